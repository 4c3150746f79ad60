"""Chunks of an MCAP log: checked, decompressed, and split into records in one compiled pass.

The reader is our own because the MCAP library fails 112 of the 416 files of the format's conformance suite
and gives up on truncated and unindexed files, which crashed recorders leave behind. It also yields one
object for each message, where we need a chunk's messages as columns.
"""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO, NamedTuple, TypeAlias, TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from numpy.typing import NDArray

from spatial_replay.compiled import elementwise, kernel
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.byte_ranges import plan_reads

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of the body that follows."""

_Record = TypeVar("_Record")


class DamageError(Exception):
    """Bytes that are not what they should be. The text says what is wrong; the catcher knows where."""


def encoded(*several: records.McapRecord) -> bytes:
    """Encode records one after the other, each with its head."""
    builder = RecordBuilder()
    for record in several:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def decoded(read: Callable[[ReadDataStream], _Record], body: bytes) -> _Record:
    """Decode the record in a body.

    Raises:
        DamageError: the body is too short, or holds impossible lengths or texts that are not UTF-8.
    """
    try:
        return read(ReadDataStream(BytesIO(body)))
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError) as error:
        raise DamageError(f"a record cannot be read ({type(error).__name__}: {error})") from None


Bytes = NDArray[np.uint8]
Words = NDArray[np.uint64]

_RECORD_HEAD = 9
_MESSAGE_FIELDS = np.dtype(
    [("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")]
)
_MESSAGE_BYTES = _MESSAGE_FIELDS.itemsize
_SCHEMA, _CHANNEL, _MESSAGE = 3, 4, 5


class RecordHeads(NamedTuple):
    """N schemas, channels and messages.

    Attributes:
        opcode: (N,) int64.
        begin, end: (N,) int64, where their bodies are.
        channel, sequence, log_time, publish_time: (N,) uint64, of messages; 0 for other records.
    """

    opcode: Integers
    begin: Integers
    end: Integers
    channel: Words
    sequence: Words
    log_time: Words
    publish_time: Words


def walk_records(content: bytes) -> tuple[RecordHeads, bool]:
    """Return the schemas, channels and messages in some bytes, and whether the last record breaks off."""
    view = np.frombuffer(content, np.uint8)
    # counted first: room for as many as there could be is many times the bytes
    count, _ = _walk(view, np.empty((3, 0), np.int64))
    places = np.empty((3, count), np.int64)
    _, end = _walk(view, places)
    is_message = places[0] == _MESSAGE
    heads = view[places[1, is_message][:, None] + np.arange(_MESSAGE_BYTES)].view(_MESSAGE_FIELDS)
    fields = np.zeros((4, count), np.uint64)
    for field, name in zip(fields, _MESSAGE_FIELDS.names or (), strict=True):
        field[is_message] = heads[name][:, 0]
    return RecordHeads(*places, *fields), end < len(content)


@elementwise
@kernel
def _walk(content: Bytes, places: Integers) -> tuple[int, int]:
    """Fill in the records that there is room for; return their number, and where the last whole one ends."""
    size = content.shape[0]
    position = 0
    count = 0
    while position + _RECORD_HEAD <= size:
        begin = position + _RECORD_HEAD
        # from the highest byte on, so that no length, however large, overflows
        length = 0
        for k in range(begin - 1, position, -1):
            length = min(256 * length + content[k], size)
        if length > size - begin:
            break
        end = begin + length
        opcode = content[position]
        is_message = opcode == _MESSAGE and end - begin >= _MESSAGE_BYTES
        if is_message or _SCHEMA <= opcode <= _CHANNEL:
            if count < places.shape[1]:
                places[0, count], places[1, count], places[2, count] = opcode, begin, end
            count += 1
        position = end
    return count, position


LARGEST_CHUNK = 2**30
"""Bytes, uncompressed; a chunk that claims more is damaged."""

_ALWAYS_ALLOWED, _MOST_TIMES_LARGER = 2**26, 1_000
"""Bytes, and times its own size, that a chunk may decompress to: no recorder's chunk needs more."""

_CHUNK_HEAD = struct.Struct("<QQQII")
_FIXED_HEAD = RECORD_HEAD.size + _CHUNK_HEAD.size
_LONGEST_HEAD = 80
_TOGETHER, _AHEAD = 8, 24


RawMessage: TypeAlias = tuple[int, int, int, int, bytes]
"""A message of a chunk: log time, channel, sequence, publish time, payload."""

