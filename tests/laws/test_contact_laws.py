"""The points that show a distance are as far apart as measured, and lie where they should."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given

from laws.strategies_geometry import footprints, radii
from spatial_replay import Footprint
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.measure import (
    MeasureRequest,
    Operand,
    contact,
    contacts,
    enlarge,
    measure,
    protrusion_contact,
)

TOLERANCE = 1e-6


def measured(quantity, first, second):
    batch = FootprintBatch.from_footprints([first, second])
    operands = [Operand(np.array([[row]])) for row in range(2)]
    return float(measure(batch, operands, [MeasureRequest(quantity, 0, 1)])[0, 0])


def to(point, footprint):
    return measured("signed_distance", Footprint.disc(*point, 0.0), footprint)


@given(footprints, footprints)
def test_a_contact_is_the_signed_distance(a, b):
    found = contact(a, b)
    distance = measured("signed_distance", a, b)
    assert math.isclose(found.distance, distance, abs_tol=TOLERANCE)
    assert math.isclose(math.dist(found.first, found.second), abs(distance), abs_tol=TOLERANCE)
    if distance > TOLERANCE:
        assert abs(to(found.first, a)) < TOLERANCE
        assert abs(to(found.second, b)) < TOLERANCE


@given(footprints, footprints)
def test_the_contact_translation_separates_overlapping_footprints(a, b):
    found = contact(a, b)
    if found.distance < -TOLERANCE and len(a.parts) == len(b.parts) == 1:
        push = np.subtract(found.first, found.second)
        moved = Footprint.polygon(b.parts[0].vertices + push) if len(b.parts[0].vertices) > 2 else None
        if moved is not None:
            moved = enlarge(moved, b.parts[0].radius)
            assert abs(measured("signed_distance", a, moved)) < TOLERANCE


@given(footprints, footprints)
def test_the_protrusion_contact_has_the_measured_protrusion(inner, outer):
    found = protrusion_contact(inner, outer)
    protrusion = measured("protrusion", inner, outer)
    assert math.isclose(found.distance, protrusion, abs_tol=TOLERANCE)
    assert math.isclose(math.dist(found.first, found.second), abs(protrusion), abs_tol=TOLERANCE)


@given(footprints, footprints, radii)
def test_enlarging_reduces_the_distance(a, b, radius):
    before, after = contact(a, b).distance, contact(a, enlarge(b, radius)).distance
    assert math.isclose(after, before - radius, abs_tol=TOLERANCE)


def many(first, second, *, is_protrusion):
    """The row of `contacts` for one pair."""
    batch = FootprintBatch.from_footprints([first, second])
    return contacts(batch, *(Operand(np.array([[row]])) for row in range(2)), is_protrusion=is_protrusion)[0]


@given(footprints, footprints)
def test_contacts_of_many_samples_equal_the_measured_distances(a, b):
    for is_protrusion, quantity in ((False, "signed_distance"), (True, "protrusion")):
        *found, distance, top = many(a, b, is_protrusion=is_protrusion)
        assert math.isclose(distance, measured(quantity, a, b), abs_tol=TOLERANCE)
        assert math.isclose(math.dist(found[:2], found[2:]), abs(distance), abs_tol=TOLERANCE)
        assert math.isnan(top)


@given(footprints, footprints)
def test_contacts_lie_on_both_boundaries(a, b):
    *found, distance, _ = many(a, b, is_protrusion=False)
    if distance > TOLERANCE:
        assert abs(to(found[:2], a)) < TOLERANCE
        assert abs(to(found[2:], b)) < TOLERANCE


def test_contacts_of_groups_are_those_of_the_members_that_decide():
    shapes = [Footprint.box(0, 0, 1, 1), Footprint.box(5, 0, 6, 1), Footprint.box(8, 0, 10, 1)]
    batch = FootprintBatch.from_footprints(shapes, [None, (0.0, 2.0), None])
    group, single = Operand(np.array([[0, 1], [0, -1], [-1, -1]])), Operand(np.array([[2]] * 3), 0.5)
    near = contacts(batch, group, single, is_protrusion=False)
    assert near[:, 4].tolist()[:2] == [1.5, 6.5]
    assert near[0, [0, 2]].tolist() == [6.0, 7.5]
    assert near[0, 5] == 2.0
    assert np.isnan(near[2]).all()
    assert contacts(batch, group, single, is_protrusion=True)[:, 4].tolist()[:2] == [7.5, 7.5]
