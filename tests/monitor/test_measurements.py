"""Measurements as their classes describe them, compared with geometry."""

from itertools import product

import pytest

from spatial_replay import Footprint, Sample, Trace, TrackedObject
from spatial_replay.monitor.atoms.measurements import measurement_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.spec.formula import (
    CentroidProjection,
    Enlarged,
    Group,
    Projection,
    Protrusion,
    SignedDistance,
    TrackedName,
)

PLACES = {"a": (0.0, 0.0), "b": (0.5, 3.0), "c": (6.0, 0.5), "d": (9.0, 1.0)}
OBJECTS = {
    name: TrackedObject(Footprint.box(x, y, x + 1.0, y + 2.0), height=(y, y + 4.0))
    for name, (x, y) in PLACES.items()
}
SCENE = TraceScene(Trace.from_samples([Sample(0, OBJECTS)]), {})
FIRST, SECOND = Group("", ("a", "b")), Group("", ("c", "d"))
MEASUREMENTS = [
    SignedDistance(FIRST, SECOND),
    Protrusion(FIRST, SECOND),
    *(Projection(FIRST, axis, side) for axis in ("x", "y", "z") for side in ("min", "max")),
    *(CentroidProjection(FIRST, axis, side) for axis in ("x", "y") for side in ("min", "max")),
]


def number(measurement) -> float:
    return float(measurement_values(SCENE, [measurement])[0][0, 0])


@pytest.mark.parametrize("measurement", MEASUREMENTS, ids=lambda measurement: measurement.quantity)
def test_the_members_that_extrema_pick_decide_a_group(measurement):
    members = [[TrackedName(name) for name in group.members] for group in measurement.terms]
    numbers = {terms: number(measurement.with_terms(*terms)) for terms in product(*members)}
    for side in reversed(measurement.extrema):
        pick = min if side == "min" else max
        firsts = dict.fromkeys(terms[:-1] for terms in numbers)
        numbers = {
            first: pick(numbers[terms] for terms in numbers if terms[:-1] == first) for first in firsts
        }
    assert number(measurement) == numbers[()]


@pytest.mark.parametrize("measurement", MEASUREMENTS, ids=lambda measurement: measurement.quantity)
def test_a_radius_changes_a_number_by_its_effect(measurement):
    for place, effect in enumerate(measurement.radius_effects):
        terms = list(measurement.terms)
        terms[place] = Enlarged(terms[place], 0.25)
        enlarged = measurement.with_terms(*terms)
        assert number(enlarged) - number(measurement) == pytest.approx(0.25 * effect)
