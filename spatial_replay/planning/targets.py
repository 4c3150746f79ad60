"""Targets: the best cell of an object's gradient map or, for a push, the nearest good cell within reach.

A target is then refined on finer grids, from the centre of its cell to a better place and turn nearby.
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
"""Maximum distance of a refined target from its old place, along x and along y, cells."""
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
    """Return the target for an object, or the reason why there is none.

    Args:
        gradient: map of the progress set.
        tracked: object before the motion.
        room: (A, rows, columns), distance to the objects from which room is kept.
        failed: places (x, y) where earlier motions failed.
        failures: targets of failed motions in the current scene.
    """
    good = good_cells(gradient, settings, failed, failures)
    if not good.any():
        return _why_nowhere(gradient, settings, bool(failed))
    if settings.skill == "place":
        roomy = good & (room >= least_room(good, room, settings, failures))
        values = np.where(roomy, gradient.robustness, -np.inf)
        # the nearest of equally robust cells
        away = distance_to([centre_of(tracked.footprint)], gradient.grid)
        values = np.where(values >= values.max() - _EQUAL, -away, -np.inf)
        return _best_target(gradient, values, tracked)
    return _nearest_cell(gradient, good, tracked, settings, failures)


def good_cells(
    gradient: GradientMap,
    settings: Settings,
    failed: Collection[tuple[float, float]] = (),
    failures: Sequence[Target] = (),
) -> Booleans:
    """Return the cells that will do as a target, (A, rows, columns); arguments as in `find_target`."""
    holds = (gradient.blocked == FREE) & (gradient.robustness >= settings.margin)
    good: Booleans = holds & ~avoided_cells(gradient, settings, failed)
    if settings.skill == "place" and failures:
        # cells at least a finger's width from failed targets; without any, cells with other poses than these
        for apart in (_spread(settings), _SAME * _cell(settings)):
            untried = good & ~tried_poses(gradient, failures, apart)
            if untried.any():
                return untried
    return good


def tried_cells(candidate: Candidate, settings: Settings) -> Booleans:
    """Return the cells that would do but for failed motions of a candidate, (A, rows, columns)."""
    gradient = candidate.map
    good = good_cells(gradient, settings, candidate.failed, candidate.failures)
    return np.asarray((gradient.blocked == FREE) & (gradient.robustness >= settings.margin) & ~good)


def least_room(good: Booleans, room: Floats, settings: Settings, failures: Sequence[Target] = ()) -> float:
    """Return the room that a placed object keeps; -inf if no cell has the preferred room.

    Args:
        good: cells that will do.
        room, failures: as in `find_target`.
    """
    # after failures, the cells with the most room count if no cell has the preferred room
    most = float(room[good].max(initial=-math.inf))
    preferred = min(settings.room, most) if failures else settings.room
    return preferred if most >= preferred else -math.inf


def target_in(
    gradient: GradientMap,
    tracked: TrackedObject,
    settings: Settings,
    pose: tuple[float, float, float],
    failures: Sequence[Target] = (),
) -> Target | str:
    """Return the target for an object at a pose (x, y, turn) of a map, or the reason why it is impossible."""
    cell = gradient.cell_of(*pose)
    if gradient.blocked[cell] != FREE:
        return REASONS[gradient.blocked[cell]]
    goal = np.zeros(gradient.blocked.shape, np.bool_)
    goal[cell] = True
    if settings.skill == "place":
        return _target(gradient, tracked, cell, (centre_of(tracked.footprint), pose[:2]))
    return _nearest_cell(gradient, goal, tracked, settings, failures)


def nearest_target(
    gradient: GradientMap,
    good: np.ndarray,
    tracked: TrackedObject,
    settings: Settings,
    failures: Sequence[Target] = (),
) -> Target | str:
    """Return the target in the nearest of `good` cells (A, rows, columns), or why there is none."""
    if not good.any():
        return "there is no place for it"
    if settings.skill == "push":
        return _nearest_cell(gradient, good, tracked, settings, failures)
    away = distance_to([centre_of(tracked.footprint)], gradient.grid)
    return _best_target(gradient, np.where(good, -away, -np.inf), tracked)


def _best_target(gradient: GradientMap, values: Floats, tracked: TrackedObject) -> Target:
    turn, row, column = (int(index) for index in np.unravel_index(int(np.argmax(values)), values.shape))
    start, end = centre_of(tracked.footprint), gradient.grid.centre(row, column)
    return _target(gradient, tracked, (turn, row, column), (start, end))


def _nearest_cell(
    gradient: GradientMap,
    good: np.ndarray,
    tracked: TrackedObject,
    settings: Settings,
    failures: Sequence[Target],
) -> Target | str:
    start = centre_of(tracked.footprint)
    if not gradient.grid.contains(np.array(start)):
        return "it lies too far outside the workspace"
    cell = gradient.grid.cell(*start)
    towards = _failed_directions(gradient.grid, tracked, failures)
    entry = _path_into_reach(gradient, cell, settings, towards)
    if entry is None:
        return "no free path leads into reach" + _but_for(failures)
    row, column = entry.cells[-1].tolist()
    free = (gradient.blocked[0] == FREE) & ~towards
    paths = {0: shortest_path(free, (row, column), good[0])}
    if paths[0] is None:
        # other orientations are tried only if the object cannot keep its orientation
        for layer in range(1, len(gradient.turns)):
            goals = _turnable(gradient, layer, good[layer] & free, settings)
            paths[layer] = shortest_path(free, (row, column), goals)
    routes = [(path.length, layer, path) for layer, path in paths.items() if path is not None]
    if not routes:
        return "no free path leads to a good place" + _but_for(failures)
    _, turned, path = min(routes, key=lambda route: route[0])
    cells = [(row, column) for row, column in (*entry.cells.tolist(), *path.cells[1:].tolist())]
    # an object off the centre of its cell need not go to this centre first
    first = 0
    if cells[0] == cell and len(cells) > 1:
        first = int(is_clear_leg(gradient, (start, gradient.grid.centre(*cells[1])), settings))
    turns = [gradient.grid.centre(*corner) for corner in cells[first:]]
    way = (start, *turns)
    # after a failed push, a straight first leg might begin in the failed direction again
    if not failures:
        way = _without_corners(way, gradient, free, settings)
    return _target(gradient, tracked, (turned, *cells[-1]), way)


class Ways(NamedTuple):
    """Ways of a pushed object over cells.

    Attributes:
        lengths: (rows, columns), length of the shortest way to each cell; inf without a way.
        shortest: length of the shortest way to a cell that will do.
        end: middle of the nearest of these cells to the target.
    """

    lengths: Floats
    shortest: float
    end: tuple[float, float]


def ways_of(candidate: Candidate, target: Target, settings: Settings) -> Ways | None:
    """Return the ways that `find_target` compares for a push; None if it finds no way."""
    gradient, failures = candidate.map, candidate.failures
    grid = gradient.grid
    tracked = gradient.made_of.now.about.sample.objects[candidate.name]
    towards = _failed_directions(grid, tracked, failures)
    entry = _path_into_reach(gradient, grid.cell(*centre_of(tracked.footprint)), settings, towards)
    if entry is None:
        return None
    free = (gradient.blocked[0] == FREE) & ~towards
    row, column = entry.cells[-1].tolist()
    lengths = (entry.length + lengths_from(free, (row, column))) * grid.cell_size
    layer, *_ = gradient.cell_of(*target.pose)
    good = good_cells(gradient, settings, candidate.failed, failures)[layer]
    if layer:
        able = _turnable(gradient, layer, good & free, settings)
        lengths = np.where(good & ~able, np.inf, lengths)
    of_good = np.where(good, lengths, np.inf)
    shortest = float(of_good.min())
    if not math.isfinite(shortest):
        return None
    away = distance_to([(target.x, target.y)], grid)
    end = np.where(of_good <= shortest * (1.0 + _EQUAL), away, np.inf)
    row, column = (int(index) for index in np.unravel_index(int(np.argmin(end)), end.shape))
    return Ways(lengths, shortest, grid.centre(row, column))


def _without_corners(
    way: Sequence[tuple[float, float]], gradient: GradientMap, free: Booleans, settings: Settings
) -> tuple[tuple[float, float], ...]:
    """Return a path in which straight legs over free and clear cells replace corners.

    A pushing robot has to take hold again at each corner.
    """
    grid = gradient.grid
    least = settings.workspace.clearance + grid.cell_size / math.sqrt(2.0)
    passable = free & (gradient.clearance[0] > least)

    def is_passable(leg: Sequence[tuple[float, float]]) -> bool:
        points = points_along(leg, grid.cell_size / _PLACES_IN_CELL)
        return all(passable[grid.cell(*point)] for point in points)

    straightened, rest = [way[0]], list(way[1:])
    while rest:
        farthest = next(
            (place for place in range(len(rest) - 1, 0, -1) if is_passable((straightened[-1], rest[place]))),
            0,
        )
        straightened.append(rest[farthest])
        rest = rest[farthest + 1 :]
    return tuple(straightened)


def _turnable(gradient: GradientMap, layer: int, goals: Booleans, settings: Settings) -> Booleans:
    """Return the goals (rows, columns) in which an object can be turned to the orientation of a layer."""
    # only the box around the goals is measured, instead of the whole grid
    able = np.zeros(goals.shape, np.bool_)
    if goals.any():
        low, left = np.argwhere(goals).min(axis=0).tolist()
        high, right = (np.argwhere(goals).max(axis=0) + 1).tolist()
        grid, size = gradient.grid, gradient.grid.cell_size
        corner = grid.xmin + left * size, grid.ymin + low * size
        around, turn = Grid(*corner, size, right - left, high - low), float(gradient.turns[layer])
        able[low:high, left:right] = can_turn_in(around, gradient, turn, settings)
    return able & goals


def can_turn_in(grid: Grid, gradient: GradientMap, turn: float, settings: Settings) -> Booleans:
    """Return whether a map's object can turn on the spot in each cell of a grid, (rows, columns).

    At several orientations during the turn, no obstacle may touch it and no constraint may hold.
    """
    count = math.ceil(abs(turn) / _SWEPT)
    about = gradient.made_of.now.about
    yaw = about.sample.objects[gradient.name].yaw or 0.0
    yaws = tuple(yaw + turn * number / count for number in range(1, count))
    if not yaws:
        return np.ones(grid.shape, np.bool_)
    workspace = replace(settings.workspace, yaws=yaws, keeps_yaw=False)
    maps = proposition_maps(*about, gradient.name, workspace, grid)
    is_kept = danger_of(maps, gradient.made_of.constraints) < -settings.constraint_margin
    return np.asarray(((maps.clearance > workspace.clearance) & is_kept).all(axis=0))


def _but_for(failures: Sequence[Target]) -> str:
    return ", other than by motions that failed" if failures else ""


def is_clear_leg(gradient: GradientMap, leg: Sequence[tuple[float, float]], settings: Settings) -> bool:
    """Return whether a map's object stays clear on a straight leg, also between the centres of cells."""
    grid, workspace = gradient.grid, settings.workspace
    points = list(points_along(leg, grid.cell_size / _PLACES_IN_CELL))
    # at any point of a cell the clearance is at most half a diagonal less than at the centre
    least = workspace.clearance + grid.cell_size / math.sqrt(2.0)
    if all(gradient.clearance[0][grid.cell(*point)] > least for point in points):
        return True
    # maps of one cell without propositions measure only the clearance
    about = gradient.made_of.now.about
    return all(
        proposition_maps(
            (), about.regions, about.sample, gradient.name, workspace, _spot(x, y, grid.cell_size)
        ).clearance[0, 0, 0]
        > workspace.clearance
        # the first point is where the object is already
        for x, y in points[1:]
    )


