"""ROS 1 bags, whole or damaged.

The reader is our own because rosbags refuses bags with any damage, and bags without an index. Interrupted
recorders leave such bags behind. Our reader loses only the damaged chunks, and reports each of them.
"""

from __future__ import annotations

import bz2
import os
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from types import MappingProxyType
from typing import BinaryIO, NamedTuple

import lz4.frame
import numpy as np
from numpy.typing import NDArray

from spatial_replay.bags.decoders import Topic, channel_of, topics_by_name
from spatial_replay.bags.definitions import full_type_name
from spatial_replay.bags.reader import Columns, MessageColumns, MessageReader, in_order, places_in
from spatial_replay.compiled import kernel, piece
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.mcap.index import LARGEST_CHUNK, DamageError
from spatial_replay.logs.mcap.read import ALWAYS_ALLOWED, MOST_TIMES_LARGER, most_waiting
from spatial_replay.logs.messages import Channel, Schema
from spatial_replay.logs.read_options import FaultList
from spatial_replay.text import Instant, Sentence

BAG_MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
LONGEST_HEAD = 2**20
_SECOND_NS = 1_000_000_000
# first letters of the fields op, conn and time
_C, _I, _O, _P, _T = b"ciopt"
# a definition whose first field is a header; blank lines, comments and constants may come before it
_HEADER_FIRST = re.compile(rb"(?:[ \t]*(?:#[^\n]*)?\n|[^\n=#]*=[^\n]*\n)*[ \t]*(?:std_msgs/)?Header[ \t]")


class RecordTable(NamedTuple):
    """N records of a chunk, in their order.

    Attributes:
        opcode, connection, time_ns: (N,) int64; -1 if the head lacks the field.
        head: (N,) int64, offset of the head's fields.
        begin, end: (N,) int64, bounds of the data.
    """

    opcode: Integers
    connection: Integers
    time_ns: Integers
    head: Integers
    begin: Integers
    end: Integers


def fields_of(head: bytes) -> dict[str, bytes]:
    """Parse the fields of a record's head, or of a connection's data, by name.

    Raises:
        DamageError: the fields do not fill the bytes exactly.
    """
    fields: dict[str, bytes] = {}
    position = 0
    while position < len(head):
        begin = position + 4
        position = begin + int.from_bytes(head[position:begin], "little")
        if position > len(head):
            raise DamageError("a record's head breaks off")
        name, separator, value = head[begin:position].partition(b"=")
        if not separator:
            raise DamageError("a field of a record's head has no name")
        fields[name.decode("latin-1")] = value
    return fields


def number(fields: dict[str, bytes], name: str, size: int = 4) -> int:
    """Return the little-endian number of `size` bytes in a field.

    Raises:
        DamageError: the field is missing, or has another size.
    """
    value = fields.get(name, b"")
    if len(value) != size:
        raise DamageError(f"a record has no field {name!r} of {size} bytes")
    return int.from_bytes(value, "little")


def time_from(value: int) -> int:
    """Convert a time to nanoseconds: seconds in the lower half of a word, nanoseconds in the upper."""
    return (value & 0xFFFFFFFF) * _SECOND_NS + (value >> 32)


def decompress_chunk(compression: bytes, data: bytes, size: int) -> bytes:
    """Decompress the records of a chunk.

    Raises:
        DamageError: the records do not decompress to `size` bytes.
    """
    most_bytes = max(ALWAYS_ALLOWED, MOST_TIMES_LARGER * len(data))
    if size > LARGEST_CHUNK or (compression != b"none" and size > most_bytes):
        raise DamageError(f"the chunk claims to hold {size} bytes in {len(data)}")
    try:
        match compression:
            case b"none":
                content = data
            case b"bz2":
                # one more byte reveals a chunk that is larger than its head says
                content = bz2.BZ2Decompressor().decompress(data, size + 1)
            case b"lz4":
                content = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
            case _:
                raise DamageError(f"the chunk is compressed as {compression!r:.40}; known are none, bz2, lz4")
    except (OSError, RuntimeError, EOFError, ValueError) as error:
        raise DamageError(f"the chunk does not decompress ({error})") from None
    if len(content) != size:
        raise DamageError(f"the chunk holds {len(content)} bytes instead of {size}")
    return content


