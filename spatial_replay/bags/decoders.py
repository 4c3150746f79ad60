"""Topics of a log, and decoders of their payloads by their encoding.

The decoders of ROS messages are Python code that rosbags generates from names and sizes and then runs. A
definition comes with the log and is not trusted: it gets through only if names are plain identifiers,
references resolve without a cycle, and sizes are bounded.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

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

from spatial_replay.errors import LogError
from spatial_replay.logs.messages import Channel, Schema

Decoder = Callable[[bytes], object]
"""A payload to an object with fields: attributes of ROS and protobuf messages, keys of a JSON object."""

_LATCHED = re.compile(r"durability: *(1|transient_local)\b")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a log, of one type and encoding.

    Attributes:
        type: as rosbags names ROS types (`turtlesim/msg/Pose`), else the schema's name
            (`foxglove.SceneUpdate`); empty where the log does not say.
        encoding: of the messages: ros1, cdr, protobuf, json.
        count: how many messages the log declares, or None.
        schema: the definition as the log has it, or None.
        latched: whether its last message before a window still counts (latched, transient local).
        unreadable: why its messages cannot be decoded, or None.
        metadata: of its channel, as an MCAP log has it.
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


Kind: TypeAlias = Literal["scalar", "array", "sequence"]

LONGEST_TEXT = 2**18
MOST_TYPES = 1_000
MOST_FIELDS = 4_000
MOST_VALUES = 4_000
"""Values in one message that its definition alone, not its bytes, asks for: each becomes lines of code."""
MOST_VALUES_IN_ALL = 12_000
"""The same, over a type and all those that it uses."""

BASE_BYTES: Mapping[str, int] = {
    **dict.fromkeys(("bool", "byte", "char", "octet", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32", "string"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
"""The least number of bytes that a value takes; a string has at least its length."""
_NOT_READ = frozenset({"wstring", "wchar", "char16", "float128"})
"""Base types of ROS that are not read."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*){1,3}")
_FIELD = re.compile(
    r"\s*(?P<type>[A-Za-z][A-Za-z0-9_/]*)(?:<=(?P<longest>[0-9]{1,10}))?"
    r"(?P<brackets>\[(?P<limit>(?:<=)?[0-9]{1,10})?\])?[ \t]+(?P<name>[A-Za-z][A-Za-z0-9_]*)"
    r"[ \t]*(?P<rest>.*)"
)
_ANNOTATIONS = re.compile(r"^\s*(?:@[A-Za-z_]\w*(?:\s*\([^()]*\))?\s*)+", re.ASCII)
_SEPARATOR = re.compile(r"^={20,}[ \t]*\r?$", re.MULTILINE)
_HEAD = re.compile(r"\s*(?:MSG|IDL): *(?P<name>\S+)[ \t]*\r?(?:\n|\Z)")
_BUILT_IN = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message type.

    Attributes:
        type: a base type, or the full name of a message type.
        size: of an array; the bound of a sequence, 0 for none.
        longest: bound of a string's length, 0 for none.
    """

    name: str
    type: str
    kind: Kind = "scalar"
    size: int = 0
    longest: int = 0


Definitions: TypeAlias = Mapping[str, tuple[Field, ...]]
"""Message types with their fields, by full name."""


def full_type_name(name: str) -> str:
    """Return a ROS type's name with its middle part: geometry_msgs/Pose becomes geometry_msgs/msg/Pose."""
    parts = name.split("/")
    return "/".join([parts[0], "msg", parts[1]]) if len(parts) == 2 else name


def definitions_from_msg(text: str, type_name: str) -> Definitions:
    """Parse the types in a .msg text: its own, and those that it uses, after lines of equals signs.

    Constants and default values are left out: no message depends on them.

    Raises:
        LogError: a line that is not a field, a malformed name.
    """
    sections = list(iter_sections(text, type_name))
    section_names = {name for name, _ in sections}
    fields_by_type: dict[str, tuple[Field, ...]] = {}
    for name, body in sections:
        if name not in fields_by_type:
            fields_by_type[name] = tuple(_iter_fields(body, name, section_names))
    return fields_by_type


def iter_sections(text: str, type_name: str) -> Iterator[tuple[str, str]]:
    """Yield each type's name and text; the first may lack a head line."""
    if len(text) > LONGEST_TEXT:
        raise LogError(
            f"the definition of {type_name!r:.100} has {len(text)} characters;"
            f" at most {LONGEST_TEXT} are read"
        )
    for section in _SEPARATOR.split(text):
        head = _HEAD.match(section)
        if head:
            yield checked_type_name(full_type_name(head["name"])), section[head.end() :]
        elif section.strip():
            yield checked_type_name(full_type_name(type_name)), section


