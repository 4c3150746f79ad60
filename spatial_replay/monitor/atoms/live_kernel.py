"""Kernel that measures and computes the leaves of one sample in one call.

A plan's arrays say which rows are measured with which, and how leaves follow. Rows stand for, in this order:
each sample looked at, the regions, then the places, each an object in one of those samples. A missing sample
or object has the class code `ABSENT`; an object that is there, but not known where, has its class, and no
parts.

Working memory lies in few arrays, because an allocation takes as long as measuring a pair of boxes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from spatial_replay.compiled import inlined, kernel
from spatial_replay.geometry.arrays import Flags, Floats, Integers
from spatial_replay.geometry.footprint import BOTTOM, PARTS, TOP, UNCERTAINTY, YAW
from spatial_replay.geometry.kernels import measure_rows
from spatial_replay.geometry.measure import closest_rows, misalignment_of
from spatial_replay.monitor.atoms.instructions import run_instructions
from spatial_replay.text import TEXTS

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
    """A plan's arrays one after the other, so that a kernel gets two.

    Attributes:
        whole: where each array begins and ends, and then those of whole numbers.
        real: the others.
        leaves: how many leaves it computes.
    """

    whole: Integers
    real: Floats
    leaves: int

    @classmethod
    def of(cls, arrays: PlanArrays) -> PackedPlan:
        whole, real = [np.zeros(2 * len(arrays), np.int64)], [np.zeros(0)]
        for number, array in enumerate(arrays):
            among: list[Any] = whole if array.dtype == np.int64 else real
            begin = sum(map(len, among))
            whole[0][2 * number : 2 * number + 2] = begin, begin + array.size
            among.append(array.ravel())
        return cls(np.concatenate(whole), np.concatenate(real), len(arrays.outputs))


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
        operand_start=whole[whole[12] : whole[13]],
        operand_rows=whole[whole[14] : whole[15]],
        operand_classes=whole[whole[16] : whole[17]],
        enlargement=real[whole[18] : whole[19]],
        geometric=whole[whole[20] : whole[21]],
        quantity=whole[whole[22] : whole[23]],
        first=whole[whole[24] : whole[25]],
        second=whole[whole[26] : whole[27]],
        yaws=whole[whole[28] : whole[29]].reshape((-1, 3)),
        required_start=whole[whole[30] : whole[31]],
        required=whole[whole[32] : whole[33]],
        closest_start=whole[whole[34] : whole[35]],
        closest_rows=whole[whole[36] : whole[37]],
        closest_classes=whole[whole[38] : whole[39]],
        closest_enlargement=real[whole[40] : whole[41]],
        member_start=whole[whole[42] : whole[43]],
        member_rows=whole[whole[44] : whole[45]],
        member_classes=whole[whole[46] : whole[47]],
        is_group=whole[whole[48] : whole[49]],
        code=whole[whole[50] : whole[51]].reshape((-1, 4)),
        constants=real[whole[52] : whole[53]],
        outputs=whole[whole[54] : whole[55]],
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
def _rows_of_sample(plan: PlanArrays, sample: Floats) -> SampleRows:
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
    whole, real = np.empty(2 * rows + parts + 2, np.int64), np.empty(4 * rows + parts + 6 * corners)
    starts, heights = rows, 4 * rows + parts
    made = SampleRows(
        classes=whole[:rows],
        part_start=whole[starts : starts + rows + 1],
        vertex_start=whole[starts + rows + 1 :],
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
def _measure(plan: PlanArrays, rows: SampleRows, values: Floats, spreads: Floats) -> None:
    """Fill `values` and `spreads` (K, 1), as `measurements.measured` gives them."""
    if len(values) == 0:  # signals alone
        return
    operands = len(plan.operand_start) - 1
    of_operands, measured = np.empty(operands + 1), np.empty((len(plan.geometric), 1))
    room = np.empty(2 * operands + 1 + len(plan.operand_rows), np.int64)
    widths, hidden, members = room[:operands], room[operands : 2 * operands + 1], room[2 * operands + 1 :]
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
    # a literal 0 has a type of its own, for which all of it would be compiled once more
    for sample in range(1):
        measure_rows(
            rows.part_start, rows.vertex_start, rows.vertices, rows.radius, rows.bottom, rows.top,
            members, plan.operand_start, widths, plan.enlargement, plan.quantity, plan.first, plan.second,
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
        for at in range(plan.required_start[k], plan.required_start[k + 1]):
            if rows.classes[plan.required[at]] == ABSENT:
                values[k, 0] = np.nan


@inlined
def _closest(plan: PlanArrays, rows: SampleRows, closest: Floats) -> None:
    """Fill `closest` (K, 4, 1), as `measurements.leaf_values` computes it."""
    if len(closest) == 0:
        return
    found = np.empty((1, 3))
    for k in range(len(closest)):
        begin, end = plan.closest_start[k], plan.closest_start[k + 1]
        members = np.empty((1, end - begin), np.int64)
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


@kernel
def measure_sample(whole: Integers, real: Floats, sample: Floats, leaves: Floats) -> int:
    """Compute the leaves of one sample, (C, A, 1), as `leaf_values` does.

    Args:
        whole, real: of a `PackedPlan`.
        sample: 0 or `ABSENT` for each sample, then the value of each signal. If the plan distinguishes
            classes, the class code of each place follows. Last comes each place's `packed` object: without
            parts if it is absent, with -1 parts if its place is unknown.
        leaves: (MOST_CHANNELS, A, 1), receives them.

    Returns:
        C, in how many channels they are.
    """
    plan = plan_at(whole, real)
    rows, count = _rows_of_sample(plan, sample), len(plan.required_start) - 1
    members = np.empty((len(plan.is_group), 1), np.int8)
    _members(plan, rows.classes, members)
    results, closest = np.empty((2, count, 1)), np.empty((len(plan.closest_enlargement), 4, 1))
    values, spreads = results[0], results[1]
    _closest(plan, rows, closest)
    _measure(plan, rows, values, spreads)
    signals = sample[plan.extent[0] : plan.extent[0] + plan.extent[3]].reshape((-1, 1))
    channels = _channels_of(values, spreads, signals, closest, members, plan.constants)
    for t in range(1):  # as in `_measure`
        run_instructions(
            plan.code, plan.constants, values, spreads, signals, closest, members, plan.outputs,
            leaves[:channels], t, t + 1,
        )  # fmt: skip
    return channels


def leaves_of_sample(plan: PackedPlan, sample: bytes) -> Floats:
    """Return the leaves of one sample, (C, A, 1), from the bytes of what `measure_sample` takes."""
    leaves = np.empty((MOST_CHANNELS, plan.leaves, 1))
    # writable, since kernels are compiled for that
    channels = measure_sample(plan.whole, plan.real, np.frombuffer(bytearray(sample)), leaves)
    return leaves[:channels]
