"""The decisions that a log tells of.

The steps of a planned run as values, made again from its log.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

from google.protobuf.message import DecodeError

from spatial_replay.errors import LogError, UsageError
from spatial_replay.lazy import Displayed
from spatial_replay.logs.mcap.reader import McapSource
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.source import Source, read_blocks
from spatial_replay.logs.topics import PLAN_DECISION
from spatial_replay.planning.decisions import Outcome, Step
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.recompute import planner_of
from spatial_replay.sources.open_log import open_source
from spatial_replay.trace.sample import Sample


@dataclass(frozen=True, slots=True)
class Told:
    """What a log tells of decisions.

    Attributes:
        decisions: one or more, in order, each with its outcome if it has one.
        faults: what was lost while reading, each with its place.
    """

    decisions: tuple[PlanDecision, ...]
    faults: tuple[str, ...]


def read_decisions(log: Path) -> Told:
    """Every decision in a log.

    Raises:
        UsageError: the log holds none.
        MissingFileError, LogError: the log cannot be read.
    """
    source = open_source(log)
    decisions: dict[int, PlanDecision] = {}
    faults: list[str] = []
    if isinstance(source, McapSource):
        for payloads, lost in source.iter_payloads(PLAN_DECISION):
            faults += lost
            for payload in payloads:
                try:
                    decision = PlanDecision.FromString(payload)
                except DecodeError as error:
                    faults.append(f"{source.name}: a message on {PLAN_DECISION} cannot be read: {error}")
                    continue
                # the one with the outcome comes later and says everything that the first one does
                decisions[decision.number] = decision
    if not decisions:
        raise UsageError(f"{source.name} holds no decisions; `spatial-replay plan` makes logs that do")
    return Told(tuple(decisions[number] for number in sorted(decisions)), tuple(faults))


@dataclass(frozen=True, slots=True, eq=False)
class LoggedStep(Displayed):
    """A step that a log tells of.

    Attributes:
        step: the decision, with all maps that it rests on.
        sample: what it was made on.
        outcome: how its execution or the wait went; None of what has none, or where the log ends before.
        end_ns: when it ended, if it did.
        travelled: points (x, y) that the object went through.
    """

    step: Step
    sample: Sample = field(repr=False)
    outcome: Outcome | None
    end_ns: int | None
    travelled: tuple[tuple[float, float], ...] = field(repr=False)


def read_steps(log: str | PathLike[str]) -> tuple[LoggedStep, ...]:
    """Every step of a planned run, in order, each made again from the samples before it.

    Raises:
        UsageError: the log holds no plan.
        MissingFileError, LogError: the log cannot be read, or tells of other decisions.
    """
    path = Path(log)
    source = open_source(path)
    run = _Run(source.name, planner_of(source), _iter_samples(source))
    return tuple([run.step(decision) for decision in read_decisions(path).decisions])


class _Run:
    """A run that a planner watches again."""

    def __init__(self, name: str, planner: Planner, samples: Iterator[Sample]) -> None:
        self._name = name
        self._planner = planner
        self._samples = samples
        self._sample: Sample | None = None

    def step(self, decision: PlanDecision) -> LoggedStep:
        """The next step; afterwards the run is where its execution ended."""
        sample = self._observe_until(decision.time_ns)
        step = self._planner.next_step()
        if (step.number, step.reason) != (decision.number, decision.reason):
            raise LogError(
                f"{self._name} tells of decision {decision.number}: {decision.reason!r}; made again it is "
                f"{step.reason!r}; `spatial-replay verify --decisions` says what differs"
            )
        if not decision.HasField("outcome"):
            return LoggedStep(step, sample, None, None, ())
        told = decision.outcome
        outcome = Outcome(told.succeeded, told.reason)
        self._observe_until(told.end_ns)
        if step.kind == "execute":
            self._planner.conclude(outcome)
        travelled = tuple(zip(told.travelled[::2], told.travelled[1::2], strict=True))
        return LoggedStep(step, sample, outcome, told.end_ns, travelled)

    def _observe_until(self, time_ns: int) -> Sample:
        """Watch up to the sample of a time."""
        while self._sample is None or self._sample.time_ns < time_ns:
            self._sample = next(self._samples, None)
            if self._sample is None:
                raise LogError(f"{self._name} has lost the sample at {time_ns} ns, on which a decision rests")
            self._planner.observe(self._sample)
        return self._sample


def _iter_samples(source: Source) -> Iterator[Sample]:
    for block in read_blocks(source):
        yield from block.trace.samples()
