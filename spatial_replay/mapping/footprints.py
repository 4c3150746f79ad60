"""Bodies in space to footprints: projected along z, with the interval of heights that they take up.

The bodies that messages made for drawing and for perception consist of.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers, flat_index, starts_from_counts
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.outline import convex_hull
from spatial_replay.mapping.field_paths import Style
from spatial_replay.mapping.transforms import is_upright

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
    solids = _with_boxes(solids)
    kind, size = solids.kind, solids.size
    boxes, polygons, hulls = (np.flatnonzero(kind == each) for each in (BOX, POLYGON, HULL))
    tilted = boxes[~is_upright(solids.rotation[boxes]) & ~np.isnan(size[boxes, 2])]
    flat = np.setdiff1d(boxes, tilted, assume_unique=True) if len(tilted) else boxes
    rings = [_ring(solids, piece) for piece in hulls.tolist()]
    vertex_counts = _VERTICES[kind]
    vertex_counts[tilted] = 6
    vertex_counts[polygons] = np.diff(solids.point_start)[polygons]
    vertex_counts[hulls] = [len(ring) for ring in rings]
    start = starts_from_counts(vertex_counts)
    vertices = np.empty((int(start[-1]), 2))
    if len(boxes) + len(polygons) + len(hulls) < len(kind):
        rounds = np.flatnonzero(_IS_ROUND[kind])
        vertices[start[rounds]] = solids.position[rounds, :2]
    for pieces, corners in ((flat, _rectangles), (tilted, _hexagons)):
        if len(pieces):
            _fill(vertices, start, pieces, corners(solids, size, pieces))
    if len(polygons):
        _fill_polygons(vertices, start, solids, polygons)
    for piece, ring in zip(hulls.tolist(), rings, strict=True):
        vertices[start[piece] : start[piece] + len(ring)] = ring
    bottom, top = _heights(solids, size, count)
    return FootprintBatch(
        part_start=starts_from_counts(np.bincount(solids.owner, minlength=count).astype(np.int64)),
        vertex_start=start,
        vertices=vertices,
        radius=np.where(_IS_ROUND[kind], size[:, 0] / 2, 0.0),
        bottom=bottom,
        top=top,
    )


_VERTICES = np.array([4, 1, 1, 1, 0, 0], np.int64)
_IS_ROUND = np.array([False, True, True, True, False, False])


def _with_boxes(solids: Solids) -> Solids:
    """The solids, with boxes for the cylinders and spheres that count as the box around them."""
    kind, size = solids.kind, solids.size
    doubtful = np.flatnonzero((kind == CYLINDER) | (kind == SPHERE))
    if not len(doubtful):
        return solids
    kind, size = kind[doubtful], size[doubtful]
    unequal = size[:, 0] != size[:, 1]
    cylinder = (kind == CYLINDER) & (unequal | ~is_upright(solids.rotation[doubtful]))
    sphere = (kind == SPHERE) & (unequal | (size[:, 0] != size[:, 2]))
    kinds = solids.kind.copy()
    kinds[doubtful[cylinder | sphere]] = BOX
    return replace(solids, kind=kinds)


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
    rotation, position = solids.rotation[pieces, :2, :], solids.position[pieces, :2]
    if (rotation != np.eye(3)[:2]).any() or position.any():
        points = np.einsum("nij,nj->ni", np.repeat(rotation, counts, axis=0), points)
        points[:, :2] += np.repeat(position, counts, axis=0)
    vertices[flat_index(start[pieces], counts)] = points[:, :2]


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
    has_height = (
        (solids.kind != DISC) & (solids.kind != POLYGON) & ~((solids.kind == BOX) & np.isnan(size[:, 2]))
    )
    if not has_height.any():
        return np.full(count, np.nan), np.full(count, np.nan)
    up = solids.rotation[:, 2, :]
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
    # NaN wins over every number
    np.minimum.at(bottom, solids.owner, lowest)
    np.maximum.at(top, solids.owner, highest)
    return bottom, top


Numbers: TypeAlias = tuple[float, ...]
Read: TypeAlias = Callable[[Any, str], Any]

MARKER_ADD, MARKER_DELETE, MARKER_DELETE_ALL = 0, 2, 3
DELETE_ALL_ENTITIES = 1

_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


class Solid(NamedTuple):
    """One body in the frame of its message; see `Solids` for what its numbers mean."""

    kind: int
    position: Numbers
    quaternion: Numbers
    size: Numbers
    points: Sequence[Numbers] = ()


def reader_of(style: Style) -> Read:
    """How a field is read that may be missing from a JSON object."""
    return getattr if style == "attributes" else lambda value, name: value.get(name)


def solids_of_marker(marker: Any, read: Read) -> list[Solid]:
    """The bodies of a visualization_msgs/Marker; none of markers that are no bodies: arrows, lines, texts."""
    kind = read(marker, "type")
    pose, scale = read(marker, "pose"), _vector(read(marker, "scale"), read)
    position, quaternion = _pose(pose, read)
    single = {1: BOX, 2: SPHERE, 3: CYLINDER}.get(kind)
    if single is not None:
        return [Solid(single, position, quaternion, scale)]
    points = [_vector(point, read) for point in read(marker, "points") or ()]
    if kind in (6, 7):
        # each at a point in the marker's own frame: a hull of one point stands for the shift
        listed = BOX if kind == 6 else SPHERE
        return [Solid(listed, position, quaternion, scale, (point,)) for point in points]
    if kind == 11 and len(points) >= 3:
        scaled = [tuple(a * b for a, b in zip(point, scale, strict=True)) for point in points]
        return [
            Solid(HULL, position, quaternion, (nan,) * 3, scaled[i : i + 3])
            for i in range(0, len(points) - 2, 3)
        ]
    return []


def solids_of_entity(entity: Any, read: Read) -> list[Solid]:
    """The bodies of a foxglove.SceneEntity; its lines, arrows, texts and models are none."""
    bodies: list[Solid] = []
    for name, kind in (("cubes", BOX), ("spheres", SPHERE), ("cylinders", CYLINDER)):
        for primitive in read(entity, name) or ():
            size = _vector(read(primitive, "size"), read)
            if kind == CYLINDER:
                scale = max(_or_one(read(primitive, "bottom_scale")), _or_one(read(primitive, "top_scale")))
                size = (size[0] * scale, size[1] * scale, size[2])
            bodies.append(Solid(kind, *_pose(read(primitive, "pose"), read), size))
    for primitive in read(entity, "triangles") or ():
        points = [_vector(point, read) for point in read(primitive, "points") or ()]
        order = list(read(primitive, "indices") or range(len(points)))
        corners = [points[i] for i in order if i < len(points)]
        pose = _pose(read(primitive, "pose"), read)
        bodies += [Solid(HULL, *pose, (nan,) * 3, corners[i : i + 3]) for i in range(0, len(corners) - 2, 3)]
    return bodies


def solids_of_perceived_object(thing: Any, read: Read) -> list[Solid]:
    """The body of a derived_object_msgs/Object: its solid, else its polygon, else the point where it is."""
    pose = _pose(read(thing, "pose"), read)
    solid = read(thing, "shape")
    kind = read(solid, "type")
    sizes = [float(size) for size in read(solid, "dimensions")]
    if kind == 1 and len(sizes) >= 3:
        return [Solid(BOX, *pose, tuple(sizes[:3]))]
    if kind == 2 and sizes:
        return [Solid(SPHERE, *pose, (2 * sizes[0],) * 3)]
    if kind in (3, 4) and len(sizes) >= 2:
        return [Solid(CYLINDER, *pose, (2 * sizes[1], 2 * sizes[1], sizes[0]))]
    corners = [_vector(point, read) for point in read(read(thing, "polygon"), "points") or ()]
    if len(corners) >= 3:
        return [Solid(POLYGON, (0.0, 0.0, pose[0][2]), _NO_ROTATION, (nan,) * 3, corners)]
    return [Solid(SPHERE, *pose, (0.0,) * 3)]


def _pose(pose: Any, read: Read) -> tuple[Numbers, Numbers]:
    if pose is None:
        return (0.0,) * 3, _NO_ROTATION
    quaternion = read(pose, "orientation")
    turned = _NO_ROTATION if quaternion is None else _coordinates(quaternion, "xyzw", read)
    return _vector(read(pose, "position"), read), turned


def _vector(vector: Any, read: Read) -> Numbers:
    return (0.0,) * 3 if vector is None else _coordinates(vector, "xyz", read)


def _coordinates(value: Any, names: Iterable[str], read: Read) -> Numbers:
    return tuple([float(read(value, name) or 0.0) for name in names])


def _or_one(value: Any) -> float:
    return 1.0 if value is None else float(value)
