"""Recording: samples in, a log out, with the robustness of specifications beside them."""

from __future__ import annotations

from spatial_replay.logs.topics import ENDING
from spatial_replay.recording.record_source import Recorded, record_source
from spatial_replay.recording.recorder import Recorder
from spatial_replay.recording.recording import Recording

__all__ = ["ENDING", "Recorded", "Recorder", "Recording", "record_source"]
