"""Interpreted and compiled kernels give the same bits, so it never matters which of them ran."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st

import spatial_replay as sr
from laws.strategies_monitor import recordings, specifications
from spatial_replay.compiled import only

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
FORMS = ("interpreted", "compiled")


@settings(max_examples=40)
@given(specifications(), recordings(), st.sampled_from(["ltlf", "paper"]))
def test_an_evaluation_has_the_same_bits(specification, recording, semantics):
    each = {"ego": "all"} if specification.specs[0].parameter else None

    def numbers():
        # a new trace each time, since measurements are cached with a trace
        trace = sr.Trace.from_samples(recording.samples)
        evaluation = sr.evaluate(specification, trace, each=each, semantics=semantics)
        series = [result.series.tobytes() for result in evaluation]
        return series if semantics == "paper" else [*series, *(r.full_signal().tobytes() for r in evaluation)]

    try:
        interpreted, compiled = in_both_forms(numbers)
    except sr.UsageError:
        # the paper's semantics knows X, F, G and U only
        assert semantics == "paper"
        reject()
    assert interpreted == compiled


def in_both_forms(function):
    results = []
    for form in FORMS:
        with only(form):
            results.append(function())
    return results


@pytest.mark.parametrize("log", ["push.mcap", "table.jsonl"])
def test_an_annotated_log_has_the_same_bytes(log, tmp_path):
    written = []
    for form in FORMS:
        output = tmp_path / f"{form}.mcap"
        specification = RECORDINGS / f"{log.partition('.')[0]}_edited.spatial"
        replay(RECORDINGS / log, "--spec", specification, "-o", output, SPATIAL_REPLAY_KERNELS=form)
        written.append(output.read_bytes())
    assert written[0] == written[1]


def test_a_log_is_replayed_where_no_cache_can_be_written(tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, not a folder")
    environment = {"SPATIAL_REPLAY_CACHE": str(blocked), "HOME": str(blocked), "XDG_CACHE_HOME": str(blocked)}
    replay(RECORDINGS / "table.jsonl", "--spec", RECORDINGS / "table_edited.spatial", **environment)


def test_machine_code_lies_in_a_folder_of_its_own_sources(tmp_path):
    stale = tmp_path / "kernels-0000000000000000"
    stale.mkdir()
    (stale / "step.nbi").write_bytes(b"code of another version")
    cache = {"SPATIAL_REPLAY_CACHE": str(tmp_path), "SPATIAL_REPLAY_KERNELS": "compiled"}
    replay(RECORDINGS / "table.jsonl", "--spec", RECORDINGS / "table_edited.spatial", **cache)
    (used,) = set(tmp_path.iterdir()) - {stale}
    assert list(used.rglob("*.nbi"))
    assert (stale / "step.nbi").read_bytes() == b"code of another version"


def replay(*arguments, **environment):
    command = [sys.executable, "-m", "spatial_replay", "replay", *map(str, arguments)]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, ""), done.stderr
