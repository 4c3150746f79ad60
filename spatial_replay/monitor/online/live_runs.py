"""Runs of some formulas that take in one sample by one call of one kernel, from its objects to all numbers.

A call costs something for each array that it is given, more than some samples cost, so all arrays of all runs
lie in two buffers, of floats and of integers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain, pairwise
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.compiled import direct, kernel, merged
from spatial_replay.geometry.arrays import Floats, Integers, starts_from_counts
from spatial_replay.monitor.atoms.live_kernel import PackedPlan, leaves_of_plan
from spatial_replay.monitor.online.node_numbers import Results
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.state import KEEPS, OFFSET, POSITION, Memory, Scratch
from spatial_replay.monitor.online.step import AnyArray, OnlineRun, Tables, step, step_with_windows

ROOM: Final = 64
"""Recent samples a run has room for at first: few, so that they stay in the processor's cache."""

_NO_ROOM: Final = -1
_MOST_DIMENSIONS: Final = 4

# where each array comes in `OnlineRun.arrays`
_TABLES_AT: Final = Tables(*range(len(Tables._fields)))
_MEMORY_AT: Final = Memory(*range(len(_TABLES_AT), len(_TABLES_AT) + len(Memory._fields)))
_SCRATCH_AT: Final = Scratch(*range(_MEMORY_AT.clock + 1, _MEMORY_AT.clock + 1 + len(Scratch._fields)))
_FINAL: Final = _SCRATCH_AT.nodes + 1
_ARRAYS: Final = _FINAL + 1


class Buffers(NamedTuple):
    """The arrays of runs, one after the other.

    Attributes:
        numbers, whole: the arrays of floats and of integers. The latter begin with how many runs there are,
            where the leaves of each begin, and the last end, the same of nodes, and a `layout`.
    """

    numbers: Floats
    whole: Integers


class _Layout(NamedTuple):
    """What buffers hold.

    Attributes:
        arrays: (R, ARRAYS, 1 + _MOST_DIMENSIONS), for each array of each run where it begins in its buffer,
            and its shape, 0 for dimensions that it does not have.
        leaves, nodes: (R + 1,), where the leaves and the nodes of each run begin, and the last end.
    """

    arrays: Integers
    leaves: Integers
    nodes: Integers


@merged
def _array_1(buffer, layout):  # type: ignore[no-untyped-def]
    start = layout[0]
    return buffer[start : start + layout[1]]


@merged
def _array_2(buffer, layout):  # type: ignore[no-untyped-def]
    start, size = layout[0], layout[1] * layout[2]
    return buffer[start : start + size].reshape((layout[1], layout[2]))


@merged
def _array_3(buffer, layout):  # type: ignore[no-untyped-def]
    start, size = layout[0], layout[1] * layout[2] * layout[3]
    return buffer[start : start + size].reshape((layout[1], layout[2], layout[3]))


@merged
def _array_4(buffer, layout):  # type: ignore[no-untyped-def]
    start, size = layout[0], layout[1] * layout[2] * layout[3] * layout[4]
    return buffer[start : start + size].reshape((layout[1], layout[2], layout[3], layout[4]))


@merged
def _layout_of(whole: Integers) -> _Layout:
    runs = whole[0]
    leaves = 1 + runs + 1
    nodes = leaves + runs + 1
    end = nodes + runs * _ARRAYS * (1 + _MOST_DIMENSIONS)
    arrays = whole[nodes:end].reshape((runs, _ARRAYS, 1 + _MOST_DIMENSIONS))
    return _Layout(arrays, whole[1:leaves], whole[leaves:nodes])