def checked_type_name(name: str) -> str:
    """Return the name, if it is one that a message type may have.

    Raises:
        LogError: it is not.
    """
    if len(name) > 256 or not _TYPE_NAME.fullmatch(name):
        raise LogError(f"{name!r:.100} is not a name of a message type, such as geometry_msgs/msg/Pose")
    return name


def _iter_fields(body: str, owner: str, known: set[str]) -> Iterator[Field]:
    for number, line in enumerate(body.splitlines(), 1):
        # an annotation may stand on the line of its field; no encoding of ROS depends on it so far
        bare = _ANNOTATIONS.sub("", line.partition("#")[0])
        if not bare.strip():
            continue
        field_match = _FIELD.fullmatch(bare)
        if field_match is None:
            raise LogError(
                f"the definition of {owner!r}, line {number}: {line.strip()!r:.100} is not a field"
            )
        if field_match["rest"].startswith("="):
            continue
        limit, longest = field_match["limit"] or "", int(field_match["longest"] or 0)
        kind: Kind = "scalar" if not field_match["brackets"] else "array" if limit.isdigit() else "sequence"
        type_name = _resolve(field_match["type"], owner, known)
        yield Field(field_match["name"], type_name, kind, int(limit.removeprefix("<=") or 0), longest)


def _resolve(name: str, owner: str, known: set[str]) -> str:
    if name in BASE_BYTES or name in _NOT_READ:
        return name
    if name in _BUILT_IN:
        return _BUILT_IN[name]
    if "/" in name:
        return full_type_name(name)
    neighbour = f"{owner.rpartition('/')[0]}/{name}"
    return "std_msgs/msg/Header" if name == "Header" and neighbour not in known else neighbour


def check_definitions(definitions: Definitions, type_name: str, *, empty_bytes: int) -> Definitions:
    """Return the type and those that it uses, if it is safe to generate decoders from them.

    Args:
        empty_bytes: what a message without fields takes: 0 in ROS 1, 1 in ROS 2.

    Raises:
        LogError: a type that is missing, contains itself, or asks for too much; a name that is none.
    """
    walk = _Walk(definitions, empty_bytes)
    walk.measure(type_name, ())
    return walk.used


class _Walk:
    """Visits each type that is used; knows how many values it asks for, and how few bytes they may take."""

    def __init__(self, definitions: Definitions, empty_bytes: int) -> None:
        self._definitions = definitions
        self._empty_bytes = empty_bytes
        self._measured: dict[str, tuple[int, int]] = {}
        self._in_all = 0
        self.used: dict[str, tuple[Field, ...]] = {}

    def measure(self, name: str, above: tuple[str, ...]) -> tuple[int, int]:
        """Return how many values and at least how many bytes a type takes."""
        if name in self._measured:
            return self._measured[name]
        if name not in self._definitions:
            raise LogError(f"the definition of {name!r:.100} is missing" + _used_by(above))
        if name in above or len(above) >= 64:
            raise LogError(f"the type {name!r} contains itself" + _used_by(above))
        if len(self.used) >= MOST_TYPES:
            raise LogError(f"the definition uses more than {MOST_TYPES} types")
        fields = self._definitions[name]
        if len(fields) > MOST_FIELDS:
            raise LogError(f"{name!r:.100} has {len(fields)} fields; at most {MOST_FIELDS} are read")
        self.used[checked_type_name(name)] = fields
        _check_field_names(name, fields)
        values = least = 0
        for member in fields:
            field_values, field_least = self._field(member, name, (*above, name))
            values += field_values
            least += field_least
        if values > MOST_VALUES:
            raise LogError(f"{name!r} asks for {values} values in a message; at most {MOST_VALUES} are read")
        self._in_all += values
        if self._in_all > MOST_VALUES_IN_ALL:
            raise LogError(
                f"{name!r} and the types beside it ask for {self._in_all} values; at most"
                f" {MOST_VALUES_IN_ALL} are read"
            )
        self._measured[name] = values, least if fields else self._empty_bytes
        return self._measured[name]

    def _field(self, field: Field, owner: str, above: tuple[str, ...]) -> tuple[int, int]:
        if field.type in _NOT_READ:
            raise LogError(f"{field.name!r} of {owner!r} is a {field.type}, which is not read")
        if field.type in BASE_BYTES:
            values, least = 1, BASE_BYTES[field.type]
            by_block = field.type != "string"
        else:
            values, least = self.measure(field.type, above)
            by_block = False
        if field.kind == "array":
            return (1 if by_block else max(1, values) * field.size), least * field.size
        if field.kind == "sequence":
            if not least:
                raise LogError(f"{field.name!r} of {owner!r} is a sequence of items that take no bytes")
            return values, 4
        return values, least


