"""The extent of a scene: the bounds of all footprints so far, and the size that scales texts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.annotate.scene.scene_template import boxes
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.trace.trace import Trace

VIEW: Final = 1.5
"""Height of the view, as a multiple of the scene's longer side. A panel may be narrower than high."""

_STEP: Final = 1.5
"""Ratio of consecutive sizes for texts. Steps keep names in place while a scene grows."""


class SceneBounds(NamedTuple):
    """The bounding box of a log's footprints, in footprint units."""

    xmin: float
    ymin: float
    xmax: float
    ymax: float

    @classmethod
    def of(cls, trace: Trace, before: SceneBounds | None = None) -> SceneBounds | None:
        """Return the box of some samples joined with an earlier box; None without any footprint."""
        lows, highs = _finite_boxes(trace.footprints.select(trace.rows[trace.rows >= 0]))
        box = cls(*lows.min(axis=0, initial=np.inf).tolist(), *highs.max(axis=0, initial=-np.inf).tolist())
        if not np.isfinite(box).all():
            return before
        return box if before is None else before.with_points(np.reshape(box, (2, 2)))

    def with_points(self, points: Floats) -> SceneBounds:
        """Return this box enlarged to contain some points (P, 2)."""
        corners = np.vstack([points, [self[:2], self[2:]]])
        return SceneBounds(*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist())

    def contains(self, footprints: FootprintBatch) -> bool:
        """Return whether all footprints are certainly inside; footprints with NaN corners are not inside."""
        radius = footprints.radius.max(initial=0.0)
        columns = zip(footprints.vertices.T, self[:2], self[2:], strict=True)
        return all(
            low <= column.min(initial=np.inf) - radius and column.max(initial=-np.inf) + radius <= high
            for column, low, high in columns
        )


class SceneExtent(NamedTuple):
    """The extent of the samples so far.

    Attributes:
        bounds: box of the footprints; None before any footprint.
        size: longer side of the box around footprints and regions, rounded up. Sizes are the first length
            times powers of `_STEP`.
    """

    bounds: SceneBounds | None = None
    size: float = 0.0

    def with_area(self, area: SceneBounds | None) -> SceneExtent:
        """Return the extent joined with the area of a planner's map; None is no area."""
        if area is None:
            return self
        bounds = area if self.bounds is None else self.bounds.with_points(np.reshape(area, (2, 2)))
        side = max(bounds.xmax - bounds.xmin, bounds.ymax - bounds.ymin)
        return SceneExtent(bounds, float(_in_steps(np.array([side]), self.size)[0]) if self.size else 0.0)

    def after(self, trace: Trace, regions: Floats | None = None) -> SceneExtent:
        """Return the extent after the next samples; see `grow`."""
        if not self.size:
            first_extent = self.grow(trace.slice(0, 1), regions)[0]
            return first_extent.after(trace, regions) if first_extent.size else self.grow(trace, regions)[0]
        bounds = SceneBounds.of(trace, self.bounds)
        if bounds is None or bounds == self.bounds:
            return self
        xmin, ymin, xmax, ymax = _with_regions(np.array(bounds), regions).tolist()
        sides = np.array([max(xmax - xmin, ymax - ymin)])
        return SceneExtent(bounds, float(_in_steps(sides, self.size)[0]))

    def grow(self, trace: Trace, regions: Floats | None = None) -> tuple[SceneExtent, Floats, Floats]:
        """Return the extent after T samples, and the running extent at each sample.

        Args:
            regions: corners (P, 2) of the regions.

        Returns:
            The extent; (T, 2, 2), running low and high corners around footprints and regions, infinite before
            any footprint; (T,), running sizes.
        """
        if self.size and self.bounds is not None and self.bounds.contains(trace.footprints):
            corners = np.reshape(_with_regions(np.array(self.bounds), regions), (1, 2, 2))
            return self, np.repeat(corners, len(trace), axis=0), np.full(len(trace), self.size)
        box_lows, box_highs = _finite_boxes(trace.footprints)
        earlier_corners = np.array(self.bounds or (np.inf, np.inf, -np.inf, -np.inf))
        # the row -1 of an absent object indexes the appended empty box
        running_lows = np.append(box_lows, [[np.inf, np.inf]], axis=0)[trace.rows].min(axis=1, initial=np.inf)
        running_highs = np.append(box_highs, [[-np.inf, -np.inf]], axis=0)[trace.rows].max(
            axis=1, initial=-np.inf
        )
        running_lows = np.minimum(np.minimum.accumulate(running_lows), earlier_corners[:2])
        running_highs = np.maximum(np.maximum.accumulate(running_highs), earlier_corners[2:])
        if not len(trace) or not np.isfinite(running_lows[-1]).all():
            corners = np.repeat(np.reshape(earlier_corners, (1, 2, 2)), len(trace), axis=0)
            return self, corners, np.full(len(trace), self.size)
        bounds = SceneBounds(*running_lows[-1].tolist(), *running_highs[-1].tolist())
        corners = _with_regions(np.concatenate([running_lows, running_highs], axis=1), regions).reshape(
            -1, 2, 2
        )
        is_empty = ~np.isfinite(running_lows).all(axis=1)
        sides = np.where(is_empty, 0.0, (corners[:, 1] - corners[:, 0]).max(axis=1))
        sizes = _in_steps(sides, self.size)
        return SceneExtent(bounds, float(sizes[-1])), corners, sizes


def map_area(plan: Mapping[str, str]) -> SceneBounds | None:
    """Return the area of a planner's map, from the plan's metadata; None without a map."""
    try:
        xmin, ymin, cell, columns, rows = map(float, json.loads(plan["settings"])["grid"])
    except (KeyError, TypeError, ValueError):
        return None
    return SceneBounds(xmin, ymin, xmin + columns * cell, ymin + rows * cell)


def _with_regions(corners: Floats, regions: Floats | None) -> Floats:
    """Return boxes (..., 4) enlarged to contain the corners of regions."""
    if regions is None or not len(regions):
        return corners
    lows = np.minimum(corners[..., :2], regions.min(axis=0))
    highs = np.maximum(corners[..., 2:], regions.max(axis=0))
    return np.concatenate([lows, highs], axis=-1)


def _finite_boxes(footprints: FootprintBatch) -> tuple[Floats, Floats]:
    """Return the low and high corners of the boxes of footprints, (R, 2) each; infinite for NaN corners."""
    vertex_starts = footprints.vertex_start[footprints.part_start]
    radii = np.repeat(footprints.radius, np.diff(footprints.vertex_start))[:, None]
    lows = boxes(footprints.vertices - radii, vertex_starts)[0]
    highs = boxes(footprints.vertices + radii, vertex_starts)[1]
    is_finite = np.isfinite(lows).all(axis=1, keepdims=True) & np.isfinite(highs).all(axis=1, keepdims=True)
    return np.where(is_finite, lows, np.inf), np.where(is_finite, highs, -np.inf)


def _in_steps(sides: Floats, size: float) -> Floats:
    """Round nondecreasing lengths (T,) up to steps: the first positive length times powers of `_STEP`.

    Args:
        size: size after the earlier samples; 0 without a size so far.
    """
    sizes, position = np.empty(len(sides)), 0
    while position < len(sides):
        end = max(int(np.searchsorted(sides, size, side="right")), position)
        sizes[position:end] = size
        if end < len(sides):
            # repeated products, unlike a power, give the same bits for every cut into blocks
            size = size or float(sides[end])
            while size < sides[end]:
                size *= _STEP
        position = end
    return sizes
