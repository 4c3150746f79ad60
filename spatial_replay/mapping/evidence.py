"""Measurements of a log while it is read: arrivals and objects of each topic in, statistics out.

Every message and object is measured, in columns. Medians come from a subset of the values. The module
`assumptions` compares the measurements with a mapping's assumptions.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from math import inf, nan, pi
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.mapping.binding import Binding, Codes
from spatial_replay.mapping.detections import Detections
from spatial_replay.mapping.message_types import geodetic_order
from spatial_replay.mapping.reading_plan import PlannedTopic
from spatial_replay.mapping.topic_reader import TopicReader

_HEADING: Final = re.compile(r"heading|course|bearing|azimuth|cog$", re.I)
"""Names of fields with angles from north, clockwise."""

_ANGLE: Final = re.compile(r"(^|[._])(bearing|azimuth|heading|theta|phi|yaw|angle)(_?(deg|rad)\w*)?$", re.I)
"""Names of fields with angles."""

_MOST_VALUES: Final = 4_096
"""Limit of values that a `Spread` keeps for its median."""

_ROWS_AT_ONCE: Final = 4_096
"""Number of objects measured together, because a short column costs as much as a long column."""

_LONGEST_GAP: Final = 9
"""Longest distinguished gap between two reports of an object, messages. Longer gaps are clipped to it."""

_MOST_LEAPS: Final = 4
"""Largest number of steps within which a return of an object to its place is detected."""

_MOST_ROWS: Final = 32_768
"""Limit of reports that are kept for later steps and returns; the oldest reports are dropped."""

FAR_LEAP: Final = 5.0
"""Least length of a suspicious step, in sizes of the object."""

_FAST: Final = 100.0
"""Limit of a robot's speed, footprint units per second. A faster object that leaps there and back is two
objects under one name."""


class Spread:
    """Statistics of values: least, median, greatest, and the time of the greatest value.

    NaN and infinity are ignored. The median is the median of every n-th value.
    """

    __slots__ = ("_kept_values", "_stride", "count", "greatest", "greatest_ns", "least")

    def __init__(self) -> None:
        self.count, self.least, self.greatest, self.greatest_ns = 0, inf, -inf, 0
        self._kept_values, self._stride = np.empty(0), 1

    def add(self, values: Floats, times_ns: Integers | None = None) -> None:
        """Add values (N,) with their times (N,)."""
        is_finite = np.isfinite(values)
        if not is_finite.all():
            values = values[is_finite]
            times_ns = None if times_ns is None else times_ns[is_finite]
        if not len(values):
            return
        greatest_index = int(values.argmax())
        if values[greatest_index] > self.greatest:
            self.greatest, self.greatest_ns = (
                float(values[greatest_index]),
                0 if times_ns is None else int(times_ns[greatest_index]),
            )
        self.least = min(self.least, float(values.min()))
        # the stride continues over calls, so that the subset does not depend on the sizes of calls
        kept_values = np.concatenate([self._kept_values, values[-self.count % self._stride :: self._stride]])
        while len(kept_values) > _MOST_VALUES:
            kept_values, self._stride = kept_values[::2], 2 * self._stride
        self._kept_values = kept_values
        self.count += len(values)

    @property
    def median(self) -> float:
        """The median; NaN without values."""
        return float(np.median(self._kept_values)) if len(self._kept_values) else nan

    def quantile(self, share: float) -> float:
        """Return the quantile at a share from 0 to 1; NaN without values."""
        return float(np.quantile(self._kept_values, share)) if len(self._kept_values) else nan


class Moment(NamedTuple):
    """An event of an object: name, time, and amount in footprint units."""

    name: str
    time_ns: int
    amount: float


class ClassChange(NamedTuple):
    """A change of an object's class, in the message at `time_ns`."""

    name: str
    before: str | None
    after: str | None
    time_ns: int


