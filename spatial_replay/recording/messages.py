"""A caller's own messages next to samples: their channels and schemas, and the queue that records them."""

from __future__ import annotations

import json
import operator
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from reprlib import repr as shortened
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError, Message

from spatial_replay.errors import UsageError
from spatial_replay.logs.messages import Channel, Messages, Schema
from spatial_replay.logs.topics import GRADIENT_MAP, PLAN_DECISION, PLAN_PATH, protobuf_channel
from spatial_replay.text import times_apart
from spatial_replay.trace.sample import LATEST_NS

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
    topic: str,
    encoding: str | None,
    schema: SchemaLike,
    schema_name: str | None,
    schema_encoding: str | None,
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
        wanted = {"json": "a dict or bytes", "protobuf": "a message of its class or bytes"}
        raise UsageError(
            f"{channel.topic} has {channel.encoding} messages, and {shortened(data)} is"
            f" {type(data).__name__}; give {wanted.get(channel.encoding, 'bytes')}"
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
    wanted = {
        "protobuf": "the message class, or the bytes of a FileDescriptorSet",
        "flatbuffer": "the bytes of a .bfbs file",
        "ros1": "the text of the definition",
        "cdr": "the text of the definition",
    }.get(encoding, "a JSON schema, as a dict or its text")
    raise UsageError(
        f"{topic}: the schema of {encoding} messages is {shortened(schema)} ({type(schema).__name__});"
        f" give {wanted}"
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
    known = [full for file in files.file for full in _type_names(file.package, file.message_type)]
    if name not in known:
        listed = ", ".join(known[:8]) + (", …" if len(known) > 8 else "") or "no message"
        raise UsageError(f"{topic}: the schema has no message {name!r}; it has {listed}")


def _type_names(prefix: str, types: Any) -> list[str]:
    each: DescriptorProto
    names = []
    for each in types:
        name = f"{prefix}.{each.name}".lstrip(".")
        names += [name, *_type_names(name, each.nested_type)]
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


class _Waiting(NamedTuple):
    """One message in the queue."""

    channel: int
    sequence: int
    time_ns: int
    publish_ns: int
    payload: bytes


class MessageQueue:
    """Messages from any thread, on their way to the one thread that writes them.

    Only the threads that write messages take its lock, so that an interruption of one of them never stops
    the writing thread.
    """

    def __init__(
        self,
        name: str,
        limit: int,
        *,
        blocks: bool,
        ring: Callable[[], None],
        missed: Callable[[int], None],
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
        self._queue: queue.SimpleQueue[_Waiting] = queue.SimpleQueue()
        self._bytes_in = self._bytes_out = 0
        self._is_closed = False
        self._process = os.getpid()
        self._failure: Exception | None = None

    @property
    def written(self) -> int:
        """How many messages were taken, on all channels."""
        return sum(channel.written for channel in self.channels.values())

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
            known = self.channels.get(channel.topic)
            if known is None:
                number = len(self.channels)
                known = MessageChannel(self, number, channel)
                # replaced, never changed: the writing thread may be reading it
                self._declared = MappingProxyType({**self._declared, number: channel})
                self.channels[channel.topic] = known
            elif known.declaration != channel:
                raise UsageError(
                    f"{channel.topic} is open already with another encoding or schema; give one topic to each"
                )
            return known

    def require_open(self) -> None:
        """Check that messages can be taken.

        Raises:
            UsageError: the recorder is closed, or another process has it since a fork.
            Exception: what prevents writing.
        """
        if self._is_closed:
            raise UsageError(f"{self._name} is closed; open another recorder")
        if os.getpid() != self._process:
            raise UsageError(f"{self._name} belongs to another process; open a recorder in this one")
        if self._failure is not None:
            raise self._failure

    def put(self, message: _Waiting) -> bool:
        """Queue a message; return False if it was dropped. Call it with the lock held."""
        size = len(message.payload)
        while self._is_full(size):
            if not self._blocks:
                return False
            if self._failure is not None:
                # no one makes room any more
                raise self._failure
            self._ring()
            time.sleep(_PAUSE_S)
        self._bytes_in += size
        self._queue.put(message)
        if self._bytes_in - self._bytes_out > _TOGETHER_BYTES or self._queue.qsize() * 2 >= self._limit:
            self._ring()
        return True

    def take(self) -> Messages:
        """Return some of the messages that wait, none if there are none; for the writing thread."""
        taken: list[_Waiting] = []
        size = 0
        with suppress(queue.Empty):
            while size < _TOGETHER_BYTES:
                message = self._queue.get_nowait()
                taken.append(message)
                size += len(message.payload)
        self._bytes_out += size
        if not taken:
            return Messages()
        *numbers, payloads = zip(*taken, strict=True)
        channel, sequence, log_ns, publish_ns = (np.array(each, np.int64) for each in numbers)
        return Messages(self._declared, channel, sequence, log_ns, publish_ns, payloads)

    def fail(self, error: Exception) -> None:
        """Raise an error of the writing thread in whichever call comes next."""
        self._failure = error

    def close(self) -> None:
        """Take no more messages."""
        with self.lock:
            self._is_closed = True

    def _is_full(self, size: int) -> bool:
        waiting_bytes = self._bytes_in - self._bytes_out
        return self._queue.qsize() >= self._limit or (
            waiting_bytes > 0 and waiting_bytes + size > MOST_WAITING_BYTES
        )


class MessageChannel:
    """A topic of a recorder for messages of the caller's own; `Recorder.channel` opens it.

    Any thread may write, also several on one channel.
    """

    def __init__(self, queue: MessageQueue, number: int, declaration: Channel) -> None:
        self._queue, self._number = queue, number
        self.declaration = declaration
        self._encode = payload_encoder(declaration)
        self._last_ns = 0
        self._written = self._dropped = 0

    @property
    def topic(self) -> str:
        return self.declaration.topic

    @property
    def encoding(self) -> str:
        """The encoding of its messages."""
        return self.declaration.encoding

    @property
    def written(self) -> int:
        """How many messages were taken."""
        return self._written

    @property
    def dropped(self) -> int:
        """How many messages were dropped because the queue was full."""
        return self._dropped

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
        time_ns = self._checked(time_ns)
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
        """Hand over a message of another program, which may come a little late: it is published at its time,
        and logged then or, if that is later, when the one before was."""
        with self._queue.lock:
            self._queue.require_open()
            self._put(max(time_ns, self._last_ns), time_ns, payload)

    def _put(self, time_ns: int, publish_ns: int, payload: bytes) -> None:
        self._last_ns = time_ns
        if self._queue.put(_Waiting(self._number, self._written, time_ns, publish_ns, payload)):
            self._written += 1
        else:
            self._dropped += 1
            self._queue.missed(time_ns)

    def _checked(self, time_ns: object) -> int:
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
