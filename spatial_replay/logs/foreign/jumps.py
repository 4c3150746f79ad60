"""Logs whose clock was set back while they were recorded, as when a simulation starts again.

Read in the order of time, the two passes over the same time would look like one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

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
    topics = dict[str, _Recorded]()
    for each in columns:
        for topic, rows in _rows_by_topic(each.topics):
            recorded = topics.setdefault(topic, _Recorded())
            jump = recorded.first_jump(each.log_time_ns[rows], each.place[rows])
            if jump is not None:
                raise LogError(
                    f"{name}: time jumps back: the message on {topic!r} logged at"
                    f" {each.log_time_ns[rows][jump]} ns was recorded before others that were logged more"
                    " than a second earlier; on_time_jump='split' (--on-time-jump split) ends the log"
                    " where it jumps"
                )
        yield each


def _rows_by_topic(topics: Sequence[str]) -> Iterator[tuple[str, Integers | slice]]:
    names = sorted(set(topics))
    if len(names) == 1:
        yield names[0], slice(None)
        return
    number = {name: code for code, name in enumerate(names)}
    codes = np.fromiter(map(number.__getitem__, topics), np.int64, len(topics))
    rows = np.split(np.argsort(codes, kind="stable"), np.cumsum(np.bincount(codes))[:-1])
    yield from zip(names, rows, strict=True)


class _Recorded:
    """How far the recording had come at each of the last messages, a second back and a little more."""

    def __init__(self) -> None:
        self._latest: deque[tuple[Integers, Integers]] = deque()
        self._before = -1
        self._furthest = -1

    def first_jump(self, times_ns: Integers, places: Integers) -> int | None:
        """The first message that was recorded before one of more than a second earlier, or None.

        Args:
            times_ns, places: (M,) of messages in the order of time, after those of the call before.
        """
        if not len(times_ns):
            return None
        is_ordered = places[0] >= self._furthest and (places[1:] >= places[:-1]).all()
        furthest = places if is_ordered else np.maximum(np.maximum.accumulate(places), self._furthest)
        self._latest.append((times_ns, furthest))
        self._furthest = int(furthest[-1])
        found = None if is_ordered else self._search(times_ns, places)
        while self._latest[0][0][-1] < times_ns[-1] - DISORDER_NS:
            self._before = int(self._latest.popleft()[1][-1])
        return found

    def _search(self, times_ns: Integers, places: Integers) -> int | None:
        times = np.concatenate([times for times, _ in self._latest])
        furthest = np.concatenate([[self._before], *(furthest for _, furthest in self._latest)])
        earlier = np.searchsorted(times, times_ns - DISORDER_NS)
        jumps = np.flatnonzero(places < furthest[earlier])
        return int(jumps[0]) if len(jumps) else None
