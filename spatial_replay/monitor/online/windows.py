"""Windows below unbounded operators: the nodes of a part at every position that is still open.

A part runs in one channel at a time. Each of its nodes has a row of numbers, its *column*, with one number
for each recent sample. A sample changes a column only where a window opens or closes with the sample, or
where an operand has changed. Columns are updated operands first. For each column, the changed positions are
stored.

Positions of the root whose windows have all closed are absorbed into a table (see `signals`). The *base* is
the first position of the root that is not absorbed. The table gives the root's value at the first sample. It
is a function of each variable's value at the variable's *boundary*, the first position beyond the table. If
the operand of a past operator looks ahead, the past operator has a table, too. This table gives the past
operator's value at one position, its *state*.

Columns exist in up to three sets: for a run that ends with the newest sample, for the lowest later values,
and for the highest later values. The *mode* of a set is `OPEN_END`, `OPEN_LOW` or `OPEN_HIGH`. Positions are
indices of the recent samples.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import inlined, kernel, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.signals import read_table

CLOSING = 16
"""Number of samples between two searches for closed positions."""
BLOCK = 64
"""Number of positions in a block of the root's operand. A block is joined again only after a change."""
STRIDE = 16
"""Number of positions that `_run_open` fills at once."""
_NEVER = 1 << 62
"""Position beyond all samples."""

SETS = 3
"""Number of sets of columns: `OPEN_END`, `OPEN_LOW` and `OPEN_HIGH`. The next set is for a table's corner."""
SEEN = SETS + 1
"""Index of the first set with copies of operands' columns, which windows compare with the new columns."""
EXTRA = SEEN + SETS
"""Number of sets of columns, before the extra rows."""
# rows after the columns of the nodes: joined blocks, work space of `_slide`, and the results of a part
JOINED, BEFORE, RESULTS = 0, SETS, SETS + 1
RESULT_NOW = 1
"""Result row of a part's value at the newest sample. The value at the first sample is in row 0."""
EXTRA_ROWS = SETS + 5

# rows of the state: HEAD has single numbers, and the other rows have one number for each node. The newest
# sample changed its own position, and the positions from CHANGED to before CHANGED_END. CHANGED_END is 0 if
# no earlier position changed
HEAD, LOWS, LOW, HIGH, PLAIN, CHANGED, CHANGED_END, BOUNDARY, STATE = range(9)
STARTS = 9  # two rows follow for each window in seconds: its first position, and its last position plus one
# columns of HEAD: number of dropped samples, the base, whether any position is absorbed, and the number of
# samples entered into windows in seconds
OFFSET, BASE, IS_BEGUN, ENTERED = range(4)
KNOWN = 4  # for each set, the newest sample in its columns
NEXT = KNOWN + SETS  # for each window in seconds, the next positions whose windows begin and close


@inlined
def better(is_greatest: bool, first: float, second: float) -> float:
    """Return the greater or the lesser of two numbers."""
    if is_greatest:
        return first if first > second else second
    return first if first < second else second


@inlined
def _outdoes(is_greatest: bool, value: float, rival: float) -> bool:
    return value > rival if is_greatest else value < rival


@inlined
def beyond(mode: int, weak: int) -> float:
    """Return the value of an open operator beyond the last sample."""
    if mode == codes.OPEN_END:
        return np.inf if weak else -np.inf
    return np.inf if mode == codes.OPEN_HIGH else -np.inf


@inlined
def extremum(is_greatest: bool, columns: Floats, row: int, begin: int, end: int, start: float) -> float:
    """Return the greatest or least of `start` and the numbers of a row from `begin` to before `end`.

    Eight chains run in parallel, because in a single chain, each step would wait for the previous step.
    """
    sign = 1.0 if is_greatest else -1.0
    v0 = v1 = v2 = v3 = v4 = v5 = v6 = v7 = sign * start
    # numba wraps negative indices around, so the loop is vectorised only if no index can be negative
    place = max(begin, 0)
    while place + 8 <= end:
        v0, v1 = max(v0, sign * columns[row, place]), max(v1, sign * columns[row, place + 1])
        v2, v3 = max(v2, sign * columns[row, place + 2]), max(v3, sign * columns[row, place + 3])
        v4, v5 = max(v4, sign * columns[row, place + 4]), max(v5, sign * columns[row, place + 5])
        v6, v7 = max(v6, sign * columns[row, place + 6]), max(v7, sign * columns[row, place + 7])
        place += 8
    value = max(max(max(v0, v1), max(v2, v3)), max(max(v4, v5), max(v6, v7)))
    for late_place in range(place, end):
        value = max(value, sign * columns[row, late_place])
    return sign * value


# ------------------------------------------------------------------------------- where windows begin and end


@inlined
def window_of(rows: Integers, node: int) -> tuple[bool, int, int, int, int]:
    """Return whether a node looks ahead, the unit and ends of its window, and the row of its times."""
    is_ahead = codes.PART_WINDOW_MAX <= rows[node, codes.NODE_CODE] <= codes.SHIFT
    times_row = STARTS + 2 * rows[node, codes.NODE_TIMED]
    return (
        is_ahead,
        rows[node, codes.NODE_UNIT],
        rows[node, codes.NODE_LOW],
        rows[node, codes.NODE_HIGH],
        times_row,
    )


