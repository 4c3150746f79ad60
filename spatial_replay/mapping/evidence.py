"""Evidence of how a log was read: arrivals and objects of each topic in, measurements out.

Measurements cover every message and object, in columns, while the log is read. Medians come from a sample of
the values. `assumptions` compares the measurements with what a mapping assumes.
"""

from __future__ import annotations

import re
from math import inf, nan, pi
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.mapping.binding import Codes
from spatial_replay.mapping.detections import Detections
from spatial_replay.mapping.message_types import geodetic_order
from spatial_replay.mapping.reading_plan import PlannedTopic
from spatial_replay.mapping.topic_reader import TopicReader

_HEADING: Final = re.compile(r"heading|course|bearing|azimuth|cog$", re.I)
"""Names of fields that hold angles from north, clockwise."""

_ANGLE: Final = re.compile(r"(^|[._])(bearing|azimuth|heading|theta|phi|yaw|angle)$", re.I)
"""Names of fields that hold angles."""

_MOST_VALUES: Final = 4_096
"""Values that a `Spread` holds for its median."""

_ROWS_AT_ONCE: Final = 4_096
"""Objects that wait until they are measured, because a column of few costs as much as one of many."""

_LONGEST_GAP: Final = 8
"""Messages from one report of an object to the next; longer gaps count as this one."""


class Spread:
    """The least, the median and the greatest of values, and when the greatest came.

    Values that are not finite are left out. The median is that of evenly spaced values.
    """

    __slots__ = ("_held", "_stride", "count", "greatest", "greatest_ns", "least")

    def __init__(self) -> None:
        self.count, self.least, self.greatest, self.greatest_ns = 0, inf, -inf, 0
        self._held, self._stride = np.empty(0), 1

    def add(self, values: Floats, times_ns: Integers | None = None) -> None:
        """Add values (N,) with their times (N,)."""
        is_finite = np.isfinite(values)
        if not is_finite.all():
            values = values[is_finite]
            times_ns = None if times_ns is None else times_ns[is_finite]
        if not len(values):
            return
        at = int(values.argmax())
        if values[at] > self.greatest:
            self.greatest, self.greatest_ns = float(values[at]), 0 if times_ns is None else int(times_ns[at])
        self.least = min(self.least, float(values.min()))
        held = np.concatenate([self._held, values[-self.count % self._stride :: self._stride]])
        while len(held) > _MOST_VALUES:
            held, self._stride = held[::2], 2 * self._stride
        self._held = held
        self.count += len(values)

    @property
    def median(self) -> float:
        """The median; NaN without values."""
        return float(np.median(self._held)) if len(self._held) else nan

    def quantile(self, share: float) -> float:
        """Return the value below which a share of the values lies; NaN without values."""
        return float(np.quantile(self._held, share)) if len(self._held) else nan


