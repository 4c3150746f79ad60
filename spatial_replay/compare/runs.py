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
        knots: corresponding times, at least one pair. Between two knots, times are interpolated linearly.
            Before the first knot and after the last knot, time runs equally fast in both runs.
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
        a_ns, b_ns: time at which each run enters its differing states; None if the run ends before the
            divergence.
        a_states, b_states: differing states of each run; () if the run ends before the divergence.
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
        zeros_ns: zeros of times in texts about A and about B.
        results: pairs of results of both runs.
        align: "time", "progress", "progress:NAME", or the name of a spec, whose first change of sign is the
            event.

    Raises:
        UsageError: an unknown spec, a spec that never changes its sign, or no result with an automaton.
    """
    a_ns, b_ns = times_ns
    if align == "time":
        return _alignment("time", None, [Knot(*zeros_ns)], a_ns, b_ns)
    method, separator, name = align.partition(":")
    if method != "progress" or (separator and not name):
        return _alignment("event", align, [_event(results, align)], a_ns, b_ns)
    if name:
        results = _find_pairs(results, name)
    candidates: list[tuple[str, list[Knot]]] = []
    for result_a, result_b in results:
        require_ltlf(result_a.semantics, "the progress of an automaton")
        paths = [_path(result, files) for result in (result_a, result_b)]
        if paths[0] is None or paths[1] is None:
            continue
        common_count = _common(paths[0], paths[1])
        knots = [
            Knot(visit_a.time_ns, visit_b.time_ns)
            for visit_a, visit_b in zip(paths[0][:common_count], paths[1][:common_count], strict=True)
        ]
        if common_count == len(paths[0]) == len(paths[1]):
            knots.append(Knot(int(a_ns[-1]), int(b_ns[-1])))
        candidates.append((result_a.title, knots))
    if not candidates:
        raise UsageError(
            f"{name + ' has no' if name else 'no spec has an'} automaton to align by (past operators and "
            "bounds in seconds have none); align by time, or by a spec's name"
        )
    # the result with the most knots is used: a formula without temporal operators gives few knots
    name, knots = max(candidates, key=lambda candidate: len(candidate[1]))
    return _alignment("progress", name, knots, a_ns, b_ns)


def _find_pairs(
    results: Sequence[tuple[SpecResult, SpecResult]], wanted_name: str
) -> list[tuple[SpecResult, SpecResult]]:
    """Return the pairs of results with a name or title.

    Raises:
        UsageError: no result has the name.
    """
    pairs = [pair for pair in results if wanted_name in (pair[0].title, pair[0].name)]
    if not pairs:
        titles = [result.title for result, _ in results]
        hint = nearest_hint(wanted_name, titles) or f"there are {', '.join(titles) or 'none'}"
        raise UsageError(f"no result is named {wanted_name!r}, so its progress cannot align the runs; {hint}")
    return pairs


def parting_of(one: SpecResult, other: SpecResult, files: Sequence[Specification]) -> Parting | None:
    """Return the divergence of two runs in a spec's automaton; None without a divergence or automaton."""
    paths = [_path(result, files) for result in (one, other)]
    if paths[0] is None or paths[1] is None or paths[0] == paths[1]:
        return None
    common_count = _common(paths[0], paths[1])
    one_visit, other_visit = (
        path[common_count] if common_count < len(path) else None for path in (paths[0], paths[1])
    )
    if one_visit is None and other_visit is None:
        return None
    return Parting(
        None if one_visit is None else one_visit.time_ns,
        None if other_visit is None else other_visit.time_ns,
        () if one_visit is None else one_visit.states,
        () if other_visit is None else other_visit.states,
    )


