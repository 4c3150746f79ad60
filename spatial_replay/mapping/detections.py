"""Detections in columns: chunks of decoded objects in; poses, solids and names as arrays out.

Coordinates are in the frames of messages; `tracker` transforms coordinates into the fixed frame. Footprints
are projections of solids along z, with height intervals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from math import nan
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import (
    Booleans,
    Floats,
    Integers,
    flat_index,
    select,
    starts_from_counts,
)
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.outline import convex_hull
from spatial_replay.mapping.binding import Binding
from spatial_replay.mapping.field_paths import Style
from spatial_replay.mapping.mapping_file import ShapeMapping
from spatial_replay.mapping.message_types import MessageLayout
from spatial_replay.mapping.transforms import (
    Transforms,
    is_upright,
    matrices_from_quaternions,
    matrices_from_yaw,
    no_rotations,
    yaw_of,
)

BOX, DISC, CYLINDER, SPHERE, POLYGON, HULL = range(6)
"""Kinds of solids with their three sizes. Box: length, width, height (NaN if flat). Disc: diameter. Cylinder:
diameters along x and y, height. Sphere: diameters along x, y and z. A polygon has ordered corners. A hull has
points in any order. A box replaces a cylinder that is tilted or not round, and a sphere that is not round."""


@dataclass(frozen=True, slots=True)
class Solids:
    """P solids that make up R objects.

    Attributes:
        owner: (P,) int64, index of each solid's object, never decreasing.
        kind: (P,) int8.
        position: (P, 3), translation of frame_from_solid.
        rotation: (P, 3, 3), rotation of frame_from_solid.
        size: (P, 3), see the kinds of solids.
        point_start: (P + 1,) int64, start of each solid in `points`, then the number of points.
        points: (V, 3), coordinates in the solid's frame.
    """

    owner: Integers
    kind: NDArray[np.int8]
    position: Floats
    rotation: Floats
    size: Floats
    point_start: Integers
    points: Floats

    def repeat(self, owner: int, count: int) -> Solids:
        """Return the solids of one object, `count` times."""
        solid_indices = np.flatnonzero(self.owner == owner)
        copy_indices = np.tile(solid_indices, count)
        point_counts = np.diff(self.point_start)[copy_indices]
        return Solids(
            owner=np.repeat(np.arange(count, dtype=np.int64), len(solid_indices)),
            kind=self.kind[copy_indices],
            position=self.position[copy_indices],
            rotation=self.rotation[copy_indices],
            size=self.size[copy_indices],
            point_start=starts_from_counts(point_counts),
            points=self.points[flat_index(self.point_start[copy_indices], point_counts)],
        )


def footprints_from_solids(solids: Solids, count: int) -> FootprintBatch:
    """Return the footprints (R,) of objects; an object with a flat solid has no height.

    Args:
        count: number of objects, R.
    """
    solids = _with_boxes(solids)
    kind, size = solids.kind, solids.size
    boxes, polygons, hulls, rounds = map(
        np.flatnonzero, (kind == BOX, kind == POLYGON, kind == HULL, _IS_ROUND[kind])
    )
    # the projection of a tilted flat box has four corners, so it needs no hexagon
    is_tilted = ~np.isnan(size[boxes, 2]) & ~is_upright(solids.rotation[boxes])
    flat_boxes, tilted_boxes = boxes[~is_tilted], boxes[is_tilted]
    rings = [_ring(solids, hull) for hull in hulls.tolist()]
    vertex_counts = _VERTICES[kind]
    vertex_counts[tilted_boxes] = 6
    vertex_counts[polygons] = np.diff(solids.point_start)[polygons]
    vertex_counts[hulls] = [len(ring) for ring in rings]
    vertex_start = starts_from_counts(vertex_counts)
    vertices = np.empty((int(vertex_start[-1]), 2))
    radius = np.zeros(len(kind))
    vertices[vertex_start[rounds]] = solids.position[rounds, :2]
    radius[rounds] = size[rounds, 0] / 2
    for box_indices, corners in (
        (flat_boxes, _rectangles(solids, flat_boxes)),
        (tilted_boxes, _hexagons(solids, tilted_boxes)),
    ):
        vertices[flat_index(vertex_start[box_indices], vertex_counts[box_indices])] = corners.reshape(-1, 2)
    _fill_polygons(vertices, vertex_start, solids, polygons)
    for hull, ring in zip(hulls.tolist(), rings, strict=True):
        vertices[vertex_start[hull] : vertex_start[hull] + len(ring)] = ring
    bottom, top = _height_intervals(solids, count)
    return FootprintBatch.without_checks(
        part_start=starts_from_counts(np.bincount(solids.owner, minlength=count)),
        vertex_start=vertex_start,
        vertices=vertices,
        radius=radius,
        bottom=bottom,
        top=top,
    )


_VERTICES = np.array([4, 1, 1, 1, 0, 0], np.int64)
_IS_ROUND = np.array([False, True, True, True, False, False])


def _with_boxes(solids: Solids) -> Solids:
    """Replace tilted cylinders, and cylinders and spheres that are not round, by boxes."""
    kind, size = solids.kind, solids.size
    round_indices = np.flatnonzero((kind == CYLINDER) | (kind == SPHERE))
    kind, size = kind[round_indices], size[round_indices]
    is_unequal = size[:, 0] != size[:, 1]
    is_boxed_cylinder = (kind == CYLINDER) & (is_unequal | ~is_upright(solids.rotation[round_indices]))
    is_boxed_sphere = (kind == SPHERE) & (is_unequal | (size[:, 0] != size[:, 2]))
    boxed_kinds = solids.kind.copy()
    boxed_kinds[round_indices[is_boxed_cylinder | is_boxed_sphere]] = BOX
    return replace(solids, kind=boxed_kinds)


def _rectangles(solids: Solids, box_indices: Integers) -> Floats:
    """Return the corners (K, 4, 2) of flat or upright boxes, seen from above."""
    along = solids.rotation[box_indices, :2, 0] * (solids.size[box_indices, 0, None] / 2)
    across = solids.rotation[box_indices, :2, 1] * (solids.size[box_indices, 1, None] / 2)
    centre = solids.position[box_indices, :2]
    front, back = centre + along, centre - along
    return np.stack((back - across, front - across, front + across, back + across), axis=1)


def _hexagons(solids: Solids, box_indices: Integers) -> Floats:
    """Return the outlines (K, 6, 2) of tilted boxes, seen from above.

    A box's projection is a zonogon: the Minkowski sum of its three projected axes. The axes are flipped into
    the upper half plane and ordered by angle. The outline starts at the lowest corner, runs along each axis
    in this order, and then back along each axis in the same order.
    """
    axes = np.swapaxes(solids.rotation[box_indices, :2, :] * (solids.size[box_indices, None, :] / 2), 1, 2)
    points_down = (axes[..., 1] < 0) | ((axes[..., 1] == 0) & (axes[..., 0] < 0))
    axes = np.where(points_down[..., None], -axes, axes)
    angle_order = np.argsort(np.arctan2(axes[..., 1], axes[..., 0]), axis=1, kind="stable")
    axes = np.take_along_axis(axes, angle_order[..., None], axis=1)
    lowest_corner = solids.position[box_indices, :2] - axes.sum(axis=1)
    corners = [lowest_corner]
    for axis in (0, 1, 2, 0, 1):
        sign = 2.0 if len(corners) <= 3 else -2.0
        corners.append(corners[-1] + sign * axes[:, axis])
    return np.stack(corners, axis=1)


def _fill_polygons(vertices: Floats, vertex_start: Integers, solids: Solids, polygons: Integers) -> None:
    corner_counts = np.diff(solids.point_start)[polygons]
    points = solids.points[flat_index(solids.point_start[:-1][polygons], corner_counts)]
    rotation, position = solids.rotation[polygons, :2, :], solids.position[polygons, :2]
    if (rotation != np.eye(3)[:2]).any() or position.any():
        points = np.einsum("nij,nj->ni", np.repeat(rotation, corner_counts, axis=0), points)
        points[:, :2] += np.repeat(position, corner_counts, axis=0)
    vertices[flat_index(vertex_start[polygons], corner_counts)] = points[:, :2]


def _ring(solids: Solids, solid_index: int) -> Floats:
    """Return a solid's convex hull, seen from above; one NaN corner if a point is not finite."""
    points = solids.points[solids.point_start[solid_index] : solids.point_start[solid_index + 1]]
    placed_points = points @ solids.rotation[solid_index].T + solids.position[solid_index]
    if not np.isfinite(placed_points).all():
        return np.full((1, 2), np.nan)
    hull = convex_hull(placed_points[:, :2])
    return hull[:-1] if len(hull) > 1 and (hull[0] == hull[-1]).all() else hull