class Arrivals:
    """Arrivals of a topic's messages: times, publishers and clocks.

    Attributes:
        messages: number of messages.
        first_ns, last_ns: first and last time on the topic's clock.
        period_s, log_period_s: intervals between messages on the topic's clock, and between log times.
        lateness_s: time from the stamps of messages to their recording.
        publish_varies, log_varies: whether publish times, and log times, are not all equal.
        publishers: channel numbers, one for each publisher.
        returns: number of changes of the publisher back to an earlier publisher.
        longest_still_s: longest time without a new stamp.
        still_ns: log time at which `longest_still_s` began.
        stamps_vary: whether stamps are not all equal.
        stamps_passed_s: difference of the last and the first stamp.
        log_passed_s: difference of the log times of the last and the first stamp.
    """

    def __init__(self) -> None:
        self.messages = self.returns = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.period_s, self.lateness_s = Spread(), Spread()
        self.publish_varies = self.log_varies = False
        self.publishers: set[int] = set()
        self.log_period_s = Spread()
        self.longest_still_s, self.still_ns, self.stamps_vary = 0.0, 0, False
        self.stamps_passed_s = self.log_passed_s = 0.0
        self._first_stamp_ns = self._first_stamp_log_ns = 0
        self._first_log_ns = self._last_log_ns = self._first_publish_ns = 0
        self._publisher: int | None = None
        self._waiting: list[tuple[Integers, ...]] = []
        self._waiting_messages = 0
        self._waiting_stamps: list[tuple[Integers, ...]] = []
        self._stamp_ns: int | None = None
        self._stamp_since_ns = 0

    def add(self, times_ns: Integers, log_ns: Integers, publish_ns: Integers, channels: Integers) -> None:
        """Add messages in the order of arrival, all (N,)."""
        if not len(times_ns):
            return
        if self.first_ns is None:
            self.first_ns = int(times_ns[0])
        self.messages += len(times_ns)
        self._waiting.append((times_ns, log_ns, publish_ns, channels))
        self._waiting_messages += len(times_ns)
        if self._waiting_messages >= _ROWS_AT_ONCE:
            self.settle()

    def settle(self) -> None:
        """Measure the waiting messages and stamps."""
        self._waiting_messages = 0
        if self._waiting:
            self._measure(*map(np.concatenate, zip(*self._waiting, strict=True)))
            self._waiting = []
        if self._waiting_stamps:
            self._measure_stamps(*map(np.concatenate, zip(*self._waiting_stamps, strict=True)))
            self._waiting_stamps = []

    def _measure(
        self, times_ns: Integers, log_ns: Integers, publish_ns: Integers, channels: Integers
    ) -> None:
        is_first = self.last_ns is None
        if self.last_ns is None:
            self.last_ns = int(times_ns[0])
            self._first_log_ns, self._first_publish_ns = int(log_ns[0]), int(publish_ns[0])
            self._publisher = int(channels[0])
            self.publishers.add(self._publisher)
        self.log_varies = self.log_varies or bool((log_ns != self._first_log_ns).any())
        self.publish_varies = self.publish_varies or bool((publish_ns != self._first_publish_ns).any())
        times_with_previous = np.append(self.last_ns, times_ns)
        intervals = slice(int(is_first), None)
        self.period_s.add(np.diff(times_with_previous)[intervals] / 1e9, times_ns[intervals])
        log_times_with_previous = np.append(self._last_log_ns, log_ns)
        self.log_period_s.add(np.diff(log_times_with_previous)[intervals] / 1e9)
        self._last_log_ns = int(log_ns[-1])
        if (channels != self._publisher).any():
            previous_channels = np.append(self._publisher or 0, channels[:-1])
            for channel in channels[channels != previous_channels].tolist():
                self.returns += channel in self.publishers
                self.publishers.add(channel)
        self._publisher = int(channels[-1])
        self.last_ns = int(times_ns[-1])

    @property
    def mean_period_s(self) -> float:
        """Mean interval between messages, seconds; NaN without two messages of different times."""
        if self.first_ns is None or self.last_ns is None or self.messages < 2:
            return nan
        return (self.last_ns - self.first_ns) / (self.messages - 1) / 1e9 or nan

    def add_stamps(self, stamps_ns: Integers, log_ns: Integers) -> None:
        """Add stamps of messages in order, with the messages' log times."""
        self._waiting_stamps.append((stamps_ns, log_ns))

    def _measure_stamps(self, stamps_ns: Integers, log_ns: Integers) -> None:
        is_set = stamps_ns != 0
        stamps_ns, log_ns = stamps_ns[is_set], log_ns[is_set]
        if not len(stamps_ns):
            return
        self.lateness_s.add((log_ns - stamps_ns) / 1e9)
        if self._stamp_ns is None:
            self._stamp_ns, self._stamp_since_ns = int(stamps_ns[0]), int(log_ns[0])
            self._first_stamp_ns, self._first_stamp_log_ns = self._stamp_ns, self._stamp_since_ns
        self.stamps_passed_s = (int(stamps_ns[-1]) - self._first_stamp_ns) / 1e9
        self.log_passed_s = (int(log_ns[-1]) - self._first_stamp_log_ns) / 1e9
        is_new = np.append(stamps_ns[0] != self._stamp_ns, stamps_ns[1:] != stamps_ns[:-1])
        self.stamps_vary = self.stamps_vary or bool(is_new.any())
        # for each message, the log time of the first message with the same stamp
        since_ns = np.where(is_new, log_ns, 0)
        since_ns[0] = since_ns[0] or self._stamp_since_ns
        since_ns = np.maximum.accumulate(since_ns)
        still_s = (log_ns - since_ns) / 1e9
        longest_index = int(still_s.argmax())
        if still_s[longest_index] > self.longest_still_s:
            self.longest_still_s, self.still_ns = float(still_s[longest_index]), int(since_ns[longest_index])
        self._stamp_ns, self._stamp_since_ns = int(stamps_ns[-1]), int(since_ns[-1])


