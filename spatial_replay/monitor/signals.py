"""Subformulas without future operators: settled at each sample, computed forwards."""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.codes import (
    AND,
    CONSTANT,
    DELAY,
    HISTORICALLY,
    IFF,
    LEAF,
    NOT,
    ONCE,
    OR,
    SINCE,
    WINDOW_MAX,
    WINDOW_MIN,
    XOR,
)
from spatial_replay.monitor.memory import Memory
from spatial_replay.monitor.positions import behind, first_behind


@piece
def step_signals(
    signals: Integers, leaves: Floats, t: int, count: int, position: int, offset: int, memory: Memory
) -> None:
    """All signals over the samples t … t + count - 1 of `leaves`, in every channel, into the history.

    Args:
        position: of the first of these samples in the run; it stands at position - offset in the history.
    """  # fmt: skip
    begin = position - offset
    history, stamps, running, wedge_next = memory.history, memory.stamps, memory.running, memory.wedge_next
    channels = leaves.shape[0]
    for s in range(signals.shape[0]):
        code, a, b = signals[s, 0], signals[s, 1], signals[s, 2]
        for channel in range(channels):
            mirror = channel ^ 1 if channels > 1 else channel
            target = history[channel, s, begin : begin + count]
            first = history[channel, a, begin : begin + count]
            second = history[channel, b, begin : begin + count]
            if code == LEAF:
                for k in range(count):
                    target[k] = leaves[channel, a, t + k]
            elif code == CONSTANT:
                for k in range(count):
                    target[k] = signals[s, 4] * np.inf
            elif code == NOT:
                for k in range(count):
                    target[k] = -history[mirror, a, begin + k]
            elif code == AND:
                for k in range(count):
                    target[k] = min(first[k], second[k])
            elif code == OR:
                for k in range(count):
                    target[k] = max(first[k], second[k])
            elif code == XOR:
                for k in range(count):
                    target[k] = max(
                        min(first[k], -history[mirror, b, begin + k]),
                        min(-history[mirror, a, begin + k], second[k]),
                    )
            elif code == IFF:
                for k in range(count):
                    target[k] = min(
                        max(-history[mirror, a, begin + k], second[k]),
                        max(-history[mirror, b, begin + k], first[k]),
                    )
            elif code in (ONCE, HISTORICALLY, SINCE):
                _run_past(code, first, second, target, running[channel, s], position == 0)
            elif code == DELAY:
                for k in range(count):
                    source = behind(stamps, offset, position + k, signals[s, 3], signals[s, 4])
                    if source >= offset:
                        target[k] = history[channel, a, source - offset]
                    else:
                        target[k] = signals[s, 5] * np.inf
            else:
                _slide(
                    signals[s], history[channel, a], target, position, offset, count, stamps,
                    memory.wedges[signals[s, 6], channel], memory.wedge_ends[signals[s, 6], channel],
                    wedge_next[signals[s, 6]],
                )  # fmt: skip
            running[channel, s] = target[count - 1]
            if position == 0:
                memory.firsts[channel, s] = target[0]
        if code in (WINDOW_MAX, WINDOW_MIN):
            newest = behind(stamps, offset, position + count - 1, signals[s, 3], signals[s, 4])
            wedge_next[signals[s, 6]] = max(wedge_next[signals[s, 6]], newest + 1)


@piece
def _run_past(code: int, first: Floats, second: Floats, target: Floats, before: float, starts: bool) -> None:
    """Unbounded once, historically and since, from their value at the sample before."""
    value = before
    if starts:
        value = np.inf if code == HISTORICALLY else -np.inf
    for k in range(len(target)):
        if code == ONCE:
            value = max(first[k], value)
        elif code == HISTORICALLY:
            value = min(first[k], value)
        else:
            value = max(second[k], min(first[k], value))
        target[k] = value


@piece
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
    """Extremum over a sliding window: a wedge of the positions whose values can still become it.

    The wedge is a ring; `ends` counts the positions that ever left and entered it.
    """  # fmt: skip
    sign = 1.0 if signal[0] == WINDOW_MAX else -1.0
    size = wedge.shape[0]
    head, tail = ends[0], ends[1]
    for k in range(count):
        newest = behind(stamps, offset, position + k, signal[3], signal[4])
        while entering <= newest:
            value = sign * source[entering - offset]
            while tail > head and sign * source[wedge[(tail - 1) % size] - offset] <= value:
                tail -= 1
            wedge[tail % size] = entering
            tail += 1
            entering += 1
        oldest = first_behind(stamps, offset, position + k, signal[3], signal[5])
        while tail > head and wedge[head % size] < oldest:
            head += 1
        target[k] = source[wedge[head % size] - offset] if tail > head else -sign * np.inf
    ends[0], ends[1] = head, tail
