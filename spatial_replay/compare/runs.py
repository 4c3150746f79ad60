"""Two runs side by side: where they part, who moved differently, and what that did to each spec."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Final

from spatial_replay.compare.alignment import Alignment, align_runs
from spatial_replay.compare.decision_diff import DecisionDiff, compare_decisions
from spatial_replay.compare.movement import (
    ObjectDiff,
    SignalDiff,
    compare_objects,
    compare_signals,
    movement_sentence,
    signal_sentence,
)
from spatial_replay.compare.run_results import RunSpecDiff, compare_results
from spatial_replay.lazy import Displayed
from spatial_replay.logs.source import Source
from spatial_replay.monitor.evaluate import Evaluation, evaluate
from spatial_replay.monitor.result import SpecResult
from spatial_replay.replay.selection import DEFAULT_OPTIONS, LogNames, ReplayOptions, Selection
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.formula import Specification
from spatial_replay.text import counted, counted_from, json_number
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import Trace

_MOST_LISTED: Final = 12


@dataclass(frozen=True, eq=False)
class LogDiff(Displayed):
    """Two runs side by side.

    Attributes:
        a, b: the names of the logs.
        samples: how many each has, where they were compared.
        starts_ns: the times of their first samples, which sentences count from.
        alignment: how samples correspond.
        objects: those that moved differently, the first apart first.
        signals: those with other values, in the order of their names.
        only_a, only_b: objects and signals that one run never has, and results of templates for them.
        specs: results of both runs.
        decision: the first decision that differs; None if none does, or the runs were not planned.
        has_equal_samples: whether all samples are equal.
        faults: what was lost while reading.
        missing: a warning for each name in the specifications that a log never has.
        traces: the samples.
    """

    a: str
    b: str
    samples: tuple[int, int]
    starts_ns: tuple[int, int]
    alignment: Alignment
    objects: tuple[ObjectDiff, ...]
    signals: tuple[SignalDiff, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    specs: tuple[RunSpecDiff, ...]
    decision: DecisionDiff | None
    has_equal_samples: bool
    faults: tuple[str, ...]
    traces: tuple[Trace, Trace]
    missing: tuple[Diagnostic, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether nothing differs: no sample, no result, no decision."""
        return self.has_equal_samples and self.decision is None

    def lines(self) -> Iterator[str]:
        """Yield the diff as text, as the command `diff` prints it."""
        yield f"A {self.a} | B {self.b}"
        if self.is_empty:
            yield f"  the same {counted(self.samples[0], 'sample')}"
            return
        paired = [len(set(rows.tolist())) for rows in (self.alignment.a, self.alignment.b)]
        counts = " | ".join(counted(count, "sample") for count in self.samples)
        yield f"  {counts}; {self.alignment}: {paired[0]:,} of A beside {paired[1]:,} of B"
        start_ns = self.starts_ns[0]
        for each in self.objects[:_MOST_LISTED]:
            yield f"  {each.name}: {movement_sentence(each, start_ns)}"
        if len(self.objects) > _MOST_LISTED:
            yield f"  and {counted(len(self.objects) - _MOST_LISTED, 'other object')} moved differently"
        for signal in self.signals[:_MOST_LISTED]:
            yield f"  {signal.name}: {signal_sentence(signal, start_ns)}"
        if len(self.signals) > _MOST_LISTED:
            yield f"  and {counted(len(self.signals) - _MOST_LISTED, 'other signal')} with other values"
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
            "damaged": bool(self.faults),
            "alignment": {
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
            "signals": [
                {
                    "name": each.name,
                    "first_ns": each.first_ns,
                    "greatest_difference": json_number(each.greatest),
                    "greatest_ns": each.greatest_ns,
                    "ratio": json_number(each.ratio),
                }
                for each in self.signals
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
    """Compare two logs by all of their samples.

    Args:
        options: how each log is evaluated.
        align: "time" since the first sample, "progress" of the automaton that both go farthest through,
            "progress:NAME" of that of a spec, or
            the name of a spec, whose first change of sign in each run is the event.
        advance: called with the number of samples of each block that is read.

    Raises:
        UsageError: no sample in a run, no common object, other units, nothing to align by.
        LogError: a log cannot be read.
        SpecificationError: names that a log never has, if names are strict.
    """
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
    diff = _compare(sources, traces, files, options, align)
    return replace(diff, missing=tuple(dict.fromkeys(missing)))


def _compare(
    sources: tuple[Source, Source],
    traces: tuple[Trace, Trace],
    files: Sequence[Specification],
    options: tuple[ReplayOptions, ReplayOptions],
    align: str,
) -> LogDiff:
    """Compare two runs and what specifications say of them.

    Args:
        traces: their samples.
    """
    a, b = traces
    # all three measure for most of their time, which leaves the interpreter to the others
    with ThreadPoolExecutor(2, "comparing") as threads:
        waiting = [
            threads.submit(_evaluated, trace, files, own) for trace, own in zip(traces, options, strict=True)
        ]
        aligned = _aligned(a, b, (), files, align) if align == "time" else None
        evaluations = [each.result() for each in waiting]
    results = _paired(evaluations)
    alignment, objects = aligned or _aligned(a, b, results, files, align)
    titles = [{result.title for evaluation in own for result in evaluation} for own in evaluations]
    return LogDiff(
        sources[0].name,
        sources[1].name,
        (len(a), len(b)),
        (int(a.times_ns[0]), int(b.times_ns[0])),
        alignment,
        objects,
        compare_signals(a, b, alignment),
        _only_in(a, b, titles[0] - titles[1]),
        _only_in(b, a, titles[1] - titles[0]),
        tuple(compare_results(one, other, alignment, traces, objects, files) for one, other in results),
        compare_decisions(sources),
        not objects and a == b,
        (*_faults(a), *_faults(b)),
        traces,
    )


def _aligned(
    a: Trace,
    b: Trace,
    results: Sequence[tuple[SpecResult, SpecResult]],
    files: Sequence[Specification],
    align: str,
) -> tuple[Alignment, tuple[ObjectDiff, ...]]:
    alignment = align_runs((a.times_ns, b.times_ns), results, files, align)
    return alignment, compare_objects(a, b, alignment)


def _only_in(one: Trace, other: Trace, titles: set[str]) -> tuple[str, ...]:
    names = sorted(set(one.names) - set(other.names)) + sorted(set(one.signals) - set(other.signals))
    return (*names, *sorted(titles))


def _faults(trace: Trace) -> tuple[str, ...]:
    return counted_from(trace.faults, int(trace.times_ns[0]))


def _evaluated(trace: Trace, files: Sequence[Specification], options: ReplayOptions) -> list[Evaluation]:
    parameters = [{spec.parameter for spec in file.results} for file in files]
    return [
        evaluate(
            file,
            trace,
            semantics=options.semantics,
            start_ns=options.window.start_ns,
            end_ns=min(options.window.end_ns, FOREVER),
            each={name: choice for name, choice in options.each.items() if name in own},
        )
        for file, own in zip(files, parameters, strict=True)
    ]


def _paired(evaluations: Sequence[Sequence[Evaluation]]) -> list[tuple[SpecResult, SpecResult]]:
    pairs = []
    for one, other in zip(*evaluations, strict=True):
        named = {result.title: result for result in other}
        pairs += [(result, named[result.title]) for result in one if result.title in named]
    return pairs
