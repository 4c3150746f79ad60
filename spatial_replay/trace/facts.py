"""How each topic of a log was read, in numbers that a person checks at a glance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Distribution(NamedTuple):
    """The least, the median and the greatest of numbers, and when the greatest came, if that is known."""

    least: float
    median: float
    greatest: float
    greatest_ns: int | None = None


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """Content of one mapped topic, as it was read; numbers without a measurement are None.

    Attributes:
        messages: their number, from `first_ns` to `last_ns` on the clock of the mapping.
        period_s: the intervals between messages, seconds; the greatest is the longest pause.
        lateness_s: how much later messages were recorded than their stamps say, seconds.
        publishers: number of channels.
        frames: that its messages name.
        objects: number of reports, of which one message has up to `most_at_once`.
        name: how names are made: the entry of the mapping; "" for the default of the type.
        names: of the objects.
        classes: of the objects; None for objects without one.
        class_changes: how often an object was reported with another class than before.
        signals: names of the signals.
        size, shorter_side: longer and shorter sides of outlines, in footprint units.
        low, high: the least and the greatest coordinates, as messages have them.
        speed, turn_rate: between reports of an object, in footprint units and radians a second.
        bottom, top: heights of objects.
        uncertainty: radii of objects.
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
