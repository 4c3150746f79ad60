"""`.db3` files of ROS 2 bags, whole or damaged.

SQLite files of ROS 2 bags: opened without trust, and read past damage.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from spatial_replay.bags.columns import Columns, CountedTopics, MessageColumns, unnumbered
from spatial_replay.bags.decoders import decoder_of, is_latched, topics_named
from spatial_replay.bags.file_reader import OneFile
from spatial_replay.bags.metadata import BagMetadata, bag_metadata_from_text
from spatial_replay.bags.reader import Decoder, Topic
from spatial_replay.bags.ros_definitions import LONGEST_TEXT, full_type_name
from spatial_replay.bags.unpacking import copy_beginning, temporary_folder
from spatial_replay.errors import LogError
from spatial_replay.logs.messages import Schema
from spatial_replay.logs.read_options import FaultList
from spatial_replay.trace.sample import LATEST_NS

SQLITE_MAGIC = b"SQLite format 3\x00"
_MOST_TOPICS = 100_000
_STEPS = 10_000
"""Steps of the database's machine between two looks at how many it has taken."""
_STEPS_A_BYTE = 20
_SKIPS = 64
"""Damaged stretches are stepped over with twice the step each time: after so many no row can be left."""

_MOST_ROWS, _BATCH_BYTES, _SAMPLED = 512, 2**21, 8

_COLUMNS = "SELECT id, topic_id, timestamp, data FROM messages"

Row = tuple[int, int, Any, Any]
"""Number, topic, time and content of a message; a damaged file may hold anything as the last two."""


@dataclass(frozen=True, slots=True)
class BagTables:
    """What a file says of itself.

    Attributes:
        topics: by number.
        metadata: what the recorder put down when it closed the file; None without it.
        distribution: the release of ROS that wrote it.
    """

    topics: dict[int, Topic] = field(hash=False)
    metadata: BagMetadata | None
    distribution: str | None


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """The database in a file, read only: nothing beside it is looked at, no function in it is trusted.

    Raises:
        LogError: it cannot be opened.
    """
    size = path.stat().st_size
    try:
        uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as database:
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(10**6, size))
            database.text_factory = lambda text: text.decode("utf-8", "replace")
            # a file that was cut is refused without this; nothing is ever written
            database.execute("PRAGMA writable_schema=ON")
            database.execute("PRAGMA trusted_schema=OFF")
            database.execute("PRAGMA cell_size_check=ON")
            taken = count(1)
            most = 1_000 + size * _STEPS_A_BYTE // _STEPS
            # a damaged tree of pages may lead in circles
            database.set_progress_handler(lambda: next(taken) > most, _STEPS)
            yield database
    # names of columns come as text, whatever bytes they are
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise LogError(f"{path.name}: the database is damaged ({error})") from None


class Extent(NamedTuple):
    """How much of a file is there: bytes missing from its end, and bytes in whole pages."""

    missing: int
    whole: int


