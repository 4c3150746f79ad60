"""Assemble samples while their messages come: each as soon as nothing is missing that it waits for.

A log is read until no earlier message can follow, up to eleven seconds. A running system cannot wait for so
long, so a sample waits for three things only, and only so long:

    other topics        that they have come as far; where all count by the time of arrival, a message that
                        comes later shows that, or a moment of silence
    other clocks        with stamps inside messages, up to `max_delay`, since topics may lag behind others
    transforms          of its observations, up to `max_delay`

A later message counts as missing, as in a log: its value is unknown, or the one before.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.bags.columns import Message
from spatial_replay.bags.decoders import Decoder, Topic
from spatial_replay.geometry.arrays import Integers
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.read_options import FaultKinds
from spatial_replay.mapping.assemble import Assembler
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.topic_reader import MISFITS, ReadingPlan, TopicReader
from spatial_replay.text import Sentence
from spatial_replay.trace.trace import Trace

_MOMENT_S: Final = 0.001
"""How long messages of the same time may come one after the other."""

_MOST_HELD: Final = 4_096
"""Observations that may wait for transforms at once; beyond that, none does."""


_TRIAL = """
fixed_frame: map
topics:
  /boxes:
    {objects: "of[*]", name: "box{id}", position: [x, y], yaw: yaw, shape: {box: [1, 1, 1]}, uncertainty: 0.1}
  /discs: {name: disc, position: [x, y], shape: {disc: 1}}
  /rings: {name: ring, polygon: corners, max_age: 10ms}
  /charge: {signals: {charge: value}}
