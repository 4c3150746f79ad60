"""Bounded operators at neighbouring positions, from columns of contiguous numbers.

Extrema over windows are computed by doubling: over 1, 2, 4, … numbers from each on, of which any two cover a
window. Each of these passes is a plain loop over neighbouring numbers, which the compiler turns into vector
instructions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.state import Memory, Scratch, behind, first_behind

NEAR = 16
"""So far behind the last sample, what a window in seconds begins with is found by walking back."""
STRIDE = 16
"""So many numbers are filled with one at a time, at first."""


class Recent(NamedTuple):
    """What is known of the recent samples, and room to work in: arrays of `Memory` and `Scratch`."""

    stamps: Integers
    window_ends: Integers
    window_next: Integers
    extrema: Floats
    ends: Integers


@inlined
def recent_of(memory: Memory, scratch: Scratch) -> Recent:
    return Recent(memory.stamps, memory.window_ends, memory.window_next, scratch.extrema, scratch.ends)


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


@inlined
def either(is_greatest: bool, first: float, second: float) -> float:
    """Return the greater or the lesser of two numbers."""
    return max(first, second) if is_greatest else min(first, second)


@uncounted
def join_changed(
    is_greatest: bool, first: Floats, second: Floats, target: Floats, begin: int, known: int, end: int
) -> int:
    """Join numbers from `begin` to before `end`; return the first that changes, of those before `known`."""
    while begin < known and either(is_greatest, first[begin], second[begin]) == target[begin]:
        begin += 1
    join(is_greatest, first[begin:end], second[begin:end], target[begin:end])
    return begin


@uncounted
def extremum(is_greatest: bool, source: Floats, start: float) -> float:
    """Return the greatest or least number and `start`.

    Eight numbers are joined side by side: one after the other, each would wait for the one before.
    """
    count = len(source)
    whole = count - count % 8
    value, v1, v2, v3, v4, v5, v6, v7 = start, start, start, start, start, start, start, start
    if is_greatest:
        for k in range(0, whole, 8):
            value, v1, v2, v3 = (
                max(value, source[k]),
                max(v1, source[k + 1]),
                max(v2, source[k + 2]),
                max(v3, source[k + 3]),
            )
            v4, v5, v6, v7 = (
                max(v4, source[k + 4]),
                max(v5, source[k + 5]),
                max(v6, source[k + 6]),
                max(v7, source[k + 7]),
            )
        value = max(max(max(value, v1), max(v2, v3)), max(max(v4, v5), max(v6, v7)))
        for k in range(whole, count):
            value = max(value, source[k])
    else:
        for k in range(0, whole, 8):
            value, v1, v2, v3 = (
                min(value, source[k]),
                min(v1, source[k + 1]),
                min(v2, source[k + 2]),
                min(v3, source[k + 3]),
            )
            v4, v5, v6, v7 = (
                min(v4, source[k + 4]),
                min(v5, source[k + 5]),
                min(v6, source[k + 6]),
                min(v7, source[k + 7]),
            )
        value = min(min(min(value, v1), min(v2, v3)), min(min(v4, v5), min(v6, v7)))
        for k in range(whole, count):
            value = min(value, source[k])
    return value


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
def is_decided(node: Integers, mode: int) -> bool:
    """Return whether what may come outdoes all that an open window holds."""
    is_greatest = node[codes.NODE_CODE] == codes.PART_WINDOW_MAX
    return mode != codes.OPEN_END and (mode == codes.OPEN_HIGH) == is_greatest


@inlined
def looks_ahead(code: int) -> bool:
    return code in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN)


@inlined
def first_unclosed(node: Integers, recent: Recent, offset: int, last: int) -> int:
    """Return the first position whose window ahead a later sample may fall into."""
    if node[codes.NODE_UNIT] == codes.SAMPLES:
        return int(max(last - node[codes.NODE_HIGH] + 1, offset))
    first = recent.window_next[node[codes.NODE_TIMED], 2]
    if recent.stamps[last - offset] - recent.stamps[first - offset] == node[codes.NODE_HIGH]:
        first += 1
    return int(first)


@uncounted
def slide_evenly(
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
def _find_ends(node: Integers, begin: int, end: int, recent: Recent, offset: int, last: int) -> None:
    """Put where the windows in seconds of begin … end - 1 start, and what comes after them, into `ends`."""
    stamps, window_ends, window_next = recent.stamps, recent.window_ends, recent.window_next
    starts, afters = recent.ends[0], recent.ends[1]
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
    is_greatest: bool, source: Floats, target: Floats, begin: int, end: int, recent: Recent, offset: int
) -> None:
    """Slide over windows with the ends found, over all that are about as wide at a time."""
    nothing = -np.inf if is_greatest else np.inf
    starts, afters, count = recent.ends[0], recent.ends[1], end - begin
    # the last windows mostly end alike, and each of these holds what the one after it does
    at = beyond_last = afters[count - 1]
    value = nothing
    while count > 0 and afters[count - 1] == beyond_last:
        count -= 1
        while at > starts[count]:
            at -= 1
            number = source[at - offset]
            value = max(value, number) if is_greatest else min(value, number)
        target[begin + count - offset] = value
    narrowest, widest = np.iinfo(np.int64).max, 0
    for k in range(count):
        width = afters[k] - starts[k]
        if width > 0:
            narrowest, widest = min(narrowest, width), max(widest, width)
        else:
            target[begin + k - offset] = nothing
    if widest == 0:
        return
    numbers, other = recent.extrema[0], recent.extrema[1]
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
    """Compute a bounded operator at begin … end - 1, the extremum of `source` over each window."""
    code = node[codes.NODE_CODE]
    is_greatest = code in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX)
    if looks_ahead(code) and is_decided(node, mode):
        first = min(max(first_unclosed(node, recent, offset, last), begin), end)
        fill(target[first - offset : end - offset], beyond(mode, node[codes.NODE_WEAK]))
        end = first
    if begin >= end:
        return
    if node[codes.NODE_UNIT] != codes.SAMPLES:
        _find_ends(node, begin, end, recent, offset, last)
        _slide_unevenly(is_greatest, source, target, begin, end, recent, offset)
        return
    near, width = node[codes.NODE_LOW], node[codes.NODE_HIGH] - node[codes.NODE_LOW] + 1
    if looks_ahead(code):
        width = min(width, last - (begin + near) + 1)
        first = begin + near
    else:
        width = min(width, end - 1 - near - offset + 1)
        first = begin - near - width + 1
    slide_evenly(is_greatest, source, target, begin, end, first, width, recent.extrema, offset, last)


@uncounted
def run_shift(
    node: Integers, source: Floats, target: Floats, begin: int, end: int, mode: int, recent: Recent,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Compute a shift or a delay at begin … end - 1: `source` at a distance ahead or behind."""
    unit, distance, timed = node[codes.NODE_UNIT], node[codes.NODE_LOW], node[codes.NODE_TIMED]
    is_ahead = node[codes.NODE_CODE] == codes.SHIFT
    missing = beyond(mode if is_ahead else codes.OPEN_END, node[codes.NODE_WEAK])
    for position in range(begin, end):
        if not is_ahead:
            at = behind(recent.stamps, offset, position, unit, distance)
        elif unit == codes.SAMPLES:
            at = position + distance
        elif position < recent.window_next[timed, 1]:
            at = recent.window_ends[timed, 0, position - offset]
        else:
            at = last + 1
        target[position - offset] = source[at - offset] if offset <= at <= last else missing


