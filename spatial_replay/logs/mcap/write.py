"""Write MCAP logs: messages in compressed chunks, each with its index, then the summary.

The writer is our own because equal messages must give equal bytes of chunks, however calls divide the
messages.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from threading import local
from types import TracebackType
from typing import Any, BinaryIO, Final, NamedTuple, Self
from zlib import crc32

import numpy as np
import zstandard
from mcap import records
from mcap.opcode import Opcode

from spatial_replay.compiled import cores
from spatial_replay.errors import OutputError
from spatial_replay.geometry.arrays import Integers, select
from spatial_replay.logs.mcap.index import RECORD_HEAD, encode_records
from spatial_replay.logs.messages import Channel, Messages, Schema, messages_of
from spatial_replay.logs.output_file import output_error
from spatial_replay.logs.topics import LIBRARY, MAGIC, OWN_PREFIX
from spatial_replay.logs.wire import Bytes, Payloads, stretches
from spatial_replay.trace.trace import FOREVER

CHUNK_BYTES = 512 * 2**10
"""Uncompressed size at which a chunk is closed, bytes."""
CHUNK_NS = 10**9
"""Longest time from the first to the last message of a chunk, nanoseconds."""
WHOLE_CHUNK_NS = 10 * CHUNK_NS
"""`CHUNK_NS` for a log that appears only when it is complete: fewer chunks are faster and smaller."""
REPEAT_NS = 5 * 10**9
"""Time after which a channel is declared again, nanoseconds. A channel's first two chunks declare it, too.

Declarations in every chunk would make an annotated log 15 % larger; at this interval, at most 5 %.
"""
WAITING_BYTES = 64 * 2**20
"""Maximum bytes of chunks that wait for compression; images and point clouds make large chunks."""
_PART_BYTES: Final = 4 * 2**20
"""Size of messages that are laid out as records at once, bytes."""
COMPRESSION_LEVEL: Final = 1
"""Zstandard level; higher levels take several times as long, and hardly shrink coordinates further."""
_OWN_LEVEL, _OWN_HASH_LOG = -1, 12
"""Zstandard level and table size for our own messages, which resemble their predecessors.

