"""What a camera sees: frames to tags, tags to objects with their uncertainty, objects to samples.

    frame           an image with its time
    video           frames of video files, H.264; the only importer of PyAV
    image_topics    frames of MCAP files and ROS bags
    camera_frames   frames of a camera, as they come
    opencv          tags in images, calibration; the only importer of OpenCV
    corners         their corners to a fraction of a pixel
    tags_file       which tag is on which object, where the plane is
    plane           pixels to places
    object_poses    corners to poses and their covariance
    camera_view     one camera: its tags, its plane, poses of objects
    camera_pose     where a camera is
    simultaneous    frames of several cameras that belong together
    observer        frames to samples
    camera_messages what the log shows of it
    calibration     a camera from views of known tags
    tag_sheet       tags to print
    rendering       images whose truth is known

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.perception.camera_frames import CameraFrames
    from spatial_replay.perception.frame import Frame
    from spatial_replay.perception.image_topics import open_frames
    from spatial_replay.perception.observer import (
        Observation,
        TagObserver,
        observe_cameras,
        observe_frames,
    )
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

__getattr__, __dir__ = loaded_when_used(
    globals(),
    {
        "camera_frames": ("CameraFrames",),
        "frame": ("Frame",),
        "image_topics": ("open_frames",),
        "observer": ("Observation", "TagObserver", "observe_cameras", "observe_frames"),
        "tags_file": ("TagsFile", "load_tags", "parse_tags"),
    },
)
