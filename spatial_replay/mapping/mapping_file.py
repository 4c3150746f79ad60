"""Load mapping files: YAML in, a `LogMapping` or a list of all errors out.

The text is checked in two steps: against the published JSON Schema, and for contradictions that a schema
cannot express. Violations of the schema become plain sentences. The first half of the module defines the
values of a mapping.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from collections.abc import Mapping as Table
from dataclasses import dataclass
from dataclasses import field as value_of
from decimal import Decimal
from functools import lru_cache
from itertools import combinations
from math import pi
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

from spatial_replay.errors import LogError, UsageError
from spatial_replay.logs.formats.episodes import AS_STORED, EpisodeReading
from spatial_replay.logs.formats.mujoco import identity_of_model
from spatial_replay.logs.remote import log_file
from spatial_replay.mapping.field_paths import FieldPath, NameTemplate
from spatial_replay.mapping.yaml_document import Document, Place, checked_document, read_yaml_text, schema_of
from spatial_replay.text import nearest_hint
from spatial_replay.trace.units import OUR_AXES, Axes

Clock: TypeAlias = Literal["log", "publish", "header"]
"""Time of a message: of recording ("log"), of sending ("publish"), or its stamp ("header")."""

DEFAULT_MAX_AGE_NS = 10**9
FOREVER_NS = 2**63 - 1
"""`max_age` of observations that stay valid forever, nanoseconds."""

NO_TOPIC = "no topic was chosen: name one with objects or signals"
"""Error of a mapping without topics."""
NO_FEATURE = "no feature was chosen: name one with objects or signals"
"""Error of a mapping without features."""
NO_FRAME = "no frame was chosen: name the one that coordinates are brought into"
"""Error of a mapping whose `fixed_frame` has no value."""

Measure: TypeAlias = float | str
"""A number, or the path of a field with the number."""


@dataclass(frozen=True, slots=True)
class ShapeMapping:
    """A footprint in an object's own frame.

    Attributes:
        kind: "box", "disc" or "polygon".
        sizes: of a box: length along x, width along y, and maybe height along z; of a disc: radius.
        points: fixed corners of a polygon.
        outline: path of the corners of a polygon; "" for fixed corners.
        offset: centre (x, y) in the object's own frame, in footprint units.
        height: bottom and top above the object's origin.
    """

    kind: Literal["box", "disc", "polygon"]
    sizes: tuple[Measure, ...] = ()
    points: tuple[tuple[float, float], ...] = ()
    outline: str = ""
    offset: tuple[float, float] = (0.0, 0.0)
    height: tuple[Measure, Measure] | None = None


@dataclass(frozen=True, slots=True)
class ClassMapping:
    """Mapping from a field to a class: `table[str(value)]`, or `other` for values outside the table.

    Attributes:
        has_other: whether `other` is given. Otherwise a value outside the table is itself the class.
        changes: effect of a change of class: only a remark ("remark"), a second object ("split"), or no
            effect ("first").
    """

    field: str
    table: Table[str, str | None] = value_of(default_factory=lambda: MappingProxyType({}), hash=False)
    other: str | None = None
    has_other: bool = False
    changes: Literal["remark", "split", "first"] = "remark"


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Radius of uncertainty: a number, a field, or `sigmas` standard deviations of a covariance.

    Attributes:
        measure: number or field path; "" for the covariance of a built-in type.
    """

    measure: Measure
    is_covariance: bool = False
    sigmas: float = 2.0


@dataclass(frozen=True, slots=True)
class SignalMapping:
    """A signal: the path of its field, and its unit.

    Attributes:
        unit: unit of the numbers, or names of the numbers as a JSON object (see `names_from_unit`).
    """

    name: str
    field: str
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Stamp:
    """Field of a stamp: a ROS or protobuf time, or a number of units.

    Attributes:
        unit_ns: unit of a number, nanoseconds.
        nanoseconds: path of the nanoseconds, if `field` holds only seconds; otherwise "".
    """

    field: str
    unit_ns: int = 1
    nanoseconds: str = ""


