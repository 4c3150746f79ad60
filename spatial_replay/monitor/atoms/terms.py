"""Terms in a trace: footprints, uncertainty, where they are unknown, and how far they look back (`a[-3]`).

A rate looks back at reports. A run of samples that show the same report of an object ends where they show
another one, or none.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isfinite, isnan, nan
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Flags, Floats, Integers
from spatial_replay.geometry.footprint import (
    Footprint,
    FootprintBatch,
    TrackedObject,
    centre_of,
    centres_of,
    shifted,
)
from spatial_replay.geometry.measure import Operand
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Centre,
    ComputedSignal,
    Earlier,
    Enlarged,
    Formula,
    Group,
    Outline,
    Present,
    PreviousSignal,
    Rate,
    RegionName,
    ReportStep,
    Signal,
    Term,
    TrackedName,
    Variable,
)
from spatial_replay.spec.relations import computed_signal
from spatial_replay.spec.walks import has_rate, iter_terms, named_members, standing, step_of
from spatial_replay.text import TEXTS
from spatial_replay.trace.trace import ABSENT, Sample, Trace


class Delay(NamedTuple):
    """How far a term looks back: some samples, at least some ns, or to a report (neither)."""

    samples: int | None
    duration_ns: int | None

    @classmethod
    def of(cls, term: Earlier) -> Delay:
        return cls(term.samples, term.duration_ns)


NO_DELAY = Delay(0, None)
TO_REPORTS = Delay(None, None)


def iter_delays(formulas: Sequence[Formula]) -> Iterator[Delay]:
    """Iterate over the delays of the terms in some formulas that look back."""
    for term in map(standing, iter_terms(formulas)):
        if isinstance(term, Earlier):
            yield Delay.of(term)
    if any(map(has_rate, formulas)):
        yield TO_REPORTS


class Reach(NamedTuple):
    """How far terms look back: some samples (`a[-3]`), some ns (`a[-2s]`), and to reports (`speed(a)`)."""

    samples: int
    duration_ns: int
    to_reports: bool = False

    def __bool__(self) -> bool:
        return any(tuple(self))


def look_back(formulas: Sequence[Formula]) -> Reach:
    """Return how far the terms of some formulas look back."""
    delays = list(iter_delays(formulas))
    samples = max((delay.samples or 0 for delay in delays), default=0)
    duration_ns = max((delay.duration_ns or 0 for delay in delays), default=0)
    return Reach(samples, duration_ns, TO_REPORTS in delays)


def tail(trace: Trace, reach: Reach) -> Trace:
    """Return the samples of a trace that the next one may look back at (see `look_back`)."""
    begin = len(trace) - max(reach.samples, reach.to_reports)
    if reach.duration_ns:
        # the next sample is later than the newest, so it needs nothing before what the newest looks back at
        latest_ns = trace.times_ns[-1] - reach.duration_ns
        begin = min(begin, int(np.searchsorted(trace.times_ns, latest_ns, side="right")) - 1)
    recent = np.arange(max(begin, 0), len(trace))
    if reach.to_reports:
        recent = np.union1d(_before_last_reports(trace), recent)
    return trace.take(recent)


def _before_last_reports(trace: Trace) -> Integers:
    """Return the samples right before those that show the last reports."""
    columns = [(trace.rows >= 0, trace.reported_ns)] if trace.reported_ns is not None else []
    for name, reported_ns in trace.signals_reported_ns.items():
        columns.append((is_signal_known(trace.signals[name])[:, None], reported_ns[:, None]))
    samples = [np.empty(0, np.int64)]
    for is_known, reported_ns in columns:
        begins = _begins(is_known, reported_ns)[:, is_known[-1]]
        first = len(trace) - 1 - np.argmax(begins[::-1], axis=0)
        samples.append(first[first > 0] - 1)
    return np.concatenate(samples).astype(np.int64)


def is_signal_known(values: Floats) -> Booleans:
    """Return where the values of a signal are numbers."""
    return np.asarray(np.isfinite(values) & (values > TEXTS))


def _begins(is_known: Booleans, reported_ns: Integers) -> Booleans:
    """Return where reports begin to be shown; both columns are (T, ...)."""
    begins = is_known.copy()
    begins[1:] &= ~is_known[:-1] | (reported_ns[1:] != reported_ns[:-1])
    return begins


class Reports(NamedTuple):
    """The report of an object or a signal that each sample shows, and the last other one before it.

    Attributes:
        before: (T,), the last sample that showed the other one, -1 if there is none: what is reported for the
            first time, or for the first time after a hole.
        seconds: (T,), the time between both; NaN if there is none, or if it is not positive.
    """

    before: Integers
    seconds: Floats

    @classmethod
    def of(cls, is_known: Booleans, reported_ns: Integers) -> Reports:
        begins = np.where(_begins(is_known, reported_ns), np.arange(len(is_known)), -1)
        before = np.where(is_known, np.maximum.accumulate(begins) - 1, -1)
        before = np.where((before >= 0) & is_known[before], before, -1)
        step_ns = np.where(before < 0, 0, reported_ns - reported_ns[before])
        seconds = np.where(step_ns > 0, step_ns / 1e9, np.nan)
        return cls(before.astype(np.int64), seconds)


class RecentSamples:
    """The samples at some delays from the newest; older ones are dropped."""

    def __init__(self, delays: Iterable[Delay]) -> None:
        self._queues: list[tuple[Delay, deque[Sample]]] = [(delay, deque()) for delay in delays]
        self._is_newest_only = [delay for delay, _ in self._queues] == [NO_DELAY]

    def add(self, sample: Sample) -> list[Sample | None]:
        """Add the next sample; return the one at each delay from it, None before the first sample."""
        if self._is_newest_only:
            return [sample]
        return [_at_delay(delay, queue, sample) for delay, queue in self._queues]


def _at_delay(delay: Delay, queue: deque[Sample], sample: Sample) -> Sample | None:
    if delay in (NO_DELAY, TO_REPORTS):
        return sample
    queue.append(sample)
    if delay.duration_ns is None:
        while len(queue) > (delay.samples or 0) + 1:
            queue.popleft()
        return queue[0] if len(queue) > (delay.samples or 0) else None
    latest_ns = sample.time_ns - delay.duration_ns
    while len(queue) > 1 and queue[1].time_ns <= latest_ns:
        queue.popleft()
    return queue[0] if queue[0].time_ns <= latest_ns else None


class LatestReport(NamedTuple):
    """What a sample shows of an object or a signal (see `Reports`).

    Attributes:
        shown: the object, or the value.
        reported_ns: when it was reported.
        before: the last other report, None if there is none.
        seconds: the time between both; NaN if there is none, or if it is not positive.
    """

    shown: Any
    reported_ns: int
    before: LatestReport | None = None
    seconds: float = nan

    def follow(self, shown: Any, reported_ns: int) -> LatestReport:
        """Return what the next sample shows, by what it reports."""
        if reported_ns == self.reported_ns:
            return self._replace(shown=shown)
        step_ns = reported_ns - self.reported_ns
        before = self._replace(before=None)
        return LatestReport(shown, reported_ns, before, step_ns / 1e9 if step_ns > 0 else nan)


class RecentReports:
    """The reports that the newest sample shows of objects and signals, and the last other ones.

    Args:
        objects: their names; None for all objects.
    """

    def __init__(self, objects: frozenset[str] | None, signals: Iterable[Signal]) -> None:
        self._objects = objects
        self._signals = tuple(signals)
        self.of: dict[str | Signal, LatestReport] = {}

    def add(self, sample: Sample) -> None:
        """Add the next sample; a hole forgets the reports before it."""
        latest: dict[str | Signal, LatestReport] = {}
        objects, times = sample.objects, sample.reported_ns
        for name in objects if self._objects is None else self._objects:
            if name in objects:
                latest[name] = self._next(name, objects[name], times.get(name, sample.time_ns))
        for signal in self._signals:
            time_ns = sample.time_ns
            if isinstance(signal, ComputedSignal):
                value = computed_signal(signal, sample)
            else:
                value, time_ns = sample.signals.get(signal.name, nan), times.get(signal.name, time_ns)
            if isfinite(value) and value > TEXTS:
                latest[signal] = self._next(signal, value, time_ns)
        self.of = latest

    def _next(self, key: str | Signal, shown: Any, reported_ns: int) -> LatestReport:
        latest = self.of.get(key)
        return LatestReport(shown, reported_ns) if latest is None else latest.follow(shown, reported_ns)

    def seconds(self, name: str) -> float:
        """Return the time between the last two reports of an object; NaN if there are no two."""
        latest = self.of.get(name)
        return nan if latest is None else latest.seconds

    def step(self, terms: Iterable[Term], sample: Sample) -> float:
        """Return the shortest time between two reports of what moves in some terms, NaN for none."""
        shortest = inf
        for term in terms:
            for name in _members_in(term, sample):
                seconds = self.seconds(name)
                if seconds != seconds and name not in sample.lasting:
                    return nan
                shortest = min(shortest, seconds if seconds == seconds else inf)
        return shortest if isfinite(shortest) else nan

    def moved_back(self, name: str, sample: Sample, shortest: float) -> TrackedObject | None:
        """Return an object as it was some seconds ago by its velocity; None if it was not reported before."""
        latest = self.of.get(name)
        if latest is None:
            return None
        before, seconds = latest.before, latest.seconds
        now: TrackedObject = latest.shown
        if before is None or seconds != seconds:
            return now if name in sample.lasting else None
        then: TrackedObject = before.shown
        if seconds == shortest:
            return then
        if not seconds > shortest:
            return None
        (x, y), (then_x, then_y) = (centre_of(tracked.footprint) for tracked in (now, then))
        share = shortest / seconds
        shift = np.array([[(then_x - x) * share, (then_y - y) * share]])
        moved = shifted(FootprintBatch.from_footprints([now.footprint]), shift)
        uncertainty = max(now.uncertainty, then.uncertainty)
        return replace(now, footprint=moved.footprint(0), uncertainty=uncertainty)


def _members_in(term: Term, sample: Sample) -> Iterable[str]:
    """Return the objects of a term in a sample."""
    if not isinstance(term, Group):
        return (term.name,)  # type: ignore[union-attr]
    if not term.is_open:
        return named_members(term)
    wanted, left_out = (term.class_name or "").casefold(), left_out_of(term)
    classes = {name: tracked.class_name for name, tracked in sample.objects.items()} | dict(sample.unknown)
    return [
        name
        for name, class_name in classes.items()
        if name not in left_out and (term.class_name == ANY_CLASS or (class_name or "").casefold() == wanted)
    ]


_NO_REPORT = ABSENT - 1
"""In place of a row: the object is there, but was not reported before."""

Bindings = Mapping[str, TrackedName]
"""The objects that variables stand for."""


@dataclass(frozen=True)
class ResolvedTerm:
    """A term over the samples of a scene.

    Attributes:
        operand: its footprints.
        unknown: (T,), where it is unknown as a whole.
        spread: (T,), its uncertainty; the largest of a group's members.
        yaw: (T,), its orientation, NaN if it has none.
    """

    operand: Operand
    unknown: Booleans
    spread: Floats
    yaw: Floats


_Base: TypeAlias = TrackedName | Variable | RegionName | Group


class TraceScene:
    """The samples `skip` and after of a trace, and the regions of a specification.

    Earlier samples are there for terms that look back (`a[-3]`).
    """

    def __init__(self, trace: Trace, regions: Mapping[str, Outline], skip: int = 0) -> None:
        self.trace = trace
        self.regions = regions
        self.skip = skip
        self._column = {name: index for index, name in enumerate(trace.names)}
        self._has_centres = False
        self._moved: list[FootprintBatch] = []
        self._joined_batch: FootprintBatch | None = None
        self._moved_count = 0
        self._reports: dict[TrackedName | Signal, Reports] = {}
        self._steps: dict[tuple[TrackedName | Variable | Group, ...], Floats] = {}
        self._resolved: dict[Term, ResolvedTerm] = {}
        self._members: dict[Group | Earlier, tuple[tuple[str, ...], Flags, Booleans]] = {}

    def __len__(self) -> int:
        return len(self.trace) - self.skip

    @cached_property
    def is_sure(self) -> bool:
        """Whether nothing in the trace is uncertain."""
        return not self.trace.uncertainty.any()

    @property
    def batch(self) -> FootprintBatch:
        """The trace's footprints, then the regions'.

        If terms need them, the centres of all come next, then what is moved back, each with its centre.
        """
        if not self._has_centres:
            return self._whole
        if self._joined_batch is None:
            self._joined_batch = FootprintBatch.concatenate([self._whole, self._centres, *self._moved])
        return self._joined_batch

    @cached_property
    def _centres(self) -> FootprintBatch:
        return centres_of(self._whole)

    @cached_property
    def _whole(self) -> FootprintBatch:
        regions = [footprint_from_outline(outline) for outline in self.regions.values()]
        if not regions:
            return self.trace.footprints
        heights = [outline.height for outline in self.regions.values()]
        return FootprintBatch.concatenate(
            [self.trace.footprints, FootprintBatch.from_footprints(regions, heights)]
        )

    def signal(self, signal: Signal) -> Floats:
        """Return a signal, (T,), NaN where it is missing."""
        return self._signal(signal)[self.skip :]

    def _signal(self, signal: Signal) -> Floats:
        if isinstance(signal, ReportStep):
            return (
                self._step(signal.terms) if signal.signal is None else self._reports_of(signal.signal).seconds
            )
        if isinstance(signal, PreviousSignal):
            before = self._reports_of(signal.signal).before
            return np.where(before < 0, np.nan, self._signal(signal.signal)[before])
        if isinstance(signal, Present):
            return np.asarray(self._rows_of(signal.term.name) != ABSENT, np.float64)
        if isinstance(signal, ComputedSignal):
            return np.array([computed_signal(signal, sample) for sample in self.trace.samples()], np.float64)
        return self.trace.signals.get(signal.name, np.full(len(self.trace), np.nan))

    def compared_ns(self, rate: Rate) -> tuple[int, int] | None:
        """Return the times of the two reports that a rate compares in the first sample; None if it has none.

        Of several objects, those of the one whose reports are nearest to each other.
        """
        shown: list[TrackedName | Signal] = [rate.signal] if rate.signal else []
        for term in step_of(rate).terms:
            shown += map(TrackedName, self._members_of(term)[0])
        seconds = {name: float(self._reports_of(name).seconds[self.skip]) for name in shown}
        moving = [name for name in shown if not isnan(seconds[name])]
        if not moving:
            return None
        nearest = min(moving, key=seconds.__getitem__)
        times_ns, before = self._reported_ns(nearest), self._reports_of(nearest).before[self.skip]
        return int(times_ns[before]), int(times_ns[self.skip])

    def _reported_ns(self, shown: TrackedName | Signal) -> Integers:
        """Return when each sample's report of an object or a signal was made, (T,) of the whole trace."""
        trace, reported_ns = self.trace, None
        if isinstance(shown, TrackedName):
            if trace.reported_ns is not None and shown.name in self._column:
                reported_ns = trace.reported_ns[:, self._column[shown.name]]
        elif not isinstance(shown, ComputedSignal):
            reported_ns = trace.signals_reported_ns.get(shown.name)
        return trace.times_ns if reported_ns is None else reported_ns

    def _reports_of(self, shown: TrackedName | Signal) -> Reports:
        """Return the reports of an object or a signal in the whole trace."""
        if shown not in self._reports:
            if isinstance(shown, TrackedName):
                is_known = self._rows_of(shown.name) >= 0
            else:
                is_known = is_signal_known(self._signal(shown))
            self._reports[shown] = Reports.of(is_known, self._reported_ns(shown))
        return self._reports[shown]

    def _step(self, terms: tuple[TrackedName | Variable | Group, ...]) -> Floats:
        """Return the shortest time between two reports of some terms, (T,) of the whole trace."""
        if terms not in self._steps:
            shortest = np.full(len(self.trace), np.inf)
            for term in terms:
                is_open = isinstance(term, Group) and term.is_open
                for name, rows in zip(*self._members_of(term), strict=True):
                    seconds = self._reports_of(TrackedName(name)).seconds
                    ignored = (rows == ABSENT) & is_open
                    if name in self.trace.lasting:  # it stands until it has a rate
                        ignored |= (rows >= 0) & np.isnan(seconds)
                    shortest = np.minimum(shortest, np.where(ignored, np.inf, seconds))
            self._steps[terms] = np.where(np.isfinite(shortest), shortest, np.nan)
        return self._steps[terms]

    def resolve(self, term: Term) -> ResolvedTerm:
        """Resolve a term without variables (see `bind`)."""
        if term not in self._resolved:
            self._resolved[term] = self._resolve(term)
        return self._resolved[term]

    def candidates(self, group: Group | Earlier) -> tuple[str, ...]:
        """Return the names of the objects that are ever in an open group."""
        return self.members(group)[0]

    def may_be_unknown(self, group: Group | Earlier) -> bool:
        """Return whether an open group is ever that of a time before the trace."""
        return bool(self.members(group)[2].any())

    def members(self, group: Group | Earlier) -> tuple[tuple[str, ...], Flags, Booleans]:
        """Return the members of an open group.

        Returns:
            Names of all members (M,); their membership (T, M) as 1 or 0; and (T,), whether membership is
            unknown because the group belongs to a time before the trace.
        """
        if group not in self._members:
            self._members[group] = self._find_members(group)
        return self._members[group]

    def _find_members(self, group: Group | Earlier) -> tuple[tuple[str, ...], Flags, Booleans]:
        base = open_group(group)
        _, source = self._base_and_source(group)
        names, rows = self._open_rows(base)
        before = source < 0
        present = (rows != ABSENT)[np.maximum(source, 0)] & ~before[:, None]
        return names, present.astype(np.int8), before

    def _resolve(self, term: Term) -> ResolvedTerm:
        if isinstance(term, Enlarged):
            inner = self.resolve(term.term)
            operand = Operand(inner.operand.rows, inner.operand.enlargement + term.radius)
            return ResolvedTerm(operand, inner.unknown, inner.spread, inner.yaw)
        if isinstance(term, Centre):
            inner, self._has_centres = self.resolve(term.term), True
            rows, whole = inner.operand.rows, len(self._whole)
            # what is moved back has its centre right after it
            centres = np.where(rows < 2 * whole, rows + whole, rows + 1)
            return replace(inner, operand=Operand(np.where(rows < 0, rows, centres)))
        if isinstance(term, Earlier) and term.rate:
            return self._moved_back(term)
        base, source = self._base_and_source(term)
        if isinstance(base, RegionName):
            return self._found_region(base, source < 0)
        at = np.maximum(source, 0) if isinstance(term, Earlier) else slice(self.skip, None)
        if isinstance(base, Group):
            is_open = base.members is None
            rows = (self._open_rows(base)[1] if is_open else self._named_rows(base))[at]
            unknown = (rows < (ABSENT if is_open else 0)).any(axis=1)
        else:
            rows = self._rows_of(base.name)[at, None]
            unknown = rows[:, 0] < 0
        return self._found_rows(rows, unknown | (source < 0))

    def _moved_back(self, term: Earlier) -> ResolvedTerm:
        """Resolve a term as a rate looks back at it."""
        shortest, columns, spreads = self._step(term.rate), [], []
        for name, shown in zip(*self._members_of(term.term), strict=True):
            rows, spread = self._moved_rows(name, shown, shortest)
            columns.append(rows)
            spreads.append(spread)
        if not columns:
            count = len(self)
            empty = Operand(np.empty((count, 0), np.int64))
            return ResolvedTerm(empty, np.zeros(count, np.bool_), np.zeros(count), np.full(count, np.nan))
        rows = np.stack(columns, axis=1)[self.skip :]
        is_open = isinstance(term.term, Group) and term.term.is_open
        unknown = np.asarray((rows < (ABSENT if is_open else 0)).any(axis=1))
        spread = np.stack(spreads, axis=1)[self.skip :].max(axis=1)
        return ResolvedTerm(Operand(rows), unknown, spread, np.full(len(rows), np.nan))

    def _moved_rows(self, name: str, shown: Integers, shortest: Floats) -> tuple[Integers, Floats]:
        """Return an object's row in each sample, moved back by its velocity, and its uncertainty then.

        Args:
            shown: (T,), its row in each sample of the whole trace.
            shortest: (T,), how far to move it back, in seconds.
        """
        before, seconds = self._reports_of(TrackedName(name))
        is_there, stands = shown >= 0, np.isnan(seconds) & (name in self.trace.lasting)
        before_rows = np.where(before < 0, ABSENT, self._rows_of(name)[before])
        rows = np.where(is_there & ~stands, _NO_REPORT, shown)
        uncertainty = np.append(self.trace.uncertainty, 0.0)
        spread = np.where(is_there, uncertainty[np.where(is_there, shown, -1)], 0.0)
        was = is_there & (seconds == shortest)
        rows[was], spread[was] = before_rows[was], uncertainty[before_rows[was]]
        between = np.flatnonzero(is_there & (seconds > shortest))
        if len(between):
            now, then = shown[between], before_rows[between]
            rows[between] = self._add_moved(now, then, shortest[between] / seconds[between])
            spread[between] = np.maximum(uncertainty[now], uncertainty[then])
        return rows, spread

    def _add_moved(self, now: Integers, then: Integers, share: Floats) -> Integers:
        """Move some rows by a share of the way back to others; return their new rows."""
        self._has_centres, self._joined_batch = True, None
        centres = self._centres.vertices
        moved = shifted(self._whole.select(now), (centres[then] - centres[now]) * share[:, None])
        pairs = np.arange(2 * len(now)).reshape(2, -1).T.ravel()
        self._moved.append(FootprintBatch.concatenate([moved, centres_of(moved)]).select(pairs))
        first = 2 * len(self._whole) + self._moved_count
        self._moved_count += 2 * len(now)
        return np.asarray(first + 2 * np.arange(len(now)), np.int64)

    def _members_of(
        self, term: TrackedName | Variable | RegionName | Group
    ) -> tuple[Sequence[str], Integers]:
        """Return the objects of a term, and their rows (N, T) in the whole trace, `ABSENT` if not members."""
        if isinstance(term, Group):
            if term.is_open:
                names, rows = self._open_rows(term)
                return names, rows.T
            return named_members(term), self._named_rows(term).T
        return (term.name,), self._rows_of(term.name)[None]

    def _base_and_source(self, term: _Base | Earlier) -> tuple[_Base, Integers]:
        """Return what a term is about, and the trace's sample each of the scene's looks at (-1: none)."""
        now = np.arange(self.skip, len(self.trace), dtype=np.int64)
        if not isinstance(term, Earlier):
            return term, now
        if term.samples is not None:
            return term.term, np.asarray(np.maximum(now - term.samples, -1), np.int64)
        times = self.trace.times_ns
        wanted = times[self.skip :] - (term.duration_ns or 0)
        return term.term, np.searchsorted(times, wanted, side="right").astype(np.int64) - 1

    def _found_rows(self, rows: Integers, unknown: Booleans) -> ResolvedTerm:
        seen = rows >= 0
        at = np.maximum(rows, 0)
        if len(self.trace.uncertainty) and seen.shape[1]:
            spread = (
                np.zeros(len(rows))
                if self.is_sure
                else np.where(seen, self.trace.uncertainty[at], 0.0).max(axis=1)
            )
            yaw = np.where(seen[:, 0], self.trace.yaw[at[:, 0]], np.nan)
        else:
            spread, yaw = np.zeros(len(rows)), np.full(len(rows), np.nan)
        return ResolvedTerm(Operand(rows), unknown, spread, yaw)

    def _found_region(self, region: RegionName, unknown: Booleans) -> ResolvedTerm:
        row = len(self.trace.footprints) + list(self.regions).index(region.name)
        count = len(self)
        return ResolvedTerm(
            Operand(np.full((count, 1), row, np.int64)), unknown, np.zeros(count), np.full(count, np.nan)
        )

    def _rows_of(self, name: str) -> Integers:
        """Return an object's row in each sample of the whole trace, (T,); `ABSENT` for an unknown object."""
        if name in self._column:
            return self.trace.rows[:, self._column[name]]
        return np.full(len(self.trace), ABSENT, np.int64)

    def _named_rows(self, group: Group) -> Integers:
        columns = [self._rows_of(name) for name in named_members(group)]
        if not columns:
            return np.empty((len(self.trace), 0), np.int64)
        return np.stack(columns, axis=1)

    def _open_rows(self, group: Group) -> tuple[tuple[str, ...], Integers]:
        """Return possible members and their rows over the whole trace, `ABSENT` where not members."""
        left_out = left_out_of(group)
        names = tuple(name for name in self.trace.names if name not in left_out)
        rows = self.trace.rows[:, [self._column[name] for name in names]]
        if group.class_name == ANY_CLASS or not names:
            return names, rows
        wanted = (group.class_name or "").casefold()
        fits = np.array([(name or "").casefold() == wanted for name in self.trace.classes], np.bool_)
        observation = np.where(rows < ABSENT, -2 - rows, np.maximum(rows, 0))
        if len(self.trace.class_code) == 0:
            return names, rows
        is_member = (rows != ABSENT) & fits[self.trace.class_code[observation]]
        ever = is_member.any(axis=0)
        kept = tuple(name for name, is_kept in zip(names, ever.tolist(), strict=True) if is_kept)
        return kept, np.where(is_member, rows, ABSENT)[:, ever]


def footprint_from_outline(outline: Outline) -> Footprint:
    """Return the shape of a region; a polygon that is not convex is decomposed.

    Raises:
        GeometryError: an outline that makes no footprint.
    """
    if len(outline.vertices) == 1 and outline.radius > 0.0:
        (x, y), *_ = outline.vertices
        return Footprint.disc(x, y, outline.radius)
    return Footprint.polygon(outline.vertices)


def open_group(term: Group | Earlier) -> Group:
    """Return the open group that a term denotes, now or earlier."""
    base = term.term if isinstance(term, Earlier) else term
    if not isinstance(base, Group) or base.members is not None:
        raise TypeError(f"{term!r} is not an open group")
    return base


def left_out_of(group: Group) -> frozenset[str]:
    return frozenset(each.name for each in group.excluded)
