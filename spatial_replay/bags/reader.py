"""Messages as columns, and the interface of all logs of messages.

Columns replace a million small objects, which Python's garbage collection would scan repeatedly. The scans
would take longer than reading the log.

Chunks and files of a log may overlap in time, so their messages are merged. Logs whose clock jumps back, such
as after a restart of a simulation, are refused: sorted by time, both runs would look like one.
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
"""Number of `Message` objects that are made at once, below the threshold of Python's garbage collection."""


class Message(NamedTuple):
    """One message of a log.

    Attributes:
        log_time_ns: time of recording.
        publish_time_ns: time of sending; the log time if the log stores no time of sending.
        sequence: number of the message within its topic; 0 for a log without such numbers. Messages of one
            topic and time are ordered by this number.
        payload: message in the encoding of its topic.
    """

    topic: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    payload: bytes


@dataclass(frozen=True, slots=True, eq=False)
class MessageColumns(Messages):
    """M messages on the channels of `MessageReader.channels`; each publisher of a topic may have a channel.

    Attributes:
        place: (M,) int64, numbers that increase in the order of recording.
    """

    place: Integers = field(default_factory=lambda: np.zeros(0, np.int64))

    def sort_by_time(self) -> MessageColumns:
        """Sort the messages by log time, topic and sequence; the sort is stable."""
        times_ns = self.log_time_ns
        if (times_ns[1:] > times_ns[:-1]).all():
            return self
        return select(self, np.lexsort((self.sequence, self.topic_ranks, times_ns)))

    def count_before(self, time_ns: int) -> int:
        """Count the messages before a time; the messages must be sorted by time."""
        return int(np.searchsorted(self.log_time_ns, time_ns, side="left"))

    def raw(self, channels: Mapping[int, Channel]) -> Messages:
        """Return the messages as `Messages` on the given channels, for a copy of the log."""
        columns = self.channel, self.sequence, self.log_time_ns, self.publish_time_ns, self.payloads
        return Messages(channels, *columns)

    def messages(self) -> list[Message]:
        """Return the messages as objects."""
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
    """Return places of messages in a log of several parts; places increase from part to part.

    Args:
        part: index of the part.
        within: places in the part.
    """
    return (np.int64(part) << 28) + within


def in_order(
    starts_ns: Sequence[int], chunks: Iterable[MessageColumns], name: str, most_bytes: int
) -> Columns:
    """Yield the messages of several chunks by log time, topic and sequence.

    Only messages of chunks that overlap in time are held in memory.

    Args:
        starts_ns: sorted start times of the chunks; a message before the start of its chunk is yielded late.
        name: name of the log.
        most_bytes: maximum number of bytes of messages in memory.

    Raises:
        LogError: the messages in memory exceed `most_bytes`.
    """
    waiting = MessageColumns()
    held_bytes = 0
    for chunk_count, chunk in enumerate(chunks, 1):
        held_bytes += sum(map(len, chunk.payloads))
        if held_bytes > most_bytes:
            raise too_many_waiting(name, most_bytes)
        waiting = concatenate_tables([waiting, chunk] if len(waiting) else [chunk]).sort_by_time()
        if chunk_count == len(starts_ns):
            break
        ready_count = waiting.count_before(starts_ns[chunk_count])
        if ready_count:
            yield select(waiting, slice(ready_count))
            waiting = select(waiting, slice(ready_count, None))
            held_bytes = sum(map(len, waiting.payloads))
    if len(waiting):
        yield waiting


_Active = list[tuple[int, int, MessageColumns, Columns]]
"""Heap of open files: time of the next message, index of the file, read messages, unread messages."""


def merge_files(files: Iterable[tuple[int, Callable[[], Columns]]]) -> Columns:
    """Merge the messages of several files by log time; a file is opened when its first message is due.

    Args:
        files: for each file, the time of its first message, and a function that opens it.
    """
    unopened_files = sorted(files, key=itemgetter(0), reverse=True)
    active: _Active = []
    opened_count = 0
    while unopened_files or active:
        while unopened_files and (not active or unopened_files[-1][0] <= active[0][0]):
            _push_next(active, opened_count, unopened_files.pop()[1]())
            opened_count += 1
        if not active:
            continue
        _, file_number, columns, later_columns = heapq.heappop(active)
        limits_ns = [start_ns for start_ns, _ in unopened_files[-1:]] + [entry[0] for entry in active[:1]]
        # messages of equal times are yielded in the order of the files
        ready_count = columns.count_before(min(limits_ns) + 1) if limits_ns else len(columns)
        yield select(columns, slice(ready_count))
        if ready_count < len(columns):
            remaining = select(columns, slice(ready_count, None))
            heapq.heappush(active, (int(remaining.log_time_ns[0]), file_number, remaining, later_columns))
        else:
            _push_next(active, file_number, later_columns)


