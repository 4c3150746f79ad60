"""Everything that is known at the times of samples: objects of all topics, and signals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.mapping.channel import Channel
from spatial_replay.logs.mapping.frames import FrameTree, Transforms
from spatial_replay.logs.mapping.instants import Instants
from spatial_replay.logs.mapping.naming import Codes
from spatial_replay.logs.mapping.observed import Rows, rows_from_seen
from spatial_replay.logs.mapping.plan import Plan
from spatial_replay.logs.mapping.remarks import Remarks
from spatial_replay.logs.mapping.seen import EVERYONE, Seen
from spatial_replay.logs.mapping.timeline import STALE, Events, events_of
from spatial_replay.trace.times import FOREVER
from spatial_replay.trace.trace import ABSENT, Trace

TakeFault = Callable[[str, int, str], None]


class Scene:
    """The state of every object and signal, carried from one stretch of a log to the next."""

    def __init__(
        self,
        plan: Plan,
        channels: Mapping[str, Channel],
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
        self._rows = Rows.blank(np.empty(0, np.int64))
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
        self._rows = Rows.concatenate(stored) if len(stored) > 1 else self._rows
        times = instants.upto(np.concatenate([np.empty(0, np.int64), *sampled]), upto_ns)
        times = times[(times >= start_ns) & (times < end_ns)]
        trace = self._trace(times)
        self._forget(upto_ns)
        return trace

    def _take_objects(
        self,
        channel: Channel,
        times_ns: Integers,
        log_times_ns: Integers,
        seen: Seen,
        stored: list[Rows],
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

        rows = rows_from_seen(seen, self._transforms(channel, seen, times_ns), self._concave, fault)
        first = sum(map(len, stored))
        number = np.arange(first, first + len(rows), dtype=np.int64)
        stored.append(rows)
        reading = channel.planned.reading
        before = self._events[channel.name]
        is_complete = reading is not None and reading.complete
        if is_complete:
            number = self._without_twice_named(seen, number, stored, fault)
        self._events[channel.name] = events_of(
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

    def _transforms(self, channel: Channel, seen: Seen, times_ns: Integers) -> Transforms | None:
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

    def _matters(self, channel: Channel, times_ns: Integers) -> NDArray[np.bool_]:
        """Whether what a topic says at some times may count in the window."""
        start_ns, end_ns = self._window_ns
        return (times_ns < end_ns) & (times_ns >= start_ns - channel.planned.max_age_ns)

    def _without_twice_named(
        self, seen: Seen, number: Integers, stored: list[Rows], fault: Callable[[int, str], None]
    ) -> Integers:
        """The rows, where an object that one message names twice is unknown."""
        order = np.lexsort((seen.name, seen.message))
        message, name = seen.message[order], seen.name[order]
        again = order[1:][(message[1:] == message[:-1]) & (name[1:] == name[:-1])]
        if not len(again):
            return number
        for index in again.tolist():
            fault(index, " is there twice in one message; name each object once")
        blank = Rows.blank(seen.class_code[again])
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
            everything = Rows.concatenate([kept, Rows.blank(np.arange(len(self._classes), dtype=np.int64))])
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


def _spelt_out(seen: Seen, before: Events) -> list[tuple[int, int]]:
    """Who was deleted by which message, name by name."""
    if all(name != EVERYONE for _, name in seen.gone):
        return seen.gone
    everyone = np.unique(np.concatenate([before.name, seen.name])).tolist()
    return [
        (message, name) for message, told in seen.gone for name in (everyone if told == EVERYONE else [told])
    ]
