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
for none. The rows it follows come next, one for each bit."""

ROWS_FROM: Final = 6
IN_COLUMN, IN_ROWS, IN_TABLE = range(3)
"""Kinds of spans: what they are stands in the node's column, in rows of its own, in its table."""

THROUGH: Final = 1 << 20
"""Stands for the span of a window's last position where that is the newest sample."""


@inlined
def _span_at(spans: Integers, count: int, position: int) -> int:
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
def _takes_rows(span: Integers, other: Integers) -> bool:
    """Have a span follow the rows of another, too; return False if a bit would stand for two rows."""
    for bit in range(CORNER_BITS):
        row = other[ROWS_FROM + bit]
        if row >= 0 and span[ROWS_FROM + bit] >= 0 and span[ROWS_FROM + bit] != row:
            return False
        span[ROWS_FROM + bit] = max(span[ROWS_FROM + bit], row)
    return True


@uncounted
def _window_spans(
    node: Integers, place: int, bit: int, decided: bool, stamps: Integers, offset: int, since: int, last: int,
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
        left, right = _span_at(operand, others, start), _span_at(operand, others, reach)
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
        fits = operand[left, KIND] == IN_ROWS or _takes_rows(span, operand[left])
        if not is_through and operand[right, KIND] != IN_ROWS:
            fits = fits and _takes_rows(span, operand[right])
        if not fits:
            return -1
        if kind == IN_TABLE and row >= 0:
            span[ROWS_FROM + bit] = row
        count += 1
    return count


@uncounted
def _joined_spans(
    begin: int, last: int, one: Integers, ones: int, two: Integers, twos: int, spans: Integers
) -> int:
    """Find the spans of an `and` or `or` from `begin` on; return how many there are then, or -1."""
    count, first = 1, begin
    while first <= last:
        a, b = _span_at(one, ones, first), _span_at(two, twos, first)
        end = min(one[a, END], two[b, END])
        if count >= MOST_SPANS:
            return -1
        kind = IN_ROWS if one[a, KIND] == IN_ROWS or two[b, KIND] == IN_ROWS else IN_TABLE
        _enter_span(spans, count, first, end, kind, a, b, -1)
        if kind == IN_TABLE and not (_takes_rows(spans[count], one[a]) and _takes_rows(spans[count], two[b])):
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
    stamps, offset, windows = memory.stamps, memory.clock[OFFSET], 0
    first = part[codes.PART_FIRST]
    for d in range(first, part[codes.PART_END] - 1):
        place, node, spans = d - first, nodes[d], scratch.spans[d - first]
        code, begin = node[codes.NODE_CODE], scratch.begins[place]
        if code == codes.LITERAL:
            _enter_span(spans, 0, offset, since, IN_COLUMN, -1, -1, -1)
            _enter_span(spans, 1, since, last + 1, IN_ROWS, -1, -1, -1)
            scratch.span_counts[place] = 2
            scratch.corner_bits[place] = 0
            continue
        _enter_span(spans, 0, offset, begin, IN_COLUMN, -1, -1, -1)
        a, b = node[codes.NODE_A], node[codes.NODE_B]
        one, ones, bits = scratch.spans[a], scratch.span_counts[a], scratch.corner_bits[a]
        count = -1
        if code in (codes.PART_AND, codes.PART_OR):
            two, twos = scratch.spans[b], scratch.span_counts[b]
            count = _joined_spans(begin, last, one, ones, two, twos, spans)
            bits |= scratch.corner_bits[b]
        elif windows < CORNER_BITS:
            count = _window_spans(
                node, place, windows, is_decided(node, mode) and code in codes.AHEAD_OF, stamps, offset,
                since, last, begin, one, ones, spans, scratch.cuts,
            )  # fmt: skip
            scratch.bit_of[place] = windows
            for k in range(1, count):
                if spans[k, ROWS_FROM + windows] >= 0:
                    bits |= 1 << windows
            windows += 1
        if count < 0:
            return 0
        scratch.span_counts[place] = count
        scratch.corner_bits[place] = bits
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
            for k in range(count - 1, -1, -1):
                value = max(value, stretch[k])
                target[k] = value
        else:
            for k in range(count - 1, -1, -1):
                value = min(value, stretch[k])
                target[k] = value
        return
    for k in range(count - 1, -1, -1):
        while at > starts[k]:
            at -= 1
            value = either(is_greatest, value, source[at - base])
        target[k] = value


@uncounted
def _join_right(
    is_greatest: bool, source: Floats, base: int, begin: int, afters: Integers, is_even: bool, target: Floats
) -> None:
    """Join numbers with the extrema from `begin` to where windows end (see `_join_left`)."""
    at, count = afters[0], len(target)
    value = extremum(is_greatest, source[begin - base : at - base], -np.inf if is_greatest else np.inf)
    if is_even:
        stretch = source[at - 1 - base : at - 1 - base + count]
        if is_greatest:
            for k in range(count):
                value = max(value, stretch[k])
                target[k] = max(target[k], value)
        else:
            for k in range(count):
                value = min(value, stretch[k])
                target[k] = min(target[k], value)
        return
    for k in range(count):
        while at < afters[k]:
            value = either(is_greatest, value, source[at - base])
            at += 1
        target[k] = either(is_greatest, target[k], value)


@apart
def fill_tables(table_at: int, number: int, which: int, channels: int, since: int, last: int) -> int:
    """Compute what all nodes of a part are at the corners, in spans with tables, and over these spans."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, look = tables.nodes, tables.parts[number], look_of(which, channels)
    columns, history = memory.columns[columns_number(which)], memory.history[look.channel]
    recent, offset, first = recent_of(memory, scratch), memory.clock[OFFSET], part[codes.PART_FIRST]
    lowest, starts, afters = scratch.block[BLOCK_LOWEST], scratch.ends[0], scratch.ends[1]
    for d in range(first, part[codes.PART_END]):
        place, node = d - first, nodes[d]
        code, is_root = node[codes.NODE_CODE], d == part[codes.PART_END] - 1
        if code == codes.LITERAL:
            continue
        a, b = node[codes.NODE_B] if is_root else node[codes.NODE_A], node[codes.NODE_B]
        is_greatest = code in (codes.PART_OR, codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX, codes.UNTIL)
        signal = signal_of(nodes, first + a)
        column = columns[first + a] if signal < 0 else history[signal]
        one, used = scratch.spans[a], scratch.corner_bits[a]
        if code in (codes.PART_AND, codes.PART_OR):
            other_signal = signal_of(nodes, first + b)
            other = columns[first + b] if other_signal < 0 else history[other_signal]
            two, used_by_two = scratch.spans[b], scratch.corner_bits[b]
            for k in range(1, scratch.span_counts[place]):
                span = scratch.spans[place, k]
                if span[KIND] != IN_TABLE:
                    continue
                begin, end = span[BEGIN], span[END]
                for corner in range(1 << CORNER_BITS):
                    if corner & ~scratch.corner_bits[place]:
                        continue
                    target = scratch.corner_columns[place, corner, begin - lowest : end - lowest]
                    source, base = column, offset
                    if one[span[LEFT], KIND] == IN_TABLE:
                        source, base = scratch.corner_columns[a, corner & used], lowest
                    second, base_of_second = other, offset
                    if two[span[RIGHT], KIND] == IN_TABLE:
                        second, base_of_second = scratch.corner_columns[b, corner & used_by_two], lowest
                    join(
                        is_greatest,
                        source[begin - base : end - base],
                        second[begin - base_of_second : end - base_of_second],
                        target,
                    )
            continue
        # what a window, or the root, holds of its operand's spans
        for k in range(1, scratch.span_counts[a]):
            if one[k, KIND] != IN_TABLE:
                continue
            for corner in range(1 << CORNER_BITS):
                if not corner & ~used:
                    source = scratch.corner_columns[a, corner, one[k, BEGIN] - lowest : one[k, END] - lowest]
                    nothing = -np.inf if is_greatest else np.inf
                    scratch.sums[place, k, corner] = extremum(is_greatest, source, nothing)
        if is_root:
            continue
        value, bit = beyond(look.mode, node[codes.NODE_WEAK]), 1 << scratch.bit_of[place]
        own = scratch.corner_bits[place]
        for k in range(1, scratch.span_counts[place]):
            span = scratch.spans[place, k]
            begin, end, left, right = span[BEGIN], span[END], span[LEFT], span[RIGHT]
            if left < 0:
                for corner in range(1 << CORNER_BITS):
                    if not corner & ~own:
                        fill(scratch.corner_columns[place, corner, begin - lowest : end - lowest], value)
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
            for corner in range(1 << CORNER_BITS):
                if corner & ~(own | used) or corner & bit:
                    continue
                target = scratch.corner_columns[place, corner, begin - lowest : end - lowest]
                source, base = column, offset
                if has_left:
                    if one[left, KIND] == IN_TABLE:
                        source, base = scratch.corner_columns[a, corner & used], lowest
                    if left == right:
                        _slide(is_greatest, source, base, starts, afters, target)
                    else:
                        _join_left(is_greatest, source, base, starts, starts_evenly, one[left, END], target)
                else:
                    fill(target, -np.inf if is_greatest else np.inf)
                if has_right:
                    source, base = column, offset
                    if one[right, KIND] == IN_TABLE:
                        source, base = scratch.corner_columns[a, corner & used], lowest
                    first_of_right = one[right, BEGIN]
                    _join_right(is_greatest, source, base, first_of_right, afters, ends_evenly, target)
                if not own & bit:
                    continue
                beside = scratch.corner_columns[place, corner | bit, begin - lowest : end - lowest]
                copy(target, beside)
                if span[ROWS_FROM + scratch.bit_of[place]] >= 0:
                    # where the row between is as great as can be, say, it outdoes the rest
                    fill(beside if is_greatest else target, np.inf if is_greatest else -np.inf)
    return 1
