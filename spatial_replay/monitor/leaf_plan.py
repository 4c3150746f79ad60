"""What the leaves of a monitor are computed from, found once for samples with the same objects.

To a monitor most samples look alike: other numbers, the same names. A plan holds what follows from the names,
as index arrays, so that a sample costs little more than its numbers. It serves every sample whose members of
open groups are among its own, under whatever names; an object that is not in a sample is only a flag to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import nan
from typing import NamedTuple, cast

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.geometry.measure import QUANTITY_CODES
from spatial_replay.monitor.leaf_code import LeafCode, Membership
from spatial_replay.monitor.measurements import quantity_of, terms_of
from spatial_replay.monitor.operands import footprint_from_outline, left_out_of, open_group
from spatial_replay.monitor.plan_kernel import ABSENT, ANY, PlanArrays, leaves_of_sample, packed
from spatial_replay.monitor.recent import NO_DELAY, Delay
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
    Earlier,
    Enlarged,
    Group,
    Misalignment,
    Outline,
    Quantified,
    RegionName,
    Term,
)
from spatial_replay.trace.sample import Sample

Leaves = Sequence[Atom | Quantified]
Ragged = tuple[list[int], list[int]]


class Member(NamedTuple):
    """An object that an open group may hold: its name, and the code of its class."""

    name: str
    class_code: int


@dataclass(frozen=True, eq=False)
class Frame:
    """What plans for a specification share.

    Attributes:
        leaves: those of each formula.
        delays: the samples looked at, the newest first.
        classes: the code of each class that open groups ask for, by its name in lower case; others have 0.
        regions: the shapes that formulas may name.
    """

    leaves: Sequence[Leaves]
    delays: tuple[Delay, ...]
    classes: Mapping[str, int]
    regions: Mapping[str, Outline]


class _Row(NamedTuple):
    """A row of a plan, and the class that it must have (or `ANY`) to count."""

    row: int
    class_code: int = ANY


class _Rows:
    """Rows for what terms are about, numbered as they are asked for (see `plan_kernel`)."""

    def __init__(self, frame: Frame, members: frozenset[Member]) -> None:
        self._frame = frame
        self._members = members
        self._sample = {delay: number for number, delay in enumerate(frame.delays)}
        self._region = {name: len(self._sample) + number for number, name in enumerate(frame.regions)}
        self.places: dict[tuple[int, str], int] = {}

    def candidates(self, group: Group | Earlier) -> tuple[str, ...]:
        base = open_group(group)
        wanted = self._class_wanted(base)
        fitting = {name for name, code in self._members if wanted in (ANY, code)}
        return tuple(sorted(fitting - left_out_of(base)))

    def may_be_unknown(self, group: Group | Earlier) -> bool:
        return isinstance(group, Earlier)

    def of_membership(self, membership: Membership) -> list[_Row]:
        sample = self._sample_of(membership.group)
        if not membership.chosen:
            return [_Row(sample)]
        names, wanted = self.candidates(membership.group), self._class_wanted(open_group(membership.group))
        return [_Row(self._place(sample, names[each]), wanted) for each in membership.chosen]

    def of_term(self, term: Term) -> list[_Row]:
        """The rows that a term is the union of."""
        while isinstance(term, Enlarged):
            term = term.term
        sample = self._sample_of(term)
        base = term.term if isinstance(term, Earlier) else term
        if isinstance(base, RegionName):
            return [_Row(self._region[base.name])]
        if not isinstance(base, Group):
            return [_Row(self._place(sample, base.name))]
        if base.members is None:
            wanted = self._class_wanted(base)
            return [_Row(self._place(sample, name), wanted) for name in self.candidates(base)]
        left_out = left_out_of(base)
        return [_Row(self._place(sample, name)) for name in base.members if name not in left_out]

    def required(self, term: Term) -> list[int]:
        """The rows without which a term is unknown as a whole: that of its sample among them."""
        while isinstance(term, Enlarged):
            term = term.term
        base = term.term if isinstance(term, Earlier) else term
        sample = [self._sample_of(term)] if isinstance(term, Earlier) else []
        if isinstance(base, RegionName) or (isinstance(base, Group) and base.members is None):
            return sample
        return sample + [each.row for each in self.of_term(term)]

    def _sample_of(self, term: Term) -> int:
        return self._sample[Delay.of(term) if isinstance(term, Earlier) else NO_DELAY]

    def _class_wanted(self, group: Group) -> int:
        if group.class_name == ANY_CLASS:
            return ANY
        return self._frame.classes[(group.class_name or "").casefold()]

    def _place(self, sample: int, name: str) -> int:
        first = len(self._sample) + len(self._region)
        return self.places.setdefault((sample, name), first + len(self.places))


class LeafPlan:
    """How the leaves of formulas follow from a sample and the earlier ones that it looks back at."""

    def __init__(self, frame: Frame, members: frozenset[Member]) -> None:
        """Plan for samples that hold no other members of open groups.

        Raises:
            UsageError: more bindings than `MAX_BINDINGS`.
        """
        self._classes = frame.classes
        rows = _Rows(frame, members)
        code = LeafCode(rows)
        outputs = [number for leaves in frame.leaves for number in code.add_leaves(leaves, {})]
        self._arrays = packed(_arrays(frame, rows, code, outputs))
        self._places = tuple(rows.places)
        self._signals = tuple(code.signals)

    def leaf_values(self, samples: Sequence[Sample | None], stands_for: Mapping[str, str]) -> Floats:
        """Each leaf of each formula, one after the other.

        Args:
            samples: the one at each of the frame's delays; None before the first.
            stands_for: the objects that go by another name among the plan's members.

        Returns:
            (C, A, 1), in as many channels as `leaves.leaf_values` would give.
        """
        whole = [ABSENT if sample is None else 0 for sample in samples]
        classes: list[int] = []
        counts: list[int] = []
        sizes: list[int] = []
        numbers: list[float] = []
        radii: list[float] = []
        vertices: list[Floats] = [_NO_VERTICES]
        for number, name in self._places:
            sample = samples[number]
            tracked = None if sample is None else sample.objects.get(stands_for.get(name, name))
            if tracked is None:
                classes.append(ABSENT)
                counts.append(0)
                numbers += _NO_NUMBERS
                continue
            tracked = cast(TrackedObject, tracked)  # a sample makes one of a bare footprint
            classes.append(class_code(tracked, self._classes))
            bottom, top = tracked.height or _NO_HEIGHT
            numbers += (bottom, top, nan if tracked.yaw is None else tracked.yaw, tracked.uncertainty)
            parts = tracked.footprint.parts
            counts.append(len(parts))
            for part in parts:
                sizes.append(len(part.vertices))
                radii.append(part.radius)
                vertices.append(part.vertices)
        newest = cast(Sample, samples[0]).signals
        numbers += radii
        numbers += [newest.get(name, nan) for name in self._signals]
        whole += classes
        whole += counts
        whole += sizes
        return leaves_of_sample(
            self._arrays, np.array(whole, np.int64), np.array(numbers, np.float64), np.concatenate(vertices)
        )


_NO_HEIGHT = (nan, nan)
_NO_NUMBERS = (nan, nan, nan, 0.0)
_NO_VERTICES = np.empty((0, 2))


def class_code(tracked: TrackedObject, classes: Mapping[str, int]) -> int:
    """The code of an object's class."""
    return classes.get((tracked.class_name or "").casefold(), 0) if classes else 0


