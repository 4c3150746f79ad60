"""Track objects and signals through a log: pending messages of all topics in, traces at given times out.

`rows_from_detections` converts detections to checked observations in the fixed frame. `events_from_messages`
arranges the observations in a timeline, together with the departures of objects. `Events.state` reads the
timeline at the times of samples.

The tracker holds the last state of every object and signal. So a log can be processed in parts.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers, concatenate_tables, select
from spatial_replay.geometry.footprint import Concave, FootprintBatch
from spatial_replay.mapping.binding import Codes
from spatial_replay.mapping.detections import EVERY_OBJECT, Detections, Solids, footprints_from_solids
from spatial_replay.mapping.evidence import TopicEvidence
from spatial_replay.mapping.mapping_file import FOREVER_NS, LogMapping
from spatial_replay.mapping.message_types import name_pattern, possible_classes
from spatial_replay.mapping.reading_plan import PlannedTopic, ReadingPlan
from spatial_replay.mapping.topic_reader import ReportFault, TopicReader, unit_of_stamp
from spatial_replay.mapping.transforms import FrameTree, Transforms
from spatial_replay.text import Instant, Sentence, plural
from spatial_replay.trace.observations import Observations, check_observations
from spatial_replay.trace.spans import TopicSpan
from spatial_replay.trace.trace import ABSENT, LONG_PAUSE, Pauses, Trace, class_order, renumber_rows
from spatial_replay.trace.units import Axes

LEFT = -1
"""Row number of an object that has left."""

STALE = -2
"""Row number of an existing object whose last observation is too old."""


@dataclass(frozen=True, slots=True)
class Events:
    """E events of the objects of one topic, ordered by name, then by time.

    Attributes:
        name, time_ns, class_code: (E,) int64.
        row: (E,) int64, row number of the observation, or `LEFT`.
        expires_ns: (E,) int64, time at which the object leaves if no other event follows.
    """

    name: Integers
    time_ns: Integers
    row: Integers
    expires_ns: Integers
    class_code: Integers

    @classmethod
    def none(cls) -> Events:
        return cls(*(np.empty(0, np.int64) for _ in range(5)))

    def last(self) -> Events:
        """Return the last event of each object that has not left."""
        is_last = np.append(self.name[1:] != self.name[:-1], True)[: len(self.name)]
        return select(self, np.flatnonzero(is_last & (self.row != LEFT)))

    def after(self, before: Events) -> Events:
        """Join earlier events of the same topic, `before`, with these events."""
        joined = concatenate_tables([before, self])
        # events are sorted, because events of a running system may be late
        return select(joined, np.lexsort((joined.time_ns, joined.name)))

    def state(self, times_ns: Integers, max_age_ns: int) -> States:
        """Return the state of all N objects at T times."""
        object_starts = np.flatnonzero(np.append(True, self.name[1:] != self.name[:-1])[: len(self.name)])
        if len(times_ns) == 1 and len(object_starts):
            # the search is vectorised over objects, because a running system has one time and many objects
            event_indices = (
                object_starts + np.add.reduceat(self.time_ns <= times_ns, object_starts, dtype=np.int64) - 1
            )
            columns = self._standing(event_indices, object_starts, times_ns, max_age_ns)
            return States(self.name[object_starts], *(column[None] for column in columns))
        object_ends = np.append(object_starts[1:], len(self.name))[: len(object_starts)]
        state_columns = np.zeros((3, len(times_ns), len(object_starts)), np.int64)
        for object_index, (start, end) in enumerate(
            zip(object_starts.tolist(), object_ends.tolist(), strict=True)
        ):
            event_indices = np.searchsorted(self.time_ns[start:end], times_ns, "right") - 1 + start
            state_columns[:, :, object_index] = self._standing(event_indices, start, times_ns, max_age_ns)
        return States(self.name[object_starts], *state_columns)

    def _standing(
        self, event_indices: Integers, starts: Integers | int, times_ns: Integers, max_age_ns: int
    ) -> tuple[Integers, Integers, Integers]:
        """Return an object's row numbers, class codes and report times at some times.

        Args:
            event_indices: index of the last event up to each time; below `starts` before the object's first
                event.
            starts: index of the first event of the object.
        """
        has_appeared = event_indices >= starts
        event_indices = np.maximum(event_indices, starts)
        event_rows = self.row[event_indices]
        is_old = times_ns - self.time_ns[event_indices] > max_age_ns
        is_absent = ~has_appeared | (event_rows == LEFT) | (times_ns >= self.expires_ns[event_indices])
        row_numbers = np.where(is_absent, ABSENT, np.where(is_old, STALE, event_rows))
        return row_numbers, self.class_code[event_indices], self.time_ns[event_indices]


class States(NamedTuple):
    """The states of N objects at T times.

    Attributes:
        names: (N,), distinct codes.
        rows: (T, N), row numbers, `ABSENT` or `STALE`.
        classes: (T, N), codes.
        reported_ns: (T, N), time of the last report.
    """

    names: Integers
    rows: Integers
    classes: Integers
    reported_ns: Integers


def events_from_messages(
    detections: Detections,
    times_ns: Integers,
    rows: Integers,
    *,
    alive: Events,
    is_complete: bool,
) -> Events:
    """Return the events of messages in order: detections, deletions, and objects missing from complete lists.

    Args:
        times_ns: (M,) time of each message.
        rows: (R,) row of each detection.
        alive: last earlier event of each object that has not left.
        is_complete: whether an object missing from a message has left.
    """
    name, message, lifetime_ns = detections.name, detections.message, detections.lifetime_ns
    expires_ns = np.full(len(name), FOREVER_NS, np.int64)
    if lifetime_ns is not None:
        limited_indices = np.flatnonzero(lifetime_ns > 0)
        expires_ns[limited_indices] = times_ns[message[limited_indices]] + lifetime_ns[limited_indices]
    left_name, left_message = np.empty(0, np.int64), np.empty(0, np.int64)
    if is_complete:
        left_name, left_message = _left_out(name, message, alive.name, len(times_ns))
    if deletions := _named_deletions(detections, alive):
        deletion_pairs = np.array(deletions, np.int64)
        left_message = np.concatenate([left_message, deletion_pairs[:, 0]])
        left_name = np.concatenate([left_name, deletion_pairs[:, 1]])
    every_name = np.concatenate([left_name, name])
    every_message = np.concatenate([left_message, message])
    # departures come first in the stable sort, so that an object deleted and reported by one message exists
    event_order = np.lexsort((every_message, every_name))
    left_count = len(left_name)

    def column(left_value: int, detected_values: Integers) -> Integers:
        return np.concatenate([np.full(left_count, left_value, np.int64), detected_values])[event_order]

    return Events(
        name=every_name[event_order],
        time_ns=times_ns[every_message[event_order]],
        row=column(LEFT, rows),
        expires_ns=column(FOREVER_NS, expires_ns),
        class_code=column(0, detections.class_code),
    )


def _named_deletions(detections: Detections, alive: Events) -> list[tuple[int, int]]:
    """Return (message, name) of each deletion, with `EVERY_OBJECT` replaced by all names."""
    if all(name != EVERY_OBJECT for _, name in detections.deleted):
        return detections.deleted
    every_name = np.unique(np.concatenate([alive.name, detections.name])).tolist()
    return [
        (message, deleted)
        for message, name in detections.deleted
        for deleted in (every_name if name == EVERY_OBJECT else [name])
    ]


def _left_out(
    name: Integers, message: Integers, alive_names: Integers, batch_size: int
) -> tuple[Integers, Integers]:
    """Return names that are in a message but not in the next message, and the next message's index."""
    every_name = np.concatenate([alive_names, name])
    # objects alive before the batch count as detected in message -1, just before message 0
    every_message = np.concatenate([np.full(len(alive_names), -1, np.int64), message])
    name_order = np.lexsort((every_message, every_name))
    name, message = every_name[name_order], every_message[name_order]
    next_message = np.append(np.where(name[1:] == name[:-1], message[1:], batch_size), batch_size)[
        : len(name)
    ]
    left_indices = np.flatnonzero((next_message > message + 1) & (message + 1 < batch_size))
    return name[left_indices], message[left_indices] + 1