def _height_intervals(solids: Solids, count: int) -> tuple[Floats, Floats]:
    """Return the bottom and the top (R,) of objects; NaN if a solid of the object is flat."""
    is_flat_box = (solids.kind == BOX) & np.isnan(solids.size[:, 2])
    has_height = (solids.kind != DISC) & (solids.kind != POLYGON) & ~is_flat_box
    if not has_height.any():
        return np.full(count, np.nan), np.full(count, np.nan)
    up_rows = solids.rotation[:, 2, :]
    # half the extent along z of a rotated box: the sum of its projected half axes
    half_height = np.einsum("ij,ij->i", np.abs(up_rows), np.nan_to_num(solids.size)) / 2
    half_height = np.where(solids.kind == SPHERE, solids.size[:, 0] / 2, half_height)
    half_height = np.where(has_height, half_height, np.nan)
    lowest, highest = solids.position[:, 2] - half_height, solids.position[:, 2] + half_height
    for hull in np.flatnonzero(solids.kind == HULL).tolist():
        points = solids.points[solids.point_start[hull] : solids.point_start[hull + 1]]
        heights = points @ solids.rotation[hull, 2] + solids.position[hull, 2]
        lowest[hull], highest[hull] = heights.min(initial=np.inf), heights.max(initial=-np.inf)
    if len(lowest) == count:
        return lowest, highest
    bottom, top = np.full(count, np.inf), np.full(count, -np.inf)
    # minimum and maximum keep NaN, so one solid without a height makes the object's height NaN
    np.minimum.at(bottom, solids.owner, lowest)
    np.maximum.at(top, solids.owner, highest)
    return bottom, top


