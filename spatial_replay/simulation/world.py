"""What the rest of the package knows of a simulated world."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from spatial_replay.geometry.footprint import Footprint
from spatial_replay.simulation.shapes import Shape
from spatial_replay.trace.sample import Sample

Skill = Literal["push", "place"]
"""What a robot does with an object: push it along a path, or pick it up and place it."""


@dataclass(frozen=True, slots=True)
class Body:
    """An object of a world.

    Attributes:
        name, class_name: as in the samples.
        shape: its form and size, in metres.
        movable: whether the robot can push it, or pick and place it.
        support: whether other objects may be placed on it, as on a plate. It is then no obstacle to them, and
            its samples have no height: what lies on it lies in it.
    """

    name: str
    class_name: str
    shape: Shape
    movable: bool = True
    support: bool = False


@dataclass(frozen=True, slots=True)
class ReachableArea:
    """Where the robot can put the centre of an object: a box, cut by a ring around its base at (0, 0).

    Attributes:
        xmin, ymin, xmax, ymax: the box, in metres.
        nearest, farthest: distances from the base, in metres.
        yaws: how the robot may turn objects, in radians; none to leave them as they are.
    """

    xmin: float
    ymin: float
    xmax: float
    ymax: float
    nearest: float = 0.0
    farthest: float = math.inf
    yaws: tuple[float, ...] = ()

    def contains(self, x: float, y: float) -> bool:
        """Whether a point lies in it, its border included."""
        inside = self.xmin <= x <= self.xmax and self.ymin <= y <= self.ymax
        return inside and self.nearest <= math.hypot(x, y) <= self.farthest


@dataclass(frozen=True, slots=True)
class Execution:
    """How a motion of the robot went.

    Attributes:
        succeeded: whether the object is where it was to be.
        reason: what happened, in words.
    """

    succeeded: bool
    reason: str


class World(Protocol):
    """A world that is simulated step by step; lengths are metres, y grows to the robot's left, z upwards.

    The robot's base stands at (0, 0) and looks along x; the table's surface is z = 0. Everything that
    advances time (`step`, `push`, `place`) hands each sample, when its time has come, to the listener that
    is attached; the first one, of time 0, when time begins to advance.
    """

    @property
    def name(self) -> str:
        """The scenario's name."""

    @property
    def skill(self) -> Skill:
        """What the robot does with objects."""

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The objects, in the order of their names in the samples."""

    @property
    def workspace(self) -> ReachableArea:
        """Where the robot reaches."""

    @property
    def obstacles(self) -> tuple[Footprint, ...]:
        """What stands in the plane beside the bodies and never moves."""

    @property
    def time_ns(self) -> int:
        """The simulated time, 0 at the beginning."""

    def attach(self, listen: Callable[[Sample], None]) -> None:
        """Hand samples to `listen` from now on."""

    def reset(self, seed: int) -> None:
        """Begin anew at time 0; equal seeds give equal worlds."""

    def sample(self) -> Sample:
        """What is seen now: every body, with noise if there is any; the same however often one asks."""

    def step(self) -> None:
        """Advance to the next sample's time, the robot holding still."""

    def push(self, name: str, path: Sequence[tuple[float, float]]) -> Execution:
        """Push an object so that its centre follows a path of points (x, y) in the plane.

        Raises:
            UsageError: no such object, or the world's robot does not push.
        """

    def place(self, name: str, x: float, y: float, yaw: float | None = None) -> Execution:
        """Pick an object up and place it with its centre at (x, y); `yaw` None leaves its turn as it is.

        Raises:
            UsageError: no such object, or the world's robot does not pick.
        """

    def close(self) -> None:
        """Give back what the simulator holds."""
