"""Motions: candidates that can take an edge, predicted samples, and orders of several motions.

An object in the way of another object is parked: it is moved aside first. Later, a parked object with a
target is moved to its target. So two objects can change places, and a pushed object can pass other objects.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.guards import Transition
from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import Footprint, TrackedObject, centre_of, moved_object, radius_of
from spatial_replay.planning.decisions import Candidate, Consideration, Guards, Reason, Target, points_along
from spatial_replay.planning.edges import (
    BESIDE,
    Attempts,
    Budget,
    Demand,
    Pose,
    Symbol,
    demands_of,
    idle_transitions,
    move_objects,
    values_in,
    with_objects,
)
from spatial_replay.planning.maps import (
    FREE,
    OCCUPIED,
    Cube,
    Cubes,
    GradientMap,
    MapParts,
    PropositionMaps,
    concerns,
    danger_of,
    distance_between,
    distance_to,
    gradient_map,
    most_dangerous,
    proposition_maps,
)
from spatial_replay.planning.paths import reachable, shortest_path
from spatial_replay.planning.settings import Grid, Settings, Skill, Workspace
from spatial_replay.planning.targets import (
    Measured,
    begins_as,
    can_turn_in,
    find_target,
    is_clear_leg,
    is_repeated,
    nearest_target,
    refine_target,
    target_in,
)
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.trace import Sample

# ------------------------------------------------------------------------------------------------- candidates

_MOST_NAMED: Final = 2
"""Maximum number of constraints that a reason names."""
_LONGEST_NAME: Final = 60
"""Maximum length of a constraint that a reason names, characters."""
_DIGITS: Final = 9
"""Number of decimal places to which lengths and robustness are rounded for comparisons."""


@dataclass(eq=False)
class Movables:
    """The movable objects of one sample.

    The propositions of an object are measured over the grid once, and used for every edge.
    """

    propositions: Sequence[Formula]
    regions: Mapping[str, Outline]
    sample: Sample
    settings: Settings
    attempts: Attempts
    _maps: dict[str, PropositionMaps] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """The names of the movable objects, in the order of the settings."""
        movable, present = self.settings.movable, self.sample.objects
        return [name for name in (sorted(present) if movable is None else movable) if name in present]

    def names_for(self, progress: Guards) -> list[str]:
        """Return the movable objects on which a progress set depends, in the order of the settings."""
        proposition_numbers = {number for cube in progress.cubes for number, _ in cube}
        return [
            name
            for name in self.names
            if any(concerns(self.propositions[number], name) for number in proposition_numbers)
        ]

    def candidate(
        self,
        name: str,
        consideration: Consideration,
        later: Collection[str] = (),
        *,
        refine: bool = False,
    ) -> Candidate:
        """Return an object with its map for an edge, and with its target or the reason of a rejection.

        Args:
            later: objects that may need a motion after this motion.
            refine: whether to refine the target, if the settings allow it.
        """
        tracked, settings = self.sample.objects[name], self.settings
        gradient = self.gradient(name, consideration.progress.cubes, consideration.constraints.cubes)
        # lack of room may have caused a failed motion, so the object keeps room from everything
        keeps_all_room = settings.room_from == "all" or name in later or self.attempts.needs_room(name)
        room_from = None if keeps_all_room else later
        failed_places = self.attempts.places_of(name)
        # another target does not help an object that cannot be picked up
        target: Target | str = "it could not be picked up where it lies"
        if not self.attempts.failed_pick(name, self.sample, settings):
            room = gradient.made_of.now.room(room_from)
            target = find_target(gradient, tracked, settings, room, failed_places, self.failed_here(name))
        if isinstance(target, Target) and refine:
            target = self.refine(target, consideration, room_from)
        if isinstance(target, Target):
            target = self.with_way(target, consideration.constraints.cubes)
        if isinstance(target, Target) and self.is_repeated(target):
            target = "it was tried wherever it would hold, and nothing has changed since"
        possible_target, rejection = (None, target) if isinstance(target, str) else (target, "")
        return Candidate(
            name,
            gradient,
            possible_target,
            rejection,
            failed=failed_places,
            room_from=_tuple(room_from),
            failures=self.failed_here(name),
        )

    def failed_here(self, name: str) -> tuple[Target, ...]:
        """Return the targets of failed motions of an object in the current scene."""
        return self.attempts.failed_here(name, self.sample, self.settings)

    def is_repeated(self, target: Target) -> bool:
        """Return whether a motion to a target would repeat a failed motion in the current scene."""
        failures = self.failed_here(target.name)
        if self.settings.skill == "place":
            if self.attempts.failed_pick(target.name, self.sample, self.settings):
                return True
            return is_repeated(target, failures, self.settings)
        return begins_as(target, failures, self.sample.objects[target.name])

    def refine(
        self,
        target: Target,
        consideration: Consideration,
        room_from: Collection[str] | None,
        then: Mapping[str, Pose] | None = None,
    ) -> Target:
        """Return the most robust target near a target; the target itself if the settings forbid refinement.

        Args:
            room_from: objects from which the object keeps room; None for all objects.
            then: later poses of other objects, which determine the robustness and are obstacles.
        """
        settings, name = self.settings, target.name
        if not settings.refine:
            return target
        failures = () if settings.skill == "push" else self.failed_here(name)
        measure = self._measures(name, consideration, room_from, then)
        refined_target = refine_target(target, self.sample.objects[name], settings, measure, failures)
        is_usable = settings.skill == "place" or self._is_pushed_to(
            refined_target, consideration.constraints.cubes
        )
        return refined_target if is_usable else target

    def _measures(
        self,
        name: str,
        consideration: Consideration,
        room_from: Collection[str] | None,
        then: Mapping[str, Pose] | None = None,
    ) -> Measured:
        """Return the function that measures an object's maps for an edge, for `refine_target`."""
        settings = self.settings
        progress, constraints = consideration.progress.cubes, consideration.constraints.cubes
        later_sample = self.sample if then is None else move_objects(self.sample, then)

        def measure(grid: Grid, yaws: tuple[float, ...]) -> tuple[GradientMap, Floats]:
            workspace = replace(settings.workspace, yaws=yaws, keeps_yaw=False)
            subject = self.propositions, self.regions
            current_maps = proposition_maps(*subject, self.sample, name, workspace, grid)
            later_maps = (
                current_maps
                if then is None
                else proposition_maps(*subject, later_sample, name, workspace, grid)
            )
            gradient = gradient_map(
                current_maps,
                progress,
                constraints,
                settings.workspace,
                settings.constraint_margin,
                later_maps,
            )
            # places that later motions of other objects occupy
            gradient.blocked[later_maps.clearance <= settings.workspace.clearance] = OCCUPIED
            return gradient, np.minimum(current_maps.room(room_from), later_maps.room(room_from))

        return measure

    def _is_pushed_to(self, target: Target, constraints: Cubes) -> bool:
        """Return whether the last leg of a path and the turn at the path's end are free."""
        # the progress set ((),) is always true, because only blocked cells matter
        gradient = self.gradient(target.name, ((),), constraints)
        cell_size = gradient.grid.cell_size
        last_cells = (
            gradient.grid.cell(*point) for point in points_along(target.waypoints[-2:], cell_size / 2)
        )
        if any(gradient.blocked[0][cell] != FREE for cell in last_cells):
            return False
        if not is_clear_leg(gradient, target.waypoints[-2:], self.settings):
            return False
        target_grid = Grid(target.x - cell_size / 2, target.y - cell_size / 2, cell_size, 1, 1)
        return bool(can_turn_in(target_grid, gradient, target.turn, self.settings).all())

    def with_way(self, target: Target, constraints: Cubes) -> Target | str:
        """Return the target with a path that keeps the constraints, or the reason why there is no such path.

        If no constraint concerns the carried object, the robot may choose the path. On the path, constraints
        are false by the margin plus half a cell's diagonal. Without such a path, constraints are false by the
        margin. As a last resort, constraints are just false.
        """
        settings, name = self.settings, target.name
        proposition_numbers = sorted({number for cube in constraints for number, _ in cube})
        is_bound = any(concerns(self.propositions[number], name) for number in proposition_numbers)
        if settings.skill == "push" or settings.lift is None or not is_bound:
            return target
        danger, grid, map_parts = self._danger_on_the_way(target, constraints, proposition_numbers)
        base_distance = distance_to([settings.workspace.base], grid)
        is_reached = (base_distance >= settings.workspace.nearest) & (
            base_distance <= settings.workspace.farthest
        )
        (start, end), goals = target.waypoints, np.zeros(grid.shape, np.bool_)
        goals[grid.cell(*end)] = True
        margin = settings.constraint_margin
        for distance in (margin + grid.cell_size / math.sqrt(2.0), margin, 0.0):
            path = shortest_path(is_reached & (danger < -distance), grid.cell(*start), goals)
            if path is not None:
                corners = [grid.centre(*cell) for cell in path.cells[1:-1].tolist()]
                # a straight path gets a third waypoint: two waypoints would leave the path to the robot
                middle = ((start[0] + end[0]) / 2.0, (start[1] + end[1]) / 2.0)
                return replace(target, waypoints=(start, *(corners or [middle]), end))
        # the reason names the constraints that the shortest path crosses
        path = shortest_path(is_reached, grid.cell(*start), goals)
        if path is None:
            return "the robot does not reach all of any way there"
        centres = [grid.centre(*cell) for cell in path.cells.tolist()]
        crossed_cells = [grid.cell(*point) for point in points_along(centres, grid.cell_size)]
        texts, indices = most_dangerous(map_parts, (1, *grid.shape))
        crossed_numbers = dict.fromkeys(
            int(indices[0][cell]) for cell in crossed_cells if danger[cell] >= 0.0
        )
        crossed_texts = sorted((texts[number] for number in crossed_numbers), key=len)
        listing = " and ".join(text for text in crossed_texts[:_MOST_NAMED] if len(text) <= _LONGEST_NAME)
        return f"on every way there a constraint would hold{listing and ', on the shortest one ' + listing}"

    def _danger_on_the_way(
        self, target: Target, constraints: Cubes, proposition_numbers: Sequence[int]
    ) -> tuple[np.ndarray, Grid, MapParts]:
        """Return the constraints' greatest robustness with the object above each cell, (rows, columns).

        Also return the grid, and the maps of the object's last orientation.
        """
        settings, tracked = self.settings, self.sample.objects[target.name]
        if tracked.height is not None and settings.lift:
            low, high = tracked.height
            tracked = replace(tracked, height=(low + settings.lift, high + settings.lift))
        centre = centre_of(tracked.footprint)
        grid = settings.workspace.grid.reaching(*centre)
        # only the constraints decide here, so all objects are declared supports, which are no obstacles
        free_workspace = Workspace(grid, supports=frozenset(self.sample.objects))
        formulas = [self.propositions[proposition] for proposition in proposition_numbers]
        positions = {proposition: place for place, proposition in enumerate(proposition_numbers)}
        cubes = tuple(tuple((positions[number], value) for number, value in cube) for cube in constraints)
        carried_objects = (moved_object(tracked, *centre, turn) for turn in dict.fromkeys((0.0, target.turn)))
        samples = (with_objects(self.sample, {target.name: carried}) for carried in carried_objects)
        maps = [
            proposition_maps(formulas, self.regions, sample, target.name, free_workspace)
            for sample in samples
        ]
        danger = np.maximum.reduce([danger_of(turned, cubes)[0] for turned in maps])
        return danger, grid, MapParts(maps[-1], maps[-1], (), cubes)

    def gradient(self, name: str, progress: Cubes, constraints: Cubes) -> GradientMap:
        """Return the map of an object for a progress set and a constraint set."""
        workspace, margin = self.settings.workspace, self.settings.constraint_margin
        return gradient_map(self.maps_of(name), progress, constraints, workspace, margin)

    def maps_of(self, name: str) -> PropositionMaps:
        """Return the maps of all propositions for an object."""
        if name not in self._maps:
            workspace = self.settings.workspace
            is_pushed = self.settings.skill == "push"
            # a pushed object crosses all cells from its start, which may be outside the workspace
            centre = centre_of(self.sample.objects[name].footprint)
            grid = workspace.grid.reaching(*centre) if is_pushed else workspace.grid
            subject = self.propositions, self.regions, self.sample, name
            self._maps[name] = proposition_maps(*subject, workspace, grid)
        return self._maps[name]


