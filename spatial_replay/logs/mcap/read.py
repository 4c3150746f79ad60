"""Read our own MCAP logs, whole or damaged, in blocks of samples with their messages.

The reader is our own for two reasons. The MCAP library fails 112 of the 416 files of the format's conformance
suite. It gives up on truncated and unindexed files, which crashed recorders leave behind.

Chunks may overlap in time. So chunks are read in the order of their start times, and a message is yielded
only when no later chunk can hold an earlier message.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from threading import RLock
from types import MappingProxyType
from typing import Any, BinaryIO, Final, TypeAlias
from zlib import crc32

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.opcode import Opcode

from spatial_replay.compiled import cores
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Integers, concatenate_tables, select
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.mcap.index import (
    CHUNK_HEAD,
    RECORD_HEAD,
    ChunkPlace,
    DamageError,
    Directory,
    check_attachments,
    chunk_place,
    decode_record,
    iter_attachments,
    iter_metadata,
    read_directory,
)
from spatial_replay.logs.messages import Attachment, Block, Channel, Messages, Schema
from spatial_replay.logs.objects import decode_objects
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.remote import RemoteFile, each_ahead, open_file, plan_reads
from spatial_replay.logs.source import BLOCK_SAMPLES, FileSource, noting_pauses
from spatial_replay.logs.topics import (
    ALL,
    DERIVED,
    DOUBTS,
    METADATA,
    OBJECTS,
    OBJECTS_TYPE,
    ORIGINAL_PREFIX,
    RECOVERY,
    copied_channel,
    has_our_type,
    is_kept,
    remarks_on_copies,
)
from spatial_replay.text import Instant, Sentence, listing, plural
from spatial_replay.trace.doubts import doubts_from_metadata
from spatial_replay.trace.trace import LATEST_NS, Trace
from spatial_replay.trace.units import Axes

ALWAYS_ALLOWED, MOST_TIMES_LARGER = 2**26, 1_000
"""Limits of a decompressed chunk or message: bytes that are always allowed, and compression ratio."""
_ALWAYS_WAITING, _MOST_TIMES_WAITING = 2**28, 20
"""Limits of messages that wait for other chunks: bytes, and multiple of the log; the larger limit applies."""
_AHEAD_BYTES: Final = 2**24
"""Maximum decompressed size of the chunks read ahead, bytes; one chunk per core is always read ahead."""
BLOCK_BYTES = 64 * 2**20
"""Size of messages at which a block is closed, bytes."""
AFTER_ALL_NS = 2**64
"""A time after all times of MCAP, which are unsigned 64-bit integers."""
_LEAST_BOUND: Final = 2**20
"""Chunks up to this size are accepted whatever size the index gives, bytes; some writers leave sizes out."""
_LONGEST_HEAD: Final = 80
_CHANNELS: Final = 2**16
"""Number of channels that a file can have."""


def most_waiting(lengths: Iterable[int]) -> int:
    """Return the limit of waiting messages, bytes, from the lengths of all chunks."""
    return max(_ALWAYS_WAITING, _MOST_TIMES_WAITING * sum(lengths))


def too_many_waiting(name: str, most: int) -> LogError:
    """Return the error for waiting messages of more than `most` bytes."""
    return LogError(
        f"{name}: chunks that overlap in time hold more than {most} bytes of messages, far more than the log;"
        " give a part of it by --start and --end, or fewer topics"
    )


def _content(place: ChunkPlace, record: bytes) -> bytes:
    """Return the decompressed records of a place.

    Raises:
        DamageError: the chunk breaks off, does not decompress, or fails its checksum.
    """
    if len(record) < place.length:
        raise DamageError("the chunk breaks off")
    if not place.compressed:
        return record
    chunk_place(place.offset, record[:_LONGEST_HEAD], len(record))
    _, _, size, checksum, name_length = CHUNK_HEAD.unpack_from(record, RECORD_HEAD.size)
    if size > max(place.size, _LEAST_BOUND):
        raise DamageError(f"the chunk claims to hold {size} bytes, but the index says {place.size}")
    name_offset = RECORD_HEAD.size + CHUNK_HEAD.size
    data_offset = name_offset + name_length + 8
    content = _decompress(
        record[name_offset : name_offset + name_length], memoryview(record)[data_offset:], size
    )
    if len(content) != size:
        raise DamageError(f"the chunk holds {len(content)} bytes instead of {size}")
    if (checksum or place.has_checksum) and crc32(content) != checksum:
        if not checksum:
            raise DamageError("the chunk has no checksum, and every log of ours has one")
        raise DamageError("the chunk's checksum does not fit its content")
    return content


def _decompress(compression: bytes, data: memoryview, size: int) -> bytes:
    if compression and size > max(ALWAYS_ALLOWED, MOST_TIMES_LARGER * len(data)):
        raise DamageError(f"the chunk claims to hold {size} bytes in {len(data)}")
    try:
        if compression == b"zstd":
            # zstandard ignores max_output_size if the frame has its size:
            # https://python-zstandard.readthedocs.io/en/latest/decompressor.html
            if zstandard.frame_content_size(data) > size:
                raise DamageError("the chunk holds more than it says")
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        if compression == b"lz4":
            # one more byte reveals a chunk that is larger than its head says
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise DamageError(f"the chunk does not decompress ({error})") from None
    if compression:
        raise DamageError(f"the chunk is compressed as {compression!r}; known are zstd and lz4")
    return bytes(data)


def iter_records(
    stream: BinaryIO, places: Sequence[ChunkPlace]
) -> Iterator[tuple[ChunkPlace, bytes | DamageError]]:
    """Yield places in their order, each with its decompressed records or its damage.

    Threads read ahead from the stream, so the caller must not read from the stream.
    """
    plan_reads(stream, ((place.offset, place.offset + place.length) for place in places))
    stream_lock, is_over = RLock(), False

    def read(place: ChunkPlace) -> bytes | DamageError:
        with stream_lock:
            # the caller may have closed the stream
            if is_over:
                return b""
            stream.seek(place.offset)
            record = stream.read(place.length)
        try:
            return _content(place, record)
        except DamageError as damage:
            return damage

    # a short log has one chunk, which needs no thread
    results: Iterator[bytes | DamageError] = map(read, places)
    if len(places) > 1:
        results = each_ahead(read, places, cores(), _AHEAD_BYTES, lambda place: max(place.length, place.size))
    try:
        yield from zip(places, results, strict=True)
    finally:
        with stream_lock:
            is_over = True


MessageHeads: TypeAlias = np.ndarray[Any, np.dtype[np.void]]
"""(M,) with the fields channel, sequence, log_time and publish_time."""
_SCHEMA, _CHANNEL, _MESSAGE = int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)
_HEAD: Final = np.dtype(
    [("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")]
)
_HEAD_BYTES: Final = _HEAD.itemsize


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """Messages and declarations in the bytes of a chunk, in the chunk's order.

    Attributes:
        heads: (M,) heads of the messages.
        payloads: slices of the bytes, one for the payload of each message.
        declarations: opcodes and bodies of schemas and channels.
        breaks_off: whether the last record is incomplete.
    """

    heads: MessageHeads
    payloads: Sequence[slice]
    declarations: Sequence[tuple[int, bytes]]
    breaks_off: bool


def split_records(content: bytes, passed_over: Collection[int] = ()) -> Records:
    """Return the messages and declarations in decompressed records, up to an incomplete record.

    Args:
        passed_over: channels whose messages are left out.
    """
    heads, payloads = list[bytes](), list[slice]()
    declarations = list[tuple[int, bytes]]()
    position, size, unpack = 0, len(content), RECORD_HEAD.unpack_from
    while position + RECORD_HEAD.size <= size:
        opcode, length = unpack(content, position)
        begin = position + RECORD_HEAD.size
        if length > size - begin:
            break
        position = begin + length
        if opcode == _MESSAGE:
            if length >= _HEAD_BYTES and content[begin] | content[begin + 1] << 8 not in passed_over:
                payload_offset = begin + _HEAD_BYTES
                heads.append(content[begin:payload_offset])
                payloads.append(slice(payload_offset, position))
        elif opcode in (_SCHEMA, _CHANNEL):
            declarations.append((opcode, content[begin:position]))
    return Records(np.frombuffer(b"".join(heads), _HEAD), payloads, declarations, position < size)


class ChunkWalk:
    """The messages of a log by chunk, and the channels that are declared so far."""

    def __init__(
        self,
        stream: BinaryIO,
        directory: Directory,
        faults: FaultList,
        name: str,
        renamed: Callable[[Channel], Channel] = lambda channel: channel,
    ) -> None:
        """Begin with the channels that the directory declares.

        Args:
            renamed: function that returns the output's channel for a channel of the log.
        """
        self._renamed = renamed
        self.stream = stream
        self.faults = faults
        self.name = name
        self.directory = directory
        self._schemas = dict(directory.schemas)
        self.channels: dict[int, Channel] = {}
        self._is_declared, self._is_objects = np.zeros(_CHANNELS, np.bool_), np.zeros(_CHANNELS, np.bool_)
        self.places = sorted(directory.chunks, key=lambda place: (place.start_ns, place.offset))
        for channel in directory.channels.values():
            self._declare(channel)
        if directory.statistics is None:
            self._find_channels()

    def iter_messages(
        self, places: Sequence[ChunkPlace], is_wanted: Callable[[str], bool] = lambda topic: True
    ) -> Iterator[tuple[ChunkPlace, Messages]]:
        """Yield the messages of wanted topics in each place; losses go to `faults`."""
        declared_count, unwanted = -1, set[int]()
        for place, content in iter_records(self.stream, places):
            if declared_count < len(self.channels):
                declared_count = len(self.channels)
                unwanted = {n for n, channel in self.channels.items() if not is_wanted(channel.topic)}
            if isinstance(content, DamageError):
                self._fault(place, f"{content}; the ", " are lost")
                yield place, Messages(self.channels)
                continue
            messages = self._messages(place, split_records(content, unwanted), content)
            if declared_count < len(self.channels):
                # this chunk declares channels, and their topics may not be wanted
                topics = [self.channels[n].topic for n in messages.channel.tolist()]
                messages = select(messages, np.flatnonzero(np.fromiter(map(is_wanted, topics), np.bool_)))
            yield place, messages

    def sample_count(self, messages: Messages) -> int:
        """Count the samples among messages."""
        return int(np.count_nonzero(self._is_objects[messages.channel]))

    def _messages(self, place: ChunkPlace, chunk: Records, content: bytes) -> Messages:
        """Return the valid messages of a place; report the number of invalid messages."""
        damage = self._add_declarations(chunk.declarations) or (
            "a record breaks off" if chunk.breaks_off else ""
        )
        if damage:
            self._fault(place, f"{damage}; of the ", f", {len(chunk.heads)} could be read")
        is_usable = self._is_declared[chunk.heads["channel"]] & (chunk.heads["log_time"] <= LATEST_NS)
        if not is_usable.all():
            lost_count = len(is_usable) - np.count_nonzero(is_usable)
            self._fault(place, f"{lost_count} of the ", " have no channel, or a time beyond 2**63 - 1 ns")
        field_names = ("channel", "sequence", "log_time", "publish_time")
        channel, sequence, log_ns, publish_ns = (
            chunk.heads[name][is_usable].astype(np.int64) for name in field_names
        )
        payloads = [content[span] for span in compress(chunk.payloads, is_usable)]
        return Messages(self.channels, channel, sequence, log_ns, publish_ns, payloads)

    def _find_channels(self) -> None:
        """Declare all channels of a log without a summary.

        Chunks are read in time order, but the only declaration of a channel may be in a chunk that is later
        in time.
        """
        for _, content in iter_records(self.stream, sorted(self.places, key=lambda place: place.offset)):
            # damage is reported when the chunk is read again for its messages
            if not isinstance(content, DamageError):
                self._add_declarations(split_records(content).declarations)

    def _add_declarations(self, declarations: Iterable[tuple[int, bytes]]) -> str:
        """Store new declarations; return the damage of the first invalid declaration, or ""."""
        damage = ""
        for opcode, body in declarations:
            number = int.from_bytes(body[:2], "little")
            try:
                if opcode == Opcode.CHANNEL and number not in self.channels:
                    self._declare(decode_record(records.Channel.read, body))
                elif opcode == Opcode.SCHEMA and number not in self._schemas:
                    self._schemas[number] = decode_record(records.Schema.read, body)
            except DamageError as error:
                damage = damage or str(error)
        return damage

    def _declare(self, channel: records.Channel) -> None:
        schema = self._schemas.get(channel.schema_id)
        self._is_declared[channel.id], self._is_objects[channel.id] = True, channel.topic == OBJECTS
        log_channel = Channel(
            channel.topic,
            channel.message_encoding,
            Schema(schema.name, schema.encoding, schema.data) if schema else None,
            MappingProxyType(channel.metadata),
        )
        self.channels[channel.id] = self._renamed(log_channel)

    def _fault(self, place: ChunkPlace, before: str, after: str) -> None:
        """Report a fault of a place; its text is `before`, the times of the place's messages, and `after`."""
        time_words = "messages between ", Instant(place.start_ns, 0), " and ", Instant(place.end_ns, 0)
        place_text = f"{self.name}: at byte {place.offset}: "
        self.faults.add(Sentence(place_text, Sentence(before, *time_words, after)))


