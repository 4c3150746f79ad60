"""Frames: images with their times."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
"""(height, width) grey or (height, width, 3) blue, green, red."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of a camera.

    Attributes:
        time_ns: its stamp, on the clock of the samples.
        image: (height, width) grey, or (height, width, 3) blue, green, red.
        data: the frame as H.264 in Annex B form, where it came like that; b"" otherwise.
        is_key: whether `data` can be decoded without the frames before.
    """

    time_ns: int
    image: Image
    data: bytes = field(default=b"", repr=False)
    is_key: bool = False
