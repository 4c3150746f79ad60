"""Goals about several objects, things in the way, and what cannot be done in the end."""

from __future__ import annotations

import math
import re
import sys
from collections import Counter
from dataclasses import replace
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from mcap.reader import make_reader

import spatial_replay as sr
from planning.kinematics import BLOCKS, Table, block, run
from planning.plans import record_plan_of
from spatial_replay import Planner, Settings
from spatial_replay.geometry.footprint import centre_of
from spatial_replay.planning import Grid, Workspace, moved_object, read_decisions, recompute_decisions
from spatial_replay.planning.settings import settings_from_text, text_from_settings
from spatial_replay.sources import open_source

TABLE = Settings(
    Workspace(Grid.over(0, 0, 10, 10, 0.25), supports=frozenset({"plate"}), clearance=0.05),
    movable=("a", "b", "c", "d"),
    margin=0.02,
)
THINGS = {name: block(x, y, size=1) for name, x, y in [("a", 1, 1), ("b", 3, 1), ("c", 8, 1), ("d", 8, 8)]}


def planned(text, settings=TABLE, things=THINGS, **options):
    """Return the names of the objects moved, how the run ends, and the steps and the table."""
    specification = sr.parse_specification(text)
    steps, table = run(Planner(specification, settings), things, **options)
    verdict = sr.evaluate(specification, sr.Trace.from_samples(table.samples)).verdict
    assert (steps[-1].kind == "hold") == (verdict == "satisfied")
    return [step.target.name for step in steps if step.target], steps[-1].kind, steps, table


@pytest.mark.parametrize(
    "text",
    [
        "group reds = a, b\nspec s = F (forall r in reds: r enclosedin goal)",
        "spec s = F G (a enclosedin goal and b rightof a)",
        "spec s = F (a enclosedin goal and b enclosedin goal and a above b)",
    ],
)
def test_a_goal_about_two_objects_takes_two_motions(text):
    moved, end, steps, _ = planned(f"region goal = box(4, 4, 7, 7)\n{text}")
    assert sorted(moved) == ["a", "b"]
    assert end == "hold"
    assert "the first of 2 motions" in steps[0].reason


def test_four_objects_are_arranged_in_a_tight_place():
    both = " and ".join(f"{name} enclosedin goal" for name in "abcd")
    moved, end, steps, _ = planned(f"region goal = box(4, 4, 6.55, 6.55)\nspec s = F ({both})")
    assert sorted(moved) == ["a", "b", "c", "d"]
    assert end == "hold"
    assert [each.name for each in steps[0].aim.motions] == moved


def test_blocks_are_pushed_to_a_goal_about_all_of_them():
    settings = Settings(
        Workspace(Grid.over(0.3, -0.225, 0.75, 0.225, 0.01)), "push", margin=0.01, constraint_margin=0.005
    )
    text = "use spatial_spec\nspec s = F (green rightof red and red rightof blue and green above blue)"
    _, end, _, _ = planned(text, settings, BLOCKS)
    assert end == "hold"


def test_one_push_that_leads_all_the_way_comes_before_two():
    # the shortest push for the first goal does not reach the second one
    places = {"a": (-0.54, -1.3), "b": (4.44, 4.22), "c": (4.03, -2.51)}
    settings = Settings(Workspace(Grid(-6, -6, 1, 12, 12)), "push", margin=0.3, attempts=1)
    things = {name: block(*place, size=1) for name, place in places.items()}
    moved, end, steps, _ = planned("F (b leftof c and X (b leftof a))", settings, things)
    assert moved == ["b"]
    assert end == "hold"
    assert len(steps[0].aim.motions) == 1


def test_a_row_that_is_narrower_than_whole_cells_is_filled():
    # three objects and the gaps between them leave 0.1 of 3.2, less than half a cell
    goal = " and ".join(f"{name} enclosedin row" for name in "abc")
    moved, end, _, table = planned(f"region row = box(4.05, 4.05, 7.3, 5.2)\nspec s = F ({goal})")
    assert (sorted(moved), end) == (["a", "b", "c"], "hold")
    centres = sorted(centre_of(table.objects[name].footprint)[0] for name in "abc")
    assert all(after - before > 1.05 for before, after in pairwise(centres))


