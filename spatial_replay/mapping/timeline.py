"""What is known of each object over time: events, and the state at the times of samples.

Objects as they were seen, brought into the fixed frame and checked, in columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import Concave
from spatial_replay.mapping.detections import Detections
from spatial_replay.mapping.footprints import Solids, footprints_from_solids
from spatial_replay.mapping.model import FOREVER_NS
from spatial_replay.mapping.transforms import Transforms
from spatial_replay.trace.observations import Observations, trace_from_observations
from spatial_replay.trace.trace import ABSENT

GONE = -1
"""Instead of a row: the object has left."""

STALE = -2
"""Instead of a row: the object is there, but what was known of it is too old."""


@dataclass(frozen=True, slots=True)
class Events:
    """E events of one topic's objects, by name, then in the order in which they happened.

    Attributes:
        name: (E,) int64.
        time_ns: (E,) int64.
        row: (E,) int64, the observation, or `GONE`.
        expires_ns: (E,) int64, from when the object has left by itself.
        class_code: (E,) int64.
    """

    name: Integers
    time_ns: Integers
    row: Integers
    expires_ns: Integers
    class_code: Integers

    @classmethod
    def none(cls) -> Events:
        return cls(*(np.empty(0, np.int64) for _ in range(5)))

    def select(self, chosen: Integers) -> Events:
        columns = (self.name, self.time_ns, self.row, self.expires_ns, self.class_code)
        return Events(*(column[chosen] for column in columns))

    def last(self) -> Events:
        """The last event of each name, but for those who have left."""
        is_last = np.append(self.name[1:] != self.name[:-1], True)[: len(self.name)]
        return self.select(np.flatnonzero(is_last & (self.row != GONE)))

    def after(self, before: Events) -> Events:
        """These events after earlier ones of the same topic."""
        columns = [
            np.concatenate([getattr(before, name), getattr(self, name)])
            for name in ("name", "time_ns", "row", "expires_ns", "class_code")
        ]
        joined = Events(*columns)
        return joined.select(np.argsort(joined.name, kind="stable"))

    def state(self, times_ns: Integers, max_age_ns: int) -> tuple[Integers, Integers, Integers]:
        """What is known at some times.

        Returns:
            names (N,), each once; rows (T, N): a row, `ABSENT`, or `STALE`; class codes (T, N).
        """
        starts = np.flatnonzero(np.diff(self.name, prepend=-1))
        ends = np.append(starts[1:], len(self.name))[: len(starts)]
        rows = np.full((len(times_ns), len(starts)), ABSENT, np.int64)
        classes = np.zeros((len(times_ns), len(starts)), np.int64)
        for column, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            at = np.searchsorted(self.time_ns[start:end], times_ns, "right") - 1 + start
            has_come = at >= start
            at = np.maximum(at, start)
            found = self.row[at]
            too_old = times_ns - self.time_ns[at] > max_age_ns
            left = ~has_come | (found == GONE) | (times_ns >= self.expires_ns[at])
            rows[:, column] = np.where(left, ABSENT, np.where(too_old, STALE, found))
            classes[:, column] = self.class_code[at]
        return self.name[starts], rows, classes


def events_from_messages(
    *,
    name: Integers,
    message: Integers,
    class_code: Integers,
    times_ns: Integers,
    rows: Integers,
    lifetime_ns: Integers | None,
    gone: list[tuple[int, int]],
    alive: Events,
    is_complete: bool,
) -> Events:
    """The events of messages in order.

    Args:
        name, message, class_code, rows: (R,) of each object that was seen; `message` increases.
        times_ns: (M,) of each message.
        gone: (message, name) of those that were deleted, before whoever the same message tells of.
        alive: the last event of each object before.
        is_complete: whether those that a message leaves out have left.
    """
    expires = np.full(len(name), FOREVER_NS, np.int64)
    if lifetime_ns is not None:
        limited = np.flatnonzero(lifetime_ns > 0)
        expires[limited] = times_ns[message[limited]] + lifetime_ns[limited]
    left_name, left_message = np.empty(0, np.int64), np.empty(0, np.int64)
    if is_complete:
        left_name, left_message = _left_out(name, message, alive.name, len(times_ns))
    if gone:
        told = np.array(gone, np.int64)
        left_message = np.concatenate([left_message, told[:, 0]])
        left_name = np.concatenate([left_name, told[:, 1]])
    every_name = np.concatenate([left_name, name])
    every_message = np.concatenate([left_message, message])
    # those who left come first, so that a name that a message deletes and tells of is there
    order = np.lexsort((every_message, every_name))
    count = len(left_name)

    def column(left: int, seen: Integers) -> Integers:
        return np.concatenate([np.full(count, left, np.int64), seen])[order]

    return Events(
        name=every_name[order],
        time_ns=times_ns[every_message[order]],
        row=column(GONE, rows),
        expires_ns=column(FOREVER_NS, expires),
        class_code=column(0, class_code),
    )


def _left_out(name: Integers, message: Integers, alive: Integers, messages: int) -> tuple[Integers, Integers]:
    """Who is left out by the message after one that told of them: names, and those messages."""
    every_name = np.concatenate([alive, name])
    every_message = np.concatenate([np.full(len(alive), -1, np.int64), message])
    order = np.lexsort((every_message, every_name))
    name, message = every_name[order], every_message[order]
    following = np.append(np.where(name[1:] == name[:-1], message[1:], messages), messages)[: len(name)]
    left = np.flatnonzero((following > message + 1) & (message + 1 < messages))
    return name[left], message[left] + 1


Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ObservationRows:
    """R observations as a trace holds them.

    Attributes:
        is_readable: (R,) bool; where not, some number is not finite.
    """

    shapes: FootprintBatch
    yaw: Floats
    uncertainty: Floats
    class_code: Integers
    is_readable: Flags

    def __len__(self) -> int:
        return len(self.yaw)

    @classmethod
    def blank(cls, class_code: Integers) -> ObservationRows:
        """Objects of which nothing is known but their class."""
        count = len(class_code)
        nowhere = FootprintBatch(
            part_start=np.arange(count + 1),
            vertex_start=np.arange(count + 1),
            vertices=np.full((count, 2), np.nan),
            radius=np.zeros(count),
            bottom=np.full(count, np.nan),
            top=np.full(count, np.nan),
        )
        return cls(nowhere, np.full(count, np.nan), np.zeros(count), class_code, np.zeros(count, np.bool_))

    def select(self, rows: Integers) -> ObservationRows:
        return ObservationRows(
            self.shapes.select(rows),
            self.yaw[rows],
            self.uncertainty[rows],
            self.class_code[rows],
            self.is_readable[rows],
        )

    @classmethod
    def concatenate(cls, several: Sequence[ObservationRows]) -> ObservationRows:
        return cls(
            FootprintBatch.concatenate([rows.shapes for rows in several]),
            np.concatenate([np.empty(0), *(rows.yaw for rows in several)]),
            np.concatenate([np.empty(0), *(rows.uncertainty for rows in several)]),
            np.concatenate([np.empty(0, np.int64), *(rows.class_code for rows in several)]),
            np.concatenate([np.empty(0, np.bool_), *(rows.is_readable for rows in several)]),
        )


def rows_from_detections(
    seen: Detections, transforms: Transforms | None, concave: Concave, fault: Callable[[int, str], None]
) -> ObservationRows:
    """The observations in the fixed frame; blank where the transform is not known or there is no footprint.

    Args:
        transforms: fixed_from_frame of each object, or None where all are in the fixed frame.
        fault: takes the index of an object that makes no footprint, and what comes after its name.
    """
    poses, solids, count = seen.poses, seen.solids, len(seen.name)
    unknown = np.zeros(count, np.bool_)
    covariance = seen.covariance
    if transforms is not None:
        poses, solids = poses.moved(transforms), _moved(solids, transforms)
        unknown = ~transforms.known
        if covariance is not None:
            turn = transforms.rotation
            covariance = turn @ covariance @ np.swapaxes(turn, 1, 2)
    shapes = footprints_from_solids(solids, count)
    if seen.height is not None:
        heights = poses.position[:, 2, None] + seen.height
        shapes = replace(shapes, bottom=heights[:, 0], top=heights[:, 1])
    uncertainty = seen.uncertainty if covariance is None else _radius(covariance)
    return _checked(seen, shapes, poses.yaw, uncertainty, unknown, concave, fault)


def _moved(solids: Solids, transforms: Transforms) -> Solids:
    rotation = transforms.rotation[solids.owner]
    position = np.einsum("nij,nj->ni", rotation, solids.position) + transforms.translation[solids.owner]
    return replace(solids, position=position, rotation=rotation @ solids.rotation)


def _radius(covariance: Floats) -> Floats:
    """(R,) the longest half axis of the ellipses of covariances (R, 3, 3), seen from above.

    NaN for those with a negative variance, by which some programs say that they know nothing.
    """
    a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    largest = (a + d) / 2 + np.hypot((a - d) / 2, b)
    return np.asarray(np.where((a < 0) | (d < 0), np.nan, np.sqrt(np.maximum(largest, 0.0))))


def _checked(
    seen: Detections,
    shapes: FootprintBatch,
    yaw: Floats,
    uncertainty: Floats,
    unknown: Flags,
    concave: Concave,
    fault: Callable[[int, str], None],
) -> ObservationRows:
    """Each observation as a sample of its own, so that one that makes no footprint costs no other."""
    count = len(seen.name)
    each = np.arange(count, dtype=np.int64)
    trace, faults = trace_from_observations(
        Observations(
            times_ns=each,
            sample=each,
            name=np.zeros(count, np.int64),
            names=("",),
            class_code=seen.class_code,
            classes=(None,) * (int(seen.class_code.max(initial=-1)) + 1),
            yaw=yaw,
            uncertainty=uncertainty,
            shapes=shapes,
            invalid=unknown,
            signals={},
        ),
        concave=concave,
    )
    for index, what in faults.items():
        fault(index, what.removeprefix("object ''"))
    kept = trace.rows[:, 0]
    is_good = np.zeros(count, np.bool_)
    is_good[trace.times_ns] = kept > ABSENT
    row = np.where(kept > ABSENT, kept, -2 - kept)
    is_kept = np.zeros(count, np.bool_)
    is_kept[trace.times_ns] = ~unknown[trace.times_ns]
    placed = ObservationRows(
        trace.footprints, trace.yaw, trace.uncertainty, trace.class_code, np.ones(len(trace), np.bool_)
    )
    if is_kept.all() and (row == each).all():
        return replace(placed, is_readable=is_good)
    # blank rows come after the others
    number = np.arange(count, dtype=np.int64) + len(placed)
    number[trace.times_ns] = np.where(unknown[trace.times_ns], number[trace.times_ns], row)
    both = ObservationRows.concatenate([placed, ObservationRows.blank(seen.class_code)])
    return replace(both.select(number), is_readable=is_good & is_kept)
