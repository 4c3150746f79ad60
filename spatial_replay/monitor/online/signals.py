"""Signals and tables: the nodes of a formula without windows into the future.

A signal is a subformula without future operators. Its robustness at a sample is final once that sample has
come. So it is computed once, forwards, with a little state for past operators.

A table is the value of a formula at the first sample as a function of later values. Let x_1 … x_m be the
values of a part's unbounded temporal subformulas at the next sample. In negation normal form, the part's
value is a monotone lattice polynomial of them (minima and maxima only). Its values at the corners x in
{-inf, +inf}^m determine it: they are its table of 2^m numbers.

A new sample replaces each x_j by its expansion (max(psi, min(phi, x)) for an until), and reads the old table
at that point. The first and the last entry bound the value over every continuation. The corner with strong
operators at -inf and weak ones at +inf is the value if the run ends here.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes

# columns of a sliding window's ring: numbers of positions that have left and entered it, the next position to
# enter, then the positions that can still attain the extremum
HEAD, TAIL, ENTERING, RING = range(4)


@inlined
def _delay_place(times: Integers, unit: int, place: int, distance: int) -> int:
    """Return the last place that is at least `distance` before `place`; negative if there is none.

    Times are compared by their differences, because a time plus the distance could exceed 64 bits.
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
    """Return the value of an unbounded O, H or S at a sample, given its value at the previous sample."""
    if code == codes.ONCE:
        return max(first, before)
    if code == codes.HISTORICALLY:
        return min(first, before)
    return max(second, min(first, before))


@inlined
def _distance(times: Integers, unit: int, place: int, later: int) -> int:
    """Return the distance from a place to a later one, in the unit of a window."""
    return later - place if unit == codes.SAMPLES else times[0, later] - times[0, place]


@piece
def _slide(
    rows: Integers, row: int, history: Floats, channel: int, target: int, times: Integers, offset: int,
    begin: int, count: int,
) -> None:  # fmt: skip
    """Compute an extremum over a sliding window.

    The ring is a monotonic queue: it holds the positions that can still attain the extremum.
    """
    operand, unit = rows[row, codes.SIGNAL_A], rows[row, codes.SIGNAL_UNIT]
    near, far = rows[row, codes.SIGNAL_LOW], rows[row, codes.SIGNAL_HIGH]
    sign = 1.0 if rows[row, codes.SIGNAL_CODE] == codes.WINDOW_MAX else -1.0
    ring, size = 1 + 4 * rows[row, codes.SIGNAL_WINDOW] + channel, times.shape[1] - RING
    head, tail, entering = times[ring, HEAD], times[ring, TAIL], times[ring, ENTERING]
    for place in range(begin, begin + count):
        while entering <= offset + place and _distance(times, unit, entering - offset, place) >= near:
            number = sign * history[channel, operand, entering - offset]
            while tail > head:
                newest = times[ring, RING + (tail - 1) % size] - offset
                if sign * history[channel, operand, newest] > number:
                    break
                tail -= 1
            times[ring, RING + tail % size] = entering
            tail += 1
            entering += 1
        oldest = 0
        while tail > head:
            oldest = times[ring, RING + head % size] - offset
            # a negative place was dropped from the history: it is further back than any window reaches
            if oldest >= 0 and _distance(times, unit, oldest, place) <= far:
                break
            head += 1
        history[channel, target, place] = history[channel, operand, oldest] if tail > head else -sign * np.inf
    times[ring, HEAD], times[ring, TAIL], times[ring, ENTERING] = head, tail, entering


