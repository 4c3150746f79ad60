"""Messages packed into chunks of an MCAP log, and the summary that ends the log.

The writer is our own because chunks have to be the same bytes for the same messages, however these were
divided among calls, and because the library packs messages one by one, where whole columns are ten times
as fast.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, NamedTuple, cast

import numpy as np
import zstandard
from mcap import records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Integers, equal_places, starts_from_counts
from spatial_replay.logs.checksums import crc32
from spatial_replay.logs.mcap.chunk_records import RECORD_HEAD, encoded
from spatial_replay.logs.messages import Messages
from spatial_replay.logs.payloads import Filled, MixedPayloads, columns_of
from spatial_replay.trace.sample import FOREVER

_MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_HEAD: Final = _MESSAGE.itemsize
_HEAD_BYTES: Final = np.dtype(f"V{_HEAD}")
_INDEX_ENTRY: Final = 16
_ZSTD: Final = b"zstd"
_CHUNK: Final = struct.Struct("<BQQQQII4sQ")
_INDEX: Final = struct.Struct("<BQHI")
_MOST_KEPT: Final = 2**22
"""A thread keeps room for so many bytes of chunks."""
COMPRESSION_LEVEL: Final = 1
"""Coordinates hardly shrink further at higher levels, which take several times as long."""


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A chunk ready to be written, with what the summary says of it.

    Attributes:
        parts: the chunk's record, followed by its index of messages.
        record_bytes, index_bytes: how long both are.
        index_offsets: for each channel, where its entries begin in the index.
    """

    parts: Sequence[bytes]
    record_bytes: int
    index_bytes: int
    index_offsets: Mapping[int, int]
    compressed_size: int
    uncompressed_size: int
    counts: Mapping[int, int]
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Messages as records.

    Attributes:
        heads: (M,), the encoded heads.
        payloads: what follows them.
        start: (M + 1,) int64, where each begins and the last one ends, side by side.
        times_ns: (M,) int64, their log times.
        numbers: (M,) int64, the numbers of their channels; and as a list `channels`.
    """

    heads: NDArray[np.void]
    payloads: MixedPayloads
    start: Integers
    times_ns: Integers
    numbers: Integers
    channels: list[int]

    @classmethod
    def of(cls, messages: Messages, numbers: Integers) -> Batch:
        """Return messages as records, with channel numbers (M,)."""
        payloads = columns_of(messages.payloads)
        sizes = payloads.sizes
        heads = np.zeros(len(payloads), _MESSAGE)
        heads["opcode"] = Opcode.MESSAGE
        heads["length"] = sizes + (_HEAD - RECORD_HEAD.size)
        heads["channel"] = numbers
        heads["sequence"] = messages.sequence
        heads["log_time"] = messages.log_time_ns
        heads["publish_time"] = messages.publish_time_ns
        encoded_heads: NDArray[np.void] = heads.view(_HEAD_BYTES)
        start = starts_from_counts(sizes + _HEAD)
        return cls(encoded_heads, payloads, start, messages.log_time_ns, numbers, numbers.tolist())


@dataclass(frozen=True, slots=True, eq=False)
class MessageRange:
    """The messages of a batch from `begin` up to, not including, `stop`."""

    batch: Batch
    begin: int
    stop: int

    @property
    def times_ns(self) -> Integers:
        return self.batch.times_ns[self.begin : self.stop]

    @property
    def numbers(self) -> Integers:
        return self.batch.numbers[self.begin : self.stop]

    @property
    def start(self) -> Integers:
        """(m + 1,) where its records begin and the last one ends, side by side."""
        start = self.batch.start[self.begin : self.stop + 1]
        return np.asarray(start - start[0])

    @property
    def channels(self) -> set[int]:
        """The numbers of the channels with messages in it."""
        return set(self.batch.channels[self.begin : self.stop])

    @property
    def start_ns(self) -> int:
        """Log time of its first message."""
        return int(self.batch.times_ns[self.begin])

    def write(self, content: memoryview, start: Integers) -> None:
        """Write payloads into records (m + 1,); those of a template without what is to be filled in."""
        payloads = self.batch.payloads
        patterns = [part.template.pattern if isinstance(part, Filled) else None for part in payloads.parts]
        own = slice(self.begin, self.stop)
        columns = payloads.part[own], payloads.row[own], start[:-1] + _HEAD, start[1:]
        for part, row, begin, end in zip(*(column.tolist() for column in columns), strict=True):
            pattern = patterns[part]
            content[begin:end] = payloads.parts[part][row] if pattern is None else pattern

    def fill(self, content: memoryview, starts: Integers) -> None:
        """Fill in heads and templates.

        Args:
            content: after `write`.
            starts: (m,) where each message's record begins.
        """
        heads: NDArray[np.void] = np.ndarray((len(content) - _HEAD + 1,), _HEAD_BYTES, content, 0, (1,))
        heads[starts] = self.batch.heads[self.begin : self.stop]
        payloads, own = self.batch.payloads, slice(self.begin, self.stop)
        part, row = payloads.part[own], payloads.row[own]
        for places in equal_places(part):
            filled = payloads.parts[part[places[0]]]
            if isinstance(filled, Filled):
                filled.write(content, starts[places] + _HEAD, row[places])


class OpenChunk(NamedTuple):
    """A chunk to be packed: its messages, at least one, and the declarations that it begins with."""

    ranges: Sequence[MessageRange]
    declaring: bytes

    @property
    def size(self) -> int:
        """How many bytes its content has."""
        starts = [(each.batch.start, each) for each in self.ranges]
        return len(self.declaring) + sum(int(start[own.stop] - start[own.begin]) for start, own in starts)


def pack(chunks: Sequence[OpenChunk]) -> list[PackedChunk]:
    """Pack messages into compressed chunks, each with its index.

    Several chunks are laid out in one buffer, where the messages of a template are encoded together.
    """
    content, starts = _laid_out(chunks)
    ranges = [each for chunk in chunks for each in chunk.ranges]
    counts = np.array([sum(each.stop - each.begin for each in chunk.ranges) for chunk in chunks], np.int64)
    times_ns = np.concatenate([each.times_ns for each in ranges])
    numbers = np.concatenate([each.numbers for each in ranges])
    begins = starts_from_counts([chunk.size for chunk in chunks])
    first = starts_from_counts(counts)
    low_ns = np.minimum.reduceat(times_ns, first[:-1]).tolist()
    high_ns = np.maximum.reduceat(times_ns, first[:-1]).tolist()
    chunk_of = np.repeat(np.arange(len(chunks)), counts)
    entries = np.stack([times_ns, starts - begins[chunk_of]], axis=1).astype("<i8", copy=False)
    key = chunk_of * 2**16 + numbers
    order = np.argsort(key, kind="stable")
    key, listed = key[order], entries[order]
    edges = np.flatnonzero(np.diff(key, prepend=-1, append=-1)).tolist()
    indices: list[list[tuple[int, bytes]]] = [[] for _ in chunks]
    for begin, end in pairwise(edges):
        chunk, channel = divmod(int(key[begin]), 2**16)
        indices[chunk].append((channel, listed[begin:end].tobytes()))
    bounds = begins.tolist()
    return [
        _packed(content[bounds[at] : bounds[at + 1]], indices[at], low_ns[at], high_ns[at])
        for at in range(len(chunks))
    ]


def _laid_out(chunks: Sequence[OpenChunk]) -> tuple[memoryview, Integers]:
    """Return the content of chunks, one after the other, and where each message's record begins in it."""
    content = _room(sum(chunk.size for chunk in chunks))
    offset, starts = 0, list[Integers]()
    for chunk in chunks:
        content[offset : offset + len(chunk.declaring)] = chunk.declaring
        offset += len(chunk.declaring)
        for each in chunk.ranges:
            start = offset + each.start
            each.write(content, start)
            starts.append(start[:-1])
            offset = int(start[-1])
    for each, own in _joined(chunks, starts):
        each.fill(content, own)
    return content, np.concatenate(starts)


