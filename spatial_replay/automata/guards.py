"""The moves of an automaton: which states lead to which others, and under what guards.

A guard is a disjunction of few cubes, computed from the diagram of a state's moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from spatial_replay.automata.diagrams import LEAF, NO, YES, Diagrams
from spatial_replay.automata.minimise import nodes_of
from spatial_replay.automata.propositions import Proposition
from spatial_replay.errors import NoAutomatonError

Literal: TypeAlias = tuple[int, bool]
"""A proposition's number, and whether it has to be true."""

Cube: TypeAlias = tuple[Literal, ...]
"""Literals that all have to hold, by proposition; without any, it always does."""

Guard: TypeAlias = tuple[Cube, ...]
"""Cubes of which one has to hold."""


MAX_CUBES = 100_000
"""How many cubes all guards of an automaton have together."""


class Covers:
    """Functions as irredundant disjunctions of cubes: no cube and no literal of one can be left out.

    The algorithm is that of Minato and Morreale (1992): equal functions have equal cubes.
    """

    def __init__(self, diagrams: Diagrams) -> None:
        self._diagrams = diagrams
        self._known: dict[tuple[int, int], tuple[tuple[Cube, ...], int]] = {}
        self._cubes = 0

    def guard(self, node: int) -> Guard:
        """Return the cubes of a function.

        Raises:
            NoAutomatonError: they, and those before, are more than `MAX_CUBES`.
        """
        cubes = self._between(node, node)[0]
        self._count(len(cubes))
        return tuple(sorted(cubes))

    def _count(self, cubes: int) -> None:
        self._cubes += cubes
        if self._cubes > MAX_CUBES:
            raise NoAutomatonError(f"the guards of the automaton take more than {MAX_CUBES} cubes")

    def _between(self, lower: int, upper: int) -> tuple[tuple[Cube, ...], int]:
        """Return cubes that hold where `lower` does and at most where `upper` does, and their function."""
        if lower == NO:
            return (), NO
        if upper == YES:
            return ((),), YES
        key = (lower, upper)
        if key not in self._known:
            self._known[key] = self._split(lower, upper)
        return self._known[key]

    def _split(self, lower: int, upper: int) -> tuple[tuple[Cube, ...], int]:
        diagrams = self._diagrams
        variable = min(diagrams[lower].variable, diagrams[upper].variable)
        low_0, low_1 = diagrams.branches(lower, variable)
        high_0, high_1 = diagrams.branches(upper, variable)
        cubes_0, covered_0 = self._between(diagrams.both(low_0, diagrams.complement(high_1)), high_0)
        cubes_1, covered_1 = self._between(diagrams.both(low_1, diagrams.complement(high_0)), high_1)
        # what the cubes with this variable leave open is left to cubes without it
        open_0 = diagrams.both(low_0, diagrams.complement(covered_0))
        open_1 = diagrams.both(low_1, diagrams.complement(covered_1))
        cubes, covered = self._between(diagrams.either(open_0, open_1), diagrams.both(high_0, high_1))
        with_0 = (((variable, False), *cube) for cube in cubes_0)
        with_1 = (((variable, True), *cube) for cube in cubes_1)
        all_cubes = (*with_0, *with_1, *cubes)
        if len(all_cubes) > MAX_CUBES:
            self._count(len(all_cubes))
        decided = diagrams.decide(variable, covered_0, covered_1)
        return all_cubes, diagrams.either(decided, covered)


def guard_words(guard: Guard, propositions: Sequence[Proposition]) -> str:
    """Return a guard as a sentence of the specification language."""
    if guard == ((),):
        return "true"
    texts = [" and ".join(propositions[number].literal(value) for number, value in cube) for cube in guard]
    is_bare = [len(guard) == 1 or len(cube) == 1 for cube in guard]
    return " or ".join(text if bare else f"({text})" for text, bare in zip(texts, is_bare, strict=True))


MAX_VISITS = 25_000_000
"""Decisions visited to find all moves, each once for every state that it may matter to."""


@dataclass(frozen=True)
class Transition:
    """A move from one state to another.

    Attributes:
        guard: cubes of literals (proposition's number, whether it is true), of which one has to hold; no cube
            and no literal of one can be left out.
    """

    source: int
    guard: Guard
    target: int


class Moves(NamedTuple):
    """Moves as diagrams with states as leaves.

    Attributes:
        nodes: for each state.
    """

    diagrams: Diagrams
    nodes: tuple[int, ...]


def moves_of(entries: Sequence[int], decisions: Sequence[tuple[int, int, int]]) -> Moves:
    """Return the moves of an automaton with such `entries` and `decisions`."""
    diagrams = Diagrams()
    nodes: list[int] = []

    def node(place: int) -> int:
        return diagrams.leaf(~place) if place < 0 else nodes[place]

    for proposition, low, high in decisions:
        nodes.append(diagrams.decide(proposition, node(low), node(high)))
    return Moves(diagrams, tuple(node(place) for place in entries))


def successors_of(moves: Moves) -> tuple[tuple[int, ...], ...]:
    """Return for each state, those that one sample can lead to.

    Raises:
        NoAutomatonError: finding them takes more than `MAX_VISITS`.
    """
    diagrams = moves.diagrams
    found: dict[int, tuple[int, ...]] = {}
    visits = 0
    for node in moves.nodes:
        if node not in found:
            below = nodes_of(diagrams, node)
            visits = _counted(visits, len(below))
            leaves = [diagrams[each].low for each in below if diagrams[each].variable == LEAF]
            found[node] = tuple(sorted(leaves))
    return tuple(found[node] for node in moves.nodes)


def transitions_of(moves: Moves, successors: Sequence[Sequence[int]]) -> tuple[Transition, ...]:
    """Return all transitions, by source and target.

    Args:
        successors: those of the moves.

    Raises:
        NoAutomatonError: finding them takes more than `MAX_VISITS`, or their guards more than `MAX_CUBES`.
    """
    count = sum(map(len, successors))
    if count > MAX_CUBES:
        raise NoAutomatonError(f"the automaton has {count} transitions, at most {MAX_CUBES} are kept")
    covers = Covers(moves.diagrams)
    leading = _Leading(moves.diagrams)
    return tuple(
        Transition(source, covers.guard(leading.to(target, node)), target)
        for source, node in enumerate(moves.nodes)
        for target in successors[source]
    )


class _Leading:
    """Whether moves lead to a state, as functions of the propositions."""

    def __init__(self, diagrams: Diagrams) -> None:
        self._diagrams = diagrams
        self._known: dict[int, dict[int, int]] = {}
        self._visits = 0

    def to(self, target: int, node: int) -> int:
        """Return the function that is true where a node leads to a state.

        Raises:
            NoAutomatonError: that, and all calls before, take more than `MAX_VISITS`.
        """
        known = self._known.setdefault(target, {})
        before = len(known)
        result = self._copied(target, node, known)
        self._visits = _counted(self._visits, len(known) - before)
        return result

    def _copied(self, target: int, node: int, known: dict[int, int]) -> int:
        if node not in known:
            variable, low, high = self._diagrams[node]
            if variable == LEAF:
                known[node] = YES if low == target else NO
            else:
                branches = self._copied(target, low, known), self._copied(target, high, known)
                known[node] = self._diagrams.decide(variable, *branches)
        return known[node]


def _counted(visits: int, more: int) -> int:
    if visits + more > MAX_VISITS:
        raise NoAutomatonError(f"finding the automaton's moves takes more than {MAX_VISITS} steps")
    return visits + more
