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

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import (
    Recent,
    beyond,
    copy,
    fill,
    is_decided,
    join,
    looks_ahead,
    oppose,
    recent_of,
    run_shift,
    run_window,
)
from spatial_replay.monitor.online.state import (
    OFFSET,
    ahead,
    behind,
    first_behind,
    is_closed,
    last_ahead,
)

NEAR = 16
"""So far behind the last sample, what a window in seconds begins with is found by walking back."""
FEW = 8
"""So many new samples are joined with open windows one by one; of more, windows are computed again."""


class Look(NamedTuple):
    """How a run over the recent samples sees them.

    Attributes:
        channel, mirror: the channel whose values it takes, and the one that negation takes them from.
        mode: what lies beyond the last sample.
    """

    channel: int
    mirror: int
    mode: int


@inlined
def look_of(which: int, channels: int) -> Look:
    """Return how a part is seen for one of its numbers."""
    nominal_high = 1 if channels > 1 else 0
    wide_low = 2 if channels > 2 else 0
    channel = (0 if which < 2 else wide_low) + (nominal_high if which % 2 else 0)
    mode = codes.OPEN_LOW if which == 4 else codes.OPEN_HIGH if which == 5 else codes.OPEN_END
    return Look(channel, channel ^ nominal_high, mode)


@inlined
def columns_number(which: int) -> int:
    """Return which of the columns of `Memory` belong to one of a part's numbers."""
    return which if which < 2 else which - 2


@inlined
def cells_of(part: Integers) -> tuple[int, int, int]:
    """Return where a part's cells hold its base, its variables' positions and its tables' positions."""
    base = part[codes.PART_CELL_START]
    return base, base + 1, base + 1 + part[codes.PART_VARIABLES]


@apart
def reach(table_at: int, number: int, root_low: int, root_high: int, last: int) -> int:
    """Compute which positions of a part's nodes matter for its root at root_low … root_high.

    Returns 1 if every window that they look through has closed, else 0. `plain` holds the lower ends before
    they are widened to what the tables start from.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, offset = tables.nodes, tables.parts[number], memory.clock[OFFSET]
    first, end = part[codes.PART_FIRST], part[codes.PART_END]
    base, boundaries, states = cells_of(part)
    cells, low, high = memory.cells, scratch.low, scratch.high
    for d in range(end - first):
        low[d] = np.iinfo(np.int64).max
        high[d] = -1
    low[end - 1 - first], high[end - 1 - first] = root_low, root_high
    closed = True
    for d in range(end - 1, first - 1, -1):
        node = nodes[d]
        a, b = node[codes.NODE_A], node[codes.NODE_B]
        scratch.plain[d - first] = low[d - first]
        if node[codes.NODE_VARIABLE] >= 0 and cells[base] > 0:
            low[d - first] = min(low[d - first], cells[boundaries + node[codes.NODE_VARIABLE]])
        if node[codes.NODE_TABLE] >= 0:
            low[d - first] = min(low[d - first], cells[states + node[codes.NODE_TABLE]] + 1)
        if node[codes.NODE_CODE] == codes.LITERAL:
            continue
        child_low, child_high, child_closed = _operands_reach(
            node, low[d - first], high[d - first], memory.stamps, offset, last
        )
        closed = closed and child_closed
        if a >= 0:
            low[a] = min(low[a], child_low)
            high[a] = max(high[a], child_high, high[d - first])
        if node[codes.NODE_CODE] in (
            codes.PART_AND,
            codes.PART_OR,
            codes.UNTIL,
            codes.RELEASE,
            codes.PAST_SINCE,
            codes.PAST_TRIGGER,
        ):
            low[b] = min(low[b], child_low)
            high[b] = max(high[b], child_high)
    return 1 if closed else 0


@inlined
def _operands_reach(
    node: Integers, low: int, high: int, stamps: Integers, offset: int, last: int
) -> tuple[int, int, bool]:
    """Return the operands' positions a node looks at from low … high, and whether all of them are known."""
    code, unit, near, far = (
        node[codes.NODE_CODE],
        node[codes.NODE_UNIT],
        node[codes.NODE_LOW],
        node[codes.NODE_HIGH],
    )
    if code in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN):
        closed = is_closed(stamps, offset, last, high, unit, far)
        return low, last_ahead(stamps, offset, last, high, unit, far), closed
    if code == codes.SHIFT:
        shifted = ahead(stamps, offset, last, high, unit, near)
        wanted = last_ahead(stamps, offset, last, high, unit, far) if far >= 0 else shifted
        return low, min(max(shifted, wanted), last), shifted <= last
    if code in (codes.PAST_WINDOW_MAX, codes.PAST_WINDOW_MIN):
        return first_behind(stamps, offset, min(low, last), unit, far), high, True
    if code == codes.PAST_DELAY:
        return max(behind(stamps, offset, min(low, last), unit, near), offset), high, True
    return low, high, True


@uncounted
def find_lows(table_at: int, number: int, last: int) -> None:
    """Enter the first position of each of a part's nodes that still matters."""
    # arrays are not passed on: most of them would be laid out for a call that hardly ever comes
    tables, memory, scratch, _ = arrays_at(table_at)
    part = tables.parts[number]
    base = min(memory.cells[part[codes.PART_CELL_START]], last)
    reach(table_at, number, base, last, last)
    for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
        memory.lows[d] = scratch.low[d - part[codes.PART_FIRST]]


@apart
def bring_columns_up(table_at: int, number: int, which: int, channels: int, last: int) -> int:
    """Bring the columns of a part's nodes for one of its numbers up to the last sample.

    Those are the nodes that depend on no variable.

    Args:
        number: of the part.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, at = tables.nodes, tables.parts[number], columns_number(which)
    offset, known = memory.clock[OFFSET], memory.known[number, at]
    if known < 0:
        find_lows(table_at, number, last)
    if known >= last:
        return 0
    memory.known[number, at] = last
    look, recent, changed = look_of(which, channels), recent_of(memory, scratch), scratch.changed
    first, since, end = part[codes.PART_FIRST], max(known + 1, offset), last + 1
    columns = memory.columns[at, first : part[codes.PART_END]]
    for d in range(first, part[codes.PART_END]):
        node, lowest = nodes[d], memory.lows[d]
        if node[codes.NODE_DEPENDS]:
            continue
        code, a, b, target = node[codes.NODE_CODE], node[codes.NODE_A], node[codes.NODE_B], columns[d - first]
        if code == codes.LITERAL:
            begin = max(since, lowest)
            into = target[begin - offset : end - offset]
            if b:
                oppose(memory.history[look.mirror, a, begin - offset : end - offset], into)
            else:
                copy(memory.history[look.channel, a, begin - offset : end - offset], into)
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
            run_shift(node, columns[a], target, begin, end, look.mode, recent, offset, last)
        else:
            begin = changed[a]
            is_joined = False
            if looks_ahead(code):
                is_joined = not is_decided(node, look.mode)
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
    return 0


@inlined
def _first_up_to(node: Integers, distance: int, recent: Recent, offset: int, last: int, position: int) -> int:
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
