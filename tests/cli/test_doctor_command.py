"""`doctor` says what is wrong with a specification, and writes runs that can be looked at."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from spatial_replay.cli import run

SOUND = """region tray = polygon((0, 0), (2, 0), (1, 2))
spec served "REQ-3: the cup is served" =
    (cup leftof plate) U (cup enclosedin tray and cup oriented[0.1] plate)
spec calm = G (cup dist plate >= 0.2 -> X (cup dist plate >= 0.1))
"""
WRONG = "spec torn = F (red leftof blue and blue leftof red)\n"


def doctor(folder: Path, text: str, *options: str) -> int:
    (folder / "s.spatial").write_text(text)
    return run(["doctor", str(folder / "s.spatial"), *options])


def test_a_sound_specification_exits_with_0(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor(tmp_path, SOUND) == 0
    said = capsys.readouterr()
    assert said.out.startswith("served\n  satisfied by 1 sample, robustness ")
    assert "\n    0  cup enclosedin tray and cup oriented[0.1] plate\n" in said.out
    assert said.out.endswith("\nnothing found\n")
    assert said.err == ""


def test_a_finding_exits_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor(tmp_path, WRONG) == 1
    said = capsys.readouterr().out
    assert said.startswith(
        "s.spatial:1:6: warning: no run satisfies torn: "
        "`red leftof blue` and `blue leftof red` exclude each other\n"
    )
    assert "torn\n  satisfied by no run\n  violated by 1 sample, robustness " in said
    assert said.endswith("1 finding in 1 result\n")


def test_the_files_of_shortest_runs_are_recorded_and_replayed_to_their_verdicts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert doctor(tmp_path, SOUND, "-o", str(tmp_path / "runs")) == 0
    files = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert files == [
        f"{name}.{verdict}.jsonl" for name in ("calm", "served") for verdict in ("satisfied", "violated")
    ]
    for name in files:
        log = tmp_path / "run.mcap"
        assert run(["record", "tracks", str(tmp_path / "runs" / name), "-o", str(log)]) == 0
        capsys.readouterr()
        assert run(["replay", str(log), "--spec", str(tmp_path / "s.spatial"), "--json", "-"]) in (0, 1)
        document = json.loads(capsys.readouterr().out)
        spec, verdict, _ = name.split(".")
        verdicts = {each["name"]: each["verdict"] for each in document["specifications"]}
        assert verdicts[spec] == verdict


def test_a_run_that_is_not_shown_says_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor(tmp_path, "spec late = F[3s, 4s] (mode == 3)\n") == 0
    said = capsys.readouterr().out
    assert "\n  satisfied: no run is shown, since without an automaton runs are guesses, " in said


def test_json_has_findings_and_tracks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor(tmp_path, WRONG, "--json") == 1
    document = json.loads(capsys.readouterr().out)
    (finding,) = document["findings"]
    assert (finding["kind"], finding["specifications"], finding["line"], finding["column"]) == (
        "unsatisfiable",
        ["torn"],
        1,
        6,
    )
    assert finding["exclusions"] == [["red leftof blue", "blue leftof red"]]
    (spec,) = document["specifications"]
    assert spec["automaton"] is True
    assert spec["satisfied"] is None
    assert [each["name"] for each in spec["violated"]["tracks"][0]["objects"]] == ["blue", "red"]


def test_findings_are_annotations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor(tmp_path, WRONG, "--format", "github") == 1
    assert "line=1,col=6::no run satisfies torn: " in capsys.readouterr().out
    assert doctor(tmp_path, WRONG, "--format", "sarif") == 1
    (result,) = json.loads(capsys.readouterr().out)["runs"][0]["results"]
    assert result["message"]["text"].startswith("no run satisfies torn: ")
    assert doctor(tmp_path, "spec torn = F (\n", "--format", "github") == 2
    assert capsys.readouterr().out.startswith("::error ")
    assert doctor(tmp_path, WRONG, "--json", "--format", "sarif") == 2


def test_check_warns_of_what_doctor_finds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "s.spatial").write_text(WRONG)
    assert run(["check", str(tmp_path / "s.spatial")]) == 0
    said = capsys.readouterr()
    assert "s.spatial:1:6: warning: no run satisfies torn: " in said.err
    assert said.out.startswith("spec torn\n")


def test_constants_are_replaced_before_anything_is_examined(tmp_path: Path) -> None:
    text = "const near = 0.1\nconst far = 0.2\nspec s = F (a dist b <= near and a dist b >= far)\n"
    assert doctor(tmp_path, text) == 1
    assert doctor(tmp_path, text, "--const", "near=0.3") == 0
