"""Measurements whose numbers can be read off a drawing."""

from __future__ import annotations

import math
import os

import numpy as np
import pytest

from spatial_replay import Footprint, GeometryError
from spatial_replay.compiled import inlined, kernel, only
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure

UNIT = Footprint.box(0, 0, 1, 1)
POINT = Footprint.polygon([(0, 0)])
SEGMENT = Footprint.polygon([(0, 0), (4, 0)])


def rows(*numbers):
    return Operand(np.array([numbers], dtype=np.int64).reshape(1, -1))


def between(quantity, first, second):
    batch = FootprintBatch.from_footprints([first, second])
    return float(measure(batch, [rows(0), rows(1)], [MeasureRequest(quantity, 0, 1)])[0, 0])


@pytest.mark.parametrize(
    ("other", "distance"),
    [
        (Footprint.box(3, 0, 4, 1), 2),
        (Footprint.box(4, 5, 6, 6), 5),
        (Footprint.box(1, 0, 2, 1), 0),
        (Footprint.box(0.75, 0, 2, 1), -0.25),
        (Footprint.box(-1, -1, 3, 3), -2),
        (Footprint.disc(3, 0.5, 0.5), 1.5),
        (Footprint.disc(0.5, 0.5, 0.125), -0.625),
        (Footprint.polygon([(0.5, -1), (0.5, 2)]), -0.5),
        (Footprint.polygon([(1.5, 0.5), (3, 0.5)]), 0.5),
        (Footprint.polygon([(0, 0)]), 0),
    ],
)
def test_signed_distance_to_the_unit_square(other, distance):
    assert between("signed_distance", UNIT, other) == distance


@pytest.mark.parametrize(
    ("first", "second", "distance"),
    [
        (POINT, POINT, 0),
        (POINT, Footprint.polygon([(3, 4)]), 5),
        (SEGMENT, Footprint.polygon([(6, 0), (9, 0)]), 2),
        (SEGMENT, Footprint.polygon([(3, 0), (9, 0)]), 0),
        (SEGMENT, Footprint.polygon([(1, 2), (9, 2)]), 2),
        (SEGMENT, Footprint.polygon([(2, -1), (2, 3)]), -1),
        (SEGMENT, Footprint.polygon([(7, 4)]), 5),
        (SEGMENT, Footprint.polygon([(2, 0)]), 0),
        (Footprint.capsule((0, 0), (4, 0), 1), Footprint.capsule((6, 0), (9, 0), 0.5), 0.5),
    ],
)
def test_signed_distance_of_points_and_segments(first, second, distance):
    assert between("signed_distance", first, second) == distance


@pytest.mark.parametrize(
    ("direction", "gap"), [((1.0, 3.0), 0.7), ((0.1, 0.3), 5.0), ((7.0, -0.013), 1e3), ((-1.0, 1 / 3), 1e-3)]
)
def test_segments_on_one_skew_line_keep_their_gap(direction, gap):
    unit = np.array(direction) / math.hypot(*direction)
    start = np.array((123.4, -77.7))
    first = Footprint.polygon([start, start + unit])
    second = Footprint.polygon([start + (1 + gap) * unit, start + (2 + gap) * unit])
    assert between("signed_distance", first, second) == pytest.approx(gap, abs=1e-9)


@pytest.mark.parametrize("degrees", range(1, 90, 4))
def test_boxes_that_face_each_other_askew_keep_the_gap_between_their_sides(degrees):
    angle = math.radians(degrees)
    turn = np.array([(math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))])
    lower = np.array([(0, 0), (10, 0), (10, 1), (0, 1)]) @ turn
    upper = np.array([(4, 1.25), (14, 1.25), (14, 2), (4, 2)]) @ turn
    distance = between("signed_distance", Footprint.polygon(lower), Footprint.polygon(upper))
    assert distance == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("inner", "outer", "protrusion"),
    [
        (Footprint.box(1, 1, 2, 2), Footprint.box(0, 0, 4, 4), -1),
        (Footprint.box(1, 1, 2, 5), Footprint.box(0, 0, 4, 4), 1),
        (UNIT, UNIT, 0),
        (Footprint.disc(2, 2, 1), Footprint.box(0, 0, 4, 4), -1),
        (Footprint.disc(0, 0, 1), Footprint.disc(0, 0, 3), -2),
        (Footprint.box(0, 0, 3, 4), POINT, 5),
        (Footprint.polygon([(1, 0), (5, 0)]), SEGMENT, 1),
    ],
)
def test_protrusion(inner, outer, protrusion):
    assert between("protrusion", inner, outer) == protrusion


def test_centroids_are_those_of_areas_and_of_each_part():
    shapes = Footprint.union(
        [Footprint.polygon([(0, 0), (3, 0), (0, 3)]), Footprint.capsule((5, 6), (7, 8), 2)]
    )
    names = ("centroid_min_x", "centroid_max_x", "centroid_min_y", "centroid_max_y")
    batch = FootprintBatch.from_footprints([shapes])
    values = measure(batch, [rows(0)], [MeasureRequest(name, 0) for name in names])
    assert values[:, 0].tolist() == [1, 6, 1, 7]