@dataclass(frozen=True)
class McapSource(FileSource):
    """An MCAP log with the topic /spatial/objects; its index is read once for all uses of the source.

    Attributes:
        keep: patterns of other topics whose messages are in the blocks, see `is_kept`. Chunks without these
            topics are skipped if the index lists the channels of chunks.
    """

    kind: str = "MCAP"
    keep: tuple[str, ...] = (ALL,)

    def keeping(self, keep: tuple[str, ...] = ()) -> McapSource:
        """See `Source.keeping`."""
        return replace(self, keep=keep)

    @property
    def _given(self) -> Mapping[str, object]:
        # the metadata of our logs already have the read options of the recording
        return {}

    @noting_pauses
    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`; derived topics, and topics that `keep` does not match, are left out.

        If the log has an index, only chunks that overlap the window are read.
        """
        renamed = set[Channel]()
        with self.open_walk(lambda channel: self._channel_of_copy(channel, renamed)) as walk:
            window_ns = (0 if start_ns is None else start_ns, AFTER_ALL_NS if end_ns is None else end_ns)
            decoder = _BlockDecoder(self, walk)
            for messages in _blocks(walk, window_ns, self.is_wanted):
                yield decoder.block(messages)
            if not isinstance(self.path, RemoteFile) or window_ns == (0, AFTER_ALL_NS):
                # for a window of a remote log, a download of all attachments would cost too much
                check_attachments(walk.stream, walk.directory, walk.faults, self.name)
            last_faults = walk.faults.take(last=True)
            first_fault = decoder.first_fault or next(iter(last_faults), None)
            if not decoder.any_sample and all(channel.topic != OBJECTS for channel in walk.channels.values()):
                raise self._without_objects(walk, first_fault)
            if not decoder.any_sample and window_ns == (0, AFTER_ALL_NS) and first_fault is not None:
                raise LogError(f"{self.name} holds no sample: {first_fault}")
            remarks = directory_remarks(self.name, walk.directory, self.metadata())
            remarks = (*remarks, *remarks_on_copies(self.name, renamed))
            doubts = tuple(doubts_from_metadata(dict(self.metadata()).get(DOUBTS, {})))
            if last_faults or remarks or doubts:
                trace = replace(Trace.from_samples(()), faults=last_faults)
                yield Block(trace, remarks=remarks, doubts=doubts)

    def iter_payloads(self, topic: str) -> Iterator[tuple[list[bytes], tuple[str, ...]]]:
        """Yield the payloads of one topic in order, in lists of bounded size, each with its faults."""
        with self.open_walk() as walk:
            for messages in _blocks(walk, (0, AFTER_ALL_NS), topic.__eq__):
                yield list(messages.payloads), walk.faults.take()
            yield [], walk.faults.take(last=True)

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`; damaged attachments are left out."""
        return self._outside_chunks[0]

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`; damaged records are left out."""
        return self._outside_chunks[1]

    @property
    def axes(self) -> Axes:
        """Axes of the recorded source; samples are always y-up."""
        return Axes.from_metadata(dict(self.metadata()).get(METADATA, {}))

    @property
    def begin_ns(self) -> int | None:
        """Start of the first chunk with samples; None if the index lists no channels."""
        with self.open_walk() as walk:
            sample_channels = {
                number for number, channel in walk.channels.items() if channel.topic == OBJECTS
            }
            return next(
                (p.start_ns for p in walk.places if p.channels and p.channels & sample_channels), None
            )

    @property
    def has_samples(self) -> bool:
        """Whether the log has the topic of our samples."""
        with self.open_walk() as walk:
            return any(map(is_samples, walk.channels.values()))

    def is_wanted(self, topic: str) -> bool:
        """Return whether the blocks hold messages of a topic."""
        topic_names = {topic, topic.removeprefix(ORIGINAL_PREFIX)}
        return topic == OBJECTS or (
            topic not in DERIVED and any(is_kept(name, self.keep, ()) for name in topic_names)
        )

    @contextmanager
    def open_walk(
        self, renamed: Callable[[Channel], Channel] = lambda channel: channel
    ) -> Iterator[ChunkWalk]:
        """Open the file for a walk over its chunks; the walk's faults begin with the faults of the index."""
        directory, faults = self._index
        with open_file(self.path) as stream:
            # a copy, because every walk reports the faults of the index again
            yield ChunkWalk(stream, directory, deepcopy(faults), self.name, renamed)

    @cached_property
    def _index(self) -> tuple[Directory, FaultList]:
        """The directory and its faults, cached because a log without a summary is scanned as a whole."""
        faults = FaultList()
        with open_file(self.path) as stream:
            return read_directory(stream, faults, self.name), faults

    @cached_property
    def _outside_chunks(self) -> tuple[tuple[Attachment, ...], tuple[tuple[str, Mapping[str, str]], ...]]:
        directory, _ = self._index
        with open_file(self.path) as stream:
            record_spans = [*directory.attachments, *directory.metadata]
            plan_reads(stream, ((offset, offset + length) for offset, length in record_spans))
            attachments = tuple(iter_attachments(stream, directory, FaultList(), self.name))
            return attachments, tuple(iter_metadata(stream, directory, FaultList(), self.name))

    def _channel_of_copy(self, channel: Channel, renamed: set[Channel]) -> Channel:
        """Return the channel in a copy; add `channel` to `renamed` if the copy has another topic."""
        channel_in_copy = copied_channel(channel)
        # other programs may write our topics, even with our types
        is_ours = has_our_type(channel) and METADATA in dict(self.metadata())
        if is_ours or channel.topic == OBJECTS or channel_in_copy == channel:
            return channel
        renamed.add(channel)
        return channel_in_copy

    def _without_objects(self, walk: ChunkWalk, fault: str | None) -> LogError | UsageError:
        topics = sorted({channel.topic for channel in walk.channels.values()})
        if not topics:
            return LogError(f"{self.name} holds no message" + (f": {fault}" if fault else ""))
        fault_text = f"no topic {OBJECTS!r} in {self.name}; it has {listing([*map(repr, topics)])}"
        if fault:
            return LogError(f"{fault_text}: {fault}")
        if METADATA in dict(self.metadata()):
            remedy = (
                "no sample was recorded in it, or it is a layer: give the log that the layer was made from"
            )
            return UsageError(f"{fault_text}; {remedy}")
        return UsageError(f"{fault_text}; a mapping file says which of them carry objects")