class Moment(NamedTuple):
    """Something that happened to an object: its name, when, and by how much."""

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
    """When the messages of a topic came, from whom, and what their clocks say.

    Attributes:
        messages: their number.
        first_ns, last_ns: the first and the last time on the topic's clock.
        period_s, log_period_s: the intervals between messages, and between their times of recording.
        lateness_s: how much later messages were recorded than their stamps say.
        publish_varies, log_varies: whether publish times, and log times, differ at all.
        publishers: numbers of the channels; `switches` counts messages from another one than the message
            before.
        longest_still_s: the longest time for which stamps stood still; `still_ns` is when that began.
    """

    def __init__(self) -> None:
        self.messages = self.switches = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.period_s, self.lateness_s = Spread(), Spread()
        self.publish_varies = self.log_varies = False
        self.publishers: set[int] = set()
        self.log_period_s = Spread()
        self.longest_still_s, self.still_ns = 0.0, 0
        self._first_log_ns = self._first_publish_ns = 0
        self._publisher: int | None = None
        self._stamp_ns: int | None = None
        self._since_ns = 0

    def add(self, times_ns: Integers, log_ns: Integers, publish_ns: Integers, channels: Integers) -> None:
        """Add messages in the order of arrival, all (N,)."""
        if not len(times_ns):
            return
        if self.first_ns is None or self.last_ns is None:
            self.first_ns = self.last_ns = int(times_ns[0])
            self._first_log_ns, self._first_publish_ns = int(log_ns[0]), int(publish_ns[0])
            self._publisher = int(channels[0])
        self.log_varies = self.log_varies or bool((log_ns != self._first_log_ns).any())
        self.publish_varies = self.publish_varies or bool((publish_ns != self._first_publish_ns).any())
        since = np.append(self.last_ns, times_ns)
        passed = slice(0 if self.messages else 1, None)
        self.period_s.add(np.diff(since)[passed] / 1e9, times_ns[passed])
        self.log_period_s.add(np.diff(log_ns) / 1e9)
        if len(self.publishers) != 1 or (channels != self._publisher).any():
            self.publishers.update(np.unique(channels).tolist())
            before = np.append(self._publisher or 0, channels[:-1])
            self.switches += int(np.count_nonzero(channels != before))
        self._publisher = int(channels[-1])
        self.messages += len(times_ns)
        self.last_ns = int(times_ns[-1])

    def add_stamps(self, stamps_ns: Integers, log_ns: Integers) -> None:
        """Add the stamps of some messages, in order, and when these were recorded."""
        is_set = stamps_ns != 0
        stamps_ns, log_ns = stamps_ns[is_set], log_ns[is_set]
        if not len(stamps_ns):
            return
        self.lateness_s.add((log_ns - stamps_ns) / 1e9)
        if self._stamp_ns is None:
            self._stamp_ns, self._since_ns = int(stamps_ns[0]), int(log_ns[0])
        is_new = np.append(stamps_ns[0] != self._stamp_ns, stamps_ns[1:] != stamps_ns[:-1])
        since_ns = np.where(is_new, log_ns, 0)
        since_ns[0] = since_ns[0] or self._since_ns
        since_ns = np.maximum.accumulate(since_ns)
        still_s = (log_ns - since_ns) / 1e9
        at = int(still_s.argmax())
        if still_s[at] > self.longest_still_s:
            self.longest_still_s, self.still_ns = float(still_s[at]), int(since_ns[at])
        self._stamp_ns, self._since_ns = int(stamps_ns[-1]), int(since_ns[-1])


_NAME, _MESSAGE, _SECONDS, _X, _Y, _YAW, _TURN, _SIZE, _CLASS, _IS_NEW = range(10)
"""Columns of the reports of objects that are measured together."""

HEADINGS: Final[dict[str, tuple[float, float]]] = {
    "unit: rad": (0.0, 1.0),
    "unit: deg": (0.0, pi / 180),
    "unit: rad, zero: north, clockwise: true": (pi / 2, -1.0),
    "unit: deg, zero: north, clockwise: true": (pi / 2, -pi / 180),
    "unit: rad, zero: east, clockwise: true": (0.0, -1.0),
    "unit: deg, zero: east, clockwise: true": (0.0, -pi / 180),
}
"""Readings of a number as a yaw, in the keys of a mapping: the yaw at 0, and that of one unit, in radians."""


