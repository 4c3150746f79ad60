"""A recorder for a control loop: the caller hands over samples, a thread of its own writes them."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from itertools import takewhile
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.compiled import compile_ahead
from spatial_replay.errors import OutputError, SpatialReplayError, TraceError, UsageError
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.contact import contacts
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.geometry.measure import Operand
from spatial_replay.logs.mcap.writer import LogWriter
from spatial_replay.logs.messages import MemorySink, Messages
from spatial_replay.logs.output_file import open_output, refuse_inputs
from spatial_replay.recording.interruption import terminable, uninterrupted
from spatial_replay.recording.message_channel import MessageChannel, MessageQueue
from spatial_replay.recording.message_schema import SchemaLike, message_channel
from spatial_replay.recording.recording import Recording, refuse_templates
from spatial_replay.spec import object_names, signal_names
from spatial_replay.spec.formula import Specification
from spatial_replay.text import times_apart
from spatial_replay.trace.sample import Sample
from spatial_replay.trace.trace import Trace

FLUSH_S = 0.4
"""About the longest time from writing a sample until the operating system has it."""

_GATHER_S = 0.2
"""How long samples are gathered before they are encoded. A few together cost hardly more than one, and while
none are encoded, the caller's thread need not wait for the interpreter lock."""

_TOGETHER = 1024
"""The most samples that are encoded at once."""

_PAUSE_S = 0.001
"""How long `write` waits before it checks a full queue again."""


