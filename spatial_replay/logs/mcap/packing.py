"""Messages packed into chunks of an MCAP log, and the summary that ends the log.

The writer is our own because chunks have to be the same bytes for the same messages, however these were
divided among calls, and because the library packs messages one by one, where whole columns are ten times
as fast.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, cast

import zstandard
from mcap import records
from mcap.opcode import Opcode

from spatial_replay.logs.checksums import crc32
from spatial_replay.logs.mcap.chunk_content import OpenChunk, lay_out
from spatial_replay.logs.mcap.chunk_records import RECORD_HEAD, encoded
from spatial_replay.trace.sample import FOREVER

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

    parts: Sequence[bytes | memoryview]
    record_bytes: int
    index_bytes: int
    index_offsets: Mapping[int, int]
    compressed_size: int
    uncompressed_size: int
    counts: Mapping[int, int]
    start_ns: int
    end_ns: int


def pack(chunks: Sequence[OpenChunk]) -> list[PackedChunk]:
    """Pack messages into compressed chunks, each with its index.

    Several chunks are laid out in one buffer, and compressed together, so that this thread seldom waits for
    the interpreter.
    """
    content = _room(sum(chunk.size for chunk in chunks))
    laid_out = lay_out(chunks, content)
    contents: list[bytes | bytearray | memoryview] = [
        content[begin:end] for begin, end in pairwise(laid_out.begin.tolist())
    ]
    compressed = _compressor().multi_compress_to_buffer(contents)
    entries, at = memoryview(laid_out.entries.astype("<i8", copy=False).tobytes()), 0
    low_ns, high_ns = laid_out.low_ns.tolist(), laid_out.high_ns.tolist()
    packed = []
    for number, (own, counts) in enumerate(zip(contents, laid_out.counts.tolist(), strict=True)):
        data = compressed[number].tobytes()
        about = low_ns[number], high_ns[number], len(own), crc32(own)
        length = _CHUNK.size - RECORD_HEAD.size + len(data)
        head = _CHUNK.pack(Opcode.CHUNK, length, *about, len(_ZSTD), _ZSTD, len(data))
        parts: list[bytes | memoryview] = [head, data]
        offsets, size = dict[int, int](), 0
        numbers = {channel: count for channel, count in enumerate(counts) if count}
        for channel, count in numbers.items():
            listed = entries[at : at + count * _INDEX_ENTRY]
            offsets[channel] = size
            parts += [_INDEX.pack(Opcode.MESSAGE_INDEX, len(listed) + 6, channel, len(listed)), listed]
            size += _INDEX.size + len(listed)
            at += len(listed)
        sizes = len(data), len(own)
        record_bytes = RECORD_HEAD.size + length
        packed.append(PackedChunk(parts, record_bytes, size, offsets, *sizes, numbers, *about[:2]))
    return packed


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