@dataclass(frozen=True, slots=True)
class ObservationRows:
    """R observations in the columns of a trace.

    Attributes:
        is_valid: (R,) whether a footprint is known and all numbers are finite.
    """

    shapes: FootprintBatch
    yaw: Floats
    uncertainty: Floats
    class_code: Integers
    is_valid: Booleans

    def __len__(self) -> int:
        return len(self.yaw)

    def slice(self, begin: int, end: int) -> ObservationRows:
        """Return the observations from `begin` to before `end`, as views."""
        return ObservationRows(
            self.shapes.slice(begin, end),
            self.yaw[begin:end],
            self.uncertainty[begin:end],
            self.class_code[begin:end],
            self.is_valid[begin:end],
        )

    @classmethod
    def blank(cls, class_code: Integers) -> ObservationRows:
        """Return unknown observations with known classes."""
        count = len(class_code)
        footprints = FootprintBatch.unknown(count)
        return cls(
            footprints,
            np.full(count, np.nan),
            np.zeros(count),
            class_code,
            np.zeros(count, np.bool_),
        )


def rows_from_detections(
    detections: Detections,
    transforms: Transforms | None,
    axes: Axes,
    concave: Concave,
    report: Callable[[int, str], None],
) -> ObservationRows:
    """Transform detections into the fixed frame; rows without a transform, or a valid footprint, are blank.

    Args:
        transforms: fixed_from_frame of each object; None if all objects are in the fixed frame.
        axes: axes of the fixed frame; rows are converted to the axes of samples.
        concave: treatment of polygons that are not convex.
        report: receiver of invalid footprints: index of the object, and the sentence without its subject.
    """
    poses, solids, object_count = detections.poses, detections.solids, len(detections.name)
    is_unknown = np.zeros(object_count, np.bool_)
    covariance = detections.covariance
    if transforms is not None:
        poses, solids = poses.transform(transforms), _transform_solids(solids, transforms)
        is_unknown = ~transforms.known
        if covariance is not None:
            rotation = transforms.rotation
            covariance = rotation @ covariance @ np.swapaxes(rotation, 1, 2)
    shapes = footprints_from_solids(solids, object_count)
    if detections.height is not None:
        heights = poses.position[:, 2, None] + detections.height
        shapes = replace(shapes, bottom=heights[:, 0], top=heights[:, 1])
    uncertainty = detections.uncertainty if covariance is None else _radius(covariance)
    uncertainty = uncertainty * axes.scale
    shapes, yaw = axes.convert_shapes(shapes), axes.convert_yaw(poses.yaw)
    # each detection is checked as a separate sample, so that an invalid detection does not affect others
    object_indices = np.arange(object_count, dtype=np.int64)
    is_readable, footprints, faults = check_observations(
        Observations(
            times_ns=object_indices,
            sample=object_indices,
            name=np.zeros(object_count, np.int64),
            names=("",),
            class_code=detections.class_code,
            classes=(None,) * (int(detections.class_code.max(initial=-1)) + 1),
            yaw=yaw,
            uncertainty=uncertainty,
            shapes=shapes,
            invalid=is_unknown,
            signals={},
        ),
        concave=concave,
    )
    for index, fault in faults.items():
        report(index, fault.removeprefix("object ''"))
    rows = ObservationRows(footprints, yaw, uncertainty, detections.class_code, is_readable)
    if not faults and not is_unknown.any():
        return rows
    is_unknown[list(faults)] = True
    rows_and_blanks = concatenate_tables([rows, ObservationRows.blank(detections.class_code)])
    return replace(
        select(rows_and_blanks, np.where(is_unknown, object_count + object_indices, object_indices)),
        is_valid=is_readable & ~is_unknown,
    )


