"""What a camera saw as messages of Foxglove: the video, outlines drawn on it, the calibration, the pose."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from google.protobuf.timestamp_pb2 import Timestamp

from spatial_replay.annotate.obligations import Standing
from spatial_replay.annotate.requirements import Requirement, requirements_of
from spatial_replay.annotate.scene.scene_entities import FRAME
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.logs.topics import (
    CAMERA_ANNOTATIONS,
    CAMERA_CALIBRATION,
    CAMERA_FRAMES,
    CAMERA_VIDEO,
    protobuf_channel,
    topic_of_camera,
)
from spatial_replay.monitor.monitor import Update
from spatial_replay.palette import FAILING, NEGATIVE, NEUTRAL, POSITIVE
from spatial_replay.perception.camera_view import View
from spatial_replay.perception.opencv import Camera
from spatial_replay.perception.plane import CameraPlane
from spatial_replay.spec.formula import ANY_CLASS, Specification
from spatial_replay.trace.sample import Sample

TRANSFORMS: Final = protobuf_channel(CAMERA_FRAMES, FrameTransforms)

_AROUND: Final = 24
"""Points of the outline of a disc."""
_THICKNESS, _LETTERS = 3.0, 16.0

Colour = tuple[float, float, float]


class CameraChannels:
    """The channels of one of several cameras, and the name of its frame; a process for one run."""

    def __init__(self, number: int) -> None:
        """Name them: `/camera/video`, `/camera2/video`."""
        self.frame = "camera" if number == 1 else f"camera{number}"
        self.video = protobuf_channel(topic_of_camera(CAMERA_VIDEO, number), CompressedVideo)
        self.annotations = protobuf_channel(topic_of_camera(CAMERA_ANNOTATIONS, number), ImageAnnotations)
        self.calibration = protobuf_channel(topic_of_camera(CAMERA_CALIBRATION, number), CameraCalibration)


class AskedColours:
    """The colours of what specifications ask of each object, from sample to sample."""

    def __init__(self, files: Sequence[Specification]) -> None:
        """Find the requirements of each result."""
        self._requirements = [[requirements_of(spec.formula) for spec in file.results] for file in files]

    def of(self, sample: Sample, updates: Sequence[Update]) -> Mapping[str, Colour]:
        """Return the colour of each object: of the worst requirement that it takes part in, grey without one.

        Args:
            updates: of each file, after the sample.
        """
        worst: dict[str, int] = {}
        at = np.zeros(1, np.int64)
        for of_file, update in zip(self._requirements, updates, strict=True):
            for requirements, spec in zip(of_file, update.specs, strict=True):
                if spec.numbers is None:
                    continue
                series = spec.numbers[:, :, None]
                for each in requirements:
                    standing = _RANKS[Standing(int(each.standing(series, at)[0]))]
                    for name in _members(each, sample):
                        worst[name] = max(worst.get(name, 0), standing)
        return {name: _COLOURS[worst.get(name, 0)] for name in sample.objects}


_RANKS: Final = {
    Standing.FULFILLED: 0,
    Standing.UNKNOWN: 0,
    Standing.HOLDING: 1,
    Standing.PENDING: 2,
    Standing.VIOLATED: 3,
}
_COLOURS: Final = (NEUTRAL, POSITIVE, FAILING, NEGATIVE)


def _members(requirement: Requirement, sample: Sample) -> set[str]:
    names = set(requirement.objects)
    for group in requirement.groups:
        for name, each in sample.objects.items():
            kind = each.class_name if isinstance(each, TrackedObject) else None
            if group.class_name == ANY_CLASS or (kind or "").casefold() == group.class_name:
                names |= {name} - group.excluded
    return names


def encode_video(time_ns: int, data: bytes, frame: str) -> bytes:
    """Return the message of one frame in H.264."""
    message = CompressedVideo(frame_id=frame, data=data, format="h264")
    _stamp(message.timestamp, time_ns)
    return message.SerializeToString(deterministic=True)


def encode_annotations(seen: View, sample: Sample, colours: Mapping[str, Colour]) -> bytes:
    """Return the outlines and names of the objects, and the outlines and numbers of all tags, in a view."""
    message = ImageAnnotations()
    time_ns = seen.frame.time_ns
    for detection in seen.detections:
        _outline(message, time_ns, detection.corners, NEUTRAL, 1.0)
        _text(message, time_ns, str(detection.id), detection.corners.mean(axis=0), NEUTRAL, 0.7 * _LETTERS)
    if seen.plane is None:
        return message.SerializeToString(deterministic=True)
    for name, each in sample.objects.items():
        if not isinstance(each, TrackedObject):
            continue
        colour = colours.get(name, NEUTRAL)
        # as high as its upper face, where its tags are
        z = 0.0 if each.height is None else each.height[1]
        lowest: Floats | None = None
        for part in each.footprint.parts:
            ring = _ring(part.vertices, part.radius)
            places = np.concatenate([ring, np.full((len(ring), 1), z)], axis=1)
            pixels = seen.plane.pixels(places)
            if not np.isfinite(pixels).all():
                continue
            _outline(message, time_ns, pixels, colour, _THICKNESS)
            bottom = pixels[pixels[:, 1].argmax()]
            lowest = bottom if lowest is None or bottom[1] > lowest[1] else lowest
        if lowest is not None:
            _text(message, time_ns, name, lowest + np.array([0.0, _LETTERS]), colour, _LETTERS)
    return message.SerializeToString(deterministic=True)


def encode_calibration(time_ns: int, camera: Camera, frame: str) -> bytes:
    """Return the calibration of a camera."""
    width, height = camera.size
    numbers = list(camera.distortion)
    message = CameraCalibration(
        frame_id=frame,
        width=width,
        height=height,
        distortion_model="plumb_bob" if len(numbers) <= 5 else "rational_polynomial",
        D=numbers + [0.0] * (5 - len(numbers)) if len(numbers) < 5 else numbers,
        K=camera.matrix.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.concatenate([camera.matrix, np.zeros((3, 1))], axis=1).ravel().tolist(),
    )
    _stamp(message.timestamp, time_ns)
    return message.SerializeToString(deterministic=True)


def encode_camera_pose(time_ns: int, plane: CameraPlane, frame: str) -> bytes:
    """Return where the camera is in the frame of the scene."""
    message = FrameTransforms()
    each = message.transforms.add(parent_frame_id=FRAME, child_frame_id=frame)
    _stamp(each.timestamp, time_ns)
    x, y, z = (-plane.rotation.T @ plane.pose[3:]).tolist()
    each.translation.x, each.translation.y, each.translation.z = x, y, z
    # the other way round than the pose, which takes the scene to the camera
    turn = -plane.pose[:3]
    angle = float(np.linalg.norm(turn))
    part = math.sin(angle / 2) / angle if angle > 0 else 0.5
    each.rotation.w = math.cos(angle / 2)
    each.rotation.x, each.rotation.y, each.rotation.z = (part * turn).tolist()
    return message.SerializeToString(deterministic=True)


def _ring(vertices: Floats, radius: float) -> Floats:
    """Return the outline of a convex part: of a rounded one, points on the arcs around its corners."""
    if not radius:
        return vertices
    angles = np.linspace(0, 2 * math.pi, _AROUND, endpoint=False)
    around = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    if len(vertices) == 1:
        return vertices + around
    support = (around @ vertices.T).argmax(axis=1)
    return np.asarray(vertices[support] + around, np.float64)


def _outline(
    message: ImageAnnotations, time_ns: int, pixels: Floats, colour: Colour, thickness: float
) -> None:
    each = message.points.add(type=PointsAnnotation.LINE_LOOP, thickness=thickness)
    _stamp(each.timestamp, time_ns)
    each.outline_color.r, each.outline_color.g, each.outline_color.b = colour
    each.outline_color.a = 1.0
    for x, y in pixels.tolist():
        # viewers count from the outer corner of the first pixel
        each.points.add(x=x + 0.5, y=y + 0.5)


def _text(
    message: ImageAnnotations, time_ns: int, text: str, place: Floats, colour: Colour, size: float
) -> None:
    each = message.texts.add(text=text, font_size=size)
    _stamp(each.timestamp, time_ns)
    each.position.x, each.position.y = (place + 0.5).tolist()
    each.text_color.r, each.text_color.g, each.text_color.b = colour
    each.text_color.a = 1.0
    each.background_color.r = each.background_color.g = each.background_color.b = 1.0
    each.background_color.a = 0.8


def _stamp(stamp: Timestamp, time_ns: int) -> None:
    stamp.seconds, stamp.nanos = divmod(time_ns, 10**9)
