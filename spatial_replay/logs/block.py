"""What a source yields: a stretch of a log, as samples and as the messages it was made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.trace.trace import Trace

BLOCK_SAMPLES = 8_192
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


def messages_of(channel: Channel, times_ns: Integers, payloads: Sequence[bytes], first: int) -> Messages:
    """Messages of one channel, published when they are logged, numbered from `first`."""
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
    """A stretch of a log.

    Attributes:
        trace: its samples; `trace.faults` tells what was lost since the block before.
        messages: what a copy of the log has to contain beside what is derived from the samples; empty for
            sources that are no log of messages. A copy gets a topic for the samples where they have none.
        remarks: what whoever evaluates it should know, without anything being lost: how many observations are
            out of date, which transforms are missing.
    """

    trace: Trace
    messages: Messages = field(default_factory=Messages)
    remarks: tuple[str, ...] = ()