def record_table(content: bytes) -> tuple[RecordTable, bool]:
    """Return the records in a chunk's content, and whether the last record breaks off."""
    view = np.frombuffer(content, np.uint8)
    # the first walk only counts the records, so its table is empty
    record_count, _ = _walk(view, np.empty((6, 0), np.int64))
    table = np.empty((6, record_count), np.int64)
    _, end_offset = _walk(view, table)
    return RecordTable(*table), end_offset < len(content)


@piece
def _u32(content: NDArray[np.uint8], at: int) -> int:
    """Return a little-endian word."""
    word = 0
    for byte_index in range(4):
        word += int(content[at + byte_index]) << (8 * byte_index)
    return word


@piece
def _head(content: NDArray[np.uint8], head: int, data: int) -> tuple[int, int, int]:
    """Return opcode, connection and time in the fields of a head; a missing field is -1."""
    opcode = connection = time_ns = -1
    position = head
    while position + 4 <= data:
        length = _u32(content, position)
        position += 4
        if position + length > data:
            break
        first_letter, second_letter = content[position], content[position + 1]
        if length == 4 and first_letter == _O and second_letter == _P:
            opcode = int(content[position + 3])
        elif length == 9 and first_letter == _C and second_letter == _O:
            connection = _u32(content, position + 5)
        elif length == 13 and first_letter == _T and second_letter == _I:
            time_ns = _u32(content, position + 5) * _SECOND_NS + _u32(content, position + 9)
        position += length
    return (opcode if position == data else -1), connection, time_ns


@kernel
def _walk(content: NDArray[np.uint8], table: NDArray[np.int64]) -> tuple[int, int]:
    """Fill the table's columns; return the number of complete records, and the end of the last record."""
    size = content.shape[0]
    position = 0
    count = 0
    while position + 8 <= size:
        head = position + 4
        data = head + _u32(content, position)
        if data + 4 > size:
            break
        begin = data + 4
        end = begin + _u32(content, data)
        if end > size:
            break
        opcode, connection, time_ns = _head(content, head, data)
        if opcode < 0:
            break
        if count < table.shape[1]:
            table[0, count], table[1, count], table[2, count] = opcode, connection, time_ns
            table[3, count], table[4, count], table[5, count] = head, begin, end
        position = end
        count += 1
    return count, position


_STRIDE = 2**20
# the field op of a chunk's head, with its length: http://wiki.ros.org/Bags/Format/2.0
_CHUNK_MARK = b"\x04\x00\x00\x00op=\x05"
_BEFORE_MARK = (4, 17, 23, 24, 36, 37)
"""Possible offsets of the opcode field in a chunk's record, bytes; other fields may come first."""
_CHUNK_HEAD_BYTES = range(20, 80)
_MOST_GAPS, _MOST_MARKS = 1_000, 100_000
"""Limits of damaged parts, and of possible chunks. Beyond a limit, the rest of a file is not searched."""


@dataclass(frozen=True, slots=True)
class Connection:
    """A publisher of a topic, as the bag describes it.

    Attributes:
        data: fields of the description: type, md5sum, message_definition and others.
    """

    number: int
    topic: str
    data: Mapping[str, bytes] = field(hash=False)

    @property
    def type(self) -> str:
        return self.data.get("type", b"").decode("utf-8", "replace")

    @property
    def is_latched(self) -> bool:
        return self.data.get("latching") == b"1"

    @property
    def begins_with_header(self) -> bool:
        return _HEADER_FIRST.match(self.data.get("message_definition", b"")) is not None


@dataclass(frozen=True, slots=True)
class BagChunk:
    """Place and content of a chunk.

    Attributes:
        offset: offset of the chunk's record in the file.
        counts: number of messages of each connection; None if only reading the chunk shows the numbers.
    """

    offset: int
    start_ns: int
    end_ns: int
    counts: Mapping[int, int] | None = field(hash=False)


@dataclass(slots=True)
class BagDirectory:
    """Connections by number, and chunks in file order.

    Attributes:
        is_indexed: whether the bag's own index was read.
    """

    connections: dict[int, Connection] = field(default_factory=dict)
    chunks: list[BagChunk] = field(default_factory=list)
    is_indexed: bool = False


@dataclass(frozen=True, slots=True)
class _Record:
    """A record in the file: the fields of its head, and the place of its data.

    Attributes:
        missing_bytes: number of missing bytes in an uncompressed chunk at the end of a truncated file.
    """

    fields: dict[str, bytes]
    data_offset: int
    length: int
    missing_bytes: int = 0

    @property
    def opcode(self) -> int:
        return number(self.fields, "op", 1)

    @property
    def next_offset(self) -> int:
        return self.data_offset + self.length


