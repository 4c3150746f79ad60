"""Recordings of videos and cameras: samples from frames, changes of verdicts, and a log with the pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final, Literal, Protocol, TypeAlias

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation

from spatial_replay.annotate.requirements import Requirement, Standing, requirements_of
from spatial_replay.annotate.scene.scene_template import FRAME
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.logs.messages import Channel
from spatial_replay.logs.output_file import Durability
from spatial_replay.logs.topics import (
    CAMERA_ANNOTATIONS,
    CAMERA_CALIBRATION,
    CAMERA_FRAMES,
    CAMERA_PREFIX,
    CAMERA_VIDEO,
    OWN_PREFIX,
    protobuf_channel,
    topic_of_camera,
)
from spatial_replay.monitor.monitor import Ending, Monitor, Update
from spatial_replay.palette import NEGATIVE, NEUTRAL, POSITIVE
from spatial_replay.perception.observer import Observation, TagObserver, View, camera_names, simultaneous
from spatial_replay.perception.opencv import Camera, Frame
from spatial_replay.perception.plane import CameraPlane, Fit
from spatial_replay.perception.tags_file import TagsFile
from spatial_replay.perception.video import H264Encoder
from spatial_replay.recording.log import VerdictChange, VerdictChanges, refuse_templates
from spatial_replay.runs.scripted import RunLog, run_log
from spatial_replay.spec.formula import ANY_CLASS, Specification
from spatial_replay.trace.trace import Sample
from spatial_replay.trace.units import Axes

# --------------------------------------------------------------------------------------------------- messages

TRANSFORMS: Final = protobuf_channel(CAMERA_FRAMES, FrameTransforms)

_AROUND: Final = 24
"""Number of points on the outline of a disc."""
_THICKNESS, _LETTERS = 3.0, 16.0
"""Line width of outlines and font size of names, pixels."""

Colour = tuple[float, float, float]


def asked_colours(
    requirements: Sequence[Sequence[Requirement]], sample: Sample, updates: Sequence[Update]
) -> Mapping[str, Colour]:
    """Return the colour of each object: the colour of its worst requirement, or grey without requirements.

    Args:
        requirements: requirements of each result.
        updates: updates of all specifications at the sample.
    """
    worst_ranks: dict[str, int] = {}
    sample_indices = np.zeros(1, np.int64)
    specs = [spec for update in updates for spec in update.specs]
    for spec_requirements, spec in zip(requirements, specs, strict=True):
        if spec.numbers is None:
            continue
        node_values = spec.numbers[:, :, None]
        for requirement in spec_requirements:
            rank = _RANKS[Standing(int(requirement.standing(node_values, sample_indices)[0]))]
            for name in _members(requirement, sample):
                worst_ranks[name] = max(worst_ranks.get(name, 0), rank)
    return {name: _COLOURS[worst_ranks.get(name, 0)] for name in sample.objects}


_RANKS: Final = {
    Standing.FULFILLED: 0,
    Standing.UNKNOWN: 0,
    Standing.HOLDING: 1,
    Standing.PENDING: 2,
    Standing.VIOLATED: 3,
}
_COLOURS: Final = (NEUTRAL, POSITIVE, NEUTRAL, NEGATIVE)


def _members(requirement: Requirement, sample: Sample) -> set[str]:
    object_names = set(requirement.objects)
    for group in requirement.groups:
        for name, tracked_object in sample.objects.items():
            if group.class_name in (ANY_CLASS, (tracked_object.class_name or "").casefold()):
                object_names |= {name} - group.excluded
    return object_names


def encode_video(time_ns: int, data: bytes, frame: str) -> bytes:
    """Return the message of a frame in H.264."""
    message = CompressedVideo(frame_id=frame, data=data, format="h264")
    message.timestamp.FromNanoseconds(time_ns)
    return message.SerializeToString(deterministic=True)


def encode_annotations(view: View, sample: Sample, colours: Mapping[str, Colour]) -> bytes:
    """Return the message with the outlines in a view: objects with names, tags with numbers."""
    message = ImageAnnotations()
    time_ns = view.frame.time_ns
    for detection in view.detections:
        _outline(message, time_ns, detection.corners, NEUTRAL, 1.0)
        _text(message, time_ns, str(detection.id), detection.corners.mean(axis=0), NEUTRAL, 0.7 * _LETTERS)
    if view.plane is None:
        return message.SerializeToString(deterministic=True)
    for name, tracked_object in sample.objects.items():
        colour = colours.get(name, NEUTRAL)
        # outlines are drawn at the upper face, where the tags are
        upper_z = 0.0 if tracked_object.height is None else tracked_object.height[1]
        label_pixel: Floats | None = None
        for part in tracked_object.footprint.parts:
            ring = _ring(part.vertices, part.radius)
            outline_points = np.concatenate([ring, np.full((len(ring), 1), upper_z)], axis=1)
            pixels = view.plane.pixels(outline_points)
            if not np.isfinite(pixels).all():
                continue
            _outline(message, time_ns, pixels, colour, _THICKNESS)
            bottom = pixels[pixels[:, 1].argmax()]
            label_pixel = bottom if label_pixel is None or bottom[1] > label_pixel[1] else label_pixel
        if label_pixel is not None:
            _text(message, time_ns, name, label_pixel + np.array([0.0, _LETTERS]), colour, _LETTERS)
    return message.SerializeToString(deterministic=True)


def encode_calibration(time_ns: int, camera: Camera, frame: str) -> bytes:
    """Return the message with the calibration of a camera."""
    width, height = camera.size
    distortion = list(camera.distortion)
    # plumb_bob has five parameters, rational_polynomial has more
    # (https://docs.ros.org/en/noetic/api/sensor_msgs/html/msg/CameraInfo.html)
    message = CameraCalibration(
        frame_id=frame,
        width=width,
        height=height,
        distortion_model="plumb_bob" if len(distortion) <= 5 else "rational_polynomial",
        D=distortion + [0.0] * (5 - len(distortion)) if len(distortion) < 5 else distortion,
        K=camera.matrix.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.concatenate([camera.matrix, np.zeros((3, 1))], axis=1).ravel().tolist(),
    )
    message.timestamp.FromNanoseconds(time_ns)
    return message.SerializeToString(deterministic=True)


def encode_camera_pose(time_ns: int, plane: CameraPlane, frame: str) -> bytes:
    """Return the message with the pose of the camera in the frame of the scene."""
    message = FrameTransforms()
    transform = message.transforms.add(parent_frame_id=FRAME, child_frame_id=frame)
    transform.timestamp.FromNanoseconds(time_ns)
    x, y, z = (-plane.rotation.T @ plane.pose[3:]).tolist()
    transform.translation.x, transform.translation.y, transform.translation.z = x, y, z
    # the inverse of the pose, which transforms from the scene to the camera
    rotation_vector = -plane.pose[:3]
    angle = float(np.linalg.norm(rotation_vector))
    # the limit at angle 0 is 0.5
    sine_ratio = math.sin(angle / 2) / angle if angle > 0 else 0.5
    transform.rotation.w = math.cos(angle / 2)
    transform.rotation.x, transform.rotation.y, transform.rotation.z = (sine_ratio * rotation_vector).tolist()
    return message.SerializeToString(deterministic=True)


def _ring(vertices: Floats, radius: float) -> Floats:
    """Return the outline of a convex part; a rounded part has points on the arcs around its corners."""
    if not radius:
        return vertices
    angles = np.linspace(0, 2 * math.pi, _AROUND, endpoint=False)
    circle_points = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    if len(vertices) == 1:
        return vertices + circle_points
    # each direction belongs to the corner that is farthest in that direction
    farthest_corners = (circle_points @ vertices.T).argmax(axis=1)
    return np.asarray(vertices[farthest_corners] + circle_points, np.float64)


def _outline(
    message: ImageAnnotations, time_ns: int, pixels: Floats, colour: Colour, thickness: float
) -> None:
    outline = message.points.add(type=PointsAnnotation.LINE_LOOP, thickness=thickness)
    outline.timestamp.FromNanoseconds(time_ns)
    outline.outline_color.r, outline.outline_color.g, outline.outline_color.b = colour
    outline.outline_color.a = 1.0
    for x, y in pixels.tolist():
        # the origin is the outer corner of the first pixel, not its centre
        # (https://docs.foxglove.dev/docs/sdk/schemas/points-annotation)
        outline.points.add(x=x + 0.5, y=y + 0.5)


def _text(
    message: ImageAnnotations, time_ns: int, text: str, pixel: Floats, colour: Colour, size: float
) -> None:
    label = message.texts.add(text=text, font_size=size)
    label.timestamp.FromNanoseconds(time_ns)
    label.position.x, label.position.y = (pixel + 0.5).tolist()
    label.text_color.r, label.text_color.g, label.text_color.b = colour
    label.text_color.a = 1.0
    label.background_color.r = label.background_color.g = label.background_color.b = 1.0
    label.background_color.a = 0.8


# -------------------------------------------------------------------------------------------------- recording

KeepVideo: TypeAlias = Literal["copy", "h264", "none"]
"""Form of a video in a log: an unchanged copy, a new encoding, or no video."""

_NOT_YET_ALONE: Final = 2
"""Number of final samples without a camera's frame that need no remark; cameras end at different times."""

