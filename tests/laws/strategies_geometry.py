"""Shapes to try laws on: from points and slivers of nothing to polygons and unions."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from spatial_replay import ConvexPart, Footprint

coordinates = st.integers(-400, 400).map(lambda value: value / 16)
"""Numbers of a coarse grid: shapes that touch, share edges or lie on one line come up often."""

free_coordinates = st.floats(-25, 25, allow_nan=False, allow_subnormal=False)
radii = st.one_of(st.just(0.0), st.integers(1, 64).map(lambda value: value / 16))
points = st.tuples(coordinates, coordinates)
angles = st.floats(-math.pi, math.pi, allow_nan=False)


@st.composite
def convex_vertices(draw, min_size=1):
    """Corners of a convex polygon, segment or point, in either order, some of them superfluous."""
    cloud = draw(
        st.lists(st.one_of(points, st.tuples(free_coordinates, free_coordinates)), min_size=1, max_size=7)
    )
    corners = _hull(cloud)
    if len(corners) < min_size:
        x, y = corners[0]
        corners = _hull([(x, y), (x + 3, y), (x + 2, y + 2), (x, y + 4)])
    if draw(st.booleans()):
        corners = corners[::-1]
    if draw(st.booleans()):
        at = draw(st.integers(0, len(corners) - 1))
        corners = corners[: at + 1] + corners[at:]
    return corners


@st.composite
def convex_parts(draw, radii=radii):
    return ConvexPart(np.array(draw(convex_vertices())), draw(radii))


@st.composite
def polygonal_parts(draw):
    """Parts with an area and no rounding."""
    return ConvexPart(np.array(draw(convex_vertices(min_size=3))))


footprints = st.lists(convex_parts(), min_size=1, max_size=3).map(lambda parts: Footprint(tuple(parts)))


@st.composite
def star_polygons(draw):
    """Corners of a polygon, mostly not convex, whose boundary does not cross itself."""
    count = draw(st.integers(4, 12))
    lengths = draw(st.lists(st.integers(4, 40), min_size=count, max_size=count))
    x, y = draw(points)
    turns = [2 * math.pi * i / count for i in range(count)]
    corners = [(x + r * math.cos(a), y + r * math.sin(a)) for r, a in zip(lengths, turns, strict=True)]
    return corners if draw(st.booleans()) else corners[::-1]


def _hull(cloud):
    """Corners of the convex hull, counter-clockwise."""
    cloud = sorted(set(cloud))
    if len(cloud) <= 2:
        return cloud

    def chain(ordered):
        kept = []
        for x, y in ordered:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                    break
                kept.pop()
            kept.append((x, y))
        return kept[:-1]

    return chain(cloud) + chain(cloud[::-1])
