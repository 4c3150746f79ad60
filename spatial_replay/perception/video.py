"""Video files and H.264 frames: decoding, encoding and writing. Only this module imports PyAV.

A predicted frame depends on earlier frames. If an earlier frame is missing or damaged, a decoder invents the
missing parts: images are outdated or incomplete until the next key frame. A frame with such an image is
called not true.

A log stores video as H.264 in Annex B form. `foxglove.CompressedVideo` demands one frame per message,
parameter sets before each key frame, and no B frames.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple, Self, cast

import numpy as np

from spatial_replay.errors import LogError, MissingFileError, OutputError, UsageError, importing
from spatial_replay.perception.opencv import LARGEST_PICTURE, Frame, Image
from spatial_replay.text import plural

# --------------------------------------------------------------------------------------------------- decoding

_OPTIONS: Final = MappingProxyType({"max_pixels": str(LARGEST_PICTURE)})
_IDR, _SEQUENCE_PARAMETERS = 5, 7
"""Types of NAL units in H.264."""

_MISSING: Final = "Frame num gap"
"""Prefix of the debug messages of FFmpeg's H.264 decoder about missing frames."""
_HARMLESS: Final = "SEI"
"""Prefix of FFmpeg's messages about malformed SEI units, which are harmless."""

_MOST_WAITING: Final = 32
"""Maximum number of packets that wait for their frames; codecs delay a frame by at most 16 packets."""

_TURN = threading.Lock()
"""Lock for decoding, because FFmpeg has one log level for all threads."""


class Decoded(NamedTuple):
    """A decoded frame.

    Attributes:
        of: object that the caller passed with the frame's packet.
        frame: frame of PyAV.
        is_true: False if the frame depends on a missing or damaged frame.
    """

    of: Any
    frame: Any
    is_true: bool


class Shown(NamedTuple):
    """A decoded image.

    Attributes:
        of: object that the caller passed with the image's message.
        image: image of the frame; black if the frame is not true.
        is_true: False if the frame depends on a missing or damaged frame.
    """

    of: Any
    image: Image
    is_true: bool


@dataclass(slots=True, eq=False)
class _PendingPacket:
    """A pending packet.

    Attributes:
        of: object that was passed with the packet.
        losses_before, losses_after: numbers of losses before and after the packet's decoding.
    """

    of: Any
    losses_before: int
    losses_after: int
    pts: int | None
    time_base: Any