Declaration: TypeAlias = records.Schema | records.Channel


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """Where some records are in the file.

    Attributes:
        offset, length: of the record with its head, in bytes.
        start_ns, end_ns: log times of its first and last message.
        compressed: whether it is a chunk; else records outside chunks.
        channels: those with messages in it, by the index; None where it does not say.
        has_checksum: whether a chunk must have a checksum, as those of our own logs do.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    compressed: bool = True
    channels: frozenset[int] | None = None
    has_checksum: bool = False


def chunk_place(offset: int, record: bytes, length: int) -> ChunkPlace:
    """Return the place of a chunk by the beginning of its record, if that is consistent in itself.

    Args:
        record: the first bytes of the record, at least 64 unless the file ends.
        length: of the record with its head.

    Raises:
        DamageError: it is not.
    """
    if len(record) < _FIXED_HEAD:
        raise DamageError("a chunk breaks off")
    start, end, size, _, name_length = _CHUNK_HEAD.unpack_from(record, RECORD_HEAD.size)
    data_length = _FIXED_HEAD + name_length
    if name_length > 16 or len(record) < data_length + 8:
        raise DamageError("a chunk's head is inconsistent")
    stored = int.from_bytes(record[data_length : data_length + 8], "little")
    if data_length + 8 + stored != length or size > LARGEST_CHUNK or not start <= end < 2**63:
        raise DamageError("a chunk's head is inconsistent")
    return ChunkPlace(offset, length, start, end)


def read_records(stream: BinaryIO, place: ChunkPlace) -> bytes:
    """Read the records in a place, decompressed.

    Raises:
        DamageError: the chunk is cut off, does not decompress, or has another checksum than it says.
    """
    stream.seek(place.offset)
    record = stream.read(place.length)
    if len(record) < place.length:
        raise DamageError("the chunk breaks off")
    if not place.compressed:
        return record
    chunk_place(place.offset, record[:_LONGEST_HEAD], len(record))
    _, _, size, checksum, name_length = _CHUNK_HEAD.unpack_from(record, RECORD_HEAD.size)
    begin = _FIXED_HEAD + name_length
    content = _decompressed(record[_FIXED_HEAD:begin], record[begin + 8 :], size)
    if len(content) != size:
        raise DamageError(f"the chunk holds {len(content)} bytes instead of {size}")
    if (checksum or place.has_checksum) and zlib.crc32(content) != checksum:
        if not checksum:
            raise DamageError("the chunk has no checksum, and every log of ours has one")
        raise DamageError("the chunk's checksum does not fit its content")
    return content


def iter_contents(
    stream: BinaryIO, places: Sequence[ChunkPlace]
) -> Iterator[tuple[ChunkPlace, bytes | DamageError]]:
    """Yield each place with its records, or with the damage that `read_records` raised.

    A second thread reads and decompresses the next places while the caller processes one, so the caller must
    not use the stream in between.
    """
    plan_places(stream, places)
    groups = [places[begin : begin + _TOGETHER] for begin in range(0, len(places), _TOGETHER)]
    waiting: deque[tuple[Sequence[ChunkPlace], Future[list[bytes | DamageError]]]] = deque()
    with ThreadPoolExecutor(1, "chunk-reading") as reader:
        try:
            for group in groups:
                waiting.append((group, reader.submit(_read_group, stream, group)))
                if len(waiting) > _AHEAD:
                    ready, contents = waiting.popleft()
                    yield from zip(ready, contents.result(), strict=True)
            for ready, contents in waiting:
                yield from zip(ready, contents.result(), strict=True)
        finally:
            # a caller that has seen enough does not wait for the rest
            reader.shutdown(cancel_futures=True)


def plan_places(stream: BinaryIO, places: Iterable[ChunkPlace]) -> None:
    """Announce the places that are going to be read from a stream, in this order."""
    plan_reads(stream, ((place.offset, place.offset + place.length) for place in places))


def _read_group(stream: BinaryIO, places: Sequence[ChunkPlace]) -> list[bytes | DamageError]:
    contents: list[bytes | DamageError] = []
    for place in places:
        try:
            contents.append(read_records(stream, place))
        except DamageError as damage:
            contents.append(damage)
    return contents


def _decompressed(compression: bytes, data: bytes, size: int) -> bytes:
    if compression and size > max(_ALWAYS_ALLOWED, _MOST_TIMES_LARGER * len(data)):
        raise DamageError(f"the chunk claims to hold {size} bytes in {len(data)}")
    try:
        if compression == b"zstd":
            if zstandard.frame_content_size(data) > size:
                raise DamageError("the chunk holds more than it says")
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        if compression == b"lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise DamageError(f"the chunk does not decompress ({error})") from None
    if compression:
        raise DamageError(f"the chunk is compressed as {compression!r}; known are zstd and lz4")
    return data


@dataclass(frozen=True, slots=True)
class Records:
    """The records of a chunk that a reader needs, in their order.

    Attributes:
        damage: why the chunk's end could not be read, or None.
    """

    messages: list[RawMessage]
    declarations: list[Declaration]
    damage: str | None = None


def split_records(content: bytes, passed_over: frozenset[int] = frozenset()) -> Records:
    """Return the messages and declarations in decompressed records, up to where one breaks off.

    Args:
        passed_over: channels whose messages are not wanted.
    """
    heads, breaks_off = walk_records(content)
    is_message = (heads.opcode == Opcode.MESSAGE) & (heads.end - heads.begin >= _MESSAGE_BYTES)
    for channel in passed_over:
        is_message &= heads.channel != channel
    wanted = np.flatnonzero(is_message)
    begins, ends = (heads.begin[wanted] + _MESSAGE_BYTES).tolist(), heads.end[wanted].tolist()
    fields = (heads.log_time, heads.channel, heads.sequence, heads.publish_time)
    payloads = [content[begin:end] for begin, end in zip(begins, ends, strict=True)]
    messages = list(zip(*(field[wanted].tolist() for field in fields), payloads, strict=True))
    declarations: list[Declaration] = []
    for index in np.flatnonzero((heads.opcode == Opcode.SCHEMA) | (heads.opcode == Opcode.CHANNEL)).tolist():
        read = records.Schema.read if heads.opcode[index] == Opcode.SCHEMA else records.Channel.read
        try:
            declarations.append(decoded(read, content[heads.begin[index] : heads.end[index]]))
        except DamageError as damage:
            whole = int(np.searchsorted(wanted, index))
            return Records(messages[:whole], declarations, str(damage))
    return Records(messages, declarations, "a record breaks off" if breaks_off else None)
