"""Messages of other logs as a copy of the log keeps them: raw, with their definitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from types import MappingProxyType

import numpy as np

from spatial_replay.errors import LogError
from spatial_replay.logs.block import Channel, Messages
from spatial_replay.logs.foreign.messages import Message, Topic
from spatial_replay.logs.foreign.ros_types import standard_schema
from spatial_replay.logs.topics import DERIVED, OBJECTS
from spatial_replay.trace.trace import Trace

_LOG_TIME = attrgetter("log_time_ns")


class CopiedMessages:
    """Collects raw messages until the samples made of them are there, and gives them in the order of time."""

    def __init__(self, topics: Sequence[Topic], most_bytes: int) -> None:
        self._channels: dict[str, Channel] = {
            topic.name: _channel(topic)
            for topic in topics
            # what we write under these names is made anew from the samples
            if topic.name != OBJECTS and topic.name not in DERIVED
        }
        self._most_bytes = most_bytes
        self._waiting: list[Message] = []
        self._waiting_bytes = 0

    def add(self, messages: Sequence[Message]) -> None:
        """Take messages that a copy of the log contains."""
        kept = [message for message in messages if message.topic in self._channels]
        self._waiting += kept
        self._waiting_bytes += sum(len(message.payload) for message in kept)

    def take(self, trace: Trace, *, last: bool = False) -> Messages:
        """The messages up to the last of some new samples; with `last`, all that wait.

        Messages whose clock has nothing to do with that of the samples do not wait for ever.
        """
        self._waiting.sort(key=_LOG_TIME)
        if last or self._waiting_bytes > self._most_bytes:
            ready = len(self._waiting)
        elif len(trace):
            latest = int(trace.times_ns[-1])
            ready = sum(message.log_time_ns <= latest for message in self._waiting)
        else:
            ready = 0
        taken, self._waiting = self._waiting[:ready], self._waiting[ready:]
        self._waiting_bytes -= sum(len(message.payload) for message in taken)
        return _columns(taken, self._channels)


def _columns(messages: Sequence[Message], channels: Mapping[str, Channel]) -> Messages:
    if not messages:
        return Messages()
    number = {topic: index for index, topic in enumerate(sorted(channels))}
    topics, log_time_ns, publish_time_ns, sequence, payloads = zip(*messages, strict=True)
    return Messages(
        channels=MappingProxyType({index: channels[topic] for topic, index in number.items()}),
        channel=np.array([number[topic] for topic in topics], np.int64),
        sequence=np.array(sequence, np.int64),
        log_time_ns=np.array(log_time_ns, np.int64),
        publish_time_ns=np.array(publish_time_ns, np.int64),
        payloads=payloads,
    )


def _channel(topic: Topic) -> Channel:
    schema = topic.schema
    if topic.encoding in ("ros1", "cdr") and (schema is None or not schema.data.strip()):
        try:
            schema = standard_schema(topic.type, topic.encoding)  # type: ignore[arg-type]
        except LogError:
            schema = topic.schema
    return Channel(topic.name, topic.encoding, schema, topic.metadata)