@inlined
def _start(state: Integers, window: tuple[bool, int, int, int, int], position: int, last_sample: int) -> int:
    """Return the first position in the window of `position`; `last_sample` + 1 before it begins."""
    is_ahead, unit, near_end, far_end, times_row = window
    if unit != codes.SAMPLES:
        return int(min(state[times_row, position], last_sample + 1))
    return min(position + near_end, last_sample + 1) if is_ahead else max(position - far_end, 0)


@inlined
def _after(state: Integers, window: tuple[bool, int, int, int, int], position: int, last_sample: int) -> int:
    """Return the last position in the window of `position`, plus one, at most `last_sample` + 1."""
    is_ahead, unit, near_end, far_end, times_row = window
    if unit != codes.SAMPLES:
        return int(min(state[times_row + 1, position], last_sample + 1))
    return min(position + far_end, last_sample) + 1 if is_ahead else position - near_end + 1


@inlined
def _first_holding(
    state: Integers, window: tuple[bool, int, int, int, int], position: int, last_sample: int
) -> int:
    """Return the first position whose window ends at `position` or later."""
    is_ahead, unit, near_end, far_end, times_row = window
    if unit == codes.SAMPLES:
        return max(position - far_end, 0) if is_ahead else position + near_end
    low, high = 0, last_sample + 1
    while low < high:
        middle = (low + high) >> 1
        if state[times_row + 1, middle] <= position:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _first_starting(
    state: Integers, window: tuple[bool, int, int, int, int], position: int, last_sample: int
) -> int:
    """Return the first position whose window ahead starts at `position` or later."""
    _, unit, near_end, _, times_row = window
    if unit == codes.SAMPLES:
        return max(position - near_end, 0)
    low, high = 0, last_sample + 1
    while low < high:
        middle = (low + high) >> 1
        if state[times_row, middle] < position:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _first_open(
    state: Integers, stamps: Integers, window: tuple[bool, int, int, int, int], last_sample: int
) -> int:
    """Return the first position whose window ahead may get a later sample."""
    _, unit, _, far_end, times_row = window
    if unit == codes.SAMPLES:
        return max(last_sample - far_end + 1, 0)
    next_close = state[HEAD, NEXT + times_row + 1 - STARTS]
    return int(next_close + 1 if stamps[last_sample] - stamps[next_close] == far_end else next_close)


@inlined
def _enter(rows: Integers, stamps: Integers, state: Integers, last_sample: int) -> None:
    """Store the positions at which windows in seconds begin or end with the newest samples."""
    for node in range(len(rows) - 1):
        if rows[node, codes.NODE_TIMED] < 0:
            continue
        is_ahead, _, near_end, far_end, times_row = window_of(rows, node)
        next_begin, next_close = (
            state[HEAD, NEXT + times_row - STARTS],
            state[HEAD, NEXT + times_row + 1 - STARTS],
        )
        for position in range(state[HEAD, ENTERED], last_sample + 1):
            time_ns = stamps[position]
            if is_ahead:
                state[times_row, position] = state[times_row + 1, position] = _NEVER
                while next_begin <= position and time_ns - stamps[next_begin] >= near_end:
                    state[times_row, next_begin] = position
                    next_begin += 1
                # the far end is -1 without an upper end
                while far_end >= 0 and next_close < position and time_ns - stamps[next_close] > far_end:
                    state[times_row + 1, next_close] = position
                    next_close += 1
            else:
                while next_begin < position and time_ns - stamps[next_begin] > far_end:
                    next_begin += 1
                while next_close <= position and time_ns - stamps[next_close] >= near_end:
                    next_close += 1
                state[times_row, position], state[times_row + 1, position] = next_begin, next_close
        state[HEAD, NEXT + times_row - STARTS], state[HEAD, NEXT + times_row + 1 - STARTS] = (
            next_begin,
            next_close,
        )
    state[HEAD, ENTERED] = last_sample + 1


# -------------------------------------------------------------------------------------- columns of the nodes


