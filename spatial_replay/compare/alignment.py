"""Which sample of one run stands beside which of another, and how far each object is from itself there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.annotate.automaton_state import AutomatonRun
from spatial_replay.automata.compile import automaton
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.trace import Trace

AlignmentKind: TypeAlias = Literal["time", "event", "progress"]

_OTHER_UNITS: Final = 8.0
"""Where every common object is so many times as large in one run, that run is in another unit."""


class Knot(NamedTuple):
    """Two times, one in each run, that stand beside each other."""

    a_ns: int
    b_ns: int


@dataclass(frozen=True, eq=False)
class Alignment:
    """How the samples of run A correspond to those of run B.

    Attributes:
        kind: by "time" since the first sample, by an "event", by the "progress" of an automaton.
        about: what the event or the progress is of.
        knots: at least one; between two, time runs evenly, and outside them as fast in both.
        a, b: (P,) indices of the samples that stand beside each other, by time in A.
    """

    kind: AlignmentKind
    about: str | None
    knots: tuple[Knot, ...]
    a: Integers
    b: Integers

    def __str__(self) -> str:
        if self.kind == "time":
            return "aligned by time since the first sample"
        return f"aligned by the {'event' if self.kind == 'event' else 'progress of'} {self.about}"


class Parting(NamedTuple):
    """Where the paths of two runs through one automaton part: the first states that differ.

    Attributes:
        name: of the result.
        a_ns, b_ns: when each run enters its own; None if it ends before.
        a_states, b_states: these states; () if the run ends before.
    """

    name: str
    a_ns: int | None
    b_ns: int | None
    a_states: tuple[int, ...]
    b_states: tuple[int, ...]


def align_runs(
    times_ns: tuple[Integers, Integers],
    results: Sequence[tuple[SpecResult, SpecResult]],
    files: Sequence[Specification],
    align: str,
) -> Alignment:
    """Align two runs.

    Args:
        times_ns: of the samples of A and of B, at least one each.
        results: of both runs, in pairs.
        align: "time", "progress", or the name of a spec, whose first change of sign is the event.

    Raises:
        UsageError: no such spec, a spec that never changes its sign, no result with an automaton.
    """
    a, b = times_ns
    start = Knot(int(a[0]), int(b[0]))
    if align == "time":
        return _alignment("time", None, [start], a, b)
    if align != "progress":
        return _alignment("event", align, [_event(results, align)], a, b)
    for one, other in results:
        paths = [_path(result, files) for result in (one, other)]
        if paths[0] is None or paths[1] is None:
            continue
        common = _common(paths[0], paths[1])
        knots = [
            Knot(x.time_ns, y.time_ns) for x, y in zip(paths[0][:common], paths[1][:common], strict=True)
        ]
        if common == len(paths[0]) == len(paths[1]):
            knots.append(Knot(int(a[-1]), int(b[-1])))
        return _alignment("progress", one.title, knots, a, b)
    raise UsageError(
        "no spec has an automaton to align by (past operators and bounds in seconds have none); "
        "align by time, or by a spec's name"
    )


def parting_of(one: SpecResult, other: SpecResult, files: Sequence[Specification]) -> Parting | None:
    """Return where two runs of one spec part in its automaton; None if they do not, or it has none."""
    paths = [_path(result, files) for result in (one, other)]
    if paths[0] is None or paths[1] is None or paths[0] == paths[1]:
        return None
    common = _common(paths[0], paths[1])
    one_end, other_end = (path[common] if common < len(path) else None for path in (paths[0], paths[1]))
    if one_end is None and other_end is None:
        return None
    return Parting(
        one.title,
        None if one_end is None else one_end.time_ns,
        None if other_end is None else other_end.time_ns,
        () if one_end is None else one_end.states,
        () if other_end is None else other_end.states,
    )


def _alignment(
    kind: AlignmentKind, about: str | None, knots: Sequence[Knot], a_ns: Integers, b_ns: Integers
) -> Alignment:
    increasing = [knots[0]]
    for knot in knots[1:]:
        if knot.a_ns > increasing[-1].a_ns and knot.b_ns > increasing[-1].b_ns:
            increasing.append(knot)
    beside_ns = _mapped(a_ns, increasing)
    after = np.clip(np.searchsorted(b_ns, beside_ns), 1, max(len(b_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(b_ns) - 1)
    nearest = np.where(beside_ns - b_ns[before] <= b_ns[after] - beside_ns, before, after)
    # where one run has no sample within a step, there is nothing to compare with
    steps = [int(np.median(np.diff(times_ns))) for times_ns in (a_ns, b_ns) if len(times_ns) > 1]
    inside = np.flatnonzero(np.abs(b_ns[nearest] - beside_ns) <= max(steps, default=0))
    return Alignment(kind, about, tuple(increasing), inside, nearest[inside])


def _mapped(a_ns: Integers, knots: Sequence[Knot]) -> Integers:
    """Return the times in B that stand beside times in A."""
    first, last = knots[0], knots[-1]
    # relative to the first knot, so that doubles hold every nanosecond of a long log
    x = np.array([knot.a_ns - first.a_ns for knot in knots], np.float64)
    y = np.array([knot.b_ns - first.b_ns for knot in knots], np.float64)
    inner = np.round(np.interp((a_ns - first.a_ns).astype(np.float64), x, y)).astype(np.int64) + first.b_ns
    inner = np.where(a_ns < first.a_ns, a_ns - first.a_ns + first.b_ns, inner)
    return np.asarray(np.where(a_ns > last.a_ns, a_ns - last.a_ns + last.b_ns, inner), np.int64)


def _event(results: Sequence[tuple[SpecResult, SpecResult]], name: str) -> Knot:
    """Return the times at which the value of a named spec first changes its sign in each run."""
    names: list[str] = []
    for one, other in results:
        names += [node.name for node in one.nodes if node.name is not None]
        if name not in names:
            continue
        times = [_first_change(result, name) for result in (one, other)]
        for which, time_ns in zip("AB", times, strict=True):
            if time_ns is None:
                raise UsageError(
                    f"{name} never changes its sign in run {which}, so it is no event to align by; "
                    "align by time, or by another spec"
                )
        return Knot(*(time_ns for time_ns in times if time_ns is not None))
    known = nearest_hint(name, names) or f"there are {', '.join(dict.fromkeys(names)) or 'none'}"
    raise UsageError(f"no spec is named {name!r} to align by; {known}; or give time or progress")


def _first_change(result: SpecResult, name: str) -> int | None:
    value = result.node(name).value
    known = np.flatnonzero(~np.isnan(value))
    holds = value[known] >= 0.0
    turned = np.flatnonzero(holds != holds[0]) if len(known) else known
    return int(result.times_ns[known[turned[0]]]) if len(turned) else None


class _Visit(NamedTuple):
    """States of an automaton, and the first sample after which a run is in them."""

    time_ns: int
    states: tuple[int, ...]


def _path(result: SpecResult, files: Sequence[Specification]) -> list[_Visit] | None:
    """Return the states of a run, each as often as it is entered; None without an automaton."""
    if result.leaves is None or not len(result.times_ns):
        return None
    file = next((file for file in files if any(each.formula is result.formula for each in file.specs)), None)
    if file is None:
        return None
    try:
        machine = automaton(file, result.spec.name)
    except NoAutomatonError:
        return None
    run = AutomatonRun(
        result.name, result.object, machine, result.formula, result.evidence.instance.program.leaves
    )
    after = run.states(SeriesBlock(result.times_ns, result.series, result.leaves))
    changed = after[1:] != after[:-1]
    entered = [0, *(np.flatnonzero(changed if after.ndim == 1 else changed.any(axis=1)) + 1).tolist()]
    return [
        _Visit(
            int(result.times_ns[at]),
            tuple(np.flatnonzero(after[at]).tolist()) if after.ndim > 1 else (int(after[at]),),
        )
        for at in entered
    ]


def _common(one: Sequence[_Visit], other: Sequence[_Visit]) -> int:
    """Count the states that two paths begin with."""
    pairs = zip(one, other, strict=False)
    return next(
        (index for index, (a, b) in enumerate(pairs) if a.states != b.states), min(len(one), len(other))
    )


# ------------------------------------------------------------------------------ who moved differently


@dataclass(frozen=True, slots=True)
class ObjectDiff:
    """One object in two aligned runs.

    Attributes:
        first_ns: the first sample of A in which it is not just where, or as, it is in B.
        apart_ns: the first one in which the two footprints do not touch; None if they always do.
        greatest: the greatest signed distance between the two footprints, at `greatest_ns`; NaN where none
            was measured.
        shift: how far its vertices' mean is away at most.
        only_a, only_b: in how many pairs of samples only one run has it.
    """

    name: str
    first_ns: int
    apart_ns: int | None
    greatest: float
    greatest_ns: int
    shift: float
    only_a: int
    only_b: int


def compare_objects(a: Trace, b: Trace, alignment: Alignment) -> tuple[ObjectDiff, ...]:
    """Return the common objects that moved differently: those apart first come first, then the farthest.

    Raises:
        UsageError: no object is in both runs, or one run is in another unit.
    """
    names = sorted(set(a.names) & set(b.names))
    if not names and (a.names or b.names):
        raise UsageError(
            f"the runs have no object in common: {_listed(a.names)}; {_listed(b.names)}. "
            "Map the same things to the same names"
        )
    shapes = _Shapes(a), _Shapes(b)
    _check_units(a, b, names, shapes)
    both = FootprintBatch.concatenate([a.footprints, b.footprints])
    found = [
        diff for name in names if (diff := _object_diff(name, a, b, alignment, shapes, both)) is not None
    ]
    never = int(a.times_ns[-1]) + 1
    return tuple(
        sorted(found, key=lambda each: (each.apart_ns or never, -each.shift, each.first_ns, each.name))
    )


class _Shapes:
    """Columns of numbers of the observations of a trace, by which they are compared."""

    def __init__(self, trace: Trace) -> None:
        batch = trace.footprints
        vertex = batch.vertex_start[batch.part_start]
        count = np.maximum(np.diff(vertex), 1)
        x, y = np.ascontiguousarray(batch.vertices.T)
        sums = [_sums(each, vertex) for each in (x, y, x * x, y * y)]
        self.mean = sums[0] / count, sums[1] / count
        spread = (sums[2] + sums[3]) / count - self.mean[0] ** 2 - self.mean[1] ** 2
        self.size = np.sqrt(np.maximum(spread, 0.0)) + _sums(batch.radius, batch.part_start)
        optional = [each for each in (batch.bottom, batch.top, trace.yaw) if not np.isnan(each).all()]
        self.columns = [*sums, self.size, trace.uncertainty, *optional]

    def differ(self, rows: Integers, other: _Shapes, other_rows: Integers) -> Booleans:
        """Return which of some observations are not those of another trace, in pairs."""
        differs = np.full(len(rows), len(self.columns) != len(other.columns))
        for column, beside in zip(self.columns, other.columns, strict=False):
            one, two = column[rows], beside[other_rows]
            differs |= (one != two) & ~(np.isnan(one) & np.isnan(two))
        return differs


def _sums(values: Floats, start: Integers) -> Floats:
    """Return the sum of each ragged row, (R,)."""
    return np.asarray(np.add.reduceat(values, start[:-1])) if len(start) > 1 else np.empty(0)


def _object_diff(
    name: str,
    a: Trace,
    b: Trace,
    alignment: Alignment,
    shapes: tuple[_Shapes, _Shapes],
    both: FootprintBatch,
) -> ObjectDiff | None:
    one = a.rows[alignment.a, a.names.index(name)]
    other = b.rows[alignment.b, b.names.index(name)]
    differs: Booleans = (one >= 0) != (other >= 0)
    only_a, only_b = (int(np.count_nonzero(differs & (rows >= 0))) for rows in (one, other))
    pairs = np.flatnonzero((one >= 0) & (other >= 0))
    pairs = pairs[shapes[0].differ(one[pairs], shapes[1], other[pairs])]
    differs[pairs] = True
    if not differs.any():
        return None
    times_ns = a.times_ns[alignment.a]
    first_ns = int(times_ns[differs.argmax()])
    if not len(pairs):
        return ObjectDiff(name, first_ns, None, np.nan, first_ns, 0.0, only_a, only_b)
    one, other = one[pairs], other[pairs]
    operands = [Operand(one[:, None]), Operand(other[:, None] + len(a.footprints))]
    distance = measure(both, operands, [MeasureRequest("signed_distance", 0, 1)])[0]
    apart = np.flatnonzero(distance > 0.0)
    x, y = (mine[one] - its[other] for mine, its in zip(shapes[0].mean, shapes[1].mean, strict=True))
    shift = np.hypot(x, y)
    farthest = int(distance.argmax())
    return ObjectDiff(
        name,
        first_ns,
        int(times_ns[pairs[apart[0]]]) if len(apart) else None,
        float(distance[farthest]),
        int(times_ns[pairs[farthest]]),
        float(shift.max()),
        only_a,
        only_b,
    )


def _check_units(a: Trace, b: Trace, names: Sequence[str], shapes: tuple[_Shapes, _Shapes]) -> None:
    """Refuse runs whose common objects are all many times as large in one as in the other."""
    ratios, example = [], ""
    for name in names:
        sizes = [
            float(np.median(own.size[rows[rows >= 0]])) if (rows >= 0).any() else 0.0
            for trace, own in zip((a, b), shapes, strict=True)
            for rows in [trace.rows[:, trace.names.index(name)]]
        ]
        if min(sizes) > 0.0:
            ratios.append(sizes[0] / sizes[1])
            example = example or f"{name} is {ratios[0]:.3g} times as large in the first"
    if ratios and (min(ratios) >= _OTHER_UNITS or max(ratios) <= 1.0 / _OTHER_UNITS):
        raise UsageError(
            f"the runs seem to be in other units: {example}. Read both in one unit, by a mapping with `scale`"
        )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (", …" if len(names) > 8 else "") or "none"