_POSE_EVERY_NS: Final = 10**9
"""Interval at which a log repeats the camera's constant calibration and pose, ns."""


class FrameSource(Protocol):
    """Frames with increasing times, which can be read once: a video file, an image topic, or a camera.

    Attributes:
        name: name for error messages.
        channel: channel whose messages are the frames' `data`; None if `data` is H.264.
        faults: sentences on lost frames.
        copy_fault: reason why `data` cannot be copied into a log; None if `data` can be copied.
        remark: sentence on the options of the source, available after the last frame; None without a remark.
    """

    name: str
    faults: list[str]

    @property
    def channel(self) -> Channel | None: ...

    @property
    def copy_fault(self) -> str | None: ...

    @property
    def remark(self) -> str | None: ...

    def __iter__(self) -> Iterator[Frame]: ...


@dataclass(frozen=True, slots=True)
class SeenRun:
    """The result of recording cameras.

    Attributes:
        samples: number of samples; each has at most one frame of each camera.
        seconds: time from the first to the last sample.
        endings: result of each spec at the end.
        fits: name of each camera, and fit of the camera's reference tags; None without reference tags.
        remarks: sentences on tags and objects that were missing, doubtful or not mapped.
        faults: sentences on lost parts of the videos.
        kept: form of each camera's video in the log.
    """

    samples: int
    seconds: float
    endings: tuple[Ending, ...]
    fits: tuple[tuple[str, Fit | None], ...]
    remarks: tuple[str, ...]
    faults: tuple[str, ...]
    kept: tuple[KeepVideo, ...]


