"""Footprints as rings of points, one for each part, as scenes and reports draw them."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import (
    Floats,
    Integers,
    combined,
    equal_places,
    flat_index,
    starts_from_counts,
)
from spatial_replay.geometry.footprint import Footprint, FootprintBatch
from spatial_replay.trace.trace import Trace

ROUND: Final = 32
"""Points on the ring of a rounded part."""


class Rings(NamedTuple):
    """The rings of R footprints, as ragged rows.

    Attributes:
        start: (R + 1,) int64, where each footprint's points begin.
        points: (P, 2), counter-clockwise.
        form: (R,) int64, index into `forms`.
        forms: for each form, the lengths of its rings and whether it has a height.
        has_round: whether any part is rounded, or a point.
    """

    start: Integers
    points: Floats
    form: Integers
    forms: tuple[Form, ...]
    has_round: bool

    def rings_of(self, footprint: int) -> tuple[Floats, ...]:
        """Return the rings (n, 2) of one of the footprints."""
        end, rings = int(self.start[footprint]), []
        for length in self.forms[self.form[footprint]].rings:
            begin, end = end, end + length
            rings.append(self.points[begin:end])
        return tuple(rings)


class Form(NamedTuple):
    """The primitives of a footprint: the lengths of its rings, and whether it has a height."""

    rings: tuple[int, ...]
    has_height: bool


def rings_of(footprints: FootprintBatch, point_radius: float) -> Rings:
    """Return the rings of footprints; a bare point becomes a disc of the given radius."""
    counts = np.diff(footprints.vertex_start)
    is_round = (counts == 1) | (footprints.radius > 0.0)
    lengths = np.where(is_round, ROUND, counts)
    part_start = starts_from_counts(lengths)
    form, forms = _forms(footprints, lengths)
    if not is_round.any():
        corners = footprints.vertices[footprints.vertex_start[0] : footprints.vertex_start[-1]]
        return Rings(part_start[footprints.part_start], corners, form, forms, False)
    points = np.empty((part_start[-1], 2))
    straight = ~is_round
    points[flat_index(part_start[:-1][straight], counts[straight])] = footprints.vertices[
        flat_index(footprints.vertex_start[:-1][straight], counts[straight])
    ]
    for count in np.unique(counts[is_round]).tolist():
        parts = np.flatnonzero(is_round & (counts == count))
        corners = footprints.vertices[footprints.vertex_start[parts][:, None] + np.arange(count)]
        radius = np.where(footprints.radius[parts] > 0.0, footprints.radius[parts], point_radius)
        points[part_start[parts][:, None] + np.arange(ROUND)] = _rounded(corners, radius)
    return Rings(part_start[footprints.part_start], points, form, forms, True)


def outlines_of(footprint: Footprint) -> list[Floats]:
    """Return the ring (n, 2) of each part of one footprint."""
    return list(rings_of(FootprintBatch.from_footprints([footprint]), 0.0).rings_of(0))


def extents(footprints: FootprintBatch) -> Floats:
    """Return (R,) the longer side of each footprint's bounding box."""
    if not len(footprints):
        return np.empty(0)
    start = footprints.vertex_start[footprints.part_start]
    if footprints.radius.any():
        radius = np.repeat(footprints.radius, np.diff(footprints.vertex_start))[:, None]
        sides = boxes(footprints.vertices + radius, start)[1] - boxes(footprints.vertices - radius, start)[0]
    else:
        low, high = boxes(footprints.vertices, start)
        sides = high - low
    return np.asarray(np.maximum(sides[:, 0], sides[:, 1]))


def boxes(points: Floats, start: Integers) -> tuple[Floats, Floats]:
    """Return the least and the greatest coordinates, (R, 2) each, of rows of points.

    Args:
        points: (P, 2).
        start: (R + 1,), where each row begins and the last one ends; none is empty.
    """
    if len(start) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    points = points[: start[-1]]
    return np.minimum.reduceat(points, start[:-1]), np.maximum.reduceat(points, start[:-1])


_ANGLES = np.arange(ROUND) * (2.0 * np.pi / ROUND)
_DIRECTIONS: Final = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


def _rounded(corners: Floats, radius: Floats) -> Floats:
    """Return the rings (M, ROUND, 2) of M parts: the outermost point in each direction.

    Args:
        corners: (M, n, 2).
        radius: (M,).
    """
    x, y = _DIRECTIONS[:, :1], _DIRECTIONS[:, 1:]
    reach = corners[:, None, :, 0] * x + corners[:, None, :, 1] * y
    outermost = np.take_along_axis(corners, reach.argmax(axis=2)[:, :, None], axis=1)
    return np.asarray(outermost + radius[:, None, None] * _DIRECTIONS)


def _forms(footprints: FootprintBatch, lengths: Integers) -> tuple[Integers, tuple[Form, ...]]:
    """Return (R,) the form of each footprint, and the forms."""
    part_counts = np.diff(footprints.part_start)
    has_height = ~np.isnan(footprints.bottom)
    columns = [part_counts, has_height]
    for part in range(int(part_counts.max(initial=0))):
        has_part = part_counts > part
        at = np.where(has_part, footprints.part_start[:-1] + part, 0)
        columns.append(np.where(has_part, lengths[at], 0))
    form, forms = np.zeros(len(footprints), np.int64), list[Form]()
    for places in equal_places(combined(columns, len(footprints))):
        form[places], row = len(forms), int(places[0])
        rings = lengths[footprints.part_start[row] : footprints.part_start[row + 1]]
        forms.append(Form(tuple(rings.tolist()), bool(has_height[row])))
    return form, tuple(forms)


class SceneBounds(NamedTuple):
    """The box that a log's footprints lie in, in footprint units."""

    xmin: float
    ymin: float
    xmax: float
    ymax: float

    @classmethod
    def of(cls, trace: Trace, before: SceneBounds | None = None) -> SceneBounds | None:
        """Return the box of some samples and of those before; None without any footprint."""
        vertices = trace.footprints.vertices
        low, high = _corners(vertices)
        if not np.isfinite([low, high]).all():
            vertices = vertices[np.isfinite(vertices).all(axis=1)]
            low, high = _corners(vertices)
        if not len(vertices):
            return before
        if before is not None:
            low = [min(low[0], before.xmin), min(low[1], before.ymin)]
            high = [max(high[0], before.xmax), max(high[1], before.ymax)]
        return cls(low[0], low[1], high[0], high[1])


def _corners(vertices: Floats) -> tuple[list[float], list[float]]:
    """Return the least and the greatest coordinates of vertices (V, 2); infinite without any."""
    columns = [vertices[:, axis] for axis in (0, 1)]
    low = [float(column.min(initial=np.inf)) for column in columns]
    return low, [float(column.max(initial=-np.inf)) for column in columns]