def test_the_reason_names_the_rival_and_what_is_wanted():
    _, _, steps, _ = planned("spec s = F (a rightof c)")
    assert steps[0].reason.startswith(f"{steps[0].target.name} moves: a rightof c is wanted; ")


def test_the_reason_does_not_repeat_what_always_has_to_hold():
    _, _, steps, _ = planned("spec s = (F a rightof c) and G (a dist b >= 0.01 and b dist c >= 0.01)")
    why, *_ = re.split("[;.] ", steps[0].reason)
    assert why == f"{steps[0].target.name} moves: a rightof c is wanted"


def test_the_reason_names_the_specs_that_a_relation_is_of():
    text = """
    def near(x, y) = (0.2 <= x dist y <= 0.5) and (x leftof y) and (y rightof x)
    spec tidy  = F (d leftof a)
    spec close = F near(b, c)
    spec s     = tidy and close
    """
    _, _, steps, _ = planned(text)
    first, second = (step.reason for step in steps if step.target)
    assert str(steps[0].considered[0].progress) in ("close and d leftof a", "d leftof a and close")
    assert re.search("^[bc] moves: close is wanted[;.] ", first)
    assert re.search(r"^[ad] moves: d leftof a \(tidy\) is wanted[;.] ", second)


def test_an_edge_that_no_single_motion_takes_is_not_given_up_for_good():
    regions = "region p = box(4, 6, 7, 9)\nregion q = box(0, 3, 2, 5)\n"
    text = f"{regions}spec s = (F a enclosedin p) and (F d enclosedin q)"
    _, end, steps, _ = planned(text, slips=1)
    edges = [[each.edge for each in step.considered] for step in steps[:2]]
    assert (end, len(edges[0])) == ("hold", 2)
    assert edges[0] == edges[1]


def test_what_is_in_the_way_is_moved_first():
    moved, end, _, _ = planned("region spot = box(7.2, 0.2, 8.8, 1.8)\nspec s = F (a enclosedin spot)")
    assert moved == ["c", "a"]
    assert end == "hold"


def test_motions_go_on_as_planned_and_do_not_undo_each_other():
    # a new arrangement after the first motion would take five more, the first of them back
    spots = [(13, 15.8), (7.6, 17.5), (10.7, 5.6), (7.9, 7.6), (13.7, 4.1), (14.1, 6.9)]
    things = {f"o{number}": block(*spot, size=1) for number, spot in enumerate(spots)}
    workspace = Workspace(Grid.over(0, 0, 20, 20, 1), clearance=0.2)
    settings = Settings(workspace, "push", movable=tuple(things), margin=0.1, constraint_margin=0.1)
    sorting = " and ".join(
        f"{left} leftof {right}" for left, right in pairwise(["o5", "o2", "o0", "o3", "o1", "o4"])
    )
    planner = Planner(sr.parse_specification(f"F ({sorting})"), settings)
    table = Table(things, planner)
    table.look()
    first = planner.next_step()
    planner.conclude(table.execute(first))
    _, *left = [motion.name for motion in first.aim.motions]
    assert left == [motion.name for motion in planner.next_step().aim.motions]


def test_objects_are_lined_up_on_a_grid_of_200_columns():
    things = {name: block(0.8 + 2.5 * number, 0.5, size=0.4) for number, name in enumerate("abcd")}
    line = " and ".join(f"{a} rightof {b} and {a} dist {b} <= 0.3" for a, b in pairwise(things))
    settings = Settings(
        Workspace(Grid.over(0, 0, 10, 1, 0.05), clearance=0.05), movable=tuple(things), margin=0.05
    )
    planner = Planner(sr.parse_specification(f"F ({line})"), settings)
    planner.observe(sr.Sample(0, things))
    step = planner.next_step()
    assert (step.kind, step.search.arrangements) == ("execute", 1)