def is_samples(channel: Channel) -> bool:
    """Return whether the messages of a channel are our samples."""
    return channel.topic == OBJECTS and has_our_type(channel)


def directory_remarks(
    name: str, directory: Directory, metadata: Sequence[tuple[str, Mapping[str, str]]]
) -> tuple[str, ...]:
    """Return remarks on skipped records, and on the recovery of the log from a damaged log."""
    skip_remarks = (
        (f"{name}: {plural(directory.skipped, 'record')} of kinds that MCAP reserves for later skipped",)
        if directory.skipped
        else ()
    )
    return skip_remarks + tuple(
        f"{name} was recovered from {data.get('source', 'a damaged log')}:"
        f" {data.get('losses', 'how much is missing is not known')}"
        for record_name, data in metadata
        if record_name == RECOVERY
    )


def _blocks(
    walk: ChunkWalk, window_ns: tuple[int, int], is_wanted: Callable[[str], bool]
) -> Iterator[Messages]:
    """Yield the messages of wanted topics in time order, in blocks of bounded size."""
    start_ns, end_ns = window_ns
    wanted_channels = {number for number, channel in walk.channels.items() if is_wanted(channel.topic)}
    places = [
        place
        for place in walk.places
        if place.start_ns < end_ns
        and place.end_ns >= start_ns
        and (place.channels is None or not place.channels.isdisjoint(wanted_channels))
    ]
    waiting: list[Messages] = []
    waiting_limit = most_waiting(place.length for place in places)
    waiting_bytes = sample_count = 0
    for number, (place, messages) in enumerate(walk.iter_messages(places, is_wanted), 1):
        if place.start_ns < start_ns or place.end_ns >= end_ns:
            messages = messages.within(start_ns, end_ns)
        waiting.append(messages)
        waiting_bytes += messages.nbytes
        sample_count += walk.sample_count(messages)
        if number < len(places) and (waiting_bytes >= BLOCK_BYTES or sample_count >= BLOCK_SAMPLES):
            ordered_messages = _in_order(waiting)
            # chunks are sorted by start, so no later chunk has a message before the start of the next chunk
            ready_count = int(np.searchsorted(ordered_messages.log_time_ns, places[number].start_ns))
            waiting = [ordered_messages]
            if ready_count:
                yield select(ordered_messages, slice(ready_count))
                later = select(ordered_messages, slice(ready_count, None))
                waiting, waiting_bytes, sample_count = [later], later.nbytes, walk.sample_count(later)
            if waiting_bytes > waiting_limit:
                raise too_many_waiting(walk.name, waiting_limit)
    later = _in_order(waiting)
    if len(later):
        yield later


