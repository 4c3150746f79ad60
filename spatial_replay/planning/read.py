"""Decisions in logs: their messages, their verification, and decisions with other settings."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from os import PathLike
from types import MappingProxyType
from typing import Any, Final, NamedTuple, get_args

import numpy as np

from spatial_replay.errors import LogError, SpatialReplayError, UsageError
from spatial_replay.geometry.arrays import select
from spatial_replay.geometry.footprint import Footprint
from spatial_replay.lazy import Displayed, Printed
from spatial_replay.logs.mcap.read import McapSource
from spatial_replay.logs.messages import Block, Messages, merge
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanCandidate, PlanDecision
from spatial_replay.logs.source import Source, SourceOf, read_blocks
from spatial_replay.logs.topics import (
    ENDING,
    GRADIENT_MAP,
    MAP_DRAWING,
    METADATA,
    PLAN_DECISION,
    PLAN_METADATA,
    PLAN_PATH,
    RECORDED_PREFIX,
    REDONE_DECISION,
    REDONE_DRAWING,
    REDONE_MAP,
    REDONE_PATH,
)
from spatial_replay.planning.decision_log import (
    PLAN_VERSION,
    BlackBox,
    best_robustness,
    brief_lines,
    candidate_lines,
    decision_from_payload,
    decision_lines,
    decision_rows,
    demand_words,
    effort_text,
    explained_decision,
    latest_decisions,
    layers_of,
    maps_of,
    plain,
    plan_lines,
)
from spatial_replay.planning.decisions import Outcome, Stage, Step
from spatial_replay.planning.demands import Ban, ban_of
from spatial_replay.planning.maps import BlockedBy, GradientMap, danger_of
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings import Settings, changed_settings, changes_text, settings_from_text
from spatial_replay.sources.open_log import open_source
from spatial_replay.spec import parse_specification
from spatial_replay.spec.format import format_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.text import cut, json_fields, plural, time_text
from spatial_replay.trace.trace import Sample, window_of

PLANNER_TOPICS: Final = (PLAN_DECISION, GRADIENT_MAP, PLAN_PATH)


class LoggedDecisions(NamedTuple):
    """The decisions in a log.

    Attributes:
        decisions: one or more decisions in order, with their outcomes.
        faults: sentences on parts of the log that could not be read.
    """

    name: str
    decisions: tuple[PlanDecision, ...]
    faults: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """Yield lines on each decision: its aim, the candidates, the choice and the outcome."""
        return plan_lines(self.name, self.decisions)

    def brief(self, number: int) -> Iterator[str]:
        """Yield at most five lines on one decision.

        Raises:
            UsageError: the log has no decision with this number.
        """
        return brief_lines(self.decision(number))

    def decision(self, number: int) -> PlanDecision:
        """Return one decision.

        Raises:
            UsageError: the log has no decision with this number.
        """
        for decision in self.decisions:
            if decision.number == number:
                return decision
        raise UsageError(
            f"{self.name} has no decision {number}; it has {self.decisions[0].number} to "
            f"{self.decisions[-1].number}"
        )

    @property
    def document(self) -> dict[str, Any]:
        """The decisions as values for JSON."""
        rows = decision_rows(self.decisions)
        return {"name": self.name, "damaged": bool(self.faults), "decisions": rows}


def read_decisions(log: str | PathLike[str]) -> LoggedDecisions:
    """Read the messages of all decisions in a log.

    Raises:
        UsageError: the log has no decisions.
        MissingFileError, LogError: the log cannot be read.
    """
    source = open_source(log)
    decisions: list[PlanDecision] = []
    faults: list[str] = []
    if isinstance(source, McapSource):
        for payloads, payload_faults in source.iter_payloads(PLAN_DECISION):
            faults += payload_faults
            for payload in payloads:
                try:
                    decisions.append(decision_from_payload(payload))
                except LogError as error:
                    faults.append(f"{source.name}: {error}")
    if not decisions:
        raise _without_decisions(source)
    return LoggedDecisions(source.name, latest_decisions(decisions), tuple(faults))


def planner_of(source: Source) -> Planner:
    """Return the planner of a log, in the planner's state before the first sample.

    Raises:
        UsageError: the log holds no plan.
        LogError: the settings or the specification of the plan cannot be read.
    """
    plan_metadata = _plan_of(source)
    attachment_data = {attachment.name: attachment.data for attachment in source.attachments()}
    file_name = RECORDED_PREFIX + plan_metadata.get("file", "")
    if file_name not in attachment_data:
        raise LogError(f"{source.name} has lost {file_name!r}, the specification that was planned for")
    specification = parse_specification(
        attachment_data[file_name].decode("utf-8", "replace"), filename=plan_metadata.get("file", "<text>")
    )
    return Planner(
        specification,
        settings_from_text(plan_metadata.get("settings", "")),
        name=plan_metadata.get("specification"),
        rate_hz=_rate_of(plan_metadata),
    )


def obstacles_of(source: Source) -> Mapping[str, Footprint]:
    """Return the named obstacles of the workspace for which a log was planned.

    The result is empty without a plan, or with settings that cannot be read.
    """
    plan_metadata = dict(source.metadata()).get(PLAN_METADATA, {})
    try:
        return settings_from_text(plan_metadata.get("settings", "")).workspace.named_obstacles
    except LogError:
        return {}


def _rate_of(plan_metadata: Mapping[str, str]) -> float | None:
    rate_text = plan_metadata.get("rate_hz")
    try:
        return None if rate_text is None else float(rate_text)
    except ValueError:
        raise LogError(f"the plan's rate_hz is {rate_text!r:.40}, which is not a number") from None


def _plan_of(source: Source) -> Mapping[str, str]:
    plan_metadata = dict(source.metadata()).get(PLAN_METADATA)
    if plan_metadata is None:
        raise _without_decisions(source)
    return plan_metadata


def rerun_of(source: Source) -> Rerun:
    """Return the planned run of a log for a repetition from its first sample.

    Raises:
        UsageError: the log holds no plan.
        LogError: the settings or the specification of the plan cannot be read.
    """
    version = _plan_of(source).get("version", "")
    if version != str(PLAN_VERSION):
        raise LogError(
            f"the plan in {source.name} has version {version[:20]!r}, and this version of spatial-replay "
            f"recomputes {PLAN_VERSION}; use the version that wrote it"
        )
    return Rerun(planner_of(source))


def _without_decisions(source: Source) -> UsageError:
    return UsageError(f"{source.name} holds no decisions; `spatial-replay plan` makes logs that do")


@dataclass(frozen=True, slots=True, eq=False)
class LoggedStep(Printed, Displayed):
    """A decision of a planned run.

    Attributes:
        step: decision with all maps on which it depends.
        message: message of the decision in the log, with the outcome if there is one.
        sample: newest sample at the decision.
    """

    step: Step
    message: PlanDecision = field(repr=False)
    sample: Sample = field(repr=False)

    def lines(self) -> Iterator[str]:
        """Yield lines on the aim, the candidates, the choice and the outcome."""
        return decision_lines(self.message)


def read_steps(log: str | PathLike[str]) -> tuple[LoggedStep, ...]:
    """Read every step of a planned run, in order; each step is recomputed from the earlier samples.

    Raises:
        UsageError: the log holds no plan.
        MissingFileError, LogError: the log cannot be read, or a decision differs from its recomputation.
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
            rerun.take_messages()
            if decision.HasField("outcome"):
                steps[decision.number] = replace(steps[decision.number], message=decision)
            elif rerun.last is not None:
                refuse_other(source, rerun.last, decision)
                steps[decision.number] = LoggedStep(rerun.last, decision, sample)
    if not steps:
        raise _without_decisions(source)
    return tuple(steps.values())


