"""Parts with windows, run over a block of samples at once (see `blocks.node_rows`).

A block says the same as its samples one by one (see `windows`), and leaves the columns as these would.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.compiled import apart, inlined, uncounted
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.blocks.block_ends import (
    WIDE,
    find_begins,
    find_closing,
    find_ends,
    is_beside_one,
)
from spatial_replay.monitor.online.blocks.node_rows import (
    NodeRows,
    SampleBlock,
    fill_open,
    join_closed,
    join_operands_rows,
    join_positions,
    recurrent_rows,
    shift_rows,
    take_row,
    window_rows,
)
from spatial_replay.monitor.online.blocks.row_loops import fill_row
from spatial_replay.monitor.online.blocks.span_rows import block_of
from spatial_replay.monitor.online.closing import absorb, is_outdone, looks_for_outdone
from spatial_replay.monitor.online.node_columns import (
    cells_of,
    columns_number,
    look_of,
    signal_of,
    start_of_past,
    tables_end,
)
from spatial_replay.monitor.online.open_windows import (
    has_ended,
    is_cut_short,
    is_known,
    is_over,
    is_plain,
    is_same,
    known_number,
    root_window,
    runs_root,
)
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import (
    Recent,
    beyond,
    copy,
    either,
    enter_samples,
    extremum,
    fill,
    is_decided,
    recent_of,
)
from spatial_replay.monitor.online.state import (
    BLOCK_LAST,
    BLOCK_LOWEST,
    BLOCK_SINCE,
    IS_FOLLOWED,
    LOOKS,
    MOST_ROWS,
    OFFSET,
    POSITION,
    Memory,
    Scratch,
    first_behind,
)
from spatial_replay.monitor.online.tables import read_table

WHOLE, PARTIAL = 1, 2
"""Whether all of a part's columns are brought up, or what its next block looks at."""


@inlined
def operand_of(
    nodes: Integers, part: Integers, operand: int, columns: Floats, history: Floats, scratch: Scratch
) -> NodeRows:
    """Return the numbers of a node by its place in its part; where there is none, any."""
    d = part[codes.PART_FIRST] + max(operand, 0)
    signal, rows = signal_of(nodes, d), scratch.rows[max(nodes[d, codes.NODE_ROWS], 0)]
    return NodeRows(columns[d] if signal < 0 else history[signal], rows, scratch.begins[max(operand, 0)])


