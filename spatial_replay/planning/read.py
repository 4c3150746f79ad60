"""Decisions in logs: read as messages, or repeated from the samples as values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Final, NamedTuple, get_args

from spatial_replay.errors import LogError, UsageError
from spatial_replay.lazy import Displayed
from spatial_replay.logs.mcap.reader import McapSource
from spatial_replay.logs.messages import Block, Messages
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.source import Source, read_blocks
from spatial_replay.logs.topics import (
    GRADIENT_MAP,
    PLAN_DECISION,
    PLAN_METADATA,
    PLAN_PATH,
    RECORDED_PREFIX,
)
from spatial_replay.planning.decision_log import (
    PLAN_VERSION,
    BlackBox,
    decision_from_payload,
    latest_decisions,
)
from spatial_replay.planning.decisions import Outcome, Stage, Step
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings import settings_from_text
from spatial_replay.sources.open_log import open_source
from spatial_replay.spec import parse_specification
from spatial_replay.trace.sample import Sample

PLANNER_TOPICS: Final = (PLAN_DECISION, GRADIENT_MAP, PLAN_PATH)


class LoggedDecisions(NamedTuple):
    """The decisions in a log.

    Attributes:
        decisions: one or more, in order, each with its outcome if it has one.
        faults: the parts of the log that could not be read.
    """

    decisions: tuple[PlanDecision, ...]
    faults: tuple[str, ...]


def read_decisions(log: str | PathLike[str]) -> LoggedDecisions:
    """Read the messages of all decisions in a log.

    Raises:
        UsageError: the log has none.
        MissingFileError, LogError: the log cannot be read.
    """
    source = open_source(log)
    decisions: list[PlanDecision] = []
    faults: list[str] = []
    if isinstance(source, McapSource):
        for payloads, lost in source.iter_payloads(PLAN_DECISION):
            faults += lost
            for payload in payloads:
                try:
                    decisions.append(decision_from_payload(payload))
                except LogError as error:
                    faults.append(f"{source.name}: {error}")
    if not decisions:
        raise _without_decisions(source)
    return LoggedDecisions(latest_decisions(decisions), tuple(faults))


def planner_of(source: Source) -> Planner:
    """Return the planner that a log was made with, before its first sample.

    Raises:
        UsageError: the log holds no plan.
        LogError: the settings or the specification of the plan cannot be read.
    """
    about = _plan_of(source)
    texts = {attachment.name: attachment.data for attachment in source.attachments()}
    name = RECORDED_PREFIX + about.get("file", "")
    if name not in texts:
        raise LogError(f"{source.name} has lost {name!r}, the specification that was planned for")
    specification = parse_specification(
        texts[name].decode("utf-8", "replace"), filename=about.get("file", "<text>")
    )
    return Planner(
        specification,
        settings_from_text(about.get("settings", "")),
        name=about.get("specification"),
        rate_hz=_rate_of(about),
    )


def _rate_of(about: Mapping[str, str]) -> float | None:
    text = about.get("rate_hz")
    try:
        return None if text is None else float(text)
    except ValueError:
        raise LogError(f"the plan's rate_hz is {text!r:.40}, which is not a number") from None


def _plan_of(source: Source) -> Mapping[str, str]:
    about = dict(source.metadata()).get(PLAN_METADATA)
    if about is None:
        raise _without_decisions(source)
    return about


def _version_of(source: Source) -> int:
    """Return what messages of a log's planner say."""
    text = _plan_of(source).get("version", "1")
    if not text.isdecimal() or not 1 <= int(text) <= PLAN_VERSION:
        raise LogError(
            f"the plan in {source.name} has version {text[:20]!r}, and this version of spatial-replay "
            f"recomputes 1 to {PLAN_VERSION}; use a newer one"
        )
    return int(text)


def rerun_of(source: Source) -> Rerun:
    """Return the planned run of a log, to repeat it from before its first sample.

    Raises:
        UsageError: the log holds no plan.
        LogError: the settings or the specification of the plan cannot be read.
    """
    return Rerun(planner_of(source), _version_of(source))


def _without_decisions(source: Source) -> UsageError:
    return UsageError(f"{source.name} holds no decisions; `spatial-replay plan` makes logs that do")


@dataclass(frozen=True, slots=True, eq=False)
class LoggedStep(Displayed):
    """A step of a planned run, from its log.

    Attributes:
        step: the decision, with all maps that it depends on.
        sample: the sample that it was made on.
        outcome: how the motion or the wait ended; None without either, or if the log ends before.
        end_ns: when it ended, if it did.
        travelled: points (x, y) that the object passed.
    """

    step: Step
    sample: Sample = field(repr=False)
    outcome: Outcome | None
    end_ns: int | None
    travelled: tuple[tuple[float, float], ...] = field(repr=False)


