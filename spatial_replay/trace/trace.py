"""Samples, traces with a cache of measurements, pauses of a log, and time points that users write.

Times are whole nanoseconds (signed 64-bit).
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from reprlib import repr as shortened
from threading import Lock
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import TraceError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers, read_only_floats, read_only_integers
from spatial_replay.geometry.footprint import Footprint, FootprintBatch, TrackedObject
from spatial_replay.lazy import Displayed
from spatial_replay.text import (
    Instant,
    Sentence,
    is_encodable,
    named_arguments,
    names_from_unit,
    plural,
    text_number,
    times_apart,
)
from spatial_replay.trace.doubts import Doubt
from spatial_replay.trace.spans import TopicSpan, join_spans

LATEST_NS = 2**63 - 1
"""The latest time of a sample."""

FOREVER = LATEST_NS + 1
"""A time after every sample."""


def require_time(value: object, name: str) -> None:
    """Check that a value is None or a time in ns.

    Raises:
        UsageError: the value is not None and not an integer of at least 0.
    """
    if value is None:
        return
    # a truth value is an integer in Python
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
        raise UsageError(f"{name} is {shortened(value)}; give integer nanoseconds, 0 or more")


def _require_name(name: object, kind: str) -> None:
    if not isinstance(name, str) or not name:
        raise TraceError(f"{kind} is named {shortened(name)}; give a text that is not empty")
    if not is_encodable(name):
        raise TraceError(
            f"{kind} is named {shortened(name)}, with half a character (a lone surrogate), which no log can"
            ' hold; decode names with errors="replace"'
        )


_EXAMPLES = MappingProxyType(
    {
        "objects": "{'cup': Footprint.disc(0, 0, 0.1)}",
        "signals": "{'battery': 0.8}",
        "unknown": "{'cup': None}",
        "reported_ns": "{'cup': 5_000_000_000}",
    }
)


def _signal_value(name: str, value: Any) -> float:
    """Return a number as a float, and a text as its `text_number`."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(value, str):
            return text_number(value)
        raise TraceError(f"signal {name!r} is {shortened(value)}; give a number or a text") from error
    # texts of numbers, and truth values, convert to floats, but are probably mistakes
    if isinstance(value, (str, bytes, bool, np.bool_)):
        raise TraceError(f"signal {name!r} is {shortened(value)}; give a number, such as 1.0 for true")
    return number


