"""The state of objects over time: detections in; observations in the fixed frame, and events, out.

`rows_from_detections` makes checked observations of detections. `events_from_messages` makes a timeline of
them that also says who left; `Events.state` reads it at the times of samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.geometry.footprint import Concave, FootprintBatch
from spatial_replay.mapping.detections import EVERY_OBJECT, Detections
from spatial_replay.mapping.footprints import Solids, footprints_from_solids
from spatial_replay.mapping.model import FOREVER_NS
from spatial_replay.mapping.transforms import Transforms
from spatial_replay.trace.observations import Observations, check_observations
from spatial_replay.trace.trace import ABSENT
from spatial_replay.trace.units import Axes

LEFT = -1
"""Instead of a row: the object has left."""

STALE = -2
"""Instead of a row: the object exists, but its last observation is too old."""


@dataclass(frozen=True, slots=True)
class Events:
    """E events of the objects of one topic, ordered by name, then by time.

    Attributes:
        name, time_ns, class_code: (E,) int64.
        row: (E,) int64, the observation, or `LEFT`.
        expires_ns: (E,) int64, when the object leaves by itself.
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
        return Events(*(column[chosen] for column in self._columns()))

    def last(self) -> Events:
        """Return the last event of each object that has not left."""
        is_last = np.append(self.name[1:] != self.name[:-1], True)[: len(self.name)]
        return self.select(np.flatnonzero(is_last & (self.row != LEFT)))

    def after(self, before: Events) -> Events:
        """Join earlier events of the same topic and these."""
        joined = Events(*map(np.concatenate, zip(before._columns(), self._columns(), strict=True)))
        return joined.select(np.argsort(joined.name, kind="stable"))

    def _columns(self) -> tuple[Integers, ...]:
        return self.name, self.time_ns, self.row, self.expires_ns, self.class_code

    def state(self, times_ns: Integers, max_age_ns: int) -> tuple[Integers, Integers, Integers]:
        """Return the state of all N objects at T times.

        Returns:
            distinct names (N,); rows (T, N), each a row, `ABSENT` or `STALE`; class codes (T, N).
        """
        starts = np.flatnonzero(np.append(True, self.name[1:] != self.name[:-1])[: len(self.name)])
        if len(times_ns) == 1 and len(starts):
            return self._state_at(int(times_ns[0]), max_age_ns, starts)
        ends = np.append(starts[1:], len(self.name))[: len(starts)]
        rows = np.full((len(times_ns), len(starts)), ABSENT, np.int64)
        classes = np.zeros((len(times_ns), len(starts)), np.int64)
        for column, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            at = np.searchsorted(self.time_ns[start:end], times_ns, "right") - 1 + start
            has_appeared = at >= start
            at = np.maximum(at, start)
            row = self.row[at]
            is_old = times_ns - self.time_ns[at] > max_age_ns
            is_absent = ~has_appeared | (row == LEFT) | (times_ns >= self.expires_ns[at])
            rows[:, column] = np.where(is_absent, ABSENT, np.where(is_old, STALE, row))
            classes[:, column] = self.class_code[at]
        return self.name[starts], rows, classes

    def _state_at(
        self, time_ns: int, max_age_ns: int, starts: Integers
    ) -> tuple[Integers, Integers, Integers]:
        """Return the state at one time: all objects at once, as there are more of them than times."""
        at = starts + np.add.reduceat(self.time_ns <= time_ns, starts, dtype=np.int64) - 1
        has_appeared = at >= starts
        at = np.maximum(at, starts)
        row = self.row[at]
        is_old = time_ns - self.time_ns[at] > max_age_ns
        is_absent = ~has_appeared | (row == LEFT) | (time_ns >= self.expires_ns[at])
        rows = np.where(is_absent, ABSENT, np.where(is_old, STALE, row))
        return self.name[starts], rows[None], self.class_code[at][None]


