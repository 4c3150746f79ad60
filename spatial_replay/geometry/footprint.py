"""Footprints: the areas that objects and regions cover in the plane, singly or as ragged rows.

The module also computes centres of footprints, and moves and turns footprints.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from struct import Struct
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Literal, NoReturn, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from spatial_replay.compiled import elementwise, kernel, long_kernel
from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import (
    Floats,
    Integers,
    flat_index,
    read_only_floats,
    read_only_integers,
    starts_from_counts,
)
from spatial_replay.geometry.kernels import weight_and_centre
from spatial_replay.geometry.outline import (
    MOST_CONVEX_CORNERS,
    NOT_CONVEX,
    SOUND,
    TOO_MANY_CORNERS,
    convex_hull,
    convex_pieces,
    normalise_polygon,
    normalise_polygons,
)
from spatial_replay.text import is_encodable, named_arguments

Concave: TypeAlias = Literal["decompose", "hull"]
"""Treatment of a non-convex polygon: split into convex parts, or replacement by its convex hull."""

_pack_part: Final = Struct("=2d").pack
_OF_VERTEX: Final = 16
"""Size of a packed vertex, and of the header (vertex count, radius) before the first vertex, bytes."""
_pack_object: Final = Struct("=5d").pack
PARTS, BOTTOM, TOP, YAW, UNCERTAINTY = range(5)
"""Indices of the numbers of a packed object; heights and yaw are NaN if missing."""
_PLAIN: Final = _pack_object(1.0, math.nan, math.nan, math.nan, 0.0)
"""Packed numbers of the most common objects: one part, no height, no yaw, no uncertainty."""


@dataclass(frozen=True, slots=True, eq=False, init=False)
class ConvexPart:
    """A rounded convex polygon: the Minkowski sum of a convex polygon and a disc.

    Two parts are equal if their radii and their rings of vertices are equal. Equal rings may start at
    different vertices.

    Attributes:
        vertices: (n, 2) float64, read-only, counter-clockwise, without repeated or collinear vertices. One
            vertex is a point (with a radius: a disc), two vertices are a segment (a capsule).
        radius: rounding radius in footprint units, at least 0.
        packed: number of vertices, radius, and x and y of each vertex, as bytes of doubles. A monitor copies
            the bytes to its kernel. `vertices` is a view of the bytes.

    Raises:
        GeometryError: there is no vertex, a coordinate is not finite, the vertices are not convex, or the
            radius is negative. Clockwise order, repeated and collinear vertices are corrected.
    """

    radius: float
    packed: bytes = field(repr=False)

    def __init__(self, vertices: ArrayLike, radius: float = 0.0) -> None:
        corners, is_convex = _tidy(vertices)
        if not is_convex:
            raise GeometryError(
                f"the vertices {_vertices_text(corners)} do not form a convex polygon in this order; "
                "Footprint.polygon takes any polygon"
            )
        radius = _finite(radius, "a part's radius")
        if radius < 0:
            raise GeometryError(f"a part's radius is {radius}; give 0 or more")
        _fill(self, corners.tobytes(), radius)

    @property
    def vertices(self) -> Floats:
        vertex_count = len(self.packed) // _OF_VERTEX - 1
        return np.ndarray((vertex_count, 2), np.float64, self.packed, _OF_VERTEX)

    def __repr__(self) -> str:
        radius = f", radius={self.radius:.6g}" if self.radius else ""
        return f"ConvexPart({_vertices_text(self.vertices)}{radius})"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ConvexPart):
            return NotImplemented
        return self.radius == other.radius and _ring(self.vertices) == _ring(other.vertices)

    def __hash__(self) -> int:
        return hash((self.radius, _ring(self.vertices)))


def _fill(part: ConvexPart, corners: bytes, radius: float) -> None:
    """Set the numbers of a part without checks."""
    object.__setattr__(part, "radius", radius)
    object.__setattr__(part, "packed", _pack_part(len(corners) // _OF_VERTEX, radius) + corners)


def _checked_part(corners: bytes, radius: float = 0.0) -> ConvexPart:
    part = object.__new__(ConvexPart)
    _fill(part, corners, radius)
    return part


def convex_parts(start: Integers, vertices: Floats, radius: Floats) -> list[ConvexPart]:
    """Return P parts, checked and corrected together.

    Args:
        start: (P + 1,), start of each part in `vertices`, then the end of the last part.
        vertices: (V, 2), in footprint units.
        radius: (P,), rounding radius of each part.

    Raises:
        GeometryError: a part is invalid; see `ConvexPart`.
    """
    outlines = normalise_polygons(start, vertices)
    if outlines.fault.any() or not (np.isfinite(radius) & (radius >= 0)).all():
        part_ranges = zip(pairwise(start.tolist()), radius.tolist(), strict=True)
        # parts are built one by one, so that the first faulty part raises its error
        return [ConvexPart(vertices[begin:end], rounding) for (begin, end), rounding in part_ranges]
    corners, byte_offsets = outlines.vertices.tobytes(), (_OF_VERTEX * outlines.vertex_start).tolist()
    return [
        _checked_part(corners[begin:end], rounding)
        for (begin, end), rounding in zip(pairwise(byte_offsets), radius.tolist(), strict=True)
    ]


_SHAPES: Final[Mapping[str, str]] = MappingProxyType(
    {"circle": "disc(x, y, radius)", **dict.fromkeys(("rectangle", "rect"), "box(xmin, ymin, xmax, ymax)")}
)
"""Constructors of footprints, by the shape's name in other libraries or in the specification language."""


