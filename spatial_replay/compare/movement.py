"""Who moved differently in two aligned runs, and how far each object is from itself; signals that differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from spatial_replay.compare.alignment import Alignment
from spatial_replay.compiled import elementwise, kernel
from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Booleans, Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure
from spatial_replay.text import Instant, Sentence, counted, number_text
from spatial_replay.trace.other_units import OTHER_UNITS, require_same_units
from spatial_replay.trace.trace import Trace

_PAIRS_AT_ONCE: Final = 16_384
"""Observations that are compared at once: few enough for the processor's cache."""


@dataclass(frozen=True, slots=True)
class ObjectDiff:
    """One object in two aligned runs.

    Attributes:
        first_ns: the first sample of A in which it is not just where, or as, it is in B.
        apart_ns: the first one in which the two footprints do not touch; None if they always do.
        greatest: the greatest signed distance between the two footprints, at `greatest_ns`; NaN where none
            was measured.
        shift: how far its vertices' mean is away at most.
        only_a, only_b: in how many pairs of samples only one run has it.
    """

    name: str
    first_ns: int
    apart_ns: int | None
    greatest: float
    greatest_ns: int
    shift: float
    only_a: int
    only_b: int


@dataclass(frozen=True, slots=True)
class SignalDiff:
    """One signal in two aligned runs.

    Attributes:
        first_ns: the first sample of A in which its value is not that in B.
        greatest: the greatest difference of two known values, at `greatest_ns`; NaN where there are none.
        ratio: how many times as large the median of its magnitudes is in B; NaN if one of them is 0.
    """

    name: str
    first_ns: int
    greatest: float
    greatest_ns: int
    ratio: float

    @property
    def has_other_unit(self) -> bool:
        """Whether it seems to be in another unit in B: percent instead of parts, millimetres for metres."""
        return self.ratio >= OTHER_UNITS or self.ratio <= 1.0 / OTHER_UNITS


def compare_signals(a: Trace, b: Trace, alignment: Alignment) -> tuple[SignalDiff, ...]:
    """Return the common signals with other values."""
    times_ns = a.times_ns[alignment.a]
    diffs = []
    for name in sorted(set(a.signals) & set(b.signals)):
        one, other = a.signals[name][alignment.a], b.signals[name][alignment.b]
        differs = (one != other) & ~(np.isnan(one) & np.isnan(other))
        if not differs.any():
            continue
        known = np.flatnonzero(~(np.isnan(one) | np.isnan(other)))
        apart = np.abs(other - one)
        farthest = int(known[apart[known].argmax()]) if len(known) else None
        sizes = [float(np.median(np.abs(each[known]))) if len(known) else 0.0 for each in (one, other)]
        diffs.append(
            SignalDiff(
                name,
                int(times_ns[differs.argmax()]),
                np.nan if farthest is None else float(apart[farthest]),
                int(times_ns[differs.argmax() if farthest is None else farthest]),
                sizes[1] / sizes[0] if min(sizes) > 0.0 else np.nan,
            )
        )
    return tuple(diffs)


def compare_objects(a: Trace, b: Trace, alignment: Alignment) -> tuple[ObjectDiff, ...]:
    """Return the common objects that moved differently: those apart first come first, then the farthest.

    Raises:
        UsageError: no object is in both runs, or one run is in another unit.
    """
    names = sorted(set(a.names) & set(b.names))
    if not names and (a.names or b.names):
        raise UsageError(
            f"the runs have no object in common: A has {_listed(a.names)}; B has {_listed(b.names)}. "
            "Map the same things to the same names"
        )
    require_same_units(a, b)
    # (P, K) observations
    one, other = (
        trace.rows[rows][:, [trace.names.index(name) for name in names]]
        for trace, rows in ((a, alignment.a), (b, alignment.b))
    )
    in_both = np.flatnonzero((one >= 0) & (other >= 0))
    moved, shift, distances = np.zeros(one.shape, np.bool_), np.zeros(one.shape), np.full(one.shape, np.nan)
    for start in range(0, len(in_both), _PAIRS_AT_ONCE):
        places = in_both[start : start + _PAIRS_AT_ONCE]
        found = _compared(a, one.flat[places], b, other.flat[places])
        for values, part in zip((moved, shift, distances), found, strict=True):
            values.flat[places] = part
    times_ns = a.times_ns[alignment.a]
    only = (one >= 0) & (other < 0), (other >= 0) & (one < 0)
    diffs = []
    for number, name in enumerate(names):
        only_a, only_b = (each[:, number] for each in only)
        differs = moved[:, number] | only_a | only_b
        if not differs.any():
            continue
        distance = distances[:, number]
        apart = np.flatnonzero(distance > 0.0)
        farthest = None if np.isnan(distance).all() else int(np.nanargmax(distance))
        diffs.append(
            ObjectDiff(
                name,
                int(times_ns[differs.argmax()]),
                int(times_ns[apart[0]]) if len(apart) else None,
                np.nan if farthest is None else float(distance[farthest]),
                int(times_ns[differs.argmax() if farthest is None else farthest]),
                float(np.sqrt(shift[:, number].max())),
                int(np.count_nonzero(only_a)),
                int(np.count_nonzero(only_b)),
            )
        )
    never = int(a.times_ns[-1]) + 1
    return tuple(
        sorted(diffs, key=lambda each: (each.apart_ns or never, -each.shift, each.first_ns, each.name))
    )