@dataclass(frozen=True, slots=True)
class Angle:
    """Field of an angle; the yaw in radians is zero + scale * angle.

    Attributes:
        scale: radians per unit of the field; negative if angles count clockwise.
        zero: yaw at angle 0, in radians.
        is_plain: whether the mapping leaves out the zero and the direction.
    """

    field: str
    scale: float = 1.0
    zero: float = 0.0
    is_plain: bool = True


@dataclass(frozen=True, slots=True)
class TopicMapping:
    """Entry of one topic; None selects the default of the message type.

    Attributes:
        reads_objects: whether the topic has objects; False for topics with signals only.
        objects: path of the list of objects; "" for a message that is one object.
        complete: whether a message lists all existing objects. Then objects missing from a message have left.
        position: path of a point, or paths of x, y and maybe z.
        orientation: path of a quaternion, or paths of its x, y, z and w.
        order: order of the four numbers of a quaternion in a list.
        yaw: field of an angle.
        bounds: path of two opposite corners of an axis-aligned box, or paths of its four numbers.
        bounds_have_size: whether the last two numbers are width and height instead of a corner.
        only, without: patterns of names to keep, and of names to leave out.
        max_age_ns: validity of an observation, nanoseconds.
        clock: clock of this topic; None for the mapping's clock.
        scale: units of the log per unit of the topic's positions, sizes, heights and uncertainties.
        invalid: numbers that stand for a missing value.
        has_zeros_left_out: whether fields missing from JSON messages are 0.
        optional: whether a log may lack the topic.
        publisher: number, from 1, of the only publisher whose messages are read; None for all publishers.
    """

    topic: str
    reads_objects: bool = True
    type: str | None = None
    objects: str | None = None
    complete: bool | None = None
    name: str | None = None
    class_name: str | ClassMapping | None = None
    position: str | tuple[str, ...] | None = None
    orientation: str | tuple[str, ...] | None = None
    order: Literal["xyzw", "wxyz"] | None = None
    yaw: Angle | None = None
    polygon: str | None = None
    bounds: str | tuple[str, ...] | None = None
    bounds_have_size: bool = False
    shape: ShapeMapping | None = None
    height: tuple[Measure, Measure] | None = None
    uncertainty: Uncertainty | None = None
    frame: str | None = None
    frame_field: str | None = None
    stamp: Stamp | None = None
    signals: tuple[SignalMapping, ...] = ()
    only: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    max_age_ns: int | None = None
    clock: Clock | None = None
    scale: float = 1.0
    invalid: tuple[float, ...] = ()
    has_zeros_left_out: bool = False
    optional: bool = False
    publisher: int | None = None


@dataclass(frozen=True, slots=True)
class Sampling:
    """Sampling: a sample at each message of a topic, or at each multiple of a step.

    Attributes:
        topic: sampled topic. None without `step_ns` selects the most frequent topic with objects.
        step_ns: step, nanoseconds; None for samples at messages.
    """

    topic: str | None = None
    step_ns: int | None = None


@dataclass(frozen=True, slots=True)
class LogMapping:
    """A valid mapping.

    Attributes:
        name: name of the file.
        sha256: hash of the file's content, independent of layout and comments.
        fixed_frame: frame into which coordinates are transformed; None for coordinates as they are.
        topics: entries of topics, in the file's order.
        max_gap_ns: pause of a topic, nanoseconds, beyond which its objects are unknown.
        trims_ends: whether samples before the start, and after the end, of a needed topic are left out.
        axes: axes of the fixed frame; without a fixed frame, axes of the messages.
        origin: latitude and longitude of the point (0, 0), degrees, for satellite fixes.
        accept: names of assumptions that the log may contradict.
        features: entries of a data set's features, in the file's order, with the feature as `topic`.
        episodes: options for reading a data set.
        shapes: shapes by name, also for bodies that a data set names itself.
    """

    name: str
    sha256: str
    topics: tuple[TopicMapping, ...]
    fixed_frame: str | None = None
    clock: Clock = "log"
    sampling: Sampling = Sampling()
    max_age_ns: int | None = None
    max_gap_ns: int | None = None
    trims_ends: bool = True
    axes: Axes = OUR_AXES
    origin: tuple[float, float] | None = None
    accept: tuple[str, ...] = ()
    features: tuple[TopicMapping, ...] = ()
    episodes: EpisodeReading = AS_STORED
    shapes: Table[str, ShapeMapping] = value_of(default_factory=lambda: MappingProxyType({}), hash=False)

    @property
    def identity(self) -> str:
        """Hash of the file's content, and of the models and meshes that it references."""
        model, assets = self.episodes.model, self.episodes.assets
        if model is None and assets is None:
            return self.sha256
        try:
            return f"{self.sha256} {identity_of_model(model, assets)}"
        except (LogError, OSError) as error:
            # reading an episode raises this error again
            return f"{self.sha256} {error}"