class Motions:
    """How the objects of a topic move, from one report of each to its next.

    Attributes:
        speed, turn_rate: in footprint units, and radians, a second.
        jump: the longest step of an object; `jump_s` is how long it took.
        triples: how many times an object was reported three times in a row; in `returns` of them it left by
            more than its size, and came back. `return_moment` is the first.
        gaps: (9,) how often so many messages passed from one report of an object to its next.
        changes: the first changes of classes; `change_count` counts all.
        courses: for the angle as it is read, and for each of `HEADINGS`: the mean of exp(i (course - angle))
            over the steps of objects that move, and `course`, the mean of exp(i course).
    """

    def __init__(self, names: Codes, classes: Codes) -> None:
        self._names, self._classes = names, classes
        self.speed, self.turn_rate = Spread(), Spread()
        self.jump: Moment | None = None
        self.jump_s = 0.0
        self.triples = self.returns = 0
        self.return_moment: Moment | None = None
        self.gaps = np.zeros(_LONGEST_GAP + 1, np.int64)
        self.changes: list[ClassChange] = []
        self.change_count = 0
        self._courses = np.zeros(len(HEADINGS) + 2, np.complex128)
        self._steps = 0
        self._begin_ns = 0
        self._tail = np.empty((0, _IS_NEW + 1))

    def add(self, reports: Floats, begin_ns: int, *, turns_back: bool, zero: float, scale: float) -> None:
        """Add reports (R, 10) of objects in the order of messages.

        Args:
            begin_ns: the time from which their seconds count.
            turns_back: whether angles of messages run clockwise in our axes.
            zero, scale: the angle is read as `zero` radians and `scale` times its number.
        """
        self._begin_ns = begin_ns
        reports = np.concatenate([self._tail, reports])
        name = reports[:, _NAME].astype(np.int64)
        reports = reports[np.argsort(name, kind="stable")]
        same = reports[1:, _NAME] == reports[:-1, _NAME]
        is_last = np.append(~same, True)
        is_before_last = np.append(is_last[1:], False) & np.append(same, False)
        self._tail = reports[is_last | is_before_last].copy()
        self._tail[:, _IS_NEW] = 0.0
        after = np.flatnonzero(same & (reports[1:, _IS_NEW] > 0)) + 1
        if not len(after):
            return
        earlier, later = reports[after - 1], reports[after]
        self._add_steps(earlier, later, turns_back=turns_back, zero=zero, scale=scale)
        thrice = after[(after > 1) & same[np.maximum(after - 2, 0)]]
        self._add_returns(reports[thrice - 2], reports[thrice - 1], reports[thrice])
        gap = np.clip(later[:, _MESSAGE] - earlier[:, _MESSAGE], 0, _LONGEST_GAP).astype(np.int64)
        self.gaps += np.bincount(gap, minlength=_LONGEST_GAP + 1)
        for at in np.flatnonzero(earlier[:, _CLASS] != later[:, _CLASS]).tolist():
            self.change_count += 1
            if len(self.changes) < _MOST_CHANGES:
                before, now = (self._classes.by_code[int(row[at, _CLASS])] for row in (earlier, later))
                self.changes.append(ClassChange(self._name(later[at]), before, now, self._time_ns(later[at])))

    def _add_steps(
        self, earlier: Floats, later: Floats, *, turns_back: bool, zero: float, scale: float
    ) -> None:
        seconds = later[:, _SECONDS] - earlier[:, _SECONDS]
        step = later[:, _X : _Y + 1] - earlier[:, _X : _Y + 1]
        distance = np.hypot(step[:, 0], step[:, 1])
        times_ns = self._begin_ns + (later[:, _SECONDS] * 1e9).astype(np.int64)
        self.speed.add(np.where(seconds > 0, distance / seconds, nan), times_ns)
        turn = np.abs((later[:, _YAW] - earlier[:, _YAW] + pi) % (2 * pi) - pi)
        self.turn_rate.add(np.where(seconds > 0, turn / seconds, nan), times_ns)
        at = int(np.nan_to_num(distance, nan=0.0).argmax())
        if distance[at] > (self.jump.amount if self.jump is not None else 0.0):
            self.jump = Moment(self._name(later[at]), int(times_ns[at]), float(distance[at]))
            self.jump_s = float(seconds[at])
        # noise has no course, so short steps are left out
        moves = (distance >= self.speed.median / 2 * seconds) & (distance > 0) & np.isfinite(later[:, _TURN])
        if not moves.any():
            return
        course = np.arctan2(step[moves, 1], step[moves, 0])
        yaw, number = earlier[moves, _YAW], earlier[moves, _TURN]
        sign = -1.0 if turns_back else 1.0
        readings = (base - zero + (unit - scale) * number for base, unit in HEADINGS.values())
        angles = [yaw, *(yaw + sign * reading for reading in readings)]
        offsets = [np.exp(1j * (course - angle)).sum() for angle in angles]
        self._courses += np.array([*offsets, np.exp(1j * course).sum()])
        self._steps += int(np.count_nonzero(moves))

    def _add_returns(self, first: Floats, second: Floats, third: Floats) -> None:
        if not len(first):
            return
        away = np.hypot(*(second - first)[:, _X : _Y + 1].T)
        back = np.hypot(*(third - second)[:, _X : _Y + 1].T)
        between = np.hypot(*(third - first)[:, _X : _Y + 1].T)
        least = np.minimum(away, back)
        returns = (least > second[:, _SIZE]) & (between < least / 4)
        self.triples += int(np.isfinite(least).sum())
        self.returns += int(np.count_nonzero(returns))
        if self.return_moment is None and returns.any():
            at = int(returns.argmax())
            self.return_moment = Moment(self._name(second[at]), self._time_ns(second[at]), float(away[at]))

    @property
    def steps(self) -> int:
        """How many steps have a course and an angle."""
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


