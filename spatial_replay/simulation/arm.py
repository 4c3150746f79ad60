"""A robot arm with a gripper, and the scene that it works on."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint, FootprintBatch
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure
from spatial_replay.simulation.bullet import REST, STEPS_PER_S, Engine, downwards, joints_for, tool_frame
from spatial_replay.simulation.world import Body, Pose, TreeTick, footprint, height

TICKS_PER_S = 60
"""Commands of the arm per second."""
STEPS_PER_TICK = STEPS_PER_S // TICKS_PER_S

WIDEST = 0.08
"""The maximum distance of the fingers, in metres."""
FINGERTIP = 0.008
"""How far the fingertips reach below the tool's point, in metres."""
FINGER_DEPTH, FINGER_WIDTH = 0.018, 0.0145
"""The size of a finger across the axis on which the fingers open, and along it, in metres."""
ABOVE = 0.3
"""The travel height of the tool, in metres."""

Motion: TypeAlias = Generator[None, None, None]
"""A motion: each of its steps commands the arm for one tick."""

_FAST = 0.45
_TURNING = 2.0
_REACHED = 0.003
_SETTLING_TICKS = 30
_GRIP_FORCE = 25.0
_PINCHED = 0.004
"""How much wider than commanded the fingers are, in metres, if they hold something."""
_MIDDLE, _FURTHEST = 0.78, 2.75
"""The centre of the tool's yaw range relative to the direction from the base, and its half width."""
_NEAREST, _FARTHEST = 0.27, 0.77
"""The smallest and the largest distance from the base at which the tool reaches the table, in metres."""
_INSIDE = 0.33
"""The smallest distance from the base when the tool travels around it, in metres."""


