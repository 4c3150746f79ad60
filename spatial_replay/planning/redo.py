"""Counterfactuals: what a planner would have decided, with other settings, on the samples of a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from spatial_replay.errors import LogError
from spatial_replay.lazy import Displayed
from spatial_replay.logs.messages import Block, Messages, merge, select
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.source import Source, SourceOf, read_blocks
from spatial_replay.logs.topics import (
    GRADIENT_MAP,
    PLAN_DECISION,
    PLAN_PATH,
    REDONE_DECISION,
    REDONE_MAP,
    REDONE_PATH,
)
from spatial_replay.planning.decision_log import decision_from_payload, explained_decision
from spatial_replay.planning.decisions import Step
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.read import (
    PlannerMessage,
    Rerun,
    iter_moments,
    planner_messages,
    planner_of,
    refuse_other,
    rerun_of,
)
from spatial_replay.planning.settings import changed_settings, changes_text
from spatial_replay.spec.format import format_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import window_of

_REDONE: Final = MappingProxyType(
    {PLAN_DECISION: REDONE_DECISION, GRADIENT_MAP: REDONE_MAP, PLAN_PATH: REDONE_PATH}
)


@dataclass(frozen=True, slots=True, eq=False)
class RedoneStep:
    """A decision as value and as message, which says what its maps are made of and has no outcome."""

    step: Step
    message: PlanDecision


@dataclass(frozen=True, slots=True, eq=False)
class Redone(Displayed):
    """What a planner would have decided on the samples of a log.

    After the first decision by which something else is done, the recorded samples say nothing more: they are
    what followed on the recorded one.

    Attributes:
        name: of the log.
        changes: what was changed, each as a sentence; empty if nothing was.
        decisions: how many the log has.
        same: how many, from the first on, are the same byte for byte, with all their maps.
        alike: how many in all, from the first on, do the same.
        sample: of the first decision that differs; None if all do the same.
        recorded, redone: that decision; `recorded` is None where the log has none at that sample.
        messages: of what was redone, the decision that differs included.
        faults: the parts of the log that could not be read.
    """

    name: str
    changes: tuple[str, ...]
    decisions: int
    same: int
    alike: int
    sample: Sample | None = field(repr=False)
    recorded: RedoneStep | None = field(repr=False)
    redone: RedoneStep | None = field(repr=False)
    messages: Messages = field(repr=False)
    faults: tuple[str, ...] = ()

    @property
    def is_different(self) -> bool:
        """Whether something else would have been done."""
        return self.redone is not None


def redo_decisions(
    source: Source,
    specification: Specification | None = None,
    changes: Mapping[str, Any] = MappingProxyType({}),
    *,
    name: str | None = None,
    advance: Callable[[int], None] = lambda samples: None,
) -> Redone:
    """Decide again on the samples of a planned run, with another specification or other settings.

    As long as the same is done, outcomes are those of the log. While both planners wait, the new one is asked
    at every sample, as `plan` does.

    Args:
        specification: to plan for instead of the recorded one.
        changes: to the recorded settings, by the keys of settings files.
        name: the spec to plan for, if there are several.
        advance: called with the number of samples after each block.

    Raises:
        UsageError: the log holds no plan; settings that do not go together; a specification that cannot be
            planned for.
        LogError: the settings or the specification of the plan cannot be read, or the recorded decisions do
            not follow from the samples.
    """
    old = planner_of(source)
    settings = changed_settings(old.settings, changes)
    if name is None and specification is None:
        name = old.automaton.name
    planner = Planner(
        old.specification if specification is None else specification,
        settings,
        name=name,
        rate_hz=old.rate_hz,
    )
    changed = (*_specification_changes(old, planner), *changes_text(old.settings, settings))
    faults: list[str] = []

    def iter_blocks() -> Iterator[Block]:
        for block in read_blocks(source):
            faults.extend(block.trace.faults)
            yield block
            advance(len(block.trace))

    redoing = _Redoing(source, planner, changed)
    for sample, messages in iter_moments(iter_blocks()):
        redoing.take(sample, messages)
    return redoing.redone(tuple(faults))


def _specification_changes(old: Planner, new: Planner) -> Iterator[str]:
    texts = [format_specification(each.specification) for each in (old, new)]
    names = [f"{each.specification.filename}, {each.automaton.name}" for each in (old, new)]
    if texts[0] != texts[1] or old.automaton.name != new.automaton.name:
        yield f"specification {names[0]} -> {names[1]}"


class _Redoing:
    """A run whose decisions are repeated as recorded, and redone beside."""

    def __init__(self, source: Source, planner: Planner, changes: tuple[str, ...]) -> None:
        self._source, self._changes = source, changes
        self._old = rerun_of(source)
        self._new = Rerun(planner, self._old.box.version)
        self._decisions = self._same = self._alike = 0
        self._sample: Sample | None = None
        self._recorded: RedoneStep | None = None
        self._redone: RedoneStep | None = None
        self._messages: list[Messages] = []

    def take(self, sample: Sample | None, recorded: list[PlannerMessage]) -> None:
        """Take a sample and the recorded messages that follow it."""
        decisions = [decision_from_payload(each.payload) for each in recorded if each.topic == PLAN_DECISION]
        made = [each for each in decisions if not each.HasField("outcome")]
        self._decisions += len(made)
        if self._redone is not None or sample is None:
            return
        self._old.box.observe(sample)
        self._new.box.observe(sample)
        waiting = self._new.last is not None and self._new.last.kind == "wait"
        if self._changes and waiting and not made:
            # what it decides now comes before anything in the log
            step, messages = self._new.box.decide()
            if step is not self._new.last:
                self._differ(sample, None, step, messages)
            return
        for decision in decisions:
            if not self._repeat(sample, decision, recorded):
                return

    def _repeat(self, sample: Sample, decision: PlanDecision, recorded: list[PlannerMessage]) -> bool:
        """Repeat a decision or its outcome; return whether the same was done."""
        before = self._new.last
        self._old.repeat(decision)
        messages = self._new.repeat(decision)
        if messages is None or decision.HasField("outcome"):
            if messages is not None:
                self._messages.append(_on_redone_topics(messages))
            return True
        old, new = self._old.last, self._new.last
        if old is None or new is None:
            return True
        refuse_other(self._source, old, decision)
        if new is before or not _does_the_same(old, new):
            first = min(
                (m.number for e in decision.considered for c in e.candidates for m in c.maps), default=0
            )
            explained = explained_decision(old, self._old.box.planner, first)
            self._differ(sample, RedoneStep(old, explained), new, messages)
            return False
        self._messages.append(_on_redone_topics(messages))
        if self._same == self._alike and _has_all(recorded, messages):
            self._same += 1
        self._alike += 1
        return True

    def _differ(self, sample: Sample, recorded: RedoneStep | None, step: Step, messages: Messages) -> None:
        self._sample, self._recorded = sample, recorded
        self._redone = RedoneStep(step, explained_decision(step, self._new.box.planner))
        self._messages.append(_on_redone_topics(messages))

    def redone(self, faults: tuple[str, ...]) -> Redone:
        """Return what was found.

        Raises:
            LogError: nothing was changed, and another decision was made nevertheless.
        """
        if self._redone is not None and not self._changes and not faults:
            raise LogError(
                f"the decisions in {self._source.name} do not follow from its samples; "
                "`spatial-replay verify --decisions` shows what differs"
            )
        return Redone(
            self._source.name,
            self._changes,
            self._decisions,
            self._same,
            self._alike,
            self._sample,
            self._recorded,
            self._redone,
            merge(self._messages),
            faults,
        )


def _does_the_same(old: Step, new: Step) -> bool:
    """Return whether two decisions have the robot do the same."""
    if old.kind != new.kind or (old.target is None) != (new.target is None):
        return False
    if old.target is None or new.target is None:
        return True
    return replace(old.target, robustness=0.0) == replace(new.target, robustness=0.0)


def _has_all(recorded: list[PlannerMessage], redone: Messages) -> bool:
    """Return whether the log has messages byte for byte."""
    payloads = {(each.topic, each.payload) for each in recorded}
    return all((each.topic, each.payload) in payloads for each in planner_messages(redone))


def _on_redone_topics(messages: Messages) -> Messages:
    channels = {
        number: replace(channel, topic=_REDONE[channel.topic])
        for number, channel in messages.channels.items()
    }
    return replace(messages, channels=channels)


@dataclass(frozen=True)
class RedoneSource(SourceOf):
    """A planned log with what would have been decided beside what was."""

    beside: Messages

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        done, _ = window_of(self.beside.log_time_ns, start_ns or 0, np.iinfo(np.int64).max)
        for block in self.source.iter_blocks(start_ns, end_ns):
            if not len(block.trace):
                yield block
                continue
            _, end = window_of(self.beside.log_time_ns, 0, int(block.trace.times_ns[-1]) + 1)
            own = select(self.beside, np.arange(done, max(done, end)))
            done = max(done, end)
            yield replace(block, messages=merge([block.messages, own]))
