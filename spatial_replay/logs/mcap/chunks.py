"""Chunks of an MCAP log: read, checked, decompressed and split, on several threads.

The reader is our own because the MCAP library fails 112 of the 416 files of the format's conformance suite
and gives up on truncated and unindexed files, which crashed recorders leave behind. It also yields one
object for each message, where we need a chunk's messages as columns.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate, pairwise
from threading import Lock, local
from typing import BinaryIO, NamedTuple, TypeAlias

import lz4.frame
import numpy as np
import zstandard

from spatial_replay.compiled import bytes_at, copying_kernel, integers_at
from spatial_replay.cores import Work, cores, drop, first_result
from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.byte_ranges import is_planned, plan_reads
from spatial_replay.logs.checksums import crc32, joined_checksum
from spatial_replay.logs.mcap.chunk_records import (
    RECORD_HEAD,
    DamageError,
    RawMessages,
    Records,
    Splitter,
)
from spatial_replay.logs.payloads import Bytes

LARGEST_CHUNK = 2**30
"""Bytes, uncompressed; a chunk that claims more is damaged."""

ALWAYS_ALLOWED, MOST_TIMES_LARGER = 2**26, 1_000
"""Bytes, and times its own size, that a chunk or a message may decompress to: no recorder's needs more."""

_ALWAYS_WAITING, _MOST_TIMES_WAITING = 2**28, 20
"""Bytes, and times the size of the log, of messages that wait until all chunks before them are read."""

