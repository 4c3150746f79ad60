"""Decisions, gradient maps and paths as messages."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from types import MappingProxyType

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.inspection.drawing import FRAME
from spatial_replay.inspection.rings import rings_of
from spatial_replay.logs.messages.PlanDecision_pb2 import (
    PlanCandidate,
    PlanDecision,
    PlanEdge,
    PlanGuard,
    PlanOutcome,
    PlanTarget,
    PrunedEdge,
)
from spatial_replay.palette import NEUTRAL, POSITIVE
from spatial_replay.planning.maps import GradientMap
from spatial_replay.planning.poses import moved_object
from spatial_replay.planning.step import Candidate, Consideration, Guards, Kind, Outcome, Step, Target

_KINDS: MappingProxyType[Kind, PlanDecision.Kind.ValueType] = MappingProxyType(
    {
        "execute": PlanDecision.KIND_EXECUTE,
        "hold": PlanDecision.KIND_HOLD,
        "wait": PlanDecision.KIND_WAIT,
        "no path": PlanDecision.KIND_NO_PATH,
    }
)
_WAY, _TRAVELLED = "plan/way", "plan/travelled"
_PIXELS = 3.0


def decision_message(step: Step, specification: str) -> PlanDecision:
    """A decision, without an outcome."""
    return PlanDecision(
        time_ns=step.time_ns,
        number=step.number,
        specification=specification,
        kind=_KINDS[step.kind],
        states=step.states,
        considered=map(_edge, step.considered),
        target=None if step.target is None else _target(step.target),
        pruned=[
            PrunedEdge(source=source, target=target, reason=reason)
            for (source, target), reason in step.pruned
        ],
        reason=step.reason,
    )


def outcome_message(
    outcome: Outcome, end_ns: int, states: Sequence[int], travelled: Sequence[tuple[float, float]]
) -> PlanOutcome:
    """How a step went, and where its object and the automaton were then."""
    return PlanOutcome(
        end_ns=end_ns,
        succeeded=outcome.succeeded,
        reason=outcome.reason,
        states=states,
        travelled=[coordinate for point in travelled for coordinate in point],
    )


def map_message(found: GradientMap, time_ns: int) -> GridMessage:
    """A gradient map that lies over the scene: a field for each way in which the object is turned."""
    turns, grid = len(found.turns), found.grid
    message = GridMessage(
        frame_id=FRAME,
        column_count=grid.columns,
        row_stride=4 * turns * grid.columns,
        cell_stride=4 * turns,
        data=np.ascontiguousarray(np.moveaxis(found.values, 0, -1), "<f4").tobytes(),
    )
    message.timestamp.FromNanoseconds(time_ns)
    message.pose.position.x, message.pose.position.y = grid.xmin, grid.ymin
    message.pose.orientation.w = 1.0
    message.cell_size.x = message.cell_size.y = grid.cell_size
    for turn in range(turns):
        name = "robustness" if turns == 1 else f"robustness_{turn}"
        message.fields.add(name=name, offset=4 * turn, type=PackedElementField.FLOAT32)
    return message


def path_message(
    target: Target | None,
    tracked: TrackedObject | None,
    time_ns: int,
    travelled: Sequence[tuple[float, float]] = (),
) -> SceneUpdate:
    """The way to a target, its object's outline there, the way it has travelled; all gone without one."""
    message = SceneUpdate()
    lines: dict[str, list[tuple[list[tuple[float, float]], bool, tuple[float, float, float]]]] = {}
    height = 0.0
    if target is not None and tracked is not None:
        height = 0.0 if tracked.height is None else tracked.height[1]
        there = moved_object(tracked, target.x, target.y, target.turn)
        outlines = [(ring, True, POSITIVE) for ring in _outlines(there.footprint)]
        lines[_WAY] = [(list(target.waypoints), False, POSITIVE), *outlines]
        if travelled:
            lines[_TRAVELLED] = [(list(travelled), False, NEUTRAL)]
    for identifier in (_WAY, _TRAVELLED):
        if identifier not in lines:
            deletion = message.deletions.add(type=SceneEntityDeletion.MATCHING_ID, id=identifier)
            deletion.timestamp.FromNanoseconds(time_ns)
            continue
        entity = message.entities.add(id=identifier, frame_id=FRAME)
        entity.timestamp.FromNanoseconds(time_ns)
        for points, is_closed, colour in lines[identifier]:
            _add_line(entity, points, height, colour, is_closed=is_closed)
    return message


def _add_line(
    entity: SceneEntity,
    points: list[tuple[float, float]],
    height: float,
    colour: tuple[float, float, float],
    *,
    is_closed: bool,
) -> None:
    kind = LinePrimitive.LINE_LOOP if is_closed else LinePrimitive.LINE_STRIP
    line = entity.lines.add(type=kind, thickness=_PIXELS, scale_invariant=True)
    line.pose.position.z, line.pose.orientation.w = height, 1.0
    for x, y in points:
        line.points.add(x=x, y=y)
    line.color.r, line.color.g, line.color.b, line.color.a = *colour, 1.0


def _outlines(footprint: Footprint) -> list[list[tuple[float, float]]]:
    """The points of each part's outline."""
    rings = rings_of(FootprintBatch.from_footprints([footprint]), 0.0)
    ends = np.cumsum(rings.forms[0].rings)[:-1]
    return [[(x, y) for x, y in ring.tolist()] for ring in np.split(rings.points, ends)]


def _edge(consideration: Consideration) -> PlanEdge:
    return PlanEdge(
        path=consideration.path,
        source=consideration.edge[0],
        target=consideration.edge[1],
        progress=_guards(consideration.progress),
        constraints=_guards(consideration.constraints),
        candidates=map(_candidate, consideration.candidates),
        pruned=consideration.pruned,
    )


def _guards(guards: Guards) -> list[PlanGuard]:
    return [
        PlanGuard(text=text, propositions=[number for number, _ in cube], values=[value for _, value in cube])
        for cube, text in zip(guards.cubes, guards.texts, strict=True)
    ]


def _candidate(candidate: Candidate) -> PlanCandidate:
    return PlanCandidate(
        object=candidate.name,
        best=candidate.map.best(),
        map_sha256=map_digest(candidate.map),
        target=None if candidate.target is None else _target(candidate.target),
        rejected=candidate.rejected,
        chosen=candidate.is_chosen,
    )


def map_digest(found: GradientMap) -> bytes:
    """SHA-256 of a map's values: little-endian float64 by turn, row and column, NaN where blocked."""
    return hashlib.sha256(np.ascontiguousarray(found.values, "<f8").tobytes()).digest()


def _target(target: Target) -> PlanTarget:
    return PlanTarget(
        object=target.name,
        x=target.x,
        y=target.y,
        turn=target.turn,
        yaw=target.yaw,
        waypoints=[coordinate for point in target.waypoints for coordinate in point],
        robustness=target.robustness,
    )
