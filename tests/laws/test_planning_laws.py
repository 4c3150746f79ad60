"""What must hold for every gradient map and every planner."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from itertools import count, pairwise, product

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from spatial_replay import Planner, Settings
from spatial_replay.geometry.footprint import centre_of
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanDecision
from spatial_replay.logs.topics import GRADIENT_MAP, PLAN_DECISION
from spatial_replay.planning import Grid, Outcome, Workspace, moved_object
from spatial_replay.planning.decision_log import BlackBox, map_fields
from spatial_replay.planning.demands import bans_of
from spatial_replay.planning.edges import MOST_MOTIONS
from spatial_replay.planning.maps import proposition_maps

TEXTS = (
    "a leftof b",
    "a dist b >= 1.5",
    "a enclosedin b and not (a ovlp c)",
    "a closer b than c",
    "a oriented[0.5] b",
    "b touch[1] c",
    "a enclosedin here or a between[x] (b, c)",
    "a prec[z] b",
    "forall x in all: x dist b <= 4",
    "a moved[2] c",
    "load >= 1 -> a above b",
)
REGION = "region here = circle((3, 3), 2)\n"


@st.composite
def bodies(draw):
    x, y = draw(st.floats(-5, 5)), draw(st.floats(-5, 5))
    width, length = draw(st.floats(0.1, 3)), draw(st.floats(0.1, 3))
    shape = draw(
        st.sampled_from(
            [
                sr.Footprint.box(0, 0, width, length),
                sr.Footprint.disc(0, 0, width),
                sr.Footprint.capsule((0, 0), (width, length), 0.5),
                sr.Footprint.polygon([(0, 0), (3, 0), (3, 1), (1, 1), (1, length + 1), (0, length + 1)]),
            ]
        )
    )
    height = draw(st.sampled_from([None, (0.0, 1.0), (0.5, 2.0)]))
    yaw = draw(st.one_of(st.none(), st.floats(-3, 3)))
    uncertainty = draw(st.sampled_from([0.0, 0.0, 0.2]))
    body = sr.TrackedObject(shape, yaw=yaw, height=height, uncertainty=uncertainty)
    return moved_object(body, x, y, draw(st.floats(-3, 3)))


@st.composite
def scenes(draw):
    names = draw(st.sampled_from([("a", "b", "c"), ("a", "b", "c", "d"), ("a", "c")]))
    signals = draw(st.sampled_from([{}, {"load": 2.0}]))
    return sr.Sample(5, {name: draw(bodies()) for name in names}, signals)


@given(scenes(), st.sampled_from(TEXTS), st.sampled_from([(), (0.5,), (-1.0, 2.0)]), st.data())
@examples(60)
def test_a_cell_is_the_robustness_of_the_sample_with_the_object_moved_there(sample, text, yaws, data):
    specification = sr.parse_specification(f"{REGION}spec s = {text}")
    workspace = Workspace(Grid(-4.0, -4.0, 1.7, 5, 4), yaws)
    maps = proposition_maps([specification.specs[0].formula], specification.regions, sample, "a", workspace)
    turn, row, column = (data.draw(st.integers(0, size - 1)) for size in maps.lower.shape[1:])
    x, y = workspace.grid.centre(row, column)
    there = moved_object(sample.objects["a"], x, y, float(maps.turns[turn]))
    monitor = sr.Monitor(specification)
    node = monitor.update(sr.Sample(5, {**sample.objects, "a": there}, sample.signals)).node("s")
    low, high = maps.lower[0, turn, row, column], maps.upper[0, turn, row, column]
    if math.isnan(node.now):
        assert low != high
    else:
        assert low == high
        assert np.isclose(low, node.now, rtol=1e-12, atol=1e-12)


@given(
    scenes(),
    st.sampled_from([*TEXTS, "forall x, y in all: x dist y >= 0.5"]),
    st.sampled_from([(), (0.5,), (-1.0, 2.0)]),
    st.booleans(),
)
@examples(30)
def test_many_cells_have_the_bits_that_few_have(sample, text, yaws, is_obstructed):
    # 4,480 cells are measured in three tiles, a quarter of them in one; corners of cells are exact numbers
    specification = sr.parse_specification(f"{REGION}spec s = {text}")
    obstacles = (sr.Footprint.disc(1.0, 2.0, 0.5), sr.Footprint.box(-3, -3, -2, 1)) if is_obstructed else ()

    def maps(grid):
        workspace = Workspace(grid, yaws, obstacles=obstacles)
        return proposition_maps(
            [specification.specs[0].formula], specification.regions, sample, "a", workspace
        )

    whole = maps(Grid(-8.0, -8.0, 0.25, 70, 64))
    quarters = [maps(Grid(-8.0, -8.0 + 4.0 * number, 0.25, 70, 16)) for number in range(4)]
    for name in ("lower", "upper", "distances", "clearance"):
        joined = np.concatenate([getattr(each, name) for each in quarters], axis=-2)
        assert getattr(whole, name).tobytes() == joined.tobytes()


@given(bodies(), st.floats(-9, 9), st.floats(-9, 9), st.floats(-7, 7))
def test_a_moved_object_is_where_it_was_moved_to(body, x, y, turn):
    moved = moved_object(body, x, y, turn)
    assert np.allclose(centre_of(moved.footprint), (x, y), atol=1e-9)
    if body.yaw is not None:
        assert moved.yaw == body.yaw + turn


# ------------------------------------------------------------------------------------------ planners

THINGS = ("a", "b", "c")
GOALS = (
    "{0} leftof {1}",
    "{0} above {1}",
    "{0} dist {1} >= 3",
    "{0} dist {1} <= 1",
    "{0} enclosedin here",
    "not ({0} closeto[2] {1})",
    "{0} leftof {1} and {0} rightof {1}",
    "{0} dist unseen <= 1",
)
TASKS = (
    "F ({0})",
    "G ({0})",
    "(not ({0})) U ({1})",
    "F ({0} and X ({1}))",
    "G (({0}) -> F ({1}))",
    "F[0,3] ({0})",
    "F[2,5] ({0})",
    "X X F ({0})",
    "(G[0,2] ({0})) and F ({1})",
)


@st.composite
def tasks(draw):
    """Specifications with an automaton, many of which cannot be satisfied."""

    def goal():
        first, second = draw(st.permutations(THINGS))[:2]
        return draw(st.sampled_from(GOALS)).format(first, second)

    tasks = draw(st.lists(st.sampled_from(TASKS), min_size=1, max_size=3))
    parts = [f"({task.format(goal(), goal())})" for task in tasks]
    return sr.parse_specification(f"region here = circle((3, 3), 2)\nspec s = {' and '.join(parts)}")


@st.composite
def settings_of_planners(draw):
    workspace = Workspace(
        Grid(-6.0, -6.0, 1.0, 12, 12),
        nearest=draw(st.sampled_from([0.0, 2.0])),
        clearance=draw(st.sampled_from([0.0, 0.5])),
    )
    return Settings(
        workspace,
        draw(st.sampled_from(["push", "place"])),
        movable=draw(st.sampled_from([None, ("a",), ("a", "b"), ()])),
        margin=draw(st.sampled_from([0.0, 0.3])),
        constraint_margin=draw(st.sampled_from([0.0, 0.3])),
        attempts=draw(st.integers(1, 2)),
    )


@given(tasks(), settings_of_planners(), st.integers(0, 2**32 - 1))
@examples(60)
def test_a_planner_terminates_with_a_reason_for_each_pruned_edge(specification, options, seed):
    random = np.random.default_rng(seed)
    planner = Planner(specification, options)
    places = random.uniform(-5, 5, (len(THINGS), 2))
    shape = sr.TrackedObject(sr.Footprint.box(0, 0, 1, 1))
    scene = {name: moved_object(shape, *place) for name, place in zip(THINGS, places, strict=True)}
    planner.observe(sr.Sample(0, scene))
    motions, waits = 0, set()
    for time_ns in count(1):
        step = planner.next_step()
        if step.kind == "execute":
            # now and then an object ends up anywhere
            name, succeeds = step.target.name, random.random() < 0.7
            x, y = (step.target.x, step.target.y) if succeeds else random.uniform(-5, 5, 2)
            scene = {**scene, name: moved_object(scene[name], x, y)}
            assert name in (options.movable or THINGS)
            planner.observe(sr.Sample(time_ns, scene))
            planner.conclude(Outcome(succeeds))
            motions += 1
        elif step.ahead:
            planner.observe(sr.Sample(time_ns, scene))
            waits.add(step.number)
        else:
            break
    edges = len(planner.automaton.transitions)
    assert motions <= MOST_MOTIONS * edges
    assert len(waits) <= (motions + 1) * edges
    assert step.kind != "execute"
    assert planner.is_accepting or step.kind != "hold" or len(planner.states) > 1
    if step.kind == "no path":
        assert step.reason.startswith("no path left")
        assert all(reason.kind for _, reason in step.pruned)


@given(st.data(), settings_of_planners(), st.integers(0, 2**32 - 1))
@examples(15)
def test_no_cell_that_would_do_is_better_than_the_target_by_the_rule_in_the_log(data, options, seed):
    options = replace(options, room=data.draw(st.sampled_from([0.0, 1.5])))
    random = np.random.default_rng(seed)
    written = []
    box = BlackBox(Planner(data.draw(st.one_of(easy_tasks(), tasks())), options), written.append)
    shape = sr.TrackedObject(sr.Footprint.box(0, 0, 1, 1))
    scene = {name: moved_object(shape, *random.uniform(-5, 5, 2)) for name in THINGS}
    for time_ns in range(4):
        box.observe(sr.Sample(time_ns, scene))
        if time_ns:
            box.conclude(Outcome(succeeded=False, reason="it slipped"))
        step = box.next_step()
        if step.kind != "execute":
            return
        rows = [(topic, row.payload) for m in written for topic, row in zip(m.topics, m.rows(), strict=True)]
        decision = [PlanDecision.FromString(payload) for topic, payload in rows if topic == PLAN_DECISION][-1]
        grids = [GridMessage.FromString(payload) for topic, payload in rows if topic == GRADIENT_MAP]
        (chosen,) = [each for each in decision.considered[-1].candidates if each.chosen]
        check_rule(chosen, [map_fields(grids[each.number]) for each in chosen.maps], decision, options)


def check_rule(chosen, maps, decision, options):
    """Check that no cell of the maps of the chosen object is better than its target."""
    fields, target = maps[0], chosen.target
    would_do = (fields["blocked_by"] == 0) & (fields["robustness"] >= options.margin)
    if decision.considered[-1].joint:
        assert re.match("it goes aside|the places that an earlier|the first arrangement", chosen.rule)
    elif options.skill == "push":
        # the shortest way leads to the target, or to a cell near it
        least = chosen.least_way
        assert np.nanmin(fields["way"][would_do]) == pytest.approx(least)
        ends = would_do & (fields["way"] <= least * (1.0 + 1e-6))
        x, y = np.meshgrid(np.arange(-5.5, 6.0), np.arange(-5.5, 6.0))
        assert (ends & (abs(x - target.x) <= 2.0) & (abs(y - target.y) <= 2.0)).any()
        assert f"{least:.4g}" in chosen.rule
    else:
        roomy = (
            would_do & (fields["room"] >= chosen.least_room) if chosen.HasField("least_room") else would_do
        )
        better = roomy & (fields["robustness"] > target.robustness + 1e-6)
        assert not better.any()
        assert chosen.HasField("least_room") == ("of places with room" in chosen.rule)


@st.composite
def easy_tasks(draw):
    """Specifications of one goal, which most scenes leave to be done and allow."""
    names = draw(st.permutations(THINGS))
    return sr.parse_specification(f"{REGION}spec s = F ({draw(st.sampled_from(GOALS[:6])).format(*names)})")


@given(st.one_of(easy_tasks(), tasks()), settings_of_planners(), st.integers(0, 2**32 - 1))
@examples(60)
def test_a_target_is_free_and_has_the_robustness_that_it_states(specification, options, seed):
    random = np.random.default_rng(seed)
    shape = sr.TrackedObject(sr.Footprint.box(0, 0, 1, 1))
    scene = {name: moved_object(shape, *random.uniform(-5, 5, 2)) for name in THINGS}
    planner, coarse = Planner(specification, options), Planner(specification, replace(options, refine=False))
    planner.observe(sr.Sample(0, scene))
    coarse.observe(sr.Sample(0, scene))
    step, plain = planner.next_step(), coarse.next_step()
    if step.target is None:
        return
    aim, target = step.considered[-1], step.target
    motions = aim.motions if aim.is_joint else (target,)
    assert motions[0] == target
    if not aim.is_joint:
        # a refined target lies near the one in the middle of a cell, and has at least as much
        middles = [each.target for each in plain.candidates if each.name == target.name]
        if plain.considered and plain.considered[-1].edge == aim.edge and middles and middles[0] is not None:
            assert target.robustness >= middles[0].robustness
            assert max(abs(target.x - middles[0].x), abs(target.y - middles[0].y)) <= 2.0 + 1e-9
        if options.skill == "place":
            (chosen,) = [each for each in step.candidates if each.is_chosen]
            assert target.robustness >= np.nanmax(chosen.map.values)
    is_parked = any(each.name == target.name for each in motions[1:])
    assert is_parked or target.robustness >= options.margin
    assert math.dist((target.x, target.y), (0.0, 0.0)) >= options.workspace.nearest
    assert target.waypoints[-1] == (target.x, target.y)
    # it is how well the edge's progress holds with the object there, and the others where they are to go
    progress = sr.Monitor(sr.parse_specification(f"{REGION}spec s = {aim.progress}"))
    placed, stated = scene, []
    for time_ns, each in enumerate(each for each in motions if each == target or each.name != target.name):
        placed = {**placed, each.name: moved_object(placed[each.name], each.x, each.y)}
        stated.append(progress.update(sr.Sample(time_ns, placed)).node("s").now)
    assert any(np.isclose(target.robustness, each, rtol=1e-12, atol=1e-12) for each in stated)
    # and the automaton takes the edge once all of them are there
    visited = []
    for time_ns, each in enumerate(motions, 1):
        scene = {**scene, each.name: moved_object(scene[each.name], each.x, each.y)}
        others = [name for name in THINGS if name != each.name]
        apart = " and ".join(f"{each.name} dist {name} >= 0" for name in others)
        room = sr.Monitor(sr.parse_specification(apart)).update(sr.Sample(0, scene)).node("spec").now
        assert room > options.workspace.clearance
        planner.observe(sr.Sample(time_ns, scene))
        visited.append(planner.states)
    if options.margin > 0.0:
        assert (aim.edge[1],) in visited


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(["F", "F[0,1]", "F[0,40]", "F[3,40]", "X X F"]),
    st.sampled_from(["a leftof b", "a dist c <= 1", "a above b and a above c"]),
)
@examples(60)
def test_a_pushed_object_touches_nothing_whatever_the_deadline(seed, when, goal):
    random = np.random.default_rng(seed)
    workspace = Workspace(Grid(-6.0, -6.0, 0.5, 24, 24), farthest=7.0, clearance=0.25)
    shape = sr.TrackedObject(sr.Footprint.box(0, 0, 1, 1))
    scene = {name: moved_object(shape, *random.uniform(-5, 5, 2)) for name in ("b", "c")}
    scene["a"] = moved_object(shape, *random.uniform(-10, 10, 2))
    specification = sr.parse_specification(f"{when} ({goal})")
    planner = Planner(specification, Settings(workspace, "push", movable=("a",)))
    planner.observe(sr.Sample(0, scene))
    step, times_ns = planner.next_step(), count(1)
    while step.kind == "wait":
        planner.observe(sr.Sample(next(times_ns), scene))
        step = planner.next_step()
    if step.target is None:
        return
    clear = sr.Monitor(sr.parse_specification("a dist b > 0.25 and a dist c > 0.25"))
    turns = [np.array(point) for point in step.target.waypoints[1:]]
    cells = [
        begin + share * (end - begin)
        for begin, end in pairwise([*turns[:1], *turns])
        for share in np.linspace(0.0, 1.0, 1 + round(2 * float(abs(end - begin).max())))
    ]
    for time_ns, place in enumerate(cells):
        there = sr.Sample(time_ns, {**scene, "a": moved_object(shape, *place)})
        assert clear.update(there).node("spec").now > 0.0


CUBES = st.lists(st.dictionaries(st.sampled_from("abcde"), st.booleans(), min_size=1), max_size=6)


def text_of(cube: dict[str, bool]) -> str:
    return " and ".join(name if value else f"not {name}" for name, value in cube.items())


ROWS = [dict(zip("abcde", values, strict=True)) for values in product([False, True], repeat=5)]


@given(CUBES, CUBES)
@examples(40)
def test_bans_forbid_the_constraint_set_and_at_most_guards_that_were_given_up(guards, given_up):
    def is_any(cubes, row):
        return any(all(row[name] is value for name, value in cube.items()) for cube in cubes)

    bans = bans_of([text_of(cube) for cube in guards], [text_of(cube) for cube in given_up])
    cubes = [dict.fromkeys(ban.holding, True) | dict.fromkeys(ban.failing, False) for ban in bans]
    for row in ROWS:
        assert is_any(guards, row) <= is_any(cubes, row) <= is_any([*guards, *given_up], row)
    for cube in cubes:
        for name in cube:
            # without the literal it would forbid more
            shorter = {rest: value for rest, value in cube.items() if rest != name}
            assert any(is_any([shorter], row) > is_any([*guards, *given_up], row) for row in ROWS)
