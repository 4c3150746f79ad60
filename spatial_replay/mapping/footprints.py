"""Footprints of solids: solids in space in, their projections along z and intervals of heights out.

The first half works on arrays; the second reads the solids in messages for visualization and perception.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import (
    Floats,
    Integers,
    counts_from_starts,
    flat_index,
    starts_from_counts,
)
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.outline import convex_hull
from spatial_replay.mapping.field_paths import Style
from spatial_replay.mapping.transforms import is_upright

BOX, DISC, CYLINDER, SPHERE, POLYGON, HULL = range(6)
"""Kinds of solids, with the meaning of their three sizes: box: length, width, height (NaN if flat); disc:
diameter; cylinder: diameters along x and y, height; sphere: diameters along x, y and z. A polygon has corners
in order, a hull points in any order. Cylinders that are tilted or not round, and spheres that are not round,
count as their bounding boxes."""


@dataclass(frozen=True, slots=True)
class Solids:
    """P solids that make up R objects.

    Attributes:
        owner: (P,) int64, increasing: the object that a solid belongs to.
        kind: (P,) int8.
        position: (P, 3), rotation: (P, 3, 3): frame_from_solid.
        size: (P, 3).
        point_start: (P + 1,) int64 into `points` (V, 3), which are in the solid's frame.
    """

    owner: Integers
    kind: NDArray[np.int8]
    position: Floats
    rotation: Floats
    size: Floats
    point_start: Integers
    points: Floats

    def repeated(self, owner: int, count: int) -> Solids:
        """Return the solids of one object, `count` times."""
        own = np.flatnonzero(self.owner == owner)
        pieces = np.tile(own, count)
        sizes = counts_from_starts(self.point_start)[pieces]
        return Solids(
            owner=np.repeat(np.arange(count, dtype=np.int64), len(own)),
            kind=self.kind[pieces],
            position=self.position[pieces],
            rotation=self.rotation[pieces],
            size=self.size[pieces],
            point_start=starts_from_counts(sizes),
            points=self.points[flat_index(self.point_start[pieces], sizes)],
        )


def footprints_from_solids(solids: Solids, count: int) -> FootprintBatch:
    """Return the footprints (R,) of objects; an object has no height if one of its solids has none.

    Args:
        count: R.
    """
    if not _MAYBE_BOXES.isdisjoint(solids.kind.tolist()):
        solids = _with_boxes(solids)
    kind, size = solids.kind, solids.size
    # few solids are of few kinds, and what is not there need not be looked for
    present = set(kind.tolist())
    boxes, polygons, hulls = (
        np.flatnonzero(kind == each) if each in present else _NO_SOLIDS for each in (BOX, POLYGON, HULL)
    )
    tilted = boxes[~np.isnan(size[boxes, 2])] if len(boxes) else _NO_SOLIDS
    if len(tilted):
        tilted = tilted[~is_upright(solids.rotation[tilted])]
    flat = np.setdiff1d(boxes, tilted, assume_unique=True) if len(tilted) else boxes
    rings = [_ring(solids, piece) for piece in hulls.tolist()]
    vertex_counts = _VERTICES[kind]
    if len(tilted):
        vertex_counts[tilted] = 6
    if len(polygons):
        vertex_counts[polygons] = counts_from_starts(solids.point_start)[polygons]
    if len(hulls):
        vertex_counts[hulls] = [len(ring) for ring in rings]
    start = starts_from_counts(vertex_counts)
    vertices = np.empty((int(start[-1]), 2))
    radius = np.zeros(len(kind))
    if len(boxes) + len(polygons) + len(hulls) < len(kind):
        rounds = np.flatnonzero(_IS_ROUND[kind])
        vertices[start[rounds]] = solids.position[rounds, :2]
        radius[rounds] = size[rounds, 0] / 2
    for pieces, corners in ((flat, _rectangles), (tilted, _hexagons)):
        if len(pieces):
            _fill(vertices, start, pieces, corners(solids, size, pieces))
    if len(polygons):
        _fill_polygons(vertices, start, solids, polygons)
    for piece, ring in zip(hulls.tolist(), rings, strict=True):
        vertices[start[piece] : start[piece] + len(ring)] = ring
    bottom, top = _heights(solids, size, count)
    is_single = len(kind) == count and (solids.owner == np.arange(count)).all()
    parts = np.ones(count, np.int64) if is_single else np.bincount(solids.owner, minlength=count)
    return FootprintBatch.trusted(
        part_start=starts_from_counts(parts),
        vertex_start=start,
        vertices=vertices,
        radius=radius,
        bottom=bottom,
        top=top,
    )


_VERTICES = np.array([4, 1, 1, 1, 0, 0], np.int64)
_MAYBE_BOXES = frozenset({CYLINDER, SPHERE})
_NO_SOLIDS = np.empty(0, np.int64)
_IS_ROUND = np.array([False, True, True, True, False, False])


def _with_boxes(solids: Solids) -> Solids:
    """Replace the cylinders and spheres that count as their bounding boxes."""
    kind, size = solids.kind, solids.size
    doubtful = np.flatnonzero((kind == CYLINDER) | (kind == SPHERE))
    kind, size = kind[doubtful], size[doubtful]
    unequal = size[:, 0] != size[:, 1]
    cylinder = (kind == CYLINDER) & (unequal | ~is_upright(solids.rotation[doubtful]))
    sphere = (kind == SPHERE) & (unequal | (size[:, 0] != size[:, 2]))
    kinds = solids.kind.copy()
    kinds[doubtful[cylinder | sphere]] = BOX
    return replace(solids, kind=kinds)


def _fill(vertices: Floats, start: Integers, pieces: Integers, corners: Floats) -> None:
    """Write the corners (K, C, 2) of some solids to their places in `vertices`."""
    if len(vertices) == corners.shape[0] * corners.shape[1]:
        vertices[:] = corners.reshape(-1, 2)
        return
    counts = np.full(len(pieces), corners.shape[1])
    vertices[flat_index(start[pieces], counts)] = corners.reshape(-1, 2)


def _rectangles(solids: Solids, size: Floats, pieces: Integers) -> Floats:
    """Return the corners (K, 4, 2), seen from above, of boxes that are flat or upright."""
    along = solids.rotation[pieces, :2, 0] * (size[pieces, 0, None] / 2)
    across = solids.rotation[pieces, :2, 1] * (size[pieces, 1, None] / 2)
    centre = solids.position[pieces, :2]
    front, back = centre + along, centre - along
    return np.stack((back - across, front - across, front + across, back + across), axis=1)


def _hexagons(solids: Solids, size: Floats, pieces: Integers) -> Floats:
    """Return the outlines (K, 6, 2) of tilted boxes, seen from above.

    The projection of a box is the Minkowski sum of its three projected axes. With the axes turned into the
    upper half plane and ordered by angle, the outline runs from the lowest corner along each of them, and
    back.
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
    counts = counts_from_starts(solids.point_start)[pieces]
    points = solids.points[flat_index(solids.point_start[:-1][pieces], counts)]
    rotation, position = solids.rotation[pieces, :2, :], solids.position[pieces, :2]
    if (rotation != np.eye(3)[:2]).any() or position.any():
        points = np.einsum("nij,nj->ni", np.repeat(rotation, counts, axis=0), points)
        points[:, :2] += np.repeat(position, counts, axis=0)
    vertices[flat_index(start[pieces], counts)] = points[:, :2]


