"""Edges of an automaton for a planner: progress and constraint sets, idle transitions, and attempts.

The automaton takes idle transitions while all propositions keep their values. Formulas with `X`, or
with bounds in samples, depend on the number of samples, so time alone moves their automata.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise, product, takewhile
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.guards import MAX_CUBES, Transition
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import TrackedObject, centre_of, moved_object, radius_of
from spatial_replay.monitor.atoms.live import SampleLeaves
from spatial_replay.monitor.atoms.measurements import leaf_values
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.witness.path import unknowns_of
from spatial_replay.planning.decisions import (
    Consideration,
    Edge,
    Guards,
    Outcome,
    Reason,
    Search,
    Stage,
    Target,
)
from spatial_replay.planning.maps import Cube, concerns
from spatial_replay.planning.settings import Settings
from spatial_replay.spec.format import format_term
from spatial_replay.spec.formula import (
    ANY_CLASS,
    Atom,
    Boolean,
    Formula,
    Group,
    Outline,
    Quantified,
    Specification,
    TrackedName,
    Truth,
    expand,
)
from spatial_replay.spec.walks import base_of, iter_formulas, iter_terms
from spatial_replay.text import nearest_hint, time_text
from spatial_replay.trace.trace import Sample, Trace

# ---------------------------------------------------------------------------------------------------- demands

Pose: TypeAlias = tuple[float, float, float]
"""Position and turn of an object, (x, y, turn)."""

_Value = TypeVar("_Value", float, Floats)

MOST_ALTERNATIVES: Final = 32
"""Maximum number of conjunctions of a formula; further conjunctions are not tried."""


class Demand(NamedTuple):
    """A formula without temporal operators that must hold, or must not hold, by at least a margin."""

    formula: Formula
    wanted: bool
    least: float


def alternatives(formula: Formula, wanted: bool) -> list[tuple[tuple[Formula, bool], ...]]:
    """Return conjunctions of atoms; each implies a formula if `wanted`, else the formula's negation."""
    formula = expand(formula)
    match formula:
        case Truth():
            return [()] if formula.value == wanted else []
        case Boolean(operator="not"):
            return alternatives(formula.operands[0], not wanted)
        case Boolean():
            options_by_operand = [alternatives(operand, wanted) for operand in formula.operands]
            if (formula.operator == "and") == wanted:
                return _conjoin(options_by_operand)
            return [conjunction for options in options_by_operand for conjunction in options][
                :MOST_ALTERNATIVES
            ]
        case _:
            return [((formula, wanted),)]


def demands_of(cube: Cube, formulas: Sequence[Formula], least: float) -> list[tuple[Demand, ...]]:
    """Return conjunctions of demands, each of which implies a cube of propositions."""
    options_by_literal = [alternatives(formulas[number], value) for number, value in cube]
    return [
        tuple(Demand(*literal, least) for literal in conjunction)
        for conjunction in _conjoin(options_by_literal)
    ]


def _conjoin(
    options_by_operand: Sequence[list[tuple[tuple[Formula, bool], ...]]],
) -> list[tuple[tuple[Formula, bool], ...]]:
    conjunctions: list[tuple[tuple[Formula, bool], ...]] = [()]
    for options in options_by_operand:
        # cut at each step, because the number of products grows exponentially
        conjunctions = [(*left, *right) for left, right in product(conjunctions, options)][:MOST_ALTERNATIVES]
    # without duplicate literals, and without contradictions
    unique_literals = (dict.fromkeys(conjunction) for conjunction in conjunctions)
    return [
        tuple(literals)
        for literals in unique_literals
        if not any((formula, not value) in literals for formula, value in literals)
    ]


def values_in(
    sample: Sample, formulas: Sequence[Formula], regions: Mapping[str, Outline]
) -> tuple[list[float], list[float]]:
    """Return lower and upper bounds of the robustness of formulas in a sample; infinite if unknown."""
    leaves = leaf_values(TraceScene(Trace.from_samples([sample]), regions), formulas, {})
    return leaves[0][:, 0].tolist(), leaves[min(1, len(leaves) - 1)][:, 0].tolist()


