"""Targets: the best cell of an object's gradient map or, for a push, the nearest good cell within reach.

Refinement on finer grids then moves a target from the centre of its cell to a better place and turn nearby.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import TrackedObject, centre_of, radius_of
from spatial_replay.monitor.atoms.terms import seam_texts
from spatial_replay.planning.decisions import Candidate, Target, points_along
from spatial_replay.planning.maps import (
    CONSTRAINED,
    FREE,
    OUT_OF_REACH,
    REASONS,
    GradientMap,
    MapSubject,
    avoided_cells,
    danger_of,
    distance_to,
    proposition_maps,
)
from spatial_replay.planning.paths import Path, lengths_from, shortest_path
from spatial_replay.planning.settings import Grid, Settings
from spatial_replay.spec.format import format_term
from spatial_replay.spec.formula import Atom, Term, TrackedName
from spatial_replay.spec.walks import base_of, iter_formulas

_COARSEST: Final = 0.5
"""First spacing of the refinement, cells."""
_HALVED: Final = 4
"""Number of times that the spacing is halved."""
_MOST_GRIDS: Final = 12
"""Maximum number of measured grids for one target."""
_FARTHEST: Final = 2.0
"""Maximum distance of a refined target from the unrefined target, along x and along y, cells."""
_SAME: Final = 0.25
"""Distance up to which two poses count as the same, cells."""
_SAME_TURN: Final = math.radians(3.0)
"""Angle up to which two poses count as the same, radians."""
_BETTER: Final = 1e-9
"""Least gain of robustness in a step of the refinement."""

_ASIDE: Final = math.radians(35.0)
"""Least angle between the directions of a failed push and of a further push, radians."""
_PLACES_IN_CELL: Final = 4
"""Number of tested points in each cell along a leg of a path."""
_SWEPT: Final = math.radians(10.0)
"""Maximum angle between tested orientations during a turn on the spot, radians."""

Measured = Callable[[Grid, tuple[float, ...]], tuple[GradientMap, Floats]]
"""Function from a grid and orientations (yaws) to an object's map and its room."""

NOWHERE: Final = "no place is good enough"
"""Beginning of the reason if all places are below the margin."""
_EQUAL: Final = 1e-9
"""Difference of robustness up to which cells count as equally robust."""


def find_target(
    gradient: GradientMap,
    tracked: TrackedObject,
    settings: Settings,
    room: Floats,
    failed: Collection[tuple[float, float]] = (),
    failures: Sequence[Target] = (),
) -> Target | str:
    """Return the target for an object, or the reason why there is no target.

    Args:
        gradient: map of the progress set.
        tracked: object before the motion.
        room: (A, rows, columns), distance to the objects from which the target keeps room.
        failed: places (x, y) where earlier motions failed.
        failures: targets of failed motions in the current scene.
    """
    is_good = good_cells(gradient, settings, failed, failures)
    if not is_good.any():
        return _why_nowhere(gradient, settings, bool(failed))
    if settings.skill == "place":
        is_roomy = is_good & (room >= least_room(is_good, room, settings, failures))
        cell_values = np.where(is_roomy, gradient.robustness, -np.inf)
        # the nearest of equally robust cells
        distance = distance_to([centre_of(tracked.footprint)], gradient.grid)
        cell_values = np.where(cell_values >= cell_values.max() - _EQUAL, -distance, -np.inf)
        return _best_target(gradient, cell_values, tracked)
    return _nearest_cell(gradient, is_good, tracked, settings, failures)


def good_cells(
    gradient: GradientMap,
    settings: Settings,
    failed: Collection[tuple[float, float]] = (),
    failures: Sequence[Target] = (),
) -> Booleans:
    """Return whether each cell is suitable as a target, (A, rows, columns); arguments as in `find_target`."""
    is_met = (gradient.blocked == FREE) & (gradient.robustness >= settings.margin)
    is_good: Booleans = is_met & ~avoided_cells(gradient, settings, failed)
    if settings.skill == "place" and failures:
        # cells at least a finger's width from failed targets; without such cells, all poses that did not fail
        for radius in (_spread(settings), _SAME * _cell(settings)):
            is_untried = is_good & ~tried_poses(gradient, failures, radius)
            if is_untried.any():
                return is_untried
    return is_good


