"""What has been computed from a trace, kept for the next edit of a specification."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock

from spatial_replay.geometry.arrays import Floats

_BYTES = 1 << 30


class Memo:
    """Arrays computed from one frozen trace, by what they are; the least recently used go beyond 1 GiB.

    It belongs to one trace and lives as long as that, so nothing computed from one trace can be taken for
    another's. Its keys are compared whole, never by their hash alone. Several threads may evaluate one trace.
    """

    def __init__(self) -> None:
        self._arrays: OrderedDict[Hashable, Floats] = OrderedDict()
        self._bytes = 0
        self._changing = Lock()

    def get(self, key: Hashable) -> Floats | None:
        """The array kept under a key, or None."""
        with self._changing:
            found = self._arrays.get(key)
            if found is not None:
                self._arrays.move_to_end(key)
            return found

    def keep(self, key: Hashable, array: Floats) -> None:
        """Keep an array, which must not be written to afterwards."""
        with self._changing:
            replaced = self._arrays.pop(key, None)
            self._bytes += array.nbytes - (0 if replaced is None else replaced.nbytes)
            self._arrays[key] = array
            while self._bytes > _BYTES and len(self._arrays) > 1:
                _, dropped = self._arrays.popitem(last=False)
                self._bytes -= dropped.nbytes

    def or_compute(self, key: Hashable, compute: Callable[[], Floats]) -> Floats:
        """The array kept under a key, computed now if there is none."""
        found = self.get(key)
        if found is None:
            found = compute()
            self.keep(key, found)
        return found
