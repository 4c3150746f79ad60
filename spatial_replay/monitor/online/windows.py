"""Bounded operators below unbounded ones, and past operators above future ones.

Such a part's value at its oldest open positions changes with every sample, so the samples since then are
stored. Its table (see `tables`) belongs to a *base*: the last position of the root up to which all windows
have closed, or do not matter any more (see `closing`), or that of some samples ago. Later positions are
columns of numbers (see `open_windows`), which are read into the table. A past operator with a future
operator below it carries a table of its own from base to base.

A part's cells hold: the base, as the next position to absorb; for each variable, its position in the table;
for each table of a past operator, the position it belongs to (-1: before the first).
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.closing import (
    CLOSING,
    absorb,
    is_outdone,
    is_settled,
    looks_for_outdone,
)
from spatial_replay.monitor.online.node_columns import (
    columns_number,
    look_of,
    set_point,
    signal_of,
    tables_end,
)
from spatial_replay.monitor.online.open_windows import (
    bring_columns_up,
    has_ended,
    is_cut_short,
    is_known,
    is_plain,
    is_same,
    known_number,
    looks_of,
    reach,
    root_window,
    runs_root,
)
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import (
    beyond,
    copy,
    either,
    enter_samples,
    extremum,
    first_unclosed,
    recent_of,
)
from spatial_replay.monitor.online.state import (
    JOINED,
    NUMBERS,
    OFFSET,
    POSITION,
    Memory,
    Scratch,
    behind,
    first_behind,
)
from spatial_replay.monitor.online.tables import read_table

_MANY = 4
"""From so many stretches of open positions on, each is joined by itself, and only if it has changed."""


@uncounted
def _joined(
    number: int, at: int, is_until: bool, body: Floats, value: float, begin: int, end: int, memory: Memory,
    count: int,
) -> float:  # fmt: skip
    """Join a number with those at begin … end - 1, of `count` recent ones, of which few ever change."""
    if end - begin < _MANY * JOINED:
        return extremum(is_until, body[begin : max(end, begin)], value)
    joined, nothing = memory.joined[at, number], -np.inf if is_until else np.inf
    first = max(memory.unjoined[number, at] - memory.clock[OFFSET], 0) // JOINED
    for k in range(first, (count - 1) // JOINED + 1):
        joined[k] = extremum(is_until, body[k * JOINED : min(k * JOINED + JOINED, count)], nothing)
    memory.unjoined[number, at] = memory.clock[OFFSET] + count
    whole, after = begin // JOINED + 1, end // JOINED
    value = extremum(is_until, body[begin : whole * JOINED], value)
    value = extremum(is_until, joined[whole:after], value)
    return extremum(is_until, body[after * JOINED : end], value)


@inlined
def _cut_at(nodes: Integers, part: Integers, memory: Memory, scratch: Scratch, offset: int, last: int) -> int:
    """Return the first position where a window is open that cuts a part's bound short."""
    first, recent = last + 1, recent_of(memory, scratch)
    for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
        if nodes[d, codes.NODE_CUTS]:
            first = min(first, first_unclosed(nodes[d], recent, offset, last))
    return first


@inlined
def _value_at_first(
    nodes: Integers, part: Integers, number: int, which: int, channels: int, memory: Memory, scratch: Scratch,
    offset: int, last: int,
) -> float:  # fmt: skip
    """Return one of a part's numbers at the first sample, once its columns are brought up."""
    look, at, root = look_of(which, channels), columns_number(which), nodes[part[codes.PART_END] - 1]
    base, variables = memory.cells[part[codes.PART_CELL_START]], part[codes.PART_VARIABLES]
    tables = memory.tables[look.channel, part[codes.PART_TABLE_START] : tables_end(part)]
    if is_known(which, part, memory, last):
        return known_number(which, part, memory, look.channel)
    has_more = not has_ended(part, root, memory, last)
    value = beyond(look.mode if has_more else codes.OPEN_END, root[codes.NODE_WEAK])
    if runs_root(part, root):
        value = memory.columns[at, part[codes.PART_END] - 1, base - offset] if base <= last else value
    else:
        begin, end = root_window(root, memory, last)
        if is_cut_short(which, part, root, channels):
            at = look.channel
            end = min(end, _cut_at(nodes, part, memory, scratch, offset, last))
        d = part[codes.PART_FIRST] + root[codes.NODE_B]
        signal, is_until = signal_of(nodes, d), root[codes.NODE_CODE] == codes.UNTIL
        body = memory.columns[at, d] if signal < 0 else memory.history[look.channel, signal]
        begin, count = max(begin, base) - offset, last + 1 - offset
        value = _joined(number, at, is_until, body, value, begin, end - offset, memory, count)
    if base == 0:
        return float(value)
    if is_plain(part):
        return float(max(tables[0], min(value, tables[1])))
    for d in range(part[codes.PART_FIRST], part[codes.PART_END] - 1):
        set_point(nodes[d], part, memory.columns[at, d], memory.cells, look.mode, offset, last, scratch.point)
    if root[codes.NODE_VARIABLE] >= 0:
        scratch.point[root[codes.NODE_VARIABLE]] = value
    return read_table(tables[: 1 << variables], variables, scratch.point, scratch.order)


