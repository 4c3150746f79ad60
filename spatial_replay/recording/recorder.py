"""Recorders: samples of a running loop or of a source, written to a log that a signal leaves whole."""

from __future__ import annotations

import json
import math
import operator
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from os import PathLike
from pathlib import Path
from reprlib import repr as shortened
from types import FrameType, MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, ClassVar, Final, Self, TypeAlias

from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError, Message

from spatial_replay.annotate.automaton_state import SpecAutomaton
from spatial_replay.errors import LogError, OutputError, SpatialReplayError, TraceError, UsageError
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.messages import (
    DOUBTS,
    GRADIENT_MAP,
    PLAN_DECISION,
    PLAN_PATH,
    Channel,
    Messages,
    Row,
    Schema,
    Source,
    protobuf_channel,
    read_blocks,
)
from spatial_replay.logs.output_file import Durability, open_output, refuse_inputs
from spatial_replay.recording.clips import ClipLog, Trigger, TriggeredClip
from spatial_replay.recording.log import (
    FileLog,
    RecorderLog,
    Recording,
    RunEnd,
    RunEvent,
    encodable,
    refuse_templates,
)
from spatial_replay.spec import check_names
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import listed_specifications
from spatial_replay.text import counted_from, listed, named_arguments, times_apart
from spatial_replay.trace.doubts import Doubt, distinct_doubts, metadata_from_doubts
from spatial_replay.trace.trace import LATEST_NS, Sample, Trace, checked_units, require_sample
from spatial_replay.trace.units import Axes

if TYPE_CHECKING:
    from spatial_replay.planning.decision_log import BlackBox
    from spatial_replay.planning.decisions import Outcome, Step
    from spatial_replay.planning.planner import Planner


SchemaLike: TypeAlias = Mapping[str, Any] | str | bytes | type[Message] | None
"""A JSON schema, as a dict or its text; a protobuf class; a definition, as its text or bytes; or none."""

MessageData: TypeAlias = Mapping[str, Any] | Message | bytes | bytearray | memoryview
"""A JSON object, a protobuf message, or a payload that is encoded already."""

ENCODINGS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "json": "jsonschema",
        "protobuf": "protobuf",
        "ros1": "ros1msg",
        "cdr": "ros2msg",
        "cbor": "jsonschema",
        "msgpack": "jsonschema",
        "flatbuffer": "flatbuffer",
    }
)
"""The encodings of messages that the MCAP registry lists, each with the usual encoding of its schemas."""

_SELF_DESCRIBING: Final = frozenset({"json", "cbor", "msgpack"})
"""Encodings that can be decoded without a schema."""

_OTHER_SCHEMAS: Final = {"cdr": ("ros2idl", "omgidl")}
"""Further encodings of schemas."""

_OURS: Final = frozenset({PLAN_DECISION, GRADIENT_MAP, PLAN_PATH})


def message_channel(
    topic: str, encoding: str | None, schema: SchemaLike, schema_name: str | None, schema_encoding: str | None
) -> Channel:
    """Return the channel of a topic for a caller's own messages.

    Raises:
        UsageError: a topic of ours, an unknown encoding, a schema that does not fit.
    """
    check_topic(topic)
    message = schema if isinstance(schema, type) and issubclass(schema, Message) else None
    if encoding is None:
        encoding = "protobuf" if message else "json"
    if encoding not in ENCODINGS:
        raise UsageError(
            f"{topic}: the encoding is {shortened(encoding)}; known encodings are {', '.join(ENCODINGS)}"
        )
    if message is not None:
        if encoding != "protobuf":
            raise UsageError(
                f"{topic}: the schema is the protobuf class {message.__name__}, but the encoding is"
                f" {encoding}; give encoding='protobuf'"
            )
        return protobuf_channel(topic, message)
    if schema is None:
        if encoding not in _SELF_DESCRIBING:
            raise UsageError(f"{topic}: {encoding} messages cannot be decoded without a schema; give one")
        return Channel(topic, encoding, None)
    return Channel(topic, encoding, _schema(topic, encoding, schema, schema_name, schema_encoding))


