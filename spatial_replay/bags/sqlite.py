"""Read `.db3` files of ROS 2 bags, untrusted and possibly damaged.

A log is untrusted input, so no function in the database may run. An error of SQLite about a damaged file
becomes a fault of the log.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
import weakref
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import MappingProxyType
from typing import Any, BinaryIO, Literal, cast
from urllib.parse import quote

import numpy as np
import zstandard

from spatial_replay.bags.decoders import Topic, channel_of, is_latched, topics_by_name
from spatial_replay.bags.definitions import LONGEST_TEXT, full_type_name
from spatial_replay.bags.reader import Columns, MessageColumns, MessageReader
from spatial_replay.errors import LogError, OutputError
from spatial_replay.logs.mcap.index import LARGEST_CHUNK
from spatial_replay.logs.mcap.read import ALWAYS_ALLOWED, MOST_TIMES_LARGER
from spatial_replay.logs.messages import Channel, Schema
from spatial_replay.logs.output_file import open_output, output_error
from spatial_replay.text import Instant, Sentence

Compression = Literal["", "file", "message"]

LARGEST_METADATA = 2**23
_DEEPEST = 32
_MOST = 2**63


@dataclass(frozen=True, slots=True)
class BagMetadata:
    """Declarations of a bag.

    Attributes:
        files: names of the bag's files, without folders, in order.
        types: type of each topic.
        counts: number of messages of each topic.
        compression: unit of compression, "file" or "message"; "" without compression.
        distribution: ROS release that wrote the bag; None if the metadata names no release.
    """

    files: tuple[str, ...]
    types: Mapping[str, str]
    counts: Mapping[str, int]
    compression: Compression
    distribution: str | None


def bag_metadata_from_bytes(data: bytes) -> BagMetadata:
    """Parse the first `LARGEST_METADATA` + 1 bytes of a metadata.yaml; a longer file is refused.

    Raises:
        LogError: the file is not YAML, or does not describe a bag.
    """
    try:
        document = _plain(data.decode())
    except UnicodeDecodeError:
        raise LogError("it is not UTF-8") from None
    information = (
        document.get("rosbag2_bagfile_information", document) if isinstance(document, dict) else None
    )
    if not isinstance(information, dict):
        raise LogError("it does not describe a bag; it has no 'rosbag2_bagfile_information'")
    topics = [_metadata_topic(entry) for entry in _list(information, "topics_with_message_count")]
    files = [_text(entry, "relative_file_paths") for entry in _list(information, "relative_file_paths")]
    distribution = information.get("ros_distro")
    return BagMetadata(
        files=tuple(dict.fromkeys(_base_name(file) for file in files)),
        types={name: type_name for name, type_name, _ in topics},
        counts={name: count for name, _, count in topics},
        compression=_compression(information),
        distribution=distribution if isinstance(distribution, str) else None,
    )


def _plain(text: str) -> Any:
    """Parse a YAML text; refuse aliases, because aliases can expand a short text without bound."""
    import yaml

    if len(text) > LARGEST_METADATA:
        raise LogError(f"it has {len(text)} characters; up to {LARGEST_METADATA} are read")
    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > _DEEPEST:
                raise LogError("it refers to parts of itself, or is nested too deep; no recorder writes that")
        # safe, because the loader creates plain values only
        return yaml.load(text, Loader=loader)
    # malformed numbers and dates raise errors of all these types
    except (yaml.YAMLError, ValueError, OverflowError, TypeError, KeyError) as error:
        raise LogError(f"it is no YAML ({' '.join(str(error).split()):.200})") from None


def _metadata_topic(entry: object) -> tuple[str, str, int]:
    if not isinstance(entry, dict) or not isinstance(entry.get("topic_metadata"), dict):
        raise LogError("a topic in it has no 'topic_metadata'")
    topic_metadata = cast("dict[str, object]", entry["topic_metadata"])
    name, count = _text(topic_metadata.get("name"), "name"), entry.get("message_count")
    if not isinstance(count, int) or not 0 <= count < _MOST:
        raise LogError(f"the message_count of topic {name!r:.100} is {count!r:.100}; give a number")
    return name, _text(topic_metadata.get("type"), "type"), count


def _compression(topic_metadata: dict[str, object]) -> Compression:
    compression_mode = str(topic_metadata.get("compression_mode") or "none").lower()
    compression_format = str(topic_metadata.get("compression_format") or "")
    if compression_mode == "none":
        return ""
    if compression_mode not in ("file", "message") or compression_format != "zstd":
        raise LogError(
            f"the bag is compressed by {compression_mode!r:.40} with {compression_format!r:.40}; "
            "only zstd is read, by file or by message"
        )
    return "file" if compression_mode == "file" else "message"


def _list(mapping: dict[str, object], name: str) -> list[object]:
    value = mapping.get(name)
    if not isinstance(value, list):
        raise LogError(f"{name!r} in it is not a list")
    return value


def _text(value: object, name: str) -> str:
    if not isinstance(value, str):
        raise LogError(f"{name!r} in it is {value!r:.100}; give a string")
    return value


def _base_name(path: str) -> str:
    """Return the file name in a path; early releases wrote a folder, too. No path may leave the bag."""
    name = PureWindowsPath(PurePosixPath(path).name).name
    if name in ("", "..") or "\x00" in name:
        raise LogError(f"{path!r:.100} in it is not a file name")
    return name


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE = 2**20
_PACKED_PIECE = 2**12
"""Size of one read of compressed data, bytes; small, because one byte may decompress to 32,000 bytes."""
_LEFT_FREE = 2**26
"""Disk space that stays free, bytes, but at most a tenth of the free space."""


def temporary_folder(owner: object) -> Path:
    """Create a folder that is removed with its owner.

    Raises:
        OutputError: the folder cannot be created.
    """
    try:
        folder = tempfile.mkdtemp(prefix="spatial-replay-")
    except OSError as error:
        raise output_error(Path("a temporary folder"), error) from error
    weakref.finalize(owner, shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def copy_beginning(path: Path, size: int, folder: Path) -> Path:
    """Copy the first `size` bytes of a file into a folder."""
    target_path = folder / path.name
    with path.open("rb") as source_file, open_output(target_path) as target_file:
        while size > 0 and (piece := source_file.read(min(size, _PIECE))):
            target_file.write(piece)
            size -= len(piece)
    return target_path


def unpack_file(packed: Path, folder: Path) -> tuple[Path, str]:
    """Decompress a file into a folder.

    Returns:
        the path of the decompressed file, without the suffix of the compression, and a fault or "".

    Raises:
        LogError: nothing decompresses, or the content is implausibly large.
        OutputError: the folder has no room for it.
    """
    target = folder / (packed.stem if packed.suffix in (".zstd", ".zst") else packed.name)
    most_bytes = packed.stat().st_size * MOST_TIMES_LARGER + ALWAYS_ALLOWED
    free_bytes = shutil.disk_usage(folder).free
    room_bytes = free_bytes - min(_LEFT_FREE, free_bytes // 10)
    unpacked_bytes = 0
    damage = "breaks off"
    try:
        with packed.open("rb") as packed_file, open_output(target) as target_file:
            for piece, is_between in _decompress(packed_file):
                unpacked_bytes += len(piece)
                if unpacked_bytes > most_bytes:
                    raise LogError(
                        f"{packed.name} decompresses to more than {most_bytes} bytes; no recorder writes that"
                    )
                if unpacked_bytes > room_bytes:
                    raise OutputError(
                        f"{packed.name} decompresses to more than fits in {folder.parent};"
                        " set TMPDIR to a folder with more room"
                    )
                target_file.write(piece)
                damage = "" if is_between else "breaks off"
    except zstandard.ZstdError as error:
        damage = f"does not decompress to its end ({error})"
    if not unpacked_bytes:
        raise LogError(f"{packed.name} {damage or 'is empty'}; nothing in it can be decompressed")
    return target, f"{packed.name} {damage}; {unpacked_bytes} bytes could be decompressed" if damage else ""


def _decompress(source: BinaryIO) -> Iterator[tuple[bytes, bool]]:
    """Yield the decompressed pieces of a file, and whether each piece completes a frame."""
    frame, unused_bytes = None, b""
    while piece := unused_bytes or source.read(_PACKED_PIECE):
        frame = frame or zstandard.ZstdDecompressor().decompressobj()
        content, unused_bytes = frame.decompress(piece), b""
        if frame.eof:
            unused_bytes = frame.unused_data
            frame = None
        yield content, frame is None


def unpacked_size(payload: bytes) -> int:
    """Return an upper bound of a message's decompressed size, bytes; the message may be plain."""
    try:
        size = zstandard.frame_content_size(payload)
    except zstandard.ZstdError:
        return len(payload)
    return size if size >= 0 else ALWAYS_ALLOWED


