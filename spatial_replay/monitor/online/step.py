"""One program on one stream of samples: the compiled step that monitors and replays share.

Samples are run in tiles: first the signals of a tile (subformulas without future operators, final at each
sample), then each part, then the tree as the user wrote it. A tile of one sample and a tile of many give the
same bits, because the only arithmetic is minima, maxima and negation.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np

from spatial_replay.compiled import apart, floats_at, inlined, integers_at, releasing
from spatial_replay.cores import cores
from spatial_replay.geometry.arrays import Empty, Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.blocks.tile_run import run_in_blocks
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.online.node_numbers import Results, report
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.run_arrays import RunArrays, Tables, arrays_at, table_of
from spatial_replay.monitor.online.shares import (
    NARROW,
    RunAhead,
    SectionStart,
    begin_late,
    bound_late,
    bound_memory,
    closed_up_to,
    copied,
    joined_memory,
    numbers_of,
    open_share,
    sections_of,
    shared_programs,
    starts_of,
)
from spatial_replay.monitor.online.signals import step_signals
from spatial_replay.monitor.online.state import (
    KEEPS,
    LONG_TILE,
    OFFSET,
    POSITION,
    START_NS,
    TILE,
    Memory,
    first_memory,
    has_windows,
    know_no_columns,
    scratch_for,
    widen,
    with_room,
)
from spatial_replay.monitor.online.tables import step_tables
from spatial_replay.monitor.online.windows import forget

_MANY_TILES = 8
"""So many long tiles of samples that come together are worth more room to work in."""

_WORTH_TWO_CORES = 16 * LONG_TILE
"""So many samples that come together are worth two cores: more than a replay takes in at once, which has
both of them busy."""


@inlined
def _begin(memory: Memory, times_ns: Integers, t: int, count: int) -> int:
    """Enter the times of the next samples; return where they stand in the history."""
    clock = memory.clock
    if clock[POSITION] == 0:
        clock[START_NS] = times_ns[t]
    if not clock[KEEPS]:
        clock[OFFSET] = clock[POSITION]
    begin = clock[POSITION] - clock[OFFSET]
    stamps, times_ns = memory.stamps[begin : begin + count], times_ns[t : t + count]
    for k in range(count):
        stamps[k] = times_ns[k]
    return int(begin)


@inlined
def begin_step(
    table_at: int, leaves_at: int, channels: int, width: int, times_at: int, length: int, t: int, count: int
) -> None:
    """Run the samples t … t + count - 1 through the signals, and through the parts without windows.

    Args:
        table_at: that of the run's arrays (see `run_arrays`).
        leaves_at: (channels, width, length), the leaves of all samples, the run's own first; for as many
            channels as the run has.
        times_at: (length,), the times of all samples.
    """
    tables, memory, scratch, _ = arrays_at(table_at)
    position, begin = memory.clock[POSITION], _begin(memory, integers_at(times_at, length), t, count)
    leaves = floats_at(leaves_at, (channels, width, length))
    step_signals(tables.signals, leaves, t, count, position, begin, memory)
    step_tables(tables.nodes, tables.parts, memory, scratch, channels, position, begin, count)


@inlined
def end_step(table_at: int, channels: int, series_at: int, length: int, t: int, count: int) -> None:
    """Enter the numbers of every node into the series, (N, 4, length)."""
    tables, memory, scratch, final = arrays_at(table_at)
    begin = memory.clock[POSITION] - memory.clock[OFFSET]
    results = Results(floats_at(series_at, (len(final), 4, length)), final)
    report(tables.reports, tables.operands, memory, scratch, channels, begin, count, t, results)
    memory.clock[POSITION] += count


@apart
def step(
    table_at: int, leaves_at: int, channels: int, width: int, times_at: int, series_at: int, length: int,
    t: int, count: int,
) -> int:  # fmt: skip
    """Run samples through a program without windows under its parts (see `begin_step`, `end_step`)."""
    begin_step(table_at, leaves_at, channels, width, times_at, length, t, count)
    end_step(table_at, channels, series_at, length, t, count)
    return 0


@apart
def step_with_windows(
    table_at: int, leaves_at: int, channels: int, width: int, times_at: int, series_at: int, length: int,
    t: int, count: int,
) -> int:  # fmt: skip
    """`step` for any program; apart from it because windows are much more to compile and to load."""
    begin_step(table_at, leaves_at, channels, width, times_at, length, t, count)
    run_in_blocks(table_at, channels, count)
    end_step(table_at, channels, series_at, length, t, count)
    return 0


_LATER_SECTIONS = 4
"""So many later sections at most for each `least_shared` samples."""

_MOST_THREADS = 8
"""So many share the work at most: the one that enters the numbers of all nodes has enough to do by then."""

_MOST_IN_SECTIONS = 1 << 18
"""So many samples at most are run in sections at once: numbers of later ones wait for those of the first."""

_TILES_ALONE = 8
"""So many tiles are run before it is looked again whether several threads are worth it."""

_TILES_AT_ONCE = 4
"""So many tiles are handed over together: fewer, and waiting for each other takes longer."""


class _Stretch(NamedTuple):
    """Samples that come together, and what is said of them: see `OnlineRun.extend`."""

    leaves: Floats
    times_ns: Integers
    series: Floats


class OnlineRun:
    """The state that a compiled formula carries from sample to sample.

    Its size depends on the formula and on how many samples its windows span, not on the length of the stream.

    Attributes:
        step: the kernel that runs its samples.
    """

    def __init__(
        self, program: Program, *, room: int = 2 * TILE, tile: int = TILE,
        least_shared: int = _WORTH_TWO_CORES, threads: int | None = None,
    ) -> None:  # fmt: skip
        """Start before the first sample.

        Args:
            room: the number of recent samples there is room for at first (it doubles when needed).
            tile: how many samples are run together, at most. Samples that come one by one are faster with 1,
                since the numbers worked with then lie closer together.
            least_shared: from so many samples that come together on, several threads share the work.
            threads: how many may; with None, as many as there are cores.
        """
        self._program = program
        self.step = step_with_windows if has_windows(program) else step
        self._called = self.step
        self._least_shared = least_shared
        self._threads = min(cores(), _MOST_THREADS) if threads is None else threads
        if not program.keeps_history:
            room = tile
        self._tables = Tables.of(program)
        self._channels = 1
        self._take(first_memory(program, room), np.zeros((len(program.reports), 2)), tile)

    def __len__(self) -> int:
        """Return how many samples were added."""
        return int(self._memory.clock[POSITION])

    @property
    def table_at(self) -> int:
        """The address of the table of its arrays, until samples are added or room is made for them."""
        return self._table_at

    @property
    def final(self) -> Floats:
        """(N, 2): lower and upper end of each node's value if the run ends here."""
        return self._final.copy()

    def extend(self, leaves: Floats, times_ns: Integers, empty: Empty = np.empty) -> Floats:
        """Add samples.

        Args:
            leaves: (C, A, T), the program's leaves: exact values for C = 1, the ends of the interval given
                what is unknown for C = 2, those and the same ends with uncertainty for C = 4.
            times_ns: (T,), increasing and after the previous samples.
            empty: gives memory for what is returned.

        Returns:
            (N, 4, T): value, now, lower and upper of each node.

        Raises:
            ValueError: the shapes do not fit; kernels would read beyond the arrays.
        """
        wanted = len(self._program.leaves), len(times_ns)
        if leaves.shape[1:] != wanted or len(leaves) not in (1, 2, 4):
            raise ValueError(f"leaves of shape {leaves.shape}; a run of these needs (1, 2 or 4, *{wanted})")
        self.widen(len(leaves))
        if self._tile == TILE and len(times_ns) >= _MANY_TILES * LONG_TILE:
            self._lengthen_tiles()
        leaves = np.ascontiguousarray(in_channels(leaves, self._channels), np.float64)
        times_ns = np.array(times_ns, np.int64)  # writable, since kernels are compiled for that
        series = empty((len(self._program.reports), 4, len(times_ns)))
        stretch, done = _Stretch(leaves, times_ns, series), 0
        alone, was_narrow = 0, True
        may_share = has_windows(self._program) and self._is_worth_sharing(len(times_ns))
        while done < len(times_ns):
            done += self._run_tile(stretch, done, len(times_ns))
            # after a tile, the kernel is there, and what settles soon has
            if may_share and alone <= done < len(times_ns) and self._is_compiled:
                share = open_share(self._program, self._memory, len(times_ns) - done)
                if share <= NARROW or (share <= 1 and was_narrow):
                    # one position may have waited longer than usual
                    alone, was_narrow = done + _TILES_ALONE * self._tile, share <= NARROW
                    continue
                before, done = done, self._run_in_sections(stretch, done)
                if done == before:
                    done = self._run_shared(stretch, done)
                may_share = done > before and self._is_worth_sharing(len(times_ns) - done)
        return series

    @property
    def _is_compiled(self) -> bool:
        return bool(getattr(self.step, "is_compiled", False))

    def _is_worth_sharing(self, count: int) -> bool:
        return count >= self._least_shared and self._threads > 1

    def _run_tile(self, stretch: _Stretch, begin: int, end: int) -> int:
        """Run the first samples of a stretch's number begin … end - 1; return how many."""
        count = self.make_room(min(self._tile, end - begin))
        self._run(stretch, begin, count)
        return count

    def _run(self, stretch: _Stretch, begin: int, count: int) -> None:
        leaves, times_ns, series = stretch
        arrays = leaves, *leaves.shape[:2], times_ns, series, len(times_ns)
        self._called(self._table_at, *arrays, begin, count)

    def _run_in_sections(self, stretch: _Stretch, begin: int) -> int:
        """Run samples of a stretch from `begin` on in several sections at once (see `shares`).

        All begin with copies of the state, which stays as it is until they are done.

        Returns:
            How many samples of the stretch are done: as before, if they cannot be run so.
        """
        sections = sections_of(self._program, self._memory)
        if sections is None:
            return begin
        end = min(len(stretch.times_ns), begin + _MOST_IN_SECTIONS)
        most = min(self._threads, 1 + _LATER_SECTIONS * (end - begin) // self._least_shared)
        starts = starts_of(sections, stretch.times_ns, begin, end, most)
        if not starts:
            return begin
        # twice what is looked at, so that samples are seldom moved to the front
        room = 2 * max(own - seen for seen, own in starts) + self._tile
        first, late_runs = self._share(self._program, room), dict[int, OnlineRun]()
        which = numbers_of(sections.late)
        of_none = stretch._replace(series=np.empty((0, 4, len(stretch.times_ns))))

        def run_late(start: SectionStart, at: int, after: int) -> Floats:
            if at == start.own:
                late_runs[at] = self._late_run(sections.late, of_none, begin, start, room)
            return late_runs[start.own]._run_ahead(of_none, which, at, after)

        ends = [start.own for start in starts[1:]] + [end]
        ahead = [
            RunAhead(partial(run_late, start), self._pieces(start.own, after))
            for start, after in zip(starts, ends, strict=True)
        ]
        try:
            for each in ahead:
                each.begin()
            done = begin
            while done < starts[0].own:
                done += first._run_tile(stretch, done, starts[0].own)
            memory = late = first._memory
            for start, after, pieces in zip(starts, ends, ahead, strict=True):
                if closed_up_to(sections.late, late) < len(self) + start.seen - begin:
                    break  # as samples stand unevenly
                if start is starts[0]:
                    first._go_on_with(sections.early)
                tables = late.tables.copy()
                for at, numbers in pieces:
                    bound_late(sections.late, tables, self._channels, which, numbers)
                    first._run_behind(stretch, which, numbers, at)
                late, done = late_runs[start.own]._memory, after
                bound_memory(sections.late, late, tables, self._channels)
        finally:
            RunAhead.stop(ahead)
        if done > starts[0].own:
            memory = joined_memory((sections.early, sections.late), (first._memory, late))
        else:
            know_no_columns(memory)
        self._take(memory, first._final, self._tile)
        return done

    def _late_run(
        self, program: Program, stretch: _Stretch, begin: int, start: SectionStart, room: int
    ) -> OnlineRun:
        """Return a run of a later section, up to its own samples.

        Args:
            program: of later sections.
            begin: the first sample of the first section.
            room: for so many recent samples, at least.
        """
        # of its own, since the other sections that run must not find the parts set aside
        run = self._share(replace(program, parts=program.parts.copy()), room)
        begin_late(program, run._memory, self._channels, len(self) + start.seen - begin)
        run._pass_over(stretch, begin, start.own)
        return run

    def _pieces(self, begin: int, end: int) -> list[tuple[int, int]]:
        """Return what is handed from one run to another at a time, of samples `begin` to before `end`."""
        length = _TILES_AT_ONCE * self._tile
        return [(at, min(at + length, end)) for at in range(begin, end, length)]

    def _pass_over(self, stretch: _Stretch, begin: int, end: int) -> None:
        """Take in samples number begin … end - 1 of a stretch without running parts with windows."""
        own = self._tables.parts[:, codes.PART_NUMBERS].copy()
        while begin < end:
            count = self.make_room(min(self._tile, end - begin))
            self._tables.parts[:, codes.PART_NUMBERS] = 0
            self._run(stretch, begin, count)
            self._tables.parts[:, codes.PART_NUMBERS] = own
            begin += count

    def _run_shared(self, stretch: _Stretch, begin: int) -> int:
        """Run the samples of a stretch from `begin` on by two runs at once (see `shares`).

        They begin with copies of the state, which stays as it is until both are done.

        Returns:
            How many samples of the stretch are done: as before, if the work cannot be shared.
        """
        programs = shared_programs(self._program, self._memory, self._channels)
        if programs is None:
            return begin
        first, second = map(self._share, programs)
        which, end = numbers_of(second._program), len(stretch.times_ns)
        of_none = stretch._replace(series=np.empty((0, 4, end)))
        ahead = RunAhead(partial(second._run_ahead, of_none, which), self._pieces(begin, end))
        try:
            ahead.begin()
            for at, numbers in ahead:
                first._run_behind(stretch, which, numbers, at)
        finally:
            RunAhead.stop([ahead])
        self._take(joined_memory(programs, (first._memory, second._memory)), first._final, self._tile)
        return end

    def _share(self, program: Program, room: int = 0) -> OnlineRun:
        """Return a run that goes on from here, of the same program but for what it computes.

        Args:
            room: for so many recent samples, at least.
        """
        share = copy(self)
        share._called = releasing(self.step)
        share._memory = copied(self._memory)
        share._go_on_with(program, room)
        return share

    def _go_on_with(self, program: Program, room: int = 0) -> None:
        """Compute from here on what another program does, of the same nodes."""
        self._program, self._tables = program, Tables.of(program)
        self._final = np.zeros((len(program.reports), 2))
        self._widen_room(room, self._tile)

    def _run_ahead(self, stretch: _Stretch, which: tuple[Integers, Integers], begin: int, end: int) -> Floats:
        """Run samples number begin … end - 1 of a stretch; return these numbers of its parts, (K, count)."""
        numbers, done = np.empty((len(which[0]), end - begin)), 0
        while done < end - begin:
            count = self._run_tile(stretch, begin + done, end)
            numbers[:, done : done + count] = self._scratch.parts[*which, :count]
            done += count
        return numbers

    def _run_behind(
        self, stretch: _Stretch, which: tuple[Integers, Integers], numbers: Floats, begin: int
    ) -> None:
        """Run samples of a stretch from `begin` on, given these numbers of its parts, (K, count)."""
        done = 0
        while done < numbers.shape[1]:
            count = self.make_room(min(self._tile, numbers.shape[1] - done))
            self._scratch.parts[*which, :count] = numbers[:, done : done + count]
            self._run(stretch, begin + done, count)
            done += count

    def widen(self, channels: int) -> None:
        """Have at least so many channels."""
        if channels > self._channels:
            widen(self._memory, self._channels)
            self._channels = channels

    def _lengthen_tiles(self) -> None:
        """Run more samples together from now on: with many, the calls cost more than what the cache saves."""
        self._widen_room((2 if self._program.keeps_history else 1) * LONG_TILE, LONG_TILE)

    def _widen_room(self, least: int, tile: int) -> None:
        """Have room for so many recent samples, and run so many together: columns are computed again."""
        memory, room = self._memory, len(self._memory.stamps)
        while room < least:
            room *= 2
        if room > len(memory.stamps):
            memory = with_room(memory, room, self._channels, self._program.signals)
        self._take(memory, self._final, tile)

    def _take(self, memory: Memory, final: Floats, tile: int) -> None:
        """Go on with another memory, and other tiles, and the room to work in that these need."""
        scratch = scratch_for(self._program, len(memory.stamps), tile)
        arrays = RunArrays(self._tables, memory, scratch, final)
        table = table_of(arrays)
        at = table.ctypes.data
        # together, so that an interruption comes before all of these or after
        self._memory, self._scratch, self._final, self._tile = memory, scratch, final, tile
        self._arrays, self._table, self._table_at = arrays, table, at

    def make_room(self, wanted: int) -> int:
        """Make room for at least one of the wanted samples; return for how many."""
        room, clock = len(self._memory.stamps), self._memory.clock
        if not self._program.keeps_history:
            return min(wanted, room)
        position, offset = int(clock[POSITION]), int(clock[OFFSET])
        used = position - offset
        if used + wanted > room:
            # given addresses, a kernel does not see how much there is to move, and is interpreted long
            drop = cast(Any, forget).compiled() if self._is_compiled else forget
            if drop(self._table_at, self._channels):
                offset = int(clock[OFFSET])
            elif used == room:
                self._widen_room(2 * room, self._tile)
        return min(wanted, len(self._memory.stamps) - (position - offset))
