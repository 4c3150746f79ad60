"""SHA-256 of much data beside other work."""

from __future__ import annotations

import hashlib
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import cast

import numpy as np
from numpy.typing import NDArray

_MOST_WAITING = 64
"""How many buffers may wait to be hashed, so that memory stays bounded."""


class Hashing:
    """Takes buffers into hashes in their order, on a thread of its own.

    Hashing a large buffer leaves the interpreter to others, so that on two cores it costs a replay next to
    nothing.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "hashing")
        self._waiting: deque[Future[None]] = deque()

    def update(self, hashed: hashlib._Hash, buffer: bytes | NDArray[np.generic]) -> None:
        """Take a buffer, which must not change afterwards, into a hash."""
        if len(self._waiting) >= _MOST_WAITING:
            self._waiting.popleft().result()
        # an array is a buffer, though its type does not say so
        self._waiting.append(self._thread.submit(hashed.update, cast(bytes, buffer)))

    def finish(self) -> None:
        """Wait until everything was taken in."""
        while self._waiting:
            self._waiting.popleft().result()