_NAME, _MESSAGE, _SECONDS, _X, _Y, _YAW, _TURN, _SIZE, _CLASS, _IS_NEW = range(10)
"""Columns of an array of reports, with one row per report of an object."""

HEADINGS: Final[dict[str, tuple[float, float]]] = {
    "unit: rad": (0.0, 1.0),
    "unit: deg": (0.0, pi / 180),
    "unit: rad, zero: north, clockwise: true": (pi / 2, -1.0),
    "unit: deg, zero: north, clockwise: true": (pi / 2, -pi / 180),
    "unit: rad, zero: east, clockwise: true": (0.0, -1.0),
    "unit: deg, zero: east, clockwise: true": (0.0, -pi / 180),
}
"""Possible interpretations of a field as a yaw: (yaw at field 0, yaw per unit of the field), in radians. The
keys are text of a mapping."""


class Motions:
    """Motions of a topic's objects: differences between successive reports of an object.

    Attributes:
        speed: speeds, footprint units per second.
        turn_rate: turn rates, radians per second.
        jump: longest step of an object.
        jump_s: duration of the longest step.
        comeback: longest step over an absence. In an absence, messages lack the object for a second or more.
        comeback_s: duration of the step in `comeback`.
        zeros: number of steps to (0, 0), without an absence, that are longer than five sizes of the object.
        turn_step: greatest change of the raw angle that is read as yaw.
        chances: number of reports that follow at least two earlier reports of the same object.
        returns: number of reports in which an object is back at its position of two to four reports earlier.
            All steps in between are longer than the object's size.
        slow_returns: number of returns whose last step takes a second or more, at the speed of a robot.
        return_moment: first return; None without a return.
        gaps: (10,) element n is the number of steps whose two reports are n messages apart.
        changes: first changes of classes.
        change_count: number of all changes of classes.
        courses: mean of exp(i (course - yaw)) over the steps of moving objects, for the mapping's yaw
            ("read") and for each interpretation in `HEADINGS`.
        course: mean of exp(i course) over the same steps.
    """

    def __init__(self, names: Codes, classes: Codes) -> None:
        self._names, self._classes = names, classes
        self.speed, self.turn_rate = Spread(), Spread()
        self.jump: Moment | None = None
        self.jump_s = self.comeback_s = 0.0
        self.comeback: Moment | None = None
        self.zeros = 0
        self.turn_step = 0.0
        self.chances = self.returns = self.slow_returns = 0
        self.return_moment: Moment | None = None
        self.gaps = np.zeros(_LONGEST_GAP + 1, np.int64)
        self.changes: list[ClassChange] = []
        self.change_count = 0
        self._courses = np.zeros(len(HEADINGS) + 2, np.complex128)
        self._steps = 0
        self._begin_ns = 0
        self._last_reports = np.empty((0, _IS_NEW + 1))

    def add(self, reports: Floats, begin_ns: int, *, turns_back: bool, zero: float, scale: float) -> None:
        """Add reports (R, 10) of objects in the order of messages.

        Args:
            begin_ns: time 0 of the seconds in reports.
            turns_back: whether angles of messages run clockwise in the axes of samples.
            zero, scale: interpretation of the raw angle: yaw = zero + scale * raw angle, in radians.
        """
        self._begin_ns = begin_ns
        reports = np.concatenate([self._last_reports, reports])
        name_codes = reports[:, _NAME].astype(np.int64)
        reports = reports[np.argsort(name_codes, kind="stable")]
        is_same_object = reports[1:, _NAME] == reports[:-1, _NAME]
        # `later_count`: number of later reports of the same object
        last_indices = np.append(np.flatnonzero(~is_same_object), len(reports) - 1)
        later_count = np.repeat(last_indices, np.diff(last_indices, prepend=-1)) - np.arange(len(reports))
        self._last_reports = reports[later_count < _MOST_LEAPS].copy()
        self._last_reports[:, _IS_NEW] = 0.0
        if len(self._last_reports) > _MOST_ROWS:
            message_numbers = self._last_reports[:, _MESSAGE]
            self._last_reports = self._last_reports[
                message_numbers >= np.partition(message_numbers, -_MOST_ROWS)[-_MOST_ROWS]
            ]
        new_indices = np.flatnonzero(is_same_object & (reports[1:, _IS_NEW] > 0)) + 1
        if not len(new_indices):
            return
        earlier_reports, later_reports = reports[new_indices - 1], reports[new_indices]
        self._add_steps(earlier_reports, later_reports, turns_back=turns_back, zero=zero, scale=scale)
        self._add_returns(reports, new_indices)
        message_gaps = np.clip(
            later_reports[:, _MESSAGE] - earlier_reports[:, _MESSAGE], 0, _LONGEST_GAP
        ).astype(np.int64)
        self.gaps += np.bincount(message_gaps, minlength=_LONGEST_GAP + 1)
        for change_index in np.flatnonzero(earlier_reports[:, _CLASS] != later_reports[:, _CLASS]).tolist():
            self.change_count += 1
            if len(self.changes) < _MOST_CHANGES:
                class_before, class_after = (
                    self._classes.by_code[int(report_rows[change_index, _CLASS])]
                    for report_rows in (earlier_reports, later_reports)
                )
                self.changes.append(
                    ClassChange(
                        self._name(later_reports[change_index]),
                        class_before,
                        class_after,
                        self._time_ns(later_reports[change_index]),
                    )
                )

    def _add_steps(
        self, earlier_reports: Floats, later_reports: Floats, *, turns_back: bool, zero: float, scale: float
    ) -> None:
        step_s = later_reports[:, _SECONDS] - earlier_reports[:, _SECONDS]
        step_xy = later_reports[:, _X : _Y + 1] - earlier_reports[:, _X : _Y + 1]
        distance = np.hypot(step_xy[:, 0], step_xy[:, 1])
        times_ns = self._begin_ns + (later_reports[:, _SECONDS] * 1e9).astype(np.int64)
        self.speed.add(np.where(step_s > 0, distance / step_s, nan), times_ns)
        turn_step = np.fmax.reduce(np.abs(later_reports[:, _TURN] - earlier_reports[:, _TURN]))
        self.turn_step = max(self.turn_step, float(np.nan_to_num(turn_step)))
        # the turn by the shorter way
        turn = np.abs((later_reports[:, _YAW] - earlier_reports[:, _YAW] + pi) % (2 * pi) - pi)
        self.turn_rate.add(np.where(step_s > 0, turn / step_s, nan), times_ns)
        longest_index = int(np.nan_to_num(distance, nan=0.0).argmax())
        if distance[longest_index] > (self.jump.amount if self.jump is not None else 0.0):
            self.jump = Moment(
                self._name(later_reports[longest_index]),
                int(times_ns[longest_index]),
                float(distance[longest_index]),
            )
            self.jump_s = float(step_s[longest_index])
        is_absence = (later_reports[:, _MESSAGE] - earlier_reports[:, _MESSAGE] > 1) & (step_s >= 1.0)
        if is_absence.any():
            self._add_comeback(
                later_reports, np.where(is_absence, np.nan_to_num(distance, nan=0.0), 0.0), step_s
            )
        is_zero = ~later_reports[:, _X : _Y + 1].any(axis=1)
        if is_zero.any():
            is_far = distance > FAR_LEAP * later_reports[:, _SIZE]
            self.zeros += int(np.count_nonzero(is_zero & is_far & ~is_absence))
        is_moving = (distance > 0) & np.isfinite(later_reports[:, _TURN])
        if not is_moving.any():
            return
        # short steps are ignored, because the course of noise is random
        is_moving &= distance >= self.speed.median / 2 * step_s
        if not is_moving.any():
            return
        course = np.arctan2(step_xy[is_moving, 1], step_xy[is_moving, 0])
        yaw, raw_angle = earlier_reports[is_moving, _YAW], earlier_reports[is_moving, _TURN]
        sign = -1.0 if turns_back else 1.0
        # an interpretation differs from the yaw by the differences of its zero and scale
        readings = (
            base_angle - zero + (unit_angle - scale) * raw_angle
            for base_angle, unit_angle in HEADINGS.values()
        )
        angles = [yaw, *(yaw + sign * reading for reading in readings)]
        offsets = [np.exp(1j * (course - angle)).sum() for angle in angles]
        self._courses += np.array([*offsets, np.exp(1j * course).sum()])
        self._steps += int(np.count_nonzero(is_moving))

    def _add_comeback(self, later_reports: Floats, distance: Floats, step_s: Floats) -> None:
        longest_index = int(distance.argmax())
        if distance[longest_index] > (self.comeback.amount if self.comeback is not None else 0.0):
            self.comeback = Moment(
                self._name(later_reports[longest_index]),
                self._time_ns(later_reports[longest_index]),
                float(distance[longest_index]),
            )
            self.comeback_s = float(step_s[longest_index])

    def _add_returns(self, reports: Floats, new_indices: Integers) -> None:
        """Count returns of objects to an earlier place after leaps.

        Args:
            reports: reports, grouped by object.
            new_indices: indices of new reports, except the first report of each object.
        """
        position, name_codes = reports[:, _X : _Y + 1], reports[:, _NAME]
        step_xy = np.diff(position, axis=0, prepend=position[:1])
        leap_lengths = np.hypot(step_xy[:, 0], step_xy[:, 1])
        step_s = np.diff(reports[:, _SECONDS], prepend=0.0)
        leap_lengths = np.where(leap_lengths > np.fmax(reports[:, _SIZE], 0.0), leap_lengths, 0.0)
        self.chances += int(
            np.count_nonzero((new_indices > 1) & (name_codes[new_indices] == name_codes[new_indices - 2]))
        )
        if not leap_lengths[new_indices].any():
            return
        least_leap, is_back = leap_lengths[new_indices], np.zeros(len(new_indices), np.bool_)
        for step_count in range(2, _MOST_LEAPS + 1):
            earlier_indices = np.maximum(new_indices - step_count, 0)
            least_leap = np.minimum(least_leap, leap_lengths[earlier_indices + 1])
            offset = position[new_indices] - position[earlier_indices]
            is_same_object = (name_codes[earlier_indices] == name_codes[new_indices]) & (
                new_indices >= step_count
            )
            # an object is back within a quarter of the shortest leap since its earlier position
            is_back |= is_same_object & (np.hypot(offset[:, 0], offset[:, 1]) < least_leap / 4)
        is_slow = (
            is_back & (step_s[new_indices] >= 1.0) & (leap_lengths[new_indices] < _FAST * step_s[new_indices])
        )
        self.returns += int(np.count_nonzero(is_back))
        self.slow_returns += int(np.count_nonzero(is_slow))
        if self.return_moment is None and is_back.any():
            return_index = new_indices[is_back.argmax()]
            self.return_moment = Moment(
                self._name(reports[return_index]),
                self._time_ns(reports[return_index - 1]),
                float(leap_lengths[return_index - 1]),
            )

    @property
    def steps(self) -> int:
        """Number of steps with a course and an angle."""
        return self._steps

    @property
    def course(self) -> complex:
        return complex(self._courses[-1]) / max(1, self._steps)

    @property
    def courses(self) -> dict[str, complex]:
        means = self._courses / max(1, self._steps)
        return dict(zip(("read", *HEADINGS), map(complex, means[:-1]), strict=True))

    def _name(self, report: Floats) -> str:
        return str(self._names.by_code[int(report[_NAME])])

    def _time_ns(self, report: Floats) -> int:
        return self._begin_ns + int(report[_SECONDS] * 1e9)