def why_not_there(
    log: str | PathLike[str], number: int, name: str, place: tuple[float, float]
) -> Iterator[str]:
    """Yield the reasons why a decision does not bring an object to a place: each demand, and obstacles.

    Values are for the centre of the place's cell, in the target's orientation; without a target, for turn 0.

    Raises:
        UsageError: the log has no plan or no such decision, the decision did not consider the object, or the
            place is outside the object's map.
        MissingFileError, LogError: the log cannot be read.
    """
    steps = {logged.step.number: logged for logged in read_steps(log)}
    if number not in steps:
        raise UsageError(f"there is no decision {number}; the log has {min(steps)} to {max(steps)}")
    step = steps[number].step
    edge_candidates = [
        (edge, candidate)
        for edge in reversed(step.considered)
        for candidate in edge.candidates
        if candidate.name == name
    ]
    if not edge_candidates:
        candidate_names = {candidate.name for edge in step.considered for candidate in edge.candidates}
        names_text = ", ".join(sorted(candidate_names)) or "nothing"
        raise UsageError(f"decision {number} did not consider {name!r}; it considered: {names_text}")
    edge, candidate = edge_candidates[0]
    gradient, target = candidate.map, candidate.target
    grid = gradient.grid
    if not grid.contains(np.array(place)):
        first_centre, last_centre = grid.centre(0, 0), grid.centre(grid.rows - 1, grid.columns - 1)
        raise UsageError(
            f"({place[0]:g}, {place[1]:g}) is outside the map of {name}; the middles of its cells are from "
            f"({first_centre[0]:.4g}, {first_centre[1]:.4g}) to ({last_centre[0]:.4g}, {last_centre[1]:.4g})"
        )
    cell = gradient.cell_of(*place, 0.0 if target is None else target.turn)
    planner = planner_of(open_source(log))
    settings = planner.settings
    yield (
        f"{name} at ({place[0]:g}, {place[1]:g}) for the edge {edge.edge[0]} -> {edge.edge[1]}: robustness "
        f"{gradient.robustness[cell]:.4g}, {settings.margin:.4g} needed "
        f"({effort_text(steps[number].message)})"
    )
    layers = layers_of(candidate, settings)
    edge_message = steps[number].message.considered[step.considered.index(edge)]
    (logged,) = (message for message in edge_message.candidates if message.object == name)
    for layer in np.argsort(layers.robustness[(slice(None), *cell)], kind="stable").tolist():
        robustness = float(layers.robustness[(layer, *cell)])
        judgement = "not met" if robustness < 0.0 else "met"
        margin_note = f", but {settings.margin:.4g} needed" if 0.0 <= robustness < settings.margin else ""
        demand = plain(demand_words(logged.conjuncts[layer]))
        yield f"  {robustness:>9.4g}  {demand}: {judgement}{margin_note}"
    cause = layers.causes[layers.blocked_by[cell]] if layers.blocked_by[cell] >= 0 else None
    bans = planner.bans(edge, step.pruned)
    yield from (f"  {text}" for text in _blocking_texts(gradient, cell, cause, bans, settings))
    if target is not None:
        judgement = "chosen" if candidate.is_chosen else "possible"
        yield f"  {judgement} instead: ({target.x:.4g}, {target.y:.4g}), robustness {target.robustness:.4g}"
        if logged.rule:
            yield f"  rule: {logged.rule}"


