"""Pushing bodies over the table with two fingers side by side, and turning them between the fingers."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence

import numpy as np

from spatial_replay.simulation.arm import (
    FINGER_DEPTH,
    FINGER_WIDTH,
    FINGERTIP,
    TICKS_PER_S,
    in_reach,
    turn_towards,
)
from spatial_replay.simulation.picking import turn_on_the_spot
from spatial_replay.simulation.scene import Scene, extent, rectangle
from spatial_replay.simulation.world import Execution

Point = tuple[float, float]

_LOW = FINGERTIP + 0.006
"""The height of the tool while it pushes, in metres: low enough not to tip a body."""
_AWAY = 0.01
"""The distance behind a body at which the fingers come down, in metres."""
_MARGIN = 0.001
_FAST, _SLOW = 0.1, 0.015
_CLOSE = 0.004
"""The distance to its goal, in metres, at which a body needs no further stroke."""
_FAR = 0.015
"""The tolerance of a body's position after all strokes, in metres."""
_STRAIGHT = 0.0025
_TURNED = 0.05
"""The tolerance of a body's yaw that is given, in radians."""
_TURNS = 2
"""The maximum number of turns on the spot."""
_STROKES = 4
"""The maximum number of strokes to one goal."""


def pushing(
    scene: Scene, name: str, path: Sequence[Point], yaw: float | None = None
) -> Generator[None, None, Execution]:
    """Push a body along a path, one stroke for each straight stretch, with corrections at the end.

    With `yaw`, turn it there: a stroke also turns a body a little, as its side comes to lie at the fingers.
    """
    corners = straightened([scene.place_of(name), *path])[1:]
    for corner in corners[:-1]:
        trouble = yield from _push_to(scene, name, corner, strokes=1, allowed=3 * _FAR)
        if trouble is not None:
            return trouble
    trouble = yield from _push_to(scene, name, corners[-1], strokes=_STROKES, allowed=_FAR)
    if trouble is not None:
        return trouble
    if turning := (yield from _turn_to(scene, name, corners[-1], yaw)):
        return Execution(False, turning, "place")
    is_straight = len(corners) == 1
    way = "straight to its place" if is_straight else f"along {len(corners)} straight stretches"
    turned = "" if yaw is None else ", and turned it there"
    return Execution(True, f"pushed {name} {way}{turned}")


def _push_to(
    scene: Scene, name: str, goal: Point, *, strokes: int, allowed: float
) -> Generator[None, None, Execution | None]:
    """Push a body to a point in several strokes; return the failure, if it fails."""
    missed = 0.0
    for _ in range(strokes):
        trouble = yield from _stroke(scene, name, goal)
        if trouble is not None:
            return trouble
        missed = math.dist(scene.place_of(name), goal)
        if missed <= _CLOSE:
            break
    if missed <= allowed:
        return None
    return Execution(False, f"{name} ended {missed * 100:.1f} cm from where it was pushed to", "place")


def _turn_to(scene: Scene, name: str, goal: Point, yaw: float | None) -> Generator[None, None, str]:
    """Turn a body to a yaw near its goal; return the reason of a failure, or ""."""
    if yaw is None:
        return ""
    for _ in range(_TURNS):
        if abs(scene.pose(name).turned_from(yaw)) <= _TURNED:
            break
        trouble = yield from turn_on_the_spot(scene, name, yaw)
        if trouble:
            return trouble
    left = abs(scene.pose(name).turned_from(yaw))
    if left > _TURNED:
        return f"{name} is {math.degrees(left):.0f} degrees from how it was turned"
    missed = math.dist(scene.place_of(name), goal)
    return "" if missed <= _FAR else f"{name} ended {missed * 100:.1f} cm from where it was pushed to"


def straightened(path: Sequence[Point]) -> list[Point]:
    """Return the corners of a path, without points on the line between others (Douglas–Peucker)."""
    if len(path) < 3:
        return list(path)
    points = np.array(path)
    chord = points[-1] - points[0]
    length = float(np.hypot(*chord))
    offsets = points - points[0]
    if length > 0:
        away = np.abs(offsets[:, 0] * chord[1] - offsets[:, 1] * chord[0]) / length
    else:
        away = np.hypot(offsets[:, 0], offsets[:, 1])
    farthest = int(np.argmax(away))
    if away[farthest] <= _STRAIGHT:
        return [path[0], path[-1]]
    return straightened(path[: farthest + 1])[:-1] + straightened(path[farthest:])


def _stroke(scene: Scene, name: str, goal: Point) -> Generator[None, None, Execution | None]:
    """Push a body straight towards a point; return the failure, if it fails."""
    x, y = scene.place_of(name)
    length = math.dist((x, y), goal)
    if length < _CLOSE:
        return None
    heading = math.atan2(goal[1] - y, goal[0] - x)
    u, v = math.cos(heading), math.sin(heading)
    back = u * x + v * y - extent(scene.footprint(name), heading)[0] + FINGER_DEPTH / 2
    behind = (x - u * (back + _AWAY), y - v * (back + _AWAY))
    if not in_reach(*goal):
        said = f"the robot does not reach ({goal[0]:.2f}, {goal[1]:.2f}), where {name} should go"
        return Execution(False, said, "place")
    if not in_reach(*behind):
        return Execution(False, f"the robot does not reach behind {name} where it lies", "pick")
    gap = _gap(scene, name, behind, heading)
    if gap is None:
        return Execution(False, f"no room for the fingers behind {name}", "pick")
    arm = scene.arm
    yield from arm.travel(*behind, turn_towards(heading, *behind))
    yield from arm.grip(gap)
    yield from arm.move(*behind, 0.08)
    yield from arm.move(*behind, _LOW, speed=0.2)
    reached = yield from _advance(scene, name, behind, heading, length, back)
    x, y, z = arm.commanded
    yield from arm.move(x - 0.02 * u, y - 0.02 * v, z)
    yield from arm.move(x - 0.02 * u, y - 0.02 * v, 0.1)
    return None if reached else Execution(False, f"the fingers lost {name}", "way")


def _advance(
    scene: Scene, name: str, behind: Point, heading: float, length: float, back: float
) -> Generator[None, None, bool]:
    """Move the fingers forward until the body has moved by a length; return whether it did."""
    u, v = math.cos(heading), math.sin(heading)
    x, y = scene.place_of(name)
    travelled = 0.0
    while True:
        now = scene.place_of(name)
        remaining = length - (now[0] - x) * u - (now[1] - y) * v
        if remaining <= _MARGIN:
            return True
        if travelled > length + back + _AWAY:
            return False
        travelled += min(_FAST, _SLOW + 2.0 * remaining) / TICKS_PER_S
        scene.arm.aim(np.array([behind[0] + u * travelled, behind[1] + v * travelled, _LOW]), scene.arm.yaw)
        yield


def _gap(scene: Scene, name: str, behind: Point, heading: float) -> float | None:
    """Return the widest gap of the fingers that fits behind a body; None if none does."""
    low, high = extent(scene.footprint(name), heading + math.pi / 2)
    widest = max(0.0, min(0.05, high - low - 2 * FINGER_WIDTH))
    for gap in (widest, widest / 2, 0.0):
        fingers = rectangle(*behind, FINGER_DEPTH, gap + 2 * FINGER_WIDTH, heading)
        if scene.clearance(fingers, name) > _MARGIN:
            return gap
    return None