def surplus(lower: _Value, upper: _Value, demand: Demand) -> _Value:
    """Return the robustness of a demand minus its margin; negative for an unmet or unknown demand."""
    return (lower if demand.wanted else -upper) - demand.least


class Budget:
    """The number of maps that a decision may compute.

    Attributes:
        left: number of maps left.
        arrangements: number of arrangements of several objects for which an order of motions was searched.
        parking_places: number of parking places tried for objects that are in the way of other objects.
    """

    def __init__(self, maps: float) -> None:
        self.left, self._initial_maps = maps, maps
        self.arrangements = self.parking_places = 0

    @property
    def search(self) -> Search:
        """The search effort until now."""
        return Search(self._initial_maps - self.left, self.arrangements, self.parking_places)

    def spend(self, maps: float = 1.0) -> bool:
        """Subtract maps from the budget; return False if the budget is exceeded."""
        self.left -= maps
        return self.left >= 0.0


def move_objects(sample: Sample, poses: Mapping[str, Pose], later_ns: int = 0) -> Sample:
    """Return a sample with objects moved to poses (x, y, turn)."""
    moved_objects = {name: moved_object(sample.objects[name], *pose) for name, pose in poses.items()}
    return with_objects(sample, moved_objects, later_ns)


def with_objects(sample: Sample, objects: Mapping[str, TrackedObject], later_ns: int = 0) -> Sample:
    """Return a sample with some objects replaced or added."""
    time_ns = sample.time_ns + later_ns
    return Sample(time_ns, {**sample.objects, **objects}, sample.signals, sample.unknown)


# ------------------------------------------------------------------------------------------------------ edges

Symbol: TypeAlias = tuple[bool | None, ...]
"""The value of each proposition; None if it is unknown."""

MOST_MOTIONS: Final = 100
"""Maximum number of motions for an edge, including successful and refused motions.

Six objects are sorted in at most 14 motions, if three motions in ten fail.
"""
_TURNED: Final = math.radians(10.0)
"""Turn up to which an object counts as unmoved, radians."""
BESIDE: Final = 1.5
"""Distance up to which a neighbour may block the push of an object, in radii of the object."""
_LISTED: Final = 4
"""Maximum number of edges that a reason names; the number of further edges follows."""
_TRIED: Final = "tried "
"""First word of the kinds of reasons that give a number of motions."""
LATER: Final = "what has to come after it cannot be done"
"""Kind of the reason for an edge that can be taken now, but does not lead to acceptance."""


class Observer:
    """Values of propositions, sample by sample: true if the robustness is at least 0.

    Uncertainty is ignored, as in the `value` of a result, because a robot acts on the most likely state.
    """

    def __init__(self, formulas: Sequence[Formula], regions: Mapping[str, Outline]) -> None:
        # a leaf may be any formula without temporal operators, so every proposition is a leaf
        leaves: list[Any] = list(formulas)
        self._leaves = SampleLeaves([leaves], regions)

    def symbol(self, sample: Sample) -> Symbol:
        """Return the value of each proposition in a sample."""
        leaf_bounds = self._leaves.fill_room(sample).measure()
        lower, upper = leaf_bounds[0, :, 0].tolist(), leaf_bounds[min(1, len(leaf_bounds) - 1), :, 0].tolist()
        bounds = zip(lower, upper, strict=True)
        return tuple(None if low < 0.0 <= high else low >= 0.0 for low, high in bounds)


