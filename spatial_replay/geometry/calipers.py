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

from spatial_replay.compiled import apart, floats_at, inlined, inlined_as, piece
from spatial_replay.geometry.arrays import Floats

MANY = 4096
"""Above so many pairs of vertices a walk takes less time than looking at all."""
BLOCKS = 64
"""Edges are left out by blocks, at most twice as many; vertices are looked for by as many strides."""
CLOSE = 1e-9
"""What coordinates may be off by from rounding, to their size, with much to spare."""
MISSES = 3
"""So often an enclosure finds corners that do not go in step, and then looks for no more."""
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
def _low_vertex(
    vertices: Floats, edges: Floats, i: int, j: int, b_start: int, b_stop: int
) -> tuple[int, float]:
    """Return a vertex of B low above the edge i of A, and its height; above those before it, j was one."""
    stride, height = _stride(b_stop - b_start), _height(vertices, edges, i, j)
    for _ in range(b_start, b_stop, stride):
        following = j + stride if j + stride < b_stop else j + stride - (b_stop - b_start)
        ahead = _height(vertices, edges, i, following)
        if ahead >= height:
            break
        j, height = following, ahead
    return j, height


@inlined
def _in_step(
    vertices: Floats, edges: Floats, begin: int, end: int, k: int, b_start: int, b_stop: int
) -> tuple[float, int, int, int]:
    """Return what `_most_separating` finds where B's lowest vertex goes on by one with each edge.

    Of outlines that are alike, two vertices are as low but for rounding, and a processor cannot guess which
    of them is lower. Here both are looked at, k and the next for the first edge, and no branch depends on it.

    Returns:
        (separation, i, j, k): of the edges before i, above the last of which j is lowest, and what k is for
        i. They end where an edge separates them: only then it matters which one separates most.
    """
    separation, i, j = -np.inf, begin, k - 1
    while i < end and k > b_start and k + 2 < b_stop:
        low, following = _height(vertices, edges, i, k), _height(vertices, edges, i, k + 1)
        leads_here = low <= _height(vertices, edges, i, k - 1)
        if not (leads_here and _height(vertices, edges, i, k + 2) > following):
            break
        is_next = following <= low
        height = following if is_next else low
        if height >= 0.0:
            break
        separation = height if height > separation else separation
        j = k + 1 if is_next else k
        i, k = i + 1, k + 1
    return separation, i, j, k


@inlined
def _leads_down(vertices: Floats, edges: Floats, i: int, j: int, k: int) -> bool:
    """Return whether from vertex j back to k each is lower above the edge i."""
    is_lower = j >= k
    height = _height(vertices, edges, i, k)
    for at in range(k + 1, j + 1):
        ahead = _height(vertices, edges, i, at)
        is_lower &= height < ahead
        height = ahead
    return is_lower