@inlined
def _slide(
    is_greatest: bool, window: tuple[bool, int, int, int, int], state: Integers, columns: Floats,
    operand_column: int, column: int, scratch_row: int, begin: int, end: int, last_sample: int,
) -> int:  # fmt: skip
    """Compute extrema over the windows of positions begin … end - 1.

    The common positions of several windows are scanned once. Earlier positions are scanned backwards for the
    first windows, and later positions are scanned forwards for the last windows.

    Returns:
        the first position whose number changes; `last_sample` + 1 without a change.
    """
    neutral, first_change = -np.inf if is_greatest else np.inf, last_sample + 1
    while begin < end:
        scan_end, stop = _after(state, window, begin, last_sample), end
        scan_begin = _start(state, window, end - 1, last_sample)
        if scan_begin >= scan_end:
            stop, scan_begin = begin + 1, _start(state, window, begin, last_sample)
            while stop < end and _start(state, window, stop, last_sample) < scan_end:
                scan_begin = _start(state, window, stop, last_sample)
                stop += 1
        value = extremum(is_greatest, columns, operand_column, scan_begin, scan_end, neutral)
        for position in range(stop - 1, begin - 1, -1):
            window_start = _start(state, window, position, last_sample)
            while scan_begin > window_start:
                scan_begin -= 1
                value = better(is_greatest, value, columns[operand_column, scan_begin])
            columns[scratch_row, position - begin] = value
        value = neutral
        for position in range(begin, stop):
            window_end = _after(state, window, position, last_sample)
            while scan_end < window_end:
                value = better(is_greatest, value, columns[operand_column, scan_end])
                scan_end += 1
            number = better(is_greatest, columns[scratch_row, position - begin], value)
            if first_change > last_sample and columns[column, position] != number:
                first_change = position
            columns[column, position] = number
        begin = stop
    return first_change


@inlined
def _run_open(
    is_greatest: bool, window: tuple[bool, int, int, int, int], state: Integers, columns: Floats,
    operand_column: int, column: int, begin: int, first_change: int, last_sample: int, is_fresh: bool,
) -> int:  # fmt: skip
    """Update the windows that reach to the last sample, from the last window backwards.

    Earlier windows contain later windows, so the update stops at the first window that does not change.

    Returns:
        the first position whose number changes.
    """
    value, is_same = -np.inf if is_greatest else np.inf, False
    for position in range(begin if is_fresh else last_sample, last_sample + 1):
        columns[column, position] = value
    # windows that begin after the newest sample are empty, so they are skipped
    position, scan_begin = (
        min(_first_starting(state, window, last_sample + 1, last_sample), last_sample + 1),
        last_sample + 1,
    )
    while position > begin and not is_same:
        stop = max(position - STRIDE, begin)
        stride_start = _start(state, window, stop, last_sample)
        if (
            scan_begin <= last_sample
            and extremum(is_greatest, columns, operand_column, stride_start, scan_begin, value) == value
        ):
            # no number in these windows exceeds the extremum, so all these windows have this extremum
            window_start = _start(state, window, position - 1, last_sample)
            is_same = not is_fresh and window_start <= first_change and columns[column, position - 1] == value
            for index in range(position if is_same else stop, position):
                columns[column, index] = value
            position, scan_begin = position if is_same else stop, stride_start
        while position > stop and not is_same:
            window_start = _start(state, window, position - 1, last_sample)
            while scan_begin > window_start:
                scan_begin -= 1
                value = better(is_greatest, value, columns[operand_column, scan_begin])
            is_same = not is_fresh and window_start <= first_change and columns[column, position - 1] == value
            if not is_same:
                position -= 1
                columns[column, position] = value
    return position


@inlined
def _changing_windows(
    is_greatest: bool, columns: Floats, operand_column: int, column: int, seen_column: int,
    change_begin: int, change_end: int, begin: int, end: int,
) -> tuple[int, int]:  # fmt: skip
    """Skip windows whose extremum is better than all changed numbers, old and new.

    Returns:
        the first window among begin … end - 1 that may change, and the last such window plus one.
    """
    neutral = -np.inf if is_greatest else np.inf
    if change_begin >= change_end:
        begin = end
    if begin < end:
        old_extremum = extremum(is_greatest, columns, seen_column, change_begin, change_end, neutral)
        new_extremum = extremum(is_greatest, columns, operand_column, change_begin, change_end, neutral)
        worst_number = extremum(not is_greatest, columns, column, begin, end, -neutral)
        if _outdoes(is_greatest, worst_number, old_extremum) and not _outdoes(
            is_greatest, new_extremum, worst_number
        ):
            begin = end
        while begin < end and (
            _outdoes(is_greatest, columns[column, begin], old_extremum)
            and not _outdoes(is_greatest, new_extremum, columns[column, begin])
        ):
            begin += 1
        while begin < end and (
            _outdoes(is_greatest, columns[column, end - 1], old_extremum)
            and not _outdoes(is_greatest, new_extremum, columns[column, end - 1])
        ):
            end -= 1
    return begin, end


