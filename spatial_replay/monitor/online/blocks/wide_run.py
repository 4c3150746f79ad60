"""Parts with many open positions, run over several blocks of samples at once (see `blocks.spans`)."""

from __future__ import annotations

from spatial_replay.compiled import apart, uncounted
from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.blocks.block_ends import find_begins, is_beside_one
from spatial_replay.monitor.online.blocks.block_run import (
    PARTIAL,
    WHOLE,
    enter_numbers,
    operand_of,
    set_first,
    set_last,
)
from spatial_replay.monitor.online.blocks.span_rows import (
    block_of,
    join_body_spans,
    outdone_in_spans,
    run_spans,
)
from spatial_replay.monitor.online.blocks.span_tables import fill_tables
from spatial_replay.monitor.online.blocks.spans import find_spans
from spatial_replay.monitor.online.closing import absorb, looks_for_outdone
from spatial_replay.monitor.online.node_columns import cells_of, columns_number, look_of, tables_end
from spatial_replay.monitor.online.open_windows import (
    has_ended,
    is_cut_short,
    is_known,
    is_over,
    is_same,
    root_window,
    runs_root,
)
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.sliding import beyond, enter_samples, recent_of
from spatial_replay.monitor.online.state import (
    BLOCK,
    BLOCK_LAST,
    BLOCK_LOWEST,
    BLOCK_NEWEST,
    BLOCK_SINCE,
    IS_FOLLOWED,
    LOOKS,
    OFFSET,
    POSITION,
    Memory,
)
from spatial_replay.monitor.online.windows import run_part

_SPANNED = (
    codes.LITERAL, codes.PART_AND, codes.PART_OR, *codes.AHEAD_OF, *codes.PAST_WINDOWS,
    codes.UNTIL, codes.RELEASE, codes.PAST_SINCE, codes.PAST_TRIGGER,
)  # fmt: skip
"""Nodes that spans are found for."""


@uncounted
def _takes_spans(nodes: Integers, part: Integers, memory: Memory, begins: Integers) -> bool:
    """Return whether spans can be found for a part, given where the rows of its nodes begin."""
    first, cells, tables_from = part[codes.PART_FIRST], memory.cells, cells_of(part)[2]
    root = nodes[part[codes.PART_END] - 1]
    if part[codes.PART_VARIABLES] == 0 or (runs_root(part, root) and cells[part[codes.PART_CELL_START]] == 0):
        return False
    takes = True
    for d in range(first, part[codes.PART_END]):
        a, b, code = nodes[d, codes.NODE_A], nodes[d, codes.NODE_B], nodes[d, codes.NODE_CODE]
        takes = takes and code in _SPANNED
        if takes and code in (codes.PAST_SINCE, codes.PAST_TRIGGER):
            # what they start from must not follow what is to come
            depends = nodes[first + b, codes.NODE_DEPENDS] or (
                a >= 0 and nodes[first + a, codes.NODE_DEPENDS]
            )
            takes = not depends and begins[d - first] > cells[tables_from + nodes[d, codes.NODE_TABLE]]
    return bool(takes)