@named_arguments
@dataclass(frozen=True, slots=True)
class Sample:
    """All objects and signals at one time.

    Attributes:
        time_ns: nanoseconds, 0 to 2**63 - 1.
        objects: detected objects by name; a bare footprint stands for a `TrackedObject`.
        signals: numbers by name, NaN for an unknown value; a text is stored as its `text_number`.
        unknown: classes of objects with unknown position, by name; None for an object without a class. Such
            objects stay members of open groups, so atoms over these groups are unknown.
        reported_ns: times of the reports of objects and signals, by name, at most `time_ns`. The default
            is the sample's time. An object and a signal of the same name share a time.
        lasting: objects that keep their position until their next report, such as a latched map.

    Raises:
        TraceError: an invalid time, name or value.
    """

    time_ns: int
    objects: Mapping[str, TrackedObject] = field(default_factory=dict)
    signals: Mapping[str, float] = field(default_factory=dict)
    unknown: Mapping[str, str | None] = field(default_factory=dict)
    reported_ns: Mapping[str, int] = field(default_factory=dict)
    lasting: frozenset[str] = frozenset()

    if TYPE_CHECKING:
        # the constructor accepts bare footprints and texts, which the fields never hold
        def __init__(
            self,
            time_ns: int,
            objects: Mapping[str, TrackedObject | Footprint] = ...,
            signals: Mapping[str, float | str] = ...,
            unknown: Mapping[str, str | None] = ...,
            reported_ns: Mapping[str, int] = ...,
            lasting: Collection[str] = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        if isinstance(self.time_ns, bool) or not isinstance(self.time_ns, (int, np.integer)):
            raise TraceError(f"time_ns is {self.time_ns!r}; give integer nanoseconds")
        for attribute in _EXAMPLES:
            named_values = getattr(self, attribute)
            if not isinstance(named_values, Mapping):
                raise TraceError(
                    f"{attribute} is {shortened(named_values)}; give a dict by name,"
                    f" as in {_EXAMPLES[attribute]}"
                )
        if not 0 <= self.time_ns <= LATEST_NS:
            raise TraceError(f"time_ns is {self.time_ns}; give a time from 0 to 2**63 - 1 ns")
        objects: dict[str, TrackedObject] = {}
        tracked_by_name: Mapping[str, object] = self.objects
        for name, tracked in tracked_by_name.items():
            _require_name(name, "an object")
            if isinstance(tracked, Footprint):
                tracked = TrackedObject(tracked)
            elif not isinstance(tracked, TrackedObject):
                raise TraceError(
                    f"object {name!r} is {shortened(tracked)}; give a Footprint or a TrackedObject; numbers"
                    f" and texts are signals: Sample(time_ns, objects, {{{name!r}: ...}})"
                )
            objects[name] = tracked
        signals: dict[str, float] = {}
        for name, value in self.signals.items():
            _require_name(name, "a signal")
            signals[name] = _signal_value(name, value)
        for name, class_name in self.unknown.items():
            _require_name(name, "an object")
            if name in objects:
                raise TraceError(f"object {name!r} is both known and unknown; give it once")
            # a class may be empty, like the class of a `TrackedObject`
            if class_name not in (None, ""):
                _require_name(class_name, "a class")
        for name, reported_ns in self.reported_ns.items():
            if name not in objects and name not in signals and name not in self.unknown:
                raise TraceError(f"reported_ns has {name!r}, which the sample does not have; leave it out")
            self._check_report_time(name, reported_ns)
        object.__setattr__(self, "time_ns", int(self.time_ns))
        object.__setattr__(self, "objects", MappingProxyType(objects))
        object.__setattr__(self, "unknown", MappingProxyType(dict(self.unknown)))
        object.__setattr__(self, "signals", MappingProxyType(signals))
        # the sample's time is the default; storing it would make equal samples differ
        report_times_ns = {
            name: reported_ns
            for name, reported_ns in self.reported_ns.items()
            if reported_ns != self.time_ns and name not in self.unknown
        }
        object.__setattr__(self, "reported_ns", MappingProxyType(report_times_ns))
        object.__setattr__(self, "lasting", frozenset(self.lasting) & objects.keys())

    def _check_report_time(self, name: str, reported_ns: object) -> None:
        if isinstance(reported_ns, bool) or not isinstance(reported_ns, (int, np.integer)):
            raise TraceError(f"reported_ns of {name!r} is {shortened(reported_ns)}; give integer nanoseconds")
        if not 0 <= reported_ns <= self.time_ns:
            problem = f"reported_ns of {name!r} is {reported_ns}"
            raise TraceError(f"{problem}; give a time from 0 to that of the sample, {self.time_ns} ns")


def require_sample(value: object) -> None:
    """Check that a value is a sample.

    Raises:
        UsageError: the value is not a `Sample`.
    """
    if not isinstance(value, Sample):
        raise UsageError(f"{shortened(value)} is not a sample; give a Sample(time_ns, objects)")


MOST_NAMES = 20_000
"""Limit on objects of a trace, and on its signals."""
_BYTES = 1 << 30


class MeasurementCache:
    """Cache of arrays of one frozen trace. Above 1 GiB, the least recently used arrays are evicted.

    Each trace has its own cache, so traces never share results. Keys are compared by equality, never by hash
    alone. Several threads may use the cache at once.
    """

    def __init__(self) -> None:
        self._arrays: dict[Hashable, Floats] = {}
        self._bytes = 0
        self._lock = Lock()

    def get(self, key: Hashable) -> Floats | None:
        """Return the array stored under a key, or None."""
        with self._lock:
            array = self._arrays.pop(key, None)
            # the array is moved to the end, because the order of the dict is the order of use
            if array is not None:
                self._arrays[key] = array
            return array

    def put(self, key: Hashable, array: Floats) -> None:
        """Store an array, which must not be written to afterwards."""
        with self._lock:
            old_array = self._arrays.pop(key, None)
            self._bytes += array.nbytes - (0 if old_array is None else old_array.nbytes)
            self._arrays[key] = array
            # the newest array stays, even if it alone exceeds the limit
            while len(self._arrays) > 1 and self._bytes > _BYTES:
                self._bytes -= self._arrays.pop(next(iter(self._arrays))).nbytes


_DURATION = re.compile(
    r"(?P<number>\d{1,19}(?:\.\d{1,30})?(?:e[+-]?\d{1,2})?)(?P<unit>s|ms)", re.ASCII | re.I
)
_ABSOLUTE = re.compile(r"(?P<number>\d{1,19})(?P<unit>ns)?", re.ASCII | re.I)
_LEAST_WITHOUT_UNIT_NS = 10**12
"""Least integer that is read as nanoseconds without a unit. Smaller integers could be s or ms."""
_CALENDAR = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)[T ](?P<time>\d\d:\d\d:\d\d)(?:\.(?P<fraction>\d{1,9}))?"
    r"(?P<offset>Z|[+-]\d\d:\d\d)",
    re.ASCII | re.IGNORECASE,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class TimePoint:
    """A time in a log, as users write it.

    Attributes:
        nanoseconds: time after the origin, ns. It is at most 0 if the origin is the last sample.
        origin: first sample, last sample, or zero of the log's clock.
    """

    nanoseconds: int
    origin: Literal["first sample", "last sample", "zero"]

    def absolute_ns(self, first_ns: int = 0, last_ns: int = 0) -> int:
        """Return this time on the clock of a log, ns.

        Args:
            first_ns, last_ns: times of the log's first and last sample.
        """
        origins_ns = {"first sample": first_ns, "last sample": last_ns, "zero": 0}
        return max(0, origins_ns[self.origin] + self.nanoseconds)


def time_point_from_text(text: str) -> TimePoint:
    """Read `12.5s` after the first sample, `-1s` before the last, `5250000000ns` on the clock, or RFC 3339.

    An integer of at least 10^12 without a unit is read as nanoseconds.

    Raises:
        UsageError: any other text, a small integer without a unit, or a time beyond the range of logs.
    """
    if _DURATION.fullmatch(text):
        return TimePoint(duration_ns_from_text(text), "first sample")
    if text.startswith("-") and _DURATION.fullmatch(text[1:]):
        return TimePoint(-duration_ns_from_text(text[1:]), "last sample")
    if absolute := _ABSOLUTE.fullmatch(text):
        if absolute["unit"] is None and int(text) < _LEAST_WITHOUT_UNIT_NS:
            raise UsageError(
                f"{text!r} has no unit: {text}s after the log's first sample, or {text} ns on the log's own "
                f"clock? Write {text}s or {text}ns"
            )
        return TimePoint(_checked_ns(int(absolute["number"]), text), "zero")
    if calendar := _CALENDAR.fullmatch(text):
        return TimePoint(_checked_ns(_ns_from_calendar(calendar, text), text), "zero")
    raise UsageError(
        f"{text!r} is not a time; write 12.5s or 1500ms after the log's first sample, "
        "-200ms before its last, 5250000000ns on its own clock, or 2026-01-31T12:00:00Z"
    )


