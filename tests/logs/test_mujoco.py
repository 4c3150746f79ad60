"""Models of MuJoCo: footprints of free bodies, and models whose files are elsewhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spatial_replay.errors import LogError
from spatial_replay.logs.formats.episodes import Body
from spatial_replay.logs.formats.mujoco import model_from_file, model_from_xml

pytest.importorskip("mujoco")

DIRECTIONS = np.stack([np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8)])
CUBE = '<geom type="box" size="0.03 0.05 0.02"/>'
MESH = '<geom type="mesh" mesh="can"/>'
TETRAHEDRON = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def scene(geoms: str, assets: str = "", world: str = "") -> str:
    body = f'<body name="cup"><freejoint/>{geoms}</body>'
    return f"<mujoco>{assets}<worldbody>{world}{body}</worldbody></mujoco>"


def only_body(xml: str, *poses: list[float], assets: Path | None = None) -> Body:
    (body,) = model_from_xml(xml, "scene.xml", assets).bodies(np.array(poses), "qpos")
    return body


def pairs(numbers: list[list[float]]) -> str:
    return " ".join(str(number) for row in numbers for number in row)


def test_footprints_and_heights_are_those_of_the_surfaces(data_folder: Path) -> None:
    path = data_folder / "vectors" / "footprints.json"
    vectors: list[dict[str, Any]] = json.loads(path.read_text())["vectors"]
    mesh = next(vector for vector in vectors if "faces_given" in vector)
    shape = f'vertex="{pairs(mesh["vertices_given"])}" face="{pairs(mesh["faces_given"])}"'
    for vector in vectors:
        size = " ".join(map(str, vector["size"]))
        geom = MESH if vector["type"] == "mesh" else f'<geom type="{vector["type"]}" size="{size}"/>'
        xml = scene(geom, f'<asset><mesh name="can" {shape}/></asset>')
        body = only_body(xml, [*vector["body_pos"], *vector["body_quat_wxyz"]])
        assert body.shapes is not None
        (part,) = body.shapes.footprint(0).parts
        support = (part.vertices @ DIRECTIONS).max(axis=0) + part.radius
        tolerance = 1e-6 if vector["type"] == "mesh" else 1e-9
        expected = vector["expected"]
        np.testing.assert_allclose(support, expected["support_16_directions"], rtol=0, atol=tolerance)
        np.testing.assert_allclose(body.shapes.height(0), expected["height"], rtol=0, atol=tolerance)


def test_a_model_is_compiled_once_until_a_file_of_it_changes(tmp_path: Path) -> None:
    (tmp_path / "can.obj").write_text(TETRAHEDRON)
    (tmp_path / "scene.xml").write_text(scene(MESH, '<asset><mesh name="can" file="can.obj"/></asset>'))
    model = model_from_file(tmp_path / "scene.xml")
    assert model_from_file(tmp_path / "scene.xml") is model
    (tmp_path / "can.obj").write_text(TETRAHEDRON.replace("0.1", "0.2"))
    assert model_from_file(tmp_path / "scene.xml") is not model


def test_colliding_geoms_alone_are_the_footprint() -> None:
    visual = '<geom type="sphere" size="0.5" contype="0" conaffinity="0"/>'
    knob = '<geom type="sphere" size="0.01" pos="0.1 0 0"/>'
    body = only_body(scene(CUBE + visual + knob), [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    assert body.shapes is not None
    assert len(body.shapes.footprint(0).parts) == 2
    assert body.shapes.height(0) == (0.98, 1.02)


def test_a_state_that_is_not_finite_is_unknown_alone() -> None:
    at = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    body = only_body(scene(CUBE), at, [np.nan, *at[1:]], [1.0, *at[1:]])
    assert np.isnan(body.positions[1]).all()
    assert body.positions[2, 0] == 1.0
    assert body.shapes is not None
    assert np.isnan(body.shapes.bottom).tolist() == [False, True, False]
    assert body.shapes.height(2) == (-0.02, 0.02)


FOREIGN = (
    '<compiler meshdir="/home/recorder/models/meshes"/><asset><mesh name="can" file="objects/can.obj"/>'
    '<texture name="wood" type="2d" file="/home/recorder/wood.png"/>'
    '<material name="wood" texture="wood"/></asset>'
)


def test_a_mesh_that_is_not_in_the_data_makes_a_point() -> None:
    model = model_from_xml(scene(MESH, FOREIGN, '<body name="goal" mocap="true"/>'), "scene.xml")
    (body,) = model.bodies(np.array([[1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]]), "qpos")
    assert body.shapes is None
    assert body.positions.tolist() == [[1.0, 2.0, 3.0]]
    assert body.quaternions is not None
    assert body.quaternions.tolist() == [[0.0, 0.0, 0.0, 1.0]]
    (mocap,) = model.remarks
    assert "not in the states of the model: goal;" in mocap


def test_a_visual_mesh_that_is_missing_leaves_the_footprint_of_colliding_geoms() -> None:
    visual = MESH.replace("/>", ' contype="0" conaffinity="0" material="wood"/>')
    model = model_from_xml(scene(CUBE + visual, FOREIGN), "scene.xml")
    assert model.remarks == ()


def test_meshes_come_from_the_folder_of_assets(tmp_path: Path) -> None:
    (tmp_path / "objects").mkdir()
    (tmp_path / "objects" / "can.obj").write_text(TETRAHEDRON)
    body = only_body(scene(MESH, FOREIGN), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], assets=tmp_path)
    assert body.shapes is not None
    assert body.shapes.height(0) == pytest.approx((0.0, 0.1), abs=1e-6)


@pytest.mark.parametrize("name", ["../can.obj", "link.obj"])
def test_no_mesh_outside_the_folder_of_assets_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "can.obj").write_text(TETRAHEDRON)
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "link.obj").symlink_to(tmp_path / "can.obj")
    xml = scene(MESH, f'<asset><mesh name="can" file="{name}"/></asset>')
    body = only_body(xml, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], assets=tmp_path / "assets")
    assert body.shapes is None


@pytest.mark.parametrize(
    ("xml", "reason"),
    [
        ("<mujoco", "is broken"),
        ("<robot/>", "its root is <robot>"),
        ('<!DOCTYPE m [<!ENTITY a "aa">]><mujoco/>', "declares a document type"),
        ("<mujoco>" + "<body>" * 500 + "</body>" * 500 + "</mujoco>", "200 deep"),
        (scene(f'<replicate count="999999999">{CUBE}</replicate>'), "10,000 times"),
        (scene('<geom type="box"/>'), "does not compile scene.xml"),
    ],
)
def test_models_that_cannot_be_used_are_refused(xml: str, reason: str) -> None:
    with pytest.raises(LogError, match=reason):
        model_from_xml(xml, "scene.xml")


def test_states_of_another_model_are_refused() -> None:
    with pytest.raises(LogError, match=r"a state of scene.xml has 14 numbers: time, 7 of qpos, 6 of qvel"):
        model_from_xml(scene(CUBE), "scene.xml").states(np.zeros((3, 32)), "states")


def test_robosuite_states_give_the_positions_of_the_simulator(data_folder: Path) -> None:
    h5py = pytest.importorskip("h5py")
    answers = json.loads((data_folder / "learning" / "robomimic" / "answers.json").read_text())
    with h5py.File(data_folder / "learning" / "robomimic" / "lift.hdf5") as file:
        for answer in answers:
            demo = file["data"][answer["demo"]]
            model = model_from_xml(demo.attrs["model_file"], "model_file")
            times, (cube,) = model.states(demo["states"][:], "states")
            assert cube.shapes is not None
            for pose in answer["poses"]:
                index = pose["state_index"]
                assert times[index] == pose["time"]
                assert cube.positions[index].tolist() == pose["cube_qpos"][:3]
                centre = np.mean(cube.shapes.footprint(index).parts[0].vertices, axis=0)
                np.testing.assert_allclose(centre, pose["cube_qpos"][:2], atol=1e-12)
