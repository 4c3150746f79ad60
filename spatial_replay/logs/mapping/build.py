"""The entry of one topic in a mapping file, as a value."""

from __future__ import annotations

from collections.abc import Mapping as Table
from math import pi
from types import MappingProxyType
from typing import Any

from spatial_replay.logs.mapping.model import (
    Measure,
    Shape,
    Signal,
    Stamp,
    TopicMapping,
    Translation,
    Uncertainty,
)
from spatial_replay.logs.mapping.numbers import age_ns, unit_ns
from spatial_replay.logs.mapping.paths import Path
from spatial_replay.logs.mapping.templates import Template

_SIGNAL_KEYS = frozenset({"signals", "max_age", "clock", "stamp"})
"""Keys that say nothing about objects: a topic with signals and these alone has no objects."""


def topic_mapping_from_values(topic: str, entry: Table[str, Any], shapes: Table[str, Any]) -> TopicMapping:
    """An entry that follows the schema.

    Args:
        shapes: the shapes by name.

    Raises:
        UsageError: a path or a template that the schema let pass.
    """
    if "objects" in entry:
        Path.of(entry["objects"])
    if "name" in entry:
        Template.of(entry["name"])
    frame = entry.get("frame")
    yaw = entry.get("yaw")
    position = entry.get("position")
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
        height=_height(entry.get("height")),
        uncertainty=_uncertainty(entry.get("uncertainty")),
        frame=frame.removeprefix("/") if isinstance(frame, str) else None,
        frame_field=frame["field"] if isinstance(frame, dict) else None,
        stamp=_stamp(entry.get("stamp")),
        signals=tuple(_signal(name, value) for name, value in entry.get("signals", {}).items()),
        only=tuple(entry.get("only", ())),
        without=tuple(entry.get("except", ())),
        max_age_ns=age_ns(entry["max_age"]) if "max_age" in entry else None,
        clock=entry.get("clock"),
    )


def _class(value: Any) -> str | Translation | None:
    if not isinstance(value, dict):
        return None if value is None else str(value)
    return Translation(
        value["field"], MappingProxyType(dict(value.get("names", {}))), value.get("else"), "else" in value
    )


def _shape(value: Any, shapes: Table[str, Any]) -> Shape | None:
    if value is None:
        return None
    if isinstance(value, str):
        value = shapes[value]
    x, y = value.get("offset", (0.0, 0.0))
    offset = (float(x), float(y))
    if "box" in value:
        return Shape("box", tuple(_measure(size) for size in value["box"]), offset=offset)
    if "disc" in value:
        return Shape("disc", (_measure(value["disc"]),), offset=offset)
    corners = tuple((float(x), float(y)) for x, y in value["polygon"])
    return Shape("polygon", points=corners, offset=offset)


def _height(value: Any) -> tuple[Measure, Measure] | None:
    return None if value is None else (_measure(value[0]), _measure(value[1]))


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
    if value is None:
        return None
    return (
        Stamp(value["field"], unit_ns(value.get("unit", "ns"))) if isinstance(value, dict) else Stamp(value)
    )


def _signal(name: str, value: Any) -> Signal:
    return (
        Signal(name, value["field"], value.get("unit", ""))
        if isinstance(value, dict)
        else Signal(name, value)
    )
