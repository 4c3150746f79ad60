"""The leaves of single samples, for monitors: plans are compiled once and reused.

Most samples differ in their numbers, not in their names. A plan stores everything that depends on names as
index arrays, so a sample only has to copy its numbers. A plan serves every sample whose members of open
groups fit into the plan. An object that is missing from a sample only needs a flag.

Without open groups, one plan serves all samples. Otherwise a plan depends on the number of members. The plan
has placeholders for objects that the specification does not name, because these objects differ only in their
classes. Each sample assigns its objects to placeholders, so tracks with new names need no new plan.
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
from spatial_replay.geometry.kernels import QUANTITY_CODES, measure_rows
from spatial_replay.geometry.measure import closest_rows, misalignment_of
from spatial_replay.monitor.atoms.instructions import LeafCode, Membership, run_instructions
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
    named_members,
    rates_of,
    standing,
)
from spatial_replay.text import TEXTS
from spatial_replay.trace.trace import Sample

ABSENT = -1
ANY = -1
"""Class code that stands for any class."""

MOST_CHANNELS = 4
"""Limit on channels of leaves (see `online.codes`)."""

_OF_OBJECT, _OF_PART = 5, 2
"""Number of values before the parts of a packed object, and before the vertices of a part."""


class PlanArrays(NamedTuple):
    """The arrays of a plan, which are the same for every sample. Ragged lists have offsets of their rows.

    Attributes:
        region_parts: number of parts of each region's footprint.
        region_sizes: number of vertices of each part.
        region_radius: radius of each part.
        region_vertices: x and y of all vertices.
        region_heights: (bottom, top) of each region.
        listed_start: offsets of the lists in `listed_rows`: one list for each operand, then one list for each
            closest pair, each binding, and each measurement.
        listed_rows: rows of an operand, rows of a pair's group, rows needed for a binding, and rows without
            which a measurement is unknown.
        listed_classes: the class that each listed row must have, or `ANY`.
        enlargement: enlargement of each operand.
        geometric: numbers of the measurements between footprints, with a `quantity` and the operands `first`
            and `second`, which is -1 for a single operand.
        yaws: (Y, 3), number of each measurement between orientations, and its two rows.
        closest_enlargement: total enlargement of each closest pair.
        is_group: 1 for a binding that stands for a whole group. The group's members are unknown in samples
            without the listed row.
        code, constants, outputs: arguments of `run_instructions`.
    """

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


class PlanExtent(NamedTuple):
    """Counts of samples, regions, places, signals, and class codes of places in a plan."""

    samples: int
    regions: int
    places: int
    signals: int
    coded: int


class PackedPlan(NamedTuple):
    """A plan's arrays joined into two arrays, because each array argument costs time in a kernel.

    Attributes:
        whole: the fields of `PlanPlaces`, then the integer arrays.
        real: the float arrays.
        room: size of the work space of `measure_sample`, entries. The space that depends on the sample's
            objects, three entries per packed number, is not included.
    """

    whole: Integers
    real: Floats
    room: int

    @property
    def nbytes(self) -> int:
        """Size of both arrays in bytes."""
        return self.whole.nbytes + self.real.nbytes

    @classmethod
    def of(cls, extent: PlanExtent, arrays: PlanArrays) -> PackedPlan:
        fields = extent._asdict() | {
            "parts": len(arrays.region_radius),
            "corners": len(arrays.region_vertices) // 2,
            "operands": len(arrays.enlargement),
            "geometric_count": len(arrays.geometric),
            "yaw_count": len(arrays.yaws),
            "pairs": len(arrays.closest_enlargement),
            "groups": len(arrays.is_group),
        }
        header = np.zeros(len(PlanPlaces._fields), np.int64)
        integer_arrays, float_arrays = [header], [np.zeros(0)]
        for name, array in arrays._asdict().items():
            joined_arrays = integer_arrays if array.dtype == np.int64 else float_arrays
            fields[name] = sum(map(len, joined_arrays))
            fields[f"{name}_end"] = fields[name] + array.size
            joined_arrays.append(array.ravel())
        header[:] = [fields[name] for name in PlanPlaces._fields]
        operand_count = fields["operands"]
        room = 3 * (fields["geometric_count"] + fields["yaw_count"]) + 4 * fields["pairs"] + fields["groups"]
        room += 3 * operand_count + 2 + int(arrays.listed_start[operand_count])
        room += 6 * (extent.samples + extent.regions + extent.places) + 2
        room += 2 * fields["parts"] + 6 * fields["corners"]
        return cls(np.concatenate(integer_arrays), np.concatenate(float_arrays), room)


class PlanPlaces(NamedTuple):
    """Begins and ends of a plan's arrays in `PackedPlan.whole` and `PackedPlan.real`, and counts.

    The begin of an array has the array's name, and its end has the suffix `_end`. Kernels get these numbers
    instead of a tuple of arrays, because kernels manage a reference count for each array.

    Attributes:
        samples, regions, places, signals, coded: the plan's extent.
        parts, corners: numbers of parts and vertices of all regions.
    """

    samples: int
    regions: int
    places: int
    signals: int
    coded: int
    parts: int
    corners: int
    operands: int
    geometric_count: int
    yaw_count: int
    pairs: int
    groups: int
    region_parts: int
    region_sizes: int
    region_radius: int
    region_vertices: int
    region_heights: int
    listed_start: int
    listed_rows: int
    listed_classes: int
    enlargement: int
    geometric: int
    quantity: int
    first: int
    second: int
    yaws: int
    closest_enlargement: int
    is_group: int
    code: int
    code_end: int
    constants: int
    constants_end: int
    outputs: int
    outputs_end: int


@inlined
def plan_at(whole: Integers) -> PlanPlaces:
    """Read the fields that `PackedPlan.of` writes first, in their order.

    The compiler needs one index per field, so the indices are written out.
    """
    return PlanPlaces(
        whole[0], whole[1], whole[2], whole[3], whole[4], whole[5], whole[6], whole[7], whole[8], whole[9],
        whole[10], whole[11], whole[12], whole[13], whole[14], whole[15], whole[16], whole[17], whole[18],
        whole[19], whole[20], whole[21], whole[22], whole[23], whole[24], whole[25], whole[26], whole[27],
        whole[28], whole[29], whole[30], whole[31], whole[32], whole[33],
    )  # fmt: skip


class RowPlaces(NamedTuple):
    """Begins of the row arrays in the work space of one sample, in the layout of `measure_rows`.

    Attributes:
        rows, parts, corners: numbers of rows, parts and vertices.
        classes: class code of each row.
        yaw, uncertainty: yaw and uncertainty of each row; NaN and 0 for samples and regions.
        edges: (V, 4), work space of `measure_rows`.
    """

    rows: int
    parts: int
    corners: int
    classes: int
    part_start: int
    vertex_start: int
    vertices: int
    radius: int
    bottom: int
    top: int
    yaw: int
    uncertainty: int
    edges: int


@inlined
def _rows_at(plan: PlanPlaces, sample: Floats, begin: int) -> RowPlaces:
    """Return the places of a sample's rows in the work space from `begin` on."""
    rows = plan.samples + plan.regions + plan.places
    parts, corners, cursor = plan.parts, plan.corners, plan.samples + plan.signals + plan.coded
    for _ in range(plan.places):
        part_count = max(int(sample[cursor + PARTS]), 0)
        cursor += _OF_OBJECT
        parts += part_count
        for _ in range(part_count):
            vertex_count = int(sample[cursor])
            cursor += _OF_PART + 2 * vertex_count
            corners += vertex_count
    vertices = begin + 4 * rows + parts
    classes = vertices + 6 * corners
    return RowPlaces(
        rows=rows,
        parts=parts,
        corners=corners,
        classes=classes,
        part_start=classes + rows,
        vertex_start=classes + 2 * rows + 1,
        vertices=vertices,
        radius=begin + 4 * rows,
        bottom=begin,
        top=begin + rows,
        yaw=begin + 2 * rows,
        uncertainty=begin + 3 * rows,
        edges=vertices + 2 * corners,
    )


