"""The content of a report: what it keeps of a run, and its facts as JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.annotate.specification import ReportedTree
from spatial_replay.automata.automaton import Automaton
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.result import NodeResult, SpecResult, worst_first
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.monitor.vacuity import UntestedPart
from spatial_replay.monitor.verdict import Verdict, worst_verdict
from spatial_replay.palette import CURVES, NEGATIVE, NEUTRAL, POSITIVE, hexadecimal
from spatial_replay.report.compact import Packing, sentence_parts, singles
from spatial_replay.report.panels import (
    MOST_EVENTS,
    MOST_NODES,
    NO_PICTURES,
    ReportedDecisions,
    ReportedEvent,
    ReportedPictures,
    ReportedScene,
    StatePath,
    automaton_value,
    decisions_value,
    event_values,
    final_text,
    named_nodes,
    picture_values,
    requirement_values,
    scene_value,
    series_of,
    shown_nodes,
    tree_value,
)
from spatial_replay.spec.formula import Formula, NamedSpec, Specification
from spatial_replay.spec.walks import Unit
from spatial_replay.text import Sentence, json_number
from spatial_replay.trace.units import Axes

MANY: Final = 6
"""More results are counted, sorted and can be filtered; only the explanation of the first is unfolded."""
MOST_DRAWN: Final = 24
"""Results with an explanation, a tree and curves, at most: the worst. All have their verdicts."""


class Pointer(NamedTuple):
    """The atom that decided a verdict, as an arrow in the scene.

    Attributes:
        ends: (2, 2), from where to where it points.
        text: the atom's.
        number: its robustness, in the unit of the log where `scale` divides it.
        is_condition: whether it is in the condition of an implication, whose response is what was missed.
        is_response: whether it is what came nearest to such a response.
        objects: what it is about.
    """

    ends: Floats
    text: str
    number: float
    is_condition: bool = False
    is_response: bool = False
    objects: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ReportedResult:
    """One result of a run, with its explanation and its path through its automaton.

    Attributes:
        tree: under which it is reported.
        source: the text of its file.
        relations: the names of relations that its file may use.
        sentences: the explanation of its verdict; none if the page does not explain it.
        decided_ns: the sample that decided it; None without an explanation.
        decided_node: the id of the node that decided it; None without an explanation.
        decided_text: the atom of the objects that decided it, where that node is a quantifier, or "".
        left_open: between which numbers that atom lies, if its uncertainty leaves the verdict open, or "".
        pointer: the two points between which the atom that decided it stands; None if it has none.
        named: the specs of its file, by name.
        units: those of the numbers that its robustness is the least of.
        unit: that of its robustness, if it is declared, or "".
        automaton: None if it has none.
        no_automaton: why not.
        path: the states of the run.
    """

    result: SpecResult
    tree: ReportedTree
    source: str
    relations: frozenset[str]
    sentences: tuple[Sentence, ...]
    decided_ns: int | None
    decided_node: int | None
    decided_text: str
    left_open: str
    pointer: Pointer | None
    named: Mapping[str, NamedSpec]
    units: tuple[Unit, ...]
    unit: str
    automaton: Automaton | None
    no_automaton: str
    path: StatePath

    @property
    def specs(self) -> Iterator[NodeResult]:
        """Yield the root of each named spec within the formula, once, in the order of the text."""
        names = {self.result.nodes[0].name}
        for node in self.result.nodes[1:]:
            if node.name is not None and node.name not in names:
                names.add(node.name)
                yield node

    @property
    def fault_ns(self) -> int | None:
        """The sample that made it violated or unknown."""
        return None if self.result.verdict is Verdict.SATISFIED else self.decided_ns

    @property
    def robustness_text(self) -> str:
        """The root's robustness with its unit, or between which numbers it lies."""
        return final_text(self.result.robustness, self.result.lower, self.result.upper, self.unit)

    @property
    def formula(self) -> Formula:
        """Its formula, with the object that it is about in place of a template's parameter."""
        return self.result.evidence.bound(self.result.formula)


