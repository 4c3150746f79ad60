"""Edges of an automaton as a planner sees them: what has to hold, what must not, what is left of them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Final

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.moves import Transition
from spatial_replay.planning.step import Consideration, Edge, Guards

_LISTED: Final = 4
"""Edges that are named for a reason; others are counted."""


def consideration_of(
    automaton: Automaton, way: tuple[Transition, ...], pruned: Collection[Edge]
) -> Consideration:
    """The first edge of a path with its progress and constraint sets.

    Args:
        pruned: edges that were given up: taking one of these is no harm.
    """
    first = way[0]
    edge = (first.source, first.target)
    elsewhere = (
        each
        for each in automaton.transitions
        if each.source == first.source
        and each.target not in edge
        and (each.source, each.target) not in pruned
    )
    path = (first.source, *(each.target for each in way))
    return Consideration(path, edge, _guards(automaton, [first]), _guards(automaton, elsewhere), ())


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