@inlined
def _fill_rows(
    plan: PlanPlaces, rows: RowPlaces, whole: Integers, real: Floats, sample: Floats, lists: Integers
) -> None:
    """Copy the regions of a plan and the objects of a sample into rows."""
    samples, object_begin = plan.samples, plan.samples + plan.regions
    lists[rows.part_start] = lists[rows.vertex_start] = 0
    for index in range(object_begin):
        lists[rows.classes + index] = int(sample[index]) if index < samples else 0
        region_part_count = 0 if index < samples else whole[plan.region_parts + index - samples]
        lists[rows.part_start + index + 1] = lists[rows.part_start + index] + region_part_count
        height_index = plan.region_heights + 2 * (index - samples)
        sample[rows.bottom + index] = np.nan if index < samples else real[height_index]
        sample[rows.top + index] = np.nan if index < samples else real[height_index + 1]
        sample[rows.yaw + index], sample[rows.uncertainty + index] = np.nan, 0.0
    for part_index in range(plan.parts):
        lists[rows.vertex_start + part_index + 1] = (
            lists[rows.vertex_start + part_index] + whole[plan.region_sizes + part_index]
        )
        sample[rows.radius + part_index] = real[plan.region_radius + part_index]
    for index in range(2 * plan.corners):
        sample[rows.vertices + index] = real[plan.region_vertices + index]
    first_part, codes_begin = plan.parts, samples + plan.signals
    cursor = codes_begin + plan.coded
    for row in range(object_begin, rows.rows):
        part_count = max(int(sample[cursor + PARTS]), 0)
        lists[rows.classes + row] = int(sample[codes_begin + row - object_begin]) if plan.coded > 0 else 0
        if sample[cursor + PARTS] == 0.0:
            lists[rows.classes + row] = ABSENT
        lists[rows.part_start + row + 1] = first_part + part_count
        sample[rows.bottom + row], sample[rows.top + row] = sample[cursor + BOTTOM], sample[cursor + TOP]
        sample[rows.yaw + row], sample[rows.uncertainty + row] = (
            sample[cursor + YAW],
            sample[cursor + UNCERTAINTY],
        )
        cursor += _OF_OBJECT
        for part_index in range(first_part, first_part + part_count):
            first_vertex, vertex_count = lists[rows.vertex_start + part_index], int(sample[cursor])
            sample[rows.radius + part_index] = sample[cursor + 1]
            cursor += _OF_PART
            for index in range(2 * vertex_count):
                sample[rows.vertices + 2 * first_vertex + index] = sample[cursor + index]
            cursor += 2 * vertex_count
            lists[rows.vertex_start + part_index + 1] = first_vertex + vertex_count
        first_part += part_count


@inlined
def _is_there(lists: Integers, classes: int, row: int, class_code: int) -> bool:
    return lists[classes + row] != ABSENT and class_code in (ANY, lists[classes + row])


@inlined
def _is_hidden(plan: PlanPlaces, rows: RowPlaces, lists: Integers, row: int) -> bool:
    """Return whether a present object has an unknown position."""
    start = rows.part_start + row
    return bool(row >= plan.samples + plan.regions and lists[start] == lists[start + 1])


