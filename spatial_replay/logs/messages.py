"""Messages of a log as columns, blocks of samples with their messages, and sinks.

Messages of several channels are merged in an order that depends on the content of the channels, not on their
numbers. So equal logs give equal files.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import NamedTuple, Protocol, Self

import numpy as np

from spatial_replay.geometry.arrays import Integers, concatenate_tables, equal_places, select
from spatial_replay.trace.doubts import Doubt
from spatial_replay.trace.facts import TopicFacts
from spatial_replay.trace.trace import LATEST_NS, Trace


@dataclass(frozen=True, slots=True)
class Schema:
    """Description of the messages of a channel: an MCAP schema without its number."""

    name: str
    encoding: str
    data: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic with the encoding of its messages: an MCAP channel without its number.

    Attributes:
        topic: name, such as /spatial/objects.
        encoding: encoding of the messages: protobuf, json, cdr or ros1.
        schema: description of the messages; None if the log has none.
        metadata: key-value pairs, as in the log.
    """

    topic: str
    encoding: str
    schema: Schema | None
    metadata: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}), hash=False)


def _none() -> Integers:
    return np.zeros(0, np.int64)


class Row(NamedTuple):
    """One message of `Messages`."""

    channel: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """M messages in the order (time, channel, sequence), byte for byte as in the log.

    Attributes:
        channels: channels by number.
        channel: (M,) int64, number of each message's channel.
        sequence: (M,) int64.
        log_time_ns, publish_time_ns: (M,) int64.
        payloads: M encoded messages.
    """

    channels: Mapping[int, Channel] = field(default_factory=lambda: MappingProxyType({}))
    channel: Integers = field(default_factory=_none)
    sequence: Integers = field(default_factory=_none)
    log_time_ns: Integers = field(default_factory=_none)
    publish_time_ns: Integers = field(default_factory=_none)
    payloads: Sequence[bytes] = ()

    @classmethod
    def from_rows(cls, channels: Mapping[int, Channel], rows: Sequence[Row]) -> Messages:
        """Build the columns from single messages."""
        *number_columns, payloads = zip(*rows, strict=True) if rows else [()] * len(Row._fields)
        channel, sequence, log_ns, publish_ns = (np.array(column, np.int64) for column in number_columns)
        return Messages(channels, channel, sequence, log_ns, publish_ns, payloads)

    def rows(self) -> Iterator[Row]:
        """Iterate over the messages one by one."""
        columns = (self.channel, self.sequence, self.log_time_ns, self.publish_time_ns)
        return map(Row._make, zip(*(column.tolist() for column in columns), self.payloads, strict=True))

    def __len__(self) -> int:
        return len(self.payloads)

    @property
    def nbytes(self) -> int:
        """The size of the payloads in bytes."""
        return sum(map(len, self.payloads))

    @property
    def topics(self) -> list[str]:
        """The topic of each message."""
        topic_by_number = {number: channel.topic for number, channel in self.channels.items()}
        return [topic_by_number[number] for number in self.channel.tolist()]

    @property
    def topic_ranks(self) -> Integers:
        """(M,) int64, rank of each message's topic among the sorted topics."""
        topics = {channel.topic for channel in self.channels.values()}
        rank_by_topic = {topic: rank for rank, topic in enumerate(sorted(topics))}
        rank_by_channel = np.zeros(max(self.channels, default=-1) + 1, np.int64)
        for number, channel in self.channels.items():
            rank_by_channel[number] = rank_by_topic[channel.topic]
        return rank_by_channel[self.channel]

    def by_channel(self) -> Iterator[tuple[Channel, Integers]]:
        """Iterate over the channels that have messages, with the indices of their messages."""
        for message_indices in equal_places(self.channel):
            yield self.channels[int(self.channel[message_indices[0]])], message_indices

    def by_topic(self) -> Iterator[tuple[str, Integers]]:
        """Iterate over the sorted topics that have messages, with the indices of their messages."""
        for message_indices in equal_places(self.topic_ranks):
            yield self.channels[int(self.channel[message_indices[0]])].topic, message_indices

    def of_topics(self, topics: Collection[str]) -> Self:
        """Return the messages of the given topics, in the same order."""
        channel_numbers = [number for number, channel in self.channels.items() if channel.topic in topics]
        message_indices = np.flatnonzero(np.isin(self.channel, channel_numbers))
        return self if len(message_indices) == len(self) else select(self, message_indices)

    def within(self, start_ns: int, end_ns: int) -> Self:
        """Return the messages with log times in [start_ns, end_ns), in the same order."""
        times_ns = self.log_time_ns
        # `end_ns` may exceed int64
        is_inside = (times_ns >= start_ns) & (times_ns <= min(end_ns - 1, LATEST_NS))
        return self if is_inside.all() else select(self, np.flatnonzero(is_inside))


