"""Choose grasps: how to hold a body between two fingers, and set it down."""

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
from spatial_replay.simulation.world import Execution

Point = tuple[float, float]

_THICKEST = WIDEST - 0.008
"""The maximum thickness of a body between the fingers, in metres."""
_OPENING = 0.02
"""How much wider than the body the fingers open, in metres."""
_BELOW_TOP = 0.022
"""The depth of a grasp below the top of a tall body, in metres."""
_HAND_DEPTH, _HAND_WIDTH, _HAND_ABOVE = 0.064, 0.21, 0.035
"""The hand: its size across and along its opening, and its height above the tool point, in metres."""
_ROOM, _AMPLE = 0.0015, 0.01
"""The clearance around the fingers, in metres, that is required, and beyond which more does not count."""
_ANGLES = 12


@dataclass(frozen=True, slots=True)
class Grasp:
    """A grasp of a body.

    Attributes:
        yaw: of the tool when it picks the body up, in radians.
        turn: yaw of the tool when it sets the body down.
        above_bottom: height of the tool point above the body's lowest point, in metres.
        opening: distance of the fingers before and after, in metres.
    """

    yaw: float
    turn: float
    above_bottom: float
    opening: float


def best_grasp(
    scene: Scene, name: str, goal: Point, yaw: float | None, *, is_lifted: bool = True
) -> Grasp | Execution:
    """Return the grasp with the most clearance, preferring thin sides; or the failure if there is none.

    A body that is not lifted is turned the shorter way round.
    """
    start = scene.place_of(name)
    if not in_reach(*start):
        return Execution(False, f"{name} lies out of the robot's reach", "pick")
    if not in_reach(*goal):
        return Execution(False, f"({goal[0]:.2f}, {goal[1]:.2f}) is out of the robot's reach", "place")
    angles = _angles(scene, name)
    across = [(thickness, angle) for thickness, angle in angles if thickness <= _THICKEST]
    if not across:
        thinnest = f"{min(angles)[0] * 100:.1f} cm, and {_THICKEST * 100:.1f} cm fit between the fingers"
        return Execution(False, f"{name} is too thick for the gripper as it lies: {thinnest}", "pick")
    bottom, top = scene.height(name)
    above_bottom = max(FINGERTIP + 0.003, top - bottom - _BELOW_TOP)
    best, best_room, can_turn_hand, can_pick, can_place = None, _ROOM, False, False, False
    for thickness, angle in sorted(across):
        opening = min(WIDEST, thickness + _OPENING)
        for grasp_yaw, turn in _turns(scene, name, angle, goal, yaw, is_lifted):
            grasp = Grasp(grasp_yaw, turn, above_bottom, opening)
            here = _room(scene, name, start, grasp.yaw, grasp, bottom)
            there = _room(scene, name, goal, grasp.turn, grasp, surface(scene, name, goal))
            can_turn_hand = True
            can_pick, can_place = can_pick or here > _ROOM, can_place or there > _ROOM
            room = min(here, there, _AMPLE)
            if room > best_room:
                best, best_room = grasp, room
    if best is not None:
        return best
    if not can_turn_hand:
        return Execution(False, f"the hand cannot turn as far as {name} has to be turned", "place")
    if can_pick and can_place:
        said = f"no grasp of {name} has room for the fingers both where it lies and where it should go"
        return Execution(False, said, "place")
    where = (
        "where it lies" if can_place else "where it should go" if can_pick else "where it lies and should go"
    )
    return Execution(False, f"no room for the fingers around {name} {where}", "place" if can_pick else "pick")


def surface(scene: Scene, name: str, goal: Point) -> float:
    """Return the height of the support under a point: the table, or a body that supports others."""
    spot = rectangle(*goal, 1e-3, 1e-3, 0.0)
    under = [
        scene.height(other)[1]
        for other, body in scene.bodies.items()
        if body.support and other != name and scene.distance(spot, other) <= 0
    ]
    return max(under, default=0.0)


def _angles(scene: Scene, name: str) -> list[tuple[float, float]]:
    """Return (thickness, yaw of the tool) of possible grasps: across flat sides if there are any."""
    pose, covered = scene.pose(name), scene.footprint(name)
    if isinstance(scene.bodies[name].shape, Box) and pose.is_level:
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
    scene: Scene, name: str, angle: float, goal: Point, yaw: float | None, is_lifted: bool
) -> Iterator[tuple[float, float]]:
    """Iterate over the yaws of the tool for picking up and setting down that the arm can reach."""
    pose, start = scene.pose(name), scene.place_of(name)
    # any yaw suits a round body: the arm keeps its own relative to the direction from the base
    is_round = not isinstance(scene.bodies[name].shape, Box) and pose.stands
    for picked in (angle, angle + math.pi):
        grasp_yaw = turn_towards(picked, *start, 2 * math.pi)
        further = 0.0 if yaw is None or not pose.is_level else yaw - pose.yaw
        if is_round:
            further = math.atan2(goal[1], goal[0]) - math.atan2(start[1], start[0])
        turn = grasp_yaw + math.remainder(further, math.tau)
        if is_lifted:
            turn = turn_towards(grasp_yaw + further, *goal, 2 * math.pi)
        if can_turn(grasp_yaw, *start) and can_turn(turn, *goal):
            yield grasp_yaw, turn


def _room(scene: Scene, name: str, place: Point, turn: float, grasp: Grasp, bottom: float) -> float:
    """Return the clearance of fingers and hand to other bodies when a body is held at a place."""
    tool = bottom + grasp.above_bottom
    fingers = rectangle(*place, FINGER_DEPTH, grasp.opening + 2 * FINGER_WIDTH, turn)
    hand = rectangle(*place, _HAND_DEPTH, _HAND_WIDTH, turn)
    around_fingers = scene.clearance(fingers, name, above=tool - FINGERTIP)
    return min(around_fingers, scene.clearance(hand, name, above=tool + _HAND_ABOVE))
