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

import numpy as np

from spatial_replay.compiled import inlined, kernel, piece, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.open_windows import (
    Look,
    Stretch,
    beyond,
    bring_up,
    enter_samples,
    extremum,
    join,
    look_of,
    recent_of,
    run_shift,
    run_window,
)
from spatial_replay.monitor.online.state import (
    NUMBERS,
    OFFSET,
    POSITION,
    Memory,
    Scratch,
    ahead,
    behind,
    first_behind,
    is_closed,
    last_ahead,
)
from spatial_replay.monitor.online.tables import corner_value, read_table

CLOSING = 16
"""So many samples together are looked at for positions that have closed."""


@inlined
def _cells_of(part: Integers) -> tuple[int, int, int]:
    """Return where a part's cells hold its base, its variables' positions and its tables' positions."""
    base = part[codes.PART_CELL_START]
    return base, base + 1, base + 1 + part[codes.PART_VARIABLES]


@uncounted
def reach(
    nodes: Integers, part: Integers, memory: Memory, scratch: Scratch, root_low: int, root_high: int,
    offset: int, last: int,
) -> bool:  # fmt: skip
    """Compute which positions of each node matter for the root at root_low … root_high.

    Returns whether every window that they look through has closed. `plain` holds the lower ends before
    they are widened to what the tables start from.
    """
    first, end = part[codes.PART_FIRST], part[codes.PART_END]
    base, boundaries, states = _cells_of(part)
    cells, low, high = memory.cells, scratch.low, scratch.high
    for d in range(end - first):
        low[d] = np.iinfo(np.int64).max
        high[d] = -1
    low[end - 1 - first], high[end - 1 - first] = root_low, root_high
    closed = True
    for d in range(end - 1, first - 1, -1):
        node = nodes[d]
        a, b = node[codes.NODE_A], node[codes.NODE_B]
        scratch.plain[d - first] = low[d - first]
        if node[codes.NODE_VARIABLE] >= 0 and cells[base] > 0:
            low[d - first] = min(low[d - first], cells[boundaries + node[codes.NODE_VARIABLE]])
        if node[codes.NODE_TABLE] >= 0:
            low[d - first] = min(low[d - first], cells[states + node[codes.NODE_TABLE]] + 1)
        if node[codes.NODE_CODE] == codes.LITERAL:
            continue
        child_low, child_high, child_closed = _operands_reach(
            node, low[d - first], high[d - first], memory.stamps, offset, last
        )
        closed = closed and child_closed
        if a >= 0:
            low[a] = min(low[a], child_low)
            high[a] = max(high[a], child_high, high[d - first])
        if node[codes.NODE_CODE] in (
            codes.PART_AND,
            codes.PART_OR,
            codes.UNTIL,
            codes.RELEASE,
            codes.PAST_SINCE,
            codes.PAST_TRIGGER,
        ):
            low[b] = min(low[b], child_low)
            high[b] = max(high[b], child_high)
    return closed


@inlined
def _operands_reach(
    node: Integers, low: int, high: int, stamps: Integers, offset: int, last: int
) -> tuple[int, int, bool]:
    """Return the operands' positions a node looks at from low … high, and whether all of them are known."""
    code, unit, near, far = (
        node[codes.NODE_CODE],
        node[codes.NODE_UNIT],
        node[codes.NODE_LOW],
        node[codes.NODE_HIGH],
    )
    if code in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN):
        closed = is_closed(stamps, offset, last, high, unit, far)
        return low, last_ahead(stamps, offset, last, high, unit, far), closed
    if code == codes.SHIFT:
        shifted = ahead(stamps, offset, last, high, unit, near)
        wanted = last_ahead(stamps, offset, last, high, unit, far) if far >= 0 else shifted
        return low, min(max(shifted, wanted), last), shifted <= last
    if code in (codes.PAST_WINDOW_MAX, codes.PAST_WINDOW_MIN):
        return first_behind(stamps, offset, min(low, last), unit, far), high, True
    if code == codes.PAST_DELAY:
        return max(behind(stamps, offset, min(low, last), unit, near), offset), high, True
    return low, high, True