Numbers: TypeAlias = tuple[float, ...]
GetField: TypeAlias = Callable[[Any, str], Any]

MARKER_ADD, MARKER_DELETE, MARKER_DELETE_ALL = 0, 2, 3
"""Actions of a marker, see https://docs.ros.org/en/jazzy/p/visualization_msgs/interfaces/msg/Marker.html."""
DELETE_ALL_ENTITIES = (1, "ALL")
"""ALL as number and text, see https://docs.foxglove.dev/docs/sdk/schemas/scene-entity-deletion-type."""

_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


class Solid(NamedTuple):
    """One solid in the frame of its message; see `Solids` for its sizes and points."""

    kind: int
    position: Numbers
    quaternion: Numbers
    size: Numbers
    points: Sequence[Numbers] = ()


def lenient_getter(style: Style) -> GetField:
    """Return a getter of a field by name. It returns None for a missing field of a JSON object."""
    return getattr if style == "attributes" else lambda value, name: value.get(name)


def solids_of_marker(marker: Any, get: GetField) -> list[Solid]:
    """Return the solids of a visualization_msgs/Marker; [] for arrows, lines and texts."""
    # 1 CUBE, 2 SPHERE, 3 CYLINDER, 6 CUBE_LIST, 7 SPHERE_LIST, 11 TRIANGLE_LIST
    marker_type, scale = get(marker, "type"), _vector(get(marker, "scale"), get)
    position, quaternion = _pose(get(marker, "pose"), get)
    solid_kind = {1: BOX, 2: SPHERE, 3: CYLINDER}.get(marker_type)
    if solid_kind is not None:
        return [Solid(solid_kind, position, quaternion, scale)]
    points = [_vector(point, get) for point in get(marker, "points") or ()]
    if marker_type in (6, 7):
        # elements of a list marker; `_listed_solids` shifts each element to its point in the marker's frame
        element_kind = BOX if marker_type == 6 else SPHERE
        return [Solid(element_kind, position, quaternion, scale, (point,)) for point in points]
    if marker_type == 11 and len(points) >= 3:
        # the points of a triangle list are in units of the marker's scale
        scaled_points = [
            tuple(coordinate * factor for coordinate, factor in zip(point, scale, strict=True))
            for point in points
        ]
        return _triangles((position, quaternion), scaled_points)
    return []


