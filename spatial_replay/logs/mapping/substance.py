"""What objects consist of: a shape of the mapping, or what their messages say."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.mapping.binding import Binding
from spatial_replay.logs.mapping.bodies import (
    Body,
    bodies_of_entity,
    bodies_of_marker,
    bodies_of_perceived,
    reader_of,
)
from spatial_replay.logs.mapping.fields import Style, field_names, style_of
from spatial_replay.logs.mapping.paths import Path, tuple_getter
from spatial_replay.logs.mapping.poses import Poses
from spatial_replay.logs.mapping.readings import Reading
from spatial_replay.logs.mapping.rotation import matrices_from_quaternions
from spatial_replay.logs.mapping.solids import BOX, DISC, POLYGON, SPHERE, Solids
from spatial_replay.trace.ragged import starts_from_counts

_BODIES = {"marker": bodies_of_marker, "scene": bodies_of_entity, "primitive": bodies_of_perceived}


def bodies_of(reading: Reading, binding: Binding, objects: Sequence[Any]) -> list[list[Body]]:
    """The bodies of each object, of a type that says what they consist of; none where nothing is one."""
    read = reader_of(binding.style)
    take = _BODIES[reading.solids]
    return [take(each, read) for each in objects]


def solids_of_bodies(listed: list[list[Body]]) -> tuple[Solids, Poses]:
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


def shapes(reading: Reading, binding: Binding, poses: Poses, numbers: Floats) -> Solids:
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
        get = tuple_getter([Path.of(axis) for axis in axes], style)
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
