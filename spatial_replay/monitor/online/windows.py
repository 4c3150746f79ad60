"""Bounded operators below unbounded ones, and past operators above future ones.

Such a part's value at its oldest open positions changes with every sample, so the samples since then are
stored. Its table (see `tables`) belongs to a *base*: the last position of the root all of whose windows have
closed. Later positions are run backwards from the newest sample each time, at a cost that depends on how many
samples the windows span, and read into the table. A past operator with a future operator below it carries a
table of its own from base to base.

A part's cells hold: the base, as the next position to absorb; for each variable, its position in the table;
for each table of a past operator, the position it belongs to (-1: before the first).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, kernel, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.state import (
    NUMBERS,
    Memory,
    Scratch,
    ahead,
    behind,
    first_after,
    first_behind,
    first_onward,
    is_closed,
    last_ahead,
)
from spatial_replay.monitor.online.tables import corner_value, read_table


class Look(NamedTuple):
    """How a run over the recent samples sees them.

    Attributes:
        channel, mirror: the channel whose values it takes, and the one that negation takes them from.
        mode: what lies beyond the last sample.
        corner: where mode is `OPEN_CORNER`, the values that the variables have there.
    """

    channel: int
    mirror: int
    mode: int
    corner: int


@inlined
def _cells_of(part: Integers) -> tuple[int, int, int]:
    """Return where a part's cells hold its base, its variables' positions and its tables' positions."""
    base = part[codes.PART_CELL_START]
    return base, base + 1, base + 1 + part[codes.PART_VARIABLES]


@piece
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
def _beyond(mode: int, weak: int) -> float:
    """Return the value an operator that is still open takes from beyond the last sample."""
    if mode == codes.OPEN_END:
        return np.inf if weak else -np.inf
    return np.inf if mode == codes.OPEN_HIGH else -np.inf


@inlined
def _run_boolean(
    node: Integers, columns: Floats, target: Floats, history: Floats, look: Look, begin: int, end: int
) -> None:
    """Run a literal, a conjunction or a disjunction."""
    code, a, b = node[codes.NODE_CODE], node[codes.NODE_A], node[codes.NODE_B]
    if code == codes.PART_AND:
        for k in range(begin, end):
            target[k] = min(columns[a, k], columns[b, k])
    elif code == codes.PART_OR:
        for k in range(begin, end):
            target[k] = max(columns[a, k], columns[b, k])
    elif b:
        for k in range(begin, end):
            target[k] = -history[look.mirror, a, k]
    else:
        for k in range(begin, end):
            target[k] = history[look.channel, a, k]


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


@piece
def _run_window(
    node: Integers, source: Floats, target: Floats, low: int, high: int, stamps: Integers, offset: int,
    last: int, mode: int, wedge: Integers,
) -> None:  # fmt: skip
    """Run a bounded operator at low … high: the extremum of `source` over the window ahead or behind."""
    unit, near, far = node[codes.NODE_UNIT], node[codes.NODE_LOW], node[codes.NODE_HIGH]
    is_ahead = node[codes.NODE_CODE] in (codes.PART_WINDOW_MAX, codes.PART_WINDOW_MIN)
    sign = 1.0 if node[codes.NODE_CODE] in (codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX) else -1.0
    nearest, beyond_farthest = (near, far + 1) if is_ahead else (-far, 1 - near)
    head = tail = entering = 0
    start = after = offset
    if unit != codes.SAMPLES:
        newest = last if is_ahead else low
        start = first_after(stamps, offset, newest, low, nearest)
        after = first_after(stamps, offset, newest, low, beyond_farthest)
    for position in range(low, high + 1):
        if unit == codes.SAMPLES:
            start, after = max(position + nearest, offset), min(position + beyond_farthest, last + 1)
        else:
            newest = last if is_ahead else position
            start = first_onward(stamps, offset, newest, position, nearest, start)
            after = first_onward(stamps, offset, newest, position, beyond_farthest, after)
        entering = max(entering, start)
        while entering < after:
            value = sign * source[entering - offset]
            while tail > head and sign * source[wedge[tail - 1] - offset] <= value:
                tail -= 1
            wedge[tail] = entering
            tail += 1
            entering += 1
        while tail > head and wedge[head] < start:
            head += 1
        result = source[wedge[head] - offset] if tail > head else -sign * np.inf
        if is_ahead and not is_closed(stamps, offset, last, position, unit, far):
            beyond = _beyond(mode, node[codes.NODE_WEAK])
            result = max(result, beyond) if sign > 0 else min(result, beyond)
        target[position - offset] = result


