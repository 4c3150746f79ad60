"""Valid footprints, and the errors for invalid ones."""

from __future__ import annotations

import json
import math
from itertools import pairwise

import numpy as np
import pytest

import spatial_replay as sr
from spatial_replay import ConvexPart, Footprint, GeometryError, LogError, TrackedObject

SQUARE = [(0, 0), (2, 0), (2, 2), (0, 2)]
L_SHAPE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
BOW_TIE = [(0, 0), (2, 2), (2, 0), (0, 2)]


def vertices_of(footprint):
    return [tuple(vertex) for part in footprint.parts for vertex in part.vertices.tolist()]


@pytest.mark.parametrize(
    "corners",
    [
        SQUARE,
        SQUARE[::-1],
        [*SQUARE, SQUARE[0]],
        [(0, 0), (1, 0), (2, 0), (2, 0), (2, 2), (0, 2), (0, 1)],
        [(2, 2), (0, 2), (0, 0), (2, 0)],
        [(0, 0), (1, 1e-12), (2, 0), (2, 2), (0, 2)],
    ],
    ids=["plain", "clockwise", "closed", "superfluous", "other start", "dent of a rounding error"],
)
def test_spellings_of_one_square_are_equal(corners):
    square = Footprint.polygon(corners)
    assert square == Footprint.box(0, 0, 2, 2)
    assert hash(square) == hash(Footprint.box(0, 0, 2, 2))


def test_normal_vertices_are_returned_bit_for_bit():
    corners = np.array([(0.1, 0.2), (1.7, 0.3), (0.9, 1.1)])
    assert Footprint.polygon(corners).parts[0].vertices.tobytes() == corners.tobytes()


@pytest.mark.parametrize(
    ("footprint", "vertices"),
    [
        (Footprint.box(1, 1, 1, 3), [(1, 1), (1, 3)]),
        (Footprint.box(1, 1, 1, 1), [(1, 1)]),
        (Footprint.polygon([(0, 0), (2, 0), (1, 0), (3, 0)]), [(0, 0), (3, 0)]),
        (Footprint.polygon([(5, 5), (5, 5), (5, 5)]), [(5, 5)]),
        (Footprint.polygon([(7, 1)]), [(7, 1)]),
        (Footprint.capsule((0, 0), (4, 0), 1), [(0, 0), (4, 0)]),
        (Footprint.disc(3, 4, 2), [(3, 4)]),
    ],
)
def test_shapes_without_an_inside_are_segments_and_points(footprint, vertices):
    assert vertices_of(footprint) == vertices


def test_a_polygon_that_is_not_convex_becomes_few_convex_parts_or_its_hull():
    parts = Footprint.polygon(L_SHAPE).parts
    assert 2 <= len(parts) <= 3
    assert vertices_of(Footprint.polygon(L_SHAPE, concave="hull")) == [
        *[(0, 2), (0, 0), (2, 0), (2, 1), (1, 2)]
    ]


def test_a_polygon_of_very_many_corners_is_split_only_up_to_a_number():
    turns = np.linspace(0, 2 * np.pi, 20_000, endpoint=False)
    radius = 10 + np.arange(20_000) % 2
    cog = np.stack([radius * np.cos(turns), radius * np.sin(turns)], axis=1)
    with pytest.raises(
        GeometryError, match=r"has 20,000 corners, more than the 2,000 that can be split.*concave='hull'"
    ):
        Footprint.polygon(cog)
    assert len(Footprint.polygon(cog, concave="hull").parts[0].vertices) == 10_000
    along = np.linspace(0, 1, 5_000, endpoint=False)
    sides = [np.add(a, np.outer(along, np.subtract(b, a))) for a, b in pairwise([*SQUARE, SQUARE[0]])]
    assert Footprint.polygon(np.concatenate(sides)) == Footprint.polygon(SQUARE)


def test_a_convex_polygon_of_very_many_corners_is_refused(tmp_path):
    turns = np.linspace(0, 2 * np.pi, 10_001, endpoint=False)
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    assert len(Footprint.polygon(circle[:-1]).parts[0].vertices) == 10_000
    with pytest.raises(GeometryError, match="has 10,001 corners; simplify it to at most 10,000"):
        Footprint.polygon(circle)
    log = tmp_path / "run.jsonl"
    objects = [{"name": "wheel", "polygon": circle.tolist()}]
    log.write_text(json.dumps({"time_ns": 0, "objects": objects}))
    with pytest.raises(LogError, match=r"'wheel'.*10,001 corners"):
        sr.read_trace(log)


