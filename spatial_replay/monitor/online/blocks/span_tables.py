"""What nodes are at the corners, in spans of positions that follow a few rows alike (see `blocks.spans`).

For each corner, a node is a column of numbers, computed from those of its operands once for many blocks of
samples.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.blocks.block_ends import find_ends
from spatial_replay.monitor.online.blocks.column_scans import (
    extrema_from,
    extrema_up_to,
    found_along,
    join_extrema_up_to,
)
from spatial_replay.monitor.online.blocks.spans import (
    BEGIN,
    END,
    IN_ROWS,
    IN_TABLE,
    KIND,
    LEFT,
    RIGHT,
    ROW,
    THROUGH,
    corner_below,
    corners_of,
)
from spatial_replay.monitor.online.node_columns import columns_number, look_of, signal_of
from spatial_replay.monitor.online.open_windows import runs_root
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import beyond, either, extremum, fill, join, recent_of
from spatial_replay.monitor.online.state import (
    BLOCK_LOWEST,
    OFFSET,
)


@uncounted
def _slide(
    is_greatest: bool, source: Floats, base: int, starts: Integers, afters: Integers, row: Floats,
    spare: Floats, target: Floats,
) -> None:  # fmt: skip
    """Compute extrema over windows that begin and end among the same numbers."""
    first, count = 0, len(target)
    while first < count:
        middle, until = max(afters[first], starts[first]), first + 1
        while until < count and starts[until] < middle:
            until += 1
        some, others = starts[first:until], afters[first:until]
        _join_left(is_greatest, source, base, some, False, middle, row, spare, target[first:until])
        _join_right(is_greatest, source, base, middle, others, False, row, spare, target[first:until])
        first = until


@uncounted
def _join_left(
    is_greatest: bool, source: Floats, base: int, starts: Integers, is_even: bool, end: int, row: Floats,
    spare: Floats, target: Floats,
) -> None:  # fmt: skip
    """Compute extrema from where windows start to before `end`.

    Args:
        is_even: whether each starts one position after the one before, so that they need not be looked up.
        row, spare: (ROW,) and (2 * room,), room to work in.
    """
    first, count = starts[0], len(target)
    at = max(min(starts[count - 1], end), base)
    value = extremum(is_greatest, source[at - base : end - base], -np.inf if is_greatest else np.inf)
    if is_even:
        extrema_from(is_greatest, source[first - base : first - base + count], value, row, target)
        return
    before = max(at - first, 0)
    extrema_from(is_greatest, source[first - base : at - base], value, row, spare[:before])
    spare[before] = value
    for k in range(count):
        target[k] = spare[min(starts[k] - first, before)]


@uncounted
def _join_right(
    is_greatest: bool, source: Floats, base: int, begin: int, afters: Integers, is_even: bool,
    row: Floats, spare: Floats, target: Floats,
) -> None:  # fmt: skip
    """Join numbers with the extrema from `begin` to where windows end (see `_join_left`)."""
    # windows that hold no sample at all end before they begin
    at, count = max(afters[0], begin), len(target)
    value = extremum(is_greatest, source[begin - base : at - base], -np.inf if is_greatest else np.inf)
    if is_even:
        # the first number is in the value, too
        join_extrema_up_to(is_greatest, source[at - 1 - base : at - 1 - base + count], value, row, target)
        return
    spare[0], last = value, max(afters[count - 1], at)
    extrema_up_to(is_greatest, source[at - base : last - base], value, row, spare[1 : 1 + last - at])
    for k in range(count):
        target[k] = either(is_greatest, target[k], spare[max(afters[k] - at, 0)])


@inlined
def _source_of(
    tables: Floats, spans: Integers, span: int, above: Integers, corner: int, column: Floats, offset: int,
    lowest: int,
) -> tuple[Floats, int]:  # fmt: skip
    """Return what an operand is in one of its spans at a corner of a span above, and the first position.

    Args:
        tables: (corners, positions), of the operand.
        column: its numbers from `offset` on, where they are the same for all samples.
    """
    if spans[span, KIND] == IN_TABLE:
        return tables[corner_below(above, corner, spans[span])], lowest
    return column, offset


@uncounted
def _run_corners(
    is_strong: bool, is_ahead: bool, has_left: bool, left: Floats, right: Floats, row: Floats, worst: Floats,
    best: Floats,
) -> None:  # fmt: skip
    """Run an operator without a window from one end of a span to the other, at the corners of its own row.

    At one of these, nothing comes to what is found on the way; at the other, as much, or as little, as the
    left operand has let through up to there.
    """
    neutral, found, passed = (-np.inf, worst, best) if is_strong else (np.inf, best, worst)
    if not has_left:
        fill(passed, -neutral)
        if is_ahead:
            extrema_from(is_strong, right, neutral, row, found)
        else:
            extrema_up_to(is_strong, right, neutral, row, found)
        return
    found_along(is_strong, is_ahead, left, right, row, found)
    if is_ahead:
        extrema_from(not is_strong, left, -neutral, row, passed)
    else:
        extrema_up_to(not is_strong, left, -neutral, row, passed)
    join(is_strong, found, passed, passed)


@uncounted
def _look_up(source: Floats, base: int, starts: Integers, target: Floats) -> None:
    for k in range(len(target)):
        target[k] = source[starts[k] - base]


@apart
def fill_tables(table_at: int, number: int, which: int, channels: int, last: int) -> int:
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
    is_joined = code in (codes.PART_AND, codes.PART_OR)
    # neighbouring corners of what has a row of its own differ in that alone
    for corner in range(0, corners_of(span), 1 if is_joined else 2):
        two, base = _source_of(
            scratch.corner_columns[b], scratch.spans[b], span[RIGHT], span, corner, of_two, offset, lowest
        )
        left = right = two[begin - base : end - base]
        if has_left:
            one, base = _source_of(
                scratch.corner_columns[a], scratch.spans[a], span[LEFT], span, corner, of_one, offset, lowest
            )
            left = one[begin - base : end - base]
        target = scratch.corner_columns[d - first, corner, begin - lowest : end - lowest]
        if is_joined:
            join(is_strong, left, right, target)
            continue
        is_ahead = code in (codes.UNTIL, codes.RELEASE)
        best = scratch.corner_columns[d - first, corner + 1, begin - lowest : end - lowest]
        _run_corners(is_strong, is_ahead, has_left, left, right, scratch.running, target, best)
    return 0


@apart
def _fill_window(table_at: int, number: int, d: int, which: int, channels: int, last: int) -> int:
    """Compute a window or shift at the corners of its spans, and what it, or the root, holds of each."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, look = tables.nodes, tables.parts[number], look_of(which, channels)
    columns, history = memory.columns[columns_number(which)], memory.history[look.channel]
    recent, offset, first = recent_of(memory, scratch), memory.clock[OFFSET], part[codes.PART_FIRST]
    lowest, starts, afters = scratch.block[BLOCK_LOWEST], scratch.ends[0], scratch.ends[1]
    row, spare = scratch.running, scratch.extrema[0]
    place, node, root = d - first, nodes[d], part[codes.PART_END] - 1
    is_root = d == root and not runs_root(part, nodes[root])
    code, a = node[codes.NODE_CODE], node[codes.NODE_B] if is_root else node[codes.NODE_A]
    is_greatest = code in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX, codes.UNTIL)
    signal, one, below = signal_of(nodes, first + a), scratch.spans[a], scratch.corner_columns[a]
    column = columns[first + a] if signal < 0 else history[signal]
    for k in range(1, scratch.span_counts[a] if code != codes.SHIFT else 1):
        if one[k, KIND] != IN_TABLE:
            continue
        for corner in range(corners_of(one[k])):
            source = below[corner, one[k, BEGIN] - lowest : one[k, END] - lowest]
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
        steps, is_counted = end - 1 - begin, node[codes.NODE_UNIT] == codes.SAMPLES
        find_ends(node, recent, begin, begin + 1, offset, last, starts, afters)
        find_ends(node, recent, end - 1, end, offset, last, starts[steps:], afters[steps:])
        is_at_once = code in codes.AHEAD_OF and node[codes.NODE_LOW] == 0
        starts_evenly = (is_counted or is_at_once) and starts[steps] - starts[0] == steps
        ends_evenly = is_counted and afters[steps] - afters[0] == steps
        # of windows that start and end evenly, only the first and the last are looked at
        if left == right or code == codes.SHIFT or not (starts_evenly and ends_evenly):
            find_ends(node, recent, begin, end, offset, last, starts, afters)
        # of a span with rows of its own, what stands in tables is joined with these
        has_row = span[KIND] == IN_TABLE and span[ROW] >= 0
        for corner in range(0, corners_of(span), 2 if has_row else 1):
            target = scratch.corner_columns[place, corner, begin - lowest : end - lowest]
            source, base = _source_of(below, one, left, span, corner, column, offset, lowest)
            if code == codes.SHIFT:
                _look_up(source, base, starts, target)
                continue
            if has_row:
                # where the row between is as great as can be, say, it outdoes the rest
                beside = scratch.corner_columns[place, corner + 1, begin - lowest : end - lowest]
                target, other = (target, beside) if is_greatest else (beside, target)
                fill(other, np.inf if is_greatest else -np.inf)
            if not has_left:
                fill(target, -np.inf if is_greatest else np.inf)
            elif left == right:
                _slide(is_greatest, source, base, starts, afters, row, spare, target)
            else:
                at = one[left, END]
                _join_left(is_greatest, source, base, starts, starts_evenly, at, row, spare, target)
            if has_right:
                source, base = _source_of(below, one, right, span, corner, column, offset, lowest)
                at = one[right, BEGIN]
                _join_right(is_greatest, source, base, at, afters, ends_evenly, row, spare, target)
    return 0
