"""`.db3` files of ROS 2 bags: opened without trust, and read up to the first damage.

A log is input from outside, so nothing in the database may compute, and whatever SQLite says about a
damaged file becomes a fault of the log.
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
from typing import Any
from urllib.parse import quote

import numpy as np

from spatial_replay.bags.columns import Columns, MessageColumns, unnumbered
from spatial_replay.bags.decoders import channel_of, topics_by_name
from spatial_replay.bags.metadata import BagMetadata, bag_metadata_from_text
from spatial_replay.bags.reader import MessageReader
from spatial_replay.bags.ros_definitions import LONGEST_TEXT, full_type_name
from spatial_replay.bags.topic import Topic, is_latched
from spatial_replay.bags.unpacking import copy_beginning, temporary_folder
from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.messages import Channel, Schema

SQLITE_MAGIC = b"SQLite format 3\x00"
_MOST_TOPICS = 100_000
_STEPS = 10_000
"""Steps of SQLite's virtual machine between two looks at how many it has taken."""
_STEPS_A_BYTE = 20
_MOST_ROWS, _BATCH_BYTES = 512, 2**21

Row = tuple[int, int, Any, Any]
"""Id, topic, time and content of a message; a damaged file may hold anything as the last two."""


class SqliteBag(MessageReader):
    """A `.db3` file of a ROS 2 bag."""

    kind = "ROS 2 bag"

    @cached_property
    def _whole(self) -> Path:
        """The file; if it was cut, a copy of its whole pages: the rest of a page would read as zeros."""
        missing, whole = _bytes_missing(self._path)
        if not missing:
            return self._path
        self._faults.add(f"{self.name}: at least {missing} bytes are missing from its end")
        return copy_beginning(self._path, whole, temporary_folder(self))

    @cached_property
    def _tables(self) -> BagTables:
        for ending in ("-wal", "-journal"):
            beside = self._path.with_name(self.name + ending)
            if beside.is_file() and beside.stat().st_size:
                self._faults.add(
                    f"{self.name}: its recorder was interrupted, and what {beside.name} holds was not read;"
                    " open a copy of both with sqlite3 to bring them together"
                )
        with _opened(self._whole) as database:
            return _read_tables(database, self.name)

    @cached_property
    def _topics(self) -> tuple[Topic, ...]:
        return topics_by_name(self._tables.topics.values(), self._tables.distribution)

    @property
    def _distribution(self) -> str | None:
        return self._tables.distribution

    @cached_property
    def start_ns(self) -> int | None:
        """Log time of the first message."""
        try:
            with _opened(self._whole) as database:
                ((start_ns,),) = database.execute("SELECT min(timestamp) FROM messages")
        except LogError:
            # reading the messages reports the damage
            return 0
        return start_ns if isinstance(start_ns, int) else None

    def channels(self, topics: Collection[str]) -> Mapping[int, Channel]:
        described = self._tables.topics
        return {
            rank: channel_of(described[number], self._distribution)
            for rank, number in enumerate(self._numbers.tolist())
            if described[number].name in topics
        }

    @property
    def channel_count(self) -> int:
        """The number of channels, of whatever topics."""
        return len(self._numbers)

    @cached_property
    def _numbers(self) -> Integers:
        """The numbers of the topics, in order."""
        return np.array(sorted(self._tables.topics), np.int64)

    def _read(self, topics: Collection[str], first: int, last: int, *, as_recorded: bool) -> Columns:
        wanted = {number: topic.name for number, topic in self._tables.topics.items() if topic.name in topics}
        query = (
            "SELECT id, topic_id, timestamp, data FROM messages"
            f" WHERE topic_id IN ({', '.join('?' * len(wanted))}) AND timestamp BETWEEN ? AND ?"
            f" ORDER BY {'id' if as_recorded else 'timestamp, id'}"
        )
        row_id = None
        with _opened(self._whole) as database:
            try:
                for rows in _batches(database.execute(query, (*sorted(wanted), first, last - 1))):
                    yield self._columns(rows, wanted)
                    row_id = rows[-1][0]
            except sqlite3.Error as error:
                read = "no message could be read" if row_id is None else f"read up to row {row_id}"
                self._faults.add(f"{self.name}: the database is damaged ({error}); {read}")

    def _columns(self, rows: Sequence[Row], wanted: Mapping[int, str]) -> MessageColumns:
        places, numbers, times, payloads = zip(*rows, strict=True)
        if set(map(type, payloads)) != {bytes} or set(map(type, times)) != {int}:
            good = [row for row in rows if type(row[3]) is bytes and type(row[2]) is int]
            self._faults.add(f"{self.name}: {len(rows) - len(good)} messages have no time or no content")
            return self._columns(good, wanted) if good else MessageColumns()
        topics = [wanted[number] for number in numbers]
        channel = np.searchsorted(self._numbers, np.array(numbers, np.int64))
        place = np.array(places, np.int64)
        return unnumbered(topics, np.array(times, np.int64), payloads, place, channel)


