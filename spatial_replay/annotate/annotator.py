"""The messages of an annotated log that report results: robustness, automaton states, events, the scene."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from operator import attrgetter
from types import MappingProxyType
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.Event_pb2 import Event
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.annotate.automaton_state import AutomatonRun, SpecAutomaton
from spatial_replay.annotate.deciding_leaf import NewestSamples, leaf_pairs
from spatial_replay.annotate.events import EncodedEvent, EventReporter, encoded_occurrence
from spatial_replay.annotate.requirements import requirements_of
from spatial_replay.annotate.robustness import encode_robustness
from spatial_replay.annotate.scene.extent import SceneBounds, map_area
from spatial_replay.annotate.scene.scene_frames import SceneFrames
from spatial_replay.annotate.scene.scene_template import encode_frame
from spatial_replay.annotate.scene.scene_update import SceneEncoder, SceneState
from spatial_replay.annotate.specification import ReportedTree, encode_specification
from spatial_replay.annotate.standing import StandingEncoder
from spatial_replay.annotate.violations import EvaluatedResult, ShadeTracker, violated_since
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.messages import Channel, Messages, messages_of
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.schemas.Robustness_pb2 import (
    EventFacts,
    RecentEvent,
    RecentEvents,
    Robustness,
    StandingUpdate,
)
from spatial_replay.logs.schemas.Specification_pb2 import Specification as SpecificationMessage
from spatial_replay.logs.topics import (
    AUTOMATON,
    DERIVED,
    EVENT_LOG,
    EVENTS,
    FRAME,
    RECENT_EVENTS,
    ROBUSTNESS,
    SCENE,
    SPECIFICATION,
    STANDING,
    protobuf_channel,
)
from spatial_replay.logs.wire import Payloads
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.stream import Instance, SeriesBlock
from spatial_replay.monitor.verdict import Semantics
from spatial_replay.spec.formula import Outline, Specification, iter_nodes
from spatial_replay.trace.trace import LATEST_NS, Trace

_MOST_RECENT: Final = 20
"""Limit of events in the message that lists recent events."""


class _Result:
    """The state of one result between blocks, and the encoder of its messages."""

    def __init__(
        self,
        tree: ReportedTree,
        instance: Instance,
        spec_automaton: SpecAutomaton,
        file: Specification,
        reporter: EventReporter,
        *,
        settles: bool,
        has_arrow: bool,
    ) -> None:
        self.tree, self.reporter = tree, reporter
        self.requirements = requirements_of(tree.formula, tree.object, settles=settles)
        part_requirements = requirements_of(tree.formula, tree.object, settles=settles, splits=True)
        self._shades = ShadeTracker(instance, part_requirements, file.regions)
        self._violated_since_ns = np.full(len(self.requirements), LATEST_NS)
        self._node_names = [node.name for _, _, node in iter_nodes(tree.formula)]
        self._leaf_pairs = (
            leaf_pairs(instance, self.requirements, file.regions, file.relations) if has_arrow else None
        )
        self.run: AutomatonRun | None = None
        if spec_automaton.automaton is not None:
            leaves = instance.program.leaves
            self.run = AutomatonRun(
                tree.name, tree.object, spec_automaton.automaton, tree.formula, leaves, tree.with_object_name
            )

    def extend(self, trace: Trace, block: SeriesBlock) -> list[EncodedEvent]:
        """Add the next samples and their evaluation, and return the events."""
        self._shades.extend(trace, block)
        self.violate(block)
        return self.reporter.extend(block)

    def violate(self, block: SeriesBlock) -> None:
        """Update the start of each requirement's permanent violation."""
        self._violated_since_ns = violated_since(self.requirements, block, self._violated_since_ns)

    def robustness(self, block: SeriesBlock, *, final: bool = False) -> Payloads:
        """Return one message on robustness per sample."""
        tree = self.tree
        return encode_robustness(
            tree.name, tree.object, self._node_names, block.times_ns, block.series, final=final
        )

    def result_for_scene(self, block: SeriesBlock, *, is_final: bool) -> EvaluatedResult:
        """Return the numbers of the result that the scene shows."""
        return EvaluatedResult(
            self.requirements,
            block,
            self._leaf_pairs,
            self._violated_since_ns,
            self.reporter.settled,
            is_final,
            self._shades.shades,
        )


