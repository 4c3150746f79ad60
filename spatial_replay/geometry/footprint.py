"""Footprints: the shapes that objects and regions cover in the plane."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from struct import Struct
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import Floats, Integers
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
from spatial_replay.text import is_encodable

Concave: TypeAlias = Literal["decompose", "hull"]
"""How a non-convex polygon is treated: split into convex parts, or replaced by its convex hull."""

_pack_part: Final = Struct("=2d").pack
_OF_VERTEX: Final = 16
"""Bytes of a vertex, and of what comes before the first."""
_pack_object: Final = Struct("=5d").pack
PARTS, BOTTOM, TOP, YAW, UNCERTAINTY = range(5)
"""The numbers of a packed object: how many parts it has, NaN for a height or a yaw that it does not have."""
_PLAIN: Final = _pack_object(1.0, math.nan, math.nan, math.nan, 0.0)
"""What most objects are packed as: they share it."""


@dataclass(frozen=True, slots=True, eq=False, init=False)
class ConvexPart:
    """A rounded convex polygon: the Minkowski sum of its hull with a disc.

    Two parts are equal when their radii and their rings of vertices are, wherever the rings start.

    Attributes:
        vertices: (n, 2) float64, read-only, counter-clockwise, no repeated or collinear ones; one
            vertex is a point (with a radius: a disc), two are a segment (a capsule).
        radius: rounding radius in footprint units, at least 0.
        packed: how many vertices there are, the radius, x and y of each vertex, as bytes of doubles: what a
            monitor gives to its kernel. The vertices are a view of it, made when asked for.

    Raises:
        GeometryError: no vertex, coordinates that are not finite, vertices that are not convex, a
            negative radius. Clockwise order, repeated and collinear vertices are accepted and corrected.
    """

    radius: float
    packed: bytes = field(repr=False)

    def __init__(self, vertices: ArrayLike, radius: float = 0.0) -> None:
        corners, is_convex = _tidy(vertices)
        if not is_convex:
            raise GeometryError(
                f"the vertices {_shown(corners)} are not those of a convex polygon in order; "
                "Footprint.polygon takes any polygon"
            )
        radius = _finite(radius, "a part's radius")
        if radius < 0:
            raise GeometryError(f"a part's radius is {radius}; give 0 or more")
        _fill(self, corners.tobytes(), radius)

    @property
    def vertices(self) -> Floats:
        count = len(self.packed) // _OF_VERTEX - 1
        return np.ndarray((count, 2), np.float64, self.packed, _OF_VERTEX)

    def __repr__(self) -> str:
        radius = f", radius={self.radius:.6g}" if self.radius else ""
        return f"ConvexPart({_shown(self.vertices)}{radius})"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ConvexPart):
            return NotImplemented
        return self.radius == other.radius and _ring(self.vertices) == _ring(other.vertices)

    def __hash__(self) -> int:
        return hash((self.radius, _ring(self.vertices)))


def _fill(part: ConvexPart, corners: bytes, radius: float) -> None:
    """Give a part its numbers, which are checked already."""
    object.__setattr__(part, "radius", radius)
    object.__setattr__(part, "packed", _pack_part(len(corners) // _OF_VERTEX, radius) + corners)


def _checked_part(corners: bytes, radius: float = 0.0) -> ConvexPart:
    part = object.__new__(ConvexPart)
    _fill(part, corners, radius)
    return part


def convex_parts(start: Integers, vertices: Floats, radius: Floats) -> list[ConvexPart]:
    """Return P parts, checked and corrected all at once.

    Args:
        start: (P + 1,) where the vertices of each begin and end.
        vertices: (V, 2), radius: (P,).

    Raises:
        GeometryError: as `ConvexPart`.
    """
    outlines = normalise_polygons(start, vertices)
    if outlines.fault.any() or not (np.isfinite(radius) & (radius >= 0)).all():
        each = zip(pairwise(start.tolist()), radius.tolist(), strict=True)
        return [ConvexPart(vertices[begin:end], rounding) for (begin, end), rounding in each]
    corners, ends = outlines.vertices.tobytes(), (_OF_VERTEX * outlines.vertex_start).tolist()
    return [
        _checked_part(corners[begin:end], rounding)
        for (begin, end), rounding in zip(pairwise(ends), radius.tolist(), strict=True)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """A union of rounded convex parts; equal when the sets of parts are.

    Raises:
        GeometryError: no part.
    """

    parts: tuple[ConvexPart, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", tuple(self.parts))
        if not self.parts:
            raise GeometryError("a footprint without parts; leave an object that covers nothing out instead")

    def __repr__(self) -> str:
        return f"Footprint({', '.join(map(repr, self.parts))})"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Footprint):
            return NotImplemented
        return frozenset(self.parts) == frozenset(other.parts)

    def __hash__(self) -> int:
        return hash(frozenset(self.parts))

    @classmethod
    def box(cls, xmin: float, ymin: float, xmax: float, ymax: float) -> Footprint:
        """Return an axis-aligned box; equal limits make a segment or a point.

        Raises:
            GeometryError: coordinates that are not finite, a minimum above its maximum.
        """
        if xmin > xmax or ymin > ymax:
            what = f"box({xmin}, {ymin}, {xmax}, {ymax}) has its least corner above its greatest"
            raise GeometryError(f"{what}; give xmin, ymin, xmax, ymax")
        return cls.polygon([(xmin, ymin), (xmax, ymin), (xmax, ymax), (xmin, ymax)])

    @classmethod
    def disc(cls, x: float, y: float, radius: float) -> Footprint:
        """Return the disc around (x, y); with radius 0, a point.

        Raises:
            GeometryError: a value that is not finite, a negative radius.
        """
        return cls((ConvexPart(np.array([(x, y)]), radius),))

    @classmethod
    def capsule(cls, start: ArrayLike, end: ArrayLike, radius: float) -> Footprint:
        """Return all points within `radius` of the segment between two points (x, y).

        Raises:
            GeometryError: a value that is not finite, a negative radius.
        """
        return cls((ConvexPart(np.array([start, end]), radius),))

    @classmethod
    def polygon(cls, vertices: ArrayLike, *, concave: Concave = "decompose") -> Footprint:
        """Return the polygon with the given corners (n, 2), in either order.

        Raises:
            GeometryError: no corner, coordinates that are not finite; unless `concave="hull"`, a boundary
                that crosses itself, or more than 2,000 corners that are not those of a convex polygon.
        """
        if concave not in ("decompose", "hull"):
            raise GeometryError(f"concave={concave!r}; choose 'decompose' or 'hull'")
        corners, is_convex = _tidy(vertices)
        if is_convex:
            return cls((_checked_part(corners.tobytes()),))
        if concave == "hull":
            return cls((ConvexPart(convex_hull(corners)),))
        pieces = [ConvexPart(piece) for piece in convex_pieces(corners)]
        # a piece thinner than coordinates resolve covers nothing beyond its neighbours
        return cls(tuple(piece for piece in pieces if len(piece.vertices) > 2))

    @classmethod
    def union(cls, footprints: Iterable[Footprint]) -> Footprint:
        """Join all parts of some footprints.

        Raises:
            GeometryError: no footprint.
        """
        return cls(tuple(part for footprint in footprints for part in footprint.parts))


@dataclass(frozen=True, slots=True)
class TrackedObject:
    """An object at one time: its footprint and what else a log reports of it.

    Attributes:
        footprint: the area it covers.
        class_name: its class, or None.
        yaw: its orientation in radians, counter-clockwise from the x axis, or None.
        height: (bottom, top) in footprint units, or None.
        uncertainty: how far its true outline may differ, as a radius in footprint units.
        packed: its other numbers as `ConvexPart.packed`, then that of each part.

    Raises:
        GeometryError: a value that is not finite, bottom above top, a negative uncertainty.
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
        object.__setattr__(self, "packed", self._packed())

    def _packed(self) -> tuple[bytes, ...]:
        parts, yaw, height = self.footprint.parts, self.yaw, self.height
        if len(parts) == 1 and yaw is None and height is None and self.uncertainty == 0.0:
            return _PLAIN, parts[0].packed
        bottom, top = (math.nan, math.nan) if height is None else height
        yaw = math.nan if yaw is None else yaw
        return _pack_object(len(parts), bottom, top, yaw, self.uncertainty), *[part.packed for part in parts]