def _tuple(names: Collection[str] | None) -> tuple[str, ...] | None:
    return None if names is None else tuple(names)


def with_choice(
    consideration: Consideration, candidates: Sequence[Candidate], settings: Settings
) -> Consideration:
    """Return an edge with its candidates, the best candidate chosen; pruned if no candidate has a target.

    The best candidate is the first candidate of `by_cost`; equal candidates keep their order.
    """
    targets_by_index = by_cost(candidates, settings)
    if not targets_by_index:
        causes = "; ".join(f"{candidate.name}: {candidate.rejected}" for candidate in candidates)
        kind = "no object can do it" if causes else "no object that can be moved matters to it"
        return replace(consideration, candidates=tuple(candidates), pruned=Reason(kind, causes))
    return choose_candidate(
        replace(consideration, candidates=tuple(candidates)), next(iter(targets_by_index))
    )


def choose_candidate(
    consideration: Consideration, number: int | None, motions: tuple[Target, ...] = ()
) -> Consideration:
    """Return an edge with its planned motions, and the candidate `number` chosen; None for no candidate."""
    candidates = tuple(
        replace(candidate, is_chosen=index == number)
        for index, candidate in enumerate(consideration.candidates)
    )
    return replace(consideration, candidates=candidates, motions=motions)


def by_cost(candidates: Sequence[Candidate], settings: Settings) -> dict[int, Target]:
    """Return the targets by the index of their candidate, the best target first."""
    targets = [
        (number, candidate.target)
        for number, candidate in enumerate(candidates)
        if candidate.target is not None
    ]
    return dict(sorted(targets, key=lambda item: costs_of(item[1], settings.skill)))


