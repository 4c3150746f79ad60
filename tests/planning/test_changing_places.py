"""Objects that change places although something keeps them apart, and motions that failed at once."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

import spatial_replay as sr
from planning.kinematics import Table, block, run
from spatial_replay import Planner, Settings
from spatial_replay.geometry.footprint import centre_of
from spatial_replay.planning import Grid, Outcome, Workspace

TABLE = Settings(Workspace(Grid.over(0, 0, 10, 7, 0.25), clearance=0.05), margin=0.02, constraint_margin=0.02)
PLACES = {"a": (2.0, 2.0), "b": (6.0, 2.0), "c": (4.0, 5.0)}
THINGS = {name: block(*place, size=1) for name, place in PLACES.items()}
REGIONS = "".join(
    f"region at_{name} = box({x - 0.8}, {y - 0.8}, {x + 0.8}, {y + 0.8})\n" for name, (x, y) in PLACES.items()
)
SWAP = "F (a enclosedin at_b and b enclosedin at_a)"
RING = "F (a enclosedin at_b and b enclosedin at_c and c enclosedin at_a)"


def planned(text, names, always="", **options):
    """Return the motions of a run that ends satisfied, and keeps what always has to hold in every sample."""
    settings = replace(TABLE, movable=tuple(names), **options)
    things = {name: THINGS[name] for name in names}
    both = f"({text}) and G ({always})" if always else text
    specification = sr.parse_specification(f"{REGIONS}spec s = {both}")
    steps, table = run(Planner(specification, settings), things)
    assert steps[-1].kind == "hold", steps[-1].reason
    assert sr.evaluate(specification, sr.Trace.from_samples(table.samples)).verdict == "satisfied"
    return [step.target.name for step in steps if step.target]


@pytest.mark.parametrize("skill", ["place", "push"])
@pytest.mark.parametrize("apart", [0.02, 1.5])
def test_two_objects_change_places_that_always_have_to_be_apart(apart, skill):
    moved = planned(SWAP, "ab", f"a dist b >= {apart}", skill=skill)
    assert (moved[0], len(moved)) == (moved[2], 3)


def test_two_objects_change_places_past_a_third_one_that_both_have_to_keep_away_from():
    always = "a dist b >= 0.4 and a dist c >= 0.4 and b dist c >= 0.4"
    assert len(planned(SWAP, "abc", always)) <= 4


@pytest.mark.parametrize("skill", ["place", "push"])
@pytest.mark.parametrize("always", ["", "a dist b >= 0.3 and a dist c >= 0.3 and b dist c >= 0.3"])
def test_three_objects_change_places_in_a_ring_by_four_motions(always, skill):
    moved = planned(RING, "abc", always, skill=skill)
    assert (sorted(set(moved)), len(moved), moved[0]) == (["a", "b", "c"], 4, moved[-1])


@pytest.mark.parametrize("always", ["", "a dist b >= 0.1"])
def test_objects_that_are_pushed_pass_each_other_in_a_corridor(always):
    corridor = Workspace(Grid.over(0, 1.25, 10, 2.75, 0.25), clearance=0.05)
    moved = planned(SWAP, "ab", always, skill="push", workspace=corridor)
    assert (moved[0], len(moved)) == (moved[2], 3)


def test_two_pairs_of_objects_change_places_at_once():
    spots = {"a": (2.0, 2.0), "b": (2.0, 5.0), "c": (7.0, 5.0), "d": (7.0, 2.0)}
    regions = "".join(
        f"region at_{name} = box({x - 0.8}, {y - 0.8}, {x + 0.8}, {y + 0.8})\n"
        for name, (x, y) in spots.items()
    )
    goal = "a enclosedin at_b and b enclosedin at_a and c enclosedin at_d and d enclosedin at_c"
    steps, _ = run(
        Planner(
            sr.parse_specification(f"{regions}spec s = F ({goal})"), replace(TABLE, movable=tuple("abcd"))
        ),
        {name: block(*spot, size=1) for name, spot in spots.items()},
    )
    assert [step.kind for step in steps] == ["execute"] * 6 + ["hold"]


def test_a_corridor_without_room_to_pass_is_said_before_the_first_motion():
    corridor = Workspace(Grid.over(0, 1.75, 10, 2.25, 0.25), clearance=0.05)
    settings = replace(TABLE, movable=("a", "b"), skill="push", workspace=corridor)
    steps, _ = run(
        Planner(sr.parse_specification(f"{REGIONS}spec s = {SWAP}"), settings), {n: THINGS[n] for n in "ab"}
    )
    assert [step.kind for step in steps] == ["no path"]
    assert "a and b: there are places for all, but no order of motions to them was found" in steps[0].reason


# --------------------------------------------------------------------------------- what failed at once


def begins(step):
    """The direction in which a push begins, over the distance from a block's middle to its corner."""
    x, y = step.target.waypoints[0]
    points = [np.array(each) for each in step.target.waypoints]
    along = [a + share * (b - a) for a, b in pairwise(points) for share in np.linspace(0, 1, 50)]
    u, v = next((each for each in along if math.dist(each, (x, y)) >= math.sqrt(0.5)), points[-1])
    return math.atan2(v - y, u - x)