class _FootprintType(type):
    # `__getattr__` is hidden from type checkers, because they would accept every attribute
    if not TYPE_CHECKING:

        def __getattr__(cls, name: str) -> NoReturn:
            hint = f"; write {cls.__name__}.{_SHAPES[name]}" if name in _SHAPES else ""
            raise AttributeError(f"type object {cls.__name__!r} has no attribute {name!r}{hint}")


@dataclass(frozen=True, slots=True, eq=False)
class Footprint(metaclass=_FootprintType):
    """A union of rounded convex parts. Two footprints are equal if their sets of parts are equal.

    Raises:
        GeometryError: no part.
    """

    parts: tuple[ConvexPart, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", tuple(self.parts))
        if not self.parts:
            raise GeometryError("a footprint without parts; leave out an object that covers nothing")

    def __repr__(self) -> str:
        return f"Footprint({', '.join(map(repr, self.parts))})"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Footprint):
            return NotImplemented
        return frozenset(self.parts) == frozenset(other.parts)

    def __hash__(self) -> int:
        return hash(frozenset(self.parts))

    @classmethod
    @named_arguments
    def box(cls, xmin: float, ymin: float, xmax: float, ymax: float) -> Footprint:
        """Return an axis-aligned box; a segment or a point if limits are equal.

        Raises:
            GeometryError: a coordinate is not finite, or a minimum is above its maximum.
        """
        if xmin > xmax or ymin > ymax:
            box_text = f"box({xmin}, {ymin}, {xmax}, {ymax}) has its least corner above its greatest"
            raise GeometryError(f"{box_text}; give xmin, ymin, xmax, ymax")
        return cls.polygon([(xmin, ymin), (xmax, ymin), (xmax, ymax), (xmin, ymax)])

    @classmethod
    @named_arguments
    def disc(cls, x: float, y: float, radius: float) -> Footprint:
        """Return the disc around (x, y), which is a point if the radius is 0.

        Raises:
            GeometryError: a value is not finite, or the radius is negative.
        """
        return cls((ConvexPart(np.array([(x, y)]), radius),))

    @classmethod
    @named_arguments
    def capsule(cls, start: ArrayLike, end: ArrayLike, radius: float) -> Footprint:
        """Return all points within `radius` of the segment between two points (x, y).

        Raises:
            GeometryError: a value is not finite, or the radius is negative.
        """
        return cls((ConvexPart(np.array([start, end]), radius),))

    @classmethod
    @named_arguments
    def polygon(cls, vertices: ArrayLike, *, concave: Concave = "decompose") -> Footprint:
        """Return the polygon with the given corners (n, 2), in either order.

        Raises:
            GeometryError: there is no corner, a coordinate is not finite, or a convex polygon has more than
                10,000 corners. Unless `concave="hull"`, also if the boundary crosses itself, or a polygon of
                more than 2,000 corners is not convex.
        """
        if concave not in ("decompose", "hull"):
            raise GeometryError(f"concave={concave!r}; choose 'decompose' or 'hull'")
        corners, is_convex = _tidy(vertices)
        if is_convex:
            return cls((_checked_part(corners.tobytes()),))
        if concave == "hull":
            return cls((ConvexPart(convex_hull(corners)),))
        pieces = [ConvexPart(piece) for piece in convex_pieces(corners)]
        # a piece narrower than the resolution of coordinates is now a segment, which neighbouring pieces
        # cover
        return cls(tuple(piece for piece in pieces if len(piece.vertices) > 2))

    @classmethod
    @named_arguments
    def union(cls, footprints: Iterable[Footprint]) -> Footprint:
        """Return the footprint with all parts of the given footprints.

        Raises:
            GeometryError: no footprint.
        """
        return cls(tuple(part for footprint in footprints for part in footprint.parts))


