"""Nodes of a part at its open positions, for a block of samples side by side.

What a node is at a position may differ with the sample that is the last one, so of a block of samples it is a
row of numbers, one for each. What joins two rows is a few vector instructions: a block costs little more than
each of its samples would by itself.

Before a node's first open position, nothing changes with the block, and its numbers are those of its column
(see `node_columns`), the same for every sample. A row's samples before its own position have no number: what
stands there is never looked at, or left out by what looks ahead.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online.blocks.column_scans import extrema_from
from spatial_replay.monitor.online.blocks.row_loops import (
    extend,
    extend_from,
    fill_row,
    fill_row_until,
    join_all,
    join_all_from,
    join_each,
    join_rows,
    join_rows_from,
    repeat,
    repeat_joined,
    run_back,
    run_back_from,
    run_on,
    run_unbounded,
)
from spatial_replay.monitor.online.sliding import extremum


class SampleBlock(NamedTuple):
    """Some neighbouring samples, and room to work in.

    Attributes:
        running: (BLOCK,), the row that others are joined with, one by one.
        starts, afters: (room,), where windows start, and what comes after them (see `find_ends`).
        before: (2 * room,), what windows hold before some position, and room to find that in.
        since, last: the first and the last sample.
        lowest: the position of the first row.
        offset: that of the first number of a column.
    """

    running: Floats
    starts: Integers
    afters: Integers
    before: Floats
    since: int
    last: int
    lowest: int
    offset: int


class NodeRows(NamedTuple):
    """The numbers of a node.

    Attributes:
        column: those of the positions before `begin`, from the block's offset on; of a signal, of all.
        rows: (ROWS, BLOCK), those of the positions from `begin` on.
        begin: the first position that has a row; for a signal, what comes after the last one.
    """

    column: Floats
    rows: Floats
    begin: int


@inlined
def enter(is_greatest: bool, block: SampleBlock, operand: NodeRows, position: int, begin: int) -> None:
    """Join the running row with the numbers at a position, for the samples from `begin` on."""
    running = block.running
    if position < operand.begin:
        number = operand.column[position - block.offset]
        if begin <= 0:
            join_rows(is_greatest, running, number, running)
        else:
            join_rows_from(is_greatest, running, begin, number, running)
    else:
        row = operand.rows[position - block.lowest]
        if begin <= 0:
            join_rows(is_greatest, running, row, running)
        else:
            join_rows_from(is_greatest, running, begin, row, running)


@uncounted
def join_positions(block: SampleBlock, is_greatest: bool, operand: NodeRows, begin: int, end: int) -> None:
    """Join the running row with the numbers at begin … end - 1, for the samples that have come by then."""
    running, whole = block.running, max(min(end, block.since + 1), begin)
    rows_from = max(min(operand.begin, whole), begin)
    numbers = operand.column[begin - block.offset : rows_from - block.offset]
    rows = operand.rows[rows_from - block.lowest : whole - block.lowest]
    if rows_from > begin:
        # as single numbers, of which there may be many
        nothing = -np.inf if is_greatest else np.inf
        join_rows(is_greatest, running, extremum(is_greatest, numbers, nothing), running)
    join_all(is_greatest, running, rows)
    if end > whole:
        rows_from = max(min(operand.begin, end), whole)
        numbers = operand.column[whole - block.offset : rows_from - block.offset]
        join_all_from(is_greatest, running, whole - block.since, numbers)
        rows = operand.rows[rows_from - block.lowest : end - block.lowest]
        join_all_from(is_greatest, running, rows_from - block.since, rows)


@uncounted
def join_closed(
    block: SampleBlock, is_greatest: bool, operand: NodeRows, begin: int, end: int, closing: Integers
) -> bool:
    """Join the running row with the numbers at begin … end - 1, for the samples that these count for.

    Args:
        closing: from which sample on each does, counted from the block's first, if that is not before its
            own; none of them from an earlier one than the one before.

    Returns:
        Whether all of them count for some sample.
    """
    position, count = begin, block.last + 1 - block.since
    while position < end:
        at = max(closing[position - begin], position - block.since)
        if at >= count:
            return False
        # as far as each counts from one sample later on, and both are numbers, or rows
        until, stop = position + 1, min(end, operand.begin) if position < operand.begin else end
        while until < stop and max(closing[until - begin], until - block.since) == at + until - position:
            until += 1
        if position < operand.begin:
            numbers = operand.column[position - block.offset : until - block.offset]
            join_all_from(is_greatest, block.running, at, numbers)
        else:
            rows = operand.rows[position - block.lowest : until - block.lowest]
            join_all_from(is_greatest, block.running, at, rows)
        position = until
    return True


@uncounted
def join_operands_rows(
    is_greatest: bool, block: SampleBlock, one: NodeRows, two: NodeRows, target: Floats, begin: int, end: int
) -> None:
    """Compute an `and` or `or` at begin … end - 1; `target` may be the rows of an operand."""
    while begin < end:
        # as far as both are numbers, or rows
        until = end
        for change in (one.begin, two.begin):
            until = change if begin < change < until else until
        at, after, offset = begin - block.lowest, until - block.lowest, block.offset
        rows, running = target[at:after], block.running
        first, second = (
            one.column[begin - offset : until - offset],
            two.column[begin - offset : until - offset],
        )
        if begin < one.begin and begin < two.begin:
            join_each(is_greatest, running, first, second, rows)
        elif begin < one.begin:
            join_each(is_greatest, running, two.rows[at:after], first, rows)
        elif begin < two.begin:
            join_each(is_greatest, running, one.rows[at:after], second, rows)
        else:
            join_each(is_greatest, running, one.rows[at:after], two.rows[at:after], rows)
        begin = until


@uncounted
def window_rows(
    block: SampleBlock, is_greatest: bool, operand: NodeRows, target: Floats, begin: int, beyond: int
) -> None:
    """Compute extrema over the windows of begin … beyond - 1, whose ends are found.

    Those that hold one position, or end there, share what they hold: of what comes before it, each holds what
    the next one does and more; of the rest, what the one before does and more. For windows ahead that begin
    with their position, `target` may be the rows of the operand.
    """
    starts, afters, end = block.starts, block.afters, block.last + 1
    nothing, settled, position = (
        -np.inf if is_greatest else np.inf,
        min(operand.begin, block.since + 1),
        begin,
    )
    while position < beyond:
        start, after = starts[position - begin], afters[position - begin]
        # what is the same for all samples is joined as numbers; windows that end with the block stay together
        middle, until = settled if start < settled < after else max(start, after), position + 1
        parts = middle > settled and after < end
        while (
            until < beyond and starts[until - begin] < middle and not (parts and afters[until - begin] == end)
        ):
            until += 1
        first, count = position - begin, until - position
        rows = target[position - block.lowest : until - block.lowest]
        if middle <= settled:
            _enter_before(block, is_greatest, operand.column, starts[first : first + count], middle)
            fill_row(nothing, block.running)
            ends, numbers = afters[first : first + count], block.before
            join_after(block, is_greatest, operand, middle, ends, numbers, rows)
        else:
            fill_row(nothing, block.running)
            begins = starts[first : first + count]
            join_before(block, is_greatest, operand, middle, begins, target, position)
            if middle < afters[until - 1 - begin]:
                fill_row(nothing, block.running)
                ends = afters[first : first + count]
                join_after(block, is_greatest, operand, middle, ends, rows, rows)
        position = until


@uncounted
def _enter_before(
    block: SampleBlock, is_greatest: bool, column: Floats, starts: Integers, middle: int
) -> None:
    """Enter the extrema of numbers from where windows start to before a position into the first of `before`.

    The running row is room to work in.
    """
    count, first = len(starts), starts[0]
    at = max(min(starts[count - 1], middle), block.offset)
    value = -np.inf if is_greatest else np.inf
    value = extremum(is_greatest, column[at - block.offset : middle - block.offset], value)
    size = max(at - first, 0)
    from_each = block.before[count : count + size + 1]
    numbers = column[first - block.offset : at - block.offset]
    extrema_from(is_greatest, numbers, value, block.running, from_each[:size])
    from_each[size] = value
    for k in range(count):
        block.before[k] = from_each[min(starts[k] - first, size)]


@uncounted
def _join_back(
    block: SampleBlock, is_greatest: bool, operand: NodeRows, begin: int, end: int, target: Floats
) -> None:
    """Join the running row with end - 1 … begin, one after the other, and store it after each."""
    running, since, offset, lowest = block.running, block.since, block.offset, block.lowest
    rows_from, cut = max(min(operand.begin, end), begin), max(min(since + 1, end), begin)
    at = max(rows_from, cut)
    rows, part = operand.rows[at - lowest : end - lowest], target[at - begin : end - begin]
    run_back_from(is_greatest, running, at - since, rows, part)
    if rows_from < cut:
        rows, part = operand.rows[rows_from - lowest : cut - lowest], target[rows_from - begin : cut - begin]
        run_back(is_greatest, running, rows, part)
    elif cut < rows_from:
        numbers, part = operand.column[cut - offset : at - offset], target[cut - begin : at - begin]
        run_back_from(is_greatest, running, cut - since, numbers, part)
    at = min(rows_from, cut)
    run_back(is_greatest, running, operand.column[begin - offset : at - offset], target[: at - begin])


@uncounted
def join_before(
    block: SampleBlock,
    is_greatest: bool,
    operand: NodeRows,
    at: int,
    starts: Integers,
    target: Floats,
    begin: int,
) -> None:
    """Enter the extrema from where windows start to before `at`, at positions from `begin` on."""
    k = len(starts) - 1
    while k >= 0:
        first, start = k, starts[k]
        rows_end = begin + k + 1 - block.lowest
        if start >= at:
            while first > 0 and starts[first - 1] >= at:
                first -= 1
            repeat(block.running, target[begin + first - block.lowest : rows_end])
        else:
            if start + 1 < at:
                join_positions(block, is_greatest, operand, start + 1, at)
            while first > 0 and starts[first - 1] == starts[first] - 1:
                first -= 1
            at = starts[first]
            rows = target[begin + first - block.lowest : rows_end]
            _join_back(block, is_greatest, operand, at, start + 1, rows)
        k = first - 1


@uncounted
def _join_on(
    block: SampleBlock,
    is_greatest: bool,
    operand: NodeRows,
    begin: int,
    end: int,
    before: Any,
    target: Floats,
) -> None:
    """Join the running row with begin … end - 1, one after the other; store it, joined, after each.

    Args:
        before: (end - begin,) or (end - begin, BLOCK), what it is joined with.
    """
    running, since, offset, lowest = block.running, block.since, block.offset, block.lowest
    rows_from, cut = max(min(operand.begin, end), begin), max(min(since + 1, end), begin)
    at = min(rows_from, cut)
    numbers, part = operand.column[begin - offset : at - offset], target[: at - begin]
    extend(is_greatest, running, numbers, before[: at - begin], part)
    if cut < rows_from:
        numbers, part = (
            operand.column[cut - offset : rows_from - offset],
            target[cut - begin : rows_from - begin],
        )
        extend_from(is_greatest, running, cut - since, numbers, before[cut - begin : rows_from - begin], part)
    elif rows_from < cut:
        rows, part = operand.rows[rows_from - lowest : cut - lowest], target[rows_from - begin : cut - begin]
        extend(is_greatest, running, rows, before[rows_from - begin : cut - begin], part)
    at = max(rows_from, cut)
    rows, part = operand.rows[at - lowest : end - lowest], target[at - begin : end - begin]
    extend_from(is_greatest, running, at - since, rows, before[at - begin :], part)


@uncounted
def join_after(
    block: SampleBlock, is_greatest: bool, operand: NodeRows, at: int, afters: Integers, before: Any,
    target: Floats,
) -> None:  # fmt: skip
    """Join the extrema from `at` to where windows end with what comes before.

    Args:
        before: an array of what comes before, of rows or of numbers.
        target: receives the rows; `before` may be these.
    """
    k, count = 0, len(afters)
    while k < count:
        until, after = k + 1, afters[k]
        if after <= at:
            while until < count and afters[until] <= at:
                until += 1
            repeat_joined(is_greatest, block.running, before[k:until], target[k:until])
        else:
            if at < after - 1:
                join_positions(block, is_greatest, operand, at, after - 1)
            while until < count and afters[until] == afters[until - 1] + 1:
                until += 1
            at = afters[until - 1]
            _join_on(block, is_greatest, operand, after - 1, at, before[k:until], target[k:until])
        k = until


@inlined
def _step(
    block: SampleBlock, is_strong: bool, has_left: bool, one: NodeRows, two: NodeRows, target: Floats,
    position: int,
) -> None:  # fmt: skip
    """Compute an unbounded operator at one position from the running row."""
    if has_left:
        enter(not is_strong, block, one, position, position - block.since)
    enter(is_strong, block, two, position, position - block.since)
    fill_row(block.running, target[position - block.lowest])


@uncounted
def recurrent_rows(
    block: SampleBlock, is_strong: bool, has_left: bool, one: NodeRows, two: NodeRows, target: Floats,
    begin: int, end: int, is_ahead: bool,
) -> None:  # fmt: skip
    """Compute an unbounded until or release backwards from end - 1 to `begin`, a since or trigger forwards.

    Args:
        is_strong: whether it is an until or a since.
        target: receives the rows; may be those of an operand.
        is_ahead: whether it is an until or a release.

    The running row is what the operator is at `end`, or before `begin`, and then what it is at the last
    position that is computed.
    """
    since, lowest, offset = block.since, block.lowest, block.offset
    whole = min(max(since + 1, begin), end)
    if is_ahead:
        for position in range(end - 1, whole - 1, -1):
            _step(block, is_strong, has_left, one, two, target, position)
    running, stop = block.running, whole
    if begin < whole and not has_left:
        rows_from = max(min(two.begin, stop), begin)
        rows, part = two.rows[rows_from - lowest : stop - lowest], target[rows_from - lowest : stop - lowest]
        numbers = two.column[begin - offset : rows_from - offset]
        of_numbers = target[begin - lowest : rows_from - lowest]
        if is_ahead:
            run_back(is_strong, running, rows, part)
            run_back(is_strong, running, numbers, of_numbers)
        else:
            run_on(is_strong, running, numbers, of_numbers)
            run_on(is_strong, running, rows, part)
    elif begin < whole:
        first, second = max(min(one.begin, stop), begin), max(min(two.begin, stop), begin)
        for k in range(3):
            # as far as each operand is numbers, or rows
            m = 2 - k if is_ahead else k
            low = begin if m == 0 else (min(first, second) if m == 1 else max(first, second))
            high = stop if m == 2 else (max(first, second) if m == 1 else min(first, second))
            at, after = low - lowest, high - lowest
            left, right = one.rows[at:after], two.rows[at:after]
            of_left, of_right = (
                one.column[low - offset : high - offset],
                two.column[low - offset : high - offset],
            )
            if low >= high:
                continue
            if low >= one.begin and low >= two.begin:
                run_unbounded(is_strong, is_ahead, running, left, right, target[at:after])
            elif low >= one.begin:
                run_unbounded(is_strong, is_ahead, running, left, of_right, target[at:after])
            elif low >= two.begin:
                run_unbounded(is_strong, is_ahead, running, of_left, right, target[at:after])
            else:
                run_unbounded(is_strong, is_ahead, running, of_left, of_right, target[at:after])
    if not is_ahead:
        for position in range(whole, end):
            _step(block, is_strong, has_left, one, two, target, position)


@inlined
def take_row(block: SampleBlock, operand: NodeRows, at: int, missing: float, target: Floats) -> None:
    """Fill a row with the numbers at a position, or with `missing` for samples before it, or all outside."""
    if at < block.offset or at > block.last:
        fill_row(missing, target)
        return
    if at < operand.begin:
        fill_row(operand.column[at - block.offset], target)
    else:
        fill_row(operand.rows[at - block.lowest], target)
    if at > block.since:
        fill_row_until(at - block.since, missing, target, target)


@uncounted
def shift_rows(
    block: SampleBlock,
    is_ahead: bool,
    operand: NodeRows,
    target: Floats,
    begin: int,
    end: int,
    missing: float,
) -> None:
    """Compute a shift or delay at begin … end - 1: `starts` says where each looks.

    `target` may be the rows of the operand.
    """
    for k in range(end - begin):
        # what is still to be looked at must not be replaced
        position = begin + k if is_ahead else end - 1 - k
        take_row(block, operand, block.starts[position - begin], missing, target[position - block.lowest])


@uncounted
def fill_open(
    block: SampleBlock, is_open_until: Integers, target: Floats, begin: int, end: int, value: float
) -> None:
    """Enter what an operator is while it is open, at begin … end - 1.

    Args:
        is_open_until: the first sample for which each is not, counted from the block's first.
    """
    for position in range(begin, end):
        row = target[position - block.lowest]
        fill_row_until(is_open_until[position - begin], value, row, row)
