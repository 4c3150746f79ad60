"""Replays that write a report: one page with what a run did, and why."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from spatial_replay.inspection.report.collecting import Collector
from spatial_replay.inspection.report.contents import Report, ReportedResult, worst_results
from spatial_replay.inspection.report.page import page
from spatial_replay.logs.output import replacing
from spatial_replay.logs.source import Source
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.replay.annotated import check_parameters
from spatial_replay.replay.explanation import explanation_of
from spatial_replay.replay.found import Replayed
from spatial_replay.replay.replay import Replay
from spatial_replay.replay.window import Window
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.relations import RELATION_NAMES


def write_report(
    source: Source,
    files: Sequence[Specification],
    output: Path,
    *,
    window: Window | None = None,
    each: Mapping[str, str] | None = None,
    semantics: Semantics = "ltlf",
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
) -> Replayed:
    """Evaluate specifications over a source and write what was found as one HTML page.

    The page needs no other file and no network. Equal sources, specifications and options give an equal page.

    Args:
        each: for each parameter of a template, the objects that it stands for: "all", "class:NAME".
        semantics: "ltlf", or "paper": Def. 16 of the paper to the letter.
        inputs: files that the output must not be.
        advance: told how many more samples are done.

    Raises:
        UsageError: an option that cannot work, no sample in the window, the output is an input.
        SpecificationError: names that the log never has.
        LogError: no sample in the log.
        OutputError: the output cannot be written.
    """
    check_parameters(files, each or {})
    replay = Replay(
        source, files, window=window, each=each, semantics=semantics, keep_series=True, keep_leaves=True
    )
    with replacing(output, inputs) as stream:
        collector = Collector()
        for messages, samples in replay.iter_messages(annotate=True):
            collector.add(messages)
            advance(samples)
        replayed = replay.result()
        stream.write(page(_report(replay, replayed, collector)))
    return replayed


def _report(replay: Replay, replayed: Replayed, collector: Collector) -> Report:
    return Report(
        log=replayed.log,
        samples=replayed.samples,
        first_ns=replayed.first_ns,
        start_ns=replayed.start_ns,
        end_ns=replayed.end_ns,
        faults=replayed.faults,
        remarks=replayed.remarks,
        unreadable=replayed.unreadable,
        semantics=replayed.semantics,
        certificate=replayed.certificate,
        files=tuple(replay.files),
        results=tuple(_results(replay, replayed, collector)),
        film=collector.film,
        events=collector.events,
        plan=collector.plan,
    )


def _results(replay: Replay, replayed: Replayed, collector: Collector) -> Iterator[ReportedResult]:
    explained = _explained(replayed)
    for index, result in enumerate(replayed.results):
        tree, kept = replay.trees[index], replay.automata[index]
        unseen = np.empty((len(result.robustness), 4, 0))
        why = explanation_of(result, first_ns=replayed.first_ns) if index in explained else None
        yield ReportedResult(
            name=result.name,
            object=result.object,
            formula=result.formula,
            relations=RELATION_NAMES | replay.files[tree.file].relations,
            verdict=result.verdict,
            robustness=result.robustness,
            final=result.final,
            first_satisfied_ns=result.first_satisfied_ns,
            times_ns=np.empty(0, np.int64) if result.times_ns is None else result.times_ns,
            series=unseen if result.series is None else result.series,
            sentences=() if why is None else why.sentences,
            decided_ns=None if why is None else why.time_ns,
            automaton=kept.automaton,
            no_automaton=kept.reason,
            path=collector.path(tree.name, tree.object),
        )


def _explained(replayed: Replayed) -> frozenset[int]:
    """Which results are explained; under the paper's semantics none can be."""
    if replayed.semantics != "ltlf":
        return frozenset()
    return frozenset(worst_results([result.verdict for result in replayed.results]))