def _check_field_names(name: str, fields: tuple[Field, ...]) -> None:
    seen: set[str] = set()
    for member in fields:
        if len(member.name) > 256 or not _NAME.fullmatch(member.name):
            raise LogError(f"{member.name!r:.100} is not a name of a field; it is in {name!r}")
        if member.name in seen:
            raise LogError(f"the type {name!r} has two fields {member.name!r}")
        seen.add(member.name)


def _used_by(above: tuple[str, ...]) -> str:
    return f"; it is used by {above[-1]!r}" if above else ""


def msg_from_definitions(definitions: Definitions, type_name: str) -> str:
    """Write a .msg text of a type and those that it uses, as `definitions_from_msg` reads it."""
    lines: list[str] = []
    for name in sorted(definitions, key=lambda name: name != type_name):
        if name != type_name:
            lines += ["=" * 80, f"MSG: {name.replace('/msg/', '/')}"]
        lines += [f"{_field_text(field)} {field.name}" for field in definitions[name]]
    return "".join(f"{line}\n" for line in lines)


def _field_text(field: Field) -> str:
    name = field.type.replace("/msg/", "/") + (f"<={field.longest}" if field.longest else "")
    match field.kind:
        case "scalar":
            return name
        case "array":
            return f"{name}[{field.size}]"
        case "sequence":
            return f"{name}[<={field.size}]" if field.size else f"{name}[]"


if TYPE_CHECKING:
    from rosbags.interfaces.typing import BaseDesc, FieldDesc, NameDesc, Typesdict
    from rosbags.typesys.store import Typestore

RosEncoding = Literal["ros1", "cdr"]

_DISTRIBUTIONS = ("jazzy", "kilted", "lyrical", "iron", "humble", "galactic", "foxy", "eloquent", "dashing")
_PLAIN = (b"\x00\x01", b"\x00\x00")
_MOST_AROUND = 7
"""Bytes of a message that hold no field: four before them, and up to three that fill it up."""
_LONGEST_IDL = 2**17
_MOST_ANNOTATIONS = 500
_IDL_ASIDE = re.compile(r'"(?:\\"|[^"])*"|\'(?:[^\'\\\n]|\\.)*\'|//[^\n]*|/\*.*?\*/', re.DOTALL)
"""Strings and comments, as the parser takes them."""
_IDL_ANNOTATION = re.compile(r"@[A-Za-z_][\w:]*\s*\(")
_IDL_ENUM = re.compile(r"\benum\s+([A-Za-z]\w*)\s*\{", re.ASCII)
_IDL_NESTED_TYPE = re.compile(r"<[^<>]*<[^<>]*<")
_KINDS: dict[int, Kind] = {3: "array", 4: "sequence"}


@lru_cache(256)
def ros_definitions(
    type_name: str, encoding: RosEncoding, schema: Schema | None, distribution: str | None = None
) -> tuple[Definitions, ...]:
    """Return the definitions that messages of a type may have: one, or those of each release of ROS.

    Args:
        type_name: in full, such as geometry_msgs/msg/Pose.
        schema: None where the log has none; then the type must be a standard one.
        distribution: the ROS release that the log names.

    Raises:
        LogError: none, or one that cannot be understood.
    """
    empty_bytes = 1 if encoding == "cdr" else 0
    if not type_name:
        raise LogError(
            "the log has no message definition and no type of it; name a standard `type` in a mapping"
        )
    checked_type_name(type_name)
    if schema is None or not schema.data.strip():
        definitions = [
            check_definitions(standard, type_name, empty_bytes=empty_bytes)
            for standard in _standards(encoding, distribution)
            if type_name in standard
        ]
        if not definitions:
            raise LogError(f"the log has no definition of {type_name!r}, which is not a standard ROS type")
        return tuple(
            definition
            for index, definition in enumerate(definitions)
            if definition not in definitions[:index]
        )
    from_schema = _parse(type_name, schema)
    standard = next(iter(_standards(encoding, distribution)))
    return (check_definitions({**standard, **from_schema}, type_name, empty_bytes=empty_bytes),)


