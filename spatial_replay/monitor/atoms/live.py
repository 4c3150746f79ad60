"""The leaves of single samples, for monitors: plans are compiled once and reused.

Most samples differ in their numbers, not in their names. A plan holds what follows from the names as index
arrays, so that a sample costs little more than its numbers. It serves every sample whose members of open
groups fit into it; an object missing from a sample is only a flag.

Without open groups one plan serves all samples. Otherwise it depends on how many members they have. Objects
that the specification does not name differ only in their classes, so a plan has placeholders for them. Each
sample assigns objects to placeholders. Tracks that appear under new names need no new plan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain, zip_longest
from math import nan
from struct import Struct
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np

from spatial_replay.compiled import inlined, kernel
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats, Integers, starts_from_counts
from spatial_replay.geometry.footprint import (
    BOTTOM,
    PARTS,
    TOP,
    UNCERTAINTY,
    YAW,
    FootprintBatch,
    TrackedObject,
    centre_object,
)
from spatial_replay.geometry.kernels import measure_rows
from spatial_replay.geometry.measure import QUANTITY_CODES, closest_rows, misalignment_of
from spatial_replay.monitor.atoms.instructions import LeafCode, Membership, run_instructions
from spatial_replay.monitor.atoms.measurements import quantity_of
from spatial_replay.monitor.atoms.reports import RecentReports, left_out_of
from spatial_replay.monitor.atoms.terms import (
    NO_DELAY,
    Delay,
    RecentSamples,
    footprint_from_outline,
    iter_delays,
    open_group,
)
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
    Centre,
    ComputedSignal,
    Earlier,
    Enlarged,
    Formula,
    Group,
    Misalignment,
    Outline,
    Present,
    PreviousSignal,
    Quantified,
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
    is_centre,
    iter_terms,
    measured_terms,
    named_members,
    rates_of,
    standing,
)
from spatial_replay.text import TEXTS
from spatial_replay.trace.trace import Sample

ABSENT = -1
ANY = -1
"""The required class if any class matches."""

MOST_CHANNELS = 4
"""As many as leaves may be in (see `online.codes`)."""

_OF_OBJECT, _OF_PART = 5, 2
"""How many numbers come before those of an object's parts, and before those of a part's vertices."""


class PlanArrays(NamedTuple):
    """Work of a plan for every sample; ragged lists come with the offsets of their rows.

    Attributes:
        extent: (5,), how many samples, regions, places, signals and classes of places there are.
        region_parts, region_sizes, region_radius, region_vertices, region_heights: the regions' footprints:
            parts of each, vertices of each part, radius of each part, x and y of all vertices,
            (bottom, top) of each.
        listed_start, listed_rows, listed_classes: rows of each operand, then of each closest pair's group,
            and the class that each row must have. After them come the rows needed for each binding, and those
            without which each measurement is unknown.
        enlargement: of each operand.
        geometric: numbers of the measurements between footprints, with their `quantity` and operands
            `first` and `second` (-1: none).
        yaws: (Y, 3), the number of each measurement between orientations, and its two rows.
        closest_enlargement: of both in each closest pair.
        is_group: for each binding, 1 where it stands for a group itself: not known without its row.
        code, constants, outputs: what `run_instructions` takes.
    """

    extent: Integers
    region_parts: Integers
    region_sizes: Integers
    region_radius: Floats
    region_vertices: Floats
    region_heights: Floats
    listed_start: Integers
    listed_rows: Integers
    listed_classes: Integers
    enlargement: Floats
    geometric: Integers
    quantity: Integers
    first: Integers
    second: Integers
    yaws: Integers
    closest_enlargement: Floats
    is_group: Integers
    code: Integers
    constants: Floats
    outputs: Integers


class PackedPlan(NamedTuple):
    """A plan's arrays one after the other, so that a kernel gets two.

    Attributes:
        whole: where each array begins and ends, and then those of whole numbers.
        real: the others.
        room: for how many numbers `measure_sample` takes room, besides three for each of the objects'.
    """

    whole: Integers
    real: Floats
    room: int

    @property
    def nbytes(self) -> int:
        """The memory of both."""
        return self.whole.nbytes + self.real.nbytes

    @classmethod
    def of(cls, arrays: PlanArrays) -> PackedPlan:
        whole, real = [np.zeros(2 * len(arrays), np.int64)], [np.zeros(0)]
        for number, array in enumerate(arrays):
            among: list[Any] = whole if array.dtype == np.int64 else real
            begin = sum(map(len, among))
            whole[0][2 * number : 2 * number + 2] = begin, begin + array.size
            among.append(array.ravel())
        measured, closest = len(arrays.geometric) + len(arrays.yaws), len(arrays.closest_enlargement)
        operands = len(arrays.enlargement)
        room = 3 * measured + 4 * closest + len(arrays.is_group)
        room += 3 * operands + 2 + int(arrays.listed_start[operands])
        room += 6 * int(arrays.extent[:3].sum()) + 2
        room += 2 * len(arrays.region_radius) + 3 * len(arrays.region_vertices)
        return cls(np.concatenate(whole), np.concatenate(real), room)


@inlined
def plan_at(whole: Integers, real: Floats) -> PlanArrays:
    """Return the arrays of a plan."""
    return PlanArrays(
        extent=whole[whole[0] : whole[1]],
        region_parts=whole[whole[2] : whole[3]],
        region_sizes=whole[whole[4] : whole[5]],
        region_radius=real[whole[6] : whole[7]],
        region_vertices=real[whole[8] : whole[9]],
        region_heights=real[whole[10] : whole[11]].reshape((-1, 2)),
        listed_start=whole[whole[12] : whole[13]],
        listed_rows=whole[whole[14] : whole[15]],
        listed_classes=whole[whole[16] : whole[17]],
        enlargement=real[whole[18] : whole[19]],
        geometric=whole[whole[20] : whole[21]],
        quantity=whole[whole[22] : whole[23]],
        first=whole[whole[24] : whole[25]],
        second=whole[whole[26] : whole[27]],
        yaws=whole[whole[28] : whole[29]].reshape((-1, 3)),
        closest_enlargement=real[whole[30] : whole[31]],
        is_group=whole[whole[32] : whole[33]],
        code=whole[whole[34] : whole[35]].reshape((-1, 4)),
        constants=real[whole[36] : whole[37]],
        outputs=whole[whole[38] : whole[39]],
    )


class SampleRows(NamedTuple):
    """The rows of a plan in one sample, as `measure_rows` takes them, with the class code of each.

    Attributes:
        yaw, uncertainty: of each row; NaN and 0 for samples and regions.
        edges: (V, 4), room for `measure_rows`.
    """

    classes: Integers
    part_start: Integers
    vertex_start: Integers
    vertices: Floats
    radius: Floats
    bottom: Floats
    top: Floats
    yaw: Floats
    uncertainty: Floats
    edges: Floats


@inlined
def _places_at(plan: PlanArrays) -> int:
    """Return where the numbers of the objects begin in those of a sample."""
    return int(plan.extent[0] + plan.extent[3] + plan.extent[4])


@inlined
def _rows_of_sample(plan: PlanArrays, sample: Floats, room: Floats) -> SampleRows:
    """Lay the regions and the objects of a sample out in rows; its numbers are those of `measure_sample`."""
    samples, regions, places = plan.extent[0], plan.extent[1], plan.extent[2]
    here, rows = samples + regions, samples + regions + places
    parts, corners, at = len(plan.region_radius), len(plan.region_vertices) // 2, _places_at(plan)
    for _ in range(places):
        own = max(int(sample[at + PARTS]), 0)
        at += _OF_OBJECT
        parts += own
        for _ in range(own):
            count = int(sample[at])
            at += _OF_PART + 2 * count
            corners += count
    starts, heights = rows, 4 * rows + parts
    real, whole = room[: heights + 6 * corners], room[heights + 6 * corners :].view(np.int64)
    made = SampleRows(
        classes=whole[:rows],
        part_start=whole[starts : starts + rows + 1],
        vertex_start=whole[starts + rows + 1 : starts + rows + parts + 2],
        vertices=real[heights : heights + 2 * corners].reshape((corners, 2)),
        radius=real[4 * rows : heights],
        bottom=real[:rows],
        top=real[rows : 2 * rows],
        yaw=real[2 * rows : 3 * rows],
        uncertainty=real[3 * rows : 4 * rows],
        edges=real[heights + 2 * corners :].reshape((corners, 4)),
    )
    made.part_start[0] = made.vertex_start[0] = 0
    for k in range(here):
        made.classes[k] = int(sample[k]) if k < samples else 0
        made.part_start[k + 1] = made.part_start[k]
        made.bottom[k] = made.top[k] = made.yaw[k] = np.nan
        made.uncertainty[k] = 0.0
    for k in range(regions):
        made.part_start[samples + k + 1] = made.part_start[samples + k] + plan.region_parts[k]
        made.bottom[samples + k], made.top[samples + k] = plan.region_heights[k, 0], plan.region_heights[k, 1]
    part = len(plan.region_radius)
    for p in range(part):
        made.vertex_start[p + 1] = made.vertex_start[p] + plan.region_sizes[p]
        made.radius[p] = plan.region_radius[p]
    for v in range(len(plan.region_vertices) // 2):
        made.vertices[v, 0], made.vertices[v, 1] = (
            plan.region_vertices[2 * v],
            plan.region_vertices[2 * v + 1],
        )
    at, codes_at = _places_at(plan), samples + plan.extent[3]
    for row in range(here, rows):
        own = max(int(sample[at + PARTS]), 0)
        made.classes[row] = int(sample[codes_at + row - here]) if plan.extent[4] > 0 else 0
        if sample[at + PARTS] == 0.0:
            made.classes[row] = ABSENT
        made.part_start[row + 1] = part + own
        made.bottom[row], made.top[row] = sample[at + BOTTOM], sample[at + TOP]
        made.yaw[row], made.uncertainty[row] = sample[at + YAW], sample[at + UNCERTAINTY]
        at += _OF_OBJECT
        for p in range(part, part + own):
            start, count = made.vertex_start[p], int(sample[at])
            made.radius[p] = sample[at + 1]
            at += _OF_PART
            for v in range(start, start + count):
                made.vertices[v, 0], made.vertices[v, 1] = sample[at], sample[at + 1]
                at += 2
            made.vertex_start[p + 1] = start + count
        part += own
    return made


@inlined
def _is_there(classes: Integers, row: int, wanted: int) -> bool:
    return classes[row] != ABSENT and wanted in (ANY, classes[row])


@inlined
def _is_hidden(plan: PlanArrays, rows: SampleRows, row: int) -> bool:
    """Return whether an object that is there is not known where."""
    is_place = row >= plan.extent[0] + plan.extent[1]
    return bool(is_place and rows.part_start[row] == rows.part_start[row + 1])


@inlined
def _measure(plan: PlanArrays, rows: SampleRows, values: Floats, spreads: Floats, room: Floats) -> None:
    """Fill `values` and `spreads` (K, 1), as `measurements.measured` gives them."""
    if len(values) == 0:
        return
    operands, required = len(plan.enlargement), len(plan.listed_start) - 1 - len(values)
    of_operands, begin = room[: operands + 1], operands + 1 + len(plan.geometric)
    measured, lists = room[operands + 1 : begin].reshape((-1, 1)), room[begin:].view(np.int64)
    widths, hidden, members = lists[:operands], lists[operands : 2 * operands + 1], lists[2 * operands + 1 :]
    of_operands[operands], hidden[operands] = 0.0, 0  # for no operand, -1
    for operand in range(operands):
        begin, end = plan.listed_start[operand], plan.listed_start[operand + 1]
        widths[operand], hidden[operand], spread = end - begin, 0, 0.0
        for k in range(begin, end):
            row, members[k] = plan.listed_rows[k], ABSENT
            if not _is_there(rows.classes, row, plan.listed_classes[k]):
                continue
            if _is_hidden(plan, rows, row):
                hidden[operand] = 1
            else:
                members[k] = row
                spread = max(spread, rows.uncertainty[row])
        of_operands[operand] = spread
    # a literal 0 has a type of its own, for which all of it would be compiled once more
    for sample in range(1):
        measure_rows(
            rows.part_start, rows.vertex_start, rows.vertices, rows.radius, rows.bottom, rows.top,
            members, plan.listed_start, widths, plan.enlargement, plan.quantity, plan.first, plan.second,
            rows.edges, measured, sample, sample + 1,
        )  # fmt: skip
    for g in range(len(plan.geometric)):
        k = plan.geometric[g]
        values[k, 0] = np.nan if hidden[plan.first[g]] or hidden[plan.second[g]] else measured[g, 0]
        spreads[k, 0] = of_operands[plan.first[g]] + of_operands[plan.second[g]]
    for y in range(len(plan.yaws)):
        k, a, b = plan.yaws[y, 0], plan.yaws[y, 1], plan.yaws[y, 2]
        values[k, 0], spreads[k, 0] = misalignment_of(rows.yaw[a], rows.yaw[b]), 0.0
    for k in range(len(values)):
        for at in range(plan.listed_start[required + k], plan.listed_start[required + k + 1]):
            if rows.classes[plan.listed_rows[at]] == ABSENT:
                values[k, 0] = np.nan


@inlined
def _closest(plan: PlanArrays, rows: SampleRows, closest: Floats) -> None:
    """Fill `closest` (K, 4, 1), as `measurements.leaf_values` computes it."""
    if len(closest) == 0:
        return
    found, operands = np.empty((1, 3)), len(plan.enlargement)
    for k in range(len(closest)):
        begin, end = plan.listed_start[operands + k], plan.listed_start[operands + k + 1]
        members = np.empty((1, end - begin), np.int64)
        there = hidden = 0
        for m in range(begin, end):
            row, members[0, m - begin] = plan.listed_rows[m], ABSENT
            if not _is_there(rows.classes, row, plan.listed_classes[m]):
                continue
            there += 1
            if _is_hidden(plan, rows, row):
                hidden += 1
            else:
                members[0, m - begin] = row
        closest_rows(
            rows.part_start,
            rows.vertex_start,
            rows.vertices,
            rows.radius,
            rows.bottom,
            rows.top,
            members,
            rows.uncertainty,
            plan.closest_enlargement[k],
            rows.edges,
            found,
        )
        closest[k, 0, 0] = closest[k, 1, 0] = found[0, 0]
        closest[k, 2, 0], closest[k, 3, 0] = found[0, 1], found[0, 2]
        if hidden > 0 and there > 1:  # it may be anywhere, and so may be the closest
            closest[k, 0, 0] = closest[k, 2, 0] = -np.inf


@inlined
def _members(plan: PlanArrays, classes: Integers, members: Integers) -> None:
    """Fill `members` (M, 1): whether each binding is one (1, 0), or that is not known (-1)."""
    first = len(plan.enlargement) + len(plan.closest_enlargement)
    for m in range(len(members)):
        members[m, 0] = 0 if plan.is_group[m] else 1
        for k in range(plan.listed_start[first + m], plan.listed_start[first + m + 1]):
            if not _is_there(classes, plan.listed_rows[k], plan.listed_classes[k]):
                members[m, 0] = -1 if plan.is_group[m] else 0


@inlined
def _channels_of(
    values: Floats, spreads: Floats, signals: Floats, closest: Floats, members: Integers, constants: Floats
) -> int:
    """Return the number of channels needed: 4 with uncertainty, 2 with anything unknown, else 1."""
    channels = 1
    for k in range(len(constants)):
        if -np.inf < constants[k] <= TEXTS:
            channels = 2
    for k in range(len(closest)):
        if closest[k, 2, 0] != closest[k, 0, 0] or closest[k, 3, 0] != closest[k, 1, 0]:
            return 4
        if closest[k, 0, 0] != closest[k, 1, 0]:
            channels = 2
    for k in range(len(values)):
        if spreads[k, 0] != 0.0:
            return 4
        if not np.isfinite(values[k, 0]):
            channels = 2
    for k in range(len(signals)):
        if not np.isfinite(signals[k, 0]) or signals[k, 0] <= TEXTS:
            channels = 2
    for k in range(len(members)):
        if members[k, 0] < 0:
            channels = 2
    return channels


@kernel
def measure_sample(whole: Integers, real: Floats, sample: Floats, end: int, leaves: Floats) -> int:
    """Compute the leaves of one sample, (C, A, 1), as `leaf_values` does.

    Args:
        whole, real: of a `PackedPlan`.
        sample: 0 or `ABSENT` for each sample, then the value of each signal. If the plan distinguishes
            classes, the class code of each place follows. Last comes each place's `packed` object: without
            parts if it is absent, with -1 parts if its place is unknown. Room to work in begins at `end`.
        leaves: (MOST_CHANNELS, A, 1), receives them.

    Returns:
        C, in how many channels they are.
    """
    plan = plan_at(whole, real)
    count, groups, pairs = (
        len(plan.geometric) + len(plan.yaws),
        len(plan.is_group),
        len(plan.closest_enlargement),
    )
    room = sample[end:]  # a new array would take as long as a distance
    values, spreads = room[:count].reshape((-1, 1)), room[count : 2 * count].reshape((-1, 1))
    closest = room[2 * count : 2 * count + 4 * pairs].reshape((-1, 4, 1))
    members = room[2 * count + 4 * pairs : 2 * count + 4 * pairs + groups].view(np.int64).reshape((-1, 1))
    if count + groups + pairs > 0:  # not signals alone
        begin, operands = 2 * count + 4 * pairs + groups, len(plan.enlargement)
        after = begin + 3 * operands + 2 + len(plan.geometric) + plan.listed_start[operands]
        rows = _rows_of_sample(plan, sample, room[after:])
        _members(plan, rows.classes, members)
        _closest(plan, rows, closest)
        _measure(plan, rows, values, spreads, room[begin:after])
    signals = sample[plan.extent[0] : plan.extent[0] + plan.extent[3]].reshape((-1, 1))
    channels = _channels_of(values, spreads, signals, closest, members, plan.constants)
    for t in range(1):  # as in `_measure`
        run_instructions(
            plan.code, plan.constants, values, spreads, signals, closest, members, plan.outputs,
            leaves[:channels], t, t + 1,
        )  # fmt: skip
    return channels


class SampleRoom:
    """The newest sample of a stream, as kernels take it; the next one takes its place.

    Attributes:
        whole, real: of the plan that it fits into.
        numbers, end: what `measure_sample` takes as `sample`.
        leaves: (MOST_CHANNELS, A, 1), once they are measured.
        channels: in how many of them the leaves differ; 0 until they are measured.
    """

    __slots__ = ("_bytes", "channels", "end", "leaves", "numbers", "real", "whole")

    def __init__(self, leaves: int) -> None:
        self.whole, self.real = np.zeros(0, np.int64), np.zeros(0)
        self.leaves, self.channels = np.empty((MOST_CHANNELS, leaves, 1)), 0
        self._bytes, self.end = bytearray(), 0

    def fill(self, plan: PackedPlan, layout: Struct, numbers: Sequence[float], objects: list[bytes]) -> None:
        """Take the next sample: a plan for it, its numbers, and the packed objects of its places."""
        self.whole, self.real, self.channels = plan.whole, plan.real, 0
        packed = b"".join(objects)
        begin, end = layout.size, layout.size + len(packed)
        size = end + 8 * plan.room + 3 * len(packed)
        if size > len(self._bytes):
            self._bytes = bytearray(2 * size)
            self.numbers = np.frombuffer(self._bytes)
        layout.pack_into(self._bytes, 0, *numbers)
        self._bytes[begin:end] = packed
        self.end = end >> 3

    def measure(self) -> Floats:
        """Return the leaves of the sample, (C, A, 1)."""
        self.channels = measure_sample(self.whole, self.real, self.numbers, self.end, self.leaves)
        return self.leaves[: self.channels]


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
    """An object in one of the samples looked at, or the point at its centre.

    Attributes:
        rate: the terms of the rate that moves it back, if any does.
    """

    sample: int
    name: str
    is_centre: bool
    rate: tuple[Term, ...] = ()


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
        base = term.term if isinstance(term, Earlier) else term
        rate = term.rate if isinstance(term, Earlier) else ()
        place = partial(self._place, self._sample_of(term), is_centre=is_point, rate=rate)
        if isinstance(base, RegionName):
            return [Row(self._region[Centre(base) if is_point else base])]
        if not isinstance(base, Group):
            return [Row(place(base.name))]
        if base.members is None:
            wanted = self._class_wanted(base)
            return [Row(place(name), wanted) for name in self.candidates(base)]
        return [Row(place(name)) for name in named_members(base)]

    def required(self, term: Term) -> list[Row]:
        """Return the rows, its sample's among them, without which a term is unknown."""
        then, base = standing(term), base_of(term)
        sample = [Row(self._sample_of(then))] if isinstance(then, Earlier) else []
        if isinstance(base, RegionName) or (isinstance(base, Group) and base.members is None):
            return sample
        return sample + self.of_term(term)

    def _sample_of(self, term: Term) -> int:
        return self._sample[Delay.of(term) if isinstance(term, Earlier) else NO_DELAY]

    def _class_wanted(self, group: Group) -> int:
        if group.class_name == ANY_CLASS:
            return ANY
        return self._frame.classes[(group.class_name or "").casefold()]

    def _place(self, sample: int, name: str, *, is_centre: bool = False, rate: tuple[Term, ...] = ()) -> int:
        first = len(self._sample) + len(self._region)
        return self.places.setdefault(Place(sample, name, is_centre, rate), first + len(self.places))


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
        terms = [place.rate for place in rows.places]
        terms += [signal.terms for signal in code.signals if isinstance(signal, ReportStep)]
        self._rates: tuple[tuple[Term, ...], ...] = tuple(filter(None, dict.fromkeys(terms)))
        numbers = {rate: number for number, rate in enumerate(self._rates)}
        self._places = tuple((*place[:3], numbers.get(place.rate)) for place in rows.places)
        steps = (
            numbers.get(signal.terms) if isinstance(signal, ReportStep) else None for signal in code.signals
        )
        self._signals = tuple(
            (signal.name if type(signal) is Signal else None, signal, step)
            for signal, step in zip(code.signals, steps, strict=True)
        )
        self._has_classes = bool(frame.classes)
        count = len(frame.delays) + len(self._signals) + (len(self._places) if self._has_classes else 0)
        self._layout = Struct(f"={count}d")

    def fill(
        self,
        room: SampleRoom,
        samples: Sequence[Sample | None],
        stands_for: Mapping[str, str],
        code_of: Callable[[str | None], int],
        reports: RecentReports,
    ) -> None:
        """Flatten samples for `measure_sample`.

        Args:
            room: receives them.
            samples: the one at each of the frame's delays; None before the first.
            stands_for: the objects that go by another name among the plan's members.
            code_of: returns that of a class.
            reports: those that the newest sample shows.
        """
        newest: Any = samples[0]
        numbers = [0.0]
        if len(samples) > 1:
            numbers = [0.0 if sample else ABSENT for sample in samples]
        steps = [_step(rate, newest, reports, stands_for) for rate in self._rates] if self._rates else []
        for plain_name, signal, rate in self._signals:
            if plain_name is not None:
                numbers.append(newest.signals.get(plain_name, nan))
            elif rate is not None:
                numbers.append(steps[rate])
            elif isinstance(signal, Present):
                name = stands_for.get(signal.term.name, signal.term.name)
                numbers.append(name in newest.objects or name in newest.unknown)
            else:
                numbers.append(_signal(signal, newest, reports))
        packed: list[bytes] = []
        lookups = [newest.objects.get]
        if len(samples) > 1:
            lookups = [sample.objects.get if sample else _NOTHING_THERE for sample in samples]
        for place, name, is_point, rate in self._places:
            name = stands_for.get(name, name) if stands_for else name
            tracked: Any = lookups[place](name)
            if rate is not None and tracked is not None:
                class_name = tracked.class_name
                tracked = reports.moved_back(name, newest, steps[rate])
                if tracked is None:
                    packed.append(_HIDDEN)
                    if self._has_classes:
                        numbers.append(code_of(class_name))
                    continue
            if tracked is not None:
                packed += reports.packed_centre(name, tracked) if is_point else tracked.packed
                if self._has_classes:
                    numbers.append(code_of(tracked.class_name))
                continue
            unknown: Any = _NOTHING if samples[place] is None else cast(Sample, samples[place]).unknown
            packed.append(_HIDDEN if name in unknown else _NOT_THERE)
            if self._has_classes:
                numbers.append(code_of(unknown[name]) if name in unknown else 0.0)
        room.fill(self.packed, self._layout, numbers, packed)


