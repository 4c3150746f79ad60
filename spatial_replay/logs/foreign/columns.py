"""Many messages as columns.

A million small objects that live for a while make the interpreter's collector of cycles look through all
there is, again and again, which costs more than reading them. Columns of texts, numbers and bytes do not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.foreign.messages import Message

_TOGETHER = 512
"""Messages made at once: fewer than the collector lets pass before it looks."""
_NEW_MESSAGE = partial(tuple.__new__, Message)


@dataclass(frozen=True, slots=True)
class MessageColumns:
    """M messages.

    Attributes:
        topics: (M,) names.
        log_time_ns, publish_time_ns, sequence: (M,) int64.
        payloads: M messages, each in its topic's encoding.
        place: (M,) int64, numbers that increase in the order in which the messages were recorded.
    """

    topics: Sequence[str] = ()
    log_time_ns: Integers = field(default_factory=lambda: np.zeros(0, np.int64))
    publish_time_ns: Integers = field(default_factory=lambda: np.zeros(0, np.int64))
    sequence: Integers = field(default_factory=lambda: np.zeros(0, np.int64))
    payloads: Sequence[bytes] = ()
    place: Integers = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.topics)

    def slice(self, begin: int, end: int) -> MessageColumns:
        """The messages from `begin` up to, not including, `end`."""
        return MessageColumns(
            self.topics[begin:end],
            self.log_time_ns[begin:end],
            self.publish_time_ns[begin:end],
            self.sequence[begin:end],
            self.payloads[begin:end],
            self.place[begin:end],
        )

    def take(self, places: Integers) -> MessageColumns:
        """The messages in the given places, in that order."""
        listed = places.tolist()
        return MessageColumns(
            [self.topics[place] for place in listed],
            self.log_time_ns[places],
            self.publish_time_ns[places],
            self.sequence[places],
            [self.payloads[place] for place in listed],
            self.place[places],
        )

    def ordered(self) -> MessageColumns:
        """The same messages by log time, topic and sequence; equal ones stay as they are."""
        times = self.log_time_ns
        if (times[1:] > times[:-1]).all():
            return self
        rank = {topic: number for number, topic in enumerate(sorted(set(self.topics)))}
        topics = np.fromiter(map(rank.__getitem__, self.topics), np.int64, len(self))
        return self.take(np.lexsort((self.sequence, topics, times)))

    def count_before(self, time_ns: int) -> int:
        """How many of the messages, which are in order, are earlier."""
        return int(np.searchsorted(self.log_time_ns, time_ns, side="left"))

    def messages(self) -> list[Message]:
        """The messages one by one."""
        columns = zip(
            self.topics,
            self.log_time_ns.tolist(),
            self.publish_time_ns.tolist(),
            self.sequence.tolist(),
            self.payloads,
            strict=True,
        )
        return list(map(_NEW_MESSAGE, columns))


Columns: TypeAlias = Iterator[MessageColumns]


def joined(several: Sequence[MessageColumns]) -> MessageColumns:
    """The messages of several columns, one after the other."""
    if len(several) == 1:
        return several[0]
    return MessageColumns(
        [topic for each in several for topic in each.topics],
        np.concatenate([np.zeros(0, np.int64), *(each.log_time_ns for each in several)]),
        np.concatenate([np.zeros(0, np.int64), *(each.publish_time_ns for each in several)]),
        np.concatenate([np.zeros(0, np.int64), *(each.sequence for each in several)]),
        [payload for each in several for payload in each.payloads],
        np.concatenate([np.zeros(0, np.int64), *(each.place for each in several)]),
    )


def in_pieces(columns: Columns, size: int = _TOGETHER) -> Columns:
    """The same messages, no more than `size` at a time."""
    for each in columns:
        for begin in range(0, len(each), size):
            yield each.slice(begin, begin + size)


def one_by_one(columns: Columns) -> Iterator[Message]:
    """The messages themselves."""
    for piece in in_pieces(columns):
        yield from piece.messages()


def unnumbered(
    topics: Sequence[str], times_ns: Integers, payloads: Sequence[bytes], place: Integers
) -> MessageColumns:
    """Messages of a container that knows one time and no sequence."""
    return MessageColumns(topics, times_ns, times_ns, np.zeros(len(times_ns), np.int64), payloads, place)


def places_in(part: int, within: Integers) -> Integers:
    """Places in a log of several parts, such as chunks: in the order of the parts, then within each."""
    return (np.int64(part) << 28) + within
