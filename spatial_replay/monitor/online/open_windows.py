"""The nodes of a part at every position that is still open, each as one column of contiguous numbers.

A sample changes a node only where a window has just begun to hold it or has closed with it, or where an
operand has changed. So columns are kept from sample to sample and brought up to the newest one: what a
window holds is joined with the new number, and an extremum over windows of changed numbers is computed again,
by doubling: over 1, 2, 4, … numbers from each on, of which any two cover a window. Each of these passes is a
plain loop over neighbouring numbers, which the compiler turns into vector instructions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.state import (
    Memory,
    Scratch,
    behind,
    first_behind,
)

FEW = 8
"""So many new samples are joined with open windows one by one; of more, windows are computed again."""


class Look(NamedTuple):
    """How a run over the recent samples sees them.

    Attributes:
        channel, mirror: the channel whose values it takes, and the one that negation takes them from.
        mode: what lies beyond the last sample.
        corner: where mode is `OPEN_CORNER`, the values that the variables have there.
    """

    channel: int
    mirror: int
    mode: int
    corner: int


@inlined
def look_of(which: int, channels: int) -> Look:
    """Return how a part is seen for one of its numbers."""
    nominal_high = 1 if channels > 1 else 0
    wide_low = 2 if channels > 2 else 0
    channel = (0 if which < 2 else wide_low) + (nominal_high if which % 2 else 0)
    mode = codes.OPEN_LOW if which == 4 else codes.OPEN_HIGH if which == 5 else codes.OPEN_END
    return Look(channel, channel ^ nominal_high, mode, 0)


class Recent(NamedTuple):
    """What is known of the recent samples, and room to work in: arrays of `Memory` and `Scratch`."""

    history: Floats
    stamps: Integers
    lows: Integers
    window_ends: Integers
    window_next: Integers
    changed: Integers
    extrema: Floats
    ends: Integers


@inlined
def recent_of(memory: Memory, scratch: Scratch) -> Recent:
    return Recent(
        memory.history,
        memory.stamps,
        memory.lows,
        memory.window_ends,
        memory.window_next,
        scratch.changed,
        scratch.extrema,
        scratch.ends,
    )


class Stretch(NamedTuple):
    """The recent samples, and the first of them that a column does not know yet."""

    offset: int
    last: int
    since: int


@inlined
def beyond(mode: int, weak: int) -> float:
    """Return the value an operator that is still open takes from beyond the last sample."""
    if mode == codes.OPEN_END:
        return np.inf if weak else -np.inf
    return np.inf if mode == codes.OPEN_HIGH else -np.inf


@uncounted
def copy(source: Floats, target: Floats) -> None:
    for k in range(len(target)):
        target[k] = source[k]


@uncounted
def oppose(source: Floats, target: Floats) -> None:
    for k in range(len(target)):
        target[k] = -source[k]


@uncounted
def fill(target: Floats, value: float) -> None:
    for k in range(len(target)):
        target[k] = value


@uncounted
def join(is_greatest: bool, first: Floats, second: Floats, target: Floats) -> None:
    """Take the greater, or the lesser, of each two numbers."""
    if is_greatest:
        for k in range(len(target)):
            target[k] = max(first[k], second[k])
    else:
        for k in range(len(target)):
            target[k] = min(first[k], second[k])


@uncounted
def extremum(is_greatest: bool, source: Floats, start: float) -> float:
    """Return the greatest or least number and `start`, in four strands that need not wait for each other."""
    a = b = c = d = start
    count = len(source)
    whole = count - count % 4
    if is_greatest:
        for k in range(0, whole, 4):
            a, b = max(a, source[k]), max(b, source[k + 1])
            c, d = max(c, source[k + 2]), max(d, source[k + 3])
        for k in range(whole, count):
            a = max(a, source[k])
        return max(max(a, b), max(c, d))
    for k in range(0, whole, 4):
        a, b = min(a, source[k]), min(b, source[k + 1])
        c, d = min(c, source[k + 2]), min(d, source[k + 3])
    for k in range(whole, count):
        a = min(a, source[k])
    return min(min(a, b), min(c, d))


# ------------------------------------------------------------------------------------- windows in seconds


@uncounted
def enter_samples(
    nodes: Integers, part: Integers, stamps: Integers, window_ends: Integers, window_next: Integers,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Note, for each window in seconds, which positions' windows begin with the new samples, and end before.

    So each end is searched once, however often the window is looked through.
    """
    for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
        timed, near, far = nodes[d, codes.NODE_TIMED], nodes[d, codes.NODE_LOW], nodes[d, codes.NODE_HIGH]
        if timed < 0:
            continue
        is_window = nodes[d, codes.NODE_CODE] != codes.SHIFT
        starts, afters = window_ends[timed, 0], window_ends[timed, 1]
        newest = max(window_next[timed, 0], offset)
        begun, closed = max(window_next[timed, 1], offset), max(window_next[timed, 2], offset)
        for position in range(newest, last + 1):
            time_ns = stamps[position - offset]
            while begun <= position and time_ns - stamps[begun - offset] >= near:
                starts[begun - offset] = position
                begun += 1
            while is_window and closed < position and time_ns - stamps[closed - offset] > far:
                afters[closed - offset] = position
                closed += 1
        window_next[timed, 0] = last + 1
        window_next[timed, 1], window_next[timed, 2] = begun, closed


