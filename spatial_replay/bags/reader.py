"""Logs of messages: messages as columns, and the interface of every log.

Columns, because a million small objects that live for a while make Python's garbage collection look through
all of them again and again, which costs more than reading them.

Chunks and files of a log may overlap in time, so their messages are merged. Logs whose clock jumped back, as
when a simulation restarts, are refused: sorted by time, both passes would look like one.
"""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from spatial_replay.bags.decoders import Topic, decoder_of
from spatial_replay.bags.definitions import Decoder
from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import Integers, concatenate_tables, select
from spatial_replay.logs.mcap.read import too_many_waiting
from spatial_replay.logs.messages import Attachment, Channel, Messages
from spatial_replay.logs.read_options import FaultList
from spatial_replay.logs.remote import LogFile
from spatial_replay.text import Instant, encodable
from spatial_replay.trace.trace import LATEST_NS

_TOGETHER = 512
"""Messages made at once: fewer than the garbage collector lets pass before it runs."""


class Message(NamedTuple):
    """One message of a log.

    Attributes:
        log_time_ns: when it was recorded.
        publish_time_ns: when it was sent; the log time where the container does not know.
        sequence: number within its topic as in the log, 0 where the log has none; of messages of one topic
            and time, the later one has the greater number.
        payload: in its topic's encoding.
    """

    topic: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    payload: bytes


@dataclass(frozen=True, slots=True, eq=False)
class MessageColumns(Messages):
    """M messages, on the channels of `MessageReader.channels`: several publishers of one topic have several.

    Attributes:
        place: (M,) int64, numbers that increase in the order in which the messages were recorded.
    """

    place: Integers = field(default_factory=lambda: np.zeros(0, np.int64))

    def sort_by_time(self) -> MessageColumns:
        """Return the same messages by log time, topic and sequence; equal ones keep their order."""
        times = self.log_time_ns
        if (times[1:] > times[:-1]).all():
            return self
        return select(self, np.lexsort((self.sequence, self.topic_ranks, times)))

    def count_before(self, time_ns: int) -> int:
        """Count the messages, which are in order, before a time."""
        return int(np.searchsorted(self.log_time_ns, time_ns, side="left"))

    def raw(self, channels: Mapping[int, Channel]) -> Messages:
        """Return the messages as a copy of the log has them, on these channels."""
        columns = self.channel, self.sequence, self.log_time_ns, self.publish_time_ns, self.payloads
        return Messages(channels, *columns)

    def messages(self) -> list[Message]:
        """Return the messages one by one."""
        return [
            Message(topic, row.log_time_ns, row.publish_time_ns, row.sequence, row.payload)
            for topic, row in zip(self.topics, self.rows(), strict=True)
        ]


Columns: TypeAlias = Iterator[MessageColumns]


def in_pieces(columns: Columns) -> Columns:
    """Yield the same messages, at most `_TOGETHER` at a time."""
    for message_columns in columns:
        for begin in range(0, len(message_columns), _TOGETHER):
            yield select(message_columns, slice(begin, begin + _TOGETHER))


def places_in(part: int, within: Integers) -> Integers:
    """Return places in a log of several parts, such as chunks, in the order of the parts."""
    return (np.int64(part) << 28) + within


def in_order(
    starts_ns: Sequence[int], chunks: Iterable[MessageColumns], name: str, most_bytes: int
) -> Columns:
    """Yield the messages of several chunks by log time, topic and sequence.

    It holds no more messages than overlap.

    Args:
        starts_ns: when each chunk begins, in order; a message before that comes late.
        name: of the log.
        most_bytes: of the messages that it may hold.

    Raises:
        LogError: it would hold more.
    """
    waiting = MessageColumns()
    held = 0
    for number, chunk in enumerate(chunks, 1):
        held += sum(map(len, chunk.payloads))
        if held > most_bytes:
            raise too_many_waiting(name, most_bytes)
        waiting = concatenate_tables([waiting, chunk] if len(waiting) else [chunk]).sort_by_time()
        if number == len(starts_ns):
            break
        ready = waiting.count_before(starts_ns[number])
        if ready:
            yield select(waiting, slice(ready))
            waiting = select(waiting, slice(ready, None))
            held = sum(map(len, waiting.payloads))
    if len(waiting):
        yield waiting


_Active = list[tuple[int, int, MessageColumns, Columns]]
"""A heap: time of the first message, number of the file, messages, and those that follow them."""