@dataclass(frozen=True, eq=False)
class RunReport:
    """A run with its results.

    Attributes:
        log: base name of the log.
        first_ns, start_ns, end_ns: times of the log's first sample, and of the first and last evaluated.
        axes: those of the source, as opposed to those of the samples.
        faults, remarks: what was lost while reading, and other notes of the reader.
        vacuous: templates that no object fits.
        gaps: sentences on what unknown results lack before or after a time.
        unreadable: how many observations have no finite numbers.
        planned_for: the file that decisions were made for, if another one is evaluated; else "".
    """

    log: str
    samples: int
    first_ns: int
    start_ns: int
    end_ns: int
    axes: Axes
    faults: tuple[str, ...]
    remarks: tuple[str, ...]
    unreadable: int
    semantics: Semantics
    certificate: Mapping[str, str]
    files: tuple[Specification, ...]
    results: tuple[ReportedResult, ...]
    vacuous: tuple[UntestedPart, ...]
    gaps: tuple[str, ...]
    scene: ReportedScene
    events: tuple[ReportedEvent, ...]
    decisions: ReportedDecisions
    pictures: ReportedPictures = NO_PICTURES
    planned_for: str = ""

    @property
    def verdict(self) -> Verdict:
        return worst_verdict(each.result.verdict for each in self.results)

    @property
    def drawn(self) -> tuple[ReportedResult, ...]:
        """The results that have a tree and curves on the page, in order."""
        return tuple(self.results[number] for number in self.drawn_numbers)

    @property
    def drawn_numbers(self) -> list[int]:
        """The places of those results."""
        return worst_results([each.result for each in self.results])


def worst_results(results: Sequence[SpecResult]) -> list[int]:
    """Return which results are explained and drawn, in the order of `worst_first`: `MOST_DRAWN` at most."""
    return worst_first(results)[:MOST_DRAWN]


class NodeSeries(NamedTuple):
    """The numbers of some nodes, which the chosen samples must represent.

    Attributes:
        times_ns: (T,) int64, consecutive samples of the run.
        series: (K, 4, T): value, now, lower, upper.
    """

    times_ns: Integers
    series: Floats


