"""A robot arm with a gripper, commanded by where its tool should be."""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.simulation.bullet import STEPS_PER_S, Engine
from spatial_replay.simulation.kinematics import REST, downwards, joints_for, tool_frame

TICKS_PER_S = 60
"""How often in a second the arm is commanded."""
STEPS_PER_TICK = STEPS_PER_S // TICKS_PER_S

WIDEST = 0.08
"""The greatest distance of the fingers, in metres."""
FINGERTIP = 0.008
"""How far the fingertips reach below the tool's point, in metres."""
FINGER_DEPTH, FINGER_WIDTH = 0.018, 0.0145
"""A finger's size across the axis on which the fingers open, and along it, in metres."""
ABOVE = 0.3
"""The height at which the tool travels, in metres."""

Motion: TypeAlias = Generator[None, None, None]
"""A movement: each step of it commands the arm for one tick."""

_FAST = 0.45
_TURNING = 2.0
_REACHED = 0.003
_SETTLING_TICKS = 30
_GRIP_FORCE = 25.0
_MIDDLE, _FURTHEST = 0.78, 2.75
"""The middle of what the tool turns against the direction from the base, and how far it turns either way."""
_NEAREST, _FARTHEST = 0.27, 0.77
"""How near to the base and how far from it the tool comes to the table, in metres."""
_INSIDE = 0.33
"""The tool travels around the base at no less than this distance from it, in metres."""


class Arm:
    """A Franka arm: positions in metres, turns of the tool in radians."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._joints = joints_for(np.array([0.4, 0.0, ABOVE]), downwards(0.0), REST, 50)
        self._position, self._yaw = np.array([0.4, 0.0, ABOVE]), 0.0
        self._width = WIDEST
        self._velocities = np.zeros_like(self._joints)
        self.limp = False
        """Whether the gripper lets go, whatever it is commanded."""
        engine.set_joints(self._joints, self._width)

    @property
    def position(self) -> Floats:
        """Where the tool's point (3,) is."""
        return tool_frame(self._engine.joints())[0]

    @property
    def width(self) -> float:
        """How far apart the fingers are."""
        return self._engine.finger_width()

    def drive(self) -> None:
        """Give the motors the newest command; it holds for a tick."""
        width = WIDEST if self.limp else self._width
        self._engine.drive(self._joints, self._velocities, width, _GRIP_FORCE)

    def aim(self, position: Floats, yaw: float) -> None:
        """Command the tool to a pose that it can reach within a tick."""
        joints = joints_for(position, downwards(yaw), self._joints)
        self._velocities = (joints - self._joints) * TICKS_PER_S
        self._joints, self._position, self._yaw = joints, position, yaw

    def move(self, x: float, y: float, z: float, yaw: float | None = None, *, speed: float = _FAST) -> Motion:
        """Move the tool in a straight line, and wait until it has come to rest."""
        goal = np.array([x, y, z])
        start, turned = self._position, self._yaw
        turn = 0.0 if yaw is None else yaw - turned
        distance = math.dist(start, goal)
        for share in _shares(distance / speed, abs(turn) / _TURNING):
            self.aim(start + share * (goal - start), turned + share * turn)
            yield
        yield from self._settle()

    def travel(self, x: float, y: float, yaw: float) -> Motion:
        """Lift the tool and bring it above a point, around the base."""
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
        # the goal may lie nearer to the base than one travels
        yield from self.move(x, y, ABOVE)

    def grip(self, width: float) -> Motion:
        """Move the fingers to a distance, or until something between them stops them."""
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
        """Hold still for ever."""
        while True:
            yield from self.wait(1.0)

    @property
    def commanded(self) -> tuple[float, float, float]:
        """Where the tool's point is commanded to be."""
        x, y, z = self._position.tolist()
        return x, y, z

    @property
    def yaw(self) -> float:
        """The turn of the tool that is commanded."""
        return self._yaw

    def _settle(self) -> Motion:
        self._velocities = np.zeros_like(self._joints)
        for _ in range(_SETTLING_TICKS):
            if math.dist(self.position, self._position) < _REACHED:
                return
            yield


def _shares(*durations_s: float) -> list[float]:
    """How much of a movement is done after each of its ticks: slow at both ends."""
    count = max(1, math.ceil(1.5 * max(durations_s) * TICKS_PER_S))
    return [3 * (k / count) ** 2 - 2 * (k / count) ** 3 for k in range(1, count + 1)]


def turn_towards(yaw: float, x: float, y: float, period: float = math.pi) -> float:
    """The turn of a tool at a point that differs from `yaw` by whole periods and suits the last joint best.

    A gripper looks alike after half a turn; what it holds does not.
    """
    low = math.atan2(y, x) + _MIDDLE - period / 2
    return low + (yaw - low) % period


def in_reach(x: float, y: float) -> bool:
    """Whether the tool, pointing down, comes to a point on the table."""
    return _NEAREST <= math.hypot(x, y) <= _FARTHEST


def can_turn(yaw: float, x: float, y: float) -> bool:
    """Whether the last joint can turn the tool at a point to `yaw`."""
    return abs(yaw - math.atan2(y, x) - _MIDDLE) <= _FURTHEST
