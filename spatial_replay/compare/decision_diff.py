"""The first decision in which two planned runs differ."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from spatial_replay.errors import UsageError
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.source import Source
from spatial_replay.planning.read import read_decisions


class DecisionDiff(NamedTuple):
    """The first decision of two planned runs that differs.

    Attributes:
        number: of the decision, from 0.
        a, b: the decisions in words, or that there is none.
        a_ns, b_ns: when they were made.
        maps: the objects whose gradient maps differ.
    """

    number: int
    a: str
    b: str
    a_ns: int | None
    b_ns: int | None
    maps: tuple[str, ...]


def compare_decisions(sources: tuple[Source, Source]) -> DecisionDiff | None:
    """Return the first decision that differs, or None; of logs that were not planned, None."""
    decisions: list[tuple[PlanDecision, ...]] = []
    for source in sources:
        path = getattr(source, "path", None)
        found: tuple[PlanDecision, ...] = ()
        if isinstance(path, Path) and source.kind == "MCAP":
            with suppress(UsageError):
                found = read_decisions(path).decisions
        decisions.append(found)
    for number in range(max(map(len, decisions))):
        pair = [own[number] if number < len(own) else None for own in decisions]
        if _compared(pair[0]) != _compared(pair[1]):
            hashes = [_map_hashes(decision) for decision in pair]
            maps = sorted(
                name for name in hashes[0].keys() & hashes[1].keys() if hashes[0][name] != hashes[1][name]
            )
            texts = [_decision_text(decision) for decision in pair]
            times_ns = [None if decision is None else decision.time_ns for decision in pair]
            return DecisionDiff(number, texts[0], texts[1], times_ns[0], times_ns[1], tuple(maps))
    return None


def _compared(decision: PlanDecision | None) -> bytes | None:
    """Return what of a decision counts: what is to be done and why, not when it was made or how it went."""
    if decision is None:
        return None
    copy = PlanDecision.FromString(decision.SerializeToString())
    copy.ClearField("time_ns")
    copy.ClearField("outcome")
    copied: bytes = copy.SerializeToString(deterministic=True)
    return copied


def _map_hashes(decision: PlanDecision | None) -> dict[str, tuple[bytes, ...]]:
    hashes: dict[str, tuple[bytes, ...]] = {}
    for edge in () if decision is None else decision.considered:
        for candidate in edge.candidates:
            hashes[candidate.object] = (*hashes.get(candidate.object, ()), candidate.map_sha256)
    return hashes


def _decision_text(decision: PlanDecision | None) -> str:
    if decision is None:
        return "none: the run has no such decision"
    target = decision.target
    where = f"; {target.object} to ({target.x:.4g}, {target.y:.4g})" if decision.HasField("target") else ""
    return f"{decision.reason}{where}"
