"""The order of several motions: one in which each is possible when it is its turn.

An object that is in the way of another one is parked: it goes aside first, and to its own place, if any,
later. So two objects change places, and a pushed one gets past others.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.automata.guards import Transition
from spatial_replay.geometry.arrays import Booleans
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.geometry.poses import centre_of, moved_object, radius_of
from spatial_replay.planning.decisions import Consideration, Target
from spatial_replay.planning.demands import Budget, Demand, Pose, demands_of, with_moved, with_objects
from spatial_replay.planning.edges import BESIDE
from spatial_replay.planning.expectations import Expectations, Foreseen
from spatial_replay.planning.map_layers import distance_to
from spatial_replay.planning.maps import (
    FREE,
    Cubes,
    PropositionMaps,
    concerns,
    danger_of,
    gradient_map,
    proposition_maps,
)
from spatial_replay.planning.paths import reachable
from spatial_replay.planning.targets import nearest_target, points_along, target_in
from spatial_replay.planning.workspace import Grid
from spatial_replay.spec.formula import Atom, Formula, SignedDistance, TrackedName
from spatial_replay.trace.sample import Sample

_MOST_PARKED: Final = 2
"""The most objects that stand aside for others at once."""
_MOST_PLACES: Final = 4
"""The most places that are tried for an object that is brought aside."""
_MOST_MAPS: Final = 40
"""The most maps that are computed to bring objects aside for one arrangement."""


class Ordered(NamedTuple):
    """Motions in an order in which each is possible, and where they lead."""

    motions: tuple[Target, ...]
    scene: Foreseen
    state: int


class MotionOrder:
    """The search for an order of the motions that bring objects to their places."""

    def __init__(
        self,
        expected: Expectations,
        scene: Foreseen,
        aims: Sequence[Transition],
        consideration: Consideration,
        places: Mapping[str, Pose],
        robustness: float,
    ) -> None:
        """Begin in a scene.

        Args:
            aims: the transitions that the motions are to take: a whole path to acceptance, or one edge.
            consideration: the first of them, with what must not hold on the way.
            places: where each object is to go.
            robustness: of the progress set with all objects there.
        """
        self._expected, self._begin, self._aims = expected, scene, aims
        self._constraints, self._places = consideration.constraints.cubes, places
        self._robustness = robustness
        self._dead: set[tuple[frozenset[str], tuple[tuple[str, Pose], ...]]] = set()
        self._idle = set(expected.idle(scene, aims[0].source).states)
        self._is_careful = expected.settings.rules > 3
        self._targets: dict[tuple[tuple[tuple[str, Pose], ...], int, str], Target | None] = {}
        self._most_parked = _MOST_PARKED
        self._aside_maps = Budget(_MOST_MAPS)

    def found(self) -> Ordered | None:
        """Return the first order found, with as few objects brought aside as possible; None without one."""
        if not self._is_careful:
            return self._motions(self._begin, self._aims[0].source, frozenset(self._places))
        for self._most_parked in range(_MOST_PARKED + 1):
            self._dead.clear()
            found = self._motions(self._begin, self._aims[0].source, frozenset(self._places))
            if found is not None:
                return found
        return None

    def _motions(
        self, scene: Foreseen, state: int, left: frozenset[str], parked: tuple[str, ...] = ()
    ) -> Ordered | None:
        """Return the motions of the objects left, and the scene and the state after them."""
        if not left:
            return Ordered((), scene, state) if self._is_done(state) else None
        if (left, scene.moved) in self._dead:
            return None
        is_first = len(left) == len(self._places)
        for name in sorted(left):
            key = scene.moved, state, name
            if key not in self._targets:
                self._targets[key] = self._target(scene, state, name, parked, is_first)
            target = self._targets[key]
            still = tuple(each for each in parked if each != name) if self._is_careful else parked
            if (found := self._on(scene, state, target, left - {name}, still, is_first)) is not None:
                return found
        if self._expected.settings.rules > 1 and len(parked) < self._most_parked:
            for name in sorted(left):
                for other, target in self._aside(scene, state, name, left, parked, is_first):
                    more = (*parked, other)
                    if other not in parked and (
                        found := self._on(scene, state, target, left, more, is_first)
                    ):
                        return found
        self._dead.add((left, scene.moved))
        return None

    def _on(
        self,
        scene: Foreseen,
        state: int,
        target: Target | None,
        left: frozenset[str],
        parked: tuple[str, ...],
        is_first: bool,
    ) -> Ordered | None:
        """Return a motion and those of the objects left after it; None if either is not possible."""
        if target is None:
            return None
        after = scene.after(target)
        if (reached := self._reached(after, state, is_first)) is None:
            return None
        rest = self._motions(after, reached, left, parked)
        return None if rest is None else Ordered((target, *rest.motions), rest.scene, rest.state)

    def _is_done(self, state: int) -> bool:
        automaton = self._expected.automaton
        if len(self._aims) > 1:
            return state in automaton.accepting
        return state == self._aims[0].target or (state in automaton.can_accept and state not in self._idle)

    def _reached(self, scene: Foreseen, state: int, is_first: bool) -> int | None:
        """Return the state after a motion; None if that is not one on the way."""
        aim, is_strict = self._aims[0].target, is_first or len(self._aims) == 1
        for _ in range(len(self._aims)):
            states = self._expected.states_after(scene, state)
            (after,) = states if len(states) == 1 else (-1,)
            if after not in self._expected.automaton.can_accept:
                return None
            if is_strict and after != aim and after not in self._idle:
                return None
            if after == state:
                break
            state = after
            # once the edge is taken, time alone may lead on
            is_strict = is_strict and state != aim
        return state

    def _place_of(self, scene: Foreseen, name: str) -> Pose:
        """Return where an object is to go, with the turn from how it is oriented in a scene."""
        (x, y, turn), still = self._places[name], (0.0, 0.0, 0.0)
        turned = dict(scene.moved).get(name, still)[2] - dict(self._begin.moved).get(name, still)[2]
        return x, y, turn - turned

    def _constraints_at(self, state: int, is_first: bool) -> Cubes:
        """Return what must not hold on the way of the next motion."""
        is_strict = is_first or len(self._aims) == 1
        return self._constraints if is_strict else self._expected.traps(state)

    def _spend(self, parked: Sequence[str], maps: int = 1) -> bool:
        """Count maps; return whether there are any left. Those for what goes aside are counted apart."""
        if not (self._is_careful and parked):
            return self._expected.budget.spend(maps)
        return self._aside_maps.spend(maps) and self._expected.aside_budget.spend(maps)

    def _target(
        self, scene: Foreseen, state: int, name: str, parked: tuple[str, ...], is_first: bool
    ) -> Target | None:
        """Return the motion of an object to its place; None if it is not possible now."""
        settings, constraints = self._expected.settings, self._constraints_at(state, is_first)
        tracked = scene.sample.objects[name]
        if not isinstance(tracked, TrackedObject):
            return None
        if settings.skill == "place" and not is_first:
            return self._placed(scene, name, tracked, constraints)
        if not self._spend(parked):
            return None
        movables = self._expected.movables(scene)
        cubes = self._aims[0].guard, constraints
        gradient = gradient_map(
            movables.maps_of(name), *cubes, settings.workspace, settings.constraint_margin
        )
        found = target_in(
            gradient, tracked, settings, self._place_of(scene, name), movables.failed_here(name)
        )
        if isinstance(found, Target):
            found = movables.with_way(found, constraints)
        if isinstance(found, str) or movables.is_repeated(found):
            return None
        return replace(found, robustness=self._robustness)

    def _placed(
        self, scene: Foreseen, name: str, tracked: TrackedObject, constraints: Cubes
    ) -> Target | None:
        """Return the motion of an object that is carried, if there is room for it at its place."""
        settings, (x, y, turn) = self._expected.settings, self._place_of(scene, name)
        there = with_moved(scene.sample, {name: (x, y, turn)})
        others = [each for each in there.objects if each != name and each not in settings.workspace.supports]
        apart = [Atom("", "dist", SignedDistance(TrackedName(name), TrackedName(each))) for each in others]
        lower, upper = self._expected.values(there, apart)
        if any(each <= settings.workspace.clearance for each in lower[len(self._expected.formulas) :]):
            return None
        for cube in constraints:
            danger = min((upper[n] if w else -lower[n] for n, w in cube), default=0.0)
            if danger >= -settings.constraint_margin:
                return None
        yaw = None if tracked.yaw is None else tracked.yaw + turn
        target = Target(name, x, y, turn, yaw, (centre_of(tracked.footprint), (x, y)), self._robustness)
        found = self._expected.movables(scene).with_way(target, constraints)
        return None if isinstance(found, str) else found

    # ---------------------------------------------------------------------------------------- in the way

    def _aside(
        self,
        scene: Foreseen,
        state: int,
        name: str,
        left: frozenset[str],
        parked: tuple[str, ...],
        is_first: bool,
    ) -> Iterator[tuple[str, Target]]:
        """Yield motions that bring aside what is in the way of an object, or on its place."""
        constraints, settings = self._constraints_at(state, is_first), self._expected.settings
        names = [each for each in self._expected.movables(scene).names if each != name]
        if self._is_careful:
            names = [each for each in names if each in left or each not in {*parked, *self._places}]
        aside = (*parked, name)
        if settings.skill == "push" and not self._spend(aside):
            return
        way = self._way_past(scene, name, names, constraints)
        if way is None:
            return
        bound = self._bound_by(scene, {name: way}, constraints) if self._is_careful else set()
        beside = self._beside(scene, name, names)
        for other in names:
            if not isinstance(scene.sample.objects[other], TrackedObject):
                continue
            clearance = self._clearance(scene, {name: way}, other)
            in_way = other in bound | beside or clearance <= settings.workspace.clearance
            if in_way and self._spend(aside, 3 if self._is_careful else 2):
                for target in self._parked(scene, state, other, {name: way}, left, is_first, other in beside):
                    yield other, target

    def _way_past(
        self, scene: Foreseen, name: str, others: Sequence[str], constraints: Cubes
    ) -> TrackedObject | None:
        """Return all that an object covers on its way as if none of some others was in it."""
        settings, tracked = self._expected.settings, scene.sample.objects[name]
        place = self._place_of(scene, name)
        if not isinstance(tracked, TrackedObject):
            return None
        if settings.skill == "place":
            return moved_object(tracked, *place)
        formulas, workspace = self._expected.formulas, settings.workspace
        if self._is_careful:
            ways = [each for each in self._ways_to_hold(constraints) if not _concerned(each, others)]
            formulas, constraints = _cubes_of(ways)
        free = replace(workspace, supports=workspace.supports.union(others))
        about = formulas, self._expected.regions, scene.sample, name, free
        maps = proposition_maps(*about, self._expected.movables(scene).maps_of(name).grid)
        gradient = gradient_map(maps, ((),), constraints, workspace, settings.constraint_margin)
        target = target_in(gradient, tracked, settings, place)
        if isinstance(target, str):
            return None
        step = workspace.grid.cell_size
        if self._is_careful:
            # footprints that overlap by half leave no gap in which another object could stand
            step = max(step, radius_of(tracked) / 2.0)
        parts = [
            part
            for x, y in points_along(target.waypoints, step)
            for part in moved_object(tracked, x, y).footprint.parts
        ]
        parts += moved_object(tracked, target.x, target.y, target.turn).footprint.parts
        return replace(tracked, footprint=Footprint(tuple(parts)))

    def _ways_to_hold(self, constraints: Cubes) -> list[tuple[Demand, ...]]:
        """Return relations of which no conjunction must hold."""
        return [each for cube in constraints for each in demands_of(cube, self._expected.formulas, 0.0)]

    def _bound_by(
        self, scene: Foreseen, covered: Mapping[str, TrackedObject], constraints: Cubes
    ) -> set[str]:
        """Return the objects because of which a constraint would hold with another one where it is to go."""
        ((name, way),) = covered.items()
        ways = [each for each in self._ways_to_hold(constraints) if _concerned(each, [name])]
        relations = list(dict.fromkeys(each.formula for one in ways for each in one))
        lower, upper = self._expected.values(with_objects(scene.sample, {name: way}), relations)
        first = len(self._expected.formulas)
        numbers = {each: first + place for place, each in enumerate(relations)}
        bound: set[str] = set()
        for one in ways:
            ends = ((numbers[each.formula], each.wanted) for each in one)
            danger = min((upper[n] if wanted else -lower[n] for n, wanted in ends), default=0.0)
            if danger >= -self._expected.settings.constraint_margin:
                bound |= _concerned(one, scene.sample.objects)
        return bound

    def _beside(self, scene: Foreseen, name: str, others: Sequence[str]) -> set[str]:
        """Return the objects so near to one that could not be moved that they may be why."""
        tracked = scene.sample.objects[name]
        if not (isinstance(tracked, TrackedObject) and self._expected.movables(scene).failed_here(name)):
            return set()
        near = BESIDE * radius_of(tracked)
        return {each for each in others if self._clearance(scene, {name: tracked}, each) <= near}

    def _clearance(self, scene: Foreseen, covered: Mapping[str, TrackedObject], other: str) -> float:
        """Return the distance of an object to what another one covers."""
        (name,) = covered
        apart = Atom("", "dist", SignedDistance(TrackedName(name), TrackedName(other)))
        return self._expected.values(with_objects(scene.sample, covered), [apart])[0][-1]

    def _formulas_about(self, name: str, constraints: Cubes) -> tuple[Sequence[Formula], Cubes]:
        """Return relations with an object, and the conjunctions of them that must not hold."""
        if not self._is_careful:
            return (), ()
        return _cubes_of([each for each in self._ways_to_hold(constraints) if _concerned(each, [name])])

    def _is_kept(
        self, sample: Sample, name: str, grid: Grid, formulas: Sequence[Formula], constraints: Cubes
    ) -> tuple[Booleans, PropositionMaps]:
        """Return (A, rows, columns) where an object is clear and no constraint holds, and its maps."""
        settings = self._expected.settings
        maps = proposition_maps(formulas, self._expected.regions, sample, name, settings.workspace, grid)
        is_kept = danger_of(maps, constraints) < -settings.constraint_margin
        return np.asarray(is_kept & (maps.clearance > settings.workspace.clearance)), maps

    def _parked(
        self,
        scene: Foreseen,
        state: int,
        name: str,
        covered: Mapping[str, TrackedObject],
        left: frozenset[str],
        is_first: bool,
        is_beside: bool,
    ) -> Iterator[Target]:
        """Yield motions of an object to places where it is in no one's way, the nearest first.

        There, nothing that must not hold does, neither now nor with the others where they are to go. What
        stands beside an object that could not be moved goes away from it.
        """
        settings, constraints = self._expected.settings, self._constraints_at(state, is_first)
        tracked = scene.sample.objects[name]
        if not isinstance(tracked, TrackedObject):
            return
        movables = self._expected.movables(scene)
        now, workspace = movables.maps_of(name), settings.workspace
        gradient = gradient_map(now, self._aims[0].guard, constraints, workspace, settings.constraint_margin)
        places = {each: self._place_of(scene, each) for each in left if each != name}
        there = with_moved(scene.sample, places)
        later = self._formulas_about(name, self._constraints_at(state, is_first=False))
        clear, maps = self._is_kept(with_objects(there, covered), name, now.grid, *later)
        good = (gradient.blocked == FREE) & clear
        after = np.ones_like(good)
        if self._is_careful and settings.skill == "push":
            after, _ = self._is_kept(there, name, now.grid, *later)
            onwards = _reachable_from(centre_of(tracked.footprint), now.grid, gradient.blocked == FREE)
            if name in self._places:
                # behind those that are at their places by then, it would stay away from its own
                onwards &= _reachable_from(self._place_of(scene, name)[:2], now.grid, after)
            after &= onwards
            good &= after
        # what is picked up or pushed again needs room
        room = np.minimum(maps.clearance, gradient.clearance)
        roomy = good & (room >= settings.room)
        if settings.skill == "push" and not self._is_careful:
            roomy = good
        (blocked,) = covered
        beside = scene.sample.objects[blocked]
        if is_beside and isinstance(beside, TrackedObject):
            good &= distance_to([centre_of(tracked.footprint)], now.grid) > 2.0 * now.grid.cell_size
            far = good & (now.room([blocked]) > BESIDE * radius_of(beside))
            roomy = roomy & far if (roomy & far).any() else far
        free = np.ones_like(good)
        for is_at_edge in (False, True) if self._is_careful and settings.skill == "push" else (False,):
            if is_at_edge:
                # in a corridor no place is clear of a way through its middle: others give way at its edges
                if is_beside:
                    return
                good = roomy = (gradient.blocked == FREE) & after & free
            for _ in range(_MOST_PLACES if self._is_careful else 1):
                among = roomy if roomy.any() else good
                if is_at_edge and among.any():
                    among = among & (maps.clearance >= maps.clearance[among].max() - now.grid.cell_size / 2.0)
                target = nearest_target(gradient, among, tracked, settings, movables.failed_here(name))
                if isinstance(target, str):
                    break
                found = movables.with_way(target, constraints)
                if isinstance(found, Target) and not movables.is_repeated(found):
                    yield found
                away = distance_to([(target.x, target.y)], gradient.grid) > 2.0 * radius_of(tracked)
                free = free & away
                good, roomy = good & away, roomy & away


def _reachable_from(point: tuple[float, float], grid: Grid, free: Booleans) -> Booleans:
    """Return (rows, columns) the cells that are joined to a point's by free ones (A, rows, columns); all if
    that is not free itself."""
    cell = grid.cell(*point)
    return reachable(free[0], cell) if free[0][cell] else np.ones(grid.shape, np.bool_)


def _cubes_of(ways: Sequence[tuple[Demand, ...]]) -> tuple[list[Formula], Cubes]:
    """Return the relations of conjunctions, and these as cubes over them."""
    formulas = list(dict.fromkeys(each.formula for way in ways for each in way))
    return formulas, tuple(tuple((formulas.index(each.formula), each.wanted) for each in way) for way in ways)


def _concerned(demands: Sequence[Demand], names: Iterable[str]) -> set[str]:
    """Return which of some objects demands are about."""
    return {name for name in names if any(concerns(each.formula, name) for each in demands)}
