"""What is written beside the samples of a log: the specification, its robustness, the scene."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import PurePath

import numpy as np
from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.errors import SpecificationError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.inspection.automata import (
    KeptAutomaton,
    automata_attachments,
    automata_metadata,
    automata_of,
)
from spatial_replay.inspection.automaton import AutomatonRun
from spatial_replay.inspection.events import EventTeller
from spatial_replay.inspection.involvement import Evaluated, concerns_of
from spatial_replay.inspection.pointing import Judged, pointing_of
from spatial_replay.inspection.robustness import encode_robustness
from spatial_replay.inspection.scene import SceneEncoder, SceneState
from spatial_replay.inspection.specification import encode_specification, reported_trees
from spatial_replay.inspection.viewer import Contents, Extent, layout_attachment
from spatial_replay.logs.block import Channel, Messages
from spatial_replay.logs.messages.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.messages.Robustness_pb2 import Robustness
from spatial_replay.logs.messages.Specification_pb2 import Specification as SpecificationMessage
from spatial_replay.logs.sink import Attachment
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
from spatial_replay.monitor.semantics import Semantics, instance_evaluation
from spatial_replay.monitor.stream import EvaluationStream, Stretch
from spatial_replay.spec import format_specification, parse_specification
from spatial_replay.spec.formula import Outline, Specification, iter_nodes
from spatial_replay.trace.trace import Trace


class AnnotatedEvaluation:
    """Specifications evaluated over samples as they come, with the messages that say so.

    Into how many stretches the samples are cut changes neither numbers nor messages.

    Attributes:
        trees: every result, under the name it is reported by.
        streams: their evaluation, in the same order.
    """

    def __init__(
        self,
        files: Sequence[Specification],
        instances: Sequence[Sequence[Instance]],
        semantics: Semantics = "ltlf",
        compiled_before: Callable[[], Sequence[Attachment]] = list,
    ) -> None:
        """Start before the first sample.

        Args:
            instances: what to evaluate of each file.
            compiled_before: gives the attachments of a log; automata among them need no MONA.
        """
        self._files = files
        self._semantics = semantics
        self._compiled_before = compiled_before
        begin = partial(instance_evaluation, semantics=semantics)
        self._evaluations = [
            EvaluationStream(own, file.regions, begin) for own, file in zip(instances, files, strict=True)
        ]
        self.streams = [stream for evaluation in self._evaluations for stream in evaluation.streams]
        self.trees = reported_trees(files, instances)
        self._concerns = [concerns_of(tree.formula, tree.object) for tree in self.trees]
        self._names = [[node.name for _, _, node in iter_nodes(tree.formula)] for tree in self.trees]
        self._pointing = [
            pointing_of(stream.instance, concerns, files[tree.file].regions)
            for tree, stream, concerns in zip(self.trees, self.streams, self._concerns, strict=True)
        ]
        self._tellers = [
            EventTeller(tree, stream.instance, files[tree.file], semantics)
            for tree, stream in zip(self.trees, self.streams, strict=True)
        ]
        self._encoder = SceneEncoder(shown_regions(files))
        self._state = SceneState()
        self._extent: Extent | None = None
        self._written = dict.fromkeys(DERIVED, 0)

    def extend(self, trace: Trace) -> list[Stretch]:
        """Take in the next samples; one stretch for each of `trees`."""
        return [stretch for evaluation in self._evaluations for stretch in evaluation.extend(trace)]

    def messages(self, trace: Trace, stretches: Sequence[Stretch]) -> list[Messages]:
        """What to write beside samples, from the stretches that `extend` gave for them."""
        if not len(trace):
            return []
        self._extent = Extent.of(trace, self._extent)
        messages = []
        if self.trees and not self._written[SPECIFICATION]:
            propositions = [() if run is None else run.propositions for run in self._runs]
            payload = encode_specification(self._files, self.trees, propositions=propositions)
            messages.append(self._messages(_SPECIFICATION, trace.times_ns[:1], [payload]))
        messages.append(self._robustness(stretches))
        messages.append(self._automaton_states(stretches))
        messages += self._events(stretches)
        evaluated = [
            Evaluated(concerns, stretch.times_ns, stretch.series)
            for concerns, stretch in zip(self._concerns, stretches, strict=True)
        ]
        judged = [
            Judged(each, stretch.leaves, pointing)
            for each, stretch, pointing in zip(evaluated, stretches, self._pointing, strict=True)
        ]
        scene = self._encoder.encode(trace, evaluated, self._state, judged)
        self._state = scene.state
        messages.append(self._messages(_SCENE, scene.times_ns, scene.payloads))
        return messages

    def automata_metadata(self) -> Mapping[str, str]:
        """For each spec, how large its automaton is, or why there is none."""
        return automata_metadata(self._automata)

    def automata_attachments(self, prefix: str) -> list[Attachment]:
        """The automata, to be kept beside the specifications of `specification_attachments`."""
        return automata_attachments(self._automata, prefix)

    def layout(self, beside: Collection[str] = ()) -> Attachment:
        """How to open the log in a viewer, once all samples are written.

        Args:
            beside: topics of messages of others in it.
        """
        written = {topic for topic, count in self._written.items() if count}
        has_states = [bool(self._written[AUTOMATON]) and run is not None for run in self._runs]
        scale = self._state.scale or 1.0
        return layout_attachment(Contents(self.trees, has_states, self._extent, written | set(beside), scale))

    def _robustness(self, stretches: Sequence[Stretch]) -> Messages:
        """One message per sample and result."""
        encoded = [
            encode_robustness(tree.name, tree.object, names, stretch.times_ns, stretch.series)
            for tree, names, stretch in zip(self.trees, self._names, stretches, strict=True)
        ]
        return self._in_order(_ROBUSTNESS, stretches, encoded)

    def _events(self, stretches: Sequence[Stretch]) -> list[Messages]:
        """What changed, by time, then in the order of results and of their nodes."""
        told = [
            each
            for teller, stretch in zip(self._tellers, stretches, strict=True)
            for each in teller.tell(stretch)
        ]
        told.sort(key=lambda each: each.time_ns)
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

    @cached_property
    def _automata(self) -> Sequence[KeptAutomaton]:
        """Of each tree; compiled when first asked for, since not every evaluation is written down."""
        return automata_of(self._files, self.trees, self._semantics, self._compiled_before())

    @cached_property
    def _runs(self) -> Sequence[AutomatonRun | None]:
        return [
            None
            if kept.automaton is None
            else AutomatonRun(
                tree.name, tree.object, kept.automaton, tree.formula, stream.instance.program.leaves
            )
            for tree, stream, kept in zip(self.trees, self.streams, self._automata, strict=True)
        ]

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


def messages_of(channel: Channel, times_ns: Integers, payloads: Sequence[bytes], first: int) -> Messages:
    """Messages of one channel, published when they are logged, numbered from `first`."""
    return Messages(
        channels={0: channel},
        channel=np.zeros(len(payloads), np.int64),
        sequence=np.arange(first, first + len(payloads), dtype=np.int64),
        log_time_ns=times_ns,
        publish_time_ns=times_ns,
        payloads=payloads,
    )


def kept_files(files: Sequence[Specification]) -> list[Specification]:
    """The specifications as a log keeps them, so that who reads it back gets equal ones of equal names.

    Each has a file name whose stem no other has. A text that would not be read back as the same specification
    (it was parsed with a profile or constants of its own) gives way to the canonical one.
    """
    kept: list[Specification] = []
    stems: set[str] = set()
    for file in files:
        path = PurePath(file.filename)
        own, suffix = path.stem.strip("<>"), path.suffix or ".spatial"
        stem, count = own, 1
        while stem in stems:
            count += 1
            stem = f"{own}-{count}"
        stems.add(stem)
        kept.append(replace(_self_contained(file), filename=f"{stem}{suffix}"))
    return kept


def specification_attachments(files: Sequence[Specification], prefix: str) -> list[Attachment]:
    """The texts of `kept_files`, to be kept in a log under names that begin with `prefix`."""
    return [Attachment(f"{prefix}{file.filename}", "text/plain", file.source.encode()) for file in files]


def _self_contained(file: Specification) -> Specification:
    for text in (file.source, format_specification(file)):
        try:
            read_back = parse_specification(text, filename=file.filename)
        except SpecificationError:
            continue
        if read_back == file:
            return file if text == file.source else read_back
    # relations given in Python cannot be written down
    return file


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