def _blocking_texts(
    gradient: GradientMap,
    cell: tuple[int, int, int],
    cause: BlockedBy | None,
    bans: Sequence[Ban],
    settings: Settings,
) -> Iterator[str]:
    """Yield the causes that keep an object out of a cell, with numbers."""
    cause_kind = "" if cause is None else cause.kind
    if cause is not None and cause_kind == "constraint":
        danger = danger_of(gradient.made_of.now, gradient.made_of.constraints)[cell]
        rule = plain(ban_of(cause.name, bans).rule)
        if danger >= 0.0:
            yield f"blocked: on the way, {rule}: short by {danger:.4g}"
        else:
            margin = settings.constraint_margin
            yield f"blocked: on the way, {rule}: met by {-danger:.4g}, {margin:.4g} needed"
    maps = gradient.made_of.now
    distances = maps.distances[(slice(None), *cell)]
    if distances.size and distances.min() <= settings.workspace.clearance:
        nearest_index = int(maps.nearest()[cell])
        distance, name = (
            float(distances[nearest_index]),
            maps.obstacles[nearest_index] or "an obstacle of the workspace",
        )
        yield f"blocked: {name} stands there: " + (
            f"they overlap by {-distance:.4g}" if distance < 0.0 else f"{distance:.4g} is left between them"
        )
    other_causes = {"reach": "the robot does not reach it", "failed": "a motion failed near it"}
    if cause_kind in other_causes:
        yield f"blocked: {other_causes[cause_kind]}"
    elif cause_kind == "unknown":
        yield "blocked: a relation there is unknown"


