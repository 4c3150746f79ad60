"""Signals and tables: the nodes of a formula without windows into the future.

A signal is a subformula without future operators. Its robustness at a sample is final once that sample has
come, so it is computed once, forwards, with a little state for past operators.

A table is the value of a formula at the first sample as a function of later values. Let x_1 … x_m be the
values of a part's unbounded temporal subformulas at the next sample. In negation normal form, the part's
value is a monotone lattice polynomial of x_1 … x_m (minima and maxima only). The polynomial is determined by
its values at the corners x in {-inf, +inf}^m. These 2^m numbers are the table.

A new sample replaces each x_j by its expansion (max(psi, min(phi, x)) for an until), and reads the old table
at that point. The first and the last entry bound the value over every continuation. The corner with strong
operators at -inf and weak operators at +inf is the value if the run ends here.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes

# columns of a sliding window's ring: number of positions that left the ring, number of positions that entered
# it, the next position to enter, then the positions that can still attain the extremum
HEAD, TAIL, ENTERING, RING = range(4)


@inlined
def _delay_place(times: Integers, unit: int, place: int, distance: int) -> int:
    """Return the last place that is at least `distance` before `place`; negative without such a place.

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
    """Return the distance from a place to a later place, in the unit of a window."""
    return later - place if unit == codes.SAMPLES else times[0, later] - times[0, place]


@piece
def _slide(
    rows: Integers, row: int, history: Floats, channel: int, target: int, times: Integers, offset: int,
    begin: int, count: int,
) -> None:  # fmt: skip
    """Compute an extremum over a sliding window.

    The ring is a monotonic queue: it holds the positions that can still attain the extremum.

    Args:
        row: row of the window in `rows`.
        target: row of the window in the history.
        times: times of the recent samples, then the rings.
        offset: position in the run of place 0 of the history.
        begin, count: first place, and number of places, to compute.
    """
    operand, unit = rows[row, codes.SIGNAL_A], rows[row, codes.SIGNAL_UNIT]
    near_distance, far_distance = rows[row, codes.SIGNAL_LOW], rows[row, codes.SIGNAL_HIGH]
    sign = 1.0 if rows[row, codes.SIGNAL_CODE] == codes.WINDOW_MAX else -1.0
    ring_row, ring_size = 1 + 4 * rows[row, codes.SIGNAL_WINDOW] + channel, times.shape[1] - RING
    head, tail, entering_position = times[ring_row, HEAD], times[ring_row, TAIL], times[ring_row, ENTERING]
    for place in range(begin, begin + count):
        while (
            entering_position <= offset + place
            and _distance(times, unit, entering_position - offset, place) >= near_distance
        ):
            operand_number = sign * history[channel, operand, entering_position - offset]
            while tail > head:
                newest_place = times[ring_row, RING + (tail - 1) % ring_size] - offset
                if sign * history[channel, operand, newest_place] > operand_number:
                    break
                tail -= 1
            times[ring_row, RING + tail % ring_size] = entering_position
            tail += 1
            entering_position += 1
        oldest_place = 0
        while tail > head:
            oldest_place = times[ring_row, RING + head % ring_size] - offset
            # a negative place was dropped from the history, because no window reaches so far back
            if oldest_place >= 0 and _distance(times, unit, oldest_place, place) <= far_distance:
                break
            head += 1
        history[channel, target, place] = (
            history[channel, operand, oldest_place] if tail > head else -sign * np.inf
        )
    times[ring_row, HEAD], times[ring_row, TAIL], times[ring_row, ENTERING] = head, tail, entering_position


