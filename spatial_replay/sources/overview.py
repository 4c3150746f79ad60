"""Overview of a log: its objects and signals, or an external log's topics that a mapping could read."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from spatial_replay.bags.decoders import Topic
from spatial_replay.bags.definitions import Decoder
from spatial_replay.bags.open import McapLog, open_messages
from spatial_replay.bags.reader import Message, MessageReader
from spatial_replay.errors import LogError, MissingFileError, UsageError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.formats.datasets import data_set_address
from spatial_replay.logs.mcap.read import LogSummary, McapSource, summarise_mcap
from spatial_replay.logs.read_options import FaultList, gap_ns
from spatial_replay.logs.remote import RemoteFile, log_file
from spatial_replay.logs.source import Source, TrackSource, read_blocks
from spatial_replay.logs.topics import OBJECTS
from spatial_replay.mapping.suggest import EXAMPLES, suggest_mapping, suggest_topics
from spatial_replay.sources.open_log import is_bag_folder, readable_file
from spatial_replay.text import Instant, Sentence
from spatial_replay.trace.doubts import Doubt, distinct_doubts
from spatial_replay.trace.facts import TopicFacts
from spatial_replay.trace.trace import Pauses, Trace
from spatial_replay.trace.units import OUR_AXES, Axes

_STEP = 10_000
"""Messages between two progress reports."""
_ENOUGH = 1024
"""Number of messages per topic that is enough for a survey."""
_LOOKED_AT = frozenset({*range(1, EXAMPLES + 1), *(2**n for n in range(5, 20))})
"""Messages of a topic that are decoded, by their number from 1: the first messages, then powers of two."""
_EXAMPLE_BYTES = 2**22
"""Size limit of a topic's decoded messages after the first, bytes, because images and point clouds are
large."""


@dataclass(frozen=True, slots=True)
class TopicSurvey:
    """A topic of an external log.

    Attributes:
        messages: number of messages read.
        entry: suggested entry of a mapping; empty if no field looks like an object.
    """

    topic: Topic
    messages: int
    entry: str


@dataclass(frozen=True, slots=True)
class Survey:
    """Overview of an external log.

    Attributes:
        start_ns, end_ns: log times of the first and the last message; None without messages.
        mapping: text of a suggested mapping file.
        faults: sentences on damage, each with its place.
        remarks: notes that do not concern losses.
    """

    name: str
    kind: str
    start_ns: int | None
    end_ns: int | None
    topics: tuple[TopicSurvey, ...]
    mapping: str
    faults: tuple[str, ...]
    remarks: tuple[str, ...]

    @property
    def messages(self) -> int:
        return sum(topic.messages for topic in self.topics)


def messages_in(path: str | PathLike[str]) -> MessageReader | None:
    """Return a reader of a log of messages that needs a mapping; None for other logs.

    Other logs name their objects, or are episodes of data sets.

    Raises:
        MissingFileError: there is no such file.
    """
    file = log_file(path)
    if isinstance(file, Path) and file.is_dir() and not is_bag_folder(file):
        return None
    if data_set_address(path) is not None:
        return None
    file = readable_file(path)
    try:
        reader = open_messages(file)
        if isinstance(reader, McapLog) and (OBJECTS in reader.channel_topics or not reader.channel_topics):
            return None
    except MissingFileError:
        raise
    except LogError:
        return None
    return reader


def survey(
    reader: MessageReader, advance: Callable[[int], object] = lambda messages: None, *, whole: bool = True
) -> Survey:
    """Survey an external log.

    Args:
        advance: function that is called repeatedly with the number of messages read since the last call.
        whole: whether to read the whole log and find all damage. Otherwise reading ends when there are enough
            messages of every topic.

    Raises:
        LogError: nothing can be read.
    """
    topics = reader.topics()
    counter = _Counter(reader, topics)
    for message_count, message in enumerate(reader.iter_messages({topic.name for topic in topics}), 1):
        counter.add(message)
        if message_count % _STEP == 0:
            advance(_STEP)
        if not whole and not counter.missing:
            break
    suggestions = suggest_topics(topics, counter.examples, counter.times_ns)
    faults = FaultList()
    reader.move_faults(faults)
    return Survey(
        name=reader.name,
        kind=reader.kind,
        start_ns=counter.start_ns,
        end_ns=counter.end_ns,
        topics=tuple(
            TopicSurvey(suggestion.topic, counter.counts[suggestion.topic.name], suggestion.entry)
            for suggestion in suggestions
        ),
        mapping=suggest_mapping(reader.name, topics, counter.examples, counter.times_ns),
        faults=faults.take(last=True),
        remarks=(*reader.take_remarks(), *counter.take_remarks()),
    )


@dataclass(frozen=True, slots=True)
class Regularity:
    """Regularity of samples or messages over a log.

    Attributes:
        count: number of samples or messages.
        rate: rate in hertz with two decimals, rounded down.
        max_gap: longest pause in seconds with three decimals, rounded up. Pauses before the first and
            after the last sample or message are included.
    """

    count: int
    rate: float
    max_gap: float

    @classmethod
    def of(cls, times_ns: Integers, start_ns: int, end_ns: int) -> Regularity:
        gaps_ns = np.diff(times_ns, prepend=start_ns, append=end_ns)
        duration_s = max(end_ns - start_ns, 1) / 1e9
        # figures are rounded to the log's disadvantage, so that no printed figure meets a limit that the log
        # misses
        return cls(
            len(times_ns),
            math.floor(100.0 * (len(times_ns) - 1) / duration_s) / 100.0,
            math.ceil(int(gaps_ns.max()) / 1e6) / 1e3,
        )

    def lacks(self, wanted: Mapping[str, Any], what: str) -> Iterator[str]:
        """Yield a sentence with the subject `what` for each missed limit in `wanted`."""
        if self.rate < (least_rate := wanted.get("rate", 0.0)):
            yield f"{what} have {self.rate:g} a second, at least {least_rate:g} are required"
        if self.max_gap > (gap_ns(wanted.get("max_gap")) or math.inf) / 1e9:
            yield f"{what} pause for {self.max_gap:g} s, at most {wanted['max_gap']} is allowed"


@dataclass(frozen=True, slots=True)
class Fitness:
    """Fitness of a log for judging.

    Attributes:
        samples: regularity of the samples.
        topics: regularity of messages, by topic; empty for logs without messages.
        objects: by object name, share of samples in which the object's state is known. The share is rounded
            down to three decimals.
    """

    samples: Regularity
    topics: Mapping[str, Regularity]
    objects: Mapping[str, float]

    def lacks(self, required: Mapping[str, Any]) -> Iterator[str]:
        """Yield a sentence for each requirement that the log misses; `required` is a suite's `requires`."""
        yield from self.samples.lacks(required.get("samples", {}), "samples")
        for name, requirement in required.get("topics", {}).items():
            if name in self.topics:
                yield from self.topics[name].lacks(requirement, f"messages of {name}")
            else:
                yield f"there is no message of {name}"
        for name, share in required.get("objects", {}).items():
            if (known_share := self.objects.get(name, 0.0)) < share:
                yield f"{name} is known in {known_share:g} of the samples, at least {share:g} are required"