def duration_ns_from_text(text: str) -> int:
    """Read a duration such as `2s`, `0.5s` or `1500ms` as nanoseconds, rounded to the nearest.

    Raises:
        UsageError: any other text, or a duration beyond the range of logs.
    """
    match = _DURATION.fullmatch(text)
    if match is None:
        raise UsageError(f"{text!r} is not a duration; write it as 2s, 0.5s or 1500ms")
    nanoseconds = Decimal(match["number"]) * (10**9 if match["unit"].lower() == "s" else 10**6)
    # the number is limited before the conversion, because its exponent can give a hundred digits
    return _checked_ns(int(min(nanoseconds, Decimal(LATEST_NS + 1)).to_integral_value()), text)


def _ns_from_calendar(match: re.Match[str], text: str) -> int:
    offset = "+00:00" if match["offset"] in "Zz" else match["offset"]
    try:
        whole_seconds = datetime.fromisoformat(f"{match['date']}T{match['time']}{offset}")
    except ValueError as error:
        raise UsageError(f"{text!r} is not a calendar time: {error}") from error
    fraction_ns = int((match["fraction"] or "").ljust(9, "0"))
    # the arithmetic uses integers, because a timestamp as float would lose nanoseconds
    return (whole_seconds - _EPOCH) // timedelta(seconds=1) * 10**9 + fraction_ns


def _checked_ns(nanoseconds: int, text: str) -> int:
    if not 0 <= nanoseconds <= LATEST_NS:
        raise UsageError(f"{text!r} is outside the times of a log, 0 to 2**63 - 1 ns")
    return nanoseconds


ABSENT = -1
"""Row number of an object that is not in the sample."""


