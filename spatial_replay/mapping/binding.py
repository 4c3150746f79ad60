"""Bind a layout to the first object of a topic: field paths in, compiled getters out.

A layout lists alternative paths. The topic's first object decides between alternatives, and whether a time is
two fields or a number. Names and classes of objects become codes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from collections.abc import Mapping as Table
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from decimal import Decimal
from fnmatch import fnmatchcase
from itertools import chain, repeat
from typing import Any, TypeVar

import numpy as np

from spatial_replay.mapping.field_paths import (
    INDEX,
    TOPIC,
    ContentError,
    FieldError,
    FieldPath,
    Get,
    NameTemplate,
    Place,
    Sparse,
    Style,
    Zero,
    below,
    enum_names,
    field_names,
    get_field,
    getter,
    is_list,
    is_number,
    leads_somewhere,
    may_be_unset,
    name_from_topic,
    style_of,
    tuple_getter,
    type_name,
    walk,
)
from spatial_replay.mapping.mapping_file import Measure, Stamp
from spatial_replay.mapping.message_types import Alternatives, MessageLayout
from spatial_replay.mapping.outlines import path_of_rings
from spatial_replay.trace.trace import LATEST_NS

BY_PLACE = "only the places in the list distinguish objects without an id: objects swap where these change"
"""Remark on objects that are named by their indices."""
_LONGEST_NAME = 500
_UUID_BYTES = 16
_MOST_IN_NAME = 16
"""Limit of list elements in one name, such as the ids of a bundle of tags."""


class Codes(dict[Any, int]):
    """Codes of values in the order of first use; `by_code` lists the values."""

    def __init__(self) -> None:
        super().__init__()
        self.by_code: list[Any] = []

    def __missing__(self, value: Any) -> int:
        code = self[value] = len(self.by_code)
        self.by_code.append(value)
        return code


class Namer:
    """Namer of objects by a template; several namers share one table of codes.

    Args:
        only, without: patterns of names to keep, and of names to leave out.
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
        self.is_by_place = False
        """Whether some objects were distinguished only by their indices in a list."""
        self._has_ids = False
        self._is_prepared = False

    @property
    def is_constant(self) -> bool:
        """Whether all objects get the same name."""
        return self._template.is_constant or self._template.text == "{topic}"

    @property
    def needs_messages(self) -> bool:
        """Whether names depend on fields of the message outside its objects."""
        paths = (path for part in self._template.parts if not isinstance(part, str) for path in part)
        return any(path.from_message for path in paths)

    def codes(
        self,
        objects: Sequence[object],
        indices: Sequence[int | str],
        messages: Sequence[object] | None = None,
    ) -> list[int]:
        """Return the code of each object's name.

        Args:
            indices: index or key of each object in its list.
            messages: message of each object; required if the namer `needs_messages`.

        Raises:
            FieldError: a field of the template is missing, or the name is empty or too long.
        """
        if self.is_constant:
            name = "".join(str(part) for part in self._template.parts) if self._template.is_constant else ""
            return [self._codes[_check_name(name or self._topic)]] * len(objects)
        if objects and not self._is_prepared:
            # the first object is read step by step, because errors of the fast getter do not name the fields
            message = messages[0] if messages else None
            self._name(objects[0], indices[0], message)
            self._prepare(objects[0], indices[0], message)
        code_by_value, get = self._code_by_value, self._get
        message_of_object = repeat(None, len(objects)) if messages is None else messages
        arguments = zip(objects, indices, message_of_object, strict=True)
        if get is None:
            return [self._codes[self._name(*argument)] for argument in arguments]
        codes = []
        for argument in arguments:
            field_value = get(*argument)
            # the list of a UUID is not hashable
            value_key = field_value if isinstance(field_value, str | int | float) else bytes(field_value)
            code = code_by_value.get(value_key)
            if code is None:
                code = code_by_value[value_key] = self._codes[self._name(*argument)]
            codes.append(code)
        return codes

    def select(self, codes: Sequence[int]) -> list[bool]:
        """Return for each code of a name whether the patterns keep it."""
        for code in set(codes).difference(self._is_wanted):
            name = self._codes.by_code[code]
            is_named = not self._only or any(fnmatchcase(name, pattern) for pattern in self._only)
            is_excluded = any(fnmatchcase(name, pattern) for pattern in self._without)
            self._is_wanted[code] = is_named and not is_excluded
        return [self._is_wanted[code] for code in codes]

    def _prepare(self, example: object, index: int | str, message: object) -> None:
        """Compile a getter if the template has a single field, so that its value can be a cache key."""
        self._is_prepared = True
        template_fields = [part for part in self._template.parts if not isinstance(part, str)]
        built_in_names = {INDEX, TOPIC}.difference(field_names(example))
        if all(alternatives[0].text in built_in_names for alternatives in template_fields):
            self._get = lambda _, index, message: index
        elif len(template_fields) == 1 and len(template_fields[0]) == 1:
            (path,) = template_fields[0]
            field_value = walk(path, message if path.from_message else example, index)
            if not isinstance(field_value, str | int | float) and not _is_uuid(field_value):
                return
            *list_steps, last_step = path.steps
            if path.from_message and isinstance(last_step, Place) and list_steps:
                get_names = getter(FieldPath(path.text, tuple(list_steps)), message)
                self._get = lambda _, index, message: get_names(message)[index]
            elif not path.from_message:
                get = getter(path, example)
                self._get = lambda element, *_: get(element)

    def _name(self, element: object, index: int | str, message: object) -> str:
        words = (
            part if isinstance(part, str) else self._word(part, element, index, message)
            for part in self._template.parts
        )
        return _check_name("".join(words))

    def _word(
        self, alternatives: tuple[FieldPath, ...], element: object, index: int | str, message: object
    ) -> str:
        for path in alternatives:
            if path.text in (INDEX, TOPIC) and path.text not in field_names(element):
                if path.text == TOPIC:
                    return self._topic
                is_one_of_several = self._has_ids or (isinstance(index, int) and index > 0)
                self.is_by_place = self.is_by_place or is_one_of_several
                return str(index)
            try:
                root = message if path.from_message else element
                word = _text(walk(path, root, index, is_strict=len(alternatives) > 1), path)
            except FieldError:
                if len(alternatives) == 1:
                    raise
                continue
            if word:
                self._has_ids = self._has_ids or alternatives[-1].text == INDEX
                return word
        field_list = "|".join(path.text for path in alternatives)
        raise ContentError(f"{{{field_list}}} is empty; choose another name")


