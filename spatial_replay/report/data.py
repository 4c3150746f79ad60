"""The content of a report: a run with its results, and the facts of the page as JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Event_pb2 import Event
from numpy.typing import NDArray

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.annotate.deciding_leaf import pair_of
from spatial_replay.annotate.scene.scene_frames import entity_ids
from spatial_replay.annotate.scene.scene_template import outlines_of
from spatial_replay.annotate.specification import ReportedTree
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.footprint import Footprint
from spatial_replay.monitor.result import NodeResult, SpecResult, worst_first
from spatial_replay.monitor.sentences import divisor_of, open_text
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.monitor.witness.path import DecidingAtom
from spatial_replay.monitor.witness.witness import Witness, WitnessStep
from spatial_replay.palette import CURVES, SIGNS
from spatial_replay.replay.engine import Replayed
from spatial_replay.report.panels import (
    MOST_EVENTS,
    MOST_NODES,
    NO_PICTURES,
    Packing,
    ReportedDecisions,
    ReportedScene,
    StatePath,
    automaton_value,
    decisions_value,
    event_values,
    final_text,
    named_nodes,
    requirement_values,
    scene_value,
    sentence_parts,
    shown_nodes,
    singles,
    start_of,
    tree_value,
)
from spatial_replay.report.ticks import MOST_TICKS, ticks_value
from spatial_replay.spec.formula import Quantified, Specification, iter_nodes
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.text import Sentence, json_fields, json_number, with_unit
from spatial_replay.trace.units import Axes

MANY: Final = 6
"""Limit of results on a page without counts and filters.

A page with more results unfolds only one explanation.
"""
_MOST_MARKED: Final = 200
"""Limit of events whose samples are always drawn; the earliest events come first."""
MOST_DRAWN: Final = 24
"""Limit of results with explanation, tree and curves; the worst results come first.

The page shows the verdicts of all results.
"""


@dataclass(frozen=True, eq=False)
class ReportedResult:
    """One result of a run, with its explanation and its path through its automaton.

    Attributes:
        tree: the reported tree with the result's name.
        file: the specification of the result.
        sentences: explanation of the verdict; empty without an explanation.
        witness: deciding path and atom; None without an explanation.
        unit: declared unit of the robustness; "" if none is declared.
        compiled: the automaton, or the reason why there is none.
        path: states of the automaton over the run.
    """

    result: SpecResult
    tree: ReportedTree
    file: Specification
    sentences: tuple[Sentence, ...]
    witness: Witness | None
    unit: str
    compiled: SpecAutomaton
    path: StatePath

    @property
    def specs(self) -> Iterator[NodeResult]:
        """Yield the first node of each named spec within the formula, in the order of the text."""
        reported_names = {self.result.nodes[0].name}
        for node in self.result.nodes[1:]:
            if node.name is not None and node.name not in reported_names:
                reported_names.add(node.name)
                yield node

    @property
    def decided(self) -> WitnessStep | None:
        """The step at which the page opens; None without an explanation.

        The step is the end of the deciding path, or of the path to the atom closest to a missed response. If
        an operator on the path takes its number from an earlier sample, the page opens at that operator,
        because the operator did not fail before.
        """
        if self.witness is None:
            return None
        path = self.witness.closest_path or self.witness.path
        return next(
            (step for step, next_step in pairwise(path) if next_step.time_ns < step.time_ns), path[-1]
        )

    @property
    def deciding(self) -> DecidingAtom | None:
        """The deciding atom or, for a missed response, the atom closest to fulfilling the response."""
        if self.witness is None:
            return None
        return self.witness.deciding if self.witness.closest is None else self.witness.closest[0]

    @property
    def fault_ns(self) -> int | None:
        """Time of the step that made the result violated or unknown; None for a satisfied result."""
        decided = self.decided
        return None if decided is None or self.result.verdict is Verdict.SATISFIED else decided.time_ns

    @property
    def robustness_text(self) -> str:
        """The root's robustness with its unit, or the ends of its interval."""
        return final_text(self.result.robustness, self.result.lower, self.result.upper, self.unit)