sample: {topic: /boxes}
"""


def rehearse() -> None:
    """Assemble a few samples of messages made up, so that no real one waits for code to be compiled."""
    ring = [[0, 0], [2, 0], [2, 2], [1, 1]]
    contents: dict[str, Any] = {
        "/boxes": {
            "frame_id": "map",
            "of": [{"id": each, "x": each, "y": 0, "yaw": each} for each in (1, 2)],
        },
        "/discs": {"x": 0, "y": 0},
        "/rings": {"corners": [{"x": x, "y": y} for x, y in ring]},
        "/charge": {"value": 1},
    }
    topics = [Topic(topic, "trial", "json") for topic in contents]
    plan = ReadingPlan.of(parse_mapping(_TRIAL), topics)
    assembler = LiveAssembler(plan, lambda topic: lambda _: contents[topic], name="", max_delay_s=1.0)
    for tick in range(4):
        for topic in contents:
            assembler.add([Message(topic, tick * 10**9, tick * 10**9, 0, b"")], tick)
    assembler.lose(tuple(contents), 5.0)
    assembler.finish()


class _Held(NamedTuple):
    """An observation that waits for the transforms of its frame.

    Attributes:
        time_ns: of its message, on the clock of the samples.
        at_ns: the time of the transforms: its stamp, or the time of its message.
        until_s: when it has waited for long enough.
    """

    topic: str
    frame: str
    time_ns: int
    at_ns: int
    by_stamp: bool
    until_s: float


class LiveAssembler:
    """Assembles the samples of a running system; callers pass the time of their clock, `now_s`, in seconds.

    Attributes:
        overdue: observations whose transforms did not come in time, so that they are unknown.
        overdue_frame: the topic and the frame of the last of them.
    """

    def __init__(
        self,
        plan: ReadingPlan,
        decoder: Callable[[str], Decoder],
        *,
        name: str,
        max_delay_s: float,
        concave: Concave = "decompose",
    ) -> None:
        self._plan = plan
        self._max_delay_s = max_delay_s
        self._patience_s = _MOMENT_S if plan.by_log_time else max_delay_s
        moving = [each.name for each in plan.planned if each.is_transforms and not each.is_static]
        self._assembler = Assembler(
            plan,
            decoder,
            name=name,
            on_time_jump="split",
            concave=concave,
            arrived=self._note_arrived,
            faults=FaultKinds(),
        )
        self._moving = frozenset(moving)
        # what is sent once and stays is not waited for
        self._in_step = [
            each.name
            for each in plan.planned
            if not (each.is_lasting or each.is_latched)
            and (each.mapping is not None or each.name == plan.sampled_topic)
        ]
        self._follows_frames = bool(moving) and any(
            each.is_static and each.mapping is not None for each in plan.planned
        )
        self._latest_ns = dict.fromkeys((each.name for each in plan.planned), -1)
        self._silent: deque[tuple[float, int]] = deque()
        self._patient_ns = -1
        self._held: list[_Held] = []
        self._are_transforms_new = False
        self._lost: set[str] = set()
        self._now_s = 0.0
        self.overdue = 0
        self.overdue_frame: tuple[str, str] | None = None

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics that samples depend on, but those that are sent once and stay."""
        return tuple(each.name for each in self._plan.planned if not (each.is_lasting or each.is_latched))

    @property
    def is_finished(self) -> bool:
        """Whether time has jumped back, so that no further message counts."""
        return self._assembler.is_finished

    @property
    def jump(self) -> Sentence | None:
        """Where time has jumped back."""
        return self._assembler.jump

    def add(self, messages: Sequence[Message], now_s: float) -> Trace:
        """Add messages as they came; return the samples that are final now.

        Raises:
            LogError: time jumps so far ahead that steps between samples cannot be counted.
            UsageError: the mapping does not fit what the messages hold.
        """
        self._now_s = now_s
        self._lost.difference_update(message.topic for message in messages)
        self._assembler.take_in(messages)
        newest_ns = self._assembler.newest_ns
        if messages and (not self._silent or self._silent[-1][1] < newest_ns):
            self._silent.append((now_s + self._patience_s, newest_ns))
        return self._assembler.settle(self._upto_ns(now_s))

    def due_s(self) -> float | None:
        """Return when to `add` again, even without messages; None if nothing waits."""
        times = [each.until_s for each in self._held]
        is_settled = self._assembler.settled_ns >= self._assembler.newest_ns
        if self._silent and self._silent[-1][1] > self._patient_ns and not is_settled:
            times.append(self._silent[0][0])
        return min(times, default=None)

    def lose(self, topics: Collection[str], now_s: float) -> Trace:
        """Return the samples so far, and one in which what some topics reported is unknown.

        Nothing of what they reported holds on: not while a connection is lost, nor after silence.
        """
        gone = set(topics) & set(self._latest_ns) - self._lost
        if not gone:
            return Trace.empty()
        self._now_s = now_s
        self._lost |= gone
        self._held = [each for each in self._held if each.topic not in gone]
        self._patient_ns = self._assembler.newest_ns
        self._silent.clear()
        return self._assembler.lose(gone)

    def finish(self) -> Trace:
        """End the run; return the remaining samples.

        Raises:
            UsageError: the mapping fits no message of a topic.
        """
        return self._assembler.finish()

    def take_remarks(self) -> tuple[str, ...]:
        """Return counts of stale objects and missing transforms, after `finish`."""
        return self._assembler.take_remarks()

    def take_faults(self, *, last: bool = False) -> tuple[str, ...]:
        """Return what was lost since the last call, the first of each kind; at last, how many more."""
        return self._assembler.take_faults(last=last)

    def _note_arrived(self, reader: TopicReader, times_ns: Integers, contents: Sequence[Any]) -> None:
        name = reader.name
        self._latest_ns[name] = max(self._latest_ns[name], int(times_ns.max()))
        if name in self._moving:
            self._are_transforms_new = True
        if not self._moving or len(self._held) >= _MOST_HELD:
            return
        until_s = self._now_s + self._max_delay_s
        if self._follows_frames and name == self._plan.sampled_topic:
            self._held += [_Held(name, "", int(each), int(each), False, until_s) for each in times_ns]
        if reader.extractor is None or reader.planned.is_static:
            return
        for time_ns, message in zip(times_ns.tolist(), contents, strict=True):
            try:
                chunk = reader.extractor.read([message], np.zeros(1, np.int64))
            except MISFITS:
                # reported when it is read for its objects
                continue
            # a sample waits for the frame that a marker moves with
            self._follows_frames = self._follows_frames or any(chunk.locked)
            stamps = chunk.stamps or [0] * len(chunk.name)
            for frame, stamp_ns in dict.fromkeys(zip(chunk.frames or (), stamps, strict=False)):
                if frame != self._plan.mapping.fixed_frame:
                    at_ns, by_stamp = (stamp_ns, True) if stamp_ns else (time_ns, False)
                    self._held.append(_Held(name, frame, time_ns, at_ns, by_stamp, until_s))
                    self._are_transforms_new = True

    def _upto_ns(self, now_s: float) -> int:
        """Return the time up to which nothing is waited for any more."""
        newest_ns = self._assembler.newest_ns
        # several programs send transforms, often at the same time; another topic has one message at a time
        reached = (self._latest_ns[topic] - (topic in self._moving) for topic in self._in_step)
        upto_ns = min(reached, default=newest_ns)
        if self._plan.by_log_time:
            upto_ns = max(upto_ns, newest_ns - 1)
        while self._silent and self._silent[0][0] <= now_s:
            self._patient_ns = self._silent.popleft()[1]
        upto_ns = min(max(upto_ns, self._patient_ns), newest_ns)
        self._release(now_s)
        return min([upto_ns, *(each.time_ns - 1 for each in self._held)])

    def _release(self, now_s: float) -> None:
        """Let go of the observations that can be placed, and of those that have waited for long enough."""
        if self._held and self._are_transforms_new:
            self._are_transforms_new = False
            self._held = [
                each for each, known in zip(self._held, self._placeable(), strict=True) if not known
            ]
        late = [each for each in self._held if each.until_s <= now_s]
        if late:
            self._held = [each for each in self._held if each.until_s > now_s]
            self.overdue += len(late)
            self.overdue_frame = late[-1].topic, late[-1].frame

    def _placeable(self) -> list[bool]:
        """Return whether the transforms of each observation that waits have come."""
        fixed, tree = self._plan.mapping.fixed_frame or "", self._assembler.frames
        known = [False] * len(self._held)
        reached_ns = min((self._latest_ns[topic] for topic in self._moving), default=-1)
        kinds: dict[tuple[str, bool], list[int]] = {}
        for place, each in enumerate(self._held):
            if each.frame:
                kinds.setdefault((each.frame, each.by_stamp), []).append(place)
            else:
                known[place] = reached_ns >= each.at_ns
        for (frame, by_stamp), places in kinds.items():
            at_ns = np.array([self._held[place].at_ns for place in places], np.int64)
            found = tree.between(fixed, frame, at_ns, by_stamp=by_stamp).known
            for place, is_known in zip(places, found.tolist(), strict=True):
                known[place] = is_known
        return known