def solids_of_entity(entity: Any, get: GetField) -> list[Solid]:
    """Return the solids of a foxglove.SceneEntity, without its lines, arrows, texts and models."""
    solids: list[Solid] = []
    for name, kind in (("cubes", BOX), ("spheres", SPHERE), ("cylinders", CYLINDER)):
        for primitive in get(entity, name) or ():
            size = _vector(get(primitive, "size"), get)
            if kind == CYLINDER:
                # the cylinder around a cone; scales that a protobuf sender leaves unset are 0 and mean 1
                scale = (
                    max(_or_one(get(primitive, "bottom_scale")), _or_one(get(primitive, "top_scale"))) or 1.0
                )
                size = (size[0] * scale, size[1] * scale, size[2])
            solids.append(Solid(kind, *_pose(get(primitive, "pose"), get), size))
    for primitive in get(entity, "triangles") or ():
        points = [_vector(point, get) for point in get(primitive, "points") or ()]
        corner_indices = list(get(primitive, "indices") or range(len(points)))
        corners = [points[index] for index in corner_indices if index < len(points)]
        solids += _triangles(_pose(get(primitive, "pose"), get), corners)
    return solids


def _triangles(pose: tuple[Numbers, Numbers], corners: Sequence[Numbers]) -> list[Solid]:
    return [Solid(HULL, *pose, (nan,) * 3, corners[i : i + 3]) for i in range(0, len(corners) - 2, 3)]


def solids_of_perceived_object(perceived_object: Any, get: GetField) -> list[Solid]:
    """Return the solid of a derived_object_msgs/Object: its shape, else its polygon, else a point."""
    # 1 BOX, 2 SPHERE, 3 CYLINDER and 4 CONE: radii and height, not diameters, as in
    # https://github.com/ros2/common_interfaces/blob/humble/shape_msgs/msg/SolidPrimitive.msg
    pose = _pose(get(perceived_object, "pose"), get)
    shape = get(perceived_object, "shape")
    shape_type = get(shape, "type")
    sizes = [float(size) for size in get(shape, "dimensions")]
    if shape_type == 1 and len(sizes) >= 3:
        return [Solid(BOX, *pose, tuple(sizes[:3]))]
    if shape_type == 2 and sizes:
        return [Solid(SPHERE, *pose, (2 * sizes[0],) * 3)]
    if shape_type in (3, 4) and len(sizes) >= 2:
        return [Solid(CYLINDER, *pose, (2 * sizes[1], 2 * sizes[1], sizes[0]))]
    corners = [_vector(point, get) for point in get(get(perceived_object, "polygon"), "points") or ()]
    if len(corners) >= 3:
        return [Solid(POLYGON, (0.0, 0.0, pose[0][2]), _NO_ROTATION, (nan,) * 3, corners)]
    return [Solid(SPHERE, *pose, (0.0,) * 3)]


def _pose(pose: Any, get: GetField) -> tuple[Numbers, Numbers]:
    if pose is None:
        return (0.0,) * 3, _NO_ROTATION
    quaternion = get(pose, "orientation")
    rotation = _NO_ROTATION if quaternion is None else _coordinates(quaternion, "xyzw", get)
    return _vector(get(pose, "position"), get), rotation


def _vector(vector: Any, get: GetField) -> Numbers:
    return (0.0,) * 3 if vector is None else _coordinates(vector, "xyz", get)


def _coordinates(value: Any, field_names: Iterable[str], get: GetField) -> Numbers:
    return tuple([float(get(value, name) or 0.0) for name in field_names])


def _or_one(value: Any) -> float:
    return 1.0 if value is None else float(value)


EVERY_OBJECT = -1
"""Name code that stands for all objects of a topic."""