@dataclass(frozen=True, eq=False)
class Trace(Displayed):
    """T samples with strictly increasing times.

    Objects are stored as observations: rows of flat arrays, one row for each report of an object.
    `rows[t, n]` is the observation of object n in sample t, or `ABSENT`. An observation with a number
    that is not finite is unreadable, and its object is unknown. An unreadable observation in row r has the
    entry -2 - r in `rows`.

    Two traces are equal if they hold the same samples. Equality ignores `faults`, `remarks`, `doubts`,
    `units`, `spans`, the order of observations, and names that no sample uses.

    Attributes:
        times_ns: (T,) int64.
        names: names of the N objects, in order of code points.
        rows: (T, N) int64.
        footprints: footprints of the R observations.
        yaw: (R,) float64, radians; NaN for observations without orientation.
        uncertainty: (R,) float64, radius in footprint units, at least 0.
        class_code: (R,) int64, index into `classes`.
        classes: class names; None for objects without a class.
        signals: numeric signals by name, each (T,) float64, NaN where unknown.
        reported_ns: (T, N) int64, time of the report that each sample shows; None if every report has the
            time of its sample.
        signals_reported_ns: times of reports by signal, each (T,) int64. A signal is left out if all its
            reports have the times of their samples.
        lasting: objects that keep their position until their next report.
        faults: messages about samples lost or left out while reading, each with its place in the log.
        remarks: messages about the log that are no faults.
        doubts: assumptions of the reader that the log contradicts.
        units: declared units of signals by name; the unit of lengths under "".
        spans: samples in which each mapped topic could be judged, for logs with trimmed ends.
        cache: cached measurements of this trace.

    Raises:
        TraceError: columns with lengths that do not match, times that do not increase, or too many names.
    """

    times_ns: Integers
    names: tuple[str, ...]
    rows: Integers
    footprints: FootprintBatch
    yaw: Floats
    uncertainty: Floats
    class_code: Integers
    classes: tuple[str | None, ...]
    signals: Mapping[str, Floats] = field(default_factory=dict)
    reported_ns: Integers | None = None
    signals_reported_ns: Mapping[str, Integers] = field(default_factory=dict)
    lasting: frozenset[str] = frozenset()
    faults: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    spans: tuple[TopicSpan, ...] = field(default=(), repr=False)
    cache: MeasurementCache = field(default_factory=MeasurementCache, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("times_ns", "rows", "class_code"):
            object.__setattr__(self, name, read_only_integers(getattr(self, name)))
        for name in ("yaw", "uncertainty"):
            object.__setattr__(self, name, read_only_floats(getattr(self, name)))
        signals = {name: read_only_floats(self.signals[name]) for name in sorted(self.signals)}
        object.__setattr__(self, "signals", MappingProxyType(signals))
        if self.reported_ns is not None:
            object.__setattr__(self, "reported_ns", read_only_integers(self.reported_ns))
        signal_times = {name: read_only_integers(times) for name, times in self.signals_reported_ns.items()}
        object.__setattr__(self, "signals_reported_ns", MappingProxyType(signal_times))
        object.__setattr__(self, "units", MappingProxyType(dict(self.units)))
        _check_shapes(self)
        _check_times(self.times_ns)

    def __len__(self) -> int:
        return len(self.times_ns)

    def __iter__(self) -> Iterator[Sample]:
        return self.samples()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Trace):
            return NotImplemented
        return _same_samples(self.compact(), other.compact())

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        span = f", {self.times_ns[0]} to {self.times_ns[-1]} ns" if len(self) else ""
        return f"<Trace: {len(self)} samples{span}; objects {', '.join(self.names) or 'none'}>"

    @property
    def nbytes(self) -> int:
        """Size of the arrays in bytes, without the cache."""
        columns = [self.times_ns, self.rows, self.yaw, self.uncertainty, self.class_code]
        columns += [*self.signals.values(), *self.signals_reported_ns.values()]
        columns += [] if self.reported_ns is None else [self.reported_ns]
        return self.footprints.nbytes + sum(column.nbytes for column in columns)

    @property
    def unreadable_count(self) -> int:
        """Number of observations with a number that is not finite."""
        return int(np.count_nonzero(self.rows < ABSENT))

    @property
    def is_unknown(self) -> NDArray[np.bool_]:
        """(T,), whether a sample has no known object and no known signal."""
        is_unknown: NDArray[np.bool_] = np.asarray((self.rows < 0).all(axis=1))
        for values in self.signals.values():
            is_unknown &= np.isnan(values)
        return is_unknown

    @property
    def filling(self) -> NDArray[np.bool_]:
        """(T,), whether a sample fills a pause.

        Consecutive unknown samples fill a pause if they begin 1 ns after a sample, or end 1 ns before a
        sample.
        """
        is_unknown = self.is_unknown
        span_ends = np.flatnonzero(np.diff(is_unknown, prepend=False, append=False))
        is_adjacent = np.concatenate([[False], np.diff(self.times_ns) == 1, [False]])
        is_filling = np.zeros(len(self), np.bool_)
        for start, end in span_ends.reshape(-1, 2)[
            is_adjacent[span_ends].reshape(-1, 2).any(axis=1)
        ].tolist():
            is_filling[start:end] = True
        return is_filling

    def without_filling(self) -> Trace:
        """Return the trace without the samples that fill pauses."""
        is_filling = self.filling
        return self.take(np.flatnonzero(~is_filling)) if is_filling.any() else self

    @classmethod
    def empty(cls) -> Trace:
        """Return a trace without samples."""
        no_integers, no_floats = np.empty(0, np.int64), np.empty(0)
        return cls(
            no_integers,
            (),
            no_integers.reshape(0, 0),
            FootprintBatch.unknown(0),
            no_floats,
            no_floats,
            no_integers,
            (),
        )

    @classmethod
    def from_samples(cls, samples: Iterable[Sample], *, units: Mapping[str, str] | None = None) -> Trace:
        """Build the trace of the given samples, in their order.

        Args:
            units: declared units of signals by name; the unit of lengths under "".

        Raises:
            TraceError: times that do not increase, or too many names.
            UsageError: units that are not texts.
        """
        sample_list = list(samples)
        for sample in sample_list:
            require_sample(sample)
        names = tuple(sorted({name for sample in sample_list for name in (*sample.objects, *sample.unknown)}))
        signal_names = sorted({name for sample in sample_list for name in sample.signals})
        require_few(names, signal_names)
        column_of_name = {name: index for index, name in enumerate(names)}
        rows = np.full((len(sample_list), len(names)), ABSENT, np.int64)
        tracked_objects: list[TrackedObject] = []
        # rows of objects with unknown position come last, and store only the class
        unknown_objects: list[tuple[int, str, str | None]] = []
        for index, sample in enumerate(sample_list):
            for name in sorted(sample.objects):
                rows[index, column_of_name[name]] = len(tracked_objects)
                tracked_objects.append(sample.objects[name])
            unknown_objects += ((index, name, sample.unknown[name]) for name in sorted(sample.unknown))
        for row, (index, name, _) in enumerate(unknown_objects, len(tracked_objects)):
            rows[index, column_of_name[name]] = -2 - row
        class_names = [
            *(tracked.class_name for tracked in tracked_objects),
            *(class_name for *_, class_name in unknown_objects),
        ]
        classes = class_order(class_names)
        signal_values = {
            name: [sample.signals.get(name, np.nan) for sample in sample_list] for name in signal_names
        }
        known_shapes = FootprintBatch.from_footprints(
            [tracked.footprint for tracked in tracked_objects],
            [tracked.height for tracked in tracked_objects],
        )
        shapes = FootprintBatch.concatenate([known_shapes, FootprintBatch.unknown(len(unknown_objects))])
        yaws = [
            *(np.nan if tracked.yaw is None else tracked.yaw for tracked in tracked_objects),
            *(np.nan for _ in unknown_objects),
        ]
        return cls(
            times_ns=np.array([sample.time_ns for sample in sample_list], np.int64),
            names=names,
            rows=rows,
            footprints=shapes,
            yaw=np.array(yaws, np.float64),
            uncertainty=np.array(
                [*(tracked.uncertainty for tracked in tracked_objects), *(0.0 for _ in unknown_objects)]
            ),
            class_code=np.array([classes.index(name) for name in class_names], np.int64),
            classes=classes,
            signals={name: np.array(values, np.float64) for name, values in signal_values.items()},
            **_reported_of_samples(sample_list, names, signal_names),
            lasting=frozenset().union(*(sample.lasting for sample in sample_list)),
            units=checked_units(units),
        )

    def samples(self) -> Iterator[Sample]:
        """Iterate over the samples as objects.

        Numbers of unreadable observations and unknown signals are left out.
        """
        for index, time_ns in enumerate(self.times_ns.tolist()):
            named_rows = list(zip(self.names, self.rows[index].tolist(), strict=True))
            known_rows = [row for _, row in named_rows if row >= 0]
            footprints = iter(self.footprints.footprints(known_rows))
            objects = {name: self._observation(row, next(footprints)) for name, row in named_rows if row >= 0}
            unknown = {
                name: self.classes[int(self.class_code[-2 - row])] for name, row in named_rows if row < ABSENT
            }
            named_values = ((name, float(column[index])) for name, column in self.signals.items())
            signals = {name: value for name, value in named_values if value == value}
            reported_ns = self._reported_in(index, objects, signals)
            yield Sample(time_ns, objects, signals, unknown, reported_ns, self.lasting)

    def _reported_in(
        self, sample_index: int, objects: Collection[str], signals: Collection[str]
    ) -> dict[str, int]:
        reported_ns = {
            name: int(report_times[sample_index])
            for name, report_times in self.signals_reported_ns.items()
            if name in signals
        }
        if self.reported_ns is not None:
            report_times = zip(self.names, self.reported_ns[sample_index].tolist(), strict=True)
            reported_ns |= {name: time_ns for name, time_ns in report_times if name in objects}
        return reported_ns

    def observation(self, row: int) -> TrackedObject:
        """Return the object of the observation `row`, which is at least 0."""
        return self._observation(row, self.footprints.footprint(row))

    def _observation(self, row: int, footprint: Footprint) -> TrackedObject:
        yaw = float(self.yaw[row])
        return TrackedObject(
            footprint,
            class_name=self.classes[int(self.class_code[row])],
            yaw=None if yaw != yaw else yaw,
            height=self.footprints.height(row),
            uncertainty=float(self.uncertainty[row]),
        )

    def slice(self, start: int, stop: int) -> Trace:
        """Return the samples from `start` to before `stop` as a trace without other observations."""
        begin, end, _ = slice(start, stop).indices(len(self))
        return self.take(np.arange(begin, max(begin, end), dtype=np.int64))

    def take(self, samples: Integers) -> Trace:
        """Return the trace of the samples with the given indices (K,), which must increase."""
        rows = self.rows[samples]
        used_rows, new_rows = renumber_rows(rows)
        return replace(
            self,
            times_ns=self.times_ns[samples],
            rows=new_rows,
            footprints=self.footprints.select(used_rows),
            yaw=self.yaw[used_rows],
            uncertainty=self.uncertainty[used_rows],
            class_code=self.class_code[used_rows],
            signals={name: values[samples] for name, values in self.signals.items()},
            reported_ns=None if self.reported_ns is None else self.reported_ns[samples],
            signals_reported_ns={name: times[samples] for name, times in self.signals_reported_ns.items()},
        )

    def compact(self) -> Trace:
        """Return the normal form of the trace, which is identical for equal traces.

        Observations are numbered by sample, then name; names, classes and signals that no sample uses
        are dropped; classes are sorted, None first.
        """
        is_observed = (self.rows != ABSENT).any(axis=0)
        used_trace = replace(
            self,
            names=tuple(
                name for name, is_used in zip(self.names, is_observed.tolist(), strict=True) if is_used
            ),
            rows=self.rows[:, is_observed],
            signals={name: values for name, values in self.signals.items() if not np.isnan(values).all()},
            **self._report_times(is_observed),
        ).take(np.arange(len(self), dtype=np.int64))
        codes, code_indices = np.unique(used_trace.class_code, return_inverse=True)
        classes = class_order(self.classes[code] for code in codes.tolist())
        new_codes = np.array([classes.index(self.classes[code]) for code in codes.tolist()], np.int64)
        return replace(
            used_trace,
            class_code=new_codes[code_indices] if len(codes) else used_trace.class_code,
            classes=classes,
        )

    def _report_times(self, is_observed: NDArray[np.bool_]) -> dict[str, Any]:
        """Return the fields of the normal form that depend on reports.

        The report time of an unknown value is replaced by the time of its sample.
        """
        sample_ns = self.times_ns[:, None]
        reported_ns = None
        if self.reported_ns is not None:
            reported_ns = np.where(self.rows >= 0, self.reported_ns, sample_ns)[:, is_observed]
        signal_times = {
            name: np.where(np.isnan(self.signals[name]), self.times_ns, times)
            for name, times in self.signals_reported_ns.items()
        }
        return {
            "reported_ns": None if reported_ns is None or (reported_ns == sample_ns).all() else reported_ns,
            "signals_reported_ns": {
                name: times for name, times in signal_times.items() if (times != self.times_ns).any()
            },
            "lasting": self.lasting
            & {name for name, rows in zip(self.names, self.rows.T, strict=True) if (rows >= 0).any()},
        }

    @classmethod
    def concatenate(cls, traces: Sequence[Trace]) -> Trace:
        """Join traces that follow each other in time.

        Raises:
            TraceError: a trace begins before the end of the previous trace.
        """
        names = tuple(sorted({name for trace in traces for name in trace.names}))
        column_of_name = {name: index for index, name in enumerate(names)}
        classes = class_order(name for trace in traces for name in trace.classes)
        code_of_class = {name: index for index, name in enumerate(classes)}
        signals = sorted({name for trace in traces for name in trace.signals})
        rows = np.full((sum(map(len, traces)), len(names)), ABSENT, np.int64)
        reported_ns = None
        if any(trace.reported_ns is not None for trace in traces):
            reported_ns = np.zeros(rows.shape, np.int64)
        sample_start = row_start = 0
        for trace in traces:
            # an unreadable row is stored as -2 - row, so its number is shifted downwards
            row_shift = np.where(trace.rows >= 0, row_start, np.where(trace.rows == ABSENT, 0, -row_start))
            columns = [column_of_name[name] for name in trace.names]
            rows[sample_start : sample_start + len(trace), columns] = trace.rows + row_shift
            if reported_ns is not None:
                trace_reported_ns = (
                    trace.times_ns[:, None] if trace.reported_ns is None else trace.reported_ns
                )
                reported_ns[sample_start : sample_start + len(trace), columns] = trace_reported_ns
            sample_start += len(trace)
            row_start += len(trace.footprints)
        # NaN by trace length; signals that a trace lacks share the array
        unknown_values = {len(trace): np.full(len(trace), np.nan) for trace in traces}
        class_codes = (
            np.array([code_of_class[n] for n in trace.classes], np.int64)[trace.class_code]
            for trace in traces
        )
        return cls(
            # the empty arrays give the type if there are no traces
            times_ns=np.concatenate([np.empty(0, np.int64), *(trace.times_ns for trace in traces)]),
            names=names,
            rows=rows,
            footprints=FootprintBatch.concatenate([trace.footprints for trace in traces]),
            yaw=np.concatenate([np.empty(0), *(trace.yaw for trace in traces)]),
            uncertainty=np.concatenate([np.empty(0), *(trace.uncertainty for trace in traces)]),
            class_code=np.concatenate([np.empty(0, np.int64), *class_codes]),
            classes=classes,
            signals={
                name: np.concatenate(
                    [trace.signals.get(name, unknown_values[len(trace)]) for trace in traces]
                )
                for name in signals
            },
            reported_ns=reported_ns,
            signals_reported_ns={
                name: np.concatenate([t.signals_reported_ns.get(name, t.times_ns) for t in traces])
                for name in sorted({name for trace in traces for name in trace.signals_reported_ns})
            },
            lasting=frozenset().union(*(trace.lasting for trace in traces)),
            faults=tuple(fault for trace in traces for fault in trace.faults),
            remarks=tuple(remark for trace in traces for remark in trace.remarks),
            doubts=tuple(dict.fromkeys(doubt for trace in traces for doubt in trace.doubts)),
            units={name: unit for trace in traces for name, unit in trace.units.items()},
            spans=join_spans(trace.spans for trace in traces),
        )


