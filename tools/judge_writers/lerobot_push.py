"""Write a made push of a puck with LeRobot's writer: some episodes push the puck past the goal."""

import os
import sys
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

PLACES = ["puck_x", "puck_y", "puck_z", "goal_x", "goal_y", "goal_z"]
FEATURES = {
    "observation.environment_state": {"dtype": "float32", "shape": (6,), "names": PLACES},
    "action": {"dtype": "float32", "shape": (2,), "names": ["dx", "dy"]},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}
data_set = LeRobotDataset.create(
    "local/push", fps=20, features=FEATURES, root=Path(sys.argv[1]) / "push", use_videos=False
)
for episode in range(10):
    random = np.random.default_rng(episode)
    puck, goal = random.uniform(-0.3, 0.0, 2), np.array([0.2, 0.1])
    push = 0.015 * (goal - puck) / np.linalg.norm(goal - puck)
    for step in range(60):
        # odd episodes push on, past the goal, and their label counts that; the last even one never begins
        action = push if episode % 2 else np.clip(goal - puck, -0.015, 0.015) * (episode != 8)
        state = np.array([*puck, 0.02, *goal, 0.02], np.float32)
        puck = puck + action
        success = bool(np.linalg.norm(goal - puck) <= 0.05)
        data_set.add_frame(
            {
                "observation.environment_state": state,
                "action": action.astype(np.float32),
                "next.success": np.array([success]),
                "next.done": np.array([step == 59]),
                "task": "push the puck to the goal",
            }
        )
    data_set.save_episode()
data_set.finalize()
