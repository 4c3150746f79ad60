"""Assemble samples: the messages of one log in, traces out.

A message runs through these stages:

    assemble       raw messages of all topics → `PendingMessages` of each topic, transforms in a `FrameTree`
    topic_reader   pending messages of one topic → `TopicColumns`: signals, and objects by bound field paths
    detections     objects → `Detections`: poses and solids in columns
    tracker        detections → observations in the fixed frame, `Events` over time, and a `Trace` of samples

Messages wait in the first stage until none that is earlier can arrive.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import compress, repeat
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.bags.columns import DISORDER_NS, JUMP_REMEDY, Message, MessageColumns
from spatial_replay.bags.decoders import Decoder
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Integers
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.read_options import FaultList, OnTimeJump
from spatial_replay.mapping.binding import BY_PLACE, Codes
from spatial_replay.mapping.topic_reader import MISFITS, ReadingPlan, TopicReader
from spatial_replay.mapping.tracker import Remarks, Tracker
from spatial_replay.mapping.transforms import HISTORY_NS, FrameTree
from spatial_replay.text import Instant, Sentence, counted, nearest_hint, times_apart
from spatial_replay.trace.sample import FOREVER, LATEST_NS
from spatial_replay.trace.trace import Trace

_FIRST_STEP: Final = 256
_LONGEST_STEP: Final = 8_192
"""Messages between two traces: few at first, so that the first sample comes out early."""

_STEP_BYTES: Final = 2**23
"""Bytes of messages between two traces, if that is fewer messages."""

_MOST_STEPS = 100_000
"""Samples between two messages; more are not a pause, but a clock that jumped."""

_MOST_AT_ONCE = 1_000_000
"""Samples between the messages of one step: all are in memory at once."""


class Assembler:
    """Assembles the samples of one log from its messages.

    Add thousands of messages at once, because it works on columns. The samples do not depend on how the
    messages are divided.

    Args:
        name: of the log, for errors and remarks.
        decoder: returns the decoder of a topic.
        start_ns, end_ns: only samples from `start_ns` up to, not including, `end_ns` come out. Messages
            before and after the window may be added, and count.
        on_time_jump: whether a log whose time jumps back by more than the plan's `late_ns` is refused, or
            ends there.
        arrived: takes the messages of each topic as they arrive: its reader, their times on its clock, and
            their contents, decoded where frames matter.
        faults: takes what is lost, in place of a new list.
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
        arrived: Callable[[TopicReader, Integers, Sequence[Any]], None] | None = None,
        faults: FaultList | None = None,
    ) -> None:
        self._plan = plan
        self._arrived = arrived
        self._name = name
        self._window_ns = start_ns or 0, FOREVER if end_ns is None else end_ns
        self._on_time_jump = on_time_jump
        self._faults = FaultList() if faults is None else faults
        for topic, reason in plan.lost:
            # some reasons start with the topic already
            what = reason.removeprefix(f"topic {topic!r}: ")
            self._faults.add(f"{name}: {topic}: its transforms cannot be decoded: {what}")
        self._remarks = Remarks(name, plan.mapping)
        self._tree = FrameTree()
        self._knows_static = False
        names, classes = Codes(), Codes()
        self._readers = {
            topic.name: TopicReader(
                topic,
                decoder,
                names,
                classes,
                mapping_name=plan.mapping.name,
                needs_frame=plan.mapping.fixed_frame is not None,
                decodes_early=arrived is not None,
                report=self._add_fault,
            )
            for topic in plan.planned
        }
        self._number_of_topic = {topic: number for number, topic in enumerate(self._readers)}
        self._tracker = Tracker(
            plan,
            self._readers,
            names,
            classes,
            self._tree,
            self._remarks,
            window_ns=self._window_ns,
            concave=concave,
            report=self._add_fault,
        )
        self._sample_times = _SampleTimes(plan, name, self._window_ns[0])
        self._begin_ns: int | None = None
        self._newest_ns = -1
        self._latest_ns = self._settled_ns = self._forgot_ns = -1
        self._count = self._bytes = self._recorded = 0
        self._step = _FIRST_STEP
        self.jump: Sentence | None = None
        """Where time jumped back so far that the log is taken to end there."""

    @property
    def is_finished(self) -> bool:
        """Whether no further message counts: after a jump that splits the log, or past the window."""
        return self.jump is not None or self._settled_ns >= self._window_ns[1] - 1

    def add(self, messages: Sequence[Message] | MessageColumns) -> Trace:
        """Add messages in the order of the log; return the samples that are final now.

        Raises:
            LogError: time jumps back too far, and `on_time_jump` is "error".
            UsageError: the mapping does not fit what the messages hold.
        """
        columns = messages if isinstance(messages, MessageColumns) else self._columns(messages)
        traces: list[Trace] = []
        ends = np.cumsum(np.fromiter(map(len, columns.payloads), np.int64, len(columns)))
        begin = 0
        while begin < len(columns) and not self.is_finished:
            read = int(ends[begin - 1]) if begin else 0
            by_size = int(np.searchsorted(ends, read + _STEP_BYTES - self._bytes)) + 1
            stop = min(begin + self._step - self._count, by_size, len(columns))
            self._add_step(columns.slice(begin, stop))
            self._count += stop - begin
            self._bytes += int(ends[stop - 1]) - read
            begin = stop
            if self._count == self._step or self._bytes >= _STEP_BYTES:
                self._count = self._bytes = 0
                self._step = min(2 * self._step, _LONGEST_STEP)
                traces.append(self._settle(self._newest_ns - self._plan.margin_ns))
        return traces[0] if len(traces) == 1 else Trace.concatenate(traces)

    def know_static(self, messages: Iterable[Message]) -> None:
        """Take the static transforms of the whole log, before any message is added."""
        self._knows_static = True
        for topic, log_ns, publish_ns, _, payload in messages:
            reader = self._readers[topic]
            good = np.ones(1, np.bool_)
            contents = reader.decode([payload], [log_ns], good)
            if good[0]:
                times_ns = {"log": log_ns, "publish": publish_ns, "header": None}
                self._add_transforms(reader, times_ns[reader.planned.clock], log_ns, contents[0])

    def _add_transforms(self, reader: TopicReader, clock_ns: int | None, log_ns: int, message: Any) -> None:
        if reader.transforms is None:
            return
        try:
            is_static = reader.planned.is_static
            reader.transforms.add(self._tree, message, clock_ns, log_ns=log_ns, is_static=is_static)
        except MISFITS as error:
            self._add_fault(reader.name, log_ns, f"its transforms cannot be read: {error}")

    def take_in(self, messages: Sequence[Message]) -> None:
        """Add messages in the order in which they came, without looking for samples; see `settle`.

        Raises:
            UsageError: the mapping does not fit what the messages hold.
        """
        if messages and not self.is_finished:
            self._add_step(self._columns(messages))

    @property
    def newest_ns(self) -> int:
        """How far the messages have come, on the clocks of their topics; -1 before the first."""
        return self._newest_ns

    @property
    def settled_ns(self) -> int:
        """Up to when samples are final; -1 before the first."""
        return self._settled_ns

    @property
    def frames(self) -> FrameTree:
        """The transforms so far."""
        return self._tree

    def settle(self, upto_ns: int) -> Trace:
        """Return the samples up to a time; messages before it that come later count from then on.

        Raises:
            LogError, UsageError: as `add`.
        """
        return self._settle(upto_ns)

    def lose(self, topics: Collection[str]) -> Trace:
        """Return the samples so far and one right after them, in which what some topics reported is unknown.

        It stays unknown until they report it again.
        """
        so_far = self._settle(self._newest_ns)
        lost_ns = self._settled_ns + 1
        if not self._sample_times.note(lost_ns):
            return so_far
        self._tracker.lose(lost_ns, topics)
        if any(self._readers[topic].transforms is not None for topic in topics):
            self._tree.forget_moving()
        self._settled_ns = lost_ns
        lost = self._tracker.trace(np.array([lost_ns], np.int64), lost_ns)
        self._tracker.forget(lost_ns)
        return Trace.concatenate([so_far, lost])

    def finish(self) -> Trace:
        """End the log; return the remaining samples.

        Raises:
            UsageError: the mapping fits no message of a topic, or the log has no such fixed frame.
        """
        trace = self._settle(max(self._newest_ns, self._latest_ns))
        if self._arrived is None:
            self._remarks.add_pauses()
        for text in self._tree.remarks():
            self._remarks.add(text)
        # of a system that runs, there is no log to cut
        if self.jump is not None and self._arrived is None:
            what_follows = ": the log is taken to end there; cut it to evaluate what comes after"
            self._remarks.add(Sentence(self.jump, what_follows))
        for reader in self._readers.values():
            reader.finish()
            if reader.extractor is not None and reader.extractor.is_by_place:
                self._remarks.add(f"{reader.name}: {BY_PLACE}")
            if reader.extractor is not None and reader.extractor.cornerless:
                outlines = counted(reader.extractor.cornerless, "outline")
                what = "other than two corners" if reader.extractor.is_bounds else "fewer than three corners"
                hint = "" if reader.extractor.is_bounds else "; `bounds` reads two opposite corners of a box"
                self._remarks.add(f"{reader.name}: {outlines} with {what}: objects are unknown there{hint}")
            for signal, texts in reader.unnamed.items():
                listed = ", ".join(map(repr, texts))
                what = f"`names` of the signal {signal!r} lacks {listed}; it is unknown there"
                self._remarks.add(f"{reader.name}: {what}")
            if (step := reader.pending.first_step) is not None:
                steps = counted(reader.pending.steps, "time")
                since = Instant(step.from_ns, 0)
                self._remarks.add(
                    Sentence(
                        f"{reader.name}: the clock steps back {steps} though its messages are numbered on,"
                        f" first by {(step.from_ns - step.to_ns) / 1e9:.3f} s at ",
                        since,
                        ": those recorded after a step count right after those before; cut the log there, or"
                        " take another `clock`",
                    )
                )
            if reader.unstamped:
                were = "message was" if reader.unstamped == 1 else "messages were"
                self._remarks.add(
                    f"{reader.name}: {reader.unstamped} {were} left out, without a stamp, or with one of 0,"
                    " for the clock header"
                )
        self._check_fixed_frame()
        self._settled_ns = LATEST_NS
        return trace

    def _check_fixed_frame(self) -> None:
        """Raise UsageError if a whole log has frames, but not the fixed one."""
        mapping = self._plan.mapping
        is_whole = self._arrived is None and self._window_ns == (0, FOREVER) and self.jump is None
        if mapping.fixed_frame is None or not is_whole or self._plan.lost:
            return
        extractors = (reader.extractor for reader in self._readers.values())
        noted = (each.noted_frames for each in extractors if each is not None)
        frames = sorted(self._tree.names.union(*noted) - {""})
        if frames and mapping.fixed_frame not in frames:
            hint = nearest_hint(mapping.fixed_frame, frames)
            listed = ", ".join(frames[:20]) + (f" and {len(frames) - 20} more" if len(frames) > 20 else "")
            raise UsageError(
                f"{mapping.name}: fixed_frame: the log has no frame {mapping.fixed_frame!r};"
                f" {f'{hint} ' if hint else ''}its frames are {listed}"
            )

    def take_faults(self, *, last: bool = False) -> tuple[str, ...]:
        """Return what was lost since the last call, each with its place."""
        return self._faults.take(last=last or self._settled_ns == LATEST_NS)

    def move_faults(self, other: FaultList) -> None:
        """Move what `take_faults` would return to another list, with the count of faults beyond its limit."""
        self._faults.move_to(other)

    def take_remarks(self) -> tuple[str, ...]:
        """Return counts of stale objects and missing transforms; none before `finish`, when they are
        complete."""
        return self._remarks.take() if self._settled_ns == LATEST_NS else ()

    def _add_step(self, arrived: MessageColumns) -> None:
        """Distribute messages: transforms to the frame tree, all others to the readers of their topics."""
        numbers = map(self._number_of_topic.get, arrived.topics, repeat(-1))
        number_of_message = np.fromiter(numbers, np.int64, len(arrived))
        stamped: list[_Stamped] = []
        come = set(arrived.topics)
        for number, reader in enumerate(self._readers.values()):
            if reader.name not in come or (
                self._knows_static and reader.planned.is_static and not reader.is_mapped
            ):
                continue
            places = np.flatnonzero(number_of_message == number)
            if len(places):
                stamped.append(self._stamp(reader, places, arrived))
        end = self._advance_time(stamped, arrived)
        for each in stamped:
            self._put(each.before(end), arrived)

    def _stamp(self, reader: TopicReader, places: Integers, arrived: MessageColumns) -> _Stamped:
        """Return the messages of one topic with their times on its clock, decoded if the clock needs that."""
        contents: list[Any] = [arrived.payloads[place] for place in places.tolist()]
        clock = reader.planned.clock
        times_ns = (arrived.publish_time_ns if clock == "publish" else arrived.log_time_ns)[places]
        if reader.decodes_on_arrival:
            good = np.ones(len(places), np.bool_)
            log_times_ns = arrived.log_time_ns[places].tolist()
            contents = reader.decode(contents, log_times_ns, good)
            if clock == "header":
                times_ns = reader.stamps(contents, log_times_ns, good)
                if reader.planned.is_static:
                    # many programs send static transforms without a stamp
                    times_ns = np.where(times_ns == 0, arrived.log_time_ns[places], times_ns)
            contents = list(compress(contents, good.tolist()))
            places, times_ns = places[good], times_ns[good]
        return _Stamped(reader, places, times_ns, contents)

    def _advance_time(self, stamped: list[_Stamped], arrived: MessageColumns) -> int:
        """Update how far the log has come; return the number of messages before a jump that splits it.

        Raises:
            LogError: time jumps back, and jumps do not split the log.
        """
        moving = [each for each in stamped if each.reader.advances_time]
        if not moving:
            return len(arrived)
        places, times_ns = moving[0].places, moving[0].times_ns
        if len(moving) > 1:
            places = np.concatenate([each.places for each in moving])
            times_ns = np.concatenate([each.times_ns for each in moving])
            order = np.argsort(places, kind="stable")
            places, times_ns = places[order], times_ns[order]
        if not len(times_ns):
            return len(arrived)
        if self._begin_ns is None:
            self._begin_ns = int(times_ns[0])
        newest_ns = max(self._newest_ns, int(times_ns.max()))
        if int(times_ns.min()) >= newest_ns - self._plan.late_ns:
            self._newest_ns = newest_ns
            return len(arrived)
        newest = np.maximum.accumulate(np.concatenate([[self._newest_ns], times_ns]))
        late = np.flatnonzero(times_ns < newest[:-1] - self._plan.late_ns)
        if not len(late):
            self._newest_ns = int(newest[-1])
            return len(arrived)
        at = int(late[0])
        self._newest_ns = int(newest[at])
        place = int(places[at])
        where = Sentence(
            f"time jumps back by {(int(newest[at]) - int(times_ns[at])) / 1e9:.3f} s, from ",
            Instant(int(newest[at]), self._begin_ns or 0),
            " to ",
            Instant(int(times_ns[at]), self._begin_ns or 0),
            f", at a message of {arrived.topics[place]}",
        )
        if self._on_time_jump == "error":
            raise LogError(f"{self._name}: {where}; {JUMP_REMEDY}, and another clock may not jump")
        self.jump = where
        return place

    def _put(self, stamped: _Stamped, arrived: MessageColumns) -> None:
        reader = stamped.reader
        if self._arrived is not None and len(stamped.times_ns):
            self._arrived(reader, stamped.times_ns, stamped.contents)
        log_times_ns = arrived.log_time_ns[stamped.places]
        if reader.transforms is not None and not (self._knows_static and reader.planned.is_static):
            for time_ns, log_ns, message in zip(
                stamped.times_ns.tolist(), log_times_ns.tolist(), stamped.contents, strict=True
            ):
                self._add_transforms(reader, time_ns, log_ns, message)
        if reader.is_mapped or reader.name == self._plan.sampled_topic:
            # samples up to here are out already: a late message counts from now on
            times_ns = np.maximum(stamped.times_ns, self._settled_ns + 1)
            self._latest_ns = max(self._latest_ns, int(times_ns.max(initial=-1)))
            sequences, recorded = arrived.sequence[stamped.places], arrived.place[stamped.places]
            reader.pending.add(times_ns, sequences, log_times_ns, recorded, stamped.contents)

    def _settle(self, upto_ns: int) -> Trace:
        """Return the samples up to a time before which no further message is expected."""
        if upto_ns <= self._settled_ns:
            return Trace.empty()
        start_ns, end_ns = self._window_ns
        # logs contain NaN and infinity; they make objects unknown, without warnings
        with np.errstate(all="ignore"):
            times_ns = self._sample_times.upto(self._tracker.advance(upto_ns), upto_ns)
            times_ns = times_ns[(times_ns >= start_ns) & (times_ns < end_ns)]
            self._remarks.note_samples(times_ns)
            trace = self._tracker.trace(times_ns, max(self._newest_ns, self._latest_ns))
            self._tracker.forget(upto_ns)
        self._settled_ns = upto_ns
        # looking through all transforms takes longer than a sample
        if upto_ns - self._forgot_ns > DISORDER_NS:
            self._tree.forget_before(upto_ns - HISTORY_NS)
            self._forgot_ns = upto_ns
        return trace

    def _columns(self, messages: Sequence[Message]) -> MessageColumns:
        if not messages:
            return MessageColumns()
        topics, *numbers, payloads = zip(*messages, strict=True)
        log_ns, publish_ns, sequence = (np.array(each, np.int64) for each in numbers)
        place = self._recorded + np.arange(len(messages))
        self._recorded += len(messages)
        channel = np.zeros(len(messages), np.int64)
        return MessageColumns(topics, log_ns, publish_ns, sequence, payloads, place, channel)

    def _add_fault(self, topic: str, log_time_ns: int, what: str) -> None:
        self._faults.add(Sentence(f"{self._name}: {topic} at ", Instant(log_time_ns, 0), f": {what}"))