class TopicEvidence:
    """What the messages of one mapped topic say about how it is read.

    Attributes:
        arrivals, motions: of its messages and objects.
        objects: the number of reports; `most_at_once` in one message.
        quaternion_length: of the `quaternions` that are not zeros; `upright` and `upright_otherwise`
            count upright objects in the order that is read, and with w at the other end.
        turn: the numbers that are read as yaw.
        low, high: (3,) the least and the greatest coordinates, in the numbers of the messages.
        is_single: whether float32 holds all coordinates, and some are no whole numbers.
        size: the longer sides of outlines; `shorter` the shorter; `pointlike` counts objects that have none.
        bottom, top: heights of the objects.
        uncertainty: the radii; `zero_covariances` counts covariances of zeros only.
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
        self.upright = self.upright_otherwise = self.quaternions = 0
        self.low, self.high = np.full(3, inf), np.full(3, -inf)
        self.is_single, self.has_fraction = True, False
        self.size, self.shorter, self.pointlike = Spread(), Spread(), 0
        self.bottom, self.top, self.uncertainty = Spread(), Spread(), Spread()
        self.zero_covariances = self.covariances = 0
        self._messages = 0
        self._waiting: list[Floats] = []
        self._waiting_rows = 0

    @property
    def planned(self) -> PlannedTopic:
        """How the topic is read."""
        return self.reader.planned

    @property
    def uses_frames(self) -> bool:
        """Whether objects are placed by transforms at their stamps."""
        return self.reader.needs_frame and self.reader.extractor is not None

    @property
    def frames(self) -> frozenset[str]:
        """The frames of its objects that messages name."""
        extractor = self.reader.extractor
        return frozenset() if extractor is None else frozenset(extractor.noted_frames - {""})

    @property
    def turn_path(self) -> str:
        """The field of the yaw; "" without one."""
        layout = self.planned.layout
        return "" if layout is None else next(iter(layout.yaw), "")

    @property
    def is_called_heading(self) -> bool:
        """Whether the field of the yaw has the name of an angle from north."""
        return bool(_HEADING.search(self.turn_path))

    @property
    def has_given_heading(self) -> bool:
        """Whether the mapping says from where the yaw counts."""
        mapping = self.planned.mapping
        return mapping is not None and mapping.yaw is not None and not mapping.yaw.is_plain

    @property
    def is_called_degrees(self) -> bool:
        """Whether positions are fields with the names of latitude and longitude."""
        layout = self.planned.layout
        return layout is not None and any(geodetic_order(paths) is not None for paths in layout.position[:1])

    @property
    def angle_path(self) -> str:
        """The field of a coordinate that has the name of an angle; "" for none."""
        position = None if self.planned.mapping is None else self.planned.mapping.position
        paths = position if isinstance(position, tuple) else ()
        return next((path for path in paths if _ANGLE.search(path)), "")

    @property
    def object_names(self) -> frozenset[str]:
        """The names of its objects."""
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
            times_ns: (M,) of each message.
        """
        count = len(detections.name)
        first, self._messages = self._messages, self._messages + len(times_ns)
        if not count:
            return
        self.objects += count
        self.most_at_once = max(self.most_at_once, int(np.bincount(detections.message).max()))
        self.name_codes.update(np.unique(detections.name).tolist())
        self.class_codes.update(np.unique(detections.class_code).tolist())
        self._add_numbers(detections)
        self.uncertainty.add(uncertainty)
        if detections.covariance is not None:
            self.covariances += count
            is_zero = ~detections.covariance.reshape(count, -1).any(axis=1)
            self.zero_covariances += int(np.count_nonzero(is_zero))
        centre, sides = extents(shapes)
        longer = sides.max(axis=1)
        self.size.add(longer)
        self.shorter.add(sides.min(axis=1))
        self.pointlike += int(np.count_nonzero(longer == 0.0))
        self.bottom.add(shapes.bottom)
        self.top.add(shapes.top)
        begin_ns = self.arrivals.first_ns or 0
        reports = np.empty((count, _IS_NEW + 1))
        reports[:, _NAME] = detections.name
        reports[:, _MESSAGE] = first + detections.message
        reports[:, _SECONDS] = (times_ns[detections.message] - begin_ns) / 1e9
        reports[:, _X : _Y + 1] = centre
        reports[:, _YAW] = yaw
        reports[:, _TURN] = self._turns(detections)
        reports[:, _SIZE] = longer
        reports[:, _CLASS] = detections.class_code
        reports[:, _IS_NEW] = 1.0
        self._waiting.append(reports)
        self._waiting_rows += count
        if self._waiting_rows >= _ROWS_AT_ONCE:
            self.settle()

    def settle(self) -> None:
        """Measure the objects that wait."""
        if not self._waiting:
            return
        layout = self.planned.layout
        # numbers of a log may be NaN, infinite and equal
        with np.errstate(all="ignore"):
            self.motions.add(
                np.concatenate(self._waiting),
                self.arrivals.first_ns or 0,
                turns_back=self.reader.axes.y == "down",
                zero=0.0 if layout is None else layout.angle_zero,
                scale=1.0 if layout is None else layout.angle_scale,
            )
        self._waiting, self._waiting_rows = [], 0

    def _turns(self, detections: Detections) -> Floats | float:
        binding = None if self.reader.extractor is None else self.reader.extractor.binding
        if binding is None or binding.yaw is None or detections.numbers is None:
            return nan
        return detections.numbers[:, binding.yaw]

    def _add_numbers(self, detections: Detections) -> None:
        """Add the numbers as messages have them."""
        binding = None if self.reader.extractor is None else self.reader.extractor.binding
        numbers = detections.numbers
        places = detections.poses.position
        if binding is not None and numbers is not None:
            if binding.orientation:
                self._add_quaternions(numbers[:, list(binding.orientation)])
            if binding.yaw is not None:
                self.turn.add(numbers[:, binding.yaw])
            if binding.position:
                places = numbers[:, list(binding.position[:3])]
            elif len(detections.solids.points):
                places = detections.solids.points
        with np.errstate(all="ignore"):
            low, high = np.fmin.reduce(places, axis=0), np.fmax.reduce(places, axis=0)
        axes = slice(places.shape[1])
        self.low[axes], self.high[axes] = np.fmin(self.low[axes], low), np.fmax(self.high[axes], high)
        # single precision matters for degrees, and far from the origin
        is_far = self.planned.is_geodetic or np.fmax.reduce(np.abs([*low, *high])) > _FAR
        if self.is_single and is_far:
            plane = places[:, :2]
            is_finite = np.isfinite(plane)
            self.is_single = bool((plane.astype(np.float32) == plane)[is_finite].all())
            self.has_fraction = self.has_fraction or bool((plane != np.rint(plane))[is_finite].any())

    def _add_quaternions(self, quaternions: Floats) -> None:
        length = np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))
        is_set = length > 0
        quaternions, length = quaternions[is_set], length[is_set]
        self.quaternion_length.add(length)
        self.quaternions += len(length)
        x, y, z, w = (quaternions / length[:, None]).T
        # the z axis of an object points up where the squares of its x and y are small
        self.upright += int(np.count_nonzero(x * x + y * y < _LEVEL))
        layout = self.planned.layout
        # in the other order, w stands for x and x for y, or y for x and z for y
        first, second = (w, x) if layout is not None and layout.order == "wxyz" else (y, z)
        self.upright_otherwise += int(np.count_nonzero(first * first + second * second < _LEVEL))


_FAR: Final = 1e4
"""Coordinates from which on the steps of float32 are worth a look."""
_LEVEL: Final = 0.0076
"""Twice this is 1 - cos 10 degrees: objects tilted by less count as upright."""


def extents(shapes: FootprintBatch) -> tuple[Floats, Floats]:
    """Return the centres and the sides (R, 2) of the boxes around footprints; NaN for unknown ones."""
    count = len(shapes.part_start) - 1
    parts, vertices = shapes.part_start, shapes.vertex_start[shapes.part_start]
    has_parts = vertices[1:] > vertices[:-1]
    low, high = np.full((count, 2), nan), np.full((count, 2), nan)
    if has_parts.any():
        # rows without vertices begin where the next one does
        starts = vertices[:-1][has_parts]
        radius = np.maximum.reduceat(shapes.radius, parts[:-1][has_parts])[:, None]
        low[has_parts] = np.minimum.reduceat(shapes.vertices, starts, axis=0) - radius
        high[has_parts] = np.maximum.reduceat(shapes.vertices, starts, axis=0) + radius
    return (low + high) / 2, high - low