@inlined
def _run_window(
    rows: Integers, node: int, stamps: Integers, state: Integers, columns: Floats, mode: int,
    last_sample: int, is_fresh: bool,
) -> tuple[int, int]:  # fmt: skip
    """Update the column of a bounded operator, and return the begin and the end of the changed positions."""
    code, window, lowest_position, node_count = (
        rows[node, codes.NODE_CODE],
        window_of(rows, node),
        state[LOWS, node],
        len(rows) - 1,
    )
    operand_column, column = mode * node_count + rows[node, codes.NODE_A], mode * node_count + node
    change_begin, change_end = (
        state[CHANGED, rows[node, codes.NODE_A]],
        state[CHANGED_END, rows[node, codes.NODE_A]],
    )
    seen_column, is_ahead = SEEN * node_count + column, window[0]
    is_greatest = code in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX)
    # whether the bound of an open window is infinite, regardless of the window's numbers so far
    is_decided = is_ahead and mode != codes.OPEN_END and (mode == codes.OPEN_HIGH) == is_greatest
    open_begin = last_sample + 1
    if is_decided:
        open_begin = _first_open(state, stamps, window, last_sample)
    elif is_ahead:
        open_begin = _first_holding(state, window, last_sample, last_sample)
    begin, open_begin = lowest_position, min(max(open_begin, lowest_position), last_sample + 1)
    end = open_begin
    if not is_fresh:
        begin = min(
            max(min(_first_holding(state, window, change_begin, last_sample), last_sample), lowest_position),
            open_begin,
        )
    if is_ahead and not is_fresh:
        closing_begin = open_begin  # windows from this position on close with the newest sample or later
        if is_decided and last_sample > 0:
            closing_begin = min(
                max(_first_holding(state, window, last_sample - 1, last_sample), lowest_position), open_begin
            )
        end = min(_first_starting(state, window, change_end, last_sample), closing_begin)
        begin, end = _changing_windows(
            is_greatest, columns, operand_column, column, seen_column, change_begin, change_end, begin, end
        )
        if closing_begin < open_begin:
            begin, end = closing_begin if begin >= end else begin, open_begin
    if is_ahead:
        for index in range(change_begin, change_end):
            columns[seen_column, index] = columns[operand_column, index]
        columns[seen_column, last_sample] = columns[operand_column, last_sample]
    first_change = _slide(
        is_greatest,
        window,
        state,
        columns,
        operand_column,
        column,
        EXTRA * node_count + BEFORE,
        begin,
        end,
        last_sample,
    )
    if is_decided:
        for position in range(open_begin if is_fresh else max(open_begin, last_sample), last_sample + 1):
            columns[column, position] = beyond(mode, 0)
    elif open_begin <= last_sample:
        first_open_change = _run_open(
            is_greatest,
            window,
            state,
            columns,
            operand_column,
            column,
            open_begin,
            change_begin,
            last_sample,
            is_fresh,
        )
        if first_open_change < last_sample:
            first_change, end = min(first_change, first_open_change), last_sample
    return (lowest_position, last_sample) if is_fresh else (first_change, min(end, last_sample))


@inlined
def _run_since(
    is_strong: bool, has_left: bool, columns: Floats, left_column: int, right_column: int, column: int,
    value: float, begin: int, last_sample: int,
) -> int:  # fmt: skip
    """Run a since or trigger forwards from `begin`, given its previous value, and return the first change."""
    first_change, is_same = begin, True
    for position in range(begin, last_sample + 1):
        if has_left:
            value = better(not is_strong, columns[left_column, position], value)
        value = better(is_strong, columns[right_column, position], value)
        is_same = is_same and position < last_sample and columns[column, position] == value
        first_change += is_same
        columns[column, position] = value
    return first_change


@inlined
def _start_of_past(rows: Integers, node: int, state: Integers, tables: Floats) -> float:
    """Return the start value of a since or trigger, read from its table if it has a state."""
    value, part_row = beyond(codes.OPEN_END, rows[node, codes.NODE_WEAK]), len(rows) - 1
    if state[STATE, node] >= 0:
        variable_count, point_row = (
            rows[part_row, codes.PART_VARIABLES],
            2 * rows[part_row, codes.PART_TABLES],
        )
        value = read_table(tables, rows[node, codes.NODE_TABLE], 0, variable_count, tables, point_row)
    return value


@inlined
def _set_point(
    rows: Integers,
    node: int,
    state: Integers,
    columns: Floats,
    column: int,
    mode: int,
    last_sample: int,
    tables: Floats,
) -> None:
    """Store a node's value at the boundary as the coordinate of the node's variable in the point."""
    boundary = state[BOUNDARY, node]
    value = (
        columns[column, boundary] if boundary <= last_sample else beyond(mode, rows[node, codes.NODE_WEAK])
    )
    tables[2 * rows[len(rows) - 1, codes.PART_TABLES], rows[node, codes.NODE_VARIABLE]] = value


@inlined
def has_column(rows: Integers) -> bool:
    """Return whether the root has a column. A root that joins all positions has no column."""
    root = len(rows) - 2
    return bool(rows[root, codes.NODE_A] >= 0 or rows[root, codes.NODE_VARIABLE] < 0)


