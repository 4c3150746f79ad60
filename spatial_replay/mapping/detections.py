"""Objects that messages tell of, in columns.

What objects consist of: a shape of the mapping, or what their messages say.

Where objects are: origins and axes, in columns.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers, starts_from_counts
from spatial_replay.mapping.binding import Binding
from spatial_replay.mapping.field_paths import FieldPath, Style, field_names, style_of, tuple_getter
from spatial_replay.mapping.footprints import (
    BOX,
    DISC,
    POLYGON,
    SPHERE,
    Solid,
    Solids,
    reader_of,
    solids_of_entity,
    solids_of_marker,
    solids_of_perceived_object,
)
from spatial_replay.mapping.message_types import MessageLayout
from spatial_replay.mapping.transforms import Transforms, matrices_from_quaternions, matrices_from_yaw, yaw_of


@dataclass(frozen=True, slots=True)
class Poses:
    """R poses.

    Attributes:
        position: (R, 3).
        rotation: (R, 3, 3) frame_from_object.
        yaw: (R,) radians; NaN for objects without an orientation.
    """

    position: Floats
    rotation: Floats
    yaw: Floats

    def moved(self, transforms: Transforms) -> Poses:
        """The same poses in another frame."""
        rotation = transforms.rotation @ self.rotation
        position = np.einsum("nij,nj->ni", transforms.rotation, self.position) + transforms.translation
        return Poses(position, rotation, np.where(np.isnan(self.yaw), np.nan, yaw_of(rotation)))


def poses_of(reading: MessageLayout, binding: Binding, numbers: Floats) -> Poses:
    """The poses that the numbers (R, width) of objects hold; no orientation is the frame's own."""
    count = len(numbers)
    position = np.zeros((count, 3))
    for axis, column in enumerate(binding.position):
        position[:, axis] = numbers[:, column]
    if binding.orientation:
        rotation, yaw = matrices_from_quaternions(numbers[:, list(binding.orientation)])
        return Poses(position, rotation, yaw)
    if binding.yaw is not None:
        yaw = numbers[:, binding.yaw] * reading.angle_scale
        return Poses(position, matrices_from_yaw(yaw), yaw)
    return Poses(position, np.broadcast_to(np.eye(3), (count, 3, 3)), np.full(count, np.nan))


_BODIES = {"marker": solids_of_marker, "scene": solids_of_entity, "primitive": solids_of_perceived_object}


def bodies_of(reading: MessageLayout, binding: Binding, objects: Sequence[Any]) -> list[list[Solid]]:
    """The bodies of each object, of a type that says what they consist of; none where nothing is one."""
    read = reader_of(binding.style)
    take = _BODIES[reading.solids]
    return [take(each, read) for each in objects]


def solids_of_bodies(listed: list[list[Solid]]) -> tuple[Solids, Poses]:
    """The solids of objects that have at least one body each, and the pose of each one's first."""
    counts = np.array([len(bodies) for bodies in listed], np.int64)
    bodies = list(chain.from_iterable(listed))
    owner = np.repeat(np.arange(len(counts)), counts)
    position = _array([body.position for body in bodies], 3)
    rotation, yaw = matrices_from_quaternions(_array([body.quaternion for body in bodies], 4))
    first = np.cumsum(counts) - counts
    kind = np.array([body.kind for body in bodies], np.int8)
    poses = Poses(position[first], rotation[first], yaw[first])
    points = _array(list(chain.from_iterable(body.points for body in bodies)), 3)
    start = starts_from_counts(np.array([len(body.points) for body in bodies], np.int64))
    shifted = np.flatnonzero((np.diff(start) == 1) & ((kind == BOX) | (kind == SPHERE)))
    position = position.copy()
    position[shifted] += np.einsum("nij,nj->ni", rotation[shifted], points[start[shifted]])
    return Solids(owner, kind, position, rotation, _array([b.size for b in bodies], 3), start, points), poses


