"""Windows below unbounded operators: the nodes of a part at every position that is still open.

A part runs in one channel at a time. Each of its nodes has a row of numbers, its *column*, with one number
for each recent sample. A sample changes a column only where a window opens or closes with it, or where an
operand has changed. Columns are updated operands first, and each records the positions that have changed.

Positions of the root whose windows have all closed are absorbed into a table (see `signals`). The *base* is
the first position of the root that is not absorbed. The table gives the root's value at the first sample, as
a function of each variable's value at the end of the table, its *boundary*. A past operator over an operator
that looks ahead has its own table, with its value at one position, its *state*.

Columns exist in up to three sets: for a run that ends with the newest sample, and for the lowest and the
highest values of later samples. Positions are indices of the recent samples; `last` is the newest one.
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
"""Number of positions in a block of the root's operand; a block is joined again only after a change."""
STRIDE = 16
"""Number of positions that `_run_open` fills at once."""
_NEVER = 1 << 62
"""Position beyond all samples."""

SETS = 3
"""Sets of columns: `OPEN_END`, `OPEN_LOW` and `OPEN_HIGH`. Columns of a table's corner follow."""
SEEN = SETS + 1
"""Index of the first set with copies of operands' columns; windows compare them with the new columns."""
EXTRA = SEEN + SETS
"""Number of sets of columns, before the extra rows."""
# rows after the columns of the nodes: joined blocks, work space of `_slide`, and the results of a part
JOINED, BEFORE, RESULTS = 0, SETS, SETS + 1
RESULT_NOW = 1
"""Result row of a part's value at the newest sample; the value at the first sample is row 0."""
EXTRA_ROWS = SETS + 5

