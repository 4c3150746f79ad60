"""External MCAP logs, whole or damaged.

The reader is our own for two reasons. The MCAP library fails 112 of the 416 files of the format's conformance
suite. It gives up on truncated and unindexed files, which crashed recorders leave behind. It also yields
columns of a chunk at a time rather than one object for each message.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from copy import copy
from functools import cached_property

import numpy as np

from spatial_replay.bags.decoders import Topic, topic_of, topics_by_name
from spatial_replay.bags.reader import Columns, MessageColumns, MessageReader, in_order, places_in
from spatial_replay.geometry.arrays import select
from spatial_replay.logs.mcap.index import (
    ChunkPlace,
    Directory,
    iter_attachments,
    iter_metadata,
    read_directory,
)
from spatial_replay.logs.mcap.read import ChunkWalk, directory_remarks, most_waiting
from spatial_replay.logs.messages import Attachment, Channel, Messages
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.remote import LogFile, open_file


class McapLog(MessageReader):
    """An MCAP log of any encoding, read chunk by chunk."""

    kind = "MCAP"

    def __init__(self, path: LogFile) -> None:
        super().__init__(path)
        self._file = path
        self._walked, self._walked_all = 0, False
        self._is_remarked = False

    @cached_property
    def _walk(self) -> ChunkWalk:
        with open_file(self._file) as stream:
            directory = read_directory(stream, self._faults, self.name)
            return ChunkWalk(stream, directory, self._faults, self.name)

    @property
    def _directory(self) -> Directory:
        return self._walk.directory

    @cached_property
    def _topics(self) -> tuple[Topic, ...]:
        statistics = self._directory.statistics
        counts = statistics.channel_message_counts if statistics else None
        if statistics and not counts and statistics.message_count:
            # the format leaves counts of channels out at will
            counts = None
        if statistics and counts and sum(counts.values()) != statistics.message_count:
            self._faults.add(
                f"{self.name}: its statistics contradict themselves: {statistics.message_count} messages,"
                f" and {sum(counts.values())} on its channels"
            )
        return topics_by_name(
            topic_of(channel, None if counts is None else counts.get(number, 0))
            for number, channel in sorted(self._walk.channels.items())
        )

    @property
    def profile(self) -> str:
        header = self._directory.header
        return header.profile if header else ""

    def take_remarks(self) -> tuple[str, ...]:
        is_first, self._is_remarked = not self._is_remarked, True
        return directory_remarks(self.name, self._directory, self.metadata()) if is_first else ()

    @cached_property
    def _topic_of(self) -> Mapping[int, str]:
        return {number: channel.topic for number, channel in self._walk.channels.items()}

    def _channel(self, number: int) -> Channel:
        return self._walk.channels[number]

    @property
    def channel_topics(self) -> frozenset[str]:
        """The topics of its channels, without a look at their definitions."""
        return frozenset(self._topic_of.values())

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message."""
        return min((place.start_ns for place in self._directory.chunks), default=None)

    def _read(self, topics: Collection[str], first: int, last: int, *, as_recorded: bool) -> Columns:
        directory, wanted = self._directory, self._wanted(topics)
        places = [
            (rank, place)
            for rank, place in enumerate(directory.chunks)
            if place.start_ns < last
            and place.end_ns >= first
            and (place.channels is None or not place.channels.isdisjoint(wanted))
        ]
        if not as_recorded:
            places.sort(key=lambda ranked: ranked[1].start_ns)
        self._walked, self._walked_all = 0, len(places) == len(directory.chunks)
        with open_file(self._file) as stream:
            walk = copy(self._walk)
            walk.stream = stream
            statistics = directory.statistics
            # where the log counts no channels, all messages are compared with its total
            is_total = statistics is not None and not statistics.channel_message_counts
            found = walk.iter_messages(
                [place for _, place in places], lambda topic: is_total or topic in topics
            )
            contents = (
                self._columns(rank, place, messages, wanted, first, last)
                for (rank, _), (place, messages) in zip(places, found, strict=True)
            )
            if as_recorded:
                yield from contents
                return
            most = most_waiting(place.length for _, place in places)
            yield from in_order([place.start_ns for _, place in places], contents, self.name, most)

    def _counted(self, columns: Columns, topics: Collection[str], name: str | None = None) -> Columns:
        yield from super()._counted(columns, topics, name)
        statistics = self._directory.statistics
        # without counts of channels, the total is all there is to compare
        if statistics and not statistics.channel_message_counts and self._walked_all:
            total = statistics.message_count
            if total != self._walked:
                self._faults.add(
                    f"{self.name}: it declares {total} messages in all; {self._walked} could be read"
                )

    def attachments(self) -> tuple[Attachment, ...]:
        with open_file(self._file) as stream:
            return tuple(iter_attachments(stream, self._directory, FaultList(), self.name))

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        with open_file(self._file) as stream:
            return tuple(iter_metadata(stream, self._directory, FaultList(), self.name))

    def _columns(
        self, rank: int, place: ChunkPlace, messages: Messages, wanted: dict[int, str], first: int, last: int
    ) -> MessageColumns:
        """Return the wanted messages in a place; those of channels that the index lacks go to the faults."""
        self._walked += len(messages)
        unknown = np.setdiff1d(messages.channel, self._numbers)
        if len(unknown):
            what = f"at byte {place.offset}: some messages are of a channel {unknown[0]} that is not declared"
            self._faults.add(f"{self.name}: {what} in the index")
        times = messages.log_time_ns
        is_chosen = np.isin(messages.channel, list(wanted)) & (times >= first) & (times < last)
        rows = np.flatnonzero(is_chosen)
        chosen = select(messages, rows)
        return MessageColumns(
            [wanted[number] for number in chosen.channel.tolist()],
            chosen.log_time_ns,
            chosen.publish_time_ns,
            chosen.sequence,
            chosen.payloads,
            places_in(rank, rows),
            np.searchsorted(self._numbers, chosen.channel),
        )
