"""Points where two footprints are nearest, overlap deepest, or where one protrudes farthest from another.

For pictures and explanations only; robustness is computed by `measure`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spatial_replay.compiled import kernel, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.footprint import ConvexPart, Footprint, FootprintBatch
from spatial_replay.geometry.measure import Operand

Point = tuple[float, float]

_Line = tuple[float, float, float, float, float]
"""A point (x, y) of one polygon, a unit direction (x, y), and the signed distance along it to the other."""


@dataclass(frozen=True, slots=True)
class Contact:
    """A pair of points, one on each of two footprints.

    Attributes:
        first, second: the nearest points of disjoint footprints; for overlapping ones, the ends of the
            shortest translation that separates them.
        distance: signed, negative for overlap; its absolute value is the distance of the points.
    """

    first: Point
    second: Point
    distance: float


def contact(a: Footprint, b: Footprint) -> Contact:
    """Return where the signed distance of two footprints is attained (Def. 2-4)."""
    return _contact(a, b, is_protrusion=False)


def protrusion_contact(inner: Footprint, outer: Footprint) -> Contact:
    """Return `inner`'s point farthest outside `outer` or least deep in it, and the nearest on its boundary.

    The distance is the protrusion: positive where `inner` sticks out (Prop. 2).
    """
    return _contact(inner, outer, is_protrusion=True)


def _contact(first: Footprint, second: Footprint, *, is_protrusion: bool) -> Contact:
    batch = FootprintBatch.from_footprints([first, second])
    operands = [Operand(np.array([[row]])) for row in range(2)]
    x, y, other_x, other_y, distance, _ = contacts(batch, *operands, is_protrusion=is_protrusion)[0].tolist()
    return Contact((x, y), (other_x, other_y), distance)


def enlarged(footprint: Footprint, radius: float) -> Footprint:
    """Return the Minkowski sum of a footprint with a disc of the given radius (at least 0)."""
    return Footprint(tuple(ConvexPart(part.vertices, part.radius + radius) for part in footprint.parts))


def contacts(batch: FootprintBatch, first: Operand, second: Operand, *, is_protrusion: bool) -> Floats:
    """Return where the signed distance (or protrusion) of two operands is attained in each sample.

    Heights are ignored.

    Returns:
        (T, 6): a point of `first`, a point of `second`, and their signed distance (or protrusion). The last
        column is the upper end of the higher footprint, NaN if neither has a height. NaN where an operand is
        empty.
    """
    result = np.full((len(first.rows), 6), np.nan)
    _contacts(
        batch.part_start,
        batch.vertex_start,
        batch.vertices,
        batch.radius,
        batch.top,
        np.ascontiguousarray(first.rows),
        np.ascontiguousarray(second.rows),
        float(first.enlargement),
        float(second.enlargement),
        is_protrusion,
        result,
    )
    return result


@kernel
def _contacts(
    part_start: Integers,
    vertex_start: Integers,
    vertices: Floats,
    radius: Floats,
    top: Floats,
    first: Integers,
    second: Integers,
    first_enlargement: float,
    second_enlargement: float,
    is_protrusion: bool,
    result: Floats,
) -> None:
    """Fill `result` (T, 6); `first` and `second` are rows (T, M), negative for empty places."""
    for t in range(result.shape[0]):
        greatest = -np.inf
        least = np.inf
        for i in range(first.shape[1]):
            a = first[t, i]
            if a < 0:
                continue
            for p in range(part_start[a], part_start[a + 1]):
                # a protrusion is a maximum over the parts of `first` of minima, a distance one minimum
                if is_protrusion:
                    least = np.inf
                px, py, dx, dy, distance = np.nan, np.nan, 1.0, 0.0, np.inf
                upper = np.nan
                for j in range(second.shape[1]):
                    b = second[t, j]
                    if b < 0:
                        continue
                    for q in range(part_start[b], part_start[b + 1]):
                        line = _of_parts(
                            vertices, vertex_start[p], vertex_start[p + 1], vertex_start[q],
                            vertex_start[q + 1], is_protrusion,
                        )  # fmt: skip
                        own = radius[p] + first_enlargement
                        own = -own if is_protrusion else own
                        other = radius[q] + second_enlargement
                        rounded = line[4] - own - other
                        if rounded < least:
                            least = rounded
                            px, py = line[0] + line[2] * own, line[1] + line[3] * own
                            dx, dy, distance = line[2], line[3], rounded
                            upper = top[b] if math.isnan(top[a]) or top[b] > top[a] else top[a]
                is_taken = distance > greatest if is_protrusion else distance < np.inf
                if is_taken and not math.isnan(px):
                    greatest = distance
                    result[t, 0], result[t, 1] = px, py
                    result[t, 2], result[t, 3] = px + dx * distance, py + dy * distance
                    result[t, 4], result[t, 5] = distance, upper


@piece
def _of_parts(
    vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int, is_protrusion: bool
) -> _Line:
    """Return the line from part A to B or, for a protrusion, from A's vertex farthest outside B."""
    if not is_protrusion:
        return _line(vertices, a_start, a_stop, b_start, b_stop)
    farthest = _line(vertices, a_start, a_start + 1, b_start, b_stop)
    for i in range(a_start + 1, a_stop):
        line = _line(vertices, i, i + 1, b_start, b_stop)
        if line[4] > farthest[4]:
            farthest = line
    return farthest


