"""The arm: its motions, the scene around it, and the skills of picking, placing and pushing."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint, FootprintBatch
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure
from spatial_replay.logs.behaviour_tree import TreeTick
from spatial_replay.planning.decisions import Outcome, Stage, points_along
from spatial_replay.simulation.bullet import REST, STEPS_PER_S, Engine, downwards, joints_for, tool_frame
from spatial_replay.simulation.world import Body, Box, Pose, footprint, height, rectangle

TICKS_PER_S = 60
"""Commands of the arm per second."""
STEPS_PER_TICK = STEPS_PER_S // TICKS_PER_S

WIDEST = 0.08
"""Maximum distance of the fingers, metres."""
FINGERTIP = 0.008
"""Length of the fingertips below the tool point, metres."""
FINGER_DEPTH, FINGER_WIDTH = 0.018, 0.0145
"""Size of a finger across and along the axis on which the fingers open, metres."""
ABOVE = 0.3
"""Travel height of the tool, metres."""

Motion: TypeAlias = Generator[None, None, None]
"""A motion of the arm; each step of the generator commands the arm for one tick."""

_FAST = 0.45
"""Travel speed of the tool, m/s."""
_TURNING = 2.0
"""Turning speed of the tool, rad/s."""
_REACHED = 0.003
"""Distance at which the tool has reached its commanded position, metres."""
_SETTLING_TICKS = 30
"""Maximum number of ticks to wait for the tool to reach its commanded position."""
_GRIP_FORCE = 25.0
"""Force of the fingers, N."""
_PINCHED = 0.004
"""Least excess of the fingers' distance over the commanded distance while they hold a body, metres."""
_MIDDLE, _FURTHEST = 0.78, 2.75
"""Tool yaw range relative to the direction from the base: its centre and its half width, radians."""
_NEAREST, _FARTHEST = 0.27, 0.77
"""Smallest and largest distance from the base at which the tool reaches the table, metres."""
_INSIDE = 0.33
"""Smallest distance from the base during travel around the base, metres."""