@inlined
def window_start(node: Integers, recent: Recent, position: int, offset: int, last: int) -> int:
    """Return the position that a window ahead starts with, at most that after the last sample."""
    if node[codes.NODE_UNIT] == codes.SAMPLES:
        return int(min(position + node[codes.NODE_LOW], last + 1))
    timed = node[codes.NODE_TIMED]
    is_begun = position < recent.window_next[timed, 1]
    return int(recent.window_ends[timed, 0, position - offset]) if is_begun else last + 1


@inlined
def window_after(node: Integers, recent: Recent, position: int, offset: int, last: int) -> int:
    """Return the position that comes after a window ahead, at most that after the last sample."""
    if node[codes.NODE_UNIT] == codes.SAMPLES:
        return int(min(position + node[codes.NODE_HIGH], last)) + 1
    timed = node[codes.NODE_TIMED]
    is_ended = position < recent.window_next[timed, 2]
    return int(recent.window_ends[timed, 1, position - offset]) if is_ended else last + 1


@inlined
def run_to_last(
    is_greatest: bool, node: Integers, source: Floats, target: Floats, value: float, lowest: int,
    changed: int, since: int, recent: Recent, offset: int, last: int,
) -> int:  # fmt: skip
    """Compute extrema from where a window starts to the last sample, backwards as far as they change.

    Args:
        value: what lies beyond.
        lowest: the first position.
        changed: the first position at which `source` has changed.
        since: the first sample for which `target` has no numbers yet.

    Returns:
        The first position that changes.
    """
    is_even = node[codes.NODE_UNIT] == codes.SAMPLES or node[codes.NODE_LOW] == 0
    position, at, stride = last, last + 1, STRIDE
    while position >= lowest:
        start = window_start(node, recent, position, offset, last)
        while at > start:
            at -= 1
            value = either(is_greatest, value, source[at - offset])
        if position < since:
            if at <= changed and target[position - offset] == value:
                break
            # where many change, most become equal to the newest
            # windows that begin after the last sample all begin there, not one after the other
            is_in_step = is_even and at == start <= last
            if is_in_step and position - stride >= lowest and position + STRIDE < since:
                begin = at - stride - offset
                if extremum(is_greatest, source[begin : begin + stride], value) == value:
                    begin = position - stride - offset
                    fill(target[begin : begin + stride + 1], value)
                    position, at = position - stride - 1, at - stride
                    stride *= 2
                    continue
                stride = STRIDE
        target[position - offset] = value
        position -= 1
    return position + 1


@inlined
def first_up_to(node: Integers, distance: int, recent: Recent, offset: int, last: int, position: int) -> int:
    """Return the first position that is at most the distance in a column of its node before another one."""
    if node[codes.NODE_UNIT] == codes.SAMPLES:
        return int(max(position - node[distance], offset))
    if distance == codes.NODE_HIGH and position > last - NEAR:
        # of those whose windows have closed, the newest are the only ones that may hold it
        timed = node[codes.NODE_TIMED]
        first, afters = recent.window_next[timed, 2], recent.window_ends[timed, 1]
        while first > offset and afters[first - 1 - offset] > position:
            first -= 1
        return int(first)
    return first_behind(recent.stamps, offset, position, node[codes.NODE_UNIT], node[distance])