@merged
def _run_at(numbers: Floats, whole: Integers, at: Integers) -> tuple[Tables, Memory, Scratch, Floats]:
    """Return a run's arrays, in the order of `OnlineRun.arrays`."""
    tables = Tables(
        signals=_array_2(whole, at[_TABLES_AT.signals]),
        nodes=_array_2(whole, at[_TABLES_AT.nodes]),
        parts=_array_2(whole, at[_TABLES_AT.parts]),
        reports=_array_2(whole, at[_TABLES_AT.reports]),
        operands=_array_1(whole, at[_TABLES_AT.operands]),
    )
    memory = Memory(
        history=_array_3(numbers, at[_MEMORY_AT.history]),
        stamps=_array_1(whole, at[_MEMORY_AT.stamps]),
        running=_array_2(numbers, at[_MEMORY_AT.running]),
        firsts=_array_2(numbers, at[_MEMORY_AT.firsts]),
        wedges=_array_3(whole, at[_MEMORY_AT.wedges]),
        wedge_ends=_array_3(whole, at[_MEMORY_AT.wedge_ends]),
        wedge_next=_array_1(whole, at[_MEMORY_AT.wedge_next]),
        heights=_array_4(numbers, at[_MEMORY_AT.heights]),
        tables=_array_2(numbers, at[_MEMORY_AT.tables]),
        cells=_array_1(whole, at[_MEMORY_AT.cells]),
        columns=_array_3(numbers, at[_MEMORY_AT.columns]),
        known=_array_2(whole, at[_MEMORY_AT.known]),
        lows=_array_1(whole, at[_MEMORY_AT.lows]),
        window_ends=_array_3(whole, at[_MEMORY_AT.window_ends]),
        window_next=_array_2(whole, at[_MEMORY_AT.window_next]),
        clock=_array_1(whole, at[_MEMORY_AT.clock]),
    )
    scratch = Scratch(
        columns=_array_2(numbers, at[_SCRATCH_AT.columns]),
        low=_array_1(whole, at[_SCRATCH_AT.low]),
        high=_array_1(whole, at[_SCRATCH_AT.high]),
        plain=_array_1(whole, at[_SCRATCH_AT.plain]),
        changed=_array_1(whole, at[_SCRATCH_AT.changed]),
        values=_array_1(numbers, at[_SCRATCH_AT.values]),
        point=_array_1(numbers, at[_SCRATCH_AT.point]),
        order=_array_1(whole, at[_SCRATCH_AT.order]),
        starts=_array_1(numbers, at[_SCRATCH_AT.starts]),
        fresh=_array_1(numbers, at[_SCRATCH_AT.fresh]),
        extrema=_array_2(numbers, at[_SCRATCH_AT.extrema]),
        ends=_array_2(whole, at[_SCRATCH_AT.ends]),
        series=_array_2(numbers, at[_SCRATCH_AT.series]),
        parts=_array_3(numbers, at[_SCRATCH_AT.parts]),
        nodes=_array_3(numbers, at[_SCRATCH_AT.nodes]),
    )
    return tables, memory, scratch, _array_2(numbers, at[_FINAL])


@merged
def _wanted(whole: Integers, layout: Integers, leaves: Floats, channels: int) -> int:
    """Return how many channels runs lack, `_NO_ROOM` if one has no room for a sample, 0 if all is well."""
    if leaves.shape[0] > channels:
        return int(leaves.shape[0])
    for r in range(layout.shape[0]):
        clock = _array_1(whole, layout[r, _MEMORY_AT.clock])
        if clock[KEEPS] and clock[POSITION] - clock[OFFSET] >= layout[r, _MEMORY_AT.stamps, 1]:
            return _NO_ROOM
    return 0


@merged
def _own_leaves(leaves: Floats, begin: int, end: int, channels: int) -> Floats:
    """Return some leaves in so many channels (see `in_channels`)."""
    own = np.empty((channels, end - begin, 1))
    for channel in range(channels):
        for k in range(end - begin):
            own[channel, k, 0] = leaves[channel & (leaves.shape[0] - 1), begin + k, 0]
    return own


@kernel
def _take_in(
    plan: Integers, constants: Floats, sample: Floats, numbers: Floats, whole: Integers, channels: int,
    time_ns: int, series: Floats,
) -> int:  # fmt: skip
    """Add a sample to all runs, whose programs have no windows under their parts.

    Args:
        plan, constants: a `PackedPlan`.
        sample: the numbers for it (see `leaves_of_sample`).
        numbers, whole: `Buffers`.
        channels: how many the runs have.
        series: (N, 4), receives value, now, lower and upper of each node.

    Returns:
        0; or, if nothing was added, how many channels are needed, or `_NO_ROOM`.
    """
    leaves = leaves_of_plan(PackedPlan(plan, constants), sample)
    layout, own, nodes = _layout_of(whole)
    wanted = _wanted(whole, layout, leaves, channels)
    if wanted == 0:
        times_ns = np.empty(1, np.int64)
        times_ns[0] = time_ns
        for r in range(layout.shape[0]):
            tables, memory, scratch, final = _run_at(numbers, whole, layout[r])
            of_run = series[nodes[r] : nodes[r + 1]].reshape((nodes[r + 1] - nodes[r], 4, 1))
            at = _own_leaves(leaves, own[r], own[r + 1], channels)
            step(tables, memory, scratch, at, times_ns, 0, 1, Results(of_run, final))
    return wanted


