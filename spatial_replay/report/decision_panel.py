"""Messages of a planner → its decisions as the page shows them, with their maps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.schemas.PlanDecision_pb2 import (
    PlanCandidate,
    PlanDecision,
    PlanEdge,
    PlanGuard,
    PlanTarget,
)
from spatial_replay.planning.decision_log import decision_from_payload, latest_decisions, map_fields
from spatial_replay.planning.decisions import Reason, candidate_lines, cause_text
from spatial_replay.report.compact import Packing, singles
from spatial_replay.text import number_text

MOST_CELLS: Final = 1_500_000
"""Cells of all maps of a page together, at most; maps of chosen targets come first."""
_MOST_GUARDS: Final = 4
_MOST_LAYERED: Final = 50_000
"""Cells of a map of which a page says what limits and blocks them."""


@dataclass(frozen=True, eq=False)
class ReportedDecisions:
    """The decisions in a log, with the gradient maps.

    Attributes:
        decisions: in order, each with its outcome if it has one.
        maps: by the number by which decisions name them, in the order of the log.
        redone: what would have been decided otherwise, if the log has that.
    """

    decisions: tuple[PlanDecision, ...]
    maps: Mapping[int, Grid]
    redone: ReportedDecisions | None = None


class DecisionCollector:
    """Collects decisions and maps from messages as they come."""

    def __init__(self) -> None:
        self._decisions: list[PlanDecision] = []
        self._maps: dict[int, Grid] = {}
        self._redone: DecisionCollector | None = None

    @property
    def redone(self) -> DecisionCollector:
        """What collects the decisions that would have been made otherwise."""
        self._redone = self._redone or DecisionCollector()
        return self._redone

    def add_decision(self, payload: bytes) -> None:
        """Take in a decision; one that cannot be decoded is skipped."""
        with suppress(LogError):
            self._decisions.append(decision_from_payload(payload))

    def add_map(self, number: int, payload: bytes) -> None:
        """Take in a gradient map; one that cannot be decoded is skipped."""
        try:
            self._maps[number] = Grid.FromString(payload)
        except DecodeError:
            return

    @property
    def decisions(self) -> ReportedDecisions:
        """The decisions and maps so far."""
        redone = None if self._redone is None else self._redone.decisions
        return ReportedDecisions(latest_decisions(self._decisions), dict(self._maps), redone)


class _Owner(NamedTuple):
    """The candidate that a map belongs to.

    Attributes:
        edge, place: of the edge among those considered, and of the candidate among the edge's.
        turn: how far the object is turned, in radians.
    """

    edge: int
    place: int
    candidate: PlanCandidate
    turn: float

    @property
    def target(self) -> PlanTarget | None:
        """The candidate's target, if it was found on this map: that of the nearest orientation."""
        candidate = self.candidate
        if not candidate.HasField("target"):
            return None
        nearest = min(
            (each.turn for each in candidate.maps), key=lambda turn: abs(turn - candidate.target.turn)
        )
        return candidate.target if nearest == self.turn else None


class _Drawn(NamedTuple):
    """A gradient map as numbers.

    Attributes:
        values: (rows, columns), NaN where blocked.
        low, high: where its corners lie.
        owner: None if the log does not record it.
        is_chosen: whether the decision's target was found on it.
        fields: what the message has of each cell, (rows, columns) by name.
    """

    values: Floats
    low: tuple[float, float]
    high: tuple[float, float]
    owner: _Owner | None
    is_chosen: bool
    fields: Mapping[str, NDArray[Any]]


def decisions_value(
    plan: ReportedDecisions, first_ns: int, packing: Packing, most_cells: int = MOST_CELLS
) -> Mapping[str, Any]:
    """Return the decisions as the page reads them, and how many maps did not fit."""
    drawn = [list(_maps_of(plan, decision)) for decision in plan.decisions]
    kept = _kept([each for maps in drawn for each in maps], most_cells)
    redone = {} if plan.redone is None else _redone_by_number(plan, plan.redone)
    decisions = []
    for decision, maps in zip(plan.decisions, drawn, strict=True):
        values = [_map_value(each, packing) for each in maps if id(each) in kept]
        value = dict(_decision_value(decision, values, first_ns, packing))
        if plan.redone is not None and (other := redone.get(decision.number)) is not None:
            chosen = [each for each in _maps_of(plan.redone, other) if each.is_chosen]
            own = [_map_value(each, packing) for each in chosen]
            value["redone"] = _decision_value(other, own, first_ns, packing)
        decisions.append(value)
    return {"decisions": decisions, "maps_left_out": sum(map(len, drawn)) - len(kept)}


