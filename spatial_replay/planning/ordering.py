"""The order of several motions: one in which each is possible when it is its turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from spatial_replay.automata.guards import Transition
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.planning.candidates import target_in
from spatial_replay.planning.decisions import Consideration, Target
from spatial_replay.planning.demands import Pose, with_moved
from spatial_replay.planning.expectations import Expectations, Foreseen
from spatial_replay.planning.maps import Cubes, centre_of, gradient_map
from spatial_replay.spec.formula import Atom, SignedDistance, TrackedName


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
        self._dead: set[frozenset[str]] = set()
        self._idle = set(expected.idle(scene, aims[0].source).states)

    def found(self) -> Ordered | None:
        """Return the first order found; None without one."""
        return self._motions(self._begin, self._aims[0].source, frozenset(self._places))

    def _motions(self, scene: Foreseen, state: int, left: frozenset[str]) -> Ordered | None:
        """Return the motions of the objects left, and the scene and the state after them."""
        if not left:
            return Ordered((), scene, state) if self._is_done(state) else None
        if left in self._dead:
            return None
        is_first = len(left) == len(self._places)
        for name in sorted(left):
            if (target := self._target(scene, state, name, is_first)) is None:
                continue
            after = scene.after(target)
            if (reached := self._reached(after, state, is_first)) is None:
                continue
            if (rest := self._motions(after, reached, left - {name})) is not None:
                return Ordered((target, *rest.motions), rest.scene, rest.state)
        self._dead.add(left)
        return None

    def _is_done(self, state: int) -> bool:
        automaton = self._expected.automaton
        if len(self._aims) > 1:
            return state in automaton.accepting
        return state == self._aims[0].target or (state in automaton.can_accept and state not in self._idle)

    def _reached(self, scene: Foreseen, state: int, is_first: bool) -> int | None:
        """Return the state after a motion; None if that is not one on the way."""
        allowed = self._idle | {self._aims[0].target}
        for _ in range(len(self._aims)):
            states = self._expected.states_after(scene, state)
            (after,) = states if len(states) == 1 else (-1,)
            if after not in self._expected.automaton.can_accept:
                return None
            if (is_first or len(self._aims) == 1) and after not in allowed:
                return None
            if after == state:
                break
            state = after
        return state

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
        found = target_in(gradient, tracked, settings, self._places[name])
        if isinstance(found, Target):
            found = movables.with_way(found, constraints)
        return None if isinstance(found, str) else replace(found, robustness=self._robustness)

    def _placed(
        self, scene: Foreseen, name: str, tracked: TrackedObject, constraints: Cubes
    ) -> Target | None:
        """Return the motion of an object that is carried, if there is room for it at its place."""
        settings, (x, y, turn) = self._expected.settings, self._places[name]
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