@lru_cache(64)
def ros_decoder(
    type_name: str, encoding: RosEncoding, schema: Schema | None, distribution: str | None = None
) -> Decoder:
    """Return a decoder for the messages of a type.

    Raises:
        LogError: its definition is missing or cannot be understood.
    """
    choices = ros_definitions(type_name, encoding, schema, distribution)
    decoders = [_decoder(type_name, encoding, definitions) for definitions in choices]
    return decoders[0] if len(decoders) == 1 else _first_that_fits(decoders)


def _decoder(type_name: str, encoding: RosEncoding, definitions: Definitions) -> Decoder:
    from rosbags.typesys import Stores, get_typestore

    try:
        store = get_typestore(Stores.EMPTY)
        store.register(_describe(definitions, store))
        store.get_msgdef(type_name)
    # rosbags raises errors of many undocumented types if it cannot generate code
    except Exception as error:
        raise LogError(f"the definition of {type_name!r} cannot be used: {_reason(error)}") from None
    return _cdr_decoder(store, type_name) if encoding == "cdr" else _ros1_decoder(store, type_name)


def _ros1_decoder(store: Typestore, type_name: str) -> Decoder:
    definition = store.get_msgdef(type_name)
    deserialize, message_class = definition.deserialize_ros1, definition.cls

    def decode(payload: bytes) -> object:
        try:
            message, end = deserialize(payload, 0, message_class, store)
        # bytes that do not fit raise errors of many types
        except Exception as error:
            raise LogError(f"a message is not a {type_name}: {_reason(error)}") from None
        if end != len(payload):
            raise LogError(f"a message is not a {type_name}: it has {len(payload)} bytes, not {end}")
        return message

    return decode


def _cdr_decoder(store: Typestore, type_name: str) -> Decoder:
    definition = store.get_msgdef(type_name)
    little, big, message_class = definition.deserialize_cdr_le, definition.deserialize_cdr_be, definition.cls

    def decode(payload: bytes) -> object:
        try:
            # alignment counts from behind the four bytes that say how the rest is encoded
            deserialize = little if payload[1] else big
            message, end = deserialize(payload[4:], 0, message_class, store)
        except Exception as error:
            raise LogError(f"a message is not a {type_name}: {_reason(error)}") from None
        if not 4 <= len(payload) - end <= _MOST_AROUND or payload[:2] not in _PLAIN:
            sizes = f"it has {len(payload)} bytes, {end + 4} were expected"
            raise LogError(f"a message is not a {type_name} in plain CDR: {sizes}")
        return message

    return decode


def _first_that_fits(decoders: list[Decoder]) -> Decoder:
    def decode(payload: bytes) -> object:
        for decoder in decoders[:-1]:
            try:
                return decoder(payload)
            except LogError:
                continue
        return decoders[-1](payload)

    return decode


def _reason(error: Exception) -> str:
    return f"{error!s:.200}" or type(error).__name__


def _parse(type_name: str, schema: Schema) -> Definitions:
    try:
        text = schema.data.decode()
    except UnicodeDecodeError:
        raise LogError(f"the definition of {type_name!r} is not UTF-8") from None
    if schema.encoding in ("ros1msg", "ros2msg"):
        return definitions_from_msg(text, type_name)
    if schema.encoding == "ros2idl":
        return _from_idl(text, type_name)
    readable = "ros1msg, ros2msg and ros2idl are read"
    raise LogError(f"the definition of {type_name!r} is in {schema.encoding!r:.100}; {readable}")


def _from_idl(text: str, type_name: str) -> Definitions:
    from rosbags.typesys import get_types_from_idl

    _check_idl(text, type_name)
    fields_by_type: dict[str, tuple[Field, ...]] = {}
    try:
        for _, body in iter_sections(text, type_name):
            fields_by_type |= _fields(get_types_from_idl(body))
    except LogError:
        raise
    except Exception as error:
        raise LogError(f"the definition of {type_name!r} cannot be read: {_reason(error)}") from None
    enums = {*_IDL_ENUM.findall(_IDL_ASIDE.sub(" ", text))}
    return {
        name: tuple(_without_enum(field, fields_by_type, enums) for field in fields)
        for name, fields in fields_by_type.items()
    }