def _signal(signal: Signal, sample: Sample, reports: RecentReports) -> float:
    """Return what `TraceScene.signal` does of one sample."""
    if isinstance(signal, ReportStep | PreviousSignal):
        latest = reports.of.get(signal.signal or signal)
        if latest is None or latest.before is None:
            return nan
        return latest.seconds if isinstance(signal, ReportStep) else float(latest.before.value)
    if isinstance(signal, ComputedSignal):
        return computed_signal(signal, sample)
    return sample.signals.get(signal.name, nan)


def _step(
    terms: Sequence[Term], sample: Sample, reports: RecentReports, stands_for: Mapping[str, str]
) -> float:
    """Return the shortest time between two reports of what moves in some terms."""
    if stands_for:
        names = {name: TrackedName(other) for name, other in stands_for.items()}
        terms = [names.get(term.name, term) if isinstance(term, TrackedName) else term for term in terms]
    return reports.step(terms, sample)


_NOTHING_THERE: Callable[[str], None] = MappingProxyType[str, None]({}).get
_NOT_THERE, _HIDDEN = (Struct("=5d").pack(parts, nan, nan, nan, 0.0) for parts in (0.0, -1.0))


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
    listed = [rows.of_term(term) for term in operands]
    listed += [rows.of_term(each.group) for each in code.closest]
    listed += [rows.of_membership(each) for each in code.members]
    listed += [[row for term in measured_terms(each) for row in rows.required(term)] for each in measurements]
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
        listed_start=starts_from_counts(list(map(len, listed))),
        listed_rows=_whole(each.row for among in listed for each in among),
        listed_classes=_whole(each.class_code for among in listed for each in among),
        enlargement=np.array([_enlargement(term) for term in operands], np.float64),
        geometric=_whole(geometric),
        quantity=_whole(QUANTITY_CODES[quantity_of(measurements[k])] for k in geometric),
        first=_whole(pair[0] for pair in pairs),
        second=_whole(pair[1] if len(pair) > 1 else ABSENT for pair in pairs),
        yaws=np.array(yaws, np.int64).reshape(len(yaws), 3),
        closest_enlargement=np.array([each.enlargement for each in code.closest], np.float64),
        is_group=_whole(not each.chosen for each in code.members),
        code=np.array(list(code.rows), np.int64).reshape(len(code.rows), 4),
        constants=np.array(list(code.constants), np.float64),
        outputs=_whole(outputs),
    )


