"""Decode video, and find out which of its frames are true; the only module that imports PyAV.

A predicted frame is drawn onto the frames before it. Where one of those is missing or damaged, a decoder
makes up what it lacks, and goes on: what it shows is old, or in parts, until the next key frame.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from types import MappingProxyType
from typing import Any, Final, NamedTuple, cast

import numpy as np

from spatial_replay.errors import LogError, importing
from spatial_replay.perception.frame import LARGEST_PICTURE, Image
from spatial_replay.text import counted

_OPTIONS: Final = MappingProxyType({"max_pixels": str(LARGEST_PICTURE)})
_IDR, _SEQUENCE_PARAMETERS = 5, 7
"""Kinds of units in H.264."""

_MISSING: Final = "Frame num gap"
"""How the decoder of H.264 begins to say that frames are missing, at the level of its debugging."""
_HARMLESS: Final = "SEI"
"""What it says of notes beside the pictures, which many a camera writes wrongly, begins so."""

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
            own = frame.opaque or sent
            self._waiting = [each for each in self._waiting if each is not own]
            decoded += self._never_shown(frame.pts)
            decoded.append(self._judged(frame, own))
        if is_end or len(self._waiting) > _MOST_WAITING:
            decoded += self._never_shown(None)
        return decoded

    def _await(self, sent: _Sent) -> None:
        if sent.after and sent.pts is not None:
            self._waiting.append(sent)

    def _never_shown(self, pts: int | None) -> Iterator[Decoded]:
        """Yield empty frames for those due before a stamp: some decoders skip what they cannot draw."""
        late = [each for each in self._waiting if pts is None or cast("int", each.pts) < pts]
        self._waiting = [each for each in self._waiting if each not in late]
        width, height = self._context.width, self._context.height
        for each in sorted(late, key=lambda sent: cast("int", sent.pts)):
            if each.after > self._mended and width and height:
                frame = load_av().VideoFrame(width, height, "gray")
                frame.pts, frame.time_base = each.pts, each.time_base
                yield Decoded(each.of, frame, False)

    def _judged(self, frame: Any, sent: _Sent) -> Decoded:
        if frame.is_corrupt:
            self._mended = -1
        # a picture that is renewed strip by strip is called a key frame where that begins, but is predicted
        elif frame.key_frame and frame.pict_type not in _predicted() and sent.before == sent.after:
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
                found = self._decoder.decode(packet, of)
            except av.FFmpegError as error:
                raise LogError(f"a frame cannot be decoded ({reason(error)})") from None
            for each in found:
                yield Shown(each.of, picture(each), each.is_true)

    def rest(self) -> Iterator[Shown]:
        """Yield what is held back; the decoder is then at its end."""
        if self._is_ready:
            with suppress(load_av().FFmpegError):
                for each in self._decoder.decode(None):
                    yield Shown(each.of, picture(each), each.is_true)


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
            f"{name}: frames are missing or damaged {where}; {counted(self.frames, 'frame')}, up to the next"
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
def _predicted() -> frozenset[Any]:
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
