"""The numbers of one node of a part at its open positions, brought up to the newest sample.

Each kind of node has a kernel of its own, compiled apart: together, they would be slower, as well. Every one
computes no more than what changes: what a window holds is joined with the new number, and what looks through
windows of changed numbers stops where these make no difference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import apart, inlined
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import (
    STRIDE,
    beyond,
    either,
    extremum,
    fill,
    first_up_to,
    join_changed,
    recent_of,
    run_shift,
    run_to_last,
    run_window,
)
from spatial_replay.monitor.online.state import OFFSET, Scratch
from spatial_replay.monitor.online.tables import read_table


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
def settled_look(part: Integers, channel: int, channels: int) -> int:
    """Return for which number closed positions of a part are looked up in a channel, -1 for none.

    Their columns are the same for all numbers of a channel, whatever is open, so that any will do that the
    run computes.
    """
    for which in (0, 1, 4, 5):
        if (part[codes.PART_NUMBERS] >> which) & 1 and look_of(which, channels).channel == channel:
            return which
    return -1


@inlined
def cells_of(part: Integers) -> tuple[int, int, int]:
    """Return where a part's cells hold its base, its variables' positions and its tables' positions."""
    base = part[codes.PART_CELL_START]
    return base, base + 1, base + 1 + part[codes.PART_VARIABLES]


@inlined
def set_point(
    node: Integers, part: Integers, column: Floats, cells: Integers, mode: int, offset: int, last: int,
    point: Floats,
) -> None:  # fmt: skip
    """Enter into `point` what the variable of a node, if it has one, is where the part's table ends."""
    variable = node[codes.NODE_VARIABLE]
    if variable >= 0:
        boundary = cells[cells_of(part)[1] + variable]
        is_known = boundary <= last
        point[variable] = column[boundary - offset] if is_known else beyond(mode, node[codes.NODE_WEAK])


@inlined
def signal_of(nodes: Integers, d: int) -> int:
    """Return the signal whose numbers are those of a node, which has no column; -1 for none."""
    return nodes[d, codes.NODE_A] if nodes[d, codes.NODE_CODE] == codes.LITERAL else -1


@inlined
def tables_end(part: Integers) -> int:
    """Return where a part's own table and those of its past operators end; they begin with its own."""
    return int(part[codes.PART_TABLE_START] + (part[codes.PART_TABLES] << part[codes.PART_VARIABLES]))


@apart
def join_operands(
    table_at: int, number: int, d: int, which: int, channels: int, since: int, last: int
) -> int:
    """Bring the column of an `and` or `or` up; return the first position that changes.

    Args:
        number, d: of the part, and of the node.
        which, channels: the number that the column is for (see `look_of`).
        since: the first sample for which there are no numbers yet.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, first, offset = tables.nodes, tables.parts[number, codes.PART_FIRST], memory.clock[OFFSET]
    columns, history = memory.columns[columns_number(which)], memory.history[look_of(which, channels).channel]
    a, b = nodes[d, codes.NODE_A], nodes[d, codes.NODE_B]
    left, right = signal_of(nodes, first + a), signal_of(nodes, first + b)
    one = columns[first + a] if left < 0 else history[left]
    two = columns[first + b] if right < 0 else history[right]
    begin = max(min(scratch.changed[a], scratch.changed[b]), memory.lows[d]) - offset
    is_greatest = nodes[d, codes.NODE_CODE] == codes.PART_OR
    return int(offset) + join_changed(
        is_greatest, one, two, columns[d], begin, since - offset, last + 1 - offset
    )


@apart
def run_until(table_at: int, number: int, d: int, which: int, channels: int, since: int, last: int) -> int:
    """Bring the column of an unbounded until or release up (see `join_operands`), backwards."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, offset = tables.nodes, tables.parts[number], memory.clock[OFFSET]
    node, first, lowest, changed = nodes[d], part[codes.PART_FIRST], memory.lows[d], scratch.changed
    look, recent = look_of(which, channels), recent_of(memory, scratch)
    columns, history = memory.columns[columns_number(which)], memory.history[look.channel]
    a, b, target = node[codes.NODE_A], node[codes.NODE_B], columns[d]
    left, right = signal_of(nodes, first + max(a, 0)), signal_of(nodes, first + b)
    one = columns[first + max(a, 0)] if left < 0 else history[left]
    two = columns[first + b] if right < 0 else history[right]
    is_until, value = node[codes.NODE_CODE] == codes.UNTIL, beyond(look.mode, node[codes.NODE_WEAK])
    if a < 0:
        begin = run_to_last(
            is_until, node, two, target, value, lowest, changed[b], since, recent, offset, last
        )
    else:
        same, begin = min(changed[a], changed[b], since), last + 1
        while begin > lowest:
            k = begin - 1 - offset
            value = either(is_until, two[k], either(not is_until, one[k], value))
            if begin <= same and value == target[k]:
                break
            target[k] = value
            begin -= 1
    set_point(node, part, target, memory.cells, look.mode, offset, last, scratch.point)
    return int(begin)


