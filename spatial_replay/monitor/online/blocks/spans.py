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

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.node_columns import look_of
from spatial_replay.monitor.online.open_windows import root_window, runs_root
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import is_decided
from spatial_replay.monitor.online.state import (
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
    for bit in range(CORNER_BITS):
        if span[ROWS_FROM + bit] == row or row < 0:
            return True
        if span[ROWS_FROM + bit] < 0:
            span[ROWS_FROM + bit] = row
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
def corner_below(span: Integers, corner: int, other: Integers) -> int:
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
        # two of this span, and four of the window's own, have to fit in
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
                # no more than these, so that they fit
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


@uncounted
def _cut_span(spans: Integers, count: int, at: int) -> int:
    """Have a span begin at a position, if that has rows or tables; return how many there are, or -1."""
    k = span_at(spans, count, at)
    if k == 0 or spans[k, BEGIN] == at or at >= spans[k, END]:
        return count
    if count >= MOST_SPANS:
        return -1
    for later in range(count, k, -1):
        for number in range(spans.shape[1]):
            spans[later, number] = spans[later - 1, number]
    spans[k, END] = spans[k + 1, BEGIN] = at
    return count + 1


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
    if runs_root(part, nodes[end - 1]):
        return 1
    # the root joins whole spans, and none outside its window or before its base
    body, base = nodes[end - 1, codes.NODE_B], memory.cells[part[codes.PART_CELL_START]]
    for at in (*root_window(nodes[end - 1], memory, last), base):
        count = scratch.span_counts[body]
        scratch.span_counts[body] = _cut_span(scratch.spans[body], count, at) if count > 0 else count
    return 1 if scratch.span_counts[body] > 0 else 0
