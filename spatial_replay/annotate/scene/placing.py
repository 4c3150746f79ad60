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
    boxes = list(blocked.swapaxes(0, 1))
    for number in range(low.shape[1]):
        half = np.full((len(low), 2), line / 2.0)
        half[:, 0] *= LETTER * letters[:, number]
        middle = (low[:, number] + high[:, number]) / 2.0
        reach = (high[:, number] - low[:, number]) / 2.0 + half + _GAP * line
        left = np.arange(len(low))
        for side in _SIDES:
            places = middle[left] + side * reach[left]
            middles[left, number] = places
            begin, end = places - half[left], places + half[left]
            is_covered = np.zeros(len(left), np.bool_)
            for box in boxes:
                is_covered |= ((begin < box[left, 1]) & (box[left, 0] < end)).all(axis=1)
            left = left[is_covered]
            if not len(left):
                break
        top = np.nanmax([box[left, 1, 1] for box in boxes], axis=0, initial=-np.inf)
        middles[left, number, 0] = middle[left, 0]
        middles[left, number, 1] = top + half[left, 1] + _GAP * line
        centres = middles[:, number]
        boxes.append(np.stack([centres - half, centres + half], axis=1))
    return middles
