"""Runs of a few samples that many automata agree with: one diagram over the facts of all samples.

Many automata have more states together than can be visited, but runs that end after a few samples need none
of them: what each automaton asks of such a run is a small diagram by itself, and so are all together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple, TypeAlias

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.diagrams import LEAF, NO, YES, Diagrams

Cube: TypeAlias = dict[int, bool]
"""Facts by number that have to be true, or false, in one sample."""

MAX_NODES: Final = 100_000
"""How many nodes the diagrams about runs of one length have at most."""

MAX_CONFLICTS: Final = 400
"""How many combinations of facts geometry excludes at most before a length is given up."""


class TooManyConflictsError(Exception):
    """More than `MAX_CONFLICTS` combinations of facts were excluded."""


class Side(NamedTuple):
    """An automaton, and whether it has to accept the run or to reject it."""

    automaton: Automaton
    accepts: bool = True

    def agrees(self, state: int) -> bool:
        """Return whether a run may end in a state."""
        return (state in self.automaton.accepting) == self.accepts

    def may_agree(self, state: int) -> bool:
        """Return whether a run may still end as it has to."""
        return state in (self.automaton.can_accept if self.accepts else self.automaton.can_reject)

    def least_left(self, state: int) -> int:
        """Return how many samples it takes at least to end as it has to."""
        return self.automaton.distances[state] if self.accepts else int(not self.agrees(state))


def word_of_length(
    sides: Sequence[Side],
    length: int,
    facts: Diagrams,
    diagrams: Diagrams,
    condition_of: Callable[[Automaton], Sequence[int]],
    conflicts: Callable[[Cube], Iterable[Cube]],
    avoided: Sequence[Sequence[Cube]] = (),
) -> tuple[Cube, ...] | None:
    """Return what has to hold in each sample of a run of some length that all sides agree with.

    Args:
        facts: the diagrams that conditions are in.
        diagrams: new ones, of `MAX_NODES` at most, for those about runs.
        condition_of: returns the condition of each proposition of an automaton.
        conflicts: returns facts of one sample that exclude each other.
        avoided: what no such run may have: facts of each sample, or of one in any.

    Raises:
        NoAutomatonError: it takes too many nodes.
        RecursionError: it takes too many facts.
        TooManyConflictsError: geometry excludes too much.
    """
    runs = _Runs(length, facts, diagrams)
    whole = YES
    for side in sides:
        whole = runs.diagrams.both(whole, runs.agreed(side, condition_of(side.automaton)))
    allowed = whole
    for word in avoided:
        allowed = runs.without(allowed, word)
    for _ in range(MAX_CONFLICTS):
        if allowed == NO:
            return None
        word = runs.split(necessary(runs.diagrams, whole, first_cube(runs.diagrams, allowed)))
        excluded = [conflict for cube in word for conflict in conflicts(cube)]
        if not excluded:
            return word
        for conflict in excluded:
            allowed = runs.without(allowed, [conflict])
    raise TooManyConflictsError


def agreements(
    sides: Sequence[Side],
    word: Sequence[Cube],
    facts: Diagrams,
    diagrams: Diagrams,
    condition_of: Callable[[Automaton], Sequence[int]],
) -> list[tuple[bool, bool]]:
    """Return of each side whether it agrees with any of the runs in which some facts hold, and with all.

    Raises:
        NoAutomatonError: it takes too many nodes.
    """
    runs = _Runs(len(word), facts, diagrams)
    cube = {
        runs.variable(fact, index): value for index, each in enumerate(word) for fact, value in each.items()
    }
    never = clause(diagrams, cube)
    agreed = [runs.agreed(side, condition_of(side.automaton)) for side in sides]
    return [(diagrams.either(never, each) != never, diagrams.either(never, each) == YES) for each in agreed]


class _Runs:
    """Diagrams about all samples of a run: the samples of one fact are next to each other."""

    def __init__(self, length: int, facts: Diagrams, diagrams: Diagrams) -> None:
        self.diagrams, self._length, self._facts = diagrams, length, facts
        self._at: dict[tuple[int, int], int] = {}

    def variable(self, fact: int, index: int) -> int:
        """Return the variable of a fact in a sample."""
        return fact * self._length + index

    def clause(self, word: Sequence[Cube], first: int = 0) -> int:
        """Return where facts of some samples do not all have their values."""
        cubes = enumerate(word, first)
        return clause(
            self.diagrams,
            {self.variable(fact, index): value for index, cube in cubes for fact, value in cube.items()},
        )

    def without(self, node: int, word: Sequence[Cube]) -> int:
        """Return the runs in which facts do not all have their values: those of one sample, in none."""
        for first in range(self._length - len(word) + 1):
            node = self.diagrams.both(node, self.clause(word, first))
        return node

    def split(self, cube: Cube) -> tuple[Cube, ...]:
        """Return the facts of each sample."""
        word: tuple[Cube, ...] = tuple({} for _ in range(self._length))
        for variable, value in cube.items():
            fact, index = divmod(variable, self._length)
            word[index][fact] = value
        return word

    def agreed(self, side: Side, conditions: Sequence[int]) -> int:
        """Return the runs that a side agrees with."""
        automaton = side.automaton
        known: dict[tuple[int, int], int] = {}

        def after(state: int, index: int) -> int:
            if index == self._length:
                return YES if side.agrees(state) else NO
            if not side.may_agree(state):
                return NO
            return decided(automaton.entries[state], index)

        def decided(place: int, index: int) -> int:
            if place < 0:
                return after(~place, index + 1)
            key = place, index
            if key not in known:
                proposition, low, high = automaton.decisions[place]
                condition = self._in_sample(conditions[proposition], index)
                known[key] = self.diagrams.choose(condition, decided(high, index), decided(low, index))
            return known[key]

        return after(automaton.initial, 0)

    def _in_sample(self, node: int, index: int) -> int:
        """Return a condition on facts as one on a sample."""
        key = node, index
        if key not in self._at:
            fact, low, high = self._facts[node]
            self._at[key] = (
                node
                if fact == LEAF
                else self.diagrams.decide(
                    self.variable(fact, index), self._in_sample(low, index), self._in_sample(high, index)
                )
            )
        return self._at[key]


def first_cube(diagrams: Diagrams, node: int) -> Cube:
    """Return decisions that lead to true."""
    cube: Cube = {}
    while node != YES:
        variable, low, high = diagrams[node]
        cube[variable] = low == NO
        node = high if low == NO else low
    return cube


def necessary(diagrams: Diagrams, condition: int, cube: Cube) -> Cube:
    """Return facts of a cube that make a condition true, without those that do not matter."""
    for fact in sorted(cube, reverse=True):
        less = {each: value for each, value in cube.items() if each != fact}
        if _is_certain(diagrams, condition, less):
            cube = less
    return cube


def _is_certain(diagrams: Diagrams, node: int, cube: Cube) -> bool:
    """Return whether a function is true wherever some facts have their values."""
    waiting, visited = [node], {node}
    while waiting:
        each = waiting.pop()
        if each == NO:
            return False
        if each == YES:
            continue
        variable, low, high = diagrams[each]
        value = cube.get(variable)
        for after in (low, high) if value is None else (high,) if value else (low,):
            if after not in visited:
                visited.add(after)
                waiting.append(after)
    return True


def clause(diagrams: Diagrams, cube: Cube) -> int:
    """Return where facts do not all have their values."""
    node = NO
    for fact in sorted(cube, reverse=True):
        node = diagrams.decide(fact, *((YES, node) if cube[fact] else (node, YES)))
    return node
