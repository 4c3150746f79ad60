"""The tree as the user wrote it: the numbers of every node, from those of signals and parts.

Each node has the numbers listed at `state.NUMBERS`, in as many channels as needed so far (see `codes`). Of
samples that come together, and of which everything is known, only the four that differ are computed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.state import NUMBERS, Memory, Scratch


class Results(NamedTuple):
    """What a run says.

    Attributes:
        series: (N, 4, T), receives value, now, lower and upper of each node.
        final: (N, 2), receives the ends of each node's value if the run ends with the last sample.
    """

    series: Floats
    final: Floats


@inlined
def _columns_of(reports: Integers, n: int) -> tuple[int, int, int, int, int]:
    """Return the code of a node, its index and rule, and where its operands begin and end."""
    return (
        reports[n, codes.REPORT_CODE],
        reports[n, codes.REPORT_INDEX],
        reports[n, codes.REPORT_RULE],
        reports[n, codes.REPORT_FIRST],
        reports[n, codes.REPORT_END],
    )


@inlined
def _combine_low(code: int, low: float, high: float, other_low: float, other_high: float) -> float:
    """Return the lower end of a Boolean operator over two intervals; the upper end is its mirror image."""
    if code == codes.REPORT_AND:
        return min(low, other_low)
    if code == codes.REPORT_OR:
        return max(low, other_low)
    if code == codes.REPORT_XOR:
        return max(min(low, -other_high), min(-high, other_low))
    if code == codes.REPORT_IMPLIES:
        return max(-high, other_low)
    return min(max(-high, other_low), max(-other_high, low))


@inlined
def _combine(code: int, into: Floats, other: Floats, count: int) -> None:
    for pair in range(0, NUMBERS, 2):
        low, high, other_low, other_high = into[pair], into[pair + 1], other[pair], other[pair + 1]
        if code == codes.REPORT_AND:
            for k in range(count):
                low[k], high[k] = min(low[k], other_low[k]), min(high[k], other_high[k])
        elif code == codes.REPORT_OR:
            for k in range(count):
                low[k], high[k] = max(low[k], other_low[k]), max(high[k], other_high[k])
        else:
            for k in range(count):
                low[k], high[k] = (
                    _combine_low(code, low[k], high[k], other_low[k], other_high[k]),
                    _combine_low(code, high[k], low[k], other_high[k], other_low[k]),
                )


@uncounted
def _copy(source: Floats, target: Floats) -> None:
    """Copy one row of numbers to the beginning of another."""
    # element by element: what says that two slices differ in length takes seconds to compile
    for k in range(len(source)):
        target[k] = source[k]


@inlined
def _copy_numbers(source: Floats, target: Floats, count: int) -> None:
    """Copy the numbers of one node, (NUMBERS, count)."""
    for number in range(NUMBERS):
        if count == 1:  # a slice costs more than its only number
            target[number, 0] = source[number, 0]
        else:
            _copy(source[number, :count], target[number])


@inlined
def _set_now(rule: int, into: Floats, first: Floats, last: Floats, count: int) -> None:
    """Compute what a part is now, from what its first and its last operand are."""
    for number in (2, 3):
        for k in range(count):
            if rule == codes.NOW_LAST_OPERAND:
                into[number, k] = last[number, k]
            elif rule == codes.NOW_EITHER:
                into[number, k] = max(first[number, k], last[number, k])
            elif rule == codes.NOW_TRUE:
                into[number, k] = np.inf
            elif rule == codes.NOW_FALSE:
                into[number, k] = -np.inf


@uncounted
def _copy_known(source: Floats, target: Floats) -> None:
    """Copy numbers; adding zero turns -0.0 into 0.0, so that equal numbers are equal bits."""
    for k in range(len(target)):
        target[k] = source[k] + 0.0


@inlined
def _write_series(numbers: Floats, t: int, count: int, series: Floats) -> None:
    """Write value, now, lower and upper of every node; NaN where the ends of value or now differ.

    Adding zero turns -0.0 into 0.0, so that equal numbers are equal bits.
    """
    for n in range(numbers.shape[0]):
        for which in range(2):
            low, high = numbers[n, 2 * which], numbers[n, 2 * which + 1]
            if count == 1:  # a slice costs more than its only number
                series[n, which, t] = low[0] + 0.0 if low[0] == high[0] else np.nan
                series[n, 2 + which, t] = numbers[n, 4 + which, 0] + 0.0
                continue
            target = series[n, which, t : t + count]
            for k in range(count):
                target[k] = low[k] + 0.0 if low[k] == high[k] else np.nan
            _copy_known(numbers[n, 4 + which, :count], series[n, 2 + which, t : t + count])


@uncounted
def _fill_known(number: float, target: Floats) -> None:
    for k in range(len(target)):
        target[k] = number + 0.0


@uncounted
def _oppose_known(source: Floats, target: Floats) -> None:
    for k in range(len(target)):
        target[k] = -source[k] + 0.0


@uncounted
def _combine_known(
    code: int, into: Floats, low: Floats, high: Floats, other_low: Floats, other_high: Floats
) -> None:
    """Combine one end of two operands; `low` is that end of the first one, `high` its other end."""
    if code == codes.REPORT_AND:
        for k in range(len(into)):
            into[k] = min(low[k], other_low[k]) + 0.0
    elif code == codes.REPORT_OR:
        for k in range(len(into)):
            into[k] = max(low[k], other_low[k]) + 0.0
    elif code == codes.REPORT_IMPLIES:
        for k in range(len(into)):
            into[k] = max(-high[k], other_low[k]) + 0.0
    else:
        for k in range(len(into)):
            into[k] = _combine_low(code, low[k], high[k], other_low[k], other_high[k]) + 0.0


@uncounted
def _report_known(
    reports: Integers, operands: Integers, memory: Memory, scratch: Scratch, begin: int, count: int, t: int,
    results: Results,
) -> None:  # fmt: skip
    """Run `report` where everything is known: half of the numbers are equal to others, and left out."""
    series, end, room = results.series, t + count, scratch.series[0, :count]
    for n in range(reports.shape[0] - 1, -1, -1):
        code, index, rule, start, stop = _columns_of(reports, n)
        value, now = series[n, 0, t:end], series[n, 1, t:end]
        lower, upper = series[n, 2, t:end], series[n, 3, t:end]
        if code == codes.REPORT_SIGNAL:
            for which in (0, 2, 3):
                _fill_known(memory.firsts[0, index], series[n, which, t:end])
            _copy_known(memory.history[0, index, begin : begin + count], now)
        elif code == codes.REPORT_PART:
            part = scratch.parts[index]
            _copy_known(part[0, :count], value)
            _copy_known(part[4, :count], lower)
            _copy_known(part[5, :count], upper)
            last = series[operands[stop - 1], 1, t:end]
            if rule == codes.NOW_OF_PART:
                _copy_known(part[2, :count], now)
            elif rule == codes.NOW_LAST_OPERAND:
                _copy_known(last, now)
            elif rule == codes.NOW_EITHER:
                first = series[operands[start], 1, t:end]
                _combine_known(codes.REPORT_OR, now, first, first, last, last)
            else:
                _fill_known(np.inf if rule == codes.NOW_TRUE else -np.inf, now)
        elif code == codes.REPORT_LASTING:
            left, right = operands[start], operands[stop - 1]
            for which, row in ((0, 0), (2, 4), (3, 5)):
                into, of = series[n, which, t:end], series[left, which, t:end]
                awaited, at_once = scratch.parts[index, row, :count], series[right, which, t:end]
                _combine_known(codes.REPORT_AND, into, awaited, awaited, of, of)
                if rule == codes.NOW_LAST_OPERAND:
                    _combine_known(codes.REPORT_OR, into, into, into, at_once, at_once)
            if rule == codes.NOW_LAST_OPERAND:
                _copy_known(series[right, 1, t:end], now)
            else:
                _fill_known(-np.inf, now)
        elif code == codes.REPORT_PAST:
            of = operands[stop - 1]
            for which in (0, 2, 3):
                _copy_known(series[of, which, t:end], series[n, which, t:end])
            if rule == codes.NOW_OF_SIGNAL:
                _copy_known(memory.history[0, index, begin : begin + count], now)
            else:
                _copy_known(scratch.parts[index, 2 if rule == codes.NOW_OF_PART else 0, :count], now)
        elif code == codes.REPORT_NOT:
            of = operands[start]
            _oppose_known(series[of, 0, t:end], value)
            _oppose_known(series[of, 1, t:end], now)
            _oppose_known(series[of, 3, t:end], lower)
            _oppose_known(series[of, 2, t:end], upper)
        else:
            for which in range(4):
                of = series[operands[start], which, t:end]
                _copy_known(of, series[n, which, t:end])
            for each in range(start + 1, stop):
                for which in range(2):
                    into = series[n, which, t:end]
                    of = series[operands[each], which, t:end]
                    _combine_known(code, into, into, into, of, of)
                least = series[operands[each], 2, t:end]
                most = series[operands[each], 3, t:end]
                _copy_known(lower, room)
                _combine_known(code, lower, lower, upper, least, most)
                _combine_known(code, upper, upper, room, most, least)
    for n in range(reports.shape[0]):
        results.final[n, 0] = results.final[n, 1] = series[n, 0, t + count - 1]


@uncounted
def report(
    reports: Integers, operands: Integers, memory: Memory, scratch: Scratch, channels: int, begin: int,
    count: int, t: int, results: Results,
) -> None:  # fmt: skip
    """Compute the numbers of every node over `count` samples, operands first.

    Args:
        begin: where these samples stand in the history.
        t: where they go in the series.
    """
    if channels == 1 and count > 1:
        _report_known(reports, operands, memory, scratch, begin, count, t, results)
        return
    nominal_high = 1 if channels > 1 else 0
    wide_low = 2 if channels > 2 else 0
    wide_high = wide_low + nominal_high
    numbers = scratch.nodes
    for n in range(reports.shape[0] - 1, -1, -1):
        code, index, rule, start, stop = _columns_of(reports, n)
        rows = numbers[n]
        if code == codes.REPORT_SIGNAL:  # settled by the first sample
            if count == 1:
                rows[2, 0] = memory.history[0, index, begin]
                rows[3, 0] = memory.history[nominal_high, index, begin]
            else:
                _copy(memory.history[0, index, begin : begin + count], rows[2])
                _copy(memory.history[nominal_high, index, begin : begin + count], rows[3])
            for k in range(count):
                rows[0, k], rows[1, k] = memory.firsts[0, index], memory.firsts[nominal_high, index]
                rows[4, k], rows[5, k] = memory.firsts[wide_low, index], memory.firsts[wide_high, index]
                rows[6, k], rows[7, k] = rows[4, k], rows[5, k]
        elif code == codes.REPORT_PART:
            _copy_numbers(scratch.parts[index], rows, count)
            _set_now(rule, rows, numbers[operands[start]], numbers[operands[stop - 1]], count)
        elif code == codes.REPORT_LASTING:
            _copy_numbers(scratch.parts[index], rows, count)
            _combine(codes.REPORT_AND, rows, numbers[operands[start]], count)
            if rule == codes.NOW_LAST_OPERAND:
                _combine(codes.REPORT_OR, rows, numbers[operands[stop - 1]], count)
            _set_now(rule, rows, numbers[operands[start]], numbers[operands[stop - 1]], count)
        elif code == codes.REPORT_PAST:
            _copy_numbers(numbers[operands[stop - 1]], rows, count)
            row = 2 if rule == codes.NOW_OF_PART else 0
            for end in range(2):
                for k in range(count):
                    if rule == codes.NOW_OF_SIGNAL:
                        rows[2 + end, k] = memory.history[end * nominal_high, index, begin + k]
                    else:
                        rows[2 + end, k] = scratch.parts[index, row + end, k]
        elif code == codes.REPORT_NOT:
            child = numbers[operands[start]]
            for pair in range(0, NUMBERS, 2):
                for k in range(count):
                    rows[pair, k], rows[pair + 1, k] = -child[pair + 1, k], -child[pair, k]
        else:
            _copy_numbers(numbers[operands[start]], rows, count)
            for each in range(start + 1, stop):
                _combine(code, rows, numbers[operands[each]], count)
    _write_series(numbers, t, count, results.series)
    for n in range(reports.shape[0]):
        results.final[n, 0] = numbers[n, 6, count - 1] + 0.0
        results.final[n, 1] = numbers[n, 7, count - 1] + 0.0