def _joined(
    chunks: Sequence[OpenChunk], starts: Sequence[Integers]
) -> Iterator[tuple[MessageRange, Integers]]:
    """Yield the ranges of one batch that follow each other as one, with the places of their records."""
    waiting: list[Integers] = []
    ranges = [each for chunk in chunks for each in chunk.ranges]
    for at, (each, own) in enumerate(zip(ranges, starts, strict=True)):
        waiting.append(own)
        after = ranges[at + 1] if at + 1 < len(ranges) else None
        if after is None or after.batch is not each.batch or after.begin != each.stop:
            count = sum(map(len, waiting))
            yield MessageRange(each.batch, each.stop - count, each.stop), np.concatenate(waiting)
            waiting = []


def _packed(
    content: memoryview, index: Sequence[tuple[int, bytes]], start_ns: int, end_ns: int
) -> PackedChunk:
    """Compress a chunk.

    Args:
        index: of each channel, the entries of its messages.
    """
    compressed = _compressor().compress(content)
    about = start_ns, end_ns, len(content), crc32(content)
    length = _CHUNK.size - RECORD_HEAD.size + len(compressed)
    parts = [_CHUNK.pack(Opcode.CHUNK, length, *about, len(_ZSTD), _ZSTD, len(compressed)), compressed]
    offsets, size = dict[int, int](), 0
    for channel, entries in index:
        offsets[channel] = size
        parts += [_INDEX.pack(Opcode.MESSAGE_INDEX, len(entries) + 6, channel, len(entries)), entries]
        size += _INDEX.size + len(entries)
    counts = {channel: len(entries) // _INDEX_ENTRY for channel, entries in index}
    sizes = len(compressed), len(content)
    record_bytes = RECORD_HEAD.size + length
    return PackedChunk(parts, record_bytes, size, offsets, *sizes, counts, start_ns, end_ns)


_local = threading.local()


def _room(size: int) -> memoryview:
    """Return room for a content, until this thread asks again: new memory costs as much as filling it."""
    if size > _MOST_KEPT:
        return memoryview(bytearray(size))
    if len(getattr(_local, "room", b"")) < size:
        _local.room = bytearray(size)
    return memoryview(_local.room)[:size]


def _compressor() -> zstandard.ZstdCompressor:
    """Return the compressor of this thread: one serves one thread at a time."""
    if not hasattr(_local, "compressor"):
        _local.compressor = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL)
    return cast(zstandard.ZstdCompressor, _local.compressor)


