"""Terms that look back (`a[-3]`, `a[-2s]`): how far they do, and the recent samples they need."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from spatial_replay.spec.formula import Earlier, Formula
from spatial_replay.spec.walks import has_rate, iter_terms, standing
from spatial_replay.trace.trace import Sample, Trace


class Delay(NamedTuple):
    """How far a term looks back: some samples, or to the last sample at least some ns earlier."""

    samples: int | None
    duration_ns: int | None

    @classmethod
    def of(cls, term: Earlier) -> Delay:
        return cls(term.samples, term.duration_ns)


NO_DELAY = Delay(0, None)
PREVIOUS = Delay(1, None)


def iter_delays(formulas: Sequence[Formula]) -> Iterator[Delay]:
    """Iterate over the delays of the terms in some formulas that look back."""
    for term in map(standing, iter_terms(formulas)):
        if isinstance(term, Earlier):
            yield Delay.of(term)
    # rates also look at the time of the sample before, and at its signals
    if any(map(has_rate, formulas)):
        yield PREVIOUS


def look_back(formulas: Sequence[Formula]) -> tuple[int, int]:
    """Return how far terms look back: the most samples (`a[-3]`), the longest duration in ns (`a[-2s]`)."""
    delays = list(iter_delays(formulas))
    samples = max((delay.samples or 0 for delay in delays), default=0)
    duration_ns = max((delay.duration_ns or 0 for delay in delays), default=0)
    return samples, duration_ns


def tail(trace: Trace, samples: int, duration_ns: int) -> Trace:
    """Return the last samples of a trace that the next one may look back at (see `look_back`)."""
    begin = len(trace) - samples
    if duration_ns:
        # the next sample is later than the newest, so it needs nothing before what the newest looks back at
        latest_ns = trace.times_ns[-1] - duration_ns
        begin = min(begin, int(np.searchsorted(trace.times_ns, latest_ns, side="right")) - 1)
    return trace.slice(max(begin, 0), len(trace))


class RecentSamples:
    """The samples at some delays from the newest; older ones are dropped."""

    def __init__(self, delays: Iterable[Delay]) -> None:
        self._queues: list[tuple[Delay, deque[Sample]]] = [(delay, deque()) for delay in delays]
        self._is_newest_only = [delay for delay, _ in self._queues] == [NO_DELAY]

    def add(self, sample: Sample) -> list[Sample | None]:
        """Add the next sample; return the one at each delay from it, None before the first sample."""
        if self._is_newest_only:
            return [sample]
        return [_at_delay(delay, queue, sample) for delay, queue in self._queues]


def _at_delay(delay: Delay, queue: deque[Sample], sample: Sample) -> Sample | None:
    if delay == NO_DELAY:
        return sample
    queue.append(sample)
    if delay.duration_ns is None:
        while len(queue) > (delay.samples or 0) + 1:
            queue.popleft()
        return queue[0] if len(queue) > (delay.samples or 0) else None
    latest_ns = sample.time_ns - delay.duration_ns
    while len(queue) > 1 and queue[1].time_ns <= latest_ns:
        queue.popleft()
    return queue[0] if queue[0].time_ns <= latest_ns else None