def tried_cells(candidate: Candidate, settings: Settings) -> Booleans:
    """Return whether only failed motions of a candidate make a cell unsuitable, (A, rows, columns)."""
    gradient = candidate.map
    is_good = good_cells(gradient, settings, candidate.failed, candidate.failures)
    return np.asarray((gradient.blocked == FREE) & (gradient.robustness >= settings.margin) & ~is_good)


def least_room(good: Booleans, room: Floats, settings: Settings, failures: Sequence[Target] = ()) -> float:
    """Return the room that a placed object keeps; -inf if no cell has the preferred room.

    Args:
        good: (A, rows, columns), whether each cell is suitable as a target.
        room, failures: as in `find_target`.
    """
    # after failures, cells with the most room are required if no cell has the preferred room
    most_room = float(room[good].max(initial=-math.inf))
    preferred = min(settings.room, most_room) if failures else settings.room
    return preferred if most_room >= preferred else -math.inf


def target_in(
    gradient: GradientMap,
    tracked: TrackedObject,
    settings: Settings,
    pose: tuple[float, float, float],
    failures: Sequence[Target] = (),
) -> Target | str:
    """Return the target at a pose (x, y, turn) of an object's map, or the reason why it is impossible."""
    cell = gradient.cell_of(*pose)
    if gradient.blocked[cell] != FREE:
        return REASONS[gradient.blocked[cell]]
    goal_cells = np.zeros(gradient.blocked.shape, np.bool_)
    goal_cells[cell] = True
    if settings.skill == "place":
        return _target(gradient, tracked, cell, (centre_of(tracked.footprint), pose[:2]))
    return _nearest_cell(gradient, goal_cells, tracked, settings, failures)


def nearest_target(
    gradient: GradientMap,
    good: np.ndarray,
    tracked: TrackedObject,
    settings: Settings,
    failures: Sequence[Target] = (),
) -> Target | str:
    """Return the target in the nearest of `good` cells (A, rows, columns), or the reason for no target."""
    if not good.any():
        return "there is no place for it"
    if settings.skill == "push":
        return _nearest_cell(gradient, good, tracked, settings, failures)
    distance = distance_to([centre_of(tracked.footprint)], gradient.grid)
    return _best_target(gradient, np.where(good, -distance, -np.inf), tracked)


def _best_target(gradient: GradientMap, cell_values: Floats, tracked: TrackedObject) -> Target:
    turn, row, column = (
        int(index) for index in np.unravel_index(int(np.argmax(cell_values)), cell_values.shape)
    )
    start, end = centre_of(tracked.footprint), gradient.grid.centre(row, column)
    return _target(gradient, tracked, (turn, row, column), (start, end))


def _nearest_cell(
    gradient: GradientMap,
    goal_cells: np.ndarray,
    tracked: TrackedObject,
    settings: Settings,
    failures: Sequence[Target],
) -> Target | str:
    start = centre_of(tracked.footprint)
    if not gradient.grid.contains(np.array(start)):
        return "it lies too far outside the workspace"
    cell = gradient.grid.cell(*start)
    failed_cells = _failed_directions(gradient.grid, tracked, failures)
    entry_path = _path_into_reach(gradient, cell, settings, failed_cells)
    if entry_path is None:
        return "no free path leads into reach" + _but_for(failures)
    row, column = entry_path.cells[-1].tolist()
    is_free = (gradient.blocked[0] == FREE) & ~failed_cells
    path_by_layer = {0: shortest_path(is_free, (row, column), goal_cells[0])}
    if path_by_layer[0] is None:
        # other orientations are tried only if the object cannot keep its orientation
        for layer in range(1, len(gradient.turns)):
            goals = _turnable(gradient, layer, goal_cells[layer] & is_free, settings)
            path_by_layer[layer] = shortest_path(is_free, (row, column), goals)
    routes = [(path.length, layer, path) for layer, path in path_by_layer.items() if path is not None]
    if not routes:
        return "no free path leads to a good place" + _but_for(failures)
    _, best_layer, path = min(routes, key=lambda route: route[0])
    cells = [(row, column) for row, column in (*entry_path.cells.tolist(), *path.cells[1:].tolist())]
    # an object off the centre of its cell need not start at this centre
    first_corner = 0
    if cells[0] == cell and len(cells) > 1:
        first_corner = int(is_clear_leg(gradient, (start, gradient.grid.centre(*cells[1])), settings))
    corners = [gradient.grid.centre(*corner) for corner in cells[first_corner:]]
    waypoints = (start, *corners)
    # after a failed push, a straight first leg might begin in the failed direction again
    if not failures:
        waypoints = _without_corners(waypoints, gradient, is_free, settings)
    return _target(gradient, tracked, (best_layer, *cells[-1]), waypoints)


