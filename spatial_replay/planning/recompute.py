"""Decisions made again from a log, and compared with what it says, bit for bit.

How much of a planned run a log has: all of it, or a part.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from google.protobuf.message import DecodeError

from spatial_replay.errors import LogError, SpatialReplayError, UsageError
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.source import Source, read_blocks
from spatial_replay.logs.topics import (
    ENDING,
    GRADIENT_MAP,
    METADATA,
    PLAN_DECISION,
    PLAN_PATH,
    RECORDED_PREFIX,
)
from spatial_replay.planning.decision_log import PLAN_METADATA, BlackBox, maps_of
from spatial_replay.planning.decisions import Outcome, Step
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings import settings_from_text
from spatial_replay.spec import parse_specification
from spatial_replay.text import counted
from spatial_replay.trace.sample import Sample


class Extent(NamedTuple):
    """What a log's metadata says of the run.

    Attributes:
        samples: of the run; None where it did not come to an end.
        was_interrupted: whether it was ended from outside.
        is_copy: whether a replay wrote the log.
        is_cut: whether that replay began after the source's first sample, as far as it was told to.
    """

    samples: int | None
    was_interrupted: bool
    is_copy: bool
    is_cut: bool

    def is_whole(self, samples: int) -> bool:
        """Whether a log of so many samples has the run to its proper end."""
        return samples == self.samples and not self.was_interrupted

    def is_part(self, samples: int) -> bool:
        """Whether a log of so many samples may lack some of the run."""
        return self.is_copy if self.samples is None else samples < self.samples


def extent_of(source: Source) -> Extent:
    """What a log's metadata says.

    Raises:
        LogError: it cannot be read.
    """
    metadata = dict(source.metadata())
    ending, about = metadata.get(ENDING, {}), metadata.get(METADATA, {})
    is_copy = about.get("written_by") == "replay"
    options = _value(about, "options", {}) if is_copy else {}
    samples = _value(ending, "samples", None)
    if not isinstance(options, dict) or not isinstance(samples, int | None):
        raise LogError(f"the metadata of {source.name} tells of {samples!r} samples and options {options!r}")
    return Extent(samples, _value(ending, "interrupted", False) is not False, is_copy, "start_ns" in options)


def _value(texts: Mapping[str, str], key: str, otherwise: object) -> object:
    try:
        return json.loads(texts[key]) if key in texts else otherwise
    except ValueError as error:
        raise LogError(f"{key!r} in the log's metadata cannot be read: {error}") from error


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

    Outcomes are the controller's, and taken from the log. That a log to the proper end of its run tells no
    decision after a motion, or none at all, is a difference, too.

    Args:
        advance: told how many more samples are done.

    Raises:
        UsageError: the log holds no plan, or begins within the run.
        LogError: what the plan was made with cannot be read.
    """
    extent, check = extent_of(source), _Check(BlackBox(planner_of(source)))
    faults: list[str] = []
    samples = 0
    for block in read_blocks(source):
        faults += block.trace.faults
        check.run(list(block.trace.samples()), list(_planned(block.messages)))
        samples += len(block.trace)
        advance(len(block.trace))
    if not faults and extent.is_part(samples) and (extent.is_cut or check.began_within):
        raise UsageError(
            f"{source.name} begins within the run, and decisions rest on all samples before; verify the log "
            "that it was made of, or name that: --source SOURCE"
        )
    return check.end(tuple(faults), is_whole=not faults and extent.is_whole(samples))


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
        self.began_within = False
        self._box = box
        self._last: Step | None = None
        self._is_moving = False
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

    def end(self, faults: tuple[str, ...], *, is_whole: bool) -> Redone:
        """What came of it, with what was lost meanwhile.

        Args:
            is_whole: the log goes on to the proper end of the run.
        """
        if self._waiting:
            self._compare_until(self._waiting[-1][0] + 1)
        if is_whole and not self._differences:
            self._differences += self._what_is_missing()
        return Redone(self._decisions, self._maps, tuple(self._differences), faults)

    def _compare_until(self, end_ns: int) -> None:
        """Make the decisions again whose messages come before a time."""
        ready = [each for each in self._waiting if each[0] < end_ns]
        self._waiting = self._waiting[len(ready) :]
        recorded = {topic: [payload for _, name, payload in ready if name == topic] for topic in _TOPICS}
        if not ready or self._differences:
            return
        self.began_within |= self._last is None and not recorded[PLAN_DECISION]
        made: dict[str, list[bytes]] = {topic: [] for topic in _TOPICS}
        for payload in recorded[PLAN_DECISION]:
            try:
                messages = list(self._made_again(payload))
            except SpatialReplayError as error:
                self._differences.append(f"at {_seconds(ready[0][0])}: {error}")
                return
            for _, topic, own in messages:
                made[topic].append(own)
        for topic in _TOPICS:
            self._compare(ready[0][0], topic, recorded[topic], made[topic])

    def _made_again(self, payload: bytes) -> Iterator[tuple[int, str, bytes]]:
        """The messages of a decision, or of the outcome that the log tells of."""
        message = _decision(payload)
        has_ended = message.HasField("outcome")
        if self._last is None and (has_ended or message.number):
            self.began_within = True
        if not has_ended:
            yield from self._decided_again(message.number)
        elif message.kind != PlanDecision.KIND_WAIT:
            # what became of a wait comes with the decision after it
            if not self._is_moving:
                raise LogError(f"the log tells how decision {message.number} went, and not of the decision")
            self._is_moving = False
            told = Outcome(message.outcome.succeeded, message.outcome.reason)
            yield from _planned(self._box.conclude(told))

    def _decided_again(self, number: int) -> Iterator[tuple[int, str, bytes]]:
        if self._is_moving and self._last is not None:
            raise LogError(f"the log tells of decision {number}, and not how {self._last.number} went before")
        self._last, messages = self._box.decide()
        self._is_moving = self._last.kind == "execute"
        self._decisions += 1
        self._maps += len(maps_of(self._last))
        yield from _planned(messages)

    def _what_is_missing(self) -> Iterator[str]:
        """What has to be told at the proper end of a run, and is not."""
        if self._last is None:
            yield "the log tells no decision, and a planned run has one at least"
            return
        which = f"decision {self._last.number} at {_seconds(self._last.time_ns)}"
        if self._is_moving:
            yield f"the log does not tell how {which} went"
        elif not _is_final(self._last, self._box.planner):
            yield f"the log tells nothing after {which}, which did not end the run"

    def _compare(self, time_ns: int, topic: str, recorded: list[bytes], made: list[bytes]) -> None:
        if len(recorded) != len(made):
            messages = counted(len(recorded), "message")
            self._differences.append(f"at {_seconds(time_ns)}: {messages} on {topic}, {len(made)} made again")
        for old, new in zip(recorded, made, strict=False):
            if old != new:
                self._differences.append(
                    f"at {_seconds(time_ns)}: {topic} differs{_difference(topic, old, new)}"
                )


def _decision(payload: bytes) -> PlanDecision:
    try:
        return PlanDecision.FromString(payload)
    except DecodeError as error:
        raise LogError(f"a message on {PLAN_DECISION} cannot be read") from error


def _is_final(step: Step, planner: Planner) -> bool:
    """Whether a decision can be the last one of a run that came to its proper end."""
    if step.kind == "hold":
        return planner.is_accepting or planner.is_doubtful
    return step.kind == "no path" or (step.kind == "wait" and planner.next_step() is step)


def _seconds(time_ns: int) -> str:
    return f"{time_ns / 1e9:.3f} s"


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
