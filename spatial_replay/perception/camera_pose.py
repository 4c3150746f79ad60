"""Where a camera is: poses as rotation vectors and translations."""

from __future__ import annotations

import math

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats


def pose_looking_at(eye: Floats, target: Floats, up: Floats) -> Floats:
    """Return the pose (6,), rotation vector and translation from the plane's frame to that of a camera.

    Args:
        eye, target: (3,), where the camera is, and a point in the middle of its image.
        up: (3,), what points up in the image.

    Raises:
        UsageError: the camera is at the target, or `up` is where it looks.
    """
    forward = target - eye
    right = np.cross(forward, up)
    if not np.linalg.norm(forward) > 0 or not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        raise UsageError(
            "the camera's pose is not determined: give another look_at than its position, and an up that is"
            " not where it looks, such as up: [0, 1, 0] for a camera that looks straight down"
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.concatenate([rotation_vector(rotation), -rotation @ eye])


def rotation_vector(rotation: Floats) -> Floats:
    """Return the rotation vector (3,) of a rotation matrix (3, 3)."""
    # through the quaternion, whose largest component is never small
    xx, yy, zz = np.diag(rotation)
    four = np.array([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz])
    index = int(four.argmax())
    part = math.sqrt(max(four[index], 0.0)) / 2
    antisymmetric = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    symmetric = rotation + rotation.T
    if index == 0:
        w, vector = part, antisymmetric / (4 * part)
    else:
        axis = index - 1
        w = antisymmetric[axis] / (4 * part)
        vector = symmetric[axis] / (4 * part)
        vector[axis] = part
    if w < 0:
        w, vector = -w, -vector
    sine = float(np.linalg.norm(vector))
    angle = 2 * math.atan2(sine, w)
    turn: Floats = vector * (angle / sine if sine > 1e-12 else 2.0)
    return turn


def rotations(vectors: Floats) -> Floats:
    """Return the rotation matrices (N, 3, 3) of rotation vectors (N, 3)."""
    angle = np.linalg.norm(vectors, axis=1)
    safe = np.where(angle > 1e-12, angle, 1.0)
    x, y, z = (vectors / safe[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    sine, versine = np.sin(angle)[:, None, None], (1 - np.cos(angle))[:, None, None]
    matrices: Floats = np.eye(3) + sine * cross + versine * (cross @ cross)
    return matrices
