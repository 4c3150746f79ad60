"""Interpreted and compiled kernels give the same bits, so it never matters which of them ran."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, reject
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from laws.strategies_monitor import recordings, specifications
from spatial_replay.compiled import only
from spatial_replay.monitor.stream import EvaluationStream, find_instances
from spatial_replay.trace.trace import FOREVER

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
FORMS = ("interpreted", "compiled")


@examples(40)
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
    specification = sr.load_specification(RECORDINGS / f"{log.partition('.')[0]}_edited.spatial")

    def written():
        output = tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap"
        sr.replay_log(RECORDINGS / log, specification, output=output)
        return output.read_bytes()

    interpreted, compiled = in_both_forms(written)
    assert interpreted == compiled


def test_a_log_is_replayed_where_no_cache_can_be_written(tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, not a folder")
    environment = {"SPATIAL_REPLAY_CACHE": str(blocked), "HOME": str(blocked), "XDG_CACHE_HOME": str(blocked)}
    replay(RECORDINGS / "table.jsonl", "--spec", RECORDINGS / "table_edited.spatial", **environment)


_ONE_KERNEL = """
from spatial_replay.compiled import kernel, only

@kernel
def doubled(number):
    return 2 * number

with only("compiled"):
    print(doubled(2))
"""


def test_machine_code_lies_in_a_folder_of_its_own_sources(tmp_path):
    cache, program = tmp_path / "cache", tmp_path / "program.py"
    stale = cache / "kernels-0000000000000000"
    stale.mkdir(parents=True)
    (stale / "step.nbi").write_bytes(b"code of another version")
    program.write_text(_ONE_KERNEL)
    environment = os.environ | {"SPATIAL_REPLAY_CACHE": str(cache), "SPATIAL_REPLAY_KERNELS": ""}
    done = subprocess.run(
        [sys.executable, program], env=environment, capture_output=True, text=True, check=True
    )
    (used,) = set(cache.iterdir()) - {stale}
    assert (done.stdout, [each.suffix for each in used.rglob("*.nbi")]) == ("4\n", [".nbi"])
    assert (stale / "step.nbi").read_bytes() == b"code of another version"


def test_of_processes_that_need_a_kernel_at_once_one_compiles_it(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(_ONE_KERNEL + "print(sum(doubled.compiled_form().stats.cache_hits.values()))")
    environment = os.environ | {"SPATIAL_REPLAY_CACHE": str(tmp_path / "cache"), "SPATIAL_REPLAY_KERNELS": ""}
    begun = [
        subprocess.Popen([sys.executable, program], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    assert sorted(process.communicate()[0] for process in begun) == ["4\n0\n", "4\n1\n"]


def replay(*arguments, **environment):
    command = [sys.executable, "-m", "spatial_replay", "replay", *map(str, arguments)]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, ""), done.stderr


@pytest.mark.parametrize(
    "formula",
    [
        "(G p >= 0 <-> F not q >= 0) and (H[0,3] p >= 1 xor O q >= 2)",
        "G (p >= 1 -> F[0,700] q >= 1)",
        "G (p >= 1 -> F[0,2] G[0,3] q >= 1)",
        "G (p >= 1 -> F[0s,0.000000005s] (p >= 2 U[0s,0.00000002s] q >= 1))",
    ],
)
def test_a_long_log_at_once_has_the_bits_of_its_parts(formula):
    """Of a great many samples, more are run together than of few."""
    numbers = random.Random(0)
    specification = sr.parse_specification(formula)
    trace = sr.Trace.from_samples(
        sr.Sample(k, signals={"p": numbers.uniform(-1, 5), "q": numbers.uniform(-5, 3)}) for k in range(9000)
    )
    with only("compiled"):
        whole = sr.evaluate(specification, trace).result()
        stream = EvaluationStream(find_instances(specification, {}, [trace], 0, FOREVER), {})
        ends = [0, 1, 700, 4000, 8500, 9000]
        parts = [stream.extend(trace.slice(*cut))[0] for cut in pairwise(ends)]
    series = np.concatenate([each.series for each in parts], axis=2)
    assert series.tobytes() == whole.series.tobytes()
    assert stream.streams[0].final.tobytes() == whole.final.tobytes()
