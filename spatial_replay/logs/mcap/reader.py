"""Read our own MCAP logs, whole or damaged, in blocks of samples with their messages.

Chunks may overlap in time. So they are read in the order of their first message, and a message is handed
out only when no later chunk can hold an earlier one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Integers
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.byte_ranges import plan_reads
from spatial_replay.logs.mcap.chunk_records import RawMessages
from spatial_replay.logs.mcap.chunk_walk import ChunkWalk
from spatial_replay.logs.mcap.chunks import most_waiting, too_many_waiting
from spatial_replay.logs.mcap.index import (
    Directory,
    check_attachments,
    iter_attachments,
    iter_metadata,
    read_directory,
)
from spatial_replay.logs.messages import (
    BLOCK_SAMPLES,
    Attachment,
    Block,
    Channel,
    Messages,
    select,
)
from spatial_replay.logs.objects.decode import decode_objects
from spatial_replay.logs.objects.sample_columns import ColumnReader, trace_of
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.remote import LogFile, RemoteFile, open_file
from spatial_replay.logs.topics import ALL, DERIVED, METADATA, OBJECTS, RECOVERY, is_kept
from spatial_replay.text import Instant, Sentence, counted, encodable
from spatial_replay.trace.axes import Axes
from spatial_replay.trace.declared_units import signal_units_from_metadata
from spatial_replay.trace.trace import Trace

FIRST_SAMPLES = 1_024
"""Samples of the first block; each one after it has half as many again, up to those of a block. Other threads
wait for the first, and with twice as many they would wait for those after it, too."""
BLOCK_BYTES = 64 * 2**20
"""A block of messages is closed when it holds this much, however few its samples are."""
AFTER_ALL_NS = 2**64
_SAMPLES = "spatial_replay.ObjectStates"


@dataclass(frozen=True)
class McapSource:
    """An MCAP log with the topic /spatial/objects; its index is read once for all uses of the source.

    Attributes:
        keep: which of its other messages its blocks hold, as `is_kept` takes them. What they do not hold is
            not read, where chunks say what they hold.
    """

    path: LogFile
    kind: str = "MCAP"
    concave: Concave = "decompose"
    keep: tuple[str, ...] = (ALL,)

    @property
    def name(self) -> str:
        return encodable(self.path.name)

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`; derived topics, and those that `keep` does not name, are left out.

        Only chunks that reach into the window are read, if the log has an index.
        """
        with self.open_walk() as walk:
            window = (0 if start_ns is None else start_ns, AFTER_ALL_NS if end_ns is None else end_ns)
            decoder = _BlockDecoder(self, walk)
            for messages in _blocks(walk, window, self.is_wanted, _SampleReader(walk)):
                yield decoder.block(messages)
            if not isinstance(self.path, RemoteFile) or window == (0, AFTER_ALL_NS):
                # some seconds of a log elsewhere are not worth all its attachments
                check_attachments(walk.stream, walk.directory, walk.faults, self.name)
            rest = walk.faults.take(last=True)
            fault = decoder.first_fault or next(iter(rest), None)
            if not decoder.any_sample and not walk.sees_objects:
                raise self._without_objects(walk, fault)
            if not decoder.any_sample and window == (0, AFTER_ALL_NS) and fault is not None:
                raise LogError(f"{self.name} holds no sample: {fault}")
            remarks = directory_remarks(self.name, walk.directory, self.metadata())
            if rest or remarks:
                yield Block(replace(Trace.from_samples(()), faults=rest), remarks=remarks)

    def iter_payloads(self, topic: str) -> Iterator[tuple[list[bytes], tuple[str, ...]]]:
        """Yield the payloads of one topic in order, in lists of bounded size, each with what was lost."""
        with self.open_walk() as walk:
            for messages in _blocks(walk, (0, AFTER_ALL_NS), topic.__eq__):
                yield list(messages.payloads), walk.faults.take()
            yield [], walk.faults.take(last=True)

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`; those that are damaged are left out."""
        return self._beside[0]

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`; records that are damaged are left out."""
        return self._beside[1]

    @property
    def axes(self) -> Axes:
        """Those of what the log was recorded from; its samples have ours."""
        return Axes.from_metadata(dict(self.metadata()).get(METADATA, {}))

    @property
    def signal_units(self) -> Mapping[str, str]:
        """The units that are declared, by signal."""
        return signal_units_from_metadata(dict(self.metadata()).get(METADATA, {}))

    @property
    def begin_ns(self) -> int | None:
        """When the first chunk with samples begins, if the index says so."""
        with self.open_walk() as walk:
            numbers = {number for number, channel in walk.channels.items() if channel.topic == OBJECTS}
            return next((p.start_ns for p in walk.places if p.channels and p.channels & numbers), None)

    @property
    def has_samples(self) -> bool:
        """Whether the log has the topic of our samples."""
        with self.open_walk() as walk:
            return any(
                channel.topic == OBJECTS and channel.schema is not None and channel.schema.name == _SAMPLES
                for channel in walk.channels.values()
            )

    def is_wanted(self, topic: str) -> bool:
        """Return whether the blocks hold messages of a topic."""
        return topic == OBJECTS or (topic not in DERIVED and is_kept(topic, self.keep, ()))

    @contextmanager
    def open_walk(self) -> Iterator[ChunkWalk]:
        """Open the file for a walk over its chunks, whose faults begin with those of the index."""
        directory, faults = self._index
        with open_file(self.path) as stream:
            yield ChunkWalk(stream, directory, deepcopy(faults), self.name)

    @cached_property
    def _index(self) -> tuple[Directory, FaultList]:
        """The directory and its faults, read once: without a summary, it takes a scan of the whole file."""
        faults = FaultList()
        with open_file(self.path) as stream:
            return read_directory(stream, faults, self.name), faults

    @cached_property
    def _beside(self) -> tuple[tuple[Attachment, ...], tuple[tuple[str, Mapping[str, str]], ...]]:
        directory, _ = self._index
        with open_file(self.path) as stream:
            beside = [*directory.attachments, *directory.metadata]
            plan_reads(stream, ((offset, offset + length) for offset, length in beside))
            attachments = tuple(iter_attachments(stream, directory, FaultList(), self.name))
            return attachments, tuple(iter_metadata(stream, directory, FaultList(), self.name))

    def _without_objects(self, walk: ChunkWalk, fault: str | None) -> LogError | UsageError:
        topics = sorted({channel.topic for channel in walk.channels.values()})
        if not topics:
            return LogError(f"{self.name} holds no message" + (f": {fault}" if fault else ""))
        listed = ", ".join(map(repr, topics[:8])) + (", …" if len(topics) > 8 else "")
        what = f"no topic {OBJECTS!r} in {self.name}; it has {listed}"
        if fault:
            return LogError(f"{what}: {fault}")
        if METADATA in dict(self.metadata()):
            remedy = (
                "no sample was recorded in it, or it is a layer: give the log that the layer was made from"
            )
            return UsageError(f"{what}; {remedy}")
        return UsageError(f"{what}; a mapping file says which of them carry objects")


def is_samples(channel: Channel) -> bool:
    """Return whether the messages of a channel are samples of ours."""
    schema = channel.schema.name if channel.schema else ""
    return (channel.topic, channel.encoding, schema) == (OBJECTS, "protobuf", _SAMPLES)


def directory_remarks(
    name: str, directory: Directory, metadata: Sequence[tuple[str, Mapping[str, str]]]
) -> tuple[str, ...]:
    """Return what to say about a log with skipped records, or one recovered from a damaged one."""
    skipped = (
        (f"{name}: {counted(directory.skipped, 'record')} of kinds that MCAP reserves for later skipped",)
        if directory.skipped
        else ()
    )
    return skipped + tuple(
        f"{name} was recovered from {data.get('source', 'a damaged log')}:"
        f" {data.get('losses', 'how much is missing is not known')}"
        for record, data in metadata
        if record == RECOVERY
    )


def _blocks(
    walk: ChunkWalk,
    window: tuple[int, int],
    is_wanted: Callable[[str], bool],
    prepare: Callable[[RawMessages], RawMessages] = lambda messages: messages,
) -> Iterator[RawMessages]:
    """Yield the messages of the topics wanted, in order, in blocks of bounded size.

    Args:
        prepare: what the threads that read do with messages.
    """
    start_ns, end_ns = window
    declared = 0
    wanted = objects = walk.numbers(is_wanted)
    numbers = set(np.flatnonzero(wanted).tolist())
    places = [
        place
        for place in walk.places
        if place.start_ns < end_ns
        and place.end_ns >= start_ns
        and (place.channels is None or not place.channels.isdisjoint(numbers))
    ]
    waiting: list[RawMessages] = []
    most = most_waiting(place.length for place in places)
    size = samples = number = 0
    enough = FIRST_SAMPLES
    for several, messages in walk.iter_messages(places, is_wanted, prepare):
        number += len(several)
        if declared < len(walk.channels):
            declared = len(walk.channels)
            wanted, objects = walk.numbers(is_wanted), walk.numbers(OBJECTS.__eq__)
        is_inside = all(place.start_ns >= start_ns and place.end_ns < end_ns for place in several)
        if not is_inside or messages.channel < 0 or not wanted[messages.channel]:
            heads = messages.heads
            is_chosen = wanted[heads["channel"]]
            if not is_inside:
                is_chosen &= (heads["log_time"] >= start_ns) & (heads["log_time"] < end_ns)
            if not is_chosen.all():
                messages = messages.take(np.flatnonzero(is_chosen))
        waiting.append(messages)
        size += messages.buffer_bytes if messages.channel >= 0 else messages.payloads.nbytes
        samples += _count(messages, objects)
        if number < len(places) and (size >= BLOCK_BYTES or samples >= enough):
            ordered = _in_order(waiting)
            ready = int(np.searchsorted(ordered.heads["log_time"], places[number].start_ns))
            waiting = [ordered]
            if ready:
                block, rest = ordered.divided(ready, objects)
                yield block
                enough = min(3 * enough // 2, BLOCK_SAMPLES)
                waiting, size, samples = [rest], rest.buffer_bytes, _count(rest, objects)
            if size > most:
                raise too_many_waiting(walk.name, most)
    rest = _in_order(waiting)
    if len(rest):
        yield rest


def _count(messages: RawMessages, chosen: Booleans) -> int:
    """Count the messages of chosen channels."""
    if messages.channel >= 0:
        return len(messages) if chosen[messages.channel] else 0
    return int(np.count_nonzero(chosen[messages.heads["channel"]]))


def _in_order(several: Sequence[RawMessages]) -> RawMessages:
    """Join messages by log time, channel and sequence; those that share all three keep their order."""
    joined = RawMessages.join(several)
    times = joined.heads["log_time"]
    if (times[1:] > times[:-1]).all():
        return joined
    ordered = joined.take(np.lexsort((joined.heads["sequence"], joined.heads["channel"], times)))
    # samples are mostly in order among themselves, which is compared once more where they are used
    return replace(ordered, samples=joined.samples)


class _SampleReader:
    """Reads the samples among messages as columns, on the threads that read these."""

    def __init__(self, walk: ChunkWalk) -> None:
        own = [number for number, channel in walk.channels.items() if channel.topic == OBJECTS]
        self._number = own[0] if len(own) == 1 and is_samples(walk.channels[own[0]]) else None
        self._columns = ColumnReader()

    def __call__(self, messages: RawMessages) -> RawMessages:
        """Return the same messages, with their samples as columns if they are all sound."""
        if self._number is None:
            return messages
        payloads, heads = messages.payloads, messages.heads
        if messages.channel != self._number:
            own = np.flatnonzero(heads["channel"] == self._number)
            payloads, heads = payloads.take(own), heads[own]
        samples = self._columns.read(payloads, heads["log_time"].astype(np.int64))
        return messages if samples is None else replace(messages, samples=samples)


class _BlockDecoder:
    """Decodes messages to blocks; remembers the latest sample, after which the next one has to come."""

    def __init__(self, source: McapSource, walk: ChunkWalk) -> None:
        self._source = source
        self._walk = walk
        self._latest_ns = -1
        self.any_sample = False
        self.first_fault: str | None = None

    def block(self, messages: RawMessages) -> Block:
        """Decode the samples among some messages."""
        columns = self._columns(messages)
        samples = [number for number, channel in columns.channels.items() if self._is_objects(channel)]
        is_own = np.isin(columns.channel, samples)
        own = np.flatnonzero(is_own)
        times = columns.log_time_ns[own]
        before = np.maximum.accumulate(np.concatenate([[self._latest_ns], times]))
        for time_ns in times[times <= before[:-1]].tolist():
            self._fault(Sentence("sample at ", Instant(time_ns, 0), ": there is one at this time already"))
        own, self._latest_ns = own[times > before[:-1]], int(before[-1])
        trace, faults = self._trace(messages, own, columns.log_time_ns[own])
        for fault in faults:
            self._fault(fault)
        if len(trace) < int(is_own.sum()):
            # a copy holds the samples that were read, and is sound
            read = own[np.isin(columns.log_time_ns[own], trace.times_ns)]
            columns = select(columns, np.union1d(np.flatnonzero(~is_own), read))
        self.any_sample = self.any_sample or len(trace) > 0
        lost = self._walk.faults.take()
        self.first_fault = self.first_fault or next(iter(lost), None)
        return Block(replace(trace, faults=lost), columns)

    def _trace(
        self, messages: RawMessages, own: Integers, times_ns: Integers
    ) -> tuple[Trace, list[Sentence]]:
        """Return the samples that some messages are, and what is wrong with them."""
        samples = messages.samples
        if samples and np.array_equal(np.concatenate([each.times_ns for each in samples]), times_ns):
            return trace_of(samples), []
        payloads = messages.payloads.take(own)
        return decode_objects(payloads, times_ns, concave=self._source.concave)

    def _is_objects(self, channel: Channel) -> bool:
        if channel.topic != OBJECTS or is_samples(channel):
            return channel.topic == OBJECTS
        schema = channel.schema.name if channel.schema else "none"
        raise LogError(
            f"{self._source.name}: {OBJECTS!r} has messages of the schema {schema!r}, encoded as"
            f" {channel.encoding!r}; give {_SAMPLES} in protobuf"
        )

    def _columns(self, messages: RawMessages) -> Messages:
        declared = self._walk.channels.items()
        is_wanted = self._source.is_wanted
        heads = messages.heads
        return Messages(
            channels=MappingProxyType({n: each for n, each in declared if is_wanted(each.topic)}),
            channel=heads["channel"].astype(np.int64),
            sequence=heads["sequence"].astype(np.int64),
            log_time_ns=heads["log_time"].astype(np.int64),
            publish_time_ns=heads["publish_time"].astype(np.int64),
            payloads=messages.payloads,
        )

    def _fault(self, what: str) -> None:
        self._walk.faults.add(Sentence(f"{self._source.name}: ", what))