_CHUNK_HEAD = struct.Struct("<QQQII")
_FIXED_HEAD = RECORD_HEAD.size + _CHUNK_HEAD.size
_LONGEST_HEAD = 80
_RECORD_HEAD = RECORD_HEAD.size
_ZSTD = 4 | int.from_bytes(b"zstd", "little") << 32
"""The compression of our own chunks in their heads: a length, and a name."""
_OUR_HEAD = _FIXED_HEAD + 4 + 8
"""How long these heads are."""
_TOGETHER, _TOGETHER_BYTES = 64, 2**22
"""Chunks, and their bytes, that a thread takes at once: with fewer, it waits for the interpreter
more often."""
_LARGEST_OF_OURS = 2**20
"""Bytes, uncompressed, of the largest chunk that is read together with others."""
_CACHED_BYTES = 2**21
"""So many are decompressed before they are split: they stay in the cache."""
_AHEAD, _AHEAD_BYTES = 24, 2**24
"""So many times a thread takes some, and so many bytes, are read ahead at most: more than a block of samples
has."""
_LEAST_AHEAD = 8
"""So many times at most, as long as each thread has some, they are read ahead however large they are."""
_USUAL_TIMES_LARGER = 8
"""A chunk that decompresses to more than so many times its size counts as one of a larger size."""
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
        size: bytes that a chunk decompresses to, by the index or by its head; 0 for records outside chunks.
    """

    offset: int
    length: int
    start_ns: int
    end_ns: int
    compressed: bool = True
    channels: frozenset[int] | None = None
    has_checksum: bool = False
    size: int = 0

    @property
    def weight(self) -> int:
        """Bytes by which it counts where many are read at the same time."""
        return max(self.length, self.size // _USUAL_TIMES_LARGER)


def most_waiting(lengths: Iterable[int]) -> int:
    """Return the bytes of messages that may wait for others, by the lengths of all chunks."""
    return max(_ALWAYS_WAITING, _MOST_TIMES_WAITING * sum(lengths))


def too_many_waiting(name: str, most: int) -> LogError:
    """Return the error that more messages wait than that."""
    return LogError(
        f"{name}: chunks that overlap in time hold more than {most} bytes of messages, far more than the log;"
        " give a part of it by --start and --end, or fewer topics"
    )


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
    return ChunkPlace(offset, length, start, end, size=size)


def read_records(stream: BinaryIO, place: ChunkPlace) -> bytes:
    """Read the records in a place, decompressed.

    Raises:
        DamageError: the chunk is cut off, does not decompress, or has another checksum than it says.
    """
    data, _ = _read_places(stream, [place], _Room())
    return _content(place, data, zstandard.ZstdDecompressor())


class _Room:
    """A buffer that serves again and again: new memory costs as much as filling it."""

    def __init__(self) -> None:
        self._bytes = np.empty(0, np.uint8)

    def of(self, size: int) -> Bytes:
        """Return (size,) bytes, in which anything may be, and which are the same ones each time."""
        if len(self._bytes) < size:
            self._bytes = np.empty(size + size // 8, np.uint8)
        return self._bytes[:size]


def _read_places(
    stream: BinaryIO, places: Sequence[ChunkPlace], room: _Room
) -> tuple[memoryview, list[tuple[int, int]]]:
    """Read what is in some places, at once where they follow each other closely, as on this machine.

    Returns:
        what was read, which may be in the room, and where each place begins and ends in it: too early, if the
        file ends before.
    """
    begin, end = places[0].offset, max(place.offset + place.length for place in places)
    is_near = end - begin <= _MOST_SPREAD * sum(place.length for place in places)
    if not is_near or is_planned(stream) or begin > min(place.offset for place in places):
        parts = list[bytes]()
        for place in places:
            stream.seek(place.offset)
            parts.append(stream.read(place.length))
        return memoryview(b"".join(parts)), list(pairwise(accumulate(map(len, parts), initial=0)))
    stream.seek(begin)
    whole = room.of(end - begin).data
    size = stream.readinto(whole)  # type: ignore[attr-defined]
    bounds = ((place.offset - begin, place.offset - begin + place.length) for place in places)
    return whole[:size], [(min(first, size), min(last, size)) for first, last in bounds]


def _content(place: ChunkPlace, record: memoryview, decompressor: zstandard.ZstdDecompressor) -> bytes:
    """Return the records in what was read of a place; see `read_records`."""
    if len(record) < place.length:
        raise DamageError("the chunk breaks off")
    if not place.compressed:
        return bytes(record)
    chunk_place(place.offset, bytes(record[:_LONGEST_HEAD]), len(record))
    _, _, size, checksum, name_length = _CHUNK_HEAD.unpack_from(record, RECORD_HEAD.size)
    if size > max(place.size, ALWAYS_ALLOWED // _TOGETHER):
        raise DamageError(f"the chunk claims to hold {size} bytes, and the index {place.size}")
    begin = _FIXED_HEAD + name_length
    content = _decompressed(bytes(record[_FIXED_HEAD:begin]), record[begin + 8 :], size, decompressor)
    if len(content) != size:
        raise DamageError(f"the chunk holds {len(content)} bytes instead of {size}")
    if (checksum or place.has_checksum) and crc32(content) != checksum:
        if not checksum:
            raise DamageError("the chunk has no checksum, and every log of ours has one")
        raise DamageError("the chunk's checksum does not fit its content")
    return content


def _unchanged(messages: RawMessages) -> RawMessages:
    return messages


def iter_records(
    stream: BinaryIO,
    places: Sequence[ChunkPlace],
    passed_over: Collection[int] = (),
    prepare: Callable[[RawMessages], RawMessages] = _unchanged,
) -> Iterator[tuple[Sequence[ChunkPlace], Records | DamageError]]:
    """Yield places with their records, or with the damage that `read_records` raised, in this order.

    Sound chunks that follow each other come several at once, damaged ones alone. On free cores, other threads
    read, decompress, check and split the next places while the caller processes some, so the caller must not
    use the stream in between.

    Args:
        passed_over: channels whose messages are not wanted.
        prepare: what else these threads do with the messages of some places.
    """
    plan_places(stream, places)
    reader = _GroupReader(stream, passed_over, prepare)
    waiting: deque[tuple[int, Work[_Found]]] = deque()
    ahead = 0
    try:
        for group in _groups(places):
            size = sum(place.weight for place in group)
            waiting.append((size, Work(partial(reader.read, group), waits=is_planned(stream))))
            waiting[-1][1].hand_out()
            ahead += size
            if len(waiting) > _AHEAD or (ahead > _AHEAD_BYTES and len(waiting) > min(cores(), _LEAST_AHEAD)):
                found = first_result(work for _, work in waiting)
                size, _ = waiting.popleft()
                ahead -= size
                yield from found
        while waiting:
            found = first_result(work for _, work in waiting)
            waiting.popleft()
            yield from found
    finally:
        # a caller that has seen enough does not wait for the rest
        drop(work for _, work in waiting)


def _groups(places: Sequence[ChunkPlace]) -> Iterator[Sequence[ChunkPlace]]:
    """Yield the places that a thread takes at once, in order."""
    begin = size = 0
    for number, place in enumerate(places, 1):
        size += place.weight
        if number - begin == _TOGETHER or size >= _TOGETHER_BYTES or number == len(places):
            yield places[begin:number]
            begin, size = number, 0


def plan_places(stream: BinaryIO, places: Iterable[ChunkPlace]) -> None:
    """Announce the places that are going to be read from a stream, in this order."""
    plan_reads(stream, ((place.offset, place.offset + place.length) for place in places))


_Found: TypeAlias = "list[tuple[Sequence[ChunkPlace], Records | DamageError]]"


class _Buffers:
    """What a thread that reads has for itself."""

    def __init__(self, passed_over: Collection[int]) -> None:
        self.read, self.frames, self.content = _Room(), _Room(), _Room()
        self.decompressor = zstandard.ZstdDecompressor()
        self.splitter = Splitter(passed_over)


class _GroupReader:
    """Reads groups of chunks on several threads, each with buffers that serve again and again."""

    def __init__(
        self,
        stream: BinaryIO,
        passed_over: Collection[int],
        prepare: Callable[[RawMessages], RawMessages],
    ) -> None:
        self._stream, self._passed_over, self._prepare = stream, passed_over, prepare
        self._reading = Lock()
        self._own = local()

    def read(self, places: Sequence[ChunkPlace]) -> _Found:
        """Return the records in all places, or in each, with its damage."""
        own: _Buffers | None = getattr(self._own, "buffers", None)
        if own is None:
            self._own.buffers = own = _Buffers(self._passed_over)
        with self._reading:
            data, bounds = _read_places(self._stream, places, own.read)
        if (records := _records_together(places, data, bounds, own)) is not None:
            return [(places, self._prepared(records))]
        found: _Found = []
        for place, (begin, end) in zip(places, bounds, strict=True):
            try:
                records = own.splitter.split(_content(place, data[begin:end], own.decompressor))
                found.append(([place], self._prepared(records)))
            except DamageError as damage:
                found.append(([place], damage))
        return found

    def _prepared(self, records: Records) -> Records:
        return replace(records, messages=self._prepare(records.messages))


def _records_together(
    places: Sequence[ChunkPlace], data: memoryview, bounds: Sequence[tuple[int, int]], own: _Buffers
) -> Records | None:
    """Return the records of several chunks, a few of which are decompressed, checked and split in one step.

    Threads then seldom wait for the interpreter, and what is decompressed is still in the processor's cache
    when it is split.

    Returns:
        None if not all are sound and compressed as ours: then each is looked at by itself.
    """
    if not all(place.compressed for place in places):
        return None
    if [end - begin for begin, end in bounds] != [place.length for place in places]:
        return None
    table = np.empty((len(places), 5), np.int64)
    table[:, :2] = bounds
    # not only as much as was read: an index may name the same bytes several times
    frames = own.frames.of(sum(place.length for place in places))
    if not _gather_frames(np.frombuffer(data, np.uint8), table, frames):
        return None
    lengths, sizes, checksums = table[:, 2:].T.tolist()
    ends = list(accumulate(lengths, initial=0))
    view = frames.data
    checksum = 0
    own.splitter.begin(sum(sizes))
    try:
        if [zstandard.frame_content_size(view[begin:end]) for begin, end in pairwise(ends)] != sizes:
            return None
        for first, last in _batches(sizes):
            content = own.content.of(sum(sizes[first:last])).data
            if not _decompress_frames(
                view[ends[first] : ends[last]], content, own, is_long=len(sizes) == _TOGETHER
            ):
                return None
            checksum = crc32(content, checksum)
            if not own.splitter.add(content, sizes[first:last]):
                return None
    except (zstandard.ZstdError, RuntimeError, ValueError):
        return None
    return own.splitter.records() if checksum == joined_checksum(checksums, sizes) else None


def _decompress_frames(frames: memoryview, content: memoryview, own: _Buffers, *, is_long: bool) -> bool:
    """Decompress several frames into as many bytes as they hold; return whether they hold these.

    Args:
        is_long: whether the log has so many chunks that it pays to load what decompresses all in one step.
            Else each frame hands the interpreter to another thread, and waits for it.

    Raises:
        ZstdError, RuntimeError, ValueError: they are damaged.
    """
    if is_long:
        from numcodecs import zstd

        zstd.decompress(frames, content)
        return True
    reader = own.decompressor.stream_reader(frames, read_across_frames=True)
    return bool(reader.readinto(content) == len(content))  # type: ignore[attr-defined, unused-ignore]


def _batches(sizes: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Yield which chunks are decompressed together, as a range."""
    begin = size = 0
    for number, each in enumerate(sizes):
        if number > begin and size + each > _CACHED_BYTES:
            yield begin, number
            begin, size = number, 0
        size += each
    yield begin, len(sizes)