def _transform_solids(solids: Solids, transforms: Transforms) -> Solids:
    rotation = transforms.rotation[solids.owner]
    position = np.einsum("nij,nj->ni", rotation, solids.position) + transforms.translation[solids.owner]
    return replace(solids, position=position, rotation=rotation @ solids.rotation)


def _radius(covariance: Floats) -> Floats:
    """Return the longer half axis (R,) of the ellipse in the plane of each covariance (R, 3, 3).

    The result is NaN for a negative variance, with which some programs mark an unknown covariance.
    """
    variance_x, covariance_xy, variance_y = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    # the larger eigenvalue of [[variance_x, covariance_xy], [covariance_xy, variance_y]]
    largest_variance = (variance_x + variance_y) / 2 + np.hypot((variance_x - variance_y) / 2, covariance_xy)
    return np.asarray(
        np.where((variance_x < 0) | (variance_y < 0), np.nan, np.sqrt(np.maximum(largest_variance, 0.0)))
    )


_OLD_ADVANCES, _OLD_ROWS = 32, 256
"""Calls of `advance`, and stored observations, after which old observations are dropped.

Dropping after each call would be slow, because a call may process a single message."""

_FAR_NS = 366 * 86_400 * 10**9
"""Least difference between stamp and log time that shows another clock or unit, nanoseconds."""

_MOST_NAMES = 8
"""Limit of names in one remark."""


class _Following(NamedTuple):
    """An object that moves with its frame, as reported by one message.

    Attributes:
        place: index of the object in the detections.
    """

    frame: str
    detections: Detections
    place: int


