"""Reports as HTML pages, of one run or of a comparison of two runs under one time cursor.

A replay gives the results, and a `Collector` gathers the other facts from the replay's messages. Results
and facts form a `RunReport`, which `page` writes as HTML.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, TypeAlias

from foxglove_schemas_protobuf.Event_pb2 import Event

from spatial_replay.annotate.specification import unit_of
from spatial_replay.compare.runs import DecisionDiff, LogDiff
from spatial_replay.compare.specifications import SpecificationDiff
from spatial_replay.errors import UsageError
from spatial_replay.html import Html, element
from spatial_replay.logs import topics as log_topics
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.output_file import refuse_inputs, replacing
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.source import Source
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.sentences import gap_sentence
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.planning.read import obstacles_of
from spatial_replay.replay.engine import Replay, Replayed, planned_for
from spatial_replay.replay.selection import DEFAULT_OPTIONS, ReplayOptions
from spatial_replay.report.data import ReportedResult, RunReport, page_data, worst_results
from spatial_replay.report.page import chip, document, page, panel, sentence_html, text
from spatial_replay.report.panels import (
    ReportedDecisions,
    ReportedScene,
    StatePath,
    json_text,
    pictures_of,
    shown_nodes,
)
from spatial_replay.spec.formula import Specification
from spatial_replay.text import Instant, Sentence
from spatial_replay.version import __version__

_COLLECTED: Final = frozenset(
    (
        log_topics.AUTOMATON,
        log_topics.EVENTS,
        log_topics.PLAN_DECISION,
        log_topics.GRADIENT_MAP,
        log_topics.REDONE_DECISION,
        log_topics.REDONE_MAP,
        log_topics.BEHAVIOUR_TREE,
    )
)


class Collector:
    """Collects the facts of a page from the messages and scenes of a replay."""

    def __init__(self) -> None:
        self.scene = ReportedScene()
        self.decisions, self.redone = ReportedDecisions(), ReportedDecisions()
        self.events: list[Event] = []
        self.ticks: list[bytes] = []
        self.paths: defaultdict[tuple[str, str | None], StatePath] = defaultdict(StatePath)

    def add(self, messages: Messages) -> None:
        """Add the next messages of the replay."""
        report_messages = messages.of_topics(_COLLECTED)
        for topic, (_, sequence, time_ns, _, payload) in zip(
            report_messages.topics, report_messages.rows(), strict=True
        ):
            match topic:
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
                case log_topics.BEHAVIOUR_TREE:
                    self.ticks.append(payload)


def refuse_output(output: Path, inputs: Sequence[Path] = ()) -> None:
    """Check the path of a report before the log is read.

    Raises:
        UsageError: the output is not named .html or .htm, is an input or a folder, or is in a missing folder.
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
        inputs: files that the output must not replace.
        advance: called with the number of samples of each evaluated block.

    Raises:
        UsageError: an option is impossible, the window has no sample, or `refuse_output` refuses the output.
        SpecificationError: a name is missing from the whole log, if names are strict.
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
    """Evaluate specifications over a source, and return the results with the facts of the page.

    Arguments and errors are the same as for `write_report`.
    """
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
        tuple(collector.ticks),
        obstacles=obstacles_of(source) if collector.decisions.decisions else {},
    )
    # the scene keeps one of many messages; a second pass over the log draws the samples in sentences
    missing_ns = sorted(set(report.marked_ns).difference(collector.scene.times_ns.tolist()))
    replay.draw_samples(replayed.results, missing_ns, collector.scene.insert)
    return replayed, report


def _results(
    replay: Replay, replayed: Replayed, collector: Collector, declared: Mapping[str, str]
) -> Iterator[ReportedResult]:
    # results under the paper's semantics cannot be explained
    explained_indices = frozenset(worst_results(replayed.results) if replayed.semantics == "ltlf" else ())
    for index, result in enumerate(replayed.results):
        tree, unit = replay.trees[index], unit_of(result.formula, declared)
        is_explained = index in explained_indices
        witness = (
            (result.causes[0].robustness_witness if result.causes else result.worst) if is_explained else None
        )
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
    """Return a sentence for each gap that makes a result unknown and that a smaller window avoids."""
    unknown = [result for result in replayed.results if result.verdict is Verdict.UNKNOWN]
    gaps = (gap for result in unknown for gap in result.gaps() if gap.window is not None)
    return tuple(dict.fromkeys(gap_sentence(gap, replayed.first_ns) for gap in gaps))


Side: TypeAlias = tuple[Source, Sequence[Specification], ReplayOptions]
"""One side of a page: a log, its specifications and the options of their evaluation."""