class Arm:
    """A Franka arm: positions in metres, yaw of the tool in radians."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._joints = joints_for(np.array([0.4, 0.0, ABOVE]), downwards(0.0), REST, 50)
        self._position, self._yaw = np.array([0.4, 0.0, ABOVE]), 0.0
        self._width = WIDEST
        self._velocities = np.zeros_like(self._joints)
        self.limp = False
        """Whether the gripper stays open, regardless of its commands."""
        engine.set_joints(self._joints, self._width)

    @property
    def position(self) -> Floats:
        """The actual position (3,) of the tool point."""
        return tool_frame(self._engine.joints())[0]

    @property
    def width(self) -> float:
        """The actual distance of the fingers."""
        return self._engine.finger_width()

    @property
    def holds(self) -> bool:
        """Whether something between the fingers keeps them from their distance."""
        return self.width > self._width + _PINCHED

    def drive(self) -> None:
        """Send the latest command to the motors; it holds for one tick."""
        width = WIDEST if self.limp else self._width
        self._engine.drive(self._joints, self._velocities, width, _GRIP_FORCE)

    def aim(self, position: Floats, yaw: float) -> None:
        """Command the tool to a pose that it can reach within one tick."""
        joints = joints_for(position, downwards(yaw), self._joints)
        self._velocities = (joints - self._joints) * TICKS_PER_S
        self._joints, self._position, self._yaw = joints, position, yaw

    def move(self, x: float, y: float, z: float, yaw: float | None = None, *, speed: float = _FAST) -> Motion:
        """Move the tool in a straight line, and wait until it is at rest."""
        goal = np.array([x, y, z])
        start, turned = self._position, self._yaw
        turn = 0.0 if yaw is None else yaw - turned
        distance = math.dist(start, goal)
        for share in _shares(distance / speed, abs(turn) / _TURNING):
            self.aim(start + share * (goal - start), turned + share * turn)
            yield
        yield from self._settle()

    def travel(self, x: float, y: float, yaw: float) -> Motion:
        """Lift the tool and move it above a point, around the base."""
        start = self._position
        if start[2] < ABOVE - 0.01:
            yield from self.move(start[0], start[1], ABOVE)
            start = self._position
        radius, angle = math.hypot(start[0], start[1]), math.atan2(start[1], start[0])
        longer, further = math.hypot(x, y) - radius, math.atan2(y, x) - angle
        turned = self._yaw
        turn = yaw - turned
        lengths = math.hypot(longer, further * max(radius, 0.4))
        for share in _shares(lengths / _FAST, abs(turn) / _TURNING):
            r, a = max(radius + share * longer, _INSIDE), angle + share * further
            self.aim(np.array([r * math.cos(a), r * math.sin(a), ABOVE]), turned + share * turn)
            yield
        # the goal may be closer to the base than the travel radius
        yield from self.move(x, y, ABOVE)

    def grip(self, width: float) -> Motion:
        """Move the fingers to a distance, or until a body between them stops them."""
        self._width = width
        self._velocities = np.zeros_like(self._joints)
        last = self.width
        yield
        for _ in range(TICKS_PER_S):
            for _ in range(6):
                yield
            now = self.width
            if abs(now - last) < 2e-4:
                return
            last = now

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
    """Return the share of a motion that is done after each tick: a cubic, slow at both ends."""
    # the cubic is 1.5 times as fast in the middle as on average
    count = max(1, math.ceil(1.5 * max(durations_s) * TICKS_PER_S))
    return [3 * (k / count) ** 2 - 2 * (k / count) ** 3 for k in range(1, count + 1)]


def turn_towards(yaw: float, x: float, y: float, period: float = math.pi) -> float:
    """Return the yaw, `yaw` plus whole periods, that is closest to the middle of the last joint's range.

    The period is pi for an empty gripper, which is symmetric, and 2 pi for one that holds a body.
    """
    low = math.atan2(y, x) + _MIDDLE - period / 2
    return low + (yaw - low) % period


def in_reach(x: float, y: float) -> bool:
    """Return whether the tool, pointing down, reaches a point on the table."""
    return _NEAREST <= math.hypot(x, y) <= _FARTHEST


def can_turn(yaw: float, x: float, y: float) -> bool:
    """Return whether the last joint can turn the tool at a point to `yaw`."""
    return abs(yaw - math.atan2(y, x) - _MIDDLE) <= _FURTHEST


# -------------------------------------------------------------------------------------------------- the scene


@dataclass(frozen=True, slots=True)
class Scene:
    """The physics, the arm, the bodies by name, and where ticks of behaviour trees go."""

    engine: Engine
    arm: Arm
    bodies: Mapping[str, Body]
    report_tick: Callable[[TreeTick], None] = lambda tick: None

    def pose(self, name: str) -> Pose:
        """Return the pose of a body."""
        return self.engine.pose(name)

    def place_of(self, name: str) -> tuple[float, float]:
        """Return the centre of a body in the plane, in metres."""
        x, y, _ = self.engine.pose(name).position.tolist()
        return x, y

    def footprint(self, name: str) -> Footprint:
        """Return the footprint of a body."""
        return footprint(self.bodies[name].shape, self.engine.pose(name))

    def height(self, name: str) -> tuple[float, float]:
        """Return the lowest and the highest point of a body."""
        return height(self.bodies[name].shape, self.engine.pose(name))

    def clearance(self, covered: Footprint, name: str, *, above: float = 0.0) -> float:
        """Return the distance, in metres, to all bodies but one that reach higher than `above`."""
        others = [
            self.footprint(other) for other in self.bodies if other != name and self.height(other)[1] > above
        ]
        return least_distance(covered, others) if others else math.inf

    def distance(self, covered: Footprint, name: str) -> float:
        """Return the distance to a body in the plane; below 0 if they overlap."""
        return least_distance(covered, [self.footprint(name)])


def least_distance(covered: Footprint, others: Sequence[Footprint]) -> float:
    """Return the distance, in metres, to the nearest of some footprints; below 0 if it overlaps one."""
    batch = FootprintBatch.from_footprints([covered, *others])
    operands = [Operand(np.array([[0]])), Operand(np.arange(1, len(batch))[None, :])]
    return float(measure(batch, operands, [MeasureRequest("signed_distance", 0, 1)])[0, 0])


def extent(covered: Footprint, angle: float) -> tuple[float, float]:
    """Return the smallest and the largest coordinate of a footprint along a direction."""
    along = np.array([math.cos(angle), math.sin(angle)])
    spans = [(part.vertices @ along, part.radius) for part in covered.parts]
    low = min(float(values.min()) - radius for values, radius in spans)
    return low, max(float(values.max()) + radius for values, radius in spans)


def rectangle(x: float, y: float, length: float, width: float, yaw: float) -> Footprint:
    """Return a rectangle around a point, with its length along `yaw`."""
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    corners: Floats = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * np.array([length, width]) / 2
    return Footprint.polygon(corners @ turn + np.array([x, y]))
