"""Pauses of samples: remarked in every format, and unknown where that is asked for."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from spatial_replay import (
    Footprint,
    Recorder,
    Sample,
    UsageError,
    parse_specification,
    read_trace,
    replay_log,
)
from spatial_replay.cli import run
from spatial_replay.trace.trace import Pauses


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Samples every 0.1 s, but for a pause of 5 s after the twentieth."""
    lines = []
    for tick in range(40):
        time_ns = tick * 10**8 + (5 * 10**9 if tick >= 20 else 0)
        cup = {"name": "cup", "polygon": [[tick, 0], [tick + 1, 0], [tick, 1]]}
        lines.append({"time_ns": time_ns, "objects": [cup]})
    path = tmp_path / "run.jsonl"
    path.write_text("\n".join(map(json.dumps, lines)))
    return path


def test_a_pause_is_remarked_with_its_place_and_length(log: Path) -> None:
    trace = read_trace(log)
    assert len(trace) == 40
    assert trace.remarks == (
        "run.jsonl: samples pause for 5.100 s from 1.900 s on, where one usually comes every 0.1 s; `max_gap`"
        " makes what lies there unknown",
    )


def test_a_lost_connection_is_no_pause_and_not_called_max_gap(tmp_path: Path) -> None:
    log, spec = tmp_path / "run.mcap", parse_specification("spec far = G (cup dist wall >= 1)")
    wall = Footprint.box(50, 0, 51, 1)
    with Recorder(log, specifications=[spec]) as recorder:
        for tick in range(40):
            time_ns = tick * 10**8 + (5 * 10**9 if tick >= 20 else 0)
            recorder.write(Sample(time_ns, {"cup": Footprint.box(tick, 0, tick + 1, 1), "wall": wall}))
            if tick == 19:
                recorder.write(Sample(time_ns + 1, unknown={"cup": None, "wall": None}))
    replayed = replay_log(log, spec)
    explained = replayed.results[0].explain()
    assert "The samples pause from 1.900 s to 7.000 s (5.100 s): the connection was lost" in explained
    assert "max_gap" not in explained + " ".join(map(str, replayed.remarks))


def test_everything_in_a_longer_pause_is_unknown(log: Path, tmp_path: Path) -> None:
    trace = read_trace(log, max_gap="2s")
    inside = [time_ns / 1e9 for time_ns in trace.times_ns.tolist() if 1.9e9 < time_ns < 7e9]
    assert inside == [1.900000001, *(round(1.9 + 0.2 * step, 1) for step in range(1, 26)), 6.999999999]
    assert (trace.rows[20:-20] <= -2).all()
    assert "; what lies in a pause of more than 2 s is unknown (`max_gap`)" in trace.remarks[0]
    assert read_trace(log, max_gap="6s") == read_trace(log)
    spec = tmp_path / "far.spatial"
    spec.write_text("region wall = box(50, 0, 51, 1)\nspec far = G (cup dist wall >= 1)\n")
    whole, paused = (replay_log(log, spec, max_gap=each) for each in (None, "2s"))
    assert [whole.verdict, paused.verdict] == ["satisfied", "unknown"]
    assert [paused.samples, paused.unreadable] == [40, 0]
    worst = paused.results[0].explain()
    assert "is unknown at 1.900 s, where it could decide (within `far`): the samples pause there." in worst
    assert "The samples pause from 1.900 s to 7.000 s (5.100 s): `max_gap` makes that unknown." in worst
    assert "missing" not in worst


