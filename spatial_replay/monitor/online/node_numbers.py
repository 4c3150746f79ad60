"""The tree as the user wrote it: the numbers of every node, from those of signals and parts.

Where everything is known there are four for each sample: value, now, lower and upper. In more channels (see
`codes`) there are eight: low and high end of the value, of `now`, of the value over every continuation, and
of the value if the run ends there. A number is made of those of the operands in the same row and in its
mirror, which negation takes it from.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes

NUMBERS = 8
"""Rows of numbers of a node, or of a part."""
SERIES = 4
"""Rows that a run says of a node: value, now, lower and upper."""


@inlined
def _mirror(row: int, channels: int) -> int:
    if channels > 1:
        return row ^ 1
    return row if row < 2 else 5 - row


@inlined
def _channel(row: int, channels: int) -> int:
    """Return the channel that a row is in."""
    if channels == 1:
        return 0
    return row & 1 if row < 4 or channels == 2 else 2 + (row & 1)


@inlined
def said_in(mode: int, channel: int, channels: int) -> int:
    """Return the row for what a part says in a channel, as `OPEN_END`, … say; -1 for none."""
    if channels == 1:
        return 0 if mode == codes.OPEN_END else 1 + mode
    if mode == codes.OPEN_END:
        return channel if channel < 2 else -1
    return 3 + mode if channel == channels - 3 + mode else -1


@inlined
def _combine(code: int, one: float, one_mirror: float, two: float, two_mirror: float) -> float:
    """Return the lower end of a Boolean operator over two intervals; the upper end is its mirror image."""
    if code == codes.REPORT_XOR:
        return max(min(one, -two_mirror), min(-one_mirror, two))
    if code == codes.REPORT_IMPLIES:
        return max(-one_mirror, two)
    return min(max(-one_mirror, two), max(-two_mirror, one))


@inlined
def _join(code: int, work: Floats, into: int, other: int, count: int) -> None:
    if code == codes.REPORT_AND:
        for k in range(count):
            work[into, k] = min(work[into, k], work[other, k])
    else:
        for k in range(count):
            work[into, k] = max(work[into, k], work[other, k])


@inlined
def _copy(work: Floats, source: int, into: int, count: int) -> None:
    for k in range(count):
        work[into, k] = work[source, k]


@inlined
def _fill(work: Floats, into: int, value: float, count: int) -> None:
    for k in range(count):
        work[into, k] = value


@piece
def report(
    rows: Integers, history: Floats, memory: Floats, work: Floats, channels: int, begin: int, count: int
) -> None:
    """Compute the numbers of every node over `count` samples, operands first.

    Args:
        rows: of a program (see `Program`).
        history, memory: of the signals (see `run_signals`).
        work: receives the numbers of the nodes, after those of the parts, and then the series.
        begin: where these samples stand in the history.
    """
    first, number = rows[0, codes.HEAD_REPORTS_AT], rows[0, codes.HEAD_REPORTS]
    operands, width = rows[0, codes.HEAD_OPERANDS_AT], rows.shape[1]
    own, used = NUMBERS * rows[0, codes.HEAD_PARTS], SERIES if channels == 1 else NUMBERS
    for n in range(number - 1, -1, -1):
        row = first + n
        code, index, rule = (
            rows[row, codes.REPORT_CODE],
            rows[row, codes.REPORT_INDEX],
            rows[row, codes.REPORT_RULE],
        )
        start, stop, one, two = rows[row, codes.REPORT_FIRST], rows[row, codes.REPORT_END], 0, 0
        if stop > start:
            one = own + NUMBERS * rows[operands + start // width, start % width]
            two = own + NUMBERS * rows[operands + (stop - 1) // width, (stop - 1) % width]
        for r in range(used):
            into, part, mirror = own + NUMBERS * n + r, NUMBERS * index + r, _mirror(r, channels)
            channel, is_now = _channel(r, channels), r == 1 if channels == 1 else r in (2, 3)
            if is_now and (
                code == codes.REPORT_SIGNAL or (code == codes.REPORT_PAST and rule == codes.NOW_OF_SIGNAL)
            ):
                for k in range(count):
                    work[into, k] = history[channel, index, begin + k]
            elif code == codes.REPORT_SIGNAL:  # settled by the first sample
                _fill(work, into, memory[channel, rows[0, codes.HEAD_SIGNALS] + index], count)
            elif code == codes.REPORT_PAST:
                # what it is now is what the part is at the first sample
                _copy(work, part - used // 4 if is_now else two + r, into, count)
            elif code in (codes.REPORT_PART, codes.REPORT_LASTING):
                if not is_now or rule == codes.NOW_OF_PART:
                    _copy(work, part, into, count)
                    if code == codes.REPORT_LASTING:
                        _join(codes.REPORT_AND, work, into, one + r, count)
                        if rule == codes.NOW_LAST_OPERAND:
                            _join(codes.REPORT_OR, work, into, two + r, count)
                elif rule in (codes.NOW_LAST_OPERAND, codes.NOW_EITHER):
                    _copy(work, two + r, into, count)
                    if rule == codes.NOW_EITHER:
                        _join(codes.REPORT_OR, work, into, one + r, count)
                else:
                    _fill(work, into, np.inf if rule == codes.NOW_TRUE else -np.inf, count)
            elif code == codes.REPORT_NOT:
                for k in range(count):
                    work[into, k] = -work[one + mirror, k]
            elif code in (codes.REPORT_AND, codes.REPORT_OR, codes.REPORT_SPEC):
                _copy(work, one + r, into, count)
                for each in range(start + 1, stop):
                    other = own + NUMBERS * rows[operands + each // width, each % width]
                    _join(code, work, into, other + r, count)
            else:
                for k in range(count):
                    work[into, k] = _combine(
                        code, work[one + r, k], work[one + mirror, k], work[two + r, k], work[two + mirror, k]
                    )
    _write_series(work, own, own + NUMBERS * number, number, channels, count)


@inlined
def _write_series(work: Floats, first: int, series: int, number: int, channels: int, count: int) -> None:
    """Write value, now, lower and upper of every node; NaN where the ends of value or now differ.

    Adding zero turns -0.0 into 0.0, so that equal numbers are equal bits.
    """
    for n in range(number):
        for r in range(SERIES):
            into, source = series + SERIES * n + r, first + NUMBERS * n + r
            if channels > 1 and r < 2:
                source += r
                for k in range(count):
                    low, high = work[source, k], work[source + 1, k]
                    work[into, k] = low + 0.0 if low == high else np.nan
            else:
                source += 0 if channels == 1 else 2
                for k in range(count):
                    work[into, k] = work[source, k] + 0.0