class Arm:
    """A Franka arm: positions in metres, yaw of the tool in radians."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._joints = joints_for(np.array([0.4, 0.0, ABOVE]), downwards(0.0), REST, 50)
        self._position, self._yaw = np.array([0.4, 0.0, ABOVE]), 0.0
        self._commanded_width = WIDEST
        self._velocities = np.zeros_like(self._joints)
        self.limp = False
        """Whether the gripper stays open, regardless of its commands."""
        engine.set_joints(self._joints, self._commanded_width)

    @property
    def position(self) -> Floats:
        """The measured position (3,) of the tool point."""
        return tool_frame(self._engine.joints())[0]

    @property
    def width(self) -> float:
        """The measured distance of the fingers."""
        return self._engine.finger_width()

    @property
    def holds(self) -> bool:
        """Whether a body between the fingers keeps them from their commanded distance."""
        return self.width > self._commanded_width + _PINCHED

    def drive(self) -> None:
        """Send the latest command to the motors, for one tick."""
        width = WIDEST if self.limp else self._commanded_width
        self._engine.drive(self._joints, self._velocities, width, _GRIP_FORCE)

    def aim(self, position: Floats, yaw: float) -> None:
        """Command the tool to a pose (metres, yaw in radians) that it can reach within one tick."""
        joints = joints_for(position, downwards(yaw), self._joints)
        self._velocities = (joints - self._joints) * TICKS_PER_S
        self._joints, self._position, self._yaw = joints, position, yaw

    def move(self, x: float, y: float, z: float, yaw: float | None = None, *, speed: float = _FAST) -> Motion:
        """Move the tool in a straight line, and wait until the tool has reached the point."""
        goal = np.array([x, y, z])
        start, start_yaw = self._position, self._yaw
        yaw_change = 0.0 if yaw is None else yaw - start_yaw
        distance = math.dist(start, goal)
        for share in _shares(distance / speed, abs(yaw_change) / _TURNING):
            self.aim(start + share * (goal - start), start_yaw + share * yaw_change)
            yield
        yield from self._settle()

    def travel(self, x: float, y: float, yaw: float) -> Motion:
        """Lift the tool, and move the tool around the base to a position above a point."""
        start = self._position
        if start[2] < ABOVE - 0.01:
            yield from self.move(start[0], start[1], ABOVE)
            start = self._position
        radius, angle = math.hypot(start[0], start[1]), math.atan2(start[1], start[0])
        radius_change, angle_change = math.hypot(x, y) - radius, math.atan2(y, x) - angle
        start_yaw = self._yaw
        yaw_change = yaw - start_yaw
        # the radius counts as at least 0.4 m, which limits the angular speed around the base
        arc_length = math.hypot(radius_change, angle_change * max(radius, 0.4))
        for share in _shares(arc_length / _FAST, abs(yaw_change) / _TURNING):
            tool_radius = max(radius + share * radius_change, _INSIDE)
            tool_angle = angle + share * angle_change
            x_now, y_now = tool_radius * math.cos(tool_angle), tool_radius * math.sin(tool_angle)
            self.aim(np.array([x_now, y_now, ABOVE]), start_yaw + share * yaw_change)
            yield
        # the goal may be closer to the base than the travel radius
        yield from self.move(x, y, ABOVE)

    def grip(self, width: float) -> Motion:
        """Move the fingers to a distance, or until a body stops them."""
        self._commanded_width = width
        self._velocities = np.zeros_like(self._joints)
        previous_width = self.width
        yield
        for _ in range(TICKS_PER_S):
            for _ in range(6):
                yield
            current_width = self.width
            # the fingers have stopped at the commanded distance, or at a body
            if abs(current_width - previous_width) < 2e-4:
                return
            previous_width = current_width

    def wait(self, seconds: float) -> Motion:
        """Hold still."""
        self._velocities = np.zeros_like(self._joints)
        for _ in range(round(seconds * TICKS_PER_S)):
            yield

    def rest(self) -> Motion:
        """Hold still forever."""
        while True:
            yield from self.wait(1.0)

    @property
    def commanded(self) -> tuple[float, float, float]:
        """The commanded position of the tool point."""
        x, y, z = self._position.tolist()
        return x, y, z

    @property
    def yaw(self) -> float:
        """The commanded yaw of the tool."""
        return self._yaw

    def _settle(self) -> Motion:
        self._velocities = np.zeros_like(self._joints)
        for _ in range(_SETTLING_TICKS):
            if math.dist(self.position, self._position) < _REACHED:
                return
            yield


def _shares(*durations_s: float) -> list[float]:
    """Return the completed share of a motion after each tick: a cubic, slow at both ends.

    Durations are for maximum speed. The motion takes 1.5 times the longest duration: its mean speed is lower.
    """
    # the maximum speed of the cubic, in the middle, is 1.5 times its mean speed
    tick_count = max(1, math.ceil(1.5 * max(durations_s) * TICKS_PER_S))
    return [3 * (k / tick_count) ** 2 - 2 * (k / tick_count) ** 3 for k in range(1, tick_count + 1)]


def turn_towards(yaw: float, x: float, y: float, period: float = math.pi) -> float:
    """Shift `yaw` by whole periods towards the middle of the last joint's range.

    The period is pi for an empty gripper, because it is symmetric, and 2 pi for a gripper that holds a body.
    """
    lower_bound = math.atan2(y, x) + _MIDDLE - period / 2
    return lower_bound + (yaw - lower_bound) % period


def in_reach(x: float, y: float) -> bool:
    """Return whether the downward tool reaches a point on the table."""
    return _NEAREST <= math.hypot(x, y) <= _FARTHEST


def can_turn(yaw: float, x: float, y: float) -> bool:
    """Return whether the last joint can turn the tool to `yaw` at a point."""
    return abs(yaw - math.atan2(y, x) - _MIDDLE) <= _FURTHEST


# -------------------------------------------------------------------------------------------------- the scene


@dataclass(frozen=True, slots=True)
class Scene:
    """The physics engine, the arm, the bodies by name, and a listener for ticks of behaviour trees."""

    engine: Engine
    arm: Arm
    bodies: Mapping[str, Body]
    report_tick: Callable[[TreeTick], None] = lambda tick: None

    def pose(self, name: str) -> Pose:
        """Return the pose of a body."""
        return self.engine.pose(name)

    def place_of(self, name: str) -> tuple[float, float]:
        """Return the centre (x, y) of a body, metres."""
        x, y, _ = self.engine.pose(name).position.tolist()
        return x, y

    def footprint(self, name: str) -> Footprint:
        """Return the footprint of a body."""
        return footprint(self.bodies[name].shape, self.engine.pose(name))

    def height(self, name: str) -> tuple[float, float]:
        """Return the lowest and highest z of a body, metres."""
        return height(self.bodies[name].shape, self.engine.pose(name))

    def clearance(self, covered: Footprint, name: str, *, above: float = 0.0) -> float:
        """Return the distance, metres, to the nearest body other than `name` that is higher than `above`."""
        other_footprints = [
            self.footprint(body) for body in self.bodies if body != name and self.height(body)[1] > above
        ]
        return least_distance(covered, other_footprints) if other_footprints else math.inf


def least_distance(covered: Footprint, others: Sequence[Footprint]) -> float:
    """Return the distance, metres, from a footprint to the nearest of `others`; below 0 for an overlap."""
    batch = FootprintBatch.from_footprints([covered, *others])
    operands = [Operand(np.array([[0]])), Operand(np.arange(1, len(batch))[None, :])]
    return float(measure(batch, operands, [MeasureRequest("signed_distance", 0, 1)])[0, 0])


def extent(covered: Footprint, angle: float) -> tuple[float, float]:
    """Return the smallest and largest coordinate of a footprint along the direction `angle`, metres."""
    direction = np.array([math.cos(angle), math.sin(angle)])
    spans = [(part.vertices @ direction, part.radius) for part in covered.parts]
    lowest = min(float(coordinates.min()) - radius for coordinates, radius in spans)
    return lowest, max(float(coordinates.max()) + radius for coordinates, radius in spans)


# ----------------------------------------------------------------------------------------------------- grasps

Point = tuple[float, float]

_THICKEST = WIDEST - 0.008
"""Maximum thickness of a body between the fingers, metres."""
_OPENING = 0.02
"""Excess of the fingers' opening over the thickness of the body, metres."""
_BELOW_TOP = 0.022
"""Depth of a grasp below the top of a tall body, metres."""
_HAND_DEPTH, _HAND_WIDTH, _HAND_ABOVE = 0.064, 0.21, 0.035
"""Size of the hand across and along its opening, and its height above the tool point, metres."""
_ROOM, _AMPLE = 0.0015, 0.01
"""Required clearance around the fingers, and clearance above which grasps count as equal, metres."""
_ANGLES = 12
"""Number of tool yaws to try for a body without flat sides."""