def _reported_of_samples(
    samples: Sequence[Sample], names: Sequence[str], signals: Sequence[str]
) -> dict[str, Any]:
    """Return the fields `reported_ns` and `signals_reported_ns`; {} if every report has its sample's time."""
    if not any(sample.reported_ns for sample in samples):
        return {}
    times_ns = np.array([sample.time_ns for sample in samples], np.int64)
    times_of_name = {name: times_ns.copy() for sample in samples for name in sample.reported_ns}
    for index, sample in enumerate(samples):
        for name, reported_ns in sample.reported_ns.items():
            times_of_name[name][index] = reported_ns
    object_times = np.stack([times_of_name.get(name, times_ns) for name in names] or [times_ns], axis=1)
    return {
        "reported_ns": object_times[:, : len(names)] if times_of_name.keys() & set(names) else None,
        "signals_reported_ns": {name: times_of_name[name] for name in signals if name in times_of_name},
    }


_LONGEST_UNIT = 64
"""Limit on the length of a unit, characters."""


def checked_units(units: Mapping[str, str] | None) -> dict[str, str]:
    """Return declared units sorted by name; {} for None.

    Raises:
        UsageError: the units are not short texts by name.
    """
    if units is None:
        return {}
    if not isinstance(units, Mapping) or not all(isinstance(name, str) for name in units):
        remedy = 'give them by the names of signals, and that of lengths by "": {"": "m"}'
        raise UsageError(f"units are {shortened(units)}; {remedy}")
    for name, unit in units.items():
        is_text = isinstance(unit, str) and is_encodable(unit)
        if not is_text or not (0 < len(unit) <= _LONGEST_UNIT or names_from_unit(unit)):
            subject = f"of signal {name!r}" if name else "of lengths"
            raise UsageError(f"the unit {subject} is {shortened(unit)}; give a short text, such as 'm'")
    return dict(sorted(units.items()))