def events_from_messages(
    detections: Detections, times_ns: Integers, rows: Integers, *, alive: Events, is_complete: bool
) -> Events:
    """Return the events of messages in order: detections, deletions, and objects that lists leave out.

    Args:
        times_ns: (M,) of each message.
        rows: (R,) the row of each detection.
        alive: the last event of each object before.
        is_complete: whether objects that a message leaves out have left.
    """
    name, message, lifetime_ns = detections.name, detections.message, detections.lifetime_ns
    expires = np.full(len(name), FOREVER_NS, np.int64)
    if lifetime_ns is not None:
        limited = np.flatnonzero(lifetime_ns > 0)
        expires[limited] = times_ns[message[limited]] + lifetime_ns[limited]
    left_name, left_message = np.empty(0, np.int64), np.empty(0, np.int64)
    if is_complete:
        left_name, left_message = _left_out(name, message, alive.name, len(times_ns))
    if deletions := _named_deletions(detections, alive):
        deleted = np.array(deletions, np.int64)
        left_message = np.concatenate([left_message, deleted[:, 0]])
        left_name = np.concatenate([left_name, deleted[:, 1]])
    every_name = np.concatenate([left_name, name])
    every_message = np.concatenate([left_message, message])
    # the sort is stable and departures come first: an object that a message deletes and reports again exists
    order = np.lexsort((every_message, every_name))
    count = len(left_name)

    def column(of_left: int, of_detected: Integers) -> Integers:
        return np.concatenate([np.full(count, of_left, np.int64), of_detected])[order]

    return Events(
        name=every_name[order],
        time_ns=times_ns[every_message[order]],
        row=column(LEFT, rows),
        expires_ns=column(FOREVER_NS, expires),
        class_code=column(0, detections.class_code),
    )


def _named_deletions(detections: Detections, alive: Events) -> list[tuple[int, int]]:
    """Return (message, name) of each deletion, with `EVERY_OBJECT` replaced by all names."""
    if all(name != EVERY_OBJECT for _, name in detections.deleted):
        return detections.deleted
    every_name = np.unique(np.concatenate([alive.name, detections.name])).tolist()
    return [
        (message, each)
        for message, name in detections.deleted
        for each in (every_name if name == EVERY_OBJECT else [name])
    ]


def _left_out(name: Integers, message: Integers, alive: Integers, messages: int) -> tuple[Integers, Integers]:
    """Return the names that a message leaves out while the one before has them, and those messages."""
    every_name = np.concatenate([alive, name])
    # objects alive before the batch count as detected in message -1, just before the first
    every_message = np.concatenate([np.full(len(alive), -1, np.int64), message])
    order = np.lexsort((every_message, every_name))
    name, message = every_name[order], every_message[order]
    following = np.append(np.where(name[1:] == name[:-1], message[1:], messages), messages)[: len(name)]
    left = np.flatnonzero((following > message + 1) & (message + 1 < messages))
    return name[left], message[left] + 1


@dataclass(frozen=True, slots=True)
class ObservationRows:
    """R observations in the columns of a trace.

    Attributes:
        is_valid: (R,) whether all numbers are finite.
    """

    shapes: FootprintBatch
    yaw: Floats
    uncertainty: Floats
    class_code: Integers
    is_valid: Booleans

    def __len__(self) -> int:
        return len(self.yaw)

    @classmethod
    def blank(cls, class_code: Integers) -> ObservationRows:
        """Return observations of which only the class is known."""
        count = len(class_code)
        nowhere = FootprintBatch.unknown(count)
        return cls(nowhere, np.full(count, np.nan), np.zeros(count), class_code, np.zeros(count, np.bool_))

    def select(self, rows: Integers) -> ObservationRows:
        columns = self.yaw[rows], self.uncertainty[rows], self.class_code[rows], self.is_valid[rows]
        return ObservationRows(self.shapes.select(rows), *columns)

    @classmethod
    def concatenate(cls, several: Sequence[ObservationRows]) -> ObservationRows:
        if len(several) == 1:
            return several[0]
        return cls(
            FootprintBatch.concatenate([rows.shapes for rows in several]),
            np.concatenate([np.empty(0), *(rows.yaw for rows in several)]),
            np.concatenate([np.empty(0), *(rows.uncertainty for rows in several)]),
            np.concatenate([np.empty(0, np.int64), *(rows.class_code for rows in several)]),
            np.concatenate([np.empty(0, np.bool_), *(rows.is_valid for rows in several)]),
        )


