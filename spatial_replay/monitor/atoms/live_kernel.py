"""Kernel that measures and computes the leaves of one sample in one call.

A plan's arrays say which rows are measured with which, and how leaves follow. Rows stand for, in this order:
each sample looked at, the regions, then the places, each an object in one of those samples. A missing sample
or object has the class code `ABSENT`.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, cast

import numpy as np

from spatial_replay.compiled import allocating_apart, floats_at, inlined, integers_at, merged
from spatial_replay.geometry.arrays import PLACE, Flags, Floats, Integers, shape_2
from spatial_replay.geometry.closest import closest_rows
from spatial_replay.geometry.kernels import measure_rows
from spatial_replay.geometry.measure import misalignment_of
from spatial_replay.monitor.atoms.instructions import run_instructions

ABSENT = -1
ANY = -1
"""The required class if any class matches."""

MOST_CHANNELS = 4
"""As many as leaves may be in (see `online.codes`)."""

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


class PlacedPlan(NamedTuple):
    """A plan's arrays, and the table of where they lie."""

    arrays: PlanArrays
    table: Integers


_AT: Final[Any] = PlanArrays(*cast(Any, range(len(PlanArrays._fields))))
"""The number of each array."""


@inlined
def _plan_at(table_at: int) -> PlanArrays:
    at = integers_at(table_at, (len(_AT), PLACE))
    return PlanArrays(
        extent=integers_at(at[_AT.extent, 0], at[_AT.extent, 1]),
        region_parts=integers_at(at[_AT.region_parts, 0], at[_AT.region_parts, 1]),
        region_sizes=integers_at(at[_AT.region_sizes, 0], at[_AT.region_sizes, 1]),
        region_radius=floats_at(at[_AT.region_radius, 0], at[_AT.region_radius, 1]),
        region_vertices=floats_at(at[_AT.region_vertices, 0], at[_AT.region_vertices, 1]),
        region_heights=floats_at(at[_AT.region_heights, 0], shape_2(at, _AT.region_heights)),
        operand_start=integers_at(at[_AT.operand_start, 0], at[_AT.operand_start, 1]),
        operand_rows=integers_at(at[_AT.operand_rows, 0], at[_AT.operand_rows, 1]),
        operand_classes=integers_at(at[_AT.operand_classes, 0], at[_AT.operand_classes, 1]),
        enlargement=floats_at(at[_AT.enlargement, 0], at[_AT.enlargement, 1]),
        geometric=integers_at(at[_AT.geometric, 0], at[_AT.geometric, 1]),
        quantity=integers_at(at[_AT.quantity, 0], at[_AT.quantity, 1]),
        first=integers_at(at[_AT.first, 0], at[_AT.first, 1]),
        second=integers_at(at[_AT.second, 0], at[_AT.second, 1]),
        yaws=integers_at(at[_AT.yaws, 0], shape_2(at, _AT.yaws)),
        required_start=integers_at(at[_AT.required_start, 0], at[_AT.required_start, 1]),
        required=integers_at(at[_AT.required, 0], at[_AT.required, 1]),
        closest_start=integers_at(at[_AT.closest_start, 0], at[_AT.closest_start, 1]),
        closest_rows=integers_at(at[_AT.closest_rows, 0], at[_AT.closest_rows, 1]),
        closest_classes=integers_at(at[_AT.closest_classes, 0], at[_AT.closest_classes, 1]),
        closest_enlargement=floats_at(at[_AT.closest_enlargement, 0], at[_AT.closest_enlargement, 1]),
        member_start=integers_at(at[_AT.member_start, 0], at[_AT.member_start, 1]),
        member_rows=integers_at(at[_AT.member_rows, 0], at[_AT.member_rows, 1]),
        member_classes=integers_at(at[_AT.member_classes, 0], at[_AT.member_classes, 1]),
        is_group=integers_at(at[_AT.is_group, 0], at[_AT.is_group, 1]),
        code=integers_at(at[_AT.code, 0], shape_2(at, _AT.code)),
        constants=floats_at(at[_AT.constants, 0], at[_AT.constants, 1]),
        outputs=integers_at(at[_AT.outputs, 0], at[_AT.outputs, 1]),
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
def _rows_of_sample(plan: PlanArrays, sample_at: int, length: int) -> SampleRows:
    """Lay the regions and the objects of a sample out in rows; its numbers are those of `measure_sample`."""
    numbers = floats_at(sample_at, length)
    samples, regions, places, signals = plan.extent[0], plan.extent[1], plan.extent[2], plan.extent[3]
    here, known = samples + regions, len(plan.region_radius)
    of_places = floats_at(sample_at + 8 * samples, (places, NUMBERS_OF_PLACE))
    at = samples + NUMBERS_OF_PLACE * places
    rows, parts, corners = here + places, known, len(plan.region_vertices) // 2
    for k in range(places):
        parts += int(of_places[k, PARTS])
    for p in range(parts - known):
        corners += int(numbers[at + 2 * p])
    whole, room = np.empty(2 * rows + 1 + parts + 1, np.int64), np.empty(2 * rows + parts)
    classes, part_start, vertex_start = whole[:rows], whole[rows : 2 * rows + 1], whole[2 * rows + 1 :]
    bottom, top, radius = room[:rows], room[rows : 2 * rows], room[2 * rows :]
    part_start[0] = vertex_start[0] = 0
    for k in range(samples):
        classes[k], part_start[k + 1] = int(numbers[k]), 0
        bottom[k] = top[k] = np.nan
    for k in range(regions):
        row = samples + k
        classes[row], part_start[row + 1] = 0, part_start[row] + plan.region_parts[k]
        bottom[row], top[row] = plan.region_heights[k, 0], plan.region_heights[k, 1]
    for k in range(places):
        row = here + k
        classes[row], part_start[row + 1] = (
            int(of_places[k, CLASS]),
            part_start[row] + int(of_places[k, PARTS]),
        )
        bottom[row], top[row] = of_places[k, BOTTOM], of_places[k, TOP]
    for p in range(known):
        vertex_start[p + 1], radius[p] = vertex_start[p] + plan.region_sizes[p], plan.region_radius[p]
    for p in range(known, parts):
        vertex_start[p + 1], radius[p] = vertex_start[p] + int(numbers[at]), numbers[at + 1]
        at += 2
    of_regions = len(plan.region_vertices) // 2
    following = at + signals - 2 * of_regions
    vertices = np.empty((corners, 2))
    for k in range(of_regions):
        vertices[k, 0], vertices[k, 1] = plan.region_vertices[2 * k], plan.region_vertices[2 * k + 1]
    for k in range(of_regions, corners):
        vertices[k, 0], vertices[k, 1] = numbers[following + 2 * k], numbers[following + 2 * k + 1]
    of_signals = floats_at(sample_at + 8 * at, (signals, 1))
    return SampleRows(classes, part_start, vertex_start, vertices, radius, bottom, top, of_places, of_signals)


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


@allocating_apart
def measure_sample(plan_at: int, sample_at: int, length: int, leaves_at: int) -> int:
    """Compute the leaves of one sample, (C, A, 1), as `leaf_values` does.

    Args:
        plan_at: address of the table of a plan's arrays.
        sample_at, length: address of these numbers, and their count: for each sample looked at 0, or
            `ABSENT`; `NUMBERS_OF_PLACE` of each place; how many vertices each part has, and its radius; the
            value of each signal; x and y of each vertex of all parts.
        leaves_at: address of room for all channels of the leaves.

    Returns:
        C, in how many channels they are.
    """
    plan = _plan_at(plan_at)
    rows = _rows_of_sample(plan, sample_at, length)
    count = len(plan.required_start) - 1
    values, spreads = np.empty((count, 1)), np.empty((count, 1))
    _measure(plan, rows, values, spreads)
    members = np.empty((len(plan.is_group), 1), np.int8)
    _members(plan, rows.classes, members)
    closest = np.empty((len(plan.closest_enlargement), 4, 1))
    _closest(plan, rows, closest)
    channels = _channels_of(values, spreads, rows.signals, closest, members)
    leaves = floats_at(leaves_at, (channels, len(plan.outputs), 1))
    run_instructions(
        plan.code, plan.constants, values, spreads, rows.signals, closest, members, plan.outputs, leaves, 0, 1
    )
    return channels


def leaves_of_sample(plan: PlacedPlan, sample: bytes) -> Floats:
    """Return the leaves of one sample, (C, A, 1), from the bytes of what `measure_sample` takes."""
    count = len(plan.arrays.outputs)
    leaves = np.empty(MOST_CHANNELS * count)
    channels = measure_sample(plan.table, np.frombuffer(sample), len(sample) // 8, leaves)
    return leaves[: channels * count].reshape(channels, count, 1)
