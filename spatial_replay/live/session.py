"""Monitoring a running robot: messages to samples, verdicts, a log and clips."""

from __future__ import annotations

import asyncio
import gc
import itertools
import math
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from spatial_replay.bags.decoders import decoder_of, topic_of, topics_by_name
from spatial_replay.bags.reader import DISORDER_NS, Message
from spatial_replay.errors import LogError, UsageError, importing
from spatial_replay.live.client import Client, Disconnected, Inbox, Offered, Received
from spatial_replay.live.protocol import Connected, Warned
from spatial_replay.logs.messages import Channel, MemorySink, Messages
from spatial_replay.logs.objects import OBJECTS_CHANNEL, decode_objects
from spatial_replay.logs.read_options import FaultKinds
from spatial_replay.logs.topics import OBJECTS, is_kept
from spatial_replay.mapping.assemble import LiveAssembler, rehearse
from spatial_replay.mapping.mapping_file import LogMapping, Sampling, load_mapping
from spatial_replay.mapping.message_types import TRANSFORM_TYPES, short_type
from spatial_replay.mapping.reading_plan import ReadingPlan
from spatial_replay.monitor.doubtful import ClassMembers, doubts_about, needs_of_spec
from spatial_replay.monitor.ends import Needs, RunEnds
from spatial_replay.monitor.monitor import Ending, Monitor, NodeUpdate, SpecUpdate, Update, Violation
from spatial_replay.monitor.result import no_such_node
from spatial_replay.monitor.verdict import Verdict, worst_verdict
from spatial_replay.recording.clips import Trigger
from spatial_replay.recording.log import (
    RecorderLog,
    Recording,
    RunEnd,
    RunEvent,
    VerdictChange,
    VerdictChanges,
    refuse_templates,
    warm_up,
)
from spatial_replay.recording.recorder import Recorder, SampleWriter
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import listed_specifications
from spatial_replay.text import counted_from, plural
from spatial_replay.trace.doubts import Doubt, distinct_doubts
from spatial_replay.trace.trace import ABSENT, Sample, Trace

if TYPE_CHECKING:
    from spatial_replay.serve.server import RunServer


class ObjectsAssembler:
    """Decodes samples at their arrival, with the interface of `LiveAssembler`."""

    late = overdue = 0
    jump = None
    topics = (OBJECTS,)

    def __init__(self, name: str) -> None:
        self._name = name
        self._faults = FaultKinds()
        self._newest_ns = -1
        self._classes: dict[str, str | None] = {}
        self.is_finished = False

    def add(self, messages: Sequence[Message], now_s: float) -> Trace:
        """Decode messages in order of arrival to samples. Late and repeated samples are left out."""
        new_messages: list[Message] = []
        for message in messages:
            if message.log_time_ns < self._newest_ns - DISORDER_NS:
                self.is_finished = True
            if self.is_finished:
                break
            if message.log_time_ns > self._newest_ns:
                new_messages.append(message)
                self._newest_ns = message.log_time_ns
        times_ns = np.array([message.log_time_ns for message in new_messages], np.int64)
        trace, faults = decode_objects([message.payload for message in new_messages], times_ns)
        for fault in faults:
            self._faults.add(f"{self._name}: {fault}")
        if len(trace):
            named_rows = zip(trace.names, trace.rows[-1].tolist(), strict=True)
            present_rows = {name: row if row >= 0 else -2 - row for name, row in named_rows if row != ABSENT}
            self._classes = {
                name: trace.classes[int(trace.class_code[row])] for name, row in present_rows.items()
            }
        return trace

    def arrived_s(self, time_ns: int) -> float:
        """Return infinity, because samples do not wait."""
        return math.inf

    def due_s(self) -> None:
        """Return None, because no sample waits."""

    def flush(self) -> Trace:
        """Return no samples, because no sample waits."""
        return Trace.empty()

    def lose(self, topics: Collection[str], now_s: float) -> Trace:
        """Return a sample 1 ns after the newest sample, in which every object is unknown."""
        if self._newest_ns < 0 or not self._classes:
            return Trace.empty()
        self._newest_ns += 1
        unknown_classes, self._classes = self._classes, {}
        return Trace.from_samples([Sample(self._newest_ns, unknown=unknown_classes)])

    def finish(self) -> Trace:
        """Return no samples, because no sample remains."""
        return Trace.empty()

    def take_faults(self, *, last: bool = False) -> tuple[str, ...]:
        """Return the first fault of each new kind. With `last`, add counts of repeated faults."""
        return self._faults.take(last=last)

    def take_remarks(self) -> tuple[str, ...]:
        """Return no remarks."""
        return ()

    def find_doubts(self) -> tuple[Doubt, ...]:
        """Return no doubts: samples are read without a mapping."""
        return ()

    def take_doubts(self) -> tuple[Doubt, ...]:
        """Return no doubts, as `find_doubts`."""
        return ()


