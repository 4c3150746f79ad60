"""Recorders: samples of a running loop, written to a log that is closed properly after a signal."""

from __future__ import annotations

import math
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, ClassVar, Self

from spatial_replay.errors import OutputError, SpatialReplayError, TraceError, UsageError
from spatial_replay.logs.messages import Channel, Messages
from spatial_replay.logs.output_file import Durability, refuse_inputs
from spatial_replay.recording.clips import ClipLog, Trigger, TriggeredClip
from spatial_replay.recording.foreign_channels import SchemaLike, check_topic, message_channel
from spatial_replay.recording.interruption import terminable, uninterrupted
from spatial_replay.recording.log import FileLog, RecorderLog, RunEnd, RunEvent, encodable, refuse_templates
from spatial_replay.recording.message_queue import PAUSE_S, MessageChannel, MessageQueue
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import listed_specifications
from spatial_replay.text import named_arguments, times_apart
from spatial_replay.trace.doubts import Doubt
from spatial_replay.trace.trace import Sample, Trace, checked_units, require_sample
from spatial_replay.trace.units import Axes

if TYPE_CHECKING:
    from spatial_replay.planning.decision_log import BlackBox
    from spatial_replay.planning.decisions import Outcome, Step
    from spatial_replay.planning.planner import Planner


FLUSH_S = 0.3
"""Interval between two flushes to the operating system, s."""

MOST_LOST_S = 0.8
"""Largest age of an unflushed sample, s. From this age on, `write` waits or drops samples (see `block`).

In a campaign, each of 2,468 kills lost at most 0.79 s of samples (docs/reliability.md).
"""

_TOGETHER = 1024
"""Maximum number of samples that are encoded at once."""


