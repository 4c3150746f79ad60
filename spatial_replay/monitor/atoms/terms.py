"""Terms in a trace: footprints, uncertainty, where they are unknown, and how far they look back (`a[-3]`)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Flags, Floats, Integers
from spatial_replay.geometry.footprint import Footprint, FootprintBatch, centres_of
from spatial_replay.geometry.measure import Operand
from spatial_replay.spec.formula import (
    ANY_CLASS,
    STEP,
    Centre,
    ComputedSignal,
    Earlier,
    Enlarged,
    Formula,
    Group,
    Outline,
    Present,
    PreviousSignal,
    RegionName,
    Signal,
    Term,
    TrackedName,
    Variable,
)
from spatial_replay.spec.relations import computed_signal
from spatial_replay.spec.walks import has_rate, iter_terms, named_members, standing
from spatial_replay.trace.trace import ABSENT, Sample, Trace


class Delay(NamedTuple):
    """How far a term looks back: some samples, or to the last sample at least some ns earlier."""

    samples: int | None
    duration_ns: int | None

    @classmethod
    def of(cls, term: Earlier) -> Delay:
        return cls(term.samples, term.duration_ns)


NO_DELAY = Delay(0, None)
PREVIOUS = Delay(1, None)


def iter_delays(formulas: Sequence[Formula]) -> Iterator[Delay]:
    """Iterate over the delays of the terms in some formulas that look back."""
    for term in map(standing, iter_terms(formulas)):
        if isinstance(term, Earlier):
            yield Delay.of(term)
    # rates also look at the time of the sample before, and at its signals
    if any(map(has_rate, formulas)):
        yield PREVIOUS


def look_back(formulas: Sequence[Formula]) -> tuple[int, int]:
    """Return how far terms look back: the most samples (`a[-3]`), the longest duration in ns (`a[-2s]`)."""
    delays = list(iter_delays(formulas))
    samples = max((delay.samples or 0 for delay in delays), default=0)
    duration_ns = max((delay.duration_ns or 0 for delay in delays), default=0)
    return samples, duration_ns


def tail(trace: Trace, samples: int, duration_ns: int) -> Trace:
    """Return the last samples of a trace that the next one may look back at (see `look_back`)."""
    begin = len(trace) - samples
    if duration_ns:
        # the next sample is later than the newest, so it needs nothing before what the newest looks back at
        latest_ns = trace.times_ns[-1] - duration_ns
        begin = min(begin, int(np.searchsorted(trace.times_ns, latest_ns, side="right")) - 1)
    return trace.slice(max(begin, 0), len(trace))


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
    if delay == NO_DELAY:
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
        """The trace's footprints, after them the regions'; with a `Centre` resolved, the centres of all."""
        return self._with_centres if self._has_centres else self._whole

    @cached_property
    def _with_centres(self) -> FootprintBatch:
        return FootprintBatch.concatenate([self._whole, centres_of(self._whole)])

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
        times_ns = self.trace.times_ns
        if signal == STEP:
            return np.append(np.nan, np.diff(times_ns) / 1e9)[: len(times_ns)]
        if isinstance(signal, PreviousSignal):
            return np.append(np.nan, self._signal(signal.of))[:-1]
        if isinstance(signal, Present):
            return np.asarray(self._rows_of(signal.term.name) != ABSENT, np.float64)
        if isinstance(signal, ComputedSignal):
            return np.array([computed_signal(signal, sample) for sample in self.trace.samples()], np.float64)
        return self.trace.signals.get(signal.name, np.full(len(times_ns), np.nan))

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
            rows = inner.operand.rows
            return replace(inner, operand=Operand(np.where(rows < 0, rows, rows + len(self._whole))))
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
