"""The moves of an automaton: which states lead to which others, and under what guards.

Moves are kept as decision diagrams. A guard is a disjunction of few cubes, which is computed from them when
it is asked for: an automaton may have far more transitions, and these more cubes, than anyone will look at.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias, overload

from spatial_replay.automata.diagrams import LEAF, NO, YES, Diagrams
from spatial_replay.automata.propositions import Proposition
from spatial_replay.errors import NoAutomatonError

Literal: TypeAlias = tuple[int, bool]
"""A proposition's number, and whether it has to be true."""

Cube: TypeAlias = tuple[Literal, ...]
"""Literals that all have to hold, by proposition; without any, it always does."""

Guard: TypeAlias = tuple[Cube, ...]
"""Cubes of which one has to hold."""


MAX_CUBES = 100_000
"""How many cubes a guard has at most."""

FEW_CUBES = 1_000
"""How many cubes are kept of a guard that has more than `MAX_CUBES`."""


class Covers:
    """Functions as irredundant disjunctions of cubes: no cube and no literal of one can be left out.

    The algorithm is that of Minato and Morreale (1992): equal functions have equal cubes.
    """

    def __init__(self, diagrams: Diagrams) -> None:
        self._diagrams = diagrams
        self._known: dict[tuple[int, int], _Cover] = {}

    def guard(self, node: int) -> Guard:
        """Return the cubes of a function.

        Raises:
            NoAutomatonError: they are more than `MAX_CUBES`.
        """
        cover = self._between(node, node)
        # counted before they are written out
        if cover.size > MAX_CUBES:
            raise NoAutomatonError(f"a guard takes more than {MAX_CUBES} cubes")
        return tuple(sorted(_cubes_of(cover)))

    def some(self, node: int) -> Guard:
        """Return some cubes of a function, `FEW_CUBES` at most, of which no two hold at once."""
        found: list[Cube] = []
        stack: list[tuple[int, Cube]] = [(node, ())]
        while stack and len(found) < FEW_CUBES:
            each, cube = stack.pop()
            variable, low, high = self._diagrams[each]
            if each == YES:
                found.append(cube)
            elif each != NO:
                stack += ((high, (*cube, (variable, True))), (low, (*cube, (variable, False))))
        return tuple(found)

    def _between(self, lower: int, upper: int) -> _Cover:
        """Return cubes that hold where `lower` does and at most where `upper` does."""
        if lower == NO:
            return _Cover(0, NO)
        if upper == YES:
            return _Cover(1, YES)
        key = (lower, upper)
        if key not in self._known:
            self._known[key] = self._split(lower, upper)
        return self._known[key]

    def _split(self, lower: int, upper: int) -> _Cover:
        diagrams = self._diagrams
        variable = min(diagrams[lower].variable, diagrams[upper].variable)
        low_0, low_1 = diagrams.branches(lower, variable)
        high_0, high_1 = diagrams.branches(upper, variable)
        low = self._between(diagrams.both(low_0, diagrams.complement(high_1)), high_0)
        high = self._between(diagrams.both(low_1, diagrams.complement(high_0)), high_1)
        # what the cubes with this variable leave open is left to cubes without it
        open_0 = diagrams.both(low_0, diagrams.complement(low.covered))
        open_1 = diagrams.both(low_1, diagrams.complement(high.covered))
        rest = self._between(diagrams.either(open_0, open_1), diagrams.both(high_0, high_1))
        decided = diagrams.decide(variable, low.covered, high.covered)
        size = low.size + high.size + rest.size
        return _Cover(size, diagrams.either(decided, rest.covered), (variable, low, high, rest))


class _Cover(NamedTuple):
    """Cubes that are not written out.

    Attributes:
        size: how many there are.
        covered: the function that they are together.
        split: a variable, the cubes in which it is false and true, without it, and those that leave it out;
            None for no cube, or the empty one alone.
    """

    size: int
    covered: int
    split: tuple[int, _Cover, _Cover, _Cover] | None = None


def _cubes_of(cover: _Cover) -> Iterator[Cube]:
    """Yield the cubes of a cover."""
    waiting: list[tuple[_Cover, Cube]] = [(cover, ())]
    while waiting:
        (size, _, split), cube = waiting.pop()
        if split is not None:
            variable, low, high, rest = split
            waiting += ((low, (*cube, (variable, False))), (high, (*cube, (variable, True))), (rest, cube))
        elif size:
            yield cube


