"""Write MCAP logs.

The bounds of chunks depend on topics, bytes and log time alone, so that equal messages make equal files.
Messages of /spatial/* have chunks of their own: who wants them need not read the camera images between them.
Schemas and channels are declared again and again: the first chunk of a log that was never closed may be
broken, and the others can be read without it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from mcap import records

from spatial_replay.compiled import elementwise, long_kernel
from spatial_replay.cores import Work, drop, first_result
from spatial_replay.errors import OutputError
from spatial_replay.geometry.arrays import Integers, counts_from_starts
from spatial_replay.logs.mcap.chunk_content import Batch, MessageRange, OpenChunk
from spatial_replay.logs.mcap.chunk_records import encoded
from spatial_replay.logs.mcap.packing import McapSummary, PackedChunks, pack
from spatial_replay.logs.messages import Channel, Messages, Schema, messages_of, select
from spatial_replay.logs.output_file import output_error
from spatial_replay.logs.topics import LIBRARY, MAGIC, OWN_PREFIX
from spatial_replay.trace.sample import FOREVER

CHUNK_BYTES = 512 * 2**10
"""A chunk is closed when it holds this much, uncompressed."""
CHUNK_NS = 10**9
"""A chunk is closed before a message this much later than its first one."""
WHOLE_CHUNK_NS = 10 * CHUNK_NS
"""The same for a log that appears only when it is whole: fewer chunks are quicker and smaller."""
REPEAT_NS = 5 * 10**9
"""A channel is declared again in the second chunk with its messages, and in one this much after the last that
declares it. In every chunk, schemas would add 15 % to an annotated log; so they add up to 5 %."""
TOGETHER_BYTES = 4 * CHUNK_BYTES
"""So much is packed at once: messages are encoded together, and stay in the cache of the processor."""
WAITING_BYTES = 64 * 2**20
"""Bytes of chunks that may wait for their compression: pictures and clouds of points make large ones."""


@dataclass(slots=True)
class _Lane:
    """The open chunk of some topics: its messages, their bytes, and when it began by the clock."""

    open: list[MessageRange] = field(default_factory=list)
    open_bytes: int = 0
    began_s: float = 0.0


@dataclass(slots=True)
class _Declaration:
    """A channel and its schema as records, in how many chunks they were declared, and from when on the next
    one does."""

    schema: bytes
    channel: bytes
    count: int = 0
    due_ns: int = -FOREVER


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
        library: str = LIBRARY,
        chunk_ns: int = CHUNK_NS,
        clock: Callable[[], float] | None = None,
    ) -> None:
        """Begin a log.

        Args:
            stream: takes bytes; need not seek. It is flushed after each chunk, and left open.
            chunk_ns: a chunk is closed before a message this much later than its first one.
            clock: seconds, for a log whose samples come in real time.
        """
        self._stream = stream
        self._path = Path(str(getattr(stream, "name", "the log")))
        self._chunk_ns = chunk_ns
        self._clock = clock
        self._offset = 0
        self._summary = McapSummary()
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[Schema, int] = {}
        self._declarations: dict[int, _Declaration] = {}
        self._lanes = (_Lane(), _Lane())
        self._began_ns = np.zeros(len(self._lanes), np.int64)
        self._undue: tuple[frozenset[int], int] = frozenset(), 0
        self._packing: deque[tuple[int, Work[PackedChunks]]] = deque()
        self._packing_bytes = 0
        self._closed = False
        self._write(MAGIC)
        self._write_record(records.Header(profile, library))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, OutputError):
            drop(work for _, work in self._packing)
        else:
            self.close()

    def write(self, channel: Channel, log_time_ns: int, payload: bytes, *, sequence: int = 0) -> None:
        """Add one message, published at its log time."""
        self.write_messages(messages_of(channel, np.array([log_time_ns], np.int64), (payload,), sequence))

    def write_messages(self, messages: Messages) -> None:
        """Add messages in the order given."""
        if not len(messages):
            return
        numbers, lanes = self._numbers(messages)
        closed = [self._take(lane) for lane in self._lanes if lane.open and self._is_over(lane)]
        batches = []
        for number in range(len(self._lanes)):
            places = np.flatnonzero(lanes == number)
            own = messages if len(places) == len(messages) else select(messages, places)
            batches.append(Batch.of(own, numbers[places]) if len(places) else None)
        sizes = np.empty(len(messages), np.int64)
        for number, batch in enumerate(batches):
            if batch is not None:
                sizes[lanes == number] = counts_from_starts(batch.start)
        open_bytes = np.array([lane.open_bytes if lane.open else -1 for lane in self._lanes], np.int64)
        ends = np.empty((len(messages) + len(self._lanes), 2), np.int64)
        # a copy, since a kernel is compiled again for arrays that are read-only
        times_ns = messages.log_time_ns.copy()
        count = _divide(times_ns, sizes, lanes, self._chunk_ns, self._began_ns, open_bytes, ends)
        taken = [0] * len(self._lanes)
        for number, stop in ends[:count].tolist():
            self._extend(number, batches[number], taken[number], stop)
            closed.append(self._take(self._lanes[number]))
            taken[number] = stop
        for number, batch in enumerate(batches):
            if batch is not None:
                self._extend(number, batch, taken[number], len(batch))
        self._pack(closed)

    def _extend(self, number: int, batch: Batch | None, begin: int, stop: int) -> None:
        """Add messages of a batch to the open chunk of a lane."""
        if batch is not None and stop > begin:
            lane = self._lanes[number]
            if not lane.open and self._clock:
                lane.began_s = self._clock()
            lane.open.append(MessageRange(batch, begin, stop))
            lane.open_bytes += lane.open[-1].size

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record, its keys in the order given, after closing the chunk."""
        self.flush()
        offset, length = self._write_record(records.Metadata(name, dict(data)))
        self._summary.metadata.append(records.MetadataIndex(offset=offset, length=length, name=name))

    def add_attachment(
        self, name: str, media_type: str, data: bytes, *, log_time_ns: int = 0, create_time_ns: int = 0
    ) -> None:
        """Add an attachment, after closing the chunk; its times are left open unless given."""
        self.flush()
        about: dict[str, Any] = {
            "create_time": create_time_ns,
            "log_time": log_time_ns,
            "name": name,
            "media_type": media_type,
        }
        offset, length = self._write_record(records.Attachment(data=data, **about))
        index = records.AttachmentIndex(offset=offset, length=length, data_size=len(data), **about)
        self._summary.attachments.append(index)

    def flush(self) -> None:
        """Close the chunks and hand everything written so far to the operating system."""
        self._pack([self._take(lane) for lane in self._lanes if lane.open])
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
            drop(work for _, work in self._packing)

    def _numbers(self, messages: Messages) -> tuple[Integers, Integers]:
        """Return (M,) channel numbers and (M,) lanes; channels that are new are numbered as they come."""
        known, first = np.unique(messages.channel, return_index=True)
        number = np.zeros(int(known.max()) + 1, np.int64)
        lane = np.zeros(len(number), np.int64)
        for local in known[np.argsort(first)].tolist():
            channel = messages.channels[local]
            lane[local] = not channel.topic.startswith(OWN_PREFIX)
            if channel not in self._channels:
                self._declare(channel)
            number[local] = self._channels[channel]
        return number[messages.channel], lane[messages.channel]

    def _declare(self, channel: Channel) -> None:
        """Number a channel and its schema, and prepare the records that chunks declare them with."""
        schema, described = channel.schema, b""
        if schema is not None:
            is_new = schema not in self._schemas
            number = self._schemas.setdefault(schema, len(self._schemas) + 1)
            record = records.Schema(id=number, data=schema.data, encoding=schema.encoding, name=schema.name)
            if is_new:
                self._summary.schemas.append(record)
            described = encoded(record)
        self._channels[channel] = len(self._channels) + 1
        declared = records.Channel(
            id=self._channels[channel],
            topic=channel.topic,
            message_encoding=channel.encoding,
            metadata=dict(channel.metadata),
            schema_id=0 if schema is None else self._schemas[schema],
        )
        self._summary.channels.append(declared)
        self._declarations[declared.id] = _Declaration(described, encoded(declared))

    def _is_over(self, lane: _Lane) -> bool:
        """Return whether a second of the clock has passed since a chunk began."""
        return self._clock is not None and (self._clock() - lane.began_s) * 1e9 >= CHUNK_NS

    def _take(self, lane: _Lane) -> OpenChunk:
        """Return the open chunk of a lane, and begin an empty one."""
        declaring = self._declaring(lane.open)
        chunk = OpenChunk(lane.open, lane.open_bytes, declaring, is_own=lane is self._lanes[0])
        lane.open, lane.open_bytes = [], 0
        return chunk

    def _pack(self, closed: Sequence[OpenChunk]) -> None:
        """Pack chunks on other threads, some together, and write those that are ready."""
        together, size = list[OpenChunk](), 0
        for number, chunk in enumerate(closed, start=1):
            together.append(chunk)
            size += chunk.size
            if size >= TOGETHER_BYTES or number == len(closed):
                work = Work(partial(pack, together))
                self._packing.append((size, work))
                work.hand_out()
                self._packing_bytes += size
                self._write_packed(WAITING_BYTES)
                together, size = [], 0

    def _declaring(self, ranges: Sequence[MessageRange]) -> bytes:
        """Return the declarations that a chunk begins with; each schema is in it once."""
        start_ns = ranges[0].start_ns
        numbers = frozenset[int]().union(*(own.channels for own in ranges))
        undue, until_ns = self._undue
        if start_ns < until_ns and numbers <= undue:
            return b""
        own = [self._declarations[number] for number in sorted(numbers)]
        due = [each for each in own if start_ns >= each.due_ns]
        for each in due:
            each.count += 1
            each.due_ns = -FOREVER if each.count < 2 else start_ns + REPEAT_NS
        self._undue = numbers, min(each.due_ns for each in own)
        return b"".join([*dict.fromkeys(each.schema for each in due), *(each.channel for each in due)])

    def _write_packed(self, waiting_bytes: int) -> None:
        """Write chunks in their order until no more bytes are waiting, and those that are ready."""
        while self._packing and (self._packing_bytes > waiting_bytes or self._packing[0][1].is_done):
            packed = first_result(work for _, work in self._packing)
            size, _ = self._packing.popleft()
            self._summary.add(packed, self._offset)
            for piece in packed.data:
                self._write(piece)
            self._packing_bytes -= size
            self._flush_stream()

    def _write_record(self, record: records.McapRecord) -> tuple[int, int]:
        """Write a record; return its place and length."""
        offset, content = self._offset, encoded(record)
        self._write(content)
        return offset, len(content)

    def _write(self, data: Any) -> None:
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


