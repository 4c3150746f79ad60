"""External logs as sources: a log and a mapping in; blocks of samples with their raw messages out.

Copies of the log contain the raw messages and their definitions, so that viewers show the messages next to
results.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cache, cached_property, partial
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from spatial_replay.bags.decoders import Topic, why_unreadable
from spatial_replay.bags.definitions import full_type_name
from spatial_replay.bags.open import files_of_bag_around, open_messages
from spatial_replay.bags.reader import Columns, MessageColumns, MessageReader, in_pieces, without_jumps
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import concatenate_tables, select
from spatial_replay.logs.behaviour_tree import NAV2_LOG, TREE_CHANNEL, Nav2Tree, TreeNode, TreeTick
from spatial_replay.logs.messages import Attachment, Block, Channel, Messages, Row, merge
from spatial_replay.logs.read_options import FaultList, late_ns
from spatial_replay.logs.remote import RemoteFile
from spatial_replay.logs.source import FileSource, noting_pauses
from spatial_replay.logs.topics import (
    MAPPED,
    METADATA,
    copied_channel,
    has_our_type,
    is_kept,
    remarks_on_copies,
)
from spatial_replay.mapping.assemble import Assembler
from spatial_replay.mapping.mapping_file import Clock, LogMapping
from spatial_replay.mapping.reading_plan import ReadingPlan
from spatial_replay.trace.trace import FOREVER, LATEST_NS, Trace
from spatial_replay.trace.units import Axes

_WAITING_BYTES = 2**26
"""Size limit of raw messages that wait for their samples, bytes. Above this size, no message waits."""

_MOST_UNREAD = 20
"""Limit of undecodable topics listed one by one."""


@dataclass(frozen=True)
class MappedSource(FileSource):
    """An external log, with a mapping from its messages to objects.

    Attributes:
        keep: topics whose raw messages are in the blocks, for copies of the log: "mapped" for topics that the
            mapping reads, "all", or patterns such as "/camera/*". Several values can be combined.
    """

    _: KW_ONLY
    mapping: LogMapping
    keep: tuple[str, ...] = (MAPPED,)

    def keeping(self, keep: tuple[str, ...] = ()) -> MappedSource:
        """See `Source.keeping`."""
        return replace(self, keep=keep)

    @property
    def max_gap_ns(self) -> int | None:
        return super().max_gap_ns or self.mapping.max_gap_ns

    @property
    def axes(self) -> Axes:
        """Axes of the messages; samples always have y up."""
        return self.mapping.axes

    @property
    def _given(self) -> Mapping[str, object]:
        mapping = {"mapping": self.mapping.name, "mapping_sha256": self.mapping.sha256}
        return {**mapping, **self.reading.non_defaults(), **mapping}

    @property
    def begin_ns(self) -> int | None:
        """Log time of the first message of a remote log; None for local logs, or if the time is unknown."""
        return open_messages(self.path).start_ns if isinstance(self.path, RemoteFile) else None

    @noting_pauses
    def iter_blocks(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Block]:
        """See `Source.iter_blocks`; from an indexed log, only messages for the window are read.

        Blocks hold raw messages of the topics in `keep`.
        """
        # None for a window of the whole log, because only a full read checks the declared counts
        start_ns = start_ns or None
        end_ns = None if end_ns is None or end_ns >= FOREVER else end_ns
        reader = open_messages(self.path)
        topics = tuple(map(self._with_type, reader.topics()))
        by_name = {topic.name: topic for topic in topics}
        plan = self._plan(reader, topics)
        mapped_topics = frozenset(plan.topics)
        copied_topics = [topic.name for topic in topics if is_kept(topic.name, self.keep, mapped_topics)]
        channels = _foreign_channels(reader, copied_topics)
        tree_log = _TreeLog(reader, topics, self.mapping.clock)
        copied_messages = _CopiedMessages(channels, tree_log)
        read_topics = mapped_topics | copied_messages.topics | tree_log.topics
        first_ns = partial(_first_ns, cache(partial(open_messages, self.path)))
        moving_topics = {topic.topic for topic in plan.planned if not topic.is_static}
        read_end_ns = FOREVER if end_ns is None or not plan.by_log_time else end_ns + plan.margin_ns
        assembler = Assembler(
            plan,
            lambda topic: reader.decoder(by_name[topic]),
            goes_on=cache(lambda: read_end_ns < FOREVER and first_ns(moving_topics, read_end_ns) is not None),
            name=self.name,
            start_ns=start_ns,
            end_ns=end_ns,
            on_time_jump=self.reading.on_time_jump,
            concave=self.reading.concave,
        )
        blocks = _Blocks(assembler, reader, copied_messages, start_ns or 0, end_ns)
        blocks.remarks.extend(
            f"{self.name}: it has no topic {topic!r}, which {self.mapping.name} marks as optional"
            for topic in plan.absent
        )
        blocks.remarks.extend(f"{self.name}: {remark}" for remark in plan.remarks)
        blocks.remarks.extend(_unread(self.name, topics, plan))
        blocks.remarks.extend(remarks_on_copies(self.name, channels.values()))
        files = files_of_bag_around(self.path) if isinstance(self.path, Path) else ()
        if len(files) > 1:
            description = f"one of the {len(files)} files of a bag; give its folder for all of them"
            blocks.remarks.append(f"{self.name}: it is {description}")
        static_topics = list(dict.fromkeys(topic.topic for topic in plan.planned if topic.is_static))
        if static_topics:
            # a static transform holds after its time, and a frame's first static transform also before its
            # time
            assembler.know_static(open_messages(self.path).iter_messages(static_topics))
        if start_ns is not None and plan.by_log_time and plan.sampled_topic is not None:
            sampled_ns = first_ns([plan.sampled_topic])
            fallback_topics = {
                planned.topic for planned in plan.planned if planned.name in plan.fallback_topics
            }
            is_read = sampled_ns is None or sampled_ns >= plan.first_read_ns(start_ns)
            assembler.know_start(None if is_read else sampled_ns, first_ns(fallback_topics))
        as_recorded = self.reading.on_time_jump == "split"
        columns = _columns(reader, plan, read_topics, start_ns, end_ns, as_recorded=as_recorded)
        if not as_recorded and plan.late_ns < LATEST_NS:
            columns = without_jumps(columns, self.name, mapped_topics, plan.late_ns)
        for piece in in_pieces(columns):
            # messages that are only copied make no samples, and do not advance the time of samples
            mapped_piece = piece if read_topics == mapped_topics else piece.of_topics(mapped_topics)
            yield from blocks.of(assembler.add(mapped_piece), piece)
            if assembler.is_finished:
                break
        yield from blocks.of(assembler.finish(), MessageColumns(), last=True)
        if not blocks.any_sample and start_ns is None and end_ns is None:
            reason = blocks.first_fault or "its messages make none with this mapping"
            raise LogError(f"{self.name} holds no sample: {reason}")

    def _with_type(self, topic: Topic) -> Topic:
        """Return a topic. A ROS topic without a type in the log gets the mapping's type."""
        type_names = (entry.type for entry in self.mapping.topics if entry.topic == topic.name and entry.type)
        type_name = next(type_names, None)
        if topic.type or type_name is None or topic.encoding not in ("ros1", "cdr"):
            return topic
        typed_topic = replace(topic, type=full_type_name(type_name))
        return replace(typed_topic, unreadable=why_unreadable(typed_topic))

    def _plan(self, reader: MessageReader, topics: Sequence[Topic]) -> ReadingPlan:
        """Compare the mapping with the topics of the log.

        Raises:
            LogError: a mapped topic cannot be decoded, or is missing from a damaged log.
            UsageError: the mapping does not fit the log.
        """
        mapped_names = {*(entry.topic for entry in self.mapping.topics), self.mapping.sampling.topic}
        reasons = [topic.unreadable for topic in topics if topic.name in mapped_names and topic.unreadable]
        if reasons:
            fault_texts = [f"{self.name}: {reason}" for reason in reasons]
            raise LogError("\n".join([*fault_texts, *reader.take_faults()]))
        try:
            mapping = replace(self.mapping, max_gap_ns=self.max_gap_ns)
            return ReadingPlan.of(mapping, topics, late_ns(self.reading.max_lateness))
        except UsageError as error:
            faults = reader.take_faults()
            if faults:
                raise LogError("\n".join([str(error), *faults])) from None
            raise

    def attachments(self) -> tuple[Attachment, ...]:
        """See `Source.attachments`."""
        return self._beside[0]

    def metadata(self) -> tuple[tuple[str, Mapping[str, str]], ...]:
        """See `Source.metadata`."""
        return self._beside[1]

    @cached_property
    def _beside(self) -> tuple[tuple[Attachment, ...], tuple[tuple[str, Mapping[str, str]], ...]]:
        """Attachments and metadata, read once, because a log without an index must be scanned for them."""
        reader = open_messages(self.path)
        return reader.attachments(), reader.metadata()