The small table takes a quarter less time, for 5 % more bytes.
"""

_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_HEAD_BYTES: Final = _HEAD.itemsize
# records MessageIndex and Chunk, field by field: https://mcap.dev/spec
_INDEX_HEAD: Final = struct.Struct("<BQHI")
_INDEX_ENTRY: Final = 16
"""Size of a message-index entry, bytes: log time and offset in the chunk, 8 bytes each."""
_ZSTD: Final = "zstd"
_CHUNK: Final = struct.Struct("<BQQQQII4sQ")


class _Records(NamedTuple):
    """Encoded records of M messages.

    Attributes:
        content: concatenated heads and payloads.
        channels, times_ns, sizes: (M,) channel number, log time, and record size in bytes.
    """

    content: Bytes
    channels: Integers
    times_ns: Integers
    sizes: Integers


@dataclass(slots=True)
class _Lane:
    """The open chunk of our topics, or of the other topics.

    Attributes:
        is_own: whether the topics are ours; our messages resemble their predecessors.
        records: records of the messages.
        first_ns: time of the first message.
        size: size of all records, bytes.
        began_s: clock time at which the chunk was opened, seconds.
    """

    is_own: bool
    records: list[_Records] = field(default_factory=list)
    first_ns: int = 0
    size: int = 0
    began_s: float = 0.0


def _run_ends(times_ns: Integers, lanes: Integers) -> list[int]:
    """Return the ends of runs of messages that share a lane and have times that do not decrease."""
    if len(lanes) == 1:
        return [1]
    break_indices = np.flatnonzero((np.diff(times_ns) < 0) | (np.diff(lanes) != 0)) + 1
    return [*break_indices.tolist(), len(lanes)]


class _PackedChunk(NamedTuple):
    """A chunk with its message indexes, ready to be written.

    Attributes:
        summary: index of the chunk for the log's summary; offsets are relative to the chunk.
        counts: number of messages by channel.
    """

    data: bytes
    summary: records.ChunkIndex
    counts: dict[int, int]


def _pack(lane: _Lane, declarations: bytes) -> _PackedChunk:
    """Compress the declarations and the messages of a lane to a chunk, and build its index."""
    contents, *columns = zip(*lane.records, strict=True)
    channels, times_ns, sizes = map(np.concatenate, columns)
    content = b"".join([declarations, *contents])
    compressed = _compressor(lane.is_own).compress(content)
    start_ns, end_ns = int(times_ns.min()), int(times_ns.max())
    length = _CHUNK.size - RECORD_HEAD.size + len(compressed)
    head_fields = start_ns, end_ns, len(content), crc32(content), len(_ZSTD), _ZSTD.encode(), len(compressed)
    chunk_pieces = [_CHUNK.pack(Opcode.CHUNK, length, *head_fields), compressed]
    entries = np.stack([times_ns, len(declarations) + np.cumsum(sizes) - sizes], axis=1).astype("<u8")
    record_bytes = index_offset = RECORD_HEAD.size + length
    index_offsets, message_counts = dict[int, int](), dict[int, int]()
    for channel in np.unique(channels).tolist():
        entry_bytes = entries[channels == channel].tobytes()
        index_offsets[channel] = index_offset
        message_counts[channel] = len(entry_bytes) // _INDEX_ENTRY
        chunk_pieces += (
            _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, len(entry_bytes) + 6, channel, len(entry_bytes)),
            entry_bytes,
        )
        index_offset += _INDEX_HEAD.size + len(entry_bytes)
    chunk_index = records.ChunkIndex(
        chunk_length=record_bytes,
        chunk_start_offset=0,
        compression=_ZSTD,
        compressed_size=len(compressed),
        message_end_time=end_ns,
        message_index_length=index_offset - record_bytes,
        message_index_offsets=index_offsets,
        message_start_time=start_ns,
        uncompressed_size=len(content),
    )
    return _PackedChunk(b"".join(chunk_pieces), chunk_index, message_counts)


_local = local()


def _compressor(is_own: bool) -> zstandard.ZstdCompressor:
    """Return a compressor of this thread."""
    # instances are not thread-safe: https://python-zstandard.readthedocs.io/en/latest/compressor.html
    if not hasattr(_local, "compressors"):
        parameters = zstandard.ZstdCompressionParameters.from_level(_OWN_LEVEL, hash_log=_OWN_HASH_LOG)
        _local.compressors = (
            zstandard.ZstdCompressor(level=COMPRESSION_LEVEL),
            zstandard.ZstdCompressor(compression_params=parameters),
        )
    compressors: tuple[zstandard.ZstdCompressor, zstandard.ZstdCompressor] = _local.compressors
    return compressors[is_own]


@dataclass(slots=True)
class _Summary:
    """Content of a log, collected while it is written."""

    schemas: list[records.Schema] = field(default_factory=list)
    channels: list[records.Channel] = field(default_factory=list)
    chunks: list[bytes] = field(default_factory=list)
    attachments: list[records.AttachmentIndex] = field(default_factory=list)
    metadata: list[records.MetadataIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int = FOREVER
    end_ns: int = 0

    def add(self, chunk: _PackedChunk, offset: int) -> None:
        """Add a chunk at its offset in the file."""
        index = chunk.summary
        file_offsets = {
            channel: offset + chunk_offset for channel, chunk_offset in index.message_index_offsets.items()
        }
        self.chunks.append(
            encode_records(replace(index, chunk_start_offset=offset, message_index_offsets=file_offsets))
        )
        self.counts.update(chunk.counts)
        self.start_ns = min(self.start_ns, index.message_start_time)
        self.end_ns = max(self.end_ns, index.message_end_time)

    def section(self, offset: int) -> bytes:
        """Encode the summary section and the footer for an offset in the file."""
        record_groups = (
            (Opcode.SCHEMA, encode_records(*self.schemas)),
            (Opcode.CHANNEL, encode_records(*self.channels)),
            (Opcode.STATISTICS, encode_records(self._statistics())),
            (Opcode.CHUNK_INDEX, b"".join(self.chunks)),
            (Opcode.ATTACHMENT_INDEX, encode_records(*self.attachments)),
            (Opcode.METADATA_INDEX, encode_records(*self.metadata)),
        )
        section, summary_offsets = b"", []
        for opcode, content in record_groups:
            if content:
                summary_offsets.append(records.SummaryOffset(opcode, offset + len(section), len(content)))
                section += content
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, offset, offset + len(section))
        section += encode_records(*summary_offsets) + footer
        # the checksum covers the footer up to itself: https://mcap.dev/spec#footer-op0x02
        return section + struct.pack("<I", crc32(section))

    def _statistics(self) -> records.Statistics:
        return records.Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=len(self.chunks),
            message_count=self.counts.total(),
            message_end_time=self.end_ns,
            message_start_time=self.start_ns if self.chunks else 0,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


@dataclass(slots=True)
class _Declaration:
    """Records of a channel and its schema.

    Attributes:
        count: number of chunks that have these records.
        due_ns: time from which the next chunk repeats these records, nanoseconds.
    """

    schema: bytes
    channel: bytes
    count: int = 0
    due_ns: int = -FOREVER


class LogWriter:
    """Writes one MCAP log to a stream, from its first byte to its last.

    Equal messages give equal bytes, however calls divide them. With a `clock`, the bytes also depend on the
    times of calls, because a chunk is closed after a second of the clock.

    Raises:
        OutputError: from any method, if a write to the stream fails.
    """

    def __init__(
        self,
        stream: BinaryIO,
        *,
        profile: str = "",
        chunk_ns: int = CHUNK_NS,
        clock: Callable[[], float] | None = None,
    ) -> None:
        """Begin a log.

        Args:
            stream: binary stream, which need not seek. It is flushed after each chunk, and left open.
            chunk_ns: longest time from the first to the last message of a chunk.
            clock: clock in seconds, for a log of samples in real time.
        """
        self._stream = stream
        self._path = Path(str(getattr(stream, "name", "the log")))
        self._chunk_ns = chunk_ns
        self._clock = clock
        self._offset = 0
        self._summary = _Summary()
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[Schema, int] = {}
        self._declarations: dict[int, _Declaration] = {}
        self._lanes = [_Lane(is_own=True), _Lane(is_own=False)]
        self._threads = ThreadPoolExecutor(cores(), "packing")
        self._packing: deque[tuple[int, Future[_PackedChunk]]] = deque()
        self._packing_bytes = 0
        self._is_closed = False
        self._write(MAGIC)
        self._write_record(records.Header(profile, LIBRARY))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # a summary cannot be written to a failed stream
        if isinstance(error, OutputError):
            self._threads.shutdown(cancel_futures=True)
        else:
            self.close()

    def write(self, channel: Channel, log_time_ns: int, payload: bytes, *, sequence: int = 0) -> None:
        """Add one message; its publish time is its log time."""
        self.write_messages(messages_of(channel, np.array([log_time_ns], np.int64), (payload,), sequence))

    def write_messages(self, messages: Messages) -> None:
        """Add messages in the order given."""
        if not len(messages):
            return
        channel_numbers, lanes = self._numbers(messages)
        for lane_number, lane in enumerate(self._lanes):
            if lane.records and self._clock and (self._clock() - lane.began_s) * 1e9 >= CHUNK_NS:
                self._end(lane_number)
        payloads = Payloads.of(messages.payloads)
        payload_ends = np.cumsum(payloads.size)
        begin = 0
        while begin < len(messages):
            # messages are laid out in parts, which reuse memory: new memory takes as long as filling it
            filled_bytes = int(payload_ends[begin]) - int(payloads.size[begin]) + _PART_BYTES
            end = max(begin + 1, int(np.searchsorted(payload_ends, filled_bytes)))
            part_messages = select(replace(messages, payloads=payloads), slice(begin, end))
            self._write_part(part_messages, channel_numbers[begin:end], lanes[begin:end])
            begin = end

    def _write_part(self, messages: Messages, numbers: Integers, lanes: Integers) -> None:
        """Add messages with their channel numbers in `numbers` (M,) and their lanes in `lanes` (M,)."""
        payloads = Payloads.of(messages.payloads)
        sizes = payloads.size + _HEAD_BYTES
        heads = np.zeros(len(messages), _HEAD)
        heads["opcode"] = Opcode.MESSAGE
        heads["length"] = sizes - RECORD_HEAD.size
        heads["channel"] = numbers
        heads["sequence"] = messages.sequence
        heads["log_time"] = messages.log_time_ns
        heads["publish_time"] = messages.publish_time_ns
        # records of one lane are adjacent, so that a run of messages is one slice
        lane_order = np.argsort(lanes, kind="stable")
        record_starts = np.empty(len(messages), np.int64)
        record_starts[lane_order] = np.cumsum(sizes[lane_order]) - sizes[lane_order]
        content = np.empty(int(sizes.sum()), np.uint8)
        stretches(content, _HEAD_BYTES)[record_starts] = heads.view(f"V{_HEAD_BYTES}")
        payloads.copy_into(content, record_starts + _HEAD_BYTES)
        records_of_part = _Records(content, numbers, messages.log_time_ns, sizes)
        begin = 0
        for end in _run_ends(messages.log_time_ns, lanes):
            self._fill(int(lanes[begin]), records_of_part, record_starts, begin, end)
            begin = end

    def _fill(self, lane_number: int, part: _Records, starts: Integers, begin: int, end: int) -> None:
        """Add messages of one lane, with times that do not decrease, chunk by chunk."""
        times_ns = part.times_ns
        while begin < end:
            time_ns = int(times_ns[begin])
            for open_lane, lane in enumerate(self._lanes):
                if lane.records and time_ns - lane.first_ns >= self._chunk_ns:
                    self._end(open_lane)
            lane = self._lanes[lane_number]
            if not lane.records:
                lane.began_s = self._clock() if self._clock else 0.0
                lane.first_ns = time_ns
            first_ns = min([time_ns, *(lane.first_ns for lane in self._lanes if lane.records)])
            # all messages up to the end of the chunk are added at once; one by one, each takes 2 µs
            stop_index = begin + int(np.searchsorted(times_ns[begin:end], first_ns + self._chunk_ns))
            start_offset, last_index = int(starts[begin]), stop_index - 1
            added_bytes = int(starts[last_index] + part.sizes[last_index]) - start_offset
            if added_bytes + lane.size >= CHUNK_BYTES:
                full_offset = start_offset + CHUNK_BYTES - lane.size
                stop_index = begin + 1 + int(np.searchsorted(starts[begin + 1 : stop_index], full_offset))
                last_index = stop_index - 1
                added_bytes = int(starts[last_index] + part.sizes[last_index]) - start_offset
            columns = (column[begin:stop_index] for column in part[1:])
            lane.records.append(_Records(part.content[start_offset : start_offset + added_bytes], *columns))
            lane.size += added_bytes
            if lane.size >= CHUNK_BYTES:
                self._end(lane_number)
            begin = stop_index

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Close the chunks, and add a metadata record with its keys in the given order."""
        self.flush()
        offset, length = self._write_record(records.Metadata(name, dict(data)))
        self._summary.metadata.append(records.MetadataIndex(offset=offset, length=length, name=name))

    def add_attachment(
        self, name: str, media_type: str, data: bytes, *, log_time_ns: int = 0, create_time_ns: int = 0
    ) -> None:
        """Close the chunks, and add an attachment; unknown times are 0."""
        self.flush()
        attributes: dict[str, Any] = {
            "create_time": create_time_ns,
            "log_time": log_time_ns,
            "name": name,
            "media_type": media_type,
        }
        offset, length = self._write_record(records.Attachment(data=data, **attributes))
        index = records.AttachmentIndex(offset=offset, length=length, data_size=len(data), **attributes)
        self._summary.attachments.append(index)

    def flush(self) -> None:
        """Close the chunks and hand everything written so far to the operating system."""
        for lane_number, lane in enumerate(self._lanes):
            if lane.records:
                self._end(lane_number)
        self._write_ready_chunks(0)

    def close(self) -> None:
        """Finish the log: summary, index and footer. Closing twice does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        try:
            self.flush()
            # 0: no checksum of the data section, as each chunk has one: https://mcap.dev/spec#data-end-op0x0f
            self._write_record(records.DataEnd(0))
            self._write(self._summary.section(self._offset) + MAGIC)
            self._flush_stream()
        finally:
            self._threads.shutdown(cancel_futures=True)

    def _numbers(self, messages: Messages) -> tuple[Integers, Integers]:
        """Return (M,) channel numbers and (M,) lanes; new channels are numbered in order of appearance."""
        local_numbers, first_indices = np.unique(messages.channel, return_index=True)
        log_numbers = np.zeros(int(local_numbers.max()) + 1, np.int64)
        lane_by_number = np.zeros(len(log_numbers), np.int64)
        for local_number in local_numbers[np.argsort(first_indices)].tolist():
            channel = messages.channels[local_number]
            lane_by_number[local_number] = not channel.topic.startswith(OWN_PREFIX)
            if channel not in self._channels:
                self._declare(channel)
            log_numbers[local_number] = self._channels[channel]
        return log_numbers[messages.channel], lane_by_number[messages.channel]

    def _declare(self, channel: Channel) -> None:
        """Number a channel and its schema, and encode their declarations."""
        schema, schema_bytes = channel.schema, b""
        if schema is not None:
            is_new = schema not in self._schemas
            number = self._schemas.setdefault(schema, len(self._schemas) + 1)
            schema_record = records.Schema(
                id=number, data=schema.data, encoding=schema.encoding, name=schema.name
            )
            if is_new:
                self._summary.schemas.append(schema_record)
            schema_bytes = encode_records(schema_record)
        self._channels[channel] = len(self._channels) + 1
        channel_record = records.Channel(
            id=self._channels[channel],
            topic=channel.topic,
            message_encoding=channel.encoding,
            metadata=dict(channel.metadata),
            schema_id=0 if schema is None else self._schemas[schema],
        )
        self._summary.channels.append(channel_record)
        self._declarations[channel_record.id] = _Declaration(schema_bytes, encode_records(channel_record))

    def _end(self, lane_number: int) -> None:
        """Close the open chunk of a lane: pack it on another thread, and write the chunks that are ready."""
        lane = self._lanes[lane_number]
        self._lanes[lane_number] = _Lane(lane.is_own)
        self._packing.append((lane.size, self._threads.submit(_pack, lane, self._due_declarations(lane))))
        self._packing_bytes += lane.size
        self._write_ready_chunks(WAITING_BYTES)

    def _due_declarations(self, lane: _Lane) -> bytes:
        """Return the declarations at the beginning of a chunk, each schema once."""
        start_ns = lane.first_ns
        counts = sum(np.bincount(part.channels, minlength=len(self._channels) + 1) for part in lane.records)
        declarations = [self._declarations[number] for number in np.flatnonzero(counts).tolist()]
        due_declarations = [declaration for declaration in declarations if start_ns >= declaration.due_ns]
        # declarations are repeated, so that a broken chunk does not take them from other chunks
        for declaration in due_declarations:
            declaration.count += 1
            declaration.due_ns = -FOREVER if declaration.count < 2 else start_ns + REPEAT_NS
        return b"".join(
            chain(
                dict.fromkeys(declaration.schema for declaration in due_declarations),
                (declaration.channel for declaration in due_declarations),
            )
        )

    def _write_ready_chunks(self, waiting_bytes: int) -> None:
        """Write packed chunks in order; wait for packing while more than `waiting_bytes` are pending."""
        while self._packing and (self._packing_bytes > waiting_bytes or self._packing[0][1].done()):
            chunk_bytes, future = self._packing.popleft()
            chunk = future.result()
            self._packing_bytes -= chunk_bytes
            self._summary.add(chunk, self._offset)
            self._write(chunk.data)
            self._flush_stream()

    def _write_record(self, record: records.McapRecord) -> tuple[int, int]:
        """Write a record; return its offset and length."""
        offset, content = self._offset, encode_records(record)
        self._write(content)
        return offset, len(content)

    def _write(self, data: bytes) -> None:
        try:
            self._stream.write(data)
        except OSError as error:
            raise output_error(self._path, error) from error
        self._offset += len(data)

    def _flush_stream(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            raise output_error(self._path, error) from error
