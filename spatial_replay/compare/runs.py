"""Differences of two runs: their alignment, and the objects, signals, results and decisions that differ."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.annotate.automaton_state import states_of_result
from spatial_replay.compare.specifications import EditOutcome, difference_text, evaluate_with, outcome_text
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers, count_in_rows
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure
from spatial_replay.lazy import Displayed, Printed
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.source import Source
from spatial_replay.monitor.result import Evaluation, SpecResult
from spatial_replay.monitor.sentences import cause_reason
from spatial_replay.monitor.verdict import require_ltlf
from spatial_replay.planning.decision_log import place_text
from spatial_replay.planning.read import read_decisions
from spatial_replay.replay.selection import DEFAULT_OPTIONS, ReplayOptions, Selection
from spatial_replay.spec.checks import with_numbers
from spatial_replay.spec.diagnostics import Diagnostic, nearest_hint
from spatial_replay.spec.formula import Atom, Specification, iter_nodes
from spatial_replay.spec.walks import nodes_of, other_names
from spatial_replay.text import (
    TEXTS,
    Instant,
    Sentence,
    counted_from,
    json_fields,
    json_value,
    listing,
    names_from_unit,
    plural,
    with_unit,
)
from spatial_replay.trace.trace import Trace
from spatial_replay.trace.units import OTHER_UNITS, require_same_units

AlignmentKind: TypeAlias = Literal["time", "event", "progress"]


class Knot(NamedTuple):
    """Two corresponding times, one in each run."""

    a_ns: int
    b_ns: int


@dataclass(frozen=True, eq=False)
class Alignment:
    """Correspondence between the samples of run A and of run B.

    Attributes:
        kind: "time" since the zero of each log, an "event", or the "progress" of an automaton.
        about: spec of the event or of the automaton; None for "time".
        knots: corresponding times, at least one pair. Between two knots times are interpolated linearly;
            before the first and after the last one, time runs equally fast in both runs.
        a, b: (P,), indices of corresponding samples, by time in A.
    """

    kind: AlignmentKind
    about: str | None
    knots: tuple[Knot, ...]
    a: Integers
    b: Integers

    def __str__(self) -> str:
        if self.kind == "time":
            return "aligned by time since the zero of each log"
        return f"aligned by the {'event' if self.kind == 'event' else 'progress of'} {self.about}"


class Parting(NamedTuple):
    """Divergence of two runs in one automaton: their first states that differ.

    Attributes:
        a_ns, b_ns: time at which each run enters its differing states; None if it ends before.
        a_states, b_states: differing states of each run; () if it ends before.
    """

    a_ns: int | None
    b_ns: int | None
    a_states: tuple[int, ...]
    b_states: tuple[int, ...]


def align_runs(
    times_ns: tuple[Integers, Integers],
    zeros_ns: tuple[int, int],
    results: Sequence[tuple[SpecResult, SpecResult]],
    files: Sequence[Specification],
    align: str,
) -> Alignment:
    """Align two runs.

    Args:
        times_ns: times of the samples of A and of B, at least one each.
        zeros_ns: times of A and B that texts count from.
        results: pairs of results of both runs.
        align: "time", "progress", "progress:NAME", or the name of a spec, whose first change of sign is the
            event.

    Raises:
        UsageError: an unknown spec, a spec that never changes its sign, or no result with an automaton.
    """
    a, b = times_ns
    if align == "time":
        return _alignment("time", None, [Knot(*zeros_ns)], a, b)
    kind, colon, name = align.partition(":")
    if kind != "progress" or (colon and not name):
        return _alignment("event", align, [_event(results, align)], a, b)
    if name:
        results = _find_pairs(results, name)
    candidates: list[tuple[str, list[Knot]]] = []
    for result_a, result_b in results:
        require_ltlf(result_a.semantics, "the progress of an automaton")
        paths = [_path(result, files) for result in (result_a, result_b)]
        if paths[0] is None or paths[1] is None:
            continue
        common = _common(paths[0], paths[1])
        knots = [
            Knot(x.time_ns, y.time_ns) for x, y in zip(paths[0][:common], paths[1][:common], strict=True)
        ]
        if common == len(paths[0]) == len(paths[1]):
            knots.append(Knot(int(a[-1]), int(b[-1])))
        candidates.append((result_a.title, knots))
    if not candidates:
        raise UsageError(
            f"{name + ' has no' if name else 'no spec has an'} automaton to align by (past operators and "
            "bounds in seconds have none); align by time, or by a spec's name"
        )
    # the most knots win: the automaton of a formula without temporal operators gives hardly any
    name, knots = max(candidates, key=lambda candidate: len(candidate[1]))
    return _alignment("progress", name, knots, a, b)


def _find_pairs(
    results: Sequence[tuple[SpecResult, SpecResult]], wanted: str
) -> list[tuple[SpecResult, SpecResult]]:
    """Return the pairs of results with a name or title.

    Raises:
        UsageError: no result has the name.
    """
    pairs = [pair for pair in results if wanted in (pair[0].title, pair[0].name)]
    if not pairs:
        titles = [result.title for result, _ in results]
        hint = nearest_hint(wanted, titles) or f"there are {', '.join(titles) or 'none'}"
        raise UsageError(f"no result is named {wanted!r}, so its progress cannot align the runs; {hint}")
    return pairs


def parting_of(one: SpecResult, other: SpecResult, files: Sequence[Specification]) -> Parting | None:
    """Return the divergence of two runs in the automaton of a spec; None without one."""
    paths = [_path(result, files) for result in (one, other)]
    if paths[0] is None or paths[1] is None or paths[0] == paths[1]:
        return None
    common = _common(paths[0], paths[1])
    one_end, other_end = (path[common] if common < len(path) else None for path in (paths[0], paths[1]))
    if one_end is None and other_end is None:
        return None
    return Parting(
        None if one_end is None else one_end.time_ns,
        None if other_end is None else other_end.time_ns,
        () if one_end is None else one_end.states,
        () if other_end is None else other_end.states,
    )


def _alignment(
    kind: AlignmentKind, about: str | None, knots: Sequence[Knot], a_ns: Integers, b_ns: Integers
) -> Alignment:
    # interpolation needs times that increase in both runs
    increasing = [knots[0]]
    for knot in knots[1:]:
        if knot.a_ns > increasing[-1].a_ns and knot.b_ns > increasing[-1].b_ns:
            increasing.append(knot)
    beside_ns = _times_beside(a_ns, increasing)
    after = np.clip(np.searchsorted(b_ns, beside_ns), 1, max(len(b_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(b_ns) - 1)
    nearest = np.where(beside_ns - b_ns[before] <= b_ns[after] - beside_ns, before, after)
    # a sample of A has no counterpart if B has no sample within one step
    steps = [int(np.median(np.diff(times_ns))) for times_ns in (a_ns, b_ns) if len(times_ns) > 1]
    step_ns = max(steps, default=0)
    is_beyond = (beside_ns < b_ns[0]) | (beside_ns > b_ns[-1])
    is_near = np.abs(b_ns[nearest] - beside_ns) <= np.where(is_beyond, step_ns // 2, step_ns)
    inside = np.flatnonzero(is_near)
    return Alignment(kind, about, tuple(increasing), inside, nearest[inside])


def _times_beside(a_ns: Integers, knots: Sequence[Knot]) -> Integers:
    """Return the times in B that correspond to times in A."""
    first, last = knots[0], knots[-1]
    # relative to the first knot, because floats are exact only up to 2**53 ns (104 days)
    x = np.array([knot.a_ns - first.a_ns for knot in knots], np.float64)
    y = np.array([knot.b_ns - first.b_ns for knot in knots], np.float64)
    inner = np.round(np.interp((a_ns - first.a_ns).astype(np.float64), x, y)).astype(np.int64) + first.b_ns
    inner = np.where(a_ns < first.a_ns, a_ns - first.a_ns + first.b_ns, inner)
    return np.asarray(np.where(a_ns > last.a_ns, a_ns - last.a_ns + last.b_ns, inner), np.int64)


def _event(results: Sequence[tuple[SpecResult, SpecResult]], name: str) -> Knot:
    """Return the times at which the value of a named spec first changes its sign in each run.

    Raises:
        UsageError: an unknown spec, or a spec that never changes its sign.
    """
    names: list[str] = []
    for result_a, result_b in results:
        names += [node.name for node in result_a.nodes if node.name is not None]
        if name not in names:
            continue
        # `value` of a spec without temporal operators is constant, so `now` is used if it never changes
        pairs = [
            [_first_change(result.times_ns, series(result.node(name))) for result in (result_a, result_b)]
            for series in (attrgetter("value"), attrgetter("now"))
        ]
        times = next((pair for pair in pairs if None not in pair), pairs[0])
        for which, time_ns in zip("AB", times, strict=True):
            if time_ns is None:
                raise UsageError(
                    f"{name} never changes its sign in run {which}, so it is no event to align by; "
                    "align by time, or by another spec"
                )
        return Knot(*(time_ns for time_ns in times if time_ns is not None))
    remedy = nearest_hint(name, names) or f"there are {', '.join(dict.fromkeys(names)) or 'none'}"
    raise UsageError(f"no spec is named {name!r} to align by; {remedy}; or give time or progress")


def _first_change(times_ns: Integers, values: Floats) -> int | None:
    known_places = np.flatnonzero(~np.isnan(values))
    holds = values[known_places] >= 0.0
    turned = np.flatnonzero(holds != holds[0]) if len(known_places) else known_places
    return int(times_ns[known_places[turned[0]]]) if len(turned) else None


class _Visit(NamedTuple):
    """States of an automaton, with the time of the first sample after which a run is in them."""

    time_ns: int
    states: tuple[int, ...]


def _path(result: SpecResult, files: Sequence[Specification]) -> list[_Visit] | None:
    """Return the states that a run enters, in order; None without an automaton."""
    if result.leaves is None or not len(result.times_ns) or result.semantics != "ltlf":
        return None
    file = file_of(files, result)
    if file is None:
        return None
    try:
        _, after = states_of_result(result, file)
    except NoAutomatonError:
        return None
    changed = after[1:] != after[:-1]
    entered = [0, *(np.flatnonzero(changed if after.ndim == 1 else changed.any(axis=1)) + 1).tolist()]
    return [
        _Visit(
            int(result.times_ns[at]),
            tuple(np.flatnonzero(after[at]).tolist()) if after.ndim > 1 else (int(after[at]),),
        )
        for at in entered
    ]


def file_of(files: Sequence[Specification], result: SpecResult) -> Specification | None:
    """Return the specification of a result; None if it is not in `files`."""
    as_evaluated = [with_numbers(file, result.evidence.units) for file in files]
    pairs = [(file, spec.formula) for file in as_evaluated for spec in file.specs]
    same = (file for file, formula in pairs if formula is result.formula)
    # an equal formula counts, too: a specification of another profile is parsed again in its logged form
    equal = (file for file, formula in pairs if formula == result.formula)
    return next(same, None) or next(equal, None)


def _common(one: Sequence[_Visit], other: Sequence[_Visit]) -> int:
    """Return the number of common states at the beginning of two paths."""
    pairs = zip(one, other, strict=False)
    return next(
        (index for index, (a, b) in enumerate(pairs) if a.states != b.states), min(len(one), len(other))
    )


_PAIRS_AT_ONCE: Final = 16_384
"""Observations in one comparison, few enough for the cache of the processor."""


@dataclass(frozen=True, slots=True)
class ObjectDiff:
    """Difference of one object between two aligned runs; times are those of samples of A.

    Attributes:
        first_ns: first time at which the object differs in position, shape or another property.
        apart_ns: first time at which its two footprints do not touch; None if they always touch.
        greatest_distance: greatest signed distance between its two footprints; NaN without a measurement.
        greatest_ns: time of the greatest distance, or `first_ns` without a measurement.
        greatest_shift: greatest displacement of the mean of its vertices.
        samples_only_in_a, samples_only_in_b: number of pairs of samples in which only one run has the object.
    """

    name: str
    first_ns: int
    apart_ns: int | None
    greatest_distance: float
    greatest_ns: int
    greatest_shift: float
    samples_only_in_a: int
    samples_only_in_b: int


@dataclass(frozen=True, slots=True)
class SignalDiff:
    """Difference of one signal between two aligned runs; times are those of samples of A.

    Attributes:
        first_ns: first time with different values.
        greatest_difference: greatest difference of two known numbers; NaN if there are none.
        greatest_ns: time of the greatest difference, or `first_ns` without numbers.
        ratio: median magnitude in B divided by that in A; NaN if one of them is 0.
    """

    name: str
    first_ns: int
    greatest_difference: float
    greatest_ns: int
    ratio: float

    @property
    def has_other_unit(self) -> bool:
        """Whether the unit seems to be another one in B, such as millimetres instead of metres."""
        return self.ratio >= OTHER_UNITS or self.ratio <= 1.0 / OTHER_UNITS


def compare_signals(a: Trace, b: Trace, alignment: Alignment) -> tuple[SignalDiff, ...]:
    """Return the differences of common signals."""
    times_ns = a.times_ns[alignment.a]
    diffs = []
    for name in sorted(set(a.signals) & set(b.signals)):
        values_a, values_b = a.signals[name][alignment.a], b.signals[name][alignment.b]
        differs = (values_a != values_b) & ~(np.isnan(values_a) & np.isnan(values_b))
        if not differs.any():
            continue
        # two texts have no numeric difference
        numeric = np.flatnonzero((values_a > TEXTS) & (values_b > TEXTS))
        apart = np.abs(values_b - values_a)
        farthest = int(numeric[apart[numeric].argmax()]) if len(numeric) else None
        sizes = [
            float(np.median(np.abs(values[numeric]))) if len(numeric) else 0.0
            for values in (values_a, values_b)
        ]
        diffs.append(
            SignalDiff(
                name,
                int(times_ns[differs.argmax()]),
                np.nan if farthest is None else float(apart[farthest]),
                int(times_ns[differs.argmax() if farthest is None else farthest]),
                sizes[1] / sizes[0] if min(sizes) > 0.0 else np.nan,
            )
        )
    return tuple(diffs)


def compare_objects(a: Trace, b: Trace, alignment: Alignment) -> tuple[ObjectDiff, ...]:
    """Return the differences of common objects, sorted by `apart_ns` and then by greatest displacement.

    Raises:
        UsageError: the runs have no common object, or different units.
    """
    names = sorted(set(a.names) & set(b.names))
    if not names and (a.names or b.names):
        raise UsageError(
            f"the runs have no object in common: A has {listing(a.names) or 'none'}; "
            f"B has {listing(b.names) or 'none'}. "
            "Map the same things to the same names"
        )
    require_same_units(a, b)
    # (P, K) observations
    rows_a, rows_b = (
        trace.rows[rows][:, [trace.names.index(name) for name in names]]
        for trace, rows in ((a, alignment.a), (b, alignment.b))
    )
    in_both = np.flatnonzero((rows_a >= 0) & (rows_b >= 0))
    moved, shift, distances = (
        np.zeros(rows_a.shape, np.bool_),
        np.zeros(rows_a.shape),
        np.full(rows_a.shape, np.nan),
    )
    for start in range(0, len(in_both), _PAIRS_AT_ONCE):
        places = in_both[start : start + _PAIRS_AT_ONCE]
        differences = _object_diff(a, rows_a.flat[places], b, rows_b.flat[places])
        for values, part in zip((moved, shift, distances), differences, strict=True):
            values.flat[places] = part
    times_ns = a.times_ns[alignment.a]
    only = (rows_a >= 0) & (rows_b < 0), (rows_b >= 0) & (rows_a < 0)
    diffs = []
    for number, name in enumerate(names):
        only_a, only_b = (absent[:, number] for absent in only)
        differs = moved[:, number] | only_a | only_b
        if not differs.any():
            continue
        distance = distances[:, number]
        apart = np.flatnonzero(distance > 0.0)
        farthest = None if np.isnan(distance).all() else int(np.nanargmax(distance))
        diffs.append(
            ObjectDiff(
                name,
                int(times_ns[differs.argmax()]),
                int(times_ns[apart[0]]) if len(apart) else None,
                np.nan if farthest is None else float(distance[farthest]),
                int(times_ns[differs.argmax() if farthest is None else farthest]),
                float(np.sqrt(shift[:, number].max())),
                int(np.count_nonzero(only_a)),
                int(np.count_nonzero(only_b)),
            )
        )
    never = int(a.times_ns[-1]) + 1
    diffs.sort(
        key=lambda diff: (
            never if diff.apart_ns is None else diff.apart_ns,
            -diff.greatest_shift,
            diff.first_ns,
            diff.name,
        )
    )
    return tuple(diffs)


def _object_diff(a: Trace, a_rows: Integers, b: Trace, b_rows: Integers) -> tuple[Booleans, Floats, Floats]:
    """Compare pairs of observations.

    Returns:
        For each pair: whether it differs, the squared displacement of the mean of the vertices, and the
        signed distance of the footprints, which is NaN without a difference.
    """
    first, second = a.footprints.select(a_rows), b.footprints.select(b_rows)
    moved = ~_are_equal(first, second)
    columns = [(first.bottom, second.bottom), (first.top, second.top)]
    columns += [(a.yaw[a_rows], b.yaw[b_rows]), (a.uncertainty[a_rows], b.uncertainty[b_rows])]
    for value, beside in columns:
        # NaN on both sides is no difference
        moved |= (value != beside) & ~(np.isnan(value) & np.isnan(beside))
    # relative to one vertex, because means of coordinates far from the origin lose digits when subtracted
    corner = first.vertices[first.vertex_start[first.part_start[:-1]]]
    x, y = _mean_vertices(second, corner) - _mean_vertices(first, corner)
    distance = np.full(len(a_rows), np.nan)
    operands = [Operand(np.flatnonzero(moved)[:, None] + start) for start in (0, len(a_rows))]
    both = FootprintBatch.concatenate([first, second])
    distance[moved] = measure(both, operands, [MeasureRequest("signed_distance", 0, 1)])[0]
    return moved, x * x + y * y, distance


def _are_equal(first: FootprintBatch, second: FootprintBatch) -> Booleans:
    """Return whether each row has the same parts in both batches."""
    sizes = [
        (np.diff(batch.part_start), np.diff(batch.vertex_start[batch.part_start]))
        for batch in (first, second)
    ]
    alike = (sizes[0][0] == sizes[1][0]) & (sizes[0][1] == sizes[1][1])
    first, second = (batch.select(np.flatnonzero(alike)) for batch in (first, second))
    parts = (np.diff(first.vertex_start) != np.diff(second.vertex_start)) | (first.radius != second.radius)
    vertices = (first.vertices != second.vertices).any(axis=1)
    unequal = count_in_rows(parts, first.part_start)
    unequal += count_in_rows(vertices, first.vertex_start[first.part_start])
    alike[alike] = unequal == 0
    return np.asarray(alike)


def _mean_vertices(batch: FootprintBatch, origin: Floats) -> Floats:
    """Return the mean of each row's vertices relative to the origin of the row, (2, R)."""
    counts = np.diff(batch.vertex_start[batch.part_start])
    rows = np.repeat(np.arange(len(batch)), counts)
    sums = [np.bincount(rows, coordinates, len(batch)) for coordinates in (batch.vertices - origin[rows]).T]
    return np.stack(sums) / counts