@inlined
def _bring_up(
    rows: Integers, history: Floats, stamps: Integers, columns: Floats, state: Integers, tables: Floats,
    mode: int, last_sample: int, is_fresh: bool,
) -> None:  # fmt: skip
    """Update the columns of one set to the last sample. If `is_fresh`, all numbers are computed."""
    node_count, first_column = len(rows) - 1, mode * (len(rows) - 1)
    for node in range(node_count if has_column(rows) else node_count - 1):
        code, left_operand, right_operand = (
            rows[node, codes.NODE_CODE],
            rows[node, codes.NODE_A],
            rows[node, codes.NODE_B],
        )
        column, begin, end, lowest_position = first_column + node, last_sample, last_sample, state[LOWS, node]
        if code == codes.LITERAL:
            begin = lowest_position if is_fresh else last_sample
            for index in range(begin, last_sample + 1):
                columns[column, index] = history[left_operand, index]
        elif code in (codes.PART_AND, codes.PART_OR):
            is_or, left_column, right_column = (
                code == codes.PART_OR,
                first_column + left_operand,
                first_column + right_operand,
            )
            begin = max(min(state[CHANGED, left_operand], state[CHANGED, right_operand]), lowest_position)
            end = max(state[CHANGED_END, left_operand], state[CHANGED_END, right_operand])
            while (
                begin < end
                and not is_fresh
                and better(is_or, columns[left_column, begin], columns[right_column, begin])
                == columns[column, begin]
            ):
                begin += 1
            left_values, right_values, values = (
                columns[left_column, begin:end],
                columns[right_column, begin:end],
                columns[column, begin:end],
            )
            if is_or:
                for index in range(len(values)):
                    values[index] = max(left_values[index], right_values[index])
            else:
                for index in range(len(values)):
                    values[index] = min(left_values[index], right_values[index])
            columns[column, last_sample] = better(
                is_or, columns[left_column, last_sample], columns[right_column, last_sample]
            )
        elif code in (codes.UNTIL, codes.RELEASE):
            left_column, right_column, is_strong = (
                first_column + max(left_operand, 0),
                first_column + right_operand,
                code == codes.UNTIL,
            )
            first_change, begin = state[CHANGED, right_operand], last_sample + 1
            if left_operand >= 0:
                first_change = min(first_change, state[CHANGED, left_operand])
            value, is_same = beyond(mode, rows[node, codes.NODE_WEAK]), False
            while begin > lowest_position and not is_same:
                if left_operand >= 0:
                    value = better(not is_strong, columns[left_column, begin - 1], value)
                value = better(is_strong, columns[right_column, begin - 1], value)
                is_same = (
                    not is_fresh
                    and begin <= min(first_change, last_sample)
                    and columns[column, begin - 1] == value
                )
                if not is_same:
                    begin -= 1
                    columns[column, begin] = value
            if rows[node, codes.NODE_VARIABLE] >= 0:
                _set_point(rows, node, state, columns, column, mode, last_sample, tables)
        elif code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
            left_column, right_column, state_position = (
                first_column + max(left_operand, 0),
                first_column + right_operand,
                state[STATE, node],
            )
            value, begin = (
                _start_of_past(rows, node, state, tables),
                min(state[CHANGED, right_operand], last_sample),
            )
            if left_operand >= 0:
                begin = min(begin, state[CHANGED, left_operand])
            # the start value comes from a table, so it may depend on later samples
            if state_position >= 0 and (is_fresh or columns[column, state_position] != value):
                columns[column, state_position], begin = value, state_position
            begin = state_position + 1 if is_fresh else max(begin, state_position + 1)
            if begin > state_position + 1:
                value = columns[column, begin - 1]
            first_change = _run_since(
                code == codes.PAST_SINCE,
                left_operand >= 0,
                columns,
                left_column,
                right_column,
                column,
                value,
                begin,
                last_sample,
            )
            begin = lowest_position if is_fresh else first_change
        elif code in (codes.SHIFT, codes.PAST_DELAY):
            window, operand_column = window_of(rows, node), first_column + left_operand
            missing_value = beyond(mode if window[0] else codes.OPEN_END, rows[node, codes.NODE_WEAK])
            if is_fresh:
                begin = lowest_position
            elif window[0]:
                begin = max(
                    min(
                        _first_starting(state, window, state[CHANGED, left_operand], last_sample), last_sample
                    ),
                    lowest_position,
                )
            else:
                begin = max(
                    min(
                        _first_holding(state, window, state[CHANGED, left_operand], last_sample), last_sample
                    ),
                    lowest_position,
                )
            for index in range(begin, last_sample + 1):
                source_position = (
                    _start(state, window, index, last_sample)
                    if window[0]
                    else _after(state, window, index, last_sample) - 1
                )
                columns[column, index] = (
                    columns[operand_column, source_position]
                    if 0 <= source_position <= last_sample
                    else missing_value
                )
        else:
            begin, end = _run_window(rows, node, stamps, state, columns, mode, last_sample, is_fresh)
        if begin >= end:
            begin, end = last_sample, 0
        state[CHANGED, node], state[CHANGED_END, node] = begin, end
    if not has_column(rows):
        body = rows[node_count - 1, codes.NODE_B]
        is_until, joined_row = (
            rows[node_count - 1, codes.NODE_CODE] == codes.UNTIL,
            EXTRA * node_count + JOINED + mode,
        )
        neutral, block_count = -np.inf if is_until else np.inf, (last_sample + 1) // BLOCK
        for index in range(state[CHANGED, body] // BLOCK, block_count):
            if index == block_count - 1 or index * BLOCK < state[CHANGED_END, body]:
                columns[joined_row, index] = extremum(
                    is_until, columns, first_column + body, index * BLOCK, (index + 1) * BLOCK, neutral
                )


# ------------------------------------------------------------------------------------- the results of a part


@inlined
def _join_blocks(
    is_until: bool, columns: Floats, body_column: int, joined_row: int, value: float, begin: int, end: int
) -> float:
    """Join a number with the numbers at begin … end - 1 by means of joined blocks."""
    first_block, block_end = begin // BLOCK + 1, end // BLOCK
    blocks_begin = min(first_block * BLOCK, end)
    value = extremum(is_until, columns, body_column, begin, blocks_begin, value)
    value = extremum(is_until, columns, joined_row, first_block, block_end, value)
    return extremum(is_until, columns, body_column, max(blocks_begin, block_end * BLOCK), end, value)


@inlined
def _at_first(
    rows: Integers, columns: Floats, state: Integers, tables: Floats, mode: int, last_sample: int
) -> float:
    """Return the root's value at the first sample, from the columns of a set."""
    node_count, base = len(rows) - 1, state[HEAD, BASE]
    first_column, root = mode * node_count, node_count - 1
    value = beyond(mode, rows[root, codes.NODE_WEAK])
    if not has_column(rows):
        is_until, body_column = (
            rows[root, codes.NODE_CODE] == codes.UNTIL,
            first_column + rows[root, codes.NODE_B],
        )
        value = _join_blocks(
            is_until, columns, body_column, EXTRA * node_count + JOINED + mode, value, base, last_sample + 1
        )
    elif base <= last_sample:
        value = columns[first_column + root, base]
    if state[HEAD, IS_BEGUN]:
        variable_count, point_row = (
            rows[node_count, codes.PART_VARIABLES],
            2 * rows[node_count, codes.PART_TABLES],
        )
        if rows[root, codes.NODE_VARIABLE] >= 0:
            tables[point_row, rows[root, codes.NODE_VARIABLE]] = value
        value = read_table(tables, 0, 0, variable_count, tables, point_row)
    return value


@inlined
def _is_known(rows: Integers, state: Integers, mode: int) -> bool:
    """Return whether a bound follows from the table alone (see `program`)."""
    part = len(rows) - 1
    is_constant = state[HEAD, IS_BEGUN] > 0 and rows[part, codes.PART_VARIABLES] == 0
    return bool(is_constant or rows[part, codes.PART_KNOWN] >> mode & 1 > 0)


@kernel
def run_windows(
    rows: Integers, history: Floats, stamps: Integers, columns: Floats, state: Integers, tables: Floats,
    begin: int, count: int, bounds: int,
) -> None:  # fmt: skip
    """Run a part over the recent samples begin … begin + count - 1, in one channel.

    Args:
        rows: (D + 1, NODE_WIDTH), nodes of the part, then the part itself.
        history: (S, room), signals in the channel.
        stamps: (room,), times of the recent samples.
        columns: (EXTRA * D + EXTRA_ROWS, room). The last four rows are output, the results of the part.
        state: state of the part (see `HEAD`).
        tables: (2 T + 2, …), tables of the part and of its past operators, space for the next tables, a
            point at which tables are read, and start values of past operators.
        bounds: 1 to compute the lower bound, 2 for the upper bound, 3 for both.
    """
    node_count = len(rows) - 1
    root, first_result = node_count - 1, EXTRA * node_count + RESULTS
    is_until = rows[root, codes.NODE_CODE] == codes.UNTIL
    corner_count, has_now = (
        1 << rows[node_count, codes.PART_VARIABLES],
        rows[node_count, codes.PART_HAS_NOW] > 0,
    )
    for index in range(count):
        last_sample = begin + index
        if state[HEAD, IS_BEGUN] and not has_now and tables[0, 0] == tables[0, corner_count - 1]:
            # the extreme corners are equal, so no later sample can change the value
            columns[first_result, index] = columns[first_result + 2, index] = columns[
                first_result + 3, index
            ] = tables[0, 0]
            continue
        if state.shape[0] > STARTS:
            _enter(rows, stamps, state, last_sample)
        for mode in range(SETS):
            result_row = first_result + mode + (mode != codes.OPEN_END)
            if mode != codes.OPEN_END and not bounds >> (mode - 1) & 1:
                continue
            if mode != codes.OPEN_END and _is_known(rows, state, mode):
                corner = 0 if mode == codes.OPEN_LOW else corner_count - 1
                columns[result_row, index] = tables[0, corner] if state[HEAD, IS_BEGUN] else beyond(mode, 0)
                continue
            # columns are computed again if they lack the previous sample
            is_fresh = state[HEAD, KNOWN + mode] != last_sample - 1 or last_sample == 0
            state[HEAD, KNOWN + mode] = last_sample
            if is_fresh:
                find_lows(rows, state, stamps, last_sample)
            _bring_up(rows, history, stamps, columns, state, tables, mode, last_sample, is_fresh)
            columns[result_row, index] = _at_first(rows, columns, state, tables, mode, last_sample)
        if has_now and has_column(rows):
            columns[first_result + RESULT_NOW, index] = columns[root, last_sample]
        elif has_now:
            columns[first_result + RESULT_NOW, index] = better(
                is_until,
                columns[rows[root, codes.NODE_B], last_sample],
                beyond(codes.OPEN_END, rows[root, codes.NODE_WEAK]),
            )
        # samples are counted from the first sample of the run, so that the length of a tile does not matter
        if (state[HEAD, OFFSET] + last_sample) % CLOSING == CLOSING - 1:
            _absorb(rows, stamps, columns, state, tables, last_sample)


# ------------------------------------------------------------------------------ closed positions go to tables


@piece
def _reach(
    rows: Integers, state: Integers, stamps: Integers, root_low: int, root_high: int, last_sample: int
) -> bool:
    """Find, for each node, the first and the last position that the root needs at root_low … root_high.

    The positions are written to `LOW` and `HIGH`. `PLAIN` is `LOW` without boundaries and states.

    Returns:
        whether all windows between these positions and the root have closed.
    """
    node_count, is_closed = len(rows) - 1, True
    for node in range(node_count):
        state[LOW, node], state[HIGH, node] = _NEVER, -1
    state[LOW, node_count - 1], state[HIGH, node_count - 1] = root_low, root_high
    for node in range(node_count - 1, -1, -1):
        code, left_operand, right_operand = (
            rows[node, codes.NODE_CODE],
            rows[node, codes.NODE_A],
            rows[node, codes.NODE_B],
        )
        state[PLAIN, node] = state[LOW, node]
        if rows[node, codes.NODE_VARIABLE] >= 0 and state[HEAD, IS_BEGUN]:
            state[LOW, node] = min(state[LOW, node], state[BOUNDARY, node])
        if rows[node, codes.NODE_TABLE] >= 0:
            # the column also has the start value of the operator
            state[LOW, node] = min(state[LOW, node], max(state[STATE, node], 0))
        low, high = state[LOW, node], state[HIGH, node]
        if code == codes.LITERAL:
            continue
        window = window_of(rows, node)
        if code in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN):
            is_closed = is_closed and high < _first_open(state, stamps, window, last_sample)
            high = _after(state, window, high, last_sample) - 1
        elif code == codes.SHIFT:
            shifted_position = _start(state, window, high, last_sample)
            is_closed = is_closed and shifted_position <= last_sample
            farthest_position = (
                _after(state, window, high, last_sample) - 1 if window[3] >= 0 else shifted_position
            )
            high = min(max(shifted_position, farthest_position), last_sample)
        elif code in (codes.PAST_WINDOW_MAX, codes.PAST_WINDOW_MIN):
            low = _start(state, window, min(low, last_sample), last_sample)
        elif code == codes.PAST_DELAY:
            low = max(_after(state, window, min(low, last_sample), last_sample) - 1, 0)
        if left_operand >= 0:
            state[LOW, left_operand] = min(state[LOW, left_operand], low)
            state[HIGH, left_operand] = max(state[HIGH, left_operand], high, state[HIGH, node])
        if not (
            codes.PART_WINDOW_MAX <= code <= codes.SHIFT or codes.PAST_WINDOW_MAX <= code <= codes.PAST_DELAY
        ):
            state[LOW, right_operand], state[HIGH, right_operand] = (
                min(state[LOW, right_operand], low),
                max(state[HIGH, right_operand], high),
            )
    return is_closed


