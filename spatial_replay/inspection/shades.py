"""How strongly robustness is coloured, by how large it is."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spatial_replay.geometry.arrays import Floats
from spatial_replay.palette import NEGATIVE, NEUTRAL, POSITIVE

_LEAST: Final = 0.4
"""How far the colour of the slightest robustness is from grey: its sign can be seen."""

_OPACITY: Final = 0.6
"""Of a map's cells: what lies over them stands out."""


def colours(robustness: ArrayLike, scale: ArrayLike) -> Floats:
    """The colours (..., 3) of robustness (...): full where it is as large as `scale`, grey where NaN.

    Args:
        scale: above 0, in the unit of the robustness; one, or an array that goes with it.
    """
    values = np.asarray(robustness, np.float64)[..., None]
    share = _LEAST + (1.0 - _LEAST) * np.minimum(np.abs(values) / np.asarray(scale)[..., None], 1.0)
    hue = np.where(values >= 0.0, POSITIVE, NEGATIVE)
    mixed = np.where(np.isnan(values), NEUTRAL, NEUTRAL + share * (hue - NEUTRAL))
    # the steps of a screen: finer ones nobody sees, and a log of them is larger
    return np.asarray(np.round(mixed * 255.0) / 255.0)


def cell_colours(robustness: Floats) -> NDArray[np.uint8]:
    """Red, green, blue and alpha (..., 4) of cells (...): full where the map is largest, clear where NaN."""
    largest = float(np.abs(robustness[np.isfinite(robustness)]).max(initial=0.0))
    opacity = np.where(np.isnan(robustness), 0.0, _OPACITY)
    shares = np.concatenate([colours(robustness, largest or 1.0), opacity[..., None]], axis=-1)
    return np.asarray(np.round(255.0 * shares), np.uint8)
