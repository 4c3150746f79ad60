"""The directory of an MCAP file: its chunks and attachments, from its summary or from a scan.

Summaries are optional, and an interrupted recorder writes none. A file without a summary is scanned from its
beginning. A damaged part is skipped up to the next chunk with a consistent head.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from heapq import merge
from io import BytesIO
from types import MappingProxyType
from typing import BinaryIO, NamedTuple, TypeVar
from zlib import crc32

from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode

from spatial_replay.logs.messages import Attachment
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.topics import LIBRARY, MAGIC
from spatial_replay.text import Instant, Sentence

RECORD_HEAD = struct.Struct("<BQ")
"""Head of a record: opcode, and length of the body that follows."""
CHUNK_HEAD = struct.Struct("<QQQII")
"""Head of a chunk: first and last time, size, checksum, and length of the compression's name."""
LARGEST_CHUNK = 2**30
"""Largest chunk, uncompressed, bytes; a chunk that claims more is damaged."""

_Record = TypeVar("_Record")


class DamageError(Exception):
    """Damaged bytes. The text describes the damage; the handler adds the place."""


def encode_records(*several: records.McapRecord) -> bytes:
    """Encode and concatenate records, each with its head."""
    builder = RecordBuilder()
    for record in several:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def decode_record(read: Callable[[ReadDataStream], _Record], body: bytes) -> _Record:
    """Decode the body of a record.

    Raises:
        DamageError: the body is too short, or holds impossible lengths or texts that are not UTF-8.
    """
    try:
        return read(ReadDataStream(BytesIO(body)))
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise DamageError(f"a record cannot be read ({type(error).__name__}: {error})") from None


