"""Members of open groups that leave a log within reach of a threshold and come back: nothing judged them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.monitor.atoms.measurements import measured
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
    SignedDistance,
    Term,
    TrackedName,
    Variable,
)
from spatial_replay.spec.walks import base_of, iter_bound, iter_expressions, looks_back, substitute
from spatial_replay.text import Instant, Sentence, printable, with_unit
from spatial_replay.trace.trace import ABSENT, Trace

_APPROACH_NS: Final = 1_000_000_000
"""The approach of an object is its change of distance over so long before it leaves."""


@dataclass(frozen=True, slots=True)
class Departure:
    """An absence of a member from its open group.

    Attributes:
        name: of the object.
        start_ns, end_ns: the first sample without it, and the sample in which it is a member again.
        distance: from the object that its atom compares it with, in the sample before `start_ns`.
        message: a sentence.
    """

    name: str
    start_ns: int
    end_ns: int
    distance: float
    message: Sentence


class _Watch(NamedTuple):
    """The distance of the members of an open group from something, with its threshold."""

    group: Group
    member: Term
    other: Term
    threshold: float

    def distance(self, name: str) -> SignedDistance:
        return SignedDistance(_about(self.member, name), _without(self.other, name))


class Departures:
    """Members of open groups that leave and come back, collected block by block.

    A member counts if it was less than twice the threshold away before or after, or approached fast enough to
    reach the threshold meanwhile.

    Attributes:
        departures: the ones so far.
    """

    def __init__(self, instances: Iterable[Instance], regions: Mapping[str, Outline], unit: str = "") -> None:
        """Start before the first sample.

        Args:
            instances: the formulas of one specification.
            unit: of lengths; "" where the log declares none.
        """
        self.departures: list[Departure] = []
        self._regions, self._unit = regions, unit
        self._watches: dict[Group, list[_Watch]] = {}
        for watch in dict.fromkeys(watch for instance in instances for watch in _watches_of(instance)):
            self._watches.setdefault(watch.group, []).append(watch)
        self._past: Trace | None = None
        self._absent: dict[tuple[Group, str], Trace] = {}

    def add(self, trace: Trace) -> None:
        """Add the next samples; the ones that fill a pause do not count."""
        trace = trace.without_filling() if self._watches else trace
        if not self._watches or not len(trace):
            return
        if self._past is not None:
            trace = Trace.concatenate([self._past, trace])
        scene = TraceScene(trace, self._regions)
        for group in self._watches:
            self._follow(group, scene)
        self._past = tail(trace, Reach(1, _APPROACH_NS))

    def _follow(self, group: Group, scene: TraceScene) -> None:
        trace, first = scene.trace, 0 if self._past is None else len(self._past)
        names, members, _ = scene.members(group)
        turns = np.diff(members[max(first - 1, 0) :], axis=0)
        samples, columns = np.nonzero(turns)
        for sample, column in zip((samples + max(first, 1)).tolist(), columns.tolist(), strict=True):
            key = group, names[column]
            if not members[sample, column]:
                early_ns = trace.times_ns[sample - 1] - _APPROACH_NS
                early = int(np.searchsorted(trace.times_ns[:sample], early_ns))
                early += int(members[early:sample, column].argmax())
                # the first sample without it is the last of these
                before = [early, sample - 1, sample] if early < sample - 1 else [sample - 1, sample]
                self._absent[key] = trace.take(np.array(before, np.int64))
            elif key in self._absent:
                self._return(group, names[column], self._absent.pop(key), trace.slice(sample, sample + 1))

    def _return(self, group: Group, name: str, before: Trace, after: Trace) -> None:
        watches = self._watches[group]
        scene = TraceScene(Trace.concatenate([before, after]), self._regions)
        distances, _ = measured(scene, [watch.distance(name) for watch in watches])
        start_ns, end_ns = int(before.times_ns[-1]), int(after.times_ns[0])
        for watch, (*early, last, _, returned) in zip(watches, distances.tolist(), strict=True):
            approach = 0.0
            if early:
                span_ns = int(before.times_ns[1] - before.times_ns[0])
                approach = (early[0] - last) / span_ns * (end_ns - int(before.times_ns[-2]))
            reach = max(watch.threshold, approach)
            if last - watch.threshold < reach or returned - watch.threshold < watch.threshold:
                why = self._absence(group, name, before)
                away = with_unit(last, self._unit)
                text = f"; it was {away} away before, from {format_term(_without(watch.other, name))}"
                message = Sentence(why, " from ", Instant(start_ns, 0), " to ", Instant(end_ns, 0), text)
                self.departures.append(Departure(name, start_ns, end_ns, last, message))
                return

    def _absence(self, group: Group, name: str, before: Trace) -> str:
        """Return why an object is no member in the last of these samples."""
        row = int(before.rows[-1, before.names.index(name)])
        if row == ABSENT:
            return f"{printable(name)} was not in the log"
        current = before.classes[before.class_code[row if row >= 0 else -2 - row]]
        instead = f" but {printable(current)!r}" if current else ""
        return f"{printable(name)} was not of the class {printable(group.class_name or '')!r}{instead}"


def _watches_of(instance: Instance) -> Iterator[_Watch]:
    for node, around in iter_bound(substitute(instance.formula, instance.bindings)):
        distances = list(_distances_of(node)) if isinstance(node, Atom) else []
        if not isinstance(node, Atom) or len(distances) != 1:
            continue
        groups = {variable: scope.group for scope in around for variable in scope.variables}
        limits = [abs(limit) for limit in node.parameters if isinstance(limit, float)]
        first, second = (_with_group(term, groups) for term in (distances[0].first, distances[0].second))
        for member, other in ((first, second), (second, first)):
            group = base_of(member)
            is_open = isinstance(group, Group) and group.is_open and not looks_back(member)
            if is_open and not isinstance(base_of(other), Variable) and not looks_back(other):
                yield _Watch(group, member, other, max(limits, default=0.0))


def _distances_of(atom: Atom) -> Iterator[SignedDistance]:
    parts = iter_expressions(atom.expression)
    return (part for part in dict.fromkeys(parts) if isinstance(part, SignedDistance))


def _with_group(term: Term, groups: Mapping[str, Group | Earlier]) -> Term:
    """Return a term about the whole group that its variable stands for, without other variables."""
    match term:
        case Enlarged() | Centre():
            return replace(term, term=_with_group(term.term, groups))
        case Variable() if isinstance(group := groups.get(term.name), Group):
            return _with_group(group, groups)
        case Group():
            return replace(term, excluded=tuple(x for x in term.excluded if isinstance(x, TrackedName)))
    return term


def _about(term: Term, name: str) -> Term:
    """Return a term about one member in place of its open group."""
    if isinstance(term, Enlarged | Centre):
        return replace(term, term=_about(term.term, name))
    return TrackedName(name)


def _without(term: Term, name: str) -> Term:
    """Return a term in which an object is no member of its open group."""
    if isinstance(term, Enlarged | Centre):
        return replace(term, term=_without(term.term, name))
    is_open = isinstance(term, Group) and term.is_open
    return replace(term, excluded=(*term.excluded, TrackedName(name))) if is_open else term
