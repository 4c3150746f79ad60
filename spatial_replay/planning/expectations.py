"""Expectations: samples that a planner expects after motions, and what holds and can be moved in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from spatial_replay.automata.automaton import Automaton
from spatial_replay.planning.candidates import Movables
from spatial_replay.planning.decisions import Target
from spatial_replay.planning.demands import Budget, Pose, values_in, with_moved
from spatial_replay.planning.edges import Attempts, IdleTransitions, Symbol, idle_transitions
from spatial_replay.planning.maps import Cubes
from spatial_replay.planning.settings import Settings
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.sample import Sample

_MOST_ASIDE: Final = 80
"""The most maps that are computed to bring objects aside for one decision."""


class Foreseen(NamedTuple):
    """A sample that is expected after motions.

    Attributes:
        moved: the poses of the objects moved, by name and in order, each with all its turns.
    """

    sample: Sample
    moved: tuple[tuple[str, Pose], ...] = ()

    def after(self, target: Target) -> Foreseen:
        """Return the scene after a motion."""
        pose = target.x, target.y, target.turn
        moved = dict(self.moved)
        *_, turned = moved.get(target.name, (0.0, 0.0, 0.0))
        moved[target.name] = target.x, target.y, turned + target.turn
        return Foreseen(with_moved(self.sample, {target.name: pose}), tuple(sorted(moved.items())))


class Expectations:
    """The samples that one decision expects, each looked at once.

    Attributes:
        automaton, formulas, regions, settings: of the planner; `formulas` are the automaton's propositions.
        attempts: the motions of the run so far.
        budget, aside_budget: the maps that may still be computed, those for what goes aside apart.
    """

    def __init__(
        self,
        automaton: Automaton,
        formulas: Sequence[Formula],
        regions: Mapping[str, Outline],
        settings: Settings,
        attempts: Attempts,
        budget: Budget,
    ) -> None:
        """Begin with no scene."""
        self.automaton, self.formulas, self.regions = automaton, formulas, regions
        self.settings, self.attempts, self.budget = settings, attempts, budget
        self.aside_budget = Budget(_MOST_ASIDE)
        self._movables: dict[tuple[tuple[str, Pose], ...], Movables] = {}
        self._symbols: dict[tuple[tuple[str, Pose], ...], Symbol] = {}

    def begin(self, movables: Movables) -> Foreseen:
        """Return the scene of the newest sample, of which some maps are known."""
        self._movables[()] = movables
        return Foreseen(movables.sample)

    def symbol(self, scene: Foreseen) -> Symbol:
        """Return the value of each proposition in a scene."""
        if scene.moved not in self._symbols:
            bounds = zip(*self.values(scene.sample), strict=True)
            self._symbols[scene.moved] = tuple(
                None if low < 0.0 <= high else low >= 0.0 for low, high in bounds
            )
        return self._symbols[scene.moved]

    def values(self, sample: Sample, more: Sequence[Formula] = ()) -> tuple[list[float], list[float]]:
        """Return the lower and the upper robustness of all propositions, and more formulas, in a sample."""
        return values_in(sample, [*self.formulas, *more], self.regions)

    def movables(self, scene: Foreseen) -> Movables:
        """Return the movable objects of a scene."""
        if scene.moved not in self._movables:
            about = self.formulas, self.regions, scene.sample, self.settings, self.attempts
            self._movables[scene.moved] = Movables(*about)
        return self._movables[scene.moved]

    def idle(self, scene: Foreseen, state: int) -> IdleTransitions:
        """Return the transitions that time alone takes from a state while a scene stays as it is."""
        return idle_transitions(self.automaton, state, self.symbol(scene))

    def states_after(self, scene: Foreseen, state: int) -> frozenset[int]:
        """Return the states that the automaton can be in after a sample like a scene."""
        return self.automaton.step_set({state}, self.symbol(scene))

    def robustness(self, sample: Sample, cubes: Cubes) -> float:
        """Return the robustness of a disjunction of cubes in a sample."""
        lower, upper = self.values(sample)
        return max(min((lower[n] if w else -upper[n] for n, w in cube), default=0.0) for cube in cubes)

    def traps(self, state: int) -> Cubes:
        """Return the guards of the transitions by which acceptance is lost."""
        lost = (self.automaton.transition(state, each) for each in self.automaton.successors[state])
        return tuple(
            cube
            for each in lost
            if each is not None and each.target not in self.automaton.can_accept
            for cube in each.guard
        )
