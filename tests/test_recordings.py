"""The recordings that ship with the project, and what is expected of them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from spatial_replay.logs.source import read_trace
from spatial_replay.monitor.evaluation import evaluate
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.spec.specification import load_specification

ROOT = Path(__file__).resolve().parent.parent
RECORDINGS = ROOT / "recordings"
EXPECTED = json.loads((RECORDINGS / "table.expected.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", sorted(EXPECTED["specifications"]))
def test_every_result_is_as_expected(name):
    evaluation = evaluate(load_specification(RECORDINGS / name), read_trace(RECORDINGS / EXPECTED["log"]))
    assert EXPECTED["specifications"][name] == {
        result.name: {
            "verdict": result.verdict,
            "robustness": pytest.approx(result.robustness, abs=1e-6),
            "first_satisfied_ns": result.first_satisfied_ns,
        }
        for result in evaluation
    }


def test_the_edit_turns_the_verdict():
    trace = read_trace(RECORDINGS / "table.jsonl")
    original = evaluate(load_specification(RECORDINGS / "table.spatial"), trace)
    edited = evaluate(load_specification(RECORDINGS / "table_edited.spatial"), trace)
    assert (original.verdict, edited.verdict) == (Verdict.SATISFIED, Verdict.VIOLATED)


def test_an_object_comes_into_view_late():
    first = next(iter(read_trace(RECORDINGS / "table.jsonl").samples()))
    assert "milk" not in first.objects
    assert "milk" in read_trace(RECORDINGS / "table.jsonl").names


def test_the_script_makes_the_files_that_are_there():
    command = [sys.executable, str(ROOT / "tools" / "make_recordings"), "--check"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout + result.stderr) == (0, "")
