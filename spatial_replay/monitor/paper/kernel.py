"""Kernels for Def. 16 on every prefix: one sample at a time through the table of a formula.

A number that reaches beyond the run is left out: it is NaN, and minima and maxima skip it. A number that
depends on something unknown is lost: a mark beside it, which every minimum and maximum over it inherits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import kernel, piece
from spatial_replay.geometry.arrays import Flags, Floats, Integers
from spatial_replay.monitor.paper.scans import (
    ALWAYS,
    CODE,
    COLUMN,
    END,
    EVENTUALLY,
    FIRST,
    HIGH,
    INNER,
    IS_IN_NS,
    IS_PLAIN,
    LEAF,
    LEAF_NODE,
    LOW,
    NEXT,
    PAIRS,
    TRUTH,
    combine,
    least,
    most,
    pick,
    scan,
    scan_until,
    scan_until_by_last,
    scan_until_by_pairs,
    total,
)


class PaperMemory(NamedTuple):
    """State between samples; each array of numbers has a parallel one of lost numbers.

    Attributes:
        stamps: (room,), times of the samples in ns; of the first alone if nothing keeps a column.
        columns: (K, room), numbers at each sample, on the samples so far.
        value: (N,), each node at the first sample.
        now: (N,), each node at the newest sample.
        left: (N,), of an until at the first sample: the least of its left operand.
        starts: (N,), where the window of the earliest sample that is still open begins; -1 for not yet.
        opens: (N,), the earliest sample whose window is still open.
        pairs: the left operand of an until for each end of its run, one row after the other.
        pair_starts: (P, room), sample s of the row of end t is at `pair_starts[p, t] + s`.
        pair_end: (1,), how much of `pairs` is used.
    """

    stamps: Integers
    columns: Floats
    lost_columns: Flags
    value: Floats
    lost_value: Flags
    now: Floats
    lost_now: Flags
    left: Floats
    lost_left: Flags
    starts: Integers
    opens: Integers
    pairs: Floats
    lost_pairs: Flags
    pair_starts: Integers
    pair_end: Integers


@piece
def _set_now(rows: Integers, operands: Integers, n: int, numbers: Floats, lost: Flags) -> None:
    """Compute a node on the newest sample alone, from its operands there."""
    code, first, end = rows[n, CODE], rows[n, FIRST], rows[n, END]
    if code == NEXT or (code > NEXT and rows[n, LOW] > 0):
        numbers[n], lost[n] = np.nan, 0
        return
    operand = operands[first]
    if code in (EVENTUALLY, ALWAYS):
        numbers[n], lost[n] = numbers[operand], lost[operand]
        return
    if code > ALWAYS:
        other = operands[end - 1]
        numbers[n], lost[n] = least(numbers[operand], numbers[other]), lost[operand] | lost[other]
        return
    _fold(code, operands[first:end], numbers, lost, n)


@piece
def _fold(code: int, operands: Integers, numbers: Floats, lost: Flags, n: int) -> None:
    """Compute a Boolean node from its operands."""
    number, is_lost = numbers[operands[0]], lost[operands[0]]
    number = combine(code, number, number) if len(operands) == 1 else number
    for each in operands[1:]:
        number = combine(code, number, numbers[each])
        is_lost |= lost[each]
    numbers[n], lost[n] = number, is_lost


@piece
def _set_column(rows: Integers, operands: Integers, n: int, last: int, memory: PaperMemory) -> None:
    """Compute a Boolean node at every sample, from its operands."""
    code, first, end = rows[n, CODE], rows[n, FIRST], rows[n, END]
    row = rows[n, COLUMN]
    into, lost = memory.columns[row], memory.lost_columns[row]
    other_row = rows[operands[first], COLUMN]
    other, other_lost = memory.columns[other_row], memory.lost_columns[other_row]
    for t in range(last + 1):
        into[t] = combine(code, other[t], other[t]) if end - first == 1 else other[t]
        lost[t] = other_lost[t]
    for each in range(first + 1, end):
        other_row = rows[operands[each], COLUMN]
        other, other_lost = memory.columns[other_row], memory.lost_columns[other_row]
        for t in range(last + 1):
            into[t] = combine(code, into[t], other[t])
            lost[t] |= other_lost[t]


@piece
def _window_at_first(rows: Integers, n: int, last: int, time_ns: int, memory: PaperMemory) -> bool:
    """Return whether the last sample is in the first one's window; note where that window begins."""
    passed = time_ns - memory.stamps[0] if rows[n, IS_IN_NS] else last
    if memory.starts[n] < 0 and passed >= rows[n, LOW]:
        memory.starts[n] = last
    return bool(memory.starts[n] >= 0 and (rows[n, HIGH] < 0 or passed <= rows[n, HIGH]))


