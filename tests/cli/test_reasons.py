"""What `replay` and `explain` say about why a verdict is what it is, and about what decided nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from spatial_replay.cli import run

LOG = Path(__file__).parent.parent.parent / "recordings" / "table.jsonl"
MISSION = """\
spec safe = G (cup dist plate >= 0.2)
spec goal = F (fork ovlp plate)
spec mission "REQ-7: done and safe" = safe and goal
"""
IDLE = """\
spec late = G[60s, 90s] (cup ovlp plate)
spec polite = G (cup ovlp plate -> fork ovlp plate)
spec calm = G (forall d in class "dragon": d ovlp plate)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mission.spatial").write_text(MISSION)
    (tmp_path / "idle.spatial").write_text(IDLE)
    return tmp_path


def _document(folder: Path, spec: str, *options: str) -> tuple[int, dict[str, Any]]:
    code = run(["replay", str(LOG), "--spec", spec, *options, "--json", "out.json"])
    loaded: dict[str, Any] = json.loads((folder / "out.json").read_text())
    return code, loaded


def test_every_failing_spec_has_a_cause_and_the_settled_one_is_the_worst(folder: Path) -> None:
    code, document = _document(folder, "mission.spatial")
    (mission,) = document["specifications"]
    assert (code, mission["verdict"]) == (1, "violated")
    assert [each["spec"] for each in mission["causes"]] == ["safe", "goal"]
    settled, pending = mission["causes"]
    assert settled["settled_ns"] == mission["violated_at_ns"] == 5_533_333_333
    assert pending["settled_ns"] is None, "only the end of the log decided that the goal was missed"
    assert mission["worst"] == settled["witness"]
    assert mission["worst"]["atom"]["text"] == "cup dist plate >= 0.2"
    assert mission["worst"]["time_ns"] == mission["violated_at_ns"]
    assert mission["satisfied_at_ns"] is None


def test_the_text_says_when_a_violation_became_certain_and_why(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", str(LOG), "--spec", "mission.spatial"]) == 1
    printed = capsys.readouterr().out
    _, first, title, safe, goal = printed.splitlines()
    assert "mission [REQ-7]  violated" in first
    assert "certain since 5.533333333s" in first
    assert title.strip() == "done and safe"
    assert safe.strip().startswith("safe at 5.533333333s: `cup dist plate >= 0.2` fails by ")
    assert goal.strip().startswith("goal: `fork ovlp plate` fails by ")
    assert "first satisfied" not in printed


def test_the_requirement_is_in_the_document(folder: Path) -> None:
    (mission,) = _document(folder, "mission.spatial")[1]["specifications"]
    assert (mission["requirement"], mission["title"]) == ("REQ-7", "done and safe")


def test_explain_lists_every_failing_spec_the_settled_one_first(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["explain", str(LOG), "--spec", "mission.spatial"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "REQ-7: done and safe"
    assert lines[1].startswith("`mission` is violated: robustness -0.144867, certain since 5.533 s")
    assert lines[2] == "`safe` is violated since 5.533 s, whatever came after."
    assert any(line.startswith("`goal` is violated: ") for line in lines[3:])


def test_explain_names_the_part_with_the_least_robustness(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "stopped.spatial").write_text(
        "spec safe = G (cup dist plate >= 0.06)\nspec goal = F (fork dist cup >= 5)\nspec s = safe and goal\n"
    )
    assert run(["explain", str(LOG), "--spec", "stopped.spatial"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("(the least robustness is that of `goal`).")
    assert lines[1].startswith("`safe` is violated since ")


def test_a_named_part_is_explained_by_what_settled_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["explain", str(LOG), "--spec", "mission.spatial", "--node", "safe"]) == 1
    assert capsys.readouterr().out.startswith("`safe` is violated since 5.533 s, whatever came after.")


def test_parts_that_decided_nothing_are_marked_and_can_fail_a_gate(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, document = _document(folder, "idle.spatial")
    assert code == 0
    reasons = {
        each["name"]: [part["reason"] for part in each["vacuous"]] for each in document["specifications"]
    }
    assert reasons == {
        "late": ["empty window"],
        "polite": ["antecedent never held"],
        "calm": ["no members"],
    }
    assert capsys.readouterr().out.count("vacuous: `") == 3
    assert _document(folder, "idle.spatial", "--fail-on", "vacuous")[0] == 1


def test_a_template_without_objects_is_vacuous(folder: Path) -> None:
    (folder / "t.spatial").write_text(
        "spec near(t) = G (t dist plate >= 0)\nspec s = F (cup dist plate >= 0)\n"
    )
    none = ("--each", "t=class:drink", "--to", "2s")
    code, document = _document(folder, "t.spatial", *none)
    assert code == 0
    assert [(each["reason"], each["text"]) for each in document["vacuous"]] == [("no instances", "near(t)")]
    assert _document(folder, "t.spatial", *none, "--fail-on", "vacuous")[0] == 1


def test_an_unknown_verdict_can_fail_a_gate(folder: Path) -> None:
    (folder / "unknown.spatial").write_text("spec s = G (cupp ovlp plate)\n")
    assert _document(folder, "unknown.spatial")[0] == 4
    assert _document(folder, "unknown.spatial", "--fail-on", "vacuous,unknown")[0] == 1
    assert _document(folder, "mission.spatial", "--fail-on", "vacuous,unknown")[0] == 1


def test_a_kind_of_failure_that_there_is_not_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["replay", str(LOG), "--spec", "idle.spatial", "--fail-on", "vacous"]) == 2
    assert "--fail-on: 'vacous' is not a kind of failure; did you mean 'vacuous'?" in capsys.readouterr().err
