"""Foresight: the motions from a sample to acceptance, tried out in samples that the planner expects.

A motion is expected to bring its object to the target, at once. What can be done by one object at a time is
done so; where that fails, or where what comes later would have to move something again, all objects are
arranged together.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations, islice, product
from typing import Final

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.guards import Transition
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.planning.arrangements import Arranger, Cell
from spatial_replay.planning.candidates import AVOIDED_CELLS, Movables, by_cost, target_in
from spatial_replay.planning.decisions import Candidate, Consideration, Edge, Reason, Target
from spatial_replay.planning.demands import (
    Budget,
    Demand,
    Foreseen,
    Pose,
    alternatives,
    demands_of,
    values_in,
    with_moved,
)
from spatial_replay.planning.edges import (
    LATER,
    Symbol,
    consideration_of,
    equivalent_edges,
    idle_transitions,
)
from spatial_replay.planning.maps import Cubes, centre_of, concerns, gradient_map, proposition_maps
from spatial_replay.planning.settings import Settings
from spatial_replay.spec.formula import Atom, Formula, Outline, SignedDistance, TrackedName
from spatial_replay.trace.sample import Sample

MOST_MAPS: Final = 150
"""The most maps that looking ahead computes for one decision."""
_MOST_EDGES: Final = 12
"""The most edges that are tried from one state that is foreseen."""
_MOST_ORDERED: Final = 6
"""The most arrangements of which the order of motions is looked for."""
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
        failed: Callable[[str], Collection[tuple[float, float]]],
    ) -> None:
        """Begin with what is known about a run.

        Args:
            failed: gives the places where an object could not be brought.
        """
        self._automaton, self._formulas, self._regions = automaton, formulas, regions
        self._settings, self._failed = settings, failed
        self._pruned: set[Edge] = set()
        self._budget = Budget(MOST_MAPS)
        self._known: dict[tuple[int, tuple[tuple[str, Pose], ...]], tuple[Target, ...] | None] = {}
        self._movables: dict[tuple[tuple[str, Pose], ...], Movables] = {}
        self._first: Foreseen | None = None
        self._why: dict[str, None] = {}
        self._symbols: dict[tuple[tuple[str, Pose], ...], Symbol] = {}
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
        self._first = scene = Foreseen(movables.sample)
        self._pruned = set(pruned)
        self._movables[()] = movables
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
        automaton, symbol = self._automaton, self._symbol(scene)
        idle = idle_transitions(automaton, state, symbol)
        pruned = self._pruned - idle.edges
        for _ in range(_MOST_EDGES):
            pruned |= self._ruled_out
            path = next(automaton.paths(state, pruned), None)
            if path is None or self._budget.left <= 0:
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
        movables = self._movables_in(scene)
        candidates: list[Candidate] = []
        for name in movables.names_for(consideration.progress):
            if not self._budget.spend():
                return
            candidates.append(movables.candidate(name, consideration, self._failed(name)))
        for number in by_cost(candidates, self._settings):
            target = candidates[number].target
            if target is not None:
                after = scene.after(target)
                states = self._automaton.step_set({path[0].source}, self._symbol(after))
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
        states = self._automaton.step_set({state}, self._symbol(scene))
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
                about = Arranger(scene.sample, self._regions, self._settings, demands, self._budget)
                if self._budget.left <= 0 or about.why_hopeless():
                    continue
                arrangements = about.arrangements(self._settings.motions)
                for cells in islice(arrangements, _MOST_ORDERED):
                    yield from self._ordered_from(scene, aims, consideration, about, cells)

    def _demands_of(self, scene: Foreseen, aims: Sequence[Transition]) -> Iterator[tuple[Demand, ...]]:
        """Yield what has to hold for some edges to be taken, as conjunctions: all progress, no trap."""
        never = self._traps(aims[0].source)
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

    def _traps(self, state: int) -> Cubes:
        """Return the guards of the transitions by which acceptance is lost."""
        automaton = self._automaton
        lost = (automaton.transition(state, each) for each in automaton.successors[state])
        return tuple(
            cube
            for each in lost
            if each is not None and each.target not in automaton.can_accept
            for cube in each.guard
        )

    def _can_be_taken_in_turns(self, scene: Foreseen, edge: Transition) -> bool:
        """Return whether moving one object after the other can take an edge, and no other one before.

        This looks at propositions alone: each motion may change those about one object.
        """
        symbol = self._symbol(scene)
        movables = self._movables_in(scene)
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

    def _ordered_from(
        self,
        scene: Foreseen,
        aims: Sequence[Transition],
        consideration: Consideration,
        about: Arranger,
        cells: Mapping[str, Cell],
    ) -> Iterator[tuple[tuple[Target, ...], tuple[Foreseen, int]]]:
        """Yield the motions to an arrangement, in an order in which each is possible."""
        poses = {name: about.pose(name, cell) for name, cell in cells.items()}
        near = AVOIDED_CELLS * self._settings.workspace.grid.cell_size
        for name, (x, y, _) in poses.items():
            if any((x - u) ** 2 + (y - v) ** 2 <= near**2 for u, v in self._failed(name)):
                return
        robustness = self._robustness(about.sample_with(cells), aims[0].guard)
        order = _Order(self, scene, aims, consideration, cells, poses, robustness)
        if (found := order.motions(scene, aims[0].source, frozenset(poses))) is not None:
            motions, after, state = found
            yield motions, (after, state)

    def _robustness(self, sample: Sample, cubes: Cubes) -> float:
        lower, upper = values_in(sample, self._formulas, self._regions)
        return max(min((lower[n] if w else -upper[n] for n, w in cube), default=0.0) for cube in cubes)

    def _begun(
        self,
        consideration: Consideration,
        motions: tuple[Target, ...],
        rest: tuple[Target, ...],
        movables: Movables,
    ) -> Consideration:
        """Return an edge with the first of several motions as its chosen candidate."""
        first = motions[0]
        poses = {each.name: (each.x, each.y, each.turn) for each in motions[1:]}
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
        candidate = Candidate(first.name, gradient, target, is_chosen=True)
        others = tuple(replace(each, is_chosen=False) for each in consideration.candidates)
        planned = (target, *motions[1:], *rest)
        return replace(
            consideration, candidates=(*others, candidate), pruned=None, motions=planned, is_joint=True
        )

    # --------------------------------------------------------------------------------------- what is seen

    def _symbol(self, scene: Foreseen) -> Symbol:
        if scene.moved not in self._symbols:
            bounds = zip(*values_in(scene.sample, self._formulas, self._regions), strict=True)
            self._symbols[scene.moved] = tuple(
                None if low < 0.0 <= high else low >= 0.0 for low, high in bounds
            )
        return self._symbols[scene.moved]

    def _movables_in(self, scene: Foreseen) -> Movables:
        if scene.moved not in self._movables:
            about = self._formulas, self._regions, scene.sample, self._settings
            self._movables[scene.moved] = Movables(*about)
        return self._movables[scene.moved]

    @cached_property
    def _hopeless(self) -> frozenset[Edge]:
        """The edges that need what no arrangement of the objects can bring about."""
        if self._first is None:
            return frozenset()
        symbol = self._symbol(self._first)
        literals = {
            literal for each in self._automaton.transitions for cube in each.guard for literal in cube
        }
        hopeless: set[tuple[int, bool]] = set()
        budget = Budget(MOST_MAPS)
        for number, wanted in sorted(literals):
            if symbol[number] is (not wanted) and budget.left > 0:
                why = self._why_hopeless(self._first.sample, number, wanted, budget)
                if why:
                    hopeless.add((number, wanted))
                    self._why[f"{self._automaton.propositions[number].literal(wanted)}: {why}"] = None
        return frozenset(
            (each.source, each.target)
            for each in self._automaton.transitions
            if all(any(literal in hopeless for literal in cube) for cube in each.guard)
        )

    def _why_hopeless(self, sample: Sample, number: int, wanted: bool, budget: Budget) -> str:
        why = "it never holds"
        for demands in demands_of(((number, wanted),), self._formulas, self._settings.margin):
            about = Arranger(sample, self._regions, self._settings, demands, budget)
            why = about.why_hopeless()
            if not why:
                found = next(about.arrangements(self._settings.motions), None)
                if found is not None or budget.left <= 0:
                    return ""
                why = "no arrangement of objects brings it about"
        return why


class _Order:
    """The search for an order of motions in which each is possible."""

    def __init__(
        self,
        foresight: Foresight,
        scene: Foreseen,
        aims: Sequence[Transition],
        consideration: Consideration,
        cells: Mapping[str, Cell],
        poses: Mapping[str, Pose],
        robustness: float,
    ) -> None:
        self._of, self._begin, self._aims = foresight, scene, aims
        self._consideration, self._cells, self._poses = consideration, cells, poses
        self._robustness = robustness
        self._dead: set[frozenset[str]] = set()
        automaton = foresight._automaton
        symbol = foresight._symbol(scene)
        self._idle = set(idle_transitions(automaton, aims[0].source, symbol).states)

    def motions(
        self, scene: Foreseen, state: int, left: frozenset[str]
    ) -> tuple[tuple[Target, ...], Foreseen, int] | None:
        """Return the motions of the objects left, and the scene and the state after them."""
        if not left:
            return ((), scene, state) if self._is_done(state) else None
        if left in self._dead:
            return None
        is_first = len(left) == len(self._poses)
        for name in sorted(left):
            if (target := self._target(scene, state, name, is_first)) is None:
                continue
            after = scene.after(target)
            if (reached := self._reached(after, state, is_first)) is None:
                continue
            if (found := self.motions(after, reached, left - {name})) is not None:
                return (target, *found[0]), found[1], found[2]
        self._dead.add(left)
        return None

    def _is_done(self, state: int) -> bool:
        automaton = self._of._automaton
        if len(self._aims) > 1:
            return state in automaton.accepting
        return state == self._aims[0].target or (state in automaton.can_accept and state not in self._idle)

    def _reached(self, scene: Foreseen, state: int, is_first: bool) -> int | None:
        """Return the state after a motion; None if that is not one on the way."""
        automaton, symbol = self._of._automaton, self._of._symbol(scene)
        allowed = self._idle | {self._aims[0].target}
        for _ in range(len(self._aims)):
            states = automaton.step_set({state}, symbol)
            (after,) = states if len(states) == 1 else (-1,)
            if after not in automaton.can_accept:
                return None
            if (is_first or len(self._aims) == 1) and after not in allowed:
                return None
            if after == state:
                break
            state = after
        return state

    def _target(self, scene: Foreseen, state: int, name: str, is_first: bool) -> Target | None:
        """Return the motion of an object to its place; None if it is not possible now."""
        of = self._of
        settings = of._settings
        is_strict = is_first or len(self._aims) == 1
        constraints = self._consideration.constraints.cubes if is_strict else of._traps(state)
        if settings.skill == "push" or is_first:
            movables = of._movables_in(scene)
            if not of._budget.spend():
                return None
            maps = movables.maps_of(name)
            cubes = self._aims[0].guard, constraints
            gradient = gradient_map(maps, *cubes, settings.workspace, settings.constraint_margin)
            tracked = scene.sample.objects[name]
            if not isinstance(tracked, TrackedObject):
                return None
            found = target_in(gradient, tracked, settings, self._poses[name])
            if isinstance(found, Target):
                found = movables.with_way(found, constraints)
            return None if isinstance(found, str) else replace(found, robustness=self._robustness)
        return self._placed(scene, name, constraints)

    def _placed(self, scene: Foreseen, name: str, constraints: Cubes) -> Target | None:
        """Return the motion of an object that is carried, if there is room for it at its place."""
        of, (x, y, turn) = self._of, self._poses[name]
        tracked = scene.sample.objects[name]
        if not isinstance(tracked, TrackedObject):
            return None
        there = with_moved(scene.sample, {name: (x, y, turn)})
        workspace = of._settings.workspace
        others = [each for each in there.objects if each != name and each not in workspace.supports]
        apart = [Atom("", "dist", SignedDistance(TrackedName(name), TrackedName(each))) for each in others]
        lower, upper = values_in(there, [*of._formulas, *apart], of._regions)
        if any(each <= workspace.clearance for each in lower[len(of._formulas) :]):
            return None
        for cube in constraints:
            if (
                min((upper[n] if w else -lower[n] for n, w in cube), default=0.0)
                >= -of._settings.constraint_margin
            ):
                return None
        yaw = None if tracked.yaw is None else tracked.yaw + turn
        target = Target(name, x, y, turn, yaw, (centre_of(tracked.footprint), (x, y)), self._robustness)
        found = of._movables_in(scene).with_way(target, constraints)
        return None if isinstance(found, str) else found


def _chosen(consideration: Consideration, number: int, motions: tuple[Target, ...]) -> Consideration:
    marked = tuple(
        replace(each, is_chosen=place == number) for place, each in enumerate(consideration.candidates)
    )
    return replace(consideration, candidates=marked, motions=motions)
