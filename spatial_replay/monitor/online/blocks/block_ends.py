"""Which positions a block of samples changes, and where the windows there end (see `blocks.node_rows`)."""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import apart, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.blocks.node_rows import SampleBlock
from spatial_replay.monitor.online.node_columns import columns_number, look_of, signal_of
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import Recent, either, extremum, is_decided, window_after
from spatial_replay.monitor.online.state import OFFSET, ahead, behind, first_behind

WIDE = 192
"""So many open positions are many."""


@uncounted
def _first_touched(
    is_greatest: bool, source: Floats, column: Floats, begin: int, since: int, last: int, offset: int
) -> int:
    """Return the first of the open windows over a signal, from `begin` on, that the block's samples change.

    All of these end with the last sample, so that the later one begins, the less it holds.
    """
    now = extremum(
        is_greatest, source[since - offset : last + 1 - offset], -np.inf if is_greatest else np.inf
    )
    end = since
    while begin < end:
        middle = (begin + end) >> 1
        if either(is_greatest, column[middle - offset], now) == column[middle - offset]:
            begin = middle + 1
        else:
            end = middle
    return begin


@apart
def find_begins(
    table_at: int, number: int, which: int, channels: int, narrows: int, is_next: int, since: int, last: int
) -> int:
    """Enter the first position of each node that samples from `since` to `last` may change; return the least.

    Args:
        narrows: 1 to look at what these samples are, and not only at which windows are open.
        is_next: 1 to enter them into `next_begins`; 2 to do so where only windows matter: what joins these
            with an operator that never ends is closed when they are.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, look = tables.nodes, tables.parts[number], look_of(which, channels)
    columns, history = memory.columns[columns_number(which)], memory.history[look.channel]
    stamps, lows, offset = memory.stamps, memory.lows, memory.clock[OFFSET]
    begins, changed = scratch.next_begins if is_next else scratch.begins, scratch.changed
    first, lowest = part[codes.PART_FIRST], since
    for d in range(first, part[codes.PART_END]):
        node = nodes[d]
        code, unit, near, far = node[0], node[codes.NODE_UNIT], node[codes.NODE_LOW], node[codes.NODE_HIGH]
        if code == codes.LITERAL:
            begins[d - first] = changed[d - first] = last + 1
            continue
        begin = changed[node[codes.NODE_A]] if node[codes.NODE_A] >= 0 else last + 1
        if code in (codes.PART_AND, codes.PART_OR, codes.PAST_SINCE, codes.PAST_TRIGGER):
            begin = min(begin, changed[node[codes.NODE_B]])
        elif code in (codes.UNTIL, codes.RELEASE):
            begin = min(begin, changed[node[codes.NODE_B]]) if is_next == 2 else offset
        elif code in codes.AHEAD_OF:
            distance = near if code == codes.SHIFT else far
            if begin < since:
                begin = first_behind(stamps, offset, begin, unit, distance)
            if distance > 0 and since > offset:
                begin = min(begin, first_behind(stamps, offset, since - 1, unit, distance - 1))
            signal, is_greatest = signal_of(nodes, first + node[codes.NODE_A]), code == codes.PART_WINDOW_MAX
            if narrows and code != codes.SHIFT and signal >= 0 and not is_decided(node, look.mode):
                begin, source = max(begin, lows[d]), history[signal]
                begin = _first_touched(is_greatest, source, columns[d], begin, since, last, offset)
        elif begin < since:
            begin = ahead(stamps, offset, since - 1, begin, unit, near)
        # which positions matter may change before the next block, and so must not say which ones are open
        changed[d - first] = min(begin, since)
        begins[d - first] = max(changed[d - first], lows[d])
        # what a past operator starts from may be a row, too
        has_start = code in (codes.PAST_SINCE, codes.PAST_TRIGGER)
        lowest = min(lowest, lows[d] if has_start else begins[d - first])
    return int(lowest)


@uncounted
def is_beside_one(nodes: Integers, part: Integers, stamps: Integers, offset: int, since: int) -> bool:
    """Return whether a part has few open positions but those of one window over a signal, or one operator."""
    first, count, most = part[codes.PART_FIRST], 0, 0
    for d in range(first, part[codes.PART_END] - 1):
        code, unit, far = nodes[d, codes.NODE_CODE], nodes[d, codes.NODE_UNIT], nodes[d, codes.NODE_HIGH]
        if code in (codes.LITERAL, codes.PART_AND, codes.PART_OR, codes.SHIFT):
            continue
        is_ahead = code in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN)
        own = since - first_behind(stamps, offset, since - 1, unit, far) if is_ahead else WIDE
        count += own
        if not is_ahead or signal_of(nodes, first + nodes[d, codes.NODE_A]) >= 0:
            most = max(most, own)
    return bool(count - most <= WIDE // 2)


@uncounted
def _copy_known(
    ends: Integers, unknown: int, begin: int, end: int, offset: int, most: int, target: Integers
) -> None:
    """Copy ends of windows at begin … end - 1, known up to `unknown`; those that are later are `most`."""
    known = max(min(unknown, end), begin) - begin
    ends = ends[begin - offset : begin - offset + known]
    for k in range(known):
        target[k] = min(ends[k], most)
    for k in range(known, end - begin):
        target[k] = most


@uncounted
def find_ends(
    node: Integers, recent: Recent, begin: int, end: int, offset: int, last: int, starts: Integers,
    afters: Integers,
) -> None:  # fmt: skip
    """Enter where windows of begin … end - 1 start, and what comes after them; where shifts and delays look.

    Args:
        last: the last sample that counts.
    """
    stamps, code, unit = recent.stamps, node[codes.NODE_CODE], node[codes.NODE_UNIT]
    near, far = node[codes.NODE_LOW], node[codes.NODE_HIGH]
    if code in codes.AHEAD_OF and unit == codes.SAMPLES:
        for k in range(end - begin):
            starts[k] = min(begin + k + near, last + 1)
        for k in range(end - begin):
            afters[k] = min(begin + k + far, last) + 1
        return
    if code in codes.AHEAD_OF:
        timed, next_ends = node[codes.NODE_TIMED], recent.window_next[node[codes.NODE_TIMED]]
        _copy_known(recent.window_ends[timed, 0], next_ends[1], begin, end, offset, last + 1, starts)
        _copy_known(recent.window_ends[timed, 1], next_ends[2], begin, end, offset, last + 1, afters)
        return
    start, after = begin, behind(stamps, offset, begin, unit, near) + 1
    if code != codes.PAST_DELAY:
        start = first_behind(stamps, offset, begin, unit, far)
    for position in range(begin, end):
        if unit == codes.SAMPLES:
            start, after = max(position - far, offset), position - near + 1
        else:
            time_ns = stamps[position - offset]
            while code != codes.PAST_DELAY and time_ns - stamps[start - offset] > far:
                start += 1
            while after <= position and time_ns - stamps[after - offset] >= near:
                after += 1
        starts[position - begin] = after - 1 if code == codes.PAST_DELAY else start
        afters[position - begin] = after


@uncounted
def find_closing(
    node: Integers, block: SampleBlock, recent: Recent, begin: int, end: int, newest: int, is_first: bool,
    closing: Integers,
) -> None:  # fmt: skip
    """Enter with which sample windows ahead of begin … end - 1 close, counted from the block's first.

    Args:
        newest: the last sample for which ends of windows are known.
        is_first: whether to replace what is there, or to raise it.
    """
    far, stamps, offset = node[codes.NODE_HIGH], recent.stamps, block.offset
    for position in range(begin, end):
        at = position + far
        if node[codes.NODE_UNIT] != codes.SAMPLES:
            at = window_after(node, recent, position, offset, newest)
            at -= stamps[at - 1 - offset] - stamps[position - offset] == far
        sample, k = at - block.since, position - begin
        closing[k] = sample if is_first else max(closing[k], sample)
