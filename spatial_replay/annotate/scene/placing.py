"""Places of names beside what they name, off outlines, arrows and each other."""

from __future__ import annotations

from collections.abc import Sequence
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
    # x and y apart: numpy compares long columns, not pairs
    boxes = [(box[:, 0].T.copy(), box[:, 1].T.copy()) for box in blocked.swapaxes(0, 1)]
    for number in range(low.shape[1]):
        half = np.full((2, len(low)), line / 2.0)
        half[0] *= LETTER * letters[:, number]
        middle = (low[:, number] + high[:, number]).T / 2.0
        reach = (high[:, number] - low[:, number]).T / 2.0 + half + _GAP * line
        centres = _first_free(middle, reach, half, boxes, line)
        middles[:, number] = centres.T
        boxes.append((centres - half, centres + half))
    return middles


_Box = tuple[Floats, Floats]
"""Low and high corners (2, K) of a box in each scene."""


def _first_free(middle: Floats, reach: Floats, half: Floats, boxes: Sequence[_Box], line: float) -> Floats:
    """Return the middles (2, K) of one name in each scene: at the first free side, or above all boxes."""
    centres = np.empty(middle.shape)
    left = np.arange(middle.shape[1])
    for side in _SIDES:
        is_first = len(left) == middle.shape[1]
        columns = [middle, reach, half] if is_first else [column[:, left] for column in (middle, reach, half)]
        places = columns[0] + side[:, None] * columns[1]
        centres[:, left] = places
        begin, end = places - columns[2], places + columns[2]
        is_covered = np.zeros(len(left), np.bool_)
        for low, high in boxes:
            if not is_first:
                low, high = low[:, left], high[:, left]
            is_covered |= (begin[0] < high[0]) & (low[0] < end[0]) & (begin[1] < high[1]) & (low[1] < end[1])
        left = left[is_covered]
        if not len(left):
            return centres
    top = np.nanmax([high[1, left] for _, high in boxes], axis=0, initial=-np.inf)
    centres[0, left] = middle[0, left]
    centres[1, left] = top + half[1, left] + _GAP * line
    return centres