def decompress_message(payload: bytes) -> bytes:
    """Decompress a single message.

    Raises:
        LogError: the message does not decompress, or exceeds the limits of a chunk of an MCAP log.
    """
    try:
        size = zstandard.frame_content_size(payload)
        most_bytes = min(LARGEST_CHUNK, max(ALWAYS_ALLOWED, MOST_TIMES_LARGER * len(payload)))
        if size > most_bytes:
            raise LogError(f"a message claims to hold {size} bytes in {len(payload)}")
        return zstandard.ZstdDecompressor().decompress(payload, max_output_size=most_bytes)
    except zstandard.ZstdError as error:
        raise LogError(f"a message does not decompress ({error})") from None


SQLITE_MAGIC = b"SQLite format 3\x00"
_MOST_TOPICS = 100_000
_STEPS = 10_000
"""Steps of SQLite's virtual machine between two checks of the limit."""
_STEPS_A_BYTE = 20
"""Maximum number of steps for each byte of a file, because pages of a damaged file can form a cycle."""
_MOST_ROWS, _BATCH_BYTES = 512, 2**21

_MOST_PROBES = 10_000
"""Maximum number of queries for parts of a damaged table; the remaining parts are reported as lost."""

Row = tuple[int, int, Any, Any]
"""Id, topic, time and content of a message."""
# SQLite stores any type in any column, so a damaged row may hold a text where an id belongs
_TYPES = (int, int, int, bytes)
RowHead = tuple[int, int, int]
"""Id, topic and time of a message."""
_Span = tuple[int, int]
"""First and last id of a range."""


