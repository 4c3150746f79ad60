"""Parse definitions of message types in MSG form to fields with bounded sizes.

A definition comes with the log and is not trusted. A definition is accepted only if names are plain
identifiers, references resolve without a cycle, and sizes are bounded.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from spatial_replay.errors import LogError

Decoder = Callable[[bytes], object]
"""Function from a payload to a message with fields: attributes in ROS and protobuf, keys in JSON."""


Kind: TypeAlias = Literal["scalar", "array", "sequence"]

LONGEST_TEXT = 2**18
MOST_TYPES = 1_000
MOST_FIELDS = 4_000
MOST_VALUES = 4_000
"""Maximum number of values that a definition requires; each value becomes lines of generated code."""
MOST_VALUES_IN_ALL = 12_000
"""Maximum number of values of a type and of all types that the type uses."""

BASE_BYTES: Mapping[str, int] = {
    **dict.fromkeys(("bool", "byte", "char", "octet", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32", "string"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
"""Least size of a value by base type, bytes; a string has at least its length field."""
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
# built-in types of ROS 1: http://wiki.ros.org/msg
_BUILT_IN = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message type.

    Attributes:
        type: base type, or full name of a message type.
        size: length of an array, or bound of a sequence; 0 for no bound.
        longest: bound of a string's length; 0 for no bound.
    """

    name: str
    type: str
    kind: Kind = "scalar"
    size: int = 0
    longest: int = 0


Definitions: TypeAlias = Mapping[str, tuple[Field, ...]]
"""Message types with their fields, by full name."""


def full_type_name(name: str) -> str:
    """Insert `msg` into the name of a ROS type: geometry_msgs/Pose becomes geometry_msgs/msg/Pose."""
    name_parts = name.split("/")
    return "/".join([name_parts[0], "msg", name_parts[1]]) if len(name_parts) == 2 else name


def definitions_from_msg(text: str, type_name: str) -> Definitions:
    """Parse the types in a .msg text: the main type, then each used type after a line of equals signs.

    Constants and default values are ignored, because messages do not depend on these values.

    Raises:
        LogError: a line is not a field, or a name is malformed.
    """
    sections = list(iter_sections(text, type_name))
    section_names = {name for name, _ in sections}
    fields_by_type: dict[str, tuple[Field, ...]] = {}
    for name, body in sections:
        if name not in fields_by_type:
            fields_by_type[name] = tuple(_iter_fields(body, name, section_names))
    return fields_by_type


def iter_sections(text: str, type_name: str) -> Iterator[tuple[str, str]]:
    """Yield each type's name and text; the first type may lack a head line."""
    if len(text) > LONGEST_TEXT:
        raise LogError(
            f"the definition of {type_name!r:.100} has {len(text)} characters;"
            f" at most {LONGEST_TEXT} are read"
        )
    for section in _SEPARATOR.split(text):
        head_match = _HEAD.match(section)
        if head_match:
            yield checked_type_name(full_type_name(head_match["name"])), section[head_match.end() :]
        elif section.strip():
            yield checked_type_name(full_type_name(type_name)), section


def checked_type_name(name: str) -> str:
    """Return a valid name of a message type unchanged.

    Raises:
        LogError: the name is invalid.
    """
    if len(name) > 256 or not _TYPE_NAME.fullmatch(name):
        raise LogError(f"{name!r:.100} is not a name of a message type, such as geometry_msgs/msg/Pose")
    return name


def _iter_fields(body: str, owner: str, type_names: set[str]) -> Iterator[Field]:
    for line_number, line in enumerate(body.splitlines(), 1):
        # an annotation may be on the line of its field; no encoding of ROS depends on annotations
        bare_line = _ANNOTATIONS.sub("", line.partition("#")[0])
        if not bare_line.strip():
            continue
        field_match = _FIELD.fullmatch(bare_line)
        if field_match is None:
            raise LogError(
                f"the definition of {owner!r}, line {line_number}: {line.strip()!r:.100} is not a field"
            )
        # a constant is not in the bytes of a message
        if field_match["rest"].startswith("="):
            continue
        limit_text, longest = field_match["limit"] or "", int(field_match["longest"] or 0)
        kind: Kind = (
            "scalar" if not field_match["brackets"] else "array" if limit_text.isdigit() else "sequence"
        )
        type_name = _resolve(field_match["type"], owner, type_names)
        yield Field(field_match["name"], type_name, kind, int(limit_text.removeprefix("<=") or 0), longest)


def _resolve(name: str, owner: str, type_names: set[str]) -> str:
    if name in BASE_BYTES or name in _NOT_READ:
        return name
    if name in _BUILT_IN:
        return _BUILT_IN[name]
    if "/" in name:
        return full_type_name(name)
    neighbour = f"{owner.rpartition('/')[0]}/{name}"
    # ROS 1 writes a header without its package: http://wiki.ros.org/msg
    return "std_msgs/msg/Header" if name == "Header" and neighbour not in type_names else neighbour