def _redone_by_number(plan: ReportedDecisions, redone: ReportedDecisions) -> dict[int, PlanDecision]:
    """Return the decisions that do something else than those of the log, by number."""
    done = {each.number: (each.kind, each.reason, each.time_ns) for each in plan.decisions}
    return {
        each.number: each
        for each in redone.decisions
        if (each.kind, each.reason, each.time_ns) != done.get(each.number)
    }


def _kept(maps: Sequence[_Drawn], most_cells: int) -> set[int]:
    """Return the maps that fit, by identity: those of chosen targets, then the others, in order."""
    kept: set[int] = set()
    cells = 0
    for each in sorted(maps, key=lambda each: not each.is_chosen):
        if cells + each.values.size <= most_cells:
            cells += each.values.size
            kept.add(id(each))
    return kept


def _maps_of(plan: ReportedDecisions, decision: PlanDecision) -> Iterator[_Drawn]:
    """Yield the maps of a decision; if the log does not record their owners, those of its time."""
    owners = {
        named.number: _Owner(edge, place, candidate, named.turn)
        for edge, considered in enumerate(decision.considered)
        for place, candidate in enumerate(considered.candidates)
        for named in candidate.maps
    }
    found: list[tuple[_Owner | None, Grid]] = [
        (owner, plan.maps[number]) for number, owner in sorted(owners.items()) if number in plan.maps
    ]
    if not owners:
        found = [(None, grid) for _, grid in sorted(plan.maps.items()) if _is_of_time(grid, decision)]
    for owner, grid in found:
        drawn = _drawn(grid, owner, _is_chosen(owner, decision, len(found)))
        if drawn is not None:
            yield drawn


def _is_of_time(grid: Grid, decision: PlanDecision) -> bool:
    return grid.timestamp.ToNanoseconds() == decision.time_ns


def _is_chosen(owner: _Owner | None, decision: PlanDecision, maps: int) -> bool:
    """Return whether a decision's target was found on a map; without owners, on the only one."""
    if not decision.HasField("target"):
        return False
    if owner is None:
        return maps == 1
    is_last = owner.edge == len(decision.considered) - 1
    return is_last and owner.candidate.chosen and owner.target is not None


def _drawn(grid: Grid, owner: _Owner | None, is_chosen: bool) -> _Drawn | None:
    """Return a map's robustness; None if the sizes in the message are inconsistent or empty."""
    fields = map_fields(grid)
    numbers = fields.get("robustness")
    if numbers is None:
        return None
    rows, columns = numbers.shape
    x, y = grid.pose.position.x, grid.pose.position.y
    high = x + columns * grid.cell_size.x, y + rows * grid.cell_size.y
    if not np.isfinite([x, y, *high]).all() or high[0] <= x or high[1] <= y:
        return None
    return _Drawn(numbers.astype(np.float64), (x, y), high, owner, is_chosen, fields)


def _map_value(drawn: _Drawn, packing: Packing) -> Mapping[str, Any]:
    known = drawn.values[np.isfinite(drawn.values)]
    value: dict[str, Any] = {
        "columns": drawn.values.shape[1],
        "low": drawn.low,
        "high": drawn.high,
        "scale": float(np.abs(known).max(initial=0.0)),
        "values": packing.add(singles(drawn.values), "f4"),
        "chosen": drawn.is_chosen,
        "edge": None,
        "candidate": None,
        "title": "",
        "target": None,
    }
    owner = drawn.owner
    if owner is None:
        return value
    candidate = owner.candidate
    turned = f", turned by {math.degrees(owner.turn):.3g}°" if len(candidate.maps) > 1 else ""
    value |= _layer_values(drawn, candidate, packing)
    return value | {
        "edge": owner.edge,
        "candidate": owner.place,
        "title": f"{candidate.object}{turned}",
        "target": None if owner.target is None else _target_value(owner.target),
    }


