"""What a report is about, and the same as the numbers and texts that its page reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from spatial_replay.automata.automaton import Automaton
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.inspection.report.decisions import Plan, plan_value
from spatial_replay.inspection.report.film import Film, film_value
from spatial_replay.inspection.report.happenings import MOST_EVENTS, Happening, happening_values
from spatial_replay.inspection.report.packing import Packing, singles
from spatial_replay.inspection.report.states import StatePath, automaton_value
from spatial_replay.inspection.report.thinning import Curves, kept_samples
from spatial_replay.inspection.report.tree import (
    MOST_NODES,
    final_text,
    named_nodes,
    series_of,
    shown_nodes,
    tree_value,
)
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.monitor.verdict import Verdict, worst_verdict
from spatial_replay.palette import CURVES, NEGATIVE, NEUTRAL, POSITIVE, hexadecimal
from spatial_replay.spec.formula import Formula, Specification

MOST_VALUES: Final = 4_000_000
"""How many numbers of nodes at samples a page holds; of a longer run it keeps fewer samples."""
MOST_DRAWN: Final = 24
"""How many results a page explains and has trees and curves of: the worst; it has the verdicts of all."""
_FEWEST_SAMPLES: Final = 200


@dataclass(frozen=True, eq=False)
class ReportedResult:
    """One result, with all that was found of it.

    Attributes:
        name: the name that it is reported under.
        object: the object that a template's parameter stands for, or None.
        relations: the names of relations that its file may use.
        robustness: (N,), each node's value on the whole log.
        final: (N, 2), lower and upper end of each node for the finished log.
        first_satisfied_ns: the first sample with a value of at least 0, or None.
        times_ns, series: (T,) and (N, 4, T): value, now, lower, upper of each node.
        sentences: why its verdict is what it is; none where that was not asked.
        automaton: None if it has none.
        no_automaton: why not.
        path: where the run is in it.
    """

    name: str
    object: str | None
    formula: Formula
    relations: frozenset[str]
    verdict: Verdict
    robustness: Floats
    final: Floats
    first_satisfied_ns: int | None
    times_ns: Integers
    series: Floats
    sentences: tuple[str, ...]
    automaton: Automaton | None
    no_automaton: str
    path: StatePath

    @property
    def title(self) -> str:
        return self.name if self.object is None else f"{self.name}({self.object})"

    @property
    def robustness_text(self) -> str:
        """The root's robustness, or between which numbers it lies."""
        return final_text(float(self.robustness[0]), *self.final[0].tolist())


@dataclass(frozen=True, eq=False)
class Report:
    """A run and what was found of it.

    Attributes:
        log: base name of the log.
        first_ns, start_ns, end_ns: times of the log's first sample, and of the first and last evaluated.
        faults, remarks: what was lost, and what else the log says of its samples.
        unreadable: how many observations are there and say nothing.
    """

    log: str
    samples: int
    first_ns: int
    start_ns: int
    end_ns: int
    faults: tuple[str, ...]
    remarks: tuple[str, ...]
    unreadable: int
    semantics: Semantics
    certificate: Mapping[str, str]
    files: tuple[Specification, ...]
    results: tuple[ReportedResult, ...]
    film: Film
    happenings: tuple[Happening, ...]
    plan: Plan

    @property
    def verdict(self) -> Verdict:
        return worst_verdict(result.verdict for result in self.results)

    @property
    def drawn(self) -> tuple[ReportedResult, ...]:
        """The results that have a tree and curves on the page, in order: the worst if they are too many."""
        chosen = worst_results([result.verdict for result in self.results])
        return tuple(self.results[number] for number in chosen)


def worst_results(verdicts: Sequence[Verdict]) -> list[int]:
    """Which results are looked into, in order: `MOST_DRAWN` of them at most."""
    return sorted(worst_first(verdicts)[:MOST_DRAWN])


def worst_first(verdicts: Sequence[Verdict]) -> list[int]:
    """The places of results: those violated, those unknown, the others, each kind in order."""
    severity = {Verdict.VIOLATED: 0, Verdict.UNKNOWN: 1}
    return sorted(range(len(verdicts)), key=lambda number: severity.get(verdicts[number], 2))