def _without_enum(field: Field, known: Definitions, enums: Collection[str]) -> Field:
    """Return a field with an enum as the integer of four bytes that CDR writes for it."""
    is_enum = field.type not in known and field.type.rpartition("/")[2] in enums
    return replace(field, type="uint32") if is_enum else field


def _check_idl(text: str, type_name: str) -> None:
    """Check that a text in IDL can be parsed in seconds.

    The parser tries nested parentheses in ever more ways, and takes milliseconds for each annotation.
    """
    bare = _IDL_ASIDE.sub(" ", text) if len(text) <= _LONGEST_IDL else ""
    what = None
    if len(text) > _LONGEST_IDL:
        what = f"has {len(text)} characters; at most {_LONGEST_IDL} are read"
    elif "<<" in bare:
        what = "shifts numbers; shifts are not read"
    elif bare.count("(") > len(_IDL_ANNOTATION.findall(bare)):
        what = "has parentheses outside annotations, or nested ones; they are not read"
    elif _IDL_NESTED_TYPE.search(bare):
        what = "nests types deeply; such types are not read"
    elif bare.count("@") > _MOST_ANNOTATIONS:
        what = f"has {bare.count('@')} annotations; at most {_MOST_ANNOTATIONS} are read"
    if what is not None:
        raise LogError(f"the definition of {type_name!r} {what}")


def _standards(encoding: RosEncoding, distribution: str | None) -> Iterator[Definitions]:
    """Yield the standard types of each release, first of the release that is named, else of the likeliest."""
    if encoding == "ros1":
        yield _standard("ros1_noetic")
        return
    for name in sorted(_DISTRIBUTIONS, key=lambda name: name != distribution):
        yield _standard(f"ros2_{name}")


@lru_cache(16)
def _standard(store: str) -> Definitions:
    from rosbags.typesys import Stores, get_typestore

    return _fields(get_typestore(Stores(store)).fielddefs)


def _fields(described: Typesdict) -> dict[str, tuple[Field, ...]]:
    """Return types from the form that rosbags describes them in."""
    return {
        full_type_name(name): tuple(_field(field, description) for field, description in fields)
        for name, (_, fields) in described.items()
    }


def _field(name: str, description: FieldDesc) -> Field:
    kind = _KINDS.get(int(description[0]))
    # rosbags nests its tuples in a way that its types do not say
    item: Any = description
    size = 0
    if kind:
        item, size = item[1]
    what = item[1]
    type_name, longest = (what, 0) if isinstance(what, str) else what
    return Field(name, type_name, kind or "scalar", size, longest)


def _describe(definitions: Definitions, store: Typestore) -> Typesdict:
    """Describe the types that a store does not know yet, in the form of rosbags."""
    return {
        name: ([], [(field.name, _description(field)) for field in fields])
        for name, fields in definitions.items()
        if name not in store.fielddefs
    }


def _description(field: Field) -> FieldDesc:
    from rosbags.interfaces import Nodetype

    item: BaseDesc | NameDesc
    if field.type in BASE_BYTES:
        item = (Nodetype.BASE, (field.type, field.longest))  # type: ignore[assignment]
    else:
        item = (Nodetype.NAME, field.type)
    if field.kind == "scalar":
        return item
    return (Nodetype.ARRAY if field.kind == "array" else Nodetype.SEQUENCE, (item, field.size))


def standard_schema(type_name: str, encoding: RosEncoding, distribution: str | None = None) -> Schema:
    """Return the definition of a standard type, for a copy of a log that has none.

    Raises:
        LogError: it is not a standard type.
    """
    definitions = ros_definitions(type_name, encoding, None, distribution)[0]
    text = msg_from_definitions(definitions, type_name).encode()
    if encoding == "ros1":
        return Schema(type_name.replace("/msg/", "/"), "ros1msg", text)
    return Schema(type_name, "ros2msg", text)


_MOST_FILES = 1_000
"""Files that one descriptor set may hold."""

_WELL_KNOWN = (any_pb2, duration_pb2, empty_pb2, field_mask_pb2, struct_pb2, timestamp_pb2, wrappers_pb2)
"""None of these imports another."""

ENCODINGS = ("ros1", "cdr", "protobuf", "json")