def _in_order(streams: Sequence[Messages]) -> Messages:
    """Join messages and sort them by log time, channel and sequence; the sort is stable."""
    joined_messages = concatenate_tables([Messages(), *streams])
    times_ns = joined_messages.log_time_ns
    if (times_ns[1:] > times_ns[:-1]).all():
        return joined_messages
    return select(joined_messages, np.lexsort((joined_messages.sequence, joined_messages.channel, times_ns)))


def decode_samples(
    messages: Messages,
    places: Integers,
    latest_ns: int,
    report: Callable[[Sentence], None],
    concave: Concave = "decompose",
) -> tuple[Trace, Integers]:
    """Decode our samples; return the valid samples, and their places among the messages.

    Args:
        places: places of all samples among the messages.
        latest_ns: time of the previous sample; valid samples are later.
        report: receiver of the faults of invalid samples.
    """
    times_ns = messages.log_time_ns[places]
    latest_before_ns = np.maximum.accumulate(np.append(latest_ns, times_ns))[:-1]
    for time_ns in times_ns[times_ns <= latest_before_ns].tolist():
        report(Sentence("sample at ", Instant(time_ns, 0), ": there is one at this time already"))
    places, times_ns = places[times_ns > latest_before_ns], times_ns[times_ns > latest_before_ns]
    trace, faults = decode_objects(
        [messages.payloads[place] for place in places.tolist()], times_ns, concave=concave
    )
    for fault in faults:
        report(fault)
    return trace, places[np.isin(times_ns, trace.times_ns)]


