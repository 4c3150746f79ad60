"""What maps in a log say of each cell, against shapely, which knows nothing of this package."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from shapely import affinity
from shapely.geometry import Point, box

import spatial_replay as sr
from planning.kinematics import block
from planning.plans import record_plan_of
from spatial_replay import Settings
from spatial_replay.logs.schemas.PlanDecision_pb2 import PlanCause
from spatial_replay.logs.topics import GRADIENT_MAP, MAP_DRAWING
from spatial_replay.planning import Grid, Workspace, read_decisions, recompute_decisions
from spatial_replay.planning.decision_log import map_fields
from spatial_replay.sources import open_source

SPEC = """
spec tidy = (F (cup leftof jug and cup dist jug <= 0.6 and cup dist plate >= 0.5)) and G (cup dist pan >= 0.4)
"""
SIZE = 0.6
PLACES = {"cup": (3.0, 1.0), "jug": (2.4, 2.6), "plate": (1.1, 0.9), "pan": (0.6, 3.2)}
OBJECTS = {name: block(*place, size=SIZE) for name, place in PLACES.items()}
TIDYING = Settings(
    Workspace(Grid.over(0, 0, 4, 4, 0.1), yaws=(0.0, math.pi / 4), clearance=0.05),
    movable=("cup",),
    margin=0.05,
    constraint_margin=0.1,
    room=0.4,
    room_from="all",
    refine=False,
    lift=None,
)
SHAPES = {
    name: box(x - SIZE / 2, y - SIZE / 2, x + SIZE / 2, y + SIZE / 2) for name, (x, y) in PLACES.items()
}


def messages(path):
    found = (each for batch, _ in open_source(path).iter_payloads(GRADIENT_MAP) for each in batch)
    return [GridMessage.FromString(payload) for payload in found]


def cup_at(message, row, column, turn):
    x = message.pose.position.x + (column + 0.5) * message.cell_size.x
    y = message.pose.position.y + (row + 0.5) * message.cell_size.y
    return affinity.translate(affinity.rotate(box(-0.3, -0.3, 0.3, 0.3), turn, use_radians=True), x, y)


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    path = tmp_path_factory.mktemp("layers") / "run.mcap"
    record_plan_of(path, SPEC, OBJECTS, TIDYING)
    return path, read_decisions(path).decisions, messages(path)


def test_every_layer_of_every_cell_is_what_shapely_measures(logged):
    _, (first, *_), maps = logged
    (candidate,) = first.considered[-1].candidates
    jug, plate, pan = (SHAPES[name] for name in ("jug", "plate", "pan"))
    assert {each.text for each in candidate.conjuncts} >= {"cup leftof jug", "cup dist plate >= 0.5"}
    names = [f"{number}: {each.text}" for number, each in enumerate(candidate.conjuncts, 1)]
    for named in candidate.maps:
        message = maps[named.number]
        fields = map_fields(message)
        layers = np.array([fields[name] for name in names])
        free = fields["blocked_by"] == 0
        np.testing.assert_array_equal(np.isnan(fields["robustness"]), ~free)
        np.testing.assert_array_equal(fields["robustness"][free], layers.min(axis=0)[free])
        limiting = np.take_along_axis(layers, fields["limited_by"][None].astype(int) - 1, axis=0)[0]
        np.testing.assert_array_equal(limiting, layers.min(axis=0))
        for row, column in np.ndindex(free.shape):
            cup = cup_at(message, row, column, named.turn)
            expected = {
                "cup leftof jug": jug.bounds[0] - cup.bounds[2],
                "cup dist jug <= 0.6": 0.6 - cup.distance(jug),
                "cup dist plate >= 0.5": cup.distance(plate) - 0.5,
                "cup dist pan >= 0.4": cup.distance(pan) - 0.4,
            }
            for name in names:
                text = name.partition(": ")[2]
                # distances of shapes that overlap are negative here, and 0 in shapely
                if "dist" not in text or not cup.intersects(SHAPES[text.split()[2]]):
                    assert fields[name][row, column] == pytest.approx(expected[text], abs=1e-6)
            near = {other: cup.distance(SHAPES[other]) for other in ("jug", "plate", "pan")}
            if min(near.values()) > 0.0:
                assert fields["clearance"][row, column] == pytest.approx(min(near.values()), abs=1e-6)
            if free[row, column]:
                assert min(near.values()) > 0.05 - 1e-9
                assert near["pan"] > 0.4 + 0.1 - 1e-9
                continue
            cause = candidate.causes[fields["blocked_by"][row, column] - 1]
            if cause.kind == cause.KIND_OBJECT:
                assert near[cause.text] <= 0.05 + 1e-9
                assert near[cause.text] == min(near.values())
            else:
                assert (cause.kind, cause.text) == (cause.KIND_CONSTRAINT, "not (cup dist pan >= 0.4)")
                assert near["pan"] <= 0.4 + 0.1 + 1e-9


def test_counts_in_a_decision_are_those_of_its_maps(logged):
    _, (first, *_), maps = logged
    (candidate,) = first.considered[-1].candidates
    fields = [map_fields(maps[each.number]) for each in candidate.maps]
    blocked = np.array([each["blocked_by"] for each in fields])
    limited = np.array([each["limited_by"] for each in fields])[blocked == 0]
    assert [each.cells for each in candidate.causes] == [
        int((blocked == number).sum()) for number in range(1, len(candidate.causes) + 1)
    ]
    assert [each.limits for each in candidate.conjuncts] == [
        int((limited == number).sum()) for number in range(1, len(candidate.conjuncts) + 1)
    ]


def test_the_choice_and_what_its_room_costs_follow_from_the_logged_maps(logged):
    _, (first, *_), maps = logged
    (candidate,) = first.considered[-1].candidates
    fields = {each.turn: map_fields(maps[each.number]) for each in candidate.maps}
    best = {
        is_roomy: max(
            float(np.where((each["blocked_by"] == 0) & roomy, each["robustness"], -np.inf).max())
            for each in fields.values()
            for roomy in [(each["room"] >= 0.4) | (not is_roomy)]
        )
        for is_roomy in (True, False)
    }
    assert first.target.robustness >= best[True] - 1e-6
    assert candidate.room.wanted == 0.4
    assert candidate.room.possible == pytest.approx(best[False], abs=1e-6)
    assert candidate.room.possible > first.target.robustness
    assert candidate.room.clearance < 0.4
    least = min(each.at_target for each in candidate.conjuncts)
    assert least == pytest.approx(first.target.robustness, abs=0.1)


def test_cells_near_a_failed_motion_are_named(tmp_path):
    record_plan_of(tmp_path / "run.mcap", SPEC, OBJECTS, TIDYING, slips=1)
    first, second, *_ = read_decisions(tmp_path / "run.mcap").decisions
    maps = messages(tmp_path / "run.mcap")
    (candidate,) = second.considered[-1].candidates
    number = [each.kind for each in candidate.causes].index(candidate.causes[0].KIND_FAILED) + 1
    for named in candidate.maps:
        message = maps[named.number]
        avoided = map_fields(message)["blocked_by"] == number
        for row, column in np.ndindex(avoided.shape):
            centre = cup_at(message, row, column, 0.0).centroid
            if avoided[row, column]:
                assert centre.distance(Point(first.target.x, first.target.y)) <= 0.2 + 1e-9
    assert candidate.causes[number - 1].cells > 1
    assert recompute_decisions(open_source(tmp_path / "run.mcap")).differences == ()


def test_a_lost_specification_is_named_with_its_time(tmp_path):
    text = "spec calm = (F cup leftof jug) and G (cup dist plate >= 0.3)"
    objects = {**OBJECTS, "cup": block(1.1, 1.7, size=SIZE)}
    record_plan_of(tmp_path / "run.mcap", text, objects, TIDYING)
    (decision,) = read_decisions(tmp_path / "run.mcap").decisions
    assert decision.kind == decision.KIND_NO_PATH
    assert decision.lost.time_ns == 0
    assert decision.lost.text == "not (cup dist plate >= 0.3)"


def test_while_a_specification_can_be_satisfied_nothing_is_lost(logged):
    _, decisions, _ = logged
    assert not any(each.HasField("lost") for each in decisions)


def test_obstacles_are_drawn_and_an_object_within_one_is_named_first(tmp_path):
    around_jug, far = box(1.9, 0.2, 3.8, 3.8), box(0.2, 1.8, 1.0, 2.4)
    rings = [shape.exterior.coords[:-1] for shape in (around_jug, far)]
    workspace = Workspace(
        Grid.over(0, 0, 4, 4, 0.2), obstacles=tuple(sr.Footprint.polygon(list(ring)) for ring in rings)
    )
    record_plan_of(tmp_path / "run.mcap", SPEC, OBJECTS, replace(TIDYING, workspace=workspace))
    source = open_source(tmp_path / "run.mcap")
    drawing = next(payload for batch, _ in source.iter_payloads(MAP_DRAWING) for payload in batch)
    entities = {entity.id: entity for entity in SceneUpdate.FromString(drawing).entities}
    assert set(entities) == {"plan/map", "plan/obstacle/obstacle 0", "plan/obstacle/obstacle 1"}
    (outline,) = entities["plan/obstacle/obstacle 1"].lines
    assert {(point.x, point.y) for point in outline.points} == set(rings[1])
    (candidate,) = read_decisions(tmp_path / "run.mcap").decisions[0].considered[-1].candidates
    (message,) = (messages(tmp_path / "run.mcap")[named.number] for named in candidate.maps)
    row, column = (int(place / 0.2 - 0.5) for place in reversed(PLACES["jug"]))
    blocked_by = map_fields(message)["blocked_by"]
    (area, *_) = entities["plan/map"].triangles
    corners = np.array([(point.x, point.y) for point in area.points]).reshape(-1, 4, 2)
    assert np.ptp(corners, axis=1).prod(axis=1).sum() == pytest.approx((blocked_by > 0).sum() * 0.2**2)
    cause = candidate.causes[blocked_by[row, column] - 1]
    assert (cause.kind, cause.text) == (PlanCause.KIND_OBJECT, "jug")