def _spot(x: float, y: float, size: float) -> Grid:
    """Return a grid of one cell around a point."""
    return Grid(x - size / 2, y - size / 2, size, 1, 1)


def _failed_directions(grid: Grid, tracked: TrackedObject, failures: Sequence[Target]) -> Booleans:
    """Return the cells (rows, columns) near an object that are in about the direction of a failed push."""
    towards = np.zeros(grid.shape, np.bool_)
    centre, radius = centre_of(tracked.footprint), radius_of(tracked)
    offsets = (grid.centres() - np.array(centre)).reshape(*grid.shape, 2)
    away = np.hypot(offsets[..., 0], offsets[..., 1])
    for failure in failures:
        angle = _beginning(failure, radius)
        along = offsets @ np.array([math.cos(angle), math.sin(angle)])
        towards |= (away > grid.cell_size) & (away <= radius) & (along >= math.cos(_ASIDE) * away)
    return towards


def begins_as(target: Target, failures: Sequence[Target], tracked: TrackedObject) -> bool:
    """Return whether a push begins in about the direction of a failed push."""
    radius = radius_of(tracked)
    begins = _beginning(target, radius)
    turned = (math.remainder(begins - _beginning(failure, radius), math.tau) for failure in failures)
    return any(abs(angle) < _ASIDE / 2.0 for angle in turned)


