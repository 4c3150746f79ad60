"""The decisions that a log tells of."""

from __future__ import annotations

from pathlib import Path

from google.protobuf.message import DecodeError

from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.mcap_reader import McapSource
from spatial_replay.logs.messages.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.source import open_source
from spatial_replay.planning.black_box import DECISION


def read_decisions(log: Path) -> list[PlanDecision]:
    """Every decision in a log, in order, each with its outcome if it has one.

    Raises:
        UsageError: the log holds none.
        MissingFileError, LogError: the log cannot be read.
    """
    source = open_source(log)
    decisions: dict[int, PlanDecision] = {}
    if isinstance(source, McapSource):
        for payloads, _ in source.iter_payloads(DECISION):
            for payload in payloads:
                try:
                    decision = PlanDecision.FromString(payload)
                except DecodeError as error:
                    raise LogError(
                        f"{source.name}: a message on {DECISION} cannot be read: {error}"
                    ) from error
                # the one with the outcome comes later and says everything that the first one does
                decisions[decision.number] = decision
    if not decisions:
        raise UsageError(f"{source.name} holds no decisions; `spatial-replay plan` makes logs that do")
    return [decisions[number] for number in sorted(decisions)]