def choose_samples(times_ns: Integers, curves: Sequence[NodeSeries], most: int) -> Integers:
    """Return the indices of the samples to keep, in order: all of them, or at most `most`.

    Samples of a run that is too long are chosen in this order, as long as there is room: the first and the
    last of all and of each curve, others at equal distances, those around changes of sign, and the extrema of
    each curve within a stretch. If the room does not suffice, they are spread over the run.

    Args:
        times_ns: (T,) int64, of all samples.
        most: at least 8, and 4 for each of the curves.
    """
    count = len(times_ns)
    if count <= most:
        return np.arange(count)
    starts = [int(np.searchsorted(times_ns, each.times_ns[0])) for each in curves]
    chosen = np.zeros(count, np.bool_)
    chosen[np.linspace(0, count - 1, most // 4).astype(np.int64)] = True
    for start, each in zip(starts, curves, strict=True):
        chosen[[start, start + len(each.times_ns) - 1]] = True
    stretches = max(1, most // 16)
    for limit, found_in in ((most * 5 // 8, _turns), (most, lambda series: _extremes(series, stretches))):
        for start, each in zip(starts, curves, strict=True):
            _choose(chosen, start + found_in(each.series), limit)
    return np.flatnonzero(chosen)


def _choose(chosen: NDArray[np.bool_], samples: Integers, most: int) -> None:
    """Add samples as long as no more than `most` are chosen."""
    new = samples[~chosen[samples]]
    room = max(0, most - int(np.count_nonzero(chosen)))
    if len(new) > room:
        new = new[np.linspace(0, len(new), room, endpoint=False).astype(np.int64)]
    chosen[new] = True


def _turns(series: Floats) -> Integers:
    """Return the samples on both sides of a change of sign: of a number, or of an end of its interval."""
    found = [np.empty(0, np.int64)]
    for numbers in series.reshape(-1, series.shape[-1]):
        sign = np.where(np.isnan(numbers), 0, np.where(numbers >= 0.0, 1, -1))
        after = np.flatnonzero(np.diff(sign)) + 1
        found += [after - 1, after]
    return np.unique(np.concatenate(found))


def _extremes(series: Floats, stretches: int) -> Integers:
    """Return where value and now are least and greatest within each of so many stretches."""
    count = series.shape[-1]
    starts = np.unique(np.linspace(0, count, stretches, endpoint=False).astype(np.int64))
    found = [np.empty(0, np.int64)]
    for numbers in series[:, :2].reshape(-1, count):
        for infinite, extreme in ((np.inf, np.minimum), (-np.inf, np.maximum)):
            known = np.where(np.isnan(numbers), infinite, numbers)
            best = np.repeat(extreme.reduceat(known, starts), np.diff([*starts, count]))
            hits = np.flatnonzero(known == best)
            # the first in each stretch
            _, first = np.unique(np.searchsorted(starts, hits, side="right"), return_index=True)
            found.append(hits[first])
    return np.unique(np.concatenate(found))


MOST_VALUES: Final = 4_000_000
"""Numbers of nodes at samples in a page, at most; a longer run keeps fewer samples."""
_FEWEST_SAMPLES: Final = 200


@dataclass(frozen=True)
class PageData:
    """Data of the page: facts in JSON, numbers, and notes on omissions.

    Attributes:
        numbers: of `Packing.text`.
        omissions: sentences on what is left out to limit the size of the page.
    """

    facts: Mapping[str, Any]
    numbers: str
    omissions: tuple[str, ...]


def page_data(report: RunReport) -> PageData:
    """Return everything that the page draws; equal reports give equal data."""
    packing = Packing()
    drawn = report.drawn
    times_ns = np.unique(
        np.concatenate([report.scene.times_ns, *(each.result.times_ns for each in drawn)]).astype(np.int64)
    )
    curves = [_curves(each) for each in drawn if len(each.result.times_ns)]
    room = _room(drawn, len(times_ns))
    shown_ns = _shown_times(report, times_ns, room // 2)
    kept = np.union1d(times_ns[choose_samples(times_ns, curves, room - len(shown_ns))], shown_ns)
    scene = report.scene.at(kept)
    decisions = decisions_value(report.decisions, report.first_ns, packing)
    facts = {
        "settles": report.semantics == "ltlf",
        "lengths": report.axes.unit,
        "is_thinned": len(kept) < len(times_ns),
        "times": packing.add((kept - report.first_ns) / 1e9, "f8"),
        "palette": {
            "positive": hexadecimal(POSITIVE),
            "negative": hexadecimal(NEGATIVE),
            "neutral": hexadecimal(NEUTRAL),
            # without those of the signs
            "curves": CURVES[2:],
        },
        "results": [_result_value(each, kept, report, packing) for each in drawn],
        "scene": scene_value(scene, report.first_ns, _places(report), packing),
        "events": event_values(report.events, report.first_ns),
        "decisions": decisions["decisions"],
        "camera": picture_values(report.pictures, report.first_ns),
    }
    omissions = tuple(_omissions(report, len(times_ns), len(kept), decisions["maps_left_out"]))
    return PageData(facts, packing.text(), omissions)


def _room(results: Sequence[ReportedResult], samples: int) -> int:
    """Return how many samples fit."""
    values = sum(4 * len(shown_nodes(each.result.formula)) * len(each.result.times_ns) for each in results)
    return max(_FEWEST_SAMPLES, MOST_VALUES * max(samples, 1) // max(values, 1))


def _places(report: RunReport) -> Mapping[tuple[int, int], tuple[int, int]]:
    """Return the places on the page of the run's results and their nodes, as far as it shows them."""
    return {
        (number, node): (index, place)
        for index, number in enumerate(report.drawn_numbers)
        for place, node in enumerate(shown_nodes(report.results[number].result.formula))
    }


def _curves(each: ReportedResult) -> NodeSeries:
    return NodeSeries(each.result.times_ns, each.result.series[list(named_nodes(each.result.formula))])


def _shown_times(report: RunReport, times_ns: Integers, most: int) -> Integers:
    """Return samples that the page has whatever else it leaves out: `most` at most, but what decided.

    They are the samples that decided a verdict, the samples of events and, if there is room, samples of the
    scene at equal distances. At one cursor, the page shows one sample.
    """
    decided_ns = [each.decided_ns for each in report.drawn if each.decided_ns is not None]
    events_ns = sorted({each.start_ns for each in report.events[:MOST_EVENTS]})[: most // 2]
    shown_ns = np.array([*decided_ns, *events_ns], np.int64)
    room = max(most - len(shown_ns), 2)
    scene_ns = report.scene.times_ns[:: max(1, -(-len(report.scene.times_ns) // room))]
    return np.intersect1d(np.concatenate([shown_ns, scene_ns]), times_ns)


def _result_value(
    each: ReportedResult, kept: Integers, report: RunReport, packing: Packing
) -> Mapping[str, Any]:
    first_ns = report.first_ns
    samples = np.flatnonzero(np.isin(each.result.times_ns, kept))
    here = each.result.times_ns[samples]
    series = series_of(each.result.series, each.result.formula, samples)
    value: dict[str, Any] = {
        "title": each.result.title,
        "name": each.result.name,
        "object": each.result.object,
        "verdict": str(each.result.verdict),
        "pointer": _pointer_value(each, first_ns, report.axes.unit),
        "fault": None if each.fault_ns is None else (each.fault_ns - first_ns) / 1e9,
        "first": int(np.searchsorted(kept, here[0])) if len(here) else 0,
        "samples": len(here),
        "decided": _place_of(each),
        "decided_text": each.decided_text,
        "left_open": each.left_open,
        "nodes": tree_value(
            each.formula,
            each.result.values,
            each.result.final,
            each.relations,
            report.axes.units,
            each.tree.calls(each.source),
        ),
        "requirements": requirement_values(each.result, samples, packing),
        "series": packing.add(singles(series), "f4"),
        "automaton": None,
        "no_automaton": sentence_parts(each.no_automaton),
    }
    if each.automaton is not None:
        inside = np.searchsorted(each.path.times_ns, here)
        value["automaton"] = {
            **automaton_value(each.automaton, each.path, each.tree.named),
            "sets": each.path.sets,
            "path": packing.add(each.path.codes[inside], "i4"),
        }
    return value


def _place_of(each: ReportedResult) -> int | None:
    """Return the place on the page of the node that decided a result."""
    shown = shown_nodes(each.result.formula)
    return shown.index(each.decided_node) if each.decided_node in shown else None


def _pointer_value(each: ReportedResult, first_ns: int, lengths: str) -> Mapping[str, Any] | None:
    """Return the arrow at what decided a result that is not satisfied, and when it is shown."""
    if each.pointer is None or each.fault_ns is None:
        return None
    # as the arrow of the log's scene says it
    holds = "must not hold, holds by " if each.pointer.number >= 0 else ""
    return {
        "time": (each.fault_ns - first_ns) / 1e9,
        "ends": each.pointer.ends.reshape(-1).tolist(),
        "text": each.pointer.text,
        "label": each.left_open or f"{holds}{each.pointer.number:.3g} {lengths}".rstrip(),
        "number": json_number(each.pointer.number),
        "is_condition": each.pointer.is_condition,
        "is_response": each.pointer.is_response,
        "objects": list(each.pointer.objects),
    }


def _omissions(report: RunReport, samples: int, kept: int, maps: int) -> Iterator[str]:
    if kept < samples:
        yield (
            f"Curves and tree have {kept:,} of {samples:,} samples: those at equal distances, those around "
            "changes of sign, and the extremes of every curve in between."
        )
    if report.scene.stride > 1:
        yield f"The scene has one of {report.scene.stride} messages of /spatial/scene."
    drawn = [each for frame in report.scene.frames[:1] for each in frame.entities.values()]
    if len(report.results) > 1 and not all(each.shades for each in drawn):
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
    if maps:
        yield f"{maps:,} gradient maps are left out."
