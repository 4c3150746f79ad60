"""Terms in a trace: footprints, uncertainty, unknown samples, and delays (`a[-3]`).

A rate looks back at reports (see `reports`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import isnan
from typing import NamedTuple, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Flags, Floats, Integers
from spatial_replay.geometry.footprint import (
    Footprint,
    FootprintBatch,
    centres_of,
    shift_rows,
)
from spatial_replay.geometry.measure import Operand
from spatial_replay.monitor.atoms.reports import Reports, before_last_reports, is_signal_known, left_out_of
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
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
from spatial_replay.spec.walks import (
    base_of,
    has_rate,
    iter_formulas,
    iter_terms,
    named_members,
    standing,
    step_of,
)
from spatial_replay.trace.trace import ABSENT, Sample, Trace


class Delay(NamedTuple):
    """The delay of a term, in samples or in ns. Both are None for a delay to the previous report."""

    samples: int | None
    duration_ns: int | None

    @classmethod
    def of(cls, term: Earlier) -> Delay:
        return cls(term.samples, term.duration_ns)


NO_DELAY = Delay(0, None)
TO_REPORTS = Delay(None, None)


def iter_delays(formulas: Sequence[Formula]) -> Iterator[Delay]:
    """Iterate over the delays of all terms in formulas that look back."""
    for term in map(standing, iter_terms(formulas)):
        if isinstance(term, Earlier):
            yield Delay.of(term)
    if any(map(has_rate, formulas)):
        yield TO_REPORTS


class Reach(NamedTuple):
    """The largest delays of terms: in samples (`a[-3]`), in ns (`a[-2s]`), and to reports (`speed(a)`)."""

    samples: int
    duration_ns: int
    to_reports: bool = False

    def __bool__(self) -> bool:
        return any(tuple(self))


def look_back(formulas: Sequence[Formula]) -> Reach:
    """Return the largest delays of the terms in formulas."""
    delays = list(iter_delays(formulas))
    samples = max((delay.samples or 0 for delay in delays), default=0)
    duration_ns = max((delay.duration_ns or 0 for delay in delays), default=0)
    return Reach(samples, duration_ns, TO_REPORTS in delays)


def tail(trace: Trace, reach: Reach) -> Trace:
    """Return the samples of a trace that the next sample may look back at (see `look_back`)."""
    first_sample = len(trace) - max(reach.samples, reach.to_reports)
    if reach.duration_ns:
        # the next sample is later than the newest sample, so it cannot look back further
        latest_ns = trace.times_ns[-1] - reach.duration_ns
        first_sample = min(first_sample, int(np.searchsorted(trace.times_ns, latest_ns, side="right")) - 1)
    recent_samples = np.arange(max(first_sample, 0), len(trace))
    if reach.to_reports:
        recent_samples = np.union1d(before_last_reports(trace), recent_samples)
    return trace.take(recent_samples)


class RecentSamples:
    """The samples at given delays before the newest sample. Older samples are dropped."""

    def __init__(self, delays: Iterable[Delay]) -> None:
        self._queues: list[tuple[Delay, deque[Sample]]] = [(delay, deque()) for delay in delays]
        self._is_newest_only = [delay for delay, _ in self._queues] == [NO_DELAY]

    def add(self, sample: Sample) -> list[Sample | None]:
        """Add the next sample. Return the sample at each delay; None for a delay beyond the first sample."""
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


_NO_REPORT = ABSENT - 1
"""Row number of an object that is present, but has no earlier report."""

Bindings = Mapping[str, TrackedName]
"""Objects by the names of variables."""


@dataclass(frozen=True)
class ResolvedTerm:
    """A term over the samples of a scene.

    Attributes:
        operand: footprints of the term.
        unknown: (T,), whether the term is unknown.
        spread: (T,), uncertainty; for a group, the largest uncertainty of its members.
        yaw: (T,), orientation, radians; NaN without orientation.
    """

    operand: Operand
    unknown: Booleans
    spread: Floats
    yaw: Floats


_Base: TypeAlias = TrackedName | Variable | RegionName | Group


class TraceScene:
    """The samples of a trace from `skip` on, and the regions of a specification.

    Terms may look back (`a[-3]`) at samples before `skip`.
    """

    def __init__(self, trace: Trace, regions: Mapping[str, Outline], skip: int = 0) -> None:
        self.trace = trace
        self.regions = regions
        self.skip = skip
        self._column_of_name = {name: index for index, name in enumerate(trace.names)}
        self._has_centres = False
        self._moved_batches: list[FootprintBatch] = []
        self._joined_batch: FootprintBatch | None = None
        self._moved_row_count = 0
        self._reports: dict[TrackedName | Signal, Reports] = {}
        self._step_seconds: dict[tuple[TrackedName | Variable | Group, ...], Floats] = {}
        self._resolved_terms: dict[Term, ResolvedTerm] = {}
        self._members: dict[Group | Earlier, tuple[tuple[str, ...], Flags, Booleans]] = {}

    def __len__(self) -> int:
        return len(self.trace) - self.skip

    @cached_property
    def is_sure(self) -> bool:
        """Whether the trace has no uncertainty."""
        return not self.trace.uncertainty.any()

    @property
    def batch(self) -> FootprintBatch:
        """Footprints of the trace, then footprints of the regions.

        If terms need centres, the centres of these footprints follow. Moved footprints come last, each before
        its centre.
        """
        if not self._has_centres:
            return self._base_batch
        if self._joined_batch is None:
            self._joined_batch = FootprintBatch.concatenate(
                [self._base_batch, self._centres, *self._moved_batches]
            )
        return self._joined_batch

    @cached_property
    def _centres(self) -> FootprintBatch:
        return centres_of(self._base_batch)

    @cached_property
    def _base_batch(self) -> FootprintBatch:
        regions = [footprint_from_outline(outline) for outline in self.regions.values()]
        if not regions:
            return self.trace.footprints
        heights = [outline.height for outline in self.regions.values()]
        return FootprintBatch.concatenate(
            [self.trace.footprints, FootprintBatch.from_footprints(regions, heights)]
        )

    def signal(self, signal: Signal) -> Floats:
        """Return the values of a signal, (T,); NaN where it is missing."""
        return self._signal(signal)[self.skip :]

    def _signal(self, signal: Signal) -> Floats:
        if isinstance(signal, ReportStep):
            return (
                self._step(signal.terms) if signal.signal is None else self._reports_of(signal.signal).seconds
            )
        if isinstance(signal, PreviousSignal):
            previous_samples = self._reports_of(signal.signal).before
            return np.where(previous_samples < 0, np.nan, self._signal(signal.signal)[previous_samples])
        if isinstance(signal, Present):
            return np.asarray(self._rows_of(signal.term.name) != ABSENT, np.float64)
        if isinstance(signal, ComputedSignal):
            return np.array([computed_signal(signal, sample) for sample in self.trace.samples()], np.float64)
        return self.trace.signals.get(signal.name, np.full(len(self.trace), np.nan))

    def compared_ns(self, rate: Rate) -> tuple[int, int] | None:
        """Return the times of the two reports that a rate compares in the first sample.

        For several objects, the pair with the shortest time between reports is returned. The result is None
        if the rate has no value.
        """
        sources: list[TrackedName | Signal] = [rate.signal] if rate.signal else []
        for term in step_of(rate).terms:
            sources += map(TrackedName, self._members_of(term)[0])
        step_seconds = {name: float(self._reports_of(name).seconds[self.skip]) for name in sources}
        compared_sources = [name for name in sources if not isnan(step_seconds[name])]
        if not compared_sources:
            return None
        fastest_source = min(compared_sources, key=step_seconds.__getitem__)
        times_ns, previous_sample = (
            self._reported_ns(fastest_source),
            self._reports_of(fastest_source).before[self.skip],
        )
        return int(times_ns[previous_sample]), int(times_ns[self.skip])

    def _reported_ns(self, source: TrackedName | Signal) -> Integers:
        """Return the report times of an object or a signal in each sample, (T,) of the whole trace."""
        trace, reported_ns = self.trace, None
        if isinstance(source, TrackedName):
            if trace.reported_ns is not None and source.name in self._column_of_name:
                reported_ns = trace.reported_ns[:, self._column_of_name[source.name]]
        elif not isinstance(source, ComputedSignal):
            reported_ns = trace.signals_reported_ns.get(source.name)
        return trace.times_ns if reported_ns is None else reported_ns

    def _reports_of(self, source: TrackedName | Signal) -> Reports:
        """Return the reports of an object or a signal in the whole trace."""
        if source not in self._reports:
            if isinstance(source, TrackedName):
                is_known = self._rows_of(source.name) >= 0
            else:
                is_known = is_signal_known(self._signal(source))
            self._reports[source] = Reports.of(is_known, self._reported_ns(source))
        return self._reports[source]

    def _step(self, terms: tuple[TrackedName | Variable | Group, ...]) -> Floats:
        """Return the shortest time between the last two reports of the terms' objects, (T,), seconds."""
        if terms not in self._step_seconds:
            shortest_s = np.full(len(self.trace), np.inf)
            for term in terms:
                is_open = isinstance(term, Group) and term.is_open
                for name, rows in zip(*self._members_of(term), strict=True):
                    seconds = self._reports_of(TrackedName(name)).seconds
                    is_ignored = (rows == ABSENT) & is_open
                    if (
                        name in self.trace.lasting
                    ):  # an object that lasts stands still until it has two reports
                        is_ignored |= (rows >= 0) & np.isnan(seconds)
                    shortest_s = np.minimum(shortest_s, np.where(is_ignored, np.inf, seconds))
            self._step_seconds[terms] = np.where(np.isfinite(shortest_s), shortest_s, np.nan)
        return self._step_seconds[terms]

    def resolve(self, term: Term) -> ResolvedTerm:
        """Resolve a term without variables."""
        if term not in self._resolved_terms:
            self._resolved_terms[term] = self._resolve(term)
        return self._resolved_terms[term]

    def candidates(self, group: Group | Earlier) -> tuple[str, ...]:
        """Return the names of all objects that are ever in an open group."""
        return self.members(group)[0]

    def may_be_unknown(self, group: Group | Earlier) -> bool:
        """Return whether an open group ever looks back to a time before the trace."""
        return bool(self.members(group)[2].any())

    def members(self, group: Group | Earlier) -> tuple[tuple[str, ...], Flags, Booleans]:
        """Return the members of an open group.

        Returns:
            the names of all members (M,), their membership (T, M) as 1 or 0, and whether the membership is
            unknown (T,). It is unknown if the group looks back to a time before the trace.
        """
        if group not in self._members:
            self._members[group] = self._find_members(group)
        return self._members[group]

    def _find_members(self, group: Group | Earlier) -> tuple[tuple[str, ...], Flags, Booleans]:
        group_now = open_group(group)
        _, source_samples = self._base_and_source(group)
        names, rows = self._open_rows(group_now)
        is_before_start = source_samples < 0
        is_member = (rows != ABSENT)[np.maximum(source_samples, 0)] & ~is_before_start[:, None]
        return names, is_member.astype(np.int8), is_before_start

    def _resolve(self, term: Term) -> ResolvedTerm:
        if isinstance(term, Enlarged):
            inner_term = self.resolve(term.term)
            operand = Operand(inner_term.operand.rows, inner_term.operand.enlargement + term.radius)
            return ResolvedTerm(operand, inner_term.unknown, inner_term.spread, inner_term.yaw)
        if isinstance(term, Centre):
            inner_term, self._has_centres = self.resolve(term.term), True
            rows, row_count = inner_term.operand.rows, len(self._base_batch)
            # the row of a moved footprint precedes the row of its centre
            centres = np.where(rows < 2 * row_count, rows + row_count, rows + 1)
            return replace(inner_term, operand=Operand(np.where(rows < 0, rows, centres)))
        if isinstance(term, Earlier) and term.rate:
            return self._moved_back(term)
        base, source_samples = self._base_and_source(term)
        if isinstance(base, RegionName):
            return self._resolve_region(base, source_samples < 0)
        samples = np.maximum(source_samples, 0) if isinstance(term, Earlier) else slice(self.skip, None)
        if isinstance(base, Group):
            is_open = base.members is None
            rows = (self._open_rows(base)[1] if is_open else self._named_rows(base))[samples]
            # an absent object is no member of an open group, but makes a named group unknown
            is_unknown = (rows < (ABSENT if is_open else 0)).any(axis=1)
        else:
            rows = self._rows_of(base.name)[samples, None]
            is_unknown = rows[:, 0] < 0
        return self._resolve_rows(rows, is_unknown | (source_samples < 0))

    def _moved_back(self, term: Earlier) -> ResolvedTerm:
        """Resolve a term at the time of the earlier report that a rate compares."""
        shortest_s, row_columns, spreads = self._step(term.rate), [], []
        for name, current_rows in zip(*self._members_of(term.term), strict=True):
            rows, spread = self._moved_rows(name, current_rows, shortest_s)
            row_columns.append(rows)
            spreads.append(spread)
        if not row_columns:
            sample_count = len(self)
            no_operand = Operand(np.empty((sample_count, 0), np.int64))
            return ResolvedTerm(
                no_operand,
                np.zeros(sample_count, np.bool_),
                np.zeros(sample_count),
                np.full(sample_count, np.nan),
            )
        rows = np.stack(row_columns, axis=1)[self.skip :]
        is_open = isinstance(term.term, Group) and term.term.is_open
        is_unknown = np.asarray((rows < (ABSENT if is_open else 0)).any(axis=1))
        spread = np.stack(spreads, axis=1)[self.skip :].max(axis=1)
        return ResolvedTerm(Operand(rows), is_unknown, spread, np.full(len(rows), np.nan))

    def _moved_rows(self, name: str, current_rows: Integers, shortest_s: Floats) -> tuple[Integers, Floats]:
        """Return the rows of an object moved back by its velocity, and their uncertainty.

        Args:
            current_rows: (T,), row of the object in each sample of the whole trace.
            shortest_s: (T,), time by which the object is moved back, s.
        """
        previous_samples, seconds = self._reports_of(TrackedName(name))
        is_present, is_standing = current_rows >= 0, np.isnan(seconds) & (name in self.trace.lasting)
        previous_rows = np.where(previous_samples < 0, ABSENT, self._rows_of(name)[previous_samples])
        # without an earlier report, the object is unknown
        rows = np.where(is_present & ~is_standing, _NO_REPORT, current_rows)
        # row -1, for samples without the object, is the row of the appended 0
        uncertainty = np.append(self.trace.uncertainty, 0.0)
        spread = np.where(is_present, uncertainty[np.where(is_present, current_rows, -1)], 0.0)
        is_previous = is_present & (seconds == shortest_s)
        # the earlier report itself, so that a replay and a live run give identical bits
        rows[is_previous], spread[is_previous] = (
            previous_rows[is_previous],
            uncertainty[previous_rows[is_previous]],
        )
        between_samples = np.flatnonzero(is_present & (seconds > shortest_s))
        if len(between_samples):
            newer_rows, older_rows = current_rows[between_samples], previous_rows[between_samples]
            rows[between_samples] = self._add_moved_rows(
                newer_rows, older_rows, shortest_s[between_samples] / seconds[between_samples]
            )
            # the uncertainty between two reports is the greater uncertainty
            spread[between_samples] = np.maximum(uncertainty[newer_rows], uncertainty[older_rows])
        return rows, spread

    def _add_moved_rows(self, newer_rows: Integers, older_rows: Integers, fractions: Floats) -> Integers:
        """Add newer rows, moved by a fraction of the way to older rows. Return the new row numbers."""
        # the joined batch has to include the new rows
        self._has_centres, self._joined_batch = True, None
        centres = self._centres.vertices
        moved_batch = shift_rows(
            self._base_batch.select(newer_rows),
            (centres[older_rows] - centres[newer_rows]) * fractions[:, None],
        )
        # interleaves the moved rows with their centres
        row_order = np.arange(2 * len(newer_rows)).reshape(2, -1).T.ravel()
        self._moved_batches.append(
            FootprintBatch.concatenate([moved_batch, centres_of(moved_batch)]).select(row_order)
        )
        first_row = 2 * len(self._base_batch) + self._moved_row_count
        self._moved_row_count += 2 * len(newer_rows)
        return np.asarray(first_row + 2 * np.arange(len(newer_rows)), np.int64)

    def _members_of(
        self, term: TrackedName | Variable | RegionName | Group
    ) -> tuple[Sequence[str], Integers]:
        """Return the objects of a term and their rows (N, T) in the whole trace, `ABSENT` for non-members."""
        if isinstance(term, Group):
            if term.is_open:
                names, rows = self._open_rows(term)
                return names, rows.T
            return named_members(term), self._named_rows(term).T
        return (term.name,), self._rows_of(term.name)[None]

    def _base_and_source(self, term: _Base | Earlier) -> tuple[_Base, Integers]:
        """Return the base of a term, and the sample that the term reads at each sample; -1 for no sample."""
        samples = np.arange(self.skip, len(self.trace), dtype=np.int64)
        if not isinstance(term, Earlier):
            return term, samples
        if term.samples is not None:
            return term.term, np.asarray(np.maximum(samples - term.samples, -1), np.int64)
        times_ns = self.trace.times_ns
        source_times_ns = times_ns[self.skip :] - (term.duration_ns or 0)
        return term.term, np.searchsorted(times_ns, source_times_ns, side="right").astype(np.int64) - 1

    def _resolve_rows(self, rows: Integers, is_unknown: Booleans) -> ResolvedTerm:
        is_present = rows >= 0
        safe_rows = np.maximum(rows, 0)
        if len(self.trace.uncertainty) and is_present.shape[1]:
            spread = (
                np.zeros(len(rows))
                if self.is_sure
                else np.where(is_present, self.trace.uncertainty[safe_rows], 0.0).max(axis=1)
            )
            yaw = np.where(is_present[:, 0], self.trace.yaw[safe_rows[:, 0]], np.nan)
        else:
            spread, yaw = np.zeros(len(rows)), np.full(len(rows), np.nan)
        return ResolvedTerm(Operand(rows), is_unknown, spread, yaw)

    def _resolve_region(self, region: RegionName, is_unknown: Booleans) -> ResolvedTerm:
        row = len(self.trace.footprints) + list(self.regions).index(region.name)
        sample_count = len(self)
        return ResolvedTerm(
            Operand(np.full((sample_count, 1), row, np.int64)),
            is_unknown,
            np.zeros(sample_count),
            np.full(sample_count, np.nan),
        )

    def _rows_of(self, name: str) -> Integers:
        """Return an object's row in each sample of the whole trace, (T,); `ABSENT` for an unknown name."""
        if name in self._column_of_name:
            return self.trace.rows[:, self._column_of_name[name]]
        return np.full(len(self.trace), ABSENT, np.int64)

    def _named_rows(self, group: Group) -> Integers:
        columns = [self._rows_of(name) for name in named_members(group)]
        if not columns:
            return np.empty((len(self.trace), 0), np.int64)
        return np.stack(columns, axis=1)

    def _open_rows(self, group: Group) -> tuple[tuple[str, ...], Integers]:
        """Return possible members and their rows in the whole trace, `ABSENT` for non-members."""
        excluded_names = left_out_of(group)
        names = tuple(name for name in self.trace.names if name not in excluded_names)
        rows = self.trace.rows[:, [self._column_of_name[name] for name in names]]
        if group.class_name == ANY_CLASS or not names:
            return names, rows
        group_class = (group.class_name or "").casefold()
        is_fitting_class = np.array(
            [(name or "").casefold() == group_class for name in self.trace.classes], np.bool_
        )
        # a row below `ABSENT` stands for observation -2 - row, an object with unknown position
        observation = np.where(rows < ABSENT, -2 - rows, np.maximum(rows, 0))
        if len(self.trace.class_code) == 0:
            return names, rows
        is_member = (rows != ABSENT) & is_fitting_class[self.trace.class_code[observation]]
        is_ever_member = is_member.any(axis=0)
        member_names = tuple(
            name for name, is_ever in zip(names, is_ever_member.tolist(), strict=True) if is_ever
        )
        return member_names, np.where(is_member, rows, ABSENT)[:, is_ever_member]