def merge_files(files: Iterable[tuple[int, Callable[[], Columns]]]) -> Columns:
    """Merge the messages of several files by log time; a file is opened when its time has come.

    Args:
        files: of each, the time of its first message, and what opens it.
    """
    waiting = sorted(files, key=itemgetter(0), reverse=True)
    active: _Active = []
    opened = 0
    while waiting or active:
        while waiting and (not active or waiting[-1][0] <= active[0][0]):
            _push_next(active, opened, waiting.pop()[1]())
            opened += 1
        if not active:
            continue
        _, number, columns, following = heapq.heappop(active)
        limits = [start_ns for start_ns, _ in waiting[-1:]] + [entry[0] for entry in active[:1]]
        # equal times come in the order of the files
        ready = columns.count_before(min(limits) + 1) if limits else len(columns)
        yield select(columns, slice(ready))
        if ready < len(columns):
            rest = select(columns, slice(ready, None))
            heapq.heappush(active, (int(rest.log_time_ns[0]), number, rest, following))
        else:
            _push_next(active, number, following)


def _push_next(active: _Active, number: int, following: Columns) -> None:
    for columns in following:
        if len(columns):
            heapq.heappush(active, (int(columns.log_time_ns[0]), number, columns, following))
            return


DISORDER_NS = 10**9
"""How far messages may be out of order by default: recorders write topics from several threads."""
JUMP_REMEDY = (
    "max_lateness='5s' (--read max_lateness=5s) takes messages that come later, 'all' sorts the whole log;"
    " on_time_jump='split' (--read on_time_jump=split) ends it where its clock jumps"
)


def without_jumps(
    columns: Columns, name: str, checked: Collection[str], disorder_ns: int = DISORDER_NS
) -> Columns:
    """Yield the messages as they are, which are in the order of time.

    Args:
        checked: the topics to check; others are only copied, in any order.
        disorder_ns: how far they may have been recorded out of order.

    Raises:
        LogError: those of a topic were not recorded in that order: some of them come more than that before
            others that were recorded earlier.
    """
    first_ns: int | None = None
    # logs put together topic by topic are in order all the same, so each topic counts by itself
    topics = dict[str, _Recorded]()
    for message_columns in columns:
        if first_ns is None and len(message_columns):
            first_ns = int(message_columns.log_time_ns[0])
        for topic, rows in message_columns.by_topic():
            if topic not in checked:
                continue
            recorded = topics.setdefault(topic, _Recorded(disorder_ns))
            jump = recorded.first_jump(message_columns.log_time_ns[rows], message_columns.place[rows])
            if jump is not None:
                at = Instant(int(message_columns.log_time_ns[rows][jump]), first_ns or 0)
                raise LogError(
                    f"{name}: time jumps back: the message on {topic!r} logged at {at} was recorded before"
                    f" others that were logged more than {disorder_ns / 1e9:g} s earlier; {JUMP_REMEDY}"
                )
        yield message_columns


class _Recorded:
    """How far the recording had come at each message of the last moments, as long as the disorder."""

    def __init__(self, disorder_ns: int) -> None:
        self._disorder_ns = disorder_ns
        self._latest: deque[tuple[Integers, Integers]] = deque()
        self._before = self._furthest = -1

    def first_jump(self, times_ns: Integers, places: Integers) -> int | None:
        """Return the first message recorded before one that is earlier by more than the disorder, or None.

        Args:
            times_ns, places: (M,) of messages in the order of time, at least one, after those of the call
                before.
        """
        furthest = np.maximum.accumulate(np.append(self._furthest, places))[1:]
        self._latest.append((times_ns, furthest))
        self._furthest, jumps = int(furthest[-1]), np.zeros(0, np.int64)
        if (places < furthest).any():
            times, reached = map(np.concatenate, zip(*self._latest, strict=True))
            earlier = np.searchsorted(times, times_ns - self._disorder_ns)
            jumps = np.flatnonzero(places < np.append(self._before, reached)[earlier])
        while self._latest[0][0][-1] < times_ns[-1] - self._disorder_ns:
            self._before = int(self._latest.popleft()[1][-1])
        return int(jumps[0]) if len(jumps) else None