def test_a_slot_for_two_is_not_taken_in_the_middle():
    text = "region slot = box(4, 4, 6.6, 5.6)\n"
    text += "spec s = (F G (a enclosedin slot)) and (F (a leftof d and b enclosedin slot))"
    moved, end, _, _ = planned(text)
    assert sorted(moved) == ["a", "b"]
    assert end == "hold"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("(F (a enclosedin goal)) and (F (b leftof c)) and F (d enclosedin tiny)", "d enclosedin tiny"),
        ("(F G (a enclosedin slot)) and (F (c above d)) and F G (b enclosedin slot)", "enclosedin slot"),
    ],
)
def test_what_cannot_be_done_in_the_end_is_said_before_the_first_motion(text, named):
    regions = "region goal = box(4, 4, 7, 7)\nregion tiny = box(4, 4, 4.5, 4.5)\n"
    moved, end, steps, _ = planned(f"{regions}region slot = box(4, 4, 5.5, 5.5)\nspec s = {text}")
    assert (moved, end) == ([], "no path")
    assert named in steps[0].reason


SWAP = "region left = box(1.3, 1.3, 2.7, 2.7)\nregion right = box(5.3, 1.3, 6.7, 2.7)\n"
PAIR = {"a": block(2, 2, size=1), "b": block(6, 2, size=1)}


@pytest.mark.parametrize("skill", ["place", "push"])
@pytest.mark.parametrize(
    "goal",
    [
        "F (a enclosedin right and b enclosedin left)",
        "(F G (a enclosedin right)) and F G (b enclosedin left)",
    ],
)
def test_two_objects_change_places_by_parking_one(goal, skill):
    settings = replace(TABLE, skill=skill, movable=("a", "b"))
    moved, end, steps, _ = planned(f"{SWAP}spec s = {goal}", settings, PAIR)
    assert (moved[0], moved[-1], len(moved), end) == (moved[2], moved[0], 3, "hold")
    parked = steps[0].target
    assert steps[0].reason.startswith(f"{moved[0]} goes aside: {moved[1]} has to pass. ")
    assert [each.name for each in steps[0].aim.motions] == moved
    assert (parked.x, parked.y) != (steps[2].target.x, steps[2].target.y)


def test_what_stands_in_the_only_way_of_a_push_is_pushed_aside():
    walls = (sr.Footprint.box(4, 0, 4.5, 4), sr.Footprint.box(4, 6, 4.5, 10))
    settings = replace(
        TABLE,
        skill="push",
        movable=("a", "c"),
        workspace=replace(TABLE.workspace, obstacles=walls, clearance=0.0),
    )
    things = {"a": block(2, 5, size=1), "c": block(4.25, 5, size=1)}
    text = "region goal = box(7, 4, 9, 6)\nspec s = F (a enclosedin goal)"
    moved, end, _, _ = planned(text, settings, things)
    assert (moved, end) == (["c", "a"], "hold")
    assert planned(text, replace(settings, movable=("a",)), things)[:2] == ([], "no path")


def test_a_place_where_a_motion_failed_comes_again_if_there_is_no_other():
    text = "region spot = box(4, 4, 5.3, 5.3)\nspec s = F (a enclosedin spot)"
    assert planned(text, slips=2)[:2] == (["a", "a", "a"], "hold")


def test_a_planner_that_plans_one_motion_at_a_time_gives_joint_goals_up():
    alone = Settings(TABLE.workspace, movable=TABLE.movable, margin=0.02, motions=1)
    moved, end, _, _ = planned(
        "region goal = box(4, 4, 7, 7)\nspec s = F (a enclosedin goal and b enclosedin goal)", alone
    )
    assert (moved, end) == ([], "no path")


def test_settings_in_a_log_are_read_as_they_were():
    assert settings_from_text(text_from_settings(TABLE)) == TABLE


def test_a_motion_that_slips_is_planned_again():
    moved, end, _, _ = planned(
        "region goal = box(4, 4, 7, 7)\nspec s = F (a enclosedin goal and b enclosedin goal)", slips=1
    )
    assert len(moved) == 3
    assert end == "hold"


JOINT = "region goal = box(4, 4, 7, 7)\nspec s = F (a enclosedin goal and b enclosedin goal)"


