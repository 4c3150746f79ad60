"""Remarks on episodes whose frames or quaternions contradict each other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import spatial_replay as sr
from spatial_replay.geometry.arrays import Floats

FRAMES = 60


def read(folder: Path, poses: Floats, *, keys: str = "", fps: int = 20) -> sr.Trace:
    """Read an episode of one object from its positions, or poses, in each frame."""
    np.savez(folder / "cup.npz", cup=poses, terminals=np.arange(len(poses)) == len(poses) - 1)
    entry = f'{{name: cup, position: "[0:3]", height: [0, 0]{keys}}}'
    (folder / "cup.yaml").write_text(f"fps: {fps}\nfeatures: {{cup: {entry}}}\n")
    return sr.read_trace(f"{folder / 'cup.npz'}#0", mapping=folder / "cup.yaml")


def path(x: Callable[[Floats], Floats]) -> Floats:
    seconds = np.arange(FRAMES) / 20
    return np.column_stack([x(seconds), np.zeros(FRAMES), np.zeros(FRAMES)])


def test_exchanged_frames_are_remarked(tmp_path: Path) -> None:
    poses = path(lambda seconds: 0.2 * seconds)
    poses[10:20], poses[40:50] = poses[40:50].copy(), poses[10:20].copy()
    (remark,) = read(tmp_path, poses).remarks
    assert remark.startswith("cup.npz#0 at 0.500 s: cup jumps by 0.31, and moves at most 0.01 in the frames")
    assert "(4 jumps in all)" in remark


@pytest.mark.parametrize(
    "x",
    [
        lambda seconds: 0.2 * seconds,
        # pushed from rest to 1 m/s within one frame
        lambda seconds: np.maximum(0.0, seconds - 1.0),
        # grasped, carried, and put down
        lambda seconds: np.clip(seconds - 1.0, 0.0, 0.5),
        # falls for one frame after a reset
        lambda seconds: np.where(seconds > 0, 0.0, 0.012),
    ],
)
def test_motions_of_robots_are_no_jumps(x: Callable[[Floats], Floats], tmp_path: Path) -> None:
    assert not read(tmp_path, path(x)).remarks


def test_a_quaternion_in_the_other_order_is_remarked(tmp_path: Path) -> None:
    turn = np.linspace(0.1, 0.6, FRAMES)
    poses = np.column_stack([path(lambda seconds: seconds), np.cos(turn), 0 * turn, 0 * turn, np.sin(turn)])
    right, wrong = (
        read(tmp_path, poses, keys=f', orientation: "[3:7]", order: {order}').remarks
        for order in ("wxyz", "xyzw")
    )
    assert not right
    assert wrong == (
        "cup.npz#0: cup stands upright only if its orientation has the other order; check `order`",
    )


def test_bodies_without_a_shape_are_points_at_their_heights(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    actors = tmp_path / "stack.h5"
    with h5py.File(actors, "w") as file:
        for name, height in (("lower", 0.02), ("upper", 0.06)):
            state = np.tile([0.1, 0.2, height, 1.0, *[0.0] * 9], (5, 1))
            file[f"traj_0/env_states/actors/{name}"] = state
        file["traj_0/actions"] = np.zeros((4, 2))
    trace = sr.read_trace(f"{actors}#0")
    result = sr.evaluate(sr.parse_specification("spec s = G (upper dist lower >= 0)"), trace)
    assert result.node("s").robustness == pytest.approx(0.04)
