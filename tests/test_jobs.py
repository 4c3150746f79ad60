"""The pages about whole jobs: every command and program on them runs and prints what the page shows."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from batch.fleet import Done, command

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
    """A folder with the recordings, in which `python` is that of the tests."""
    shutil.copytree(ROOT / "recordings", tmp_path / "recordings")
    programs = tmp_path / "bin"
    programs.mkdir()
    # a link would leave the packages of a virtual environment behind
    python = programs / "python"
    python.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} "$@"\n')
    python.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def commands(block: Block) -> Iterator[tuple[str, int]]:
    """The commands of a block; a comment that begins with a digit is the exit code, else 0."""
    for line in block.text.splitlines():
        # push_v3#2 is an address
        typed_line, _, comment = line.partition(" #")
        code = re.match(r"\s*(\d)", comment)
        yield typed_line.strip(), int(code[1]) if code else 0


def typed(line: str) -> Done:
    """Run a line of the program in this process, which starts sooner, or another line in a shell."""
    program, *words = shlex.split(line)
    if program == "spatial-replay":
        found = (sorted(map(str, Path().glob(word))) if "*" in word else [word] for word in words)
        return command(*chain.from_iterable(found))
    ended = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
    return Done(ended.returncode, ended.stdout, ended.stderr)


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
            for line, code in commands(block):
                ended = typed(line)
                printed += ended.out
                assert ended.code == code, f"{line}\n{ended.out}{ended.err}"


@pytest.mark.usefixtures("desk")
def test_a_robot_of_ones_own_is_planned_for_and_recorded(capsys: pytest.CaptureFixture[str]) -> None:
    Path("edited.spatial").write_text("F (red dist blue <= 0.1)", "utf-8")
    page = "your-own-robot.md"
    names: dict[str, object] = {}
    for block in blocks(page):
        if block.language == "python":
            exec(compile(block.text, page, "exec"), names)  # noqa: S102
            printed = capsys.readouterr().out
        elif block.language == "text":
            assert printed == block.text
        else:
            assert [(line, typed(line).code) for line, _ in commands(block)] == [
                (line, code) for line, code in commands(block)
            ]


@pytest.mark.usefixtures("desk")
def test_a_loop_stops_its_robot_at_the_first_violation_and_its_log_says_why(
    capsys: pytest.CaptureFixture[str],
) -> None:
    names: dict[str, object] = {}
    follow("your-own-loop.md", names, capsys)
    because = names["robot"].stopped_because  # type: ignore[attr-defined]
    assert because.startswith("robot is 0.002692 too close to vase: ")
    explained = names["replayed"].explain()  # type: ignore[attr-defined]
    assert explained.index("robot dist vase >= 0.05") < explained.index("robot enclosedin goal")
    assert Path("run.html").stat().st_size > 10_000


@pytest.mark.usefixtures("desk")
def test_episodes_are_judged_while_they_are_trained_on(capsys: pytest.CaptureFixture[str]) -> None:
    follow("training.md", {}, capsys)


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
def test_labelled_episodes_are_judged_and_gated(capsys: pytest.CaptureFixture[str]) -> None:
    follow("judge.md", {}, capsys)
    assert Path("push.results").is_dir()


@pytest.mark.usefixtures("desk")
def test_a_success_rate_is_corrected_and_a_data_set_filtered(capsys: pytest.CaptureFixture[str]) -> None:
    follow("success-rate.md", {}, capsys)


@pytest.mark.usefixtures("desk")
def test_the_way_out_needs_no_program_of_ours(capsys: pytest.CaptureFixture[str]) -> None:
    follow("limits.md", {}, capsys)
    assert len(Path("numbers.csv").read_text().splitlines()) == 301
    read = subprocess.run([sys.executable, "leave.py"], capture_output=True, text=True, check=True)
    assert read.stdout.splitlines()[0].startswith("0: ['cup'")


@pytest.mark.usefixtures("desk")
def test_numbers_that_fit_recorded_runs_are_found_and_written(capsys: pytest.CaptureFixture[str]) -> None:
    follow("tuning.md", {}, capsys)
    assert "const clearance = 0.8 in [0, 2]    # metres, a first guess" in Path("pass.spatial").read_text()


@pytest.mark.usefixtures("desk")
def test_what_is_wrong_with_a_specification_is_found_and_its_shortest_runs_are_looked_at(
    capsys: pytest.CaptureFixture[str],
) -> None:
    follow("doctor.md", {}, capsys)
    assert Path("served.html").stat().st_size > 10_000


@pytest.mark.usefixtures("desk")
def test_a_specification_is_learned_from_runs(capsys: pytest.CaptureFixture[str]) -> None:
    follow("learning.md", {}, capsys)
    assert 'spec cup_apart_lamp_always "LEARNED-1: ' in Path("learned.spatial").read_text()


@pytest.fixture
def gate(desk: Path, monkeypatch: pytest.MonkeyPatch) -> list[Block]:
    """The blocks of the page about CI, with its files and logs made, in a folder of its own."""
    monkeypatch.delenv("GITHUB_ACTIONS", raising=False)
    page = blocks("ci.md")
    for block in page:
        if block.title:
            (desk / block.title).write_text(block.text, "utf-8")
    assert typed("python make_logs.py").code == 0
    assert len(list(Path("logs").iterdir())) == 50
    return page


def test_fifty_logs_are_gated_by_one_command_a_suite_and_a_baseline(
    gate: list[Block], capsys: pytest.CaptureFixture[str]
) -> None:
    for block in gate:
        for line, code in commands(block) if block.language == "sh" else ():
            done = typed(line)
            assert done.code == code, f"{line}\n{done.out}{done.err}"
    assert {path.name for path in Path("pages").iterdir()} == {"index.html", "reports"}
    assert len(Path("rows.jsonl").read_text().splitlines()) == 82
    assert Path("main.results/last_run.parquet").exists()
    capsys.readouterr()
    for program, output in pairwise(gate):
        if program.language == "python" and output.language == "text":
            exec(compile(program.text, program.title, "exec"), {})  # noqa: S102
            assert capsys.readouterr() == (output.text, "")


def test_the_jobs_of_both_services_run_the_gate(gate: list[Block]) -> None:
    github = yaml.safe_load(Path("github.yml").read_text())
    gitlab = yaml.safe_load(Path("gitlab.yml").read_text())
    steps = [step["run"] for step in github["jobs"]["gate"]["steps"] if "run" in step]
    assert steps == gitlab["gate"]["script"]
    install, line = steps
    # what is under test is installed already
    assert install.startswith("pip install './spatial-replay[parquet]'")
    assert typed(line).code == 0
    # results of a gate that failed are kept, too
    saved = next(each for each in github["jobs"]["gate"]["steps"] if "cache/save" in each.get("uses", ""))
    assert (saved["if"], gitlab["gate"]["cache"]["when"]) == ("always()", "always")
    assert Path(gitlab["gate"]["artifacts"]["reports"]["junit"]).exists()
    assert Path(gitlab["gate"]["artifacts"]["paths"][0], "index.html").exists()
    assert Path(gitlab["gate"]["cache"]["paths"][0], "last_run.parquet").exists()
    Path("gate.spatial").write_text(Path("gate.spatial").read_text().replace("0.3", "0.5"))
    assert typed(line).code == 1


def test_the_image_installs_an_extra_that_exists_and_compiles_once(gate: list[Block]) -> None:
    (image,) = (block.text for block in gate if block.language == "dockerfile")
    base, copied, (install, compiling, _) = image.splitlines()[0], image.splitlines()[1], image.split(" && ")
    assert (base, copied) == ("FROM python:3.11-slim", "COPY spatial-replay /src")
    (extra,) = re.findall(r"RUN pip install '/src\[(\w+)\]'", install)
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert extra in project["optional-dependencies"]
    assert typed(f"{compiling} --help").code == 0


def test_a_missing_log_does_not_pass_the_gate(gate: list[Block]) -> None:
    assert gate
    assert typed("spatial-replay batch logs/run-50.jsonl --spec gate.spatial").code == 2
    shutil.rmtree("logs")
    assert typed("spatial-replay batch suite.yaml").code == 2


def test_a_specification_that_checks_nothing_does_not_pass_the_gate(gate: list[Block]) -> None:
    assert gate
    Path("gate.spatial").write_text("spec late = G[60s, 90s] (cart dist person >= 0.3)")
    assert typed("spatial-replay batch logs --spec gate.spatial --fail-on vacuous").code == 1
