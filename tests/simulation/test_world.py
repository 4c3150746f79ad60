"""Worlds: their samples, and what the robot does in them."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from simulation.worlds import NO_SIMULATOR, centre, off, world
from spatial_replay import Sample, TrackedObject, UsageError
from spatial_replay.simulation.scenarios.push import SCENARIO as PUSH
from spatial_replay.simulation.tabletop import SCENARIOS, Tabletop, default_specification, make_world
from spatial_replay.simulation.world import Box, Start, footprint, height
from spatial_replay.spec import object_names


def tracked(sample: Sample, name: str) -> TrackedObject:
    each = sample.objects[name]
    assert isinstance(each, TrackedObject)
    return each


@pytest.mark.parametrize("name", SCENARIOS)
def test_samples_have_the_poses_of_bodies(name: str) -> None:
    with world(name) as (made, _):
        sample = made.sample()
        assert list(sample.objects) == [body.name for body in made.bodies]
        for body in made.bodies:
            seen, pose = tracked(sample, body.name), made.scene.pose(body.name)
            assert seen.footprint == footprint(body.shape, pose)
            assert seen.height == (None if body.support else height(body.shape, pose))
            assert seen.yaw == (pose.yaw if isinstance(body.shape, Box) else None)
            assert (seen.class_name, seen.uncertainty) == (body.class_name, 0.0)


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_default_specification_names_objects_of_its_world(name: str) -> None:
    with world(name) as (made, _):
        names = set(object_names(default_specification(name)))
        assert names
        assert names <= {body.name for body in made.bodies}


@pytest.mark.parametrize("name", SCENARIOS)
def test_all_bodies_start_in_reach_and_at_rest(name: str) -> None:
    with world(name, seed=3) as (made, _):
        before = {body.name: centre(made, body.name) for body in made.bodies}
        space = made.workspace
        xmin, ymin, xmax, ymax = space["area"]
        for x, y in before.values():
            assert xmin <= x <= xmax
            assert ymin <= y <= ymax
            assert space["nearest"] <= math.hypot(x, y) <= space["farthest"]
        for _ in range(6):
            made.step()
        assert all(off(made, name, place) < 1e-3 for name, place in before.items())


def test_samples_come_thirty_times_a_second_from_time_0() -> None:
    with world("push") as (made, seen):
        for _ in range(3):
            made.step()
        assert [sample.time_ns for sample in seen] == [0, 33333333, 66666666, 100000000]
        assert made.time_ns == 10**8


def test_a_reset_restarts_the_world() -> None:
    with world("push", seed=4) as (made, _):
        first = made.sample()
        made.push("red", [(0.4, 0.0)])
        made.reset(5)
        assert made.time_ns == 0
        assert made.sample() != first
        made.reset(4)
        assert made.sample() == first


def test_noise_stays_within_the_uncertainty_that_samples_state() -> None:
    with world("push", noise_m=0.004) as (made, seen), world("push") as (exact, _):
        for _ in range(20):
            made.step()
        assert made.sample() == made.sample() == seen[-1]
        offsets = []
        for sample in seen:
            for body in made.bodies:
                each = tracked(sample, body.name)
                assert each.uncertainty == 0.004
                middle = each.footprint.parts[0].vertices.mean(axis=0)
                offsets.append(math.dist(middle, centre(exact, body.name)))
        assert np.mean(offsets) > 0.002
        assert max(offsets) <= 0.0041


def test_the_robot_pushes_a_block_along_a_path() -> None:
    with world("push") as (made, seen):
        blue = centre(made, "blue")
        done = made.push("green", [(0.38, -0.01), (0.42, -0.01), (0.42, 0.06)])
        assert done.succeeded, done.reason
        assert off(made, "green", (0.42, 0.06)) < 0.01
        assert off(made, "blue", blue) < 1e-4
        assert made.scene.pose("green").stands
        widest = max(tracked(sample, "green").footprint.parts[0].vertices[:, 0].max() for sample in seen)
        assert widest < 0.47


def test_the_robot_places_objects_at_their_goals() -> None:
    with world("pick-place") as (made, _):
        for name, goal, yaw in [("mug", (0.36, -0.2), None), ("banana", (0.42, 0.2), 1.2)]:
            done = made.place(name, *goal, yaw)
            assert done.succeeded, done.reason
            assert off(made, name, goal) < 0.01
            assert made.scene.pose(name).stands
        assert made.scene.pose("banana").yaw == pytest.approx(1.2, abs=0.05)


def test_an_object_on_a_plate_lies_higher() -> None:
    with world("pick-place") as (made, _):
        assert made.place("kanelbulle", *centre(made, "plate")).succeeded
        top = made.scene.height("plate")[1]
        assert made.scene.height("kanelbulle")[0] == pytest.approx(top, abs=2e-3)


def test_an_impossible_placement_fails_with_a_reason() -> None:
    with world("pick-place") as (made, _):
        can = centre(made, "can")
        done = made.place("banana", *can)
        assert not done.succeeded
        assert done.reason == "no room for the fingers around banana where it should go"
        assert made.time_ns == 0
    beside = Start("gelatin", can[0], can[1] + 0.05)
    with world("pick-place", starts=(beside,)) as (made, _):
        done = made.place("gelatin", 0.42, 0.2)
        assert done.reason == "no room for the fingers around gelatin where it lies"
        done = made.place("gelatin", *centre(made, "mug"))
        assert done.reason == "no room for the fingers around gelatin where it lies and should go"
        assert made.time_ns == 0


def test_invalid_calls_are_refused() -> None:
    with world("push") as (made, _):
        with pytest.raises(UsageError, match="'purple' cannot be moved in push; green, red, blue can"):
            made.push("purple", [(0.4, 0.0)])
        with pytest.raises(UsageError, match="does not place objects; it can push them"):
            made.place("red", 0.4, 0.0)
        for path in [], [(0.4, math.nan)]:
            with pytest.raises(UsageError, match="give finite numbers"):
                made.push("red", path)
        made.close()
        for use in made.step, made.sample, lambda: made.push("red", [(0.4, 0.0)]):
            with pytest.raises(UsageError, match="the world push is closed"):
                use()
    with pytest.raises(UsageError, match="no scenario 'chess'; there are push"):
        make_world("chess")
    with pytest.raises(UsageError, match="the noise is -1"):
        make_world("push", noise_m=-1)


def test_a_goal_out_of_reach_fails_with_a_reason() -> None:
    with world("pick-place") as (made, _):
        assert made.place("banana", 0.1, 0.1).reason == "(0.10, 0.10) is out of the robot's reach"
    with world("push") as (made, _):
        done = made.push("green", [(0.9, 0.0)])
        assert done.reason == "the robot does not reach (0.90, 0.00), where green should go"
        assert made.time_ns == 0


def test_a_pushed_block_is_turned_to_the_yaw_that_is_asked_for() -> None:
    with world("push", seed=2) as (made, _):
        before = tracked(made.sample(), "blue").yaw or 0.0
        done = made.push("blue", [(0.5, 0.12)], yaw=before + 0.7)
        assert done.succeeded and "turned" in done.reason
        yaw = tracked(made.sample(), "blue").yaw or 0.0
        assert abs(math.remainder(yaw - before - 0.7, math.tau)) < 0.05
        assert math.dist(centre(made, "blue"), (0.5, 0.12)) < 0.015
        # stopped with the fingers closed around it, the hand lets go
        made.attach(lambda sample: "enough" if sample.signals["finger_width"] < 0.045 else None)
        assert made.push("blue", [(0.5, 0.12)], yaw=before).reason == "enough"
        assert made.sample().signals["finger_width"] > 0.06


def test_a_block_wider_than_the_fingers_open_is_pushed_but_not_turned() -> None:
    pytest.importorskip("pybullet", reason=NO_SIMULATOR)
    green, *others = PUSH.placements
    wide = replace(green, body=replace(green.body, shape=Box(0.08, 0.08, 0.04)))
    with closing(Tabletop(replace(PUSH, placements=(wide, *others)))) as made:
        assert made.push("green", [(0.4, -0.1)]).succeeded
        done = made.push("green", [(0.4, -0.1)], yaw=0.5)
    too_thick = "green is too thick for the gripper as it lies: 8.0 cm, and 7.2 cm fit between the fingers"
    assert (done.succeeded, done.reason) == (False, too_thick)