# rows of the state: HEAD has single numbers, the others one number for each node. The newest sample changed
# its own position, and the positions from CHANGED to before CHANGED_END; without any, CHANGED_END is 0
HEAD, LOWS, LOW, HIGH, PLAIN, CHANGED, CHANGED_END, BOUNDARY, STATE = range(9)
STARTS = 9  # then two rows per window in seconds: its first position, and its last position plus one
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

    Eight chains run side by side; in a single chain, each step would wait for the previous one.
    """
    sign = 1.0 if is_greatest else -1.0
    v0 = v1 = v2 = v3 = v4 = v5 = v6 = v7 = sign * start
    # the loop is vectorised only if numba knows that no index is negative, because it wraps those around
    k = max(begin, 0)
    while k + 8 <= end:
        v0, v1 = max(v0, sign * columns[row, k]), max(v1, sign * columns[row, k + 1])
        v2, v3 = max(v2, sign * columns[row, k + 2]), max(v3, sign * columns[row, k + 3])
        v4, v5 = max(v4, sign * columns[row, k + 4]), max(v5, sign * columns[row, k + 5])
        v6, v7 = max(v6, sign * columns[row, k + 6]), max(v7, sign * columns[row, k + 7])
        k += 8
    value = max(max(max(v0, v1), max(v2, v3)), max(max(v4, v5), max(v6, v7)))
    for i in range(k, end):
        value = max(value, sign * columns[row, i])
    return sign * value


# ------------------------------------------------------------------------------- where windows begin and end


@inlined
def window_of(rows: Integers, d: int) -> tuple[bool, int, int, int, int]:
    """Return whether a node looks ahead, its window's unit and ends, and the row of its window's times."""
    is_ahead = codes.PART_WINDOW_MAX <= rows[d, codes.NODE_CODE] <= codes.SHIFT
    times = STARTS + 2 * rows[d, codes.NODE_TIMED]
    return is_ahead, rows[d, codes.NODE_UNIT], rows[d, codes.NODE_LOW], rows[d, codes.NODE_HIGH], times


@inlined
def _start(state: Integers, window: tuple[bool, int, int, int, int], position: int, last: int) -> int:
    """Return the first position in a window; last + 1 if the window has not begun."""
    is_ahead, unit, near, far, times = window
    if unit != codes.SAMPLES:
        return int(min(state[times, position], last + 1))
    return min(position + near, last + 1) if is_ahead else max(position - far, 0)


@inlined
def _after(state: Integers, window: tuple[bool, int, int, int, int], position: int, last: int) -> int:
    """Return the last position in a window plus one, at most last + 1."""
    is_ahead, unit, near, far, times = window
    if unit != codes.SAMPLES:
        return int(min(state[times + 1, position], last + 1))
    return min(position + far, last) + 1 if is_ahead else position - near + 1


@inlined
def _first_holding(state: Integers, window: tuple[bool, int, int, int, int], position: int, last: int) -> int:
    """Return the first position whose window ends at `position` or later."""
    is_ahead, unit, near, far, times = window
    if unit == codes.SAMPLES:
        return max(position - far, 0) if is_ahead else position + near
    low, high = 0, last + 1
    while low < high:
        middle = (low + high) >> 1
        if state[times + 1, middle] <= position:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _first_starting(
    state: Integers, window: tuple[bool, int, int, int, int], position: int, last: int
) -> int:
    """Return the first position whose window ahead starts at `position` or later."""
    _, unit, near, _, times = window
    if unit == codes.SAMPLES:
        return max(position - near, 0)
    low, high = 0, last + 1
    while low < high:
        middle = (low + high) >> 1
        if state[times, middle] < position:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def _first_open(state: Integers, stamps: Integers, window: tuple[bool, int, int, int, int], last: int) -> int:
    """Return the first position whose window ahead may get a later sample."""
    _, unit, _, far, times = window
    if unit == codes.SAMPLES:
        return max(last - far + 1, 0)
    first = state[HEAD, NEXT + times + 1 - STARTS]
    return int(first + 1 if stamps[last] - stamps[first] == far else first)


@inlined
def _enter(rows: Integers, stamps: Integers, state: Integers, last: int) -> None:
    """Record which windows in seconds begin or have ended with the newest samples."""
    for d in range(len(rows) - 1):
        if rows[d, codes.NODE_TIMED] < 0:
            continue
        is_ahead, _, near, far, times = window_of(rows, d)
        next_begin, next_close = state[HEAD, NEXT + times - STARTS], state[HEAD, NEXT + times + 1 - STARTS]
        for position in range(state[HEAD, ENTERED], last + 1):
            time_ns = stamps[position]
            if is_ahead:
                state[times, position] = state[times + 1, position] = _NEVER
                while next_begin <= position and time_ns - stamps[next_begin] >= near:
                    state[times, next_begin] = position
                    next_begin += 1
                # far is -1 without an upper end
                while far >= 0 and next_close < position and time_ns - stamps[next_close] > far:
                    state[times + 1, next_close] = position
                    next_close += 1
            else:
                while next_begin < position and time_ns - stamps[next_begin] > far:
                    next_begin += 1
                while next_close <= position and time_ns - stamps[next_close] >= near:
                    next_close += 1
                state[times, position], state[times + 1, position] = next_begin, next_close
        state[HEAD, NEXT + times - STARTS], state[HEAD, NEXT + times + 1 - STARTS] = next_begin, next_close
    state[HEAD, ENTERED] = last + 1


# -------------------------------------------------------------------------------------- columns of the nodes


@inlined
def _slide(
    is_greatest: bool, window: tuple[bool, int, int, int, int], state: Integers, columns: Floats,
    child: int, column: int, scratch: int, begin: int, end: int, last: int,
) -> int:  # fmt: skip
    """Compute extrema over the windows of positions begin … end - 1.

    The common positions of several windows are scanned once. Positions before them are scanned backwards for
    the first windows, and positions after them forwards for the last windows.

    Returns:
        the first position whose number changes; last + 1 for none.
    """
    nothing, changed = -np.inf if is_greatest else np.inf, last + 1
    while begin < end:
        middle, stop = _after(state, window, begin, last), end
        at = _start(state, window, end - 1, last)
        if at >= middle:
            stop, at = begin + 1, _start(state, window, begin, last)
            while stop < end and _start(state, window, stop, last) < middle:
                at = _start(state, window, stop, last)
                stop += 1
        value = extremum(is_greatest, columns, child, at, middle, nothing)
        for position in range(stop - 1, begin - 1, -1):
            start = _start(state, window, position, last)
            while at > start:
                at -= 1
                value = better(is_greatest, value, columns[child, at])
            columns[scratch, position - begin] = value
        value = nothing
        for position in range(begin, stop):
            after = _after(state, window, position, last)
            while middle < after:
                value = better(is_greatest, value, columns[child, middle])
                middle += 1
            number = better(is_greatest, columns[scratch, position - begin], value)
            if changed > last and columns[column, position] != number:
                changed = position
            columns[column, position] = number
        begin = stop
    return changed


@inlined
def _run_open(
    is_greatest: bool, window: tuple[bool, int, int, int, int], state: Integers, columns: Floats,
    child: int, column: int, begin: int, changed: int, last: int, is_fresh: bool,
) -> int:  # fmt: skip
    """Update the windows that reach to the last sample, from the last window backwards.

    Earlier windows contain later ones, so the update stops at the first window that does not change.

    Returns:
        the first position whose number changes.
    """
    value, is_same = -np.inf if is_greatest else np.inf, False
    for position in range(begin if is_fresh else last, last + 1):
        columns[column, position] = value
    # windows that begin after the newest sample are empty: skip them
    position, at = min(_first_starting(state, window, last + 1, last), last + 1), last + 1
    while position > begin and not is_same:
        stop = max(position - STRIDE, begin)
        first = _start(state, window, stop, last)
        if at <= last and extremum(is_greatest, columns, child, first, at, value) == value:
            # no number in these windows exceeds the extremum, so all of them have this extremum
            start = _start(state, window, position - 1, last)
            is_same = not is_fresh and start <= changed and columns[column, position - 1] == value
            for k in range(position if is_same else stop, position):
                columns[column, k] = value
            position, at = position if is_same else stop, first
        while position > stop and not is_same:
            start = _start(state, window, position - 1, last)
            while at > start:
                at -= 1
                value = better(is_greatest, value, columns[child, at])
            is_same = not is_fresh and start <= changed and columns[column, position - 1] == value
            if not is_same:
                position -= 1
                columns[column, position] = value
    return position


@inlined
def _changing_windows(
    is_greatest: bool, columns: Floats, child: int, column: int, seen: int, changed: int, changed_end: int,
    begin: int, end: int,
) -> tuple[int, int]:  # fmt: skip
    """Skip windows whose number beats all changed numbers, old and new.

    Returns:
        the bounds of the windows among begin … end - 1 that may change: first, last plus one.
    """
    nothing = -np.inf if is_greatest else np.inf
    if changed >= changed_end:
        begin = end
    if begin < end:
        old_extremum = extremum(is_greatest, columns, seen, changed, changed_end, nothing)
        new_extremum = extremum(is_greatest, columns, child, changed, changed_end, nothing)
        worst = extremum(not is_greatest, columns, column, begin, end, -nothing)
        if _outdoes(is_greatest, worst, old_extremum) and not _outdoes(is_greatest, new_extremum, worst):
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
    rows: Integers, d: int, stamps: Integers, state: Integers, columns: Floats, mode: int, last: int,
    is_fresh: bool,
) -> tuple[int, int]:  # fmt: skip
    """Update the column of a bounded operator; return the bounds of the changed positions."""
    code, window, lowest, nodes = rows[d, codes.NODE_CODE], window_of(rows, d), state[LOWS, d], len(rows) - 1
    child, column = mode * nodes + rows[d, codes.NODE_A], mode * nodes + d
    changed, changed_end = state[CHANGED, rows[d, codes.NODE_A]], state[CHANGED_END, rows[d, codes.NODE_A]]
    seen, is_ahead = SEEN * nodes + column, window[0]
    is_greatest = code in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX)
    # whether the bound of an open window is infinite, regardless of its numbers so far
    is_decided = is_ahead and mode != codes.OPEN_END and (mode == codes.OPEN_HIGH) == is_greatest
    tail = last + 1
    if is_decided:
        tail = _first_open(state, stamps, window, last)
    elif is_ahead:
        tail = _first_holding(state, window, last, last)
    begin, tail = lowest, min(max(tail, lowest), last + 1)
    end = tail
    if not is_fresh:
        begin = min(max(min(_first_holding(state, window, changed, last), last), lowest), tail)
    if is_ahead and not is_fresh:
        closing = tail  # windows from this position on close with the newest sample or later
        if is_decided and last > 0:
            closing = min(max(_first_holding(state, window, last - 1, last), lowest), tail)
        end = min(_first_starting(state, window, changed_end, last), closing)
        begin, end = _changing_windows(
            is_greatest, columns, child, column, seen, changed, changed_end, begin, end
        )
        if closing < tail:
            begin, end = closing if begin >= end else begin, tail
    if is_ahead:
        for k in range(changed, changed_end):
            columns[seen, k] = columns[child, k]
        columns[seen, last] = columns[child, last]
    first = _slide(
        is_greatest, window, state, columns, child, column, EXTRA * nodes + BEFORE, begin, end, last
    )
    if is_decided:
        for position in range(tail if is_fresh else max(tail, last), last + 1):
            columns[column, position] = beyond(mode, 0)
    elif tail <= last:
        opened = _run_open(is_greatest, window, state, columns, child, column, tail, changed, last, is_fresh)
        if opened < last:
            first, end = min(first, opened), last
    return (lowest, last) if is_fresh else (first, min(end, last))


@inlined
def _run_since(
    strong: bool, has_left: bool, columns: Floats, left: int, right: int, column: int, value: float,
    begin: int, last: int,
) -> int:  # fmt: skip
    """Run a since or trigger forwards from `begin`, given the value before; return the first change."""
    changes, is_same = begin, True
    for k in range(begin, last + 1):
        if has_left:
            value = better(not strong, columns[left, k], value)
        value = better(strong, columns[right, k], value)
        is_same = is_same and k < last and columns[column, k] == value
        changes += is_same
        columns[column, k] = value
    return changes


@inlined
def _start_of_past(rows: Integers, d: int, state: Integers, tables: Floats) -> float:
    """Return the start value of a since or trigger, which its table gives for the position of its state."""
    value, part = beyond(codes.OPEN_END, rows[d, codes.NODE_WEAK]), len(rows) - 1
    if state[STATE, d] >= 0:
        variables, point = rows[part, codes.PART_VARIABLES], 2 * rows[part, codes.PART_TABLES]
        value = read_table(tables, rows[d, codes.NODE_TABLE], 0, variables, tables, point)
    return value


@inlined
def _set_point(
    rows: Integers, d: int, state: Integers, columns: Floats, row: int, mode: int, last: int, tables: Floats
) -> None:
    """Set the coordinate of a node's variable in the point to the node's value at the boundary."""
    boundary = state[BOUNDARY, d]
    value = columns[row, boundary] if boundary <= last else beyond(mode, rows[d, codes.NODE_WEAK])
    tables[2 * rows[len(rows) - 1, codes.PART_TABLES], rows[d, codes.NODE_VARIABLE]] = value


@inlined
def has_column(rows: Integers) -> bool:
    """Return whether the root has a column. A root that joins all positions needs none."""
    root = len(rows) - 2
    return bool(rows[root, codes.NODE_A] >= 0 or rows[root, codes.NODE_VARIABLE] < 0)


@inlined
def _bring_up(
    rows: Integers, history: Floats, stamps: Integers, columns: Floats, state: Integers, tables: Floats,
    mode: int, last: int, is_fresh: bool,
) -> None:  # fmt: skip
    """Update the columns of one set to the last sample; if `is_fresh`, compute all their numbers."""
    nodes, first = len(rows) - 1, mode * (len(rows) - 1)
    for d in range(nodes if has_column(rows) else nodes - 1):
        code, a, b = rows[d, codes.NODE_CODE], rows[d, codes.NODE_A], rows[d, codes.NODE_B]
        column, begin, end, lowest = first + d, last, last, state[LOWS, d]
        if code == codes.LITERAL:
            begin = lowest if is_fresh else last
            for k in range(begin, last + 1):
                columns[column, k] = history[a, k]
        elif code in (codes.PART_AND, codes.PART_OR):
            is_or, left, right = code == codes.PART_OR, first + a, first + b
            begin = max(min(state[CHANGED, a], state[CHANGED, b]), lowest)
            end = max(state[CHANGED_END, a], state[CHANGED_END, b])
            while (
                begin < end
                and not is_fresh
                and better(is_or, columns[left, begin], columns[right, begin]) == columns[column, begin]
            ):
                begin += 1
            left_values, right_values, values = (
                columns[left, begin:end],
                columns[right, begin:end],
                columns[column, begin:end],
            )
            if is_or:
                for k in range(len(values)):
                    values[k] = max(left_values[k], right_values[k])
            else:
                for k in range(len(values)):
                    values[k] = min(left_values[k], right_values[k])
            columns[column, last] = better(is_or, columns[left, last], columns[right, last])
        elif code in (codes.UNTIL, codes.RELEASE):
            left, right, strong = first + max(a, 0), first + b, code == codes.UNTIL
            changed, begin = state[CHANGED, b], last + 1
            if a >= 0:
                changed = min(changed, state[CHANGED, a])
            value, is_same = beyond(mode, rows[d, codes.NODE_WEAK]), False
            while begin > lowest and not is_same:
                if a >= 0:
                    value = better(not strong, columns[left, begin - 1], value)
                value = better(strong, columns[right, begin - 1], value)
                is_same = not is_fresh and begin <= min(changed, last) and columns[column, begin - 1] == value
                if not is_same:
                    begin -= 1
                    columns[column, begin] = value
            if rows[d, codes.NODE_VARIABLE] >= 0:
                _set_point(rows, d, state, columns, column, mode, last, tables)
        elif code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
            left, right, start = first + max(a, 0), first + b, state[STATE, d]
            value, begin = _start_of_past(rows, d, state, tables), min(state[CHANGED, b], last)
            if a >= 0:
                begin = min(begin, state[CHANGED, a])
            # the start value comes from a table, so it may depend on later samples
            if start >= 0 and (is_fresh or columns[column, start] != value):
                columns[column, start], begin = value, start
            begin = start + 1 if is_fresh else max(begin, start + 1)
            if begin > start + 1:
                value = columns[column, begin - 1]
            changed = _run_since(
                code == codes.PAST_SINCE, a >= 0, columns, left, right, column, value, begin, last
            )
            begin = lowest if is_fresh else changed
        elif code in (codes.SHIFT, codes.PAST_DELAY):
            window, child = window_of(rows, d), first + a
            missing = beyond(mode if window[0] else codes.OPEN_END, rows[d, codes.NODE_WEAK])
            if is_fresh:
                begin = lowest
            elif window[0]:
                begin = max(min(_first_starting(state, window, state[CHANGED, a], last), last), lowest)
            else:
                begin = max(min(_first_holding(state, window, state[CHANGED, a], last), last), lowest)
            for k in range(begin, last + 1):
                at = _start(state, window, k, last) if window[0] else _after(state, window, k, last) - 1
                columns[column, k] = columns[child, at] if 0 <= at <= last else missing
        else:
            begin, end = _run_window(rows, d, stamps, state, columns, mode, last, is_fresh)
        if begin >= end:
            begin, end = last, 0
        state[CHANGED, d], state[CHANGED_END, d] = begin, end
    if not has_column(rows):
        body = rows[nodes - 1, codes.NODE_B]
        is_until, joined = rows[nodes - 1, codes.NODE_CODE] == codes.UNTIL, EXTRA * nodes + JOINED + mode
        nothing, complete = -np.inf if is_until else np.inf, (last + 1) // BLOCK
        for k in range(state[CHANGED, body] // BLOCK, complete):
            if k == complete - 1 or k * BLOCK < state[CHANGED_END, body]:
                columns[joined, k] = extremum(
                    is_until, columns, first + body, k * BLOCK, (k + 1) * BLOCK, nothing
                )


# ------------------------------------------------------------------------------------- the results of a part


@inlined
def _join_blocks(
    is_until: bool, columns: Floats, body: int, joined: int, value: float, begin: int, end: int
) -> float:
    """Join a number with the numbers at begin … end - 1, using joined blocks."""
    first_block, block_end = begin // BLOCK + 1, end // BLOCK
    blocks_begin = min(first_block * BLOCK, end)
    value = extremum(is_until, columns, body, begin, blocks_begin, value)
    value = extremum(is_until, columns, joined, first_block, block_end, value)
    return extremum(is_until, columns, body, max(blocks_begin, block_end * BLOCK), end, value)


@inlined
def _at_first(
    rows: Integers, columns: Floats, state: Integers, tables: Floats, mode: int, last: int
) -> float:
    """Return the root's value at the first sample, from the columns of a set."""
    nodes, base = len(rows) - 1, state[HEAD, BASE]
    first, root = mode * nodes, nodes - 1
    value = beyond(mode, rows[root, codes.NODE_WEAK])
    if not has_column(rows):
        is_until, body = rows[root, codes.NODE_CODE] == codes.UNTIL, first + rows[root, codes.NODE_B]
        value = _join_blocks(is_until, columns, body, EXTRA * nodes + JOINED + mode, value, base, last + 1)
    elif base <= last:
        value = columns[first + root, base]
    if state[HEAD, IS_BEGUN]:
        variables, point = rows[nodes, codes.PART_VARIABLES], 2 * rows[nodes, codes.PART_TABLES]
        if rows[root, codes.NODE_VARIABLE] >= 0:
            tables[point, rows[root, codes.NODE_VARIABLE]] = value
        value = read_table(tables, 0, 0, variables, tables, point)
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
        columns: (EXTRA * D + EXTRA_ROWS, room); the last four rows are output, the results of the part.
        state: state of the part (see `HEAD`).
        tables: (2 T + 2, …), tables of the part and of its past operators, space for the next tables, a
            point at which tables are read, and start values of past operators.
        bounds: 1 to compute the lower bound, 2 for the upper bound, 3 for both.
    """
    nodes = len(rows) - 1
    root, first_result = nodes - 1, EXTRA * nodes + RESULTS
    is_until = rows[root, codes.NODE_CODE] == codes.UNTIL
    corners, has_now = 1 << rows[nodes, codes.PART_VARIABLES], rows[nodes, codes.PART_HAS_NOW] > 0
    for k in range(count):
        last = begin + k
        if state[HEAD, IS_BEGUN] and not has_now and tables[0, 0] == tables[0, corners - 1]:
            # the extreme corners agree: no later sample can change the value
            columns[first_result, k] = columns[first_result + 2, k] = columns[first_result + 3, k] = tables[
                0, 0
            ]
            continue
        if state.shape[0] > STARTS:
            _enter(rows, stamps, state, last)
        for mode in range(SETS):
            result_row = first_result + mode + (mode != codes.OPEN_END)
            if mode != codes.OPEN_END and not bounds >> (mode - 1) & 1:
                continue
            if mode != codes.OPEN_END and _is_known(rows, state, mode):
                corner = 0 if mode == codes.OPEN_LOW else corners - 1
                columns[result_row, k] = tables[0, corner] if state[HEAD, IS_BEGUN] else beyond(mode, 0)
                continue
            # columns are computed again if they lack the previous sample
            is_fresh = state[HEAD, KNOWN + mode] != last - 1 or last == 0
            state[HEAD, KNOWN + mode] = last
            if is_fresh:
                find_lows(rows, state, stamps, last)
            _bring_up(rows, history, stamps, columns, state, tables, mode, last, is_fresh)
            columns[result_row, k] = _at_first(rows, columns, state, tables, mode, last)
        if has_now and has_column(rows):
            columns[first_result + RESULT_NOW, k] = columns[root, last]
        elif has_now:
            columns[first_result + RESULT_NOW, k] = better(
                is_until,
                columns[rows[root, codes.NODE_B], last],
                beyond(codes.OPEN_END, rows[root, codes.NODE_WEAK]),
            )
        # counted from the first sample of the run, so that tiles of any length absorb at the same samples
        if (state[HEAD, OFFSET] + last) % CLOSING == CLOSING - 1:
            _absorb(rows, stamps, columns, state, tables, last)


# ------------------------------------------------------------------------------ closed positions go to tables


@piece
def _reach(
    rows: Integers, state: Integers, stamps: Integers, root_low: int, root_high: int, last: int
) -> bool:
    """Find the positions of each node that the root needs at root_low … root_high.

    They are written to `LOW` and `HIGH`. `PLAIN` is `LOW` before it is widened to boundaries and states.

    Returns:
        whether all windows between these positions and the root have closed.
    """
    nodes, is_closed = len(rows) - 1, True
    for d in range(nodes):
        state[LOW, d], state[HIGH, d] = _NEVER, -1
    state[LOW, nodes - 1], state[HIGH, nodes - 1] = root_low, root_high
    for d in range(nodes - 1, -1, -1):
        code, a, b = rows[d, codes.NODE_CODE], rows[d, codes.NODE_A], rows[d, codes.NODE_B]
        state[PLAIN, d] = state[LOW, d]
        if rows[d, codes.NODE_VARIABLE] >= 0 and state[HEAD, IS_BEGUN]:
            state[LOW, d] = min(state[LOW, d], state[BOUNDARY, d])
        if rows[d, codes.NODE_TABLE] >= 0:
            # the column also has the start value of the operator
            state[LOW, d] = min(state[LOW, d], max(state[STATE, d], 0))
        low, high = state[LOW, d], state[HIGH, d]
        if code == codes.LITERAL:
            continue
        window = window_of(rows, d)
        if code in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN):
            is_closed = is_closed and high < _first_open(state, stamps, window, last)
            high = _after(state, window, high, last) - 1
        elif code == codes.SHIFT:
            shifted = _start(state, window, high, last)
            is_closed = is_closed and shifted <= last
            farthest = _after(state, window, high, last) - 1 if window[3] >= 0 else shifted
            high = min(max(shifted, farthest), last)
        elif code in (codes.PAST_WINDOW_MAX, codes.PAST_WINDOW_MIN):
            low = _start(state, window, min(low, last), last)
        elif code == codes.PAST_DELAY:
            low = max(_after(state, window, min(low, last), last) - 1, 0)
        if a >= 0:
            state[LOW, a] = min(state[LOW, a], low)
            state[HIGH, a] = max(state[HIGH, a], high, state[HIGH, d])
        if not (
            codes.PART_WINDOW_MAX <= code <= codes.SHIFT or codes.PAST_WINDOW_MAX <= code <= codes.PAST_DELAY
        ):
            state[LOW, b], state[HIGH, b] = min(state[LOW, b], low), max(state[HIGH, b], high)
    return is_closed


@piece
def find_lows(rows: Integers, state: Integers, stamps: Integers, last: int) -> None:
    """Store the first position of each node that is still needed."""
    _reach(rows, state, stamps, min(state[HEAD, BASE], last), last, last)
    for d in range(len(rows) - 1):
        state[LOWS, d] = state[LOW, d]


@piece
def _run_corner(
    rows: Integers, stamps: Integers, columns: Floats, state: Integers, tables: Floats, corner: int, last: int
) -> None:
    """Compute the nodes that depend on a variable or a table, at `LOW` … `HIGH`, for one corner."""
    nodes = len(rows) - 1
    point, corner_columns = 2 * rows[nodes, codes.PART_TABLES], SETS * nodes
    for d in range(nodes):
        if not rows[d, codes.NODE_DEPENDS]:
            continue
        code, a, b = rows[d, codes.NODE_CODE], max(rows[d, codes.NODE_A], 0), rows[d, codes.NODE_B]
        has_left, low, high = rows[d, codes.NODE_A] >= 0, state[LOW, d], state[HIGH, d]
        left = corner_columns + a if rows[a, codes.NODE_DEPENDS] else a
        right = corner_columns + b if rows[b, codes.NODE_DEPENDS] else b
        column = corner_columns + d
        if code in (codes.PART_AND, codes.PART_OR):
            for k in range(low, high + 1):
                columns[column, k] = better(code == codes.PART_OR, columns[left, k], columns[right, k])
        elif code in (codes.UNTIL, codes.RELEASE):
            variable, strong, start = rows[d, codes.NODE_VARIABLE], code == codes.UNTIL, -np.inf
            if variable >= 0 and corner >> variable & 1:
                start = np.inf
            value = start
            for k in range(high, low - 1, -1):
                if has_left:
                    value = better(not strong, columns[left, k], value)
                value = better(strong, columns[right, k], value)
                columns[column, k] = value
            if variable >= 0:
                boundary = state[BOUNDARY, d]
                tables[point, variable] = columns[column, boundary] if boundary <= high else start
        elif code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
            value = _start_of_past(rows, d, state, tables)
            tables[point + 1, rows[d, codes.NODE_TABLE]] = value
            begin = state[STATE, d] + 1
            _run_since(code == codes.PAST_SINCE, has_left, columns, left, right, column, value, begin, high)
        elif code in (codes.SHIFT, codes.PAST_DELAY):
            window, missing = window_of(rows, d), beyond(codes.OPEN_END, rows[d, codes.NODE_WEAK])
            for k in range(low, high + 1):
                at = _start(state, window, k, last) if window[0] else _after(state, window, k, last) - 1
                columns[column, k] = columns[left, at] if 0 <= at <= last else missing
        else:
            is_greatest = code in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX)
            scratch = EXTRA * nodes + BEFORE
            _slide(
                is_greatest, window_of(rows, d), state, columns, left, column, scratch, low, high + 1, last
            )


@piece
def _renew_tables(
    rows: Integers, stamps: Integers, columns: Floats, state: Integers, tables: Floats, last: int
) -> None:
    """Compute the tables of a part again, with more positions from its base on."""
    nodes = len(rows) - 1
    count, variables = rows[nodes, codes.PART_TABLES], rows[nodes, codes.PART_VARIABLES]
    for corner in range(1 << variables):
        _run_corner(rows, stamps, columns, state, tables, corner, last)
        if state[HEAD, IS_BEGUN]:
            tables[count, corner] = read_table(tables, 0, 0, variables, tables, 2 * count)
        else:
            root = nodes - 1
            tables[count, corner] = columns[
                SETS * nodes + root if rows[root, codes.NODE_DEPENDS] else root, 0
            ]
        for d in range(nodes):
            table, at = rows[d, codes.NODE_TABLE], state[PLAIN, d] - 1
            if table >= 0:
                is_new = at > state[STATE, d]
                value = columns[SETS * nodes + d, at] if is_new else tables[2 * count + 1, table]
                tables[count + table, corner] = value
    for table in range(count):
        for corner in range(1 << variables):
            tables[table, corner] = tables[count + table, corner]


@inlined
def _pass_outdone(rows: Integers, columns: Floats, state: Integers, tables: Floats, last: int) -> None:
    """Move the base over positions with open windows that cannot change the root any more.

    The table bounds `G x` from above. A position has no effect once x is at least this bound, because x
    never falls.
    """
    root, base = len(rows) - 2, state[HEAD, BASE]
    is_until, body = rows[root, codes.NODE_CODE] == codes.UNTIL, rows[root, codes.NODE_B]
    # docs/design/monitor.md shows an example; few positions stay open in most recordings
    limit = tables[0, 0] if is_until else tables[0, 1]
    while base <= last and not _outdoes(is_until, columns[body, base], limit):
        base += 1
    state[HEAD, BASE] = state[BOUNDARY, root] = base


@piece
def _absorb(
    rows: Integers, stamps: Integers, columns: Floats, state: Integers, tables: Floats, last: int
) -> None:
    """Move the base over all positions whose windows have all closed."""
    # large runs first: the tables are then computed once for many positions
    size, old_base = CLOSING, state[HEAD, BASE]
    while size > 0:
        base = state[HEAD, BASE]
        if base + size > last + 1 or not _reach(rows, state, stamps, base, base + size - 1, last):
            size //= 2
            continue
        _renew_tables(rows, stamps, columns, state, tables, last)
        for d in range(len(rows) - 1):
            if rows[d, codes.NODE_VARIABLE] >= 0:
                state[BOUNDARY, d] = state[HIGH, d] + 1
            if rows[d, codes.NODE_TABLE] >= 0:
                state[STATE, d] = max(state[STATE, d], state[PLAIN, d] - 1)
        state[HEAD, BASE], state[HEAD, IS_BEGUN] = base + size, 1
    if rows[len(rows) - 1, codes.PART_IS_MONOTONE] and state[HEAD, IS_BEGUN]:
        _pass_outdone(rows, columns, state, tables, last)
    if state[HEAD, BASE] > old_base:
        find_lows(rows, state, stamps, last)
