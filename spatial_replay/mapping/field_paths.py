"""Field paths such as `poses[*].position.x`, and name templates such as `tag{id}` that contain them.

    path      =  ["$."] step { step }      "$." starts at the message, not at the object in it
    step      =  key | "." key | "[" number "]" | "[*]" | "[best]" | "[index]" | key "[" path "=" text "]"
    key       =  name | "'" any characters but ' { } | "'"
    template  =  { text | "{" path { "|" path } "}" }

A key in quotes may have dots, spaces and letters beyond ASCII: `'pose.x'`. A number below 0 counts from the
end. `[*]` selects the elements of a list, or the values of a JSON object or a protobuf map. `[best]` selects
the element with the highest score. In names, `[index]` selects an element of another list, at the object's
index or key in the list of objects.

`tracks[id=7]` is the last element of `tracks` whose field `id` is 7. `position[name=elbow]` is the element of
`position` at the index of `elbow` in the neighbouring list `name`. Without a matching element the value is
unknown.

Messages are decoded ROS, protobuf or JSON messages. `walk` follows a path step by step and explains errors.
`getter` compiles a path to nested calls. A path comes from a file, so no part of it is evaluated as code. It
reaches only fields that the message declares.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from math import inf, isnan, nan
from operator import attrgetter, itemgetter
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias, TypeGuard

from spatial_replay.errors import UsageError
from spatial_replay.text import listing, nearest_hint

Style: TypeAlias = Literal["attributes", "keys"]


def style_of(value: object) -> Style:
    """Return the access to a message's fields: by key for JSON objects, otherwise by attribute."""
    return "keys" if isinstance(value, dict) else "attributes"


def field_names(value: object) -> tuple[str, ...]:
    """Return the field names of a message or a part of it; () for numbers, texts and lists."""
    if isinstance(value, dict):
        return tuple(name for name in value if isinstance(name, str))
    if isinstance(value, Mapping):
        return tuple(map(str, value))
    if _is_free(value):
        return tuple(value.fields)  # type: ignore[attr-defined]
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        return tuple(field.name for field in descriptor.fields)
    if is_dataclass(value):
        return tuple(field.name for field in fields(value) if not field.name.startswith("__"))
    return ()


def get_field(value: Any, name: str) -> object:
    """Return the value of a field that `field_names` lists."""
    if isinstance(value, dict):
        return _plain(value[name])
    if isinstance(value, Mapping):
        # keys of protobuf maps may be numbers
        return _plain(next(element for key, element in value.items() if str(key) == name))
    return _plain(value.fields[name] if _is_free(value) else getattr(value, name))


_FREE = "google.protobuf.Struct"


def _is_free(value: object) -> bool:
    """Return whether a value is a `google.protobuf.Struct`, in which each sender chooses the fields."""
    return getattr(getattr(value, "DESCRIPTOR", None), "full_name", "") == _FREE


def _plain(value: Any) -> Any:
    """Return a `google.protobuf.Struct` and its parts as JSON values, but other values unchanged."""
    descriptor = getattr(value, "DESCRIPTOR", None)
    full_name = "" if descriptor is None else descriptor.full_name
    if full_name == _FREE:
        return {key: _plain(element) for key, element in value.fields.items()}
    if full_name == "google.protobuf.ListValue":
        return list(map(_plain, value.values))
    if full_name != "google.protobuf.Value":
        return value
    field = value.WhichOneof("kind")
    return None if field in (None, "null_value") else _plain(getattr(value, field))


class Sparse(dict[str, Any]):
    """A JSON object in which missing fields are 0, because proto3 leaves zeros out."""

    def __missing__(self, key: str) -> Zero:
        return ZERO


class Zero(Sparse):
    """A missing field: a number 0, an empty message or an empty list."""

    def __float__(self) -> float:
        return 0.0

    def __index__(self) -> int:
        return 0


ZERO = Zero()


def sparse(value: object) -> object:
    """Return a decoded message with its JSON objects as `Sparse`.

    Raises:
        ContentError: the message is nested too deeply.
    """
    try:
        return _sparse(value)
    except RecursionError:
        raise ContentError("its JSON is nested too deeply") from None


def _sparse(value: object) -> object:
    if isinstance(value, dict):
        return Sparse({key: _sparse(element) for key, element in value.items()})
    return [_sparse(element) for element in value] if isinstance(value, list) else value