@piece
def find_lows(rows: Integers, state: Integers, stamps: Integers, last_sample: int) -> None:
    """Store for each node the first position that is still needed."""
    _reach(rows, state, stamps, min(state[HEAD, BASE], last_sample), last_sample, last_sample)
    for node in range(len(rows) - 1):
        state[LOWS, node] = state[LOW, node]


@piece
def _run_corner(
    rows: Integers,
    stamps: Integers,
    columns: Floats,
    state: Integers,
    tables: Floats,
    corner: int,
    last_sample: int,
) -> None:
    """Compute the nodes that depend on a variable or a table, at `LOW` … `HIGH`, for one corner."""
    node_count = len(rows) - 1
    point_row, corner_columns = 2 * rows[node_count, codes.PART_TABLES], SETS * node_count
    for node in range(node_count):
        if not rows[node, codes.NODE_DEPENDS]:
            continue
        code, left_operand, right_operand = (
            rows[node, codes.NODE_CODE],
            max(rows[node, codes.NODE_A], 0),
            rows[node, codes.NODE_B],
        )
        has_left, low, high = rows[node, codes.NODE_A] >= 0, state[LOW, node], state[HIGH, node]
        left_column = (
            corner_columns + left_operand if rows[left_operand, codes.NODE_DEPENDS] else left_operand
        )
        right_column = (
            corner_columns + right_operand if rows[right_operand, codes.NODE_DEPENDS] else right_operand
        )
        column = corner_columns + node
        if code in (codes.PART_AND, codes.PART_OR):
            for position in range(low, high + 1):
                columns[column, position] = better(
                    code == codes.PART_OR, columns[left_column, position], columns[right_column, position]
                )
        elif code in (codes.UNTIL, codes.RELEASE):
            variable, is_strong, start_value = rows[node, codes.NODE_VARIABLE], code == codes.UNTIL, -np.inf
            if variable >= 0 and corner >> variable & 1:
                start_value = np.inf
            value = start_value
            for position in range(high, low - 1, -1):
                if has_left:
                    value = better(not is_strong, columns[left_column, position], value)
                value = better(is_strong, columns[right_column, position], value)
                columns[column, position] = value
            if variable >= 0:
                boundary = state[BOUNDARY, node]
                tables[point_row, variable] = columns[column, boundary] if boundary <= high else start_value
        elif code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
            value = _start_of_past(rows, node, state, tables)
            tables[point_row + 1, rows[node, codes.NODE_TABLE]] = value
            begin = state[STATE, node] + 1
            _run_since(
                code == codes.PAST_SINCE,
                has_left,
                columns,
                left_column,
                right_column,
                column,
                value,
                begin,
                high,
            )
        elif code in (codes.SHIFT, codes.PAST_DELAY):
            window, missing_value = window_of(rows, node), beyond(codes.OPEN_END, rows[node, codes.NODE_WEAK])
            for position in range(low, high + 1):
                source_position = (
                    _start(state, window, position, last_sample)
                    if window[0]
                    else _after(state, window, position, last_sample) - 1
                )
                columns[column, position] = (
                    columns[left_column, source_position]
                    if 0 <= source_position <= last_sample
                    else missing_value
                )
        else:
            is_greatest = code in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX)
            scratch_row = EXTRA * node_count + BEFORE
            _slide(
                is_greatest,
                window_of(rows, node),
                state,
                columns,
                left_column,
                column,
                scratch_row,
                low,
                high + 1,
                last_sample,
            )


