"""Replays that write a report: one page with what a run did, and why.

Messages of an annotated log → what a report shows of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.logs.messages import Messages
from spatial_replay.logs.output_file import replacing
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import AUTOMATON, EVENTS, GRADIENT_MAP, PLAN_DECISION, SCENE
from spatial_replay.replay.document import explain_node
from spatial_replay.replay.engine import Replay, Replayed
from spatial_replay.replay.selection import DEFAULT_OPTIONS, ReplayOptions
from spatial_replay.report.automaton_panel import StatePath, StatePathMaker
from spatial_replay.report.contents import Report, ReportedResult, worst_results
from spatial_replay.report.decision_panel import Plan, PlanMaker
from spatial_replay.report.event_panel import ReportedEvent, event_of
from spatial_replay.report.page import page
from spatial_replay.report.scene_panel import Film, FilmMaker
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.relations import RELATION_NAMES


class Taken(NamedTuple):
    """Where a message stands in its topic: its time, and its sequence number."""

    time_ns: int
    sequence: int


class Collector:
    """Takes the messages of a run as they come, and keeps what a page has room for."""

    def __init__(self) -> None:
        self._film = FilmMaker()
        self._plan = PlanMaker()
        self._events: list[ReportedEvent] = []
        self._paths: dict[tuple[str, str], StatePathMaker] = {}

    def add(self, messages: Messages) -> None:
        """Take in the next messages."""
        topics = {number: channel.topic for number, channel in messages.channels.items()}
        for index, number in enumerate(messages.channel.tolist()):
            take = _TAKERS.get(topics[number])
            if take is not None:
                taken = Taken(int(messages.log_time_ns[index]), int(messages.sequence[index]))
                take(self, taken, messages.payloads[index])

    @property
    def film(self) -> Film:
        return self._film.film()

    @property
    def plan(self) -> Plan:
        return self._plan.plan()

    @property
    def events(self) -> tuple[ReportedEvent, ...]:
        return tuple(self._events)

    def path(self, name: str, object: str | None) -> StatePath:
        """Where the automaton of a result was; nowhere if it has none."""
        return self._paths.get((name, object or ""), StatePathMaker()).path()

    def _take_scene(self, taken: Taken, payload: bytes) -> None:
        self._film.add(taken.time_ns, payload)

    def _take_event(self, _: Taken, payload: bytes) -> None:
        self._events.append(event_of(payload))

    def _take_state(self, _: Taken, payload: bytes) -> None:
        message = AutomatonState.FromString(payload)
        self._paths.setdefault((message.specification, message.object), StatePathMaker()).add(message)

    def _take_decision(self, _: Taken, payload: bytes) -> None:
        self._plan.add_decision(payload)

    def _take_map(self, taken: Taken, payload: bytes) -> None:
        self._plan.add_map(taken.sequence, payload)


_TAKERS: Final[Mapping[str, Callable[[Collector, Taken, bytes], None]]] = MappingProxyType(
    {
        SCENE: Collector._take_scene,
        EVENTS: Collector._take_event,
        AUTOMATON: Collector._take_state,
        PLAN_DECISION: Collector._take_decision,
        GRADIENT_MAP: Collector._take_map,
    }
)


def write_report(
    source: Source,
    files: Sequence[Specification],
    output: Path,
    options: ReplayOptions = DEFAULT_OPTIONS,
    *,
    inputs: Sequence[Path] = (),
    advance: Callable[[int], None] = lambda samples: None,
) -> Replayed:
    """Evaluate specifications over a source and write what was found as one HTML page.

    The page needs no other file and no network. Equal sources, specifications and options give an equal page.

    Args:
        inputs: files that the output must not be.
        advance: told how many more samples are done.

    Raises:
        UsageError: an option that cannot work, no sample in the window, the output is an input.
        SpecificationError: names that the log never has.
        LogError: no sample in the log.
        OutputError: the output cannot be written.
    """
    replay = Replay(source, files, options, keep_series=True, keep_leaves=True)
    with replacing(output, inputs) as stream:
        collector = Collector()
        replayed = replay.run(collector.add, advance=advance)
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
        why = explain_node(result, first_ns=replayed.first_ns) if index in explained else None
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
