"""Candidates: objects that could be moved to take an edge of the automaton, with a target for each."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from spatial_replay.errors import TraceError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.geometry.poses import centre_of, moved_object
from spatial_replay.planning.decisions import Candidate, Consideration, Guards, Reason, Target
from spatial_replay.planning.demands import Pose, with_moved, with_objects
from spatial_replay.planning.edges import Attempts
from spatial_replay.planning.map_layers import most_dangerous
from spatial_replay.planning.maps import (
    FREE,
    OCCUPIED,
    Cubes,
    GradientMap,
    MapParts,
    PropositionMaps,
    concerns,
    danger_of,
    gradient_map,
    proposition_maps,
)
from spatial_replay.planning.paths import shortest_path
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.targets import (
    Measured,
    begins_as,
    between_cells,
    can_turn_in,
    find_target,
    is_repeated,
    points_along,
    refined,
)
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.sample import Sample

_MOST_NAMED: Final = 2
"""The most constraints that a reason names."""
_LONGEST_NAME: Final = 60
"""The most characters of one of them."""


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
        keeps_all = settings.room_from == "all" or name in later or self._attempts.needs_room(name)
        room_from = None if keeps_all else later
        if self._attempts.failed_pick(name, self._sample, settings):
            # no other target helps
            rejected = "it could not be picked up where it lies"
            return Candidate(
                name, gradient, None, rejected, failed=tuple(failed), room_from=_tuple(room_from)
            )
        target = find_target(
            gradient, tracked, settings, maps.room(room_from), failed, self.failed_here(name)
        )
        if isinstance(target, str) and settings.refine and settings.rules > 3:
            measured = self._measures(name, consideration, room_from)
            target = between_cells(gradient, tracked, settings, measured, self.failed_here(name)) or target
        if isinstance(target, Target) and refine:
            target = self.refined(target, consideration, room_from)
        if isinstance(target, Target):
            target = self.with_way(target, consideration.constraints.cubes)
        if isinstance(target, Target) and self.is_repeated(target):
            target = "it was tried wherever it would hold, and nothing has changed since"
        found, why = (None, target) if isinstance(target, str) else (target, "")
        return Candidate(name, gradient, found, why, failed=tuple(failed), room_from=_tuple(room_from))

    def failed_places(self, name: str) -> tuple[tuple[float, float], ...]:
        """Return the places (x, y) where moving an object failed, whatever it was for."""
        return self._attempts.places_of(name)

    def failed_here(self, name: str) -> tuple[Target, ...]:
        """Return the targets for which motions of an object failed while everything stood as it does."""
        return self._attempts.failed_here(name, self._sample, self._settings)

    def is_repeated(self, target: Target) -> bool:
        """Return whether a motion to a target would repeat one that failed while everything stood as now."""
        failures = self.failed_here(target.name)
        if self._settings.skill == "place":
            if self._attempts.failed_pick(target.name, self._sample, self._settings):
                return True
            return is_repeated(target, failures, self._settings)
        return begins_as(target, failures, self._tracked(target.name))

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
        failures = () if settings.skill == "push" else self.failed_here(name)
        measured = self._measures(name, consideration, room_from, then)
        found = refined(target, self._tracked(name), settings, measured, failures)
        is_kept = settings.skill == "place" or self._is_pushed_to(found, consideration.constraints.cubes)
        return found if is_kept else target

    def _measures(
        self,
        name: str,
        consideration: Consideration,
        room_from: Collection[str] | None,
        then: Mapping[str, Pose] | None = None,
    ) -> Measured:
        """Return what measures maps of an object for an edge over any grid; see `refined`."""
        settings = self._settings
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

        return measured

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
        danger, grid, parts = self._danger_on_the_way(target, constraints, about)
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
        if settings.rules < 4:
            return "on every way there a constraint would hold"
        # what is crossed by the shortest way of all
        path = shortest_path(reached, grid.cell(*here), goals)
        if path is None:
            return "the robot does not reach all of any way there"
        centres = [grid.centre(*each) for each in path.cells.tolist()]
        crossed = [grid.cell(*each) for each in points_along(centres, grid.cell_size)]
        texts, which = most_dangerous(parts, (1, *grid.shape))
        numbers = dict.fromkeys(int(which[0][each]) for each in crossed if danger[each] >= 0.0)
        named = sorted((texts[number] for number in numbers), key=len)
        said = " and ".join(each for each in named[:_MOST_NAMED] if len(each) <= _LONGEST_NAME)
        return f"on every way there a constraint would hold{said and ', on the shortest one ' + said}"

    def _danger_on_the_way(
        self, target: Target, constraints: Cubes, about: Sequence[int]
    ) -> tuple[np.ndarray, Grid, MapParts]:
        """Return (rows, columns): the constraints' robustness with the object carried there.

        Also return the grid, and the maps that this was computed from, with the object turned last.
        """
        settings, tracked = self._settings, self._tracked(target.name)
        if tracked.height is not None and settings.lift:
            low, high = tracked.height
            tracked = replace(tracked, height=(low + settings.lift, high + settings.lift))
        here = centre_of(tracked.footprint)
        grid = settings.workspace.grid.reaching(*here)
        # nothing that is carried over stands in the way
        free = Workspace(grid, supports=frozenset(self._sample.objects))
        formulas = [self._propositions[number] for number in about]
        places = {number: place for place, number in enumerate(about)}
        cubes = tuple(tuple((places[n], wanted) for n, wanted in cube) for cube in constraints)
        moved = (moved_object(tracked, *here, turn) for turn in dict.fromkeys((0.0, target.turn)))
        samples = (with_objects(self._sample, {target.name: each}) for each in moved)
        maps = [proposition_maps(formulas, self._regions, each, target.name, free) for each in samples]
        danger = np.maximum.reduce([danger_of(each, cubes)[0] for each in maps])
        return danger, grid, MapParts(maps[-1], maps[-1], (), cubes)

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


def _tuple(names: Collection[str] | None) -> tuple[str, ...] | None:
    return None if names is None else tuple(names)


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