@dataclass(frozen=True, slots=True)
class Grasp:
    """A grasp of a body.

    Attributes:
        yaw: yaw of the tool when the body is picked, radians.
        turn: yaw of the tool when the body is placed, radians.
        above_bottom: height of the tool point above the body's lowest point, metres.
        opening: distance of the fingers before and after the grasp, metres.
    """

    yaw: float
    turn: float
    above_bottom: float
    opening: float


def best_grasp(
    scene: Scene, name: str, goal: Point, yaw: float | None, *, is_lifted: bool = True
) -> Grasp | Outcome:
    """Return the grasp with the most clearance, or the failure if no grasp is possible.

    Among grasps of equal clearance, the grasp across the thinnest side is preferred. A body that is not
    lifted is turned in the shorter direction.
    """
    start_point = scene.place_of(name)
    if not in_reach(*start_point):
        return Outcome(False, f"{name} lies out of the robot's reach", "pick")
    if not in_reach(*goal):
        return Outcome(False, f"({goal[0]:.2f}, {goal[1]:.2f}) is out of the robot's reach", "place")
    candidates = _angles(scene, name)
    thin_candidates = [(thickness, angle) for thickness, angle in candidates if thickness <= _THICKEST]
    if not thin_candidates:
        thinnest = f"{min(candidates)[0] * 100:.1f} cm, and {_THICKEST * 100:.1f} cm fit between the fingers"
        return Outcome(False, f"{name} is too thick for the gripper as it lies: {thinnest}", "pick")
    bottom, top = scene.height(name)
    # the fingertips stay 3 mm above the body's lowest point
    above_bottom = max(FINGERTIP + 0.003, top - bottom - _BELOW_TOP)
    best, best_room, can_turn_hand, can_pick, can_place = None, _ROOM, False, False, False
    for thickness, angle in sorted(thin_candidates):
        opening = min(WIDEST, thickness + _OPENING)
        for grasp_yaw, place_yaw in _turns(scene, name, angle, goal, yaw, is_lifted):
            grasp = Grasp(grasp_yaw, place_yaw, above_bottom, opening)
            pick_room = _room(scene, name, start_point, grasp.yaw, grasp, bottom)
            goal_room = _room(scene, name, goal, grasp.turn, grasp, surface(scene, name, goal))
            can_turn_hand = True
            can_pick, can_place = can_pick or pick_room > _ROOM, can_place or goal_room > _ROOM
            room = min(pick_room, goal_room, _AMPLE)
            if room > best_room:
                best, best_room = grasp, room
    if best is not None:
        return best
    if not can_turn_hand:
        return Outcome(False, f"the hand cannot turn as far as {name} has to be turned", "place")
    if can_pick and can_place:
        reason = f"no grasp of {name} has room for the fingers both where it lies and where it should go"
        return Outcome(False, reason, "place")
    sites = (
        "where it lies" if can_place else "where it should go" if can_pick else "where it lies and should go"
    )
    return Outcome(False, f"no room for the fingers around {name} {sites}", "place" if can_pick else "pick")


