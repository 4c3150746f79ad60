"""Signed distance and protrusion of convex polygons with many vertices, in time proportional to their number.

As a direction turns once around, the vertex of a convex polygon that is farthest in it goes around once, too.
So one walk finds the vertex of B that is lowest above each edge of A. The signed distance of two polygons is
that of the origin to the polygon of all their differences, whose edges are those of A, each at B's lowest
vertex, and those of B, each at A's; and of a convex polygon, the edge whose line is farthest from a point
outside holds its nearest point, or ends at it.
"""

from __future__ import annotations

import math

import numpy as np

from spatial_replay.compiled import inlined, piece
from spatial_replay.geometry.arrays import Floats

MANY = 4096
"""Above so many pairs of vertices a walk takes less time than looking at all."""


@inlined
def are_many(a_count: int, b_count: int) -> bool:
    """Return whether a walk pays; it takes polygons, of at least three vertices."""
    return a_count * b_count > MANY and a_count > 2 and b_count > 2


@inlined
def _height(vertices: Floats, edges: Floats, i: int, j: int) -> float:
    """Return the height of vertex j above the line through the edge from vertex i."""
    dx, dy = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1]
    return float(edges[i, 0] * dx + edges[i, 1] * dy)


@inlined
def _lowest(vertices: Floats, edges: Floats, i: int, start: int, stop: int) -> int:
    lowest = start
    for j in range(start + 1, stop):
        if _height(vertices, edges, i, j) < _height(vertices, edges, i, lowest):
            lowest = j
    return lowest


@inlined
def _after(k: int, start: int, stop: int) -> int:
    return k + 1 if k + 1 < stop else start


@inlined
def _before(k: int, start: int, stop: int) -> int:
    return k - 1 if k > start else stop - 1


@piece
def _separate(
    vertices: Floats, edges: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> tuple[float, float, float]:
    """Return how far the edges of A separate it from B.

    Returns:
        (separation, nearest, squared): as `kernels._separate` gives them, of the edge that separates most and
        those beside it; and the least squared distance of these edges' ends from B's lowest vertices. The
        polygons' distance is attained there, for the edges of A or for those of B.
    """
    separation, nearest, squared = -np.inf, np.inf, np.inf
    j = _lowest(vertices, edges, a_start, b_start, b_stop)
    best, lowest = a_start, j
    for i in range(a_start, a_stop):
        height = _height(vertices, edges, i, j)
        for _ in range(b_stop - b_start):
            following = _after(j, b_start, b_stop)
            ahead = _height(vertices, edges, i, following)
            if ahead > height:
                break
            j, height = following, ahead
        if height > separation:
            separation, best, lowest = height, i, j
    if separation < 0.0:
        return separation, nearest, squared
    # edges that are parallel to others separate as much as their neighbours, at several vertices
    for i in (_before(best, a_start, a_stop), best, _after(best, a_start, a_stop)):
        end = _after(i, a_start, a_stop)
        for k in (_before(lowest, b_start, b_stop), lowest, _after(lowest, b_start, b_stop)):
            dx, dy = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1]
            height = edges[i, 0] * dx + edges[i, 1] * dy
            if height >= 0.0 and 0.0 <= edges[i, 0] * dy - edges[i, 1] * dx <= edges[i, 2]:
                nearest = min(nearest, height)
            squared = min(squared, dx * dx + dy * dy)
            dx, dy = vertices[end, 0] - vertices[k, 0], vertices[end, 1] - vertices[k, 1]
            squared = min(squared, dx * dx + dy * dy)
    return separation, nearest, squared


@piece
def walked_distance(
    vertices: Floats, edges: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> float:
    """Return the signed distance of two convex polygons."""
    a_separation, a_nearest, a_squared = _separate(vertices, edges, a_start, a_stop, b_start, b_stop)
    b_separation, b_nearest, b_squared = _separate(vertices, edges, b_start, b_stop, a_start, a_stop)
    separation = max(a_separation, b_separation)
    if separation < 0.0:
        return separation
    nearest = min(a_nearest, b_nearest)
    if nearest <= separation:
        return nearest
    return min(nearest, math.sqrt(min(a_squared, b_squared)))


@piece
def walked_protrusion(
    vertices: Floats, edges: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> float:
    """Return the greatest signed distance from a vertex of A to the polygon B."""
    # the greatest height above any edge of B: the result, if that is negative
    greatest = -np.inf
    j = a_start
    for k in range(a_start + 1, a_stop):
        if _height(vertices, edges, b_start, k) > _height(vertices, edges, b_start, j):
            j = k
    for i in range(b_start, b_stop):
        height = _height(vertices, edges, i, j)
        for _ in range(a_stop - a_start):
            following = _after(j, a_start, a_stop)
            ahead = _height(vertices, edges, i, following)
            if ahead < height:
                break
            j, height = following, ahead
        greatest = max(greatest, height)
    if greatest < 0.0:
        return greatest
    # else that of the vertices outside. An edge that separates a vertex most has the nearest point of B, and
    # among the edges that separate it all lead up to that one: from vertex to vertex it moves little
    greatest, edge, depth = 0.0, b_start, 0.0
    for v in range(a_start, a_stop):
        # one that lies so deep within that the way from it does not lead outside
        depth -= edges[v - 1, 2] if v > a_start else 0.0
        if depth > 0.0:
            continue
        height = _height(vertices, edges, edge, v)
        if height < 0.0:
            for i in range(b_start, b_stop):
                if _height(vertices, edges, i, v) > height:
                    edge, height = i, _height(vertices, edges, i, v)
            if height < 0.0:
                depth = -height
                continue
        for way in range(2):
            for _ in range(b_stop - b_start):
                following = _after(edge, b_start, b_stop) if way == 0 else _before(edge, b_start, b_stop)
                ahead = _height(vertices, edges, following, v)
                if ahead < height:
                    break
                edge, height = following, ahead
        distance, squared = np.inf, np.inf
        for i in (_before(edge, b_start, b_stop), edge, _after(edge, b_start, b_stop)):
            dx, dy = vertices[v, 0] - vertices[i, 0], vertices[v, 1] - vertices[i, 1]
            above = edges[i, 0] * dx + edges[i, 1] * dy
            if above >= 0.0 and 0.0 <= edges[i, 0] * dy - edges[i, 1] * dx <= edges[i, 2]:
                distance = min(distance, above)
            squared = min(squared, dx * dx + dy * dy)
        if distance > height:
            distance = min(distance, math.sqrt(squared))
        greatest = max(greatest, distance)
    return greatest