def test_samples_that_only_fill_a_pause_do_not_count(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = tmp_path / "far.spatial"
    spec.write_text("region wall = box(50, 0, 51, 1)\nspec far = G (cup dist wall >= 1 and cap ovlp cup)\n")
    assert run(["check", str(spec), "--log", str(log), "--read", "max_gap=2s"]) == 0
    assert "compared with 40 samples of run.jsonl" in capsys.readouterr().out
    assert run(["explain", str(log), "--spec", str(spec), "--read", "max_gap=2s"]) == 4
    assert "cap is missing in every sample" in capsys.readouterr().out


def test_a_replay_that_begins_or_ends_in_a_pause_is_remarked(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = tmp_path / "far.spatial"
    spec.write_text("spec far = G (cup ovlp cup)\n")
    replay = ["replay", str(log), "--spec", str(spec)]
    assert run([*replay, "--from", "3s"]) == 0
    assert "the window has no sample from 3.000 s to 7.000 s" in capsys.readouterr().err
    assert run([*replay, "--from", "0.5s", "--to", "6s"]) == 0
    assert "the window has no sample from 1.900 s to 6.000 s" in capsys.readouterr().err
    assert run([*replay, "--from", "0.5s", "--to", "9s"]) == 0
    assert "the window has no sample" not in capsys.readouterr().err
    assert run([*replay, "--from", "3s", "--to", "6s"]) == 2
    assert "on its clock) and pause there" in capsys.readouterr().err


def test_a_window_without_a_sample_names_the_samples_around_it(log: Path, tmp_path: Path) -> None:
    spec = tmp_path / "far.spatial"
    spec.write_text("spec far = F[3s, 4s] (cup ovlp cup)\n")
    (result,) = replay_log(log, spec).results
    assert str(result.untested[0].message).endswith(
        "no sample of the log lies in its window, between those at 1.900 s and 7.000 s."
    )


@pytest.mark.parametrize("body", ["F[1s, 1.2s]", "G[1s, 1.2s]", "O[1s, 1.2s]", "H[0s, 0.1s]", "F[0s, 0s]"])
def test_no_verdict_rests_on_a_window_in_a_pause(log: Path, tmp_path: Path, body: str) -> None:
    spec = tmp_path / "far.spatial"
    holds = f"{body} cup dist wall >= 1"
    spec.write_text(f"region wall = box(50, 0, 51, 1)\nspec far = G[1.5s, 7s] ({holds})\n")
    assert replay_log(log, spec, max_gap="2s").results[0].verdict == "unknown"


def test_a_window_that_may_miss_what_fills_a_pause_is_refused(log: Path, tmp_path: Path) -> None:
    spec = tmp_path / "far.spatial"
    spec.write_text("region wall = box(50, 0, 51, 1)\nspec far = F[1s, 1.1s] cup dist wall >= 1\n")
    with pytest.raises(UsageError, match=r"\[1s, 1.1s\] is too narrow for max_gap.*; make it 0.2s long"):
        replay_log(log, spec, max_gap="2s")
    assert replay_log(log, spec, max_gap="1s").results[0].verdict == "satisfied"


def test_a_limit_has_a_unit(log: Path) -> None:
    with pytest.raises(UsageError, match=r"max_gap is '2'; give a duration above 0, such as 2s or 500ms"):
        read_trace(log, max_gap="2")


def test_pauses_of_a_long_log_are_found_and_take_no_memory() -> None:
    intervals = np.full(1_000_000, 33_000_000)
    intervals[[900, 500_000, 999_000]] = 10**9, 2 * 10**9, 3 * 10**9
    times_ns = np.cumsum(intervals)
    pauses = Pauses()
    tracemalloc.start()
    try:
        for first in range(0, len(times_ns), 4_096):
            pauses.add(times_ns[first : first + 4_096])
        held_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held_bytes < 2_000_000
    assert pauses.usual_ns == 33_000_000
    assert [length for _, length in pauses.longest_first()] == [3 * 10**9, 2 * 10**9, 10**9]
    assert pauses.longest_first()[1][0] == times_ns[499_999]


@pytest.mark.parametrize("size", [1, 2, 3, 50, 403])
def test_pauses_do_not_depend_on_blocks(size: int) -> None:
    intervals = np.full(402, 33_000_000)
    intervals[[0, 200]] = 10**9, 5 * 10**9
    times_ns = np.append(0, np.cumsum(intervals))
    pauses = Pauses()
    for first in range(0, len(times_ns), size):
        pauses.add(times_ns[first : first + size])
    assert pauses.usual_ns == 33_000_000
    assert [length for _, length in pauses.longest_first()] == [5 * 10**9, 10**9]
