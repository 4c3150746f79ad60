"""The rows of nodes for a block of samples, at positions whose spans have no tables (see `blocks.spans`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from spatial_replay.compiled import apart, inlined, row_code, uncounted
from spatial_replay.compiler import Lanes
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.blocks.block_ends import find_closing, find_ends
from spatial_replay.monitor.online.blocks.node_rows import (
    NodeRows,
    SampleBlock,
    fill_open,
    join_after,
    join_before,
    join_closed,
    join_operands_rows,
    join_positions,
    recurrent_rows,
    shift_rows,
    take_row,
    window_rows,
)
from spatial_replay.monitor.online.blocks.row_loops import fill_row, join_rows
from spatial_replay.monitor.online.blocks.spans import (
    BEGIN,
    END,
    IN_COLUMN,
    IN_ROWS,
    IN_TABLE,
    KIND,
    LEFT,
    RIGHT,
    ROW,
    ROWS_FROM,
    THROUGH,
    corners_of,
    span_at,
)
from spatial_replay.monitor.online.closing import is_outdone
from spatial_replay.monitor.online.node_columns import cells_of, columns_number, look_of, signal_of
from spatial_replay.monitor.online.open_windows import reach, runs_root
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import (
    Recent,
    beyond,
    extremum,
    is_decided,
    recent_of,
)
from spatial_replay.monitor.online.state import (
    BLOCK_LAST,
    BLOCK_LOWEST,
    BLOCK_NEWEST,
    BLOCK_SINCE,
    OFFSET,
    Memory,
    Scratch,
    is_closed,
)


@inlined
def block_of(memory: Memory, scratch: Scratch) -> SampleBlock:
    """Return the block of samples that is run."""
    return SampleBlock(
        scratch.running,
        scratch.ends[0],
        scratch.ends[1],
        scratch.extrema[0],
        scratch.block[BLOCK_SINCE],
        scratch.block[BLOCK_LAST],
        scratch.block[BLOCK_LOWEST],
        memory.clock[OFFSET],
    )


@row_code
def _one_bit(lanes: Lanes, low: Any, high: Any, row: Any) -> Any:
    return lanes.greater(low, lanes.lesser(high, row))


@row_code
def _two_bits(lanes: Lanes, none: Any, first: Any, second: Any, both: Any, row: Any, other: Any) -> Any:
    one = lanes.greater(none, lanes.lesser(first, row))
    return lanes.greater(one, lanes.lesser(other, lanes.greater(second, lanes.lesser(both, row))))


@inlined
def _read_four(numbers: Floats, rows: Floats, span: Integers, target: Floats) -> None:
    row, other = rows[span[ROWS_FROM]], rows[span[ROWS_FROM + 1]]
    _two_bits(numbers[0], numbers[1], numbers[2], numbers[3], row, other, target)


@uncounted
def read_rows(span: Integers, numbers: Floats, rows: Floats, spare: Floats, target: Floats) -> None:
    """Read the numbers at the corners for the rows that a span follows.

    With each row, they grow from those at the corners where it is as small as can be, to those where it is as
    great, but no further than it does.
    """
    corners = corners_of(span)
    if corners == 1:
        fill_row(numbers[0], target)
    elif corners == 2:
        _one_bit(numbers[0], numbers[1], rows[span[ROWS_FROM]], target)
    else:
        _read_four(numbers, rows, span, target)
    if corners >= 8:
        _read_four(numbers[4:], rows, span, spare[0])
        _one_bit(target, spare[0], rows[span[ROWS_FROM + 2]], target)
    if corners == 16:
        _read_four(numbers[8:], rows, span, spare[0])
        _read_four(numbers[12:], rows, span, spare[1])
        _one_bit(spare[0], spare[1], rows[span[ROWS_FROM + 2]], spare[0])
        _one_bit(target, spare[0], rows[span[ROWS_FROM + 3]], target)


@uncounted
def _read_position(
    span: Integers, columns: Floats, at: int, rows: Floats, spare: Floats, numbers: Floats, target: Floats
) -> None:
    """Read the table of one position."""
    for corner in range(corners_of(span)):
        numbers[corner] = columns[corner, at]
    read_rows(span, numbers, rows, spare, target)


@uncounted
def _fill_wholes(
    block: SampleBlock, is_greatest: bool, operand: NodeRows, spans: Integers, count: int, sums: Floats,
    joints: Floats, spare: Floats, wholes: Floats,
) -> None:  # fmt: skip
    """Join each of an operand's spans into one row."""
    for k in range(1, count):
        span, begin = spans[k], spans[k, BEGIN]
        end = min(span[END], block.last + 1)
        if span[KIND] != IN_ROWS:
            read_rows(span, sums[k], joints, spare, wholes[k])
            continue
        fill_row(-np.inf if is_greatest else np.inf, block.running)
        join_positions(block, is_greatest, operand, begin, end)
        fill_row(block.running, wholes[k])


