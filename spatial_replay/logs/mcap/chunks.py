"""Chunks of an MCAP log: read, checked, decompressed and split, on several threads.

The reader is our own because the MCAP library fails 112 of the 416 files of the format's conformance suite
and gives up on truncated and unindexed files, which crashed recorders leave behind. It also yields one
object for each message, where we need a chunk's messages as columns.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock, local
from typing import BinaryIO, NamedTuple, TypeAlias

import lz4.frame
import zstandard

from spatial_replay.cores import cores
from spatial_replay.logs.byte_ranges import is_planned, plan_reads
from spatial_replay.logs.checksums import crc32, joined_checksum
from spatial_replay.logs.mcap.chunk_records import (
    RECORD_HEAD,
    DamageError,
    Records,
    Splitter,
)

LARGEST_CHUNK = 2**30
"""Bytes, uncompressed; a chunk that claims more is damaged."""

_ALWAYS_ALLOWED, _MOST_TIMES_LARGER = 2**26, 1_000
"""Bytes, and times its own size, that a chunk may decompress to: no recorder's chunk needs more."""

_CHUNK_HEAD = struct.Struct("<QQQII")
_FIXED_HEAD = RECORD_HEAD.size + _CHUNK_HEAD.size
_LONGEST_HEAD = 80
_TOGETHER, _TOGETHER_BYTES = 16, 2**20
"""Chunks, and their bytes, that a thread takes at once: what it decompresses stays in the cache."""
_AHEAD, _AHEAD_BYTES = 48, 2**24
"""How many times as many are read ahead, at most, and their bytes: more than a block of samples has."""
_LEAST_AHEAD = 8
"""So many are read ahead however large they are, so that each thread has work."""
_MOST_THREADS = 4
"""More would wait for the one that takes what they have read."""
_MOST_SPREAD = 1.5
"""Times their own bytes that chunks and what lies between them may have, to be read at once."""


class ChunkPlace(NamedTuple):
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
    (record,) = _read_places(stream, [place])
    return _content(place, record, zstandard.ZstdDecompressor())


def _read_places(stream: BinaryIO, places: Sequence[ChunkPlace]) -> list[memoryview]:
    """Read what is in some places, at once where they follow each other closely, as on this machine."""
    begin, end = places[0].offset, max(place.offset + place.length for place in places)
    is_near = end - begin <= _MOST_SPREAD * sum(place.length for place in places)
    if len(places) == 1 or not is_near or begin > min(place.offset for place in places) or is_planned(stream):
        return [_read(stream, place.offset, place.length) for place in places]
    data = _read(stream, begin, end - begin)
    return [data[place.offset - begin : place.offset - begin + place.length] for place in places]


def _read(stream: BinaryIO, offset: int, length: int) -> memoryview:
    stream.seek(offset)
    return memoryview(stream.read(length))


def _content(place: ChunkPlace, record: memoryview, decompressor: zstandard.ZstdDecompressor) -> bytes:
    """Return the records in what was read of a place; see `read_records`."""
    if len(record) < place.length:
        raise DamageError("the chunk breaks off")
    if not place.compressed:
        return bytes(record)
    chunk_place(place.offset, bytes(record[:_LONGEST_HEAD]), len(record))
    _, _, size, checksum, name_length = _CHUNK_HEAD.unpack_from(record, RECORD_HEAD.size)
    begin = _FIXED_HEAD + name_length
    content = _decompressed(bytes(record[_FIXED_HEAD:begin]), record[begin + 8 :], size, decompressor)
    if len(content) != size:
        raise DamageError(f"the chunk holds {len(content)} bytes instead of {size}")
    if (checksum or place.has_checksum) and crc32(content) != checksum:
        if not checksum:
            raise DamageError("the chunk has no checksum, and every log of ours has one")
        raise DamageError("the chunk's checksum does not fit its content")
    return content


def iter_records(
    stream: BinaryIO, places: Sequence[ChunkPlace], passed_over: Collection[int] = ()
) -> Iterator[tuple[Sequence[ChunkPlace], Records | DamageError]]:
    """Yield places with their records, or with the damage that `read_records` raised, in this order.

    Sound chunks that follow each other come several at once, damaged ones alone. Other threads, one for each
    core, read, decompress, check and split the next places while the caller processes some, so the caller
    must not use the stream in between.

    Args:
        passed_over: channels whose messages are not wanted.
    """
    plan_places(stream, places)
    reader = _GroupReader(stream, passed_over)
    waiting: deque[tuple[int, Future[_Found]]] = deque()
    ahead = 0
    with ThreadPoolExecutor(min(cores(), _MOST_THREADS), "chunk-reading") as readers:
        try:
            for group in _groups(places):
                size = sum(place.length for place in group)
                waiting.append((size, readers.submit(reader.read, group)))
                ahead += size
                while len(waiting) > _AHEAD or (ahead > _AHEAD_BYTES and len(waiting) > _LEAST_AHEAD):
                    size, ready = waiting.popleft()
                    ahead -= size
                    yield from ready.result()
            for _, ready in waiting:
                yield from ready.result()
        finally:
            # a caller that has seen enough does not wait for the rest
            readers.shutdown(cancel_futures=True)