_MOST_CHANGES: Final = 8
"""Limit of kept changes of classes."""


class _Objects(NamedTuple):
    """Objects that wait to be measured.

    Attributes:
        first: number of the topic's messages before the first of these messages.
    """

    first: int
    times_ns: Integers
    detections: Detections
    shapes: FootprintBatch
    yaw: Floats
    uncertainty: Floats


class TopicEvidence:
    """Measurements of the messages of one mapped topic, and of their objects and signals.

    Attributes:
        arrivals: arrivals of the topic's messages.
        motions: motions of the topic's objects.
        objects: number of reports of objects.
        most_at_once: greatest number of objects in one message.
        quaternion_length: lengths of quaternions, except quaternions of zeros.
        quaternions: number of quaternions, except quaternions of zeros.
        upright: number of upright objects if quaternions have the mapping's order.
        upright_otherwise: number of upright objects if w is at the other end of quaternions.
        turned_otherwise: number of objects in `upright_otherwise` with a turn of more than 20 degrees.
        turn: raw angles that are read as yaw.
        first_turn: greatest absolute raw angle in the first message with angles.
        low, high: (3,) least and greatest coordinates, as the messages give them.
        is_single: whether coordinates are float32 numbers. Only degrees, and coordinates far from the origin,
            are tested.
        has_fraction: whether some coordinates tested for `is_single` are not integers.
        size: longer sides of outlines.
        shorter: shorter sides of outlines.
        pointlike: number of objects whose sides are 0.
        bottom, top: heights of the objects.
        uncertainty: radii of uncertainty.
        covariances: number of covariances.
        zero_covariances: number of covariances with zeros only.
        signal_chances: number of messages with signals, except the first two messages.
        signal_returns: (S,) number of messages in which a signal is back at its value of two messages before.
    """

    def __init__(self, reader: TopicReader, names: Codes, classes: Codes) -> None:
        self.reader = reader
        self.names, self.classes = names, classes
        self.arrivals = Arrivals()
        self.motions = Motions(names, classes)
        self.objects = self.most_at_once = 0
        self.name_codes: set[int] = set()
        self.class_codes: set[int] = set()
        self.quaternion_length, self.turn = Spread(), Spread()
        self.first_turn = nan
        self.upright = self.upright_otherwise = self.turned_otherwise = self.quaternions = 0
        self.low, self.high = np.full(3, inf), np.full(3, -inf)
        self.is_single, self.has_fraction = True, False
        self.size, self.shorter, self.pointlike = Spread(), Spread(), 0
        self.bottom, self.top, self.uncertainty = Spread(), Spread(), Spread()
        self.zero_covariances = self.covariances = 0
        self._messages = 0
        self._binding: Binding | None = None
        self._waiting: list[_Objects] = []
        self._waiting_rows = 0
        self._reports: list[Floats] = []
        self._reports_rows = 0
        mapping = reader.planned.mapping
        signal_count = 0 if mapping is None else len(mapping.signals)
        self.signal_chances, self.signal_returns = 0, np.zeros(signal_count, np.int64)
        self._last_values = np.empty((0, signal_count))
        self._waiting_signals: list[Floats] = []
        self._waiting_values = 0

    @property
    def planned(self) -> PlannedTopic:
        """Plan for the topic."""
        return self.reader.planned

    @property
    def uses_frames(self) -> bool:
        """Whether transforms place the topic's objects."""
        return self.reader.needs_frame and self.reader.extractor is not None

    @property
    def uses_stamps(self) -> bool:
        """Whether stamps affect the times or the places of objects."""
        return self.planned.clock == "header" or self.uses_frames

    @property
    def has_moving_stamps(self) -> bool:
        """Whether stamps vary; False for topics whose messages stay valid, such as latched topics."""
        planned, arrivals = self.planned, self.arrivals
        stays = (
            planned.is_latched or planned.is_lasting or (planned.layout is not None and planned.layout.stays)
        )
        return not stays and arrivals.stamps_vary

    @property
    def frames(self) -> frozenset[str]:
        """Names of frames in the topic's messages."""
        extractor = self.reader.extractor
        return frozenset() if extractor is None else frozenset(extractor.noted_frames - {""})

    @property
    def turn_path(self) -> str:
        """Path of the yaw; "" without a yaw."""
        layout = self.planned.layout
        return "" if layout is None else next(iter(layout.yaw), "")

    @property
    def is_called_heading(self) -> bool:
        """Whether the name of the yaw's field means an angle from north, such as `heading`."""
        return bool(_HEADING.search(self.turn_path))

    @property
    def has_given_heading(self) -> bool:
        """Whether the mapping gives the yaw's zero and direction."""
        mapping = self.planned.mapping
        return mapping is not None and mapping.yaw is not None and not mapping.yaw.is_plain

    @property
    def is_called_degrees(self) -> bool:
        """Whether the fields of the position are named latitude and longitude."""
        layout = self.planned.layout
        return layout is not None and any(geodetic_order(paths) is not None for paths in layout.position[:1])

    @property
    def angle_path(self) -> str:
        """Path of a coordinate whose name means an angle; "" without such a coordinate."""
        position = None if self.planned.mapping is None else self.planned.mapping.position
        paths = position if isinstance(position, tuple) else ()
        return next((path for path in paths if _ANGLE.search(path)), "")

    @property
    def object_names(self) -> frozenset[str]:
        """Names of the topic's objects."""
        return frozenset(str(self.names.by_code[code]) for code in self.name_codes)

    def add_objects(
        self,
        detections: Detections,
        shapes: FootprintBatch,
        yaw: Floats,
        uncertainty: Floats,
        times_ns: Integers,
    ) -> None:
        """Add the objects of messages, with their footprints, angles and radii in the fixed frame.

        Args:
            times_ns: (M,) time of each message.
        """
        first_message, self._messages = self._messages, self._messages + len(times_ns)
        if not len(detections.name):
            return
        binding = None if self.reader.extractor is None else self.reader.extractor.binding
        if binding is not self._binding:
            self._measure()
            self._binding = binding
        self._waiting.append(_Objects(first_message, times_ns, detections, shapes, yaw, uncertainty))
        self._waiting_rows += len(detections.name)
        if self._waiting_rows >= _ROWS_AT_ONCE:
            self._measure()

    def add_signals(self, values: Floats) -> None:
        """Add the signals (N, S) of messages, in order."""
        self._waiting_signals.append(values)
        self._waiting_values += values.size
        if self._waiting_values >= _ROWS_AT_ONCE:
            self._measure_signals()

    def settle(self) -> None:
        """Measure all waiting messages, objects and signals, at the end of the log."""
        self.arrivals.settle()
        self._measure()
        self._measure_signals()
        self._measure_motions(self._reports_rows)

    def _measure(self) -> None:
        if not self._waiting:
            return
        waiting_objects, self._waiting, self._waiting_rows = self._waiting, [], 0
        detections = [objects.detections for objects in waiting_objects]
        name_codes = np.concatenate([detected.name for detected in detections])
        class_code = np.concatenate([detected.class_code for detected in detections])
        message_numbers = np.concatenate(
            [objects.first + objects.detections.message for objects in waiting_objects]
        )
        yaw, uncertainty = (
            np.concatenate(columns)
            for columns in zip(
                *((objects.yaw, objects.uncertainty) for objects in waiting_objects), strict=True
            )
        )
        shapes = FootprintBatch.concatenate([objects.shapes for objects in waiting_objects])
        self.objects += len(name_codes)
        message_starts = np.flatnonzero(np.diff(message_numbers, prepend=-1))
        self.most_at_once = max(self.most_at_once, int(np.diff(message_starts, append=len(name_codes)).max()))
        self.name_codes.update(name_codes.tolist())
        self.class_codes.update(class_code.tolist())
        numbers = self._measure_numbers(detections, message_numbers)
        self.uncertainty.add(uncertainty)
        for detected in detections:
            if detected.covariance is not None:
                self.covariances += len(detected.name)
                is_set = detected.covariance.reshape(len(detected.name), -1).any(axis=1)
                self.zero_covariances += int(np.count_nonzero(~is_set))
        centre, sides = extents(shapes)
        longer_sides = sides.max(axis=1)
        self.size.add(longer_sides)
        self.shorter.add(sides.min(axis=1))
        self.pointlike += int(np.count_nonzero(longer_sides == 0.0))
        self.bottom.add(shapes.bottom)
        self.top.add(shapes.top)
        report_times_ns = np.concatenate(
            [objects.times_ns[objects.detections.message] for objects in waiting_objects]
        )
        reports = np.empty((len(name_codes), _IS_NEW + 1))
        reports[:, _NAME] = name_codes
        reports[:, _MESSAGE] = message_numbers
        reports[:, _SECONDS] = (report_times_ns - (self.arrivals.first_ns or 0)) / 1e9
        reports[:, _X : _Y + 1] = centre
        reports[:, _YAW] = yaw
        reports[:, _TURN] = nan
        if numbers is not None and self._binding is not None and self._binding.yaw is not None:
            reports[:, _TURN] = numbers[:, self._binding.yaw]
        reports[:, _SIZE] = longer_sides
        reports[:, _CLASS] = class_code
        reports[:, _IS_NEW] = 1.0
        self._reports.append(reports)
        self._reports_rows += len(reports)
        self._measure_motions(self._reports_rows // _ROWS_AT_ONCE * _ROWS_AT_ONCE)

    def _measure_motions(self, report_count: int) -> None:
        """Measure the motions of the first `report_count` reports, in parts of fixed size.

        Parts, and so results, do not depend on the division of the log into calls.
        """
        if not report_count:
            return
        layout = self.planned.layout
        reports = np.concatenate(self._reports)
        for begin in range(0, report_count, _ROWS_AT_ONCE):
            # no warnings about NaN, infinity, or division by 0
            with np.errstate(all="ignore"):
                self.motions.add(
                    reports[begin : min(begin + _ROWS_AT_ONCE, report_count)],
                    self.arrivals.first_ns or 0,
                    turns_back=self.reader.axes.y == "down",
                    zero=0.0 if layout is None else layout.angle_zero,
                    scale=1.0 if layout is None else layout.angle_scale,
                )
        self._reports, self._reports_rows = [reports[report_count:]], len(reports) - report_count

    def _measure_signals(self) -> None:
        """Update `signal_chances` and `signal_returns`."""
        if not self._waiting_values:
            return
        values = np.concatenate([self._last_values, *self._waiting_signals])
        self._waiting_signals, self._waiting_values = [], 0
        self._last_values = values[-2:]
        if len(values) < 3:
            return
        with np.errstate(all="ignore"):
            steps = np.abs(np.diff(values, axis=0))
            smaller_step = np.minimum(steps[1:], steps[:-1])
            is_back = np.abs(values[2:] - values[:-2]) < smaller_step / 4
            is_switch = (np.fmin.reduce(values) == 0) & (np.fmax.reduce(values) == 1)
        self.signal_chances += len(is_back)
        self.signal_returns[: values.shape[1]] += np.where(is_switch, 0, is_back.sum(axis=0))

    def _measure_numbers(self, detections: Sequence[Detections], message_numbers: Integers) -> Floats | None:
        """Measure the raw numbers of messages; return these numbers, or None without a binding."""
        binding = self._binding
        number_arrays = [detected.numbers for detected in detections if detected.numbers is not None]
        numbers = (
            np.concatenate(number_arrays)
            if binding is not None and len(number_arrays) == len(detections)
            else None
        )
        positions = np.concatenate([detected.poses.position for detected in detections])
        if binding is not None and numbers is not None:
            if binding.orientation:
                self._measure_quaternions(numbers[:, list(binding.orientation)])
            if binding.yaw is not None:
                raw_angles = numbers[:, binding.yaw]
                self.turn.add(raw_angles)
                is_finite = np.isfinite(raw_angles)
                if not self.first_turn >= 0 and is_finite.any():
                    is_first = message_numbers == message_numbers[is_finite.argmax()]
                    self.first_turn = float(np.fmax.reduce(np.abs(raw_angles[is_first])))
            if binding.position:
                positions = numbers[:, list(binding.position[:3])]
            else:
                points = [detected.solids.points for detected in detections if len(detected.solids.points)]
                positions = np.concatenate(points) if points else positions
        with np.errstate(all="ignore"):
            low, high = np.fmin.reduce(positions, axis=0), np.fmax.reduce(positions, axis=0)
        axes = slice(positions.shape[1])
        self.low[axes], self.high[axes] = np.fmin(self.low[axes], low), np.fmax(self.high[axes], high)
        # the resolution of float32 matters for degrees, and far from the origin
        is_far = self.planned.is_geodetic or np.fmax.reduce(np.abs([*low, *high])) > _FAR
        if self.is_single and is_far:
            plane_positions = positions[:, :2]
            if not self.planned.is_geodetic:
                plane_positions = plane_positions[(np.abs(plane_positions) > _FAR).any(axis=1)]
            is_finite = np.isfinite(plane_positions)
            self.is_single = bool((plane_positions.astype(np.float32) == plane_positions)[is_finite].all())
            self.has_fraction = self.has_fraction or bool(
                (plane_positions != np.rint(plane_positions))[is_finite].any()
            )
        return numbers

    def _measure_quaternions(self, quaternions: Floats) -> None:
        lengths = np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))
        is_set = lengths > 0
        quaternions, lengths = quaternions[is_set], lengths[is_set]
        self.quaternion_length.add(lengths)
        self.quaternions += len(lengths)
        x, y, z, w = (quaternions / lengths[:, None]).T
        # the tilt of an object's z axis has the cosine 1 - 2 (x * x + y * y)
        self.upright += int(np.count_nonzero(x * x + y * y < _LEVEL))
        layout = self.planned.layout
        # in the other order, the numbers named w, x, y (or y, z, w) are x, y, z
        is_w_first = layout is not None and layout.order == "wxyz"
        other_x, other_y, other_z = (w, x, y) if is_w_first else (y, z, w)
        is_upright = other_x * other_x + other_y * other_y < _LEVEL
        self.upright_otherwise += int(np.count_nonzero(is_upright))
        self.turned_otherwise += int(np.count_nonzero(is_upright & (np.abs(other_z) > _TURNED)))


