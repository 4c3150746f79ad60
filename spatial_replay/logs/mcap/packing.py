"""Messages packed into chunks of an MCAP log, and the summary that ends the log.

The writer is our own because chunks have to be the same bytes for the same messages, however these were
divided among calls, and because the library packs messages one by one, where whole columns are ten times
as fast.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import Any, Final, NamedTuple, cast

import zstandard
from mcap import records
from mcap.opcode import Opcode

from spatial_replay.logs.checksums import crc32
from spatial_replay.logs.mcap.chunk_content import INDEX_ENTRY, INDEX_HEAD, OpenChunk, lay_out
from spatial_replay.logs.mcap.chunk_records import RECORD_HEAD, encoded
from spatial_replay.trace.sample import FOREVER

_ZSTD: Final = b"zstd"
_CHUNK: Final = struct.Struct("<BQQQQII4sQ")
_MOST_KEPT: Final = 2**22
"""A thread keeps room for so many bytes of chunks."""
COMPRESSION_LEVEL: Final = 1
"""Coordinates hardly shrink further at higher levels, which take several times as long."""
_OWN_LEVEL, _OWN_HASH_LOG = -1, 12
"""The same for our own messages, of which each is much like the one before: a table that fits into the first
cache of the processor finds what repeats, and a quarter of the time is saved for a twentieth more bytes."""


class PackedChunk(NamedTuple):
    """What the summary says of a chunk.

    Attributes:
        record_bytes, index_bytes: how long its record is, and its index of messages, which follows.
        index_offsets: channels with their places in both, one after the other.
    """

    record_bytes: int
    index_bytes: int
    index_offsets: Sequence[int]
    compressed_size: int
    uncompressed_size: int
    start_ns: int
    end_ns: int


class PackedChunks(NamedTuple):
    """Chunks ready to be written.

    Attributes:
        data: their records and indexes, piece by piece.
        chunks: what the summary says of each.
        counts: how many messages there are, by channel.
    """

    data: Sequence[Any]
    chunks: Sequence[PackedChunk]
    counts: Sequence[int]


def pack(chunks: Sequence[OpenChunk]) -> PackedChunks:
    """Pack messages into compressed chunks, each with its index.

    Several chunks are laid out in one buffer, and compressed together, so that this thread seldom waits for
    the interpreter.
    """
    content = _room(sum(chunk.size for chunk in chunks))
    laid_out = lay_out(chunks, content)
    contents: list[bytes | bytearray | memoryview] = [
        content[begin:end] for begin, end in pairwise(laid_out.begin.tolist())
    ]
    compressed = _compressed(contents, [chunk.is_own for chunk in chunks])
    about = zip(
        contents,
        laid_out.counts.tolist(),
        laid_out.low_ns.tolist(),
        laid_out.high_ns.tolist(),
        pairwise(laid_out.index_begin.tolist()),
        strict=True,
    )
    parts: list[Any] = []
    packed = []
    for number, (own, counts, start_ns, end_ns, (begin, end)) in enumerate(about):
        data, span = compressed[number], (start_ns, end_ns)
        length = _CHUNK.size - RECORD_HEAD.size + len(data)
        head = _CHUNK.pack(Opcode.CHUNK, length, *span, len(own), crc32(own), len(_ZSTD), _ZSTD, len(data))
        parts += head, data, laid_out.indexes[begin:end]
        record_bytes = at = RECORD_HEAD.size + length
        offsets = list[int]()
        for channel, count in enumerate(counts):
            if count:
                offsets += channel, at
                at += INDEX_HEAD + count * INDEX_ENTRY
        packed.append(PackedChunk(record_bytes, end - begin, offsets, len(data), len(own), *span))
    return PackedChunks(parts, packed, laid_out.counts.sum(axis=0).tolist())


_local = threading.local()


def _room(size: int) -> memoryview:
    """Return room for a content, until this thread asks again: new memory costs as much as filling it."""
    if size > _MOST_KEPT:
        return memoryview(bytearray(size))
    if len(getattr(_local, "room", b"")) < size:
        _local.room = bytearray(size)
    return memoryview(_local.room)[:size]


def _compressed(contents: Sequence[bytes | bytearray | memoryview], are_own: Sequence[bool]) -> list[Any]:
    """Compress the contents of chunks, in one call those of our messages, and in another those of others."""
    compressed = list[Any](contents)
    for is_own in set(are_own):
        places = [place for place, own in enumerate(are_own) if own == is_own]
        several = _compressor(is_own).multi_compress_to_buffer([contents[place] for place in places])
        for number, place in enumerate(places):
            compressed[place] = several[number]
    return compressed


def _compressor(is_own: bool) -> zstandard.ZstdCompressor:
    """Return a compressor of this thread: one serves one thread at a time."""
    if not hasattr(_local, "compressors"):
        own = zstandard.ZstdCompressionParameters.from_level(_OWN_LEVEL, hash_log=_OWN_HASH_LOG)
        _local.compressors = (
            zstandard.ZstdCompressor(level=COMPRESSION_LEVEL),
            zstandard.ZstdCompressor(compression_params=own),
        )
    return cast(zstandard.ZstdCompressor, _local.compressors[is_own])


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

    def add(self, packed: PackedChunks, offset: int) -> None:
        """Take in chunks that are written at a place in the file, one after the other."""
        for chunk in packed.chunks:
            self.chunks.append(_chunk_index(chunk, offset))
            offset += chunk.record_bytes + chunk.index_bytes
            for channel in chunk.index_offsets[::2]:
                # in the order of the chunks that they are in first
                self.counts.setdefault(channel, 0)
        self.start_ns = min(self.start_ns, *(chunk.start_ns for chunk in packed.chunks))
        self.end_ns = max(self.end_ns, *(chunk.end_ns for chunk in packed.chunks))
        for channel, count in enumerate(packed.counts):
            if count:
                self.counts[channel] += count

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


_CHUNK_INDEX: Final = "<BQQQQQI{}QI4sQQ"


def _chunk_index(chunk: PackedChunk, offset: int) -> bytes:
    """Encode the index of a chunk as `encoded` does, in a tenth of the time: long logs have very many."""
    record = _chunk_index_record(len(chunk.index_offsets) // 2)
    places = list(chunk.index_offsets)
    places[1::2] = [offset + at for at in places[1::2]]
    about = chunk.start_ns, chunk.end_ns, offset, chunk.record_bytes, len(places) // 2 * 10
    sizes = chunk.index_bytes, len(_ZSTD), _ZSTD, chunk.compressed_size, chunk.uncompressed_size
    return record.pack(Opcode.CHUNK_INDEX, record.size - RECORD_HEAD.size, *about, *places, *sizes)


@cache
def _chunk_index_record(channels: int) -> struct.Struct:
    return struct.Struct(_CHUNK_INDEX.format("HQ" * channels))
