"""A reading bound to the first object that was seen: paths that lead somewhere, compiled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from spatial_replay.mapping.field_paths import (
    FieldError,
    FieldPath,
    Get,
    Style,
    below,
    check,
    field_names,
    getter,
    is_list,
    is_number,
    leads_somewhere,
    style_of,
    tuple_getter,
    type_name,
    walk,
)
from spatial_replay.mapping.message_types import MessageLayout
from spatial_replay.mapping.model import Measure, Stamp
from spatial_replay.mapping.stamps import TimeGetter, bind_time

_Option = TypeVar("_Option")
_Found = TypeVar("_Found")


@dataclass(frozen=True, slots=True)
class Binding:
    """Where the columns of objects come from; a column is the place in the tuple that `numbers` gives.

    Attributes:
        numbers: every number that is read from an object, at once.
        position: columns of x, y and maybe z; () where a polygon says it all.
        orientation: columns of x, y, z, w; () for none.
        yaw: a column, or None.
        sizes: columns of a box, where the message has its sizes.
        shape_sizes, height: of the mapping, a number or a column each.
        uncertainty: a number, a column, or None.
        frame: how a frame's name is read, from the message or from the object; None for the fixed frame.
    """

    style: Style
    numbers: Get | None
    width: int
    position: tuple[int, ...]
    orientation: tuple[int, ...]
    yaw: int | None
    sizes: tuple[int, ...]
    shape_sizes: tuple[float | int, ...]
    height: tuple[float | int, ...]
    uncertainty: float | int | None
    polygon: Get | None
    covariance: Get | None
    class_gets: tuple[Get, ...]
    frame: tuple[Get, bool] | None
    lifetime: TimeGetter | None


class _Columns:
    """Paths of numbers, each once."""

    def __init__(self, example: object) -> None:
        self.example = example
        self.paths: list[FieldPath] = []

    def add(self, path: FieldPath) -> int:
        if path.from_message:
            raise FieldError(f"{path.text}: $. is for frame, stamp and signals; give a field of the object")
        value = walk(path, self.example)
        if not is_number(value):
            raise FieldError(f"{path.text}: {type_name(value)} where a number belongs")
        texts = [known.text for known in self.paths]
        if path.text in texts:
            return texts.index(path.text)
        self.paths.append(path)
        return len(self.paths) - 1

    def point(self, path: FieldPath, names: str) -> tuple[int, ...]:
        """The columns of a point's coordinates, as far as it has them: at least two."""
        value = walk(path, self.example)
        known = field_names(value)
        if all(name in known for name in names[:2]):
            return tuple(self.add(below(path, name)) for name in names if name in known)
        if is_list(value) and 2 <= len(value) <= len(names):
            return tuple(self.add(below(path, index)) for index in range(len(value)))
        fields = f"; its fields are {', '.join(known)}" if known else ""
        raise FieldError(f"{path.text}: {type_name(value)} has no {' and '.join(names[:2])}{fields}")

    def measure(self, measure: Measure) -> float | int:
        """A column (an int), or the number (a float) itself."""
        return self.add(FieldPath.of(measure)) if isinstance(measure, str) else float(measure)


