from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

import spatial_replay as sr
from planning.kinematics import BLOCKS, block
from planning.plans import PUSH, record_plan_of
from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.messages.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.source import open_source
from spatial_replay.logs.topics import GRADIENT_MAP, PLAN_PATH
from spatial_replay.planning.redo import redo_decisions
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.settings_text import settings_from_text, text_from_settings
from spatial_replay.planning.told import read_decisions
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.replay import run_replay
from spatial_replay.replay.verification import verify_certificate
from spatial_replay.spec import load_specification


def payloads(path, topic, kind):
    found = (each for batch, _ in open_source(path).iter_payloads(topic) for each in batch)
    return [kind.FromString(each) for each in found]


def test_decisions_are_told_with_their_outcomes(tmp_path):
    steps = record_plan_of(tmp_path / "run.mcap", slips=1)
    told = read_decisions(tmp_path / "run.mcap").decisions
    assert [each.number for each in told] == list(range(len(steps)))
    assert [each.outcome.succeeded for each in told[:-1]] == [False, *[True] * (len(steps) - 2)]
    assert told[0].outcome.reason == "it slipped"
    assert not told[-1].HasField("outcome")
    assert told[-1].kind == told[-1].KIND_HOLD
    assert told[0].considered[0].pruned == steps[0].considered[0].pruned
    assert [each.object for each in told[0].considered[1].candidates] == ["blue", "green", "red"]


def test_decisions_made_again_are_the_same(tmp_path):
    steps = record_plan_of(tmp_path / "run.mcap", slips=1)
    redone = redo_decisions(open_source(tmp_path / "run.mcap"))
    assert redone.differences == ()
    assert redone.decisions == len(steps)
    assert redone.maps == sum(len(each.candidates) for step in steps for each in step.considered)


def test_equal_runs_give_equal_logs(tmp_path):
    for name in ("one.mcap", "two.mcap"):
        record_plan_of(tmp_path / name)
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()


def test_other_settings_make_other_decisions(tmp_path):
    record_plan_of(tmp_path / "run.mcap", told=replace(PUSH, margin=0.03))
    (first, *_) = redo_decisions(open_source(tmp_path / "run.mcap")).differences
    assert "/plan/decision differs in" in first
    assert "of decision 0" in first


def test_a_sample_that_was_changed_shows(tmp_path):
    def seen_as(sample):
        return sr.Sample(sample.time_ns, {**sample.objects, "red": block(0.5, -0.0500001, math.pi / 4)})

    record_plan_of(tmp_path / "run.mcap", seen_as=seen_as)
    assert redo_decisions(open_source(tmp_path / "run.mcap")).differences


def test_a_replay_keeps_what_was_decided(tmp_path):
    record_plan_of(tmp_path / "run.mcap")
    (tmp_path / "edited.spatial").write_text("use spatial_spec\nF (red above blue)\n")
    edited = load_specification(tmp_path / "edited.spatial")
    run_replay(open_source(tmp_path / "run.mcap"), [edited], output=tmp_path / "annotated.mcap")
    assert redo_decisions(open_source(tmp_path / "annotated.mcap")).differences == ()


def test_certificates_count_what_was_decided(tmp_path):
    record_plan_of(tmp_path / "run.mcap")
    verified = verify_certificate(open_source(tmp_path / "run.mcap"))
    assert verified.recorded
    assert verified.differences == ()


def test_maps_lie_over_the_scene(tmp_path):
    steps = record_plan_of(tmp_path / "run.mcap")
    messages = payloads(tmp_path / "run.mcap", GRADIENT_MAP, GridMessage)
    assert len(messages) == sum(len(step.candidates) for step in steps)
    chosen = messages[len(steps[0].candidates) - 1]
    values = np.frombuffer(chosen.data, "<f4").reshape(-1, chosen.column_count)
    target, grid = steps[0].target, PUSH.workspace.grid
    column = math.floor((target.x - chosen.pose.position.x) / chosen.cell_size.x)
    row = math.floor((target.y - chosen.pose.position.y) / chosen.cell_size.y)
    assert values.shape == grid.shape
    assert values[row, column] == np.float32(target.robustness)
    assert np.isnan(values).any()


def test_a_path_is_drawn_and_then_the_way_that_was_travelled(tmp_path):
    steps = record_plan_of(tmp_path / "run.mcap")
    planned, travelled, *_, last = payloads(tmp_path / "run.mcap", PLAN_PATH, SceneUpdate)
    points = [(point.x, point.y) for point in planned.entities[0].lines[0].points]
    assert points == list(steps[0].target.waypoints)
    assert len(planned.entities) == 1
    assert len(travelled.entities) == 2
    assert [each.id for each in last.deletions] == ["plan/way", "plan/travelled"]


def test_everything_of_a_decision_has_the_time_of_its_sample(tmp_path):
    steps = record_plan_of(tmp_path / "run.mcap")
    times = {
        message.timestamp.ToNanoseconds()
        for message in payloads(tmp_path / "run.mcap", GRADIENT_MAP, GridMessage)
    }
    assert times == {step.time_ns for step in steps if step.candidates}
    assert times <= {int(time) for time in sr.read_trace(tmp_path / "run.mcap").times_ns}


def test_the_planner_and_the_log_agree_on_where_the_automaton_is(tmp_path):
    steps = record_plan_of(tmp_path / "run.mcap", slips=1)
    logged = payloads(tmp_path / "run.mcap", "/spatial/automaton", AutomatonState)
    states = {message.time_ns: tuple(message.states) for message in logged}
    assert [states[step.time_ns] for step in steps] == [step.states for step in steps]
    told = read_decisions(tmp_path / "run.mcap").decisions
    after = [(states[each.outcome.end_ns], tuple(each.outcome.states)) for each in told[:-1]]
    assert all(one == other for one, other in after)


def test_a_log_without_decisions_has_none_to_make_again(tmp_path):
    with sr.Recorder(tmp_path / "run.mcap") as recorder:
        recorder.write(sr.Sample(0, BLOCKS))
    with pytest.raises(UsageError, match="holds no decisions"):
        redo_decisions(open_source(tmp_path / "run.mcap"))
    with pytest.raises(UsageError, match="holds no decisions"):
        read_decisions(tmp_path / "run.mcap")


def test_settings_are_read_back_as_they_were():
    workspace = Workspace(
        Grid(0.1, -0.7, 1 / 3, 5, 7),
        yaws=(0.0, math.pi / 3),
        base=(0.1, 0.2),
        nearest=0.3,
        obstacles=(sr.Footprint.disc(1, 2, 0.1), sr.Footprint.box(0, 0, 1, 1)),
        supports=frozenset({"plate", "mat"}),
        clearance=0.02,
    )
    for settings in (PUSH, Settings(workspace, movable=("cup",), margin=0.1, attempts=2)):
        assert settings_from_text(text_from_settings(settings)) == settings


@pytest.mark.parametrize("text", ["", "{}", "[1]", json.dumps({"grid": [0, 0, 0, 1, 1]})])
def test_settings_that_cannot_be_read_are_refused(text):
    with pytest.raises(LogError, match="settings in the log cannot be read"):
        settings_from_text(text)
