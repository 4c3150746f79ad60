"""Episodes of data sets as logs: what a mapping of features reads, and what it refuses."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spatial_replay as sr
from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.formats.datasets import open_data_set
from spatial_replay.mapping.mapping_file import parse_mapping

DATA = os.environ.get("SPATIAL_REPLAY_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="SPATIAL_REPLAY_DATA names no folder")

PUSH = """
features:
  observation.environment_state:
    - {name: puck, position: [puck_x, puck_y, puck_z], orientation: [puck_qx, puck_qy, puck_qz, puck_qw],
       order: xyzw, shape: puck}
    - {name: goal, position: "[7:10]", shape: puck}
  observation.state:
    - {name: hand, position: [0, 1, 2], signals: {gripper: gripper}}
shapes: {puck: {disc: 0.02, height: [-0.02, 0.02]}}
"""
CUBES = """
fps: 20
features:
  qpos:
    - {name: block_0, position: "[14:17]", orientation: "[17:21]", order: wxyz, shape: cube}
    - {name: block_1, position: "[21:24]", orientation: "[24:28]", order: wxyz, shape: cube}
shapes: {cube: {box: [0.04, 0.04, 0.04]}}
"""


def positions(trace: sr.Trace, name: str) -> np.ndarray[Any, Any]:
    """Return the centres (T, 3) of an object's footprints; z only where it has a height."""
    rows = trace.rows[:, trace.names.index(name)]
    assert (rows >= 0).all()
    shapes = trace.footprints
    starts = shapes.vertex_start[shapes.part_start]
    centres = [shapes.vertices[starts[row] : starts[row + 1]].mean(axis=0) for row in rows]
    return np.column_stack([centres, (shapes.bottom + shapes.top)[rows] / 2])


@needs_data
@pytest.mark.parametrize(
    ("name", "answers"),
    [
        ("push_v3", "answers"),
        ("push_v21", "answers"),
        ("push_v3_thirdparty", "answers"),
        ("push_v3_stopped", "stopped_answers"),
    ],
)
def test_lerobot_episodes_have_the_positions_of_the_simulator(
    tmp_path: Path, name: str, answers: str
) -> None:
    folder, mapping = Path(DATA or "") / "learning" / "lerobot", tmp_path / "push.yaml"
    mapping.write_text(PUSH)
    data_set = open_data_set(folder / name)
    assert data_set is not None and data_set.fps == 80 and not data_set.remarks
    for answer in json.loads((folder / f"{answers}.json").read_text()):
        columns = data_set.columns(answer["episode"], features=())
        assert columns.label == answer["success_any"] and not columns.remarks and not columns.unjudged
        trace = sr.read_trace(f"{folder / name}#{answer['episode']}", mapping=mapping)
        assert trace.names == ("goal", "hand", "puck") and len(trace) == answer["frames"]
        pucks, goals = positions(trace, "puck"), positions(trace, "goal")
        for pose in answer["poses"]:
            frame = pose["frame"]
            assert np.abs(pucks[frame] - pose["puck"]).max() < 1e-7
            assert np.abs(goals[frame] - pose["goal"]).max() < 1e-7
            assert trace.times_ns[frame] == round(pose["timestamp"] * 1e9)


@needs_data
def test_ogbench_episodes_have_the_positions_of_the_simulator(tmp_path: Path) -> None:
    folder, mapping = Path(DATA or "") / "learning" / "ogbench", tmp_path / "cubes.yaml"
    mapping.write_text(CUBES)
    for answer in json.loads((folder / "answers.json").read_text()):
        trace = sr.read_trace(f"{folder}/cube-double-tiny.npz#{answer['episode']}", mapping=mapping)
        for name in ("block_0", "block_1"):
            centres = positions(trace, name)
            yaw = trace.yaw[trace.rows[:, trace.names.index(name)]]
            for pose in answer["poses"]:
                w, x, y, z = pose[name][3:]
                assert np.abs(centres[pose["step"]] - pose[name][:3]).max() < 1e-6
                expected = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
                assert abs((yaw[pose["step"]] - expected + np.pi) % (2 * np.pi) - np.pi) < 1e-5