@dataclass(frozen=True, eq=False)
class RunReport:
    """A run with its results.

    Attributes:
        axes: axes of the source; samples are always y-up.
        results: the results of `replayed`.
        gaps: sentences about gaps in the samples that make results unknown; a smaller window avoids each gap.
        redone: decisions of `plan --redo` that differ from the recorded decisions.
        pictures: pictures of the camera, see `pictures_of`.
        planned_for: specification file of the decisions, if the report evaluates another file; else "".
        ticks: messages of the robot's behaviour tree.
        obstacles: obstacles of the planner's workspace by name.
    """

    replayed: Replayed
    axes: Axes
    files: tuple[Specification, ...]
    results: tuple[ReportedResult, ...]
    gaps: tuple[str, ...]
    scene: ReportedScene
    events: tuple[Event, ...]
    decisions: ReportedDecisions
    redone: ReportedDecisions
    planned_for: str
    ticks: tuple[bytes, ...] = ()
    pictures: Mapping[str, Any] = field(default_factory=lambda: NO_PICTURES)
    obstacles: Mapping[str, Footprint] = field(default_factory=dict)

    @property
    def drawn(self) -> tuple[ReportedResult, ...]:
        """The results with a tree and curves, in the order of the page."""
        return tuple(self.results[number] for number in self.drawn_numbers)

    @property
    def drawn_numbers(self) -> list[int]:
        """The indices of the drawn results in `results`."""
        return worst_results(self.replayed.results)

    @property
    def decided_ns(self) -> list[int]:
        """The times of the samples that decided the drawn results."""
        return [reported.decided.time_ns for reported in self.drawn if reported.decided is not None]

    @property
    def marked_ns(self) -> list[int]:
        """The times in sentences: deciding samples, samples of least robustness, and starts of events."""
        least_ns = (reported.result.least_at_ns for reported in self.drawn)
        events_ns = sorted(set(map(start_of, self.events)))[:_MOST_MARKED]
        return sorted(
            {*self.decided_ns, *(time_ns for time_ns in least_ns if time_ns is not None), *events_ns}
        )


def worst_results(results: Sequence[SpecResult]) -> list[int]:
    """Return the indices of the results to draw: the first `MOST_DRAWN` of `worst_first`."""
    return worst_first(results)[:MOST_DRAWN]


class NodeSeries(NamedTuple):
    """Curves of some nodes, whose shape the chosen samples must keep.

    Attributes:
        times_ns: (T,) int64, consecutive samples of the run.
        series: (K, 4, T): value, now, lower, upper.
    """

    times_ns: Integers
    series: Floats