@dataclass(frozen=True, slots=True)
class SessionStatus:
    """State of a session.

    Attributes:
        server: name that the server gives itself; None before the first connection.
        is_connected: whether the connection is open.
        waits_for: needed topics that the server does not offer yet.
        samples, messages: numbers of evaluated samples and of received messages.
        dropped: number of samples that were dropped because evaluation fell behind.
        messages_dropped: number of messages that were dropped before they became samples.
        late: number of messages that arrived after the sample of their time was complete.
        overdue: number of observations whose transforms did not arrive within `max_delay_s`.
        delay_s: time from the arrival of the newest sample's message to the sample's verdict, seconds; NaN
            before the first sample.
        time_ns: time of the newest sample; None before the first sample.
    """

    server: str | None
    is_connected: bool
    waits_for: tuple[str, ...]
    samples: int
    messages: int
    dropped: int
    messages_dropped: int
    late: int
    overdue: int
    delay_s: float
    time_ns: int | None


@dataclass(frozen=True, eq=False)
class LiveUpdate:
    """Results of one sample.

    Attributes:
        sample: the objects and signals.
        changes: verdicts and signs that changed with this sample, each with its reason.
        notes: other events since the last update, such as a lost connection or a silent topic.
        delay_s: time from the arrival of the message that completed the sample to the sample's verdict,
            seconds.
        dropped: number of samples that were dropped so far.
        updates: update of the monitor of each specification file.
    """

    sample: Sample
    changes: tuple[VerdictChange, ...]
    notes: tuple[str, ...]
    delay_s: float
    dropped: int
    updates: tuple[Update, ...] = field(repr=False)

    @property
    def time_ns(self) -> int:
        """The time of the sample."""
        return self.sample.time_ns

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the specs."""
        return worst_verdict(update.verdict for update in self.updates)

    @property
    def specs(self) -> tuple[SpecUpdate, ...]:
        """The updates of all result specs."""
        return tuple(spec for update in self.updates for spec in update.specs)

    @cached_property
    def violations(self) -> tuple[Violation, ...]:
        """Permanent violations; see `Update.violations`."""
        return tuple(violation for update in self.updates for violation in update.violations)

    def node(self, name: str) -> NodeUpdate:
        """Return the root node of a named spec in any file.

        Raises:
            UsageError: no node has the name.
        """
        for update in self.updates:
            if name in update.places:
                return update.node(name)
        node_names = sorted(node_name for update in self.updates for node_name in update.places)
        raise UsageError(no_such_node(name, node_names))


MAX_DELAY_S: Final = 0.2
"""Default time that a sample waits for transforms and for lagging topics, seconds."""

LATE_S: Final = 1.0
"""Longest wait of a sample for evaluation, seconds; then the sample is dropped if a newer sample waits."""

_OFFER_S: Final = 5.0
"""Longest wait for the needed topics after a connection, seconds."""
_SETTLE_S: Final = 0.3
"""Wait for transforms and optional topics once the needed topics are offered, seconds."""

_STAMPING_SERVERS: Final = frozenset({"foxglove_bridge"})
"""Servers that stamp each message with the time of sending."""

_PAUSE_S: Final = 0.005
"""Pause before another attempt to reserve room in a full log, seconds."""

_SAMPLES_BEFORE_DOUBTS: Final = 100
"""Number of samples before a run is first compared with its mapping; each comparison doubles the number."""

_USUAL: Final = 9
"""Number of latest intervals between messages of a topic, whose median is the topic's usual interval."""

_GRACE_TURNS: Final = 5
"""Maximum number of iterations of the event loop that a deadline waits for arrived messages."""

_TURN_S: Final = 0.02
"""Time of evaluation between two polls of the inbox, seconds."""