def read_chunk(stream: BinaryIO, offset: int) -> bytes:
    """Read and decompress the chunk at an offset.

    Raises:
        DamageError: the record breaks off, is no chunk, or does not decompress.
    """
    record = _record(stream, offset, stream.seek(0, os.SEEK_END))
    if record.opcode != CHUNK:
        raise DamageError("there is no chunk")
    return _content(stream, record)


def connections_in(content: bytes, table: RecordTable) -> Iterator[Connection]:
    """Yield the connections that a chunk declares.

    Raises:
        DamageError: a connection cannot be read.
    """
    for row in (table.opcode == CONNECTION).nonzero()[0].tolist():
        begin, end = int(table.begin[row]), int(table.end[row])
        yield _connection(fields_of(content[int(table.head[row]) : begin - 4]), content[begin:end])


def _from_index(stream: BinaryIO, size: int) -> BagDirectory:
    header = _record(stream, len(BAG_MAGIC), size)
    if header.opcode != BAG_HEADER:
        raise DamageError("the bag's header is damaged")
    position = number(header.fields, "index_pos", 8)
    if not header.next_offset <= position <= size:
        raise DamageError("the bag has no index; its writer was interrupted or the file is cut")
    directory = BagDirectory(is_indexed=True)
    while position < size:
        record = _record(stream, position, size)
        if record.opcode == CONNECTION:
            connection = _connection(record.fields, _data(stream, record))
            directory.connections[connection.number] = connection
        elif record.opcode == CHUNK_INFO:
            directory.chunks.append(_chunk_info(record.fields, _data(stream, record)))
        else:
            raise DamageError(f"the index has an unexpected record (op {record.opcode})")
        position = record.next_offset
    declared_counts = number(header.fields, "conn_count"), number(header.fields, "chunk_count")
    if declared_counts != (len(directory.connections), len(directory.chunks)):
        raise DamageError("the index does not hold as many connections and chunks as the bag's header says")
    unknown = {connection for chunk in directory.chunks for connection in chunk.counts or {}} - set(
        directory.connections
    )
    if unknown:
        raise DamageError(f"the index counts messages of a connection {min(unknown)} that it does not have")
    directory.chunks.sort(key=lambda chunk: chunk.offset)
    return directory


def _chunk_info(fields: dict[str, bytes], data: bytes) -> BagChunk:
    if number(fields, "ver") != 1 or number(fields, "count") * 8 != len(data):
        raise DamageError("the index describes a chunk in an unknown version")
    words = [int.from_bytes(data[offset : offset + 4], "little") for offset in range(0, len(data), 4)]
    return BagChunk(
        number(fields, "chunk_pos", 8),
        time_from(number(fields, "start_time", 8)),
        time_from(number(fields, "end_time", 8)),
        dict(zip(words[::2], words[1::2], strict=True)),
    )


def _connection(fields: dict[str, bytes], data: bytes) -> Connection:
    topic = fields.get("topic", b"").decode("utf-8", "replace")
    return Connection(number(fields, "conn"), topic, fields_of(data))


def _record(stream: BinaryIO, position: int, size: int) -> _Record:
    if position > size:
        raise DamageError("the place lies outside the file")
    stream.seek(position)
    head_length = _word(stream)
    if head_length > min(LONGEST_HEAD, size - position):
        raise DamageError("a record's head is inconsistent")
    fields = fields_of(stream.read(head_length))
    length = _word(stream)
    data_offset = stream.tell()
    missing_bytes = max(0, data_offset + length - size)
    record = _Record(fields, data_offset, length - missing_bytes, missing_bytes)
    if missing_bytes and not (
        record.opcode == CHUNK and fields.get("compression") == b"none" and number(fields, "size") == length
    ):
        raise DamageError("the file breaks off in a record")
    return record


def _word(stream: BinaryIO) -> int:
    word = stream.read(4)
    if len(word) < 4:
        raise DamageError("the file breaks off")
    return int.from_bytes(word, "little")


def _data(stream: BinaryIO, record: _Record) -> bytes:
    if record.length > LARGEST_CHUNK:
        raise DamageError(f"a record claims to hold {record.length} bytes")
    stream.seek(record.data_offset)
    return stream.read(record.length)


def _content(stream: BinaryIO, record: _Record) -> bytes:
    compression = record.fields.get("compression", b"")
    size = number(record.fields, "size") - record.missing_bytes
    content = decompress_chunk(compression, _data(stream, record), size)
    if record.missing_bytes:
        # the scan of the file reports the loss
        table, _ = record_table(content)
        content = content[: int(table.end.max(initial=0))]
    return content


