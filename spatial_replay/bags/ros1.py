"""ROS 1 bags, whole or damaged.

The reader is our own because rosbags refuses a whole bag at its first damage, and bags without an index,
which interrupted recorders leave behind. Here only the damaged chunks are lost, and each is reported.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from functools import cached_property
from itertools import pairwise
from types import MappingProxyType
from typing import BinaryIO

import numpy as np

from spatial_replay.bags.columns import Columns, MessageColumns, in_order, places_in, unnumbered
from spatial_replay.bags.decoders import channel_of, topics_by_name
from spatial_replay.bags.reader import MessageReader
from spatial_replay.bags.ros1_index import (
    MESSAGE,
    BagChunk,
    BagDirectory,
    Connection,
    connections_in,
    read_bag_directory,
    read_chunk,
    record_table,
)
from spatial_replay.bags.ros_definitions import full_type_name
from spatial_replay.bags.topic import Topic
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.mcap.index import DamageError
from spatial_replay.logs.mcap.read import most_waiting
from spatial_replay.logs.messages import Channel, Schema
from spatial_replay.text import Instant, Sentence


class Ros1Bag(MessageReader):
    """A ROS 1 bag, read chunk by chunk."""

    kind = "ROS 1 bag"

    @cached_property
    def _directory(self) -> BagDirectory:
        with self._path.open("rb") as stream:
            return read_bag_directory(stream, self._faults, self.name)

    @cached_property
    def _topics(self) -> tuple[Topic, ...]:
        counts: Counter[int] = Counter()
        for chunk in self._directory.chunks:
            counts.update(chunk.counts or {})
        return topics_by_name(
            self._topic(each, counts[each.number]) for each in self._directory.connections.values()
        )

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message."""
        return min((chunk.start_ns for chunk in self._directory.chunks), default=None)

    def _read(self, topics: Collection[str], first: int, last: int, *, as_recorded: bool) -> Columns:
        wanted = {c.number: c for c in self._directory.connections.values() if c.topic in topics}
        chunks = [
            (rank, chunk)
            for rank, chunk in enumerate(self._directory.chunks)
            if chunk.start_ns < last
            and chunk.end_ns >= first
            and (chunk.counts is None or not wanted.keys().isdisjoint(chunk.counts))
        ]
        if not as_recorded:
            chunks.sort(key=lambda ranked: ranked[1].start_ns)
            if self._is_in_parts:
                chunks = [(rank, chunk) for rank, (_, chunk) in enumerate(chunks)]
        with self._path.open("rb") as stream:
            contents = (self._messages(stream, *ranked, wanted, first, last) for ranked in chunks)
            if as_recorded:
                yield from contents
                return
            most = most_waiting([self._path.stat().st_size])
            yield from in_order([chunk.start_ns for _, chunk in chunks], contents, self.name, most)

    @cached_property
    def _is_in_parts(self) -> bool:
        """Whether no chunk overlaps another in time: then their order in the file means nothing.

        Bags are played by their index, and tools that merge or repair them write chunks in any order.
        """
        ordered = sorted(self._directory.chunks, key=lambda chunk: (chunk.start_ns, chunk.end_ns))
        return all(one.end_ns <= other.start_ns for one, other in pairwise(ordered))

    def channels(self, topics: Collection[str]) -> Mapping[int, Channel]:
        return {
            rank: channel_of(self._topic(self._directory.connections[number], 0))
            for rank, number in enumerate(self._numbers.tolist())
            if self._directory.connections[number].topic in topics
        }

    @cached_property
    def _numbers(self) -> Integers:
        """The numbers of the connections, in order."""
        return np.array(sorted(self._directory.connections), np.int64)

    def _messages(
        self,
        stream: BinaryIO,
        rank: int,
        chunk: BagChunk,
        wanted: dict[int, Connection],
        first: int,
        last: int,
    ) -> MessageColumns:
        """Read the messages of a chunk; what is lost of them goes to the faults."""
        span = Sentence("messages between ", Instant(chunk.start_ns, 0), " and ", Instant(chunk.end_ns, 0))
        try:
            content = read_chunk(stream, chunk.offset)
        except DamageError as damage:
            self._fault(chunk, Sentence(f"{damage}; the ", span, " are lost"))
            return MessageColumns()
        table, breaks_off = record_table(content)
        if breaks_off:
            self._fault(chunk, Sentence("a record breaks off; some of the ", span, " are lost"))
        try:
            for connection in connections_in(content, table):
                if wanted.get(connection.number, connection) != connection:
                    self._fault(chunk, f"connection {connection.number} is described in two ways")
        except DamageError as damage:
            self._fault(chunk, f"{damage}; a connection is described there")
        is_message = table.opcode == MESSAGE
        if (chunk.start_ns, chunk.end_ns) != _span(table.time_ns[is_message]):
            self._fault(chunk, Sentence("the ", span, " have other times than the index says"))
        rows = is_message & np.isin(table.connection, list(wanted))
        rows &= (table.time_ns >= first) & (table.time_ns < last)
        bounds = zip(table.begin[rows].tolist(), table.end[rows].tolist(), strict=True)
        return unnumbered(
            [wanted[number].topic for number in table.connection[rows].tolist()],
            table.time_ns[rows],
            [content[begin:end] for begin, end in bounds],
            places_in(rank, np.flatnonzero(rows)),
            np.searchsorted(self._numbers, table.connection[rows]),
        )

    def _topic(self, connection: Connection, count: int) -> Topic:
        definition = connection.data.get("message_definition", b"")
        return Topic(
            name=connection.topic,
            type=full_type_name(connection.type),
            encoding="ros1",
            count=count if self._directory.is_indexed else None,
            schema=Schema(connection.type, "ros1msg", definition),
            latched=connection.is_latched,
            metadata=MappingProxyType(
                {
                    key: connection.data[key].decode("utf-8", "replace")
                    for key in ("callerid", "latching", "md5sum")
                    if key in connection.data
                }
            ),
        )

    def _fault(self, chunk: BagChunk, what: str) -> None:
        self._faults.add(Sentence(f"{self.name}: at byte {chunk.offset}: ", what))


def _span(times_ns: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> tuple[int, int]:
    return (int(times_ns.min()), int(times_ns.max())) if len(times_ns) else (0, 0)
