"""What a mapping file says: which topics carry which objects and signals, and when a sample is taken.

Durations as mapping files write them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping as Table
from dataclasses import dataclass
from dataclasses import field as value_of
from decimal import Decimal
from types import MappingProxyType
from typing import Literal, TypeAlias

from spatial_replay.errors import UsageError

Clock: TypeAlias = Literal["log", "publish", "header"]
"""Which of a message's times counts: when it was recorded, when it was sent, or the stamp inside it."""

DEFAULT_MAX_AGE_NS = 10**9
FOREVER_NS = 2**63 - 1
"""A `max_age` that never ends."""

Measure: TypeAlias = float | str
"""A number, or the field path where a message has it."""


@dataclass(frozen=True, slots=True)
class ShapeMapping:
    """A footprint in an object's own frame.

    Attributes:
        kind: "box" (sizes: length along x, width along y, or also height along z), "disc" (sizes: radius) or
            "polygon" (points: its corners).
        offset: where its centre stands in the object's own frame (x, y), in footprint units.
    """

    kind: Literal["box", "disc", "polygon"]
    sizes: tuple[Measure, ...] = ()
    points: tuple[tuple[float, float], ...] = ()
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ClassMapping:
    """What a field's values mean: `table[str(value)]`, or `other` for values that are not in it."""

    field: str
    table: Table[str, str | None] = value_of(default_factory=lambda: MappingProxyType({}), hash=False)
    other: str | None = None
    has_other: bool = False


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """A radius: a number, a field of that number, or `sigmas` standard deviations of a covariance.

    Attributes:
        measure: the number or the field path; "" for the covariance that a built-in type has.
    """

    measure: Measure
    is_covariance: bool = False
    sigmas: float = 2.0


@dataclass(frozen=True, slots=True)
class SignalMapping:
    """A numeric signal: the field that holds it, and its unit as text."""

    name: str
    field: str
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Stamp:
    """Where a message or an object says when it was: a ROS or protobuf time, or a number of `unit`."""

    field: str
    unit_ns: int = 1


@dataclass(frozen=True, slots=True)
class TopicMapping:
    """How one topic is read; what is None is as the message's type has it.

    Attributes:
        objects: path of the list that holds the objects; "" for a message that is one object.
        complete: whether a message lists every object there is, so that those it leaves out have left.
        position: path of a point, or paths of x, y and maybe z.
        orientation: path of a quaternion.
        yaw: path of an angle, which `yaw_scale` turns into radians.
        only, without: patterns of names to keep, and to leave out.
        max_age_ns: how long an observation stays valid.
        clock: the clock of this topic where it is not the mapping's.
        reads_objects: false for topics that are read for their signals only.
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


@dataclass(frozen=True, slots=True)
class Sampling:
    """When samples are taken: at each message of a topic, or at each multiple of a step.

    Attributes:
        topic: None (and no step) for the first topic with objects.
    """

    topic: str | None = None
    step_ns: int | None = None


@dataclass(frozen=True, slots=True)
class LogMapping:
    """A mapping file, checked.

    Attributes:
        name: of the file.
        sha256: of what it says, however it is laid out.
        fixed_frame: the frame that everything is brought into; None leaves coordinates as they are.
        topics: in the file's order.
    """

    name: str
    sha256: str
    topics: tuple[TopicMapping, ...]
    fixed_frame: str | None = None
    clock: Clock = "log"
    sampling: Sampling = Sampling()
    max_age_ns: int | None = None


_UNITS_NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}
_DURATION = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)(ns|us|ms|s)", re.ASCII)


def duration_ns(text: str) -> int:
    """`100ms` or `0.5s` as nanoseconds.

    Raises:
        UsageError: for anything else, and for 0.
    """
    found = _DURATION.fullmatch(text)
    nanoseconds = int(Decimal(found[1]) * _UNITS_NS[found[2]]) if found else 0
    if nanoseconds <= 0:
        raise UsageError(f"{text!r} is no duration; write 100ms or 0.5s")
    return nanoseconds


def age_ns(text: str) -> int:
    """A duration, or `forever`.

    Raises:
        UsageError: for anything else.
    """
    return FOREVER_NS if text == "forever" else duration_ns(text)


def unit_ns(text: str) -> int:
    """Nanoseconds of a unit of time: ns, us, ms or s."""
    return _UNITS_NS[text]
