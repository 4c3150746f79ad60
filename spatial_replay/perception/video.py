"""Video files and H.264 frames: decoding, encoding and writing; the only module that imports PyAV.

A predicted frame is drawn onto the frames before it. If one of those is missing or damaged, a decoder makes
up the difference: its pictures are old, or in parts, until the next key frame.

A log stores video as H.264 in Annex B form, one frame a message, with parameter sets before each key frame
and without B frames, as `foxglove.CompressedVideo` demands.
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
"""Kinds of units in H.264."""

_MISSING: Final = "Frame num gap"
"""How the decoder of H.264 begins to say that frames are missing, at the level of its debugging."""
_HARMLESS: Final = "SEI"
"""Prefix of FFmpeg's messages about malformed SEI units, which are harmless."""

_MOST_WAITING: Final = 32
"""Packets; codecs show a frame at most 16 later."""

_TURN = threading.Lock()
"""Held while one thread decodes: how much FFmpeg says is set for all of them."""


class Decoded(NamedTuple):
    """A frame as it comes out of the decoder.

    Attributes:
        of: what was given with its packet.
        frame: of PyAV.
        is_true: whether nothing it was drawn onto is missing or damaged.
    """

    of: Any
    frame: Any
    is_true: bool


class Shown(NamedTuple):
    """An image as it comes out of the decoder.

    Attributes:
        of: what was given with its message.
        image: black if it is not true.
        is_true: whether nothing it was drawn onto is missing or damaged.
    """

    of: Any
    image: Image
    is_true: bool


@dataclass(slots=True, eq=False)
class _Sent:
    """A packet under way: what was given with it, and the losses noticed before it and with it."""

    of: Any
    before: int
    after: int
    pts: int | None
    time_base: Any


class Decoder:
    """Packets to frames, in their order of showing; a process for one stream."""

    def __init__(self, context: Any) -> None:
        """Prepare a codec context that is not open yet: one thread, one frame out for one in."""
        av = load_av()
        context.thread_type, context.thread_count = "NONE", 1
        context.options = dict(_OPTIONS)
        context.flags |= av.codec.context.Flags.copy_opaque
        self._context = context
        self._losses = 0
        # the losses that no longer count, since a key frame was shown after them
        self._mended = 0
        # sent after a loss, and not shown yet
        self._waiting: list[_Sent] = []

    def decode(self, packet: Any, of: Any = None) -> list[Decoded]:
        """Return the frames that come out with a packet, which may be those of earlier ones.

        Args:
            packet: None for what is held back; the decoder is then at its end.
            of: what to give back with its frame.

        Raises:
            av.FFmpegError: it cannot be decoded; what follows is not true until the next key frame.
        """
        av = load_av()
        sent = _Sent(of, self._losses, self._losses, None, None)
        is_end = packet is None or not packet.size
        if packet is not None:
            packet.opaque = sent
            sent.pts, sent.time_base = packet.pts, packet.time_base
        with _TURN, av.logging.Capture() as said:
            av.logging.set_level(av.logging.DEBUG)
            try:
                frames = self._context.decode(packet)
            except av.FFmpegError:
                self._losses += 1
                sent.after = self._losses
                self._await(sent)
                raise
            finally:
                av.logging.set_level(None)
        self._losses += any(
            (level <= av.logging.ERROR and not text.startswith(_HARMLESS)) or text.startswith(_MISSING)
            for level, _, text in said
        )
        sent.after = self._losses
        if not is_end:
            self._await(sent)
        decoded: list[Decoded] = []
        for frame in frames:
            packet_of_frame = frame.opaque or sent
            self._waiting = [waiting for waiting in self._waiting if waiting is not packet_of_frame]
            decoded += self._skipped_frames(frame.pts)
            decoded.append(self._judge(frame, packet_of_frame))
        if is_end or len(self._waiting) > _MOST_WAITING:
            decoded += self._skipped_frames(None)
        return decoded

    def _await(self, sent: _Sent) -> None:
        if sent.after and sent.pts is not None:
            self._waiting.append(sent)

    def _skipped_frames(self, pts: int | None) -> Iterator[Decoded]:
        """Yield empty frames for those due before a stamp: some decoders skip what they cannot draw."""
        late = [waiting for waiting in self._waiting if pts is None or cast("int", waiting.pts) < pts]
        self._waiting = [waiting for waiting in self._waiting if waiting not in late]
        width, height = self._context.width, self._context.height
        for late_packet in sorted(late, key=lambda sent: cast("int", sent.pts)):
            if late_packet.after > self._mended and width and height:
                frame = load_av().VideoFrame(width, height, "gray")
                frame.pts, frame.time_base = late_packet.pts, late_packet.time_base
                yield Decoded(late_packet.of, frame, False)

    def _judge(self, frame: Any, sent: _Sent) -> Decoded:
        if frame.is_corrupt:
            self._mended = -1
        # a picture that is renewed strip by strip is called a key frame where that begins, but is predicted
        elif frame.key_frame and frame.pict_type not in _predicted_kinds() and sent.before == sent.after:
            self._mended = max(self._mended, sent.after)
        return Decoded(sent.of, frame, sent.after <= self._mended)