class LiveSession:
    """One run of monitors over the messages of a server, in one event loop.

    Iterate over `updates` once; any task of the loop can `stop` it.
    """

    def __init__(
        self,
        address: str,
        specifications: Specification | Sequence[Specification],
        mapping: LogMapping | str | PathLike[str] | None = None,
        *,
        recorders: Sequence[SampleWriter] = (),
        topics: Sequence[str] = (),
        max_delay_s: float = MAX_DELAY_S,
        topic_timeout_s: float | None = None,
        start_within_s: float | None = None,
    ) -> None:
        """Compile the specifications before connecting; see `monitor` for the other arguments.

        Args:
            recorders: receivers of all samples, and of messages on `topics`; by default, on mapped topics.
        """
        for name, value in (
            ("max_delay_s", max_delay_s),
            ("topic_timeout_s", topic_timeout_s),
            ("start_within_s", start_within_s),
        ):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise UsageError(f"{name} is {value!r}; give seconds above 0")
        self.files = listed_specifications(specifications)
        if not self.files:
            raise UsageError("there is no specification to monitor; give one")
        self._address = address
        self._mapping = (
            mapping if mapping is None or isinstance(mapping, LogMapping) else load_mapping(mapping)
        )
        self._recorders = recorders
        # viewers may miss samples, a log may not
        self._logs = [recorder for recorder in recorders if isinstance(recorder, Recorder)]
        self._topics = tuple(topics)
        self._max_delay_s, self._topic_timeout_s = max_delay_s, topic_timeout_s
        units = {} if self._mapping is None else self._mapping.axes.units
        self._monitors = [Monitor(file, units=units) for file in self.files]
        self._changes = VerdictChanges(self.files)
        within_ns = None if start_within_s is None else round(start_within_s * 1e9)
        self._ends = RunEnds(Needs.of(self.files, {}), within_ns=within_ns)
        rehearse()
        self._assembler: LiveAssembler | ObjectsAssembler | None = None
        self._channels: tuple[Channel, ...] = ()
        self._planned_channels: dict[str, Channel] = {}
        self._offer_deadline_s = self._settle_deadline_s = math.inf
        self._last_message_s: dict[str, float] = {}
        # silent topics, with the times of their last messages
        self._silent_since_s: dict[str, float] = {}
        self._heard_topics: set[str] = set()
        self._rare_topics: set[str] = set()
        self._intervals_s: dict[str, deque[float]] = {}
        self._overdue_count = 0
        self._has_noted_overdue = False
        self._notes: list[str] = []
        self._missing_topics: tuple[str, ...] = ()
        self._server: str | None = None
        self._is_connected = False
        self.connected = asyncio.Event()
        """Set when the first connection is open."""
        self._sample_count = self._message_count = self._dropped_count = 0
        self._delay_s = math.nan
        self._time_ns: int | None = None
        self._is_stopped = False
        self._inbox: Inbox | None = None
        self._early_inbox = Inbox()
        self._refused_topics: set[str] = set()
        self._noted_diagnostics: set[Diagnostic] = set()
        self._members = ClassMembers(self._ends.needs.classes)
        self._is_closed = False
        self._next_doubt_sample = _SAMPLES_BEFORE_DOUBTS
        self._noted_doubts: set[tuple[str, str]] = set()
        self.remarks: tuple[str, ...] = ()
        self.doubts: tuple[Doubt, ...] = ()
        """Assumptions that the run contradicts; known after `close`, or at the end of `updates`."""
        self.failure: LogError | None = None
        """Error that ended the run because time jumped back; None for a run without a jump."""

    @property
    def status(self) -> SessionStatus:
        """The current state."""
        return SessionStatus(
            self._server,
            self._is_connected,
            self._missing_topics,
            self._sample_count,
            self._message_count,
            self._dropped_count,
            self._early_inbox.dropped + (0 if self._inbox is None else self._inbox.dropped),
            0 if self._assembler is None else self._assembler.late,
            0 if self._assembler is None else self._assembler.overdue,
            self._delay_s,
            self._time_ns,
        )

    def endings(self) -> tuple[Ending, ...]:
        """Return the result of each spec for a run that ends with the newest sample."""
        endings = (ending for monitor in self._monitors for ending in monitor.endings())
        return tuple(
            ending._replace(doubts=doubts_about(needs_of_spec(ending.spec), self.doubts, self._members))
            for ending in endings
        )

    def take_notes(self, *, last: bool = False) -> tuple[str, ...]:
        """Return the notes since the last update. With `last`, add counts of repeated faults."""
        self._note_overdue()
        if last and self._assembler is not None:
            self._notes += self._assembler.take_faults(last=True)
        notes, self._notes = tuple(self._notes), []
        return notes

    def _note_overdue(self) -> None:
        """Note an overdue transform, once in a run; before the run begins, overdue transforms are usual."""
        assembler = self._assembler
        if not isinstance(assembler, LiveAssembler) or assembler.overdue == self._overdue_count:
            return
        is_first = self._sample_count > 0 and not self._has_noted_overdue and self._is_connected
        self._overdue_count = assembler.overdue
        if is_first and assembler.overdue_frame is not None:
            topic, frame = assembler.overdue_frame
            self._has_noted_overdue = True
            self._notes.append(
                f"{topic} is unknown where no transform of {frame!r} came within {self._max_delay_s:g} s; if"
                " transforms come later or seldom, give --max-delay (max_delay_s) more"
            )

    def close(self) -> None:
        """Compare the run with its mapping's assumptions, if the caller left `updates` before the end."""
        if self._assembler is not None and not self._is_closed:
            self._assembler.finish()
            self._conclude(self._assembler)

    def _conclude(self, assembler: LiveAssembler | ObjectsAssembler) -> None:
        """Collect the doubts and remarks of a finished assembler."""
        self._is_closed = True
        first_ns = self._ends.begin_ns or 0
        self.doubts = distinct_doubts(assembler.take_doubts(), first_ns)
        remarks = counted_from(assembler.take_remarks(), first_ns)
        self.remarks = (*(doubt.remark(self._address) for doubt in self.doubts), *remarks)
        for log in self._logs:
            log.doubts = self.doubts

    def stop(self) -> None:
        """End `updates` after the arrived messages are evaluated."""
        self._is_stopped = True
        if self._inbox is not None:
            self._inbox.filled.set()

    async def updates(self) -> AsyncIterator[LiveUpdate]:
        """Yield an update for each sample, until stopped.

        Raises:
            RemoteError: the first connection fails.
            UsageError: the mapping does not fit the messages of the server.
            LogError: a topic changes its type, or a message cannot be sorted by time.
        """
        inbox = self._inbox = Inbox()
        client = Client(self._address, self._wants, inbox, self._record)
        client_task = asyncio.create_task(client.run())
        client_task.add_done_callback(lambda _: inbox.filled.set())
        # objects that are loaded by now stay, and garbage collection of these objects would delay samples:
        # https://docs.python.org/3/library/gc.html#gc.freeze
        gc.freeze()
        try:
            while not (self._is_stopped or self.failure):
                await self._wait(inbox)
                if client_task.done():
                    client_task.result()
                async for update in self._turn(inbox):
                    yield update
            if self._assembler is None and self._is_connected and not self.failure:
                # the run ends before all topics are offered: `_begin` reports the missing topics
                async for update in self._turn(inbox):
                    yield update
                if self._assembler is None:
                    self._begin(inbox, time.monotonic())
                async for update in self._turn(inbox):
                    yield update
            if self._assembler is not None:
                trace = self._assembler.finish()
                async for update in self._evaluate(trace, time.monotonic(), self._ends.finish):
                    yield update
                self._conclude(self._assembler)
        finally:
            client_task.cancel()
            with suppress(asyncio.CancelledError, Exception):
                await client_task

    # ------------------------------------------------------------------------------ arrivals

    def _wants(self, topic: str) -> bool:
        return self._is_evaluated(topic) or self._is_copied(topic)

    def _is_evaluated(self, topic: str) -> bool:
        if self._mapping is None:
            return topic == OBJECTS
        return topic in self._planned_channels or self._is_named(topic, self._mapping)

    def _is_named(self, topic: str, mapping: LogMapping) -> bool:
        # a client subscribes by names, so topics of transforms are recognised by their usual names
        is_frames = mapping.fixed_frame is not None and topic.rsplit("/", 1)[-1] in ("tf", "tf_static")
        return is_frames or topic in (mapping.sampling.topic, *(entry.topic for entry in mapping.topics))

    def _is_copied(self, topic: str) -> bool:
        return is_kept(topic, self._topics, ()) if self._topics else self._is_evaluated(topic)

    def _record(self, received: Received) -> None:
        """Copy a message to the recorders before it can be dropped."""
        channel = received.channel
        if not self._recorders or channel.topic in self._refused_topics or not self._is_copied(channel.topic):
            return
        for recorder in self._recorders:
            try:
                recorder.copy(channel, received.time_ns, received.payload)
            except UsageError as error:
                self._refused_topics.add(channel.topic)
                self._notes.append(f"{channel.topic} is not recorded: {error}")

    async def _wait(self, inbox: Inbox) -> None:
        """Wait for an item of the inbox, or for the next deadline."""
        now_s = time.monotonic()
        due_times_s = [self._settle_deadline_s, self._offer_deadline_s]
        if self._assembler is not None:
            due_times_s.append(self._assembler.due_s() or math.inf)
            if self._topic_timeout_s is not None:
                last_times_s = (
                    last_s
                    for topic, last_s in self._last_message_s.items()
                    if topic not in self._silent_since_s
                )
                due_times_s.append(min(last_times_s, default=math.inf) + self._topic_timeout_s)
        due_s = min(due_times_s)
        if inbox.filled.is_set() or due_s <= now_s:
            # the client gets a turn, even if many samples wait for evaluation
            await asyncio.sleep(0)
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(None if due_s == math.inf else due_s - now_s):
                await inbox.filled.wait()
        for _ in range(_GRACE_TURNS):
            # messages that arrived in time are not late, even if this process was delayed
            if inbox.filled.is_set():
                break
            await asyncio.sleep(0)

    async def _turn(self, inbox: Inbox) -> AsyncIterator[LiveUpdate]:
        """Process the items of the inbox, and evaluate the samples that are complete."""
        messages: list[Message] = []
        arrived_s = math.inf
        for arrival in inbox.take():
            if isinstance(arrival, Received):
                topic = arrival.channel.topic
                if self._assembler is None:
                    # messages that arrive before all topics are offered are evaluated after that
                    self._early_inbox.put(arrival)
                    continue
                if topic not in self._planned_channels:
                    continue
                self._message_count += 1
                arrived_s = min(arrived_s, arrival.arrived_s)
                self._note_return(topic, arrival.arrived_s)
                messages.append(Message(topic, arrival.time_ns, arrival.time_ns, 0, arrival.payload))
                continue
            # earlier messages are evaluated first, because this item may make their objects unknown
            async for update in self._evaluate(self._add(messages), arrived_s):
                yield update
            messages, arrived_s = [], math.inf
            match arrival:
                case Connected(server):
                    if self._server is not None:
                        self._notes.append(f"connected again to {self._address}")
                        # silence counts from the new connection on
                        self._last_message_s = dict.fromkeys(self._last_message_s, time.monotonic())
                    self._server, self._is_connected = server, True
                    self.connected.set()
                    self._offer_deadline_s = time.monotonic() + _OFFER_S
                case Offered(channels):
                    self._channels = tuple(channels)
                    self._plan()
                case Warned(text):
                    self._notes.append(text)
                case Disconnected(reason, at_s):
                    self._is_connected = False
                    self._offer_deadline_s = self._settle_deadline_s = math.inf
                    if self._assembler is None:
                        # the run begins after the pause, so that no value is held during the pause
                        self._early_inbox = Inbox()
                    else:
                        # pending samples are evaluated now, because a lost connection delivers no topic
                        trace = self._assembler.flush()
                        async for update in self._evaluate(trace, at_s, self._ends.release):
                            yield update
                    self._notes.append(
                        f"the connection to {self._address} is lost: {reason}; everything is unknown until"
                        " it is back"
                    )
                    unknown_trace = self._lose(list(self._planned_channels), "connection lost")
                    async for update in self._evaluate(unknown_trace, at_s, self._ends.release):
                        yield update
        async for update in self._evaluate(self._add(messages), arrived_s):
            yield update
        now_s = time.monotonic()
        if (
            self._assembler is None
            and self._is_connected
            and now_s >= min(self._offer_deadline_s, self._settle_deadline_s)
        ):
            self._begin(inbox, now_s)
        if silent := self._silent_topics(now_s):
            self._silent_since_s |= {topic: self._last_message_s[topic] for topic in silent}
            topic_names = ", ".join(silent)
            self._notes.append(
                f"no message on {topic_names} for {self._topic_timeout_s:g} s: what it reports is unknown"
            )
            unknown_trace = self._lose(silent, f"silence on {topic_names}")
            async for update in self._evaluate(unknown_trace, now_s, self._ends.release):
                yield update

    def _note_return(self, topic: str, arrived_s: float) -> None:
        """Store the time of a message on a topic; note a return after silence."""
        intervals_s = self._intervals_s.setdefault(topic, deque(maxlen=_USUAL))
        interval_s = arrived_s - self._last_message_s.get(topic, arrived_s)
        if topic in self._heard_topics:
            intervals_s.append(interval_s)
        self._heard_topics.add(topic)
        self._last_message_s[topic] = arrived_s
        if topic not in self._silent_since_s:
            return
        silent_s = arrived_s - self._silent_since_s.pop(topic)
        self._notes.append(f"a message on {topic} again, after {silent_s:.3g} s")
        usual_s = median(intervals_s) if len(intervals_s) > 1 else 0.0
        timeout_s = self._topic_timeout_s or math.inf
        if usual_s >= timeout_s and topic not in self._rare_topics:
            self._rare_topics.add(topic)
            self._notes.append(
                f"{topic} usually comes every {usual_s:.3g} s: with a timeout of {timeout_s:g} s, what it"
                " reports is unknown between its messages; give --topic-timeout (topic_timeout_s) more"
            )

    def _add(self, messages: Sequence[Message]) -> Trace | None:
        if self._assembler is None:
            return None
        trace = self._assembler.add(messages, time.monotonic())
        self._notes += self._assembler.take_faults()
        if self._assembler.is_finished and self.failure is None:
            jump_text = self._assembler.jump or "time jumps back by more than a second"
            self.failure = LogError(
                f"{self._address}: {jump_text}, as when a simulation or a player starts again; the run ends"
                " there: start the monitor again"
            )
        return trace

    def _lose(self, topics: Sequence[str], event_name: str) -> Trace | None:
        """Make the objects of some topics unknown; report an event whose sentence is the newest note."""
        if self._assembler is None:
            return None
        trace = self._assembler.lose(topics, time.monotonic())
        time_ns = int(trace.times_ns[-1]) if len(trace) else self._time_ns
        if time_ns is not None:
            for recorder in self._recorders:
                recorder.report(RunEvent(time_ns, event_name, self._notes[-1]))
        return trace

    def _silent_topics(self, now_s: float) -> list[str]:
        """Return the topics that exceed the timeout and are not yet noted as silent."""
        if self._topic_timeout_s is None or self._assembler is None or not self._is_connected:
            return []
        watched_topics = [topic for topic in self._assembler.topics if topic not in self._silent_since_s]
        return [
            topic
            for topic in watched_topics
            if now_s - self._last_message_s.get(topic, now_s) >= self._topic_timeout_s
        ]

    # -------------------------------------------------------------------------------- planning

    def _plan(self) -> None:
        """Find the topics of the mapping among the offered topics."""
        channels = {channel.topic: channel for channel in self._channels}
        if self._assembler is not None:
            changed_topics = [
                topic
                for topic, channel in self._planned_channels.items()
                if topic in channels and channels[topic] != channel
            ]
            if changed_topics:
                raise LogError(
                    f"{self._address}: {', '.join(changed_topics)} has another type or definition than"
                    " before; start the monitor again"
                )
            self._missing_topics = tuple(topic for topic in self._planned_channels if topic not in channels)
            return
        if self._mapping is None:
            needed_topics = [OBJECTS]
        else:
            needed_topics = [entry.topic for entry in self._mapping.topics if not entry.optional]
            needed_topics += [
                sampled_topic for sampled_topic in [self._mapping.sampling.topic] if sampled_topic is not None
            ]
        self._missing_topics = tuple(topic for topic in dict.fromkeys(needed_topics) if topic not in channels)
        # transforms and optional topics are often offered a little later
        self._settle_deadline_s = math.inf if self._missing_topics else time.monotonic() + _SETTLE_S

    def _begin(self, inbox: Inbox, now_s: float) -> None:
        """Begin to assemble samples from the offered topics, from the earliest message on."""
        self._offer_deadline_s = self._settle_deadline_s = math.inf
        channels = {channel.topic: channel for channel in self._channels}
        if self._mapping is None:
            if OBJECTS not in channels:
                raise UsageError(
                    f"{self._address} has no topic {OBJECTS}; give --mapping FILE (`mapping=`) to say which"
                    f" topics carry which objects: {', '.join(sorted(channels)[:20]) or 'it has none'}"
                )
            self._assembler, self._planned_channels = (
                ObjectsAssembler(self._address),
                {OBJECTS: channels[OBJECTS]},
            )
        else:
            topics = topics_by_name(map(topic_of, self._channels))
            try:
                plan = ReadingPlan.of(self._mapping, topics)
            except UsageError as error:
                raise UsageError(str(error).replace("the log has", "the server offers")) from None
            topic_by_name = {topic.name: topic for topic in topics}
            self._assembler = LiveAssembler(
                plan,
                lambda topic: decoder_of(topic_by_name[topic]),
                name=self._address,
                max_delay_s=self._max_delay_s,
                in_order=self._server in _STAMPING_SERVERS,
            )
            self._planned_channels = {topic: channels[topic] for topic in plan.topics}
            unheard_topics = [
                topic.name
                for topic in topics
                if topic.name in self._planned_channels
                and short_type(topic.type) in TRANSFORM_TYPES
                and not self._is_named(topic.name, self._mapping)
            ]
            if unheard_topics:
                self._notes.append(
                    f"transforms on {', '.join(unheard_topics)} are not listened to: map the topic"
                )
        self._last_message_s = dict.fromkeys(self._assembler.topics, now_s)
        self._notes.append(
            f"connected to {self._address}{f' ({self._server})' if self._server else ''}:"
            f" {plural(len(self._planned_channels), 'topic')}"
        )
        if (sampled_topic := self._sampled_by_default()) is not None:
            self._notes.append(
                f"samples are taken at {sampled_topic}, the first topic with objects; a bag is sampled at the"
                f" most frequent one: `sample: {{topic: {sampled_topic}}}` in the mapping takes the same"
            )
        self._early_inbox, early_inbox = Inbox(), self._early_inbox
        for arrival in early_inbox.take():
            # the wait for the beginning does not count as late evaluation
            inbox.put(arrival._replace(arrived_s=now_s) if isinstance(arrival, Received) else arrival)

    def _sampled_by_default(self) -> str | None:
        """Return the topic at which samples are taken; None if a bag is surely sampled there, too."""
        if self._mapping is None or self._mapping.sampling != Sampling():
            return None
        entries = [entry for entry in self._mapping.topics if entry.topic in self._planned_channels]
        candidate_topics = {entry.topic for entry in entries if entry.reads_objects} or {
            entry.topic for entry in entries
        }
        first_topic = next((entry.topic for entry in entries if entry.topic in candidate_topics), None)
        return first_topic if len(candidate_topics) > 1 else None

    # ------------------------------------------------------------------------------ evaluating

    async def _evaluate(
        self, trace: Trace | None, arrived_s: float, remaining: Callable[[], list[Trace]] | None = None
    ) -> AsyncIterator[LiveUpdate]:
        """Evaluate samples, and yield their updates; late samples are dropped if newer samples wait.

        Args:
            remaining: function that returns pending samples of `RunEnds`, which are evaluated, too.
        """
        if trace is not None:
            trace = self._relevant_samples(trace, remaining)
        if trace is None or not len(trace):
            return
        turn_start_s = time.monotonic()
        last_ns = int(trace.times_ns[-1])
        for sample in trace.samples():
            # the log must hold each evaluated sample; while the log is full, the inbox drops messages
            while not all(log.reserve() for log in self._logs):
                await asyncio.sleep(_PAUSE_S)
            now_s = time.monotonic()
            # the newest sample is never dropped
            if now_s - arrived_s > LATE_S and sample.time_ns != last_ns:
                self._dropped_count += 1
                for recorder in self._recorders:
                    recorder.miss(sample)
                continue
            if now_s - turn_start_s > _TURN_S:
                await asyncio.sleep(0)
                turn_start_s = now_s
            yield self._update(sample, arrived_s)

    def _relevant_samples(self, trace: Trace, remaining: Callable[[], list[Trace]] | None) -> Trace:
        """Return the samples that are ready for evaluation.

        The run begins once all needed topics can be judged. While a needed topic cannot be judged, samples
        wait, because the run may have ended.
        """
        self._members.add(trace)
        run_ends = self._ends
        had_begun, remarks = run_ends.begin_ns is not None, run_ends.remarks
        # samples are added one by one, so that no sample waits for a later sample
        samples = [trace.slice(index, index + 1) for index in range(len(trace))]
        run_traces = [
            run_trace
            for new_trace in (samples if had_begun else [trace])
            for run_trace in run_ends.add(new_trace)
        ]
        if remaining is not None:
            run_traces += remaining()
        if run_ends.begin_ns is not None:
            self._notes += counted_from(run_ends.remarks[len(remarks) :], run_ends.begin_ns)
            if run_ends.late and not had_begun:
                topic_names = ", ".join(run_ends.late)
                self._notes.append(
                    f"the run begins although {topic_names} cannot be judged yet: until then, what it"
                    " reports is unknown, and groups lack its objects; --start-within (start_within_s)"
                    " waits longer"
                )
        return run_traces[0] if len(run_traces) == 1 else Trace.concatenate(run_traces)

    def _note_doubts(self) -> None:
        """Note new contradictions of the run to its mapping; compare again after twice as many samples."""
        self._next_doubt_sample *= 2
        if self._assembler is None:
            return
        for doubt in distinct_doubts(self._assembler.find_doubts(), self._ends.begin_ns or 0):
            if (doubt.assumption, doubt.topic) not in self._noted_doubts:
                self._noted_doubts.add((doubt.assumption, doubt.topic))
                self._notes.append(doubt.remark(self._address))

    def _update(self, sample: Sample, arrived_s: float) -> LiveUpdate:
        updates = tuple(monitor.update(sample) for monitor in self._monitors)
        for monitor in self._monitors:
            monitor.note_unknown()
        for remark in itertools.chain.from_iterable(update.remarks for update in updates):
            if remark not in self._noted_diagnostics:
                self._noted_diagnostics.add(remark)
                self._notes.append(
                    f"{remark.filename}:{remark.line}:{remark.column}: {remark.message}; {remark.hint}"
                )
        self._sample_count += 1
        if self._sample_count >= self._next_doubt_sample:
            self._note_doubts()
        self._time_ns = sample.time_ns
        now_s = time.monotonic()
        if self._assembler is not None:
            arrived_s = min(arrived_s, self._assembler.arrived_s(sample.time_ns))
        # the arrival time of a sample is infinite if no message completed the sample
        self._delay_s = max(0.0, now_s - min(arrived_s, now_s))
        for recorder in self._recorders:
            recorder.write(sample)
        changes = tuple(self._changes.after(updates))
        return LiveUpdate(sample, changes, self.take_notes(), self._delay_s, self._dropped_count, updates)