@apart
def _run_node(table_at: int, number: int, d: int, which: int, channels: int) -> int:
    """Compute the rows of a node, and what the next samples need of its column (see `node_columns`)."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, recent = tables.nodes, tables.parts[number], recent_of(memory, scratch)
    node, look, block = nodes[d], look_of(which, channels), block_of(memory, scratch)
    columns, history = memory.columns[columns_number(which)], memory.history[look.channel]
    code, a, b, first = node[codes.NODE_CODE], node[codes.NODE_A], node[codes.NODE_B], part[codes.PART_FIRST]
    target, begin = scratch.rows[node[codes.NODE_ROWS]], scratch.begins[d - first]
    one = operand_of(nodes, part, a, columns, history, scratch)
    two = operand_of(nodes, part, b, columns, history, scratch)
    is_greatest = code in (codes.PART_OR, codes.PART_WINDOW_MAX, codes.PAST_WINDOW_MAX)
    value = beyond(look.mode if code not in codes.PAST else codes.OPEN_END, node[codes.NODE_WEAK])
    if code in (codes.PART_AND, codes.PART_OR):
        join_operands_rows(is_greatest, block, one, two, target, begin, block.last + 1)
    elif code in codes.BINARY_NODES:
        is_strong, is_ahead, fresh = code in (codes.UNTIL, codes.PAST_SINCE), code not in codes.PAST, begin
        if is_ahead:
            fill_row(value, block.running)
        else:
            channel = look.channel
            begin = _start_since(node, part, block, columns[d], memory, scratch, channel, begin, target)
            scratch.begins[d - first] = begin
            fresh = max(begin, memory.cells[cells_of(part)[2] + node[codes.NODE_TABLE]] + 1)
        recurrent_rows(block, is_strong, a >= 0, one, two, target, fresh, block.last + 1, is_ahead)
    else:
        find_ends(node, recent, begin, block.last + 1, block.offset, block.last, block.starts, block.afters)
        if code in (codes.SHIFT, codes.PAST_DELAY):
            end, is_ahead = block.last + 1, code == codes.SHIFT
            is_in_place = nodes[first + a, codes.NODE_ROWS] == node[codes.NODE_ROWS]
            if is_ahead and is_in_place and node[codes.NODE_LOW] == 0:
                end = min(max(one.begin, begin), end)  # from there on, its rows are the operand's
            shift_rows(block, is_ahead, one, target, begin, end, value)
        else:
            closed = block.last + 1
            if code in codes.AHEAD_OF and is_decided(node, look.mode):
                end = block.last + 1
                find_closing(node, block, recent, begin, end, block.last, True, scratch.closing)
                while closed > begin and scratch.closing[closed - 1 - begin] > block.last - block.since:
                    closed -= 1
            window_rows(block, is_greatest, one, target, begin, closed)
            if code in codes.AHEAD_OF and is_decided(node, look.mode):
                fill_open(block, scratch.closing, target, begin, block.last + 1, value)
    # after another block, the columns of positions that are still open are looked at no more
    stop = scratch.next_begins[d - first] if scratch.block[IS_FOLLOWED] else block.last + 1
    for position in range(begin, stop):
        columns[d, position - block.offset] = target[position - block.lowest, block.last - block.since]
    variable = node[codes.NODE_VARIABLE]
    if variable >= 0:
        boundary = memory.cells[cells_of(part)[1] + variable]
        take_row(block, NodeRows(columns[d], target, begin), boundary, value, scratch.points[variable])
    return 0


@inlined
def _start_since(
    node: Integers, part: Integers, block: SampleBlock, column: Floats, memory: Memory, scratch: Scratch,
    channel: int, begin: int, target: Floats,
) -> int:  # fmt: skip
    """Put what a since or trigger is before its first rows into the running row.

    Returns:
        The position of its first row: `begin`, or that of what it starts from, if that differs.
    """
    running, offset = block.running, block.offset
    start = memory.cells[cells_of(part)[2] + node[codes.NODE_TABLE]]
    tables = memory.tables[channel, part[codes.PART_TABLE_START] : tables_end(part)]
    differs = begin <= start
    for k in range(block.last + 1 - block.since if start >= 0 else 0):
        for variable in range(part[codes.PART_VARIABLES]):
            scratch.point[variable] = scratch.points[variable, k]
        running[k] = start_of_past(node, part, tables, start, scratch)
        differs = differs or running[k] != column[start - offset]
    if differs:
        fill_row(running, target[start - block.lowest])
        return int(start)
    if begin <= offset:
        fill_row(np.inf if node[codes.NODE_WEAK] else -np.inf, running)
    else:
        fill_row(column[begin - 1 - offset], running)
    return begin


@uncounted
def _join_body(
    nodes: Integers, part: Integers, block: SampleBlock, body: NodeRows, base: int, after: int,
    start: float, is_cut: bool, recent: Recent, closing: Integers,
) -> None:  # fmt: skip
    """Fill the running row with what the root of a part joins, from its base on, and a number.

    Args:
        after: what comes after the last position.
        is_cut: whether only what comes before the first open window that cuts the bound short.
        closing: room to work in.
    """
    is_until, offset = nodes[part[codes.PART_END] - 1, codes.NODE_CODE] == codes.UNTIL, block.offset
    settled, cuts = max(body.begin, base), 0
    for d in range(part[codes.PART_FIRST], part[codes.PART_END] if is_cut else 0):
        unit, far = nodes[d, codes.NODE_UNIT], nodes[d, codes.NODE_HIGH]
        if nodes[d, codes.NODE_CUTS] and far > 0 and block.since > offset:
            closed = first_behind(recent.stamps, offset, block.since - 1, unit, far - 1)
            settled = max(min(settled, closed), base)
    for d in range(part[codes.PART_FIRST], part[codes.PART_END] if is_cut else 0):
        if nodes[d, codes.NODE_CUTS]:
            find_closing(nodes[d], block, recent, settled, block.last + 1, block.last, cuts == 0, closing)
            cuts += 1
    known = max(min(settled, after), base)
    fill_row(extremum(is_until, body.column[base - offset : known - offset], start), block.running)
    if cuts == 0:
        join_positions(block, is_until, body, settled, after)
        return
    whole = settled
    while body.begin <= whole < min(block.since + 1, after) and closing[whole - settled] <= 0:
        whole += 1
    join_positions(block, is_until, body, settled, whole)
    join_closed(block, is_until, body, whole, after, closing[whole - settled :])


@uncounted
def enter_numbers(
    part: Integers, root: Integers, table: Floats, base: int, block: SampleBlock, scratch: Scratch,
    numbers: Floats,
) -> None:  # fmt: skip
    """Enter what a part says, by its table and by what the root is from the base on: the running row."""
    if base == 0:
        copy(block.running, numbers)
    elif is_plain(part):
        for k in range(len(numbers)):
            numbers[k] = max(table[0], min(block.running[k], table[1]))
    else:
        variables, points, point = part[codes.PART_VARIABLES], scratch.points, scratch.point
        for k in range(len(numbers)):
            for variable in range(variables):
                point[variable] = points[variable, k]
            if root[codes.NODE_VARIABLE] >= 0:
                point[root[codes.NODE_VARIABLE]] = block.running[k]
            numbers[k] = read_table(table[: 1 << variables], variables, point, scratch.order)


@apart
def set_first(table_at: int, number: int, which: int, channels: int, at: int) -> int:
    """Enter one of a part's numbers at the first sample, for each sample of the block (see `windows`)."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, block = tables.nodes, tables.parts[number], block_of(memory, scratch)
    look, end, root = look_of(which, channels), part[codes.PART_END] - 1, nodes[part[codes.PART_END] - 1]
    count = block.last + 1 - block.since
    numbers = scratch.parts[number, which, at : at + count]
    if is_known(which, part, memory, block.since):
        fill(numbers, known_number(which, part, memory, look.channel))
        return 0
    if is_same(which, part, memory, channels, block.since):
        copy(scratch.parts[number, look.channel, at : at + count], numbers)
        return 0
    base, is_cut = memory.cells[part[codes.PART_CELL_START]], is_cut_short(which, part, root, channels)
    columns = memory.columns[look.channel if is_cut else columns_number(which)]
    table = memory.tables[look.channel, part[codes.PART_TABLE_START] : tables_end(part)]
    mode = codes.OPEN_END if has_ended(part, root, memory, block.since) else look.mode
    missing = beyond(mode, root[codes.NODE_WEAK])
    has_root = runs_root(part, root)
    place = end - part[codes.PART_FIRST] if has_root else root[codes.NODE_B]
    operand = operand_of(nodes, part, place, columns, memory.history[look.channel], scratch)
    if has_root and root[codes.NODE_VARIABLE] >= 0:
        copy(scratch.points[root[codes.NODE_VARIABLE]], block.running)
    elif has_root:
        take_row(block, operand, 0, missing, block.running)
    else:
        recent, closing = recent_of(memory, scratch), scratch.closing
        begin, after = root_window(root, memory, block.last)
        begin = max(begin, base)
        _join_body(nodes, part, block, operand, begin, after, missing, is_cut, recent, closing)
    enter_numbers(part, root, table, base, block, scratch, numbers)
    return 0