def _ring(solids: Solids, piece: int) -> Floats:
    """Return the convex hull, seen from above, of a solid's points; one NaN if some are not finite."""
    points = solids.points[solids.point_start[piece] : solids.point_start[piece + 1]]
    placed = points @ solids.rotation[piece].T + solids.position[piece]
    if not np.isfinite(placed).all():
        return np.full((1, 2), np.nan)
    hull = convex_hull(placed[:, :2])
    return hull[:-1] if len(hull) > 1 and (hull[0] == hull[-1]).all() else hull


def _heights(solids: Solids, size: Floats, count: int) -> tuple[Floats, Floats]:
    """Return the bottom and the top (R,) of objects; NaN if one of their solids is flat."""
    is_flat_box = (solids.kind == BOX) & np.isnan(size[:, 2])
    has_height = (solids.kind != DISC) & (solids.kind != POLYGON) & ~is_flat_box
    if not has_height.any():
        return np.full(count, np.nan), np.full(count, np.nan)
    up = solids.rotation[:, 2, :]
    # half the extent along z of a box in any orientation
    half = np.einsum("ij,ij->i", np.abs(up), np.nan_to_num(size)) / 2
    half = np.where(solids.kind == SPHERE, size[:, 0] / 2, half)
    half = np.where(has_height, half, np.nan)
    lowest, highest = solids.position[:, 2] - half, solids.position[:, 2] + half
    for piece in np.flatnonzero(solids.kind == HULL).tolist():
        points = solids.points[solids.point_start[piece] : solids.point_start[piece + 1]]
        heights = points @ solids.rotation[piece, 2] + solids.position[piece, 2]
        lowest[piece], highest[piece] = heights.min(initial=np.inf), heights.max(initial=-np.inf)
    if len(lowest) == count:
        return lowest, highest
    bottom, top = np.full(count, np.inf), np.full(count, -np.inf)
    # NaN prevails: one solid without a height leaves the object without
    np.minimum.at(bottom, solids.owner, lowest)
    np.maximum.at(top, solids.owner, highest)
    return bottom, top


Numbers: TypeAlias = tuple[float, ...]
GetField: TypeAlias = Callable[[Any, str], Any]