def class_codes(
    layout: MessageLayout, binding: Binding, objects: Sequence[object], codes: Codes
) -> list[int]:
    """Return the code of each object's class."""
    if not binding.class_gets:
        return [codes[layout.class_name]] * len(objects)
    code_by_value: dict[Any, int] = {}
    object_codes = []
    for element in objects:
        class_value = _first_value(binding.class_gets, element)
        code = code_by_value.get(class_value)
        if code is None:
            code = code_by_value[class_value] = codes[_class_name(layout, class_value, binding.class_names)]
        object_codes.append(code)
    return object_codes


def _first_value(getters: Sequence[Get], element: object) -> Any:
    for get in getters:
        try:
            value = get(element)
        except (AttributeError, LookupError, TypeError):
            continue
        if isinstance(value, Zero):
            return None
        # lists and messages become texts, because they cannot be keys of a dictionary
        return value if isinstance(value, str | int | float | bool) else str(value)
    return None


def _class_name(layout: MessageLayout, class_value: object, name_by_value: Table[object, str]) -> str | None:
    if class_value is None or class_value == "":
        return None
    # JSON can contain lone surrogates as escapes, which UTF-8 cannot encode
    value_text = str(class_value).encode("utf-8", "replace").decode()
    class_text = name_by_value.get(class_value, value_text)
    for table_key in (value_text, class_text):
        if table_key in layout.class_table:
            return layout.class_table[table_key]
    return layout.class_other if layout.class_has_other else class_text