def _alignment(
    kind: AlignmentKind, about: str | None, knots: Sequence[Knot], a_ns: Integers, b_ns: Integers
) -> Alignment:
    # interpolation needs times that increase in both runs
    increasing_knots = [knots[0]]
    for knot in knots[1:]:
        if knot.a_ns > increasing_knots[-1].a_ns and knot.b_ns > increasing_knots[-1].b_ns:
            increasing_knots.append(knot)
    counterpart_ns = _times_beside(a_ns, increasing_knots)
    after_index = np.clip(np.searchsorted(b_ns, counterpart_ns), 1, max(len(b_ns) - 1, 1))
    before_index = after_index - 1
    after_index = np.minimum(after_index, len(b_ns) - 1)
    nearest_index = np.where(
        counterpart_ns - b_ns[before_index] <= b_ns[after_index] - counterpart_ns, before_index, after_index
    )
    # a sample of A has no counterpart if B has no sample within one step
    median_steps_ns = [int(np.median(np.diff(times_ns))) for times_ns in (a_ns, b_ns) if len(times_ns) > 1]
    longest_step_ns = max(median_steps_ns, default=0)
    is_outside_b = (counterpart_ns < b_ns[0]) | (counterpart_ns > b_ns[-1])
    is_near = np.abs(b_ns[nearest_index] - counterpart_ns) <= np.where(
        is_outside_b, longest_step_ns // 2, longest_step_ns
    )
    paired_samples = np.flatnonzero(is_near)
    return Alignment(kind, about, tuple(increasing_knots), paired_samples, nearest_index[paired_samples])


def _times_beside(a_ns: Integers, knots: Sequence[Knot]) -> Integers:
    """Return the times in B that correspond to times in A."""
    first_knot, last_knot = knots[0], knots[-1]
    # relative to the first knot, because floats are exact only up to 2**53 ns (104 days)
    a_offsets_ns = np.array([knot.a_ns - first_knot.a_ns for knot in knots], np.float64)
    b_offsets_ns = np.array([knot.b_ns - first_knot.b_ns for knot in knots], np.float64)
    b_ns = (
        np.round(np.interp((a_ns - first_knot.a_ns).astype(np.float64), a_offsets_ns, b_offsets_ns)).astype(
            np.int64
        )
        + first_knot.b_ns
    )
    b_ns = np.where(a_ns < first_knot.a_ns, a_ns - first_knot.a_ns + first_knot.b_ns, b_ns)
    return np.asarray(np.where(a_ns > last_knot.a_ns, a_ns - last_knot.a_ns + last_knot.b_ns, b_ns), np.int64)


def _event(results: Sequence[tuple[SpecResult, SpecResult]], name: str) -> Knot:
    """Return the times at which the value of a named spec first changes its sign in each run.

    Raises:
        UsageError: an unknown spec, or a spec that never changes its sign.
    """
    spec_names: list[str] = []
    for result_a, result_b in results:
        spec_names += [node.name for node in result_a.nodes if node.name is not None]
        if name not in spec_names:
            continue
        # `value` of a spec without temporal operators is constant, so `now` is the second choice
        time_pairs = [
            [
                _first_change(result.times_ns, read_series(result.node(name)))
                for result in (result_a, result_b)
            ]
            for read_series in (attrgetter("value"), attrgetter("now"))
        ]
        change_times_ns = next(
            (time_pair for time_pair in time_pairs if None not in time_pair), time_pairs[0]
        )
        for run, time_ns in zip("AB", change_times_ns, strict=True):
            if time_ns is None:
                raise UsageError(
                    f"{name} never changes its sign in run {run}, so it is no event to align by; "
                    "align by time, or by another spec"
                )
        return Knot(*(time_ns for time_ns in change_times_ns if time_ns is not None))
    hint = nearest_hint(name, spec_names) or f"there are {', '.join(dict.fromkeys(spec_names)) or 'none'}"
    raise UsageError(f"no spec is named {name!r} to align by; {hint}; or give time or progress")


def _first_change(times_ns: Integers, values: Floats) -> int | None:
    known_samples = np.flatnonzero(~np.isnan(values))
    holds = values[known_samples] >= 0.0
    change_indices = np.flatnonzero(holds != holds[0]) if len(known_samples) else known_samples
    return int(times_ns[known_samples[change_indices[0]]]) if len(change_indices) else None