class Ways(NamedTuple):
    """Ways of a pushed object over cells.

    Attributes:
        lengths: (rows, columns), length of the shortest way to each cell; inf without a way.
        shortest: length of the shortest way to a suitable cell.
        end: centre of the suitable cell at this length that is nearest to the target.
    """

    lengths: Floats
    shortest: float
    end: tuple[float, float]


def ways_of(candidate: Candidate, target: Target, settings: Settings) -> Ways | None:
    """Return the ways that `find_target` compares for a push; None if there is no way."""
    gradient, failures = candidate.map, candidate.failures
    grid = gradient.grid
    tracked = gradient.made_of.now.about.sample.objects[candidate.name]
    failed_cells = _failed_directions(grid, tracked, failures)
    entry_path = _path_into_reach(gradient, grid.cell(*centre_of(tracked.footprint)), settings, failed_cells)
    if entry_path is None:
        return None
    is_free = (gradient.blocked[0] == FREE) & ~failed_cells
    row, column = entry_path.cells[-1].tolist()
    lengths = (entry_path.length + lengths_from(is_free, (row, column))) * grid.cell_size
    layer, *_ = gradient.cell_of(*target.pose)
    is_good = good_cells(gradient, settings, candidate.failed, failures)[layer]
    if layer:
        is_turnable = _turnable(gradient, layer, is_good & is_free, settings)
        lengths = np.where(is_good & ~is_turnable, np.inf, lengths)
    good_lengths = np.where(is_good, lengths, np.inf)
    shortest = float(good_lengths.min())
    if not math.isfinite(shortest):
        return None
    target_distance = distance_to([(target.x, target.y)], grid)
    end_distance = np.where(good_lengths <= shortest * (1.0 + _EQUAL), target_distance, np.inf)
    row, column = (int(index) for index in np.unravel_index(int(np.argmin(end_distance)), end_distance.shape))
    return Ways(lengths, shortest, grid.centre(row, column))


def _without_corners(
    waypoints: Sequence[tuple[float, float]], gradient: GradientMap, free: Booleans, settings: Settings
) -> tuple[tuple[float, float], ...]:
    """Return a path in which straight legs over free and clear cells replace corners.

    A pushing robot has to take hold again at each corner.
    """
    grid = gradient.grid
    least_clearance = settings.workspace.clearance + grid.cell_size / math.sqrt(2.0)
    passable_cells = free & (gradient.clearance[0] > least_clearance)

    def is_passable(leg: Sequence[tuple[float, float]]) -> bool:
        points = points_along(leg, grid.cell_size / _PLACES_IN_CELL)
        return all(passable_cells[grid.cell(*point)] for point in points)

    corners, remaining_points = [waypoints[0]], list(waypoints[1:])
    while remaining_points:
        farthest = next(
            (
                index
                for index in range(len(remaining_points) - 1, 0, -1)
                if is_passable((corners[-1], remaining_points[index]))
            ),
            0,
        )
        corners.append(remaining_points[farthest])
        remaining_points = remaining_points[farthest + 1 :]
    return tuple(corners)


