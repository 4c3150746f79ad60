"""Topics of a log, and decoders of their messages by encoding."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from types import MappingProxyType

from google.protobuf import (
    any_pb2,
    duration_pb2,
    empty_pb2,
    field_mask_pb2,
    struct_pb2,
    timestamp_pb2,
    wrappers_pb2,
)
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from spatial_replay.bags.definitions import Decoder, full_type_name
from spatial_replay.bags.ros_decoders import failure_text, ros_decoder, ros_definitions, standard_schema
from spatial_replay.errors import LogError
from spatial_replay.logs.messages import Channel, Schema

# early releases of ROS 2 write a policy's number, later releases its name
_LATCHED = re.compile(r"durability: *(1|transient_local)\b")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a log, of one type and encoding.

    Attributes:
        type: full ROS type (`turtlesim/msg/Pose`), or name of the schema (`foxglove.SceneUpdate`); "" if the
            log names no type.
        encoding: encoding of the messages: ros1, cdr, protobuf or json.
        count: number of messages that the log declares, or None.
        schema: definition in the log, or None.
        latched: whether the last message before a window is valid in the window (latched, transient local).
        unreadable: reason why the topic's messages cannot be decoded, or None.
        metadata: metadata of the topic's channel, as in an MCAP log.
    """

    name: str
    type: str
    encoding: str
    count: int | None = None
    schema: Schema | None = None
    latched: bool = False
    unreadable: str | None = None
    metadata: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}), hash=False)


def is_latched(qos: str) -> bool:
    """Return whether a ROS 2 publisher's quality of service keeps messages for late subscribers."""
    return _LATCHED.search(qos) is not None


_MOST_FILES = 1_000
"""Maximum number of files in a descriptor set."""

_WELL_KNOWN = (any_pb2, duration_pb2, empty_pb2, field_mask_pb2, struct_pb2, timestamp_pb2, wrappers_pb2)
"""Modules of well-known types, which do not import each other."""

ENCODINGS = ("ros1", "cdr", "protobuf", "json")


def decoder_of(topic: Topic, distribution: str | None = None) -> Decoder:
    """Return a decoder for the messages of a topic.

    Args:
        distribution: ROS release that the log names, for types that the log does not define.

    Raises:
        LogError: the definition is missing or invalid, or the encoding is unknown.
    """
    try:
        match topic.encoding:
            case "ros1" | "cdr":
                return ros_decoder(topic.type, topic.encoding, topic.schema, distribution)
            case "protobuf":
                return _protobuf_decoder(topic.type, _message_class(topic.type, topic.schema))
            case "json":
                return _decode_json
        raise LogError(f"the encoding {topic.encoding!r:.100} is not known; known are {', '.join(ENCODINGS)}")
    except LogError as error:
        raise LogError(f"topic {topic.name!r}: {error}") from None


def why_unreadable(topic: Topic, distribution: str | None = None) -> str | None:
    """Return the reason why the messages of a topic cannot be decoded, or None."""
    prefix = f"topic {topic.name!r}: "
    try:
        if topic.encoding in ("ros1", "cdr"):
            # making a decoder takes longer than checking its definition
            ros_definitions(topic.type, topic.encoding, topic.schema, distribution)
        else:
            decoder_of(topic)
    except LogError as error:
        return prefix + str(error).removeprefix(prefix)
    return None


def same_definition(first: Topic, second: Topic) -> bool:
    """Return whether two topics of one type have equal definitions, except for comments."""
    if first.schema == second.schema or first.encoding == "json":
        return True
    if first.encoding not in ("ros1", "cdr"):
        return False
    try:
        definitions = [ros_definitions(topic.type, topic.encoding, topic.schema) for topic in (first, second)]
    except LogError:
        return False
    return definitions[0] == definitions[1]


def _protobuf_decoder(type_name: str, message_class: type[Message]) -> Decoder:
    from_string = message_class.FromString

    def decode(payload: bytes) -> object:
        try:
            return from_string(payload)
        except DecodeError as error:
            raise LogError(f"a message is not a {type_name}: {error}") from None

    return decode


