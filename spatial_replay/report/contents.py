"""The facts of a report, as they are collected from a run and before they are laid out on a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from spatial_replay.annotate.specification import ReportedTree
from spatial_replay.automata.automaton import Automaton
from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.result import NodeResult, SpecResult, worst_first
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.monitor.vacuity import UntestedPart
from spatial_replay.monitor.verdict import Verdict, worst_verdict
from spatial_replay.report.automaton_panel import StatePath
from spatial_replay.report.decision_panel import ReportedDecisions
from spatial_replay.report.event_panel import ReportedEvent
from spatial_replay.report.picture_panel import NO_PICTURES, ReportedPictures
from spatial_replay.report.scene_panel import ReportedScene
from spatial_replay.report.tree_panel import final_text
from spatial_replay.spec.formula import Formula, NamedSpec, Specification
from spatial_replay.spec.units import Unit
from spatial_replay.text import Sentence
from spatial_replay.trace.axes import Axes

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
        observed_ns: from when on all is observed that unknown results are about; or None.
        unreadable: how many observations have no finite numbers.
        declared_units: those of signals by their names, and of lengths by "".
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
    declared_units: Mapping[str, str]
    semantics: Semantics
    certificate: Mapping[str, str]
    files: tuple[Specification, ...]
    results: tuple[ReportedResult, ...]
    vacuous: tuple[UntestedPart, ...]
    observed_ns: int | None
    scene: ReportedScene
    events: tuple[ReportedEvent, ...]
    decisions: ReportedDecisions
    pictures: ReportedPictures = NO_PICTURES

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