def surface(scene: Scene, name: str, goal: Point) -> float:
    """Return the height of the surface under a point, metres: the table, or the highest support."""
    goal_spot = rectangle(*goal, 1e-3, 1e-3, 0.0)
    surface_heights = [
        scene.height(support)[1]
        for support, body in scene.bodies.items()
        if body.support and support != name and least_distance(goal_spot, [scene.footprint(support)]) <= 0
    ]
    return max(surface_heights, default=0.0)


def _angles(scene: Scene, name: str) -> list[tuple[float, float]]:
    """Return pairs (body's thickness, tool yaw) of possible grasps; a body with flat sides has two."""
    pose, covered = scene.pose(name), scene.footprint(name)
    if isinstance(scene.bodies[name].shape, Box) and pose.is_level:
        tool_yaws = [pose.yaw, pose.yaw + math.pi / 2]
    else:
        tool_yaws = [k * math.pi / _ANGLES for k in range(_ANGLES)]
    spans = [(extent(covered, tool_yaw + math.pi / 2), tool_yaw) for tool_yaw in tool_yaws]
    grasp_angles = [(high - low, tool_yaw) for (low, high), tool_yaw in spans]
    if len(grasp_angles) == 2:
        return grasp_angles
    thinnest = min(grasp_angles)[0]
    return [(thickness, tool_yaw) for thickness, tool_yaw in grasp_angles if thickness < thinnest + 1e-3]