@dataclass(slots=True)
class McapSummary:
    """What a log holds, collected while it is written."""

    schemas: list[records.Schema] = field(default_factory=list)
    channels: list[records.Channel] = field(default_factory=list)
    chunks: list[bytes] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int = FOREVER
    end_ns: int = 0

    def add_chunk(self, chunk: PackedChunk, offset: int) -> None:
        """Take in a chunk that is written at a place in the file."""
        self.chunks.append(_chunk_index(chunk, offset))
        self.start_ns, self.end_ns = min(self.start_ns, chunk.start_ns), max(self.end_ns, chunk.end_ns)
        for channel, count in chunk.counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + count

    def section(self, offset: int) -> bytes:
        """Encode the section and the footer for a place in the file."""
        groups = (
            (Opcode.SCHEMA, encoded(*self.schemas)),
            (Opcode.CHANNEL, encoded(*self.channels)),
            (Opcode.STATISTICS, encoded(self._statistics())),
            (Opcode.CHUNK_INDEX, b"".join(self.chunks)),
            (Opcode.ATTACHMENT_INDEX, encoded(*self.attachments)),
            (Opcode.METADATA_INDEX, encoded(*self.metadata)),
        )
        section, offsets = b"", []
        for opcode, content in groups:
            if content:
                offsets.append(records.SummaryOffset(opcode, offset + len(section), len(content)))
                section += content
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, offset, offset + len(section))
        section += encoded(*offsets) + footer
        return section + struct.pack("<I", crc32(section))

    def _statistics(self) -> records.Statistics:
        return records.Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=self.counts,
            chunk_count=len(self.chunks),
            message_count=sum(self.counts.values()),
            message_end_time=self.end_ns,
            message_start_time=self.start_ns if self.chunks else 0,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


_CHUNK_INDEX: Final = struct.Struct("<BQQQQQI")
_CHUNK_SIZES: Final = struct.Struct("<QI4sQQ")


def _chunk_index(chunk: PackedChunk, offset: int) -> bytes:
    """Encode the index of a chunk as `encoded` does, in a tenth of the time: long logs have very many."""
    following = offset + chunk.record_bytes
    places = [each for number, at in chunk.index_offsets.items() for each in (number, following + at)]
    offsets = struct.pack("<" + "HQ" * (len(places) // 2), *places)
    sizes = chunk.index_bytes, len(_ZSTD), _ZSTD, chunk.compressed_size, chunk.uncompressed_size
    length = _CHUNK_INDEX.size - RECORD_HEAD.size + len(offsets) + _CHUNK_SIZES.size
    about = chunk.start_ns, chunk.end_ns, offset, chunk.record_bytes
    head = _CHUNK_INDEX.pack(Opcode.CHUNK_INDEX, length, *about, len(offsets))
    return head + offsets + _CHUNK_SIZES.pack(*sizes)
