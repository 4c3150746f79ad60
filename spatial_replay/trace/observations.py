"""Build a trace from the objects that a log reports: check, normalise and arrange them in columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import (
    Booleans,
    Floats,
    Integers,
    count_in_rows,
    flat_index,
    starts_from_counts,
)
from spatial_replay.geometry.footprint import Concave, Footprint, FootprintBatch
from spatial_replay.geometry.outline import SOUND, normalise_polygons
from spatial_replay.trace.trace import ABSENT, Trace


@dataclass(frozen=True, slots=True)
class Observations:
    """R objects detected in T samples, as reported: unchecked, vertices in any order.

    Attributes:
        times_ns: (T,) int64, increasing.
        sample: (R,) int64, index of the sample in which an object was detected.
        name: (R,) int64, index into `names`.
        names: names of the objects, in any order.
        class_code: (R,) int64, index into `classes`.
        classes: class names; None for objects without a class.
        yaw: (R,) float64, radians; NaN for objects without orientation.
        uncertainty: (R,) float64, radius in footprint units.
        shapes: footprints of the R objects; bottom and top are NaN for objects without height.
        invalid: (R,) bool, whether the report itself marks a number as unknown.
        signals: numeric signals by name, each (T,) float64, NaN where unknown.
        reported_ns: (R,) int64, times of the reports; None if all equal the times of their samples.
        signals_reported_ns: times of the signals' reports, as in a `Trace`.
        lasting: objects that keep their position until their next report.
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
    invalid: Booleans
    signals: Mapping[str, Floats]
    reported_ns: Integers | None = None
    signals_reported_ns: Mapping[str, Integers] = field(default_factory=dict)
    lasting: frozenset[str] = frozenset()


def trace_from_observations(observed: Observations, *, concave: Concave) -> tuple[Trace, dict[int, str]]:
    """Check every observation and normalise its polygons.

    Observations with a number that is not finite become unreadable rows. Samples are left out if they name
    an object twice, or have a negative radius or uncertainty, a height upside down, or an invalid polygon.

    Args:
        concave: treatment of polygons that are not convex.

    Returns:
        the trace of the remaining samples, and the fault of each sample left out, by its index.
    """
    observed = _sort_observations(observed)
    faults = _duplicates(observed)
    readable, shapes, wrong = check_observations(observed, concave=concave)
    # of several faults of a sample, the duplicate is reported
    faults = wrong | faults
    rows = np.full((len(observed.times_ns), len(observed.names)), ABSENT, np.int64)
    number = np.arange(len(observed.name), dtype=np.int64)
    rows[observed.sample, observed.name] = np.where(readable, number, -2 - number)
    reported_ns = None
    if observed.reported_ns is not None:
        reported_ns = np.repeat(observed.times_ns[:, None], len(observed.names), axis=1)
        reported_ns[observed.sample, observed.name] = observed.reported_ns
    trace = Trace(
        times_ns=observed.times_ns,
        names=tuple(observed.names),
        rows=rows,
        footprints=shapes,
        yaw=observed.yaw,
        uncertainty=observed.uncertainty,
        class_code=observed.class_code,
        classes=observed.classes,
        signals=observed.signals,
        reported_ns=reported_ns,
        signals_reported_ns=observed.signals_reported_ns,
        lasting=observed.lasting,
    )
    if faults:
        is_sound = np.ones(len(trace), np.bool_)
        is_sound[list(faults)] = False
        trace = trace.take(np.flatnonzero(is_sound))
    return trace, faults


def check_observations(
    observed: Observations, *, concave: Concave
) -> tuple[Booleans, FootprintBatch, dict[int, str]]:
    """Check every observation on its own, and normalise its polygons.

    Returns:
        whether each observation (R,) has only finite numbers; the footprints; and the fault of each sample
        with an impossible observation, by its index.
    """
    readable = _finite(observed) & ~observed.invalid
    faults = _wrong_numbers(observed, readable)
    shapes, misshapen = _normalise_shapes(observed, readable, concave)
    return readable, shapes, misshapen | faults


def _sort_observations(observed: Observations) -> Observations:
    """Sort the observations by sample, then by name in order of code points."""
    order = sorted(range(len(observed.names)), key=observed.names.__getitem__)
    names = [observed.names[index] for index in order]
    rank = np.zeros(len(order), np.int64)
    rank[order] = np.arange(len(order))
    name = rank[observed.name]
    # one integer sorts by both
    key = observed.sample * max(1, len(names)) + name
    # readers mostly yield sorted rows, which need no copies
    if (key[1:] >= key[:-1]).all():
        return replace(observed, names=names, name=name)
    by_key = np.argsort(key, kind="stable")
    return replace(
        observed,
        names=names,
        name=name[by_key],
        sample=observed.sample[by_key],
        class_code=observed.class_code[by_key],
        yaw=observed.yaw[by_key],
        uncertainty=observed.uncertainty[by_key],
        shapes=observed.shapes.select(by_key),
        invalid=observed.invalid[by_key],
        reported_ns=None if observed.reported_ns is None else observed.reported_ns[by_key],
    )