def _turns(
    scene: Scene, name: str, grasp_angle: float, goal: Point, yaw: float | None, is_lifted: bool
) -> Iterator[tuple[float, float]]:
    """Yield pairs of reachable tool yaws: when the body is picked, and when it is placed."""
    pose, start_point = scene.pose(name), scene.place_of(name)
    # a round body has no yaw, so the tool keeps its yaw relative to the direction from the base
    is_round = not isinstance(scene.bodies[name].shape, Box) and pose.stands
    # the hand can hold a body in two opposite orientations
    for hand_angle in (grasp_angle, grasp_angle + math.pi):
        grasp_yaw = turn_towards(hand_angle, *start_point, 2 * math.pi)
        yaw_change = 0.0 if yaw is None or not pose.is_level else yaw - pose.yaw
        if is_round:
            yaw_change = math.atan2(goal[1], goal[0]) - math.atan2(start_point[1], start_point[0])
        place_yaw = grasp_yaw + math.remainder(yaw_change, math.tau)
        if is_lifted:
            place_yaw = turn_towards(grasp_yaw + yaw_change, *goal, 2 * math.pi)
        if can_turn(grasp_yaw, *start_point) and can_turn(place_yaw, *goal):
            yield grasp_yaw, place_yaw


def _room(scene: Scene, name: str, place: Point, tool_yaw: float, grasp: Grasp, support_z: float) -> float:
    """Return the clearance between the hand, which holds a body at a place, and other bodies, metres."""
    tool_z = support_z + grasp.above_bottom
    fingers = rectangle(*place, FINGER_DEPTH, grasp.opening + 2 * FINGER_WIDTH, tool_yaw)
    hand = rectangle(*place, _HAND_DEPTH, _HAND_WIDTH, tool_yaw)
    around_fingers = scene.clearance(fingers, name, above=tool_z - FINGERTIP)
    return min(around_fingers, scene.clearance(hand, name, above=tool_z + _HAND_ABOVE))


# ---------------------------------------------------------------------------------------------------- picking

_SLOW = 0.15
"""Speed of the tool near bodies, m/s."""
_SETTING_DOWN = 0.002
"""Height above its support at which a body is released, metres."""
_LOST_TICKS = 6
"""Number of ticks without contact after which a body counts as lost."""
_STRAIGHT = 0.08
"""Maximum length of a segment of a carried body's way, metres; `travel` is nearly straight on a segment."""
_NEAR = 0.02
"""Tolerance of a placed body's position, metres."""


def picking(
    scene: Scene, name: str, goal: Point, yaw: float | None, via: Sequence[Point] = ()
) -> Generator[None, None, Outcome]:
    """Pick a body up, carry it along `via` and place its centre at `goal`; a yaw of None keeps the yaw."""
    grasp = best_grasp(scene, name, goal, yaw)
    if isinstance(grasp, Outcome):
        return grasp
    is_standing = scene.pose(name).stands
    stage: Stage = "pick"
    failure = yield from pick_up(scene, name, grasp)
    if not failure:
        stage, failure = "way", (yield from carry(scene, name, grasp, goal, via))
    if not failure:
        stage, failure = "place", (yield from set_down(scene, name, goal))
    yield from let_go(scene, grasp.opening)
    failure = failure or miss_text(scene, name, goal, stood=is_standing)
    return Outcome(False, failure, stage) if failure else Outcome(True, f"placed {name}")


def pick_up(scene: Scene, name: str, grasp: Grasp) -> Generator[None, None, str]:
    """Grasp a body and lift it; return the reason of a failure, or ""."""
    (x, y), failure = scene.place_of(name), (yield from take_hold(scene, name, grasp))
    if failure:
        return failure
    is_lifted = yield from _holding(scene, name, scene.arm.move(x, y, ABOVE, speed=2 * _SLOW))
    return "" if is_lifted else f"{name} slipped out of the fingers as it was lifted"


def take_hold(scene: Scene, name: str, grasp: Grasp) -> Generator[None, None, str]:
    """Close the fingers on a body without lifting it; return the reason of a failure, or ""."""
    arm, (x, y) = scene.arm, scene.place_of(name)
    z = scene.height(name)[0] + grasp.above_bottom
    yield from arm.travel(x, y, grasp.yaw)
    yield from arm.grip(grasp.opening)
    yield from arm.move(x, y, z + 0.05)
    yield from arm.move(x, y, z, speed=_SLOW)
    yield from arm.grip(0.0)
    if scene.engine.fingers_touching(name) < 2:
        return f"the fingers closed beside {name}"
    return ""


