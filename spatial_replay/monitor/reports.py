"""The tree that the user sees: every node's numbers, from signals, parts and operands.

`memory.NUMBERS` says which numbers a node has at a sample.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.codes import (
    NOW_EITHER,
    NOW_FALSE,
    NOW_LAST_OPERAND,
    NOW_TRUE,
    REPORT_AND,
    REPORT_CODE,
    REPORT_END,
    REPORT_FIRST,
    REPORT_IMPLIES,
    REPORT_INDEX,
    REPORT_NOT,
    REPORT_OR,
    REPORT_PART,
    REPORT_RULE,
    REPORT_SIGNAL,
    REPORT_XOR,
)
from spatial_replay.monitor.memory import NUMBERS, Memory, Scratch


@piece
def _combine_low(code: int, low: float, high: float, other_low: float, other_high: float) -> float:
    """Lower end of a Boolean operator over two intervals; the upper end is its mirror image."""
    if code == REPORT_AND:
        return min(low, other_low)
    if code == REPORT_OR:
        return max(low, other_low)
    if code == REPORT_XOR:
        return max(min(low, -other_high), min(-high, other_low))
    if code == REPORT_IMPLIES:
        return max(-high, other_low)
    return min(max(-high, other_low), max(-other_high, low))


@piece
def _combine(code: int, into: Floats, other: Floats, count: int) -> None:
    for pair in range(0, NUMBERS, 2):
        low, high, other_low, other_high = into[pair], into[pair + 1], other[pair], other[pair + 1]
        if code == REPORT_AND:
            for k in range(count):
                low[k], high[k] = min(low[k], other_low[k]), min(high[k], other_high[k])
        elif code == REPORT_OR:
            for k in range(count):
                low[k], high[k] = max(low[k], other_low[k]), max(high[k], other_high[k])
        else:
            for k in range(count):
                low[k], high[k] = (
                    _combine_low(code, low[k], high[k], other_low[k], other_high[k]),
                    _combine_low(code, high[k], low[k], other_high[k], other_low[k]),
                )


@piece
def _set_now(rule: int, into: Floats, first: Floats, last: Floats, count: int) -> None:
    """What a part is now, from what its first and its last operand are."""
    for number in (2, 3):
        for k in range(count):
            if rule == NOW_LAST_OPERAND:
                into[number, k] = last[number, k]
            elif rule == NOW_EITHER:
                into[number, k] = max(first[number, k], last[number, k])
            elif rule == NOW_TRUE:
                into[number, k] = np.inf
            elif rule == NOW_FALSE:
                into[number, k] = -np.inf


@piece
def _write_series(numbers: Floats, t: int, count: int, series: Floats) -> None:
    """value, now, lower and upper of every node; NaN where the ends of value or now differ.

    Adding zero turns -0.0 into 0.0, so that equal numbers are equal bits.
    """
    for n in range(numbers.shape[0]):
        for which in range(2):
            low, high = numbers[n, 2 * which], numbers[n, 2 * which + 1]
            for k in range(count):
                series[n, which, t + k] = low[k] + 0.0 if low[k] == high[k] else np.nan
        for which in range(2):
            end = numbers[n, 4 + which]
            for k in range(count):
                series[n, 2 + which, t + k] = end[k] + 0.0


@piece
def report(
    reports: Integers, operands: Integers, memory: Memory, scratch: Scratch, channels: int, begin: int,
    count: int, t: int, series: Floats, final: Floats,
) -> None:  # fmt: skip
    """The numbers of every node over `count` samples, operands first.

    Args:
        begin: where these samples stand in the history.
        t: where they go in `series`, (N, 4, T): value, now, lower, upper.
        final: (N, 2), receives the ends of each node's value if the run ends with the last of them.
    """
    nominal_high = 1 if channels > 1 else 0
    wide_low = 2 if channels > 2 else 0
    wide_high = wide_low + nominal_high
    numbers = scratch.nodes
    for n in range(reports.shape[0] - 1, -1, -1):
        code, index, rule = reports[n, REPORT_CODE], reports[n, REPORT_INDEX], reports[n, REPORT_RULE]
        start, stop = reports[n, REPORT_FIRST], reports[n, REPORT_END]
        rows = numbers[n]
        if code == REPORT_SIGNAL:  # settled by the first sample
            for k in range(count):
                rows[0, k], rows[1, k] = memory.firsts[0, index], memory.firsts[nominal_high, index]
                rows[2, k], rows[3, k] = (
                    memory.history[0, index, begin + k],
                    memory.history[nominal_high, index, begin + k],
                )
                rows[4, k], rows[5, k] = memory.firsts[wide_low, index], memory.firsts[wide_high, index]
                rows[6, k], rows[7, k] = memory.firsts[wide_low, index], memory.firsts[wide_high, index]
        elif code == REPORT_PART:
            for number in range(NUMBERS):
                for k in range(count):
                    rows[number, k] = scratch.parts[index, number, k]
            _set_now(rule, rows, numbers[operands[start]], numbers[operands[stop - 1]], count)
        elif code == REPORT_NOT:
            child = numbers[operands[start]]
            for pair in range(0, NUMBERS, 2):
                for k in range(count):
                    rows[pair, k], rows[pair + 1, k] = -child[pair + 1, k], -child[pair, k]
        else:
            child = numbers[operands[start]]
            for number in range(NUMBERS):
                for k in range(count):
                    rows[number, k] = child[number, k]
            for each in range(start + 1, stop):
                _combine(code, rows, numbers[operands[each]], count)
    _write_series(numbers, t, count, series)
    for n in range(reports.shape[0]):
        final[n, 0], final[n, 1] = numbers[n, 6, count - 1] + 0.0, numbers[n, 7, count - 1] + 0.0