def costs_of(target: Target, skill: Skill) -> tuple[float, float]:
    """Return two costs: targets are compared by the first cost, and equal targets by the second.

    Pushes compare path lengths first, placements compare robustness first. Numbers are rounded, because equal
    targets differ in their last digits.
    """
    length, robustness = round(target.length, _DIGITS), round(target.robustness, _DIGITS)
    return (length, -robustness) if skill == "push" else (-robustness, length)


# ----------------------------------------------------------------------------------------------- expectations

_LOOK: Final = 0.25
"""Cost of the evaluation of one sample, maps."""


Moved: TypeAlias = tuple[tuple[str, Pose], ...]
"""Poses of moved objects, sorted by name."""


class PredictedState(NamedTuple):
    """A predicted sample after motions.

    Attributes:
        moved: poses of the moved objects, sorted by name; the turn is the sum over an object's motions.
    """

    sample: Sample
    moved: Moved = ()

    def after(self, name: str, pose: Pose) -> PredictedState:
        """Return the predicted state after a motion of an object."""
        (x, y, turn), moved = pose, dict(self.moved)
        *_, previous_turn = moved.get(name, (0.0, 0.0, 0.0))
        moved[name] = x, y, previous_turn + turn
        return PredictedState(move_objects(self.sample, {name: pose}), tuple(sorted(moved.items())))


