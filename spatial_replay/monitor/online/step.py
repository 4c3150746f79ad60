"""One program on one stream of samples: the compiled step that monitors and replays share.

Samples are run in tiles: first the signals of a tile (subformulas without future operators, final at each
sample), then each part, then the tree as the user wrote it. A tile of one sample and a tile of many give the
same bits, because the only arithmetic is minima, maxima and negation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.compiled import elementwise, inlined, kernel
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.online.node_numbers import Results, report
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.signals import step_signals
from spatial_replay.monitor.online.state import (
    KEEPS,
    LONG_TILE,
    OFFSET,
    POSITION,
    START_NS,
    TILE,
    Memory,
    Scratch,
    doubled,
    first_memory,
    has_windows,
    scratch_for,
    widen,
)
from spatial_replay.monitor.online.tables import step_tables
from spatial_replay.monitor.online.windows import forget, step_windows

AnyArray: TypeAlias = NDArray[Any]


_MANY_TILES = 8
"""So many long tiles of samples that come together are worth more room to work in."""


class Tables(NamedTuple):
    """A program's tables (see `Program`)."""

    signals: Integers
    nodes: Integers
    parts: Integers
    reports: Integers
    operands: Integers

    @classmethod
    def of(cls, program: Program) -> Tables:
        return cls(program.signals, program.nodes, program.parts, program.reports, program.operands)


@elementwise
@kernel
def step(
    tables: Tables, memory: Memory, scratch: Scratch, leaves: Floats, times_ns: Integers, t: int, count: int,
    results: Results,
) -> None:  # fmt: skip
    """Run the samples t … t + count - 1 of `leaves` through a program without windows under its parts.

    Args:
        leaves: (C, A, T), for as many channels as the run has.
    """  # fmt: skip
    channels, position, begin = leaves.shape[0], memory.clock[POSITION], _begin(memory, times_ns, t, count)
    step_signals(tables.signals, leaves, t, count, position, position - begin, memory)
    step_tables(
        tables.nodes, tables.parts, memory, scratch, channels, position, memory.clock[START_NS], begin, count
    )
    report(tables.reports, tables.operands, memory, scratch, channels, begin, count, t, results)
    memory.clock[POSITION] = position + count


@kernel
def step_with_windows(
    tables: Tables, memory: Memory, scratch: Scratch, leaves: Floats, times_ns: Integers, t: int, count: int,
    results: Results,
) -> None:  # fmt: skip
    """`step` for any program; apart from it because it is much more to compile and to load."""
    channels, position, begin = leaves.shape[0], memory.clock[POSITION], _begin(memory, times_ns, t, count)
    offset = position - begin
    step_signals(tables.signals, leaves, t, count, position, offset, memory)
    step_tables(
        tables.nodes, tables.parts, memory, scratch, channels, position, memory.clock[START_NS], begin, count
    )
    for p in range(len(tables.parts)):
        part = tables.parts[p]
        if part[codes.PART_KIND] == codes.WINDOWED:
            step_windows(
                tables.nodes, part, p, memory, scratch, channels, position, offset, count, scratch.parts[p]
            )
    report(tables.reports, tables.operands, memory, scratch, channels, begin, count, t, results)
    memory.clock[POSITION] = position + count


@inlined
def _begin(memory: Memory, times_ns: Integers, t: int, count: int) -> int:
    """Enter the times of the next samples; return where they stand in the history."""
    clock = memory.clock
    if clock[POSITION] == 0:
        clock[START_NS] = times_ns[t]
    if not clock[KEEPS]:
        clock[OFFSET] = clock[POSITION]
    begin = clock[POSITION] - clock[OFFSET]
    for k in range(count):
        memory.stamps[begin + k] = times_ns[t + k]
    return int(begin)