@inlined
def _run_shift(
    node: Integers, source: Floats, target: Floats, low: int, high: int, stamps: Integers, offset: int,
    last: int, mode: int,
) -> None:  # fmt: skip
    """Run a shift or a delay at positions low … high: `source` at a distance ahead or behind."""
    unit, distance = node[codes.NODE_UNIT], node[codes.NODE_LOW]
    is_ahead = node[codes.NODE_CODE] == codes.SHIFT
    missing = _beyond(mode if is_ahead else codes.OPEN_END, node[codes.NODE_WEAK])
    for position in range(low, high + 1):
        if is_ahead:
            at = ahead(stamps, offset, last, position, unit, distance)
        else:
            at = behind(stamps, offset, position, unit, distance)
        target[position - offset] = source[at - offset] if offset <= at <= last else missing


@inlined
def _run_until(
    node: Integers, part: Integers, target: Floats, low: int, high: int, look: Look, memory: Memory,
    scratch: Scratch, offset: int,
) -> None:  # fmt: skip
    """Run an unbounded until or release at low … high; its variable's value goes to the point."""
    variable = node[codes.NODE_VARIABLE]
    if look.mode == codes.OPEN_CORNER:
        after = corner_value(look.corner, variable) if variable >= 0 else -np.inf
    else:
        after = _beyond(look.mode, node[codes.NODE_WEAK])
    _run_recurrence(node, scratch.columns, target, after, high - offset, low - offset - 1, -1)
    if variable >= 0:
        boundary = memory.cells[_cells_of(part)[1] + variable]
        scratch.point[variable] = target[boundary - offset] if boundary <= high else after


