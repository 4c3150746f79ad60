"""Corners of tags to a fraction of a pixel: the lines along their four edges, and where these meet.

A corner of a small tag has cells of the tag within two or three pixels, which pull a search around the corner
away. An edge is long: the steps from white to black along it determine a line to a few hundredths of a pixel.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.perception.frame import Image

_ALONG: Final = 24
"""Places along an edge at which its step is measured."""

_MARGIN: Final = 0.1
"""The share of an edge that is left out at each end, where the other edges are."""

_APART: Final = 0.25
"""Pixels between two places across an edge."""

_CELLS: Final = 0.6
"""How far the step is searched across an edge, in cells of the tag: further, there are other edges."""

_WIDEST: Final = 3.0
_SECOND: Final = 0.5
"""How far at most, in pixels; and which share of it the second time, when the first has been close."""


def refined_corners(grey: Image, corners: Floats, cells: int) -> Floats:
    """Return corners closer to where they are; those of a tag whose edges are not found stay.

    Args:
        corners: (N, 4, 2) in pixels, in the order of a `Detection`, no more than two pixels off.
        cells: along the edge of the black square.
    """
    if not len(corners):
        return corners
    for share in (1.0, _SECOND):
        corners = _refined(grey, corners, cells, share)
    return corners


def _refined(grey: Image, corners: Floats, cells: int, share: float) -> Floats:
    ahead = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(ahead, axis=2)
    along = ahead / length[..., None]
    # image coordinates run down: this is out of a tag whose corners are in our order
    outward = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    reach = np.minimum(_CELLS * length.min(axis=1) / cells, _WIDEST) * share
    shares = np.linspace(_MARGIN, 1 - _MARGIN, _ALONG)
    on_edge = corners[:, :, None] + shares[:, None] * ahead[:, :, None]
    steps = np.arange(-round(_WIDEST / _APART), round(_WIDEST / _APART) + 1) * _APART
    # one pixel further on each side, for differences
    wide = np.arange(steps[0] - 1.0, steps[-1] + 1.0 + _APART / 2, _APART)
    points = on_edge[..., None, :] + wide[:, None] * outward[:, :, None, None]
    values = _bilinear(grey, points)
    two = round(2.0 / _APART)
    rise = values[..., two:] - values[..., :-two]
    weight = np.where(np.abs(steps) <= reach[:, None, None, None], np.square(np.maximum(rise, 0.0)), 0.0)
    total = weight.sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (weight * steps).sum(axis=-1) / total
    total = np.where(np.isfinite(at), total, 0.0)
    # the line through the steps of each edge: offset = a + b * share, with little weight on faint ones
    found = np.minimum(total, np.median(total, axis=-1, keepdims=True))
    sums = [(found * shares**power).sum(axis=-1) for power in range(3)]
    at = np.nan_to_num(at)
    moments = [(found * at * shares**power).sum(axis=-1) for power in range(2)]
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (sums[0] * moments[1] - sums[1] * moments[0]) / (sums[0] * sums[2] - sums[1] ** 2)
        begin = (moments[0] - slope * sums[1]) / sums[0]
    start = corners + begin[..., None] * outward
    direction = ahead + slope[..., None] * outward
    met = _meeting(np.roll(start, 1, axis=1), np.roll(direction, 1, axis=1), start, direction)
    is_sound = np.isfinite(met).all(axis=(1, 2)) & (
        np.linalg.norm(met - corners, axis=2).max(axis=1) <= 2 * reach + 1.0
    )
    return np.where(is_sound[:, None, None], met, corners)


def _bilinear(grey: Image, points: Floats) -> Floats:
    """Return the values of an image between its pixels; beyond its border, those at the border."""
    height, width = grey.shape
    x = np.clip(points[..., 0], 0, width - 1.001)
    y = np.clip(points[..., 1], 0, height - 1.001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    u, v = x - column, y - row
    flat, at = grey.ravel(), row * width + column
    above = (1 - u) * flat[at] + u * flat[at + 1]
    below = (1 - u) * flat[at + width] + u * flat[at + width + 1]
    values: Floats = (1 - v) * above + v * below
    return values


def _meeting(first: Floats, along: Floats, second: Floats, across: Floats) -> Floats:
    """Return where lines (…, 2) meet, each given by a point and a direction."""
    cross = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
    between = second - first
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (between[..., 0] * across[..., 1] - between[..., 1] * across[..., 0]) / cross
    met: Floats = first + share[..., None] * along
    return met