UNITS_NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}
_DURATION = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)(ns|us|ms|s)", re.ASCII)


def duration_ns(text: str) -> int:
    """Parse `100ms` or `0.5s` to nanoseconds.

    Raises:
        UsageError: the text is not a duration above 0.
    """
    match = _DURATION.fullmatch(text)
    nanoseconds = int(Decimal(match[1]) * UNITS_NS[match[2]]) if match else 0
    if nanoseconds <= 0:
        raise UsageError(f"{text!r} is not a duration; write 100ms or 0.5s")
    return nanoseconds


def age_ns(text: str) -> int:
    """Parse a duration, or `forever`, to nanoseconds.

    Raises:
        UsageError: the text is neither a duration nor `forever`.
    """
    return FOREVER_NS if text == "forever" else duration_ns(text)


_NO_TIME = re.compile(r"0+(\.0*)?[nums]*", re.ASCII)
_SIGNAL_KEYS = frozenset({"signals", "max_age", "clock", "stamp", "optional", "missing", "publisher"})
"""Keys that do not concern objects. An entry with `signals` and only such keys has no objects."""


def load_mapping(path: str | PathLike[str]) -> LogMapping:
    """Load a mapping file, from a path or an address.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the file is not a valid mapping; all errors are listed.
    """
    file = log_file(path)
    if file.name.endswith(".spatial"):
        raise UsageError(f"{file.name} is a specification, not a mapping; give it by --spec")
    return parse_mapping(read_yaml_text(path), file.name, file.parent if isinstance(file, Path) else None)


@lru_cache(maxsize=8)
def parse_mapping(text: str, name: str = "mapping", folder: Path | None = None) -> LogMapping:
    """Parse the text of a mapping file; the last eight results are cached.

    Args:
        name: name of the file, for errors.
        folder: folder of the file; paths in the file are relative to it.

    Raises:
        UsageError: the text is not a valid mapping; all errors are listed.
    """
    document = checked_document(text, name, schema_of("mapping", "mapping"), _contradictions, "a mapping")
    try:
        return _mapping(document, name, folder or Path())
    except UsageError as error:
        raise UsageError(f"{name}: {error}") from None


def _mapping(document: Document, name: str, folder: Path) -> LogMapping:
    root: Any = document.value
    shapes = root.get("shapes") or {}
    sampling = root.get("sample", {})
    # the hash is computed from a canonical form, so that it does not depend on layout and comments
    canonical_text = json.dumps(root, ensure_ascii=False, separators=(",", ":"), allow_nan=True)
    fixed_frame, origin = root.get("fixed_frame"), root.get("origin")
    topics = tuple(_topic_mapping(topic, entry or {}, shapes) for topic, _, entry in _entries(root, "topics"))
    features = tuple(
        _topic_mapping(feature, _without_indices(entry), shapes)
        for feature, _, entry in _entries(root, "features")
    )
    unit_by_signal = {
        signal.name: signal.unit for entry in (*topics, *features) for signal in entry.signals if signal.unit
    }
    return LogMapping(
        name=name,
        sha256=hashlib.sha256(canonical_text.encode("utf-8", "surrogatepass")).hexdigest(),
        topics=topics,
        fixed_frame=None if fixed_frame is None else fixed_frame.removeprefix("/"),
        clock=root.get("clock", "log"),
        sampling=Sampling(
            sampling.get("topic"), duration_ns(sampling["every"]) if "every" in sampling else None
        ),
        max_age_ns=age_ns(root["max_age"]) if "max_age" in root else None,
        max_gap_ns=duration_ns(root["max_gap"]) if "max_gap" in root else None,
        trims_ends=root.get("ends", "trim") == "trim",
        accept=tuple(root.get("accept", ())),
        origin=(float(origin[0]), float(origin[1])) if origin else None,
        axes=Axes(
            root.get("axes", {}).get("y", "up"),
            float(root.get("scale", 1.0)),
            root.get("unit", ""),
            unit_by_signal,
        ),
        features=features,
        episodes=EpisodeReading(
            fps=float(root["fps"]) if "fps" in root else None,
            label=root.get("label"),
            model=folder / root["model"] if "model" in root else None,
            order=root.get("order"),
            assets=folder / root["assets"] if "assets" in root else None,
        ),
        shapes=MappingProxyType({name: shape for name in shapes if (shape := _shape(name, shapes))}),
    )


