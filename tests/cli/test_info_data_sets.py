"""`spatial-replay info` of robot-learning data sets: what they hold, and the mapping that is suggested."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from spatial_replay.cli import run

pytest.importorskip("pyarrow")

SCENE = ["cup.x", "cup.y", "cup.z", "cup.qx", "cup.qy", "cup.qz", "cup.qw", "cup_vel_x", "cup_vel_y"]
STATE = ["hand_x", "hand_y", "hand_z", "gripper"]
UPRIGHT = [0.1, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8]


def lerobot(folder: Path, columns: Mapping[str, tuple[Sequence[str] | None, Sequence[float]]]) -> Path:
    """Write a data set of two episodes with three frames each; every frame has the same numbers."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(numbers)], "names": names}
        for name, (names, numbers) in columns.items()
    }
    features["next.success"] = {"dtype": "bool", "shape": [1], "names": None}
    features["observation.images.top"] = {"dtype": "video", "shape": [8, 8, 3], "names": None}
    for part in ("meta", "data/chunk-000"):
        (folder / part).mkdir(parents=True)
    info = {"codebase_version": "v2.1", "fps": 10, "robot_type": "arm", "features": features}
    (folder / "meta/info.json").write_text(json.dumps(info))
    episodes = [{"episode_index": number, "tasks": ["fill the cup"], "length": 3} for number in range(2)]
    (folder / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, episodes)))
    for number in range(2):
        rows = {
            "episode_index": [number] * 3,
            "frame_index": [0, 1, 2],
            "next.success": [False, False, number == 0],
            **{name: [list(numbers)] * 3 for name, (_, numbers) in columns.items()},
        }
        pq.write_table(pa.table(rows), folder / f"data/chunk-000/episode_{number:06d}.parquet")
    return folder