def from_protobuf_json(value: object, objects: str) -> object:
    """Return a JSON message with the fields of its definition, also if protobuf wrote the message.

    ProtoJSON renames fields and leaves out defaults (https://protobuf.dev/programming-guides/json/). So a
    copy of `frameId` is added as `frame_id`, missing coordinates as 0, and a missing list of objects as an
    empty list.

    Args:
        objects: path of the list of objects, such as `entities[*]`; "" for a message that is one object.

    Raises:
        ContentError: the message is nested too deeply.
    """
    try:
        message = _message_from_json(value)
    except RecursionError:
        raise ContentError("its JSON is nested too deeply") from None
    if objects and isinstance(message, dict):
        message.setdefault(objects.partition("[")[0], [])
    return message


_POINT = MappingProxyType({"x": 0.0, "y": 0.0, "z": 0.0})


def _message_from_json(json_value: object) -> object:
    if isinstance(json_value, list):
        # a list of numbers is not copied, because it may be long
        return (
            list(map(_message_from_json, json_value))
            if json_value and isinstance(json_value[0], dict | list)
            else json_value
        )
    if not isinstance(json_value, dict):
        return json_value
    if json_value.keys() <= {"x", "y", "z", "w"}:
        return {**_POINT, **json_value}
    fields = {key: _message_from_json(field_value) for key, field_value in json_value.items()}
    if "position" in fields:
        # a missing orientation becomes a quaternion of zeros, as in protobuf's binary encoding
        fields.setdefault("orientation", {**_POINT, "w": 0.0})
    return {_snake_case(key): field_value for key, field_value in fields.items()} | fields


@lru_cache(4096)
def _snake_case(key: str) -> str:
    return re.sub(r"(?<=[a-z0-9])[A-Z]", lambda match: f"_{match[0].lower()}", key)


def type_name(value: object) -> str:
    """Describe the type of a message, or of a message's part, for errors."""
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
    if isinstance(value, Mapping):
        return "the map"
    return "a list" if hasattr(value, "__len__") else "nothing" if value is None else "a value"


Get: TypeAlias = Callable[[Any], Any]

EACH: Final = "*"
_NAME = r"[A-Za-z_][\w-]*"
_KEY = rf"(?:{_NAME}|'[^'{{}}|\x00-\x1f]{{1,200}}')"
_CHOSEN = rf"\[(?:{_NAME})(?:\.(?:{_NAME}))*=[^\[\]{{}}|=\s]{{1,100}}\]"
_BRACKET = r"\[(?:-?\d{1,9}|\*|best|index)\]"
PATTERN: Final = rf"(?:\$\.)?(?:{_KEY}(?:{_CHOSEN})?|\[\*\])(?:\.{_KEY}(?:{_CHOSEN})?|{_BRACKET})*"
"""A path, as a regular expression."""

_STEP = re.compile(
    rf"\.?(?:({_NAME})|'([^']+)')(?:\[([^\[\]=]+)=([^\[\]]+)\])?|\[(-?\d{{1,9}}|\*|best|index)\]", re.ASCII
)
_PATH = re.compile(PATTERN, re.ASCII)


class FieldError(Exception):
    """A path that does not resolve in a message; the text lists the existing fields."""


class ContentError(FieldError):
    """An existing field with an unusable value."""


@dataclass(frozen=True, slots=True)
class Each:
    """The step `[*]`: every element of a list."""


@dataclass(frozen=True, slots=True)
class Keyed:
    """The step `field[path=key]`: an element of a list, by a field of the element or by a list of names."""

    field: str
    path: FieldPath
    key: str

    def read(self, value: Any) -> object:
        """Return the element; None without a matching element, which makes a number unknown.

        Raises:
            FieldError: the elements lack the field.
        """
        elements = get_field(value, self.field)
        names = self.names(value)
        if names is not None:
            return elements[names.index(self.key)] if self.key in names else None  # type: ignore[index]
        matching = [
            element for element in elements_of(elements) if _word(walk(self.path, element)) == self.key
        ]
        return matching[-1] if matching else None

    def names(self, value: object) -> list[str] | None:
        """Return the names in the neighbouring list; None without such a list."""
        beside = self.path.text
        names = get_field(value, beside) if beside in field_names(value) else None
        return list(map(_word, names)) if is_list(names) else None


def _word(value: object) -> str:
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


@dataclass(frozen=True, slots=True)
class Best:
    """The step `[best]`: the first element of a list with the highest score."""

    def read(self, value: Any) -> object:
        """Return the element.

        Raises:
            IndexError: the list is empty.
        """
        return value[0] if len(value) < 2 else max(value, key=_score)


