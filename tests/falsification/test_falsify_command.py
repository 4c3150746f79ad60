"""`spatial-replay falsify` in a simulated world: its logs, what it says, and its exit codes."""

from __future__ import annotations

import json
import shlex
from itertools import pairwise
from pathlib import Path

import pytest

import spatial_replay as sr
from spatial_replay.cli import run

NEAR = "const far = 1\nspec near = G (red dist blue <= far)\n"
VARIED = ("--vary", "start.red=0.03", "--vary", "slip@T", "--seed", "2")


@pytest.fixture(autouse=True)
def _extras() -> None:
    pytest.importorskip("pybullet", reason="PyBullet is not installed; it has wheels for Python 3.11")
    pytest.importorskip("cma", reason="the search needs cma")


def test_a_failure_is_the_log_that_its_command_records(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("near.spatial").write_text(NEAR)
    given = ["--spec", "near.spatial", "--const", "far=0.19"]
    command = ["falsify", "push", *given, "-o", "found", *VARIED, "--budget", "3"]
    assert run(command) == 1
    said = capsys.readouterr().out
    assert said.startswith("run 1, with nothing varied: satisfied, near 0.0")
    found = json.loads(Path("found/failures.json").read_text())
    worst = found["failures"][0]
    # a red block too far away needs no mishap
    assert worst["smaller"]["slip"] is None
    assert worst["smaller"]["start.red.x"] == worst["case"]["start.red.x"]
    assert f"with less: found/{worst['smaller_log']}" in said
    *_, repeated = said.splitlines()
    label, again = repeated.split(": spatial-replay ")
    least = min(found["failures"], key=lambda each: each["smaller_robustness"])
    assert label == f"the worst again, run {least['run']} with less"
    assert f"--start red={worst['case']['start.red.x']}," in again
    assert run(shlex.split(again)) == 0
    assert Path("again.mcap").read_bytes() == Path("found", worst["smaller_log"]).read_bytes()
    # what is known is not simulated again
    before = {file: file.read_bytes() for file in Path("found").rglob("*.*")}
    assert run([*command, "--json"]) == 1
    *_, printed = capsys.readouterr().out.partition("{")
    assert json.loads("{" + printed) == found
    assert {file: file.read_bytes() for file in Path("found").rglob("*.*")} == before


@pytest.mark.parametrize(
    ("formula", "error"),
    [
        ("G (red dist blue >= 0 or red dist blue < 1)", "every run satisfies beside: "),
        ("F (red leftof blue and blue leftof red)", "no run satisfies beside: "),
    ],
)
def test_a_specification_that_every_run_decides_alike_is_refused_before_the_first_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], formula: str, error: str
) -> None:
    spec = tmp_path / "beside.spatial"
    spec.write_text(f"spec low = G (tool_z >= 0)\nspec beside = {formula}\n")
    assert run(["falsify", "push", "--spec", str(spec), "-o", str(tmp_path / "found")]) == 2
    said = capsys.readouterr().err
    assert f"beside.spatial:2:6: error: {error}" in said
    assert not (tmp_path / "found").exists()


def test_what_was_covered_is_said_where_nothing_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["falsify", "push", "-o", str(tmp_path / "found"), "--vary", "slip@5s:200s", "--budget", "2"]
    command += ["--vary", "noise=0:0.05"]
    # noise leaves doubt, and the robot's script does not act on what is seen
    assert run(command) == 4
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("run 1, with nothing varied: satisfied, push 0.0")
    assert said[1].startswith("slip@5s:200s goes on after the end of that run, at ")
    assert said[1].endswith(" s: from there on nothing happens")
    assert said[2] == "2 runs of push: none violated, 1 unknown"
    assert said[3].startswith("  the lowest: run 1, satisfied, push 0.0")
    assert said[4] == "  that is no proof: the same command with a larger --budget goes on from there"
    assert said[7].split()[:5] == ["noise", "0", "to", "0.05", "m"]
    assert sorted(said[7].split()[5:]) == ["0"] * 9 + ["1"]


