"""Many footprints in flat arrays, as logs provide and kernels read them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import (
    Floats,
    Integers,
    counts_from_starts,
    flat_index,
    read_only_floats,
    read_only_integers,
    starts_from_counts,
)
from spatial_replay.geometry.footprint import Footprint, convex_parts


@dataclass(frozen=True, slots=True, eq=False)
class FootprintBatch:
    """R footprints made of P convex parts with V vertices in total, as ragged rows.

    Footprint r has the parts part_start[r] up to part_start[r + 1]; part p has the vertices
    vertex_start[p] up to vertex_start[p + 1]. Vertices of a part are in counter-clockwise order, without
    repeated or collinear ones (one vertex: a point or disc, two: a segment or capsule); raw outlines go
    through `normalise_polygons` first.

    Attributes:
        part_start: (R + 1,) int64.
        vertex_start: (P + 1,) int64.
        vertices: (V, 2) float64, in footprint units.
        radius: (P,) float64, rounding radius of each part, at least 0.
        bottom, top: (R,) float64, height interval; NaN where a footprint has none.
        All are contiguous and read-only.

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
        expected = {"vertices": (vertices, 2), "radius": (parts,), "bottom": (rows,), "top": (rows,)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                actual = getattr(self, name).shape
                raise GeometryError(f"{name} is {actual}; {rows} rows of {parts} parts need {shape}")
        for name, last in (("part_start", parts), ("vertex_start", vertices)):
            start = getattr(self, name)
            if start[0] != 0 or start[-1] != last or (start[1:] < start[:-1]).any():
                raise GeometryError(f"{name} must rise from 0 to {last}; it is {start}")

    @classmethod
    def trusted(cls, **columns: Floats | Integers) -> FootprintBatch:
        """Build rows of new, contiguous arrays that are known to fit together.

        For a few rows, checking takes longer than making them.
        """
        batch = object.__new__(cls)
        for name, array in columns.items():
            array.flags.writeable = False
            object.__setattr__(batch, name, array)
        return batch

    def __len__(self) -> int:
        return len(self.part_start) - 1

    @property
    def nbytes(self) -> int:
        """The size of its arrays in bytes."""
        numbers = (self.vertices, self.radius, self.bottom, self.top)
        return self.part_start.nbytes + self.vertex_start.nbytes + sum(array.nbytes for array in numbers)

    @classmethod
    def from_footprints(
        cls, footprints: Sequence[Footprint], heights: Sequence[tuple[float, float] | None] | None = None
    ) -> FootprintBatch:
        """Build one row per footprint, with its height interval (bottom, top) if it has one."""
        packed = [part.packed for footprint in footprints for part in footprint.parts]
        # a part's number of vertices and radius lie before its vertices
        numbers = np.frombuffer(b"".join(packed)).reshape(-1, 2)
        heads = starts_from_counts([len(each) for each in packed]) // numbers.strides[0]
        intervals = [height or (np.nan, np.nan) for height in heights or [None] * len(footprints)]
        return cls(
            part_start=starts_from_counts([len(footprint.parts) for footprint in footprints]),
            vertex_start=heads - np.arange(len(heads)),
            vertices=np.delete(numbers, heads[:-1], axis=0),
            radius=numbers[heads[:-1], 1],
            bottom=np.array([bottom for bottom, _ in intervals], dtype=np.float64),
            top=np.array([top for _, top in intervals], dtype=np.float64),
        )

    @classmethod
    def unknown(cls, count: int) -> FootprintBatch:
        """Build rows of which nothing is known: one point each, at NaN."""
        return cls.trusted(
            part_start=np.arange(count + 1, dtype=np.int64),
            vertex_start=np.arange(count + 1, dtype=np.int64),
            vertices=np.full((count, 2), np.nan),
            radius=np.zeros(count),
            bottom=np.full(count, np.nan),
            top=np.full(count, np.nan),
        )

    @classmethod
    def concatenate(cls, batches: Sequence[FootprintBatch]) -> FootprintBatch:
        """Join the rows of several batches, one after the other."""
        if len(batches) == 1:
            return batches[0]
        none = np.empty(0, np.int64)
        part_counts = np.concatenate([none, *(counts_from_starts(batch.part_start) for batch in batches)])
        vertex_counts = np.concatenate([none, *(counts_from_starts(batch.vertex_start) for batch in batches)])
        return cls.trusted(
            part_start=starts_from_counts(part_counts),
            vertex_start=starts_from_counts(vertex_counts),
            vertices=np.concatenate([np.empty((0, 2)), *(batch.vertices for batch in batches)]),
            radius=np.concatenate([np.empty(0), *(batch.radius for batch in batches)]),
            bottom=np.concatenate([np.empty(0), *(batch.bottom for batch in batches)]),
            top=np.concatenate([np.empty(0), *(batch.top for batch in batches)]),
        )

    def select(self, rows: Integers) -> FootprintBatch:
        """Return the given rows (K,), in the order given; a row may be repeated."""
        if len(rows) == len(self) and (rows == np.arange(len(self))).all():
            return self
        first_part = self.part_start[rows]
        part_counts = self.part_start[rows + 1] - first_part
        parts = flat_index(first_part, part_counts)
        first_vertex = self.vertex_start[parts]
        vertex_counts = self.vertex_start[parts + 1] - first_vertex
        return FootprintBatch.trusted(
            part_start=starts_from_counts(part_counts),
            vertex_start=starts_from_counts(vertex_counts),
            vertices=self.vertices.take(flat_index(first_vertex, vertex_counts), axis=0),
            radius=self.radius[parts],
            bottom=self.bottom[rows],
            top=self.top[rows],
        )

    def with_outlines(self, vertex_start: Integers, vertices: Floats) -> FootprintBatch:
        """Return the same parts with other vertices, of as many parts: new arrays."""
        return FootprintBatch.trusted(
            part_start=self.part_start,
            vertex_start=vertex_start,
            vertices=vertices,
            radius=self.radius,
            bottom=self.bottom,
            top=self.top,
        )

    def footprint(self, row: int) -> Footprint:
        """Return the footprint of one row; see `footprints`."""
        (footprint,) = self.footprints([row])
        return footprint

    def footprints(self, rows: Sequence[int]) -> list[Footprint]:
        """Return the footprints of some rows.

        Raises:
            GeometryError: coordinates that are not those of convex parts.
        """
        is_all = len(rows) == len(self) and list(rows) == list(range(len(self)))
        chosen = self if is_all else self.select(np.array(rows, np.int64))
        parts = convex_parts(chosen.vertex_start, chosen.vertices, chosen.radius)
        return [Footprint(tuple(parts[begin:end])) for begin, end in pairwise(chosen.part_start.tolist())]

    def height(self, row: int) -> tuple[float, float] | None:
        """Return the height interval (bottom, top) of one row, or None."""
        bottom = float(self.bottom[row])
        return None if math.isnan(bottom) else (bottom, float(self.top[row]))