def bind(reading: MessageLayout, example: object, message: object, *, needs_frame: bool) -> Binding:
    """
    Args:
        example: the first object, found in `message`.

    Raises:
        FieldError: a path leads nowhere; the text names the fields that are there.
    """
    style = style_of(example)
    columns = _Columns(example)
    position: tuple[int, ...] = ()
    orientation: tuple[int, ...] = ()
    yaw: int | None = None
    if not reading.solids:
        orientation = _orientation(reading, columns)
        yaw = None if orientation else _yaw(reading, columns)
        position = () if reading.polygon and reading.is_generic else _position(reading, columns)
    uncertainty, covariance = _uncertainty(reading, columns, style)
    sizes = (
        _first(reading.sizes, lambda paths: tuple(columns.add(FieldPath.of(path)) for path in paths)) or ()
    )
    shape_sizes = tuple(map(columns.measure, reading.shape.sizes)) if reading.shape else ()
    height = tuple(map(columns.measure, reading.height)) if reading.height else ()
    polygon = _polygon(reading, example, style)
    class_paths = [FieldPath.of(path) for path in reading.class_field]
    if len(class_paths) == 1:
        check(class_paths[0], example)
    lifetime = None
    if reading.stays:
        lifetime = bind_time((Stamp("lifetime"),), example, message)
    paths = columns.paths
    return Binding(
        style=style,
        numbers=tuple_getter(paths, style) if paths else None,
        width=len(paths),
        position=position,
        orientation=orientation,
        yaw=yaw,
        sizes=sizes,
        shape_sizes=shape_sizes,
        height=height,
        uncertainty=uncertainty,
        polygon=polygon,
        covariance=covariance,
        class_gets=tuple(getter(path, style) for path in class_paths),
        frame=_frame(reading, example, message, needs_frame),
        lifetime=lifetime,
    )


def _position(reading: MessageLayout, columns: _Columns) -> tuple[int, ...]:
    def columns_of(paths: tuple[str, ...]) -> tuple[int, ...]:
        if len(paths) == 1:
            return columns.point(FieldPath.of(paths[0]), "xyz")
        return tuple(columns.add(FieldPath.of(path)) for path in paths)

    if not reading.position:
        return ()
    found = _first(reading.position, columns_of)
    if found is None:
        fields = ", ".join(field_names(columns.example)[:20])
        raise FieldError(
            f"no field of {type_name(columns.example)} looks like a position; name one with `position`"
            + (f"; its fields are {fields}" if fields else "")
        )
    return found


def _orientation(reading: MessageLayout, columns: _Columns) -> tuple[int, ...]:
    def columns_of(path: str) -> tuple[int, ...]:
        found = columns.point(FieldPath.of(path), "xyzw")
        if len(found) != 4:
            raise FieldError(f"{path}: it is no quaternion; give the path of one with x, y, z, w")
        return found

    return _first(reading.orientation, columns_of) or ()


def _yaw(reading: MessageLayout, columns: _Columns) -> int | None:
    return _first(reading.yaw, lambda path: columns.add(FieldPath.of(path)))


def _first(alternatives: Sequence[_Option], resolve: Callable[[_Option], _Found]) -> _Found | None:
    """What the first alternative that is there resolves to; a single one must be there.

    Raises:
        FieldError: the only alternative leads nowhere.
    """
    for option in alternatives:
        try:
            return resolve(option)
        except FieldError:
            if len(alternatives) == 1:
                raise
    return None


def _polygon(reading: MessageLayout, example: object, style: Style) -> Get | None:
    if not reading.polygon:
        return None
    path = FieldPath.of(reading.polygon[0])
    value = walk(path, example)
    if not is_list(value):
        raise FieldError(f"{path.text}: {type_name(value)} where a list of corners belongs")
    return getter(path, style)


def _uncertainty(
    reading: MessageLayout, columns: _Columns, style: Style
) -> tuple[float | int | None, Get | None]:
    wanted = reading.uncertainty
    if wanted is None:
        return None, None
    if not wanted.is_covariance:
        return columns.measure(wanted.measure), None
    path = FieldPath.of(str(wanted.measure) or reading.covariance or "covariance")
    value = walk(path, columns.example)
    if not is_list(value) or len(value) not in (4, 9, 36):
        raise FieldError(
            f"{path.text}: {type_name(value)} is no covariance; give the path of 4, 9 or 36 numbers"
        )
    return None, getter(path, style)


def _frame(
    reading: MessageLayout, example: object, message: object, needs_frame: bool
) -> tuple[Get, bool] | None:
    for text in reading.frame:
        path = FieldPath.of(text)
        root = message if path.from_message else example
        if (len(reading.frame) > 1 or not needs_frame) and not leads_somewhere(path, root):
            continue
        value = walk(path, root)
        if not isinstance(value, str):
            raise FieldError(f"{path.text}: {type_name(value)} where a frame's name belongs")
        return getter(path, style_of(root)), path.from_message
    return None