def without(messages: Messages, own: Integers, sound: Integers) -> Integers:
    """Return the places of all messages except damaged samples.

    Args:
        own: places of all samples.
        sound: places of the valid samples.
    """
    return np.setdiff1d(np.arange(len(messages)), np.setdiff1d(own, sound))


class _BlockDecoder:
    """Decodes messages to blocks, and checks that the times of samples increase."""

    def __init__(self, source: McapSource, walk: ChunkWalk) -> None:
        self._source = source
        self._walk = walk
        self._latest_ns = -1
        self.any_sample = False
        self.first_fault: str | None = None

    def block(self, messages: Messages) -> Block:
        """Decode the samples among some messages."""
        channels = {
            n: channel for n, channel in messages.channels.items() if self._source.is_wanted(channel.topic)
        }
        wanted_messages = replace(messages, channels=MappingProxyType(channels))
        sample_channels = [number for number, channel in channels.items() if self._is_objects(channel)]
        sample_places = np.flatnonzero(np.isin(wanted_messages.channel, sample_channels))
        trace, valid_places = decode_samples(
            wanted_messages, sample_places, self._latest_ns, self._fault, self._source.reading.concave
        )
        self._latest_ns = int(wanted_messages.log_time_ns[sample_places].max(initial=self._latest_ns))
        if len(valid_places) < len(sample_places):
            # a copy must be readable, so a copy gets only the valid samples
            wanted_messages = select(wanted_messages, without(wanted_messages, sample_places, valid_places))
        self.any_sample = self.any_sample or len(trace) > 0
        new_faults = self._walk.faults.take()
        self.first_fault = self.first_fault or next(iter(new_faults), None)
        return Block(replace(trace, faults=new_faults), wanted_messages)

    def _is_objects(self, channel: Channel) -> bool:
        if channel.topic != OBJECTS or is_samples(channel):
            return channel.topic == OBJECTS
        schema = channel.schema.name if channel.schema else "none"
        raise LogError(
            f"{self._source.name}: {OBJECTS!r} has messages of the schema {schema!r}, encoded as"
            f" {channel.encoding!r}; give {OBJECTS_TYPE} in protobuf"
        )

    def _fault(self, what: str) -> None:
        self._walk.faults.add(Sentence(f"{self._source.name}: ", what))