class Decoder:
    """Decodes the packets of one stream to frames in display order."""

    def __init__(self, context: Any) -> None:
        """Prepare an unopened codec context for one thread, because several threads delay frames."""
        av = load_av()
        context.thread_type, context.thread_count = "NONE", 1
        context.options = dict(_OPTIONS)
        # a frame gets the `opaque` of its packet
        context.flags |= av.codec.context.Flags.copy_opaque
        self._context = context
        self._losses = 0
        # losses before the last key frame no longer count
        self._mended_losses = 0
        # packets after a loss that wait for their frames
        self._pending: list[_PendingPacket] = []

    def decode(self, packet: Any, of: Any = None) -> list[Decoded]:
        """Decode a packet; return the finished frames, which may be frames of earlier packets.

        Args:
            packet: packet; None at the end of the stream, for the frames that the codec still holds.
            of: object that is returned with its frame.

        Raises:
            av.FFmpegError: the packet cannot be decoded; later frames are not true until the next key frame.
        """
        av = load_av()
        pending = _PendingPacket(of, self._losses, self._losses, None, None)
        is_end = packet is None or not packet.size
        if packet is not None:
            packet.opaque = pending
            pending.pts, pending.time_base = packet.pts, packet.time_base
        with _TURN, av.logging.Capture() as log_messages:
            # FFmpeg reports missing frames at this level only
            av.logging.set_level(av.logging.DEBUG)
            try:
                frames = self._context.decode(packet)
            except av.FFmpegError:
                self._losses += 1
                pending.losses_after = self._losses
                self._await(pending)
                raise
            finally:
                av.logging.set_level(None)
        self._losses += any(
            (level <= av.logging.ERROR and not text.startswith(_HARMLESS)) or text.startswith(_MISSING)
            for level, _, text in log_messages
        )
        pending.losses_after = self._losses
        if not is_end:
            self._await(pending)
        decoded_frames: list[Decoded] = []
        for frame in frames:
            packet_of_frame = frame.opaque or pending
            self._pending = [
                pending_packet for pending_packet in self._pending if pending_packet is not packet_of_frame
            ]
            decoded_frames += self._skipped_frames(frame.pts)
            decoded_frames.append(self._judge(frame, packet_of_frame))
        if is_end or len(self._pending) > _MOST_WAITING:
            decoded_frames += self._skipped_frames(None)
        return decoded_frames

    def _await(self, pending: _PendingPacket) -> None:
        if pending.losses_after and pending.pts is not None:
            self._pending.append(pending)

    def _skipped_frames(self, pts: int | None) -> Iterator[Decoded]:
        """Yield empty frames for the pending packets before `pts`; None is for all pending packets.

        Some decoders skip frames after a loss.
        """
        late_packets = [
            pending_packet
            for pending_packet in self._pending
            if pts is None or cast("int", pending_packet.pts) < pts
        ]
        self._pending = [
            pending_packet for pending_packet in self._pending if pending_packet not in late_packets
        ]
        width, height = self._context.width, self._context.height
        for late_packet in sorted(late_packets, key=lambda sent: cast("int", sent.pts)):
            if late_packet.losses_after > self._mended_losses and width and height:
                frame = load_av().VideoFrame(width, height, "gray")
                frame.pts, frame.time_base = late_packet.pts, late_packet.time_base
                yield Decoded(late_packet.of, frame, False)

    def _judge(self, frame: Any, pending: _PendingPacket) -> Decoded:
        if frame.is_corrupt:
            self._mended_losses = -1
        # with intra refresh (strip by strip), FFmpeg marks the first frame as key, although it is predicted
        elif (
            frame.key_frame
            and frame.pict_type not in _predicted_kinds()
            and pending.losses_before == pending.losses_after
        ):
            self._mended_losses = max(self._mended_losses, pending.losses_after)
        return Decoded(pending.of, frame, pending.losses_after <= self._mended_losses)


class H264Decoder:
    """Decodes the H.264 messages of one topic to images, in order."""

    def __init__(self) -> None:
        """Open the decoder; frames before the first key frame are not decoded."""
        self._decoder = Decoder(load_av().CodecContext.create("h264", "r"))
        self._is_ready = False
        self._message_count = 0

    def decode(self, data: bytes, of: Any = None) -> Iterator[Shown]:
        """Decode a message; yield the finished images, which may be of earlier messages.

        Messages before the first key frame are skipped.

        Raises:
            LogError: the message is damaged.
        """
        self._is_ready |= has_key(data)
        if self._is_ready:
            av = load_av()
            # stamps count the messages, so that skipped frames are noticed
            packet = av.Packet(data)
            packet.pts, packet.time_base = self._message_count, Fraction(1)
            self._message_count += 1
            try:
                decoded_frames = self._decoder.decode(packet, of)
            except av.FFmpegError as error:
                raise LogError(f"a frame cannot be decoded ({reason(error)})") from None
            for frame in decoded_frames:
                yield Shown(frame.of, picture(frame), frame.is_true)

    def rest(self) -> Iterator[Shown]:
        """Yield the images that the decoder still holds at the end of the stream."""
        if self._is_ready:
            with suppress(load_av().FFmpegError):
                for frame in self._decoder.decode(None):
                    yield Shown(frame.of, picture(frame), frame.is_true)


