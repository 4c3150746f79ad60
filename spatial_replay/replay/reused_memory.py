"""Memory that is used again: large arrays of one evaluation after those of another.

An operating system clears memory before it gives it, and takes it back when it is freed. Where the same log
is evaluated again and again, that costs a fifth of an evaluation of many nodes.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Floats

_LEAST: Final = 1 << 20
"""Numbers of the smallest array that is worth it: what is smaller, an allocator uses again by itself."""


class ReusedMemory:
    """Gives arrays memory that former ones had, once nothing refers to these or to parts of them any more."""

    def __init__(self, most: int) -> None:
        """Hold no memory yet.

        Args:
            most: so many numbers at most are held for arrays to come; what was free for longest goes first.
        """
        self._most = most
        self._free: dict[int, Floats] = {}

    def empty(self, shape: Sequence[int]) -> Floats:
        """Return an array whose numbers are whatever was there before, as `numpy.empty` does."""
        count = math.prod(shape)
        if count < _LEAST:
            return np.empty(shape)
        memory = self._taken(count)
        # what is cut from an array refers to it alone as long as its own memory is no array
        array = np.frombuffer(memory.data, np.float64, count)
        weakref.finalize(array, self._give_back, memory).atexit = False
        return array.reshape(shape)

    def _taken(self, count: int) -> Floats:
        """Return memory for so many numbers, and not for many more: the smallest that is free, or new one."""
        sizes = {key: len(each) for key, each in self._free.copy().items()}
        fitting = [key for key, size in sizes.items() if count <= size <= 2 * count]
        for key in sorted(fitting, key=sizes.__getitem__):
            # another thread may have taken it
            if (memory := self._free.pop(key, None)) is not None:
                return memory
        return np.empty(count)

    def _give_back(self, memory: Floats) -> None:
        """Hold memory for arrays to come; called by any thread, between any two steps of another one."""
        self._free[id(memory)] = memory
        held = self._free.copy()
        excess = sum(map(len, held.values())) - self._most
        for key, each in held.items():
            if excess > 0 and self._free.pop(key, None) is not None:
                excess -= len(each)
