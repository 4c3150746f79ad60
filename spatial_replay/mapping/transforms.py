"""Frames: messages with transforms in, the transform between any two frames at any time out.

A transform places a child frame in its parent. Between two transforms of a child, translation is interpolated
linearly and rotation along the shorter arc, as in tf2. There is no extrapolation. A static transform holds
until another one replaces it.

A step back of the stamps begins a new run, such as a restarted simulation. Only static transforms hold across
runs. Rotations are arrays: quaternions (x, y, z, w) and matrices.
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
        (N, 3, 3) a_from_b matrices, whose columns are the axes of b, and (N,) angles of the projected x axes.
        The angle is NaN for quaternions of zeros.
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
    # exactly the identity, also for norms that are above 0 and below the limit
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
    """Return for each rotation (N,) whether it keeps the z axis vertical, up or down."""
    return np.asarray(np.hypot(matrices[:, 0, 2], matrices[:, 1, 2]) <= _UPRIGHT)


def slerp(first: Floats, second: Floats, share: Floats) -> Floats:
    """Interpolate between quaternions at constant angular speed, along the shorter arc.

    Args:
        first, second: (N, 4) x, y, z, w, of any length above 0.
        share: (N,) from 0 for `first` to 1 for `second`.
    """
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    dot = np.einsum("ij,ij->i", first, second)
    # q and -q are the same rotation; the shorter arc ends at the nearer one
    second = np.where(dot[:, None] < 0, -second, second)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    sine = np.sin(angle)
    # linear interpolation for nearly equal quaternions, for which the quotient below tends to 0 / 0
    is_close = sine < _LEAST_NORM
    divisor = np.where(is_close, 1.0, sine)
    weight = np.where(is_close, 1.0 - share, np.sin((1.0 - share) * angle) / divisor)
    next_weight = np.where(is_close, share, np.sin(share * angle) / divisor)
    return np.asarray(weight[:, None] * first + next_weight[:, None] * second)


# a buffer of tf2 keeps transforms for 10 s by default, too
HISTORY_NS = 10 * 10**9
"""Longest time between two transforms that are interpolated, nanoseconds."""

_LONGEST_CHAIN = 100
"""Limit of frames between a frame and its root."""
_OFF_LENGTH = 0.01
"""Largest error of the squared length of a rotation's quaternion, as in tf2."""
_LEAST_JUMP = 0.1
"""Least jump of a frame: distance in metres plus turn in radians."""
_MANY_JUMPS = 3
"""Least number of a frame's jumps for a remark."""
_MOST_PUBLISHERS = 4
"""Limit of publishers that may send a frame in turn."""
LEAST_STEP_NS = 10_000_000
"""Least step back of a clock, nanoseconds; recorders with several threads mix messages by less."""
_MOST_RESTARTS = 1_000
"""Limit of kept restarts."""


class Transforms(NamedTuple):
    """N rigid transforms.

    Attributes:
        rotation: (N, 3, 3).
        translation: (N, 3).
        known: (N,) whether a transform is known; other numbers of unknown transforms have no meaning.
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
        """Set the transforms at some indices in place, to collect a result."""
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

    def inverse(self) -> Transforms:
        """Return b_from_a for a_from_b."""
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
    """A step back of the stamps: the last transform before it, and the first one after."""

    old: _Entry
    new: _Entry


@dataclass(slots=True)
class _Child:
    """The transforms of one child frame.

    Attributes:
        restart: step back of the stamps at the last transform; None without one.
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
        """Return the index of the last transform up to each time; 0 before the first."""
        return np.maximum(np.searchsorted(self.times_ns, times_ns, "right") - 1, 0)


