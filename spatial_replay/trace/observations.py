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
    """R reports of objects in T samples, unchecked, with vertices in any order.

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
        reported_ns: (R,) int64, times of the reports; None if every report has its sample's time.
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
    an object twice. They are also left out if an object has a negative radius or uncertainty, a top below
    its bottom, or an invalid polygon.

    Args:
        concave: treatment of polygons that are not convex.

    Returns:
        the trace of the remaining samples, and the fault of each sample left out, by its index.
    """
    observed = _sort_observations(observed)
    faults = _duplicates(observed)
    is_readable, shapes, observation_faults = check_observations(observed, concave=concave)
    # if a sample has several faults, the duplicate is reported
    faults = observation_faults | faults
    rows = np.full((len(observed.times_ns), len(observed.names)), ABSENT, np.int64)
    row_numbers = np.arange(len(observed.name), dtype=np.int64)
    rows[observed.sample, observed.name] = np.where(is_readable, row_numbers, -2 - row_numbers)
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
        is_valid = np.ones(len(trace), np.bool_)
        is_valid[list(faults)] = False
        trace = trace.take(np.flatnonzero(is_valid))
    return trace, faults


def check_observations(
    observed: Observations, *, concave: Concave
) -> tuple[Booleans, FootprintBatch, dict[int, str]]:
    """Check every observation on its own, and normalise its polygons.

    Returns:
        whether each observation is readable (R,), the footprints, and the faults of invalid observations by
        sample index.
    """
    is_readable = _finite(observed) & ~observed.invalid
    faults = _wrong_numbers(observed, is_readable)
    shapes, shape_faults = _normalise_shapes(observed, is_readable, concave)
    return is_readable, shapes, shape_faults | faults


def _sort_observations(observed: Observations) -> Observations:
    """Sort the observations by sample, then by name in order of code points."""
    name_order = sorted(range(len(observed.names)), key=observed.names.__getitem__)
    names = [observed.names[index] for index in name_order]
    rank = np.zeros(len(name_order), np.int64)
    rank[name_order] = np.arange(len(name_order))
    name_index = rank[observed.name]
    # one integer per observation sorts by sample and name
    sort_keys = observed.sample * max(1, len(names)) + name_index
    # readers mostly yield sorted rows, which need no copies
    if (sort_keys[1:] >= sort_keys[:-1]).all():
        return replace(observed, names=names, name=name_index)
    row_order = np.argsort(sort_keys, kind="stable")
    return replace(
        observed,
        names=names,
        name=name_index[row_order],
        sample=observed.sample[row_order],
        class_code=observed.class_code[row_order],
        yaw=observed.yaw[row_order],
        uncertainty=observed.uncertainty[row_order],
        shapes=observed.shapes.select(row_order),
        invalid=observed.invalid[row_order],
        reported_ns=None if observed.reported_ns is None else observed.reported_ns[row_order],
    )


def _duplicates(observed: Observations) -> dict[int, str]:
    is_duplicate = (observed.sample[1:] == observed.sample[:-1]) & (observed.name[1:] == observed.name[:-1])
    problem = "is there twice; name each object once"
    return {
        int(observed.sample[row]): f"object {observed.names[observed.name[row]]!r} {problem}"
        for row in np.flatnonzero(is_duplicate).tolist()
    }


def _finite(observed: Observations) -> Booleans:
    """Return whether all numbers of each observation are finite, (R,). A missing yaw or height is allowed."""
    shapes = observed.shapes
    is_bad_part = ~np.isfinite(shapes.radius)
    is_finite = np.isfinite(shapes.vertices)
    if not is_finite.all():
        # per vertex only if needed: `all(axis=1)` over pairs takes ten times as long as `all()`
        is_bad_part |= count_in_rows(np.asarray(~is_finite.all(axis=1)), shapes.vertex_start) > 0
    bad_part_counts = count_in_rows(is_bad_part, shapes.part_start)
    has_no_height = np.isnan(shapes.bottom) & np.isnan(shapes.top)
    return np.asarray(
        (bad_part_counts == 0)
        & np.isfinite(observed.uncertainty)
        & ~np.isinf(observed.yaw)
        & (has_no_height | (np.isfinite(shapes.bottom) & np.isfinite(shapes.top)))
    )