@uncounted
def _fill_joint(is_greatest: bool, wholes: Floats, begin: int, end: int, target: Floats) -> None:
    """Join the rows of neighbouring spans."""
    fill_row(wholes[begin], target)
    for k in range(begin + 1, end):
        join_rows(is_greatest, target, wholes[k], target)


@uncounted
def _window_span_rows(
    node: Integers, block: SampleBlock, recent: Recent, span: Integers, operand: NodeRows,
    operands: Integers, columns: Floats, joints: Floats, spare: Floats, numbers: Floats, target: Floats,
) -> None:  # fmt: skip
    """Compute a window's rows in one span."""
    is_greatest = node[codes.NODE_CODE] in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX)
    begin, end, left, right = span[BEGIN], min(span[END], block.last + 1), span[LEFT], span[RIGHT]
    begins_in_rows = operands[left, KIND] == IN_ROWS
    ends_in_rows = right != THROUGH and right != left and operands[right, KIND] == IN_ROWS
    if begins_in_rows or ends_in_rows:
        find_ends(node, recent, begin, end, block.offset, block.last, block.starts, block.afters)
    if left == right and begins_in_rows:
        window_rows(block, is_greatest, operand, target, begin, end)
        return
    # what stands in the table is the same for all samples, if no row is followed
    is_number = corners_of(span) == 1
    first, count = begin - block.lowest, end - begin
    if span[ROW] >= 0:
        fill_row(joints[span[ROW]], block.running)
    else:
        fill_row(-np.inf if is_greatest else np.inf, block.running)
    if begins_in_rows:
        at = min(operands[left, END], block.last + 1)
        join_before(block, is_greatest, operand, at, block.starts[:count], target, begin)
        fill_row(-np.inf if is_greatest else np.inf, block.running)
    if begins_in_rows and not ends_in_rows and right != THROUGH:
        for k in range(count):
            _read_position(span, columns, first + k, joints, spare, numbers, block.running)
            join_rows(is_greatest, target[first + k], block.running, target[first + k])
    elif not begins_in_rows and is_number and ends_in_rows:
        at = operands[right, BEGIN]
        numbers_before, afters = columns[0, first:], block.afters[:count]
        join_after(block, is_greatest, operand, at, afters, numbers_before, target[first : first + count])
        return
    elif not begins_in_rows:
        for k in range(count):
            if is_number:
                join_rows(is_greatest, block.running, columns[0, first + k], target[first + k])
                continue
            _read_position(span, columns, first + k, joints, spare, numbers, target[first + k])
            join_rows(is_greatest, target[first + k], block.running, target[first + k])
        fill_row(-np.inf if is_greatest else np.inf, block.running)
    if ends_in_rows:
        at = operands[right, BEGIN]
        rows = target[first : first + count]
        join_after(block, is_greatest, operand, at, block.afters[:count], rows, rows)


@uncounted
def _operand_rows(
    spans: Integers, span: int, column: Floats, columns: Floats, rows: Floats, begin: int, end: int,
    joints: Floats, spare: Floats, numbers: Floats, lowest: int, has_rows: bool, last: int,
) -> NodeRows:  # fmt: skip
    """Return what an operand is at begin … end - 1: rows, or numbers that are the same for all samples."""
    if spans[span, KIND] == IN_COLUMN or not has_rows:
        return NodeRows(column, rows, last + 1)
    if spans[span, KIND] == IN_TABLE:
        for position in range(begin, end):
            at = position - lowest
            _read_position(spans[span], columns, at, joints, spare, numbers, rows[at])
    return NodeRows(column, rows, begin)


