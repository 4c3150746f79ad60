"""Trees of frames: messages with transforms in, the transform between any two frames at any time out.

A transform places a child frame in its parent. Between two transforms of a child, translation is interpolated
linearly and rotation along the shorter arc, as in tf2. There is no extrapolation. A static transform holds
until another static transform replaces it.

A step back of the stamps begins a new run, such as a restarted simulation. Only static transforms hold across
runs. Rotations are quaternions (x, y, z, w) or matrices, in arrays.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import compress
from math import hypot, inf, isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.bags.reader import DISORDER_NS
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.mapping.field_paths import (
    FieldError,
    FieldPath,
    Get,
    field_names,
    getter,
    leads_somewhere,
    tuple_getter,
)
from spatial_replay.text import Instant, Sentence, plural
from spatial_replay.trace.trace import LATEST_NS

_LEAST_NORM = 1e-6
_UPRIGHT = 1e-9


def matrices_from_quaternions(quaternions: Floats) -> tuple[Floats, Floats]:
    """Convert quaternions of any length to rotation matrices.

    A quaternion of zeros, the default of messages, means no rotation.

    Args:
        quaternions: (N, 4) x, y, z, w.

    Returns:
        (N, 3, 3) a_from_b matrices, whose columns are the axes of b, and (N,) angles of the projected x axes
        in radians. The angle is NaN for quaternions of zeros.
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
    # the matrix is exactly the identity, also for norms between 0 and the limit
    matrices[is_zero] = np.eye(3)
    return matrices, np.where(is_zero, np.nan, yaw_of(matrices))


def matrices_from_yaw(yaw: Floats) -> Floats:
    """Return rotations (N, 3, 3) about z by angles (N,) in radians."""
    matrices = np.zeros((len(yaw), 3, 3))
    cosine, sine = np.cos(yaw), np.sin(yaw)
    matrices[:, 0, 0] = matrices[:, 1, 1] = cosine
    matrices[:, 0, 1] = -sine
    matrices[:, 1, 0] = sine
    matrices[:, 2, 2] = 1.0
    return matrices


def no_rotations(count: int) -> Floats:
    """Return identity matrices (count, 3, 3)."""
    return np.tile(np.eye(3), (count, 1, 1))


def yaw_of(matrices: Floats) -> Floats:
    """Return the angle (N,) of the x axis in the plane, in radians; NaN if the axis is vertical."""
    x, y = matrices[:, 0, 0], matrices[:, 1, 0]
    return np.asarray(np.where(np.hypot(x, y) > _UPRIGHT, np.arctan2(y, x), np.nan))


def is_upright(matrices: Floats) -> Booleans:
    """Return for each rotation (N,) whether the z axis stays vertical, up or down."""
    return np.asarray(np.hypot(matrices[:, 0, 2], matrices[:, 1, 2]) <= _UPRIGHT)


def slerp(first: Floats, second: Floats, share: Floats) -> Floats:
    """Interpolate between quaternions at constant angular speed, along the shorter arc.

    Args:
        first, second: (N, 4) x, y, z, w, of any length above 0.
        share: (N,) from 0 for `first` to 1 for `second`.
    """
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    dot_product = np.einsum("ij,ij->i", first, second)
    # q and -q are the same rotation; the shorter arc ends at the nearer quaternion
    second = np.where(dot_product[:, None] < 0, -second, second)
    angle = np.arccos(np.clip(np.abs(dot_product), 0.0, 1.0))
    sine = np.sin(angle)
    # linear interpolation for nearly equal quaternions, because the quotient below tends to 0 / 0
    is_close = sine < _LEAST_NORM
    divisor = np.where(is_close, 1.0, sine)
    weight = np.where(is_close, 1.0 - share, np.sin((1.0 - share) * angle) / divisor)
    next_weight = np.where(is_close, share, np.sin(share * angle) / divisor)
    return np.asarray(weight[:, None] * first + next_weight[:, None] * second)


# a buffer of tf2 keeps transforms for 10 s by default, too
HISTORY_NS = 10 * 10**9
"""Longest gap between two transforms that interpolation bridges, nanoseconds."""