@dataclass(frozen=True, slots=True)
class Poses:
    """R poses.

    Attributes:
        position: (R, 3).
        rotation: (R, 3, 3), frame_from_object.
        yaw: (R,) radians; NaN for objects without an orientation.
    """

    position: Floats
    rotation: Floats
    yaw: Floats

    def transform(self, transforms: Transforms) -> Poses:
        """Return the same poses in another frame."""
        rotation = transforms.rotation @ self.rotation
        position = np.einsum("nij,nj->ni", transforms.rotation, self.position) + transforms.translation
        return Poses(position, rotation, np.where(np.isnan(self.yaw), np.nan, yaw_of(rotation)))


@dataclass(frozen=True, slots=True)
class Detections:
    """R objects in M messages of a topic.

    Attributes:
        message: (R,) int64, index of each object's message, never decreasing.
        name, class_code: (R,) int64 codes.
        frames: name of each object's frame; None if all objects are in the fixed frame.
        stamp_ns: (R,) int64; None if messages have no stamps.
        poses: poses of the objects.
        solids: solids of the objects.
        height: (R, 2) bottom and top above each object's origin; None if solids give the heights.
        uncertainty: (R,) radii.
        covariance: (R, 3, 3) covariances of positions, multiplied by the square of the mapping's `sigmas`;
            None if the mapping reads no covariances.
        lifetime_ns: (R,) lifetimes, 0 for no limit; None if the topic has no lifetimes.
        is_locked: (R,) whether an object moves with its frame; None if no object does.
        deleted: (message, code of the name or `EVERY_OBJECT`) of each deletion.
        skipped: number of objects without a solid.
        numbers: (R, W) all numbers that the binding reads, before conversion; None without a binding.
    """

    message: Integers
    name: Integers
    class_code: Integers
    poses: Poses
    solids: Solids
    uncertainty: Floats
    frames: list[str] | None = None
    stamp_ns: Integers | None = None
    height: Floats | None = None
    covariance: Floats | None = None
    lifetime_ns: Integers | None = None
    is_locked: Booleans | None = None
    deleted: list[tuple[int, int]] = field(default_factory=list)
    skipped: int = 0
    numbers: Floats | None = None

    def scale(self, factor: float) -> Detections:
        """Return the same objects with all lengths multiplied by a factor."""
        solids, poses = self.solids, self.poses
        return replace(
            self,
            poses=replace(poses, position=poses.position * factor),
            solids=replace(
                solids,
                position=solids.position * factor,
                size=solids.size * factor,
                points=solids.points * factor,
            ),
            height=None if self.height is None else self.height * factor,
            uncertainty=self.uncertainty * factor,
            covariance=None if self.covariance is None else self.covariance * factor**2,
        )

    def repeat(self, index: int, count: int) -> Detections:
        """Return `count` copies of one object, each in a separate message, without frame and stamp."""
        row_indices = np.full(count, index, np.int64)
        poses = self.poses
        return Detections(
            message=np.arange(count, dtype=np.int64),
            name=self.name[row_indices],
            class_code=self.class_code[row_indices],
            poses=select(poses, row_indices),
            solids=self.solids.repeat(index, count),
            height=None if self.height is None else self.height[row_indices],
            uncertainty=self.uncertainty[row_indices],
            covariance=None if self.covariance is None else self.covariance[row_indices],
        )


@dataclass(slots=True)
class DetectionChunk:
    """Objects of a few messages, partly as lists; see `Detections` for the other attributes.

    Attributes:
        places: index of each message in the batch.
        deleted, message: as in `Detections`, with messages as indices into `places`.
        numbers: (R, W) all numbers that the binding reads from an object.
        noted_stamps: (message index in the batch, stamp) of messages or objects; only the first stamp if
            frames are not read.
        outline_counts: (R,) number of polygons of each object.
        corner_counts: number of corners of each polygon.
        corners: (V, 3) corners of all polygons.
    """

    places: Integers
    deleted: list[tuple[int, int]]
    message: list[int] = field(default_factory=list)
    name: list[int] = field(default_factory=list)
    class_code: list[int] = field(default_factory=list)
    frames: list[str] | None = None
    stamps: list[int] | None = None
    noted_stamps: list[tuple[int, int]] = field(default_factory=list)
    numbers: Floats = field(default_factory=lambda: np.empty((0, 0)))
    covariance: Floats | None = None
    lifetimes: list[int] = field(default_factory=list)
    locked: list[bool] = field(default_factory=list)
    solids: list[list[Solid]] = field(default_factory=list)
    outline_counts: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    corner_counts: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    corners: Floats = field(default_factory=lambda: np.empty((0, 3)))
    skipped: int = 0


