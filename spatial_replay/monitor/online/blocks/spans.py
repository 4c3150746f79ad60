"""Spans of neighbouring positions at which a node follows a few rows alike, while many samples come.

With many open positions, nearly all of them lie between those where a window begins or ends with one of the
next samples. There, what a node is depends on these samples by way of few rows, which all positions of a span
have in common: what windows hold that lies beyond the span. In them it is a lattice polynomial, as a part's
table is in its variables (see `tables`): the numbers at the corners say what it is for any. So each such
position takes a number for each corner, once for many blocks of samples, in place of a row for each block.

A node's spans follow one another, the first up to where its own rows begin. They are found for the samples of
several blocks together (`find_spans`), with their tables (`fill_tables`).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.node_columns import columns_number, look_of, signal_of
from spatial_replay.monitor.online.open_windows import runs_root
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import (
    Recent,
    beyond,
    copy,
    either,
    extremum,
    fill,
    is_decided,
    join,
    recent_of,
)
from spatial_replay.monitor.online.state import (
    BLOCK_LOWEST,
    CORNER_BITS,
    MOST_SPANS,
    OFFSET,
    ahead,
    behind,
    first_behind,
    last_ahead,
)

BEGIN, END, KIND, LEFT, RIGHT, ROW = range(6)
"""What the numbers of a span stand for: its first position, and what comes after it; which kind it is; of a
window, the operand's spans that its first and its last position lie in, and the row of what lies between, -1
for none; of others, the spans of both operands, and of an operator without a window the row that the next
position is, or the one before. The rows it follows come next, its own one first, one for each bit of a
corner."""

ROWS_FROM: Final = 6
IN_COLUMN, IN_ROWS, IN_TABLE = range(3)
"""Kinds of spans: what they are stands in the node's column, in rows of its own, in its table."""

THROUGH: Final = 1 << 20
"""Stands for the span of a window's last position where that is the newest sample."""


@inlined
def span_at(spans: Integers, count: int, position: int) -> int:
    """Return which span a position lies in."""
    span = count - 1
    while span > 0 and spans[span, BEGIN] > position:
        span -= 1
    return span


@inlined
def _first_reaching(node: Integers, stamps: Integers, offset: int, last: int, at: int) -> int:
    """Return the first position whose window reaches a position."""
    unit, near, far = node[codes.NODE_UNIT], node[codes.NODE_LOW], node[codes.NODE_HIGH]
    if node[codes.NODE_CODE] in codes.PAST_WINDOWS:
        return int(ahead(stamps, offset, last, at, unit, near)) if at <= last else last + 1
    return int(first_behind(stamps, offset, at, unit, far)) if at <= last else last + 1


@inlined
def _first_starting(node: Integers, stamps: Integers, offset: int, last: int, at: int) -> int:
    """Return the first position whose window starts at a position, or later."""
    unit, near, far = node[codes.NODE_UNIT], node[codes.NODE_LOW], node[codes.NODE_HIGH]
    if at <= offset:
        return offset
    if node[codes.NODE_CODE] in codes.PAST_WINDOWS:
        return int(last_ahead(stamps, offset, last, at - 1, unit, far)) + 1
    return int(max(behind(stamps, offset, at - 1, unit, near) + 1, offset))


@uncounted
def _sorted_into(cuts: Integers, count: int, at: int, begin: int, end: int) -> int:
    """Enter where a span may begin among those found so far; return how many there are."""
    if at <= begin or at >= end:
        return count
    k = count
    while k > 0 and cuts[k - 1] > at:
        k -= 1
    if k > 0 and cuts[k - 1] == at:
        return count
    for later in range(count, k, -1):
        cuts[later] = cuts[later - 1]
    cuts[k] = at
    return count + 1


@uncounted
def _enter_span(
    spans: Integers, count: int, begin: int, end: int, kind: int, left: int, right: int, row: int
) -> None:
    span = spans[count]
    span[BEGIN], span[END], span[KIND], span[LEFT], span[RIGHT], span[ROW] = (
        begin,
        end,
        kind,
        left,
        right,
        row,
    )
    for bit in range(CORNER_BITS):
        span[ROWS_FROM + bit] = -1