def payload_encoder(channel: Channel) -> Callable[[object], bytes]:
    """Return a function that encodes one message of a channel; bytes pass through unchanged.

    The function raises UsageError for data that does not fit the channel.
    """

    def encode(data: object) -> bytes:
        if isinstance(data, bytes):
            return data
        if isinstance(data, (bytearray, memoryview)):
            return bytes(data)
        if isinstance(data, Mapping) and channel.encoding == "json":
            return _json(channel.topic, data)
        if isinstance(data, Message) and channel.encoding == "protobuf" and channel.schema:
            name = data.DESCRIPTOR.full_name
            if name != channel.schema.name:
                raise UsageError(
                    f"{channel.topic} has messages of {channel.schema.name}; this one is a {name}"
                )
            return data.SerializeToString()
        accepted_forms = {"json": "a dict or bytes", "protobuf": "a message of its class or bytes"}
        raise UsageError(
            f"{channel.topic} has {channel.encoding} messages, and {shortened(data)} is"
            f" {type(data).__name__}; give {accepted_forms.get(channel.encoding, 'bytes')}"
        )

    return encode


def check_topic(topic: object) -> None:
    if not isinstance(topic, str) or not topic.strip("/ "):
        raise UsageError(f"a topic is named {shortened(topic)}; give a text such as '/joint_states'")
    if topic == "/spatial" or topic.startswith("/spatial/") or topic in _OURS:
        raise UsageError(
            f"{topic} is a topic that spatial-replay writes itself; give your messages another one"
        )


def _schema(
    topic: str, encoding: str, schema: object, name: str | None, schema_encoding: str | None
) -> Schema:
    """Return a schema that is not a class."""
    expected = (ENCODINGS[encoding], *_OTHER_SCHEMAS.get(encoding, ()))
    if schema_encoding is not None and schema_encoding not in expected:
        raise UsageError(
            f"{topic}: the schema is encoded as {shortened(schema_encoding)}; a schema of {encoding}"
            f" messages is {' or '.join(expected)}"
        )
    text = _text(topic, encoding, schema)
    if expected[0] == "jsonschema":
        title = _title(topic, text)
        name = name or title
    if not name:
        raise UsageError(
            f"{topic}: the schema has no name; give schema_name, the type of the messages, such as"
            " 'sensor_msgs/msg/JointState'"
        )
    if encoding == "protobuf":
        _check_descriptors(topic, text, name)
    return Schema(name, schema_encoding or expected[0], text)


def _text(topic: str, encoding: str, schema: object) -> bytes:
    """Return the bytes of a schema that is not a class."""
    if isinstance(schema, Mapping) and ENCODINGS[encoding] == "jsonschema":
        return _json(topic, schema)
    if isinstance(schema, str) and encoding not in ("protobuf", "flatbuffer"):
        return schema.encode()
    if isinstance(schema, bytes):
        return schema
    accepted_form = {
        "protobuf": "the message class, or the bytes of a FileDescriptorSet",
        "flatbuffer": "the bytes of a .bfbs file",
        "ros1": "the text of the definition",
        "cdr": "the text of the definition",
    }.get(encoding, "a JSON schema, as a dict or its text")
    raise UsageError(
        f"{topic}: the schema of {encoding} messages is {shortened(schema)} ({type(schema).__name__});"
        f" give {accepted_form}"
    )


def _title(topic: str, text: bytes) -> str:
    """Check a JSON schema, and return its title or, if it has none, the name of the topic."""
    try:
        schema = json.loads(text)
    except ValueError as error:
        raise UsageError(f"{topic}: the schema is not JSON: {error}") from None
    if not isinstance(schema, dict) or schema.get("type", "object") != "object":
        raise UsageError(
            f'{topic}: the schema is {shortened(schema)}; give a JSON schema with "type": "object", since'
            " messages are objects"
        )
    title = schema.get("title")
    return title if isinstance(title, str) and title else topic.strip("/")


def _check_descriptors(topic: str, text: bytes, name: str) -> None:
    try:
        files = FileDescriptorSet.FromString(text)
    except DecodeError:
        raise UsageError(
            f"{topic}: the schema is not a FileDescriptorSet; give the message class, or the bytes that"
            " protoc --include_imports --descriptor_set_out writes"
        ) from None
    type_names = [
        type_name for file in files.file for type_name in _type_names(file.package, file.message_type)
    ]
    if name not in type_names:
        raise UsageError(
            f"{topic}: the schema has no message {name!r}; it has {listed(type_names) or 'no message'}"
        )


def _type_names(prefix: str, types: Any) -> list[str]:
    message_type: DescriptorProto
    names = []
    for message_type in types:
        name = f"{prefix}.{message_type.name}".lstrip(".")
        names += [name, *_type_names(name, message_type.nested_type)]
    return names


