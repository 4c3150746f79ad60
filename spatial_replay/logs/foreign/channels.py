"""Messages of other logs as a copy of the log keeps them: raw, with their definitions."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from types import MappingProxyType

import numpy as np

from spatial_replay.errors import LogError
from spatial_replay.logs.block import Channel, Messages
from spatial_replay.logs.foreign.messages import Message, Topic
from spatial_replay.logs.foreign.ros_types import standard_schema
from spatial_replay.logs.topics import DERIVED, OBJECTS
from spatial_replay.trace.trace import Trace

_PAYLOAD = itemgetter(4)


class CopiedMessages:
    """Collects raw messages until the samples made of them are there, and gives them in the order of time."""

    def __init__(self, topics: Sequence[Topic], most_bytes: int) -> None:
        self._channels: dict[str, Channel] = {
            topic.name: _channel(topic)
            for topic in topics
            # what we write under these names is made anew from the samples
            if topic.name != OBJECTS and topic.name not in DERIVED
        }
        self._numbers = {topic: number for number, topic in enumerate(sorted(self._channels))}
        self._by_number = MappingProxyType({number: self._channels[t] for t, number in self._numbers.items()})
        self._has_all = len(self._channels) == len(topics)
        self._most_bytes = most_bytes
        self._waiting: list[Message] = []
        self._waiting_bytes = 0

    def add(self, messages: Sequence[Message]) -> None:
        """Take messages that a copy of the log contains."""
        if not self._has_all:
            messages = [message for message in messages if message.topic in self._channels]
        self._waiting += messages
        self._waiting_bytes += sum(map(len, map(_PAYLOAD, messages)))

    def take(self, trace: Trace, *, last: bool = False) -> Messages:
        """The messages up to the last of some new samples; with `last`, all that wait.

        Messages whose clock has nothing to do with that of the samples do not wait for ever.
        """
        is_all = last or self._waiting_bytes > self._most_bytes
        if not self._waiting or not (is_all or len(trace)):
            return Messages()
        topics, log_times, publish_times, sequences, payloads = zip(*self._waiting, strict=True)
        log_time_ns = np.array(log_times, np.int64)
        ready = np.arange(len(log_time_ns))
        if not (log_time_ns[1:] >= log_time_ns[:-1]).all():
            ready = np.argsort(log_time_ns, kind="stable")
            self._waiting = [self._waiting[place] for place in ready.tolist()]
        if not is_all:
            count = int(np.searchsorted(log_time_ns[ready], trace.times_ns[-1], side="right"))
            ready = ready[:count]
        taken = [payloads[place] for place in ready.tolist()]
        self._waiting = self._waiting[len(taken) :]
        self._waiting_bytes -= sum(map(len, taken))
        numbers = np.fromiter(map(self._numbers.__getitem__, topics), np.int64, len(topics))
        return Messages(
            channels=self._by_number,
            channel=numbers[ready],
            sequence=np.array(sequences, np.int64)[ready],
            log_time_ns=log_time_ns[ready],
            publish_time_ns=np.array(publish_times, np.int64)[ready],
            payloads=taken,
        )


def _channel(topic: Topic) -> Channel:
    schema = topic.schema
    if topic.encoding in ("ros1", "cdr") and (schema is None or not schema.data.strip()):
        try:
            schema = standard_schema(topic.type, topic.encoding)  # type: ignore[arg-type]
        except LogError:
            schema = topic.schema
    return Channel(topic.name, topic.encoding, schema, topic.metadata)