@piece
def _renew_tables(
    rows: Integers, stamps: Integers, columns: Floats, state: Integers, tables: Floats, last_sample: int
) -> None:
    """Compute the tables of a part again, with the positions from its base to the root's `HIGH`."""
    node_count = len(rows) - 1
    table_count, variable_count = rows[node_count, codes.PART_TABLES], rows[node_count, codes.PART_VARIABLES]
    for corner in range(1 << variable_count):
        _run_corner(rows, stamps, columns, state, tables, corner, last_sample)
        if state[HEAD, IS_BEGUN]:
            tables[table_count, corner] = read_table(tables, 0, 0, variable_count, tables, 2 * table_count)
        else:
            root = node_count - 1
            tables[table_count, corner] = columns[
                SETS * node_count + root if rows[root, codes.NODE_DEPENDS] else root, 0
            ]
        for node in range(node_count):
            table, state_position = rows[node, codes.NODE_TABLE], state[PLAIN, node] - 1
            if table >= 0:
                is_new = state_position > state[STATE, node]
                value = (
                    columns[SETS * node_count + node, state_position]
                    if is_new
                    else tables[2 * table_count + 1, table]
                )
                tables[table_count + table, corner] = value
    for table in range(table_count):
        for corner in range(1 << variable_count):
            tables[table, corner] = tables[table_count + table, corner]


