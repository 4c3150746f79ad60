"""Everything that is known at the times of samples: objects of all topics, and signals.

What is not as one would wish, counted, without a loss.

When samples are taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.footprint import Concave
from spatial_replay.mapping.detections import EVERY_OBJECT, Detections
from spatial_replay.mapping.model import LogMapping
from spatial_replay.mapping.names import Codes
from spatial_replay.mapping.reading_plan import ReadingPlan
from spatial_replay.mapping.timeline import (
    STALE,
    Events,
    ObservationRows,
    events_from_messages,
    rows_from_detections,
)
from spatial_replay.mapping.topic_reader import TopicReader
from spatial_replay.mapping.transforms import FrameTree, Transforms
from spatial_replay.trace.sample import FOREVER
from spatial_replay.trace.trace import ABSENT, Trace

_MOST_STEPS = 100_000
"""Samples between two messages; more are no log with pauses, but a clock that jumped."""


_MOST_AT_ONCE = 1_000_000
"""Samples among the messages that are taken together: they are in memory at once."""


class Instants:
    """The times of samples, as the messages go by.

    Args:
        start_ns: where the samples begin that matter; those at multiples of a step are counted from there.
    """

    def __init__(self, plan: ReadingPlan, name: str, start_ns: int) -> None:
        self._name = name
        self._mapping_name = plan.mapping.name
        self._step_ns = plan.mapping.sampling.step_ns
        self._start_ns = start_ns
        self._from_ns: int | None = None
        self._last_ns = -1

    def upto(self, times_ns: Integers, upto_ns: int) -> Integers:
        """The times of the next samples, each once.

        Args:
            times_ns: of the messages that are new: those of the sampled topic or, for samples at
                each multiple of a step, of all topics with objects or signals.
            upto_ns: how far the log is known.

        Raises:
            LogError: there are far too many samples to where the log goes on.
            UsageError: the step is far too short for how often there are messages.
        """
        if self._step_ns is None:
            times = np.unique(times_ns)
            times = times[times > self._last_ns]
        else:
            times = self._multiples(times_ns, upto_ns, self._step_ns)
        if len(times):
            self._last_ns = int(times[-1])
        return times

    def _multiples(self, times_ns: Integers, upto_ns: int, step_ns: int) -> Integers:
        if self._from_ns is None and len(times_ns):
            self._from_ns = max(int(times_ns.min()), self._start_ns)
        if self._from_ns is None or upto_ns < self._from_ns:
            return np.empty(0, np.int64)
        begin_ns = max(self._from_ns, self._last_ns + 1)
        first, stop = -(-begin_ns // step_ns), upto_ns // step_ns + 1
        marks = np.unique(np.concatenate([[begin_ns, upto_ns], times_ns[times_ns > begin_ns]]))
        gaps = np.diff(marks)
        if len(gaps) and int(gaps.max()) // step_ns > _MOST_STEPS:
            at = int(np.argmax(gaps))
            raise LogError(
                f"{self._name}: time jumps forward from {marks[at]} ns to {marks[at + 1]} ns, more than"
                f" {_MOST_STEPS} samples without a message; take another clock or a longer step"
            )
        if stop - first > _MOST_AT_ONCE:
            raise UsageError(
                f"{self._mapping_name}: sample.every: a sample each {step_ns} ns makes {stop - first} of them"
                f" up to {upto_ns} ns, where at most {_MOST_AT_ONCE} fit between messages that are read"
                " together; give a longer step"
            )
        return np.arange(first, max(first, stop), dtype=np.int64) * step_ns


_MOST_NAMES = 8


class Remarks:
    """Counts of what became unknown, and why."""

    def __init__(self, name: str, mapping: LogMapping) -> None:
        self._name = name
        self._mapping = mapping
        self._texts: list[str] = []
        self._missing: dict[tuple[str, str, bool], tuple[int, int]] = {}
        self._stale: dict[tuple[str, str], tuple[int, int]] = {}
        self._skipped: dict[str, int] = {}
        self._frames: set[str] = set()

    def add(self, text: str) -> None:
        self._texts.append(text)

    def count_missing(self, topic: str, frame: str, count: int, first_ns: int, *, is_known: bool) -> None:
        """Objects whose transform into the fixed frame is missing."""
        before, first = self._missing.get((topic, frame, is_known), (0, first_ns))
        self._missing[topic, frame, is_known] = before + count, first

    def count_stale(self, topic: str, name: str, count: int, first_ns: int) -> None:
        """Samples in which an object is unknown because its topic fell silent."""
        before, first = self._stale.get((topic, name), (0, first_ns))
        self._stale[topic, name] = before + count, first

    def count_skipped(self, topic: str, count: int) -> None:
        """Drawn things that are no bodies."""
        self._skipped[topic] = self._skipped.get(topic, 0) + count

    def note_frames(self, frames: Iterable[str]) -> None:
        """Frames that coordinates are taken in as they are."""
        if len(self._frames) < _MOST_NAMES:
            self._frames.update(frame.removeprefix("/") for frame in frames if frame)

    def take(self) -> tuple[str, ...]:
        """Every remark, once."""
        texts = [f"{self._name}: {text}" for text in self._texts]
        fixed = self._mapping.fixed_frame
        for (topic, frame, is_known), (count, first_ns) in sorted(self._missing.items()):
            reason = f"no transform from {frame!r} to {fixed!r} at that time"
            if not frame:
                reason = "its messages name no frame; give one with `frame`"
            elif not is_known:
                reason = f"no transform to {fixed!r} names the frame {frame!r}"
            texts.append(
                f"{self._name}: {topic}: {count} observation{'s are' if count != 1 else ' is'} unknown,"
                f" the first at {first_ns} ns: {reason}"
            )
        texts += self._stale_texts()
        texts += [
            f"{self._name}: {topic}: "
            + (
                f"{count} things were left out that are no bodies"
                if count != 1
                else "1 thing was left out that is no body"
            )
            + ", such as lines and texts"
            for topic, count in sorted(self._skipped.items())
        ]
        if fixed is None and len(self._frames) > 1:
            listed = ", ".join(sorted(map(repr, self._frames)))
            texts.append(
                f"{self._name}: coordinates are in the frames {listed} and taken as they are;"
                " `fixed_frame` in the mapping brings them into one"
            )
        self._texts, self._missing, self._stale, self._skipped, self._frames = [], {}, {}, {}, set()
        return tuple(texts)

    def _stale_texts(self) -> list[str]:
        by_topic: dict[str, list[tuple[str, int, int]]] = {}
        for (topic, name), (count, first_ns) in sorted(self._stale.items()):
            by_topic.setdefault(topic, []).append((name, count, first_ns))
        texts: list[str] = []
        for topic, stale in by_topic.items():
            names = ", ".join(name for name, _, _ in stale[:_MOST_NAMES])
            more = f" and {len(stale) - _MOST_NAMES} more" if len(stale) > _MOST_NAMES else ""
            most = max(count for _, count, _ in stale)
            first_ns = min(first for _, _, first in stale)
            texts.append(
                f"{self._name}: {topic}: {names}{more} are unknown in up to {most} samples, the first at"
                f" {first_ns} ns: the topic was silent for longer than max_age"
            )
        return texts


TakeFault = Callable[[str, int, str], None]


class Tracker:
    """The state of every object and signal, carried from one stretch of a log to the next."""

    def __init__(
        self,
        plan: ReadingPlan,
        channels: Mapping[str, TopicReader],
        names: Codes,
        classes: Codes,
        tree: FrameTree,
        remarks: Remarks,
        fault: TakeFault,
        concave: Concave,
    ) -> None:
        self._plan = plan
        self._channels = channels
        self._names, self._classes = names, classes
        self._tree = tree
        self._remarks = remarks
        self._fault = fault
        self._concave = concave
        self._rows = ObservationRows.blank(np.empty(0, np.int64))
        self._events = {name: Events.none() for name in channels}
        self._signals: dict[tuple[str, int], tuple[Integers, Floats]] = {}
        self._owners: dict[int, str] = {}
        self._window_ns = 0, FOREVER

    def settle(self, upto_ns: int, instants: Instants, start_ns: int, end_ns: int) -> Trace:
        """Take in the messages that wait, up to a time; the samples up to then that lie in a window."""
        self._window_ns = start_ns, end_ns
        sampled: list[Integers] = []
        stored = [self._rows]
        for name, channel in self._channels.items():
            times_ns, log_times_ns, contents = channel.pending.take(upto_ns)
            harvest = channel.harvest(log_times_ns, contents) if channel.reads else None
            if harvest is not None and len(harvest.kept) < len(contents):
                times_ns, log_times_ns = times_ns[harvest.kept], log_times_ns[harvest.kept]
            if channel.extractor is not None:
                self._remarks.note_frames(channel.extractor.noted_frames)
            if self._plan.sampled_topic in (None, name):
                sampled.append(times_ns)
            if harvest is not None and harvest.seen is not None:
                self._take_objects(channel, times_ns, log_times_ns, harvest.seen, stored)
            for place, values in enumerate(harvest.signals if harvest is not None else ()):
                self._take_signal((name, place), times_ns, values)
        self._rows = ObservationRows.concatenate(stored) if len(stored) > 1 else self._rows
        times = instants.upto(np.concatenate([np.empty(0, np.int64), *sampled]), upto_ns)
        times = times[(times >= start_ns) & (times < end_ns)]
        trace = self._trace(times)
        self._forget(upto_ns)
        return trace

    def _take_objects(
        self,
        channel: TopicReader,
        times_ns: Integers,
        log_times_ns: Integers,
        seen: Detections,
        stored: list[ObservationRows],
    ) -> None:
        if not len(times_ns):
            return
        if seen.skipped:
            self._remarks.count_skipped(channel.name, seen.skipped)
        self._claim(channel.name, seen.name)
        name_of = _Names(self._names)

        def fault(index: int, what: str) -> None:
            named = f"object {name_of[int(seen.name[index])]!r}{what}"
            self._fault(channel.name, int(log_times_ns[seen.message[index]]), named)

        rows = rows_from_detections(seen, self._transforms(channel, seen, times_ns), self._concave, fault)
        first = sum(map(len, stored))
        number = np.arange(first, first + len(rows), dtype=np.int64)
        stored.append(rows)
        reading = channel.planned.reading
        before = self._events[channel.name]
        is_complete = reading is not None and reading.complete
        if is_complete:
            number = self._without_twice_named(seen, number, stored, fault)
        self._events[channel.name] = events_from_messages(
            name=seen.name,
            message=seen.message,
            class_code=seen.class_code,
            times_ns=times_ns,
            rows=number,
            lifetime_ns=seen.lifetime_ns,
            gone=_spelt_out(seen, before),
            alive=before.last(),
            is_complete=is_complete,
        ).after(before)

    def _claim(self, topic: str, names: Integers) -> None:
        for code in np.unique(names).tolist():
            owner = self._owners.setdefault(code, topic)
            if owner != topic:
                name = _Names(self._names)[code]
                raise UsageError(
                    f"{self._plan.mapping.name}: both {owner} and {topic} have an object {name!r};"
                    " give one of them another `name`"
                )

    def _transforms(self, channel: TopicReader, seen: Detections, times_ns: Integers) -> Transforms | None:
        """fixed_from_frame of each object; None where everything is in the fixed frame."""
        fixed = self._plan.mapping.fixed_frame
        if seen.frames is None or fixed is None:
            return None
        codes = Codes()
        of_frame = np.array([codes[frame] for frame in seen.frames], np.int64)
        count = len(of_frame)
        found = Transforms(np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros(count, np.bool_))
        clock_ns = times_ns[seen.message]
        stamped = np.zeros(count, np.bool_) if seen.stamp_ns is None else seen.stamp_ns != 0
        for frame, code in codes.items():
            for by_stamp in (False, True):
                chosen = np.flatnonzero((of_frame == code) & (stamped == by_stamp))
                if not len(chosen):
                    continue
                at = clock_ns[chosen] if seen.stamp_ns is None or not by_stamp else seen.stamp_ns[chosen]
                between = self._tree.between(fixed, frame, at, by_stamp=by_stamp)
                for whole, part in zip(found, between, strict=True):
                    whole[chosen] = part
                missing = chosen[~between.known]
                # what says nothing of the window is no loss
                missing = missing[self._matters(channel, clock_ns[missing])]
                if len(missing):
                    self._remarks.count_missing(
                        channel.name,
                        frame,
                        len(missing),
                        int(clock_ns[missing[0]]),
                        is_known=frame in self._tree.names,
                    )
        return found

    def _matters(self, channel: TopicReader, times_ns: Integers) -> NDArray[np.bool_]:
        """Whether what a topic says at some times may count in the window."""
        start_ns, end_ns = self._window_ns
        return (times_ns < end_ns) & (times_ns >= start_ns - channel.planned.max_age_ns)

    def _without_twice_named(
        self,
        seen: Detections,
        number: Integers,
        stored: list[ObservationRows],
        fault: Callable[[int, str], None],
    ) -> Integers:
        """The rows, where an object that one message names twice is unknown."""
        order = np.lexsort((seen.name, seen.message))
        message, name = seen.message[order], seen.name[order]
        again = order[1:][(message[1:] == message[:-1]) & (name[1:] == name[:-1])]
        if not len(again):
            return number
        for index in again.tolist():
            fault(index, " is there twice in one message; name each object once")
        blank = ObservationRows.blank(seen.class_code[again])
        number = number.copy()
        number[again] = sum(map(len, stored)) + np.arange(len(again))
        stored.append(blank)
        return number

    def _take_signal(self, key: tuple[str, int], times_ns: Integers, values: Floats) -> None:
        before = self._signals.get(key, (np.empty(0, np.int64), np.empty(0)))
        self._signals[key] = np.concatenate([before[0], times_ns]), np.concatenate([before[1], values])

    def _trace(self, times_ns: Integers) -> Trace:
        if not len(times_ns):
            return Trace.from_samples(())
        states = []
        for topic, events in self._events.items():
            age = self._channels[topic].planned.max_age_ns
            state = events.state(times_ns, age)
            self._count_stale(topic, times_ns, state[0], state[1])
            states.append(state)
        codes = np.concatenate([np.empty(0, np.int64), *(state[0] for state in states)])
        rows = np.concatenate([state[1] for state in states], axis=1)
        classes = np.concatenate([state[2] for state in states], axis=1)
        name_of = _Names(self._names)
        names = [name_of[code] for code in codes.tolist()]
        seen = (rows != ABSENT).any(axis=0).tolist()
        order = sorted((i for i in range(len(names)) if seen[i]), key=names.__getitem__)
        rows, classes = rows[:, order], classes[:, order]
        # what is stale has a blank row, by class, after the others
        kept = self._rows
        stale_rows = len(kept) + classes
        readable = np.append(kept.is_readable, False)[np.where(rows >= 0, rows, -1)]
        numbered = np.where(rows == ABSENT, ABSENT, np.where(readable, rows, -2 - rows))
        everything, is_stale = kept, rows == STALE
        if is_stale.any():
            numbered = np.where(is_stale, -2 - stale_rows, numbered)
            everything = ObservationRows.concatenate(
                [kept, ObservationRows.blank(np.arange(len(self._classes), dtype=np.int64))]
            )
        by_code = sorted(self._classes, key=self._classes.__getitem__)
        ordered = sorted(range(len(by_code)), key=lambda i: (by_code[i] is not None, by_code[i] or ""))
        rank = np.zeros(len(by_code), np.int64)
        rank[ordered] = np.arange(len(by_code))
        return Trace(
            times_ns=times_ns,
            names=tuple(names[i] for i in order),
            rows=numbered,
            footprints=everything.shapes,
            yaw=everything.yaw,
            uncertainty=everything.uncertainty,
            class_code=rank[everything.class_code] if len(rank) else everything.class_code,
            classes=tuple(by_code[i] for i in ordered),
            signals=self._signal_columns(times_ns),
        ).take(np.arange(len(times_ns)))

    def _count_stale(self, topic: str, times_ns: Integers, names: Integers, rows: Integers) -> None:
        stale = rows == STALE
        columns = np.flatnonzero(stale.any(axis=0)).tolist()
        name_of = _Names(self._names if columns else ())
        for column in columns:
            at = np.flatnonzero(stale[:, column])
            name = name_of[int(names[column])]
            self._remarks.count_stale(topic, name, len(at), int(times_ns[at[0]]))

    def _signal_columns(self, times_ns: Integers) -> dict[str, Floats]:
        columns: dict[str, Floats] = {}
        for (topic, place), (reported_ns, values) in self._signals.items():
            planned = self._channels[topic].planned
            assert planned.mapping is not None
            at = np.searchsorted(reported_ns, times_ns, "right") - 1
            if len(values):
                too_old = (at < 0) | (times_ns - reported_ns[at] > planned.max_age_ns)
                found = np.where(too_old, np.nan, values[at])
                name = planned.mapping.signals[place].name
                columns[name] = (
                    np.where(np.isnan(columns[name]), found, columns[name]) if name in columns else found
                )
        return columns

    def _forget(self, upto_ns: int) -> None:
        """Keep of the past what later samples may need: the last that is known of each."""
        used: list[Integers] = []
        for name, events in self._events.items():
            last = events.last()
            last = last.select(np.flatnonzero(last.expires_ns > upto_ns))
            self._events[name] = last
            used.append(last.row)
        chosen = np.concatenate([np.empty(0, np.int64), *used])
        number = np.zeros(len(self._rows), np.int64)
        number[chosen] = np.arange(len(chosen))
        self._rows = self._rows.select(chosen)
        for name, last in self._events.items():
            self._events[name] = Events(
                last.name, last.time_ns, number[last.row], last.expires_ns, last.class_code
            )
        self._signals = {key: (times[-1:], values[-1:]) for key, (times, values) in self._signals.items()}


class _Names:
    """Names by their codes."""

    def __init__(self, codes: Iterable[str]) -> None:
        self._texts: Sequence[str] = list(codes)

    def __getitem__(self, code: int) -> str:
        return self._texts[code]


def _spelt_out(seen: Detections, before: Events) -> list[tuple[int, int]]:
    """Who was deleted by which message, name by name."""
    if all(name != EVERY_OBJECT for _, name in seen.gone):
        return seen.gone
    everyone = np.unique(np.concatenate([before.name, seen.name])).tolist()
    return [
        (message, name)
        for message, told in seen.gone
        for name in (everyone if told == EVERY_OBJECT else [told])
    ]