def _json(topic: str, data: Mapping[str, Any]) -> bytes:
    try:
        return json.dumps(dict(data), ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise UsageError(
            f"{topic}: {shortened(data)} cannot be written as JSON: {error}; give texts, finite numbers,"
            " lists and dicts"
        ) from None


MOST_WAITING_BYTES: Final = 64 * 2**20
"""The most bytes of messages that wait to be written; one message that is larger waits alone."""

_TOGETHER_BYTES: Final = 8 * 2**20
"""About the most bytes that are written at once."""

_PAUSE_S = 0.001


class MessageQueue:
    """Messages from any thread, on their way to the one thread that writes them.

    Only the threads that write messages take its lock, so that an interruption of one of them never stops
    the writing thread.

    Attributes:
        newest_ns: the latest time of a queued message, -1 before the first.
        is_closed: whether no more messages are taken.
        process: the one that the recorder belongs to.
        failure: why nothing can be written any more, or None.
    """

    def __init__(
        self, name: str, limit: int, *, blocks: bool, ring: Callable[[], None], missed: Callable[[int], None]
    ) -> None:
        """Begin without channels.

        Args:
            name: of the log.
            limit: how many messages may wait.
            blocks: whether a message waits for its place, or is dropped.
            ring: wakes the writing thread.
            missed: takes the time of each message that is dropped.
        """
        self.missed = missed
        self._name, self._limit, self._blocks, self._ring = name, limit, blocks, ring
        # reentrant, so that a signal handler may write while its own thread does
        self.lock = threading.RLock()
        self.channels: dict[str, MessageChannel] = {}
        self._declared: Mapping[int, Channel] = MappingProxyType({})
        self._queue: queue.SimpleQueue[Row] = queue.SimpleQueue()
        self._bytes_in = self._bytes_out = 0
        self.newest_ns = -1
        self.is_closed = False
        self.process = os.getpid()
        self.failure: SpatialReplayError | None = None

    @property
    def dropped(self) -> int:
        """How many messages were dropped, on all channels."""
        return sum(channel.dropped for channel in self.channels.values())

    def channel(self, channel: Channel) -> MessageChannel:
        """Return the channel of a topic, the same one whenever it is opened in the same way.

        Raises:
            UsageError: the recorder is closed, or the topic is open with another encoding or schema.
        """
        with self.lock:
            self.require_open()
            message_channel = self.channels.get(channel.topic)
            if message_channel is None:
                number = len(self.channels)
                message_channel = MessageChannel(self, number, channel)
                # replaced, never changed: the writing thread may be reading it
                self._declared = MappingProxyType({**self._declared, number: channel})
                self.channels[channel.topic] = message_channel
            elif message_channel.declaration != channel:
                raise UsageError(
                    f"{channel.topic} is open already with another encoding or schema; give one topic to each"
                )
            return message_channel

    def require_open(self) -> None:
        """Check that messages can be taken.

        Raises:
            UsageError: the recorder is closed, or another process has it since a fork.
            Exception: what prevents writing.
        """
        if self.is_closed:
            raise UsageError(f"{self._name} is closed; open another recorder")
        if os.getpid() != self.process:
            raise UsageError(f"{self._name} belongs to another process; open a recorder in this one")
        self.raise_failure()

    def raise_failure(self) -> None:
        """Raise what prevents writing, if anything does."""
        if self.failure is not None:
            raise self.failure

    def put(self, message: Row) -> bool:
        """Queue a message; return False if it was dropped. Call it with the lock held."""
        size = len(message.payload)
        while self._is_full(size):
            if not self._blocks:
                return False
            # no one makes room after that
            self.raise_failure()
            self._ring()
            time.sleep(_PAUSE_S)
        self._bytes_in += size
        self._queue.put(message)
        if self._bytes_in - self._bytes_out > _TOGETHER_BYTES or self._queue.qsize() * 2 >= self._limit:
            self._ring()
        return True

    def take(self) -> Messages:
        """Return some of the messages that wait, none if there are none; for the writing thread."""
        rows: list[Row] = []
        size = 0
        with suppress(queue.Empty):
            while size < _TOGETHER_BYTES:
                row = self._queue.get_nowait()
                rows.append(row)
                size += len(row.payload)
        self._bytes_out += size
        return Messages.from_rows(self._declared, rows)

    def _is_full(self, size: int) -> bool:
        waiting_bytes = self._bytes_in - self._bytes_out
        return self._queue.qsize() >= self._limit or (
            waiting_bytes > 0 and waiting_bytes + size > MOST_WAITING_BYTES
        )


class MessageChannel:
    """A topic of a recorder for messages of the caller's own; `Recorder.channel` opens it.

    Any thread may write, also several on one channel.

    Attributes:
        topic, encoding: those of its messages.
        written: how many messages were taken.
        dropped: how many messages were dropped because the queue was full.
    """

    def __init__(self, queue: MessageQueue, number: int, declaration: Channel) -> None:
        self._queue, self._number = queue, number
        self.declaration = declaration
        self.topic, self.encoding = declaration.topic, declaration.encoding
        self._encode = payload_encoder(declaration)
        self._last_ns = 0
        self.written = self.dropped = 0

    def __repr__(self) -> str:
        return f"MessageChannel({self.topic!r}, encoding={self.encoding!r}, written={self.written})"

    def write(self, time_ns: int, data: MessageData) -> None:
        """Hand over the next message; return at once unless the queue is full.

        Args:
            time_ns: its log time, on the clock of the samples; not before that of the channel's last message.
            data: a dict for json, a message for protobuf, or bytes, which are written unchanged.

        Raises:
            UsageError: a time out of range or order, data that does not fit the channel, a closed recorder.
            OutputError: something before could not be written.
        """
        time_ns = self._check_time(time_ns)
        payload = self._encode(data)
        queue = self._queue
        with queue.lock:
            queue.require_open()
            if time_ns < self._last_ns:
                at, last = times_apart(time_ns, self._last_ns)
                raise UsageError(
                    f"a message on {self.topic} at {at} follows one at {last}; give times that do not"
                    " decrease, or each thread a topic"
                )
            self._put(time_ns, time_ns, payload)

    def copy(self, time_ns: int, payload: bytes) -> None:
        """Hand over a message of another program, which may come a little late. It is published at its time,
        and logged then or at the log time of its predecessor, whichever is later."""
        with self._queue.lock:
            self._queue.require_open()
            self._put(max(time_ns, self._last_ns), time_ns, payload)

    def _put(self, time_ns: int, publish_ns: int, payload: bytes) -> None:
        self._last_ns = time_ns
        if self._queue.put(Row(self._number, self.written, time_ns, publish_ns, payload)):
            self.written += 1
            self._queue.newest_ns = max(self._queue.newest_ns, time_ns)
        else:
            self.dropped += 1
            self._queue.missed(time_ns)

    def _check_time(self, time_ns: object) -> int:
        try:
            number = operator.index(time_ns)  # type: ignore[arg-type]
        except TypeError:
            number = -1
        if isinstance(time_ns, bool) or not 0 <= number <= LATEST_NS:
            raise UsageError(
                f"the time of a message on {self.topic} is {shortened(time_ns)}; give integer nanoseconds"
                " from 0 to 2**63 - 1"
            )
        return number


TERMINATED = 128 + signal.SIGTERM
"""The exit code of a process that SIGTERM ended, as shells report it."""


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold SIGINT and SIGTERM back during the block; the first one that arrived is raised after it.

    Signals that are ignored, or end the process at once, stay as they are, and so does everything outside the
    main thread, since only that may handle signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    arrived: list[int] = []
    for number, handler in handlers.items():
        if callable(handler):
            signal.signal(number, lambda number, frame: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if callable(handler):
                signal.signal(number, handler)
    if arrived:
        signal.raise_signal(arrived[0])


@contextmanager
def leaving(output: Path) -> Iterator[None]:
    """Add to a KeyboardInterrupt the note that the shorter log can be used."""
    try:
        yield
    except KeyboardInterrupt as interruption:
        interruption.add_note(
            f"{output} holds the samples up to the interruption, and is marked as interrupted"
        )
        raise


@contextmanager
def terminable() -> Iterator[None]:
    """Let SIGTERM raise SystemExit during the block, so that logs are closed before the process ends.

    If the program handles or ignores SIGTERM, before or during the block, that stays; outside the main
    thread, nothing changes.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, _leave)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGTERM) is _leave:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(TERMINATED)


FLUSH_S = 0.3
"""About the longest time from writing a sample until the operating system has it."""

MOST_LOST_S = 0.8
"""Samples of more time than this are never on their way: then `write` waits or, if it may not, drops."""

_TOGETHER = 1024
"""The most samples that are encoded at once."""


class SampleWriter:
    """Samples and messages from a caller's threads, on their way to the one thread that writes them.

    Attributes:
        dropped: how many samples were dropped because the queue was full, or given to `miss`.
        doubts: assumptions that the source contradicts; the end of the log has those set by then.
    """

    def __init__(
        self, log: RecorderLog, name: str, waiting: int, *, block: bool, most_lost_s: float = math.inf
    ) -> None:
        """Start the writing thread.

        Args:
            name: of the log, for errors.
            waiting: how many samples, and how many messages, may wait for the writing thread.
            block: when that many wait, or `most_lost_s` of them, let `write` wait, too; otherwise drop what
                comes, and count it.
            most_lost_s: how much time of samples a kill may cost.
        """
        self._log, self.name = log, name
        # unlike a queue with a limit of its own, an interruption never leaves this one locked
        self._queue: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._waiting = waiting
        self._enough = max(1, min(waiting, _TOGETHER) // 2)
        self._blocks = block
        self._most_lost_s = most_lost_s
        self._is_reserved = False
        self._events: queue.SimpleQueue[RunEvent] = queue.SimpleQueue()
        missed = partial(log.miss, kind="message")
        self._messages = MessageQueue(name, waiting, blocks=block, ring=self._ring, missed=missed)
        self.dropped = 0
        self.doubts: tuple[Doubt, ...] = ()
        self._last_ns = self._queued_ns = -1
        self._unsafe_s: float | None = None
        self._drains = False
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    @property
    def messages_dropped(self) -> int:
        """How many messages were dropped, on all channels."""
        return self._messages.dropped

    def reserve(self) -> bool:
        """Return whether the next `write` takes its sample, which it then does at once."""
        self._is_reserved = self._messages.failure is not None or not self._is_behind()
        return self._is_reserved

    def copy(self, channel: Channel, time_ns: int, payload: bytes) -> None:
        """Hand over a message of another program, as it is: its time becomes that of its publication.

        Raises:
            UsageError: a topic of ours, or one that is open with another definition; a closed recorder.
            OutputError: something before could not be written.
        """
        message_channel = self._messages.channels.get(channel.topic)
        if message_channel is None or message_channel.declaration != channel:
            check_topic(channel.topic)
            message_channel = self._messages.channel(channel)
        message_channel.copy(time_ns, payload)

    def write(self, sample: Sample) -> None:
        """Hand over the next sample; return at once unless the queue is full.

        Raises:
            TraceError: a time that is not after the last one.
            OutputError: an earlier sample could not be written.
            UsageError: not a sample, or the recorder is closed.
        """
        require_sample(sample)
        self._messages.require_open()
        if sample.time_ns <= self._last_ns:
            at, last = times_apart(sample.time_ns, self._last_ns)
            raise TraceError(f"a sample at {at} follows one at {last}; give times that increase")
        self._last_ns = sample.time_ns
        is_reserved, self._is_reserved = self._is_reserved, False
        while not is_reserved and self._is_behind():
            if not self._blocks:
                self.miss(sample)
                return
            self._messages.raise_failure()
            time.sleep(_PAUSE_S)
        if self._unsafe_s is None:
            self._unsafe_s = time.monotonic()
        self._queue.put(sample)
        self._queued_ns = sample.time_ns
        if self._queue.qsize() >= self._enough:
            self._ring()

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest sample; None before the first."""
        return None if self._last_ns < 0 else self._last_ns

    def miss(self, sample: Sample) -> None:
        """Count a sample that is left out."""
        self.dropped += 1
        self._log.miss(sample.time_ns, kind="sample")

    def report(self, event: RunEvent) -> None:
        """Hand over what happens to the run beside its samples, from the thread that writes these."""
        self._events.put(event)
        self._ring()

    def _is_behind(self) -> bool:
        """Return whether too many samples wait, or too much time of them could be lost."""
        if self._queue.qsize() + self._log.backlog >= self._waiting:
            return True
        since = self._unsafe_s
        return since is not None and time.monotonic() - since > self._most_lost_s

    def close(self, *, interrupted: bool = False) -> None:
        """Write all waiting samples and finish the log; closing twice, or after a fork, does nothing.

        Raises:
            OutputError: something could not be written.
        """
        with uninterrupted():
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
        """Write the end of the log; after a failure, as far as that is possible, and say that it failed."""
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
        ended = False
        while not ended:
            now = time.monotonic()
            samples, ended = self._waiting_samples()
            # those that are left came before the others
            drained_s = now if len(samples) < _TOGETHER else drained_s
            self._record(samples, self._messages.take())
            self._report_events()
            # decisions come before the samples that follow them
            while self._drains and len(messages := self._messages.take()):
                self._record([], messages)
            if self._messages.failure is None and time.monotonic() - flushed_s >= FLUSH_S:
                self._try(self._log.flush)
                flushed_s = time.monotonic()
                self._unsafe_s = drained_s if self._queue.qsize() else None
        while len(messages := self._messages.take()):
            self._record([], messages)

    def _report_events(self) -> None:
        with suppress(queue.Empty):
            while self._messages.failure is None:
                event = self._events.get_nowait()
                self._try(partial(self._log.report, event))

    def _record(self, samples: Sequence[Sample], messages: Messages) -> None:
        """Encode and write samples and messages; after a failure, drop them."""
        if self._messages.failure is not None or not (samples or len(messages) or self._log.is_busy):
            return
        try:
            trace = Trace.from_samples(samples)
        except Exception as error:
            # what comes before the sample that cannot be encoded is written
            sound = encodable(samples)
            self._try(lambda: self._log.add(sound, Trace.from_samples(sound), messages))
            self._fail(error)
        else:
            self._try(lambda: self._log.add(samples, trace, messages))

    def _try(self, step: Callable[[], None]) -> None:
        """Do a step of the writing thread."""
        try:
            step()
        except Exception as error:
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """Let the next `write` raise an error, which would go unnoticed in this thread."""
        if not isinstance(error, SpatialReplayError):
            what = f"a sample or message could not be written ({type(error).__name__}: {error})"
            failure = OutputError(f"{self.name} ends here: {what}")
            failure.__cause__ = error
            error = failure
        self._messages.failure = error

    def _ring(self) -> None:
        """Wake the writing thread before its gathering time is over."""
        if self._bell.empty():
            self._bell.put(None)

    def _waiting_samples(self) -> tuple[list[Sample], bool]:
        """Return the gathered samples, and whether the log ends with them."""
        if self._queue.qsize() < self._enough and not self._log.is_busy:
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
    """Record samples into an MCAP log, with the robustness of specifications beside them.

    The log is written in place: if the process is killed, less than a second of samples is lost, counted from
    when `write` took them, however busy the machine is. Leaving the `with` block closes the log properly,
    also after an error or Ctrl-C; the log then says that it was interrupted. So does SIGTERM: in a `with`
    block of the main thread it raises SystemExit(143), unless the program has a handler of its own. A signal
    that arrives while the log is closed waits until that is done.

    With a trigger, nothing is written until it fires. Earlier samples wait in memory, and each firing leaves
    one log around it. With a planner, its decisions are recorded as well: samples, decisions and outcomes go
    through the recorder, in their order; or `plan(planner, robot, recorder)` does that.

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

        Returns when the first sample can be written without delay: the first time on a machine, numerical
        code is compiled first, which takes many seconds.

        Args:
            path: the log; with a trigger, the folder that its logs are written to.
            specifications: evaluated as the samples arrive, without templates; one or several.
            about: further metadata of the log: a seed, where the samples come from.
            units: for sentences, axes and viewers: of signals by their names, of lengths by "".
            waiting: how many samples, and how many messages of channels, may wait for the writing thread.
            block: whether `write` waits while the queue is full, or, without a trigger, while more than 0.8 s
                of samples have not reached the operating system. Otherwise new samples are dropped, and the
                log counts them.
            trigger: when to write what, instead of everything.
            durability: "process" for a log that survives the end of the process; "disk" for one that
                survives that of the machine, too: then each flush waits for the disk (fsync).
            planner: observes the samples that are written; its decisions are recorded, see `next_step`.
            overwrite: replace a file that exists and is not empty.

        Raises:
            UsageError: a specification that cannot be recorded, units that are not texts, a limit below 1.
            UsageError: a trigger without a spec of that name, a planner with a trigger or without `block`.
            UsageError: an existing file.
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
        self._entered = ExitStack()
        self._files = tuple(files)
        self._box: BlackBox | None = None
        # what waits for a trigger is in memory anyway
        most_lost_s = self.most_lost_s if trigger is None else math.inf
        super().__init__(log, self._path.name, waiting, block=block, most_lost_s=most_lost_s)
        if planner is not None:
            self.attach(planner)

    @property
    def planner(self) -> Planner | None:
        """The planner whose decisions are recorded."""
        return None if self._box is None else self._box.planner

    def attach(self, planner: Planner, *, timings: bool = False) -> None:
        """Let a planner observe every sample from now on, and record its decisions; `timings`: how long, too.

        Raises:
            UsageError: a second planner, one whose specification is not recorded, one that has observed
                samples; a recorder with a trigger, or one that drops samples.
        """
        from spatial_replay.planning.decision_log import BlackBox

        self._refuse_planner(planner)
        self._box = BlackBox(planner, self._write_decision, timings=timings)
        self._drains = True

    def _refuse_planner(self, planner: Planner) -> None:
        if self._box is not None:
            raise UsageError(f"{self.name} has a planner already; open another recorder")
        if self._clips is not None or not self._blocks:
            remedy = "open a Recorder without a trigger, and with block=True"
            raise UsageError(f"{self.name} may leave samples out, on which decisions depend; {remedy}")
        if planner.specification not in self._files:
            name, remedy = planner.specification.filename, "open the Recorder with planner=planner"
            raise UsageError(f"{self.name} does not record {name}, which is planned for; {remedy}")
        if self._last_ns >= 0 or planner.has_observed:
            raise UsageError("decisions depend on all samples; attach a new planner before the first one")

    def write(self, sample: Sample) -> None:
        """Hand over the next sample; a planner observes it, too.

        Returns at once unless the queue is full.

        Raises:
            TraceError: a time that is not after the last one.
            OutputError: an earlier sample could not be written.
            UsageError: not a sample, or the recorder is closed; at the first sample, settings of the planner
                that do not fit it.
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
        """Return the planner's next step, and record it with everything that it depends on.

        Raises:
            UsageError: there is no planner, nothing was written yet, or the last step was not concluded.
            OutputError: something before could not be written.
        """
        return self._require_box().next_step()

    def conclude(self, outcome: Outcome) -> None:
        """Record the outcome of the last step, after the samples of its motion.

        Raises:
            UsageError: there is no planner, not an outcome, or no step is being executed.
            OutputError: something before could not be written.
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

    def trigger(self, reason: str = "by hand") -> None:
        """Fire the trigger now, whatever it waits for; from any thread, and from a signal handler.

        The clip is around the newest sample or message at the call, or around the first one to come.

        Raises:
            UsageError: the recorder has none.
        """
        if self._clips is None:
            raise UsageError(f"{self.name} is written as a whole; open a Recorder with a trigger")
        self._clips.fire(reason, self._queued_ns, self._messages.newest_ns)
        self._ring()

    @property
    def is_triggered(self) -> bool:
        """Whether it writes what its trigger chooses, not everything."""
        return self._clips is not None

    @property
    def clips(self) -> tuple[TriggeredClip, ...]:
        """The logs that the trigger has left so far, complete ones only."""
        return () if self._clips is None else self._clips.written

    @property
    def held_bytes(self) -> int:
        """Samples and messages that wait for the trigger."""
        return 0 if self._clips is None else self._clips.held_bytes

    def take_remarks(self) -> tuple[str, ...]:
        """Return what the trigger has done since the last call, and what it could not hold."""
        return () if self._clips is None else self._clips.take_remarks()

    def __enter__(self) -> Self:
        self._entered.enter_context(terminable())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._entered:
            self.close(interrupted=error is not None)


@dataclass(frozen=True, slots=True)
class Recorded:
    """The result of a recording.

    Attributes:
        samples: number of samples.
        start_ns, end_ns: times of the first and the last.
        objects: names of the objects.
        faults: what was lost while reading, each with its place.
        unreadable: number of observations with a number that is not finite.
        missing: names in the specifications that no sample had.
        remarks: what the source reports about its samples where nothing was lost.
    """

    samples: int
    start_ns: int
    end_ns: int
    objects: tuple[str, ...]
    faults: tuple[str, ...]
    unreadable: int
    missing: tuple[Diagnostic, ...]
    remarks: tuple[str, ...] = ()


def record_source(
    source: Source,
    output: Path,
    files: Sequence[Specification] = (),
    *,
    inputs: Sequence[Path] = (),
    unit: str = "",
    advance: Callable[[int], None] = lambda samples: None,
    durability: Durability = "process",
) -> Recorded:
    """Record the samples of a source, in place under the final name.

    Equal sources and specifications give equal bytes. An interruption leaves a shorter log, closed properly
    and marked as interrupted.

    Args:
        inputs: files that the output must not be.
        unit: that of lengths, for readers, where the source declares none.
        advance: called with the number of samples of each block that is done.
        durability: "disk" for a log of which the disk has each chunk as soon as it is written.

    Raises:
        UsageError: the output is an input, a specification cannot be recorded, or the source declares another
            unit.
        LogError: the source has no sample, or it cannot be read to its end.
        OutputError: the output cannot be written.
    """
    refuse_inputs(output, inputs)
    refuse_templates(files)
    tally = _Tally()
    traces = _traces(source, tally)
    # a source without samples raises here, before the output is touched
    first = next(traces)
    about = {"source": source.name, "options": json.dumps(dict(source.options))}
    about |= _units_metadata(source, unit)
    stream = open_output(output, durability)
    try:
        with leaving(output), stream, recording_in(stream, files, about) as (_, recording):
            for trace in chain([first], traces):
                with uninterrupted():
                    recording.add(trace)
                advance(len(trace))
            if tally.doubts:
                recording.add_metadata(DOUBTS, tally.doubts_metadata())
    except OutputError:
        # a disk that is full: half of a log that can be recorded again is worth less than none
        if output.is_file():
            output.unlink(missing_ok=True)
        raise
    return tally.summary(source.name, files)


def _units_metadata(source: Source, unit: str) -> dict[str, str]:
    """Return the entries for the log's metadata with axes and units; `unit` is that of lengths, if given."""
    axes = source.axes
    if unit and axes.unit not in ("", unit):
        raise UsageError(f"{source.name} declares lengths in {axes.unit}, and not in {unit}; leave that out")
    unit = checked_units({"": unit})[""] if unit else axes.unit
    return replace(axes, unit=unit).metadata()


def _traces(source: Source, tally: _Tally) -> Iterator[Trace]:
    """Read the samples of a source, in blocks of one or more.

    Raises:
        LogError: there are none, or they cannot be read.
    """
    any_sample = False
    for block in read_blocks(source):
        tally.add(block.trace)
        tally.remarks += block.remarks
        tally.doubts += block.doubts
        if len(block.trace):
            any_sample = True
            yield block.trace
    if not any_sample:
        raise LogError("; ".join([f"{source.name} has no sample", *tally.faults[:1]]))


@contextmanager
def recording_in(
    stream: BinaryIO,
    files: Sequence[Specification],
    about: Mapping[str, str] | None,
    known: Sequence[SpecAutomaton] = (),
) -> Iterator[tuple[LogWriter, Recording]]:
    """Begin a log, and write its end however the block ends; after an error it is marked as interrupted."""
    interrupted = True

    def end() -> None:
        with uninterrupted():
            recording.end(RunEnd(interrupted))
            writer.close()

    with ExitStack() as ending:
        # an interruption between two records would leave a log whose index does not fit
        with uninterrupted():
            writer = LogWriter(stream)
            recording = Recording(writer, files, about, known)
            ending.callback(end)
        yield writer, recording
        interrupted = False


class _Tally:
    """Counts of what was recorded so far."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._names: set[str] = set()
        self._signals: set[str] = set()
        self.faults: list[str] = []
        self.remarks: list[str] = []
        self.doubts: list[Doubt] = []
        self._samples = self._unreadable = 0

    def add(self, trace: Trace) -> None:
        self._samples += len(trace)
        self.faults += trace.faults
        self._unreadable += trace.unreadable_count
        self._names.update(trace.names)
        self._signals.update(trace.signals)
        if len(trace):
            self._times = [*self._times[:1], int(trace.times_ns[0]), int(trace.times_ns[-1])]

    def summary(self, name: str, files: Sequence[Specification]) -> Recorded:
        names, signals = sorted(self._names), sorted(self._signals)
        remarks = [remark for file in files for remark in check_names(file, names, signals)]
        doubts = (doubt.remark(name) for doubt in dict.fromkeys(self.doubts))
        return Recorded(
            self._samples,
            self._times[0],
            self._times[-1],
            tuple(names),
            counted_from(self.faults, self._times[0]),
            self._unreadable,
            tuple(remark for remark in remarks if remark.severity == "error"),
            counted_from((*doubts, *self.remarks), self._times[0]),
        )

    def doubts_metadata(self) -> dict[str, str]:
        """Return the metadata record of the doubts; {} without any."""
        return metadata_from_doubts(distinct_doubts(self.doubts, self._times[0]))