class _Visit(NamedTuple):
    """States of an automaton, and the time of the sample after which a run enters these states."""

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
        _, states_after = states_of_result(result, file)
    except NoAutomatonError:
        return None
    is_changed = states_after[1:] != states_after[:-1]
    entry_samples = [
        0,
        *(np.flatnonzero(is_changed if states_after.ndim == 1 else is_changed.any(axis=1)) + 1).tolist(),
    ]
    return [
        _Visit(
            int(result.times_ns[sample]),
            tuple(np.flatnonzero(states_after[sample]).tolist())
            if states_after.ndim > 1
            else (int(states_after[sample]),),
        )
        for sample in entry_samples
    ]


def file_of(files: Sequence[Specification], result: SpecResult) -> Specification | None:
    """Return the specification of a result; None if it is not in `files`."""
    evaluated_files = [with_numbers(file, result.evidence.units) for file in files]
    file_formulas = [(file, spec.formula) for file in evaluated_files for spec in file.specs]
    identical_files = (file for file, formula in file_formulas if formula is result.formula)
    # an equal formula counts, too: a specification of another profile is parsed again in its logged form
    equal_files = (file for file, formula in file_formulas if formula == result.formula)
    return next(identical_files, None) or next(equal_files, None)


def _common(one: Sequence[_Visit], other: Sequence[_Visit]) -> int:
    """Return the number of common states at the beginning of two paths."""
    visit_pairs = zip(one, other, strict=False)
    return next(
        (index for index, (visit_a, visit_b) in enumerate(visit_pairs) if visit_a.states != visit_b.states),
        min(len(one), len(other)),
    )


_PAIRS_AT_ONCE: Final = 16_384
"""Observations in one comparison, few enough for the cache of the processor."""


