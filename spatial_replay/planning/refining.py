"""Refined targets: from the middle of a cell to a better place and turn nearby, on finer and finer grids."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.planning.decisions import Target
from spatial_replay.planning.maps import FREE, GradientMap
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.workspace import Grid

_COARSEST: Final = 0.5
"""The first distance between places, in cells."""
_HALVED: Final = 4
"""How often that distance is halved."""
_MOST_GRIDS: Final = 12
"""The most grids that are measured for one target."""
_FARTHEST: Final = 2.0
"""How far a target moves from the middle of its cell at most, in cells, along x and along y."""
_SAME: Final = 0.25
"""How near to a pose another one counts as the same, in cells."""
_SAME_TURN: Final = math.radians(3.0)
_BETTER: Final = 1e-9
"""How much robustness a move has to gain."""

Measured = Callable[[Grid, tuple[float, ...]], tuple[GradientMap, Floats]]
"""Gives the map of an object over a grid in some orientations (yaws), and its room there."""


def refined(
    target: Target,
    tracked: TrackedObject,
    settings: Settings,
    measured: Measured,
    failures: Sequence[Target] = (),
) -> Target:
    """Return the target with the most robustness near a target, or the same one.

    A compass search: the best of 5 x 5 places around the newest one, in up to three turns, and closer ones
    once none is better. Places are free, as that of the target is, and have the preferred room if that has.

    Args:
        tracked: the object before the motion.
        measured: measures maps around the target.
        failures: targets for which motions failed; others are taken if there are any.
    """
    size = settings.workspace.grid.cell_size
    spacing, turning, halved = _COARSEST * size, _widest_turn(target, tracked, settings) / 2.0, 0
    pose, best, least = (target.x, target.y, target.turn), target.robustness, -math.inf
    if is_repeated(target, failures, settings):
        # any other place that is good enough is better
        best = settings.margin - 2.0 * _BETTER
    for number in range(_MOST_GRIDS):
        x, y, turn = pose
        low = x - 2.5 * spacing, y - 2.5 * spacing
        turns = [0.0] if turning == 0.0 else [-turning, 0.0, turning]
        yaws = tuple((tracked.yaw or 0.0) + turn + each for each in turns) if settings.workspace.yaws else ()
        gradient, room = measured(Grid(*low, spacing, 5, 5), yaws)
        if number == 0:
            middle = len(gradient.turns) // 2, 2, 2
            least = settings.room if room[middle] >= settings.room else -math.inf
        good = (gradient.blocked == FREE) & (room >= least) & _near(gradient, target, tracked, settings)
        good &= ~tried(gradient, failures, settings)
        values = np.where(good, gradient.robustness, -np.inf)
        place = tuple(map(int, np.unravel_index(int(np.argmax(values)), values.shape)))
        if values[place] > best + _BETTER:
            best = float(values[place])
            pose = (*gradient.grid.centre(*place[1:]), float(gradient.turns[place[0]]))
        elif halved == _HALVED:
            break
        else:
            spacing, turning, halved = spacing / 2.0, turning / 2.0, halved + 1
    x, y, turn = pose
    if (x, y, turn) == (target.x, target.y, target.turn):
        return target
    yaw = None if tracked.yaw is None else tracked.yaw + turn
    return Target(target.name, x, y, turn, yaw, (*target.waypoints[:-1], (x, y)), best)


def tried(gradient: GradientMap, failures: Sequence[Target], settings: Settings) -> Booleans:
    """Return (A, rows, columns): which poses of a map are some targets, but for a fraction of a cell."""
    same = np.zeros(gradient.blocked.shape, np.bool_)
    centres = gradient.grid.centres().reshape(*gradient.grid.shape, 2)
    for each in failures:
        near = np.hypot(centres[..., 0] - each.x, centres[..., 1] - each.y) <= _SAME * _cell(settings)
        same |= (np.abs(gradient.turns - each.turn) <= _SAME_TURN)[:, None, None] & near
    return same


def is_repeated(target: Target, failures: Sequence[Target], settings: Settings) -> bool:
    """Return whether a target is one of some others, but for a fraction of a cell."""
    return any(
        math.dist((target.x, target.y), (each.x, each.y)) <= _SAME * _cell(settings)
        and abs(target.turn - each.turn) <= _SAME_TURN
        for each in failures
    )


def _cell(settings: Settings) -> float:
    return settings.workspace.grid.cell_size


def _near(gradient: GradientMap, target: Target, tracked: TrackedObject, settings: Settings) -> Booleans:
    """Return (A, rows, columns): whether poses are as near to a target as they may be."""
    offsets = np.abs(gradient.grid.centres() - np.array([target.x, target.y])).max(axis=1)
    near = offsets <= _FARTHEST * settings.workspace.grid.cell_size * (1.0 + 1e-9)
    turned = np.abs(gradient.turns - target.turn) <= _widest_turn(target, tracked, settings) * (1.0 + 1e-9)
    return np.asarray(turned[:, None, None] & near.reshape(gradient.grid.shape))


def _widest_turn(target: Target, tracked: TrackedObject, settings: Settings) -> float:
    """Return how far an object may be turned from an orientation: half the way to the next one; or 0.

    A pushed object that keeps its orientation is not turned at all.
    """
    yaws = sorted(settings.workspace.yaws)
    if len(yaws) < 2 or tracked.yaw is None or (settings.skill == "push" and target.turn == 0.0):
        return 0.0
    return min(after - before for before, after in pairwise(yaws)) / 2.0
