"""Foresight: the motions from a sample to acceptance, tried out in samples that the planner expects.

A motion is expected to bring its object to the target, at once. What can be done by one object at a time is
done so; where that fails, or where what comes later would have to move something again, all objects are
arranged together.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations, islice, product
from typing import Final

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.guards import Transition
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.geometry.poses import centre_of
from spatial_replay.planning.arrangements import Arranger, Cell
from spatial_replay.planning.candidates import Movables, by_cost
from spatial_replay.planning.decisions import Candidate, Consideration, Edge, Reason, Target
from spatial_replay.planning.demands import (
    Budget,
    Demand,
    Pose,
    alternatives,
    demands_of,
    with_moved,
)
from spatial_replay.planning.edges import (
    LATER,
    Attempts,
    Symbol,
    consideration_of,
    equivalent_edges,
    idle_transitions,
    moved_later,
)
from spatial_replay.planning.expectations import Expectations, Foreseen
from spatial_replay.planning.map_layers import AVOIDED_CELLS
from spatial_replay.planning.maps import concerns, gradient_map, proposition_maps
from spatial_replay.planning.ordering import MotionOrder
from spatial_replay.planning.settings import Settings
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Formula, Outline
from spatial_replay.trace.sample import Sample

MOST_MAPS: Final = 150
"""The most maps that looking ahead computes for one decision."""
_MOST_WHY_NOT: Final = 60
"""The most maps that are computed to say what cannot be done."""
_MOST_EDGES: Final = 12
"""The most edges that are tried from one state that is foreseen."""
_MOST_ORDERED: Final = 6
"""The most arrangements of which the order of motions is looked for."""
_STILL_TURN: Final = math.radians(1.0)
"""The widest turn of an object that stays as it is."""
_STRICTLY: Final = 1e-12
"""What a constraint has to stay away from holding at least: at 0 it does."""


class Foresight:
    """What can be done from one sample on; made for one decision."""

    def __init__(
        self,
        automaton: Automaton,
        formulas: Sequence[Formula],
        regions: Mapping[str, Outline],
        settings: Settings,
        attempts: Attempts,
    ) -> None:
        """Begin with what is known about a run.

        Args:
            attempts: the motions so far.
        """
        self._expected = Expectations(automaton, formulas, regions, settings, attempts, Budget(MOST_MAPS))
        self._automaton, self._formulas, self._regions = automaton, formulas, regions
        self._settings, self._attempts = settings, attempts
        self._pruned: set[Edge] = set()
        self._known: dict[tuple[int, tuple[tuple[str, Pose], ...]], tuple[Target, ...] | None] = {}
        self._first: Foreseen | None = None
        self._why: dict[str, None] = {}
        self._unordered = ""
        self._ruled_out: frozenset[Edge] = frozenset()

    def decide(
        self,
        consideration: Consideration,
        path: tuple[Transition, ...],
        movables: Movables,
        pruned: Collection[Edge],
    ) -> Consideration:
        """Return an edge with the candidate with which acceptance can be reached, or pruned.

        Args:
            consideration: the edge with the candidates that can take it by one motion, or pruned.
            path: that begins with the edge.
            movables: of the newest sample.
            pruned: the edges given up so far.
        """
        self._first = scene = self._expected.begin(movables)
        self._pruned = set(pruned)
        self._why.clear()
        state = path[0].source
        second_best: Consideration | None = None
        for number in by_cost(consideration.candidates, self._settings):
            target = consideration.candidates[number].target
            if target is None or (rest := self._after(scene, state, (target,), path[0].target)) is None:
                continue
            found = _chosen(consideration, number, (target, *rest))
            names = [each.name for each in found.motions]
            if len(set(names)) == len(names):
                return found
            second_best = second_best or found
        for motions, after in islice(self._joint(scene, path, consideration), 4):
            rest = self._ahead(*after)
            if rest is not None:
                return self._begun(consideration, motions, rest, movables)
        if second_best is not None:
            return second_best
        if not by_cost(consideration.candidates, self._settings):
            return consideration
        why = "; ".join(islice(self._why, 3)) or "no sequence of motions was found"
        unmarked = tuple(replace(each, is_chosen=False) for each in consideration.candidates)
        reason = Reason(LATER, why)
        return replace(consideration, candidates=unmarked, pruned=reason)

    # ------------------------------------------------------------------------------------ one at a time

    def _ahead(self, scene: Foreseen, state: int) -> tuple[Target, ...] | None:
        """Return motions from a state to acceptance; None if there are none, or none were found."""
        if state in self._automaton.accepting:
            return ()
        key = state, scene.moved
        if key not in self._known:
            self._known[key] = None
            self._known[key] = self._found(scene, state)
        return self._known[key]

    def _found(self, scene: Foreseen, state: int) -> tuple[Target, ...] | None:
        automaton, symbol = self._automaton, self._expected.symbol(scene)
        idle = idle_transitions(automaton, state, symbol)
        pruned = self._pruned - idle.edges
        for _ in range(_MOST_EDGES):
            pruned |= self._ruled_out
            path = next(automaton.paths(state, pruned), None)
            if path is None or self._expected.budget.left <= 0:
                return None
            if ahead := idle.along(path):
                return self._ahead(scene, ahead[-1])
            consideration = consideration_of(automaton, path, pruned, symbol)
            for motions, after in self._ways(scene, path, consideration):
                if (rest := self._ahead(*after)) is not None:
                    return (*motions, *rest)
            # what is hopeless is worked out when something has failed
            self._ruled_out = self._hopeless
            pruned.add(consideration.edge)
            pruned |= set(equivalent_edges(automaton, consideration, idle, pruned, symbol))
        return None

    def _ways(
        self, scene: Foreseen, path: tuple[Transition, ...], consideration: Consideration
    ) -> Iterator[tuple[tuple[Target, ...], tuple[Foreseen, int]]]:
        """Yield motions that take the first edge of a path, and where they lead."""
        movables = self._expected.movables(scene)
        candidates: list[Candidate] = []
        later = moved_later(path, self._expected.symbol(scene), self._formulas, movables.names)
        for name in movables.names_for(consideration.progress):
            if not self._expected.budget.spend():
                return
            candidates.append(movables.candidate(name, consideration, self._attempts.places_of(name), later))
        for number in by_cost(candidates, self._settings):
            target = candidates[number].target
            if target is not None:
                after = scene.after(target)
                states = self._automaton.step_set({path[0].source}, self._expected.symbol(after))
                if states == {path[0].target}:
                    yield (target,), (after, path[0].target)
        if not any(each.target for each in candidates):
            causes = "; ".join(f"{each.name}: {each.rejected}" for each in candidates)
            self._why[f"{consideration.progress}: {causes or 'nothing that can be moved matters to it'}"] = (
                None
            )
        yield from islice(self._joint(scene, path, consideration), 2)

    def _after(
        self, scene: Foreseen, state: int, motions: tuple[Target, ...], aim: int
    ) -> tuple[Target, ...] | None:
        """Return the motions that follow some others to acceptance; none if what is seen does not say."""
        for target in motions:
            scene = scene.after(target)
        states = self._automaton.step_set({state}, self._expected.symbol(scene))
        if len(states) > 1:
            return ()
        return self._ahead(scene, aim if aim in states else min(states))

    # ------------------------------------------------------------------------------------ all together

    def _joint(
        self, scene: Foreseen, path: tuple[Transition, ...], consideration: Consideration
    ) -> Iterator[tuple[tuple[Target, ...], tuple[Foreseen, int]]]:
        """Yield motions of several objects that lead along a path, or take its first edge."""
        if self._settings.motions < 2:
            return
        for length in dict.fromkeys((len(path), 1)):
            if length == 1 and not self._can_be_taken_in_turns(scene, path[0]):
                continue
            aims = path[:length]
            if any((each.source, each.target) in self._ruled_out for each in aims):
                continue
            for demands in self._demands_of(scene, aims):
                about = Arranger(scene.sample, self._regions, self._settings, demands, self._expected.budget)
                if self._expected.budget.left <= 0 or about.why_hopeless():
                    continue
                near_failures = []
                for cells in islice(about.arrangements(self._settings.motions), _MOST_ORDERED):
                    if self._is_near_failure(about, cells):
                        near_failures.append(cells)
                    else:
                        yield from self._ordered_from(scene, aims, consideration, about, cells)
                # a motion may fail by chance: places where one did come again, after all others
                for cells in near_failures if self._settings.rules > 1 else ():
                    yield from self._ordered_from(scene, aims, consideration, about, cells)

    def _demands_of(self, scene: Foreseen, aims: Sequence[Transition]) -> Iterator[tuple[Demand, ...]]:
        """Yield what has to hold for some edges to be taken, as conjunctions: all progress, no trap."""
        never = self._expected.traps(aims[0].source)
        kept: list[Demand] = []
        least = self._settings.constraint_margin * (1.0 + 1e-9) + _STRICTLY
        for cube in never:
            if len(cube) == 1:
                ((number, wanted),) = cube
                ways = alternatives(self._formulas[number], not wanted)
                if len(ways) == 1:
                    kept += (Demand(*each, least) for each in ways[0])
        for cubes in islice(product(*(each.guard for each in aims)), 8):
            literals = tuple(dict.fromkeys(literal for cube in cubes for literal in cube))
            if any((number, not wanted) in literals for number, wanted in literals):
                continue
            for demands in demands_of(literals, self._formulas, self._settings.margin):
                yield (*demands, *kept)

    def _can_be_taken_in_turns(self, scene: Foreseen, edge: Transition) -> bool:
        """Return whether moving one object after the other can take an edge, and no other one before.

        This looks at propositions alone: each motion may change those about one object.
        """
        symbol = self._expected.symbol(scene)
        movables = self._expected.movables(scene)
        for cube in edge.guard:
            false = [number for number, wanted in cube if symbol[number] is not wanted]
            wanted = {number: value for number, value in cube if number in false}
            if None in (symbol[number] for number in false) or len(false) > 8:
                continue
            groups = [
                {number for number in false if concerns(self._formulas[number], name)}
                for name in movables.names
            ]
            if self._turns_lead(symbol, wanted, groups, edge):
                return True
        return False

    def _turns_lead(
        self, symbol: Symbol, wanted: Mapping[int, bool], groups: Sequence[set[int]], edge: Transition
    ) -> bool:
        open_sets, seen = [frozenset[int]()], set[frozenset[int]]()
        while open_sets:
            done = open_sets.pop()
            if done in seen:
                continue
            seen.add(done)
            now = tuple(wanted[n] if n in done else value for n, value in enumerate(symbol))
            states = self._automaton.step_set({edge.source}, now)
            if edge.target in states:
                return True
            if states != {edge.source} and done:
                continue
            for group in groups:
                left = sorted(group - done)
                for size in range(1, len(left) + 1):
                    open_sets += (done | frozenset(each) for each in combinations(left, size))
        return False

    def _is_near_failure(self, about: Arranger, cells: Mapping[str, Cell]) -> bool:
        """Return whether an arrangement brings an object near a place where that failed."""
        near = AVOIDED_CELLS * self._settings.workspace.grid.cell_size
        poses = ((name, about.pose(name, cell)) for name, cell in cells.items())
        return any(
            (x - u) ** 2 + (y - v) ** 2 <= near**2
            for name, (x, y, _) in poses
            for u, v in self._attempts.places_of(name)
        )

    def _ordered_from(
        self,
        scene: Foreseen,
        aims: Sequence[Transition],
        consideration: Consideration,
        about: Arranger,
        cells: Mapping[str, Cell],
    ) -> Iterator[tuple[tuple[Target, ...], tuple[Foreseen, int]]]:
        """Yield the motions to an arrangement, in an order in which each is possible."""
        if self._settings.rules > 3:
            cells = self._without_staying(scene, about, cells)
        poses = {name: about.pose(name, cell) for name, cell in cells.items()}
        robustness = self._expected.robustness(about.sample_with(cells), aims[0].guard)
        order = MotionOrder(self._expected, scene, aims, consideration, poses, robustness)
        if (found := order.found()) is not None:
            yield found.motions, (found.scene, found.state)
        elif scene is self._first and len(poses) > 1 and not self._unordered:
            self._unordered = " and ".join(sorted(poses))

    def _without_staying(
        self, scene: Foreseen, about: Arranger, cells: Mapping[str, Cell]
    ) -> Mapping[str, Cell]:
        """Return an arrangement without the objects that may as well stay where they are."""
        for name in list(cells):
            tracked, (x, y, turn) = scene.sample.objects[name], about.pose(name, cells[name])
            others = {other: cell for other, cell in cells.items() if other != name}
            if not isinstance(tracked, TrackedObject) or abs(turn) > _STILL_TURN:
                continue
            away = math.dist((x, y), centre_of(tracked.footprint))
            is_near = away <= self._settings.workspace.grid.cell_size
            if is_near and about.meets(about.sample_with(others)):
                cells = others
        return cells

    def _begun(
        self,
        consideration: Consideration,
        motions: tuple[Target, ...],
        rest: tuple[Target, ...],
        movables: Movables,
    ) -> Consideration:
        """Return an edge with the first of several motions as its chosen candidate."""
        first = motions[0]
        # what is parked first goes to its own place later
        poses = {each.name: (each.x, each.y, each.turn) for each in motions[1:] if each.name != first.name}
        sample = movables.sample
        settings, now = self._settings, movables.maps_of(first.name)
        then = proposition_maps(
            self._formulas,
            self._regions,
            with_moved(sample, poses),
            first.name,
            settings.workspace,
            now.grid,
        )
        cubes = consideration.progress.cubes, consideration.constraints.cubes
        gradient = gradient_map(now, *cubes, settings.workspace, settings.constraint_margin, then)
        place = gradient.cell_of(first.x, first.y, first.turn)
        target = replace(first, robustness=float(gradient.robustness[place]))
        if all(each.name != first.name for each in motions[1:]):
            target = self._refined(target, consideration, movables, poses, (*motions[1:], *rest))
        candidate = Candidate(first.name, gradient, target, is_chosen=True)
        others = tuple(replace(each, is_chosen=False) for each in consideration.candidates)
        planned = (target, *motions[1:], *rest)
        return replace(
            consideration, candidates=(*others, candidate), pruned=None, motions=planned, is_joint=True
        )

    def _refined(
        self,
        target: Target,
        consideration: Consideration,
        movables: Movables,
        poses: Mapping[str, Pose],
        rest: tuple[Target, ...],
    ) -> Target:
        """Return the first of several motions with a refined target, if the others lead on as before."""
        here, *way, there = target.waypoints
        way = way if self._settings.skill == "push" else []
        found = movables.refined(replace(target, waypoints=(here, *way, there)), consideration, None, poses)
        ways = movables.with_way(found, consideration.constraints.cubes)
        if isinstance(ways, str) or movables.is_repeated(ways) or found.robustness <= target.robustness:
            return target
        state = consideration.edge[0]
        before, after = (self._states_along((each, *rest), state) for each in (target, ways))
        return ways if before == after else target

    def _states_along(self, motions: Sequence[Target], state: int) -> list[frozenset[int]]:
        """Return the states after each of some motions, from the newest sample on."""
        scene, states, visited = self._first, frozenset({state}), []
        for each in motions:
            scene = scene.after(each) if scene is not None else None
            if scene is not None:
                states = self._automaton.step_set(states, self._expected.symbol(scene))
                visited.append(states)
        return visited

    # --------------------------------------------------------------------------------------- what is seen

    @cached_property
    def _hopeless(self) -> frozenset[Edge]:
        """The edges that need what no arrangement of the objects can bring about."""
        return self._needing(self._hopeless_literals)

    def _needing(self, literals: Collection[tuple[int, bool]]) -> frozenset[Edge]:
        """Return the edges that cannot be taken without some of these values of propositions."""
        if not self._automaton.is_listable:
            return frozenset()
        return frozenset(
            (each.source, each.target)
            for each in self._automaton.transitions
            if all(any(literal in literals for literal in cube) for cube in each.guard)
        )

    @cached_property
    def _hopeless_literals(self) -> tuple[tuple[int, bool], ...]:
        """The values of propositions that no arrangement of the objects can bring about."""
        if self._first is None or not self._automaton.is_listable:
            return ()
        symbol = self._expected.symbol(self._first)
        literals = {
            literal for each in self._automaton.transitions for cube in each.guard for literal in cube
        }
        hopeless: list[tuple[int, bool]] = []
        budget = Budget(MOST_MAPS)
        for number, wanted in sorted(literals):
            if symbol[number] is (not wanted) and budget.left > 0:
                why = self._why_hopeless(self._first.sample, number, wanted, budget)
                if why:
                    hopeless.append((number, wanted))
                    self._why[f"{self._automaton.propositions[number].literal(wanted)}: {why}"] = None
        return tuple(hopeless)

    def why_not(self, state: int) -> str:
        """Return what every path to acceptance needs and cannot hold, and what stands there.

        Or else, which objects have places to which no order of motions was found; "" without either.
        """
        if self._first is None or self._settings.rules < 4:
            return ""
        for literal in self._hopeless_literals:
            if next(self._automaton.paths(state, self._needing({literal})), None) is None:
                return self._why_never(self._first.sample, literal)
        if not self._unordered:
            return ""
        return f"{self._unordered}: there are places for all, but no order of motions to them was found"

    def _why_never(self, sample: Sample, literal: tuple[int, bool]) -> str:
        """Return what of a proposition cannot hold in any arrangement, and what stands there."""
        budget = Budget(_MOST_WHY_NOT)
        every = demands_of((literal,), self._formulas, self._settings.margin)
        demands = next(iter(every), ())
        # without any of those that are left, the others could hold
        core = list(demands)
        for each in reversed(demands):
            fewer = tuple(other for other in core if other != each)
            if fewer and budget.left > 0 and not self._is_possible(sample, fewer, budget):
                core = list(fewer)
        about = Arranger(sample, self._regions, self._settings, core, budget)
        what = " and ".join(_text_of(each) for each in core)
        if why := about.why_hopeless():
            return f"{what}: {why}"
        stands = about.what_stands()
        said = "no places were found for all at once", stands, "smaller cells (cell_size) may help"
        return f"{what}: {'; '.join(filter(None, said))}"

    def _is_possible(self, sample: Sample, demands: Sequence[Demand], budget: Budget) -> bool:
        """Return whether demands hold in some arrangement, as far as that is looked for."""
        about = Arranger(sample, self._regions, self._settings, demands, budget)
        why = about.why_hopeless()
        return about.is_tight or (
            not why and next(about.arrangements(self._settings.motions), None) is not None
        )

    def _why_hopeless(self, sample: Sample, number: int, wanted: bool, budget: Budget) -> str:
        why = "it never holds"
        for demands in demands_of(((number, wanted),), self._formulas, self._settings.margin):
            about = Arranger(sample, self._regions, self._settings, demands, budget)
            why = about.why_hopeless()
            if about.is_tight:
                return ""
            if not why:
                found = next(about.arrangements(self._settings.motions), None)
                if found is not None or budget.left <= 0:
                    return ""
                why = "no arrangement of objects brings it about"
        return why


def _text_of(demand: Demand) -> str:
    text = format_formula(demand.formula)
    return text if demand.wanted else f"not ({text})"


def _chosen(consideration: Consideration, number: int, motions: tuple[Target, ...]) -> Consideration:
    marked = tuple(
        replace(each, is_chosen=place == number) for place, each in enumerate(consideration.candidates)
    )
    return replace(consideration, candidates=marked, motions=motions)
