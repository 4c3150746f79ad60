"""Measure footprints and orientations over many samples in one kernel call; find points of contact.

The closest pair of many footprints is found by a sweep over bounding boxes. The sweep skips pairs whose boxes
are farther apart than the closest pair so far. The sweep is exact: the signed distance of two footprints is
at least the gap between their boxes along either axis, also for a negative gap. The result equals the result
of testing all pairs, bit for bit.

A contact is the place where two footprints are nearest, overlap deepest, or where one footprint protrudes
farthest. Contacts are used only for pictures and explanations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spatial_replay.compiled import elementwise, inlined, kernel, long_kernel, over_cores
from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import Floats, Integers, writable
from spatial_replay.geometry.footprint import ConvexPart, Footprint, FootprintBatch
from spatial_replay.geometry.kernels import (
    QUANTITY_CODES,
    Rows,
    fill_contacts,
    fill_row,
    measure_rows,
    rows_distance,
)

_SHARE = 16_384
"""Least number of quantities per thread, so that starting a thread pays."""
_NO_ROWS = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Operand:
    """A footprint over T samples: in each sample, the union of some rows.

    Attributes:
        rows: (T, M) int64, row numbers of a `FootprintBatch`; negative for an absent member. M is the number
            of members of a group, or 1 for a single object.
        enlargement: radius of the disc added (Minkowski sum), in footprint units.
    """

    rows: Integers
    enlargement: float = 0.0


@dataclass(frozen=True, slots=True)
class MeasureRequest:
    """A quantity of one operand, or of two operands.

    Attributes:
        quantity: key of `QUANTITY_CODES`.
        first, second: indices of operands; -1 without a second operand.
    """

    quantity: str
    first: int
    second: int = -1


def measure(batch: FootprintBatch, operands: Sequence[Operand], requests: Sequence[MeasureRequest]) -> Floats:
    """Compute each requested quantity in each sample.

    signed_distance(A, B) is the minimum over pairs of parts. For two parts it is the distance of their
    polygons minus both radii (Def. 2-4 of the paper). Overlapping polygons have minus the penetration depth
    as their distance. If both footprints have heights, they are upright prisms.

    protrusion(A, B) is the maximum, over parts of A, of the minimum over parts of B. For two parts it is the
    maximum, over vertices p of A, of sd(p, B's polygon) + r_A - r_B. For prisms it is the greatest of this
    planar protrusion, B.bottom - A.bottom and A.top - B.top.

    Projections cover all parts and include radius and enlargement. Projections of centroids use the area
    centroids of the unrounded polygons. Along z, the projection of a footprint without a height is NaN.

    The minimum over an empty union is +inf, the maximum is -inf.

    Returns:
        (K, T) float64 for K requests.

    Raises:
        GeometryError: the batch lacks a row.
    """
    members = np.concatenate([np.ravel(operand.rows) for operand in operands] or [_NO_ROWS])
    if members.size and members.max() >= len(batch):
        raise GeometryError(f"an operand has row {members.max()}; the batch has {len(batch)} rows, from 0")
    operand_sizes = np.array([operand.rows.size for operand in operands], dtype=np.int64)
    values = np.empty((len(requests), operands[0].rows.shape[0] if operands else 0))
    codes = np.array([QUANTITY_CODES[request.quantity] for request in requests], dtype=np.int64)
    arguments: Any = (
        *_arrays_of(batch),
        members,
        np.concatenate([[0], np.cumsum(operand_sizes)]),
        np.array([operand.rows.shape[1] for operand in operands], dtype=np.int64),
        np.array([operand.enlargement for operand in operands], dtype=np.float64),
        codes,
        np.array([request.first for request in requests], dtype=np.int64),
        np.array([request.second for request in requests], dtype=np.int64),
        np.empty((len(batch.vertices), 4)),
        values,
    )
    least_samples = _SHARE // max(len(requests), 1) + 1
    over_cores(measure_rows, lambda *share: measure_rows(*arguments, *share), values.shape[1], least_samples)
    return values


def _arrays_of(batch: FootprintBatch) -> Any:
    """Return the leading arguments of kernels."""
    starts = (writable(batch.part_start), writable(batch.vertex_start))
    return (*starts, *map(writable, (batch.vertices, batch.radius, batch.bottom, batch.top)))


def misalignment(first: Floats, second: Floats) -> Floats:
    """Return half the squared distance of the unit vectors at two angles: 1 - cos(difference) (Def. 10, 11).

    Args:
        first, second: (T,) radians; NaN for a missing orientation makes the result NaN.
    """
    result = np.empty(len(first))
    _misalignment(first, second, result)
    return result


@kernel
def _misalignment(first: Floats, second: Floats, result: Floats) -> None:
    for index in range(len(first)):
        result[index] = misalignment_of(first[index], second[index])


@inlined
def misalignment_of(first: float, second: float) -> float:
    """Return the `misalignment` of two angles; callable from kernels."""
    # 1 - cos(first - second) would cancel for nearly equal angles
    x = math.cos(first) - math.cos(second)
    y = math.sin(first) - math.sin(second)
    return 0.5 * (x * x + y * y)


# ------------------------------------------------------------------------------------------- closest pairs

LEFT, RIGHT, LOWER, UPPER = 0, 1, 2, 3


def closest_pairs(batch: FootprintBatch, rows: Integers, uncertainty: Floats, enlargement: float) -> Floats:
    """Compute the signed distance of the closest pair of footprints in each sample.

    Args:
        rows: (T, M), row numbers of M footprints in each of T samples; negative for an absent footprint.
        uncertainty: radius of each row of the batch, at least 0, in footprint units.
        enlargement: length subtracted from each distance, in footprint units.

    Returns:
        (T, 3), three minima over pairs: distance, distance minus both uncertainties, distance plus both
        uncertainties. They are +inf in samples with fewer than two footprints.
    """
    result = np.empty((len(rows), 3))
    members = np.ascontiguousarray(rows), writable(uncertainty), float(enlargement)
    arguments: Any = (*_arrays_of(batch), *members, np.empty((len(batch.vertices), 4)), result)
    closest_rows(*arguments)
    return result


def candidate_pairs(
    batch: FootprintBatch, rows: Integers, uncertainty: Floats, enlargement: float
) -> Integers:
    """Return all pairs that may be a sample's closest pair, with or without uncertainty.

    Args:
        rows: (M,), row numbers of M footprints.
        uncertainty, enlargement: as for `closest_pairs`.

    Returns:
        (P, 2), indices into `rows`, in ascending order; the lesser index of each pair comes first.
    """
    footprints = batch.select(rows)
    first_vertex = footprints.vertex_start[footprints.part_start[:-1]]
    radius = np.repeat(footprints.radius, np.diff(footprints.vertex_start))[:, None]
    lower_corners = np.minimum.reduceat(footprints.vertices - radius, first_vertex)
    upper_corners = np.maximum.reduceat(footprints.vertices + radius, first_vertex)
    closest_distance = closest_pairs(batch, rows[None], uncertainty, enlargement)[0, 2]
    greatest_coordinate = max(np.abs(lower_corners).max(), np.abs(upper_corners).max())
    # 1e-9 covers rounding, as in `closest_rows`
    reach = closest_distance + enlargement + 2.0 * uncertainty[rows].max() + 1e-9 * greatest_coordinate
    # pairs are found by a sweep from left to right, because a matrix of all pairs takes gigabytes for
    # thousands of footprints
    left_order = np.argsort(lower_corners[:, 0], kind="stable")
    lower_corners, upper_corners = lower_corners[left_order], upper_corners[left_order]
    end_positions = np.searchsorted(lower_corners[:, 0], upper_corners[:, 0] + reach, side="right").tolist()
    pairs = []
    for position, end in enumerate(end_positions):
        lower_sides, upper_sides = lower_corners[position + 1 : end, 1], upper_corners[position + 1 : end, 1]
        is_near = (lower_sides <= upper_corners[position, 1] + reach) & (
            lower_corners[position, 1] <= upper_sides + reach
        )
        near_indices = left_order[position + 1 : end][is_near]
        pairs.append(
            np.sort(np.column_stack([np.full_like(near_indices, left_order[position]), near_indices]))
        )
    joined_pairs = np.concatenate(pairs).astype(np.int64)
    return joined_pairs[np.lexsort(joined_pairs.T[::-1])]


@elementwise
@long_kernel
def closest_rows(
    part_start: Integers,
    vertex_start: Integers,
    vertices: Floats,
    radius: Floats,
    bottom: Floats,
    top: Floats,
    members: Integers,
    uncertainty: Floats,
    enlargement: float,
    edges: Floats,
    result: Floats,
) -> None:
    """Fill `result` (T, 3) as in `closest_pairs`; `edges` (V, 4) is scratch space."""
    rows = Rows(part_start, vertex_start, vertices, edges, radius, bottom, top)
    is_filled = np.zeros(len(part_start), dtype=np.bool_)
    member_count = members.shape[1]
    boxes = np.full((member_count, 4), np.inf)
    # footprints are sorted from left to right by insertion, because their order changes little between
    # samples
    member_order = np.arange(member_count)
    for sample in range(result.shape[0]):
        present_count, greatest_coordinate, widest_uncertainty = 0, 0.0, 0.0
        for member in range(member_count):
            row = members[sample, member]
            # absent footprints have empty boxes, which come last
            left, right, lower, upper = np.inf, -np.inf, np.inf, -np.inf
            if row >= 0:
                present_count += 1
                widest_uncertainty = max(widest_uncertainty, uncertainty[row])
                if not is_filled[row]:
                    is_filled[row] = True
                    fill_row(rows, row)
                for part in range(part_start[row], part_start[row + 1]):
                    for vertex in range(vertex_start[part], vertex_start[part + 1]):
                        left = min(left, vertices[vertex, 0] - radius[part])
                        right = max(right, vertices[vertex, 0] + radius[part])
                        lower = min(lower, vertices[vertex, 1] - radius[part])
                        upper = max(upper, vertices[vertex, 1] + radius[part])
                greatest_coordinate = max(greatest_coordinate, max(max(-left, right), max(-lower, upper)))
            boxes[member, LEFT], boxes[member, RIGHT], boxes[member, LOWER], boxes[member, UPPER] = (
                left,
                right,
                lower,
                upper,
            )
        for position in range(1, member_count):
            moved_member, slot = member_order[position], position
            while slot > 0 and boxes[member_order[slot - 1], LEFT] > boxes[moved_member, LEFT]:
                member_order[slot] = member_order[slot - 1]
                slot -= 1
            member_order[slot] = moved_member
        # enlargement and uncertainty reduce distances below the gaps of boxes; 1e-9 covers rounding
        slack = enlargement + 2.0 * widest_uncertainty + 1e-9 * greatest_coordinate
        least_distance, least_low, least_high = np.inf, np.inf, np.inf
        for position in range(present_count):
            first_member = member_order[position]
            for other_position in range(position + 1, present_count):
                second_member = member_order[other_position]
                reach = least_high + slack
                gap_x = boxes[second_member, LEFT] - boxes[first_member, RIGHT]
                if gap_x > reach:
                    # boxes are sorted by their left sides, so all further boxes are farther away
                    break
                gap_y = max(
                    boxes[second_member, LOWER] - boxes[first_member, UPPER],
                    boxes[first_member, LOWER] - boxes[second_member, UPPER],
                )
                if gap_y > reach:
                    continue
                if gap_x > 0.0 and gap_y > 0.0 and gap_x * gap_x + gap_y * gap_y > reach * reach:
                    continue
                first_row, second_row = members[sample, first_member], members[sample, second_member]
                distance = rows_distance(rows, first_row, second_row, enlargement)
                spread = uncertainty[first_row] + uncertainty[second_row]
                least_distance = min(least_distance, distance)
                least_low = min(least_low, distance - spread)
                least_high = min(least_high, distance + spread)
        result[sample, 0], result[sample, 1], result[sample, 2] = least_distance, least_low, least_high


Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Contact:
    """A pair of points, one on each of two footprints.

    Attributes:
        first, second: nearest points of disjoint footprints. For overlapping footprints, the ends of the
            shortest translation that separates them.
        distance: distance of the two points, negative for overlap.
    """

    first: Point
    second: Point
    distance: float


def contact(a: Footprint, b: Footprint) -> Contact:
    """Return the points that attain the signed distance of two footprints (Def. 2-4)."""
    return _contact(a, b, is_protrusion=False)


def protrusion_contact(inner: Footprint, outer: Footprint) -> Contact:
    """Return the points that attain the protrusion of `inner` from `outer` (Prop. 2).

    The first point is the point of `inner` farthest outside `outer`, or the least deep point inside. The
    second point is the nearest point of the boundary of `outer`. The distance is the protrusion, positive
    outside.
    """
    return _contact(inner, outer, is_protrusion=True)


def _contact(first: Footprint, second: Footprint, *, is_protrusion: bool) -> Contact:
    batch = FootprintBatch.from_footprints([first, second])
    operands = [Operand(np.array([[row]])) for row in range(2)]
    x, y, other_x, other_y, distance, _ = contacts(batch, *operands, is_protrusion=is_protrusion)[0].tolist()
    return Contact((x, y), (other_x, other_y), distance)


def enlarge(footprint: Footprint, radius: float) -> Footprint:
    """Return the Minkowski sum of a footprint with a disc of the given radius (at least 0)."""
    return Footprint(tuple(ConvexPart(part.vertices, part.radius + radius) for part in footprint.parts))


def contacts(batch: FootprintBatch, first: Operand, second: Operand, *, is_protrusion: bool) -> Floats:
    """Return the points that attain the signed distance (or protrusion) of two operands in each sample.

    Heights are ignored.

    Returns:
        (T, 6): x and y of a point of `first`, x and y of a point of `second`, their signed distance (or
        protrusion), and the top of the higher footprint. The top is NaN if neither operand has a height. The
        whole row is NaN if an operand is empty.
    """
    result = np.full((len(first.rows), 6), np.nan)
    fill_contacts(
        batch.part_start,
        batch.vertex_start,
        batch.vertices,
        batch.radius,
        batch.top,
        np.ascontiguousarray(first.rows),
        np.ascontiguousarray(second.rows),
        float(first.enlargement),
        float(second.enlargement),
        is_protrusion,
        result,
    )
    return result
