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
BLOCKS = 64
"""Edges are left out by blocks, at most twice as many; vertices are looked for by as many strides."""
DIRECTIONS = 8
"""In so many directions the first look is for a vertex that sticks out far."""


@inlined
def _stride(count: int) -> int:
    return 1 + count // BLOCKS


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
def _after(k: int, start: int, stop: int) -> int:
    return k + 1 if k + 1 < stop else start


@inlined
def _before(k: int, start: int, stop: int) -> int:
    return k - 1 if k > start else stop - 1


@inlined
def _low_vertex(vertices: Floats, edges: Floats, i: int, j: int, b_start: int, b_stop: int) -> int:
    """Return a vertex of B low above the edge i of A; above those before it, j was one."""
    stride = _stride(b_stop - b_start)
    for _ in range(b_start, b_stop, stride):
        ahead = j + stride if j + stride < b_stop else j + stride - (b_stop - b_start)
        if _height(vertices, edges, i, ahead) >= _height(vertices, edges, i, j):
            break
        j = ahead
    return j


@piece
def _most_separating(
    vertices: Floats, edges: Floats, begin: int, end: int, j: int, b_start: int, b_stop: int
) -> tuple[float, int, int]:
    """Return how far the edges from `begin` to before `end` separate A from B, which one, and B's lowest.

    Args:
        j: a vertex of B low above these edges.
    """
    separation, best, lowest = -np.inf, begin, j
    for _ in range(b_stop - b_start):
        before = _before(j, b_start, b_stop)
        if _height(vertices, edges, begin, before) >= _height(vertices, edges, begin, j):
            break
        j = before
    for i in range(begin, end):
        height = _height(vertices, edges, i, j)
        for _ in range(b_stop - b_start):
            following = _after(j, b_start, b_stop)
            ahead = _height(vertices, edges, i, following)
            if ahead > height:
                break
            j, height = following, ahead
        if height > separation:
            separation, best, lowest = height, i, j
    return separation, best, lowest


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
    block = _stride(a_stop - a_start)
    first = b_start
    for j in range(b_start, b_stop, _stride(b_stop - b_start)):
        if _height(vertices, edges, a_start, j) < _height(vertices, edges, a_start, first):
            first = j
    # a block that separates much, then those that may separate as much
    j, begin, most, low = first, a_start, -np.inf, first
    for at in range(a_start, a_stop, block):
        middle = min(at + block // 2, a_stop - 1)
        j = _low_vertex(vertices, edges, middle, j, b_start, b_stop)
        if _height(vertices, edges, middle, j) > most:
            most, begin, low = _height(vertices, edges, middle, j), at, j
    end = min(begin + block, a_stop)
    least, best, lowest = _most_separating(vertices, edges, begin, end, low, b_start, b_stop)
    j = first
    for at in range(a_start, a_stop, block):
        end = min(at + block, a_stop)
        j = _low_vertex(vertices, edges, min(at + block // 2, a_stop - 1), j, b_start, b_stop)
        # no edge separates A from B by more than any one vertex of B is above it
        bound = -np.inf
        for i in range(at, end):
            bound = max(bound, _height(vertices, edges, i, j))
        # the first of those that separate equally counts, as if all were looked at
        if bound >= least and bound > separation:
            found, i, k = _most_separating(vertices, edges, at, end, j, b_start, b_stop)
            if found > separation:
                separation, best, lowest = found, i, k
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


@inlined
def _deepest_within(
    vertices: Floats, edges: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> tuple[float, int]:
    """Return the greatest height of a vertex of A above any edge of B, and a vertex above one if any is."""
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
        if greatest >= 0.0:
            break
    return greatest, j


@inlined
def _edge_below(
    vertices: Floats, edges: Floats, edge: int, v: int, b_start: int, b_stop: int
) -> tuple[int, float]:
    """Return the edge of B above which vertex v is highest, and how high; `edge` is a guess."""
    height = _height(vertices, edges, edge, v)
    if height < 0.0:
        for i in range(b_start, b_stop, _stride(b_stop - b_start)):
            if _height(vertices, edges, i, v) > height:
                edge, height = i, _height(vertices, edges, i, v)
    if height < 0.0:
        for i in range(b_start, b_stop):
            if _height(vertices, edges, i, v) > height:
                edge, height = i, _height(vertices, edges, i, v)
        if height < 0.0:
            return edge, height
    # among the edges that separate a vertex all lead up to the one that separates it most
    for way in range(2):
        for _ in range(b_stop - b_start):
            following = _after(edge, b_start, b_stop) if way == 0 else _before(edge, b_start, b_stop)
            ahead = _height(vertices, edges, following, v)
            if ahead < height:
                break
            edge, height = following, ahead
    return edge, height


@inlined
def _above(vertices: Floats, edges: Floats, i: int, v: int) -> tuple[float, float]:
    """Return how high v is above the edge from i, +inf beside it, and its squared distance from vertex i."""
    dx, dy = vertices[v, 0] - vertices[i, 0], vertices[v, 1] - vertices[i, 1]
    above = edges[i, 0] * dx + edges[i, 1] * dy
    is_beside = above < 0.0 or not 0.0 <= edges[i, 0] * dy - edges[i, 1] * dx <= edges[i, 2]
    return np.inf if is_beside else above, dx * dx + dy * dy


@piece
def walked_protrusion(
    vertices: Floats, edges: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> float:
    """Return the greatest signed distance from a vertex of A to the polygon B."""
    v, most = a_start, -np.inf
    for i in range(b_start, b_stop, 1 + (b_stop - b_start) // DIRECTIONS):
        for k in range(a_start, a_stop, _stride(a_stop - a_start)):
            if _height(vertices, edges, i, k) > most:
                v, most = k, _height(vertices, edges, i, k)
    if most < 0.0:
        most, v = _deepest_within(vertices, edges, a_start, a_stop, b_start, b_stop)
        if most < 0.0:
            return most
    greatest, edge, to_spare = 0.0, b_start, 0.0
    for _ in range(a_stop - a_start):
        # on the way from vertex to vertex the distance grows by no more than the way
        if to_spare <= 0.0:
            edge, height = _edge_below(vertices, edges, edge, v, b_start, b_stop)
            distance = height
            if height >= 0.0:
                # the edge that separates a vertex most has the nearest point of B, or ends there
                following = _after(edge, b_start, b_stop)
                distance, squared = _above(vertices, edges, edge, v)
                above, of_following = _above(vertices, edges, following, v)
                distance, squared = min(distance, above), min(squared, of_following)
                above, _ = _above(vertices, edges, _before(edge, b_start, b_stop), v)
                distance = min(distance, above)
                if distance > height:
                    distance = min(distance, math.sqrt(squared))
                greatest = max(greatest, distance)
            to_spare = greatest - distance
            # what coordinates may be off by from rounding
            to_spare -= 1e-9 * (abs(vertices[v, 0]) + abs(vertices[v, 1]) + to_spare)
        to_spare -= edges[v, 2]
        v = _after(v, a_start, a_stop)
    return greatest
