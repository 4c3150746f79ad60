"""Messages of a planner → its decisions as the page tells them, with their maps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from google.protobuf.message import DecodeError

from spatial_replay.geometry.arrays import Floats
from spatial_replay.inspection.report.packing import Packing, singles
from spatial_replay.inspection.words import number_text
from spatial_replay.logs.messages.PlanDecision_pb2 import (
    PlanCandidate,
    PlanDecision,
    PlanEdge,
    PlanGuard,
    PlanTarget,
)

MOST_CELLS: Final = 1_500_000
"""How many cells the maps of a page have at most, all together."""
_MOST_GUARDS: Final = 4


@dataclass(frozen=True, eq=False)
class Plan:
    """What a log tells of decisions.

    Attributes:
        decisions: in order, each with its outcome if it has one.
        maps: by the number by which decisions name them, in the order of the log.
    """

    decisions: tuple[PlanDecision, ...]
    maps: Mapping[int, Grid]


class PlanMaker:
    """Takes decisions and maps from messages as they come."""

    def __init__(self) -> None:
        self._decisions: dict[int, PlanDecision] = {}
        self._maps: dict[int, Grid] = {}

    def add_decision(self, payload: bytes) -> None:
        """Take in a decision; one that cannot be read tells nothing."""
        try:
            decision = PlanDecision.FromString(payload)
        except DecodeError:
            return
        # the one with the outcome comes later and says everything that the first one does
        self._decisions[decision.number] = decision

    def add_map(self, number: int, payload: bytes) -> None:
        """Take in a gradient map; one that cannot be read is none."""
        try:
            self._maps[number] = Grid.FromString(payload)
        except DecodeError:
            return

    def plan(self) -> Plan:
        """What was taken so far."""
        return Plan(tuple(self._decisions[number] for number in sorted(self._decisions)), dict(self._maps))


class _Owner(NamedTuple):
    """Whose map one is.

    Attributes:
        edge, place: of the edge among those considered, and of the candidate among the edge's.
        turn: how far the object is turned, in radians.
    """

    edge: int
    place: int
    candidate: PlanCandidate
    turn: float


class _Drawn(NamedTuple):
    """A gradient map as numbers: (rows, columns), NaN where blocked, and where its corners lie."""

    values: Floats
    low: tuple[float, float]
    high: tuple[float, float]


def plan_value(plan: Plan, first_ns: int, packing: Packing) -> Mapping[str, Any]:
    """The decisions as the page reads them, and how many maps there was no room for."""
    decisions: list[Mapping[str, Any]] = []
    cells = left_out = 0
    for decision in plan.decisions:
        maps: list[Mapping[str, Any]] = []
        for owner, grid in _maps_of(plan, decision):
            drawn = _drawn(grid)
            if drawn is None:
                continue
            if cells + drawn.values.size > MOST_CELLS:
                left_out += 1
                continue
            cells += drawn.values.size
            maps.append(_map_value(drawn, owner, packing))
        decisions.append(_decision_value(decision, maps, first_ns, packing))
    return {"decisions": decisions, "maps_left_out": left_out}


def _maps_of(plan: Plan, decision: PlanDecision) -> Iterator[tuple[_Owner | None, Grid]]:
    """The maps that a decision rests on; of a log that does not say whose they are, those of its time."""
    owners = {
        named.number: _Owner(edge, place, candidate, named.turn)
        for edge, considered in enumerate(decision.considered)
        for place, candidate in enumerate(considered.candidates)
        for named in candidate.maps
    }
    if owners:
        yield from ((owners[number], plan.maps[number]) for number in sorted(owners) if number in plan.maps)
        return
    for _, grid in sorted(plan.maps.items()):
        if grid.timestamp.ToNanoseconds() == decision.time_ns:
            yield None, grid


def _drawn(grid: Grid) -> _Drawn | None:
    """A map's robustness; None of a message whose sizes do not fit together, or make no rectangle."""
    columns, cell, row = grid.column_count, grid.cell_stride, grid.row_stride
    rows = len(grid.data) // row if row else 0
    offset = next((field.offset for field in grid.fields if field.name.startswith("robustness")), cell)
    if not rows or not columns or cell * columns > row or offset + 4 > cell:
        return None
    numbers = np.ndarray((rows, columns), "<f4", grid.data, offset, (row, cell))
    x, y = grid.pose.position.x, grid.pose.position.y
    high = x + columns * grid.cell_size.x, y + rows * grid.cell_size.y
    if not np.isfinite([x, y, *high]).all() or high[0] <= x or high[1] <= y:
        return None
    return _Drawn(numbers.astype(np.float64), (x, y), high)


def _map_value(drawn: _Drawn, owner: _Owner | None, packing: Packing) -> Mapping[str, Any]:
    known = drawn.values[np.isfinite(drawn.values)]
    value: dict[str, Any] = {
        "columns": drawn.values.shape[1],
        "low": drawn.low,
        "high": drawn.high,
        "scale": float(np.abs(known).max(initial=0.0)),
        "values": packing.add(singles(drawn.values), "f4"),
        "edge": None,
        "candidate": None,
        "title": "",
        "target": None,
    }
    if owner is None:
        return value
    candidate = owner.candidate
    has_target = candidate.HasField("target") and candidate.target.turn == owner.turn
    turned = f", turned by {math.degrees(owner.turn):.3g}°" if len(candidate.maps) > 1 else ""
    return value | {
        "edge": owner.edge,
        "candidate": owner.place,
        "title": f"{candidate.object}{turned}",
        "target": _target_value(candidate.target) if has_target else None,
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
        "pruned": edge.pruned.split(" (", 1)[0],
    }


def _guard_texts(guards: Sequence[PlanGuard]) -> list[str]:
    more = [f"and {len(guards) - _MOST_GUARDS} more"] if len(guards) > _MOST_GUARDS else []
    return [guard.text for guard in guards[:_MOST_GUARDS]] + more


def _candidate_value(candidate: PlanCandidate) -> Mapping[str, Any]:
    return {
        "object": candidate.object,
        "best": "nowhere free" if math.isinf(candidate.best) else number_text(candidate.best),
        "standing": "rejected" if candidate.rejected else "chosen" if candidate.chosen else "possible",
        "rejected": candidate.rejected,
        "target": _target_value(candidate.target) if candidate.HasField("target") else None,
    }


def _target_value(target: PlanTarget) -> Mapping[str, Any]:
    """A target in words, and as points to be drawn: none of them if one is not finite."""
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