@inlined
def _measure(
    plan: PlanPlaces, rows: RowPlaces, whole: Integers, real: Floats, sample: Floats, lists: Integers,
    values: int, begin: int,
) -> None:  # fmt: skip
    """Write K values at `values`, then K spreads, equal to those of `measurements.measurement_values`.

    Args:
        begin: begin of the work space for operands.
    """
    operand_count, measurement_count = plan.operands, plan.geometric_count + plan.yaw_count
    spreads, list_starts = values + measurement_count, plan.listed_start
    operand_spreads, measured_begin = begin, begin + operand_count + 1
    widths = measured_begin + plan.geometric_count
    hidden, members = widths + operand_count, widths + 2 * operand_count + 1
    sample[operand_spreads + operand_count], lists[hidden + operand_count] = (
        0.0,
        0,
    )  # entry of the missing second operand of a measurement
    for operand in range(operand_count):
        list_begin, list_end = whole[list_starts + operand], whole[list_starts + operand + 1]
        lists[widths + operand], lists[hidden + operand], spread = list_end - list_begin, 0, 0.0
        for index in range(list_begin, list_end):
            row, lists[members + index] = whole[plan.listed_rows + index], ABSENT
            if not _is_there(lists, rows.classes, row, whole[plan.listed_classes + index]):
                continue
            if _is_hidden(plan, rows, lists, row):
                lists[hidden + operand] = 1
            else:
                lists[members + index] = row
                spread = max(spread, sample[rows.uncertainty + row])
        sample[operand_spreads + operand] = spread
    # a literal 0 has a numba type of its own, for which `measure_rows` would be compiled once more
    zero = min(operand_count, 0)
    measure_rows(
        lists[rows.part_start : rows.part_start + rows.rows + 1],
        lists[rows.vertex_start : rows.vertex_start + rows.parts + 1],
        sample[rows.vertices : rows.edges].reshape((-1, 2)),
        sample[rows.radius : rows.vertices],
        sample[rows.bottom : rows.top],
        sample[rows.top : rows.yaw],
        lists[members : members + whole[list_starts + operand_count]],
        whole[list_starts : list_starts + operand_count + 1],
        lists[widths:hidden],
        real[plan.enlargement : plan.enlargement + operand_count],
        whole[plan.quantity : plan.quantity + plan.geometric_count],
        whole[plan.first : plan.first + plan.geometric_count],
        whole[plan.second : plan.second + plan.geometric_count],
        sample[rows.edges : rows.classes].reshape((-1, 4)),
        sample[measured_begin:widths].reshape((-1, 1)),
        zero,
        zero + 1,
    )
    for geometric_index in range(plan.geometric_count):
        index, first_operand, second_operand = (
            whole[plan.geometric + geometric_index],
            whole[plan.first + geometric_index],
            whole[plan.second + geometric_index],
        )
        first_operand, second_operand = (
            first_operand,
            second_operand if second_operand >= 0 else operand_count,
        )
        is_hidden = lists[hidden + first_operand] != 0 or lists[hidden + second_operand] != 0
        sample[values + index] = np.nan if is_hidden else sample[measured_begin + geometric_index]
        sample[spreads + index] = (
            sample[operand_spreads + first_operand] + sample[operand_spreads + second_operand]
        )
    for yaw_index in range(plan.yaw_count):
        entry = plan.yaws + 3 * yaw_index
        index, first_operand, second_operand = whole[entry], whole[entry + 1], whole[entry + 2]
        sample[values + index] = misalignment_of(
            sample[rows.yaw + first_operand], sample[rows.yaw + second_operand]
        )
        sample[spreads + index] = 0.0
    required_starts = list_starts + operand_count + plan.pairs + plan.groups
    for index in range(measurement_count):
        for entry in range(whole[required_starts + index], whole[required_starts + index + 1]):
            if lists[rows.classes + whole[plan.listed_rows + entry]] == ABSENT:
                sample[values + index] = np.nan


@inlined
def _closest(
    plan: PlanPlaces, rows: RowPlaces, whole: Integers, real: Floats, sample: Floats, lists: Integers,
    closest: int,
) -> None:  # fmt: skip
    """Write the ends (K, 4) of the closest pairs at `closest`, equal to those in `leaf_values`."""
    nearest_distances = np.empty((1, 3))
    for pair in range(plan.pairs):
        list_index = plan.listed_start + plan.operands + pair
        begin, end = whole[list_index], whole[list_index + 1]
        member_rows = np.empty((1, end - begin), np.int64)
        present_count = hidden_count = 0
        for index in range(begin, end):
            row, member_rows[0, index - begin] = whole[plan.listed_rows + index], ABSENT
            if not _is_there(lists, rows.classes, row, whole[plan.listed_classes + index]):
                continue
            present_count += 1
            if _is_hidden(plan, rows, lists, row):
                hidden_count += 1
            else:
                member_rows[0, index - begin] = row
        closest_rows(
            lists[rows.part_start : rows.part_start + rows.rows + 1],
            lists[rows.vertex_start : rows.vertex_start + rows.parts + 1],
            sample[rows.vertices : rows.edges].reshape((-1, 2)),
            sample[rows.radius : rows.vertices],
            sample[rows.bottom : rows.top],
            sample[rows.top : rows.yaw],
            member_rows,
            sample[rows.uncertainty : rows.radius],
            real[plan.closest_enlargement + pair],
            sample[rows.edges : rows.classes].reshape((-1, 4)),
            nearest_distances,
        )
        pair_begin = closest + 4 * pair
        sample[pair_begin] = sample[pair_begin + 1] = nearest_distances[0, 0]
        sample[pair_begin + 2], sample[pair_begin + 3] = nearest_distances[0, 1], nearest_distances[0, 2]
        if hidden_count > 0 and present_count > 1:  # a hidden member may belong to the closest pair
            sample[pair_begin] = sample[pair_begin + 2] = -np.inf