def unknown_reasons(
    formulas: Iterable[Formula], sample: Sample, seen: Mapping[str, int], regions: Mapping[str, Outline]
) -> list[str]:
    """Return the reasons why propositions are unknown in a sample, without duplicates.

    Args:
        seen: newest time of each object in this sample or in earlier samples, ns.
    """
    scene = TraceScene(Trace.from_samples([sample]), regions)
    reasons: dict[str, None] = {}
    for leaf in _leaves_of(formulas):
        if not isinstance(leaf, Atom):
            continue
        object_names = [base.name for term in leaf.terms if isinstance(base := base_of(term), TrackedName)]
        for reason in unknowns_of(scene, leaf):
            missing = next((name for name in object_names if reason == f"{name} is not in the sample"), None)
            if missing is not None and missing in seen:
                reason = f"{missing} has not been seen since {time_text(seen[missing])}"
            hint = nearest_hint(missing, sample.objects) if missing and missing not in seen else ""
            reasons[f"{reason}; {hint}" if hint else reason] = None
    return list(reasons)


def groups_without_members(formula: Formula, sample: Sample) -> list[Group]:
    """Return a proposition's open groups that lack members; none if one of its relations lacks no members."""
    empty_groups: list[Group] = []
    for leaf in _leaves_of([formula]):
        least_members = 1
        groups = [base for term in iter_terms([leaf]) if isinstance(base := base_of(term), Group)]
        if isinstance(leaf, Quantified) and isinstance(leaf.group, Group):
            groups, least_members = [leaf.group], len(leaf.variables)
        missing_groups = [
            group for group in groups if group.is_open and _members_of(group, sample) < least_members
        ]
        if not missing_groups:
            return []
        empty_groups += missing_groups
    return empty_groups


def absence_text(groups: Iterable[Group], sample: Sample) -> str:
    """Return the names of groups without members, with the most similar class name in the sample."""
    classes = sorted({tracked.class_name for tracked in sample.objects.values() if tracked.class_name})
    hints = {
        format_term(replace(group, name="")): nearest_hint(group.class_name or "", classes)
        for group in groups
    }
    return " and ".join(f"{text}; {hint}" if hint else text for text, hint in hints.items())


def _leaves_of(formulas: Iterable[Formula]) -> Iterator[Formula]:
    for formula in formulas:
        if isinstance(formula, Boolean):
            yield from _leaves_of(formula.operands)
        else:
            yield formula


def _members_of(group: Group, sample: Sample) -> int:
    classes = {name: tracked.class_name for name, tracked in sample.objects.items()} | dict(sample.unknown)
    excluded = {name.name for name in group.excluded}
    group_class = (group.class_name or ANY_CLASS).casefold()
    return sum(
        name not in excluded and group_class in (ANY_CLASS, (class_name or "").casefold())
        for name, class_name in classes.items()
    )


def refuse_template(specification: Specification, name: str) -> None:
    """Check that a spec names its objects.

    Raises:
        UsageError: the spec is a template, whose objects are known only at the end of a log.
    """
    for spec in specification.specs:
        if spec.name == name and spec.parameter is not None:
            raise UsageError(
                f"{name}({spec.parameter}) in {specification.filename} is a template: its objects are not "
                "known before the end of a log; plan for a spec that names its objects"
            )


def specs_of(formula: Formula, propositions: Sequence[Formula]) -> list[list[str]]:
    """Return the names of the innermost specs that contain each proposition, in a formula."""
    formulas_by_spec = {
        spec.name: list(iter_formulas(spec))[1:] for spec in list(iter_formulas(formula))[1:] if spec.name
    }
    innermost_specs = {
        name: nested for name, nested in formulas_by_spec.items() if not any(part.name for part in nested)
    }
    return [
        [name for name, nested in innermost_specs.items() if proposition in nested]
        for proposition in propositions
    ]


class IdleTransitions(NamedTuple):
    """The states that an automaton visits while all propositions keep their newest values.

    Attributes:
        states: visited states from the current state on, without repetition. The last state leads back to a
            visited state, or its next state depends on unknown propositions.
    """

    states: tuple[int, ...]

    @property
    def edges(self) -> frozenset[Edge]:
        """The transitions between these states."""
        return frozenset(pairwise(self.states))

    def along(self, path: Sequence[Transition]) -> tuple[int, ...]:
        """Return the states along a path that time alone reaches; none if the first edge needs a motion."""
        steps = zip(path, self.states[1:], strict=False)
        return tuple(state for _, state in takewhile(lambda step: step[0].target == step[1], steps))