def window_of(times_ns: Integers, start_ns: int, end_ns: int) -> tuple[int, int]:
    """Return the index range of the times from `start_ns` to before `end_ns`.

    Args:
        times_ns: (T,) int64, in order.
        start_ns, end_ns: integers of any size.
    """
    # `np.searchsorted` would compare an end beyond int64 as a rounded double
    return bisect_left(times_ns, start_ns), bisect_left(times_ns, end_ns)


def within(trace: Trace, start_ns: int | None, end_ns: int | None) -> Trace:
    """Return the samples of a trace from `start_ns` to before `end_ns`."""
    begin, end = window_of(trace.times_ns, start_ns or 0, FOREVER if end_ns is None else end_ns)
    return trace if (begin, end) == (0, len(trace)) else trace.slice(begin, end)


def require_few(objects: Collection[str], signals: Collection[str]) -> None:
    """Limit the number of names, because each sample stores a number for each name.

    Raises:
        TraceError: more objects or signals than `MOST_NAMES`.
    """
    for names, kind in ((objects, "objects"), (signals, "signals")):
        if len(names) > MOST_NAMES:
            raise TraceError(f"there are {len(names):,} {kind}; {MOST_NAMES:,} is the limit: leave some out")


def _check_shapes(trace: Trace) -> None:
    require_few(trace.names, trace.signals)
    sample_count, observation_count = len(trace.times_ns), len(trace.footprints)
    if trace.times_ns.ndim != 1 or trace.rows.shape != (sample_count, len(trace.names)):
        raise TraceError(
            f"rows have the shape {trace.rows.shape}; {sample_count} times and {len(trace.names)} names"
            f" need ({sample_count}, {len(trace.names)})"
        )
    if list(trace.names) != sorted(set(trace.names)):
        raise TraceError(f"names are {trace.names}; give each once, in order of code points")
    for column in ("yaw", "uncertainty", "class_code"):
        if (shape := getattr(trace, column).shape) != (observation_count,):
            needed = f"{observation_count} footprints need ({observation_count},)"
            raise TraceError(f"{column} has the shape {shape}; {needed}")
    # -2 - (observation_count - 1) is the least row of an unreadable observation
    if trace.rows.size and (
        trace.rows.max() >= observation_count or trace.rows.min() < -1 - observation_count
    ):
        raise TraceError(f"a row number lies outside the {observation_count} observations")
    for name, values in trace.signals.items():
        if values.shape != (sample_count,):
            raise TraceError(
                f"signal {name!r} has the shape {values.shape}; the times need ({sample_count},)"
            )
    if trace.reported_ns is not None and trace.reported_ns.shape != trace.rows.shape:
        raise TraceError(f"reported_ns has the shape {trace.reported_ns.shape}; rows have {trace.rows.shape}")
    for name, times in trace.signals_reported_ns.items():
        if name not in trace.signals or times.shape != (sample_count,):
            raise TraceError(
                f"signals_reported_ns of {name!r} needs a signal and the shape ({sample_count},)"
            )


