"""Frames of cameras, and of topics with images or tags in MCAP files and ROS bags."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from os import PathLike
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.bags.decoders import Topic
from spatial_replay.bags.open import is_log, open_messages
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.remote import LogFile, local_copy, log_file
from spatial_replay.logs.topics import is_image_type
from spatial_replay.mapping.message_types import short_type
from spatial_replay.perception.opencv import (
    FAMILIES,
    LARGEST_PICTURE,
    NO_IMAGE,
    Detection,
    Frame,
    Image,
    convert,
    corners_from_apriltag,
    decode_image,
    open_camera,
)
from spatial_replay.perception.video import H264Decoder, Shown, Untrue, VideoFile, has_key
from spatial_replay.text import nearest_hint, time_text

_CHANNELS: Final[Mapping[str, tuple[int, tuple[int, ...]]]] = MappingProxyType(
    {
        "mono8": (1, (0,)),
        "8uc1": (1, (0,)),
        "rgb8": (3, (2, 1, 0)),
        "8uc3": (3, (0, 1, 2)),
        "bgr8": (3, (0, 1, 2)),
        "rgba8": (4, (2, 1, 0)),
        "bgra8": (4, (0, 1, 2)),
    }
)
"""Encodings of raw images: bytes per pixel, and the byte indices of blue, green and red, or of grey."""

_CONVERTED: Final[Mapping[str, tuple[int, str]]] = MappingProxyType(
    {
        **{f"bayer_{order}8": (1, f"Bayer{order.upper()}2BGR") for order in ("rggb", "bggr", "gbrg", "grbg")},
        "yuv422": (2, "YUV2BGR_UYVY"),
        "uyvy": (2, "YUV2BGR_UYVY"),
        "yuv422_yuy2": (2, "YUV2BGR_YUYV"),
        "yuyv": (2, "YUV2BGR_YUYV"),
    }
)
"""Encodings that OpenCV converts: bytes per pixel, and the name of OpenCV's conversion."""

_ENCODINGS: Final = (*_CHANNELS, "mono16", *_CONVERTED)

_DETECTIONS: Final[Mapping[str, str]] = MappingProxyType(
    {"apriltag_msgs/AprilTagDetectionArray": "detections", "apriltag_msgs/ApriltagArrayStamped": "apriltags"}
)
"""Types of messages with detected tags, and the field that has the tags."""