def _movement_sentence(diff: ObjectDiff, start_ns: int, unit: str) -> Sentence:
    """Return a sentence on the first difference of an object and its greatest distance."""
    parts: list[str | Instant] = [f"{diff.name}: differs since ", Instant(diff.first_ns, start_ns)]
    if diff.greatest_shift:
        parts.append(f", by up to {with_unit(diff.greatest_shift, unit)}")
    if diff.apart_ns is not None:
        farthest = with_unit(diff.greatest_distance, unit)
        parts += ["; apart from itself since ", Instant(diff.apart_ns, start_ns)]
        parts += [f", farthest by {farthest} at ", Instant(diff.greatest_ns, start_ns)]
    for which, count in (("A", diff.samples_only_in_a), ("B", diff.samples_only_in_b)):
        if count:
            parts.append(f"; only {which} has it in {plural(count, 'sample')}")
    return Sentence(*parts)


def _signal_sentence(diff: SignalDiff, start_ns: int, unit: str) -> Sentence:
    """Return a sentence on the first and the greatest difference of a signal, and on its unit."""
    parts: list[str | Instant] = [f"{diff.name}: differs since ", Instant(diff.first_ns, start_ns)]
    greatest = diff.greatest_difference
    if greatest > 0.0 and not names_from_unit(unit):
        parts += [f", by up to {with_unit(greatest, unit)} at ", Instant(diff.greatest_ns, start_ns)]
    if diff.has_other_unit:
        times, which = (diff.ratio, "B") if diff.ratio > 1.0 else (1.0 / diff.ratio, "A")
        parts.append(f"; {times:,.0f} times as large in {which}: it may be in another unit there")
    return Sentence(*parts)


