"""Objects put elsewhere: one at a time, or at every cell of a grid at once."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject

_LESS_THAN_AREA = 1e-12


def centre_of(footprint: Footprint) -> tuple[float, float]:
    """The point that says where an object is: the centroid of its parts' areas.

    Each part counts by its area, with the centroid of its polygon before it is rounded: for one without area,
    the mean of their vertices. Where parts overlap, their area counts twice.
    """
    weights, centres = zip(*map(_weight_and_centre, footprint.parts), strict=True)
    if sum(weights) <= 0.0:
        weights = (1.0,) * len(centres)
    total = sum(weights)
    x = sum(weight * centre[0] for weight, centre in zip(weights, centres, strict=True)) / total
    y = sum(weight * centre[1] for weight, centre in zip(weights, centres, strict=True)) / total
    return x, y


def moved_object(tracked: TrackedObject, x: float, y: float, turn: float = 0.0) -> TrackedObject:
    """The object with its centre at (x, y), turned by an angle in radians; heights stay."""
    footprint = tracked.footprint
    centre = np.array(centre_of(footprint))
    parts = tuple(
        ConvexPart(_placed(part.vertices, centre, np.array([[x, y]]), turn)[0], part.radius)
        for part in footprint.parts
    )
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return replace(tracked, footprint=Footprint(parts), yaw=yaw)


def moved_batch(tracked: TrackedObject, positions: Floats, turns: Floats) -> FootprintBatch:
    """The object turned by each angle (A,) in radians and put at each position (M, 2), as A * M rows."""
    footprint = tracked.footprint
    centre = np.array(centre_of(footprint))
    count = len(positions) * len(turns)
    vertices = np.concatenate([part.vertices for part in footprint.parts])
    sizes = np.array([len(part.vertices) for part in footprint.parts], np.int64)
    bottom, top = tracked.height or (math.nan, math.nan)
    return FootprintBatch(
        part_start=np.arange(count + 1, dtype=np.int64) * len(sizes),
        vertex_start=_starts(np.tile(sizes, count)),
        vertices=np.concatenate(
            [_placed(vertices, centre, positions, turn) for turn in turns.tolist()]
        ).reshape(-1, 2),
        radius=np.tile([part.radius for part in footprint.parts], count),
        bottom=np.full(count, bottom),
        top=np.full(count, top),
    )


def turns_for(tracked: TrackedObject, yaws: tuple[float, ...]) -> Floats:
    """(A,): by how much to turn an object so that it has each orientation; [0] to leave it as it is."""
    if not yaws:
        return np.zeros(1)
    return np.array(yaws) - (tracked.yaw or 0.0)


def _placed(vertices: Floats, centre: Floats, positions: Floats, turn: float) -> Floats:
    """(M, n, 2): vertices (n, 2) turned around the centre, which is then moved to each position (M, 2)."""
    local = vertices - centre
    if turn != 0.0:
        cosine, sine = math.cos(turn), math.sin(turn)
        x, y = local[:, 0], local[:, 1]
        local = np.stack((x * cosine - y * sine, x * sine + y * cosine), axis=1)
    placed: Floats = positions[:, None, :] + local[None, :, :]
    return placed


def _weight_and_centre(part: ConvexPart) -> tuple[float, tuple[float, float]]:
    """A part's area, and the centroid of its polygon before it is rounded."""
    # a few vertices at most: plain numbers are quicker than arrays
    corners = part.vertices.tolist()
    (x0, y0), *_ = corners
    doubled = sum_x = sum_y = length = 0.0
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        cross = (ax - x0) * (by - y0) - (bx - x0) * (ay - y0)
        doubled += cross
        sum_x += cross * (ax + bx - 2.0 * x0)
        sum_y += cross * (ay + by - 2.0 * y0)
        length += math.hypot(bx - ax, by - ay)
    # a rounded polygon: its own area, a strip along its sides and a disc in all of its corners together
    area = doubled / 2 + length * part.radius + math.pi * part.radius**2
    if len(corners) > 2 and doubled > _LESS_THAN_AREA * length**2:
        return area, (x0 + sum_x / (3.0 * doubled), y0 + sum_y / (3.0 * doubled))
    count = len(corners)
    return area, (sum(x for x, _ in corners) / count, sum(y for _, y in corners) / count)


def _starts(counts: Integers) -> Integers:
    return np.concatenate(([0], np.cumsum(counts)))
