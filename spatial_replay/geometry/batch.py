"""Many footprints in flat arrays: what the kernels read and what a log fills."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import Floats as Floats
from spatial_replay.geometry.arrays import Integers as Integers
from spatial_replay.geometry.arrays import read_only_floats, read_only_integers
from spatial_replay.geometry.footprint import ConvexPart, Footprint


@dataclass(frozen=True, slots=True, eq=False)
class FootprintBatch:
    """R footprints made of P convex parts with V vertices in all, as ragged rows.

    Footprint r has the parts part_start[r] up to part_start[r + 1]; part p has the vertices
    vertex_start[p] up to vertex_start[p + 1]. Vertices of a part are in counter-clockwise order, without
    repeated or collinear ones (one vertex: a point or disc, two: a segment or capsule); for raw ones
    there is `normalise_polygons`.

    Attributes:
        part_start: (R + 1,) int64.
        vertex_start: (P + 1,) int64.
        vertices: (V, 2) float64, in footprint units.
        radius: (P,) float64, rounding radius of each part, at least 0.
        bottom, top: (R,) float64, height interval; NaN where a footprint has none.
        All of them contiguous and read-only.

    Raises:
        GeometryError: arrays whose lengths do not fit together.
    """

    part_start: Integers
    vertex_start: Integers
    vertices: Floats
    radius: Floats
    bottom: Floats
    top: Floats

    def __post_init__(self) -> None:
        for name in ("part_start", "vertex_start"):
            object.__setattr__(self, name, read_only_integers(getattr(self, name)))
        for name in ("vertices", "radius", "bottom", "top"):
            object.__setattr__(self, name, read_only_floats(getattr(self, name)))
        rows, parts, vertices = len(self.part_start) - 1, len(self.vertex_start) - 1, len(self.vertices)
        expected = {
            "vertices": (vertices, 2),
            "radius": (parts,),
            "bottom": (rows,),
            "top": (rows,),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                actual = getattr(self, name).shape
                raise GeometryError(f"{name} is {actual}; {rows} rows of {parts} parts need {shape}")
        for name, last in (("part_start", parts), ("vertex_start", vertices)):
            start = getattr(self, name)
            if start[0] != 0 or start[-1] != last or np.any(np.diff(start) < 0):
                raise GeometryError(f"{name} must rise from 0 to {last}; it is {start}")

    def __len__(self) -> int:
        return len(self.part_start) - 1

    @classmethod
    def from_footprints(
        cls,
        footprints: Sequence[Footprint],
        heights: Sequence[tuple[float, float] | None] | None = None,
    ) -> FootprintBatch:
        """One row for each footprint, with its height interval (bottom, top) where it has one."""
        parts = [part for footprint in footprints for part in footprint.parts]
        intervals = [height or (np.nan, np.nan) for height in heights or [None] * len(footprints)]
        return cls(
            part_start=_starts([len(footprint.parts) for footprint in footprints]),
            vertex_start=_starts([len(part.vertices) for part in parts]),
            vertices=np.concatenate([np.empty((0, 2)), *(part.vertices for part in parts)]),
            radius=np.array([part.radius for part in parts], dtype=np.float64),
            bottom=np.array([bottom for bottom, _ in intervals], dtype=np.float64),
            top=np.array([top for _, top in intervals], dtype=np.float64),
        )

    @classmethod
    def concatenate(cls, batches: Sequence[FootprintBatch]) -> FootprintBatch:
        """The rows of several batches, one after the other."""
        return cls(
            part_start=_starts(np.concatenate([_NONE, *(np.diff(b.part_start) for b in batches)])),
            vertex_start=_starts(np.concatenate([_NONE, *(np.diff(b.vertex_start) for b in batches)])),
            vertices=np.concatenate([np.empty((0, 2)), *(batch.vertices for batch in batches)]),
            radius=np.concatenate([np.empty(0), *(batch.radius for batch in batches)]),
            bottom=np.concatenate([np.empty(0), *(batch.bottom for batch in batches)]),
            top=np.concatenate([np.empty(0), *(batch.top for batch in batches)]),
        )

    def select(self, rows: Integers) -> FootprintBatch:
        """The given rows (K,), in the order given; a row may be given more than once."""
        parts, part_start = _gather(self.part_start, np.asarray(rows, dtype=np.int64))
        vertices, vertex_start = _gather(self.vertex_start, parts)
        return FootprintBatch(
            part_start=part_start,
            vertex_start=vertex_start,
            vertices=self.vertices[vertices],
            radius=self.radius[parts],
            bottom=self.bottom[rows],
            top=self.top[rows],
        )

    def footprint(self, row: int) -> Footprint:
        """The footprint of one row, as a value of its own.

        Raises:
            GeometryError: if the row's coordinates make no convex parts.
        """
        parts = []
        for part in range(self.part_start[row], self.part_start[row + 1]):
            corners = self.vertices[self.vertex_start[part] : self.vertex_start[part + 1]]
            parts.append(ConvexPart(corners, float(self.radius[part])))
        return Footprint(tuple(parts))

    def height(self, row: int) -> tuple[float, float] | None:
        """The height interval (bottom, top) of one row, or None."""
        if np.isnan(self.bottom[row]):
            return None
        return float(self.bottom[row]), float(self.top[row])


_NONE = np.empty(0, dtype=np.int64)


def _starts(counts: Sequence[int] | Integers) -> Integers:
    """(N + 1,) offsets of N ragged rows of the given lengths."""
    starts = np.zeros(len(counts) + 1, dtype=np.int64)
    np.cumsum(counts, out=starts[1:])
    return starts


def _gather(starts: Integers, rows: Integers) -> tuple[Integers, Integers]:
    """Indices of everything in the chosen ragged rows, and the offsets of those rows among them."""
    counts = starts[rows + 1] - starts[rows]
    chosen = _starts(counts)
    return np.repeat(starts[rows] - chosen[:-1], counts) + np.arange(chosen[-1]), chosen