@dataclass
class Tracker:
    """Tracker of every object and signal over the parts of a log.

    Attributes:
        names, classes: codes that all topics share.
        window_ns: start and end of the half-open window of samples.
        report: receiver of lost observations.
    """

    plan: ReadingPlan
    readers: Mapping[str, TopicReader]
    names: Codes
    classes: Codes
    tree: FrameTree
    remarks: Remarks
    window_ns: tuple[int, int]
    concave: Concave
    report: ReportFault

    def __post_init__(self) -> None:
        self._rows = ObservationRows.blank(np.empty(0, np.int64))
        self._added_rows: list[ObservationRows] = []
        self._events = {name: Events.none() for name in self.readers}
        self._reported_ns: dict[str, Integers] = {}
        self._placed_messages: dict[str, Booleans] = {}
        self._begun_ns: dict[str, int] = {}
        self._unplaced_ns: dict[str, list[Integers]] = defaultdict(list)
        # time of each lost topic's first message after the loss; FOREVER_NS until such a message
        self._lost_until_ns: dict[str, int] = {}
        self._following: dict[int, _Following] = {}
        self._signals: dict[tuple[str, int], tuple[Integers, Floats]] = {}
        self._topic_of_name: dict[int, str] = {}
        self._objects_of: dict[str, frozenset[str]] = {}
        self._advances = 0
        self.evidence = {
            name: TopicEvidence(reader, self.names, self.classes)
            for name, reader in self.readers.items()
            if reader.is_mapped
        }
        self._unheard_spans = {
            name: _unheard_span(reader.planned) for name, reader in self.readers.items() if reader.is_mapped
        }

    def advance(self, upto_ns: int) -> tuple[Integers, Integers]:
        """Process the pending messages up to a time.

        Returns:
            Message times of the sampled topic, and of fallback topics. Without a sampled topic, the first
            array has the times of all topics.
        """
        self._advances += 1
        sampled_ns, fallback_ns = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for name, reader in self.readers.items():
            if not reader.pending:
                continue
            times_ns, log_times_ns, contents = reader.pending.take(upto_ns)
            is_placed = np.ones(len(times_ns), np.bool_)
            if reader.is_mapped:
                columns = reader.read(log_times_ns, contents)
                arrivals = self.evidence[name].arrivals
                if reader.planned.clock == "header":
                    arrivals.add_stamps(times_ns, log_times_ns)
                else:
                    arrivals.add_stamps(columns.stamps[:, 1], log_times_ns[columns.stamps[:, 0]])
                times_ns, log_times_ns = times_ns[columns.good], log_times_ns[columns.good]
                if len(times_ns) and self._lost_until_ns.get(name) == FOREVER_NS:
                    self._lost_until_ns[name] = int(times_ns[0])
                is_placed = np.ones(len(times_ns), np.bool_)
                if columns.detections is not None and len(times_ns):
                    is_placed = self._take_detections(reader, times_ns, log_times_ns, columns.detections)
                elif columns.signals.size:
                    self._count_replacements(name, times_ns, np.flatnonzero(times_ns[1:] == times_ns[:-1]))
                if columns.signals.size:
                    self.evidence[name].add_signals(columns.signals)
                for signal_index, signal_values in enumerate(columns.signals.T if len(times_ns) else ()):
                    earlier_ns, earlier_values = self._signals.get(
                        (name, signal_index), (times_ns[:0], signal_values[:0])
                    )
                    signal_series = (
                        np.concatenate([earlier_ns, times_ns]),
                        np.concatenate([earlier_values, signal_values]),
                    )
                    self._signals[name, signal_index] = signal_series
            if reader.is_mapped and len(times_ns):
                self._note_messages(reader.planned, times_ns, is_placed)
            if self.plan.sampled_topic in (None, name):
                sampled_ns.append(times_ns)
            elif name in self.plan.fallback_topics:
                fallback_ns.append(times_ns)
        self._store_additions()
        return np.concatenate(sampled_ns), np.concatenate(fallback_ns)

    def _note_messages(self, planned: PlannedTopic, times_ns: Integers, is_placed: Booleans) -> None:
        """Note the times of a topic's messages, and whether transforms place the objects of each message."""
        name = planned.name
        self._begun_ns.setdefault(name, int(times_ns[0]))
        latest_ns, was_placed = (
            self._reported_ns.get(name, times_ns[:0])[-1:],
            self._placed_messages.get(name),
        )
        self._reported_ns[name] = np.concatenate([latest_ns, times_ns])
        self._placed_messages[name] = np.concatenate(
            [is_placed[:0] if was_placed is None else was_placed[-1:], is_placed]
        )
        if planned.max_age_ns >= FOREVER_NS:
            stays_valid = planned.layout is not None and planned.layout.stays
            reason = (
                "since the topic is latched" if planned.is_latched else "as markers do" if stays_valid else ""
            )
            self.remarks.lasting[name] = reason or "by its `max_age: forever`"
        if not planned.is_static:
            start_ns, end_ns = self.window_ns
            self.remarks.messages[name].add(times_ns[(times_ns >= start_ns) & (times_ns < end_ns)])

    def trace(self, times_ns: Integers, newest_ns: int) -> Trace:
        """Return the samples at some times, up to the time of the last `advance`.

        Args:
            newest_ns: newest time of the log.
        """
        if not len(times_ns):
            return Trace.empty()
        name_codes, rows, classes, reported_ns = self._states(times_ns, newest_ns)
        self._store_additions()
        names = [self.names.by_code[code] for code in name_codes.tolist()]
        has_appeared = (rows != ABSENT).any(axis=0).tolist()
        name_order = sorted(
            (index for index in range(len(names)) if has_appeared[index]), key=names.__getitem__
        )
        rows, classes, reported_ns = rows[:, name_order], classes[:, name_order], reported_ns[:, name_order]
        stored_rows, is_stale = self._rows, rows == STALE
        # unknown rows have the numbers -2, -3 and so on
        is_valid = np.append(stored_rows.is_valid, False)[np.where(rows >= 0, rows, -1)]
        row_numbers = np.where((rows == ABSENT) | is_valid, rows, -2 - rows)
        if is_stale.any():
            # a stale object keeps only its class, so one blank row per class follows the other rows
            row_numbers = np.where(is_stale, -2 - (len(stored_rows) + classes), row_numbers)
            blank_rows = ObservationRows.blank(np.arange(len(self.classes), dtype=np.int64))
            stored_rows = concatenate_tables([stored_rows, blank_rows])
        # class codes depend on the order of messages, but a trace must not depend on that order
        class_by_code = self.classes.by_code
        sorted_classes = class_order(class_by_code)
        class_places = {name: class_place for class_place, name in enumerate(sorted_classes)}
        class_rank = np.array([class_places[name] for name in class_by_code], np.int64)
        used_rows, row_numbers = renumber_rows(row_numbers)
        stored_rows = select(stored_rows, used_rows)
        signals, signals_reported_ns = self._signal_columns(times_ns, newest_ns)
        return Trace(
            times_ns=times_ns,
            names=tuple(names[index] for index in name_order),
            rows=row_numbers,
            footprints=stored_rows.shapes,
            yaw=stored_rows.yaw,
            uncertainty=stored_rows.uncertainty,
            class_code=class_rank[stored_rows.class_code] if len(class_rank) else stored_rows.class_code,
            classes=sorted_classes,
            signals=signals,
            reported_ns=None if (reported_ns == times_ns[:, None])[rows >= 0].all() else reported_ns,
            signals_reported_ns=signals_reported_ns,
            lasting=frozenset(
                names[index] for index in name_order if self._is_lasting(int(name_codes[index]))
            ),
            spans=self._spans(times_ns) if self.plan.mapping.trims_ends else (),
        )

    def _is_lasting(self, name: int) -> bool:
        """Return whether an object stays valid until its next report."""
        planned = self.readers[self._topic_of_name[name]].planned
        # static transforms count as reports in every sample
        return planned.is_lasting and not planned.is_static

    def _spans(self, times_ns: Integers) -> tuple[TopicSpan, ...]:
        """Return the span of each mapped topic: the samples that its messages cover."""
        spans = []
        for topic, reader in self.readers.items():
            if not reader.is_mapped:
                continue
            judged_ns = times_ns[self._is_judged(reader.planned, times_ns)]
            heard_ns = self._reported_ns.get(topic, times_ns[:0])
            first_ns, last_ns = judged_ns[[0, -1]].tolist() if len(judged_ns) else (None, None)
            spans.append(
                replace(
                    self._unheard_spans[topic],
                    objects=self._objects_of.get(topic, frozenset()),
                    begun_ns=self._begun_ns.get(topic),
                    heard_ns=int(heard_ns[-1]) if len(heard_ns) else None,
                    first_ns=first_ns,
                    last_ns=last_ns,
                )
            )
        self._unplaced_ns.clear()
        return tuple(spans)

    def _is_judged(self, planned: PlannedTopic, times_ns: Integers) -> Booleans:
        """Return for each sample whether a topic has begun, is not silent, and has transforms."""
        begun_ns, heard_ns = self._begun_ns.get(planned.name), self._reported_ns.get(planned.name)
        if begun_ns is None or heard_ns is None:
            return np.zeros(len(times_ns), np.bool_)
        message_indices = np.maximum(np.searchsorted(heard_ns, times_ns, "right") - 1, 0)
        is_placed = self._placed_messages[planned.name][message_indices]
        is_old = times_ns - heard_ns[message_indices] > planned.max_age_ns
        is_judged = (times_ns >= begun_ns) & is_placed & ~is_old
        if unplaced_ns := self._unplaced_ns.get(planned.name):
            is_judged &= ~np.isin(times_ns, np.concatenate(unplaced_ns))
        return np.asarray(is_judged)

    def forget(self, upto_ns: int) -> None:
        """Drop old observations, except the last observation of each object and signal."""
        if self._advances < _OLD_ADVANCES and len(self._rows) < _OLD_ROWS:
            return
        self._advances = 0
        used_rows = [np.empty(0, np.int64)]
        for name, events in self._events.items():
            last_events = events.last()
            last_events = select(last_events, np.flatnonzero(last_events.expires_ns > upto_ns))
            self._events[name] = last_events
            used_rows.append(last_events.row)
        last_rows = np.concatenate(used_rows)
        new_numbers = np.zeros(len(self._rows), np.int64)
        new_numbers[last_rows] = np.arange(len(last_rows))
        self._rows = select(self._rows, last_rows)
        for name, last_events in self._events.items():
            self._events[name] = replace(last_events, row=new_numbers[last_events.row])
        self._signals = {
            signal_key: (times_ns[-1:], values[-1:])
            for signal_key, (times_ns, values) in self._signals.items()
        }
        remaining_rows = set(last_rows.tolist())
        self._following = {
            int(new_numbers[row]): following
            for row, following in self._following.items()
            if row in remaining_rows
        }

    def lose(self, time_ns: int, topics: Collection[str]) -> None:
        """Make objects and signals of some topics unknown from a time on; the objects continue to exist."""
        for topic in topics:
            self._begun_ns.pop(topic, None)
            last_events = self._events[topic].last()
            last_events = select(last_events, np.flatnonzero(last_events.expires_ns > time_ns))
            blank_rows = self._add(ObservationRows.blank(last_events.class_code))
            lost_ns = np.full(len(blank_rows), time_ns, np.int64)
            expires_ns = np.full(len(blank_rows), FOREVER_NS, np.int64)
            self._events[topic] = Events(
                last_events.name, lost_ns, blank_rows, expires_ns, last_events.class_code
            ).after(last_events)
            # report times are removed, so that the loss is neither a pause nor a silence of the topic
            self._reported_ns.pop(topic, None)
        self._lost_until_ns |= dict.fromkeys(topics, FOREVER_NS)
        self._signals = {
            signal_key: (np.array([time_ns]), np.array([np.nan])) if signal_key[0] in topics else series
            for signal_key, series in self._signals.items()
        }
        self._store_additions()

    def _take_detections(
        self, reader: TopicReader, times_ns: Integers, log_times_ns: Integers, detections: Detections
    ) -> Booleans:
        """Store the objects of messages; return whether transforms place each message's objects (M,)."""
        if detections.skipped:
            self.remarks.skipped[reader.name] += detections.skipped
        self._claim_names(reader.name, detections.name)
        layout = reader.planned.layout
        is_complete = layout is not None and layout.complete
        self._count_replacements(
            reader.name, times_ns, _superseded_messages(detections, times_ns, is_complete=is_complete)
        )

        def report(repeated_index: int, fault: str) -> None:
            name = self.names.by_code[int(detections.name[repeated_index])]
            log_ns = int(log_times_ns[detections.message[repeated_index]])
            self.report(reader.name, log_ns, f"object {name!r}{fault}")

        transforms = self._transforms(reader, detections, times_ns, log_times_ns)
        rows = rows_from_detections(detections, transforms, self.plan.mapping.axes, self.concave, report)
        self.evidence[reader.name].add_objects(detections, rows.shapes, rows.yaw, rows.uncertainty, times_ns)
        row_numbers = self._add(rows)
        for index in self._follows(reader, detections).tolist():
            frame = (detections.frames or ())[index]
            self._following[int(row_numbers[index])] = _Following(frame, detections, index)
        repeated_indices = _repeated_names(detections) if is_complete else []
        if repeated_indices:
            for repeated_index in repeated_indices:
                report(repeated_index, " is there twice in one message; name each object once")
            # the object is unknown, because either of the two reports may be right
            row_numbers[repeated_indices] = self._add(
                ObservationRows.blank(detections.class_code[repeated_indices])
            )
        earlier_events = self._events[reader.name]
        alive = earlier_events.last()
        events = events_from_messages(
            detections,
            times_ns,
            row_numbers,
            alive=alive,
            is_complete=is_complete,
        )
        self._events[reader.name] = events.after(earlier_events)
        is_placed = np.ones(len(times_ns), np.bool_)
        if transforms is not None:
            is_placed[detections.message[~transforms.known]] = False
        return is_placed

    def _place_following(self, topic: str, times_ns: Integers, states: States) -> None:
        """Replace row numbers (T, N) of objects that move with frames by a row for each time."""
        if not self._following:
            return
        for rows, reported_ns in zip(states.rows.T, states.reported_ns.T, strict=True):
            for row in np.unique(rows).tolist():
                if row in self._following:
                    sample_indices = np.flatnonzero(rows == row)
                    rows[sample_indices] = self._rows_at(
                        topic, self._following[row], times_ns[sample_indices]
                    )
                    # a transform counts as a report at the time of the sample
                    reported_ns[sample_indices] = times_ns[sample_indices]

    def _rows_at(self, topic: str, following: _Following, times_ns: Integers) -> Integers:
        """Return the row numbers of an object that moves with a frame, at some times."""
        mapping, (frame, detections, index) = self.plan.mapping, following
        fixed_frame, longest_ns = mapping.fixed_frame or "", self.readers[topic].planned.between_ns
        log_ns = times_ns if self.plan.by_log_time else None
        poses_of_frame = self.tree.between(
            fixed_frame, frame, times_ns, by_stamp=False, log_ns=log_ns, longest_ns=longest_ns, holds=True
        )
        self._count_missing(topic, frame, times_ns[~poses_of_frame.known])
        self._unplaced_ns[topic].append(times_ns[~poses_of_frame.known])
        # equal transforms in a row share one observation
        changed_indices = _changes(poses_of_frame)
        copies, changed_transforms = (
            detections.repeat(index, len(changed_indices)),
            poses_of_frame.select(changed_indices),
        )
        # faults were reported on arrival
        rows = rows_from_detections(
            copies, changed_transforms, mapping.axes, self.concave, lambda index, what: None
        )
        return self._add(rows)[np.searchsorted(changed_indices, np.arange(len(times_ns)), "right") - 1]

    def _count_missing(self, topic: str, frame: str, times_ns: Integers) -> None:
        if len(times_ns):
            is_known = frame in self.tree.names
            self.remarks.missing.add((topic, frame, is_known), times_ns)

    def _count_replacements(self, topic: str, times_ns: Integers, replaced_indices: Integers) -> None:
        """Count messages that a later message with the same time replaces, wholly or in part."""
        start_ns, end_ns = self.window_ns
        replaced_ns = times_ns[replaced_indices]
        replaced_ns = replaced_ns[(replaced_ns >= start_ns) & (replaced_ns < end_ns)]
        if len(replaced_ns):
            self.remarks.replaced.add(topic, replaced_ns)

    def _store_additions(self) -> None:
        if self._added_rows:
            self._rows = concatenate_tables([self._rows, *self._added_rows])
            self._added_rows = []

    def _add(self, rows: ObservationRows) -> Integers:
        first_row = len(self._rows) + sum(map(len, self._added_rows))
        self._added_rows.append(rows)
        return np.arange(first_row, first_row + len(rows), dtype=np.int64)

    def _claim_names(self, topic: str, name_codes: Integers) -> None:
        distinct_codes = set(name_codes.tolist())
        new_names = {self.names.by_code[code] for code in distinct_codes.difference(self._topic_of_name)}
        if new_names:
            self._objects_of[topic] = self._objects_of.get(topic, frozenset()) | new_names
        for code in distinct_codes:
            owner = self._topic_of_name.setdefault(code, topic)
            if owner != topic:
                raise UsageError(
                    f"{self.plan.mapping.name}: both {owner} and {topic} have an object"
                    f" {self.names.by_code[code]!r}; give one of them another `name`"
                )

    def _transforms(
        self, reader: TopicReader, detections: Detections, times_ns: Integers, log_times_ns: Integers
    ) -> Transforms | None:
        """Return fixed_from_frame of each object; None if all objects are in the fixed frame."""
        fixed_frame = self.plan.mapping.fixed_frame
        if detections.frames is None or fixed_frame is None:
            return None
        frame_codes = Codes()
        frame_of_object = np.array([frame_codes[frame] for frame in detections.frames], np.int64)
        object_count = len(frame_of_object)
        transforms = Transforms.unknown(object_count)
        clock_ns, log_ns = times_ns[detections.message], log_times_ns[detections.message]
        stamp_ns = np.zeros(object_count, np.int64) if detections.stamp_ns is None else detections.stamp_ns
        # a stamp of 0 was not set
        has_stamp = stamp_ns != 0
        following_indices = self._follows(reader, detections)
        # objects that move with frames are placed later, at the times of samples
        transforms.put(following_indices, Transforms.identity(len(following_indices)))
        is_placed_now = np.ones(object_count, np.bool_)
        is_placed_now[following_indices] = False
        for frame, code in frame_codes.items():
            for by_stamp in (False, True):
                object_indices = np.flatnonzero(
                    is_placed_now & (frame_of_object == code) & (has_stamp == by_stamp)
                )
                if not len(object_indices):
                    continue
                at_ns, object_log_ns = (
                    (stamp_ns if by_stamp else clock_ns)[object_indices],
                    log_ns[object_indices],
                )
                frame_transforms = self.tree.between(
                    fixed_frame,
                    frame,
                    at_ns,
                    by_stamp=by_stamp,
                    log_ns=object_log_ns,
                    longest_ns=reader.planned.between_ns,
                )
                transforms.put(object_indices, frame_transforms)
                missing_ns = clock_ns[object_indices[~frame_transforms.known]]
                if by_stamp and len(missing_ns):
                    first_missing = int((~frame_transforms.known).argmax())
                    self.remarks.stamps.setdefault(
                        reader.name, (int(at_ns[first_missing]), int(object_log_ns[first_missing]))
                    )
                # only observations that may be valid in the window are counted
                start_ns, end_ns = self.window_ns
                is_near = (missing_ns < end_ns) & (missing_ns >= start_ns - reader.planned.max_age_ns)
                self._count_missing(reader.name, frame, missing_ns[is_near])
        return transforms

    def _follows(self, reader: TopicReader, detections: Detections) -> Integers:
        """Return the indices of objects that move with their frames."""
        if detections.frames is None or self.plan.mapping.fixed_frame is None:
            return np.empty(0, np.int64)
        if reader.planned.is_static:
            return np.arange(len(detections.name))
        return np.flatnonzero(False if detections.is_locked is None else detections.is_locked)

    def _in_gap(self, topic: str, times_ns: Integers, newest_ns: int) -> Booleans:
        """Return for each time whether the topic pauses around this time for longer than `max_gap`."""
        max_gap_ns, reported_ns = self.plan.mapping.max_gap_ns, self._reported_ns.get(topic)
        planned = self.readers[topic].planned
        if max_gap_ns is None or reported_ns is None or planned.is_lasting or planned.is_latched:
            return np.zeros(len(times_ns), np.bool_)
        waiting_ns = self.readers[topic].pending.first_ns
        # if no message follows, the pause lasts at least until the newest time
        following_ns = newest_ns if waiting_ns is None else waiting_ns
        next_index = np.searchsorted(reported_ns, times_ns, "right")
        before_ns = reported_ns[np.maximum(next_index - 1, 0)]
        next_ns = np.append(reported_ns, following_ns)[next_index]
        return np.asarray((next_index > 0) & (next_ns - before_ns > max_gap_ns) & (times_ns > before_ns))

    def _states(self, times_ns: Integers, newest_ns: int) -> States:
        states = []
        for topic, events in self._events.items():
            state = events.state(times_ns, self.readers[topic].planned.max_age_ns)
            rows, in_gap = state.rows, self._in_gap(topic, times_ns, newest_ns)
            rows[in_gap[:, None] & (rows >= 0)] = STALE
            is_stale = (rows == STALE) & (times_ns >= self._lost_until_ns.get(topic, 0))[:, None]
            for object_index in np.flatnonzero(is_stale.any(axis=0)).tolist():
                name = self.names.by_code[int(state.names[object_index])]
                self.remarks.count_stale(topic, name, times_ns, is_stale[:, object_index], in_gap)
            self._place_following(topic, times_ns, state)
            states.append(state)
        name_arrays, *state_columns = zip(*states, strict=True)
        return States(
            np.concatenate(name_arrays),
            *(np.concatenate(state_column, axis=1) for state_column in state_columns),
        )

    def _signal_columns(
        self, times_ns: Integers, newest_ns: int
    ) -> tuple[dict[str, Floats], dict[str, Integers]]:
        """Return the values of signals, and the report times of signals that some sample carries forward."""
        values_by_signal: dict[str, Floats] = {}
        report_times_ns: dict[str, Integers] = {}
        stale_signals: list[tuple[str, str, Booleans, Booleans]] = []
        for (topic, signal_index), (reported_ns, values) in self._signals.items():
            planned = self.readers[topic].planned
            if planned.mapping is None:
                continue
            report_indices = np.searchsorted(reported_ns, times_ns, "right") - 1
            is_old = times_ns - reported_ns[report_indices] > planned.max_age_ns
            in_gap = self._in_gap(topic, times_ns, newest_ns)
            signal_values = np.where((report_indices < 0) | is_old | in_gap, np.nan, values[report_indices])
            name = planned.mapping.signals[signal_index].name
            is_stale = (
                (report_indices >= 0) & (is_old | in_gap) & (times_ns >= self._lost_until_ns.get(topic, 0))
            )
            stale_signals.append((topic, name, is_stale, in_gap))
            # if several topics report one signal, the first topic with a value is used
            earlier_values = values_by_signal.get(name, np.full(len(times_ns), np.nan))
            report_times_ns[name] = np.where(
                np.isnan(earlier_values), reported_ns[report_indices], report_times_ns.get(name, times_ns)
            )
            values_by_signal[name] = np.where(np.isnan(earlier_values), signal_values, earlier_values)
        for topic, name, is_stale, in_gap in stale_signals:
            self.remarks.count_stale(
                topic, name, times_ns, is_stale & np.isnan(values_by_signal[name]), in_gap
            )
        earlier_reports = {
            name: report_ns
            for name, report_ns in report_times_ns.items()
            if (report_ns != times_ns)[~np.isnan(values_by_signal[name])].any()
        }
        return values_by_signal, earlier_reports