@inlined
def _members(plan: PlanPlaces, classes: int, whole: Integers, lists: Integers, members: int) -> None:
    """Write for each binding, at `members`, whether all its objects are members: 1, 0, or -1 if unknown."""
    first_list = plan.listed_start + plan.operands + plan.pairs
    for binding in range(plan.groups):
        is_group = whole[plan.is_group + binding] != 0
        lists[members + binding] = 0 if is_group else 1
        for index in range(whole[first_list + binding], whole[first_list + binding + 1]):
            row, class_code = whole[plan.listed_rows + index], whole[plan.listed_classes + index]
            if not _is_there(lists, classes, row, class_code):
                lists[members + binding] = -1 if is_group else 0


@inlined
def _channels_of(
    values: Floats, spreads: Floats, signals: Floats, closest: Floats, members: Integers, constants: Floats
) -> int:
    """Return the number of channels: 4 with an uncertain value, 2 with an unknown value, else 1."""
    channel_count = 1
    for index in range(len(constants)):
        if -np.inf < constants[index] <= TEXTS:
            channel_count = max(channel_count, 2)
    for index in range(0, len(closest), 4):
        if closest[index + 2] != closest[index] or closest[index + 3] != closest[index + 1]:
            channel_count = 4
        elif closest[index] != closest[index + 1]:
            channel_count = max(channel_count, 2)
    for index in range(len(values)):
        if spreads[index] != 0.0:
            channel_count = 4
        elif not np.isfinite(values[index]):
            channel_count = max(channel_count, 2)
    for index in range(len(signals)):
        if not np.isfinite(signals[index]) or signals[index] <= TEXTS:
            channel_count = max(channel_count, 2)
    for index in range(len(members)):
        if members[index] < 0:
            channel_count = max(channel_count, 2)
    return channel_count


@kernel
def measure_sample(whole: Integers, real: Floats, sample: Floats, end: int, leaves: Floats) -> int:
    """Compute the leaves (C, A, 1) of one sample, equal to the leaves of `leaf_values`.

    Args:
        whole, real: arrays of a `PackedPlan`.
        sample: 0 or `ABSENT` for each sample that the plan reads, then the value of each signal. If the plan
            distinguishes classes, the class code of each place follows. The `packed` object of each place
            comes last. It has 0 parts for an absent object, and -1 parts for an unknown position.
        end: end of the sample's numbers, where the work space begins.
        leaves: (MOST_CHANNELS, A, 1), output.

    Returns:
        C, the number of channels in use.
    """
    # the work space holds floats and integers in one buffer
    plan, lists = plan_at(whole), sample.view(np.int64)
    measurement_count = plan.geometric_count + plan.yaw_count
    # a work space for results, operands and rows, because allocation would take as long as the distances
    closest_begin, members_begin = end + 2 * measurement_count, end + 2 * measurement_count + 4 * plan.pairs
    work_begin = members_begin + plan.groups
    if measurement_count + plan.groups + plan.pairs > 0:  # otherwise the plan has only signals
        operand_room = 3 * plan.operands + 2 + plan.geometric_count + whole[plan.listed_start + plan.operands]
        rows = _rows_at(plan, sample, work_begin + operand_room)
        _fill_rows(plan, rows, whole, real, sample, lists)
        _members(plan, rows.classes, whole, lists, members_begin)
        if plan.pairs > 0:
            _closest(plan, rows, whole, real, sample, lists, closest_begin)
        if measurement_count > 0:
            _measure(plan, rows, whole, real, sample, lists, end, work_begin)
    values, spreads = sample[end : end + measurement_count], sample[end + measurement_count : closest_begin]
    signals = sample[plan.samples : plan.samples + plan.signals]
    pair_ends, memberships, constants = (
        sample[closest_begin:members_begin],
        lists[members_begin:work_begin],
        real[plan.constants : plan.constants_end],
    )
    channel_count = _channels_of(values, spreads, signals, pair_ends, memberships, constants)
    zero = min(measurement_count, 0)  # not a literal 0, as in `_measure`
    run_instructions(
        whole[plan.code : plan.code_end], constants, values, spreads, signals, pair_ends, memberships,
        whole[plan.outputs : plan.outputs_end], leaves[:channel_count], zero, zero + 1,
    )  # fmt: skip
    return channel_count