def _tidy(vertices: ArrayLike) -> tuple[Floats, bool]:
    """Return normalised vertices, and whether they are convex.

    Raises:
        GeometryError: anything but one or more finite points.
    """
    try:
        corners = np.array(vertices, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError) as error:
        raise GeometryError(f"vertices are {vertices!r}; give pairs of numbers (x, y)") from error
    if corners.ndim != 2 or corners.shape[1] != 2 or not len(corners):
        raise GeometryError(f"vertices have the shape {corners.shape}; give one or more pairs (x, y)")
    corners, fault = normalise_polygon(corners)
    if fault == TOO_MANY_CORNERS:
        most = f"{MOST_CONVEX_CORNERS:,}"
        raise GeometryError(f"a polygon has {len(corners):,} corners; simplify it to at most {most}")
    if fault not in (SOUND, NOT_CONVEX):
        raise GeometryError(f"vertices {_shown(corners)} are not all finite numbers of at most 1e100")
    return corners, fault == SOUND


def _finite(value: float, what: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise GeometryError(f"{what} is {value!r}; give a number") from error
    if not math.isfinite(number):
        raise GeometryError(f"{what} is {number}; give a finite number")
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


def _shown(vertices: Floats) -> str:
    corners = [f"({x:.6g}, {y:.6g})" for x, y in vertices[:8].tolist()]
    return ", ".join(corners + ["…"] * (len(vertices) > 8))


def _ring(vertices: Floats) -> tuple[tuple[float, float], ...]:
    """Return the vertices from the least on, a form that equal rings share."""
    corners = [(x, y) for x, y in vertices.tolist()]
    first = corners.index(min(corners))
    return tuple(corners[first:] + corners[:first])