class Untrue:
    """Counts frames that are not true in one run.

    Attributes:
        frames: number of frames that are not true.
        last: number of frames after the last true frame.
    """

    def __init__(self) -> None:
        self.frames = self.last = self._places = 0
        self._first_ns = 0

    def add(self, time_ns: int, is_true: bool) -> None:
        """Count a frame; `time_ns` is its time after the first frame."""
        if is_true:
            self.last = 0
            return
        if not self.frames:
            self._first_ns = time_ns
        self._places += self.last == 0
        self.frames += 1
        self.last += 1

    def faults(self, name: str) -> list[str]:
        """Return one sentence on the frames that are not true; [] if all frames are true."""
        if not self.frames:
            return []
        where = f"after {self._first_ns / 1e9:.3f} s"
        if self._places > 1:
            where = f"in {self._places} places, the first {where}"
        return [
            f"{name}: frames are missing or damaged {where}; {plural(self.frames, 'frame')}, up to the next"
            " key frame, left out"
        ]


def has_key(data: bytes) -> bool:
    """Return whether a decoder can start at a message of H.264 in Annex B form."""
    offset = data.find(b"\x00\x00\x01")
    while 0 <= offset < len(data) - 3:
        if data[offset + 3] & 31 in (_IDR, _SEQUENCE_PARAMETERS):
            return True
        offset = data.find(b"\x00\x00\x01", offset + 3)
    return False


def picture(decoded: Decoded) -> Image:
    """Return the image of a frame. A frame that is not true is black, as it may show tags at wrong places.

    Raises:
        LogError: the frame is too large.
    """
    width, height = decoded.frame.width, decoded.frame.height
    if width * height > LARGEST_PICTURE:
        raise LogError(f"a frame of {width} x {height} is too large")
    if not decoded.is_true:
        return np.zeros((height, width, 3), np.uint8)
    return np.asarray(decoded.frame.to_ndarray(format="bgr24"), np.uint8)