def _turnable(gradient: GradientMap, layer: int, goals: Booleans, settings: Settings) -> Booleans:
    """Return whether an object can be turned to a layer's orientation in each goal cell, (rows, columns)."""
    # only the box around the goals is measured, instead of the whole grid
    is_turnable = np.zeros(goals.shape, np.bool_)
    if goals.any():
        first_row, first_column = np.argwhere(goals).min(axis=0).tolist()
        end_row, end_column = (np.argwhere(goals).max(axis=0) + 1).tolist()
        grid, size = gradient.grid, gradient.grid.cell_size
        corner = grid.xmin + first_column * size, grid.ymin + first_row * size
        goal_grid, turn = (
            Grid(*corner, size, end_column - first_column, end_row - first_row),
            float(gradient.turns[layer]),
        )
        is_turnable[first_row:end_row, first_column:end_column] = can_turn_in(
            goal_grid, gradient, turn, settings
        )
    return is_turnable & goals


def can_turn_in(grid: Grid, gradient: GradientMap, turn: float, settings: Settings) -> Booleans:
    """Return whether a map's object can turn on the spot in each cell of a grid, (rows, columns).

    At several orientations during the turn, no obstacle may touch the object and no constraint may hold.
    """
    step_count = math.ceil(abs(turn) / _SWEPT)
    map_subject = gradient.made_of.now.about
    yaw = map_subject.sample.objects[gradient.name].yaw or 0.0
    yaws = tuple(yaw + turn * number / step_count for number in range(1, step_count))
    if not yaws:
        return np.ones(grid.shape, np.bool_)
    workspace = replace(settings.workspace, yaws=yaws, keeps_yaw=False)
    maps = proposition_maps(*map_subject, gradient.name, workspace, grid)
    is_kept = danger_of(maps, gradient.made_of.constraints) < -settings.constraint_margin
    return np.asarray(((maps.clearance > workspace.clearance) & is_kept).all(axis=0))


def _but_for(failures: Sequence[Target]) -> str:
    return ", other than by motions that failed" if failures else ""


def is_clear_leg(gradient: GradientMap, leg: Sequence[tuple[float, float]], settings: Settings) -> bool:
    """Return whether a map's object stays clear on a straight leg, including points between cell centres."""
    grid, workspace = gradient.grid, settings.workspace
    points = list(points_along(leg, grid.cell_size / _PLACES_IN_CELL))
    # anywhere in a cell, the clearance is at most half a diagonal less than at the centre
    least_clearance = workspace.clearance + grid.cell_size / math.sqrt(2.0)
    if all(gradient.clearance[0][grid.cell(*point)] > least_clearance for point in points):
        return True
    # maps of one cell without propositions measure only the clearance
    map_subject = gradient.made_of.now.about
    return all(
        proposition_maps(
            (), map_subject.regions, map_subject.sample, gradient.name, workspace, _spot(x, y, grid.cell_size)
        ).clearance[0, 0, 0]
        > workspace.clearance
        # the first point is the object's current place
        for x, y in points[1:]
    )


def _spot(x: float, y: float, size: float) -> Grid:
    return Grid(x - size / 2, y - size / 2, size, 1, 1)


def _failed_directions(grid: Grid, tracked: TrackedObject, failures: Sequence[Target]) -> Booleans:
    """Return the cells (rows, columns) near an object that are roughly in the direction of a failed push."""
    failed_cells = np.zeros(grid.shape, np.bool_)
    centre, radius = centre_of(tracked.footprint), radius_of(tracked)
    offsets = (grid.centres() - np.array(centre)).reshape(*grid.shape, 2)
    distances = np.hypot(offsets[..., 0], offsets[..., 1])
    for failure in failures:
        angle = _beginning(failure, radius)
        forward_distances = offsets @ np.array([math.cos(angle), math.sin(angle)])
        failed_cells |= (
            (distances > grid.cell_size)
            & (distances <= radius)
            & (forward_distances >= math.cos(_ASIDE) * distances)
        )
    return failed_cells


def begins_as(target: Target, failures: Sequence[Target], tracked: TrackedObject) -> bool:
    """Return whether a push begins roughly in the direction of a failed push."""
    radius = radius_of(tracked)
    direction = _beginning(target, radius)
    angles = (math.remainder(direction - _beginning(failure, radius), math.tau) for failure in failures)
    return any(abs(angle) < _ASIDE / 2.0 for angle in angles)