_WAITING = 65_536
"""Maximum number of waiting samples, and of waiting messages: a robot does not wait for a disk."""


class _RunRecorder(Recorder):
    """A recorder of a live run; it drops samples only beyond `_WAITING`, also on a slow disk."""

    most_lost_s: ClassVar[float] = math.inf


@contextmanager
def open_recorders(
    files: Sequence[Specification],
    mapping: LogMapping | None,
    output: Path | None = None,
    trigger: Trigger | None = None,
    clips: Path | None = None,
    *,
    overwrite: bool = False,
) -> Iterator[list[Recorder]]:
    """Open a recorder of the whole run for `output`, and a recorder of clips for `clips`.

    Raises:
        UsageError: only one of trigger and clips is given, the trigger is invalid, or an output exists
            without `overwrite`.
        OutputError: a log cannot be written.
    """
    if (trigger is None) != (clips is None):
        raise UsageError("clips take a trigger and a folder; give both")
    metadata = _about(mapping)
    with ExitStack() as stack:
        recorders: list[Recorder] = [
            stack.enter_context(
                _RunRecorder(
                    path,
                    specifications=files,
                    about=metadata,
                    waiting=_WAITING,
                    block=False,
                    trigger=trigger_of_path,
                    overwrite=overwrite,
                )
            )
            for path, trigger_of_path in ((output, None), (clips, trigger))
            if path is not None
        ]
        yield recorders


