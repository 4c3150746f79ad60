"""Runs of some formulas that take in one sample by one call of one kernel, from its objects to all numbers.

A call costs something for each array that it is given, more than some samples cost, so all arrays of all runs
lie in two buffers, of floats and of integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, pairwise
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.compiled import by_address, floats_at, integers_at, kernel, merged
from spatial_replay.geometry.arrays import Floats, Integers, starts_from_counts
from spatial_replay.monitor.atoms.live_kernel import PackedPlan, leaves_of_plan
from spatial_replay.monitor.online.node_numbers import Results
from spatial_replay.monitor.online.program import Program
from spatial_replay.monitor.online.state import KEEPS, OFFSET, POSITION, Memory, Scratch
from spatial_replay.monitor.online.step import AnyArray, OnlineRun, Tables, step, step_with_windows
from spatial_replay.monitor.online.windows import forget

ROOM: Final = 64
"""Recent samples a run has room for at first: few, so that they stay in the processor's cache."""

_NO_ROOM: Final = -1

# of a frame: a plan's arrays, those of `Buffers`, and the results, each by its address and length; how many
# channels there are, and the time of the sample
_PLAN, _CONSTANTS, _NUMBERS, _WHOLE, _SERIES, _CHANNELS, _TIME = 0, 2, 4, 6, 8, 10, 11
_FRAME: Final = 12
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
def _wanted(numbers: Floats, whole: Integers, layout: Integers, leaves: Floats, channels: int) -> int:
    """Return how many channels runs lack, `_NO_ROOM` if one has no room for a sample, 0 if all is well."""
    if leaves.shape[0] > channels:
        return int(leaves.shape[0])
    for r in range(layout.shape[0]):
        clock = _array_1(whole, layout[r, _MEMORY_AT.clock])
        if clock[KEEPS] and clock[POSITION] - clock[OFFSET] >= layout[r, _MEMORY_AT.stamps, 1]:
            tables, memory, scratch, _ = _run_at(numbers, whole, layout[r])
            if not forget(tables.signals, tables.nodes, tables.parts, memory, scratch, channels):
                return _NO_ROOM
    return 0


@merged
def _own_leaves(leaves: Floats, begin: int, end: int, channels: int) -> Floats:
    """Return some leaves in so many channels (see `in_channels`)."""
    if leaves.shape[0] == channels and leaves.shape[1] == end - begin:
        return leaves
    own = np.empty((channels, end - begin, 1))
    for channel in range(channels):
        for k in range(end - begin):
            own[channel, k, 0] = leaves[channel & (leaves.shape[0] - 1), begin + k, 0]
    return own


@kernel
def _take_in(frame_at: int, sample_at: int, length: int, time_ns: int) -> int:
    """Add a sample to all runs, whose programs have no windows under their parts.

    Args:
        frame_at: address of a frame: of each array and how long it is, and how many channels the runs have.
        sample_at, length: address of the numbers for the sample (see `leaves_of_sample`), and their count.

    Returns:
        0; or, if nothing was added, how many channels are needed, or `_NO_ROOM`.
    """
    frame = integers_at(frame_at, _FRAME)
    plan = PackedPlan(
        integers_at(frame[_PLAN], frame[_PLAN + 1]), floats_at(frame[_CONSTANTS], frame[_CONSTANTS + 1])
    )
    leaves = leaves_of_plan(plan, floats_at(sample_at, length))
    numbers = floats_at(frame[_NUMBERS], frame[_NUMBERS + 1])
    whole = integers_at(frame[_WHOLE], frame[_WHOLE + 1])
    series = floats_at(frame[_SERIES], frame[_SERIES + 1]).reshape((-1, 4, 1))
    layout, own, nodes = _layout_of(whole)
    wanted = _wanted(numbers, whole, layout, leaves, frame[_CHANNELS])
    if wanted == 0:
        times_ns = frame[_TIME:]
        times_ns[0] = time_ns
        for r in range(layout.shape[0]):
            tables, memory, scratch, final = _run_at(numbers, whole, layout[r])
            at = _own_leaves(leaves, own[r], own[r + 1], frame[_CHANNELS])
            results = Results(series[nodes[r] : nodes[r + 1]], final)
            step(tables, memory, scratch, at, times_ns, 0, 1, results)
    return wanted


