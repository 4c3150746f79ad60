"""Where two footprints are nearest to each other, deepest in each other, or stick out of each other.

For one pair at one time, to be shown to people: what is measured over many samples is in `measure`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import shapely

from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import ConvexPart, Footprint

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Contact:
    """A point of each of two footprints.

    Attributes:
        first, second: of footprints that are apart, the points nearest to each other; of overlapping ones,
            the ends of the shortest push that would part them.
        distance: signed, negative where they overlap; its absolute value is the distance of the points.
    """

    first: Point
    second: Point
    distance: float


def contact(a: Footprint, b: Footprint) -> Contact:
    """Where the signed distance of two footprints is attained (Def. 2-4)."""
    return min((_contact_of_parts(*pair) for pair in product(a.parts, b.parts)), key=_distance)


def protrusion_contact(inner: Footprint, outer: Footprint) -> Contact:
    """The point of `inner` farthest out of `outer`, or least deep in it, and the nearest on its boundary.

    Its distance is the protrusion: positive where `inner` sticks out (Prop. 2).
    """
    return max(
        (min((_sticking_out(part, other) for other in outer.parts), key=_distance) for part in inner.parts),
        key=_distance,
    )


def enlarged(footprint: Footprint, radius: float) -> Footprint:
    """The Minkowski sum of a footprint with a disc of a radius of at least 0."""
    return Footprint(tuple(ConvexPart(part.vertices, part.radius + radius) for part in footprint.parts))


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """From a point of one polygon to one of another.

    Attributes:
        direction: unit vector in which the second polygon lies, also where the points coincide.
        distance: signed, along the direction.
    """

    start: Floats
    direction: Floats
    distance: float

    def rounded(self, first_radius: float, second_radius: float) -> Contact:
        """The same between polygons with rounded corners and edges."""
        first = self.start + self.direction * first_radius
        second = self.start + self.direction * (self.distance - second_radius)
        return Contact(_point(first), _point(second), self.distance - first_radius - second_radius)


def _distance(found: Contact | _Line) -> float:
    return found.distance


def _point(values: Floats) -> Point:
    return float(values[0]), float(values[1])


def _contact_of_parts(a: ConvexPart, b: ConvexPart) -> Contact:
    return _line(a.vertices, b.vertices).rounded(a.radius, b.radius)


def _sticking_out(inner: ConvexPart, outer: ConvexPart) -> Contact:
    """The vertex of `inner` farthest out; rounding takes it further."""
    farthest = max((_line(vertex[None, :], outer.vertices) for vertex in inner.vertices), key=_distance)
    return farthest.rounded(-inner.radius, outer.radius)


def _line(a: Floats, b: Floats) -> _Line:
    """Where the signed distance of two convex polygons, segments or points is attained."""
    first, second = shapely.get_coordinates(shapely.shortest_line(_geometry(a), _geometry(b)))
    distance = float(np.hypot(*(second - first)))
    if distance > 0.0:
        return _Line(first, (second - first) / distance, distance)
    return max([*_pushes(a, b), *map(_turned, _pushes(b, a))], key=_distance, default=_touching(first))


def _touching(point: Floats) -> _Line:
    """Two points in one place have no direction of their own."""
    return _Line(point, np.array([1.0, 0.0]), 0.0)


def _pushes(a: Floats, b: Floats) -> Iterator[_Line]:
    """For each direction in which an edge of A could push B out of A: how far, and where."""
    if len(a) < 2:
        return
    for corner, following in zip(a, np.roll(a, -1, axis=0), strict=True):
        length = float(np.hypot(*(following - corner)))
        along = (following - corner) / length
        yield _push(corner, np.array([along[1], -along[0]]), along, length, b)
        if len(a) == 2:  # a segment has ends, too
            yield _push(following, along, np.array([-along[1], along[0]]), 0.0, b)


def _push(corner: Floats, normal: Floats, along: Floats, length: float, b: Floats) -> _Line:
    """Over an edge from a corner: in the middle of where what is deepest of B lies behind the edge."""
    heights, places = (b - corner) @ normal, (b - corner) @ along
    height = float(heights.min())
    deepest = places[heights <= height + 1e-9 * (abs(height) + length)]
    low, high = (min(max(end, 0.0), length) for end in (deepest.min(), deepest.max()))
    place = 0.5 * (low + high) if len(deepest) > 1 else deepest[0]
    return _Line(corner + along * place, normal, height)


def _turned(line: _Line) -> _Line:
    return _Line(line.start + line.direction * line.distance, -line.direction, line.distance)


def _geometry(vertices: Floats) -> shapely.Geometry:
    kinds = {1: shapely.Point, 2: shapely.LineString}
    return kinds.get(len(vertices), shapely.Polygon)(vertices if len(vertices) > 1 else vertices[0])