@piece
def run_signals(
    rows: Integers, leaves: Floats, first_leaf: int, t: int, count: int, position: int, begin: int,
    start_ns: int, history: Floats, times: Integers, memory: Floats,
) -> None:  # fmt: skip
    """Compute the signals at samples t … t + count - 1 of `leaves`, in every channel, into the history.

    Args:
        first_leaf: index of the program's first leaf in `leaves`.
        position: number of the first of these samples in the run; its place in the history is `begin`.
        times: times of the recent samples, then a ring for each sliding window and channel.
        memory: (4, …), every signal at the last sample, then at the first sample, by channel.
    """
    offset, channels, signal_count, end = (
        position - begin,
        leaves.shape[0],
        rows[0, codes.HEAD_SIGNALS],
        begin + count,
    )
    for s in range(signal_count):
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
                    place = _delay_place(times, unit, k, low)
                    history[c, s, k] = history[c, a, place] if place >= 0 else high * np.inf
            elif code == codes.ELAPSED:
                for k in range(begin, end):
                    distance = offset + k if unit == codes.SAMPLES else times[0, k] - start_ns
                    history[c, s, k] = high * (np.inf if distance >= low else -np.inf)
            else:
                _slide(rows, row, history, c, s, times, offset, begin, count)
            memory[c, s] = history[c, s, end - 1]
            if position == 0:
                memory[c, signal_count + s] = history[c, s, begin]


# work rows of a part, after one row for each of its nodes; its results follow
VALUES, FRESH, POINT, RESULTS = range(4)
EXTRA_ROWS = 6


@inlined
def read_table(tables: Floats, row: int, first: int, variables: int, points: Floats, point: int) -> float:
    """Read a table at a point: walk its corners in descending order of the coordinates.

    Args:
        tables, row, first: array, row and column of the table's begin.
        points, point: array and row of the point.
    """
    # a monotone lattice polynomial is the maximum over the chain of corners of min(coordinate, entry)
    value, corner = tables[row, first], 0
    for _ in range(variables):
        greatest = -1
        for j in range(variables):
            if not corner >> j & 1 and (greatest < 0 or points[point, j] > points[point, greatest]):
                greatest = j
        corner |= 1 << greatest
        value = max(value, min(points[point, greatest], tables[row, first + corner]))
    return float(value)


@inlined
def _start(
    rows: Integers, first: int, end: int, corners: int, memory: Floats, channel: int, table: int,
    work: Floats, values: int,
) -> None:  # fmt: skip
    """Fill the table before the first sample: each operator equals its value at the next sample."""
    for corner in range(corners):
        for d in range(end - first):
            variable, a, b = rows[first + d, codes.NODE_VARIABLE], rows[first + d, codes.NODE_A], 0
            if variable >= 0:
                work[values, d] = np.inf if corner >> variable & 1 else -np.inf
            elif rows[first + d, codes.NODE_CODE] == codes.PART_OR:
                b = rows[first + d, codes.NODE_B]
                work[values, d] = max(work[values, a], work[values, b])
        memory[channel, table + corner] = work[values, end - 1 - first]


@inlined
def _fill_columns(
    rows: Integers, first: int, end: int, history: Floats, channel: int, begin: int, count: int,
    work: Floats, top: int,
) -> None:  # fmt: skip
    """Compute the nodes that depend on no variable, at `count` samples."""
    for d in range(end - first):
        row, target = first + d, top + d
        code, a, b = rows[row, codes.NODE_CODE], rows[row, codes.NODE_A], top + rows[row, codes.NODE_B]
        if code == codes.LITERAL:
            for k in range(count):
                work[target, k] = history[channel, a, begin + k]
        elif not rows[row, codes.NODE_DEPENDS]:
            if code == codes.PART_AND:
                for k in range(count):
                    work[target, k] = min(work[top + a, k], work[b, k])
            elif code == codes.PART_OR:
                for k in range(count):
                    work[target, k] = max(work[top + a, k], work[b, k])


