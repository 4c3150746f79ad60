"""Cameras: frames to tags, tags to objects with their uncertainty, objects to samples.

Names are loaded when they are first used.
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
