from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader

import spatial_replay as sr
from planning.kinematics import BLOCKS, block
from planning.plans import PUSH, record_plan_of, write_usual_run
from spatial_replay import LogError, Settings, UsageError, load_specification
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState
from spatial_replay.logs.topics import GRADIENT_MAP, MAP_DRAWING, PLAN_METADATA, PLAN_PATH
from spatial_replay.planning import Grid, Reason, Workspace, read_decisions, recompute_decisions
from spatial_replay.planning.decision_log import map_fields
from spatial_replay.planning.read import planner_of
from spatial_replay.planning.settings import settings_from_text, text_from_settings
from spatial_replay.replay.engine import load_files, run_replay
from spatial_replay.replay.selection import ReplayOptions, Window
from spatial_replay.replay.verification import verify_certificate
from spatial_replay.sources import open_source

RECORDED = Path(__file__).resolve().parents[2] / "recordings" / "push.mcap"


def payloads(path, topic, kind):
    found = (each for batch, _ in open_source(path).iter_payloads(topic) for each in batch)
    return [kind.FromString(each) for each in found]


def test_decisions_are_logged_with_their_outcomes(tmp_path):
    steps = write_usual_run(tmp_path / "run.mcap", slips=1)
    decisions = read_decisions(tmp_path / "run.mcap").decisions
    assert [each.number for each in decisions] == list(range(len(steps)))
    assert [each.outcome.succeeded for each in decisions[:-1]] == [False, *[True] * (len(steps) - 2)]
    assert decisions[0].outcome.reason == "it slipped"
    assert not decisions[-1].HasField("outcome")
    assert decisions[-1].kind == decisions[-1].KIND_HOLD
    assert Reason.from_text(decisions[0].considered[0].pruned) == steps[0].considered[0].pruned
    assert [each.object for each in decisions[0].considered[1].candidates] == ["blue", "green", "red"]


def test_recomputed_decisions_are_the_same(tmp_path):
    steps = write_usual_run(tmp_path / "run.mcap", slips=1)
    recomputed = recompute_decisions(open_source(tmp_path / "run.mcap"))
    assert recomputed.differences == ()
    assert recomputed.decisions == len(steps)
    assert recomputed.maps == sum(len(each.candidates) for step in steps for each in step.considered)


def test_the_stage_of_a_failure_is_logged_and_read_back(tmp_path):
    record_plan_of(tmp_path / "run.mcap", slips=1, stage="way")
    assert read_decisions(tmp_path / "run.mcap").decisions[0].outcome.at == "way"
    first, *_ = sr.planning.read_steps(tmp_path / "run.mcap")
    assert (first.message.outcome.reason, first.message.outcome.at) == ("it slipped", "way")
    assert recompute_decisions(open_source(tmp_path / "run.mcap")).differences == ()


def test_equal_runs_give_equal_logs(tmp_path):
    write_usual_run(tmp_path / "one.mcap")
    record_plan_of(tmp_path / "two.mcap")
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()


def test_other_settings_make_other_decisions(tmp_path):
    record_plan_of(tmp_path / "run.mcap", recorded_settings=replace(PUSH, margin=0.03))
    (first, *_) = recompute_decisions(open_source(tmp_path / "run.mcap")).differences
    assert "/plan/decision differs in" in first
    assert "of decision 0" in first


def test_a_changed_sample_is_a_difference(tmp_path):
    def recorded_as(sample):
        return sr.Sample(sample.time_ns, {**sample.objects, "red": block(0.5, -0.0500001, math.pi / 4)})

    record_plan_of(tmp_path / "run.mcap", recorded_as=recorded_as)
    assert recompute_decisions(open_source(tmp_path / "run.mcap")).differences