class SampleWriter:
    """Samples and messages from the caller's threads that wait for the writing thread.

    Attributes:
        dropped: number of samples not recorded, because the queue was full or `miss` received them.
        doubts: assumptions that the source contradicts, which are written at the end of the log.
    """

    def __init__(
        self, log: RecorderLog, name: str, waiting: int, *, block: bool, most_lost_s: float = math.inf
    ) -> None:
        """Start the writing thread.

        Args:
            name: name of the log, for errors.
            waiting: maximum number of waiting samples, and maximum number of waiting messages.
            block: whether `write` waits while the queue is full or `most_lost_s` is reached. Otherwise,
                `write` drops and counts new samples.
            most_lost_s: largest age of an unflushed sample, s; a kill loses unflushed samples.
        """
        self._log, self.name = log, name
        # a SimpleQueue is reentrant: an interruption never leaves it locked, unlike a Queue with a limit
        # (https://docs.python.org/3/library/queue.html#queue.SimpleQueue.put)
        self._queue: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._waiting_limit = waiting
        # half a batch wakes the writing thread
        self._wake_count = max(1, min(waiting, _TOGETHER) // 2)
        self._blocks = block
        self._most_lost_s = most_lost_s
        self._is_reserved = False
        self._events: queue.SimpleQueue[RunEvent] = queue.SimpleQueue()
        count_missed = partial(log.miss, kind="message")
        self._messages = MessageQueue(name, waiting, blocks=block, ring=self._ring, missed=count_missed)
        self.dropped = 0
        self.doubts: tuple[Doubt, ...] = ()
        self._last_ns = self._queued_ns = -1
        self._unflushed_since_s: float | None = None
        self._drains_messages = False
        # a daemon, so that a program that never closes its recorder can end
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    @property
    def messages_dropped(self) -> int:
        """Number of dropped messages, over all channels."""
        return self._messages.dropped

    def reserve(self) -> bool:
        """Return whether the queue has room; the next `write` then accepts its sample without waiting."""
        # after a failure, the next `write` raises the error at once
        self._is_reserved = self._messages.failure is not None or not self._is_behind()
        return self._is_reserved

    def copy(self, channel: Channel, time_ns: int, payload: bytes) -> None:
        """Queue an encoded message of another program; `time_ns` is its publish time.

        Raises:
            UsageError: a topic of this package, a topic that is open with another definition, or a closed
                recorder.
            OutputError: an earlier sample or message could not be written.
        """
        message_channel = self._messages.channels.get(channel.topic)
        if message_channel is None or message_channel.declaration != channel:
            check_topic(channel.topic)
            message_channel = self._messages.channel(channel)
        message_channel.copy(time_ns, payload)

    def write(self, sample: Sample) -> None:
        """Queue the next sample; return at once unless the queue is full.

        Raises:
            TraceError: a time that is not after the previous sample's time.
            OutputError: an earlier sample could not be written.
            UsageError: not a sample, or the recorder is closed.
        """
        require_sample(sample)
        self._messages.require_open()
        if sample.time_ns <= self._last_ns:
            time_text, last_time_text = times_apart(sample.time_ns, self._last_ns)
            raise TraceError(
                f"a sample at {time_text} follows one at {last_time_text}; give times that increase"
            )
        self._last_ns = sample.time_ns
        is_reserved, self._is_reserved = self._is_reserved, False
        while not is_reserved and self._is_behind():
            if not self._blocks:
                self.miss(sample)
                return
            self._messages.raise_failure()
            time.sleep(PAUSE_S)
        if self._unflushed_since_s is None:
            self._unflushed_since_s = time.monotonic()
        self._queue.put(sample)
        self._queued_ns = sample.time_ns
        if self._queue.qsize() >= self._wake_count:
            self._ring()

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest sample; None before the first sample."""
        return None if self._last_ns < 0 else self._last_ns

    def miss(self, sample: Sample) -> None:
        """Count a sample that is not recorded."""
        self.dropped += 1
        self._log.miss(sample.time_ns, kind="sample")

    def report(self, event: RunEvent) -> None:
        """Queue an external event of the run; call it from the thread that writes samples."""
        self._events.put(event)
        self._ring()

    def _is_behind(self) -> bool:
        """Return whether too many samples wait, or the oldest unflushed sample is too old."""
        if self._queue.qsize() + self._log.backlog >= self._waiting_limit:
            return True
        unflushed_since_s = self._unflushed_since_s
        return unflushed_since_s is not None and time.monotonic() - unflushed_since_s > self._most_lost_s

    def close(self, *, interrupted: bool = False) -> None:
        """Write all waiting samples and finish the log.

        A second call, or a call in a forked process, has no effect.

        Raises:
            OutputError: a sample or message could not be written.
        """
        with uninterrupted():
            # a forked process has no writing thread
            if os.getpid() != self._messages.process:
                return
            with self._messages.lock:
                if self._messages.is_closed:
                    return
                self._messages.is_closed = True
            self._queue.put(None)
            self._ring()
            self._thread.join()
            self._finish(interrupted=interrupted)
        self._messages.raise_failure()

    def _finish(self, *, interrupted: bool) -> None:
        """Write the end of the log; after a failure, try to write an end that states the failure."""
        end = RunEnd(interrupted, self.dropped, self._messages.dropped, self.doubts)
        try:
            if self._messages.failure is not None:
                with suppress(Exception):
                    self._log.break_off(end)
            else:
                self._log.end(end)
        finally:
            self._log.close()

    def _work(self) -> None:
        """Encode and write waiting samples, until `close`."""
        self._try(self._write_waiting)

    def _write_waiting(self) -> None:
        flushed_s = drained_s = time.monotonic()
        is_ended = False
        while not is_ended:
            now_s = time.monotonic()
            samples, is_ended = self._waiting_samples()
            # after a full batch, the remaining samples may have waited since the last complete drain
            drained_s = now_s if len(samples) < _TOGETHER else drained_s
            self._record(samples, self._messages.take())
            self._report_events()
            # a decision is written before the samples that follow it
            while self._drains_messages and len(messages := self._messages.take()):
                self._record([], messages)
            if self._messages.failure is None and time.monotonic() - flushed_s >= FLUSH_S:
                self._try(self._log.flush)
                flushed_s = time.monotonic()
                self._unflushed_since_s = drained_s if self._queue.qsize() else None
        # messages that were queued until the recorder was closed
        while len(messages := self._messages.take()):
            self._record([], messages)

    def _report_events(self) -> None:
        with suppress(queue.Empty):
            while self._messages.failure is None:
                event = self._events.get_nowait()
                self._try(partial(self._log.report, event))

    def _record(self, samples: Sequence[Sample], messages: Messages) -> None:
        """Encode and write samples and messages. After a failure, they are dropped."""
        if self._messages.failure is not None or not (samples or len(messages) or self._log.is_busy):
            return
        try:
            trace = Trace.from_samples(samples)
        except Exception as error:
            # only the samples before the faulty sample are written
            encodable_samples = encodable(samples)
            self._try(
                lambda: self._log.add(encodable_samples, Trace.from_samples(encodable_samples), messages)
            )
            self._fail(error)
        else:
            self._try(lambda: self._log.add(samples, trace, messages))

    def _try(self, write_step: Callable[[], None]) -> None:
        """Run a step of the writing thread; an error becomes the failure of the recorder."""
        try:
            write_step()
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Store an error for the next `write` to raise, because errors of this thread would go unnoticed."""
        if not isinstance(error, SpatialReplayError):
            failure_text = f"a sample or message could not be written ({type(error).__name__}: {error})"
            failure = OutputError(f"{self.name} ends here: {failure_text}")
            failure.__cause__ = error
            error = failure
        self._messages.failure = error

    def _ring(self) -> None:
        """Wake the writing thread before the end of its gathering time."""
        if self._bell.empty():
            self._bell.put(None)

    def _waiting_samples(self) -> tuple[list[Sample], bool]:
        """Return gathered samples, and whether the log ends after these samples."""
        if self._queue.qsize() < self._wake_count and not self._log.is_busy:
            with suppress(queue.Empty):
                self._bell.get(timeout=self._log.gather_s)
        samples: list[Sample] = []
        with suppress(queue.Empty):
            while len(samples) < _TOGETHER:
                sample = self._queue.get_nowait()
                if sample is None:
                    return samples, True
                samples.append(sample)
        return samples, False


@named_arguments
class Recorder(SampleWriter):
    """Record samples into an MCAP log, with the robustness of specifications.

    The log is written in place. If the process is killed, samples are lost only if `write` received them less
    than a second before, also on a busy machine. The end of the `with` block closes the log. After an error
    or Ctrl-C the closed log is marked as interrupted. SIGTERM has the same effect: in a `with` block of the
    main thread it raises SystemExit(143), unless the program handles SIGTERM. A signal that arrives during
    the closing is delayed until the log is closed.

    With a trigger, samples wait in memory until the trigger fires. Each firing writes one log of the time
    before and after the firing.
    With a planner, the log also has its decisions. Samples, decisions and outcomes then go through the
    recorder in their order, as in `plan(planner, robot, recorder)`.

    Use as:

        with Recorder("run.mcap", specifications=[spec]) as recorder:
            joints = recorder.channel("/joint_states")
            joints.write(time_ns, {"position": [0.1, 0.2]})
            recorder.write(sample)
    """

    most_lost_s: ClassVar[float] = MOST_LOST_S

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        specifications: Specification | Sequence[Specification] = (),
        about: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        waiting: int = 4096,
        block: bool = True,
        trigger: Trigger | None = None,
        durability: Durability = "process",
        planner: Planner | None = None,
        overwrite: bool = False,
    ) -> None:
        """Begin a log.

        Returns when the first sample can be written without delay. The first call on a machine compiles
        numerical code, which takes many seconds.

        Args:
            path: path of the log or, with a trigger, of the folder for its logs.
            specifications: one or several specifications without templates, evaluated as samples arrive.
            about: further metadata of the log, such as a seed or the origin of the samples.
            units: units of signals by name, and of lengths by "", for sentences, axes and viewers.
            waiting: maximum number of waiting samples, and maximum number of waiting messages of channels.
            block: whether `write` waits while the queue is full or, without a trigger, while more than 0.8 s
                of samples have not reached the operating system. Otherwise new samples are dropped, and the
                log counts them.
            trigger: condition for writing clips instead of the whole run.
            durability: "process" for a log that survives a crash of the process. "disk" for a log that also
                survives a crash of the machine: each flush waits for the disk (fsync).
            planner: planner that observes the written samples; its decisions are recorded, see `next_step`.
            overwrite: whether to replace an existing file that is not empty.

        Raises:
            UsageError: a specification that cannot be recorded, units that are not texts, a limit below 1, a
                trigger that names no spec, a planner with a trigger or without `block`, or an existing file.
            OutputError: the file cannot be written.
        """
        if waiting < 1:
            raise UsageError(f"waiting is {waiting}; give 1 or more samples")
        files = listed_specifications(specifications)
        if planner is not None and planner.specification not in files:
            files.insert(0, planner.specification)
        refuse_templates(files)
        about = {**(about or {}), **Axes.of_units(checked_units(units)).metadata()}
        self._path = Path(path)
        self._clips: ClipLog | None = None
        if trigger is None:
            refuse_inputs(self._path, ())
            log: RecorderLog = FileLog(self._path, files, about, durability, overwrite=overwrite)
        else:
            log = self._clips = ClipLog(self._path, files, about, trigger)
        self._exit_stack = ExitStack()
        self._files = tuple(files)
        self._box: BlackBox | None = None
        # with a trigger, samples stay in memory on purpose, so their age is not limited
        most_lost_s = self.most_lost_s if trigger is None else math.inf
        super().__init__(log, self._path.name, waiting, block=block, most_lost_s=most_lost_s)
        if planner is not None:
            self.attach(planner)

    @property
    def planner(self) -> Planner | None:
        """The planner whose decisions are recorded."""
        return None if self._box is None else self._box.planner

    def attach(self, planner: Planner, *, timings: bool = False) -> None:
        """Let a planner observe every further sample, and record its decisions.

        Args:
            timings: also record the duration of each decision.

        Raises:
            UsageError: the recorder already has a planner, has a trigger, drops samples, or does not record
                the planner's specification; or the planner has observed samples.
        """
        # the import is late, because a recorder without a planner does not need the planner's code
        from spatial_replay.planning.decision_log import BlackBox

        self._refuse_planner(planner)
        self._box = BlackBox(planner, self._write_decision, timings=timings)
        self._drains_messages = True

    def _refuse_planner(self, planner: Planner) -> None:
        if self._box is not None:
            raise UsageError(f"{self.name} has a planner already; open another recorder")
        if self._clips is not None or not self._blocks:
            remedy = "open a Recorder without a trigger, and with block=True"
            raise UsageError(f"{self.name} may drop samples, and decisions depend on all of them; {remedy}")
        if planner.specification not in self._files:
            filename, remedy = planner.specification.filename, "open the Recorder with planner=planner"
            raise UsageError(f"{self.name} does not record {filename}, the planner's specification; {remedy}")
        if self._last_ns >= 0 or planner.has_observed:
            raise UsageError("decisions depend on all samples; attach a new planner before the first one")

    def write(self, sample: Sample) -> None:
        """Queue the next sample, and let the planner observe it.

        Returns at once unless the queue is full.

        Raises:
            TraceError: a time that is not after the previous sample's time.
            OutputError: an earlier sample could not be written.
            UsageError: not a sample, a closed recorder, or settings of the planner that do not fit the first
                sample.
        """
        super().write(sample)
        if self._box is not None:
            is_first = not self._box.planner.has_observed
            self._box.observe(sample)
            # settings may depend on the first sample
            if is_first and isinstance(self._log, FileLog):
                planner = self._box.planner
                self._log.add_plan(planner, self._files.index(planner.specification))

    def next_step(self) -> Step:
        """Return the planner's next step, and record it with its inputs.

        Raises:
            UsageError: there is no planner, no sample was written yet, or the last step was not concluded.
            OutputError: an earlier sample or message could not be written.
        """
        return self._require_box().next_step()

    def conclude(self, outcome: Outcome) -> None:
        """Record the outcome of the last step, after the samples of its motion.

        Raises:
            UsageError: there is no planner, the argument is no outcome, or no step is being executed.
            OutputError: an earlier sample or message could not be written.
        """
        self._require_box().conclude(outcome)

    def _require_box(self) -> BlackBox:
        if self._box is None:
            raise UsageError(f"{self.name} has no planner; open the Recorder with planner=planner")
        return self._box

    def _write_decision(self, messages: Messages) -> None:
        for row in messages.rows():
            self._messages.channel(messages.channels[row.channel]).copy(row.log_time_ns, row.payload)

    def channel(
        self,
        topic: str,
        *,
        schema: SchemaLike = None,
        encoding: str | None = None,
        schema_name: str | None = None,
        schema_encoding: str | None = None,
    ) -> MessageChannel:
        """Open a topic for your own messages, which are recorded next to the samples.

        A replay copies the messages, and the certificate covers them. A topic that is already open gives the
        same channel.

        Args:
            topic: name such as "/joint_states". Topics under /spatial and the topics of a planner are
                reserved.
            schema: a JSON schema (dict or text), a protobuf class, or the encoding's kind of definition (text
                or bytes). The encodings json, cbor and msgpack need no schema. Messages are not checked
                against the schema.
            encoding: "json", "protobuf", "ros1", "cdr", "cbor", "msgpack" or "flatbuffer". The default is
                "protobuf" for a protobuf class, else "json".
            schema_name: type of the messages. The default is the name of a protobuf class, or the title of a
                JSON schema.
            schema_encoding: "ros2msg" (default), "ros2idl" or "omgidl" for the encoding "cdr".

        Raises:
            UsageError: a reserved topic, an unknown encoding, a schema that does not fit, a topic that is
                open with another definition, or a closed recorder.
            OutputError: an earlier sample or message could not be written.
        """
        return self._messages.channel(message_channel(topic, encoding, schema, schema_name, schema_encoding))

    def trigger(self, reason: str = "by hand") -> None:
        """Fire the trigger now, regardless of its condition; any thread or signal handler may call it.

        The clip is around the newest sample or message at the call. If there is none yet, the clip is around
        the first one that arrives.

        Raises:
            UsageError: the recorder has no trigger.
        """
        if self._clips is None:
            raise UsageError(f"{self.name} is written as a whole; open a Recorder with a trigger")
        self._clips.fire(reason, self._queued_ns, self._messages.newest_ns)
        self._ring()

    @property
    def is_triggered(self) -> bool:
        """Whether the recorder writes clips instead of the whole run."""
        return self._clips is not None

    @property
    def clips(self) -> tuple[TriggeredClip, ...]:
        """The completed logs of the trigger."""
        return () if self._clips is None else self._clips.written

    @property
    def held_bytes(self) -> int:
        """Memory of the samples and messages that wait for the trigger, bytes."""
        return 0 if self._clips is None else self._clips.held_bytes

    def take_remarks(self) -> tuple[str, ...]:
        """Return remarks since the last call: on written clips, and on a ring that is too small."""
        return () if self._clips is None else self._clips.take_remarks()

    def __enter__(self) -> Self:
        self._exit_stack.enter_context(terminable())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._exit_stack:
            self.close(interrupted=error is not None)
