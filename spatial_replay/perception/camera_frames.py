"""Frames of a camera of this machine, as they come."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from spatial_replay.errors import LogError
from spatial_replay.perception.frame import Frame
from spatial_replay.perception.opencv import open_camera


class CameraFrames:
    """Frames of a camera until it is unplugged; times count from the first one. A process for one run.

    Attributes:
        name: such as "camera 0".
        channel: None, since it is no topic.
        faults: what was lost so far.
    """

    channel = None
    copy_fault = "a camera's frames are not compressed"

    def __init__(
        self, number: int, *, length_ns: int | None = None, opened: Callable[[int], Any] = open_camera
    ) -> None:
        """Open the camera.

        Args:
            length_ns: end after so much time.
            opened: opens it; what it returns has `read` and `release`, as OpenCV's captures.

        Raises:
            UsageError: there is no such camera; OpenCV is not installed.
        """
        self.name = f"camera {number}"
        self.faults: list[str] = []
        self._capture, self._length_ns = opened(number), length_ns

    def __iter__(self) -> Iterator[Frame]:
        first, last_ns = None, -1
        try:
            while self._length_ns is None or last_ns < self._length_ns:
                is_there, image = self._capture.read()
                if not is_there:
                    if first is None:
                        raise LogError(f"{self.name} gives no picture; another program may be using it")
                    self.faults.append(
                        f"{self.name} gives no more pictures after {last_ns / 1e9:.3f} s; is it unplugged?"
                    )
                    return
                now = time.monotonic_ns()
                first = now if first is None else first
                last_ns = max(now - first, last_ns + 1)
                yield Frame(last_ns, image)
        finally:
            self._capture.release()