@piece
def _step_first(
    rows: Integers, operands: Integers, n: int, last: int, time_ns: int, memory: PaperMemory
) -> None:
    """Update a temporal node that is needed at the first sample only."""
    code, value, lost = rows[n, CODE], memory.value, memory.lost_value
    right = operands[rows[n, END] - 1]
    right_row = rows[right, COLUMN]
    is_plain = rows[right, IS_PLAIN] != 0
    if code == NEXT:
        if is_plain and last == 1:
            value[n], lost[n] = memory.now[right], memory.lost_now[right]
        if not is_plain and last >= 1:
            value[n], lost[n] = memory.columns[right_row, 1], memory.lost_columns[right_row, 1]
        return
    if not _window_at_first(rows, n, last, time_ns, memory):
        return
    start = memory.starts[n]
    if code in (EVENTUALLY, ALWAYS):
        if is_plain:
            value[n] = pick(code == ALWAYS, value[n], memory.now[right])
            lost[n] |= memory.lost_now[right]
        else:
            numbers, marks = memory.columns[right_row], memory.lost_columns[right_row]
            value[n], lost[n] = total(code == ALWAYS, numbers, marks, start, last)
        return
    left = operands[rows[n, FIRST]]
    if rows[left, IS_PLAIN]:
        memory.left[n] = least(memory.left[n], memory.now[left])
        memory.lost_left[n] |= memory.lost_now[left]
    else:
        left_row = rows[left, COLUMN]
        numbers, marks = memory.columns[left_row], memory.lost_columns[left_row]
        memory.left[n], memory.lost_left[n] = total(True, numbers, marks, start, last)
    if is_plain:
        value[n] = most(value[n], least(memory.now[right], memory.left[n]))
        lost[n] |= memory.lost_now[right] | memory.lost_left[n]
        return
    inner = rows[n, INNER]
    memory.columns[inner, last], memory.lost_columns[inner, last] = memory.left[n], memory.lost_left[n]
    value[n], lost[n] = np.nan, 0
    for t in range(start, last + 1):
        value[n] = most(value[n], least(memory.columns[right_row, t], memory.columns[inner, t]))
        lost[n] |= memory.lost_columns[right_row, t] | memory.lost_columns[inner, t]


@piece
def _apart(rows: Integers, n: int, earlier: int, later: int, memory: PaperMemory) -> int:
    """Return the distance of two samples, in the unit of a node's window."""
    return memory.stamps[later] - memory.stamps[earlier] if rows[n, IS_IN_NS] else later - earlier


@piece
def _step_column(rows: Integers, operands: Integers, n: int, last: int, memory: PaperMemory) -> None:
    """Update a temporal node that is needed at every sample, where its window was still open."""
    code = rows[n, CODE]
    row, inner = rows[n, COLUMN], rows[n, INNER]
    into, into_lost = memory.columns[row], memory.lost_columns[row]
    right_row = rows[operands[rows[n, END] - 1], COLUMN]
    right, right_lost = memory.columns[right_row], memory.lost_columns[right_row]
    if code == NEXT:
        for t in range(last):
            into[t], into_lost[t] = right[t + 1], right_lost[t + 1]
        into[last], into_lost[last] = np.nan, 0
        return
    low, high = rows[n, LOW], rows[n, HIGH]
    while high >= 0 and _apart(rows, n, memory.opens[n], last, memory) > high:
        memory.opens[n] += 1
    start = max(memory.starts[n], memory.opens[n])
    while start <= last and _apart(rows, n, memory.opens[n], start, memory) < low:
        start += 1
    memory.starts[n] = start
    if start <= last:
        _scan_node(rows, operands, n, start, last, memory)
    if inner == row:
        return
    for t in range(memory.opens[n], last + 1):
        while start <= last and _apart(rows, n, t, start, memory) < low:
            start += 1
        if start <= last:
            into[t], into_lost[t] = memory.columns[inner, start], memory.lost_columns[inner, start]
        else:
            into[t], into_lost[t] = np.nan, 0