class _Scan:
    """A scan of the records of a file, which reads chunks for their times and connections."""

    def __init__(self, stream: BinaryIO, size: int, faults: FaultList, name: str) -> None:
        self._stream = stream
        self._file_bytes = size
        self._faults = faults
        self._name = name
        self._directory = BagDirectory()
        self._mark_count = 0

    def directory(self) -> BagDirectory:
        position = len(BAG_MAGIC)
        gap_count = 0
        while position < self._file_bytes:
            try:
                position = self._read_record(position)
            except DamageError as damage:
                gap_count += 1
                next_offset = self._next_chunk(position + 1) if gap_count < _MOST_GAPS else None
                self._lose(position, damage, (next_offset or self._file_bytes) - position)
                if next_offset is None:
                    break
                position = next_offset
        return self._directory

    def _lose(self, position: int, damage: DamageError | str, lost_bytes: int) -> None:
        self._faults.add(f"{self._name}: at byte {position}: {damage}; {lost_bytes} bytes cannot be read")

    def _read_record(self, position: int) -> int:
        """Read the record at a position; return the position of the next record."""
        record = _record(self._stream, position, self._file_bytes)
        if record.opcode == CHUNK:
            self._chunk(position, record)
        elif record.opcode == CONNECTION:
            connection = _connection(record.fields, _data(self._stream, record))
            self._directory.connections.setdefault(connection.number, connection)
        elif record.opcode not in (BAG_HEADER, INDEX, CHUNK_INFO):
            raise DamageError(f"there is no known record (op {record.opcode})")
        return record.next_offset

    def _chunk(self, position: int, record: _Record) -> None:
        content = _content(self._stream, record)
        table, _ = record_table(content)
        for connection in connections_in(content, table):
            self._directory.connections.setdefault(connection.number, connection)
        if record.missing_bytes:
            self._lose(
                position,
                "the file breaks off in a chunk",
                record.missing_bytes + record.length - len(content),
            )
        is_message = table.opcode == MESSAGE
        if is_message.any():
            times_ns = table.time_ns[is_message]
            counts = Counter(table.connection[is_message].tolist())
            self._directory.chunks.append(
                BagChunk(position, int(times_ns.min()), int(times_ns.max()), counts)
            )

    def _next_chunk(self, position: int) -> int | None:
        """Return the offset of the next chunk with a consistent head; None if no chunk follows a position."""
        overlap_bytes = max(_CHUNK_HEAD_BYTES) + len(_CHUNK_MARK)
        while position < self._file_bytes:
            self._stream.seek(position)
            window = self._stream.read(_STRIDE + overlap_bytes)
            mark_offset = window.find(_CHUNK_MARK)
            while mark_offset >= 0:
                self._mark_count += 1
                if self._mark_count > _MOST_MARKS:
                    return None
                for begin in (mark_offset - distance for distance in reversed(_BEFORE_MARK)):
                    length = int.from_bytes(window[max(0, begin) : max(0, begin) + 4], "little")
                    if begin >= 0 and length in _CHUNK_HEAD_BYTES and self._is_chunk(position + begin):
                        return position + begin
                mark_offset = window.find(_CHUNK_MARK, mark_offset + 1)
            position += _STRIDE
        return None

    def _is_chunk(self, position: int) -> bool:
        try:
            record = _record(self._stream, position, self._file_bytes)
            return record.opcode == CHUNK and "compression" in record.fields and "size" in record.fields
        except DamageError:
            return False