def _entries(root: Table[str, Any], section: str) -> Iterator[tuple[str, Place, Any]]:
    """Yield (topic or feature, place, entry) for each entry; one topic may have several entries."""
    for name, entry in root.get(section, {}).items():
        if isinstance(entry, list):
            yield from ((name, (section, name, index), list_entry) for index, list_entry in enumerate(entry))
        else:
            yield name, (section, name), entry


def _without_indices(entry: Any) -> Any:
    """Return the entry of a feature, with each index such as 3 written as a place such as `[3]`."""

    def as_text(index: Any) -> Any:
        if isinstance(index, list):
            return list(map(as_text, index))
        if isinstance(index, dict):
            return {**index, "field": as_text(index["field"])}
        return f"[{index}]" if isinstance(index, int) else index

    path_entries = {key: as_text(entry[key]) for key in ("position", "orientation", "yaw") if key in entry}
    if "signals" in entry:
        path_entries["signals"] = {name: as_text(index) for name, index in entry["signals"].items()}
    return {**entry, **path_entries}


_OF_TOPICS = ("topics", "fixed_frame", "origin", "clock", "sample", "max_age", "ends")
"""Keys that apply to logs of messages only."""
_OF_EPISODES = ("features", "label", "fps", "model", "assets", "order")
"""Keys that apply to data sets of episodes only."""


def _contradictions_of_kinds(root: Table[str, Any]) -> Iterator[tuple[Place, str]]:
    """Yield faults of a file that mixes keys of logs and data sets, or lacks both."""
    episode_keys = [key for key in _OF_EPISODES if key in root]
    if not episode_keys and "topics" not in root:
        yield (), "the key 'topics' is missing, or 'features' for a data set of episodes"
    for key in _OF_TOPICS if episode_keys else ():
        if key in root:
            yield (key,), f"it is for logs of messages, and {episode_keys[0]!r} for data sets of episodes"
    if "features" in root and not root["features"]:
        yield ("features",), NO_FEATURE


def _contradictions(document: Document) -> list[tuple[Place, str]]:
    """Return faults that a schema cannot express: unknown shapes, conflicting keys, durations of 0."""
    root: Any = document.value
    if isinstance(root, dict) and "topics" in root and not root["topics"]:
        return [(("topics",), NO_TOPIC)]
    if not isinstance(root, dict):
        return []
    faults = list(_contradictions_of_kinds(root))
    if not all(isinstance(root.get(key, {}), dict) for key in ("topics", "features")):
        return faults
    shapes_by_name = root.get("shapes")
    shapes = list(shapes_by_name) if isinstance(shapes_by_name, dict) else []
    if root.get("fixed_frame", "") is None:
        faults.append((("fixed_frame",), NO_FRAME))
    feature_entries = list(_entries(root, "features"))
    entries = [*_entries(root, "topics"), *feature_entries]
    for _, place, entry in feature_entries:
        if isinstance(entry, dict) and "position" not in entry and not entry.keys() <= _SIGNAL_KEYS:
            faults.append((place, "the key 'position' is missing"))
    for _, place, entry in entries:
        if not isinstance(entry, dict):
            continue
        shape = entry.get("shape")
        if isinstance(shape, str) and shape not in shapes:
            hint = nearest_hint(shape, shapes) or f"shapes are {', '.join(shapes) or 'none'}"
            faults.append(((*place, "shape"), f"there is no shape {shape[:60]!r}; {hint}"))
        outlines = combinations(("polygon", "bounds", "shape"), 2)
        for key, other_key in (*outlines, ("orientation", "yaw")):
            if key in entry and other_key in entry:
                faults.append(((*place, other_key), f"there is {key!r} already; give one of the two"))
        is_feature = place[0] == "features"
        faults += [
            ((*place, *inner_place), fault)
            for inner_place, fault in _contradictions_of_turns(entry, is_feature)
        ]
    tables_with_durations: list[tuple[Place, Any, str]] = [
        ((), root, "max_age"),
        ((), root, "max_gap"),
        (("sample",), root.get("sample"), "every"),
    ]
    tables_with_durations += [(place, entry, "max_age") for _, place, entry in entries]
    for place, table, key in tables_with_durations:
        duration_text = table.get(key) if isinstance(table, dict) else None
        if isinstance(duration_text, str) and _NO_TIME.fullmatch(duration_text):
            faults.append(((*place, key), f"{duration_text!r} is not a time; give a duration above 0"))
    return faults