def _beginning(target: Target, distance: float) -> float:
    """Return the first direction of a path: the angle to its first point at a distance, or to its end."""
    begin, points = target.waypoints[0], points_along(target.waypoints, distance / 8.0)
    x, y = next((point for point in points if math.dist(point, begin) >= distance), target.waypoints[-1])
    return math.atan2(y - begin[1], x - begin[0])


def _path_into_reach(
    gradient: GradientMap, cell: tuple[int, int], settings: Settings, towards: Booleans
) -> Path | None:
    """Return the path to the nearest free cell.

    A path may cross cells out of reach only if it starts in one. It may cross constrained cells only if it
    starts in one, but no occupied cells. From an occupied cell it first jumps to the nearest passable cell.
    """
    free = gradient.blocked[0] == FREE
    is_reached = settings.workspace.within_reach(gradient.grid)[cell]
    passable = free if is_reached else free | (gradient.blocked[0] == OUT_OF_REACH)
    if not passable[cell]:
        empty = gradient.clearance[0] > settings.workspace.clearance
        passable = passable | (empty & (gradient.blocked[0] == CONSTRAINED))
    passable = passable & ~towards
    return shortest_path(passable, cell if passable[cell] else _nearest(passable, cell), free)


def _nearest(cells: np.ndarray, cell: tuple[int, int]) -> tuple[int, int]:
    """Return the nearest of `cells` to a cell."""
    places = np.argwhere(cells)
    row, column = places[int(np.argmin(((places - np.array(cell)) ** 2).sum(axis=1)))].tolist()
    return row, column