@apart
def run_spans(table_at: int, number: int, which: int, channels: int, is_end: int) -> int:
    """Compute the rows of all nodes for a block of samples (see `find_spans`).

    Args:
        is_end: 1 if it is the last one of those that spans were found for: then what is closed after it is
            entered into the columns.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, block = tables.nodes, tables.parts[number], block_of(memory, scratch)
    columns = memory.columns[columns_number(which)]
    first, root = part[codes.PART_FIRST], part[codes.PART_END] - 1
    has_root = runs_root(part, nodes[root])
    for d in range(first, part[codes.PART_END]):
        code, place = nodes[d, codes.NODE_CODE], d - first
        if code == codes.LITERAL:
            continue
        if code in codes.BINARY_NODES and (has_root or d < root):
            _run_joined(table_at, number, d, which, channels)
        else:
            _run_window(table_at, number, d, which, channels)
        if is_end and d < root:
            target = scratch.rows[max(nodes[d, codes.NODE_ROWS], 0)]
            _fill_column(
                scratch.spans[place], scratch.span_counts[place], scratch, place, target, columns[d], block
            )
    return 0


@apart
def _run_joined(table_at: int, number: int, d: int, which: int, channels: int) -> int:
    """Compute the rows of a node with two operands; of one without a window, what its spans follow, too."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, look = tables.nodes, tables.parts[number], look_of(which, channels)
    columns, history = memory.columns[columns_number(which)], memory.history[look.channel]
    block, first = block_of(memory, scratch), part[codes.PART_FIRST]
    joints, spare, numbers = scratch.joints, scratch.spare, scratch.corner
    node, place, running = nodes[d], d - first, block.running
    code, has_left = node[codes.NODE_CODE], node[codes.NODE_A] >= 0
    a, b = max(node[codes.NODE_A], 0), node[codes.NODE_B]
    signal, other = signal_of(nodes, first + a), signal_of(nodes, first + b)
    of_one = columns[first + a] if signal < 0 else history[signal]
    of_two = columns[first + b] if other < 0 else history[other]
    one_rows = scratch.rows[max(nodes[first + a, codes.NODE_ROWS], 0)]
    two_rows = scratch.rows[max(nodes[first + b, codes.NODE_ROWS], 0)]
    target, tables_of = scratch.rows[max(node[codes.NODE_ROWS], 0)], scratch.corner_columns[place]
    spans, count = scratch.spans[place], scratch.span_counts[place]
    is_ahead = code in (codes.UNTIL, codes.RELEASE)
    is_strong = code in (codes.PART_OR, codes.UNTIL, codes.PAST_SINCE)
    is_joined = code in (codes.PART_AND, codes.PART_OR)
    if is_ahead:
        fill_row(beyond(look.mode, node[codes.NODE_WEAK]), running)
    elif not is_joined and spans[0, END] > block.offset:
        fill_row(columns[d, spans[0, END] - 1 - block.offset], running)
    elif not is_joined:
        fill_row(np.inf if node[codes.NODE_WEAK] else -np.inf, running)
    for m in range(1, count):
        k = count - m if is_ahead else m
        span, begin, end = spans[k], spans[k, BEGIN], min(spans[k, END], block.last + 1)
        if begin >= end:
            continue
        if span[KIND] == IN_TABLE:
            if not is_joined:
                fill_row(running, joints[span[ROW]])
                at = (begin if is_ahead else end - 1) - block.lowest
                _read_position(span, tables_of, at, joints, spare, numbers, running)
            continue
        two = _operand_rows(
            scratch.spans[b], span[RIGHT], of_two, scratch.corner_columns[b], two_rows, begin, end,
            joints, spare, numbers, block.lowest, other < 0, block.last,
        )  # fmt: skip
        one = two
        if has_left:
            one = _operand_rows(
                scratch.spans[a], span[LEFT], of_one, scratch.corner_columns[a], one_rows, begin, end,
                joints, spare, numbers, block.lowest, signal < 0, block.last,
            )  # fmt: skip
        if is_joined:
            join_operands_rows(is_strong, block, one, two, target, begin, end)
        else:
            recurrent_rows(block, is_strong, has_left, one, two, target, begin, end, is_ahead)
    variable = node[codes.NODE_VARIABLE]
    if variable >= 0:
        at, point = memory.cells[cells_of(part)[1] + variable], scratch.points[variable]
        k = span_at(spans, count, at)
        if block.offset <= at <= block.last and spans[k, KIND] == IN_TABLE:
            _read_position(spans[k], tables_of, at - block.lowest, joints, spare, numbers, point)
        else:
            own = NodeRows(columns[d], target, spans[0, END])
            take_row(block, own, at, beyond(look.mode, node[codes.NODE_WEAK]), point)
    return 0


