"""One program on one stream of samples: the compiled step that a monitor and a replay share.

Samples are taken in by tiles: first the signals of a tile, then each part, then the tree. A tile of one
sample and a tile of many give the same bits, because the only arithmetic is minima, maxima and negation.

Numbers are kept in as many channels as are needed so far (see `channels`).
"""

from __future__ import annotations

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.channels import in_channels
from spatial_replay.monitor.codes import PART_IS_FLAT
from spatial_replay.monitor.memory import TILE, doubled, first_memory, forget, scratch_for, widen
from spatial_replay.monitor.program import Program
from spatial_replay.monitor.step import Tables, step, step_with_windows
from spatial_replay.monitor.windows import kept_from


class Run:
    """The state that a compiled formula carries from sample to sample.

    Its size depends on the formula and on how many samples its windows span, never on how long the stream
    is. It is the one place that changes while a monitor or a replay goes on.
    """

    def __init__(self, program: Program, *, room: int = 2 * TILE, tile: int = TILE) -> None:
        """Start before the first sample.

        Args:
            room: for how many recent samples there is room at first (it doubles when needed).
            tile: how many samples are taken in together, at most. What comes one by one is faster with 1,
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
        self._take_in = step if program.parts[:, PART_IS_FLAT].all() else step_with_windows
        self._channels = 1
        self._position = 0
        self._offset = 0
        self._start_ns = 0

    def __len__(self) -> int:
        """How many samples were taken in."""
        return self._position

    @property
    def final(self) -> Floats:
        """(N, 2): lower and upper end of each node's value if the run ends here."""
        return self._final.copy()

    def extend(self, leaves: Floats, times_ns: Integers) -> Floats:
        """Take in more samples.

        Args:
            leaves: (C, A, T), the program's leaves: with C = 1 exact values, with C = 2 the ends of the
                interval that what is unknown leaves open, with C = 4 those and the same ends with
                uncertainty.
            times_ns: (T,), increasing, also beyond the samples before.

        Returns:
            (N, 4, T): value, now, lower and upper of each node.
        """
        if len(leaves) > self._channels:
            widen(self._memory, self._channels)
            self._channels = len(leaves)
        leaves = np.ascontiguousarray(in_channels(leaves, self._channels))
        times_ns = np.array(times_ns, np.int64)  # writable, since kernels are compiled for that
        series = np.empty((len(self._program.reports), 4, len(times_ns)))
        done = 0
        while done < len(times_ns):
            count = self._make_room(min(self._tile, len(times_ns) - done))
            self._step(leaves, times_ns, done, count, series)
            done += count
        return series

    def _step(self, leaves: Floats, times_ns: Integers, t: int, count: int, series: Floats) -> None:
        """Take in the samples t up to t + count, for which there is room."""
        if self._position == 0:
            self._start_ns = int(times_ns[t])
        self._take_in(
            self._tables, self._memory, self._scratch, leaves, times_ns, self._start_ns,
            self._position, self._offset, t, count, series, self._final,
        )  # fmt: skip
        self._position += count

    def _make_room(self, wanted: int) -> int:
        """How many of the wanted samples there is room for, at least one."""
        room = len(self._memory.stamps)
        if not self._program.keeps_history:
            self._offset = self._position
        used = self._position - self._offset
        if used + wanted > room:
            signals, nodes, parts = self._program.signals, self._program.nodes, self._program.parts
            last = self._position - 1
            keep = kept_from(signals, nodes, parts, self._memory, self._scratch, self._offset, last)
            if 2 * (keep - self._offset) >= room:
                forget(self._memory, keep - self._offset, used)
                self._offset = keep
            elif used == room:
                self._memory = doubled(self._memory)
                self._scratch = scratch_for(self._program, 2 * room, self._tile)
        return min(wanted, len(self._memory.stamps) - (self._position - self._offset))
