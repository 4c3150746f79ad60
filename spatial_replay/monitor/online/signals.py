"""Signals: subformulas without future operators, and what clauses say of positions that are behind.

The robustness of a subformula without a future operator is final with its sample. So it is computed
forwards, once, with a little state for past operators; and so is what the clauses of a part are made of (see
`clauses`): the least or the greatest response of the positions up to the sample.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.state import START_NS, Memory, behind, is_closed, past_value


@inlined
def matters_no_more(signal: Integers, memory: Memory) -> bool:
    """Return whether a signal is run no more, since all that looked at it has settled."""
    cell = signal[codes.SIGNAL_SETTLED]
    return bool(cell >= 0 and memory.cells[cell])


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
        if matters_no_more(signals[s], memory):
            continue
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
            elif code in (codes.ARRIVED_MIN, codes.ARRIVED_MAX):
                _gather_arrived(signals[s], history[channel, a], target, position, offset, count, stamps)
            elif code in codes.BEGUN:
                ring = signals[s, 6]
                _gather_begun(
                    signals[s], history[channel, a], history[channel, b], target, position, offset, count,
                    stamps, memory.wedges[ring, channel], memory.heights[ring, channel],
                    memory.wedge_ends[ring, channel],
                )  # fmt: skip
            elif code in codes.CLOSED:
                ring = signals[s, 6]
                _gather_closed(
                    signals[s], history[channel, a], history[channel, b], target, position, offset, count,
                    stamps, memory.wedges[ring, channel], memory.wedge_ends[ring, channel],
                    running[channel, s], history[channel, s],
                )  # fmt: skip
            elif code in codes.CROSSING:
                ring = signals[s, 6]
                _find_crossing(
                    signals[s], history[channel, a], history[channel, b], target, position, offset, count,
                    stamps, memory.wedges[ring, channel], memory.wedge_ends[ring, channel],
                    memory.wedges[ring + 1, channel], memory.wedge_ends[ring + 1, channel],
                )  # fmt: skip
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
def _first_from(wedge: Integers, head: int, tail: int, position: int) -> int:
    """Return the first entry of a wedge that is not before a position."""
    while head < tail and wedge[head % wedge.shape[0]] < position:
        head += 1
    return head


@inlined
def _first_within(
    wedge: Integers, head: int, tail: int, at: int, unit: int, near: int, stamps: Integers, offset: int
) -> int:
    """Return the first entry of a wedge in the window ahead of a position, which is still open."""
    size, head = wedge.shape[0], _first_from(wedge, head, tail, at)
    while head < tail and _apart(stamps, offset, unit, at, wedge[head % size]) < near:
        head += 1
    return head


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


@uncounted
def _gather_arrived(
    signal: Integers, source: Floats, target: Floats, position: int, offset: int, count: int, stamps: Integers
) -> None:
    """Compute an extremum over the positions that have come to be a distance behind since the last sample."""
    unit, distance, is_least = signal[3], signal[4], signal[0] == codes.ARRIVED_MIN
    for k in range(count):
        here = position + k
        at = behind(stamps, offset, here, unit, distance)
        before = behind(stamps, offset, here - 1, unit, distance) if here > offset else offset - 1
        value = np.inf if is_least else -np.inf
        while at > before and at >= offset:
            number = source[at - offset]
            value = min(value, number) if is_least else max(value, number)
            at -= 1
        target[k] = value


@uncounted
def _gather_closed(
    signal: Integers, conditions: Floats, source: Floats, target: Floats, position: int, offset: int,
    count: int, stamps: Integers, wedge: Integers, state: Integers, before: float, by_position: Floats,
) -> None:  # fmt: skip
    """Compute the extremum of the responses of all positions whose window ahead has closed.

    The wedge is that of a sliding window, which moves on to the next position as soon as its window closes.

    Args:
        by_position: receives each response, where these are asked for one by one.
    """
    code, unit, near, far = signal[0], signal[3], signal[4], signal[5]
    is_least = code in (codes.CLOSED_MIN_OF_MAX, codes.CLOSED_MIN_OF_MIN)
    of_greatest = (codes.CLOSED_MIN_OF_MAX, codes.CLOSED_MAX_OF_MAX, codes.CLOSED_EACH_MAX)
    sign = 1.0 if code in of_greatest else -1.0
    size = wedge.shape[0]
    head, tail, asking, entering = state[0], state[1], state[2], state[3]
    value = before
    if position == 0:
        value = np.inf if is_least else -np.inf
    for k in range(count):
        last = position + k
        while asking <= last and is_closed(stamps, offset, last, asking, unit, far):
            # what lies before `asking` may be forgotten already
            head = _first_within(wedge, head, tail, asking, unit, near, stamps, offset)
            while entering <= last and _apart(stamps, offset, unit, asking, entering) <= far:
                if _apart(stamps, offset, unit, asking, entering) >= near:
                    tail = _push(wedge, head, tail, sign, source, offset, entering)
                entering += 1
            found = source[wedge[head % size] - offset] if tail > head else -sign * np.inf
            condition = conditions[asking - offset]
            if code == codes.CLOSED_EACH_MAX:
                by_position[asking - offset] = max(condition, found)
            elif code == codes.CLOSED_EACH_MIN:
                by_position[asking - offset] = min(condition, found)
            else:
                value = min(value, max(condition, found)) if is_least else max(value, min(condition, found))
            asking += 1
        if code not in codes.CLOSED_EACH:
            target[k] = value
    state[0], state[1], state[2], state[3] = head, tail, asking, entering


@uncounted
def _gather_begun(
    signal: Integers, conditions: Floats, source: Floats, target: Floats, position: int, offset: int,
    count: int, stamps: Integers, wedge: Integers, heights: Floats, state: Integers,
) -> None:  # fmt: skip
    """Compute the extremum of the responses of the positions whose window has begun and is still open.

    Positions for which the same number of `source` counts so far lie side by side: they make one segment,
    and a new number joins all those segments that it outdoes. So `wedge` holds the newest position of each
    segment, and `heights` its number, the extremum of its conditions, and that of all responses up to it.
    Positions that have closed may stay in a segment: what is found for them later never outdoes their
    own response, which `_gather_closed` holds.
    """  # fmt: skip
    unit, near, far = signal[3], signal[4], signal[5]
    is_least = signal[0] == codes.BEGUN_MIN
    sign = 1.0 if is_least else -1.0
    size = wedge.shape[0]
    bottom, top, asking = state[0], state[1], state[2]
    for k in range(count):
        last = position + k
        newest, condition = -1, sign * np.inf
        while asking <= last and _apart(stamps, offset, unit, asking, last) >= near:
            number = conditions[asking - offset]
            condition = min(condition, number) if is_least else max(condition, number)
            newest = asking
            asking += 1
        found = source[last - offset]
        while top > bottom and sign * found >= sign * heights[0, (top - 1) % size]:
            top -= 1
            number = heights[1, top % size]
            condition = min(condition, number) if is_least else max(condition, number)
            newest = max(newest, wedge[top % size])
        if newest >= 0:
            below = heights[2, (top - 1) % size] if top > bottom else sign * np.inf
            response = max(condition, found) if is_least else min(condition, found)
            wedge[top % size] = newest
            heights[0, top % size], heights[1, top % size] = found, condition
            heights[2, top % size] = min(below, response) if is_least else max(below, response)
            top += 1
        while top > bottom and is_closed(stamps, offset, last, wedge[bottom % size], unit, far):
            bottom += 1
        target[k] = heights[2, (top - 1) % size] if top > bottom else sign * np.inf
    state[0], state[1], state[2] = bottom, top, asking


@uncounted
def _find_crossing(
    signal: Integers, falling: Floats, rising: Floats, target: Floats, position: int, offset: int, count: int,
    stamps: Integers, of_falling: Integers, falling_ends: Integers, of_rising: Integers,
    rising_ends: Integers,
) -> None:  # fmt: skip
    """Compute the extremum, over open windows, of the greater of what falls and what rises with each sample.

    For `CROSSING_MIN`, that is the least of a window's `falling` and the greatest of its `rising` so far.
    The later a window begins, the greater is the one and the smaller the other. So the least of all is where
    they cross: with the first window in which `falling` is as great, or with the one before. Samples only
    ever move the crossing forward. `CROSSING_MAX` mirrors it.

    Each has a wedge of its own, without entries before the first open window, which may be forgotten.
    """
    unit, near, far = signal[3], signal[4], signal[5]
    sign, size = 1.0 if signal[0] == codes.CROSSING_MIN else -1.0, of_falling.shape[0]
    fell, fell_end, crossing, opened = falling_ends[0], falling_ends[1], falling_ends[2], falling_ends[3]
    rose, rose_end = rising_ends[0], rising_ends[1]
    for k in range(count):
        last = position + k
        while opened <= last and is_closed(stamps, offset, last, opened, unit, far):
            opened += 1
        crossing = max(crossing, opened)
        fell = _first_from(of_falling, fell, fell_end, opened)
        rose = _first_from(of_rising, rose, rose_end, opened)
        fell_end = _push(of_falling, fell, fell_end, -sign, falling, offset, last)
        rose_end = _push(of_rising, rose, rose_end, sign, rising, offset, last)
        value = sign * np.inf
        while crossing <= last and _apart(stamps, offset, unit, crossing, last) >= near:
            fell = _first_within(of_falling, fell, fell_end, crossing, unit, near, stamps, offset)
            entry = _first_within(of_rising, rose, rose_end, crossing, unit, near, stamps, offset)
            if crossing == opened:
                rose = entry  # no window before is open
            number = falling[of_falling[fell % size] - offset]
            if sign * number >= sign * rising[of_rising[entry % size] - offset]:
                value = number
                break
            rose = entry
            crossing += 1
        if crossing > opened:
            rose = _first_within(of_rising, rose, rose_end, crossing - 1, unit, near, stamps, offset)
            number = rising[of_rising[rose % size] - offset]
            value = min(value, number) if sign > 0 else max(value, number)
        target[k] = value
    falling_ends[0], falling_ends[1], falling_ends[2], falling_ends[3] = fell, fell_end, crossing, opened
    rising_ends[0], rising_ends[1] = rose, rose_end
