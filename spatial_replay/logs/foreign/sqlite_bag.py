"""`.db3` files of ROS 2 bags, whole or damaged."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from spatial_replay.errors import LogError
from spatial_replay.logs.foreign.columns import Columns, MessageColumns, unnumbered
from spatial_replay.logs.foreign.decoders import decoder_of
from spatial_replay.logs.foreign.messages import Decoder, Topic
from spatial_replay.logs.foreign.one_file import OneFile
from spatial_replay.logs.foreign.ordering import CountedTopics
from spatial_replay.logs.foreign.sqlite_tables import (
    BagTables,
    Query,
    Row,
    extent_of,
    iter_rows,
    opened,
    read_tables,
)
from spatial_replay.logs.foreign.topic_table import topics_named
from spatial_replay.logs.foreign.unpacking import copy_beginning, temporary_folder
from spatial_replay.trace.times import LATEST_NS

_ROW_BYTES = 6
"""The least that a message takes in a file."""


class SqliteBag(OneFile):
    """A `.db3` file of a ROS 2 bag; see `MessageReader`."""

    kind = "ROS 2 bag"

    @cached_property
    def _whole(self) -> Path:
        """The file; if it was cut, a copy of its whole pages: the rest of a page would read as zeros."""
        extent = extent_of(self._path)
        if not extent.missing:
            return self._path
        self._faults.add(f"{self.name}: at least {extent.missing} bytes are missing from its end")
        return copy_beginning(self._path, extent.whole, temporary_folder(self))

    @cached_property
    def _tables(self) -> BagTables:
        for ending in ("-wal", "-journal"):
            beside = self._path.with_name(self.name + ending)
            if beside.is_file() and beside.stat().st_size:
                self._faults.add(
                    f"{self.name}: its recorder was interrupted, and what {beside.name} holds was not read;"
                    " open a copy of both with sqlite3 to bring them together"
                )
        with opened(self._whole) as database:
            return read_tables(database, self.name)

    @cached_property
    def _topics(self) -> tuple[Topic, ...]:
        return topics_named(self._tables.topics.values(), self._tables.distribution)

    @cached_property
    def start_ns(self) -> int | None:
        """Log time of the first message."""
        try:
            with opened(self._whole) as database:
                ((start_ns,),) = database.execute("SELECT min(timestamp) FROM messages")
        except LogError:
            # the damage is told when the messages are read
            return 0
        return start_ns if isinstance(start_ns, int) else None

    def topics(self) -> tuple[Topic, ...]:
        """See `MessageReader.topics`."""
        if not self._topics:
            raise LogError(f"{self.name} holds no topic")
        return self._topics

    def decoder(self, topic: str) -> Decoder:
        """See `MessageReader.decoder`."""
        named = next(each for each in self._topics if each.name == topic)
        return decoder_of(named, self._tables.distribution)

    def iter_columns(
        self,
        topics: Collection[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        as_recorded: bool = False,
    ) -> Columns:
        """See `ColumnReader.iter_columns`."""
        first, last = start_ns or 0, LATEST_NS if end_ns is None else min(end_ns - 1, LATEST_NS)
        counts = {each.name: each.count for each in self._topics if each.name in topics}
        columns = self._messages(counts, first, last, as_recorded=as_recorded)
        if (first, last) != (0, LATEST_NS):
            yield from columns
            return
        counted = CountedTopics(counts)
        yield from counted.counted(columns)
        counted.compare(self.name, self._faults)

    def _messages(self, topics: Collection[str], first: int, last: int, *, as_recorded: bool) -> Columns:
        wanted = {number: topic.name for number, topic in self._tables.topics.items() if topic.name in topics}
        most = self._path.stat().st_size // _ROW_BYTES
        with opened(self._whole) as database:
            query = Query(sorted(wanted), first, last, as_recorded)
            for rows in iter_rows(database, query, self._faults, self.name):
                most -= len(rows)
                if most < 0:
                    raise LogError(f"{self.name} is damaged: it lists more messages than it has room for")
                yield self._columns(rows, wanted)

    def _columns(self, rows: Sequence[Row], wanted: Mapping[int, str]) -> MessageColumns:
        places, numbers, times, payloads = zip(*rows, strict=True)
        if set(map(type, payloads)) != {bytes} or set(map(type, times)) != {int}:
            good = [row for row in rows if type(row[3]) is bytes and type(row[2]) is int]
            self._faults.add(f"{self.name}: {len(rows) - len(good)} messages have no time or no content")
            return self._columns(good, wanted) if good else MessageColumns()
        topics = [wanted[number] for number in numbers]
        return unnumbered(topics, np.array(times, np.int64), payloads, np.array(places, np.int64))
