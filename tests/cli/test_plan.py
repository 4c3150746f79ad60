"""`spatial-replay plan`: exit codes, and what is said."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from spatial_replay.cli import run
from spatial_replay.planning import read_decisions

SATISFIED = "spec calm = F (green leftof red)\n"
IMPOSSIBLE = "spec torn = F (red dist blue >= 100)\n"


@pytest.fixture(autouse=True)
def _simulator() -> None:
    pytest.importorskip("pybullet", reason="PyBullet is not installed; it has wheels for Python 3.11")


def plan(folder: Path, text: str, *options: str) -> int:
    """`plan push` for a specification, into `run.mcap`."""
    (folder / "task.spatial").write_text(text, encoding="utf-8")
    output = folder / "run.mcap"
    return run(["plan", "push", "-o", str(output), "--spec", str(folder / "task.spatial"), *options])


def test_a_satisfied_plan_exits_with_0(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plan(tmp_path, SATISFIED) == 0
    said = capsys.readouterr()
    assert "over 1.033 s; 0 motions\n" in said.out
    assert "the planner: the specification is satisfied: hold\nthe log: calm is satisfied\n" in said.out
    assert re.fullmatch(r"planning took \d+\.\d\d s\n", said.err)


def test_a_plan_without_a_path_left_exits_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plan(tmp_path, IMPOSSIBLE) == 1
    said = capsys.readouterr().out
    reason = "no path left: every way from state 0 was given up (0 -> 1: no object can do it)"
    assert f"the planner: {reason}; what cannot be done: red dist blue >= 100: " in said
    assert f"spatial-replay info {tmp_path / 'run.mcap'} --decisions shows" in said
    assert said.endswith("the log: torn is violated\n")


def test_a_plan_with_too_uncertain_objects_exits_with_4(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert plan(tmp_path, SATISFIED, "--noise", "0.1") == 4
    assert "the planner: the specification is satisfied: hold\nthe log: calm is unknown\n" in (
        capsys.readouterr().out
    )


def test_one_of_several_results_has_to_be_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plan(tmp_path, IMPOSSIBLE + SATISFIED) == 2
    assert "task.spatial has several results; choose one with --result: torn, calm" in capsys.readouterr().err
    assert not (tmp_path / "run.mcap").exists()
    assert plan(tmp_path, IMPOSSIBLE + SATISFIED, "--result", "calm") == 0
    assert read_decisions(tmp_path / "run.mcap").decisions[0].specification == "calm"
    assert run(["verify", str(tmp_path / "run.mcap"), "--decisions"]) == 0


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (SATISFIED, ["--result", "clam"], "task.spatial has no result 'clam'; its results are: calm"),
        ("spec calm = G O (green leftof red)\n", [], "past operators"),
        ("spec calm = F (pink leftof red)\n", [], "the world never has the object 'pink'"),
        ("spec calm = F (\n", [], "task.spatial:1"),
        (
            "spec calm = F (red leftof blue and not (red leftof blue))\n",
            [],
            "no run satisfies calm: by logic alone",
        ),
        (
            "spec calm = F (red leftof blue and red ovlp blue)\n",
            [],
            "no run satisfies calm: `red leftof blue` and `red ovlp blue` exclude each other",
        ),
        (SATISFIED, ["--inject", "drop@1s"], "drop"),
    ],
)
def test_a_specification_that_cannot_be_planned_for_exits_with_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, options: list[str], message: str
) -> None:
    assert plan(tmp_path, text, *options) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert message in said.err
    assert not (tmp_path / "run.mcap").exists()


@pytest.mark.parametrize("display", ["", ":987", "nowhere:0"])
def test_without_a_display_no_window_is_opened(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, display: str
) -> None:
    monkeypatch.setenv("DISPLAY", display)
    assert plan(tmp_path, SATISFIED, "--gui") == 2
    said = capsys.readouterr().err
    assert "DISPLAY" in said
    assert "run without gui" in said
    assert not (tmp_path / "run.mcap").exists()