def test_prisms_count_when_both_have_heights():
    batch = FootprintBatch.from_footprints(
        [UNIT, Footprint.box(4, 0, 5, 1), Footprint.box(0, 0, 2, 2)], [(0, 1), (5, 6), None]
    )
    requests = [
        MeasureRequest("signed_distance", 0, 1),
        MeasureRequest("signed_distance", 0, 2),
        MeasureRequest("max_z", 1),
    ]
    assert measure(batch, [rows(0), rows(1), rows(2)], requests)[:, 0].tolist() == [5, -1, 6]
    assert np.isnan(
        measure(batch, [rows(0, 2)], [MeasureRequest("min_z", 0), MeasureRequest("max_z", 0)])
    ).all()
    assert measure(batch, [rows(0, 1)], [MeasureRequest("min_z", 0), MeasureRequest("max_z", 0)])[
        :, 0
    ].tolist() == [0, 6]


def test_empty_places_are_left_out_and_an_empty_union_is_infinitely_far():
    batch = FootprintBatch.from_footprints([UNIT, Footprint.box(3, 0, 4, 1), Footprint.box(9, 0, 10, 1)])
    empty, some = rows(-1, -7), rows(-1, 2, 1)
    requests = [
        MeasureRequest("signed_distance", 0, 2),
        MeasureRequest("signed_distance", 0, 1),
        MeasureRequest("protrusion", 1, 0),
    ]
    requests += [
        MeasureRequest("min_x", 1),
        MeasureRequest("max_x", 1),
        MeasureRequest("max_x", 2),
        MeasureRequest("protrusion", 0, 1),
    ]
    values = measure(batch, [rows(0), empty, some], requests)[:, 0]
    assert values.tolist() == [2, math.inf, -math.inf, math.inf, -math.inf, 10, math.inf]
    assert measure(batch, [rows(0), rows()], [MeasureRequest("signed_distance", 0, 1)])[0, 0] == math.inf


def test_each_sample_has_its_own_rows():
    batch = FootprintBatch.from_footprints([UNIT, *(Footprint.box(x, 0, x + 1, 1) for x in (2, 3, 4))])
    operands = [Operand(np.zeros((3, 1), dtype=np.int64)), Operand(np.array([[1], [2], [3]]), 0.5)]
    assert measure(batch, operands, [MeasureRequest("signed_distance", 0, 1)]).tolist() == [[0.5, 1.5, 2.5]]


def test_what_stays_has_the_same_number_in_every_sample():
    batch = FootprintBatch.from_footprints([Footprint.box(x, 0, x + 1, 1) for x in (0, 2, 5, 9)])
    stays, also, goes = (np.array([places]).T for places in ([1] * 3, [3] * 3, [0, 2, 0]))
    operands = [Operand(goes), Operand(stays, 0.5), Operand(also), Operand(np.hstack((stays, also)))]
    requests = [
        MeasureRequest("signed_distance", 1, 2),
        MeasureRequest("protrusion", 0, 3),
        MeasureRequest("max_x", 1),
        MeasureRequest("protrusion", 3, 2),
        MeasureRequest("min_x", 0),
    ]
    assert measure(batch, operands, requests).tolist() == [
        [5.5, 5.5, 5.5],
        [2.0, 3.0, 2.0],
        [3.5, 3.5, 3.5],
        [7.0, 7.0, 7.0],
        [0.0, 5.0, 0.0],
    ]


def test_no_requests_give_no_measurements():
    batch = FootprintBatch.from_footprints([])
    assert measure(batch, [], []).shape == (0, 0)
    assert measure(batch, [Operand(np.full((4, 1), -1))], [MeasureRequest("min_x", 0)]).tolist() == [
        [math.inf] * 4
    ]


def test_a_row_that_the_batch_does_not_have_is_refused():
    with pytest.raises(GeometryError, match="row 1"):
        measure(FootprintBatch.from_footprints([UNIT]), [rows(1)], [MeasureRequest("min_x", 0)])


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system does not pin processes to cores")
def test_the_number_of_cores_changes_no_bit() -> None:
    boxes = [Footprint.box(x, 0.1 * x, x + 0.3 + 0.01 * x, 1.0) for x in np.linspace(-2.0, 2.0, 200).tolist()]
    batch = FootprintBatch.from_footprints(boxes)
    rows = np.random.default_rng(4).integers(0, len(boxes), (40_000, 2))
    operands = Operand(rows[:, :1]), Operand(rows[:, 1:], 0.05)
    requests = [MeasureRequest("signed_distance", 0, 1), MeasureRequest("max_x", 1)]
    cores = os.sched_getaffinity(0)
    with only("compiled"):
        measure(batch, operands, requests)
        everywhere = measure(batch, operands, requests)
        os.sched_setaffinity(0, {min(cores)})
        try:
            alone = measure(batch, operands, requests)
        finally:
            os.sched_setaffinity(0, cores)
    assert everywhere.tobytes() == alone.tobytes()


def _half_of(numbers, place):
    return numbers[place] / 2


_half = inlined(_half_of, of_another_version=True)


@kernel
def _fill_halves(numbers, halves):
    for place in range(len(numbers)):
        halves[place] = _half(numbers, place)


def test_options_that_the_compiler_does_not_have_are_left_out():
    halves = np.zeros(3)
    with only("compiled"):
        _fill_halves(np.array([1.0, 2.0, 4.0]), halves)
    assert halves.tolist() == [0.5, 1.0, 2.0]
