"""Logs as values: messages as columns, blocks of samples with their messages, sources, sinks, and names.

Messages of several channels are merged in an order that depends on what the channels are, not on their
numbers, so that equal logs give equal files.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from fnmatch import fnmatchcase
from functools import wraps
from itertools import repeat
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import Integers, concatenated, equal_places, select
from spatial_replay.logs.read_options import DEFAULTS, FaultList, ReadOptions, gap_ns
from spatial_replay.logs.remote import LogFile, each_ahead
from spatial_replay.text import Sentence, encodable
from spatial_replay.trace.doubts import Doubt
from spatial_replay.trace.facts import TopicFacts
from spatial_replay.trace.trace import LATEST_NS, Pauses, ReportsBack, Sample, Trace, within
from spatial_replay.trace.track_evidence import TrackEvidence
from spatial_replay.trace.units import OUR_AXES, Axes

if TYPE_CHECKING:
    from google.protobuf.descriptor import FileDescriptor
    from google.protobuf.message import Message

BLOCK_SAMPLES = 12_288
"""A block holds at most this many samples, so that memory stays bounded whatever the log's length."""


@dataclass(frozen=True, slots=True)
class Schema:
    """How a channel's messages are described: an MCAP schema without its number."""

    name: str
    encoding: str
    data: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class Channel:
    """A topic with the form of its messages: an MCAP channel without its number.

    Attributes:
        topic: where messages go, such as /spatial/objects.
        encoding: of the messages: protobuf, json, cdr, ros1.
        schema: None where the log has none.
        metadata: as in the log.
    """

    topic: str
    encoding: str
    schema: Schema | None
    metadata: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}), hash=False)


def _none() -> Integers:
    return np.zeros(0, np.int64)


class Row(NamedTuple):
    """One message of `Messages`."""

    channel: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """M messages in the order (time, channel, sequence), byte for byte as in the log.

    Attributes:
        channels: by the number that `channel` uses.
        channel: (M,) int64.
        sequence: (M,) int64.
        log_time_ns, publish_time_ns: (M,) int64.
        payloads: M encoded messages.
    """

    channels: Mapping[int, Channel] = field(default_factory=lambda: MappingProxyType({}))
    channel: Integers = field(default_factory=_none)
    sequence: Integers = field(default_factory=_none)
    log_time_ns: Integers = field(default_factory=_none)
    publish_time_ns: Integers = field(default_factory=_none)
    payloads: Sequence[bytes] = ()

    @classmethod
    def from_rows(cls, channels: Mapping[int, Channel], rows: Sequence[Row]) -> Messages:
        """Return the messages one by one as columns."""
        *numbers, payloads = zip(*rows, strict=True) if rows else [()] * len(Row._fields)
        channel, sequence, log_ns, publish_ns = (np.array(column, np.int64) for column in numbers)
        return Messages(channels, channel, sequence, log_ns, publish_ns, payloads)

    def rows(self) -> Iterator[Row]:
        """Iterate over the messages one by one."""
        columns = (self.channel, self.sequence, self.log_time_ns, self.publish_time_ns)
        return map(Row._make, zip(*(column.tolist() for column in columns), self.payloads, strict=True))

    def __len__(self) -> int:
        return len(self.payloads)

    @property
    def nbytes(self) -> int:
        """The size of the payloads in bytes."""
        return sum(map(len, self.payloads))

    @property
    def topics(self) -> list[str]:
        """The topic of each message."""
        names = {number: channel.topic for number, channel in self.channels.items()}
        return [names[number] for number in self.channel.tolist()]

    @property
    def topic_ranks(self) -> Integers:
        """(M,) int64, of the topic of each message among all topics in order."""
        names = {channel.topic for channel in self.channels.values()}
        rank = {name: place for place, name in enumerate(sorted(names))}
        of_channel = np.zeros(max(self.channels, default=-1) + 1, np.int64)
        for number, channel in self.channels.items():
            of_channel[number] = rank[channel.topic]
        return of_channel[self.channel]

    def by_channel(self) -> Iterator[tuple[Channel, Integers]]:
        """Iterate over the channels that have messages, each with the places of these."""
        for places in equal_places(self.channel):
            yield self.channels[int(self.channel[places[0]])], places

    def by_topic(self) -> Iterator[tuple[str, Integers]]:
        """Iterate over the topics that have messages, in order, each with the places of these."""
        for places in equal_places(self.topic_ranks):
            yield self.channels[int(self.channel[places[0]])].topic, places

    def of_topics(self, topics: Collection[str]) -> Self:
        """Return the messages of some topics, in the same order."""
        numbers = [number for number, channel in self.channels.items() if channel.topic in topics]
        places = np.flatnonzero(np.isin(self.channel, numbers))
        return self if len(places) == len(self) else select(self, places)

    def within(self, start_ns: int, end_ns: int) -> Self:
        """Return the messages logged from one time to before another, in the same order."""
        times_ns = self.log_time_ns
        inside = (times_ns >= start_ns) & (times_ns <= min(end_ns - 1, LATEST_NS))
        return self if inside.all() else select(self, np.flatnonzero(inside))


