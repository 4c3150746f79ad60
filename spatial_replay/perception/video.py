"""Video files and H.264 frames: what is read, encoded and written with PyAV.

What a log keeps of a video is H.264 in Annex B form, one frame a message, with parameter sets before each key
frame and without B frames: what `foxglove.CompressedVideo` demands.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from spatial_replay.errors import LogError, MissingFileError, OutputError, UsageError
from spatial_replay.perception.decoder import Decoded, Decoder, Untrue, has_key, load_av, picture, reason
from spatial_replay.perception.frame import LARGEST_PICTURE, Frame

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
        """That its own stamps are not taken, if it has any; None otherwise."""
        stream = self._stream
        if self._rate is None or stream.start_time is None:
            return None
        own = stream.average_rate
        rate = f" ({float(own):g} frames a second)" if own else ""
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
        kept: Frame | None = None
        try:
            length_ns = self._length_ns()
            for found in self._decoded():
                stamp = self._stamp_ns(found.frame, count)
                count += 1
                first = stamp if first is None and found.is_true else first
                time_ns = 0 if first is None else stamp - first
                untrue.add(time_ns, found.is_true)
                if kept is not None:
                    yield kept
                    kept = None
                if first is None:
                    continue
                if time_ns <= last_ns:
                    self._add_fault(f"{self.name}: frame {count} is not after the one before it; left out")
                    continue
                widest_ns = max(widest_ns, time_ns - last_ns) if last_ns >= 0 else 0
                before_ns, last_ns = last_ns, time_ns
                frame = Frame(time_ns, picture(found), found.of, has_key(found.of))
                if found.is_true:
                    yield frame
                else:
                    kept = frame
            # a file that ends within a frame has damaged that one
            if untrue.last == untrue.frames == 1:
                at = (
                    "in its first frame"
                    if first is None
                    else f"after {before_ns / 1e9:.3f} s, within a frame"
                )
                self._add_fault(f"{self.name} breaks off {at}")
                return
            if kept is not None:
                yield kept
            self.faults += untrue.faults(self.name)
            # the last frame is shown as long as any other, however uneven they are
            if widest_ns and last_ns + widest_ns * 3 // 2 < length_ns:
                ends = f"{last_ns / 1e9:.3f} s, though its header says {length_ns / 1e9:.3f} s"
                self._add_fault(f"{self.name} breaks off after {ends}")
        except (av.FFmpegError, EOFError) as error:
            at = "before its first frame" if last_ns < 0 else f"after {last_ns / 1e9:.3f} s"
            self._add_fault(f"{self.name} breaks off {at} ({reason(error)})")
        finally:
            self.close()

    def _decoded(self) -> Iterator[Decoded]:
        """Yield frames, each with its bytes if it can be copied."""
        av = load_av()
        convert = None
        if self.copy_fault is None:
            convert = av.bitstream.BitStreamFilterContext("h264_mp4toannexb", self._stream)
        for packet in self._container.demux(self._stream):
            # an .avi has no stamps but the order of decoding; without B frames it is that of showing, too,
            # and what FFmpeg guesses is one frame late
            if self._container.format.name == "avi" and not self._stream.codec_context.has_b_frames:
                packet.pts = packet.dts
            if packet.is_corrupt:
                self._add_fault(f"{self.name}: a packet is damaged")
            copies: list[bytes] = []
            found = []
            try:
                found = self._decoder.decode(packet, copies)
            except av.InvalidDataError as error:
                self._add_fault(f"{self.name}: a frame cannot be decoded ({reason(error)}); left out")
            # the filter takes the packet's content
            if convert is not None and packet.size:
                # one that is damaged has been reported above
                with suppress(av.InvalidDataError):
                    copies += [bytes(each) for each in convert.filter(packet)]
            for each in found:
                yield each._replace(of=b"".join(each.of))

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
            return round(count * 1e9 / self._rate)
        if frame.pts is None or frame.time_base is None:
            raise LogError(
                f"{self.name} has no time stamps; say how many frames a second it has, as in --rate 30"
            )
        stamp: Fraction = frame.pts * frame.time_base / _NS
        return round(stamp)

    def _add_fault(self, text: str) -> None:
        self.faults.append(text)

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
        av = load_av()
        width, height = self._size
        image = frame.image[:height, :width]
        form = "gray" if image.ndim == 2 else "bgr24"
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=form)
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
        av = load_av()
        height, width = (edge - edge % 2 for edge in frame.image.shape[:2])
        if self._stream is None:
            self._stream = self._opened(width, height)
        form = "gray" if frame.image.ndim == 2 else "bgr24"
        image = np.ascontiguousarray(frame.image[:height, :width])
        picture = av.VideoFrame.from_ndarray(image, format=form)
        picture.time_base = _TICK
        picture.pts = round(frame.time_ns * _NS / _TICK)
        self._container.mux(self._stream.encode(picture))

    def _opened(self, width: int, height: int) -> Any:
        stream = self._container.add_stream("libx264", rate=self._rate)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        context = stream.codec_context
        context.time_base, context.thread_count = _TICK, 1
        context.max_b_frames, context.gop_size = 0, _KEY_FRAMES
        stream.options = {"preset": "ultrafast", "tune": "zerolatency", "crf": "18"}
        return stream


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
