"""When samples are taken."""

from __future__ import annotations

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.mapping.plan import Plan

_MOST_STEPS = 100_000
"""Samples between two messages; more are no log with pauses, but a clock that jumped."""


_MOST_AT_ONCE = 1_000_000
"""Samples among the messages that are taken together: they are in memory at once."""


class Instants:
    """The times of samples, as the messages go by.

    Args:
        start_ns: where the samples begin that matter; those at multiples of a step are counted from there.
    """

    def __init__(self, plan: Plan, name: str, start_ns: int) -> None:
        self._name = name
        self._mapping_name = plan.mapping.name
        self._step_ns = plan.mapping.sampling.step_ns
        self._start_ns = start_ns
        self._from_ns: int | None = None
        self._last_ns = -1

    def upto(self, times_ns: Integers, upto_ns: int) -> Integers:
        """The times of the next samples, each once.

        Args:
            times_ns: of the messages that are new: those of the sampled topic or, for samples at
                each multiple of a step, of all topics with objects or signals.
            upto_ns: how far the log is known.

        Raises:
            LogError: there are far too many samples to where the log goes on.
            UsageError: the step is far too short for how often there are messages.
        """
        if self._step_ns is None:
            times = np.unique(times_ns)
            times = times[times > self._last_ns]
        else:
            times = self._multiples(times_ns, upto_ns, self._step_ns)
        if len(times):
            self._last_ns = int(times[-1])
        return times

    def _multiples(self, times_ns: Integers, upto_ns: int, step_ns: int) -> Integers:
        if self._from_ns is None and len(times_ns):
            self._from_ns = max(int(times_ns.min()), self._start_ns)
        if self._from_ns is None or upto_ns < self._from_ns:
            return np.empty(0, np.int64)
        begin_ns = max(self._from_ns, self._last_ns + 1)
        first, stop = -(-begin_ns // step_ns), upto_ns // step_ns + 1
        marks = np.unique(np.concatenate([[begin_ns, upto_ns], times_ns[times_ns > begin_ns]]))
        gaps = np.diff(marks)
        if len(gaps) and int(gaps.max()) // step_ns > _MOST_STEPS:
            at = int(np.argmax(gaps))
            raise LogError(
                f"{self._name}: time jumps forward from {marks[at]} ns to {marks[at + 1]} ns, more than"
                f" {_MOST_STEPS} samples without a message; take another clock or a longer step"
            )
        if stop - first > _MOST_AT_ONCE:
            raise UsageError(
                f"{self._mapping_name}: sample.every: a sample each {step_ns} ns makes {stop - first} of them"
                f" up to {upto_ns} ns, where at most {_MOST_AT_ONCE} fit between messages that are read"
                " together; give a longer step"
            )
        return np.arange(first, max(first, stop), dtype=np.int64) * step_ns
