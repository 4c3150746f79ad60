"""The axes and units of a source: where its y points, how long its unit is, and the units of its signals.

Samples always have y upwards, so that `above` means above and drawings are the right way up. Images count
their rows downwards; what is measured in them is turned over when it is read, and by nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.trace.trace import Trace

AXES_KEY = "source_axes"
"""The entry of a log's metadata that says what the axes of its source were."""
SIGNAL_UNITS_KEY = "signal_units"
"""The entry of a log's metadata with the units of its signals; that of lengths is among the axes."""


@dataclass(frozen=True, slots=True)
class Axes:
    """The axes and units of a source, as opposed to those of samples.

    Attributes:
        y: where its y points.
        scale: footprint units per unit of the source.
        unit: what a footprint unit is, for readers: "m"; "" where nothing declares it.
        signals: units of signals, by their names; or names of their numbers, see `names_from_unit`.
    """

    y: Literal["up", "down"] = "up"
    scale: float = 1.0
    unit: str = ""
    signals: Mapping[str, str] = field(default_factory=dict, compare=False)

    @classmethod
    def of_units(cls, units: Mapping[str, str]) -> Axes:
        """Return our axes with units: of signals by their names, of lengths by ""."""
        return cls(unit=units.get("", ""), signals={name: unit for name, unit in units.items() if name})

    @classmethod
    def from_metadata(cls, about: Mapping[str, str]) -> Axes:
        """Return the axes that a log's metadata say its source had; ours, where they say nothing."""
        try:
            axes, signals = (json.loads(about.get(key, "{}")) for key in (AXES_KEY, SIGNAL_UNITS_KEY))
            y: Literal["up", "down"] = "down" if axes.get("y") == "down" else "up"
            declared = {name: unit for name, unit in signals.items() if name and isinstance(unit, str)}
            return cls(y, float(axes.get("scale", 1.0)), str(axes.get("unit", "")), declared)
        except (ValueError, TypeError, AttributeError, RecursionError):
            return cls()

    def metadata(self) -> dict[str, str]:
        """Return the entries for the metadata of a log; none where the source has our axes and no units."""
        unit = {"unit": self.unit} if self.unit else {}
        axes = {"scale": self.scale, **unit, "y": self.y} if self != OUR_AXES else {}
        about = {AXES_KEY: axes, SIGNAL_UNITS_KEY: dict(sorted(self.signals.items()))}
        return {key: json.dumps(value) for key, value in about.items() if value}

    @property
    def units(self) -> dict[str, str]:
        """All that is declared: the units of signals by their names, and that of lengths by ""."""
        return {**self.signals, **({"": self.unit} if self.unit else {})}

    def __str__(self) -> str:
        turned = " (down in the source)" if self.y == "down" else ""
        scaled = "" if self.scale == 1.0 else f"; 1 unit of the source is {self.scale:g}"
        lengths = f"; lengths in {self.unit}" if self.unit else ""
        return f"y up{turned}{scaled}{lengths}"

    def convert_shapes(self, shapes: FootprintBatch) -> FootprintBatch:
        """Return footprints of the source as those of samples."""
        if self == OUR_AXES:
            return shapes
        vertices, start = shapes.vertices, shapes.vertex_start
        if self.y == "down":
            # a mirrored outline runs clockwise, so each part's vertices are listed from its last to its first
            mirror = np.repeat(start[:-1] + start[1:] - 1, np.diff(start)) - np.arange(len(vertices))
            vertices = vertices[mirror]
            # 0 - y rather than -y: zero stays zero
            vertices = np.column_stack([vertices[:, 0], 0.0 - vertices[:, 1]])
        return replace(
            shapes,
            vertices=vertices * self.scale,
            radius=shapes.radius * self.scale,
            bottom=shapes.bottom * self.scale,
            top=shapes.top * self.scale,
        )

    def convert_yaw(self, yaw: Floats) -> Floats:
        """Return angles (R,) from the source's x axis as those of samples."""
        return 0.0 - yaw if self.y == "down" else yaw

    def convert_trace(self, trace: Trace) -> Trace:
        """Return samples of the source with our axes."""
        if (self.y, self.scale) == ("up", 1.0):
            return trace
        return replace(
            trace,
            footprints=self.convert_shapes(trace.footprints),
            yaw=self.convert_yaw(trace.yaw),
            uncertainty=trace.uncertainty * self.scale,
        )


OUR_AXES = Axes()
"""Axes of samples: y up."""


OTHER_UNITS: Final = 8.0
"""Size ratio from which two runs are taken to use different units."""

_MOST_SIZES: Final = 256
"""Samples of an object that its size is the median of."""


def require_same_units(a: Trace, b: Trace, called: tuple[str, str] = ("A", "B")) -> None:
    """Refuse runs whose common objects are all many times as large in one as in the other.

    Args:
        called: what the runs are called in the message.

    Raises:
        UsageError: the runs are in other units.
    """
    ratios, example = [], ""
    for name in sorted(set(a.names) & set(b.names)):
        size_a, size_b = _size(a, name), _size(b, name)
        if min(size_a, size_b) > 0.0:
            ratios.append(size_a / size_b)
            times, which = (ratios[0], called[0]) if ratios[0] > 1.0 else (1.0 / ratios[0], called[1])
            example = example or f"{name} is {times:,.0f} times as large in {which}"
    if ratios and (min(ratios) >= OTHER_UNITS or max(ratios) <= 1.0 / OTHER_UNITS):
        runs = "the runs" if called == ("A", "B") else " and ".join(called)
        raise UsageError(
            f"{runs} seem to be in other units: {example}. Read both in one unit, by a mapping with `scale`"
        )


def _size(trace: Trace, name: str) -> float:
    """Return the median extent of an object, radii included; 0 where it is a point or never observed."""
    rows = trace.rows[:, trace.names.index(name)]
    rows = rows[rows >= 0]
    if not len(rows):
        return 0.0
    return float(np.median(trace.footprints.select(rows[:: -(-len(rows) // _MOST_SIZES)]).sizes))
