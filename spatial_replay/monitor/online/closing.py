"""Positions of a part whose windows have closed, or which matter no more, absorbed into its table.

What depends on a variable, or on the table of a past operator, is run over the positions that matter, once
for each corner of the table.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.node_columns import (
    cells_of,
    columns_number,
    settled_look,
    signal_of,
    start_of_past,
    tables_end,
)
from spatial_replay.monitor.online.open_windows import (
    bring_columns_up,
    find_lows,
    has_ended,
    is_over,
    reach,
    root_window,
)
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import (
    beyond,
    either,
    extremum,
    join,
    recent_of,
    run_shift,
    run_window,
)
from spatial_replay.monitor.online.state import OFFSET, Memory, Scratch
from spatial_replay.monitor.online.tables import corner_value, read_table

CLOSING = 16
"""So many samples together are looked at for positions that have closed."""


@uncounted
def root_value(
    root: Integers, left: Floats, right: Floats, after: float, first: int, last: int, offset: int
) -> float:
    """Return an unbounded until or release at `first`, given what it is after `last`."""
    is_until = root[codes.NODE_CODE] == codes.UNTIL
    if root[codes.NODE_A] < 0:
        return extremum(is_until, right[first - offset : last + 1 - offset], after)
    value = after
    for k in range(last - offset, first - offset - 1, -1):
        value = either(is_until, right[k], either(not is_until, left[k], value))
    return value


@inlined
def is_settled(part: Integers, memory: Memory) -> bool:
    """Return whether no later sample matters: a part's table says the same whatever is still to come."""
    # what it is now goes on, but is a matter of the run that computes its value
    goes_on = part[codes.PART_IS_REMEMBERING] and part[codes.PART_NUMBERS] & 1
    if goes_on or memory.cells[part[codes.PART_CELL_START]] == 0:
        return False
    least = part[codes.PART_TABLE_START]
    most = least + (1 << part[codes.PART_VARIABLES]) - 1
    for channel in range(codes.CHANNELS):
        if memory.tables[channel, least] != memory.tables[channel, most]:
            return False
    return True


@inlined
def _run_recurrence(
    node: Integers, left: Floats, right: Floats, target: Floats, start: float, begin: int, end: int, step: int
) -> None:
    """Run an operator without a window: until and release backwards, since and trigger forwards."""
    has_left = node[codes.NODE_A] >= 0
    is_strong = node[codes.NODE_CODE] in (codes.UNTIL, codes.PAST_SINCE)
    value = start
    for k in range(begin, end, step):
        if is_strong:
            value = max(right[k], min(left[k], value) if has_left else value)
        else:
            value = min(right[k], max(left[k], value) if has_left else value)
        target[k] = value


@apart
def run_dependent(table_at: int, number: int, channel: int, at: int, corner: int, last: int) -> int:
    """Run the nodes of a part that depend on a variable or a table, at the positions low … high of `Scratch`.

    `scratch.point` receives the variables' values where the table's base ends, `scratch.starts` the
    values that past operators start from.

    Args:
        number: of the part.
        channel: of the tables.
        at: which columns hold what does not depend on any.
        corner: of the table, the values of the variables.
    """
    arrays, memory, scratch, _ = arrays_at(table_at)
    nodes, part, offset = arrays.nodes, arrays.parts[number], memory.clock[OFFSET]
    first, recent, cells = part[codes.PART_FIRST], recent_of(memory, scratch), memory.cells
    settled, history = memory.columns[at], memory.history[channel]
    tables = memory.tables[channel, part[codes.PART_TABLE_START] : tables_end(part)]
    _, boundaries, states = cells_of(part)
    for d in range(first, part[codes.PART_END]):
        node = nodes[d]
        if not node[codes.NODE_DEPENDS]:
            continue
        code, a, b, target = node[0], node[codes.NODE_A], node[codes.NODE_B], scratch.corners[d - first]
        own_low, own_high = scratch.low[d - first], scratch.high[d - first]
        begin, end = own_low - offset, own_high - offset + 1
        a, b = max(a, 0), max(b, 0)
        left, right = signal_of(nodes, first + a), signal_of(nodes, first + b)
        one = settled[first + a] if left < 0 else history[left]
        two = settled[first + b] if right < 0 else history[right]
        if nodes[first + a, codes.NODE_DEPENDS]:
            one = scratch.corners[a]
        if nodes[first + b, codes.NODE_DEPENDS]:
            two = scratch.corners[b]
        if code in (codes.PART_AND, codes.PART_OR):
            join(code == codes.PART_OR, one[begin:end], two[begin:end], target[begin:end])
        elif code in (codes.UNTIL, codes.RELEASE):
            variable = node[codes.NODE_VARIABLE]
            value = corner_value(corner, variable) if variable >= 0 else -np.inf
            _run_recurrence(node, one, two, target, value, end - 1, begin - 1, -1)
            if variable >= 0:
                boundary = cells[boundaries + variable]
                scratch.point[variable] = target[boundary - offset] if boundary <= own_high else value
        elif code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
            table, start = node[codes.NODE_TABLE], cells[states + node[codes.NODE_TABLE]]
            scratch.starts[table] = start_of_past(node, part, tables, start, scratch)
            _run_recurrence(node, one, two, target, scratch.starts[table], start + 1 - offset, end, 1)
        elif code in (codes.SHIFT, codes.PAST_DELAY):
            run_shift(node, one, target, own_low, own_high + 1, codes.OPEN_CORNER, recent, offset, last)
        else:
            run_window(node, one, target, own_low, own_high + 1, codes.OPEN_CORNER, recent, offset, last)
    return 0