@pytest.mark.parametrize(
    ("most_recorded", "missing"),
    [
        (0, "the log has no decision"),
        (1, "the log has no outcome of decision 0 at 0.000 s"),
        (2, "the log has no decision after decision 0 at 0.000 s"),
        (3, "the log has no outcome of decision 1 at 0.100 s"),
        (4, "the log has no decision after decision 1 at 0.100 s"),
    ],
)
def test_missing_decisions_are_a_difference(tmp_path, most_recorded, missing):
    record_plan_of(tmp_path / "run.mcap", most_recorded=most_recorded)
    (difference,) = recompute_decisions(open_source(tmp_path / "run.mcap")).differences
    assert difference.startswith(missing)


def test_a_wait_without_an_end_is_a_difference(tmp_path):
    text = "F[30,900] (green rightof red)"
    record_plan_of(tmp_path / "run.mcap", f"use spatial_spec\nspec late = {text}", most_recorded=1)
    (difference,) = recompute_decisions(open_source(tmp_path / "run.mcap")).differences
    assert difference.startswith("the log has no decision after decision 0")


def cut(log, to, window):
    """Copy some samples of a log."""
    source = open_source(log)
    run_replay(source, load_files((), source), ReplayOptions(window), output=to)


def test_the_beginning_of_a_run_can_be_recomputed_and_the_end_cannot(tmp_path):
    write_usual_run(tmp_path / "run.mcap", slips=1)
    first, second, *_ = read_decisions(tmp_path / "run.mcap").decisions
    cut(tmp_path / "run.mcap", tmp_path / "begun.mcap", Window(end_ns=second.time_ns + 1))
    recomputed = recompute_decisions(open_source(tmp_path / "begun.mcap"))
    assert recomputed.differences == ()
    assert recomputed.decisions == second.number + 1
    cut(tmp_path / "run.mcap", tmp_path / "cut.mcap", Window(start_ns=first.time_ns + 1))
    cut(tmp_path / "cut.mcap", tmp_path / "copy.mcap", Window())
    for name in ("cut.mcap", "copy.mcap"):
        with pytest.raises(UsageError, match=f"{name} begins within the run"):
            recompute_decisions(open_source(tmp_path / name))


def test_a_replay_keeps_decisions(tmp_path):
    write_usual_run(tmp_path / "run.mcap")
    (tmp_path / "edited.spatial").write_text("use spatial_spec\nF (red above blue)\n")
    edited = load_specification(tmp_path / "edited.spatial")
    run_replay(open_source(tmp_path / "run.mcap"), [edited], output=tmp_path / "annotated.mcap")
    assert recompute_decisions(open_source(tmp_path / "annotated.mcap")).differences == ()


def test_certificates_cover_decisions(tmp_path):
    write_usual_run(tmp_path / "run.mcap")
    verified = verify_certificate(open_source(tmp_path / "run.mcap"))
    assert "plan_sha256" in verified.recorded
    assert verified.differences == ()


def test_verify_notices_edited_and_removed_plan_settings(tmp_path):
    log = tmp_path / "annotated.mcap"
    run_replay(open_source(RECORDED), load_files([], open_source(RECORDED)), output=log)
    assert sr.verify(log).differences == sr.verify(log, RECORDED).differences == ()
    settings = dict(open_source(log).metadata())[PLAN_METADATA]
    edited = settings | {"settings": settings["settings"].replace('"margin":', '"margin": 1')}
    assert edited != settings
    for name, plan, now in (("edited", edited, ""), ("removed", None, "nothing now")):
        with_plan(log, tmp_path / f"{name}.mcap", plan)
        for source in (None, RECORDED):
            verified = sr.verify(tmp_path / f"{name}.mcap", source, explain=True)
            (difference,) = verified.differences
            assert difference.startswith(f"other plan settings: {now}")
        assert "plan settings  differ from those certified" in verified.explanation


def test_verify_notices_that_a_log_without_a_hash_of_its_plan_settings_has_none(tmp_path):
    # as logs were recorded before certificates had one
    earlier = tmp_path / "earlier.mcap"
    with_plan(RECORDED, earlier, dict(open_source(RECORDED).metadata())[PLAN_METADATA], is_hashed=False)
    assert sr.verify(earlier).differences == ()
    with_plan(earlier, tmp_path / "removed.mcap", None)
    (difference,) = sr.verify(tmp_path / "removed.mcap").differences
    assert difference.startswith("no plan settings: ")