@dataclass(slots=True)
class _Blocks:
    """Builder of blocks from samples and messages, with the faults since the last block."""

    assembler: Assembler
    reader: MessageReader
    copied: _CopiedMessages
    start_ns: int
    end_ns: int | None
    faults: FaultList = field(default_factory=FaultList)
    remarks: list[str] = field(default_factory=list)
    any_sample: bool = False
    first_fault: str | None = None

    def of(self, trace: Trace, messages: MessageColumns, *, last: bool = False) -> Iterator[Block]:
        """Yield the next block, unless it would be empty."""
        messages = messages.within(self.start_ns, FOREVER if self.end_ns is None else self.end_ns)
        for fault in trace.faults:
            self.faults.add(fault)
        self.reader.move_faults(self.faults)
        self.assembler.move_faults(self.faults)
        faults = self.faults.take(last=last)
        self.any_sample = self.any_sample or len(trace) > 0
        self.first_fault = self.first_fault or next(iter(faults), None)
        remarks = (*self.remarks, *self.reader.take_remarks(), *self.assembler.take_remarks())
        self.remarks = []
        copied = self.copied.passed_on(messages, trace, last=last)
        self.copied.trees.faults.move_to(self.faults)
        doubts = self.assembler.take_doubts()
        facts = self.assembler.facts if last else ()
        if len(trace) or len(copied) or faults or remarks or doubts or facts:
            yield Block(replace(trace, faults=faults), copied, remarks, doubts, facts)