def _about(mapping: LogMapping | None) -> Mapping[str, str]:
    """Return the metadata of a run for its log; no entry depends on the machine."""
    if mapping is None:
        return {"source": "live"}
    mapping_metadata = {"mapping": mapping.name, "mapping_sha256": mapping.sha256}
    return {"source": "live", **mapping_metadata, **mapping.axes.metadata()}


async def monitor(
    address: str,
    specifications: Specification | Sequence[Specification],
    mapping: LogMapping | str | PathLike[str] | None = None,
    *,
    output: str | PathLike[str] | None = None,
    trigger: Trigger | None = None,
    clips: str | PathLike[str] | None = None,
    topics: Sequence[str] = (),
    max_delay_s: float = MAX_DELAY_S,
    topic_timeout_s: float | None = None,
    start_within_s: float | None = None,
    overwrite: bool = False,
) -> AsyncIterator[LiveUpdate]:
    """Monitor a running robot; yield an update for each sample.

    After a lost connection, the client connects again; all objects and signals are unknown until then. Leave
    the loop to end the run; its log is then closed.

    Args:
        address: address of foxglove_bridge or another server of Foxglove's WebSocket protocol, such as
            ws://robot:8765.
        mapping: mapping as for a log of the same topics; without a mapping, the server needs
            /spatial/objects.
        output: path of a log of samples and messages, which is written as `Recorder` does.
        trigger, clips: trigger of clips, which are logs of a part of the run, and the folder of clips.
        topics: patterns of topics whose messages are written; by default, the mapped topics.
        max_delay_s: longest wait of a sample for transforms, and for topics whose stamps lag, seconds.
        topic_timeout_s: silence of a topic after which its objects are unknown, seconds.
        start_within_s: longest wait of the run for each topic that the specification needs, seconds; by
            default, the `max_age` of the topic.
        overwrite: whether to replace an existing output.

    Raises:
        UsageError: a template, an invalid option, a mapping that does not fit the messages, or an existing
            output.
        RemoteError: the first connection fails.
        LogError: time jumps back by more than a second.
        OutputError: the log cannot be written.
    """
    files = listed_specifications(specifications)
    if mapping is not None and not isinstance(mapping, LogMapping):
        mapping = load_mapping(mapping)
    outputs = None if output is None else Path(output), trigger, None if clips is None else Path(clips)
    with open_recorders(files, mapping, *outputs, overwrite=overwrite) as recorders:
        session = LiveSession(
            address,
            files,
            mapping,
            recorders=recorders,
            topics=topics,
            max_delay_s=max_delay_s,
            topic_timeout_s=topic_timeout_s,
            start_within_s=start_within_s,
        )
        try:
            async for update in session.updates():
                yield update
        finally:
            # closing adds the doubts to the log, even if the caller left the loop
            session.close()
        if session.failure is not None:
            raise session.failure


