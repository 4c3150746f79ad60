"""The planner's messages in a log: what it decided, on which maps, and how that went."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message

from spatial_replay.errors import UsageError
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.logs.block import Messages, messages_of
from spatial_replay.logs.merging import merge
from spatial_replay.logs.messages.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.topics import GRADIENT_MAP, PLAN_DECISION, PLAN_PATH, protobuf_channel
from spatial_replay.planning.decision_message import decision_message, outcome_message
from spatial_replay.planning.map_message import map_message, maps_of
from spatial_replay.planning.path_message import path_message
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.poses import centre_of
from spatial_replay.planning.step import Outcome, Step, wait_outcome
from spatial_replay.trace.sample import Sample

PLAN_METADATA: Final = "spatial_replay_plan"
"""The metadata record with what decisions depend on besides samples: settings, and which specification."""

_DECISIONS: Final = protobuf_channel(PLAN_DECISION, PlanDecision)
_MAPS: Final = protobuf_channel(GRADIENT_MAP, GridMessage)
_PATHS: Final = protobuf_channel(PLAN_PATH, SceneUpdate)
_CHANNELS: Final = (_DECISIONS, _MAPS, _PATHS)


class BlackBox:
    """A planner and a record of everything it decides.

    Samples, `decide` and `conclude` go through it in the order in which they happen; equal ones give equal
    bytes.
    """

    def __init__(self, planner: Planner) -> None:
        """Begin before the first sample."""
        self.planner = planner
        self._written = dict.fromkeys(_CHANNELS, 0)
        self._sample: Sample | None = None
        self._step: Step | None = None
        self._decision = PlanDecision()
        self._tracked: TrackedObject | None = None
        self._travelled: list[tuple[float, float]] = []

    def observe(self, sample: Sample) -> None:
        """Take in the next sample.

        Raises:
            TraceError: it does not come after the one before.
        """
        self.planner.observe(sample)
        self._sample = sample
        tracked = self._object_moved()
        if tracked is not None:
            self._travelled.append(centre_of(tracked.footprint))

    def decide(self) -> tuple[Step, Messages]:
        """The planner's next step, and the messages that tell of it; none while the same wait goes on.

        What became of a wait is told when something else is decided.

        Raises:
            UsageError: nothing was observed yet, or the last step was not concluded.
        """
        step = self.planner.next_step()
        if step is self._step:
            return step, self._messages(step.time_ns, [], [], [])
        waited = self._waited(step.time_ns)
        self._step = step
        self._tracked = self._object_moved()
        self._travelled = [] if self._tracked is None else [centre_of(self._tracked.footprint)]
        self._decision = decision_message(step, self.planner.automaton.name, self._written[_MAPS])
        maps = [map_message(turned, step.time_ns) for turned in maps_of(step)]
        path = path_message(step.target, self._tracked, step.time_ns)
        return step, self._messages(step.time_ns, [*waited, self._decision], maps, [path])

    def conclude(self, outcome: Outcome) -> Messages:
        """Say how the last step went; the messages that tell of it.

        Raises:
            UsageError: no step is being executed.
        """
        self.planner.conclude(outcome)
        if self._step is None or self._sample is None:
            raise UsageError("no step is being executed; decide on one first")
        step, end_ns = self._step, self._sample.time_ns
        told = self._concluded(outcome, end_ns)
        path = path_message(step.target, self._tracked, end_ns, self._travelled)
        self._step = None
        return self._messages(end_ns, [told], [], [path])

    def _waited(self, end_ns: int) -> list[PlanDecision]:
        """The last decision with its outcome, if it was to wait."""
        if self._step is None or self._step.kind != "wait":
            return []
        return [self._concluded(wait_outcome(self._step, self.planner.states), end_ns)]

    def _concluded(self, outcome: Outcome, end_ns: int) -> PlanDecision:
        """The last decision with its outcome."""
        told = outcome_message(outcome, end_ns, self.planner.states, self._travelled)
        self._decision.outcome.CopyFrom(told)
        return self._decision

    def _object_moved(self) -> TrackedObject | None:
        """The object that the last step moves, as it is now."""
        if self._step is None or self._step.target is None or self._sample is None:
            return None
        tracked = self._sample.objects.get(self._step.target.name)
        return tracked if isinstance(tracked, TrackedObject) else None

    def _messages(self, time_ns: int, *of_channels: Sequence[Message]) -> Messages:
        """Messages of each channel, as the log numbers them."""
        streams = []
        for channel, messages in zip(_CHANNELS, of_channels, strict=True):
            first = self._written[channel]
            self._written[channel] += len(messages)
            payloads = [message.SerializeToString(deterministic=True) for message in messages]
            times_ns = np.full(len(payloads), time_ns, np.int64)
            streams.append(messages_of(channel, times_ns, payloads, first))
        return merge(streams)
