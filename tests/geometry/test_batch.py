"""Footprints in flat arrays, and outlines read from a file."""

from __future__ import annotations

import math

import numpy as np
import pytest

from spatial_replay import Footprint, GeometryError
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.geometry.outline import EMPTY, NOT_CONVEX, NOT_FINITE, SOUND, normalise_polygons


def test_heights_stay_with_their_rows():
    batch = FootprintBatch.from_footprints(
        [Footprint.disc(x, 0, 1) for x in range(3)], [(0, 1), None, (2, 5)]
    )
    chosen = batch.select(np.array([2, 1, 2]))
    assert [chosen.height(row) for row in range(3)] == [(2, 5), None, (2, 5)]
    assert chosen.footprint(0) == Footprint.disc(2, 0, 1)


def test_arrays_are_read_only_views():
    vertices = np.zeros((1, 2))
    batch = FootprintBatch([0, 1], [0, 1], vertices, [0.0], [math.nan], [math.nan])
    with pytest.raises(ValueError, match="read-only"):
        batch.vertices[0, 0] = 1
    vertices[0, 0] = 3


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("radius", [1.0, 2.0], "radius"),
        ("vertices", [(0.0, 0.0, 0.0)], "vertices"),
        ("part_start", [0, 2], "part_start must rise from 0 to 1"),
        ("vertex_start", [1, 1], "vertex_start"),
        ("top", [], "top"),
    ],
)
def test_arrays_of_inconsistent_shape_are_refused(field, value, message):
    arrays = {
        "part_start": [0, 1],
        "vertex_start": [0, 1],
        "vertices": [(0.0, 0.0)],
        "radius": [1.0],
        "bottom": [math.nan],
        "top": [math.nan],
    }
    with pytest.raises(GeometryError, match=message):
        FootprintBatch(**{**arrays, field: value})


def test_raw_outlines_are_normalised_or_reported():
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    dart = [(0, 0), (2, 1), (0, 2), (1, 1)]
    broken = [(0, 0), (1, math.nan), (1, 1)]
    flat = [(0, 0), (1, 1), (2, 2), (1, 1)]
    outlines = [square[::-1], [], dart, broken, flat, square]
    start = np.concatenate([[0], np.cumsum([len(corners) for corners in outlines])]).astype(np.int64)
    vertices = np.array([vertex for corners in outlines for vertex in corners], dtype=float)
    result = normalise_polygons(start, vertices)
    assert result.fault.tolist() == [SOUND, EMPTY, NOT_CONVEX, NOT_FINITE, SOUND, SOUND]
    pieces = np.split(result.vertices, result.vertex_start[1:-1])
    np.testing.assert_array_equal(pieces[0], [(0, 1), (0, 0), (1, 0), (1, 1)])
    np.testing.assert_array_equal(pieces[2], dart)
    np.testing.assert_array_equal(pieces[3], broken)
    np.testing.assert_array_equal(pieces[4], [(0, 0), (2, 2)])
    np.testing.assert_array_equal(pieces[5], square)