_GATHER_S: Final = 1 / 30
"""Time in which samples for viewers are gathered before they are sent, seconds."""

_MOST_WAITING: Final = 4_096


class _ViewerLog(RecorderLog):
    """The log of a run for viewers: messages are sent and not stored, and viewers may miss some."""

    gather_s = _GATHER_S

    def __init__(self, files: Sequence[Specification], about: Mapping[str, str], server: RunServer) -> None:
        self._server = server
        self._sink = MemorySink()
        self._recording = Recording(self._sink, files, about)
        warm_up(files, self._recording.automata)

    def add(self, samples: Sequence[Sample], trace: Trace, messages: Messages) -> None:
        """Send the next samples and messages, and the results of the samples."""
        self._recording.add(trace, messages)
        self._publish()
        if len(trace):
            self._server.send_time(int(trace.times_ns[-1]))

    def report(self, event: RunEvent) -> None:
        """Send an event of the run, such as a lost connection."""
        self._recording.report(event)
        self._publish()

    def end(self, end: RunEnd) -> None:
        """Send the events at the end."""
        self._recording.end(end)
        self._publish()

    def _publish(self) -> None:
        for message in self._sink.messages:
            self._server.publish(message)
        self._sink.messages.clear()


class Viewing(SampleWriter):
    """A writer that shows a run to viewers; it is one of a session's recorders."""

    def __init__(self, files: Sequence[Specification], about: Mapping[str, str], server: RunServer) -> None:
        """Compile the specifications."""
        refuse_templates(files)
        self.address = server.address
        super().__init__(_ViewerLog(files, about, server), "the view", _MOST_WAITING, block=False)