class _CopiedMessages:
    """Buffer of raw messages until their samples are ready, which returns messages in order of time."""

    def __init__(self, channels: Mapping[int, Channel], trees: _TreeLog) -> None:
        """Create an empty buffer.

        Args:
            channels: channels of the log, by channel number.
            trees: source of additional messages, the ticks of behaviour trees.
        """
        self.topics = frozenset(channel.topic for channel in channels.values())
        self.trees = trees
        self._channel_numbers = list(channels)
        self._channels = MappingProxyType(
            {number: copied_channel(channel) for number, channel in channels.items()}
        )
        self._waiting: list[MessageColumns] = []
        self._waiting_bytes = 0

    def passed_on(self, messages: MessageColumns, trace: Trace, *, last: bool = False) -> Messages:
        """Add messages; return the held messages up to the last new sample, or all messages if `last`.

        Above a size limit, all messages are returned, because log times and header stamps may be far apart.
        """
        messages = messages.of_topics(self.topics | self.trees.topics)
        self._waiting.append(messages)
        self._waiting_bytes += sum(map(len, messages.payloads))
        is_all = last or self._waiting_bytes > _WAITING_BYTES
        if not (is_all or len(trace)):
            return Messages()
        waiting = concatenate_tables(self._waiting)
        times_ns = waiting.log_time_ns
        if not (times_ns[1:] >= times_ns[:-1]).all():
            waiting = select(waiting, np.argsort(times_ns, kind="stable"))
        ready_count = len(waiting) if is_all else waiting.count_before(int(trace.times_ns[-1]) + 1)
        ready_messages, waiting_rest = (
            select(waiting, slice(ready_count)),
            select(waiting, slice(ready_count, None)),
        )
        self._waiting = [waiting_rest] if len(waiting_rest) else []
        self._waiting_bytes = sum(map(len, waiting_rest.payloads))
        # messages are selected by channel, because a topic may also have a channel that a replay writes
        copied_messages = select(
            ready_messages, np.flatnonzero(np.isin(ready_messages.channel, self._channel_numbers))
        )
        ticks = self.trees.ticks(ready_messages)
        raw_messages = copied_messages.raw(self._channels)
        return merge([raw_messages, ticks]) if len(ticks) else raw_messages