def reason(error: BaseException) -> str:
    """Return FFmpeg's text of an error, shortened."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return f"{text!s:.200}".lower()


@cache
def _predicted_kinds() -> frozenset[Any]:
    kinds = load_av().video.frame.PictureType
    return frozenset({kinds.P, kinds.B})


@cache
def load_av() -> Any:
    """Import PyAV.

    Raises:
        UsageError: PyAV is not installed.
    """
    with importing("videos need PyAV", extra="vision"):
        import av
        import av.bitstream
    # FFmpeg prints no messages: errors are raised, and `Decoder` reads the messages of codecs
    with suppress(AttributeError):
        av.logging.set_level(None)
        av.logging.set_skip_repeated(False)
    return av


# ----------------------------------------------------------------------------------------- files and encoding

_KEY_FRAMES: Final = 30
"""Number of frames from one key frame to the next in our videos. A viewer seeks to a key frame first."""

_NS: Final = Fraction(1, 10**9)
_TICK: Final = Fraction(1, 90_000)
_MOST_BOXES: Final = 1000
"""Maximum number of boxes of an .mp4 that are searched for its index."""


class VideoFile:
    """Frames of a video file, for one iteration. The first true frame has the stamp 0.

    Attributes:
        name: name of the file.
        channel: None, because a file has no topic.
        faults: losses so far, each with its place.
    """

    channel = None

    def __init__(self, path: Path, *, rate: float | None = None) -> None:
        """Open the file.

        Args:
            rate: frames per second, which replace the file's own stamps.

        Raises:
            MissingFileError: there is no such file.
            LogError: the file is no video, or its codec is missing.
            UsageError: PyAV is not installed, or the rate is not above 0.
        """
        if rate is not None and not (math.isfinite(rate) and rate > 0):
            raise UsageError(f"the rate is {rate!r}; give frames a second, above 0")
        self.name, self._path, self._rate = path.name, path, rate
        self.faults: list[str] = []
        self._last_pts: int | None = None
        self._goes_back = False
        av = load_av()
        try:
            # the file is opened first, so that a missing file raises the usual error
            with path.open("rb"):
                pass
        except OSError as error:
            raise MissingFileError.of(path, error) from None
        try:
            self._container = av.open(str(path))
        except (av.FFmpegError, ValueError) as error:
            if _lacks_index(path):
                raise LogError(
                    f"{self.name} has no index, which is written when a recording ends: the file was not"
                    " closed, or is cut off; give the whole file, or record as .mkv or .ts, without an index"
                ) from None
            raise LogError(
                f"{self.name} is no video that can be read ({reason(error)}); give a file of a camera, such"
                " as .mp4, .mkv or .avi, or a log with --topic"
            ) from None
        streams = self._container.streams.video
        if not streams:
            self.close()
            raise LogError(f"{self.name} has no video stream; give a file with pictures")
        self._stream = streams[0]
        context = self._stream.codec_context
        if context is None:
            self.close()
            raise LogError(
                f"{self.name} has a video that no codec here decodes; convert it, as with"
                f" ffmpeg -i {self.name} -c:v libx264 table.mp4"
            )
        if context.width * context.height > LARGEST_PICTURE:
            self.close()
            raise LogError(f"{self.name}: its frames of {context.width} x {context.height} are too large")
        self._decoder = Decoder(context)
        self._has_stamps = self._stream.start_time is not None
        self._own_rate = float(self._stream.average_rate or 0)

    @property
    def copy_fault(self) -> str | None:
        """Reason why a log cannot store the frames unchanged, or None."""
        context = self._stream.codec_context
        if context.name != "h264":
            return f"{self.name} holds {context.name}, not H.264"
        if context.has_b_frames:
            return f"{self.name} has B frames, which a log cannot hold"
        return None

    @property
    def remark(self) -> str | None:
        """Remark that the given rate replaces the file's stamps, or None.

        The remark is None if no rate is given, if the file has no stamps, or if its stamps go back.

        The remark is final after all frames are read.
        """
        if self._rate is None or not self._has_stamps or self._goes_back:
            return None
        rate = f" ({self._own_rate:g} frames a second)" if self._own_rate else ""
        return (
            f"{self.name} has time stamps{rate}; {self._rate:g} frames a second are taken instead of them:"
            " leave out --rate unless they are wrong"
        )

    def __iter__(self) -> Iterator[Frame]:
        av = load_av()
        last_ns = previous_ns = -1
        first_stamp_ns, frame_count, longest_gap_ns = None, 0, 0
        untrue = Untrue()
        # a frame that depends on a missing or damaged frame waits for the next frame, because the last frame
        # of a cut file is dropped
        waiting_frame: Frame | None = None
        try:
            length_ns = self._length_ns()
            for decoded in self._decode():
                stamp_ns = self._stamp_ns(decoded.frame, frame_count)
                frame_count += 1
                first_stamp_ns = stamp_ns if first_stamp_ns is None and decoded.is_true else first_stamp_ns
                time_ns = 0 if first_stamp_ns is None else stamp_ns - first_stamp_ns
                untrue.add(time_ns, decoded.is_true)
                if waiting_frame is not None:
                    yield waiting_frame
                    waiting_frame = None
                if first_stamp_ns is None:
                    continue
                if time_ns < last_ns and decoded.is_true:
                    raise LogError(self._order_fault(frame_count, stamp_ns, last_ns - time_ns))
                if time_ns <= last_ns:
                    self.faults.append(
                        f"{self.name}: frame {frame_count} is not after the one before it; left out"
                    )
                    continue
                longest_gap_ns = max(longest_gap_ns, time_ns - last_ns) if last_ns >= 0 else 0
                previous_ns, last_ns = last_ns, time_ns
                frame = Frame(time_ns, picture(decoded), decoded.of)
                if decoded.is_true:
                    yield frame
                else:
                    waiting_frame = frame
            # only the last frame is not true, so the file ends within that frame
            if untrue.last == untrue.frames == 1:
                where = (
                    "in its first frame"
                    if first_stamp_ns is None
                    else f"after {previous_ns / 1e9:.3f} s, within a frame"
                )
                self.faults.append(f"{self.name} breaks off {where}")
                return
            if waiting_frame is not None:
                yield waiting_frame
            self.faults += untrue.faults(self.name)
            # a last frame of more than 1.5 times the longest interval means that frames are missing
            if longest_gap_ns and last_ns + longest_gap_ns * 3 // 2 < length_ns:
                end_text = f"{last_ns / 1e9:.3f} s, though its header says {length_ns / 1e9:.3f} s"
                self.faults.append(f"{self.name} breaks off after {end_text}")
        except (av.FFmpegError, EOFError) as error:
            where = "before its first frame" if last_ns < 0 else f"after {last_ns / 1e9:.3f} s"
            self.faults.append(f"{self.name} breaks off {where} ({reason(error)})")
        finally:
            self.close()

    def _order_fault(self, frame_number: int, stamp_ns: int, back_ns: int) -> str:
        return (
            f"{self.name} has time stamps that go back: frame {frame_number} has {stamp_ns / 1e9:.3f} s,"
            f" {back_ns / 1e9:.3f} s less than the frame before it; give its frame rate, as in"
            f" --rate {self._own_rate or 30:g}"
        )

    def _decode(self) -> Iterator[Decoded]:
        """Yield frames in display order, with their bytes if the frames can be copied."""
        av = load_av()
        # an .avi has no display times: its frames in display order get the sorted decoding times (`slots`)
        is_avi = self._container.format.name == "avi"
        is_reordered = is_avi and self._stream.codec_context.has_b_frames
        slots: deque[int] = deque()
        annex_b_filter = None
        if self.copy_fault is None:
            annex_b_filter = av.bitstream.BitStreamFilterContext("h264_mp4toannexb", self._stream)
        for packet in self._container.demux(self._stream):
            # FFmpeg guesses the pts of an .avi: with B frames, its guesses are out of order and up to 0.2 s
            # late
            if is_avi:
                packet.pts = None if is_reordered else packet.dts
            slot = packet.dts if is_reordered and packet.size else None
            if slot is not None:
                slots.append(slot)
            if packet.is_corrupt:
                self.faults.append(f"{self.name}: a packet is damaged")
            copies: list[bytes] = []
            decoded_frames: list[Decoded] = []
            try:
                decoded_frames = self._decoder.decode(packet, (copies, slot))
            except av.InvalidDataError as error:
                self.faults.append(f"{self.name}: a frame cannot be decoded ({reason(error)}); left out")
            # copies follow the decoding, because the filter consumes the packet's content
            if annex_b_filter is not None and packet.size:
                # a damaged packet was reported above
                with suppress(av.InvalidDataError):
                    copies += [bytes(converted_packet) for converted_packet in annex_b_filter.filter(packet)]
            for decoded in decoded_frames:
                copies, slot = decoded.of
                # a key frame is not displayed before it is decoded: earlier slots belong to lost frames
                while decoded.frame.key_frame and slot is not None and slots and slots[0] < slot:
                    slots.popleft()
                if slots:
                    decoded.frame.pts, decoded.frame.time_base = slots.popleft(), self._stream.time_base
                yield decoded._replace(of=b"".join(copies))

    def _length_ns(self) -> int:
        """Return the length of the video from the file's header; 0 without one."""
        if self._rate is not None:
            return 0
        stream, container = self._stream, self._container
        if stream.duration is not None:
            return int(stream.duration * stream.time_base / _NS)
        # the length of the container may be that of another, longer stream
        return 1000 * (container.duration or 0) if len(container.streams) == 1 else 0

    def _stamp_ns(self, frame: Any, frame_count: int) -> int:
        if self._rate is not None:
            if frame.pts is not None:
                self._goes_back |= self._last_pts is not None and frame.pts < self._last_pts
                self._last_pts = frame.pts
            return round(frame_count * 1e9 / self._rate)
        if frame.pts is None or frame.time_base is None:
            raise LogError(
                f"{self.name} has no time stamps; say how many frames a second it has, as in --rate 30"
            )
        stamp_ns: Fraction = frame.pts * frame.time_base / _NS
        return round(stamp_ns)

    def close(self) -> None:
        """Close the file."""
        self._container.close()


