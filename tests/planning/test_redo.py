"""What a planner would have decided otherwise, and the settings with which it is asked."""

from __future__ import annotations

import json
import math
import re
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields
from importlib.resources import files
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import pytest

import spatial_replay as sr
from planning.plans import record_plan_of
from planning.test_map_layers import OBJECTS, SPEC, TIDYING
from report.report_pages import page_of
from spatial_replay import Settings, UsageError, cli
from spatial_replay.planning import (
    Grid,
    Workspace,
    changed_settings,
    parse_settings,
    read_decisions,
    recompute_decisions,
    redo_decisions,
)
from spatial_replay.planning.settings import text_from_settings
from spatial_replay.report.write import write_report
from spatial_replay.sources import open_source

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def tidied(tmp_path_factory):
    path = tmp_path_factory.mktemp("redo") / "run.mcap"
    record_plan_of(path, SPEC, OBJECTS, TIDYING, slips=1)
    return path


def test_with_nothing_changed_every_decision_is_the_same_byte_for_byte(tidied):
    redone = redo_decisions(open_source(tidied))
    assert not redone.is_different
    assert redone.changes == ()
    assert redone.same == redone.alike == redone.decisions == len(read_decisions(tidied).decisions)


def test_less_room_gives_the_robustness_that_the_log_says_is_possible(tidied):
    (candidate,) = read_decisions(tidied).decisions[0].considered[-1].candidates
    redone = redo_decisions(open_source(tidied), changes={"room": 0.0})
    assert redone.is_different
    assert (redone.same, redone.alike) == (0, 0)
    assert redone.changes == ("room 0.4 -> 0.0",)
    assert redone.recorded.step.target.robustness == candidate.target.robustness
    assert redone.redone.step.target.robustness == pytest.approx(candidate.room.possible, abs=1e-9)


def test_a_change_that_matters_later_leaves_the_decisions_before_it(tidied):
    # one motion fails, so that with one attempt the second decision gives up
    redone = redo_decisions(open_source(tidied), changes={"attempts": 1})
    assert redone.alike == 1
    assert redone.recorded.message.number == 1
    assert redone.redone.step.kind == "no path"


def test_a_change_of_no_consequence_does_the_same_with_other_maps(tidied):
    changed = SPEC.replace("plate >= 0.5", "plate >= 0.45")
    redone = redo_decisions(open_source(tidied), sr.parse_specification(changed))
    assert redone.changes == ("specification task.spatial, tidy -> <text>, tidy",)
    assert not redone.is_different
    assert redone.same < redone.alike == redone.decisions


def test_a_planner_that_would_not_have_waited_differs_where_the_log_has_no_decision(tmp_path):
    text = "spec late = F[30,900] (cup leftof jug)"
    record_plan_of(tmp_path / "run.mcap", text, OBJECTS, TIDYING)
    early = sr.parse_specification(text.replace("30", "12"))
    redone = redo_decisions(open_source(tmp_path / "run.mcap"), early)
    assert redone.recorded is None
    assert redone.redone.sample.time_ns == 11 * 100_000_000
    assert redone.redone.step.kind == "execute"


class Ran(NamedTuple):
    exit_code: int
    output: str


def run(*arguments):
    with redirect_stdout(StringIO()) as said, redirect_stderr(said):
        code = cli.run([str(each) for each in arguments])
    return Ran(code, said.getvalue())


def test_the_command_line_shows_both_decisions_and_both_maps(tidied, tmp_path):
    same = run("plan", "--redo", tidied)
    assert same.exit_code == 0
    assert "all decisions are the same, byte for byte" in same.output
    both = tmp_path / "both.mcap"
    other = run("plan", "--redo", tidied, "--set", "room=0", "-o", both)
    assert other.exit_code == 1
    assert "redone with room 0.4 -> 0.0" in other.output
    assert "decision 0 at 0.000 s differs" in other.output
    assert other.output.count("robustness 0.") >= 2
    document = json.loads(run("plan", "--redo", tidied, "--set", "room=0", "--json").output)
    assert document["recorded"]["target"]["robustness"] < document["redone"]["target"]["robustness"]


def test_the_log_and_the_page_of_it_have_both_decisions(tidied, tmp_path):
    both, page = tmp_path / "both.mcap", tmp_path / "both.html"
    ran = run("plan", "--redo", tidied, "--set", "room=0", "-o", both)
    assert ran.exit_code == 1, ran.output
    source = open_source(both)
    topics = {
        topic: sum(len(batch) for batch, _ in source.iter_payloads(topic))
        for topic in ("/plan/decision", "/plan/redone/decision", "/plan/redone/gradient_map")
    }
    assert topics["/plan/redone/decision"] == 1
    assert topics["/plan/redone/gradient_map"] == 2
    assert recompute_decisions(source).differences == ()
    (layout,) = (each.data for each in source.attachments() if each.name == "layout.json")
    shown = json.loads(layout)["configById"]["3D!scene"]["topics"]
    assert not shown["/plan/redone/gradient_map"]["visible"], "a viewer can show it instead"
    write_report(source, [], page)
    assert '"redone":' in page_of(page).script("facts")


