"""Write MCAP logs.

The bounds of chunks depend on bytes and log time alone, so that equal messages make equal files.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
import zstandard
from mcap import records

from spatial_replay.errors import OutputError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.mcap.chunks import MAGIC, encoded
from spatial_replay.logs.mcap.packing import Batch, McapSummary, MessageRange, PackedChunk, pack
from spatial_replay.logs.messages import Channel, Messages, Schema, messages_of
from spatial_replay.logs.output_file import output_error

CHUNK_BYTES = 128 * 2**10
"""A chunk is closed when it holds this much, uncompressed."""
CHUNK_NS = 10**9
"""A chunk is closed before a message this much later than its first one."""
COMPRESSION_LEVEL = 1
"""Coordinates hardly shrink further at higher levels, which take several times as long."""
WAITING_CHUNKS = 1024
"""Chunks that may wait for their compression."""
WAITING_BYTES = 256 * 2**20
"""Bytes of chunks that may wait for their compression: pictures and clouds of points make large ones."""


class LogWriter:
    """Writes one MCAP log to a stream, from its first byte to its last.

    Equal calls give equal bytes. How messages are divided among calls makes no difference; a `clock`
    makes one, because then a chunk is also closed when a second of its time has passed.

    Raises:
        OutputError: from any method, when the stream cannot take what is written to it.
    """

    def __init__(
        self,
        stream: BinaryIO,
        *,
        profile: str = "",
        library: str = "spatial-replay",
        clock: Callable[[], float] | None = None,
    ) -> None:
        """Begin a log.

        Args:
            stream: takes bytes; need not seek. It is flushed after each chunk, and left open.
            clock: seconds, for a log whose samples come in real time.
        """
        self._stream = stream
        self._path = Path(str(getattr(stream, "name", "the log")))
        self._clock = clock
        self._offset = 0
        self._summary = McapSummary()
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[Schema, int] = {}
        self._open: list[MessageRange] = []
        self._open_bytes = 0
        self._began_ns = 0
        self._began_s = 0.0
        self._worker = ThreadPoolExecutor(1, "chunk-compression")
        self._compressor = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL)
        self._packing: deque[Future[PackedChunk]] = deque()
        self._packing_bytes: deque[int] = deque()
        self._closed = False
        self._write(MAGIC)
        self._write_record(records.Header(profile, library))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, OutputError):
            self._worker.shutdown(cancel_futures=True)
        else:
            self.close()

    def write(self, channel: Channel, log_time_ns: int, payload: bytes, *, sequence: int = 0) -> None:
        """Add one message, published at its log time."""
        self.write_messages(messages_of(channel, np.array([log_time_ns], np.int64), (payload,), sequence))

    def write_messages(self, messages: Messages) -> None:
        """Add messages in the order given; a channel is declared before its first one."""
        if not len(messages):
            return
        self._divide(Batch.of(messages, *self._numbers(messages)), messages.log_time_ns)

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record, its keys in the order given, after closing the chunk."""
        self.flush()
        offset, length = self._write_record(records.Metadata(name, dict(data)))
        self._summary.metadata.append(records.MetadataIndex(offset=offset, length=length, name=name))

    def add_attachment(self, name: str, media_type: str, data: bytes, *, log_time_ns: int = 0) -> None:
        """Add an attachment, after closing the chunk; its time of creation is left open."""
        self.flush()
        about: dict[str, Any] = {
            "create_time": 0,
            "log_time": log_time_ns,
            "name": name,
            "media_type": media_type,
        }
        offset, length = self._write_record(records.Attachment(data=data, **about))
        index = records.AttachmentIndex(offset=offset, length=length, data_size=len(data), **about)
        self._summary.attachments.append(index)

    def flush(self) -> None:
        """Close the chunk and hand everything written so far to the operating system."""
        self._close_chunk()
        self._write_packed(0)

    def close(self) -> None:
        """Finish the log: summary, index and footer. Closing twice does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self.flush()
            self._write_record(records.DataEnd(0))
            self._write(self._summary.section(self._offset) + MAGIC)
            self._flush_stream()
        finally:
            self._worker.shutdown(cancel_futures=True)

    def _numbers(self, messages: Messages) -> tuple[Integers, dict[int, bytes]]:
        """Return (M,) channel numbers, and declarations of channels by the message that they precede."""
        known, first = np.unique(messages.channel, return_index=True)
        number = np.zeros(int(known.max()) + 1, np.int64)
        declared: dict[int, bytes] = {}
        for index in sorted(first.tolist()):
            local = int(messages.channel[index])
            channel = messages.channels[local]
            if channel not in self._channels:
                declared[index] = self._declare(channel)
            number[local] = self._channels[channel]
        return number[messages.channel], declared

    def _declare(self, channel: Channel) -> bytes:
        declaration = b""
        schema = channel.schema
        if schema is not None and schema not in self._schemas:
            number = self._schemas[schema] = len(self._schemas) + 1
            described = records.Schema(
                id=number, data=schema.data, encoding=schema.encoding, name=schema.name
            )
            self._summary.schemas.append(described)
            declaration += encoded(described)
        self._channels[channel] = len(self._channels) + 1
        record = records.Channel(
            id=self._channels[channel],
            topic=channel.topic,
            message_encoding=channel.encoding,
            metadata=dict(channel.metadata),
            schema_id=0 if schema is None else self._schemas[schema],
        )
        self._summary.channels.append(record)
        return declaration + encoded(record)

    def _divide(self, batch: Batch, times_ns: Integers) -> None:
        """Cut a batch where chunks end, and pack those that do."""
        ends = np.cumsum(batch.sizes)
        latest = np.maximum.accumulate(times_ns)
        begin = 0
        while begin < len(times_ns):
            if self._open and self._is_over(int(times_ns[begin])):
                self._close_chunk()
            if not self._open:
                self._began_ns = int(times_ns[begin])
                self._began_s = self._clock() if self._clock else 0.0
            written = int(ends[begin - 1]) if begin else 0
            full = int(np.searchsorted(ends, written + CHUNK_BYTES - self._open_bytes)) + 1
            late = bisect_left(latest, self._began_ns + CHUNK_NS, begin)
            stop = max(begin + 1, min(full, late, len(times_ns)))
            self._open.append(MessageRange(batch, begin, stop))
            self._open_bytes += int(ends[stop - 1]) - written
            if self._open_bytes >= CHUNK_BYTES:
                self._close_chunk()
            begin = stop

    def _is_over(self, time_ns: int) -> bool:
        if time_ns - self._began_ns >= CHUNK_NS:
            return True
        return self._clock is not None and (self._clock() - self._began_s) * 1e9 >= CHUNK_NS

    def _close_chunk(self) -> None:
        if self._open:
            self._packing.append(self._worker.submit(pack, self._open, self._compressor))
            self._packing_bytes.append(self._open_bytes)
            self._open, self._open_bytes = [], 0
            self._write_packed(WAITING_CHUNKS)

    def _write_packed(self, waiting: int) -> None:
        """Write chunks in their order until no more than `waiting` are left, and those that are ready."""
        while self._packing and (
            len(self._packing) > waiting
            or sum(self._packing_bytes) > WAITING_BYTES
            or self._packing[0].done()
        ):
            chunk = self._packing.popleft().result()
            self._packing_bytes.popleft()
            following = self._offset + len(chunk.record)
            index = records.ChunkIndex(
                chunk_length=len(chunk.record),
                chunk_start_offset=self._offset,
                compression="zstd",
                compressed_size=chunk.compressed_size,
                message_end_time=chunk.end_ns,
                message_index_length=len(chunk.index),
                message_index_offsets={n: following + place for n, place in chunk.index_offsets.items()},
                message_start_time=chunk.start_ns,
                uncompressed_size=chunk.uncompressed_size,
            )
            self._summary.add_chunk(index, chunk.counts)
            self._write(chunk.record)
            self._write(chunk.index)
            self._flush_stream()

    def _write_record(self, record: records.McapRecord) -> tuple[int, int]:
        """Write a record; return its place and length."""
        offset, content = self._offset, encoded(record)
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