class SampleRoom:
    """Memory for the newest sample of a stream, in the layout of kernels.

    Args:
        leaves: number of leaves.

    Attributes:
        arguments: arguments of `measure_sample`.
        leaves: (MOST_CHANNELS, A, 1), measured leaves.
        channels: number of channels in use; 0 before the leaves are measured.
    """

    __slots__ = ("_bytes", "_numbers", "_objects_length", "_plan", "arguments", "channels", "leaves")

    def __init__(self, leaves: int) -> None:
        self.leaves, self.channels = np.empty((MOST_CHANNELS, leaves, 1)), 0
        self.arguments: tuple[Integers, Floats, Floats, int, Floats]
        self._plan: PackedPlan | None = None
        self._objects_length = -1
        self._bytes, self._numbers = bytearray(), np.empty(0)

    def fill(self, plan: PackedPlan, layout: Struct, numbers: Sequence[float], objects: list[bytes]) -> None:
        """Store the plan of the next sample, its numbers, and the packed objects of the plan's places."""
        packed_objects = b"".join(objects)
        if plan is not self._plan or len(packed_objects) != self._objects_length:
            self._fit(plan, layout.size, len(packed_objects))
        layout.pack_into(self._bytes, 0, *numbers)
        if packed_objects:
            self._bytes[layout.size : layout.size + len(packed_objects)] = packed_objects
        self.channels = 0

    def _fit(self, plan: PackedPlan, objects_begin: int, objects_length: int) -> None:
        """Make room for packed objects of the given length in bytes."""
        self._plan, self._objects_length = plan, objects_length
        size = objects_begin + 4 * objects_length + 8 * plan.room
        if size > len(self._bytes):
            # the size is doubled, because numbers of objects and vertices change from sample to sample
            self._bytes = bytearray(2 * size)
            self._numbers = np.frombuffer(self._bytes)
        self.arguments = (
            plan.whole,
            plan.real,
            self._numbers,
            (objects_begin + objects_length) // 8,
            self.leaves,
        )

    def measure(self) -> Floats:
        """Return the leaves of the sample, (C, A, 1)."""
        self.channels = measure_sample(*self.arguments)
        return self.leaves[: self.channels]


Leaves: TypeAlias = Sequence[Atom | Quantified]


class Member(NamedTuple):
    """A possible member of an open group: its name and the code of its class."""

    name: str
    class_code: int


@dataclass(frozen=True, eq=False)
class PlanContext:
    """State that the plans of a specification share.

    Attributes:
        leaves: leaves of each formula.
        delays: delays of the samples that terms read; delay 0 is first.
        classes: code of each class of an open group, by class name in lower case. Other classes have code 0.
        regions: regions, and centres of regions, in formulas.
    """

    leaves: Sequence[Leaves]
    delays: tuple[Delay, ...]
    classes: Mapping[str, int]
    regions: Mapping[RegionName | Centre, TrackedObject]


class Place(NamedTuple):
    """An object in a sample that a plan reads, or the point at the object's centre.

    Attributes:
        sample: index of the sample's delay.
        rate: terms of the rate by which the object is moved back; empty without a rate.
    """

    sample: int
    name: str
    is_centre: bool
    rate: tuple[Term, ...] = ()


class Row(NamedTuple):
    """A row of a plan, and the class code without which the row is ignored, or `ANY`."""

    row: int
    class_code: int = ANY


class PlanRows:
    """Rows of a plan for the objects and regions of terms, numbered in the order of requests."""

    def __init__(self, frame: PlanContext, members: frozenset[Member]) -> None:
        self._frame = frame
        self._members = members
        self._row_of_sample = {delay: number for number, delay in enumerate(frame.delays)}
        self._row_of_region = {
            name: len(self._row_of_sample) + number for number, name in enumerate(frame.regions)
        }
        self.places: dict[Place, int] = {}

    def candidates(self, group: Group | Earlier) -> tuple[str, ...]:
        base = open_group(group)
        class_code = self._required_class(base)
        fitting_names = {name for name, code in self._members if class_code in (ANY, code)}
        return tuple(sorted(fitting_names - left_out_of(base)))

    def may_be_unknown(self, group: Group | Earlier) -> bool:
        return isinstance(group, Earlier)

    def of_membership(self, membership: Membership) -> list[Row]:
        sample_row = self._sample_of(membership.group)
        if not membership.candidates:
            return [Row(sample_row)]
        candidate_names, class_code = (
            self.candidates(membership.group),
            self._required_class(open_group(membership.group)),
        )
        return [
            Row(self._place(sample_row, candidate_names[candidate]), class_code)
            for candidate in membership.candidates
        ]

    def of_term(self, term: Term) -> list[Row]:
        """Return the rows whose union is the footprint of the term."""
        is_point, term = is_centre(term), standing(term)
        base = term.term if isinstance(term, Earlier) else term
        rate = term.rate if isinstance(term, Earlier) else ()
        place_row = partial(self._place, self._sample_of(term), is_centre=is_point, rate=rate)
        if isinstance(base, RegionName):
            return [Row(self._row_of_region[Centre(base) if is_point else base])]
        if not isinstance(base, Group):
            return [Row(place_row(base.name))]
        if base.members is None:
            class_code = self._required_class(base)
            return [Row(place_row(name), class_code) for name in self.candidates(base)]
        return [Row(place_row(name)) for name in named_members(base)]

    def required_rows(self, term: Term) -> list[Row]:
        """Return the rows without which a term is unknown, including the row of its earlier sample."""
        current_term, base = standing(term), base_of(term)
        sample_rows = [Row(self._sample_of(current_term))] if isinstance(current_term, Earlier) else []
        if isinstance(base, RegionName) or (isinstance(base, Group) and base.members is None):
            return sample_rows
        return sample_rows + self.of_term(term)

    def _sample_of(self, term: Term) -> int:
        return self._row_of_sample[Delay.of(term) if isinstance(term, Earlier) else NO_DELAY]

    def _required_class(self, group: Group) -> int:
        if group.class_name == ANY_CLASS:
            return ANY
        return self._frame.classes[(group.class_name or "").casefold()]

    def _place(self, sample: int, name: str, *, is_centre: bool = False, rate: tuple[Term, ...] = ()) -> int:
        first_row = len(self._row_of_sample) + len(self._row_of_region)
        return self.places.setdefault(Place(sample, name, is_centre, rate), first_row + len(self.places))


