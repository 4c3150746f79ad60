"""The fields of decoded messages, whatever decoded them: ROS, protobuf or JSON."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, Literal, TypeAlias

Style: TypeAlias = Literal["attributes", "keys"]


def style_of(value: object) -> Style:
    """How the fields of a message are reached: JSON objects by key, all others by attribute."""
    return "keys" if isinstance(value, dict) else "attributes"


def field_names(value: object) -> tuple[str, ...]:
    """The names of the fields of a message or a part of it; none for numbers, texts and lists."""
    if isinstance(value, dict):
        return tuple(name for name in value if isinstance(name, str))
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        return tuple(field.name for field in descriptor.fields)
    if is_dataclass(value):
        return tuple(field.name for field in fields(value) if not field.name.startswith("__"))
    return ()


def get_field(value: Any, name: str) -> object:
    """The value of a field that `field_names` lists."""
    found: object = value[name] if isinstance(value, dict) else getattr(value, name)
    return found


def type_name(value: object) -> str:
    """What a message or a part of it is called."""
    if isinstance(value, dict):
        return "the JSON object"
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        return str(descriptor.full_name)
    ros_type = getattr(value, "__msgtype__", None)
    if isinstance(ros_type, str):
        return ros_type
    if isinstance(value, str):
        return "a text"
    if isinstance(value, bool):
        return "a truth value"
    if isinstance(value, int | float):
        return "a number"
    return "a list" if hasattr(value, "__len__") else "nothing" if value is None else "a value"
