"""The few earlier samples that a monitor still looks back at."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import chain
from typing import NamedTuple

from spatial_replay.spec.formula import Atom, Earlier, Enlarged, Formula, Quantified
from spatial_replay.spec.terms import iter_formulas, terms_of
from spatial_replay.trace.sample import Sample


class Delay(NamedTuple):
    """How far a term looks back: so many samples, or to the last sample at least so many ns earlier."""

    samples: int | None
    duration_ns: int | None

    @classmethod
    def of(cls, term: Earlier) -> Delay:
        return cls(term.samples, term.duration_ns)


NO_DELAY = Delay(0, None)


def iter_delays(formulas: Iterable[Formula]) -> Iterator[Delay]:
    """How far each term in some formulas looks back, for those that do."""
    for formula in chain.from_iterable(map(iter_formulas, formulas)):
        terms = terms_of(formula.expression) if isinstance(formula, Atom) else ()
        for term in chain(terms, (formula.group,) if isinstance(formula, Quantified) else ()):
            while isinstance(term, Enlarged):
                term = term.term
            if isinstance(term, Earlier):
                yield Delay.of(term)


class RecentSamples:
    """What is at some delays, sample after sample. It keeps the samples within the delays, no others."""

    def __init__(self, delays: Iterable[Delay]) -> None:
        self._queues: list[tuple[Delay, deque[Sample]]] = [(delay, deque()) for delay in delays]

    def take(self, sample: Sample) -> list[Sample | None]:
        """Take in the next sample; the sample at each delay from it, None where that is before the first."""
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
