"""Frames: messages with transforms in, the transform between any two frames at any time out.

A transform places a child frame in its parent. Between two transforms of a child, translation is interpolated
linearly and rotation along the shorter arc, as tf2 does; there is no extrapolation. A static transform holds
at all times. Rotations are arrays of many at once: quaternions (x, y, z, w) and matrices.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.mapping.field_paths import (
    FieldError,
    FieldPath,
    Get,
    field_names,
    getter,
    leads_somewhere,
    style_of,
    tuple_getter,
)
from spatial_replay.trace.sample import LATEST_NS

_LEAST_NORM = 1e-6
_UPRIGHT = 1e-9


def matrices_from_quaternions(quaternions: Floats) -> tuple[Floats, Floats]:
    """Convert quaternions of any length to rotation matrices.

    A quaternion of zeros, the default of messages whose orientation was never set, means no rotation.

    Args:
        quaternions: (N, 4) x, y, z, w.

    Returns:
        (N, 3, 3) a_from_b matrices, whose columns are the axes of b; (N,) the angle of the projected x axis,
        NaN for quaternions of zeros.
    """
    norm = np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))
    is_zero = norm < _LEAST_NORM
    x, y, z, w = (quaternions / np.where(is_zero, 1.0, norm)[:, None]).T
    w = np.where(is_zero, 1.0, w)
    matrices = np.empty((len(quaternions), 3, 3))
    matrices[:, 0, 0] = 1 - 2 * (y * y + z * z)
    matrices[:, 0, 1] = 2 * (x * y - z * w)
    matrices[:, 0, 2] = 2 * (x * z + y * w)
    matrices[:, 1, 0] = 2 * (x * y + z * w)
    matrices[:, 1, 1] = 1 - 2 * (x * x + z * z)
    matrices[:, 1, 2] = 2 * (y * z - x * w)
    matrices[:, 2, 0] = 2 * (x * z - y * w)
    matrices[:, 2, 1] = 2 * (y * z + x * w)
    matrices[:, 2, 2] = 1 - 2 * (x * x + y * y)
    # rotations about z alone, the common case, exactly upright
    matrices[is_zero] = np.eye(3)
    return matrices, np.where(is_zero, np.nan, yaw_of(matrices))


def matrices_from_yaw(yaw: Floats) -> Floats:
    """(N, 3, 3) rotations about z by angles (N,) in radians."""
    matrices = np.zeros((len(yaw), 3, 3))
    cosine, sine = np.cos(yaw), np.sin(yaw)
    matrices[:, 0, 0] = matrices[:, 1, 1] = cosine
    matrices[:, 0, 1] = -sine
    matrices[:, 1, 0] = sine
    matrices[:, 2, 2] = 1.0
    return matrices


def no_rotations(count: int) -> Floats:
    """Return identity matrices (count, 3, 3)."""
    matrices = np.zeros((count, 9))
    matrices[:, ::4] = 1.0
    return matrices.reshape(count, 3, 3)


def yaw_of(matrices: Floats) -> Floats:
    """Return the angle (N,) of the projected x axis in radians; NaN if its projection is a point."""
    x, y = matrices[:, 0, 0], matrices[:, 1, 0]
    return np.asarray(np.where(np.hypot(x, y) > _UPRIGHT, np.arctan2(y, x), np.nan))


def is_upright(matrices: Floats) -> Booleans:
    """Return whether (N,) the rotation maps the z axis to itself, up or down."""
    return np.asarray(np.hypot(matrices[:, 0, 2], matrices[:, 1, 2]) <= _UPRIGHT)


def slerp(first: Floats, second: Floats, share: Floats) -> Floats:
    """Interpolate between quaternions at constant angular speed, along the shorter arc.

    Args:
        first, second: (N, 4) x, y, z, w, of any length but 0.
        share: (N,) 0 for the first up to 1 for the second.
    """
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    dot = np.einsum("ij,ij->i", first, second)
    # q and -q are one rotation; the arc to the nearer one is the shorter
    second = np.where(dot[:, None] < 0, -second, second)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    # the quotient below is 0 / 0 for equal quaternions, and linear interpolation is exact enough near them
    is_close = sine < _LEAST_NORM
    divisor = np.where(is_close, 1.0, sine)
    one = np.where(is_close, 1.0 - share, np.sin((1.0 - share) * angle) / divisor)
    other = np.where(is_close, share, np.sin(share * angle) / divisor)
    return np.asarray(one[:, None] * first + other[:, None] * second)


HISTORY_NS = 10 * 10**9
"""How far the transforms before and after a time may lie from it."""

_LONGEST_CHAIN = 100


class Transforms(NamedTuple):
    """N rigid transforms.

    Attributes:
        rotation: (N, 3, 3).
        translation: (N, 3).
        known: (N,) bool; numbers of unknown transforms have no meaning.
    """

    rotation: Floats
    translation: Floats
    known: NDArray[np.bool_]

    @classmethod
    def identity(cls, count: int) -> Transforms:
        rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
        return cls(rotation, np.zeros((count, 3)), np.ones(count, np.bool_))

    @classmethod
    def unknown(cls, count: int) -> Transforms:
        return cls(np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros(count, np.bool_))

    def put(self, places: Integers, others: Transforms) -> None:
        """Replace the transforms in some places, while these are being collected."""
        for whole, part in zip(self, others, strict=True):
            whole[places] = part

    def select(self, places: Integers) -> Transforms:
        return Transforms(self.rotation[places], self.translation[places], self.known[places])

    def after(self, first: Transforms) -> Transforms:
        """Return a_from_c for a_from_b (this) and b_from_c (`first`)."""
        return Transforms(
            self.rotation @ first.rotation,
            np.einsum("nij,nj->ni", self.rotation, first.translation) + self.translation,
            self.known & first.known,
        )

    def inverted(self) -> Transforms:
        """Return b_from_a for a_from_b."""
        rotation = np.swapaxes(self.rotation, 1, 2)
        return Transforms(rotation, -np.einsum("nij,nj->ni", rotation, self.translation), self.known)


@dataclass(slots=True)
class _Child:
    """The transforms of one child frame: stamp, clock, parent and pose of each; and the static one, if
    any."""

    entries: list[tuple[int, int, str, tuple[float, ...]]] = field(default_factory=list)
    parents: dict[str, None] = field(default_factory=dict)
    static: tuple[str, tuple[float, ...]] | None = None


class _Series(NamedTuple):
    """The transforms of one child frame, ordered by stamp or by clock."""

    times_ns: Integers
    parents: list[str]
    poses: Floats


class FrameTree:
    """The transforms of a log, added as they arrive."""

    def __init__(self) -> None:
        self._children: dict[str, _Child] = {}
        self._series: dict[tuple[str, bool], _Series] = {}

    def add(
        self,
        child: str,
        parent: str,
        pose: tuple[float, ...],
        *,
        stamp_ns: int,
        clock_ns: int,
        is_static: bool,
    ) -> None:
        """Add one transform.

        Args:
            pose: x, y, z, then the quaternion x, y, z, w.
            stamp_ns: the time inside the message.
            clock_ns: the time of the message on the clock of the samples.
        """
        entry = self._children.setdefault(child, _Child())
        if is_static:
            entry.static = (parent, pose)
            return
        entry.entries.append((stamp_ns, clock_ns, parent, pose))
        entry.parents.setdefault(parent)
        for by_stamp in (False, True):
            self._series.pop((child, by_stamp), None)

    def forget_before(self, clock_ns: int) -> None:
        """Drop the transforms of messages before a time, except the last one of each child."""
        for child in self._children.values():
            keep = [entry for entry in child.entries if entry[1] >= clock_ns]
            if len(keep) < len(child.entries):
                # the last one names the parent, and may be the start of the next interpolation
                child.entries = keep or child.entries[-1:]
                child.parents = dict.fromkeys(entry[2] for entry in child.entries)
        self._series.clear()

    def forget_moving(self) -> None:
        """Drop every transform but the static ones: nothing is known between those and what comes next."""
        self._children = {name: child for name, child in self._children.items() if child.static is not None}
        self._series.clear()

    @property
    def names(self) -> frozenset[str]:
        """All frames that are a child or a parent of a transform."""
        parents = {parent for child in self._children.values() for parent in child.parents}
        static = {child.static[0] for child in self._children.values() if child.static is not None}
        return frozenset(self._children) | parents | static

    def between(self, target: str, source: str, times_ns: Integers, *, by_stamp: bool) -> Transforms:
        """Return target_from_source at each of N times; unknown where the tree has no transforms.

        Args:
            times_ns: (N,) stamps, or times of messages on the clock of the samples (`by_stamp=False`).
        """
        if target == source or not len(times_ns):
            return Transforms.identity(len(times_ns))
        parts = self._stretches(times_ns, by_stamp)
        if len(parts) == 1:
            return self._in_one_tree(target, source, times_ns, by_stamp)
        result = Transforms.unknown(len(times_ns))
        for part in parts:
            result.put(part, self._in_one_tree(target, source, times_ns[part], by_stamp))
        return result

    def _stretches(self, times_ns: Integers, by_stamp: bool) -> list[Integers]:
        """Return the indices of times in groups within which no frame changes its parent."""
        breaks: set[int] = set()
        for name, child in self._children.items():
            if len(child.parents) > 1:
                series = self._series_of(name, by_stamp)
                breaks.update(
                    int(series.times_ns[i])
                    for i in range(1, len(series.parents))
                    if series.parents[i] != series.parents[i - 1]
                )
        if not breaks:
            return [np.arange(len(times_ns))]
        group = np.searchsorted(np.array(sorted(breaks), np.int64), times_ns, "right")
        return [np.flatnonzero(group == each) for each in np.unique(group)]

    def _in_one_tree(self, target: str, source: str, times_ns: Integers, by_stamp: bool) -> Transforms:
        up = self._ancestors(source, int(times_ns[0]), by_stamp)
        down = self._ancestors(target, int(times_ns[0]), by_stamp)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return Transforms.identity(len(times_ns))._replace(known=np.zeros(len(times_ns), np.bool_))
        common_from_source = self._climb(up[: up.index(common)], times_ns, by_stamp)
        common_from_target = self._climb(down[: down.index(common)], times_ns, by_stamp)
        return common_from_target.inverted().after(common_from_source)

    def _ancestors(self, frame: str, time_ns: int, by_stamp: bool) -> list[str]:
        """Return a frame, its parent, the parent of that and so on, at a time."""
        chain = [frame]
        while len(chain) < _LONGEST_CHAIN:
            parent = self._parent(chain[-1], time_ns, by_stamp)
            # a log may contain cycles
            if parent is None or parent in chain:
                break
            chain.append(parent)
        return chain

    def _parent(self, frame: str, time_ns: int, by_stamp: bool) -> str | None:
        child = self._children.get(frame)
        if child is None:
            return None
        if child.static is not None:
            return child.static[0]
        series = self._series_of(frame, by_stamp)
        at = int(np.searchsorted(series.times_ns, time_ns, "right")) - 1
        return series.parents[max(at, 0)]

    def _climb(self, frames: list[str], times_ns: Integers, by_stamp: bool) -> Transforms:
        """Return the transform from the first frame of a chain into the parent of the last."""
        total = Transforms.identity(len(times_ns))
        for frame in frames:
            total = self._step(frame, times_ns, by_stamp).after(total)
        return total

    def _step(self, frame: str, times_ns: Integers, by_stamp: bool) -> Transforms:
        """Return parent_from_child at each time."""
        child = self._children[frame]
        if child.static is not None:
            poses = np.broadcast_to(np.array(child.static[1], np.float64), (len(times_ns), 7))
            return _transforms(poses[:, :3], poses[:, 3:], np.ones(len(times_ns), np.bool_))
        series = self._series_of(frame, by_stamp)
        last = len(series.times_ns) - 1
        after = np.searchsorted(series.times_ns, times_ns, "left")
        inside = after <= last
        after = np.minimum(after, last)
        before = np.where(series.times_ns[after] == times_ns, after, after - 1)
        known = inside & (before >= 0)
        before = np.maximum(before, 0)
        start, end = series.times_ns[before], series.times_ns[after]
        known &= (times_ns - start <= HISTORY_NS) & (end - times_ns <= HISTORY_NS)
        span = np.where(end > start, end - start, 1)
        share = np.where(end > start, (times_ns - start) / span, 0.0)
        parents = series.parents
        if len(set(parents)) > 1:
            same = [parents[i] == parents[j] for i, j in zip(before.tolist(), after.tolist(), strict=True)]
            # poses in different parents cannot be interpolated; the earlier one holds
            share = np.where(same, share, 0.0)
        first, second = series.poses[before], series.poses[after]
        translation = first[:, :3] + share[:, None] * (second[:, :3] - first[:, :3])
        rotation = np.where(
            (share == 0.0)[:, None],
            first[:, 3:],
            slerp(_not_zero(first[:, 3:]), _not_zero(second[:, 3:]), share),
        )
        return _transforms(translation, rotation, known)

    def _series_of(self, frame: str, by_stamp: bool) -> _Series:
        """Return the transforms of a child in order; of equal times, the later entry counts."""
        series = self._series.get((frame, by_stamp))
        if series is None:
            child = self._children[frame]
            times = np.array([entry[0 if by_stamp else 1] for entry in child.entries], np.int64)
            order = np.argsort(times, kind="stable")
            ordered = times[order]
            keep = order[np.append(ordered[1:] != ordered[:-1], True)[: len(ordered)]]
            series = _Series(
                times[keep],
                [child.entries[i][2] for i in keep.tolist()],
                np.array([child.entries[i][3] for i in keep.tolist()], np.float64).reshape(-1, 7),
            )
            self._series[frame, by_stamp] = series
        return series


def _transforms(translation: Floats, quaternions: Floats, known: NDArray[np.bool_]) -> Transforms:
    rotation, _ = matrices_from_quaternions(np.ascontiguousarray(quaternions))
    finite = np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(translation).all(axis=1)
    return Transforms(rotation, np.asarray(translation), known & finite)


def _not_zero(quaternions: Floats) -> Floats:
    """Replace quaternions of zeros by no rotation."""
    zero = np.einsum("ij,ij->i", quaternions, quaternions) == 0.0
    return np.where(zero[:, None], np.array([0.0, 0.0, 0.0, 1.0]), quaternions)


_SECONDS = ("sec", "secs", "seconds")
_REST = ("nanosec", "nsec", "nsecs", "nanos")


class TransformReader:
    """Reads the transforms in the messages of one topic, in the types of ROS 1, ROS 2 and Foxglove."""

    def __init__(self) -> None:
        self._list: Get | None = None
        self._get: Get | None = None

    def add(self, tree: FrameTree, message: object, clock_ns: int, *, is_static: bool) -> None:
        """Add the transforms of a message to a tree.

        Raises:
            FieldError, AttributeError, LookupError, TypeError, ValueError: the message holds no transforms.
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
        """Return the stamp of the first transform of a message; None if there is no transform."""
        for transform in self._each(message):
            _, _, seconds, rest, *_ = self._values(transform)
            return _nanoseconds(seconds, rest)
        return None

    def _each(self, message: object) -> Iterator[Any]:
        if self._list is None:
            has_list = "transforms" in field_names(message)
            path, style = FieldPath.of("transforms"), style_of(message)
            self._list = getter(path, style) if has_list else lambda one: (one,)
        return iter(self._list(message))

    def _values(self, transform: Any) -> Sequence[Any]:
        self._get = self._get or _getter(transform)
        values: Sequence[Any] = self._get(transform)
        return values


def _getter(example: object) -> Get:
    """Return a getter for child, parent, seconds, nanoseconds, x, y, z and the quaternion x, y, z, w."""
    names = field_names(example)
    in_header = "header" in names
    stamp, parent = ("header.stamp", "header.frame_id") if in_header else ("timestamp", "parent_frame_id")
    place = "transform." if "transform" in names else ""
    paths = ["child_frame_id", parent]
    for parts in (_SECONDS, _REST):
        fields = [f"{stamp}.{part}" for part in parts]
        existing = [each for each in fields if leads_somewhere(FieldPath.of(each), example)]
        if not existing:
            raise FieldError(f"{stamp} is not a time; a transform has a stamp")
        paths.append(existing[0])
    paths += [f"{place}translation.{axis}" for axis in "xyz"]
    paths += [f"{place}rotation.{axis}" for axis in "xyzw"]
    return tuple_getter([FieldPath.of(path) for path in paths], style_of(example))


def _nanoseconds(seconds: Any, rest: Any) -> int:
    time_ns = int(seconds) * 1_000_000_000 + int(rest)
    if abs(time_ns) > LATEST_NS:
        raise FieldError(f"its stamp {time_ns} ns lies outside the times of a log")
    return time_ns
