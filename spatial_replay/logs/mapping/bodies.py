"""The bodies that messages made for drawing and for perception consist of."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import nan
from typing import Any, NamedTuple, TypeAlias

from spatial_replay.logs.mapping.fields import Style
from spatial_replay.logs.mapping.solids import BOX, CYLINDER, HULL, POLYGON, SPHERE

Numbers: TypeAlias = tuple[float, ...]
Read: TypeAlias = Callable[[Any, str], Any]

MARKER_ADD, MARKER_DELETE, MARKER_DELETE_ALL = 0, 2, 3
DELETE_ALL_ENTITIES = 1

_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


class Body(NamedTuple):
    """One body in the frame of its message; see `Solids` for what its numbers mean."""

    kind: int
    position: Numbers
    quaternion: Numbers
    size: Numbers
    points: Sequence[Numbers] = ()


def reader_of(style: Style) -> Read:
    """How a field is read that may be missing from a JSON object."""
    return getattr if style == "attributes" else lambda value, name: value.get(name)


def bodies_of_marker(marker: Any, read: Read) -> list[Body]:
    """The bodies of a visualization_msgs/Marker; none of markers that are no bodies: arrows, lines, texts."""
    kind = read(marker, "type")
    pose, scale = read(marker, "pose"), _vector(read(marker, "scale"), read)
    position, quaternion = _pose(pose, read)
    single = {1: BOX, 2: SPHERE, 3: CYLINDER}.get(kind)
    if single is not None:
        return [Body(single, position, quaternion, scale)]
    points = [_vector(point, read) for point in read(marker, "points") or ()]
    if kind in (6, 7):
        # each at a point in the marker's own frame: a hull of one point stands for the shift
        listed = BOX if kind == 6 else SPHERE
        return [Body(listed, position, quaternion, scale, (point,)) for point in points]
    if kind == 11 and len(points) >= 3:
        scaled = [tuple(a * b for a, b in zip(point, scale, strict=True)) for point in points]
        return [
            Body(HULL, position, quaternion, (nan,) * 3, scaled[i : i + 3])
            for i in range(0, len(points) - 2, 3)
        ]
    return []


def bodies_of_entity(entity: Any, read: Read) -> list[Body]:
    """The bodies of a foxglove.SceneEntity; its lines, arrows, texts and models are none."""
    bodies: list[Body] = []
    for name, kind in (("cubes", BOX), ("spheres", SPHERE), ("cylinders", CYLINDER)):
        for primitive in read(entity, name) or ():
            size = _vector(read(primitive, "size"), read)
            if kind == CYLINDER:
                scale = max(_or_one(read(primitive, "bottom_scale")), _or_one(read(primitive, "top_scale")))
                size = (size[0] * scale, size[1] * scale, size[2])
            bodies.append(Body(kind, *_pose(read(primitive, "pose"), read), size))
    for primitive in read(entity, "triangles") or ():
        points = [_vector(point, read) for point in read(primitive, "points") or ()]
        order = list(read(primitive, "indices") or range(len(points)))
        corners = [points[i] for i in order if i < len(points)]
        pose = _pose(read(primitive, "pose"), read)
        bodies += [Body(HULL, *pose, (nan,) * 3, corners[i : i + 3]) for i in range(0, len(corners) - 2, 3)]
    return bodies


def bodies_of_perceived(thing: Any, read: Read) -> list[Body]:
    """The body of a derived_object_msgs/Object: its solid, else its polygon, else the point where it is."""
    pose = _pose(read(thing, "pose"), read)
    solid = read(thing, "shape")
    kind = read(solid, "type")
    sizes = [float(size) for size in read(solid, "dimensions")]
    if kind == 1 and len(sizes) >= 3:
        return [Body(BOX, *pose, tuple(sizes[:3]))]
    if kind == 2 and sizes:
        return [Body(SPHERE, *pose, (2 * sizes[0],) * 3)]
    if kind in (3, 4) and len(sizes) >= 2:
        return [Body(CYLINDER, *pose, (2 * sizes[1], 2 * sizes[1], sizes[0]))]
    corners = [_vector(point, read) for point in read(read(thing, "polygon"), "points") or ()]
    if len(corners) >= 3:
        return [Body(POLYGON, (0.0, 0.0, pose[0][2]), _NO_ROTATION, (nan,) * 3, corners)]
    return [Body(SPHERE, *pose, (0.0,) * 3)]


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