def shapes(reading: MessageLayout, binding: Binding, poses: Poses, numbers: Floats) -> Solids:
    """One solid each, of the shape that the mapping or the message gives; a point where nobody does."""
    count = len(poses.position)
    shape = reading.shape
    size = np.full((count, 3), np.nan)
    position = poses.position
    counts, points = np.zeros(count, np.int64), np.empty((0, 3))
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
        if shape.offset != (0.0, 0.0):
            position = position + poses.rotation[:, :, :2] @ np.array(shape.offset)
        if shape.points:
            corners = np.array([(x, y, 0.0) for x, y in shape.points])
            counts, points = np.full(count, len(corners)), np.tile(corners, (count, 1))
    # a negative size is none; not a number makes the object unknown
    size[:, :2] = np.where(size[:, :2] < 0, np.nan, size[:, :2])
    return Solids(
        owner=np.arange(count),
        kind=np.full(count, kind, np.int8),
        position=position,
        rotation=poses.rotation,
        size=size,
        point_start=starts_from_counts(counts),
        points=points,
    )


def polygons(counts: Integers, points: Floats) -> Solids:
    """Polygons whose corners are given in the frame of their message, not in the object's own."""
    count = len(counts)
    origin = np.zeros((count, 3))
    return Solids(
        owner=np.arange(count),
        kind=np.full(count, POLYGON, np.int8),
        position=origin,
        rotation=np.broadcast_to(np.eye(3), (count, 3, 3)),
        size=np.full((count, 3), np.nan),
        point_start=starts_from_counts(counts),
        points=points,
    )


def points_of(lists: list[Any]) -> tuple[Integers, Floats]:
    """The corners of lists of points, of pairs of numbers, or of x, y, x, y … in turn."""
    example = next((each[0] for each in lists if len(each)), None)
    flat = list(chain.from_iterable(lists))
    counts = np.array([len(each) for each in lists], np.int64)
    names = field_names(example)
    if "x" in names and "y" in names:
        axes = "xyz" if "z" in names else "xy"
        style = style_of(example)
        get = tuple_getter([FieldPath.of(axis) for axis in axes], style)
        found = rows_of(map(get, flat), len(flat), len(axes), style)
        return counts, found if len(axes) == 3 else np.column_stack([found, np.zeros(len(flat))])
    if example is None or hasattr(example, "__len__"):
        return counts, _with_zero([(p[0], p[1]) for p in flat])
    if (counts % 2).any():
        raise ValueError("a polygon has an odd number of coordinates; give x and y of each corner in turn")
    pairs = np.array(flat, np.float64).reshape(-1, 2)
    return counts // 2, np.column_stack([pairs, np.zeros(len(pairs))])


def rows_of(tuples: Iterable[Sequence[Any]], count: int, width: int, style: Style) -> Floats:
    """(count, width) the numbers in tuples; None, as JSON has it, is not a number."""
    if style == "keys":
        return np.array(list(tuples), np.float64).reshape(count, width)
    return np.fromiter(chain.from_iterable(tuples), np.float64, count * width).reshape(count, width)


def _with_zero(pairs: list[tuple[Any, Any]]) -> Floats:
    found = np.zeros((len(pairs), 3))
    found[:, :2] = _array(pairs, 2)
    return found


def _array(rows: list[Any], width: int) -> Floats:
    return np.array(rows, np.float64).reshape(len(rows), width)


EVERY_OBJECT = -1
"""Instead of a name: everything that the topic has told of."""


@dataclass(slots=True)
class Detections:
    """R objects that M messages of a topic tell of.

    Attributes:
        message: (R,) int64, increasing: the message of each object.
        name, class_code: (R,) int64.
        frames: the name of the frame of each, or None where all are in the fixed frame.
        stamp_ns: (R,) int64 of each, or None where messages have no stamps.
        poses: where they are.
        solids: what they consist of.
        height: (R, 2) above the origin of each; None for the heights of the solids.
        uncertainty: (R,) radius.
        covariance: (R, 3, 3) of the position with the number of deviations applied, or None.
        lifetime_ns: (R,) 0 for ever; None for all of them.
        gone: (message, name's code or `EVERY_OBJECT`) of those that were deleted.
        skipped: how many objects had nothing that is a body.
    """

    message: Integers
    name: Integers
    class_code: Integers
    frames: list[str] | None
    stamp_ns: Integers | None
    poses: Poses
    solids: Solids
    height: Floats | None
    uncertainty: Floats
    covariance: Floats | None
    lifetime_ns: Integers | None
    gone: list[tuple[int, int]]
    skipped: int