@inlined
def _run_simple(
    rows: Integers, root: int, end_corner: int, memory: Floats, channel: int, table: int, work: Floats,
    top: int, first_result: int, count: int,
) -> None:  # fmt: skip
    """Run a part that is a single until or release, with a table of two numbers."""
    low, high = memory[channel, table], memory[channel, table + 1]
    has_left, a, b = rows[root, codes.NODE_A] >= 0, rows[root, codes.NODE_A], rows[root, codes.NODE_B]
    is_until = rows[root, codes.NODE_CODE] == codes.UNTIL
    for k in range(count):
        right = work[top + b, k]
        # the value of the root if its next value is -inf, and if it is +inf
        if is_until:
            least, most = right, max(right, work[top + a, k]) if has_left else np.inf
        else:
            least, most = min(right, work[top + a, k]) if has_left else -np.inf, right
        low, high = max(low, min(least, high)), max(low, min(most, high))
        work[first_result + 1, k], work[first_result + 2, k] = low, high
        work[first_result, k] = high if end_corner else low
    memory[channel, table], memory[channel, table + 1] = low, high


@piece
def run_table(
    rows: Integers, part: int, history: Floats, channel: int, memory: Floats, table: int, work: Floats,
    top: int, position: int, begin: int, count: int,
) -> int:  # fmt: skip
    """Substitute samples into the table of a part without windows, in one channel.

    Args:
        part: row of the part.
        table: begin of its table in the `memory` of the channel.
        top: first free row of `work`.
        position: number of the first of the `count` samples; its place in the history is `begin`.

    Returns:
        the row of `work` with its value; the rows of its lower and upper bound follow.
    """
    first, end = rows[part, codes.PART_FIRST], rows[part, codes.PART_END]
    variables, end_corner = rows[part, codes.PART_VARIABLES], rows[part, codes.PART_END_CORNER]
    nodes, corners, root = end - first, 1 << variables, rows[end - 1, codes.NODE_CODE]
    values, fresh, point, first_result = (
        top + nodes + VALUES,
        top + nodes + FRESH,
        top + nodes + POINT,
        top + nodes + RESULTS,
    )
    if position == 0:
        _start(rows, first, end, corners, memory, channel, table, work, values)
    elif memory[channel, table] == memory[channel, table + corners - 1]:
        # the extreme corners agree: no later sample can change the value
        for k in range(count):
            work[first_result, k] = work[first_result + 1, k] = work[first_result + 2, k] = memory[
                channel, table
            ]
        return int(first_result)
    _fill_columns(rows, first, end, history, channel, begin, count, work, top)
    if variables == 1 and root in (codes.UNTIL, codes.RELEASE):
        _run_simple(rows, end - 1, end_corner, memory, channel, table, work, top, first_result, count)
        return int(first_result)
    for k in range(count):
        for d in range(nodes):
            # a node that depends on no variable has one value for all corners
            if not rows[first + d, codes.NODE_DEPENDS]:
                work[values, d] = work[top + d, k]
        for corner in range(corners):
            for row in range(first, end):
                if not rows[row, codes.NODE_DEPENDS]:
                    continue
                code, a, b = rows[row, codes.NODE_CODE], rows[row, codes.NODE_A], rows[row, codes.NODE_B]
                if code == codes.PART_AND:
                    value = min(work[values, a], work[values, b])
                elif code == codes.PART_OR:
                    value = max(work[values, a], work[values, b])
                else:
                    variable, is_until = rows[row, codes.NODE_VARIABLE], code == codes.UNTIL
                    value = np.inf if corner >> variable & 1 else -np.inf
                    if a >= 0:
                        value = min(work[values, a], value) if is_until else max(work[values, a], value)
                    value = max(work[values, b], value) if is_until else min(work[values, b], value)
                    work[point, variable] = value
                work[values, row - first] = value
            work[fresh, corner] = read_table(memory, channel, table, variables, work, point)
        for corner in range(corners):
            memory[channel, table + corner] = work[fresh, corner]
        work[first_result, k] = memory[channel, table + end_corner]
        work[first_result + 1, k], work[first_result + 2, k] = (
            memory[channel, table],
            memory[channel, table + corners - 1],
        )
    return int(first_result)