class Recorder:
    """Record samples into an MCAP log, with the robustness of specifications beside them.

    The log is written in place: if the process is killed, all but the last second can be read. Leaving the
    `with` block closes the log properly, also after an error or Ctrl-C; the log then says that it was
    interrupted. So does SIGTERM: in a `with` block of the main thread it raises SystemExit(143), unless the
    program has a handler of its own. A signal that arrives while the log is closed waits until that is done.

    Use as:

        with Recorder("run.mcap", specifications=[spec]) as recorder:
            joints = recorder.channel("/joint_states")
            joints.write(time_ns, {"position": [0.1, 0.2]})
            recorder.write(sample)
    """

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        specifications: Specification | Sequence[Specification] = (),
        about: Mapping[str, str] | None = None,
        waiting: int = 4096,
        block: bool = True,
    ) -> None:
        """Begin a log.

        Returns when the first sample can be written without delay: the first time on a machine, numerical
        code is compiled first, which takes many seconds.

        Args:
            path: replaced if it exists.
            specifications: evaluated as the samples arrive, without templates; one or several.
            about: further metadata of the log: a seed, where the samples come from.
            waiting: how many samples, and how many messages of channels, may wait for the writing thread.
            block: when that many wait, let `write` wait, too; otherwise drop what comes, and count it in the
                log.

        Raises:
            UsageError: a specification that cannot be recorded, a limit below 1.
            OutputError: the file cannot be written.
        """
        if waiting < 1:
            raise UsageError(f"waiting is {waiting}; give 1 or more samples")
        files = [specifications] if isinstance(specifications, Specification) else list(specifications)
        refuse_templates(files)
        self._path = Path(path)
        refuse_inputs(self._path, ())
        # unlike a queue with a limit of its own, an interruption never leaves this one locked
        self._queue: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._waiting = waiting
        self._enough = max(1, min(waiting, _TOGETHER) // 2)
        self._blocks = block
        self._messages = MessageQueue(self._path.name, waiting, blocks=block, ring=self._ring)
        self._dropped = 0
        self._last_ns = -1
        self._closed = False
        self._failure: SpatialReplayError | None = None
        self._entered = ExitStack()
        self._stream = open_output(self._path)
        try:
            self._writer = LogWriter(self._stream, clock=time.monotonic)
            self._recording = Recording(self._writer, files, about)
            self._flush()
            warm_up(self._recording.files, self._recording.automata)
        except BaseException:
            with suppress(OutputError):
                self._stream.close()
            raise
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """How many samples were dropped because the queue was full."""
        return self._dropped

    def channel(
        self,
        topic: str,
        *,
        schema: SchemaLike = None,
        encoding: str | None = None,
        schema_name: str | None = None,
        schema_encoding: str | None = None,
    ) -> MessageChannel:
        """Open a topic for messages of your own, which are recorded beside the samples.

        A replay keeps them, and the certificate covers them. Opening a topic again gives the same channel.

        Args:
            topic: such as "/joint_states"; those under /spatial and those of a planner are taken.
            schema: a JSON schema (dict or text), a protobuf class, or the definition that belongs to the
                encoding (text or bytes); json needs none. Messages are not checked against it.
            encoding: "json", "protobuf", "ros1", "cdr", "cbor", "msgpack" or "flatbuffer"; without it,
                "protobuf" for a protobuf class, else "json".
            schema_name: the type of the messages; a protobuf class has its name, a JSON schema its title.
            schema_encoding: that of the schema where there are several: "ros2msg", "ros2idl" or "omgidl".

        Raises:
            UsageError: a topic of ours, an unknown encoding, a schema that does not fit, a topic that is open
                in another way, a closed recorder.
            OutputError: something before could not be written.
        """
        return self._messages.channel(message_channel(topic, encoding, schema, schema_name, schema_encoding))

    def write(self, sample: Sample) -> None:
        """Hand over the next sample; return at once unless the queue is full.

        Raises:
            TraceError: a time that is not after the last one.
            OutputError: an earlier sample could not be written.
            UsageError: not a sample, or the recorder is closed.
        """
        if not isinstance(sample, Sample):
            raise UsageError(f"{sample!r} is not a sample; give a Sample(time_ns, objects)")
        if self._closed:
            raise UsageError(f"{self._path.name} is closed; open another recorder")
        self._raise_failure()
        if sample.time_ns <= self._last_ns:
            at, last = times_apart(sample.time_ns, self._last_ns)
            raise TraceError(f"a sample at {at} follows one at {last}; give times that increase")
        self._last_ns = sample.time_ns
        while self._queue.qsize() >= self._waiting:
            if not self._blocks:
                self._dropped += 1
                return
            self._raise_failure()
            time.sleep(_PAUSE_S)
        self._queue.put(sample)
        if self._queue.qsize() >= self._enough:
            self._ring()

    def close(self, *, interrupted: bool = False) -> None:
        """Write all waiting samples and finish the log; closing twice does nothing.

        Raises:
            OutputError: something could not be written.
        """
        with uninterrupted():
            if self._closed:
                return
            self._closed = True
            self._messages.close()
            self._queue.put(None)
            self._ring()
            self._thread.join()
            self._finish(interrupted=interrupted)
        self._raise_failure()

    def __enter__(self) -> Self:
        self._entered.enter_context(terminable())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._entered:
            self.close(interrupted=error is not None)

    def _finish(self, *, interrupted: bool) -> None:
        """Write the end of the log; after a failure, as far as that is possible, and say that it failed."""
        try:
            if self._failure is not None:
                with suppress(Exception):
                    self._recording.break_off(dropped=self._dropped, messages_dropped=self._messages.dropped)
                    self._writer.close()
            else:
                self._recording.end(
                    interrupted=interrupted, dropped=self._dropped, messages_dropped=self._messages.dropped
                )
                self._writer.close()
        finally:
            self._stream.close()

    def _flush(self) -> None:
        """Hand everything written so far to the operating system."""
        self._writer.flush()
        self._stream.flush()

    def _work(self) -> None:
        """Encode and write waiting samples, until `close`."""
        try:
            self._write_waiting()
        except Exception as error:
            self._fail(error)

    def _write_waiting(self) -> None:
        flushed = time.monotonic()
        ended = False
        while not ended:
            samples, ended = self._waiting_samples()
            self._record(samples, self._messages.take())
            if self._failure is None and time.monotonic() - flushed >= FLUSH_S:
                self._try(self._flush)
                flushed = time.monotonic()
        while len(messages := self._messages.take()):
            self._record([], messages)

    def _record(self, samples: Sequence[Sample], messages: Messages) -> None:
        """Encode and write samples and messages; after a failure, drop them."""
        if self._failure is not None or not (samples or len(messages)):
            return
        try:
            trace = Trace.from_samples(samples)
        except Exception as error:
            # what comes before the sample that cannot be encoded is written
            sound = list(takewhile(_is_encodable, samples))
            self._try(lambda: self._recording.add(Trace.from_samples(sound), messages))
            self._fail(error)
        else:
            self._try(lambda: self._recording.add(trace, messages))

    def _try(self, step: Callable[[], None]) -> None:
        """Do a step of the writing thread."""
        try:
            step()
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Let the next `write` raise an error, which would go unnoticed in this thread."""
        failure = (
            error
            if isinstance(error, SpatialReplayError)
            else OutputError(
                f"{self._path.name} ends here: a sample or message could not be written"
                f" ({type(error).__name__}: {error})"
            )
        )
        failure.__cause__ = error if failure is not error else error.__cause__
        self._failure = failure
        self._messages.fail(failure)

    def _ring(self) -> None:
        """Wake the writing thread before its gathering time is over."""
        if self._bell.empty():
            self._bell.put(None)

    def _waiting_samples(self) -> tuple[list[Sample], bool]:
        """Return the gathered samples, and whether the log ends with them."""
        if self._queue.qsize() < self._enough:
            with suppress(queue.Empty):
                self._bell.get(timeout=_GATHER_S)
        samples: list[Sample] = []
        try:
            while len(samples) < _TOGETHER:
                sample = self._queue.get_nowait()
                if sample is None:
                    return samples, True
                samples.append(sample)
        except queue.Empty:
            pass
        return samples, False

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure


def _is_encodable(sample: Sample) -> bool:
    try:
        Trace.from_samples([sample])
    except Exception:
        return False
    return True


def warm_up(files: Sequence[Specification], automata: Sequence[SpecAutomaton]) -> None:
    """Record some samples into memory, so that the code for the specifications is compiled and loaded.

    With an empty compiler cache this takes many seconds, otherwise a fraction of one.

    Args:
        automata: those of the specifications, which are not compiled again.
    """
    compile_ahead()
    recording = Recording(MemorySink(), files, known=automata)
    objects = ["object", *(name for file in files for name in object_names(file))]
    signals = {name: 0.0 for file in files for name in signal_names(file)}
    samples = [
        Sample(
            time_s * 10**9,
            {
                name: _tracked(index + time_s, 0.1 * index + time_s)
                for index, name in enumerate(dict.fromkeys(objects))
            },
            signals,
        )
        for time_s in range(4)
    ]
    recording.add(Trace.from_samples(samples[:1]))
    recording.add(Trace.from_samples(samples[1:]))
    # without objects: intervals of unknown atoms run code of their own
    recording.add(Trace.from_samples([Sample(10**10, {})]))
    recording.end()
    # the arrow at a violation, of which these samples may have none
    shapes = FootprintBatch.from_footprints([Footprint.box(x, 0, x + 1, 1) for x in range(2)])
    contacts(shapes, *(Operand(np.array([[row]])) for row in range(2)), is_protrusion=False)


def _tracked(kind: int, x: float) -> TrackedObject:
    box, disc = Footprint.box(x, 0, x + 1, 1), Footprint.disc(x + 0.5, 0.5, 0.5)
    footprint = (box, disc, Footprint((*box.parts, *disc.parts)))[kind % 3]
    return TrackedObject(footprint, class_name="thing", yaw=x, height=(0.0, 1.0), uncertainty=0.01)
