"""Outlines in messages: lists of corners, or rings with holes, in; corners in columns out.

Rings follow GeoJSON (RFC 7946): a polygon is a list of an outer ring and holes, a `MultiPolygon` a list of
polygons. polygon_msgs/ComplexPolygon2D has the outer ring in the field `outer`, and holes in `inner`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from typing import Any

import numpy as np

from spatial_replay.errors import GeometryError
from spatial_replay.geometry.arrays import Floats, Integers, starts_from_counts
from spatial_replay.geometry.outline import convex_pieces
from spatial_replay.mapping.field_paths import (
    ContentError,
    FieldPath,
    Get,
    Style,
    field_names,
    get_field,
    is_list,
    leads_somewhere,
    style_of,
    tuple_getter,
    walk,
)

_LEAST_CORNERS = 3
_OUTER, _INNER = "outer", "inner"


def outlines_from_lists(
    lists: list[Any], *, is_bounds: bool, have_size: bool = False
) -> tuple[Integers, Floats, int]:
    """Return the corner counts (R,) and corners (V, 3) of outlines, and the number of faulty outlines.

    An outline with too few corners gets one corner at NaN, which makes its object unknown.

    Args:
        is_bounds: whether each list is two opposite corners of a box, to be expanded to four corners.
        have_size: whether bounds have width and height instead of the second corner.
    """
    corner_counts, points = points_from_lists(lists)
    if is_bounds:
        is_faulty = corner_counts != 2
        first_corners = starts_from_counts(corner_counts)[:-1][~is_faulty]
        box_corners = (
            np.stack([points[first_corners], points[first_corners + 1]])
            if len(first_corners)
            else np.empty((2, 0, 3))
        )
        if have_size:
            # NaN instead of a negative size makes the object unknown
            box_corners[1] = box_corners[0] + np.where(box_corners[1] < 0, np.nan, box_corners[1])
        (left, bottom, _), (right, top, _) = box_corners.min(axis=0).T, box_corners.max(axis=0).T
        box_xs, box_ys = (
            np.stack([left, right, right, left], axis=1),
            np.stack([bottom, bottom, top, top], axis=1),
        )
        boxes = np.stack([box_xs, box_ys, np.zeros_like(box_xs)], axis=2).reshape(-1, 3)
        corner_counts, points = np.where(is_faulty, 0, 4), boxes
    else:
        is_faulty = corner_counts < _LEAST_CORNERS
    if not is_faulty.any():
        return corner_counts, points, 0
    is_enough = np.repeat(~is_faulty, corner_counts)
    insertions = starts_from_counts(np.where(is_faulty, 0, corner_counts))[:-1][is_faulty]
    points = np.insert(points[is_enough], insertions, np.nan, axis=0)
    return np.where(is_faulty, 1, corner_counts), points, int(np.count_nonzero(is_faulty))


def points_from_lists(lists: list[Any]) -> tuple[Integers, Floats]:
    """Return the corner counts (R,) and corners (V, 3) of lists.

    Elements are points with fields, pairs of numbers, or x and y in turn.
    """
    example = next((corners[0] for corners in lists if len(corners)), None)
    elements = list(chain.from_iterable(lists))
    element_counts = np.array([len(corners) for corners in lists], np.int64)
    names = field_names(example)
    if "x" in names and "y" in names:
        axes = "xyz" if "z" in names else "xy"
        get_axes = tuple_getter([FieldPath.of(axis) for axis in axes], example)
        coordinate_rows = read_rows(get_axes, elements, len(axes), style_of(example))
        return element_counts, coordinate_rows if len(axes) == 3 else np.column_stack(
            [coordinate_rows, np.zeros(len(elements))]
        )
    if example is None or hasattr(example, "__len__"):
        xy_pairs = np.array([(point[0], point[1]) for point in elements], np.float64).reshape(-1, 2)
        return element_counts, np.column_stack([xy_pairs, np.zeros(len(xy_pairs))])
    if (element_counts % 2).any():
        raise ValueError("a polygon has an odd number of coordinates; give x and y of each corner in turn")
    xy_pairs = np.array(elements, np.float64).reshape(-1, 2)
    return element_counts // 2, np.column_stack([xy_pairs, np.zeros(len(xy_pairs))])


def read_rows(get: Get, elements: Sequence[object], width: int, style: Style) -> Floats:
    """Return the numbers (N, width) of elements; NaN for null in JSON, and for missing elements of lists.

    Args:
        get: function from an element to its numbers.
    """
    element_count = len(elements)
    if style == "attributes":
        # np.fromiter is faster than np.array of a list of tuples, but refuses None
        with suppress(TypeError):
            numbers = chain.from_iterable(map(get, elements))
            return np.fromiter(numbers, np.float64, element_count * width).reshape(element_count, width)
    return np.array(list(map(get, elements)), np.float64).reshape(element_count, width)


def features_in(message: object) -> dict[str, object]:
    """Return the features of a foxglove.GeoJSON message, whose only field is a JSON text.

    Raises:
        ContentError: the text is not GeoJSON.
    """
    geojson_text = get_field(message, "geojson")
    try:
        geojson = json.loads(str(geojson_text))
    except (ValueError, RecursionError) as error:
        raise ContentError(f"geojson: it is not JSON: {error}") from None
    geojson_type = geojson.get("type") if isinstance(geojson, dict) else None
    if geojson_type == "FeatureCollection":
        return geojson  # type: ignore[no-any-return]
    if geojson_type is None:
        raise ContentError("geojson: it has no type, such as FeatureCollection")
    feature = (
        geojson if geojson_type == "Feature" else {"type": "Feature", "geometry": geojson, "properties": {}}
    )
    return {"features": [feature]}


def path_of_rings(path: FieldPath, example: object) -> FieldPath | None:
    """Return the path of the object with the rings at a path; None if the path leads to corners.

    A neighbouring field identifies rings: `type` next to `coordinates`, or `inner` next to `outer`.
    """
    for step_count, step in enumerate(path.steps):
        owner_path = FieldPath(path.text, path.steps[:step_count])
        neighbour_names = field_names(walk(owner_path, example))
        if (step == _OUTER and _INNER in neighbour_names) or (
            step == "coordinates" and "type" in neighbour_names
        ):
            return owner_path
    value = walk(path, example) if leads_somewhere(path, example) else None
    neighbour_names = field_names(value)
    # corners are lists in a list; rings are one level deeper
    has_rings = _INNER in neighbour_names or "coordinates" in neighbour_names or _depth(value) > 2
    return path if has_rings else None


def outlines_from_rings(holders: Sequence[Any]) -> tuple[Integers, Integers, Floats, int]:
    """Return outline counts (R,), corner counts, corners (V, 3), and the number of objects without polygon.

    A polygon without a hole is one outline. A polygon with holes is split into convex outlines. An object
    without a polygon gets one corner at NaN, which makes it unknown.

    Raises:
        ContentError: a ring crosses or touches itself or another ring.
    """
    outlines: list[Floats] = []
    outline_counts, empty_count = [], 0
    for holder in holders:
        polygon_outlines = [
            polygon_outline for rings in _polygons_in(holder) for polygon_outline in _pieces(rings)
        ]
        empty_count += not polygon_outlines
        outlines += polygon_outlines or [np.full((1, 3), np.nan)]
        outline_counts.append(max(1, len(polygon_outlines)))
    corner_counts = np.array([len(outline) for outline in outlines], np.int64)
    corners = np.concatenate(outlines) if outlines else np.empty((0, 3))
    return np.array(outline_counts, np.int64), corner_counts, corners, empty_count


def _polygons_in(holder: Any) -> list[Any]:
    """Return the polygons of an object, each as a list of rings."""
    holder_fields = field_names(holder)
    if _OUTER in holder_fields:
        rings = [get_field(holder, _OUTER), *get_field(holder, _INNER)]  # type: ignore[misc]
        return [[get_field(ring, "points") if "points" in field_names(ring) else ring for ring in rings]]
    if "type" in holder_fields:
        coordinates = get_field(holder, "coordinates") if "coordinates" in holder_fields else ()
        # points and lines cover no area
        polygons_by_type: dict[object, Any] = {"Polygon": [coordinates], "MultiPolygon": coordinates}
        return list(polygons_by_type.get(get_field(holder, "type"), ()))
    # a polygon has three levels of lists (rings, corners, numbers), a MultiPolygon has four
    return list(holder) if _depth(holder) > 3 else [holder]


def _depth(value: Any) -> int:
    """Return the depth of nested lists, 0 for other values."""
    return 1 + _depth(value[0]) if is_list(value) and len(value) else int(is_list(value))


def _pieces(rings: Sequence[Any]) -> list[Floats]:
    """Return the outlines (n, 3) of a polygon; [] if its outer ring has too few corners."""
    outer_ring, *holes = (_ring(ring) for ring in rings) if len(rings) else (np.empty((0, 3)),)
    if len(outer_ring) < _LEAST_CORNERS:
        return []
    holes = [hole for hole in holes if len(hole) >= _LEAST_CORNERS]
    if not holes:
        return [outer_ring]
    try:
        pieces = convex_pieces(outer_ring[:, :2], [hole[:, :2] for hole in holes])
    except GeometryError as error:
        raise ContentError(str(error)) from None
    return [np.column_stack([piece, np.full(len(piece), outer_ring[0, 2])]) for piece in pieces]


def _ring(corners: Any) -> Floats:
    """Return the corners (n, 3) of a ring, without a last corner that repeats the first corner."""
    _, points = points_from_lists([corners])
    # rings of GeoJSON are closed (RFC 7946, section 3.1.6), rings of polygon_msgs are open
    is_closed = len(points) > 1 and (points[0] == points[-1]).all()
    return points[:-1] if is_closed else points
