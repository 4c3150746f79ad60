"""The messages of an MCAP log chunk by chunk, with the channels that are declared on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import BinaryIO

import numpy as np
from mcap import records

from spatial_replay.geometry.arrays import Booleans
from spatial_replay.logs.mcap.chunk_records import (
    DamageError,
    Declaration,
    RawMessages,
    Records,
    split_records,
)
from spatial_replay.logs.mcap.chunks import ChunkPlace, iter_records, read_records
from spatial_replay.logs.mcap.index import Directory
from spatial_replay.logs.messages import Channel, Schema
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.topics import OBJECTS
from spatial_replay.text import Instant, Sentence
from spatial_replay.trace.sample import LATEST_NS

_CHANNELS = 2**16
"""As many as a file can have."""


class ChunkWalk:
    """The messages of a log by chunk, with the channels that have been declared so far."""

    def __init__(self, stream: BinaryIO, directory: Directory, faults: FaultList, name: str) -> None:
        self.stream = stream
        self.faults = faults
        self.name = name
        self.directory = directory
        self._schemas = dict(directory.schemas)
        self.channels: dict[int, Channel] = {}
        self._is_declared = np.zeros(_CHANNELS, np.bool_)
        self.places = sorted(directory.chunks, key=lambda place: (place.start_ns, place.offset))
        for channel in directory.channels.values():
            self._declare(channel)
        if directory.statistics is None:
            self._find_channels()

    @property
    def sees_objects(self) -> bool:
        """Whether a channel with samples has been declared."""
        return any(channel.topic == OBJECTS for channel in self.channels.values())

    def iter_messages(
        self,
        places: Sequence[ChunkPlace],
        is_wanted: Callable[[str], bool] = lambda topic: True,
        prepare: Callable[[RawMessages], RawMessages] = lambda messages: messages,
    ) -> Iterator[tuple[Sequence[ChunkPlace], RawMessages]]:
        """Yield the messages in all places, some places at once; what is lost of them goes to the faults.

        Args:
            is_wanted: which topics matter; messages of others may be left out.
            prepare: what is done with messages on the threads that read them; see `iter_records`.
        """
        passed_over = [n for n, each in self.channels.items() if not is_wanted(each.topic)]
        for several, found in iter_records(self.stream, places, passed_over, prepare):
            yield several, self._messages(several, found)

    def numbers(self, is_chosen: Callable[[str], bool]) -> Booleans:
        """Return by number, (65536,), whether the topic of a channel is chosen."""
        chosen = np.zeros(_CHANNELS, np.bool_)
        chosen[[number for number, each in self.channels.items() if is_chosen(each.topic)]] = True
        return chosen

    def _messages(self, places: Sequence[ChunkPlace], found: Records | DamageError) -> RawMessages:
        if isinstance(found, DamageError):
            self._fault(places, f"{found}; the ", " are lost")
            return RawMessages.join([])
        messages = found.messages
        if found.damage:
            self._fault(places, f"{found.damage}; of the ", f", {len(messages)} could be read")
        self._take_in(found.declarations)
        if messages.channel >= 0 and self._is_declared[messages.channel]:
            return messages
        is_usable = self._is_declared[messages.heads["channel"]] & (messages.heads["log_time"] <= LATEST_NS)
        if is_usable.all():
            return messages
        lost = len(messages) - np.count_nonzero(is_usable)
        self._fault(places, f"{lost} of the ", " have no channel, or a time beyond 2**63 - 1 ns")
        return messages.take(np.flatnonzero(is_usable))

    def _find_channels(self) -> None:
        """Declare all channels of a log without a summary: chunks need not come in the order of time."""
        for place in sorted(self.places, key=lambda each: each.offset):
            # the chunk is read again for its messages, and its damage reported then
            with suppress(DamageError):
                self._take_in(split_records(read_records(self.stream, place)).declarations)

    def _take_in(self, declarations: Iterable[Declaration]) -> None:
        for record in declarations:
            if isinstance(record, records.Schema):
                self._schemas.setdefault(record.id, record)
            else:
                self._declare(record)

    def _declare(self, channel: records.Channel) -> None:
        if channel.id in self.channels:
            return
        schema = self._schemas.get(channel.schema_id)
        self._is_declared[channel.id] = True
        self.channels[channel.id] = Channel(
            channel.topic,
            channel.message_encoding,
            Schema(schema.name, schema.encoding, schema.data) if schema else None,
            MappingProxyType(channel.metadata),
        )

    def _fault(self, places: Sequence[ChunkPlace], before: str, after: str) -> None:
        """Report what happened to messages in some places, in words before and after their times."""
        first, last = min(place.start_ns for place in places), max(place.end_ns for place in places)
        span = "messages between ", Instant(first, 0), " and ", Instant(last, 0)
        where = f"{self.name}: at byte {places[0].offset}: "
        self.faults.add(Sentence(where, Sentence(before, *span, after)))