def refuse_other(source: Source, step: Step, decision: PlanDecision) -> None:
    """Check that a recomputed step equals the recorded decision.

    Raises:
        LogError: the step differs from the decision.
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
    """A sample with the planner's messages until the next sample.

    `sample` is None for messages before the first sample.
    """

    sample: Sample | None
    messages: list[PlannerMessage]


def iter_moments(blocks: Iterable[Block]) -> Iterator[Moment]:
    """Iterate over samples, each with the planner's messages until the next sample."""
    moment = Moment(None, [])
    pending_messages: list[PlannerMessage] = []
    for block in blocks:
        pending_messages += planner_messages(block.messages)
        message_count = 0
        for sample in block.trace.samples():
            # a message at the time of a sample belongs to the sample
            while (
                message_count < len(pending_messages)
                and pending_messages[message_count].time_ns < sample.time_ns
            ):
                moment.messages.append(pending_messages[message_count])
                message_count += 1
            if moment.sample is not None or moment.messages:
                yield moment
            moment = Moment(sample, [])
        del pending_messages[:message_count]
    moment.messages.extend(pending_messages)
    if moment.sample is not None or moment.messages:
        yield moment


def planner_messages(messages: Messages) -> Iterator[PlannerMessage]:
    """Iterate over the messages on the planner's topics, in the order of the log."""
    for topic, row in zip(messages.topics, messages.rows(), strict=True):
        if topic in PLANNER_TOPICS:
            yield PlannerMessage(row.log_time_ns, topic, row.payload)


class Rerun:
    """A planned run that is repeated from the samples and outcomes of its log.

    Attributes:
        box: planner with its messages; samples go to its `observe`.
        last: newest repeated decision.
        is_moving: whether the newest decision's motion is not concluded yet.
    """

    def __init__(self, planner: Planner) -> None:
        """Begin before the first sample."""
        self._pending_messages: list[Messages] = []
        self.box = BlackBox(planner, self._pending_messages.append)
        self.last: Step | None = None
        self.is_moving = False

    def take_messages(self) -> Messages:
        """Return and forget the messages since the last call."""
        messages = merge(self._pending_messages)
        self._pending_messages.clear()
        return messages

    def repeat(self, recorded: PlanDecision) -> None:
        """Repeat a recorded decision, or conclude the decision with its recorded outcome.

        Raises:
            LogError: the previous decision has no outcome, or an outcome has no decision.
            UsageError: no sample was observed yet.
        """
        if not recorded.HasField("outcome"):
            if self.is_moving and self.last is not None:
                raise LogError(
                    f"the log has decision {recorded.number}, and no outcome of {self.last.number} before it"
                )
            self.last = self.box.next_step()
            self.is_moving = self.last.kind == "execute"
        # the next decision writes the outcome of a wait, so its repetition also repeats the outcome
        elif recorded.kind != PlanDecision.KIND_WAIT:
            if not self.is_moving:
                raise LogError(f"the log has the outcome of decision {recorded.number}, and not the decision")
            self.is_moving = False
            self.box.conclude(_outcome(recorded))


def _outcome(decision: PlanDecision) -> Outcome:
    stage_name = decision.outcome.at
    stage = next((name for name in get_args(Stage) if name == stage_name), None)
    if stage_name and stage is None:
        raise LogError(
            f"the outcome of decision {decision.number} is at {stage_name!r:.40}, not pick, way or place"
        )
    return Outcome(decision.outcome.succeeded, decision.outcome.reason, stage)


# ----------------------------------------------------------------------------------------------- verification


@dataclass(frozen=True, slots=True)
class Recomputed:
    """The result of recomputing the decisions of a log.

    Attributes:
        decisions: number of recomputed decisions.
        maps: number of recomputed gradient maps, one for each orientation of an object.
        differences: sentences on the differences from the log, each with its time.
        faults: sentences on parts of the log that could not be read.
    """

    decisions: int
    maps: int
    differences: tuple[str, ...]
    faults: tuple[str, ...] = ()


def recompute_decisions(source: Source, advance: Callable[[int], None] = lambda samples: None) -> Recomputed:
    """Recompute every decision of a planned run from its samples, and compare all messages byte for byte.

    Outcomes come from the controller, so the log gives the outcomes. A complete log without a decision, or
    without a decision after a motion, also counts as different.

    Args:
        advance: called with the number of samples of each block.

    Raises:
        UsageError: the log has no plan, or begins within the run.
        LogError: the settings or the specification of the plan cannot be read.
    """
    extent, comparison = _run_extent(source), _Comparison(rerun_of(source))
    faults: list[str] = []
    sample_count = 0
    for sample, recorded in iter_moments(_iter_blocks(source, faults, advance)):
        if sample is not None:
            comparison.rerun.box.observe(sample)
            sample_count += 1
        # all messages have the sample's time, unless the log has lost samples
        for time_ns, messages in groupby(recorded, key=lambda message: message.time_ns):
            comparison.compare(time_ns, list(messages))
    # a damaged log lacks samples, too, so only undamaged logs are checked for a begin within the run
    is_part = extent.is_copy if extent.samples is None else sample_count < extent.samples
    if not faults and is_part and (extent.is_cut or comparison.began_within):
        raise UsageError(
            f"{source.name} begins within the run, and decisions depend on all samples before; verify the "
            "log that it was made from, or name that one: --source SOURCE"
        )
    is_whole = sample_count == extent.samples and not extent.was_interrupted
    if not faults and not comparison.differences and is_whole:
        comparison.differences += _missing(comparison.rerun)
    return Recomputed(comparison.decisions, comparison.maps, tuple(comparison.differences), tuple(faults))


