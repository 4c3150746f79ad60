"""The axes of a source: which way its y points and how long its unit is.

Samples always have y upwards, so that `above` means above and drawings are the right way up. Images count
their rows downwards; what is measured in them is turned over when it is read, and by nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import FootprintBatch
from spatial_replay.trace.declared_units import (
    checked_units,
    signal_units_from_metadata,
    signal_units_metadata,
)
from spatial_replay.trace.trace import Trace

AXES_KEY = "source_axes"
"""The entry of a log's metadata that says what the axes of its source were."""


@dataclass(frozen=True, slots=True)
class Axes:
    """The axes of a source, as opposed to those of samples.

    Attributes:
        y: where its y points.
        scale: footprint units per unit of the source.
        unit: what a footprint unit is, for readers: "m"; "" where nothing declares it.
    """

    y: Literal["up", "down"] = "up"
    scale: float = 1.0
    unit: str = ""

    @classmethod
    def from_metadata(cls, about: Mapping[str, str]) -> Axes:
        """Return the axes that a log's metadata say its source had; ours, where they say nothing."""
        try:
            found = json.loads(about.get(AXES_KEY, "{}"))
            y: Literal["up", "down"] = "down" if found.get("y") == "down" else "up"
            return cls(y, float(found.get("scale", 1.0)), str(found.get("unit", "")))
        except (ValueError, TypeError, AttributeError):
            return cls()

    def metadata(self) -> dict[str, str]:
        """Return the entry for the metadata of a log; none where the source has our axes."""
        if self == OUR_AXES:
            return {}
        unit = {"unit": self.unit} if self.unit else {}
        return {AXES_KEY: json.dumps({"scale": self.scale, **unit, "y": self.y})}

    def units_with(self, of_signals: Mapping[str, str]) -> dict[str, str]:
        """Return all that is declared: the units of signals by their names, and that of lengths by ""."""
        return {**of_signals, **({"": self.unit} if self.unit else {})}

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
        if self.scale == 1.0:
            return replace(shapes, vertices=vertices)
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
"""Those of samples: y up."""


def units_metadata(units: Mapping[str, str] | None) -> dict[str, str]:
    """Return the entries for the metadata of a log whose samples have these units.

    Raises:
        UsageError: units that are not texts by names.
    """
    units = checked_units(units)
    return Axes(unit=units.get("", "")).metadata() | signal_units_metadata(units)


def units_from_metadata(about: Mapping[str, str]) -> dict[str, str]:
    """Return the units that a log's metadata declare: of signals by their names, of lengths by ""."""
    return Axes.from_metadata(about).units_with(signal_units_from_metadata(about))
