"""Laws of every pair of footprints, against definitions and another library."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import example, given
from hypothesis import strategies as st

from examples import examples
from laws.strategies_geometry import (
    angles,
    convex_parts,
    convex_vertices,
    footprints,
    points,
    polygonal_parts,
    radii,
    star_polygons,
)
from spatial_replay import ConvexPart, Footprint
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.measure import MeasureRequest, Operand, measure
from spatial_replay.geometry.outline import SOUND, normalise_polygon, normalise_polygons

TOLERANCE = 1e-6
"""Loose enough for the other library; slivers within a billionth of a shape's extent are flattened."""

heights = st.tuples(st.integers(-20, 20), st.integers(0, 20)).map(lambda pair: (pair[0], pair[0] + pair[1]))


def between(quantity, first, second, *, grow=(0.0, 0.0), heights=None):
    batch = FootprintBatch.from_footprints([first, second], heights)
    operands = [Operand(np.array([[row]]), radius) for row, radius in enumerate(grow)]
    return float(measure(batch, operands, [MeasureRequest(quantity, 0, 1)])[0, 0])


def signed_distance(first, second, **options):
    return between("signed_distance", first, second, **options)


def protrusion(first, second, **options):
    return between("protrusion", first, second, **options)


def projections(footprint):
    names = ("min_x", "max_x", "min_y", "max_y")
    batch = FootprintBatch.from_footprints([footprint])
    return measure(batch, [Operand(np.array([[0]]))], [MeasureRequest(name, 0) for name in names])[:, 0]


def outline_of(vertices):
    return shapely.MultiPoint(vertices).convex_hull


def sharp(part):
    return Footprint((ConvexPart(part.vertices),))


def moved(footprint, angle, x, y):
    turn = np.array([(math.cos(angle), math.sin(angle)), (-math.sin(angle), math.cos(angle))])
    return Footprint(
        tuple(ConvexPart(part.vertices @ turn + (x, y), part.radius) for part in footprint.parts)
    )


def signed_distance_by_differences(first, second):
    """By definition: depth or distance of the origin in the set of differences."""
    differences = (first.vertices[:, None] - second.vertices[None]).reshape(-1, 2)
    hull, origin = outline_of(differences), shapely.Point(0, 0)
    if hull.geom_type == "Polygon" and hull.contains(origin):
        return -hull.exterior.distance(origin)
    return hull.distance(origin)


@given(convex_parts(), convex_parts())
def test_signed_distance_is_that_of_the_set_of_differences_less_the_radii(first, second):
    expected = signed_distance_by_differences(first, second) - first.radius - second.radius
    assert signed_distance(Footprint((first,)), Footprint((second,))) == pytest.approx(
        expected, abs=TOLERANCE
    )


@given(convex_parts(radii=st.just(0.0)), convex_parts(radii=st.just(0.0)))
def test_signed_distance_of_sharp_parts_apart_is_their_distance(first, second):
    expected = outline_of(first.vertices).distance(outline_of(second.vertices))
    assert max(0.0, signed_distance(sharp(first), sharp(second))) == pytest.approx(expected, abs=TOLERANCE)


@st.composite
def round_parts(draw):
    """Ellipses of so many corners that those of two make thousands of pairs; evenly spaced or not."""
    count, flat = draw(st.integers(66, 90)), draw(st.sampled_from([1.0, 0.4, 0.02]))
    steps = np.random.default_rng(draw(st.integers(0, 99))).uniform(0.5, 1.5, count)
    turns = np.cumsum(steps if draw(st.booleans()) else np.ones(count))
    around = 2.0 * math.pi * turns / turns[-1]
    outline = draw(st.integers(1, 8)) / 4 * np.column_stack((np.cos(around), flat * np.sin(around)))
    (part,) = moved(Footprint.polygon(outline), draw(angles), *draw(st.tuples(near, near))).parts
    return part


near = st.integers(-48, 48).map(lambda value: value / 16)


@examples(10)
@given(round_parts(), round_parts())
def test_outlines_of_many_corners_are_measured_like_others(first, second):
    measured, expected = (
        signed_distance(sharp(first), sharp(second)),
        signed_distance_by_differences(first, second),
    )
    assert measured == pytest.approx(expected, abs=TOLERANCE)
    assert measured == signed_distance(sharp(second), sharp(first))
    # the corners one by one, each with few pairs
    corners = [signed_distance(Footprint.polygon([corner]), sharp(second)) for corner in first.vertices]
    assert protrusion(sharp(first), sharp(second)) == pytest.approx(max(corners), abs=TOLERANCE)


