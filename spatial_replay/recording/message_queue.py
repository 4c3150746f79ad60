"""Messages of the caller, from any thread to the one that writes the log."""

from __future__ import annotations

import operator
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from reprlib import repr as shortened
from types import MappingProxyType
from typing import Final

from spatial_replay.errors import SpatialReplayError, UsageError
from spatial_replay.logs.messages import Channel, Messages, Row
from spatial_replay.recording.foreign_channels import MessageData, payload_encoder
from spatial_replay.text import times_apart
from spatial_replay.trace.trace import LATEST_NS

MOST_WAITING_BYTES: Final = 64 * 2**20
"""The most bytes of messages that wait to be written; one message that is larger waits alone."""

_TOGETHER_BYTES: Final = 8 * 2**20
"""About the most bytes that are written at once."""

PAUSE_S = 0.001
"""Between two looks at a queue that is full."""


class MessageQueue:
    """Messages from any thread, on their way to the one thread that writes them.

    Only the threads that write messages take its lock, so that an interruption of one of them never stops
    the writing thread.

    Attributes:
        newest_ns: the latest time of a queued message, -1 before the first.
        is_closed: whether no more messages are taken.
        process: the one that the recorder belongs to.
        failure: why nothing can be written any more, or None.
    """

    def __init__(
        self, name: str, limit: int, *, blocks: bool, ring: Callable[[], None], missed: Callable[[int], None]
    ) -> None:
        """Begin without channels.

        Args:
            name: of the log.
            limit: how many messages may wait.
            blocks: whether a message waits for its place, or is dropped.
            ring: wakes the writing thread.
            missed: takes the time of each message that is dropped.
        """
        self.missed = missed
        self._name, self._limit, self._blocks, self._ring = name, limit, blocks, ring
        # reentrant, so that a signal handler may write while its own thread does
        self.lock = threading.RLock()
        self.channels: dict[str, MessageChannel] = {}
        self._declared: Mapping[int, Channel] = MappingProxyType({})
        self._queue: queue.SimpleQueue[Row] = queue.SimpleQueue()
        self._bytes_in = self._bytes_out = 0
        self.newest_ns = -1
        self.is_closed = False
        self.process = os.getpid()
        self.failure: SpatialReplayError | None = None

    @property
    def dropped(self) -> int:
        """How many messages were dropped, on all channels."""
        return sum(channel.dropped for channel in self.channels.values())

    def channel(self, channel: Channel) -> MessageChannel:
        """Return the channel of a topic, the same one whenever it is opened in the same way.

        Raises:
            UsageError: the recorder is closed, or the topic is open with another encoding or schema.
        """
        with self.lock:
            self.require_open()
            message_channel = self.channels.get(channel.topic)
            if message_channel is None:
                number = len(self.channels)
                message_channel = MessageChannel(self, number, channel)
                # replaced, never changed: the writing thread may be reading it
                self._declared = MappingProxyType({**self._declared, number: channel})
                self.channels[channel.topic] = message_channel
            elif message_channel.declaration != channel:
                raise UsageError(
                    f"{channel.topic} is open already with another encoding or schema; give one topic to each"
                )
            return message_channel

    def require_open(self) -> None:
        """Check that messages can be taken.

        Raises:
            UsageError: the recorder is closed, or another process has it since a fork.
            Exception: what prevents writing.
        """
        if self.is_closed:
            raise UsageError(f"{self._name} is closed; open another recorder")
        if os.getpid() != self.process:
            raise UsageError(f"{self._name} belongs to another process; open a recorder in this one")
        self.raise_failure()

    def raise_failure(self) -> None:
        """Raise what prevents writing, if anything does."""
        if self.failure is not None:
            raise self.failure

    def put(self, message: Row) -> bool:
        """Queue a message; return False if it was dropped. Call it with the lock held."""
        size = len(message.payload)
        while self._is_full(size):
            if not self._blocks:
                return False
            # no one makes room after that
            self.raise_failure()
            self._ring()
            time.sleep(PAUSE_S)
        self._bytes_in += size
        self._queue.put(message)
        if self._bytes_in - self._bytes_out > _TOGETHER_BYTES or self._queue.qsize() * 2 >= self._limit:
            self._ring()
        return True

    def take(self) -> Messages:
        """Return some of the messages that wait, none if there are none; for the writing thread."""
        rows: list[Row] = []
        size = 0
        with suppress(queue.Empty):
            while size < _TOGETHER_BYTES:
                row = self._queue.get_nowait()
                rows.append(row)
                size += len(row.payload)
        # only this thread counts what leaves, and others, under the lock, what comes: it needs no lock
        self._bytes_out += size
        return Messages.from_rows(self._declared, rows)

    def _is_full(self, size: int) -> bool:
        waiting_bytes = self._bytes_in - self._bytes_out
        return self._queue.qsize() >= self._limit or (
            waiting_bytes > 0 and waiting_bytes + size > MOST_WAITING_BYTES
        )


class MessageChannel:
    """A topic of a recorder for messages of the caller's own; `Recorder.channel` opens it.

    Any thread may write, also several on one channel.

    Attributes:
        topic, encoding: those of its messages.
        written: how many messages were taken.
        dropped: how many messages were dropped because the queue was full.
    """

    def __init__(self, queue: MessageQueue, number: int, declaration: Channel) -> None:
        self._queue, self._number = queue, number
        self.declaration = declaration
        self.topic, self.encoding = declaration.topic, declaration.encoding
        self._encode = payload_encoder(declaration)
        self._last_ns = 0
        self.written = self.dropped = 0

    def __repr__(self) -> str:
        return f"MessageChannel({self.topic!r}, encoding={self.encoding!r}, written={self.written})"

    def write(self, time_ns: int, data: MessageData) -> None:
        """Hand over the next message; return at once unless the queue is full.

        Args:
            time_ns: its log time, on the clock of the samples; not before that of the channel's last message.
            data: a dict for json, a message for protobuf, or bytes, which are written unchanged.

        Raises:
            UsageError: a time out of range or order, data that does not fit the channel, a closed recorder.
            OutputError: something before could not be written.
        """
        time_ns = self._check_time(time_ns)
        payload = self._encode(data)
        queue = self._queue
        with queue.lock:
            queue.require_open()
            if time_ns < self._last_ns:
                at, last = times_apart(time_ns, self._last_ns)
                raise UsageError(
                    f"a message on {self.topic} at {at} follows one at {last}; give times that do not"
                    " decrease, or each thread a topic"
                )
            self._put(time_ns, time_ns, payload)

    def copy(self, time_ns: int, payload: bytes) -> None:
        """Hand over a message of another program, which may come a little late. It is published at its time,
        and logged then or at the log time of its predecessor, whichever is later."""
        with self._queue.lock:
            self._queue.require_open()
            self._put(max(time_ns, self._last_ns), time_ns, payload)

    def _put(self, time_ns: int, publish_ns: int, payload: bytes) -> None:
        self._last_ns = time_ns
        if self._queue.put(Row(self._number, self.written, time_ns, publish_ns, payload)):
            self.written += 1
            self._queue.newest_ns = max(self._queue.newest_ns, time_ns)
        else:
            self.dropped += 1
            self._queue.missed(time_ns)

    def _check_time(self, time_ns: object) -> int:
        try:
            number = operator.index(time_ns)  # type: ignore[arg-type]
        except TypeError:
            number = -1
        if isinstance(time_ns, bool) or not 0 <= number <= LATEST_NS:
            raise UsageError(
                f"the time of a message on {self.topic} is {shortened(time_ns)}; give integer nanoseconds"
                " from 0 to 2**63 - 1"
            )
        return number
