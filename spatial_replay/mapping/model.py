"""The content of a mapping file as values: topics with their objects and signals, and when samples are
taken."""

from __future__ import annotations

import re
from collections.abc import Mapping as Table
from dataclasses import dataclass
from dataclasses import field as value_of
from decimal import Decimal
from types import MappingProxyType
from typing import Literal, TypeAlias

from spatial_replay.errors import UsageError
from spatial_replay.trace.units import OUR_AXES, Axes, signal_units_metadata

Clock: TypeAlias = Literal["log", "publish", "header"]
"""Which time of a message counts: when it was recorded, when it was sent, or the stamp inside it."""

DEFAULT_MAX_AGE_NS = 10**9
FOREVER_NS = 2**63 - 1
"""The `max_age` of observations that stay valid forever."""

NO_TOPIC = "no topic was chosen: name one with objects or signals"
"""What is wrong with a mapping without topics."""
NO_FRAME = "no frame was chosen: name the one that coordinates are brought into"
"""What is wrong with a mapping whose fixed frame is left open."""

Measure: TypeAlias = float | str
"""A number, or the field path of one."""


@dataclass(frozen=True, slots=True)
class ShapeMapping:
    """A footprint in an object's own frame.

    Attributes:
        kind: "box" (sizes: length along x, width along y, or also height along z), "disc" (sizes: radius) or
            "polygon" (points: its corners; or outline: the path of these in each message).
        offset: its centre (x, y) in the object's own frame, in footprint units.
    """

    kind: Literal["box", "disc", "polygon"]
    sizes: tuple[Measure, ...] = ()
    points: tuple[tuple[float, float], ...] = ()
    outline: str = ""
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ClassMapping:
    """Maps a field to a class: `table[str(value)]`, or `other` for values that are not in the table."""

    field: str
    table: Table[str, str | None] = value_of(default_factory=lambda: MappingProxyType({}), hash=False)
    other: str | None = None
    has_other: bool = False


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """A radius: a number, the field of one, or `sigmas` standard deviations of a covariance.

    Attributes:
        measure: the number or the field path; "" for the covariance of a built-in type.
    """

    measure: Measure
    is_covariance: bool = False
    sigmas: float = 2.0


@dataclass(frozen=True, slots=True)
class SignalMapping:
    """A numeric signal: the path of its field, and its unit for readers.

    Attributes:
        table: the numbers of texts; other texts are unknown. Empty for a field with numbers.
    """

    name: str
    field: str
    unit: str = ""
    table: Table[str, float] = value_of(default_factory=lambda: MappingProxyType({}), hash=False)


@dataclass(frozen=True, slots=True)
class Stamp:
    """The field of a time: a ROS or protobuf time, or a number of `unit_ns`."""

    field: str
    unit_ns: int = 1


@dataclass(frozen=True, slots=True)
class TopicMapping:
    """How one topic is read; None leaves the default of the message type.

    Attributes:
        objects: path of the list of objects; "" for a message that is one object.
        complete: whether a message lists all objects that exist, so that those it leaves out have left.
        position: path of a point, or paths of x, y and maybe z.
        orientation: path of a quaternion.
        yaw: path of an angle; times `yaw_scale` it is in radians.
        bounds: path of two opposite corners of a box along the axes.
        only, without: patterns of names to keep, and to leave out.
        max_age_ns: how long an observation stays valid.
        clock: the clock of this topic, if not that of the mapping.
        has_zeros_left_out: whether fields that JSON messages lack are 0.
        reads_objects: false for topics that are read for their signals only.
        optional: whether a log may lack the topic.
    """

    topic: str
    reads_objects: bool = True
    type: str | None = None
    objects: str | None = None
    complete: bool | None = None
    name: str | None = None
    class_name: str | ClassMapping | None = None
    position: str | tuple[str, ...] | None = None
    orientation: str | None = None
    yaw: str | None = None
    yaw_scale: float = 1.0
    polygon: str | None = None
    bounds: str | None = None
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
    has_zeros_left_out: bool = False
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Sampling:
    """When samples are taken: at each message of a topic, or at multiples of a step.

    Attributes:
        topic: None, without a step, for the most frequent topic with objects.
    """

    topic: str | None = None
    step_ns: int | None = None


@dataclass(frozen=True, slots=True)
class LogMapping:
    """A valid mapping.

    Attributes:
        name: of the file.
        sha256: of its content, independent of layout and comments.
        fixed_frame: the frame that coordinates are transformed into; None leaves them as they are.
        topics: in the file's order.
        max_gap_ns: what lies in a longer pause of a topic is unknown.
        axes: those of the fixed frame, or of the messages without one.
        origin: latitude and longitude in degrees where the fixes of satellite receivers have (0, 0).
    """

    name: str
    sha256: str
    topics: tuple[TopicMapping, ...]
    fixed_frame: str | None = None
    clock: Clock = "log"
    sampling: Sampling = Sampling()
    max_age_ns: int | None = None
    max_gap_ns: int | None = None
    axes: Axes = OUR_AXES
    origin: tuple[float, float] | None = None

    @property
    def signal_units(self) -> Table[str, str]:
        """The units that are declared, by signal."""
        signals = [signal for topic in self.topics for signal in topic.signals]
        return {signal.name: signal.unit for signal in signals if signal.unit}

    def metadata(self) -> dict[str, str]:
        """Return the entries for the metadata of a log of these messages: axes and units."""
        return self.axes.metadata() | signal_units_metadata(self.signal_units)


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
        UsageError: the text is neither.
    """
    return FOREVER_NS if text == "forever" else duration_ns(text)
