"""Assemble samples: the messages of one log in, traces out.

A message passes these stages:

- assemble: raw messages of all topics → `PendingMessages` of each topic, transforms in a `FrameTree`
- topic_reader: pending messages of one topic → `TopicColumns`: signals, and objects by bound field paths
- detections: objects → `Detections`: poses and solids in columns
- tracker: detections → observations in the fixed frame, `Events` over time, and a `Trace` of samples

Messages wait in the first stage until no earlier message can arrive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import compress, repeat
from math import inf
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.bags.decoders import Topic
from spatial_replay.bags.definitions import Decoder
from spatial_replay.bags.reader import DISORDER_NS, JUMP_REMEDY, Message, MessageColumns
from spatial_replay.errors import LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Integers, select
from spatial_replay.geometry.footprint import Concave
from spatial_replay.logs.messages import Channel
from spatial_replay.logs.read_options import FaultKinds, FaultList, OnTimeJump
from spatial_replay.mapping.assumptions import contradictions
from spatial_replay.mapping.binding import Codes
from spatial_replay.mapping.facts import facts_of
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import PlannedTopic, ReadingPlan
from spatial_replay.mapping.topic_reader import MISFITS, TopicReader
from spatial_replay.mapping.tracker import Remarks, Tracker
from spatial_replay.mapping.transforms import HISTORY_NS, FrameTree
from spatial_replay.text import Instant, Sentence, nearest_hint, plural, times_apart
from spatial_replay.trace.doubts import Doubt
from spatial_replay.trace.facts import TopicFacts
from spatial_replay.trace.trace import FOREVER, LATEST_NS, LONG_PAUSE, Trace

_FIRST_STEP: Final = 256
"""Limit of messages before the first trace, low for an early first sample; doubled after each trace."""
_LONGEST_STEP: Final = 8_192
"""Limit of messages between two traces."""

_STEP_BYTES: Final = 2**23
"""Size limit of messages between two traces, bytes."""

_MOST_STEPS = 100_000
"""Limit of samples between two messages. A longer gap is a jump of the clock."""

_ANOTHER_CLOCK_NS: Final = 366 * 86_400 * 10**9
"""Least jump back, nanoseconds, that shows two clocks, such as simulated time and time since 1970."""

_MOST_AT_ONCE = 1_000_000
"""Limit of samples per step, because all samples of a step are in memory together."""


class _Assembling:
    """Assembler of samples from the messages of a log or of a running system.

    Args:
        name: name of the log, for errors and remarks.
        decoder: function from a topic to its decoder.
        start_ns, end_ns: half-open window of the samples. Messages outside the window may be added, because
            they may affect samples in the window.
        on_time_jump: whether a jump back by more than the plan's `late_ns` is an error or ends the log.
    """

    _is_live = False

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
        self._window_ns = start_ns or 0, FOREVER if end_ns is None else end_ns
        self._on_time_jump = on_time_jump
        self._faults = FaultKinds() if self._is_live else FaultList()
        for topic, reason in plan.lost:
            # some reasons begin with the topic
            cause = reason.removeprefix(f"topic {topic!r}: ")
            self._faults.add(f"{name}: {topic}: its transforms cannot be decoded: {cause}")
        self._remarks = Remarks(name, plan.mapping)
        self._doubts: list[Doubt] = []
        self._tree = FrameTree()
        self._knows_static = False
        name_codes, class_codes = Codes(), Codes()
        self._readers = {
            topic.name: TopicReader(
                topic,
                plan.mapping,
                decoder,
                name_codes,
                class_codes,
                decodes_early=self._is_live,
                report=self._add_fault,
            )
            for topic in plan.planned
        }
        topics = dict.fromkeys(reader.planned.topic for reader in self._readers.values())
        self._number_of_topic = {topic: topic_number for topic_number, topic in enumerate(topics)}
        self._tracker = Tracker(
            plan,
            self._readers,
            name_codes,
            class_codes,
            self._tree,
            self._remarks,
            window_ns=self._window_ns,
            concave=concave,
            report=self._add_fault,
        )
        self._sample_times = _SampleTimes(plan, name, self._window_ns[0])
        self._silences = _Silences(plan, self._readers, self._window_ns)
        self._begin_ns: int | None = None
        self._newest_ns = -1
        self._latest_ns = self._settled_ns = self._forgot_ns = -1
        self._message_count = 0
        self._channel_by_topic: dict[str, int] = {}
        self.jump: Sentence | None = None
        """Jump of time that ended the log; None without a jump."""

    @property
    def is_finished(self) -> bool:
        """Whether later messages are ignored: after a jump that ended the log, or after the window."""
        return self.jump is not None or self._settled_ns >= self._window_ns[1] - 1

    def _add_transforms(self, reader: TopicReader, clock_ns: int | None, log_ns: int, message: Any) -> None:
        if reader.transforms is None:
            return
        try:
            is_static = reader.planned.is_static
            reader.transforms.add(self._tree, message, clock_ns, log_ns=log_ns, is_static=is_static)
        except MISFITS as error:
            self._add_fault(reader.name, log_ns, f"its transforms cannot be read: {error}")

    def finish(self) -> Trace:
        """End the log and return the remaining samples.

        Raises:
            UsageError: the mapping fits no message of a topic, or the log lacks the fixed frame.
        """
        trace = self._settle(max(self._newest_ns, self._latest_ns), is_last=True)
        if not self._is_live:
            self._remarks.add_pauses()
            self._remarks.add_silences()
        fallback_names = " and ".join(sorted(self._plan.fallback_topics))
        for text in self._silences.remarks(self._plan.sampled_topic or "", fallback_names):
            self._remarks.add(text)
        for text in self._tree.remarks():
            self._remarks.add(text)
        # a running system has no log that the user could cut
        if self.jump is not None and not self._is_live:
            consequence = ": the log is taken to end there; cut it to evaluate what comes after"
            self._remarks.add(Sentence(self.jump, consequence))
        for reader in self._readers.values():
            reader.finish()
            for signal, signal_texts in reader.unnamed.items():
                unnamed = ", ".join(map(repr, signal_texts))
                remark_text = f"`names` of the signal {signal!r} lacks {unnamed}; it is unknown there"
                self._remarks.add(f"{reader.name}: {remark_text}")
            if (step_back := reader.pending.first_step) is not None:
                treatment = (
                    "are sorted by time, as if of two senders; if a clock was set back, cut the log there"
                )
                if not step_back.is_sorted:
                    treatment = "are numbered on, so those recorded later count later; cut the log there"
                step_text = f"{(step_back.from_ns - step_back.to_ns) / 1e9:.3f} s"
                remark_text = (
                    f"{reader.name}: times step back in the order of recording, first by {step_text} at "
                )
                treatment = f": its messages {treatment}, or take another `clock`"
                self._remarks.add(Sentence(remark_text, Instant(step_back.from_ns, 0), treatment))
            if reader.unstamped:
                subject = "message was" if reader.unstamped == 1 else "messages were"
                self._remarks.add(
                    f"{reader.name}: {reader.unstamped} {subject} left out, without a stamp, or with one of"
                    " 0, for the clock header"
                )
        for contradiction in contradictions(self._tracker.evidence, self._plan.mapping):
            if isinstance(contradiction, Doubt):
                self._doubts.append(contradiction)
            else:
                self._remarks.add(contradiction)
        self._check_fixed_frame()
        self._settled_ns = LATEST_NS
        return trace

    def _check_fixed_frame(self) -> None:
        """Raise UsageError if a whole log has frames, but lacks the fixed frame."""
        mapping = self._plan.mapping
        has_whole_log = not self._is_live and self._window_ns == (0, FOREVER) and self.jump is None
        if mapping.fixed_frame is None or not has_whole_log or self._plan.lost:
            return
        extractors = (reader.extractor for reader in self._readers.values())
        noted_names = (extractor.noted_frames for extractor in extractors if extractor is not None)
        frame_names = sorted(self._tree.names.union(*noted_names) - {""})
        if frame_names and mapping.fixed_frame not in frame_names:
            hint = nearest_hint(mapping.fixed_frame, frame_names)
            first_frames = ", ".join(frame_names[:20]) + (
                f" and {len(frame_names) - 20} more" if len(frame_names) > 20 else ""
            )
            raise UsageError(
                f"{mapping.name}: fixed_frame: the log has no frame {mapping.fixed_frame!r};"
                f" {f'{hint} ' if hint else ''}its frames are {first_frames}"
            )

    def take_faults(self, *, last: bool = False) -> tuple[str, ...]:
        """Return the faults since the last call, each with its topic and time."""
        return self._faults.take(last=last or self._settled_ns == LATEST_NS)

    def find_doubts(self) -> tuple[Doubt, ...]:
        """Return doubts about the messages so far, except doubts that the mapping accepts."""
        doubts = contradictions(self._tracker.evidence, self._plan.mapping)
        return tuple(doubt for doubt in doubts if isinstance(doubt, Doubt) and not doubt.is_accepted)

    def take_doubts(self) -> tuple[Doubt, ...]:
        """Return the assumptions that the log contradicts; () before `finish`."""
        doubts, self._doubts = tuple(self._doubts), []
        return doubts

    @property
    def facts(self) -> tuple[TopicFacts, ...]:
        """Facts of each mapped topic; complete after `finish`."""
        return tuple(map(facts_of, self._tracker.evidence.values()))

    def take_remarks(self) -> tuple[str, ...]:
        """Return remarks on stale objects, missing transforms and pauses; () before `finish`."""
        return self._remarks.take() if self._settled_ns == LATEST_NS else ()

    def _add_step(self, messages: MessageColumns) -> None:
        """Pass transforms to the frame tree, and messages to the readers of their topics."""
        topics = messages.topics
        topic_numbers = map(self._number_of_topic.get, topics, repeat(-1))
        topic_of_message = np.fromiter(topic_numbers, np.int64, len(messages))
        batches: list[_Stamped] = []
        arrived_topics = set(topics)
        for reader in self._readers.values():
            if reader.planned.topic not in arrived_topics or (
                self._knows_static and reader.planned.is_static and not reader.is_mapped
            ):
                # static transforms were added in advance, by `know_static`
                continue
            message_indices = np.flatnonzero(topic_of_message == self._number_of_topic[reader.planned.topic])
            message_indices = self._of_publisher(reader.planned, message_indices, messages)
            if len(message_indices):
                batches.append(self._stamp(reader, message_indices, messages))
        end_index = self._advance_time(batches, messages)
        for batch in batches:
            self._put(batch.before(end_index), messages)

    def _of_publisher(
        self, planned: PlannedTopic, message_indices: Integers, messages: MessageColumns
    ) -> Integers:
        """Return the indices of messages from the selected publisher.

        Raises:
            UsageError: the topic lacks this publisher.
        """
        publisher = None if planned.mapping is None else planned.mapping.publisher
        if publisher is None:
            return message_indices
        channel_codes = sorted(
            code for code, channel in messages.channels.items() if channel.topic == planned.topic
        )
        if publisher > len(channel_codes):
            raise UsageError(
                f"{self._plan.mapping.name}: topics.{planned.name}.publisher: there is no publisher"
                f" {publisher}; the topic has {plural(len(channel_codes), 'channel')}"
            )
        of_publisher: Integers = message_indices[
            messages.channel[message_indices] == channel_codes[publisher - 1]
        ]
        return of_publisher

    def _stamp(self, reader: TopicReader, message_indices: Integers, messages: MessageColumns) -> _Stamped:
        """Return the messages of one topic with times on the topic's clock.

        The messages are decoded if the reader `decodes_on_arrival`, for example for stamps or transforms.
        """
        contents: list[Any] = [messages.payloads[message_index] for message_index in message_indices.tolist()]
        clock = reader.planned.clock
        times_ns = (messages.publish_time_ns if clock == "publish" else messages.log_time_ns)[message_indices]
        if reader.decodes_on_arrival:
            is_good = np.ones(len(message_indices), np.bool_)
            log_times_ns = messages.log_time_ns[message_indices].tolist()
            contents = reader.decode(contents, log_times_ns, is_good)
            if clock == "header":
                times_ns = reader.stamps(contents, log_times_ns, is_good)
                if reader.planned.is_static:
                    # many programs send static transforms without a stamp
                    times_ns = np.where(times_ns == 0, messages.log_time_ns[message_indices], times_ns)
            contents = list(compress(contents, is_good.tolist()))
            message_indices, times_ns = message_indices[is_good], times_ns[is_good]
        return _Stamped(reader, message_indices, times_ns, contents)

    def _advance_time(self, batches: list[_Stamped], messages: MessageColumns) -> int:
        """Update the newest time of the log; return the number of messages before a jump that ends the log.

        Raises:
            LogError: time jumps back, and `on_time_jump` is "error".
        """
        moving_batches = [batch for batch in batches if batch.reader.advances_time]
        no_integers = np.empty(0, np.int64)
        message_indices = np.concatenate([no_integers, *(batch.message_indices for batch in moving_batches)])
        # jumps are defined in the order of arrival over all topics
        arrival_order = np.argsort(message_indices, kind="stable")
        times_ns = np.concatenate([no_integers, *(batch.times_ns for batch in moving_batches)])[arrival_order]
        if self._begin_ns is None and len(times_ns):
            self._begin_ns = int(times_ns[0])
        newest_ns = np.maximum.accumulate(np.append(self._newest_ns, times_ns))
        late_indices = np.flatnonzero(times_ns < newest_ns[:-1] - self._plan.late_ns)
        jump_index = int(late_indices[0]) if len(late_indices) else -1
        self._newest_ns = int(newest_ns[jump_index])
        if jump_index < 0:
            return len(messages)
        message_index = int(message_indices[arrival_order[jump_index]])
        jump = Sentence(
            (
                f"time jumps back by {(int(newest_ns[jump_index]) - int(times_ns[jump_index])) / 1e9:.3f} s,"
                " from "
            ),
            Instant(int(newest_ns[jump_index]), self._begin_ns or 0),
            " to ",
            Instant(int(times_ns[jump_index]), self._begin_ns or 0),
            f", at a message of {messages.topics[message_index]}",
        )
        if self._on_time_jump == "error":
            remedy = f"{JUMP_REMEDY}, and another clock may not jump"
            if int(newest_ns[jump_index]) - int(times_ns[jump_index]) > _ANOTHER_CLOCK_NS:
                remedy = "its stamps and those before are of two clocks; `clock: log` uses one for all"
            raise LogError(f"{self._name}: {jump}; {remedy}")
        self.jump = jump
        return message_index

    def _put(self, batch: _Stamped, messages: MessageColumns) -> None:
        reader = batch.reader
        if len(batch.times_ns):
            self._note_arrivals(reader, batch.times_ns, batch.contents)
        log_times_ns = messages.log_time_ns[batch.message_indices]
        if reader.is_mapped:
            arrivals = self._tracker.evidence[reader.name].arrivals
            publish_times_ns, channel_codes = (
                column[batch.message_indices] for column in (messages.publish_time_ns, messages.channel)
            )
            arrivals.add(batch.times_ns, log_times_ns, publish_times_ns, channel_codes)
        if reader.transforms is not None and not (self._knows_static and reader.planned.is_static):
            for time_ns, log_ns, message in zip(
                batch.times_ns.tolist(), log_times_ns.tolist(), batch.contents, strict=True
            ):
                self._add_transforms(reader, time_ns, log_ns, message)
        if reader.is_mapped or reader.name == self._plan.sampled_topic:
            times_ns, is_used = self._counting(reader, batch.times_ns, log_times_ns)
            self._latest_ns = max(self._latest_ns, int(times_ns.max(initial=-1)))
            sequence_numbers, record_numbers = (
                messages.sequence[batch.message_indices],
                messages.place[batch.message_indices],
            )
            columns = (
                times_ns[is_used],
                sequence_numbers[is_used],
                log_times_ns[is_used],
                record_numbers[is_used],
            )
            reader.pending.add(columns, list(compress(batch.contents, is_used.tolist())))

    def _counting(
        self, reader: TopicReader, times_ns: Integers, log_times_ns: Integers
    ) -> tuple[Integers, Booleans]:
        """Return the time from which each message is valid, and whether the message is used."""
        # a late message is valid right after the final samples
        return np.maximum(times_ns, self._settled_ns + 1), np.ones(len(times_ns), np.bool_)

    def _settle(self, upto_ns: int, *, is_last: bool = False) -> Trace:
        """Return the new final samples up to a time.

        A message that arrives later, with a time up to `upto_ns`, is valid only after `upto_ns`.

        Args:
            is_last: whether the log ends here, so that no message waits.

        Raises:
            LogError, UsageError: see `Assembler.add`.
        """
        newest_ns = max(self._newest_ns, self._latest_ns)
        # in a running system, messages older than the newest message may still arrive
        known_ns = upto_ns if self._is_live or is_last else newest_ns - self._plan.late_ns
        upto_ns = self._silences.limit(upto_ns, known_ns, is_last=is_last)
        if upto_ns <= self._settled_ns:
            return Trace.empty()
        start_ns, end_ns = self._window_ns
        start_ns = max(start_ns, self._settled_ns + 1)
        # NumPy does not warn, because NaN and infinity in logs make objects unknown
        with np.errstate(all="ignore"):
            sampled_ns, fallback_ns = self._tracker.advance(upto_ns)
            fallback_ns = self._silences.sampled_in(fallback_ns)
            times_ns = self._sample_times.upto(np.concatenate([sampled_ns, fallback_ns]), upto_ns)
            times_ns = times_ns[(times_ns >= start_ns) & (times_ns < end_ns)]
            self._remarks.samples.add(times_ns)
            trace = self._tracker.trace(times_ns, newest_ns)
            self._tracker.forget(upto_ns)
        self._settled_ns = upto_ns
        # old transforms are dropped rarely, because searching all transforms takes longer than a sample
        if upto_ns - self._forgot_ns > DISORDER_NS:
            self._tree.forget_before(upto_ns - HISTORY_NS)
            self._forgot_ns = upto_ns
        return trace

    def _note_arrivals(self, reader: TopicReader, times_ns: Integers, contents: Sequence[Any]) -> None:
        """Note arrived messages of a topic; `contents` are decoded if the reader `decodes_on_arrival`."""

    def _columns(self, messages: Sequence[Message]) -> MessageColumns:
        if not messages:
            return MessageColumns()
        topics, *number_columns, payloads = zip(*messages, strict=True)
        log_ns, publish_ns, sequence_numbers = (np.array(column, np.int64) for column in number_columns)
        record_numbers = self._message_count + np.arange(len(messages))
        self._message_count += len(messages)
        # a topic keeps its channel number between calls, because a new number would mean another publisher
        channel_by_topic = self._channel_by_topic
        channels = {
            channel_by_topic.setdefault(topic, len(channel_by_topic)): Channel(topic, "", None)
            for topic in dict.fromkeys(topics)
        }
        channel_codes = np.array([channel_by_topic[topic] for topic in topics], np.int64)
        return MessageColumns(
            channels, channel_codes, sequence_numbers, log_ns, publish_ns, payloads, record_numbers
        )

    def _add_fault(self, topic: str, log_time_ns: int, fault: str) -> None:
        self._faults.add(Sentence(f"{self._name}: {topic} at ", Instant(log_time_ns, 0), f": {fault}"))


class Assembler(_Assembling):
    """Assembler of the samples of one log; see `_Assembling` for the other arguments.

    Add thousands of messages per call, because the assembler works on columns. The samples do not depend on
    the division into calls.

    Args:
        goes_on: function that returns whether the log has messages after the last added message; by default,
            False.
    """

    _step_limit, _step_count, _step_bytes = _FIRST_STEP, 0, 0

    def __init__(
        self,
        plan: ReadingPlan,
        decoder: Callable[[str], Decoder],
        *,
        goes_on: Callable[[], bool] = lambda: False,
        **options: Any,
    ) -> None:
        super().__init__(plan, decoder, **options)
        self._silences.goes_on = goes_on

    def know_start(self, sampled_ns: int | None, others_ns: int | None) -> None:
        """Note the times of the log's first messages, for a window that begins after them.

        Args:
            sampled_ns: time of the sampled topic's first message; None if `add` will receive this message.
            others_ns: time of the first message of the fallback topics.
        """
        self._silences.know_start(sampled_ns, others_ns)

    def add(self, messages: Sequence[Message] | MessageColumns) -> Trace:
        """Add messages in the order of the log; return the samples that are now final.

        Raises:
            LogError: time jumps back too far, and `on_time_jump` is "error".
            UsageError: the mapping does not fit the messages.
        """
        columns = messages if isinstance(messages, MessageColumns) else self._columns(messages)
        traces: list[Trace] = []
        end_bytes = np.cumsum(np.fromiter(map(len, columns.payloads), np.int64, len(columns)))
        begin = 0
        while begin < len(columns) and not self.is_finished:
            read_bytes = int(end_bytes[begin - 1]) if begin else 0
            size_stop = int(np.searchsorted(end_bytes, read_bytes + _STEP_BYTES - self._step_bytes)) + 1
            stop = min(begin + self._step_limit - self._step_count, size_stop, len(columns))
            self._add_step(select(columns, slice(begin, stop)))
            self._step_count += stop - begin
            self._step_bytes += int(end_bytes[stop - 1]) - read_bytes
            begin = stop
            if self._step_count == self._step_limit or self._step_bytes >= _STEP_BYTES:
                self._step_count = self._step_bytes = 0
                self._step_limit = min(2 * self._step_limit, _LONGEST_STEP)
                traces.append(self._settle(self._newest_ns - self._plan.wait_ns))
        return traces[0] if len(traces) == 1 else Trace.concatenate(traces)

    def know_static(self, messages: Iterable[Message]) -> None:
        """Add the static transforms of the whole log, before any other message is added."""
        self._knows_static = True
        for topic, log_ns, publish_ns, _, payload in messages:
            reader = self._readers[topic]
            is_good = np.ones(1, np.bool_)
            contents = reader.decode([payload], [log_ns], is_good)
            if is_good[0]:
                time_by_clock = {"log": log_ns, "publish": publish_ns, "header": None}
                self._add_transforms(reader, time_by_clock[reader.planned.clock], log_ns, contents[0])

    def move_faults(self, target: FaultList) -> None:
        """Move all faults to another list, including the number of faults beyond the list's limit."""
        self._faults.move_to(target)


