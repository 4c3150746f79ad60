"""Shapes of bodies, and their footprints and heights in a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint

UPRIGHT = 1e-2
"""The lean, in radians, below which a body counts as upright."""

_LEVEL = 0.1
"""The lean, in radians, up to which a body has a yaw: a knife with its handle on a mat does."""

_RIM = 16
"""Corners of the polygon around the rim of a leaning cylinder."""


@dataclass(frozen=True, slots=True)
class Box:
    """A cuboid with edges along the body's axes x, y and z, in metres."""

    length: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder around the body's axis z, in metres."""

    radius: float
    height: float


Shape: TypeAlias = Box | Cylinder


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """The position of a body's centre, and its orientation.

    Attributes:
        position: (3,) float64, metres.
        rotation: (3, 3) float64, its columns the body's axes in the world.
    """

    position: Floats
    rotation: Floats

    @property
    def yaw(self) -> float:
        """The angle of the body's axis x in the plane, in radians, counter-clockwise from the world's."""
        return math.atan2(self.rotation[1, 0], self.rotation[0, 0])

    def turned_from(self, yaw: float) -> float:
        """Return the difference of the body's yaw to `yaw`, -pi to pi."""
        return math.remainder(self.yaw - yaw, 2 * math.pi)

    @property
    def lean(self) -> float:
        """The angle between the body's axis z and the vertical, 0 to pi."""
        return math.acos(min(1.0, max(-1.0, float(self.rotation[2, 2]))))

    @property
    def stands(self) -> bool:
        """Whether the body's axis z is vertical, upwards or downwards."""
        return min(self.lean, math.pi - self.lean) < UPRIGHT

    @property
    def is_level(self) -> bool:
        """Whether the body's axis z is nearly vertical, so that its yaw means something."""
        return min(self.lean, math.pi - self.lean) < _LEVEL


def footprint(shape: Shape, pose: Pose) -> Footprint:
    """Return the footprint of a body: a polygon, or a disc for an upright cylinder."""
    x, y = float(pose.position[0]), float(pose.position[1])
    match shape:
        case Cylinder(radius=radius) if pose.stands:
            return Footprint.disc(x, y, radius)
        case Box(length=length, width=width) if pose.stands:
            return Footprint.polygon(_rectangle(x, y, length / 2, width / 2, pose.yaw))
        case _:
            return Footprint.polygon(_outline(shape, pose)[:, :2], concave="hull")


def height(shape: Shape, pose: Pose) -> tuple[float, float]:
    """Return the lowest and the highest z of a body."""
    z = float(pose.position[2])
    up = np.abs(pose.rotation[2])
    if isinstance(shape, Box):
        half = float(up @ np.array([shape.length, shape.width, shape.height])) / 2
    else:
        half = shape.radius * math.hypot(up[0], up[1]) + shape.height / 2 * float(up[2])
    return z - half, z + half


def _rectangle(x: float, y: float, a: float, b: float, yaw: float) -> list[tuple[float, float]]:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    corners = ((a, b), (-a, b), (-a, -b), (a, -b))
    return [(x + u * cosine - v * sine, y + u * sine + v * cosine) for u, v in corners]


def _outline(shape: Shape, pose: Pose) -> Floats:
    """Return points (n, 3) whose convex hull is the body, or contains it for a cylinder."""
    if isinstance(shape, Box):
        signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], np.float64)
        points = signs * np.array([shape.length, shape.width, shape.height]) / 2
    else:
        angles = np.arange(_RIM) * (2 * math.pi / _RIM)
        # the polygon is around the rim, so that the footprint covers the body
        rim = shape.radius / math.cos(math.pi / _RIM) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points = np.concatenate([np.c_[rim, np.full(_RIM, z)] for z in (-shape.height / 2, shape.height / 2)])
    moved: Floats = points @ pose.rotation.T + pose.position
    return moved