@inlined
def _is_decided(node: Integers, mode: int) -> bool:
    """Return whether what may come outdoes all that an open window holds."""
    is_greatest = node[codes.NODE_CODE] == codes.PART_WINDOW_MAX
    return mode != codes.OPEN_END and (mode == codes.OPEN_HIGH) == is_greatest


@inlined
def looks_ahead(code: int) -> bool:
    return code in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN)


@inlined
def _first_open(node: Integers, recent: Recent, offset: int, last: int) -> int:
    """Return the first position whose window ahead a later sample may fall into."""
    if node[codes.NODE_UNIT] == codes.SAMPLES:
        return int(max(last - node[codes.NODE_HIGH] + 1, offset))
    first = recent.window_next[node[codes.NODE_TIMED], 2]
    if recent.stamps[last - offset] - recent.stamps[first - offset] == node[codes.NODE_HIGH]:
        first += 1
    return int(first)


# -------------------------------------------------------------------------------------- sliding extrema


@inlined
def _slide(
    node: Integers, source: Floats, target: Floats, begin: int, end: int, recent: Recent,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Compute the extremum of `source` over the windows of the positions begin … end - 1, up to `last`."""
    code = node[codes.NODE_CODE]
    is_greatest = code in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX)
    if node[codes.NODE_UNIT] == codes.SAMPLES:
        near, width = node[codes.NODE_LOW], node[codes.NODE_HIGH] - node[codes.NODE_LOW] + 1
        if looks_ahead(code):
            width = min(width, last - (begin + near) + 1)
            first = begin + near
        else:
            width = min(width, end - 1 - near - offset + 1)
            first = begin - near - width + 1
        _slide_evenly(is_greatest, source, target, begin, end, first, width, recent.extrema, offset, last)
    else:
        _find_ends(
            node, begin, end, recent.stamps, recent.window_ends, recent.window_next, recent.ends, offset, last
        )
        _slide_unevenly(is_greatest, source, target, begin, end, recent.ends, recent.extrema, offset)


@uncounted
def _slide_evenly(
    is_greatest: bool, source: Floats, target: Floats, begin: int, end: int, first: int, width: int,
    extrema: Floats, offset: int, last: int,
) -> None:  # fmt: skip
    """Slide over windows of one width, that of `begin` from `first` on, nothing outside of the samples."""
    nothing = -np.inf if is_greatest else np.inf
    if width <= 0:
        fill(target[begin - offset : end - offset], nothing)
        return
    numbers, other = extrema[0], extrema[1]
    size = end - begin + width - 1
    inside, beyond_last = max(offset, first), min(first + size, last + 1)
    fill(numbers[: inside - first], nothing)
    copy(source[inside - offset : beyond_last - offset], numbers[inside - first : beyond_last - first])
    fill(numbers[beyond_last - first : size], nothing)
    step = 1
    while 2 * step <= width:
        size -= step
        join(is_greatest, numbers[:size], numbers[step : size + step], other[:size])
        numbers, other = other, numbers
        step *= 2
    count, late = end - begin, width - step
    join(is_greatest, numbers[:count], numbers[late : late + count], target[begin - offset : end - offset])


@uncounted
def _find_ends(
    node: Integers, begin: int, end: int, stamps: Integers, window_ends: Integers, window_next: Integers,
    ends: Integers, offset: int, last: int,
) -> None:  # fmt: skip
    """Put where the windows in seconds of begin … end - 1 start, and what comes after them, into `ends`."""
    starts, afters = ends[0], ends[1]
    unit, near, far = node[codes.NODE_UNIT], node[codes.NODE_LOW], node[codes.NODE_HIGH]
    if not looks_ahead(node[codes.NODE_CODE]):
        for position in range(begin, end):
            starts[position - begin] = first_behind(stamps, offset, position, unit, far)
            afters[position - begin] = behind(stamps, offset, position, unit, near) + 1
        return
    timed = node[codes.NODE_TIMED]
    begun, closed = window_next[timed, 1], window_next[timed, 2]
    for k in range(end - begin):
        starts[k] = window_ends[timed, 0, begin + k - offset] if begin + k < begun else last + 1
        afters[k] = window_ends[timed, 1, begin + k - offset] if begin + k < closed else last + 1


@uncounted
def _slide_unevenly(
    is_greatest: bool, source: Floats, target: Floats, begin: int, end: int, ends: Integers,
    extrema: Floats, offset: int,
) -> None:  # fmt: skip
    """Slide over windows with the given ends, over all that are about as wide at a time."""
    nothing = -np.inf if is_greatest else np.inf
    starts, afters, count = ends[0], ends[1], end - begin
    narrowest, widest = np.iinfo(np.int64).max, 0
    for k in range(count):
        width = afters[k] - starts[k]
        if width > 0:
            narrowest, widest = min(narrowest, width), max(widest, width)
        else:
            target[begin + k - offset] = nothing
    if widest == 0:
        return
    numbers, other = extrema[0], extrema[1]
    first, size = starts[0], afters[count - 1] - starts[0]
    copy(source[first - offset : first + size - offset], numbers[:size])
    step = 1
    while True:
        if 2 * step > narrowest:
            for k in range(count):
                if step <= afters[k] - starts[k] < 2 * step:
                    one, two = numbers[starts[k] - first], numbers[afters[k] - step - first]
                    target[begin + k - offset] = max(one, two) if is_greatest else min(one, two)
        if 2 * step > widest:
            return
        size -= step
        join(is_greatest, numbers[:size], numbers[step : size + step], other[:size])
        numbers, other = other, numbers
        step *= 2


@inlined
def run_window(
    node: Integers, source: Floats, target: Floats, begin: int, end: int, mode: int, recent: Recent,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Compute a bounded operator at begin … end - 1 from its operand."""
    if looks_ahead(node[codes.NODE_CODE]) and _is_decided(node, mode):
        first = min(max(_first_open(node, recent, offset, last), begin), end)
        fill(target[first - offset : end - offset], beyond(mode, node[codes.NODE_WEAK]))
        end = first
    if begin < end:
        _slide(node, source, target, begin, end, recent, offset, last)


@uncounted
def run_shift(
    node: Integers, source: Floats, target: Floats, begin: int, end: int, mode: int, stamps: Integers,
    window_ends: Integers, window_next: Integers, offset: int, last: int,
) -> None:  # fmt: skip
    """Compute a shift or a delay at begin … end - 1: `source` at a distance ahead or behind."""
    unit, distance, timed = node[codes.NODE_UNIT], node[codes.NODE_LOW], node[codes.NODE_TIMED]
    is_ahead = node[codes.NODE_CODE] == codes.SHIFT
    missing = beyond(mode if is_ahead else codes.OPEN_END, node[codes.NODE_WEAK])
    for position in range(begin, end):
        if not is_ahead:
            at = behind(stamps, offset, position, unit, distance)
        elif unit == codes.SAMPLES:
            at = position + distance
        elif position < window_next[timed, 1]:
            at = window_ends[timed, 0, position - offset]
        else:
            at = last + 1
        target[position - offset] = source[at - offset] if offset <= at <= last else missing


# ------------------------------------------------------------------------------------- brought up to date


@uncounted
def bring_up(
    nodes: Integers, part: Integers, columns: Floats, look: Look, recent: Recent,
    stretch: Stretch,
) -> None:  # fmt: skip
    """Bring the columns of all nodes that depend on no variable up to the last sample.

    Args:
        columns: (D, room), those of one look, which know the samples before `stretch.since`.
    """
    first, offset, last, since = part[codes.PART_FIRST], stretch.offset, stretch.last, stretch.since
    changed, end = recent.changed, last + 1
    for d in range(first, part[codes.PART_END]):
        node, lowest = nodes[d], recent.lows[d]
        if node[codes.NODE_DEPENDS]:
            continue
        code, a, b, target = node[codes.NODE_CODE], node[codes.NODE_A], node[codes.NODE_B], columns[d - first]
        if code == codes.LITERAL:
            begin = max(since, lowest)
            into = target[begin - offset : end - offset]
            if b:
                oppose(recent.history[look.mirror, a, begin - offset : end - offset], into)
            else:
                copy(recent.history[look.channel, a, begin - offset : end - offset], into)
        elif code in (codes.PART_AND, codes.PART_OR):
            begin = max(min(changed[a], changed[b]), lowest)
            one, two = columns[a, begin - offset : end - offset], columns[b, begin - offset : end - offset]
            join(code == codes.PART_OR, one, two, target[begin - offset : end - offset])
        elif code in (codes.UNTIL, codes.RELEASE):
            begin = _run_running(node, columns, target, lowest, look.mode, changed, offset, last, since)
        elif code in (codes.SHIFT, codes.PAST_DELAY):
            begin = changed[a]
            if code == codes.SHIFT:  # positions that look between two samples look at the second one
                begin = _first_up_to(node, codes.NODE_LOW, recent, offset, last, max(begin - 1, offset))
            begin = max(begin, lowest)
            run_shift(
                node, columns[a], target, begin, end, look.mode, recent.stamps, recent.window_ends,
                recent.window_next, offset, last,
            )  # fmt: skip
        else:
            begin = changed[a]
            is_joined = False
            if looks_ahead(code):
                is_joined = not _is_decided(node, look.mode)
                if not is_joined:  # those that have closed have changed, too
                    begin = max(min(begin, since - 1), offset)
                is_joined = is_joined and since <= changed[a] and since > offset and last - since < FEW
                begin = _first_up_to(node, codes.NODE_HIGH, recent, offset, last, begin)
            begin = max(begin, lowest)
            if is_joined:
                begin = _join_samples(node, columns[a], target, begin, lowest, recent, offset, last, since)
            else:
                run_window(node, columns[a], target, begin, end, look.mode, recent, offset, last)
        changed[d - first] = begin


@inlined
def _first_up_to(node: Integers, distance: int, recent: Recent, offset: int, last: int, position: int) -> int:
    """Return the first position that is at most the distance in a column of its node before another one."""
    if node[codes.NODE_UNIT] == codes.SAMPLES:
        return int(max(position - node[distance], offset))
    if position == last and distance == codes.NODE_HIGH:
        return int(recent.window_next[node[codes.NODE_TIMED], 2])
    return first_behind(recent.stamps, offset, position, node[codes.NODE_UNIT], node[distance])


@uncounted
def _run_running(
    node: Integers, columns: Floats, target: Floats, lowest: int, mode: int, changed: Integers, offset: int,
    last: int, since: int,
) -> int:  # fmt: skip
    """Run an until or release without a variable backwards, as far as it changes; return how far that is."""
    a, b, is_until = node[codes.NODE_A], node[codes.NODE_B], node[codes.NODE_CODE] == codes.UNTIL
    same = min(changed[b], since)
    if a >= 0:
        same = min(same, changed[a])
    value = beyond(mode, node[codes.NODE_WEAK])
    position = last
    while position >= lowest:
        k = position - offset
        if is_until:
            value = max(columns[b, k], min(columns[a, k], value) if a >= 0 else value)
        else:
            value = min(columns[b, k], max(columns[a, k], value) if a >= 0 else value)
        if position < same and value == target[k]:
            break
        target[k] = value
        position -= 1
    return position + 1


@inlined
def _join_samples(
    node: Integers, source: Floats, target: Floats, begin: int, lowest: int, recent: Recent, offset: int,
    last: int, since: int,
) -> int:  # fmt: skip
    """Join the new samples with the open windows that hold them, the first of which is that of `begin`.

    These windows all end with the sample, so that the later one begins, the less it holds: where one changes,
    so do those after it, and the first is searched by halves.

    Returns:
        The first position that changes.
    """
    is_greatest, changed = node[codes.NODE_CODE] == codes.PART_WINDOW_MAX, since
    for position in range(since, last + 1):
        value = source[position - offset]
        target[position - offset] = -np.inf if is_greatest else np.inf
        low, after = begin, position + 1
        if position > since:
            low = max(_first_up_to(node, codes.NODE_HIGH, recent, offset, last, position), lowest)
        if node[codes.NODE_LOW] > 0:
            after = 1 + behind(recent.stamps, offset, position, node[codes.NODE_UNIT], node[codes.NODE_LOW])
        high = max(after, low)
        while low < high:
            middle = (low + high) >> 1
            held = target[middle - offset]
            if held < value if is_greatest else held > value:
                high = middle
            else:
                low = middle + 1
        if low < after:
            fill(target[low - offset : after - offset], value)
            changed = min(changed, low)
    return changed
