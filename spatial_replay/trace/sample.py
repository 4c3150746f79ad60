"""One sample: the objects and signals known at one time, in whole nanoseconds (signed 64-bit)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from reprlib import repr as shortened
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from spatial_replay.errors import TraceError, UsageError
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.text import is_encodable, named_arguments, text_number

LATEST_NS = 2**63 - 1
"""The latest time of a sample."""

FOREVER = LATEST_NS + 1
"""A time after every sample."""


def require_time(value: object, name: str) -> None:
    """Check that a value is None or a time in ns.

    Raises:
        UsageError: anything else than None or an integer of at least 0.
    """
    if value is None:
        return
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
        raise UsageError(f"{name} is {shortened(value)}; give integer nanoseconds, 0 or more")


def _require_name(name: object, what: str) -> None:
    if not isinstance(name, str) or not name:
        raise TraceError(f"{what} is named {shortened(name)}; give a text that is not empty")
    if not is_encodable(name):
        raise TraceError(
            f"{what} is named {shortened(name)}, with half a character (a lone surrogate), which no log can"
            ' hold; decode names with errors="replace"'
        )


_EXAMPLES = MappingProxyType(
    {
        "objects": "{'cup': Footprint.disc(0, 0, 0.1)}",
        "signals": "{'battery': 0.8}",
        "unknown": "{'cup': None}",
    }
)


def _signal_value(name: str, value: Any) -> float:
    """Return a number as it is, and that of a text that is none."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(value, str):
            return text_number(value)
        raise TraceError(f"signal {name!r} is {shortened(value)}; give a number or a text") from error
    if isinstance(value, (str, bytes, bool, np.bool_)):
        raise TraceError(f"signal {name!r} is {shortened(value)}; give a number, such as 1.0 for true")
    return number


@named_arguments
@dataclass(frozen=True, slots=True)
class Sample:
    """Every object and signal at one time.

    Attributes:
        time_ns: nanoseconds, 0 to 2**63 - 1.
        objects: the detected objects by name; a bare footprint stands for a `TrackedObject` with it.
        signals: numbers by name, NaN for an unknown value; a text is stored as its `text_number`.
        unknown: the objects that are there, but not known where: their classes by name, None without one.
            Unlike an object that is left out, they stay members of open groups, and make atoms over these
            unknown.

    Raises:
        TraceError: an invalid time, name or value.
    """

    time_ns: int
    objects: Mapping[str, TrackedObject] = field(default_factory=dict)
    signals: Mapping[str, float] = field(default_factory=dict)
    unknown: Mapping[str, str | None] = field(default_factory=dict)

    if TYPE_CHECKING:
        # what is given may be less than what is there then
        def __init__(
            self,
            time_ns: int,
            objects: Mapping[str, TrackedObject | Footprint] = ...,
            signals: Mapping[str, float | str] = ...,
            unknown: Mapping[str, str | None] = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        if isinstance(self.time_ns, bool) or not isinstance(self.time_ns, (int, np.integer)):
            raise TraceError(f"time_ns is {self.time_ns!r}; give integer nanoseconds")
        for what, named in (("objects", self.objects), ("signals", self.signals), ("unknown", self.unknown)):
            if not isinstance(named, Mapping):
                raise TraceError(
                    f"{what} is {shortened(named)}; give a dict by name, as in {_EXAMPLES[what]}"
                )
        if not 0 <= self.time_ns <= LATEST_NS:
            raise TraceError(f"time_ns is {self.time_ns}; give a time from 0 to 2**63 - 1 ns")
        objects: dict[str, TrackedObject] = {}
        given: Mapping[str, object] = self.objects
        for name, tracked in given.items():
            _require_name(name, "an object")
            if isinstance(tracked, Footprint):
                tracked = TrackedObject(tracked)
            elif not isinstance(tracked, TrackedObject):
                raise TraceError(
                    f"object {name!r} is {shortened(tracked)}; give a Footprint or a TrackedObject; numbers"
                    f" and texts are signals: Sample(time_ns, objects, {{{name!r}: ...}})"
                )
            objects[name] = tracked
        signals: dict[str, float] = {}
        for name, value in self.signals.items():
            _require_name(name, "a signal")
            signals[name] = _signal_value(name, value)
        for name, class_name in self.unknown.items():
            _require_name(name, "an object")
            if name in objects:
                raise TraceError(f"object {name!r} is both known and unknown; give it once")
            # a class may be empty, as that of a tracked object
            if class_name not in (None, ""):
                _require_name(class_name, "a class")
        object.__setattr__(self, "time_ns", int(self.time_ns))
        object.__setattr__(self, "objects", MappingProxyType(objects))
        object.__setattr__(self, "unknown", MappingProxyType(dict(self.unknown)))
        object.__setattr__(self, "signals", MappingProxyType(signals))


def require_sample(value: object) -> None:
    """Refuse anything but a sample.

    Raises:
        UsageError: it is something else.
    """
    if not isinstance(value, Sample):
        raise UsageError(f"{shortened(value)} is not a sample; give a Sample(time_ns, objects)")
