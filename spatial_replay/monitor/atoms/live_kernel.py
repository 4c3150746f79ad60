"""Kernel that measures and computes the leaves of one sample in one call.

A plan's arrays say which rows are measured with which, and how leaves follow. Rows stand for, in this order:
each sample looked at, the regions, then the places, each an object in one of those samples. A missing sample
or object has the class code `ABSENT`.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, cast

import numpy as np

from spatial_replay.compiled import inlined, kernel, merged
from spatial_replay.geometry.arrays import Flags, Floats, Integers
from spatial_replay.geometry.closest import closest_rows
from spatial_replay.geometry.kernels import measure_rows
from spatial_replay.geometry.measure import misalignment_of
from spatial_replay.monitor.atoms.instructions import run_instructions

ABSENT = -1
ANY = -1
"""The required class if any class matches."""

CLASS, PARTS, BOTTOM, TOP, YAW, UNCERTAINTY = range(6)
"""What a sample says of a place: bottom, top and yaw are NaN where there is none."""
NUMBERS_OF_PLACE = 6


class PlanArrays(NamedTuple):
    """What a plan does with every sample; ragged lists come with the offsets of their rows.

    Attributes:
        extent: (4,), how many samples, regions, places and signals there are.
        region_parts, region_sizes, region_radius, region_vertices, region_heights: the regions' footprints:
            parts of each, vertices of each part, radius of each part, x and y of all vertices,
            (bottom, top) of each.
        operand_start, operand_rows, operand_classes: rows of each operand, and the class that each must have.
        enlargement: of each operand.
        geometric: numbers of the measurements between footprints, with their `quantity` and operands
            `first` and `second` (-1: none).
        yaws: (Y, 3), the number of each measurement between orientations, and its two rows.
        required_start, required: the rows without which each measurement is unknown.
        closest_start, closest_rows, closest_classes, closest_enlargement: the rows of each closest pair's
            group, the class that each must have, and the enlargement of both.
        member_start, member_rows, member_classes: the rows that must be there for each binding, and classes.
        is_group: for each binding, 1 where it stands for a group itself: not known without its row.
        code, constants, outputs: what `run_instructions` takes.
    """

    extent: Integers
    region_parts: Integers
    region_sizes: Integers
    region_radius: Floats
    region_vertices: Floats
    region_heights: Floats
    operand_start: Integers
    operand_rows: Integers
    operand_classes: Integers
    enlargement: Floats
    geometric: Integers
    quantity: Integers
    first: Integers
    second: Integers
    yaws: Integers
    required_start: Integers
    required: Integers
    closest_start: Integers
    closest_rows: Integers
    closest_classes: Integers
    closest_enlargement: Floats
    member_start: Integers
    member_rows: Integers
    member_classes: Integers
    is_group: Integers
    code: Integers
    constants: Floats
    outputs: Integers


class PackedPlan(NamedTuple):
    """A plan's arrays in two, since each array costs a call something.

    Attributes:
        whole, numbers: the arrays of integers and of floats, flat, one after the other. The former begin with
            where each array begins and ends in one of these, in the order of `PlanArrays`.
    """

    whole: Integers
    numbers: Floats


def packed(plan: PlanArrays) -> PackedPlan:
    """Pack arrays, for `_unpacked` to find."""
    ends = {"i": 2 * len(plan), "f": 0}
    starts = list[int]()
    for array in plan:
        starts += [ends[array.dtype.kind], ends[array.dtype.kind] + array.size]
        ends[array.dtype.kind] += array.size
    whole, numbers = (
        np.concatenate([np.ravel(array) for array in plan if array.dtype.kind == kind]) for kind in ends
    )
    return PackedPlan(np.concatenate([np.array(starts, np.int64), whole]), numbers)


_AT: Final[Any] = PlanArrays(*cast(Any, range(len(PlanArrays._fields))))
"""The number of each array."""


@merged
def _integers(plan: PackedPlan, number: int) -> Integers:
    return plan.whole[plan.whole[2 * number] : plan.whole[2 * number + 1]]


@merged
def _floats(plan: PackedPlan, number: int) -> Floats:
    return plan.numbers[plan.whole[2 * number] : plan.whole[2 * number + 1]]


@merged
def _unpacked(plan: PackedPlan) -> PlanArrays:
    return PlanArrays(
        extent=_integers(plan, _AT.extent),
        region_parts=_integers(plan, _AT.region_parts),
        region_sizes=_integers(plan, _AT.region_sizes),
        region_radius=_floats(plan, _AT.region_radius),
        region_vertices=_floats(plan, _AT.region_vertices),
        region_heights=_floats(plan, _AT.region_heights).reshape((-1, 2)),
        operand_start=_integers(plan, _AT.operand_start),
        operand_rows=_integers(plan, _AT.operand_rows),
        operand_classes=_integers(plan, _AT.operand_classes),
        enlargement=_floats(plan, _AT.enlargement),
        geometric=_integers(plan, _AT.geometric),
        quantity=_integers(plan, _AT.quantity),
        first=_integers(plan, _AT.first),
        second=_integers(plan, _AT.second),
        yaws=_integers(plan, _AT.yaws).reshape((-1, 3)),
        required_start=_integers(plan, _AT.required_start),
        required=_integers(plan, _AT.required),
        closest_start=_integers(plan, _AT.closest_start),
        closest_rows=_integers(plan, _AT.closest_rows),
        closest_classes=_integers(plan, _AT.closest_classes),
        closest_enlargement=_floats(plan, _AT.closest_enlargement),
        member_start=_integers(plan, _AT.member_start),
        member_rows=_integers(plan, _AT.member_rows),
        member_classes=_integers(plan, _AT.member_classes),
        is_group=_integers(plan, _AT.is_group),
        code=_integers(plan, _AT.code).reshape((-1, 4)),
        constants=_floats(plan, _AT.constants),
        outputs=_integers(plan, _AT.outputs),
    )


class SampleRows(NamedTuple):
    """The rows of a plan in one sample, as `measure_rows` takes them, with the class code of each.

    Attributes:
        places: (P, NUMBERS_OF_PLACE), what a sample says of each place.
        signals: (S, 1).
    """

    classes: Integers
    part_start: Integers
    vertex_start: Integers
    vertices: Floats
    radius: Floats
    bottom: Floats
    top: Floats
    places: Floats
    signals: Floats


@merged
def _rows_of_sample(plan: PlanArrays, numbers: Floats) -> SampleRows:
    """Lay the regions and the objects of a sample out in rows; `numbers` as for `leaves_of_sample`."""
    samples, regions, places, signals = plan.extent[0], plan.extent[1], plan.extent[2], plan.extent[3]
    here = samples + regions
    at = samples + NUMBERS_OF_PLACE * places
    of_places = numbers[samples:at].reshape((places, NUMBERS_OF_PLACE))
    classes = np.zeros(here + places, np.int64)
    part_start = np.zeros(here + places + 1, np.int64)
    bottom, top = np.empty(here + places), np.empty(here + places)
    for k in range(samples):
        classes[k] = int(numbers[k])
        bottom[k] = top[k] = np.nan
    for k in range(regions):
        part_start[samples + k + 1] = part_start[samples + k] + plan.region_parts[k]
        bottom[samples + k], top[samples + k] = plan.region_heights[k, 0], plan.region_heights[k, 1]
    for k in range(places):
        classes[here + k] = int(of_places[k, CLASS])
        part_start[here + k + 1] = part_start[here + k] + int(of_places[k, PARTS])
        bottom[here + k], top[here + k] = of_places[k, BOTTOM], of_places[k, TOP]
    known, parts = len(plan.region_radius), part_start[here + places]
    vertex_start, radius = np.zeros(parts + 1, np.int64), np.empty(parts)
    for p in range(known):
        vertex_start[p + 1], radius[p] = vertex_start[p] + plan.region_sizes[p], plan.region_radius[p]
    for p in range(known, parts):
        vertex_start[p + 1], radius[p] = vertex_start[p] + int(numbers[at]), numbers[at + 1]
        at += 2
    of_regions, following = len(plan.region_vertices), at + signals
    vertices = np.empty(2 * vertex_start[parts])
    for k in range(of_regions):
        vertices[k] = plan.region_vertices[k]
    for k in range(of_regions, len(vertices)):
        vertices[k] = numbers[following + k - of_regions]
    return SampleRows(
        classes,
        part_start,
        vertex_start,
        vertices.reshape((-1, 2)),
        radius,
        bottom,
        top,
        of_places,
        numbers[at:following].reshape((signals, 1)),
    )


@inlined
def _is_there(classes: Integers, row: int, wanted: int) -> bool:
    return classes[row] != ABSENT and wanted in (ANY, classes[row])


@merged
def _lengths(starts: Integers) -> Integers:
    lengths = np.empty(len(starts) - 1, np.int64)
    for k in range(len(lengths)):
        lengths[k] = starts[k + 1] - starts[k]
    return lengths


@merged
def _spreads(starts: Integers, members: Integers, places: Floats, here: int) -> Floats:
    """Return each operand's uncertainty, the largest of its members'; then 0, for no operand."""
    spreads = np.zeros(len(starts))
    for operand in range(len(starts) - 1):
        for k in range(starts[operand], starts[operand + 1]):
            if members[k] >= here:
                spreads[operand] = max(spreads[operand], places[members[k] - here, UNCERTAINTY])
    return spreads


@inlined
def _yaw(row: int, classes: Integers, places: Floats, here: int) -> float:
    return places[row - here, YAW] if row >= here and classes[row] != ABSENT else np.nan


@merged
def _measure(plan: PlanArrays, rows: SampleRows, values: Floats, spreads: Floats) -> None:
    """Fill `values` and `spreads` (K, 1), as `measurements.measured` gives them."""
    if len(values) == 0:  # signals alone
        return
    classes, places = rows.classes, rows.places
    here = len(classes) - len(places)
    members = np.empty(len(plan.operand_rows), np.int64)
    for k in range(len(members)):
        is_there = _is_there(classes, plan.operand_rows[k], plan.operand_classes[k])
        members[k] = plan.operand_rows[k] if is_there else ABSENT
    measured = np.empty((len(plan.geometric), 1))
    measure_rows(
        rows.part_start,
        rows.vertex_start,
        rows.vertices,
        rows.radius,
        rows.bottom,
        rows.top,
        members,
        plan.operand_start,
        _lengths(plan.operand_start),
        plan.enlargement,
        plan.quantity,
        plan.first,
        plan.second,
        np.empty((len(rows.vertices), 4)),
        measured,
        0,
        1,
    )
    of_operands = _spreads(plan.operand_start, members, places, here)
    for g in range(len(plan.geometric)):
        k = plan.geometric[g]
        values[k, 0] = measured[g, 0]
        spreads[k, 0] = of_operands[plan.first[g]] + of_operands[plan.second[g]]  # the last for -1
    for y in range(len(plan.yaws)):
        k, a, b = plan.yaws[y, 0], plan.yaws[y, 1], plan.yaws[y, 2]
        yaws = _yaw(a, classes, places, here), _yaw(b, classes, places, here)
        values[k, 0], spreads[k, 0] = misalignment_of(yaws[0], yaws[1]), 0.0
    for k in range(len(values)):
        for at in range(plan.required_start[k], plan.required_start[k + 1]):
            if classes[plan.required[at]] == ABSENT:
                values[k, 0] = np.nan


@merged
def _closest(plan: PlanArrays, rows: SampleRows, closest: Floats) -> None:
    """Fill `closest` (K, 4, 1), as `measurements.leaf_values` computes it."""
    if len(closest) == 0:
        return
    classes, places = rows.classes, rows.places
    here = len(classes) - len(places)
    uncertainty = np.zeros(len(classes))
    for k in range(len(places)):
        uncertainty[here + k] = places[k, UNCERTAINTY]
    found = np.empty((1, 3))
    for k in range(len(closest)):
        begin, end = plan.closest_start[k], plan.closest_start[k + 1]
        members = np.empty((1, end - begin), np.int64)
        for m in range(begin, end):
            is_there = _is_there(classes, plan.closest_rows[m], plan.closest_classes[m])
            members[0, m - begin] = plan.closest_rows[m] if is_there else ABSENT
        closest_rows(
            rows.part_start,
            rows.vertex_start,
            rows.vertices,
            rows.radius,
            rows.bottom,
            rows.top,
            members,
            uncertainty,
            plan.closest_enlargement[k],
            np.empty((len(rows.vertices), 4)),
            found,
        )
        closest[k, 0, 0] = closest[k, 1, 0] = found[0, 0]
        closest[k, 2, 0], closest[k, 3, 0] = found[0, 1], found[0, 2]


@inlined
def _members(plan: PlanArrays, classes: Integers, members: Flags) -> None:
    """Fill `members` (M, 1): whether each binding is one (1, 0), or that is not known (-1)."""
    for m in range(len(members)):
        members[m, 0] = 0 if plan.is_group[m] else 1
        for k in range(plan.member_start[m], plan.member_start[m + 1]):
            if not _is_there(classes, plan.member_rows[k], plan.member_classes[k]):
                members[m, 0] = -1 if plan.is_group[m] else 0


@inlined
def _channels_of(values: Floats, spreads: Floats, signals: Floats, closest: Floats, members: Flags) -> int:
    """Return the number of channels needed: 4 with uncertainty, 2 with anything unknown, else 1."""
    channels = 1
    for k in range(len(closest)):
        if closest[k, 2, 0] != closest[k, 0, 0] or closest[k, 3, 0] != closest[k, 0, 0]:
            return 4
    for k in range(len(values)):
        if spreads[k, 0] != 0.0:
            return 4
        if not np.isfinite(values[k, 0]):
            channels = 2
    for k in range(len(signals)):
        if not np.isfinite(signals[k, 0]):
            channels = 2
    for k in range(len(members)):
        if members[k, 0] < 0:
            channels = 2
    return channels


@merged
def _leaves_of_signals(plan: PlanArrays, numbers: Floats) -> Floats:
    """Compute the leaves where there are no regions and no objects, with few arrays."""
    samples, count = plan.extent[0], plan.extent[3]
    signals = numbers[samples : samples + count].reshape((count, 1))
    nothing = numbers[:0].reshape((0, 1))
    closest, members = numbers[:0].reshape((0, 4, 1)), np.empty((0, 1), np.int8)
    leaves = np.empty((_channels_of(nothing, nothing, signals, closest, members), len(plan.outputs), 1))
    run_instructions(
        plan.code, plan.constants, nothing, nothing, signals, closest, members, plan.outputs, leaves, 0, 1
    )
    return leaves


@merged
def leaves_of_plan(packed_plan: PackedPlan, numbers: Floats) -> Floats:
    """Compute `leaves_of_sample`, within another kernel."""
    plan = _unpacked(packed_plan)
    measured = len(plan.required_start) - 1 + len(plan.closest_enlargement)
    if plan.extent[1] + plan.extent[2] + len(plan.is_group) + measured == 0:
        return _leaves_of_signals(plan, numbers)
    rows = _rows_of_sample(plan, numbers)
    values = np.empty((len(plan.required_start) - 1, 1))
    spreads = np.empty((len(plan.required_start) - 1, 1))
    _measure(plan, rows, values, spreads)
    members = np.empty((len(plan.is_group), 1), np.int8)
    _members(plan, rows.classes, members)
    closest = np.empty((len(plan.closest_enlargement), 4, 1))
    _closest(plan, rows, closest)
    channels = _channels_of(values, spreads, rows.signals, closest, members)
    leaves = np.empty((channels, len(plan.outputs), 1))
    run_instructions(
        plan.code, plan.constants, values, spreads, rows.signals, closest, members, plan.outputs, leaves, 0, 1
    )
    return leaves


@kernel
def leaves_of_sample(packed_plan: PackedPlan, numbers: Floats) -> Floats:
    """Compute the leaves of one sample, (C, A, 1), as `leaf_values` does.

    Args:
        numbers: for each sample looked at 0, or `ABSENT`; `NUMBERS_OF_PLACE` of each place; how many vertices
            each part has, and its radius; the value of each signal; x and y of each vertex of all parts.
    """
    return leaves_of_plan(packed_plan, numbers)
