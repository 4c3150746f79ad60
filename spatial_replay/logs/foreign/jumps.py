"""Logs whose clock was set back while they were recorded, as when a simulation starts again.

Read in the order of time, the two passes over the same time would look like one.
"""

from __future__ import annotations

import numpy as np

from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.foreign.columns import Columns

DISORDER_NS = 10**9
"""How far messages may be out of order."""


def without_jumps(columns: Columns, name: str) -> Columns:
    """The messages as they are, in the order of time.

    Raises:
        LogError: those of a topic were not recorded in that order: some of them come more than a second
            before others that were recorded earlier.
    """
    # logs put together topic by topic are in order all the same, so each topic counts by itself
    whole, topics = _Recorded(), dict[str, _Recorded]()
    by_topic = False
    for each in columns:
        by_topic = by_topic or whole.first_jump(each.log_time_ns, each.place) is not None
        if by_topic:
            names = np.array(each.topics)
            for topic in sorted(set(each.topics)):
                rows = np.flatnonzero(names == topic)
                recorded = topics.setdefault(topic, _Recorded())
                jump = recorded.first_jump(each.log_time_ns[rows], each.place[rows])
                if jump is not None:
                    raise LogError(
                        f"{name}: time jumps back: the message on {topic!r} logged at"
                        f" {each.log_time_ns[rows[jump]]} ns was recorded before others that were logged more"
                        " than a second earlier; on_time_jump='split' (--on-time-jump split) ends the log"
                        " where it jumps"
                    )
        yield each


class _Recorded:
    """How far the recording had come, up to a second before the newest message."""

    def __init__(self) -> None:
        self._times = np.zeros(0, np.int64)
        self._furthest = np.zeros(0, np.int64)
        self._base = np.int64(-1)

    def first_jump(self, times_ns: Integers, places: Integers) -> int | None:
        """The first message that was recorded before one of more than a second earlier, or None.

        Args:
            times_ns, places: (M,) of messages in the order of time, after those of the call before.
        """
        if not len(times_ns):
            return None
        times = np.concatenate([self._times, times_ns])
        furthest = np.maximum(np.maximum.accumulate(np.concatenate([self._furthest, places])), self._base)
        before = np.searchsorted(times, times_ns - DISORDER_NS) - 1
        reached = np.where(before >= 0, furthest[before], self._base)
        jumps = np.flatnonzero(places < reached)
        settled = int(np.searchsorted(times, times[-1] - DISORDER_NS))
        if settled:
            self._base = furthest[settled - 1]
        self._times, self._furthest = times[settled:], furthest[settled:]
        return int(jumps[0]) if len(jumps) else None