def _iter_blocks(source: Source, faults: list[str], advance: Callable[[int], None]) -> Iterator[Block]:
    for block in read_blocks(source):
        faults.extend(block.trace.faults)
        yield block
        advance(len(block.trace))


class _Comparison:
    """Comparison of the recorded and recomputed messages of a run.

    Attributes:
        rerun: repeated run.
        began_within: whether the log lacks the first decisions.
        decisions, maps: numbers of recomputed decisions and maps.
        differences: differences at the first time with different messages; later messages are not compared.
    """

    def __init__(self, rerun: Rerun) -> None:
        self.rerun = rerun
        self.began_within = False
        self.decisions = self.maps = 0
        self.differences: list[str] = []

    def compare(self, time_ns: int, recorded: list[PlannerMessage]) -> None:
        """Compare the messages of one time; the newest sample must be observed."""
        # after a different decision the planner's state differs, so all later messages would differ
        if self.differences:
            return
        is_first = self.rerun.last is None
        self.began_within |= is_first and not any(message.topic == PLAN_DECISION for message in recorded)
        recomputed: list[PlannerMessage] = []
        for message in recorded:
            if message.topic == PLAN_DECISION:
                try:
                    recomputed += self._recompute(decision_from_payload(message.payload))
                except SpatialReplayError as error:
                    self.differences.append(f"at {_seconds(time_ns)}: {error}")
                    return
        for topic in PLANNER_TOPICS:
            old_payloads, new_payloads = (
                [m.payload for m in messages if m.topic == topic] for messages in (recorded, recomputed)
            )
            self.differences += (
                f"at {_seconds(time_ns)}: {difference}"
                for difference in _differences(topic, old_payloads, new_payloads)
            )

    def _recompute(self, recorded: PlanDecision) -> Iterator[PlannerMessage]:
        has_outcome = recorded.HasField("outcome")
        self.began_within |= self.rerun.last is None and bool(has_outcome or recorded.number)
        self.rerun.repeat(recorded)
        if not has_outcome and self.rerun.last is not None:
            self.decisions += 1
            self.maps += len(maps_of(self.rerun.last))
        return planner_messages(self.rerun.take_messages())


def _missing(rerun: Rerun) -> Iterator[str]:
    """Yield a sentence if a complete log lacks a decision or an outcome."""
    last_step, planner = rerun.last, rerun.box.planner
    if last_step is None:
        yield "the log has no decision, and a planned run has at least one"
        return
    decision_text = f"decision {last_step.number} at {_seconds(last_step.time_ns)}"
    if rerun.is_moving:
        yield f"the log has no outcome of {decision_text}"
        return
    is_satisfied = last_step.kind == "hold" and (planner.is_accepting or planner.is_doubtful)
    is_waiting = last_step.kind == "wait" and planner.next_step() is last_step
    if not (is_satisfied or is_waiting or last_step.kind == "no path"):
        yield f"the log has no decision after {decision_text}, which did not end the run"


def _differences(topic: str, recorded: list[bytes], recomputed: list[bytes]) -> Iterator[str]:
    if len(recorded) != len(recomputed):
        yield f"{plural(len(recorded), 'message')} on {topic}, {len(recomputed)} recomputed"
    for old, new in zip(recorded, recomputed, strict=False):
        if old != new:
            yield f"{topic} differs{_differing_fields(old, new) if topic == PLAN_DECISION else ''}"


def _differing_fields(recorded: bytes, recomputed: bytes) -> str:
    old, new = map(decision_from_payload, (recorded, recomputed))
    names = (field.name for field in PlanDecision.DESCRIPTOR.fields)
    differing_names = [name for name in names if getattr(old, name) != getattr(new, name)]
    return f" in {', '.join(differing_names)} of decision {old.number}" if differing_names else ""


