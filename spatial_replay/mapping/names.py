"""Names and classes of objects, as numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from typing import Any

from spatial_replay.mapping.binding import Binding
from spatial_replay.mapping.field_paths import (
    INDEX,
    TOPIC,
    ContentError,
    FieldError,
    FieldPath,
    NameTemplate,
    Style,
    field_names,
    getter,
    name_from_topic,
    type_name,
    walk,
)
from spatial_replay.mapping.message_types import MessageLayout

Get = Callable[[Any], Any]


class Codes(dict[Any, int]):
    """A number for each value, counted as they come."""

    def __missing__(self, value: Any) -> int:
        code = self[value] = len(self)
        return code


class Namer:
    """Objects' names from a template, as codes that several namers share."""

    def __init__(
        self, template: NameTemplate, topic: str, codes: Codes, only: Sequence[str], without: Sequence[str]
    ) -> None:
        self._template = template
        self._topic = name_from_topic(topic)
        self._codes = codes
        self._only, self._without = tuple(only), tuple(without)
        self._wanted: dict[int, bool] = {}
        self._by_values: dict[Any, int] = {}
        self._get: Get | None = None
        self._has_places_only = False
        self._is_planned = False

    def codes(self, objects: Sequence[object], places: Sequence[int], style: Style) -> list[int]:
        """The code of each object's name.

        Args:
            places: where each object stands in its list.

        Raises:
            FieldError: a field of the template is missing, or the name is empty or too long.
        """
        if self._template.is_constant or self._template.text == "{topic}":
            name = "".join(str(part) for part in self._template.parts) if self._template.is_constant else ""
            return [self._codes[_checked(name or self._topic)]] * len(objects)
        if objects and not self._is_planned:
            # the first one is taken step by step, so that a wrong path is told well
            self._name(objects[0], places[0])
            self._plan(objects[0], style)
        get = self._get
        known = self._by_values
        if self._has_places_only:
            for place, thing in zip(places, objects, strict=True):
                if place not in known:
                    known[place] = self._codes[self._name(thing, place)]
            return [known[place] for place in places]
        if get is None or not objects:
            return [self._codes[self._name(each, place)] for each, place in zip(objects, places, strict=True)]
        # most names depend on one field alone
        found = []
        for each in objects:
            value = get(each)
            code = known.get(value)
            if code is None:
                code = known[value] = self._codes[self._name(each, 0)]
            found.append(code)
        return found

    def is_filtering(self) -> bool:
        return bool(self._only or self._without)

    def wants(self, code: int, name: str) -> bool:
        """Whether an object of this name is to be kept."""
        found = self._wanted.get(code)
        if found is None:
            kept = not self._only or any(fnmatchcase(name, pattern) for pattern in self._only)
            found = kept and not any(fnmatchcase(name, pattern) for pattern in self._without)
            self._wanted[code] = found
        return found

    def _plan(self, example: object, style: Style) -> None:
        """Find out how the one field is read that names depend on, where it is as simple as that."""
        self._is_planned = True
        fields = [part for part in self._template.parts if not isinstance(part, str)]
        given = {INDEX, TOPIC}.difference(field_names(example))
        if all(alternatives[0].text in given for alternatives in fields):
            self._has_places_only = True
            return
        if len(fields) == 1 and len(fields[0]) == 1:
            (path,) = fields[0]
            if path.text in (INDEX, TOPIC) and path.text not in field_names(example):
                return
            if not path.from_message and isinstance(walk(path, example), str | int | float):
                self._get = getter(path, style)

    def _name(self, thing: object, place: int) -> str:
        words = [
            part if isinstance(part, str) else self._word(part, thing, place) for part in self._template.parts
        ]
        return _checked("".join(words))

    def _word(self, alternatives: tuple[FieldPath, ...], thing: object, place: int) -> str:
        for path in alternatives:
            if path.text in (INDEX, TOPIC) and path.text not in field_names(thing):
                return str(place) if path.text == INDEX else self._topic
            try:
                word = _text(walk(path, thing), path)
            except FieldError:
                if len(alternatives) == 1:
                    raise
                continue
            if word:
                return word
        raise ContentError(
            f"{{{'|'.join(path.text for path in alternatives)}}} is empty; choose another name"
        )


def class_codes(
    reading: MessageLayout, binding: Binding, objects: Sequence[object], codes: Codes
) -> list[int]:
    """The code of each object's class."""
    if not binding.class_gets:
        return [codes[reading.class_name]] * len(objects)
    known: dict[Any, int] = {}
    found = []
    for each in objects:
        value = _first_value(binding.class_gets, each)
        code = known.get(value)
        if code is None:
            code = known[value] = codes[_class_name(reading, value)]
        found.append(code)
    return found


def _first_value(gets: Sequence[Get], thing: object) -> Any:
    for get in gets:
        try:
            value = get(thing)
        except (AttributeError, LookupError, TypeError):
            continue
        # what cannot be a key cannot be a class
        return value if isinstance(value, str | int | float | bool) else str(value)
    return None


def _class_name(reading: MessageLayout, value: object) -> str | None:
    if value is None or value == "":
        return None
    # halves of surrogate pairs, which JSON can spell, cannot be written
    text = str(value).encode("utf-8", "replace").decode()
    if text in reading.class_table:
        return reading.class_table[text]
    return reading.class_other if reading.class_has_other else text


def _text(value: object, path: FieldPath) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    if isinstance(value, int | float) or (hasattr(value, "item") and not hasattr(value, "__len__")):
        return str(value)
    if field_names(value) == ("value",):
        # such as osi3.Identifier
        return str(getattr(value, "value", ""))
    raise FieldError(f"{path.text}: {type_name(value)} where a text or a number belongs")


_LONGEST_NAME = 500


def _checked(name: str) -> str:
    if not name or len(name) > _LONGEST_NAME or not name.isprintable():
        raise ContentError(
            f"the name {name[:40]!r} is empty, too long or not printable; give another with `name`"
        )
    return name