def _duplicates(observed: Observations) -> dict[int, str]:
    again = (observed.sample[1:] == observed.sample[:-1]) & (observed.name[1:] == observed.name[:-1])
    what = "is there twice; name each object once"
    return {
        int(observed.sample[row]): f"object {observed.names[observed.name[row]]!r} {what}"
        for row in np.flatnonzero(again).tolist()
    }


def _finite(observed: Observations) -> Booleans:
    """Return whether all numbers of each observation are finite, (R,). A missing yaw or height is allowed."""
    shapes = observed.shapes
    is_bad = ~np.isfinite(shapes.radius)
    finite = np.isfinite(shapes.vertices)
    if not finite.all():
        # per vertex only if needed: `all(axis=1)` over pairs takes ten times as long as `all()`
        is_bad |= count_in_rows(np.asarray(~finite.all(axis=1)), shapes.vertex_start) > 0
    bad_parts = count_in_rows(is_bad, shapes.part_start)
    no_height = np.isnan(shapes.bottom) & np.isnan(shapes.top)
    return np.asarray(
        (bad_parts == 0)
        & np.isfinite(observed.uncertainty)
        & ~np.isinf(observed.yaw)
        & (no_height | (np.isfinite(shapes.bottom) & np.isfinite(shapes.top)))
    )


def _wrong_numbers(observed: Observations, readable: Booleans) -> dict[int, str]:
    shapes = observed.shapes
    # NaN in a comparison is no fault: such rows are unreadable
    with np.errstate(invalid="ignore"):
        empty_parts = count_in_rows(np.diff(shapes.vertex_start) == 0, shapes.part_start)
        negative_parts = count_in_rows(shapes.radius < 0, shapes.part_start)
        checks = (
            (np.diff(shapes.part_start) == 0, "has no footprint; give it a polygon or parts"),
            (empty_parts > 0, "has a part without vertices; give each part at least one"),
            (negative_parts > 0, "has a part with a negative radius; give a radius of at least 0"),
            (observed.uncertainty < 0, "has a negative uncertainty; give a radius of at least 0"),
            (shapes.bottom > shapes.top, "has a height whose bottom is above its top; give [bottom, top]"),
        )
    faults: dict[int, str] = {}
    for wrong, what in checks:
        for row in np.flatnonzero(wrong & readable).tolist() if wrong.any() else ():
            name = observed.names[observed.name[row]]
            faults.setdefault(int(observed.sample[row]), f"object {name!r} {what}")
    return faults


def _normalise_shapes(
    observed: Observations, readable: Booleans, concave: Concave
) -> tuple[FootprintBatch, dict[int, str]]:
    """Return normalised polygons and the samples' faults; polygons that are not convex are decomposed."""
    shapes = observed.shapes
    part_counts = np.diff(shapes.part_start)
    vertex_start, vertices, fault = normalise_polygons(shapes.vertex_start, shapes.vertices)
    shapes = replace(shapes, vertex_start=vertex_start, vertices=vertices)
    if not fault.any():
        return shapes, {}
    owner = np.repeat(np.arange(len(readable)), part_counts)
    # few polygons are concave, so the slow decomposition treats them one by one
    # unreadable parts stay unknown, and parts without vertices have a fault already
    odd = np.flatnonzero((fault != SOUND) & readable[owner] & (np.diff(vertex_start) > 0))
    pieces: dict[int, Footprint] = {}
    faults: dict[int, str] = {}
    for part in odd.tolist():
        polygon = vertices[vertex_start[part] : vertex_start[part + 1]]
        try:
            pieces[part] = Footprint.polygon(polygon, concave=concave)
        except GeometryError as error:
            name = observed.names[observed.name[owner[part]]]
            faults.setdefault(int(observed.sample[owner[part]]), f"object {name!r}: {error}")
    return _with_pieces(shapes, pieces) if pieces else shapes, faults


def _with_pieces(shapes: FootprintBatch, pieces: Mapping[int, Footprint]) -> FootprintBatch:
    """Replace each given part of the shapes by the parts of a footprint."""
    counts = np.ones(len(shapes.radius), np.int64)
    counts[list(pieces)] = [len(footprint.parts) for footprint in pieces.values()]
    added = [part.vertices for footprint in pieces.values() for part in footprint.parts]
    vertex_counts = np.concatenate([np.diff(shapes.vertex_start), [len(vertices) for vertices in added]])
    vertices = np.concatenate([shapes.vertices, *added])
    begins = starts_from_counts(vertex_counts)[:-1]
    first = np.arange(len(shapes.radius), dtype=np.int64)
    # pieces are behind all parts, and `order` brings them to their places
    first[list(pieces)] = len(shapes.radius) + starts_from_counts(counts[list(pieces)])[:-1]
    order = flat_index(first, counts)
    return replace(
        shapes,
        part_start=starts_from_counts(counts)[shapes.part_start],
        vertex_start=starts_from_counts(vertex_counts[order]),
        vertices=vertices[flat_index(begins[order], vertex_counts[order])],
        radius=np.repeat(shapes.radius, counts),
    )