@kernel
def _take_in_with_windows(frame_at: int, sample_at: int, length: int, time_ns: int) -> int:
    """`_take_in` for any programs."""
    frame = integers_at(frame_at, _FRAME)
    plan = PackedPlan(
        integers_at(frame[_PLAN], frame[_PLAN + 1]), floats_at(frame[_CONSTANTS], frame[_CONSTANTS + 1])
    )
    leaves = leaves_of_plan(plan, floats_at(sample_at, length))
    numbers = floats_at(frame[_NUMBERS], frame[_NUMBERS + 1])
    whole = integers_at(frame[_WHOLE], frame[_WHOLE + 1])
    series = floats_at(frame[_SERIES], frame[_SERIES + 1]).reshape((-1, 4, 1))
    layout, own, nodes = _layout_of(whole)
    wanted = _wanted(numbers, whole, layout, leaves, frame[_CHANNELS])
    if wanted == 0:
        times_ns = frame[_TIME:]
        times_ns[0] = time_ns
        for r in range(layout.shape[0]):
            tables, memory, scratch, final = _run_at(numbers, whole, layout[r])
            at = _own_leaves(leaves, own[r], own[r + 1], frame[_CHANNELS])
            results = Results(series[nodes[r] : nodes[r + 1]], final)
            step_with_windows(tables, memory, scratch, at, times_ns, 0, 1, results)
    return wanted


class LiveRuns:
    """The runs of some formulas over one stream, sample by sample."""

    def __init__(self, programs: Sequence[Program]) -> None:
        """Start before the first sample."""
        self._runs = [OnlineRun(program, room=ROOM, tile=1) for program in programs]
        self._channels = 1
        has_windows = any(run.has_windows for run in self._runs)
        self._take_in = by_address(_take_in_with_windows if has_windows else _take_in)
        self._leaves = starts_from_counts([len(program.leaves) for program in programs])
        self._nodes = starts_from_counts([len(program.reports) for program in programs])
        self._buffers = _joined(self._runs, self._leaves, self._nodes)
        self._plan: PackedPlan | None = None
        self._series = np.empty((int(self._nodes[-1]), 4))
        self._frame = np.zeros(_FRAME, np.int64)
        self._frame_at = self._frame.ctypes.data

    @property
    def finals(self) -> list[Floats | None]:
        """For each formula (N, 2), lower and upper end of each node's value if the log ends here, or None
        before the first sample."""
        return [run.final if len(run) else None for run in self._runs]

    def extend(self, plan: PackedPlan, sample: bytes, time_ns: int) -> Floats:
        """Add a sample, as the bytes of what `leaves_of_sample` takes.

        Returns:
            (N, 4): value, now, lower and upper of the nodes of all formulas, one formula after the other.
        """
        if plan is not self._plan:
            self._plan = plan
            self._fill_frame()
        while wanted := self._take_in(self._frame_at, sample, len(sample) // 8, time_ns):
            for run in self._runs:
                if wanted == _NO_ROOM:
                    run.make_room(1)
                else:
                    run.widen(wanted)
            self._channels = max(self._channels, wanted)
            self._join()
        return self._series.copy()

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
        self._fill_frame()

    def _fill_frame(self) -> None:
        """Enter where all arrays are."""
        if self._plan is not None:
            arrays = (*self._plan, *self._buffers, self._series)
            self._frame[:_CHANNELS] = [number for each in arrays for number in (each.ctypes.data, each.size)]
        self._frame[_CHANNELS] = self._channels


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
