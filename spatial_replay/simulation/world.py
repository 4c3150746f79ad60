"""The interface of simulated worlds to the rest of the package."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from spatial_replay.geometry.footprint import Footprint
from spatial_replay.simulation.shapes import Shape
from spatial_replay.trace.sample import Sample

Skill = Literal["push", "place"]
"""What the robot does with an object: push it along a path, or pick and place it."""
Stage = Literal["pick", "way", "place"]
"""Of a motion: taking hold of its object, moving it, leaving it at its goal."""


@dataclass(frozen=True, slots=True)
class Body:
    """An object of a world.

    Attributes:
        name, class_name: as in the samples.
        shape: in metres.
        movable: whether the robot can push it, or pick and place it.
        support: whether other objects may be placed on it, as on a plate. It is then not an obstacle to them,
            and has no height in samples, so that objects on it count as inside.
    """

    name: str
    class_name: str
    shape: Shape
    movable: bool = True
    support: bool = False


@dataclass(frozen=True, slots=True)
class ReachableArea:
    """The area in which the robot can place the centre of an object: a box and a ring around its base.

    Attributes:
        xmin, ymin, xmax, ymax: the box, in metres.
        nearest, farthest: distances from the base, in metres.
        yaws: allowed yaws of objects, in radians; none to keep theirs.
    """

    xmin: float
    ymin: float
    xmax: float
    ymax: float
    nearest: float = 0.0
    farthest: float = math.inf
    yaws: tuple[float, ...] = ()

    def contains(self, x: float, y: float) -> bool:
        """Return whether a point is inside or on the border."""
        inside = self.xmin <= x <= self.xmax and self.ymin <= y <= self.ymax
        return inside and self.nearest <= math.hypot(x, y) <= self.farthest


@dataclass(frozen=True, slots=True)
class Execution:
    """The result of a motion.

    Attributes:
        succeeded: whether the object is at its goal.
        reason: what happened, as text.
        at: the stage at which it failed; None if it is not known.
    """

    succeeded: bool
    reason: str
    at: Stage | None = None


class TreeNode(NamedTuple):
    """A node of a behaviour tree.

    Attributes:
        kind: such as Sequence, Selector, Retry, or Action for a leaf.
        parent: place of the node above among the nodes; None for the root.
        status: RUNNING, SUCCESS or FAILURE; INVALID if it was not ticked since the tree began or was reset.
    """

    name: str
    kind: str
    parent: int | None
    status: str


class TreeTick(NamedTuple):
    """A behaviour tree after a tick that changed the status of a node: depth first, children in order."""

    number: int
    nodes: tuple[TreeNode, ...]


class World(Protocol):
    """A world that is simulated step by step; lengths are in metres.

    The robot's base is at (0, 0); x points forward, y to its left, z up; the table is z = 0. Methods that
    advance time (`step`, `push`, `place`) pass each sample to the attached listener when it is due; the first
    one, of time 0, when time starts to advance.
    """

    @property
    def name(self) -> str:
        """The scenario's name."""

    @property
    def skill(self) -> Skill:
        """What the robot does with objects."""

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The objects, in the order of the samples."""

    @property
    def workspace(self) -> ReachableArea:
        """Where the robot can place objects."""

    @property
    def obstacles(self) -> tuple[Footprint, ...]:
        """Fixed obstacles that are not bodies."""

    @property
    def time_ns(self) -> int:
        """The simulated time, from 0."""

    def attach(
        self,
        listen: Callable[[Sample], str | None],
        listen_to_tree: Callable[[TreeTick], None] = lambda tick: None,
    ) -> None:
        """Pass samples to `listen` from now on, and ticks of behaviour trees to `listen_to_tree`.

        A reason that `listen` returns stops a motion.
        """

    def reset(self, seed: int) -> None:
        """Restart at time 0; equal seeds give equal worlds."""

    def sample(self) -> Sample:
        """Return the current sample: all bodies, with detection noise; repeated calls return the same."""

    def step(self) -> None:
        """Advance to the time of the next sample; the robot holds still."""

    def push(self, name: str, path: Sequence[tuple[float, float]], yaw: float | None = None) -> Execution:
        """Push an object along a path of points (x, y) of its centre, and turn it there to `yaw` if given.

        Raises:
            UsageError: no such object, or the robot does not push.
        """

    def place(
        self,
        name: str,
        x: float,
        y: float,
        yaw: float | None = None,
        via: Sequence[tuple[float, float]] = (),
    ) -> Execution:
        """Pick an object up, carry it along points and place its centre at (x, y); None keeps its yaw.

        Raises:
            UsageError: no such object, or the robot does not pick.
        """

    def close(self) -> None:
        """Release the simulator."""