@dataclass(frozen=True, slots=True)
class ObjectDiff:
    """Difference of one object between two aligned runs, with times of samples of A.

    Attributes:
        first_ns: first time at which the object differs in position, shape or another property.
        apart_ns: first time at which the object's two footprints do not touch; None if they always touch.
        greatest_distance: greatest signed distance between the two footprints; NaN without a measurement.
        greatest_ns: time of the greatest distance, or `first_ns` without a measurement.
        greatest_shift: greatest displacement of the footprint's mean vertex.
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
    """Difference of one signal between two aligned runs, with times of samples of A.

    Attributes:
        first_ns: first time with different values.
        greatest_difference: greatest difference of two known numbers; NaN if there are none.
        greatest_ns: time of the greatest difference, or `first_ns` without numbers.
        ratio: median magnitude in B divided by the median magnitude in A; NaN if either median is 0.
    """

    name: str
    first_ns: int
    greatest_difference: float
    greatest_ns: int
    ratio: float

    @property
    def has_other_unit(self) -> bool:
        """Whether the signal seems to have another unit in B, such as millimetres instead of metres."""
        return self.ratio >= OTHER_UNITS or self.ratio <= 1.0 / OTHER_UNITS


def compare_signals(a: Trace, b: Trace, alignment: Alignment) -> tuple[SignalDiff, ...]:
    """Return the differences of common signals."""
    times_ns = a.times_ns[alignment.a]
    diffs = []
    for name in sorted(set(a.signals) & set(b.signals)):
        values_a, values_b = a.signals[name][alignment.a], b.signals[name][alignment.b]
        is_different = (values_a != values_b) & ~(np.isnan(values_a) & np.isnan(values_b))
        if not is_different.any():
            continue
        # two texts have no numeric difference
        numeric_samples = np.flatnonzero((values_a > TEXTS) & (values_b > TEXTS))
        differences = np.abs(values_b - values_a)
        greatest_sample = (
            int(numeric_samples[differences[numeric_samples].argmax()]) if len(numeric_samples) else None
        )
        magnitudes = [
            float(np.median(np.abs(values[numeric_samples]))) if len(numeric_samples) else 0.0
            for values in (values_a, values_b)
        ]
        diffs.append(
            SignalDiff(
                name,
                int(times_ns[is_different.argmax()]),
                np.nan if greatest_sample is None else float(differences[greatest_sample]),
                int(times_ns[is_different.argmax() if greatest_sample is None else greatest_sample]),
                magnitudes[1] / magnitudes[0] if min(magnitudes) > 0.0 else np.nan,
            )
        )
    return tuple(diffs)


def compare_objects(a: Trace, b: Trace, alignment: Alignment) -> tuple[ObjectDiff, ...]:
    """Return the differences of common objects, sorted by `apart_ns` and then by greatest displacement.

    Raises:
        UsageError: the runs have no common object, or different units.
    """
    common_names = sorted(set(a.names) & set(b.names))
    if not common_names and (a.names or b.names):
        raise UsageError(
            f"the runs have no object in common: A has {listing(a.names) or 'none'}; "
            f"B has {listing(b.names) or 'none'}. "
            "Map the same things to the same names"
        )
    require_same_units(a, b)
    # indices of observations, (P, K)
    rows_a, rows_b = (
        trace.rows[samples][:, [trace.names.index(name) for name in common_names]]
        for trace, samples in ((a, alignment.a), (b, alignment.b))
    )
    common_observations = np.flatnonzero((rows_a >= 0) & (rows_b >= 0))
    is_moved, squared_shifts, distances = (
        np.zeros(rows_a.shape, np.bool_),
        np.zeros(rows_a.shape),
        np.full(rows_a.shape, np.nan),
    )
    for batch_start in range(0, len(common_observations), _PAIRS_AT_ONCE):
        batch_indices = common_observations[batch_start : batch_start + _PAIRS_AT_ONCE]
        batch_results = _object_diff(a, rows_a.flat[batch_indices], b, rows_b.flat[batch_indices])
        for quantities, batch_quantities in zip(
            (is_moved, squared_shifts, distances), batch_results, strict=True
        ):
            quantities.flat[batch_indices] = batch_quantities
    times_ns = a.times_ns[alignment.a]
    is_only_in = (rows_a >= 0) & (rows_b < 0), (rows_b >= 0) & (rows_a < 0)
    diffs = []
    for column, name in enumerate(common_names):
        is_only_in_a, is_only_in_b = (is_unpaired[:, column] for is_unpaired in is_only_in)
        is_different = is_moved[:, column] | is_only_in_a | is_only_in_b
        if not is_different.any():
            continue
        object_distances = distances[:, column]
        apart_samples = np.flatnonzero(object_distances > 0.0)
        farthest_sample = None if np.isnan(object_distances).all() else int(np.nanargmax(object_distances))
        diffs.append(
            ObjectDiff(
                name,
                int(times_ns[is_different.argmax()]),
                int(times_ns[apart_samples[0]]) if len(apart_samples) else None,
                np.nan if farthest_sample is None else float(object_distances[farthest_sample]),
                int(times_ns[is_different.argmax() if farthest_sample is None else farthest_sample]),
                float(np.sqrt(squared_shifts[:, column].max())),
                int(np.count_nonzero(is_only_in_a)),
                int(np.count_nonzero(is_only_in_b)),
            )
        )
    after_end_ns = int(a.times_ns[-1]) + 1
    diffs.sort(
        key=lambda diff: (
            after_end_ns if diff.apart_ns is None else diff.apart_ns,
            -diff.greatest_shift,
            diff.first_ns,
            diff.name,
        )
    )
    return tuple(diffs)


def _object_diff(a: Trace, a_rows: Integers, b: Trace, b_rows: Integers) -> tuple[Booleans, Floats, Floats]:
    """Compare pairs of observations.

    Returns:
        For each pair: whether the observations differ, the squared displacement of the mean vertex, and the
        signed distance of the footprints. The distance is NaN without a difference.
    """
    footprints_a, footprints_b = a.footprints.select(a_rows), b.footprints.select(b_rows)
    is_moved = ~_are_equal(footprints_a, footprints_b)
    property_pairs = [(footprints_a.bottom, footprints_b.bottom), (footprints_a.top, footprints_b.top)]
    property_pairs += [(a.yaw[a_rows], b.yaw[b_rows]), (a.uncertainty[a_rows], b.uncertainty[b_rows])]
    for property_a, property_b in property_pairs:
        # NaN on both sides is no difference
        is_moved |= (property_a != property_b) & ~(np.isnan(property_a) & np.isnan(property_b))
    # means are relative to one vertex: far from the origin, their difference would lose digits
    first_vertices = footprints_a.vertices[footprints_a.vertex_start[footprints_a.part_start[:-1]]]
    shift_x, shift_y = _mean_vertices(footprints_b, first_vertices) - _mean_vertices(
        footprints_a, first_vertices
    )
    distances = np.full(len(a_rows), np.nan)
    operands = [Operand(np.flatnonzero(is_moved)[:, None] + first_row) for first_row in (0, len(a_rows))]
    all_footprints = FootprintBatch.concatenate([footprints_a, footprints_b])
    distances[is_moved] = measure(all_footprints, operands, [MeasureRequest("signed_distance", 0, 1)])[0]
    return is_moved, shift_x * shift_x + shift_y * shift_y, distances


def _are_equal(batch_a: FootprintBatch, batch_b: FootprintBatch) -> Booleans:
    """Return whether each row has the same parts in both batches."""
    row_sizes = [
        (np.diff(batch.part_start), np.diff(batch.vertex_start[batch.part_start]))
        for batch in (batch_a, batch_b)
    ]
    is_equal = (row_sizes[0][0] == row_sizes[1][0]) & (row_sizes[0][1] == row_sizes[1][1])
    batch_a, batch_b = (batch.select(np.flatnonzero(is_equal)) for batch in (batch_a, batch_b))
    is_part_different = (np.diff(batch_a.vertex_start) != np.diff(batch_b.vertex_start)) | (
        batch_a.radius != batch_b.radius
    )
    is_vertex_different = (batch_a.vertices != batch_b.vertices).any(axis=1)
    difference_counts = count_in_rows(is_part_different, batch_a.part_start)
    difference_counts += count_in_rows(is_vertex_different, batch_a.vertex_start[batch_a.part_start])
    is_equal[is_equal] = difference_counts == 0
    return np.asarray(is_equal)


def _mean_vertices(batch: FootprintBatch, origin: Floats) -> Floats:
    """Return the mean vertex of each row relative to the row's origin, (2, R)."""
    vertex_counts = np.diff(batch.vertex_start[batch.part_start])
    vertex_rows = np.repeat(np.arange(len(batch)), vertex_counts)
    coordinate_sums = [
        np.bincount(vertex_rows, coordinates, len(batch))
        for coordinates in (batch.vertices - origin[vertex_rows]).T
    ]
    return np.stack(coordinate_sums) / vertex_counts