class LeafPlan:
    """Index arrays for the leaves of a sample, which may read earlier samples."""

    def __init__(
        self, frame: PlanContext, members: frozenset[Member], placeholders: Mapping[_Classes, Sequence[str]]
    ) -> None:
        """Create a plan for samples whose open groups only have members in `members`.

        Args:
            placeholders: names of members that stand for unnamed objects, by the classes of an object.

        Raises:
            UsageError: the bindings exceed `MAX_BINDINGS`.
        """
        rows = PlanRows(frame, members)
        code = LeafCode(rows)
        outputs = [number for leaves in frame.leaves for number in code.add_leaves(leaves, {})]
        arrays = _arrays(frame, rows, code, outputs)
        place_count = len(rows.places)
        extent = PlanExtent(
            samples=len(frame.delays),
            regions=len(frame.regions),
            places=place_count,
            signals=len(code.signals),
            coded=place_count if frame.classes else 0,
        )
        self.packed = PackedPlan.of(extent, arrays)
        self.placeholders = placeholders
        rate_terms = [place.rate for place in rows.places]
        rate_terms += [signal.terms for signal in code.signals if isinstance(signal, ReportStep)]
        self._rates: tuple[tuple[Term, ...], ...] = tuple(filter(None, dict.fromkeys(rate_terms)))
        number_of_rate = {rate: number for number, rate in enumerate(self._rates)}
        self._places = tuple((*place[:3], number_of_rate.get(place.rate)) for place in rows.places)
        step_numbers = (
            number_of_rate.get(signal.terms) if isinstance(signal, ReportStep) else None
            for signal in code.signals
        )
        self._signals = tuple(
            (signal.name if type(signal) is Signal else None, signal, step_number)
            for signal, step_number in zip(code.signals, step_numbers, strict=True)
        )
        self._has_classes = bool(frame.classes)
        number_count = (
            len(frame.delays) + len(self._signals) + (len(self._places) if self._has_classes else 0)
        )
        self._layout = Struct(f"={number_count}d")

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
            room: output.
            samples: sample at each delay of the context; None before the first sample.
            stands_for: object of each placeholder.
            code_of: returns the code of a class.
            reports: reports of the newest sample.
        """
        newest_sample: Any = samples[0]
        numbers = [0.0]
        if len(samples) > 1:
            numbers = [0.0 if sample else ABSENT for sample in samples]
        step_seconds = (
            [_step(rate, newest_sample, reports, stands_for) for rate in self._rates] if self._rates else []
        )
        for plain_name, signal, rate in self._signals:
            if plain_name is not None:
                numbers.append(newest_sample.signals.get(plain_name, nan))
            elif rate is not None:
                numbers.append(step_seconds[rate])
            elif isinstance(signal, Present):
                name = stands_for.get(signal.term.name, signal.term.name)
                numbers.append(name in newest_sample.objects or name in newest_sample.unknown)
            else:
                numbers.append(_signal(signal, newest_sample, reports))
        packed_objects: list[bytes] = []
        if not self._places:
            room.fill(self.packed, self._layout, numbers, packed_objects)
            return
        lookups = [newest_sample.objects.get]
        if len(samples) > 1:
            lookups = [sample.objects.get if sample else _NOTHING_THERE for sample in samples]
        for sample_index, name, is_point, rate in self._places:
            name = stands_for.get(name, name) if stands_for else name
            tracked: Any = lookups[sample_index](name)
            if rate is not None and tracked is not None:
                class_name = tracked.class_name
                tracked = reports.moved_back(name, newest_sample, step_seconds[rate])
                if tracked is None:
                    packed_objects.append(_HIDDEN)
                    if self._has_classes:
                        numbers.append(code_of(class_name))
                    continue
            if tracked is not None:
                packed_objects += reports.packed_centre(name, tracked) if is_point else tracked.packed
                if self._has_classes:
                    numbers.append(code_of(tracked.class_name))
                continue
            unknown_classes: Any = (
                _NOTHING if samples[sample_index] is None else cast(Sample, samples[sample_index]).unknown
            )
            packed_objects.append(_HIDDEN if name in unknown_classes else _NOT_THERE)
            if self._has_classes:
                numbers.append(code_of(unknown_classes[name]) if name in unknown_classes else 0.0)
        room.fill(self.packed, self._layout, numbers, packed_objects)


def _signal(signal: Signal, sample: Sample, reports: RecentReports) -> float:
    """Return the value of a signal in one sample, as `TraceScene.signal` does."""
    if isinstance(signal, ReportStep | PreviousSignal):
        latest = reports.latest.get(signal.signal or signal)
        if latest is None or latest.before is None:
            return nan
        return latest.seconds if isinstance(signal, ReportStep) else float(latest.before.value)
    if isinstance(signal, ComputedSignal):
        return computed_signal(signal, sample)
    return sample.signals.get(signal.name, nan)


def _step(
    terms: Sequence[Term], sample: Sample, reports: RecentReports, stands_for: Mapping[str, str]
) -> float:
    """Return the shortest time between two reports of the terms' objects, s; NaN if undefined."""
    if stands_for:
        names = {placeholder: TrackedName(name) for placeholder, name in stands_for.items()}
        terms = [names.get(term.name, term) if isinstance(term, TrackedName) else term for term in terms]
    return reports.step(terms, sample)


_NOTHING_THERE: Callable[[str], None] = MappingProxyType[str, None]({}).get
# the kernel treats unknown positions, too: 21 µs for 20 people instead of 1.3 ms by a trace
_NOT_THERE, _HIDDEN = (Struct("=5d").pack(parts, nan, nan, nan, 0.0) for parts in (0.0, -1.0))