def read_steps(log: str | PathLike[str]) -> tuple[LoggedStep, ...]:
    """Read every step of a planned run, in order, each recomputed from the samples before it.

    Raises:
        UsageError: the log holds no plan.
        MissingFileError, LogError: the log cannot be read, or has other decisions than those recomputed.
    """
    source = open_source(log)
    rerun = rerun_of(source)
    steps: dict[int, LoggedStep] = {}
    for sample, messages in iter_moments(read_blocks(source)):
        if sample is not None:
            rerun.box.observe(sample)
        for message in messages:
            if message.topic != PLAN_DECISION:
                continue
            decision = decision_from_payload(message.payload)
            if sample is None or sample.time_ns != message.time_ns:
                raise LogError(
                    f"{source.name} has lost the sample at {message.time_ns} ns, on which a decision depends"
                )
            rerun.repeat(decision)
            if decision.HasField("outcome"):
                steps[decision.number] = _ended(steps[decision.number], decision)
            elif rerun.last is not None:
                refuse_other(source, rerun.last, decision)
                steps[decision.number] = LoggedStep(rerun.last, sample, None, None, ())
    if not steps:
        raise _without_decisions(source)
    return tuple(steps.values())


def _ended(logged: LoggedStep, decision: PlanDecision) -> LoggedStep:
    outcome = decision.outcome
    travelled = tuple(zip(outcome.travelled[::2], outcome.travelled[1::2], strict=True))
    return replace(logged, outcome=_outcome(decision), end_ns=outcome.end_ns, travelled=travelled)


def refuse_other(source: Source, step: Step, decision: PlanDecision) -> None:
    """Check that a recomputed step is the recorded decision.

    Raises:
        LogError: it is another one.
    """
    if (step.number, step.reason) != (decision.number, decision.reason):
        raise LogError(
            f"decision {decision.number} in {source.name} is {decision.reason!r}; recomputed, it is "
            f"{step.reason!r}; `spatial-replay verify --decisions` shows what differs"
        )


class PlannerMessage(NamedTuple):
    """A message on one of the planner's topics."""

    time_ns: int
    topic: str
    payload: bytes


class Moment(NamedTuple):
    """A sample, None before the first one, and the planner's messages from it until the next sample."""

    sample: Sample | None
    messages: list[PlannerMessage]


def iter_moments(blocks: Iterable[Block]) -> Iterator[Moment]:
    """Iterate over samples with the planner's messages that follow each of them."""
    moment = Moment(None, [])
    waiting: list[PlannerMessage] = []
    for block in blocks:
        waiting += planner_messages(block.messages)
        taken = 0
        for sample in block.trace.samples():
            while taken < len(waiting) and waiting[taken].time_ns < sample.time_ns:
                moment.messages.append(waiting[taken])
                taken += 1
            if moment.sample is not None or moment.messages:
                yield moment
            moment = Moment(sample, [])
        del waiting[:taken]
    moment.messages.extend(waiting)
    if moment.sample is not None or moment.messages:
        yield moment


def planner_messages(messages: Messages) -> Iterator[PlannerMessage]:
    """Iterate over the messages on the planner's topics, in their order."""
    topics = {number: channel.topic for number, channel in messages.channels.items()}
    columns = messages.channel.tolist(), messages.log_time_ns.tolist(), messages.payloads
    for number, time_ns, payload in zip(*columns, strict=True):
        if topics[number] in PLANNER_TOPICS:
            yield PlannerMessage(time_ns, topics[number], payload)


class Rerun:
    """A planned run that is repeated from the samples and outcomes of its log.

    Attributes:
        box: the planner; samples go to its `observe`.
        last: the decision repeated last.
        is_moving: whether its motion has not been concluded yet.
    """

    def __init__(self, planner: Planner, version: int = PLAN_VERSION) -> None:
        """Begin before the first sample.

        Args:
            version: of what messages say, see `PLAN_VERSION`.
        """
        self.box = BlackBox(planner, version=version)
        self.last: Step | None = None
        self.is_moving = False

    def repeat(self, recorded: PlanDecision) -> Messages | None:
        """Repeat a recorded decision, or conclude it with its recorded outcome; return the messages of that.

        Raises:
            LogError: a decision without the outcome of the one before, or an outcome without a decision.
            UsageError: nothing was observed yet.
        """
        if not recorded.HasField("outcome"):
            if self.is_moving and self.last is not None:
                raise LogError(
                    f"the log has decision {recorded.number}, and no outcome of {self.last.number} before it"
                )
            self.last, messages = self.box.decide()
            self.is_moving = self.last.kind == "execute"
            return messages
        if recorded.kind == PlanDecision.KIND_WAIT:
            # the outcome of a wait is written with the next decision, and so is repeated with it
            return None
        if not self.is_moving:
            raise LogError(f"the log has the outcome of decision {recorded.number}, and not the decision")
        self.is_moving = False
        return self.box.conclude(_outcome(recorded))


def _outcome(decision: PlanDecision) -> Outcome:
    at = decision.outcome.at
    stage = next((each for each in get_args(Stage) if each == at), None)
    if at and stage is None:
        raise LogError(f"the outcome of decision {decision.number} is at {at!r:.40}, not pick, way or place")
    return Outcome(decision.outcome.succeeded, decision.outcome.reason, stage)