def carry(
    scene: Scene, name: str, grasp: Grasp, goal: Point, via: Sequence[Point] = ()
) -> Generator[None, None, str]:
    """Move the held body along `via` to a position above `goal`; return the reason of a failure, or ""."""
    # `travel` moves around the base; between close points its path is nearly straight
    waypoints = (scene.place_of(name), *via, goal)
    for point in islice(points_along(waypoints, _STRAIGHT), 1, None) if via else (goal,):
        x, y = _tool_for(scene, name, point, grasp.turn)
        is_carried = yield from _holding(scene, name, scene.arm.travel(x, y, grasp.turn))
        if not is_carried:
            return f"{name} slipped out of the fingers on the way"
    return ""


def turn_on_the_spot(scene: Scene, name: str, yaw: float) -> Generator[None, None, str]:
    """Turn a body on its support between the fingers; return the reason of a failure, or ""."""
    grasp = best_grasp(scene, name, scene.place_of(name), yaw, is_lifted=False)
    if isinstance(grasp, Outcome):
        return grasp.reason
    failure = yield from take_hold(scene, name, grasp)
    if not failure:
        is_turned = yield from _holding(scene, name, scene.arm.move(*scene.arm.commanded, grasp.turn))
        failure = "" if is_turned else f"{name} slipped out of the fingers as it was turned"
    yield from let_go(scene, grasp.opening)
    return failure


def put_back(scene: Scene, name: str) -> Motion:
    """Put a body down where it is if the fingers hold it, and open the fingers."""
    if scene.engine.fingers_touching(name):
        yield from set_down(scene, name, scene.place_of(name))
    yield from let_go(scene, WIDEST)


def set_down(scene: Scene, name: str, goal: Point) -> Generator[None, None, str]:
    """Lower the held body onto its support; return the reason of a failure, or ""."""
    arm = scene.arm
    x, y, tool_z = arm.commanded
    # the height is measured now, because the grasp may have changed the pose of the body
    z = surface(scene, name, goal) + tool_z - scene.height(name)[0] + _SETTING_DOWN
    is_lowered = yield from _holding(scene, name, arm.move(x, y, z + 0.03))
    if is_lowered:
        is_lowered = yield from _holding(scene, name, arm.move(x, y, z, speed=_SLOW / 2))
    return "" if is_lowered else f"{name} slipped out of the fingers as it was set down"


def let_go(scene: Scene, opening: float) -> Motion:
    """Open the fingers, and lift them."""
    x, y, _ = scene.arm.commanded
    yield from scene.arm.grip(opening)
    yield from scene.arm.move(x, y, ABOVE)


def miss_text(scene: Scene, name: str, goal: Point, *, stood: bool = True) -> str:
    """Return the reason why a released body misses its goal, or "" if it is at its goal."""
    if stood and not scene.pose(name).stands:
        return f"{name} fell over"
    miss_m = math.dist(scene.place_of(name), goal)
    return "" if miss_m <= _NEAR else f"{name} lies {miss_m * 100:.1f} cm from where it was put"


def _tool_for(scene: Scene, name: str, goal: Point, tool_yaw: float) -> Point:
    """Return the tool position that brings the held body to `goal`; the body may be off the tool's centre."""
    x, y = scene.place_of(name)
    tool_x, tool_y, _ = scene.arm.commanded
    dx, dy, yaw_change = x - tool_x, y - tool_y, tool_yaw - scene.arm.yaw
    cosine, sine = math.cos(yaw_change), math.sin(yaw_change)
    return goal[0] - dx * cosine + dy * sine, goal[1] - dx * sine - dy * cosine


def _holding(scene: Scene, name: str, motion: Motion) -> Generator[None, None, bool]:
    """Run a motion while the fingers hold a body; stop and return False if the body is lost."""
    lost_ticks = 0
    for _ in motion:
        yield
        lost_ticks = lost_ticks + 1 if scene.engine.fingers_touching(name) == 0 else 0
        if lost_ticks >= _LOST_TICKS:
            return False
    return True