def _target(
    gradient: GradientMap,
    tracked: TrackedObject,
    place: tuple[int, int, int],
    waypoints: tuple[tuple[float, float], ...],
) -> Target:
    x, y = waypoints[-1]
    turn = float(gradient.turns[place[0]])
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return Target(gradient.name, x, y, turn, yaw, waypoints, float(gradient.robustness[place]))


def _why_nowhere(gradient: GradientMap, settings: Settings, has_failed: bool) -> str:
    enough = gradient.robustness >= settings.margin
    if not enough.any():
        best = float(gradient.robustness.max())
        if why := _why_too_large(gradient):
            return why
        about = gradient.made_of.then.about
        formulas = [about.propositions[number] for cube in gradient.made_of.progress for number, _ in cube]
        nowhere = f"no place is good enough: {best:.4g} at best, {settings.margin:.4g} needed"
        return "; ".join([nowhere, *seam_texts(formulas, about.regions)])
    counts = np.bincount(gradient.blocked[enough], minlength=len(REASONS))
    if counts[FREE] and has_failed:
        return "it was tried wherever it would hold"
    reasons = zip(counts[1:].tolist(), REASONS[1:], strict=True)
    causes = ", ".join(f"{count} cells: {reason}" for count, reason in reasons if count)
    return f"blocked wherever it would hold: {causes}"


