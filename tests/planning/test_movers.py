"""Objects that move by themselves, and pushes that end where they end."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice, pairwise, product

import numpy as np
import pytest

import spatial_replay as sr
from examples import cases
from planning.kinematics import block
from spatial_replay import Planner, Settings
from spatial_replay.geometry.measure import contact
from spatial_replay.planning import (
    Grid,
    Outcome,
    Workspace,
    moved_object,
    read_decisions,
    recompute_decisions,
)
from spatial_replay.planning.decisions import points_along
from spatial_replay.sources import open_source

STEP = 0.012
"""How far an object is moved from sample to sample."""


@dataclass
class Robot:
    """Moves objects in small steps, and stops when the planner says so.

    Attributes:
        write: takes each sample.
        person: gives the person at a sample's number.
        step: how far an object is moved from sample to sample.
        approach: for how many samples an object stands before each straight leg of its way.
    """

    objects: dict[str, sr.TrackedObject]
    planner: Planner
    write: object
    person: object = None
    step: float = STEP
    approach: int = 0
    samples: list[sr.Sample] = field(default_factory=list)
    stops: int = 0

    def look(self):
        number = len(self.samples)
        objects = (
            dict(self.objects) if self.person is None else {**self.objects, "person": self.person(number)}
        )
        self.samples.append(sr.Sample(round(number * 1e9 / 30), objects))
        self.write(self.samples[-1])

    def execute(self, step):
        name = step.target.name
        for begin, end in pairwise(step.target.waypoints):
            for point in (*[begin] * self.approach, *islice(points_along((begin, end), self.step), 1, None)):
                self.objects[name] = moved_object(self.objects[name], *point)
                self.look()
                if self.planner.stop_reason:
                    self.stops += 1
                    return Outcome(False, self.planner.stop_reason)
        return Outcome(True)


def walking(speed, phase):
    """A person who walks to and fro between two places, from one of 16 phases on."""

    def person(number):
        passed = (number / 30 * speed + phase / 16) % 1.0
        return sr.TrackedObject(sr.Footprint.disc(0.6, 0.1 + min(passed, 1.0 - passed), 0.08))

    return person


PASSING = """region r = box(0.95, 0.3, 1.15, 0.5)
spec task = (F (cup enclosedin r)) and (G (cup dist person >= 0.05))"""
AREA = Workspace(Grid.over(0.0, 0.0, 1.3, 0.8, 0.02))


def act(planner, robot):
    """Let a robot act until nothing is left to do; return the kind of the last decision, and the verdict."""
    robot.look()
    while (step := planner.next_step()).kind in ("execute", "wait"):
        if step.kind == "wait":
            robot.look()
        else:
            planner.conclude(robot.execute(step))
    return step.kind, sr.evaluate(planner.specification, sr.Trace.from_samples(robot.samples)).verdict


def past_a_person(skill, speed, phase):
    """Return a planner and a robot that has to bring a cup past a person."""
    settings = Settings(AREA, skill, movable=("cup",), margin=0.005, constraint_margin=0.005, lift=0.1)
    planner = Planner(sr.parse_specification(PASSING), settings)
    cup = sr.TrackedObject(sr.Footprint.disc(0.15, 0.4, 0.04))
    return planner, Robot({"cup": cup}, planner, planner.observe, walking(speed, phase))


@pytest.mark.parametrize("skill", ["place", "push"])
@pytest.mark.parametrize(
    ("speed", "phase"), cases([*product((0.1, 0.3), range(16))], quick=[(0.1, 10), (0.3, 3), (0.3, 13)])
)
def test_an_object_keeps_away_from_a_person_who_walks_to_and_fro(speed, phase, skill):
    assert act(*past_a_person(skill, speed, phase)) == ("hold", "satisfied")


@pytest.mark.parametrize("phase", [0, 12])
def test_an_arm_that_needs_time_to_begin_pushes_past_a_person(phase):
    def person(number):
        passed = (number / 90 + phase / 8) % 2.0
        return sr.TrackedObject(sr.Footprint.disc(0.475, 1.8 * min(passed, 2.0 - passed) - 0.9, 0.03))

    text = "(F (cup enclosedin goal)) and (G (cup dist person >= 0.04))"
    file = sr.parse_specification(f"region goal = box(0.62, -0.08, 0.76, 0.08)\nspec task = {text}")
    area = Workspace(Grid.over(0.2, -0.3, 0.8, 0.3, 0.01))
    planner = Planner(file, Settings(area, "push", movable=("cup",), margin=0.01, constraint_margin=0.008))
    cup = block(0.33, 0.0, size=0.04)
    robot = Robot({"cup": cup}, planner, planner.observe, person, step=0.01, approach=35)
    assert act(planner, robot) == ("hold", "satisfied")


def test_a_motion_aside_during_which_no_sample_comes_becomes_a_wait():
    planner, robot = past_a_person("push", 0.3, 3)
    # straight towards the cup
    robot.person = lambda number: sr.TrackedObject(sr.Footprint.disc(0.6 - number * 0.02, 0.4, 0.08))
    move, times_ns = robot.execute, []

    def execute(step):
        if "goes aside" not in step.reason:
            return move(step)
        times_ns.append(step.time_ns)
        return Outcome(True)

    robot.execute = execute
    act(planner, robot)
    assert times_ns
    assert len(set(times_ns)) == len(times_ns)


def test_a_wait_for_others_is_logged_with_its_reason_and_counts_no_attempt(tmp_path):
    path = tmp_path / "run.mcap"
    planner, robot = past_a_person("place", 0.3, 8)
    with sr.Recorder(path, planner=planner) as recorder:
        robot.write = recorder.write
        sr.plan(planner, robot, recorder)
    decisions = read_decisions(path).decisions
    waits = [decision for decision in decisions if decision.kind == decision.KIND_WAIT]
    assert waits
    for wait in waits:
        assert wait.reason == "wait: person may come too near"
        assert (wait.outcome.succeeded, wait.outcome.reason) == (True, "nothing is in the way any more")
    assert all(not decision.pruned for decision in decisions)
    assert recompute_decisions(open_source(path)).differences == ()


@pytest.mark.parametrize("seed", cases(range(12), quick=range(5)))
def test_two_pushed_boxes_change_places_without_a_stop(seed):
    random = np.random.default_rng(seed)
    (ax, ay), (bx, by) = random.uniform((0.2, 0.3), (0.45, 0.7)), random.uniform((0.75, 0.3), (1.0, 0.7))
    things = {"a": block(ax, ay, size=0.08), "b": block(bx, by, size=0.08)}
    regions = "".join(
        f"region at_{name} = box({x - 0.06}, {y - 0.06}, {x + 0.06}, {y + 0.06})\n"
        for name, (x, y) in {"a": (ax, ay), "b": (bx, by)}.items()
    )
    text = "(F (a enclosedin at_b and b enclosedin at_a)) and (G (a dist b >= 0.02))"
    specification = sr.parse_specification(f"{regions}spec swap = {text}")
    settings = Settings(
        Workspace(Grid.over(0.0, 0.0, 1.2, 1.0, 0.02), clearance=0.01),
        "push",
        margin=0.005,
        constraint_margin=0.005,
    )
    planner = Planner(specification, settings)
    robot = Robot(things, planner, planner.observe)
    assert act(planner, robot) == ("hold", "satisfied")
    assert (robot.stops, planner.motions) == (0, 3)


def test_the_first_and_the_last_leg_of_a_push_touch_nothing():
    # the middles of all cells on the way are free, and a straight way between two of them is not
    random = np.random.default_rng(126)
    places = random.uniform(0.1, 0.9, (8, 2))
    things = {f"o{number}": block(*place, random.uniform(0, 1), 0.08) for number, place in enumerate(places)}
    things["o0"] = sr.TrackedObject(sr.Footprint.disc(0.1266181, 0.9807553, 0.05))
    x, y = 0.492582, 0.464629
    text = f"region r = box({x - 0.07}, {y - 0.07}, {x + 0.07}, {y + 0.07})\nspec s = F (o0 enclosedin r)"
    settings = Settings(Workspace(Grid.over(0, 0, 1, 1, 0.02)), "push", movable=("o0",))
    planner = Planner(sr.parse_specification(text), settings)
    planner.observe(sr.Sample(0, things))
    waypoints = planner.next_step().target.waypoints
    others = [thing.footprint for name, thing in things.items() if name != "o0"]
    for leg in (waypoints[:2], waypoints[-2:]):
        for place in points_along(leg, 0.002):
            moved = moved_object(things["o0"], *place).footprint
            assert min(contact(moved, thing).distance for thing in others) > -1e-3