class _TreeLog:
    """Converter from logs of Nav2's behaviour trees to ticks, on the clock of the mapping."""

    def __init__(self, reader: MessageReader, topics: Iterable[Topic], clock: Clock) -> None:
        log_topics = [topic for topic in topics if topic.type == NAV2_LOG and topic.unreadable is None]
        self.topics = frozenset(topic.name for topic in log_topics)
        self.faults = FaultList()
        self._channels = reader.channels(self.topics) if log_topics else {}
        self._decoders = {topic.name: reader.decoder(topic) for topic in log_topics}
        self._trees = {topic: Nav2Tree() for topic in sorted(self.topics)}
        self._nodes: dict[str, tuple[TreeNode, ...]] = {}
        self._clock = clock
        self._tick_count = 0

    def ticks(self, messages: MessageColumns) -> Messages:
        """Return one tick per message of a tree's log."""
        tick_rows = []
        log_messages = select(messages, np.flatnonzero(np.isin(messages.channel, list(self._channels))))
        for message in replace(log_messages, channels=self._channels).messages():
            try:
                log: Any = self._decoders[message.topic](message.payload)
            except LogError as error:
                self.faults.add(f"{message.topic}: {error}")
                continue
            header_ns = log.timestamp.sec * 10**9 + log.timestamp.nanosec
            time_by_clock = {
                "log": message.log_time_ns,
                "publish": message.publish_time_ns,
                "header": header_ns,
            }
            self._nodes[message.topic] = self._trees[message.topic].add(log)
            payload = self._tick().payload(time_by_clock[self._clock])
            tick_rows.append(Row(0, self._tick_count, message.log_time_ns, message.publish_time_ns, payload))
            self._tick_count += 1
        return Messages.from_rows({0: TREE_CHANNEL}, tick_rows)

    def _tick(self) -> TreeTick:
        """Return the newest nodes. If there are several trees, each tree gets a root named like its topic."""
        if len(self.topics) == 1:
            return TreeTick(None, *self._nodes.values())
        nodes: list[TreeNode] = []
        for topic in sorted(self._nodes):
            root_index = len(nodes)
            nodes.append(TreeNode(topic, "Tree", None, "RUNNING"))
            nodes += [node._replace(parent=root_index) for node in self._nodes[topic]]
        return TreeTick(None, tuple(nodes))


def _first_ns(
    open_reader: Callable[[], MessageReader], topics: Iterable[str | None], log_ns: int | None = None
) -> int | None:
    """Return the log time of the first message on the topics, at or after `log_ns`; None if none follows."""
    topic_names = [topic for topic in topics if topic is not None]
    messages = open_reader().iter_messages(topic_names, log_ns) if topic_names else ()
    return next((message.log_time_ns for message in messages), None)


def _foreign_channels(reader: MessageReader, topics: Collection[str]) -> Mapping[int, Channel]:
    """Return the channels of some topics, except channels that a replay writes from the samples."""
    channels = reader.channels(topics)
    own_channels = [number for number, channel in channels.items() if has_our_type(channel)]
    # only logs that a replay wrote have such channels; elsewhere, channels with our types are foreign
    if own_channels and METADATA in dict(reader.metadata()):
        return {number: channel for number, channel in channels.items() if number not in own_channels}
    return channels


def _unread(name: str, topics: Sequence[Topic], plan: ReadingPlan) -> list[str]:
    """Return remarks on unmapped topics that cannot be decoded, with their message counts."""
    sent_topics = [topic for topic in topics if topic.count != 0 and topic.name not in plan.topics]
    unread_topics = [topic for topic in sent_topics if topic.unreadable]
    remarks = []
    for topic in unread_topics[:_MOST_UNREAD]:
        count_text = "an unknown number" if topic.count is None else f"{topic.count}"
        remarks.append(f"{name}: {topic.unreadable}; it is not mapped: messages not read: {count_text}")
    if len(unread_topics) > _MOST_UNREAD:
        more_count = len(unread_topics) - _MOST_UNREAD
        remarks.append(f"{name}: of the topics that are not mapped, {more_count} more cannot be decoded")
    return remarks


def _columns(
    reader: MessageReader,
    plan: ReadingPlan,
    topics: Collection[str],
    start_ns: int | None,
    end_ns: int | None,
    *,
    as_recorded: bool,
) -> Columns:
    """Iterate over messages of some topics in a window, and over other messages that affect the window."""
    if not plan.by_log_time or (not start_ns and end_ns is None):
        return reader.iter_columns(topics, as_recorded=as_recorded)
    last_ns = None if end_ns is None else end_ns + plan.margin_ns
    first_ns = plan.first_read_ns(start_ns or 0)
    lasting_topics = [topic for topic in plan.topics if plan.lookback_ns(topic) is None]
    window_columns = reader.iter_columns(topics, first_ns or None, last_ns, as_recorded=as_recorded)
    if not lasting_topics or not first_ns:
        return window_columns
    return chain(reader.iter_columns(lasting_topics, None, first_ns, as_recorded=as_recorded), window_columns)