def write_comparison(
    diff: SpecificationDiff | LogDiff,
    sides: tuple[Side, Side],
    output: Path,
    *,
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
) -> None:
    """Write a diff as one HTML page, which needs no other file and no network. Equal diffs give equal pages.

    Args:
        sides: the compared sides, with the old specification or run A first.
        inputs: files that the output must not replace.
        advance: called with the number of samples of each evaluated block.

    Raises:
        UsageError: `refuse_output` refuses the output.
        LogError: a log has become unreadable.
        OutputError: the output cannot be written.
    """
    refuse_output(output, inputs)
    with replacing(output, inputs) as stream:
        (_, a), (_, b) = (report_of(*side, advance) for side in sides)
        stream.write(comparison_page(diff, a, b))


def comparison_page(diff: SpecificationDiff | LogDiff, a: RunReport, b: RunReport) -> bytes:
    """Return the page of a diff in UTF-8.

    Args:
        a, b: the reports of both sides.
    """
    data_a, data_b = page_data(a), page_data(b)
    labels = _labels(diff)
    decision = None if isinstance(diff, SpecificationDiff) else diff.decision
    is_same = "nothing differs" if diff.is_empty else "different"
    title = element("div", element("h1", text(" → ".join(labels))), **{"class": "title"})
    about_html = element(
        "p", text(f"{_about(diff)} · {is_same} · spatial-replay {__version__}"), **{"class": "about"}
    )
    parts = [
        element("header", title, about_html, **{"class": "top"}),
        element(
            "main",
            panel("verdicts", "What differs", *_changes(diff, (a.replayed.first_ns, b.replayed.first_ns))),
            panel("scene-a", labels[0]),
            panel("scene-b", labels[1]),
            *_decision_panels(decision, labels),
            panel("timeline", "Over time"),
            id="main",
            tabindex="-1",
        ),
    ]
    return document(
        " → ".join(labels),
        parts,
        {
            "facts-a": json_text(data_a.facts),
            "facts-b": json_text(data_b.facts),
            "pairs": json_text({"labels": labels, **_pairs(diff, a, b)}),
        },
        {"numbers-a": data_a.numbers, "numbers-b": data_b.numbers},
        "comparison",
    )


def _labels(diff: SpecificationDiff | LogDiff) -> tuple[str, str]:
    if isinstance(diff, SpecificationDiff):
        names = diff.old.filename, diff.new.filename
        return names if names[0] != names[1] else (f"{names[0]} (old)", f"{names[1]} (new)")
    return (diff.a, diff.b) if diff.a != diff.b else (f"{diff.a} (A)", f"{diff.b} (B)")


def _about(diff: SpecificationDiff | LogDiff) -> str:
    if isinstance(diff, SpecificationDiff):
        return f"two specifications over {diff.log}"
    return f"two runs, {diff.alignment}"


def _changes(diff: SpecificationDiff | LogDiff, first_ns: tuple[int, int]) -> Iterator[Html]:
    """Yield the changes, each with a headline and with sentences whose times are links."""
    if diff.is_empty:
        yield element("p", "Nothing differs.")
    if isinstance(diff, SpecificationDiff):
        for spec_diff in sorted(
            diff.specs, key=lambda spec_diff: not _is_flipped(spec_diff.old, spec_diff.new)
        ):
            if spec_diff.edits or spec_diff.is_different:
                verdicts = spec_diff.old.verdict, spec_diff.new.verdict
                yield _change(spec_diff.title, verdicts, list(spec_diff.sentences(diff.first_ns)), first_ns)
        for names, specification in ((diff.removed, diff.old), (diff.added, diff.new)):
            yield from (element("p", text(f"{name}: only in {specification.filename}")) for name in names)
        return
    if diff.is_empty:
        return
    for spec in sorted(diff.specs, key=lambda spec: not _is_flipped(spec.a, spec.b)):
        verdicts = spec.a.verdict, spec.b.verdict
        yield _change(spec.a.title, verdicts, list(spec.sentences(diff.zeros_ns)), first_ns)
    if diff.objects:
        yield _change("who moved differently", (), diff.movements, first_ns)
    if diff.signals:
        yield _change("signals with other values", (), diff.signal_changes, first_ns)
    for run_name, names in (("A", diff.only_a), ("B", diff.only_b)):
        if names:
            yield element("p", text(f"Only in {run_name}: {', '.join(names)}"))
    if diff.decision is not None:
        title = f"decision {diff.decision.number} is the first that differs"
        yield _change(title, (), list(map(Sentence, diff.decision.lines())), first_ns)


def _decision_panels(decision: DecisionDiff | None, labels: tuple[str, str]) -> list[Html]:
    """Return a panel per run for the first decision that differs, to be filled by the page's script."""
    if decision is None:
        return []
    names_and_labels = zip(("decision-a", "decision-b"), labels, strict=True)
    return [panel(name, text(f"{label}: decision {decision.number}")) for name, label in names_and_labels]


def _is_flipped(old: SpecResult, new: SpecResult) -> bool:
    return old.verdict != new.verdict