def _wrong_numbers(observed: Observations, is_readable: Booleans) -> dict[int, str]:
    shapes = observed.shapes
    # NaN in a comparison is no fault: such rows are unreadable
    with np.errstate(invalid="ignore"):
        empty_part_counts = count_in_rows(np.diff(shapes.vertex_start) == 0, shapes.part_start)
        negative_part_counts = count_in_rows(shapes.radius < 0, shapes.part_start)
        checks = (
            (np.diff(shapes.part_start) == 0, "has no footprint; give it a polygon or parts"),
            (empty_part_counts > 0, "has a part without vertices; give each part at least one"),
            (negative_part_counts > 0, "has a part with a negative radius; give a radius of at least 0"),
            (observed.uncertainty < 0, "has a negative uncertainty; give a radius of at least 0"),
            (shapes.bottom > shapes.top, "has a height whose bottom is above its top; give [bottom, top]"),
        )
    faults: dict[int, str] = {}
    for is_wrong, problem in checks:
        for row in np.flatnonzero(is_wrong & is_readable).tolist() if is_wrong.any() else ():
            name = observed.names[observed.name[row]]
            faults.setdefault(int(observed.sample[row]), f"object {name!r} {problem}")
    return faults


def _normalise_shapes(
    observed: Observations, is_readable: Booleans, concave: Concave
) -> tuple[FootprintBatch, dict[int, str]]:
    """Return normalised polygons, and faults by sample index. Concave polygons are decomposed."""
    shapes = observed.shapes
    part_counts = np.diff(shapes.part_start)
    vertex_start, vertices, fault_codes = normalise_polygons(shapes.vertex_start, shapes.vertices)
    shapes = replace(shapes, vertex_start=vertex_start, vertices=vertices)
    if not fault_codes.any():
        return shapes, {}
    observation_of_part = np.repeat(np.arange(len(is_readable)), part_counts)
    # few polygons are concave, so the slow decomposition treats them one by one. Unreadable parts stay
    # unknown, and parts without vertices have a fault already
    faulty_parts = np.flatnonzero(
        (fault_codes != SOUND) & is_readable[observation_of_part] & (np.diff(vertex_start) > 0)
    )
    footprint_by_part: dict[int, Footprint] = {}
    faults: dict[int, str] = {}
    for part in faulty_parts.tolist():
        polygon = vertices[vertex_start[part] : vertex_start[part + 1]]
        try:
            footprint_by_part[part] = Footprint.polygon(polygon, concave=concave)
        except GeometryError as error:
            name = observed.names[observed.name[observation_of_part[part]]]
            faults.setdefault(int(observed.sample[observation_of_part[part]]), f"object {name!r}: {error}")
    return _with_pieces(shapes, footprint_by_part) if footprint_by_part else shapes, faults


def _with_pieces(shapes: FootprintBatch, footprint_by_part: Mapping[int, Footprint]) -> FootprintBatch:
    """Replace parts of the shapes, given by index, by the parts of a footprint."""
    part_counts = np.ones(len(shapes.radius), np.int64)
    part_counts[list(footprint_by_part)] = [len(footprint.parts) for footprint in footprint_by_part.values()]
    new_polygons = [part.vertices for footprint in footprint_by_part.values() for part in footprint.parts]
    vertex_counts = np.concatenate(
        [np.diff(shapes.vertex_start), [len(vertices) for vertices in new_polygons]]
    )
    vertices = np.concatenate([shapes.vertices, *new_polygons])
    vertex_begins = starts_from_counts(vertex_counts)[:-1]
    first_parts = np.arange(len(shapes.radius), dtype=np.int64)
    # new polygons are appended, and `part_order` moves them to the places of the replaced parts
    first_parts[list(footprint_by_part)] = (
        len(shapes.radius) + starts_from_counts(part_counts[list(footprint_by_part)])[:-1]
    )
    part_order = flat_index(first_parts, part_counts)
    return replace(
        shapes,
        part_start=starts_from_counts(part_counts)[shapes.part_start],
        vertex_start=starts_from_counts(vertex_counts[part_order]),
        vertices=vertices[flat_index(vertex_begins[part_order], vertex_counts[part_order])],
        radius=np.repeat(shapes.radius, part_counts),
    )
