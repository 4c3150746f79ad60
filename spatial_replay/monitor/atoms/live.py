"""The leaves of single samples, for monitors: plans are compiled once and reused.

Most samples differ in their numbers, not in their names. A plan holds what follows from the names as index
arrays, so that a sample costs little more than its numbers. It serves every sample whose members of open
groups fit into it; an object missing from a sample is only a flag.

Without open groups one plan serves all samples. Otherwise it depends on how many members they have. Objects
that the specification does not name differ only in their classes, so a plan has placeholders for them. Each
sample assigns objects to placeholders. Tracks that appear under new names need no new plan.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain, zip_longest
from math import nan
from struct import Struct
from types import MappingProxyType
from typing import Any, TypeAlias, cast

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, Integers, starts_from_counts
from spatial_replay.geometry.footprint import FootprintBatch, TrackedObject, centre_object
from spatial_replay.geometry.measure import QUANTITY_CODES
from spatial_replay.monitor.atoms.delays import NO_DELAY, PREVIOUS, RecentSamples, iter_delays
from spatial_replay.monitor.atoms.instructions import LeafCode
from spatial_replay.monitor.atoms.live_kernel import ABSENT, PackedPlan, PlanArrays, leaves_of_sample
from spatial_replay.monitor.atoms.live_rows import Leaves, Member, PlanContext, PlanRows
from spatial_replay.monitor.atoms.measurements import quantity_of
from spatial_replay.monitor.atoms.terms import footprint_from_outline
from spatial_replay.spec.formula import (
    ANY_CLASS,
    STEP,
    Centre,
    ComputedSignal,
    Enlarged,
    Group,
    Misalignment,
    Outline,
    PreviousSignal,
    RegionName,
    Signal,
    Term,
    TrackedName,
)
from spatial_replay.spec.relations import computed_signal
from spatial_replay.spec.walks import base_of, is_centre, iter_terms, measured_terms
from spatial_replay.trace.sample import Sample


class LeafPlan:
    """Index arrays that compute the leaves of a sample and the earlier ones it looks back at."""

    def __init__(
        self, frame: PlanContext, members: frozenset[Member], placeholders: Mapping[_Classes, Sequence[str]]
    ) -> None:
        """Plan for samples that hold no other members of open groups.

        Args:
            placeholders: those members that stand for unnamed objects, of each kind.

        Raises:
            UsageError: more bindings than `MAX_BINDINGS`.
        """
        rows = PlanRows(frame, members)
        code = LeafCode(rows)
        outputs = [number for leaves in frame.leaves for number in code.add_leaves(leaves, {})]
        arrays = _arrays(frame, rows, code, outputs)
        self.packed = PackedPlan.of(arrays)
        self.placeholders = placeholders
        self._places = tuple(rows.places)
        self._signals = tuple(code.signals)
        self._previous = frame.delays.index(PREVIOUS) if PREVIOUS in frame.delays else 0
        self._has_classes = bool(frame.classes)
        count = len(frame.delays) + len(self._signals) + (len(self._places) if self._has_classes else 0)
        self._pack = Struct(f"={count}d").pack

    @property
    def nbytes(self) -> int:
        """The memory of its arrays."""
        return self.packed.whole.nbytes + self.packed.real.nbytes

    def numbers(
        self, samples: Sequence[Sample | None], stands_for: Mapping[str, str], codes: ClassCodes
    ) -> bytes:
        """Flatten samples for `measure_sample`, as the bytes of doubles.

        Args:
            samples: the one at each of the frame's delays; None before the first.
            stands_for: the objects that go by another name among the plan's members.
            codes: those of classes.
        """
        newest: Any = samples[0]
        numbers = [0.0]
        if len(samples) > 1:
            numbers = [0.0 if sample else ABSENT for sample in samples]
        for signal in self._signals:
            numbers.append(_signal(signal, newest, samples[self._previous]))
        if not self._places:
            return self._pack(*numbers)
        packed = [b""]
        lookups = [newest.objects.get]
        if len(samples) > 1:
            lookups = [sample.objects.get if sample else _NOTHING_THERE for sample in samples]
        for place, name, is_point in self._places:
            name = stands_for.get(name, name) if stands_for else name
            tracked: Any = lookups[place](name)
            if tracked is not None:
                packed += (centre_object(tracked) if is_point else tracked).packed
                if self._has_classes:
                    numbers.append(codes[tracked.class_name])
                continue
            unknown: Any = _NOTHING if samples[place] is None else cast(Sample, samples[place]).unknown
            packed.append(_HIDDEN if name in unknown else _NOT_THERE)
            if self._has_classes:
                numbers.append(codes[unknown[name]] if name in unknown else 0.0)
        packed[0] = self._pack(*numbers)
        return b"".join(packed)


def _signal(signal: Signal, sample: Sample, previous: Sample | None) -> float:
    """Return what `TraceScene.signal` does of one sample."""
    if signal == STEP:
        return nan if previous is None else (sample.time_ns - previous.time_ns) / 1e9
    if isinstance(signal, PreviousSignal):
        return nan if previous is None else _signal(signal.of, previous, None)
    if isinstance(signal, ComputedSignal):
        return computed_signal(signal, sample)
    return sample.signals.get(signal.name, nan)


_NOTHING_THERE: Callable[[str], None] = MappingProxyType[str, None]({}).get
_NOT_THERE, _HIDDEN = (Struct("=5d").pack(parts, nan, nan, nan, 0.0) for parts in (0.0, -1.0))


class ClassCodes(dict[str | None, int]):
    """The codes of classes as objects name them, 0 of any other; those asked for lately are kept."""

    def __init__(self, classes: Mapping[str, int]) -> None:
        super().__init__()
        self._classes = classes

    def __missing__(self, name: str | None) -> int:
        if len(self) >= MOST_CLASSES:
            self.clear()
        self[name] = code = self._classes.get((name or "").casefold(), 0)
        return code


MOST_CLASSES = 1024
"""Classes that are kept."""


def _arrays(frame: PlanContext, rows: PlanRows, code: LeafCode, outputs: Sequence[int]) -> PlanArrays:
    measurements = list(code.measurements)
    operands: dict[Term, int] = {}
    geometric = [k for k, each in enumerate(measurements) if not isinstance(each, Misalignment)]
    pairs = [
        [operands.setdefault(term, len(operands)) for term in measured_terms(measurements[k])]
        for k in geometric
    ]
    yaws = [
        [k, *(rows.of_term(term)[0].row for term in measured_terms(each))]
        for k, each in enumerate(measurements)
        if isinstance(each, Misalignment)
    ]
    operand_rows = [rows.of_term(term) for term in operands]
    required = [
        [row for term in measured_terms(each) for row in rows.required(term)] for each in measurements
    ]
    closest = [rows.of_term(each.group) for each in code.closest]
    members = [rows.of_membership(each) for each in code.members]
    regions = FootprintBatch.from_footprints(
        [each.footprint for each in frame.regions.values()], [each.height for each in frame.regions.values()]
    )
    return PlanArrays(
        extent=_whole(
            [
                len(frame.delays),
                len(frame.regions),
                len(rows.places),
                len(code.signals),
                len(rows.places) if frame.classes else 0,
            ]
        ),
        region_parts=np.diff(regions.part_start),
        region_sizes=np.diff(regions.vertex_start),
        region_radius=regions.radius.copy(),
        region_vertices=regions.vertices.ravel(),
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
        closest_start=_starts(closest),
        closest_rows=_whole(each.row for among in closest for each in among),
        closest_classes=_whole(each.class_code for among in closest for each in among),
        closest_enlargement=np.array([each.enlargement for each in code.closest], np.float64),
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
    return starts_from_counts([len(each) for each in among])


def _enlargement(term: Term) -> float:
    """Return the total enlargement of a term, summed in the order in which `TraceScene` sums it."""
    return _enlargement(term.term) + term.radius if isinstance(term, Enlarged) else 0.0


MOST_PLANS = 256
MOST_BYTES = 1 << 22
"""Limits on stored plans, by number and memory; the least recently used go first, never the newest."""

_NO_OBJECT = ""
"""A name that no object has."""
_NOTHING: Mapping[str, str] = MappingProxyType({})


def _region(outline: Outline) -> TrackedObject:
    return TrackedObject(footprint_from_outline(outline), height=outline.height)


_Classes: TypeAlias = tuple[int, ...]
"""Codes of the classes of one object in the samples looked at: nearly always one."""

_Counts: TypeAlias = tuple[tuple[_Classes, int], ...]
"""The number of placeholders for the unnamed objects of each kind."""


class SampleLeaves:
    """The leaves of some formulas, sample by sample."""

    def __init__(self, leaves: Sequence[Leaves], regions: Mapping[str, Outline]) -> None:
        formulas = list(chain.from_iterable(leaves))
        terms = list(iter_terms(formulas))
        bases = [base_of(term) for term in terms]
        open_classes = {base.class_name or "" for base in bases if isinstance(base, Group) and base.is_open}
        named = {name: _region(outline) for name, outline in regions.items() if RegionName(name) in bases}
        classes = sorted({name.casefold() for name in open_classes if name != ANY_CLASS})
        self._frame = PlanContext(
            leaves,
            tuple(dict.fromkeys((NO_DELAY, *iter_delays(formulas)))),
            {name: code for code, name in enumerate(classes, start=1)},
            {
                **{RegionName(name): each for name, each in named.items()},
                **{
                    Centre(base): centre_object(named[base.name])
                    for base in map(base_of, filter(is_centre, terms))
                    if isinstance(base, RegionName)
                },
            },
        )
        self._regions = regions
        self._recent = RecentSamples(self._frame.delays)
        self._takes_any = ANY_CLASS in open_classes
        self._own_names = _names(bases)
        self._prefix = "?"
        while any(name.startswith(self._prefix) for name in self._own_names):
            self._prefix += "?"
        self._own_members: frozenset[Member] = frozenset()  # grows, but no further than the specification
        self._codes = ClassCodes(self._frame.classes)
        self._only_plan = None if open_classes else LeafPlan(self._frame, frozenset(), {})
        self._plans: OrderedDict[tuple[frozenset[Member], _Counts], LeafPlan] = OrderedDict()
        self._bytes = 0

    def look_at(self, sample: Sample) -> list[Sample | None]:
        """Add the next sample; return it and those that it looks back at."""
        return self._recent.add(sample)

    def values(self, samples: Sequence[Sample | None]) -> Floats:
        """Compute the leaves of all formulas, (C, A, 1).

        Args:
            samples: what `look_at` gave.

        Raises:
            UsageError: more bindings than `MAX_BINDINGS`.
        """
        plan, stands_for = self._only_plan, _NOTHING
        if plan is None:
            plan, stands_for = self._fitting_plan(samples)
        return leaves_of_sample(plan.packed, plan.numbers(samples, stands_for, self._codes))

    def _fitting_plan(self, samples: Sequence[Sample | None]) -> tuple[LeafPlan, Mapping[str, str]]:
        """Return a plan for the members of open groups in some samples, and their names in it."""
        unnamed = self._unnamed_members(samples)
        counts = {classes: _room(len(names)) for classes, names in unnamed.items()}
        try:
            plan = self._plan_for(counts)
        except UsageError:  # the rounded-up counts exceed the limit of bindings; the exact ones may not
            counts = {classes: len(names) for classes, names in unnamed.items()}
            plan = self._plan_for(counts)
        stands_for: dict[str, str] = {}
        for classes, names in unnamed.items():
            stands_for.update(zip_longest(plan.placeholders[classes], names, fillvalue=_NO_OBJECT))
        return plan, stands_for

    def _unnamed_members(self, samples: Sequence[Sample | None]) -> dict[_Classes, list[str]]:
        """Return the members of open groups that the specification does not name, by their classes."""
        found: dict[str, _Classes] = {}
        own: list[Member] = []
        codes, takes_any, own_names = self._codes, self._takes_any, self._own_names
        for sample in filter(None, samples):
            objects: Any = sample.objects
            coded = [codes[each.class_name] for each in objects.values()]
            coded += [codes[class_name] for class_name in sample.unknown.values()]
            for name, code in zip(chain(objects, sample.unknown), coded, strict=True):
                if not (code or takes_any):
                    continue
                if name in own_names:
                    own.append(Member(name, code))
                elif name not in found:
                    found[name] = (code,)
                elif code not in found[name]:
                    found[name] = tuple(sorted((*found[name], code)))
        if not self._own_members.issuperset(own):
            self._own_members |= frozenset(own)
        kinds: dict[_Classes, list[str]] = {}
        for name, kind in found.items():
            kinds.setdefault(kind, []).append(name)
        return kinds

    def _plan_for(self, counts: Mapping[_Classes, int]) -> LeafPlan:
        """Return the plan for the given number of unnamed members of each kind."""
        key = self._own_members, tuple(sorted(counts.items()))
        if key in self._plans:
            self._plans.move_to_end(key)
            return self._plans[key]
        # names that the specification does not use
        placeholders = {
            classes: [f"{self._prefix}{classes} {number}" for number in range(count)]
            for classes, count in counts.items()
        }
        unnamed = {
            Member(name, code)
            for classes, names in placeholders.items()
            for name in names
            for code in classes
        }
        plan = LeafPlan(self._frame, self._own_members | unnamed, placeholders)
        self._plans[key] = plan
        self._bytes += plan.nbytes
        while len(self._plans) > 1 and (len(self._plans) > MOST_PLANS or self._bytes > MOST_BYTES):
            _, dropped = self._plans.popitem(last=False)
            self._bytes -= dropped.nbytes
        return plan


def _room(count: int) -> int:
    """Round a number of members up to 1, 2, 3, 4, 6, 8, 12, 16, …, so that few plans are needed."""
    power = 1 << (count - 1).bit_length()
    return count if count < 4 else power * 3 // 4 if count <= power * 3 // 4 else power


def _names(bases: Sequence[Term]) -> frozenset[str]:
    """Return the objects that terms name."""
    names: set[str] = set()
    for base in bases:
        if isinstance(base, TrackedName):
            names.add(base.name)
        elif isinstance(base, Group):
            names.update(base.members or ())
            names.update(each.name for each in base.excluded if isinstance(each, TrackedName))
    return frozenset(names)