def _change(
    title: str, verdicts: Sequence[str], sentences: Sequence[Sentence], first_ns: tuple[int, int]
) -> Html:
    """Return one change with its verdict, or with both verdicts if these differ."""
    verdict_chips = [mark for verdict in dict.fromkeys(verdicts) for mark in (text(" → "), chip(verdict))][1:]
    title_html = element("span", text(title), **{"class": "name"})
    summary = element("div", *verdict_chips, title_html, **{"class": "summary"})
    sentence_lines = [element("p", *_with_run(sentence, first_ns)) for sentence in sentences]
    return element("div", summary, *sentence_lines, **{"class": "verdict change"})


def _with_run(sentence: Sentence, first_ns: tuple[int, int]) -> Iterator[Html]:
    """Yield the HTML of a sentence, in which the times of run B are marked."""
    is_b = first_ns[0] != first_ns[1] and any(
        isinstance(part, Instant) and part.first_ns == first_ns[1] for part in sentence.parts
    )
    is_b = is_b or sentence.startswith("B: ")
    for piece in sentence_html(sentence, first_ns[1] if is_b else first_ns[0]):
        yield Html(piece.replace("data-time-ns", 'data-run="b" data-time-ns')) if is_b else piece


def _pairs(diff: SpecificationDiff | LogDiff, a: RunReport, b: RunReport) -> dict[str, Any]:
    """Return the pairs of curves, the alignment of both clocks, and the time at which the page opens."""
    first_ns: int | None = None
    decision: DecisionDiff | None = None
    node_pairs: list[dict[str, Any]] = []
    page_places = [_places(report) for report in (a, b)]
    if isinstance(diff, SpecificationDiff):
        clock_knots = [[0.0, (a.replayed.first_ns - b.replayed.first_ns) / 1e9]]
        for spec in diff.specs:
            if first_ns is None and spec.first is not None:
                first_ns = spec.first.time_ns
            titles = spec.old.title, spec.new.title
            node_pairs += _node_pairs(spec.title, titles, (spec.old, spec.new), page_places)
            for edit in spec.cause:
                if edit.old_nodes and edit.new_nodes and edit.old_nodes[0]:
                    node_ids = edit.old_nodes[0], edit.new_nodes[0]
                    node_pairs += _node_pair(f"{spec.title}: {edit.new}", titles, node_ids, page_places)
    else:
        decision = diff.decision
        clock_knots = [
            [(knot.a_ns - a.replayed.first_ns) / 1e9, (knot.b_ns - b.replayed.first_ns) / 1e9]
            for knot in diff.alignment.knots
        ]
        candidates_ns = (
            [object_diff.apart_ns for object_diff in diff.objects],
            [] if decision is None else [decision.a_ns],
            [spec.first_ns for spec in diff.specs],
            [
                *(object_diff.first_ns for object_diff in diff.objects),
                *(object_diff.first_ns for object_diff in diff.signals),
            ],
        )
        time_groups = ([time_ns for time_ns in times_ns if time_ns is not None] for times_ns in candidates_ns)
        first_ns = next((min(times_ns) for times_ns in time_groups if times_ns), None)
        for run_spec in diff.specs:
            titles = run_spec.a.title, run_spec.b.title
            node_pairs += _node_pairs(run_spec.a.title, titles, (run_spec.a, run_spec.b), page_places)
    return {
        "knots": clock_knots,
        "nodes": node_pairs,
        "decision": decision and decision.number,
        "first": None if first_ns is None else (first_ns - a.replayed.first_ns) / 1e9,
    }


_Places: TypeAlias = Mapping[str, tuple[int, Mapping[int, int]]]
"""Map from a result's title to its index on the page, and to the indices of its shown nodes by id."""


def _places(report: RunReport) -> _Places:
    return {
        reported.result.title: (
            index,
            {node: node_index for node_index, node in enumerate(shown_nodes(reported.result.formula))},
        )
        for index, reported in enumerate(report.drawn)
    }


def _node_pairs(
    title: str, titles: tuple[str, str], results: tuple[SpecResult, SpecResult], places: Sequence[_Places]
) -> Iterator[dict[str, Any]]:
    """Yield the pair of roots of two results, and the pairs of nodes with equal names."""
    yield from _node_pair(title, titles, (0, 0), places)
    ids_by_name = {node.name: node.id for node in reversed(results[1].nodes) if node.name and node.id}
    seen_names: set[str] = set()
    for node in results[0].nodes[1:]:
        if node.name in ids_by_name and node.name not in seen_names:
            seen_names.add(node.name)
            yield from _node_pair(node.name, titles, (node.id, ids_by_name[node.name]), places)


def _node_pair(
    label: str, titles: tuple[str, str], ids: tuple[int, int], places: Sequence[_Places]
) -> Iterator[dict[str, Any]]:
    """Yield a pair of nodes by their indices on the page, if the page shows both."""
    page_nodes = [
        [places_of_report[title][0], places_of_report[title][1][identifier]]
        for places_of_report, title, identifier in zip(places, titles, ids, strict=True)
        if title in places_of_report and identifier in places_of_report[title][1]
    ]
    if len(page_nodes) == 2:
        yield {"label": label, "a": page_nodes[0], "b": page_nodes[1]}
