"""Write OGBench's cube-double by its own oracle: an npz with the keys of its data sets, and its model."""

import sys
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import ogbench  # noqa: F401 (registers the environments)
from ogbench.manipspace.oracles.plan.cube_plan import CubePlanOracle

folder, steps = Path(sys.argv[1]), 150
environment = gymnasium.make(
    "cube-double-v0", terminate_at_goal=False, mode="data_collection", max_episode_steps=1001
)
columns = {name: [] for name in ("observations", "actions", "terminals", "qpos", "target", "success")}
for episode in range(10):
    np.random.seed(episode)
    oracle = CubePlanOracle(env=environment, noise=0.3 * (episode % 4), noise_smoothing=0.5)
    observation, info = environment.reset(seed=episode)
    oracle.reset(observation, info)
    for step in range(steps):
        action = np.clip(np.array(oracle.select_action(observation, info)), -1, 1).astype(np.float32)
        columns["observations"].append(observation.astype(np.float32))
        columns["actions"].append(action)
        columns["qpos"].append(info["qpos"].astype(np.float32))
        columns["target"].append([*info["privileged/target_block_pos"], info["privileged/target_block"]])
        observation, _, _, _, info = environment.step(action)
        columns["success"].append(bool(info["success"]))
        columns["terminals"].append(step == steps - 1)
np.savez_compressed(folder / "cubes.npz", **{name: np.array(values) for name, values in columns.items()})
mujoco.mj_saveLastXML(str(folder / "scene.xml"), environment.unwrapped._model)
