"""Robot-learning data sets: recognised by content, read by columns, with known positions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import spatial_replay as sr
from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.formats.datasets import data_set_address, open_data_set


def lerobot(folder: Path, frames: dict[str, list[object]], **info: object) -> Path:
    """Write a small data set in LeRobot's layout of v2.1."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    about = {"codebase_version": "v2.1", "fps": 10, "features": {}, **info}
    (folder / "meta" / "info.json").write_text(json.dumps(about))
    numbers = sorted(set(frames["episode_index"]))  # type: ignore[type-var]
    lines = [json.dumps({"episode_index": number, "tasks": ["go"]}) for number in numbers]
    (folder / "meta" / "episodes.jsonl").write_text("\n".join(lines))
    pq.write_table(pa.table(frames), folder / "data" / "chunk-000" / "episode_000000.parquet")
    return folder


def test_rows_are_found_by_their_episode_whatever_the_files_are_called(tmp_path: Path) -> None:
    frames = {"episode_index": [7, 7, 9], "frame_index": [0, 1, 0], "state": [[1.0], [2.0], [3.0]]}
    features = {"state": {"dtype": "float32", "shape": [1], "names": {"motors": ["x"]}}}
    data_set = open_data_set(lerobot(tmp_path / "set", frames, features=features))
    assert data_set is not None
    assert [episode.number for episode in data_set.episodes] == [7, 9]
    assert data_set.remarks == (
        "meta names files that are not in data/: episode_000007.parquet, episode_000009.parquet;"
        " rows are found by episode_index",
    )
    assert data_set.columns(9).features["state"].tolist() == [[3.0]]
    assert data_set.features[0].places == ("x",)
    with pytest.raises(UsageError, match="set has no episode 8; it has 2 episodes, set#7 to set#9"):
        data_set.columns(8)


def test_an_episode_of_two_runs_is_not_judged(tmp_path: Path) -> None:
    frames = {"episode_index": [0, 0, 0, 0], "frame_index": [0, 1, 0, 1]}
    data_set = open_data_set(lerobot(tmp_path / "set", frames))
    assert data_set is not None
    assert "goes from 1 to 0 at row 2" in data_set.columns(0).unjudged


def test_times_unlike_those_of_frames_are_remarked(tmp_path: Path) -> None:
    frames = {"episode_index": [0, 0], "frame_index": [0, 1], "timestamp": [2.0, 2.1]}
    data_set = open_data_set(lerobot(tmp_path / "set", frames))
    assert data_set is not None
    columns = data_set.columns(0)
    assert columns.times_ns.tolist() == [0, 100_000_000]
    assert "its timestamp is 2 s at frame 0" in columns.remarks[0]


def test_missing_files_are_named(tmp_path: Path) -> None:
    folder = lerobot(tmp_path / "set", {"episode_index": [0], "frame_index": [0]})
    (folder / "data" / "chunk-000" / "episode_000000.parquet").unlink()
    data_set = open_data_set(folder)
    assert data_set is not None
    with pytest.raises(LogError, match=r"set#0: no file in data/ has its rows \(episode_000000.parquet"):
        data_set.columns(0)


def test_pickles_are_never_loaded(tmp_path: Path) -> None:
    file = tmp_path / "set.npz"
    np.savez(file, terminals=[False, True], qpos=np.zeros((2, 3)), extra=np.array([{}, {}], object))
    data_set = open_data_set(file)
    assert data_set is not None and "a pickle" in data_set.remarks[0]
    assert [feature.name for feature in data_set.features] == ["qpos"]


def test_a_damaged_archive_ends_no_batch(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text('fps: 10\nfeatures: {qpos: [{name: cube, position: "[0:3]"}]}\n')
    (tmp_path / "gate.spatial").write_text("spec near = G (cube dist cube <= 1)\n")
    for name in ("damaged", "good"):
        np.savez(tmp_path / f"{name}.npz", terminals=[False, True] * 2, qpos=np.full((4, 3_000), 0.5))
    damaged = tmp_path / "damaged.npz"
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 255
    damaged.write_bytes(content)
    logs = [f"{tmp_path / name}.npz#{number}" for name in ("damaged", "good") for number in (0, 1)]
    mapping = str(tmp_path / "m.yaml")
    rows = sr.evaluate_logs(
        logs, tmp_path / "gate.spatial", output=tmp_path / "results", mapping=mapping
    ).table
    assert rows["verdict"].to_pylist() == [None, None, "satisfied", "satisfied"]
    assert rows["error_kind"].to_pylist() == ["log", "log", None, None]
    assert "damaged.npz cannot be read" in rows["error"][0].as_py()
    damaged.write_bytes(b"PK")
    with pytest.raises(LogError, match=r"damaged.npz cannot be read.*; copy the file again"):
        open_data_set(damaged)
    # a folder does not hide it
    names = sr.evaluate_logs(
        tmp_path, tmp_path / "gate.spatial", output=tmp_path / "results", mapping=mapping
    ).table
    assert {Path(name).name for name in names["log"].to_pylist()} == {
        "damaged.npz",
        "good.npz#0",
        "good.npz#1",
    }


def test_an_address_names_an_episode(tmp_path: Path) -> None:
    folder = lerobot(tmp_path / "set", {"episode_index": [0], "frame_index": [0]})
    assert data_set_address(f"{folder}#17") == (str(folder), 17)
    assert data_set_address(f"{folder}") is None
    (tmp_path / "set#17").write_text("")
    assert data_set_address(f"{folder}#17") is None


def test_a_damaged_description_of_lerobot_is_named(tmp_path: Path) -> None:
    (tmp_path / "push/meta").mkdir(parents=True)
    for text, message in (("{", "info.json is not JSON"), ("{}", "push is LeRobot without codebase_version")):
        (tmp_path / "push/meta/info.json").write_text(text)
        with pytest.raises((LogError, UsageError), match=message):
            open_data_set(tmp_path / "push")
