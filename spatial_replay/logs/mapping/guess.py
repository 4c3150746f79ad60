"""What in a message looks like an object: where it is, what it is called, how large it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from spatial_replay.logs.mapping.fields import field_names, get_field
from spatial_replay.logs.mapping.paths import is_list

_DEEPEST = 4
_POSITIONS = ("position", "center", "centre", "translation", "location", "point")
_TURNS = ("orientation", "rotation", "quaternion")
_YAWS = ("yaw", "theta", "heading", "angle")
_SIZES = ("dimension", "dimensions", "size", "scale", "extent", "shape", "bbox")
_OUTLINES = ("corners", "polygon", "points", "vertices", "outline", "footprint", "contour")
_NAMES = ("name", "id", "track_id", "object_id", "tracking_id", "child_frame_id", "uuid", "label")
_CLASSES = ("class", "class_name", "classification", "category", "label", "object_type", "type")
_LISTS = (
    "object",
    "detection",
    "track",
    "tag",
    "agent",
    "obstacle",
    "pose",
    "vehicle",
    "pedestrian",
    "marker",
)
_NOT_PLACES = frozenset(
    {"velocity", "acceleration", "twist", "linear", "angular", "header", "stamp", "covariance"}
)


@dataclass(frozen=True, slots=True)
class Guess:
    """How an object may be read; texts are field paths.

    Attributes:
        objects: the path of the list that it is in, or None.
        position: of a point, or paths of x and y.
        size: paths of length, width and maybe height; or of a radius.
        others: further lists whose elements look like objects.
    """

    objects: str | None = None
    position: str | tuple[str, ...] | None = None
    orientation: str | None = None
    yaw: str | None = None
    polygon: str | None = None
    size: tuple[str, ...] = ()
    name: str | None = None
    class_name: str | None = None
    others: tuple[str, ...] = ()

    @property
    def score(self) -> int:
        """How much of an object it is."""
        parts = (self.polygon, self.size, self.name, self.orientation or self.yaw, self.class_name)
        return 10 * (self.polygon is not None or self.position is not None) + sum(map(bool, parts))


def guess_from(message: object) -> Guess | None:
    """What in a message looks like an object, or a list of them; None if nothing does."""
    itself = _object_in(message)
    lists = sorted(
        ((guess, path) for path, guess in _iter_lists(message)),
        key=lambda found: (-_kinship(found[1]), -found[0].score),
    )
    if lists and (itself is None or itself.polygon is None):
        best, path = lists[0]
        return replace(best, objects=path, others=tuple(other for _, other in lists[1:]))
    return itself


def numbers_in(message: object) -> tuple[str, ...]:
    """The paths of the numbers of a message that stand outside of lists and of its header."""
    return tuple(
        path
        for path, value in _iter_fields(message, passed_over=frozenset({"header", "stamp"}))
        if _is_number(value)
    )


def frame_of(message: object) -> str | None:
    """The frame that a message says its coordinates are in."""
    for path, value in _iter_fields(message, passed_over=frozenset()):
        if path.split(".")[-1] == "frame_id" and isinstance(value, str) and value:
            return value.removeprefix("/")
    return None


def _iter_lists(message: object) -> Iterator[tuple[str, Guess]]:
    for path, value in _iter_fields(message):
        if is_list(value) and len(value) and field_names(value[0]):
            guess = _object_in(value[0])
            # corners of one outline are points, not objects
            if guess is not None and not (path.split(".")[-1] in _OUTLINES and guess.score <= 10):
                yield f"{path}[*]", guess


def _object_in(value: object) -> Guess | None:
    """The object that a message or an element of a list is."""
    fields = dict(_iter_fields(value))
    polygon = next((path for path in _named(fields, _OUTLINES) if _is_outline(fields[path])), None)
    position = _position_in(fields)
    if polygon is None and position is None:
        return None
    yaw = _first(fields, _YAWS, _is_number) if polygon is None else None
    turn = next((path for path in _named(fields, _TURNS) if _has(fields[path], "xyzw")), None)
    return Guess(
        position=position if polygon is None else None,
        orientation=turn if polygon is None else None,
        yaw=None if turn else yaw,
        polygon=polygon,
        size=_size_in(fields) if polygon is None else (),
        name=_name_in(fields),
        class_name=_first(fields, _CLASSES, lambda each: isinstance(each, str)),
    )


def _position_in(fields: dict[str, object]) -> str | tuple[str, ...] | None:
    for path in _named(fields, _POSITIONS):
        if _has(fields[path], "xy"):
            return path
    if _is_number(fields.get("x")) and _is_number(fields.get("y")) and not _is_number(fields.get("w")):
        return ("x", "y")
    return None


def _size_in(fields: dict[str, object]) -> tuple[str, ...]:
    for path in _named(fields, _SIZES):
        for names in (("length", "width", "height"), ("x", "y", "z"), ("size_x", "size_y", "size_z")):
            known = field_names(fields[path])
            if all(name in known and _is_number(get_field(fields[path], name)) for name in names[:2]):
                return tuple(f"{path}.{name}" for name in names if name in known)
    for names in (("length", "width", "height"), ("size_x", "size_y", "size_z")):
        if all(_is_number(fields.get(name)) for name in names[:2]):
            return tuple(name for name in names if name in fields)
    return ("radius",) if _is_number(fields.get("radius")) else ()


def _name_in(fields: dict[str, object]) -> str | None:
    for path in _named(fields, _NAMES):
        value = fields[path]
        if isinstance(value, str | int) and not isinstance(value, bool):
            return path
        if "value" in field_names(value):
            return f"{path}.value"
    return None


def _named(fields: dict[str, object], names: tuple[str, ...]) -> list[str]:
    """The paths that end in one of some names: the shallowest first, then in the order of the names."""
    found = [path for path in fields if path.split(".")[-1].lower() in names]
    return sorted(found, key=lambda path: (path.count("."), names.index(path.split(".")[-1].lower())))


def _first(fields: dict[str, object], names: tuple[str, ...], fits: Callable[[object], bool]) -> str | None:
    return next((path for path in _named(fields, names) if fits(fields[path])), None)


def _iter_fields(
    value: object, path: str = "", depth: int = 0, *, passed_over: frozenset[str] = _NOT_PLACES
) -> Iterator[tuple[str, object]]:
    """Every field of a message, and of those in it, with its path; lists are not entered."""
    for name in field_names(value) if depth < _DEEPEST else ():
        inner = get_field(value, name)
        full = f"{path}.{name}" if path else name
        if name not in passed_over:
            yield full, inner
            yield from _iter_fields(inner, full, depth + 1, passed_over=passed_over)


def _kinship(path: str) -> int:
    """How much a list's name sounds like objects that move."""
    last = path.removesuffix("[*]").split(".")[-1].lower()
    return 2 * ("moving" in last or "dynamic" in last) + any(word in last for word in _LISTS)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _has(value: object, names: str) -> bool:
    """Whether a message has fields of one letter each, all numbers."""
    known = field_names(value)
    return all(name in known and _is_number(get_field(value, name)) for name in names)


def _is_outline(value: object) -> bool:
    if not is_list(value):
        return "points" in field_names(value) and _is_outline(get_field(value, "points"))
    return len(value) >= 3 and _has(value[0], "xy")