def detections_from_chunks(
    layout: MessageLayout, binding: Binding | None, chunks: Sequence[DetectionChunk], good: Booleans
) -> Detections:
    """Join the chunks of a batch into columns.

    Args:
        good: (N,) whether each message of the batch was read. A message index of the result is a position
            among the good messages.
    """
    good_number = np.cumsum(good) - 1
    deletions = [
        (int(good_number[chunk.places[message]]), name) for chunk in chunks for message, name in chunk.deleted
    ]
    skipped = sum(chunk.skipped for chunk in chunks)
    chunks = [chunk for chunk in chunks if chunk.name]
    if binding is None or not chunks:
        return _no_detections(deletions, skipped)
    name = _join_columns(chunk.name for chunk in chunks)
    numbers = np.empty((len(name), 0))
    if binding.numbers is not None:
        numbers = np.concatenate([chunk.numbers for chunk in chunks])
    if layout.solids:
        solids, poses = _listed_solids(list(chain.from_iterable(chunk.solids for chunk in chunks)))
    else:
        poses = poses_from_numbers(layout, binding, numbers)
        if binding.polygon is not None:
            corner_counts = np.concatenate([chunk.corner_counts for chunk in chunks])
            object_frames = None
            if layout.shape is not None:
                object_frames = _origins_of_shape(layout.shape, poses), poses.rotation
            corners = np.concatenate([chunk.corners for chunk in chunks])
            outline_counts = np.concatenate([chunk.outline_counts for chunk in chunks])
            solids = _polygons(outline_counts, corner_counts, corners, object_frames)
        else:
            solids = solids_of_shape(layout, binding, poses, numbers)
    has_frames, has_stamps = chunks[0].frames is not None, chunks[0].stamps is not None
    locked_flags = list(chain.from_iterable(chunk.locked for chunk in chunks))
    chunk_covariances = [chunk.covariance for chunk in chunks if chunk.covariance is not None]
    return Detections(
        message=np.concatenate([good_number[chunk.places[chunk.message]] for chunk in chunks]),
        name=name,
        class_code=_join_columns(chunk.class_code for chunk in chunks),
        frames=list(chain.from_iterable(chunk.frames or () for chunk in chunks)) if has_frames else None,
        stamp_ns=_join_columns(chunk.stamps or () for chunk in chunks) if has_stamps else None,
        poses=poses,
        solids=solids,
        height=heights_from_numbers(binding, numbers),
        uncertainty=radii_from_numbers(binding, numbers, len(name)),
        covariance=np.concatenate(chunk_covariances) if chunk_covariances else None,
        lifetime_ns=_join_columns(chunk.lifetimes for chunk in chunks) if layout.stays else None,
        is_locked=np.array(locked_flags, np.bool_) if any(locked_flags) else None,
        deleted=deletions,
        skipped=skipped,
        numbers=numbers,
    )


def _no_detections(deleted: list[tuple[int, int]], skipped: int) -> Detections:
    no_codes, no_numbers = np.empty(0, np.int64), np.empty(0)
    no_points, no_matrices = np.empty((0, 3)), np.empty((0, 3, 3))
    solids = Solids(
        no_codes, np.empty(0, np.int8), no_points, no_matrices, no_points, np.zeros(1, np.int64), no_points
    )
    poses = Poses(no_points, no_matrices, no_numbers)
    return Detections(
        no_codes, no_codes, no_codes, poses, solids, no_numbers, deleted=deleted, skipped=skipped
    )


def _join_columns(columns: Iterable[Sequence[int]]) -> Integers:
    return np.fromiter(chain.from_iterable(columns), np.int64)