# ---------------------------------------------------------------------------------------------------- pushing


_LOW = FINGERTIP + 0.006
"""Height of the tool during a push, metres: low enough not to tip a body."""
_AWAY = 0.01
"""Distance behind a body at which the fingers come down, metres."""
_MARGIN = 0.001
"""Distance from the goal at which a stroke ends, and least clearance behind a pushed body, metres."""
_PUSH_FAST, _PUSH_SLOW = 0.1, 0.015
"""Speed of a push at the beginning and at the end, m/s."""
_CLOSE = 0.004
"""Distance to the goal up to which a body needs no further stroke, metres."""
_FAR = 0.015
"""Tolerance of a body's position after all strokes, metres."""
_STRAIGHTENED = 0.0025
"""Distance from a straight line up to which points of a path are dropped, metres."""
_TURNED = 0.05
"""Tolerance of a requested yaw, radians."""
_TURNS = 2
"""Maximum number of turns on the spot."""
_STROKES = 4
"""Maximum number of strokes to one goal."""


def pushing(
    scene: Scene, name: str, path: Sequence[Point], yaw: float | None = None
) -> Generator[None, None, Outcome]:
    """Push a body along a path, one stroke for each straight segment, with corrections at the end.

    Strokes rotate the body: its side aligns with the fingers. With `yaw`, the body is turned at the end.
    """
    corners = straighten([scene.place_of(name), *path])[1:]
    for corner in corners[:-1]:
        # corners need less precision than the goal
        failure = yield from _push_to(scene, name, corner, max_strokes=1, tolerance_m=3 * _FAR)
        if failure is not None:
            return failure
    failure = yield from _push_to(scene, name, corners[-1], max_strokes=_STROKES, tolerance_m=_FAR)
    if failure is not None:
        return failure
    if turn_failure := (yield from _turn_to(scene, name, corners[-1], yaw)):
        return Outcome(False, turn_failure, "place")
    is_straight = len(corners) == 1
    way_text = "straight to its place" if is_straight else f"along {len(corners)} straight stretches"
    turn_text = "" if yaw is None else ", and turned it there"
    return Outcome(True, f"pushed {name} {way_text}{turn_text}")


def _push_to(
    scene: Scene, name: str, goal: Point, *, max_strokes: int, tolerance_m: float
) -> Generator[None, None, Outcome | None]:
    """Push a body to a point in up to `max_strokes` strokes; return the failure, or None."""
    miss_m = 0.0
    for _ in range(max_strokes):
        failure = yield from _stroke(scene, name, goal)
        if failure is not None:
            return failure
        miss_m = math.dist(scene.place_of(name), goal)
        if miss_m <= _CLOSE:
            break
    if miss_m <= tolerance_m:
        return None
    return Outcome(False, f"{name} ended {miss_m * 100:.1f} cm from where it was pushed to", "place")


def _turn_to(scene: Scene, name: str, goal: Point, yaw: float | None) -> Generator[None, None, str]:
    """Turn a body to a yaw near its goal; return the reason of a failure, or ""."""
    if yaw is None:
        return ""
    for _ in range(_TURNS):
        if abs(scene.pose(name).turned_from(yaw)) <= _TURNED:
            break
        failure = yield from turn_on_the_spot(scene, name, yaw)
        if failure:
            return failure
    remaining_yaw = abs(scene.pose(name).turned_from(yaw))
    if remaining_yaw > _TURNED:
        return f"{name} is {math.degrees(remaining_yaw):.0f} degrees from how it was turned"
    miss_m = math.dist(scene.place_of(name), goal)
    return "" if miss_m <= _FAR else f"{name} ended {miss_m * 100:.1f} cm from where it was pushed to"