def _beginning(target: Target, distance: float) -> float:
    """Return the first direction of a path: the angle to the point at a distance, or to the end."""
    start, points = target.waypoints[0], points_along(target.waypoints, distance / 8.0)
    x, y = next((point for point in points if math.dist(point, start) >= distance), target.waypoints[-1])
    return math.atan2(y - start[1], x - start[0])


def _path_into_reach(
    gradient: GradientMap, cell: tuple[int, int], settings: Settings, failed_cells: Booleans
) -> Path | None:
    """Return the path to the nearest free cell.

    A path may cross cells out of reach only if it starts out of reach. It may cross constrained cells only if
    its first cell is not passable. It never crosses occupied cells: from an occupied cell, it starts at the
    nearest passable cell.
    """
    is_free = gradient.blocked[0] == FREE
    is_reached = settings.workspace.within_reach(gradient.grid)[cell]
    is_passable = is_free if is_reached else is_free | (gradient.blocked[0] == OUT_OF_REACH)
    if not is_passable[cell]:
        is_empty = gradient.clearance[0] > settings.workspace.clearance
        is_passable = is_passable | (is_empty & (gradient.blocked[0] == CONSTRAINED))
    is_passable = is_passable & ~failed_cells
    return shortest_path(is_passable, cell if is_passable[cell] else _nearest(is_passable, cell), is_free)


def _nearest(cells: np.ndarray, cell: tuple[int, int]) -> tuple[int, int]:
    indices = np.argwhere(cells)
    row, column = indices[int(np.argmin(((indices - np.array(cell)) ** 2).sum(axis=1)))].tolist()
    return row, column


def _target(
    gradient: GradientMap,
    tracked: TrackedObject,
    cell: tuple[int, int, int],
    waypoints: tuple[tuple[float, float], ...],
) -> Target:
    x, y = waypoints[-1]
    turn = float(gradient.turns[cell[0]])
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return Target(gradient.name, x, y, turn, yaw, waypoints, float(gradient.robustness[cell]))


def _why_nowhere(gradient: GradientMap, settings: Settings, has_failed: bool) -> str:
    is_enough = gradient.robustness >= settings.margin
    if not is_enough.any():
        best_robustness = float(gradient.robustness.max())
        if size_text := _why_too_large(gradient):
            return size_text
        map_subject = gradient.made_of.then.about
        formulas = [
            map_subject.propositions[number] for cube in gradient.made_of.progress for number, _ in cube
        ]
        sentence = f"{NOWHERE}: {best_robustness:.4g} at best, {settings.margin:.4g} needed"
        return "; ".join([sentence, *seam_texts(formulas, map_subject.regions)])
    counts_by_reason = np.bincount(gradient.blocked[is_enough], minlength=len(REASONS))
    if counts_by_reason[FREE] and has_failed:
        return "it was tried wherever it would hold"
    count_reasons = zip(counts_by_reason[1:].tolist(), REASONS[1:], strict=True)
    causes = ", ".join(f"{count} cells: {reason}" for count, reason in count_reasons if count)
    return f"blocked wherever it would hold: {causes}"


def _why_too_large(gradient: GradientMap) -> str:
    """Return a sentence on a region or object that is too small to enclose a map's object, or ""."""
    map_subject = gradient.made_of.then.about
    formulas = [
        map_subject.propositions[number]
        for cube in gradient.made_of.progress
        for number, value in cube
        if value
    ]
    for formula in formulas:
        for atom in iter_formulas(formula):
            if not isinstance(atom, Atom) or atom.relation != "enclosedin":
                continue
            inner, outer = (_outlines_of(term, map_subject) for term in atom.terms)
            if getattr(atom.terms[0], "name", "") != gradient.name or not inner or not outer:
                continue
            outer_size = _extent(outer, 0.0)
            excess = min(float((_extent(inner, turn) - outer_size).max()) for turn in gradient.turns.tolist())
            if excess > 0.0:
                return f"{gradient.name} is {excess:.3g} too large for {format_term(atom.terms[1])}"
    return ""


_Rounded: TypeAlias = tuple[Floats, float]
"""Corners (N, 2) and rounding radius of an outline."""