def idle_transitions(automaton: Automaton, state: int, symbol: Symbol) -> IdleTransitions:
    """Return the transitions from a state that time alone takes."""
    visited_states = {state: None}
    next_states = automaton.step_set({state}, symbol)
    while len(next_states) == 1 and not next_states <= visited_states.keys():
        (state,) = next_states
        visited_states[state] = None
        next_states = automaton.step_set({state}, symbol)
    return IdleTransitions(tuple(visited_states))


def consideration_of(
    automaton: Automaton, path: tuple[Transition, ...], pruned: Collection[Edge], symbol: Symbol
) -> Consideration:
    """Return the first edge of a path with its progress and constraint sets.

    Args:
        pruned: edges that are left out of the constraint set.
        symbol: values of the propositions in the newest sample. The constraint set also omits the edge that
            these values take, if this edge does not lose acceptance.
    """
    states, edge = (
        (path[0].source, *(transition.target for transition in path)),
        (path[0].source, path[0].target),
    )
    rivals = _other_edges(automaton, edge, pruned, symbol)
    return Consideration(states, edge, guards_of(automaton, path[:1]), guards_of(automaton, rivals), ())


def order_text(automaton: Automaton, path: Sequence[Transition], without: Collection[Edge]) -> str:
    """Return the reason why a path's first edge precedes the edge of an equally short path.

    The result is "" if no other path is equally short.

    Args:
        without: pruned edges, and edges that time alone takes.
    """
    move = path[0]
    rival_path = next(automaton.paths(move.source, {*without, (move.source, move.target)}), ())
    if len(rival_path) != len(path):
        return ""
    return f"{move.source} -> {rival_path[0].target} is as short; the state with the lower number comes first"


def equivalent_edges(
    automaton: Automaton,
    consideration: Consideration,
    idle: IdleTransitions,
    pruned: Collection[Edge],
    symbol: Symbol,
) -> Iterator[Edge]:
    """Iterate over edges from idle states that are at least as hard to take as a considered edge.

    Such an edge has the progress set of the considered edge, and at least its constraints.

    A deadline unrolls one edge into a copy for each remaining sample. If a copy is impossible now, the later
    copies are also impossible, and the planner skips them.
    """
    constraint_cubes = set(consideration.constraints.cubes)
    for edge in ((source, target) for source in idle.states[1:] for target in automaton.successors[source]):
        transition = automaton.transition(*edge)
        if transition is not None and transition.guard == consideration.progress.cubes:
            other_transitions = _other_edges(automaton, edge, pruned, symbol)
            if constraint_cubes <= {cube for rival in other_transitions for cube in rival.guard}:
                yield edge


def _other_edges(
    automaton: Automaton, edge: Edge, pruned: Collection[Edge], symbol: Symbol
) -> Iterator[Transition]:
    """Iterate over the transitions that must not be taken before an edge.

    Raises:
        NoAutomatonError: a guard has more than `MAX_CUBES` cubes, and a motion could not avoid all of them.
    """
    source = edge[0]
    allowed_targets = {*edge, *(automaton.step_set({source}, symbol) & automaton.can_accept)}
    for target in automaton.successors[source]:
        transition = automaton.transition(source, target)
        if transition is not None and target not in allowed_targets and (source, target) not in pruned:
            if transition.is_cut:
                reason = f"the guard of {source} -> {target} takes more than {MAX_CUBES} cubes"
                raise NoAutomatonError(
                    f"{reason}, too many to plan around; write simpler propositions", reason
                )
            yield transition


def guards_of(automaton: Automaton, transitions: Iterable[Transition]) -> Guards:
    """Return the guards of all transitions as one set."""
    cubes = tuple(cube for transition in transitions for cube in transition.guard)
    texts = tuple(
        " and ".join(automaton.propositions[number].literal(value) for number, value in cube) or "true"
        for cube in cubes
    )
    return Guards(cubes, texts)


