from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

import spatial_replay as sr
from planning.kinematics import BLOCKS, PUSHING, Table, block, run
from spatial_replay import NoAutomatonError, Planner, Settings, TraceError, UsageError
from spatial_replay.planning import Grid, Outcome, Reason, Workspace, moved_object
from spatial_replay.planning.edges import MOST_MOTIONS

PUSH = Settings(
    Workspace(Grid.over(0.3, -0.225, 0.75, 0.225, 0.005)), "push", margin=0.01, constraint_margin=0.005
)
TABLE = Settings(Workspace(Grid.over(0, 0, 10, 10, 0.5), supports=frozenset({"plate"})))
THINGS = {
    "cup": block(1, 1, size=1),
    "fork": block(9, 9, size=1),
    "plate": block(5, 5, size=3),
}


def planner(text, settings=TABLE, **options):
    return Planner(sr.parse_specification(text), settings, **options)


def test_three_blocks_are_pushed_as_in_the_paper():
    steps, table = run(planner(PUSHING, PUSH), BLOCKS)
    assert [step.kind for step in steps] == ["execute", "execute", "hold"]
    assert len(steps[0].pruned) == 1
    assert steps[0].considered[0].pruned.kind == "no object can do it"
    assert steps[0].considered[0].path[-1] == steps[1].considered[-1].path[-1]
    result = sr.evaluate(sr.parse_specification(PUSHING), sr.Trace.from_samples(table.samples))
    assert result.verdict == "satisfied"


def test_a_path_keeps_clear_of_constraints():
    _, table = run(planner(PUSHING, PUSH), BLOCKS)
    always = sr.parse_specification(
        "G (green dist red >= 0.03 and green dist blue >= 0.03 and red dist blue >= 0.03)"
    )
    assert sr.evaluate(always, sr.Trace.from_samples(table.samples)).verdict == "satisfied"


def test_things_are_placed_one_after_the_other():
    text = "(F (cup enclosedin plate)) and (F (fork leftof plate and fork dist plate <= 1))"
    steps, table = run(planner(text), THINGS)
    assert sorted(step.target.name for step in steps[:-1]) == ["cup", "fork"]
    assert steps[-1].kind == "hold"
    result = sr.evaluate(sr.parse_specification(text), sr.Trace.from_samples(table.samples))
    assert result.verdict == "satisfied"


def test_only_movable_objects_are_moved():
    settings = Settings(TABLE.workspace, movable=("cup",))
    steps, _ = run(planner("F (cup enclosedin plate)", settings), THINGS)
    assert [candidate.name for candidate in steps[0].candidates] == ["cup"]


@pytest.mark.parametrize(("room", "is_roomy"), [(0.0, False), (2.0, True), (50.0, False)])
def test_things_are_placed_with_room_around_them_if_there_is_any(room, is_roomy):
    settings = Settings(TABLE.workspace, movable=("cup",), room=room, room_from="all")
    steps, table = run(planner("F (cup dist fork <= 4)", settings), THINGS)
    assert steps[-1].kind == "hold"
    apart = sr.parse_specification("F (cup dist fork >= 2)")
    last = sr.Trace.from_samples(table.samples[-1:])
    assert (sr.evaluate(apart, last).verdict == "satisfied") == is_roomy


def test_an_object_is_turned_if_the_specification_needs_it():
    yaws = tuple(k * math.pi / 4 for k in range(8))
    settings = Settings(Workspace(Grid.over(0, 0, 10, 10, 0.5), yaws))
    fork = block(1, 1, 0.3, size=1)
    steps, table = run(planner("F (fork oriented[0.01] plate)", settings), {**THINGS, "fork": fork})
    assert steps[-1].kind == "hold"
    assert math.isclose(math.cos(table.objects["fork"].yaw - table.objects["plate"].yaw), 1.0)


def test_a_step_that_fails_is_tried_elsewhere():
    steps, _ = run(planner("F (cup enclosedin plate)"), THINGS, slips=1)
    assert [step.kind for step in steps] == ["execute", "execute", "hold"]
    first, second = (step.target for step in steps[:2])
    assert math.dist((first.x, first.y), (second.x, second.y)) > TABLE.workspace.grid.cell_size


@dataclass
class Stubborn(Table):
    """A robot whose first motions are refused, or fail at a stage, while nothing moves."""

    at: str | None = None
    refusals: int = 0
    looks: bool = False

    def execute(self, step):
        if self.refusals:
            self.refusals -= 1
            if self.looks:
                self.look()
            return Outcome(False, "no room for the fingers", self.at)
        return super().execute(step)


def ended(one, objects, **options):
    """The steps of a run of a stubborn robot."""
    table = Stubborn(dict(objects), one, **options)
    table.look()
    steps = [one.next_step()]
    while steps[-1].kind == "execute":
        one.conclude(table.execute(steps[-1]))
        steps.append(one.next_step())
    return steps