class Annotator:
    """Encodes the results of an evaluation as messages, sample by sample.

    The messages do not depend on the cut of samples into blocks.

    Attributes:
        first_event_ns: time of the first event; None before any event.
    """

    def __init__(
        self,
        files: Sequence[Specification],
        trees: Sequence[ReportedTree],
        instances: Sequence[Instance],
        automata: Sequence[SpecAutomaton],
        semantics: Semantics,
        scene: SceneState | None = None,
        show: Callable[[SceneFrames], None] = lambda frames: None,
        arrow: str = "",
        units: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Start before the first sample.

        Args:
            instances, automata: one instance and one automaton per tree.
            scene: state of a viewer that continues with these messages; None for a new viewer.
            show: function that receives the frames of the scene.
            arrow: title of the result whose violation has the arrow. An unknown title, such as "", means
                the first violated result.
            units: declared units, see `unit_of`.
        """
        self._units = units
        self._files = files
        self._trees = trees
        self._automata = [spec_automaton.automaton for spec_automaton in automata]
        arrow_trees = [tree for tree in trees if tree.is_called(arrow)] or trees
        self._newest_samples = NewestSamples()
        self._results = [
            _Result(
                tree,
                instance,
                spec_automaton,
                files[tree.file],
                EventReporter(tree, instance, files[tree.file], semantics, units, self._newest_samples),
                settles=semantics == "ltlf",
                has_arrow=tree in arrow_trees,
            )
            for tree, instance, spec_automaton in zip(trees, instances, automata, strict=True)
        ]
        self._runs = [result.run for result in self._results]
        self.standing = StandingEncoder(trees, self._runs, units)
        requirements = [requirement for result in self._results for requirement in result.requirements]
        named_objects = frozenset(name for requirement in requirements for name in requirement.objects)
        self._encoder = SceneEncoder(shown_regions(files), units.get("", ""), named_objects)
        self.first_event_ns: int | None = None
        self._last_sample: tuple[Trace, list[SeriesBlock]] | None = None
        self._scene = scene or SceneState()
        self.standing.zero_ns = self._scene.zero_ns
        self._show = show
        self._message_counts = dict.fromkeys(DERIVED, 0)
        self._newest_events = deque[tuple[RecentEvent, EventFacts]](maxlen=_MOST_RECENT)

    @property
    def scene(self) -> SceneState:
        """The state of a viewer after the messages so far."""
        return self._scene

    @property
    def extent(self) -> SceneBounds | None:
        """The bounds of the planner's map and of all footprints so far; None without map and footprints."""
        return self._scene.extent.bounds

    def add_map(self, plan: Mapping[str, str]) -> None:
        """Add the area of a planner's map to the extent; `plan` is the metadata of the plan."""
        self._scene = replace(self._scene, extent=self._scene.extent.with_area(map_area(plan)))

    @property
    def has_samples(self) -> bool:
        """Whether there was at least one sample."""
        return self._last_sample is not None

    @property
    def _over(self) -> list[str]:
        """The deciding atom or missed response of each result; "" for a pending result."""
        return [result.reporter.over for result in self._results]

    def count_from(self, zero_ns: int) -> None:
        """Set the zero of times in texts; the default is the time of the first sample."""
        self._scene = replace(self._scene, zero_ns=zero_ns)
        self.standing.zero_ns = zero_ns

    def _find_zero(self, trace: Trace) -> None:
        if self._scene.zero_ns is None:
            self.count_from(int(trace.times_ns[0]))

    def messages(self, trace: Trace, blocks: Sequence[SeriesBlock]) -> list[Messages]:
        """Return the messages that annotate the next samples.

        Args:
            blocks: evaluations of the samples, one block per tree.
        """
        if not len(trace):
            return []
        self._find_zero(trace)
        messages = []
        if not self._message_counts[FRAME]:
            messages.append(
                self._messages(_FRAME, trace.times_ns[:1], [encode_frame(int(trace.times_ns[0]))])
            )
        if self._trees and not self._message_counts[SPECIFICATION]:
            specification = encode_specification(
                self._files,
                self._trees,
                self._units,
                [() if run is None else run.propositions for run in self._runs],
                self._automata,
                self._scene.zero_ns or 0,
            )
            messages.append(self._messages(_SPECIFICATION, trace.times_ns[:1], [specification]))
        messages.append(self._robustness(blocks))
        runs_with_blocks = [
            (run, block) for run, block in zip(self._runs, blocks, strict=True) if run is not None
        ]
        state_payloads = [run.encode(block) for run, block in runs_with_blocks]
        messages.append(self._in_order(_AUTOMATON, [block for _, block in runs_with_blocks], state_payloads))
        events = self._changes(trace, blocks)
        if self._trees:
            standing_messages = self.standing.encode(trace.times_ns, blocks, self._over)
            messages.append(self._messages(_STANDING, *standing_messages))
        messages += self._events(events)
        messages.append(self._scene_messages(trace, blocks))
        self._remember(trace, blocks)
        return messages

    def occurrence(self, time_ns: int, what: str, sentence: str) -> list[Messages]:
        """Return the messages of an external event, such as a lost connection."""
        return self._events([encoded_occurrence(time_ns, what, sentence)])

    def pass_over(self, trace: Trace, blocks: Sequence[SeriesBlock], most_changes: int = 0) -> list[Messages]:
        """Add the next samples, and return only the events and the last changes of the standing.

        Args:
            most_changes: limit of changes with a message; see `StandingEncoder.encode_changes`.
        """
        if not len(trace):
            return []
        self._find_zero(trace)
        for run, block in zip(self._runs, blocks, strict=True):
            if run is not None:
                run.pass_over(block)
        self._scene = self._encoder.pass_over(trace, self._scene)
        self._remember(trace, blocks)
        messages = self._events(self._changes(trace, blocks))
        if not most_changes or not self._trees:
            self.standing.pass_over(blocks)
            return messages
        standing_changes = self.standing.encode_changes(blocks, self._over, most_changes)
        return [*messages, self._messages(_STANDING, *standing_changes)]

    def draw(self, trace: Trace, blocks: Sequence[SeriesBlock]) -> None:
        """Draw the scene at the next sample, without the rate limit of scenes and without other messages."""
        self.pass_over(trace, blocks)
        self._scene = replace(self._scene, written_ns=None)
        self._scene_messages(trace, blocks)

    def end(
        self, time_ns: int, finals: Sequence[Floats], results: Sequence[SpecResult] = ()
    ) -> list[Messages]:
        """Return the messages after the last sample.

        The messages are final verdicts of pending nodes, warnings about untested parts, and the robustness,
        standing and scene of the finished log.

        Args:
            time_ns: time of the end of the log, not before the last sample.
            finals: for each tree, (N, 2), lower and upper end of each node's value over the finished log.
            results: results of the trees, for the warnings; without results there are no warnings.
        """
        events = list[EncodedEvent]()
        for result_state, final_intervals in zip(self._results, finals, strict=True):
            events += result_state.reporter.end(time_ns, final_intervals)
        for result_state, result in zip(self._results, results, strict=False):
            events += result_state.reporter.untested_warnings(time_ns, result)
        return [*self._events(events), *self._finals(time_ns, finals)]

    def _finals(self, time_ns: int, finals: Sequence[Floats]) -> list[Messages]:
        """Return the last message on robustness of each result, the last standing and the last scene."""
        if self._last_sample is None or not self._trees:
            return []
        trace, blocks = self._last_sample
        final_blocks = [
            _with_final_intervals(block, final_intervals)
            for block, final_intervals in zip(blocks, finals, strict=True)
        ]
        results_with_blocks = zip(self._results, final_blocks, strict=True)
        robustness_payloads = Payloads.concatenate(
            [result.robustness(block, final=True) for result, block in results_with_blocks]
        )
        last_ns = int(trace.times_ns[-1])
        robustness_messages = self._messages(
            _ROBUSTNESS, np.full(len(robustness_payloads), time_ns), robustness_payloads
        )
        standing_payload = self.standing.end(last_ns, finals, self._over)
        standing_messages = self._messages(_STANDING, np.array([time_ns]), [standing_payload])
        for result, block in zip(self._results, final_blocks, strict=True):
            result.violate(block)
        # without a time of the last scene, the final colours are drawn at once
        self._scene = replace(self._scene, written_ns=None)
        scene_messages = self._scene_messages(trace, final_blocks, is_final=True)
        times_ns = np.full(len(scene_messages), time_ns)
        return [
            robustness_messages,
            standing_messages,
            replace(scene_messages, log_time_ns=times_ns, publish_time_ns=times_ns),
        ]

    def _remember(self, trace: Trace, blocks: Sequence[SeriesBlock]) -> None:
        """Store the last sample of the trace and of each result, for the messages of `end`."""
        earlier_blocks = [None] * len(blocks) if self._last_sample is None else self._last_sample[1]
        last_blocks = [
            _last_of(block) if len(block.times_ns) or earlier_block is None else earlier_block
            for block, earlier_block in zip(blocks, earlier_blocks, strict=True)
        ]
        self._last_sample = trace.slice(len(trace) - 1, len(trace)), last_blocks

    def _robustness(self, blocks: Sequence[SeriesBlock]) -> Messages:
        """Return one message on robustness per sample and result."""
        encoded = [result.robustness(block) for result, block in zip(self._results, blocks, strict=True)]
        return self._in_order(_ROBUSTNESS, blocks, encoded)

    def _changes(self, trace: Trace, blocks: Sequence[SeriesBlock]) -> list[EncodedEvent]:
        """Return the events, sorted by time, then by result and node."""
        self._newest_samples.extend(trace)
        results_with_blocks = zip(self._results, blocks, strict=True)
        events = [event for result, block in results_with_blocks for event in result.extend(trace, block)]
        return sorted(events, key=lambda event: event.time_ns)

    def _events(self, events: Sequence[EncodedEvent]) -> list[Messages]:
        times_ns = np.array([event.time_ns for event in events], np.int64)
        if len(events) and self.first_event_ns is None:
            self.first_event_ns = events[0].time_ns
        log_payloads = [event.log.SerializeToString(deterministic=True) for event in events]
        events_by_time = groupby(events, attrgetter("time_ns"))
        recent_by_time = {
            time_ns: self._recent(list(simultaneous_events))
            for time_ns, simultaneous_events in events_by_time
        }
        return [
            self._messages(_EVENTS, times_ns, [event.event for event in events]),
            self._messages(_EVENT_LOG, times_ns, log_payloads),
            self._messages(_RECENT_EVENTS, np.array([*recent_by_time], np.int64), [*recent_by_time.values()]),
        ]

    def _recent(self, events: Sequence[EncodedEvent]) -> bytes:
        """Add events of one time, and return a message with the newest events.

        Each message repeats earlier events, because after a seek a viewer reads only one message per topic.
        """
        zero_ns = events[0].time_ns if self._scene.zero_ns is None else self._scene.zero_ns
        for event in events:
            seconds = round((event.time_ns - zero_ns) / 1e9, 3)
            self._newest_events.appendleft((RecentEvent(at=seconds, event=event.log.message), event.facts))
        recent_events, facts = zip(*self._newest_events, strict=True)
        return RecentEvents(events=recent_events, facts=facts).SerializeToString(deterministic=True)

    def _scene_messages(
        self, trace: Trace, blocks: Sequence[SeriesBlock], *, is_final: bool = False
    ) -> Messages:
        results_with_blocks = zip(self._results, blocks, strict=True)
        evaluated_results = [
            result.result_for_scene(block, is_final=is_final) for result, block in results_with_blocks
        ]
        scene_messages = self._encoder.encode(trace, evaluated_results, self._scene)
        if scene_messages.frames is not None:
            self._show(scene_messages.frames)
        self._scene = scene_messages.state
        return self._messages(_SCENE, scene_messages.times_ns, scene_messages.payloads)

    def _in_order(
        self, channel: Channel, blocks: Sequence[SeriesBlock], payloads: Sequence[Sequence[bytes]]
    ) -> Messages:
        """Sort the messages of all results by time. Messages of equal times keep the order of results."""
        times_ns = np.concatenate([np.empty(0, np.int64), *(block.times_ns for block in blocks)])
        time_order = np.argsort(times_ns, kind="stable")
        return self._messages(
            channel, times_ns[time_order], Payloads.concatenate(payloads).select(time_order)
        )

    def _messages(self, channel: Channel, times_ns: Integers, payloads: Sequence[bytes]) -> Messages:
        first_index = self._message_counts[channel.topic]
        self._message_counts[channel.topic] += len(payloads)
        return messages_of(channel, times_ns, payloads, first_index)


def _last_of(block: SeriesBlock) -> SeriesBlock:
    """Return the last sample of a block. An empty block stays empty."""
    # copies, because views would keep the whole block in memory
    return SeriesBlock(
        block.times_ns[-1:].copy(), block.series[:, :, -1:].copy(), block.leaves[:, :, -1:].copy()
    )


def _with_final_intervals(block: SeriesBlock, final_intervals: Floats) -> SeriesBlock:
    """Return the last sample with each node's interval over the finished log, (N, 2)."""
    series = block.series.copy()
    series[:, 2:] = final_intervals[:, :, None]
    return replace(block, series=series)


def shown_regions(files: Sequence[Specification]) -> Mapping[str, Outline]:
    """Return the regions of all files by name.

    If two files define a name differently, the later region is named FILE:NAME.
    """
    outlines: dict[str, Outline] = {}
    for file in files:
        for name, outline in file.regions.items():
            has_clash = name in outlines and outlines[name] != outline
            outlines[f"{file.filename}:{name}" if has_clash else name] = outline
    return outlines


_FRAME = protobuf_channel(FRAME, FrameTransform)
_SPECIFICATION = protobuf_channel(SPECIFICATION, SpecificationMessage)
_ROBUSTNESS = protobuf_channel(ROBUSTNESS, Robustness)
_STANDING = protobuf_channel(STANDING, StandingUpdate)
_AUTOMATON = protobuf_channel(AUTOMATON, AutomatonState)
_SCENE = protobuf_channel(SCENE, SceneUpdate)
_EVENTS = protobuf_channel(EVENTS, Event)
_EVENT_LOG = protobuf_channel(EVENT_LOG, Log)
_RECENT_EVENTS = protobuf_channel(RECENT_EVENTS, RecentEvents)


def channels_of_results(trees: Sequence[ReportedTree]) -> tuple[Channel, ...]:
    """Return the channels of the messages that annotate samples."""
    if not trees:
        return (_FRAME, _ROBUSTNESS, _AUTOMATON, _EVENTS, _EVENT_LOG, _RECENT_EVENTS, _SCENE)
    event_channels = (_EVENTS, _EVENT_LOG, _RECENT_EVENTS)
    return (_FRAME, _SPECIFICATION, _ROBUSTNESS, _AUTOMATON, _STANDING, *event_channels, _SCENE)
