"""Candidates: objects that could be moved to take an edge of the automaton, with a target for each.

A target is the best cell of an object's gradient map, or, for a skill that pushes, the nearest good cell that
a free path leads to.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from spatial_replay.errors import TraceError
from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.planning.decisions import Candidate, Consideration, Guards, Reason, Target
from spatial_replay.planning.demands import Pose, with_moved
from spatial_replay.planning.edges import Attempts
from spatial_replay.planning.map_layers import avoided_cells
from spatial_replay.planning.maps import (
    CONSTRAINED,
    FREE,
    OCCUPIED,
    OUT_OF_REACH,
    REASONS,
    Cubes,
    GradientMap,
    PropositionMaps,
    centre_of,
    concerns,
    danger_of,
    gradient_map,
    moved_object,
    proposition_maps,
    radius_of,
)
from spatial_replay.planning.paths import Path, shortest_path
from spatial_replay.planning.refining import is_repeated, refined, tried
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.sample import Sample

_ASIDE: Final = math.radians(35.0)
"""How far aside another push begins from a direction in which one failed at once."""
_SWEPT: Final = math.radians(10.0)
"""The widest angle between orientations that are looked at while an object turns on the spot."""


def find_target(
    gradient: GradientMap,
    tracked: TrackedObject,
    settings: Settings,
    room: Floats,
    failed: Collection[tuple[float, float]] = (),
    failures: Sequence[Target] = (),
) -> Target | str:
    """Return the target for an object, or why there is none.

    Args:
        gradient: the map of the progress set.
        tracked: the object before the motion.
        room: (A, rows, columns), the distance to what room is kept from.
        failed: places (x, y) where earlier attempts failed.
        failures: targets for which motions failed while everything stood as it does.
    """
    holds = (gradient.blocked == FREE) & (gradient.robustness >= settings.margin)
    good = holds & ~avoided_cells(gradient, settings, failed)
    if not good.any():
        return _why_nowhere(gradient, settings, bool(failed))
    if settings.skill == "place":
        # near a cell that was tried, a refined target may still be another one
        untried = good & ~tried(gradient, failures, settings)
        good = untried if untried.any() else good
        return _best_cell(gradient, good & (room >= settings.room), good, tracked)
    return _nearest_cell(gradient, good, tracked, settings, failures)


def target_in(
    gradient: GradientMap,
    tracked: TrackedObject,
    settings: Settings,
    pose: tuple[float, float, float],
    failures: Sequence[Target] = (),
) -> Target | str:
    """Return the target for an object at one pose (x, y, turn) of a map, or why it cannot get there."""
    place = gradient.cell_of(*pose)
    if gradient.blocked[place] != FREE:
        return REASONS[gradient.blocked[place]]
    only = np.zeros(gradient.blocked.shape, np.bool_)
    only[place] = True
    if settings.skill == "place":
        return _target(gradient, tracked, place, (centre_of(tracked.footprint), pose[:2]))
    return _nearest_cell(gradient, only, tracked, settings, failures)


def nearest_target(
    gradient: GradientMap,
    good: np.ndarray,
    tracked: TrackedObject,
    settings: Settings,
    failures: Sequence[Target] = (),
) -> Target | str:
    """Return the target in the nearest of some cells (A, rows, columns), or why there is none."""
    if not good.any():
        return "there is no place for it"
    if settings.skill == "push":
        return _nearest_cell(gradient, good, tracked, settings, failures)
    here = centre_of(tracked.footprint)
    away = np.hypot(*(gradient.grid.centres() - np.array(here)).T).reshape(gradient.grid.shape)
    values = np.where(good, -away, -np.inf)
    turn, row, column = (int(index) for index in np.unravel_index(int(np.argmax(values)), values.shape))
    return _target(gradient, tracked, (turn, row, column), (here, gradient.grid.centre(row, column)))


def points_along(waypoints: Sequence[tuple[float, float]], step: float) -> Iterator[tuple[float, float]]:
    """Yield points on a way, no farther apart than a step."""
    yield waypoints[0]
    for (u, v), (x, y) in pairwise(waypoints):
        count = max(1, math.ceil(math.dist((u, v), (x, y)) / step))
        yield from ((u + k / count * (x - u), v + k / count * (y - v)) for k in range(1, count + 1))


def _best_cell(gradient: GradientMap, roomy: np.ndarray, good: np.ndarray, tracked: TrackedObject) -> Target:
    values = np.where(roomy if roomy.any() else good, gradient.robustness, -np.inf)
    turn, row, column = (int(index) for index in np.unravel_index(int(np.argmax(values)), values.shape))
    here, there = centre_of(tracked.footprint), gradient.grid.centre(row, column)
    return _target(gradient, tracked, (turn, row, column), (here, there))


def _nearest_cell(
    gradient: GradientMap,
    good: np.ndarray,
    tracked: TrackedObject,
    settings: Settings,
    failures: Sequence[Target],
) -> Target | str:
    here = centre_of(tracked.footprint)
    if not gradient.grid.contains(np.array(here)):
        return "it lies too far outside the workspace"
    cell = gradient.grid.cell(*here)
    towards = _failed_directions(gradient.grid, tracked, failures)
    entry = _path_into_reach(gradient, cell, settings, towards)
    if entry is None:
        return "no free path leads into reach" + _but_for(failures)
    row, column = entry.cells[-1].tolist()
    free = (gradient.blocked[0] == FREE) & ~towards
    path, turned = shortest_path(free, (row, column), good[0]), 0
    if path is None:
        # it is turned at the end of its path, and only if that is needed
        for layer in range(1, len(gradient.turns)):
            goals = _turnable(gradient, layer, good[layer] & free, settings)
            other = shortest_path(free, (row, column), goals)
            if other is not None and (path is None or other.length < path.length):
                path, turned = other, layer
    if path is None:
        return "no free path leads to a good place" + _but_for(failures)
    cells = [(row, column) for row, column in (*entry.cells.tolist(), *path.cells[1:].tolist())]
    # an object off the middle of its cell need not visit that middle first
    first = 1 if cells[0] == cell and len(cells) > 1 else 0
    turns = [gradient.grid.centre(*each) for each in cells[first:]]
    return _target(gradient, tracked, (turned, *cells[-1]), (here, *turns))


def _turnable(gradient: GradientMap, layer: int, goals: Booleans, settings: Settings) -> Booleans:
    """Return in which of some cells (rows, columns) an object can be turned to the orientation of a layer."""
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
    """Return (rows, columns): whether a map's object can turn on the spot in each cell of a grid.

    Nothing stands in its way there, and no constraint holds, in orientations every few degrees in between.
    """
    count = math.ceil(abs(turn) / _SWEPT)
    about = gradient.made_of.now.about
    tracked = about.sample.objects[gradient.name]
    here = (tracked.yaw or 0.0) if isinstance(tracked, TrackedObject) else 0.0
    yaws = tuple(here + turn * number / count for number in range(1, count))
    if not yaws:
        return np.ones(grid.shape, np.bool_)
    workspace = replace(settings.workspace, yaws=yaws, keeps_yaw=False)
    maps = proposition_maps(*about, gradient.name, workspace, grid)
    is_kept = danger_of(maps, gradient.made_of.constraints) < -settings.constraint_margin
    return np.asarray(((maps.clearance > workspace.clearance) & is_kept).all(axis=0))


def _but_for(failures: Sequence[Target]) -> str:
    return ", other than by motions that failed" if failures else ""


def _failed_directions(grid: Grid, tracked: TrackedObject, failures: Sequence[Target]) -> Booleans:
    """Return (rows, columns): where a path would begin in about a direction in which a push failed."""
    towards = np.zeros(grid.shape, np.bool_)
    here, radius = centre_of(tracked.footprint), radius_of(tracked)
    offsets = (grid.centres() - np.array(here)).reshape(*grid.shape, 2)
    away = np.hypot(offsets[..., 0], offsets[..., 1])
    for each in failures:
        angle = _beginning(each, radius)
        along = offsets @ np.array([math.cos(angle), math.sin(angle)])
        towards |= (away > grid.cell_size) & (away <= radius) & (along >= math.cos(_ASIDE) * away)
    return towards


def _beginning(target: Target, distance: float) -> float:
    """Return the angle in which a way begins: that to its first point at a distance, or to its end."""
    begin, points = target.waypoints[0], points_along(target.waypoints, distance / 8.0)
    x, y = next((each for each in points if math.dist(each, begin) >= distance), target.waypoints[-1])
    return math.atan2(y - begin[1], x - begin[0])


def _path_into_reach(
    gradient: GradientMap, cell: tuple[int, int], settings: Settings, towards: Booleans
) -> Path | None:
    """Return the path to the nearest free cell.

    Cells out of reach may be crossed only if the path starts in one. From a cell where a constraint would
    hold, such cells may be crossed too, but no occupied ones; from an occupied cell the path first jumps to
    the nearest cell that is not.
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
    """Return the one of some cells that is nearest to another cell."""
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
        return f"nowhere would it hold: {best:.4g} at best, {settings.margin:.4g} needed"
    counts = np.bincount(gradient.blocked[enough], minlength=len(REASONS))
    if counts[FREE] and has_failed:
        return "it was tried wherever it would hold"
    reasons = zip(counts[1:].tolist(), REASONS[1:], strict=True)
    listed = ", ".join(f"{count} cells: {reason}" for count, reason in reasons if count)
    return f"blocked wherever it would hold: {listed}"