def messages_of(channel: Channel, times_ns: Integers, payloads: Sequence[bytes], first: int) -> Messages:
    """Return messages of one channel, published when they are logged, numbered from `first`."""
    return Messages(
        channels={0: channel},
        channel=np.zeros(len(payloads), np.int64),
        sequence=np.arange(first, first + len(payloads), dtype=np.int64),
        log_time_ns=times_ns,
        publish_time_ns=times_ns,
        payloads=payloads,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Some samples of a log with their messages.

    Attributes:
        trace: the samples; `trace.faults` lists what was lost since the previous block.
        messages: those that a copy of the log must contain beside what is derived from the samples; empty for
            sources that are not a log of messages. A copy gets a topic for the samples where they have none.
        remarks: what is worth knowing although nothing was lost: how many observations are out of date, which
            transforms are missing.
        doubts: assumptions that the log contradicts.
        facts: how each mapped topic was read, once all of it is.
    """

    trace: Trace
    messages: Messages = field(default_factory=Messages)
    remarks: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()
    facts: tuple[TopicFacts, ...] = ()


def merge(streams: Sequence[Messages]) -> Messages:
    """Merge messages in the order of time, topic and sequence.

    Channel numbers mean nothing outside their log, so channels are ordered by their content. Equal messages
    come out in the same order from any log.
    """
    joined = join(streams)
    return select(joined, np.lexsort((joined.sequence, joined.channel, joined.log_time_ns)))


def join(streams: Sequence[Messages]) -> Messages:
    """Join messages, one stream after the other."""
    distinct = {id(channel): channel for stream in streams for channel in stream.channels.values()}
    by_rank = {_rank(channel): channel for channel in distinct.values()}
    number = {rank: place for place, rank in enumerate(sorted(by_rank))}
    numbers = {identity: number[_rank(channel)] for identity, channel in distinct.items()}
    renumbered = [replace(stream, channel=_renumber(stream, numbers)) for stream in streams]
    channels = {place: by_rank[rank] for rank, place in number.items()}
    return replace(concatenated([Messages(), *renumbered]), channels=channels)


def _rank(channel: Channel) -> tuple[str, str, str, str, bytes, tuple[tuple[str, str], ...]]:
    schema = channel.schema
    name, encoding, data = ("", "", b"") if schema is None else (schema.name, schema.encoding, schema.data)
    return channel.topic, channel.encoding, name, encoding, data, tuple(sorted(channel.metadata.items()))


def _renumber(stream: Messages, number: dict[int, int]) -> Integers:
    if not len(stream):
        return np.zeros(0, np.int64)
    new = np.zeros(max(stream.channels) + 1, np.int64)
    for old, channel in stream.channels.items():
        new[old] = number[id(channel)]
    return new[stream.channel]


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file in a log; its times are 0 where they are not known."""

    name: str
    media_type: str
    data: bytes = field(repr=False)
    log_time_ns: int = 0
    create_time_ns: int = 0


class Sink(Protocol):
    """A log being written."""

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record."""

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file to the log."""

    def write_messages(self, messages: Messages) -> None:
        """Add messages, in the order given."""


class MemorySink:
    """A log in memory, for tests and for callers that need messages rather than a file."""

    def __init__(self) -> None:
        self.metadata: list[tuple[str, Mapping[str, str]]] = []
        self.attachments: list[Attachment] = []
        self.messages: list[Messages] = []

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """See `Sink`."""
        self.metadata.append((name, dict(data)))

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """See `Sink`."""
        self.attachments.append(Attachment(name, media_type, data))

    def write_messages(self, messages: Messages) -> None:
        """See `Sink`."""
        self.messages.append(messages)


SAMPLES_A_GAP: Final = 10
"""Samples that fill a gap of the length that is allowed."""
_MOST_IN_GAP = 10_000
"""Samples that fill one gap."""

IterBlocks = Callable[..., Iterator[Block]]


def noting_pauses(iter_blocks: IterBlocks) -> IterBlocks:
    """Let `iter_blocks` of a source remark pauses and steps back, and fill pauses beyond its `max_gap_ns`."""

    @wraps(iter_blocks)
    def wrapper(self: Any, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        pauses, reports = Pauses(), ReportsBack()
        before: Trace | None = None
        for block in iter_blocks(self, start_ns, end_ns):
            trace = block.trace
            pauses.add(trace.times_ns, trace.is_unknown)
            reports.add(trace)
            if self.max_gap_ns is not None and len(trace):
                block = replace(block, trace=_without_gaps(before or Trace.empty(), trace, self.max_gap_ns))
                before = trace.slice(len(trace) - 1, len(trace))
            yield block
        pause = pauses.remark("samples", self.max_gap_ns)
        remarks = [*([] if pause is None else [pause]), *reports.remarks()]
        if remarks:
            said = tuple(Sentence(f"{self.name}: ", remark) for remark in remarks)
            yield Block(Trace.empty(), remarks=said)

    return wrapper


def _without_gaps(before: Trace, trace: Trace, max_gap_ns: int) -> Trace:
    """Fill gaps between samples with samples in which every object and signal is unknown.

    Args:
        before: the sample before those of `trace`, or none.
    """
    times = np.concatenate([before.times_ns, trace.times_ns])
    gaps = np.flatnonzero(np.diff(times) > max_gap_ns).tolist()
    parts, filled_to = [], 0
    for gap in gaps:
        begin = gap + 1 - len(before)
        last = trace.slice(begin - 1, begin) if begin else before
        first_ns, next_ns = times[gap : gap + 2].tolist()
        step_ns = max(max_gap_ns // SAMPLES_A_GAP, (next_ns - first_ns) // _MOST_IN_GAP, 1)
        # right after the last sample, and right before the next one
        steps = np.union1d(np.arange(first_ns + step_ns, next_ns, step_ns), [first_ns + 1, next_ns - 1])
        rows = np.repeat(np.where(last.rows >= 0, -2 - last.rows, last.rows), len(steps), axis=0)
        signals = {name: np.full(len(steps), np.nan) for name in last.signals}
        unknown = replace(
            last,
            times_ns=steps,
            rows=rows,
            signals=signals,
            reported_ns=None,
            signals_reported_ns={},
            faults=(),
            remarks=(),
        )
        parts += [trace.slice(filled_to, begin), unknown]
        filled_to = begin
    return Trace.concatenate([*parts, trace.slice(filled_to, len(trace))]) if gaps else trace


OWN_PREFIX = "/spatial/"
"""Topics of ours; a log has them in chunks of their own."""

OBJECTS = "/spatial/objects"
OBJECTS_TYPE = "spatial_replay.ObjectStates"
SCENE = "/spatial/scene"
SPECIFICATION = "/spatial/specification"
FRAME = "/spatial/frame"
STANDING = "/spatial/standing"
ROBUSTNESS = "/spatial/robustness"
AUTOMATON = "/spatial/automaton"
EVENTS = "/spatial/events"
EVENT_LOG = "/spatial/log"
RECENT_EVENTS = "/spatial/recent_events"

_DERIVED_TYPES: Final = MappingProxyType(
    {
        SCENE: "foxglove.SceneUpdate",
        FRAME: "foxglove.FrameTransform",
        SPECIFICATION: "spatial_replay.Specification",
        STANDING: "spatial_replay.StandingUpdate",
        ROBUSTNESS: "spatial_replay.Robustness",
        AUTOMATON: "spatial_replay.AutomatonState",
        EVENTS: "foxglove.Event",
        EVENT_LOG: "foxglove.Log",
        RECENT_EVENTS: "spatial_replay.RecentEvents",
    }
)
DERIVED = frozenset(_DERIVED_TYPES)
"""Topics computed from the samples and a specification: a replay replaces them."""


def has_our_type(channel: Channel) -> bool:
    """Return whether a channel has the messages that we write on its topic, one of `OBJECTS` or `DERIVED`."""
    type_name = OBJECTS_TYPE if channel.topic == OBJECTS else _DERIVED_TYPES.get(channel.topic)
    schema = channel.schema.name if channel.schema else ""
    return (channel.encoding, schema) == ("protobuf", type_name)


ORIGINAL_PREFIX = "/original"
"""Begins the topic on which a copy has the messages that others wrote on one of our topics."""


def copied_channel(channel: Channel) -> Channel:
    """Return the channel on which a copy has messages that others wrote: not on a topic of ours."""
    is_ours = channel.topic == OBJECTS or channel.topic in DERIVED
    return replace(channel, topic=ORIGINAL_PREFIX + channel.topic) if is_ours else channel


def remarks_on_copies(name: str, channels: Iterable[Channel]) -> list[str]:
    """Return remarks on channels of a log that a copy has on another topic."""
    topics = {channel.topic for channel in channels if copied_channel(channel) != channel}
    return [
        f"{name}: a copy has its messages on {topic} on {ORIGINAL_PREFIX}{topic},"
        " because a replay writes that topic"
        for topic in sorted(topics)
    ]


CURVES_TOPIC = "/spatial/curves"
"""Curves of the whole log, published by a live server; no file has this topic."""

PLAN_DECISION = "/plan/decision"
GRADIENT_MAP = "/plan/gradient_map"
PLAN_PATH = "/plan/path"
REDONE_DECISION = "/plan/redone/decision"
REDONE_MAP = "/plan/redone/gradient_map"
REDONE_PATH = "/plan/redone/path"
BEHAVIOUR_TREE = "/plan/behaviour_tree"
"""Topics that a planner writes, what it would have decided otherwise, and the robot; a replay copies them."""

CAMERA_VIDEO = "/camera/video"
CAMERA_ANNOTATIONS = "/camera/annotations"
CAMERA_CALIBRATION = "/camera/calibration"
CAMERA_FRAMES = "/tf"
"""Topics of a run that a camera saw; a replay copies them."""


def topic_of_camera(topic: str, number: int) -> str:
    """Return the topic of one of several cameras, from 1: `/camera/video`, `/camera2/video`."""
    return topic if number == 1 else topic.replace("/camera/", f"/camera{number}/", 1)


MAGIC = b"\x89MCAP0\r\n"
"""The first bytes of an MCAP file, and the last."""

LIBRARY = "spatial-replay"
"""How our writer names itself in the header of a log."""

METADATA = "spatial_replay"
"""The metadata record that comes first: who wrote the log, from what, with which options."""

ZERO = "zero_ns"
"""Its entry of the time that texts about the log count from; without it, they count from the first sample."""

ENDING = "spatial_replay_ending"
"""The metadata record at the end of a recording: how many samples it holds, and how it ended."""

TRIGGER = "spatial_replay_trigger"
"""The metadata record of a clip: what fired, when, and how much around it was asked for and held."""

CERTIFICATE = "spatial_replay_certificate"
"""The metadata record that comes last: hashes of inputs and results."""

PLAN_METADATA = "spatial_replay_plan"
"""The metadata record with the settings and the specification that a planner's decisions depend on."""

RECOVERY = "spatial_replay_recovery"
"""The metadata record of a log that was recovered from a damaged one: what is missing in it."""

VERDICTS = "spatial_replay_verdicts"
"""The metadata record with the verdict and robustness of each result of a replay."""

DOUBTS = "spatial_replay_doubts"
"""The metadata record with the assumptions that a log's source contradicts; see `Doubt`."""

AUTOMATA = "spatial_replay_automata"
"""The metadata record with the sizes of automata, and why a specification has none."""

AUTOMATA_PREFIX = "automata/"
"""Attachments with automata; the prefix of their specification comes next."""

LAYOUT = "layout.json"
"""The attachment that arranges a viewer's panels; a replay replaces it."""

RECORDED_PREFIX = "recorded/"
"""Inputs of a recording as attachments; they stay in every copy."""

CAMERA_PREFIX = "camera/"
"""The tags file of a camera's run as an attachment; it stays in every copy."""

REPLAYED_PREFIX = "replayed/"
"""Inputs of a replay as attachments; the next replay replaces them."""


_IMAGES = frozenset({"CompressedImage", "CompressedVideo", "Image", "RawImage"})


def is_image_type(name: str) -> bool:
    """Return whether messages of a type are images or frames of a video: of ROS or of Foxglove."""
    package, _, short = name.replace(".", "/").rpartition("/")
    return short in _IMAGES and package.split("/")[0] in ("sensor_msgs", "foxglove", "foxglove_msgs")


def image_topics(channels: Iterable[Channel]) -> set[str]:
    """Return the topics whose messages are images."""
    return {
        channel.topic
        for channel in channels
        if channel.schema is not None and is_image_type(channel.schema.name)
    }


ALL, MAPPED = "all", "mapped"
"""Values of `is_kept` besides patterns: every topic, or the topics of the samples."""


def is_kept(topic: str, keep: Collection[str], mapped: Collection[str]) -> bool:
    """Return whether a copy of a log keeps the messages of a topic.

    Args:
        keep: "all", "mapped", or patterns of topics such as "/camera/*"; one that says so is enough.
        mapped: the topics that the samples are made of.
    """
    return any(
        pattern == ALL or (pattern == MAPPED and topic in mapped) or fnmatchcase(topic, pattern)
        for pattern in keep
    )


def protobuf_channel(topic: str, message: type[Message]) -> Channel:
    """Return the channel of a topic with messages of one protobuf type, with all it takes to decode them."""
    # imported here since readers need none of it
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    descriptors = FileDescriptorSet()
    for file in _with_dependencies(message.DESCRIPTOR.file, {}):
        file.CopyToProto(descriptors.file.add())
    data = descriptors.SerializeToString(deterministic=True)
    return Channel(topic, "protobuf", Schema(message.DESCRIPTOR.full_name, "protobuf", data))


def _with_dependencies(file: Any, found: dict[str, FileDescriptor]) -> Iterable[FileDescriptor]:
    """Return a file of message types and all that it imports, each behind its own imports."""
    for dependency in file.dependencies:
        if dependency.name not in found:
            _with_dependencies(dependency, found)
    found[file.name] = file
    return found.values()


_Read = TypeVar("_Read")


class Source:
    """A log that can be read, any number of times, in blocks of bounded size."""

    path: LogFile | None = None

    @property
    def name(self) -> str:
        """The base name of its file."""
        raise NotImplementedError

    @property
    def kind(self) -> str:
        """The format, in a word."""
        raise NotImplementedError

    @property
    def axes(self) -> Axes:
        """Axes of the source, or of what a log was recorded from; its samples have ours."""
        return OUR_AXES

    @property
    def options(self) -> Mapping[str, object]:
        """The options of reading that are not the defaults, for a log's metadata."""
        return {}

    @property
    def max_gap_ns(self) -> int | None:
        """Objects and signals are unknown in a longer pause; None for no limit."""
        return None

    @property
    def begin_ns(self) -> int | None:
        """A time before the first sample, close to it, if that is known without reading the samples."""
        return None

    def keeping(self, keep: tuple[str, ...] = ()) -> Source:
        """Return a source that reads its samples and, beside them, only messages of some topics.

        Args:
            keep: as `is_kept` takes them.
        """
        return self

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """Return the samples from the first at or after `start_ns` to the last before `end_ns`.

        Unreadable parts are in `trace.faults` of the blocks; the last block may hold nothing else.

        Raises:
            LogError: nothing in the log can be read as a sample.
            UsageError: a log without damage that has no topic for samples.
        """
        raise NotImplementedError

    def attachments(self) -> tuple[Attachment, ...]:
        """Return the attachments of the log."""
        return ()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """Return the metadata records of the log, with their names."""
        return ()


@dataclass(frozen=True)
class MemorySource(Source):
    """A trace, or samples, in memory."""

    trace: Trace
    name: str = "memory"
    kind: str = "memory"

    @property
    def axes(self) -> Axes:
        """Ours, with the units that the trace declares."""
        return Axes.of_units(self.trace.units)

    @classmethod
    def from_samples(cls, samples: Iterable[Sample], name: str = "memory") -> MemorySource:
        return cls(Trace.from_samples(samples), name)

    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        window = within(self.trace, start_ns, end_ns)
        if len(window) <= BLOCK_SAMPLES:
            yield Block(window, doubts=window.doubts)
            return
        for begin in range(0, len(window), BLOCK_SAMPLES):
            block = window.slice(begin, begin + BLOCK_SAMPLES)
            yield Block(block if begin == 0 else replace(block, faults=()), doubts=block.doubts)


@dataclass(frozen=True)
class FileSource(Source):
    """The file of a log, with the options for reading it."""

    path: LogFile
    kind: str = ""
    reading: ReadOptions = DEFAULTS

    @property
    def name(self) -> str:
        return encodable(self.path.name or Path(self.path).absolute().name)

    @property
    def options(self) -> Mapping[str, object]:
        """See `Source.options`."""
        concave = self.reading.concave
        return {**self._given, **({} if concave == "decompose" else {"concave": concave})}

    @property
    def _given(self) -> Mapping[str, object]:
        return self.reading.non_defaults()

    @property
    def max_gap_ns(self) -> int | None:
        """See `Source.max_gap_ns`."""
        return gap_ns(self.reading.max_gap)


IterTraces = Callable[..., Iterator[Trace]]


@dataclass(frozen=True)
class TrackSource(FileSource):
    """A track file.

    Attributes:
        axes: those of the file; samples have ours.
    """

    _: KW_ONLY
    iter_traces: IterTraces
    axes: Axes = OUR_AXES

    @noting_pauses
    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`."""
        faults = FaultList()
        any_sample = False
        first_fault: str | None = None
        evidence = TrackEvidence()
        for trace in self.iter_traces(self.path, faults, concave=self.reading.concave):
            any_sample = any_sample or len(trace) > 0
            lost = faults.take()
            first_fault = first_fault or next(iter(lost), None)
            window = self.axes.convert_trace(within(trace, start_ns, end_ns))
            evidence.add(trace)
            yield Block(replace(window, faults=lost))
        if doubts := tuple(evidence.doubts()):
            yield Block(Trace.empty(), doubts=doubts)
        rest = faults.take(last=True)
        if not any_sample:
            reason = first_fault or next(iter(rest), f"{self.name} is empty")
            raise LogError(f"{self.name} holds no sample: {reason}")
        if rest:
            yield Block(replace(Trace.from_samples(()), faults=rest))


@dataclass(frozen=True)
class SourceOf(Source):
    """Attributes that a derived source takes from its original: everything but its blocks."""

    source: Source

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def kind(self) -> str:
        return self.source.kind

    @property
    def axes(self) -> Axes:
        return self.source.axes

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`."""
        return self.source.attachments()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        return self.source.metadata()


def read_blocks(
    source: Source, start_ns: int | None = None, end_ns: int | None = None
) -> Generator[Block, None, None]:
    """Yield the blocks of a source, as `Source.iter_blocks` does.

    Raises:
        LogError: what that raises, and if the disk fails or is gone.
    """
    try:
        yield from source.iter_blocks(start_ns, end_ns)
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{source.name} could not be read: {reason}; copy it to another disk") from error


def read_ahead(blocks: Generator[_Read, None, None]) -> Iterator[_Read]:
    """Yield the same blocks, from the third on each read while the previous one is processed.

    A short log has one or two, and starting a thread takes longer than reading them.
    """
    for _ in range(2):
        first = next(blocks, None)
        if first is None:
            return
        yield first
    for block in each_ahead(lambda _: next(blocks, None), repeat(None)):
        if block is None:
            return
        yield block
