"""Kernel that measures and computes the leaves of one sample in one call.

A plan's arrays say which rows are measured with which, and how leaves follow. Rows stand for, in this order:
each sample looked at, the regions, then the places, each an object in one of those samples. A missing sample
or object has the class code `ABSENT`; an object that is there, but not known where, has its class, and no
parts.

What is worked with lies in one piece of memory: to allocate an array, and to count who refers to it, takes as
long as to measure a pair of boxes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spatial_replay.compiled import allocating_apart, flags_at, floats_at, inlined, integers_at, merged
from spatial_replay.geometry.arrays import Flags, Floats, Integers
from spatial_replay.geometry.footprint import BOTTOM, PARTS, TOP, UNCERTAINTY, YAW
from spatial_replay.geometry.kernels import measure_rows
from spatial_replay.geometry.measure import closest_rows, misalignment_of
from spatial_replay.monitor.atoms.instructions import run_instructions
from spatial_replay.monitor.atoms.plan_arrays import PlacedPlan, PlanArrays, plan_at
from spatial_replay.text import TEXTS

ABSENT = -1
ANY = -1
"""The required class if any class matches."""

MOST_CHANNELS = 4
"""As many as leaves may be in (see `online.codes`)."""

_OF_OBJECT, _OF_PART = 5, 2
"""How many numbers come before those of an object's parts, and before those of a part's vertices."""


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
def _places_at(plan: PlanArrays, sample_at: int) -> int:
    """Return where the numbers of the objects begin."""
    return sample_at + 8 * int(plan.extent[0] + plan.extent[3] + plan.extent[4])


@inlined
def _parts_and_corners(plan: PlanArrays, sample_at: int) -> tuple[int, int]:
    """Count the parts of regions and objects, and their vertices."""
    parts, corners = len(plan.region_radius), len(plan.region_vertices) // 2
    at = _places_at(plan, sample_at)
    for _ in range(plan.extent[2]):
        own = max(int(floats_at(at, _OF_OBJECT)[PARTS]), 0)
        at += 8 * _OF_OBJECT
        parts += own
        for _ in range(own):
            count = int(floats_at(at, _OF_PART)[0])
            at += 8 * (_OF_PART + 2 * count)
            corners += count
    return parts, corners


@inlined
def _room_for_rows(plan: PlanArrays, parts: int, corners: int) -> int:
    rows = plan.extent[0] + plan.extent[1] + plan.extent[2]
    return int(6 * rows + 2 * parts + 6 * corners + 2)


@inlined
def _rows_of_sample(plan: PlanArrays, sample_at: int, parts: int, corners: int, room_at: int) -> SampleRows:
    """Lay the regions and the objects of a sample out in rows; its numbers are those of `measure_sample`."""
    samples, regions, places = plan.extent[0], plan.extent[1], plan.extent[2]
    here, rows = samples + regions, samples + regions + places
    starts_at = room_at + 8 * rows
    heights_at = starts_at + 8 * (rows + 1 + parts + 1)
    vertices_at = heights_at + 8 * (4 * rows + parts)
    made = SampleRows(
        classes=integers_at(room_at, rows),
        part_start=integers_at(starts_at, rows + 1),
        vertex_start=integers_at(starts_at + 8 * (rows + 1), parts + 1),
        vertices=floats_at(vertices_at, (corners, 2)),
        radius=floats_at(heights_at + 32 * rows, parts),
        bottom=floats_at(heights_at, rows),
        top=floats_at(heights_at + 8 * rows, rows),
        yaw=floats_at(heights_at + 16 * rows, rows),
        uncertainty=floats_at(heights_at + 24 * rows, rows),
        edges=floats_at(vertices_at + 16 * corners, (corners, 4)),
    )
    given = floats_at(sample_at, samples)
    made.part_start[0] = made.vertex_start[0] = 0
    for k in range(here):
        made.classes[k] = int(given[k]) if k < samples else 0
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
    codes = floats_at(sample_at + 8 * (samples + plan.extent[3]), plan.extent[4])
    at = _places_at(plan, sample_at)
    for row in range(here, rows):
        tracked = floats_at(at, _OF_OBJECT)
        own = max(int(tracked[PARTS]), 0)
        at += 8 * _OF_OBJECT
        made.classes[row] = int(codes[row - here]) if len(codes) else 0
        if tracked[PARTS] == 0.0:
            made.classes[row] = ABSENT
        made.part_start[row + 1] = part + own
        made.bottom[row], made.top[row] = tracked[BOTTOM], tracked[TOP]
        made.yaw[row], made.uncertainty[row] = tracked[YAW], tracked[UNCERTAINTY]
        for p in range(part, part + own):
            start, count = made.vertex_start[p], int(floats_at(at, _OF_PART)[0])
            made.radius[p] = floats_at(at, _OF_PART)[1]
            outline = floats_at(at + 8 * _OF_PART, (count, 2))
            for v in range(count):
                made.vertices[start + v, 0], made.vertices[start + v, 1] = outline[v, 0], outline[v, 1]
            made.vertex_start[p + 1] = start + count
            at += 8 * (_OF_PART + 2 * count)
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


@merged
def _measure(plan: PlanArrays, rows: SampleRows, room_at: int, values: Floats, spreads: Floats) -> None:
    """Fill `values` and `spreads` (K, 1), as `measurements.measured` gives them."""
    if len(values) == 0:  # signals alone
        return
    operands = len(plan.operand_start) - 1
    of_operands = floats_at(room_at, operands + 1)
    widths = integers_at(room_at + 8 * (operands + 1), operands)
    hidden = integers_at(room_at + 16 * (operands + 1), operands + 1)
    measured_at = room_at + 24 * (operands + 1)
    measured = floats_at(measured_at, (len(plan.geometric), 1))
    members = integers_at(measured_at + 8 * len(plan.geometric), len(plan.operand_rows))
    of_operands[operands], hidden[operands] = 0.0, 0  # for no operand, -1
    for operand in range(operands):
        begin, end = plan.operand_start[operand], plan.operand_start[operand + 1]
        widths[operand], hidden[operand], spread = end - begin, 0, 0.0
        for k in range(begin, end):
            row, members[k] = plan.operand_rows[k], ABSENT
            if not _is_there(rows.classes, row, plan.operand_classes[k]):
                continue
            if _is_hidden(plan, rows, row):
                hidden[operand] = 1
            else:
                members[k] = row
                spread = max(spread, rows.uncertainty[row])
        of_operands[operand] = spread
    measure_rows(
        rows.part_start,
        rows.vertex_start,
        rows.vertices,
        rows.radius,
        rows.bottom,
        rows.top,
        members,
        plan.operand_start,
        widths,
        plan.enlargement,
        plan.quantity,
        plan.first,
        plan.second,
        rows.edges,
        measured,
        0,
        1,
    )
    for g in range(len(plan.geometric)):
        k = plan.geometric[g]
        values[k, 0] = np.nan if hidden[plan.first[g]] or hidden[plan.second[g]] else measured[g, 0]
        spreads[k, 0] = of_operands[plan.first[g]] + of_operands[plan.second[g]]
    for y in range(len(plan.yaws)):
        k, a, b = plan.yaws[y, 0], plan.yaws[y, 1], plan.yaws[y, 2]
        values[k, 0], spreads[k, 0] = misalignment_of(rows.yaw[a], rows.yaw[b]), 0.0
    for k in range(len(values)):
        for at in range(plan.required_start[k], plan.required_start[k + 1]):
            if rows.classes[plan.required[at]] == ABSENT:
                values[k, 0] = np.nan


@merged
def _closest(plan: PlanArrays, rows: SampleRows, room_at: int, closest: Floats) -> None:
    """Fill `closest` (K, 4, 1), as `measurements.leaf_values` computes it."""
    found = floats_at(room_at, (1, 3))
    for k in range(len(closest)):
        begin, end = plan.closest_start[k], plan.closest_start[k + 1]
        members = integers_at(room_at + 24, (1, end - begin))
        there = hidden = 0
        for m in range(begin, end):
            row, members[0, m - begin] = plan.closest_rows[m], ABSENT
            if not _is_there(rows.classes, row, plan.closest_classes[m]):
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
def _members(plan: PlanArrays, classes: Integers, members: Flags) -> None:
    """Fill `members` (M, 1): whether each binding is one (1, 0), or that is not known (-1)."""
    for m in range(len(members)):
        members[m, 0] = 0 if plan.is_group[m] else 1
        for k in range(plan.member_start[m], plan.member_start[m + 1]):
            if not _is_there(classes, plan.member_rows[k], plan.member_classes[k]):
                members[m, 0] = -1 if plan.is_group[m] else 0


@inlined
def _channels_of(
    values: Floats, spreads: Floats, signals: Floats, closest: Floats, members: Flags, constants: Floats
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


@inlined
def _room_for_numbers(plan: PlanArrays) -> int:
    flags, results = (len(plan.is_group) + 7) // 8, 2 * (len(plan.required_start) - 1)
    while_measuring = 3 * len(plan.operand_start) + len(plan.geometric) + len(plan.operand_rows)
    # one after the other
    work = max(while_measuring, 3 + len(plan.closest_rows))
    return int(flags + results + 4 * len(plan.closest_enlargement) + work)


@merged
def _measured(table_at: int, sample_at: int, parts: int, corners: int, room_at: int, leaves_at: int) -> int:
    """Do what `measure_sample` does, with room for rows and for numbers."""
    plan = plan_at(table_at)
    rows = _rows_of_sample(plan, sample_at, parts, corners, room_at)
    members_at = room_at + 8 * _room_for_rows(plan, parts, corners)
    members = flags_at(members_at, (len(plan.is_group), 1))
    _members(plan, rows.classes, members)
    values_at = members_at + 8 * ((len(members) + 7) // 8)
    count = len(plan.required_start) - 1
    values, spreads = floats_at(values_at, (count, 1)), floats_at(values_at + 8 * count, (count, 1))
    closest_at = values_at + 16 * count
    closest = floats_at(closest_at, (len(plan.closest_enlargement), 4, 1))
    work_at = closest_at + 32 * len(closest)
    _closest(plan, rows, work_at, closest)
    _measure(plan, rows, work_at, values, spreads)
    signals = floats_at(sample_at + 8 * plan.extent[0], (plan.extent[3], 1))
    channels = _channels_of(values, spreads, signals, closest, members, plan.constants)
    leaves = floats_at(leaves_at, (channels, len(plan.outputs), 1))
    run_instructions(
        plan.code, plan.constants, values, spreads, signals, closest, members, plan.outputs, leaves, 0, 1
    )
    return channels


@allocating_apart
def measure_sample(table_at: int, sample_at: int, leaves_at: int) -> int:
    """Compute the leaves of one sample, (C, A, 1), as `leaf_values` does.

    Args:
        table_at: address of the table of a plan's arrays.
        sample_at: address of these numbers: for each sample looked at 0, or `ABSENT`; the value of each
            signal; if the plan distinguishes classes, the code of that at each place; of each place, as its
            object is `packed`: as one of no parts if it is not there, of -1 if it is not known where.
        leaves_at: address of room for all channels of the leaves.

    Returns:
        C, in how many channels they are.
    """
    plan = plan_at(table_at)
    parts, corners = _parts_and_corners(plan, sample_at)
    room = np.empty(_room_for_rows(plan, parts, corners) + _room_for_numbers(plan))
    channels = _measured(table_at, sample_at, parts, corners, room.ctypes.data, leaves_at)
    room[0] = 0.0  # until here it has to live
    return channels


def leaves_of_sample(plan: PlacedPlan, sample: bytes) -> Floats:
    """Return the leaves of one sample, (C, A, 1), from the bytes of what `measure_sample` takes."""
    count = len(plan.arrays.outputs)
    leaves = np.empty(MOST_CHANNELS * count)
    channels = measure_sample(plan.table, np.frombuffer(sample), leaves)
    return leaves[: channels * count].reshape(channels, count, 1)