def test_tasks_labels_and_features_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = lerobot(
        tmp_path / "fill", {"observation.state": (STATE, [0.0] * 4), "action": (None, [0.0] * 2)}
    )
    assert run(["info", str(folder)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "fill: LeRobot v2.1, 2 episodes, 6 frames at 10 Hz, robot arm",
        "tasks    fill the cup (2)",
        "label    next.success: true in 1 of 2 episodes; it is about the state after each frame's action",
        "features observation.state  hand_x hand_y hand_z gripper",
        "pictures observation.images.top",
        "a mapping says which of these are objects: --suggest-mapping",
        f"each episode is a log: spatial-replay info {folder}#0",
    ]
    assert run(["info", str(folder), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [episode["success"] for episode in document["episodes"]] == [True, False]
    assert document["label"]["field"] == "next.success" and document["label"]["successes"] == 1


def test_an_episode_without_a_mapping_has_the_ranges_of_its_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lerobot(tmp_path / "fill", {"observation.state": (STATE, [0.5, 0.0, 0.0, 1.0])})
    assert run(["info", f"{folder}#1"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("fill#1: LeRobot v2.1 episode, 3 frames in 0.200 s\ntask     fill the cup\n")
    assert "label    next.success: false\n" in text
    assert "  hand_x   first 0.5  from 0.5 to 0.5\n" in text
    assert run(["info", f"{folder}#7"]) == 2
    assert "fill has no episode 7; it has 2 episodes, fill#0 to fill#1" in capsys.readouterr().err


def test_a_damaged_file_is_reported_once_for_all_episodes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lerobot(tmp_path / "fill", {"observation.state": (STATE, [0.0] * 4)})
    for file in (folder / "data/chunk-000").iterdir():
        file.write_bytes(b"PAR1")
    assert run(["info", str(folder)]) == 0
    (warning,) = [line for line in capsys.readouterr().err.split("spatial-replay: ") if "parquet" in line]
    assert "download it again (2 episodes: #0, #1)" in " ".join(warning.split())


def test_an_address_without_a_number_names_the_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lerobot(tmp_path / "fill", {"observation.state": (STATE, [0.0] * 4)})
    for command in (["info"], ["explain", "--spec", "a dist b <= 1"], ["judge", "--spec", "gate.spatial"]):
        assert run([*command, f"{folder}#x"]) == 2
        message = capsys.readouterr().err.replace("\n", " ")
        assert "fill#x: episodes go by number; it has 2 episodes, fill#0 to fill#1" in message


def test_names_of_places_suggest_objects(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, state = (SCENE, [*UPRIGHT, 0.0, 0.0]), (STATE, [0.0] * 4)
    folder = lerobot(tmp_path / "fill", {"observation.state": state, "observation.environment_state": scene})
    assert run(["info", str(folder), "--suggest-mapping"]) == 0
    features = yaml.safe_load(capsys.readouterr().out)["features"]
    (cup,), (hand,) = features["observation.environment_state"], features["observation.state"]
    assert (cup["name"], cup["position"], cup["orientation"]) == ("cup", SCENE[:3], SCENE[3:7])
    assert (hand["name"], hand["position"], hand["signals"]) == ("hand", STATE[:3], {"gripper": "gripper"})


def test_four_numbers_of_another_length_are_no_orientation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lerobot(tmp_path / "fill", {"observation.state": (SCENE[:7], [0.0] * 6 + [0.4])})
    assert run(["info", str(folder), "--suggest-mapping"]) == 0
    text = capsys.readouterr().out
    assert "has lengths from 0.4 to 0.4, so it is no orientation" in text
    assert "orientation" not in yaml.safe_load(text)["features"]["observation.state"][0]


@pytest.mark.parametrize(
    ("quaternion", "order"),
    [
        ([0.8, 0.0, 0.0, 0.6], "wxyz"),
        ([0.0, 0.0, 0.6, 0.8], "xyzw"),
        ([0.5, 0.5, 0.5, 0.5], None),
    ],
)
def test_the_order_of_a_quaternion_is_decided_by_its_numbers_or_asked(
    quaternion: list[float], order: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lerobot(tmp_path / "fill", {"cup_pose": (None, [*UPRIGHT[:3], *quaternion])})
    assert run(["info", str(folder), "--suggest-mapping"]) == 0
    text = capsys.readouterr().out
    (cup,) = yaml.safe_load(text)["features"]["cup_pose"]
    assert cup.get("order") == order and ("orientation" in cup) == (order is not None)
    assert ("needs `order: wxyz` or `order: xyzw`" in text) == (order is None)


def test_bodies_in_a_state_of_mujoco_are_found_by_their_quaternions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joints, angles = np.linspace([0.1, 0.3], [0.5, 0.2], 9), np.linspace(0.0, 1.0, 9)
    zeros = np.zeros(9)
    pose = np.stack([angles, zeros, zeros + 0.02, np.cos(angles), zeros, zeros, np.sin(angles)], axis=1)
    path = tmp_path / "cubes.npz"
    np.savez(path, qpos=np.hstack([joints, pose, pose]), terminals=np.arange(9) == 8)
    assert run(["info", str(path), "--suggest-mapping"]) == 0
    mapping = yaml.safe_load(capsys.readouterr().out)
    assert [body["position"] for body in mapping["features"]["qpos"]] == ["[2:5]", "[9:12]"]
    # frames a second are asked for
    assert mapping["fps"] is None


def test_a_copy_that_lost_labels_and_poses_is_recognised(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    folder = lerobot(tmp_path / "copy", {"observation.state": (None, [0.0] * 4)})
    info = json.loads((folder / "meta/info.json").read_text())
    # as forge-robotics 0.2.0 writes it
    info |= {"codebase_version": "v3.0", "chunks_size": 1}
    (folder / "meta/info.json").write_text(json.dumps(info))
    for number in range(2):
        (folder / f"meta/episodes/chunk-{number:03d}").mkdir(parents=True)
        table = pa.table({"episode_index": [number], "length": [3], "task_index": [0]})
        pq.write_table(table, folder / f"meta/episodes/chunk-{number:03d}/file-000.parquet")
    assert run(["info", str(folder)]) == 0
    assert "it looks like a copy by forge-robotics, which leaves out labels" in capsys.readouterr().err


def test_joints_and_pictures_are_no_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = lerobot(
        tmp_path / "arm", {"observation.state": (["shoulder_pan.pos", "gripper.pos"], [0.0] * 2)}
    )
    for option in ([], ["--suggest-mapping"]):
        assert run(["info", str(folder), *option]) == 2
        assert "no poses in this data set; what would be needed: a feature" in capsys.readouterr().err


def test_contents_of_logs_are_refused_for_a_data_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lerobot(tmp_path / "fill", {"observation.state": (STATE, [0.0] * 4)})
    assert run(["info", str(folder), "--fit"]) == 2
    assert f"--fit is about one episode; give its address: {folder}#0" in capsys.readouterr().err


def test_a_mapped_episode_is_shown_as_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lerobot(tmp_path / "fill", {"observation.state": (STATE, [0.0] * 4)})
    mapping = tmp_path / "fill.yaml"
    mapping.write_text("features: {observation.state: {name: hand, position: [hand_x, hand_y, hand_z]}}")
    assert run(["info", f"{tmp_path}/fill#1", "--mapping", str(mapping), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["name"], document["samples"]) == ("fill#1", 3)
    assert run(["info", f"{tmp_path}/fill#1", "--mapping", str(mapping), "--fit"]) == 0
    assert "    hand: 1" in capsys.readouterr().out.replace('"', "")


def test_an_episode_with_a_mapping_has_its_task_and_label(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lerobot(tmp_path / "fill", {"observation.state": (STATE, [0.0] * 4)})
    mapping = tmp_path / "fill.yaml"
    assert run(["info", str(folder), "--suggest-mapping", "-o", str(mapping)]) == 0
    assert run(["info", f"{folder}#0", "--mapping", str(mapping)]) == 0
    assert capsys.readouterr().out.splitlines()[:3] == [
        "fill#0: LeRobot v2.1 episode, 3 samples",
        "task     fill the cup",
        "label    success",
    ]


def test_the_folder_above_a_data_set_names_the_data_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lerobot(tmp_path / "space" / "fill", {"observation.state": (STATE, [0.0] * 4)})
    assert run(["info", str(tmp_path / "space")]) == 2
    assert f"{tmp_path}/space/fill is a data set of episodes" in capsys.readouterr().err.replace("\n", "")