@inlined
def _value_at_last(
    nodes: Integers, part: Integers, d: int, which: int, channel: int, memory: Memory, offset: int, last: int
) -> float:
    """Return what a node of a part is at the last sample, once the part's columns are brought up."""
    root = nodes[part[codes.PART_END] - 1]
    if d < part[codes.PART_END] - 1 or runs_root(part, root):
        return float(memory.columns[which, d, last - offset])
    d = part[codes.PART_FIRST] + root[codes.NODE_B]
    signal = signal_of(nodes, d)
    body = (memory.columns[which, d] if signal < 0 else memory.history[channel, signal])[last - offset]
    value = beyond(codes.OPEN_END, root[codes.NODE_WEAK])
    return either(root[codes.NODE_CODE] == codes.UNTIL, float(body), value)


@uncounted
def _enter_last(
    nodes: Integers, parts: Integers, number: int, which: int, channels: int, memory: Memory,
    scratch: Scratch, offset: int, last: int, k: int,
) -> None:  # fmt: skip
    """Enter what a part says of itself, and of others, at the last sample."""
    channel = look_of(which, channels).channel
    for other in range(len(parts)):
        if parts[other, codes.PART_LAST_IN] == number:
            d = parts[number, codes.PART_FIRST] + parts[other, codes.PART_LAST_NODE]
            value = _value_at_last(nodes, parts[number], d, which, channel, memory, offset, last)
            scratch.parts[other, which + 2, k] = value
            if channels == 1:
                scratch.parts[other, 3, k] = value


@uncounted
def _outdone_up_to(
    nodes: Integers, part: Integers, channels: int, memory: Memory, offset: int, last: int
) -> int:
    """Return what comes after the positions where what the root joins is outdone (see `closing`)."""
    root, position = nodes[part[codes.PART_END] - 1], memory.cells[part[codes.PART_CELL_START]]
    d, stop = part[codes.PART_FIRST] + root[codes.NODE_B], last + 1
    signal = signal_of(nodes, d)
    for which in range(channels):
        body, k = memory.columns[which, d] if signal < 0 else memory.history[which, signal], position
        while k < stop and is_outdone(part, root, memory, which, body[k - offset]):
            k += 1
        stop = k
    return int(stop)


@apart
def run_windows(table_at: int, channels: int, count: int) -> int:
    """Run all parts with windows over the next `count` samples, one by one.

    `scratch.parts` receives their numbers; those of an ending run are for the last sample.
    """
    tables, _, _, _ = arrays_at(table_at)
    for number in range(len(tables.parts)):
        part = tables.parts[number]
        if part[codes.PART_KIND] == codes.WINDOWED and part[codes.PART_NUMBERS] & codes.FIRST_NUMBERS:
            run_part(table_at, number, channels, 0, count, count)
    return 0