_SCORES = ("score", "probability", "confidence")


def _score(result: object) -> float:
    """Return the score of a result, or of its hypothesis; -inf without a score."""
    score_fields = field_names(result)
    if "hypothesis" in score_fields:
        return _score(get_field(result, "hypothesis"))
    scores: Iterator[Any] = (get_field(result, name) for name in _SCORES if name in score_fields)
    best_score = next((float(score) for score in scores if score is not None and is_number(score)), nan)
    return -inf if isnan(best_score) else best_score


@dataclass(frozen=True, slots=True)
class Place:
    """The step `[index]`: the element of another list at an object's index or key in the list of objects."""


Step: TypeAlias = str | int | Each | Keyed | Best | Place


@dataclass(frozen=True, slots=True)
class FieldPath:
    """A field path.

    Attributes:
        text: the path in the mapping.
        steps: names, indices and other steps.
        from_message: whether the path starts at the message instead of the object.
    """

    text: str
    steps: tuple[Step, ...]
    from_message: bool = False

    @classmethod
    def of(cls, text: str) -> FieldPath:
        """Parse a path.

        Raises:
            UsageError: the text is not a path.
        """
        if not _PATH.fullmatch(text):
            raise UsageError(
                f"{text[:80]!r} is not a field path; write names with dots: pose.position.x, tags[0].id;"
                " a key with other characters stands in quotes: 'pose.x'"
            )
        steps: list[Step] = []
        for match in _STEP.finditer(text.removeprefix("$.")):
            name, quoted, chosen_by, key, index = match.groups()
            if chosen_by:
                steps.append(Keyed(name or quoted, cls.of(chosen_by), key))
            else:
                steps.append(name or quoted or _BRACKETS.get(index) or int(index))
        return cls(text, tuple(steps), text.startswith("$."))


_BRACKETS: Mapping[str, Each | Best | Place] = MappingProxyType(
    {EACH: Each(), "best": Best(), "index": Place()}
)


def walk(
    path: FieldPath,
    value: object,
    index: int | str | None = None,
    *,
    is_strict: bool = False,
    may_lack_keys: bool = False,
) -> object:
    """Return the value at a path without `[*]`.

    Args:
        index: index or key of the object in its list, for `[index]`.
        is_strict: whether missing fields of a sparse message are errors instead of 0.
        may_lack_keys: whether a missing key of a protobuf map or Struct is unknown instead of an error.

    Raises:
        FieldError: the path does not resolve; the message names the failing step and the existing fields.
    """
    for step in path.steps:
        # a Struct is read like a dictionary
        has_free_keys = may_lack_keys and (isinstance(value, Mapping) or _is_free(value))
        if has_free_keys and str(step) not in field_names(value):
            return None
        if isinstance(step, str):
            is_left_out = isinstance(value, Sparse) and not is_strict
            value = value[step] if is_left_out else _field_at(path, value, step)  # type: ignore[index]
        elif isinstance(step, int):
            value = _element_at(path, value, step)
        elif isinstance(step, Keyed):
            value = _element_of_key(path, value, step)
            if value is None:
                return None
        elif isinstance(step, Best):
            _element_at(path, value, 0)
            value = step.read(value)
        elif isinstance(step, Place):
            value = _element_at_place(path, value, index)
    return value


def _element_at_place(path: FieldPath, value: object, index: int | str | None) -> object:
    if index is None:
        raise FieldError(f"{path.text}: [index] is for names: it is the place of an object in its list")
    return _field_at(path, value, index) if isinstance(index, str) else _element_at(path, value, index)


def leads_somewhere(path: FieldPath, value: object) -> bool:
    """Return whether a path without `[*]` resolves; fields missing from `Sparse` do not resolve."""
    try:
        walk(path, value, is_strict=True)
    except FieldError:
        return False
    return True


def _field_at(path: FieldPath, value: object, name: str) -> object:
    names = field_names(value)
    if name not in names:
        dotted_key = next((key for key in names if "." in key and _in_quotes(key) not in path.text), None)
        hint = f"a key with a dot stands in quotes: {_in_quotes(dotted_key)}" if dotted_key else ""
        hint = hint or nearest_hint(name, names)
        raise FieldError(
            f"{path.text}: {type_name(value)} has no field {name!r}"
            + (f"; {hint}" if hint else "")
            + (f"; its fields are {listing(names, 20)}" if names else "")
        )
    return get_field(value, name)


def _in_quotes(key: str) -> str:
    return f"'{key}'"