class Movables:
    """The movable objects of one sample.

    An object's propositions are measured over the grid once and used for every edge.
    """

    def __init__(
        self,
        propositions: Sequence[Formula],
        regions: Mapping[str, Outline],
        sample: Sample,
        settings: Settings,
        attempts: Attempts,
    ) -> None:
        self._propositions, self._regions = propositions, regions
        self._sample, self._settings, self._attempts = sample, settings, attempts
        self._maps: dict[str, PropositionMaps] = {}

    @property
    def sample(self) -> Sample:
        """The sample."""
        return self._sample

    @property
    def names(self) -> list[str]:
        """The movable objects, in the order of the settings."""
        movable, present = self._settings.movable, self._sample.objects
        return [name for name in (sorted(present) if movable is None else movable) if name in present]

    def names_for(self, progress: Guards) -> list[str]:
        """Return the movable objects that a progress set depends on, in the order of the settings."""
        about = {number for cube in progress.cubes for number, _ in cube}
        return [
            name for name in self.names if any(concerns(self._propositions[number], name) for number in about)
        ]

    def candidate(
        self,
        name: str,
        consideration: Consideration,
        failed: Collection[tuple[float, float]] = (),
        later: Collection[str] = (),
        *,
        refine: bool = False,
    ) -> Candidate:
        """Return an object with its map for an edge, and its target or why it has none.

        Args:
            failed: places (x, y) where earlier attempts failed.
            later: objects that may still have to be moved after this motion.
            refine: refine the target, if the settings want that.

        Raises:
            TraceError: the sample has no footprint for the object.
        """
        tracked = self._tracked(name)
        settings, maps = self._settings, self.maps_of(name)
        cubes = consideration.progress.cubes, consideration.constraints.cubes
        gradient = gradient_map(maps, *cubes, settings.workspace, settings.constraint_margin)
        room_from = None if settings.room_from == "all" or name in later else later
        target = find_target(
            gradient, tracked, settings, maps.room(room_from), failed, self.failed_here(name)
        )
        if isinstance(target, Target) and refine:
            target = self.refined(target, consideration, room_from)
        if isinstance(target, Target):
            target = self.with_way(target, consideration.constraints.cubes)
        if isinstance(target, Target) and self.is_repeated(target):
            target = "it was tried wherever it would hold, and nothing has changed since"
        kept_from = None if room_from is None else tuple(room_from)
        found, why = (None, target) if isinstance(target, str) else (target, "")
        return Candidate(name, gradient, found, why, failed=tuple(failed), room_from=kept_from)

    def failed_here(self, name: str) -> tuple[Target, ...]:
        """Return the targets for which motions of an object failed while everything stood as it does."""
        return self._attempts.failed_here(name, self._sample, self._settings)

    def is_repeated(self, target: Target) -> bool:
        """Return whether a motion to a target would repeat one that failed while everything stood as now."""
        failures = self.failed_here(target.name)
        if self._settings.skill == "place":
            return is_repeated(target, failures, self._settings)
        # pushes that begin in another direction are others
        radius = radius_of(self._tracked(target.name))
        begins = _beginning(target, radius)
        turned = (math.remainder(begins - _beginning(each, radius), math.tau) for each in failures)
        return any(abs(each) < _ASIDE / 2.0 for each in turned)

    def refined(
        self,
        target: Target,
        consideration: Consideration,
        room_from: Collection[str] | None,
        then: Mapping[str, Pose] | None = None,
    ) -> Target:
        """Return a target of a placed object with more robustness nearby, if the settings want that.

        Args:
            room_from: the objects to keep room from; None for everything.
            then: where other objects are moved to later, for the robustness, and as obstacles.
        """
        settings, name = self._settings, target.name
        if not settings.refine or (settings.skill == "push" and settings.rules < 3):
            return target
        progress, constraints = consideration.progress.cubes, consideration.constraints.cubes
        later = self._sample if then is None else with_moved(self._sample, then)

        def measured(grid: Grid, yaws: tuple[float, ...]) -> tuple[GradientMap, Floats]:
            workspace = replace(settings.workspace, yaws=yaws, keeps_yaw=False)
            about = self._propositions, self._regions
            now = proposition_maps(*about, self._sample, name, workspace, grid)
            after = now if then is None else proposition_maps(*about, later, name, workspace, grid)
            gradient = gradient_map(
                now, progress, constraints, settings.workspace, settings.constraint_margin, after
            )
            gradient.blocked[after.clearance <= settings.workspace.clearance] = OCCUPIED
            return gradient, np.minimum(now.room(room_from), after.room(room_from))

        failures = () if settings.skill == "push" else self.failed_here(name)
        found = refined(target, self._tracked(name), settings, measured, failures)
        return found if settings.skill == "place" or self._is_pushed_to(found, constraints) else target

    def _is_pushed_to(self, target: Target, constraints: Cubes) -> bool:
        """Return whether nothing is in the way on the last stretch of a path, and while turning there."""
        settings, maps = self._settings, self.maps_of(target.name)
        gradient = gradient_map(maps, ((),), constraints, settings.workspace, settings.constraint_margin)
        last = (
            gradient.grid.cell(*each)
            for each in points_along(target.waypoints[-2:], gradient.grid.cell_size / 2)
        )
        if any(gradient.blocked[0][cell] != FREE for cell in last):
            return False
        size = gradient.grid.cell_size
        spot = Grid(target.x - size / 2, target.y - size / 2, size, 1, 1)
        return bool(can_turn_in(spot, gradient, target.turn, settings).all())

    def _tracked(self, name: str) -> TrackedObject:
        tracked = self._sample.objects[name]
        if not isinstance(tracked, TrackedObject):
            raise TraceError(f"object {name!r} is {tracked!r}; give a TrackedObject")
        return tracked

    def with_way(self, target: Target, constraints: Cubes) -> Target | str:
        """Return the target of a carried object with a way that keeps the constraints, or why there is none.

        Where no constraint is about the object, its way does not matter. On the way, constraints stay away
        from holding by the margin and half a cell; where there is no such way, by the margin; else at all.
        """
        settings, name = self._settings, target.name
        about = sorted({number for cube in constraints for number, _ in cube})
        is_bound = any(concerns(self._propositions[number], name) for number in about)
        if settings.skill == "push" or settings.lift is None or not is_bound:
            return target
        danger, grid = self._danger_on_the_way(target, constraints, about)
        away = np.hypot(*(grid.centres() - np.array(settings.workspace.base)).T).reshape(grid.shape)
        reached = (away >= settings.workspace.nearest) & (away <= settings.workspace.farthest)
        (here, there), goals = target.waypoints, np.zeros(grid.shape, np.bool_)
        goals[grid.cell(*there)] = True
        margin = settings.constraint_margin
        for distance in (margin + grid.cell_size / math.sqrt(2.0), margin, 0.0):
            path = shortest_path(reached & (danger < -distance), grid.cell(*here), goals)
            if path is not None:
                turns = [grid.centre(*each) for each in path.cells[1:-1].tolist()]
                # a way of two points is one that does not matter
                middle = ((here[0] + there[0]) / 2.0, (here[1] + there[1]) / 2.0)
                return replace(target, waypoints=(here, *(turns or [middle]), there))
        return "on every way there a constraint would hold"

    def _danger_on_the_way(
        self, target: Target, constraints: Cubes, about: Sequence[int]
    ) -> tuple[np.ndarray, Grid]:
        """Return (rows, columns): the constraints' robustness with the object carried there; and the grid."""
        settings, tracked = self._settings, self._tracked(target.name)
        if tracked.height is not None and settings.lift:
            low, high = tracked.height
            tracked = replace(tracked, height=(low + settings.lift, high + settings.lift))
        here = centre_of(tracked.footprint)
        grid = settings.workspace.grid.reaching(*here)
        # nothing that is carried over stands in the way
        free = Workspace(grid, supports=frozenset(self._sample.objects))
        formulas = [self._propositions[number] for number in about]
        danger = np.full(grid.shape, -np.inf)
        for turn in dict.fromkeys((0.0, target.turn)):
            objects = {**self._sample.objects, target.name: moved_object(tracked, *here, turn)}
            sample = Sample(self._sample.time_ns, objects, self._sample.signals, self._sample.unknown)
            maps = proposition_maps(formulas, self._regions, sample, target.name, free)
            places = {number: place for place, number in enumerate(about)}
            cubes = tuple(tuple((places[n], wanted) for n, wanted in cube) for cube in constraints)
            np.maximum(danger, danger_of(maps, cubes)[0], out=danger)
        return danger, grid

    def maps_of(self, name: str) -> PropositionMaps:
        """Return the maps of all propositions over the cells of an object.

        Raises:
            TraceError: the sample has no footprint for the object.
        """
        tracked = self._tracked(name)
        if name not in self._maps:
            workspace = self._settings.workspace
            pushes = self._settings.skill == "push"
            # a pushed object crosses all cells from where it lies, which may be outside the workspace
            grid = workspace.grid.reaching(*centre_of(tracked.footprint)) if pushes else workspace.grid
            about = self._propositions, self._regions, self._sample, name
            self._maps[name] = proposition_maps(*about, workspace, grid)
        return self._maps[name]


def with_choice(
    consideration: Consideration, candidates: Sequence[Candidate], settings: Settings
) -> Consideration:
    """Return an edge with its candidates, the best one chosen; pruned if no candidate has a target.

    The best candidate has the shortest path if it is pushed, the greatest robustness if it is placed; the
    first one wins a tie.
    """
    order = by_cost(candidates, settings)
    if not order:
        causes = "; ".join(f"{each.name}: {each.rejected}" for each in candidates)
        kind = "no object can do it" if causes else "no object that can be moved matters to it"
        return replace(consideration, candidates=tuple(candidates), pruned=Reason(kind, causes))
    chosen = order[0]
    marked = (replace(each, is_chosen=number == chosen) for number, each in enumerate(candidates))
    return replace(consideration, candidates=tuple(marked))


def by_cost(candidates: Sequence[Candidate], settings: Settings) -> list[int]:
    """Return the candidates that have a target, by number, the best first."""
    costs = {
        number: each.target.length if settings.skill == "push" else -each.target.robustness
        for number, each in enumerate(candidates)
        if each.target is not None
    }
    return sorted(costs, key=costs.__getitem__)
