"""Specifications for which time has to pass: `X`, and bounds in samples."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import spatial_replay as sr
from planning.kinematics import BLOCKS, run
from planning.plans import PUSH, record_plan_of
from spatial_replay import NoAutomatonError, Planner, Settings
from spatial_replay.planning import (
    Grid,
    Outcome,
    Workspace,
    moved_object,
    read_decisions,
    read_steps,
    recompute_decisions,
)
from spatial_replay.sources import open_source

DONE = "green rightof red"
TIMED = {
    f"X X X X X F ({DONE})": 4,
    f"F[30,900] ({DONE})": 29,
    f"(green dist red >= 0.03) U[30,900] ({DONE})": 29,
    f"(G[0,60] (green leftof red)) and F ({DONE})": 60,
}


def planner(text, settings=PUSH):
    return Planner(sr.parse_specification(f"use spatial_spec\n{text}"), settings)


def verdict(text, samples):
    specification = sr.parse_specification(f"use spatial_spec\n{text}")
    return sr.evaluate(specification, sr.Trace.from_samples(samples)).verdict


@pytest.mark.parametrize(("text", "samples"), TIMED.items())
def test_the_planner_waits_as_long_as_time_has_to_pass(text, samples):
    steps, table = run(planner(text), BLOCKS)
    assert [step.kind for step in steps] == ["wait", "execute", "hold"]
    assert len(steps[0].ahead) == samples
    assert f"wait for {samples} samples" in steps[0].reason
    assert steps[0].aim.candidates == ()
    assert verdict(text, table.samples) == "satisfied"


def test_bounds_in_seconds_count_samples_at_the_stated_rate(tmp_path):
    text = f"use spatial_spec\nF[3s,90s] ({DONE})"
    with pytest.raises(NoAutomatonError, match="state the samples a second"):
        Planner(sr.parse_specification(text), PUSH)
    # the table without physics has ten samples a second
    timed = Planner(sr.parse_specification(text), PUSH, rate_hz=10)
    assert timed.bounds == "at 10 Hz, `F[3s, 90s]` is `F[30, 900]`"
    steps, table = run(timed, BLOCKS)
    assert [step.kind for step in steps] == ["wait", "execute", "hold"]
    assert len(steps[0].ahead) == 29
    assert verdict(f"F[3s,90s] ({DONE})", table.samples) == "satisfied"
    record_plan_of(tmp_path / "run.mcap", text, rate_hz=10)
    assert recompute_decisions(open_source(tmp_path / "run.mcap")).differences == ()


def test_the_planner_does_not_wait_before_a_deadline():
    steps, table = run(planner(f"F[0,600] ({DONE})"), BLOCKS)
    assert [step.kind for step in steps] == ["execute", "hold"]
    assert steps[0].aim.constraints.texts == ()
    assert verdict(f"F[0,600] ({DONE})", table.samples) == "satisfied"


def test_the_planner_does_not_wait_for_an_impossible_task():
    steps, _ = run(planner("F[0,600] (green rightof red and green leftof red)"), BLOCKS)
    assert [step.kind for step in steps] == ["no path"]
    assert len(steps[0].pruned) == 1


def test_two_tasks_with_a_deadline_are_done_one_after_the_other():
    text = "(F[0,600] (green rightof blue)) and (F[0,600] (red leftof blue and red above blue))"
    steps, table = run(planner(text), BLOCKS)
    assert [step.kind for step in steps] == ["execute", "execute", "hold"]
    assert verdict(text, table.samples) == "satisfied"


def test_a_wait_ends_when_the_automaton_takes_another_transition():
    one = planner(f"(G[0,60] (green leftof red)) and F ({DONE})")
    one.observe(sr.Sample(0, BLOCKS))
    first = one.next_step()
    one.observe(sr.Sample(1, BLOCKS))
    assert one.next_step() is first
    one.observe(sr.Sample(2, {**BLOCKS, "green": moved_object(BLOCKS["green"], 0.7, 0.0)}))
    after = one.next_step()
    assert (after.kind, after.number) == ("no path", 1)


WALL = sr.TrackedObject(sr.Footprint.box(0.45, 0.3, 0.55, 0.7))
TABLE = {
    "puck": sr.TrackedObject(sr.Footprint.disc(0.1, 0.5, 0.05)),
    "wall": WALL,
    "goal": sr.TrackedObject(sr.Footprint.box(0.8, 0.4, 1.0, 0.6)),
}
AROUND = Settings(
    Workspace(Grid.over(0, 0, 1.2, 1.0, cell_size=0.02), supports=frozenset({"goal"}), clearance=0.01),
    "push",
    movable=("puck",),
)


@pytest.mark.parametrize("samples", [1, 2, 50, 900])
@pytest.mark.parametrize("always", ["", " and G (puck dist wall >= 0.02)"])
def test_a_deadline_is_no_reason_to_go_through_a_wall(samples, always):
    steps, _ = run(planner(f"(F[0,{samples}] (puck enclosedin goal)){always}", AROUND), TABLE)
    points = [np.array(point) for point in steps[0].target.waypoints]
    places = [a + share * (b - a) for a, b in pairwise(points) for share in np.linspace(0, 1, 40)]
    seen = [
        sr.Sample(time_ns, {**TABLE, "puck": moved_object(TABLE["puck"], *place)})
        for time_ns, place in enumerate(places)
    ]
    assert verdict("G (puck dist wall >= 0)", seen) == "satisfied"


@pytest.mark.parametrize("text", TIMED)
def test_a_wait_is_logged_once_with_its_outcome(tmp_path, text):
    log = tmp_path / "run.mcap"
    steps = record_plan_of(log, f"use spatial_spec\nspec task = {text}")
    waits = [each for each in read_decisions(log).decisions if each.kind == each.KIND_WAIT]
    (wait,) = waits
    assert wait.outcome.succeeded
    assert wait.outcome.reason == "the time has passed"
    assert wait.outcome.end_ns == steps[1].time_ns
    recomputed = recompute_decisions(open_source(log))
    assert recomputed.differences == ()
    assert recomputed.decisions == len(steps)
    assert [each.step.reason for each in read_steps(log)] == [each.reason for each in steps]


def block(x: float, yaw: float | None = None) -> sr.TrackedObject:
    return sr.TrackedObject(sr.Footprint.disc(x, 0, 0.02), class_name="block", yaw=yaw)


IN_BIN = 'region bin = box(0.6, -0.1, 0.8, 0.1)\ngroup all_blocks = class "block"\nspec s = '


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (f"{IN_BIN}F (rad enclosedin bin)", "rad is not in the sample; did you mean 'red'?"),
        ("F (red oriented[0.1] blue)", "red oriented[0.1] blue unknown: red has no orientation"),
        (
            'F (forall b in class "blok": b above red)',
            "nothing shows that it is done: no object is in class \"blok\"; did you mean 'block'?",
        ),
    ],
)
def test_a_wait_says_what_it_lacks(text: str, reason: str) -> None:
    planner = Planner(sr.parse_specification(text), PUSH)
    for time_ns in range(3):
        planner.observe(sr.Sample(time_ns, {"red": block(0.4), "blue": block(0.5, yaw=0.0)}))
        step = planner.next_step()
        assert (step.kind, step.number) == ("wait", 0)
        assert reason in step.reason


def test_a_class_without_members_is_not_done_until_they_come_and_do_it() -> None:
    planner = Planner(sr.parse_specification(f"{IN_BIN}F (forall b in all_blocks: b enclosedin bin)"), PUSH)
    kinds = []
    for time_ns, objects in enumerate([{}, {}, {"red": block(0.4)}]):
        planner.observe(sr.Sample(time_ns, objects))
        step = planner.next_step()
        kinds.append(step.kind)
    assert kinds == ["wait", "wait", "execute"]
    planner.observe(sr.Sample(9, {"red": block(0.7)}))
    planner.conclude(Outcome(True))
    assert planner.next_step().kind == "hold"


@pytest.mark.parametrize(
    "text",
    [
        "(F red enclosedin bin) and G (forall b in people: b dist red >= 0.1)",
        "F (red enclosedin bin and forall b in people: b dist red >= 0.1)",
    ],
)
def test_people_who_never_come_hold_nothing_up(text: str) -> None:
    planner = Planner(sr.parse_specification(f'group people = class "person"\n{IN_BIN}{text}'), PUSH)
    planner.observe(sr.Sample(0, {"red": block(0.4)}))
    assert planner.next_step().kind == "execute"
    planner.observe(sr.Sample(1, {"red": block(0.7)}))
    planner.conclude(Outcome(True))
    assert planner.next_step().kind == "hold"
