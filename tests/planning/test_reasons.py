"""Reasons of decisions: what is too large, what was not there, what was not seen, and why not elsewhere."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

import spatial_replay as sr
from planning.kinematics import block
from planning.plans import write_usual_run
from spatial_replay import Planner, Settings
from spatial_replay.cli.application import application
from spatial_replay.planning import (
    Grid,
    Outcome,
    Workspace,
    moved_object,
    read_decisions,
    read_steps,
)
from spatial_replay.planning.decision_log import explained_decision
from spatial_replay.planning.demands import ban_of, bans_of, demand_of, rules_of, wanted_of

AREA = Workspace(Grid.over(0, 0, 1, 1, 0.02))


def planner_for(text, objects, *names, **options):
    planner = Planner(sr.parse_specification(text), Settings(AREA, movable=names, **options))
    planner.observe(sr.Sample(0, objects))
    return planner


def test_an_object_that_is_too_large_for_a_region_is_named_with_the_excess():
    text = "region slot = box(0.4, 0.4, 0.47, 0.6)\nspec s = F (a enclosedin slot)"
    step = planner_for(text, {"a": block(0.2, 0.2, size=0.08)}, "a").next_step()
    assert step.kind == "no path"
    assert "a is 0.01 too large for slot" in str(dict(step.pruned))


def test_an_object_that_was_seen_before_is_named_with_the_time():
    planner = planner_for("F (a leftof b)", {"a": block(0.6, 0.5), "b": block(0.4, 0.5)}, "a")
    planner.observe(sr.Sample(300_000_000, {"a": block(0.6, 0.5), "b": block(0.4, 0.5)}))
    planner.observe(sr.Sample(600_000_000, {"a": block(0.6, 0.5)}))
    step = planner.next_step()
    assert (step.kind, "b has not been seen since 0.300 s" in step.reason) == ("wait", True)


def test_a_motion_whose_object_is_elsewhere_afterwards_is_named_with_its_place():
    planner = planner_for("F (a leftof b)", {"a": block(0.6, 0.5), "b": block(0.4, 0.5)}, "a", attempts=2)
    time_ns = 0
    while (step := planner.next_step()).kind == "execute":
        time_ns += 1
        planner.observe(sr.Sample(time_ns, {"a": block(0.8, 0.2 + time_ns / 10), "b": block(0.4, 0.5)}))
        planner.conclude(Outcome(True))
    assert "moved, but then not at its target: a at (0.8, 0.4)" in step.reason


def test_a_region_with_a_seam_is_named_where_an_object_would_have_to_cross_it():
    region = "region corner = polygon((0.2, 0.2), (0.5, 0.2), (0.5, 0.3), (0.3, 0.3), (0.3, 0.5), (0.2, 0.5))"
    text = f"{region}\nspec s = F (a enclosedin corner)"
    seam = "corner is cut into parts; an object across their seam counts as outside"
    step = planner_for(text, {"a": block(0.7, 0.7, size=0.13)}, "a").next_step()
    assert step.kind == "no path"
    assert seam in step.reason
    assert seam in sr.doctor(sr.parse_specification(text), examples=False).notes
    assert seam not in planner_for(text, {"a": block(0.7, 0.7, size=0.05)}, "a").next_step().reason


@pytest.mark.parametrize(
    ("goal", "options", "rule"),
    [
        ("a leftof b", {"skill": "push"}, "of places that will do, (0.325, 0.575) has the shortest way"),
        ("a leftof b", {"skill": "place"}, "the most robust place is taken, of equal ones the nearest"),
        (
            "a enclosedin slot",
            {"skill": "place", "room": 0.35, "room_from": "all"},
            "of places with room 0.35 around them the most robust is taken",
        ),
        (
            "a leftof c and b rightof d",
            {"skill": "place"},
            "the first arrangement of objects that works is taken, here number 1",
        ),
    ],
)
def test_the_rule_that_chose_a_place_is_in_the_decision(goal, options, rule):
    objects = {
        "a": block(0.6, 0.5),
        "b": block(0.4, 0.5),
        "c": block(0.5, 0.2),
        "d": block(0.5, 0.8),
    }
    area = Workspace(Grid.over(0, 0, 1, 1, 0.05))
    text = f"region slot = box(0.55, 0.5, 0.95, 0.8)\nspec s = F ({goal})"
    planner = Planner(sr.parse_specification(text), Settings(area, movable=("a", "b"), **options))
    planner.observe(sr.Sample(0, objects))
    step = planner.next_step()
    (chosen,) = (
        candidate
        for candidate in explained_decision(step, planner).considered[-1].candidates
        if candidate.chosen
    )
    assert chosen.rule.startswith(rule)


def test_equal_objects_are_taken_by_their_ways_then_by_their_order():
    objects = {"b": block(0.4, 0.5), "a": block(0.6, 0.5)}
    step = planner_for("F (a leftof b)", objects, "a", "b", skill="place").next_step()
    assert step.target.name == "a"
    assert "b could do it with the same robustness" in step.reason
    assert "the same length of way, and comes later in `movable`" in step.reason
    text = "region r = box(0.4, 0.4, 0.6, 0.6)\nspec s = F (a enclosedin r or b enclosedin r)"
    objects = {"a": block(0.1, 0.5), "b": block(0.8, 0.5)}
    step = planner_for(text, objects, "a", "b", skill="place").next_step()
    assert step.target.name == "b"
    assert "a could do it with the same robustness (0.084), and a longer way (0.4, here 0.3)" in step.reason


def test_a_decision_reports_its_attempts_and_what_it_searched(tmp_path):
    """Two blocks change places by parking one, after a motion that failed."""
    regions = "region p = box(0.1, 0.1, 0.3, 0.3)\nregion q = box(0.5, 0.1, 0.7, 0.3)\n"
    text = f"{regions}spec s = F (a enclosedin q and b enclosedin p)"
    objects = {"a": block(0.2, 0.2, size=0.1), "b": block(0.6, 0.2, size=0.1)}
    planner = Planner(sr.parse_specification(text), Settings(AREA, skill="place"))
    log = tmp_path / "run.mcap"
    with sr.Recorder(log, planner=planner) as recorder:
        recorder.write(sr.Sample(0, objects))
        recorder.next_step()
        recorder.write(sr.Sample(1, objects))
        recorder.conclude(Outcome(False, "it slipped", at="pick"))
        step = recorder.next_step()
        recorder.write(sr.Sample(2, objects))
        recorder.conclude(Outcome(False, "it slipped", at="pick"))
    assert step.search.maps > 1.0 and step.search.arrangements >= 1 and step.search.parking_places >= 1
    first, second = read_decisions(log).decisions
    assert [decision.considered[-1].failed for decision in (first, second)] == [0, 1]
    effort = f"attempt 2, {step.search.maps:.4g} maps, "
    assert any(effort in line for line in call("info", log, "--decisions"))
    assert call("info", log, "--decisions", 1)[0].startswith("decision 1 (attempt 2) at ")
    assert effort in call("plan", "--why", log, "--step", 1, "--object", "a", "--at", "0.5,0.5")[0]
    assert read_steps(log)[1].step.search == step.search


def test_an_edge_is_named_with_those_on_paths_as_short():
    regions = "region r = box(0.1, 0.1, 0.3, 0.3)\nregion q = box(0.7, 0.1, 0.9, 0.3)\n"
    text = f"{regions}spec s = (F (a enclosedin r)) and (F (a enclosedin q))"
    aim = planner_for(text, {"a": block(0.5, 0.5)}, "a").next_step().aim
    assert aim.order.endswith(" is as short; the state with the lower number comes first")
    assert aim.order.startswith(f"{aim.edge[0]} -> ") and int(aim.order.split()[2]) > aim.edge[1]


def test_alternatives_of_a_step_are_other_good_places():
    step = planner_for("F (a leftof b)", {"a": block(0.6, 0.5), "b": block(0.4, 0.5)}, "a").next_step()
    first, second, third = step.alternatives(3)
    assert first.robustness >= second.robustness >= third.robustness > 0.0
    assert (first.x, first.y) != (step.target.x, step.target.y)
    planner = Planner(sr.parse_specification("F (a leftof b)"), Settings(AREA))
    planner.observe(
        sr.Sample(0, {"a": moved_object(block(0.6, 0.5), first.x, first.y), "b": block(0.4, 0.5)})
    )
    assert planner.is_accepting


def call(*arguments):
    result = CliRunner().invoke(application, [str(argument) for argument in arguments], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return result.output.splitlines()


def test_one_decision_is_shown_in_five_lines(tmp_path):
    steps = write_usual_run(tmp_path / "run.mcap")
    log = tmp_path / "run.mcap"
    lines = call("info", log, "--decisions", 0)
    assert lines[0] == f"decision 0 at {steps[0].time_ns / 1e9:.3f} s, state 0: {steps[0].reason}"
    gaps = " and ".join(
        f"({pair} >= 0.03)" for pair in ("green dist red", "green dist blue", "red dist blue")
    )
    right = "(green rightof red) and (green rightof blue)"
    assert lines[1] == f"  wanted   red above blue; keep {gaps}; avoid {right}"
    assert lines[2].startswith(
        "  there    robustness 0.03 (0.01 needed); tightest: red above blue, then red dist"
    )
    first, second, third = lines[3].split("; ")
    assert first == "  instead  path 0 -> 3: no object can do it"
    assert second.startswith("blue to (")
    assert third.startswith("green: no place is good enough: ")
    assert third.endswith(" needed, and the best place is limited by red above blue")
    assert lines[4].startswith("  done at ")
    whole = call("info", log, "--decisions")
    assert whole[0] == "run.mcap: 3 decisions for 'push', 2 motions"
    assert whole[-1] == "given up: 0 -> 3: no object can do it"
    with pytest.raises(sr.UsageError, match="has no decision 9; it has 0 to"):
        call("info", tmp_path / "run.mcap", "--decisions", 9)
    with pytest.raises(sr.UsageError, match="takes the number of a decision"):
        call("info", "--decisions", tmp_path / "run.mcap")


def test_a_place_that_was_not_chosen_is_explained_by_the_demands_that_fail_there(tmp_path):
    log = tmp_path / "run.mcap"
    write_usual_run(log)
    lines = call("plan", "--why", log, "--step", 0, "--object", "red", "--at", "0.6,0.15")
    number, demand = lines[1].split(maxsplit=1)
    assert float(number) < 0.0
    assert demand == "keep red dist blue >= 0.03: not met"
    assert any(line.endswith("  one of several: avoid green rightof red: met") for line in lines)
    assert any(
        line.startswith("  blocked: on the way, keep red dist blue >= 0.03: short by ") for line in lines
    )
    assert any(line.startswith("  blocked: blue stands there: they overlap by ") for line in lines)
    assert not [line for line in lines if "not (" in line]
    assert lines[-2].startswith("  chosen instead: (")
    assert lines[-1].startswith("  rule: of places that will do, (")
    *_, last = call("plan", "--why", log, "--step", 0, "--object", "blue", "--at", "0.5,-0.05")
    assert last.startswith("  possible instead: (")
    for arguments, error in {
        ("--object", "pink", "--at", "0.6,0.15"): "did not consider 'pink'; it considered: blue, green, red",
        ("--object", "red", "--at", "9,9"): r"outside the map of red; the middles of its cells are from \(",
        ("--object", "red", "--at", "here"): "give two numbers",
        ("--object", "red"): "give --step N, --object NAME and --at X,Y",
    }.items():
        with pytest.raises(sr.UsageError, match=error):
            call("plan", "--why", log, "--step", 0, *arguments)


def test_detours_after_failures_do_not_end_a_run_that_goes_on(tmp_path):
    """Six objects are sorted by a robot that drops every third one beside its way."""
    names = [f"o{number}" for number in range(6)]
    objects = {name: block(0.1 + 0.15 * number, 0.2, size=0.05) for number, name in enumerate(names)}
    goal = " and ".join(
        f"{left} leftof {right}" for left, right in zip(names[::-1], names[-2::-1], strict=False)
    )
    planner = planner_for(f"F ({goal})", objects, *names, skill="place", margin=0.005)
    time_ns = count = 0
    while (step := planner.next_step()).kind == "execute":
        count += 1
        slips = count % 3 == 0
        target, time_ns = step.target, time_ns + 1
        x, y = target.waypoints[0] if slips else (target.x, target.y)
        objects = {**objects, target.name: moved_object(objects[target.name], x, y + 0.1 * slips)}
        planner.observe(sr.Sample(time_ns, objects))
        planner.conclude(Outcome(not slips, "it slipped" if slips else ""))
    assert step.kind == "hold", step.reason


def test_constraints_are_said_as_what_to_keep_and_what_to_avoid():
    bans = bans_of(["not (a dist b >= 1)", "(x and y) and not c", "d", "not e", "f and g", "not h and not i"])
    assert rules_of(bans) == (
        "keep `a dist b >= 1` and `e`",
        "avoid `d`",
        "`x and y` not before `c`",
        "avoid `f` together with `g`",
        "keep `h` or `i`",
    )
    rules = [ban_of(guard, bans).rule for guard in ("d and not z", "(x and y) and not c")]
    assert rules == ["avoid `d`", "`x and y` not before `c`"]
    way = bans_of(["not ((a dist b >= 1) and e)", "not h and not i"])
    demands = [demand_of(literal, way) for literal in ("k", "h", "e", "a dist b >= 1", "not (f and g)")]
    assert demands == ["`k`", "`h`", "keep `e`", "keep `a dist b >= 1`", "avoid `f and g`"]
    assert demand_of("not f", way, is_required=False) == "one of several: avoid `f`"
    wanted = wanted_of(["k and e and not c and not d", "not k and e and not m"], bans)
    assert wanted == ("`k` and `c` no longer", "`k` no longer and `m` no longer")


def test_names_in_quotes_are_not_taken_apart():
    bans = bans_of(['"salt and pepper" leftof "cup (old)" and not ("a) and (b" ovlp cup)'])
    assert rules_of(bans) == ('`"salt and pepper" leftof "cup (old)"` not before `"a) and (b" ovlp cup`',)
    # in quotes, a backslash stands for itself only if it is doubled
    bans = bans_of([r'"C:\\" ovlp cup and not "a \" and b" ovlp cup'])
    assert rules_of(bans) == (r'`"C:\\" ovlp cup` not before `"a \" and b" ovlp cup`',)