def record_cameras(
    cameras: Sequence[FrameSource],
    tags: TagsFile,
    output: Path,
    files: Sequence[Specification] = (),
    *,
    offsets_ns: Sequence[int] = (),
    hold_ns: int | None = None,
    keep: KeepVideo | None = None,
    inputs: Sequence[Path] = (),
    begin: Callable[[int], None] = lambda first_ns: None,
    show: Callable[[VerdictChange], None] = lambda change: None,
    advance: Callable[[int], None] = lambda samples: None,
    durability: Durability = "process",
) -> SeenRun:
    """Record the objects in the pictures of cameras, with verdicts; equal frames give equal bytes.

    Args:
        cameras: one or several cameras, whose simultaneous frames make one sample.
        offsets_ns: offset of each camera's time stamps; empty for no offsets.
        hold_ns: time for which a hidden object keeps its position, with growing uncertainty. None for the
            value of the tags file.
        keep: form of the videos in the log. With None, each video is copied if possible, else encoded.
        inputs: input files, which the output must not overwrite.
        begin: called with the time of the first sample.
        show: called with each change of a verdict.
        advance: called with 1 for each sample.

    Raises:
        UsageError: a specification that cannot be recorded, reference tags that do not fit, an unknown
            camera, a calibration for another picture size, or a video that cannot be copied.
        LogError: no frame can be read.
        OutputError: the output cannot be written.
    """
    refuse_templates(files)
    names = camera_names(cameras)
    keep_modes: list[KeepVideo] = []
    for camera in cameras:
        if keep == "copy" and camera.copy_fault is not None:
            raise UsageError(f"the video cannot be copied: {camera.copy_fault}; write --keep-video h264")
        keep_modes.append(keep or ("copy" if camera.copy_fault is None else "h264"))
    observer = TagObserver(tags, hold_ns=hold_ns, cameras=names)
    frame_groups = simultaneous(cameras, offsets_ns)
    first_frames = next(frame_groups, None)
    if first_frames is None:
        opening_faults = [fault for camera in cameras for fault in camera.faults[:1]]
        camera_list = " and ".join(dict.fromkeys(camera.name for camera in cameras))
        raise LogError("; ".join([f"{camera_list}: no frame can be read", *opening_faults]))
    if keep == "h264" and any(frame is not None and frame.detections is not None for frame in first_frames):
        raise UsageError("detections have no images to encode; leave out --keep-video h264")
    # reference tags that do not fit raise an error before the output is created
    first_observation = observer.observe(*first_frames)
    monitors = [Monitor(file, units={"": tags.unit}) for file in files]
    changes = VerdictChanges(files)
    requirements = [requirements_of(spec.formula) for file in files for spec in file.results]
    options = {
        "tags": tags.name,
        "hold_ns": observer.hold_ns,
        "keep_video": keep_modes[0] if len(keep_modes) == 1 else keep_modes,
        **({"cameras": names, "offsets_ns": [*offsets_ns]} if len(cameras) > 1 else {}),
    }
    source_names = list(dict.fromkeys(camera.name for camera in cameras))
    metadata = {"source": ", ".join(source_names), "options": json.dumps(options)}
    metadata |= Axes(unit=tags.unit).metadata()
    tag_files = [tags.of_camera(name, number, count=len(names)) for number, name in enumerate(names, 1)]
    frame_counts = _FrameCounts(names)
    sample_count, first_ns = 0, first_observation.sample.time_ns
    last_ns = first_ns
    begin(first_ns)
    with run_log(output, files, metadata, inputs, durability=durability) as log:
        log.add_attachment(f"{CAMERA_PREFIX}{tags.name}", "application/yaml", tags.text.encode())
        pictures = [
            _Picture(number, camera, mode)
            for number, (camera, mode) in enumerate(zip(cameras, keep_modes, strict=True), 1)
        ]
        for observation in chain([first_observation], (observer.observe(*frames) for frames in frame_groups)):
            sample_count, last_ns = sample_count + 1, observation.sample.time_ns
            log.write(observation.sample)
            updates: list[Update] = [monitor.update(observation.sample) for monitor in monitors]
            object_colours = asked_colours(requirements, observation.sample, updates)
            for picture, view, camera_tags in zip(pictures, observation.views, tag_files, strict=True):
                if view is not None:
                    picture.write(log, view, observation.sample, object_colours, camera_tags.camera)
            frame_counts.count(observation)
            for change in changes.after(updates):
                show(change)
            advance(1)
    endings = tuple(ending for monitor in monitors for ending in monitor.endings())
    faults = tuple(dict.fromkeys(fault for camera in cameras for fault in camera.faults))
    source_remarks = [camera.remark for camera in cameras if camera.remark is not None]
    remarks = (*source_remarks, *observer.remarks(), *frame_counts.remarks(first_ns, last_ns))
    fits = tuple(zip(names, observer.fits, strict=True))
    return SeenRun(
        sample_count, (last_ns - first_ns) / 1e9, endings, fits, remarks, faults, tuple(keep_modes)
    )