@dataclass(frozen=True, eq=False)
class RunSpecDiff:
    """Difference of one result between two runs.

    Attributes:
        a, b: results of both runs.
        first_ns: time of the first sample of A whose value has another sign than in B, or None.
        nodes: ids of the deepest nodes with different verdicts; for equal verdicts with different robustness,
            the deciding node of A.
        parting: divergence in the automaton; None for equal verdicts or without an automaton.
        moved: differences of the objects that these nodes mention.
    """

    a: SpecResult
    b: SpecResult
    first_ns: int | None
    nodes: tuple[int, ...]
    parting: Parting | None
    moved: tuple[ObjectDiff, ...]

    @property
    def is_flipped(self) -> bool:
        """Whether the verdicts differ."""
        return self.a.verdict is not self.b.verdict

    @property
    def is_different(self) -> bool:
        """Whether the verdicts or the final numbers differ."""
        return not EditOutcome.of(self.a).same_as(EditOutcome.of(self.b))

    def sentences(self, zeros_ns: tuple[int, int]) -> Iterator[Sentence]:
        """Yield sentences on the differences; times of each run count from its zero."""
        yield Sentence(" | ".join(map(outcome_text, (self.a, self.b))) + difference_text(self.a, self.b))
        if self.first_ns is not None:
            yield Sentence("the sign of its value differs since ", Instant(self.first_ns, zeros_ns[0]))
        if self.parting is not None:
            where = self.parting
            yield Sentence(
                "they part in the automaton: ",
                *_entry_parts(where.a_ns, where.a_states, zeros_ns[0]),
                " | ",
                *_entry_parts(where.b_ns, where.b_states, zeros_ns[1]),
            )
        for node in self.nodes:
            yield Sentence(f"brought about by `{self.a.nodes[node].text}`")
        for which, result, start_ns in zip("AB", (self.a, self.b), zeros_ns, strict=True):
            if self.is_flipped and result.causes and result.causes[0].witness is not None:
                reason = cause_reason(result.causes[0], start_ns)
                yield Sentence(f"{which}: ", *reason.parts)
        if self.moved:
            names = ", ".join(diff.name for diff in self.moved)
            yield Sentence(f"of what it is about, these moved differently: {names}")

    @property
    def document(self) -> dict[str, Any]:
        """The difference as values for JSON."""
        return {
            "name": self.a.name,
            "object": self.a.object,
            "flipped": self.is_flipped,
            "a": json_value(EditOutcome.of(self.a)),
            "b": json_value(EditOutcome.of(self.b)),
            "first_ns": self.first_ns,
            "nodes": [{"id": node, "text": self.a.nodes[node].text} for node in self.nodes],
            "parting": json_value(self.parting),
            "moved": [diff.name for diff in self.moved],
        }


