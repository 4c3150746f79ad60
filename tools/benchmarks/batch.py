"""Many logs: two workers against one, what a log costs beyond its evaluation, and very many results."""

from __future__ import annotations

import json
import os
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import spatial_replay as sr
from spatial_replay.batch.rows import Task, rows_from_task
from spatial_replay.batch.run import prepare, read_specification_text, run_batch
from spatial_replay.batch.run_table import worst_rows
from spatial_replay.batch.store import ResultsFolder, run_columns
from spatial_replay.batch.suite import Suite
from spatial_replay.batch.workers import LocalProcesses, ThisProcess, Workers
from spatial_replay.compiled import only
from spatial_replay.logs.messages import MemorySource
from spatial_replay.recording.recorder import record_source

LOGS, FEW_LOGS, BARE_LOGS = 1_000, 16, 400
ROWS = 100_000
TWO_MORE = "spec apart = G (red1 dist blue1 >= -20)\nspec near = F (red1 dist blue1 <= 400)\n"


def bench_batch(bench: Any) -> None:
    """Logs of 1,579 samples under three specs."""
    data = Path(os.environ.get("SPATIAL_REPLAY_DATA", "")) / "paper"
    if not data.is_dir():
        bench.remark("no recording of the blocks")
        return
    count = LOGS if bench.full else FEW_LOGS
    trace = sr.read_trace(data / "blocks_moving_passage.jsonl.gz")
    text = json.loads((data / "expected.json").read_text())["blocks_moving_passage"]["spec"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        spec = folder / "blocks.spatial"
        spec.write_text(f"{text.rstrip()}\n{TWO_MORE}")
        (folder / "logs").mkdir()
        for number in range(count):
            own = replace(trace, times_ns=trace.times_ns + number)
            record_source(MemorySource(own), folder / f"logs/{number:04}.mcap")
        suite = Suite("logs", folder, Suite.of_logs(["logs"], [spec]).cases)

        few = Suite("few", folder, Suite.of_logs(["logs/000*.mcap"], [spec]).cases)

        def run(workers: Workers, results: str, suite: Suite = suite) -> float:
            return _seconds(lambda: run_batch(prepare(suite), folder / results, workers))

        text = read_specification_text(spec)
        tasks = [Task(str(log), (text,)) for log in sorted((folder / "logs").iterdir())]
        # logs of their own, before and after, because the speed of a machine drifts
        halves = tasks[:BARE_LOGS:2], tasks[1:BARE_LOGS:2]

        def bare(half: Sequence[Task]) -> float:
            return _seconds(lambda: [rows_from_task(task) for task in half])

        # everything is compiled and loaded by the first few
        with only("compiled"):
            run(ThisProcess(), "few", few)
            before = _memory()
            bare_s = bare(halves[0])
            after = _memory()
            one_s = run(ThisProcess(), "one")
            bare_s = (bare_s + bare(halves[1])) / sum(map(len, halves))
        bench.quantile("reading and evaluating", [bare_s], 0.5, unit="log")
        bench.quantile("in this process", [one_s / count], 0.5, unit="log")
        bench.quantile("beyond its evaluation", [one_s / count - bare_s], 0.5, unit="log", limit_s=0.005)
        bench.ratio("memory after many to after ten", after / before, 1.1)
        # a process of its own loads its code first, be there one or two
        worker_s, two_s = run(LocalProcesses(1), "worker"), run(LocalProcesses(2), "two")
        bench.quantile("one worker", [worker_s / count], 0.5, unit="log")
        bench.quantile("two workers", [two_s / count], 0.5, unit="log")
        bench.ratio("two workers to half of one", 2.0 * two_s / worker_s, 2.0 / 1.8)
        bench.quantile("nothing new", [run(LocalProcesses(2), "two")], 0.5, unit="run", limit_s=2.0)


def bench_results(bench: Any) -> None:
    """The worst ten of very many rows, from the file."""
    import numpy as np
    import pyarrow as pa

    numbers = np.random.default_rng(1).normal(1.0, 0.5, ROWS)
    place = np.arange(ROWS)
    known = {
        "key": [f"{number:032x}" for number in place],
        "log": [f"logs/{number // 3:06}.mcap" for number in place],
        "spec": [f"spec{number % 3}" for number in place],
        "robustness": numbers,
        "verdict": np.where(numbers < 0.0, "violated", "satisfied"),
        "failure": [None if number >= 0.0 else "violated, expected satisfied" for number in numbers],
        "reason": [f"`a dist b >= 1` decides by {number:.6g}: a and b are apart." for number in numbers],
    }
    schema = run_columns()
    columns = {each.name: known.get(each.name, pa.nulls(ROWS, each.type)) for each in schema}
    with tempfile.TemporaryDirectory() as folder:
        results = ResultsFolder.create(Path(folder) / "results")
        results.write_run(pa.table(columns, schema=schema))
        bench.measure(
            f"worst ten of {ROWS:,} rows",
            lambda _: worst_rows(ResultsFolder.open(results.location).read_run(), 10),
            unit="search",
            runs=5,
            limit_s=1.0,
        )


def _memory() -> int:
    """The memory of this process now, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