def _whole(numbers: Iterable[int]) -> Integers:
    return np.array(list(numbers), np.int64)


def _enlargement(term: Term) -> float:
    """Return the total enlargement of a term, summed in the order in which `TraceScene` sums it."""
    return _enlargement(term.term) + term.radius if isinstance(term, Enlarged) else 0.0


MOST_PLANS = 64
_MOST_BYTES = 1 << 22
"""Limits on stored plans, by number and memory; the least recently used go first, never the newest."""
_MOST_CLASSES = 1024
"""Classes whose codes are kept: objects name them in any case."""

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
        self._reports = _reports_needed(formulas)
        self._takes_any = ANY_CLASS in open_classes
        self._own_names = _names(bases)
        self._prefix = "?"
        while any(name.startswith(self._prefix) for name in self._own_names):
            self._prefix += "?"
        self._own_members: frozenset[Member] = frozenset()  # grows, but no further than the specification
        self._code_of = lru_cache(_MOST_CLASSES)(partial(_class_code, self._frame.classes))
        self._plans: dict[tuple[frozenset[Member], _Counts], LeafPlan] = {}
        self._only_plan = None if open_classes else LeafPlan(self._frame, frozenset(), {})
        self._looks_back = len(self._frame.delays) > 1 or bool(
            next(chain.from_iterable(map(rates_of, formulas)), None)
        )
        self.room = SampleRoom(len(formulas))

    def look_at(self, sample: Sample) -> Sequence[Sample | None]:
        """Add the next sample; return it and those that it looks back at."""
        if not self._looks_back:
            return (sample,)
        self._reports.add(sample)
        return self._recent.add(sample)

    def fill_room(self, sample: Sample) -> SampleRoom:
        """Add the next sample, and flatten it and those that it looks back at for kernels.

        Raises:
            UsageError: more bindings than `MAX_BINDINGS`.
        """
        samples = self.look_at(sample)
        plan, stands_for = self._only_plan, _NOTHING
        if plan is None:
            plan, stands_for = self._fitting_plan(samples)
        plan.fill(self.room, samples, stands_for, self._code_of, self._reports)
        return self.room

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
        code_of, takes_any, own_names = self._code_of, self._takes_any, self._own_names
        for sample in filter(None, samples):
            objects: Any = sample.objects
            coded = [code_of(each.class_name) for each in objects.values()]
            coded += map(code_of, sample.unknown.values())
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
        key, plans = (self._own_members, tuple(sorted(counts.items()))), self._plans
        plan = plans.pop(key, None)
        if plan is None:
            plan = _plan(self._frame, self._prefix, *key)
            room = _MOST_BYTES - plan.packed.nbytes
            while plans and (len(plans) >= MOST_PLANS or sum(p.packed.nbytes for p in plans.values()) > room):
                del plans[next(iter(plans))]
        plans[key] = plan
        return plan


def _reports_needed(formulas: Sequence[Formula]) -> RecentReports:
    """Return an empty memory of the reports that the rates in some formulas compare."""
    rates = [rate for formula in formulas for rate in rates_of(formula)]
    bases = [base_of(term) for rate in rates for term in rate.terms]
    is_any = any(isinstance(base, Variable) or (isinstance(base, Group) and base.is_open) for base in bases)
    signals = dict.fromkeys(rate.signal for rate in rates if rate.signal is not None)
    return RecentReports(None if is_any else _names(bases), signals)


def _plan(frame: PlanContext, prefix: str, own_members: frozenset[Member], counts: _Counts) -> LeafPlan:
    """Return the plan for the given number of unnamed members of each kind."""
    # names that the specification does not use
    placeholders = {
        classes: [f"{prefix}{classes} {number}" for number in range(count)] for classes, count in counts
    }
    unnamed = {
        Member(name, code) for classes, names in placeholders.items() for name in names for code in classes
    }
    return LeafPlan(frame, own_members | unnamed, placeholders)


def _class_code(classes: Mapping[str, int], name: str | None) -> int:
    """Return the code of a class as an object names it; 0 of one that no group asks for."""
    return classes.get((name or "").casefold(), 0)


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
