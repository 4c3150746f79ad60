"""Positions of a part whose windows have closed, absorbed into its table.

What depends on a variable, or on the table of a past operator, is run over the positions that matter, once
for each corner of the table.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.open_windows import bring_columns_up, cells_of, find_lows, reach
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import beyond, extremum, join, recent_of, run_shift, run_window
from spatial_replay.monitor.online.state import OFFSET, Memory, Scratch
from spatial_replay.monitor.online.tables import corner_value, read_table

CLOSING = 16
"""So many samples together are looked at for positions that have closed."""


@uncounted
def root_value(root: Integers, columns: Floats, after: float, first: int, last: int, offset: int) -> float:
    """Return an unbounded until or release at `first`, given what it is after `last`."""
    a, b, is_until = root[codes.NODE_A], root[codes.NODE_B], root[codes.NODE_CODE] == codes.UNTIL
    if a < 0:
        return extremum(is_until, columns[b, first - offset : last + 1 - offset], after)
    value = after
    for k in range(last - offset, first - offset - 1, -1):
        if is_until:
            value = max(columns[b, k], min(columns[a, k], value))
        else:
            value = min(columns[b, k], max(columns[a, k], value))
    return value


@inlined
def is_plain(part: Integers) -> bool:
    """Return whether the root is all that depends on a variable."""
    return part[codes.PART_VARIABLES] == 1 and not part[codes.PART_IS_NESTED]


@inlined
def tables_end(part: Integers) -> int:
    """Return where a part's own table and those of its past operators end; they begin with its own."""
    return int(part[codes.PART_TABLE_START] + (part[codes.PART_TABLES] << part[codes.PART_VARIABLES]))


@inlined
def is_settled(part: Integers, memory: Memory) -> bool:
    """Return whether no later sample matters: every window from the first sample on has closed."""
    without_state = part[codes.PART_VARIABLES] == 0 and not part[codes.PART_IS_REMEMBERING]
    return bool(without_state and memory.cells[part[codes.PART_CELL_START]] > 0)


@inlined
def _run_recurrence(
    node: Integers, columns: Floats, target: Floats, start: float, begin: int, end: int, step: int
) -> None:
    """Run an operator without a window: until and release backwards, since and trigger forwards."""
    a, b = node[codes.NODE_A], node[codes.NODE_B]
    is_strong = node[codes.NODE_CODE] in (codes.UNTIL, codes.PAST_SINCE)
    value = start
    for k in range(begin, end, step):
        if is_strong:
            value = max(columns[b, k], min(columns[a, k], value) if a >= 0 else value)
        else:
            value = min(columns[b, k], max(columns[a, k], value) if a >= 0 else value)
        target[k] = value


@inlined
def _run_until(
    node: Integers, part: Integers, columns: Floats, target: Floats, low: int, high: int, mode: int,
    corner: int, memory: Memory, scratch: Scratch, offset: int,
) -> None:  # fmt: skip
    """Run an unbounded until or release at low … high; its variable's value goes to the point."""
    variable = node[codes.NODE_VARIABLE]
    if mode == codes.OPEN_CORNER:
        after = corner_value(corner, variable) if variable >= 0 else -np.inf
    else:
        after = beyond(mode, node[codes.NODE_WEAK])
    _run_recurrence(node, columns, target, after, high - offset, low - offset - 1, -1)
    if variable >= 0:
        boundary = memory.cells[cells_of(part)[1] + variable]
        scratch.point[variable] = target[boundary - offset] if boundary <= high else after


@inlined
def _run_since(
    node: Integers, part: Integers, tables: Floats, columns: Floats, target: Floats, high: int,
    memory: Memory, scratch: Scratch, offset: int,
) -> None:  # fmt: skip
    """Run an unbounded since or trigger from the position of its table up to `high`."""
    table, variables = node[codes.NODE_TABLE], part[codes.PART_VARIABLES]
    start = memory.cells[cells_of(part)[2] + table]
    if start < 0:
        value = np.inf if node[codes.NODE_WEAK] else -np.inf
    else:
        at = table << variables
        value = read_table(tables[at : at + (1 << variables)], variables, scratch.point, scratch.order)
    scratch.starts[table] = value
    _run_recurrence(node, columns, target, value, start + 1 - offset, high - offset + 1, 1)