@apart
def _set_first_of_spans(
    table_at: int, number: int, which: int, channels: int, at: int, columns_of: int
) -> int:
    """Enter one of a part's numbers at the first sample, as `set_first` does, from the spans of its body.

    A root with a column of its own needs none of these.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, block = tables.nodes, tables.parts[number], block_of(memory, scratch)
    first, end = part[codes.PART_FIRST], part[codes.PART_END] - 1
    look, root = look_of(which, channels), nodes[end]
    is_said = is_known(which, part, memory, block.since) or is_same(
        which, part, memory, channels, block.since
    )
    if runs_root(part, root) or is_said:
        return int(set_first(table_at, number, which, channels, at))
    table = memory.tables[look.channel, part[codes.PART_TABLE_START] : tables_end(part)]
    mode = codes.OPEN_END if has_ended(part, root, memory, block.since) else look.mode
    missing, count = beyond(mode, root[codes.NODE_WEAK]), block.last + 1 - block.since
    numbers, body = scratch.parts[number, which, at : at + count], root[codes.NODE_B]
    base, (begin, after) = memory.cells[part[codes.PART_CELL_START]], root_window(root, memory, block.last)
    operand = operand_of(nodes, part, body, memory.columns[columns_of], memory.history[look.channel], scratch)
    join_body_spans(
        nodes, part, block, operand, max(base, begin), after, missing,
        is_cut_short(which, part, root, channels), recent_of(memory, scratch),
        scratch.block[BLOCK_NEWEST], scratch.spans[body], scratch.span_counts[body],
        scratch.wholes[end - first], scratch.closing,
    )  # fmt: skip
    enter_numbers(part, root, table, base, block, scratch, numbers)
    return 0


@uncounted
def _find_next_begins(table_at: int, number: int, channels: int, last: int) -> None:
    """Enter up to where the column of each node is looked at after these samples.

    What an operator that never ends is joined with says when both have closed. Then only what is absorbed is
    looked at, which is what the root joins, or what a node that depends on a table does.
    """
    tables, _, scratch, _ = arrays_at(table_at)
    nodes, part = tables.nodes, tables.parts[number]
    first, root = part[codes.PART_FIRST], part[codes.PART_END] - 1
    find_begins(table_at, number, 0, channels, 0, 0, last + 1, last + 1)
    find_begins(table_at, number, 0, channels, 0, 2, last + 1, last + 1)
    for d in range(first, root + 1):
        is_absorbed = False
        for above in range(d + 1, root + 1):
            is_operand = nodes[above, codes.NODE_A] == d - first or nodes[above, codes.NODE_B] == d - first
            is_absorbed = is_absorbed or (
                is_operand and (above == root or nodes[above, codes.NODE_DEPENDS] > 0)
            )
        if not is_absorbed:
            scratch.next_begins[d - first] = scratch.begins[d - first]


@apart
def run_wide(table_at: int, number: int, looks: int, channels: int, at: int, count: int, tile: int) -> int:
    """Run a part with many open positions over `count` samples from number `at` of a tile on (see `spans`).

    Args:
        looks: as for `run_block`.
        tile: how many samples the tile has.

    Returns:
        WHOLE or PARTIAL, as `run_block`; or 0 if it cannot be run so, and nothing is done.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    nodes, part, numbers = tables.nodes, tables.parts[number], scratch.parts[number]
    block, offset = scratch.block, memory.clock[OFFSET]
    since = memory.clock[POSITION] + at
    last = since + count - 1
    if since <= offset:
        return 0
    if is_beside_one(nodes, part, memory.stamps, offset, since):
        return 0  # sample by sample, the width of one window alone costs next to nothing
    if is_over(part, memory, last) and not is_over(part, memory, since):
        return 0  # the samples are all of one kind
    # as long as not looked at what the samples are, this is the same for all numbers
    _find_next_begins(table_at, number, channels, last)
    lowest, is_first = find_begins(table_at, number, 0, channels, 0, 0, since, last), True
    if last + 1 - lowest > scratch.rows.shape[1] or not _takes_spans(nodes, part, memory, scratch.begins):
        return 0
    block[BLOCK_LOWEST], block[BLOCK_NEWEST], block[IS_FOLLOWED], outdone = lowest, last, 1, 0
    for which in range(LOOKS):
        if not (looks >> which) & 1:
            continue
        if not find_spans(table_at, number, which, channels, since, last):
            if is_first:
                return 0
            memory.known[number], memory.window_next[:] = -1, -1
            run_part(table_at, number, channels, at, at + count, tile)
            return WHOLE
        if is_first and len(memory.window_next):
            enter_samples(nodes, part, memory.stamps, memory.window_ends, memory.window_next, offset, last)
        is_first = False
        fill_tables(table_at, number, which, channels, last)
        for begin in range(since, last + 1, BLOCK):
            end = min(begin + BLOCK - 1, last)
            block[BLOCK_SINCE], block[BLOCK_LAST] = begin, end
            run_spans(table_at, number, which, channels, 1 if end == last else 0)
            k = at + begin - since
            _set_first_of_spans(table_at, number, which, channels, k, columns_number(which))
            if which > 1:
                continue
            if part[codes.PART_IS_REMEMBERING]:
                set_last(table_at, number, which, channels, k)
            for bound in (4, 5):
                is_beside = bound - 4 == which if channels == 4 else look_of(bound, channels).channel == which
                if is_beside and ((part[codes.PART_NUMBERS] & ~looks) >> bound) & 1:
                    _set_first_of_spans(table_at, number, bound, channels, k, columns_number(which))
        if which < 2 and looks_for_outdone(part, memory, channels, codes.BY_WORST, last):
            found = outdone_in_spans(table_at, number, which)
            outdone = found if which == 0 else min(outdone, found)
        memory.known[number, columns_number(which)] = memory.closed[number, columns_number(which)] = last
        memory.unjoined[number, columns_number(which)] = 0
    for k in range(at, at + count if channels < 4 else at):
        if channels == 1:
            numbers[1, k] = numbers[0, k]
        numbers[6, k], numbers[7, k] = numbers[0, k], numbers[1, k]
    absorb(table_at, number, channels, last, outdone)
    return PARTIAL
