"""Messages in the order of time, out of stretches that overlap."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter

from spatial_replay.logs.faults import FaultList
from spatial_replay.logs.foreign.messages import Message

_LOG_ORDER = itemgetter(1, 0, 3)
_LOG_TIME = itemgetter(1)


def in_order(starts_ns: Sequence[int], stretches: Iterable[list[Message]]) -> Iterator[Message]:
    """The messages of several stretches by log time, topic and sequence.

    No more is held than stretches overlap.

    Args:
        starts_ns: when each stretch begins, in order; a message before that comes late.
    """
    waiting: list[Message] = []
    for number, stretch in enumerate(stretches, 1):
        waiting += stretch
        waiting.sort(key=_LOG_ORDER)
        if number == len(starts_ns) or not waiting or waiting[-1].log_time_ns < starts_ns[number]:
            yield from waiting
            waiting = []
        else:
            ready = _count_before(waiting, starts_ns[number])
            yield from waiting[:ready]
            del waiting[:ready]
    yield from waiting


def _count_before(messages: Sequence[Message], time_ns: int) -> int:
    count = len(messages)
    while count and messages[count - 1].log_time_ns >= time_ns:
        count -= 1
    return count


@dataclass(frozen=True)
class Run:
    """Messages in order that may be read from a time on."""

    start_ns: int
    read: Callable[[], Iterator[Message]]


def merged(runs: Iterable[Run]) -> Iterator[Message]:
    """The messages of several runs by log time; a run is opened when its time has come."""
    waiting = sorted(runs, key=lambda run: run.start_ns, reverse=True)
    active: list[tuple[int, int, Message, Iterator[Message]]] = []
    opened = 0
    while waiting or active:
        while waiting and (not active or waiting[-1].start_ns <= active[0][0]):
            messages = waiting.pop().read()
            _push(active, opened, messages)
            opened += 1
        if not active:
            continue
        _, number, message, messages = heapq.heappop(active)
        yield message
        limit = min([run.start_ns for run in waiting[-1:]] + [each[0] for each in active[:1]], default=None)
        for message in messages:
            if limit is not None and message.log_time_ns >= limit:
                heapq.heappush(active, (message.log_time_ns, number, message, messages))
                break
            yield message


def _push(
    active: list[tuple[int, int, Message, Iterator[Message]]], number: int, messages: Iterator[Message]
) -> None:
    first = next(messages, None)
    if first is not None:
        heapq.heappush(active, (first.log_time_ns, number, first, messages))


class CountedTopics:
    """Counts what is read of each topic, and compares it with what a log declares."""

    def __init__(self, declared: Mapping[str, int | None]) -> None:
        self._declared = declared
        self._read: dict[str, int] = dict.fromkeys(declared, 0)

    def counted(self, messages: Iterable[Message]) -> Iterator[Message]:
        """The messages as they are."""
        read = self._read
        for message in messages:
            read[message.topic] += 1
            yield message

    def compare(self, name: str, faults: FaultList) -> None:
        """Tell the faults where a topic has more or fewer messages than declared."""
        for topic, declared in self._declared.items():
            if declared is not None and declared != self._read[topic]:
                faults.add(
                    f"{name}: it declares {declared} messages on {topic!r}; {self._read[topic]} could be read"
                )