def _groups(places: Sequence[ChunkPlace]) -> Iterator[Sequence[ChunkPlace]]:
    """Yield the places that a thread takes at once, in order."""
    begin = size = 0
    for number, place in enumerate(places, 1):
        size += place.length
        if number - begin == _TOGETHER or size >= _TOGETHER_BYTES or number == len(places):
            yield places[begin:number]
            begin, size = number, 0


def plan_places(stream: BinaryIO, places: Iterable[ChunkPlace]) -> None:
    """Announce the places that are going to be read from a stream, in this order."""
    plan_reads(stream, ((place.offset, place.offset + place.length) for place in places))


_Found: TypeAlias = "list[tuple[Sequence[ChunkPlace], Records | DamageError]]"


class _GroupReader:
    """Reads groups of chunks on several threads, each with buffers that serve again and again."""

    def __init__(self, stream: BinaryIO, passed_over: Collection[int]) -> None:
        self._stream, self._passed_over = stream, passed_over
        self._reading = Lock()
        self._own = local()

    def read(self, places: Sequence[ChunkPlace]) -> _Found:
        """Return the records in all places, or in each, with its damage."""
        with self._reading:
            read = _read_places(self._stream, places)
        decompressor, splitter = zstandard.ZstdDecompressor(), self._splitter()
        if (content := self._content(places, read, decompressor)) is not None:
            records = splitter.split(*content)
            if records.damage is None:
                return [(places, records)]
        found: _Found = []
        for place, record in zip(places, read, strict=True):
            try:
                found.append(([place], splitter.split(_content(place, record, decompressor))))
            except DamageError as damage:
                found.append(([place], damage))
        return found

    def _content(
        self,
        places: Sequence[ChunkPlace],
        read: Sequence[memoryview],
        decompressor: zstandard.ZstdDecompressor,
    ) -> tuple[memoryview, list[int]] | None:
        """Decompress and check all chunks in one step each, so that threads seldom wait for the interpreter.

        Returns:
            all contents and their sizes; None if they are not all sound and compressed as ours: then each is
            looked at by itself.
        """
        frames, sizes, checksums = list[memoryview](), list[int](), list[int]()
        for place, record in zip(places, read, strict=True):
            if not place.compressed or len(record) < max(place.length, _LONGEST_HEAD):
                return None
            _, _, size, checksum, name_length = _CHUNK_HEAD.unpack_from(record, RECORD_HEAD.size)
            begin = _FIXED_HEAD + name_length
            if bytes(record[_FIXED_HEAD:begin]) != b"zstd" or not checksum or size > _TOGETHER_BYTES:
                return None
            frames.append(record[begin + 8 :])
            sizes.append(size)
            checksums.append(checksum)
        try:
            for place, record in zip(places, read, strict=True):
                chunk_place(place.offset, bytes(record[:_LONGEST_HEAD]), len(record))
            if list(map(zstandard.frame_content_size, frames)) != sizes:
                return None
            whole = self._buffer(sum(sizes))
            reader = decompressor.stream_reader(b"".join(frames), read_across_frames=True)
            if reader.readinto(whole) != len(whole):  # type: ignore[attr-defined, unused-ignore]
                return None
        except (DamageError, zstandard.ZstdError):
            return None
        if crc32(whole) != joined_checksum(checksums, sizes):
            return None
        return whole, sizes

    def _splitter(self) -> Splitter:
        """Return the splitter of this thread: new memory costs as much as filling it."""
        splitter: Splitter | None = getattr(self._own, "splitter", None)
        if splitter is None:
            self._own.splitter = splitter = Splitter(self._passed_over)
        return splitter

    def _buffer(self, size: int) -> memoryview:
        buffer: bytearray | None = getattr(self._own, "buffer", None)
        if buffer is None or len(buffer) < size:
            self._own.buffer = buffer = bytearray(size + size // 8)
        return memoryview(buffer)[:size]


def _decompressed(
    compression: bytes, data: memoryview, size: int, decompressor: zstandard.ZstdDecompressor
) -> bytes:
    if compression and size > max(_ALWAYS_ALLOWED, _MOST_TIMES_LARGER * len(data)):
        raise DamageError(f"the chunk claims to hold {size} bytes in {len(data)}")
    try:
        if compression == b"zstd":
            if zstandard.frame_content_size(data) > size:
                raise DamageError("the chunk holds more than it says")
            return decompressor.decompress(data, max_output_size=size)
        if compression == b"lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise DamageError(f"the chunk does not decompress ({error})") from None
    if compression:
        raise DamageError(f"the chunk is compressed as {compression!r}; known are zstd and lz4")
    return bytes(data)