def fitness_of(path: str | PathLike[str], source: Source) -> Fitness:
    """Return the fitness of a log, after reading its samples and the times of all its messages.

    Raises:
        LogError: nothing can be read.
    """
    tally, no_times = _Tally(), np.empty(0, np.int64)
    trace_times_ns = [no_times]
    for block in read_blocks(source.keeping()):
        tally.add(block.trace)
        trace_times_ns.append(block.trace.times_ns)
    sample_times_ns = np.concatenate(trace_times_ns)
    if not len(sample_times_ns):
        raise LogError(f"{source.name} has no sample")
    times_by_topic: dict[str, list[Integers]] = defaultdict(list)
    reader = None
    # an episode of a data set has no messages
    with suppress(LogError):
        reader = None if data_set_address(path) is not None else open_messages(readable_file(path))
    for columns in reader.iter_columns({topic.name for topic in reader.topics()}) if reader else ():
        for name, row_indices in columns.by_topic():
            times_by_topic[name].append(columns.log_time_ns[row_indices])
    topic_times_ns = {
        name: np.concatenate(time_arrays) for name, time_arrays in sorted(times_by_topic.items())
    }
    start_ns = min((int(times_ns[0]) for times_ns in topic_times_ns.values()), default=0)
    end_ns = max((int(times_ns[-1]) for times_ns in topic_times_ns.values()), default=0)
    return Fitness(
        Regularity.of(sample_times_ns, int(sample_times_ns[0]), int(sample_times_ns[-1])),
        {name: Regularity.of(times_ns, start_ns, end_ns) for name, times_ns in topic_times_ns.items()},
        {
            tracked.name: math.floor(1000.0 * (tracked.samples - tracked.unreadable) / tally.samples) / 1000.0
            for tracked in tally.objects()
        },
    )