class ImageTopic:
    """Frames of one log topic with images or AprilTag detections, for one iteration.

    Attributes:
        name: name of the log.
        topic: name of the topic.
        channel: channel of the topic in the log.
        faults: losses so far, each with its place.
    """

    copy_fault = remark = None

    def __init__(self, path: LogFile, topic: str | None = None) -> None:
        """Open the log, and choose the topic.

        Args:
            topic: name of the topic. None chooses the only image topic or, without image topics, the only
                topic with detections.

        Raises:
            MissingFileError: there is no such file.
            LogError: the file is not a log of messages.
            UsageError: no such topic, a topic of JSON messages, or a choice that is not unique.
        """
        self._reader = open_messages(path)
        self.name = self._reader.name
        image_topic = _choose_topic(self.name, self._reader.topics(), topic)
        self.topic, self._type = image_topic.name, short_type(image_topic.type)
        self.channel = next(iter(self._reader.channels({self.topic}).values()), None)
        if self.channel is not None and self.channel.encoding == "json":
            raise UsageError(f"{self.topic} has JSON messages; record it as protobuf or as ROS messages")
        self._decode = self._reader.decoder(self.topic)
        self._is_video = "CompressedVideo" in self._type
        self.faults: list[str] = []

    def __iter__(self) -> Iterator[Frame]:
        last_stamp_ns = first_log_ns = -1
        untrue = Untrue()
        for log_ns, frame, is_true in self._frames():
            first_log_ns = log_ns if first_log_ns < 0 else first_log_ns
            fault = f"{frame}; left out" if isinstance(frame, LogError) else None
            if not isinstance(frame, LogError):
                untrue.add(log_ns - first_log_ns, is_true)
                if frame.time_ns > last_stamp_ns:
                    last_stamp_ns = frame.time_ns
                    yield frame
                else:
                    fault = "its stamp is not after that of the frame before; left out"
            if fault is not None:
                time_in_log = time_text(log_ns, first_log_ns)
                self.faults.append(f"{self.name}: {self.topic} after {time_in_log}: {fault}")
        self.faults += untrue.faults(f"{self.name}: {self.topic}")
        self.faults += self._reader.take_faults()

    def _frames(self) -> Iterator[tuple[int, Frame | LogError, bool]]:
        """Yield each message's log time, its frame or fault, and whether the frame is true (see `video`)."""
        decoder = H264Decoder() if self._is_video else None
        detections_field = _DETECTIONS.get(self._type)
        for message in self._reader.iter_messages({self.topic}):
            log_ns, payload = message.log_time_ns, message.payload
            try:
                content: Any = self._decode(payload)
                stamp_ns = _stamp_ns(content) or log_ns
                if decoder is not None:
                    yield from map(_frame, decoder.decode(_h264(content), (log_ns, stamp_ns, payload)))
                elif detections_field is not None:
                    detections = _detections(getattr(content, detections_field))
                    yield log_ns, Frame(stamp_ns, NO_IMAGE, payload, detections=detections), True
                else:
                    yield log_ns, Frame(stamp_ns, _image(content, self._type), payload), True
            except LogError as error:
                yield log_ns, error, False
        if decoder is not None:
            yield from map(_frame, decoder.rest())

    def frames_at(self, times_ns: Sequence[int]) -> Iterator[Frame]:
        """Yield the latest frame at or before each of some increasing times.

        A frame for several times is yielded once. Only the necessary frames are decoded. Damaged frames
        are left out.

        Raises:
            UsageError: PyAV is not installed.
        """
        frame_times = self._times_of_frames()
        frame_indices = (
            np.searchsorted(frame_times.stamps_ns, np.asarray(times_ns, np.int64), side="right") - 1
        )
        decoder, read_until_ns = H264Decoder() if self._is_video else None, 0
        for frame_index in np.unique(frame_indices[frame_indices >= 0]).tolist():
            stamp_ns = int(frame_times.stamps_ns[frame_index])
            frame_log_ns = int(frame_times.log_times_ns[frame_index])
            # a video is read from the key frame, or from the decoder's position if that is later
            key_log_ns = int(frame_times.key_times_ns[frame_index])
            first_log_ns = frame_log_ns if decoder is None else max(key_log_ns, read_until_ns)
            read_until_ns = frame_log_ns + 1
            shown_images: list[Shown] = []
            for message in self._reader.iter_messages({self.topic}, first_log_ns, read_until_ns):
                with suppress(LogError):
                    content: Any = self._decode(message.payload)
                    message_stamp_ns = _stamp_ns(content) or message.log_time_ns
                    if decoder is not None:
                        shown_images += _of_stamp(stamp_ns, decoder.decode(_h264(content), message_stamp_ns))
                    elif message_stamp_ns == stamp_ns:
                        shown_images.append(Shown(message_stamp_ns, _image(content, self._type), True))
            if decoder is not None and not shown_images:
                # the decoder withholds the frame, because data are missing; the next frame begins at its key
                # frame
                shown_images += _of_stamp(stamp_ns, decoder.rest())
                decoder, read_until_ns = H264Decoder(), 0
            image = next((image.image for image in reversed(shown_images) if image.is_true), None)
            if image is not None:
                yield Frame(stamp_ns, image)

    def _times_of_frames(self) -> _FrameTimes:
        """Return the times of all frames without decoding images."""
        frame_times: list[tuple[int, int, int]] = []
        key_log_ns = last_stamp_ns = -1
        for message in self._reader.iter_messages({self.topic}):
            try:
                content: Any = self._decode(message.payload)
            except LogError:
                continue
            if not self._is_video or has_key(bytes(content.data)):
                key_log_ns = message.log_time_ns
            stamp_ns = _stamp_ns(content) or message.log_time_ns
            if stamp_ns > last_stamp_ns and key_log_ns >= 0:
                last_stamp_ns = stamp_ns
                frame_times.append((stamp_ns, message.log_time_ns, key_log_ns))
        return _FrameTimes(*np.array(frame_times, np.int64).reshape(-1, 3).T)


