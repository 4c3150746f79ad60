"""The axes and units of a source: direction of y, unit of lengths, and units of signals.

Samples always have y upwards, so that `above` means above and drawings are the right way up. Row numbers of
images increase downwards, so coordinates from images are mirrored once, when they are read.
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
"""Metadata key of a log for the axes of its source and the unit of lengths."""
SIGNAL_UNITS_KEY = "signal_units"
"""Metadata key of a log for the units of its signals."""


@dataclass(frozen=True, slots=True)
class Axes:
    """The axes and units of a source, from which reading converts to the axes of samples.

    Attributes:
        y: direction of its y axis.
        scale: footprint units per unit of the source.
        unit: name of the footprint unit, such as "m"; "" if it is not declared.
        signals: units by name of a signal. A unit may be replaced by names of numbers, see `names_from_unit`.
    """

    y: Literal["up", "down"] = "up"
    scale: float = 1.0
    unit: str = ""
    signals: Mapping[str, str] = field(default_factory=dict, compare=False)

    @classmethod
    def of_units(cls, units: Mapping[str, str]) -> Axes:
        """Return `OUR_AXES` with declared units.

        Args:
            units: units of signals by name; the unit of lengths under "".
        """
        return cls(unit=units.get("", ""), signals={name: unit for name, unit in units.items() if name})

    @classmethod
    def from_metadata(cls, about: Mapping[str, str]) -> Axes:
        """Return the axes of a log's source from the log's metadata, by default `OUR_AXES`."""
        try:
            axes, signals = (json.loads(about.get(key, "{}")) for key in (AXES_KEY, SIGNAL_UNITS_KEY))
            y: Literal["up", "down"] = "down" if axes.get("y") == "down" else "up"
            signal_units = {name: unit for name, unit in signals.items() if name and isinstance(unit, str)}
            return cls(y, float(axes.get("scale", 1.0)), str(axes.get("unit", "")), signal_units)
        # other programs may write anything under these keys
        except (ValueError, TypeError, AttributeError, RecursionError):
            return cls()

    def metadata(self) -> dict[str, str]:
        """Return the entries for a log's metadata. `OUR_AXES` without units have no entries."""
        unit = {"unit": self.unit} if self.unit else {}
        axes = {"scale": self.scale, **unit, "y": self.y} if self != OUR_AXES else {}
        entries = {AXES_KEY: axes, SIGNAL_UNITS_KEY: dict(sorted(self.signals.items()))}
        return {key: json.dumps(value) for key, value in entries.items() if value}

    @property
    def units(self) -> dict[str, str]:
        """The declared units: units of signals by name, the unit of lengths under ""."""
        return {**self.signals, **({"": self.unit} if self.unit else {})}

    def __str__(self) -> str:
        turned = " (down in the source)" if self.y == "down" else ""
        scaled = "" if self.scale == 1.0 else f"; 1 unit of the source is {self.scale:g}"
        lengths = f"; lengths in {self.unit}" if self.unit else ""
        return f"y up{turned}{scaled}{lengths}"

    def convert_shapes(self, shapes: FootprintBatch) -> FootprintBatch:
        """Convert footprints from the axes of the source to the axes of samples."""
        if self == OUR_AXES:
            return shapes
        vertices, vertex_start = shapes.vertices, shapes.vertex_start
        if self.y == "down":
            # mirroring turns an outline clockwise, so the order of each part's vertices is reversed
            reversed_order = np.repeat(
                vertex_start[:-1] + vertex_start[1:] - 1, np.diff(vertex_start)
            ) - np.arange(len(vertices))
            vertices = vertices[reversed_order]
            # 0 - y instead of -y, which would turn 0 into -0
            vertices = np.column_stack([vertices[:, 0], 0.0 - vertices[:, 1]])
        return replace(
            shapes,
            vertices=vertices * self.scale,
            radius=shapes.radius * self.scale,
            bottom=shapes.bottom * self.scale,
            top=shapes.top * self.scale,
        )

    def convert_yaw(self, yaw: Floats) -> Floats:
        """Convert angles (R,) from the axes of the source to the axes of samples, radians."""
        # 0 - yaw instead of -yaw, which would turn 0 into -0
        return 0.0 - yaw if self.y == "down" else yaw

    def convert_trace(self, trace: Trace) -> Trace:
        """Convert samples from the axes of the source to `OUR_AXES`."""
        if (self.y, self.scale) == ("up", 1.0):
            return trace
        return replace(
            trace,
            footprints=self.convert_shapes(trace.footprints),
            yaw=self.convert_yaw(trace.yaw),
            uncertainty=trace.uncertainty * self.scale,
        )


OUR_AXES = Axes()
"""The axes of samples: y upwards, scale 1."""


OTHER_UNITS: Final = 8.0
"""Size ratio from which on two runs are assumed to use different units."""

_MOST_SIZES: Final = 256
"""Maximum number of samples from which an object's median size is computed."""


def require_same_units(a: Trace, b: Trace, called: tuple[str, str] = ("A", "B")) -> None:
    """Refuse two runs if all common objects are many times larger in one run than in the other.

    Args:
        called: names of the runs in the message.

    Raises:
        UsageError: the runs seem to have different units.
    """
    ratios, example = [], ""
    for name in sorted(set(a.names) & set(b.names)):
        size_a, size_b = _size(a, name), _size(b, name)
        if min(size_a, size_b) > 0.0:
            ratios.append(size_a / size_b)
            ratio, larger_run = (ratios[0], called[0]) if ratios[0] > 1.0 else (1.0 / ratios[0], called[1])
            example = example or f"{name} is {ratio:,.0f} times as large in {larger_run}"
    if ratios and (min(ratios) >= OTHER_UNITS or max(ratios) <= 1.0 / OTHER_UNITS):
        runs = "the runs" if called == ("A", "B") else " and ".join(called)
        raise UsageError(
            f"{runs} seem to have different units: {example}. Read both in one unit by `scale` in a mapping"
        )


def _size(trace: Trace, name: str) -> float:
    """Return the median extent of an object, radii included; 0 for a point or an unknown position."""
    rows = trace.rows[:, trace.names.index(name)]
    rows = rows[rows >= 0]
    if not len(rows):
        return 0.0
    # ceiling division gives an even spread of at most `_MOST_SIZES` rows
    return float(np.median(trace.footprints.select(rows[:: -(-len(rows) // _MOST_SIZES)]).sizes))
