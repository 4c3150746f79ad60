"""Nodes of a part at its open positions, for a block of samples side by side.

What a node is at a position may differ with the sample that is the last one, so of a block of samples it is a
row of numbers, one for each. What joins two rows is one loop over neighbouring numbers, which the compiler
turns into vector instructions: a block costs little more than each of its samples would by itself.

Before a node's first open position, nothing changes with the block, and its numbers are those of its column
(see `node_columns`), the same for every sample. A row's samples before its own position have no number: what
stands there is never looked at, or left out by what looks ahead.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, inlined_as, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online.sliding import copy, either, fill


class SampleBlock(NamedTuple):
    """Some neighbouring samples, and room to work in.

    Attributes:
        running: (2, BLOCK), the rows that are joined one by one take turns.
        starts, afters: (room,), where windows start, and what comes after them (see `find_ends`).
        before: (2 * room,), what windows hold before some position.
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


def _joined(is_greatest: bool, first: Floats, number: Any, target: Floats) -> None:
    (np.maximum if is_greatest else np.minimum)(first, number, out=target)


def _joined_into(is_greatest: bool, number: Any, target: Floats) -> None:
    _joined(is_greatest, target, number, target)


def _joined_from(is_greatest: bool, first: Floats, number: Any, target: Floats, begin: int) -> None:
    copy(first[:begin], target[:begin])
    others = number[begin:] if isinstance(number, np.ndarray) else number
    _joined(is_greatest, first[begin:], others, target[begin:])


def _joined_both(is_greatest: bool, first: Floats, second: Floats, third: Floats, target: Floats) -> None:
    _joined(is_greatest, first, second, target)
    _joined(is_greatest, target, third, target)


# A row is joined in a place of its own, or in its own place alone: the compiler has to see which.


@inlined_as(_joined)
def join_rows(is_greatest: bool, first: Floats, number: Floats, target: Floats) -> None:
    if is_greatest:
        for k in range(len(target)):
            target[k] = max(first[k], number[k])
    else:
        for k in range(len(target)):
            target[k] = min(first[k], number[k])


@inlined_as(_joined)
def join_number(is_greatest: bool, first: Floats, number: float, target: Floats) -> None:
    if is_greatest:
        for k in range(len(target)):
            target[k] = max(first[k], number)
    else:
        for k in range(len(target)):
            target[k] = min(first[k], number)


@inlined_as(_joined_into)
def join_rows_into(is_greatest: bool, number: Floats, target: Floats) -> None:
    if is_greatest:
        for k in range(len(target)):
            target[k] = max(target[k], number[k])
    else:
        for k in range(len(target)):
            target[k] = min(target[k], number[k])


@inlined_as(_joined_into)
def _join_number_into(is_greatest: bool, number: float, target: Floats) -> None:
    if is_greatest:
        for k in range(len(target)):
            target[k] = max(target[k], number)
    else:
        for k in range(len(target)):
            target[k] = min(target[k], number)


@inlined_as(_joined_into)
def _join_rows_whole(is_greatest: bool, number: Floats, target: Floats) -> None:
    """Join a row that is read again at once: adding zero has all of it stored, not only what changes."""
    if is_greatest:
        for k in range(len(target)):
            target[k] = max(target[k], number[k]) + 0.0
    else:
        for k in range(len(target)):
            target[k] = min(target[k], number[k]) + 0.0


@inlined_as(_joined_from)
def _join_rows_from(is_greatest: bool, first: Floats, number: Floats, target: Floats, begin: int) -> None:
    """Join the samples from `begin` on, and copy those before."""
    if is_greatest:
        for k in range(len(target)):
            target[k] = max(first[k], number[k]) if k >= begin else first[k]
    else:
        for k in range(len(target)):
            target[k] = min(first[k], number[k]) if k >= begin else first[k]


@inlined_as(_joined_from)
def _join_number_from(is_greatest: bool, first: Floats, number: float, target: Floats, begin: int) -> None:
    if is_greatest:
        for k in range(len(target)):
            target[k] = max(first[k], number) if k >= begin else first[k]
    else:
        for k in range(len(target)):
            target[k] = min(first[k], number) if k >= begin else first[k]


@inlined
def enter(
    is_greatest: bool, block: SampleBlock, operand: NodeRows, position: int, begin: int, current: int
) -> int:
    """Join the running row with the numbers at a position, for the samples from `begin` on.

    Returns:
        Which of the two running rows it is now; `current` before.
    """
    running, target = block.running[current], block.running[1 - current]
    if position < operand.begin:
        number = operand.column[position - block.offset]
        if begin <= 0:
            join_number(is_greatest, running, number, target)
        else:
            _join_number_from(is_greatest, running, number, target, begin)
    else:
        row = operand.rows[position - block.lowest]
        if begin <= 0:
            join_rows(is_greatest, running, row, target)
        else:
            _join_rows_from(is_greatest, running, row, target, begin)
    return 1 - current


@inlined_as(_joined_both)
def _join_both(is_greatest: bool, first: Floats, second: Floats, third: Floats, target: Floats) -> None:
    if is_greatest:
        for k in range(len(target)):
            target[k] = max(max(first[k], second[k]), third[k])
    else:
        for k in range(len(target)):
            target[k] = min(min(first[k], second[k]), third[k])


