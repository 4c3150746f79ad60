"""External MCAP logs, whole or damaged.

The reader is our own for two reasons. The MCAP library fails 112 of the 416 files of the format's conformance
suite. It gives up on truncated and unindexed files, which crashed recorders leave behind. It also yields
columns of a chunk at a time rather than one object for each message.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cached_property

import numpy as np

from spatial_replay.bags.decoders import Topic, topic_of, topics_by_name
from spatial_replay.bags.reader import Columns, MessageColumns, MessageReader, in_order, places_in
from spatial_replay.logs.mcap.index import (
    ChunkPlace,
    DamageError,
    Directory,
    iter_attachments,
    iter_metadata,
    read_directory,
)
from spatial_replay.logs.mcap.read import (
    ChunkWalk,
    directory_remarks,
    iter_records,
    most_waiting,
    split_records,
)
from spatial_replay.logs.messages import Attachment, Channel
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.remote import LogFile, open_file
from spatial_replay.text import Instant, Sentence
from spatial_replay.trace.sample import LATEST_NS


class McapLog(MessageReader):
    """An MCAP log of any encoding, read chunk by chunk."""

    kind = "MCAP"

    def __init__(self, path: LogFile) -> None:
        super().__init__(path)
        self._file = path
        self._walked, self._walked_all = 0, False
        self._is_remarked = False

    @cached_property
    def _contents(self) -> tuple[Directory, dict[int, Channel]]:
        with open_file(self._file) as stream:
            directory = read_directory(stream, self._faults, self.name)
            return directory, ChunkWalk(stream, directory, FaultList(), self.name).channels

    @cached_property
    def _topics(self) -> tuple[Topic, ...]:
        directory, channels = self._contents
        statistics = directory.statistics
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
            for number, channel in sorted(channels.items())
        )

    @property
    def profile(self) -> str:
        header = self._contents[0].header
        return header.profile if header else ""

    def take_remarks(self) -> tuple[str, ...]:
        is_first, self._is_remarked = not self._is_remarked, True
        return directory_remarks(self.name, self._contents[0], self.metadata()) if is_first else ()

    @cached_property
    def _topic_of(self) -> Mapping[int, str]:
        return {number: channel.topic for number, channel in self._contents[1].items()}

    def _channel(self, number: int) -> Channel:
        return self._contents[1][number]

    @property
    def channel_topics(self) -> frozenset[str]:
        """The topics of its channels, without a look at their definitions."""
        return frozenset(self._topic_of.values())

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message."""
        return min((place.start_ns for place in self._contents[0].chunks), default=None)

    def _read(self, topics: Collection[str], first: int, last: int, *, as_recorded: bool) -> Columns:
        directory, wanted = self._contents[0], self._wanted(topics)
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
            found = iter_records(stream, [place for _, place in places])
            contents = (
                self._messages(rank, place, content, wanted, first, last)
                for (rank, _), (place, content) in zip(places, found, strict=True)
            )
            if as_recorded:
                yield from contents
                return
            most = most_waiting(place.length for _, place in places)
            yield from in_order([place.start_ns for _, place in places], contents, self.name, most)

    def _counted(self, columns: Columns, topics: Collection[str], name: str | None = None) -> Columns:
        yield from super()._counted(columns, topics, name)
        statistics = self._contents[0].statistics
        # without counts of channels, the total is all there is to compare
        if statistics and not statistics.channel_message_counts and self._walked_all:
            total = statistics.message_count
            if total != self._walked:
                self._faults.add(
                    f"{self.name}: it declares {total} messages in all; {self._walked} could be read"
                )

    def attachments(self) -> tuple[Attachment, ...]:
        with open_file(self._file) as stream:
            return tuple(iter_attachments(stream, self._contents[0], FaultList(), self.name))

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        with open_file(self._file) as stream:
            return tuple(iter_metadata(stream, self._contents[0], FaultList(), self.name))

    def _messages(
        self,
        rank: int,
        place: ChunkPlace,
        content: bytes | DamageError,
        wanted: dict[int, str],
        first: int,
        last: int,
    ) -> MessageColumns:
        """Read the messages in a place; what is lost of them goes to the faults."""
        span = Sentence("messages between ", Instant(place.start_ns, 0), " and ", Instant(place.end_ns, 0))
        if isinstance(content, DamageError):
            self._fault(place, Sentence(f"{content}; the ", span, " are lost"))
            return MessageColumns()
        split = split_records(content)
        channel, times = split.heads["channel"], split.heads["log_time"]
        if split.breaks_off:
            self._fault(
                place, Sentence("a record breaks off; of the ", span, f", {len(channel)} could be read")
            )
        self._walked += len(channel)
        beyond = times > LATEST_NS
        if beyond.any():
            self._fault(place, Sentence(f"{beyond.sum()} of the ", span, " have a time beyond 2**63 - 1 ns"))
        if len(unknown := set(np.unique(channel).tolist()) - self._contents[1].keys()):
            self._fault(
                place,
                Sentence("some of the ", span, f" are of a channel {min(unknown)} that is not declared"),
            )
        is_chosen = np.isin(channel, list(wanted)) & (times >= first) & (times < last)
        rows = np.flatnonzero(is_chosen)
        heads = split.heads[rows]
        return MessageColumns(
            [wanted[number] for number in heads["channel"].tolist()],
            heads["log_time"].astype(np.int64),
            heads["publish_time"].astype(np.int64),
            heads["sequence"].astype(np.int64),
            [content[split.payloads[row]] for row in rows.tolist()],
            places_in(rank, rows),
            np.searchsorted(self._numbers, heads["channel"].astype(np.int64)),
        )

    def _fault(self, place: ChunkPlace, what: str) -> None:
        self._faults.add(Sentence(f"{self.name}: at byte {place.offset}: ", what))