@piece
def _line(vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int) -> _Line:
    """Return the line along which two convex polygons, segments or points attain their signed distance."""
    from_a = _push(vertices, a_start, a_stop, b_start, b_stop)
    from_b = _push(vertices, b_start, b_stop, a_start, a_stop)
    if from_b[4] > from_a[4]:
        x, y, dx, dy, distance = from_b
        from_a = (x + dx * distance, y + dy * distance, -dx, -dy, distance)
    if -np.inf < from_a[4] <= 0.0:
        return from_a
    near_a = _nearest(vertices, a_start, a_stop, b_start, b_stop)
    near_b = _nearest(vertices, b_start, b_stop, a_start, a_stop)
    if near_b[4] < near_a[4]:
        x, y, dx, dy, distance = near_b
        return x + dx * distance, y + dy * distance, -dx, -dy, distance
    return near_a


@piece
def _push(vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int) -> _Line:
    """Return the line from A's most separating edge to the deepest point of B; -inf long if A has no edge."""
    best = (vertices[a_start, 0], vertices[a_start, 1], 1.0, 0.0, -np.inf)
    if a_stop - a_start < 2:
        return best
    for i in range(a_start, a_stop):
        following = i + 1 if i + 1 < a_stop else a_start
        x, y = vertices[i, 0], vertices[i, 1]
        ax, ay = vertices[following, 0] - x, vertices[following, 1] - y
        length = math.sqrt(ax * ax + ay * ay)
        ax, ay = ax / length, ay / length
        height, low, high = _deepest(vertices, b_start, b_stop, x, y, ay, -ax)
        if height > best[4]:
            place = 0.5 * (min(max(low, 0.0), length) + min(max(high, 0.0), length)) if low < high else low
            best = (x + ax * place, y + ay * place, ay, -ax, height)
        if a_stop - a_start == 2:  # beyond its ends a segment separates too, where its normals see no gap
            x, y = vertices[following, 0], vertices[following, 1]
            height, low, high = _deepest(vertices, b_start, b_stop, x, y, ax, ay)
            if height > best[4]:
                place = 0.0 if low < high else low
                best = (x - ay * place, y + ax * place, ax, ay, height)
    return best


@piece
def _deepest(
    vertices: Floats, start: int, stop: int, x: float, y: float, nx: float, ny: float
) -> tuple[float, float, float]:
    """Return the least height of a part above a line, and the range along the line where it is attained."""
    height, low, high = np.inf, np.inf, -np.inf
    for j in range(start, stop):
        height = min(height, (vertices[j, 0] - x) * nx + (vertices[j, 1] - y) * ny)
    # an edge parallel to the line is deepest along all of its length, within rounding
    slack = 1e-9 * (abs(height) + abs(x) + abs(y))
    for j in range(start, stop):
        dx, dy = vertices[j, 0] - x, vertices[j, 1] - y
        if dx * nx + dy * ny <= height + slack:
            along = dy * nx - dx * ny
            low, high = min(low, along), max(high, along)
    return height, low, high


@piece
def _nearest(vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int) -> _Line:
    """Return the line from the point of A's boundary nearest to a vertex of B, to that vertex."""
    best = (vertices[a_start, 0], vertices[a_start, 1], 1.0, 0.0, np.inf)
    for i in range(a_start, a_stop):
        following = i + 1 if i + 1 < a_stop else a_start
        x, y = vertices[i, 0], vertices[i, 1]
        ax, ay = vertices[following, 0] - x, vertices[following, 1] - y
        squared = ax * ax + ay * ay
        for j in range(b_start, b_stop):
            dx, dy = vertices[j, 0] - x, vertices[j, 1] - y
            share = min(max((dx * ax + dy * ay) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
            gx, gy = dx - share * ax, dy - share * ay
            distance = math.sqrt(gx * gx + gy * gy)
            if distance < best[4]:
                nx, ny = (gx / distance, gy / distance) if distance > 0.0 else (1.0, 0.0)
                best = (x + share * ax, y + share * ay, nx, ny, distance)
    return best
