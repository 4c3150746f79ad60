"""`spatial-replay replay --semantics`, from outside."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from cli.program import run_program
from replay.runs import SPECIFICATION, content_of, record, run, write_tracks
from spatial_replay.cli import run as run_in_process
from spatial_replay.logs.schemas.Robustness_pb2 import SATISFIED, UNKNOWN, VIOLATED, Robustness
from spatial_replay.logs.topics import METADATA, ROBUSTNESS

REPLAY = ("replay", "run.jsonl", "--spec", "blocks.spatial")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, the current one, with a run in which one object is not always seen."""
    monkeypatch.chdir(tmp_path)
    write_tracks(run(), tmp_path / "run.jsonl")
    (tmp_path / "blocks.spatial").write_text(
        f"{SPECIFICATION}spec soon = F[0,2] G (cube moved[0.1] cube[-1])\n", encoding="utf-8"
    )
    return tmp_path


def found(*options: str, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    run_in_process([*REPLAY, "--json", "-", *options])
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    return document


def test_results_name_their_semantics(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    default = found(capsys=capsys)
    paper = found("--semantics", "paper", "--series", capsys=capsys)
    assert (default["semantics"], paper["semantics"]) == ("ltlf", "paper")
    assert default == found("--semantics", "ltlf", capsys=capsys)
    differing = {
        key for key in default["certificate"] if default["certificate"][key] != paper["certificate"][key]
    }
    assert differing == {"results_sha256"}
    reach, apart, soon = paper["specifications"]
    assert reach["verdict"] == "satisfied"
    assert reach["robustness"] == reach["lower"] == reach["upper"] > 0
    assert (apart["verdict"], apart["robustness"], apart["lower"], apart["upper"]) == ("unknown", *[None] * 3)
    assert apart["series"]["value"][0][:3] == apart["series"]["upper"][0][:3]
    assert apart["series"]["value"][0][3:] == [None] * 9
    assert soon["series"]["value"][0][0] is None


def test_an_undetermined_result_is_printed_without_an_interval(folder: Path) -> None:
    done = run_program(*REPLAY, "--semantics", "paper", cwd=folder)
    assert (done.returncode, done.stderr) == (4, "")
    _, *lines = done.stdout.splitlines()
    [apart] = [line for line in lines if line.startswith("  apart")]
    assert ["reach", "satisfied"] in [line.split()[:2] for line in lines]
    assert apart.startswith("  apart  unknown    robustness not determined, held so far at")


def test_an_annotated_log_names_its_semantics_and_is_replayed_with_the_default(folder: Path) -> None:
    record(run(), Path("run.mcap"))
    options = ("--spec", "blocks.spatial", "-o", "out.mcap", "--semantics", "paper")
    assert run_in_process(["replay", "run.mcap", *options]) == 4
    written = content_of(Path("out.mcap"))
    assert dict(written.metadata)[METADATA]["semantics"] == "paper"
    messages = [Robustness.FromString(message[-1]) for message in written.of(ROBUSTNESS)]
    for node in [node for each in messages if not each.final for node in each.nodes]:
        decided = SATISFIED if node.value >= 0 else VIOLATED
        assert node.standing == (UNKNOWN if math.isnan(node.value) else decided)
    assert run_in_process(["replay", "out.mcap", "-o", "again.mcap"]) == 4
    assert dict(content_of(Path("again.mcap")).metadata)[METADATA]["semantics"] == "ltlf"


def test_an_operator_outside_the_paper_is_wrong_usage(folder: Path) -> None:
    Path("past.spatial").write_text("spec fine = F (cube ovlp cube)\nspec past = G O (cube ovlp cube)\n")
    done = run_program("replay", "run.jsonl", "--spec", "past.spatial", "--semantics", "paper", cwd=folder)
    assert (done.returncode, done.stdout) == (2, "")
    fault = done.stderr.splitlines()[-1]
    assert (
        "past.spatial:2:15: the paper's semantics has no O, which past uses; write it with X, F, G and U"
        in fault
    )


def test_unknown_semantics_are_wrong_usage(folder: Path) -> None:
    assert run_program(*REPLAY, "--semantics", "stl", cwd=folder).returncode == 2