class _FrameCounts:
    """Counts of simultaneous frames of the cameras, and the last frame of each camera."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._last_samples: list[int] = [0] * len(names)
        self._sample_count = self._shared_count = 0
        self._end_ns = [-1] * len(names)

    def count(self, observation: Observation) -> None:
        """Count the frames of a sample."""
        self._sample_count += 1
        camera_indices = [index for index, view in enumerate(observation.views) if view is not None]
        self._shared_count += len(camera_indices) > 1
        for index in camera_indices:
            self._last_samples[index], self._end_ns[index] = self._sample_count, observation.sample.time_ns

    def remarks(self, first_ns: int, last_ns: int) -> Iterator[str]:
        """Yield remarks on cameras that ended early, and on cameras without simultaneous frames."""
        if len(self._names) == 1:
            return
        if not self._shared_count:
            yield (
                f"no frames of {' and '.join(self._names)} are of the same time; are their clocks the same?"
                " --offset shifts one"
            )
        for name, last_sample, end_ns in zip(self._names, self._last_samples, self._end_ns, strict=True):
            if not last_sample:
                yield f"{name} has no frame"
            elif self._sample_count - last_sample > _NOT_YET_ALONE:
                yield (
                    f"{name} ends after {(end_ns - first_ns) / 1e9:.3f} s, and the run after"
                    f" {(last_ns - first_ns) / 1e9:.3f} s: what only it showed is hidden from there on"
                )


class _Picture:
    """Writer of one camera's messages, such as `/camera2/video`: picture, annotations, calibration, pose."""

    def __init__(self, number: int, camera: FrameSource, keep_mode: KeepVideo) -> None:
        self._frame_id = "camera" if number == 1 else f"camera{number}"
        self._video = protobuf_channel(topic_of_camera(CAMERA_VIDEO, number), CompressedVideo)
        self._annotations = protobuf_channel(topic_of_camera(CAMERA_ANNOTATIONS, number), ImageAnnotations)
        self._calibration = protobuf_channel(topic_of_camera(CAMERA_CALIBRATION, number), CameraCalibration)
        self._keep_mode, self._copy_channel = keep_mode, camera.channel
        # a topic under /spatial/ would clash with the log's own topics
        if self._copy_channel is not None and self._copy_channel.topic.startswith(OWN_PREFIX):
            self._keep_mode = "none"
        self._encoder: H264Encoder | None = None
        self._last_ns: dict[str, int] = {}

    def write(
        self,
        log: RunLog,
        view: View,
        sample: Sample,
        colours: Mapping[str, Colour],
        camera: Camera | None,
    ) -> None:
        """Write the messages of a frame."""
        time_ns = view.frame.time_ns
        self._write_frame(log, view.frame)
        log.write_payload(self._annotations, time_ns, encode_annotations(view, sample, colours))
        if camera is not None and self._is_due(CAMERA_CALIBRATION, time_ns):
            log.write_payload(self._calibration, time_ns, encode_calibration(time_ns, camera, self._frame_id))
        if isinstance(view.plane, CameraPlane) and self._is_due(CAMERA_FRAMES, time_ns):
            log.write_payload(TRANSFORMS, time_ns, encode_camera_pose(time_ns, view.plane, self._frame_id))

    def _write_frame(self, log: RunLog, frame: Frame) -> None:
        channel, data = self._copy_channel, frame.data
        if self._keep_mode == "none":
            return
        if self._keep_mode == "h264":
            if self._encoder is None:
                height, width = frame.image.shape[:2]
                self._encoder = H264Encoder(width, height)
            channel, data = None, self._encoder.encode(frame)
        if channel is not None:
            log.write_payload(channel, frame.time_ns, data)
        elif data:
            message = encode_video(frame.time_ns, data, self._frame_id)
            log.write_payload(self._video, frame.time_ns, message)

    def _is_due(self, topic: str, time_ns: int) -> bool:
        """Return whether the constant message of a topic is due; a due message counts as written."""
        last_ns = self._last_ns.get(topic)
        if last_ns is not None and time_ns - last_ns < _POSE_EVERY_NS:
            return False
        self._last_ns[topic] = time_ns
        return True