def _movement_sentence(diff: ObjectDiff, start_ns: int, unit: str) -> Sentence:
    sentence_parts: list[str | Instant] = [f"{diff.name}: differs since ", Instant(diff.first_ns, start_ns)]
    if diff.greatest_shift:
        sentence_parts.append(f", by up to {with_unit(diff.greatest_shift, unit)}")
    if diff.apart_ns is not None:
        distance_text = with_unit(diff.greatest_distance, unit)
        sentence_parts += ["; apart from itself since ", Instant(diff.apart_ns, start_ns)]
        sentence_parts += [f", farthest by {distance_text} at ", Instant(diff.greatest_ns, start_ns)]
    for run, sample_count in (("A", diff.samples_only_in_a), ("B", diff.samples_only_in_b)):
        if sample_count:
            sentence_parts.append(f"; only {run} has it in {plural(sample_count, 'sample')}")
    return Sentence(*sentence_parts)


def _signal_sentence(diff: SignalDiff, start_ns: int, unit: str) -> Sentence:
    sentence_parts: list[str | Instant] = [f"{diff.name}: differs since ", Instant(diff.first_ns, start_ns)]
    greatest_difference = diff.greatest_difference
    if greatest_difference > 0.0 and not names_from_unit(unit):
        sentence_parts += [
            f", by up to {with_unit(greatest_difference, unit)} at ",
            Instant(diff.greatest_ns, start_ns),
        ]
    if diff.has_other_unit:
        factor, larger_run = (diff.ratio, "B") if diff.ratio > 1.0 else (1.0 / diff.ratio, "A")
        sentence_parts.append(
            f"; {factor:,.0f} times as large in {larger_run}: it may be in another unit there"
        )
    return Sentence(*sentence_parts)


