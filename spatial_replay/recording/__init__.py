"""Recording: samples in, a log out, with the robustness of specifications beside them."""

from __future__ import annotations

from spatial_replay.logs.topics import ENDING
from spatial_replay.recording.log import Recording
from spatial_replay.recording.recorder import Recorded, Recorder, record_source

__all__ = ["ENDING", "Recorded", "Recorder", "Recording", "record_source"]