def lerobot(folder: Path, columns: dict[str, list[Any]], places: dict[str, list[str]] | None = None) -> Path:
    """Write a data set of one episode in LeRobot's layout of v2.1, with features of those widths."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    features = {
        name: {
            "dtype": "float32",
            "shape": [np.atleast_1d(rows[0]).size],
            "names": (places or {}).get(name),
        }
        for name, rows in columns.items()
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    about = {"codebase_version": "v2.1", "fps": 10, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(about))
    (folder / "meta" / "episodes.jsonl").write_text(json.dumps({"episode_index": 0, "tasks": ["go"]}))
    count = len(next(iter(columns.values()), []))
    own = {"episode_index": [0] * count, "frame_index": list(range(count))}
    pq.write_table(pa.table(own | columns), folder / "data" / "chunk-000" / "episode_000000.parquet")
    return folder


def episode(
    folder: Path, mapping: str, columns: dict[str, list[Any]], places: dict[str, list[str]] | None = None
) -> sr.Trace:
    """Return the trace of a small episode with a mapping."""
    (folder / "m.yaml").write_text(mapping)
    address = f"{lerobot(folder / 'set', columns, places)}#0"
    return sr.read_trace(address, mapping=folder / "m.yaml")


def test_places_are_names_indices_slices_and_other_features(tmp_path: Path) -> None:
    columns = {
        "observation.state": [[1.0, 2.0, 3.0, 9.0], [4.0, 5.0, 6.0, -1.0]],
        "block.quat": [[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]] * 2,
        "speed": [7.0, 8.0],
    }
    mapping = """
features:
  observation.state:
    - {name: a, position: [x, y, z], orientation: block.quat, order: wxyz, shape: big}
    - {position: "[:2]", scale: 10, yaw: {field: "[-1]", unit: deg}, uncertainty: z}
    - {name: c, position: ["block.quat[0]", 3], class: cup, invalid: [-1]}
  speed: {signals: {speed: 0, again: {field: speed, unit: m/s}}}
order: xyzw
shapes: {big: {box: [2, 1], height: [0, 1]}}
"""
    trace = episode(tmp_path, mapping, columns, {"observation.state": ["x", "y", "z", "grip"]})
    assert trace.names == ("a", "c", "state") and trace.classes == (None, "cup")
    assert np.allclose(positions(trace, "a"), [[1, 2, 3.5], [4, 5, 6.5]])
    assert np.allclose(trace.yaw[trace.rows[:, 0]], np.pi / 2)
    assert np.allclose(positions(trace, "state")[:, :2], [[10, 20], [40, 50]])
    assert np.allclose(trace.yaw[trace.rows[:, 2]], np.radians([9, -1]))
    assert trace.uncertainty[trace.rows[:, 2]].tolist() == [30, 60]
    # a coordinate of an invalid number is unknown
    assert (trace.rows[:, 1] >= 0).tolist() == [True, False]
    assert {name: values.tolist() for name, values in trace.signals.items()} == {
        "speed": [7, 8],
        "again": [7, 8],
    }
    assert trace.units == {"again": "m/s"}


def test_numbers_that_are_not_finite_are_unknown(tmp_path: Path) -> None:
    rows = [[1.0, 2.0], [np.nan, 2.0], [np.inf, 2.0], [1.0, 2.0]]
    turns = [[0.0, 0.0, 0.0, 1.0]] * 3 + [[0.0, 0.0, np.nan, 1.0]]
    mapping = """
features:
  obs:
    - {name: a, position: "[0:2]", shape: {disc: 1}}
    - {name: b, position: "[0:2]", orientation: turn, order: xyzw}