def compare_results(
    one: SpecResult,
    other: SpecResult,
    alignment: Alignment,
    traces: tuple[Trace, Trace],
    objects: Sequence[ObjectDiff],
    files: Sequence[Specification],
) -> RunSpecDiff:
    """Compare the results of one spec in two aligned runs.

    Args:
        objects: differences of objects.
    """
    moved = {diff.name: diff for diff in objects}
    nodes = _deepest_flips(one, other)
    if not nodes and one.can_explain and one.robustness != other.robustness:
        nodes = (one.deciding_node(),)
    names = [name for node in nodes for name in sorted(_objects_of(one, node)) if name in moved]
    return RunSpecDiff(
        one,
        other,
        _first_sign(one, other, alignment, traces),
        nodes,
        parting_of(one, other, files) if one.verdict is not other.verdict else None,
        tuple(moved[name] for name in dict.fromkeys(names)),
    )


def _deepest_flips(one: SpecResult, other: SpecResult) -> tuple[int, ...]:
    """Return the deepest nodes with different verdicts; none if the root has the same verdict."""
    flipped = {
        node.id
        for node, beside in zip(one.nodes, other.nodes, strict=True)
        if node.verdict is not beside.verdict
    }
    if 0 not in flipped:
        return ()
    below = {one.nodes[node].parent for node in flipped}
    # a node counts only if all nodes from the root down to it have different verdicts
    reached = {0}
    for node in sorted(flipped):
        if one.nodes[node].parent in reached:
            reached.add(node)
    return tuple(sorted(reached - below))


