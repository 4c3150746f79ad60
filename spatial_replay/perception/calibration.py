"""Calibration of a camera from frames of tags whose places on a sheet or a table are known."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.perception.frame import Frame
from spatial_replay.perception.opencv import Calibration, Camera, TagDetector, calibrate
from spatial_replay.perception.tags_file import ReferenceTag
from spatial_replay.text import counted

_LEAST_TAGS: Final = 4
_LEAST_VIEWS: Final = 6
_MOST_VIEWS: Final = 60
_APART: Final = 0.04
"""By what share of the image's width the tags of two views differ at least: equal views say nothing."""

_LOOSE: Final = 0.02
"""A standard deviation of the focal length above this share of it says that views were too much alike."""

_WRONG: Final = 8.0
"""Pixels by which corners are off when the sheet is not the one that was said; a bent one stays far below."""

_WIDE: Final = 0.6
"""The least share of the image's width and height that the tags of all views should reach over."""


class Calibrated(NamedTuple):
    """A calibration, and how far to trust it.

    Attributes:
        views: how many frames it is from.
        remarks: what would make it better.
    """

    calibration: Calibration
    views: int
    remarks: tuple[str, ...]


def calibrate_camera(
    name: str, frames: Iterable[Frame], family: str, references: Sequence[ReferenceTag]
) -> Calibrated:
    """Calibrate a camera from frames in which tags are seen from several sides.

    Args:
        name: of where the frames come from, for errors.
        references: the tags, at their places on one plane.

    Raises:
        LogError: there is no frame.
        UsageError: too few frames show enough of the tags from different sides, or the tags are not where
            the references have them.
    """
    detector = TagDetector(family)
    known = {each.id: each.corners for each in references}
    points: list[Floats] = []
    pixels: list[Floats] = []
    views: list[dict[int, Floats]] = []
    size: tuple[int, int] | None = None
    seen = 0
    for frame in frames:
        if frame.detections is not None:
            raise UsageError(f"{name} has detections without images; a camera is calibrated from its images")
        size = frame.image.shape[1], frame.image.shape[0]
        found = {each.id: each.corners for each in detector.detect(frame.image) if each.id in known}
        seen += len(found) >= _LEAST_TAGS
        if len(found) < _LEAST_TAGS or not _is_new(found, views, _APART * size[0]):
            continue
        views.append(found)
        flat = np.concatenate([known[number] for number in found])
        points.append(np.concatenate([flat, np.zeros((len(flat), 1))], axis=1))
        pixels.append(np.concatenate(list(found.values())))
        if len(views) == _MOST_VIEWS:
            break
    if size is None:
        raise LogError(f"{name} has no frame that can be read")
    if len(views) < _LEAST_VIEWS:
        raise UsageError(
            f"{name}: {counted(len(views), 'frame')} of different views with {_LEAST_TAGS} or more of the"
            f" tags ({counted(seen, 'frame')} with so many in all); {_LEAST_VIEWS} are needed: tilt it,"
            " or move the camera around the table, near and far"
        )
    found_calibration = calibrate(points, pixels, size)
    if not found_calibration.rms < _WRONG or not np.isfinite(found_calibration.deviations).all():
        raise UsageError(
            f"{name}: no camera sees the tags like that: with the best one, corners are off by"
            f" {found_calibration.rms:.1f} pixels; give --family, --ids, --size and --paper as the sheet was"
            " printed, or check the places of the reference tags"
        )
    return Calibrated(found_calibration, len(views), tuple(_remarks(found_calibration, pixels, size)))


def _is_new(found: dict[int, Floats], views: Sequence[dict[int, Floats]], least: float) -> bool:
    """Return whether no view before has the tags at the same places."""
    for view in views:
        shared = [number for number in found if number in view]
        off = [float(np.linalg.norm(found[number] - view[number], axis=1).mean()) for number in shared]
        if off and max(off) < least:
            return False
    return True


def _remarks(found: Calibration, pixels: Sequence[Floats], size: tuple[int, int]) -> list[str]:
    remarks = []
    (fx, fy), spread = found.camera.focal, found.deviations
    if max(spread[0] / fx, spread[1] / fy) > _LOOSE:
        remarks.append("the views are too much alike to measure the focal length: tilt the sheet more")
    every = np.concatenate(pixels)
    reach = (every.max(axis=0) - every.min(axis=0)) / np.array(size)
    if reach.min() < _WIDE:
        remarks.append(
            f"tags were seen in {reach[0]:.0%} of the image's width and {reach[1]:.0%} of its height: bring"
            " them to its corners, where a lens bends most"
        )
    if found.rms > 1.0:
        remarks.append(
            f"corners are off by {found.rms:.1f} pixels: is the sheet flat, printed at 100 %, the"
            " picture sharp?"
        )
    return remarks


def camera_text(camera: Camera) -> str:
    """Return the part of a tags file that describes a camera."""
    (fx, fy), (cx, cy), (width, height) = camera.focal, camera.centre, camera.size
    lines = [
        "camera:",
        f"  size: [{width}, {height}]",
        f"  focal: [{fx:.3f}, {fy:.3f}]",
        f"  centre: [{cx:.3f}, {cy:.3f}]",
    ]
    if camera.distortion:
        lines.append(f"  distortion: [{', '.join(f'{each:.6g}' for each in camera.distortion)}]")
    return "\n".join(lines) + "\n"