def _text(field_value: object, path: FieldPath) -> str:
    if isinstance(field_value, str):
        return field_value
    if isinstance(field_value, Zero):
        return "0"
    if isinstance(field_value, float) and field_value.is_integer():
        return str(int(field_value))
    if isinstance(field_value, int | float) or (
        hasattr(field_value, "item") and not hasattr(field_value, "__len__")
    ):
        return str(field_value)
    if field_names(field_value) in (("value",), ("uuid",)):
        # a message with one field, such as osi3.Identifier and unique_identifier_msgs/UUID
        return _text(get_field(field_value, field_names(field_value)[0]), path)
    if _is_uuid(field_value):
        digits = bytes(field_value).hex()  # type: ignore[call-overload]
        # a UUID of zeros was not set
        return str(digits) if digits.strip("0") else ""
    if is_list(field_value) and len(field_value) <= _MOST_IN_NAME:
        return "_".join(_text(part, path) for part in field_value)
    raise FieldError(f"{path.text}: expected a text or a number, got {type_name(field_value)}")


def _is_uuid(value: object) -> bool:
    """Return whether a value is a sequence of 16 bytes, but not a text."""
    if isinstance(value, str) or not hasattr(value, "__len__") or len(value) != _UUID_BYTES:
        return False
    try:
        return len(bytes(value)) == _UUID_BYTES  # type: ignore[call-overload]
    except (TypeError, ValueError):
        return False


def _check_name(name: str) -> str:
    if not name or len(name) > _LONGEST_NAME or not name.isprintable():
        raise ContentError(
            f"the name {name[:40]!r} is empty, too long or not printable; give another with `name`"
        )
    return name


_Option = TypeVar("_Option")
_Resolved = TypeVar("_Resolved")
_Alternative = TypeVar("_Alternative", str, tuple[str, ...], str | tuple[str, ...])

_SECOND_NS = 10**9
# names of the two fields in ROS 2, in ROS 1, in Python and JSON of ROS 1, and in protobuf
_TIME_FIELDS = (
    ("sec", "nanosec"),
    ("sec", "nsec"),
    ("secs", "nsecs"),
    ("seconds", "nanos"),
    ("sec", "nanos"),
)


@dataclass(frozen=True, slots=True)
class Binding:
    """Getters for the columns of objects.

    A column is an index into the tuple that `numbers` returns. One call reads all numbers of an object, which
    is several times faster than one call per number.

    Attributes:
        style: access to fields.
        width: number of columns.
        numbers: getter of all numbers of an object; None without numbers.
        position: columns of x, y and maybe z; () for polygons and solids, which contain coordinates.
        orientation: columns of x, y, z, w; () without a quaternion.
        yaw: column of the yaw; None without a yaw.
        sizes: columns of length, width and maybe height; () for messages without sizes.
        shape_sizes, height: measures of the mapping, each a number (float) or a column (int).
        uncertainty: radius (float) or its column (int); None without a radius.
        polygon: getter of corners or rings; None without an outline.
        has_rings: whether `polygon` returns the holder of rings instead of corners.
        class_names: value names of a protobuf enum, by number.
        unset: (column, path, default) of numbers that a protobuf sender may leave unset.
        frame: getter of a frame's name, and whether it reads the message instead of the object; None if
            objects have no frame.
        outer_frame: getter of the message's frame, for objects with an empty frame.
        own_stamp: getter of an object's own stamp; None if only messages have stamps.
    """

    style: Style
    width: int
    position: tuple[int, ...]
    numbers: Get | None = None
    orientation: tuple[int, ...] = ()
    yaw: int | None = None
    sizes: tuple[int, ...] = ()
    shape_sizes: tuple[float | int, ...] = ()
    height: tuple[float | int, ...] = ()
    uncertainty: float | int | None = None
    polygon: Get | None = None
    has_rings: bool = False
    covariance: Get | None = None
    class_gets: tuple[Get, ...] = ()
    class_names: Table[object, str] = field(default_factory=dict)
    frame: tuple[Get, bool] | None = None
    lifetime: TimeGetter | None = None
    unset: tuple[tuple[int, FieldPath, float], ...] = ()
    outer_frame: Get | None = None
    own_stamp: TimeGetter | None = None