def with_plan(log, output, plan, is_hashed=True):
    """Copy a log with other plan settings, or without any; `is_hashed` says whether their hash is kept."""
    source = open_source(log)
    with output.open("wb") as stream, LogWriter(stream) as writer:
        for block in source.iter_blocks():
            writer.write_messages(block.messages)
        for attachment in source.attachments():
            writer.add_attachment(attachment.name, attachment.media_type, attachment.data)
        for name, data in source.metadata():
            if name != PLAN_METADATA:
                kept = {key: value for key, value in data.items() if is_hashed or key != "plan_sha256"}
                writer.add_metadata(name, kept)
            elif plan is not None:
                writer.add_metadata(name, plan)


TURNING = Settings(
    Workspace(Grid.over(0, 0, 8, 6, 0.5), yaws=(0.0, math.pi / 4, math.pi / 2)), attempts=1, margin=0.01
)
THINGS = {"cup": block(1, 1, size=1), "fork": block(3, 3, 0.3, size=1)}
TURNED = "F (fork oriented[0.01] cup and fork rightof cup) and F (fork above cup and fork oriented[0.01] cup)"


def values_of(message):
    """(rows, columns): the numbers of a grid; blocked cells are clear."""
    cells = map_fields(message)
    assert np.array_equal(cells["alpha"] == 0, np.isnan(cells["robustness"]))
    return cells["robustness"]


def value_at(message, x, y):
    column = math.floor((x - message.pose.position.x) / message.cell_size.x)
    row = math.floor((y - message.pose.position.y) / message.cell_size.y)
    return values_of(message)[row, column]


@pytest.mark.parametrize(
    "options", [{}, {"text": TURNED, "objects": THINGS, "settings": TURNING}], ids=["pushed", "turned"]
)
def test_every_map_of_every_edge_is_in_the_log(tmp_path, options):
    steps = record_plan_of(tmp_path / "run.mcap", **options)
    maps = payloads(tmp_path / "run.mcap", GRADIENT_MAP, GridMessage)
    decisions = read_decisions(tmp_path / "run.mcap").decisions
    numbers = []
    for step, decision in zip(steps, decisions, strict=True):
        for edge, seen in zip(step.considered, decision.considered, strict=True):
            for candidate, shown in zip(edge.candidates, seen.candidates, strict=True):
                assert [each.turn for each in shown.maps] == candidate.map.turns.tolist()
                for each, values in zip(shown.maps, candidate.map.values, strict=True):
                    found = values_of(maps[each.number])
                    np.testing.assert_array_equal(found, values.astype(np.float32))
                    assert maps[each.number].timestamp.ToNanoseconds() == step.time_ns
                    numbers.append(each.number)
    assert sorted(numbers) == list(range(len(maps)))


@pytest.mark.parametrize(
    "options", [{}, {"text": TURNED, "objects": THINGS, "settings": TURNING}], ids=["pushed", "turned"]
)
def test_the_last_map_of_a_step_is_that_of_the_chosen_object(tmp_path, options):
    steps = record_plan_of(tmp_path / "run.mcap", **options)
    maps = payloads(tmp_path / "run.mcap", GRADIENT_MAP, GridMessage)
    moves = [step for step in steps if step.target is not None]
    assert moves
    for step in moves:
        *_, last = (each for each in maps if each.timestamp.ToNanoseconds() == step.time_ns)
        assert value_at(last, step.target.x, step.target.y) == np.float32(step.target.robustness)
        assert np.isnan(values_of(last)).any()


def test_maps_are_numbered_on_their_topic(tmp_path):
    write_usual_run(tmp_path / "run.mcap")
    with (tmp_path / "run.mcap").open("rb") as stream:
        messages = list(make_reader(stream).iter_messages([GRADIENT_MAP]))
    assert [message.sequence for _, _, message in messages] == list(range(len(messages)))


