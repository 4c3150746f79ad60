"""Where objects are: origins and axes, in columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.mapping.binding import Binding
from spatial_replay.logs.mapping.frames import Transforms
from spatial_replay.logs.mapping.readings import Reading
from spatial_replay.logs.mapping.rotation import matrices_from_quaternions, matrices_from_yaw, yaw_of


@dataclass(frozen=True, slots=True)
class Poses:
    """R poses.

    Attributes:
        position: (R, 3).
        rotation: (R, 3, 3) frame_from_object.
        yaw: (R,) radians; NaN for objects without an orientation.
    """

    position: Floats
    rotation: Floats
    yaw: Floats

    def moved(self, transforms: Transforms) -> Poses:
        """The same poses in another frame."""
        rotation = transforms.rotation @ self.rotation
        position = np.einsum("nij,nj->ni", transforms.rotation, self.position) + transforms.translation
        return Poses(position, rotation, np.where(np.isnan(self.yaw), np.nan, yaw_of(rotation)))


def poses_of(reading: Reading, binding: Binding, numbers: Floats) -> Poses:
    """The poses that the numbers (R, width) of objects hold; no orientation is the frame's own."""
    count = len(numbers)
    position = np.zeros((count, 3))
    for axis, column in enumerate(binding.position):
        position[:, axis] = numbers[:, column]
    if binding.orientation:
        rotation, yaw = matrices_from_quaternions(numbers[:, list(binding.orientation)])
        return Poses(position, rotation, yaw)
    if binding.yaw is not None:
        yaw = numbers[:, binding.yaw] * reading.angle_scale
        return Poses(position, matrices_from_yaw(yaw), yaw)
    return Poses(position, np.broadcast_to(np.eye(3), (count, 3, 3)), np.full(count, np.nan))