@apart
def run_part(table_at: int, number: int, channels: int, begin: int, end: int, count: int) -> int:
    """Run a part over the samples number begin … end - 1 of the next `count`, one by one."""
    tables, memory, scratch, _ = arrays_at(table_at)
    position, offset = memory.clock[POSITION], memory.clock[OFFSET]
    part, numbers = tables.parts[number], scratch.parts[number]
    own = part[codes.PART_NUMBERS]
    for k in range(begin, end):
        last = position + k
        if is_settled(part, memory):
            for which in range(NUMBERS):
                # what is now goes on, and is said by another part
                if (own & codes.FIRST_NUMBERS) >> which & 1:
                    channel = look_of(which, channels).channel
                    numbers[which, k] = memory.tables[channel, part[codes.PART_TABLE_START]]
            continue
        if len(memory.window_next):
            enter_samples(
                tables.nodes, part, memory.stamps, memory.window_ends, memory.window_next, offset, last
            )
        root = tables.nodes[part[codes.PART_END] - 1]
        looks = looks_of(part, root, memory, channels, k == count - 1, last)
        bring_columns_up(table_at, number, looks, channels, last)
        for which in range(NUMBERS):
            if which in (2, 3) or (which >= 6 and k < count - 1) or not (own >> which) & 1:
                continue
            if which == 1 and channels == 1:
                numbers[1, k] = numbers[0, k]
            elif which >= 6 and channels < 4:
                numbers[which, k] = numbers[which - 6, k]
            elif is_same(which, part, memory, channels, last):
                numbers[which, k] = numbers[look_of(which, channels).channel, k]
            else:
                numbers[which, k] = _value_at_first(
                    tables.nodes, part, number, which, channels, memory, scratch, offset, last
                )
                if which < 2 and part[codes.PART_IS_REMEMBERING]:
                    _enter_last(
                        tables.nodes, tables.parts, number, which, channels, memory, scratch, offset, last, k
                    )
        if last % CLOSING == CLOSING - 1:
            outdone = 0
            if looks_for_outdone(part, memory, channels, last):
                outdone = _outdone_up_to(tables.nodes, part, channels, memory, offset, last)
            absorb(table_at, number, channels, last, outdone)
    return 0


@uncounted
def _kept_from(table_at: int, last: int) -> int:
    """Return the first position that anything may still look at after the sample at `last`."""
    tables, memory, scratch, _ = arrays_at(table_at)
    signals, parts, offset, keep = tables.signals, tables.parts, memory.clock[OFFSET], last
    for s in range(signals.shape[0]):
        code, unit = signals[s, codes.SIGNAL_CODE], signals[s, codes.SIGNAL_UNIT]
        if code == codes.DELAY:
            keep = min(keep, behind(memory.stamps, offset, last, unit, signals[s, codes.SIGNAL_LOW]))
        elif code in codes.RINGS:
            keep = min(keep, first_behind(memory.stamps, offset, last, unit, signals[s, codes.SIGNAL_HIGH]))
    for p in range(parts.shape[0]):
        part = parts[p]
        is_open = part[codes.PART_KIND] == codes.WINDOWED and not is_settled(part, memory)
        if is_open and part[codes.PART_NUMBERS] & codes.FIRST_NUMBERS:
            base = min(memory.cells[part[codes.PART_CELL_START]], last)
            reach(table_at, p, base, last, last)
            for d in range(part[codes.PART_END] - part[codes.PART_FIRST]):
                keep = min(keep, scratch.low[d])
    return int(max(keep, offset))


@apart
def forget(table_at: int, channels: int) -> int:
    """Drop the oldest samples, which nothing looks at again, if these are half of those there is room for.

    Returns:
        1 if any were dropped, else 0.
    """
    tables, memory, _, _ = arrays_at(table_at)
    signals, position, offset = tables.signals, memory.clock[POSITION], memory.clock[OFFSET]
    if position == 0:
        return 0
    keep = _kept_from(table_at, position - 1)
    moved, kept = keep - offset, position - keep
    if 2 * moved < len(memory.stamps):
        return 0
    stamps = memory.stamps[moved : moved + kept]
    for k in range(kept):
        memory.stamps[k] = stamps[k]
    for channel in range(channels):
        for s in range(len(signals)):
            if signals[s, codes.SIGNAL_IS_KEPT]:
                copy(memory.history[channel, s, moved : moved + kept], memory.history[channel, s, :kept])
    # positions have moved
    memory.known[:] = -1
    memory.window_next[:] = -1
    memory.clock[OFFSET] = keep
    return 1
