"""Messages packed into chunks of an MCAP log."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import zstandard
from mcap import records
from mcap.opcode import Opcode

from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.block import Messages
from spatial_replay.logs.mcap_records import RECORD_HEAD, encoded

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
    """A chunk ready to be written, and what the summary has to know of it."""

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
    """Messages as records: heads (M,), payloads, declarations before some of them, (M,) sizes of all that."""

    heads: np.ndarray[tuple[int], np.dtype[np.void]]
    payloads: list[bytes]
    declared: Mapping[int, bytes]
    before: Integers
    sizes: Integers

    @classmethod
    def of(cls, messages: Messages, numbers: Integers, declared: Mapping[int, bytes]) -> Batch:
        """Messages with their channels' numbers in this log (M,), and declarations before some."""
        payloads = list(messages.payloads)
        sizes = np.fromiter(map(len, payloads), np.int64, len(payloads))
        heads = np.zeros(len(payloads), _MESSAGE)
        heads["opcode"] = Opcode.MESSAGE
        heads["length"] = sizes + (_MESSAGE.itemsize - RECORD_HEAD.size)
        heads["channel"] = numbers
        heads["sequence"] = messages.sequence
        heads["log_time"] = messages.log_time_ns
        heads["publish_time"] = messages.publish_time_ns
        before = np.zeros(len(payloads), np.int64)
        for index, declaration in declared.items():
            before[index] = len(declaration)
        return cls(heads, payloads, declared, before, sizes + _MESSAGE.itemsize + before)


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """The messages begin up to stop of a batch."""

    batch: Batch
    begin: int
    stop: int

    def parts(self) -> list[bytes]:
        batch, begin, stop = self.batch, self.begin, self.stop
        heads = batch.heads[begin:stop].tobytes()
        width = _MESSAGE.itemsize
        parts = [b""] * (2 * (stop - begin))
        parts[::2] = [heads[place : place + width] for place in range(0, len(heads), width)]
        parts[1::2] = batch.payloads[begin:stop]
        for index, declaration in batch.declared.items():
            if begin <= index < stop:
                parts[2 * (index - begin)] = declaration + parts[2 * (index - begin)]
        return parts


def pack(stretches: list[Stretch], compressor: zstandard.ZstdCompressor) -> PackedChunk:
    content = b"".join([part for stretch in stretches for part in stretch.parts()])
    heads = np.concatenate([stretch.batch.heads[stretch.begin : stretch.stop] for stretch in stretches])
    sizes = np.concatenate([stretch.batch.sizes[stretch.begin : stretch.stop] for stretch in stretches])
    before = np.concatenate([stretch.batch.before[stretch.begin : stretch.stop] for stretch in stretches])
    entries = np.zeros(len(heads), _INDEX_ENTRY)
    entries["log_time"] = heads["log_time"]
    entries["offset"] = np.cumsum(sizes) - sizes + before
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
    return PackedChunk(
        encoded(chunk), bytes(index), offsets, len(compressed), len(content), counts, start_ns, end_ns
    )