def test_a_mishap_after_the_end_of_the_run_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["falsify", "push", "-o", str(tmp_path / "found"), "--vary", "slip@100s:200s"]) == 2
    said = capsys.readouterr().err
    assert "--vary slip@100s:200s: with nothing varied the run ends after " in said
    assert "begin before that, in another folder" in said


def test_a_planner_is_searched_as_a_script_is_and_its_run_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("low.spatial").write_text("const least = 1\nspec low = G (tool_z >= least)\n")
    watched = ["--spec", "low.spatial", "--const", "least=5.0"]
    # so much noise that it sees nothing to do
    assert run(["falsify", "push", *watched, "--planned", "-o", "found", "--vary", "noise=0.2:0.3"]) == 1
    *_, repeated = capsys.readouterr().out.splitlines()
    again = "plan push --also low.spatial --const least=5.0 -o again.mcap --seed 0 --noise 0.2"
    assert repeated.endswith(f": spatial-replay {again}")
    log = Path("found/runs/run-0001.mcap")
    results = {result.name: str(result.verdict) for result in sr.replay_log(log).results}
    assert results == {"push": "unknown", "low": "violated"}
    assert not sr.verify(log).differences
    assert run(shlex.split(again)) == 4
    assert "  low, of which the planner knew nothing, is violated\n" in capsys.readouterr().out
    assert Path("again.mcap").read_bytes() == log.read_bytes()


@pytest.mark.parametrize(
    ("varied", "message"),
    [
        ("noise", "--vary: 'noise' is incomplete; write NAME=LOW:HIGH, such as noise=0:0.01"),
        ("noise=-1:1", "--vary noise=-1:1: noise is not below 0; begin at 0"),
        ("drop@T", "--vary drop@T: nothing is held in push; slip can be injected there"),
        ("slip", "--vary slip: write slip@T for any time of the run, or slip@2s:9s"),
        ("slip@2:3", "--vary slip@2:3: '2' is not a duration"),
        ("noise=0:nan", "--vary noise: nan is not an end of a range; write a finite number"),
        ("slip@3s:1s", "--vary slip: 3 to 1 is not a range; write the lower end first"),
        ("start.gren", "--vary start.gren: push has no 'gren'; did you mean 'green'?"),
        ("start=0", "--vary start=0: write how far an object may be from its place"),
        ("strat", "--vary: 'strat' cannot be varied in push; did you mean 'start'?"),
        ("seed=0.5:9", "--vary seed=0.5:9: seeds are whole numbers; write seed=0:999"),
        ("wind=1:2", "--vary: 'wind' cannot be varied in push; write noise=0:0.01, seed=0:999"),
    ],
)
def test_what_cannot_be_varied_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], varied: str, message: str
) -> None:
    assert run(["falsify", "push", "-o", str(tmp_path / "found"), "--vary", varied]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "found").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--start", "gren=0.4,0.1"], "push has no 'gren'; did you mean 'green'?"),
        (["--start", "red"], "'red' is no start; write NAME=X,Y in metres"),
        (["--start", "red=1,2", "--start", "red=2,1"], "--start: 'red' is given twice; give one place"),
    ],
)
def test_starts_that_there_are_not_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert run(["record", "push", "-o", str(tmp_path / "run.mcap"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run.mcap").exists()


def test_starts_in_which_objects_would_lie_in_each_other_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = tmp_path / "calm.spatial"
    spec.write_text("spec calm = G (finger_width <= 5)\n")
    given = {"output": tmp_path / "found", "vary": ["start=0.15"], "budget": 2}
    found = sr.falsify("push", spec, **given)
    assert found.impossible > 0
    (_, other) = found.runs
    starts = [
        (other.case[f"start.{name}.x"], other.case[f"start.{name}.y"]) for name in ("red", "green", "blue")
    ]
    assert all(abs(a - c) > 0.04 or abs(b - d) > 0.04 for (a, b), (c, d) in pairwise(starts))