def _push_next(active: _Active, file_number: int, later_columns: Columns) -> None:
    for columns in later_columns:
        if len(columns):
            heapq.heappush(active, (int(columns.log_time_ns[0]), file_number, columns, later_columns))
            return


DISORDER_NS = 10**9
"""Default of the largest accepted disorder, nanoseconds; recorders write topics from several threads."""
JUMP_REMEDY = (
    "max_lateness='5s' (--read max_lateness=5s) takes messages that come later, 'all' sorts the whole log;"
    " on_time_jump='split' (--read on_time_jump=split) ends it where its clock jumps"
)


def without_jumps(
    columns: Columns, name: str, checked: Collection[str], disorder_ns: int = DISORDER_NS
) -> Columns:
    """Yield messages, which are sorted by time, and check the order of their recording.

    Args:
        checked: topics to check; messages of other topics may have been recorded in any order.
        disorder_ns: largest disorder of recording that is allowed.

    Raises:
        LogError: a topic's clock jumps: a message was recorded before a message that is earlier by more than
            `disorder_ns`.
    """
    first_ns: int | None = None
    # logs that were merged topic by topic are in order too, so each topic is checked separately
    history_by_topic = dict[str, _PlaceHistory]()
    for message_columns in columns:
        if first_ns is None and len(message_columns):
            first_ns = int(message_columns.log_time_ns[0])
        for topic, message_indices in message_columns.by_topic():
            if topic not in checked:
                continue
            history = history_by_topic.setdefault(topic, _PlaceHistory(disorder_ns))
            jump_index = history.first_jump(
                message_columns.log_time_ns[message_indices], message_columns.place[message_indices]
            )
            if jump_index is not None:
                jump_instant = Instant(
                    int(message_columns.log_time_ns[message_indices][jump_index]), first_ns or 0
                )
                raise LogError(
                    f"{name}: time jumps back: the message on {topic!r} logged at {jump_instant} was recorded"
                    f" before others that were logged more than {disorder_ns / 1e9:g} s earlier;"
                    f" {JUMP_REMEDY}"
                )
        yield message_columns


class _PlaceHistory:
    """For each message of the last `disorder_ns`, the greatest place of recording so far."""

    def __init__(self, disorder_ns: int) -> None:
        self._disorder_ns = disorder_ns
        self._latest: deque[tuple[Integers, Integers]] = deque()
        self._place_before = self._furthest_place = -1

    def first_jump(self, times_ns: Integers, places: Integers) -> int | None:
        """Return the first message that jumps.

        Such a message was recorded before another message whose time is earlier by more than `disorder_ns`.

        Args:
            times_ns, places: (M,) times and places of at least one message, sorted by time, later than the
                messages of the previous call.

        Returns:
            the index of the message; None for messages without a jump.
        """
        furthest_places = np.maximum.accumulate(np.append(self._furthest_place, places))[1:]
        self._latest.append((times_ns, furthest_places))
        self._furthest_place, jump_indices = int(furthest_places[-1]), np.zeros(0, np.int64)
        if (places < furthest_places).any():
            recent_ns, recent_places = map(np.concatenate, zip(*self._latest, strict=True))
            earlier_indices = np.searchsorted(recent_ns, times_ns - self._disorder_ns)
            jump_indices = np.flatnonzero(
                places < np.append(self._place_before, recent_places)[earlier_indices]
            )
        while self._latest[0][0][-1] < times_ns[-1] - self._disorder_ns:
            self._place_before = int(self._latest.popleft()[1][-1])
        return int(jump_indices[0]) if len(jump_indices) else None


