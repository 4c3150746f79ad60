"""Messages of several channels in the one order that a log has."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.block import Channel, Messages


def merge(streams: Sequence[Messages]) -> Messages:
    """All messages, in the order of time, topic and sequence.

    Numbers of channels mean nothing outside their log, so channels are ordered by what they are: the same
    messages come out in the same order from whichever log they were read.
    """
    joined = join(streams)
    return select(joined, np.lexsort((joined.sequence, joined.channel, joined.log_time_ns)))


def join(streams: Sequence[Messages]) -> Messages:
    """All messages, one stream after the other."""
    channels = sorted(
        {
            (_rank(channel), id(channel)): channel
            for stream in streams
            for channel in stream.channels.values()
        }.items()
    )
    number: dict[int, int] = {}
    merged: dict[int, Channel] = {}
    for (rank, identity), channel in channels:
        if not merged or _rank(merged[len(merged) - 1]) != rank:
            merged[len(merged)] = channel
        number[identity] = len(merged) - 1
    return Messages(
        channels=merged,
        channel=_joined([_renumbered(stream, number) for stream in streams]),
        sequence=_joined([stream.sequence for stream in streams]),
        log_time_ns=_joined([stream.log_time_ns for stream in streams]),
        publish_time_ns=_joined([stream.publish_time_ns for stream in streams]),
        payloads=[payload for stream in streams for payload in stream.payloads],
    )


def select(messages: Messages, chosen: Integers) -> Messages:
    """The messages with the given indices, in that order."""
    return Messages(
        channels=messages.channels,
        channel=messages.channel[chosen],
        sequence=messages.sequence[chosen],
        log_time_ns=messages.log_time_ns[chosen],
        publish_time_ns=messages.publish_time_ns[chosen],
        payloads=[messages.payloads[index] for index in chosen.tolist()],
    )


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


def _joined(arrays: Sequence[Integers]) -> Integers:
    return np.concatenate([np.zeros(0, np.int64), *arrays])
