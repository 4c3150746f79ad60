"""Many logs: two workers against one, the cost of a log beyond its evaluation, and very many results."""

from __future__ import annotations

import gzip
import json
import os
import random
import resource
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import spatial_replay as sr
from spatial_replay.batch.rows import Task, rows_from_task
from spatial_replay.batch.run import prepare, read_specification_text, run_batch
from spatial_replay.batch.run_table import worst_rows
from spatial_replay.batch.store import ResultsFolder, run_columns
from spatial_replay.batch.suite import Conditions, Suite
from spatial_replay.batch.workers import LocalProcesses, ThisProcess, Workers
from spatial_replay.compiled import only
from spatial_replay.logs.source import MemorySource
from spatial_replay.recording.source_recording import record_source

LOGS, FEW_LOGS, BARE_LOGS = 1_000, 16, 400
ROWS = 100_000
SHORT_LOGS, EPISODES = 100, 200
FOUR_SPECS = """\
spec stays   = F (G (a dist b <= 0.3))
spec apart   = G (a dist c >= 0.001)
spec near    = F[0,5s] (b dist c <= 0.4)
spec answers = G ((a dist b <= 0.2) -> F (a leftof c or c leftof a))
"""
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
        # separate logs before and after, because the speed of a machine drifts
        halves = tasks[:BARE_LOGS:2], tasks[1:BARE_LOGS:2]

        def bare(half: Sequence[Task]) -> float:
            return _seconds(lambda: [rows_from_task(task) for task in half])

        # the first logs compile and load everything
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
        # each worker process loads its code first, also a single one
        worker_s, two_s = run(LocalProcesses(1), "worker"), run(LocalProcesses(2), "two")
        bench.quantile("one worker", [worker_s / count], 0.5, unit="log")
        bench.quantile("two workers", [two_s / count], 0.5, unit="log")
        bench.ratio("two workers to half of one", 2.0 * two_s / worker_s, 2.0 / 1.8)
        bench.quantile("nothing new", [run(LocalProcesses(2), "two")], 0.5, unit="run", limit_s=2.0)


def bench_short_logs(bench: Any) -> None:
    """Logs of 200 samples of three boxes under four specs, in this process."""
    rng = random.Random(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "four.spatial").write_text(FOUR_SPECS)
        for number in range(SHORT_LOGS):
            write_short_log(folder / f"logs/{number:04}.jsonl.gz", rng)
        runs = iter(range(1_000))

        def run(_: Any) -> None:
            logs = Suite.of_logs(["logs"], [folder / "four.spatial"]).cases
            run_batch(prepare(Suite("logs", folder, logs)), folder / f"results-{next(runs)}", ThisProcess())

        bench.measure("batch, nothing explained", run, per=SHORT_LOGS, unit="log", runs=5, warmups=3)


def write_short_log(path: Path, rng: random.Random) -> None:
    """Write a log in which three boxes move to random places."""
    starts, goals = ([[rng.uniform(-0.3, 0.3) for _ in range(2)] for _ in range(3)] for _ in range(2))
    lines = []
    for step in range(200):
        share = min(1.0, step / 150)
        objects = []
        for box, start, goal in zip("abc", starts, goals, strict=True):
            x, y = (begin + (end - begin) * share for begin, end in zip(start, goal, strict=True))
            corners = [[x + dx, y + dy] for dx, dy in ((0.0, 0.0), (0.06, 0.0), (0.06, 0.06), (0.0, 0.06))]
            objects.append({"name": box, "polygon": corners})
        lines.append(json.dumps({"time_ns": step * 50_000_000, "objects": objects}))
    path.parent.mkdir(exist_ok=True)
    with gzip.open(path, "wt") as stream:
        stream.write("\n".join(lines))


def bench_episodes(bench: Any) -> None:
    """Episodes of a LeRobot data set, 200 frames of three objects under four specs, in this process."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_data_set(folder / "push", EPISODES)
        (folder / "four.spatial").write_text(FOUR_SPECS)
        objects = [
            f"    - {{name: {it}, position: [{it}_x, {it}_y], shape: {{disc: 0.02}}}}\n" for it in "abc"
        ]
        (folder / "push.yaml").write_text(f"features:\n  state:\n{''.join(objects)}")
        conditions = Conditions(mapping=str(folder / "push.yaml"))
        suite = Suite.of_logs(["push"], [folder / "four.spatial"], conditions)
        runs = iter(range(1_000))

        def run(_: Any) -> None:
            cases = prepare(Suite("episodes", folder, suite.cases))
            run_batch(cases, folder / f"results-{next(runs)}", ThisProcess())

        with only("compiled"):
            bench.measure("batch", run, per=EPISODES, unit="episode", runs=3, warmups=2)


def write_data_set(folder: Path, episodes: int) -> None:
    """Write a data set of LeRobot v3.0 in which three objects wander, in one file."""
    import numpy as np
    import pyarrow as pa
    from pyarrow import parquet

    frames = 200
    places = [f"{name}_{axis}" for name in "abc" for axis in "xy"]
    steps = np.random.default_rng(1).normal(0.0, 0.01, (episodes, frames, len(places)))
    state = np.cumsum(steps, axis=1).reshape(-1, len(places)).astype(np.float32)
    columns = {
        "state": pa.array(list(state), pa.list_(pa.float32())),
        "frame_index": np.tile(np.arange(frames), episodes),
        "episode_index": np.repeat(np.arange(episodes), frames),
    }
    about = {
        "episode_index": np.arange(episodes),
        "length": np.full(episodes, frames),
        "data/chunk_index": np.zeros(episodes, np.int64),
        "data/file_index": np.zeros(episodes, np.int64),
    }
    for name, table in (("data", columns), ("meta/episodes", about)):
        (folder / name / "chunk-000").mkdir(parents=True)
        parquet.write_table(pa.table(table), folder / name / "chunk-000" / "file-000.parquet")
    features = {"state": {"dtype": "float32", "shape": [len(places)], "names": places}}
    info = {"codebase_version": "v3.0", "fps": 50, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))


def bench_evaluate_many(bench: Any) -> None:
    """Traces of 200 samples under four specs, evaluated one by one and together."""
    try:
        from spatial_replay.monitor.result import evaluate_many
    except ImportError:
        bench.remark("this package has no evaluate_many")
        return
    rng = random.Random(1)
    specification = sr.parse_specification(FOUR_SPECS)
    with tempfile.TemporaryDirectory() as folder:
        logs = [Path(folder) / f"logs/{number}.jsonl.gz" for number in range(SHORT_LOGS)]
        for log in logs:
            write_short_log(log, rng)
        traces = [sr.read_trace(log) for log in logs]

    def outcomes(evaluations: Iterable[sr.Evaluation]) -> list[object]:
        return [(result.robustness, result.tested) for results in evaluations for result in results]

    def one_by_one(_: Any) -> list[object]:
        return outcomes(sr.evaluate(specification, replace(trace)) for trace in traces)

    def together(_: Any) -> list[object]:
        return outcomes(evaluate_many(specification, map(replace, traces)))

    options: dict[str, Any] = {"per": SHORT_LOGS, "unit": "log", "runs": 5, "warmups": 4}
    with only("compiled"):
        single = bench.measure("one by one", one_by_one, **options)
        joint = bench.measure("together", together, **options)
    bench.ratio("together to one by one", joint.median_s / single.median_s, 0.5)


def bench_results(bench: Any) -> None:
    """The worst ten of very many rows, read from the file."""
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
    """Return the present memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
