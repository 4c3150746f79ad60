"""All arrays of a run, for kernels that are given the address of a table that says where they lie."""

from __future__ import annotations

import ctypes
from typing import Any, Final, NamedTuple, cast

import numpy as np

from spatial_replay.compiled import floats_at, inlined_as, integers_at
from spatial_replay.geometry.arrays import PLACE, Floats, Integers, places_of, shape_2, shape_3
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.state import Memory, Scratch


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


class RunArrays(NamedTuple):
    """What a run works with; `final` is that of `Results`."""

    tables: Tables
    memory: Memory
    scratch: Scratch
    final: Floats


# where each array comes in the table
_TABLES: Final = Tables(*cast(Any, range(len(Tables._fields))))
_MEMORY: Final = Memory(*cast(Any, range(len(_TABLES), len(_TABLES) + len(Memory._fields))))
_SCRATCH: Final = Scratch(*cast(Any, range(_MEMORY[-1] + 1, _MEMORY[-1] + 1 + len(Scratch._fields))))
_FINAL: Final = len(_TABLES) + len(_MEMORY) + len(_SCRATCH)


def table_of(run: RunArrays) -> Integers:
    """Return where a run's arrays lie, for `arrays_at`; `run` has to be kept as long as it is used."""
    places = places_of([*run.tables, *run.memory, *run.scratch, run.final])
    return np.vstack((places, [[id(run)] + [0] * (PLACE - 1)]))


def _run_at(table_at: int) -> RunArrays:
    """Return the arrays of a run as they were given: making them again takes the interpreter long."""
    identity = ctypes.c_int64.from_address(int(table_at) + 8 * PLACE * (_FINAL + 1)).value
    return cast(RunArrays, ctypes.cast(identity, ctypes.py_object).value)


@inlined_as(_run_at)
def arrays_at(table_at: int) -> RunArrays:
    """Return the arrays of a run from the address of its table."""
    at = integers_at(table_at, (_FINAL + 1, PLACE))
    return RunArrays(
        Tables(
            signals=integers_at(at[_TABLES.signals, 0], shape_2(at, _TABLES.signals)),
            nodes=integers_at(at[_TABLES.nodes, 0], shape_2(at, _TABLES.nodes)),
            parts=integers_at(at[_TABLES.parts, 0], shape_2(at, _TABLES.parts)),
            reports=integers_at(at[_TABLES.reports, 0], shape_2(at, _TABLES.reports)),
            operands=integers_at(at[_TABLES.operands, 0], at[_TABLES.operands, 1]),
        ),
        Memory(
            history=floats_at(at[_MEMORY.history, 0], shape_3(at, _MEMORY.history)),
            stamps=integers_at(at[_MEMORY.stamps, 0], at[_MEMORY.stamps, 1]),
            running=floats_at(at[_MEMORY.running, 0], shape_2(at, _MEMORY.running)),
            firsts=floats_at(at[_MEMORY.firsts, 0], shape_2(at, _MEMORY.firsts)),
            wedges=integers_at(at[_MEMORY.wedges, 0], shape_3(at, _MEMORY.wedges)),
            wedge_ends=integers_at(at[_MEMORY.wedge_ends, 0], shape_3(at, _MEMORY.wedge_ends)),
            wedge_next=integers_at(at[_MEMORY.wedge_next, 0], at[_MEMORY.wedge_next, 1]),
            tables=floats_at(at[_MEMORY.tables, 0], shape_2(at, _MEMORY.tables)),
            cells=integers_at(at[_MEMORY.cells, 0], at[_MEMORY.cells, 1]),
            columns=floats_at(at[_MEMORY.columns, 0], shape_3(at, _MEMORY.columns)),
            known=integers_at(at[_MEMORY.known, 0], shape_2(at, _MEMORY.known)),
            unjoined=integers_at(at[_MEMORY.unjoined, 0], shape_2(at, _MEMORY.unjoined)),
            joined=floats_at(at[_MEMORY.joined, 0], shape_3(at, _MEMORY.joined)),
            lows=integers_at(at[_MEMORY.lows, 0], at[_MEMORY.lows, 1]),
            window_ends=integers_at(at[_MEMORY.window_ends, 0], shape_3(at, _MEMORY.window_ends)),
            window_next=integers_at(at[_MEMORY.window_next, 0], shape_2(at, _MEMORY.window_next)),
            clock=integers_at(at[_MEMORY.clock, 0], at[_MEMORY.clock, 1]),
        ),
        Scratch(
            columns=floats_at(at[_SCRATCH.columns, 0], shape_2(at, _SCRATCH.columns)),
            corners=floats_at(at[_SCRATCH.corners, 0], shape_2(at, _SCRATCH.corners)),
            low=integers_at(at[_SCRATCH.low, 0], at[_SCRATCH.low, 1]),
            high=integers_at(at[_SCRATCH.high, 0], at[_SCRATCH.high, 1]),
            plain=integers_at(at[_SCRATCH.plain, 0], at[_SCRATCH.plain, 1]),
            changed=integers_at(at[_SCRATCH.changed, 0], at[_SCRATCH.changed, 1]),
            values=floats_at(at[_SCRATCH.values, 0], at[_SCRATCH.values, 1]),
            point=floats_at(at[_SCRATCH.point, 0], at[_SCRATCH.point, 1]),
            order=integers_at(at[_SCRATCH.order, 0], at[_SCRATCH.order, 1]),
            starts=floats_at(at[_SCRATCH.starts, 0], at[_SCRATCH.starts, 1]),
            fresh=floats_at(at[_SCRATCH.fresh, 0], at[_SCRATCH.fresh, 1]),
            extrema=floats_at(at[_SCRATCH.extrema, 0], shape_2(at, _SCRATCH.extrema)),
            ends=integers_at(at[_SCRATCH.ends, 0], shape_2(at, _SCRATCH.ends)),
            series=floats_at(at[_SCRATCH.series, 0], shape_2(at, _SCRATCH.series)),
            parts=floats_at(at[_SCRATCH.parts, 0], shape_3(at, _SCRATCH.parts)),
            nodes=floats_at(at[_SCRATCH.nodes, 0], shape_3(at, _SCRATCH.nodes)),
        ),
        floats_at(at[_FINAL, 0], shape_2(at, _FINAL)),
    )