def _check_times(times_ns: Integers) -> None:
    if len(times_ns) and times_ns[0] < 0:
        raise TraceError(f"the first sample is at {times_ns[0]} ns; give times from 0 on")
    late_indices = np.flatnonzero(times_ns[1:] <= times_ns[:-1])
    if len(late_indices):
        index = int(late_indices[0])
        time_text, previous_text = times_apart(int(times_ns[index + 1]), int(times_ns[index]))
        raise TraceError(
            f"sample {index + 1} is at {time_text} and the one before it at {previous_text};"
            " give times that increase"
        )


def _same_samples(a: Trace, b: Trace) -> bool:
    if (a.names, a.classes, tuple(a.signals)) != (b.names, b.classes, tuple(b.signals)):
        return False
    columns = ("times_ns", "rows", "class_code", "yaw", "uncertainty")
    shapes = ("part_start", "vertex_start", "vertices", "radius", "bottom", "top")
    array_pairs = [(getattr(a, name), getattr(b, name)) for name in columns]
    array_pairs += [(getattr(a.footprints, name), getattr(b.footprints, name)) for name in shapes]
    array_pairs += [(a.signals[name], b.signals[name]) for name in a.signals]
    reported_a, reported_b = a.signals_reported_ns, b.signals_reported_ns
    if (a.reported_ns is None, reported_a.keys(), a.lasting) != (
        b.reported_ns is None,
        reported_b.keys(),
        b.lasting,
    ):
        return False
    array_pairs += [(reported_a[name], reported_b[name]) for name in reported_a]
    if a.reported_ns is not None and b.reported_ns is not None:
        array_pairs.append((a.reported_ns, b.reported_ns))
    # `equal_nan` is for floats: integers are never NaN
    return all(
        np.array_equal(array_a, array_b, equal_nan=array_a.dtype.kind == "f")
        for array_a, array_b in array_pairs
    )


def renumber_rows(rows: Integers) -> tuple[Integers, Integers]:
    """Return the used observations in the order of samples and names, and the renumbered rows (T, N)."""
    is_present = rows != ABSENT
    present_rows = rows[is_present]
    is_unreadable = present_rows < ABSENT
    used_rows = np.where(is_unreadable, -2 - present_rows, present_rows)
    new_numbers = np.arange(len(used_rows), dtype=np.int64)
    new_rows = np.full(rows.shape, ABSENT, np.int64)
    new_rows[is_present] = np.where(is_unreadable, -2 - new_numbers, new_numbers)
    return used_rows, new_rows


def class_order(classes: Iterable[str | None]) -> tuple[str | None, ...]:
    """Return distinct class names in the order of `Trace.classes`: None first, then by name."""
    return tuple(sorted(set(classes), key=lambda name: (name is not None, name or "")))


LONG_PAUSE: Final = 5
"""Longest interval that is no pause, in usual intervals."""
_FEWEST: Final = 10
"""Minimum number of intervals to determine the usual interval."""
_RARE: Final = 20
"""Minimum number of intervals per pause; with more pauses, the times are irregular."""
_MOST_LISTED: Final = 3
_MOST_HELD: Final = 65_536
"""Number of intervals after which only long intervals are stored."""


