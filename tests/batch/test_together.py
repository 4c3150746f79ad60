"""Short logs that a batch measures together, against each of them alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from batch.fleet import write_log
from spatial_replay.batch.rows import ResultRow, Task, rows_from_task, rows_from_tasks
from spatial_replay.batch.suite import Conditions
from spatial_replay.spec.load import SpecificationText

MAPPING = """
features:
  state:
    - {name: a, position: [x, y], orientation: [qx, qy, qz, qw], shape: {box: [0.1, 0.1]}}
    - signals: {gap: gap}
    - {name: b, position: [bx, y], shape: {disc: 0.1}, height: [0, 0.1]}
"""
SPECS = """
spec apart = G (gap >= 0.1)
spec near = F (a dist b <= 0.2)
spec answers = G ((a dist b <= 0.5) -> F[0s,0.3s] (gap >= 0.2))
spec later = F[0.2s,0.3s] (lamp dist a <= 1)
"""
PLACES = ["x", "y", "gap", "qx", "qy", "qz", "qw", "bx"]


def write_set(folder: Path) -> None:
    """Write a data set of LeRobot: sound episodes, and one with each fault."""
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    feature = {"dtype": "float32", "shape": [len(PLACES)], "names": PLACES}
    about = {"codebase_version": "v2.1", "fps": 10, "features": {"state": feature}}
    (folder / "meta" / "info.json").write_text(json.dumps(about))
    lengths = [5, 9, 6, 6, 7, 5, 6]
    episodes = [json.dumps({"episode_index": n, "length": length}) for n, length in enumerate(lengths)]
    (folder / "meta" / "episodes.jsonl").write_text("\n".join(episodes))
    for number, length in enumerate(lengths):
        state = [[0.1 * k, 0.0, 0.1 * number, 0.0, 0.0, 0.0, 1.0, 1.0 - 0.1 * k] for k in range(length)]
        frames = list(range(length))
        if number == 2:
            state[3][0] = float("nan")
        if number == 3:
            state[2][6] = 3.0
        if number == 4:
            frames[4:] = range(0, 3)
        if number == 5:
            state[2:] = [[*row[:7], 50.0 - row[7]] for row in state[2:]]
        if number == 6:
            frames[3:] = [7, 8, 9]
        columns = {"episode_index": [number] * length, "frame_index": frames, "state": state}
        pq.write_table(pa.table(columns), folder / "data" / "chunk-000" / f"episode_{number:06d}.parquet")


def check_equal(logs: Sequence[str], conditions: Conditions) -> dict[str, ResultRow]:
    """Check that rows of logs together are those of each alone, and return the first one of each log."""
    text = SpecificationText(SPECS, "s.spatial")
    tasks = tuple(Task(log, (text,), conditions) for log in logs)
    together = [[replace(row, seconds=0.0) for row in rows] for (rows,) in rows_from_tasks(tasks)]
    alone = [[replace(row, seconds=0.0) for row in rows] for (rows,) in map(rows_from_task, tasks)]
    # a number that is not known is unlike itself
    assert repr(together) == repr(alone)
    return {log: rows[0] for log, rows in zip(logs, together, strict=True)}


def test_episodes_read_together_are_those_read_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_set(Path("push"))
    Path("m.yaml").write_text(MAPPING)
    rows = check_equal([f"push#{n}" for n in range(7)], Conditions(mapping="m.yaml"))
    assert [log for log, row in rows.items() if row.error] == ["push#3", "push#4"]
    assert "no quaternion" in str(rows["push#3"].error)
    assert "jumps by" in str(rows["push#5"].remarks) and "frames are missing" in str(rows["push#6"].remarks)


@pytest.mark.parametrize("is_strict", [True, False])
def test_logs_measured_together_are_those_measured_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_strict: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    logs = [write_log(tmp_path / f"{n}.jsonl", 0.2 * n) for n in range(5)]
    logs[1].write_text(logs[1].read_text().replace("cart", "a").replace("person", "b"))
    logs[2].write_text("{broken\n")
    pause = {**json.loads(logs[3].read_text().splitlines()[-1]), "time_ns": 90 * 10**9}
    logs[3].write_text(f"{logs[3].read_text()}{json.dumps(pause)}\n")
    conditions = Conditions(strict_names=is_strict, reading=(("max_gap", "1s"),))
    rows = list(check_equal([*map(str, logs)], conditions).values())
    errors = [row.error is not None for row in rows]
    assert errors == [is_strict, is_strict, True, is_strict, is_strict]
