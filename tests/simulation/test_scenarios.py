"""Scripts of scenarios satisfy their specifications, and recover from injected failures if they can."""

from __future__ import annotations

import math

import pytest

from simulation.worlds import off, world
from spatial_replay import Trace, evaluate
from spatial_replay.logs.behaviour_tree import TreeTick
from spatial_replay.simulation.tabletop import default_specification


def test_the_pushing_script_satisfies_its_specification() -> None:
    with world("push") as (made, seen):
        done = made.run(made.script())
        assert done.succeeded, done.reason
        verdict = evaluate(default_specification("push"), Trace.from_samples(seen)).verdict
        assert verdict == "satisfied"


def test_a_behaviour_tree_retries_after_a_drop() -> None:
    with world("table-setting", inject=("drop@5s",)) as (made, _):
        goal = (0.34, 0.0)
        done = made.place("fork", *goal, math.pi / 2)
        assert done.succeeded
        assert done.reason.startswith("placed fork, after this went wrong: fork slipped out of the fingers")
        assert off(made, "fork", goal) < 0.02
        assert abs(made.scene.pose("fork").turned_from(math.pi / 2)) < 0.1


def test_a_behaviour_tree_does_not_move_an_object_at_its_goal() -> None:
    with world("table-setting") as (made, _):
        ticks: list[TreeTick] = []
        made.attach(lambda sample: None, ticks.append)
        x, y, _ = made.scene.pose("cup").position.tolist()
        assert made.place("cup", x, y).succeeded
        assert made.time_ns == 0
    (tick,) = ticks
    status = {node.name: node.status for node in tick.nodes}
    assert status["set"] == status["is cup placed?"] == "SUCCESS"
    assert status["move cup"] == status["pick cup"] == "INVALID"


def test_a_behaviour_tree_fails_with_the_last_reason() -> None:
    with world("table-setting", inject=("slip",)) as (made, _):
        done = made.place("fork", 0.34, 0.0)
        assert not done.succeeded
        assert done.reason.startswith("fork slipped out of the fingers")


def test_a_scripted_run_can_be_shorter_and_longer_than_its_script() -> None:
    with world("push") as (made, seen):
        assert made.follow(made.script(), 10**9) is None
        assert made.time_ns == 10**9
        assert len(seen) == 31
    with world("table-setting") as (made, seen):
        x, y, _ = made.scene.pose("cup").position.tolist()
        nothing = made.scene.arm.wait(0.1)
        made.follow(nothing, 10**9)
        assert len(seen) == 31
        assert off(made, "cup", (x, y)) < 1e-3


@pytest.mark.parametrize("duration_ns", [1, 10**7, 33_333_334])
def test_a_duration_need_not_be_a_whole_number_of_samples(duration_ns: int) -> None:
    with world("push") as (made, seen):
        made.follow(made.script(), duration_ns)
        assert made.time_ns >= duration_ns
        assert seen[-1].time_ns <= made.time_ns
