"""Measurements of footprints and orientations over many samples, in one kernel call."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from spatial_replay.compiled import inlined, kernel
from spatial_replay.cores import over_cores
from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import Floats, Integers, read_only_floats
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.kernels import NOTHING, measure_rows

Quantity: TypeAlias = Literal[
    "signed_distance", "protrusion", "min_x", "max_x", "min_y", "max_y", "min_z", "max_z",
    "centroid_min_x", "centroid_max_x", "centroid_min_y", "centroid_max_y",
]  # fmt: skip

# kernels address a quantity by its position in the list above
QUANTITY_CODES: Mapping[str, int] = MappingProxyType(
    {name: code for code, name in enumerate(get_args(Quantity))}
)
_BETWEEN_TWO = frozenset({"signed_distance", "protrusion"})
_SHARE = 16_384
"""So many quantities pay for a thread of their own."""
_NO_ROWS = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Operand:
    """A footprint over T samples: the union of some rows in each sample.

    Attributes:
        rows: (T, M) int64, row numbers into a `FootprintBatch`; any negative number leaves the
            place empty. A single object has M = 1, a group M = its number of members.
        enlargement: radius of the disc added (Minkowski sum), in footprint units.
    """

    rows: Integers
    enlargement: float = 0.0


@dataclass(frozen=True, slots=True)
class MeasureRequest:
    """One quantity of one operand, or between two (indices into the operands)."""

    quantity: Quantity
    first: int
    second: int = -1


def measure(batch: FootprintBatch, operands: Sequence[Operand], requests: Sequence[MeasureRequest]) -> Floats:
    """Compute each requested quantity in each sample.

    signed_distance(A, B) is the least over pairs of parts of the signed distance of two rounded convex
    parts: their distance when apart, minus their penetration depth when not (Def. 2-4 of the paper),
    minus both radii; with height intervals on both footprints, that of upright prisms. protrusion(A, B)
    is the greatest over parts of A, of the least over parts of B, of how far the one sticks out of the
    other: max over vertices p of sd(p, B's polygon) + r_A - r_B, and for prisms the greatest of that,
    B.bottom - A.bottom and A.top - B.top. Projections run over all parts (radius and enlargement
    included; the centroid's: area centroids of the unrounded polygons). Over an empty union the
    least is +inf and the greatest -inf. Along z, a footprint without a height gives NaN.

    Returns:
        (K, T) float64 for K requests.

    Raises:
        GeometryError: operands over different numbers of samples, a row the batch does not have, a
            request for an operand that does not exist.
    """
    values, prepared = _prepared(batch, operands, requests)
    arguments = (*prepared, np.empty((len(batch.vertices), 4)), values)
    least = _SHARE // max(len(requests), 1) + 1
    over_cores(measure_rows, lambda *share: measure_rows(*arguments, *share), values.shape[1], least)
    return values


class Remeasured:
    """Requests that are measured again and again, of footprints with other outlines each time.

    Each thread needs its own, since it measures in the same room each time.
    """

    def __init__(
        self, batch: FootprintBatch, operands: Sequence[Operand], requests: Sequence[MeasureRequest]
    ) -> None:
        self._values, prepared = _prepared(batch, operands, requests)
        self._before, self._after = prepared[:2], prepared[3:]
        self._edges = np.empty((len(batch.vertices), 4))

    def another(self) -> Remeasured:
        """Return the same with room of its own."""
        made = copy(self)
        made._values, made._edges = self._values.copy(), np.empty_like(self._edges)
        return made

    def measure(self, vertices: Floats) -> Floats:
        """Return (K, T), kept until the next call; between footprints that rest nothing is measured again.

        Args:
            vertices: (V or more, 2), in the places of the batch's.
        """
        values, room = self._values, (self._edges, self._values)
        arguments: Any = (*self._before, read_only_floats(vertices), *self._after, *room, 0, values.shape[1])
        measure_rows(*arguments)
        return values


def _prepared(
    batch: FootprintBatch, operands: Sequence[Operand], requests: Sequence[MeasureRequest]
) -> tuple[Floats, Any]:
    """Return values (K, T), of requests that rest already measured, and what `measure_rows` takes first."""
    samples = {operand.rows.shape[0] for operand in operands}
    if len(samples) > 1:
        raise GeometryError(f"operands span {sorted(samples)} samples; give each the same number")
    members = np.concatenate([np.ravel(operand.rows) for operand in operands] or [_NO_ROWS])
    if members.size and members.max() >= len(batch):
        raise GeometryError(f"an operand has row {members.max()}; the batch has {len(batch)} rows, from 0")
    width = np.array([operand.rows.shape[1] for operand in operands], dtype=np.int64)
    size = np.array([operand.rows.size for operand in operands], dtype=np.int64)
    for request in requests:
        _check_request(request, len(operands))
    values = np.empty((len(requests), samples.pop() if samples else 0))
    codes = np.array([QUANTITY_CODES[request.quantity] for request in requests], dtype=np.int64)
    if values.shape[1] > 1:
        rests = [_rests(operand) for operand in operands]
        still = [k for k, each in enumerate(requests) if all(rests[o] for o in _operands_of(each))]
        if still:
            once = [Operand(operand.rows[:1], operand.enlargement) for operand in operands]
            values[still] = measure(batch, once, [requests[k] for k in still])
            codes[still] = NOTHING
    return values, (
        batch.part_start,
        batch.vertex_start,
        batch.vertices,
        batch.radius,
        batch.bottom,
        batch.top,
        members,
        np.concatenate([[0], np.cumsum(size)]),
        width,
        np.array([operand.enlargement for operand in operands], dtype=np.float64),
        codes,
        np.array([request.first for request in requests], dtype=np.int64),
        np.array([request.second for request in requests], dtype=np.int64),
    )


def _rests(operand: Operand) -> bool:
    """Return whether an operand has the same rows in all samples."""
    rows = operand.rows
    return bool((rows[0] == rows[-1]).all() and (rows == rows[0]).all())


def _operands_of(request: MeasureRequest) -> tuple[int, ...]:
    return (request.first, request.second) if request.quantity in _BETWEEN_TWO else (request.first,)


def _check_request(request: MeasureRequest, operand_count: int) -> None:
    if request.quantity not in QUANTITY_CODES:
        raise GeometryError(f"no quantity {request.quantity!r}; there are {', '.join(QUANTITY_CODES)}")
    for index in _operands_of(request):
        if not 0 <= index < operand_count:
            asked = f"{request.quantity} asks for operand {index}"
            raise GeometryError(f"{asked}; there are {operand_count}, from 0")


def misalignment(first: Floats, second: Floats) -> Floats:
    """Return half the squared distance of unit vectors at two angles (Def. 10, 11): 1 - cos(difference).

    Args:
        first, second: (T,) radians; NaN for no orientation, which makes the result NaN.
    """
    result = np.empty(len(first))
    _misalignment(first, second, result)
    return result


@kernel
def _misalignment(first: Floats, second: Floats, result: Floats) -> None:
    for k in range(len(first)):
        result[k] = misalignment_of(first[k], second[k])


@inlined
def misalignment_of(first: float, second: float) -> float:
    """Return the `misalignment` of two angles; callable from kernels."""
    # 1 - cos(first - second) would cancel for nearly equal angles
    x = math.cos(first) - math.cos(second)
    y = math.sin(first) - math.sin(second)
    return 0.5 * (x * x + y * y)