"""
    trace = episode(tmp_path, mapping, {"obs": rows, "turn": turns})
    assert (trace.rows >= 0).tolist() == [[True, True], [False, False], [False, False], [True, False]]


def test_numbers_that_are_no_quaternion_are_refused_by_name(tmp_path: Path) -> None:
    columns = {
        "state": [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 55.0], [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 80.0]]
    }
    places = {"state": ["x", "y", "z", "open", "rx", "ry", "rz", "rw"]}
    mapping = "features: {state: {name: a, position: [x, y, z], orientation: [rx, ry, rz, rw]}}"
    with pytest.raises(UsageError) as refusal:
        episode(tmp_path, mapping, columns, places)
    assert str(refusal.value).startswith(
        "m.yaml: features.state.orientation: rx, ry, rz, rw have the length 55 in frame 0 of set#0, so they"
        " are no quaternion (rw goes from 55 to 80)"
    )


def test_all_places_that_do_not_fit_are_reported_together(tmp_path: Path) -> None:
    mapping = """
features:
  state:
    - {name: a, position: [x, yy]}
    - {name: b, position: "[0:4]"}
    - {name: c, position: "[0:2]", orientation: other}
    - {name: d, position: [x, 9]}
    - {name: e, position: [x, y], shape: {polygon: corners}}
    - {name: e, position: [x, y]}
    - {name: e, position: [x, y]}
  stat: {signals: {a: 0}}
  gone: {signals: {a: 0}, optional: true}