def _layer_values(drawn: _Drawn, candidate: PlanCandidate, packing: Packing) -> dict[str, Any]:
    """Return what limits and what blocks each cell and, of the chosen map, the layer of each conjunct."""
    if not {"limited_by", "blocked_by"} <= drawn.fields.keys() or drawn.values.size > _MOST_LAYERED:
        return {}
    named = {number: f"{number}: {each.text}" for number, each in enumerate(candidate.conjuncts, 1)}
    shown = [name for name in named.values() if name in drawn.fields] if drawn.is_chosen else []
    return {
        "limited": packing.add(drawn.fields["limited_by"], "u2"),
        "blocked": packing.add(drawn.fields["blocked_by"], "u2"),
        "limits": [each.text for each in candidate.conjuncts],
        "blocks": [cause_text(each) for each in candidate.causes],
        "layers": [{"title": name, "values": packing.add(drawn.fields[name], "f4")} for name in shown],
    }


def _decision_value(
    decision: PlanDecision, maps: Sequence[Mapping[str, Any]], first_ns: int, packing: Packing
) -> Mapping[str, Any]:
    value: dict[str, Any] = {
        "number": decision.number,
        "time": (decision.time_ns - first_ns) / 1e9,
        "specification": decision.specification,
        "kind": decision.Kind.Name(decision.kind).removeprefix("KIND_").lower().replace("_", " "),
        "states": list(decision.states),
        "reason": decision.reason,
        "edges": [
            _edge_value(edge, edge is decision.considered[-1] and not edge.pruned)
            for edge in decision.considered
        ],
        "maps": maps,
        "target": _target_value(decision.target) if decision.HasField("target") else None,
        "outcome": None,
    }
    if decision.HasField("outcome"):
        outcome = decision.outcome
        value["outcome"] = {
            "time": (outcome.end_ns - first_ns) / 1e9,
            "succeeded": outcome.succeeded,
            "reason": outcome.reason,
            "states": list(outcome.states),
            "travelled": packing.add(np.array(outcome.travelled), "f8"),
        }
    return value


def _edge_value(edge: PlanEdge, is_aim: bool) -> Mapping[str, Any]:
    return {
        "path": list(edge.path),
        "aim": is_aim,
        "progress": _guard_texts(edge.progress),
        "constraints": _guard_texts(edge.constraints),
        "candidates": [_candidate_value(candidate) for candidate in edge.candidates],
        "pruned": Reason.from_text(edge.pruned).kind,
    }


def _guard_texts(guards: Sequence[PlanGuard]) -> list[str]:
    more = [f"and {len(guards) - _MOST_GUARDS} more"] if len(guards) > _MOST_GUARDS else []
    return [guard.text for guard in guards[:_MOST_GUARDS]] + more


def _candidate_value(candidate: PlanCandidate) -> Mapping[str, Any]:
    return {
        "object": candidate.object,
        "best": "nowhere free" if math.isinf(candidate.best) else number_text(candidate.best),
        "status": "rejected" if candidate.rejected else "chosen" if candidate.chosen else "possible",
        "rejected": candidate.rejected,
        "why": [f"{key} {text}" for key, text in candidate_lines(candidate)],
        "target": _target_value(candidate.target) if candidate.HasField("target") else None,
    }


def _target_value(target: PlanTarget) -> Mapping[str, Any]:
    """Return a target in words, and as points to draw unless one is not finite."""
    points = [target.x, target.y, *target.waypoints]
    is_drawn = bool(np.isfinite(points).all())
    turned = f", turned by {math.degrees(target.turn):.3g}°" if target.turn else ""
    return {
        "object": target.object,
        "at": points[:2] if is_drawn else None,
        "words": f"({target.x:.4g}, {target.y:.4g}){turned}",
        "robustness": number_text(target.robustness),
        "way": points[2:] if is_drawn else [],
    }
