"""Where two footprints are nearest to each other, deepest in each other, or stick out of each other.

For one pair at one time, to be shown to people (see `contacts` for many): what is measured over many samples
is in `measure`.

Where two unions of footprints are nearest to each other or stick out of each other, in many samples.

What `contact` says of one pair, for pictures of whole runs: to be looked at, not to be measured with.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spatial_replay.compiled import kernel, piece
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.geometry.batch import FootprintBatch
from spatial_replay.geometry.footprint import ConvexPart, Footprint
from spatial_replay.geometry.measure import Operand

_Line = tuple[float, float, float, float, float]
"""From a point (x, y) of one polygon, in a direction (x, y), as far as (signed) to one of another."""


def contacts(batch: FootprintBatch, first: Operand, second: Operand, *, is_protrusion: bool) -> Floats:
    """Where the signed distance of two operands is attained in each sample, or how far one sticks out.

    Heights play no part.

    Returns:
        (T, 6): a point of `first`, one of `second`, their signed distance (or protrusion), and the upper end
        of the higher of the two footprints, NaN if neither has a height. NaN where either is empty.
    """
    found = np.full((len(first.rows), 6), np.nan)
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
        found,
    )
    return found


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
    found: Floats,
) -> None:
    """Fill `found` (T, 6); `first` and `second` are rows (T, M), below 0 where nobody is."""
    for t in range(found.shape[0]):
        greatest = -np.inf
        least = np.inf
        for i in range(first.shape[1]):
            a = first[t, i]
            if a < 0:
                continue
            for p in range(part_start[a], part_start[a + 1]):
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
                    found[t, 0], found[t, 1] = px, py
                    found[t, 2], found[t, 3] = px + dx * distance, py + dy * distance
                    found[t, 4], found[t, 5] = distance, upper


@piece
def _of_parts(
    vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int, is_protrusion: bool
) -> _Line:
    """Of the whole part A to B, or of the vertex of A that is farthest out of B."""
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
    """The line between two convex polygons, segments or points along which their signed distance is."""
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
    """From the edge of A that keeps B farthest away, to what is deepest of B; -inf far if A has no edge."""
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
        if a_stop - a_start == 2:  # a segment has ends, too
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
    """The least height of a part above a line with a normal, and from where to where along it that is."""
    height, low, high = np.inf, np.inf, -np.inf
    for j in range(start, stop):
        height = min(height, (vertices[j, 0] - x) * nx + (vertices[j, 1] - y) * ny)
    slack = 1e-9 * (abs(height) + abs(x) + abs(y))
    for j in range(start, stop):
        dx, dy = vertices[j, 0] - x, vertices[j, 1] - y
        if dx * nx + dy * ny <= height + slack:
            along = dy * nx - dx * ny
            low, high = min(low, along), max(high, along)
    return height, low, high


@piece
def _nearest(vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int) -> _Line:
    """From the point of A's border that is nearest to a vertex of B, to that vertex."""
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
    return _contact(a, b, is_protrusion=False)


def protrusion_contact(inner: Footprint, outer: Footprint) -> Contact:
    """The point of `inner` farthest out of `outer`, or least deep in it, and the nearest on its boundary.

    Its distance is the protrusion: positive where `inner` sticks out (Prop. 2).
    """
    return _contact(inner, outer, is_protrusion=True)


def enlarged(footprint: Footprint, radius: float) -> Footprint:
    """The Minkowski sum of a footprint with a disc of a radius of at least 0."""
    return Footprint(tuple(ConvexPart(part.vertices, part.radius + radius) for part in footprint.parts))


def _contact(first: Footprint, second: Footprint, *, is_protrusion: bool) -> Contact:
    batch = FootprintBatch.from_footprints([first, second])
    operands = [Operand(np.array([[row]])) for row in range(2)]
    x, y, other_x, other_y, distance, _ = contacts(batch, *operands, is_protrusion=is_protrusion)[0].tolist()
    return Contact((x, y), (other_x, other_y), distance)
