"""Rotations in space, many at a time: quaternions (x, y, z, w) and matrices."""

from __future__ import annotations

import numpy as np

from spatial_replay.geometry.arrays import Floats

_LEAST_NORM = 1e-6
_UPRIGHT = 1e-9


def matrices_from_quaternions(quaternions: Floats) -> tuple[Floats, Floats]:
    """Rotation matrices of quaternions of any length.

    A quaternion of zeros, as messages have it that were never given an orientation, stands for no rotation.

    Args:
        quaternions: (N, 4) x, y, z, w.

    Returns:
        (N, 3, 3) a_from_b matrices, whose columns are the axes of b; (N,) the angle of the projected x axis,
        NaN for quaternions of zeros.
    """
    norm = np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))
    is_zero = norm < _LEAST_NORM
    x, y, z, w = (quaternions / np.where(is_zero, 1.0, norm)[:, None]).T
    w = np.where(is_zero, 1.0, w)
    matrices = np.empty((len(quaternions), 3, 3))
    matrices[:, 0, 0] = 1 - 2 * (y * y + z * z)
    matrices[:, 0, 1] = 2 * (x * y - z * w)
    matrices[:, 0, 2] = 2 * (x * z + y * w)
    matrices[:, 1, 0] = 2 * (x * y + z * w)
    matrices[:, 1, 1] = 1 - 2 * (x * x + z * z)
    matrices[:, 1, 2] = 2 * (y * z - x * w)
    matrices[:, 2, 0] = 2 * (x * z - y * w)
    matrices[:, 2, 1] = 2 * (y * z + x * w)
    matrices[:, 2, 2] = 1 - 2 * (x * x + y * y)
    # rotations about z alone, the common case, exactly upright
    matrices[is_zero] = np.eye(3)
    return matrices, np.where(is_zero, np.nan, yaw_of(matrices))


def matrices_from_yaw(yaw: Floats) -> Floats:
    """(N, 3, 3) rotations about z by angles (N,) in radians."""
    matrices = np.zeros((len(yaw), 3, 3))
    cosine, sine = np.cos(yaw), np.sin(yaw)
    matrices[:, 0, 0] = matrices[:, 1, 1] = cosine
    matrices[:, 0, 1] = -sine
    matrices[:, 1, 0] = sine
    matrices[:, 2, 2] = 1.0
    return matrices


def yaw_of(matrices: Floats) -> Floats:
    """(N,) the angle of the x axis seen along z, in radians; NaN where that is a point."""
    x, y = matrices[:, 0, 0], matrices[:, 1, 0]
    return np.asarray(np.where(np.hypot(x, y) > _UPRIGHT, np.arctan2(y, x), np.nan))


def is_upright(matrices: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """(N,) whether the z axis stays the z axis, up or down."""
    return np.asarray(np.hypot(matrices[:, 0, 2], matrices[:, 1, 2]) <= _UPRIGHT)


def slerp(first: Floats, second: Floats, share: Floats) -> Floats:
    """Quaternions between two, at equal angular speed, on the shorter way.

    Args:
        first, second: (N, 4) x, y, z, w, of any length but 0.
        share: (N,) 0 for the first up to 1 for the second.
    """
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    dot = np.einsum("ij,ij->i", first, second)
    second = np.where(dot[:, None] < 0, -second, second)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    is_close = sine < _LEAST_NORM
    divisor = np.where(is_close, 1.0, sine)
    one = np.where(is_close, 1.0 - share, np.sin((1.0 - share) * angle) / divisor)
    other = np.where(is_close, share, np.sin(share * angle) / divisor)
    return np.asarray(one[:, None] * first + other[:, None] * second)
