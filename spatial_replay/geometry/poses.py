"""Where footprints are: their centres, and how they are moved and turned, one or many at once."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Floats, starts_from_counts
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject

_FLAT: Final = 1e-12
"""Twice the area over the squared perimeter; a polygon with less has no centroid of its area."""


def centre_of(footprint: Footprint) -> tuple[float, float]:
    """Return the centre (x, y) of an object: the centroid of its parts' areas.

    A part is weighted by its area, and has the centroid of its polygon before rounding, or the mean of the
    vertices if that polygon has no area. Areas of overlap count twice.
    """
    weights, centres = zip(*map(_weight_and_centre, footprint.parts), strict=True)
    if sum(weights) <= 0.0:
        weights = (1.0,) * len(centres)
    total = sum(weights)
    x, y = (sum(w * each[axis] for w, each in zip(weights, centres, strict=True)) / total for axis in (0, 1))
    return x, y


def radius_of(tracked: TrackedObject) -> float:
    """Return the distance from an object's centre to its farthest point."""
    centre = np.array(centre_of(tracked.footprint))
    return max(float(np.hypot(*(p.vertices - centre).T).max()) + p.radius for p in tracked.footprint.parts)


def moved_object(tracked: TrackedObject, x: float, y: float, turn: float = 0.0) -> TrackedObject:
    """Return the object with its centre at (x, y), turned by an angle in radians; heights stay."""
    footprint = tracked.footprint
    centre = np.array(centre_of(footprint))
    place = np.array([[x, y]])
    parts = []
    for part in footprint.parts:
        corners = part.vertices
        placed = np.empty((1, *corners.shape))
        fill_placed(corners, centre, place, turn, placed)
        parts.append(ConvexPart(placed[0], part.radius))
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return replace(tracked, footprint=Footprint(tuple(parts)), yaw=yaw)


def with_poses(
    batch: FootprintBatch, tracked: TrackedObject, positions: Floats, turns: Floats
) -> FootprintBatch:
    """Return a batch, and A * M more rows: the object turned by each angle (A,), at each position (M, 2)."""
    parts = tracked.footprint.parts
    centre = np.array(centre_of(tracked.footprint))
    count = len(positions) * len(turns)
    outlines = [part.vertices for part in parts]
    corners = np.concatenate(outlines)
    sizes = np.array([len(outline) for outline in outlines], np.int64)
    bottom, top = tracked.height or (math.nan, math.nan)
    part_start = batch.part_start[-1] + np.arange(count + 1, dtype=np.int64) * len(sizes)
    vertex_start = batch.vertex_start[-1] + starts_from_counts(np.tile(sizes, count))
    # of many cells, they are written where they stay
    vertices = np.empty((len(batch.vertices) + count * len(corners), 2))
    vertices[: len(batch.vertices)] = batch.vertices
    placed = vertices[len(batch.vertices) :].reshape(len(turns), len(positions), len(corners), 2)
    for number, turn in enumerate(turns.tolist()):
        fill_placed(corners, centre, positions, turn, placed[number])
    return FootprintBatch.trusted(
        part_start=np.concatenate((batch.part_start[:-1], part_start)),
        vertex_start=np.concatenate((batch.vertex_start[:-1], vertex_start)),
        vertices=vertices,
        radius=np.concatenate((batch.radius, np.tile([part.radius for part in parts], count))),
        bottom=np.concatenate((batch.bottom, np.full(count, bottom))),
        top=np.concatenate((batch.top, np.full(count, top))),
    )


def fill_placed(vertices: Floats, centre: Floats, positions: Floats, turn: float, placed: Floats) -> None:
    """Fill `placed` (M, n, 2): vertices (n, 2) turned around the centre, moved to each position (M, 2)."""
    local = vertices - centre
    if turn != 0.0:
        cosine, sine = math.cos(turn), math.sin(turn)
        x, y = local[:, 0], local[:, 1]
        local = np.stack((x * cosine - y * sine, x * sine + y * cosine), axis=1)
    # both coordinates in one go, as complex numbers, and along the many positions, not along the few vertices
    at = np.ascontiguousarray(positions, np.float64).view(np.complex128)[..., 0]
    filled = placed.view(np.complex128)[..., 0]
    for number, (x, y) in enumerate(local.tolist()):
        np.add(at, complex(x, y), out=filled[:, number])


def _weight_and_centre(part: ConvexPart) -> tuple[float, tuple[float, float]]:
    """Return a part's area, and the centroid of its polygon before rounding."""
    # plain numbers are quicker than arrays for the few vertices of a part
    corners = part.vertices.tolist()
    (x0, y0), *_ = corners
    doubled = sum_x = sum_y = length = 0.0
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        cross = (ax - x0) * (by - y0) - (bx - x0) * (ay - y0)
        doubled += cross
        sum_x += cross * (ax + bx - 2.0 * x0)
        sum_y += cross * (ay + by - 2.0 * y0)
        length += math.hypot(bx - ax, by - ay)
    # a rounded polygon is the polygon, a strip along its sides, and sectors at its corners that make a disc
    area = doubled / 2 + length * part.radius + math.pi * part.radius**2
    if len(corners) > 2 and doubled > _FLAT * length**2:
        return area, (x0 + sum_x / (3.0 * doubled), y0 + sum_y / (3.0 * doubled))
    count = len(corners)
    return area, (sum(x for x, _ in corners) / count, sum(y for _, y in corners) / count)
