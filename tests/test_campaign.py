"""Attacks on the program: what they once found stays mended, and a short run of each finds nothing."""

from __future__ import annotations

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
    outcome = run_cases(Damage(), "test", goes_on=lambda number: number < 40)
    assert outcome.problems == []
    assert outcome.counts["cases"] == 40


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


def test_processes_are_attacked_by_a_campaign(tmp_path: Path) -> None:
    command = [str(ROOT / "tools" / "campaign"), "--only", "kills,names,interrupts", "--cases", "1"]
    ended = subprocess.run(
        [sys.executable, *command, "--findings", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    rows = [line.split("|")[1:4] for line in ended.stdout.splitlines()[-3:]]
    assert [[cell.strip() for cell in row] for row in rows] == [
        [name, "1", "0"] for name in ("kills", "names", "interrupts")
    ]


class _Broken:
    """An attack on a program that fails at a word."""

    name = "broken"
    most_cpu_s = None

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
