"""The order of several motions: one in which each is possible when it is its turn.

An object that is in the way of another one is parked: it goes aside first, and to its own place, if any,
later. So two objects change places, and a pushed one gets past others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.automata.guards import Transition
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.planning.candidates import nearest_target, points_along, target_in
from spatial_replay.planning.decisions import Consideration, Target
from spatial_replay.planning.demands import Pose, with_moved
from spatial_replay.planning.expectations import Expectations, Foreseen
from spatial_replay.planning.maps import FREE, Cubes, centre_of, gradient_map, moved_object, proposition_maps
from spatial_replay.spec.formula import Atom, SignedDistance, TrackedName
from spatial_replay.trace.sample import Sample

_MOST_PARKED: Final = 2
"""The most objects that are brought aside for others."""


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

    def found(self) -> Ordered | None:
        """Return the first order found; None without one."""
        return self._motions(self._begin, self._aims[0].source, frozenset(self._places))

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
            target = self._target(scene, state, name, is_first)
            if (found := self._on(scene, state, target, left - {name}, parked, is_first)) is not None:
                return found
        if self._expected.settings.rules > 1 and len(parked) < _MOST_PARKED:
            for name in sorted(left):
                for other, target in self._aside(scene, state, name, left, is_first):
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

    def _target(self, scene: Foreseen, state: int, name: str, is_first: bool) -> Target | None:
        """Return the motion of an object to its place; None if it is not possible now."""
        settings, constraints = self._expected.settings, self._constraints_at(state, is_first)
        tracked = scene.sample.objects[name]
        if not isinstance(tracked, TrackedObject):
            return None
        if settings.skill == "place" and not is_first:
            return self._placed(scene, name, tracked, constraints)
        if not self._expected.budget.spend():
            return None
        movables = self._expected.movables(scene)
        cubes = self._aims[0].guard, constraints
        gradient = gradient_map(
            movables.maps_of(name), *cubes, settings.workspace, settings.constraint_margin
        )
        found = target_in(gradient, tracked, settings, self._place_of(scene, name))
        if isinstance(found, Target):
            found = movables.with_way(found, constraints)
        return None if isinstance(found, str) else replace(found, robustness=self._robustness)

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
        self, scene: Foreseen, state: int, name: str, left: frozenset[str], is_first: bool
    ) -> Iterator[tuple[str, Target]]:
        """Yield motions that bring aside what is in the way of an object, or on its place."""
        way = self._way_past(scene, state, name, is_first)
        movables = self._expected.movables(scene)
        for other in (each for each in movables.names if each != name and way is not None):
            tracked = scene.sample.objects[other]
            if not (isinstance(tracked, TrackedObject) and way is not None):
                continue
            if self._clearance(scene, {name: way}, other) > self._expected.settings.workspace.clearance:
                continue
            if (target := self._parked(scene, state, other, {name: way}, left, is_first)) is not None:
                yield other, target

    def _way_past(self, scene: Foreseen, state: int, name: str, is_first: bool) -> TrackedObject | None:
        """Return all that an object covers on its way as if nothing that can be moved was in it."""
        settings, tracked = self._expected.settings, scene.sample.objects[name]
        place = self._place_of(scene, name)
        if not isinstance(tracked, TrackedObject):
            return None
        if settings.skill == "place":
            return moved_object(tracked, *place)
        if not self._expected.budget.spend():
            return None
        movables = self._expected.movables(scene)
        workspace = settings.workspace
        free = replace(workspace, supports=workspace.supports | set(movables.names))
        about = self._expected.formulas, self._expected.regions, scene.sample, name, free
        maps = proposition_maps(*about, movables.maps_of(name).grid)
        cubes = self._aims[0].guard, self._constraints_at(state, is_first)
        gradient = gradient_map(maps, *cubes, workspace, settings.constraint_margin)
        target = target_in(gradient, tracked, settings, place)
        if isinstance(target, str):
            return None
        step = workspace.grid.cell_size
        parts = [
            part
            for x, y in points_along(target.waypoints, step)
            for part in moved_object(tracked, x, y).footprint.parts
        ]
        parts += moved_object(tracked, target.x, target.y, target.turn).footprint.parts
        return replace(tracked, footprint=Footprint(tuple(parts)))

    def _clearance(self, scene: Foreseen, covered: Mapping[str, TrackedObject], other: str) -> float:
        """Return the distance of an object to what another one covers."""
        objects = {**scene.sample.objects, **covered}
        sample = Sample(scene.sample.time_ns, objects, scene.sample.signals, scene.sample.unknown)
        (name,) = covered
        apart = Atom("", "dist", SignedDistance(TrackedName(name), TrackedName(other)))
        return self._expected.values(sample, [apart])[0][-1]

    def _parked(
        self,
        scene: Foreseen,
        state: int,
        name: str,
        covered: Mapping[str, TrackedObject],
        left: frozenset[str],
        is_first: bool,
    ) -> Target | None:
        """Return the motion of an object to the nearest place where it is in no one's way, if any."""
        settings, constraints = self._expected.settings, self._constraints_at(state, is_first)
        tracked = scene.sample.objects[name]
        if not (isinstance(tracked, TrackedObject) and self._expected.budget.spend(2)):
            return None
        movables = self._expected.movables(scene)
        now = movables.maps_of(name)
        gradient = gradient_map(
            now, self._aims[0].guard, constraints, settings.workspace, settings.constraint_margin
        )
        places = {each: self._place_of(scene, each) for each in left if each != name}
        there = with_moved(scene.sample, places)
        objects = {**there.objects, **covered}
        later = Sample(there.time_ns, objects, there.signals, there.unknown)
        workspace, about = settings.workspace, (self._expected.regions, later, name)
        clearance = proposition_maps((), *about, workspace, now.grid).clearance
        good = (gradient.blocked == FREE) & (clearance > workspace.clearance)
        if settings.skill == "place":
            # what is picked up again needs room
            roomy = good & (np.minimum(clearance, gradient.clearance) >= settings.room)
            good = roomy if roomy.any() else good
        target = nearest_target(gradient, good, tracked, settings)
        if isinstance(target, Target):
            target = movables.with_way(target, constraints)
        return None if isinstance(target, str) else target
