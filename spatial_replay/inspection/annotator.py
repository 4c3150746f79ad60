"""What is written beside the samples of a log: the specification, its robustness, the scene."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.inspection.automata import KeptAutomaton
from spatial_replay.inspection.automaton import AutomatonRun
from spatial_replay.inspection.events import EventTeller, Told
from spatial_replay.inspection.involvement import Evaluated, concerns_of
from spatial_replay.inspection.pointing import Judged, pointing_of
from spatial_replay.inspection.robustness import encode_robustness
from spatial_replay.inspection.scene import SceneEncoder, SceneState
from spatial_replay.inspection.specification import ReportedTree, encode_specification
from spatial_replay.inspection.viewer import Contents, Extent
from spatial_replay.logs.block import Channel, Messages, messages_of
from spatial_replay.logs.messages.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.messages.Robustness_pb2 import Robustness
from spatial_replay.logs.messages.Specification_pb2 import Specification as SpecificationMessage
from spatial_replay.logs.topics import (
    AUTOMATON,
    DERIVED,
    EVENT_LOG,
    EVENTS,
    ROBUSTNESS,
    SCENE,
    SPECIFICATION,
    protobuf_channel,
)
from spatial_replay.monitor.instances import Instance
from spatial_replay.monitor.semantics import Semantics
from spatial_replay.monitor.stream import Stretch
from spatial_replay.spec.formula import Outline, Specification, iter_nodes
from spatial_replay.trace.trace import Trace


class Annotator:
    """Says in messages what an evaluation found, sample after sample.

    Into how many stretches the samples are cut changes no message.
    """

    def __init__(
        self,
        files: Sequence[Specification],
        trees: Sequence[ReportedTree],
        instances: Sequence[Instance],
        automata: Sequence[KeptAutomaton],
        semantics: Semantics,
        scene: SceneState | None = None,
    ) -> None:
        """Start before the first sample.

        Args:
            instances, automata: one for each of `trees`.
            scene: what a viewer shows already, if it goes on with it.
        """
        self._files = files
        self._trees = trees
        self._concerns = [concerns_of(tree.formula, tree.object) for tree in trees]
        self._names = [[node.name for _, _, node in iter_nodes(tree.formula)] for tree in trees]
        self._pointing = [
            pointing_of(instance, concerns, files[tree.file].regions)
            for tree, instance, concerns in zip(trees, instances, self._concerns, strict=True)
        ]
        self._tellers = [
            EventTeller(tree, instance, files[tree.file], semantics)
            for tree, instance in zip(trees, instances, strict=True)
        ]
        self._runs = [
            None
            if kept.automaton is None
            else AutomatonRun(tree.name, tree.object, kept.automaton, tree.formula, instance.program.leaves)
            for tree, instance, kept in zip(trees, instances, automata, strict=True)
        ]
        self._encoder = SceneEncoder(shown_regions(files))
        self._scene = scene or SceneState()
        self._extent: Extent | None = None
        self._written = dict.fromkeys(DERIVED, 0)

    @property
    def scene(self) -> SceneState:
        """What a viewer shows after the messages so far."""
        return self._scene

    def messages(self, trace: Trace, stretches: Sequence[Stretch]) -> list[Messages]:
        """What to write beside the next samples.

        Args:
            stretches: what the evaluation says of them, one for each tree.
        """
        if not len(trace):
            return []
        self._extent = Extent.of(trace, self._extent)
        messages = []
        if self._trees and not self._written[SPECIFICATION]:
            messages.append(self._messages(_SPECIFICATION, trace.times_ns[:1], [self.specification()]))
        messages.append(self._robustness(stretches))
        messages.append(self._automaton_states(stretches))
        messages += self._events(self._told(stretches))
        messages.append(self._drawn(trace, stretches))
        return messages

    def pass_over(self, trace: Trace, stretches: Sequence[Stretch]) -> list[Messages]:
        """Take in the next samples and write nothing of them but the events."""
        if not len(trace):
            return []
        self._extent = Extent.of(trace, self._extent)
        for run, stretch in zip(self._runs, stretches, strict=True):
            if run is not None:
                run.pass_over(stretch)
        return self._events(self._told(stretches))

    def end(self, time_ns: int, finals: Sequence[Floats]) -> list[Messages]:
        """What to write when the samples have ended: the verdicts that samples after them could have changed.

        Args:
            time_ns: when the log ends, the last sample's time or later.
            finals: for each tree, (N, 2), lower and upper end of each node's value over the finished log.
        """
        return self._events(
            [
                each
                for teller, final in zip(self._tellers, finals, strict=True)
                for each in teller.end(time_ns, final)
            ]
        )

    def specification(self) -> bytes:
        """The message that says what was evaluated."""
        propositions = [() if run is None else run.propositions for run in self._runs]
        return encode_specification(self._files, self._trees, propositions=propositions)

    def contents(self, beside: Collection[str] = ()) -> Contents:
        """What there is to be shown, once everything else is written.

        Args:
            beside: topics of messages of others in the log.
        """
        written = {topic for topic, count in self._written.items() if count}
        has_states = [bool(self._written[AUTOMATON]) and run is not None for run in self._runs]
        return Contents(self._trees, has_states, self._extent, written | set(beside))

    def _robustness(self, stretches: Sequence[Stretch]) -> Messages:
        """One message per sample and result."""
        encoded = [
            encode_robustness(tree.name, tree.object, names, stretch.times_ns, stretch.series)
            for tree, names, stretch in zip(self._trees, self._names, stretches, strict=True)
        ]
        return self._in_order(_ROBUSTNESS, stretches, encoded)

    def _told(self, stretches: Sequence[Stretch]) -> list[Told]:
        """What changed, by time, then in the order of results and of their nodes."""
        told = [
            each
            for teller, stretch in zip(self._tellers, stretches, strict=True)
            for each in teller.tell(stretch)
        ]
        return sorted(told, key=lambda each: each.time_ns)

    def _events(self, told: Sequence[Told]) -> list[Messages]:
        times_ns = np.array([each.time_ns for each in told], np.int64)
        return [
            self._messages(_EVENTS, times_ns, [each.event for each in told]),
            self._messages(_EVENT_LOG, times_ns, [each.log for each in told]),
        ]

    def _automaton_states(self, stretches: Sequence[Stretch]) -> Messages:
        """One message per sample and result that has an automaton."""
        running = [
            (run, stretch) for run, stretch in zip(self._runs, stretches, strict=True) if run is not None
        ]
        encoded = [run.encode(stretch) for run, stretch in running]
        return self._in_order(_AUTOMATON, [stretch for _, stretch in running], encoded)

    def _drawn(self, trace: Trace, stretches: Sequence[Stretch]) -> Messages:
        """The scene."""
        evaluated = [
            Evaluated(concerns, stretch.times_ns, stretch.series)
            for concerns, stretch in zip(self._concerns, stretches, strict=True)
        ]
        judged = [
            Judged(each, stretch.leaves, pointing)
            for each, stretch, pointing in zip(evaluated, stretches, self._pointing, strict=True)
        ]
        drawn = self._encoder.encode(trace, evaluated, self._scene, judged)
        self._scene = drawn.state
        return self._messages(_SCENE, drawn.times_ns, drawn.payloads)

    def _in_order(
        self, channel: Channel, stretches: Sequence[Stretch], encoded: Sequence[Sequence[bytes]]
    ) -> Messages:
        """Messages of stretches by time, numbered in the order of results however the samples are cut."""
        times_ns = np.concatenate([np.empty(0, np.int64), *(stretch.times_ns for stretch in stretches)])
        payloads = [payload for own in encoded for payload in own]
        order = np.argsort(times_ns, kind="stable")
        return self._messages(channel, times_ns[order], [payloads[index] for index in order.tolist()])

    def _messages(self, channel: Channel, times_ns: Integers, payloads: Sequence[bytes]) -> Messages:
        first = self._written[channel.topic]
        self._written[channel.topic] += len(payloads)
        return messages_of(channel, times_ns, payloads, first)


def shown_regions(files: Sequence[Specification]) -> Mapping[str, Outline]:
    """The regions of all files; where two files differ on a name, the later one carries its file's name."""
    shown: dict[str, Outline] = {}
    for file in files:
        for name, outline in file.regions.items():
            is_taken = name in shown and shown[name] != outline
            shown[f"{file.filename}:{name}" if is_taken else name] = outline
    return shown


_SPECIFICATION = protobuf_channel(SPECIFICATION, SpecificationMessage)
_ROBUSTNESS = protobuf_channel(ROBUSTNESS, Robustness)
_AUTOMATON = protobuf_channel(AUTOMATON, AutomatonState)
_SCENE = protobuf_channel(SCENE, SceneUpdate)
_EVENTS = protobuf_channel(EVENTS, Event)
_EVENT_LOG = protobuf_channel(EVENT_LOG, Log)