class FrameTree:
    """The transforms of a log, added in order of arrival; `remarks` lists contradictions between them."""

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
        """Add one transform; a transform that tf2 would ignore is only counted.

        A static transform holds from its stamp on. The first static transform of a frame also holds
        before its stamp. A static transform without a stamp, or with an older stamp than its predecessor,
        holds from its clock time on.

        Args:
            pose: x, y, z, then the quaternion x, y, z, w.
            stamp_ns: stamp in the message.
            clock_ns: time of the message on the clock of the samples.
            log_ns: time of recording.
        """
        entry = _Entry(stamp_ns, clock_ns, parent, pose, log_ns)
        if (reason := _reason_to_ignore(child, entry)) is not None:
            count, first, first_child = self._ignored.get(reason, (0, entry, child))
            self._ignored[reason] = count + 1, first, first_child
            return
        frame = self._children.setdefault(child, _Child())
        if is_static:
            if frame.static and frame.static[-1][2:4] == entry[2:4]:
                return
            last_ns = frame.static[-1].stamp_ns if frame.static else -1
            if stamp_ns == 0 or stamp_ns < last_ns:
                entry = entry._replace(stamp_ns=max(clock_ns, last_ns))
        entries, others = (frame.static, frame.moving)[:: 1 if is_static else -1]
        if entries and (is_static or entries[-1].parent != parent):
            self._contradict(child, entries[-1], entry)
        if others and not entries:
            self._contradict(child, others[-1], entry, is_mixed=True)
        if not is_static:
            self.newest_stamp_ns = stamp_ns
            if frame.moving:
                self._note_restart(child, frame, entry)
        entries.append(entry)
        self._series.pop(child, None)

    def _note_restart(self, name: str, child: _Child, new: _Entry) -> None:
        """Note a restart if the stamps of a frame step back.

        If the next transform steps forward again, there was no restart: two programs with different clocks
        send the frame in turn.
        """
        old, before, child.restart = child.moving[-1], child.restart, None
        if before in self._restarts and new.stamp_ns >= before.old.stamp_ns - DISORDER_NS:
            self._restarts.remove(before)
            # cached series depend on the runs
            self._series.clear()
        if new.stamp_ns >= old.stamp_ns - DISORDER_NS or new.log_ns < old.log_ns:
            if new.stamp_ns < old.stamp_ns - LEAST_STEP_NS:
                count, *first = self._steps.get(name, (0, old, new))
                self._steps[name] = count + 1, first[0], first[1]
            return
        restart = child.restart = _Restart(old, new)
        if self._restarts and self._restarts[-1].new.log_ns > old.log_ns:
            # one restart makes all frames step back, one after the other
            restart = min(restart, self._restarts.pop(), key=lambda restart: restart.new.log_ns)
        self._restarts = [*self._restarts[1 - _MOST_RESTARTS :], restart]
        self._series.clear()

    def forget_before(self, clock_ns: int) -> None:
        """Drop the moving transforms of messages before a time, except the last one of each child."""
        for name, child in self._children.items():
            keep = [entry for entry in child.moving if entry.clock_ns >= clock_ns]
            if len(keep) < len(child.moving):
                self._look_for_jumps(name, [entry for entry in child.moving if entry.clock_ns < clock_ns])
                # the last one is kept for its parent, and as the start of the next interpolation
                child.moving = keep or child.moving[-1:]
        self._series.clear()

    def forget_moving(self) -> None:
        """Drop all transforms except static ones, so that nothing is interpolated across a loss."""
        self._children = {
            name: _Child(static=child.static) for name, child in self._children.items() if child.static
        }
        self._series.clear()

    @property
    def names(self) -> frozenset[str]:
        """Names of all frames that are a child or a parent of a transform."""
        parents = {entry.parent for child in self._children.values() for entry in child.entries}
        # frames of ignored transforms are frames of the log, too
        ignored = {name for _, entry, child in self._ignored.values() for name in (child, entry.parent)}
        return frozenset(self._children) | parents | ignored

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
            log_ns: (N,) times of recording, which identify the run; without them, all runs are used.
            longest_ns: longest time between two transforms that are interpolated.
            holds: whether a transform holds for `longest_ns` if none follows in that time.
        """
        count = len(times_ns)
        if target == source or not count:
            return Transforms.identity(count)
        ask = _Question(np.arange(count), times_ns, log_ns, by_stamp, min(longest_ns, HISTORY_NS), holds)
        result = Transforms.unknown(count)
        for run in self._by_run(ask):
            for part in self._by_parents(run):
                result.put(part.places, self._in_one_tree(target, source, part))
        return result

    def _by_run(self, ask: _Question) -> list[_Question]:
        """Divide a question by run, and into stamps near to and far from the times of recording."""
        times_ns, log_ns = ask.times_ns, ask.log_ns
        if log_ns is None:
            return [ask]
        runs = np.searchsorted([restart.new.log_ns for restart in self._restarts], log_ns, "right")
        if ask.by_stamp:
            for number, (old, new) in enumerate(self._restarts, 1):
                # an observation may come before the first transform of its run
                is_early = np.abs(times_ns - new.stamp_ns) < np.abs(times_ns - old.stamp_ns)
                runs[is_early & (log_ns > old.log_ns) & (log_ns < new.log_ns)] = number
        # even for stamps near to the times of recording, odd for stamps far from them
        kinds = 2 * runs + (ask.by_stamp & (np.abs(log_ns - times_ns) > HISTORY_NS))
        return [
            ask.part(kinds == kind)._replace(run=kind // 2, is_apart=kind % 2 > 0)
            for kind in np.unique(kinds).tolist()
        ]

    def _by_parents(self, ask: _Question) -> list[_Question]:
        """Divide a question into parts in which each frame has a single parent."""
        keys = [np.zeros(len(ask.times_ns), np.int64)]
        for name in self._children:
            series, times_ns = self._series_of(name, ask)
            if len(series.parents) > 1:
                keys.append(series.parent[series.at(times_ns)])
        if len(keys) == 1:
            return [ask]
        _, group = np.unique(np.stack(keys), axis=1, return_inverse=True)
        group = group.reshape(-1)
        return [ask.part(group == number) for number in range(int(group.max()) + 1)]

    def _in_one_tree(self, target: str, source: str, ask: _Question) -> Transforms:
        up = self._ancestors(source, ask)
        down = self._ancestors(target, ask)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return Transforms.unknown(len(ask.times_ns))
        common_from_source = self._climb(up[: up.index(common)], ask)
        common_from_target = self._climb(down[: down.index(common)], ask)
        return common_from_target.inverse().after(common_from_source)

    def _ancestors(self, frame: str, ask: _Question) -> list[str]:
        """Return the chain of a frame, its parent and so on up to the root, at the first time."""
        chain = [frame]
        while len(chain) < _LONGEST_CHAIN:
            series, times_ns = self._series_of(chain[-1], ask)
            if not series.parents:
                break
            parent = series.parents[int(series.parent[series.at(times_ns[:1])][0])]
            if parent in chain:
                loop = chain[chain.index(parent) :]
                first = loop.index(min(loop))
                self._loops.setdefault((*loop[first:], *loop[: first + 1]))
                break
            chain.append(parent)
        return chain

    def _climb(self, frames: list[str], ask: _Question) -> Transforms:
        """Return the transform from the first frame of a chain to the parent of the last frame."""
        total = Transforms.identity(len(ask.times_ns))
        for frame in frames:
            total = self._step(frame, ask).after(total)
        return total

    def _step(self, frame: str, ask: _Question) -> Transforms:
        """Return parent_from_child at each time."""
        series, times_ns = self._series_of(frame, ask)
        last, newest = len(series.times_ns) - 1, series.at(times_ns)
        is_still = newest < series.still
        if is_still.all():
            poses = series.poses[newest]
            return _transforms(poses[:, :3], poses[:, 3:], is_still)
        after = np.searchsorted(series.times_ns, times_ns, "left")
        inside = after <= last
        after = np.minimum(after, last)
        # at the time of a transform nothing is interpolated
        before = np.where(inside & (series.times_ns[after] == times_ns), after, after - inside)
        is_known = (before >= 0) | is_still
        before, after = np.where(is_still, newest, np.maximum(before, 0)), np.where(is_still, newest, after)
        start, end = series.times_ns[before], series.times_ns[after]
        is_hole = end - start > ask.longest_ns
        if (is_known & inside & is_hole).any():
            longest = int((end - start)[is_known & inside].max())
            at_ns = int(series.clock_ns[before][is_known & inside & is_hole][0])
            if longest > self._holes.get(frame, (0, 0))[0]:
                self._holes[frame] = longest, at_ns
        is_between = inside & ~is_hole
        is_held = ask.holds & ~is_between & (times_ns - start <= ask.longest_ns)
        is_known &= is_between | is_held
        span = np.where(end > start, end - start, 1)
        # no interpolation between poses in different parents: the earlier pose holds
        moves = is_between & (end > start) & (series.parent[before] == series.parent[after])
        share = np.where(moves, (times_ns - start) / span, 0.0)
        first, second = series.poses[before], series.poses[after]
        translation = first[:, :3] + share[:, None] * (second[:, :3] - first[:, :3])
        quaternions = slerp(first[:, 3:], second[:, 3:], share)
        return _transforms(
            translation, np.where((share == 0.0)[:, None], first[:, 3:], quaternions), is_known
        )

    def _series_of(self, frame: str, ask: _Question) -> tuple[_Series, Integers]:
        """Return the ordered transforms of a frame for a question, and the times to look up in them.

        Static transforms of all runs are used, but only those before the first moving transform of the frame.
        If stamps are far from times of recording, a frame without moving transforms is looked up by the time
        of recording.
        """
        child = self._children.get(frame, _Child())
        clock, run, times_ns = "stamp_ns" if ask.by_stamp else "clock_ns", ask.run, ask.times_ns
        if not child.moving:
            run = None
            if ask.is_apart and ask.log_ns is not None:
                clock, times_ns = "log_ns", ask.log_ns
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
        """Note the first contradiction of a kind: static and moving, two parents, or a changed static one."""
        key = child, is_mixed, old.parent == new.parent
        if key in self._contradictions:
            return
        what, counting = f"frame {child!r} has two parents,", "newest counts"
        places = " and ".join(f"{entry.parent!r} at {_place(entry)}" for entry in (old, new))
        if is_mixed:
            what, counting = f"frame {child!r} is sent static and moving, in", "moving ones count"
        elif old.parent == new.parent:
            what = f"the static transform of {child!r} in {new.parent!r} changes"
            places = f"from {_place(old)} to {_place(new)}"
        since = Instant(new.clock_ns, 0)
        self._contradictions[key] = Sentence(
            f"{what} {places}, the second from ", since, f" on: the {counting}"
        )

    def _look_for_jumps(self, name: str, entries: list[_Entry]) -> None:
        """Count the jumps of a child: transforms far from both neighbours, which agree with each other."""
        kinds = [(entry.parent, self._run_of(entry)) for entry in entries]
        for kind in dict.fromkeys(kinds):
            self._look_for_jumps_in(
                name, sorted(compress(entries, (kind_of_entry == kind for kind_of_entry in kinds)))
            )

    def _look_for_jumps_in(self, name: str, entries: list[_Entry]) -> None:
        if len(entries) < _MANY_JUMPS:
            return
        poses = np.array([entry.pose for entry in entries])

        def apart(first: Floats, second: Floats) -> Floats:
            # the absolute value, because q and -q are the same rotation
            cosine = np.abs(np.einsum("ij,ij->i", first[:, 3:], second[:, 3:]))
            turn = 2 * np.arccos(np.minimum(cosine, 1.0))
            return np.asarray(np.linalg.norm(first[:, :3] - second[:, :3], axis=1) + turn)

        # two poses of one publisher may have poses of other publishers between them
        lags = range(2, min(_MOST_PUBLISHERS, len(poses) - 1) + 1)
        aside = {lag: apart(poses[lag:], poses[:-lag]) for lag in (1, *lags)}
        usual = min(float(np.quantile(distances, 0.3)) for distances in aside.values())

        def jumps_of(times: int) -> Integers:
            jumps = np.zeros(len(poses), np.bool_)
            for lag in lags:
                over = aside[lag]
                between = [aside[by][: len(over)] for by in range(1, lag)]
                between += [aside[by][lag - by :][: len(over)] for by in range(1, lag)]
                least = np.min(between, axis=0)
                jumps[: len(over)] |= (least > max(_LEAST_JUMP, times * usual)) & (over * times < least)
            return np.flatnonzero(jumps)

        # noise causes few jumps, and hardly any of ten times the usual motion
        jumps = jumps_of(5)
        jumps = jumps if len(jumps) > 0.05 * len(poses) else jumps_of(10)
        if len(jumps):
            least = aside[1][jumps]
            at = int(jumps[0])
            count, most, *example = self._jumps.get(name, (0, 0.0, entries[at], entries[at + 1]))
            most = max(most, float(least.max()))
            self._jumps[name] = count + len(jumps), most, example[0], example[1]

    def remarks(self) -> list[str]:
        """Return remarks on transforms that were ignored, contradict each other, jump or pause."""
        for name, child in self._children.items():
            self._look_for_jumps(name, child.moving)
        texts: list[str] = []
        for reason, (count, first, owner) in self._ignored.items():
            were = "transform was" if count == 1 else "transforms were"
            of = f", the first of {owner!r} in {first.parent!r} at "
            texts.append(Sentence(f"{count} {were} left out{of}", Instant(first.clock_ns, 0), f": {reason}"))
        texts += self._contradictions.values()
        doubtful = [child.restart for child in self._children.values()]
        if restarts := [restart for restart in self._restarts if restart not in doubtful]:
            rule = "earlier ones do not count from there on; cut the log there to evaluate each run by itself"
            why = f", as when a simulation restarts: {rule}"
            texts.append(_stepping("transforms", len(restarts), *restarts[0], why))
        if self._steps:
            name, (count, old, new) = min(self._steps.items(), key=lambda step: step[1][2].clock_ns)
            others = len(self._steps) - 1
            of = f"{name!r} and {plural(others, 'other frame')}" if others else repr(name)
            rule = (
                "they are sorted by stamp, as if of two senders; if a clock was set back, cut the log there"
            )
            texts.append(_stepping(of, count, old, new, f": {rule}"))
        for name, (count, most, old, new) in sorted(self._jumps.items()):
            if count < _MANY_JUMPS:
                continue
            texts.append(
                Sentence(
                    f"frame {name!r} jumps in {new.parent!r} by up to {most:.3g} and back, {count} times,"
                    f" such as from {_place(old)} to {_place(new)} at ",
                    Instant(new.clock_ns, 0),
                    ": if several programs send it, the newest counts",
                )
            )
        for loop in self._loops:
            texts.append(f"frames form a loop, {' in '.join(map(repr, loop))}: what they place is unknown")
        for name, (longest_ns, at_ns) in sorted(self._holes.items()):
            remedy = "; a larger `max_age` interpolates over it" if longest_ns <= HISTORY_NS else ""
            texts.append(
                Sentence(
                    f"the transforms of {name!r} pause for up to {longest_ns / 1e9:.3f} s, longest from ",
                    Instant(at_ns, 0),
                    f" on, longer than max_age: what they place is unknown there{remedy}",
                )
            )
        return texts


class _Question(NamedTuple):
    """A request for transforms at some times; see `FrameTree.between`.

    Attributes:
        places: indices of the times in the original question.
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
    """Return transforms in order of a clock; of transforms with equal times, only the last.

    Args:
        clock: attribute of entries with the time.
        first_ns: time before which transforms are static.
    """
    times = np.array([getattr(entry, clock) for entry in entries], np.int64)
    order = np.argsort(times, kind="stable")
    ordered = times[order]
    keep = order[np.append(ordered[1:] != ordered[:-1], True)[: len(order)]]
    distinct = [entries[i] for i in keep.tolist()]
    number = {parent: index for index, parent in enumerate(dict.fromkeys(e.parent for e in distinct))}
    return _Series(
        int(np.count_nonzero(times[keep] < first_ns)),
        times[keep],
        np.array([entry.clock_ns for entry in distinct], np.int64),
        list(number),
        np.array([number[entry.parent] for entry in distinct], np.int64),
        np.array([entry.pose for entry in distinct], np.float64),
    )


