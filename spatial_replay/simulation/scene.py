"""The scene that motions work on: the robot and the poses, footprints and clearances of bodies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import Footprint
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure
from spatial_replay.simulation.arm import Arm
from spatial_replay.simulation.bullet import Engine
from spatial_replay.simulation.shapes import Pose, footprint, height
from spatial_replay.simulation.world import Body, TreeTick


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
