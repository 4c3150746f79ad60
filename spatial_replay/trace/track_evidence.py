"""Evidence of how a track file was read: its samples in, doubts out."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from spatial_replay.text import Sentence, number_text
from spatial_replay.trace.doubts import MANY_TURNS, SHORTEST_PERIOD_NS, Doubt
from spatial_replay.trace.trace import Trace

_FEW_SAMPLES = 10
"""Fewer samples may be written by hand, at any times."""


class TrackEvidence:
    """Measures the angles and the times of a track file, block by block."""

    def __init__(self) -> None:
        self._widest_turn = 0.0
        self._turned: set[str] = set()
        self._names: set[str] = set()
        self._signals: set[str] = set()
        self._samples = 0
        self._first_ns = self._last_ns = 0

    def add(self, trace: Trace) -> None:
        """Add the next samples."""
        if not len(trace):
            return
        self._names.update(trace.names)
        self._signals.update(trace.signals)
        if not self._samples:
            self._first_ns = int(trace.times_ns[0])
        self._samples += len(trace)
        self._last_ns = int(trace.times_ns[-1])
        turns = np.abs(trace.yaw)
        if (turns > MANY_TURNS).any():
            self._widest_turn = max(self._widest_turn, float(np.fmax.reduce(turns)))
            self._turned.update(trace.names)

    def doubts(self) -> Iterator[Doubt]:
        """Yield the assumptions that the samples contradict, after the last of them."""
        if self._turned:
            text = f"its angles reach {number_text(self._widest_turn)} and are read as radians"
            yield Doubt("radians", "", Sentence(f"{text}; write them in radians"), frozenset(self._turned))
        period_ns = (self._last_ns - self._first_ns) / max(1, self._samples - 1)
        if self._samples >= _FEW_SAMPLES and period_ns < SHORTEST_PERIOD_NS:
            text = f"its samples come every {period_ns:.3g} ns, as if times were in us, ms or s"
            yield Doubt(
                "log_time_unit",
                "",
                Sentence(f"{text}; write them in nanoseconds"),
                frozenset(self._names),
                frozenset(self._signals),
            )
