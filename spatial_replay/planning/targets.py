"""Where on a map an object should go: the best cell, or the nearest good one that a free path leads to."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.planning.maps import FREE, REASONS, GradientMap
from spatial_replay.planning.paths import shortest_path
from spatial_replay.planning.poses import centre_of
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.step import Target

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
    good = (found.blocked == FREE) & (found.robustness >= settings.margin) & ~_near(failed, settings)
    if not good.any():
        return _why_nowhere(found, settings, bool(failed))
    if settings.skill == "place":
        return _best_cell(found, good, tracked, settings)
    return _nearest_cell(found, good, tracked, settings)


def _best_cell(found: GradientMap, good: np.ndarray, tracked: TrackedObject, settings: Settings) -> Target:
    roomy = good & (found.clearance >= settings.room)
    values = np.where(roomy if roomy.any() else good, found.robustness, -np.inf)
    turn, row, column = (int(index) for index in np.unravel_index(int(np.argmax(values)), values.shape))
    here, there = centre_of(tracked.footprint), settings.workspace.grid.centre(row, column)
    return _target(found, tracked, (turn, row, column), (here, there))


def _nearest_cell(
    found: GradientMap, good: np.ndarray, tracked: TrackedObject, settings: Settings
) -> Target | str:
    grid = settings.workspace.grid
    free = found.blocked[0] == FREE
    here = centre_of(tracked.footprint)
    cell = grid.cell(*here)
    start = cell if free[cell] else _way_out(free, cell)
    path = shortest_path(free, start, good[0])
    if path is None:
        return "no free path leads to a good place"
    row, column = path.cells[-1].tolist()
    # where it is in its own cell, it need not go to that cell's middle first
    first = 1 if start == cell and len(path.cells) > 1 else 0
    turns = [grid.centre(*each) for each in path.cells[first:].tolist()]
    return _target(found, tracked, (0, row, column), (here, *turns))


def _way_out(free: np.ndarray, cell: tuple[int, int]) -> tuple[int, int]:
    """The free cell nearest to one that is not: where something has to go that is where it must not be."""
    cells = np.argwhere(free)
    away = ((cells - np.array(cell)) ** 2).sum(axis=1)
    row, column = cells[int(np.argmin(away))].tolist()
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


def _near(failed: Collection[tuple[float, float]], settings: Settings) -> np.ndarray:
    """(rows, columns): the cells near places that were tried in vain."""
    grid = settings.workspace.grid
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
