"""Bounded operators below unbounded ones, and past operators above future ones.

Such a part's value at its oldest open positions changes with every sample, so the samples since then are
stored. Its table (see `tables`) belongs to a *base*: the last position of the root all of whose windows have
closed, or that of some samples ago. Later positions are columns of numbers (see `open_windows`), which are
read into the table. A past operator with a future operator below it carries a table of its own from base to
base.

A part's cells hold: the base, as the next position to absorb; for each variable, its position in the table;
for each table of a past operator, the position it belongs to (-1: before the first).
"""

from __future__ import annotations

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.closing import (
    CLOSING,
    absorb,
    is_plain,
    is_settled,
    root_value,
    run_dependent,
    tables_end,
)
from spatial_replay.monitor.online.open_windows import bring_columns_up, columns_number, look_of, reach
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import beyond, copy, enter_samples
from spatial_replay.monitor.online.state import (
    NUMBERS,
    OFFSET,
    POSITION,
    Memory,
    Scratch,
    behind,
    first_behind,
)
from spatial_replay.monitor.online.tables import read_table


@inlined
def _value_at_first(
    table_at: int, number: int, which: int, channels: int, part: Integers, root: Integers, memory: Memory,
    scratch: Scratch, offset: int, last: int,
) -> float:  # fmt: skip
    """Return one of a part's numbers at the first sample."""
    look = look_of(which, channels)
    base, variables = memory.cells[part[codes.PART_CELL_START]], part[codes.PART_VARIABLES]
    tables = memory.tables[look.channel, part[codes.PART_TABLE_START] : tables_end(part)]
    at = columns_number(which)
    columns = memory.columns[at, part[codes.PART_FIRST] : part[codes.PART_END]]
    is_simple, value = is_plain(part), beyond(look.mode, root[codes.NODE_WEAK])
    # where anything may still come to outdo the rest, the rest makes no difference
    is_known = is_simple and root[codes.NODE_A] < 0 and look.mode != codes.OPEN_END
    if not (is_known and (look.mode == codes.OPEN_HIGH) == (root[codes.NODE_CODE] == codes.UNTIL)):
        bring_columns_up(table_at, number, which, channels, last)
        if is_simple:
            value = root_value(root, columns, value, base, last, offset)
    if is_simple:
        return value if base == 0 else max(tables[0], min(value, tables[1]))
    if part[codes.PART_IS_NESTED]:
        for d in range(len(columns)):
            scratch.low[d], scratch.high[d] = memory.lows[part[codes.PART_FIRST] + d], last
        run_dependent(table_at, number, at, look.channel, look.mode, 0, last)
    if base == 0:
        return float(columns[len(columns) - 1, 0 - offset])
    return read_table(tables[: 1 << variables], variables, scratch.point, scratch.order)


@inlined
def _value_at_last(
    part: Integers, root: Integers, which: int, memory: Memory, offset: int, last: int
) -> float:
    """Return what a part is at the last sample, once `_value_at_first` has run."""
    columns = memory.columns[which, part[codes.PART_FIRST] : part[codes.PART_END]]
    if is_plain(part):
        return root_value(root, columns, beyond(codes.OPEN_END, root[codes.NODE_WEAK]), last, last, offset)
    return float(columns[len(columns) - 1, last - offset])


@apart
def run_windows(table_at: int, channels: int, count: int) -> int:
    """Run all parts with windows over the next `count` samples.

    `scratch.parts` receives their numbers; those of an ending run are for the last sample.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    position, offset = memory.clock[POSITION], memory.clock[OFFSET]
    for number in range(len(tables.parts)):
        part, numbers = tables.parts[number], scratch.parts[number]
        if part[codes.PART_KIND] != codes.WINDOWED:
            continue
        root = tables.nodes[part[codes.PART_END] - 1]
        for k in range(count):
            last = position + k
            if is_settled(part, memory):
                for which in range(NUMBERS):
                    channel = look_of(which, channels).channel
                    numbers[which, k] = memory.tables[channel, part[codes.PART_TABLE_START]]
                continue
            if len(memory.window_next):
                enter_samples(
                    tables.nodes, part, memory.stamps, memory.window_ends, memory.window_next, offset, last
                )
            for which in range(NUMBERS):
                # numbers 2 and 3 (now) come with 0 and 1; those of an ending run count for the last only
                if which in (2, 3) or (which >= 6 and k < count - 1):
                    continue
                if which == 1 and channels == 1:
                    numbers[1, k], numbers[3, k] = numbers[0, k], numbers[2, k]
                    continue
                if which >= 6 and channels < 4:
                    numbers[which, k] = numbers[which - 6, k]
                    continue
                numbers[which, k] = _value_at_first(
                    table_at, number, which, channels, part, root, memory, scratch, offset, last
                )
                if which < 2 and part[codes.PART_IS_REMEMBERING]:
                    numbers[which + 2, k] = _value_at_last(part, root, which, memory, offset, last)
            if last % CLOSING == CLOSING - 1:
                absorb(table_at, number, channels, last)
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
        if part[codes.PART_KIND] == codes.WINDOWED and not is_settled(part, memory):
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
    keep = _kept_from(table_at, position - 1)
    moved, kept = keep - offset, position - keep
    if 2 * moved < len(memory.stamps):
        return 0
    for k in range(kept):
        memory.stamps[k] = memory.stamps[k + moved]
    for channel in range(channels):
        for s in range(len(signals)):
            if signals[s, codes.SIGNAL_IS_KEPT]:
                copy(memory.history[channel, s, moved : moved + kept], memory.history[channel, s, :kept])
    # positions have moved
    memory.known[:] = -1
    memory.window_next[:] = -1
    memory.clock[OFFSET] = keep
    return 1