def decoder_of(topic: Topic, distribution: str | None = None) -> Decoder:
    """Return a decoder for the messages of a topic.

    Args:
        distribution: the release of ROS that the log names, for types that it does not define.

    Raises:
        LogError: the definition is missing or cannot be understood, or the encoding is not known.
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
    """Return why the messages of a topic cannot be decoded, or None."""
    start = f"topic {topic.name!r}: "
    try:
        if topic.encoding in ("ros1", "cdr"):
            # making a decoder takes longer than checking its definition
            ros_definitions(topic.type, topic.encoding, topic.schema, distribution)
        else:
            decoder_of(topic)
    except LogError as error:
        return start + str(error).removeprefix(start)
    return None


def same_definition(one: Topic, other: Topic) -> bool:
    """Return whether one decoder serves two topics of the same type; texts may differ in comments."""
    if one.schema == other.schema or one.encoding == "json":
        return True
    if one.encoding not in ("ros1", "cdr"):
        return False
    try:
        definitions = [ros_definitions(topic.type, topic.encoding, topic.schema) for topic in (one, other)]
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
        place = "missing" if schema is None else f"in {schema.encoding!r:.100}"
        raise LogError(f"the definition of {type_name!r:.100} is {place}; protobuf needs a descriptor set")
    pool = DescriptorPool()
    try:
        for file in _in_order(_add_well_known_types(FileDescriptorSet.FromString(schema.data))):
            pool.AddSerializedFile(file.SerializeToString())
        return GetMessageClass(pool.FindMessageTypeByName(type_name))
    # descriptors that contradict themselves or each other end in TypeError, and names without one in KeyError
    except (DecodeError, TypeError, ValueError, KeyError, UnicodeError, RecursionError) as error:
        raise LogError(f"the definition of {type_name!r:.100} cannot be used: {_reason(error)}") from None


def _add_well_known_types(described: FileDescriptorSet) -> FileDescriptorSet:
    """Add the files of well-known types, such as timestamps, that a set imports without having them."""
    file_names = {file.name for file in described.file}
    imported = {name for file in described.file for name in file.dependency} - file_names
    for module in _WELL_KNOWN:
        if module.DESCRIPTOR.name in imported:
            module.DESCRIPTOR.CopyToProto(described.file.add())
    return described


def _in_order(described: FileDescriptorSet) -> list[FileDescriptorProto]:
    """Return the files, each after those that it imports."""
    if len(described.file) > _MOST_FILES:
        raise ValueError(f"it has {len(described.file)} files; at most {_MOST_FILES} are read")
    files = {file.name: file for file in described.file}
    imports = {
        name: [imported for imported in file.dependency if imported in files] for name, file in files.items()
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
    """Return one topic for each name, in order; those that cannot be decoded say why.

    Args:
        distribution: the release of ROS that the log names.
    """
    named: dict[str, Topic] = {}
    for topic in described:
        before = named.get(topic.name)
        named[topic.name] = topic if before is None else _join(before, topic)
    return tuple(
        topic if topic.unreadable else replace(topic, unreadable=why_unreadable(topic, distribution))
        for _, topic in sorted(named.items())
    )


def topic_of(channel: Channel, count: int | None = None) -> Topic:
    """Return the topic of a channel, of whose messages a log declares so many."""
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
    """Return the channel on which a copy of a log has the messages of a topic, as they are.

    Args:
        distribution: the release of ROS that the log names, for types that it does not define.
    """
    schema = topic.schema
    if topic.encoding in ("ros1", "cdr") and (schema is None or not schema.data.strip()):
        try:
            schema = standard_schema(topic.type, topic.encoding, distribution)  # type: ignore[arg-type]
        except LogError:
            # without a definition, viewers at least show the type
            schema = schema or Schema(topic.type, "", b"")
    return Channel(topic.name, topic.encoding, schema, topic.metadata)


def _join(one: Topic, other: Topic) -> Topic:
    has_counts = None not in (one.count, other.count)
    joined = replace(
        one,
        count=(one.count or 0) + (other.count or 0) if has_counts else None,
        latched=one.latched or other.latched,
        schema=one.schema or other.schema,
    )
    for what in ("type", "encoding"):
        if getattr(one, what) != getattr(other, what):
            both = f"{getattr(one, what)!r} and {getattr(other, what)!r}"
            return replace(
                joined, unreadable=f"topic {one.name!r} has messages of more than one {what}: {both}"
            )
    if None not in (one.schema, other.schema) and not same_definition(one, other):
        return replace(
            joined, unreadable=f"topic {one.name!r} has messages of {one.type!r} in two definitions"
        )
    return joined