@dataclass(frozen=True, slots=True)
class TimeGetter:
    """Getter of a time: a pair of seconds and nanoseconds, a number in `unit_ns`, or a text."""

    path: FieldPath
    get: Get
    is_pair: bool
    unit_ns: int

    def nanoseconds(self, values: Sequence[object]) -> list[int]:
        """Return the time of each value in nanoseconds. Values are messages or objects, according to `path`.

        Raises:
            FieldError: a time lies outside the times of a log.
            TypeError, ValueError, OverflowError: a value is not a time.
        """
        raw_times = map(self.get, values)
        if not self.is_pair:
            unit_ns = self.unit_ns
            return [
                self._check(
                    time * unit_ns
                    if type(time) is int
                    else ns_from_text(time, unit_ns)
                    if isinstance(time, str)
                    else round(float(time) * unit_ns)
                )
                for time in raw_times
            ]
        pairs = np.fromiter(chain.from_iterable(raw_times), np.int64, 2 * len(values))
        seconds, nanoseconds = pairs[::2], pairs[1::2]
        if len(nanoseconds) and nanoseconds.max() >= _SECOND_NS:
            raise FieldError(
                f"{self.path.text}: its nanoseconds, {nanoseconds.max()}, are not below one second, so the"
                " stamp is invalid; `clock: log` takes the time of recording"
            )
        # this check comes before the product below, because the product could overflow
        if len(seconds) and max(np.abs(seconds).max(), np.abs(nanoseconds).max()) >= LATEST_NS // _SECOND_NS:
            raise FieldError(f"{self.path.text}: the time lies outside those of a log")
        return [int(time) for time in (seconds * _SECOND_NS + nanoseconds).tolist()]

    def _check(self, time_ns: int) -> int:
        if abs(time_ns) > LATEST_NS:
            raise FieldError(f"{self.path.text}: the time lies outside those of a log")
        return time_ns


_DATE = re.compile(
    r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:[.,](\d{1,18}))?(?:[Zz]|([+-]\d\d:?\d\d))", re.ASCII
)
_SECONDS = re.compile(r"([+-]?\d{1,19}(?:\.\d{1,18})?)(s?)", re.ASCII)


def ns_from_text(text: str, unit_ns: int) -> int:
    """Return the nanoseconds of a text: an RFC 3339 time, a number in units, or seconds such as `1.5s`.

    Raises:
        ContentError: the text is none of these.
    """
    if seconds_match := _SECONDS.fullmatch(text):
        # the conversion is exact, because a float of seconds since 1970 resolves only 0.24 us
        return int(Decimal(seconds_match[1]) * (_SECOND_NS if seconds_match[2] else unit_ns))
    date_match = _DATE.fullmatch(text)
    try:
        if date_match is not None:
            moment = datetime.fromisoformat(f"{date_match[1]}T{date_match[2]}{date_match[4] or '+00:00'}")
            return int(moment.timestamp()) * _SECOND_NS + int((date_match[3] or "0").ljust(9, "0")[:9])
    except ValueError:
        pass
    raise ContentError(
        f"{text[:40]!r} is not a time; write a number, or a time with its offset from UTC, such as"
        " 2026-03-02T10:00:00.5Z; `clock: log` takes the time of recording"
    )


def ns_from_json(value: Any) -> int:
    """Return the nanoseconds of a time or duration in JSON; 0 for null.

    The value is an object with seconds and nanoseconds, a text such as `1.5s`, or a number of nanoseconds.

    Raises:
        ContentError, TypeError, ValueError: the value is none of these, or outside the times of a log.
    """
    if isinstance(value, dict):
        seconds, nanoseconds = (
            next((value[name] for name in field_pair if name in value), 0)
            for field_pair in zip(*_TIME_FIELDS, strict=True)
        )
        time_ns = int(seconds) * _SECOND_NS + int(nanoseconds)
    else:
        time_ns = ns_from_text(value, 1) if isinstance(value, str) else int(value or 0)
    if abs(time_ns) > LATEST_NS:
        raise ContentError(f"the time or duration of {time_ns} ns lies outside the times of a log")
    return time_ns


def _is_numeral(value: object) -> bool:
    """Return whether a value is a number written as a text.

    ProtoJSON writes 64-bit integers and NaN as texts (https://protobuf.dev/programming-guides/json/).
    """
    try:
        return isinstance(value, str) and float(value) is not None
    except ValueError:
        return False