class OnlineRun:
    """The state that a compiled formula carries from sample to sample.

    Its size depends on the formula and on how many samples its windows span, not on the length of the stream.
    """

    def __init__(self, program: Program, *, room: int = 2 * TILE, tile: int = TILE) -> None:
        """Start before the first sample.

        Args:
            room: the number of recent samples there is room for at first (it doubles when needed).
            tile: how many samples are run together, at most. Samples that come one by one are faster with 1,
                since the numbers worked with then lie closer together.
        """
        self._program = program
        self._tile = tile
        if not program.keeps_history:
            room = tile
        self._memory = first_memory(program, room)
        self._scratch = scratch_for(program, room, tile)
        self._final = np.zeros((len(program.reports), 2))
        self._tables = Tables.of(program)
        self._take_in = step_with_windows if self.has_windows else step
        self._channels = 1

    def __len__(self) -> int:
        """Return how many samples were added."""
        return int(self._memory.clock[POSITION])

    @property
    def has_windows(self) -> bool:
        """Whether `step_with_windows` runs it."""
        return has_windows(self._program)

    @property
    def arrays(self) -> list[AnyArray]:
        """All it works with: `Tables`, `Memory`, `Scratch` and `final`."""
        return [*self._tables, *self._memory, *self._scratch, self._final]

    def work_with(self, arrays: Sequence[AnyArray]) -> None:
        """Go on with copies of all `arrays`."""
        memory, scratch = len(Tables._fields), len(Tables._fields) + len(Memory._fields)
        self._tables = Tables(*arrays[:memory])
        self._memory = Memory(*arrays[memory:scratch])
        self._scratch = Scratch(*arrays[scratch:-1])
        self._final = arrays[-1]

    @property
    def final(self) -> Floats:
        """(N, 2): lower and upper end of each node's value if the run ends here."""
        return self._final.copy()

    def extend(self, leaves: Floats, times_ns: Integers) -> Floats:
        """Add samples.

        Args:
            leaves: (C, A, T), the program's leaves: exact values for C = 1, the ends of the interval given
                what is unknown for C = 2, those and the same ends with uncertainty for C = 4.
            times_ns: (T,), increasing and after the previous samples.

        Returns:
            (N, 4, T): value, now, lower and upper of each node.
        """
        self.widen(len(leaves))
        if self._tile == TILE and len(times_ns) >= _MANY_TILES * LONG_TILE:
            self._lengthen_tiles()
        leaves = np.ascontiguousarray(in_channels(leaves, self._channels))
        times_ns = np.array(times_ns, np.int64)  # writable, since kernels are compiled for that
        series = np.empty((len(self._program.reports), 4, len(times_ns)))
        done = 0
        while done < len(times_ns):
            count = self.make_room(min(self._tile, len(times_ns) - done))
            results = Results(series, self._final)
            self._take_in(self._tables, self._memory, self._scratch, leaves, times_ns, done, count, results)
            done += count
        return series

    def widen(self, channels: int) -> None:
        """Have at least so many channels."""
        if channels > self._channels:
            widen(self._memory, self._channels)
            self._channels = channels

    def _lengthen_tiles(self) -> None:
        """Run more samples together from now on: with many, the calls cost more than what the cache saves."""
        self._tile = LONG_TILE
        while len(self._memory.stamps) < (2 if self._program.keeps_history else 1) * LONG_TILE:
            self._memory = doubled(self._memory, self._channels)
        self._scratch = scratch_for(self._program, len(self._memory.stamps), self._tile)

    def make_room(self, wanted: int) -> int:
        """Make room for at least one of the wanted samples; return for how many."""
        room, clock = len(self._memory.stamps), self._memory.clock
        if not self._program.keeps_history:
            return min(wanted, room)
        position, offset = int(clock[POSITION]), int(clock[OFFSET])
        used = position - offset
        if used + wanted > room:
            signals, nodes, parts = self._program.signals, self._program.nodes, self._program.parts
            if forget(signals, nodes, parts, self._memory, self._scratch, self._channels):
                offset = int(clock[OFFSET])
            elif used == room:
                self._memory = doubled(self._memory, self._channels)
                self._scratch = scratch_for(self._program, 2 * room, self._tile)
        return min(wanted, len(self._memory.stamps) - (position - offset))