_LONGEST_CHAIN = 100
"""Limit of frames between a frame and its root."""
_OFF_LENGTH = 0.01
"""Largest error of a quaternion's squared length, as in tf2."""
_LEAST_JUMP = 0.1
"""Least jump of a frame: distance in metres plus turn in radians."""
_MANY_JUMPS = 3
"""Least number of jumps of a frame for a remark."""
_MOST_PUBLISHERS = 4
"""Limit of publishers that may send a frame in turn."""
LEAST_STEP_NS = 10_000_000
"""Least step back of a clock, nanoseconds. Smaller steps occur in the logs of recorders with several
threads."""
_MOST_RESTARTS = 1_000
"""Limit of kept restarts."""


class Transforms(NamedTuple):
    """N rigid transforms.

    Attributes:
        rotation: (N, 3, 3).
        translation: (N, 3).
        known: (N,) whether a transform is known. Rotation and translation of unknown transforms have no
            meaning.
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
        """Overwrite the transforms at some indices, in place."""
        for column, other_column in zip(self, others, strict=True):
            column[places] = other_column

    def select(self, places: Integers) -> Transforms:
        return Transforms(self.rotation[places], self.translation[places], self.known[places])

    def after(self, first: Transforms) -> Transforms:
        """Return a_from_c for a_from_b (self) and b_from_c (`first`)."""
        return Transforms(
            self.rotation @ first.rotation,
            np.einsum("nij,nj->ni", self.rotation, first.translation) + self.translation,
            self.known & first.known,
        )

    def inverse(self) -> Transforms:
        """Return b_from_a for a_from_b (self)."""
        rotation = np.swapaxes(self.rotation, 1, 2)
        return Transforms(rotation, -np.einsum("nij,nj->ni", rotation, self.translation), self.known)


class _Entry(NamedTuple):
    """One transform of a child frame; the pose is x, y, z, then the quaternion x, y, z, w."""

    stamp_ns: int
    clock_ns: int
    parent: str
    pose: tuple[float, ...]
    log_ns: int


class _Restart(NamedTuple):
    """A step back of the stamps: the last transform before the step, and the first transform after it."""

    old: _Entry
    new: _Entry


@dataclass(slots=True)
class _Child:
    """The transforms of one child frame.

    Attributes:
        restart: step back of the stamps at the last transform; None without a step back.
    """

    moving: list[_Entry] = field(default_factory=list)
    static: list[_Entry] = field(default_factory=list)
    restart: _Restart | None = None

    @property
    def entries(self) -> list[_Entry]:
        return [*self.static, *self.moving]


class _Series(NamedTuple):
    """The transforms of one child frame, ordered by stamp or by clock.

    Attributes:
        still: number of static transforms, which come first and are not interpolated.
        parents: names of parents.
        parent: index of each transform's parent in `parents`.
    """

    still: int
    times_ns: Integers
    clock_ns: Integers
    parents: list[str]
    parent: Integers
    poses: Floats

    def at(self, times_ns: Integers) -> Integers:
        """Return the index of the last transform up to each time; 0 before the first transform."""
        return np.maximum(np.searchsorted(self.times_ns, times_ns, "right") - 1, 0)


class FrameTree:
    """The transforms of a log, added in order of arrival; `remarks` lists their contradictions."""

    def __init__(self) -> None:
        self._children: dict[str, _Child] = {}
        self._series: dict[str, dict[tuple[str, int | None], _Series]] = {}
        self._restarts: list[_Restart] = []
        self.newest_stamp_ns = 0
        """Stamp of the last added transform that is not static."""
        self._ignored: dict[str, tuple[int, _Entry, str]] = {}
        self._steps: dict[str, tuple[int, _Entry, _Entry]] = {}
        self._contradictions: dict[tuple[str, bool, bool], Sentence] = {}
        self._jumps: dict[str, tuple[int, float, _Entry, _Entry]] = {}
        self._holes: dict[str, tuple[int, int]] = {}
        self._loops: dict[tuple[str, ...], None] = {}

    def add(
        self,
        child: str,
        parent: str,
        pose: tuple[float, ...],
        *,
        stamp_ns: int,
        clock_ns: int,
        log_ns: int,
        is_static: bool,
    ) -> None:
        """Add one transform. A transform that tf2 would ignore is only counted.

        A static transform holds from its stamp on. A frame's first static transform also holds before its
        stamp. If a static transform has no stamp, or an older stamp than the previous static transform, it
        holds from its clock time on.

        Args:
            pose: x, y, z, then the quaternion x, y, z, w.
            stamp_ns: stamp in the message.
            clock_ns: time of the message on the clock of the samples.
            log_ns: time of recording.
        """
        entry = _Entry(stamp_ns, clock_ns, parent, pose, log_ns)
        if (reason := _reason_to_ignore(child, entry)) is not None:
            ignored_count, first_entry, first_child = self._ignored.get(reason, (0, entry, child))
            self._ignored[reason] = ignored_count + 1, first_entry, first_child
            return
        frame = self._children.setdefault(child, _Child())
        if is_static:
            if frame.static and frame.static[-1][2:4] == entry[2:4]:
                return
            last_ns = frame.static[-1].stamp_ns if frame.static else -1
            if stamp_ns == 0 or stamp_ns < last_ns:
                entry = entry._replace(stamp_ns=max(clock_ns, last_ns))
        entries, other_entries = (frame.static, frame.moving)[:: 1 if is_static else -1]
        if entries and (is_static or entries[-1].parent != parent):
            self._contradict(child, entries[-1], entry)
        if other_entries and not entries:
            self._contradict(child, other_entries[-1], entry, is_mixed=True)
        if not is_static:
            self.newest_stamp_ns = stamp_ns
            if frame.moving:
                self._note_restart(child, frame, entry)
        entries.append(entry)
        self._series.pop(child, None)

    def _note_restart(self, name: str, child: _Child, new: _Entry) -> None:
        """Note a restart if the stamps of a frame step back.

        If the next transform steps forward again, two programs with different clocks send the frame in turn.
        Then the noted restart is removed.
        """
        old, earlier_restart, child.restart = child.moving[-1], child.restart, None
        if earlier_restart in self._restarts and new.stamp_ns >= earlier_restart.old.stamp_ns - DISORDER_NS:
            self._restarts.remove(earlier_restart)
            # cached series depend on the runs
            self._series.clear()
        if new.stamp_ns >= old.stamp_ns - DISORDER_NS or new.log_ns < old.log_ns:
            if new.stamp_ns < old.stamp_ns - LEAST_STEP_NS:
                step_count, *first_step = self._steps.get(name, (0, old, new))
                self._steps[name] = step_count + 1, first_step[0], first_step[1]
            return
        restart = child.restart = _Restart(old, new)
        if self._restarts and self._restarts[-1].new.log_ns > old.log_ns:
            # after one restart, all frames step back one after the other
            restart = min(restart, self._restarts.pop(), key=lambda restart: restart.new.log_ns)
        self._restarts = [*self._restarts[1 - _MOST_RESTARTS :], restart]
        self._series.clear()

    def forget_before(self, clock_ns: int) -> None:
        """Drop moving transforms of messages before a time, except each child's last transform."""
        for name, child in self._children.items():
            newer_entries = [entry for entry in child.moving if entry.clock_ns >= clock_ns]
            if len(newer_entries) < len(child.moving):
                self._look_for_jumps(name, [entry for entry in child.moving if entry.clock_ns < clock_ns])
                # the last transform gives the parent, and the start of the next interpolation
                child.moving = newer_entries or child.moving[-1:]
        self._series.clear()

    def forget_moving(self) -> None:
        """Drop all moving transforms, so that nothing is interpolated across a loss."""
        self._children = {
            name: _Child(static=child.static) for name, child in self._children.items() if child.static
        }
        self._series.clear()

    @property
    def names(self) -> frozenset[str]:
        """Names of all frames that are the child or parent of a transform."""
        parents = {entry.parent for child in self._children.values() for entry in child.entries}
        # frames of ignored transforms are frames of the log, too
        ignored_names = {name for _, entry, child in self._ignored.values() for name in (child, entry.parent)}
        return frozenset(self._children) | parents | ignored_names

    def between(
        self,
        target: str,
        source: str,
        times_ns: Integers,
        *,
        by_stamp: bool,
        log_ns: Integers | None = None,
        longest_ns: int = HISTORY_NS,
        holds: bool = False,
    ) -> Transforms:
        """Return target_from_source at each of N times; unknown at times without transforms.

        Args:
            times_ns: (N,) stamps, or times of messages on the clock of the samples (`by_stamp=False`).
            log_ns: (N,) times of recording, which identify the run; None for transforms of all runs.
            longest_ns: longest gap between two transforms that interpolation bridges, nanoseconds.
            holds: whether a transform holds for `longest_ns` if no transform follows in that time.
        """
        time_count = len(times_ns)
        if target == source or not time_count:
            return Transforms.identity(time_count)
        question = _Question(
            np.arange(time_count), times_ns, log_ns, by_stamp, min(longest_ns, HISTORY_NS), holds
        )
        transforms = Transforms.unknown(time_count)
        for run_question in self._by_run(question):
            for part_question in self._by_parents(run_question):
                transforms.put(part_question.places, self._in_one_tree(target, source, part_question))
        return transforms

    def _by_run(self, question: _Question) -> list[_Question]:
        """Divide a question by run, and by whether stamps are near the times of recording."""
        times_ns, log_ns = question.times_ns, question.log_ns
        if log_ns is None:
            return [question]
        runs = np.searchsorted([restart.new.log_ns for restart in self._restarts], log_ns, "right")
        if question.by_stamp:
            for run, (old, new) in enumerate(self._restarts, 1):
                # an observation may come before the first transform of its run
                is_early = np.abs(times_ns - new.stamp_ns) < np.abs(times_ns - old.stamp_ns)
                runs[is_early & (log_ns > old.log_ns) & (log_ns < new.log_ns)] = run
        # even numbers: stamps near the times of recording; odd numbers: stamps far from these times
        run_kinds = 2 * runs + (question.by_stamp & (np.abs(log_ns - times_ns) > HISTORY_NS))
        return [
            question.part(run_kinds == run_kind)._replace(run=run_kind // 2, is_apart=run_kind % 2 > 0)
            for run_kind in np.unique(run_kinds).tolist()
        ]

    def _by_parents(self, question: _Question) -> list[_Question]:
        """Divide a question into parts in which each frame has a single parent."""
        parent_columns = [np.zeros(len(question.times_ns), np.int64)]
        for name in self._children:
            series, times_ns = self._series_of(name, question)
            if len(series.parents) > 1:
                parent_columns.append(series.parent[series.at(times_ns)])
        if len(parent_columns) == 1:
            return [question]
        _, group_of_time = np.unique(np.stack(parent_columns), axis=1, return_inverse=True)
        group_of_time = group_of_time.reshape(-1)
        return [question.part(group_of_time == group) for group in range(int(group_of_time.max()) + 1)]

    def _in_one_tree(self, target: str, source: str, question: _Question) -> Transforms:
        source_ancestors = self._ancestors(source, question)
        target_ancestors = self._ancestors(target, question)
        common_frame = next((frame for frame in source_ancestors if frame in target_ancestors), None)
        if common_frame is None:
            return Transforms.unknown(len(question.times_ns))
        common_from_source = self._climb(source_ancestors[: source_ancestors.index(common_frame)], question)
        common_from_target = self._climb(target_ancestors[: target_ancestors.index(common_frame)], question)
        return common_from_target.inverse().after(common_from_source)

    def _ancestors(self, frame: str, question: _Question) -> list[str]:
        """Return a frame and all its ancestors up to the root, at the first time of the question."""
        chain = [frame]
        while len(chain) < _LONGEST_CHAIN:
            series, times_ns = self._series_of(chain[-1], question)
            if not series.parents:
                break
            parent = series.parents[int(series.parent[series.at(times_ns[:1])][0])]
            if parent in chain:
                loop = chain[chain.index(parent) :]
                first_index = loop.index(min(loop))
                self._loops.setdefault((*loop[first_index:], *loop[: first_index + 1]))
                break
            chain.append(parent)
        return chain

    def _climb(self, frames: list[str], question: _Question) -> Transforms:
        """Return the transforms from the first frame of a chain to the last frame's parent."""
        transforms = Transforms.identity(len(question.times_ns))
        for frame in frames:
            transforms = self._step(frame, question).after(transforms)
        return transforms

    def _step(self, frame: str, question: _Question) -> Transforms:
        """Return parent_from_child at each time of a question, for one child frame."""
        series, times_ns = self._series_of(frame, question)
        last_index, newest_indices = len(series.times_ns) - 1, series.at(times_ns)
        is_still = newest_indices < series.still
        if is_still.all():
            poses = series.poses[newest_indices]
            return _transforms(poses[:, :3], poses[:, 3:], is_still)
        next_indices = np.searchsorted(series.times_ns, times_ns, "left")
        is_inside = next_indices <= last_index
        next_indices = np.minimum(next_indices, last_index)
        # nothing is interpolated at the time of a transform
        previous_indices = np.where(
            is_inside & (series.times_ns[next_indices] == times_ns), next_indices, next_indices - is_inside
        )
        is_known = (previous_indices >= 0) | is_still
        previous_indices, next_indices = (
            np.where(is_still, newest_indices, np.maximum(previous_indices, 0)),
            np.where(is_still, newest_indices, next_indices),
        )
        start_ns, end_ns = series.times_ns[previous_indices], series.times_ns[next_indices]
        is_hole = end_ns - start_ns > question.longest_ns
        if (is_known & is_inside & is_hole).any():
            longest_ns = int((end_ns - start_ns)[is_known & is_inside].max())
            hole_ns = int(series.clock_ns[previous_indices][is_known & is_inside & is_hole][0])
            if longest_ns > self._holes.get(frame, (0, 0))[0]:
                self._holes[frame] = longest_ns, hole_ns
        is_between = is_inside & ~is_hole
        is_held = question.holds & ~is_between & (times_ns - start_ns <= question.longest_ns)
        is_known &= is_between | is_held
        span_ns = np.where(end_ns > start_ns, end_ns - start_ns, 1)
        # poses in different parents are not interpolated; the earlier pose holds
        is_moving = (
            is_between
            & (end_ns > start_ns)
            & (series.parent[previous_indices] == series.parent[next_indices])
        )
        share = np.where(is_moving, (times_ns - start_ns) / span_ns, 0.0)
        start_poses, end_poses = series.poses[previous_indices], series.poses[next_indices]
        translation = start_poses[:, :3] + share[:, None] * (end_poses[:, :3] - start_poses[:, :3])
        quaternions = slerp(start_poses[:, 3:], end_poses[:, 3:], share)
        return _transforms(
            translation, np.where((share == 0.0)[:, None], start_poses[:, 3:], quaternions), is_known
        )

    def _series_of(self, frame: str, question: _Question) -> tuple[_Series, Integers]:
        """Return a frame's ordered transforms for a question, and the times to look up.

        Static transforms of all runs are used up to the frame's first moving transform. If stamps are far
        from times of recording, a frame without moving transforms is looked up by the time of recording.
        """
        child = self._children.get(frame, _Child())
        clock, run, times_ns = (
            "stamp_ns" if question.by_stamp else "clock_ns",
            question.run,
            question.times_ns,
        )
        if not child.moving:
            run = None
            if question.is_apart and question.log_ns is not None:
                clock, times_ns = "log_ns", question.log_ns
        series_of_frame = self._series.setdefault(frame, {})
        if (clock, run) not in series_of_frame:
            moving = [entry for entry in child.moving if run is None or self._run_of(entry) == run]
            first_ns = min((getattr(entry, clock) for entry in moving), default=inf)
            static = [entry for entry in child.static if getattr(entry, clock) < first_ns]
            series_of_frame[clock, run] = _series([*static, *moving], clock, first_ns)
        return series_of_frame[clock, run], times_ns

    def _run_of(self, entry: _Entry) -> int:
        return bisect_right(self._restarts, entry.log_ns, key=lambda restart: restart.new.log_ns)

    def _contradict(self, child: str, old: _Entry, new: _Entry, *, is_mixed: bool = False) -> None:
        """Note a frame's first contradiction of each kind: static and moving, two parents, changed static."""
        contradiction = child, is_mixed, old.parent == new.parent
        if contradiction in self._contradictions:
            return
        subject, rule = f"frame {child!r} has two parents,", "newest counts"
        parent_places = " and ".join(f"{entry.parent!r} at {_place(entry)}" for entry in (old, new))
        if is_mixed:
            subject, rule = f"frame {child!r} is sent static and moving, in", "moving ones count"
        elif old.parent == new.parent:
            subject = f"the static transform of {child!r} in {new.parent!r} changes"
            parent_places = f"from {_place(old)} to {_place(new)}"
        second_since = Instant(new.clock_ns, 0)
        self._contradictions[contradiction] = Sentence(
            f"{subject} {parent_places}, the second from ", second_since, f" on: the {rule}"
        )

    def _look_for_jumps(self, name: str, entries: list[_Entry]) -> None:
        """Count a child's jumps: transforms far from both neighbours, while the neighbours agree."""
        parent_runs = [(entry.parent, self._run_of(entry)) for entry in entries]
        for parent_run in dict.fromkeys(parent_runs):
            self._look_for_jumps_in(
                name,
                sorted(
                    compress(entries, (entry_parent_run == parent_run for entry_parent_run in parent_runs))
                ),
            )

    def _look_for_jumps_in(self, name: str, entries: list[_Entry]) -> None:
        if len(entries) < _MANY_JUMPS:
            return
        poses = np.array([entry.pose for entry in entries])

        def apart(first: Floats, second: Floats) -> Floats:
            # the absolute value is taken, because q and -q are the same rotation
            cosine = np.abs(np.einsum("ij,ij->i", first[:, 3:], second[:, 3:]))
            turns = 2 * np.arccos(np.minimum(cosine, 1.0))
            return np.asarray(np.linalg.norm(first[:, :3] - second[:, :3], axis=1) + turns)

        # poses of other publishers may come between two poses of one publisher
        lags = range(2, min(_MOST_PUBLISHERS, len(poses) - 1) + 1)
        distances_by_lag = {lag: apart(poses[lag:], poses[:-lag]) for lag in (1, *lags)}
        usual_distance = min(float(np.quantile(distances, 0.3)) for distances in distances_by_lag.values())

        def jumps_of(factor: int) -> Integers:
            is_jump = np.zeros(len(poses), np.bool_)
            for lag in lags:
                returns = distances_by_lag[lag]
                distances_between = [distances_by_lag[step][: len(returns)] for step in range(1, lag)]
                distances_between += [
                    distances_by_lag[step][lag - step :][: len(returns)] for step in range(1, lag)
                ]
                least_distances = np.min(distances_between, axis=0)
                is_jump[: len(returns)] |= (least_distances > max(_LEAST_JUMP, factor * usual_distance)) & (
                    returns * factor < least_distances
                )
            return np.flatnonzero(is_jump)

        # noise causes few jumps, and almost no jumps of ten times the usual motion
        jumps = jumps_of(5)
        jumps = jumps if len(jumps) > 0.05 * len(poses) else jumps_of(10)
        if len(jumps):
            least_distances = distances_by_lag[1][jumps]
            first_jump = int(jumps[0])
            jump_count, greatest_jump, *example = self._jumps.get(
                name, (0, 0.0, entries[first_jump], entries[first_jump + 1])
            )
            greatest_jump = max(greatest_jump, float(least_distances.max()))
            self._jumps[name] = jump_count + len(jumps), greatest_jump, example[0], example[1]

    def remarks(self) -> list[str]:
        """Return remarks on transforms that are ignored, contradict each other, jump or pause."""
        for name, child in self._children.items():
            self._look_for_jumps(name, child.moving)
        texts: list[str] = []
        for reason, (entry_count, first_entry, child_name) in self._ignored.items():
            subject = "transform was" if entry_count == 1 else "transforms were"
            clause = f", the first of {child_name!r} in {first_entry.parent!r} at "
            texts.append(
                Sentence(
                    f"{entry_count} {subject} left out{clause}",
                    Instant(first_entry.clock_ns, 0),
                    f": {reason}",
                )
            )
        texts += self._contradictions.values()
        child_restarts = [child.restart for child in self._children.values()]
        if restarts := [restart for restart in self._restarts if restart not in child_restarts]:
            rule = "earlier ones do not count from there on; cut the log there to evaluate each run by itself"
            consequence = f", as when a simulation restarts: {rule}"
            texts.append(_stepping("transforms", len(restarts), *restarts[0], consequence))
        if self._steps:
            name, (entry_count, old, new) = min(self._steps.items(), key=lambda step: step[1][2].clock_ns)
            other_count = len(self._steps) - 1
            clause = f"{name!r} and {plural(other_count, 'other frame')}" if other_count else repr(name)
            rule = (
                "they are sorted by stamp, as if of two senders; if a clock was set back, cut the log there"
            )
            texts.append(_stepping(clause, entry_count, old, new, f": {rule}"))
        for name, (entry_count, greatest_jump, old, new) in sorted(self._jumps.items()):
            if entry_count < _MANY_JUMPS:
                continue
            texts.append(
                Sentence(
                    f"frame {name!r} jumps in {new.parent!r} by up to {greatest_jump:.3g} and back,"
                    f" {entry_count} times, such as from {_place(old)} to {_place(new)} at ",
                    Instant(new.clock_ns, 0),
                    ": if several programs send it, the newest counts",
                )
            )
        for loop in self._loops:
            texts.append(f"frames form a loop, {' in '.join(map(repr, loop))}: what they place is unknown")
        for name, (longest_ns, hole_ns) in sorted(self._holes.items()):
            remedy = "; a larger `max_age` interpolates over it" if longest_ns <= HISTORY_NS else ""
            texts.append(
                Sentence(
                    f"the transforms of {name!r} pause for up to {longest_ns / 1e9:.3f} s, longest from ",
                    Instant(hole_ns, 0),
                    f" on, longer than max_age: what they place is unknown there{remedy}",
                )
            )
        return texts


class _Question(NamedTuple):
    """A request for transforms at some times; see `FrameTree.between`.

    Attributes:
        places: index of each time in the original question.
        run: number of the run; None for all runs.
        is_apart: whether stamps are far from the times of recording.
    """

    places: Integers
    times_ns: Integers
    log_ns: Integers | None
    by_stamp: bool
    longest_ns: int
    holds: bool
    run: int | None = None
    is_apart: bool = False

    def part(self, selected: Booleans) -> _Question:
        log_ns = None if self.log_ns is None else self.log_ns[selected]
        return self._replace(places=self.places[selected], times_ns=self.times_ns[selected], log_ns=log_ns)


def _series(entries: Sequence[_Entry], clock: str, first_ns: float) -> _Series:
    """Return transforms in the order of a clock, and only the last of transforms with equal times.

    Args:
        clock: name of the entries' attribute with the time.
        first_ns: time before which transforms are static.
    """
    times_ns = np.array([getattr(entry, clock) for entry in entries], np.int64)
    time_order = np.argsort(times_ns, kind="stable")
    ordered_ns = times_ns[time_order]
    last_indices = time_order[np.append(ordered_ns[1:] != ordered_ns[:-1], True)[: len(time_order)]]
    distinct_entries = [entries[i] for i in last_indices.tolist()]
    parent_numbers = {
        parent: index
        for index, parent in enumerate(dict.fromkeys(entry.parent for entry in distinct_entries))
    }
    return _Series(
        int(np.count_nonzero(times_ns[last_indices] < first_ns)),
        times_ns[last_indices],
        np.array([entry.clock_ns for entry in distinct_entries], np.int64),
        list(parent_numbers),
        np.array([parent_numbers[entry.parent] for entry in distinct_entries], np.int64),
        np.array([entry.pose for entry in distinct_entries], np.float64),
    )


def _reason_to_ignore(child: str, entry: _Entry) -> str | None:
    """Return the reason why tf2 would ignore a transform; None if tf2 would use it."""
    if not child or not entry.parent:
        return "it has no name for the frame or its parent (child_frame_id, frame_id)"
    if child == entry.parent:
        return "a frame cannot be its own parent"
    if not all(map(isfinite, entry.pose)):
        return "not all of its numbers are finite"
    length = hypot(*entry.pose[3:])
    if abs(length * length - 1) > _OFF_LENGTH:
        return f"its quaternion has the length {length:.3g}, so it is not a rotation"
    return None


def _stepping(subject: str, count: int, old: _Entry, new: _Entry, consequence: str) -> Sentence:
    times_text = "" if count == 1 else f" {count} times, first"
    step_text = f"{(old.stamp_ns - new.stamp_ns) / 1e9:.3f} s"
    return Sentence(
        f"the stamps of {subject} step back{times_text} by {step_text} at ",
        Instant(new.clock_ns, 0),
        consequence,
    )


def _place(entry: _Entry) -> str:
    return f"({', '.join(f'{number:.4g}' for number in entry.pose[:3])})"


def _transforms(translation: Floats, quaternions: Floats, is_known: NDArray[np.bool_]) -> Transforms:
    rotation, _ = matrices_from_quaternions(np.ascontiguousarray(quaternions))
    is_finite = np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(translation).all(axis=1)
    return Transforms(rotation, np.asarray(translation), is_known & is_finite)


_SECONDS = ("sec", "secs", "seconds")
_REST = ("nanosec", "nsec", "nsecs", "nanos")


class TransformReader:
    """Reader of the transforms in one topic's messages of ROS 1, ROS 2 or Foxglove types."""

    def __init__(self) -> None:
        self._get_list: Get | None = None
        self._get_values: Get | None = None

    def add(
        self, tree: FrameTree, message: object, clock_ns: int | None, *, log_ns: int, is_static: bool
    ) -> None:
        """Add the transforms of a message to a tree.

        Args:
            clock_ns: time of the message on the clock of the samples; None for the stamp of each transform.
            log_ns: time of recording.

        Raises:
            FieldError, AttributeError, LookupError, TypeError, ValueError: the message has no transforms.
        """
        for transform in self._each(message):
            child, parent, seconds, nanoseconds, *pose = self._values(transform)
            stamp_ns = _nanoseconds(seconds, nanoseconds)
            # tf wrote names with a leading slash; tf2 does not
            tree.add(
                str(child).removeprefix("/"),
                str(parent).removeprefix("/"),
                tuple(map(float, pose)),
                stamp_ns=stamp_ns,
                clock_ns=(stamp_ns or log_ns) if clock_ns is None else clock_ns,
                log_ns=log_ns,
                is_static=is_static,
            )

    def stamp(self, message: object) -> int | None:
        """Return the stamp of a message's first transform, nanoseconds; None without a transform."""
        for transform in self._each(message):
            _, _, seconds, nanoseconds, *_ = self._values(transform)
            return _nanoseconds(seconds, nanoseconds)
        return None

    def _each(self, message: object) -> Iterator[Any]:
        if self._get_list is None:
            has_list = "transforms" in field_names(message)
            path = FieldPath.of("transforms")
            self._get_list = getter(path, message) if has_list else lambda message: (message,)
        return iter(self._get_list(message))

    def _values(self, transform: Any) -> Sequence[Any]:
        self._get_values = self._get_values or _getter(transform)
        values: Sequence[Any] = self._get_values(transform)
        return values


def _getter(example: object) -> Get:
    """Return a getter of child, parent, seconds, nanoseconds, x, y, z and the quaternion x, y, z, w."""
    example_fields = field_names(example)
    in_header = "header" in example_fields
    stamp, parent = ("header.stamp", "header.frame_id") if in_header else ("timestamp", "parent_frame_id")
    prefix = "transform." if "transform" in example_fields else ""
    paths = ["child_frame_id", parent]
    for alternatives in (_SECONDS, _REST):
        stamp_paths = [f"{stamp}.{field_name}" for field_name in alternatives]
        existing_paths = [
            stamp_path for stamp_path in stamp_paths if leads_somewhere(FieldPath.of(stamp_path), example)
        ]
        if not existing_paths:
            raise FieldError(f"{stamp} is not a time; a transform has a stamp")
        paths.append(existing_paths[0])
    paths += [f"{prefix}translation.{axis}" for axis in "xyz"]
    paths += [f"{prefix}rotation.{axis}" for axis in "xyzw"]
    return tuple_getter([FieldPath.of(path) for path in paths], example)


def _nanoseconds(seconds: Any, nanoseconds: Any) -> int:
    time_ns = int(seconds) * 1_000_000_000 + int(nanoseconds)
    if abs(time_ns) > LATEST_NS:
        raise FieldError(f"its stamp {time_ns} ns lies outside the times of a log")
    return time_ns
