"""Queue of the caller's messages, from any thread to the thread that writes the log."""

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
"""Limit of queued messages, bytes; a larger message is accepted into an empty queue."""

_TOGETHER_BYTES: Final = 8 * 2**20
"""Approximate limit of messages that are written at once, bytes."""

PAUSE_S = 0.001
"""Polling interval while the queue is full, s."""


class MessageQueue:
    """Messages from any thread that wait for the writing thread.

    Only the caller's threads take the lock, so that an interrupted thread never blocks the writing thread.

    Attributes:
        newest_ns: latest time of a queued message, -1 before the first message.
        is_closed: whether further messages are refused.
        process: id of the process that opened the recorder.
        failure: error that prevents further writing, or None.
    """

    def __init__(
        self, name: str, limit: int, *, blocks: bool, ring: Callable[[], None], missed: Callable[[int], None]
    ) -> None:
        """Begin without channels.

        Args:
            name: name of the log, for errors.
            limit: maximum number of waiting messages.
            blocks: whether `put` waits while the queue is full, instead of dropping the message.
            ring: function that wakes the writing thread.
            missed: function that is called with the time of each dropped message.
        """
        self.missed = missed
        self._name, self._limit, self._blocks, self._ring = name, limit, blocks, ring
        # reentrant, because a signal handler may write while it interrupts a write of the same thread
        self.lock = threading.RLock()
        self.channels: dict[str, MessageChannel] = {}
        self._channels_by_id: Mapping[int, Channel] = MappingProxyType({})
        self._queue: queue.SimpleQueue[Row] = queue.SimpleQueue()
        self._bytes_in = self._bytes_out = 0
        self.newest_ns = -1
        self.is_closed = False
        self.process = os.getpid()
        self.failure: SpatialReplayError | None = None

    @property
    def dropped(self) -> int:
        """Number of dropped messages, over all channels."""
        return sum(channel.dropped for channel in self.channels.values())

    def channel(self, channel: Channel) -> MessageChannel:
        """Return the channel of a topic; a topic that is already open gives the same channel.

        Raises:
            UsageError: the recorder is closed, or the topic is open with another encoding or schema.
        """
        with self.lock:
            self.require_open()
            message_channel = self.channels.get(channel.topic)
            if message_channel is None:
                channel_id = len(self.channels)
                message_channel = MessageChannel(self, channel_id, channel)
                # the mapping is replaced, not changed, because the writing thread reads it without the lock
                self._channels_by_id = MappingProxyType({**self._channels_by_id, channel_id: channel})
                self.channels[channel.topic] = message_channel
            elif message_channel.declaration != channel:
                raise UsageError(
                    f"{channel.topic} is open already with another encoding or schema; use another topic"
                )
            return message_channel

    def require_open(self) -> None:
        """Check that messages can be accepted.

        Raises:
            UsageError: the recorder is closed, or was opened by another process before a fork.
            SpatialReplayError: the failure that prevents writing.
        """
        if self.is_closed:
            raise UsageError(f"{self._name} is closed; open another recorder")
        if os.getpid() != self.process:
            raise UsageError(f"{self._name} belongs to another process; open a recorder in this one")
        self.raise_failure()

    def raise_failure(self) -> None:
        """Raise the failure that prevents writing, if any."""
        if self.failure is not None:
            raise self.failure

    def put(self, message: Row) -> bool:
        """Queue a message; return False if it was dropped. Call it with the lock held."""
        payload_bytes = len(message.payload)
        while self._is_full(payload_bytes):
            if not self._blocks:
                return False
            # after a failure the queue is never emptied
            self.raise_failure()
            self._ring()
            time.sleep(PAUSE_S)
        self._bytes_in += payload_bytes
        self._queue.put(message)
        # the writing thread is woken before the queue is full
        if self._bytes_in - self._bytes_out > _TOGETHER_BYTES or self._queue.qsize() * 2 >= self._limit:
            self._ring()
        return True

    def take(self) -> Messages:
        """Return some of the waiting messages, possibly none; only the writing thread calls it."""
        messages: list[Row] = []
        payload_bytes = 0
        with suppress(queue.Empty):
            while payload_bytes < _TOGETHER_BYTES:
                message = self._queue.get_nowait()
                messages.append(message)
                payload_bytes += len(message.payload)
        # no lock: only this thread changes _bytes_out, and only holders of the lock change _bytes_in
        self._bytes_out += payload_bytes
        return Messages.from_rows(self._channels_by_id, messages)

    def _is_full(self, payload_bytes: int) -> bool:
        waiting_bytes = self._bytes_in - self._bytes_out
        return self._queue.qsize() >= self._limit or (
            waiting_bytes > 0 and waiting_bytes + payload_bytes > MOST_WAITING_BYTES
        )


class MessageChannel:
    """A recorder's topic for messages of the caller; `Recorder.channel` opens it.

    Several threads may write to one channel.

    Attributes:
        topic, encoding: topic and encoding of the messages.
        written: number of accepted messages.
        dropped: number of messages that were dropped because the queue was full.
    """

    def __init__(self, queue: MessageQueue, channel_id: int, declaration: Channel) -> None:
        self._queue, self._channel_id = queue, channel_id
        self.declaration = declaration
        self.topic, self.encoding = declaration.topic, declaration.encoding
        self._encode = payload_encoder(declaration)
        self._last_ns = 0
        self.written = self.dropped = 0

    def __repr__(self) -> str:
        return f"MessageChannel({self.topic!r}, encoding={self.encoding!r}, written={self.written})"

    def write(self, time_ns: int, data: MessageData) -> None:
        """Queue the next message; return at once unless the queue is full.

        Args:
            time_ns: log time of the message, on the clock of the samples. The time may not be before the
                channel's previous message.
            data: a dict for json, a message for protobuf, or bytes, which are written unchanged.

        Raises:
            UsageError: a time out of range or order, data that does not fit the channel, a closed recorder.
            OutputError: an earlier sample or message could not be written.
        """
        time_ns = self._check_time(time_ns)
        payload = self._encode(data)
        queue = self._queue
        with queue.lock:
            queue.require_open()
            if time_ns < self._last_ns:
                time_text, last_time_text = times_apart(time_ns, self._last_ns)
                raise UsageError(
                    f"a message on {self.topic} at {time_text} follows one at {last_time_text}; give"
                    " times that do not decrease, or a topic for each thread"
                )
            self._put(time_ns, time_ns, payload)

    def copy(self, time_ns: int, payload: bytes) -> None:
        """Queue a message of another program, which may arrive late.

        The publish time is `time_ns`. The log time is the later of `time_ns` and the log time of the
        channel's previous message.
        """
        with self._queue.lock:
            self._queue.require_open()
            self._put(max(time_ns, self._last_ns), time_ns, payload)

    def _put(self, time_ns: int, publish_ns: int, payload: bytes) -> None:
        self._last_ns = time_ns
        if self._queue.put(Row(self._channel_id, self.written, time_ns, publish_ns, payload)):
            self.written += 1
            self._queue.newest_ns = max(self._queue.newest_ns, time_ns)
        else:
            self.dropped += 1
            self._queue.missed(time_ns)

    def _check_time(self, time_ns: object) -> int:
        try:
            integer_ns = operator.index(time_ns)  # type: ignore[arg-type]
        except TypeError:
            integer_ns = -1
        # operator.index also accepts booleans
        if isinstance(time_ns, bool) or not 0 <= integer_ns <= LATEST_NS:
            raise UsageError(
                f"the time of a message on {self.topic} is {shortened(time_ns)}; give integer nanoseconds"
                " from 0 to 2**63 - 1"
            )
        return integer_ns