def test_a_place_without_room_is_followed_by_one_with_room_from_everything():
    settings = replace(TABLE, movable=("cup",), room=1.5)
    one = planner("F (cup dist plate <= 2)", settings)
    first, second, last = ended(one, THINGS, at="place", refusals=1)
    assert last.kind == "hold"
    before, after = (next(each for each in step.candidates if each.is_chosen) for step in (first, second))
    assert before.room_from == ()
    assert after.room_from is None
    assert math.dist((first.target.x, first.target.y), (second.target.x, second.target.y)) > 0.5


def test_refused_motions_are_not_counted_and_the_last_reason_is_said():
    one = planner("F (cup enclosedin plate)", replace(TABLE, movable=("cup",)))
    steps = ended(one, THINGS, refusals=100)
    assert one.motions == 0
    assert steps[-1].kind == "no path"
    assert "no room for the fingers" in steps[-1].reason
    assert "no sample came during the motion" in steps[-1].reason


def test_after_a_failed_pick_no_other_target_is_tried():
    one = planner("F (cup enclosedin plate)", replace(TABLE, movable=("cup",)))
    first, second, last = ended(one, THINGS, at="pick", refusals=1, looks=True)
    assert second.target == first.target
    assert last.kind == "hold"
    refused = ended(
        planner("F (cup enclosedin plate)", replace(TABLE, movable=("cup",))), THINGS, at="pick", refusals=1
    )
    assert [each.kind for each in refused] == ["execute", "no path"]
    assert "could not be picked up" in str(refused[-1].pruned[0][1])


def test_a_push_that_failed_is_made_again_without_any_other():
    walls = (sr.Footprint.box(0, 3, 10, 4.2), sr.Footprint.box(0, 5.8, 10, 7))
    workspace = Workspace(Grid.over(0, 0, 10, 10, 0.5), obstacles=walls)
    objects = {"cup": block(1, 5, size=1), "plate": block(8, 5, size=1)}
    one = planner("F (cup dist plate <= 1)", Settings(workspace, "push", movable=("cup",)))
    steps = ended(one, objects, at="way", refusals=3, looks=True)
    assert [each.kind for each in steps] == ["execute"] * 4 + ["hold"]


def test_a_failure_has_one_of_three_stages():
    with pytest.raises(UsageError, match="fails at 'lift'"):
        Outcome(False, "", "lift")


def samples_on_the_way(step, objects):
    """What would be seen while a step's object follows its waypoints."""
    (name, points) = step.target.name, [np.array(each) for each in step.target.waypoints]
    places = [a + share * (b - a) for a, b in pairwise(points) for share in np.linspace(0, 1, 20)]
    moved = (moved_object(objects[name], *place.tolist()) for place in places)
    return [sr.Sample(time_ns, {**objects, name: each}) for time_ns, each in enumerate(moved)]


OUTSIDE = {"cup": block(-3, 5, size=1), "plate": block(8, 5, size=1)}
NEAR = "F (cup dist plate <= 1)"


@pytest.mark.parametrize(
    ("options", "others", "apart"),
    [
        ({}, {"fork": block(-0.5, 5, size=2)}, "G (cup dist fork >= 0)"),
        (
            {"obstacles": (sr.Footprint.box(-0.6, 3, -0.4, 7),)},
            {},
            "region wall = box(-0.6, 3, -0.4, 7)\nspec apart = G (cup dist wall >= 0)",
        ),
        ({"base": (10.0, 5.0), "farthest": 6.0}, {"fork": block(2, 5, size=2)}, "G (cup dist fork >= 0)"),
    ],
)
def test_an_object_out_of_reach_is_pushed_around_obstacles(options, others, apart):
    workspace = Workspace(Grid.over(0, 0, 10, 10, 0.5), clearance=0.5, **options)
    objects = {**OUTSIDE, **others}
    steps, _ = run(planner(NEAR, Settings(workspace, "push", movable=("cup",))), objects)
    assert [step.kind for step in steps] == ["execute", "hold"]
    assert len(steps[0].target.waypoints) > 2
    trace = sr.Trace.from_samples(samples_on_the_way(steps[0], objects))
    assert sr.evaluate(sr.parse_specification(apart), trace).verdict == "satisfied"


def test_an_object_without_a_free_path_is_not_pushed():
    walls = (sr.Footprint.box(-0.6, -20, -0.4, 30),)
    workspace = Workspace(Grid.over(0, 0, 10, 10, 0.5), obstacles=walls)
    steps, _ = run(planner(NEAR, Settings(workspace, "push", movable=("cup",))), OUTSIDE)
    assert "cup: no free path leads into reach" in steps[0].pruned[0][1].detail
    far = {**OUTSIDE, "cup": block(-30, 5, size=1)}
    steps, _ = run(planner(NEAR, Settings(workspace, "push", movable=("cup",))), far)
    assert "cup: it lies too far outside the workspace" in steps[0].pruned[0][1].detail


