"""The colours of robustness: blue where it is positive, vermillion where it is negative, grey where unknown.

Blue and vermillion are told apart with every common colour blindness, and so are their mixtures with grey.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from spatial_replay.geometry.arrays import Floats

POSITIVE: Final = (0.0, 0.447, 0.698)
NEGATIVE: Final = (0.835, 0.369, 0.0)
NEUTRAL: Final = (0.55, 0.55, 0.55)
LABEL: Final = (0.95, 0.95, 0.95)
"""Red, green and blue from 0 to 1."""

CURVES: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c8c8c")
"""Colours of curves beside each other, also told apart with every common colour blindness (Okabe and Ito)."""

_LEAST = 0.4
"""How far the colour of the slightest robustness is from grey: its sign can be seen."""


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


def hexadecimal(colour: tuple[float, float, float]) -> str:
    """A colour as texts name it: "#0072b2"."""
    return "#" + "".join(f"{round(255.0 * share):02x}" for share in colour)