class MessageReader(ABC):
    """A log of messages in a file or folder, which is read again for each iteration.

    Attributes:
        kind: name of the format.
    """

    kind: str

    def __init__(self, path: LogFile) -> None:
        # for a remote file, `_path` is only a name; readers that open `_path` get local files only
        self._path = path if isinstance(path, Path) else Path(path.name)
        self._faults, self._remarks = FaultList(), FaultList()
        self._part_readers: Sequence[MessageReader] = ()

    @property
    @abstractmethod
    def _topics(self) -> tuple[Topic, ...]:
        """The topics that the log declares, sorted by name."""

    @property
    def profile(self) -> str:
        """MCAP profile of this log's messages, such as "ros2"; "" for none."""
        # https://mcap.dev/spec/registry#well-known-profiles
        return {"ROS 1 bag": "ros1", "ROS 2 bag": "ros2"}.get(self.kind, "")

    @property
    def _distribution(self) -> str | None:
        """ROS release that the log names, for types that the log does not define."""
        return None

    @property
    @abstractmethod
    def start_ns(self) -> int | None:
        """Log time of the first message."""

    @abstractmethod
    def _read(self, topics: Collection[str], first_ns: int, end_ns: int, *, as_recorded: bool) -> Columns:
        """Yield the messages of some topics with log times in [first_ns, end_ns)."""

    @property
    @abstractmethod
    def _declared(self) -> Mapping[int, Channel]:
        """The channels by their numbers in the log."""

    @cached_property
    def _numbers(self) -> Integers:
        """The sorted numbers of channels in the log."""
        return np.array(sorted(self._declared), np.int64)

    @cached_property
    def _channels(self) -> Mapping[int, Channel]:
        """The channels by dense numbers from 0 on."""
        return {rank: self._declared[number] for rank, number in enumerate(self._numbers.tolist())}

    def _channel_numbers(self, topics: Collection[str]) -> list[int]:
        return [number for number, channel in self._declared.items() if channel.topic in topics]

    def _make_columns(
        self,
        numbers: Integers,
        times_ns: tuple[Integers, Integers],
        sequence: Integers,
        payloads: Sequence[bytes],
        place: Integers,
    ) -> MessageColumns:
        """Build columns; `numbers` are channel numbers of the log, `times_ns` log and publish times."""
        channel = np.searchsorted(self._numbers, numbers)
        return MessageColumns(self._channels, channel, sequence, *times_ns, payloads, place)

    def channels(self, topics: Collection[str]) -> Mapping[int, Channel]:
        """Return the channels of some topics by their numbers in `MessageColumns.channel`.

        A copy of the log declares these channels, with the schema, encoding and metadata of the log. A ROS
        type without a definition in the log gets the standard definition of the type.
        """
        return {number: channel for number, channel in self._channels.items() if channel.topic in topics}

    def attachments(self) -> tuple[Attachment, ...]:
        """Return the attachments of the log; damaged attachments are left out."""
        return ()

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """Return the metadata records of the log with their names; damaged records are left out."""
        return ()

    @property
    def name(self) -> str:
        """The base name of its file or folder."""
        return encodable(self._path.name or self._path.absolute().name)

    def topics(self) -> tuple[Topic, ...]:
        """Return the topics, sorted by name.

        Raises:
            LogError: the log is too damaged, or declares no topic.
        """
        if not self._topics:
            reason = next(iter(self._faults.take()), "it is empty")
            raise LogError(f"{self.name} holds no topic: {reason}")
        return self._topics

    def decoder(self, topic: str | Topic) -> Decoder:
        """Return a decoder for the messages of a topic, which is a name or a `Topic`.

        For a payload that does not fit, the decoder raises LogError with the reason.

        Raises:
            LogError: the topic's definition is missing or invalid.
        """
        if isinstance(topic, str):
            topic = next(candidate for candidate in self._topics if candidate.name == topic)
        return decoder_of(topic, self._distribution)

    def iter_messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield the messages of some topics by log time.

        A message before the start time of its chunk is yielded late.

        Args:
            start_ns, end_ns: window of log times, [start_ns, end_ns).

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
        """Yield the messages of `iter_messages` as columns.

        Args:
            as_recorded: whether messages are in the order of recording, in which times may jump back.
        """
        first_ns, last_ns = start_ns or 0, LATEST_NS + 1 if end_ns is None else min(end_ns, LATEST_NS + 1)
        columns = self._read(topics, first_ns, last_ns, as_recorded=as_recorded)
        yield from self._count(columns, topics) if (first_ns, last_ns) == (0, LATEST_NS + 1) else columns

    def take_faults(self) -> tuple[str, ...]:
        """Return the losses on the read topics since the last call, each with its place."""
        self._gather_parts()
        return self._faults.take()

    def move_faults(self, target: FaultList) -> None:
        """Move the faults of `take_faults` to another list; add the count of faults beyond the limit."""
        self._gather_parts()
        self._faults.move_to(target)

    def take_remarks(self) -> tuple[str, ...]:
        """Return the remarks since the last call: irregularities without a loss on the read topics."""
        part_remarks = (remark for part in self._part_readers for remark in part.take_remarks())
        return (*self._remarks.take(), *part_remarks)

    def _gather_parts(self) -> None:
        """Collect the faults of the opened files of the log."""
        for part in self._part_readers:
            part.move_faults(self._faults)

    def _count(self, columns: Columns, topics: Collection[str], name: str | None = None) -> Columns:
        """Yield all messages of some topics, then compare their numbers with the declared numbers."""
        read_counts = Counter[str]()
        for message_columns in columns:
            read_counts.update(message_columns.topics)
            yield message_columns
        for topic in self._topics:
            read_count = read_counts[topic.name]
            if topic.name in topics and topic.count not in (None, read_count):
                declaration = f"it declares {topic.count} messages on {topic.name!r}"
                self._faults.add(f"{name or self.name}: {declaration}; {read_count} could be read")