def test_an_edge_is_pruned_after_failed_motions():
    steps, _ = run(planner("F (cup enclosedin plate)"), THINGS, stuck={"cup", "plate"})
    assert steps[-1].kind == "no path"
    assert steps[-1].pruned == (((0, 1), Reason("tried 6 times", "it does not move")),)
    assert "no path left" in steps[-1].reason
    assert len(steps) == 1 + TABLE.attempts


def test_an_impossible_task_ends_with_the_reasons_for_pruned_edges():
    steps, _ = run(planner("F (cup leftof plate and cup rightof plate and cup enclosedin plate)"), THINGS)
    assert [step.kind for step in steps] == ["no path"]
    assert steps[0].reason.startswith("no path left")
    ((edge, reason),) = steps[0].pruned
    assert edge == (0, 1)
    assert "cup: no place is good enough" in reason.detail


def test_a_violated_specification_has_no_path():
    steps, _ = run(
        planner("(G (cup leftof plate)) and F (fork leftof plate)"), {**THINGS, "cup": block(8, 1)}
    )
    assert [step.kind for step in steps] == ["no path"]
    assert "cannot be satisfied any more" in steps[0].reason
    assert not steps[0].pruned


def test_a_satisfied_specification_is_held():
    steps, _ = run(planner("G (cup leftof plate)"), THINGS)
    assert [step.kind for step in steps] == ["hold"]
    assert steps[0].target is None
    assert steps[0].candidates == ()


def test_the_planner_waits_for_unknown_propositions():
    one = planner("(G (cup leftof plate)) and F (fork leftof plate)")
    one.observe(sr.Sample(0, {"plate": THINGS["plate"], "fork": THINGS["fork"]}))
    step = one.next_step()
    assert step.kind == "wait"
    assert "cup leftof plate" in step.reason
    one.observe(sr.Sample(1, THINGS))
    assert one.next_step().kind == "execute"


def test_a_doubtful_specification_is_held():
    one = planner("G (cup leftof plate)")
    for time_ns, seen in enumerate([THINGS, {"plate": THINGS["plate"]}, THINGS]):
        one.observe(sr.Sample(time_ns, seen))
    step = one.next_step()
    assert step.kind == "hold"
    assert "unless it was violated" in step.reason
    assert not one.is_accepting


def test_the_only_target_is_tried_again_until_attempts_are_used_up():
    settings = Settings(Workspace(Grid.over(2.0, 4.5, 3.0, 5.5, 1.0)), movable=("cup",), attempts=4)
    text = "F (cup leftof plate and cup dist plate <= 1)"
    steps, _ = run(planner(text, settings), THINGS, stuck={"cup"})
    assert [step.kind for step in steps] == ["execute"] * 4 + ["no path"]
    assert steps[-1].pruned == (((0, 1), Reason("tried 4 times", "it does not move")),)


def test_an_edge_without_movable_objects_is_pruned():
    settings = Settings(TABLE.workspace, movable=("fork",))
    steps, _ = run(planner("F (cup leftof plate and cup above plate)", settings), THINGS)
    assert steps[0].pruned == (((0, 1), Reason("no object that can be moved matters to it")),)


def test_equal_samples_give_equal_steps():
    first, second = (run(planner(PUSHING, PUSH), BLOCKS)[0] for _ in range(2))
    assert [step.target for step in first] == [step.target for step in second]
    assert [step.reason for step in first] == [step.reason for step in second]


def test_calls_out_of_order_are_refused():
    one = planner("F (cup enclosedin plate)")
    with pytest.raises(UsageError, match="observe a sample first"):
        one.next_step()
    with pytest.raises(UsageError, match="no step is being executed"):
        one.conclude(Outcome(True))
    one.observe(sr.Sample(5, THINGS))
    with pytest.raises(TraceError, match=r"a sample at 0.000 s follows one at 0.000 s"):
        one.observe(sr.Sample(5, THINGS))
    one.next_step()
    with pytest.raises(UsageError, match="conclude it"):
        one.next_step()


def test_wrong_types_of_arguments_are_refused():
    with pytest.raises(UsageError, match="settings is 'x'; give Settings"):
        planner("F (cup enclosedin plate)", "x")
    one = planner("F (cup enclosedin plate)")
    with pytest.raises(UsageError, match="None is not a sample; give a Sample"):
        one.observe(None)
    one.observe(sr.Sample(0, THINGS))
    one.next_step()
    with pytest.raises(UsageError, match="True is no outcome; give an Outcome"):
        one.conclude(True)
    one.conclude(Outcome(True))


