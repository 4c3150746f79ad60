"""Decoders of ROS messages, from the definition in the log or the standard definition.

Decoders are Python code that rosbags generates from the names and sizes in a definition. So a definition is
checked before rosbags gets it (see `definitions`).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

from spatial_replay.bags.definitions import (
    BASE_BYTES,
    Decoder,
    Definitions,
    Field,
    Kind,
    check_definitions,
    checked_type_name,
    definitions_from_msg,
    full_type_name,
    iter_sections,
    msg_from_definitions,
)
from spatial_replay.errors import LogError
from spatial_replay.logs.messages import Schema

if TYPE_CHECKING:
    from rosbags.interfaces.typing import BaseDesc, FieldDesc, NameDesc, Typesdict
    from rosbags.typesys.store import Typestore

RosEncoding = Literal["ros1", "cdr"]

_DISTRIBUTIONS = ("jazzy", "kilted", "lyrical", "iron", "humble", "galactic", "foxy", "eloquent", "dashing")
# representation identifiers of plain CDR, little and big endian, in the OMG's DDSI-RTPS (section 10);
# parameter lists and XCDR 2 have other identifiers and another layout
_PLAIN = (b"\x00\x01", b"\x00\x00")
_MOST_AROUND = 7
"""Maximum size of a message outside its fields: a head of four bytes, and up to three bytes of padding."""
_LONGEST_IDL = 2**17
_MOST_ANNOTATIONS = 500
_IDL_ASIDE = re.compile(r'"(?:\\"|[^"])*"|\'(?:[^\'\\\n]|\\.)*\'|//[^\n]*|/\*.*?\*/', re.DOTALL)
"""Strings and comments, as the parser of rosbags reads them."""
_IDL_ANNOTATION = re.compile(r"@[A-Za-z_][\w:]*\s*\(")
_IDL_ENUM = re.compile(r"\benum\s+([A-Za-z]\w*)\s*\{", re.ASCII)
_IDL_NESTED_TYPE = re.compile(r"<[^<>]*<[^<>]*<")
# values of `Nodetype` in rosbags
_KINDS: dict[int, Kind] = {3: "array", 4: "sequence"}


@lru_cache(256)
def ros_definitions(
    type_name: str, encoding: RosEncoding, schema: Schema | None, distribution: str | None = None
) -> tuple[Definitions, ...]:
    """Return the possible definitions of a type: from the log, or the standards of the ROS releases.

    Args:
        type_name: full name, such as geometry_msgs/msg/Pose.
        schema: definition in the log; None for a standard type without a definition in the log.
        distribution: ROS release that the log names.

    Raises:
        LogError: there is no definition, or it is invalid.
    """
    empty_bytes = 1 if encoding == "cdr" else 0
    if not type_name:
        raise LogError(
            "the log has no message definition and no type of it; name a standard `type` in a mapping"
        )
    checked_type_name(type_name)
    if schema is None or not schema.data.strip():
        definitions = [
            check_definitions(standard_types, type_name, empty_bytes=empty_bytes)
            for standard_types in _standards(encoding, distribution)
            if type_name in standard_types
        ]
        if not definitions:
            raise LogError(f"the log has no definition of {type_name!r}, which is not a standard ROS type")
        return tuple(
            definition
            for index, definition in enumerate(definitions)
            if definition not in definitions[:index]
        )
    log_definitions = _parse(type_name, schema)
    standard_types = next(iter(_standards(encoding, distribution)))
    return (check_definitions({**standard_types, **log_definitions}, type_name, empty_bytes=empty_bytes),)


@lru_cache(64)
def ros_decoder(
    type_name: str, encoding: RosEncoding, schema: Schema | None, distribution: str | None = None
) -> Decoder:
    """Return a decoder for the messages of a type.

    Raises:
        LogError: the definition of the type is missing or invalid.
    """
    possible_definitions = ros_definitions(type_name, encoding, schema, distribution)
    decoders = [_decoder(type_name, encoding, definitions) for definitions in possible_definitions]
    return decoders[0] if len(decoders) == 1 else _first_that_fits(decoders)


def _decoder(type_name: str, encoding: RosEncoding, definitions: Definitions) -> Decoder:
    from rosbags.typesys import Stores, get_typestore

    try:
        type_store = get_typestore(Stores.EMPTY)
        type_store.register(_describe(definitions, type_store))
        type_store.get_msgdef(type_name)
    # rosbags raises errors of many undocumented types if it cannot generate code
    except Exception as error:
        raise LogError(f"the definition of {type_name!r} cannot be used: {failure_text(error)}") from None
    return _cdr_decoder(type_store, type_name) if encoding == "cdr" else _ros1_decoder(type_store, type_name)


def _ros1_decoder(store: Typestore, type_name: str) -> Decoder:
    definition = store.get_msgdef(type_name)
    deserialize, message_class = definition.deserialize_ros1, definition.cls

    def decode(payload: bytes) -> object:
        try:
            message, end = deserialize(payload, 0, message_class, store)
        # bytes that do not fit raise errors of many types
        except Exception as error:
            raise LogError(f"a message is not a {type_name}: {failure_text(error)}") from None
        if end != len(payload):
            raise LogError(f"a message is not a {type_name}: it has {len(payload)} bytes, not {end}")
        return message

    return decode


def _cdr_decoder(store: Typestore, type_name: str) -> Decoder:
    definition = store.get_msgdef(type_name)
    little, big, message_class = definition.deserialize_cdr_le, definition.deserialize_cdr_be, definition.cls

    def decode(payload: bytes) -> object:
        try:
            # alignment counts from the end of the head, four bytes that name the encoding
            deserialize = little if payload[1] else big
            message, end = deserialize(payload[4:], 0, message_class, store)
        except Exception as error:
            raise LogError(f"a message is not a {type_name}: {failure_text(error)}") from None
        if not 4 <= len(payload) - end <= _MOST_AROUND or payload[:2] not in _PLAIN:
            size_text = f"it has {len(payload)} bytes, {end + 4} were expected"
            raise LogError(f"a message is not a {type_name} in plain CDR: {size_text}")
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


def failure_text(error: Exception) -> str:
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
    readable_text = "ros1msg, ros2msg and ros2idl are read"
    raise LogError(f"the definition of {type_name!r} is in {schema.encoding!r:.100}; {readable_text}")


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
        raise LogError(f"the definition of {type_name!r} cannot be read: {failure_text(error)}") from None
    enum_names = {*_IDL_ENUM.findall(_IDL_ASIDE.sub(" ", text))}
    return {
        name: tuple(_without_enum(field, fields_by_type, enum_names) for field in fields)
        for name, fields in fields_by_type.items()
    }


def _without_enum(field: Field, definitions: Definitions, enum_names: Collection[str]) -> Field:
    """Return a field with its enum replaced by uint32, the integer that CDR writes for an enum."""
    is_enum = field.type not in definitions and field.type.rpartition("/")[2] in enum_names
    return replace(field, type="uint32") if is_enum else field


def _check_idl(text: str, type_name: str) -> None:
    """Check that rosbags can parse a text in IDL within seconds.

    The parser's time grows fast with the depth of parentheses, and by milliseconds per annotation.
    """
    bare_text = _IDL_ASIDE.sub(" ", text) if len(text) <= _LONGEST_IDL else ""
    fault = None
    if len(text) > _LONGEST_IDL:
        fault = f"has {len(text)} characters; at most {_LONGEST_IDL} are read"
    elif "<<" in bare_text:
        fault = "shifts numbers; shifts are not read"
    elif bare_text.count("(") > len(_IDL_ANNOTATION.findall(bare_text)):
        fault = "has parentheses outside annotations, or nested ones; they are not read"
    elif _IDL_NESTED_TYPE.search(bare_text):
        fault = "nests types deeply; such types are not read"
    elif bare_text.count("@") > _MOST_ANNOTATIONS:
        fault = f"has {bare_text.count('@')} annotations; at most {_MOST_ANNOTATIONS} are read"
    if fault is not None:
        raise LogError(f"the definition of {type_name!r} {fault}")


def _standards(encoding: RosEncoding, distribution: str | None) -> Iterator[Definitions]:
    """Yield the standard types of each ROS release: the named release first, then the likeliest releases."""
    if encoding == "ros1":
        yield _standard("ros1_noetic")
        return
    for name in sorted(_DISTRIBUTIONS, key=lambda name: name != distribution):
        yield _standard(f"ros2_{name}")


@lru_cache(16)
def _standard(store: str) -> Definitions:
    from rosbags.typesys import Stores, get_typestore

    return _fields(get_typestore(Stores(store)).fielddefs)


def _fields(types: Typesdict) -> dict[str, tuple[Field, ...]]:
    """Convert types from the form of rosbags."""
    return {
        full_type_name(name): tuple(_field(field, description) for field, description in fields)
        for name, (_, fields) in types.items()
    }


def _field(name: str, description: FieldDesc) -> Field:
    kind = _KINDS.get(int(description[0]))
    # the type hints of rosbags do not describe its nested tuples
    base_description: Any = description
    size = 0
    if kind:
        base_description, size = base_description[1]
    type_text = base_description[1]
    type_name, longest_text = (type_text, 0) if isinstance(type_text, str) else type_text
    return Field(name, type_name, kind or "scalar", size, longest_text)


def _describe(definitions: Definitions, store: Typestore) -> Typesdict:
    """Convert the types that a store lacks to the form of rosbags."""
    return {
        name: ([], [(field.name, _description(field)) for field in fields])
        for name, fields in definitions.items()
        if name not in store.fielddefs
    }


def _description(field: Field) -> FieldDesc:
    from rosbags.interfaces import Nodetype

    base_description: BaseDesc | NameDesc
    if field.type in BASE_BYTES:
        base_description = (Nodetype.BASE, (field.type, field.longest))  # type: ignore[assignment]
    else:
        base_description = (Nodetype.NAME, field.type)
    if field.kind == "scalar":
        return base_description
    return (Nodetype.ARRAY if field.kind == "array" else Nodetype.SEQUENCE, (base_description, field.size))


def standard_schema(type_name: str, encoding: RosEncoding, distribution: str | None = None) -> Schema:
    """Return the definition of a standard type, for a copy of a log without this definition.

    Raises:
        LogError: the type is not a standard type.
    """
    definitions = ros_definitions(type_name, encoding, None, distribution)[0]
    text = msg_from_definitions(definitions, type_name).encode()
    if encoding == "ros1":
        return Schema(type_name.replace("/msg/", "/"), "ros1msg", text)
    return Schema(type_name, "ros2msg", text)