@pytest.mark.parametrize(
    "text",
    ["F (a enclosedin at_b)", f"({SWAP}) and G (a dist b >= 0.3)", "F (a leftof b) and F (b above c)"],
)
@pytest.mark.parametrize("skill", ["place", "push"])
def test_a_motion_that_failed_is_not_made_again_while_nothing_has_changed(text, skill):
    settings = replace(TABLE, skill=skill, movable=("a", "b"))
    planner = Planner(sr.parse_specification(REGIONS + f"spec s = {text}"), settings)
    steps, _ = run(planner, THINGS, stuck={"a", "b"})
    tried = [step for step in steps if step.target]
    assert steps[-1].kind == "no path"
    assert len(tried) > 1
    for place, one in enumerate(tried):
        for other in tried[:place]:
            if one.target.name != other.target.name:
                continue
            if skill == "push":
                assert abs(math.remainder(begins(one) - begins(other), math.tau)) > math.radians(15)
            else:
                assert math.dist((one.target.x, one.target.y), (other.target.x, other.target.y)) > 0.06


@dataclass
class Fingers(Table):
    """A robot that pushes with fingers: they come down behind an object, and need room there."""

    def execute(self, step):
        name, angle = step.target.name, begins(step)
        x, y = centre_of(self.objects[name].footprint)
        fingers = block(x - 0.95 * math.cos(angle), y - 0.95 * math.sin(angle), angle, size=0.4)
        scene = sr.Sample(0, {**self.objects, "fingers": fingers})
        for other in self.objects:
            apart = sr.parse_specification(f"G (fingers dist {other} >= 0.01)")
            if other != name and sr.evaluate(apart, sr.Trace.from_samples([scene])).verdict == "violated":
                self.look()
                return Outcome(False, f"no room for the fingers behind {name}")
        return super().execute(step)


def pushed(things, movable):
    settings = replace(
        TABLE, skill="push", movable=movable, workspace=replace(TABLE.workspace, clearance=0.0)
    )
    planner = Planner(sr.parse_specification(f"{REGIONS}spec s = F (a enclosedin at_b)"), settings)
    table = Fingers(dict(things), planner)
    table.look()
    steps = []
    while not steps or steps[-1].kind == "execute":
        steps.append(planner.next_step())
        if steps[-1].target:
            planner.conclude(table.execute(steps[-1]))
    assert steps[-1].kind == "hold", steps[-1].reason
    return [step.target.name for step in steps if step.target]


def test_a_push_without_room_behind_begins_in_another_direction():
    things = {"a": THINGS["a"], "wall": block(0.9, 2, size=1)}
    assert 2 <= len(pushed(things, ("a",))) <= TABLE.attempts


def test_what_takes_all_room_behind_an_object_is_pushed_away_first():
    walls = {
        "low": sr.TrackedObject(sr.Footprint.box(1.45, 0.7, 3.2, 1.2)),
        "high": sr.TrackedObject(sr.Footprint.box(1.45, 2.8, 3.2, 3.3)),
    }
    moved = pushed({"a": THINGS["a"], **walls, "c": block(0.9, 2, size=1)}, ("a", "c"))
    assert set(moved) == {"a", "c"}
    assert moved[-1] == "a"