def test_maps_without_a_good_cell_explain_that_no_path_is_left(tmp_path):
    text = "F (cup leftof fork and cup rightof fork)"
    steps = record_plan_of(tmp_path / "run.mcap", text, THINGS, replace(TURNING, margin=0.1))
    assert [step.kind for step in steps] == ["no path"]
    maps = payloads(tmp_path / "run.mcap", GRADIENT_MAP, GridMessage)
    assert len(maps) == 2 * 3
    assert not any((values_of(each) >= 0.1).any() for each in maps)


def test_the_maps_of_the_recorded_push_explain_the_pruned_edge():
    first, *_ = read_decisions(RECORDED).decisions
    given_up, aim = first.considered
    maps = payloads(RECORDED, GRADIENT_MAP, GridMessage)
    needed = planner_of(open_source(RECORDED)).settings.margin
    assert len(given_up.candidates) == 3
    for candidate in given_up.candidates:
        (each,) = candidate.maps
        assert not (values_of(maps[each.number]) >= needed).any()
    (chosen,) = (candidate for candidate in aim.candidates if candidate.chosen)
    value = value_at(maps[chosen.maps[0].number], first.target.x, first.target.y)
    assert value == np.float32(first.target.robustness)
    assert value >= needed


def test_decisions_of_the_recorded_push_are_recomputed_byte_for_byte():
    recomputed = recompute_decisions(open_source(RECORDED))
    assert recomputed.differences == ()
    assert recomputed.decisions > 2


def test_the_planned_path_is_drawn_first_and_then_the_travelled_one(tmp_path):
    steps = write_usual_run(tmp_path / "run.mcap")
    planned, travelled, *_, last = payloads(tmp_path / "run.mcap", PLAN_PATH, SceneUpdate)
    points = [(point.x, point.y) for point in planned.entities[0].lines[0].points]
    assert points == list(steps[0].target.waypoints)
    assert len(planned.entities) == 1
    assert len(travelled.entities) == 2
    assert [each.id for each in last.deletions] == ["plan/way", "plan/travelled"]