@dataclass(eq=False)
class Expectations:
    """The predicted samples of one decision, each evaluated once.

    Attributes:
        automaton, regions, settings: automaton, regions and settings of the planner.
        formulas: propositions of the automaton.
        attempts: earlier motions of the run.
        budget: number of maps that the decision may still compute.
    """

    automaton: Automaton
    formulas: Sequence[Formula]
    regions: Mapping[str, Outline]
    settings: Settings
    attempts: Attempts
    budget: Budget
    _movables: dict[Moved, Movables] = field(default_factory=dict)
    _symbols: dict[Moved, Symbol] = field(default_factory=dict)

    def symbol(self, scene: PredictedState) -> Symbol:
        """Return the value of each proposition in a scene."""
        if scene.moved not in self._symbols:
            bounds = zip(*self.values(scene.sample), strict=True)
            self._symbols[scene.moved] = tuple(
                None if low < 0.0 <= high else low >= 0.0 for low, high in bounds
            )
        return self._symbols[scene.moved]

    def values(self, sample: Sample, more: Sequence[Formula] = ()) -> tuple[list[float], list[float]]:
        """Return lower and upper bounds of the robustness of all propositions and of `more` formulas."""
        self.budget.spend(_LOOK)
        return values_in(sample, [*self.formulas, *more], self.regions)

    def clearances(self, sample: Sample, name: str, others: Collection[str]) -> list[float]:
        """Return the distance of an object to each of `others` in a sample, footprint units."""
        self.budget.spend(_LOOK)
        distance_formulas = [distance_between(name, neighbour) for neighbour in others]
        return values_in(sample, distance_formulas, self.regions)[0] if distance_formulas else []

    def movables(self, scene: PredictedState) -> Movables:
        """Return the movable objects of a scene."""
        if scene.moved not in self._movables:
            subject = self.formulas, self.regions, scene.sample, self.settings, self.attempts
            self._movables[scene.moved] = Movables(*subject)
        return self._movables[scene.moved]

    def states_after(self, scene: PredictedState, state: int) -> frozenset[int]:
        """Return the possible states of the automaton after the sample of a scene."""
        return self.automaton.step_set({state}, self.symbol(scene))

    def robustness(self, sample: Sample, cubes: Cubes) -> float:
        """Return the robustness of a disjunction of cubes in a sample."""
        lower, upper = self.values(sample)
        return max(
            min((lower[number] if is_wanted else -upper[number] for number, is_wanted in cube), default=0.0)
            for cube in cubes
        )

    def relations(self, constraints: Cubes) -> list[tuple[Demand, ...]]:
        """Return the constraints as conjunctions of relations; no conjunction may hold."""
        return [conjunction for cube in constraints for conjunction in demands_of(cube, self.formulas, 0.0)]

    def relations_about(self, name: str, constraints: Cubes) -> tuple[list[Formula], Cubes]:
        """Return the constraints on an object: their relations, and cubes over these relations."""
        return _cubes_of(
            [conjunction for conjunction in self.relations(constraints) if _subjects_of(conjunction, [name])]
        )

    def traps(self, state: int) -> Cubes:
        """Return the guards of the transitions that lose acceptance."""
        transitions = (
            self.automaton.transition(state, target) for target in self.automaton.successors[state]
        )
        return tuple(
            cube
            for transition in transitions
            if transition is not None and transition.target not in self.automaton.can_accept
            for cube in transition.guard
        )


# ---------------------------------------------------------------------------------------- an order of several

_MOST_PARKED: Final = 2
"""Maximum number of objects that are parked at the same time."""
_MOST_PLACES: Final = 4
"""Maximum number of places that are tried for a parked object."""
_LOST: Final = -1
"""Result instead of a state, if acceptance is lost or may be lost."""
_ASTRAY: Final = -2
"""Result instead of a state, if the motion takes another edge."""