@apart
def _run_window(table_at: int, number: int, d: int, which: int, channels: int) -> int:
    """Compute the rows of a window or shift, and what its spans, or the root, follow."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, look = tables.nodes, tables.parts[number], look_of(which, channels)
    columns, history = memory.columns[columns_number(which)], memory.history[look.channel]
    root = part[codes.PART_END] - 1
    is_root = d == root and not runs_root(part, nodes[root])
    recent, block, first = recent_of(memory, scratch), block_of(memory, scratch), part[codes.PART_FIRST]
    newest, joints, spare = scratch.block[BLOCK_NEWEST], scratch.joints, scratch.spare
    node, place, value = nodes[d], d - first, beyond(look.mode, nodes[d, codes.NODE_WEAK])
    code, a = node[codes.NODE_CODE], node[codes.NODE_B] if is_root else node[codes.NODE_A]
    signal, spans = signal_of(nodes, first + a), scratch.spans[place]
    is_greatest = code in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX, codes.UNTIL)
    column = columns[first + a] if signal < 0 else history[signal]
    rows = scratch.rows[max(nodes[first + a, codes.NODE_ROWS], 0)]
    target = scratch.rows[max(node[codes.NODE_ROWS], 0)]
    operand = NodeRows(column, rows, scratch.begins[a] if signal < 0 else block.last + 1)
    operands, count, wholes = scratch.spans[a], scratch.span_counts[a], scratch.wholes[place]
    if code != codes.SHIFT:
        _fill_wholes(block, is_greatest, operand, operands, count, scratch.sums[place], joints, spare, wholes)
    if is_root:
        return 0
    for k in range(1, scratch.span_counts[place] if code != codes.SHIFT else 1):
        left, right = spans[k, LEFT], min(spans[k, RIGHT], count)
        if spans[k, ROW] >= 0:
            _fill_joint(is_greatest, wholes, left + 1, right, joints[spans[k, ROW]])
    decided = is_decided(node, look.mode) and code in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN)
    for k in range(1, scratch.span_counts[place]):
        span, begin, end = spans[k], spans[k, BEGIN], min(spans[k, END], block.last + 1)
        if span[KIND] != IN_ROWS or begin >= end:
            continue
        if code == codes.SHIFT:
            find_ends(node, recent, begin, end, block.offset, block.last, block.starts, block.afters)
            shift_rows(block, True, operand, target, begin, end, value)
            continue
        _window_span_rows(
            node, block, recent, span, operand, operands, scratch.corner_columns[place],
            joints, spare, scratch.corner, target,
        )  # fmt: skip
        if decided:
            find_closing(node, block, recent, begin, end, newest, True, scratch.closing)
            fill_open(block, scratch.closing, target, begin, end, value)
    return 0


@uncounted
def outdone_in_spans(table_at: int, number: int, which: int) -> int:
    """Return what comes after the positions where what the root joins is outdone after a block.

    Where its value does not say so, the worst that may come does, which is a corner of a table: as rows are
    no better than that, nor is what windows hold that are open after all samples of the spans.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, block = tables.nodes, tables.parts[number], block_of(memory, scratch)
    root, position = nodes[part[codes.PART_END] - 1], memory.cells[part[codes.PART_CELL_START]]
    place, sample, row = root[codes.NODE_B], block.last - block.since, block.running
    d, is_said = part[codes.PART_FIRST] + place, part[codes.PART_OUTDONE_BY] == codes.BY_VALUE
    signal, spans = signal_of(nodes, d), scratch.spans[place]
    rows, columns = scratch.rows[max(nodes[d, codes.NODE_ROWS], 0)], scratch.corner_columns[place]
    column = memory.columns[which, d] if signal < 0 else memory.history[which, signal]
    # where windows close with one of the samples, no table says it; that is absorbed as it is
    first = scratch.next_begins[place] if signal < 0 and not is_said else position
    if first > position and reach(table_at, number, first - 1, first - 1, block.last):
        position = first
    k = span_at(spans, scratch.span_counts[place], position)
    while position <= block.last:
        while position >= spans[k, END]:
            k += 1
        at, kind = position - block.lowest, spans[k, KIND] if signal < 0 else IN_COLUMN
        if kind == IN_COLUMN:
            value = column[position - block.offset]
        elif not is_said:
            worst = corners_of(spans[k]) - 1 if root[codes.NODE_CODE] == codes.UNTIL else 0
            value = columns[worst, at]
        elif kind == IN_TABLE:
            _read_position(spans[k], columns, at, scratch.joints, scratch.spare, scratch.corner, row)
            value = row[sample]
        else:
            value = rows[at, sample]
        if (kind == IN_ROWS and not is_said) or not is_outdone(part, root, memory, which, value):
            break
        position += 1
    return int(position)


