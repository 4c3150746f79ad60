"""The messages of a log itself, from any time on, and those of them that still stand then."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from spatial_replay.logs.block import Block, Channel, Messages
from spatial_replay.logs.merging import merge, select
from spatial_replay.logs.reading import read_blocks
from spatial_replay.logs.source import MemorySource
from spatial_replay.replay.selection import Selection
from spatial_replay.trace.trace import Trace, window_of

_FEW: Final = 2_000
_FEW_BYTES: Final = 1 << 26
"""Messages of one topic, and bytes of all such topics, that are held in memory."""


class OwnMessages:
    """What a copy of a log keeps of it: messages of any topic, samples where they are not among those.

    Topics with few messages are held in memory, since viewers show each message until the next one of its
    topic, however old it is; the others are read again when they are played.

    Attributes:
        channels: in the order in which they were met.
        start_ns, end_ns: times of the first and the last message; 0 and -1 if there are none.
    """

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._samples: list[Trace] = []
        self._few: dict[Channel, list[Messages]] = {}
        self._counts: dict[Channel, int] = {}
        self._bytes = 0
        self.start_ns, self.end_ns = 0, -1

    @property
    def channels(self) -> tuple[Channel, ...]:
        return tuple(self._counts)

    def add(self, block: Block) -> None:
        """Take in the next block of the log."""
        window = self._selection.window
        begin, end = window_of(block.messages.log_time_ns, window.start_ns, window.end_ns)
        if end > begin:
            times_ns = block.messages.log_time_ns[begin:end]
            self.start_ns = int(times_ns[0]) if not self._counts else min(self.start_ns, int(times_ns[0]))
            self.end_ns = max(self.end_ns, int(times_ns[-1]))
            self._count(select(block.messages, np.arange(begin, end)))
        if self._counts:
            self._samples = []
        else:
            self._samples.append(block.trace)

    def iter_from(self, start_ns: int) -> Iterator[Messages]:
        """Those at or after a time, in order, in pieces of bounded size.

        Raises:
            LogError: the log cannot be read any more.
        """
        selection = self._selection
        first = 0
        source = selection.source if self._counts else MemorySource(self._trace(), selection.source.name)
        for block in read_blocks(source, max(start_ns, selection.window.start_ns), selection.window.end_ns):
            yield selection.own_messages(block, first)
            first += len(selection.inside(block.trace))

    def newest_before(self, time_ns: int) -> Messages:
        """Of each topic with few messages the last one before a time."""
        return newest(
            merge(
                [
                    select(messages, np.arange(np.searchsorted(messages.log_time_ns, time_ns)))
                    for pieces in self._few.values()
                    for messages in pieces
                ]
            )
        )

    def _trace(self) -> Trace:
        if len(self._samples) > 1:
            self._samples = [Trace.concatenate(self._samples)]
        return self._samples[0]

    def _count(self, messages: Messages) -> None:
        """Take in messages in the window; topics that have many are held no longer."""
        for number, channel in messages.channels.items():
            chosen = np.flatnonzero(messages.channel == number)
            if channel not in self._counts:
                self._few[channel] = []
            self._counts[channel] = self._counts.get(channel, 0) + len(chosen)
            if channel in self._few and len(chosen):
                own = select(messages, chosen)
                self._few[channel].append(own)
                self._bytes += _size(own)
                if self._counts[channel] > _FEW or self._bytes > _FEW_BYTES:
                    self._bytes -= sum(map(_size, self._few.pop(channel)))


class Reading:
    """A log's own messages from a time on, taken stretch by stretch."""

    def __init__(self, own: OwnMessages, start_ns: int) -> None:
        self._pieces = own.iter_from(start_ns)
        self._waiting = Messages()
        self._is_over = False

    def take_before(self, end_ns: int) -> Messages:
        """Those before a time that were not taken yet.

        Raises:
            LogError: the log cannot be read any more.
        """
        while not self._is_over and not _reaches(self._waiting, end_ns):
            piece = next(self._pieces, None)
            if piece is None:
                self._is_over = True
            else:
                self._waiting = merge([self._waiting, piece])
        count = int(np.searchsorted(self._waiting.log_time_ns, end_ns))
        taken = select(self._waiting, np.arange(count))
        self._waiting = select(self._waiting, np.arange(count, len(self._waiting)))
        return taken


def newest(messages: Messages) -> Messages:
    """Of each channel the last message."""
    _, last = np.unique(messages.channel[::-1], return_index=True)
    return select(messages, np.sort(len(messages) - 1 - last))


def _reaches(messages: Messages, end_ns: int) -> bool:
    return len(messages) > 0 and int(messages.log_time_ns[-1]) >= end_ns


def _size(messages: Messages) -> int:
    payloads: Sequence[bytes] = messages.payloads
    return sum(map(len, payloads))
