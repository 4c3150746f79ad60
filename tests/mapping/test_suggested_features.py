"""Suggested mappings of data sets give the positions that the simulators had."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spatial_replay as sr
from spatial_replay.errors import UsageError
from spatial_replay.logs.formats.datasets import open_data_set
from spatial_replay.mapping.suggest_features import suggest_feature_mapping

DATA = os.environ.get("SPATIAL_REPLAY_DATA")
pytestmark = pytest.mark.skipif(DATA is None, reason="SPATIAL_REPLAY_DATA names no folder")
LEARNING = Path(DATA or "") / "learning"

PUSH = {"puck": "puck", "goal": "goal", "hand": "hand"}
CUBES = {"body_0": "block_0", "body_1": "block_1"}


def answers_of(name: str, key: str = "") -> list[dict[str, Any]]:
    document = json.loads((LEARNING / name).read_text())
    return document[key] if key else document  # type: ignore[no-any-return]


def text_with_rate(path: Path, fps: int) -> str:
    data_set = open_data_set(path)
    assert data_set is not None
    return re.sub("^fps:$", f"fps: {fps}", suggest_feature_mapping(data_set), flags=re.MULTILINE)


@pytest.mark.parametrize(
    ("path", "answers", "names", "fps"),
    [
        ("lerobot/push_v3", ("lerobot/answers.json",), PUSH, 80),
        ("lerobot/push_v21", ("lerobot/answers.json",), PUSH, 80),
        ("lerobot/push_v3_thirdparty", ("lerobot/answers.json",), PUSH, 80),
        ("lerobot/push_v3_stopped", ("lerobot/stopped_answers.json",), PUSH, 80),
        ("ogbench/cube-double-tiny.npz", ("ogbench/answers.json",), CUBES, 20),
        ("d4rl/cube-double-d4rl.hdf5", ("d4rl/answers.json",), {**CUBES, "goal": "target"}, 20),
        *(
            (f"minari/{name}", ("minari/answers.json", name), {"obj": "obj"}, 80)
            for name in ("push-hdf5/scripted-v0", "push-arrow/scripted-v0")
        ),
        (
            "minari/fetch/random-v0",
            ("minari/answers.json", "fetch/random-v0"),
            {"achieved_goal": "object0_site", "desired_goal": "goal"},
            25,
        ),
    ],
)
def test_positions_are_those_of_the_simulator(
    path: str, answers: tuple[str, ...], names: dict[str, str], fps: int, tmp_path: Path
) -> None:
    mapping = tmp_path / "suggested.yaml"
    mapping.write_text(text_with_rate(LEARNING / path, fps))
    for answer in answers_of(*answers):
        trace = sr.read_trace(f"{LEARNING / path}#{answer['episode']}", mapping=mapping)
        shapes = trace.footprints
        for pose in answer["poses"]:
            sample = pose.get("frame", pose.get("step"))
            for name, key in names.items():
                row = int(trace.rows[sample, trace.names.index(name)])
                part = int(shapes.part_start[row])
                point = shapes.vertices[int(shapes.vertex_start[part])]
                position = [*point, shapes.bottom[row]]
                assert np.abs(np.subtract(position, pose[key][:3])).max() < 1e-7


def test_a_gripper_that_points_downwards_has_no_order() -> None:
    text = text_with_rate(LEARNING / "maniskill/StackCube-v1.h5", 20)
    # its bodies are not repeated
    assert "{name: tcp, position" in text and "name: cubeA" not in text
    assert "tcp: orientation: [3:7] needs `order: wxyz` or `order: xyzw`" in text


def test_a_data_set_that_names_its_objects_needs_no_mapping() -> None:
    with pytest.raises(UsageError, match=r"lift\.hdf5 needs no mapping: it names its objects"):
        text_with_rate(LEARNING / "robomimic/lift.hdf5", 20)
