"""Where on a map an object should go: the best cell, or the nearest good one that a free path leads to."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.planning.maps import CONSTRAINED, FREE, OUT_OF_REACH, REASONS, GradientMap
from spatial_replay.planning.paths import Path, shortest_path
from spatial_replay.planning.poses import centre_of
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.step import Target
from spatial_replay.planning.workspace import Grid

AVOIDED_CELLS = 2.0
"""How far from a place where an object could not be brought the next try stays, in cells."""


def find_target(
    found: GradientMap,
    tracked: TrackedObject,
    settings: Settings,
    failed: Collection[tuple[float, float]] = (),
) -> Target | str:
    """Where an object should go, or why nowhere.

    Args:
        found: the map of what is to hold.
        tracked: the object as it is.
        failed: places (x, y) where it could not be brought before.
    """
    good = (found.blocked == FREE) & (found.robustness >= settings.margin) & ~_near(failed, found.grid)
    if not good.any():
        return _why_nowhere(found, settings, bool(failed))
    if settings.skill == "place":
        return _best_cell(found, good, tracked, settings)
    return _nearest_cell(found, good, tracked, settings)


def _best_cell(found: GradientMap, good: np.ndarray, tracked: TrackedObject, settings: Settings) -> Target:
    roomy = good & (found.clearance >= settings.room)
    values = np.where(roomy if roomy.any() else good, found.robustness, -np.inf)
    turn, row, column = (int(index) for index in np.unravel_index(int(np.argmax(values)), values.shape))
    here, there = centre_of(tracked.footprint), found.grid.centre(row, column)
    return _target(found, tracked, (turn, row, column), (here, there))


def _nearest_cell(
    found: GradientMap, good: np.ndarray, tracked: TrackedObject, settings: Settings
) -> Target | str:
    here = centre_of(tracked.footprint)
    if not found.grid.contains(np.array(here)):
        return "it lies too far outside the workspace"
    cell = found.grid.cell(*here)
    way_in = _way_in(found, cell, settings)
    if way_in is None:
        return "no free path leads into reach"
    row, column = way_in.cells[-1].tolist()
    path = shortest_path(found.blocked[0] == FREE, (row, column), good[0])
    if path is None:
        return "no free path leads to a good place"
    cells = [(row, column) for row, column in (*way_in.cells.tolist(), *path.cells[1:].tolist())]
    # where it is in its own cell, it need not go to that cell's middle first
    first = 1 if cells[0] == cell and len(cells) > 1 else 0
    turns = [found.grid.centre(*each) for each in cells[first:]]
    return _target(found, tracked, (0, *cells[-1]), (here, *turns))


def _way_in(found: GradientMap, cell: tuple[int, int], settings: Settings) -> Path | None:
    """The way to the first free cell, over cells that are merely out of reach if it starts in such a one.

    From where a constraint would hold it goes over such cells, too, but not where anything stands; from
    where something stands, straight to the nearest cell where nothing does.
    """
    free = found.blocked[0] == FREE
    is_reached = settings.workspace.within_reach(found.grid)[cell]
    passable = free if is_reached else free | (found.blocked[0] == OUT_OF_REACH)
    if not passable[cell]:
        empty = found.clearance[0] > settings.workspace.clearance
        passable = passable | (empty & (found.blocked[0] == CONSTRAINED))
    return shortest_path(passable, cell if passable[cell] else _nearest(passable, cell), free)


def _nearest(cells: np.ndarray, cell: tuple[int, int]) -> tuple[int, int]:
    """Of some cells, the one nearest to another."""
    places = np.argwhere(cells)
    row, column = places[int(np.argmin(((places - np.array(cell)) ** 2).sum(axis=1)))].tolist()
    return row, column


def _target(
    found: GradientMap,
    tracked: TrackedObject,
    place: tuple[int, int, int],
    waypoints: tuple[tuple[float, float], ...],
) -> Target:
    x, y = waypoints[-1]
    turn = float(found.turns[place[0]])
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return Target(found.name, x, y, turn, yaw, waypoints, float(found.robustness[place]))


def _near(failed: Collection[tuple[float, float]], grid: Grid) -> np.ndarray:
    """(rows, columns): the cells near places that were tried in vain."""
    near = np.zeros(grid.shape, np.bool_)
    centres = grid.centres()
    for place in failed:
        away = np.hypot(*(centres - np.array(place)).T)
        near |= (away <= AVOIDED_CELLS * grid.cell_size).reshape(grid.shape)
    return near


def _why_nowhere(found: GradientMap, settings: Settings, has_failed: bool) -> str:
    enough = found.robustness >= settings.margin
    if not enough.any():
        best = float(found.robustness.max())
        return f"nowhere would it hold: {best:.4g} at best, {settings.margin:.4g} needed"
    where = found.blocked[enough]
    counts = np.bincount(where, minlength=len(REASONS))
    if counts[FREE] and has_failed:
        return "it was tried wherever it would hold"
    told = [
        f"{count} cells: {reason}"
        for count, reason in zip(counts[1:].tolist(), REASONS[1:], strict=True)
        if count
    ]
    return f"blocked wherever it would hold: {', '.join(told)}"