def loss_text(automaton: Automaton, states: Collection[int], before: Symbol, symbol: Symbol) -> str:
    """Return the condition that loses acceptance in a sample; empty if unknown propositions hide it.

    Args:
        states: states of the automaton before the sample.
        before: values of the propositions in the previous sample; () without a previous sample.
        symbol: values of the propositions in this sample.
    """
    cubes = [
        cube
        for source in sorted(states)
        for target in automaton.successors[source]
        if target not in automaton.can_accept and (edge := automaton.transition(source, target)) is not None
        for cube in edge.guard
        if all(symbol[number] is value for number, value in cube)
    ]
    cube = min(cubes, key=len, default=())
    # a newly true condition explains more than a condition that held before
    changed_literals = [
        literal for literal in cube if before and before[literal[0]] is not symbol[literal[0]]
    ]
    return " and ".join(
        automaton.propositions[number].literal(value) for number, value in changed_literals or cube
    )


def moved_later(
    path: Sequence[Transition], symbol: Symbol, formulas: Sequence[Formula], names: Iterable[str]
) -> frozenset[str]:
    """Return the objects that may need a motion for the later edges of a path."""
    literals = (literal for transition in path[1:] for cube in transition.guard for literal in cube)
    unmet = {number for number, value in literals if symbol[number] is not value}
    return frozenset(name for name in names if any(concerns(formulas[number], name) for number in unmet))


def worst_state(automaton: Automaton, states: Iterable[int]) -> int | None:
    """Return the state farthest from acceptance; None if no state can reach acceptance."""
    paths = {state: next(automaton.paths(state), None) for state in states}
    distances = {state: len(path) for state, path in paths.items() if path is not None}
    # among states of equal distance, the state with the lowest number
    return max(distances, key=lambda state: (distances[state], -state), default=None)


def why_no_path(automaton: Automaton, state: int, pruned: Mapping[Edge, Reason], why: str = "") -> str:
    """Return a sentence that says that no path from a state is left, and why its edges were pruned.

    Args:
        why: infeasible part of the task; if empty, the detail of a `LATER` reason replaces it.
    """
    pending_states, reachable_states = [state], {state}
    while pending_states:
        new_states = set(automaton.successors[pending_states.pop()]) - reachable_states
        reachable_states |= new_states
        pending_states += new_states
    edges_by_kind: dict[str, list[str]] = {}
    for (source, target), reason in sorted(pruned.items()):
        if source in reachable_states:
            # the last failure of an edge explains more than its number of attempts
            kind = str(reason) if reason.kind.startswith(_TRIED) else reason.kind
            edges_by_kind.setdefault(kind, []).append(f"{source} -> {target}")
    reasons = "; ".join(f"{_edges_text(texts)}: {kind}" for kind, texts in edges_by_kind.items())
    later_details = [
        reason.detail
        for edge, reason in sorted(pruned.items())
        if edge[0] in reachable_states and reason.kind == LATER
    ]
    impossible_text = f"; what cannot be done: {why or later_details[0]}" if why or later_details else ""
    return f"no path left: every way from state {state} was given up ({reasons}){impossible_text}"


def _edges_text(edges: Sequence[str]) -> str:
    rest_text = f" and {len(edges) - _LISTED} more" if len(edges) > _LISTED else ""
    return ", ".join(edges[:_LISTED]) + rest_text


# ------------------------------------------------------------------------------------------------ attempts


class FailedMotion(NamedTuple):
    """A motion that failed.

    Attributes:
        target: target of the motion.
        before: newest sample at the beginning of the motion.
        stayed: whether the object did not move.
        refused: whether no sample came during the motion.
        at: stage at which the motion failed; None for an unknown stage.
    """

    target: Target
    before: Sample
    stayed: bool
    refused: bool
    at: Stage | None


