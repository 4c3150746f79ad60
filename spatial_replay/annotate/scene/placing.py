"""Places of names beside what they name, off outlines, arrows and each other."""

from __future__ import annotations

from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Floats

LETTER: Final = 0.5
"""Width of a letter by the height of a line."""
_GAP: Final = 0.25
"""Distance of a name from what it names, by the height of a line."""
_SIDES: Final = np.array([(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1)], np.float64)
_SIDES.flags.writeable = False
"""The eight positions in the order in which they are tried: above, below, right, left, corners."""


def place_names(low: Floats, high: Floats, letters: Floats, blocked: Floats, line: float) -> Floats:
    """Return the middles (K, N, 2) of N names in each of K scenes: each at the first side that is free.

    A name without a free side is placed above all of its scene's boxes.

    Args:
        low, high: (K, N, 2), corners of the boxes of what is named.
        letters: (K, N), lengths of the names.
        blocked: (K, B, 2, 2), low and high corners of boxes that no name may cover; NaN for none.
        line: the height of a name.
    """
    middles = np.empty(low.shape)
    for number in range(low.shape[1]):
        half = np.full((len(low), 2), line / 2.0)
        half[:, 0] *= LETTER * letters[:, number]
        middle = (low[:, number] + high[:, number]) / 2.0
        reach = (high[:, number] - low[:, number]) / 2.0 + half + _GAP * line
        sides = middle[:, None] + _SIDES * reach[:, None]
        begin, end = (sides - half[:, None])[:, :, None], (sides + half[:, None])[:, :, None]
        is_covered = (begin < blocked[:, None, :, 1]) & (blocked[:, None, :, 0] < end)
        meets = is_covered.all(axis=3).any(axis=2)
        places = sides[np.arange(len(sides)), meets.argmin(axis=1)]
        crowded = np.flatnonzero(meets.all(axis=1))
        top = np.nanmax(blocked[crowded, :, 1, 1], axis=1, initial=-np.inf)
        places[crowded] = np.stack([middle[crowded, 0], top + half[crowded, 1] + _GAP * line], axis=1)
        middles[:, number] = places
        box = np.stack([places - half, places + half], axis=1)
        blocked = np.concatenate([blocked, box[:, None]], axis=1)
    return middles
