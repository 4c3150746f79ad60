"""The decisions that a log tells of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import DecodeError

from spatial_replay.errors import UsageError
from spatial_replay.logs.mcap_reader import McapSource
from spatial_replay.logs.messages.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.source import open_source
from spatial_replay.logs.topics import PLAN_DECISION


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