@uncounted
def _takes_row(span: Integers, row: int) -> bool:
    """Have a span follow a row; return False if these are too many."""
    for bit in range(ROWS_FROM, ROWS_FROM + CORNER_BITS):
        if span[bit] == row or row < 0:
            return True
        if span[bit] < 0:
            span[bit] = row
            return True
    return False


@uncounted
def _takes_rows(span: Integers, other: Integers) -> bool:
    """Have a span follow the rows of another, too; return False if these are too many."""
    fits = True
    for bit in range(CORNER_BITS):
        fits = fits and _takes_row(span, other[ROWS_FROM + bit])
    return fits


@inlined
def corners_of(span: Integers) -> int:
    """Return how many corners the rows that a span follows have."""
    corners = 1
    for bit in range(CORNER_BITS):
        corners *= 2 if span[ROWS_FROM + bit] >= 0 else 1
    return corners


@uncounted
def _corner_below(span: Integers, corner: int, other: Integers) -> int:
    """Return which corner of an operand's span one of a span is."""
    below = 0
    for bit in range(CORNER_BITS):
        for own in range(CORNER_BITS):
            is_same = other[ROWS_FROM + bit] >= 0 and span[ROWS_FROM + own] == other[ROWS_FROM + bit]
            below |= ((corner >> own) & 1) << bit if is_same else 0
    return below


@uncounted
def _window_spans(
    node: Integers, place: int, decided: bool, stamps: Integers, offset: int, since: int, last: int,
    begin: int, operand: Integers, others: int, spans: Integers, cuts: Integers,
) -> int:  # fmt: skip
    """Find the spans of a window from `begin` on; return how many there are then, or -1 for too many."""
    unit, near, far = node[codes.NODE_UNIT], node[codes.NODE_LOW], node[codes.NODE_HIGH]
    is_past, found = node[codes.NODE_CODE] in codes.PAST_WINDOWS, 0
    for k in range(others):
        if found > 2 * MOST_SPANS - 8:
            return -1
        first, start = operand[k, BEGIN], _first_starting(node, stamps, offset, last, operand[k, BEGIN])
        found = _sorted_into(cuts, found, start, begin, last + 1)
        reaching = _first_reaching(node, stamps, offset, last, first)
        found = _sorted_into(cuts, found, reaching, begin, last + 1)
    # windows that close with one of the samples, or are open after all of them
    closing, through = since, since
    found = _sorted_into(cuts, found, since, begin, last + 1)
    late = since
    if not is_past:
        closing = first_behind(stamps, offset, since - 1, unit, far - 1) if far > 0 else since
        through = behind(stamps, offset, last, unit, far) + 1
        late = behind(stamps, offset, last, unit, near) + 1
        for at in (closing, through, late):
            found = _sorted_into(cuts, found, at, begin, last + 1)
    count, k = 1, -1
    while k < found:
        first, end = begin if k < 0 else cuts[k], cuts[k + 1] if k + 1 < found else last + 1
        k += 1
        if first >= end:
            continue
        if count >= MOST_SPANS:
            return -1
        is_through = not is_past and through <= first < since
        if is_through and (decided or first >= late):
            _enter_span(spans, count, first, end, IN_TABLE, -1, -1, -1)
            count += 1
            continue
        start, reach = 0, 0
        if is_past:
            start = first_behind(stamps, offset, first, unit, far)
            reach = behind(stamps, offset, first, unit, near)
        else:
            start = ahead(stamps, offset, last, first, unit, near)
            reach = last_ahead(stamps, offset, last, first, unit, far)
        left, right = span_at(operand, others, start), span_at(operand, others, reach)
        right = THROUGH if is_through else right
        # windows that hold no sample at all
        left = min(left, right)
        stop = others if is_through else right
        row = place * MOST_SPANS + count if left + 1 < stop else -1
        kind = IN_TABLE
        if first >= since or (not is_past and closing <= first < through):
            kind = IN_ROWS
        if operand[left, KIND] == IN_ROWS or (not is_through and operand[right, KIND] == IN_ROWS):
            kind = IN_ROWS
        # neighbours of one kind, between the same spans, are one
        before = spans[count - 1]
        is_alike = before[KIND] == kind and before[LEFT] == left and before[RIGHT] == right
        if is_alike and count > 1 and first != since:
            before[END] = end
            continue
        _enter_span(spans, count, first, end, kind, left, right, row)
        span = spans[count]
        fits = kind != IN_TABLE or _takes_row(span, row)
        fits = fits and (operand[left, KIND] == IN_ROWS or _takes_rows(span, operand[left]))
        if not is_through and operand[right, KIND] != IN_ROWS:
            fits = fits and _takes_rows(span, operand[right])
        if not fits:
            return -1
        count += 1
    return count