def extent_of(path: Path) -> Extent:
    """What is left of a file, by its head."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(100)
    if len(head) < 100:
        return Extent(100 - len(head), size)
    page = int.from_bytes(head[16:18], "big")
    page = 65536 if page == 1 else page
    pages = int.from_bytes(head[28:32], "big")
    if page < 512 or head[24:28] != head[92:96]:
        # damaged, or written by a version that does not count pages
        return Extent(0, size)
    return Extent(max(0, pages * page - size), size - size % page)


def read_tables(database: sqlite3.Connection, name: str) -> BagTables:
    """What a file says of itself.

    Raises:
        LogError: it is no bag.
    """
    kinds = dict(
        database.execute(
            "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND rootpage > 0 LIMIT ?",
            (_MOST_TOPICS,),
        ).fetchall()
    )
    if not {"topics", "messages"} <= kinds.keys():
        raise LogError(f"{name} is no ROS 2 bag: it has no tables 'topics' and 'messages'")
    metadata = _metadata(database) if "metadata" in kinds else None
    schemas = _schemas(database) if "message_definitions" in kinds else {}
    rows = _records(database, "topics")
    distribution = metadata.distribution if metadata else None
    for row in _records(database, "schema") if "schema" in kinds else ():
        distribution = str(row.get("ros_distro") or "") or distribution
    counts = metadata.counts if metadata else {}
    topics = {}
    for row in rows:
        number, topic, type_name = row.get("id"), row.get("name"), row.get("type")
        if not (isinstance(number, int) and isinstance(topic, str) and isinstance(type_name, str)):
            raise LogError(f"{name} is damaged: its table 'topics' has a row without number, name or type")
        topics[number] = _topic(row, schemas.get(type_name), counts.get(topic))
    return BagTables(topics, metadata, distribution)


class Query(NamedTuple):
    """Which messages to read: topics by number, times from `first_ns` to `last_ns`, in which order."""

    topics: Sequence[int]
    first_ns: int
    last_ns: int
    as_recorded: bool


def iter_rows(
    database: sqlite3.Connection, query: Query, faults: FaultList, name: str
) -> Iterator[list[Row]]:
    """The messages that a query asks for, in order.

    Where the file is damaged, what can be reached of the rest follows in the order in which it was written.
    """
    marks = ", ".join("?" * len(query.topics))
    inside = f"{_COLUMNS} WHERE topic_id IN ({marks}) AND timestamp BETWEEN ? AND ?"
    arguments = (*query.topics, query.first_ns, query.last_ns)
    time_ns, row_id = query.first_ns, -1
    try:
        order = "id" if query.as_recorded else "timestamp, id"
        cursor = database.execute(f"{inside} ORDER BY {order}", arguments)
        for rows in _fetched(cursor):
            yield rows
            row_id, _, time_ns, _ = rows[-1]
        return
    except sqlite3.Error as error:
        faults.add(f"{name}: after {time_ns} ns: the database is damaged ({error})")
    seen = "id" if query.as_recorded else "(timestamp, id)"
    rest = f"{inside} AND {seen} > {'?' if query.as_recorded else '(?, ?)'} AND id > ? ORDER BY id"
    arguments += (row_id,) if query.as_recorded else (time_ns, row_id)
    reached, step = 0, 0
    for _ in range(_SKIPS):
        try:
            for row in database.execute(rest, (*arguments, reached + step)):
                yield [row]
                reached, step = row[0], 0
            return
        except sqlite3.Error:
            step = step * 2 or 1
        except OverflowError:
            return


def _fetched(cursor: sqlite3.Cursor) -> Iterator[list[Row]]:
    """The rows of a query in lists of some megabytes; an error loses those that were not handed over yet."""
    size = 64
    while rows := cursor.fetchmany(size):
        yield rows
        held = _SAMPLED * sum(len(row[3]) for row in rows[::_SAMPLED] if isinstance(row[3], bytes))
        size = min(2 * size, _MOST_ROWS) if held < _BATCH_BYTES else max(1, size // 2)


def _records(database: sqlite3.Connection, table: str) -> list[dict[str, object]]:
    """The rows of a small table; columns vary with the release that wrote it."""
    cursor = database.execute(f"SELECT * FROM {table} LIMIT {_MOST_TOPICS}")
    names = [column[0] for column in cursor.description]
    return [dict(zip(names, row, strict=True)) for row in cursor]


def _schemas(database: sqlite3.Connection) -> dict[str, Schema]:
    schemas = {}
    for row in _records(database, "message_definitions"):
        type_name, text = row.get("topic_type"), row.get("encoded_message_definition")
        if (
            isinstance(type_name, str)
            and isinstance(text, str)
            and text.strip()
            and len(text) <= LONGEST_TEXT
        ):
            schemas[type_name] = Schema(type_name, str(row.get("encoding")), text.encode())
    return schemas


def _metadata(database: sqlite3.Connection) -> BagMetadata | None:
    for row in _records(database, "metadata"):
        text = row.get("metadata")
        if isinstance(text, str) and text.strip():
            return bag_metadata_from_text(text)
    return None


def _topic(row: dict[str, object], schema: Schema | None, count: int | None) -> Topic:
    qos = str(row.get("offered_qos_profiles") or "")
    return Topic(
        name=str(row["name"]),
        type=full_type_name(str(row["type"])),
        encoding=str(row.get("serialization_format")),
        count=count,
        schema=schema,
        latched=is_latched(qos),
        metadata=MappingProxyType({"offered_qos_profiles": qos} if qos else {}),
    )


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
