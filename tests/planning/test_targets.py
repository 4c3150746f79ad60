"""Targets: refined within cells, and room weighed against robustness."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry import Polygon, box

import spatial_replay as sr
from examples import examples
from planning.kinematics import block
from spatial_replay import Planner, Settings
from spatial_replay.planning import Grid, Workspace, moved_object

TABLE = Settings(Workspace(Grid.over(0, 0, 10, 10, 0.5), clearance=0.05), movable=("a",), margin=0.02)


def first_target(text, objects, chosen=TABLE):
    planner = Planner(sr.parse_specification(text), chosen)
    planner.observe(sr.Sample(0, objects))
    return planner.next_step().target


def enclosed_by(one, other):
    """How far a polygon stays inside another one, by shapely."""
    corners = [
        other.exterior.distance(point) * (1 if other.covers(point) else -1) for point in corners_of(one)
    ]
    return min(corners)


def corners_of(polygon):
    return [box(x, y, x, y).centroid for x, y in polygon.exterior.coords]


def polygon_of(tracked):
    (part,) = tracked.footprint.parts
    return Polygon(part.vertices)


@examples(10)
@given(st.floats(3.0, 7.0), st.floats(3.0, 7.0), st.floats(1.2, 2.5), st.floats(0.0, 1.5))
def test_a_refined_target_is_at_least_as_robust_and_free(x, y, side, yaw):
    goal = affinity.rotate(box(x - side, y - side, x + side, y + side), yaw, use_radians=True)
    text = f"region goal = polygon({', '.join(f'({u!r}, {v!r})' for u, v in goal.exterior.coords[:-1])})\n"
    text += "spec s = F (a enclosedin goal)"
    things = {"a": block(1, 1, size=1), "post": block(x + 0.7, y, size=0.6)}
    fine, coarse = (first_target(text, things, replace(TABLE, refine=each)) for each in (True, False))
    if coarse is None:
        return
    assert fine.robustness >= coarse.robustness
    placed = polygon_of(moved_object(things["a"], fine.x, fine.y))
    assert math.isclose(enclosed_by(placed, goal), fine.robustness, abs_tol=1e-6)
    assert placed.distance(polygon_of(things["post"])) > 0.05


def test_refined_targets_are_better_than_cells_and_turns():
    diamond = "region goal = polygon((5.2, 4.0), (6.4, 5.2), (5.2, 6.4), (4.0, 5.2))\n"
    diamond += "spec s = F (a enclosedin goal)"
    turning = replace(TABLE, workspace=replace(TABLE.workspace, yaws=(0.0, math.pi / 2)))
    things = {"a": block(1, 1, size=1)}
    turned = first_target(diamond, things, turning)
    straight = first_target(diamond, things)
    assert (
        turned.robustness
        > straight.robustness
        > first_target(diamond, things, replace(TABLE, refine=False)).robustness
    )
    # a square of side 1.697 around one of side 1
    assert turned.robustness == pytest.approx((1.2 * math.sqrt(2) - 1.0) / 2.0, abs=0.01)
    assert abs(turned.yaw) == pytest.approx(math.pi / 4, abs=0.02)


BESIDE = "region goal = box(3, 3, 7, 7)\n"
NEIGHBOURS = {"a": block(1, 1, size=1), "b": block(6.5, 5, size=1)}


def test_room_is_kept_where_it_is_needed_and_costs_nothing_elsewhere():
    chosen = replace(TABLE, movable=("a", "b"), room=1.2)
    alone = f"{BESIDE}spec s = F (a enclosedin goal)"
    then_b = f"{BESIDE}spec s = F ((a enclosedin goal) and F (b leftof a))"
    assert first_target(alone, NEIGHBOURS, chosen).robustness == pytest.approx(1.5, abs=0.01)
    kept = first_target(then_b, NEIGHBOURS, replace(chosen, motions=1))
    assert kept.name == "a"
    always = first_target(alone, NEIGHBOURS, replace(chosen, room_from="all"))
    for target in (kept, always):
        placed = polygon_of(moved_object(NEIGHBOURS["a"], target.x, target.y))
        assert placed.distance(polygon_of(NEIGHBOURS["b"])) >= 1.2 - 1e-9
        assert target.robustness < 1.4