@uncounted
def set_last(table_at: int, number: int, which: int, channels: int, at: int) -> None:
    """Enter what a part says of itself, and of others, at each sample of the block (see `windows`)."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, block = tables.nodes, tables.parts[number], block_of(memory, scratch)
    end, root = part[codes.PART_END] - 1, nodes[part[codes.PART_END] - 1]
    history = memory.history[look_of(which, channels).channel]
    value, is_until = beyond(codes.OPEN_END, root[codes.NODE_WEAK]), root[codes.NODE_CODE] == codes.UNTIL
    for other in range(len(tables.parts)):
        if tables.parts[other, codes.PART_LAST_IN] != number:
            continue
        place = tables.parts[other, codes.PART_LAST_NODE]
        is_joined = place == end - part[codes.PART_FIRST] and not runs_root(part, root)
        place = root[codes.NODE_B] if is_joined else place
        operand = operand_of(nodes, part, place, memory.columns[which], history, scratch)
        for k in range(block.last + 1 - block.since):
            position = block.since + k
            number_now = (
                operand.column[position - block.offset]
                if position < operand.begin
                else operand.rows[position - block.lowest, k]
            )
            if is_joined:
                number_now = either(is_until, number_now, value)
            scratch.parts[other, which + 2, at + k] = number_now
            if channels == 1:
                scratch.parts[other, 3, at + k] = number_now


@uncounted
def _outdone_in_rows(table_at: int, number: int, which: int) -> int:
    """Return what comes after the positions where what the root joins is outdone after a block."""
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, block = tables.nodes, tables.parts[number], block_of(memory, scratch)
    root, position = nodes[part[codes.PART_END] - 1], memory.cells[part[codes.PART_CELL_START]]
    history, sample = memory.history[which], block.last - block.since
    body = operand_of(nodes, part, root[codes.NODE_B], memory.columns[which], history, scratch)
    while position <= block.last:
        is_row = position >= body.begin
        value = body.rows[position - block.lowest, sample] if is_row else body.column[position - block.offset]
        if not is_outdone(part, root, memory, which, value):
            break
        position += 1
    return int(position)


@apart
def run_block(
    table_at: int,
    number: int,
    looks: int,
    channels: int,
    at: int,
    count: int,
    is_followed: int,
    is_whole: int,
) -> int:
    """Run a part over `count` samples from number `at` of a tile on, at most BLOCK.

    Its columns are those of the sample before. `scratch.parts` receives its numbers, but none of an ending
    run where these may differ from the value.

    Args:
        looks: the numbers that are computed by themselves, a bit for each.
        is_followed: 1 if the samples after these are run as a block, too.
        is_whole: 1 if all columns are brought up.

    Returns:
        WHOLE or PARTIAL: whether all columns are brought up; or 0 if too many positions are open, and nothing
        is done.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, numbers = tables.nodes, tables.parts[number], scratch.parts[number]
    first, end, root = part[codes.PART_FIRST], part[codes.PART_END], nodes[part[codes.PART_END] - 1]
    since = memory.clock[POSITION] + at
    last = since + count - 1
    block, most = scratch.block, min(scratch.rows.shape[1], MOST_ROWS)
    lowest = find_begins(table_at, number, 0, channels, 0, 0, since, last)
    if last + 1 - lowest > most:
        return 0
    if is_over(part, memory, last) and not is_over(part, memory, since):
        return 0  # the samples of a block are all of one kind
    is_wide = last + 1 - lowest > WIDE
    narrows = 1 if is_wide and is_whole else 0
    if narrows and is_beside_one(nodes, part, memory.stamps, memory.clock[OFFSET], since):
        # sample by sample, the width of one window alone costs next to nothing
        for which in range(LOOKS):
            if (looks >> which) & 1:
                narrowed = find_begins(table_at, number, which, channels, narrows, 0, since, last)
                if last + 1 - narrowed > WIDE:
                    return 0
    block[BLOCK_SINCE], block[BLOCK_LAST], block[BLOCK_LOWEST] = since, last, lowest
    block[IS_FOLLOWED] = 1 if is_followed and not is_wide else 0
    for d in range(first, end):
        # one that never ends stays open although what it is joined with has closed
        if nodes[d, codes.NODE_CODE] in (codes.UNTIL, codes.RELEASE) and nodes[d, codes.NODE_VARIABLE] < 0:
            block[IS_FOLLOWED] = 0
    if block[IS_FOLLOWED]:
        find_begins(table_at, number, 0, channels, 0, 1, last + 1, last + 1)
    if len(memory.window_next):
        ends, next_ends = memory.window_ends, memory.window_next
        enter_samples(nodes, part, memory.stamps, ends, next_ends, memory.clock[OFFSET], last)
    outdone = 0
    for which in range(LOOKS):
        if not (looks >> which) & 1:
            continue
        if narrows:
            block[BLOCK_LOWEST] = find_begins(table_at, number, which, channels, narrows, 0, since, last)
        for d in range(first, end if runs_root(part, root) else end - 1):
            if nodes[d, codes.NODE_CODE] != codes.LITERAL:
                _run_node(table_at, number, d, which, channels)
        memory.known[number, columns_number(which)] = last
        if not runs_root(part, root):
            unjoined = memory.unjoined[number]
            begin = min(scratch.begins[root[codes.NODE_B]], since)
            unjoined[columns_number(which)] = min(unjoined[columns_number(which)], begin)
        set_first(table_at, number, which, channels, at)
        if which > 1:
            continue
        if looks_for_outdone(part, memory, channels, codes.BY_VALUE, last):
            found = _outdone_in_rows(table_at, number, which)
            outdone = found if which == 0 else min(outdone, found)
        if part[codes.PART_IS_REMEMBERING]:
            set_last(table_at, number, which, channels, at)
        for bound in (4, 5):
            # of a bound that has no columns of its own
            is_beside = bound - 4 == which if channels == 4 else look_of(bound, channels).channel == which
            if is_beside and ((part[codes.PART_NUMBERS] & ~looks) >> bound) & 1:
                set_first(table_at, number, bound, channels, at)
    for k in range(at, at + count if channels < 4 else at):
        if channels == 1:
            numbers[1, k] = numbers[0, k]
        numbers[6, k], numbers[7, k] = numbers[0, k], numbers[1, k]
    absorb(table_at, number, channels, last, outdone)
    return PARTIAL if block[IS_FOLLOWED] else WHOLE