def _element_at(path: FieldPath, value: object, index: int) -> object:
    if isinstance(value, Mapping):
        return _field_at(path, value, str(index))
    if not is_list(value):
        raise FieldError(f"{path.text}: [{index}] needs a list, got {type_name(value)}")
    if not -len(value) <= index < len(value):
        raise FieldError(f"{path.text}: [{index}] is out of range, there are {len(value)} elements")
    return value[index]


def _element_of_key(path: FieldPath, value: object, step: Keyed) -> object:
    elements = _field_at(path, value, step.field)
    if not is_list(elements) and not isinstance(elements, Mapping):
        raise FieldError(f"{path.text}: {step.field} has to be a list, got {type_name(elements)}")
    names = step.names(value)
    if names is None and any(field_names(element) for element in elements_of(elements)):
        return step.read(value)
    if names is None and len(elements):
        _field_at(path, value, step.path.text)
        raise FieldError(f"{path.text}: {step.path.text} has to be a list")
    if names is not None and step.key not in names:
        hint = nearest_hint(step.key, names) or f"it has {', '.join(names[:20]) or 'nothing'}"
        raise FieldError(f"{path.text}: {step.path.text} has no {step.key!r}; {hint}")
    return step.read(value)


def is_list(value: object) -> TypeGuard[Sequence[object]]:
    """Return whether a value is a list in ROS (also as a NumPy array), protobuf or JSON."""
    return (
        hasattr(value, "__len__")
        and hasattr(value, "__getitem__")
        and not isinstance(value, str | bytes | Mapping)
    )


def enum_names(path: FieldPath, message: object) -> dict[object, str]:
    """Return the value names of a protobuf enum at a path, by number; {} for other fields."""
    if not path.steps:
        return {}
    owner = walk(FieldPath(path.text, path.steps[:-1]), message)
    last_step = path.steps[-1]
    enum_type = getattr(
        _definition_of(owner, last_step) if isinstance(last_step, str) else None, "enum_type", None
    )
    return {} if enum_type is None else {member.number: member.name for member in enum_type.values}


def is_set(path: FieldPath, value: object) -> bool:
    """Return whether the sender set all protobuf fields on a path; fields without presence count as set."""
    for step in path.steps:
        if isinstance(step, str) and not isinstance(value, Mapping):
            field = _definition_of(value, step)
            if field is not None and field.has_presence and not value.HasField(step):  # type: ignore[attr-defined]
                return False
        value = walk(FieldPath(path.text, (step,)), value)
    return True


def may_be_unset(path: FieldPath, example: object) -> bool:
    """Return whether `is_set` may be False for messages of the example's type."""
    for step in path.steps:
        field = _definition_of(example, step) if isinstance(step, str) else None
        if field is not None and field.has_presence:
            return True
        example = walk(FieldPath(path.text, (step,)), example)
    return False


def _definition_of(value: object, name: str) -> Any:
    """Return the descriptor of a protobuf field; None for other fields."""
    return getattr(getattr(value, "DESCRIPTOR", None), "fields_by_name", {}).get(name)


def getter(path: FieldPath, example: object) -> Get:
    """Compile a path without `[*]` to a function from a message to the value at the path.

    The function is fast, but its errors (AttributeError, LookupError, TypeError) do not name the fields.
    `walk` explains these errors.

    Args:
        example: message of the type that the function reads.
    """
    if _has_free_keys(path, example):
        return lambda value: walk(path, value, may_lack_keys=True)
    style = style_of(example)
    if style == "attributes" and path.steps and all(isinstance(step, str) for step in path.steps):
        # attrgetter reads all steps in one call in C
        return attrgetter(".".join(map(str, path.steps)))
    getters: list[Get] = [
        step.read
        if isinstance(step, Keyed | Best)
        else attrgetter(step)
        if style == "attributes" and isinstance(step, str)
        else itemgetter(step)
        for step in path.steps
    ]
    if len(getters) == 1:
        return getters[0]
    may_be_missing = any(isinstance(step, Keyed) for step in path.steps)

    def follow(value: Any) -> Any:
        for get in getters:
            value = get(value)
            if may_be_missing and value is None:
                return None
        return value

    return follow


def _has_free_keys(path: FieldPath, value: object) -> bool:
    """Return whether a path crosses a protobuf map or a Struct; their keys are not attributes."""
    if style_of(value) == "keys":
        return False
    for step in path.steps:
        if isinstance(value, Mapping) or _is_free(value):
            return True
        if not isinstance(step, str | int):
            return False
        try:
            value = getattr(value, step) if isinstance(step, str) else value[step]  # type: ignore[index]
        except (AttributeError, LookupError, TypeError):
            return False
    return _plain(value) is not value