@piece
def _most_separating(
    vertices: Floats, edges: Floats, begin: int, end: int, j: int, k: int, b_start: int, b_stop: int
) -> tuple[float, int, int, int]:
    """Return how far the edges from `begin` to before `end` separate A from B, which one, and B's lowest.

    Which, and B's lowest, are only known where an edge separates them. The fourth number is `k` for
    the edge at `end`.

    Args:
        j: a vertex of B low above these edges.
        k: the first of the two lowest, if all edges before these went in step (see `_in_step`), or -1.
    """
    separation, best, lowest, i = -np.inf, begin, j, begin
    if k >= 0 and k + 1 < b_stop and _leads_down(vertices, edges, begin, j, k + 1):
        separation, i, low, k = _in_step(vertices, edges, begin, end, k, b_start, b_stop)
        if i == end:
            return separation, best, low, k
        j = low if i > begin else j
    if i == begin:
        for _ in range(b_stop - b_start):
            before = _before(j, b_start, b_stop)
            if _height(vertices, edges, begin, before) >= _height(vertices, edges, begin, j):
                break
            j = before
    k = -1
    while i < end:
        height = _height(vertices, edges, i, j)
        for _ in range(b_stop - b_start):
            following = _after(j, b_start, b_stop)
            ahead = _height(vertices, edges, i, following)
            if ahead > height:
                break
            j, height = following, ahead
        if height > separation:
            separation, best, lowest = height, i, j
        i += 1
        if i == begin + 1 and i < end and j + 2 < b_stop:
            # of two as low, j is the first or the second
            is_first = _height(vertices, edges, i, j) > _height(vertices, edges, i, j + 2)
            next_pair = j + 1 if is_first else j
            found, stop, low, next_pair = _in_step(vertices, edges, i, end, next_pair, b_start, b_stop)
            if stop > i:
                separation, i, j = max(separation, found), stop, low
            k = next_pair if i == end else -1
    return separation, best, lowest, k


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
        j, height = _low_vertex(vertices, edges, middle, j, b_start, b_stop)
        is_most = height > most
        most = height if is_most else most
        begin = at if is_most else begin
        low = j if is_most else low
    end = min(begin + block, a_stop)
    least, best, lowest, _ = _most_separating(vertices, edges, begin, end, low, -1, b_start, b_stop)
    j, k = first, -1
    for at in range(a_start, a_stop, block):
        end, middle = min(at + block, a_stop), min(at + block // 2, a_stop - 1)
        # no edge separates A from B by more than any one vertex of B is above it
        j, bound = _low_vertex(vertices, edges, middle, j, b_start, b_stop)
        if bound < least:
            for i in range(at, end):
                bound = max(bound, _height(vertices, edges, i, j))
        else:
            bound = np.inf
        # the first of those that separate equally counts, as if all were looked at
        if bound >= least and bound > separation:
            found, i, v, k = _most_separating(vertices, edges, at, end, j, k, b_start, b_stop)
            if found > separation:
                separation, best, lowest = found, i, v
        else:
            k = -1
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
def _walked_distance(
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
def _is_before(edges: Floats, k: int, i: int) -> bool:
    """Return whether the normal of edge k comes before that of edge i, less than half a turn behind."""
    return bool(edges[k, 0] * edges[i, 1] - edges[k, 1] * edges[i, 0] > 0.0)


@inlined
def _most_below(
    vertices: Floats, edges: Floats, edge: int, height: float, v: int, b_start: int, b_stop: int
) -> tuple[int, float]:
    """Return the edge of B above which vertex v is highest, and how high, given one that it is above."""
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
def _edge_below(
    vertices: Floats, edges: Floats, w: int, v: int, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> tuple[int, float, int]:
    """Return the edge of B above which vertex v of A is highest, how high, and B's vertex for the next of A.

    The height is negative where v is not outside B, or another vertex of A is surely farther from it. The
    vertex of A that is farthest from B is so in a direction in which it is the farthest of A, too; that
    direction is between the normals of two edges of B, of which one has the vertex above it.

    Args:
        w: the vertex of B that is farthest along the normal of the edge of A that leads to v.
    """
    first, last = _before(w, b_start, b_stop), w
    edge, height = first, _height(vertices, edges, first, v)
    for _ in range(b_stop - b_start):
        last = w
        ahead = _height(vertices, edges, w, v)
        if ahead > height:
            edge, height = w, ahead
        if not _is_before(edges, w, v):
            break
        w = _after(w, b_start, b_stop)
    if height < 0.0:
        return edge, height, w
    # among the edges that separate a vertex all lead up to the one that separates it most
    for way in range(2):
        if edge != (last if way == 0 else first):
            continue
        beside = _after(v, a_start, a_stop) if way == 0 else _before(v, a_start, a_stop)
        for _ in range(b_stop - b_start):
            following = _after(edge, b_start, b_stop) if way == 0 else _before(edge, b_start, b_stop)
            ahead = _height(vertices, edges, following, v)
            if ahead < height:
                break
            # beyond the edges for v, its neighbour is farther, in the direction of v's nearest point, too
            slack = CLOSE * (abs(vertices[v, 0]) + abs(vertices[v, 1]) + height)
            if _height(vertices, edges, edge, beside) > height + slack:
                return edge, -1.0, w
            edge, height = following, ahead
    return edge, height, w


@inlined
def _along(vertices: Floats, edges: Floats, i: int, v: int) -> tuple[float, float, float]:
    """Return how high v is above the edge i, how far along it, and its squared distance from vertex i."""
    dx, dy = vertices[v, 0] - vertices[i, 0], vertices[v, 1] - vertices[i, 1]
    return (
        edges[i, 0] * dx + edges[i, 1] * dy,
        edges[i, 0] * dy - edges[i, 1] * dx,
        dx * dx + dy * dy,
    )


@inlined
def _from_edge(
    vertices: Floats, edges: Floats, edge: int, height: float, v: int, b_start: int, b_stop: int
) -> float:
    """Return the distance of v from B, given the edge that separates it most, and by how much."""
    # that edge has the nearest point of B, or ends there
    _, along, squared = _along(vertices, edges, edge, v)
    length, following = edges[edge, 2], _after(edge, b_start, b_stop)
    distance = height if 0.0 <= along <= length else np.inf
    slack = CLOSE * (length + height)
    is_at_start = abs(along) <= slack
    if is_at_start or abs(along - length) <= slack:
        # at a corner, rounding decides which edge is nearer
        other = _before(edge, b_start, b_stop) if is_at_start else following
        above, at, _ = _along(vertices, edges, other, v)
        if above >= 0.0 and 0.0 <= at <= edges[other, 2]:
            distance = min(distance, above)
    if distance <= height:
        return distance
    _, _, of_following = _along(vertices, edges, following, v)
    return min(distance, math.sqrt(min(squared, of_following)))


@piece
def _walked_protrusion(
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
    greatest, to_spare, edge, w, at = 0.0, 0.0, b_start, -1, a_start
    left, misses = a_stop - a_start, 0
    while left > 0:
        # on the way from vertex to vertex the distance grows by no more than the way
        if to_spare <= 0.0:
            if misses < MISSES and b_start < edge and edge + 3 < b_stop:
                end = min(v + left, a_stop)
                greatest, edge, k = _corners_in_step(vertices, edges, greatest, edge, v, end, b_start, b_stop)
                misses += int(k == v)
                left -= k - v
                v = k if k < a_stop else a_start
                if left == 0:
                    break
            height = _height(vertices, edges, edge, v)
            if height >= 0.0:
                edge, height = _most_below(vertices, edges, edge, height, v, b_start, b_stop)
            else:
                if w < 0:
                    at, w = _before(v, a_start, a_stop), b_start
                    for k in range(b_start, b_stop):
                        if _height(vertices, edges, at, k) > _height(vertices, edges, at, w):
                            w = k
                # edge by edge, since normals are compared within half a turn
                for _ in range(a_stop - a_start):
                    if at == _before(v, a_start, a_stop):
                        break
                    at = _after(at, a_start, a_stop)
                    for _ in range(b_stop - b_start):
                        if not _is_before(edges, w, at):
                            break
                        w = _after(w, b_start, b_stop)
                edge, height, w = _edge_below(vertices, edges, w, v, a_start, a_stop, b_start, b_stop)
                at = v
            if height >= 0.0:
                distance = _from_edge(vertices, edges, edge, height, v, b_start, b_stop)
                greatest = max(greatest, distance)
                to_spare = greatest - distance
                to_spare -= CLOSE * (abs(vertices[v, 0]) + abs(vertices[v, 1]) + to_spare)
        to_spare -= edges[v, 2]
        v = _after(v, a_start, a_stop)
        left -= 1
    return greatest


@inlined
def _corners_in_step(
    vertices: Floats,
    edges: Floats,
    greatest: float,
    edge: int,
    begin: int,
    end: int,
    b_start: int,
    b_stop: int,
) -> tuple[float, int, int]:
    """Return what `_walked_protrusion` finds where B's nearest corner goes on by one with each vertex of A.

    Above both edges at that corner, a vertex is as high but for rounding; see `_in_step`.

    Returns:
        (greatest, edge, v): the greatest distance so far, of the vertices before v, and the edge of B above
        which the last of them is highest. None of them is one that the walk leaves out.
    """
    # the corner is at the end of this edge, or at that of the next one
    v = begin
    k = edge + int(_height(vertices, edges, edge, v) < _height(vertices, edges, edge + 2, v))
    while v < end and k > b_start and k + 2 < b_stop:
        before = _height(vertices, edges, k - 1, v)
        high, along, of_start = _along(vertices, edges, k, v)
        following, beside, squared = _along(vertices, edges, k + 1, v)
        beyond, _, of_end = _along(vertices, edges, k + 2, v)
        if not (0.0 <= before < high and beyond < following and squared <= min(of_start, of_end)):
            break
        # surely neither edge has a point that is nearer than the corner, as `_from_edge` would see it
        length, slack = edges[k, 2], CLOSE * (edges[k, 2] + high)
        is_beyond = along > length and min(along, along - length) > slack
        if not (is_beyond and beside < -CLOSE * (edges[k + 1, 2] + following)):
            break
        distance = math.sqrt(squared)
        most = max(greatest, distance)
        to_spare = most - distance
        to_spare -= CLOSE * (abs(vertices[v, 0]) + abs(vertices[v, 1]) + to_spare)
        if not to_spare - edges[v, 2] <= 0.0:
            break
        greatest, edge = most, k + 1 if following > high else k
        v, k = v + 1, k + 1
    return greatest, edge, v


@apart
def _walk(
    vertices_at: int,
    edges_at: int,
    count: int,
    is_protrusion: int,
    a_start: int,
    a_stop: int,
    b_start: int,
    b_stop: int,
) -> int:
    """Return the bits of a distance or protrusion, of arrays (count, 2) and (count, 4) at addresses."""
    vertices, edges = floats_at(vertices_at, (count, 2)), floats_at(edges_at, (count, 4))
    if is_protrusion:
        found = _walked_protrusion(vertices, edges, a_start, a_stop, b_start, b_stop)
    else:
        found = _walked_distance(vertices, edges, a_start, a_stop, b_start, b_stop)
    bits: int = np.float64(found).view(np.int64)  # type: ignore[assignment]
    return bits


def _walked(
    vertices: Floats, edges: Floats, is_protrusion: bool, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> float:
    walk = _walked_protrusion if is_protrusion else _walked_distance
    return walk(vertices, edges, a_start, a_stop, b_start, b_stop)


@inlined_as(_walked)
def walked(
    vertices: Floats, edges: Floats, is_protrusion: bool, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> float:
    """Return the protrusion of two convex polygons, or their signed distance.

    It is compiled once, apart from the kernels that measure: a third of their code, which few logs need.
    """
    bits = _walk(
        vertices.ctypes.data,
        edges.ctypes.data,
        len(vertices),
        int(is_protrusion),
        a_start,
        a_stop,
        b_start,
        b_stop,
    )
    return np.int64(bits).view(np.float64)
