"""Statistics of each mapped topic of a log, for a person who checks how the log was read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Distribution(NamedTuple):
    """Least, median and greatest value of a quantity, and the time of the greatest value, ns, or None."""

    least: float
    median: float
    greatest: float
    greatest_ns: int | None = None


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """Content of one mapped topic after reading. Distributions without a measurement are None.

    Attributes:
        messages: number of messages.
        first_ns, last_ns: times of the first and the last message, on the clock of the mapping.
        period_s: intervals between messages, s; the greatest is the longest pause.
        lateness_s: recording times minus stamps of messages, s.
        publishers: number of channels.
        frames: coordinate frames named in the messages.
        objects: number of reports of objects.
        most_at_once: largest number of reports in one message.
        name: mapping entry from which object names are made; "" for the default of the message type.
        names: names of the objects.
        classes: classes of the objects; None for objects without a class.
        class_changes: number of changes of an object's class between reports.
        signals: names of the signals.
        size, shorter_side: longer and shorter sides of outlines, in footprint units.
        low, high: least and greatest coordinates, in the units of the messages.
        speed, turn_rate: speeds between reports of an object, in footprint units and radians per second.
        bottom, top: heights of objects.
        uncertainty: uncertainty radii of objects.
    """

    topic: str
    messages: int
    first_ns: int | None
    last_ns: int | None
    period_s: Distribution | None
    lateness_s: Distribution | None
    publishers: int
    frames: tuple[str, ...]
    objects: int
    most_at_once: int
    name: str
    names: tuple[str, ...]
    classes: tuple[str | None, ...]
    class_changes: int
    signals: tuple[str, ...]
    size: Distribution | None
    shorter_side: Distribution | None
    low: tuple[float, ...]
    high: tuple[float, ...]
    speed: Distribution | None
    turn_rate: Distribution | None
    bottom: Distribution | None
    top: Distribution | None
    uncertainty: Distribution | None