class Ordered(NamedTuple):
    """Motions in a possible order, with the resulting scene and state.

    Attributes:
        is_aside: whether the first motion parks an object.
        arrangement: number of the arrangement in the search, from 1. 0 for the places of the last decision,
            and for a single motion.
    """

    motions: tuple[Target, ...]
    scene: PredictedState
    state: int
    is_aside: bool = False
    arrangement: int = 0

    @property
    def rule(self) -> str:
        """The rule by which the place of the first motion was chosen."""
        if self.is_aside:
            return (
                "it goes aside: parking places are tried from the nearest on, and the first one from which "
                "all motions work is taken"
            )
        if not self.arrangement:
            return (
                "the places that an earlier decision planned still work and are kept; the target may be a "
                "more robust place within 2 cells of its planned place"
            )
        return (
            f"the first arrangement of objects that works is taken, here number {self.arrangement}; few "
            "objects and robust places are tried first, and better arrangements are not sought"
        )


@dataclass(eq=False)
class MotionOrder:
    """The search for an order of the motions that bring objects to their places.

    Attributes:
        begin: scene before the motions.
        aims: transitions that the motions must take: a whole path to acceptance, or one edge.
        constraints: guards that must not hold before the first transition.
        places: target pose of each object.
        robustness: robustness of the progress set with all objects at their places.
        least: number of maps that the search must leave for the rest of the decision.
    """

    expected: Expectations
    begin: PredictedState
    aims: Sequence[Transition]
    constraints: Cubes
    places: Mapping[str, Pose]
    robustness: float
    least: float
    _dead_ends: set[tuple[frozenset[str], Moved]] = field(default_factory=set)
    _targets: dict[tuple[Moved, int, str], Target | None] = field(default_factory=dict)
    _max_parked: int = _MOST_PARKED
    _has_parked: bool = False

    def __post_init__(self) -> None:
        symbol = self.expected.symbol(self.begin)
        self._idle_states = idle_transitions(self.expected.automaton, self.aims[0].source, symbol).states

    def find(self) -> Ordered | None:
        """Return the first order with the fewest parked objects; None if no order is found."""
        for self._max_parked in range(_MOST_PARKED + 1):
            # with more parked objects, a dead end may have an order
            self._dead_ends.clear()
            self._has_parked = self._max_parked == 0
            sequence = self._motions(self.begin, self.aims[0].source, frozenset(self.places))
            # if no object could be parked, a larger limit does not help
            if sequence is not None or not self._has_parked:
                return sequence
        return None

    def _motions(
        self,
        scene: PredictedState,
        state: int,
        remaining_names: frozenset[str],
        parked_names: tuple[str, ...] = (),
    ) -> Ordered | None:
        """Return the motions of the remaining objects, with the resulting scene and state."""
        if not remaining_names:
            return Ordered((), scene, state) if self._is_done(state) else None
        if (remaining_names, scene.moved) in self._dead_ends or not self._spend(0):
            return None
        is_first = len(remaining_names) == len(self.places)
        for name in sorted(remaining_names):
            target_key = scene.moved, state, name
            if target_key not in self._targets:
                # the next state is checked first, because it costs less than the object's path
                next_scene = scene.after(name, self._place_of(scene, name))
                leads_on = self._next_state(next_scene, state, is_first) >= 0
                self._targets[target_key] = self._target(scene, state, name, is_first) if leads_on else None
            target = self._targets[target_key]
            still_parked = tuple(parked_name for parked_name in parked_names if parked_name != name)
            if (
                sequence := self._on(scene, state, target, remaining_names - {name}, still_parked, is_first)
            ) is not None:
                return sequence
        if len(parked_names) < self._max_parked:
            # a motion that takes another edge is wrong even without a blocker, so nothing is parked for it
            scene_by_name = {
                mover: scene.after(mover, self._place_of(scene, mover)) for mover in sorted(remaining_names)
            }
            able_names = [
                mover
                for mover in scene_by_name
                if self._next_state(scene_by_name[mover], state, is_first) != _ASTRAY
            ]
            for name in able_names:
                for blocker, target in self._aside(
                    scene, state, name, remaining_names, parked_names, is_first
                ):
                    parked_with_blocker, self._has_parked = (*parked_names, blocker), True
                    if blocker not in parked_names and (
                        sequence := self._on(
                            scene, state, target, remaining_names, parked_with_blocker, is_first
                        )
                    ):
                        return sequence._replace(is_aside=True)
        self._dead_ends.add((remaining_names, scene.moved))
        return None

    def _on(
        self,
        scene: PredictedState,
        state: int,
        target: Target | None,
        remaining_names: frozenset[str],
        parked_names: tuple[str, ...],
        is_first: bool,
    ) -> Ordered | None:
        """Return a motion and the motions of the remaining objects; None if a motion is impossible."""
        if target is None:
            return None
        next_scene = scene.after(target.name, target.pose)
        if (next_state := self._next_state(next_scene, state, is_first)) < 0:
            return None
        later = self._motions(next_scene, next_state, remaining_names, parked_names)
        return None if later is None else Ordered((target, *later.motions), later.scene, later.state)

    def _is_done(self, state: int) -> bool:
        automaton = self.expected.automaton
        if len(self.aims) > 1:
            return state in automaton.accepting
        return state == self.aims[0].target or (
            state in automaton.can_accept and state not in self._idle_states
        )

    def _next_state(self, scene: PredictedState, state: int, is_first: bool) -> int:
        """Return the state after a motion; `_LOST` or `_ASTRAY` if the state is not on the path."""
        aim, is_strict = self.aims[0].target, is_first or len(self.aims) == 1
        # the scene stays the same in later samples, which may take further transitions
        for _ in range(len(self.aims)):
            states = self.expected.states_after(scene, state)
            (next_state,) = states if len(states) == 1 else (_LOST,)
            if next_state not in self.expected.automaton.can_accept:
                return _LOST
            if is_strict and next_state != aim and next_state not in self._idle_states:
                return _ASTRAY
            if next_state == state:
                break
            state = next_state
            # after the edge is taken, time alone may take further transitions
            is_strict = is_strict and state != aim
        return state

    def _aims_hold(self, scene: PredictedState, remaining_names: frozenset[str], parked_name: str) -> bool:
        """Return whether the aims hold at the end; a parked object without its own place stays aside."""
        if parked_name in self.places:
            return True
        final_sample = move_objects(
            scene.sample, {name: self._place_of(scene, name) for name in remaining_names}
        )
        return all(self.expected.robustness(final_sample, aim.guard) >= 0.0 for aim in self.aims)

    def _place_of(self, scene: PredictedState, name: str) -> Pose:
        """Return the target pose of an object; its turn starts from the orientation in the scene."""
        (x, y, turn), zero = self.places[name], (0.0, 0.0, 0.0)
        turn_so_far = dict(scene.moved).get(name, zero)[2] - dict(self.begin.moved).get(name, zero)[2]
        return x, y, turn - turn_so_far

    def _constraints_at(self, state: int, is_first: bool) -> Cubes:
        """Return the guards that must not hold during the next motion."""
        is_strict = is_first or len(self.aims) == 1
        return self.constraints if is_strict else self.expected.traps(state)

    def _spend(self, maps: int) -> bool:
        """Subtract maps from the budget, and return whether this search may continue."""
        self.expected.budget.spend(maps)
        return self.expected.budget.left >= self.least

    def _target(self, scene: PredictedState, state: int, name: str, is_first: bool) -> Target | None:
        """Return the motion of an object to its place; None if it is impossible now."""
        settings, constraints = self.expected.settings, self._constraints_at(state, is_first)
        tracked = scene.sample.objects[name]
        if settings.skill == "place":
            return self._carry_target(scene, name, tracked, constraints)
        if not self._spend(1):
            return None
        movables, pose = self.expected.movables(scene), self._place_of(scene, name)
        gradient = movables.gradient(name, self.aims[0].guard, constraints)
        target = target_in(gradient, tracked, settings, pose, movables.failed_here(name))
        if isinstance(target, str) or movables.is_repeated(target):
            return None
        return replace(target, robustness=self.robustness)

    def _carry_target(
        self, scene: PredictedState, name: str, tracked: TrackedObject, constraints: Cubes
    ) -> Target | None:
        """Return the motion of a carried object to its place; None if it is impossible."""
        settings, (x, y, turn) = self.expected.settings, self._place_of(scene, name)
        moved_sample = move_objects(scene.sample, {name: (x, y, turn)})
        obstacle_names = [
            neighbour
            for neighbour in moved_sample.objects
            if neighbour != name and neighbour not in settings.workspace.supports
        ]
        if (
            min(self.expected.clearances(moved_sample, name, obstacle_names), default=math.inf)
            <= settings.workspace.clearance
        ):
            return None
        lower, upper = self.expected.values(moved_sample)
        if any(_danger(cube, lower, upper) >= -settings.constraint_margin for cube in constraints):
            return None
        yaw = None if tracked.yaw is None else tracked.yaw + turn
        target = Target(name, x, y, turn, yaw, (centre_of(tracked.footprint), (x, y)), self.robustness)
        movables = self.expected.movables(scene)
        target_with_way = movables.with_way(target, constraints)
        return (
            None
            if isinstance(target_with_way, str) or movables.is_repeated(target_with_way)
            else target_with_way
        )

    # ---------------------------------------------------------------------------------------- in the way

    def _aside(
        self,
        scene: PredictedState,
        state: int,
        name: str,
        remaining_names: frozenset[str],
        parked_names: tuple[str, ...],
        is_first: bool,
    ) -> Iterator[tuple[str, Target]]:
        """Yield pairs (name, target) that park objects which block the path or the place of an object."""
        constraints, settings = self._constraints_at(state, is_first), self.expected.settings
        other_names = [movable for movable in self.expected.movables(scene).names if movable != name]
        other_names = [
            movable
            for movable in other_names
            if movable in remaining_names or movable not in {*parked_names, *self.places}
        ]
        if settings.skill == "push" and not self._spend(1):
            return
        swept_object = self._way_past(scene, name, other_names, constraints)
        if swept_object is None:
            return
        bound_names = self._bound_by(scene, {name: swept_object}, constraints)
        beside_names = self._beside(scene, name, other_names)
        clearances = self.expected.clearances(
            with_objects(scene.sample, {name: swept_object}), name, other_names
        )
        for blocker, clearance in zip(other_names, clearances, strict=True):
            is_in_way = blocker in beside_names or clearance <= settings.workspace.clearance
            if (is_in_way or blocker in bound_names) and self._spend(3):
                for target in self._parking_motions(
                    scene,
                    state,
                    blocker,
                    {name: swept_object},
                    remaining_names,
                    is_first,
                    blocker in beside_names,
                ):
                    self.expected.budget.parking_places += 1
                    next_scene = scene.after(target.name, target.pose)
                    movables = self.expected.movables(scene)
                    # parking does not help if a constraint still holds with the blocker at its parking place
                    if not is_in_way and blocker in self._bound_by(
                        next_scene, {name: swept_object}, constraints
                    ):
                        continue
                    if not self._aims_hold(next_scene, remaining_names, blocker):
                        continue
                    target_with_way = movables.with_way(target, constraints)
                    if isinstance(target_with_way, Target) and not movables.is_repeated(target_with_way):
                        yield blocker, target_with_way

    def _way_past(
        self, scene: PredictedState, name: str, others: Sequence[str], constraints: Cubes
    ) -> TrackedObject | None:
        """Return a copy of an object that covers its whole path; None without a path.

        The path ignores `others`. An object that is carried covers only its place.
        """
        settings, tracked = self.expected.settings, scene.sample.objects[name]
        pose = self._place_of(scene, name)
        if settings.skill == "place":
            return moved_object(tracked, *pose)
        workspace = settings.workspace
        conjunctions = [
            conjunction
            for conjunction in self.expected.relations(constraints)
            if not _subjects_of(conjunction, others)
        ]
        formulas, constraints = _cubes_of(conjunctions)
        free_workspace = replace(workspace, supports=workspace.supports.union(others))
        subject = formulas, self.expected.regions, scene.sample, name, free_workspace
        maps = proposition_maps(*subject, self.expected.movables(scene).maps_of(name).grid)
        gradient = gradient_map(maps, ((),), constraints, workspace, settings.constraint_margin)
        target = target_in(gradient, tracked, settings, pose)
        if isinstance(target, str):
            return None
        # the spacing is half a radius, so that successive footprints leave no gap for another object
        spacing = max(workspace.grid.cell_size, radius_of(tracked) / 2.0)
        covered_parts = [
            part
            for x, y in points_along(target.waypoints, spacing)
            for part in moved_object(tracked, x, y).footprint.parts
        ]
        covered_parts += moved_object(tracked, target.x, target.y, target.turn).footprint.parts
        return replace(tracked, footprint=Footprint(tuple(covered_parts)))

    def _bound_by(
        self, scene: PredictedState, covered: Mapping[str, TrackedObject], constraints: Cubes
    ) -> set[str]:
        """Return the objects in the constraints that a moved object would violate on its path."""
        ((name, swept_object),) = covered.items()
        relations, cubes = self.expected.relations_about(name, constraints)
        lower, upper = self.expected.values(with_objects(scene.sample, {name: swept_object}), relations)
        bounds = lower[len(self.expected.formulas) :], upper[len(self.expected.formulas) :]
        margin = self.expected.settings.constraint_margin
        held_numbers = {number for cube in cubes if _danger(cube, *bounds) >= -margin for number, _ in cube}
        return {
            tracked_name
            for tracked_name in scene.sample.objects
            if any(concerns(relations[number], tracked_name) for number in held_numbers)
        }

    def _beside(self, scene: PredictedState, name: str, others: Sequence[str]) -> set[str]:
        """Return the neighbours of an object that may have blocked the object's failed motion."""
        if not self.expected.movables(scene).failed_here(name):
            return set()
        near_distance = BESIDE * radius_of(scene.sample.objects[name])
        clearances = zip(others, self.expected.clearances(scene.sample, name, others), strict=True)
        return {neighbour for neighbour, clearance in clearances if clearance <= near_distance}

    def _is_kept(
        self, sample: Sample, name: str, grid: Grid, formulas: Sequence[Formula], constraints: Cubes
    ) -> tuple[Booleans, PropositionMaps]:
        """Return whether an object is clear and keeps constraints, (A, rows, columns), and its maps."""
        settings = self.expected.settings
        maps = proposition_maps(formulas, self.expected.regions, sample, name, settings.workspace, grid)
        is_kept = danger_of(maps, constraints) < -settings.constraint_margin
        return np.asarray(is_kept & (maps.clearance > settings.workspace.clearance)), maps

    def _parking_motions(
        self,
        scene: PredictedState,
        state: int,
        name: str,
        covered: Mapping[str, TrackedObject],
        remaining_names: frozenset[str],
        is_first: bool,
        is_beside: bool,
    ) -> Iterator[Target]:
        """Yield motions of an object to parking places, nearest places first.

        At a parking place no constraint holds now, and no constraint holds with the other objects at their
        places. With `is_beside`, the object is moved away from the object whose motion failed.
        """
        settings, constraints = self.expected.settings, self._constraints_at(state, is_first)
        tracked = scene.sample.objects[name]
        movables = self.expected.movables(scene)
        maps_now, gradient = movables.maps_of(name), movables.gradient(name, self.aims[0].guard, constraints)
        final_poses = {mover: self._place_of(scene, mover) for mover in remaining_names if mover != name}
        final_sample = move_objects(scene.sample, final_poses)
        later_relations = self.expected.relations_about(name, self._constraints_at(state, is_first=False))
        is_clear, maps = self._is_kept(
            with_objects(final_sample, covered), name, maps_now.grid, *later_relations
        )
        good_cells = (gradient.blocked == FREE) & is_clear
        later_cells = np.ones_like(good_cells)
        if settings.skill == "push":
            later_cells, _ = self._is_kept(final_sample, name, maps_now.grid, *later_relations)
            reachable_cells = _reachable_from(
                centre_of(tracked.footprint), maps_now.grid, gradient.blocked == FREE
            )
            if name in self.places:
                # at their places, the other objects must not block the parked object's path
                reachable_cells &= _reachable_from(
                    self._place_of(scene, name)[:2], maps_now.grid, later_cells
                )
            later_cells &= reachable_cells
            good_cells &= later_cells
        # an object that is picked up or pushed again needs room
        room = np.minimum(maps.clearance, gradient.clearance)
        roomy_cells = good_cells & (room >= settings.room)
        if settings.skill == "place":
            # near a constraint, the next motion might have to stop
            spare_margin = settings.constraint_margin + 2.0 * maps_now.grid.cell_size
            far_cells = roomy_cells & (danger_of(maps, later_relations[1]) < -spare_margin)
            roomy_cells = far_cells if far_cells.any() else roomy_cells
        (blocked_name,) = covered
        if is_beside:
            good_cells &= (
                distance_to([centre_of(tracked.footprint)], maps_now.grid) > 2.0 * maps_now.grid.cell_size
            )
            far_cells = good_cells & (
                maps_now.room([blocked_name]) > BESIDE * radius_of(scene.sample.objects[blocked_name])
            )
            roomy_cells = roomy_cells & far_cells if (roomy_cells & far_cells).any() else far_cells
        untried_cells = np.ones_like(good_cells)
        for is_at_edge in (False, True) if settings.skill == "push" else (False,):
            if is_at_edge:
                # in a corridor no place is clear of a path through the middle, so its sides are tried
                if is_beside:
                    return
                good_cells = roomy_cells = (gradient.blocked == FREE) & later_cells & untried_cells
            for _ in range(_MOST_PLACES):
                allowed_cells = roomy_cells if roomy_cells.any() else good_cells
                if is_at_edge and allowed_cells.any():
                    allowed_cells = allowed_cells & (
                        maps.clearance >= maps.clearance[allowed_cells].max() - maps_now.grid.cell_size / 2.0
                    )
                target = nearest_target(
                    gradient, allowed_cells, tracked, settings, movables.failed_here(name)
                )
                if isinstance(target, str):
                    break
                yield target
                # the next place to try is at least a diameter away
                is_away = distance_to([(target.x, target.y)], gradient.grid) > 2.0 * radius_of(tracked)
                untried_cells = untried_cells & is_away
                good_cells, roomy_cells = good_cells & is_away, roomy_cells & is_away


