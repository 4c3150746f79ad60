"""Find temporary absences of group members near a threshold, because no atom judges an absent member.

An object that a formula tests with `present` is treated like a member.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Flags, Floats, Integers
from spatial_replay.monitor.atoms.measurements import measurement_values
from spatial_replay.monitor.atoms.terms import Reach, TraceScene, tail
from spatial_replay.monitor.stream import Instance
from spatial_replay.spec.format import format_term
from spatial_replay.spec.formula import (
    Atom,
    Centre,
    Earlier,
    Enlarged,
    Group,
    Outline,
    Present,
    SignedDistance,
    Term,
    TrackedName,
    Variable,
)
from spatial_replay.spec.walks import (
    base_of,
    iter_bound,
    iter_expressions,
    iter_parts,
    looks_back,
    substitute,
)
from spatial_replay.text import Instant, Sentence, printable, with_unit
from spatial_replay.trace.trace import ABSENT, Trace

_APPROACH_NS: Final = 1_000_000_000
"""Time before an absence over which the approach is measured, ns."""


_STAND_IN: Final = "\0"
"""A name that no object has; it sorts before all other names."""


@dataclass(frozen=True, slots=True)
class Departure:
    """An absence of a member from its open group, or of an object from the log.

    Attributes:
        name: name of the object.
        start_ns: time of the first sample without the object.
        end_ns: time of the sample in which the object returns.
        distance: distance to the other object of the atom in the last sample before the absence. If the
            object was not near before the absence, it is the distance at `end_ns`.
        message: a sentence.
    """

    name: str
    start_ns: int
    end_ns: int
    distance: float
    message: Sentence


_Visitors: TypeAlias = Group | TrackedName


class _Watch(NamedTuple):
    """A distance between members and a reference, with its threshold.

    Attributes:
        visitors: the open group of the members, or the one object that the formula tests with `present`.
        member, reference: terms of the distance, without enlargements.
        threshold: threshold of the atom plus the enlargements.
    """

    visitors: _Visitors
    member: Term
    reference: Term
    threshold: float

    def distance(self, name: str) -> SignedDistance:
        return SignedDistance(_about(self.member, name), _without(self.reference, name))


class Departures:
    """Collects absences of members that return, block by block.

    An absence is collected if the member was closer than twice the threshold before or after the absence.
    For a threshold of 0, the limit is the member's own size. An absence is also collected if the member
    approached fast enough to reach the threshold during the absence.

    Attributes:
        departures: the departures so far.
    """

    def __init__(self, instances: Iterable[Instance], regions: Mapping[str, Outline], unit: str = "") -> None:
        """Start before the first sample.

        Args:
            instances: instances of one specification.
            unit: unit of lengths; "" if the log declares none.
        """
        self.departures: list[Departure] = []
        self._regions, self._unit = regions, unit
        self._watches: dict[_Visitors, list[_Watch]] = {}
        for watch in dict.fromkeys(watch for instance in instances for watch in _watches_of(instance)):
            self._watches.setdefault(watch.visitors, []).append(watch)
        self._recent_samples: Trace | None = None
        self._open_absences: dict[tuple[_Visitors, str], _Absence] = {}

    def restart(self) -> Departures:
        """Return an empty collection for another log, with the same specification."""
        departures = copy(self)
        departures.departures, departures._recent_samples, departures._open_absences = [], None, {}
        return departures

    def add(self, trace: Trace) -> None:
        """Add the next samples, except samples that only fill a pause."""
        trace = trace.without_filling() if self._watches else trace
        if not self._watches or not len(trace):
            return
        if self._recent_samples is not None:
            trace = Trace.concatenate([self._recent_samples, trace])
        scene = TraceScene(trace, self._regions)
        for visitors in self._watches:
            self._follow(visitors, scene)
        # the last second suffices to measure the approach of the next member that leaves
        self._recent_samples = tail(trace, Reach(1, _APPROACH_NS))

    def _follow(self, visitors: _Visitors, scene: TraceScene) -> None:
        trace, recent_count = scene.trace, 0 if self._recent_samples is None else len(self._recent_samples)
        member_names, memberships = _memberships(visitors, scene)
        # membership cannot change in the first sample of a log
        first_sample = max(recent_count, 1)
        samples, columns = np.nonzero(np.diff(memberships[first_sample - 1 :], axis=0))
        changes = list(zip((samples + first_sample).tolist(), columns.tolist(), strict=True))
        if not changes:
            return
        early_samples = [_early(trace, memberships, *change) for change in changes]
        sample_triples = [
            (early_sample, sample - 1, sample)
            for early_sample, (sample, _) in zip(early_samples, changes, strict=True)
        ]
        member_columns = np.array([trace.names.index(member_names[column]) for _, column in changes])
        distances = self._distances(visitors, member_columns, np.array(sample_triples), trace)
        sizes = _sizes(trace, np.array(sample_triples)[:, 1:], member_columns)
        for (sample, column), triple, member_distances, (last_size, size) in zip(
            changes, sample_triples, distances, sizes.tolist(), strict=True
        ):
            absence_key, times_ns = (visitors, member_names[column]), trace.times_ns[list(triple)].tolist()
            if not memberships[sample, column]:
                reason = _why_absent(visitors, member_names[column], trace, sample)
                early_ns, last_ns, start_ns = times_ns
                self._open_absences[absence_key] = _Absence(
                    reason,
                    early_ns,
                    last_ns,
                    start_ns,
                    member_distances[:, 0],
                    member_distances[:, 1],
                    last_size,
                )
            elif absence_key in self._open_absences:
                self._return(
                    visitors,
                    member_names[column],
                    self._open_absences.pop(absence_key),
                    times_ns[-1],
                    member_distances[:, 2],
                    size,
                )

    def _distances(
        self, visitors: _Visitors, member_columns: Integers, member_samples: Integers, trace: Trace
    ) -> Floats:
        """Return the distances (N, watches, 3) of N members in three samples (N, 3) per member."""
        rows = trace.rows[member_samples.ravel()]
        own_cells = np.arange(len(rows)), np.repeat(member_columns, member_samples.shape[1])
        # a stand-in replaces each member in its samples, so that one call measures all members. This takes
        # 0.4 ms per block; a trace for each departure took 2.2 ms
        rows = np.column_stack([rows[own_cells], rows])
        # a member is removed from its own column, because its group must not contain it
        rows[own_cells[0], own_cells[1] + 1] = ABSENT
        stand_in_trace = replace(
            trace,
            # rows repeat samples in any order, but the times of a trace must increase
            times_ns=np.arange(len(rows), dtype=np.int64),
            names=(_STAND_IN, *trace.names),
            rows=rows,
            signals={},
            reported_ns=None,
            signals_reported_ns={},
        )
        watches = self._watches[visitors]
        distances, _ = measurement_values(
            TraceScene(stand_in_trace, self._regions), [watch.distance(_STAND_IN) for watch in watches]
        )
        by_member: Floats = distances.reshape(len(watches), *member_samples.shape).swapaxes(0, 1)
        return by_member

    def _return(
        self,
        visitors: _Visitors,
        name: str,
        absence: _Absence,
        end_ns: int,
        distances: Floats,
        return_size: float,
    ) -> None:
        """Add the departure of a member that has returned, if it was near a threshold."""
        # a member of a single sample has no approach; 1 avoids a division by zero
        span_ns = max(absence.last_ns - absence.early_ns, 1)
        # an empty group is infinitely far away: inf - inf is NaN, which counts as no approach
        with np.errstate(invalid="ignore"):
            approaches = (
                (absence.early_distances - absence.last_distances) / span_ns * (end_ns - absence.last_ns)
            )
        for watch, approach, last_distance, return_distance in zip(
            self._watches[visitors],
            approaches.tolist(),
            absence.last_distances.tolist(),
            distances.tolist(),
            strict=True,
        ):
            was_near = last_distance - watch.threshold < max(watch.threshold or absence.last_size, approach)
            if was_near or return_distance - watch.threshold < (watch.threshold or return_size):
                start_time, end_time = Instant(absence.start_ns, 0), Instant(end_ns, 0)
                distance, side = (last_distance, "before") if was_near else (return_distance, "after")
                distance_text = f"it was {with_unit(distance, self._unit)} away {side}"
                text = f"; {distance_text}, from {format_term(_without(watch.reference, name))}"
                message = Sentence(absence.reason, " from ", start_time, " to ", end_time, text)
                self.departures.append(Departure(name, absence.start_ns, end_ns, distance, message))
                return


class _Absence(NamedTuple):
    """An absence that has not ended.

    Attributes:
        reason: beginning of the sentence about the absence.
        early_ns: time of the member's first sample within the second that ends at `last_ns`.
        last_ns: time of the last sample with the member.
        start_ns: time of the first sample without the member.
        early_distances, last_distances: (watches,), distances at `early_ns` and `last_ns`.
        last_size: size of the member at `last_ns`.
    """

    reason: str
    early_ns: int
    last_ns: int
    start_ns: int
    early_distances: Floats
    last_distances: Floats
    last_size: float


def _early(trace: Trace, memberships: Flags, sample: int, column: int) -> int:
    """Return the first sample with a member within the second that ends at `sample` - 1."""
    first_sample = int(np.searchsorted(trace.times_ns[:sample], trace.times_ns[sample - 1] - _APPROACH_NS))
    return first_sample + int(memberships[first_sample:sample, column].argmax())


def _sizes(trace: Trace, samples: Integers, columns: Integers) -> Floats:
    """Return the sizes (N, K) of N objects in K samples per object; 0 if unknown."""
    rows = trace.rows[samples, columns[:, None]]
    sizes = np.zeros(rows.shape)
    sizes[rows >= 0] = trace.footprints.select(rows[rows >= 0]).sizes
    return sizes


def _memberships(visitors: _Visitors, scene: TraceScene) -> tuple[Sequence[str], Flags]:
    """Return the names (M,) of all members, and their membership (T, M) in each sample, 1 or 0."""
    if isinstance(visitors, Group):
        names, memberships, _ = scene.members(visitors)
        return names, memberships
    trace = scene.trace
    # empty until the object appears
    names = tuple(name for name in trace.names if name == visitors.name)
    columns = [trace.names.index(name) for name in names]
    return names, (trace.rows[:, columns] != ABSENT).astype(np.int8)


def _why_absent(visitors: _Visitors, name: str, trace: Trace, sample: int) -> str:
    """Return the reason of an absence as the beginning of a sentence."""
    row = int(trace.rows[sample, trace.names.index(name)])
    if row == ABSENT or isinstance(visitors, TrackedName):
        return f"{printable(name)} was not in the log"
    class_name = trace.classes[trace.class_code[row if row >= 0 else -2 - row]]
    class_text = f" but {printable(class_name)!r}" if class_name else ""
    return f"{printable(name)} was not of the class {printable(visitors.class_name or '')!r}{class_text}"


def _watches_of(instance: Instance) -> Iterator[_Watch]:
    formula = substitute(instance.formula, instance.bindings)
    present_terms = {part.term for part in iter_parts(formula) if isinstance(part, Present)}
    for node, quantifiers in iter_bound(formula):
        distances = list(_distances_of(node)) if isinstance(node, Atom) else []
        # an atom with several distances has no threshold for a single distance
        if not isinstance(node, Atom) or len(distances) != 1:
            continue
        groups = {variable: scope.group for scope in quantifiers for variable in scope.variables}
        distance_terms = distances[0].first, distances[0].second
        limits = (abs(limit) for limit in node.parameters if isinstance(limit, float))
        # enlarged terms touch at the sum of their radii
        threshold = max(limits, default=0.0) + sum(map(_enlargement, distance_terms))
        first_term, second_term = (_with_group(_without_enlargement(term), groups) for term in distance_terms)
        for member, reference in ((first_term, second_term), (second_term, first_term)):
            visitors = base_of(member)
            is_now = not looks_back(member) and not looks_back(reference)
            is_bound = not isinstance(base_of(reference), Variable)
            may_leave = visitors.is_open if isinstance(visitors, Group) else visitors in present_terms
            if isinstance(visitors, Group | TrackedName) and may_leave and is_now and is_bound:
                yield _Watch(visitors, member, reference, threshold)


def _distances_of(atom: Atom) -> Iterator[SignedDistance]:
    parts = iter_expressions(atom.expression)
    return (part for part in dict.fromkeys(parts) if isinstance(part, SignedDistance))


def _enlargement(term: Term) -> float:
    return term.radius + _enlargement(term.term) if isinstance(term, Enlarged) else 0.0


def _without_enlargement(term: Term) -> Term:
    return _without_enlargement(term.term) if isinstance(term, Enlarged) else term


def _with_base(term: Term, change: Callable[[Term], Term]) -> Term:
    """Apply `change` to a term, or to the term inside a `Centre`."""
    if isinstance(term, Centre):
        inner_term: Any = _with_base(term.term, change)
        return replace(term, term=inner_term)
    return change(term)


def _with_group(term: Term, groups: Mapping[str, Group | Earlier]) -> Term:
    """Replace the variable of a term by its group, which excludes only objects given by name."""

    def change(base: Term) -> Term:
        group = groups.get(base.name, base) if isinstance(base, Variable) else base
        if not isinstance(group, Group):
            return base
        excluded = tuple(member for member in group.excluded if isinstance(member, TrackedName))
        return replace(group, excluded=excluded)

    return _with_base(term, change)


def _about(term: Term, name: str) -> Term:
    """Return a term with its open group replaced by one member."""
    return _with_base(term, lambda _: TrackedName(name))


def _without(term: Term, name: str) -> Term:
    """Return a term whose open group excludes an object."""

    def change(base: Term) -> Term:
        if not isinstance(base, Group) or not base.is_open:
            return base
        return replace(base, excluded=(*base.excluded, TrackedName(name)))

    return _with_base(term, change)