def _why_too_large(gradient: GradientMap) -> str:
    """Return a sentence on a region or object that is too small for a map's object; "" if there is none."""
    about = gradient.made_of.then.about
    formulas = [
        about.propositions[number] for cube in gradient.made_of.progress for number, value in cube if value
    ]
    for formula in formulas:
        for atom in iter_formulas(formula):
            if not isinstance(atom, Atom) or atom.relation != "enclosedin":
                continue
            inner, outer = (_outlines_of(term, about) for term in atom.terms)
            if getattr(atom.terms[0], "name", "") != gradient.name or not inner or not outer:
                continue
            room = _extent(outer, 0.0)
            excess = min(float((_extent(inner, turn) - room).max()) for turn in gradient.turns.tolist())
            if excess > 0.0:
                return f"{gradient.name} is {excess:.3g} too large for {format_term(atom.terms[1])}"
    return ""


_Rounded: TypeAlias = tuple[Floats, float]
"""Corners (N, 2) and rounding radius of an outline."""


def _outlines_of(term: Term, about: MapSubject) -> list[_Rounded]:
    """Return the outlines of an object or region; none for other terms."""
    name = getattr(term, "name", "")
    if isinstance(term, TrackedName) and name in about.sample.objects:
        return [(part.vertices, part.radius) for part in about.sample.objects[name].footprint.parts]
    if base_of(term) is term and (outline := about.regions.get(name)) is not None:
        return [(np.array(outline.vertices), outline.radius)]
    return []


def _extent(outlines: Sequence[_Rounded], turn: float) -> Floats:
    """Return the width along x and y of outlines that are turned by an angle."""
    cosine, sine = math.cos(turn), math.sin(turn)
    rotation = np.array([[cosine, sine], [-sine, cosine]])
    ends = [(vertices @ rotation, radius) for vertices, radius in outlines]
    high = np.max([vertices.max(axis=0) + radius for vertices, radius in ends], axis=0)
    low = np.min([vertices.min(axis=0) - radius for vertices, radius in ends], axis=0)
    return np.asarray(high - low)


# ----------------------------------------------------------------------------------------------- refinement


def refine_target(
    target: Target,
    tracked: TrackedObject,
    settings: Settings,
    measure: Measured,
    failures: Sequence[Target] = (),
) -> Target:
    """Return the most robust target near a target, or the target itself.

    This is a compass search: each step takes the best of 5 x 5 places around the newest place, in up to three
    turns. If no place is better, the spacing is halved. Only free places count. If the target has the
    preferred room, only places with this room count.

    Args:
        tracked: object before the motion.
        measure: function that measures maps around the target.
        failures: targets of failed motions, which are avoided if possible.
    """
    size = settings.workspace.grid.cell_size
    spacing, turning, halved = _COARSEST * size, _widest_turn(target, tracked, settings) / 2.0, 0
    pose, best, least = target.pose, target.robustness, -math.inf
    apart = _spread(settings)
    if is_repeated(target, failures, settings):
        # any other place that is good enough is better
        best = settings.margin - 2.0 * _BETTER
    if _is_near(target, failures, apart):
        apart = _SAME * _cell(settings)
    for number in range(_MOST_GRIDS):
        x, y, turn = pose
        low = x - 2.5 * spacing, y - 2.5 * spacing
        turns = [0.0] if turning == 0.0 else [-turning, 0.0, turning]
        yaws = (
            tuple((tracked.yaw or 0.0) + turn + offset for offset in turns) if settings.workspace.yaws else ()
        )
        gradient, room = measure(Grid(*low, spacing, 5, 5), yaws)
        # other places need the preferred room only if the target itself has it
        if number == 0:
            middle = len(gradient.turns) // 2, 2, 2
            least = settings.room if room[middle] >= settings.room else -math.inf
        good = (gradient.blocked == FREE) & (room >= least) & _near(gradient, target, tracked, settings)
        good &= ~tried_poses(gradient, failures, apart)
        values = np.where(good, gradient.robustness, -np.inf)
        place = tuple(map(int, np.unravel_index(int(np.argmax(values)), values.shape)))
        if values[place] > best + _BETTER:
            best = float(values[place])
            pose = (*gradient.grid.centre(*place[1:]), float(gradient.turns[place[0]]))
        elif halved == _HALVED:
            break
        else:
            spacing, turning, halved = spacing / 2.0, turning / 2.0, halved + 1
    if pose == target.pose:
        return target
    x, y, turn = pose
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return Target(target.name, x, y, turn, yaw, (*target.waypoints[:-1], (x, y)), best)


