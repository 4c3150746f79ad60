"""Which plan serves a sample: one for all where no group is open, else by who is in the open groups."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import cast

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.monitor.leaf_plan import Frame, LeafPlan, Leaves, Member, class_code
from spatial_replay.monitor.recent import NO_DELAY, RecentSamples, iter_delays
from spatial_replay.spec.formula import ANY_CLASS, Atom, Formula, Group, Outline, Quantified, RegionName, Term
from spatial_replay.spec.terms import base_of, iter_formulas, terms_of
from spatial_replay.trace.sample import Sample

MOST_PLANS = 256


class SampleLeaves:
    """The leaves of some formulas, sample after sample, with what they look back at."""

    def __init__(self, leaves: Sequence[Leaves], regions: Mapping[str, Outline]) -> None:
        formulas = list(chain.from_iterable(leaves))
        bases = [base_of(term) for term in _terms(formulas)]
        wanted = {(base.class_name or "") for base in bases if isinstance(base, Group) and base.is_open}
        named = {base.name for base in bases if isinstance(base, RegionName)}
        self._is_any_wanted = ANY_CLASS in wanted
        classes = sorted({name.casefold() for name in wanted if name != ANY_CLASS})
        self._frame = Frame(
            leaves,
            tuple(dict.fromkeys((NO_DELAY, *iter_delays(formulas)))),
            {name: code for code, name in enumerate(classes, start=1)},
            {name: outline for name, outline in regions.items() if name in named},
        )
        self._recent = RecentSamples(self._frame.delays)
        self._plans: OrderedDict[frozenset[Member], LeafPlan] = OrderedDict()
        self._plan: LeafPlan | None = None
        if not wanted:
            self._plan = LeafPlan(self._frame, frozenset())
        self._has_open_groups = bool(wanted)

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
        plan = self._plan
        if plan is None or self._has_open_groups:
            plan = self._plan = self._plan_for(self._members(samples))
        return plan.leaf_values(samples)

    def _members(self, samples: Sequence[Sample | None]) -> frozenset[Member]:
        """Who is in any open group in any of the samples."""
        classes = self._frame.classes
        members = [
            Member(name, class_code(cast(TrackedObject, tracked), classes))
            for sample in samples
            if sample is not None
            for name, tracked in sample.objects.items()
        ]
        return frozenset(each for each in members if self._is_any_wanted or each.class_code)

    def _plan_for(self, members: frozenset[Member]) -> LeafPlan:
        """A plan that serves samples with these members, and has few others."""
        plan = self._plan
        if plan is not None and members <= plan.members and len(plan.members) <= _most(members):
            return plan
        if members in self._plans:
            self._plans.move_to_end(members)
            return self._plans[members]
        together = members if plan is None else members | plan.members
        if len(together) > _most(members):
            together = members
        try:
            plan = LeafPlan(self._frame, together)
        except UsageError:
            plan = LeafPlan(self._frame, members)
        self._plans[plan.members] = plan
        if len(self._plans) > MOST_PLANS:
            self._plans.popitem(last=False)
        return plan


def _most(members: frozenset[Member]) -> int:
    """How many members a plan for these may have: some that come and go, not all that ever were."""
    return len(members) + len(members) // 2 + 2


def _terms(formulas: Sequence[Formula]) -> list[Term]:
    terms: list[Term] = []
    for formula in chain.from_iterable(map(iter_formulas, formulas)):
        if isinstance(formula, Atom):
            terms += terms_of(formula.expression)
        elif isinstance(formula, Quantified):
            terms.append(formula.group)
    return terms