class _FrameTimes(NamedTuple):
    """The increasing stamps of frames, their log times, and the log times of their key frames."""

    stamps_ns: Integers
    log_times_ns: Integers
    key_times_ns: Integers


def _choose_topic(name: str, topics: tuple[Topic, ...], topic_name: str | None) -> Topic:
    image_topics = {candidate.name: candidate for candidate in topics if is_image_type(candidate.type)}
    detection_topics = {
        candidate.name: candidate for candidate in topics if short_type(candidate.type) in _DETECTIONS
    }
    if topic_name is None and not image_topics and len(detection_topics) == 1:
        return next(iter(detection_topics.values()))
    if topic_name is None:
        if len(image_topics) == 1:
            return next(iter(image_topics.values()))
        if not image_topics:
            raise UsageError(f"{name} has no topic with images")
        raise UsageError(
            f"{name} has several image topics: {', '.join(image_topics)}; choose one with --topic"
        )
    if topic_name in image_topics or topic_name in detection_topics:
        return {**image_topics, **detection_topics}[topic_name]
    topic_names = [candidate.name for candidate in topics]
    if topic_name in topic_names:
        candidate = next(candidate for candidate in topics if candidate.name == topic_name)
        raise UsageError(
            f"{name}: {topic_name} has messages of {candidate.type}, neither images nor AprilTag detections"
        )
    hint = nearest_hint(topic_name, topic_names) or f"image topics are {', '.join(image_topics) or 'none'}"
    raise UsageError(f"{name} has no topic {topic_name!r}; {hint}")


def _h264(message: Any) -> bytes:
    """Return the data of a video message.

    Raises:
        LogError: the video is not H.264.
    """
    if str(message.format).lower() not in ("h264", ""):
        raise LogError(f"the video is {message.format!r:.40}; H.264 is read")
    return bytes(message.data)


def _frame(shown: Shown) -> tuple[int, Frame, bool]:
    """Return a video message's log time, its frame, and whether the frame is true (see `video`)."""
    log_ns, time_ns, payload = shown.of
    return log_ns, Frame(time_ns, shown.image, payload), shown.is_true


def _of_stamp(stamp_ns: int, images: Iterable[Shown]) -> list[Shown]:
    return [image for image in images if image.of == stamp_ns]


def _image(message: Any, type_name: str) -> Image:
    """Return the image in a message.

    Raises:
        LogError: the image is damaged, or its encoding is unknown.
    """
    data = bytes(message.data)
    if "Compressed" in type_name:
        return decode_image(data)
    encoding, width, height = str(message.encoding).lower(), int(message.width), int(message.height)
    if encoding not in _ENCODINGS:
        raise LogError(f"the encoding {encoding!r:.40} is not known; known are {', '.join(_ENCODINGS)}")
    pixel_bytes = _CHANNELS[encoding][0] if encoding in _CHANNELS else _CONVERTED.get(encoding, (2, ""))[0]
    row_bytes = int(message.step) or width * pixel_bytes
    if not (
        0 < width * height <= LARGEST_PICTURE
        and width * pixel_bytes <= row_bytes
        and row_bytes * height <= len(data)
    ):
        raise LogError(f"an image of {width} x {height} ({encoding}) does not fit its {len(data)} bytes")
    row_values = np.frombuffer(data, np.uint8, row_bytes * height).reshape(height, row_bytes)[
        :, : width * pixel_bytes
    ]
    pixels = row_values.reshape(height, width, pixel_bytes)
    if encoding in _CONVERTED:
        return convert(pixels, _CONVERTED[encoding][1])
    if encoding == "mono16":
        wide_pixels = pixels.view(">u2" if getattr(message, "is_bigendian", False) else "<u2")[..., 0]
        # cameras of 10 or 12 bits leave the upper bits empty, so the greatest value decides the shift
        return np.asarray(wide_pixels >> max(0, int(wide_pixels.max()).bit_length() - 8), np.uint8)
    channel_indices = _CHANNELS[encoding][1]
    return np.ascontiguousarray(pixels[..., 0] if pixel_bytes == 1 else pixels[..., channel_indices])