def tuple_getter(paths: Sequence[FieldPath], example: object) -> Callable[[Any], tuple[Any, ...]]:
    """Compile one or more paths to a function from a message to the tuple of their values."""
    is_plain = style_of(example) == "attributes" and not any(
        _has_free_keys(path, example) or not all(isinstance(step, str) for step in path.steps)
        for path in paths
    )
    if is_plain and len(paths) > 1:
        return attrgetter(*(".".join(map(str, path.steps)) for path in paths))
    getters = [getter(path, example) for path in paths]
    return lambda value: tuple([get(value) for get in getters])


def iter_elements(path: FieldPath, message: object) -> Iterator[object]:
    """Iterate over the elements at a path with `[*]`, or over the one value at a path without it.

    Raises:
        FieldError: the path does not resolve.
    """
    values: list[object] = [message]
    for step in path.steps:
        if not isinstance(step, Each):
            values = [walk(FieldPath(path.text, (step,)), value) for value in values]
        else:
            for value in values:
                if not is_list(value) and not isinstance(value, Mapping):
                    raise FieldError(f"{path.text}: [*] needs a list, got {type_name(value)}")
            values = [element for value in values for element in elements_of(value)]
    return iter(values)


def elements_of(value: Any) -> Sequence[object]:
    """Return the elements of a list, or the values of a JSON object or a protobuf map."""
    return [value[key] for key in keys_of(value)] if isinstance(value, Mapping) else value


def keys_of(value: Mapping[Any, object]) -> list[Any]:
    """Return all keys of a protobuf map, or the keys of a JSON object whose values are objects."""
    return [key for key, part in value.items() if not isinstance(value, dict) or isinstance(part, dict)]


def list_getter(path: FieldPath, example: object) -> Get | None:
    """Compile a path of the form `a.b[*]` to a getter of the list; return None for other forms."""
    *list_steps, last_step = path.steps
    if isinstance(last_step, Each) and not any(isinstance(step, Each) for step in list_steps):
        return getter(FieldPath(path.text, tuple(list_steps)), example)
    return None


def below(path: FieldPath, step: str | int) -> FieldPath:
    """Return the path extended by a step."""
    text = f"{path.text}[{step}]" if isinstance(step, int) else f"{path.text}.{step}"
    return FieldPath(text, (*path.steps, step), path.from_message)


def is_number(value: object) -> bool:
    """Return whether a field holds a number or null; null is a missing number in JSON."""
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
"""A template, as a regular expression."""

_PART = re.compile(r"\{([^{}]*)\}|([^{}]+)", re.ASCII)
_TEMPLATE = re.compile(TEMPLATE_PATTERN, re.ASCII)
_DROPPED_ENDS = frozenset(
    {"pose", "odom", "odometry", "state", "position", "location", "polygon", "footprint"}
)


@dataclass(frozen=True, slots=True)
class NameTemplate:
    """A template for the names of objects: literal text and fields in turn.

    Attributes:
        parts: texts, and tuples of alternative fields. The first existing field with a value is used. `index`
            is the object's index in its list or key in a JSON object; `topic` is the object's topic. A field
            of the object with this name takes precedence.
    """

    text: str
    parts: tuple[str | tuple[FieldPath, ...], ...]

    @classmethod
    def of(cls, text: str) -> NameTemplate:
        """Parse a template.

        Raises:
            UsageError: the text is not a template.
        """
        if not _TEMPLATE.fullmatch(text):
            example = "tag{id}, {ns}_{id}"
            raise UsageError(f"{text[:80]!r} is not a name; write text with fields in braces: {example}")
        parts = tuple(
            literal if field_list is None else tuple(map(FieldPath.of, field_list.split("|")))
            for field_list, literal in (part_match.groups() for part_match in _PART.finditer(text))
        )
        return cls(text, parts)

    @property
    def is_constant(self) -> bool:
        """Whether all objects get the same name."""
        return all(isinstance(part, str) for part in self.parts)


def name_from_topic(topic: str) -> str:
    """Return an object's name from its topic: `/turtle1/pose` → turtle1, `/pose` → pose."""
    words = [word for word in topic.split("/") if word]
    if len(words) > 1 and words[-1].lower() in _DROPPED_ENDS:
        words.pop()
    return "_".join(words) or "object"