def _outlines_of(term: Term, map_subject: MapSubject) -> list[_Rounded]:
    """Return the outlines of an object or region; no outlines for other terms."""
    name = getattr(term, "name", "")
    if isinstance(term, TrackedName) and name in map_subject.sample.objects:
        return [(part.vertices, part.radius) for part in map_subject.sample.objects[name].footprint.parts]
    if base_of(term) is term and (outline := map_subject.regions.get(name)) is not None:
        return [(np.array(outline.vertices), outline.radius)]
    return []


def _extent(outlines: Sequence[_Rounded], turn: float) -> Floats:
    """Return the widths (2,) of outlines along x and y, after a turn of the outlines."""
    cosine, sine = math.cos(turn), math.sin(turn)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    turned_outlines = [(vertices @ rotation, radius) for vertices, radius in outlines]
    highest = np.max([vertices.max(axis=0) + radius for vertices, radius in turned_outlines], axis=0)
    lowest = np.min([vertices.min(axis=0) - radius for vertices, radius in turned_outlines], axis=0)
    return np.asarray(highest - lowest)


# ----------------------------------------------------------------------------------------------- refinement


def refine_target(
    target: Target,
    tracked: TrackedObject,
    settings: Settings,
    measure: Measured,
    failures: Sequence[Target] = (),
) -> Target:
    """Return the most robust target near a target, or the target itself.

    This is a compass search: each step takes the best of 5 x 5 places around the newest place, with up to
    three orientations each. If no place is better, the spacing is halved. Only free places are allowed. If
    the target has the preferred room, only places with the preferred room are allowed.

    Args:
        tracked: object before the motion.
        measure: function that measures maps around the target.
        failures: targets of failed motions, which are avoided if possible.
    """
    size = settings.workspace.grid.cell_size
    spacing, turn_spacing, halvings = _COARSEST * size, _widest_turn(target, tracked, settings) / 2.0, 0
    pose, best_robustness, required_room = target.pose, target.robustness, -math.inf
    avoided_radius = _spread(settings)
    if is_repeated(target, failures, settings):
        # every other place with the required margin is better
        best_robustness = settings.margin - 2.0 * _BETTER
    if _is_near(target, failures, avoided_radius):
        avoided_radius = _SAME * _cell(settings)
    for grid_number in range(_MOST_GRIDS):
        x, y, turn = pose
        corner = x - 2.5 * spacing, y - 2.5 * spacing
        turn_offsets = [0.0] if turn_spacing == 0.0 else [-turn_spacing, 0.0, turn_spacing]
        yaws = (
            tuple((tracked.yaw or 0.0) + turn + offset for offset in turn_offsets)
            if settings.workspace.yaws
            else ()
        )
        gradient, room = measure(Grid(*corner, spacing, 5, 5), yaws)
        # other places need the preferred room only if the target itself has the preferred room
        if grid_number == 0:
            middle = len(gradient.turns) // 2, 2, 2
            required_room = settings.room if room[middle] >= settings.room else -math.inf
        is_good = (
            (gradient.blocked == FREE) & (room >= required_room) & _near(gradient, target, tracked, settings)
        )
        is_good &= ~tried_poses(gradient, failures, avoided_radius)
        cell_values = np.where(is_good, gradient.robustness, -np.inf)
        best_cell = tuple(map(int, np.unravel_index(int(np.argmax(cell_values)), cell_values.shape)))
        if cell_values[best_cell] > best_robustness + _BETTER:
            best_robustness = float(cell_values[best_cell])
            pose = (*gradient.grid.centre(*best_cell[1:]), float(gradient.turns[best_cell[0]]))
        elif halvings == _HALVED:
            break
        else:
            spacing, turn_spacing, halvings = spacing / 2.0, turn_spacing / 2.0, halvings + 1
    if pose == target.pose:
        return target
    x, y, turn = pose
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return Target(target.name, x, y, turn, yaw, (*target.waypoints[:-1], (x, y)), best_robustness)


