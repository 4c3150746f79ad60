"""All arrays of a plan for single samples, for kernels that are given the address of a table of them."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, cast

from spatial_replay.compiled import floats_at, inlined, integers_at
from spatial_replay.geometry.arrays import PLACE, Floats, Integers, shape_2


class PlanArrays(NamedTuple):
    """What a plan does with every sample; ragged lists come with the offsets of their rows.

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


class PlacedPlan(NamedTuple):
    """A plan's arrays, and the table of where they lie."""

    arrays: PlanArrays
    table: Integers


_AT: Final[Any] = PlanArrays(*cast(Any, range(len(PlanArrays._fields))))
"""The number of each array."""


@inlined
def plan_at(table_at: int) -> PlanArrays:
    """Return the arrays of a plan from the address of its table."""
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