@dataclass(frozen=True)
class PageData:
    """What the page reads: facts that JSON can hold, numbers, and what it does not have.

    Attributes:
        numbers: of `Packing.text`.
        omissions: sentences on what is left out for the sake of its size.
    """

    facts: Mapping[str, Any]
    numbers: str
    omissions: tuple[str, ...]


def page_data(report: Report) -> PageData:
    """Everything that the page draws; equal reports give equal data."""
    packing = Packing()
    drawn = report.drawn
    times_ns = np.unique(
        np.concatenate([report.film.times_ns, *(result.times_ns for result in drawn)]).astype(np.int64)
    )
    curves = [_curves(each) for each in drawn if len(each.times_ns)]
    kept = times_ns[kept_samples(times_ns, curves, _room(drawn, len(times_ns)))]
    plan = plan_value(report.plan, report.first_ns, packing)
    facts = {
        "settles": report.semantics == "ltlf",
        "times": packing.add((kept - report.first_ns) / 1e9, "f8"),
        "palette": {
            "positive": hexadecimal(POSITIVE),
            "negative": hexadecimal(NEGATIVE),
            "neutral": hexadecimal(NEUTRAL),
            # without those of the signs
            "curves": CURVES[2:],
        },
        "results": [_result_value(each, kept, packing) for each in drawn],
        "film": film_value(report.film, report.first_ns, packing),
        "events": happening_values(report.happenings, report.first_ns),
        "decisions": plan["decisions"],
    }
    omissions = tuple(_omissions(report, len(times_ns), len(kept), plan["maps_left_out"]))
    return PageData(facts, packing.text(), omissions)


def _room(results: Sequence[ReportedResult], samples: int) -> int:
    """How many samples there is room for."""
    values = sum(4 * len(shown_nodes(each.formula)) * len(each.times_ns) for each in results)
    return max(_FEWEST_SAMPLES, MOST_VALUES * max(samples, 1) // max(values, 1))


def _curves(result: ReportedResult) -> Curves:
    return Curves(result.times_ns, result.series[list(named_nodes(result.formula))])


def _result_value(result: ReportedResult, kept: Integers, packing: Packing) -> Mapping[str, Any]:
    samples = np.flatnonzero(np.isin(result.times_ns, kept))
    here = result.times_ns[samples]
    series = series_of(result.series, result.formula, samples)
    value: dict[str, Any] = {
        "title": result.title,
        "name": result.name,
        "object": result.object,
        "verdict": str(result.verdict),
        "first": int(np.searchsorted(kept, here[0])) if len(here) else 0,
        "samples": len(here),
        "nodes": tree_value(result.formula, result.robustness, result.final, result.relations),
        "series": packing.add(singles(series), "f4"),
        "automaton": None,
        "no_automaton": result.no_automaton,
    }
    if result.automaton is not None:
        inside = np.searchsorted(result.path.times_ns, here)
        value["automaton"] = {
            **automaton_value(result.automaton, result.path),
            "sets": result.path.sets,
            "path": packing.add(result.path.codes[inside], "i4"),
        }
    return value


def _omissions(report: Report, samples: int, kept: int, maps: int) -> Sequence[str]:
    said = []
    if kept < samples:
        said.append(
            f"Curves and tree have {kept:,} of {samples:,} samples: those at equal distances, those around "
            "changes of sign, and the extremes of every curve in between."
        )
    if report.film.stride > 1:
        said.append(f"The scene has every {_ordinal(report.film.stride)} message of /spatial/scene.")
    if len(report.results) > MOST_DRAWN:
        said.append(
            f"Explanations, trees and curves are of {MOST_DRAWN} of {len(report.results):,} results, "
            "the worst."
        )
    if any(len(result.robustness) > MOST_NODES for result in report.drawn):
        said.append(f"Of trees with more than {MOST_NODES} nodes the uppermost {MOST_NODES} are shown.")
    if len(report.happenings) > MOST_EVENTS:
        said.append(f"The first {MOST_EVENTS:,} of {len(report.happenings):,} events are listed.")
    if maps:
        said.append(f"{maps:,} gradient maps are left out.")
    return said


def _ordinal(number: int) -> str:
    ends = {2: "nd", 3: "rd"} if number % 100 not in (12, 13) else {}
    return f"{number}{ends.get(number % 10, 'th')}"
