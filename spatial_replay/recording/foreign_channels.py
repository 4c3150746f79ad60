"""Channels for the caller's messages: encodings, schemas and payloads."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from reprlib import repr as shortened
from types import MappingProxyType
from typing import Any, Final, TypeAlias

from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError, Message

from spatial_replay.errors import UsageError
from spatial_replay.logs.messages import Channel, Schema
from spatial_replay.logs.topics import GRADIENT_MAP, MAP_DRAWING, PLAN_DECISION, PLAN_PATH, protobuf_channel
from spatial_replay.text import listing

SchemaLike: TypeAlias = Mapping[str, Any] | str | bytes | type[Message] | None
"""A JSON schema (dict or text), a protobuf class, another definition (text or bytes), or None."""

MessageData: TypeAlias = Mapping[str, Any] | Message | bytes | bytearray | memoryview
"""A JSON object, a protobuf message, or an encoded payload."""

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
"""Message encodings of the MCAP registry (https://mcap.dev/spec/registry), each with its schema encoding."""

_SELF_DESCRIBING: Final = frozenset({"json", "cbor", "msgpack"})
"""Encodings that can be decoded without a schema."""

_OTHER_SCHEMAS: Final = {"cdr": ("ros2idl", "omgidl")}
"""Alternative schema encodings of a message encoding."""

_OURS: Final = frozenset({PLAN_DECISION, GRADIENT_MAP, PLAN_PATH, MAP_DRAWING})


def message_channel(
    topic: str, encoding: str | None, schema: SchemaLike, schema_name: str | None, schema_encoding: str | None
) -> Channel:
    """Return the channel of a topic for the caller's messages.

    Raises:
        UsageError: a topic of this package, an unknown encoding, or a schema that does not fit.
    """
    check_topic(topic)
    message_class = schema if isinstance(schema, type) and issubclass(schema, Message) else None
    if encoding is None:
        encoding = "protobuf" if message_class else "json"
    if encoding not in ENCODINGS:
        raise UsageError(
            f"{topic}: the encoding is {shortened(encoding)}; known encodings are {', '.join(ENCODINGS)}"
        )
    if message_class is not None:
        if encoding != "protobuf":
            raise UsageError(
                f"{topic}: the schema is the protobuf class {message_class.__name__}, but the encoding is"
                f" {encoding}; give encoding='protobuf'"
            )
        return protobuf_channel(topic, message_class)
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
    topic: str, encoding: str, schema: object, schema_name: str | None, schema_encoding: str | None
) -> Schema:
    schema_encodings = (ENCODINGS[encoding], *_OTHER_SCHEMAS.get(encoding, ()))
    if schema_encoding is not None and schema_encoding not in schema_encodings:
        raise UsageError(
            f"{topic}: the schema is encoded as {shortened(schema_encoding)}; a schema of {encoding}"
            f" messages is {' or '.join(schema_encodings)}"
        )
    definition = _text(topic, encoding, schema)
    if schema_encodings[0] == "jsonschema":
        title = _title(topic, definition)
        schema_name = schema_name or title
    if not schema_name:
        raise UsageError(
            f"{topic}: the schema has no name; give schema_name, the type of the messages, such as"
            " 'sensor_msgs/msg/JointState'"
        )
    if encoding == "protobuf":
        _check_descriptors(topic, definition, schema_name)
    return Schema(schema_name, schema_encoding or schema_encodings[0], definition)


def _text(topic: str, encoding: str, schema: object) -> bytes:
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


def _title(topic: str, definition: bytes) -> str:
    """Check a JSON schema, and return its title or, without a title, the name of the topic."""
    try:
        schema = json.loads(definition)
    except ValueError as error:
        raise UsageError(f"{topic}: the schema is not JSON: {error}") from None
    if not isinstance(schema, dict) or schema.get("type", "object") != "object":
        raise UsageError(
            f'{topic}: the schema is {shortened(schema)}; give a JSON schema with "type": "object", since'
            " messages are objects"
        )
    title = schema.get("title")
    return title if isinstance(title, str) and title else topic.strip("/")


def _check_descriptors(topic: str, definition: bytes, message_name: str) -> None:
    try:
        files = FileDescriptorSet.FromString(definition)
    except DecodeError:
        raise UsageError(
            f"{topic}: the schema is not a FileDescriptorSet; give the message class, or the bytes that"
            " protoc --include_imports --descriptor_set_out writes"
        ) from None
    type_names = [
        type_name for file in files.file for type_name in _type_names(file.package, file.message_type)
    ]
    if message_name not in type_names:
        raise UsageError(
            f"{topic}: the schema has no message {message_name!r}; it has"
            f" {listing(type_names) or 'no message'}"
        )


def _type_names(prefix: str, message_types: Any) -> list[str]:
    message_type: DescriptorProto
    type_names = []
    for message_type in message_types:
        type_name = f"{prefix}.{message_type.name}".lstrip(".")
        type_names += [type_name, *_type_names(type_name, message_type.nested_type)]
    return type_names


def _json(topic: str, data: Mapping[str, Any]) -> bytes:
    try:
        return json.dumps(dict(data), ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise UsageError(
            f"{topic}: {shortened(data)} cannot be written as JSON: {error}; give texts, finite numbers,"
            " lists and dicts"
        ) from None