def test_a_copy_with_both_decisions_keeps_the_units_of_lengths_and_signals(tmp_path):
    run_, both = tmp_path / "run.mcap", tmp_path / "both.mcap"
    planner = sr.Planner(sr.parse_specification(SPEC), TIDYING)
    with sr.Recorder(run_, planner=planner, units={"": "m", "battery": "V"}) as recorder:
        recorder.write(sr.Sample(0, OBJECTS, {"battery": 24.0}))
        assert recorder.next_step().kind == "execute"
    assert run("plan", "--redo", run_, "-o", both).exit_code == 0
    assert sr.read_trace(both).units == sr.read_trace(run_).units == {"": "m", "battery": "V"}


def test_settings_come_from_a_file_and_options_have_precedence(tidied, tmp_path):
    (tmp_path / "careful.yaml").write_text("room: 0.2\nattempts: 1\nyaws: [0, 45deg]\n")
    found = run("plan", "--redo", tidied, "--settings", tmp_path / "careful.yaml", "--set", "room=0.1")
    assert "redone with room 0.4 -> 0.1, attempts 6 -> 1:" in found.output.replace("\n", ":")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--room", "0.1"), "no option --room; write --set room=VALUE"),
        (("--set", "rom=0.1"), "--set 'rom=0.1': give KEY=VALUE; did you mean 'room'?"),
        (("--set", "room"), "--set 'room': give KEY=VALUE"),
        (("--set", "room=-1"), "--set room: expected a number of 0 or more; got -1"),
        (("--set", "attempts=0"), "--set attempts: expected a whole number of at least 1; got 0"),
        (("--set", "yaws=0,3x"), "3x"),
        (("--set", "skill=throw"), "--set skill: expected push (slide along a path)"),
        (("push",), "--redo takes no scenario"),
        (("--seed", "0"), "--seed is for a run; leave it out with --redo"),
    ],
)
def test_a_mistake_on_the_command_line_is_named(tidied, arguments, message):
    found = run("plan", "--redo", tidied, *arguments)
    assert found.exit_code == 2
    assert message in found.output


def test_a_scenario_is_required_without_a_log_to_redo():
    found = run("plan", "--set", "room=0.1", "-o", "run.mcap")
    assert found.exit_code == 2
    assert "Missing a scenario (push, pick-place, table-setting), or --redo LOG." in found.output


def test_every_setting_is_in_the_schema_in_the_help_and_on_the_page():
    schema = json.loads((ROOT / "schemas/settings.schema.json").read_text())
    packaged = files("spatial_replay.planning").joinpath("settings.schema.json").read_text()
    assert json.loads(packaged) == schema
    own = {each.name for each in (*fields(Settings), *fields(Workspace))} - {"workspace", "grid"}
    # it follows from the skill
    own -= {"keeps_yaw"}
    assert schema["properties"].keys() == own | {"area", "cell_size"}
    helped = re.findall(r"\w+", run("plan", "push", "--help").output)
    page = (ROOT / "docs/planning.md").read_text()
    for key in schema["properties"]:
        assert key in helped
        assert f"`{key}`" in page


def test_every_setting_of_a_file_is_taken():
    text = """
    skill: place
    movable: [cup, fork]
    margin: 0.01
    constraint_margin: 0.02
    room: 0.03
    room_from: all
    attempts: 4
    motions: 2
    lift: null
    refine: false
    area: [0, 0, 2, 1]
    cell_size: 0.1
    yaws: [0, 90deg]
    base: [0.5, 1]
    nearest: 0.1
    farthest: 0.9
    obstacles: [{box: [0, 0, 1, 1]}, {disc: [2, 2, 0.5]}, {polygon: [[0, 0], [1, 0], [0, 1]]}]
    supports: [plate]
    clearance: 0.02
    """
    expected = Settings(
        Workspace(
            Grid(0.0, 0.0, 0.1, 20, 10),
            yaws=(0.0, math.pi / 2),
            base=(0.5, 1.0),
            nearest=0.1,
            farthest=0.9,
            obstacles=(
                sr.Footprint.box(0, 0, 1, 1),
                sr.Footprint.disc(2, 2, 0.5),
                sr.Footprint.polygon([[0, 0], [1, 0], [0, 1]]),
            ),
            supports=frozenset({"plate"}),
            clearance=0.02,
        ),
        "place",
        movable=("cup", "fork"),
        margin=0.01,
        constraint_margin=0.02,
        room=0.03,
        room_from="all",
        attempts=4,
        motions=2,
        lift=None,
        refine=False,
    )
    found = changed_settings(None, parse_settings(text))
    assert text_from_settings(found) == text_from_settings(expected)
    assert text_from_settings(changed_settings(expected, {})) == text_from_settings(expected)


def test_errors_of_a_settings_file_are_reported_together_with_their_lines():
    with pytest.raises(UsageError) as caught:
        parse_settings("room: -1\nmargn: 0\nobstacles: [{ring: 1}]\n", "careful.yaml")
    lines = str(caught.value).splitlines()
    assert [line.split(": ")[0] for line in lines] == [f"careful.yaml:{number}" for number in (1, 2, 3)]
    with pytest.raises(UsageError, match="give area"):
        changed_settings(None, {"room": 0.1})