class _Counts(dict[Any, tuple[int, int]]):
    """Counts by key, each with the time of the first event, nanoseconds."""

    def add(self, key: Hashable, times_ns: Integers) -> None:
        count, first_ns = self.get(key, (0, int(times_ns[0])))
        self[key] = count + len(times_ns), first_ns


class Remarks:
    """Remarks on a log, and the counts from which they are made.

    Attributes:
        missing: observations without a transform, by (topic, frame, whether the frame is known).
        stale: samples in which an object or signal is unknown because of a silence, by (topic, whether the
            silence is longer than `max_gap`, name).
        replaced: messages replaced by a later message with the same time, by topic.
        skipped: objects without solids, by topic.
        stamps: first stamp without a transform, and log time of its message, by topic.
        samples: intervals between samples.
        messages: intervals between messages, by topic.
        lasting: reasons why the messages of topics stay valid, by topic.
    """

    def __init__(self, name: str, mapping: LogMapping) -> None:
        self._name = name
        self._mapping = mapping
        self._texts: list[str] = []
        self.missing, self.stale, self.replaced = _Counts(), _Counts(), _Counts()
        self.skipped: Counter[str] = Counter()
        self.stamps: dict[str, tuple[int, int]] = {}
        self.samples = Pauses()
        self.messages: dict[str, Pauses] = defaultdict(Pauses)
        self.lasting: dict[str, str] = {}

    def count_stale(
        self, topic: str, name: str, times_ns: Integers, stale: Booleans, in_gap: Booleans
    ) -> None:
        """Count the samples in which an object or signal is unknown because its topic was silent."""
        for is_gap in (False, True):
            stale_ns = times_ns[stale & (in_gap == is_gap)]
            if len(stale_ns):
                self.stale.add((topic, is_gap, name), stale_ns)

    def add_pauses(self) -> None:
        """Add a remark on each topic's pauses, unless all of these pauses are also pauses of the samples."""
        sample_pauses = self.samples.longest_first()
        for topic, messages in sorted(self.messages.items()):
            if topic in self.lasting:
                continue
            topic_pauses = messages.longest_first()
            is_common = all(
                any(
                    sample_start_ns < start_ns + length_ns and start_ns < sample_start_ns + sample_length_ns
                    for sample_start_ns, sample_length_ns in sample_pauses
                )
                for start_ns, length_ns in topic_pauses
            )
            remark = messages.remark(f"{topic}: messages", self._mapping.max_gap_ns)
            if not is_common and remark is not None:
                self.add(remark)

    def add_silences(self) -> None:
        """Add remarks on topics that stopped after regular messages, and whose last message stays valid."""
        for topic, reason in sorted(self.lasting.items()):
            messages = self.messages[topic]
            last_ns, end_ns, usual_ns = messages.last_ns, self.samples.last_ns, messages.usual_ns
            if last_ns is None or end_ns is None or not messages.is_regular:
                continue
            if end_ns - last_ns > LONG_PAUSE * usual_ns:
                beginning = Sentence(f"{topic}: its messages stop at ", Instant(last_ns, 0))
                usual_text = (
                    f", where one usually comes every {usual_ns / 1e9:.3g} s; the last one stays valid until "
                )
                self.add(
                    Sentence(
                        beginning,
                        usual_text,
                        Instant(end_ns, 0),
                        f", {reason}; a shorter `max_age` makes it unknown",
                    )
                )

    def add(self, text: str) -> None:
        self._texts.append(text)

    def take(self) -> tuple[str, ...]:
        """Return all remarks and remove them."""
        texts = [*self._texts, *self._missing_texts(), *self._stale_texts()]
        for topic, count in sorted(self.skipped.items()):
            subject = "object was" if count == 1 else "objects were"
            texts.append(f"{topic}: {count} {subject} left out, without a solid: lines, arrows or texts")
        for topic, (count, first_ns) in sorted(self.replaced.items()):
            message_subject = "message was" if count == 1 else "messages were"
            beginning = f"{topic}: {count} {message_subject} left out, the first at "
            texts.append(
                Sentence(beginning, Instant(first_ns, 0), ": of those with the same time the last counts")
            )
        for collection in (self._texts, self.missing, self.stale, self.skipped, self.replaced):
            collection.clear()
        return tuple(Sentence(f"{self._name}: ", text) for text in texts)

    def _missing_texts(self) -> Iterator[Sentence]:
        fixed_frame = self._mapping.fixed_frame
        for (topic, frame, is_known), (observation_count, first_ns) in sorted(self.missing.items()):
            reason = f"no transform from {frame!r} to {fixed_frame!r} at that time"
            if not frame:
                reason = "its messages name no frame; give one with `frame`"
            elif not is_known:
                reason = f"no transform to {fixed_frame!r} names the frame {frame!r}"
            elif topic in self.stamps:
                reason += _doubt_of_stamp(*self.stamps[topic])
            subject = "observation is" if observation_count == 1 else "observations are"
            yield Sentence(
                f"{topic}: {observation_count} {subject} unknown, the first at ",
                Instant(first_ns, 0),
                f": {reason}",
            )

    def _stale_texts(self) -> Iterator[Sentence]:
        counts_by_topic: dict[tuple[str, bool], list[tuple[str, int, int]]] = {}
        for (topic, is_gap, name), (sample_count, first_ns) in sorted(self.stale.items()):
            counts_by_topic.setdefault((topic, is_gap), []).append((name, sample_count, first_ns))
        for (topic, is_gap), stale_counts in counts_by_topic.items():
            reason = "the topic was silent for longer than `max_gap`"
            if not is_gap:
                # the reason does not call the topic silent, because other objects may have been reported
                reason = "no report came for longer than max_age; `max_age: forever` keeps the last one"
            names = ", ".join(name for name, _, _ in stale_counts[:_MOST_NAMES])
            more_text = (
                f" and {len(stale_counts) - _MOST_NAMES} more" if len(stale_counts) > _MOST_NAMES else ""
            )
            verb = "is" if len(stale_counts) == 1 else "are"
            most_samples = max(sample_count for _, sample_count, _ in stale_counts)
            first_ns = min(first_stale_ns for _, _, first_stale_ns in stale_counts)
            yield Sentence(
                (
                    f"{topic}: {names}{more_text} {verb} unknown in up to {plural(most_samples, 'sample')},"
                    " the first at "
                ),
                Instant(first_ns, 0),
                f": {reason}",
            )