@inlined
def _run_recurrence(
    node: Integers, columns: Floats, target: Floats, start: float, begin: int, end: int, step: int
) -> None:
    """Run an operator without a window: until and release backwards, since and trigger forwards."""
    a, b = node[codes.NODE_A], node[codes.NODE_B]
    is_strong = node[codes.NODE_CODE] in (codes.UNTIL, codes.PAST_SINCE)
    value = start
    for k in range(begin, end, step):
        if is_strong:
            value = max(columns[b, k], min(columns[a, k], value) if a >= 0 else value)
        else:
            value = min(columns[b, k], max(columns[a, k], value) if a >= 0 else value)
        target[k] = value


@inlined
def _run_until(
    node: Integers, part: Integers, columns: Floats, target: Floats, low: int, high: int, look: Look,
    memory: Memory, scratch: Scratch, offset: int,
) -> None:  # fmt: skip
    """Run an unbounded until or release at low … high; its variable's value goes to the point."""
    variable = node[codes.NODE_VARIABLE]
    if look.mode == codes.OPEN_CORNER:
        after = corner_value(look.corner, variable) if variable >= 0 else -np.inf
    else:
        after = beyond(look.mode, node[codes.NODE_WEAK])
    _run_recurrence(node, columns, target, after, high - offset, low - offset - 1, -1)
    if variable >= 0:
        boundary = memory.cells[_cells_of(part)[1] + variable]
        scratch.point[variable] = target[boundary - offset] if boundary <= high else after


@inlined
def _run_since(
    node: Integers, part: Integers, tables: Floats, columns: Floats, target: Floats, high: int,
    memory: Memory, scratch: Scratch, offset: int,
) -> None:  # fmt: skip
    """Run an unbounded since or trigger from the position of its table up to `high`."""
    table, variables = node[codes.NODE_TABLE], part[codes.PART_VARIABLES]
    start = memory.cells[_cells_of(part)[2] + table]
    if start < 0:
        value = np.inf if node[codes.NODE_WEAK] else -np.inf
    else:
        at = table << variables
        value = read_table(tables[at : at + (1 << variables)], variables, scratch.point, scratch.order)
    scratch.starts[table] = value
    _run_recurrence(node, columns, target, value, start + 1 - offset, high - offset + 1, 1)


@uncounted
def _run_dependent(
    nodes: Integers, part: Integers, tables: Floats, columns: Floats, look: Look, low: Integers,
    high: Integers, memory: Memory, scratch: Scratch, offset: int, last: int,
) -> None:  # fmt: skip
    """Run the nodes of a part that depend on a variable or a table, over the positions that matter.

    `scratch.point` receives the variables' values where the table's base ends, `scratch.starts` the
    values that past operators start from.
    """
    first = part[codes.PART_FIRST]
    for d in range(first, part[codes.PART_END]):
        node = nodes[d]
        if not node[codes.NODE_DEPENDS]:
            continue
        code, a, b, target = node[0], node[codes.NODE_A], node[codes.NODE_B], columns[d - first]
        own_low, own_high = low[d - first], high[d - first]
        begin, end = own_low - offset, own_high - offset + 1
        if code in (codes.PART_AND, codes.PART_OR):
            one, two = columns[a, begin:end], columns[b, begin:end]
            join(code == codes.PART_OR, one, two, target[begin:end])
        elif code in (codes.UNTIL, codes.RELEASE):
            _run_until(node, part, columns, target, own_low, own_high, look, memory, scratch, offset)
        elif code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
            _run_since(node, part, tables, columns, target, own_high, memory, scratch, offset)
        elif code in (codes.SHIFT, codes.PAST_DELAY):
            run_shift(
                node, columns[a], target, own_low, own_high + 1, look.mode, memory.stamps,
                memory.window_ends, memory.window_next, offset, last,
            )  # fmt: skip
        else:
            run_window(
                node, columns[a], target, own_low, own_high + 1, look.mode, recent_of(memory, scratch),
                offset, last,
            )  # fmt: skip


