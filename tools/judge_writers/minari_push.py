"""Write Meta-World's push-v3 by a scripted policy with noise, in both storages of Minari."""

import os
import sys
from pathlib import Path

os.environ["MINARI_DATASETS_PATH"] = str(Path(sys.argv[1]).absolute())

import metaworld
import numpy as np
from metaworld.policies import ENV_POLICY_MAP
from minari import DataCollector, StepDataCallback


class Poses(StepDataCallback):
    """Store equal infos at reset and step: Minari refuses those that differ."""

    def __call__(self, env, obs, info, *args, **options):
        data = super().__call__(env, obs, info, *args, **options)
        body = env.unwrapped.data.body("obj")
        success = np.float64(info.get("success", 0.0))
        data["info"] = {"success": success, "obj_pos": body.xpos.copy(), "obj_quat": body.xquat.copy()}
        return data


tasks = metaworld.MT1("push-v3", seed=7)
for storage in ("hdf5", "arrow"):
    environment, policy = tasks.train_classes["push-v3"](), ENV_POLICY_MAP["push-v3"]()
    collector = DataCollector(environment, record_infos=True, data_format=storage, step_data_callback=Poses)
    for episode in range(10):
        environment.set_task(tasks.train_tasks[episode])
        observation, _ = collector.reset(seed=episode)
        random = np.random.default_rng(episode)
        for _ in range(80):
            action = policy.get_action(observation) + random.normal(0, 0.1 * episode, 4)
            observation, *_ = collector.step(np.clip(action, -1, 1).astype(np.float32))
    collector.create_dataset(
        dataset_id=f"push-{storage}/scripted-v0",
        algorithm_name="scripted",
        author="campaign",
        code_permalink="none",
    )
    collector.close()