class H264Decoder:
    """H.264 messages to images, in their order; a process for one topic."""

    def __init__(self) -> None:
        """Open the decoder; frames before the first key frame are not decoded."""
        self._decoder = Decoder(load_av().CodecContext.create("h264", "r"))
        self._is_ready = False
        self._count = 0

    def decode(self, data: bytes, of: Any = None) -> Iterator[Shown]:
        """Yield what comes out with a message: nothing before the first key frame, perhaps earlier messages.

        Raises:
            LogError: it is damaged.
        """
        self._is_ready |= has_key(data)
        if self._is_ready:
            av = load_av()
            # in their order, so that those which are skipped are known
            packet = av.Packet(data)
            packet.pts, packet.time_base = self._count, Fraction(1)
            self._count += 1
            try:
                decoded = self._decoder.decode(packet, of)
            except av.FFmpegError as error:
                raise LogError(f"a frame cannot be decoded ({reason(error)})") from None
            for frame in decoded:
                yield Shown(frame.of, picture(frame), frame.is_true)

    def rest(self) -> Iterator[Shown]:
        """Yield what is held back; the decoder is then at its end."""
        if self._is_ready:
            with suppress(load_av().FFmpegError):
                for frame in self._decoder.decode(None):
                    yield Shown(frame.of, picture(frame), frame.is_true)


class Untrue:
    """Counts frames that are not true; a process for one run.

    Attributes:
        frames: how many.
        last: how many of them at the end.
    """

    def __init__(self) -> None:
        """Begin with none."""
        self.frames = self.last = self._places = 0
        self._first_ns = 0

    def add(self, time_ns: int, is_true: bool) -> None:
        """Take note of a frame, shown so long after the first."""
        if is_true:
            self.last = 0
            return
        if not self.frames:
            self._first_ns = time_ns
        self._places += self.last == 0
        self.frames += 1
        self.last += 1

    def faults(self, name: str) -> list[str]:
        """Return what to say of them, if there are any."""
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
    """Return whether H.264 in Annex B form can be decoded from here on."""
    at = data.find(b"\x00\x00\x01")
    while 0 <= at < len(data) - 3:
        if data[at + 3] & 31 in (_IDR, _SEQUENCE_PARAMETERS):
            return True
        at = data.find(b"\x00\x00\x01", at + 3)
    return False


def picture(decoded: Decoded) -> Image:
    """Return the image of a frame; black where it is not true, since tags may seem to be where they are not.

    Raises:
        LogError: it is too large.
    """
    width, height = decoded.frame.width, decoded.frame.height
    if width * height > LARGEST_PICTURE:
        raise LogError(f"a frame of {width} x {height} is too large")
    if not decoded.is_true:
        return np.zeros((height, width, 3), np.uint8)
    return np.asarray(decoded.frame.to_ndarray(format="bgr24"), np.uint8)


