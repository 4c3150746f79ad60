"""The pages about whole jobs: every command and program on them runs and prints what the page shows."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
FENCE = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)


class Block(NamedTuple):
    """A fenced block of a page; with a title it is a file, "text" is the output of the block before."""

    language: str
    title: str
    text: str


def blocks(page: str) -> list[Block]:
    return [Block(*found) for found in FENCE.findall((ROOT / "docs" / page).read_text("utf-8"))]


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the recordings, in which `spatial-replay` and `python` are those under test."""
    shutil.copytree(ROOT / "recordings", tmp_path / "recordings")
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, command in (("spatial-replay", "-m spatial_replay"), ("python", "")):
        program = programs / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" {command} "$@"\n')
        program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def commands(block: Block) -> Iterator[tuple[str, int]]:
    """The commands of a block; a comment that begins with a digit is the exit code, else 0."""
    for line in block.text.splitlines():
        command, _, comment = line.partition("#")
        code = re.match(r"\s*(\d)", comment)
        yield command.strip(), int(code[1]) if code else 0


def shell(command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)


def follow(page: str, names: dict[str, object], capsys: pytest.CaptureFixture[str]) -> None:
    """Do what a page says, from top to bottom, and compare what is printed with what it shows."""
    printed = ""
    for block in blocks(page):
        if block.title:
            Path(block.title).write_text(block.text, "utf-8")
        elif block.language == "python":
            exec(compile(block.text, page, "exec"), names)  # noqa: S102
            printed = capsys.readouterr().out
        elif block.language == "text":
            assert printed == block.text
        elif block.language == "sh":
            printed = ""
            for command, code in commands(block):
                ended = shell(command)
                printed += ended.stdout
                assert ended.returncode == code, f"{command}\n{ended.stdout}{ended.stderr}"


@pytest.mark.usefixtures("desk")
def test_a_loop_stops_its_robot_at_the_first_violation_and_its_log_says_why(
    capsys: pytest.CaptureFixture[str],
) -> None:
    names: dict[str, object] = {}
    follow("your-own-loop.md", names, capsys)
    because = names["robot"].stopped_because  # type: ignore[attr-defined]
    assert because.startswith("robot is 0.00269151 too close to vase: ")
    explained = names["replayed"].explain()  # type: ignore[attr-defined]
    assert explained.index("robot dist vase >= 0.05") < explained.index("robot enclosedin goal")
    assert Path("run.html").stat().st_size > 10_000


@pytest.mark.usefixtures("desk")
def test_a_failure_is_traced_from_the_verdict_to_a_report_and_an_annotated_log(
    capsys: pytest.CaptureFixture[str],
) -> None:
    follow("why-did-it-fail.md", {}, capsys)
    for file in ("table.html", "table.mcap", "layout.json", "table.csv"):
        assert Path(file).stat().st_size > 1_000


@pytest.mark.usefixtures("desk")
def test_what_changed_is_found_and_the_smallest_piece_that_shows_it_is_cut_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    follow("compare.md", {}, capsys)
    assert Path("diff.html").stat().st_size > 10_000
    assert Path("bug.mcap").stat().st_size < Path("recordings/push.mcap").stat().st_size / 5


@pytest.mark.usefixtures("desk")
def test_numbers_that_fit_recorded_runs_are_found_and_written(capsys: pytest.CaptureFixture[str]) -> None:
    follow("tuning.md", {}, capsys)
    assert "const clearance = 0.8 in [0, 2]    # metres, a first guess" in Path("pass.spatial").read_text()


@pytest.fixture
def gate(desk: Path) -> list[Block]:
    """The page's files, with its fifty logs made."""
    page = blocks("fifty-logs-in-ci.md")
    for block in page:
        if block.title:
            (desk / block.title).write_text(block.text, "utf-8")
    assert shell("python make_logs.py").returncode == 0
    assert len(list(Path("logs").iterdir())) == 50
    return page


def test_one_process_gates_fifty_logs_and_names_those_that_fail(gate: list[Block]) -> None:
    ended = shell("python gate.py")
    shown = next(block.text for block in gate if block.language == "text")
    assert (ended.stdout, ended.returncode) == (shown, 1)


def test_a_shell_loop_fails_the_build_when_one_log_fails(gate: list[Block]) -> None:
    assert any("sh gate.sh logs/*.jsonl" in block.text for block in gate if block.language == "sh")
    assert shell("sh gate.sh logs/run-00.jsonl logs/run-01.jsonl").returncode == 0
    ended = shell("sh gate.sh logs/run-00.jsonl logs/run-49.jsonl")
    assert ended.returncode == 1
    assert ended.stderr == "logs/run-49.jsonl: exit code 1\n"
    assert {path.name for path in Path("results").iterdir()} >= {"run-00.jsonl.json", "run-49.jsonl.json"}


def test_a_missing_log_does_not_pass_the_gate(gate: list[Block]) -> None:
    assert gate
    assert shell("sh gate.sh logs/run-50.jsonl").returncode == 1
    shutil.rmtree("logs")
    assert shell("python gate.py").returncode == 1


def test_a_specification_that_checks_nothing_does_not_pass_the_gate(gate: list[Block]) -> None:
    assert gate
    Path("gate.spatial").write_text("spec late = G[60s, 90s] (cart dist person >= 0.3)")
    assert shell("sh gate.sh logs/run-00.jsonl").returncode == 1
    ended = shell("python gate.py")
    assert ended.returncode == 1
    assert "{'vacuous': 50}" in ended.stdout


def test_the_workflow_runs_the_gate_of_the_page(gate: list[Block]) -> None:
    workflow = yaml.safe_load(next(block.text for block in gate if block.language == "yaml"))
    steps = [step["run"] for step in workflow["jobs"]["gate"]["steps"] if "run" in step]
    assert steps[-1] == "sh gate.sh logs/*.jsonl"