def rows_from_detections(
    detections: Detections,
    transforms: Transforms | None,
    axes: Axes,
    concave: Concave,
    report: Callable[[int, str], None],
) -> ObservationRows:
    """Bring detections into the fixed frame; blank rows where there is no transform or no valid footprint.

    Args:
        axes: those of the fixed frame; rows have ours.
        transforms: fixed_from_frame of each object, or None if all are in the fixed frame.
        report: receives the index of each object without a valid footprint, and the text after its name.
    """
    poses, solids, count = detections.poses, detections.solids, len(detections.name)
    unknown = np.zeros(count, np.bool_)
    covariance = detections.covariance
    if transforms is not None:
        poses, solids = poses.moved(transforms), _moved(solids, transforms)
        unknown = ~transforms.known
        if covariance is not None:
            turn = transforms.rotation
            covariance = turn @ covariance @ np.swapaxes(turn, 1, 2)
    shapes = footprints_from_solids(solids, count)
    if detections.height is not None:
        heights = poses.position[:, 2, None] + detections.height
        shapes = replace(shapes, bottom=heights[:, 0], top=heights[:, 1])
    uncertainty = detections.uncertainty if covariance is None else _radius(covariance)
    shapes, yaw = axes.convert_shapes(shapes), axes.convert_yaw(poses.yaw)
    return _checked(detections, shapes, yaw, uncertainty * axes.scale, unknown, concave, report)


def _moved(solids: Solids, transforms: Transforms) -> Solids:
    rotation = transforms.rotation[solids.owner]
    position = np.einsum("nij,nj->ni", rotation, solids.position) + transforms.translation[solids.owner]
    return replace(solids, position=position, rotation=rotation @ solids.rotation)


def _radius(covariance: Floats) -> Floats:
    """Return the longest half axes (R,) of the ellipses of covariances (R, 3, 3), detections from above.

    NaN for a negative variance, by which some programs mark an unknown covariance.
    """
    a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    # the larger eigenvalue of [[a, b], [b, d]]
    largest = (a + d) / 2 + np.hypot((a - d) / 2, b)
    return np.asarray(np.where((a < 0) | (d < 0), np.nan, np.sqrt(np.maximum(largest, 0.0))))


def _checked(
    detections: Detections,
    shapes: FootprintBatch,
    yaw: Floats,
    uncertainty: Floats,
    unknown: Booleans,
    concave: Concave,
    report: Callable[[int, str], None],
) -> ObservationRows:
    """Check the observations, each as a sample of its own, so that an invalid one does not affect others."""
    count = len(detections.name)
    each = np.arange(count, dtype=np.int64)
    readable, checked, faults = check_observations(
        Observations(
            times_ns=each,
            sample=each,
            name=np.zeros(count, np.int64),
            names=("",),
            class_code=detections.class_code,
            classes=(None,) * (int(detections.class_code.max(initial=-1)) + 1),
            yaw=yaw,
            uncertainty=uncertainty,
            shapes=shapes,
            invalid=unknown,
            signals={},
        ),
        concave=concave,
    )
    for index, what in faults.items():
        report(index, what.removeprefix("object ''"))
    rows = ObservationRows(checked, yaw, uncertainty, detections.class_code, readable)
    if not faults and not unknown.any():
        return rows
    lost = unknown.copy()
    lost[list(faults)] = True
    both = ObservationRows.concatenate([rows, ObservationRows.blank(detections.class_code)])
    return replace(both.select(np.where(lost, count + each, each)), is_valid=readable & ~lost)