class H264Encoder:
    """Encodes the frames of one video to H.264, one message per frame."""

    def __init__(self, width: int, height: int, rate: int = 30) -> None:
        """Open the encoder; an odd height or width loses a row or column of pixels.

        Raises:
            UsageError: PyAV is not installed.
        """
        av = load_av()
        self._size = width - width % 2, height - height % 2
        context = av.CodecContext.create("libx264", "w")
        context.width, context.height = self._size
        context.pix_fmt = "yuv420p"
        context.time_base = Fraction(1, 1_000_000)
        context.framerate = Fraction(rate)
        context.gop_size = _KEY_FRAMES
        context.max_b_frames = 0
        context.thread_count = 1
        context.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "crf": "23",
            # parameter sets before each key frame, as `foxglove.CompressedVideo` demands
            "x264-params": "repeat-headers=1",
        }
        self._context = context

    def encode(self, frame: Frame) -> bytes:
        """Encode the next frame; times must increase."""
        picture = _to_encode(frame, self._size)
        picture.pts = frame.time_ns // 1000
        picture.time_base = Fraction(1, 1_000_000)
        return b"".join(bytes(packet) for packet in self._context.encode(picture))


class VideoWriter:
    """Writes frames to a video file (H.264, no B frames), as a context manager."""

    def __init__(self, path: Path, rate: int = 30) -> None:
        """Open the file.

        Raises:
            OutputError: the file cannot be written.
            UsageError: PyAV is not installed, or the name does not end like a video.
        """
        av = load_av()
        self._rate = rate
        self._stream: Any = None
        try:
            self._container = av.open(str(path), "w")
        except ValueError:
            raise UsageError(f"{path}: give the name of a video, such as {path.stem}.mp4") from None
        except OSError as error:
            raise OutputError(f"{path}: {reason(error)}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()

    def write(self, frame: Frame) -> None:
        """Add a frame; an odd height or width loses a row or column of pixels."""
        height, width = (edge - edge % 2 for edge in frame.image.shape[:2])
        if self._stream is None:
            self._stream = self._open(width, height)
        picture = _to_encode(frame, (width, height))
        picture.time_base = _TICK
        picture.pts = round(frame.time_ns * _NS / _TICK)
        self._container.mux(self._stream.encode(picture))

    def _open(self, width: int, height: int) -> Any:
        stream = self._container.add_stream("libx264", rate=self._rate)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.time_base, context.thread_count = _TICK, 1
        context.max_b_frames, context.gop_size = 0, _KEY_FRAMES
        stream.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": "18"}
        return stream


def _to_encode(frame: Frame, size: tuple[int, int]) -> Any:
    """Return the image of a frame for the encoders of PyAV, cut to a size (width, height)."""
    width, height = size
    image = np.ascontiguousarray(frame.image[:height, :width])
    return load_av().VideoFrame.from_ndarray(image, format="gray" if image.ndim == 2 else "bgr24")


def _lacks_index(path: Path) -> bool:
    """Return whether a file is an .mp4 or .mov without `moov`, the index of its frames."""
    with path.open("rb") as file:
        box_types: list[bytes] = []
        file_size, offset = path.stat().st_size, 0
        while offset + 8 <= file_size and len(box_types) < _MOST_BOXES:
            file.seek(offset)
            box_header = file.read(16)
            box_length, box_type = int.from_bytes(box_header[:4]), box_header[4:8]
            # length 1: eight bytes of length follow; length 0: the box ends with the file (ISO/IEC 14496-12)
            box_length = {0: file_size - offset, 1: int.from_bytes(box_header[8:])}.get(
                box_length, box_length
            )
            box_types.append(box_type)
            offset += max(box_length, 8)
    return box_types[:1] == [b"ftyp"] and b"moov" not in box_types