def tried_poses(gradient: GradientMap, failures: Sequence[Target], radius: float) -> Booleans:
    """Return whether each pose of a map is within a radius of a failed target, (A, rows, columns)."""
    same = np.zeros(gradient.blocked.shape, np.bool_)
    centres = gradient.grid.centres().reshape(*gradient.grid.shape, 2)
    for failure in failures:
        near = np.hypot(centres[..., 0] - failure.x, centres[..., 1] - failure.y) <= radius
        same |= (np.abs(gradient.turns - failure.turn) <= _SAME_TURN)[:, None, None] & near
    return same


def is_repeated(target: Target, failures: Sequence[Target], settings: Settings) -> bool:
    """Return whether a target equals a failed target within a fraction of a cell."""
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
    # with a tolerance, because places of grids are rounded
    near = offsets <= _FARTHEST * settings.workspace.grid.cell_size * (1.0 + 1e-9)
    turned = np.abs(gradient.turns - target.turn) <= _widest_turn(target, tracked, settings) * (1.0 + 1e-9)
    return np.asarray(turned[:, None, None] & near.reshape(gradient.grid.shape))


def _widest_turn(target: Target, tracked: TrackedObject, settings: Settings) -> float:
    """Return the maximum turn of an object in a refinement: half the angle to the next orientation, or 0.

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
    gram, missing = normals @ normals.T, least - normals @ point
    # the largest eigenvalue bounds the curvature, so its inverse is a safe step
    rate = 1.0 / max(float(np.linalg.norm(gram, 2)), 1e-12)
    weights = ahead = np.zeros(len(least))
    for number in range(400):
        # Nesterov's momentum, in its common form k / (k + 3)
        newest = np.maximum(ahead + rate * (missing - gram @ ahead), 0.0)
        weights, ahead = newest, newest + number / (number + 3.0) * (newest - weights)
    return np.asarray(point + normals.T @ weights)


class RoomCost(NamedTuple):
    """Cost of the room around a target: the robustness of a target with less room, and its room."""

    robustness: float
    room: float


def room_cost(candidate: Candidate, target: Target, settings: Settings) -> RoomCost | None:
    """Return the cost of the room around a target; None if less room allows no more robustness."""
    gradient = candidate.map
    if settings.skill != "place" or settings.room <= 0.0:
        return None
    good = (gradient.blocked == FREE) & ~avoided_cells(gradient, settings, candidate.failed)
    room = gradient.made_of.now.room(candidate.room_from)
    tight = good & (room < settings.room) & (gradient.robustness > target.robustness)
    if not tight.any():
        return None
    place = np.unravel_index(int(np.argmax(np.where(tight, gradient.robustness, -np.inf))), tight.shape)
    return RoomCost(float(gradient.robustness[place]), float(room[place]))