def _contradictions_of_turns(entry: Table[str, Any], is_feature: bool) -> Iterator[tuple[Place, str]]:
    orientation, yaw = entry.get("orientation"), entry.get("yaw")
    if "order" in entry and isinstance(orientation, list) and not is_feature:
        yield ("order",), "the four paths of `orientation` give the order, x, y, z and w; leave `order` out"
    if "order" in entry and yaw is not None:
        yield ("order",), "it is the order of a quaternion, and there is `yaw`; give one of the two"
    if isinstance(yaw, dict) and "field" in yaw and ("zero" in yaw) != ("clockwise" in yaw):
        missing_key, example = ("zero", "north") if "clockwise" in yaw else ("clockwise", "true")
        yield (
            ("yaw",),
            f"`zero` and `clockwise` belong together; add `{missing_key}: {example}` or the opposite",
        )


def _topic_mapping(topic: str, entry: Table[str, Any], shapes: Table[str, Any]) -> TopicMapping:
    """Return the topic's mapping for an entry that conforms to the schema.

    Raises:
        UsageError: a path or a template is invalid, although it conforms to the schema.
    """
    if "objects" in entry:
        FieldPath.of(entry["objects"])
    if "name" in entry:
        NameTemplate.of(entry["name"])
    frame = entry.get("frame")
    position, orientation, height = entry.get("position"), entry.get("orientation"), entry.get("height")
    shape = _shape(entry.get("shape"), shapes)
    bounds, bounds_form = entry.get("bounds"), "xyxy"
    if isinstance(bounds, dict):
        bounds, bounds_form = bounds["field"], bounds["form"]
    return TopicMapping(
        topic=topic,
        reads_objects="signals" not in entry or not entry.keys() <= _SIGNAL_KEYS,
        type=entry.get("type"),
        objects=entry.get("objects"),
        complete=entry.get("complete"),
        name=entry.get("name"),
        class_name=_class(entry.get("class")),
        position=tuple(position) if isinstance(position, list) else position,
        orientation=tuple(orientation) if isinstance(orientation, list) else orientation,
        order=entry.get("order"),
        yaw=_angle(entry.get("yaw")),
        polygon=entry.get("polygon"),
        bounds=tuple(bounds) if isinstance(bounds, list) else bounds,
        bounds_have_size=bounds_form == "xywh",
        shape=shape,
        height=_height(height) if height or shape is None else shape.height,
        uncertainty=_uncertainty(entry.get("uncertainty")),
        frame=frame.removeprefix("/") if isinstance(frame, str) else None,
        frame_field=frame["field"] if isinstance(frame, dict) else None,
        stamp=_stamp(entry.get("stamp")),
        signals=tuple(_signal(name, signal_entry) for name, signal_entry in entry.get("signals", {}).items()),
        only=tuple(entry.get("only", ())),
        without=tuple(entry.get("except", ())),
        max_age_ns=age_ns(entry["max_age"]) if "max_age" in entry else None,
        clock=entry.get("clock"),
        scale=float(entry.get("scale", 1.0)),
        invalid=tuple(map(float, entry.get("invalid", ()))),
        has_zeros_left_out="missing" in entry,
        optional=entry.get("optional", False),
        publisher=entry.get("publisher"),
    )


