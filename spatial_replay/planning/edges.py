"""Edges of an automaton as a planner sees them: what has to hold, what must not, what is left of them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Final

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.moves import Transition
from spatial_replay.planning.drift import Drift
from spatial_replay.planning.observing import Symbol
from spatial_replay.planning.step import Consideration, Edge, Guards

_LISTED: Final = 4
"""Edges that are named for a reason; others are counted."""


def consideration_of(
    automaton: Automaton, way: tuple[Transition, ...], given_up: Collection[Edge], symbol: Symbol
) -> Consideration:
    """The first edge of a path with its progress and constraint sets.

    Args:
        given_up: taking one of these edges is no harm.
        symbol: what the newest sample says. What the automaton does if the next one says the same is no harm
            either, unless acceptance is lost by it.
    """
    first = way[0]
    edge = (first.source, first.target)
    elsewhere = _elsewhere(automaton, edge, given_up, symbol)
    path = (first.source, *(each.target for each in way))
    return Consideration(path, edge, _guards(automaton, [first]), _guards(automaton, elsewhere), ())


def twins_of(
    automaton: Automaton,
    consideration: Consideration,
    drift: Drift,
    given_up: Collection[Edge],
    symbol: Symbol,
) -> Iterator[Edge]:
    """The edges in states to which time alone leads that take as much: equal progress, all constraints."""
    constraints = set(consideration.constraints.cubes)
    for edge in ((source, target) for source in drift.states[1:] for target in automaton.successors[source]):
        transition = automaton.transition(*edge)
        if transition is not None and transition.guard == consideration.progress.cubes:
            elsewhere = _elsewhere(automaton, edge, given_up, symbol)
            if constraints <= {cube for each in elsewhere for cube in each.guard}:
                yield edge


def _elsewhere(
    automaton: Automaton, edge: Edge, given_up: Collection[Edge], symbol: Symbol
) -> Iterator[Transition]:
    """What must not be taken on the way to an edge."""
    source = edge[0]
    idle = automaton.step_set({source}, symbol) & automaton.can_accept
    for target in automaton.successors[source]:
        transition = automaton.transition(source, target)
        if (
            transition is not None
            and target not in edge
            and target not in idle
            and (source, target) not in given_up
        ):
            yield transition


def _guards(automaton: Automaton, transitions: Iterable[Transition]) -> Guards:
    cubes = tuple(cube for each in transitions for cube in each.guard)
    texts = tuple(
        " and ".join(automaton.propositions[number].literal(value) for number, value in cube) or "true"
        for cube in cubes
    )
    return Guards(cubes, texts)


def worst_state(automaton: Automaton, states: Iterable[int]) -> int | None:
    """Of some states, the one farthest from acceptance; None if that is lost from all."""
    ways = {state: next(automaton.paths(state), None) for state in states}
    distances = {state: len(way) for state, way in ways.items() if way is not None}
    return max(distances, key=lambda state: (distances[state], -state), default=None)


def why_no_path(automaton: Automaton, state: int, pruned: Mapping[Edge, str]) -> str:
    """That every way from a state to acceptance was given up, with edges on these ways for each reason."""
    ahead, found = [state], {state}
    while ahead:
        after = set(automaton.successors[ahead.pop()]) - found
        found |= after
        ahead += after
    edges: dict[str, list[str]] = {}
    for (source, target), reason in sorted(pruned.items()):
        if source in found:
            # what is in brackets differs from edge to edge
            edges.setdefault(reason.split(" (", 1)[0], []).append(f"{source} -> {target}")
    reasons = "; ".join(f"{_listed(each)}: {reason}" for reason, each in edges.items())
    return f"no path left: every way from state {state} was given up ({reasons})"


def _listed(edges: Sequence[str]) -> str:
    more = f" and {len(edges) - _LISTED} more" if len(edges) > _LISTED else ""
    return ", ".join(edges[:_LISTED]) + more