class _Counter:
    """Counter of messages that also decodes examples of each topic.

    Attributes:
        missing: topics that still lack messages for a survey.
    """

    def __init__(self, reader: MessageReader, topics: Sequence[Topic]) -> None:
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self.counts = {topic.name: 0 for topic in topics}
        self.examples: dict[str, list[object]] = {}
        self.times_ns: dict[str, list[int]] = {}
        self._remarks: list[str] = []
        self._undecodable: dict[str, tuple[int, Sentence]] = {}
        self._decoders: dict[str, Decoder] = {}
        self.missing = {topic.name for topic in topics if topic.count != 0}
        for topic in topics:
            try:
                if topic.unreadable is not None:
                    raise LogError(topic.unreadable)
                self._decoders[topic.name] = reader.decoder(topic)
                self.examples[topic.name], self.times_ns[topic.name] = [], []
            except LogError as error:
                self._remarks.append(str(error))
        self._declared_counts = {topic.name: topic.count for topic in topics}
        self._example_bytes = dict.fromkeys(self._declared_counts, 0)

    def add(self, message: Message) -> None:
        time_ns, topic = message.log_time_ns, message.topic
        self.start_ns = time_ns if self.start_ns is None else min(self.start_ns, time_ns)
        self.end_ns = time_ns if self.end_ns is None else max(self.end_ns, time_ns)
        self.counts[topic] += 1
        if self.counts[topic] in _LOOKED_AT and topic in self.examples:
            self._look(message)
        if self.counts[topic] >= _ENOUGH or self.counts[topic] == self._declared_counts[topic]:
            self.missing.discard(topic)

    def _look(self, message: Message) -> None:
        topic = message.topic
        self._example_bytes[topic] += len(message.payload)
        if self.counts[topic] > 1 and self._example_bytes[topic] > _EXAMPLE_BYTES:
            return
        try:
            self.examples[topic].append(self._decoders[topic](message.payload))
            self.times_ns[topic].append(message.log_time_ns)
        except LogError as error:
            prefix = f"topic {topic!r}: "
            fault_start = f"{prefix}{str(error).removeprefix(prefix)}, at "
            fault = Sentence(fault_start, Instant(message.log_time_ns, 0))
            fault_count, first_fault = self._undecodable.get(topic, (0, fault))
            self._undecodable[topic] = fault_count + 1, first_fault

    def take_remarks(self) -> list[str]:
        """Return remarks on topics, and on examples, that cannot be decoded."""
        return self._remarks + [
            Sentence(
                first_fault,
                f" ({fault_count} of {fault_count + len(self.examples[topic])} messages looked at)",
            )
            for topic, (fault_count, first_fault) in self._undecodable.items()
        ]


@dataclass(frozen=True, slots=True)
class ObjectOverview:
    """One object over a log.

    Attributes:
        classes: class names of the object, in order of code points.
        samples: number of samples in which the object was observed.
        unreadable: number of samples in which a coordinate of the object was not finite.
    """

    name: str
    classes: tuple[str, ...]
    samples: int
    unreadable: int


@dataclass(frozen=True, slots=True)
class Overview:
    """Overview of a log.

    Attributes:
        start_ns, end_ns: times of the first and the last sample; None without samples.
        period_ns: usual time between samples; 0 with fewer than two samples.
        faults: sentences on data that was lost or left out.
        container: channels, metadata and attachments of an MCAP log; None for other formats.
        remarks: notes that do not concern losses.
        axes: axes of the source. Its samples already have our axes.
        doubts: assumptions that the log contradicts.
        facts: facts of each mapped topic.
    """

    name: str
    kind: str
    samples: int
    start_ns: int | None
    end_ns: int | None
    period_ns: int
    objects: tuple[ObjectOverview, ...]
    signals: tuple[str, ...]
    faults: tuple[str, ...]
    container: LogSummary | None = None
    remarks: tuple[str, ...] = ()
    axes: Axes = OUR_AXES
    doubts: tuple[Doubt, ...] = ()
    facts: tuple[TopicFacts, ...] = ()