class ChunkPlace(NamedTuple):
    """Place of a chunk in the file, or of consecutive messages outside chunks.

    Attributes:
        offset, length: place of the record with its head, bytes.
        start_ns, end_ns: log times of the first and the last message.
        compressed: whether the place is a chunk; False for messages outside chunks.
        channels: channels of the messages, from the index; None if the index lists no channels.
        has_checksum: whether each chunk must have a checksum, as in our own logs.
        size: decompressed size of a chunk, from the index or its head, bytes; 0 outside chunks.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    compressed: bool = True
    channels: frozenset[int] | None = None
    has_checksum: bool = False
    size: int = 0


def chunk_place(offset: int, record: bytes, length: int) -> ChunkPlace:
    """Return the place of a chunk from the beginning of its record.

    Args:
        record: first bytes of the record, at least 64 unless the file ends earlier.
        length: length of the record with its head, bytes.

    Raises:
        DamageError: the head of the chunk is inconsistent.
    """
    fixed_bytes = RECORD_HEAD.size + CHUNK_HEAD.size
    if len(record) < fixed_bytes:
        raise DamageError("a chunk breaks off")
    start_ns, end_ns, size, _, name_length = CHUNK_HEAD.unpack_from(record, RECORD_HEAD.size)
    size_offset = fixed_bytes + name_length
    if name_length > 16 or len(record) < size_offset + 8:
        raise DamageError("a chunk's head is inconsistent")
    data_bytes = int.from_bytes(record[size_offset : size_offset + 8], "little")
    if size_offset + 8 + data_bytes != length or size > LARGEST_CHUNK or not start_ns <= end_ns < 2**63:
        raise DamageError("a chunk's head is inconsistent")
    return ChunkPlace(offset, length, start_ns, end_ns, size=size)


def _uncompressed_content(offset: int, record: bytes, next_offset: int) -> int | None:
    """Return the offset of the records in an uncompressed chunk; None for any other record."""
    if record[0] != Opcode.CHUNK:
        return None
    with suppress(DamageError):
        content_bytes = chunk_place(offset, record, next_offset - offset).size
        if next_offset - offset == _UNCOMPRESSED_HEAD_BYTES + content_bytes:
            return offset + _UNCOMPRESSED_HEAD_BYTES
    return None


_UNCOMPRESSED_HEAD_BYTES = RECORD_HEAD.size + CHUNK_HEAD.size + 8
"""Offset of the records in an uncompressed chunk, bytes."""
_FOOTER_BYTES = RECORD_HEAD.size + 20
_CHUNK_HEAD_BYTES = 64
_CHUNK_INDEX = struct.Struct("<QQQQI")
_SIZE_BYTES = 8
"""Length of the decompressed size, the last field of a chunk index, bytes."""
_MESSAGE_INDEX = struct.Struct("<H8x")
"""Channel and offset of a message index; the offset is not read."""
_LOOSE_BYTES = 2**22
"""Maximum size of a read of messages outside chunks, bytes; single reads would take a seek per message."""
_LARGEST_RECORD = 2**30
_STRIDE = 2**20
"""Read size of a search for the next chunk, bytes."""
_MOST_GAPS = 1_000
"""Number of damaged parts after which the rest of a file is not searched."""
# a chunk has no magic bytes, so a search looks for a compression's name after the name's length:
# https://mcap.dev/spec#chunk-op0x06
_COMPRESSIONS = (b"\x04\x00\x00\x00zstd", b"\x03\x00\x00\x00lz4")
_BEFORE_COMPRESSION = RECORD_HEAD.size + 28


@dataclass(slots=True)
class Directory:
    """Places of records in a file, and the declarations outside chunks.

    Attributes:
        header: header record; None for an unreadable header.
        schemas, channels: declarations outside chunks, by number.
        chunks: places of chunks, in file order.
        attachments, metadata: offset and length of each record with its head, bytes.
        statistics: statistics of the summary; None without a summary.
        skipped: number of records with reserved opcodes that a scan skipped.
    """

    header: records.Header | None = None
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    chunks: list[ChunkPlace] = field(default_factory=list)
    attachments: list[tuple[int, int]] = field(default_factory=list)
    metadata: list[tuple[int, int]] = field(default_factory=list)
    statistics: records.Statistics | None = None
    skipped: int = 0


def read_directory(stream: BinaryIO, faults: FaultList, name: str) -> Directory:
    """Read the directory of an MCAP file; damage goes to `faults`."""
    file_bytes = stream.seek(0, os.SEEK_END)
    try:
        directory = _from_summary(stream, file_bytes)
    except _NoSummaryError:
        directory = _Scan(stream, file_bytes, faults, name).directory()
    except DamageError as damage:
        fault_count = len(faults)
        directory = _Scan(stream, file_bytes, faults, name).directory()
        if len(faults) == fault_count:
            faults.add(f"{name}: {damage}; the log was read without its index")
    if _is_own(directory.header):
        directory.chunks = [place._replace(has_checksum=True) for place in directory.chunks]
    return directory


def _is_own(header: records.Header | None) -> bool:
    """Return whether our writer wrote a log. Our logs have all checksums, so a missing checksum is damage."""
    return header is not None and header.library == LIBRARY


def has_summary(stream: BinaryIO) -> bool:
    """Return whether a file ends with a footer that points to a summary; other files are scanned."""
    tail = _tail(stream, stream.seek(0, os.SEEK_END))
    return any(tail[RECORD_HEAD.size : RECORD_HEAD.size + 8])


def _tail(stream: BinaryIO, size: int) -> bytes:
    """Return the footer and the closing magic of a file; b"" without a footer."""
    stream.seek(max(0, size - _FOOTER_BYTES - len(MAGIC)))
    tail = stream.read()
    return tail if tail.endswith(MAGIC) and tail.startswith(RECORD_HEAD.pack(Opcode.FOOTER, 20)) else b""


class _NoSummaryError(Exception):
    """A file without a complete summary; other writers may leave out parts of a summary."""


def _from_summary(stream: BinaryIO, size: int) -> Directory:
    """Read the directory from a file's own summary.

    Raises:
        _NoSummaryError: the summary is missing or incomplete.
        DamageError: the end of the file is missing or damaged.
    """
    directory = Directory(header=_header(stream))
    tail = _tail(stream, size)
    if not tail:
        raise DamageError("the file ends without a footer; its writer was interrupted")
    footer = decode_record(records.Footer.read, tail[RECORD_HEAD.size :])
    if footer.summary_start == 0:
        raise _NoSummaryError
    if not len(MAGIC) <= footer.summary_start <= size - len(tail):
        raise DamageError("the footer points outside the file")
    stream.seek(footer.summary_start)
    section = stream.read(size - len(tail) - footer.summary_start)
    has_checksum = footer.summary_crc or _is_own(directory.header)
    if has_checksum and crc32(section + tail[: _FOOTER_BYTES - 4]) != footer.summary_crc:
        raise DamageError("the summary's checksum does not fit")
    position = 0
    while position < len(section):
        opcode, body = _body(section, position)
        _add_record(directory, opcode, body)
        position += RECORD_HEAD.size + len(body)
    _check_complete(directory, footer.summary_start)
    directory.chunks.sort(key=lambda place: place.offset)
    return directory


def _header(stream: BinaryIO) -> records.Header | None:
    stream.seek(len(MAGIC))
    head = stream.read(RECORD_HEAD.size)
    if len(head) < RECORD_HEAD.size:
        return None
    opcode, length = RECORD_HEAD.unpack(head)
    if opcode != Opcode.HEADER or length > _STRIDE:
        raise DamageError("the header is damaged")
    header: records.Header = decode_record(records.Header.read, stream.read(length))
    return header


def _body(section: bytes, position: int) -> tuple[int, bytes]:
    """Return the opcode and the body of the record at a position."""
    if len(section) - position < RECORD_HEAD.size:
        raise DamageError("the summary breaks off")
    opcode, length = RECORD_HEAD.unpack_from(section, position)
    position += RECORD_HEAD.size
    if length > len(section) - position:
        raise DamageError("the summary breaks off")
    return opcode, section[position : position + length]


def _add_record(directory: Directory, opcode: int, body: bytes) -> None:
    if opcode == Opcode.SCHEMA:
        schema = decode_record(records.Schema.read, body)
        directory.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = decode_record(records.Channel.read, body)
        directory.channels[channel.id] = channel
    elif opcode == Opcode.STATISTICS:
        directory.statistics = decode_record(records.Statistics.read, body)
    elif opcode == Opcode.CHUNK_INDEX:
        if len(body) < _CHUNK_INDEX.size:
            raise DamageError("the index breaks off")
        start_ns, end_ns, offset, length, index_bytes = _CHUNK_INDEX.unpack_from(body)
        channels = _indexed_channels(body, index_bytes)
        size = int.from_bytes(body[-_SIZE_BYTES:], "little")
        place = ChunkPlace(offset, length, start_ns, end_ns, channels=channels, size=size)
        directory.chunks.append(place)
    elif opcode == Opcode.ATTACHMENT_INDEX:
        attachment = decode_record(records.AttachmentIndex.read, body)
        directory.attachments.append((attachment.offset, attachment.length))
    elif opcode == Opcode.METADATA_INDEX:
        metadata = decode_record(records.MetadataIndex.read, body)
        directory.metadata.append((metadata.offset, metadata.length))


def _indexed_channels(body: bytes, length: int) -> frozenset[int] | None:
    """Return the channels for which a chunk has a message index; None for a chunk without message indexes."""
    entries = body[_CHUNK_INDEX.size : _CHUNK_INDEX.size + length]
    if not entries or len(entries) != length or length % _MESSAGE_INDEX.size:
        return None
    return frozenset([channel for (channel,) in _MESSAGE_INDEX.iter_unpack(entries)])


def _check_complete(directory: Directory, data_end: int) -> None:
    """Check that a summary is complete; other writers may leave out parts of a summary.

    Raises:
        _NoSummaryError: the summary is incomplete.
        DamageError: the summary points outside the file.
    """
    statistics = directory.statistics
    kinds = ("schema", "channel", "chunk", "attachment", "metadata")
    stated = [getattr(statistics, f"{kind}_count", None) for kind in kinds]
    read_counts = len(directory.schemas), len(directory.channels), len(directory.chunks)
    if statistics is None or stated != [*read_counts, len(directory.attachments), len(directory.metadata)]:
        raise _NoSummaryError
    if statistics.message_count > 0 and not directory.chunks:
        raise _NoSummaryError
    spans = [(place.offset, place.length) for place in directory.chunks]
    if any(
        offset + length > data_end for offset, length in spans + directory.attachments + directory.metadata
    ):
        raise DamageError("the summary points outside the file")


class _Scan:
    """A scan of the records of a file, without the contents of the records.

    The records in an uncompressed chunk that breaks off are read as records outside chunks.
    """

    def __init__(self, stream: BinaryIO, size: int, faults: FaultList, name: str) -> None:
        self._stream = stream
        self._file_bytes = size
        # `_end` exceeds the file's size while the scan is inside a chunk that breaks off
        self._end = size
        self._faults = faults
        self._name = name
        self._directory = Directory()
        self._loose: ChunkPlace | None = None
        self._is_over = False

    def directory(self) -> Directory:
        position = sound_end = len(MAGIC)
        gap_count = 0
        while position < self._end and not self._is_over:
            try:
                position = self._record(position)
            except DamageError as damage:
                gap_count += 1
                next_chunk = self._next_chunk(sound_end) if gap_count < _MOST_GAPS else None
                self._lose(position, next_chunk, damage)
                self._end = self._file_bytes
                if next_chunk is None:
                    break
                position = next_chunk.offset
            if self._directory.chunks and self._directory.chunks[-1].compressed:
                sound_end = max(
                    sound_end, self._directory.chunks[-1].offset + self._directory.chunks[-1].length
                )
        self._end_loose()
        return self._directory

    def _lose(self, position: int, next_chunk: ChunkPlace | None, damage: DamageError) -> None:
        """Report the bytes from a position to the next chunk as lost, with the times around these bytes."""
        lost_bytes = max(0, (next_chunk.offset if next_chunk else self._end) - position)
        readable_ends_ns = [place.end_ns for place in (*self._directory.chunks, self._loose) if place]
        ends_before = [Instant(max(readable_ends_ns), 0)] if readable_ends_ns else []
        starts_after = [Instant(next_chunk.start_ns, 0)] if next_chunk else []
        time_words: tuple[str | Instant, ...] = ()
        if ends_before and starts_after:
            # chunks may overlap in time
            first_instant, last_instant = sorted(
                [*ends_before, *starts_after], key=lambda instant: instant.time_ns
            )
            time_words = (" between ", first_instant, " and ", last_instant)
        elif ends_before or starts_after:
            time_words = (" after " if ends_before else " before ", *ends_before, *starts_after)
        fault_text = f"{self._name}: at byte {position}: {damage}; {lost_bytes} bytes"
        self._faults.add(Sentence(fault_text, *time_words, " cannot be read"))

    def _record(self, position: int) -> int:
        """Read the record at a position; return the position of the next record."""
        self._stream.seek(position)
        beginning = self._stream.read(_CHUNK_HEAD_BYTES)
        if len(beginning) < RECORD_HEAD.size:
            raise DamageError("the file breaks off")
        opcode, length = RECORD_HEAD.unpack_from(beginning)
        next_position = int(position + RECORD_HEAD.size + length)
        if opcode == 0:
            raise DamageError(f"there is no record (opcode {opcode})")
        if next_position > self._file_bytes:
            content_position = _uncompressed_content(position, beginning, next_position)
            if content_position is None or self._end > self._file_bytes:
                raise DamageError("the file breaks off in a " + ("chunk" if content_position else "record"))
            self._end_loose()
            self._end = next_position
            return content_position
        # opcodes below 0x80 are reserved for later versions of the format: https://mcap.dev/spec#records
        if max(Opcode) < opcode < 0x80:
            self._skip(opcode, beginning, next_position)
        if opcode == Opcode.CHUNK:
            self._end_loose()
            self._directory.chunks.append(chunk_place(position, beginning, RECORD_HEAD.size + length))
        elif opcode == Opcode.MESSAGE:
            self._message(position, beginning, next_position)
        elif opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL):
            if length > _LARGEST_RECORD:
                raise DamageError(f"a record claims to hold {length} bytes")
            self._stream.seek(position + RECORD_HEAD.size)
            body = self._stream.read(length)
            if opcode == Opcode.HEADER:
                self._directory.header = decode_record(records.Header.read, body)
            else:
                _add_record(self._directory, opcode, body)
        elif opcode == Opcode.ATTACHMENT:
            self._directory.attachments.append((position, next_position - position))
        elif opcode == Opcode.METADATA:
            self._directory.metadata.append((position, next_position - position))
        elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
            if self._end > self._file_bytes:
                raise DamageError("the data end within a chunk")
            # damage can look like the end of the data
            if self._next_chunk(next_position) is not None:
                raise DamageError("the data end before the last chunk")
            # the summary section repeats records that were read already
            self._is_over = True
        return next_position

    def _skip(self, opcode: int, beginning: bytes, next_position: int) -> None:
        """Count a record with a reserved opcode.

        Raises:
            DamageError: no record follows the record, or the bytes are a chunk with a damaged opcode.
        """
        self._stream.seek(next_position)
        head = self._stream.read(RECORD_HEAD.size)
        is_followed = next_position == self._file_bytes - len(MAGIC)
        if len(head) == RECORD_HEAD.size:
            next_opcode, next_length = RECORD_HEAD.unpack(head)
            is_followed = is_followed or (
                next_opcode != 0 and next_position + RECORD_HEAD.size + next_length <= self._file_bytes
            )
        with suppress(DamageError):
            # the head fits a chunk, so only the opcode is damaged
            chunk_place(0, beginning, RECORD_HEAD.size + RECORD_HEAD.unpack_from(beginning)[1])
            is_followed = False
        if not is_followed:
            raise DamageError(f"there is no record (opcode {opcode})")
        self._directory.skipped += 1

    def _message(self, position: int, beginning: bytes, next_position: int) -> None:
        """Add a message outside chunks to the place of the previous messages."""
        if len(beginning) < RECORD_HEAD.size + 22 or next_position - position < RECORD_HEAD.size + 22:
            raise DamageError("a message breaks off")
        time_ns = int.from_bytes(beginning[RECORD_HEAD.size + 6 : RECORD_HEAD.size + 14], "little")
        loose = self._loose
        if loose and loose.offset + loose.length == position and loose.length < _LOOSE_BYTES:
            start_ns, end_ns = min(loose.start_ns, time_ns), max(loose.end_ns, time_ns)
            length = next_position - loose.offset
            self._loose = ChunkPlace(loose.offset, length, start_ns, end_ns, compressed=False)
        else:
            self._end_loose()
            self._loose = ChunkPlace(position, next_position - position, time_ns, time_ns, compressed=False)

    def _end_loose(self) -> None:
        if self._loose:
            self._directory.chunks.append(self._loose)
            self._loose = None

    def _next_chunk(self, position: int) -> ChunkPlace | None:
        """Return the next chunk with a consistent head, from a position on; None if no chunk follows."""
        # a chunk at the end of a window needs bytes of the next window
        overlap_bytes = _BEFORE_COMPRESSION + _CHUNK_HEAD_BYTES
        while position < self._file_bytes:
            self._stream.seek(position)
            window = self._stream.read(_STRIDE + overlap_bytes)
            # in file order, with both compressions
            for window_offset in merge(*(_iter_places(window, mark) for mark in _COMPRESSIONS)):
                record = window[window_offset : window_offset + _CHUNK_HEAD_BYTES]
                opcode, length = RECORD_HEAD.unpack_from(record)
                if (
                    opcode != Opcode.CHUNK
                    or position + window_offset + RECORD_HEAD.size + length > self._file_bytes
                ):
                    continue
                try:
                    return chunk_place(position + window_offset, record, RECORD_HEAD.size + length)
                except DamageError:
                    continue
            position += _STRIDE
        return None


def _iter_places(window: bytes, mark: bytes) -> Iterator[int]:
    """Yield the possible offsets of chunks in a window, in order.

    Args:
        mark: bytes that name the compression in the head of a chunk.
    """
    mark_offset = window.find(mark)
    while mark_offset >= 0:
        if mark_offset >= _BEFORE_COMPRESSION:
            yield mark_offset - _BEFORE_COMPRESSION
        mark_offset = window.find(mark, mark_offset + 1)


_ATTACHMENT_NUMBERS = 32
"""Bytes of the two times and three lengths of an attachment."""


def iter_attachments(
    stream: BinaryIO, directory: Directory, faults: FaultList, name: str
) -> Iterator[Attachment]:
    """Yield the readable attachments of a file; damaged attachments go to `faults`."""
    for offset, length in directory.attachments:
        stream.seek(offset + RECORD_HEAD.size)
        body = stream.read(length - RECORD_HEAD.size)
        try:
            record = decode_record(records.Attachment.read, body)
            # later versions of the format may append fields: https://mcap.dev/spec#records
            text_bytes = len(record.name.encode()) + len(record.media_type.encode())
            checked_bytes = _ATTACHMENT_NUMBERS + text_bytes + len(record.data)
            checksum = int.from_bytes(body[checked_bytes : checked_bytes + 4], "little")
            if (checksum or _is_own(directory.header)) and crc32(body[:checked_bytes]) != checksum:
                raise DamageError("an attachment's checksum does not fit")
        except DamageError as damage:
            faults.add(f"{name}: at byte {offset}: {damage}; the attachment is lost")
            continue
        yield Attachment(record.name, record.media_type, record.data, record.log_time, record.create_time)


def iter_metadata(
    stream: BinaryIO, directory: Directory, faults: FaultList, name: str
) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield the readable metadata records of a file with their names; damaged records go to `faults`."""
    for offset, length in directory.metadata:
        stream.seek(offset + RECORD_HEAD.size)
        try:
            record = decode_record(records.Metadata.read, stream.read(length - RECORD_HEAD.size))
        except DamageError as damage:
            faults.add(f"{name}: at byte {offset}: {damage}; the metadata is lost")
            continue
        yield record.name, MappingProxyType(record.metadata)


def check_attachments(stream: BinaryIO, directory: Directory, faults: FaultList, name: str) -> None:
    """Report damaged attachments and metadata to `faults`, because copies of the log lose these records."""
    for iter_records in (iter_attachments, iter_metadata):
        for _ in iter_records(stream, directory, faults, name):
            pass