@uncounted
def _shift_spans(
    node: Integers, stamps: Integers, offset: int, since: int, last: int, begin: int, operand: Integers,
    others: int, spans: Integers, cuts: Integers,
) -> int:  # fmt: skip
    """Find the spans of a shift from `begin` on; return how many there are then, or -1 for too many."""
    unit, near, found = node[codes.NODE_UNIT], node[codes.NODE_LOW], 0
    late = min(behind(stamps, offset, last, unit, near) + 1, since)
    for k in range(others):
        start = _first_starting(node, stamps, offset, last, operand[k, BEGIN])
        found = _sorted_into(cuts, found, start, begin, last + 1)
    for at in (since, late):
        found = _sorted_into(cuts, found, at, begin, last + 1)
    count = 1
    for k in range(-1, found):
        first, end = begin if k < 0 else cuts[k], cuts[k + 1] if k + 1 < found else last + 1
        if count >= MOST_SPANS:
            return -1
        if late <= first < since:
            _enter_span(spans, count, first, end, IN_TABLE, -1, -1, -1)
        elif first >= since:
            _enter_span(spans, count, first, end, IN_ROWS, -1, -1, -1)
        else:
            left = span_at(operand, others, ahead(stamps, offset, last, first, unit, near))
            kind = IN_ROWS if operand[left, KIND] == IN_ROWS else IN_TABLE
            _enter_span(spans, count, first, end, kind, left, left, -1)
            if kind == IN_TABLE:
                _takes_rows(spans[count], operand[left])
        count += 1
    return count


@uncounted
def _joined_spans(
    place: int, begin: int, last: int, one: Integers, ones: int, two: Integers, twos: int, spans: Integers
) -> int:
    """Find the spans of a node with two operands from `begin` on; return how many there are then, or -1.

    Args:
        place: of an operator without a window, which goes from one position to the next; -1 for others.
        ones: 0 if there is no first operand.
    """
    count, first = 1, begin
    while first <= last:
        a, b = span_at(one, ones, first) if ones else -1, span_at(two, twos, first)
        end = min(one[a, END], two[b, END]) if ones else two[b, END]
        if count >= MOST_SPANS:
            return -1
        is_in_rows = two[b, KIND] == IN_ROWS or (ones > 0 and one[a, KIND] == IN_ROWS)
        row = place * MOST_SPANS + count if place >= 0 and not is_in_rows else -1
        _enter_span(spans, count, first, end, IN_ROWS if is_in_rows else IN_TABLE, a, b, row)
        if not is_in_rows:
            fits = _takes_row(spans[count], row) and _takes_rows(spans[count], two[b])
            if not fits or (ones > 0 and not _takes_rows(spans[count], one[a])):
                return -1
        count, first = count + 1, end
    return count


