"""Reports: a log evaluated, and one HTML page that shows what the run did and why.

A replay gives the results and a `Collector` takes the rest from its messages. Together they are a
`RunReport`, which `page` turns into HTML.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from spatial_replay.annotate.specification import unit_of
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs import topics as log_topics
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.output_file import refuse_inputs, replacing
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.source import Source, axes_of
from spatial_replay.monitor.sentences import divisor_of, gap_sentence, open_text
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.monitor.witness.witness import Witness, WitnessStep
from spatial_replay.replay.engine import Replay, Replayed, planned_for
from spatial_replay.replay.selection import DEFAULT_OPTIONS, ReplayOptions
from spatial_replay.report.data import Pointer, ReportedResult, RunReport, worst_results
from spatial_replay.report.page import page
from spatial_replay.report.panels import (
    DecisionCollector,
    ReportedEvent,
    SceneCollector,
    StatePath,
    StatePathCollector,
    event_of,
    pictures_of,
)
from spatial_replay.spec.formula import Formula, Quantified, Specification, iter_nodes
from spatial_replay.spec.relations import RELATION_NAMES
from spatial_replay.spec.walks import units_of

_COLLECTED: Final = frozenset(
    (
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
        self.scene = SceneCollector()
        self.decisions = DecisionCollector()
        self.events: list[ReportedEvent] = []
        self._paths: defaultdict[tuple[str, str], StatePathCollector] = defaultdict(StatePathCollector)

    def add(self, messages: Messages) -> None:
        """Take in the next messages."""
        topics = {number: channel.topic for number, channel in messages.channels.items()}
        collected = [number for number, topic in topics.items() if topic in _COLLECTED]
        chosen = np.flatnonzero(np.isin(messages.channel, collected))
        columns = (messages.channel, messages.sequence)
        numbers = zip(*(column[chosen].tolist() for column in columns), strict=True)
        for place, (channel, sequence) in zip(chosen.tolist(), numbers, strict=True):
            payload = messages.payloads[place]
            match topics[channel]:
                case log_topics.EVENTS:
                    self.events.append(event_of(payload))
                case log_topics.PLAN_DECISION:
                    self.decisions.add_decision(payload)
                case log_topics.GRADIENT_MAP:
                    self.decisions.add_map(sequence, payload)
                case log_topics.REDONE_DECISION:
                    self.decisions.redone.add_decision(payload)
                case log_topics.REDONE_MAP:
                    self.decisions.redone.add_map(sequence, payload)
        of_states = [number for number, topic in topics.items() if topic == log_topics.AUTOMATON]
        chosen = np.flatnonzero(np.isin(messages.channel, of_states))
        states = [messages.payloads[place] for place in chosen.tolist()]
        self._add_states(messages.log_time_ns[chosen], states)

    def _add_states(self, times_ns: Integers, payloads: Sequence[bytes]) -> None:
        places: defaultdict[tuple[str, str], defaultdict[tuple[int, ...], list[int]]] = defaultdict(
            lambda: defaultdict(list)
        )
        for place, message in enumerate(map(AutomatonState.FromString, payloads)):
            places[message.specification, message.object][tuple(message.states)].append(place)
        for result, of_states in places.items():
            own = [(np.array(each), states) for states, each in of_states.items()]
            self._paths[result].extend(times_ns, own)

    def path(self, name: str, object: str | None) -> StatePath:
        """Return where the automaton of a result was; an empty path if it has none."""
        return self._paths[name, object or ""].path


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
        decided_ns = [each.decided_ns for each in report.drawn if each.decided_ns is not None]
        pictures = pictures_of(source, report.start_ns, report.end_ns, decided_ns)
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
    return replayed, _report(source, replay, replayed, collector)


def _report(source: Source, replay: Replay, replayed: Replayed, collector: Collector) -> RunReport:
    return RunReport(
        log=replayed.log,
        samples=replayed.samples,
        first_ns=replayed.first_ns,
        start_ns=replayed.start_ns,
        end_ns=replayed.end_ns,
        axes=axes_of(source),
        faults=replayed.faults,
        remarks=replayed.remarks,
        unreadable=replayed.unreadable,
        semantics=replayed.semantics,
        certificate=replayed.certificate,
        files=tuple(replay.files),
        results=tuple(_results(replay, replayed, collector, axes_of(source).units)),
        vacuous=replayed.vacuous,
        gaps=_gaps(replayed),
        scene=collector.scene.scene,
        events=tuple(collector.events),
        decisions=collector.decisions.decisions,
        planned_for=planned_for(source, replay.files),
    )


def _results(
    replay: Replay, replayed: Replayed, collector: Collector, declared: Mapping[str, str]
) -> Iterator[ReportedResult]:
    explained = _explained(replayed)
    for index, result in enumerate(replayed.results):
        tree, compiled = replay.trees[index], replay.automata[index]
        file, unit = replay.files[tree.file], unit_of(result.formula, declared)
        is_explained = index in explained
        witness = (result.causes[0].shown if result.causes else result.worst) if is_explained else None
        yield ReportedResult(
            result=result,
            tree=tree,
            source=file.source,
            relations=RELATION_NAMES | file.relations,
            sentences=result.sentences(replayed.first_ns) if is_explained else (),
            decided_ns=None if witness is None else _decided(witness).time_ns,
            decided_node=None if witness is None else _decided(witness).node,
            decided_text="" if witness is None else _decided_text(witness, result.formula),
            left_open="" if witness is None else open_text(witness),
            pointer=None if witness is None else _pointer(witness),
            named={spec.name: spec for spec in file.specs},
            units=units_of(result.formula),
            unit=unit if unit in declared.values() else "",
            automaton=compiled.automaton,
            no_automaton=compiled.reason,
            path=collector.path(tree.name, tree.object),
        )


def _decided(witness: Witness) -> WitnessStep:
    """Return what to look at, and when: what decided or, of a response that was missed, came nearest.

    Where an operator took its number from the past, that is the operator: it failed then, and not before.
    """
    path = witness.closest_path or witness.path
    return next((step for step, below in pairwise(path) if below.time_ns < step.time_ns), path[-1])


def _decided_text(witness: Witness, formula: Formula) -> str:
    """Return the atom of the objects that decided a quantifier, or "" if what decided is none."""
    deciding = witness.deciding if witness.closest is None else witness.closest[0]
    decided = _decided(witness).node
    node = next(node for identifier, _, node in iter_nodes(formula) if identifier == decided)
    return deciding.text if deciding is not None and isinstance(node, Quantified) else ""


def _pointer(witness: Witness) -> Pointer | None:
    deciding = witness.deciding if witness.closest is None else witness.closest[0]
    if deciding is None or deciding.unknown:
        return None
    if _decided(witness) != (witness.closest_path or witness.path)[-1]:
        return None  # things stood elsewhere when the atom had its number
    for measured in deciding.measured:
        if measured.contact is not None:
            ends = np.array([measured.contact.first, measured.contact.second])
            number = deciding.value * divisor_of(deciding.atom)
            is_response = witness.closest is not None
            is_condition = not is_response and witness.missed is not None and witness.missed.is_condition
            return Pointer(ends, deciding.text, number, is_condition, is_response, deciding.objects)
    return None


def _explained(replayed: Replayed) -> frozenset[int]:
    """Return which results are explained: under the paper's semantics, none can be."""
    if replayed.semantics != "ltlf":
        return frozenset()
    return frozenset(worst_results(replayed.results))


def _gaps(replayed: Replayed) -> tuple[str, ...]:
    """Return sentences on what unknown results lack at the ends of a log, with a window without that."""
    unknown = [each for each in replayed.results if each.verdict is Verdict.UNKNOWN]
    gaps = (gap for each in unknown for gap in each.gaps() if gap.window is not None)
    return tuple(dict.fromkeys(gap_sentence(gap, replayed.first_ns) for gap in gaps))
