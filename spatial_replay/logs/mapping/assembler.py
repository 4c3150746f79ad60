"""Messages to samples."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.errors import LogError
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.faults import FaultList
from spatial_replay.logs.foreign.messages import Decoder, Message
from spatial_replay.logs.mapping.channel import MISFITS, Channel
from spatial_replay.logs.mapping.frames import HISTORY_NS, FrameTree
from spatial_replay.logs.mapping.instants import Instants
from spatial_replay.logs.mapping.naming import Codes
from spatial_replay.logs.mapping.plan import DISORDER_NS, Plan
from spatial_replay.logs.mapping.remarks import Remarks
from spatial_replay.logs.mapping.scene import Scene
from spatial_replay.logs.mapping.transforms import add_transforms
from spatial_replay.logs.options import OnTimeJump
from spatial_replay.trace.times import FOREVER, LATEST_NS
from spatial_replay.trace.trace import Trace

_FIRST_STEP: Final = 256
_LONGEST_STEP: Final = 8_192
"""After how many messages samples come out: soon at first, for those who want to see the first one only."""


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
        plan: Plan,
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
        self._remarks = Remarks(name, plan.mapping)
        self._tree = FrameTree()
        names, classes = Codes(), Codes()
        self._channels = {
            topic.name: Channel(
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
        self._scene = Scene(
            plan, self._channels, names, classes, self._tree, self._remarks, self._add_fault, concave
        )
        self._instants = Instants(plan, name)
        self._newest_ns = -1
        self._settled_ns = -1
        self._newest_place = ""
        self._count = 0
        self._next_step = _FIRST_STEP
        self._step = _FIRST_STEP
        self._has_split = False

    @property
    def is_finished(self) -> bool:
        """Whether no further message can change anything: after a jump that splits, or past the end."""
        return self._has_split or self._settled_ns >= self._end_ns - 1

    def add(self, messages: Sequence[Message]) -> Trace:
        """Take messages in the order of the log; the samples that are final now, maybe none.

        Raises:
            LogError: time jumps back by more than a second, and `on_time_jump` is "error".
            UsageError: the mapping does not fit what the messages hold.
        """
        traces: list[Trace] = []
        begin = 0
        while begin < len(messages) and not self.is_finished:
            part = messages[begin : begin + self._next_step - self._count]
            begin += len(part)
            self._accept(part)
            self._count += len(part)
            if self._count == self._next_step:
                self._step = min(2 * self._step, _LONGEST_STEP)
                self._next_step += self._step
                traces.append(self._settle(self._newest_ns - self._plan.margin_ns))
        return traces[0] if len(traces) == 1 else Trace.concatenate(traces)

    def finish(self) -> Trace:
        """The samples that are left when the log has ended."""
        trace = self._settle(self._newest_ns)
        self._settled_ns = LATEST_NS
        return trace

    def take_faults(self) -> tuple[str, ...]:
        """What was lost since the last call, each with its place."""
        return self._faults.take(last=self._settled_ns == LATEST_NS)

    def take_remarks(self) -> tuple[str, ...]:
        """What is not as one would wish, without a loss: counts of stale objects, missing transforms.

        They are complete when `finish` has been called, and come then.
        """
        return self._remarks.take() if self._settled_ns == LATEST_NS else ()

    def _accept(self, messages: Sequence[Message]) -> None:
        """Decode messages, put transforms into the tree and the others where they wait."""
        if self._plan.by_log_time:
            messages = self._without_jump(messages)
        by_topic = _by_topic(messages)
        if not self._plan.by_log_time:
            self._accept_in_order(messages, by_topic)
            return
        for topic, places in by_topic.items():
            channel = self._channels.get(topic)
            if channel is not None:
                listed = [messages[i] for i in places]
                contents, kept = channel.decoded(listed)
                if len(kept) < len(listed):
                    listed = [listed[i] for i in kept]
                self._put(channel, [message[1] for message in listed], listed, contents)

    def _accept_in_order(self, messages: Sequence[Message], by_topic: dict[str, list[int]]) -> None:
        """Accept messages whose times are only known once they are decoded."""
        timed: list[_Timed] = []
        for topic, places in by_topic.items():
            channel = self._channels.get(topic)
            if channel is not None:
                contents, kept = channel.decoded([messages[i] for i in places])
                places = [places[i] for i in kept]
                times, kept = channel.times([messages[i] for i in places], contents)
                timed.append(_Timed(channel, times, [places[i] for i in kept], [contents[i] for i in kept]))
        moving = sorted(
            entry
            for each in timed
            if self._is_moving(each.channel.name)
            for entry in zip(each.places, each.times_ns, strict=True)
        )
        upto = self._jump([time for _, time in moving], [messages[place] for place, _ in moving])
        last = moving[upto][0] if upto is not None else len(messages)
        for each in timed:
            # places increase
            count = bisect_left(each.places, last)
            taken = [messages[place] for place in each.places[:count]]
            self._put(each.channel, each.times_ns[:count], taken, each.contents[:count])

    def _without_jump(self, messages: Sequence[Message]) -> Sequence[Message]:
        moving = [message for message in messages if self._is_moving(message[0])]
        upto = self._jump([message[1] for message in moving], moving)
        if upto is None:
            return messages
        jumped = moving[upto]
        return messages[: next(i for i, message in enumerate(messages) if message is jumped)]

    def _is_moving(self, topic: str) -> bool:
        """Whether a topic's times tell how far the log has come: not those of transforms and lasting things,
        whose stamps may lie in the past or the future."""
        channel = self._channels.get(topic)
        return channel is not None and not (
            channel.planned.is_lasting or (channel.planned.is_transforms and channel.extractor is None)
        )

    def _jump(self, times_ns: list[int], messages: Sequence[Message]) -> int | None:
        """Take note of times, in the order of the log; the first that is a jump back, where that splits.

        Raises:
            LogError: there is one, and it does not split.
        """
        if not times_ns:
            return None
        times = np.array(times_ns, np.int64)
        newest = np.maximum.accumulate(np.concatenate([[self._newest_ns], times]))
        late = np.flatnonzero(times < newest[:-1] - DISORDER_NS)
        if not len(late):
            self._newest_ns = int(newest[-1])
            return None
        at = int(late[0])
        self._newest_ns = int(newest[at])
        back = (int(newest[at]) - times_ns[at]) / 1e9
        where = (
            f"time jumps back by {back:.3f} s, from {newest[at]} ns to {times_ns[at]} ns, at a message of"
            f" {messages[at].topic} logged at {messages[at].log_time_ns} ns"
        )
        if self._on_time_jump == "error":
            raise LogError(
                f"{self._name}: {where}; on_time_jump='split' (--on-time-jump split) ends the log there, and"
                " another clock in the mapping may not jump"
            )
        self._has_split = True
        self._remarks.add(f"{where}: the log is taken to end there; cut it to evaluate what comes after")
        return at

    def _put(
        self, channel: Channel, times_ns: list[int], messages: Sequence[Message], contents: list[object]
    ) -> None:
        planned = channel.planned
        if planned.is_transforms:
            for time_ns, message, content in zip(times_ns, messages, contents, strict=True):
                try:
                    add_transforms(self._tree, content, time_ns, is_static=planned.is_static)
                except MISFITS as error:
                    self._add_fault(
                        channel.name, message.log_time_ns, f"its transforms cannot be read: {error}"
                    )
        if planned.mapping is None and channel.name != self._plan.sampled_topic:
            return
        log_times = np.array([message[1] for message in messages], np.int64)
        sequences = np.array([message[3] for message in messages], np.int64)
        # what is stamped before what is settled came too late for it, and counts from now on
        times = np.maximum(np.array(times_ns, np.int64), self._settled_ns + 1)
        channel.pending.add(times, sequences, log_times, contents)

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


class _Timed(NamedTuple):
    """Decoded messages of one topic: their times, where they stand among all, what they hold."""

    channel: Channel
    times_ns: list[int]
    places: list[int]
    contents: list[object]


def _by_topic(messages: Sequence[Message]) -> dict[str, list[int]]:
    """Where the messages of each topic stand."""
    found: dict[str, list[int]] = {}
    for place, message in enumerate(messages):
        places = found.get(message[0])
        if places is None:
            places = found[message[0]] = []
        places.append(place)
    return found