@apart
def find_spans(table_at: int, number: int, which: int, channels: int, since: int, last: int) -> int:
    """Find the spans of all nodes of a part, for one of its numbers and the samples from `since` to `last`.

    Where the rows of a node begin is found (see `find_begins`).

    Returns:
        1, or 0 if there are too many, or too many rows that one span follows.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, mode = tables.nodes, tables.parts[number], look_of(which, channels).mode
    stamps, offset = memory.stamps, memory.clock[OFFSET]
    first, end = part[codes.PART_FIRST], part[codes.PART_END]
    for d in range(first, end if runs_root(part, nodes[end - 1]) else end - 1):
        place, node, spans = d - first, nodes[d], scratch.spans[d - first]
        code, begin = node[codes.NODE_CODE], scratch.begins[place]
        if code == codes.LITERAL:
            _enter_span(spans, 0, offset, since, IN_COLUMN, -1, -1, -1)
            _enter_span(spans, 1, since, last + 1, IN_ROWS, -1, -1, -1)
            scratch.span_counts[place] = 2
            continue
        _enter_span(spans, 0, offset, begin, IN_COLUMN, -1, -1, -1)
        a, b = max(node[codes.NODE_A], 0), node[codes.NODE_B]
        one, ones = scratch.spans[a], scratch.span_counts[a]
        if code in codes.BINARY_NODES:
            two, twos = scratch.spans[b], scratch.span_counts[b]
            own = -1 if code in (codes.PART_AND, codes.PART_OR) else place
            ones = ones if node[codes.NODE_A] >= 0 else 0
            count = _joined_spans(own, begin, last, one, ones, two, twos, spans)
        elif code == codes.SHIFT:
            count = _shift_spans(node, stamps, offset, since, last, begin, one, ones, spans, scratch.cuts)
        else:
            count = _window_spans(
                node, place, is_decided(node, mode) and code in codes.AHEAD_OF, stamps, offset,
                since, last, begin, one, ones, spans, scratch.cuts,
            )  # fmt: skip
        if count < 0:
            return 0
        scratch.span_counts[place] = count
    return 1


@uncounted
def _copy_ends(
    ends: Integers, unknown: int, begin: int, end: int, offset: int, most: int, target: Integers
) -> None:
    """Copy ends of windows at begin … end - 1, known up to `unknown`; those that are later are `most`."""
    known = max(min(unknown, end), begin) - begin
    for k in range(known):
        target[k] = min(ends[begin - offset + k], most)
    for k in range(known, end - begin):
        target[k] = most


@uncounted
def ends_between(
    node: Integers, recent: Recent, begin: int, end: int, offset: int, last: int, starts: Integers,
    afters: Integers,
) -> None:  # fmt: skip
    """Enter where windows of begin … end - 1 start, and what comes after them, after the sample at `last`."""
    stamps, unit, near, far = (
        recent.stamps,
        node[codes.NODE_UNIT],
        node[codes.NODE_LOW],
        node[codes.NODE_HIGH],
    )
    if node[codes.NODE_CODE] in codes.AHEAD_OF and unit == codes.SAMPLES:
        for k in range(end - begin):
            starts[k] = min(begin + k + near, last + 1)
        for k in range(end - begin):
            afters[k] = min(begin + k + far, last) + 1
        return
    if node[codes.NODE_CODE] in codes.AHEAD_OF:
        timed = node[codes.NODE_TIMED]
        begun, closed = recent.window_next[timed, 1], recent.window_next[timed, 2]
        _copy_ends(recent.window_ends[timed, 0], begun, begin, end, offset, last + 1, starts)
        _copy_ends(recent.window_ends[timed, 1], closed, begin, end, offset, last + 1, afters)
        return
    start, after = (
        first_behind(stamps, offset, begin, unit, far),
        behind(stamps, offset, begin, unit, near) + 1,
    )
    for position in range(begin, end):
        if unit == codes.SAMPLES:
            start, after = max(position - far, offset), position - near + 1
        else:
            time_ns = stamps[position - offset]
            while time_ns - stamps[start - offset] > far:
                start += 1
            while after <= position and time_ns - stamps[after - offset] >= near:
                after += 1
        starts[position - begin] = start
        afters[position - begin] = after


@uncounted
def _slide(
    is_greatest: bool, source: Floats, base: int, starts: Integers, afters: Integers, target: Floats
) -> None:
    """Compute extrema over windows that begin and end among the same numbers."""
    nothing, first, count = -np.inf if is_greatest else np.inf, 0, len(target)
    while first < count:
        middle, until = max(afters[first], starts[first]), first + 1
        while until < count and starts[until] < middle:
            until += 1
        value, at = nothing, middle
        for k in range(until - 1, first - 1, -1):
            while at > starts[k]:
                at -= 1
                value = either(is_greatest, value, source[at - base])
            target[k] = value
        value, at = nothing, middle
        for k in range(first, until):
            while at < afters[k]:
                value = either(is_greatest, value, source[at - base])
                at += 1
            target[k] = either(is_greatest, target[k], value)
        first = until


@uncounted
def _run_back(is_greatest: bool, source: Floats, start: float, target: Floats) -> None:
    """Enter the extremum of a number and of all numbers from each on.

    Four at a time, which wait for those after them only once.
    """
    value, whole = start, len(target) % 4
    for k in range(len(target) - 4, whole - 1, -4):
        a, b, c, d = source[k], source[k + 1], source[k + 2], source[k + 3]
        c = either(is_greatest, d, c)
        b = either(is_greatest, c, b)
        a = either(is_greatest, b, a)
        target[k + 3], target[k + 2] = either(is_greatest, value, d), either(is_greatest, value, c)
        target[k + 1] = either(is_greatest, value, b)
        value = either(is_greatest, value, a)
        target[k] = value
    for k in range(whole - 1, -1, -1):
        value = either(is_greatest, value, source[k])
        target[k] = value


@uncounted
def _run_on(is_greatest: bool, source: Floats, start: float, target: Floats) -> None:
    """Enter the extremum of a number and of all numbers up to each (see `_run_back`)."""
    value, whole = start, len(target) - len(target) % 4
    for k in range(0, whole, 4):
        a, b, c, d = source[k], source[k + 1], source[k + 2], source[k + 3]
        b = either(is_greatest, a, b)
        c = either(is_greatest, b, c)
        d = either(is_greatest, c, d)
        target[k], target[k + 1] = either(is_greatest, value, a), either(is_greatest, value, b)
        target[k + 2] = either(is_greatest, value, c)
        value = either(is_greatest, value, d)
        target[k + 3] = value
    for k in range(whole, len(target)):
        value = either(is_greatest, value, source[k])
        target[k] = value


@uncounted
def _run_left(is_strong: bool, left: Floats, right: Floats, start: float, target: Floats) -> None:
    """Run an operator with a left operand back from what it is after the last position (see `_run_back`)."""
    value, whole = start, len(target) % 2
    for k in range(len(target) - 2, whole - 1, -2):
        # what two positions are together waits once for those after them
        both = either(is_strong, right[k], either(not is_strong, left[k], right[k + 1]))
        held = either(not is_strong, left[k], left[k + 1])
        target[k + 1] = either(is_strong, right[k + 1], either(not is_strong, left[k + 1], value))
        value = either(is_strong, both, either(not is_strong, held, value))
        target[k] = value
    for k in range(whole - 1, -1, -1):
        value = either(is_strong, right[k], either(not is_strong, left[k], value))
        target[k] = value


@uncounted
def _join_left(
    is_greatest: bool, source: Floats, base: int, starts: Integers, is_even: bool, end: int, target: Floats
) -> None:
    """Compute extrema from where windows start to before `end`.

    Args:
        is_even: whether each starts one position after the one before, so that they need not be looked up.
    """
    at, count = max(min(starts[len(target) - 1], end), base), len(target)
    value = extremum(is_greatest, source[at - base : end - base], -np.inf if is_greatest else np.inf)
    if is_even:
        stretch = source[starts[0] - base : starts[0] - base + count]
        if is_greatest:
            _run_back(True, stretch, value, target)
        else:
            _run_back(False, stretch, value, target)
        return
    for k in range(count - 1, -1, -1):
        while at > starts[k]:
            at -= 1
            value = either(is_greatest, value, source[at - base])
        target[k] = value


@uncounted
def _join_right(
    is_greatest: bool, source: Floats, base: int, begin: int, afters: Integers, is_even: bool,
    spare: Floats, target: Floats,
) -> None:  # fmt: skip
    """Join numbers with the extrema from `begin` to where windows end (see `_join_left`)."""
    at, count = afters[0], len(target)
    value = extremum(is_greatest, source[begin - base : at - base], -np.inf if is_greatest else np.inf)
    if is_even:
        stretch = source[at - 1 - base : at - 1 - base + count]
        if is_greatest:
            _run_on(True, stretch, value, spare[:count])
        else:
            _run_on(False, stretch, value, spare[:count])
        join(is_greatest, target, spare[:count], target)
        return
    for k in range(count):
        while at < afters[k]:
            value = either(is_greatest, value, source[at - base])
            at += 1
        target[k] = either(is_greatest, target[k], value)


@uncounted
def _source(spans: Integers, span: int, span_above: Integers, corner: int) -> int:
    """Return the corner of an operand's table that one of a span above it looks at; -1 for its column."""
    return _corner_below(span_above, corner, spans[span]) if spans[span, KIND] == IN_TABLE else -1


