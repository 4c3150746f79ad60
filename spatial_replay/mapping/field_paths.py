"""Field paths: where in a message something stands, such as `poses[*].position.x`.

    path  =  ["$."] step { step }          "$." begins at the message where the path else begins at an object
    step  =  name | "." name | "[" number "]" | "[*]"

A path is read into steps and compiled to nested calls; nothing in it is ever evaluated, and only fields that
a message declares can be reached.

The fields of decoded messages, whatever decoded them: ROS, protobuf or JSON.

Names by template: `tag{id}`, `{ns|topic}_{id}`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from operator import attrgetter, itemgetter
from typing import Any, Final, Literal, TypeAlias, TypeGuard

from spatial_replay.errors import UsageError
from spatial_replay.text import nearest_hint

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


Get: TypeAlias = Callable[[Any], Any]

EACH: Final = "*"
PATTERN: Final = r"(\$\.)?[A-Za-z_][\w-]*(\.[A-Za-z_][\w-]*|\[(\d{1,9}|\*)\])*"
"""What a path looks like, as a regular expression."""

_STEP = re.compile(r"\.?([A-Za-z_][\w-]*)|\[(\d{1,9}|\*)\]", re.ASCII)
_PATH = re.compile(PATTERN, re.ASCII)


class FieldError(Exception):
    """A path that leads nowhere in a message; its text names the fields that are there."""


class ContentError(FieldError):
    """A field that is there, but holds what cannot be used."""


@dataclass(frozen=True, slots=True)
class Each:
    """The step `[*]`: every element of a list."""


Step: TypeAlias = str | int | Each


@dataclass(frozen=True, slots=True)
class FieldPath:
    """A field path.

    Attributes:
        text: as it was written.
        steps: names, indices, and `Each`.
        from_message: whether it begins at the message, wherever it is used.
    """

    text: str
    steps: tuple[Step, ...]
    from_message: bool = False

    @classmethod
    def of(cls, text: str) -> FieldPath:
        """
        Raises:
            UsageError: the text is no path.
        """
        if not _PATH.fullmatch(text):
            raise UsageError(
                f"{text[:80]!r} is no field path; write names with dots: pose.position.x, tags[0].id"
            )
        steps: list[Step] = []
        for found in _STEP.finditer(text.removeprefix("$.")):
            name, index = found.groups()
            steps.append(name if name else Each() if index == EACH else int(index))
        return cls(text, tuple(steps), text.startswith("$."))

    @property
    def count_of_lists(self) -> int:
        """How many `[*]` the path has."""
        return sum(isinstance(step, Each) for step in self.steps)


def check(path: FieldPath, value: object) -> None:
    """That a path without `[*]` leads somewhere from a value.

    Raises:
        FieldError: it does not; the text says where it ends and which fields are there.
    """
    walk(path, value)


def walk(path: FieldPath, value: object) -> object:
    """What stands at a path without `[*]`, found step by step.

    Raises:
        FieldError: as `check`.
    """
    for step in path.steps:
        if isinstance(step, str):
            value = _named(path, value, step)
        elif isinstance(step, int):
            value = _numbered(path, value, step)
    return value


def leads_somewhere(path: FieldPath, value: object) -> bool:
    """Whether a path without `[*]` leads somewhere from a value."""
    try:
        walk(path, value)
    except FieldError:
        return False
    return True


def _named(path: FieldPath, value: object, name: str) -> object:
    names = field_names(value)
    if name not in names:
        known = ", ".join(names[:20]) + (", …" if len(names) > 20 else "")
        hint = nearest_hint(name, names)
        raise FieldError(
            f"{path.text}: {type_name(value)} has no field {name!r}"
            + (f"; {hint}" if hint else "")
            + (f"; its fields are {known}" if names else "")
        )
    return get_field(value, name)


def _numbered(path: FieldPath, value: object, index: int) -> object:
    if not is_list(value):
        raise FieldError(f"{path.text}: [{index}] follows {type_name(value)}, which is no list")
    if index >= len(value):
        raise FieldError(f"{path.text}: there are only {len(value)} elements where [{index}] is asked for")
    return value[index]


def is_list(value: object) -> TypeGuard[Sequence[object]]:
    """Whether a field's value is a list of any kind: of ROS (arrays too), protobuf or JSON."""
    return (
        hasattr(value, "__len__")
        and hasattr(value, "__getitem__")
        and not isinstance(value, str | bytes | Mapping)
    )


def getter(path: FieldPath, style: Literal["attributes", "keys"]) -> Get:
    """A function from a value to what stands at a path without `[*]`.

    It is fast and its errors (AttributeError, LookupError, TypeError) say little: `check` says it well.
    """
    if style == "attributes" and all(isinstance(step, str) for step in path.steps):
        return attrgetter(".".join(str(step) for step in path.steps)) if path.steps else _itself
    chain = [_step(step, style) for step in path.steps]
    if not chain:
        return _itself
    if len(chain) == 1:
        return chain[0]

    def follow(value: Any) -> Any:
        for get in chain:
            value = get(value)
        return value

    return follow


