"""Kernels for operators over samples whose end is known: one pass each, independent of window widths.

A future operator is a past one in reversed time, so each kernel works on *steps* 0, 1, … and looks back. Step
i stands at begin + i, or at end - 1 - i for a future operator.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, kernel, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.signals import past_value


class Steps(NamedTuple):
    """The samples begin … end - 1 in the direction in which an operator reads them.

    Attributes:
        stamps: times of all samples in ns.
        origin, stride: step i stands at origin + stride * i.
        length: how many steps there are.
    """

    stamps: Integers
    origin: int
    stride: int
    length: int


@inlined
def _at(steps: Steps, step: int) -> int:
    return steps.origin + steps.stride * step


@inlined
def _distance(steps: Steps, unit: int, earlier: int, later: int) -> int:
    """Return the distance from one step to a later one, in samples or in ns."""
    if unit == codes.SAMPLES:
        return later - earlier
    return int(abs(steps.stamps[_at(steps, later)] - steps.stamps[_at(steps, earlier)]))


@piece
def _run_past(code: int, first: Floats, second: Floats, target: Floats, steps: Steps) -> None:
    """Run an unbounded once, historically or since."""
    value = np.inf if code == codes.HISTORICALLY else -np.inf
    for i in range(steps.length):
        k = _at(steps, i)
        value = past_value(code, first[k], second[k], value)
        target[k] = value


@piece
def _run_delay(
    source: Floats, target: Floats, steps: Steps, unit: int, distance: int, missing: float
) -> None:
    """Take the value at the last step at least `distance` back."""
    back = -1
    for i in range(steps.length):
        while back < i and _distance(steps, unit, back + 1, i) >= distance:
            back += 1
        target[_at(steps, i)] = source[_at(steps, back)] if back >= 0 else missing


@piece
def _slide(
    source: Floats, target: Floats, steps: Steps, unit: int, near: int, far: int, sign: float, extrema: Floats
) -> None:
    """Compute the greatest (sign 1) or least (sign -1) value over the steps from `far` to `near` back.

    The window is kept in two stacks: `extrema` holds those from each step up to a middle, `recent` that of
    the steps from there on. Every step enters either once, however wide the window is.
    """
    first, middle, end = 0, 0, 0
    recent = -np.inf
    for i in range(steps.length):
        while end <= i and _distance(steps, unit, end, i) >= near:
            recent = max(recent, sign * source[_at(steps, end)])
            end += 1
        while first < end and _distance(steps, unit, first, i) > far:
            first += 1
        # the older stack is used up: move the recent steps into it, with running extrema from the newest down
        if first >= middle:
            extremum = -np.inf
            for step in range(end - 1, first - 1, -1):
                extremum = max(extremum, sign * source[_at(steps, step)])
                extrema[step] = extremum
            middle = end
            recent = -np.inf
        inside = extrema[first] if first < middle else -np.inf
        target[_at(steps, i)] = sign * max(inside, recent)


@piece
def _run_boolean(
    row: Integers, columns: Floats, channel: int, mirror: int, target: Floats, begin: int, end: int
) -> None:
    code, a, b = row[0], row[1], row[2]
    first, second = columns[channel, a], columns[channel, b]
    if code == codes.CONSTANT:
        target[begin:end] = row[4] * np.inf
    elif code == codes.NOT:
        for k in range(begin, end):
            target[k] = -columns[mirror, a, k]
    elif code == codes.AND:
        for k in range(begin, end):
            target[k] = min(first[k], second[k])
    elif code == codes.OR:
        for k in range(begin, end):
            target[k] = max(first[k], second[k])


@kernel
def run_offline(
    rows: Integers, leaves: Floats, stamps: Integers, begin: int, end: int, columns: Floats, extrema: Floats
) -> None:
    """Run all rows over the samples from begin to before end, as if there were no others.

    Args:
        rows: (R, OFFLINE_WIDTH), operands first.
        leaves: (C, A, T) in one, two or four channels.
        stamps: (T,), ns.
        columns: (C, K, T), receives the numbers.
        extrema: (T,), room to work in.
    """
    channels = leaves.shape[0]
    for r in range(rows.shape[0]):
        row = rows[r]
        code = row[0]
        is_ahead = code >= codes.AHEAD
        past = code - codes.AHEAD if is_ahead else code
        steps = Steps(stamps, end - 1 if is_ahead else begin, -1 if is_ahead else 1, end - begin)
        for channel in range(channels):
            mirror = channel ^ 1 if channels > 1 else channel
            target = columns[channel, row[codes.OFFLINE_TARGET]]
            if code == codes.LEAF:
                # element by element: what says that two slices differ in length takes seconds to compile
                for k in range(begin, end):
                    target[k] = leaves[channel, row[1], k]
                continue
            source = columns[channel, row[1]]
            if past < codes.ONCE:
                _run_boolean(row, columns, channel, mirror, target, begin, end)
            elif past <= codes.SINCE:
                _run_past(past, source, columns[channel, row[2]], target, steps)
            elif past == codes.DELAY:
                _run_delay(source, target, steps, row[3], row[4], row[5] * np.inf)
            else:
                sign = 1.0 if past == codes.WINDOW_MAX else -1.0
                _slide(source, target, steps, row[3], row[4], row[5], sign, extrema)


@kernel
def run_windows(
    rows: Integers, leaves: Floats, stamps: Integers, starts: Integers, columns: Floats, extrema: Floats,
    result: Floats,
) -> None:  # fmt: skip
    """Compute the first columns at the start of a window that ends at each sample, on its samples alone.

    Args:
        starts: (T,), the first sample of each window.
        result: (C, N, T).
    """
    for t in range(len(stamps)):
        run_offline(rows, leaves, stamps, starts[t], t + 1, columns, extrema)
        for channel in range(leaves.shape[0]):
            for n in range(result.shape[1]):
                result[channel, n, t] = columns[channel, n, starts[t]]
