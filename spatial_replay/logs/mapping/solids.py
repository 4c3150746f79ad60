"""Bodies in space to footprints: projected along z, with the interval of heights that they take up."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.decompose import convex_hull
from spatial_replay.logs.mapping.rotation import is_upright
from spatial_replay.trace.ragged import flat_index, starts_from_counts

BOX, DISC, CYLINDER, SPHERE, POLYGON, HULL = range(6)
"""Kinds of bodies. What their three sizes mean: of a box, length, width, height (NaN: flat); of a disc, its
diameter; of a cylinder, diameters along x and y, height; of a sphere, diameters along x, y and z. A polygon
has corners in order, a hull points in any order. Cylinders that are tilted or not round, and spheres that
are not round, count as the box around them."""


@dataclass(frozen=True, slots=True)
class Solids:
    """P bodies that make up R objects.

    Attributes:
        owner: (P,) int64, increasing: the object that a body belongs to.
        kind: (P,) int8.
        position: (P, 3), rotation: (P, 3, 3): frame_from_body.
        size: (P, 3).
        point_start: (P + 1,) int64 into `points` (V, 3), which are in the body's frame.
    """

    owner: Integers
    kind: NDArray[np.int8]
    position: Floats
    rotation: Floats
    size: Floats
    point_start: Integers
    points: Floats


def footprints_from_solids(solids: Solids, count: int) -> FootprintBatch:
    """The footprints (R,) of objects; one height is missing where any body of an object has none.

    Args:
        count: R.
    """
    solids = replace(solids, kind=_boxed(solids.kind, solids.size, solids.rotation))
    kind, size = solids.kind, solids.size
    upright = is_upright(solids.rotation)
    vertex_counts = np.ones(len(kind), np.int64)
    radius = np.where(kind == BOX, 0.0, size[:, 0] / 2)
    is_box = kind == BOX
    flat = np.isnan(size[:, 2])
    simple, tilted = is_box & (upright | flat), is_box & ~upright & ~flat
    vertex_counts[simple] = 4
    vertex_counts[tilted] = 6
    shaped = np.flatnonzero((kind == POLYGON) | (kind == HULL))
    rings = {int(piece): _ring(solids, int(piece)) for piece in shaped if kind[piece] == HULL}
    vertex_counts[shaped] = np.diff(solids.point_start)[shaped]
    for piece, ring in rings.items():
        vertex_counts[piece] = len(ring)
    radius[shaped] = 0.0
    start = starts_from_counts(vertex_counts)
    vertices = np.empty((int(start[-1]), 2))
    rounds = np.flatnonzero((kind != BOX) & (kind != POLYGON) & (kind != HULL))
    vertices[start[rounds]] = solids.position[rounds, :2]
    _fill(vertices, start, np.flatnonzero(simple), _rectangles(solids, size, np.flatnonzero(simple)))
    _fill(vertices, start, np.flatnonzero(tilted), _hexagons(solids, size, np.flatnonzero(tilted)))
    _fill_polygons(vertices, start, solids, np.flatnonzero(kind == POLYGON))
    for piece, ring in rings.items():
        vertices[start[piece] : start[piece] + len(ring)] = ring
    bottom, top = _heights(solids, size, count)
    return FootprintBatch(
        part_start=starts_from_counts(np.bincount(solids.owner, minlength=count).astype(np.int64)),
        vertex_start=start,
        vertices=vertices,
        radius=radius,
        bottom=bottom,
        top=top,
    )


def _boxed(kind: NDArray[np.int8], size: Floats, rotation: Floats) -> NDArray[np.int8]:
    """The kinds, with BOX for the cylinders and spheres that count as the box around them."""
    unequal = size[:, 0] != size[:, 1]
    cylinder = (kind == CYLINDER) & (unequal | ~is_upright(rotation))
    sphere = (kind == SPHERE) & (unequal | (size[:, 0] != size[:, 2]))
    return np.where(cylinder | sphere, np.int8(BOX), kind)


def _fill(vertices: Floats, start: Integers, pieces: Integers, corners: Floats) -> None:
    """Put corners (K, C, 2) of some pieces where they belong."""
    counts = np.full(len(pieces), corners.shape[1])
    vertices[flat_index(start[pieces], counts)] = corners.reshape(-1, 2)


def _rectangles(solids: Solids, size: Floats, pieces: Integers) -> Floats:
    """(K, 4, 2) corners of boxes seen from above that are flat or stand upright."""
    along = solids.rotation[pieces, :2, 0] * (size[pieces, 0, None] / 2)
    across = solids.rotation[pieces, :2, 1] * (size[pieces, 1, None] / 2)
    centre = solids.position[pieces, :2]
    corners = (
        centre - along - across,
        centre + along - across,
        centre + along + across,
        centre - along + across,
    )
    return np.stack(corners, axis=1)


def _hexagons(solids: Solids, size: Floats, pieces: Integers) -> Floats:
    """(K, 6, 2) outlines of tilted boxes: the sum of their three half axes, each taken both ways.

    With the axes turned into the upper half plane and ordered by angle, the outline runs from the lowest
    corner along each of them in turn, and back.
    """
    axes = np.swapaxes(solids.rotation[pieces, :2, :] * (size[pieces, None, :] / 2), 1, 2)
    down = (axes[..., 1] < 0) | ((axes[..., 1] == 0) & (axes[..., 0] < 0))
    axes = np.where(down[..., None], -axes, axes)
    order = np.argsort(np.arctan2(axes[..., 1], axes[..., 0]), axis=1, kind="stable")
    axes = np.take_along_axis(axes, order[..., None], axis=1)
    first = solids.position[pieces, :2] - axes.sum(axis=1)
    corners = [first]
    for axis in (0, 1, 2, 0, 1):
        sign = 2.0 if len(corners) <= 3 else -2.0
        corners.append(corners[-1] + sign * axes[:, axis])
    return np.stack(corners, axis=1)


def _fill_polygons(vertices: Floats, start: Integers, solids: Solids, pieces: Integers) -> None:
    counts = np.diff(solids.point_start)[pieces]
    points = solids.points[flat_index(solids.point_start[:-1][pieces], counts)]
    rotation = np.repeat(solids.rotation[pieces, :2, :], counts, axis=0)
    placed = np.einsum("nij,nj->ni", rotation, points) + np.repeat(
        solids.position[pieces, :2], counts, axis=0
    )
    vertices[flat_index(start[pieces], counts)] = placed


def _ring(solids: Solids, piece: int) -> Floats:
    """The convex hull, seen from above, of a body's points; the points as they are if some are not finite."""
    points = solids.points[solids.point_start[piece] : solids.point_start[piece + 1]]
    placed = points @ solids.rotation[piece].T + solids.position[piece]
    if not np.isfinite(placed).all():
        return np.full((1, 2), np.nan)
    hull = convex_hull(placed[:, :2])
    return hull[:-1] if len(hull) > 1 and (hull[0] == hull[-1]).all() else hull