def tuple_getter(
    paths: Sequence[FieldPath], style: Literal["attributes", "keys"]
) -> Callable[[Any], tuple[Any, ...]]:
    """A function from a value to what stands at each of one or more paths."""
    plain = all(isinstance(step, str) for path in paths for step in path.steps)
    if style == "attributes" and plain and len(paths) > 1:
        return attrgetter(*(".".join(str(step) for step in path.steps) for path in paths))
    each = [getter(path, style) for path in paths]
    if len(each) == 1:
        only = each[0]
        return lambda value: (only(value),)
    return lambda value: tuple([get(value) for get in each])


def iter_elements(path: FieldPath, message: object) -> Iterator[object]:
    """Every element that a path with `[*]` stands for, in order; of one without, what stands there.

    Raises:
        FieldError: the path leads nowhere.
    """
    values: list[object] = [message]
    for step in path.steps:
        if isinstance(step, str):
            values = [_named(path, value, step) for value in values]
        elif isinstance(step, int):
            values = [_numbered(path, value, step) for value in values]
        else:
            for value in values:
                if not is_list(value):
                    raise FieldError(f"{path.text}: [*] follows {type_name(value)}, which is no list")
            values = [element for value in values for element in value]  # type: ignore[attr-defined]
    return iter(values)


def list_getter(path: FieldPath, style: Literal["attributes", "keys"]) -> Get | None:
    """A fast function to the list that a path ends with, for the common `a.b[*]`; None for any other form."""
    *before, last = path.steps
    if isinstance(last, Each) and not any(isinstance(step, Each) for step in before):
        return getter(FieldPath(path.text, tuple(before)), style)
    return None


def _step(step: Step, style: Literal["attributes", "keys"]) -> Get:
    if isinstance(step, str):
        return attrgetter(step) if style == "attributes" else itemgetter(step)
    if isinstance(step, int):
        return itemgetter(step)
    raise ValueError("a path with [*] has many values")


def _itself(value: Any) -> Any:
    return value


def below(path: FieldPath, step: str | int) -> FieldPath:
    """A path with one more step."""
    text = f"{path.text}[{step}]" if isinstance(step, int) else f"{path.text}.{step}"
    return FieldPath(text, (*path.steps, step), path.from_message)


def is_number(value: object) -> bool:
    """Whether a field holds a number, or nothing where JSON may have one."""
    if isinstance(value, str | bytes) or value is None or field_names(value):
        return value is None
    try:
        float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return False
    return True


INDEX = "index"
TOPIC = "topic"

_ALTERNATIVES = rf"{PATTERN}(\|{PATTERN})*"
TEMPLATE_PATTERN = rf"([^{{}}]|\{{{_ALTERNATIVES}\}})+"
"""What a template looks like, as a regular expression."""

_PART = re.compile(r"\{([^{}]*)\}|([^{}]+)", re.ASCII)
_TEMPLATE = re.compile(TEMPLATE_PATTERN, re.ASCII)
_DROPPED_ENDS = frozenset(
    {"pose", "odom", "odometry", "state", "position", "location", "polygon", "footprint"}
)


@dataclass(frozen=True, slots=True)
class NameTemplate:
    """Literal text and fields in turn.

    Attributes:
        parts: a text, or the fields of which the first that is there and not empty is taken; the word `index`
            stands for an object's place in its list, `topic` for its topic, where no field is called so.
    """

    text: str
    parts: tuple[str | tuple[FieldPath, ...], ...]

    @classmethod
    def of(cls, text: str) -> NameTemplate:
        """
        Raises:
            UsageError: the text is no template.
        """
        if not _TEMPLATE.fullmatch(text):
            raise UsageError(
                f"{text[:80]!r} is no name; write text with fields in braces: tag{{id}}, {{ns}}_{{id}}"
            )
        parts: list[str | tuple[FieldPath, ...]] = []
        for found in _PART.finditer(text):
            fields, literal = found.groups()
            parts.append(
                literal if fields is None else tuple(FieldPath.of(each) for each in fields.split("|"))
            )
        return cls(text, tuple(parts))

    @property
    def is_constant(self) -> bool:
        """Whether every object gets the same name."""
        return all(isinstance(part, str) for part in self.parts)


def name_from_topic(topic: str) -> str:
    """What an object is called after its topic: `/turtle1/pose` → turtle1, `/pose` → pose."""
    words = [word for word in topic.split("/") if word]
    if len(words) > 1 and words[-1].lower() in _DROPPED_ENDS:
        words.pop()
    return "_".join(words) or "object"