@dataclass(slots=True)
class DetectionChunk:
    """What a few messages tell of, before it is put into columns; attributes as of `Detections`."""

    gone: list[tuple[int, int]]
    message: list[int] = field(default_factory=list)
    name: list[int] = field(default_factory=list)
    class_code: list[int] = field(default_factory=list)
    frames: list[str] | None = None
    stamps: list[int] | None = None
    numbers: Floats = field(default_factory=lambda: np.empty((0, 0)))
    covariance: Floats | None = None
    lifetimes: list[int] = field(default_factory=list)
    bodies: list[list[Solid]] = field(default_factory=list)
    corner_counts: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    corners: Floats = field(default_factory=lambda: np.empty((0, 3)))
    skipped: int = 0

    def shifted(self, count: int) -> DetectionChunk:
        """The same of messages that come so many later."""
        self.message = [number + count for number in self.message]
        self.gone = [(number + count, name) for number, name in self.gone]
        return self


def detections_from_chunks(
    reading: MessageLayout, binding: Binding | None, parts: Sequence[DetectionChunk]
) -> Detections:
    """The parts of consecutive messages as columns."""
    gone = [each for part in parts for each in part.gone]
    skipped = sum(part.skipped for part in parts)
    parts = [part for part in parts if part.name]
    if binding is None or not parts:
        return _nobody(gone, skipped)
    name = _joined(part.name for part in parts)
    numbers = np.empty((len(name), 0))
    if binding.numbers is not None:
        numbers = np.concatenate([part.numbers for part in parts])
    if reading.solids:
        solids, poses = solids_of_bodies(list(chain.from_iterable(part.bodies for part in parts)))
    else:
        poses = poses_of(reading, binding, numbers)
        if binding.polygon is not None:
            counts = np.concatenate([part.corner_counts for part in parts])
            solids = polygons(counts, np.concatenate([part.corners for part in parts]))
        else:
            solids = shapes(reading, binding, poses, numbers)
    has_frames, has_stamps = parts[0].frames is not None, parts[0].stamps is not None
    spreads = [part.covariance for part in parts if part.covariance is not None]
    return Detections(
        message=_joined(part.message for part in parts),
        name=name,
        class_code=_joined(part.class_code for part in parts),
        frames=list(chain.from_iterable(part.frames or () for part in parts)) if has_frames else None,
        stamp_ns=_joined(part.stamps or () for part in parts) if has_stamps else None,
        poses=poses,
        solids=solids,
        height=_measured(binding.height, numbers),
        uncertainty=_uncertainty(binding, numbers, len(name)),
        covariance=np.concatenate(spreads) if spreads else None,
        lifetime_ns=_joined(part.lifetimes for part in parts) if binding.lifetime is not None else None,
        gone=gone,
        skipped=skipped,
    )


def _joined(columns: Iterable[Sequence[int]]) -> Integers:
    return np.fromiter(chain.from_iterable(columns), np.int64)


def _measured(measures: tuple[float | int, ...], numbers: Floats) -> Floats | None:
    """(R, K) numbers of K measures."""
    if not measures:
        return None
    columns = [
        numbers[:, each] if isinstance(each, int) else np.full(len(numbers), each) for each in measures
    ]
    return np.stack(columns, axis=1)


def _uncertainty(binding: Binding, numbers: Floats, count: int) -> Floats:
    if isinstance(binding.uncertainty, int):
        return numbers[:, binding.uncertainty]
    return np.full(count, binding.uncertainty or 0.0)


def covariances(reading: MessageLayout, binding: Binding, objects: list[Any]) -> Floats | None:
    """(R, 3, 3) the position's part, times the square of the number of deviations."""
    if binding.covariance is None or reading.uncertainty is None:
        return None
    rows = np.array([list(binding.covariance(each)) for each in objects], np.float64)
    size = {4: 2, 9: 3, 36: 6}[rows.shape[1]]
    used = min(size, 3)
    found = np.zeros((len(objects), 3, 3))
    found[:, :used, :used] = rows.reshape(-1, size, size)[:, :used, :used]
    return found * reading.uncertainty.sigmas**2


def _nobody(gone: list[tuple[int, int]], skipped: int) -> Detections:
    none = np.empty(0, np.int64)
    empty = np.empty((0, 3))
    matrices = np.empty((0, 3, 3))
    return Detections(
        message=none,
        name=none,
        class_code=none,
        frames=None,
        stamp_ns=None,
        poses=Poses(empty, matrices, np.empty(0)),
        solids=Solids(
            none, np.empty(0, np.int8), empty, matrices, empty, np.zeros(1, np.int64), np.empty((0, 3))
        ),
        height=None,
        uncertainty=np.empty(0),
        covariance=None,
        lifetime_ns=None,
        gone=gone,
        skipped=skipped,
    )