@uncounted
def _run_corner(
    is_strong: bool, is_ahead: bool, has_left: bool, left: Floats, right: Floats, start: float, target: Floats
) -> None:
    """Run an operator without a window from one end of a span to the other."""
    if not has_left and is_ahead:
        if is_strong:
            _run_back(True, right, start, target)
        else:
            _run_back(False, right, start, target)
    elif not has_left:
        if is_strong:
            _run_on(True, right, start, target)
        else:
            _run_on(False, right, start, target)
    elif is_ahead:
        if is_strong:
            _run_left(True, left, right, start, target)
        else:
            _run_left(False, left, right, start, target)
    else:
        value = start
        for k in range(len(target)):
            value = either(is_strong, right[k], either(not is_strong, left[k], value))
            target[k] = value


@uncounted
def _look_up(source: Floats, base: int, starts: Integers, target: Floats) -> None:
    for k in range(len(target)):
        target[k] = source[starts[k] - base]


@apart
def fill_tables(table_at: int, number: int, which: int, channels: int, since: int, last: int) -> int:
    """Compute what all nodes of a part are at the corners, in spans with tables, and over these spans."""
    tables, _, scratch, _ = arrays_at(table_at)
    part, nodes, first = tables.parts[number], tables.nodes, tables.parts[number, codes.PART_FIRST]
    has_root = runs_root(part, nodes[part[codes.PART_END] - 1])
    for d in range(first, part[codes.PART_END]):
        code, place = nodes[d, codes.NODE_CODE], d - first
        if code in codes.BINARY_NODES and (has_root or d < part[codes.PART_END] - 1):
            for k in range(1, scratch.span_counts[place]):
                if scratch.spans[place, k, KIND] == IN_TABLE:
                    _fill_joined(table_at, number, d, k, which, channels)
        elif code != codes.LITERAL:
            _fill_window(table_at, number, d, which, channels, last)
    return 0


