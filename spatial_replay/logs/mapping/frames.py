"""Frames: transforms as a log reports them, and between any two frames at any time.

A transform places a child frame in its parent. Between two transforms of a child, translation is interpolated
linearly and rotation along the shorter arc, as tf2 does; there is no extrapolation. A static one holds at
all times.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.logs.mapping.rotation import matrices_from_quaternions, slerp

HISTORY_NS = 10 * 10**9
"""How far transforms may lie from the time that is asked for, before or after it."""

_LONGEST_CHAIN = 100


class Transforms(NamedTuple):
    """N rigid motions.

    Attributes:
        rotation: (N, 3, 3).
        translation: (N, 3).
        known: (N,) bool; where not, the numbers mean nothing.
    """

    rotation: Floats
    translation: Floats
    known: NDArray[np.bool_]

    @classmethod
    def identity(cls, count: int) -> Transforms:
        rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
        return cls(rotation, np.zeros((count, 3)), np.ones(count, np.bool_))

    def after(self, first: Transforms) -> Transforms:
        """a_from_c of a_from_b (this) and b_from_c (`first`)."""
        return Transforms(
            self.rotation @ first.rotation,
            np.einsum("nij,nj->ni", self.rotation, first.translation) + self.translation,
            self.known & first.known,
        )

    def inverted(self) -> Transforms:
        """b_from_a of a_from_b."""
        rotation = np.swapaxes(self.rotation, 1, 2)
        return Transforms(rotation, -np.einsum("nij,nj->ni", rotation, self.translation), self.known)


@dataclass(slots=True)
class _Child:
    """Every transform of one child frame: stamp, clock, parent, pose; and the static one, if there is one."""

    entries: list[tuple[int, int, str, tuple[float, ...]]] = field(default_factory=list)
    parents: dict[str, None] = field(default_factory=dict)
    static: tuple[str, tuple[float, ...]] | None = None


class _Series(NamedTuple):
    """Transforms of one child, by one of its two times."""

    times_ns: Integers
    parents: list[str]
    poses: Floats


class FrameTree:
    """The transforms of a log, as they come."""

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
        """Take one transform.

        Args:
            pose: x, y, z, then the quaternion x, y, z, w.
            stamp_ns: the time inside the message.
            clock_ns: the time of the message on the clock of the samples.
        """
        kept = self._children.get(child)
        if kept is None:
            kept = self._children[child] = _Child()
        if is_static:
            kept.static = (parent, pose)
            return
        kept.entries.append((stamp_ns, clock_ns, parent, pose))
        if parent not in kept.parents:
            kept.parents[parent] = None
        if self._series:
            self._series.clear()

    def forget_before(self, clock_ns: int) -> None:
        """Drop transforms of messages before a time, but for the last one of each child."""
        for child in self._children.values():
            keep = [entry for entry in child.entries if entry[1] >= clock_ns]
            if len(keep) < len(child.entries):
                child.entries = keep or child.entries[-1:]
                child.parents = dict.fromkeys(entry[2] for entry in child.entries)
        self._series.clear()

    @property
    def names(self) -> frozenset[str]:
        """Every frame that is a child or a parent of some transform."""
        parents = {parent for child in self._children.values() for parent in child.parents}
        static = {child.static[0] for child in self._children.values() if child.static is not None}
        return frozenset(self._children) | parents | static

    def between(self, target: str, source: str, times_ns: Integers, *, by_stamp: bool) -> Transforms:
        """target_from_source at each of N times; not known where the tree does not say.

        Args:
            times_ns: (N,) on the clock of the stamps, or of the messages (`by_stamp=False`).
        """
        if target == source or not len(times_ns):
            return Transforms.identity(len(times_ns))
        parts = self._stretches(times_ns, by_stamp)
        if len(parts) == 1:
            return self._in_one_tree(target, source, times_ns, by_stamp)
        result = Transforms(
            np.zeros((len(times_ns), 3, 3)), np.zeros((len(times_ns), 3)), np.zeros(len(times_ns), np.bool_)
        )
        for part in parts:
            found = self._in_one_tree(target, source, times_ns[part], by_stamp)
            for whole, piece in zip(result, found, strict=True):
                whole[part] = piece
        return result

    def _stretches(self, times_ns: Integers, by_stamp: bool) -> list[Integers]:
        """The times in groups between which no frame changes its parent."""
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
            unknown = Transforms.identity(len(times_ns))
            return unknown._replace(known=np.zeros(len(times_ns), np.bool_))
        common_from_source = self._climb(up[: up.index(common)], times_ns, by_stamp)
        common_from_target = self._climb(down[: down.index(common)], times_ns, by_stamp)
        return common_from_target.inverted().after(common_from_source)

    def _ancestors(self, frame: str, time_ns: int, by_stamp: bool) -> list[str]:
        """A frame, its parent, the parent's parent and so on, around a time."""
        chain = [frame]
        while len(chain) < _LONGEST_CHAIN:
            parent = self._parent(chain[-1], time_ns, by_stamp)
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
        """The transform into the parent of the last of some frames, each the parent of the one before."""
        total = Transforms.identity(len(times_ns))
        for frame in frames:
            total = self._step(frame, times_ns, by_stamp).after(total)
        return total

    def _step(self, frame: str, times_ns: Integers, by_stamp: bool) -> Transforms:
        """parent_from_child at each time."""
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
        """The transforms of a child in order; of equal times, the later one counts."""
        found = self._series.get((frame, by_stamp))
        if found is None:
            child = self._children[frame]
            times = np.array([entry[0 if by_stamp else 1] for entry in child.entries], np.int64)
            order = np.argsort(times, kind="stable")
            ordered = times[order]
            keep = order[np.append(ordered[1:] != ordered[:-1], True)[: len(ordered)]]
            found = _Series(
                times[keep],
                [child.entries[i][2] for i in keep.tolist()],
                np.array([child.entries[i][3] for i in keep.tolist()], np.float64).reshape(-1, 7),
            )
            self._series[frame, by_stamp] = found
        return found


def _transforms(translation: Floats, quaternions: Floats, known: NDArray[np.bool_]) -> Transforms:
    rotation, _ = matrices_from_quaternions(np.ascontiguousarray(quaternions))
    finite = np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(translation).all(axis=1)
    return Transforms(rotation, np.asarray(translation), known & finite)


def _not_zero(quaternions: Floats) -> Floats:
    """Quaternions of zeros as no rotation."""
    zero = np.einsum("ij,ij->i", quaternions, quaternions) == 0.0
    return np.where(zero[:, None], np.array([0.0, 0.0, 0.0, 1.0]), quaternions)