class _Columns:
    """Distinct paths of numbers; the index of a path is its column."""

    def __init__(self, example: object) -> None:
        self.example = example
        self.paths: list[FieldPath] = []

    def add(self, path: FieldPath) -> int:
        if path.from_message:
            raise FieldError(f"{path.text}: $. is for frame, stamp and signals; give a field of the object")
        example_value = walk(path, self.example)
        if not (is_number(example_value) or _is_numeral(example_value)):
            raise FieldError(f"{path.text}: expected a number, got {type_name(example_value)}")
        path_texts = [column.text for column in self.paths]
        if path.text in path_texts:
            return path_texts.index(path.text)
        self.paths.append(path)
        return len(self.paths) - 1

    def add_all(self, paths: Sequence[str]) -> tuple[int, ...]:
        return tuple(self.add(FieldPath.of(path)) for path in paths)

    def point(self, path: FieldPath, names: str) -> tuple[int, ...]:
        """Return the columns of two or more coordinates of a point."""
        value = walk(path, self.example)
        existing_names = tuple(names) if isinstance(value, Sparse) else field_names(value)
        if all(name in existing_names for name in names[:2]):
            return tuple(self.add(below(path, name)) for name in names if name in existing_names)
        if is_list(value) and 2 <= len(value) <= len(names):
            return tuple(self.add(below(path, index)) for index in range(len(value)))
        fields_hint = f"; its fields are {', '.join(existing_names)}" if existing_names else ""
        zeros_hint = "; if zeros are left out, add `missing: 0`" if isinstance(value, dict) else ""
        raise FieldError(
            f"{path.text}: {type_name(value)} has no {' and '.join(names[:2])}{fields_hint}{zeros_hint}"
        )

    def measure(self, measure: Measure) -> float | int:
        """Return a column (int) for a path, or the number itself (float)."""
        return self.add(FieldPath.of(measure)) if isinstance(measure, str) else float(measure)


def bind(layout: MessageLayout, example: object, message: object, *, needs_frame: bool) -> Binding:
    """Bind a layout to the fields of an object.

    Args:
        example: first object of the topic, which is part of `message`.

    Raises:
        FieldError: a path does not resolve; the message lists the existing fields.
    """
    style = style_of(example)
    if isinstance(example, Sparse):
        layout = _with_what_is_there(layout, example)
    columns = _Columns(example)
    position: tuple[int, ...] = ()
    orientation: tuple[int, ...] = ()
    yaw: int | None = None
    if not layout.solids:
        orientation = _orientation(layout, columns)
        if not orientation:
            yaw = _first(layout.yaw, lambda path: columns.add(FieldPath.of(path)))
        position = () if layout.polygon and layout.is_generic else _position(layout, columns)
    uncertainty, covariance = _uncertainty(layout, columns)
    sizes = _first(layout.sizes, columns.add_all) or ()
    shape_sizes = tuple(map(columns.measure, layout.shape.sizes)) if layout.shape else ()
    height = tuple(map(columns.measure, layout.height)) if layout.height else ()
    polygon, has_rings = _polygon(layout, columns)
    class_paths = [FieldPath.of(path) for path in layout.class_field]
    if len(class_paths) == 1:
        # a single path comes from the mapping and must exist; a built-in type's alternatives may all be
        # missing
        walk(class_paths[0], example)
    frame = _frame(layout.frame, example, message, needs_frame)
    outer_frames = [path for path in layout.frame if FieldPath.of(path).from_message]
    outer_frame = None if frame is None or frame[1] else _frame(outer_frames, example, message, False)
    own_stamps = (Stamp(layout.own_stamp), Stamp(layout.own_stamp)) if layout.own_stamp else ()
    lifetime_getter = (
        bind_time((Stamp("lifetime"),), example, message) if layout.stays and style != "keys" else None
    )
    column_paths = columns.paths
    return Binding(
        style=style,
        numbers=tuple_getter(column_paths, example) if column_paths else None,
        width=len(column_paths),
        position=position,
        orientation=orientation,
        yaw=yaw,
        sizes=sizes,
        shape_sizes=shape_sizes,
        height=height,
        uncertainty=uncertainty,
        polygon=polygon,
        has_rings=has_rings,
        covariance=covariance,
        class_gets=tuple(getter(path, example) for path in class_paths),
        class_names=_enum_of(class_paths, example),
        frame=frame,
        outer_frame=None if outer_frame is None else outer_frame[0],
        own_stamp=bind_time(own_stamps, example, message),
        lifetime=lifetime_getter,
        unset=tuple(
            (column, path, _default(path, example))
            for column, path in enumerate(column_paths)
            # an unset quaternion of zeros means no rotation. An unset z stays 0, because few specifications
            # need z.
            if column not in (*orientation, *position[2:]) and may_be_unset(path, example)
        ),
    )