@named_arguments
@dataclass(frozen=True, slots=True)
class TrackedObject:
    """An object at one time: its footprint and other reported properties.

    Attributes:
        footprint: covered area.
        class_name: class, or None.
        yaw: orientation in radians, counter-clockwise from the x axis, or None.
        height: (bottom, top) in footprint units, or None.
        uncertainty: greatest distance of the true outline from the footprint's outline, footprint units.
        packed: number of parts, bottom, top, yaw and uncertainty as bytes of doubles, then each part's
            `packed`.

    Raises:
        GeometryError: a value is not finite, bottom is above top, or the uncertainty is negative.
    """

    footprint: Footprint
    class_name: str | None = None
    yaw: float | None = None
    height: tuple[float, float] | None = None
    uncertainty: float = 0.0
    packed: tuple[bytes, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not isinstance(self.footprint, Footprint):
            raise GeometryError(f"footprint is {self.footprint!r}; give a Footprint")
        if self.class_name is not None and not isinstance(self.class_name, str):
            raise GeometryError(f"class_name is {self.class_name!r}; give a text or None")
        if self.class_name is not None and not is_encodable(self.class_name):
            raise GeometryError(
                f"class_name is {self.class_name!r}, with half a character (a lone surrogate), which no log"
                ' can hold; decode it with errors="replace"'
            )
        if self.yaw is not None:
            object.__setattr__(self, "yaw", _finite(self.yaw, "yaw"))
        if self.height is not None:
            object.__setattr__(self, "height", _interval(self.height))
        object.__setattr__(self, "uncertainty", _finite(self.uncertainty, "uncertainty"))
        if self.uncertainty < 0:
            raise GeometryError(f"uncertainty is {self.uncertainty}; give 0 or more")
        object.__setattr__(self, "packed", self._pack())

    def _pack(self) -> tuple[bytes, ...]:
        parts, yaw, height = self.footprint.parts, self.yaw, self.height
        if len(parts) == 1 and yaw is None and height is None and self.uncertainty == 0.0:
            return _PLAIN, parts[0].packed
        bottom, top = (math.nan, math.nan) if height is None else height
        yaw = math.nan if yaw is None else yaw
        return _pack_object(len(parts), bottom, top, yaw, self.uncertainty), *[part.packed for part in parts]


def _tidy(vertices: ArrayLike) -> tuple[Floats, bool]:
    """Return normalised vertices, and whether they are convex.

    Raises:
        GeometryError: the vertices are not one or more finite points, or a convex polygon has too many
            vertices.
    """
    try:
        corners = np.array(vertices, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError) as error:
        raise GeometryError(f"vertices are {vertices!r}; give pairs of numbers (x, y)") from error
    if corners.ndim != 2 or corners.shape[1] != 2 or not len(corners):
        raise GeometryError(f"vertices have the shape {corners.shape}; give one or more pairs (x, y)")
    corners, fault = normalise_polygon(corners)
    if fault == TOO_MANY_CORNERS:
        limit_text = f"{MOST_CONVEX_CORNERS:,}"
        raise GeometryError(f"a polygon has {len(corners):,} corners; simplify it to at most {limit_text}")
    if fault not in (SOUND, NOT_CONVEX):
        raise GeometryError(f"vertices {_vertices_text(corners)} are not all finite numbers of at most 1e100")
    return corners, fault == SOUND


def _finite(value: float, noun: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise GeometryError(f"{noun} is {value!r}; give a number") from error
    if not math.isfinite(number):
        raise GeometryError(f"{noun} is {number}; give a finite number")
    return number


def _interval(height: tuple[float, float]) -> tuple[float, float]:
    try:
        bottom, top = height
    except (TypeError, ValueError) as error:
        raise GeometryError(f"height is {height!r}; give (bottom, top)") from error
    bottom, top = _finite(bottom, "height's bottom"), _finite(top, "height's top")
    if bottom > top:
        raise GeometryError(f"height is ({bottom}, {top}), its bottom above its top; give (bottom, top)")
    return bottom, top


def _vertices_text(vertices: Floats) -> str:
    corners = [f"({x:.6g}, {y:.6g})" for x, y in vertices[:8].tolist()]
    return ", ".join(corners + ["…"] * (len(vertices) > 8))


def _ring(vertices: Floats) -> tuple[tuple[float, float], ...]:
    """Return the vertices, starting at the least vertex, so that equal rings have one form."""
    corners = [(x, y) for x, y in vertices.tolist()]
    first_index = corners.index(min(corners))
    return tuple(corners[first_index:] + corners[:first_index])


# -------------------------------------------------------------------------------------------- many footprints


@dataclass(frozen=True, slots=True, eq=False)
class FootprintBatch:
    """R footprints made of P convex parts with V vertices in total, as ragged rows.

    Footprint r has the slice part_start[r] : part_start[r + 1] of parts. Part p has the slice
    vertex_start[p] : vertex_start[p + 1] of vertices. Vertices of a part are in counter-clockwise order,
    without repeated or collinear vertices. One vertex is a point or disc, two vertices are a segment or
    capsule. Raw outlines must pass `normalise_polygons` first.

    Attributes:
        part_start: (R + 1,) int64.
        vertex_start: (P + 1,) int64.
        vertices: (V, 2) float64, in footprint units.
        radius: (P,) float64, rounding radius of each part, at least 0.
        bottom, top: (R,) float64, height interval; NaN for footprints without a height.
        All arrays are contiguous and read-only.

    Raises:
        GeometryError: the lengths of the arrays do not fit together.
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
        row_count, part_count, vertex_count = (
            len(self.part_start) - 1,
            len(self.vertex_start) - 1,
            len(self.vertices),
        )
        expected_shapes = {
            "vertices": (vertex_count, 2),
            "radius": (part_count,),
            "bottom": (row_count,),
            "top": (row_count,),
        }
        for name, shape in expected_shapes.items():
            if getattr(self, name).shape != shape:
                actual = getattr(self, name).shape
                raise GeometryError(
                    f"{name} is {actual}; {row_count} rows of {part_count} parts need {shape}"
                )
        for name, end in (("part_start", part_count), ("vertex_start", vertex_count)):
            starts = getattr(self, name)
            if starts[0] != 0 or starts[-1] != end or (starts[1:] < starts[:-1]).any():
                raise GeometryError(f"{name} must rise from 0 to {end}; it is {starts}")

    @classmethod
    def without_checks(cls, **columns: Floats | Integers) -> FootprintBatch:
        """Build a batch of new, contiguous arrays that fit together.

        For a few rows, the checks take longer than building the batch.
        """
        batch = object.__new__(cls)
        for name, array in columns.items():
            array.flags.writeable = False
            object.__setattr__(batch, name, array)
        return batch

    def __len__(self) -> int:
        return len(self.part_start) - 1

    def slice(self, begin: int, end: int) -> FootprintBatch:
        """Return the rows from `begin` to before `end`, as views."""
        part_slice = slice(*self.part_start[[begin, end]].tolist())
        vertex_slice = slice(*self.vertex_start[[part_slice.start, part_slice.stop]].tolist())
        return FootprintBatch.without_checks(
            part_start=self.part_start[begin : end + 1] - part_slice.start,
            vertex_start=self.vertex_start[part_slice.start : part_slice.stop + 1] - vertex_slice.start,
            vertices=self.vertices[vertex_slice],
            radius=self.radius[part_slice],
            bottom=self.bottom[begin:end],
            top=self.top[begin:end],
        )

    @property
    def sizes(self) -> Floats:
        """Size of each footprint (R,): diagonal of its vertices' box plus twice the greatest radius."""
        first_vertices = self.vertex_start[self.part_start[:-1]]
        spans = [
            np.maximum.reduceat(x, first_vertices) - np.minimum.reduceat(x, first_vertices)
            for x in self.vertices.T
        ]
        sizes: Floats = np.hypot(*spans) + 2.0 * np.maximum.reduceat(self.radius, self.part_start[:-1])
        return sizes

    @property
    def nbytes(self) -> int:
        """The size of the batch's arrays in bytes."""
        numbers = (self.vertices, self.radius, self.bottom, self.top)
        return self.part_start.nbytes + self.vertex_start.nbytes + sum(array.nbytes for array in numbers)

    @classmethod
    def from_footprints(
        cls, footprints: Sequence[Footprint], heights: Sequence[tuple[float, float] | None] | None = None
    ) -> FootprintBatch:
        """Build one row per footprint, with its height interval (bottom, top) or None."""
        packed_parts = [part.packed for footprint in footprints for part in footprint.parts]
        # the pair before a part's vertices is the part's header: number of vertices, radius
        number_pairs = np.frombuffer(b"".join(packed_parts)).reshape(-1, 2)
        header_rows = starts_from_counts([len(part) for part in packed_parts]) // number_pairs.strides[0]
        intervals = [height or (np.nan, np.nan) for height in heights or [None] * len(footprints)]
        return cls(
            part_start=starts_from_counts([len(footprint.parts) for footprint in footprints]),
            vertex_start=header_rows - np.arange(len(header_rows)),
            vertices=np.delete(number_pairs, header_rows[:-1], axis=0),
            radius=number_pairs[header_rows[:-1], 1],
            bottom=np.array([bottom for bottom, _ in intervals], dtype=np.float64),
            top=np.array([top for _, top in intervals], dtype=np.float64),
        )

    @classmethod
    def unknown(cls, count: int) -> FootprintBatch:
        """Build rows of unknown footprints: one point at NaN each."""
        return cls.without_checks(
            part_start=np.arange(count + 1, dtype=np.int64),
            vertex_start=np.arange(count + 1, dtype=np.int64),
            vertices=np.full((count, 2), np.nan),
            radius=np.zeros(count),
            bottom=np.full(count, np.nan),
            top=np.full(count, np.nan),
        )

    @classmethod
    def concatenate(cls, batches: Sequence[FootprintBatch]) -> FootprintBatch:
        """Join the rows of several batches in order."""
        if len(batches) == 1:
            return batches[0]
        no_counts = np.empty(0, np.int64)
        part_counts = np.concatenate([no_counts, *(np.diff(batch.part_start) for batch in batches)])
        vertex_counts = np.concatenate([no_counts, *(np.diff(batch.vertex_start) for batch in batches)])
        return cls.without_checks(
            part_start=starts_from_counts(part_counts),
            vertex_start=starts_from_counts(vertex_counts),
            vertices=np.concatenate([np.empty((0, 2)), *(batch.vertices for batch in batches)]),
            radius=np.concatenate([np.empty(0), *(batch.radius for batch in batches)]),
            bottom=np.concatenate([np.empty(0), *(batch.bottom for batch in batches)]),
            top=np.concatenate([np.empty(0), *(batch.top for batch in batches)]),
        )

    def select(self, rows: Integers) -> FootprintBatch:
        """Return the given rows (K,), in the given order; a row may be repeated."""
        if len(rows) == len(self) and (rows == np.arange(len(self))).all():
            return self
        first_part = self.part_start[rows]
        part_counts = self.part_start[rows + 1] - first_part
        part_indices = flat_index(first_part, part_counts)
        first_vertex = self.vertex_start[part_indices]
        vertex_counts = self.vertex_start[part_indices + 1] - first_vertex
        return FootprintBatch.without_checks(
            part_start=starts_from_counts(part_counts),
            vertex_start=starts_from_counts(vertex_counts),
            vertices=self.vertices.take(flat_index(first_vertex, vertex_counts), axis=0),
            radius=self.radius[part_indices],
            bottom=self.bottom[rows],
            top=self.top[rows],
        )

    def footprint(self, row: int) -> Footprint:
        """Return the footprint of one row; see `footprints`."""
        (footprint,) = self.footprints([row])
        return footprint

    def footprints(self, rows: Sequence[int]) -> list[Footprint]:
        """Return the footprints of some rows.

        Raises:
            GeometryError: the vertices of a part do not form a convex polygon.
        """
        is_all = len(rows) == len(self) and list(rows) == list(range(len(self)))
        batch = self if is_all else self.select(np.array(rows, np.int64))
        parts = convex_parts(batch.vertex_start, batch.vertices, batch.radius)
        return [Footprint(tuple(parts[begin:end])) for begin, end in pairwise(batch.part_start.tolist())]

    def height(self, row: int) -> tuple[float, float] | None:
        """Return the height interval (bottom, top) of one row; None without a height."""
        bottom = float(self.bottom[row])
        return None if math.isnan(bottom) else (bottom, float(self.top[row]))


# ------------------------------------------------------------------------------------------------------ poses


def centre_of(footprint: Footprint) -> tuple[float, float]:
    """Return the centre (x, y) of a footprint: the mean of its parts' centroids, weighted by area.

    The centroid of a part is the centroid of its unrounded polygon, or the mean of its vertices for a polygon
    without area. Overlapping areas count twice.
    """
    ((x, y),) = centres_of(FootprintBatch.from_footprints([footprint])).vertices.tolist()
    return x, y


def centre_object(tracked: TrackedObject) -> TrackedObject:
    """Return an object shrunk to the point at its centre, halfway up."""
    point = centres_of(FootprintBatch.from_footprints([tracked.footprint], [tracked.height]))
    x, y = point.vertices[0]
    return replace(tracked, footprint=Footprint.disc(x, y, 0.0), height=point.height(0))


def packed_centre(tracked: TrackedObject) -> tuple[bytes, bytes]:
    """Return `centre_object(tracked).packed` in a fiftieth of the time, for control loops."""
    # rows are headers (number of vertices, radius) and vertices in turn; a bytearray, because kernels need
    # writable arrays
    number_pairs, centre = np.frombuffer(bytearray(b"".join(tracked.packed[1:]))).reshape(-1, 2), np.empty(2)
    _fill_packed_centre(number_pairs, centre)
    bottom, top = tracked.height or (math.nan, math.nan)
    middle = bottom + 0.5 * (top - bottom)
    yaw = math.nan if tracked.yaw is None else tracked.yaw
    point = _pack_part(1, 0.0) + centre.tobytes()
    return _pack_object(1, middle, middle, yaw, tracked.uncertainty), point


@elementwise
@kernel
def _fill_packed_centre(number_pairs: Floats, centre: Floats) -> None:
    """Fill `centre` (2,) from packed parts, with the same steps as `_fill_centres`."""
    total_area = sum_x = sum_y = mean_x = mean_y = 0.0
    header, part_count = 0, 0
    while header < len(number_pairs):
        end = header + 1 + int(number_pairs[header, 0])
        area, x, y = weight_and_centre(number_pairs, header + 1, end, number_pairs[header, 1])
        total_area, sum_x, sum_y = total_area + area, sum_x + area * x, sum_y + area * y
        mean_x, mean_y = mean_x + x, mean_y + y
        header, part_count = end, part_count + 1
    # points and segments have no area, so all parts count equally
    if total_area <= 0.0:
        total_area, sum_x, sum_y = float(part_count), mean_x, mean_y
    centre[0], centre[1] = sum_x / total_area, sum_y / total_area


def centres_of(batch: FootprintBatch) -> FootprintBatch:
    """Return each row's centre (see `centre_of`) as a point, halfway up."""
    centres, points = np.empty((len(batch), 2)), np.arange(len(batch) + 1, dtype=np.int64)
    _fill_centres(batch.part_start, batch.vertex_start, batch.vertices, batch.radius, centres)
    middle = batch.bottom + 0.5 * (batch.top - batch.bottom)
    return FootprintBatch(points, points, centres, np.zeros(len(batch)), middle, middle)


@elementwise
@long_kernel
def _fill_centres(
    part_start: Integers, vertex_start: Integers, vertices: Floats, radius: Floats, centres: Floats
) -> None:
    """Fill `centres` (R, 2)."""
    for row in range(len(part_start) - 1):
        total_area = sum_x = sum_y = mean_x = mean_y = 0.0
        for part in range(part_start[row], part_start[row + 1]):
            area, x, y = weight_and_centre(vertices, vertex_start[part], vertex_start[part + 1], radius[part])
            total_area, sum_x, sum_y = total_area + area, sum_x + area * x, sum_y + area * y
            mean_x, mean_y = mean_x + x, mean_y + y
        # points and segments have no area, so all parts count equally
        if total_area <= 0.0:
            total_area, sum_x, sum_y = part_start[row + 1] - part_start[row], mean_x, mean_y
        centres[row, 0], centres[row, 1] = sum_x / total_area, sum_y / total_area


def radius_of(tracked: TrackedObject) -> float:
    """Return the distance from an object's centre to its farthest point."""
    centre = np.array(centre_of(tracked.footprint))
    return max(
        float(np.hypot(*(part.vertices - centre).T).max()) + part.radius for part in tracked.footprint.parts
    )


def shift_rows(batch: FootprintBatch, shifts: Floats) -> FootprintBatch:
    """Return a batch with each row moved in the plane by its shift (R, 2)."""
    counts = np.diff(batch.vertex_start[batch.part_start])
    return replace(batch, vertices=batch.vertices + np.repeat(shifts, counts, axis=0))


def moved_object(tracked: TrackedObject, x: float, y: float, turn: float = 0.0) -> TrackedObject:
    """Return the object turned by an angle in radians and moved to the centre (x, y), at the same height."""
    (moved,) = moved_copies(tracked, np.array([[x, y]]), turn)
    return moved


def moved_copies(tracked: TrackedObject, places: Floats, turn: float = 0.0) -> list[TrackedObject]:
    """Return copies of an object, turned by an angle in radians, with centres at `places` (M, 2)."""
    batch = with_poses(FootprintBatch.unknown(0), tracked, places, np.array([turn]))
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return [
        replace(tracked, footprint=footprint, yaw=yaw) for footprint in batch.footprints(range(len(places)))
    ]


def with_poses(
    batch: FootprintBatch, tracked: TrackedObject, positions: Floats, turns: Floats
) -> FootprintBatch:
    """Return a batch with A * M more rows: an object at each angle (A,), radians, and position (M, 2)."""
    parts = tracked.footprint.parts
    centre = np.array(centre_of(tracked.footprint))
    row_count = len(positions) * len(turns)
    outlines = [part.vertices for part in parts]
    corners = np.concatenate(outlines)
    vertex_counts = np.array([len(outline) for outline in outlines], np.int64)
    bottom, top = tracked.height or (math.nan, math.nan)
    part_start = batch.part_start[-1] + np.arange(row_count + 1, dtype=np.int64) * len(vertex_counts)
    vertex_start = batch.vertex_start[-1] + starts_from_counts(np.tile(vertex_counts, row_count))
    # one array for old and new vertices avoids copying the vertices of many cells twice
    vertices = np.empty((len(batch.vertices) + row_count * len(corners), 2))
    vertices[: len(batch.vertices)] = batch.vertices
    new_vertices = vertices[len(batch.vertices) :].reshape(len(turns), len(positions), len(corners), 2)
    # complex numbers add x and y in one operation, which runs over all positions
    complex_positions = np.ascontiguousarray(positions, np.float64).view(np.complex128)[..., 0]
    complex_vertices = new_vertices.view(np.complex128)[..., 0]
    corner_x, corner_y = (corners - centre).T
    for turn_index, turn in enumerate(turns.tolist()):
        cosine, sine = (math.cos(turn), math.sin(turn)) if turn else (1.0, 0.0)
        turned_corners = zip(
            (corner_x * cosine - corner_y * sine).tolist(),
            (corner_x * sine + corner_y * cosine).tolist(),
            strict=True,
        )
        for corner_index, corner_xy in enumerate(turned_corners):
            np.add(complex_positions, complex(*corner_xy), out=complex_vertices[turn_index, :, corner_index])
    return FootprintBatch.without_checks(
        part_start=np.concatenate((batch.part_start[:-1], part_start)),
        vertex_start=np.concatenate((batch.vertex_start[:-1], vertex_start)),
        vertices=vertices,
        radius=np.concatenate((batch.radius, np.tile([part.radius for part in parts], row_count))),
        bottom=np.concatenate((batch.bottom, np.full(row_count, bottom))),
        top=np.concatenate((batch.top, np.full(row_count, top))),
    )
