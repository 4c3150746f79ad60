"""Messages in the order of time, out of stretches that overlap; handed on in lists, not one by one."""

from __future__ import annotations

import heapq
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import TypeAlias

from spatial_replay.logs.faults import FaultList
from spatial_replay.logs.foreign.messages import Message

Batches: TypeAlias = Iterator[list[Message]]

_LOG_ORDER = itemgetter(1, 0, 3)
_LOG_TIME = itemgetter(1)
_TOPIC = itemgetter(0)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Messages of a part of a log.

    Attributes:
        is_ordered: whether the log time of each is later than that of the one before.
    """

    messages: list[Message]
    is_ordered: bool = False


def in_order(starts_ns: Sequence[int], stretches: Iterable[Stretch]) -> Batches:
    """The messages of several stretches by log time, topic and sequence.

    No more is held than stretches overlap.

    Args:
        starts_ns: when each stretch begins, in order; a message before that comes late.
    """
    waiting: list[Message] = []
    for number, stretch in enumerate(stretches, 1):
        needs_order = bool(waiting) or not stretch.is_ordered
        waiting = waiting + stretch.messages if waiting else stretch.messages
        if needs_order:
            waiting.sort(key=_LOG_ORDER)
        if number == len(starts_ns):
            break
        ready = bisect_left(waiting, starts_ns[number], key=_LOG_TIME)
        if ready:
            yield waiting[:ready]
            waiting = waiting[ready:]
    if waiting:
        yield waiting


@dataclass(frozen=True)
class Run:
    """Messages in order that may be read from a time on."""

    start_ns: int
    read: Callable[[], Batches]


def merged(runs: Iterable[Run]) -> Batches:
    """The messages of several runs by log time; a run is opened when its time has come."""
    waiting = sorted(runs, key=lambda run: run.start_ns, reverse=True)
    active: list[tuple[int, int, list[Message], Batches]] = []
    opened = 0
    while waiting or active:
        while waiting and (not active or waiting[-1].start_ns <= active[0][0]):
            _push_next(active, opened, waiting.pop().read())
            opened += 1
        if not active:
            continue
        _, number, batch, batches = heapq.heappop(active)
        limits = [run.start_ns for run in waiting[-1:]] + [each[0] for each in active[:1]]
        # equal times come in the order of the runs
        ready = bisect_right(batch, min(limits), key=_LOG_TIME) if limits else len(batch)
        yield batch[:ready]
        if ready < len(batch):
            heapq.heappush(active, (batch[ready].log_time_ns, number, batch[ready:], batches))
        else:
            _push_next(active, number, batches)


def _push_next(active: list[tuple[int, int, list[Message], Batches]], number: int, batches: Batches) -> None:
    for batch in batches:
        if batch:
            heapq.heappush(active, (batch[0].log_time_ns, number, batch, batches))
            return


class CountedTopics:
    """Counts what is read of each topic, and compares it with what a log declares."""

    def __init__(self, declared: Mapping[str, int | None]) -> None:
        self._declared = declared
        self._read: Counter[str] = Counter()

    def counted(self, batches: Batches) -> Batches:
        """The messages as they are."""
        for batch in batches:
            self._read.update(map(_TOPIC, batch))
            yield batch

    def compare(self, name: str, faults: FaultList) -> None:
        """Tell the faults where a topic has more or fewer messages than declared."""
        for topic, declared in self._declared.items():
            if declared is not None and declared != self._read[topic]:
                faults.add(
                    f"{name}: it declares {declared} messages on {topic!r}; {self._read[topic]} could be read"
                )