def _arrays(frame: Frame, rows: _Rows, code: LeafCode, outputs: Sequence[int]) -> PlanArrays:
    measurements = list(code.measurements)
    operands: dict[Term, int] = {}
    geometric = [k for k, each in enumerate(measurements) if not isinstance(each, Misalignment)]
    pairs = [
        [operands.setdefault(term, len(operands)) for term in terms_of(measurements[k])] for k in geometric
    ]
    yaws = [
        [k, *(rows.of_term(term)[0].row for term in terms_of(each))]
        for k, each in enumerate(measurements)
        if isinstance(each, Misalignment)
    ]
    operand_rows = [rows.of_term(term) for term in operands]
    required = [[row for term in terms_of(each) for row in rows.required(term)] for each in measurements]
    members = [rows.of_membership(each) for each in code.members]
    regions = FootprintBatch.from_footprints(
        [footprint_from_outline(outline) for outline in frame.regions.values()],
        [outline.height for outline in frame.regions.values()],
    )
    return PlanArrays(
        extent=_whole([len(frame.delays), len(frame.regions), len(rows.places), len(code.signals)]),
        region_parts=np.diff(regions.part_start),
        region_sizes=np.diff(regions.vertex_start),
        region_radius=regions.radius.copy(),
        region_vertices=regions.vertices.copy(),
        region_heights=np.stack((regions.bottom, regions.top), axis=1),
        operand_start=_starts(operand_rows),
        operand_rows=_whole(each.row for among in operand_rows for each in among),
        operand_classes=_whole(each.class_code for among in operand_rows for each in among),
        enlargement=np.array([_enlargement(term) for term in operands], np.float64),
        geometric=_whole(geometric),
        quantity=_whole(QUANTITY_CODES[quantity_of(measurements[k])] for k in geometric),
        first=_whole(pair[0] for pair in pairs),
        second=_whole(pair[1] if len(pair) > 1 else ABSENT for pair in pairs),
        yaws=np.array(yaws, np.int64).reshape(len(yaws), 3),
        required_start=_starts(required),
        required=_whole(row for among in required for row in among),
        member_start=_starts(members),
        member_rows=_whole(each.row for among in members for each in among),
        member_classes=_whole(each.class_code for among in members for each in among),
        is_group=_whole(not each.chosen for each in code.members),
        code=np.array(list(code.rows), np.int64).reshape(len(code.rows), 4),
        constants=np.array(list(code.constants), np.float64),
        outputs=_whole(outputs),
    )


def _whole(numbers: Iterable[int]) -> Integers:
    return np.array(list(numbers), np.int64)


def _starts(among: Sequence[Sequence[object]]) -> Integers:
    return np.concatenate(([0], np.cumsum([len(each) for each in among], dtype=np.int64)))


def _enlargement(term: Term) -> float:
    """How much a term is enlarged in all, added in the order in which a scene does."""
    return _enlargement(term.term) + term.radius if isinstance(term, Enlarged) else 0.0