def _seconds(time_ns: int) -> str:
    return f"{time_ns / 1e9:.3f} s"


class _RunExtent(NamedTuple):
    """The part of a run that a log has, according to the log's metadata.

    Attributes:
        samples: number of samples of the run; None for a log without an end.
        was_interrupted: whether the run was interrupted.
        is_copy: whether a replay wrote the log.
        is_cut: whether the replay began after the source's first sample.
    """

    samples: int | None
    was_interrupted: bool
    is_copy: bool
    is_cut: bool


def _run_extent(source: Source) -> _RunExtent:
    metadata = dict(source.metadata())
    ending, log_metadata = metadata.get(ENDING, {}), metadata.get(METADATA, {})
    is_copy = log_metadata.get("written_by") == "replay"
    options = _value(log_metadata, "options", {}) if is_copy else {}
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


# --------------------------------------------------------------------------------------------- other settings

_REDONE: Final = MappingProxyType(
    {
        PLAN_DECISION: REDONE_DECISION,
        GRADIENT_MAP: REDONE_MAP,
        PLAN_PATH: REDONE_PATH,
        MAP_DRAWING: REDONE_DRAWING,
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class Replanned(Printed):
    """Decisions of a planner on the samples of a log, with another specification or other settings.

    The first decision with another motion ends the result, because later samples follow from the recorded
    motion.

    Attributes:
        name: name of the log.
        changes: sentences on the changes; empty if nothing was changed.
        decisions: number of decisions in the log.
        same: number of decisions at the beginning that are equal byte for byte, with all their maps.
        alike: number of decisions at the beginning with an equal motion, including equal decisions.
        recorded, redone: first decision with another motion; None without such a decision. `recorded` is also
            None if the log has no decision at the sample of `redone`.
        messages: messages of the redone decisions, including the first different decision.
        faults: sentences on parts of the log that could not be read.
    """

    name: str
    changes: tuple[str, ...]
    decisions: int
    same: int
    alike: int
    recorded: LoggedStep | None = field(repr=False)
    redone: LoggedStep | None = field(repr=False)
    messages: Messages = field(repr=False)
    faults: tuple[str, ...] = ()

    def lines(self, width: int = 100) -> Iterator[str]:
        """Yield lines on the number of equal decisions, and on the first different decision with both maps.

        Args:
            width: width of the two columns of maps, characters.
        """
        changes = ", ".join(self.changes) or "nothing changed"
        yield f"{self.name}: {plural(self.decisions, 'decision')}, redone with {changes}"
        if self.same:
            yield f"{_first(self.same, self.decisions)} the same, byte for byte, with all maps"
        if self.alike > self.same:
            alike_count = self.alike - self.same
            prefix = "then " if self.same else ""
            verb = "does" if alike_count == 1 else "do"
            yield f"{prefix}{plural(alike_count, 'decision')} {verb} the same, with other maps or reasons"
        if self.redone is None:
            return
        sample_time = time_text(self.redone.sample.time_ns)
        new_message = self.redone.message
        if self.recorded is None:
            yield f"at {sample_time}, where the log has no decision, the wait is over:"
        else:
            old_message = self.recorded.message
            yield f"decision {old_message.number} at {sample_time} differs"
            yield f"  recorded  {old_message.reason}"
        yield f"  redone    {new_message.reason}"
        if new_message.HasField("lost") and new_message.lost.text:
            yield f"            at {time_text(new_message.lost.time_ns)}: {new_message.lost.text}"
        yield from _maps_side_by_side(self, (width - 13) // 2)

    @property
    def document(self) -> dict[str, Any]:
        """The result as values for JSON."""
        sides = {
            side: None if step is None else decision_rows([step.message])[0]
            for side, step in (("recorded", self.recorded), ("redone", self.redone))
        }
        return {
            **json_fields(self, "name", "changes", "decisions", "same", "alike"),
            "damaged": bool(self.faults),
            "differs_ns": None if self.redone is None else self.redone.sample.time_ns,
            **sides,
        }

    @property
    def is_different(self) -> bool:
        """Whether a decision has another motion."""
        return self.redone is not None


def _first(equal_count: int, decision_count: int) -> str:
    if equal_count == decision_count:
        return "all decisions are" if decision_count > 1 else "the decision is"
    return f"the first {plural(equal_count, 'decision')} are" if equal_count > 1 else "the first decision is"


def _maps_side_by_side(redone: Replanned, column_width: int) -> Iterator[str]:
    """Yield lines on the maps of each object for the last edges, in two columns.

    Args:
        column_width: width of a column, characters.
    """
    if redone.recorded is None or redone.redone is None:
        return
    messages = redone.recorded.message, redone.redone.message
    sides = [
        {candidate.object: candidate for edge in message.considered[-1:] for candidate in edge.candidates}
        for message in messages
    ]
    for name in dict.fromkeys((*sides[0], *sides[1])):
        yield f"{f'map of {name}':<13}{'recorded':<{column_width}}redone"
        rows_by_side = [_map_rows(side.get(name)) for side in sides]
        for key in dict.fromkeys((*rows_by_side[0], *rows_by_side[1])):
            left_texts, right_texts = (
                [cut(text, column_width - 1) for text in row.get(key, ())] for row in rows_by_side
            )
            for line in range(max(len(left_texts), len(right_texts))):
                left, right = (
                    texts[line] if line < len(texts) else "" for texts in (left_texts, right_texts)
                )
                yield f"  {key if not line else '':<11}{left:<{column_width}}{right}".rstrip()


def _map_rows(candidate: PlanCandidate | None) -> dict[str, list[str]]:
    if candidate is None:
        return {}
    robustness = best_robustness(candidate)
    best_text = "nowhere free" if math.isinf(robustness) else f"{robustness:.4g}"
    texts_by_key = {"best": [best_text]}
    if candidate.HasField("target"):
        target = candidate.target
        texts_by_key["target"] = [f"({target.x:.4g}, {target.y:.4g}), robustness {target.robustness:.4g}"]
    elif candidate.rejected:
        texts_by_key["rejected"] = [candidate.rejected]
    for key, line in candidate_lines(candidate):
        texts_by_key.setdefault(key, []).append(line)
    return texts_by_key


def redo_decisions(
    source: Source,
    specification: Specification | None = None,
    changes: Mapping[str, Any] = MappingProxyType({}),
    *,
    name: str | None = None,
    advance: Callable[[int], None] = lambda samples: None,
) -> Replanned:
    """Decide again on the samples of a planned run, with another specification or other settings.

    Outcomes come from the log while both planners have equal motions. While both planners wait, the new
    planner decides at every sample, as in `plan`.

    Args:
        specification: specification to plan for instead of the recorded specification.
        changes: changes of the recorded settings, by the keys of settings files.
        name: name of the spec to plan for; needed if another specification has several results.
        advance: called with the number of samples of each block.

    Raises:
        UsageError: the log has no plan, settings contradict each other, or the planner refuses the
            specification.
        LogError: the settings or the specification of the plan cannot be read, or the recorded decisions do
            not follow from the samples.
    """
    old_planner = planner_of(source)
    settings = changed_settings(old_planner.settings, changes)
    if name is None and specification is None:
        name = old_planner.automaton.name
    planner = Planner(
        old_planner.specification if specification is None else specification,
        settings,
        name=name,
        rate_hz=old_planner.rate_hz,
    )
    change_texts = (
        *_specification_changes(old_planner, planner),
        *changes_text(old_planner.settings, settings),
    )
    faults: list[str] = []

    redoing = _Redoing(source, planner, bool(change_texts))
    for sample, messages in iter_moments(_iter_blocks(source, faults, advance)):
        redoing.take(sample, messages)
    if redoing.redone is not None and not change_texts and not faults:
        raise LogError(
            f"the decisions in {source.name} do not follow from its samples; "
            "`spatial-replay verify --decisions` shows what differs"
        )
    counts = redoing.decisions, redoing.same, redoing.alike
    steps = redoing.recorded, redoing.redone
    return Replanned(source.name, change_texts, *counts, *steps, merge(redoing.messages), tuple(faults))


def _specification_changes(old_planner: Planner, new_planner: Planner) -> Iterator[str]:
    texts = [format_specification(planner.specification) for planner in (old_planner, new_planner)]
    spec_names = [
        f"{planner.specification.filename}, {planner.automaton.name}"
        for planner in (old_planner, new_planner)
    ]
    if texts[0] != texts[1] or old_planner.automaton.name != new_planner.automaton.name:
        yield f"specification {spec_names[0]} -> {spec_names[1]}"
    old_constants, new_constants = (planner.specification.constants for planner in (old_planner, new_planner))
    for name in old_constants:
        if name in new_constants and old_constants[name].value != new_constants[name].value:
            yield f"const {name} {old_constants[name].value:g} -> {new_constants[name].value:g}"


class _Redoing:
    """A run whose recorded decisions are repeated and redone side by side; attributes as in `Replanned`."""

    def __init__(self, source: Source, planner: Planner, is_changed: bool) -> None:
        self._source, self._is_changed = source, is_changed
        self._old_run = rerun_of(source)
        self._new_run = Rerun(planner)
        self.decisions = self.same = self.alike = 0
        self.recorded: LoggedStep | None = None
        self.redone: LoggedStep | None = None
        self.messages: list[Messages] = []

    def take(self, sample: Sample | None, recorded: list[PlannerMessage]) -> None:
        """Process a sample and the recorded messages after it."""
        decisions = [
            decision_from_payload(message.payload) for message in recorded if message.topic == PLAN_DECISION
        ]
        new_decisions = [decision for decision in decisions if not decision.HasField("outcome")]
        self.decisions += len(new_decisions)
        if self.redone is not None or sample is None:
            return
        self._old_run.box.observe(sample)
        self._new_run.box.observe(sample)
        is_waiting = self._new_run.last is not None and self._new_run.last.kind == "wait"
        if self._is_changed and is_waiting and not new_decisions:
            # a decision of the new planner at this sample precedes the next recorded decision
            step = self._new_run.box.next_step()
            if step is not self._new_run.last:
                self._differ(sample, None, step, self._new_run.take_messages())
            return
        for decision in decisions:
            if not self._repeat(sample, decision, recorded):
                return

    def _repeat(self, sample: Sample, decision: PlanDecision, recorded: list[PlannerMessage]) -> bool:
        """Repeat a decision or its outcome with both planners; return whether their motions are equal."""
        previous_step = self._new_run.last
        self._old_run.repeat(decision)
        self._old_run.take_messages()
        self._new_run.repeat(decision)
        messages, old_step, new_step = self._new_run.take_messages(), self._old_run.last, self._new_run.last
        if old_step is None or new_step is None:
            return True
        if decision.HasField("outcome"):
            self.messages.append(_on_redone_topics(messages))
            return True
        refuse_other(self._source, old_step, decision)
        if new_step is previous_step or not _does_the_same(old_step, new_step):
            first_map = min(
                (m.number for e in decision.considered for c in e.candidates for m in c.maps), default=0
            )
            explained_message = explained_decision(old_step, self._old_run.box.planner, first_map)
            self._differ(sample, LoggedStep(old_step, explained_message, sample), new_step, messages)
            return False
        self.messages.append(_on_redone_topics(messages))
        if self.same == self.alike and _has_all(recorded, messages):
            self.same += 1
        self.alike += 1
        return True

    def _differ(self, sample: Sample, recorded: LoggedStep | None, step: Step, messages: Messages) -> None:
        self.recorded = recorded
        self.redone = LoggedStep(step, explained_decision(step, self._new_run.box.planner), sample)
        self.messages.append(_on_redone_topics(messages))


def _does_the_same(old: Step, new: Step) -> bool:
    """Return whether two decisions have equal motions; the robustness of their targets may differ."""
    targets = [step.target and replace(step.target, robustness=0.0) for step in (old, new)]
    return old.kind == new.kind and targets[0] == targets[1]


def _has_all(recorded: list[PlannerMessage], redone: Messages) -> bool:
    """Return whether the log has all redone messages, byte for byte."""
    payloads = {(message.topic, message.payload) for message in recorded}
    return all((message.topic, message.payload) in payloads for message in planner_messages(redone))


def _on_redone_topics(messages: Messages) -> Messages:
    channels = {
        number: replace(channel, topic=_REDONE[channel.topic])
        for number, channel in messages.channels.items()
    }
    return replace(messages, channels=channels)


@dataclass(frozen=True)
class ReplannedSource(SourceOf):
    """A planned log with redone decisions next to the recorded decisions."""

    beside: Messages

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        first_message, _ = window_of(self.beside.log_time_ns, start_ns or 0, np.iinfo(np.int64).max)
        for block in self.source.iter_blocks(start_ns, end_ns):
            if not len(block.trace):
                yield block
                continue
            _, end_message = window_of(self.beside.log_time_ns, 0, int(block.trace.times_ns[-1]) + 1)
            replanned = select(self.beside, np.arange(first_message, max(first_message, end_message)))
            first_message = max(first_message, end_message)
            yield replace(block, messages=merge([block.messages, replanned]))
