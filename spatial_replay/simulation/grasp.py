"""How a body can be held between two fingers, and set down."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from spatial_replay.simulation.arm import (
    FINGER_DEPTH,
    FINGER_WIDTH,
    FINGERTIP,
    WIDEST,
    can_turn,
    in_reach,
    turn_towards,
)
from spatial_replay.simulation.scene import Scene, extent, rectangle
from spatial_replay.simulation.shapes import Box

Point = tuple[float, float]

_THICKEST = WIDEST - 0.008
"""What is thicker than this, in metres, does not fit between the fingers."""
_OPENING = 0.02
"""How much further than what they grasp the fingers open, in metres."""
_BELOW_TOP = 0.022
"""How far below its top a body is grasped, in metres, if it is tall enough."""
_HAND_DEPTH, _HAND_WIDTH, _HAND_ABOVE = 0.064, 0.21, 0.035
"""The gripper's body: its size across and along its opening, and how far above the tool's point it begins."""
_ROOM, _AMPLE = 0.0015, 0.01
"""Room around the fingers, in metres, that is just enough, and beyond which more is no better."""
_ANGLES = 12


@dataclass(frozen=True, slots=True)
class Grasp:
    """How a body is held and set down.

    Attributes:
        yaw: the tool's turn where the body is picked up, in radians.
        turn: the tool's turn where it is set down.
        above_bottom: height of the tool's point above the body's lowest point, in metres.
        opening: how far apart the fingers are before and after, in metres.
    """

    yaw: float
    turn: float
    above_bottom: float
    opening: float


def best_grasp(scene: Scene, name: str, goal: Point, yaw: float | None) -> Grasp | str:
    """The grasp with the most room, of those the thinnest; or why there is none."""
    start = scene.place_of(name)
    if not in_reach(*start):
        return f"{name} lies out of the robot's reach"
    if not in_reach(*goal):
        return f"({goal[0]:.2f}, {goal[1]:.2f}) is out of the robot's reach"
    across = [(thickness, angle) for thickness, angle in _angles(scene, name) if thickness <= _THICKEST]
    if not across:
        return f"{name} is too thick for the gripper as it lies"
    bottom, top = scene.height(name)
    above_bottom = max(FINGERTIP + 0.003, top - bottom - _BELOW_TOP)
    best, best_room, can_pick = None, _ROOM, False
    for thickness, angle in sorted(across):
        opening = min(WIDEST, thickness + _OPENING)
        for grasp_yaw, turn in _turns(scene, name, angle, goal, yaw):
            grasp = Grasp(grasp_yaw, turn, above_bottom, opening)
            here = _room(scene, name, start, grasp.yaw, grasp, bottom)
            there = _room(scene, name, goal, grasp.turn, grasp, surface(scene, name, goal))
            can_pick = can_pick or here > _ROOM
            room = min(here, there, _AMPLE)
            if room > best_room:
                best, best_room = grasp, room
    return best or f"no room for the fingers around {name} where it {'should go' if can_pick else 'lies'}"


def surface(scene: Scene, name: str, goal: Point) -> float:
    """The height of what is under a point: the table, or a body that others may be placed on."""
    spot = rectangle(*goal, 1e-3, 1e-3, 0.0)
    under = [
        scene.height(other)[1]
        for other, body in scene.bodies.items()
        if body.support and other != name and scene.distance(spot, other) <= 0
    ]
    return max(under, default=0.0)


def _angles(scene: Scene, name: str) -> list[tuple[float, float]]:
    """How thick a body is, and turns of the tool that grasp it there: across flat sides, if it has them."""
    pose, covered = scene.pose(name), scene.footprint(name)
    if isinstance(scene.bodies[name].shape, Box) and pose.stands:
        turns = [pose.yaw, pose.yaw + math.pi / 2]
    else:
        turns = [k * math.pi / _ANGLES for k in range(_ANGLES)]
    spans = [(extent(covered, turn + math.pi / 2), turn) for turn in turns]
    across = [(high - low, turn) for (low, high), turn in spans]
    if len(across) == 2:
        return across
    thinnest = min(across)[0]
    return [(thickness, turn) for thickness, turn in across if thickness < thinnest + 1e-3]


def _turns(
    scene: Scene, name: str, angle: float, goal: Point, yaw: float | None
) -> Iterator[tuple[float, float]]:
    """Turns of the tool for picking up and setting down: both are within what the arm can do."""
    pose, start = scene.pose(name), scene.place_of(name)
    is_round = not isinstance(scene.bodies[name].shape, Box) and pose.stands
    for picked in (angle, angle + math.pi):
        grasp_yaw = turn_towards(picked, *start, 2 * math.pi)
        further = 0.0 if yaw is None or not pose.stands else yaw - pose.yaw
        if is_round:
            further = math.atan2(goal[1], goal[0]) - math.atan2(start[1], start[0])
        turn = turn_towards(grasp_yaw + further, *goal, 2 * math.pi)
        if can_turn(grasp_yaw, *start) and can_turn(turn, *goal):
            yield grasp_yaw, turn


def _room(scene: Scene, name: str, place: Point, turn: float, grasp: Grasp, bottom: float) -> float:
    """How far fingers and gripper are from other bodies when the body is held at a place."""
    tool = bottom + grasp.above_bottom
    fingers = rectangle(*place, FINGER_DEPTH, grasp.opening + 2 * FINGER_WIDTH, turn)
    hand = rectangle(*place, _HAND_DEPTH, _HAND_WIDTH, turn)
    return min(
        scene.clearance(fingers, name, above=tool - FINGERTIP),
        scene.clearance(hand, name, above=tool + _HAND_ABOVE),
    )