def _arrays(frame: PlanContext, rows: PlanRows, code: LeafCode, outputs: Sequence[int]) -> PlanArrays:
    measurements = list(code.measurements)
    operand_of_term: dict[Term, int] = {}
    geometric_numbers = [
        number for number, measurement in enumerate(measurements) if not measurement.needs_orientation
    ]
    operand_pairs = [
        [operand_of_term.setdefault(term, len(operand_of_term)) for term in measurements[number].terms]
        for number in geometric_numbers
    ]
    yaw_rows = [
        [number, *(rows.of_term(term)[0].row for term in measurement.terms)]
        for number, measurement in enumerate(measurements)
        if measurement.needs_orientation
    ]
    row_lists = [rows.of_term(term) for term in operand_of_term]
    row_lists += [rows.of_term(operand_pair.group) for operand_pair in code.closest]
    row_lists += [rows.of_membership(membership) for membership in code.members]
    row_lists += [
        [row for term in measurement.terms for row in rows.required_rows(term)]
        for measurement in measurements
    ]
    regions = FootprintBatch.from_footprints(
        [region.footprint for region in frame.regions.values()],
        [region.height for region in frame.regions.values()],
    )
    return PlanArrays(
        region_parts=np.diff(regions.part_start),
        region_sizes=np.diff(regions.vertex_start),
        region_radius=regions.radius.copy(),
        region_vertices=regions.vertices.ravel(),
        region_heights=np.stack((regions.bottom, regions.top), axis=1),
        listed_start=starts_from_counts(list(map(len, row_lists))),
        listed_rows=_whole(row.row for row_list in row_lists for row in row_list),
        listed_classes=_whole(row.class_code for row_list in row_lists for row in row_list),
        enlargement=np.array([_enlargement(term) for term in operand_of_term], np.float64),
        geometric=_whole(geometric_numbers),
        quantity=_whole(QUANTITY_CODES[measurements[number].quantity] for number in geometric_numbers),
        first=_whole(operand_pair[0] for operand_pair in operand_pairs),
        second=_whole(operand_pair[1] if len(operand_pair) > 1 else ABSENT for operand_pair in operand_pairs),
        yaws=np.array(yaw_rows, np.int64).reshape(len(yaw_rows), 3),
        closest_enlargement=np.array([operand_pair.enlargement for operand_pair in code.closest], np.float64),
        is_group=_whole(not membership.candidates for membership in code.members),
        code=np.array(list(code.rows), np.int64).reshape(len(code.rows), 4),
        constants=np.array(list(code.constants), np.float64),
        outputs=_whole(outputs),
    )


def _whole(numbers: Iterable[int]) -> Integers:
    return np.array(list(numbers), np.int64)


def _enlargement(term: Term) -> float:
    """Return the total enlargement of a term, summed in the order of `TraceScene`."""
    return _enlargement(term.term) + term.radius if isinstance(term, Enlarged) else 0.0


MOST_PLANS = 64
"""Limit on the number of stored plans."""
_MOST_BYTES = 1 << 22
"""Limit on the size of all stored plans, bytes. The least recently used plans are evicted first."""
_MOST_CLASSES = 1024
"""Limit on cached spellings of class names, which may differ in upper and lower case."""

_NO_OBJECT = ""
"""A name that no object has."""
_NOTHING: Mapping[str, str] = MappingProxyType({})


def _region(outline: Outline) -> TrackedObject:
    return TrackedObject(footprint_from_outline(outline), height=outline.height)


_Classes: TypeAlias = tuple[int, ...]
"""Class codes of one object in all samples that a plan reads. Usually, it is a single code."""

_Counts: TypeAlias = tuple[tuple[_Classes, int], ...]
"""Number of placeholders for unnamed objects, by their class codes."""