class Attempts:
    """The motions of a run, by edge.

    Failures count separately for each edge and object, so that a robot that often fails can continue.

    Attributes:
        motions: number of concluded motions, without refused motions.
        planned: remaining motions of the plan after the last motion; empty if the last motion failed.
    """

    def __init__(self) -> None:
        self.motions = 0
        self.planned: tuple[Target, ...] = ()
        self._failure_counts: dict[Edge, Counter[str]] = {}
        self._motion_counts: Counter[Edge] = Counter()
        self._failed_places: dict[str, tuple[tuple[float, float], ...]] = {}
        self._least_left: dict[Edge, int] = {}
        self._last_failures: dict[Edge, str] = {}
        self._failed_motions: list[FailedMotion] = []
        self._begin: tuple[Sample, Settings]

    @property
    def are_any(self) -> bool:
        """Whether any motion was tried."""
        return bool(self._motion_counts)

    def forgiven(self) -> Attempts:
        """Return a copy in which only refused motions count as failures; other motions may be repeated."""
        # a shallow copy shares the counts of motions
        attempts = copy(self)
        attempts._failed_motions, attempts._failed_places = (
            [motion for motion in self._failed_motions if motion.refused],
            {},
        )
        return attempts

    def why_not_again(self, edge: Edge, most_failed: int) -> Reason | None:
        """Return the reason why an edge is not tried again; None if the edge may be tried."""
        if (failure_count := self.failures(edge)) >= most_failed:
            return Reason(_count_text(failure_count), self._last_failures.get(edge, ""))
        # a successful motion resets the failures, so without this limit `G F …` could continue forever
        return (
            Reason(f"tried {MOST_MOTIONS} times in all")
            if self._motion_counts[edge] >= MOST_MOTIONS
            else None
        )

    def failures(self, edge: Edge) -> int:
        """Return the greatest number of failed motions that one object has for an edge."""
        return max(self._failure_counts.get(edge, Counter()).values(), default=0)

    def begin(self, edge: Edge, name: str, sample: Sample, settings: Settings) -> None:
        """Count a motion of an object for an edge; until `conclude`, the motion counts as failed."""
        self._failure_counts.setdefault(edge, Counter())[name] += 1
        self._motion_counts[edge] += 1
        self._begin = sample, settings

    def conclude(
        self,
        aim: Consideration,
        target: Target,
        outcome: Outcome,
        states: Sequence[int],
        sample: Sample,
        *,
        is_stopped: bool = False,
    ) -> None:
        """Record the outcome of a motion.

        Args:
            states: states of the automaton after the motion.
            sample: newest sample after the motion.
            is_stopped: whether the planner stopped the motion. If so, the object counts as moved.
        """
        start_sample, settings = self._begin
        is_refused = start_sample is sample and not outcome.succeeded
        self.motions += not is_refused
        is_there = outcome.succeeded and _is_at(target, sample, settings)
        self.planned = aim.motions[1:] if is_there else ()
        if not outcome.succeeded:
            reasons = (outcome.reason, "no sample came during the motion" if is_refused else "")
            self._last_failures[aim.edge] = "; ".join(filter(None, reasons))
            has_stayed = not is_stopped and _stands(target.name, start_sample, sample, settings)
            self._failed_motions.append(
                FailedMotion(target, start_sample, has_stayed, is_refused, outcome.at)
            )
            # a motion that failed at its target may succeed at another place
            if outcome.at in (None, "place") and not (settings.skill == "push" and has_stayed):
                self._failed_places[target.name] = (*self.places_of(target.name), (target.x, target.y))
        elif tuple(states) == aim.edge[1:]:
            del self._failure_counts[aim.edge]
        elif not is_there:
            place_text = "({:.4g}, {:.4g})".format(*centre_of(sample.objects[target.name].footprint))
            self._last_failures[aim.edge] = (
                f"moved, but then not at its target: {target.name} at {place_text}"
            )
        elif aim.is_joint and len(aim.motions) < self._least_left.get(aim.edge, MOST_MOTIONS):
            # one of several motions succeeded, and the number of remaining motions is the least so far
            self._least_left[aim.edge] = len(aim.motions)
            self._failure_counts[aim.edge].clear()
        elif aim.is_joint:
            # a successful detour after a failure; `MOST_MOTIONS` bounds all motions for the edge
            del self._failure_counts[aim.edge][target.name]

    def withdraw(self, edge: Edge, name: str) -> None:
        """Subtract the newest motion of an object for an edge from the counts."""
        self._failure_counts[edge][name] -= 1
        self._motion_counts[edge] -= 1

    def places_of(self, name: str) -> tuple[tuple[float, float], ...]:
        """Return the places (x, y) where motions of an object failed, for any edge."""
        return self._failed_places.get(name, ())

    def needs_room(self, name: str) -> bool:
        """Return whether lack of room may be the reason why an object could not be moved to a place."""
        return any(
            motion.target.name == name and motion.stayed and motion.at in (None, "place")
            for motion in self._failed_motions
        )

    def failed_pick(self, name: str, sample: Sample, settings: Settings) -> bool:
        """Return whether a pick-up of an object failed in the scene of a sample."""
        return settings.skill == "place" and any(
            motion.at == "pick" for motion in self._here(name, sample, settings)
        )

    def failed_here(self, name: str, sample: Sample, settings: Settings) -> tuple[Target, ...]:
        """Return the targets of failed motions of an object in the scene of a sample.

        After a push that did not move its object, only the object and its neighbours make up the scene.
        """
        return tuple(motion.target for motion in self._here(name, sample, settings))

    def _here(self, name: str, sample: Sample, settings: Settings) -> Iterator[FailedMotion]:
        """Yield the failed motions of an object that began in the scene of a sample."""
        for motion in self._failed_motions:
            if motion.target.name == name and _is_same_scene(motion, sample, settings):
                yield motion