@kernel
def _take_in_with_windows(
    plan: Integers, constants: Floats, sample: Floats, numbers: Floats, whole: Integers, channels: int,
    time_ns: int, series: Floats,
) -> int:  # fmt: skip
    """`_take_in` for any programs."""
    leaves = leaves_of_plan(PackedPlan(plan, constants), sample)
    layout, own, nodes = _layout_of(whole)
    wanted = _wanted(whole, layout, leaves, channels)
    if wanted == 0:
        times_ns = np.empty(1, np.int64)
        times_ns[0] = time_ns
        for r in range(layout.shape[0]):
            tables, memory, scratch, final = _run_at(numbers, whole, layout[r])
            of_run = series[nodes[r] : nodes[r + 1]].reshape((nodes[r + 1] - nodes[r], 4, 1))
            at = _own_leaves(leaves, own[r], own[r + 1], channels)
            step_with_windows(tables, memory, scratch, at, times_ns, 0, 1, Results(of_run, final))
    return wanted


class LiveRuns:
    """The runs of some formulas over one stream, sample by sample."""

    def __init__(self, programs: Sequence[Program]) -> None:
        """Start before the first sample."""
        self._runs = [OnlineRun(program, room=ROOM, tile=1) for program in programs]
        self._channels = 1
        has_windows = any(run.has_windows for run in self._runs)
        self._take_in: Callable[..., int] = direct(_take_in_with_windows if has_windows else _take_in)
        self._leaves = starts_from_counts([len(program.leaves) for program in programs])
        self._nodes = starts_from_counts([len(program.reports) for program in programs])
        self._node_count = int(self._nodes[-1])
        self._buffers = _joined(self._runs, self._leaves, self._nodes)

    @property
    def finals(self) -> list[Floats | None]:
        """For each formula (N, 2), lower and upper end of each node's value if the log ends here, or None
        before the first sample."""
        return [run.final if len(run) else None for run in self._runs]

    def extend(self, plan: PackedPlan, sample: Floats, time_ns: int) -> Floats:
        """Add a sample, as `leaves_of_sample` takes it.

        Returns:
            (N, 4): value, now, lower and upper of the nodes of all formulas, one formula after the other.
        """
        series = np.empty((self._node_count, 4))
        while wanted := self._take_in(*plan, sample, *self._buffers, self._channels, time_ns, series):
            for run in self._runs:
                if wanted == _NO_ROOM:
                    run.make_room(1)
                else:
                    run.widen(wanted)
            self._channels = max(self._channels, wanted)
            self._join()
        return series

    def extend_with(self, leaves: Floats, time_ns: int) -> Floats:
        """Add a sample of which the leaves (C, A, 1) are known; return what `extend` does."""
        times_ns = np.array([time_ns], np.int64)
        series = [
            run.extend(leaves[:, begin:end], times_ns)[:, :, 0]
            for run, (begin, end) in zip(self._runs, pairwise(self._leaves), strict=True)
        ]
        self._channels = max(self._channels, len(leaves))
        self._join()
        return np.concatenate(series)

    def _join(self) -> None:
        """Put all arrays into two buffers, unless they are there."""
        stamps = (run.arrays[_MEMORY_AT.stamps] for run in self._runs)
        if any(each.base is not self._buffers.whole for each in stamps):
            self._buffers = _joined(self._runs, self._leaves, self._nodes)


def _joined(runs: Sequence[OnlineRun], leaves: Integers, nodes: Integers) -> Buffers:
    """Let runs go on in two new buffers."""
    arrays = [run.arrays for run in runs]
    layout = np.zeros((len(runs), _ARRAYS, 1 + _MOST_DIMENSIONS), np.int64)
    ends = {"f": 0, "i": 1 + len(leaves) + len(nodes) + layout.size}
    head = ends["i"]
    for place, array in zip(layout.reshape(-1, layout.shape[2]), chain.from_iterable(arrays), strict=True):
        place[0], place[1 : 1 + array.ndim] = ends[array.dtype.kind], array.shape
        ends[array.dtype.kind] += array.size
    numbers, whole = np.zeros(ends["f"]), np.zeros(ends["i"], np.int64)
    whole[:head] = np.concatenate([[len(runs)], leaves, nodes, layout.ravel()])
    for run, places, before in zip(runs, layout, arrays, strict=True):
        views = []
        for place, array in zip(places, before, strict=True):
            buffer: AnyArray = numbers if array.dtype.kind == "f" else whole
            view = buffer[place[0] : place[0] + array.size].reshape(array.shape)
            # room that was never used is not written to, so that it goes on to take up no memory
            bits = np.ascontiguousarray(array).view(np.int64)
            np.copyto(view.view(np.int64), bits, where=bits != 0)
            views.append(view)
        run.work_with(views)
    return Buffers(numbers, whole)
