"""Decisions made again from a log, and compared with what it says, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from google.protobuf.message import DecodeError

from spatial_replay.errors import LogError, SpatialReplayError, UsageError
from spatial_replay.logs.block import Messages
from spatial_replay.logs.messages.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.reading import read_blocks
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import GRADIENT_MAP, PLAN_DECISION, PLAN_PATH, RECORDED_PREFIX
from spatial_replay.planning.black_box import PLAN_METADATA, BlackBox
from spatial_replay.planning.map_message import maps_of
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings_text import settings_from_text
from spatial_replay.planning.step import Outcome
from spatial_replay.spec import parse_specification
from spatial_replay.trace.sample import Sample

_TOPICS = (PLAN_DECISION, GRADIENT_MAP, PLAN_PATH)


@dataclass(frozen=True, slots=True)
class Redone:
    """What became of decisions that were made again.

    Attributes:
        decisions: how many there are in the log.
        maps: how many gradient maps were computed again, one for each way in which an object may be turned.
        differences: what differs from the log, each with its place; none where all is as it was.
        faults: what was lost while reading, each with its place.
    """

    decisions: int
    maps: int
    differences: tuple[str, ...]
    faults: tuple[str, ...] = ()


def redo_decisions(source: Source, advance: Callable[[int], None] = lambda samples: None) -> Redone:
    """Make every decision of a planned run again, from its samples alone, and compare all messages' bytes.

    Outcomes are the controller's, and taken from the log.

    Args:
        advance: told how many more samples are done.

    Raises:
        UsageError: the log holds no plan.
        LogError: what the plan was made with cannot be read.
    """
    check = _Check(BlackBox(planner_of(source)))
    faults: list[str] = []
    for block in read_blocks(source):
        faults += block.trace.faults
        check.run(list(block.trace.samples()), list(_planned(block.messages)))
        advance(len(block.trace))
    return check.end(tuple(faults))


def planner_of(source: Source) -> Planner:
    """The planner that a log was made with, before the first sample.

    Raises:
        UsageError: the log holds no plan.
        LogError: what the plan was made with cannot be read.
    """
    kept = dict(source.metadata()).get(PLAN_METADATA)
    if kept is None:
        raise UsageError(f"{source.name} holds no decisions; `spatial-replay plan` makes logs that do")
    texts = {attachment.name: attachment.data for attachment in source.attachments()}
    name = RECORDED_PREFIX + kept.get("file", "")
    if name not in texts:
        raise LogError(f"{source.name} has lost {name!r}, the specification that was planned for")
    specification = parse_specification(
        texts[name].decode("utf-8", "replace"), filename=kept.get("file", "<text>")
    )
    settings = settings_from_text(kept.get("settings", ""))
    return Planner(specification, settings, name=kept.get("specification"))


def _planned(messages: Messages) -> Iterator[tuple[int, str, bytes]]:
    """The planner's messages, as (time, topic, payload)."""
    topics: Mapping[int, str] = {
        number: channel.topic for number, channel in messages.channels.items() if channel.topic in _TOPICS
    }
    for number, time_ns, payload in zip(
        messages.channel.tolist(), messages.log_time_ns.tolist(), messages.payloads, strict=True
    ):
        if number in topics:
            yield time_ns, topics[number], payload


class _Check:
    """One pass over a log."""

    def __init__(self, box: BlackBox) -> None:
        self._box = box
        self._waiting: list[tuple[int, str, bytes]] = []
        self._decisions = self._maps = 0
        self._differences: list[str] = []

    def run(self, samples: list[Sample], messages: list[tuple[int, str, bytes]]) -> None:
        """Take in the next samples, and all messages up to the last of them."""
        self._waiting += messages
        for sample in samples:
            self._compare_until(sample.time_ns)
            self._box.observe(sample)
        if samples:
            self._compare_until(samples[-1].time_ns + 1)

    def end(self, faults: tuple[str, ...]) -> Redone:
        """What came of it, with what was lost meanwhile."""
        if self._waiting:
            self._compare_until(self._waiting[-1][0] + 1)
        return Redone(self._decisions, self._maps, tuple(self._differences), faults)

    def _compare_until(self, end_ns: int) -> None:
        """Make the decisions again whose messages come before a time."""
        ready = [each for each in self._waiting if each[0] < end_ns]
        self._waiting = self._waiting[len(ready) :]
        recorded = {topic: [payload for _, name, payload in ready if name == topic] for topic in _TOPICS}
        if not ready or self._differences:
            return
        made: dict[str, list[bytes]] = {topic: [] for topic in _TOPICS}
        for payload in recorded[PLAN_DECISION]:
            try:
                messages = list(self._made_again(payload))
            except (SpatialReplayError, DecodeError) as error:
                self._differences.append(f"at {ready[0][0]} ns: {error}")
                return
            for _, topic, own in messages:
                made[topic].append(own)
        for topic in _TOPICS:
            self._compare(ready[0][0], topic, recorded[topic], made[topic])

    def _made_again(self, payload: bytes) -> Iterator[tuple[int, str, bytes]]:
        """The messages of a decision, or of the outcome that the log tells of."""
        message = PlanDecision.FromString(payload)
        if not message.HasField("outcome"):
            step, messages = self._box.decide()
            self._decisions += 1
            self._maps += len(maps_of(step))
            yield from _planned(messages)
        elif message.kind != PlanDecision.KIND_WAIT:
            # what became of a wait comes with the decision after it
            told = Outcome(message.outcome.succeeded, message.outcome.reason)
            yield from _planned(self._box.conclude(told))

    def _compare(self, time_ns: int, topic: str, recorded: list[bytes], made: list[bytes]) -> None:
        if len(recorded) != len(made):
            self._differences.append(
                f"at {time_ns} ns: {len(recorded)} messages on {topic}, made again {len(made)}"
            )
        for old, new in zip(recorded, made, strict=False):
            if old != new:
                self._differences.append(f"at {time_ns} ns: {topic} differs{_difference(topic, old, new)}")


def _difference(topic: str, recorded: bytes, made: bytes) -> str:
    """Which fields of two decisions differ."""
    if topic != PLAN_DECISION:
        return ""
    one, other = PlanDecision.FromString(recorded), PlanDecision.FromString(made)
    fields = [
        field.name
        for field in PlanDecision.DESCRIPTOR.fields
        if getattr(one, field.name) != getattr(other, field.name)
    ]
    return f" in {', '.join(fields)} of decision {one.number}" if fields else ""