def test_a_reason_names_a_few_edges_of_many():
    never = " and ".join(f"(F (cup leftof {one} and cup rightof {one}))" for one in ("fork", "plate", "cup"))
    steps, _ = run(planner(never), THINGS)
    assert steps[-1].kind == "no path"
    assert len(steps[-1].pruned) == 7
    assert steps[-1].reason.startswith(
        "no path left: every way from state 0 was given up "
        "(0 -> 1, 0 -> 2, 0 -> 3, 0 -> 4 and 3 more: no object can do it); what cannot be done: "
    )
    assert all("cup: " in reason.detail for _, reason in steps[-1].pruned)


def test_formulas_that_cannot_be_planned_are_refused():
    with pytest.raises(UsageError, match="looks at earlier samples"):
        planner("F (cup moved[1] cup[-3])")
    with pytest.raises(UsageError, match=r"^speed\(cup\) <= 1 looks at earlier samples"):
        planner("G (speed(cup) <= 1)")
    with pytest.raises(UsageError, match=r"t\(o\) in <text> is a template"):
        planner("spec t(o) = F (o leftof plate)")
    with pytest.raises(UsageError, match=r"t\(o\) in <text> is a template"):
        planner("spec a = F (cup leftof plate)\nspec t(o) = F (o leftof plate)", name="t")


@pytest.mark.parametrize(
    ("options", "messages"),
    [
        ({"skill": "throw"}, ["skill is 'throw'"]),
        ({"margin": -1.0, "attempts": 0}, ["margin is -1.0", "attempts is 0"]),
        ({"constraint_margin": math.nan, "room": "1"}, ["constraint_margin is nan", "room is '1'"]),
        ({"attempts": 2.5}, ["attempts is 2.5; give a whole number"]),
        ({"movable": "cup"}, ["movable is 'cup'; give a tuple of names"]),
        ({"movable": ("cup", 3)}, ["movable has 3; give a tuple of names"]),
        ({"workspace": None, "margin": math.inf}, ["workspace is None", "margin is inf"]),
    ],
)
def test_all_errors_in_settings_are_reported_together(options, messages):
    with pytest.raises(UsageError) as raised:
        Settings(**{"workspace": TABLE.workspace, **options})
    lines = str(raised.value).splitlines()
    assert [message in line for line, message in zip(lines, messages, strict=True)] == [True] * len(messages)


def test_unknown_movable_objects_are_named():
    one = planner("F (cup enclosedin plate)", replace(TABLE, movable=("cpu", "cup", "spoon", "fork")))
    with pytest.raises(UsageError) as raised:
        one.observe(sr.Sample(0, {"fork": THINGS["fork"], "plate": THINGS["plate"]}))
    first, second = str(raised.value).splitlines()
    assert first.startswith("'cpu' is movable, but neither")
    assert second.startswith("'spoon' is movable, but neither")
    assert second.endswith("the sample has: fork, plate")


def test_default_settings_plan_around_the_first_sample():
    one = Planner(sr.parse_specification("F (cup leftof plate and cup dist plate <= 1)"))
    with pytest.raises(UsageError, match="observe one first"):
        _ = one.settings
    with pytest.raises(UsageError, match="nothing in the sample"):
        one.observe(sr.Sample(0))
    steps, _ = run(one, {**THINGS, "cup": block(9, 1, size=1)})
    assert [step.kind for step in steps] == ["execute", "hold"]
    assert max(one.settings.workspace.grid.shape) == 80


def test_a_guard_of_too_many_cubes_is_refused_at_the_first_decision():
    # 2 ** 27 cubes: they are counted, not written out
    text = " xor ".join(f"(X t{number} leftof plate)" for number in range(28))
    one = planner(f"spec s = {text}", replace(TABLE, movable=("t0",)))
    one.observe(sr.Sample(0, {"plate": THINGS["plate"], **{f"t{n}": THINGS["cup"] for n in range(28)}}))
    with pytest.raises(NoAutomatonError, match="takes more than 100000 cubes, too many to plan around"):
        one.next_step()


def test_successful_motions_use_up_no_attempts_and_are_limited():
    one = planner("G F (cup dist plate <= 1)", replace(TABLE, movable=("cup",)))
    table = Table(dict(THINGS), one)
    table.look()
    motions = 0
    while (step := one.next_step()).kind == "execute":
        one.conclude(table.execute(step))
        motions += 1
        table.objects["cup"] = THINGS["cup"]
        table.look()
    assert step.kind == "no path"
    assert motions == MOST_MOTIONS
    assert step.pruned[0][1] == Reason(f"tried {MOST_MOTIONS} times in all")