def _unheard_span(planned: PlannedTopic) -> TopicSpan:
    """Return the span of a topic before its first message."""
    entry, layout = planned.mapping, planned.layout
    return TopicSpan(
        topic=planned.name,
        objects=frozenset(),
        pattern=None if entry is None or layout is None else name_pattern(layout, entry),
        signals=frozenset(() if entry is None else (signal.name for signal in entry.signals)),
        classes=None if layout is None else possible_classes(layout),
        limit_ns=planned.silence_ns,
        begun_ns=None,
        heard_ns=None,
        first_ns=None,
        last_ns=None,
    )


def _doubt_of_stamp(stamp_ns: int, log_ns: int) -> str:
    """Return a clause on a stamp more than a year from its log time; "" for other stamps."""
    if abs(stamp_ns - log_ns) < _FAR_NS:
        return ""
    year, unit = datetime.fromtimestamp(stamp_ns / 1e9, UTC).year, unit_of_stamp(stamp_ns, log_ns)
    remedy = "" if unit == "ns" else f": `stamp: {{field: PATH, unit: {unit}}}` reads it in {unit}"
    return f"; its stamp is {stamp_ns / 1e9:.3g} s, in {year}{remedy}"


def _superseded_messages(detections: Detections, times_ns: Integers, *, is_complete: bool) -> Integers:
    """Return the indices of messages that a later message with the same time replaces, wholly or in part."""
    has_successor = np.append(times_ns[1:] == times_ns[:-1], False)
    if is_complete or not has_successor.any():
        return np.flatnonzero(has_successor)
    message = detections.message
    name_order = np.lexsort((message, detections.name, times_ns[message]))
    name, time_ns, message = detections.name[name_order], times_ns[message[name_order]], message[name_order]
    has_later_message = (
        (name[1:] == name[:-1]) & (time_ns[1:] == time_ns[:-1]) & (message[1:] != message[:-1])
    )
    return np.unique(message[:-1][has_later_message])


def _changes(transforms: Transforms) -> Integers:
    rotation, translation, is_known = transforms
    is_changed = np.ones(len(is_known), np.bool_)
    is_changed[1:] = (
        (rotation[1:] != rotation[:-1]).any(axis=(1, 2))
        | (translation[1:] != translation[:-1]).any(axis=1)
        | (is_known[1:] != is_known[:-1])
    )
    return np.flatnonzero(is_changed)


def _repeated_names(detections: Detections) -> list[int]:
    name_order = np.lexsort((detections.name, detections.message))
    message, name = detections.message[name_order], detections.name[name_order]
    repeated_indices: list[int] = name_order[1:][
        (message[1:] == message[:-1]) & (name[1:] == name[:-1])
    ].tolist()
    return repeated_indices
