"""Objects collected one by one into columns."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import nan

import numpy as np

from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import Concave
from spatial_replay.trace.observations import Observations, trace_from_observations
from spatial_replay.trace.ragged import starts_from_counts
from spatial_replay.trace.trace import Trace


@dataclass(slots=True)
class Report:
    """One object as a line of a log reports it, unchecked; the defaults stand for what it does not say.

    Attributes:
        vertices: x, y, x, y … of all parts.
        vertex_counts: number of vertices of each part.
        radii: rounding radius of each part.
    """

    name: str
    class_name: str | None = None
    vertices: list[float] = field(default_factory=list)
    vertex_counts: list[int] = field(default_factory=list)
    radii: list[float] = field(default_factory=list)
    yaw: float = nan
    uncertainty: float = 0.0
    bottom: float = nan
    top: float = nan
    invalid: bool = False


class ReportColumns:
    """Samples as they come, and the trace of them when there are enough."""

    def __init__(self) -> None:
        self.times: list[int] = []
        self.places: list[str] = []
        self._reports: list[Report] = []
        self._counts: list[int] = []
        self._signals: list[dict[str, float]] = []

    def __len__(self) -> int:
        return len(self.times)

    def add(self, time_ns: int, place: str, reports: list[Report], signals: dict[str, float]) -> None:
        """Take one sample; `place` says where it stands in its file."""
        self.times.append(time_ns)
        self.places.append(place)
        self._reports += reports
        self._counts.append(len(reports))
        self._signals.append(signals)

    def trace(self, *, concave: Concave) -> tuple[Trace, list[str]]:
        """The samples that can be used, and what is wrong with the others, each with its place."""
        trace, faults = trace_from_observations(self._observations(), concave=concave)
        return trace, [f"{self.places[index]}: {what}" for index, what in sorted(faults.items())]

    def _observations(self) -> Observations:
        reports = self._reports
        names = {name: index for index, name in enumerate(dict.fromkeys(r.name for r in reports))}
        ordered = sorted({r.class_name for r in reports}, key=lambda c: (c is not None, c or ""))
        classes = {name: index for index, name in enumerate(ordered)}
        signals = sorted({name for values in self._signals for name in values})
        return Observations(
            times_ns=np.array(self.times, np.int64),
            sample=np.repeat(np.arange(len(self.times)), self._counts),
            name=np.array([names[r.name] for r in reports], np.int64),
            names=list(names),
            class_code=np.array([classes[r.class_name] for r in reports], np.int64),
            classes=tuple(ordered),
            yaw=np.array([r.yaw for r in reports], np.float64),
            uncertainty=np.array([r.uncertainty for r in reports], np.float64),
            shapes=_shapes(reports),
            invalid=np.array([r.invalid for r in reports], np.bool_),
            signals={
                name: np.array([values.get(name, nan) for values in self._signals], np.float64)
                for name in signals
            },
        )


def _shapes(reports: list[Report]) -> FootprintBatch:
    return FootprintBatch(
        part_start=starts_from_counts(np.array([len(r.radii) for r in reports], np.int64)),
        vertex_start=starts_from_counts(np.array([n for r in reports for n in r.vertex_counts], np.int64)),
        vertices=np.array([x for r in reports for x in r.vertices], np.float64).reshape(-1, 2),
        radius=np.array([x for r in reports for x in r.radii], np.float64),
        bottom=np.array([r.bottom for r in reports], np.float64),
        top=np.array([r.top for r in reports], np.float64),
    )