class SqliteBag(MessageReader):
    """A `.db3` file of a ROS 2 bag."""

    kind = "ROS 2 bag"

    @cached_property
    def _readable_file(self) -> Path:
        """The file, or a copy of the complete pages of a truncated file; a partial page would read as 0."""
        path = self._merged_file
        missing_bytes, whole_bytes = _bytes_missing(path)
        if not missing_bytes:
            return path
        self._faults.add(f"{self.name}: at least {missing_bytes} bytes are missing from its end")
        return copy_beginning(path, whole_bytes, temporary_folder(self))

    @cached_property
    def _merged_file(self) -> Path:
        """The file, or a copy merged with the write-ahead log next to it."""
        # https://www.sqlite.org/wal.html
        log_file = self._path.with_name(f"{self.name}-wal")
        if not log_file.is_file() or not log_file.stat().st_size:
            return self._path
        folder = temporary_folder(self)
        bag_copy, _ = (copy_beginning(file, file.stat().st_size, folder) for file in (self._path, log_file))
        most_bytes = bag_copy.stat().st_size + log_file.stat().st_size
        try:
            # the copies are in a separate folder, so that SQLite never opens the original files
            with closing(sqlite3.connect(bag_copy, isolation_level=None)) as database:
                database.execute("PRAGMA trusted_schema=OFF")
                # the checkpoint copies the pages of the write-ahead log into the copy of the file
                (_, frame_count, _) = database.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
            if frame_count < 1:
                raise sqlite3.DatabaseError("no whole change is in it")
            if bag_copy.stat().st_size > most_bytes:
                raise sqlite3.DatabaseError("it places pages beyond its own size")
        except (sqlite3.Error, UnicodeDecodeError) as error:
            self._faults.add(
                f"{self.name}: its recorder was interrupted, and what {log_file.name} holds was not read"
                f" ({error})"
            )
            return self._path
        self._remarks.add(f"{self.name}: its recorder was interrupted; {log_file.name} was read, too")
        return bag_copy

    @cached_property
    def _tables(self) -> tuple[dict[int, Topic], str | None]:
        """The topics by their numbers, and the ROS release that wrote the file."""
        journal_file = self._path.with_name(f"{self.name}-journal")
        if journal_file.is_file() and journal_file.stat().st_size:
            self._faults.add(
                f"{self.name}: its recorder was interrupted, and {journal_file.name} was not read; open a"
                " copy of both with sqlite3 to bring them together"
            )
        with _open_database(self._readable_file) as database:
            topic_by_number, distribution = _read_tables(database, self.name)
        if self._merged_file != self._path:
            # counts in the file do not include the write-ahead log
            topic_by_number = {
                number: replace(topic, count=None) for number, topic in topic_by_number.items()
            }
        return topic_by_number, distribution

    @property
    def _topic_by_number(self) -> dict[int, Topic]:
        return self._tables[0]

    @cached_property
    def _topics(self) -> tuple[Topic, ...]:
        return topics_by_name(self._topic_by_number.values(), self._distribution)

    @property
    def _distribution(self) -> str | None:
        return self._tables[1]

    @cached_property
    def start_ns(self) -> int | None:
        """Log time of the first message."""
        try:
            with _open_database(self._readable_file) as database:
                ((start_ns,),) = database.execute("SELECT min(timestamp) FROM messages")
        except LogError:
            # reading the messages reports the damage
            return 0
        return start_ns if isinstance(start_ns, int) else None

    @cached_property
    def _declared(self) -> Mapping[int, Channel]:
        return {
            number: channel_of(topic, self._distribution) for number, topic in self._topic_by_number.items()
        }

    def _read(self, topics: Collection[str], first_ns: int, end_ns: int, *, as_recorded: bool) -> Columns:
        topic_numbers = self._channel_numbers(topics)
        query = (
            "SELECT rowid, topic_id, timestamp, data FROM messages"
            f" WHERE topic_id IN ({', '.join('?' * len(topic_numbers))}) AND timestamp BETWEEN ? AND ?"
            f" ORDER BY {'rowid' if as_recorded else 'timestamp, rowid'}"
        )

        def key(row: Row | RowHead) -> tuple[int, int]:
            return (row[0], 0) if as_recorded else (row[2], row[0])

        # the last row before the damage, after which the search for intact rows continues
        last_key = (-1, -1)
        with _open_database(self._readable_file) as database:
            try:
                cursor = database.execute(query, (*sorted(topic_numbers), first_ns, end_ns - 1))
                for rows in self._valid_batches(_batches(cursor)):
                    yield self._columns(rows)
                    last_key = key(rows[-1])
                return
            except sqlite3.Error as error:
                damage = str(error)
        with _open_database(self._readable_file) as database:
            intact_rows, lost_spans = _intact_rows(database)
            remaining_rows = sorted(
                (
                    row
                    for row in intact_rows
                    if row[1] in topic_numbers and first_ns <= row[2] < end_ns and key(row) > last_key
                ),
                key=key,
            )
            for rows in self._valid_batches(_batches(_contents(database, remaining_rows, lost_spans))):
                yield self._columns(rows)
        self._report_losses(damage, intact_rows, lost_spans)

    def _report_losses(
        self, damage: str, intact_rows: Sequence[RowHead], lost_spans: Collection[_Span]
    ) -> None:
        """Report the lost rows of a damaged database, with the times of the messages around these rows."""
        damage_text = f"{self.name}: the database is damaged ({damage})"
        spans = _joined_spans(lost_spans)
        if not spans:
            self._faults.add(f"{damage_text}; every message could be read")
        row_ids = [row[0] for row in intact_rows]
        for first_id, last_id in spans:
            first_index, end_index = bisect_left(row_ids, first_id), bisect_right(row_ids, last_id)
            earlier = [Instant(row[2], 0) for row in intact_rows[max(0, first_index - 1) : first_index]]
            later = [Instant(row[2], 0) for row in intact_rows[end_index : end_index + 1]]
            time_words: tuple[str | Instant, ...] = (" between ", *earlier, " and ", *later)
            if not (earlier and later):
                time_words = (" after ", *earlier) if earlier else (" before ", *later) if later else ()
            rows_text = f"row {first_id}" if first_id == last_id else f"rows {first_id} to {last_id}"
            # if no message follows, the number of lost rows is not known
            rows_text = rows_text if later or not earlier else f"rows from {first_id} on"
            self._faults.add(Sentence(f"{damage_text}; messages", *time_words, f" are lost: {rows_text}"))

    def _valid_batches(self, batches: Iterable[list[Row]]) -> Iterator[list[Row]]:
        """Yield the rows with valid types, and report the other rows."""
        for rows in batches:
            sound_rows = [row for row in rows if tuple(map(type, row)) == _TYPES]
            if len(sound_rows) < len(rows):
                lost_count = len(rows) - len(sound_rows)
                self._faults.add(f"{self.name}: {lost_count} messages have no number, time or content")
            if sound_rows:
                yield sound_rows

    def _columns(self, rows: Sequence[Row]) -> MessageColumns:
        *columns, payloads = zip(*rows, strict=True)
        row_ids, topics, times_ns = (np.array(column, np.int64) for column in columns)
        return self._make_columns(topics, (times_ns, times_ns), np.zeros_like(row_ids), payloads, row_ids)