class MessageReader(ABC):
    """A log of messages in a file or folder, which is read again for each iteration.

    Attributes:
        kind: the format, in a word.
    """

    kind: str

    def __init__(self, path: LogFile) -> None:
        # readers that open paths get none of a remote file
        self._path = path if isinstance(path, Path) else Path(path.name)
        self._faults, self._remarks = FaultList(), FaultList()
        self._parts: Sequence[MessageReader] = ()

    @property
    @abstractmethod
    def _topics(self) -> tuple[Topic, ...]:
        """The topics that the log declares, by name."""

    @property
    def profile(self) -> str:
        """Return how an MCAP log with its messages names their origin."""
        return {"ROS 1 bag": "ros1", "ROS 2 bag": "ros2"}.get(self.kind, "")

    @property
    def _distribution(self) -> str | None:
        """The ROS release that the log names, for types that it does not define."""
        return None

    @property
    @abstractmethod
    def start_ns(self) -> int | None:
        """Log time of the first message."""

    @abstractmethod
    def _read(self, topics: Collection[str], first: int, last: int, *, as_recorded: bool) -> Columns:
        """Yield the messages of some topics logged from `first` up to, not including, `last`."""

    @property
    @abstractmethod
    def _declared(self) -> Mapping[int, Channel]:
        """The channels, by the numbers that the log gives them."""

    @cached_property
    def _numbers(self) -> Integers:
        """The numbers that the log gives channels, in order."""
        return np.array(sorted(self._declared), np.int64)

    @cached_property
    def _channels(self) -> Mapping[int, Channel]:
        """The channels, by dense numbers."""
        return {rank: self._declared[number] for rank, number in enumerate(self._numbers.tolist())}

    def _channel_numbers(self, topics: Collection[str]) -> list[int]:
        """Return the numbers that the log gives the channels of some topics."""
        return [number for number, channel in self._declared.items() if channel.topic in topics]

    def _make_columns(
        self,
        numbers: Integers,
        times_ns: tuple[Integers, Integers],
        sequence: Integers,
        payloads: Sequence[bytes],
        place: Integers,
    ) -> MessageColumns:
        """Return messages, given the numbers that the log gives their channels, and log and publish times."""
        channel = np.searchsorted(self._numbers, numbers)
        return MessageColumns(self._channels, channel, sequence, *times_ns, payloads, place)

    def channels(self, topics: Collection[str]) -> Mapping[int, Channel]:
        """Return the channels of some topics by the numbers of `MessageColumns.channel`, which are dense.

        A copy of a log declares them: their schema, encoding and metadata are those of the log. ROS types
        without a definition in the log get that of the standard type, if there is one.
        """
        return {number: channel for number, channel in self._channels.items() if channel.topic in topics}

    def attachments(self) -> tuple[Attachment, ...]:
        """Return the files in the log; those that are damaged are left out."""
        return ()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """Return the metadata records of the log, with their names; those that are damaged are left out."""
        return ()

    @property
    def name(self) -> str:
        """The base name of its file or folder."""
        return encodable(self._path.name or self._path.absolute().name)

    def topics(self) -> tuple[Topic, ...]:
        """Return the topics, by name.

        Raises:
            LogError: the log is too damaged, or declares no topic.
        """
        if not self._topics:
            reason = next(iter(self._faults.take()), "it is empty")
            raise LogError(f"{self.name} holds no topic: {reason}")
        return self._topics

    def decoder(self, topic: str | Topic) -> Decoder:
        """Return a decoder for the messages of a topic, by its name or as given.

        The decoder raises LogError for a payload that does not fit, with the reason.

        Raises:
            LogError: the topic's definition is missing or cannot be understood.
        """
        if isinstance(topic, str):
            topic = next(candidate for candidate in self._topics if candidate.name == topic)
        return decoder_of(topic, self._distribution)

    def iter_messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield the messages of some topics in the order of their log time, as far as the log keeps it.

        Args:
            start_ns, end_ns: only those logged from `start_ns` up to, not including, `end_ns`.

        Raises:
            LogError: nothing can be read.
        """
        for piece in in_pieces(self.iter_columns(topics, start_ns, end_ns)):
            yield from piece.messages()

    def iter_columns(
        self,
        topics: Collection[str],
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        as_recorded: bool = False,
    ) -> Columns:
        """Yield what `iter_messages` gives, as columns.

        Args:
            as_recorded: in the order of recording instead, which may jump back in time.
        """
        first, last = start_ns or 0, LATEST_NS + 1 if end_ns is None else min(end_ns, LATEST_NS + 1)
        columns = self._read(topics, first, last, as_recorded=as_recorded)
        yield from self._count(columns, topics) if (first, last) == (0, LATEST_NS + 1) else columns

    def take_faults(self) -> tuple[str, ...]:
        """Return what was lost since the last call, each with its place, on the topics that were read."""
        self._gather_parts()
        return self._faults.take()

    def move_faults(self, target: FaultList) -> None:
        """Move what `take_faults` would return to another list, with the count of faults beyond its limit."""
        self._gather_parts()
        self._faults.move_to(target)

    def take_remarks(self) -> tuple[str, ...]:
        """Return what is wrong since the last call without a loss on the topics that were read."""
        of_parts = (remark for part in self._parts for remark in part.take_remarks())
        return (*self._remarks.take(), *of_parts)

    def _gather_parts(self) -> None:
        """Take the faults of the files of the log that were opened."""
        for part in self._parts:
            part.move_faults(self._faults)

    def _count(self, columns: Columns, topics: Collection[str], name: str | None = None) -> Columns:
        """Yield all messages of some topics, then compare their number with what the log declares."""
        read = Counter[str]()
        for message_columns in columns:
            read.update(message_columns.topics)
            yield message_columns
        for topic in self._topics:
            count = read[topic.name]
            if topic.name in topics and topic.count not in (None, count):
                declared = f"it declares {topic.count} messages on {topic.name!r}"
                self._faults.add(f"{name or self.name}: {declared}; {count} could be read")
