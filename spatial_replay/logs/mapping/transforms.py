"""Transforms out of messages, into the tree of frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from spatial_replay.logs.mapping.fields import field_names, style_of
from spatial_replay.logs.mapping.frames import FrameTree
from spatial_replay.logs.mapping.paths import FieldError, Get, Path, getter, leads_somewhere, tuple_getter
from spatial_replay.trace.times import LATEST_NS

_SECONDS = ("sec", "secs", "seconds")
_REST = ("nanosec", "nsec", "nsecs", "nanos")


class TransformReader:
    """Reads the transforms in the messages of one topic, whatever they are called there."""

    def __init__(self) -> None:
        self._list: Get | None = None
        self._get: Get | None = None

    def add(self, tree: FrameTree, message: object, clock_ns: int, *, is_static: bool) -> None:
        """Put every transform of a message into a tree.

        Raises:
            FieldError, AttributeError, LookupError, TypeError, ValueError: it is no message of transforms.
        """
        for transform in self._each(message):
            child, parent, seconds, rest, *pose = self._values(transform)
            tree.add(
                str(child).removeprefix("/"),
                str(parent).removeprefix("/"),
                tuple(map(float, pose)),
                stamp_ns=_nanoseconds(seconds, rest),
                clock_ns=clock_ns,
                is_static=is_static,
            )

    def stamp(self, message: object) -> int | None:
        """The stamp of a message's first transform; None where it has no transform."""
        for transform in self._each(message):
            _, _, seconds, rest, *_ = self._values(transform)
            return _nanoseconds(seconds, rest)
        return None

    def _each(self, message: object) -> Iterator[Any]:
        if self._list is None:
            has_list = "transforms" in field_names(message)
            self._list = getter(Path.of("transforms"), style_of(message)) if has_list else lambda one: (one,)
        return iter(self._list(message))

    def _values(self, transform: Any) -> Sequence[Any]:
        if self._get is None:
            self._get = _getter(transform)
        values: Sequence[Any] = self._get(transform)
        return values


def _getter(example: object) -> Get:
    """Child, parent, seconds, nanoseconds, x, y, z, and the quaternion's x, y, z, w."""
    names = field_names(example)
    stamp, parent = (
        ("header.stamp", "header.frame_id") if "header" in names else ("timestamp", "parent_frame_id")
    )
    place = "transform." if "transform" in names else ""
    paths = ["child_frame_id", parent]
    for parts in (_SECONDS, _REST):
        found = [f"{stamp}.{part}" for part in parts if leads_somewhere(Path.of(f"{stamp}.{part}"), example)]
        if not found:
            raise FieldError(f"{stamp} is no time; a transform has a stamp")
        paths.append(found[0])
    paths += [f"{place}translation.{axis}" for axis in "xyz"]
    paths += [f"{place}rotation.{axis}" for axis in "xyzw"]
    return tuple_getter([Path.of(path) for path in paths], style_of(example))


def _nanoseconds(seconds: Any, rest: Any) -> int:
    time_ns = int(seconds) * 1_000_000_000 + int(rest)
    if abs(time_ns) > LATEST_NS:
        raise FieldError(f"its stamp {time_ns} ns lies outside the times of a log")
    return time_ns
