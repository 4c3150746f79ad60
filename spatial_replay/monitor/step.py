"""A stretch of samples taken through a program in one call: signals, then parts, then the tree."""

from __future__ import annotations

from typing import NamedTuple

from spatial_replay.compiled import kernel
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.codes import PART_IS_FLAT
from spatial_replay.monitor.memory import Memory, Scratch
from spatial_replay.monitor.program import Program
from spatial_replay.monitor.reports import report
from spatial_replay.monitor.signals import step_signals
from spatial_replay.monitor.tables import step_tables
from spatial_replay.monitor.windows import step_windows


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


@kernel
def step(
    tables: Tables, memory: Memory, scratch: Scratch, leaves: Floats, times_ns: Integers, start_ns: int,
    position: int, offset: int, t: int, count: int, series: Floats, final: Floats,
) -> None:  # fmt: skip
    """Take in the samples t … t + count - 1 of `leaves`, by a program without windows under its parts.

    Args:
        leaves: (C, A, T), for as many channels as the run has.
        start_ns: time of the first sample of the run.
        position: of the first of these samples in the run; it stands at position - offset in the history.
        series: (N, 4, T), receives value, now, lower and upper.
        final: (N, 2), receives the ends of each node's value if the run ends with the last of them.
    """  # fmt: skip
    channels, begin = leaves.shape[0], position - offset
    for k in range(count):
        memory.stamps[begin + k] = times_ns[t + k]
    step_signals(tables.signals, leaves, t, count, position, offset, memory)
    step_tables(tables.nodes, tables.parts, memory, scratch, channels, position, start_ns, begin, count)
    report(tables.reports, tables.operands, memory, scratch, channels, begin, count, t, series, final)


@kernel
def step_with_windows(
    tables: Tables, memory: Memory, scratch: Scratch, leaves: Floats, times_ns: Integers, start_ns: int,
    position: int, offset: int, t: int, count: int, series: Floats, final: Floats,
) -> None:  # fmt: skip
    """`step` for any program; apart from it because it is much more to compile and to load."""
    channels, begin = leaves.shape[0], position - offset
    for k in range(count):
        memory.stamps[begin + k] = times_ns[t + k]
    step_signals(tables.signals, leaves, t, count, position, offset, memory)
    step_tables(tables.nodes, tables.parts, memory, scratch, channels, position, start_ns, begin, count)
    for p in range(len(tables.parts)):
        part = tables.parts[p]
        if not part[PART_IS_FLAT]:
            step_windows(
                tables.nodes, part, memory, scratch, channels, position, offset, count, scratch.parts[p]
            )
    report(tables.reports, tables.operands, memory, scratch, channels, begin, count, t, series, final)
