"""Errors of detection, drawn from a seed."""

from __future__ import annotations

import math

import numpy as np


def displacements(radius_m: float, seed: int, sample: int, count: int) -> list[tuple[float, float]]:
    """How far detection is off for each of `count` bodies in a sample, in metres along x and y.

    Each is drawn evenly from a disc, so that no error is greater than its radius. They depend on nothing
    but the arguments: a sample looked at twice shows the same.
    """
    if radius_m == 0:
        return [(0.0, 0.0)] * count
    drawn = np.random.default_rng([seed, sample, 1]).random((count, 2))
    radii = (radius_m * np.sqrt(drawn[:, 0])).tolist()
    angles = (2 * math.pi * drawn[:, 1]).tolist()
    return [(r * math.cos(a), r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]
