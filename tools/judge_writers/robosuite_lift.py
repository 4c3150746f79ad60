"""Write robosuite's Lift by a scripted grasp, with robosuite's own recorder and gatherer."""

import json
import sys
import tempfile

import numpy as np
import robosuite
from robosuite.scripts.collect_human_demonstrations import gather_demonstrations_as_hdf5
from robosuite.wrappers import DataCollectionWrapper

settings = {"env_name": "Lift", "robots": "Panda"}
recordings = tempfile.mkdtemp()
environment = DataCollectionWrapper(
    robosuite.make(
        **settings,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        control_freq=20,
        ignore_done=True,
    ),
    recordings,
    collect_freq=1,
)
for episode in range(4):
    observation, closing = environment.reset(), 0
    for _ in range(70):
        action = np.zeros(environment.action_dim)
        away = observation["cube_pos"] - observation["robot0_eef_pos"]
        if not closing and np.linalg.norm(away) >= 0.015:
            above = np.array([0.0, 0.0, 0.08 if np.linalg.norm(away[:2]) > 0.015 else 0.0])
            action[:3], action[-1] = np.clip(8 * (away + above), -1, 1), -1
        else:
            closing, action[-1] = closing + 1, 1
            # the last episode never lifts: the gatherer drops it
            action[2] = 0.4 if closing > 8 and episode < 3 else 0.0
        observation, *_ = environment.step(action)
environment.reset()
environment.close()
gather_demonstrations_as_hdf5(recordings, sys.argv[1], json.dumps(settings))