def reason(error: BaseException) -> str:
    """Return what FFmpeg says, short."""
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
        UsageError: it is not installed.
    """
    with importing("videos need PyAV", extra="vision"):
        import av
        import av.bitstream
    # its messages would go to the terminal; errors are raised, and those of decoders are listened to
    with suppress(AttributeError):
        av.logging.set_level(None)
        av.logging.set_skip_repeated(False)
    return av


# ----------------------------------------------------------------------------------------- files and encoding

_KEY_FRAMES: Final = 30
"""Frames from one key frame to the next in what we encode: a viewer seeks to the one before the cursor."""

_NS: Final = Fraction(1, 10**9)
_TICK: Final = Fraction(1, 90_000)
_MOST_BOXES: Final = 1000
"""Boxes of an .mp4 that are looked at for its index."""


class VideoFile:
    """Frames of a video file, with their own stamps from the first frame on; a process for one run.

    Attributes:
        name: of the file.
        channel: None, since it is no topic.
        faults: what was lost so far, each with its place.
    """

    channel = None

    def __init__(self, path: Path, *, rate: float | None = None) -> None:
        """Open the file.

        Args:
            rate: frames a second, instead of the file's own stamps.

        Raises:
            MissingFileError: there is no such file.
            LogError: it is no video, or its codec is not there.
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
            with path.open("rb"):
                pass
        except OSError as error:
            raise MissingFileError.of(path, error) from None
        try:
            self._container = av.open(str(path))
        except (av.FFmpegError, ValueError) as error:
            if _lacks_index(path):
                raise LogError(
                    f"{self.name} has no index, which is written when a recording ends: it was not closed, or"
                    " it breaks off; give the whole file, or record as .mkv or .ts, which need none"
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
        """Why its frames cannot be copied into a log as they are; None if they can."""
        context = self._stream.codec_context
        if context.name != "h264":
            return f"{self.name} holds {context.name}, not H.264"
        if context.has_b_frames:
            return f"{self.name} has B frames, which a log cannot hold"
        return None

    @property
    def remark(self) -> str | None:
        """That its own stamps are ignored; None without a rate, or if it has no stamps or they go back.

        It is complete once all frames are read.
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
        last_ns = before_ns = -1
        first, count, widest_ns = None, 0, 0
        untrue = Untrue()
        # a frame that is not true, until there is another one
        waiting: Frame | None = None
        try:
            length_ns = self._length_ns()
            for decoded in self._decode():
                stamp = self._stamp_ns(decoded.frame, count)
                count += 1
                first = stamp if first is None and decoded.is_true else first
                time_ns = 0 if first is None else stamp - first
                untrue.add(time_ns, decoded.is_true)
                if waiting is not None:
                    yield waiting
                    waiting = None
                if first is None:
                    continue
                if time_ns < last_ns and decoded.is_true:
                    raise LogError(self._order_fault(count, stamp, last_ns - time_ns))
                if time_ns <= last_ns:
                    self.faults.append(f"{self.name}: frame {count} is not after the one before it; left out")
                    continue
                widest_ns = max(widest_ns, time_ns - last_ns) if last_ns >= 0 else 0
                before_ns, last_ns = last_ns, time_ns
                frame = Frame(time_ns, picture(decoded), decoded.of)
                if decoded.is_true:
                    yield frame
                else:
                    waiting = frame
            # a file that ends within a frame has damaged that one
            if untrue.last == untrue.frames == 1:
                at = (
                    "in its first frame"
                    if first is None
                    else f"after {before_ns / 1e9:.3f} s, within a frame"
                )
                self.faults.append(f"{self.name} breaks off {at}")
                return
            if waiting is not None:
                yield waiting
            self.faults += untrue.faults(self.name)
            # the last frame is shown as long as any other, however uneven they are
            if widest_ns and last_ns + widest_ns * 3 // 2 < length_ns:
                ends = f"{last_ns / 1e9:.3f} s, though its header says {length_ns / 1e9:.3f} s"
                self.faults.append(f"{self.name} breaks off after {ends}")
        except (av.FFmpegError, EOFError) as error:
            at = "before its first frame" if last_ns < 0 else f"after {last_ns / 1e9:.3f} s"
            self.faults.append(f"{self.name} breaks off {at} ({reason(error)})")
        finally:
            self.close()

    def _order_fault(self, number: int, stamp_ns: int, back_ns: int) -> str:
        return (
            f"{self.name} has time stamps that go back: frame {number} has {stamp_ns / 1e9:.3f} s,"
            f" {back_ns / 1e9:.3f} s less than the frame before it; give its frame rate, as in"
            f" --rate {self._own_rate or 30:g}"
        )

    def _decode(self) -> Iterator[Decoded]:
        """Yield frames in the order of showing, each with its bytes if it can be copied."""
        av = load_av()
        # an .avi has no times of showing: the frames shown take the times of decoding, in their order
        is_avi = self._container.format.name == "avi"
        is_reordered = is_avi and self._stream.codec_context.has_b_frames
        slots: deque[int] = deque()
        convert = None
        if self.copy_fault is None:
            convert = av.bitstream.BitStreamFilterContext("h264_mp4toannexb", self._stream)
        for packet in self._container.demux(self._stream):
            # the pts that FFmpeg guesses for an .avi are late, and out of order with B frames
            if is_avi:
                packet.pts = None if is_reordered else packet.dts
            slot = packet.dts if is_reordered and packet.size else None
            if slot is not None:
                slots.append(slot)
            if packet.is_corrupt:
                self.faults.append(f"{self.name}: a packet is damaged")
            copies: list[bytes] = []
            frames: list[Decoded] = []
            try:
                frames = self._decoder.decode(packet, (copies, slot))
            except av.InvalidDataError as error:
                self.faults.append(f"{self.name}: a frame cannot be decoded ({reason(error)}); left out")
            # the filter takes the packet's content
            if convert is not None and packet.size:
                # one that is damaged has been reported above
                with suppress(av.InvalidDataError):
                    copies += [bytes(converted) for converted in convert.filter(packet)]
            for decoded in frames:
                copies, slot = decoded.of
                # a key frame is not shown before it is decoded: frames lost ahead of it leave their slots
                while decoded.frame.key_frame and slot is not None and slots and slots[0] < slot:
                    slots.popleft()
                if slots:
                    decoded.frame.pts, decoded.frame.time_base = slots.popleft(), self._stream.time_base
                yield decoded._replace(of=b"".join(copies))

    def _length_ns(self) -> int:
        """Return how long the file says that the video is; 0 if it does not."""
        if self._rate is not None:
            return 0
        stream, container = self._stream, self._container
        if stream.duration is not None:
            return int(stream.duration * stream.time_base / _NS)
        # of several streams another one may be longer
        return 1000 * (container.duration or 0) if len(container.streams) == 1 else 0

    def _stamp_ns(self, frame: Any, count: int) -> int:
        if self._rate is not None:
            if frame.pts is not None:
                self._goes_back |= self._last_pts is not None and frame.pts < self._last_pts
                self._last_pts = frame.pts
            return round(count * 1e9 / self._rate)
        if frame.pts is None or frame.time_base is None:
            raise LogError(
                f"{self.name} has no time stamps; say how many frames a second it has, as in --rate 30"
            )
        stamp: Fraction = frame.pts * frame.time_base / _NS
        return round(stamp)

    def close(self) -> None:
        """Close the file."""
        self._container.close()


class H264Encoder:
    """Frames to H.264, one message each; a process for one video."""

    def __init__(self, width: int, height: int, rate: int = 30) -> None:
        """Open the encoder; a picture with an odd edge loses a row or column of pixels.

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
            "x264-params": "repeat-headers=1",
        }
        self._context = context

    def encode(self, frame: Frame) -> bytes:
        """Return the next frame, times increasing."""
        picture = _to_encode(frame, self._size)
        picture.pts = frame.time_ns // 1000
        picture.time_base = Fraction(1, 1_000_000)
        return b"".join(bytes(packet) for packet in self._context.encode(picture))