def _heights(solids: Solids, size: Floats, count: int) -> tuple[Floats, Floats]:
    """(R,) bottom and top, NaN where some body of an object is flat."""
    up = solids.rotation[:, 2, :]
    half = np.einsum("ij,ij->i", np.abs(up), np.nan_to_num(size)) / 2
    half = np.where(solids.kind == SPHERE, size[:, 0] / 2, half)
    half = np.where(np.isnan(size[:, 2]) & (solids.kind != SPHERE), np.nan, half)
    half = np.where((solids.kind == DISC) | (solids.kind == POLYGON), np.nan, half)
    lowest, highest = solids.position[:, 2] - half, solids.position[:, 2] + half
    for piece in np.flatnonzero(solids.kind == HULL).tolist():
        points = solids.points[solids.point_start[piece] : solids.point_start[piece + 1]]
        heights = points @ solids.rotation[piece, 2] + solids.position[piece, 2]
        lowest[piece], highest[piece] = heights.min(initial=np.inf), heights.max(initial=-np.inf)
    if len(lowest) == count:
        return lowest, highest
    bottom, top = np.full(count, np.inf), np.full(count, -np.inf)
    # NaN wins over every number
    np.minimum.at(bottom, solids.owner, lowest)
    np.maximum.at(top, solids.owner, highest)
    return bottom, top
