"""Tuning of constants over many logs, and evaluation of a saved specification."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import spatial_replay as sr
from spatial_replay.logs.source import MemorySource
from spatial_replay.recording.source_recording import record_source
from spatial_replay.replay.loaded_log import LoadedLog
from spatial_replay.trace.trace import Trace
from spatial_replay.tuning.tuned import Tuning

LOGS, FEW_LOGS = 1_000, 50
SEVERAL, FEW_SEVERAL = 100, 10
"""Numbers of logs with and without --full; figures are for one log."""

ONE = """
const near = 70 in [0, 400]
spec passed = (G ((red1 dist blue1 >= near) or (red1 below blue1))) or (F (red2 ovlp blue2))
spec met = F (green1 dist blue1 >= near)
"""
FIVE = """
const near = 150 in [0, 400]
const far = 30 in [0, 200]
const soon = 20s in [0s, 52s]
const grow = 5 in [0, 60]
const lane = 200 in [0, 900]
spec met = F[0s, soon] (red1 dist blue1 <= near)
spec apart = G (red2 dist green2 >= far)
spec swept = F (green1 ovlp enlarge(blue1, grow))
spec seen = F (red1 dist blue2 <= lane)
"""


def bench_tune(measure: Any) -> None:
    """One constant over MCAP logs, including reading and measuring."""
    trace = _trace()
    if trace is None:
        return
    count = LOGS if measure.full else FEW_LOGS
    specification = sr.parse_specification(ONE)
    with tempfile.TemporaryDirectory() as folder:
        logs = []
        for number in range(count):
            logs.append(Path(folder) / f"{number}.mcap")
            record_source(MemorySource(_shifted(trace, number)), logs[-1])
        measure(
            "one constant, from files",
            lambda _: sr.tune(specification, logs),
            per=count,
            unit="log",
            runs=1,
            limit_s=60.0 / LOGS,
        )


def bench_tune_several(measure: Any) -> None:
    """Five constants at once, over good and bad runs in memory."""
    trace = _trace()
    if trace is None:
        return
    count = SEVERAL if measure.full else FEW_SEVERAL
    specification = sr.parse_specification(FIVE)
    good = [_shifted(trace, number % 30) for number in range(count // 2)]
    bad = [_spoilt(trace, number) for number in range(count // 2)]
    measure(
        f"five constants, {count} logs",
        lambda _: _found(sr.tune(specification, good, bad)),
        unit="search",
        runs=1,
        warmups=1,
        limit_s=60.0,
    )


def bench_watch(measure: Any) -> None:
    """The block-pushing specification saved with another threshold, and with another operator."""
    trace = _trace()
    if trace is None:
        return
    samples = 100_000
    length_ns = int(trace.times_ns[-1]) + 33_333_333
    repeated = [replace(trace, times_ns=trace.times_ns + part * length_ns) for part in range(64)]
    long = Trace.concatenate(repeated).slice(0, samples)
    text = json.loads((_data() / "expected.json").read_text())["blocks_moving_passage"]["spec"]
    loaded = LoadedLog(MemorySource(long), [sr.parse_specification(text)])
    loaded.evaluate()
    edits = {
        "saved, a threshold edited": text.replace("closeto ", "closeto[65] "),
        "saved, an operator edited": text.replace("F (red2", "F[0,inf] (red2"),
    }
    for name, edited in edits.items():
        file = sr.parse_specification(edited)
        measure(
            name,
            lambda _, file=file: loaded.with_files([file]).evaluate().replayed,
            unit="save",
            runs=7,
            limit_s=0.1,
        )


def _found(tuning: Tuning) -> Tuning:
    if not tuning.is_found:
        raise RuntimeError("the benchmark of five constants has values that fit, and they were not found")
    return tuning


def _data() -> Path:
    return Path(os.environ.get("SPATIAL_REPLAY_DATA", "")) / "paper"


def _trace() -> Trace | None:
    path = _data() / "blocks_moving_passage.jsonl.gz"
    return sr.read_trace(path) if path.exists() else None


def _shifted(trace: Trace, number: int) -> Trace:
    """Return the recording, rotated to begin at another sample."""
    return replace(trace, rows=np.roll(trace.rows, -31 * number, axis=0))


def _spoilt(trace: Trace, number: int) -> Trace:
    """Return the recording with blocks that meet later, or with a block that does not move."""
    shift, kind = divmod(number, 3)
    if kind == 0:
        return _shifted(trace, -1 - shift % 14)
    rows = trace.rows.copy()
    still = trace.names.index("red1" if kind == 1 else "green1")
    rows[:, still] = rows[0, still]
    return _shifted(replace(trace, rows=rows), shift % 30)
