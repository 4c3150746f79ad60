"""Read with LeRobot what the judge has annotated: choose its successes, as a training would."""

import logging
import os
import sys
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"
# without FFmpeg, the library for videos writes 80 lines
logging.disable(logging.WARNING)

from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402

root = Path(sys.argv[1]) / "annotated"
whole = LeRobotDataset("local/push", root=root)
successes = LeRobotDataset("local/push", root=root, episode_filter=lambda episode: episode["judge/success"])
print(f"LeRobot reads {whole.num_episodes} episodes, {successes.num_episodes} of them judged successes")
print("episode columns:", ", ".join(name for name in whole.meta.episodes.column_names if "judge" in name))
print("frame columns:", ", ".join(sorted(whole[0])))
stages = [(row["timestamp"], row["content"]) for row in whole[0]["language_persistent"]]
print("stages of episode 0:", "; ".join(f"{name} from {second:.2f} s" for second, name in stages))
