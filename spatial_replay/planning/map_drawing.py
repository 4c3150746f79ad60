"""Scenes of a planner's map and path: contour at the margin, axes, colour bar, target and path."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from spatial_replay.annotate.scene.scene_frames import cell_colours
from spatial_replay.annotate.scene.scene_template import FRAME, outlines_of
from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import Footprint, TrackedObject, moved_object
from spatial_replay.palette import LABEL, NEUTRAL, POSITIVE
from spatial_replay.planning.decisions import Target
from spatial_replay.planning.maps import GradientMap
from spatial_replay.text import number_text

_MAP, _PATH, _TRAVELLED = "plan/map", "plan/way", "plan/travelled"
OBSTACLE: Final = "plan/obstacle/"
"""Prefix of the ids of the workspace's obstacles; an obstacle's name follows the prefix."""

DEPTH: Final = 0.1
"""Depth of a map below the plane, cells; a map in the plane would hide regions."""
_FRAME_DEPTH: Final = 0.5 * DEPTH
"""Depth of lines on a map, cells."""

_PIXELS: Final = 3.0
"""Width of a path on the screen, pixels."""
_CASING_PIXELS: Final = 6.0
"""Width of the white line below a path, pixels."""
_THIN_PIXELS: Final = 1.5
"""Width of axes and contours, pixels."""

_OBSTACLE_OPACITY: Final = 0.6
_BLOCKED_OPACITY: Final = 0.3
_NO_OBSTACLES: Final[Mapping[str, Footprint]] = MappingProxyType({})

_INK: Final = (0.1, 0.1, 0.1)
_WHITE: Final = (1.0, 1.0, 1.0)

_FONT, _TICK, _GAP, _BAR = 0.036, 0.012, 0.03, 0.04
"""Text height, tick length, and distance and width of the colour bar, as shares of the map's size."""

_SHADES: Final = 17
"""Number of colours on the colour bar."""
_MOST_TICKS: Final = 6
"""Maximum number of ticks on an axis."""


class MapFrame(NamedTuple):
    """Lines, texts and faces around a map, and the height of the lines, footprint units."""

    entity: SceneEntity
    height: float
    obstacles: tuple[SceneEntity, ...] = ()


def map_frame(
    gradient: GradientMap, turn: int, margin: float, obstacles: Mapping[str, Footprint] = _NO_OBSTACLES
) -> MapFrame:
    """Return the contour of a map at the margin, axes, a colour bar with numbers, and obstacles.

    Args:
        turn: index of the map's orientation.
        margin: required robustness of a target.
        obstacles: obstacles of the workspace by name.
    """
    grid, values = gradient.grid, gradient.values[turn]
    low_corner = grid.xmin, grid.ymin
    high_corner = grid.xmin + grid.columns * grid.cell_size, grid.ymin + grid.rows * grid.cell_size
    entity, height = SceneEntity(id=_MAP, frame_id=FRAME), -_FRAME_DEPTH * grid.cell_size
    _add_blocked_cells(entity, np.isnan(values), low_corner, grid.cell_size, height)
    contour = _contour(values, margin) * grid.cell_size + np.array(low_corner)
    if len(contour):
        entity.lines.append(
            _line(contour.tolist(), height, _INK, LinePrimitive.LINE_LIST, pixels=_THIN_PIXELS)
        )
    _add_axes(entity, low_corner, high_corner, height)
    greatest_value = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
    if greatest_value:
        _add_scale(entity, low_corner, high_corner, height, greatest_value, margin)
    font_size = _FONT * max(high_corner[0] - low_corner[0], high_corner[1] - low_corner[1])
    entities = (_obstacle(name, footprint, height, font_size) for name, footprint in obstacles.items())
    return MapFrame(entity, height, tuple(entities))


def _obstacle(name: str, obstacle: Footprint, height: float, font_size: float) -> SceneEntity:
    """Return the outline, the grey area and the name of an obstacle."""
    entity = SceneEntity(id=f"{OBSTACLE}{name}", frame_id=FRAME)
    rings = [ring.tolist() for ring in outlines_of(obstacle)]
    for ring in rings:
        entity.lines.append(_line(ring, height, NEUTRAL, LinePrimitive.LINE_LOOP))
        area = entity.triangles.add()
        area.pose.position.z, area.pose.orientation.w = height, 1.0
        for x, y in ring:
            area.points.add(x=x, y=y)
        area.color.r, area.color.g, area.color.b, area.color.a = *NEUTRAL, _OBSTACLE_OPACITY
        # parts of footprints are convex
        for corner in range(1, len(ring) - 1):
            area.indices.extend((0, corner, corner + 1))
    xs, ys = zip(*(point for ring in rings for point in ring), strict=True)
    # the name is above the area, because the area would cover it
    _add_text(entity, name, ((min(xs) + max(xs)) / 2.0, max(ys) + 0.75 * font_size), height, font_size)
    return entity