@apart
def _fill_joined(table_at: int, number: int, d: int, k: int, which: int, channels: int) -> int:
    """Compute a node with two operands at the corners of one of its spans."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, first, offset = tables.nodes, tables.parts[number, codes.PART_FIRST], memory.clock[OFFSET]
    columns = memory.columns[columns_number(which)]
    history, lowest = memory.history[look_of(which, channels).channel], scratch.block[BLOCK_LOWEST]
    node, span = nodes[d], scratch.spans[d - first, k]
    code, a, b = node[codes.NODE_CODE], max(node[codes.NODE_A], 0), node[codes.NODE_B]
    signal, other = signal_of(nodes, first + a), signal_of(nodes, first + b)
    of_one = columns[first + a] if signal < 0 else history[signal]
    of_two = columns[first + b] if other < 0 else history[other]
    begin, end, has_left = span[BEGIN], span[END], node[codes.NODE_A] >= 0
    is_strong = code in (codes.PART_OR, codes.UNTIL, codes.PAST_SINCE)
    for corner in range(corners_of(span)):
        at_one = _source(scratch.spans[a], span[LEFT], span, corner) if has_left else -1
        at_two = _source(scratch.spans[b], span[RIGHT], span, corner)
        one = scratch.corner_columns[a, max(at_one, 0)] if at_one >= 0 else of_one
        two = scratch.corner_columns[b, max(at_two, 0)] if at_two >= 0 else of_two
        base, base_of_two = lowest if at_one >= 0 else offset, lowest if at_two >= 0 else offset
        target = scratch.corner_columns[d - first, corner, begin - lowest : end - lowest]
        left, right = one[begin - base : end - base], two[begin - base_of_two : end - base_of_two]
        if code in (codes.PART_AND, codes.PART_OR):
            join(is_strong, left, right, target)
        else:
            start = np.inf if corner & 1 else -np.inf
            is_ahead = code in (codes.UNTIL, codes.RELEASE)
            _run_corner(is_strong, is_ahead, has_left, left, right, start, target)
    return 0


@apart
def _fill_window(table_at: int, number: int, d: int, which: int, channels: int, last: int) -> int:
    """Compute a window or shift at the corners of its spans, and what it, or the root, holds of each."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, look = tables.nodes, tables.parts[number], look_of(which, channels)
    columns, history = memory.columns[columns_number(which)], memory.history[look.channel]
    recent, offset, first = recent_of(memory, scratch), memory.clock[OFFSET], part[codes.PART_FIRST]
    lowest, starts, afters = scratch.block[BLOCK_LOWEST], scratch.ends[0], scratch.ends[1]
    spare = scratch.extrema[0]
    place, node, root = d - first, nodes[d], part[codes.PART_END] - 1
    is_root = d == root and not runs_root(part, nodes[root])
    code, a = node[codes.NODE_CODE], node[codes.NODE_B] if is_root else node[codes.NODE_A]
    is_greatest = code in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX, codes.UNTIL)
    signal, one = signal_of(nodes, first + a), scratch.spans[a]
    column = columns[first + a] if signal < 0 else history[signal]
    for k in range(1, scratch.span_counts[a] if code != codes.SHIFT else 1):
        if one[k, KIND] != IN_TABLE:
            continue
        for corner in range(corners_of(one[k])):
            source = scratch.corner_columns[a, corner, one[k, BEGIN] - lowest : one[k, END] - lowest]
            scratch.sums[place, k, corner] = extremum(is_greatest, source, -np.inf if is_greatest else np.inf)
    if is_root:
        return 0
    value = beyond(look.mode, node[codes.NODE_WEAK])
    for k in range(1, scratch.span_counts[place]):
        span = scratch.spans[place, k]
        begin, end, left, right = span[BEGIN], span[END], span[LEFT], span[RIGHT]
        if left < 0:
            if span[KIND] == IN_TABLE:
                fill(scratch.corner_columns[place, 0, begin - lowest : end - lowest], value)
            continue
        has_left = one[left, KIND] != IN_ROWS
        has_right = right != THROUGH and right != left and one[right, KIND] != IN_ROWS
        if not has_left and not has_right:
            continue
        ends_between(node, recent, begin, end, offset, last, starts, afters)
        steps, is_counted = end - 1 - begin, node[codes.NODE_UNIT] == codes.SAMPLES
        is_at_once = code in codes.AHEAD_OF and node[codes.NODE_LOW] == 0
        starts_evenly = (is_counted or is_at_once) and starts[steps] - starts[0] == steps
        ends_evenly = is_counted and afters[steps] - afters[0] == steps
        # of a span with rows of its own, what stands in tables is joined with these
        has_row = span[KIND] == IN_TABLE and span[ROW] >= 0
        for corner in range(0, corners_of(span), 2 if has_row else 1):
            target = scratch.corner_columns[place, corner, begin - lowest : end - lowest]
            at = _source(one, left, span, corner)
            source, base = (
                scratch.corner_columns[a, max(at, 0)] if at >= 0 else column,
                lowest if at >= 0 else offset,
            )
            if code == codes.SHIFT:
                _look_up(source, base, starts, target)
                continue
            if not has_left:
                fill(target, -np.inf if is_greatest else np.inf)
            elif left == right:
                _slide(is_greatest, source, base, starts, afters, target)
            else:
                _join_left(is_greatest, source, base, starts, starts_evenly, one[left, END], target)
            if has_right:
                at = _source(one, right, span, corner)
                source = scratch.corner_columns[a, max(at, 0)] if at >= 0 else column
                base, first_of_right = lowest if at >= 0 else offset, one[right, BEGIN]
                _join_right(is_greatest, source, base, first_of_right, afters, ends_evenly, spare, target)
            if has_row:
                beside = scratch.corner_columns[place, corner + 1, begin - lowest : end - lowest]
                copy(target, beside)
                # where the row between is as great as can be, say, it outdoes the rest
                fill(beside if is_greatest else target, np.inf if is_greatest else -np.inf)
    return 0
