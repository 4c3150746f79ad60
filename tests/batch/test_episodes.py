"""Episodes of data sets in batches: each is a log, found by the data set's path."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import spatial_replay as sr
from batch.fleet import batch, command, write_log

MAPPING = """
features:
  state: {name: a, position: [x, y], signals: {gap: gap}}
"""


def write_episode(folder: Path, number: int, gap: float) -> None:
    """Write a file of LeRobot's layout of v2.1 with one episode."""
    frames = {
        "episode_index": [number] * 3,
        "frame_index": [0, 1, 2],
        "state": [[float(frame), 0.0, gap] for frame in range(3)],
    }
    pq.write_table(pa.table(frames), folder / "data" / "chunk-000" / f"episode_{number:06d}.parquet")


@pytest.fixture
def push(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A data set of eleven episodes, of which one violates the specification."""
    folder = tmp_path / "push"
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    feature = {"dtype": "float32", "shape": [3], "names": ["x", "y", "gap"]}
    about = {"codebase_version": "v2.1", "fps": 10, "features": {"state": feature}}
    (folder / "meta" / "info.json").write_text(json.dumps(about))
    episodes = [json.dumps({"episode_index": number, "length": 3}) for number in range(11)]
    (folder / "meta" / "episodes.jsonl").write_text("\n".join(episodes))
    for number in range(11):
        write_episode(folder, number, 0.05 if number == 4 else 0.5 + number / 100)
    (tmp_path / "m.yaml").write_text(MAPPING)
    (tmp_path / "gap.spatial").write_text("spec apart = G (gap >= 0.1)\n")
    monkeypatch.chdir(tmp_path)
    return folder


OPTIONS = ("--spec", "gap.spatial", "--mapping", "m.yaml", "-o", "results")


def test_a_data_set_stands_for_its_episodes_and_they_are_no_repeated_runs(push: Path) -> None:
    done = batch("push", *OPTIONS, "--json", "rows.json")
    rows = [json.loads(line) for line in Path("rows.json").read_text().splitlines()]
    assert [row["log"] for row in rows] == [f"push#{number}" for number in range(11)]
    assert [row["log"] for row in rows if row["verdict"] != "satisfied"] == ["push#4"]
    assert (done.code, "flaky" in done.out, "push#4: apart: violated" in done.out) == (1, False, True)


def test_only_changed_episodes_are_evaluated_again(push: Path) -> None:
    assert "(all evaluated now)" in batch("push", *OPTIONS).out
    assert "(0 evaluated now, 11 known)" in batch("push", *OPTIONS).out
    write_episode(push, 7, 0.01)
    done = batch("push", *OPTIONS, "--jobs", "2")
    assert "(1 evaluated now, 10 known)" in done.out and "push#7: apart: violated" in done.out
    # the mapping is read in all of them
    Path("m.yaml").write_text(MAPPING + "fps: 20\n")
    assert "(all evaluated now)" in batch("push", *OPTIONS).out


def test_a_folder_has_the_episodes_of_data_sets_in_it(push: Path) -> None:
    (push.parent / "all").mkdir()
    push.rename(push.parent / "all" / "push")
    write_log(Path("all/other.jsonl"), 1.0)
    Path("present.spatial").write_text("spec seen = F true\n")
    done = batch("all/push#10", "all/p*", "--spec", "present.spatial", "--mapping", "m.yaml", "-o", "results")
    assert (done.code, "11 logs, 11 results" in done.out) == (0, True)
    done = batch("all", "--spec", "present.spatial", "--mapping", "m.yaml", "-o", "results", "--json", "j")
    names = [json.loads(line)["log"] for line in Path("j").read_text().splitlines()]
    assert names[0] == "all/other.jsonl" and names[1:] == [f"all/push#{number}" for number in range(11)]


def test_every_command_that_takes_a_log_takes_an_episode(push: Path) -> None:
    reading = ("--mapping", "m.yaml")
    tuned = "const d = 0.1 in [0.01, 0.4]\nspec apart = G (gap >= d)\n"
    Path("tuned.spatial").write_text(tuned)
    for code, arguments in (
        (0, ("explain", "push#3", "--spec", "gap.spatial")),
        (0, ("replay", "push#3", "--spec", "gap.spatial", "-o", "three.mcap")),
        (1, ("report", "push#4", "--spec", "gap.spatial", "-o", "four.html")),
        (1, ("diff", "push#3", "push#4", "--spec", "gap.spatial")),
        (0, ("clip", "push#4", "--spec", "gap.spatial", "-o", "clip.mcap")),
        (0, ("learn", "push#3", "push#5", "--bad", "push#4")),
        (0, ("tune", "--spec", "tuned.spatial", "--good", "push#3", "--bad", "push#4")),
        (0, ("check", "gap.spatial", "--log", "push#3")),
        (0, ("info", "push#3")),
    ):
        done = command(*arguments, *reading)
        assert done.code == code, done
    original, copy = sr.read_trace("push#3", mapping="m.yaml"), sr.read_trace("three.mcap")
    assert copy == original
    refusal = command("explain", "push", "--spec", "gap.spatial", *reading)
    assert (refusal.code, "give one, such as push#0" in refusal.err) == (2, True)


def test_an_episode_that_is_not_there_is_an_error_of_the_pattern(push: Path) -> None:
    done = batch("push#11", *OPTIONS)
    assert (done.code, "push has no episode 11; it has 11 episodes, push#0 to push#10" in done.err) == (
        2,
        True,
    )