@inlined
def _run_since(
    node: Integers, part: Integers, tables: Floats, target: Floats, high: int, memory: Memory,
    scratch: Scratch, offset: int,
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
    _run_recurrence(node, scratch.columns, target, value, start + 1 - offset, high - offset + 1, 1)


@piece
def _run_columns(
    nodes: Integers, part: Integers, tables: Floats, look: Look, memory: Memory, scratch: Scratch,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Run every node of a part over the positions that matter, operands first.

    `scratch.point` receives the variables' values where the table's base ends, `scratch.starts` the
    values that past operators start from.
    """
    first, stamps, columns = part[codes.PART_FIRST], memory.stamps, scratch.columns
    for d in range(first, part[codes.PART_END]):
        node = nodes[d]
        if look.corner > 0 and not node[codes.NODE_DEPENDS]:
            continue  # the same at every corner
        code, target = node[codes.NODE_CODE], columns[d - first]
        low, high = scratch.low[d - first], scratch.high[d - first]
        if code in (codes.LITERAL, codes.PART_AND, codes.PART_OR):
            begin, end = low - offset, high - offset + 1
            _run_boolean(node, columns, target, memory.history, look, begin, end)
        elif code in (codes.UNTIL, codes.RELEASE):
            _run_until(node, part, target, low, high, look, memory, scratch, offset)
        elif code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
            _run_since(node, part, tables, target, high, memory, scratch, offset)
        elif code in (codes.SHIFT, codes.PAST_DELAY):
            source = columns[node[codes.NODE_A]]
            _run_shift(node, source, target, low, high, stamps, offset, last, look.mode)
        else:
            source = columns[node[codes.NODE_A]]
            _run_window(node, source, target, low, high, stamps, offset, last, look.mode, scratch.wedge)


@inlined
def _value_at_first(
    nodes: Integers, part: Integers, tables: Floats, look: Look, memory: Memory, scratch: Scratch,
    offset: int, last: int,
) -> float:  # fmt: skip
    """Return the part's value at the first sample, given a run over the recent ones."""
    _run_columns(nodes, part, tables, look, memory, scratch, offset, last)
    if memory.cells[part[codes.PART_CELL_START]] == 0:
        return float(scratch.columns[part[codes.PART_END] - 1 - part[codes.PART_FIRST], 0 - offset])
    variables = part[codes.PART_VARIABLES]
    return read_table(tables[: 1 << variables], variables, scratch.point, scratch.order)


@piece
def _absorb(
    nodes: Integers, part: Integers, memory: Memory, scratch: Scratch, channels: int, offset: int, last: int
) -> None:
    """Move the base forward over every position whose windows have all closed."""
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


@piece
def _renew_tables(
    nodes: Integers, part: Integers, channel: int, mirror: int, memory: Memory, scratch: Scratch,
    offset: int, last: int,
) -> None:  # fmt: skip
    """Renew the tables of a part, in one channel, after adding the position at its base."""
    first, fresh, size = part[codes.PART_FIRST], scratch.fresh, 1 << part[codes.PART_VARIABLES]
    states = _cells_of(part)[2]
    tables = _tables_of(part, channel, memory)
    for corner in range(size):
        look = Look(channel, mirror, codes.OPEN_CORNER, corner)
        fresh[corner] = _value_at_first(nodes, part, tables, look, memory, scratch, offset, last)
        for d in range(first, part[codes.PART_END]):
            table = nodes[d, codes.NODE_TABLE]
            if table >= 0:
                state = scratch.plain[d - first] - 1
                is_new = state > memory.cells[states + table]
                value = scratch.columns[d - first, state - offset] if is_new else scratch.starts[table]
                fresh[table * size + corner] = value
    for k in range(len(tables)):
        tables[k] = fresh[k]


@piece
def _tables_of(part: Integers, channel: int, memory: Memory) -> Floats:
    """Return a part's own table and those of its past operators, one after the other."""
    start = part[codes.PART_TABLE_START]
    return memory.tables[channel, start : start + (part[codes.PART_TABLES] << part[codes.PART_VARIABLES])]


@inlined
def _is_settled(part: Integers, memory: Memory) -> bool:
    """Return whether no later sample matters: every window from the first sample on has closed."""
    without_state = part[codes.PART_VARIABLES] == 0 and not part[codes.PART_IS_REMEMBERING]
    return bool(without_state and memory.cells[part[codes.PART_CELL_START]] > 0)


@piece
def step_windows(
    nodes: Integers, part: Integers, memory: Memory, scratch: Scratch, channels: int, position: int,
    offset: int, count: int, numbers: Floats,
) -> None:  # fmt: skip
    """Run a part with windows over `count` samples, the first of them at `position`.

    Args:
        numbers: (NUMBERS, TILE), filled with the part's numbers; those of an ending run for the last sample.
    """
    nominal_high = 1 if channels > 1 else 0
    wide_low = 2 if channels > 2 else 0
    nodes_of_part = part[codes.PART_END] - part[codes.PART_FIRST]
    for k in range(count):
        last = position + k
        if _is_settled(part, memory):
            for which in range(NUMBERS):
                channel = (0 if which < 4 else wide_low) + (nominal_high if which % 2 else 0)
                numbers[which, k] = _tables_of(part, channel, memory)[0]
            continue
        base = min(memory.cells[part[codes.PART_CELL_START]], last)
        reach(nodes, part, memory, scratch, base, last, offset, last)
        scratch.high[:nodes_of_part] = last
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
            channel = (0 if which < 2 else wide_low) + (nominal_high if which % 2 else 0)
            mode = codes.OPEN_LOW if which == 4 else codes.OPEN_HIGH if which == 5 else codes.OPEN_END
            look = Look(channel, channel ^ nominal_high, mode, 0)
            tables = _tables_of(part, channel, memory)
            numbers[which, k] = _value_at_first(nodes, part, tables, look, memory, scratch, offset, last)
            if which < 2 and part[codes.PART_IS_REMEMBERING]:
                numbers[which + 2, k] = scratch.columns[nodes_of_part - 1, last - offset]
        _absorb(nodes, part, memory, scratch, channels, offset, last)


@kernel
def kept_from(
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