def map_drawing(
    frame: MapFrame | None, target: Target | None, tracked: TrackedObject | None, time_ns: int
) -> SceneUpdate:
    """Return the message that draws the newest map, or an empty message without a map.

    The path, and the object's outline at the target, have a white edge to be visible on blue cells.
    """
    message = SceneUpdate()
    if frame is not None:
        entity = message.entities.add()
        entity.CopyFrom(frame.entity)
        message.entities.extend(frame.obstacles)
        for part in message.entities:
            part.timestamp.FromNanoseconds(time_ns)
        if target is not None and tracked is not None:
            entity.lines.extend(_path_lines(target, tracked, frame.height, _WHITE, _CASING_PIXELS))
    return message


def _add_blocked_cells(
    entity: SceneEntity, blocked: Booleans, low_corner: tuple[float, float], cell_size: float, height: float
) -> None:
    """Add a grey area for the blocked cells, which are transparent in the map; free cells at 0 are white."""
    changes = np.diff(np.pad(blocked, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, starts = np.nonzero(changes == 1)
    ends = np.nonzero(changes == -1)[1]
    area = entity.triangles.add()
    area.pose.position.z, area.pose.orientation.w = height, 1.0
    area.color.r, area.color.g, area.color.b, area.color.a = *NEUTRAL, _BLOCKED_OPACITY
    for run_index, (row, start, end) in enumerate(
        zip(rows.tolist(), starts.tolist(), ends.tolist(), strict=True)
    ):
        for column, row_line in ((start, row), (end, row), (end, row + 1), (start, row + 1)):
            area.points.add(x=low_corner[0] + column * cell_size, y=low_corner[1] + row_line * cell_size)
        area.indices.extend(4 * run_index + corner for corner in (0, 1, 2, 0, 2, 3))


def _contour(values: Floats, margin: float) -> Floats:
    """Return the borders (2 N, 2), cells, between free cells that reach a margin and other free cells."""
    across = _run_ends(values[:-1], values[1:], margin) + np.array([1.0, 0.0])
    along = _run_ends(values[:, :-1].T, values[:, 1:].T, margin) + np.array([1.0, 0.0])
    return np.concatenate([across[:, ::-1], along])


def _run_ends(first_rows: Floats, second_rows: Floats, margin: float) -> Floats:
    """Return the ends (2 N, 2) of runs of columns in which only one of two adjacent rows reaches the margin.

    An end is (index of the first row, column).
    """
    is_parted: Booleans = (
        np.isfinite(first_rows)
        & np.isfinite(second_rows)
        & ((first_rows >= margin) != (second_rows >= margin))
    )
    changes = np.diff(np.pad(is_parted, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    return np.argwhere(changes).astype(np.float64)


def _add_axes(
    entity: SceneEntity, low_corner: tuple[float, float], high_corner: tuple[float, float], height: float
) -> None:
    """Add a frame with ticks and coordinates below and on the left."""
    map_size = max(high_corner[0] - low_corner[0], high_corner[1] - low_corner[1])
    corners = [low_corner, (high_corner[0], low_corner[1]), high_corner, (low_corner[0], high_corner[1])]
    entity.lines.append(_line(corners, height, NEUTRAL, LinePrimitive.LINE_LOOP, pixels=_THIN_PIXELS))
    ticks: list[tuple[float, float]] = []
    for x in _round_numbers(low_corner[0], high_corner[0]):
        ticks += [(x, low_corner[1]), (x, low_corner[1] - _TICK * map_size)]
        _add_text(
            entity, number_text(x), (x, low_corner[1] - (_TICK + _FONT) * map_size), height, _FONT * map_size
        )
    for y in _round_numbers(low_corner[1], high_corner[1]):
        ticks += [(low_corner[0], y), (low_corner[0] - _TICK * map_size, y)]
        text = number_text(y)
        text_x = low_corner[0] - (2.0 * _TICK + _half_width(text)) * map_size
        _add_text(entity, text, (text_x, y), height, _FONT * map_size)
    entity.lines.append(_line(ticks, height, NEUTRAL, LinePrimitive.LINE_LIST, pixels=_THIN_PIXELS))


def _add_scale(
    entity: SceneEntity,
    low_corner: tuple[float, float],
    high_corner: tuple[float, float],
    height: float,
    greatest_value: float,
    margin: float,
) -> None:
    """Add the colour bar on the right, with numbers at its ends, at 0 and at the margin."""
    map_size = max(high_corner[0] - low_corner[0], high_corner[1] - low_corner[1])
    bar_left, bar_right = high_corner[0] + _GAP * map_size, high_corner[0] + (_GAP + _BAR) * map_size
    bar_values = np.linspace(-greatest_value, greatest_value, _SHADES)
    bar_levels = np.linspace(low_corner[1], high_corner[1], _SHADES)
    bar = entity.triangles.add()
    bar.pose.position.z, bar.pose.orientation.w = height, 1.0
    for level, colour in zip(bar_levels.tolist(), (cell_colours(bar_values) / 255.0).tolist(), strict=True):
        for x in (bar_left, bar_right):
            bar.points.add(x=x, y=level)
            bar.colors.add(r=colour[0], g=colour[1], b=colour[2], a=colour[3])
    for corner in range(0, 2 * (_SHADES - 1), 2):
        bar.indices.extend((corner, corner + 1, corner + 2, corner + 1, corner + 3, corner + 2))
    ticks: list[tuple[float, float]] = []
    levels_of_texts: list[float] = []
    for tick_value in dict.fromkeys((0.0, greatest_value, -greatest_value, margin)):
        level = (low_corner[1] + high_corner[1]) / 2.0 + tick_value / greatest_value * (
            high_corner[1] - low_corner[1]
        ) / 2.0
        if abs(tick_value) > greatest_value:
            continue
        ticks += [(bar_left, level), (bar_right + _TICK * map_size, level)]
        if all(abs(level - other_level) >= _FONT * map_size for other_level in levels_of_texts):
            levels_of_texts.append(level)
            text = number_text(tick_value)
            x = bar_right + (2.0 * _TICK + _half_width(text)) * map_size
            _add_text(entity, text, (x, level), height, _FONT * map_size)
    entity.lines.append(_line(ticks, height, NEUTRAL, LinePrimitive.LINE_LIST, pixels=_THIN_PIXELS))


def _half_width(text: str) -> float:
    """Return half the width of a text as a share of the map's size; a digit is half as wide as high."""
    return 0.25 * _FONT * (len(text) + 1)


def _round_numbers(low: float, high: float) -> Iterator[float]:
    """Yield the multiples of a round number in an interval, at most `_MOST_TICKS`."""
    least_step = (high - low) / (_MOST_TICKS - 1)
    power = 10.0 ** math.floor(math.log10(least_step))
    tick_step = next(
        factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least_step * (1 - 1e-9)
    )
    # without the tolerances, rounding could drop ticks at the ends
    for multiple in range(math.ceil(low / tick_step - 1e-9), math.floor(high / tick_step + 1e-9) + 1):
        yield multiple * tick_step


def _add_text(
    entity: SceneEntity, text: str, position: tuple[float, float], height: float, font_size: float
) -> None:
    """Add a text that scales with the map, at any distance of the viewer's camera."""
    label = entity.texts.add(billboard=True, font_size=font_size, text=text)
    label.pose.position.x, label.pose.position.y, label.pose.position.z = *position, height
    label.pose.orientation.w = 1.0
    label.color.r, label.color.g, label.color.b, label.color.a = *LABEL, 1.0


def path_message(
    target: Target | None,
    tracked: TrackedObject | None,
    time_ns: int,
    travelled: Sequence[tuple[float, float]] = (),
) -> SceneUpdate:
    """Return the message with the planned path, the object's outline at the target, and the travelled path.

    Without a target, the message deletes the earlier drawing.
    """
    lines_by_id: dict[str, list[LinePrimitive]] = {_PATH: [], _TRAVELLED: []}
    if target is not None and tracked is not None:
        height = 0.0 if tracked.height is None else tracked.height[1]
        lines_by_id[_PATH] = _path_lines(target, tracked, height, POSITIVE)
        if travelled:
            lines_by_id[_TRAVELLED] = [_line(travelled, height, NEUTRAL)]
    message = SceneUpdate()
    for identifier, lines_of_entity in lines_by_id.items():
        if lines_of_entity:
            entity = message.entities.add(id=identifier, frame_id=FRAME, lines=lines_of_entity)
            entity.timestamp.FromNanoseconds(time_ns)
        else:
            deletion = message.deletions.add(type=SceneEntityDeletion.MATCHING_ID, id=identifier)
            deletion.timestamp.FromNanoseconds(time_ns)
    return message


def _path_lines(
    target: Target,
    tracked: TrackedObject,
    height: float,
    colour: tuple[float, float, float],
    pixels: float = _PIXELS,
) -> list[LinePrimitive]:
    """Return the path to a target, and the object's outlines at the target."""
    at_target = moved_object(tracked, target.x, target.y, target.turn)
    rings = [ring.tolist() for ring in outlines_of(at_target.footprint)]
    outlines = [_line(ring, height, colour, LinePrimitive.LINE_LOOP, pixels=pixels) for ring in rings]
    return [_line(target.waypoints, height, colour, pixels=pixels), *outlines]


def _line(
    points: Iterable[Sequence[float]],
    height: float,
    colour: tuple[float, float, float],
    line_type: LinePrimitive.Type.ValueType = LinePrimitive.LINE_STRIP,
    *,
    pixels: float = _PIXELS,
) -> LinePrimitive:
    """Return a line through points (x, y) at a height, footprint units; its width is in pixels."""
    # scale_invariant: the thickness is in pixels (https://docs.foxglove.dev/docs/sdk/schemas/line-primitive)
    line = LinePrimitive(type=line_type, thickness=pixels, scale_invariant=True)
    line.pose.position.z, line.pose.orientation.w = height, 1.0
    for x, y in points:
        line.points.add(x=x, y=y)
    line.color.r, line.color.g, line.color.b, line.color.a = *colour, 1.0
    return line