@apart
def run_dependent(
    table_at: int, number: int, at: int, channel: int, mode: int, corner: int, last: int
) -> int:
    """Run the nodes of a part that depend on a variable or a table, at the positions low … high of `Scratch`.

    `scratch.point` receives the variables' values where the table's base ends, `scratch.starts` the
    values that past operators start from.

    Args:
        number: of the part.
        at: which of the columns of `Memory` they are.
        channel: of the tables.
        mode, corner: what lies beyond the last sample; the values of the variables if that is `OPEN_CORNER`.
    """
    arrays, memory, scratch, _ = arrays_at(table_at)
    nodes, part, offset = arrays.nodes, arrays.parts[number], memory.clock[OFFSET]
    first, recent = part[codes.PART_FIRST], recent_of(memory, scratch)
    columns = memory.columns[at, first : part[codes.PART_END]]
    tables = memory.tables[channel, part[codes.PART_TABLE_START] : tables_end(part)]
    for d in range(first, part[codes.PART_END]):
        node = nodes[d]
        if not node[codes.NODE_DEPENDS]:
            continue
        code, a, b, target = node[0], node[codes.NODE_A], node[codes.NODE_B], columns[d - first]
        own_low, own_high = scratch.low[d - first], scratch.high[d - first]
        begin, end = own_low - offset, own_high - offset + 1
        if code in (codes.PART_AND, codes.PART_OR):
            one, two = columns[a, begin:end], columns[b, begin:end]
            join(code == codes.PART_OR, one, two, target[begin:end])
        elif code in (codes.UNTIL, codes.RELEASE):
            _run_until(node, part, columns, target, own_low, own_high, mode, corner, memory, scratch, offset)
        elif code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
            _run_since(node, part, tables, columns, target, own_high, memory, scratch, offset)
        elif code in (codes.SHIFT, codes.PAST_DELAY):
            run_shift(node, columns[a], target, own_low, own_high + 1, mode, recent, offset, last)
        else:
            run_window(node, columns[a], target, own_low, own_high + 1, mode, recent, offset, last)
    return 0


@apart
def absorb(table_at: int, number: int, channels: int, last: int) -> int:
    """Move a part's base forward over every position whose windows have all closed."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, offset = tables.nodes, tables.parts[number], memory.clock[OFFSET]
    base = cells_of(part)[0]
    before = memory.cells[base]
    # of closed positions a column holds the same whatever is open, so that any look of a channel will do
    for channel in range(channels):
        bring_columns_up(table_at, number, channel if channel < 2 else channel + 2, channels, last)
    if part[codes.PART_IS_NESTED]:
        _absorb_nested(table_at, number, nodes, part, memory, scratch, channels, offset, last)
    else:
        _absorb_plain(table_at, number, nodes, part, memory, channels, offset, last)
    if memory.cells[base] > before:
        find_lows(table_at, number, last)
    return 0


@uncounted
def _absorb_plain(
    table_at: int, number: int, nodes: Integers, part: Integers, memory: Memory, channels: int, offset: int,
    last: int,
) -> None:  # fmt: skip
    """Absorb what has closed, many positions at a time, where no more than the root has a variable."""
    base, boundary, _ = cells_of(part)
    cells, root, size = memory.cells, nodes[part[codes.PART_END] - 1], CLOSING
    nodes_of_part = part[codes.PART_END] - part[codes.PART_FIRST]
    while size > 0:
        first, newest = cells[base], cells[base] + size - 1
        if newest > last or not reach(table_at, number, newest, newest, last):
            size //= 2
            continue
        for channel in range(channels):
            columns = memory.columns[channel, part[codes.PART_FIRST] : part[codes.PART_END]]
            tables = memory.tables[channel, part[codes.PART_TABLE_START] : tables_end(part)]
            if part[codes.PART_VARIABLES] == 0:
                if first == 0:
                    tables[0] = columns[nodes_of_part - 1, 0 - offset]
                continue
            worst = root_value(root, columns, -np.inf, first, newest, offset)
            best = root_value(root, columns, np.inf, first, newest, offset)
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
    """Absorb what has closed, position by position."""
    base, boundaries, states = cells_of(part)
    cells = memory.cells
    while cells[base] <= last:
        if not reach(table_at, number, cells[base], cells[base], last):
            return
        for channel in range(channels):
            _renew_tables(table_at, number, nodes, part, channel, memory, scratch, offset, last)
        for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
            variable, table, at = (
                nodes[d, codes.NODE_VARIABLE],
                nodes[d, codes.NODE_TABLE],
                d - part[codes.PART_FIRST],
            )
            if variable >= 0:
                cells[boundaries + variable] = scratch.high[at] + 1
            if table >= 0:
                cells[states + table] = max(cells[states + table], scratch.plain[at] - 1)
        cells[base] += 1


@uncounted
def _renew_tables(
    table_at: int, number: int, nodes: Integers, part: Integers, channel: int, memory: Memory,
    scratch: Scratch, offset: int, last: int,
) -> None:  # fmt: skip
    """Renew the tables of a part, in one channel, after adding the position at its base."""
    first, end, variables = part[codes.PART_FIRST], part[codes.PART_END], part[codes.PART_VARIABLES]
    fresh, size = scratch.fresh, 1 << variables
    base, _, states = cells_of(part)
    tables = memory.tables[channel, part[codes.PART_TABLE_START] : tables_end(part)]
    columns = memory.columns[channel, first:end]
    for corner in range(size):
        run_dependent(table_at, number, channel, channel, codes.OPEN_CORNER, corner, last)
        if memory.cells[base] == 0:
            fresh[corner] = columns[end - 1 - first, 0 - offset]
        else:
            fresh[corner] = read_table(tables[:size], variables, scratch.point, scratch.order)
        for d in range(first, end):
            table = nodes[d, codes.NODE_TABLE]
            if table >= 0:
                state = scratch.plain[d - first] - 1
                is_new = state > memory.cells[states + table]
                value = columns[d - first, state - offset] if is_new else scratch.starts[table]
                fresh[table * size + corner] = value
    for k in range(len(tables)):
        tables[k] = fresh[k]
