"""Cameras: detected tags, poses of tagged objects with their uncertainty, and samples.

Each name is imported at its first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import lazy_attributes

if TYPE_CHECKING:
    from spatial_replay.perception.image_sources import CameraFrames, open_frames
    from spatial_replay.perception.observer import Observation, TagObserver, observe_cameras, observe_frames
    from spatial_replay.perception.opencv import Frame
    from spatial_replay.perception.tags_file import TagsFile, load_tags, parse_tags

__all__ = [
    "CameraFrames",
    "Frame",
    "Observation",
    "TagObserver",
    "TagsFile",
    "load_tags",
    "observe_cameras",
    "observe_frames",
    "open_frames",
    "parse_tags",
]

__getattr__, __dir__ = lazy_attributes(globals())
