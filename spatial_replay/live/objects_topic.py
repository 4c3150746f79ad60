"""The samples of a server of ours, which has them on /spatial/objects: they need no mapping."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from spatial_replay.bags.columns import DISORDER_NS, Message
from spatial_replay.logs.objects.decode import decode_objects
from spatial_replay.logs.read_options import FaultKinds
from spatial_replay.logs.topics import OBJECTS
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import ABSENT, Trace


class ObjectsAssembler:
    """Decodes samples as they come; what it offers is that of `LiveAssembler`."""

    overdue = 0
    jump = None
    topics = (OBJECTS,)

    def __init__(self, name: str) -> None:
        self._name = name
        self._faults = FaultKinds()
        self._newest_ns = -1
        self._classes: dict[str, str | None] = {}
        self.is_finished = False

    def add(self, messages: Sequence[Message], now_s: float) -> Trace:
        """Add messages as they came; return their samples. Those that come late or twice are left out."""
        kept: list[Message] = []
        for message in messages:
            if message.log_time_ns < self._newest_ns - DISORDER_NS:
                self.is_finished = True
            if self.is_finished:
                break
            if message.log_time_ns > self._newest_ns:
                kept.append(message)
                self._newest_ns = message.log_time_ns
        times_ns = np.array([message.log_time_ns for message in kept], np.int64)
        trace, faults = decode_objects([message.payload for message in kept], times_ns)
        for fault in faults:
            self._faults.add(f"{self._name}: {fault}")
        if len(trace):
            rows = zip(trace.names, trace.rows[-1].tolist(), strict=True)
            present = {name: row if row >= 0 else -2 - row for name, row in rows if row != ABSENT}
            self._classes = {name: trace.classes[int(trace.class_code[row])] for name, row in present.items()}
        return trace

    def due_s(self) -> None:
        """Nothing waits."""

    def lose(self, topics: Collection[str], now_s: float) -> Trace:
        """Return a sample right after the newest, in which every object is unknown."""
        if self._newest_ns < 0 or not self._classes:
            return Trace.empty()
        self._newest_ns += 1
        unknown, self._classes = self._classes, {}
        return Trace.from_samples([Sample(self._newest_ns, unknown=unknown)])

    def finish(self) -> Trace:
        """Return the remaining samples: none."""
        return Trace.empty()

    def take_faults(self, *, last: bool = False) -> tuple[str, ...]:
        """Return what was lost since the last call, the first of each kind; at last, how many more."""
        return self._faults.take(last=last)

    def take_remarks(self) -> tuple[str, ...]:
        """Return what is remarkable where nothing was lost: nothing."""
        return ()