def poses_from_numbers(layout: MessageLayout, binding: Binding, numbers: Floats) -> Poses:
    """Return the poses in numbers (R, W); an object without an orientation has its frame's axes."""
    count = len(numbers)
    position = np.zeros((count, 3))
    if layout.origin is not None:
        position[:, :2] = local_metres(numbers[:, list(binding.position)], layout.origin)
    else:
        for axis, column in enumerate(binding.position):
            position[:, axis] = numbers[:, column]
    if binding.orientation:
        rotation, yaw = matrices_from_quaternions(numbers[:, list(binding.orientation)])
        return Poses(position, rotation, yaw)
    if binding.yaw is not None:
        yaw = layout.angle_zero + numbers[:, binding.yaw] * layout.angle_scale
        return Poses(position, matrices_from_yaw(yaw), yaw)
    return Poses(position, no_rotations(count), np.full(count, np.nan))


_EQUATOR_M, _ECCENTRICITY_SQUARED = 6_378_137.0, 6.694379990141316e-3
"""WGS 84 ellipsoid: semi-major axis in metres, and squared first eccentricity."""


def local_metres(fixes: Floats, origin: tuple[float, float]) -> Floats:
    """Return metres east and north of an origin (R, 2), in the plane tangent to the ellipsoid at the origin.

    Args:
        fixes: (R, 2 or 3) latitude and longitude in degrees, and maybe a status. A negative status means no
            fix, as in sensor_msgs/NavSatStatus.
        origin: latitude and longitude in degrees.
    """

    # geodetic to Earth-centred, Earth-fixed coordinates at height 0
    def to_earth_frame(degrees: Floats) -> Floats:
        latitude, longitude = np.radians(degrees[:, :2]).T
        radius = _EQUATOR_M / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
        axis_distance = radius * np.cos(latitude)
        polar_distance = radius * (1 - _ECCENTRICITY_SQUARED) * np.sin(latitude)
        return np.stack(
            [axis_distance * np.cos(longitude), axis_distance * np.sin(longitude), polar_distance], axis=1
        )

    latitude, longitude = np.radians(origin)
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    north = np.array(
        [-np.sin(latitude) * np.cos(longitude), -np.sin(latitude) * np.sin(longitude), np.cos(latitude)]
    )
    offsets_m = to_earth_frame(fixes) - to_earth_frame(np.array([origin]))
    metres: Floats = offsets_m @ np.stack([east, north], axis=1)
    # longitudes may go up to 360 degrees
    has_no_fix = np.any(np.abs(fixes[:, :2]) > (90.0, 360.0), axis=1) | np.any(fixes[:, 2:] < 0, axis=1)
    metres[np.flatnonzero(has_no_fix)] = np.nan
    return metres


def heights_from_numbers(binding: Binding, numbers: Floats) -> Floats | None:
    """Return bottom and top (R, 2) above the objects' origins; None if the binding has no height."""
    if not binding.height:
        return None
    count = len(numbers)
    bounds = [
        numbers[:, measure] if isinstance(measure, int) else np.full(count, measure)
        for measure in binding.height
    ]
    return np.stack(bounds, axis=1)


def radii_from_numbers(binding: Binding, numbers: Floats, count: int) -> Floats:
    """Return the radii (R,) of uncertainty."""
    if isinstance(binding.uncertainty, int):
        return numbers[:, binding.uncertainty]
    return np.full(count, binding.uncertainty or 0.0)


def covariances(layout: MessageLayout, binding: Binding, objects: list[Any]) -> Floats | None:
    """Return the covariances (R, 3, 3) of positions, multiplied by the square of the mapping's `sigmas`."""
    if binding.covariance is None or layout.uncertainty is None:
        return None
    covariance_rows = np.array([list(binding.covariance(element)) for element in objects], np.float64)
    matrix_size = {4: 2, 9: 3, 36: 6}[covariance_rows.shape[1]]
    # a 6 x 6 covariance begins with the position, as in geometry_msgs/PoseWithCovariance
    used_size = min(matrix_size, 3)
    matrices = np.zeros((len(objects), 3, 3))
    matrices[:, :used_size, :used_size] = covariance_rows.reshape(-1, matrix_size, matrix_size)[
        :, :used_size, :used_size
    ]
    return matrices * layout.uncertainty.sigmas**2


