"""Frames: images, or the tags that were found in them, with their times."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats

Image = NDArray[np.uint8]
"""(height, width) grey or (height, width, 3) blue, green, red."""

LARGEST_PICTURE: Final = 64_000_000
"""Pixels of one image; no camera has more, and a damaged header may claim it."""

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_JPEG_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of the segments of a JPEG that have its size."""


NO_IMAGE: Final[Image] = np.zeros((0, 0), np.uint8)
"""Marks a frame of which only the tags were kept."""
NO_IMAGE.setflags(write=False)


class Detection(NamedTuple):
    """A tag in an image.

    Attributes:
        id: its number in the family.
        corners: (4, 2) in pixels, of the black square: bottom left, bottom right, top right, top left as
            seen on an upright tag.
        family: as a tags file names it; "" if it is that of the file.
    """

    id: int
    corners: Floats
    family: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of a camera.

    Attributes:
        time_ns: its stamp, on the clock of the samples.
        image: (height, width) grey, or (height, width, 3) blue, green, red.
        data: the frame as H.264 in Annex B form, where it came like that; b"" otherwise.
        is_key: whether `data` can be decoded without the frames before.
        detections: the tags that a robot found in it, which is not there itself; None to find them.

    Raises:
        UsageError: the image is not of these shapes, empty, or its numbers are not bytes.
    """

    time_ns: int
    image: Image
    data: bytes = field(default=b"", repr=False)
    is_key: bool = False
    detections: tuple[Detection, ...] | None = None

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        is_shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        if image.dtype != np.uint8 or not is_shaped or (self.detections is None and not image.size):
            raise UsageError(
                f"the image of a frame at {self.time_ns / 1e9:.3f} s is {image.dtype} {image.shape}; give"
                " uint8, (height, width) grey or (height, width, 3) blue, green, red"
            )


def encoded_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height that a JPEG, PNG or WebP image claims; None for anything else.

    Nothing is decoded: an image that claims too much can be refused for what it would cost.
    """
    try:
        if data.startswith(_PNG):
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp_size(data)
    except (struct.error, IndexError):
        pass
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:
            # filled up
            at += 1
            continue
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 2 + int(struct.unpack_from(">H", data, at + 2)[0])
    return None


def _webp_size(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
        return width, height
    if kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None