def test_joint_decisions_are_logged_and_recomputed(tmp_path):
    steps = record_plan_of(tmp_path / "run.mcap", JOINT, THINGS, TABLE)
    first, *_ = read_decisions(tmp_path / "run.mcap").decisions
    assert first.considered[-1].joint
    assert [each.object for each in first.considered[-1].motions] == ["a", "b"]
    recomputed = recompute_decisions(open_source(tmp_path / "run.mcap"))
    assert recomputed.differences == ()
    assert recomputed.decisions == len(steps)


VASE = {"cup": block(1, 5, size=1), "vase": block(5, 3, size=1), "fork": block(1, 9, size=1)}
NEVER = "spec s = (F (cup dist fork >= 8.5)) and G (cup dist vase >= 0.5)"


def on_the_way(waypoints, name, objects, step_length=0.05):
    """Samples with an object at places close to each other along a way."""
    samples = []
    for begin, end in pairwise(waypoints):
        count = max(1, round(math.dist(begin, end) / step_length))
        for k in range(count):
            x, y = (a + k / count * (b - a) for a, b in zip(begin, end, strict=True))
            moved = {**objects, name: moved_object(objects[name], x, y)}
            samples.append(sr.Sample(len(samples), moved))
    return samples


def never_violated(samples):
    specification = sr.parse_specification(f"{NEVER}\nspec g = G (cup dist vase >= 0.5)")
    return sr.evaluate(specification, sr.Trace.from_samples(samples)).node("g").verdict == "satisfied"


def first_way(objects, **options):
    settings = replace(TABLE, movable=("cup",), constraint_margin=0.02, **options)
    planner = Planner(sr.parse_specification(NEVER), settings)
    planner.observe(sr.Sample(0, objects))
    return planner.next_step()


def test_an_object_is_carried_around_what_it_must_not_come_near():
    step = first_way(VASE)
    ends = step.target.waypoints[0], step.target.waypoints[-1]
    assert not never_violated(on_the_way(ends, "cup", VASE))
    assert never_violated(on_the_way(step.target.waypoints, "cup", VASE))


def test_an_object_is_carried_over_what_it_must_not_come_near_if_heights_allow():
    raised = {name: replace(each, height=(0.0, 1.0)) for name, each in VASE.items()}
    over = first_way(raised, lift=2.0).target.waypoints
    around = first_way(raised, lift=0.2).target.waypoints
    length = [sum(math.dist(*each) for each in pairwise(way)) for way in (over, around)]
    assert length[0] < length[1]
    lifted = {**raised, "cup": replace(raised["cup"], height=(2.0, 3.0))}
    assert never_violated(on_the_way(over, "cup", lifted))


def test_an_object_is_not_carried_where_no_way_keeps_the_constraints():
    walls = {**VASE, "vase": sr.TrackedObject(sr.Footprint.box(4, -50, 5, 50))}
    step = first_way(walls)
    assert step.kind == "no path"
    assert "on every way there a constraint would hold" in str(step.pruned[0][1])


def test_a_motion_stops_before_the_sample_that_would_violate():
    planner = Planner(sr.parse_specification(NEVER), replace(TABLE, movable=("cup",), constraint_margin=0.02))
    planner.observe(sr.Sample(0, VASE))
    assert planner.next_step().kind == "execute"
    seen = []
    for k, sample in enumerate(on_the_way(((1.0, 3.0), (9.0, 3.0)), "cup", VASE, 0.3)):
        seen.append(sr.Sample(k + 1, sample.objects))
        planner.observe(seen[-1])
        if planner.stop_reason:
            break
    assert never_violated(seen)
    assert "cup dist vase >= 0.5" in planner.stop_reason
    assert centre_of(seen[-1].objects["cup"].footprint)[0] > 3.0
    planner.conclude(sr.Outcome(False, planner.stop_reason))
    assert planner.next_step().kind == "execute"


def program(name):
    """A program of `tools`, as a module; its dataclasses look themselves up among the modules."""
    loader = SourceFileLoader(name, str(Path(__file__).parents[2] / "tools" / name))
    module = module_from_spec(spec_from_loader(name, loader))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, name, module)
        loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def campaign():
    return program("plan_campaign")