def _listed_solids(solid_lists: list[list[Solid]]) -> tuple[Solids, Poses]:
    """Return all solids, and the pose of each object's first solid; each object needs a solid."""
    solid_counts = np.array([len(solids) for solids in solid_lists], np.int64)
    solids = list(chain.from_iterable(solid_lists))
    position = _array([solid.position for solid in solids], 3)
    rotation, yaw = matrices_from_quaternions(_array([solid.quaternion for solid in solids], 4))
    first_solid = np.cumsum(solid_counts) - solid_counts
    kind = np.array([solid.kind for solid in solids], np.int8)
    poses = Poses(position[first_solid], rotation[first_solid], yaw[first_solid])
    points = _array(list(chain.from_iterable(solid.points for solid in solids)), 3)
    point_start = starts_from_counts(np.array([len(solid.points) for solid in solids], np.int64))
    # a box or a sphere with one point is an element of a list marker, shifted to that point
    shifted_indices = np.flatnonzero((np.diff(point_start) == 1) & ((kind == BOX) | (kind == SPHERE)))
    position = position.copy()
    position[shifted_indices] += np.einsum(
        "nij,nj->ni", rotation[shifted_indices], points[point_start[shifted_indices]]
    )
    owner = np.repeat(np.arange(len(solid_counts)), solid_counts)
    size = _array([solid.size for solid in solids], 3)
    return Solids(owner, kind, position, rotation, size, point_start, points), poses


def solids_of_shape(layout: MessageLayout, binding: Binding, poses: Poses, numbers: Floats) -> Solids:
    """Return one solid per object: the mapping's shape, the message's sizes, or a point."""
    shape = layout.shape
    position = poses.position if shape is None else _origins_of_shape(shape, poses)
    count = len(position)
    size = np.full((count, 3), np.nan)
    corner_counts, points = np.zeros(count, np.int64), np.empty((0, 3))
    if shape is None:
        kind = BOX if binding.sizes else DISC
        size[:, 0] = 0.0
        for axis, column in enumerate(binding.sizes):
            size[:, axis] = numbers[:, column]
    else:
        kind = {"box": BOX, "disc": DISC, "polygon": POLYGON}[shape.kind]
        for axis, measure in enumerate(binding.shape_sizes):
            size[:, axis] = numbers[:, measure] if isinstance(measure, int) else measure
        if kind == DISC:
            size[:, 0] *= 2
        if shape.points:
            corners = np.array([(x, y, 0.0) for x, y in shape.points])
            corner_counts, points = np.full(count, len(corners)), np.tile(corners, (count, 1))
    # NaN instead of a negative size, so that the object is unknown
    size[:, :2] = np.where(size[:, :2] < 0, np.nan, size[:, :2])
    owner, kinds = np.arange(count), np.full(count, kind, np.int8)
    return Solids(owner, kinds, position, poses.rotation, size, starts_from_counts(corner_counts), points)


def _origins_of_shape(shape: ShapeMapping, poses: Poses) -> Floats:
    """Return the origins (R, 3) of a shape: the origins of objects plus the rotated offset."""
    if shape.offset == (0.0, 0.0):
        return poses.position
    return np.asarray(poses.position + poses.rotation[:, :, :2] @ np.array(shape.offset))


def _polygons(
    outline_counts: Integers, corner_counts: Integers, points: Floats, frames: tuple[Floats, Floats] | None
) -> Solids:
    """Return polygons with corners in the frame of their message, or in the frames of their objects.

    Args:
        outline_counts: (R,) number of polygons of each object.
        corner_counts: number of corners of each polygon.
        frames: positions (R, 3) and rotations (R, 3, 3) of the objects' frames; None for corners in the
            message's frame.
    """
    polygon_count = len(corner_counts)
    owner, kind = (
        np.repeat(np.arange(len(outline_counts)), outline_counts),
        np.full(polygon_count, POLYGON, np.int8),
    )
    position, rotation = np.zeros((polygon_count, 3)), no_rotations(polygon_count)
    if frames is not None:
        position, rotation = frames[0][owner], frames[1][owner]
    size = np.full((polygon_count, 3), np.nan)
    return Solids(owner, kind, position, rotation, size, starts_from_counts(corner_counts), points)


def _array(rows: list[Any], width: int) -> Floats:
    return np.array(rows, np.float64).reshape(len(rows), width)