def _reachable_from(point: tuple[float, float], grid: Grid, free: Booleans) -> Booleans:
    """Return the cells (rows, columns) connected to a point's cell by free cells (A, rows, columns).

    If the point's cell is not free, return all cells.
    """
    cell = grid.cell(*point)
    return reachable(free[0], cell) if free[0][cell] else np.ones(grid.shape, np.bool_)


def _cubes_of(conjunctions: Sequence[tuple[Demand, ...]]) -> tuple[list[Formula], Cubes]:
    """Return the relations in conjunctions, and the conjunctions as cubes over these relations."""
    formulas = list(dict.fromkeys(demand.formula for conjunction in conjunctions for demand in conjunction))
    return formulas, tuple(
        tuple((formulas.index(demand.formula), demand.wanted) for demand in conjunction)
        for conjunction in conjunctions
    )


def _danger(cube: Cube, lower: Sequence[float], upper: Sequence[float]) -> float:
    """Return the greatest possible robustness of a conjunction, from bounds of its members."""
    return min((upper[number] if value else -lower[number] for number, value in cube), default=0.0)


def _subjects_of(demands: Sequence[Demand], names: Iterable[str]) -> set[str]:
    """Return the objects among `names` that demands concern."""
    return {name for name in names if any(concerns(demand.formula, name) for demand in demands)}