@piece
def run_signals(
    rows: Integers, leaves: Floats, first_leaf: int, t: int, count: int, position: int, begin: int,
    start_ns: int, history: Floats, times: Integers, memory: Floats,
) -> None:  # fmt: skip
    """Compute the signals at samples t … t + count - 1 of `leaves`, in every channel, into the history.

    Args:
        first_leaf: index of the program's first leaf in `leaves`.
        position: index of sample t in the run.
        begin: place of sample t in the history.
        times: times of the recent samples, then a ring for each sliding window and channel.
        memory: (4, …), every signal at the last sample, then at the first sample, by channel.
    """
    offset, channel_count, signal_count, end = (
        position - begin,
        leaves.shape[0],
        rows[0, codes.HEAD_SIGNALS],
        begin + count,
    )
    for signal in range(signal_count):
        row = rows[0, codes.HEAD_SIGNALS_AT] + signal
        code, first_operand, second_operand = (
            rows[row, codes.SIGNAL_CODE],
            rows[row, codes.SIGNAL_A],
            rows[row, codes.SIGNAL_B],
        )
        unit, low_entry, high_entry = (
            rows[row, codes.SIGNAL_UNIT],
            rows[row, codes.SIGNAL_LOW],
            rows[row, codes.SIGNAL_HIGH],
        )
        for channel in range(channel_count):
            if code == codes.LEAF:
                for step in range(count):
                    history[channel, signal, begin + step] = leaves[
                        channel, first_leaf + first_operand, t + step
                    ]
            elif code == codes.CONSTANT:
                for place in range(begin, end):
                    history[channel, signal, place] = low_entry * np.inf
            elif code == codes.NOT:
                mirror_channel = channel ^ 1 if channel_count > 1 else channel
                for place in range(begin, end):
                    history[channel, signal, place] = -history[mirror_channel, first_operand, place]
            elif code == codes.AND:
                for place in range(begin, end):
                    history[channel, signal, place] = min(
                        history[channel, first_operand, place], history[channel, second_operand, place]
                    )
            elif code == codes.OR:
                for place in range(begin, end):
                    history[channel, signal, place] = max(
                        history[channel, first_operand, place], history[channel, second_operand, place]
                    )
            elif code in (codes.ONCE, codes.HISTORICALLY, codes.SINCE):
                value = memory[channel, signal]
                if position == 0:
                    value = np.inf if code == codes.HISTORICALLY else -np.inf
                for place in range(begin, end):
                    value = past_value(
                        code,
                        history[channel, first_operand, place],
                        history[channel, second_operand, place],
                        value,
                    )
                    history[channel, signal, place] = value
            elif code == codes.DELAY:
                for place in range(begin, end):
                    delayed_place = _delay_place(times, unit, place, low_entry)
                    history[channel, signal, place] = (
                        history[channel, first_operand, delayed_place]
                        if delayed_place >= 0
                        else high_entry * np.inf
                    )
            elif code == codes.ELAPSED:
                for place in range(begin, end):
                    distance = offset + place if unit == codes.SAMPLES else times[0, place] - start_ns
                    history[channel, signal, place] = high_entry * (
                        np.inf if distance >= low_entry else -np.inf
                    )
            else:
                _slide(rows, row, history, channel, signal, times, offset, begin, count)
            memory[channel, signal] = history[channel, signal, end - 1]
            if position == 0:
                memory[channel, signal_count + signal] = history[channel, signal, begin]


# work rows of a part: one row for each node, then `VALUES`, `FRESH` and `POINT`, then the part's results
VALUES, FRESH, POINT, RESULTS = range(4)
EXTRA_ROWS = 6


@inlined
def read_table(tables: Floats, row: int, first: int, variables: int, points: Floats, point: int) -> float:
    """Read a table at a point by a walk over its corners, in descending order of the point's coordinates.

    Args:
        tables, row, first: array, row and column of the table's begin.
        points, point: array and row of the point.
    """
    # a monotone lattice polynomial is the maximum over the chain of corners of min(coordinate, entry)
    value, corner = tables[row, first], 0
    for _ in range(variables):
        greatest_variable = -1
        for variable in range(variables):
            if not corner >> variable & 1 and (
                greatest_variable < 0 or points[point, variable] > points[point, greatest_variable]
            ):
                greatest_variable = variable
        corner |= 1 << greatest_variable
        value = max(value, min(points[point, greatest_variable], tables[row, first + corner]))
    return float(value)


@inlined
def _start(
    rows: Integers, first_row: int, end_row: int, corner_count: int, memory: Floats, channel: int, table: int,
    work: Floats, values_row: int,
) -> None:  # fmt: skip
    """Fill the table before the first sample: each operator equals its value at the next sample."""
    for corner in range(corner_count):
        for node in range(end_row - first_row):
            variable, left_node, right_node = (
                rows[first_row + node, codes.NODE_VARIABLE],
                rows[first_row + node, codes.NODE_A],
                0,
            )
            if variable >= 0:
                work[values_row, node] = np.inf if corner >> variable & 1 else -np.inf
            elif rows[first_row + node, codes.NODE_CODE] == codes.PART_OR:
                right_node = rows[first_row + node, codes.NODE_B]
                work[values_row, node] = max(work[values_row, left_node], work[values_row, right_node])
        memory[channel, table + corner] = work[values_row, end_row - 1 - first_row]


@inlined
def _fill_columns(
    rows: Integers, first_row: int, end_row: int, history: Floats, channel: int, begin: int, count: int,
    work: Floats, top: int,
) -> None:  # fmt: skip
    """Compute the nodes that depend on no variable, at `count` samples."""
    for node in range(end_row - first_row):
        row, target_row = first_row + node, top + node
        code, first_entry, second_row = (
            rows[row, codes.NODE_CODE],
            rows[row, codes.NODE_A],
            top + rows[row, codes.NODE_B],
        )
        if code == codes.LITERAL:
            for sample in range(count):
                work[target_row, sample] = history[channel, first_entry, begin + sample]
        elif not rows[row, codes.NODE_DEPENDS]:
            if code == codes.PART_AND:
                for sample in range(count):
                    work[target_row, sample] = min(work[top + first_entry, sample], work[second_row, sample])
            elif code == codes.PART_OR:
                for sample in range(count):
                    work[target_row, sample] = max(work[top + first_entry, sample], work[second_row, sample])


