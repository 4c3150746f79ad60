"""Pauses in what otherwise comes regularly: samples, or the messages of a topic."""

from __future__ import annotations

from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.text import Instant, Sentence, counted

_LONG: Final = 5
"""A pause is longer than so many usual periods."""
_FEWEST: Final = 10
"""Intervals that show which period is usual."""
_RARE: Final = 20
"""Where more than one in so many intervals is long, nothing comes regularly."""
_MOST_LISTED: Final = 3


class Pauses:
    """The intervals between times, added in order."""

    def __init__(self) -> None:
        self._times = np.empty(0, np.int64)
        self._starts: list[Integers] = []
        self._intervals: list[Integers] = []

    def add(self, times_ns: Integers) -> None:
        """Add times, which follow those before."""
        times = np.concatenate([self._times, times_ns])
        self._starts.append(times[:-1])
        self._intervals.append(np.diff(times))
        self._times = times[-1:]

    def found(self) -> list[tuple[int, int]]:
        """Return the start and the length of each pause, the longest first."""
        intervals = np.concatenate([np.empty(0, np.int64), *self._intervals])
        is_long = intervals > _LONG * self.usual_ns
        if len(intervals) < _FEWEST or np.count_nonzero(is_long) > max(1, len(intervals) // _RARE):
            return []
        starts = np.concatenate(self._starts)[is_long].tolist()
        return sorted(zip(starts, intervals[is_long].tolist(), strict=True), key=lambda each: -each[1])

    @property
    def usual_ns(self) -> int:
        """The median of the intervals; 0 without any."""
        intervals = [each for each in self._intervals if len(each)]
        return int(np.median(np.concatenate(intervals))) if intervals else 0

    def remark(self, what: str) -> Sentence | None:
        """Return a sentence about the pauses of `what`; None without any."""
        found = self.found()
        if not found:
            return None
        parts: list[str | Instant] = []
        for start_ns, length_ns in found[:_MOST_LISTED]:
            comma = ", " if parts else ""
            parts += [f"{comma}for {length_ns / 1e9:.3f} s from ", Instant(start_ns, 0), " on"]
        more = len(found) - _MOST_LISTED
        others = f", and {counted(more, 'more time')}" if more > 0 else ""
        usual = f", where one usually comes every {self.usual_ns / 1e9:.3g} s"
        return Sentence(f"{what} pause ", *parts, f"{others}{usual}; `max_gap` makes what lies there unknown")