def messages_of(channel: Channel, times_ns: Integers, payloads: Sequence[bytes], first: int) -> Messages:
    """Return messages of one channel, with sequence numbers from `first`.

    The publish time of each message is its log time.
    """
    return Messages(
        channels={0: channel},
        channel=np.zeros(len(payloads), np.int64),
        sequence=np.arange(first, first + len(payloads), dtype=np.int64),
        log_time_ns=times_ns,
        publish_time_ns=times_ns,
        payloads=payloads,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive samples of a log with their messages.

    Attributes:
        trace: the samples; `trace.faults` lists the losses since the previous block.
        messages: messages that a copy of the log must contain, except topics derived from the samples; empty
            for sources without messages. If the messages do not contain the samples, a copy adds their topic.
        remarks: notes on the data that do not concern losses, such as the number of stale observations.
        doubts: assumptions that the log contradicts.
        facts: how each mapped topic was read; empty until the topics are read to their end.
    """

    trace: Trace
    messages: Messages = field(default_factory=Messages)
    remarks: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()
    facts: tuple[TopicFacts, ...] = ()


def merge(streams: Sequence[Messages]) -> Messages:
    """Merge messages by log time, channel and sequence.

    Channel numbers are local to a log. Channels are ordered by content, so the order of messages does not
    depend on channel numbers.
    """
    joined = join(streams)
    return select(joined, np.lexsort((joined.sequence, joined.channel, joined.log_time_ns)))


def join(streams: Sequence[Messages]) -> Messages:
    """Concatenate streams of messages; channels are renumbered by their content."""
    # channels are keyed by identity, so that a rank, which holds the whole schema, is not computed per stream
    channel_by_id = {id(channel): channel for stream in streams for channel in stream.channels.values()}
    channel_by_rank = {_rank(channel): channel for channel in channel_by_id.values()}
    number_by_rank = {rank: number for number, rank in enumerate(sorted(channel_by_rank))}
    number_by_id = {object_id: number_by_rank[_rank(channel)] for object_id, channel in channel_by_id.items()}
    renumbered_streams = [replace(stream, channel=_renumber(stream, number_by_id)) for stream in streams]
    channels = {number: channel_by_rank[rank] for rank, number in number_by_rank.items()}
    return replace(concatenate_tables([Messages(), *renumbered_streams]), channels=channels)


def _rank(channel: Channel) -> tuple[str, str, str, str, bytes, tuple[tuple[str, str], ...]]:
    schema = channel.schema
    name, encoding, data = ("", "", b"") if schema is None else (schema.name, schema.encoding, schema.data)
    return channel.topic, channel.encoding, name, encoding, data, tuple(sorted(channel.metadata.items()))


def _renumber(stream: Messages, number_by_id: dict[int, int]) -> Integers:
    if not len(stream):
        return np.zeros(0, np.int64)
    new_numbers = np.zeros(max(stream.channels) + 1, np.int64)
    for old_number, channel in stream.channels.items():
        new_numbers[old_number] = number_by_id[id(channel)]
    return new_numbers[stream.channel]


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file in a log. Unknown times are 0."""

    name: str
    media_type: str
    data: bytes = field(repr=False)
    log_time_ns: int = 0
    create_time_ns: int = 0


class Sink(Protocol):
    """A log being written."""

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record."""

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file to the log."""

    def write_messages(self, messages: Messages) -> None:
        """Add messages, in the order given."""


class MemorySink:
    """A log in memory, for tests and for callers that need messages rather than a file."""

    def __init__(self) -> None:
        self.metadata: list[tuple[str, Mapping[str, str]]] = []
        self.attachments: list[Attachment] = []
        self.messages: list[Messages] = []

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """See `Sink`."""
        self.metadata.append((name, dict(data)))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """See `Sink`."""
        self.attachments.append(Attachment(name, media_type, data))

    def write_messages(self, messages: Messages) -> None:
        """See `Sink`."""
        self.messages.append(messages)