@examples(10)
@given(
    round_parts(),
    st.sampled_from([1.0, 1.0 - 1e-6, 0.999, 0.5]),
    st.sampled_from([0.0, 1e-6, 0.01, 1.0]),
    st.sampled_from([0.0, 1e-9, 1e-3, 0.25]),
)
def test_outlines_that_are_nearly_alike_are_measured_like_others(part, size, turn, aside):
    # nearly all edges separate them equally, and nearly all corners are equally far
    x, y = part.vertices.mean(axis=0).tolist()
    smaller = Footprint.polygon((part.vertices - (x, y)) * size)
    (other,) = moved(smaller, turn, x + aside, y + 0.5 * aside).parts
    assert signed_distance(sharp(part), sharp(other)) == pytest.approx(
        signed_distance_by_differences(part, other), abs=TOLERANCE
    )
    for first, second in ((part, other), (other, part)):
        corners = [signed_distance(Footprint.polygon([corner]), sharp(second)) for corner in first.vertices]
        assert protrusion(sharp(first), sharp(second)) == pytest.approx(max(corners), abs=1e-13)


@given(footprints, footprints, radii)
def test_signed_distance_is_symmetric_to_the_bit(first, second, radius):
    there = signed_distance(first, second, grow=(radius, 0.0))
    assert there == signed_distance(second, first, grow=(0.0, radius))


@given(footprints, footprints, angles, points)
def test_measurements_are_invariant_under_a_common_motion(first, second, angle, shift):
    moved_first, moved_second = moved(first, angle, *shift), moved(second, angle, *shift)
    for of in (signed_distance, protrusion):
        assert of(moved_first, moved_second) == pytest.approx(of(first, second), abs=TOLERANCE)


@given(footprints, footprints)
def test_signed_distance_is_lipschitz_in_a_translation(first, second):
    nearer = moved(first, 0.0, 0.25, 0.0)
    assert abs(signed_distance(nearer, second) - signed_distance(first, second)) <= 0.25 + TOLERANCE


@given(footprints, footprints, radii, radii)
def test_radii_come_off_the_signed_distance_and_shift_the_protrusion(first, second, one, other):
    grow = (one, other)
    assert signed_distance(first, second, grow=grow) == pytest.approx(
        signed_distance(first, second) - one - other
    )
    assert protrusion(first, second, grow=grow) == pytest.approx(protrusion(first, second) + one - other)


@given(footprints, radii)
def test_enlarging_pushes_every_side_outwards(footprint, radius):
    batch = FootprintBatch.from_footprints([footprint])
    requests = [MeasureRequest(name, 0) for name in ("min_x", "max_x", "min_y", "max_y")]
    grown = measure(batch, [Operand(np.array([[0]]), radius)], requests)[:, 0]
    assert grown == pytest.approx(projections(footprint) + np.array([-1, 1, -1, 1]) * radius)


@given(footprints)
def test_projections_are_the_bounds_of_the_rounded_shape(footprint):
    low = np.min([part.vertices.min(axis=0) - part.radius for part in footprint.parts], axis=0)
    high = np.max([part.vertices.max(axis=0) + part.radius for part in footprint.parts], axis=0)
    assert projections(footprint) == pytest.approx([low[0], high[0], low[1], high[1]])


@given(footprints, footprints)
def test_a_union_is_as_far_as_its_nearest_pair_of_parts(first, second):
    pairs = [(Footprint((p,)), Footprint((q,))) for p in first.parts for q in second.parts]
    assert signed_distance(first, second) == min(signed_distance(p, q) for p, q in pairs)


@given(footprints, footprints)
def test_a_union_sticks_out_as_its_worst_part_out_of_the_best_host(first, second):
    expected = max(
        min(protrusion(Footprint((p,)), Footprint((q,))) for q in second.parts) for p in first.parts
    )
    assert protrusion(first, second) == expected


@given(convex_parts(radii=st.just(0.0)), polygonal_parts())
def test_protrusion_says_whether_one_covers_the_other(inner, outer):
    sticks_out = protrusion(sharp(inner), sharp(outer))
    host, guest = outline_of(outer.vertices), outline_of(inner.vertices)
    if sticks_out <= -TOLERANCE:
        assert host.covers(guest)
    elif sticks_out >= TOLERANCE:
        assert not host.covers(guest)
        assert sticks_out == pytest.approx(max(host.distance(shapely.Point(p)) for p in inner.vertices))


@given(footprints)
def test_every_footprint_covers_itself(footprint):
    assert protrusion(footprint, footprint) <= TOLERANCE


@given(convex_parts(), convex_parts(), heights, heights)
def test_prisms_combine_planar_distance_and_gap(first, second, low, high):
    a, b = Footprint((first,)), Footprint((second,))
    planar, gap = signed_distance(a, b), max(low[0] - high[1], high[0] - low[1])
    expected = math.hypot(planar, gap) if planar > 0 and gap > 0 else max(planar, gap)
    assert signed_distance(a, b, heights=[low, high]) == pytest.approx(expected)
    assert signed_distance(a, b, heights=[low, None]) == planar
    sticks_out = max(protrusion(a, b), high[0] - low[0], low[1] - high[1])
    assert protrusion(a, b, heights=[low, high]) == pytest.approx(sticks_out)
    assert protrusion(a, b, heights=[None, high]) == protrusion(a, b)


