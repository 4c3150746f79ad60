"""Outlines of regions from shapes as written; shapes that enclose nothing are refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from spatial_replay.spec.formula import Outline

Corner: TypeAlias = tuple[float, float]


@dataclass(slots=True)
class Effort:
    """The pairs of edges that may still be compared, for all polygons of one text."""

    left: int = 100_000


class OutlineError(Exception):
    """A fault of a shape, and its remedy."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.message, self.hint = message, hint


def polygon(corners: Sequence[Corner], effort: Effort) -> Outline:
    """Return the outline of a polygon.

    Raises:
        OutlineError: no corner, or a boundary that crosses or touches itself. Corners on one line
            are accepted: they make a point or a segment.
    """
    if not corners:
        raise OutlineError("a polygon without corners", "write at least one corner (x, y)")
    ring = [corner for index, corner in enumerate(corners) if index == 0 or corner != corners[index - 1]]
    if len(ring) > 1 and ring[0] == ring[-1]:
        ring.pop()
    if not _is_collinear(ring):
        crossing = _crossing(ring, effort)
        if crossing is not None:
            (ax, ay), (bx, by) = crossing
            message = f"the polygon crosses itself: its edges from ({ax:g}, {ay:g}) and ({bx:g}, {by:g}) meet"
            raise OutlineError(message, "list the corners in the order of its boundary")
    return Outline(tuple(corners))


def box(xmin: float, ymin: float, xmax: float, ymax: float) -> Outline:
    """Return the outline of a box.

    Raises:
        OutlineError: a least coordinate above the greatest.
    """
    for axis, least, greatest in (("x", xmin, xmax), ("y", ymin, ymax)):
        if least > greatest:
            message = f"a box whose {axis}min, {least:g}, is above its {axis}max, {greatest:g}"
            raise OutlineError(message, "write box(xmin, ymin, xmax, ymax)")
    return Outline(((xmin, ymin), (xmax, ymin), (xmax, ymax), (xmin, ymax)))


def circle(centre: Corner, radius: float) -> Outline:
    """Return the outline of a disc.

    Raises:
        OutlineError: a negative radius.
    """
    if radius < 0.0:
        raise OutlineError(f"a circle of the negative radius {radius:g}", "write a radius of at least 0")
    return Outline((centre,), radius)


def _turn(a: Corner, b: Corner, c: Corner) -> float:
    """Return twice the signed area of a triangle: positive where a, b, c turn left, 0 on one line."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _is_collinear(ring: Sequence[Corner]) -> bool:
    if len(ring) < 3:
        return True
    return all(_turn(ring[0], ring[1], corner) == 0.0 for corner in ring[2:])


def _within(a: Corner, b: Corner, c: Corner) -> bool:
    """Return whether c, on the line through a and b, lies between them."""
    return min(a[0], b[0]) <= c[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= c[1] <= max(a[1], b[1])


def _meet(a: Corner, b: Corner, c: Corner, d: Corner) -> bool:
    """Return whether the segments ab and cd have a point in common."""
    c_side, d_side, a_side, b_side = _turn(a, b, c), _turn(a, b, d), _turn(c, d, a), _turn(c, d, b)
    if ((c_side > 0 > d_side) or (c_side < 0 < d_side)) and ((a_side > 0 > b_side) or (a_side < 0 < b_side)):
        return True
    on_line = ((c_side, a, b, c), (d_side, a, b, d), (a_side, c, d, a), (b_side, c, d, b))
    return any(side == 0.0 and _within(*points) for side, *points in on_line)


def _fold_back(a: Corner, b: Corner, c: Corner) -> bool:
    """Return whether the edge bc runs back over ab."""
    forward = (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1])
    return _turn(a, b, c) == 0.0 and forward < 0.0


def _crossing(ring: Sequence[Corner], effort: Effort) -> tuple[Corner, Corner] | None:
    """Return the first corners of two edges that meet where they should not."""
    count = len(ring)
    edges = [(ring[index], ring[(index + 1) % count]) for index in range(count)]
    for index in range(count):
        if _fold_back(*edges[index - 1], edges[index][1]):
            return edges[index - 1][0], edges[index][0]
    # a sweep along x: only edges that overlap in x are compared
    by_left = sorted(range(count), key=lambda index: min(edges[index][0][0], edges[index][1][0]))
    for place, first in enumerate(by_left):
        right = max(edges[first][0][0], edges[first][1][0])
        for second in by_left[place + 1 :]:
            if min(edges[second][0][0], edges[second][1][0]) > right:
                break
            effort.left -= 1
            if effort.left < 0:
                raise OutlineError("the polygons of this text have too many corners", "use fewer of them")
            if (first - second) % count not in (1, count - 1) and _meet(*edges[first], *edges[second]):
                return edges[min(first, second)][0], edges[max(first, second)][0]
    return None