def overview_of(source: Source, advance: Callable[[int], object] = lambda samples: None) -> Overview:
    """Read a log once and return its overview.

    Args:
        advance: function that is called repeatedly with the number of samples read since the last call.

    Raises:
        LogError: the log has no readable sample.
    """
    tally = _Tally()
    remarks: list[str] = []
    doubts: dict[Doubt, None] = {}
    facts: tuple[TopicFacts, ...] = ()
    container = summarise_mcap(source) if isinstance(source, McapSource) else None
    # an MCAP log without objects has no samples; only its container is listed
    if container is None or container.has_objects:
        try:
            # a local log is read whole, to find all damage; only the samples of a remote log are read
            read_source = source.keeping() if isinstance(source.path, RemoteFile) else source
            for block in read_source.iter_blocks():
                tally.add(block.trace)
                remarks += block.remarks
                doubts |= dict.fromkeys(block.doubts)
                facts += block.facts
                advance(len(block.trace))
        except UsageError as error:
            # a scenario without objects is valid; a mapping that does not fit is the user's mistake
            if not isinstance(source, TrackSource):
                raise
            remarks.append(str(error))
    faults = [*tally.faults, *(container.faults if container is not None else ())]
    return Overview(
        name=source.name,
        kind=source.kind,
        samples=tally.samples,
        start_ns=tally.start_ns,
        end_ns=tally.end_ns,
        period_ns=tally.pauses.usual_ns,
        objects=tally.objects(),
        signals=tuple(sorted(tally.signals)),
        # reading of samples and listing of the container report the same damage
        faults=tuple(dict.fromkeys(faults)),
        container=container,
        remarks=(*(doubt.remark(source.name) for doubt in doubts), *remarks),
        axes=source.axes,
        doubts=distinct_doubts(doubts, tally.start_ns or 0),
        facts=facts,
    )


def overview_of_survey(path: str | PathLike[str], survey: Survey) -> Overview:
    """Return the overview of an external log without a mapping, and so without samples."""
    container = summarise_mcap(McapSource(readable_file(path))) if survey.kind == McapSource.kind else None
    faults = container.faults if container is not None else ()
    return Overview(survey.name, survey.kind, 0, None, None, 0, (), (), faults, container)


@dataclass(slots=True)
class _Tally:
    """Counts over the blocks so far."""

    samples: int = 0
    start_ns: int | None = None
    end_ns: int | None = None
    samples_with: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    unreadable: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    classes: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    signals: set[str] = field(default_factory=set)
    faults: list[str] = field(default_factory=list)
    pauses: Pauses = field(default_factory=Pauses)

    def add(self, trace: Trace) -> None:
        self.faults.extend(trace.faults)
        if not len(trace):
            return
        self.samples += len(trace)
        self.pauses.add(trace.times_ns)
        self.start_ns = int(trace.times_ns[0]) if self.start_ns is None else self.start_ns
        self.end_ns = int(trace.times_ns[-1])
        self.signals.update(trace.signals)
        for object_index, name in enumerate(trace.names):
            rows = trace.rows[:, object_index]
            readable_rows, unreadable_rows = rows[rows >= 0], -2 - rows[rows <= -2]
            self.samples_with[name] += len(readable_rows) + len(unreadable_rows)
            self.unreadable[name] += len(unreadable_rows)
            class_codes = np.unique(
                trace.class_code[np.concatenate([readable_rows, unreadable_rows])]
            ).tolist()
            self.classes[name].update(
                class_name for code in class_codes if (class_name := trace.classes[code]) is not None
            )

    def objects(self) -> tuple[ObjectOverview, ...]:
        return tuple(
            ObjectOverview(name, tuple(sorted(self.classes[name])), samples, self.unreadable[name])
            for name, samples in sorted(self.samples_with.items())
        )