def _reason_to_ignore(child: str, entry: _Entry) -> str | None:
    """Return the reason for which tf2 would ignore a transform; None without one."""
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


def _stepping(of: str, count: int, old: _Entry, new: _Entry, why: str) -> Sentence:
    times = "" if count == 1 else f" {count} times, first"
    back = f"{(old.stamp_ns - new.stamp_ns) / 1e9:.3f} s"
    return Sentence(f"the stamps of {of} step back{times} by {back} at ", Instant(new.clock_ns, 0), why)


def _place(entry: _Entry) -> str:
    return f"({', '.join(f'{number:.4g}' for number in entry.pose[:3])})"


def _transforms(translation: Floats, quaternions: Floats, is_known: NDArray[np.bool_]) -> Transforms:
    rotation, _ = matrices_from_quaternions(np.ascontiguousarray(quaternions))
    finite = np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(translation).all(axis=1)
    return Transforms(rotation, np.asarray(translation), is_known & finite)


_SECONDS = ("sec", "secs", "seconds")
_REST = ("nanosec", "nsec", "nsecs", "nanos")


class TransformReader:
    """Reader of the transforms in one topic's messages, of ROS 1, ROS 2 and Foxglove types."""

    def __init__(self) -> None:
        self._list: Get | None = None
        self._get: Get | None = None

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
            child, parent, seconds, rest, *pose = self._values(transform)
            stamp_ns = _nanoseconds(seconds, rest)
            # tf wrote names with a slash in front, which tf2 does not have
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
        """Return the stamp of the first transform of a message; None without one."""
        for transform in self._each(message):
            _, _, seconds, rest, *_ = self._values(transform)
            return _nanoseconds(seconds, rest)
        return None

    def _each(self, message: object) -> Iterator[Any]:
        if self._list is None:
            has_list = "transforms" in field_names(message)
            path = FieldPath.of("transforms")
            self._list = getter(path, message) if has_list else lambda message: (message,)
        return iter(self._list(message))

    def _values(self, transform: Any) -> Sequence[Any]:
        self._get = self._get or _getter(transform)
        values: Sequence[Any] = self._get(transform)
        return values


def _getter(example: object) -> Get:
    """Return a getter of child, parent, seconds, nanoseconds, x, y, z and the quaternion x, y, z, w."""
    names = field_names(example)
    in_header = "header" in names
    stamp, parent = ("header.stamp", "header.frame_id") if in_header else ("timestamp", "parent_frame_id")
    place = "transform." if "transform" in names else ""
    paths = ["child_frame_id", parent]
    for parts in (_SECONDS, _REST):
        fields = [f"{stamp}.{part}" for part in parts]
        existing = [field for field in fields if leads_somewhere(FieldPath.of(field), example)]
        if not existing:
            raise FieldError(f"{stamp} is not a time; a transform has a stamp")
        paths.append(existing[0])
    paths += [f"{place}translation.{axis}" for axis in "xyz"]
    paths += [f"{place}rotation.{axis}" for axis in "xyzw"]
    return tuple_getter([FieldPath.of(path) for path in paths], example)


def _nanoseconds(seconds: Any, rest: Any) -> int:
    time_ns = int(seconds) * 1_000_000_000 + int(rest)
    if abs(time_ns) > LATEST_NS:
        raise FieldError(f"its stamp {time_ns} ns lies outside the times of a log")
    return time_ns
