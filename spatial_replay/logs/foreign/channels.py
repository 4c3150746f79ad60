"""Messages of other logs as a copy of the log keeps them: raw, with their definitions."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from spatial_replay.errors import LogError
from spatial_replay.logs.block import Channel, Messages
from spatial_replay.logs.foreign.columns import MessageColumns, joined
from spatial_replay.logs.foreign.messages import Topic
from spatial_replay.logs.foreign.ros_types import standard_schema
from spatial_replay.logs.topics import DERIVED, OBJECTS
from spatial_replay.trace.trace import Trace


class CopiedMessages:
    """Collects raw messages until the samples made of them are there, and gives them in the order of time."""

    def __init__(self, topics: Sequence[Topic], most_bytes: int) -> None:
        channels = {
            topic.name: _channel(topic)
            for topic in topics
            # what we write under these names is made anew from the samples
            if topic.name != OBJECTS and topic.name not in DERIVED
        }
        self._numbers = {topic: number for number, topic in enumerate(sorted(channels))}
        self._channels = MappingProxyType({number: channels[name] for name, number in self._numbers.items()})
        self._has_all = len(channels) == len(topics)
        self._most_bytes = most_bytes
        self._waiting: list[MessageColumns] = []
        self._waiting_bytes = 0

    def add(self, messages: MessageColumns) -> None:
        """Take messages that a copy of the log contains."""
        if not self._has_all:
            kept = [place for place, topic in enumerate(messages.topics) if topic in self._numbers]
            messages = messages.take(np.array(kept, np.int64))
        self._waiting.append(messages)
        self._waiting_bytes += sum(map(len, messages.payloads))

    def take(self, trace: Trace, *, last: bool = False) -> Messages:
        """The messages up to the last of some new samples; with `last`, all that wait.

        Messages whose clock has nothing to do with that of the samples do not wait for ever.
        """
        is_all = last or self._waiting_bytes > self._most_bytes
        if not self._waiting or not (is_all or len(trace)):
            return Messages()
        waiting = joined(self._waiting)
        times = waiting.log_time_ns
        if not (times[1:] >= times[:-1]).all():
            waiting = waiting.take(np.argsort(times, kind="stable"))
        ready = len(waiting) if is_all else waiting.count_before(int(trace.times_ns[-1]) + 1)
        taken, rest = waiting.slice(0, ready), waiting.slice(ready, len(waiting))
        self._waiting = [rest] if len(rest) else []
        self._waiting_bytes = sum(map(len, rest.payloads))
        return Messages(
            channels=self._channels,
            channel=np.fromiter(map(self._numbers.__getitem__, taken.topics), np.int64, len(taken)),
            sequence=taken.sequence,
            log_time_ns=taken.log_time_ns,
            publish_time_ns=taken.publish_time_ns,
            payloads=taken.payloads,
        )


def _channel(topic: Topic) -> Channel:
    schema = topic.schema
    if topic.encoding in ("ros1", "cdr") and (schema is None or not schema.data.strip()):
        try:
            schema = standard_schema(topic.type, topic.encoding)  # type: ignore[arg-type]
        except LogError:
            schema = topic.schema
    return Channel(topic.name, topic.encoding, schema, topic.metadata)
