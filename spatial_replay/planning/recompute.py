"""Recomputed decisions: every decision of a log repeated from its samples, and compared bit for bit."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

from spatial_replay.errors import LogError, SpatialReplayError, UsageError
from spatial_replay.logs.messages import Block
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.source import Source, read_blocks
from spatial_replay.logs.topics import ENDING, METADATA, PLAN_DECISION
from spatial_replay.planning.decision_log import decision_from_payload
from spatial_replay.planning.decisions import Step
from spatial_replay.planning.map_messages import maps_of
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.read import (
    PLANNER_TOPICS,
    PlannerMessage,
    Rerun,
    iter_moments,
    planner_messages,
    rerun_of,
)
from spatial_replay.text import counted


@dataclass(frozen=True, slots=True)
class Recomputed:
    """The result of recomputing the decisions of a log.

    Attributes:
        decisions: how many decisions were recomputed.
        maps: how many gradient maps were recomputed, one for each orientation of an object.
        differences: what differs from the log, each with its place.
        faults: the parts of the log that could not be read.
    """

    decisions: int
    maps: int
    differences: tuple[str, ...]
    faults: tuple[str, ...] = ()


def recompute_decisions(source: Source, advance: Callable[[int], None] = lambda samples: None) -> Recomputed:
    """Recompute every decision of a planned run from its samples alone, and compare all messages' bytes.

    Outcomes come from the controller, so they are taken from the log. A complete log with no decision, or
    with none after a motion, differs too.

    Args:
        advance: called with the number of samples after each block.

    Raises:
        UsageError: the log holds no plan, or begins within the run.
        LogError: the settings or the specification of the plan cannot be read.
    """
    extent, comparison = _run_extent(source), _Comparison(rerun_of(source))
    faults: list[str] = []
    samples = 0

    def iter_blocks() -> Iterator[Block]:
        for block in read_blocks(source):
            faults.extend(block.trace.faults)
            yield block
            advance(len(block.trace))

    for sample, messages in iter_moments(iter_blocks()):
        if sample is not None:
            comparison.rerun.box.observe(sample)
            samples += 1
        comparison.compare(messages)
    # a log of which parts are missing has other differences than that it is incomplete
    if not faults and extent.is_part(samples) and (extent.is_cut or comparison.began_within):
        raise UsageError(
            f"{source.name} begins within the run, and decisions depend on all samples before; verify the "
            "log that it was made from, or name that one: --source SOURCE"
        )
    if not faults and extent.is_whole(samples):
        comparison.compare_end()
    return Recomputed(comparison.decisions, comparison.maps, tuple(comparison.differences), tuple(faults))


class _Comparison:
    """The recorded and the recomputed messages of one run.

    Attributes:
        rerun: the run that is repeated.
        began_within: whether the log lacks the first decisions.
        decisions, maps: how many were recomputed.
        differences: between the messages; after the first ones, nothing more is compared.
    """

    def __init__(self, rerun: Rerun) -> None:
        self.rerun = rerun
        self.began_within = False
        self.decisions = self.maps = 0
        self.differences: list[str] = []

    def compare(self, recorded: list[PlannerMessage]) -> None:
        """Compare the messages that follow the newest sample."""
        # they all have its time, unless the log has lost samples
        for time_ns, messages in groupby(recorded, key=lambda each: each.time_ns):
            self._compare_at(time_ns, list(messages))

    def _compare_at(self, time_ns: int, recorded: list[PlannerMessage]) -> None:
        # a planner that took another decision is in another state, so all later messages would differ
        if self.differences:
            return
        is_first = self.rerun.last is None
        self.began_within |= is_first and not any(each.topic == PLAN_DECISION for each in recorded)
        recomputed: list[PlannerMessage] = []
        for message in recorded:
            if message.topic == PLAN_DECISION:
                try:
                    recomputed += self._recomputed(decision_from_payload(message.payload))
                except SpatialReplayError as error:
                    self.differences.append(f"at {_seconds(time_ns)}: {error}")
                    return
        for topic in PLANNER_TOPICS:
            old, new = ([m.payload for m in each if m.topic == topic] for each in (recorded, recomputed))
            self.differences += (f"at {_seconds(time_ns)}: {what}" for what in _differences(topic, old, new))

    def _recomputed(self, recorded: PlanDecision) -> Iterator[PlannerMessage]:
        has_outcome = recorded.HasField("outcome")
        self.began_within |= self.rerun.last is None and bool(has_outcome or recorded.number)
        messages = self.rerun.repeat(recorded)
        if not has_outcome and self.rerun.last is not None:
            self.decisions += 1
            self.maps += len(maps_of(self.rerun.last))
        return iter(()) if messages is None else planner_messages(messages)

    def compare_end(self) -> None:
        """Add what a log lacks that goes on to the end of its run."""
        if not self.differences and (missing := self._missing()):
            self.differences.append(missing)

    def _missing(self) -> str:
        last = self.rerun.last
        if last is None:
            return "the log has no decision, and a planned run has at least one"
        which = f"decision {last.number} at {_seconds(last.time_ns)}"
        if self.rerun.is_moving:
            return f"the log has no outcome of {which}"
        if not _can_end_run(last, self.rerun.box.planner):
            return f"the log has no decision after {which}, which did not end the run"
        return ""


def _can_end_run(step: Step, planner: Planner) -> bool:
    """Return whether a decision can be the last one of a complete run."""
    if step.kind == "hold":
        return planner.is_accepting or planner.is_doubtful
    return step.kind == "no path" or (step.kind == "wait" and planner.next_step() is step)


def _differences(topic: str, recorded: list[bytes], recomputed: list[bytes]) -> Iterator[str]:
    if len(recorded) != len(recomputed):
        yield f"{counted(len(recorded), 'message')} on {topic}, {len(recomputed)} recomputed"
    for old, new in zip(recorded, recomputed, strict=False):
        if old != new:
            yield f"{topic} differs{_differing_fields(old, new) if topic == PLAN_DECISION else ''}"


def _differing_fields(recorded: bytes, recomputed: bytes) -> str:
    one, other = map(decision_from_payload, (recorded, recomputed))
    names = (field.name for field in PlanDecision.DESCRIPTOR.fields)
    fields = [name for name in names if getattr(one, name) != getattr(other, name)]
    return f" in {', '.join(fields)} of decision {one.number}" if fields else ""


def _seconds(time_ns: int) -> str:
    return f"{time_ns / 1e9:.3f} s"


class _RunExtent(NamedTuple):
    """How much of a run a log has, by its metadata.

    Attributes:
        samples: of the run; None if it did not come to its end.
        was_interrupted: whether the run was ended from outside.
        is_copy: whether a replay wrote the log.
        is_cut: whether that replay began after the source's first sample.
    """

    samples: int | None
    was_interrupted: bool
    is_copy: bool
    is_cut: bool

    def is_whole(self, samples: int) -> bool:
        """Return whether a log of so many samples goes on to the regular end of the run."""
        return samples == self.samples and not self.was_interrupted

    def is_part(self, samples: int) -> bool:
        """Return whether a log of so many samples may lack some of the run."""
        return self.is_copy if self.samples is None else samples < self.samples


def _run_extent(source: Source) -> _RunExtent:
    metadata = dict(source.metadata())
    ending, about = metadata.get(ENDING, {}), metadata.get(METADATA, {})
    is_copy = about.get("written_by") == "replay"
    options = _value(about, "options", {}) if is_copy else {}
    samples = _value(ending, "samples", None)
    if not isinstance(options, dict) or not isinstance(samples, int | None):
        raise LogError(f"the metadata of {source.name} has {samples!r} samples and options {options!r}")
    was_interrupted = _value(ending, "interrupted", False) is not False
    return _RunExtent(samples, was_interrupted, is_copy, "start_ns" in options)


def _value(texts: Mapping[str, str], key: str, default: object) -> object:
    try:
        return json.loads(texts[key]) if key in texts else default
    except ValueError as error:
        raise LogError(f"{key!r} in the log's metadata cannot be read: {error}") from error
