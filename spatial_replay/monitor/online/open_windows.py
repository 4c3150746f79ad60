"""The nodes of a part at every position that is still open, each as one column of contiguous numbers.

A sample changes a node only where a window has just begun to hold it or has closed with it, or where an
operand has changed. So columns are kept from sample to sample and brought up to the newest one, node by node,
operands first (see `node_columns`, `windows_ahead`).
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.node_columns import (
    cells_of,
    columns_number,
    join_operands,
    look_of,
    run_behind,
    run_since,
    run_until,
)
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import looks_ahead
from spatial_replay.monitor.online.state import (
    NUMBERS,
    OFFSET,
    START_NS,
    Memory,
    ahead,
    behind,
    first_behind,
    first_since,
    is_closed,
    last_ahead,
)
from spatial_replay.monitor.online.windows_ahead import run_ahead


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
            # what it starts from stands in its column, too
            low[d - first] = min(low[d - first], max(cells[states + node[codes.NODE_TABLE]], offset))
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


@inlined
def is_plain(part: Integers) -> bool:
    """Return whether the root is all that depends on a variable."""
    return part[codes.PART_VARIABLES] == 1 and not part[codes.PART_IS_NESTED]


@inlined
def runs_root(part: Integers, root: Integers) -> bool:
    """Return whether the root has a column. One that joins all its operand from some position on needs none.

    Nor does one whose left operand only says when its window is over: what it joins after that is neutral.
    """
    has_left = root[codes.NODE_A] >= 0 and part[codes.PART_ENDS_AT] < 0
    return bool(has_left or root[codes.NODE_VARIABLE] < 0)


@inlined
def is_over(part: Integers, memory: Memory, last: int) -> bool:
    """Return whether no later sample can fall into the window of a root that counts from the first one."""
    far = part[codes.PART_ENDS_AT]
    if far < 0:
        return False
    if part[codes.PART_END_UNIT] == codes.SAMPLES:
        return bool(last >= far)
    return bool(memory.stamps[last - memory.clock[OFFSET]] - memory.clock[START_NS] >= far)


@inlined
def has_ended(part: Integers, root: Integers, memory: Memory, last: int) -> bool:
    """Return whether the window of a root that has no column is over, so that it joins nothing more."""
    return not runs_root(part, root) and is_over(part, memory, last)


@inlined
def root_window(root: Integers, memory: Memory, last: int) -> tuple[int, int]:
    """Return the first of the recent positions that a root joins, and what comes after the last one."""
    unit, near, far = root[codes.NODE_UNIT], root[codes.NODE_LOW], root[codes.NODE_HIGH]
    offset, start_ns = memory.clock[OFFSET], memory.clock[START_NS]
    begin, after = offset, last + 1
    if far > 0 and unit == codes.SAMPLES:
        begin, after = min(max(near, offset), last + 1), min(far, last) + 1
    elif far > 0:
        if near > 0:
            begin = first_since(memory.stamps, offset, last, start_ns, near)
        if memory.stamps[last - offset] - start_ns > far:
            after = first_since(memory.stamps, offset, last, start_ns, far + 1)
    return begin, after


@inlined
def is_known(which: int, part: Integers, memory: Memory, last: int) -> bool:
    """Return whether one of a part's numbers is a bound that follows from its table (see `known_number`)."""
    known = part[codes.PART_KNOWN] >> which
    return known & 1 == 1 and (known & codes.EVEN_IF_OVER > 0 or not is_over(part, memory, last))


@inlined
def is_same(which: int, part: Integers, memory: Memory, channels: int, last: int) -> bool:
    """Return whether a bound is the value: the root is over, and all that is open counts alike for both.

    Not in a run that leaves the value to another one (see `shares`): the value is computed first, and copied.
    """
    is_alike = (part[codes.PART_KNOWN] >> which) & codes.SAME_IF_OVER > 0 and channels < 4
    has_value = (part[codes.PART_NUMBERS] >> look_of(which, channels).channel) & 1 == 1
    return bool(is_alike and has_value and is_over(part, memory, last))


@inlined
def known_number(which: int, part: Integers, memory: Memory, channel: int) -> float:
    """Return a bound that is known: what comes outdoes all that is open, whatever that is."""
    if memory.cells[part[codes.PART_CELL_START]] == 0:
        return -np.inf if which == codes.LOWER else np.inf
    corner = (1 << part[codes.PART_VARIABLES]) - 1 if which == codes.UPPER else 0
    return float(memory.tables[channel, part[codes.PART_TABLE_START] + corner])


@inlined
def is_cut_short(which: int, part: Integers, root: Integers, channels: int) -> bool:
    """Return whether a number is that of the value, cut short, which needs no columns of its own."""
    cuts = 4 if root[codes.NODE_CODE] == codes.UNTIL else 5
    return part[codes.PART_IS_CUT] == 1 and which == cuts and channels < 4


@inlined
def looks_of(
    part: Integers, root: Integers, memory: Memory, channels: int, is_last: bool, position: int
) -> int:
    """Return which numbers of a part a run computes by themselves at a sample, a bit for each.

    Numbers 2 and 3 (now) come with 0 and 1; those of an ending run count for the last sample only.
    """
    looks, own = 1 | 2 if channels > 1 else 1, part[codes.PART_NUMBERS]
    if part[codes.PART_VARIABLES] == 0 and memory.cells[part[codes.PART_CELL_START]] > 0:
        return int(looks & own)  # its numbers at the first sample stand in its table
    for which in (4, 5):
        is_other = is_known(which, part, memory, position) or is_cut_short(which, part, root, channels)
        if not is_other and not is_same(which, part, memory, channels, position):
            looks |= 1 << which
    if is_last and channels == 4:
        looks |= 1 << 6 | 1 << 7
    return int(looks & own)


@apart
def bring_columns_up(table_at: int, number: int, looks: int, channels: int, last: int) -> int:
    """Bring the columns of a part's nodes up to the last sample, for some of its numbers.

    Args:
        number: of the part.
        looks: the numbers, a bit for each.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, offset, changed = tables.nodes, tables.parts[number], memory.clock[OFFSET], scratch.changed
    first, after, body = (
        part[codes.PART_FIRST],
        part[codes.PART_END],
        nodes[part[codes.PART_END] - 1, codes.NODE_B],
    )
    for which in range(NUMBERS):
        at = columns_number(which)
        if not (looks >> which) & 1 or memory.known[number, at] >= last:
            continue
        if memory.known[number, at] < 0:
            find_lows(table_at, number, last)
        since = max(memory.known[number, at] + 1, offset)
        memory.known[number, at] = last
        has_root = runs_root(part, nodes[after - 1])
        for d in range(first, after if has_root else after - 1):
            code = nodes[d, codes.NODE_CODE]
            if code == codes.LITERAL:
                begin = max(since, memory.lows[d])
            elif code in (codes.PART_AND, codes.PART_OR):
                begin = join_operands(table_at, number, d, which, channels, since, last)
            elif looks_ahead(code):
                begin = run_ahead(table_at, number, d, which, channels, since, last)
            elif code in (codes.UNTIL, codes.RELEASE):
                begin = run_until(table_at, number, d, which, channels, since, last)
            elif code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
                begin = run_since(table_at, number, d, which, channels, since, last)
            else:
                begin = run_behind(table_at, number, d, which, channels, since, last)
            changed[d - first] = begin
        if not has_root:
            memory.unjoined[number, at] = min(memory.unjoined[number, at], changed[body])
    return 0
