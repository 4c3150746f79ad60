"""Messages of a log as columns, blocks of samples with their messages, and sinks that take messages.

Messages of several channels are merged in an order that depends on what the channels are, not on their
numbers, so that equal logs give equal files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from types import MappingProxyType
from typing import Any, Final, Protocol

import numpy as np

from spatial_replay.geometry.arrays import Integers, concatenated, select
from spatial_replay.text import Sentence
from spatial_replay.trace.trace import Pauses, Trace

BLOCK_SAMPLES = 12_288
"""A block holds at most this many samples, so that memory stays bounded whatever the log's length."""


@dataclass(frozen=True, slots=True)
class Schema:
    """How a channel's messages are described: an MCAP schema without its number."""

    name: str
    encoding: str
    data: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic with the form of its messages: an MCAP channel without its number.

    Attributes:
        topic: where messages go, such as /spatial/objects.
        encoding: of the messages: protobuf, json, cdr, ros1.
        schema: None where the log has none.
        metadata: as in the log.
    """

    topic: str
    encoding: str
    schema: Schema | None
    metadata: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}), hash=False)


def _none() -> Integers:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """M messages in the order (time, channel, sequence), byte for byte as in the log.

    Attributes:
        channels: by the number that `channel` uses.
        channel: (M,) int64.
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

    def __len__(self) -> int:
        return len(self.payloads)

    @property
    def nbytes(self) -> int:
        """The size of the payloads in bytes."""
        return sum(map(len, self.payloads))


def messages_of(channel: Channel, times_ns: Integers, payloads: Sequence[bytes], first: int) -> Messages:
    """Return messages of one channel, published when they are logged, numbered from `first`."""
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
    """Some samples of a log with their messages.

    Attributes:
        trace: the samples; `trace.faults` lists what was lost since the previous block.
        messages: those that a copy of the log must contain beside what is derived from the samples; empty for
            sources that are not a log of messages. A copy gets a topic for the samples where they have none.
        remarks: what is worth knowing although nothing was lost: how many observations are out of date, which
            transforms are missing.
    """

    trace: Trace
    messages: Messages = field(default_factory=Messages)
    remarks: tuple[str, ...] = ()


def merge(streams: Sequence[Messages]) -> Messages:
    """Merge messages in the order of time, topic and sequence.

    Channel numbers mean nothing outside their log, so channels are ordered by their content. Equal messages
    come out in the same order from any log.
    """
    joined = join(streams)
    return select(joined, np.lexsort((joined.sequence, joined.channel, joined.log_time_ns)))


def join(streams: Sequence[Messages]) -> Messages:
    """Join messages, one stream after the other."""
    known = {id(channel): channel for stream in streams for channel in stream.channels.values()}
    by_rank = {_rank(channel): channel for channel in known.values()}
    number = {rank: place for place, rank in enumerate(sorted(by_rank))}
    own = {identity: number[_rank(channel)] for identity, channel in known.items()}
    renumbered = [replace(stream, channel=_renumbered(stream, own)) for stream in streams]
    channels = {place: by_rank[rank] for rank, place in number.items()}
    return replace(concatenated([Messages(), *renumbered]), channels=channels)


def _rank(channel: Channel) -> tuple[str, str, str, str, bytes, tuple[tuple[str, str], ...]]:
    schema = channel.schema
    name, encoding, data = ("", "", b"") if schema is None else (schema.name, schema.encoding, schema.data)
    return channel.topic, channel.encoding, name, encoding, data, tuple(sorted(channel.metadata.items()))


def _renumbered(stream: Messages, number: dict[int, int]) -> Integers:
    if not len(stream):
        return np.zeros(0, np.int64)
    new = np.zeros(max(stream.channels) + 1, np.int64)
    for old, channel in stream.channels.items():
        new[old] = number[id(channel)]
    return new[stream.channel]


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file in a log; its times are 0 where they are not known."""

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


SAMPLES_A_GAP: Final = 10
"""Samples that fill a gap of the length that is allowed."""
_MOST_IN_GAP = 10_000
"""Samples that fill one gap."""

IterBlocks = Callable[..., Iterator[Block]]


def noting_pauses(iter_blocks: IterBlocks) -> IterBlocks:
    """Let `iter_blocks` of a source remark pauses at the end, and fill those longer than its `max_gap_ns`."""

    @wraps(iter_blocks)
    def wrapped(self: Any, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        pauses, before = Pauses(), Trace.empty()
        for block in iter_blocks(self, start_ns, end_ns):
            trace = block.trace
            pauses.add(trace.times_ns)
            if self.max_gap_ns is not None and len(trace):
                block = replace(block, trace=_without_gaps(before, trace, self.max_gap_ns))
                before = trace.slice(len(trace) - 1, len(trace))
            yield block
        remark = pauses.remark("samples", self.max_gap_ns)
        if remark is not None:
            yield Block(Trace.empty(), remarks=(Sentence(f"{self.name}: ", remark),))

    return wrapped


def _without_gaps(before: Trace, trace: Trace, max_gap_ns: int) -> Trace:
    """Fill gaps between samples with samples in which every object and signal is unknown.

    Args:
        before: the sample before those of `trace`, or none.
    """
    times = np.concatenate([before.times_ns, trace.times_ns])
    gaps = np.flatnonzero(np.diff(times) > max_gap_ns).tolist()
    parts, done = [], 0
    for gap in gaps:
        begin = gap + 1 - len(before)
        last = trace.slice(begin - 1, begin) if begin else before
        first_ns, next_ns = times[gap : gap + 2].tolist()
        step_ns = max(max_gap_ns // SAMPLES_A_GAP, (next_ns - first_ns) // _MOST_IN_GAP, 1)
        # right after the last sample, and right before the next one
        steps = np.union1d(np.arange(first_ns + step_ns, next_ns, step_ns), [first_ns + 1, next_ns - 1])
        rows = np.repeat(np.where(last.rows >= 0, -2 - last.rows, last.rows), len(steps), axis=0)
        signals = {name: np.full(len(steps), np.nan) for name in last.signals}
        unknown = replace(last, times_ns=steps, rows=rows, signals=signals, faults=(), remarks=())
        parts += [trace.slice(done, begin), unknown]
        done = begin
    return Trace.concatenate([*parts, trace.slice(done, len(trace))]) if gaps else trace