@pytest.fixture(scope="module")
def worlds():
    pytest.importorskip("py_trees", reason="py_trees is not installed; it comes with the extra sim")
    return program("plan_worlds")


@pytest.mark.parametrize(
    "kind",
    [
        "joint",
        "blocked",
        "tight",
        "ordered",
        "infeasible",
        "never",
        "ring_apart",
        "pushed_apart",
        "chain",
        "ring",
        "corridor",
        "slot",
    ],
)
def test_scenes_of_the_campaign_end_as_they_should(campaign, kind):
    # others are run by the campaign itself
    task = campaign.KINDS[kind](np.random.default_rng([0, list(campaign.KINDS).index(kind)]))
    assert campaign.is_as_wanted(task, campaign.run(task))


@pytest.mark.parametrize("seed", [9, 21])
def test_a_swap_that_is_always_kept_apart_takes_three_motions(campaign, seed):
    random = np.random.default_rng([seed, list(campaign.KINDS).index("swapped_apart")])
    ended = campaign.run(campaign.KINDS["swapped_apart"](random))
    assert (ended.motions, ended.verdict, ended.violated) == (3, "satisfied", False)


@pytest.mark.parametrize(
    "title",
    [
        "push",
        "pick and place, at once",
        "pick and place, to stay",
    ],
)
def test_the_tasks_of_the_paper_are_satisfied_without_physics(worlds, title):
    name, text = worlds.PAPER[title]
    file = sr.parse_specification(text)
    nothing = worlds.Mishaps(np.random.default_rng(0), failing=0.0, jitter=0.0)
    loop, reason = worlds.run_without_physics(name, 0, file, nothing)
    assert worlds.is_satisfied(file, loop), reason


def test_a_decision_with_many_movable_objects_computes_few_maps(worlds):
    settings, objects = worlds.scene_of("table-setting", 0)
    file = worlds.default_specification("table-setting")
    planner = Planner(file, replace(settings, movable=None))
    planner.observe(sr.Sample(0, objects))
    called = Counter()
    previous = sys.getprofile()
    sys.setprofile(lambda frame, event, _: called.update([frame.f_code.co_name] if event == "call" else ()))
    try:
        step = planner.next_step()
    finally:
        sys.setprofile(previous)
    assert step.kind == "execute"
    assert 0 < called["proposition_maps"] < 100


@pytest.mark.parametrize("name", ["push", "table-setting"])
def test_worlds_are_set_by_a_robot_that_often_fails(worlds, name):
    file = worlds.default_specification(name)
    mishaps = worlds.Mishaps(np.random.default_rng([1, 7]), failing=0.3, jitter=0.03)
    loop, reason = worlds.run_without_physics(name, 1, file, mishaps)
    assert worlds.is_satisfied(file, loop), reason


class Robot(Table):
    """A robot of one's own: it moves things and writes what it sees to the recorder."""

    def look(self):
        sample = sr.Sample(self.time_ns, dict(self.objects))
        self.time_ns += 100_000_000
        self.samples.append(sample)
        self.recorder.write(sample)


@pytest.mark.parametrize("is_attached", [False, True])
def test_a_recorder_is_the_black_box_of_any_robot(tmp_path, is_attached):
    specification = sr.parse_specification(JOINT)
    planner = Planner(specification, TABLE)
    robot = Robot(dict(THINGS), planner)
    options = {"specifications": [specification]} if is_attached else {"planner": planner}
    with sr.Recorder(tmp_path / "run.mcap", **options) as recorder:
        robot.recorder = recorder
        last = sr.plan(planner, robot, recorder)
    assert last.kind == "hold"
    source = open_source(tmp_path / "run.mcap")
    recomputed = recompute_decisions(source)
    assert (recomputed.decisions, recomputed.differences, recomputed.faults) == (3, (), ())
    assert read_decisions(tmp_path / "run.mcap").decisions[0].outcome.succeeded
    assert sr.read_trace(tmp_path / "run.mcap").times_ns[-1] == robot.samples[-1].time_ns