class VideoWriter:
    """Writes frames as a video (H.264, no B frames), as a context manager; a process for one file."""

    def __init__(self, path: Path, rate: int = 30) -> None:
        """Open the file.

        Raises:
            OutputError: the file cannot be written.
            UsageError: PyAV is not installed, or the name's ending is not that of a video.
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
        """Add a frame; an odd edge of the picture loses a row or column of pixels."""
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
    """Return the image of a frame as PyAV encodes it, cut to a size (width, height)."""
    width, height = size
    image = np.ascontiguousarray(frame.image[:height, :width])
    return load_av().VideoFrame.from_ndarray(image, format="gray" if image.ndim == 2 else "bgr24")


def _lacks_index(path: Path) -> bool:
    """Return whether a file is an .mp4 or .mov without the box that says where its frames are."""
    with path.open("rb") as file:
        kinds: list[bytes] = []
        size, at = path.stat().st_size, 0
        while at + 8 <= size and len(kinds) < _MOST_BOXES:
            file.seek(at)
            head = file.read(16)
            length, kind = int.from_bytes(head[:4]), head[4:8]
            # 1: the length follows, as eight bytes; 0: up to the end
            length = {0: size - at, 1: int.from_bytes(head[8:])}.get(length, length)
            kinds.append(kind)
            at += max(length, 8)
    return kinds[:1] == [b"ftyp"] and b"moov" not in kinds