@uncounted
def _fill_column(
    spans: Integers, count: int, scratch: Scratch, place: int, target: Floats, column: Floats,
    block: SampleBlock,
) -> None:  # fmt: skip
    """Enter what a node is after the last sample at positions that the next ones do not change."""
    stop, sample = scratch.next_begins[place], block.last - block.since
    for k in range(1, count):
        for position in range(spans[k, BEGIN], min(spans[k, END], stop)):
            at = position - block.lowest
            if spans[k, KIND] == IN_ROWS:
                column[position - block.offset] = target[at, sample]
            else:
                columns, row = scratch.corner_columns[place], block.running
                _read_position(spans[k], columns, at, scratch.joints, scratch.spare, scratch.corner, row)
                column[position - block.offset] = row[sample]


@uncounted
def _is_closed_before(nodes: Integers, part: Integers, recent: Recent, block: SampleBlock, at: int) -> bool:
    """Return whether no window that cuts a bound short is open at a position when the block begins."""
    closed = True
    for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
        if nodes[d, codes.NODE_CUTS]:
            unit, far = nodes[d, codes.NODE_UNIT], nodes[d, codes.NODE_HIGH]
            closed = closed and is_closed(recent.stamps, block.offset, block.since - 1, at, unit, far)
    return closed


@uncounted
def join_body_spans(
    nodes: Integers, part: Integers, block: SampleBlock, body: NodeRows, base: int, after: int,
    start: float, is_cut: bool, recent: Recent, newest: int, spans: Integers, count: int, wholes: Floats,
    closing: Integers,
) -> None:  # fmt: skip
    """Fill the running row with what the root of a part joins, and a number (see `_join_body`).

    Args:
        base, after: the first position that the root joins, and what comes after the last one: spans begin
            and end there (see `find_spans`), or there are numbers.
    """
    root = part[codes.PART_END] - 1
    is_until = nodes[root, codes.NODE_CODE] == codes.UNTIL
    settled = max(min(spans[0, END], after), base)
    fill_row(
        extremum(is_until, body.column[base - block.offset : settled - block.offset], start), block.running
    )
    for k in range(1, count):
        begin, end = spans[k, BEGIN], min(spans[k, END], block.last + 1)
        if end <= base:
            continue
        if begin >= min(end, after):
            break
        if not is_cut or _is_closed_before(nodes, part, recent, block, spans[k, END] - 1):
            join_rows(is_until, block.running, wholes[k], block.running)
            continue
        if spans[k, KIND] == IN_TABLE:
            break
        is_first = True
        for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
            if nodes[d, codes.NODE_CUTS]:
                find_closing(nodes[d], block, recent, begin, end, newest, is_first, closing)
                is_first = False
        if not join_closed(block, is_until, body, begin, end, closing):
            return
