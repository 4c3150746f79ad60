"""From objects as a log reports them to a trace: checked, put right, in columns.

Rows of unequal length in one flat array: row r is values[start[r] : start[r + 1]].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import Concave, Footprint
from spatial_replay.geometry.outline import SOUND, normalise_polygons
from spatial_replay.trace.trace import ABSENT, Trace


def starts_from_counts(counts: Integers) -> Integers:
    """(n,) lengths of rows → (n + 1,) where each begins and the last ends."""
    start = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=start[1:])
    return start


def flat_index(first: Integers, counts: Integers) -> Integers:
    """Where the elements of rows stand that begin at `first` (n,) and have `counts` (n,) elements."""
    begins = starts_from_counts(counts)
    return np.asarray(np.repeat(first - begins[:-1], counts) + np.arange(begins[-1], dtype=np.int64))


def count_in_rows(flags: NDArray[np.bool_], start: Integers) -> Integers:
    """How many flags are set in each row; rows may be empty."""
    total = starts_from_counts(flags.astype(np.int64))
    return np.asarray(total[start[1:]] - total[start[:-1]])


Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Observations:
    """R objects seen in T samples, as reported: nothing is checked yet, vertices come in any order.

    Attributes:
        times_ns: (T,) int64, increasing.
        sample: (R,) int64, the index of the sample in which an object was seen.
        name: (R,) int64, index into `names`.
        names: objects' names, in any order.
        class_code: (R,) int64, index into `classes`.
        classes: class names; None for objects without one.
        yaw: (R,) float64, radians; NaN for none.
        uncertainty: (R,) float64, radius in footprint units.
        shapes: the R footprints, bottom and top NaN where there is no height.
        invalid: (R,) bool, where the report itself says that a number is not known.
        signals: numeric signals by name, each (T,) float64, NaN where not known.
    """

    times_ns: Integers
    sample: Integers
    name: Integers
    names: Sequence[str]
    class_code: Integers
    classes: tuple[str | None, ...]
    yaw: Floats
    uncertainty: Floats
    shapes: FootprintBatch
    invalid: Flags
    signals: Mapping[str, Floats]


def trace_from_observations(seen: Observations, *, concave: Concave) -> tuple[Trace, dict[int, str]]:
    """Check every observation and bring its polygons into the form that kernels read.

    Observations with a number that is not finite become unreadable rows. Samples with an object named
    twice, a negative radius or uncertainty, a height upside down, or a polygon that makes no footprint are
    left out.

    Args:
        concave: what becomes of polygons that are not convex.

    Returns:
        the trace of the other samples, and what is wrong with those left out, by their index.
    """
    seen = _ordered(seen)
    faults = _twice_named(seen)
    readable = _finite(seen) & ~seen.invalid
    faults = _wrong_numbers(seen, readable) | faults
    shapes, misshapen = _put_right(seen, readable, concave)
    faults = misshapen | faults
    rows = np.full((len(seen.times_ns), len(seen.names)), ABSENT, np.int64)
    number = np.arange(len(seen.name), dtype=np.int64)
    rows[seen.sample, seen.name] = np.where(readable, number, -2 - number)
    trace = Trace(
        times_ns=seen.times_ns,
        names=tuple(seen.names),
        rows=rows,
        footprints=shapes,
        yaw=seen.yaw,
        uncertainty=seen.uncertainty,
        class_code=seen.class_code,
        classes=seen.classes,
        signals=seen.signals,
    )
    if faults:
        kept = np.ones(len(trace), np.bool_)
        kept[list(faults)] = False
        trace = trace.take(np.flatnonzero(kept))
    return trace, faults


def _ordered(seen: Observations) -> Observations:
    """The same observations by sample, then name, with names in order of code points."""
    order = sorted(range(len(seen.names)), key=seen.names.__getitem__)
    names = [seen.names[index] for index in order]
    rank = np.zeros(len(order), np.int64)
    rank[order] = np.arange(len(order))
    name = rank[seen.name]
    key = seen.sample * max(1, len(names)) + name
    if (key[1:] >= key[:-1]).all():
        return replace(seen, names=names, name=name)
    by_key = np.argsort(key, kind="stable")
    return replace(
        seen,
        names=names,
        name=name[by_key],
        sample=seen.sample[by_key],
        class_code=seen.class_code[by_key],
        yaw=seen.yaw[by_key],
        uncertainty=seen.uncertainty[by_key],
        shapes=seen.shapes.select(by_key),
        invalid=seen.invalid[by_key],
    )


def _twice_named(seen: Observations) -> dict[int, str]:
    again = (seen.sample[1:] == seen.sample[:-1]) & (seen.name[1:] == seen.name[:-1])
    return {
        int(seen.sample[row]): f"object {seen.names[seen.name[row]]!r} is there twice; name each object once"
        for row in np.flatnonzero(again).tolist()
    }


def _finite(seen: Observations) -> Flags:
    """(R,) whether every number of an observation is finite; no yaw and no height count as such."""
    shapes = seen.shapes
    infinite = np.asarray(~np.isfinite(shapes.vertices).all(axis=1))
    bad_vertices = count_in_rows(infinite, shapes.vertex_start)
    bad_parts = count_in_rows((bad_vertices > 0) | ~np.isfinite(shapes.radius), shapes.part_start)
    no_height = np.isnan(shapes.bottom) & np.isnan(shapes.top)
    return np.asarray(
        (bad_parts == 0)
        & np.isfinite(seen.uncertainty)
        & ~np.isinf(seen.yaw)
        & (no_height | (np.isfinite(shapes.bottom) & np.isfinite(shapes.top)))
    )


def _wrong_numbers(seen: Observations, readable: Flags) -> dict[int, str]:
    shapes = seen.shapes
    with np.errstate(invalid="ignore"):
        checks = (
            (np.diff(shapes.part_start) == 0, "has no footprint; give it a polygon or parts"),
            (
                count_in_rows(np.diff(shapes.vertex_start) == 0, shapes.part_start) > 0,
                "has a part without vertices; give each part at least one",
            ),
            (
                count_in_rows(shapes.radius < 0, shapes.part_start) > 0,
                "has a part with a negative radius; give a radius of at least 0",
            ),
            (seen.uncertainty < 0, "has a negative uncertainty; give a radius of at least 0"),
            (shapes.bottom > shapes.top, "has a height whose bottom is above its top; give [bottom, top]"),
        )
    faults: dict[int, str] = {}
    for wrong, what in checks:
        for row in np.flatnonzero(wrong & readable).tolist():
            faults.setdefault(int(seen.sample[row]), f"object {seen.names[seen.name[row]]!r} {what}")
    return faults


def _put_right(
    seen: Observations, readable: Flags, concave: Concave
) -> tuple[FootprintBatch, dict[int, str]]:
    """Normalised polygons; the few that are not convex are cut up one by one."""
    shapes = seen.shapes
    part_counts = np.diff(shapes.part_start)
    vertex_start, vertices, fault = normalise_polygons(shapes.vertex_start, shapes.vertices)
    shapes = replace(shapes, vertex_start=vertex_start, vertices=vertices)
    owner = np.repeat(np.arange(len(readable)), part_counts)
    odd = np.flatnonzero((fault != SOUND) & readable[owner] & (np.diff(vertex_start) > 0))
    pieces: dict[int, Footprint] = {}
    faults: dict[int, str] = {}
    for part in odd.tolist():
        polygon = vertices[vertex_start[part] : vertex_start[part + 1]]
        try:
            pieces[part] = Footprint.polygon(polygon, concave=concave)
        except GeometryError as error:
            row = int(owner[part])
            faults.setdefault(int(seen.sample[row]), f"object {seen.names[seen.name[row]]!r}: {error}")
    return _with_pieces(shapes, pieces) if pieces else shapes, faults


def _with_pieces(shapes: FootprintBatch, pieces: Mapping[int, Footprint]) -> FootprintBatch:
    """The shapes with some of their parts replaced by the parts of a footprint each."""
    counts = np.ones(len(shapes.radius), np.int64)
    counts[list(pieces)] = [len(footprint.parts) for footprint in pieces.values()]
    added = [part.vertices for footprint in pieces.values() for part in footprint.parts]
    vertex_counts = np.concatenate([np.diff(shapes.vertex_start), [len(vertices) for vertices in added]])
    vertices = np.concatenate([shapes.vertices, *added])
    begins = starts_from_counts(vertex_counts)[:-1]
    first = np.arange(len(shapes.radius), dtype=np.int64)
    first[list(pieces)] = len(shapes.radius) + starts_from_counts(counts[list(pieces)])[:-1]
    order = flat_index(first, counts)
    return replace(
        shapes,
        part_start=starts_from_counts(counts)[shapes.part_start],
        vertex_start=starts_from_counts(vertex_counts[order]),
        vertices=vertices[flat_index(begins[order], vertex_counts[order])],
        radius=np.repeat(shapes.radius, counts),
    )
