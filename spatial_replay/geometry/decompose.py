"""Convex parts of a polygon that is not convex."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeAlias

import numpy as np

from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import Floats

_Ring: TypeAlias = tuple[int, ...]


def convex_hull(vertices: Floats) -> Floats:
    """Corners (h, 2) of the convex hull of some points (n, 2)."""
    from shapely import MultiPoint, get_coordinates

    return np.asarray(get_coordinates(MultiPoint(vertices).convex_hull), dtype=np.float64)


def convex_pieces(vertices: Floats) -> list[Floats]:
    """A few convex polygons without common interior that together are exactly the given one.

    A Delaunay triangulation, of which every two neighbours are merged, across the longest edges first,
    as long as the result stays convex (Hertel and Mehlhorn: at most four times as many pieces as needed).

    Args:
        vertices: (n, 2) float64, corners in either order, no two alike in a row.

    Raises:
        GeometryError: for a boundary that crosses or touches itself.
    """
    from shapely import Polygon, constrained_delaunay_triangles, get_coordinates

    polygon = Polygon(vertices)
    if not polygon.is_valid:
        raise GeometryError(_describe_crossing(polygon))
    number = {(float(x), float(y)): i for i, (x, y) in enumerate(vertices)}
    triangles = [
        tuple(number[float(x), float(y)] for x, y in get_coordinates(triangle)[:3])
        for triangle in constrained_delaunay_triangles(polygon).geoms
    ]
    pieces = _merge((ring if _turn(vertices, *ring) > 0 else ring[::-1] for ring in triangles), vertices)
    return [vertices[list(ring)] for ring in pieces]


def _describe_crossing(polygon: object) -> str:
    from shapely import is_valid_reason

    reason, _, place = str(is_valid_reason(polygon)).partition("[")
    where = f" at ({', '.join(place.rstrip(']').split())})" if place else f" ({reason})"
    return (
        f"the polygon's boundary crosses or touches itself{where}; "
        "list its corners in order around it, or split it, or take its hull (concave='hull')"
    )


def _turn(vertices: Floats, a: int, b: int, c: int) -> float:
    """Positive where the way from a over b to c turns to the left."""
    (ax, ay), (bx, by), (cx, cy) = vertices[a], vertices[b], vertices[c]
    return float((bx - ax) * (cy - by) - (by - ay) * (cx - bx))


def _merge(triangles: Iterable[_Ring], vertices: Floats) -> list[_Ring]:
    """Counter-clockwise triangles, joined across shared edges while the result is convex."""
    rings = dict(enumerate(triangles))
    ring_of_edge = {edge: name for name, ring in rings.items() for edge in _edges(ring)}
    shared = [(i, j) for i, j in ring_of_edge if i < j and (j, i) in ring_of_edge]
    for i, j in sorted(shared, key=lambda edge: (-_squared_length(vertices, *edge), edge)):
        left, right = rings[ring_of_edge[i, j]], rings[ring_of_edge[j, i]]
        # left runs j … i, right runs i … j.
        from_j, from_i = _rotated(left, j), _rotated(right, i)
        ring = from_j + from_i[1:-1]
        at_i = _turn(vertices, from_j[-2], i, from_i[1])
        at_j = _turn(vertices, from_i[-2], j, from_j[1])
        if at_i < 0 or at_j < 0:
            continue
        kept, gone = ring_of_edge[i, j], ring_of_edge[j, i]
        rings[kept] = ring
        del rings[gone]
        ring_of_edge.update((edge, kept) for edge in _edges(ring))
    return list(rings.values())


def _edges(ring: _Ring) -> Iterable[tuple[int, int]]:
    return zip(ring, ring[1:] + ring[:1], strict=True)


def _rotated(ring: _Ring, first: int) -> _Ring:
    """The same ring, written from one of its corners on."""
    place = ring.index(first)
    return ring[place:] + ring[:place]


def _squared_length(vertices: Floats, i: int, j: int) -> float:
    return float(np.sum((vertices[i] - vertices[j]) ** 2))
