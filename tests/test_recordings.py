"""The recordings that ship with the project, and what is expected of them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from spatial_replay import Verdict, evaluate, load_specification, read_trace
from spatial_replay.cli import run as run_in_process

ROOT = Path(__file__).resolve().parent.parent
RECORDINGS = ROOT / "recordings"
EXPECTED = {
    file: (document["log"], results)
    for document in (
        json.loads(path.read_text(encoding="utf-8")) for path in RECORDINGS.glob("*.expected.json")
    )
    for file, results in document["specifications"].items()
}


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_every_result_is_as_expected(name):
    log, results = EXPECTED[name]
    evaluation = evaluate(load_specification(RECORDINGS / name), read_trace(RECORDINGS / log))
    assert results == {
        result.name: {
            "verdict": result.verdict,
            "robustness": pytest.approx(result.robustness, abs=1e-6),
            "first_satisfied_ns": result.first_satisfied_ns,
        }
        for result in evaluation
    }


@pytest.mark.parametrize(("name", "log"), [("table", "table.jsonl"), ("push", "push.mcap")])
def test_the_edited_specification_flips_the_verdict(name, log):
    trace = read_trace(RECORDINGS / log)
    original = evaluate(load_specification(RECORDINGS / f"{name}.spatial"), trace)
    edited = evaluate(load_specification(RECORDINGS / f"{name}_edited.spatial"), trace)
    assert (original.verdict, edited.verdict) == (Verdict.SATISFIED, Verdict.VIOLATED)


def test_an_object_comes_into_view_late():
    first = next(iter(read_trace(RECORDINGS / "table.jsonl").samples()))
    assert "milk" not in first.objects
    assert "milk" in read_trace(RECORDINGS / "table.jsonl").names


def test_the_decisions_of_the_planned_push_are_printed(capsys):
    log = str(RECORDINGS / "push.mcap")
    assert run_in_process(["info", log, "--decisions"]) == 0
    printed = capsys.readouterr().out
    # all at once is given up; then two pushes
    assert "3 decisions for 'push', 2 motions" in printed
    assert "given up: 0 -> 3: no object can do it" in printed
    assert printed.index("push red at") < printed.index("push green at")
    assert "    green (map 0): rejected, no place is good enough" in printed


def test_the_script_reproduces_the_committed_files():
    command = [sys.executable, str(ROOT / "tools" / "make_recordings"), "--check"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout + result.stderr) == (0, "")


def test_recorded_logs_verify_whole_with_their_decisions(capsys):
    for log in sorted(RECORDINGS.glob("*.mcap")):
        assert run_in_process(["verify", str(log), "--decisions"]) == 0
        said = capsys.readouterr()
        assert "samples, messages, specifications and results match" in said.out
        assert "3 decisions recomputed with 9 maps, all match" in said.out
        assert "not covered" not in said.out + said.err