@apart
def absorb(table_at: int, number: int, channels: int, last: int, outdone: int) -> int:
    """Move a part's base forward over every position whose windows have all closed, or which matters no more.

    Args:
        outdone: what comes after positions that are known to matter no more (see `is_outdone`), 0 for none.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, offset = tables.nodes, tables.parts[number], memory.clock[OFFSET]
    base = cells_of(part)[0]
    before = memory.cells[base]
    looks = 0
    for channel in range(channels):
        which = settled_look(part, channel, channels)
        looks |= 1 << which if which >= 0 else 0
    bring_columns_up(table_at, number, looks, channels, last)
    if part[codes.PART_IS_NESTED]:
        _absorb_nested(table_at, number, nodes, part, memory, scratch, channels, offset, last)
    else:
        _absorb_plain(table_at, number, nodes, part, memory, channels, offset, last)
    _absorb_outdone(part, nodes[part[codes.PART_END] - 1], outdone, memory, channels, offset, last)
    if memory.cells[base] > before:
        find_lows(table_at, number, last)
    return 0


@inlined
def is_outdone(part: Integers, root: Integers, memory: Memory, channel: int, value: float) -> bool:
    """Return whether it makes no difference to a root how good its operand is, if at least this.

    `G` is never more than its table says, so that what it joins matters no more once it is at least that.
    """
    start = part[codes.PART_TABLE_START]
    if root[codes.NODE_CODE] == codes.UNTIL:
        return bool(value <= memory.tables[channel, start])
    return bool(value >= memory.tables[channel, start + 1])


@inlined
def looks_for_outdone(part: Integers, memory: Memory, channels: int, last: int) -> bool:
    """Return whether the value says what is outdone of what a root joins.

    Nothing does once its window is over: what comes is joined no more then.
    """
    is_said = part[codes.PART_IS_MONOTONE] and part[codes.PART_NUMBERS] & 1 and channels <= 2
    is_begun = memory.cells[part[codes.PART_CELL_START]] > 0
    return bool(is_said and is_begun and not is_over(part, memory, last))


@uncounted
def _absorb_outdone(
    part: Integers, root: Integers, outdone: int, memory: Memory, channels: int, offset: int, last: int
) -> None:
    """Absorb positions whose windows are open, but which do not change the table any more.

    Args:
        outdone: what comes after those that are known to be outdone.
    """
    base, boundary, _ = cells_of(part)
    limit, position = part[codes.PART_LIMIT], memory.cells[base]
    if position == 0 or is_over(part, memory, last):
        return
    begin = max(position, outdone)
    stop, is_first = begin, True
    for channel in range(channels if limit >= 0 else 0):
        if settled_look(part, channel, channels) < 0:
            continue
        signal, k, end = memory.history[channel, limit], begin, last + 1 if is_first else stop
        while k < end and is_outdone(part, root, memory, channel, signal[k - offset]):
            k += 1
        stop, is_first = k, False
    if stop > position:
        memory.cells[base] = memory.cells[boundary] = stop


@uncounted
def _absorb_plain(
    table_at: int, number: int, nodes: Integers, part: Integers, memory: Memory, channels: int, offset: int,
    last: int,
) -> None:  # fmt: skip
    """Absorb what has closed, many positions at a time, where no more than the root has a variable."""
    base, boundary, _ = cells_of(part)
    cells, root, size = memory.cells, nodes[part[codes.PART_END] - 1], CLOSING
    earliest, after = root_window(root, memory, last)
    while size > 0:
        first, newest = cells[base], cells[base] + size - 1
        if newest > last or not reach(table_at, number, newest, newest, last):
            size //= 2
            continue
        for channel in range(channels):
            which = settled_look(part, channel, channels)
            if which < 0:
                continue
            columns, history = memory.columns[columns_number(which)], memory.history[channel]
            tables = memory.tables[channel, part[codes.PART_TABLE_START] : tables_end(part)]
            if part[codes.PART_VARIABLES] == 0:
                if first == 0:
                    tables[0] = columns[part[codes.PART_END] - 1, 0 - offset]
                continue
            a, b = (
                part[codes.PART_FIRST] + max(root[codes.NODE_A], 0),
                part[codes.PART_FIRST] + root[codes.NODE_B],
            )
            signal, other = signal_of(nodes, a), signal_of(nodes, b)
            left = columns[a] if signal < 0 else history[signal]
            right = columns[b] if other < 0 else history[other]
            worst, best = -np.inf, np.inf
            if newest + 1 >= after and has_ended(part, root, memory, last):
                worst = best = beyond(codes.OPEN_END, root[codes.NODE_WEAK])
            begin = max(first, earliest)
            end = max(min(newest + 1, after), begin)
            worst = root_value(root, left, right, worst, begin, end - 1, offset)
            best = root_value(root, left, right, best, begin, end - 1, offset)
            if first > 0:
                low, high = tables[0], tables[1]
                worst, best = max(low, min(worst, high)), max(low, min(best, high))
            tables[0], tables[1] = worst, best
        cells[base] = newest + 1
        if part[codes.PART_VARIABLES] > 0:
            cells[boundary] = newest + 1


@uncounted
def _absorb_nested(
    table_at: int, number: int, nodes: Integers, part: Integers, memory: Memory, scratch: Scratch,
    channels: int, offset: int, last: int,
) -> None:  # fmt: skip
    """Absorb what has closed, many positions at a time."""
    base, boundaries, states = cells_of(part)
    cells, size = memory.cells, CLOSING
    while size > 0:
        newest = cells[base] + size - 1
        if newest > last or not reach(table_at, number, cells[base], newest, last):
            size //= 2
            continue
        for channel in range(channels):
            which = settled_look(part, channel, channels)
            if which >= 0:
                at = columns_number(which)
                _renew_tables(table_at, number, nodes, part, channel, at, memory, scratch, offset, last)
        for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
            variable, table = nodes[d, codes.NODE_VARIABLE], nodes[d, codes.NODE_TABLE]
            if variable >= 0:
                cells[boundaries + variable] = scratch.high[d - part[codes.PART_FIRST]] + 1
            if table >= 0:
                state = scratch.plain[d - part[codes.PART_FIRST]] - 1
                cells[states + table] = max(cells[states + table], state)
        cells[base] = newest + 1


@uncounted
def _renew_tables(
    table_at: int, number: int, nodes: Integers, part: Integers, channel: int, at: int, memory: Memory,
    scratch: Scratch, offset: int, last: int,
) -> None:  # fmt: skip
    """Renew the tables of a part, in one channel, after adding positions from its base on."""
    first, end, variables = part[codes.PART_FIRST], part[codes.PART_END], part[codes.PART_VARIABLES]
    fresh, size = scratch.fresh, 1 << variables
    base, _, states = cells_of(part)
    tables = memory.tables[channel, part[codes.PART_TABLE_START] : tables_end(part)]
    for corner in range(size):
        run_dependent(table_at, number, channel, at, corner, last)
        if memory.cells[base] == 0:
            is_known = not nodes[end - 1, codes.NODE_DEPENDS]
            root = memory.columns[at, end - 1] if is_known else scratch.corners[end - 1 - first]
            fresh[corner] = root[0 - offset]
        else:
            fresh[corner] = read_table(tables[:size], variables, scratch.point, scratch.order)
        for d in range(first, end):
            table = nodes[d, codes.NODE_TABLE]
            if table >= 0:
                state = scratch.plain[d - first] - 1
                is_new = state > memory.cells[states + table]
                value = scratch.corners[d - first, state - offset] if is_new else scratch.starts[table]
                fresh[table * size + corner] = value
    for k in range(len(tables)):
        tables[k] = fresh[k]
