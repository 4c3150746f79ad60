"""Compiled geometry of rounded convex parts: signed distance, protrusion, projections, points of contact.

All kernels read the ragged rows of a `FootprintBatch`.

The result for a pair of parts does not depend on other rows of the call. Loops are symmetric in the two
parts. So equal footprints give equal bits, in either order and in any batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from spatial_replay.compiled import elementwise, inlined, kernel, long_kernel, piece
from spatial_replay.geometry.arrays import Floats, Integers

SIGNED_DISTANCE, PROTRUSION = 0, 1
MIN_X, MAX_X, MIN_Y, MAX_Y, MIN_Z, MAX_Z = range(100, 106)
CENTROID_MIN_X, CENTROID_MAX_X, CENTROID_MIN_Y, CENTROID_MAX_Y = range(106, 110)
QUANTITY_CODES: Final[Mapping[str, int]] = MappingProxyType(
    {
        "signed_distance": SIGNED_DISTANCE,
        "protrusion": PROTRUSION,
        "min_x": MIN_X,
        "max_x": MAX_X,
        "min_y": MIN_Y,
        "max_y": MAX_Y,
        "min_z": MIN_Z,
        "max_z": MAX_Z,
        "centroid_min_x": CENTROID_MIN_X,
        "centroid_max_x": CENTROID_MAX_X,
        "centroid_min_y": CENTROID_MIN_Y,
        "centroid_max_y": CENTROID_MAX_Y,
    }
)
"""Codes of quantities in kernels. Quantities of two operands have codes below 100. Least coordinates have
even codes."""

_FLAT: Final = 1e-12
"""Least ratio of twice the area to the squared perimeter of polygons with an area centroid."""
BOX = 4
"""Number of corners of a box. A constant number lets the compiler unroll loops over the most common parts."""
BLOCK = 64
"""Samples per block, few enough that their edges stay in the processor's cache until distances read them."""


