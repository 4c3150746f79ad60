"""Names and classes of objects: decoded objects in, integer codes out.

Codes are dense integers, so that everything behind the decoding works on arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from itertools import repeat
from typing import Any

from spatial_replay.mapping.binding import Binding
from spatial_replay.mapping.field_paths import (
    INDEX,
    TOPIC,
    ContentError,
    FieldError,
    FieldPath,
    Get,
    NameTemplate,
    Place,
    Style,
    Zero,
    field_names,
    get_field,
    getter,
    is_list,
    name_from_topic,
    style_of,
    type_name,
    walk,
)
from spatial_replay.mapping.message_types import MessageLayout

BY_PLACE = "only the places in the list distinguish objects: objects swap where these change"
"""What to say where objects are named by their indices."""
_LONGEST_NAME = 500
_UUID_BYTES = 16
_MOST_IN_NAME = 16
"""Elements of a list that one name is made of, such as the ids of a bundle of tags."""


class Codes(dict[Any, int]):
    """Codes of values, numbered in the order of their first use; `by_code` lists the values."""

    def __init__(self) -> None:
        super().__init__()
        self.by_code: list[Any] = []

    def __missing__(self, value: Any) -> int:
        code = self[value] = len(self.by_code)
        self.by_code.append(value)
        return code


class Namer:
    """Names objects by a template, with codes that several namers share.

    Args:
        only, without: patterns of names to keep and to leave out.
    """

    def __init__(
        self, template: NameTemplate, topic: str, codes: Codes, only: Sequence[str], without: Sequence[str]
    ) -> None:
        self.is_filtering = bool(only or without)
        self._template = template
        self._topic = name_from_topic(topic)
        self._codes = codes
        self._only, self._without = tuple(only), tuple(without)
        self._is_wanted: dict[int, bool] = {}
        self._code_by_value: dict[Any, int] = {}
        self._get: Callable[[Any, int | str, Any], Any] | None = None
        self._is_by_index = False
        self.is_by_place = False
        """Whether nothing but their places in a list distinguished some objects."""
        self._is_prepared = False

    @property
    def needs_messages(self) -> bool:
        """Whether names depend on fields of the messages, and not of the objects alone."""
        parts = (path for part in self._template.parts if not isinstance(part, str) for path in part)
        return any(path.from_message for path in parts)

    def codes(
        self,
        objects: Sequence[object],
        indices: Sequence[int | str],
        style: Style,
        messages: Sequence[object] | None = None,
    ) -> list[int]:
        """Return the code of each object's name.

        Args:
            indices: the index of each object in its list, or its key.
            messages: the message of each, if the namer `needs_messages`.

        Raises:
            FieldError: a field of the template is missing, or the name is empty or too long.
        """
        if self._template.is_constant or self._template.text == "{topic}":
            name = "".join(str(part) for part in self._template.parts) if self._template.is_constant else ""
            return [self._codes[_checked(name or self._topic)]] * len(objects)
        if objects and not self._is_prepared:
            # step by step once, because the errors of the fast getter name no fields
            message = messages[0] if messages else None
            self._name(objects[0], indices[0], message)
            self._prepare(objects[0], indices[0], message, style)
        known = self._code_by_value
        if self._is_by_index:
            for index, each in zip(indices, objects, strict=True):
                if index not in known:
                    known[index] = self._codes[self._name(each, index, None)]
            return [known[index] for index in indices]
        get = self._get
        of_objects = repeat(None, len(objects)) if messages is None else messages
        rows = zip(objects, indices, of_objects, strict=True)
        if get is None:
            return [self._codes[self._name(*row)] for row in rows]
        codes = []
        for row in rows:
            value = get(*row)
            key = value if isinstance(value, str | int | float) else bytes(value)
            code = known.get(key)
            if code is None:
                code = known[key] = self._codes[self._name(*row)]
            codes.append(code)
        return codes

    def wanted(self, codes: Sequence[int]) -> list[bool]:
        """Return whether to keep the objects with these codes of names."""
        for code in set(codes).difference(self._is_wanted):
            name = self._codes.by_code[code]
            is_named = not self._only or any(fnmatchcase(name, pattern) for pattern in self._only)
            is_excluded = any(fnmatchcase(name, pattern) for pattern in self._without)
            self._is_wanted[code] = is_named and not is_excluded
        return [self._is_wanted[code] for code in codes]

    def _prepare(self, example: object, index: int | str, message: object, style: Style) -> None:
        """Find a fast way: most templates have one field, so that a name is known by its value."""
        self._is_prepared = True
        fields = [part for part in self._template.parts if not isinstance(part, str)]
        given = {INDEX, TOPIC}.difference(field_names(example))
        if all(alternatives[0].text in given for alternatives in fields):
            self._is_by_index = True
        elif len(fields) == 1 and len(fields[0]) == 1:
            (path,) = fields[0]
            value = walk(path, message if path.from_message else example, index)
            if not isinstance(value, str | int | float) and not _is_uuid(value):
                return
            *before, last = path.steps
            if path.from_message and isinstance(last, Place) and before:
                listed = getter(FieldPath(path.text, tuple(before)), style_of(message))
                self._get = lambda _, index, message: listed(message)[index]
            elif not path.from_message:
                get = getter(path, style)
                self._get = lambda thing, *_: get(thing)

    def _name(self, thing: object, index: int | str, message: object) -> str:
        words = (
            p if isinstance(p, str) else self._word(p, thing, index, message) for p in self._template.parts
        )
        return _checked("".join(words))

    def _word(
        self, alternatives: tuple[FieldPath, ...], thing: object, index: int | str, message: object
    ) -> str:
        for path in alternatives:
            if path.text in (INDEX, TOPIC) and path.text not in field_names(thing):
                if path.text == TOPIC:
                    return self._topic
                self.is_by_place = self.is_by_place or (isinstance(index, int) and index > 0)
                return str(index)
            try:
                root = message if path.from_message else thing
                word = _text(walk(path, root, index, is_strict=len(alternatives) > 1), path)
            except FieldError:
                if len(alternatives) == 1:
                    raise
                continue
            if word:
                return word
        fields = "|".join(path.text for path in alternatives)
        raise ContentError(f"{{{fields}}} is empty; choose another name")


def class_codes(
    layout: MessageLayout, binding: Binding, objects: Sequence[object], codes: Codes
) -> list[int]:
    """Return the code of each object's class."""
    if not binding.class_gets:
        return [codes[layout.class_name]] * len(objects)
    known: dict[Any, int] = {}
    result = []
    for each in objects:
        value = _first_value(binding.class_gets, each)
        code = known.get(value)
        if code is None:
            code = known[value] = codes[_class_name(layout, value)]
        result.append(code)
    return result


