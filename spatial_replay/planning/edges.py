"""Edges of an automaton for a planner: progress and constraint sets, idle transitions, reasons for no path.

Idle transitions are those that the automaton takes while all propositions keep their values: `X` and bounds
in samples count samples, so time alone moves the automaton.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise, takewhile
from typing import Any, Final, NamedTuple, TypeAlias

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.guards import MAX_CUBES, Transition
from spatial_replay.errors import NoAutomatonError, UsageError
from spatial_replay.monitor.atoms.live import SampleLeaves
from spatial_replay.planning.decisions import Consideration, Edge, Guards, Reason
from spatial_replay.planning.maps import concerns
from spatial_replay.spec.formula import Formula, Outline, Specification
from spatial_replay.trace.sample import Sample

Symbol: TypeAlias = tuple[bool | None, ...]
"""The value of each proposition; None if it is unknown."""

_LISTED: Final = 4
"""The most edges that a reason names; the others are counted."""
LATER: Final = "what has to come after it cannot be done"
"""The kind of reason of an edge that could be taken now, and leads nowhere."""


class Observer:
    """Propositions of sample after sample: true where their robustness is at least 0.

    As for a `value`, uncertainty does not count: a robot acts on the most likely state.
    """

    def __init__(self, formulas: Sequence[Formula], regions: Mapping[str, Outline]) -> None:
        # propositions need not be atoms, and leaves are any formulas without temporal operators
        leaves: list[Any] = list(formulas)
        self._leaves = SampleLeaves([leaves], regions)

    def symbol(self, sample: Sample) -> Symbol:
        """Return the value of each proposition in a sample."""
        values = self._leaves.values(self._leaves.look_at(sample))
        lower, upper = values[0, :, 0].tolist(), values[min(1, len(values) - 1), :, 0].tolist()
        bounds = zip(lower, upper, strict=True)
        return tuple(None if low < 0.0 <= high else low >= 0.0 for low, high in bounds)


def refuse_template(specification: Specification, name: str) -> None:
    """Check that a spec names its objects.

    Raises:
        UsageError: a template, since its objects are known only at the end of a log.
    """
    for spec in specification.specs:
        if spec.name == name and spec.parameter is not None:
            raise UsageError(
                f"{name}({spec.parameter}) in {specification.filename} is a template: its objects are not "
                "known before the end of a log; plan for a spec that names its objects"
            )


class IdleTransitions(NamedTuple):
    """The states that an automaton visits while every sample has the propositions of the newest one.

    Attributes:
        states: from the current one on, each once. The automaton stays in the last one, or its next state
            depends on unknown propositions.
    """

    states: tuple[int, ...]

    @property
    def edges(self) -> frozenset[Edge]:
        """The transitions between these states."""
        return frozenset(pairwise(self.states))

    def along(self, path: Sequence[Transition]) -> tuple[int, ...]:
        """Return the states at the beginning of a path that time alone reaches; none if its first is not."""
        steps = zip(path, self.states[1:], strict=False)
        return tuple(state for _, state in takewhile(lambda step: step[0].target == step[1], steps))


def idle_transitions(automaton: Automaton, state: int, symbol: Symbol) -> IdleTransitions:
    """Return the transitions that time alone takes from a state."""
    visited = {state: None}
    after = automaton.step_set({state}, symbol)
    while len(after) == 1 and not after <= visited.keys():
        (state,) = after
        visited[state] = None
        after = automaton.step_set({state}, symbol)
    return IdleTransitions(tuple(visited))


def consideration_of(
    automaton: Automaton, path: tuple[Transition, ...], pruned: Collection[Edge], symbol: Symbol
) -> Consideration:
    """Return the first edge of a path with its progress and constraint sets.

    Args:
        pruned: edges that the constraint set leaves out.
        symbol: the newest sample's propositions. The constraint set also leaves out the edge that these would
            take, unless acceptance is lost by it.
    """
    states, edge = (path[0].source, *(each.target for each in path)), (path[0].source, path[0].target)
    others = _other_edges(automaton, edge, pruned, symbol)
    return Consideration(states, edge, _guards(automaton, path[:1]), _guards(automaton, others), ())


def equivalent_edges(
    automaton: Automaton,
    consideration: Consideration,
    idle: IdleTransitions,
    pruned: Collection[Edge],
    symbol: Symbol,
) -> Iterator[Edge]:
    """Iterate over the edges from idle states that take as much: equal progress, and all constraints.

    A deadline unrolls one edge into a copy for each sample left. If one copy is impossible now, so are the
    later ones, and the planner need not try each of them.
    """
    constraints = set(consideration.constraints.cubes)
    for edge in ((source, target) for source in idle.states[1:] for target in automaton.successors[source]):
        transition = automaton.transition(*edge)
        if transition is not None and transition.guard == consideration.progress.cubes:
            others = _other_edges(automaton, edge, pruned, symbol)
            if constraints <= {cube for each in others for cube in each.guard}:
                yield edge


def _other_edges(
    automaton: Automaton, edge: Edge, pruned: Collection[Edge], symbol: Symbol
) -> Iterator[Transition]:
    """Iterate over the transitions that must not be taken on the way to an edge.

    Raises:
        NoAutomatonError: a guard that is cut, since what it leaves out would not be avoided.
    """
    source = edge[0]
    allowed = {*edge, *(automaton.step_set({source}, symbol) & automaton.can_accept)}
    for target in automaton.successors[source]:
        transition = automaton.transition(source, target)
        if transition is not None and target not in allowed and (source, target) not in pruned:
            if transition.is_cut:
                reason = f"the guard of {source} -> {target} takes more than {MAX_CUBES} cubes"
                raise NoAutomatonError(
                    f"{reason}, too many to plan around; write simpler propositions", reason
                )
            yield transition


def _guards(automaton: Automaton, transitions: Iterable[Transition]) -> Guards:
    cubes = tuple(cube for each in transitions for cube in each.guard)
    texts = tuple(
        " and ".join(automaton.propositions[number].literal(value) for number, value in cube) or "true"
        for cube in cubes
    )
    return Guards(cubes, texts)


def loss_text(automaton: Automaton, states: Collection[int], before: Symbol, symbol: Symbol) -> str:
    """Return what a sample has that takes the automaton where it cannot accept; empty if it is not known.

    Args:
        states: of the automaton before the sample.
        before, symbol: the propositions of the sample before, () if there is none, and of this one.
    """
    taken = [
        cube
        for source in sorted(states)
        for target in automaton.successors[source]
        if target not in automaton.can_accept and (edge := automaton.transition(source, target)) is not None
        for cube in edge.guard
        if all(symbol[number] is wanted for number, wanted in cube)
    ]
    cube = min(taken, key=len, default=())
    # what has just changed says more than what was so before
    changed = [each for each in cube if before and before[each[0]] is not symbol[each[0]]]
    return " and ".join(automaton.propositions[number].literal(value) for number, value in changed or cube)


def moved_later(
    path: Sequence[Transition], symbol: Symbol, formulas: Sequence[Formula], names: Iterable[str]
) -> frozenset[str]:
    """Return the objects that the rest of a path, without its first edge, may ask to be moved."""
    literals = (literal for each in path[1:] for cube in each.guard for literal in cube)
    unmet = {number for number, wanted in literals if symbol[number] is not wanted}
    return frozenset(name for name in names if any(concerns(formulas[number], name) for number in unmet))


def worst_state(automaton: Automaton, states: Iterable[int]) -> int | None:
    """Return the state farthest from acceptance; None if no state can reach it."""
    paths = {state: next(automaton.paths(state), None) for state in states}
    distances = {state: len(path) for state, path in paths.items() if path is not None}
    return max(distances, key=lambda state: (distances[state], -state), default=None)


def why_no_path(automaton: Automaton, state: int, pruned: Mapping[Edge, Reason]) -> str:
    """Return the sentence that every path from a state was pruned, with edges for each kind of reason."""
    ahead, reachable = [state], {state}
    while ahead:
        after = set(automaton.successors[ahead.pop()]) - reachable
        reachable |= after
        ahead += after
    edges: dict[str, list[str]] = {}
    for (source, target), reason in sorted(pruned.items()):
        if source in reachable:
            edges.setdefault(reason.kind, []).append(f"{source} -> {target}")
    reasons = "; ".join(f"{_listed(each)}: {kind}" for kind, each in edges.items())
    later = [
        each.detail for edge, each in sorted(pruned.items()) if edge[0] in reachable and each.kind == LATER
    ]
    what = f"; what cannot be done: {later[0]}" if later else ""
    return f"no path left: every way from state {state} was given up ({reasons}){what}"


def _listed(edges: Sequence[str]) -> str:
    more = f" and {len(edges) - _LISTED} more" if len(edges) > _LISTED else ""
    return ", ".join(edges[:_LISTED]) + more