@inlined
def _run_simple(
    rows: Integers, root: int, end_corner: int, memory: Floats, channel: int, table: int, work: Floats,
    top: int, first_result: int, count: int,
) -> None:  # fmt: skip
    """Run a part that is a single until or release, with a table of two numbers."""
    lower_bound, upper_bound = memory[channel, table], memory[channel, table + 1]
    has_left, left_node, right_node = (
        rows[root, codes.NODE_A] >= 0,
        rows[root, codes.NODE_A],
        rows[root, codes.NODE_B],
    )
    is_until = rows[root, codes.NODE_CODE] == codes.UNTIL
    for sample in range(count):
        right_number = work[top + right_node, sample]
        # the value of the root if its next value is -inf, and if it is +inf
        if is_until:
            least_value, greatest_value = (
                right_number,
                max(right_number, work[top + left_node, sample]) if has_left else np.inf,
            )
        else:
            least_value, greatest_value = (
                min(right_number, work[top + left_node, sample]) if has_left else -np.inf,
                right_number,
            )
        lower_bound, upper_bound = (
            max(lower_bound, min(least_value, upper_bound)),
            max(lower_bound, min(greatest_value, upper_bound)),
        )
        work[first_result + 1, sample], work[first_result + 2, sample] = lower_bound, upper_bound
        work[first_result, sample] = upper_bound if end_corner else lower_bound
    memory[channel, table], memory[channel, table + 1] = lower_bound, upper_bound


@piece
def run_table(
    rows: Integers, part: int, history: Floats, channel: int, memory: Floats, table: int, work: Floats,
    top: int, position: int, begin: int, count: int,
) -> int:  # fmt: skip
    """Substitute samples into the table of a part without windows, in one channel.

    Args:
        part: row of the part.
        table: begin of the part's table in the `memory` of the channel.
        top: first free row of `work`.
        position: index of the first sample in the run.
        begin: place of the same sample in the history.
        count: number of samples.

    Returns:
        the row of `work` with the part's value. The rows of its lower and its upper bound follow.
    """
    first_row, end_row = rows[part, codes.PART_FIRST], rows[part, codes.PART_END]
    variable_count, end_corner = rows[part, codes.PART_VARIABLES], rows[part, codes.PART_END_CORNER]
    node_count, corner_count, root_code = (
        end_row - first_row,
        1 << variable_count,
        rows[end_row - 1, codes.NODE_CODE],
    )
    values_row, fresh_row, point_row, first_result = (
        top + node_count + VALUES,
        top + node_count + FRESH,
        top + node_count + POINT,
        top + node_count + RESULTS,
    )
    if position == 0:
        _start(rows, first_row, end_row, corner_count, memory, channel, table, work, values_row)
    elif memory[channel, table] == memory[channel, table + corner_count - 1]:
        # the extreme corners are equal, so no later sample can change the value
        for sample in range(count):
            work[first_result, sample] = work[first_result + 1, sample] = work[first_result + 2, sample] = (
                memory[channel, table]
            )
        return int(first_result)
    _fill_columns(rows, first_row, end_row, history, channel, begin, count, work, top)
    if variable_count == 1 and root_code in (codes.UNTIL, codes.RELEASE):
        _run_simple(rows, end_row - 1, end_corner, memory, channel, table, work, top, first_result, count)
        return int(first_result)
    for sample in range(count):
        for node in range(node_count):
            # a node that depends on no variable has one value for all corners
            if not rows[first_row + node, codes.NODE_DEPENDS]:
                work[values_row, node] = work[top + node, sample]
        for corner in range(corner_count):
            for row in range(first_row, end_row):
                if not rows[row, codes.NODE_DEPENDS]:
                    continue
                code, left_node, right_node = (
                    rows[row, codes.NODE_CODE],
                    rows[row, codes.NODE_A],
                    rows[row, codes.NODE_B],
                )
                if code == codes.PART_AND:
                    value = min(work[values_row, left_node], work[values_row, right_node])
                elif code == codes.PART_OR:
                    value = max(work[values_row, left_node], work[values_row, right_node])
                else:
                    variable, is_until = rows[row, codes.NODE_VARIABLE], code == codes.UNTIL
                    value = np.inf if corner >> variable & 1 else -np.inf
                    if left_node >= 0:
                        value = (
                            min(work[values_row, left_node], value)
                            if is_until
                            else max(work[values_row, left_node], value)
                        )
                    value = (
                        max(work[values_row, right_node], value)
                        if is_until
                        else min(work[values_row, right_node], value)
                    )
                    work[point_row, variable] = value
                work[values_row, row - first_row] = value
            work[fresh_row, corner] = read_table(memory, channel, table, variable_count, work, point_row)
        for corner in range(corner_count):
            memory[channel, table + corner] = work[fresh_row, corner]
        work[first_result, sample] = memory[channel, table + end_corner]
        work[first_result + 1, sample], work[first_result + 2, sample] = (
            memory[channel, table],
            memory[channel, table + corner_count - 1],
        )
    return int(first_result)
