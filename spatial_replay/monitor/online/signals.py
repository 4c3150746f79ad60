"""Signals: subformulas without future operators.

Their robustness is final with its sample. So it is computed forwards, once, with a little state for past
operators.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.state import START_NS, Memory, behind, past_value


@uncounted
def step_signals(
    signals: Integers, leaves: Floats, t: int, count: int, position: int, begin: int, memory: Memory
) -> None:
    """Add all signals over the samples t … t + count - 1 of `leaves`, in every channel, to the history.

    Args:
        position: of the first of these samples in the run; it stands at `begin` in the history.
    """  # fmt: skip
    offset = position - begin
    history, stamps, running, wedge_next = memory.history, memory.stamps, memory.running, memory.wedge_next
    channels = leaves.shape[0]
    for s in range(signals.shape[0]):
        code, a, b = signals[s, 0], signals[s, 1], signals[s, 2]
        for channel in range(channels):
            mirror = channel ^ 1 if channels > 1 else channel
            target = history[channel, s, begin : begin + count]
            first = history[channel, a, begin : begin + count]
            second = history[channel, b, begin : begin + count]
            if code == codes.LEAF:
                # sliced, so that the compiler sees that the numbers stand side by side
                leaf = leaves[channel, a, t : t + count]
                for k in range(count):
                    target[k] = leaf[k]
            elif code == codes.CONSTANT:
                for k in range(count):
                    target[k] = signals[s, 4] * np.inf
            elif code == codes.NOT:
                opposite = history[mirror, a, begin : begin + count]
                for k in range(count):
                    target[k] = -opposite[k]
            elif code == codes.AND:
                for k in range(count):
                    target[k] = min(first[k], second[k])
            elif code == codes.OR:
                for k in range(count):
                    target[k] = max(first[k], second[k])
            elif code in (codes.ONCE, codes.HISTORICALLY, codes.SINCE):
                _run_past(code, first, second, target, running[channel, s], position == 0)
            elif code == codes.DELAY:
                for k in range(count):
                    source = behind(stamps, offset, position + k, signals[s, 3], signals[s, 4])
                    if source >= offset:
                        target[k] = history[channel, a, source - offset]
                    else:
                        target[k] = signals[s, 5] * np.inf
            elif code == codes.ELAPSED:
                for k in range(count):
                    distance = position + k
                    if signals[s, 3] != codes.SAMPLES:
                        distance = stamps[distance - offset] - memory.clock[START_NS]
                    target[k] = signals[s, 5] * (np.inf if distance >= signals[s, 4] else -np.inf)
            else:
                _slide(
                    signals[s], history[channel, a], target, position, offset, count, stamps,
                    memory.wedges[signals[s, 6], channel], memory.wedge_ends[signals[s, 6], channel],
                    wedge_next[signals[s, 6]],
                )  # fmt: skip
            running[channel, s] = target[count - 1]
            if position == 0:
                memory.firsts[channel, s] = target[0]
        if code in (codes.WINDOW_MAX, codes.WINDOW_MIN):
            newest = behind(stamps, offset, position + count - 1, signals[s, 3], signals[s, 4])
            wedge_next[signals[s, 6]] = max(wedge_next[signals[s, 6]], newest + 1)


@uncounted
def _run_past(code: int, first: Floats, second: Floats, target: Floats, before: float, starts: bool) -> None:
    """Run an unbounded once, historically or since, from its value at the previous sample."""
    value = before
    if starts:
        value = np.inf if code == codes.HISTORICALLY else -np.inf
    for k in range(len(target)):
        value = past_value(code, first[k], second[k], value)
        target[k] = value


@uncounted
def _slide(
    signal: Integers,
    source: Floats,
    target: Floats,
    position: int,
    offset: int,
    count: int,
    stamps: Integers,
    wedge: Integers,
    ends: Integers,
    entering: int,
) -> None:
    """Compute an extremum over a sliding window, with a wedge of the positions that can still attain it.

    The wedge is a ring; `ends` counts the positions that ever left and entered it.
    """  # fmt: skip
    unit, near, far = signal[3], signal[4], signal[5]
    sign = 1.0 if signal[0] == codes.WINDOW_MAX else -1.0
    size = wedge.shape[0]
    head, tail = ends[0], ends[1]
    for k in range(count):
        here = position + k
        while entering <= here and _apart(stamps, offset, unit, entering, here) >= near:
            tail = _push(wedge, head, tail, sign, source, offset, entering)
            entering += 1
        # what is forgotten is farther than any window reaches
        while tail > head and (
            wedge[head % size] < offset or _apart(stamps, offset, unit, wedge[head % size], here) > far
        ):
            head += 1
        target[k] = source[wedge[head % size] - offset] if tail > head else -sign * np.inf
    ends[0], ends[1] = head, tail


@inlined
def _apart(stamps: Integers, offset: int, unit: int, position: int, later: int) -> int:
    """Return how far a position is ahead of another, in the unit of a window."""
    return later - position if unit == codes.SAMPLES else stamps[later - offset] - stamps[position - offset]


@inlined
def _push(
    wedge: Integers, head: int, tail: int, sign: float, source: Floats, offset: int, position: int
) -> int:
    """Push a position onto a wedge of the greatest numbers, or for -1 of the least; return its new end."""
    size, number = wedge.shape[0], sign * source[position - offset]
    while tail > head and sign * source[wedge[(tail - 1) % size] - offset] <= number:
        tail -= 1
    wedge[tail % size] = position
    return tail + 1