@dataclass(frozen=True, eq=False)
class RunSpecDiff:
    """Difference of one result between two runs.

    Attributes:
        a, b: results of both runs.
        first_ns: time of the first sample of A whose value has another sign than in B, or None.
        nodes: ids of the deepest nodes with different verdicts; for equal verdicts with different robustness,
            the deciding node of A.
        parting: divergence in the automaton; None for equal verdicts or without an automaton.
        moved: differences of the objects that `nodes` mention.
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
        """Yield sentences on the differences. Times of a run are relative to the run's zero."""
        yield Sentence(" | ".join(map(outcome_text, (self.a, self.b))) + difference_text(self.a, self.b))
        if self.first_ns is not None:
            yield Sentence("the sign of its value differs since ", Instant(self.first_ns, zeros_ns[0]))
        if self.parting is not None:
            parting = self.parting
            yield Sentence(
                "they part in the automaton: ",
                *_entry_parts(parting.a_ns, parting.a_states, zeros_ns[0]),
                " | ",
                *_entry_parts(parting.b_ns, parting.b_states, zeros_ns[1]),
            )
        for node_id in self.nodes:
            yield Sentence(f"brought about by `{self.a.nodes[node_id].text}`")
        for run, result, zero_ns in zip("AB", (self.a, self.b), zeros_ns, strict=True):
            if self.is_flipped and result.causes and result.causes[0].witness is not None:
                reason = cause_reason(result.causes[0], zero_ns)
                yield Sentence(f"{run}: ", *reason.parts)
        if self.moved:
            object_names = ", ".join(diff.name for diff in self.moved)
            yield Sentence(f"of what it is about, these moved differently: {object_names}")

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
            "nodes": [{"id": node_id, "text": self.a.nodes[node_id].text} for node_id in self.nodes],
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
    diff_by_name = {diff.name: diff for diff in objects}
    node_ids = _deepest_flips(one, other)
    if not node_ids and one.can_explain and one.robustness != other.robustness:
        node_ids = (one.deciding_node(),)
    moved_names = [
        name for node_id in node_ids for name in sorted(_objects_of(one, node_id)) if name in diff_by_name
    ]
    return RunSpecDiff(
        one,
        other,
        _first_sign(one, other, alignment, traces),
        node_ids,
        parting_of(one, other, files) if one.verdict is not other.verdict else None,
        tuple(diff_by_name[name] for name in dict.fromkeys(moved_names)),
    )


def _deepest_flips(one: SpecResult, other: SpecResult) -> tuple[int, ...]:
    """Return the deepest nodes with different verdicts; none if the root has the same verdict."""
    flipped_ids = {
        node.id
        for node, other_node in zip(one.nodes, other.nodes, strict=True)
        if node.verdict is not other_node.verdict
    }
    if 0 not in flipped_ids:
        return ()
    parent_ids = {one.nodes[node].parent for node in flipped_ids}
    # a node counts only if all its ancestors have different verdicts, too
    connected_ids = {0}
    for node in sorted(flipped_ids):
        if one.nodes[node].parent in connected_ids:
            connected_ids.add(node)
    return tuple(sorted(connected_ids - parent_ids))


def _objects_of(result: SpecResult, node: int) -> frozenset[str]:
    formula = nodes_of(result.formula)[node]
    bound_formula = result.evidence.bound(formula)
    object_names: set[str] = set(other_names(bound_formula))
    for _, _, leaf in iter_nodes(bound_formula):
        if isinstance(leaf, Atom):
            object_names |= {getattr(term, "name", "") for term in leaf.terms}
    return frozenset(object_names)