@dataclass(frozen=True)
class Transition:
    """A move from one state to another.

    Attributes:
        guard: cubes of literals (proposition's number, whether it is true), of which one has to hold; no cube
            and no literal of one can be left out.
        is_cut: whether the guard takes more than `MAX_CUBES`. Then it has only some of them, each of which
            leads to the target, and no two of which hold at once.
    """

    source: int
    guard: Guard
    target: int
    is_cut: bool = False


def guard_words(move: Transition, propositions: Sequence[Proposition], longest: int | None = None) -> str:
    """Return a guard as a sentence of the specification language; one that is cut ends in "…".

    Args:
        longest: characters after which it is cut.
    """
    if move.guard == ((),):
        return "true"
    parts: list[str] = []
    length = 0
    for cube in move.guard:
        text = " and ".join(propositions[number].literal(value) for number, value in cube)
        parts.append(text if len(move.guard) == 1 or len(cube) == 1 else f"({text})")
        length += len(parts[-1])
        if longest is not None and length > longest:
            break
    words = " or ".join([*parts, "…"] if move.is_cut else parts)
    return words if longest is None or len(words) <= longest else f"{words[: longest - 1].rstrip()}…"


class Moves:
    """The moves of an automaton as decision diagrams; what was asked for is remembered."""

    def __init__(self, entries: Sequence[int], decisions: Sequence[tuple[int, int, int]]) -> None:
        """Take over `entries` and `decisions` of an automaton."""
        self._diagrams = Diagrams()
        self._covers = Covers(self._diagrams)
        places: list[int] = []

        def node(place: int) -> int:
            return self._diagrams.leaf(~place) if place < 0 else places[place]

        for proposition, low, high in decisions:
            places.append(self._diagrams.decide(proposition, node(low), node(high)))
        self._nodes = tuple(node(place) for place in entries)
        self._successors: dict[int, tuple[int, ...]] = {}
        self._leading: dict[int, dict[int, int]] = {}
        self._transitions: dict[tuple[int, int], Transition] = {}

    def __len__(self) -> int:
        return len(self._nodes)

    def successors(self, source: int) -> tuple[int, ...]:
        """Return the states that one sample can lead to from a state, in order."""
        node = self._nodes[source]
        if node not in self._successors:
            self._successors[node] = tuple(sorted(self._leaves(node)))
        return self._successors[node]

    def transition(self, source: int, target: int) -> Transition:
        """Return the move from one state to another that one sample can lead to."""
        key = (source, target)
        if key not in self._transitions:
            node = self._to(target, self._nodes[source], self._leading.setdefault(target, {}))
            try:
                move = Transition(source, self._covers.guard(node), target)
            except NoAutomatonError:
                move = Transition(source, self._covers.some(node), target, is_cut=True)
            self._transitions[key] = move
        return self._transitions[key]

    def _leaves(self, node: int) -> set[int]:
        visited = {node}
        leaves = set()
        stack = [node]
        while stack:
            variable, low, high = self._diagrams[stack.pop()]
            if variable == LEAF:
                leaves.add(low)
                continue
            for each in (low, high):
                if each not in visited:
                    visited.add(each)
                    stack.append(each)
        return leaves

    def _to(self, target: int, node: int, known: dict[int, int]) -> int:
        """Return the function that is true where a node leads to a state."""
        if node not in known:
            variable, low, high = self._diagrams[node]
            if variable == LEAF:
                known[node] = YES if low == target else NO
            else:
                branches = self._to(target, low, known), self._to(target, high, known)
                known[node] = self._diagrams.decide(variable, *branches)
        return known[node]


class Successors(Sequence[tuple[int, ...]]):
    """For each state, those that one sample can lead to; worked out when they are asked for."""

    def __init__(self, moves: Moves) -> None:
        self._moves = moves

    def __len__(self) -> int:
        return len(self._moves)

    @overload
    def __getitem__(self, state: int) -> tuple[int, ...]: ...

    @overload
    def __getitem__(self, state: slice) -> tuple[tuple[int, ...], ...]: ...

    def __getitem__(self, state: int | slice) -> tuple[int, ...] | tuple[tuple[int, ...], ...]:
        if isinstance(state, slice):
            return tuple(self[each] for each in range(len(self))[state])
        if not -len(self) <= state < len(self):
            raise IndexError(f"no state {state}; there are 0 to {len(self) - 1}")
        return self._moves.successors(state % len(self))