@inlined
def _pass_outdone(rows: Integers, columns: Floats, state: Integers, tables: Floats, last_sample: int) -> None:
    """Move the base over positions that cannot change the root any more, although their windows are open.

    The table bounds `G x` from above. A position has no effect once x is at least this bound, because x
    never falls.
    """
    root, base = len(rows) - 2, state[HEAD, BASE]
    is_until, body = rows[root, codes.NODE_CODE] == codes.UNTIL, rows[root, codes.NODE_B]
    # docs/design/monitor.md shows by an example why few positions stay open in most recordings
    limit = tables[0, 0] if is_until else tables[0, 1]
    while base <= last_sample and not _outdoes(is_until, columns[body, base], limit):
        base += 1
    state[HEAD, BASE] = state[BOUNDARY, root] = base


@piece
def _absorb(
    rows: Integers, stamps: Integers, columns: Floats, state: Integers, tables: Floats, last_sample: int
) -> None:
    """Move the base over all positions whose windows have all closed."""
    # large runs come first, so that the tables are computed once for many positions
    size, old_base = CLOSING, state[HEAD, BASE]
    while size > 0:
        base = state[HEAD, BASE]
        if base + size > last_sample + 1 or not _reach(
            rows, state, stamps, base, base + size - 1, last_sample
        ):
            size //= 2
            continue
        _renew_tables(rows, stamps, columns, state, tables, last_sample)
        for node in range(len(rows) - 1):
            if rows[node, codes.NODE_VARIABLE] >= 0:
                state[BOUNDARY, node] = state[HIGH, node] + 1
            if rows[node, codes.NODE_TABLE] >= 0:
                state[STATE, node] = max(state[STATE, node], state[PLAIN, node] - 1)
        state[HEAD, BASE], state[HEAD, IS_BEGUN] = base + size, 1
    if rows[len(rows) - 1, codes.PART_IS_MONOTONE] and state[HEAD, IS_BEGUN]:
        _pass_outdone(rows, columns, state, tables, last_sample)
    if state[HEAD, BASE] > old_base:
        find_lows(rows, state, stamps, last_sample)
