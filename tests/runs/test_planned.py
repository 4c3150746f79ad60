"""Simulated runs that are planned, end to end."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

import spatial_replay as sr
from spatial_replay.geometry.footprint import centre_of
from spatial_replay.logs.schemas.BehaviourTree_pb2 import BehaviourTree
from spatial_replay.planning import read_decisions, recompute_decisions
from spatial_replay.replay.engine import load_files, run_replay
from spatial_replay.replay.verification import verify_certificate
from spatial_replay.runs.planned import PlannedRun, record_plan, settings_for
from spatial_replay.simulation.tabletop import make_world
from spatial_replay.sources import open_source

RUNNING, SUCCESS = BehaviourTree.STATUS_RUNNING, BehaviourTree.STATUS_SUCCESS


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PlannedRun]:
    """A planned push, and its log."""
    pytest.importorskip("pybullet", reason="PyBullet is not installed; it has wheels for Python 3.11")
    path = tmp_path_factory.mktemp("planned") / "push.mcap"
    return path, record_plan("push", path, seed=3)


def test_three_blocks_are_pushed_one_after_the_other(pushed: tuple[Path, PlannedRun]) -> None:
    path, planned = pushed
    assert (planned.ended, planned.verdict) == ("hold", "satisfied")
    assert planned.pruned >= 1
    first, *_ = read_decisions(path).decisions
    assert "no object can do it" in first.considered[0].pruned
    assert len(first.considered[0].path) == 2
    assert planned.steps >= 2


def test_a_replay_confirms_that_the_specification_is_satisfied(pushed: tuple[Path, PlannedRun]) -> None:
    source = open_source(pushed[0])
    replayed = run_replay(source, load_files((), source))
    assert replayed.verdict == "satisfied"


def test_recomputed_decisions_and_certificate_are_equal(pushed: tuple[Path, PlannedRun]) -> None:
    source = open_source(pushed[0])
    assert verify_certificate(source).differences == ()
    recomputed = recompute_decisions(source)
    assert recomputed.differences == ()
    assert recomputed.decisions == len(read_decisions(pushed[0]).decisions)


def test_an_impossible_task_ends_with_a_reason(tmp_path: Path) -> None:
    pytest.importorskip("pybullet", reason="PyBullet is not installed; it has wheels for Python 3.11")
    impossible = sr.parse_specification("F (red dist blue >= 100)")
    planned = record_plan("push", tmp_path / "run.mcap", impossible)
    assert planned.ended == "no path"
    assert planned.reason.startswith("no path left")
    assert planned.steps == 0
    (decision,) = read_decisions(tmp_path / "run.mcap").decisions
    assert [(each.source, each.target) for each in decision.pruned] == [(0, 1)]


def test_names_that_the_world_does_not_have_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("pybullet", reason="PyBullet is not installed; it has wheels for Python 3.11")
    with pytest.raises(sr.SpecificationError, match="the world never has the object 'pink'"):
        record_plan("push", tmp_path / "run.mcap", sr.parse_specification("F (pink leftof red)"))
    assert not (tmp_path / "run.mcap").exists()
    # before anything else about the specification, such as how long its automaton takes
    too_large = sr.parse_specification("G (pink leftof red -> F[30, 30] (red leftof blue))")
    with pytest.raises(sr.SpecificationError, match="the world never has the object 'pink'"):
        record_plan("push", tmp_path / "run.mcap", too_large)


def test_a_push_stops_before_the_sample_that_would_violate() -> None:
    pytest.importorskip("pybullet", reason="PyBullet is not installed; it has wheels for Python 3.11")
    text = "spec apart = G (red dist green >= 0.03)\nspec s = (F (red dist blue <= 0.08)) and apart"
    file = sr.parse_specification(text)
    with closing(make_world("push", seed=3)) as world:
        planner = sr.Planner(file, replace(settings_for(world), movable=("red",)), name="s")
        seen: list[sr.Sample] = []

        def observe(sample: sr.Sample) -> str:
            seen.append(sample)
            planner.observe(sample)
            return planner.stop_reason

        world.attach(observe)
        world.step()
        assert planner.next_step().target is not None
        # the robot strays: straight towards green, instead of along the way that was planned
        done = world.push("red", [centre_of(seen[0].objects["green"].footprint)])
        assert not done.succeeded
        assert done.reason.startswith("stopped: with the next sample, not (red dist green >= 0.03)")
        planner.conclude(sr.Outcome(done.succeeded, done.reason))
        assert planner.next_step().kind == "execute"
    assert sr.evaluate(file, sr.Trace.from_samples(seen)).node("apart").verdict == "satisfied"


def test_objects_whose_orientations_are_compared_may_turn_unless_yaws_are_given(tmp_path: Path) -> None:
    pytest.importorskip("pybullet", reason="PyBullet is not installed; it has wheels for Python 3.11")
    facing = sr.parse_specification("F (red oriented[0.03] green)")
    log = tmp_path / "run.mcap"
    planned = record_plan("push", log, facing, seed=3)
    assert (planned.ended, planned.verdict) == ("hold", "satisfied")
    assert planned.yaws.endswith("degrees, since orientations are compared")
    assert read_decisions(log).decisions[0].target.turn != 0.0
    assert recompute_decisions(open_source(log)).differences == ()
    kept = record_plan("push", log, facing, seed=3, changes={"yaws": []})
    assert (kept.ended, kept.yaws) == ("no path", "")


def test_a_knife_is_turned_to_its_place(tmp_path: Path) -> None:
    pytest.importorskip("pybullet", reason="PyBullet is not installed; it has wheels for Python 3.11")
    knife = sr.parse_specification(
        "F (plate leftof knife and knife dist plate <= 0.08 and knife oriented[0.05] mat)"
    )
    log = tmp_path / "run.mcap"
    planned = record_plan("table-setting", log, knife, timings=True)
    assert (planned.ended, planned.verdict) == ("hold", "satisfied")
    decision, *_ = read_decisions(log).decisions
    assert decision.target.object == "knife"
    assert decision.target.turn != 0.0
    assert sr.verify(log).differences == recompute_decisions(open_source(log)).differences == ()

    payloads = (each for batch, _ in open_source(log).iter_payloads("/plan/behaviour_tree") for each in batch)
    ticks = [BehaviourTree.FromString(each) for each in payloads]
    assert [tick.time_ns for tick in ticks] == sorted(tick.time_ns for tick in ticks)
    statuses = [{node.name: node.status for node in tick.nodes} for tick in ticks]
    assert all(one != other for one, other in pairwise(statuses))
    assert [tick.tick for tick in ticks] == sorted({tick.tick for tick in ticks})
    picked = next(place for place, each in enumerate(statuses) if each["pick knife"] == SUCCESS)
    placed = next(place for place, each in enumerate(statuses) if each["place knife"] == SUCCESS)
    assert picked < placed
    assert statuses[0]["pick knife"] == RUNNING and statuses[-1]["set"] == SUCCESS
