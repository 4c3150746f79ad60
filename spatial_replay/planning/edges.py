"""Edges of an automaton as a planner sees them: what has to hold, what must not, what is left of them.

Where time alone leads: `X` and bounds in samples move an automaton while nothing else changes.

What samples say of propositions.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise, takewhile
from typing import Any, Final, NamedTuple, TypeAlias

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.guards import Transition
from spatial_replay.errors import UsageError
from spatial_replay.monitor.atoms.live import SampleLeaves
from spatial_replay.planning.decisions import Consideration, Edge, Guards
from spatial_replay.spec.formula import Formula, Outline, Specification
from spatial_replay.trace.sample import Sample

Symbol: TypeAlias = tuple[bool | None, ...]
"""For each proposition whether it is true; None where that is not known."""


class Observer:
    """Propositions in sample after sample: true where their robustness is at least 0.

    As for a `value`, uncertainty does not count: a robot acts on what is most likely.
    """

    def __init__(self, formulas: Sequence[Formula], regions: Mapping[str, Outline]) -> None:
        # what evaluates leaves takes all formulas without temporal operators
        leaves: list[Any] = list(formulas)
        self._leaves = SampleLeaves([leaves], regions)

    def symbol(self, sample: Sample) -> Symbol:
        """What a sample says of each proposition."""
        values = self._leaves.values(self._leaves.look_at(sample))
        lower, upper = values[0, :, 0].tolist(), values[min(1, len(values) - 1), :, 0].tolist()
        return tuple(
            None if low < 0.0 <= high else low >= 0.0 for low, high in zip(lower, upper, strict=True)
        )


def refuse_template(specification: Specification, name: str) -> None:
    """That a spec is about objects that are known.

    Raises:
        UsageError: a template, since it stands for objects that only a whole log has.
    """
    for spec in specification.specs:
        if spec.name == name and spec.parameter is not None:
            raise UsageError(
                f"{name}({spec.parameter}) in {specification.filename} is a template: it stands for objects "
                "that are not known before the end; plan for a spec that names its objects"
            )


class Drift(NamedTuple):
    """The states that an automaton goes through if all samples to come say what the newest one does.

    Attributes:
        states: the present one, and each once; it stays in the last one, or nobody knows where it goes.
    """

    states: tuple[int, ...]

    @property
    def edges(self) -> frozenset[Edge]:
        """The moves that time alone makes."""
        return frozenset(pairwise(self.states))

    def along(self, way: Sequence[Transition]) -> tuple[int, ...]:
        """The states to which time alone leads on a way, one after the other; none if its first is not."""
        steps = zip(way, self.states[1:], strict=False)
        return tuple(state for _, state in takewhile(lambda step: step[0].target == step[1], steps))


def drift_of(automaton: Automaton, state: int, symbol: Symbol) -> Drift:
    """Where time alone leads from a state."""
    seen = {state: None}
    after = automaton.step_set({state}, symbol)
    while len(after) == 1 and not after <= seen.keys():
        (state,) = after
        seen[state] = None
        after = automaton.step_set({state}, symbol)
    return Drift(tuple(seen))


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
