"""Transforms out of messages, into the tree of frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from spatial_replay.logs.mapping.bodies import Read, reader_of
from spatial_replay.logs.mapping.fields import field_names, style_of
from spatial_replay.logs.mapping.frames import FrameTree


def add_transforms(tree: FrameTree, message: object, clock_ns: int, *, is_static: bool) -> None:
    """Put every transform of a message into a tree.

    Raises:
        AttributeError, LookupError, TypeError, ValueError: it is no message of transforms.
    """
    read = reader_of(style_of(message))
    for transform in _each(message, read):
        child, parent, translation, rotation, time = _parts(transform, read)
        pose = tuple(float(read(translation, axis) or 0.0) for axis in "xyz")
        turned = tuple(float(read(rotation, axis) or 0.0) for axis in "xyzw")
        tree.add(
            str(child).removeprefix("/"),
            str(parent).removeprefix("/"),
            pose + turned,
            stamp_ns=_nanoseconds(time, read),
            clock_ns=clock_ns,
            is_static=is_static,
        )


def stamp_of_transforms(message: object) -> int | None:
    """The stamp of a message's first transform; None where it has no transform."""
    read = reader_of(style_of(message))
    first = next(_each(message, read), None)
    return None if first is None else _nanoseconds(_parts(first, read)[4], read)


def _each(message: object, read: Read) -> Iterator[Any]:
    return iter(read(message, "transforms")) if "transforms" in field_names(message) else iter((message,))


def _parts(transform: Any, read: Read) -> tuple[Any, Any, Any, Any, Any]:
    """Child, parent, translation, rotation, time."""
    child = read(transform, "child_frame_id")
    if "header" in field_names(transform):
        header, moved = read(transform, "header"), read(transform, "transform")
        parent, time = read(header, "frame_id"), read(header, "stamp")
        return child, parent, read(moved, "translation"), read(moved, "rotation"), time
    parent, time = read(transform, "parent_frame_id"), read(transform, "timestamp")
    return child, parent, read(transform, "translation"), read(transform, "rotation"), time


def _nanoseconds(time: Any, read: Read) -> int:
    names = field_names(time)
    seconds = next((name for name in ("sec", "secs", "seconds") if name in names), None)
    rest = next((name for name in ("nanosec", "nsec", "nsecs", "nanos") if name in names), None)
    whole = int(read(time, seconds)) if seconds else 0
    return whole * 10**9 + (int(read(time, rest)) if rest else 0)