def choose_samples(times_ns: Integers, curves: Sequence[NodeSeries], most: int) -> Integers:
    """Return the sorted indices of at most `most` samples that represent a run.

    First come evenly spaced samples, a quarter of `most`, and the first and the last sample of each curve.
    Samples around changes of sign follow, up to five eighths of `most`. The extrema of each curve in equal
    stretches come last. Samples above the limit are thinned evenly.

    Args:
        times_ns: (T,) int64, times of all samples.
        most: limit, at least 8 and at least 4 per curve.
    """
    sample_count = len(times_ns)
    if sample_count <= most:
        return np.arange(sample_count)
    starts = [int(np.searchsorted(times_ns, curve.times_ns[0])) for curve in curves]
    is_chosen = np.zeros(sample_count, np.bool_)
    is_chosen[np.linspace(0, sample_count - 1, most // 4).astype(np.int64)] = True
    for start, curve in zip(starts, curves, strict=True):
        is_chosen[[start, start + len(curve.times_ns) - 1]] = True
    stretch_count = max(1, most // 16)
    for limit, find_samples in (
        (most * 5 // 8, _turns),
        (most, lambda series: _extremes(series, stretch_count)),
    ):
        for start, curve in zip(starts, curves, strict=True):
            _choose(is_chosen, start + find_samples(curve.series), limit)
    return np.flatnonzero(is_chosen)


def _choose(is_chosen: NDArray[np.bool_], samples: Integers, limit: int) -> None:
    """Mark samples as chosen, up to `limit` in all. Too many samples are thinned evenly."""
    new_samples = samples[~is_chosen[samples]]
    free_count = max(0, limit - int(np.count_nonzero(is_chosen)))
    if len(new_samples) > free_count:
        new_samples = new_samples[
            np.linspace(0, len(new_samples), free_count, endpoint=False).astype(np.int64)
        ]
    is_chosen[new_samples] = True


def _turns(series: Floats) -> Integers:
    """Return the samples before and after each change of sign, of `value`, `now`, `lower` or `upper`."""
    change_samples = [np.empty(0, np.int64)]
    for numbers in series.reshape(-1, series.shape[-1]):
        signs = np.where(np.isnan(numbers), 0, np.where(numbers >= 0.0, 1, -1))
        samples_after = np.flatnonzero(np.diff(signs)) + 1
        change_samples += [samples_after - 1, samples_after]
    return np.unique(np.concatenate(change_samples))


def _extremes(series: Floats, stretch_count: int) -> Integers:
    """Return the samples with the least and the greatest value and `now` within each stretch."""
    sample_count = series.shape[-1]
    starts = np.unique(np.linspace(0, sample_count, stretch_count, endpoint=False).astype(np.int64))
    extremes = [np.empty(0, np.int64)]
    for numbers in series[:, :2].reshape(-1, sample_count):
        for placeholder, extreme in ((np.inf, np.minimum), (-np.inf, np.maximum)):
            comparable = np.where(np.isnan(numbers), placeholder, numbers)
            stretch_extremes = np.repeat(
                extreme.reduceat(comparable, starts), np.diff([*starts, sample_count])
            )
            extreme_samples = np.flatnonzero(comparable == stretch_extremes)
            # the first sample with the extreme number in each stretch
            _, first_hits = np.unique(
                np.searchsorted(starts, extreme_samples, side="right"), return_index=True
            )
            extremes.append(extreme_samples[first_hits])
    return np.unique(np.concatenate(extremes))


MOST_VALUES: Final = 4_000_000
"""Limit of a page's numbers, 4 per node and sample; a longer run keeps fewer samples."""
_FEWEST_SAMPLES: Final = 200


@dataclass(frozen=True)
class PageData:
    """Data of the page: facts in JSON, numbers, and notes on omissions.

    Attributes:
        numbers: the text of `Packing.text`.
        omissions: sentences about data that the page leaves out to limit its size.
    """

    facts: Mapping[str, Any]
    numbers: str
    omissions: tuple[str, ...]


def page_data(report: RunReport) -> PageData:
    """Return all data of the page. Equal reports give equal data."""
    packing = Packing()
    reported_results, first_ns = report.drawn, report.replayed.first_ns
    times_ns = np.unique(
        np.concatenate(
            [report.scene.times_ns, *(reported.result.times_ns for reported in reported_results)]
        ).astype(np.int64)
    )
    results = [reported.result for reported in reported_results if len(reported.result.times_ns)]
    curves = [
        NodeSeries(result.times_ns, result.series[list(named_nodes(result.formula))]) for result in results
    ]
    most_samples = _room(reported_results, len(times_ns))
    shown_ns = _shown_times(report, times_ns, most_samples // 2)
    page_ns = np.union1d(times_ns[choose_samples(times_ns, curves, most_samples - len(shown_ns))], shown_ns)
    decisions = decisions_value(report.decisions, report.redone, first_ns, packing)
    facts = {
        "settles": report.replayed.semantics == "ltlf",
        "lengths": report.axes.unit,
        "is_thinned": len(page_ns) < len(times_ns),
        "times": packing.add((page_ns - first_ns) / 1e9, "f8"),
        "palette": {
            **SIGNS,
            # without the two colours of the signs
            "curves": CURVES[2:],
        },
        "results": [_result_value(reported, page_ns, report, packing) for reported in reported_results],
        "scene": scene_value(report.scene, page_ns, first_ns, _places(report), packing),
        "events": event_values(report.events, first_ns),
        "decisions": decisions["decisions"],
        "obstacles": [
            {"name": name, "rings": [ring.ravel().tolist() for ring in outlines_of(obstacle)]}
            for name, obstacle in report.obstacles.items()
        ],
        "ticks": ticks_value(report.ticks, first_ns),
        "camera": dict(report.pictures),
    }
    omissions = tuple(_omissions(report, len(times_ns), len(page_ns), decisions["maps_left_out"]))
    return PageData(facts, packing.text(), omissions)


def _room(results: Sequence[ReportedResult], sample_count: int) -> int:
    """Return the limit of samples in the page."""
    value_count = sum(
        4 * len(shown_nodes(reported.result.formula)) * len(reported.result.times_ns) for reported in results
    )
    return max(_FEWEST_SAMPLES, MOST_VALUES * max(sample_count, 1) // max(value_count, 1))


def _places(report: RunReport) -> Mapping[tuple[int, int], tuple[int, int]]:
    """Map (result, node) to their indices on the page, for all drawn results and shown nodes."""
    return {
        (result_number, node): (page_index, node_index)
        for page_index, result_number in enumerate(report.drawn_numbers)
        for node_index, node in enumerate(shown_nodes(report.results[result_number].result.formula))
    }


def _shown_times(report: RunReport, times_ns: Integers, count_limit: int) -> Integers:
    """Return times that the page always has: times in sentences, starts of events, and times of the scene.

    There are at most `count_limit` times, unless the times in sentences alone exceed the limit. Frames of the
    scene are evenly spaced. All panels have these times, because a cursor shows one sample.
    """
    events_ns = sorted(set(map(start_of, report.events[:MOST_EVENTS])))[: count_limit // 2]
    shown_ns = np.array(sorted({*report.marked_ns, *events_ns}), np.int64)
    scene_limit = max(count_limit - len(shown_ns), 2)
    scene_ns = report.scene.times_ns[:: max(1, -(-len(report.scene.times_ns) // scene_limit))]
    return np.intersect1d(np.concatenate([shown_ns, scene_ns]), times_ns)


def _result_value(
    reported: ReportedResult, page_ns: Integers, report: RunReport, packing: Packing
) -> Mapping[str, Any]:
    first_ns = report.replayed.first_ns
    relations = RELATION_NAMES | reported.file.relations
    samples = np.flatnonzero(np.isin(reported.result.times_ns, page_ns))
    times_ns = reported.result.times_ns[samples]
    # (shown nodes, 4, samples)
    series = reported.result.series[list(shown_nodes(reported.result.formula))][:, :, samples]
    result_facts: dict[str, Any] = {
        **json_fields(reported.result, "title", "name", "object", "verdict"),
        "pointer": _pointer_value(reported, first_ns, report.axes.unit),
        "fault": None if reported.fault_ns is None else (reported.fault_ns - first_ns) / 1e9,
        "first": int(np.searchsorted(page_ns, times_ns[0])) if len(times_ns) else 0,
        "samples": len(times_ns),
        "decided": _place_of(reported),
        "decided_text": _decided_text(reported),
        "left_open": "" if reported.witness is None else open_text(reported.witness),
        "nodes": tree_value(
            reported.result, relations, report.axes.units, reported.tree.calls(reported.file.source)
        ),
        "requirements": requirement_values(reported.result, samples, packing),
        "series": packing.add(singles(series), "f4"),
        "automaton": None,
        "no_automaton": sentence_parts(reported.compiled.reason),
    }
    if reported.compiled.automaton is not None:
        path_indices = np.searchsorted(reported.path.times_ns, times_ns)
        result_facts["automaton"] = {
            **automaton_value(reported.compiled.automaton, reported.path, reported.tree.with_object_name),
            "sets": list(reported.path.sets),
            "path": packing.add(np.array(reported.path.codes)[path_indices], "i4"),
        }
    return result_facts


def _place_of(reported: ReportedResult) -> int | None:
    """Return the index on the page of the node that decided a result; None if the page lacks it."""
    nodes = shown_nodes(reported.result.formula)
    return nodes.index(reported.decided.node) if reported.decided and reported.decided.node in nodes else None


def _decided_text(reported: ReportedResult) -> str:
    """Return the atom with the objects that decided a quantifier; "" if no quantifier decided."""
    if reported.decided is None or reported.deciding is None:
        return ""
    nodes = {identifier: node for identifier, _, node in iter_nodes(reported.result.formula)}
    return reported.deciding.text if isinstance(nodes[reported.decided.node], Quantified) else ""


def _pointer_value(reported: ReportedResult, first_ns: int, lengths: str) -> Mapping[str, Any] | None:
    """Return the arrow at an unsatisfied result's deciding atom, with the time at which it is visible."""
    witness, deciding = reported.witness, reported.deciding
    if reported.fault_ns is None or witness is None or deciding is None or deciding.unknown:
        return None
    if reported.decided != (witness.closest_path or witness.path)[-1]:
        return None  # the number belongs to an earlier sample, with objects at other places
    contact = next(
        (measurement.contact for measurement in deciding.measured if measurement.contact is not None), None
    )
    if contact is None:
        return None
    number, pair = deciding.value * divisor_of(deciding.atom), pair_of(deciding.atom)
    is_response = witness.closest is not None
    # the same words as at the arrow in the log's scene
    holds_text = "must not hold, holds by " if number >= 0 else ""
    return {
        "time": (reported.fault_ns - first_ns) / 1e9,
        "ends": [*map(float, (*contact.first, *contact.second))],
        "text": deciding.text,
        "label": open_text(witness) or f"{holds_text}{with_unit(number, lengths)}",
        "number": json_number(number),
        "is_condition": not is_response and witness.missed is not None and witness.missed.is_condition,
        "is_response": is_response,
        "objects": list(deciding.objects),
        "names": [] if pair is None else entity_ids(pair.names),
    }


def _omissions(report: RunReport, sample_count: int, page_sample_count: int, map_count: int) -> Iterator[str]:
    if page_sample_count < sample_count:
        yield (
            f"Curves and tree have {page_sample_count:,} of {sample_count:,} samples: those at equal"
            " distances, those around changes of sign, and the extremes of every curve in between."
        )
    if report.scene.stride > 1:
        yield (
            f"The scene has one of {report.scene.stride} messages of /spatial/scene, and every sample that "
            "decides, is least or begins an event."
        )
    entities = [entity for _, frame in report.scene.frames[:1] for entity in frame.entities.values()]
    if len(report.results) > 1 and not all(entity.shades for entity in entities):
        yield "The scene has the colours of all results together: there are too many for colours of each."
    if len(report.results) > MOST_DRAWN:
        yield (
            f"Explanations, trees and curves are of {MOST_DRAWN} of {len(report.results):,} results, "
            "the worst."
        )
    if any(len(result.result.values) > MOST_NODES for result in report.drawn):
        yield f"Of trees with more than {MOST_NODES} nodes the uppermost {MOST_NODES} are shown."
    if len(report.events) > MOST_EVENTS:
        yield f"The first {MOST_EVENTS:,} of {len(report.events):,} events are listed."
    if len(report.ticks) > MOST_TICKS:
        yield f"The first {MOST_TICKS:,} of {len(report.ticks):,} ticks of the behaviour tree are shown."
    if map_count:
        yield f"{map_count:,} gradient maps are left out."