def messages_by_topic(path):
    with path.open("rb") as stream:
        found = {}
        for _, channel, message in make_reader(stream).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
        return found


def test_planning_times_are_sentences_that_no_certificate_covers(tmp_path):
    specification = sr.parse_specification("F (a rightof b)")
    logs = tmp_path / "untimed.mcap", tmp_path / "timed.mcap"
    for log in logs:
        planner = Planner(specification, TABLE)
        robot = Robot(dict(THINGS), planner)
        with sr.Recorder(log, specifications=specification) as recorder:
            robot.recorder = recorder
            sr.plan(planner, robot, recorder, timings=log == logs[1])
    untimed, timed = map(messages_by_topic, logs)
    added = [each for each in timed["/spatial/log"] if each not in untimed["/spatial/log"]]
    decisions = read_decisions(logs[1]).decisions
    assert [time_ns for time_ns, _ in added] == [each.time_ns for each in decisions]
    for each, (_, data) in zip(decisions, added, strict=True):
        assert re.fullmatch(rf"decision {each.number} took \d+\.\d ms", Log.FromString(data).message)
    timed["/spatial/log"] = [each for each in timed["/spatial/log"] if each not in added]
    assert timed == untimed
    # metadata has the certificate, verdicts, settings, and how many messages were recorded
    assert list(open_source(logs[1]).metadata()) == list(open_source(logs[0]).metadata())
    assert sr.verify(logs[1]).differences == ()
    assert recompute_decisions(open_source(logs[1])).differences == ()


def test_planning_times_are_asked_for_where_a_planner_is_attached(tmp_path):
    planner = Planner(sr.parse_specification("F (a rightof b)"), TABLE)
    with (
        sr.Recorder(tmp_path / "run.mcap", planner=planner) as recorder,
        pytest.raises(sr.UsageError, match="leave timings out"),
    ):
        sr.plan(planner, Robot(dict(THINGS), planner), recorder, timings=True)


def test_a_recorder_takes_one_planner_before_its_first_sample(tmp_path):
    specification = sr.parse_specification(JOINT)
    with sr.Recorder(tmp_path / "run.mcap") as recorder:
        with pytest.raises(sr.UsageError, match="has no planner"):
            recorder.next_step()
        with pytest.raises(sr.UsageError, match="planner=planner"):
            recorder.attach(Planner(specification, TABLE))
    with sr.Recorder(tmp_path / "second.mcap", specifications=[specification]) as recorder:
        recorder.write(sr.Sample(0, THINGS))
        with pytest.raises(sr.UsageError, match="before the first one"):
            recorder.attach(Planner(specification, TABLE))
    with pytest.raises(sr.UsageError, match="block=True"):
        sr.Recorder(tmp_path / "third.mcap", planner=Planner(specification, TABLE), block=False)


@pytest.mark.parametrize(("count", "seed"), [(6, 2), (7, 5)])
def test_objects_find_their_places_around_a_plate_that_can_be_moved_too(count, seed):
    random = np.random.default_rng(seed)
    things, places = {}, []
    for name, radius in [("plate", 0.09), *((f"o{number}", 0.03) for number in range(count - 1))]:
        place = random.uniform(0.12, 0.88, 2)
        while any(math.dist(place, before) <= radius + apart + 0.06 for before, apart in places):
            place = random.uniform(0.12, 0.88, 2)
        places.append((place, radius))
        things[name] = sr.TrackedObject(sr.Footprint.disc(*place, radius))
    sides = ("leftof", "rightof", "above", "below")
    goals = (
        f"{name} {sides[number % 4]} plate and {name} dist plate <= 0.25 and {name} dist plate >= 0.04"
        for number, name in enumerate(list(things)[1:])
    )
    workspace = Workspace(Grid.over(0, 0, 1, 1, 0.02), clearance=0.005)
    settings = Settings(workspace, "place", margin=0.01, constraint_margin=0.01)
    steps, _ = run(Planner(sr.parse_specification(f"spec t = F ({' and '.join(goals)})"), settings), things)
    assert steps[-1].kind == "hold", steps[-1].reason
