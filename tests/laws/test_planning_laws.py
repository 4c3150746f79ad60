"""What must hold for every gradient map."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import spatial_replay as sr
from spatial_replay.planning.maps import proposition_maps
from spatial_replay.planning.poses import centre_of, moved_object
from spatial_replay.planning.workspace import Grid, Workspace

TEXTS = (
    "a leftof b",
    "a dist b >= 1.5",
    "a enclosedin b and not (a ovlp c)",
    "a closer b than c",
    "a oriented[0.5] b",
    "b touch[1] c",
    "a enclosedin here or a between[x] (b, c)",
    "a prec[z] b",
    "forall x in all: x dist b <= 4",
    "a moved[2] c",
    "load >= 1 -> a above b",
)
REGION = "region here = circle((3, 3), 2)\n"


@st.composite
def bodies(draw):
    x, y = draw(st.floats(-5, 5)), draw(st.floats(-5, 5))
    width, length = draw(st.floats(0.1, 3)), draw(st.floats(0.1, 3))
    shape = draw(
        st.sampled_from(
            [
                sr.Footprint.box(0, 0, width, length),
                sr.Footprint.disc(0, 0, width),
                sr.Footprint.capsule((0, 0), (width, length), 0.5),
                sr.Footprint.polygon([(0, 0), (3, 0), (3, 1), (1, 1), (1, length + 1), (0, length + 1)]),
            ]
        )
    )
    height = draw(st.sampled_from([None, (0.0, 1.0), (0.5, 2.0)]))
    yaw = draw(st.one_of(st.none(), st.floats(-3, 3)))
    uncertainty = draw(st.sampled_from([0.0, 0.0, 0.2]))
    body = sr.TrackedObject(shape, yaw=yaw, height=height, uncertainty=uncertainty)
    return moved_object(body, x, y, draw(st.floats(-3, 3)))


@st.composite
def scenes(draw):
    names = draw(st.sampled_from([("a", "b", "c"), ("a", "b", "c", "d"), ("a", "c")]))
    signals = draw(st.sampled_from([{}, {"load": 2.0}]))
    return sr.Sample(5, {name: draw(bodies()) for name in names}, signals)


@given(scenes(), st.sampled_from(TEXTS), st.sampled_from([(), (0.5,), (-1.0, 2.0)]), st.data())
@settings(max_examples=60)
def test_a_cell_is_the_robustness_of_the_sample_with_the_object_moved_there(sample, text, yaws, data):
    specification = sr.parse_specification(f"{REGION}spec s = {text}")
    workspace = Workspace(Grid(-4.0, -4.0, 1.7, 5, 4), yaws)
    maps = proposition_maps([specification.specs[0].formula], specification.regions, sample, "a", workspace)
    turn, row, column = (data.draw(st.integers(0, size - 1)) for size in maps.lower.shape[1:])
    x, y = workspace.grid.centre(row, column)
    there = moved_object(sample.objects["a"], x, y, float(maps.turns[turn]))
    monitor = sr.Monitor(specification)
    node = monitor.update(sr.Sample(5, {**sample.objects, "a": there}, sample.signals)).node("s")
    low, high = maps.lower[0, turn, row, column], maps.upper[0, turn, row, column]
    if math.isnan(node.now):
        assert low != high
    else:
        assert low == high
        assert np.isclose(low, node.now, rtol=1e-12, atol=1e-12)


@given(bodies(), st.floats(-9, 9), st.floats(-9, 9), st.floats(-7, 7))
def test_a_moved_object_is_where_it_was_moved_to(body, x, y, turn):
    moved = moved_object(body, x, y, turn)
    assert np.allclose(centre_of(moved.footprint), (x, y), atol=1e-9)
    if body.yaw is not None:
        assert moved.yaw == body.yaw + turn