class SampleLeaves:
    """Computes the leaves of formulas sample by sample."""

    def __init__(self, leaves: Sequence[Leaves], regions: Mapping[str, Outline]) -> None:
        formulas = list(chain.from_iterable(leaves))
        terms = list(iter_terms(formulas))
        bases = [base_of(term) for term in terms]
        open_classes = {base.class_name or "" for base in bases if isinstance(base, Group) and base.is_open}
        region_objects = {
            name: _region(outline) for name, outline in regions.items() if RegionName(name) in bases
        }
        classes = sorted({name.casefold() for name in open_classes if name != ANY_CLASS})
        self._frame = PlanContext(
            leaves,
            tuple(dict.fromkeys((NO_DELAY, *iter_delays(formulas)))),
            {name: code for code, name in enumerate(classes, start=1)},
            {
                **{RegionName(name): region for name, region in region_objects.items()},
                **{
                    Centre(base): centre_object(region_objects[base.name])
                    for base in map(base_of, filter(is_centre, terms))
                    if isinstance(base, RegionName)
                },
            },
        )
        self._regions = regions
        self._recent_samples = RecentSamples(self._frame.delays)
        self._reports = _empty_reports(formulas)
        self._takes_any = ANY_CLASS in open_classes
        self._spec_names = _names(bases)
        self._prefix = "?"
        while any(name.startswith(self._prefix) for name in self._spec_names):
            self._prefix += "?"
        self._spec_members: frozenset[Member] = (
            frozenset()
        )  # members seen so far among the objects that the specification names
        self._code_of = lru_cache(_MOST_CLASSES)(partial(_class_code, self._frame.classes))
        self._plans: dict[tuple[frozenset[Member], _Counts], LeafPlan] = {}
        self._only_plan = None if open_classes else LeafPlan(self._frame, frozenset(), {})
        self._looks_back = len(self._frame.delays) > 1 or bool(
            next(chain.from_iterable(map(rates_of, formulas)), None)
        )
        self.room = SampleRoom(len(formulas))

    def look_at(self, sample: Sample) -> Sequence[Sample | None]:
        """Add the next sample. Return the sample at each delay; None for a delay beyond the first sample."""
        if not self._looks_back:
            return (sample,)
        self._reports.add(sample)
        return self._recent_samples.add(sample)

    def fill_room(self, sample: Sample) -> SampleRoom:
        """Add the next sample. Copy it, and earlier samples that terms read, into memory for kernels.

        Raises:
            UsageError: the bindings exceed `MAX_BINDINGS`.
        """
        samples = self.look_at(sample) if self._looks_back else (sample,)
        plan, stands_for = self._only_plan, _NOTHING
        if plan is None:
            plan, stands_for = self._fitting_plan(samples)
        plan.fill(self.room, samples, stands_for, self._code_of, self._reports)
        return self.room

    def _fitting_plan(self, samples: Sequence[Sample | None]) -> tuple[LeafPlan, Mapping[str, str]]:
        """Return a plan for the members of open groups in the samples, and the object of each placeholder."""
        names_by_classes = self._unnamed_members(samples)
        placeholder_counts = {classes: _room(len(names)) for classes, names in names_by_classes.items()}
        try:
            plan = self._plan_for(placeholder_counts)
        except UsageError:  # rounded-up counts exceed the limit of bindings, but exact counts may not
            placeholder_counts = {classes: len(names) for classes, names in names_by_classes.items()}
            plan = self._plan_for(placeholder_counts)
        stands_for: dict[str, str] = {}
        for classes, names in names_by_classes.items():
            # spare placeholders stand for a name that no sample has
            stands_for.update(zip_longest(plan.placeholders[classes], names, fillvalue=_NO_OBJECT))
        return plan, stands_for

    def _unnamed_members(self, samples: Sequence[Sample | None]) -> dict[_Classes, list[str]]:
        """Return the members of open groups that the specification does not name, by their class codes."""
        classes_by_name: dict[str, _Classes] = {}
        spec_members: list[Member] = []
        code_of, takes_any, spec_names = self._code_of, self._takes_any, self._spec_names
        for sample in filter(None, samples):
            objects: Any = sample.objects
            codes = [code_of(tracked.class_name) for tracked in objects.values()]
            codes += map(code_of, sample.unknown.values())
            for name, code in zip(chain(objects, sample.unknown), codes, strict=True):
                # the object fits no open group
                if not (code or takes_any):
                    continue
                if name in spec_names:
                    spec_members.append(Member(name, code))
                elif name not in classes_by_name:
                    classes_by_name[name] = (code,)
                # an object may have changed its class since an earlier sample
                elif code not in classes_by_name[name]:
                    classes_by_name[name] = tuple(sorted((*classes_by_name[name], code)))
        if not self._spec_members.issuperset(spec_members):
            self._spec_members |= frozenset(spec_members)
        names_by_classes: dict[_Classes, list[str]] = {}
        for name, classes in classes_by_name.items():
            names_by_classes.setdefault(classes, []).append(name)
        return names_by_classes

    def _plan_for(self, counts: Mapping[_Classes, int]) -> LeafPlan:
        """Return the plan for the given numbers of unnamed members, from the cache if possible."""
        key, plans = (self._spec_members, tuple(sorted(counts.items()))), self._plans
        # the plan is moved to the end, so that the order of the dict is the order of use
        plan = plans.pop(key, None)
        if plan is None:
            plan = _plan(self._frame, self._prefix, *key)
            byte_limit = _MOST_BYTES - plan.packed.nbytes
            while plans and (
                len(plans) >= MOST_PLANS
                or sum(other_plan.packed.nbytes for other_plan in plans.values()) > byte_limit
            ):
                del plans[next(iter(plans))]
        plans[key] = plan
        return plan


def _empty_reports(formulas: Sequence[Formula]) -> RecentReports:
    rates = [rate for formula in formulas for rate in rates_of(formula)]
    bases = [base_of(term) for rate in rates for term in rate.terms]
    is_any = any(isinstance(base, Variable) or (isinstance(base, Group) and base.is_open) for base in bases)
    signals = dict.fromkeys(rate.signal for rate in rates if rate.signal is not None)
    return RecentReports(None if is_any else _names(bases), signals)


def _plan(frame: PlanContext, prefix: str, spec_members: frozenset[Member], counts: _Counts) -> LeafPlan:
    # no name of the specification begins with the prefix
    placeholders = {
        classes: [f"{prefix}{classes} {number}" for number in range(count)] for classes, count in counts
    }
    placeholder_members = {
        Member(name, code) for classes, names in placeholders.items() for name in names for code in classes
    }
    return LeafPlan(frame, spec_members | placeholder_members, placeholders)


def _class_code(classes: Mapping[str, int], name: str | None) -> int:
    """Return the code of a class name in any case; 0 for a class without an open group."""
    return classes.get((name or "").casefold(), 0)


def _room(member_count: int) -> int:
    """Round a number of members up to 1, 2, 3, 4, 6, 8, 12, 16, …, so that few plans are needed."""
    power_of_two = 1 << (member_count - 1).bit_length()
    return (
        member_count
        if member_count < 4
        else power_of_two * 3 // 4
        if member_count <= power_of_two * 3 // 4
        else power_of_two
    )


def _names(bases: Sequence[Term]) -> frozenset[str]:
    """Return the names of objects in terms, members and exclusions of groups included."""
    names: set[str] = set()
    for base in bases:
        if isinstance(base, TrackedName):
            names.add(base.name)
        elif isinstance(base, Group):
            names.update(base.members or ())
            names.update(term.name for term in base.excluded if isinstance(term, TrackedName))
    return frozenset(names)
