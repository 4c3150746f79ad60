"""Normalise raw outlines for the kernels: counter-clockwise, no superfluous vertex, convex parts only."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.compiled import elementwise, inlined, kernel
from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import Floats, Integers

SOUND, EMPTY, NOT_FINITE, NOT_CONVEX, TOO_MANY_CORNERS = 0, 1, 2, 3, 4

LARGEST_COORDINATE = 1e100
"""Limit of absolute coordinates, so that products of a few coordinates stay finite."""

MOST_CORNERS = 2_000
"""Corner limit of polygons that are split, because each sample measures every part."""

MOST_CONVEX_CORNERS = 10_000
"""Corner limit of convex polygons, because each sample measures all corners for every pair of objects."""

# A vertex counts as on a line if it is within a tolerance. The tolerance is `_FLATNESS` times the outline's
# extent, or `_ROUNDING` (4 units in the last place) times the greatest coordinate, if that is more.
# `_SMALLEST` keeps the squared tolerance above zero.
_FLATNESS = 1e-9
_ROUNDING = 4 * 2.0**-52
_SMALLEST = 1e-100

_Corner: TypeAlias = tuple[float, float]
_Ring: TypeAlias = tuple[int, ...]
"""A polygon as indices of its corners."""


class Outlines(NamedTuple):
    """P outlines as ragged rows, each with its fault.

    Attributes:
        vertex_start: (P + 1,) int64.
        vertices: (V, 2) float64.
        fault: (P,) int8: `SOUND`, `EMPTY` (no vertex), `NOT_FINITE` (or beyond `LARGEST_COORDINATE`),
            `NOT_CONVEX` (or a boundary that crosses itself) or `TOO_MANY_CORNERS`. A faulty outline keeps its
            vertices, but an outline with too many corners is normalised.
    """

    vertex_start: Integers
    vertices: Floats
    fault: NDArray[np.int8]


def normalise_polygons(vertex_start: Integers, vertices: Floats) -> Outlines:
    """Order each outline counter-clockwise and drop repeated or collinear vertices.

    A vertex is dropped if it is within a tolerance of the segment between its neighbours. The tolerance is a
    billionth of the outline's extent, or the resolution of its coordinates. A narrower outline becomes a
    segment or a point. Convex counter-clockwise input is returned bit for bit.

    Args:
        vertex_start: (P + 1,) int64; outline p is vertices[vertex_start[p] : vertex_start[p + 1]].
        vertices: (V, 2) float64, in footprint units.
    """
    tidy_vertices = np.array(vertices, dtype=np.float64, order="C")
    counts = np.empty(len(vertex_start) - 1, dtype=np.int64)
    if len(counts) <= _FEW_OUTLINES and _are_normal(np.diff(vertex_start), tidy_vertices):
        return Outlines(
            np.array(vertex_start, dtype=np.int64), tidy_vertices, np.full(len(counts), SOUND, np.int8)
        )
    faults = np.empty(len(counts), dtype=np.int8)
    raw_start = np.array(vertex_start, dtype=np.int64)
    vertex_count = _normalise_all(raw_start, tidy_vertices, counts, faults)
    _limit_corners(counts, faults)
    tidy_start = np.zeros(len(counts) + 1, dtype=np.int64)
    np.cumsum(counts, out=tidy_start[1:])
    return Outlines(tidy_start, tidy_vertices[:vertex_count], faults)


def _are_normal(counts: Integers, vertices: Floats) -> bool:
    """Return whether each outline is a point, or convex and counter-clockwise, with equal corner counts.

    For few outlines, NumPy is much faster than an interpreted loop over vertices.
    """
    corner_count = int(counts.max(initial=0))
    is_point = counts == 1
    if corner_count > _MOST_TESTED_CORNERS or not (is_point | (counts == corner_count)).all():
        return False
    if not (np.abs(vertices) <= LARGEST_COORDINATE).all():
        return False
    if corner_count <= 1:
        return True
    corners = vertices if not is_point.any() else vertices[np.repeat(~is_point, counts)]
    x, y = corners.reshape(-1, corner_count, 2).transpose(2, 1, 0)
    extents = np.maximum(np.ptp(x, axis=0), np.ptp(y, axis=0))
    magnitudes = np.maximum(np.abs(x).max(axis=0), np.abs(y).max(axis=0))
    tolerances = np.maximum(_FLATNESS * extents, np.maximum(_ROUNDING * magnitudes, _SMALLEST))
    # the test of `_winding` for all corners at once
    next_x, next_y = np.roll(x, -1, axis=0), np.roll(y, -1, axis=0)
    edge_x, edge_y = next_x - x, next_y - y
    previous_x, previous_y = np.roll(edge_x, 1, axis=0), np.roll(edge_y, 1, axis=0)
    chord_x, chord_y = next_x - np.roll(x, 1, axis=0), next_y - np.roll(y, 1, axis=0)
    turn_area = previous_x * edge_y - previous_y * edge_x
    is_left = (turn_area > 0.0) & (
        turn_area * turn_area > tolerances * tolerances * (chord_x**2 + chord_y**2)
    )
    if not is_left.all():
        return False
    is_upper = (next_y > y) | ((next_y == y) & (next_x > x))
    return bool((np.count_nonzero(is_upper != np.roll(is_upper, 1, axis=0), axis=0) == 2).all())


def normalise_polygon(vertices: Floats) -> tuple[Floats, int]:
    """Normalise one outline (n, 2) in place; return its vertices and its fault (see `Outlines`)."""
    counts, fault = np.empty(1, np.int64), np.empty(1, np.int8)
    vertex_count = _normalise_all(np.array([0, len(vertices)]), vertices, counts, fault)
    _limit_corners(counts, fault)
    return vertices[:vertex_count], fault.item(0)


def _limit_corners(counts: Integers, fault: NDArray[np.int8]) -> None:
    fault[(counts > MOST_CONVEX_CORNERS) & (fault == SOUND)] = TOO_MANY_CORNERS


_FEW_OUTLINES = 4_096
"""Limit of outlines that NumPy tests first, because the kernel is interpreted for few outlines."""
_MOST_TESTED_CORNERS = 16
"""Limit of corners of an outline that NumPy tests."""


@elementwise
@kernel
def _normalise_all(starts: Integers, vertices: Floats, counts: Integers, fault: NDArray[np.int8]) -> int:
    """Normalise every outline in place and close the gaps; return the number of vertices left."""
    used_count = 0
    scratch = np.empty_like(vertices)
    for outline in range(len(counts)):
        first, stop = starts[outline], starts[outline + 1]
        counts[outline] = stop - first
        fault[outline] = SOUND
        tolerance = _tolerance(vertices, first, stop)
        if tolerance < 0.0:
            fault[outline] = EMPTY if first == stop else NOT_FINITE
        elif counts[outline] > 1:
            winding = _winding(vertices, first, stop, tolerance)
            # a convex outline is not tidied, so that it keeps its bits
            if winding == 0:
                _copy(vertices, first, scratch, 0, counts[outline])
                count_left = _tidy(scratch, counts[outline], tolerance)
                # the tolerance is 0, because nearly collinear vertices have been dropped
                winding = _winding(scratch, 0, count_left, 0.0) if count_left > 2 else 1
                if winding == 0:
                    fault[outline] = NOT_CONVEX
                else:
                    _copy(scratch, 0, vertices, first, count_left)
                    counts[outline] = count_left
            if winding == -1:
                # the first vertex stays first
                _reverse(vertices, first + 1, first + counts[outline])
        _copy(vertices, first, vertices, used_count, counts[outline])
        used_count += counts[outline]
    return used_count


@inlined
def _copy(source: Floats, source_start: int, target: Floats, target_start: int, count: int) -> None:
    """Copy vertices in ascending order, so that the target may overlap a later source."""
    for offset in range(count):
        target[target_start + offset, 0] = source[source_start + offset, 0]
        target[target_start + offset, 1] = source[source_start + offset, 1]


@inlined
def _reverse(vertices: Floats, start: int, stop: int) -> None:
    while start < stop - 1:
        stop -= 1
        for axis in range(2):
            vertices[start, axis], vertices[stop, axis] = vertices[stop, axis], vertices[start, axis]
        start += 1


@inlined
def _tolerance(vertices: Floats, first: int, stop: int) -> float:
    """Return the tolerance for vertices on a line; -1 for an unusable outline."""
    least_x = least_y = np.inf
    most_x = most_y = -np.inf
    for vertex in range(first, stop):
        x, y = vertices[vertex, 0], vertices[vertex, 1]
        if not (abs(x) <= LARGEST_COORDINATE and abs(y) <= LARGEST_COORDINATE):
            return -1.0
        least_x, most_x = min(least_x, x), max(most_x, x)
        least_y, most_y = min(least_y, y), max(most_y, y)
    if first == stop:
        return -1.0
    extent = max(most_x - least_x, most_y - least_y)
    magnitude = max(max(-least_x, most_x), max(-least_y, most_y))
    return max(_FLATNESS * extent, max(_ROUNDING * magnitude, _SMALLEST))


@inlined
def _winding(vertices: Floats, first: int, stop: int, tolerance: float) -> int:
    """Return 1 for one round of left turns, -1 for one round of right turns, else 0.

    A turn is neither left nor right if its vertex is within `tolerance` of its neighbours' line. a, b and c
    are the previous, the current and the next vertex.
    """
    left_turns = right_turns = vertical_changes = 0
    corner_count = stop - first
    ax, ay = vertices[stop - 1, 0], vertices[stop - 1, 1]
    bx, by = vertices[first, 0], vertices[first, 1]
    was_upper = by > ay or (by == ay and bx > ax)
    for offset in range(corner_count):
        next_vertex = first if offset + 1 == corner_count else first + offset + 1
        cx, cy = vertices[next_vertex, 0], vertices[next_vertex, 1]
        cross = (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
        chord = (cx - ax) * (cx - ax) + (cy - ay) * (cy - ay)
        if cross * cross > tolerance * tolerance * chord:
            left_turns += cross > 0.0
            right_turns += cross < 0.0
        is_upper = cy > by or (cy == by and cx > bx)
        # a convex outline rises once and falls once; a star also has only left turns, but rises and falls
        # more often
        vertical_changes += is_upper != was_upper
        was_upper = is_upper
        ax, ay, bx, by = bx, by, cx, cy
    if vertical_changes != 2:
        return 0
    return 1 if left_turns == corner_count else (-1 if right_turns == corner_count else 0)


@inlined
def _tidy(vertices: Floats, count: int, tolerance: float) -> int:
    """Drop superfluous vertices among the first `count`, in place; return the remaining number."""
    # the line between two far vertices decides whether the outline is flat
    head = _farthest(vertices, count, 0)
    tail = _farthest(vertices, count, head)
    is_flat = True
    for vertex in range(count):
        is_flat = is_flat and _strays(vertices, vertex, head, tail) <= tolerance
    if is_flat:
        first_end, second_end = min(head, tail), max(head, tail)
        _copy(vertices, first_end, vertices, 0, 1)
        _copy(vertices, second_end, vertices, 1, 1)
        return 1 if _distance(vertices, 0, 1) <= tolerance else 2
    # dropping a vertex can make its neighbours collinear, so the loop repeats until nothing changes
    has_changed = True
    while has_changed and count > 2:
        has_changed = False
        remaining_count, kept_count = count, 0
        for vertex in range(count):
            previous = kept_count - 1 if kept_count else count - 1
            following = vertex + 1 if vertex + 1 < count else 0
            if remaining_count > 2 and _strays(vertices, vertex, previous, following) <= tolerance:
                remaining_count -= 1
                has_changed = True
            else:
                _copy(vertices, vertex, vertices, kept_count, 1)
                kept_count += 1
        count = remaining_count
    return count


@inlined
def _distance(vertices: Floats, i: int, j: int) -> float:
    dx, dy = vertices[i, 0] - vertices[j, 0], vertices[i, 1] - vertices[j, 1]
    return math.sqrt(dx * dx + dy * dy)


@inlined
def _farthest(vertices: Floats, count: int, origin: int) -> int:
    greatest_distance, farthest = -1.0, origin
    for vertex in range(count):
        distance = _distance(vertices, vertex, origin)
        if distance > greatest_distance:
            greatest_distance, farthest = distance, vertex
    return farthest


@inlined
def _strays(vertices: Floats, i: int, head: int, tail: int) -> float:
    """Return the distance of vertex i from the segment between vertices `head` and `tail`."""
    segment_length = _distance(vertices, head, tail)
    if segment_length == 0.0:
        return _distance(vertices, i, head)
    dx, dy = vertices[tail, 0] - vertices[head, 0], vertices[tail, 1] - vertices[head, 1]
    px, py = vertices[i, 0] - vertices[head, 0], vertices[i, 1] - vertices[head, 1]
    share = min(max((px * dx + py * dy) / segment_length, 0.0), segment_length) / segment_length
    ox, oy = px - share * dx, py - share * dy
    return math.sqrt(ox * ox + oy * oy)


def convex_hull(vertices: Floats) -> Floats:
    """Return the corners (h, 2) of the convex hull of points (n, 2)."""
    from shapely import MultiPoint, get_coordinates

    return np.asarray(get_coordinates(MultiPoint(vertices).convex_hull), dtype=np.float64)


def convex_pieces(vertices: Floats, holes: Sequence[Floats] = ()) -> list[Floats]:
    """Split a polygon into few convex polygons with disjoint interiors.

    Triangles of a Delaunay triangulation are merged across shared edges, longest edges first, while pieces
    stay convex. There are at most four times as many pieces as necessary (Hertel and Mehlhorn, 1983).

    Args:
        vertices: (n, 2) float64, corners in either order, without equal neighbours.
        holes: corners of each hole, in the same form.

    Raises:
        GeometryError: the boundary crosses or touches itself, or has more than `MOST_CORNERS` corners.
    """
    outline, vertices = vertices, np.concatenate([vertices, *holes])
    if len(vertices) > MOST_CORNERS:
        raise GeometryError(
            f"a polygon that is not convex has {len(vertices):,} corners, more than the {MOST_CORNERS:,} that"
            " can be split; simplify it, or take its hull (concave='hull')"
        )
    from shapely import Polygon, constrained_delaunay_triangles, get_coordinates

    polygon = Polygon(outline, holes)
    if not polygon.is_valid:
        raise GeometryError(_describe_crossing(polygon))
    corners = [(x, y) for x, y in vertices.tolist()]
    corner_numbers = {corner: number for number, corner in enumerate(corners)}
    closed_triangles = get_coordinates(constrained_delaunay_triangles(polygon)).reshape(-1, 4, 2)
    triangles = [
        tuple([corner_numbers[x, y] for x, y in triangle]) for triangle in closed_triangles[:, :3].tolist()
    ]
    piece_rings = _merge((ring if _turn(corners, *ring) > 0 else ring[::-1] for ring in triangles), corners)
    return [vertices[list(ring)] for ring in piece_rings]


def _describe_crossing(polygon: object) -> str:
    from shapely import is_valid_reason

    reason, _, position = str(is_valid_reason(polygon)).partition("[")
    position_text = f" at ({', '.join(position.rstrip(']').split())})" if position else f" ({reason})"
    return (
        f"the polygon's boundary crosses or touches itself{position_text}; "
        "list its corners in order around it, or split it, or take its hull (concave='hull')"
    )


def _turn(corners: Sequence[_Corner], a: int, b: int, c: int) -> float:
    """Return a number above 0 if the path a, b, c turns left, below 0 if it turns right."""
    (ax, ay), (bx, by), (cx, cy) = corners[a], corners[b], corners[c]
    return (bx - ax) * (cy - by) - (by - ay) * (cx - bx)


def _merge(triangles: Iterable[_Ring], corners: Sequence[_Corner]) -> list[_Ring]:
    """Join counter-clockwise triangles across shared edges while the result is convex."""
    rings = dict(enumerate(triangles))
    ring_of_edge = {edge: ring_number for ring_number, ring in rings.items() for edge in _edges(ring)}
    shared_edges = [
        (first_corner, second_corner)
        for first_corner, second_corner in ring_of_edge
        if first_corner < second_corner and (second_corner, first_corner) in ring_of_edge
    ]
    for first_corner, second_corner in sorted(
        shared_edges, key=lambda edge: (-_squared_length(corners, *edge), edge)
    ):
        left_ring, right_ring = (
            rings[ring_of_edge[first_corner, second_corner]],
            rings[ring_of_edge[second_corner, first_corner]],
        )
        # the left ring runs from the second corner to the first, the right ring back
        from_second, from_first = _rotate(left_ring, second_corner), _rotate(right_ring, first_corner)
        merged_ring = from_second + from_first[1:-1]
        turn_at_first = _turn(corners, from_second[-2], first_corner, from_first[1])
        turn_at_second = _turn(corners, from_first[-2], second_corner, from_second[1])
        # straight corners are allowed, because normalising a piece drops them
        if turn_at_first < 0 or turn_at_second < 0:
            continue
        merged_number, removed_number = (
            ring_of_edge[first_corner, second_corner],
            ring_of_edge[second_corner, first_corner],
        )
        rings[merged_number] = merged_ring
        del rings[removed_number]
        ring_of_edge.update((edge, merged_number) for edge in _edges(merged_ring))
    return list(rings.values())


def _edges(ring: _Ring) -> Iterable[tuple[int, int]]:
    return zip(ring, ring[1:] + ring[:1], strict=True)


def _rotate(ring: _Ring, first: int) -> _Ring:
    """Return a ring that starts at corner `first`."""
    index = ring.index(first)
    return ring[index:] + ring[:index]


def _squared_length(corners: Sequence[_Corner], i: int, j: int) -> float:
    (ax, ay), (bx, by) = corners[i], corners[j]
    return (ax - bx) * (ax - bx) + (ay - by) * (ay - by)
