"""Data sets in HDF5 and of Minari: known positions, orders of quaternions, labels, and files with traps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import spatial_replay as sr
from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.formats.datasets import open_data_set
from spatial_replay.logs.formats.episodes import DataSet, EpisodeColumns, EpisodeReading

h5py = pytest.importorskip("h5py")

AT_20_HZ = EpisodeReading(fps=20)
XYZW = EpisodeReading(fps=20, order="xyzw")
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def opened(path: Path) -> DataSet:
    data_set = open_data_set(path)
    assert data_set is not None
    return data_set


def body(columns: EpisodeColumns, name: str, row: int) -> list[float]:
    """Return the position and the quaternion, x y z w, of a body."""
    body = next(body for body in columns.bodies if body.name == name)
    assert body.quaternions is not None
    return [*body.positions[row], *body.quaternions[row]]


@pytest.mark.parametrize("task", ["PushCube-v1", "StackCube-v1"])
def test_maniskill_gives_the_poses_of_the_simulator(data_folder: Path, task: str) -> None:
    folder = data_folder / "learning" / "maniskill"
    data_set = opened(folder / f"{task}.h5")
    assert data_set.fps == 20 and data_set.names_bodies and not data_set.remarks
    for answer in json.loads((folder / f"{task}_answers.json").read_text()):
        number = answer["episode"]
        columns = data_set.columns(number)
        assert (data_set.episode(number).seed, data_set.episode(number).task) == (number, task)
        assert columns.label == answer["success_any"]
        assert len(columns.times_ns) == answer["steps"] + 1
        for pose in answer["poses"]:
            for name in [body.name for body in columns.bodies]:
                x, y, z, qw, qx, qy, qz = pose[name]
                at = body(columns, name, pose["step"])
                np.testing.assert_allclose(at, [x, y, z, qx, qy, qz, qw], rtol=0, atol=2e-7)
            assert columns.times_ns[pose["step"]] == pose["step"] * 50_000_000


def test_isaac_lab_gives_equal_poses_in_both_orders(data_folder: Path) -> None:
    folder = data_folder / "learning" / "isaaclab"
    new, old = opened(folder / "xyzw.hdf5"), opened(folder / "wxyz_before_2026.hdf5")
    for number, answer in enumerate(json.loads((folder / "answers.json").read_text())):
        columns, before = new.columns(number, AT_20_HZ), old.columns(number, AT_20_HZ)
        assert columns.label and new.episode(number).seed == number
        for pose in answer["poses"]:
            for name in ("cube_1", "cube_2"):
                at = body(columns, name, pose["frame"])
                assert at == body(before, name, pose["frame"])
                np.testing.assert_allclose(at[:3], pose[name], rtol=0, atol=1e-9)
                yaw = 2 * np.arctan2(at[5], at[6])
                assert np.cos(yaw - pose[f"{name}_yaw"]) > 1 - 1e-4
    with pytest.raises(UsageError, match="does not say how many frames a second"):
        new.columns(0)


def test_robosuite_gives_the_positions_of_the_simulator(data_folder: Path) -> None:
    pytest.importorskip("mujoco")
    folder = data_folder / "learning" / "robomimic"
    data_set = opened(folder / "lift.hdf5")
    assert data_set.remarks[0].startswith("it holds successes only")
    assert data_set.label is not None and data_set.label.is_about_next and not data_set.label.is_stored
    for number, answer in enumerate(json.loads((folder / "answers.json").read_text()), 1):
        columns = data_set.columns(number)
        assert data_set.episode(number).key == answer["demo"] and columns.label
        for pose in answer["poses"]:
            row = pose["state_index"]
            assert body(columns, "cube_main", row)[:3] == pose["cube_qpos"][:3]
            assert columns.times_ns[row] == round(pose["time"] * 1e9)


def test_d4rl_gives_the_positions_of_the_simulator(data_folder: Path) -> None:
    folder = data_folder / "learning" / "d4rl"
    data_set = opened(folder / "cube-double-d4rl.hdf5")
    answers = json.loads((folder / "answers.json").read_text())
    assert len(data_set.episodes) == len(answers) and not data_set.remarks
    for answer in answers:
        columns = data_set.columns(answer["episode"], AT_20_HZ, ["infos/qpos", "infos/goal"])
        for pose in answer["poses"]:
            qpos = columns.features["infos/qpos"][pose["step"]]
            np.testing.assert_allclose(qpos[14:21], pose["block_0"], rtol=0, atol=1e-6)
            np.testing.assert_allclose(qpos[21:28], pose["block_1"], rtol=0, atol=1e-6)
            assert columns.features["infos/goal"][pose["step"]].tolist() == pose["target"]


def test_minari_gives_the_positions_of_the_simulator_in_both_storages(data_folder: Path) -> None:
    folder = data_folder / "learning" / "minari"
    answers = json.loads((folder / "answers.json").read_text())
    reading = EpisodeReading(fps=80)
    hdf5, arrow = (opened(folder / f"push-{name}" / "scripted-v0") for name in ("hdf5", "arrow"))
    for answer in answers["push-hdf5/scripted-v0"]:
        number = answer["episode"]
        columns, twin = hdf5.columns(number, reading), arrow.columns(number, reading)
        assert hdf5.episode(number).seed == arrow.episode(number).seed == number
        assert columns.features.keys() == twin.features.keys() and not columns.unjudged + twin.unjudged
        for name, values in columns.features.items():
            np.testing.assert_array_equal(values, twin.features[name])
        assert columns.success is not None and twin.success is not None
        assert columns.success.tolist() == twin.success.tolist()
        assert int(columns.success.argmax()) == (answer["first"] or 0)
        for pose in answer["poses"]:
            assert columns.features["infos/obj_pos"][pose["step"]].tolist() == pose["obj"]
            assert columns.features["observations"][pose["step"]][-3:].tolist() == pose["goal"]
            assert columns.times_ns[pose["step"]] == pose["step"] * 12_500_000
    fetch = opened(folder / "fetch" / "random-v0")
    for answer in answers["fetch/random-v0"]:
        columns = fetch.columns(answer["episode"], EpisodeReading(fps=25))
        assert columns.label == bool(answer["is_success_any"])
        for pose in answer["poses"]:
            place = columns.features["observations/achieved_goal"][pose["step"]]
            np.testing.assert_allclose(place, pose["object0_site"], rtol=0, atol=1e-9)


# ------------------------------------------------------------------------------------- order of quaternions


def isaac(path: Path, *demos: dict[str, list[tuple[float, ...]]], success: bool = True) -> Path:
    """Write demonstrations, each with the quaternions of its bodies by name."""
    with h5py.File(path, "w") as file:
        for number, bodies in enumerate(demos):
            demo = file.create_group(f"data/demo_{number}")
            demo.attrs["success"] = success
            for name, quaternions in bodies.items():
                poses = [[number, 0.0, 0.0, *quaternion] for quaternion in quaternions]
                demo[f"states/rigid_object/{name}/root_pose"] = poses
    return path


@pytest.mark.parametrize(
    ("bodies", "expected"),
    [
        # it stands until it turns
        ({"a": [IDENTITY, (0.0, 0.0, 0.6, 0.8)]}, IDENTITY),
        ({"a": [(1.0, 0.0, 0.0, 0.0)]}, IDENTITY),
        ({"a": [(0.0, 0.0, 0.6, 0.8)]}, (0.0, 0.0, 0.6, 0.8)),
        ({"a": [(0.8, 0.0, 0.0, 0.6)]}, (0.0, 0.0, 0.6, 0.8)),
        ({"a": [(0.5, 0.5, 0.5, 0.5), (0.8, 0.0, 0.0, 0.6)]}, (0.5, 0.5, 0.5, 0.5)),
        # at the start all stand upright; later one rolls, which alone would show the other order
        ({"a": [(0.0, 0.0, 0.6, 0.8), (0.8, 0.0, 0.0, 0.6)]}, (0.0, 0.0, 0.6, 0.8)),
    ],
)
def test_the_order_of_quaternions_is_that_of_upright_bodies(
    tmp_path: Path, bodies: dict[str, list[tuple[float, ...]]], expected: tuple[float, ...]
) -> None:
    columns = opened(isaac(tmp_path / "set.hdf5", bodies)).columns(0, AT_20_HZ)
    assert body(columns, "a", 0)[3:] == list(expected)


@pytest.mark.parametrize(
    "bodies",
    [
        {"a": [(0.5, 0.5, 0.5, 0.5)]},
        # half a turn about the vertical axis in the other order
        {"a": [IDENTITY], "b": [IDENTITY]},
        {"a": [(0.0, 0.0, 0.6, 0.8)], "b": [(0.8, 0.0, 0.0, 0.6)]},
    ],
)
def test_an_order_that_does_not_show_is_asked_for(
    tmp_path: Path, bodies: dict[str, list[tuple[float, ...]]]
) -> None:
    data_set = opened(isaac(tmp_path / "set.hdf5", bodies))
    with pytest.raises(UsageError, match="say `order: xyzw`"):
        data_set.columns(0, AT_20_HZ)
    columns = data_set.columns(0, XYZW)
    assert body(columns, "a", 0)[3:] == list(bodies["a"][0])


def test_numbers_that_are_no_orientation_are_refused_by_name(tmp_path: Path) -> None:
    data_set = opened(
        isaac(tmp_path / "set.hdf5", {"a": [IDENTITY]}, {"mug": [IDENTITY, (0.0, 0.0, 0.0, 0.04)]})
    )
    with pytest.raises(
        LogError, match=r"set.hdf5#1: states/rigid_object/mug has a quaternion of length 0.04 at row 1"
    ):
        data_set.columns(1, XYZW)


def test_episodes_go_by_number_and_keep_their_names(tmp_path: Path) -> None:
    data_set = opened(isaac(tmp_path / "set.hdf5", *([{"a": [IDENTITY]}] * 11), success=False))
    assert [episode.key for episode in data_set.episodes][-3:] == ["demo_8", "demo_9", "demo_10"]
    columns = data_set.columns(10, XYZW)
    assert body(columns, "a", 0)[0] == 10
    assert columns.label is False


def test_bodies_without_shapes_are_points_with_a_remark(tmp_path: Path) -> None:
    path = isaac(tmp_path / "set.hdf5", {"cup": [IDENTITY], "tray": [IDENTITY]})
    bodies = tmp_path / "bodies.yaml"
    bodies.write_text("fps: 20\norder: xyzw\nshapes: {tray: {box: [0.4, 0.3]}}\n")
    (remark,) = sr.replay_log(f"{path}#0", "cup enclosedin tray", mapping=str(bodies)).remarks
    assert "cup is a point without a shape in the data; give it by `shapes: {cup: …}`" in str(remark)


# ------------------------------------------------------------------------------------- labels and runs


def test_a_label_of_a_step_is_that_of_the_state_after_it(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "Push.h5", "w") as file:
        file["traj_0/env_states/actors/cube"] = [[0.0] * 3 + [1.0] + [0.0] * 9] * 3
        file["traj_0/success"] = [False, True]
        file["traj_0/actions"] = [[1.0], [2.0]]
    rows = [{"episode_id": 0, "episode_seed": 5}, {"episode_id": 1}]
    environment = {"env_id": "Push", "env_kwargs": {"sim_config": {"control_freq": 50}}}
    (tmp_path / "Push.json").write_text(json.dumps({"env_info": environment, "episodes": rows}))
    data_set = opened(tmp_path / "Push.h5")
    with pytest.raises(UsageError, match=r"Push.json describes the episodes of Push.h5; give .*Push.h5"):
        sr.read_trace(tmp_path / "Push.json")
    assert data_set.remarks == ("Push.json and Push.h5 differ in their episodes: traj_1",)
    columns = data_set.columns(0)
    assert columns.success is not None and columns.success.tolist() == [False, False, True]
    assert columns.times_ns.tolist() == [0, 20_000_000, 40_000_000]
    np.testing.assert_array_equal(columns.features["actions"], [[1.0], [2.0], [np.nan]])


CUBE = (
    '<mujoco><worldbody><body name="cube"><freejoint/>'
    '<geom type="box" size="0.1 0.1 0.1"/></body></worldbody></mujoco>'
)


def robosuite(path: Path, times: list[float], **attributes: Any) -> Path:
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_1")
        demo["states"] = [[time, time, 0.0, 0.0, 1.0, *[0.0] * 9] for time in times]
        demo["rewards"] = [0.0] * (len(times) - 1) + [1.0]
        demo.attrs["model_file"] = CUBE
        file["data"].attrs.update(attributes)
    return path


def test_sparse_rewards_are_the_label_of_robomimic(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    about = {"env_name": "Lift", "env_kwargs": {"reward_shaping": False}}
    path = robosuite(tmp_path / "lift.hdf5", [0.0, 0.05, 0.1], env_args=json.dumps(about))
    data_set = opened(path)
    columns = data_set.columns(1)
    assert data_set.label is not None and data_set.label.field == "rewards"
    assert columns.success is not None and columns.success.tolist() == [False, False, True]
    assert data_set.episode(1).task == "Lift"
    assert columns.bodies[0].shapes is not None and columns.bodies[0].shapes.height(0) == (-0.1, 0.1)


def test_a_time_that_steps_back_is_a_second_run(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    data_set = opened(robosuite(tmp_path / "lift.hdf5", [0.0, 0.05, 0.0, 0.05]))
    assert "goes from 0.05 s to 0 s at state 2" in data_set.columns(1).unjudged
    late = opened(robosuite(tmp_path / "late.hdf5", [2.0, 2.05]))
    assert late.columns(1).remarks == ("its time starts at 2.000 s",)


def test_an_episode_of_d4rl_without_an_end_is_remarked(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "set.hdf5", "w") as file:
        file["terminals"], file["timeouts"] = [False] * 5, [False, True, False, False, False]
        file["observations"] = np.arange(5.0)[:, None]
        file["rewards"] = [0.0, 0.0, 0.0, 1.0, np.nan]
    data_set = opened(tmp_path / "set.hdf5")
    assert data_set.remarks == ("its last episode, of 3 steps, has no terminal and no timeout",)
    columns = data_set.columns(1, EpisodeReading(fps=10, label="rewards"))
    assert columns.features["observations"].tolist() == [[2.0], [3.0], [4.0]]
    assert columns.success is not None and columns.success.tolist() == [False, True, False]


def test_a_model_gives_the_bodies_of_qpos(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "scene.xml").write_text(CUBE)
    qpos = [[0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]]
    with h5py.File(tmp_path / "set.hdf5", "w") as file:
        file["terminals"], file["observations"], file["infos/qpos"] = [False, True], [[0.0], [0.0]], qpos
    np.savez(tmp_path / "set.npz", terminals=[False, True], qpos=qpos)
    reading = EpisodeReading(fps=10, model=tmp_path / "scene.xml")
    for name in ("set.hdf5", "set.npz"):
        columns = opened(tmp_path / name).columns(0, reading)
        assert body(columns, "cube", 1) == [1.0, 0.0, 0.5, *IDENTITY]
    # a changed model changes the results of its episodes
    (tmp_path / "cube.yaml").write_text("fps: 10\nmodel: scene.xml\n")
    (tmp_path / "gate.spatial").write_text(
        "region low = box(-9, -9, 9, 9) height (-9, 0.3)\nspec s = low prec[z] cube\n"
    )

    def evaluated() -> tuple[int, list[str]]:
        gate, mapping = tmp_path / "gate.spatial", str(tmp_path / "cube.yaml")
        result = sr.evaluate_logs(tmp_path / "set.npz", gate, output=tmp_path / "results", mapping=mapping)
        return result.evaluated, result.table["verdict"].to_pylist()

    assert evaluated() == (1, ["satisfied"])
    assert evaluated() == (0, ["satisfied"])
    (tmp_path / "scene.xml").write_text(CUBE.replace("0.1 0.1 0.1", "0.1 0.1 0.4"))
    assert evaluated() == (1, ["violated"])


# ------------------------------------------------------------------------------------- Minari


def minari(folder: Path, ends: list[bool], **about: Any) -> Path:
    """Write a data set of Minari in HDF5 with one episode."""
    (folder / "data").mkdir(parents=True)
    metadata = {"minari_version": "0.5.4", "data_format": "hdf5", "total_episodes": 1, **about}
    (folder / "data" / "metadata.json").write_text(json.dumps(metadata))
    with h5py.File(folder / "data" / "main_data.hdf5", "w") as file:
        file["episode_0/observations/_index_0"] = np.arange(len(ends) + 1.0)
        file["episode_0/terminations"], file["episode_0/truncations"] = ends, [False] * len(ends)
        file["episode_0/actions"] = np.zeros((len(ends), 2))
        file["episode_0"].attrs["total_steps"] = len(ends)
    return folder


def test_two_runs_in_one_episode_of_minari_are_not_judged(tmp_path: Path) -> None:
    joined = opened(minari(tmp_path / "joined", [False, True, False, True]))
    assert joined.columns(0, AT_20_HZ).unjudged.startswith("its terminations end a run at step 1 of 4:")
    whole = opened(minari(tmp_path / "whole", [False, False, True]))
    columns = whole.columns(0, AT_20_HZ)
    assert columns.unjudged == ""
    assert columns.features["observations/0"].tolist() == [0.0, 1.0, 2.0, 3.0]


def test_a_combined_set_and_a_number_of_episodes_that_differs_are_remarked(tmp_path: Path) -> None:
    about = {"combined_datasets": ["push/a-v0", "push/b-v0", "push/a-v0"], "total_episodes": 2}
    first, second = opened(minari(tmp_path / "set", [True], **about)).remarks
    assert first == "metadata.json says 2 episodes, and the data have 1"
    assert second.startswith("it combines push/a-v0, push/b-v0: episodes that were filtered out")


# ------------------------------------------------------------------------------------- files with traps


def trap(path: Path, kind: str) -> Path:
    """Write a demonstration whose poses are not plainly in it."""
    isaac(path, {"a": [IDENTITY]}, {"a": [IDENTITY]})
    outside = path.with_name("outside.h5")
    name, poses = "states/rigid_object/b/root_pose", np.array([[0.0, 0.0, 0.0, *IDENTITY]])
    with h5py.File(outside, "w") as file:
        file["poses"] = poses
    with h5py.File(path, "a") as file:
        demo = file["data/demo_1"]
        if kind == "external link":
            demo[name] = h5py.ExternalLink(outside.name, "/poses")
        elif kind == "soft link":
            demo[name] = h5py.SoftLink("/data/demo_0/states/rigid_object/a/root_pose")
        elif kind == "virtual":
            layout = h5py.VirtualLayout((1, 7), "f8")
            layout[:] = h5py.VirtualSource(outside.name, "poses", (1, 7))
            demo.create_virtual_dataset(name, layout)
        elif kind == "external":
            demo.create_dataset(name, (1, 7), "f8", external=[(path.with_name("raw.bin"), 0, 56)])
        elif kind == "huge":
            demo.create_dataset(name, (2**40, 7), "f8", chunks=(1024, 7))
        elif kind == "filter":
            settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            settings.set_chunk((1, 7))
            settings.set_filter(32008, h5py.h5z.FLAG_OPTIONAL)
            space = h5py.h5s.create_simple((1, 7))
            group = demo.create_group("states/rigid_object/b")
            h5py.h5d.create(group.id, b"root_pose", h5py.h5t.IEEE_F64LE, space, settings)
        elif kind == "text":
            demo[name] = [b"a pose"]
    return path


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("external link", "b/root_pose is a link to another file, which is not read"),
        ("soft link", "b/root_pose is a link out of /data/demo_1/?.*, which is not followed"),
        ("virtual", "b/root_pose has its data in other files"),
        ("external", "b/root_pose has its data in other files"),
        ("huge", "claims 61,572,651,155,456 bytes"),
        ("filter", "is compressed by .*32008.*h5repack"),
        ("text", "b/root_pose holds no numbers"),
    ],
)
def test_data_that_are_not_plainly_in_the_file_are_refused(tmp_path: Path, kind: str, reason: str) -> None:
    data_set = opened(trap(tmp_path / "set.hdf5", kind))
    assert [body.name for body in data_set.columns(0, XYZW).bodies] == ["a"]
    with pytest.raises(LogError, match=reason):
        data_set.columns(1, XYZW)


def test_a_soft_link_within_an_episode_is_followed(tmp_path: Path) -> None:
    path = isaac(tmp_path / "set.hdf5", {"a": [IDENTITY]})
    with h5py.File(path, "a") as file:
        file["data/demo_0/states/rigid_object/b"] = h5py.SoftLink("/data/demo_0/states/rigid_object/a")
        # a circle of groups ends the search for features
        file["data/demo_0/states/again"] = file["data/demo_0/states"]
    columns = opened(path).columns(0, XYZW)
    assert [body.name for body in columns.bodies] == ["a", "b"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"\x89HDF\r\n\x1a\n" + b"\0" * 100, "set.hdf5 cannot be read"),
        (None, "set.hdf5 is an HDF5 file with images, which is no known layout"),
    ],
)
def test_files_of_no_known_layout_are_named(tmp_path: Path, content: bytes | None, reason: str) -> None:
    path = tmp_path / "set.hdf5"
    if content is None:
        with h5py.File(path, "w") as file:
            file["images"] = [1.0]
    else:
        path.write_bytes(content)
    with pytest.raises((LogError, UsageError), match=reason):
        open_data_set(path)


def test_an_episode_that_claims_terabytes_is_refused_before_its_times_are_counted(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "set.hdf5", "w") as file:
        poses = {"shape": (10**10, 7), "dtype": "f8", "chunks": (1000, 7)}
        file.create_dataset("data/demo_0/states/rigid_object/a/root_pose", **poses)
    with pytest.raises(LogError, match="claims 560,000,000,000 bytes"):
        opened(tmp_path / "set.hdf5").columns(0, EpisodeReading(fps=20))
