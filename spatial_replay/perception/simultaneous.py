"""Several cameras as one: frames of the same time together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from spatial_replay.errors import UsageError
from spatial_replay.perception.frame import Frame


def simultaneous(
    cameras: Sequence[Iterable[Frame]], offsets_ns: Sequence[int] = ()
) -> Iterator[tuple[Frame | None, ...]]:
    """Yield the frames of each time: of each camera one, or None where it has none then.

    Frames belong together if they are at most half a frame apart, half of the shortest time to the next frame
    of any camera. No more than two frames of a camera wait. When one camera ends, the others go on.

    Args:
        cameras: frames with increasing times.
        offsets_ns: what is added to the stamps of each camera; nothing unless given.
    """
    if len(cameras) == 1:
        # nothing to wait for
        for frame in cameras[0]:
            yield (frame if not any(offsets_ns) else replace(frame, time_ns=frame.time_ns + offsets_ns[0]),)
        return
    offsets = [*offsets_ns, *[0] * (len(cameras) - len(offsets_ns))]
    coming = [_Coming(iter(frames), offset) for frames, offset in zip(cameras, offsets, strict=True)]
    while present := [each for each in coming if each.now is not None]:
        gaps = [each.gap_ns for each in present if each.gap_ns]
        first_ns = min(each.time_ns for each in present)
        last_ns = first_ns + (min(gaps) // 2 if gaps else 0)
        yield tuple(
            each.take() if each.now is not None and each.time_ns <= last_ns else None for each in coming
        )


class _Coming:
    """The frames of one camera, of which the next two are known."""

    def __init__(self, frames: Iterator[Frame], offset_ns: int) -> None:
        self._frames, self._offset_ns = frames, offset_ns
        self.now, self._later = self._read(), self._read()

    def _read(self) -> Frame | None:
        frame = next(self._frames, None)
        if frame is None or not self._offset_ns:
            return frame
        return replace(frame, time_ns=frame.time_ns + self._offset_ns)

    @property
    def time_ns(self) -> int:
        """The time of the frame that comes next."""
        return 0 if self.now is None else self.now.time_ns

    @property
    def gap_ns(self) -> int:
        """The time from the frame that comes next to the one after it; 0 if there is none."""
        return 0 if self._later is None else self._later.time_ns - self.time_ns

    def take(self) -> Frame | None:
        """Return the frame that comes next, and go on."""
        taken, self.now = self.now, self._later
        self._later = None if self.now is None else self._read()
        return taken


def camera_names(cameras: Sequence[Any]) -> list[str]:
    """Return the names of cameras: of a topic, or else of a video; "" of frames that have none.

    Raises:
        UsageError: there is no camera.
    """
    if not cameras:
        raise UsageError("there is no camera; give the frames of one or more")
    return [str(getattr(each, "topic", "") or getattr(each, "name", "")) for each in cameras]
