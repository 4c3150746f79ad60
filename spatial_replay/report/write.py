"""Reports: a log evaluated, and one HTML page that shows what the run did and why.

A replay gives the results and a `Collector` takes the rest from its messages. Together they are a
`RunReport`, which `page` turns into HTML.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.Event_pb2 import Event

from spatial_replay.annotate.specification import unit_of
from spatial_replay.errors import UsageError
from spatial_replay.logs import messages as log_topics
from spatial_replay.logs.messages import Messages, Source
from spatial_replay.logs.output_file import refuse_inputs, replacing
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState
from spatial_replay.monitor.sentences import gap_sentence
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.replay.engine import Replay, Replayed, planned_for
from spatial_replay.replay.selection import DEFAULT_OPTIONS, ReplayOptions
from spatial_replay.report.data import ReportedResult, RunReport, worst_results
from spatial_replay.report.page import page
from spatial_replay.report.panels import ReportedDecisions, ReportedScene, StatePath, pictures_of
from spatial_replay.spec.formula import Specification

_COLLECTED: Final = frozenset(
    (
        log_topics.AUTOMATON,
        log_topics.EVENTS,
        log_topics.PLAN_DECISION,
        log_topics.GRADIENT_MAP,
        log_topics.REDONE_DECISION,
        log_topics.REDONE_MAP,
    )
)


class Collector:
    """Collects what a page shows from a run, as its messages come."""

    def __init__(self) -> None:
        self.scene = ReportedScene()
        self.decisions, self.redone = ReportedDecisions(), ReportedDecisions()
        self.events: list[Event] = []
        self.paths: defaultdict[tuple[str, str | None], StatePath] = defaultdict(StatePath)

    def add(self, messages: Messages) -> None:
        """Take in the next messages."""
        topics = {number: channel.topic for number, channel in messages.channels.items()}
        collected = [number for number, topic in topics.items() if topic in _COLLECTED]
        chosen = np.flatnonzero(np.isin(messages.channel, collected))
        columns = (messages.channel, messages.sequence, messages.log_time_ns)
        numbers = zip(*(column[chosen].tolist() for column in columns), strict=True)
        for place, (channel, sequence, time_ns) in zip(chosen.tolist(), numbers, strict=True):
            payload = messages.payloads[place]
            match topics[channel]:
                case log_topics.AUTOMATON:
                    state = AutomatonState.FromString(payload)
                    self.paths[state.specification, state.object or None].add(time_ns, tuple(state.states))
                case log_topics.EVENTS:
                    self.events.append(Event.FromString(payload))
                case log_topics.PLAN_DECISION:
                    self.decisions.add_decision(payload)
                case log_topics.GRADIENT_MAP:
                    self.decisions.add_map(sequence, payload)
                case log_topics.REDONE_DECISION:
                    self.redone.add_decision(payload)
                case log_topics.REDONE_MAP:
                    self.redone.add_map(sequence, payload)


def refuse_output(output: Path, inputs: Sequence[Path] = ()) -> None:
    """Check that a report may be written, before the log is read.

    Raises:
        UsageError: the output is not named like a page, is an input, is a folder, or is in none.
    """
    refuse_inputs(output, inputs)
    if output.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{output}: report writes an HTML page; name it {output.stem}.html")


def write_report(
    source: Source,
    files: Sequence[Specification],
    output: Path,
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
) -> Replayed:
    """Evaluate specifications over a source and write a report as one HTML page.

    The page needs no other file and no network. Equal sources, specifications and options give an equal page.

    Args:
        inputs: files that the output must not be.
        advance: called with the number of samples of each block that is done.

    Raises:
        UsageError: an option that cannot work, no sample in the window, and what `refuse_output` refuses.
        SpecificationError: names that the log never has, if names are strict.
        LogError: no sample in the log.
        OutputError: the output cannot be written.
    """
    refuse_output(output, inputs)
    with replacing(output, inputs) as stream:
        replayed, report = report_of(source, files, options, advance)
        span_ns = replayed.start_ns, replayed.end_ns
        pictures = pictures_of(source, replayed.first_ns, span_ns, report.decided_ns)
        stream.write(page(replace(report, pictures=pictures)))
    return replayed


def report_of(
    source: Source,
    files: Sequence[Specification],
    options: ReplayOptions = DEFAULT_OPTIONS,
    advance: Callable[[int], None] = lambda samples: None,
) -> tuple[Replayed, RunReport]:
    """Evaluate specifications over a source, and collect what a page shows of it; see `write_report`."""
    collector = Collector()
    replay = Replay(source, files, options, keep_series=True, keep_leaves=True, show=collector.scene.add)
    replayed = replay.run(collector.add, advance=advance)
    report = RunReport(
        replayed,
        source.axes,
        tuple(replay.files),
        tuple(_results(replay, replayed, collector, source.axes.units)),
        _gaps(replayed),
        collector.scene,
        tuple(collector.events),
        collector.decisions,
        collector.redone,
        planned_for(source, replay.files),
    )
    return replayed, report


def _results(
    replay: Replay, replayed: Replayed, collector: Collector, declared: Mapping[str, str]
) -> Iterator[ReportedResult]:
    # under the paper's semantics, none can be explained
    explained = frozenset(worst_results(replayed.results) if replayed.semantics == "ltlf" else ())
    for index, result in enumerate(replayed.results):
        tree, unit = replay.trees[index], unit_of(result.formula, declared)
        is_explained = index in explained
        witness = (result.causes[0].shown if result.causes else result.worst) if is_explained else None
        yield ReportedResult(
            result,
            tree,
            replay.files[tree.file],
            result.sentences(replayed.first_ns) if is_explained else (),
            witness,
            unit if unit in declared.values() else "",
            replay.automata[index],
            collector.paths[tree.name, tree.object],
        )


def _gaps(replayed: Replayed) -> tuple[str, ...]:
    """Return sentences on what unknown results lack at the ends of a log, with a window without that."""
    unknown = [each for each in replayed.results if each.verdict is Verdict.UNKNOWN]
    gaps = (gap for each in unknown for gap in each.gaps() if gap.window is not None)
    return tuple(dict.fromkeys(gap_sentence(gap, replayed.first_ns) for gap in gaps))
