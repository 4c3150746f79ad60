"""Which plan serves a sample: one for all where no group is open, else by how many are in the open groups.

To a specification, objects that it does not name are all alike but for their classes. So a plan has stand-ins
for them, and in each sample it is said whom they stand for: tracks that come and go under ever new names need
no plan of their own.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from itertools import chain, zip_longest
from typing import TypeAlias, cast

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.monitor.leaf_plan import LeafPlan, class_code
from spatial_replay.monitor.plan_rows import Frame, Leaves, Member
from spatial_replay.monitor.recent import NO_DELAY, RecentSamples, iter_delays
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
    Formula,
    Group,
    Outline,
    Quantified,
    RegionName,
    Term,
    TrackedName,
)
from spatial_replay.spec.terms import base_of, iter_formulas, terms_of
from spatial_replay.trace.sample import Sample

MOST_PLANS = 256
MOST_BYTES = 1 << 22
"""How many plans are kept, and how much memory they take but for the newest; first goes the one used longest
ago."""

_NOBODY = ""
"""A name that no object has."""

_Classes: TypeAlias = tuple[int, ...]
"""Codes of the classes that one object has in the samples looked at: nearly always one."""

_Counts: TypeAlias = tuple[tuple[_Classes, int], ...]
"""How many stand-ins there are for the unnamed objects of each kind."""


class SampleLeaves:
    """The leaves of some formulas, sample after sample, with what they look back at."""

    def __init__(self, leaves: Sequence[Leaves], regions: Mapping[str, Outline]) -> None:
        formulas = list(chain.from_iterable(leaves))
        bases = [base_of(term) for term in _terms(formulas)]
        open_classes = {base.class_name or "" for base in bases if isinstance(base, Group) and base.is_open}
        regions_named = {base.name for base in bases if isinstance(base, RegionName)}
        classes = sorted({name.casefold() for name in open_classes if name != ANY_CLASS})
        self._frame = Frame(
            leaves,
            tuple(dict.fromkeys((NO_DELAY, *iter_delays(formulas)))),
            {name: code for code, name in enumerate(classes, start=1)},
            {name: outline for name, outline in regions.items() if name in regions_named},
        )
        self._recent = RecentSamples(self._frame.delays)
        self._takes_any = ANY_CLASS in open_classes
        self._own_names = _names(bases)
        self._prefix = "?"
        while any(name.startswith(self._prefix) for name in self._own_names):
            self._prefix += "?"
        self._own_members: frozenset[Member] = frozenset()  # grows, but no further than the specification
        self._only_plan = None if open_classes else LeafPlan(self._frame, frozenset())
        self._plans: OrderedDict[tuple[frozenset[Member], _Counts], LeafPlan] = OrderedDict()
        self._bytes = 0

    def look_at(self, sample: Sample) -> list[Sample | None]:
        """Take in the next sample; it and those that it looks back at."""
        return self._recent.take(sample)

    def values(self, samples: Sequence[Sample | None]) -> Floats:
        """(C, A, 1), each leaf of each formula.

        Args:
            samples: what `look_at` gave.

        Raises:
            UsageError: more bindings than `MAX_BINDINGS`.
        """
        if self._only_plan is not None:
            return self._only_plan.leaf_values(samples, {})
        unnamed = self._unnamed_members(samples)
        counts = {classes: _room(len(names)) for classes, names in unnamed.items()}
        try:
            plan = self._plan_for(counts)
        except UsageError:
            counts = {classes: len(names) for classes, names in unnamed.items()}
            plan = self._plan_for(counts)
        stands_for: dict[str, str] = {}
        for classes, names in unnamed.items():
            stands_for.update(
                zip_longest(self._stand_ins(classes, counts[classes]), names, fillvalue=_NOBODY)
            )
        return plan.leaf_values(samples, stands_for)

    def _unnamed_members(self, samples: Sequence[Sample | None]) -> dict[_Classes, list[str]]:
        """Who is in any open group in any of the samples and not named in the specification, by kind."""
        found: dict[str, _Classes] = {}
        own: list[Member] = []
        for sample in samples:
            for name, tracked in () if sample is None else sample.objects.items():
                code = class_code(cast(TrackedObject, tracked), self._frame.classes)
                if not (code or self._takes_any):
                    continue
                if name in self._own_names:
                    own.append(Member(name, code))
                elif code not in found.setdefault(name, (code,)):
                    found[name] = tuple(sorted((*found[name], code)))
        if not self._own_members.issuperset(own):
            self._own_members |= frozenset(own)
        kinds: dict[_Classes, list[str]] = {}
        for name, classes in found.items():
            kinds.setdefault(classes, []).append(name)
        return kinds

    def _stand_ins(self, classes: _Classes, count: int) -> list[str]:
        """Names for so many unnamed objects: none that the specification names."""
        return [f"{self._prefix}{classes} {number}" for number in range(count)]

    def _plan_for(self, counts: Mapping[_Classes, int]) -> LeafPlan:
        """The plan for so many unnamed members of each kind."""
        key = self._own_members, tuple(sorted(counts.items()))
        if key in self._plans:
            self._plans.move_to_end(key)
            return self._plans[key]
        unnamed = {
            Member(name, code)
            for classes, count in counts.items()
            for name in self._stand_ins(classes, count)
            for code in classes
        }
        plan = LeafPlan(self._frame, self._own_members | unnamed)
        self._plans[key] = plan
        self._bytes += plan.nbytes
        while len(self._plans) > 1 and (len(self._plans) > MOST_PLANS or self._bytes > MOST_BYTES):
            _, dropped = self._plans.popitem(last=False)
            self._bytes -= dropped.nbytes
        return plan


def _room(count: int) -> int:
    """For how many a plan for so many is made: 1, 2, 3, 4, 6, 8, 12, 16, …, so that there are few plans."""
    power = 1 << (count - 1).bit_length()
    return count if count < 4 else power * 3 // 4 if count <= power * 3 // 4 else power


def _terms(formulas: Sequence[Formula]) -> list[Term]:
    terms: list[Term] = []
    for formula in chain.from_iterable(map(iter_formulas, formulas)):
        if isinstance(formula, Atom):
            terms += terms_of(formula.expression)
        elif isinstance(formula, Quantified):
            terms.append(formula.group)
    return terms


def _names(bases: Sequence[Term]) -> frozenset[str]:
    """The objects that terms name."""
    names: set[str] = set()
    for base in bases:
        if isinstance(base, TrackedName):
            names.add(base.name)
        elif isinstance(base, Group):
            names.update(base.members or ())
            names.update(each.name for each in base.excluded if isinstance(each, TrackedName))
    return frozenset(names)