def _compared(a: Trace, one: Integers, b: Trace, other: Integers) -> tuple[Booleans, Floats, Floats]:
    """Compare observations in pairs.

    Returns:
        Which differ, the squared shift of their vertices' mean, and the signed distance of the two
        footprints; NaN for those that do not differ.
    """
    both = FootprintBatch.concatenate([a.footprints.select(one), b.footprints.select(other)])
    first = np.arange(len(one))
    second = first + len(one)
    moved, shift = np.zeros(len(one), np.bool_), np.zeros(len(one))
    shapes = both.part_start, both.vertex_start, both.vertices, both.radius
    _compare_shapes(*shapes, first, second, moved, shift)
    columns = [(both.bottom[first], both.bottom[second]), (both.top[first], both.top[second])]
    columns += [(a.yaw[one], b.yaw[other]), (a.uncertainty[one], b.uncertainty[other])]
    for value, beside in columns:
        moved |= (value != beside) & ~(np.isnan(value) & np.isnan(beside))
    distance = np.full(len(one), np.nan)
    operands = [Operand(rows[moved, None]) for rows in (first, second)]
    distance[moved] = measure(both, operands, [MeasureRequest("signed_distance", 0, 1)])[0]
    return moved, shift, distance


@elementwise
@kernel
def _compare_shapes(
    part_start: Integers,
    vertex_start: Integers,
    vertices: Floats,
    radius: Floats,
    first: Integers,
    second: Integers,
    differs: Booleans,
    shift: Floats,
) -> None:
    """Fill in for pairs of rows whether shapes differ, and the squared shift of their vertices' mean."""
    for k in range(len(first)):
        parts, others = part_start[first[k]], part_start[second[k]]
        count, other_count = part_start[first[k] + 1] - parts, part_start[second[k] + 1] - others
        differ = count != other_count
        for p in range(min(count, other_count)):
            size = vertex_start[parts + p + 1] - vertex_start[parts + p]
            other_size = vertex_start[others + p + 1] - vertex_start[others + p]
            if size != other_size or radius[parts + p] != radius[others + p]:
                differ = True
        begin, end = vertex_start[parts], vertex_start[parts + count]
        other_begin, other_end = vertex_start[others], vertex_start[others + other_count]
        if not differ:
            for i in range(end - begin):
                for axis in range(2):
                    differ |= vertices[begin + i, axis] != vertices[other_begin + i, axis]
        differs[k] = differ
        if not differ or begin == end or other_begin == other_end:
            continue
        # relative to one vertex, so that coordinates far from the origin do not cancel
        x0, y0 = vertices[begin, 0], vertices[begin, 1]
        x = y = other_x = other_y = 0.0
        for i in range(begin, end):
            x += vertices[i, 0] - x0
            y += vertices[i, 1] - y0
        for i in range(other_begin, other_end):
            other_x += vertices[i, 0] - x0
            other_y += vertices[i, 1] - y0
        x = other_x / (other_end - other_begin) - x / (end - begin)
        y = other_y / (other_end - other_begin) - y / (end - begin)
        shift[k] = x * x + y * y


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (", …" if len(names) > 8 else "") or "none"


def movement_sentence(each: ObjectDiff, start_ns: int) -> Sentence:
    """Return since when an object moved differently, and how far the two are apart."""
    parts: list[str | Instant] = ["differs since ", Instant(each.first_ns, start_ns)]
    if each.shift:
        parts.append(f", by up to {number_text(each.shift)}")
    if each.apart_ns is not None:
        parts += ["; apart from itself since ", Instant(each.apart_ns, start_ns)]
        parts += [f", farthest by {number_text(each.greatest)} at ", Instant(each.greatest_ns, start_ns)]
    for which, count in (("A", each.only_a), ("B", each.only_b)):
        if count:
            parts.append(f"; only {which} has it in {counted(count, 'sample')}")
    return Sentence(*parts)


def signal_sentence(each: SignalDiff, start_ns: int) -> Sentence:
    """Return since when a signal has other values, by how much, and whether its unit may be another."""
    parts: list[str | Instant] = ["differs since ", Instant(each.first_ns, start_ns)]
    if each.greatest > 0.0:
        parts += [f", by up to {number_text(each.greatest)} at ", Instant(each.greatest_ns, start_ns)]
    if each.has_other_unit:
        times, which = (each.ratio, "B") if each.ratio > 1.0 else (1.0 / each.ratio, "A")
        parts.append(f"; {times:,.0f} times as large in {which}: it may be in another unit there")
    return Sentence(*parts)
