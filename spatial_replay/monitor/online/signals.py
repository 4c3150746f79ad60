"""Signals: subformulas without future operators.

Their robustness is final with its sample. So it is computed forwards, once, with a little state for past
operators.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes

# columns of a sliding window's ring: how many positions ever left and entered it, the next one to enter, and
# then the positions that can still attain its extremum
HEAD, TAIL, ENTERING, RING = range(4)


@inlined
def _delayed(times: Integers, unit: int, place: int, distance: int) -> int:
    """Return the last place at least a distance behind another; a negative one if there is none.

    Times are compared by their differences, which fit where a time plus the distance might not.
    """
    if unit == codes.SAMPLES:
        return place - distance
    low, high = 0, place + 1
    while low < high:
        middle = (low + high) >> 1
        if times[0, place] - times[0, middle] >= distance:
            low = middle + 1
        else:
            high = middle
    return low - 1


@inlined
def past_value(code: int, first: float, second: float, before: float) -> float:
    """Return an unbounded once, historically or since at a sample, from its value at the one before."""
    if code == codes.ONCE:
        return max(first, before)
    if code == codes.HISTORICALLY:
        return min(first, before)
    return max(second, min(first, before))


@inlined
def _distance(times: Integers, unit: int, place: int, later: int) -> int:
    """Return how far a place is ahead of another, in the unit of a window."""
    return later - place if unit == codes.SAMPLES else times[0, later] - times[0, place]


@piece
def _slide(
    rows: Integers, row: int, history: Floats, channel: int, own: int, times: Integers, offset: int,
    begin: int, count: int,
) -> None:  # fmt: skip
    """Compute an extremum over a sliding window, with a wedge of the positions that can still attain it."""
    a, unit = rows[row, codes.SIGNAL_A], rows[row, codes.SIGNAL_UNIT]
    near, far = rows[row, codes.SIGNAL_LOW], rows[row, codes.SIGNAL_HIGH]
    sign = 1.0 if rows[row, codes.SIGNAL_CODE] == codes.WINDOW_MAX else -1.0
    ring, size = 1 + 4 * rows[row, codes.SIGNAL_WINDOW] + channel, times.shape[1] - RING
    head, tail, entering = times[ring, HEAD], times[ring, TAIL], times[ring, ENTERING]
    for here in range(begin, begin + count):
        while entering <= offset + here and _distance(times, unit, entering - offset, here) >= near:
            number = sign * history[channel, a, entering - offset]
            while tail > head:
                newest = times[ring, RING + (tail - 1) % size] - offset
                if sign * history[channel, a, newest] > number:
                    break
                tail -= 1
            times[ring, RING + tail % size] = entering
            tail += 1
            entering += 1
        oldest = 0
        while tail > head:
            oldest = times[ring, RING + head % size] - offset
            # what is forgotten is farther than any window reaches
            if oldest >= 0 and _distance(times, unit, oldest, here) <= far:
                break
            head += 1
        history[channel, own, here] = history[channel, a, oldest] if tail > head else -sign * np.inf
    times[ring, HEAD], times[ring, TAIL], times[ring, ENTERING] = head, tail, entering


@piece
def run_signals(
    rows: Integers, leaves: Floats, first_leaf: int, t: int, count: int, position: int, begin: int,
    start_ns: int, history: Floats, times: Integers, memory: Floats,
) -> None:  # fmt: skip
    """Add signals over the samples t … t + count - 1 of `leaves`, in every channel, to the history.

    Args:
        first_leaf: where the leaves of these begin.
        position: of the first of these samples in the run; it stands at `begin` in the history.
        times: of the recent samples, and then a ring for each sliding window and channel.
        memory: (4, …), every signal at the last sample, and then at the first one, by channel.
    """
    offset, channels, number, end = (
        position - begin,
        leaves.shape[0],
        rows[0, codes.HEAD_SIGNALS],
        begin + count,
    )
    for s in range(number):
        row = rows[0, codes.HEAD_SIGNALS_AT] + s
        code, a, b = rows[row, codes.SIGNAL_CODE], rows[row, codes.SIGNAL_A], rows[row, codes.SIGNAL_B]
        unit, low, high = (
            rows[row, codes.SIGNAL_UNIT],
            rows[row, codes.SIGNAL_LOW],
            rows[row, codes.SIGNAL_HIGH],
        )
        for c in range(channels):
            if code == codes.LEAF:
                for k in range(count):
                    history[c, s, begin + k] = leaves[c, first_leaf + a, t + k]
            elif code == codes.CONSTANT:
                for k in range(begin, end):
                    history[c, s, k] = low * np.inf
            elif code == codes.NOT:
                opposite = c ^ 1 if channels > 1 else c
                for k in range(begin, end):
                    history[c, s, k] = -history[opposite, a, k]
            elif code == codes.AND:
                for k in range(begin, end):
                    history[c, s, k] = min(history[c, a, k], history[c, b, k])
            elif code == codes.OR:
                for k in range(begin, end):
                    history[c, s, k] = max(history[c, a, k], history[c, b, k])
            elif code in (codes.ONCE, codes.HISTORICALLY, codes.SINCE):
                value = memory[c, s]
                if position == 0:
                    value = np.inf if code == codes.HISTORICALLY else -np.inf
                for k in range(begin, end):
                    value = past_value(code, history[c, a, k], history[c, b, k], value)
                    history[c, s, k] = value
            elif code == codes.DELAY:
                for k in range(begin, end):
                    at = _delayed(times, unit, k, low)
                    history[c, s, k] = history[c, a, at] if at >= 0 else high * np.inf
            elif code == codes.ELAPSED:
                for k in range(begin, end):
                    elapsed = offset + k if unit == codes.SAMPLES else times[0, k] - start_ns
                    history[c, s, k] = high * (np.inf if elapsed >= low else -np.inf)
            else:
                _slide(rows, row, history, c, s, times, offset, begin, count)
            memory[c, s] = history[c, s, end - 1]
            if position == 0:
                memory[c, number + s] = history[c, s, begin]