@apart
def run_since(table_at: int, number: int, d: int, which: int, channels: int, since: int, last: int) -> int:
    """Bring the column of an unbounded since or trigger up (see `join_operands`), forwards."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, offset = tables.nodes, tables.parts[number], memory.clock[OFFSET]
    node, first, changed = nodes[d], part[codes.PART_FIRST], scratch.changed
    channel, columns = look_of(which, channels).channel, memory.columns[columns_number(which)]
    a, b, target, history = node[codes.NODE_A], node[codes.NODE_B], columns[d], memory.history[channel]
    left, right = signal_of(nodes, first + max(a, 0)), signal_of(nodes, first + b)
    one = columns[first + max(a, 0)] if left < 0 else history[left]
    two = columns[first + b] if right < 0 else history[right]
    start = memory.cells[cells_of(part)[2] + node[codes.NODE_TABLE]]
    numbers = memory.tables[channel, part[codes.PART_TABLE_START] : tables_end(part)]
    value = start_of_past(node, part, numbers, start, scratch)
    begin = min(changed[b], since)
    if a >= 0:
        begin = min(begin, changed[a])
    # what its table says follows what is to come, if that matters to its operands
    if start >= 0 and (start >= since or target[start - offset] != value):
        target[start - offset] = value
        begin = start
    begin = max(begin, start + 1)
    if begin > start + 1:
        value = target[begin - 1 - offset]
    is_since, is_same, changes = node[codes.NODE_CODE] == codes.PAST_SINCE, True, begin
    position, stride = begin, STRIDE
    while position <= last:
        k = position - offset
        if a < 0 and not is_same and position + stride <= last:
            if extremum(is_since, two[k : k + stride], value) == value:
                fill(target[k : k + stride], value)
                position, stride = position + stride, 2 * stride
                continue
            stride = STRIDE
        value = either(is_since, two[k], either(not is_since, one[k], value) if a >= 0 else value)
        is_same = is_same and position < since and target[k] == value
        changes += is_same
        target[k] = value
        position += 1
    return int(changes)


@apart
def run_behind(table_at: int, number: int, d: int, which: int, channels: int, since: int, last: int) -> int:
    """Bring the column of a shift, a delay or a window behind up (see `join_operands`)."""
    tables, memory, scratch, _ = arrays_at(table_at)
    node, first, offset = tables.nodes[d], tables.parts[number, codes.PART_FIRST], memory.clock[OFFSET]
    look, recent, code = look_of(which, channels), recent_of(memory, scratch), node[codes.NODE_CODE]
    columns, signal = (
        memory.columns[columns_number(which)],
        signal_of(tables.nodes, first + node[codes.NODE_A]),
    )
    source = columns[first + node[codes.NODE_A]] if signal < 0 else memory.history[look.channel, signal]
    begin = scratch.changed[node[codes.NODE_A]]
    if code == codes.SHIFT:  # positions that look between two samples look at the second one
        begin = first_up_to(node, codes.NODE_LOW, recent, offset, last, max(begin - 1, offset))
    begin = max(begin, memory.lows[d])
    if code in (codes.SHIFT, codes.PAST_DELAY):
        run_shift(node, source, columns[d], begin, last + 1, look.mode, recent, offset, last)
    else:
        run_window(node, source, columns[d], begin, last + 1, look.mode, recent, offset, last)
    return int(begin)


@inlined
def start_of_past(node: Integers, part: Integers, tables: Floats, start: int, scratch: Scratch) -> float:
    """Return the value that a since or trigger starts from, by its table, which ends at `start`."""
    if start < 0:
        return np.inf if node[codes.NODE_WEAK] else -np.inf
    variables = part[codes.PART_VARIABLES]
    at = node[codes.NODE_TABLE] << variables
    return read_table(tables[at : at + (1 << variables)], variables, scratch.point, scratch.order)