def _default(path: FieldPath, example: object) -> float:
    """Return the default number at a path of a protobuf message; 0 if the path crosses a list."""
    try:
        return float(walk(path, type(example)()))  # type: ignore[arg-type]
    except FieldError:
        return 0.0


def _enum_of(paths: Sequence[FieldPath], example: object) -> Table[object, str]:
    """Return the value names of the first protobuf enum at the paths, by number; {} without an enum."""
    for path in paths:
        with suppress(FieldError):
            if names := enum_names(path, example):
                return names
    return {}


def _with_what_is_there(layout: MessageLayout, example: Sparse) -> MessageLayout:
    """Return a layout without alternatives that a sparse object lacks, because missing fields read as 0."""

    def is_there(paths: Alternatives | str) -> bool:
        alternatives = (paths,) if isinstance(paths, str) else paths
        return any(leads_somewhere(FieldPath.of(path), example) for path in alternatives)

    def present(alternatives: tuple[_Alternative, ...]) -> tuple[_Alternative, ...]:
        return alternatives if len(alternatives) < 2 else tuple(filter(is_there, alternatives))

    return replace(
        layout,
        # one alternative stays, so that an object without a position is an error
        position=present(layout.position) or layout.position[:1],
        orientation=present(layout.orientation),
        yaw=present(layout.yaw),
        sizes=present(layout.sizes),
    )


def _position(layout: MessageLayout, columns: _Columns) -> tuple[int, ...]:
    def columns_of(paths: tuple[str, ...]) -> tuple[int, ...]:
        return columns.point(FieldPath.of(paths[0]), "xyz") if len(paths) == 1 else columns.add_all(paths)

    if not layout.position:
        return ()
    position = _first(layout.position, columns_of)
    if position is None:
        field_list = ", ".join(field_names(columns.example)[:20])
        raise FieldError(
            f"no field of {type_name(columns.example)} looks like a position; name one with `position`"
            + (f"; its fields are {field_list}" if field_list else "")
        )
    return position


class OrderError(FieldError):
    """A quaternion in a list without an order, or a quaternion of named fields with an order."""


def _orientation(layout: MessageLayout, columns: _Columns) -> tuple[int, ...]:
    def columns_of(paths: str | tuple[str, ...]) -> tuple[int, ...]:
        if isinstance(paths, tuple):
            return columns.add_all(paths)
        quaternion_value = walk(FieldPath.of(paths), columns.example)
        quaternion = columns.point(FieldPath.of(paths), "xyzw")
        if len(quaternion) != 4:
            raise FieldError(f"{paths}: it is not a quaternion; give the path of one with x, y, z, w")
        if not is_list(quaternion_value):
            if layout.order:
                raise OrderError(f"{paths}: its fields are named x, y, z and w; leave `order` out")
            return quaternion
        if not layout.order:
            raise OrderError(
                f"{paths}: the four numbers have no names; `order: wxyz` says that w comes first,"
                " `order: xyzw` that it comes last"
            )
        return tuple(quaternion[layout.order.index(axis)] for axis in "xyzw")

    return _first(layout.orientation, columns_of) or ()


def _first(alternatives: Sequence[_Option], resolve: Callable[[_Option], _Resolved]) -> _Resolved | None:
    """Return the first alternative that resolves; None if several alternatives all fail.

    Raises:
        FieldError: the only alternative does not resolve.
    """
    for option in alternatives:
        try:
            return resolve(option)
        except OrderError:
            raise
        except FieldError:
            if len(alternatives) == 1:
                raise
    return None