def _first_value(gets: Sequence[Get], thing: object) -> Any:
    for get in gets:
        try:
            value = get(thing)
        except (AttributeError, LookupError, TypeError):
            continue
        if isinstance(value, Zero):
            return None
        # lists and messages cannot be keys of a dictionary
        return value if isinstance(value, str | int | float | bool) else str(value)
    return None


def _class_name(layout: MessageLayout, value: object) -> str | None:
    if value is None or value == "":
        return None
    # JSON can spell lone surrogates, which UTF-8 cannot write
    text = str(value).encode("utf-8", "replace").decode()
    if text in layout.class_table:
        return layout.class_table[text]
    return layout.class_other if layout.class_has_other else text


def _text(value: object, path: FieldPath) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, Zero):
        return "0"
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    if isinstance(value, int | float) or (hasattr(value, "item") and not hasattr(value, "__len__")):
        return str(value)
    if field_names(value) in (("value",), ("uuid",)):
        # such as osi3.Identifier and unique_identifier_msgs/UUID
        return _text(get_field(value, field_names(value)[0]), path)
    if _is_uuid(value):
        digits = bytes(value).hex()  # type: ignore[call-overload]
        return str(digits) if digits.strip("0") else ""
    if is_list(value) and len(value) <= _MOST_IN_NAME:
        return "_".join(_text(each, path) for each in value)
    raise FieldError(f"{path.text}: expected a text or a number, got {type_name(value)}")


def _is_uuid(value: object) -> bool:
    """Return whether a value is 16 bytes, as texts or lists of small numbers hold them, too."""
    if isinstance(value, str) or not hasattr(value, "__len__") or len(value) != _UUID_BYTES:
        return False
    try:
        return len(bytes(value)) == _UUID_BYTES  # type: ignore[call-overload]
    except (TypeError, ValueError):
        return False


def _checked(name: str) -> str:
    if not name or len(name) > _LONGEST_NAME or not name.isprintable():
        raise ContentError(
            f"the name {name[:40]!r} is empty, too long or not printable; give another with `name`"
        )
    return name
