"""Messages in the order of time, out of stretches and files that overlap."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from spatial_replay.logs.faults import FaultList
from spatial_replay.logs.foreign.columns import Columns, MessageColumns, joined


def in_order(starts_ns: Sequence[int], stretches: Iterable[MessageColumns]) -> Columns:
    """The messages of several stretches by log time, topic and sequence.

    No more is held than stretches overlap.

    Args:
        starts_ns: when each stretch begins, in order; a message before that comes late.
    """
    waiting = MessageColumns()
    for number, stretch in enumerate(stretches, 1):
        waiting = joined([waiting, stretch] if len(waiting) else [stretch]).ordered()
        if number == len(starts_ns):
            break
        ready = waiting.count_before(starts_ns[number])
        if ready:
            yield waiting.slice(0, ready)
            waiting = waiting.slice(ready, len(waiting))
    if len(waiting):
        yield waiting


@dataclass(frozen=True)
class Run:
    """Messages in order that may be read from a time on."""

    start_ns: int
    read: Callable[[], Columns]


_Active = list[tuple[int, int, MessageColumns, Columns]]
"""A heap: time of the first message, number of the run, messages, and those that come after them."""


def merged(runs: Iterable[Run]) -> Columns:
    """The messages of several runs by log time; a run is opened when its time has come."""
    waiting = sorted(runs, key=lambda run: run.start_ns, reverse=True)
    active: _Active = []
    opened = 0
    while waiting or active:
        while waiting and (not active or waiting[-1].start_ns <= active[0][0]):
            _push_next(active, opened, waiting.pop().read())
            opened += 1
        if not active:
            continue
        _, number, columns, following = heapq.heappop(active)
        limits = [run.start_ns for run in waiting[-1:]] + [each[0] for each in active[:1]]
        # equal times come in the order of the runs
        ready = columns.count_before(min(limits) + 1) if limits else len(columns)
        yield columns.slice(0, ready)
        if ready < len(columns):
            rest = columns.slice(ready, len(columns))
            heapq.heappush(active, (int(rest.log_time_ns[0]), number, rest, following))
        else:
            _push_next(active, number, following)


def _push_next(active: _Active, number: int, following: Columns) -> None:
    for columns in following:
        if len(columns):
            heapq.heappush(active, (int(columns.log_time_ns[0]), number, columns, following))
            return


class CountedTopics:
    """Counts what is read of each topic, and compares it with what a log declares."""

    def __init__(self, declared: Mapping[str, int | None]) -> None:
        self._declared = declared
        self._read: Counter[str] = Counter()

    def counted(self, columns: Columns) -> Columns:
        """The messages as they are."""
        for each in columns:
            self._read.update(each.topics)
            yield each

    def compare(self, name: str, faults: FaultList) -> None:
        """Tell the faults where a topic has more or fewer messages than declared."""
        for topic, declared in self._declared.items():
            if declared is not None and declared != self._read[topic]:
                faults.add(
                    f"{name}: it declares {declared} messages on {topic!r}; {self._read[topic]} could be read"
                )