def _first_sign(
    one: SpecResult, other: SpecResult, alignment: Alignment, traces: tuple[Trace, Trace]
) -> int | None:
    """Return the time of the first sample whose value has another sign than its counterpart."""
    run_signs = []
    for result, trace, sample_indices in zip((one, other), traces, (alignment.a, alignment.b), strict=True):
        values = np.full(len(trace), np.nan)
        values[np.searchsorted(trace.times_ns, result.times_ns)] = result.series[0, 0]
        run_signs.append(np.where(np.isnan(values), 0, np.where(values >= 0.0, 1, -1))[sample_indices])
    is_different = run_signs[0] != run_signs[1]
    return int(traces[0].times_ns[alignment.a[is_different.argmax()]]) if is_different.any() else None


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
    decisions_by_source: list[tuple[PlanDecision, ...]] = []
    for source in sources:
        path = source.path
        decisions_of_source: tuple[PlanDecision, ...] = ()
        if isinstance(path, Path) and source.kind == "MCAP":
            with suppress(UsageError):
                decisions_of_source = read_decisions(path).decisions
        decisions_by_source.append(decisions_of_source)
    for index in range(max(map(len, decisions_by_source))):
        decision_pair = [
            run_decisions[index] if index < len(run_decisions) else None
            for run_decisions in decisions_by_source
        ]
        if _bytes_to_compare(decision_pair[0]) != _bytes_to_compare(decision_pair[1]):
            map_hashes = [_map_hashes(decision) for decision in decision_pair]
            map_names = sorted(
                name
                for name in map_hashes[0].keys() & map_hashes[1].keys()
                if map_hashes[0][name] != map_hashes[1][name]
            )
            decision_texts = [_decision_text(decision) for decision in decision_pair]
            times_ns = [None if decision is None else decision.time_ns for decision in decision_pair]
            return DecisionDiff(
                index, decision_texts[0], decision_texts[1], times_ns[0], times_ns[1], tuple(map_names)
            )
    return None


def _bytes_to_compare(decision: PlanDecision | None) -> bytes | None:
    """Return the comparable part of a decision: action and reason, without time and outcome."""
    if decision is None:
        return None
    decision_copy = PlanDecision.FromString(decision.SerializeToString())
    decision_copy.ClearField("time_ns")
    decision_copy.ClearField("outcome")
    # by default, equal messages can have different bytes
    # (https://protobuf.dev/programming-guides/serialization-not-canonical)
    comparable_bytes: bytes = decision_copy.SerializeToString(deterministic=True)
    return comparable_bytes


def _map_hashes(decision: PlanDecision | None) -> dict[str, tuple[bytes, ...]]:
    hashes: dict[str, tuple[bytes, ...]] = {}
    for edge in () if decision is None else decision.considered:
        for candidate in edge.candidates:
            hashes[candidate.object] = (*hashes.get(candidate.object, ()), candidate.map_sha256)
    return hashes


def _decision_text(decision: PlanDecision | None) -> str:
    if decision is None:
        return "none: the run has no such decision"
    target_text = f"; {place_text(decision.target)}" if decision.HasField("target") else ""
    return f"{decision.reason}{target_text}"


_MOST_LISTED: Final = 12


