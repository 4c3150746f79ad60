"""All parts with windows, run over a tile of samples in the way that costs least."""

from __future__ import annotations

from spatial_replay.compiled import apart, uncounted
from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.blocks.block_ends import find_begins
from spatial_replay.monitor.online.blocks.block_run import PARTIAL, WHOLE, run_block
from spatial_replay.monitor.online.blocks.wide_run import run_wide
from spatial_replay.monitor.online.closing import is_settled
from spatial_replay.monitor.online.node_columns import columns_number
from spatial_replay.monitor.online.open_windows import is_over, looks_of
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.state import BLOCK, LOOKS, POSITION
from spatial_replay.monitor.online.windows import run_part

WORTHWHILE = 8
"""So many samples at least are run as a block."""

SPANNED = 320
"""From so many open positions on, spans of them are worth finding."""

MOST_TOGETHER = 256
"""For so many samples at most are they found together."""


@uncounted
def _reach(known: Integers, looks: int, last: int) -> bool:
    """Return whether columns are known up to a sample, all those that are computed."""
    reached = True
    for which in range(LOOKS):
        if (looks >> which) & 1:
            reached = reached and known[columns_number(which)] == last
    return reached


@uncounted
def _samples_together(table_at: int, number: int, channels: int, since: int, most: int) -> int:
    """Return for how many samples spans are found together: the more positions are open, the more.

    Args:
        most: so many at most.
    """
    tables, memory, _, _ = arrays_at(table_at)
    part = tables.parts[number]
    count = since - find_begins(table_at, number, 0, channels, 0, 0, since, since)
    together = 0
    if count > SPANNED:
        together = 2 * BLOCK
        while 3 * together * together < 4 * count and together < MOST_TOGETHER:
            together *= 2
    together = min(together, most)
    # they are all of one kind
    while together > 1 and is_over(part, memory, since + together - 1) and not is_over(part, memory, since):
        together -= 1
    return together


@apart
def run_in_blocks(table_at: int, channels: int, count: int) -> int:
    """Run all parts with windows over the next `count` samples, in blocks as far as possible."""
    tables, memory, _, _ = arrays_at(table_at)
    # numbers of an ending run are computed at the last sample alone
    position, stop = memory.clock[POSITION], count - 1 if channels == 4 else count
    for number in range(len(tables.parts)):
        part, k, state = tables.parts[number], 0, WHOLE
        if part[codes.PART_KIND] != codes.WINDOWED or not part[codes.PART_NUMBERS] & codes.FIRST_NUMBERS:
            continue
        while k < count:
            if is_settled(part, memory):
                run_part(table_at, number, channels, k, count, count)
                break
            root = tables.nodes[part[codes.PART_END] - 1]
            looks = looks_of(part, root, memory, channels, False, position + k)
            is_up = _reach(memory.known[number], looks, position + k - 1)
            if not is_up and _reach(memory.closed[number], looks, position + k - 1):
                is_up, state = True, PARTIAL
            size, is_whole, after = min(BLOCK, stop - k), state == WHOLE, 0
            if size < WORTHWHILE or not is_up:
                size = 1
            else:
                together = _samples_together(table_at, number, channels, position + k, stop - k)
                after = run_wide(table_at, number, looks, channels, k, together, count) if together else 0
                if after:
                    k, state = k + together, after
                    continue
                is_followed = stop - k - size >= WORTHWHILE
                after = run_block(table_at, number, looks, channels, k, size, is_followed, is_whole)
            if after == 0:
                if not is_whole:
                    memory.known[number] = -1
                run_part(table_at, number, channels, k, k + size, count)
            state = WHOLE if after == 0 else after
            k += size
        if state == PARTIAL:
            memory.known[number] = -1
    return 0