def test_the_drawing_of_a_map_has_the_contour_axes_scale_and_way(tmp_path):
    first, *_ = write_usual_run(tmp_path / "run.mcap")
    (frame,) = payloads(tmp_path / "run.mcap", MAP_DRAWING, SceneUpdate)[0].entities
    maps = payloads(tmp_path / "run.mcap", GRADIENT_MAP, GridMessage)
    *_, drawn = (each for each in maps if each.timestamp.ToNanoseconds() == first.time_ns)
    values, size = values_of(drawn), drawn.cell_size.x
    contour, _, *_, way, outline = frame.lines
    ends = [(point.x, point.y) for point in contour.points]
    sides = {(1, 0): 0, (0, 1): 0}
    for (x0, y0), (x1, y1) in zip(ends[::2], ends[1::2], strict=True):
        across = (1, 0) if abs(x1 - x0) < size / 2 else (0, 1)
        count = round((abs(x1 - x0) + abs(y1 - y0)) / size)
        sides[across] += count
        for place in (np.arange(count) + 0.5) * size:
            x, y = (x0, min(y0, y1) + place) if across == (1, 0) else (min(x0, x1) + place, y0)
            dx, dy = (size / 2 * side for side in across)
            both = value_at(drawn, x - dx, y - dy), value_at(drawn, x + dx, y + dy)
            assert min(both) < PUSH.margin <= max(both)
    for axis, across in ((1, (1, 0)), (0, (0, 1))):
        reach, is_free = values >= np.float32(PUSH.margin), np.isfinite(values)
        one, two = (np.take(reach, range(k, reach.shape[axis] - 1 + k), axis) for k in (0, 1))
        free = [np.take(is_free, range(k, reach.shape[axis] - 1 + k), axis) for k in (0, 1)]
        assert sides[across] == ((one != two) & free[0] & free[1]).sum() > 0
    assert [(point.x, point.y) for point in way.points] == list(first.target.waypoints)
    assert len(outline.points) == 4
    blocked, bar = frame.triangles
    widths = [end.x - start.x for start, end in zip(blocked.points[::4], blocked.points[1::4], strict=True)]
    assert sum(widths) == pytest.approx(np.isnan(values).sum() * size)
    middle = bar.colors[len(bar.colors) // 2]
    assert middle.r == middle.b, "white at 0"
    texts = {text.text: (text.pose.position.x, text.pose.position.y) for text in frame.texts}
    scale = np.nanmax(np.abs(values))
    assert texts["0"][1] == pytest.approx(0.0, abs=1e-9), "the middle of a grid from -0.225 to 0.225"
    assert texts[f"{scale:.4g}"][1] > 0.2 > -0.2 > texts[f"-{scale:.4g}"][1]
    assert texts["0.4"][0] == pytest.approx(0.4)
    assert texts["0.4"][1] < -0.225


def test_a_decision_without_a_target_keeps_the_map_and_draws_no_way(tmp_path):
    write_usual_run(tmp_path / "run.mcap")
    drawings = payloads(tmp_path / "run.mcap", MAP_DRAWING, SceneUpdate)
    assert len(drawings) == len(read_decisions(tmp_path / "run.mcap").decisions)
    before, last = (drawing.entities[0] for drawing in drawings[-2:])
    assert [*before.texts] == [*last.texts]
    assert before.lines[:-2] == last.lines[:]


def test_all_messages_of_a_decision_have_the_time_of_its_sample(tmp_path):
    steps = write_usual_run(tmp_path / "run.mcap")
    times = {
        message.timestamp.ToNanoseconds()
        for message in payloads(tmp_path / "run.mcap", GRADIENT_MAP, GridMessage)
    }
    assert times == {step.time_ns for step in steps if step.considered}
    assert times <= {int(time) for time in sr.read_trace(tmp_path / "run.mcap").times_ns}


def test_the_planner_and_the_log_agree_on_the_states_of_the_automaton(tmp_path):
    steps = write_usual_run(tmp_path / "run.mcap", slips=1)
    logged = payloads(tmp_path / "run.mcap", "/spatial/automaton", AutomatonState)
    states = {message.time_ns: tuple(message.states) for message in logged}
    assert [states[step.time_ns] for step in steps] == [step.states for step in steps]
    decisions = read_decisions(tmp_path / "run.mcap").decisions
    after = [(states[each.outcome.end_ns], tuple(each.outcome.states)) for each in decisions[:-1]]
    assert all(one == other for one, other in after)


def test_a_log_without_decisions_cannot_be_recomputed(tmp_path):
    with sr.Recorder(tmp_path / "run.mcap") as recorder:
        recorder.write(sr.Sample(0, BLOCKS))
    with pytest.raises(UsageError, match="holds no decisions"):
        recompute_decisions(open_source(tmp_path / "run.mcap"))
    with pytest.raises(UsageError, match="holds no decisions"):
        read_decisions(tmp_path / "run.mcap")


def test_settings_survive_a_round_trip_as_text():
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


def test_settings_that_are_too_large_are_refused():
    large = Settings(Workspace(Grid(0, 0, 1.0, 500, 500), yaws=(0.0, 1.0, 2.0, 3.0)))
    document = json.loads(text_from_settings(large))
    for change in ({"yaws": [*document["yaws"], 4.0]}, {"grid": [0.0, 0.0, 1.0, 1000, 1001], "yaws": []}):
        with pytest.raises(LogError, match="give at most 1,000,000 cells"):
            settings_from_text(json.dumps(document | change))


@pytest.mark.parametrize("text", ["", "{}", "[1]", json.dumps({"grid": [0, 0, 0, 1, 1]})])
def test_settings_that_cannot_be_read_are_refused(text):
    with pytest.raises(LogError, match="settings in the log cannot be read"):
        settings_from_text(text)