@contextmanager
def _open_database(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database read-only; no other file is read, and no function in the database is trusted.

    Raises:
        LogError: the database cannot be opened.
    """
    file_bytes = path.stat().st_size
    try:
        # immutable: no locks, and no file next to it: https://www.sqlite.org/uri.html#uriimmutable
        uri = f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1"
        # one thread reads the database, but garbage collection in another thread may close it
        connection = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
        with closing(connection) as database:
            # no value is longer than its file
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(10**6, file_bytes))
            # texts of a damaged file may hold any bytes
            database.text_factory = lambda text: text.decode("utf-8", "replace")
            # without this setting, SQLite refuses a truncated file; nothing is ever written
            database.execute("PRAGMA writable_schema=ON")
            # as advised for untrusted files: https://www.sqlite.org/security.html
            database.execute("PRAGMA trusted_schema=OFF")
            database.execute("PRAGMA cell_size_check=ON")
            step_numbers = count(1)
            most_checks = 1_000 + file_bytes * _STEPS_A_BYTE // _STEPS
            # pages of a damaged file can form a cycle, so the number of steps is limited
            database.set_progress_handler(lambda: next(step_numbers) > most_checks, _STEPS)
            yield database
    # sqlite3 decodes names of columns as UTF-8, which a damaged file may violate
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise LogError(f"{path.name}: the database is damaged ({error})") from None


def _bytes_missing(path: Path) -> tuple[int, int]:
    """Return the number of missing bytes at a file's end, and the length of its complete pages, in bytes."""
    # https://www.sqlite.org/fileformat.html#the_database_header
    file_bytes = path.stat().st_size
    with path.open("rb") as stream:
        header = stream.read(100)
    if len(header) < 100:
        return 100 - len(header), file_bytes
    page_bytes = int.from_bytes(header[16:18], "big")
    page_bytes = 65536 if page_bytes == 1 else page_bytes
    page_count = int.from_bytes(header[28:32], "big")
    if page_bytes < 512 or header[24:28] != header[92:96]:
        # damaged, or written by an old version, whose number of pages is not valid:
        # https://www.sqlite.org/fileformat.html#in_header_database_size
        return 0, file_bytes
    return max(0, page_count * page_bytes - file_bytes), file_bytes - file_bytes % page_bytes


def _read_tables(database: sqlite3.Connection, name: str) -> tuple[dict[int, Topic], str | None]:
    """Read the topics of a file by number, and the ROS release that wrote the file.

    Raises:
        LogError: the file is not a bag.
    """
    table_sql = dict(
        database.execute(
            "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND rootpage > 0 LIMIT ?",
            (_MOST_TOPICS,),
        ).fetchall()
    )
    if not {"topics", "messages"} <= table_sql.keys():
        raise LogError(f"{name} is not a ROS 2 bag: it has no tables 'topics' and 'messages'")
    metadata = _metadata(database) if "metadata" in table_sql else None
    schemas = _schemas(database) if "message_definitions" in table_sql else {}
    topic_rows = _records(database, "topics")
    distribution = metadata.distribution if metadata else None
    for row in _records(database, "schema") if "schema" in table_sql else ():
        distribution = str(row.get("ros_distro") or "") or distribution
    counts = metadata.counts if metadata else {}
    topics = {}
    for row in topic_rows:
        topic_number, topic_name, type_name = row.get("id"), row.get("name"), row.get("type")
        if not (isinstance(topic_number, int) and isinstance(topic_name, str) and isinstance(type_name, str)):
            raise LogError(f"{name} is damaged: its table 'topics' has a row without an id, a name or a type")
        topics[topic_number] = _topic(row, schemas.get(type_name), counts.get(topic_name))
    return topics, distribution


def _batches(cursor: Iterable[Row]) -> Iterator[list[Row]]:
    """Yield the rows of a query in lists of bounded size; the rows before an error are yielded first."""
    rows: list[Row] = []
    held_bytes = 0
    try:
        for row in cursor:
            rows.append(row)
            held_bytes += len(row[3]) if isinstance(row[3], bytes) else 0
            if len(rows) == _MOST_ROWS or held_bytes >= _BATCH_BYTES:
                yield rows
                rows, held_bytes = [], 0
    except sqlite3.Error:
        if rows:
            yield rows
        raise
    if rows:
        yield rows


def _intact_rows(database: sqlite3.Connection) -> tuple[list[RowHead], set[_Span]]:
    """Return the readable rows of a damaged database, sorted by id, and the ranges of unreadable ids.

    An unreadable range of ids is halved until single unreadable ids are found.
    """
    # rowid, because `id` can be another column if the definition of the table is damaged
    # NOT INDEXED, because an index can be damaged, too
    query = (
        "SELECT rowid, topic_id, timestamp FROM messages NOT INDEXED"
        " WHERE rowid BETWEEN ? AND ? ORDER BY rowid"
    )
    spans = deque([_all_ids(database)])
    row_by_id: dict[int, RowHead] = {}
    lost_spans: set[_Span] = set()
    for _ in range(_MOST_PROBES):
        if not spans:
            break
        first_id, last_id = spans.popleft()
        try:
            for row in database.execute(query, (first_id, last_id)):
                if all(type(cell) is int for cell in row):
                    row_by_id[row[0]] = row
                    first_id = max(first_id, row[0] + 1)
        except sqlite3.Error as error:
            if error.sqlite_errorcode == sqlite3.SQLITE_INTERRUPT:
                # the limit of steps is reached, so the other ranges count as lost
                spans.append((first_id, last_id))
                break
            middle_id = (first_id + last_id) // 2
            half_spans = [(first_id, middle_id), (middle_id + 1, last_id)] if first_id < last_id else []
            spans.extend(half_spans)
            lost_spans.update([] if half_spans else [(first_id, last_id)])
    lost_spans.update(spans)
    return sorted(row_by_id.values()), lost_spans


def _all_ids(database: sqlite3.Connection) -> _Span:
    """Return the range of ids that messages can have."""
    try:
        ((first_id, last_id),) = database.execute(
            "SELECT (SELECT min(rowid) FROM messages NOT INDEXED),"
            " (SELECT max(rowid) FROM messages NOT INDEXED)"
        )
        if type(first_id) is type(last_id) is int:
            return first_id, last_id
    except sqlite3.Error:
        pass
    # recorders number messages from 1 on, and a message takes at least 8 bytes
    (page_count,), (page_bytes,) = (
        database.execute(f"PRAGMA {name}").fetchone() for name in ("page_count", "page_size")
    )
    return 0, int(page_count * page_bytes) // 8


def _contents(database: sqlite3.Connection, row_heads: Sequence[RowHead], lost: set[_Span]) -> Iterator[Row]:
    """Yield rows with their contents; ids of unreadable rows go to `lost`."""
    for index, (row_id, *_) in enumerate(row_heads):
        try:
            yield from database.execute(
                "SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED WHERE rowid = ?", (row_id,)
            )
        except sqlite3.Error as error:
            if error.sqlite_errorcode == sqlite3.SQLITE_INTERRUPT:
                lost.update((row_number, row_number) for row_number, *_ in row_heads[index:])
                return
            lost.add((row_id, row_id))


def _joined_spans(spans: Collection[_Span]) -> list[_Span]:
    """Return sorted ranges of ids; adjacent ranges are merged."""
    joined_spans: list[_Span] = []
    for first_id, last_id in sorted(spans):
        if joined_spans and first_id <= joined_spans[-1][1] + 1:
            joined_spans[-1] = joined_spans[-1][0], max(last_id, joined_spans[-1][1])
        else:
            joined_spans.append((first_id, last_id))
    return joined_spans


def _records(database: sqlite3.Connection, table: str) -> list[dict[str, object]]:
    """Return the rows of a small table; columns vary with the ROS release that wrote the table."""
    cursor = database.execute(f"SELECT * FROM {table} LIMIT {_MOST_TOPICS}")
    column_names = [column[0] for column in cursor.description]
    return [dict(zip(column_names, row, strict=True)) for row in cursor]


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
        metadata_text = row.get("metadata")
        if isinstance(metadata_text, str) and metadata_text.strip():
            return bag_metadata_from_bytes(metadata_text.encode())
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