def test_a_boundary_that_crosses_itself_is_refused_by_place_and_remedy():
    with pytest.raises(GeometryError, match=r"crosses or touches itself at \(1, 1\).*concave='hull'"):
        Footprint.polygon(BOW_TIE)
    assert Footprint.polygon(BOW_TIE, concave="hull") == Footprint.box(0, 0, 2, 2)


def test_a_star_polygon_is_not_convex():
    star = [(math.cos(4 * math.pi * i / 5), math.sin(4 * math.pi * i / 5)) for i in range(5)]
    with pytest.raises(GeometryError, match="crosses"):
        Footprint.polygon(star)
    with pytest.raises(GeometryError, match="convex"):
        ConvexPart(np.array(star))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Footprint.polygon([]), "one or more pairs"),
        (lambda: Footprint.polygon([(0, 0, 0)]), r"\(1, 3\)"),
        (lambda: Footprint.polygon([(0, "east")]), "pairs of numbers"),
        (lambda: Footprint.polygon([(0, 10**400)]), "pairs of numbers"),
        (lambda: Footprint.polygon([(0, 0), (math.nan, 1), (1, 1)]), "nan.*finite"),
        (lambda: Footprint.polygon([(0, 0), (math.inf, 1), (1, 1)]), "inf.*finite"),
        (lambda: Footprint.polygon([(0, 0), (1e200, 1), (1, 1)]), "1e100"),
        (lambda: Footprint.polygon(SQUARE, concave="cut"), "'cut'.*'decompose' or 'hull'"),
        (lambda: Footprint.box(1, 0, 0, 1), r"box\(1, 0, 0, 1\)"),
        (lambda: Footprint.disc(0, 0, -1), "radius is -1.*0 or more"),
        (lambda: Footprint.disc(0, 0, math.nan), "radius is nan"),
        (lambda: Footprint.disc(0, 0, "wide"), "'wide'.*number"),
        (lambda: Footprint.union([]), "without parts"),
        (lambda: ConvexPart(np.array(L_SHAPE)), "Footprint.polygon"),
    ],
)
def test_invalid_footprints_are_refused_with_their_value(make, message):
    with pytest.raises(GeometryError, match=message):
        make()


def test_a_shape_of_another_name_is_answered_with_its_constructor():
    with pytest.raises(AttributeError, match=r"'circle'; write Footprint\.disc\(x, y, radius\)"):
        Footprint.circle(0, 0, 1)
    assert not hasattr(Footprint, "sphere")


def test_vertices_are_read_only_copies():
    source = np.array(SQUARE, dtype=float)
    part = ConvexPart(source)
    source[0, 0] = 99
    assert part.vertices[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        part.vertices[0, 0] = 1


def test_footprints_compare_by_what_they_cover():
    union = Footprint.union([Footprint.disc(0, 0, 1), Footprint.box(0, 0, 1, 1)])
    assert union == Footprint.union([Footprint.box(0, 0, 1, 1), Footprint.disc(0, 0, 1)])
    assert Footprint.disc(0, 0, 1) != Footprint.disc(0, 0, 2)
    assert Footprint.box(0, 0, 1, 1) != Footprint.box(0, 0, 1, 2)
    assert Footprint.box(0, 0, 1, 1) != "box"
    assert (
        repr(union) == "Footprint(ConvexPart((0, 0), radius=1), ConvexPart((0, 0), (1, 0), (1, 1), (0, 1)))"
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"yaw": math.inf}, "yaw is inf"),
        ({"height": (2, 1)}, r"\(2.0, 1.0\).*bottom above"),
        ({"height": (0, math.nan)}, "top is nan"),
        ({"height": 3}, r"give \(bottom, top\)"),
        ({"uncertainty": -0.5}, "uncertainty is -0.5"),
        ({"uncertainty": math.nan}, "uncertainty is nan"),
        ({"class_name": 7}, "class_name is 7"),
    ],
)
def test_a_tracked_object_checks_its_attributes(options, message):
    with pytest.raises(GeometryError, match=message):
        TrackedObject(Footprint.disc(0, 0, 1), **options)


def test_a_tracked_object_needs_a_footprint():
    with pytest.raises(GeometryError, match="give a Footprint"):
        TrackedObject(SQUARE)