def footprint_from_outline(outline: Outline) -> Footprint:
    """Return the footprint of a region. A concave polygon is decomposed.

    Raises:
        GeometryError: the outline is not a valid footprint.
    """
    if len(outline.vertices) == 1 and outline.radius > 0.0:
        (x, y), *_ = outline.vertices
        return Footprint.disc(x, y, outline.radius)
    return Footprint.polygon(outline.vertices)


def seam_texts(formulas: Iterable[Formula], regions: Mapping[str, Outline]) -> list[str]:
    """Return a sentence for each region in `enclosedin` that has several convex parts."""
    atoms = (part for formula in formulas for part in iter_formulas(formula) if isinstance(part, Atom))
    names = dict.fromkeys(
        getattr(base_of(atom.terms[1]), "name", "") for atom in atoms if atom.relation == "enclosedin"
    )
    return [
        f"{name} is cut into parts; an object across their seam counts as outside"
        for name in names
        if name in regions and len(footprint_from_outline(regions[name]).parts) > 1
    ]


def open_group(term: Group | Earlier) -> Group:
    """Return the open group that a term denotes, now or earlier."""
    base = term.term if isinstance(term, Earlier) else term
    if not isinstance(base, Group) or base.members is not None:
        raise TypeError(f"{term!r} is not an open group")
    return base