@lru_cache(64)
def _message_class(type_name: str, schema: Schema | None) -> type[Message]:
    if schema is None or schema.encoding != "protobuf":
        state = "missing" if schema is None else f"in {schema.encoding!r:.100}"
        raise LogError(f"the definition of {type_name!r:.100} is {state}; protobuf needs a descriptor set")
    # a pool for each type, because logs may define a name in different ways
    pool = DescriptorPool()
    try:
        for file in _in_order(_add_well_known_types(FileDescriptorSet.FromString(schema.data))):
            pool.AddSerializedFile(file.SerializeToString())
        return GetMessageClass(pool.FindMessageTypeByName(type_name))
    # contradictory descriptors raise TypeError, and unknown names KeyError
    except (DecodeError, TypeError, ValueError, KeyError, UnicodeError, RecursionError) as error:
        raise LogError(
            f"the definition of {type_name!r:.100} cannot be used: {failure_text(error)}"
        ) from None


def _add_well_known_types(descriptors: FileDescriptorSet) -> FileDescriptorSet:
    """Add the missing files of well-known types, such as timestamps, that files of a set import."""
    file_names = {file.name for file in descriptors.file}
    missing_names = {name for file in descriptors.file for name in file.dependency} - file_names
    for module in _WELL_KNOWN:
        if module.DESCRIPTOR.name in missing_names:
            module.DESCRIPTOR.CopyToProto(descriptors.file.add())
    return descriptors


def _in_order(descriptors: FileDescriptorSet) -> list[FileDescriptorProto]:
    """Return the files, each after its imports, as the descriptor pool requires."""
    if len(descriptors.file) > _MOST_FILES:
        raise ValueError(f"it has {len(descriptors.file)} files; at most {_MOST_FILES} are read")
    files = {file.name: file for file in descriptors.file}
    imports = {
        name: [imported_name for imported_name in file.dependency if imported_name in files]
        for name, file in files.items()
    }
    try:
        return [files[name] for name in TopologicalSorter(imports).static_order()]
    except CycleError as error:
        raise ValueError(f"{error.args[1][0]!r:.100} imports itself") from None


def _decode_json(payload: bytes) -> object:
    try:
        return json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise LogError(f"a message is not JSON: {error!s:.200}") from None


def topics_by_name(described: Iterable[Topic], distribution: str | None = None) -> tuple[Topic, ...]:
    """Return one topic for each name, sorted by name; `unreadable` is set for topics that cannot be decoded.

    Args:
        distribution: ROS release that the log names.
    """
    topic_by_name: dict[str, Topic] = {}
    for topic in described:
        earlier_topic = topic_by_name.get(topic.name)
        topic_by_name[topic.name] = topic if earlier_topic is None else _join(earlier_topic, topic)
    return tuple(
        topic if topic.unreadable else replace(topic, unreadable=why_unreadable(topic, distribution))
        for _, topic in sorted(topic_by_name.items())
    )


def topic_of(channel: Channel, count: int | None = None) -> Topic:
    """Return the topic of a channel; `count` is the declared number of messages."""
    schema = channel.schema
    is_ros = channel.encoding in ("ros1", "cdr")
    name = schema.name if schema else ""
    return Topic(
        name=channel.topic,
        type=full_type_name(name) if is_ros else name,
        encoding=channel.encoding,
        count=count,
        schema=schema,
        latched=is_latched(channel.metadata.get("offered_qos_profiles", ""))
        or channel.metadata.get("latching") in ("1", "true"),
        metadata=channel.metadata,
    )


def channel_of(topic: Topic, distribution: str | None = None) -> Channel:
    """Return the channel of a topic in a copy of the log, where messages are unchanged.

    Args:
        distribution: ROS release that the log names, for types that the log does not define.
    """
    schema = topic.schema
    if topic.encoding in ("ros1", "cdr") and (schema is None or not schema.data.strip()):
        try:
            schema = standard_schema(topic.type, topic.encoding, distribution)  # type: ignore[arg-type]
        except LogError:
            # without a definition, viewers at least show the type
            schema = schema or Schema(topic.type, "", b"")
    return Channel(topic.name, topic.encoding, schema, topic.metadata)


def _join(first: Topic, second: Topic) -> Topic:
    has_counts = None not in (first.count, second.count)
    joined_topic = replace(
        first,
        count=(first.count or 0) + (second.count or 0) if has_counts else None,
        latched=first.latched or second.latched,
        schema=first.schema or second.schema,
    )
    for attribute in ("type", "encoding"):
        if getattr(first, attribute) != getattr(second, attribute):
            values_text = f"{getattr(first, attribute)!r} and {getattr(second, attribute)!r}"
            return replace(
                joined_topic,
                unreadable=f"topic {first.name!r} has messages of more than one {attribute}: {values_text}",
            )
    if None not in (first.schema, second.schema) and not same_definition(first, second):
        return replace(
            joined_topic, unreadable=f"topic {first.name!r} has messages of {first.type!r} in two definitions"
        )
    return joined_topic