def _polygon(layout: MessageLayout, columns: _Columns) -> tuple[Get | None, bool]:
    """Return the getter of an outline, and whether it returns rings instead of corners."""
    example = columns.example
    if len(layout.polygon) > 1:
        columns.add_all(layout.polygon)
        return tuple_getter(list(map(FieldPath.of, layout.polygon)), example), False
    outline_path = layout.polygon[0] if layout.polygon else layout.shape.outline if layout.shape else ""
    if not outline_path:
        return None, False
    path = FieldPath.of(outline_path)
    if (ring_path := path_of_rings(path, example)) is not None:
        return (getter(ring_path, example) if ring_path.steps else lambda element: element), True
    outline = walk(path, example)
    if "points" in field_names(outline):
        # geometry_msgs/Polygon
        path, outline = below(path, "points"), get_field(outline, "points")
    if not is_list(outline):
        raise FieldError(f"{path.text}: expected a list of corners, got {type_name(outline)}")
    return getter(path, example), False


def _uncertainty(layout: MessageLayout, columns: _Columns) -> tuple[float | int | None, Get | None]:
    uncertainty = layout.uncertainty
    if uncertainty is None:
        return None, None
    if not uncertainty.is_covariance:
        return columns.measure(uncertainty.measure), None
    path = FieldPath.of(str(uncertainty.measure) or layout.covariance or "covariance")
    covariance = walk(path, columns.example)
    if not is_list(covariance) or len(covariance) not in (4, 9, 36):
        raise FieldError(
            f"{path.text}: expected a covariance of 4, 9 or 36 numbers, got {type_name(covariance)}"
        )
    return None, getter(path, columns.example)


def _frame(
    paths: Sequence[str], example: object, message: object, needs_frame: bool
) -> tuple[Get, bool] | None:
    for path_text in paths:
        path = FieldPath.of(path_text)
        root = message if path.from_message else example
        if (len(paths) > 1 or not needs_frame) and not leads_somewhere(path, root):
            continue
        frame_name = walk(path, root)
        if not isinstance(frame_name, str):
            raise FieldError(f"{path.text}: expected the name of a frame, got {type_name(frame_name)}")
        return getter(path, root), path.from_message
    return None


def bind_time(
    stamps: Sequence[Stamp], example: object, message: object, faults: list[str] | None = None
) -> TimeGetter | None:
    """Bind the first existing stamp that is a time; None if none of several stamps is a time.

    Args:
        faults: list that gets the reasons why existing fields are not times.

    Raises:
        FieldError: the only stamp does not exist, or is not a time.
    """
    for stamp in stamps:
        path = FieldPath.of(stamp.field)
        root = message if path.from_message else example
        if len(stamps) > 1 and not leads_somewhere(path, root):
            continue
        try:
            return _time_getter(stamp, path, root)
        except FieldError as error:
            if len(stamps) == 1:
                raise
            if faults is not None:
                faults.append(str(error))
    return None


def _time_getter(stamp: Stamp, path: FieldPath, root: object) -> TimeGetter:
    stamp_value = walk(path, root)
    if stamp.nanoseconds:
        paths = [path, FieldPath.of(stamp.nanoseconds)]
        if not all(is_number(walk(part_path, root)) for part_path in paths):
            raise FieldError(f"{path.text}: seconds and nanoseconds have to be numbers")
        return TimeGetter(path, tuple_getter(paths, root), True, 1)
    existing_names = field_names(stamp_value)
    any_or_all = any if isinstance(stamp_value, Sparse) else all
    for part_names in _TIME_FIELDS:
        if any_or_all(name in existing_names for name in part_names):
            pair_getter = tuple_getter([below(path, name) for name in part_names], root)
            return TimeGetter(path, pair_getter, True, 1)
    if is_list(stamp_value) and len(stamp_value) == 2 and all(type(part) is int for part in stamp_value):
        return TimeGetter(path, getter(path, root), True, 1)
    if isinstance(stamp_value, str):
        ns_from_text(stamp_value, stamp.unit_ns)
    elif not is_number(stamp_value):
        remedy = "give the path of a stamp, a number or a text; `clock: log` takes the time of recording"
        raise FieldError(f"{path.text}: {type_name(stamp_value)} is not a time; {remedy}")
    return TimeGetter(path, getter(path, root), False, stamp.unit_ns)