def straighten(path: Sequence[Point]) -> list[Point]:
    """Return the corners of a path, without points on straight lines (Douglas–Peucker)."""
    if len(path) < 3:
        return list(path)
    points = np.array(path)
    chord = points[-1] - points[0]
    chord_length = float(np.hypot(*chord))
    offsets = points - points[0]
    if chord_length > 0:
        distances = np.abs(offsets[:, 0] * chord[1] - offsets[:, 1] * chord[0]) / chord_length
    else:
        distances = np.hypot(offsets[:, 0], offsets[:, 1])
    farthest_index = int(np.argmax(distances))
    if distances[farthest_index] <= _STRAIGHTENED:
        return [path[0], path[-1]]
    return straighten(path[: farthest_index + 1])[:-1] + straighten(path[farthest_index:])


def _stroke(scene: Scene, name: str, goal: Point) -> Generator[None, None, Outcome | None]:
    """Push a body in a straight line to a point; return the failure, or None."""
    x, y = scene.place_of(name)
    distance = math.dist((x, y), goal)
    if distance < _CLOSE:
        return None
    heading = math.atan2(goal[1] - y, goal[0] - x)
    unit_x, unit_y = math.cos(heading), math.sin(heading)
    # distance from the body's centre back to the fingers
    back = unit_x * x + unit_y * y - extent(scene.footprint(name), heading)[0] + FINGER_DEPTH / 2
    start_point = (x - unit_x * (back + _AWAY), y - unit_y * (back + _AWAY))
    if not in_reach(*goal):
        reason = f"the robot does not reach ({goal[0]:.2f}, {goal[1]:.2f}), where {name} should go"
        return Outcome(False, reason, "place")
    if not in_reach(*start_point):
        return Outcome(False, f"the robot does not reach behind {name} where it lies", "pick")
    finger_width = _gap(scene, name, start_point, heading)
    if finger_width is None:
        return Outcome(False, f"no room for the fingers behind {name}", "pick")
    arm = scene.arm
    yield from arm.travel(*start_point, turn_towards(heading, *start_point))
    yield from arm.grip(finger_width)
    yield from arm.move(*start_point, 0.08)
    yield from arm.move(*start_point, _LOW, speed=0.2)
    is_pushed = yield from _advance(scene, name, start_point, heading, distance, back)
    x, y, z = arm.commanded
    yield from arm.move(x - 0.02 * unit_x, y - 0.02 * unit_y, z)
    yield from arm.move(x - 0.02 * unit_x, y - 0.02 * unit_y, 0.1)
    return None if is_pushed else Outcome(False, f"the fingers lost {name}", "way")


def _advance(
    scene: Scene, name: str, start_point: Point, heading: float, distance: float, back: float
) -> Generator[None, None, bool]:
    """Move the fingers until the body has moved by `distance`; return False if the body stays behind.

    Args:
        back: distance from the body's centre back to the fingers, metres.
    """
    unit_x, unit_y = math.cos(heading), math.sin(heading)
    x, y = scene.place_of(name)
    advance = 0.0
    while True:
        body_place = scene.place_of(name)
        remaining = distance - (body_place[0] - x) * unit_x - (body_place[1] - y) * unit_y
        if remaining <= _MARGIN:
            return True
        # the fingers have passed the goal without the body
        if advance > distance + back + _AWAY:
            return False
        advance += min(_PUSH_FAST, _PUSH_SLOW + 2.0 * remaining) / TICKS_PER_S
        scene.arm.aim(
            np.array([start_point[0] + unit_x * advance, start_point[1] + unit_y * advance, _LOW]),
            scene.arm.yaw,
        )
        yield


def _gap(scene: Scene, name: str, place: Point, heading: float) -> float | None:
    """Return the widest distance of the fingers that fits behind a body; None if no distance fits."""
    lowest, highest = extent(scene.footprint(name), heading + math.pi / 2)
    widest = max(0.0, min(0.05, highest - lowest - 2 * FINGER_WIDTH))
    for gap in (widest, widest / 2, 0.0):
        fingers = rectangle(*place, FINGER_DEPTH, gap + 2 * FINGER_WIDTH, heading)
        if scene.clearance(fingers, name) > _MARGIN:
            return gap
    return None
