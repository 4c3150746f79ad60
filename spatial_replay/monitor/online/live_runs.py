"""Runs of some formulas that take in one sample by one call of one kernel, from its objects to all numbers.

A call costs something for each array that it is given, more than some samples cost, so it is given the
address of a table that says where all arrays lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from spatial_replay.compiled import apart, by_address, floats_at, inlined, integers_at
from spatial_replay.geometry.arrays import Floats, Integers, starts_from_counts
from spatial_replay.monitor.atoms.live_kernel import MOST_CHANNELS, measure_sample
from spatial_replay.monitor.atoms.plan_arrays import PlacedPlan
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.run_arrays import arrays_at
from spatial_replay.monitor.online.state import KEEPS, OFFSET, POSITION
from spatial_replay.monitor.online.step import OnlineRun, begin_step, end_step, step_with_windows
from spatial_replay.monitor.online.windows import forget, run_windows

ROOM: Final = 64
"""Recent samples a run has room for at first: few, so that they stay in the processor's cache."""

_NO_ROOM: Final = -1
_DOUBLE: Final = np.dtype(np.float64)

# what a kernel is given: the addresses of the plan's table, of the leaves of a sample, and of the lines on
# runs; how many leaves, runs and channels there are; the time of the sample
_PLAN, _LEAVES, _RUNS, _LEAF_COUNT, _RUN_COUNT, _CHANNELS, _TIME = range(7)
_GIVEN: Final = 7
# the line on a run: the addresses of the table of its arrays, of its leaves and of the numbers of its nodes
_TABLE, _LEAVES_AT, _SERIES_AT = range(3)
_OF_RUN: Final = 3


@inlined
def _measured(given: Integers, sample_at: int, time_ns: int) -> int:
    """Measure a sample, for all runs, and have its leaves in as many channels as these have.

    Returns:
        0; else, how many channels are needed, or `_NO_ROOM` if a run has no room for a sample.
    """
    found, channels = measure_sample(given[_PLAN], sample_at, given[_LEAVES]), given[_CHANNELS]
    if found > channels:
        return found
    leaves = floats_at(given[_LEAVES], (channels, given[_LEAF_COUNT]))
    for channel in range(found, channels):  # see `in_channels`
        for k in range(given[_LEAF_COUNT]):
            leaves[channel, k] = leaves[channel & (found - 1), k]
    runs = integers_at(given[_RUNS], (given[_RUN_COUNT], _OF_RUN))
    for r in range(len(runs)):
        memory = arrays_at(runs[r, _TABLE]).memory
        is_full = memory.clock[POSITION] - memory.clock[OFFSET] >= len(memory.stamps)
        if memory.clock[KEEPS] and is_full and not forget(runs[r, _TABLE], channels):
            return _NO_ROOM
    given[_TIME] = time_ns
    return 0


@inlined
def _begin(given_at: int, run: Integers) -> None:
    given = integers_at(given_at, _GIVEN)
    times_at = given_at + 8 * _TIME
    begin_step(run[_TABLE], run[_LEAVES_AT], given[_CHANNELS], given[_LEAF_COUNT], times_at, 1, 0, 1)


@apart
def _take_in(given_at: int, sample_at: int, time_ns: int) -> int:
    """Add a sample to all runs, whose programs have no windows under their parts.

    Args:
        sample_at: address of the numbers for the sample (see `measure_sample`).

    Returns:
        0; or, if nothing was added, how many channels are needed, or `_NO_ROOM`.
    """
    given = integers_at(given_at, _GIVEN)
    wanted = _measured(given, sample_at, time_ns)
    for r in range(given[_RUN_COUNT] if wanted == 0 else 0):
        run = integers_at(given[_RUNS] + r * _OF_RUN * 8, _OF_RUN)
        _begin(given_at, run)
        end_step(run[_TABLE], given[_CHANNELS], run[_SERIES_AT], 1, 0, 1)
    return wanted


@apart
def _take_in_with_windows(given_at: int, sample_at: int, time_ns: int) -> int:
    """`_take_in` for any programs."""
    given = integers_at(given_at, _GIVEN)
    wanted = _measured(given, sample_at, time_ns)
    for r in range(given[_RUN_COUNT] if wanted == 0 else 0):
        run = integers_at(given[_RUNS] + r * _OF_RUN * 8, _OF_RUN)
        _begin(given_at, run)
        run_windows(run[_TABLE], given[_CHANNELS], 1)
        end_step(run[_TABLE], given[_CHANNELS], run[_SERIES_AT], 1, 0, 1)
    return wanted


class LiveRuns:
    """The runs of some formulas over one stream, sample by sample."""

    def __init__(self, programs: Sequence[Program]) -> None:
        """Start before the first sample."""
        self._runs = [OnlineRun(program, room=ROOM, tile=1) for program in programs]
        self._channels = 1
        has_windows = any(run.step is step_with_windows for run in self._runs)
        self._take_in = by_address(_take_in_with_windows if has_windows else _take_in)
        leaves = starts_from_counts([len(program.leaves) for program in programs])
        nodes = starts_from_counts([len(program.reports) for program in programs])
        self._plan: PlacedPlan | None = None
        self._leaves = np.empty((MOST_CHANNELS, int(leaves[-1])))
        self._shape = int(nodes[-1]), 4
        self._series = np.empty(self._shape)
        self._of_runs = np.zeros((len(programs), _OF_RUN), np.int64)
        self._of_runs[:, _LEAVES_AT] = self._leaves.ctypes.data + 8 * leaves[:-1]
        self._of_runs[:, _SERIES_AT] = self._series.ctypes.data + 4 * 8 * nodes[:-1]
        self._given = np.zeros(_GIVEN, np.int64)
        self._given_at = self._given.ctypes.data
        self._given[_LEAVES], self._given[_LEAF_COUNT] = self._leaves.ctypes.data, leaves[-1]
        self._given[_RUNS], self._given[_RUN_COUNT] = self._of_runs.ctypes.data, len(programs)
        self._find_arrays()

    @property
    def finals(self) -> list[Floats | None]:
        """For each formula (N, 2), lower and upper end of each node's value if the log ends here, or None
        before the first sample."""
        return [run.final if len(run) else None for run in self._runs]

    def extend(self, plan: PlacedPlan, sample: bytes, time_ns: int) -> Floats:
        """Add a sample, as the bytes of what `measure_sample` takes.

        Returns:
            (N, 4), read-only: value, now, lower and upper of the nodes of all formulas, one formula after the
            other.
        """
        if plan is not self._plan:
            self._plan = plan
            self._given[_PLAN] = plan.table.ctypes.data
        while wanted := self._take_in(self._given_at, sample, time_ns):
            for run in self._runs:
                if wanted == _NO_ROOM:
                    run.make_room(1)
                else:
                    run.widen(wanted)
            self._channels = max(self._channels, wanted)
            self._find_arrays()
        # a view of bytes cannot be written to
        return np.ndarray(self._shape, _DOUBLE, self._series.tobytes())

    def _find_arrays(self) -> None:
        """Enter where the arrays of all runs are, and how many channels they have."""
        self._of_runs[:, _TABLE] = [run.table_at for run in self._runs]
        self._given[_CHANNELS] = self._channels