def _objects_of(result: SpecResult, node: int) -> frozenset[str]:
    formula = nodes_of(result.formula)[node]
    bound = result.evidence.bound(formula)
    names: set[str] = set(other_names(bound))
    for _, _, leaf in iter_nodes(bound):
        if isinstance(leaf, Atom):
            names |= {getattr(term, "name", "") for term in leaf.terms}
    return frozenset(names)


def _first_sign(
    one: SpecResult, other: SpecResult, alignment: Alignment, traces: tuple[Trace, Trace]
) -> int | None:
    """Return the time of the first sample whose value has another sign than its counterpart."""
    signs = []
    for result, trace, samples in zip((one, other), traces, (alignment.a, alignment.b), strict=True):
        value = np.full(len(trace), np.nan)
        value[np.searchsorted(trace.times_ns, result.times_ns)] = result.series[0, 0]
        signs.append(np.where(np.isnan(value), 0, np.where(value >= 0.0, 1, -1))[samples])
    differs = signs[0] != signs[1]
    return int(traces[0].times_ns[alignment.a[differs.argmax()]]) if differs.any() else None


def _entry_parts(time_ns: int | None, states: Sequence[int], start_ns: int) -> tuple[str | Instant, ...]:
    if time_ns is None:
        return ("the end of the run",)
    return f"state {', '.join(map(str, states))} at ", Instant(time_ns, start_ns)