@uncounted
def join_positions(block: SampleBlock, is_greatest: bool, operand: NodeRows, begin: int, end: int) -> int:
    """Join the first running row with the rows of begin … end - 1, none of them after the first sample.

    Returns:
        Which of the running rows it is in the end.
    """
    current, rows = 0, operand.rows[begin - block.lowest : max(end, begin) - block.lowest]
    # two at a time: the running row must be stored before it is joined again
    for k in range(0, len(rows) - 1, 2):
        running, target = block.running[current], block.running[1 - current]
        _join_both(is_greatest, running, rows[k], rows[k + 1], target)
        current = 1 - current
    if len(rows) % 2:
        join_rows(is_greatest, block.running[current], rows[-1], block.running[1 - current])
        current = 1 - current
    return current


@uncounted
def join_operands_rows(
    block: SampleBlock,
    is_greatest: bool,
    one: NodeRows,
    two: NodeRows,
    in_place: bool,
    target: Floats,
    begin: int,
    end: int,
) -> None:
    """Compute an `and` or `or` at begin … end - 1.

    Args:
        in_place: whether `target` are the rows of `one`.
    """
    for position in range(begin, end):
        row = target[position - block.lowest]
        if position < one.begin:
            fill(row, one.column[position - block.offset])
        elif not in_place:
            copy(one.rows[position - block.lowest], row)
        if position < two.begin:
            _join_number_into(is_greatest, two.column[position - block.offset], row)
        else:
            join_rows_into(is_greatest, two.rows[position - block.lowest], row)


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
        if middle <= settled:
            value, at = nothing, middle
            for k in range(until - 1 - begin, first - 1, -1):
                while at > starts[k]:
                    at -= 1
                    value = either(is_greatest, value, operand.column[at - block.offset])
                block.before[k] = value
            fill(block.running[0], nothing)
            ends, numbers = afters[first : first + count], block.before[first:]
            join_after(block, is_greatest, operand, middle, ends, numbers, True, target, position)
        else:
            fill(block.running[0], nothing)
            begins = starts[first : first + count]
            join_before(block, is_greatest, operand, middle, begins, target, position)
            if middle < afters[until - 1 - begin]:
                fill(block.running[0], nothing)
                ends = afters[first : first + count]
                join_after(block, is_greatest, operand, middle, ends, block.before, False, target, position)
        position = until


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
    current = 0
    for k in range(len(starts) - 1, -1, -1):
        while at > starts[k]:
            at -= 1
            current = enter(is_greatest, block, operand, at, at - block.since, current)
        copy(block.running[current], target[begin + k - block.lowest])


@uncounted
def join_after(
    block: SampleBlock, is_greatest: bool, operand: NodeRows, at: int, afters: Integers, before: Floats,
    is_number: bool, target: Floats, begin: int,
) -> None:  # fmt: skip
    """Join the extrema from `at` to where windows end with what comes before, at positions from `begin` on.

    Args:
        before: what comes before, if `is_number`; else it stands in `target`.
    """
    current = 0
    for k in range(len(afters)):
        while at < afters[k]:
            current = enter(is_greatest, block, operand, at, at - block.since, current)
            at += 1
        row = target[begin + k - block.lowest]
        if is_number:
            join_number(is_greatest, block.running[current], before[k], row)
        else:
            join_rows_into(is_greatest, block.running[current], row)


@inlined
def _extend(
    block: SampleBlock, is_greatest: bool, operand: NodeRows, in_place: bool, target: Floats, position: int
) -> None:
    """Join the row of a position, none after the first sample, with that of the next one."""
    k = position - block.lowest
    if position < operand.begin:
        join_number(is_greatest, target[k + 1], operand.column[position - block.offset], target[k])
    elif in_place:
        _join_rows_whole(is_greatest, target[k + 1], target[k])
    else:
        join_rows(is_greatest, target[k + 1], operand.rows[k], target[k])


@uncounted
def recurrent_rows(
    block: SampleBlock, is_strong: bool, has_left: bool, one: NodeRows, two: NodeRows, in_place: bool,
    target: Floats, begin: int, is_ahead: bool,
) -> None:  # fmt: skip
    """Compute an unbounded until or release backwards from the last sample, a since or trigger forwards.

    Args:
        is_strong: whether it is an until or a since.
        in_place: whether `target` are the rows of `two`.
        begin: the first position.
        is_ahead: whether it is an until or a release. The first running row is what it is beyond the samples,
            or before `begin`.
    """
    current, count = 0, block.last + 1 - begin
    for k in range(count):
        position = block.last - k if is_ahead else begin + k
        if is_ahead and not has_left and position < block.since:
            _extend(block, is_strong, two, in_place, target, position)
            continue
        if has_left:
            current = enter(not is_strong, block, one, position, position - block.since, current)
        current = enter(is_strong, block, two, position, position - block.since, current)
        copy(block.running[current], target[position - block.lowest])


@inlined
def take_row(block: SampleBlock, operand: NodeRows, at: int, missing: float, target: Floats) -> None:
    """Fill a row with the numbers at a position, or with `missing` for samples before it, or all outside."""
    if at < block.offset or at > block.last:
        fill(target, missing)
        return
    if at < operand.begin:
        fill(target, operand.column[at - block.offset])
    else:
        copy(operand.rows[at - block.lowest], target)
    if at > block.since:
        fill(target[: at - block.since], missing)


@uncounted
def shift_rows(
    block: SampleBlock, is_ahead: bool, operand: NodeRows, target: Floats, begin: int, missing: float
) -> None:
    """Compute a shift or delay from `begin` on: `starts` says where each looks.

    `target` may be the rows of the operand.
    """
    for k in range(block.last + 1 - begin):
        # what is still to be looked at must not be replaced
        position = begin + k if is_ahead else block.last - k
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
        fill(row[: min(max(is_open_until[position - begin], 0), len(row))], value)
