"""Diffs of specifications and runs against one evaluation, and clips against the whole log."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

import spatial_replay as sr
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.logs.messages import Block
from spatial_replay.logs.source import BLOCK_SAMPLES, Source
from spatial_replay.recording.source_recording import record_source

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
SAMPLES = 100_000
LONG = 1_000_000


def _repeated(trace: sr.Trace, count: int) -> sr.Trace:
    """Return a run repeated several times, with times that continue."""
    length_ns = int(trace.times_ns[-1] - trace.times_ns[0]) + 33_000_000
    runs = [
        replace(trace, times_ns=trace.times_ns + index * length_ns)
        for index in range(-(-count // len(trace)))
    ]
    return sr.Trace.concatenate(runs).slice(0, count)


def bench_diff(measure: Any) -> None:
    """Two versions of the block-pushing specification over 100,000 samples, and two such runs."""
    data = Path(os.environ.get("SPATIAL_REPLAY_DATA", "")) / "paper"
    if not data.is_dir():
        return
    text = json.loads((data / "expected.json").read_text())["blocks_moving_passage"]["spec"]
    trace = _repeated(sr.read_trace(data / "blocks_moving_passage.jsonl.gz"), SAMPLES)
    old = sr.parse_specification(text)
    new = sr.parse_specification(text.replace("(red2 closeto blue2)", "(red2 closeto[60] blue2)"))
    moved = replace(trace, footprints=replace(trace.footprints, vertices=trace.footprints.vertices + 1.0))
    sr.diff_specifications(trace, old, new)
    sr.diff_logs(trace, moved, old)

    # in turn, so that other load on the machine slows all three equally
    times_s: dict[str, list[float]] = {"one evaluation": [], "two specifications": [], "two runs": []}
    for _ in range(5):
        for name, run in (
            ("one evaluation", partial(sr.evaluate, old, replace(trace))),
            ("two specifications", partial(sr.diff_specifications, replace(trace), old, new)),
            ("two runs", partial(sr.diff_logs, replace(trace), replace(moved), old)),
        ):
            started = perf_counter()
            run()
            times_s[name].append(perf_counter() - started)
    for name, taken in times_s.items():
        measure.quantile(name, taken, 0.5, unit="trace", limit_s=1.0 if name == "two runs" else None)
    pairs = zip(times_s["two specifications"], times_s["one evaluation"], strict=True)
    measure.ratio(
        "specifications to evaluation", float(np.median([one / other for one, other in pairs])), 1.5
    )


@dataclass(frozen=True)
class Passing(Source):
    """A source of a robot and a person who comes too near in one sample, generated block by block."""

    samples: int
    name: str = "passing"
    kind: str = "generated"

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        for begin in range(0, self.samples, BLOCK_SAMPLES):
            yield Block(self._trace(np.arange(begin, min(begin + BLOCK_SAMPLES, self.samples))))

    def _trace(self, samples: np.ndarray[Any, Any]) -> sr.Trace:
        x = 3.0 + np.cos(samples / 1000.0) - np.where(samples == self.samples // 3, 2.5, 0.0)
        person = [np.stack([x + right, np.full(len(x), up)], -1) for right, up in 0.5 * SQUARE]
        robot = np.broadcast_to(SQUARE, (len(x), 4, 2))
        count = 2 * len(samples)
        return sr.Trace(
            times_ns=samples * 10_000_000,
            names=("person", "robot"),
            rows=np.arange(count).reshape(-1, 2),
            footprints=FootprintBatch(
                part_start=np.arange(count + 1),
                vertex_start=4 * np.arange(count + 1),
                vertices=np.stack([np.stack(person, 1), robot], 1).reshape(-1, 2),
                radius=np.zeros(count),
                bottom=np.full(count, np.nan),
                top=np.full(count, np.nan),
            ),
            yaw=np.full(count, np.nan),
            uncertainty=np.zeros(count),
            class_code=np.zeros(count, np.int64),
            classes=(None,),
        )


def bench_clip(measure: Any) -> None:
    """A violated distance over a log of a million samples."""
    with tempfile.TemporaryDirectory() as folder:
        log, output = Path(folder, "run.mcap"), Path(folder, "bug.mcap")
        record_source(Passing(LONG), log)
        specification = sr.parse_specification("spec apart = G (robot dist person >= 0.5)")
        measure(
            "a million samples",
            lambda _: sr.clip_log(log, specification, output=output),
            unit="log",
            runs=1,
            limit_s=10.0,
        )
        measure.size("clip", output.stat().st_size, log.stat().st_size // 100)
