"""Orientation in the plane."""

from __future__ import annotations

import math

import numpy as np

from spatial_replay.compiled import inlined, kernel
from spatial_replay.geometry.arrays import Floats


@inlined
def misalignment_of(first: float, second: float) -> float:
    """`misalignment` of two angles, for kernels."""
    x = math.cos(first) - math.cos(second)
    y = math.sin(first) - math.sin(second)
    return 0.5 * (x * x + y * y)


@kernel
def _misalignment(first: Floats, second: Floats, result: Floats) -> None:
    for k in range(len(first)):
        result[k] = misalignment_of(first[k], second[k])


def misalignment(first: Floats, second: Floats) -> Floats:
    """Half the squared distance of the unit vectors at two angles (Def. 10, 11): 1 - cos of their difference.

    Args:
        first, second: (T,) radians; NaN where there is none, and then the result is NaN.
    """
    result = np.empty(len(first))
    _misalignment(first, second, result)
    return result