@contextmanager
def open_viewing(
    files: Sequence[Specification],
    mapping: LogMapping | None,
    *,
    host: str,
    port: int,
    origins: Sequence[str] = (),
    fire: Callable[[str], None] | None = None,
) -> Iterator[Viewing]:
    """Serve a live run to viewers, as a context.

    Args:
        port: port of the server; 0 for any free port.
        origins: origins of web pages that may connect, in addition to Foxglove and this machine.
        fire: function that the service `trigger` calls with the given reason.

    Raises:
        UsageError: the server cannot listen on host and port, an origin is invalid, or foxglove-sdk is not
            installed.
    """
    with importing("serving takes foxglove-sdk", extra="live"):
        from spatial_replay.serve.server import RunServer
    channels = [*Recording(MemorySink(), files).channels, OBJECTS_CHANNEL]
    server = RunServer(channels, host, port, fire, origins)
    try:
        viewing = Viewing(files, _axes(mapping), server)
        try:
            yield viewing
        finally:
            viewing.close()
    finally:
        server.stop()


def layout_of_run(files: Sequence[Specification], mapping: LogMapping | None) -> str:
    """Return the layout for viewers of a live run, as JSON, with curves and states that grow.

    Raises:
        UsageError: a template, because its objects are not known before the run.
    """
    recording = Recording(MemorySink(), files, _axes(mapping))
    return recording.layout_ahead().data.decode()


def _axes(mapping: LogMapping | None) -> Mapping[str, str]:
    return {} if mapping is None else mapping.axes.metadata()
