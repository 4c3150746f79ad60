"""The shortest run that automata accept or reject together, among the runs that geometry allows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count
from typing import Final, NamedTuple, TypeAlias

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.diagrams import LEAF, NO, YES
from spatial_replay.errors import NoAutomatonError
from spatial_replay.sanity.conditions import Fact, FactDiagrams, is_negated
from spatial_replay.sanity.laws import laws
from spatial_replay.sanity.linear import solve
from spatial_replay.sanity.sums import terms_in
from spatial_replay.spec.formula import Protrusion, Signal

Cube: TypeAlias = dict[int, bool]
"""Facts by number that have to be true, or false, in one sample."""

Word: TypeAlias = tuple[Cube, ...]
"""What has to hold in each sample of a run; whatever it leaves open, the end is the same."""

MAX_STEPS: Final = 200_000
"""How many steps one question takes, each a decision of a diagram that is visited."""

MAX_ALL_STEPS: Final = 800_000
"""How many steps all questions about one specification take together."""

_STEPS_AT_ONCE: Final = 150_000
"""How many steps a question takes whose answer would spare others."""

_STEPS_OF_GEOMETRY: Final = 50
"""How many steps asking geometry counts as."""

MAX_CONFLICTS: Final = 2000
"""How many combinations of facts geometry excludes at most before an answer is given up."""


class Side(NamedTuple):
    """An automaton, and whether it has to accept the run or to reject it."""

    automaton: Automaton
    accepts: bool = True


class UndecidedError(Exception):
    """A question that takes too many steps."""


@dataclass(frozen=True)
class Answer:
    """The answer to one question.

    Attributes:
        word: of the shortest run; None if there is none.
        by_logic: whether there is none whatever the facts are about.
        exclusions: facts that exclude each other, without which there would be one.
        opposites: if it is by logic, relations that are each other's opposites, so that logic knows.
        equals: if it is by logic, comparisons whose robustness is the same, as "x > 1" and "x >= 1".
    """

    word: Word | None
    by_logic: bool = False
    exclusions: tuple[tuple[str, ...], ...] = ()
    opposites: tuple[tuple[str, str], ...] = ()
    equals: tuple[tuple[str, str], ...] = ()


class WordSearch:
    """Answers questions about automata over the same conditions; what geometry excludes is kept."""

    def __init__(self, conditions: FactDiagrams) -> None:
        self._conditions = conditions
        self._diagrams = conditions.diagrams
        self._moves: dict[tuple[int, int], int] = {}
        self._automata: dict[int, Automaton] = {}
        self._numbers: dict[tuple[int, ...], int] = {}
        self._tuples: list[tuple[int, ...]] = []
        self._exclusions: list[frozenset[tuple[int, bool]]] = []
        self._allowed = YES
        self._possible: dict[frozenset[tuple[int, bool]], frozenset[int] | None] = {}
        self._terms: dict[int, frozenset[object]] = {}
        self._open: dict[tuple[int, int], set[int]] = {}
        self._steps = self._all_steps = 0

    def shortest(self, *sides: Side) -> Answer:
        """Return the shortest run that all sides agree with.

        Raises:
            UndecidedError: it takes too many steps.
        """
        self._steps = 0
        try:
            word = self._search(sides, geometry=True)
            if word is not None:
                return Answer(word)
            if self._search(sides, geometry=False) is None:
                numbers = sorted(self._read(sides))
                facts = [self.fact(number) for number in numbers]
                # what is compared by "==" and not has no opposites that need to be named
                opposites = [
                    each.texts for each in facts if each.side == ">" and not any(map(is_negated, each.texts))
                ]
                equals = [pair for number in numbers for pair in self._conditions.equal_texts(number)]
                return Answer(None, True, opposites=tuple(opposites), equals=tuple(equals))
        except (NoAutomatonError, RecursionError) as error:
            raise UndecidedError from error
        return Answer(None, exclusions=tuple(self._texts_of(each) for each in self._about(sides)))

    def is_found(self, *sides: Side) -> bool:
        """Return whether a run that all sides agree with is found at once; if not, there may be one."""
        self._steps = MAX_STEPS - _STEPS_AT_ONCE
        exclusions, allowed, all_steps = len(self._exclusions), self._allowed, self._all_steps
        try:
            return self._search(sides, geometry=True) is not None
        except (NoAutomatonError, RecursionError, UndecidedError):
            return False
        finally:
            # answers name the exclusions that they need, not those of other questions
            del self._exclusions[exclusions:]
            self._allowed, self._all_steps = allowed, all_steps

    def _search(self, sides: Sequence[Side], *, geometry: bool) -> Word | None:
        """Return the shortest run by A*: automata say how many samples it takes at least from here on."""
        before: dict[tuple[int, ...], tuple[tuple[int, ...] | None, Cube]] = {}
        order = count()
        # what geometry says is asked when a move is taken out, of few of all that are put in
        waiting: list[tuple[tuple[int, tuple[int, ...], int], int, int, int, tuple[int, ...] | None]] = []

        def put_in(moves: int, leaves: Sequence[int], length: int, source: tuple[int, ...] | None) -> None:
            for leaf in leaves:
                after = self._tuples[leaf]
                if after not in before and all(map(_may_agree, sides, after)):
                    # of equals, those first that need least for the last side: what has to hold once
                    left = tuple(map(_least_left, sides, after))
                    key = length + max(left), left[::-1], -length
                    heappush(waiting, (key, next(order), moves, leaf, source))

        put_in(*self._joined(sides, tuple(side.automaton.initial for side in sides)), 1, None)
        while waiting:
            (_, _, length), _, moves, leaf, source = heappop(waiting)
            after = self._tuples[leaf]
            is_closed = geometry and self._allowed != YES and leaf not in self._open_leaves(moves)
            if after in before or is_closed:
                continue
            cube = self._cube(self._leading(moves, leaf)) if geometry else {}
            if cube is None:
                continue
            before[after] = source, cube
            if all(map(_agrees, sides, after)):
                return tuple(reversed(list(_back(after, before))))
            put_in(*self._joined(sides, after), 1 - length, after)
        return None

    def _spend(self, steps: int) -> None:
        self._steps += steps
        self._all_steps += steps
        if self._steps > MAX_STEPS or self._all_steps > MAX_ALL_STEPS:
            raise UndecidedError

    def _joined(self, sides: Sequence[Side], states: Sequence[int]) -> tuple[int, list[int]]:
        """Return where one sample leads to, as a diagram over facts, and its leaves: tuples of states."""
        nodes = [self._composed(side.automaton, state) for side, state in zip(sides, states, strict=True)]
        known: dict[tuple[int, ...], int] = {}

        def join(key: tuple[int, ...]) -> int:
            if key not in known:
                decisions = [self._diagrams[node] for node in key]
                variable = min(each.variable for each in decisions)
                if variable == LEAF:
                    known[key] = self._diagrams.leaf(self._number(tuple(each.low for each in decisions)))
                else:
                    branches = [self._diagrams.branches(node, variable) for node in key]
                    low, high = (join(each) for each in zip(*branches, strict=True))
                    known[key] = self._diagrams.decide(variable, low, high)
            return known[key]

        whole = join(tuple(nodes))
        self._spend(len(known))
        decisions = [self._diagrams[node] for node in known.values()]
        return whole, list(dict.fromkeys(each.low for each in decisions if each.variable == LEAF))

    def _open_leaves(self, moves: int) -> set[int]:
        """Return the leaves of a diagram to which facts lead that are not excluded together yet."""
        key = moves, self._allowed
        if key not in self._open:
            leaves, waiting, visited = set(), [key], {key}
            while waiting:
                node, allowed = waiting.pop()
                variable = min(self._diagrams[node].variable, self._diagrams[allowed].variable)
                if allowed != NO and self._diagrams[node].variable == LEAF:
                    leaves.add(self._diagrams[node].low)
                elif allowed != NO:
                    branches = [self._diagrams.branches(each, variable) for each in (node, allowed)]
                    more = set(zip(*branches, strict=True)) - visited
                    visited |= more
                    waiting += more
            self._spend(len(visited))
            self._open[key] = leaves
        return self._open[key]

    def _number(self, states: tuple[int, ...]) -> int:
        if states not in self._numbers:
            self._numbers[states] = len(self._tuples)
            self._tuples.append(states)
        return self._numbers[states]

    def _composed(self, automaton: Automaton, state: int) -> int:
        """Return the moves from a state as a diagram over facts, with states as leaves."""
        self._automata[id(automaton)] = automaton
        conditions = [self._conditions.of(each.formula) for each in automaton.propositions]

        def node(place: int) -> int:
            if place < 0:
                return self._diagrams.leaf(~place)
            key = (id(automaton), place)
            if key not in self._moves:
                proposition, low, high = automaton.decisions[place]
                self._moves[key] = self._diagrams.choose(conditions[proposition], node(high), node(low))
            return self._moves[key]

        return node(automaton.entries[state])

    def _leading(self, node: int, leaf: int) -> int:
        """Return where a diagram leads to a leaf."""
        known: dict[int, int] = {}

        def to(each: int) -> int:
            if each not in known:
                variable, low, high = self._diagrams[each]
                if variable == LEAF:
                    known[each] = YES if low == leaf else NO
                else:
                    known[each] = self._diagrams.decide(variable, to(low), to(high))
            return known[each]

        result = to(node)
        self._spend(len(known))
        return result

    def _cube(self, condition: int) -> Cube | None:
        """Return facts that make a condition true, and that geometry allows together; None without any."""
        for _ in range(MAX_CONFLICTS):
            self._spend(_STEPS_OF_GEOMETRY)
            open_ = self._diagrams.both(condition, self._allowed)
            if open_ == NO:
                return None
            cube = self._first(open_)
            # facts on the way that do not matter are left out
            for fact in sorted(cube, reverse=True):
                less = {each: value for each, value in cube.items() if each != fact}
                if self._is_certain(condition, less):
                    cube = less
            conflicts = list(filter(None, map(self._conflict, self._parts(cube))))
            if not conflicts:
                return cube
            for conflict in conflicts:
                self._exclusions.append(frozenset(conflict.items()))
                self._allowed = self._diagrams.both(self._allowed, self._clause(conflict))
        raise UndecidedError

    def _first(self, node: int) -> Cube:
        """Return decisions that lead to true."""
        cube: Cube = {}
        while node != YES:
            variable, low, high = self._diagrams[node]
            cube[variable] = low == NO
            node = high if low == NO else low
        return cube

    def _is_certain(self, node: int, cube: Cube) -> bool:
        """Return whether a function is true wherever some facts have their values."""
        waiting, visited = [node], {node}
        while waiting:
            each = waiting.pop()
            if each == NO:
                return False
            if each == YES:
                continue
            variable, low, high = self._diagrams[each]
            value = cube.get(variable)
            for after in (low, high) if value is None else (high,) if value else (low,):
                if after not in visited:
                    visited.add(after)
                    waiting.append(after)
        return True

    def _clause(self, cube: Cube) -> int:
        """Return where facts do not all have their values."""
        node = NO
        for fact in sorted(cube, reverse=True):
            node = self._diagrams.decide(fact, *((YES, node) if cube[fact] else (node, YES)))
        return node

    def _conflict(self, cube: Cube) -> Cube | None:
        """Return the fewest of some facts that geometry excludes together; None if it allows them all."""
        numbers = self._impossible(cube)
        if numbers is None:
            return None
        core = {number: cube[number] for number in sorted(numbers)}
        for number in tuple(core):
            less = {each: value for each, value in core.items() if each != number}
            if less and self._impossible(less) is not None:
                core = less
        return core

    def _impossible(self, cube: Cube) -> frozenset[int] | None:
        """Return facts of a cube that geometry excludes together; None if it allows them all."""
        key = frozenset(cube.items())
        if key not in self._possible:
            self._possible[key] = self._asked(cube)
        return self._possible[key]

    def _parts(self, cube: Cube) -> list[Cube]:
        """Return a cube in parts that are about different things: no law is about two of them."""
        parts: list[tuple[frozenset[object], Cube]] = []
        for number, value in cube.items():
            about, part = self._about_of(number), {number: value}
            apart = []
            for terms, other in parts:
                if terms.isdisjoint(about):
                    apart.append((terms, other))
                else:
                    about, part = terms | about, {**other, **part}
            parts = [*apart, (about, part)]
        return [part for _, part in parts]

    def _about_of(self, number: int) -> frozenset[object]:
        """Return the terms and signals that a fact is about."""
        if number not in self._terms:
            quantities = [quantity for quantity, _ in self._conditions.facts[number].weights]
            signals = [each for each in quantities if isinstance(each, Signal)]
            self._terms[number] = frozenset([*signals, *terms_in(quantities)])
        return self._terms[number]

    def _asked(self, cube: Cube) -> frozenset[int] | None:
        facts = self._conditions.facts
        own = [
            facts[number].inequality(value, number) for number, value in cube.items() if facts[number].weights
        ]
        inside = {
            quantity
            for each in own
            if len(each.coefficients) == 1 and each.bound <= 0
            for quantity, weight in each.coefficients
            if isinstance(quantity, Protrusion) and weight > 0
        }
        weights = [facts[number].weights for number in cube]
        quantities = dict.fromkeys(quantity for each in weights for quantity, _ in each)
        geometry = [each for each in quantities if not isinstance(each, Signal)]
        known = laws(geometry, inside, self._conditions.regions) if geometry else []
        return solve(own, known).conflict

    def _about(self, sides: Sequence[Side]) -> Iterator[frozenset[tuple[int, bool]]]:
        """Yield the exclusions between facts that automata read."""
        facts = self._read(sides)
        for each in self._exclusions:
            if facts.issuperset(fact for fact, _ in each):
                yield each

    def _read(self, sides: Sequence[Side]) -> set[int]:
        """Return the facts that automata read."""
        facts: set[int] = set()
        waiting = [
            self._conditions.of(each.formula) for side in sides for each in side.automaton.propositions
        ]
        visited = set(waiting)
        while waiting:
            variable, low, high = self._diagrams[waiting.pop()]
            if variable != LEAF:
                facts.add(variable)
                waiting += {low, high} - visited
                visited |= {low, high}
        return facts

    def _texts_of(self, exclusion: frozenset[tuple[int, bool]]) -> tuple[str, ...]:
        texts = (self.fact(number).texts[0 if value else 1] for number, value in sorted(exclusion))
        return tuple(dict.fromkeys(texts))

    def fact(self, number: int) -> Fact:
        """Return a fact by its number."""
        return self._conditions.facts[number]


def _agrees(side: Side, state: int) -> bool:
    return (state in side.automaton.accepting) == side.accepts


def _may_agree(side: Side, state: int) -> bool:
    return state in (side.automaton.can_accept if side.accepts else side.automaton.can_reject)


def _least_left(side: Side, state: int) -> int:
    """Return how many samples it takes at least to end as a side has to."""
    return side.automaton.distances[state] if side.accepts else int(not _agrees(side, state))


def _back(
    states: tuple[int, ...], before: dict[tuple[int, ...], tuple[tuple[int, ...] | None, Cube]]
) -> Iterator[Cube]:
    """Yield the cubes of a run from its last sample back to its first."""
    at: tuple[int, ...] | None = states
    while at is not None:
        at, cube = before[at]
        yield cube