def _is_at(target: Target, sample: Sample, settings: Settings) -> bool:
    """Return whether an object is at its target; True for an object that is missing in the sample."""
    tracked = sample.objects.get(target.name)
    tolerance = settings.workspace.grid.cell_size + (0.0 if tracked is None else tracked.uncertainty)
    return tracked is None or math.dist(centre_of(tracked.footprint), (target.x, target.y)) <= tolerance


def _count_text(count: int) -> str:
    return f"{_TRIED}{count} times" if count > 1 else f"{_TRIED}once"


def _is_same_scene(motion: FailedMotion, sample: Sample, settings: Settings) -> bool:
    """Return whether no object has moved since a failed motion; for a push, only near objects count."""
    moved_name, start_sample = motion.target.name, motion.before
    tracked = start_sample.objects[moved_name]
    scene_names = list(dict.fromkeys([moved_name, *start_sample.objects, *sample.objects]))
    if settings.skill == "push":
        if not motion.stayed:
            return False
        near_distance = BESIDE * radius_of(tracked)
        scene_names = [
            neighbour
            for neighbour in scene_names
            if min(_away(tracked, scene.objects.get(neighbour)) for scene in (start_sample, sample))
            <= near_distance
        ]
    return all(_stands(name, start_sample, sample, settings) for name in scene_names)


def _away(tracked: TrackedObject, other: TrackedObject | None) -> float:
    """Return the approximate distance between two objects; infinite if the other object is missing."""
    if other is None:
        return math.inf
    centre_distance = math.dist(centre_of(tracked.footprint), centre_of(other.footprint))
    return centre_distance - radius_of(tracked) - radius_of(other)


def _stands(name: str, earlier_sample: Sample, sample: Sample, settings: Settings) -> bool:
    """Return whether an object has not moved since an earlier sample; True for a missing object."""
    earlier, newest = earlier_sample.objects.get(name), sample.objects.get(name)
    if earlier is None or newest is None:
        return earlier is newest
    moved_distance = math.dist(centre_of(earlier.footprint), centre_of(newest.footprint))
    turn = math.remainder((newest.yaw or 0.0) - (earlier.yaw or 0.0), math.tau)
    tolerance = settings.workspace.grid.cell_size + earlier.uncertainty + newest.uncertainty
    return moved_distance <= tolerance and abs(turn) <= _TURNED
