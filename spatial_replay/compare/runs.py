"""Two runs side by side: where they part, who moved differently, and what that did to each spec."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from spatial_replay.compare.alignment import (
    Alignment,
    ObjectDiff,
    Parting,
    align_runs,
    compare_objects,
    parting_of,
)
from spatial_replay.compare.decision_diff import DecisionDiff, compare_decisions
from spatial_replay.errors import UsageError
from spatial_replay.lazy import Displayed
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import CERTIFICATE
from spatial_replay.monitor.evaluate import Evaluation, evaluate
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.semantics import require_ltlf
from spatial_replay.monitor.sentences import number_text, reason_sentence
from spatial_replay.replay.selection import DEFAULT_OPTIONS, LogNames, ReplayOptions, Selection
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.formula import Atom, Specification, iter_nodes
from spatial_replay.spec.walks import other_names
from spatial_replay.text import Instant, Sentence, counted, json_number
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace

_MOST_LISTED: Final = 12


@dataclass(frozen=True, eq=False)
class RunSpecDiff:
    """One result in two runs.

    Attributes:
        a, b: the results.
        first_ns: the first sample of A with a value of another sign than the one beside it in B, or None.
        nodes: ids of the deepest nodes whose verdicts differ.
        parting: where the runs part in its automaton; None if the verdict is the same, or it has none.
        moved: the objects that the deciding atoms are about, as far as they moved differently.
    """

    a: SpecResult
    b: SpecResult
    first_ns: int | None
    nodes: tuple[int, ...]
    parting: Parting | None
    moved: tuple[ObjectDiff, ...]

    @property
    def is_flipped(self) -> bool:
        """Whether the verdict differs."""
        return self.a.verdict is not self.b.verdict

    @property
    def is_different(self) -> bool:
        """Whether the verdict or a final number differs."""
        one, other = ((each.robustness, each.lower, each.upper) for each in (self.a, self.b))
        return self.is_flipped or not np.array_equal(one, other, equal_nan=True)

    def sentences(self, starts_ns: tuple[int, int]) -> Iterator[Sentence]:
        """Yield what differs; times of each run count from its own start."""
        texts = [f"{each.verdict} ({number_text(each.robustness)})" for each in (self.a, self.b)]
        yield Sentence(" | ".join(texts) + ("" if self.is_different else ", the same"))
        if self.first_ns is not None:
            yield Sentence("the sign of its value differs since ", Instant(self.first_ns, starts_ns[0]))
        if self.parting is not None:
            where = self.parting
            yield Sentence(
                "they part in the automaton: ",
                *_entered(where.a_ns, where.a_states, starts_ns[0]),
                " | ",
                *_entered(where.b_ns, where.b_states, starts_ns[1]),
            )
        for node in self.nodes:
            yield Sentence(f"brought about by `{self.a.nodes[node].text}`")
        for which, result, start_ns in zip("AB", (self.a, self.b), starts_ns, strict=True):
            if self.is_flipped and result.causes and result.causes[0].witness is not None:
                reason = reason_sentence(result.causes[0].witness, first_ns=start_ns)
                yield Sentence(f"{which}: ", *reason.parts)
        if self.moved:
            names = ", ".join(each.name for each in self.moved)
            yield Sentence(f"of what it is about, these moved differently: {names}")

    @property
    def document(self) -> dict[str, Any]:
        """The same as values for JSON."""
        parting = self.parting
        return {
            "name": self.a.name,
            "object": self.a.object,
            "flipped": self.is_flipped,
            "a": _result_value(self.a),
            "b": _result_value(self.b),
            "first_ns": self.first_ns,
            "nodes": [{"id": node, "text": self.a.nodes[node].text} for node in self.nodes],
            "parting": None
            if parting is None
            else {
                "a_ns": parting.a_ns,
                "b_ns": parting.b_ns,
                "a_states": list(parting.a_states),
                "b_states": list(parting.b_states),
            },
            "moved": [each.name for each in self.moved],
        }


@dataclass(frozen=True, eq=False)
class LogDiff(Displayed):
    """Two runs side by side.

    Attributes:
        a, b: the names of the logs.
        samples: how many each has, where they were compared.
        starts_ns: the times of their first samples, which sentences count from.
        is_certified: whether the certificates say that samples and messages are equal; nothing else was read.
        alignment: how samples correspond; None if nothing differs.
        objects: those that moved differently, the first apart first.
        only_a, only_b: objects that one run never has, and results of templates for them.
        specs: results of both runs.
        decision: the first decision that differs; None if none does, or the runs were not planned.
        has_equal_samples: whether all samples are equal.
        faults: what was lost while reading.
        missing: a warning for each name in the specifications that a log never has.
        traces: the samples; None if the certificates say that they are equal.
    """

    a: str
    b: str
    samples: tuple[int, int]
    starts_ns: tuple[int, int]
    is_certified: bool
    alignment: Alignment | None
    objects: tuple[ObjectDiff, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    specs: tuple[RunSpecDiff, ...]
    decision: DecisionDiff | None
    has_equal_samples: bool
    faults: tuple[str, ...]
    traces: tuple[Trace, Trace] | None = None
    missing: tuple[Diagnostic, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether nothing differs: no sample, no result, no decision."""
        return self.is_certified or (self.has_equal_samples and self.decision is None)

    def lines(self) -> Iterator[str]:
        """Yield the diff as text, as the command `diff` prints it."""
        yield f"A {self.a} | B {self.b}"
        if self.is_certified:
            yield "  the same samples and messages, by their certificates"
            return
        if self.is_empty:
            yield f"  the same {counted(self.samples[0], 'sample')}"
            return
        if self.alignment is not None:
            pairs = counted(len(self.alignment.a), "pair")
            counts = " | ".join(counted(count, "sample") for count in self.samples)
            yield f"  {counts}; {self.alignment}: {pairs} of samples"
        start_ns = self.starts_ns[0]
        for each in self.objects[:_MOST_LISTED]:
            yield f"  {each.name}: {movement_sentence(each, start_ns)}"
        if len(self.objects) > _MOST_LISTED:
            yield f"  and {counted(len(self.objects) - _MOST_LISTED, 'other object')} moved differently"
        for which, names in (("A", self.only_a), ("B", self.only_b)):
            if names:
                yield f"  only in {which}: {', '.join(names[:_MOST_LISTED])}"
        for spec in self.specs:
            first, *rest = spec.sentences(self.starts_ns)
            yield f"  {spec.a.title}: {first}"
            if spec.is_different:
                yield from (f"    {sentence}" for sentence in rest)
        if self.decision is not None:
            yield f"  decision {self.decision.number} is the first that differs:"
            yield f"    A: {self.decision.a}"
            yield f"    B: {self.decision.b}"
            if self.decision.maps:
                yield f"    gradient maps that differ: {', '.join(self.decision.maps)}"

    @property
    def document(self) -> dict[str, Any]:
        """The diff as values for JSON."""
        return {
            "a": self.a,
            "b": self.b,
            "same": self.is_empty,
            "certified": self.is_certified,
            "damaged": bool(self.faults),
            "alignment": None
            if self.alignment is None
            else {
                "kind": self.alignment.kind,
                "about": self.alignment.about,
                "knots": [list(knot) for knot in self.alignment.knots],
                "pairs": len(self.alignment.a),
            },
            "objects": [
                {
                    "name": each.name,
                    "first_ns": each.first_ns,
                    "apart_ns": each.apart_ns,
                    "greatest_distance": json_number(each.greatest),
                    "greatest_ns": each.greatest_ns,
                    "greatest_shift": json_number(each.shift),
                    "samples_only_in_a": each.only_a,
                    "samples_only_in_b": each.only_b,
                }
                for each in self.objects
            ],
            "only_a": list(self.only_a),
            "only_b": list(self.only_b),
            "specifications": [each.document for each in self.specs],
            "decision": None
            if self.decision is None
            else {**self.decision._asdict(), "maps": list(self.decision.maps)},
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
    """Compare two logs; if their certificates say that they are equal, no sample is read.

    Args:
        options: how each log is evaluated.
        advance: called with the number of samples of each block that is read.

    Raises:
        UsageError: what `compare_runs` raises. LogError: a log cannot be read.
        SpecificationError: names that a log never has, if names are strict.
    """
    for own in options:
        require_ltlf(own.semantics, "a diff")
    is_whole = all(each.window.is_whole for each in options)
    if is_whole and align == "time" and same_by_certificate(*sources):
        names = sources[0].name, sources[1].name
        return LogDiff(*names, (0, 0), (0, 0), True, None, (), (), (), (), None, True, ())
    selections = [
        Selection(source, tuple(files), replace(each, keep=()))
        for source, each in zip(sources, options, strict=True)
    ]
    traces = selections[0].trace(advance), selections[1].trace(advance)
    missing: list[Diagnostic] = []
    for selection, trace in zip(selections, traces, strict=True):
        if not len(selection.inside(trace)):
            raise selection.nothing_to_evaluate(trace.faults)
        known = LogNames()
        known.add(trace)
        missing += selection.missing_names(known)
    windows = [(each.window.start_ns, each.window.end_ns) for each in options]
    diff = compare_runs(
        sources, traces, files, align=align, each=options[0].each, windows_ns=(windows[0], windows[1])
    )
    return replace(diff, missing=tuple(dict.fromkeys(missing)))


def same_by_certificate(one: Source, other: Source) -> bool:
    """Say whether two logs have certificates of equal samples and messages."""
    hashes = [
        tuple(dict(source.metadata()).get(CERTIFICATE, {}).get(key) for key in _CERTIFIED)
        for source in (one, other)
    ]
    return None not in hashes[0] and hashes[0] == hashes[1]


_CERTIFIED: Final = ("samples_sha256", "messages_sha256")


def compare_runs(
    sources: tuple[Source, Source],
    traces: tuple[Trace, Trace],
    files: Sequence[Specification] = (),
    *,
    align: str = "time",
    each: Mapping[str, str] | None = None,
    windows_ns: tuple[tuple[int, int], tuple[int, int]] = ((0, FOREVER), (0, FOREVER)),
) -> LogDiff:
    """Compare two runs and what specifications say of them.

    Args:
        traces: their samples.
        align: "time" since the first sample, "progress" of the first spec with an automaton, or the name of a
            spec, whose first change of sign in each run is the event.
        each: for each parameter of a template, the objects that it stands for.
        windows_ns: of each run, from which time to before which specs are evaluated.

    Raises:
        UsageError: no sample in a run, no common object, other units, nothing to align by.
    """
    for source, trace in zip(sources, traces, strict=True):
        if not len(trace):
            raise UsageError(
                f"{source.name} has no sample in the requested window; there is nothing to compare"
            )
    a, b = traces
    evaluations = [
        _evaluated(trace, files, each, window) for trace, window in zip(traces, windows_ns, strict=True)
    ]
    results = _paired(evaluations)
    alignment = align_runs((a.times_ns, b.times_ns), results, files, align)
    objects = compare_objects(a, b, alignment)
    titles = [{result.title for evaluation in own for result in evaluation} for own in evaluations]
    return LogDiff(
        sources[0].name,
        sources[1].name,
        (len(a), len(b)),
        (int(a.times_ns[0]), int(b.times_ns[0])),
        False,
        alignment,
        objects,
        tuple(sorted(set(a.names) - set(b.names)) + sorted(titles[0] - titles[1])),
        tuple(sorted(set(b.names) - set(a.names)) + sorted(titles[1] - titles[0])),
        tuple(_spec_diff(one, other, alignment, traces, objects, files) for one, other in results),
        compare_decisions(sources),
        not objects and a == b,
        (*a.faults, *b.faults),
        traces,
    )


def _evaluated(
    trace: Trace, files: Sequence[Specification], each: Mapping[str, str] | None, window_ns: tuple[int, int]
) -> list[Evaluation]:
    parameters = [{spec.parameter for spec in file.results} for file in files]
    return [
        evaluate(
            file,
            trace,
            start_ns=window_ns[0],
            end_ns=window_ns[1],
            each={name: choice for name, choice in (each or {}).items() if name in own},
        )
        for file, own in zip(files, parameters, strict=True)
    ]


def _paired(evaluations: Sequence[Sequence[Evaluation]]) -> list[tuple[SpecResult, SpecResult]]:
    pairs = []
    for one, other in zip(*evaluations, strict=True):
        named = {result.title: result for result in other}
        pairs += [(result, named[result.title]) for result in one if result.title in named]
    return pairs


def _spec_diff(
    one: SpecResult,
    other: SpecResult,
    alignment: Alignment,
    traces: tuple[Trace, Trace],
    objects: Sequence[ObjectDiff],
    files: Sequence[Specification],
) -> RunSpecDiff:
    moved = {each.name: each for each in objects}
    nodes = _deepest_flipped(one, other)
    if not nodes and one.robustness != other.robustness:
        nodes = (one.witness().path[-1].node,)
    names = [name for node in nodes for name in sorted(_objects_of(one, node)) if name in moved]
    return RunSpecDiff(
        one,
        other,
        _first_sign(one, other, alignment, traces),
        nodes,
        parting_of(one, other, files) if one.verdict is not other.verdict else None,
        tuple(moved[name] for name in dict.fromkeys(names)),
    )


def _deepest_flipped(one: SpecResult, other: SpecResult) -> tuple[int, ...]:
    """Return the nodes with other verdicts that have no such node below."""
    flipped = {
        node.id
        for node, beside in zip(one.nodes, other.nodes, strict=True)
        if node.verdict is not beside.verdict
    }
    if 0 not in flipped:
        return ()
    below = {one.nodes[node].parent for node in flipped}
    # of a conjunction only what brought it about: the way down from the root is flipped, too
    reached = {0}
    for node in sorted(flipped):
        if one.nodes[node].parent in reached:
            reached.add(node)
    return tuple(sorted(reached - below))


def _objects_of(result: SpecResult, node: int) -> frozenset[str]:
    formula = next(each for identifier, _, each in iter_nodes(result.formula) if identifier == node)
    bound = result.evidence.bound(formula)
    names: set[str] = set(other_names(bound))
    for _, _, leaf in iter_nodes(bound):
        if isinstance(leaf, Atom):
            names |= {getattr(term, "name", "") for term in leaf.terms}
    return frozenset(names)


def _first_sign(
    one: SpecResult, other: SpecResult, alignment: Alignment, traces: tuple[Trace, Trace]
) -> int | None:
    """Return the first sample with a value of another sign than the one beside it."""
    signs = []
    for result, trace, chosen in zip((one, other), traces, (alignment.a, alignment.b), strict=True):
        value = np.full(len(trace), np.nan)
        value[np.searchsorted(trace.times_ns, result.times_ns)] = result.series[0, 0]
        signs.append(np.where(np.isnan(value), 0, np.where(value >= 0.0, 1, -1))[chosen])
    differs = signs[0] != signs[1]
    return int(traces[0].times_ns[alignment.a[differs.argmax()]]) if differs.any() else None


def movement_sentence(each: ObjectDiff, start_ns: int) -> Sentence:
    """Return since when an object moved differently, and how far the two are apart."""
    parts: list[str | Instant] = ["differs since ", Instant(each.first_ns, start_ns)]
    if each.shift:
        parts.append(f", by up to {number_text(each.shift)}")
    if each.apart_ns is not None:
        parts += ["; apart from itself since ", Instant(each.apart_ns, start_ns)]
        parts += [f", farthest by {number_text(each.greatest)} at ", Instant(each.greatest_ns, start_ns)]
    for which, count in (("A", each.only_a), ("B", each.only_b)):
        if count:
            parts.append(f"; only {which} has it in {counted(count, 'sample')}")
    return Sentence(*parts)


def _entered(time_ns: int | None, states: Sequence[int], start_ns: int) -> tuple[str | Instant, ...]:
    if time_ns is None:
        return ("the end of the run",)
    return f"state {', '.join(map(str, states))} at ", Instant(time_ns, start_ns)


def _result_value(result: SpecResult) -> dict[str, Any]:
    return {
        "verdict": str(result.verdict),
        "robustness": json_number(result.robustness),
        "lower": json_number(result.lower),
        "upper": json_number(result.upper),
    }
