"""Cache the measurements taken from one trace, so that an edited specification reuses them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from threading import Lock

from spatial_replay.geometry.arrays import Floats

_BYTES = 1 << 30


class MeasurementCache:
    """Arrays computed from one frozen trace; above 1 GiB the least recently used are dropped.

    Each trace owns one, so a result for one trace is never taken for another's. Keys are compared by
    equality, never by hash alone. Several threads may evaluate the same trace.
    """

    def __init__(self) -> None:
        self._arrays: OrderedDict[Hashable, Floats] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def get(self, key: Hashable) -> Floats | None:
        """Return the array stored under a key, or None."""
        with self._lock:
            array = self._arrays.get(key)
            if array is not None:
                self._arrays.move_to_end(key)
            return array

    def put(self, key: Hashable, array: Floats) -> None:
        """Store an array, which must not be written to afterwards."""
        with self._lock:
            replaced = self._arrays.pop(key, None)
            self._bytes += array.nbytes - (0 if replaced is None else replaced.nbytes)
            self._arrays[key] = array
            while self._bytes > _BYTES and len(self._arrays) > 1:
                _, dropped = self._arrays.popitem(last=False)
                self._bytes -= dropped.nbytes