def _angle(angle_entry: Any) -> Angle | None:
    if not isinstance(angle_entry, dict):
        return None if angle_entry is None else Angle(angle_entry)
    # MAVLink sends hundredths of a degree
    scale = {"rad": 1.0, "deg": pi / 180, "cdeg": pi / 18_000}[angle_entry.get("unit", "rad")]
    return Angle(
        angle_entry["field"],
        -scale if angle_entry.get("clockwise") else scale,
        pi / 2 if angle_entry.get("zero") == "north" else 0.0,
        is_plain="zero" not in angle_entry and "clockwise" not in angle_entry,
    )


def _class(class_entry: Any) -> str | ClassMapping | None:
    if not isinstance(class_entry, dict):
        return None if class_entry is None else str(class_entry)
    return ClassMapping(
        class_entry["field"],
        MappingProxyType(dict(class_entry.get("names", {}))),
        class_entry.get("else"),
        "else" in class_entry,
        class_entry.get("changes", "remark"),
    )


def _shape(shape_entry: Any, shapes: Table[str, Any]) -> ShapeMapping | None:
    if shape_entry is None:
        return None
    if isinstance(shape_entry, str):
        shape_entry = shapes[shape_entry]
    x, y = shape_entry.get("offset", (0.0, 0.0))
    offset, height = (float(x), float(y)), _height(shape_entry.get("height"))
    if "box" in shape_entry:
        return ShapeMapping(
            "box", tuple(_measure(size) for size in shape_entry["box"]), offset=offset, height=height
        )
    if "disc" in shape_entry:
        return ShapeMapping("disc", (_measure(shape_entry["disc"]),), offset=offset, height=height)
    if isinstance(shape_entry["polygon"], str):
        return ShapeMapping("polygon", outline=shape_entry["polygon"], offset=offset, height=height)
    corners = tuple((float(x), float(y)) for x, y in shape_entry["polygon"])
    return ShapeMapping("polygon", points=corners, offset=offset, height=height)


def _height(height_entry: Any) -> tuple[Measure, Measure] | None:
    return (_measure(height_entry[0]), _measure(height_entry[1])) if height_entry else None


def _uncertainty(uncertainty_entry: Any) -> Uncertainty | None:
    if uncertainty_entry is None:
        return None
    if isinstance(uncertainty_entry, dict):
        return Uncertainty(uncertainty_entry["covariance"], True, float(uncertainty_entry.get("sigmas", 2.0)))
    if uncertainty_entry == "covariance":
        return Uncertainty("", True)
    return Uncertainty(_measure(uncertainty_entry))


def _measure(measure_entry: Any) -> Measure:
    return measure_entry if isinstance(measure_entry, str) else float(measure_entry)


def _stamp(stamp_entry: Any) -> Stamp | None:
    if isinstance(stamp_entry, dict):
        return Stamp(stamp_entry["field"], UNITS_NS[stamp_entry.get("unit", "ns")])
    if isinstance(stamp_entry, list):
        return Stamp(stamp_entry[0], nanoseconds=stamp_entry[1])
    return None if stamp_entry is None else Stamp(stamp_entry)


def _signal(name: str, signal_entry: Any) -> SignalMapping:
    """Return the mapping of a signal.

    Raises:
        UsageError: two numbers have the same name.
    """
    if not isinstance(signal_entry, dict):
        return SignalMapping(name, signal_entry)
    number_by_text: dict[str, float] = {}
    for raw_key, label in signal_entry.get("names", {}).items():
        signal_text, number = (label, float(raw_key)) if isinstance(label, str) else (raw_key, float(label))
        if number_by_text.setdefault(signal_text, number) != number:
            raise UsageError(
                f"names of the signal {name!r}: two numbers are called {signal_text!r};"
                " give each its own name"
            )
    return SignalMapping(
        name,
        signal_entry["field"],
        signal_entry.get("unit", json.dumps(number_by_text) if number_by_text else ""),
    )