@dataclass(frozen=True, eq=False)
class LogDiff(Printed, Displayed):
    """Differences between two runs.

    Attributes:
        a, b: names of the logs.
        samples: number of compared samples of each log.
        zeros_ns: zeros of times in sentences, one per log.
        alignment: correspondence of the samples.
        objects: differences of objects, sorted by `apart_ns` (see `compare_objects`).
        signals: differences of signals, in the order of their names.
        only_a, only_b: objects, signals and results of templates that only one run has.
        specs: differences of results.
        decision: first decision that differs; None if there is none, or if no run was planned.
        has_equal_samples: whether all samples are equal.
        faults: sentences on data that was lost while reading.
        doubts: remarks on assumptions that a log contradicts.
        missing: a warning for each name in the specifications that a log lacks.
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
        paired_counts = [
            len(set(sample_indices.tolist())) for sample_indices in (self.alignment.a, self.alignment.b)
        ]
        counts_text = " | ".join(plural(sample_count, "sample") for sample_count in self.samples)
        yield f"  {counts_text}; {self.alignment}: {paired_counts[0]:,} of A beside {paired_counts[1]:,} of B"
        yield from (f"  {sentence}" for sentence in self.movements[:_MOST_LISTED])
        if len(self.objects) > _MOST_LISTED:
            yield f"  and {plural(len(self.objects) - _MOST_LISTED, 'other object')} moved differently"
        yield from (f"  {sentence}" for sentence in self.signal_changes[:_MOST_LISTED])
        if len(self.signals) > _MOST_LISTED:
            yield f"  and {plural(len(self.signals) - _MOST_LISTED, 'other signal')} with other values"
        for run, names in (("A", self.only_a), ("B", self.only_b)):
            if names:
                yield f"  only in {run}: {', '.join(names[:_MOST_LISTED])}"
        for spec in self.specs:
            first_sentence, *other_sentences = spec.sentences(self.zeros_ns)
            yield f"  {spec.a.title}: {first_sentence}"
            if spec.is_different:
                yield from (f"    {sentence}" for sentence in other_sentences)
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
        SpecificationError: a log lacks a name in the specifications, and names are strict.
    """
    selections = [
        Selection(source, tuple(files), replace(run_options, keep=()))
        for source, run_options in zip(sources, options, strict=True)
    ]
    checked_traces = [selection.checked_trace(advance) for selection in selections]
    (a, b), zeros_ns = (
        [checked_trace.trace for checked_trace in checked_traces],
        (checked_traces[0].zero_ns, checked_traces[1].zero_ns),
    )
    trace_options = zip((a, b), options, strict=True)
    evaluations = [
        [evaluate_with(run_options, file, trace) for file in files] for trace, run_options in trace_options
    ]
    results = _pair_results(evaluations)
    alignment = align_runs((a.times_ns, b.times_ns), zeros_ns, results, files, align)
    objects = compare_objects(a, b, alignment)
    result_titles = [
        {result.title for evaluation in log_evaluations for result in evaluation}
        for log_evaluations in evaluations
    ]
    return LogDiff(
        sources[0].name,
        sources[1].name,
        (len(a), len(b)),
        zeros_ns,
        alignment,
        objects,
        compare_signals(a, b, alignment),
        _only_in(a, b, result_titles[0] - result_titles[1]),
        _only_in(b, a, result_titles[1] - result_titles[0]),
        tuple(
            compare_results(result_a, result_b, alignment, (a, b), objects, files)
            for result_a, result_b in results
        ),
        compare_decisions(sources),
        not objects and a == b,
        tuple(
            fault
            for checked_trace in checked_traces
            for fault in counted_from(checked_trace.trace.faults, checked_trace.zero_ns)
        ),
        tuple(
            remark
            for source, checked_trace in zip(sources, checked_traces, strict=True)
            for remark in counted_from(
                (doubt.remark(source.name) for doubt in checked_trace.trace.doubts), checked_trace.zero_ns
            )
        ),
        (a, b),
        tuple(dict.fromkeys(remark for checked_trace in checked_traces for remark in checked_trace.missing)),
    )


def _only_in(one: Trace, other: Trace, titles: set[str]) -> tuple[str, ...]:
    names = sorted(set(one.names) - set(other.names)) + sorted(set(one.signals) - set(other.signals))
    return (*names, *sorted(titles))


def _pair_results(evaluations: Sequence[Sequence[Evaluation]]) -> list[tuple[SpecResult, SpecResult]]:
    result_pairs = []
    for evaluation_a, evaluation_b in zip(*evaluations, strict=True):
        result_by_title = {result.title: result for result in evaluation_b}
        result_pairs += [
            (result, result_by_title[result.title])
            for result in evaluation_a
            if result.title in result_by_title
        ]
    return result_pairs
