"""One program on one stream of samples: the compiled step that monitors and replays share.

Samples are run in tiles: first the signals of a tile (subformulas without future operators, final at each
sample), then each part, then the tree as the user wrote it. A tile of one sample and a tile of many give the
same bits, because the only arithmetic is minima, maxima and negation.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from spatial_replay.compiled import apart, floats_at, inlined, integers_at
from spatial_replay.geometry.arrays import Empty, Floats, Integers
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.online.node_numbers import Results, report
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.run_arrays import RunArrays, Tables, arrays_at, table_of
from spatial_replay.monitor.online.signals import step_signals
from spatial_replay.monitor.online.state import (
    KEEPS,
    OFFSET,
    POSITION,
    START_NS,
    TILE,
    Memory,
    first_memory,
    has_windows,
    scratch_for,
    widen,
    with_room,
)
from spatial_replay.monitor.online.tables import step_tables
from spatial_replay.monitor.online.windows import forget, run_windows


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
    run_windows(table_at, channels, count)
    end_step(table_at, channels, series_at, length, t, count)
    return 0


class OnlineRun:
    """The state that a compiled formula carries from sample to sample.

    Its size depends on the formula and on how many samples its windows span, not on the length of the stream.

    Attributes:
        step: the kernel that runs its samples.
    """

    def __init__(self, program: Program, *, room: int = 2 * TILE, tile: int = TILE) -> None:
        """Start before the first sample.

        Args:
            room: the number of recent samples there is room for at first (it doubles when needed).
            tile: how many samples are run together, at most. Samples that come one by one are faster with 1,
                since the numbers worked with then lie closer together.
        """
        self._program = program
        self.step = step_with_windows if has_windows(program) else step
        self._tile = tile
        if not program.keeps_history:
            room = tile
        self._tables = Tables.of(program)
        self._channels = 1
        self._take(first_memory(program, room), np.zeros((len(program.reports), 2)))

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
        leaves = np.ascontiguousarray(in_channels(leaves, self._channels), np.float64)
        times_ns = np.array(times_ns, np.int64)  # writable, since kernels are compiled for that
        length, done = len(times_ns), 0
        series = empty((len(self._program.reports), 4, length))
        while done < length:
            count = self.make_room(min(self._tile, length - done))
            shape = leaves.shape[:2]
            self.step(self._table_at, leaves, *shape, times_ns, series, length, done, count)
            done += count
        return series

    def widen(self, channels: int) -> None:
        """Have at least so many channels."""
        if channels > self._channels:
            widen(self._memory, self._channels)
            self._channels = channels

    def _take(self, memory: Memory, final: Floats) -> None:
        """Go on with another memory, and the room to work in that it needs."""
        scratch = scratch_for(self._program, len(memory.stamps), self._tile)
        arrays = RunArrays(self._tables, memory, scratch, final)
        table = table_of(arrays)
        at = table.ctypes.data
        # together, so that an interruption comes before all of these or after
        self._memory, self._final = memory, final
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
            is_compiled = getattr(self.step, "is_compiled", False)
            drop = cast(Any, forget).compiled() if is_compiled else forget
            if drop(self._table_at, self._channels):
                offset = int(clock[OFFSET])
            elif used == room:
                memory = with_room(self._memory, 2 * room, self._channels, self._program.signals)
                self._take(memory, self._final)
        return min(wanted, len(self._memory.stamps) - (position - offset))