"""
    columns = {"state": [[0.0] * 5], "other": [[0.0] * 4]}
    with pytest.raises(UsageError) as refusal:
        episode(tmp_path, mapping, columns, {"state": ["x", "y", "z", "u", "v"]})
    faults = str(refusal.value).splitlines()
    assert [fault.partition(";")[0] for fault in faults] == [
        "m.yaml: features.state.position: state has no place 'yy'",
        "m.yaml: features.state[1].position: [0:4] has 4 numbers, and 2 or 3 are needed",
        "m.yaml: features.state[2].orientation: the four numbers have no names",
        "m.yaml: features.state[3].position: state has 5 numbers, so there is no [9]",
        "m.yaml: features.state[4].shape: a feature has no list of corners",
        "m.yaml: features.state[6]: there is another object 'e'",
        "m.yaml: features.stat: set has no such feature",
    ]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("topics: {/a: {}}\nfeatures: {b: {position: [0, 1]}}", "topics: it is for logs of messages"),
        ("fixed_frame: map\nfps: 20", "fixed_frame: it is for logs of messages"),
        ("features: {}", "features: no feature was chosen"),
        ("unit: m", "the key 'topics' is missing, or 'features'"),
        ("features: {b: {name: c}}", "features.b: the key 'position' is missing"),
        ("features: {b: {position: [0]}}", "features.b.position: expected"),
        ("features: {b: {position: [0, 1], frame: map}}", "features.b.frame: unknown key"),
        ("fps: 0", "fps: expected frames per second"),
    ],
)
def test_keys_of_topics_and_of_features_never_meet(text: str, fault: str) -> None:
    with pytest.raises(UsageError) as refusal:
        parse_mapping(text, "m.yaml")
    assert fault in str(refusal.value)


def test_a_data_set_is_no_log_but_its_episodes_are(tmp_path: Path) -> None:
    folder = lerobot(tmp_path / "set", {"obs": [[1.0, 2.0]]})
    (tmp_path / "topics.yaml").write_text("topics: {/a: {}}")
    (tmp_path / "m.yaml").write_text("features: {obs: {name: a, position: [0, 1]}}")
    for address, options, fault in (
        (f"{folder}", {"mapping": tmp_path / "m.yaml"}, "data set of 1 episode; give one, such as .*set#0"),
        (f"{folder}#7", {"mapping": tmp_path / "m.yaml"}, "set has no episode 7; it has 1 episode, set#0"),
        (f"{folder}#0", {}, "a mapping file that does.*--suggest-mapping"),
        (f"{folder}#0", {"mapping": tmp_path / "topics.yaml"}, "topics.yaml: topics: set is a data set"),
        (f"{folder}#0", {"mapping": tmp_path / "m.yaml", "rate": 20}, "--read rate=20"),
        (f"{tmp_path}/m.yaml#0", {}, "is no data set of episodes; leave out #0"),
    ):
        with pytest.raises(UsageError, match=fault):
            sr.read_trace(address, **options)  # type: ignore[arg-type]


def test_a_mapping_of_features_fits_no_log_of_messages(tmp_path: Path) -> None:
    from mcap.writer import Writer

    (tmp_path / "m.yaml").write_text("features: {obs: {name: a, position: [0, 1]}}")
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        channel = writer.register_channel("/a", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(UsageError, match="for data sets of episodes, and this log has messages"):
        sr.read_trace(tmp_path / "a.mcap", mapping=tmp_path / "m.yaml")


def test_videos_alone_have_no_poses(tmp_path: Path) -> None:
    folder = lerobot(tmp_path / "set", {})
    info = json.loads((folder / "meta" / "info.json").read_text())
    info["features"] = {"observation.images.top": {"dtype": "video", "shape": [4, 4, 3]}}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(UsageError, match="no poses in this data set; what would be needed"):
        sr.read_trace(f"{folder}#0")


def test_an_episode_of_two_runs_has_no_samples(tmp_path: Path) -> None:
    columns = {"frame_index": [0, 1, 0, 1], "obs": [[0.0, 0.0]] * 4}
    with pytest.raises(LogError, match="set#0: its frame_index goes from 1 to 0"):
        episode(tmp_path, "features: {obs: {name: a, position: [0, 1]}}", columns)


@needs_data
def test_a_shape_with_the_name_of_a_body_replaces_its_footprint(tmp_path: Path) -> None:
    address = f"{DATA}/learning/maniskill/PushCube-v1.h5#0"
    assert sr.read_trace(address).names == ("cube", "goal_region", "table-workspace")
    (tmp_path / "m.yaml").write_text("shapes: {cube: {box: [0.04, 0.02], height: [-0.5, 0.5]}}\nfps: 10")
    trace = sr.read_trace(address, mapping=tmp_path / "m.yaml")
    row = trace.rows[0, 0]
    assert np.isclose(trace.footprints.top[row] - trace.footprints.bottom[row], 1.0)
    corners = trace.footprints.vertices[trace.footprints.vertex_start[trace.footprints.part_start[row]] :][:4]
    sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    assert np.allclose([sides.min(), sides.max()], [0.02, 0.04])
    assert trace.times_ns[1] == 100_000_000


def test_states_without_a_model_get_one_by_the_mapping(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "scene.xml").write_text(
        '<mujoco><worldbody><body name="cube"><freejoint/><geom type="box" size=".1 .2 .3"/></body>'
        "</worldbody></mujoco>"
    )
    states = np.array([[1.0, 2.0, 3.0, 1, 0, 0, 0], [1.0, 2.0, 4.0, 1, 0, 0, 0]])
    np.savez(tmp_path / "set.npz", terminals=[False, True], qpos=states)
    (tmp_path / "m.yaml").write_text("model: scene.xml\nfps: 20\n")
    trace = sr.read_trace(f"{tmp_path}/set.npz#0", mapping=tmp_path / "m.yaml")
    assert trace.names == ("cube",) and trace.times_ns.tolist() == [0, 50_000_000]
    assert np.allclose(positions(trace, "cube"), [[1, 2, 3], [1, 2, 4]])
    with pytest.raises(UsageError, match=r"m\.yaml: model: set .* has no states of a model"):
        episode(tmp_path, "model: scene.xml\nfeatures: {obs: {signals: {a: 0}}}", {"obs": [1.0]})
    (tmp_path / "bare.yaml").write_text("fps: 20\n")
    with pytest.raises(UsageError, match="names no objects of set"):
        sr.read_trace(f"{tmp_path}/set.npz#0", mapping=tmp_path / "bare.yaml")