@inlined
def _bring_columns_up(
    nodes: Integers, part: Integers, number: int, which: int, look: Look, memory: Memory, scratch: Scratch,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Bring a part's columns for one of its numbers up to the last sample."""
    at = which if which < 2 else which - 2
    known = memory.known[number, at]
    if known < 0:
        _find_lows(nodes, part, memory, scratch, offset, last)
    if known < last:
        columns = memory.columns[at, part[codes.PART_FIRST] : part[codes.PART_END]]
        stretch = Stretch(offset, last, max(known + 1, offset))
        bring_up(nodes, part, columns, look, recent_of(memory, scratch), stretch)
        memory.known[number, at] = last


@uncounted
def _bring_looks_up(
    nodes: Integers, part: Integers, number: int, channels: int, memory: Memory, scratch: Scratch,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Bring the columns for one number of each channel up to the last sample."""
    for channel in range(channels):
        which = channel if channel < 2 else channel + 2
        look = look_of(which, channels)
        _bring_columns_up(nodes, part, number, which, look, memory, scratch, offset, last)


@uncounted
def _find_lows(
    nodes: Integers, part: Integers, memory: Memory, scratch: Scratch, offset: int, last: int
) -> None:
    """Enter the first position of each node that still matters."""
    base = min(memory.cells[part[codes.PART_CELL_START]], last)
    reach(nodes, part, memory, scratch, base, last, offset, last)
    for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
        memory.lows[d] = scratch.low[d - part[codes.PART_FIRST]]


@uncounted
def _root_value(root: Integers, columns: Floats, after: float, first: int, last: int, offset: int) -> float:
    """Return an unbounded until or release at `first`, given what it is after `last`."""
    a, b, is_until = root[codes.NODE_A], root[codes.NODE_B], root[codes.NODE_CODE] == codes.UNTIL
    if a < 0:
        return extremum(is_until, columns[b, first - offset : last + 1 - offset], after)
    value = after
    for k in range(last - offset, first - offset - 1, -1):
        if is_until:
            value = max(columns[b, k], min(columns[a, k], value))
        else:
            value = min(columns[b, k], max(columns[a, k], value))
    return value


@inlined
def _is_plain(nodes: Integers, part: Integers) -> bool:
    """Return whether the root is all that depends on a variable."""
    return part[codes.PART_VARIABLES] == 1 and not part[codes.PART_IS_NESTED]


@inlined
def _value_at_first(
    nodes: Integers, part: Integers, number: int, which: int, channels: int, memory: Memory,
    scratch: Scratch, offset: int, last: int,
) -> float:  # fmt: skip
    """Return one of a part's numbers at the first sample."""
    look = look_of(which, channels)
    base, variables = memory.cells[part[codes.PART_CELL_START]], part[codes.PART_VARIABLES]
    tables = memory.tables[look.channel, part[codes.PART_TABLE_START] : _tables_end(part)]
    at = which if which < 2 else which - 2
    columns = memory.columns[at, part[codes.PART_FIRST] : part[codes.PART_END]]
    root = nodes[part[codes.PART_END] - 1]
    is_plain, value = _is_plain(nodes, part), beyond(look.mode, root[codes.NODE_WEAK])
    # where anything may still come to outdo the rest, the rest makes no difference
    is_known = is_plain and root[codes.NODE_A] < 0 and look.mode != codes.OPEN_END
    if not (is_known and (look.mode == codes.OPEN_HIGH) == (root[codes.NODE_CODE] == codes.UNTIL)):
        _bring_columns_up(nodes, part, number, which, look, memory, scratch, offset, last)
        if is_plain:
            value = _root_value(root, columns, value, base, last, offset)
    if is_plain:
        return value if base == 0 else max(tables[0], min(value, tables[1]))
    if part[codes.PART_IS_NESTED]:
        low = memory.lows[part[codes.PART_FIRST] : part[codes.PART_END]]
        scratch.high[: len(low)] = last
        _run_dependent(nodes, part, tables, columns, look, low, scratch.high, memory, scratch, offset, last)
    if base == 0:
        return float(columns[len(columns) - 1, 0 - offset])
    return read_table(tables[: 1 << variables], variables, scratch.point, scratch.order)


@uncounted
def _absorb(
    nodes: Integers, part: Integers, number: int, memory: Memory, scratch: Scratch, channels: int,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Move the base forward over every position whose windows have all closed."""
    base = _cells_of(part)[0]
    before = memory.cells[base]
    # of closed positions a column holds the same whatever is open, so that any look of a channel will do
    _bring_looks_up(nodes, part, number, channels, memory, scratch, offset, last)
    if part[codes.PART_IS_NESTED]:
        _absorb_nested(nodes, part, memory, scratch, channels, offset, last)
    else:
        _absorb_plain(nodes, part, memory, scratch, channels, offset, last)
    if memory.cells[base] > before:
        _find_lows(nodes, part, memory, scratch, offset, last)


@uncounted
def _absorb_plain(
    nodes: Integers, part: Integers, memory: Memory, scratch: Scratch, channels: int, offset: int, last: int
) -> None:
    """Absorb what has closed, many positions at a time, where no more than the root has a variable."""
    base, boundary, _ = _cells_of(part)
    cells, root, size = memory.cells, nodes[part[codes.PART_END] - 1], CLOSING
    nodes_of_part = part[codes.PART_END] - part[codes.PART_FIRST]
    while size > 0:
        first, newest = cells[base], cells[base] + size - 1
        if newest > last or not reach(nodes, part, memory, scratch, newest, newest, offset, last):
            size //= 2
            continue
        for channel in range(channels):
            columns = memory.columns[channel, part[codes.PART_FIRST] : part[codes.PART_END]]
            tables = memory.tables[channel, part[codes.PART_TABLE_START] : _tables_end(part)]
            if part[codes.PART_VARIABLES] == 0:
                if first == 0:
                    tables[0] = columns[nodes_of_part - 1, 0 - offset]
                continue
            worst = _root_value(root, columns, -np.inf, first, newest, offset)
            best = _root_value(root, columns, np.inf, first, newest, offset)
            if first > 0:
                low, high = tables[0], tables[1]
                worst, best = max(low, min(worst, high)), max(low, min(best, high))
            tables[0], tables[1] = worst, best
        cells[base] = newest + 1
        if part[codes.PART_VARIABLES] > 0:
            cells[boundary] = newest + 1


@uncounted
def _absorb_nested(
    nodes: Integers, part: Integers, memory: Memory, scratch: Scratch, channels: int, offset: int, last: int
) -> None:
    """Absorb what has closed, position by position."""
    base, boundaries, states = _cells_of(part)
    cells = memory.cells
    while cells[base] <= last:
        if not reach(nodes, part, memory, scratch, cells[base], cells[base], offset, last):
            return
        for channel in range(channels):
            mirror = channel ^ 1 if channels > 1 else channel
            _renew_tables(nodes, part, channel, mirror, memory, scratch, offset, last)
        for d in range(part[codes.PART_FIRST], part[codes.PART_END]):
            variable, table, at = (
                nodes[d, codes.NODE_VARIABLE],
                nodes[d, codes.NODE_TABLE],
                d - part[codes.PART_FIRST],
            )
            if variable >= 0:
                cells[boundaries + variable] = scratch.high[at] + 1
            if table >= 0:
                cells[states + table] = max(cells[states + table], scratch.plain[at] - 1)
        cells[base] += 1


@uncounted
def _renew_tables(
    nodes: Integers, part: Integers, channel: int, mirror: int, memory: Memory, scratch: Scratch,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Renew the tables of a part, in one channel, after adding the position at its base."""
    first, end, variables = part[codes.PART_FIRST], part[codes.PART_END], part[codes.PART_VARIABLES]
    fresh, size = scratch.fresh, 1 << variables
    base, _, states = _cells_of(part)
    tables = memory.tables[channel, part[codes.PART_TABLE_START] : _tables_end(part)]
    columns = memory.columns[channel, first:end]
    for corner in range(size):
        look = Look(channel, mirror, codes.OPEN_CORNER, corner)
        _run_dependent(
            nodes, part, tables, columns, look, scratch.low, scratch.high, memory, scratch, offset, last
        )
        if memory.cells[base] == 0:
            fresh[corner] = columns[end - 1 - first, 0 - offset]
        else:
            fresh[corner] = read_table(tables[:size], variables, scratch.point, scratch.order)
        for d in range(first, end):
            table = nodes[d, codes.NODE_TABLE]
            if table >= 0:
                state = scratch.plain[d - first] - 1
                is_new = state > memory.cells[states + table]
                value = columns[d - first, state - offset] if is_new else scratch.starts[table]
                fresh[table * size + corner] = value
    for k in range(len(tables)):
        tables[k] = fresh[k]


@inlined
def _tables_end(part: Integers) -> int:
    """Return where a part's own table and those of its past operators end; they begin with its own."""
    return int(part[codes.PART_TABLE_START] + (part[codes.PART_TABLES] << part[codes.PART_VARIABLES]))


@inlined
def _is_settled(part: Integers, memory: Memory) -> bool:
    """Return whether no later sample matters: every window from the first sample on has closed."""
    without_state = part[codes.PART_VARIABLES] == 0 and not part[codes.PART_IS_REMEMBERING]
    return bool(without_state and memory.cells[part[codes.PART_CELL_START]] > 0)


@uncounted
def step_windows(
    nodes: Integers, part: Integers, number: int, memory: Memory, scratch: Scratch, channels: int,
    position: int, offset: int, count: int, numbers: Floats,
) -> None:  # fmt: skip
    """Run a part with windows over `count` samples, the first of them at `position`.

    Args:
        number: of the part.
        numbers: (NUMBERS, TILE), filled with the part's numbers; those of an ending run for the last sample.
    """
    root = nodes[part[codes.PART_END] - 1]
    for k in range(count):
        last = position + k
        if _is_settled(part, memory):
            for which in range(NUMBERS):
                channel = look_of(which, channels).channel
                numbers[which, k] = memory.tables[channel, part[codes.PART_TABLE_START]]
            continue
        if len(memory.window_next):
            enter_samples(nodes, part, memory.stamps, memory.window_ends, memory.window_next, offset, last)
        for which in range(NUMBERS):
            # numbers 2 and 3 (now) come with 0 and 1; those of an ending run count for the last sample only
            if which in (2, 3) or (which >= 6 and k < count - 1):
                continue
            if which == 1 and channels == 1:
                numbers[1, k], numbers[3, k] = numbers[0, k], numbers[2, k]
                continue
            if which >= 6 and channels < 4:
                numbers[which, k] = numbers[which - 6, k]
                continue
            numbers[which, k] = _value_at_first(
                nodes, part, number, which, channels, memory, scratch, offset, last
            )
            if which < 2 and part[codes.PART_IS_REMEMBERING]:
                columns = memory.columns[which, part[codes.PART_FIRST] : part[codes.PART_END]]
                if _is_plain(nodes, part):
                    after = beyond(codes.OPEN_END, root[codes.NODE_WEAK])
                    numbers[which + 2, k] = _root_value(root, columns, after, last, last, offset)
                else:
                    numbers[which + 2, k] = columns[len(columns) - 1, last - offset]
        if last % CLOSING == CLOSING - 1:
            _absorb(nodes, part, number, memory, scratch, channels, offset, last)


@piece
def _kept_from(
    signals: Integers, nodes: Integers, parts: Integers, memory: Memory, scratch: Scratch, offset: int,
    last: int,
) -> int:  # fmt: skip
    """Return the first position that anything may still look at after the sample at `last`."""
    keep = last
    for s in range(signals.shape[0]):
        code, unit = signals[s, codes.SIGNAL_CODE], signals[s, codes.SIGNAL_UNIT]
        if code == codes.DELAY:
            keep = min(keep, behind(memory.stamps, offset, last, unit, signals[s, codes.SIGNAL_LOW]))
        elif code in codes.RINGS:
            keep = min(keep, first_behind(memory.stamps, offset, last, unit, signals[s, codes.SIGNAL_HIGH]))
    for p in range(parts.shape[0]):
        part = parts[p]
        if part[codes.PART_KIND] == codes.WINDOWED and not _is_settled(part, memory):
            base = min(memory.cells[part[codes.PART_CELL_START]], last)
            reach(nodes, part, memory, scratch, base, last, offset, last)
            for d in range(part[codes.PART_END] - part[codes.PART_FIRST]):
                keep = min(keep, scratch.low[d])
    return max(keep, offset)


@kernel
def forget(
    signals: Integers, nodes: Integers, parts: Integers, memory: Memory, scratch: Scratch, channels: int
) -> bool:
    """Drop the oldest samples, which nothing looks at again, if these are half of those there is room for.

    Returns:
        Whether any were dropped.
    """
    position, offset = memory.clock[POSITION], memory.clock[OFFSET]
    keep = _kept_from(signals, nodes, parts, memory, scratch, offset, position - 1)
    moved, kept = keep - offset, position - keep
    if 2 * moved < len(memory.stamps):
        return False
    for k in range(kept):
        memory.stamps[k] = memory.stamps[k + moved]
    for channel in range(channels):
        for s in range(len(signals)):
            for k in range(kept):
                memory.history[channel, s, k] = memory.history[channel, s, k + moved]
    # positions have moved
    memory.known[:] = -1
    memory.window_next[:] = -1
    memory.clock[OFFSET] = keep
    return True