_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def reference_free(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return an inlined function that does not count references to arrays.

    Counting took 390 of 470 ns for the distance of two boxes. `_nrt` is a private option of Numba; versions
    without this option ignore it. Use it only for functions of this module that do not make or return arrays.
    """
    return inlined(function, _nrt=False)


class Rows(NamedTuple):
    """The arrays of a `FootprintBatch`, and `edges` (V, 4) of its parts: outward normal (x, y) and length.

    For a part's first edge, the fourth number is the greatest distance of the part's first vertex from a
    vertex of the part.
    """

    part_start: Integers
    vertex_start: Integers
    vertices: Floats
    edges: Floats
    radius: Floats
    bottom: Floats
    top: Floats


@reference_free
def _fill_edges(vertices: Floats, edges: Floats, start: int, stop: int) -> None:
    """Compute outward normal and length of each edge of the part with vertices `start` to before `stop`."""
    if stop - start < 2:
        return
    for vertex in range(start, stop):
        next_vertex = vertex + 1 if vertex + 1 < stop else start
        dx = vertices[next_vertex, 0] - vertices[vertex, 0]
        dy = vertices[next_vertex, 1] - vertices[vertex, 1]
        length = math.sqrt(dx * dx + dy * dy)
        edges[vertex, 0] = dy / length
        edges[vertex, 1] = -dx / length
        edges[vertex, 2] = length


@reference_free
def fill_row(rows: Rows, row: int) -> None:
    """Compute the edges of a row for `rows_distance`."""
    # rows of one part skip the test for far parts: it slowed boxes with heights from 0.23 to 0.25 µs
    has_single_parts = len(rows.radius) == len(rows.bottom)
    for part in range(rows.part_start[row], rows.part_start[row + 1]):
        start, stop = rows.vertex_start[part], rows.vertex_start[part + 1]
        _fill_edges(rows.vertices, rows.edges, start, stop)
        if has_single_parts:
            rows.edges[start, 3] = np.inf
            continue
        greatest_squared = 0.0
        for vertex in range(start + 1, stop):
            dx, dy = (
                rows.vertices[vertex, 0] - rows.vertices[start, 0],
                rows.vertices[vertex, 1] - rows.vertices[start, 1],
            )
            greatest_squared = max(greatest_squared, dx * dx + dy * dy)
        rows.edges[start, 3] = math.sqrt(greatest_squared)


@reference_free
def _fill_if_not(rows: Rows, row: int, is_filled: NDArray[np.bool_]) -> None:
    if row >= 0 and not is_filled[row]:
        is_filled[row] = True
        fill_row(rows, row)


@reference_free
def _is_farther(rows: Rows, p: int, q: int, reach: float) -> bool:
    """Return True only if the distance of parts p and q, without their radii, is surely above `reach`."""
    a_vertex, b_vertex = rows.vertex_start[p], rows.vertex_start[q]
    reach += rows.edges[a_vertex, 3] + rows.edges[b_vertex, 3]
    dx, dy = (
        rows.vertices[a_vertex, 0] - rows.vertices[b_vertex, 0],
        rows.vertices[a_vertex, 1] - rows.vertices[b_vertex, 1],
    )
    # 1e-9 covers the rounding of the squares
    return reach < 0.0 or dx * dx + dy * dy > (1.0 + 1e-9) * reach * reach


@reference_free
def _least_height(vertices: Floats, start: int, stop: int, x: float, y: float, nx: float, ny: float) -> float:
    """Return the least height of a part's vertices above the line through (x, y) with normal (nx, ny)."""
    least_height = np.inf
    for vertex in range(start, stop):
        least_height = min(least_height, nx * (vertices[vertex, 0] - x) + ny * (vertices[vertex, 1] - y))
    return least_height


@reference_free
def _separate(
    vertices: Floats, edges: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> tuple[float, float]:
    """Return two bounds of the distance of parts A and B, both from the edges of A.

    Returns:
        (separation, nearest). For each edge of A, B has a least height above the edge's line. Separation is
        the greatest of these heights, or -inf if A is a point. Nearest is the least height of a vertex of B
        above an edge of A onto which the vertex projects, or +inf without such a vertex.
    """
    separation = -np.inf
    nearest = np.inf
    a_count = a_stop - a_start
    if a_count < 2:
        return separation, nearest
    for edge in range(a_start, a_stop):
        x, y = vertices[edge, 0], vertices[edge, 1]
        nx, ny = edges[edge, 0], edges[edge, 1]
        least_height = _least_height(vertices, b_start, b_stop, x, y, nx, ny)
        separation = max(separation, least_height)
        if least_height >= 0.0:
            for vertex in range(b_start, b_stop):
                dx, dy = vertices[vertex, 0] - x, vertices[vertex, 1] - y
                if 0.0 <= nx * dy - ny * dx <= edges[edge, 2]:
                    nearest = min(nearest, nx * dx + ny * dy)
        if a_count == 2:
            # normals of a segment show no gap to a part beyond its ends, so the segment's direction is tried,
            # too
            other_end = a_start + a_stop - 1 - edge
            x, y = vertices[other_end, 0], vertices[other_end, 1]
            separation = max(separation, _least_height(vertices, b_start, b_stop, x, y, -ny, nx))
    return separation, nearest


@reference_free
def _distance_by_edges(
    vertices: Floats, edges: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> float:
    """Return the signed distance of two parts (without their radii), by a test of all edges and vertices.

    The penetration depth is along the normal of an edge. The distance of disjoint polygons is between two
    vertices, or between a vertex and a point of an edge. In the second case, the distance equals the
    separation along the edge's normal.
    """
    a_separation, a_nearest = _separate(vertices, edges, a_start, a_stop, b_start, b_stop)
    b_separation, b_nearest = _separate(vertices, edges, b_start, b_stop, a_start, a_stop)
    separation = max(a_separation, b_separation)
    if separation < 0.0 and separation > -np.inf:
        return separation
    nearest = min(a_nearest, b_nearest)
    if nearest <= separation:
        return nearest
    least_squared = np.inf
    for a_vertex in range(a_start, a_stop):
        for b_vertex in range(b_start, b_stop):
            dx, dy = (
                vertices[a_vertex, 0] - vertices[b_vertex, 0],
                vertices[a_vertex, 1] - vertices[b_vertex, 1],
            )
            least_squared = min(least_squared, dx * dx + dy * dy)
    return min(nearest, math.sqrt(least_squared))


@reference_free
def _convex_distance(
    vertices: Floats, edges: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> float:
    """Return the signed distance of two convex polygons, segments or points (without their radii)."""
    if a_stop - a_start == BOX and b_stop - b_start == BOX:
        return _distance_by_edges(vertices, edges, a_start, a_start + BOX, b_start, b_start + BOX)
    return _distance_by_edges(vertices, edges, a_start, a_stop, b_start, b_stop)


@reference_free
def _convex_protrusion(
    vertices: Floats, edges: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int
) -> float:
    """Return the greatest signed distance from a vertex of A to the polygon B (without their radii)."""
    greatest = -np.inf
    if a_stop - a_start == BOX and b_stop - b_start == BOX:
        for vertex in range(a_start, a_start + BOX):
            distance = _distance_by_edges(vertices, edges, vertex, vertex + 1, b_start, b_start + BOX)
            greatest = max(greatest, distance)
        return greatest
    for vertex in range(a_start, a_stop):
        greatest = max(greatest, _distance_by_edges(vertices, edges, vertex, vertex + 1, b_start, b_stop))
    return greatest


@reference_free
def weight_and_centre(vertices: Floats, start: int, stop: int, radius: float) -> tuple[float, float, float]:
    """Return the area of a rounded part, and the centroid (x, y) of its unrounded polygon."""
    # coordinates are relative to the first vertex, so that products far from the origin do not cancel
    x0, y0 = vertices[start, 0], vertices[start, 1]
    doubled_area = sum_x = sum_y = mean_x = mean_y = perimeter = 0.0
    for vertex in range(start, stop):
        next_vertex = vertex + 1 if vertex + 1 < stop else start
        ax, ay = vertices[vertex, 0] - x0, vertices[vertex, 1] - y0
        bx, by = vertices[next_vertex, 0] - x0, vertices[next_vertex, 1] - y0
        cross = ax * by - bx * ay
        doubled_area, sum_x, sum_y = (
            doubled_area + cross,
            sum_x + cross * (ax + bx),
            sum_y + cross * (ay + by),
        )
        mean_x, mean_y = mean_x + ax, mean_y + ay
        perimeter += math.sqrt((bx - ax) * (bx - ax) + (by - ay) * (by - ay))
    # Steiner's formula: the polygon, a strip along its sides, and sectors at its corners that form a disc
    area = doubled_area / 2 + perimeter * radius + math.pi * radius * radius
    if stop - start > 2 and doubled_area > _FLAT * perimeter * perimeter:
        return area, x0 + sum_x / (3.0 * doubled_area), y0 + sum_y / (3.0 * doubled_area)
    return area, x0 + mean_x / (stop - start), y0 + mean_y / (stop - start)


@reference_free
def rows_distance(rows: Rows, a: int, b: int, enlargement: float) -> float:
    """Return the signed distance of rows a and b; rows that both have heights are upright prisms."""
    vertex_start = rows.vertex_start
    least_distance = np.inf
    for part in range(rows.part_start[a], rows.part_start[a + 1]):
        for other_part in range(rows.part_start[b], rows.part_start[b + 1]):
            # the parentheses keep the sum equal, bit for bit, if the parts are swapped
            radii = (rows.radius[part] + rows.radius[other_part]) + enlargement
            if least_distance < np.inf and _is_farther(rows, part, other_part, least_distance + radii):
                continue
            distance = _convex_distance(
                rows.vertices,
                rows.edges,
                vertex_start[part],
                vertex_start[part + 1],
                vertex_start[other_part],
                vertex_start[other_part + 1],
            )
            least_distance = min(least_distance, distance - radii)
    if math.isnan(rows.bottom[a]) or math.isnan(rows.bottom[b]):
        return least_distance
    gap = max(rows.bottom[a] - rows.top[b], rows.bottom[b] - rows.top[a])
    if least_distance > 0.0 and gap > 0.0:
        return math.sqrt(least_distance * least_distance + gap * gap)
    return float(max(least_distance, gap))


@reference_free
def _part_protrusion(rows: Rows, a: int, part: int, b: int, enlargement: float) -> float:
    vertex_start, radius = rows.vertex_start, rows.radius
    least_protrusion = np.inf
    for other_part in range(rows.part_start[b], rows.part_start[b + 1]):
        # the protrusion from a part is at least the distance from it, so far parts cannot give the least
        # protrusion
        reach = least_protrusion - (radius[part] - radius[other_part]) - enlargement
        if least_protrusion < np.inf and _is_farther(rows, part, other_part, reach):
            continue
        planar = _convex_protrusion(
            rows.vertices,
            rows.edges,
            vertex_start[part],
            vertex_start[part + 1],
            vertex_start[other_part],
            vertex_start[other_part + 1],
        )
        least_protrusion = min(least_protrusion, planar + (radius[part] - radius[other_part]) + enlargement)
    if math.isnan(rows.bottom[a]) or math.isnan(rows.bottom[b]):
        return least_protrusion
    return float(max(least_protrusion, max(rows.bottom[b] - rows.bottom[a], rows.top[a] - rows.top[b])))


@reference_free
def _row_extreme(rows: Rows, quantity: int, row: int, enlargement: float) -> float:
    """Return a row's greatest coordinate for MAX_ quantities.

    For MIN_ quantities, return the row's negated least coordinate.
    """
    if quantity == MIN_Z:
        return float(-rows.bottom[row])
    if quantity == MAX_Z:
        return float(rows.top[row])
    sign = -1.0 if quantity % 2 == 0 else 1.0
    greatest = -np.inf
    for part in range(rows.part_start[row], rows.part_start[row + 1]):
        start, stop = rows.vertex_start[part], rows.vertex_start[part + 1]
        if quantity >= CENTROID_MIN_X:
            _, x, y = weight_and_centre(rows.vertices, start, stop, 0.0)
            greatest = max(greatest, sign * (x if quantity <= CENTROID_MAX_X else y))
        else:
            axis = 0 if quantity <= MAX_X else 1
            for vertex in range(start, stop):
                greatest = max(
                    greatest, sign * rows.vertices[vertex, axis] + (rows.radius[part] + enlargement)
                )
    return greatest


@reference_free
def _union_distance(
    rows: Rows, members: Integers, first: tuple[int, int], second: tuple[int, int], enlargement: float
) -> float:
    least_distance = np.inf
    for first_member in range(first[0], first[1]):
        for second_member in range(second[0], second[1]):
            a, b = members[first_member], members[second_member]
            if a >= 0 and b >= 0:
                least_distance = min(least_distance, rows_distance(rows, a, b, enlargement))
    return least_distance


@reference_free
def _union_protrusion(
    rows: Rows, members: Integers, first: tuple[int, int], second: tuple[int, int], enlargement: float
) -> float:
    """Return the protrusion of one union of rows from another union.

    A part of the first union has a least protrusion over the parts of the second union. The result is the
    greatest of these least protrusions.
    """
    greatest = -np.inf
    for first_member in range(first[0], first[1]):
        a = members[first_member]
        if a < 0:
            continue
        for part in range(rows.part_start[a], rows.part_start[a + 1]):
            least_protrusion = np.inf
            for second_member in range(second[0], second[1]):
                if members[second_member] >= 0:
                    least_protrusion = min(
                        least_protrusion, _part_protrusion(rows, a, part, members[second_member], enlargement)
                    )
            greatest = max(greatest, least_protrusion)
    return greatest


@reference_free
def _union_extreme(
    rows: Rows, members: Integers, first: tuple[int, int], quantity: int, enlargement: float
) -> float:
    """Return a projection of a union of rows; NaN along z if a row has no height."""
    greatest = -np.inf
    for member in range(first[0], first[1]):
        if members[member] < 0:
            continue
        extreme = _row_extreme(rows, quantity, members[member], enlargement)
        if math.isnan(extreme):
            return np.nan
        greatest = max(greatest, extreme)
    return -greatest if quantity % 2 == 0 else greatest


@elementwise
@long_kernel
def measure_rows(
    part_start: Integers,
    vertex_start: Integers,
    vertices: Floats,
    radius: Floats,
    bottom: Floats,
    top: Floats,
    members: Integers,
    member_start: Integers,
    width: Integers,
    enlargement: Floats,
    quantity: Integers,
    first: Integers,
    second: Integers,
    edges: Floats,
    values: Floats,
    begin: int,
    end: int,
) -> None:
    """Fill `values` (K, T) with K quantities in the samples from `begin` to before `end`; see `measure`.

    In sample t, the rows of operand o are the `width[o]` elements of `members` from
    `member_start[o] + t * width[o]` on. `member_start` (O + 1,) ends with the number of all members.

    `edges` (V, 4) is scratch space, one row per vertex. Parallel calls for other samples may share `edges`,
    because all calls write the same numbers.
    """
    # edges are computed on demand, because many rows of a log are only projected, or unused
    is_filled = np.zeros(len(part_start), dtype=np.bool_)
    rows = Rows(part_start, vertex_start, vertices, edges, radius, bottom, top)
    for block in range(begin, end, BLOCK):
        block_end = min(block + BLOCK, end)
        for request in range(len(quantity)):
            if quantity[request] <= PROTRUSION:
                for operand_side in range(2):
                    operand = first[request] if operand_side == 0 else second[request]
                    operand_start = member_start[operand]
                    for member in range(
                        operand_start + block * width[operand], operand_start + block_end * width[operand]
                    ):
                        _fill_if_not(rows, members[member], is_filled)
        for sample in range(block, block_end):
            for request in range(values.shape[0]):
                a, b = first[request], second[request]
                first_element = member_start[a] + sample * width[a]
                a_members = (first_element, first_element + width[a])
                if quantity[request] >= MIN_X:
                    values[request, sample] = _union_extreme(
                        rows, members, a_members, quantity[request], enlargement[a]
                    )
                    continue
                first_element = member_start[b] + sample * width[b]
                b_members = (first_element, first_element + width[b])
                if quantity[request] == SIGNED_DISTANCE:
                    enlargements = enlargement[a] + enlargement[b]
                    values[request, sample] = _union_distance(
                        rows, members, a_members, b_members, enlargements
                    )
                elif quantity[request] == PROTRUSION:
                    # an enlarged container reduces the protrusion
                    enlargements = enlargement[a] - enlargement[b]
                    values[request, sample] = _union_protrusion(
                        rows, members, a_members, b_members, enlargements
                    )


_Line = tuple[float, float, float, float, float]
"""Line between two polygons: start (x, y) on the first, unit direction (x, y), signed distance."""


@kernel
def fill_contacts(
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
    """Fill `result` (T, 6) as in `contacts`; `first` and `second` are row numbers (T, M), or negative."""
    for sample in range(result.shape[0]):
        greatest = -np.inf
        least = np.inf
        for first_member in range(first.shape[1]):
            a = first[sample, first_member]
            if a < 0:
                continue
            for part in range(part_start[a], part_start[a + 1]):
                # a protrusion is the maximum of one minimum per part of `first`; a distance is one minimum
                if is_protrusion:
                    least = np.inf
                px, py, dx, dy, distance = np.nan, np.nan, 1.0, 0.0, np.inf
                upper = np.nan
                for second_member in range(second.shape[1]):
                    b = second[sample, second_member]
                    if b < 0:
                        continue
                    for other_part in range(part_start[b], part_start[b + 1]):
                        line = _of_parts(
                            vertices, vertex_start[part], vertex_start[part + 1], vertex_start[other_part],
                            vertex_start[other_part + 1], is_protrusion,
                        )  # fmt: skip
                        first_radius = radius[part] + first_enlargement
                        # the farthest point of a rounded part protrudes by one radius beyond its vertex
                        first_radius = -first_radius if is_protrusion else first_radius
                        second_radius = radius[other_part] + second_enlargement
                        rounded = line[4] - first_radius - second_radius
                        if rounded < least:
                            least = rounded
                            px, py = line[0] + line[2] * first_radius, line[1] + line[3] * first_radius
                            dx, dy, distance = line[2], line[3], rounded
                            upper = top[b] if math.isnan(top[a]) or top[b] > top[a] else top[a]
                is_taken = distance > greatest if is_protrusion else distance < np.inf
                if is_taken and not math.isnan(px):
                    greatest = distance
                    result[sample, 0], result[sample, 1] = px, py
                    result[sample, 2], result[sample, 3] = px + dx * distance, py + dy * distance
                    result[sample, 4], result[sample, 5] = distance, upper


@piece
def _of_parts(
    vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int, is_protrusion: bool
) -> _Line:
    """Return the line from part A to part B; for a protrusion, from A's vertex farthest outside B."""
    if not is_protrusion:
        return _line(vertices, a_start, a_stop, b_start, b_stop)
    farthest = _line(vertices, a_start, a_start + 1, b_start, b_stop)
    for vertex in range(a_start + 1, a_stop):
        line = _line(vertices, vertex, vertex + 1, b_start, b_stop)
        if line[4] > farthest[4]:
            farthest = line
    return farthest


@piece
def _line(vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int) -> _Line:
    """Return the line of the signed distance of two convex polygons, segments or points."""
    push_from_a = _push(vertices, a_start, a_stop, b_start, b_stop)
    push_from_b = _push(vertices, b_start, b_stop, a_start, a_stop)
    if push_from_b[4] > push_from_a[4]:
        x, y, dx, dy, distance = push_from_b
        push_from_a = (x + dx * distance, y + dy * distance, -dx, -dy, distance)
    if -np.inf < push_from_a[4] <= 0.0:
        return push_from_a
    near_a = _nearest(vertices, a_start, a_stop, b_start, b_stop)
    near_b = _nearest(vertices, b_start, b_stop, a_start, a_stop)
    if near_b[4] < near_a[4]:
        x, y, dx, dy, distance = near_b
        return x + dx * distance, y + dy * distance, -dx, -dy, distance
    return near_a


@piece
def _push(vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int) -> _Line:
    """Return the line from A's most separating edge to the deepest point of B.

    The line's distance is -inf if A is a point.
    """
    best_line = (vertices[a_start, 0], vertices[a_start, 1], 1.0, 0.0, -np.inf)
    if a_stop - a_start < 2:
        return best_line
    for edge in range(a_start, a_stop):
        next_vertex = edge + 1 if edge + 1 < a_stop else a_start
        x, y = vertices[edge, 0], vertices[edge, 1]
        ax, ay = vertices[next_vertex, 0] - x, vertices[next_vertex, 1] - y
        length = math.sqrt(ax * ax + ay * ay)
        ax, ay = ax / length, ay / length
        height, low, high = _deepest(vertices, b_start, b_stop, x, y, ay, -ax)
        if height > best_line[4]:
            # the middle of the edge's part that touches B
            along = 0.5 * (min(max(low, 0.0), length) + min(max(high, 0.0), length)) if low < high else low
            best_line = (x + ax * along, y + ay * along, ay, -ax, height)
        if a_stop - a_start == 2:  # normals of a segment show no gap to a part beyond its ends
            x, y = vertices[next_vertex, 0], vertices[next_vertex, 1]
            height, low, high = _deepest(vertices, b_start, b_stop, x, y, ax, ay)
            if height > best_line[4]:
                along = 0.0 if low < high else low
                best_line = (x - ay * along, y + ax * along, ax, ay, height)
    return best_line


@piece
def _deepest(
    vertices: Floats, start: int, stop: int, x: float, y: float, nx: float, ny: float
) -> tuple[float, float, float]:
    """Return a part's least height above a line, and its range (low, high) along the line."""
    height, low, high = np.inf, np.inf, -np.inf
    for vertex in range(start, stop):
        height = min(height, (vertices[vertex, 0] - x) * nx + (vertices[vertex, 1] - y) * ny)
    # both ends of an edge parallel to the line have the least height, within rounding
    slack = 1e-9 * (abs(height) + abs(x) + abs(y))
    for vertex in range(start, stop):
        dx, dy = vertices[vertex, 0] - x, vertices[vertex, 1] - y
        if dx * nx + dy * ny <= height + slack:
            along = dy * nx - dx * ny
            low, high = min(low, along), max(high, along)
    return height, low, high


@piece
def _nearest(vertices: Floats, a_start: int, a_stop: int, b_start: int, b_stop: int) -> _Line:
    """Return the shortest line from A's boundary to a vertex of B."""
    best_line = (vertices[a_start, 0], vertices[a_start, 1], 1.0, 0.0, np.inf)
    for edge in range(a_start, a_stop):
        next_vertex = edge + 1 if edge + 1 < a_stop else a_start
        x, y = vertices[edge, 0], vertices[edge, 1]
        ax, ay = vertices[next_vertex, 0] - x, vertices[next_vertex, 1] - y
        squared_length = ax * ax + ay * ay
        for vertex in range(b_start, b_stop):
            dx, dy = vertices[vertex, 0] - x, vertices[vertex, 1] - y
            share = min(max((dx * ax + dy * ay) / squared_length, 0.0), 1.0) if squared_length > 0.0 else 0.0
            gx, gy = dx - share * ax, dy - share * ay
            distance = math.sqrt(gx * gx + gy * gy)
            if distance < best_line[4]:
                nx, ny = (gx / distance, gy / distance) if distance > 0.0 else (1.0, 0.0)
                best_line = (x + share * ax, y + share * ay, nx, ny, distance)
    return best_line