def _detections(message_tags: Any) -> tuple[Detection, ...]:
    """Return the tags in a message.

    Raises:
        LogError: a tag does not have four finite corners.
    """
    detections = []
    for tag in message_tags:
        corners = np.array([(corner.x, corner.y) for corner in tag.corners], np.float64)
        if corners.shape != (4, 2) or not np.isfinite(corners).all():
            raise LogError(f"tag {tag.id} does not have four corners that are finite")
        family = str(tag.family).removeprefix("tag")
        known_family = family if family in FAMILIES else ""
        detections.append(Detection(int(tag.id), corners_from_apriltag(corners), known_family))
    return tuple(sorted(detections, key=lambda tag: (tag.id, *tag.corners[0].tolist())))


def _stamp_ns(message: Any) -> int:
    """Return the stamp inside a message; 0 without one."""
    stamp = getattr(message, "timestamp", None) or getattr(getattr(message, "header", None), "stamp", None)
    for seconds_field, nanoseconds_field in (("seconds", "nanos"), ("sec", "nanosec"), ("secs", "nsecs")):
        if hasattr(stamp, seconds_field):
            return int(getattr(stamp, seconds_field)) * 10**9 + int(getattr(stamp, nanoseconds_field))
    return 0


def open_frames(
    path: str | PathLike[str] | LogFile, *, topic: str | None = None, rate: float | None = None
) -> VideoFile | ImageTopic:
    """Open a video, or a log topic with images or AprilTag detections. The file's content decides the type.

    Args:
        topic: topic of a log. None chooses the only image topic or, without image topics, the only topic with
            detections.
        rate: frames per second of a video, which replace the video's own stamps.

    Raises:
        MissingFileError: there is no such file.
        LogError: the file is neither a video nor a log.
        UsageError: an option that does not apply to the file, or an unknown topic.
    """
    path = log_file(path)
    if is_log(path):
        if rate is not None:
            raise UsageError(f"{path.name} is a log, whose messages have stamps; leave out --rate")
        return ImageTopic(path, topic)
    if topic is not None:
        raise UsageError(f"{path.name} is not a log of messages; leave out --topic")
    return VideoFile(local_copy(path), rate=rate)


# ---------------------------------------------------------------------------------------------------- cameras


class CameraFrames:
    """Frames of a camera until it is unplugged, for one iteration. The first frame has the time 0.

    Attributes:
        name: name, such as "camera 0".
        channel: None, because a camera has no topic.
        faults: losses so far.
    """

    channel = remark = None
    copy_fault = "a camera's frames are not compressed"

    def __init__(
        self, number: int, *, length_ns: int | None = None, opened: Callable[[int], Any] = open_camera
    ) -> None:
        """Open the camera.

        Args:
            length_ns: time after which the frames end; None for no limit.
            opened: function that opens the camera; its result has `read` and `release`, like OpenCV's
                captures.

        Raises:
            UsageError: there is no such camera, or OpenCV is not installed.
        """
        self.name = f"camera {number}"
        self.faults: list[str] = []
        self._capture, self._length_ns = opened(number), length_ns

    def __iter__(self) -> Iterator[Frame]:
        first_ns, last_ns = None, -1
        try:
            while self._length_ns is None or last_ns < self._length_ns:
                has_image, image = self._capture.read()
                if not has_image:
                    if first_ns is None:
                        raise LogError(f"{self.name} gives no picture; another program may be using it")
                    self.faults.append(
                        f"{self.name} gives no more pictures after {last_ns / 1e9:.3f} s; is it unplugged?"
                    )
                    return
                # monotonic, because the wall clock may be adjusted while the camera runs
                now_ns = time.monotonic_ns()
                first_ns = now_ns if first_ns is None else first_ns
                last_ns = max(now_ns - first_ns, last_ns + 1)
                yield Frame(last_ns, image)
        finally:
            self._capture.release()