class DecisionDiff(NamedTuple):
    """First decision that differs between two planned runs.

    Attributes:
        number: index of the decision.
        a, b: decision of each run in words; a missing decision is stated.
        a_ns, b_ns: times of the decisions; None for a missing decision.
        maps: names of the objects with different gradient maps.
    """

    number: int
    a: str
    b: str
    a_ns: int | None
    b_ns: int | None
    maps: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """Yield both decisions, and the objects with different maps, as lines of text."""
        yield f"A: {self.a}"
        yield f"B: {self.b}"
        if self.maps:
            yield f"gradient maps that differ: {', '.join(self.maps)}"


def compare_decisions(sources: tuple[Source, Source]) -> DecisionDiff | None:
    """Return the first decision that differs; None if there is none, or if no log was planned."""
    decisions: list[tuple[PlanDecision, ...]] = []
    for source in sources:
        path = source.path
        decisions_of_source: tuple[PlanDecision, ...] = ()
        if isinstance(path, Path) and source.kind == "MCAP":
            with suppress(UsageError):
                decisions_of_source = read_decisions(path).decisions
        decisions.append(decisions_of_source)
    for number in range(max(map(len, decisions))):
        pair = [of_source[number] if number < len(of_source) else None for of_source in decisions]
        if _bytes_to_compare(pair[0]) != _bytes_to_compare(pair[1]):
            hashes = [_map_hashes(decision) for decision in pair]
            maps = sorted(
                name for name in hashes[0].keys() & hashes[1].keys() if hashes[0][name] != hashes[1][name]
            )
            texts = [_decision_text(decision) for decision in pair]
            times_ns = [None if decision is None else decision.time_ns for decision in pair]
            return DecisionDiff(number, texts[0], texts[1], times_ns[0], times_ns[1], tuple(maps))
    return None