@dataclass(frozen=True, slots=True)
class ChannelSummary:
    """A channel and its number of messages."""

    channel: Channel
    messages: int


@dataclass(frozen=True, slots=True)
class AttachmentSummary:
    """An attachment without its content; `size` in bytes."""

    name: str
    media_type: str
    size: int


@dataclass(frozen=True, slots=True)
class LogSummary:
    """Content of an MCAP log.

    Attributes:
        channels: channels, sorted by topic.
        metadata: records in file order; a name may occur more than once.
        attachments: attachments in file order.
        faults: damage, with its place.
    """

    channels: tuple[ChannelSummary, ...]
    metadata: tuple[tuple[str, Mapping[str, str]], ...]
    attachments: tuple[AttachmentSummary, ...]
    faults: tuple[str, ...]

    @property
    def has_objects(self) -> bool:
        """Whether the log has a channel for samples."""
        return any(summary.channel.topic == OBJECTS for summary in self.channels)


def summarise_mcap(source: McapSource) -> LogSummary:
    """Summarise an MCAP log; a log without a summary section is read as a whole."""
    with source.open_walk() as walk:
        counts, log_parts = _counts(walk), (walk.stream, walk.directory, walk.faults, source.name)
        channels = [ChannelSummary(channel, counts[number]) for number, channel in walk.channels.items()]
        return LogSummary(
            channels=tuple(sorted(channels, key=lambda summary: summary.channel.topic)),
            metadata=tuple(iter_metadata(*log_parts)),
            attachments=tuple(
                AttachmentSummary(a.name, a.media_type, len(a.data)) for a in iter_attachments(*log_parts)
            ),
            faults=walk.faults.take(last=True),
        )


def _counts(walk: ChunkWalk) -> Counter[int]:
    if walk.directory.statistics is not None:
        return Counter(walk.directory.statistics.channel_message_counts)
    counts: Counter[int] = Counter()
    for _, messages in walk.iter_messages(walk.places):
        counts.update(messages.channel.tolist())
    return counts
