"""Evidence against the assumptions by which a track file is read."""

from __future__ import annotations

from collections.abc import Iterator
from math import pi

import numpy as np

from spatial_replay.text import Sentence, number_text
from spatial_replay.trace.doubts import MANY_TURNS, SHORTEST_PERIOD_NS, Doubt
from spatial_replay.trace.trace import Trace

_FEW_SAMPLES = 10
"""Minimum number of samples for a doubt of times; shorter files may be written by hand."""


class TrackEvidence:
    """Measures the angles and times of a track file, block by block."""

    def __init__(self) -> None:
        self._widest_turn = 0.0
        self._turning_objects: set[str] = set()
        self._counts_turns = True
        self._step_count = self._fast_step_count = 0
        self._object_names: set[str] = set()
        self._signal_names: set[str] = set()
        self._sample_count = 0
        self._first_ns = self._last_ns = 0

    def add(self, trace: Trace) -> None:
        """Add the next samples."""
        if not len(trace):
            return
        self._object_names.update(trace.names)
        self._signal_names.update(trace.signals)
        if not self._sample_count:
            self._first_ns = int(trace.times_ns[0])
        self._sample_count += len(trace)
        self._last_ns = int(trace.times_ns[-1])
        angles = np.abs(trace.yaw)
        if (angles > 2 * pi).any():
            self._add_steps(trace)
        if (angles > MANY_TURNS).any():
            # `fmax` ignores NaN, the yaw of objects without orientation
            self._widest_turn = max(self._widest_turn, float(np.fmax.reduce(angles)))
            self._turning_objects.update(trace.names)

    def _add_steps(self, trace: Trace) -> None:
        """Update the number of fast steps, and whether angles are unwrapped.

        Unwrapped angles begin within one turn, and each step is smaller than half a turn.
        """
        yaw = np.where(trace.rows >= 0, trace.yaw[np.maximum(trace.rows, 0)], np.nan)

        is_first_block = self._sample_count == len(trace)
        yaw_steps, step_seconds = np.abs(np.diff(yaw, axis=0)), np.diff(trace.times_ns)[:, None] / 1e9
        self._counts_turns &= not (yaw_steps >= pi).any() and not (
            is_first_block and (np.abs(yaw[0]) > 2 * pi).any()
        )
        self._step_count += int(np.count_nonzero(np.isfinite(yaw_steps)))
        self._fast_step_count += int(np.count_nonzero(yaw_steps > 2 * pi * step_seconds))

    def doubts(self) -> Iterator[Doubt]:
        """Yield the assumptions that the samples contradict. Call this after the last sample."""
        # few robots turn more than once per second, so many fast steps point to degrees
        is_fast = self._fast_step_count > self._step_count / 10
        if self._turning_objects and not (self._counts_turns and not is_fast):
            text = f"its angles reach {number_text(self._widest_turn)} and are read as radians"
            yield Doubt(
                "radians", "", Sentence(f"{text}; write them in radians"), frozenset(self._turning_objects)
            )
        period_ns = (self._last_ns - self._first_ns) / max(1, self._sample_count - 1)
        if self._sample_count >= _FEW_SAMPLES and period_ns < SHORTEST_PERIOD_NS:
            text = f"its samples come every {period_ns:.3g} ns, as if times were in us, ms or s"
            yield Doubt(
                "log_time_unit",
                "",
                Sentence(f"{text}; write them in nanoseconds"),
                frozenset(self._object_names),
                frozenset(self._signal_names),
            )
