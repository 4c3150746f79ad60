"""The path of an object that is moved, as a message that viewers draw."""

from __future__ import annotations

from collections.abc import Sequence

from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.inspection.drawing import FRAME
from spatial_replay.inspection.rings import outlines_of
from spatial_replay.palette import NEUTRAL, POSITIVE
from spatial_replay.planning.poses import moved_object
from spatial_replay.planning.step import Target

_WAY, _TRAVELLED = "plan/way", "plan/travelled"
_PIXELS = 3.0


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
        outlines = [(points, True, POSITIVE) for points in map(_points, outlines_of(there.footprint))]
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


def _points(ring: Floats) -> list[tuple[float, float]]:
    return [(x, y) for x, y in ring.tolist()]