class Pauses:
    """The pauses in a sequence of times, which are added in order.

    All intervals are stored at first; after `_MOST_HELD` intervals, only long intervals.
    """

    def __init__(self) -> None:
        self._last_time_ns, self._is_last_lost = np.empty(0, np.int64), np.empty(0, np.bool_)
        self._interval_blocks: list[Integers] = []
        self._first_usual_ns: int | None = None
        self._interval_count = 0

    def add(self, times_ns: Integers, is_lost: NDArray[np.bool_] | None = None) -> None:
        """Add times that follow the previous times.

        Args:
            is_lost: (T,), whether everything is unknown after each time. An interval after such a time is
                no pause.
        """
        all_times_ns = np.concatenate([self._last_time_ns, times_ns])
        is_time_lost = np.concatenate(
            [self._is_last_lost, np.zeros(len(times_ns), np.bool_) if is_lost is None else is_lost]
        )
        self._last_time_ns, self._is_last_lost = all_times_ns[-1:].copy(), is_time_lost[-1:].copy()
        self._interval_count += max(0, len(all_times_ns) - 1)
        self._store(np.array([all_times_ns[:-1], np.diff(all_times_ns)])[:, ~is_time_lost[:-1]])
        if self._first_usual_ns is None and self._interval_count >= _MOST_HELD:
            intervals = self._stored_intervals
            self._first_usual_ns = int(np.median(intervals[1, :_MOST_HELD]))
            # the stored intervals are filtered, now that the usual interval is known
            self._interval_blocks = []
            self._store(intervals)

    def _store(self, intervals: Integers) -> None:
        if self._first_usual_ns is not None:
            intervals = intervals[:, intervals[1] > LONG_PAUSE * self._first_usual_ns]
        if intervals.size:
            self._interval_blocks.append(intervals)

    @property
    def _stored_intervals(self) -> Integers:
        """(2, N): starts and lengths of the stored intervals, ns."""
        return np.concatenate([np.empty((2, 0), np.int64), *self._interval_blocks], axis=1)

    def longest_first(self) -> list[tuple[int, int]]:
        """Return the start and the length of each pause, ns, the longest pause first."""
        intervals = self._stored_intervals
        if not self.is_regular:
            return []
        starts, lengths = intervals[:, intervals[1] > LONG_PAUSE * self.usual_ns].tolist()
        return sorted(zip(starts, lengths, strict=True), key=lambda pause: -pause[1])

    @property
    def last_ns(self) -> int | None:
        """The latest time; None without times."""
        return int(self._last_time_ns[-1]) if len(self._last_time_ns) else None

    @property
    def is_regular(self) -> bool:
        """Whether there are enough intervals to determine the usual interval, and few are pauses."""
        long_count = int(np.count_nonzero(self._stored_intervals[1] > LONG_PAUSE * self.usual_ns))
        # a single long interval is a pause, however short the log
        return self._interval_count >= _FEWEST and long_count <= max(1, self._interval_count // _RARE)

    @property
    def usual_ns(self) -> int:
        """Median of the intervals, ns; 0 without intervals. A long log uses its first intervals only."""
        if self._first_usual_ns is not None:
            return self._first_usual_ns
        return int(np.median(self._stored_intervals[1])) if self._interval_blocks else 0

    def remark(self, what: str, max_gap_ns: int | None) -> Sentence | None:
        """Return a sentence about the pauses of `what`; None without pauses."""
        pauses = self.longest_first()
        if not pauses:
            return None
        pause_texts: list[str | Instant] = []
        for start_ns, length_ns in pauses[:_MOST_LISTED]:
            comma = ", " if pause_texts else ""
            pause_texts += [f"{comma}for {length_ns / 1e9:.3f} s from ", Instant(start_ns, 0), " on"]
        unlisted_count = len(pauses) - _MOST_LISTED
        unlisted_text = f", and {plural(unlisted_count, 'more time')}" if unlisted_count > 0 else ""
        usual_text = f", where one usually comes every {self.usual_ns / 1e9:.3g} s"
        unknown_text = "`max_gap` makes what lies there unknown"
        if max_gap_ns is not None and pauses[0][1] > max_gap_ns:
            unknown_text = f"what lies in a pause of more than {max_gap_ns / 1e9:g} s is unknown (`max_gap`)"
        return Sentence(f"{what} pause ", *pause_texts, f"{unlisted_text}{usual_text}; {unknown_text}")


class ReportsBack:
    """Counts reports that are earlier than the previous report of their object or signal."""

    def __init__(self) -> None:
        self._last_trace = Trace.empty()
        self._counts: dict[str, tuple[int, int]] = {}

    def add(self, trace: Trace) -> None:
        """Add samples that follow the previous samples."""
        previous_trace, self._last_trace = self._last_trace, trace if len(trace) else self._last_trace
        if any(
            block.reported_ns is not None or block.signals_reported_ns for block in (previous_trace, trace)
        ):
            # the previous block's last sample is joined, so that steps between blocks count
            joined_trace = Trace.concatenate(
                [previous_trace.slice(len(previous_trace) - 1, len(previous_trace)), trace]
            )
            if joined_trace.reported_ns is not None:
                for name, rows, report_times in zip(
                    joined_trace.names, joined_trace.rows.T, joined_trace.reported_ns.T, strict=True
                ):
                    self._count(name, rows >= 0, report_times, joined_trace.times_ns)
            for name, report_times in joined_trace.signals_reported_ns.items():
                self._count(
                    name, np.isfinite(joined_trace.signals[name]), report_times, joined_trace.times_ns
                )

    def _count(
        self, name: str, is_known: NDArray[np.bool_], reported_ns: Integers, times_ns: Integers
    ) -> None:
        backward_samples = (
            np.flatnonzero(is_known[1:] & is_known[:-1] & (reported_ns[1:] < reported_ns[:-1])) + 1
        )
        if len(backward_samples):
            report_count, first_ns = self._counts.get(name, (0, int(times_ns[backward_samples[0]])))
            self._counts[name] = report_count + len(backward_samples), first_ns

    def remarks(self) -> Iterator[Sentence]:
        """Yield a sentence on each object or signal whose reports step back."""
        for name, (report_count, first_ns) in sorted(self._counts.items()):
            reports = f"report of {name} is" if report_count == 1 else f"reports of {name} are"
            first_time = Instant(first_ns, 0)
            consequence = ": there is no rate of change there"
            yield Sentence(
                f"{report_count} {reports} earlier than the one before, the first at ",
                first_time,
                consequence,
            )
