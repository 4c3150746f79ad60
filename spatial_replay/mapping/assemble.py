"""Messages to samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.bags.columns import Message, MessageColumns
from spatial_replay.bags.topic import Decoder
from spatial_replay.errors import LogError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.read_options import FaultList, OnTimeJump
from spatial_replay.mapping.names import Codes
from spatial_replay.mapping.reading_plan import DISORDER_NS, ReadingPlan
from spatial_replay.mapping.topic_reader import MISFITS, TopicReader
from spatial_replay.mapping.tracker import Instants, Remarks, Tracker
from spatial_replay.mapping.transforms import HISTORY_NS, FrameTree
from spatial_replay.trace.sample import FOREVER, LATEST_NS
from spatial_replay.trace.trace import Trace

_FIRST_STEP: Final = 256
_LONGEST_STEP: Final = 8_192
"""After how many messages samples come out: soon at first, for those who want to see the first one only."""

_STEP_BYTES: Final = 2**23
"""After how many bytes of messages they come out in any case."""


class Assembler:
    """Makes samples of the messages of one log, as they come.

    Feed it many messages at once (thousands): it works on columns. The same messages make the same samples
    however they are handed over.

    Args:
        name: of the log, for what is told.
        decoder: how the messages of a topic are decoded.
        start_ns, end_ns: only samples from `start_ns` up to, not including, `end_ns` come out; messages
            before and after may be fed, and count for them.
        on_time_jump: whether a log whose time jumps back by more than a second is refused, or ends there.
    """

    def __init__(
        self,
        plan: ReadingPlan,
        decoder: Callable[[str], Decoder],
        *,
        name: str,
        start_ns: int | None = None,
        end_ns: int | None = None,
        on_time_jump: OnTimeJump = "error",
        concave: Concave = "decompose",
    ) -> None:
        self._plan = plan
        self._name = name
        self._start_ns, self._end_ns = start_ns or 0, FOREVER if end_ns is None else end_ns
        self._on_time_jump = on_time_jump
        self._faults = FaultList()
        for topic, reason in plan.lost:
            # what is unreadable names its topic itself
            what = reason.removeprefix(f"topic {topic!r}: ")
            self._faults.add(f"{name}: {topic}: its transforms cannot be decoded: {what}")
        self._remarks = Remarks(name, plan.mapping)
        self._tree = FrameTree()
        names, classes = Codes(), Codes()
        self._channels = {
            topic.name: TopicReader(
                topic,
                decoder,
                names,
                classes,
                mapping_name=plan.mapping.name,
                needs_frame=plan.mapping.fixed_frame is not None,
                fault=self._add_fault,
            )
            for topic in plan.planned
        }
        self._codes = _Others({name: number for number, name in enumerate(self._channels)})
        self._scene = Tracker(
            plan, self._channels, names, classes, self._tree, self._remarks, self._add_fault, concave
        )
        self._instants = Instants(plan, name, self._start_ns)
        self._newest_ns = -1
        self._latest_ns = self._settled_ns = -1
        self._count = self._bytes = 0
        self._step = _FIRST_STEP
        self._has_split = False

    @property
    def is_finished(self) -> bool:
        """Whether no further message can change anything: after a jump that splits, or past the end."""
        return self._has_split or self._settled_ns >= self._end_ns - 1

    def add(self, messages: Sequence[Message] | MessageColumns) -> Trace:
        """Take messages in the order of the log; the samples that are final now, maybe none.

        Raises:
            LogError: time jumps back by more than a second, and `on_time_jump` is "error".
            UsageError: the mapping does not fit what the messages hold.
        """
        columns = messages if isinstance(messages, MessageColumns) else _columns(messages)
        traces: list[Trace] = []
        ends = np.cumsum(np.fromiter(map(len, columns.payloads), np.int64, len(columns)))
        begin = 0
        while begin < len(columns) and not self.is_finished:
            read = int(ends[begin - 1]) if begin else 0
            by_size = int(np.searchsorted(ends, read + _STEP_BYTES - self._bytes)) + 1
            stop = min(begin + self._step - self._count, by_size, len(columns))
            self._accept(columns.slice(begin, stop))
            self._count += stop - begin
            self._bytes += int(ends[stop - 1]) - read
            begin = stop
            if self._count == self._step or self._bytes >= _STEP_BYTES:
                self._count = self._bytes = 0
                self._step = min(2 * self._step, _LONGEST_STEP)
                traces.append(self._settle(self._newest_ns - self._plan.margin_ns))
        return traces[0] if len(traces) == 1 else Trace.concatenate(traces)

    def finish(self) -> Trace:
        """The samples that are left when the log has ended.

        Raises:
            UsageError: the mapping fits no message of a topic.
        """
        trace = self._settle(max(self._newest_ns, self._latest_ns))
        for channel in self._channels.values():
            channel.finish()
        self._settled_ns = LATEST_NS
        return trace

    def take_faults(self) -> tuple[str, ...]:
        """What was lost since the last call, each with its place."""
        return self._faults.take(last=self._settled_ns == LATEST_NS)

    def move_faults(self, other: FaultList) -> None:
        """Hand over what `take_faults` would give, with the count of what is no longer told one by one."""
        self._faults.move_to(other)

    def take_remarks(self) -> tuple[str, ...]:
        """What is not as one would wish, without a loss: counts of stale objects, missing transforms.

        They are complete when `finish` has been called, and come then.
        """
        return self._remarks.take() if self._settled_ns == LATEST_NS else ()

    def _accept(self, arrived: MessageColumns) -> None:
        """Put transforms into the tree, and the other messages where they wait."""
        code = np.fromiter(map(self._codes.__getitem__, arrived.topics), np.int64, len(arrived))
        taken: list[_Timed] = []
        for number, channel in enumerate(self._channels.values()):
            places = np.flatnonzero(code == number)
            if len(places):
                taken.append(self._timed(channel, places, arrived))
        end = self._jump(taken, arrived)
        for timed in taken:
            self._put(timed.before(end), arrived)

    def _timed(self, channel: TopicReader, places: Integers, arrived: MessageColumns) -> _Timed:
        """The messages of one topic with their times on its clock; decoded, where that is needed."""
        contents: list[Any] = [arrived.payloads[place] for place in places.tolist()]
        clock = channel.planned.clock
        if channel.keeps_decoded:
            contents, kept = channel.decoded(contents, arrived.log_time_ns[places].tolist())
            places = places[kept]
        if clock == "header":
            times, kept = channel.stamps(arrived.log_time_ns[places].tolist(), contents)
            return _Timed(channel, places[kept], np.array(times, np.int64), [contents[i] for i in kept])
        times_ns = arrived.log_time_ns if clock == "log" else arrived.publish_time_ns
        return _Timed(channel, places, times_ns[places], contents)

    def _jump(self, taken: list[_Timed], arrived: MessageColumns) -> int:
        """Take note of how far the log has come; where it ends: at a jump back that splits, or not at all.

        Raises:
            LogError: there is a jump back, and it does not split.
        """
        moving = [timed for timed in taken if timed.channel.is_moving]
        if not moving:
            return len(arrived)
        places = np.concatenate([timed.places for timed in moving])
        times_ns = np.concatenate([timed.times_ns for timed in moving])
        order = np.argsort(places, kind="stable")
        places, times_ns = places[order], times_ns[order]
        newest = np.maximum.accumulate(np.concatenate([[self._newest_ns], times_ns]))
        late = np.flatnonzero(times_ns < newest[:-1] - DISORDER_NS)
        if not len(late):
            self._newest_ns = int(newest[-1])
            return len(arrived)
        at = int(late[0])
        self._newest_ns = int(newest[at])
        place = int(places[at])
        where = (
            f"time jumps back by {(int(newest[at]) - int(times_ns[at])) / 1e9:.3f} s, from {newest[at]} ns to"
            f" {times_ns[at]} ns, at a message of {arrived.topics[place]} logged at"
            f" {arrived.log_time_ns[place]} ns"
        )
        if self._on_time_jump == "error":
            raise LogError(
                f"{self._name}: {where}; on_time_jump='split' (--on-time-jump split) ends the log there, and"
                " another clock in the mapping may not jump"
            )
        self._has_split = True
        self._remarks.add(f"{where}: the log is taken to end there; cut it to evaluate what comes after")
        return place

    def _put(self, timed: _Timed, arrived: MessageColumns) -> None:
        channel, planned = timed.channel, timed.channel.planned
        log_times_ns = arrived.log_time_ns[timed.places]
        if channel.transforms is not None:
            for time_ns, log_ns, content in zip(
                timed.times_ns.tolist(), log_times_ns.tolist(), timed.contents, strict=True
            ):
                try:
                    channel.transforms.add(self._tree, content, time_ns, is_static=planned.is_static)
                except MISFITS as error:
                    self._add_fault(channel.name, log_ns, f"its transforms cannot be read: {error}")
        if planned.mapping is not None or channel.name == self._plan.sampled_topic:
            # what is stamped before what is settled came too late for that, and counts from now on
            times_ns = np.maximum(timed.times_ns, self._settled_ns + 1)
            self._latest_ns = max(self._latest_ns, int(times_ns.max(initial=-1)))
            channel.pending.add(times_ns, arrived.sequence[timed.places], log_times_ns, timed.contents)

    def _settle(self, upto_ns: int) -> Trace:
        """The samples up to a time, all of whose messages are there."""
        if upto_ns <= self._settled_ns:
            return Trace.from_samples(())
        with np.errstate(all="ignore"):
            trace = self._scene.settle(upto_ns, self._instants, self._start_ns, self._end_ns)
        self._settled_ns = upto_ns
        self._tree.forget_before(upto_ns - HISTORY_NS)
        return trace

    def _add_fault(self, topic: str, log_time_ns: int, what: str) -> None:
        self._faults.add(f"{self._name}: {topic} at {log_time_ns} ns: {what}")


def _columns(messages: Sequence[Message]) -> MessageColumns:
    if not messages:
        return MessageColumns()
    topics, log_times_ns, publish_times_ns, sequences, payloads = zip(*messages, strict=True)
    log, publish, sequence = (
        np.array(each, np.int64) for each in (log_times_ns, publish_times_ns, sequences)
    )
    return MessageColumns(topics, log, publish, sequence, payloads, np.arange(len(messages)))


class _Timed(NamedTuple):
    """Messages of one topic: where they stand among all that came, their times, what they hold."""

    channel: TopicReader
    places: Integers
    times_ns: Integers
    contents: list[Any]

    def before(self, place: int) -> _Timed:
        """Those that stand before a place."""
        count = int(np.searchsorted(self.places, place))
        return _Timed(self.channel, self.places[:count], self.times_ns[:count], self.contents[:count])


class _Others(dict[str, int]):
    """Numbers of topics; those of any other topic are left out."""

    def __missing__(self, topic: str) -> int:
        return -1