@piece
def _scan_node(
    rows: Integers, operands: Integers, n: int, start: int, last: int, memory: PaperMemory
) -> None:
    """Run the unbounded operator from each sample, from `start` on, to the last one."""
    code, inner = rows[n, CODE], rows[n, INNER]
    into, into_lost = memory.columns[inner], memory.lost_columns[inner]
    right_node, left_node = operands[rows[n, END] - 1], operands[rows[n, FIRST]]
    right_row, left_row = rows[right_node, COLUMN], rows[left_node, COLUMN]
    right, right_lost = memory.columns[right_row], memory.lost_columns[right_row]
    left, left_lost = memory.columns[left_row], memory.lost_columns[left_row]
    if code in (EVENTUALLY, ALWAYS):
        scan(code == ALWAYS, right, right_lost, start, last, into, into_lost)
    elif rows[left_node, IS_PLAIN]:
        scan_until(left, left_lost, right, right_lost, start, last, into, into_lost)
    elif rows[right_node, IS_PLAIN]:
        scan_until_by_last(left, left_lost, right[last], right_lost[last], start, last, into, into_lost)
    else:
        pair_starts, end = memory.pair_starts[rows[n, PAIRS]], memory.pair_end[0]
        pair_starts[last] = end - start
        memory.pair_end[0] = end + last + 1 - start
        row, lost_row = memory.pairs[end:], memory.lost_pairs[end:]
        scan(True, left[start:], left_lost[start:], 0, last - start, row, lost_row)
        scan_until_by_pairs(
            memory.pairs, memory.lost_pairs, pair_starts, right, right_lost, start, last, into, into_lost
        )


@kernel
def step_paper(
    rows: Integers, operands: Integers, leaves: Floats, lost_leaves: Flags, times_ns: Integers,
    t: int, count: int, position: int, memory: PaperMemory, series: Floats,
) -> None:  # fmt: skip
    """Run the samples t up to t + count; `position` samples came before.

    Args:
        leaves: (A, T); NaN where one is left out.
        lost_leaves: (A, T), 1 where one is not known.
        series: (N, 4, T), receives value, now, lower and upper of each node.
    """
    nodes = rows.shape[0]
    for k in range(t, t + count):
        last = position + k - t
        if last < memory.stamps.shape[0]:
            memory.stamps[last] = times_ns[k]
        for n in range(nodes - 1, -1, -1):
            code, is_plain = rows[n, CODE], rows[n, IS_PLAIN] != 0
            if code == LEAF_NODE:
                leaf = rows[n, LEAF]
                memory.now[n], memory.lost_now[n] = leaves[leaf, k], lost_leaves[leaf, k]
            elif code == TRUTH:
                memory.now[n] = np.inf * rows[n, LEAF]
            else:
                _set_now(rows, operands, n, memory.now, memory.lost_now)
            column = rows[n, COLUMN]
            if is_plain:
                if column >= 0:
                    memory.columns[column, last] = memory.now[n]
                    memory.lost_columns[column, last] = memory.lost_now[n]
                if last == 0:
                    memory.value[n], memory.lost_value[n] = memory.now[n], memory.lost_now[n]
            elif column >= 0:
                if code >= NEXT:
                    _step_column(rows, operands, n, last, memory)
                else:
                    _set_column(rows, operands, n, last, memory)
                memory.value[n] = memory.columns[column, 0]
                memory.lost_value[n] = memory.lost_columns[column, 0]
            elif code >= NEXT:
                _step_first(rows, operands, n, last, times_ns[k], memory)
            else:
                own = operands[rows[n, FIRST] : rows[n, END]]
                _fold(code, own, memory.value, memory.lost_value, n)
            # adding zero turns -0.0 into 0.0, so that equal numbers are equal bits
            series[n, 0, k] = np.nan if memory.lost_value[n] else memory.value[n] + 0.0
            series[n, 1, k] = np.nan if memory.lost_now[n] else memory.now[n] + 0.0
            series[n, 2, k] = series[n, 3, k] = series[n, 0, k]
