"""One program on one stream of samples: the compiled step that monitors and replays share.

Samples are run in tiles: first the signals of a tile (subformulas without future operators, final at each
sample), then each part, then the tree as the user wrote it. A tile of one sample and a tile of many give the
same bits, because the only arithmetic is minima, maxima and negation.

Each node has the numbers listed at `state.NUMBERS`, in as many channels as needed so far (see `codes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.compiled import elementwise, inlined, kernel, merged, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.online import codes
from spatial_replay.monitor.online.codes import in_channels
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.signals import step_signals
from spatial_replay.monitor.online.state import (
    KEEPS,
    NUMBERS,
    OFFSET,
    POSITION,
    START_NS,
    TILE,
    Memory,
    Scratch,
    doubled,
    first_memory,
    forget,
    scratch_for,
    widen,
)
from spatial_replay.monitor.online.tables import step_tables
from spatial_replay.monitor.online.windows import kept_from, step_windows

AnyArray: TypeAlias = NDArray[Any]


@inlined
def _combine_low(code: int, low: float, high: float, other_low: float, other_high: float) -> float:
    """Return the lower end of a Boolean operator over two intervals; the upper end is its mirror image."""
    if code == codes.REPORT_AND:
        return min(low, other_low)
    if code == codes.REPORT_OR:
        return max(low, other_low)
    if code == codes.REPORT_XOR:
        return max(min(low, -other_high), min(-high, other_low))
    if code == codes.REPORT_IMPLIES:
        return max(-high, other_low)
    return min(max(-high, other_low), max(-other_high, low))


@merged
def _combine(code: int, into: Floats, other: Floats, count: int) -> None:
    for pair in range(0, NUMBERS, 2):
        low, high, other_low, other_high = into[pair], into[pair + 1], other[pair], other[pair + 1]
        if code == codes.REPORT_AND:
            for k in range(count):
                low[k], high[k] = min(low[k], other_low[k]), min(high[k], other_high[k])
        elif code == codes.REPORT_OR:
            for k in range(count):
                low[k], high[k] = max(low[k], other_low[k]), max(high[k], other_high[k])
        else:
            for k in range(count):
                low[k], high[k] = (
                    _combine_low(code, low[k], high[k], other_low[k], other_high[k]),
                    _combine_low(code, high[k], low[k], other_high[k], other_low[k]),
                )


@piece
def _copy(source: Floats, target: Floats) -> None:
    """Copy one row of numbers to the beginning of another."""
    target[: len(source)] = source


@merged
def _copy_numbers(source: Floats, target: Floats, count: int) -> None:
    """Copy the numbers of one node, (NUMBERS, count)."""
    for number in range(NUMBERS):
        if count == 1:  # a slice costs more than its only number
            target[number, 0] = source[number, 0]
        else:
            _copy(source[number, :count], target[number])


@merged
def _set_now(rule: int, into: Floats, first: Floats, last: Floats, count: int) -> None:
    """Compute what a part is now, from what its first and its last operand are."""
    for number in (2, 3):
        for k in range(count):
            if rule == codes.NOW_LAST_OPERAND:
                into[number, k] = last[number, k]
            elif rule == codes.NOW_EITHER:
                into[number, k] = max(first[number, k], last[number, k])
            elif rule == codes.NOW_TRUE:
                into[number, k] = np.inf
            elif rule == codes.NOW_FALSE:
                into[number, k] = -np.inf


@merged
def _write_series(numbers: Floats, t: int, count: int, series: Floats) -> None:
    """Write value, now, lower and upper of every node; NaN where the ends of value or now differ.

    Adding zero turns -0.0 into 0.0, so that equal numbers are equal bits.
    """
    for n in range(numbers.shape[0]):
        for which in range(2):
            low, high = numbers[n, 2 * which], numbers[n, 2 * which + 1]
            for k in range(count):
                series[n, which, t + k] = low[k] + 0.0 if low[k] == high[k] else np.nan
        for which in range(2):
            end = numbers[n, 4 + which]
            for k in range(count):
                series[n, 2 + which, t + k] = end[k] + 0.0


@merged
def report(
    reports: Integers, operands: Integers, memory: Memory, scratch: Scratch, channels: int, begin: int,
    count: int, t: int, series: Floats, final: Floats,
) -> None:  # fmt: skip
    """Compute the numbers of every node over `count` samples, operands first.

    Args:
        begin: where these samples stand in the history.
        t: where they go in `series`, (N, 4, T): value, now, lower, upper.
        final: (N, 2), receives the ends of each node's value if the run ends with the last of them.
    """
    nominal_high = 1 if channels > 1 else 0
    wide_low = 2 if channels > 2 else 0
    wide_high = wide_low + nominal_high
    numbers = scratch.nodes
    for n in range(reports.shape[0] - 1, -1, -1):
        code, index, rule = (
            reports[n, codes.REPORT_CODE],
            reports[n, codes.REPORT_INDEX],
            reports[n, codes.REPORT_RULE],
        )
        start, stop = reports[n, codes.REPORT_FIRST], reports[n, codes.REPORT_END]
        rows = numbers[n]
        if code == codes.REPORT_SIGNAL:  # settled by the first sample
            if count == 1:
                rows[2, 0] = memory.history[0, index, begin]
                rows[3, 0] = memory.history[nominal_high, index, begin]
            else:
                _copy(memory.history[0, index, begin : begin + count], rows[2])
                _copy(memory.history[nominal_high, index, begin : begin + count], rows[3])
            for k in range(count):
                rows[0, k], rows[1, k] = memory.firsts[0, index], memory.firsts[nominal_high, index]
                rows[4, k], rows[5, k] = memory.firsts[wide_low, index], memory.firsts[wide_high, index]
                rows[6, k], rows[7, k] = rows[4, k], rows[5, k]
        elif code == codes.REPORT_PART:
            _copy_numbers(scratch.parts[index], rows, count)
            _set_now(rule, rows, numbers[operands[start]], numbers[operands[stop - 1]], count)
        elif code == codes.REPORT_NOT:
            child = numbers[operands[start]]
            for pair in range(0, NUMBERS, 2):
                for k in range(count):
                    rows[pair, k], rows[pair + 1, k] = -child[pair + 1, k], -child[pair, k]
        else:
            _copy_numbers(numbers[operands[start]], rows, count)
            for each in range(start + 1, stop):
                _combine(code, rows, numbers[operands[each]], count)
    _write_series(numbers, t, count, series)
    for n in range(reports.shape[0]):
        final[n, 0], final[n, 1] = numbers[n, 6, count - 1] + 0.0, numbers[n, 7, count - 1] + 0.0


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
    series: Floats, final: Floats,
) -> None:  # fmt: skip
    """Run the samples t … t + count - 1 of `leaves` through a program without windows under its parts.

    Args:
        leaves: (C, A, T), for as many channels as the run has.
        series: (N, 4, T), receives value, now, lower and upper.
        final: (N, 2), receives the ends of each node's value if the run ends with the last of them.
    """  # fmt: skip
    channels, position, begin = leaves.shape[0], memory.clock[POSITION], _begin(memory, times_ns, t, count)
    step_signals(tables.signals, leaves, t, count, position, position - begin, memory)
    step_tables(
        tables.nodes, tables.parts, memory, scratch, channels, position, memory.clock[START_NS], begin, count
    )
    report(tables.reports, tables.operands, memory, scratch, channels, begin, count, t, series, final)
    memory.clock[POSITION] = position + count


@kernel
def step_with_windows(
    tables: Tables, memory: Memory, scratch: Scratch, leaves: Floats, times_ns: Integers, t: int, count: int,
    series: Floats, final: Floats,
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
                tables.nodes, part, memory, scratch, channels, position, offset, count, scratch.parts[p]
            )
    report(tables.reports, tables.operands, memory, scratch, channels, begin, count, t, series, final)
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
        return bool((self._program.parts[:, codes.PART_KIND] == codes.WINDOWED).any())

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
        leaves = np.ascontiguousarray(in_channels(leaves, self._channels))
        times_ns = np.array(times_ns, np.int64)  # writable, since kernels are compiled for that
        series = np.empty((len(self._program.reports), 4, len(times_ns)))
        done = 0
        while done < len(times_ns):
            count = self.make_room(min(self._tile, len(times_ns) - done))
            self._take_in(
                self._tables, self._memory, self._scratch, leaves, times_ns, done, count, series, self._final
            )
            done += count
        return series

    def widen(self, channels: int) -> None:
        """Have at least so many channels."""
        if channels > self._channels:
            widen(self._memory, self._channels)
            self._channels = channels

    def make_room(self, wanted: int) -> int:
        """Make room for at least one of the wanted samples; return for how many."""
        room, clock = len(self._memory.stamps), self._memory.clock
        if not self._program.keeps_history:
            return min(wanted, room)
        position, offset = int(clock[POSITION]), int(clock[OFFSET])
        used = position - offset
        if used + wanted > room:
            signals, nodes, parts = self._program.signals, self._program.nodes, self._program.parts
            keep = kept_from(signals, nodes, parts, self._memory, self._scratch, offset, position - 1)
            if 2 * (keep - offset) >= room:
                forget(self._memory, keep - offset, used, self._channels)
                clock[OFFSET] = offset = keep
            elif used == room:
                self._memory = doubled(self._memory, self._channels)
                self._scratch = scratch_for(self._program, 2 * room, self._tile)
        return min(wanted, len(self._memory.stamps) - (position - offset))