class Ros1Bag(MessageReader):
    """A ROS 1 bag, read chunk by chunk."""

    kind = "ROS 1 bag"

    @cached_property
    def _directory(self) -> BagDirectory:
        with self._path.open("rb") as stream:
            size = stream.seek(0, os.SEEK_END)
            try:
                return _from_index(stream, size)
            except DamageError as damage:
                self._faults.add(f"{self.name}: {damage}; the bag was read without its index")
                return _Scan(stream, size, self._faults, self.name).directory()

    @cached_property
    def _topics(self) -> tuple[Topic, ...]:
        counts: Counter[int] = Counter()
        for chunk in self._directory.chunks:
            counts.update(chunk.counts or {})
        return topics_by_name(
            self._topic(connection, counts[connection.number])
            for connection in self._directory.connections.values()
        )

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message."""
        return min((chunk.start_ns for chunk in self._directory.chunks), default=None)

    def _read(self, topics: Collection[str], first_ns: int, end_ns: int, *, as_recorded: bool) -> Columns:
        connections = {
            number: self._directory.connections[number] for number in self._channel_numbers(topics)
        }
        chunks = [
            (rank, chunk)
            for rank, chunk in enumerate(self._directory.chunks)
            if chunk.start_ns < end_ns
            and chunk.end_ns >= first_ns
            and (chunk.counts is None or not connections.keys().isdisjoint(chunk.counts))
        ]
        if not as_recorded:
            chunks.sort(key=lambda ranked: ranked[1].start_ns)
            if self._is_in_parts:
                chunks = [(rank, chunk) for rank, (_, chunk) in enumerate(chunks)]
        with self._path.open("rb") as stream:
            chunk_columns = (
                self._messages(stream, *ranked, connections, first_ns, end_ns) for ranked in chunks
            )
            if as_recorded:
                yield from chunk_columns
                return
            most_bytes = most_waiting([self._path.stat().st_size])
            yield from in_order([chunk.start_ns for _, chunk in chunks], chunk_columns, self.name, most_bytes)

    @cached_property
    def _is_in_parts(self) -> bool:
        """Whether chunks do not overlap in time; such chunks are read by time, not by place in the file.

        Players read a bag by its index. Tools that merge or repair bags write chunks in any order.
        """
        sorted_chunks = sorted(self._directory.chunks, key=lambda chunk: (chunk.start_ns, chunk.end_ns))
        return all(before.end_ns <= after.start_ns for before, after in pairwise(sorted_chunks))

    @cached_property
    def _declared(self) -> Mapping[int, Channel]:
        connections = self._directory.connections
        return {number: channel_of(self._topic(connection, 0)) for number, connection in connections.items()}

    def _messages(
        self,
        stream: BinaryIO,
        rank: int,
        chunk: BagChunk,
        connections: dict[int, Connection],
        first_ns: int,
        end_ns: int,
    ) -> MessageColumns:
        span = Sentence("messages between ", Instant(chunk.start_ns, 0), " and ", Instant(chunk.end_ns, 0))
        try:
            content = read_chunk(stream, chunk.offset)
        except DamageError as damage:
            self._fault(chunk, Sentence(f"{damage}; the ", span, " are lost"))
            return MessageColumns(self._channels)
        table, breaks_off = record_table(content)
        if breaks_off:
            self._fault(chunk, Sentence("a record breaks off; some of the ", span, " are lost"))
        try:
            for connection in connections_in(content, table):
                if connections.get(connection.number, connection) != connection:
                    self._fault(chunk, f"connection {connection.number} is described in two ways")
        except DamageError as damage:
            self._fault(chunk, f"{damage}; a connection is described there")
        is_message = table.opcode == MESSAGE
        if (chunk.start_ns, chunk.end_ns) != _span(table.time_ns[is_message]):
            self._fault(chunk, Sentence("the ", span, " have other times than the index says"))
        is_wanted = is_message & np.isin(table.connection, list(connections))
        is_wanted &= (table.time_ns >= first_ns) & (table.time_ns < end_ns)
        payload_bounds = zip(table.begin[is_wanted].tolist(), table.end[is_wanted].tolist(), strict=True)
        payloads = [content[begin:end] for begin, end in payload_bounds]
        connection_numbers = table.connection[is_wanted].tolist()
        # a header begins with the sequence number of its publisher; several publishers have no common order
        publisher_counts = Counter(connection.topic for connection in connections.values())
        headed_numbers = {
            number
            for number, connection in connections.items()
            if publisher_counts[connection.topic] == 1 and connection.begins_with_header
        }
        sequence_numbers = [
            int.from_bytes(payload[:4], "little") if number in headed_numbers else 0
            for number, payload in zip(connection_numbers, payloads, strict=True)
        ]
        times_ns = table.time_ns[is_wanted]
        return self._make_columns(
            table.connection[is_wanted],
            (times_ns, times_ns),
            np.array(sequence_numbers, np.int64),
            payloads,
            places_in(rank, np.flatnonzero(is_wanted)),
        )

    def _topic(self, connection: Connection, count: int) -> Topic:
        definition = connection.data.get("message_definition", b"")
        return Topic(
            name=connection.topic,
            type=full_type_name(connection.type),
            encoding="ros1",
            # a scan counts only the readable chunks, so the scan's count shows no loss
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