class _Stamped(NamedTuple):
    """Messages of one topic: indices among all arrived messages, times and contents."""

    reader: TopicReader
    message_indices: Integers
    times_ns: Integers
    contents: list[Any]

    def before(self, message_index: int) -> _Stamped:
        count = int(np.searchsorted(self.message_indices, message_index))
        return _Stamped(
            self.reader,
            self.message_indices[:count],
            self.times_ns[:count],
            self.contents[:count],
        )


class _SampleTimes:
    """Times of samples: at messages, or at multiples of a step.

    Args:
        start_ns: start of the window, before which there is no sample.
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
            times_ns: times of new messages: of the sampled topic or, for multiples of a step, of all topics
                with objects or signals.
            upto_ns: time up to which samples are decided.

        Raises:
            LogError: a gap in the log would hold too many samples.
            UsageError: the step is too short for the rate of the messages.
        """
        if self._step_ns is None:
            # np.unique is slow for the single message of a running system
            sample_times_ns = times_ns if len(times_ns) == 1 else np.unique(times_ns)
            sample_times_ns = sample_times_ns[sample_times_ns > self._last_ns]
        else:
            sample_times_ns = self._multiples(times_ns, upto_ns, self._step_ns)
        if len(sample_times_ns):
            self._last_ns = int(sample_times_ns[-1])
        return sample_times_ns

    def note(self, time_ns: int) -> bool:
        """Note an extra sample at a time after the last sample; return False for any other time."""
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
        # multiples are counted from the epoch, so that samples do not depend on the window. Division is in
        # integers, because floats do not resolve nanoseconds since 1970.
        first_multiple, stop_multiple = -(-begin_ns // step_ns), upto_ns // step_ns + 1
        marks_ns = np.unique(np.concatenate([[begin_ns, upto_ns], times_ns[times_ns > begin_ns]]))
        gaps_ns = np.diff(marks_ns)
        if len(gaps_ns) and int(gaps_ns.max()) // step_ns > _MOST_STEPS:
            gap_index = int(np.argmax(gaps_ns))
            start_text, end_text = times_apart(int(marks_ns[gap_index]), int(marks_ns[gap_index + 1]))
            raise LogError(
                f"{self._name}: time jumps forward from {start_text} to {end_text}, more than {_MOST_STEPS}"
                " samples without a message; take another clock or a longer step"
            )
        if stop_multiple - first_multiple > _MOST_AT_ONCE:
            raise UsageError(
                f"{self._mapping_name}: sample.every: a sample every {step_ns} ns makes"
                f" {stop_multiple - first_multiple} samples up to {upto_ns} ns, and at most {_MOST_AT_ONCE}"
                " fit between messages that are read"
                " together; give a longer step"
            )
        return np.arange(first_multiple, max(first_multiple, stop_multiple), dtype=np.int64) * step_ns


class _Silences:
    """Long silences of the sampled topic, in which fallback topics are sampled.

    A silence is too long above a limit, which depends only on the interval between the two messages before
    the silence. The limit is at most the plan's `longest_silence_ns`. So a log, a window of the log and a
    running system give the same decision.

    Attributes:
        first_ns: time of the sampled topic's first message; None without a message.
        before_ns: time of the first sample if samples begin before `first_ns`; otherwise None.
        goes_on: function that returns whether the log has messages after the last message read.
    """

    def __init__(
        self, plan: ReadingPlan, readers: Mapping[str, TopicReader], window_ns: tuple[int, int]
    ) -> None:
        self._least_limit_ns, self._greatest_limit_ns = plan.silence_ns, plan.longest_silence_ns
        self._window_ns = window_ns
        self._sampled_pending = None if plan.sampled_topic is None else readers[plan.sampled_topic].pending
        self._fallback_pending = [readers[topic].pending for topic in sorted(plan.fallback_topics)]
        self._fallback_begin_ns: int | None = None
        # message times of the sampled topic: the last two before the next samples, and all later times
        self._past_ns = self._times_ns = np.empty(0, np.int64)
        # whether fallback topics are sampled after each of `_times_ns`; the last element is for the time
        # before the first
        self._is_filled = np.zeros(1, np.bool_)
        self._unread_ns: int | None = None
        self._first_pause_ns: tuple[int, int | None] | None = None
        self._pause_count, self._last_pause_ns, self._last_ns = 0, -1, -1
        self.first_ns: int | None = None
        self.before_ns: int | None = None
        self.goes_on: Callable[[], bool] = lambda: False

    def know_start(self, sampled_ns: int | None, others_ns: int | None) -> None:
        """Note the times of the log's first messages; see `Assembler.know_start`."""
        self._fallback_begin_ns = others_ns
        if sampled_ns is not None:
            self.first_ns = self._unread_ns = sampled_ns
            self._past_ns = np.array([sampled_ns], np.int64)

    def limit(self, upto_ns: int, known_ns: int, *, is_last: bool) -> int:
        """Return the time up to which samples are decided.

        Args:
            upto_ns: requested time.
            known_ns: time up to which all messages have arrived.
            is_last: whether no further message will arrive.
        """
        if self._sampled_pending is None or not self._fallback_pending:
            return upto_ns
        waiting_ns = self._sampled_pending.times_ns
        times_ns = np.unique(np.concatenate([self._past_ns, waiting_ns[waiting_ns <= known_ns]]))
        if self._fallback_begin_ns is None:
            begin_ns = min(int(pending.times_ns.min(initial=LATEST_NS)) for pending in self._fallback_pending)
            self._fallback_begin_ns = begin_ns if begin_ns <= upto_ns else None
        is_silence_filled = self._silences(times_ns, known_ns, is_last=is_last)
        if is_last:
            if len(times_ns) and not is_silence_filled[-2] and times_ns[-1] < self._window_ns[1]:
                # reading ended after the longest limit, so this silence is too long if the log goes on
                is_silence_filled[-2] = self.goes_on()
        elif len(times_ns):
            # until the silence after the last message is decided, samples end at that message
            last_ns = int(times_ns[-1])
            upto_ns = upto_ns if last_ns > upto_ns or is_silence_filled[-2] else last_ns
        elif self._fallback_begin_ns is not None and not is_silence_filled[-1]:
            # it is not yet decided whether samples begin at fallback topics
            upto_ns = min(upto_ns, self._fallback_begin_ns - 1)
        self._times_ns, self._is_filled = times_ns, is_silence_filled
        # past messages stay past, even if this request ends before an earlier request
        past_ns = max(upto_ns, int(self._past_ns.max(initial=-1)))
        self._past_ns = times_ns[times_ns <= past_ns][-2:]
        if len(times_ns) and self.first_ns is None:
            self.first_ns = int(times_ns[0])
        return upto_ns

    def _silences(self, times_ns: Integers, known_ns: int, *, is_last: bool) -> Booleans:
        """Return for each message of the sampled topic whether the silence after the message is too long.

        The last element concerns the silence before the first message.
        """
        limits_ns = np.full(len(times_ns), self._greatest_limit_ns)
        limits_ns[1:] = np.clip(LONG_PAUSE * np.diff(times_ns), self._least_limit_ns, self._greatest_limit_ns)
        # if no message has arrived up to `known_ns`, the next message is later
        next_ns = np.append(times_ns, known_ns if is_last else known_ns + 1)
        if is_last and len(times_ns):
            # after the last message, a silence beyond the usual intervals is sampled to the end of the log
            interval_ns = int(np.diff(times_ns)[-1]) if len(times_ns) > 1 else self._least_limit_ns
            limits_ns[-1] = min(self._least_limit_ns, LONG_PAUSE * interval_ns)
        begins_late = False
        if self._fallback_begin_ns is not None and not len(self._past_ns):
            begins_late = int(next_ns[0]) - self._fallback_begin_ns > self._least_limit_ns
            begins_late = begins_late or (is_last and not len(times_ns))
        return np.append(next_ns[1:] - times_ns > limits_ns, begins_late)

    def sampled_in(self, others_ns: Integers) -> Integers:
        """Return the message times of fallback topics at which to sample.

        Args:
            others_ns: message times of fallback topics, at most the time from `limit`.
        """
        message_index = np.searchsorted(self._times_ns, others_ns, "right") - 1
        is_sampled = self._is_filled[message_index]
        start_ns, end_ns = self._window_ns
        is_in_window = is_sampled & (others_ns >= start_ns) & (others_ns < end_ns)
        self._note(others_ns[is_in_window], message_index[is_in_window])
        sampled_ns: Integers = others_ns[is_sampled]
        return sampled_ns

    def _note(self, fallback_ns: Integers, message_index: Integers) -> None:
        """Note samples at fallback topics, each with the index of the sampled topic's preceding message."""
        before_ns = fallback_ns[message_index < 0]
        if len(before_ns) and self.before_ns is None:
            self.before_ns = int(before_ns.min())
        for start_ns in np.unique(self._times_ns[message_index[message_index >= 0]]).tolist():
            if start_ns != self._last_pause_ns:
                self._pause_count, self._last_pause_ns = self._pause_count + 1, start_ns
                self._first_pause_ns = self._first_pause_ns or (start_ns, None)
        self._last_ns = max(self._last_ns, int(fallback_ns.max(initial=-1)))
        if self._first_pause_ns is not None and self._first_pause_ns[1] is None:
            later_ns = self._times_ns[self._times_ns > self._first_pause_ns[0]]
            self._first_pause_ns = self._first_pause_ns[0], int(later_ns[0]) if len(later_ns) else None

    def remarks(self, sampled_topic: str, fallback_topics: str) -> Iterator[str]:
        """Yield remarks on samples at fallback topics; call it after the last sample."""
        subject = f"samples are taken at {sampled_topic}, which "
        if self.before_ns is not None and self.first_ns is None:
            yield f"samples are taken at {fallback_topics}, since {sampled_topic} has no message"
        elif self.before_ns is not None and self.first_ns is not None:
            clause = "; those before, from ", Instant(self.before_ns, 0), f" on, are at {fallback_topics}"
            yield Sentence(f"{subject}begins at ", Instant(self.first_ns, 0), *clause)
        if self._first_pause_ns is None:
            return
        is_open = self._last_pause_ns == int(self._times_ns[-1])
        more_pauses = self._pause_count - is_open - 1
        start_ns, end_ns = self._first_pause_ns
        if end_ns is not None:
            start_words = () if start_ns == self._unread_ns else ("from ", Instant(start_ns, 0), " ")
            until_word = "until " if start_ns == self._unread_ns else "to "
            pauses_text = f" and in {plural(more_pauses, 'more pause')}" if more_pauses else ""
            ending = f"; those between{pauses_text} are at {fallback_topics}"
            yield Sentence(f"{subject}pauses ", *start_words, until_word, Instant(end_ns, 0), ending)
        if is_open and self._last_pause_ns == self._unread_ns:
            yield f"samples are taken at {fallback_topics}, since {sampled_topic} is silent"
        elif is_open:
            clause = "; those after, until ", Instant(self._last_ns, 0), f", are at {fallback_topics}"
            ending_verb = "is silent after " if self.goes_on() else "ends at "
            yield Sentence(f"{subject}{ending_verb}", Instant(self._last_pause_ns, 0), *clause)


_MOMENT_S: Final = 0.001
"""Waiting time for messages of equal time, seconds, if all messages arrive in the order of time."""

_MOST_HELD: Final = 4_096
"""Limit of observations that wait for transforms; further observations do not wait."""


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
    """Assemble a few samples of invented messages, so that the first real samples need no compilation."""
    ring_corners = [[0, 0], [2, 0], [2, 2], [1, 1]]
    contents: dict[str, Any] = {
        "/boxes": {
            "frame_id": "map",
            "of": [{"id": box_id, "x": box_id, "y": 0, "yaw": box_id} for box_id in (1, 2)],
        },
        "/discs": {"x": 0, "y": 0},
        "/rings": {"corners": [{"x": x, "y": y} for x, y in ring_corners]},
        "/charge": {"value": 1},
    }
    topics = [Topic(topic, "trial", "json") for topic in contents]
    plan = ReadingPlan.of(parse_mapping(_TRIAL), topics)
    assembler = LiveAssembler(plan, lambda topic: lambda _: contents[topic], name="", max_delay_s=1.0)
    for second in range(4):
        for topic in contents:
            assembler.add([Message(topic, second * 10**9, second * 10**9, 0, b"")], second)
    assembler.lose(tuple(contents), 5.0)
    assembler.finish()


class _Held(NamedTuple):
    """An observation that waits for the transforms of its frame.

    Attributes:
        time_ns: time of the observation's message on the clock of the samples.
        at_ns: time at which transforms are needed: the observation's stamp, or `time_ns`.
        by_stamp: whether `at_ns` is a stamp.
        until_s: deadline, seconds.
    """

    topic: str
    frame: str
    time_ns: int
    at_ns: int
    by_stamp: bool
    until_s: float


class LiveAssembler(_Assembling):
    """Assembler of the samples of a running system.

    Callers pass the time of their clock, `now_s`, in seconds. A sample is final when every topic has reached
    the sample's time. It is final at the latest `max_delay_s` after the arrival of the first message at or
    after the sample's time. So a log of the same messages gives the same samples, if topics interleave within
    that delay.

    Args:
        in_order: whether the server stamps messages when it sends them, so that messages of all topics arrive
            in the order of log time.

    Attributes:
        late: number of messages that arrived when the samples of the message's time were already final.
        overdue: number of observations that are unknown because their transforms did not arrive in time.
        overdue_frame: topic and frame of the last overdue observation.
    """

    _is_live = True

    def __init__(
        self,
        plan: ReadingPlan,
        decoder: Callable[[str], Decoder],
        *,
        name: str,
        max_delay_s: float,
        in_order: bool = False,
        concave: Concave = "decompose",
    ) -> None:
        super().__init__(plan, decoder, name=name, on_time_jump="split", concave=concave)
        self._max_delay_s = max_delay_s
        self._is_in_order = in_order and plan.by_log_time
        transform_topics = (
            planned.name for planned in plan.planned if planned.is_transforms and not planned.is_static
        )
        self._transform_topics = frozenset(transform_topics)
        # static transforms are valid at all times, so no sample waits for their topics
        self._awaited_topics = [
            planned.name
            for planned in plan.planned
            if not planned.is_static and (planned.mapping is not None or planned.name == plan.sampled_topic)
        ]
        self._follows_frames = bool(self._transform_topics) and any(
            planned.is_static and planned.mapping is not None for planned in plan.planned
        )
        self._latest_ns_by_topic = dict.fromkeys((planned.name for planned in plan.planned), -1)
        self._step_back_ns = {name: int(reader.repeats_times) for name, reader in self._readers.items()}
        self._deadlines: deque[tuple[float, int]] = deque()
        self._arrivals: deque[tuple[float, int]] = deque(maxlen=_MOST_HELD)
        self._expired_ns = -1
        self._held: list[_Held] = []
        self._are_transforms_new = False
        self._lost: set[str] = set()
        self._now_s = 0.0
        self.late = 0
        self.overdue = 0
        self.overdue_frame: tuple[str, str] | None = None

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that samples depend on, except topics that are sent once and stay valid."""
        passing_topics = (
            planned.topic for planned in self._plan.planned if not (planned.is_lasting or planned.is_latched)
        )
        return tuple(dict.fromkeys(passing_topics))

    def add(self, messages: Sequence[Message], now_s: float) -> Trace:
        """Add messages in order of arrival; return the samples that are now final.

        Raises:
            LogError: time jumps so far ahead that there would be too many samples between two messages.
            UsageError: the mapping does not fit the messages.
        """
        self._now_s = now_s
        self._lost.difference_update(self._names_of({message.topic for message in messages}))
        if messages and not self.is_finished:
            self._add_step(self._columns(messages))
        waited_ns = self._deadlines[-1][1] if self._deadlines else max(self._settled_ns, self._expired_ns)
        # one deadline covers all times since the last deadline
        if waited_ns < self._newest_ns:
            patience_s = _MOMENT_S if self._is_in_order else self._max_delay_s
            self._deadlines.append((now_s + patience_s, self._newest_ns))
            self._arrivals.append((now_s, self._newest_ns))
        return self._settle(self._upto_ns(now_s))

    def _names_of(self, topics: Collection[str]) -> set[str]:
        """Return the names of planned topics for topics of the log."""
        return {planned.name for planned in self._plan.planned if planned.topic in topics}

    def arrived_s(self, time_ns: int) -> float:
        """Return the arrival time of the first message at or after a sample's time, seconds; inf if unknown.

        Call it in the order of samples, because earlier arrivals are dropped.
        """
        while self._arrivals and self._arrivals[0][1] < time_ns:
            self._arrivals.popleft()
        return self._arrivals[0][0] if self._arrivals else inf

    def due_s(self) -> float | None:
        """Return the time at which `add` must be called, even without messages; None if nothing waits."""
        deadlines_s = [waiting.until_s for waiting in self._held]
        is_settled = self._settled_ns >= self._newest_ns
        if self._deadlines and self._deadlines[-1][1] > self._expired_ns and not is_settled:
            deadlines_s.append(self._deadlines[0][0])
        return min(deadlines_s, default=None)

    def flush(self) -> Trace:
        """Return the samples that still wait for messages."""
        self._held = []
        return self._settle(self._newest_ns, is_last=True)

    def lose(self, topics: Collection[str], now_s: float) -> Trace:
        """Make objects and signals of lost topics unknown; return the new samples.

        A last sample shows the loss. The objects and signals stay unknown until their topic reports them
        again. A topic is lost when its connection ends, or after a silence. Messages of other topics wait as
        before.
        """
        newly_lost_topics = self._names_of(topics) - self._lost
        if not newly_lost_topics:
            return Trace.empty()
        self._now_s = now_s
        self._lost |= newly_lost_topics
        self._held = [waiting for waiting in self._held if waiting.topic not in newly_lost_topics]
        # lost topics send no more messages, so samples up to their last message are final
        last_message_ns = min(
            self._newest_ns, max(self._latest_ns_by_topic[topic] for topic in newly_lost_topics)
        )
        trace = self._settle(max(self._upto_ns(now_s), last_message_ns), is_last=True)
        # the loss is one nanosecond later, so that it is a separate sample
        lost_ns = self._settled_ns + 1
        if not self._sample_times.note(lost_ns):
            return trace
        self._tracker.advance(lost_ns)
        self._tracker.lose(lost_ns, newly_lost_topics)
        if any(self._readers[topic].transforms is not None for topic in newly_lost_topics):
            self._tree.forget_moving()
        self._settled_ns = lost_ns
        lost_trace = self._tracker.trace(np.array([lost_ns], np.int64), lost_ns)
        self._tracker.forget(lost_ns)
        return Trace.concatenate([trace, lost_trace])

    def _counting(
        self, reader: TopicReader, times_ns: Integers, log_times_ns: Integers
    ) -> tuple[Integers, Booleans]:
        is_late = times_ns <= self._settled_ns
        if not is_late.any():
            return times_ns, ~is_late
        # as in a log, the next sample shows a late message, unless a later message of the topic has replaced
        # it
        is_used = ~is_late | (times_ns > reader.pending.taken_ns) | reader.repeats_times
        for time_ns, log_ns, is_shown in zip(
            times_ns[is_late].tolist(), log_times_ns[is_late].tolist(), is_used[is_late].tolist(), strict=True
        ):
            self.late += 1
            remedy = (
                "the next sample has it" if is_shown else "it is left out, since a later message came before"
            )
            behind_s = (self._settled_ns - time_ns) / 1e9
            fault = f"it came after the samples up to {behind_s:.3f} s later; {remedy}"
            self._add_fault(reader.name, log_ns, fault)
            if behind_s <= self._max_delay_s:
                self._is_in_order = False
        return times_ns, is_used

    def _note_arrivals(self, reader: TopicReader, times_ns: Integers, contents: Sequence[Any]) -> None:
        topic_name = reader.name
        newest_ns = np.maximum.accumulate(np.append(self._latest_ns_by_topic[topic_name], times_ns))
        self._latest_ns_by_topic[topic_name] = int(newest_ns[-1])
        step_back_ns = newest_ns[:-1] - times_ns
        # a message that steps back farther is too late anyway
        step_back_ns = step_back_ns[
            (step_back_ns >= 0) & (newest_ns[:-1] >= 0) & (step_back_ns < self._max_delay_s * 1e9)
        ]
        # the step is one nanosecond more, because samples are final only before the earliest possible time
        self._step_back_ns[topic_name] = max(
            self._step_back_ns[topic_name], int(step_back_ns.max(initial=-1)) + 1
        )
        if topic_name in self._transform_topics:
            self._are_transforms_new = True
        if not self._transform_topics or len(self._held) >= _MOST_HELD:
            return
        until_s = self._now_s + self._max_delay_s
        if self._follows_frames and topic_name == self._plan.sampled_topic:
            self._held += [
                _Held(topic_name, "", int(time_ns), int(time_ns), False, until_s) for time_ns in times_ns
            ]
        if reader.extractor is None or reader.planned.is_static:
            return
        for time_ns, message in zip(times_ns.tolist(), contents, strict=True):
            try:
                chunk = reader.extractor.read([message], np.zeros(1, np.int64), is_early=True)
            except MISFITS:
                # the fault is reported when the objects are read
                continue
            # markers locked to a moving frame need the frame's transform in every sample
            self._follows_frames = self._follows_frames or any(chunk.locked)
            stamps = chunk.stamps or [0] * len(chunk.name)
            for frame, stamp_ns in dict.fromkeys(zip(chunk.frames or (), stamps, strict=False)):
                if frame != self._plan.mapping.fixed_frame:
                    at_ns, by_stamp = (stamp_ns, True) if stamp_ns else (time_ns, False)
                    self._held.append(_Held(topic_name, frame, time_ns, at_ns, by_stamp, until_s))
                    self._are_transforms_new = True

    def _upto_ns(self, now_s: float) -> int:
        """Return the time up to which samples are final."""
        newest_ns = self._newest_ns
        # a topic that has stepped back in time may step back by the same amount again
        reached_ns = (
            self._latest_ns_by_topic[topic] - self._step_back_ns[topic] for topic in self._awaited_topics
        )
        upto_ns = min(reached_ns, default=newest_ns)
        if self._is_in_order:
            # all messages before the newest time have arrived, but more messages of that time may follow
            upto_ns = max(upto_ns, newest_ns - 1)
        while self._deadlines and self._deadlines[0][0] <= now_s:
            self._expired_ns = self._deadlines.popleft()[1]
        upto_ns = min(max(upto_ns, self._expired_ns), newest_ns)
        self._release(now_s)
        return min([upto_ns, *(waiting.time_ns - 1 for waiting in self._held)])

    def _release(self, now_s: float) -> None:
        """Release observations whose transforms have arrived, and observations after their deadline."""
        if self._held and self._are_transforms_new:
            self._are_transforms_new = False
            self._held = [
                waiting
                for waiting, is_placeable in zip(self._held, self._placeable(), strict=True)
                if not is_placeable
            ]
        overdue = [waiting for waiting in self._held if waiting.until_s <= now_s]
        if overdue:
            self._held = [waiting for waiting in self._held if waiting.until_s > now_s]
            self.overdue += len(overdue)
            self.overdue_frame = overdue[-1].topic, overdue[-1].frame

    def _placeable(self) -> list[bool]:
        """Return for each waiting observation whether its transforms have arrived."""
        fixed_frame, tree = self._plan.mapping.fixed_frame or "", self._tree
        are_placeable = [False] * len(self._held)
        reached_ns = min((self._latest_ns_by_topic[topic] for topic in self._transform_topics), default=-1)
        indices_by_kind: dict[tuple[str, bool], list[int]] = {}
        for index, waiting in enumerate(self._held):
            if waiting.frame:
                indices_by_kind.setdefault((waiting.frame, waiting.by_stamp), []).append(index)
            else:
                are_placeable[index] = reached_ns >= waiting.at_ns
        for (frame, by_stamp), indices in indices_by_kind.items():
            at_ns = np.array([self._held[index].at_ns for index in indices], np.int64)
            time_ns = np.array([self._held[index].time_ns for index in indices], np.int64)
            log_ns = time_ns if self._plan.by_log_time else None
            is_placeable = tree.between(fixed_frame, frame, at_ns, by_stamp=by_stamp, log_ns=log_ns).known
            if by_stamp:
                # a stamp far behind the newest stamp may follow a reset of the clock, which the next
                # transform shows
                is_placeable = is_placeable & (
                    (at_ns > tree.newest_stamp_ns - DISORDER_NS) | (time_ns < reached_ns)
                )
            for index, is_known in zip(indices, is_placeable.tolist(), strict=True):
                are_placeable[index] = is_known
        return are_placeable