@elementwise
@long_kernel
def _divide(
    times_ns: Integers,
    sizes: Integers,
    lanes: Integers,
    chunk_ns: int,
    began_ns: Integers,
    open_bytes: Integers,
    ends: Integers,
) -> int:
    """Find where chunks end: each that is full, or that a late message of whatever lane comes after.

    Args:
        times_ns, sizes, lanes: (M,) of each message: its log time, the bytes of its record, its lane.
        chunk_ns: how long after the first message of a chunk the next one begins at the latest.
        began_ns: (L,) when the open chunk of each lane began.
        open_bytes: (L,) how much is in it, negative where none is open.
        ends: (M + L, 2), to be filled in: the lane of each chunk that ends, after how many of its messages.

    Returns:
        How many chunks end.
    """
    count = 0
    taken = np.zeros(open_bytes.shape[0], np.int64)
    for i in range(times_ns.shape[0]):
        for lane in range(open_bytes.shape[0]):
            if open_bytes[lane] >= 0 and times_ns[i] - began_ns[lane] >= chunk_ns:
                ends[count, 0], ends[count, 1] = lane, taken[lane]
                open_bytes[lane] = -1
                count += 1
        lane = lanes[i]
        if open_bytes[lane] < 0:
            open_bytes[lane], began_ns[lane] = 0, times_ns[i]
        open_bytes[lane] += sizes[i]
        taken[lane] += 1
        if open_bytes[lane] >= CHUNK_BYTES:
            ends[count, 0], ends[count, 1] = lane, taken[lane]
            open_bytes[lane] = -1
            count += 1
    return count