@given(st.lists(footprints, min_size=2, max_size=5))
def test_results_do_not_depend_on_other_requests(shapes):
    batch = FootprintBatch.from_footprints(shapes)
    count = len(shapes)
    first = np.repeat(np.arange(count), count)[:, None]
    second = np.tile(np.arange(count), count)[:, None]
    requests = [
        MeasureRequest("protrusion", 0, 1),
        MeasureRequest("signed_distance", 0, 1),
        MeasureRequest("centroid_max_x", 0),
    ]
    together = measure(batch, [Operand(first), Operand(second)], requests)
    for t in range(count * count):
        alone = batch.select(np.array([first[t, 0], second[t, 0]]))
        operands = [Operand(np.array([[0]])), Operand(np.array([[1]]))]
        for k, request in enumerate(requests):
            assert measure(alone, operands, [request])[0, 0] == together[k, t]


@given(star_polygons())
def test_a_decomposition_covers_exactly_the_polygon(corners):
    polygon = shapely.Polygon(corners)
    parts = [shapely.Polygon(part.vertices) for part in Footprint.polygon(corners).parts]
    assert shapely.union_all(parts).symmetric_difference(polygon).area == pytest.approx(0, abs=TOLERANCE)
    assert sum(part.area for part in parts) == pytest.approx(polygon.area)


@given(star_polygons())
def test_a_hull_is_the_smallest_convex_cover(corners):
    (part,) = Footprint.polygon(corners, concave="hull").parts
    assert shapely.Polygon(part.vertices).area == pytest.approx(shapely.Polygon(corners).convex_hull.area)


@given(st.lists(st.one_of(convex_vertices(), star_polygons()), min_size=1, max_size=6))
def test_outlines_normalise_alike_alone_and_together_and_idempotently(outlines):
    start = np.concatenate([[0], np.cumsum([len(corners) for corners in outlines])])
    together = normalise_polygons(start, np.concatenate(outlines))
    for p, corners in enumerate(outlines):
        alone = normalise_polygons(np.array([0, len(corners)]), np.array(corners))
        assert alone.fault[0] == together.fault[p]
        mine = together.vertices[together.vertex_start[p] : together.vertex_start[p + 1]]
        assert mine.tobytes() == alone.vertices.tobytes()
        if alone.fault[0] == SOUND:
            assert ConvexPart(np.array(corners)).vertices.tobytes() == mine.tobytes()
    again = normalise_polygons(together.vertex_start, together.vertices)
    assert again.vertices.tobytes() == together.vertices.tobytes()


_NEARLY = st.sampled_from([0.0, -0.0, 1e-8, 1e-9, 2e-9, -1e-9, 1e-10, 1e-16, -1e-16, 1e-100])
_NEAR_CORNERS = st.tuples(st.integers(0, 2), _NEARLY, st.integers(0, 2), _NEARLY)


@given(st.lists(st.lists(_NEAR_CORNERS, min_size=4, max_size=4), min_size=1, max_size=4), st.booleans())
@example([[(0, 0.0, 0, 0.0), (2, 0.0, 0, 0.0), (2, 0.0, 1, 0.0), (0, 0.0, 1, 0.0)]], False)
@example([[(0, 0.0, 0, 0.0), (1, 0.0, 0, -1e-9), (2, 0.0, 0, 0.0), (0, 0.0, 1, 0.0)]], False)
@example([[(0, 0.0, 0, 0.0), (2, 0.0, 1, 0.0), (0, 0.0, 1, 0.0), (2, 0.0, 0, 0.0)]], True)
def test_outlines_that_are_tested_together_are_those_that_are_tidied_one_by_one(corners, has_point):
    outlines = [np.array([(x + small_x, y + small_y) for x, small_x, y, small_y in part]) for part in corners]
    outlines += [np.array([[0.5, 0.5]])] if has_point else []
    start = np.concatenate([[0], np.cumsum([len(outline) for outline in outlines])])
    together = normalise_polygons(start, np.concatenate(outlines))
    for number, outline in enumerate(outlines):
        vertices, fault = normalise_polygon(outline.copy())
        begin, end = together.vertex_start[number : number + 2]
        assert (together.vertices[begin:end].tobytes(), together.fault[number]) == (vertices.tobytes(), fault)


@given(convex_vertices(min_size=3))
def test_a_convex_polygon_keeps_its_area_and_turns_left(corners):
    vertices = ConvexPart(np.array(corners)).vertices
    if len(vertices) > 2:
        ring = shapely.LinearRing(vertices)
        assert ring.is_ccw
        assert shapely.Polygon(ring).area == pytest.approx(outline_of(corners).area, abs=TOLERANCE)


@given(st.lists(footprints, min_size=1, max_size=5), st.data())
def test_rows_of_a_batch_are_the_footprints_it_was_made_of(shapes, data):
    batch = FootprintBatch.from_footprints(shapes)
    assert [batch.footprint(row) for row in range(len(batch))] == shapes
    rows = data.draw(st.lists(st.integers(0, len(shapes) - 1), max_size=8))
    chosen = FootprintBatch.concatenate([batch.select(np.array(rows, dtype=np.int64)), batch])
    assert [chosen.footprint(row) for row in range(len(chosen))] == [shapes[row] for row in rows] + shapes