class _Stamped(NamedTuple):
    """Messages of one topic: their places among all that arrived, their times and contents."""

    reader: TopicReader
    places: Integers
    times_ns: Integers
    contents: list[Any]

    def before(self, place: int) -> _Stamped:
        """Return the messages before a place."""
        count = int(np.searchsorted(self.places, place))
        return _Stamped(self.reader, self.places[:count], self.times_ns[:count], self.contents[:count])


class _SampleTimes:
    """Decides when samples are taken: at messages, or at multiples of a step.

    Args:
        start_ns: the start of the window; multiples of a step are counted from there.
    """

    def __init__(self, plan: ReadingPlan, name: str, start_ns: int) -> None:
        self._name = name
        self._mapping_name = plan.mapping.name
        self._step_ns = plan.mapping.sampling.step_ns
        self._start_ns = start_ns
        self._from_ns: int | None = None
        self._last_ns = -1

    def upto(self, times_ns: Integers, upto_ns: int) -> Integers:
        """Return the distinct times of the next samples.

        Args:
            times_ns: of the new messages: those of the sampled topic or, for multiples of a step, those of
                all topics with objects or signals.
            upto_ns: how far the log is known.

        Raises:
            LogError: a gap in the log holds far too many samples.
            UsageError: the step is far too short for the rate of the messages.
        """
        if self._step_ns is None:
            times = times_ns if len(times_ns) == 1 else np.unique(times_ns)
            times = times[times > self._last_ns]
        else:
            times = self._multiples(times_ns, upto_ns, self._step_ns)
        if len(times):
            self._last_ns = int(times[-1])
        return times

    def note(self, time_ns: int) -> bool:
        """Count a sample taken besides; return whether it comes after the first and the last."""
        comes_after = 0 <= self._last_ns < time_ns
        if comes_after:
            self._last_ns = time_ns
        return comes_after

    def _multiples(self, times_ns: Integers, upto_ns: int, step_ns: int) -> Integers:
        if self._from_ns is None and len(times_ns):
            self._from_ns = max(int(times_ns.min()), self._start_ns)
        if self._from_ns is None or upto_ns < self._from_ns:
            return np.empty(0, np.int64)
        begin_ns = max(self._from_ns, self._last_ns + 1)
        # multiples of the step since the epoch, so that samples do not depend on the window
        first, stop = -(-begin_ns // step_ns), upto_ns // step_ns + 1
        marks = np.unique(np.concatenate([[begin_ns, upto_ns], times_ns[times_ns > begin_ns]]))
        gaps = np.diff(marks)
        if len(gaps) and int(gaps.max()) // step_ns > _MOST_STEPS:
            at = int(np.argmax(gaps))
            start, end = times_apart(int(marks[at]), int(marks[at + 1]))
            raise LogError(
                f"{self._name}: time jumps forward from {start} to {end}, more than {_MOST_STEPS} samples"
                " without a message; take another clock or a longer step"
            )
        if stop - first > _MOST_AT_ONCE:
            raise UsageError(
                f"{self._mapping_name}: sample.every: a sample each {step_ns} ns makes {stop - first} of them"
                f" up to {upto_ns} ns, where at most {_MOST_AT_ONCE} fit between messages that are read"
                " together; give a longer step"
            )
        return np.arange(first, max(first, stop), dtype=np.int64) * step_ns
