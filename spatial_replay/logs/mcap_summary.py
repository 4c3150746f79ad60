"""The summary section that ends an MCAP log."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from mcap import records
from mcap.opcode import Opcode

from spatial_replay.logs.mcap_records import encoded


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
        """The section and the footer, for a place in the file."""
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
                content = (
                    b"".join(map(_chunk_index, self.chunks)) if group is self.chunks else encoded(*group)
                )
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
    """A chunk index as `encoded` writes it, in a tenth of the time: long logs have very many."""
    offsets = b"".join(_INDEX_OFFSET.pack(*each) for each in index.message_index_offsets.items())
    compression = index.compression.encode()
    rest = struct.pack("<QI", index.message_index_length, len(compression)) + compression
    rest += struct.pack("<QQ", index.compressed_size, index.uncompressed_size)
    times = index.message_start_time, index.message_end_time
    places = index.chunk_start_offset, index.chunk_length
    length = _CHUNK_INDEX.size - 9 + len(offsets) + len(rest)
    head = _CHUNK_INDEX.pack(Opcode.CHUNK_INDEX, length, *times, *places, len(offsets))
    return head + offsets + rest
