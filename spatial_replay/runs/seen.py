"""A video or a camera, recorded: frames to samples, verdicts as they change, and a log with the picture."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final, Literal, Protocol, TypeAlias

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.messages import Channel, Messages, messages_of
from spatial_replay.logs.output_file import Durability
from spatial_replay.logs.topics import CAMERA_PREFIX, OWN_PREFIX
from spatial_replay.monitor.monitor import Ending, Monitor, Update
from spatial_replay.perception.camera_messages import (
    ANNOTATIONS,
    CALIBRATION,
    TRANSFORMS,
    VIDEO,
    AskedColours,
    encode_annotations,
    encode_calibration,
    encode_camera_pose,
    encode_video,
)
from spatial_replay.perception.frame import Frame
from spatial_replay.perception.observer import Observation, TagObserver
from spatial_replay.perception.plane import CameraPlane, Fit
from spatial_replay.perception.tags_file import TagsFile
from spatial_replay.perception.video import H264Encoder
from spatial_replay.recording.changes import VerdictChange, VerdictChanges
from spatial_replay.recording.recording import refuse_templates
from spatial_replay.runs.run_log import RunLog, run_log
from spatial_replay.spec.formula import Specification
from spatial_replay.trace.axes import Axes

KeepVideo: TypeAlias = Literal["copy", "h264", "none"]
"""How a log keeps a video: as it came, encoded again, or not at all."""

_POSE_EVERY_NS: Final = 10**9
"""How often a log repeats the camera's calibration and pose, which do not change."""


class FrameSource(Protocol):
    """Frames with increasing times, read once: a video file, an image topic, a camera.

    Attributes:
        name: for messages.
        channel: the topic that the frames' `data` are messages of; None where they are H.264.
        faults: what was lost so far.
        copy_fault: why `data` cannot be copied into a log; None if it can.
    """

    name: str
    faults: list[str]

    @property
    def channel(self) -> Channel | None: ...

    @property
    def copy_fault(self) -> str | None: ...

    def __iter__(self) -> Iterator[Frame]: ...


@dataclass(frozen=True, slots=True)
class SeenRun:
    """The result of recording what a camera saw.

    Attributes:
        samples: number of frames, each of which is a sample.
        seconds: from the first to the last.
        endings: the result of each spec at the end.
        fit: how the reference tags fit; None without any.
        remarks: tags and objects that were missing, doubtful or not mapped.
        faults: what was lost of the video.
        kept: how the video is in the log.
    """

    samples: int
    seconds: float
    endings: tuple[Ending, ...]
    fit: Fit | None
    remarks: tuple[str, ...]
    faults: tuple[str, ...]
    kept: KeepVideo