_FAR: Final = 1e4
"""Least coordinate at which the resolution of float32 is measured."""
_LEVEL: Final = 0.0076
"""Limit of x * x + y * y of an upright object's quaternion: (1 - cos 10 degrees) / 2."""
_TURNED: Final = 0.174
"""Least z of a turned object's quaternion: sin(20 degrees / 2)."""


def extents(shapes: FootprintBatch) -> tuple[Floats, Floats]:
    """Return centres and sides (R, 2) of the boxes around footprints; NaN for unknown footprints."""
    footprint_count = len(shapes.part_start) - 1
    part_starts, first_vertices = shapes.part_start, shapes.vertex_start[shapes.part_start]
    has_parts = first_vertices[1:] > first_vertices[:-1]
    low, high = np.full((footprint_count, 2), nan), np.full((footprint_count, 2), nan)
    if has_parts.any():
        # footprints without vertices are skipped, because reduceat would return a vertex of the next
        # footprint
        vertex_starts = first_vertices[:-1][has_parts]
        radius = np.maximum.reduceat(shapes.radius, part_starts[:-1][has_parts])[:, None]
        low[has_parts] = np.minimum.reduceat(shapes.vertices, vertex_starts, axis=0) - radius
        high[has_parts] = np.maximum.reduceat(shapes.vertices, vertex_starts, axis=0) + radius
    # coordinates of a log may be infinite
    with np.errstate(invalid="ignore"):
        return (low + high) / 2, high - low