def check_definitions(definitions: Definitions, type_name: str, *, empty_bytes: int) -> Definitions:
    """Check that generating a type's decoder is safe; return the type and all types that it uses.

    Args:
        empty_bytes: size of a message without fields, bytes: 0 in ROS 1, 1 in ROS 2.

    Raises:
        LogError: a type is missing, contains itself or is too large, or a name is invalid.
    """
    walk = _Walk(definitions, empty_bytes)
    walk.measure(type_name, ())
    return walk.used


class _Walk:
    """Visits all used types, and measures their numbers of values and least sizes."""

    def __init__(self, definitions: Definitions, empty_bytes: int) -> None:
        self._definitions = definitions
        self._empty_bytes = empty_bytes
        self._measures: dict[str, tuple[int, int]] = {}
        self._total_values = 0
        self.used: dict[str, tuple[Field, ...]] = {}

    def measure(self, name: str, above: tuple[str, ...]) -> tuple[int, int]:
        """Return the number of values of a type, and its least size in bytes."""
        if name in self._measures:
            return self._measures[name]
        if name not in self._definitions:
            raise LogError(f"the definition of {name!r:.100} is missing" + _used_by(above))
        # the depth is limited, because this function calls itself
        if name in above or len(above) >= 64:
            raise LogError(f"the type {name!r} contains itself" + _used_by(above))
        if len(self.used) >= MOST_TYPES:
            raise LogError(f"the definition uses more than {MOST_TYPES} types")
        fields = self._definitions[name]
        if len(fields) > MOST_FIELDS:
            raise LogError(f"{name!r:.100} has {len(fields)} fields; at most {MOST_FIELDS} are read")
        self.used[checked_type_name(name)] = fields
        _check_field_names(name, fields)
        value_count = least_bytes = 0
        for field in fields:
            field_values, field_bytes = self._field(field, name, (*above, name))
            value_count += field_values
            least_bytes += field_bytes
        if value_count > MOST_VALUES:
            raise LogError(
                f"{name!r} requires {value_count} values in a message; at most {MOST_VALUES} are read"
            )
        self._total_values += value_count
        if self._total_values > MOST_VALUES_IN_ALL:
            raise LogError(
                f"{name!r} and the other used types require {self._total_values} values; at most"
                f" {MOST_VALUES_IN_ALL} are read"
            )
        self._measures[name] = value_count, least_bytes if fields else self._empty_bytes
        return self._measures[name]

    def _field(self, field: Field, owner: str, above: tuple[str, ...]) -> tuple[int, int]:
        if field.type in _NOT_READ:
            raise LogError(f"{field.name!r} of {owner!r} is a {field.type}, which is not read")
        if field.type in BASE_BYTES:
            # generated code reads an array of numbers as one block, but an array of strings string by string
            value_count, least_bytes = 1, BASE_BYTES[field.type]
            is_block = field.type != "string"
        else:
            value_count, least_bytes = self.measure(field.type, above)
            is_block = False
        if field.kind == "array":
            return (1 if is_block else max(1, value_count) * field.size), least_bytes * field.size
        if field.kind == "sequence":
            if not least_bytes:
                raise LogError(f"{field.name!r} of {owner!r} is a sequence of items that take no bytes")
            return value_count, 4
        return value_count, least_bytes


def _check_field_names(name: str, fields: tuple[Field, ...]) -> None:
    field_names: set[str] = set()
    for field in fields:
        if len(field.name) > 256 or not _NAME.fullmatch(field.name):
            raise LogError(f"{field.name!r:.100} is not a name of a field; it is in {name!r}")
        if field.name in field_names:
            raise LogError(f"the type {name!r} has two fields {field.name!r}")
        field_names.add(field.name)


def _used_by(above: tuple[str, ...]) -> str:
    return f"; it is used by {above[-1]!r}" if above else ""


def msg_from_definitions(definitions: Definitions, type_name: str) -> str:
    """Write a .msg text of a type and the types that it uses; `definitions_from_msg` reads it back."""
    lines: list[str] = []
    for name in sorted(definitions, key=lambda name: name != type_name):
        if name != type_name:
            lines += ["=" * 80, f"MSG: {name.replace('/msg/', '/')}"]
        lines += [f"{_field_text(field)} {field.name}" for field in definitions[name]]
    return "".join(f"{line}\n" for line in lines)


def _field_text(field: Field) -> str:
    type_text = field.type.replace("/msg/", "/") + (f"<={field.longest}" if field.longest else "")
    match field.kind:
        case "scalar":
            return type_text
        case "array":
            return f"{type_text}[{field.size}]"
        case "sequence":
            return f"{type_text}[<={field.size}]" if field.size else f"{type_text}[]"