def _bytes_to_compare(decision: PlanDecision | None) -> bytes | None:
    """Return the comparable part of a decision: action and reason, without time and outcome."""
    if decision is None:
        return None
    copy = PlanDecision.FromString(decision.SerializeToString())
    copy.ClearField("time_ns")
    copy.ClearField("outcome")
    # by default, equal messages can have different bytes
    # (https://protobuf.dev/programming-guides/serialization-not-canonical)
    copied: bytes = copy.SerializeToString(deterministic=True)
    return copied


def _map_hashes(decision: PlanDecision | None) -> dict[str, tuple[bytes, ...]]:
    hashes: dict[str, tuple[bytes, ...]] = {}
    for edge in () if decision is None else decision.considered:
        for candidate in edge.candidates:
            hashes[candidate.object] = (*hashes.get(candidate.object, ()), candidate.map_sha256)
    return hashes


def _decision_text(decision: PlanDecision | None) -> str:
    if decision is None:
        return "none: the run has no such decision"
    where = f"; {place_text(decision.target)}" if decision.HasField("target") else ""
    return f"{decision.reason}{where}"


_MOST_LISTED: Final = 12


@dataclass(frozen=True, eq=False)
class LogDiff(Printed, Displayed):
    """Differences between two runs.

    Attributes:
        a, b: names of the logs.
        samples: number of compared samples of each log.
        zeros_ns: times that sentences count from, one of each log.
        alignment: correspondence of the samples.
        objects: differences of objects, the first ones apart first.
        signals: differences of signals, in the order of their names.
        only_a, only_b: objects, signals and results of templates that only one run has.
        specs: differences of results.
        decision: first decision that differs; None if there is none, or if no run was planned.
        has_equal_samples: whether all samples are equal.
        faults: sentences on data that was lost while reading.
        doubts: remarks on assumptions that a log contradicts.
        missing: a warning for each name in the specifications that a log never has.
        traces: samples of both runs.
    """

    a: str
    b: str
    samples: tuple[int, int]
    zeros_ns: tuple[int, int]
    alignment: Alignment
    objects: tuple[ObjectDiff, ...]
    signals: tuple[SignalDiff, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    specs: tuple[RunSpecDiff, ...]
    decision: DecisionDiff | None
    has_equal_samples: bool
    faults: tuple[str, ...]
    doubts: tuple[str, ...]
    traces: tuple[Trace, Trace]
    missing: tuple[Diagnostic, ...]

    @property
    def is_empty(self) -> bool:
        """Whether samples, results and decisions are equal."""
        return self.has_equal_samples and self.decision is None

    @property
    def movements(self) -> list[Sentence]:
        """A sentence for each of `objects`."""
        unit = self.traces[0].units.get("", "")
        return [_movement_sentence(diff, self.zeros_ns[0], unit) for diff in self.objects]

    @property
    def signal_changes(self) -> list[Sentence]:
        """A sentence for each of `signals`."""
        units = self.traces[0].units
        return [_signal_sentence(diff, self.zeros_ns[0], units.get(diff.name, "")) for diff in self.signals]

    def lines(self) -> Iterator[str]:
        """Yield the lines of text that the command `diff` prints."""
        yield f"A {self.a} | B {self.b}"
        if self.is_empty:
            yield f"  the same {plural(self.samples[0], 'sample')}"
            return
        paired = [len(set(rows.tolist())) for rows in (self.alignment.a, self.alignment.b)]
        counts = " | ".join(plural(count, "sample") for count in self.samples)
        yield f"  {counts}; {self.alignment}: {paired[0]:,} of A beside {paired[1]:,} of B"
        yield from (f"  {sentence}" for sentence in self.movements[:_MOST_LISTED])
        if len(self.objects) > _MOST_LISTED:
            yield f"  and {plural(len(self.objects) - _MOST_LISTED, 'other object')} moved differently"
        yield from (f"  {sentence}" for sentence in self.signal_changes[:_MOST_LISTED])
        if len(self.signals) > _MOST_LISTED:
            yield f"  and {plural(len(self.signals) - _MOST_LISTED, 'other signal')} with other values"
        for which, names in (("A", self.only_a), ("B", self.only_b)):
            if names:
                yield f"  only in {which}: {', '.join(names[:_MOST_LISTED])}"
        for spec in self.specs:
            first, *rest = spec.sentences(self.zeros_ns)
            yield f"  {spec.a.title}: {first}"
            if spec.is_different:
                yield from (f"    {sentence}" for sentence in rest)
        if self.decision is not None:
            yield f"  decision {self.decision.number} is the first that differs:"
            yield from (f"    {line}" for line in self.decision.lines())

    @property
    def document(self) -> dict[str, Any]:
        """The differences as values for JSON."""
        return {
            "a": self.a,
            "b": self.b,
            "zero_ns": list(self.zeros_ns),
            "same": self.is_empty,
            "damaged": bool(self.faults),
            "alignment": {
                **json_fields(self.alignment, "kind", "about"),
                "knots": list(map(list, self.alignment.knots)),
                "pairs": len(self.alignment.a),
            },
            "objects": json_value(self.objects),
            "signals": json_value(self.signals),
            "only_a": list(self.only_a),
            "only_b": list(self.only_b),
            "specifications": [diff.document for diff in self.specs],
            "decision": json_value(self.decision),
        }

    def __repr__(self) -> str:
        return "\n".join(self.lines())


def diff_sources(
    sources: tuple[Source, Source],
    files: Sequence[Specification] = (),
    options: tuple[ReplayOptions, ReplayOptions] = (DEFAULT_OPTIONS, DEFAULT_OPTIONS),
    *,
    align: str = "time",
    advance: Callable[[int], None] = lambda samples: None,
) -> LogDiff:
    """Compare two logs sample by sample.

    Args:
        options: options of the evaluation of each log.
        align: "time" since the zero of each log, "progress" of the automaton with the most common states, or
            "progress:NAME" of a spec's automaton. The name of a spec aligns by its first change of sign in
            each run.
        advance: function that is called with the number of samples of each read block.

    Raises:
        UsageError: a run has no sample, the runs have no common object or different units, or there is
            nothing to align by.
        LogError: a log cannot be read.
        SpecificationError: the specifications mention names that a log never has, if names are strict.
    """
    selections = [
        Selection(source, tuple(files), replace(reading, keep=()))
        for source, reading in zip(sources, options, strict=True)
    ]
    checked = [selection.checked_trace(advance) for selection in selections]
    (a, b), zeros_ns = [read.trace for read in checked], (checked[0].zero_ns, checked[1].zero_ns)
    pairs = zip((a, b), options, strict=True)
    evaluations = [[evaluate_with(reading, file, trace) for file in files] for trace, reading in pairs]
    results = _pair_results(evaluations)
    alignment = align_runs((a.times_ns, b.times_ns), zeros_ns, results, files, align)
    objects = compare_objects(a, b, alignment)
    titles = [{result.title for evaluation in of_log for result in evaluation} for of_log in evaluations]
    return LogDiff(
        sources[0].name,
        sources[1].name,
        (len(a), len(b)),
        zeros_ns,
        alignment,
        objects,
        compare_signals(a, b, alignment),
        _only_in(a, b, titles[0] - titles[1]),
        _only_in(b, a, titles[1] - titles[0]),
        tuple(
            compare_results(result_a, result_b, alignment, (a, b), objects, files)
            for result_a, result_b in results
        ),
        compare_decisions(sources),
        not objects and a == b,
        tuple(text for read in checked for text in counted_from(read.trace.faults, read.zero_ns)),
        tuple(
            remark
            for source, read in zip(sources, checked, strict=True)
            for remark in counted_from((d.remark(source.name) for d in read.trace.doubts), read.zero_ns)
        ),
        (a, b),
        tuple(dict.fromkeys(remark for read in checked for remark in read.missing)),
    )


def _only_in(one: Trace, other: Trace, titles: set[str]) -> tuple[str, ...]:
    names = sorted(set(one.names) - set(other.names)) + sorted(set(one.signals) - set(other.signals))
    return (*names, *sorted(titles))


def _pair_results(evaluations: Sequence[Sequence[Evaluation]]) -> list[tuple[SpecResult, SpecResult]]:
    pairs = []
    for evaluation_a, evaluation_b in zip(*evaluations, strict=True):
        named = {result.title: result for result in evaluation_b}
        pairs += [(result, named[result.title]) for result in evaluation_a if result.title in named]
    return pairs
