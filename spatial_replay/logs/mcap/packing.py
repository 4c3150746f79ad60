"""Messages packed into chunks of an MCAP log, and the summary that ends the log.

The writer is our own because chunks have to be the same bytes for the same messages, however these were
divided among calls, and because the library packs messages one by one, where whole columns are ten times
as fast.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import zstandard
from mcap import records
from mcap.opcode import Opcode

from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.mcap.chunk_records import RECORD_HEAD, encoded
from spatial_replay.logs.messages import Messages

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
_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


@dataclass(frozen=True, slots=True)
class PackedChunk:
    """A chunk ready to be written, with its entry of the summary."""

    record: bytes
    index: bytes
    index_offsets: Mapping[int, int]
    compressed_size: int
    uncompressed_size: int
    counts: Mapping[int, int]
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Messages as records: heads (M,), payloads, and (M,) sizes of both."""

    heads: np.ndarray[tuple[int], np.dtype[np.void]]
    payloads: list[bytes]
    sizes: Integers

    @classmethod
    def of(cls, messages: Messages, numbers: Integers) -> Batch:
        """Return messages as records, with channel numbers (M,)."""
        payloads = list(messages.payloads)
        sizes = np.fromiter(map(len, payloads), np.int64, len(payloads))
        heads = np.zeros(len(payloads), _MESSAGE)
        heads["opcode"] = Opcode.MESSAGE
        heads["length"] = sizes + (_MESSAGE.itemsize - RECORD_HEAD.size)
        heads["channel"] = numbers
        heads["sequence"] = messages.sequence
        heads["log_time"] = messages.log_time_ns
        heads["publish_time"] = messages.publish_time_ns
        return cls(heads, payloads, sizes + _MESSAGE.itemsize)


@dataclass(frozen=True, slots=True, eq=False)
class MessageRange:
    """The messages of a batch from `begin` up to, not including, `stop`."""

    batch: Batch
    begin: int
    stop: int

    @property
    def heads(self) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        return self.batch.heads[self.begin : self.stop]

    @property
    def channels(self) -> list[int]:
        """The numbers of the channels with messages in it."""
        numbers: list[int] = np.unique(self.heads["channel"]).tolist()
        return numbers

    @property
    def start_ns(self) -> int:
        """Log time of its first message."""
        return int(self.heads["log_time"][0])

    def parts(self) -> list[bytes]:
        """Return heads and payloads in turn."""
        heads = self.heads.tobytes()
        width = _MESSAGE.itemsize
        parts = [b""] * (2 * (self.stop - self.begin))
        parts[::2] = [heads[place : place + width] for place in range(0, len(heads), width)]
        parts[1::2] = self.batch.payloads[self.begin : self.stop]
        return parts


def pack(ranges: list[MessageRange], declaring: bytes, compressor: zstandard.ZstdCompressor) -> PackedChunk:
    """Pack messages into a compressed chunk with its index, after the declarations that it begins with."""
    heads = np.concatenate([each.heads for each in ranges])
    sizes = np.concatenate([each.batch.sizes[each.begin : each.stop] for each in ranges])
    content = declaring + b"".join([part for each in ranges for part in each.parts()])
    entries = np.zeros(len(heads), _INDEX_ENTRY)
    entries["log_time"] = heads["log_time"]
    entries["offset"] = len(declaring) + np.cumsum(sizes) - sizes
    index, offsets, counts = bytearray(), dict[int, int](), dict[int, int]()
    for channel in np.unique(heads["channel"]).tolist():
        listed = entries[heads["channel"] == channel].tobytes()
        offsets[channel] = len(index)
        counts[channel] = len(listed) // _INDEX_ENTRY.itemsize
        index += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, len(listed) + 6, channel, len(listed)) + listed
    compressed = compressor.compress(content)
    start_ns, end_ns = int(heads["log_time"].min()), int(heads["log_time"].max())
    chunk = records.Chunk(
        compression="zstd",
        data=compressed,
        message_start_time=start_ns,
        message_end_time=end_ns,
        uncompressed_crc=zlib.crc32(content),
        uncompressed_size=len(content),
    )
    sizes_of = len(compressed), len(content)
    return PackedChunk(encoded(chunk), bytes(index), offsets, *sizes_of, counts, start_ns, end_ns)


@dataclass(slots=True)
class McapSummary:
    """What a log holds, collected while it is written."""

    schemas: list[records.Schema] = field(default_factory=list)
    channels: list[records.Channel] = field(default_factory=list)
    chunks: list[records.ChunkIndex] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)

    def add_chunk(self, chunk: records.ChunkIndex, counts: Mapping[int, int]) -> None:
        """Take in a chunk with its number of messages by channel."""
        self.chunks.append(chunk)
        for channel, count in counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + count

    def section(self, offset: int) -> bytes:
        """Encode the section and the footer for a place in the file."""
        groups: tuple[tuple[Opcode, Sequence[records.McapRecord]], ...] = (
            (Opcode.SCHEMA, self.schemas),
            (Opcode.CHANNEL, self.channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self.chunks),
            (Opcode.ATTACHMENT_INDEX, self.attachments),
            (Opcode.METADATA_INDEX, self.metadata),
        )
        section, offsets = b"", []
        for opcode, group in groups:
            if group:
                is_index = opcode == Opcode.CHUNK_INDEX
                content = b"".join(map(_chunk_index, self.chunks)) if is_index else encoded(*group)
                offsets.append(records.SummaryOffset(opcode, offset + len(section), len(content)))
                section += content
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, offset, offset + len(section))
        section += encoded(*offsets) + footer
        return section + struct.pack("<I", zlib.crc32(section))

    def _statistics(self) -> records.Statistics:
        return records.Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=self.counts,
            chunk_count=len(self.chunks),
            message_count=sum(self.counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in self.chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self.chunks), default=0),
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


_CHUNK_INDEX = struct.Struct("<BQQQQQI")
_INDEX_OFFSET = struct.Struct("<HQ")


def _chunk_index(index: records.ChunkIndex) -> bytes:
    """Encode a chunk index as `encoded` does, in a tenth of the time: long logs have very many."""
    offsets = b"".join(_INDEX_OFFSET.pack(*each) for each in index.message_index_offsets.items())
    compression = index.compression.encode()
    rest = struct.pack("<QI", index.message_index_length, len(compression)) + compression
    rest += struct.pack("<QQ", index.compressed_size, index.uncompressed_size)
    times = index.message_start_time, index.message_end_time
    places = index.chunk_start_offset, index.chunk_length
    length = _CHUNK_INDEX.size - 9 + len(offsets) + len(rest)
    head = _CHUNK_INDEX.pack(Opcode.CHUNK_INDEX, length, *times, *places, len(offsets))
    return head + offsets + rest