def tried_poses(gradient: GradientMap, failures: Sequence[Target], radius: float) -> Booleans:
    """Return whether each pose of a map is within a radius of a failed target, (A, rows, columns)."""
    is_tried = np.zeros(gradient.blocked.shape, np.bool_)
    centres = gradient.grid.centres().reshape(*gradient.grid.shape, 2)
    for failure in failures:
        is_near = np.hypot(centres[..., 0] - failure.x, centres[..., 1] - failure.y) <= radius
        is_tried |= (np.abs(gradient.turns - failure.turn) <= _SAME_TURN)[:, None, None] & is_near
    return is_tried


def is_repeated(target: Target, failures: Sequence[Target], settings: Settings) -> bool:
    """Return whether a target equals a failed target, within a fraction of a cell."""
    return _is_near(target, failures, _SAME * _cell(settings))


def _is_near(target: Target, failures: Sequence[Target], radius: float) -> bool:
    return any(
        math.dist((target.x, target.y), (failure.x, failure.y)) <= radius
        and abs(target.turn - failure.turn) <= _SAME_TURN
        for failure in failures
    )


def _spread(settings: Settings) -> float:
    """Return the preferred distance from a failed place: about a finger's width."""
    return max(_cell(settings), settings.room / 4.0)


def _cell(settings: Settings) -> float:
    return settings.workspace.grid.cell_size


def _near(gradient: GradientMap, target: Target, tracked: TrackedObject, settings: Settings) -> Booleans:
    """Return whether each pose is within the permitted distance of a target, (A, rows, columns)."""
    offsets = np.abs(gradient.grid.centres() - np.array([target.x, target.y])).max(axis=1)
    # the tolerance is for rounding of the grids' places
    is_near = offsets <= _FARTHEST * settings.workspace.grid.cell_size * (1.0 + 1e-9)
    is_turn_allowed = np.abs(gradient.turns - target.turn) <= _widest_turn(target, tracked, settings) * (
        1.0 + 1e-9
    )
    return np.asarray(is_turn_allowed[:, None, None] & is_near.reshape(gradient.grid.shape))


def _widest_turn(target: Target, tracked: TrackedObject, settings: Settings) -> float:
    """Return the maximum turn of an object in a refinement: half the least angle between orientations, or 0.

    A pushed object that keeps its orientation is not turned.
    """
    yaws = sorted(settings.workspace.yaws)
    if len(yaws) < 2 or tracked.yaw is None or (settings.skill == "push" and target.turn == 0.0):
        return 0.0
    return min(after - before for before, after in pairwise(yaws)) / 2.0


def nearest_meeting(point: Floats, normals: Floats, least: Floats) -> Floats:
    """Return the nearest point to `point` with `normals @ point >= least`, if such a point exists.

    The dual problem is solved by accelerated projected gradients.
    """
    gram, shortfall = normals @ normals.T, least - normals @ point
    # the largest eigenvalue bounds the curvature, so its inverse is a safe step
    rate = 1.0 / max(float(np.linalg.norm(gram, 2)), 1e-12)
    weights = lookahead = np.zeros(len(least))
    for number in range(400):
        # Nesterov's momentum, in its common form k / (k + 3)
        new_weights = np.maximum(lookahead + rate * (shortfall - gram @ lookahead), 0.0)
        weights, lookahead = new_weights, new_weights + number / (number + 3.0) * (new_weights - weights)
    return np.asarray(point + normals.T @ weights)


class RoomCost(NamedTuple):
    """Cost of the room around a target: a more robust target's robustness, and its smaller room."""

    robustness: float
    room: float


def room_cost(candidate: Candidate, target: Target, settings: Settings) -> RoomCost | None:
    """Return the cost of the room around a target; None if no target with less room is more robust."""
    gradient = candidate.map
    if settings.skill != "place" or settings.room <= 0.0:
        return None
    is_good = (gradient.blocked == FREE) & ~avoided_cells(gradient, settings, candidate.failed)
    room = gradient.made_of.now.room(candidate.room_from)
    is_tight = is_good & (room < settings.room) & (gradient.robustness > target.robustness)
    if not is_tight.any():
        return None
    cell = np.unravel_index(int(np.argmax(np.where(is_tight, gradient.robustness, -np.inf))), is_tight.shape)
    return RoomCost(float(gradient.robustness[cell]), float(room[cell]))