def record_seen(
    frames: FrameSource,
    tags: TagsFile,
    output: Path,
    files: Sequence[Specification] = (),
    *,
    hold_ns: int | None = None,
    keep: KeepVideo | None = None,
    inputs: Sequence[Path] = (),
    begin: Callable[[int], None] = lambda first_ns: None,
    show: Callable[[VerdictChange], None] = lambda change: None,
    advance: Callable[[int], None] = lambda samples: None,
    durability: Durability = "process",
) -> SeenRun:
    """Record the objects that frames show, with verdicts; equal frames give equal bytes.

    Args:
        hold_ns: how long a hidden object stays where it was, with growing uncertainty; None for what the
            tags file says.
        keep: how the log keeps the video; None copies it where that is possible, and encodes it otherwise.
        inputs: files that the output must not be.
        begin: takes the time of the first frame.
        show: takes each change of a verdict.
        advance: called with 1 for each frame.

    Raises:
        UsageError: a specification that cannot be recorded, reference tags that do not fit, a camera that was
            calibrated for another size, a video that cannot be copied.
        LogError: there is no frame.
        OutputError: the output cannot be written.
    """
    refuse_templates(files)
    if keep == "copy" and frames.copy_fault is not None:
        raise UsageError(f"the video cannot be copied: {frames.copy_fault}; write --keep-video h264")
    kept: KeepVideo = keep or ("copy" if frames.copy_fault is None else "h264")
    observer = TagObserver(tags, hold_ns=hold_ns)
    coming = iter(frames)
    first = next(coming, None)
    if first is None:
        raise LogError("; ".join([f"{frames.name} has no frame that can be read", *frames.faults[:1]]))
    # reference tags that do not fit raise here, before the output is touched
    begun = observer.observe(first)
    monitors = [Monitor(file, units={"": tags.unit}) for file in files]
    changes, colours = VerdictChanges(files), AskedColours(files)
    options = {"tags": tags.name, "hold_ns": observer.hold_ns, "keep_video": kept}
    about = {"source": frames.name, "options": json.dumps(options)}
    about |= Axes(unit=tags.unit).metadata()
    samples, last_ns = 0, first.time_ns
    begin(first.time_ns)
    with run_log(output, files, about, inputs, durability=durability) as log:
        log.add_attachment(f"{CAMERA_PREFIX}{tags.name}", "application/yaml", tags.text.encode())
        video = _Video(frames, kept, first)
        beside = _Beside(log)
        for seen in chain([begun], map(observer.observe, coming)):
            samples, last_ns = samples + 1, seen.sample.time_ns
            log.write(seen.sample)
            updates: list[Update] = [monitor.update(seen.sample) for monitor in monitors]
            video.write(beside, seen.frame)
            beside.write(ANNOTATIONS, last_ns, encode_annotations(seen, colours.of(seen.sample, updates)))
            _write_camera(beside, tags, seen)
            for change in changes.after(updates):
                show(change)
            advance(1)
    endings = tuple(each for monitor in monitors for each in monitor.endings())
    seconds = (last_ns - first.time_ns) / 1e9
    return SeenRun(samples, seconds, endings, observer.fit, observer.remarks(), tuple(frames.faults), kept)


class _Beside:
    """Messages of several topics into the log of a run, numbered."""

    def __init__(self, log: RunLog) -> None:
        self._log = log
        self._written: dict[str, int] = {}
        self.last_ns: dict[str, int] = {}

    def write(self, channel: Channel, time_ns: int, payload: bytes) -> None:
        number = self._written.get(channel.topic, 0)
        self._written[channel.topic] = number + 1
        self.last_ns[channel.topic] = time_ns
        times = np.array([time_ns], np.int64)
        messages: Messages = messages_of(channel, times, [payload], number)
        self._log.write_messages(messages)


class _Video:
    """The picture, on its way into the log."""

    def __init__(self, frames: FrameSource, kept: KeepVideo, first: Frame) -> None:
        self._kept, self._channel = kept, frames.channel
        if self._channel is not None and self._channel.topic.startswith(OWN_PREFIX):
            self._kept = "none"
        height, width = first.image.shape[:2]
        self._encoder = H264Encoder(width, height) if kept == "h264" else None

    def write(self, beside: _Beside, frame: Frame) -> None:
        channel, data = self._channel, frame.data
        if self._encoder is not None:
            channel, data = None, self._encoder.encode(frame)
        elif self._kept == "none":
            return
        if channel is not None:
            beside.write(channel, frame.time_ns, data)
        elif data:
            beside.write(VIDEO, frame.time_ns, encode_video(frame.time_ns, data))


def _write_camera(beside: _Beside, tags: TagsFile, seen: Observation) -> None:
    """Write the calibration and the pose of the camera, from time to time."""
    time_ns = seen.sample.time_ns
    for channel in (CALIBRATION, TRANSFORMS):
        last_ns = beside.last_ns.get(channel.topic)
        if last_ns is not None and time_ns - last_ns < _POSE_EVERY_NS:
            continue
        if channel is CALIBRATION and tags.camera is not None:
            beside.write(channel, time_ns, encode_calibration(time_ns, tags.camera))
        elif channel is TRANSFORMS and isinstance(seen.plane, CameraPlane):
            beside.write(channel, time_ns, encode_camera_pose(time_ns, seen.plane))
