"""Pushes that turn objects, and targets of pushes that are refined."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from shapely.geometry import Polygon, box

import spatial_replay as sr
from planning.kinematics import block, run
from planning.plans import record_plan_of
from spatial_replay import Planner, Settings
from spatial_replay.planning import Grid, Workspace, moved_object, recompute_decisions
from spatial_replay.sources import open_source

GRID = Grid.over(0, 0, 10, 10, 0.25)
TURNING = Settings(
    Workspace(GRID, yaws=(0.0, math.pi / 4, math.pi / 2)), "push", movable=("bar", "a"), margin=0.02
)


def bar(x, y, yaw=0.0, length=3.0):
    shape = sr.Footprint.box(-length / 2, -0.25, length / 2, 0.25)
    return moved_object(sr.TrackedObject(shape, yaw=0.0, height=(0.0, 0.5)), x, y, yaw)


def polygon_of(tracked):
    (part,) = tracked.footprint.parts
    return Polygon(part.vertices)


def planned(text, things, settings=TURNING):
    steps, table = run(Planner(sr.parse_specification(text), settings), things)
    trace = sr.Trace.from_samples(table.samples)
    return steps, table, next(iter(sr.evaluate(sr.parse_specification(text), trace).results)).verdict


def test_goals_about_orientation_and_slots_are_reached_by_turning():
    slot = "region slot = box(6, 2, 7, 6)\nspec s = F G (bar enclosedin slot)"
    facing = "spec s = F G ((bar oriented[0.2] a) and (bar leftof a))"
    things = {"bar": bar(2, 4), "a": block(8, 8, math.pi / 2, size=1)}
    for text in (slot, facing):
        steps, table, verdict = planned(text, things)
        assert [step.kind for step in steps] == ["execute", "hold"]
        assert verdict == "satisfied"
        assert steps[0].target.turn == pytest.approx(math.pi / 2, abs=math.pi / 8)
        assert table.objects["bar"].yaw == pytest.approx(steps[0].target.yaw)
        # without orientations to choose from, nothing turns
        fixed = replace(TURNING, workspace=Workspace(GRID))
        assert planned(text, things, fixed)[2] == "violated"
    assert box(6, 2, 7, 6).covers(polygon_of(planned(slot, things)[1].objects["bar"]))


def test_objects_are_turned_only_if_that_is_needed_and_round_ones_never():
    text = "region right = box(5, 0, 10, 10)\nspec s = F G (bar enclosedin right and a enclosedin right)"
    disc = sr.TrackedObject(sr.Footprint.disc(2, 7, 0.5), height=(0.0, 0.5))
    steps, _, verdict = planned(text, {"bar": bar(2, 3, 0.3), "a": disc})
    assert verdict == "satisfied"
    assert [step.target.turn for step in steps if step.target] == [0.0, 0.0]


def test_a_bar_turns_only_where_it_hits_nothing_and_keeps_what_must_not_hold():
    # in the channel the bar fits along x, and along y in the slot alone: it has to turn where both do
    walls = (sr.Footprint.box(0, 6, 6, 10), sr.Footprint.box(0, 0, 6, 2), sr.Footprint.box(7.4, 0, 9, 2))
    text = (
        "region goal = box(7, 0, 9.5, 10)\nspec s = (F G (bar enclosedin goal)) and (G (bar dist a >= 0.4))"
    )
    things = {"bar": bar(2, 4, length=3.5), "a": block(9, 8.6, size=0.6)}
    settings = replace(TURNING, workspace=replace(TURNING.workspace, obstacles=walls), constraint_margin=0.05)
    steps, table, verdict = planned(text, things, settings)
    assert verdict == "satisfied"
    assert any(step.target.turn for step in steps if step.target)
    for sample in table.samples:
        shape = polygon_of(sample.objects["bar"])
        assert all(shape.distance(Polygon(part.vertices)) > 0.0 for wall in walls for part in wall.parts)


def test_a_turn_that_would_violate_is_stopped():
    planner = Planner(
        sr.parse_specification("spec s = (F (bar oriented[0.02] a)) and (G (bar dist a >= 0.2))"), TURNING
    )
    a = block(5, 6, math.pi / 2, size=0.5)
    planner.observe(sr.Sample(0, {"bar": bar(5, 3), "a": a}))
    assert (target := planner.next_step().target).turn
    reasons = []
    for number in range(1, 10):
        # the robot turns the bar below the block, where it does not go
        planner.observe(sr.Sample(number, {"bar": bar(5, 4.2, number * 0.15), "a": a}))
        reasons.append(planner.stop_reason)
    assert target.name == "bar"
    assert next(filter(None, reasons)).startswith("stopped: with the next sample")


def test_targets_of_pushes_are_refined_unless_settings_forbid_it():
    text = "region goal = box(5, 3.1, 8, 4.9)\nspec s = F (a enclosedin goal)"
    targets = []
    alone = replace(TURNING, movable=("a",))
    for settings in (alone, replace(alone, refine=False)):
        planner = Planner(sr.parse_specification(text), settings)
        planner.observe(sr.Sample(0, {"a": block(2, 4.3, size=1)}))
        targets.append(planner.next_step().target)
    fine, coarse = targets
    assert fine.robustness > coarse.robustness >= TURNING.margin
    assert math.dist((fine.x, fine.y), (coarse.x, coarse.y)) <= 2 * math.sqrt(2) * GRID.cell_size + 1e-9
    placed = polygon_of(block(fine.x, fine.y, size=1))
    assert box(5, 3.1, 8, 4.9).exterior.distance(placed) == pytest.approx(fine.robustness, abs=1e-6)
    assert fine.waypoints[:-1] == coarse.waypoints[:-1]


def test_decisions_that_turn_pushed_objects_are_recomputed_from_their_log(tmp_path):
    path = tmp_path / "turned.mcap"
    text = "region slot = box(6, 2, 7, 6)\nspec s = F G (bar enclosedin slot)"
    steps = record_plan_of(path, text, {"bar": bar(2, 4), "a": block(8, 8, size=1)}, TURNING)
    assert steps[0].target.turn
    found = recompute_decisions(open_source(path))
    assert (found.decisions, found.differences) == (len(steps), ())
