"""The messages of a log itself, read from any time on.

A playback sends them between the messages of the evaluation; a seek needs the latest message of each topic.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.messages import Block, Channel, Messages, merge, select
from spatial_replay.logs.source import read_blocks
from spatial_replay.replay.selection import Selection
from spatial_replay.trace.trace import Trace, window_of

_FEW: Final = 2_000
_FEW_BYTES: Final = 1 << 26
"""The most messages of one topic, and bytes of all such topics, that are kept in memory."""

_PIECE: Final = 256
"""Samples that are encoded at once."""


class OwnMessages:
    """The messages that a copy of a log has: those of the log, and samples that are not among them.

    Topics with few messages (a map, a transform) stay in memory, since viewers show a message until the next
    one of its topic, however old it is. The other topics are read again when they are played.

    Attributes:
        channels: in the order of their first messages.
        start_ns, end_ns: times of the first and the last message or sample; 0 and -1 if there are none.
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
        """Add the next block of the log."""
        window = self._selection.window
        begin, end = window_of(block.messages.log_time_ns, window.start_ns, window.end_ns)
        messages = select(block.messages, np.arange(begin, end))
        self._span(messages.log_time_ns)
        self._span(self._selection.inside(block.trace).times_ns)
        self._count(messages)
        # a log without messages is played from memory; others are read again
        if self._counts:
            self._samples = []
        else:
            self._samples.append(block.trace)

    def iter_from(self, start_ns: int) -> Iterator[Messages]:
        """Read the messages at or after a time, in order, in pieces of bounded size.

        Raises:
            LogError: the log can no longer be read.
        """
        selection = self._selection
        first = 0
        for block in self._iter_blocks(max(start_ns, selection.window.start_ns)):
            yield selection.own_messages(block, first)
            first += len(selection.inside(block.trace))

    def few_before(self, time_ns: int) -> Messages:
        """Return the last message before a time of each topic with few messages."""
        before = [
            select(messages, np.arange(np.searchsorted(messages.log_time_ns, time_ns)))
            for pieces in self._few.values()
            for messages in pieces
        ]
        return latest_messages(merge(before), time_ns)

    def _iter_blocks(self, start_ns: int) -> Iterator[Block]:
        """Read the log from a time on; from memory, in small pieces, if samples are all that it has."""
        if self._counts:
            yield from read_blocks(self._selection.source, start_ns, self._selection.window.end_ns)
            return
        if len(self._samples) > 1:
            self._samples = [Trace.concatenate(self._samples)]
        for trace in self._samples:
            begin = int(np.searchsorted(trace.times_ns, start_ns))
            for at in range(begin, len(trace), _PIECE):
                yield Block(trace.slice(at, at + _PIECE))

    def _span(self, times_ns: Integers) -> None:
        if len(times_ns):
            first_ns, last_ns = times_ns[[0, -1]].tolist()
            self.start_ns = first_ns if self.end_ns < 0 else min(self.start_ns, first_ns)
            self.end_ns = max(self.end_ns, last_ns)

    def _count(self, messages: Messages) -> None:
        """Count messages in the window; topics that turn out to have many leave the memory."""
        for number, channel in messages.channels.items():
            chosen = np.flatnonzero(messages.channel == number)
            if not len(chosen):
                continue
            if channel not in self._counts:
                self._few[channel] = []
            self._counts[channel] = self._counts.get(channel, 0) + len(chosen)
            if channel in self._few:
                own = select(messages, chosen)
                self._few[channel].append(own)
                self._bytes += _size(own)
                if self._counts[channel] > _FEW or self._bytes > _FEW_BYTES:
                    self._bytes -= sum(map(_size, self._few.pop(channel)))


class MessageCursor:
    """A position in a log's own messages, which moves forward."""

    def __init__(self, own: OwnMessages, start_ns: int) -> None:
        self._pieces = own.iter_from(start_ns)
        self._waiting = Messages()
        self._taken = 0
        self._is_over = False

    def take_before(self, end_ns: int) -> Messages:
        """Return the messages before a time that were not taken yet.

        Raises:
            LogError: the log can no longer be read.
        """
        while not self._is_over and not _reaches(self._waiting, end_ns):
            piece = next(self._pieces, None)
            if piece is None:
                self._is_over = True
            else:
                rest = select(self._waiting, np.arange(self._taken, len(self._waiting)))
                self._waiting, self._taken = merge([rest, piece]), 0
        begin = self._taken
        self._taken = max(begin, int(np.searchsorted(self._waiting.log_time_ns, end_ns)))
        return select(self._waiting, np.arange(begin, self._taken))


def latest_messages(messages: Messages, time_ns: int) -> Messages:
    """Return of each channel the messages from a time on or, if it has none, the last one before."""
    _, last = np.unique(messages.channel[::-1], return_index=True)
    chosen = messages.log_time_ns >= time_ns
    chosen[len(messages) - 1 - last] = True
    return select(messages, np.flatnonzero(chosen))


def _reaches(messages: Messages, end_ns: int) -> bool:
    return len(messages) > 0 and int(messages.log_time_ns[-1]) >= end_ns


def _size(messages: Messages) -> int:
    payloads: Sequence[bytes] = messages.payloads
    return sum(map(len, payloads))
