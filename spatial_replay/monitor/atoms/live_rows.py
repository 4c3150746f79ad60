"""Rows of a plan: which objects of which samples the terms of a specification are about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.monitor.atoms.delays import NO_DELAY, Delay
from spatial_replay.monitor.atoms.instructions import Membership
from spatial_replay.monitor.atoms.live_kernel import ANY
from spatial_replay.monitor.atoms.terms import left_out_of, open_group
from spatial_replay.spec.formula import ANY_CLASS, Atom, Centre, Earlier, Group, Quantified, RegionName, Term
from spatial_replay.spec.walks import base_of, is_centre, standing

Leaves: TypeAlias = Sequence[Atom | Quantified]


class Member(NamedTuple):
    """An object that an open group may hold: its name, and the code of its class."""

    name: str
    class_code: int


@dataclass(frozen=True, eq=False)
class PlanContext:
    """State that the plans of a specification share.

    Attributes:
        leaves: those of each formula.
        delays: the samples looked at, the newest first.
        classes: the code of each class that open groups ask for, by its name in lower case; others have 0.
        regions: the regions that formulas name, and those of which they name the centre.
    """

    leaves: Sequence[Leaves]
    delays: tuple[Delay, ...]
    classes: Mapping[str, int]
    regions: Mapping[RegionName | Centre, TrackedObject]


class Place(NamedTuple):
    """An object in one of the samples looked at, or the point at its centre."""

    sample: int
    name: str
    is_centre: bool


class Row(NamedTuple):
    """A row of a plan, and the class that it must have (or `ANY`) to count."""

    row: int
    class_code: int = ANY


class PlanRows:
    """Rows for what terms are about, numbered as they are asked for (see `plan_kernel`)."""

    def __init__(self, frame: PlanContext, members: frozenset[Member]) -> None:
        self._frame = frame
        self._members = members
        self._sample = {delay: number for number, delay in enumerate(frame.delays)}
        self._region = {name: len(self._sample) + number for number, name in enumerate(frame.regions)}
        self.places: dict[Place, int] = {}

    def candidates(self, group: Group | Earlier) -> tuple[str, ...]:
        base = open_group(group)
        wanted = self._class_wanted(base)
        fitting = {name for name, code in self._members if wanted in (ANY, code)}
        return tuple(sorted(fitting - left_out_of(base)))

    def may_be_unknown(self, group: Group | Earlier) -> bool:
        return isinstance(group, Earlier)

    def of_membership(self, membership: Membership) -> list[Row]:
        sample = self._sample_of(membership.group)
        if not membership.chosen:
            return [Row(sample)]
        names, wanted = self.candidates(membership.group), self._class_wanted(open_group(membership.group))
        return [Row(self._place(sample, names[each]), wanted) for each in membership.chosen]

    def of_term(self, term: Term) -> list[Row]:
        """Return the rows whose union a term is."""
        is_point, term = is_centre(term), standing(term)
        sample = self._sample_of(term)
        base = term.term if isinstance(term, Earlier) else term
        if isinstance(base, RegionName):
            return [Row(self._region[Centre(base) if is_point else base])]
        if not isinstance(base, Group):
            return [Row(self._place(sample, base.name, is_point))]
        if base.members is None:
            wanted = self._class_wanted(base)
            return [Row(self._place(sample, name, is_point), wanted) for name in self.candidates(base)]
        left_out = left_out_of(base)
        return [Row(self._place(sample, name, is_point)) for name in base.members if name not in left_out]

    def required(self, term: Term) -> list[int]:
        """Return the rows, its sample's among them, without which a term is unknown."""
        then, base = standing(term), base_of(term)
        sample = [self._sample_of(then)] if isinstance(then, Earlier) else []
        if isinstance(base, RegionName) or (isinstance(base, Group) and base.members is None):
            return sample
        return sample + [each.row for each in self.of_term(term)]

    def _sample_of(self, term: Term) -> int:
        return self._sample[Delay.of(term) if isinstance(term, Earlier) else NO_DELAY]

    def _class_wanted(self, group: Group) -> int:
        if group.class_name == ANY_CLASS:
            return ANY
        return self._frame.classes[(group.class_name or "").casefold()]

    def _place(self, sample: int, name: str, is_centre: bool = False) -> int:
        first = len(self._sample) + len(self._region)
        return self.places.setdefault(Place(sample, name, is_centre), first + len(self.places))
