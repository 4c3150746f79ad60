"""Attacks on the program: what they once found stays mended, and a short run of each finds nothing."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest

from attacks.cases import Case, Outcome, keep, read_finding, run_case, run_cases
from attacks.clients import Clients
from attacks.damage import Damage
from attacks.texts import Texts

ROOT = Path(__file__).parents[1]
FINDINGS = sorted((ROOT / "tests" / "campaign_findings").glob("*.json"))


@pytest.mark.parametrize("path", FINDINGS, ids=lambda path: path.stem)
def test_what_was_found_stays_mended(path: Path) -> None:
    from attacks.every import ATTACKS

    name, case = read_finding(path)
    attack = ATTACKS[name]()
    assert run_case(attack, case, is_timed=False).problems == []


def test_damaged_logs_end_in_typed_errors_and_change_no_verdict_silently() -> None:
    outcome = run_cases(Damage(), "test", goes_on=lambda number: number < 16)
    assert outcome.problems == []
    assert outcome.counts["cases"] == 16


def test_texts_are_parsed_or_refused_with_typed_errors() -> None:
    outcome = run_cases(Texts(), "test", goes_on=lambda number: number < 300)
    assert outcome.problems == []
    assert outcome.counts["valid"] >= 100


def test_hostile_clients_leave_the_server_to_the_next_viewer() -> None:
    attack = Clients()
    try:
        assert run_cases(attack, "test", goes_on=lambda number: number < 10).problems == []
    finally:
        attack.close()


def campaign(*arguments: str) -> str:
    """Run the tool in a process of its own, which forks others."""
    command = [sys.executable, str(ROOT / "tools" / "campaign"), *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def test_hostile_names_and_interruptions_leave_nothing_behind(tmp_path: Path) -> None:
    printed = campaign("--only", "names,interrupts", "--cases", "1", "--findings", str(tmp_path))
    rows = [[cell.strip() for cell in line.split("|")[1:4]] for line in printed.splitlines()[-2:]]
    assert rows == [["names", "1", "0"], ["interrupts", "1", "0"]]


def test_what_a_killed_recorder_wrote_a_second_before_is_in_its_log(tmp_path: Path) -> None:
    recorder = {"rate_hz": 100, "objects": 2, "specified": True, "beside": True}
    case = {"recorders": [recorder, recorder], "seconds": 1.5, "busy": 0}
    path = tmp_path / "kills.json"
    path.write_text(json.dumps({"attack": "kills", "found": [], "case": case}))
    figures = json.loads(campaign("--replay", str(path)))
    assert figures["problems"] == []
    assert figures["counts"]["kills"] == 2


class _Broken:
    """An attack on a program that fails at a word."""

    name = "broken"
    most_cpu_s = None
    uses_files = False

    def ready(self) -> None:
        pass

    def draw(self, rng: random.Random) -> Case:
        return {"word": rng.choice(("sound", "wrong"))}

    def run(self, case: Case, folder: Path) -> Outcome:
        if case["word"] == "wrong":
            raise ZeroDivisionError("division by zero")
        return Outcome()

    def kept(self, case: Case, folder: Path) -> Case:
        return case


def test_what_an_attack_finds_is_a_file_that_runs_it_again(tmp_path: Path) -> None:
    outcome = run_cases(_Broken(), "7", goes_on=lambda number: number < 20, findings=tmp_path)
    assert 0 < outcome.counts["findings"] < 20
    (path,) = tmp_path.glob("*.json")
    name, case = read_finding(path)
    assert (name, case) == ("broken", {"word": "wrong"})
    assert run_case(_Broken(), case, is_timed=False).problems == ["ZeroDivisionError: division by zero"]
    assert keep(_Broken(), case, ["ZeroDivisionError: division by zero"], tmp_path) == path