MARKER_ADD, MARKER_DELETE, MARKER_DELETE_ALL = 0, 2, 3
DELETE_ALL_ENTITIES = 1

_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


class Solid(NamedTuple):
    """One solid in the frame of its message; its numbers mean the same as in `Solids`."""

    kind: int
    position: Numbers
    quaternion: Numbers
    size: Numbers
    points: Sequence[Numbers] = ()


def lenient_getter(style: Style) -> GetField:
    """Return a function to read a field; in JSON objects, where fields may be missing, it returns None."""
    return getattr if style == "attributes" else lambda value, name: value.get(name)


def solids_of_marker(marker: Any, get: GetField) -> list[Solid]:
    """Return the solids of a visualization_msgs/Marker; none for arrows, lines and texts."""
    kind, scale = get(marker, "type"), _vector(get(marker, "scale"), get)
    position, quaternion = _pose(get(marker, "pose"), get)
    single = {1: BOX, 2: SPHERE, 3: CYLINDER}.get(kind)
    if single is not None:
        return [Solid(single, position, quaternion, scale)]
    points = [_vector(point, get) for point in get(marker, "points") or ()]
    if kind in (6, 7):
        # elements of a list marker; the point, in the marker's frame, is added when solids are put in columns
        listed = BOX if kind == 6 else SPHERE
        return [Solid(listed, position, quaternion, scale, (point,)) for point in points]
    if kind == 11 and len(points) >= 3:
        scaled = [tuple(a * b for a, b in zip(point, scale, strict=True)) for point in points]
        return _triangles((position, quaternion), scaled)
    return []


def solids_of_entity(entity: Any, get: GetField) -> list[Solid]:
    """Return the solids of a foxglove.SceneEntity; its lines, arrows, texts and models are left out."""
    solids: list[Solid] = []
    for name, kind in (("cubes", BOX), ("spheres", SPHERE), ("cylinders", CYLINDER)):
        for primitive in get(entity, name) or ():
            size = _vector(get(primitive, "size"), get)
            if kind == CYLINDER:
                scale = max(_or_one(get(primitive, "bottom_scale")), _or_one(get(primitive, "top_scale")))
                size = (size[0] * scale, size[1] * scale, size[2])
            solids.append(Solid(kind, *_pose(get(primitive, "pose"), get), size))
    for primitive in get(entity, "triangles") or ():
        points = [_vector(point, get) for point in get(primitive, "points") or ()]
        order = list(get(primitive, "indices") or range(len(points)))
        corners = [points[i] for i in order if i < len(points)]
        solids += _triangles(_pose(get(primitive, "pose"), get), corners)
    return solids


def _triangles(pose: tuple[Numbers, Numbers], corners: Sequence[Numbers]) -> list[Solid]:
    return [Solid(HULL, *pose, (nan,) * 3, corners[i : i + 3]) for i in range(0, len(corners) - 2, 3)]


def solids_of_perceived_object(thing: Any, get: GetField) -> list[Solid]:
    """Return the solid of a derived_object_msgs/Object: its shape, else its polygon, else its position."""
    pose = _pose(get(thing, "pose"), get)
    shape = get(thing, "shape")
    kind = get(shape, "type")
    sizes = [float(size) for size in get(shape, "dimensions")]
    if kind == 1 and len(sizes) >= 3:
        return [Solid(BOX, *pose, tuple(sizes[:3]))]
    if kind == 2 and sizes:
        return [Solid(SPHERE, *pose, (2 * sizes[0],) * 3)]
    if kind in (3, 4) and len(sizes) >= 2:
        return [Solid(CYLINDER, *pose, (2 * sizes[1], 2 * sizes[1], sizes[0]))]
    corners = [_vector(point, get) for point in get(get(thing, "polygon"), "points") or ()]
    if len(corners) >= 3:
        return [Solid(POLYGON, (0.0, 0.0, pose[0][2]), _NO_ROTATION, (nan,) * 3, corners)]
    return [Solid(SPHERE, *pose, (0.0,) * 3)]


def _pose(pose: Any, get: GetField) -> tuple[Numbers, Numbers]:
    if pose is None:
        return (0.0,) * 3, _NO_ROTATION
    quaternion = get(pose, "orientation")
    turned = _NO_ROTATION if quaternion is None else _coordinates(quaternion, "xyzw", get)
    return _vector(get(pose, "position"), get), turned


def _vector(vector: Any, get: GetField) -> Numbers:
    return (0.0,) * 3 if vector is None else _coordinates(vector, "xyz", get)


def _coordinates(value: Any, names: Iterable[str], get: GetField) -> Numbers:
    return tuple([float(get(value, name) or 0.0) for name in names])


def _or_one(value: Any) -> float:
    return 1.0 if value is None else float(value)