@dataclass(frozen=True, slots=True)
class BagTables:
    """What a file says about itself.

    Attributes:
        topics: by number.
        metadata: what the recorder wrote when it closed the file; None without it.
        distribution: the ROS release that wrote it.
    """

    topics: dict[int, Topic] = field(hash=False)
    metadata: BagMetadata | None
    distribution: str | None


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open the database in a file, read only: no file beside it is read, no function in it is trusted.

    Raises:
        LogError: it cannot be opened.
    """
    size = path.stat().st_size
    try:
        uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
        # one thread reads, but garbage collection in another may close it
        connected = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
        with closing(connected) as database:
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


def _bytes_missing(path: Path) -> tuple[int, int]:
    """Return the bytes missing from a file's end, by its head, and the bytes that are in whole pages."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(100)
    if len(head) < 100:
        return 100 - len(head), size
    page = int.from_bytes(head[16:18], "big")
    page = 65536 if page == 1 else page
    pages = int.from_bytes(head[28:32], "big")
    if page < 512 or head[24:28] != head[92:96]:
        # damaged, or written by a version that does not count pages
        return 0, size
    return max(0, pages * page - size), size - size % page


def _read_tables(database: sqlite3.Connection, name: str) -> BagTables:
    """Read what a file says about itself.

    Raises:
        LogError: it is not a bag.
    """
    kinds = dict(
        database.execute(
            "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND rootpage > 0 LIMIT ?",
            (_MOST_TOPICS,),
        ).fetchall()
    )
    if not {"topics", "messages"} <= kinds.keys():
        raise LogError(f"{name} is not a ROS 2 bag: it has no tables 'topics' and 'messages'")
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
            raise LogError(f"{name} is damaged: its table 'topics' has a row without an id, a name or a type")
        topics[number] = _topic(row, schemas.get(type_name), counts.get(topic))
    return BagTables(topics, metadata, distribution)


def _batches(cursor: sqlite3.Cursor) -> Iterator[list[Row]]:
    """Yield the rows of a query in lists of at most some megabytes; those before an error come before it."""
    rows: list[Row] = []
    held = 0
    try:
        for row in cursor:
            rows.append(row)
            held += len(row[3]) if isinstance(row[3], bytes) else 0
            if len(rows) == _MOST_ROWS or held >= _BATCH_BYTES:
                yield rows
                rows, held = [], 0
    except sqlite3.Error:
        if rows:
            yield rows
        raise
    if rows:
        yield rows


def _records(database: sqlite3.Connection, table: str) -> list[dict[str, object]]:
    """Return the rows of a small table; columns vary with the release that wrote it."""
    cursor = database.execute(f"SELECT * FROM {table} LIMIT {_MOST_TOPICS}")
    names = [column[0] for column in cursor.description]
    return [dict(zip(names, row, strict=True)) for row in cursor]


def _schemas(database: sqlite3.Connection) -> dict[str, Schema]:
    schemas = {}
    for row in _records(database, "message_definitions"):
        name, text = row.get("topic_type"), row.get("encoded_message_definition")
        if isinstance(name, str) and isinstance(text, str) and text.strip() and len(text) <= LONGEST_TEXT:
            schemas[name] = Schema(name, str(row.get("encoding")), text.encode())
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