def _gathered_by_struct(data: Bytes, table: Integers, frames: Bytes) -> bool:
    """See `_gather_frames`."""
    at = 0
    for row in table:
        begin, end = row[:2].tolist()
        record = data.data[begin:end]
        if len(record) < _LONGEST_HEAD:
            return False
        start, stop, size, checksum, _ = _CHUNK_HEAD.unpack_from(record, RECORD_HEAD.size)
        name, stored = struct.unpack_from("<QQ", record, _OUR_HEAD - 16)
        if name != _ZSTD or not checksum or size > _LARGEST_OF_OURS or not start <= stop < 2**63:
            return False
        if stored != len(record) - _OUR_HEAD:
            return False
        frames[at : at + stored] = data[begin + _OUR_HEAD : end]
        row[2:] = stored, size, checksum
        at += stored
    return True


@copying_kernel(_gathered_by_struct, times=1.0)
def _gather_frames(data: Bytes, table: Integers, frames: Bytes) -> bool:
    """Put the compressed contents of chunks side by side; return whether all are plainly as ours.

    Args:
        data: the chunks.
        table: (C, 5), where each begins and ends; to be filled in: the length of its compressed content, the
            size of its content, and its checksum.
        frames: to be filled in; as long as all chunks together.
    """
    source, target, used = data.ctypes.data, frames.ctypes.data, 0
    for k in range(table.shape[0]):
        length = table[k, 1] - table[k, 0]
        if length < _LONGEST_HEAD:
            return False
        at = source + table[k, 0]
        start, stop, size = (
            integers_at(at + _RECORD_HEAD, 3)[0],
            integers_at(at + _RECORD_HEAD, 3)[1],
            integers_at(at + _RECORD_HEAD, 3)[2],
        )
        checksum = integers_at(at + _RECORD_HEAD + 24, 1)[0] & 0xFFFFFFFF
        stored = integers_at(at + _OUR_HEAD - 8, 1)[0]
        if integers_at(at + _OUR_HEAD - 16, 1)[0] != _ZSTD or checksum == 0 or stored != length - _OUR_HEAD:
            return False
        if size < 0 or size > _LARGEST_OF_OURS or start < 0 or stop < start:
            return False
        frame, to = at + _OUR_HEAD, target + used
        words = stored // 8
        for i in range(words):
            integers_at(to, words)[i] = integers_at(frame, words)[i]
        for i in range(8 * words, stored):
            bytes_at(to, stored)[i] = bytes_at(frame, stored)[i]
        used += stored
        table[k, 2], table[k, 3], table[k, 4] = stored, size, checksum
    return True


def _decompressed(
    compression: bytes, data: memoryview, size: int, decompressor: zstandard.ZstdDecompressor
) -> bytes:
    if compression and size > max(ALWAYS_ALLOWED, MOST_TIMES_LARGER * len(data)):
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
