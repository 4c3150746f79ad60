"""Regions as boxes along the axes: around them, and inside them."""

from __future__ import annotations

import math

import numpy as np

from spatial_replay.geometry.footprint import ConvexPart, Footprint
from spatial_replay.spec.formula import Outline


def footprint_of(outline: Outline) -> Footprint:
    """Return the area of a region."""
    if outline.is_disc:
        (x, y), *_ = outline.vertices
        return Footprint.disc(x, y, outline.radius)
    return Footprint.polygon(np.array(outline.vertices, np.float64))


def around(outline: Outline) -> tuple[tuple[float, float], ...]:
    vertices, radius = np.array(outline.vertices, np.float64), outline.radius
    limits = zip(vertices.min(axis=0) - radius, vertices.max(axis=0) + radius, strict=True)
    return tuple((float(low), float(high)) for low, high in limits)


def inside(footprint: Footprint) -> tuple[tuple[float, float], ...]:
    """Return the largest box, among some, that a footprint encloses."""
    boxes = [_box_in(part) for part in footprint.parts]
    return max(boxes, key=lambda box: math.prod(high - low for low, high in box))


def _box_in(part: ConvexPart) -> tuple[tuple[float, float], ...]:
    """Return a box around a part's centroid, of the proportions of the box around the part."""
    x, y = centroid(part)
    if len(part.vertices) < 3:
        half = part.radius / math.sqrt(2.0)
        return (x - half, x + half), (y - half, y + half)
    width, height = np.ptp(part.vertices, axis=0).tolist()
    after = np.roll(part.vertices, -1, axis=0)
    # corners are counter-clockwise: normals point outwards
    normals = np.column_stack([after[:, 1] - part.vertices[:, 1], part.vertices[:, 0] - after[:, 0]])
    room = (normals * (part.vertices - (x, y))).sum(axis=1)
    share = float((room / (np.abs(normals) @ (width / 2.0, height / 2.0))).min())
    return (x - share * width / 2.0, x + share * width / 2.0), (
        y - share * height / 2.0,
        y + share * height / 2.0,
    )


def centroid(part: ConvexPart) -> tuple[float, float]:
    """Return the centroid of a part's polygon; of a point or segment, the mean."""
    vertices = part.vertices - part.vertices[0]
    after = np.roll(vertices, -1, axis=0)
    cross = vertices[:, 0] * after[:, 1] - after[:, 0] * vertices[:, 1]
    if len(vertices) < 3:
        x, y = vertices.mean(axis=0).tolist()
    else:
        x, y = (((vertices + after) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())).tolist()
    return x + float(part.vertices[0, 0]), y + float(part.vertices[0, 1])
