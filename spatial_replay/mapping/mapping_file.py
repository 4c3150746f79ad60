"""Load mapping files: YAML in, a `LogMapping` or a list of all errors out.

The text is checked in two steps: against the published JSON Schema, whose violations are put into plain
words, and for contradictions that a schema cannot express.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from collections.abc import Mapping as Table
from functools import cache
from importlib.resources import files
from math import pi
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from spatial_replay.errors import MissingFileError, UsageError
from spatial_replay.mapping.field_paths import FieldPath, NameTemplate
from spatial_replay.mapping.model import (
    UNITS_NS,
    ClassMapping,
    LogMapping,
    Measure,
    Sampling,
    ShapeMapping,
    SignalMapping,
    Stamp,
    TopicMapping,
    Uncertainty,
    age_ns,
    duration_ns,
)
from spatial_replay.mapping.yaml_document import LARGEST_TEXT, Document, Place, document_from_text
from spatial_replay.text import nearest_hint
from spatial_replay.trace.axes import Axes

if TYPE_CHECKING:
    from jsonschema.protocols import Validator

SCHEMA_FILE = "mapping.schema.json"

_MOST_FAULTS = 100
_NO_TIME = re.compile(r"0+(\.0*)?[nums]*", re.ASCII)
_SIGNAL_KEYS = frozenset({"signals", "max_age", "clock", "stamp", "optional"})
"""Keys that do not concern objects: a topic with signals and no other keys has no objects."""


def load_mapping(path: str | PathLike[str]) -> LogMapping:
    """Load a mapping file.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the file is not a valid mapping; all errors are listed.
    """
    try:
        with Path(path).open("rb") as stream:
            data = stream.read(LARGEST_TEXT + 1)
    except (OSError, ValueError) as error:
        raise MissingFileError.of(path, error) from None
    name = Path(path).name
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UsageError(f"{name}:{line}: a byte is not UTF-8; give a text file") from None
    return parse_mapping(text, name)


def parse_mapping(text: str, name: str = "mapping") -> LogMapping:
    """Parse the text of a mapping file.

    Args:
        name: of the file, for errors.

    Raises:
        UsageError: the text is not a valid mapping; all errors are listed.
    """
    document = document_from_text(text)
    faults = list(document.faults)
    if not faults:
        # one error for each place; a contradiction says more than the schema
        violations = [
            fault for error in _validator().iter_errors(document.value) for fault in _described(error)
        ]
        by_place = dict(violations + _contradictions(document))
        faults = [
            (document.line_of(place), f"{_text_from_place(place)}{what}") for place, what in by_place.items()
        ]
    if faults:
        lines = [f"{name}:{line}: {what}" for line, what in sorted(faults)]
        more = [f"… and {len(lines) - _MOST_FAULTS} more"] if len(lines) > _MOST_FAULTS else []
        raise UsageError("\n".join(lines[:_MOST_FAULTS] + more))
    try:
        return _mapping(document, name)
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None


def _mapping(document: Document, name: str) -> LogMapping:
    value: Any = document.value
    shapes = value.get("shapes") or {}
    sample = value.get("sample", {})
    # the hash ignores layout and comments: the same mapping has the same hash
    canonical = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=True)
    fixed_frame = value.get("fixed_frame")
    return LogMapping(
        name=name,
        sha256=hashlib.sha256(canonical.encode("utf-8", "surrogatepass")).hexdigest(),
        topics=tuple(_topic_mapping(topic, entry or {}, shapes) for topic, entry in value["topics"].items()),
        fixed_frame=None if fixed_frame is None else fixed_frame.removeprefix("/"),
        clock=value.get("clock", "log"),
        sampling=Sampling(sample.get("topic"), duration_ns(sample["every"]) if "every" in sample else None),
        max_age_ns=age_ns(value["max_age"]) if "max_age" in value else None,
        axes=Axes(value.get("axes", {}).get("y", "up"), float(value.get("scale", 1.0))),
    )


def _contradictions(document: Document) -> list[tuple[Place, str]]:
    """Find what a schema cannot express: unknown shapes, keys that exclude each other, durations of 0."""
    value = document.value
    if not isinstance(value, dict) or not isinstance(value.get("topics"), dict):
        return []
    listed = value.get("shapes")
    shapes = list(listed) if isinstance(listed, dict) else []
    faults: list[tuple[Place, str]] = []
    topics: Any = value["topics"]
    for topic, entry in topics.items():
        if not isinstance(entry, dict):
            continue
        shape = entry.get("shape")
        if isinstance(shape, str) and shape not in shapes:
            hint = nearest_hint(shape, shapes) or f"shapes are {', '.join(shapes) or 'none'}"
            faults.append((("topics", topic, "shape"), f"there is no shape {shape[:60]!r}; {hint}"))
        for one, other in (("polygon", "shape"), ("orientation", "yaw")):
            if one in entry and other in entry:
                faults.append((("topics", topic, other), f"there is {one!r} already; give one of the two"))
    for place, text in _durations(value):
        if isinstance(text, str) and _NO_TIME.fullmatch(text):
            faults.append((place, f"{text!r} is not a time; give a duration above 0"))
    return faults


def _durations(value: Any) -> list[tuple[Place, Any]]:
    tables: list[tuple[Place, Any, str]] = [
        ((), value, "max_age"),
        (("sample",), value.get("sample"), "every"),
    ]
    tables += [(("topics", topic), entry, "max_age") for topic, entry in value["topics"].items()]
    return [((*place, key), table.get(key)) for place, table, key in tables if isinstance(table, dict)]


def _text_from_place(place: Place) -> str:
    text = ""
    for step in place:
        text += f"[{step}]" if isinstance(step, int) else f"{'.' if text else ''}{step[:80]}"
    return f"{text}: " if text else ""


def _topic_mapping(topic: str, entry: Table[str, Any], shapes: Table[str, Any]) -> TopicMapping:
    """Return the mapping of a topic from an entry that follows the schema.

    Raises:
        UsageError: a path or a template is invalid, although the schema allows it.
    """
    if "objects" in entry:
        FieldPath.of(entry["objects"])
    if "name" in entry:
        NameTemplate.of(entry["name"])
    frame = entry.get("frame")
    yaw, position, height = entry.get("yaw"), entry.get("position"), entry.get("height")
    return TopicMapping(
        topic=topic,
        reads_objects="signals" not in entry or not entry.keys() <= _SIGNAL_KEYS,
        type=entry.get("type"),
        objects=entry.get("objects"),
        complete=entry.get("complete"),
        name=entry.get("name"),
        class_name=_class(entry.get("class")),
        position=tuple(position) if isinstance(position, list) else position,
        orientation=entry.get("orientation"),
        yaw=yaw["field"] if isinstance(yaw, dict) else yaw,
        yaw_scale=pi / 180 if isinstance(yaw, dict) and yaw.get("unit") == "deg" else 1.0,
        polygon=entry.get("polygon"),
        shape=_shape(entry.get("shape"), shapes),
        height=(_measure(height[0]), _measure(height[1])) if height else None,
        uncertainty=_uncertainty(entry.get("uncertainty")),
        frame=frame.removeprefix("/") if isinstance(frame, str) else None,
        frame_field=frame["field"] if isinstance(frame, dict) else None,
        stamp=_stamp(entry.get("stamp")),
        signals=tuple(_signal(name, value) for name, value in entry.get("signals", {}).items()),
        only=tuple(entry.get("only", ())),
        without=tuple(entry.get("except", ())),
        max_age_ns=age_ns(entry["max_age"]) if "max_age" in entry else None,
        clock=entry.get("clock"),
        optional=entry.get("optional", False),
    )


def _class(value: Any) -> str | ClassMapping | None:
    if not isinstance(value, dict):
        return None if value is None else str(value)
    return ClassMapping(
        value["field"], MappingProxyType(dict(value.get("names", {}))), value.get("else"), "else" in value
    )


def _shape(value: Any, shapes: Table[str, Any]) -> ShapeMapping | None:
    if value is None:
        return None
    if isinstance(value, str):
        value = shapes[value]
    x, y = value.get("offset", (0.0, 0.0))
    offset = (float(x), float(y))
    if "box" in value:
        return ShapeMapping("box", tuple(_measure(size) for size in value["box"]), offset=offset)
    if "disc" in value:
        return ShapeMapping("disc", (_measure(value["disc"]),), offset=offset)
    corners = tuple((float(x), float(y)) for x, y in value["polygon"])
    return ShapeMapping("polygon", points=corners, offset=offset)


def _uncertainty(value: Any) -> Uncertainty | None:
    if value is None:
        return None
    if isinstance(value, dict):
        return Uncertainty(value["covariance"], True, float(value.get("sigmas", 2.0)))
    if value == "covariance":
        return Uncertainty("", True)
    return Uncertainty(_measure(value))


def _measure(value: Any) -> Measure:
    return value if isinstance(value, str) else float(value)


def _stamp(value: Any) -> Stamp | None:
    if isinstance(value, dict):
        return Stamp(value["field"], UNITS_NS[value.get("unit", "ns")])
    return None if value is None else Stamp(value)


def _signal(name: str, value: Any) -> SignalMapping:
    if isinstance(value, dict):
        return SignalMapping(name, value["field"], value.get("unit", ""))
    return SignalMapping(name, value)


@cache
def _validator() -> Validator:
    from jsonschema import Draft202012Validator

    text = files(__package__).joinpath(SCHEMA_FILE).read_text(encoding="utf-8")
    return Draft202012Validator(json.loads(text))


def _described(error: Any) -> Iterator[tuple[Place, str]]:
    """Iterate over the places of a violation of the schema, with what belongs there."""
    place: Place = tuple(error.absolute_path)
    keyword = error.validator
    if keyword == "anyOf" and isinstance(error.instance, dict | list):
        branches: dict[int, list[Any]] = {}
        for each in error.context:
            branches.setdefault(each.schema_path[0], []).append(each)
        for branch in branches.values():
            # not an alternative that failed because the whole value has another type
            if not any(each.validator == "type" and len(each.absolute_path) == len(place) for each in branch):
                for each in branch:
                    yield from _described(each)
                return
    if keyword == "additionalProperties" and isinstance(error.instance, dict):
        known = list(error.schema.get("properties", {}))
        for key in error.instance:
            if key not in known:
                hint = nearest_hint(key, known) or f"known are {', '.join(known)}"
                yield (*place, key), f"unknown key; {hint}"
    elif keyword == "required":
        missing = [key for key in error.validator_value if key not in error.instance]
        yield place, f"the key {missing[0]!r} is missing"
    elif "propertyNames" in error.absolute_schema_path:
        yield place, "a name is empty; give it a name"
    else:
        wanted = error.schema.get("description", _around(error))
        yield place, f"expected {wanted}; got {_shown(error.instance)}"


def _around(error: Any) -> str:
    """Return what belongs where a rule without a description was violated: that of the rule around it."""
    parent = error.parent
    while parent is not None and "description" not in parent.schema:
        parent = parent.parent
    fallback = f"something that fits {error.validator} {error.validator_value}"
    return fallback if parent is None else str(parent.schema["description"])


def _shown(value: object) -> str:
    """Return a short text for a value."""
    if isinstance(value, dict):
        return f"keys {', '.join(map(str, value))[:60]}" if value else "{}"
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:59] + "…"
