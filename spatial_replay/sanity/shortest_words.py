"""Shortest runs that automata jointly accept or reject, among the runs that geometry allows.

The product of many automata has too many states for a search. Short runs need no product: the runs of a few
samples with the outcome of an automaton are a small diagram over the facts of all samples. A spec without an
automaton has looser readings, which still decide some questions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import chain, combinations, count, islice, product
from typing import Final, Literal, NamedTuple, TypeAlias

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.compile import automaton
from spatial_replay.automata.guards import LEAF, NO, YES, Diagrams
from spatial_replay.errors import NoAutomatonError
from spatial_replay.sanity.conditions import Fact, FactDiagrams, is_negated, terms_in
from spatial_replay.sanity.laws import LEVEL, laws
from spatial_replay.sanity.linear import solve
from spatial_replay.spec.formula import (
    PAST_OPERATORS,
    Boolean,
    Formula,
    NamedSpec,
    Protrusion,
    Signal,
    Specification,
    Temporal,
    Truth,
    expand,
)
from spatial_replay.spec.walks import iter_formulas

# -------------------------------------------------------------------------------------- runs of a few samples

Cube: TypeAlias = dict[int, bool]
"""Required values of facts in one sample, by number of the fact."""

MAX_NODES: Final = 100_000
"""Maximum number of nodes in the diagrams of runs of one length."""

MAX_CONFLICTS_OF_A_LENGTH: Final = 400
"""Maximum number of combinations of facts that geometry excludes before a length is given up."""


class TooManyConflictsError(Exception):
    """Geometry excludes more than `MAX_CONFLICTS_OF_A_LENGTH` combinations of facts."""


class Side(NamedTuple):
    """Automaton with its required outcome: it accepts the run (`accepts`) or rejects it."""

    automaton: Automaton
    accepts: bool = True

    def agrees(self, state: int) -> bool:
        """Return whether a run that ends in a state has the required outcome."""
        return (state in self.automaton.accepting) == self.accepts

    def may_agree(self, state: int) -> bool:
        """Return whether a run can still get the required outcome from a state."""
        return state in (self.automaton.can_accept if self.accepts else self.automaton.can_reject)

    def least_remaining(self, state: int) -> int:
        """Return a lower bound of the samples from a state to the required outcome."""
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
    """Return the requirements on each sample of a run of given length with the outcomes of all sides.

    The result is None if there is no such run.

    Args:
        facts: diagrams of the conditions.
        diagrams: empty diagrams for the runs, with room for `MAX_NODES` nodes.
        condition_of: function that returns the conditions of an automaton's propositions.
        conflicts: function that returns combinations of facts in one sample that geometry excludes.
        avoided: words that the run must not contain; a word of one cube is excluded in every sample.

    Raises:
        NoAutomatonError: the diagrams need too many nodes.
        RecursionError: the runs have too many facts.
        TooManyConflictsError: geometry excludes too many combinations of facts.
    """
    runs = _Runs(length, facts, diagrams)
    whole = YES
    for side in sides:
        whole = runs.diagrams.both(whole, runs.agreeing_runs(side, condition_of(side.automaton)))
    allowed = whole
    for word in avoided:
        allowed = runs.without(allowed, word)
    for _ in range(MAX_CONFLICTS_OF_A_LENGTH):
        if allowed == NO:
            return None
        # requirements are those of the sides alone (`whole`), without the exclusions
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
    """Return two flags for each side: whether some run with a word has its outcome, and whether all have it.

    Raises:
        NoAutomatonError: the diagrams need too many nodes.
    """
    runs = _Runs(len(word), facts, diagrams)
    cube = {
        runs.variable(fact, index): value
        for index, sample_cube in enumerate(word)
        for fact, value in sample_cube.items()
    }
    never = clause(diagrams, cube)
    nodes = [runs.agreeing_runs(side, condition_of(side.automaton)) for side in sides]
    return [(diagrams.either(never, node) != never, diagrams.either(never, node) == YES) for node in nodes]


class _Runs:
    """Diagrams over the facts in all samples of a run; the variables of one fact are next to each other."""

    def __init__(self, length: int, facts: Diagrams, diagrams: Diagrams) -> None:
        self.diagrams, self._length, self._facts = diagrams, length, facts
        self._at: dict[tuple[int, int], int] = {}

    def variable(self, fact: int, index: int) -> int:
        """Return the variable of a fact in a sample."""
        return fact * self._length + index

    def clause(self, word: Sequence[Cube], first: int = 0) -> int:
        """Return the diagram of the runs that differ from a word, which begins at sample `first`."""
        cubes = enumerate(word, first)
        return clause(
            self.diagrams,
            {self.variable(fact, index): value for index, cube in cubes for fact, value in cube.items()},
        )

    def without(self, node: int, word: Sequence[Cube]) -> int:
        """Return the runs of a diagram without those that contain a word."""
        for first in range(self._length - len(word) + 1):
            node = self.diagrams.both(node, self.clause(word, first))
        return node

    def split(self, cube: Cube) -> tuple[Cube, ...]:
        """Split a cube over all samples into the cubes of single samples."""
        word: tuple[Cube, ...] = tuple({} for _ in range(self._length))
        for variable, value in cube.items():
            fact, index = divmod(variable, self._length)
            word[index][fact] = value
        return word

    def agreeing_runs(self, side: Side, conditions: Sequence[int]) -> int:
        """Return the diagram of the runs with the outcome of a side."""
        automaton = side.automaton
        nodes: dict[tuple[int, int], int] = {}

        def after(state: int, index: int) -> int:
            if index == self._length:
                return YES if side.agrees(state) else NO
            if not side.may_agree(state):
                return NO
            return decision_node(automaton.entries[state], index)

        def decision_node(place: int, index: int) -> int:
            if place < 0:
                return after(~place, index + 1)
            key = place, index
            if key not in nodes:
                proposition, low, high = automaton.decisions[place]
                condition = self._in_sample(conditions[proposition], index)
                nodes[key] = self.diagrams.choose(
                    condition, decision_node(high, index), decision_node(low, index)
                )
            return nodes[key]

        return after(automaton.initial, 0)

    def _in_sample(self, node: int, index: int) -> int:
        """Return the diagram of a condition in one sample of the run."""
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
    """Return decisions on a path to true; a fact is true only if false leads nowhere."""
    cube: Cube = {}
    while node != YES:
        variable, low, high = diagrams[node]
        cube[variable] = low == NO
        node = high if low == NO else low
    return cube


def necessary(diagrams: Diagrams, condition: int, cube: Cube) -> Cube:
    """Return facts of a cube that make a condition true; without any of them it could be false."""
    for fact in sorted(cube, reverse=True):
        less = {number: value for number, value in cube.items() if number != fact}
        if _is_certain(diagrams, condition, less):
            cube = less
    return cube


def _is_certain(diagrams: Diagrams, node: int, cube: Cube) -> bool:
    """Return whether a condition is true for all values of the facts that are not in a cube."""
    waiting, visited = [node], {node}
    while waiting:
        current = waiting.pop()
        if current == NO:
            return False
        if current == YES:
            continue
        variable, low, high = diagrams[current]
        value = cube.get(variable)
        for after in (low, high) if value is None else (high,) if value else (low,):
            if after not in visited:
                visited.add(after)
                waiting.append(after)
    return True


def clause(diagrams: Diagrams, cube: Cube) -> int:
    """Return the condition that some fact of a cube has another value."""
    node = NO
    for fact in sorted(cube, reverse=True):
        node = diagrams.decide(fact, *((YES, node) if cube[fact] else (node, YES)))
    return node


# ----------------------------------------------------------------------------------------- runs of any length

Word: TypeAlias = tuple[Cube, ...]
"""Requirements on each sample of a run; other facts do not change the outcome."""

MAX_STEPS: Final = 100_000
"""Maximum number of steps of one question; a step is a visited decision of a diagram."""

MAX_ALL_STEPS: Final = 400_000
"""Maximum number of steps of all questions about one specification."""

_STEPS_OF_GEOMETRY: Final = 50
"""Steps that one check of geometry counts as."""

MAX_CONFLICTS: Final = 2000
"""Maximum number of combinations of facts that geometry excludes before a question is given up."""


MAX_LENGTHS: Final = 4
"""Maximum number of lengths that are tried without a product, from the least possible length on."""

MAX_SHORT: Final = 12
"""Longest run that is searched for without a product, samples."""

_ON_ONE_LEVEL: Final = "no gap in height"
"""Text that is added to an exclusion that does not hold for objects above each other."""

MAX_PAIRS: Final = 200
"""Maximum number of pairs of automata that are tested for excluding each other."""

Runs: TypeAlias = tuple[tuple[Side, ...], ...]
"""Alternatives: the runs that have the outcomes of all sides of at least one alternative."""


class UndecidedError(Exception):
    """A question takes too many steps."""


@dataclass(frozen=True)
class Answer:
    """Answer to one question: the shortest run, or the reason why there is none.

    Attributes:
        word: requirements of the shortest run; None if there is no run.
        by_logic: whether there is no run even without laws of geometry.
        exclusions: facts that exclude each other by geometry; without these exclusions there would be a run.
        opposites: with `by_logic`, pairs of relations that are each other's negation.
        equals: with `by_logic`, pairs of comparisons with the same robustness, such as "x > 1" and "x >= 1".
    """

    word: Word | None
    by_logic: bool = False
    exclusions: tuple[tuple[str, ...], ...] = ()
    opposites: tuple[tuple[str, str], ...] = ()
    equals: tuple[tuple[str, str], ...] = ()


class WordSearch:
    """Search for runs of automata over the same conditions; exclusions by geometry are stored."""

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

    def shortest(self, *runs: Runs) -> Answer:
        """Return the answer on the shortest run in the intersection of some sets of runs.

        Raises:
            UndecidedError: the search takes too many steps.
        """
        self._steps = 0
        options = _together(runs)
        try:
            word = self._short(options)
            if word is not None and any(word):
                return Answer(word)
            answers = [self._refine(sides) for sides in options]
        except (NoAutomatonError, RecursionError) as error:
            raise UndecidedError from error
        words = [answer for answer in answers if answer.word is not None]
        return min(words, key=lambda answer: len(answer.word or ()), default=joint(answers))

    def is_found(self, *runs: Runs) -> bool:
        """Return whether a short run in the intersection is found; False does not exclude longer runs."""
        return self._short(_together(runs)) is not None

    def another(self, length: int, avoided: Sequence[Word], *runs: Runs) -> Word | None:
        """Return a run of given length in the intersection of some sets of runs; None if none is found.

        Args:
            avoided: words that the run must not contain, as in `word_of_length`.
        """
        for sides in _together(runs):
            try:
                word = self._of_length(sides, length, avoided)
            except (NoAutomatonError, RecursionError, TooManyConflictsError):
                continue
            if word is not None:
                return word
        return None

    def _of_length(self, sides: Sequence[Side], length: int, avoided: Sequence[Word] = ()) -> Word | None:
        diagrams = Diagrams(MAX_NODES)
        try:
            return word_of_length(
                sides, length, self._diagrams, diagrams, self._conditions_of, self._conflicts, avoided
            )
        finally:
            self._all_steps += len(diagrams)

    def _short(self, options: Sequence[Sequence[Side]]) -> Word | None:
        """Return the shortest run among runs of a few samples; None if none is found."""
        least = [
            max([1, *(side.least_remaining(side.automaton.initial) for side in sides)])
            for sides in options
            if all(side.may_agree(side.automaton.initial) for side in sides)
        ]
        first, left = min(least, default=MAX_SHORT), list(options)
        lengths = 1 if self._all_steps > MAX_ALL_STEPS else MAX_LENGTHS
        for length in range(first, min(first + lengths, MAX_SHORT + 1)):
            anything = None
            for sides in tuple(left):
                try:
                    word = self._of_length(sides, length)
                except (NoAutomatonError, RecursionError, TooManyConflictsError):
                    # longer runs need even more nodes
                    left.remove(sides)
                    continue
                # a run with requirements is preferred to an empty word, which stands for any run
                if word is not None and any(word):
                    return word
                anything = anything or word
            if anything is not None or not left:
                return anything
        return None

    def _refine(self, sides: Sequence[Side]) -> Answer:
        """Return the answer for all sides by questions about few of them.

        A side that disagrees with the run of these few sides is added to them.
        """
        pairs = combinations(sides, 2) if len(sides) > 2 else ()
        for pair in islice(pairs, MAX_PAIRS):
            if self._short([pair]) is None and (answer := self._decide(pair)).word is None:
                return answer
        subset = list(sides[-1:])
        while True:
            answer = self._decide(subset)
            missing = None if answer.word is None else self._disagreeing(sides, answer.word)
            if missing is None:
                return answer
            subset.append(missing)

    def _disagreeing(self, sides: Sequence[Side], word: Word) -> Side | None:
        """Return a side that may disagree with a run, preferably one that must; None if all agree."""
        diagrams = Diagrams(MAX_NODES)
        agreement_flags = agreements(sides, word, self._diagrams, diagrams, self._conditions_of)
        partly = [side for side, (_, is_whole) in zip(sides, agreement_flags, strict=True) if not is_whole]
        wholly = [side for side, (is_any, _) in zip(sides, agreement_flags, strict=True) if not is_any]
        return next(iter([*wholly, *partly]), None)

    def _decide(self, sides: Sequence[Side]) -> Answer:
        word = self._search(sides, geometry=True)
        if word is not None:
            return Answer(word)
        if self._search(sides, geometry=False) is not None:
            return Answer(
                None, exclusions=tuple(self._texts_of(exclusion) for exclusion in self._about(sides))
            )
        numbers = sorted(self._read(sides))
        facts = [self.fact(number) for number in numbers]
        # opposites of exact comparisons and of negated relations need no explanation
        opposites = [
            fact.texts for fact in facts if fact.side == ">" and not any(map(is_negated, fact.texts))
        ]
        equals = [pair for number in numbers for pair in self._conditions.equal_texts(number)]
        return Answer(None, True, opposites=tuple(opposites), equals=tuple(equals))

    def _conditions_of(self, automaton: Automaton) -> list[int]:
        return [self._conditions.of(proposition.formula) for proposition in automaton.propositions]

    def _conflicts(self, cube: Cube) -> list[Cube]:
        """Return minimal excluded combinations of facts, at most one for each independent part of a cube."""
        return list(filter(None, map(self._conflict, self._parts(cube))))

    def _search(self, sides: Sequence[Side], *, geometry: bool) -> Word | None:
        """Return the shortest run by A*; the automata give the lower bound of the remaining samples."""
        before: dict[tuple[int, ...], tuple[tuple[int, ...] | None, Cube]] = {}
        # the number breaks ties, so that heapq compares nothing behind it
        order = count()
        # geometry is checked when a move leaves the queue, because most moves never leave it
        waiting: list[tuple[tuple[int, tuple[int, ...], int], int, int, int, tuple[int, ...] | None]] = []

        def put_in(moves: int, leaves: Sequence[int], length: int, source: tuple[int, ...] | None) -> None:
            for leaf in leaves:
                after = self._tuples[leaf]
                if after not in before and all(map(Side.may_agree, sides, after)):
                    # among equal bounds, moves near the end of the last side come first, then long runs
                    left = tuple(map(Side.least_remaining, sides, after))
                    key = length + max(left), left[::-1], -length
                    heappush(waiting, (key, next(order), moves, leaf, source))

        put_in(*self._join(sides, tuple(side.automaton.initial for side in sides)), 1, None)
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
            if all(map(Side.agrees, sides, after)):
                return tuple(reversed(list(_back(after, before))))
            put_in(*self._join(sides, after), 1 - length, after)
        return None

    def _spend(self, steps: int) -> None:
        self._steps += steps
        self._all_steps += steps
        if self._steps > MAX_STEPS or self._all_steps > MAX_ALL_STEPS:
            raise UndecidedError

    def _join(self, sides: Sequence[Side], states: Sequence[int]) -> tuple[int, list[int]]:
        """Return the moves of all sides in one sample as a diagram over facts, and its leaves.

        A leaf is a tuple with the next state of each side.
        """
        nodes = [self._compose(side.automaton, state) for side, state in zip(sides, states, strict=True)]
        joined_nodes: dict[tuple[int, ...], int] = {}

        def join(key: tuple[int, ...]) -> int:
            if key not in joined_nodes:
                decisions = [self._diagrams[node] for node in key]
                variable = min(decision.variable for decision in decisions)
                if variable == LEAF:
                    joined_nodes[key] = self._diagrams.leaf(
                        self._number(tuple(decision.low for decision in decisions))
                    )
                else:
                    branches = [self._diagrams.branches(node, variable) for node in key]
                    low, high = (join(branch) for branch in zip(*branches, strict=True))
                    joined_nodes[key] = self._diagrams.decide(variable, low, high)
            return joined_nodes[key]

        whole = join(tuple(nodes))
        self._spend(len(joined_nodes))
        decisions = [self._diagrams[node] for node in joined_nodes.values()]
        return whole, list(dict.fromkeys(decision.low for decision in decisions if decision.variable == LEAF))

    def _open_leaves(self, moves: int) -> set[int]:
        """Return the leaves of a diagram that can be reached without a known exclusion."""
        key = moves, self._allowed
        if key not in self._open:
            leaves, waiting, visited = set(), [key], {key}
            while waiting:
                node, allowed = waiting.pop()
                variable = min(self._diagrams[node].variable, self._diagrams[allowed].variable)
                if allowed != NO and self._diagrams[node].variable == LEAF:
                    leaves.add(self._diagrams[node].low)
                elif allowed != NO:
                    branches = [self._diagrams.branches(diagram, variable) for diagram in (node, allowed)]
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

    def _compose(self, automaton: Automaton, state: int) -> int:
        """Return the moves from a state as a diagram over facts, with states as leaves."""
        # stored, because the id of a deleted automaton can be reused
        self._automata[id(automaton)] = automaton
        conditions = self._conditions_of(automaton)

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
        """Return the condition under which a diagram leads to a leaf."""
        nodes: dict[int, int] = {}

        def to(inner: int) -> int:
            if inner not in nodes:
                variable, low, high = self._diagrams[inner]
                if variable == LEAF:
                    nodes[inner] = YES if low == leaf else NO
                else:
                    nodes[inner] = self._diagrams.decide(variable, to(low), to(high))
            return nodes[inner]

        result = to(node)
        self._spend(len(nodes))
        return result

    def _cube(self, condition: int) -> Cube | None:
        """Return a cube that makes a condition true and that geometry allows; None if there is none."""
        for _ in range(MAX_CONFLICTS):
            self._spend(_STEPS_OF_GEOMETRY)
            open_ = self._diagrams.both(condition, self._allowed)
            if open_ == NO:
                return None
            cube = necessary(self._diagrams, condition, first_cube(self._diagrams, open_))
            conflicts = self._conflicts(cube)
            if not conflicts:
                return cube
            for conflict in conflicts:
                self._exclusions.append(frozenset(conflict.items()))
                self._allowed = self._diagrams.both(self._allowed, clause(self._diagrams, conflict))
        raise UndecidedError

    def _conflict(self, cube: Cube) -> Cube | None:
        """Return a minimal combination of facts in a cube that geometry excludes; None if there is none."""
        numbers = self._impossible(cube)
        if numbers is None:
            return None
        core = {number: cube[number] for number in sorted(numbers - {LEVEL})}
        for number in tuple(core):
            less = {fact: value for fact, value in core.items() if fact != number}
            if less and self._impossible(less) is not None:
                core = less
        return core

    def _impossible(self, cube: Cube) -> frozenset[int] | None:
        """Return facts of a cube that exclude each other by geometry; None if it allows them all."""
        key = frozenset(cube.items())
        if key not in self._possible:
            self._possible[key] = self._ask_geometry(cube)
        return self._possible[key]

    def _parts(self, cube: Cube) -> list[Cube]:
        """Split a cube into parts without common terms or signals, so that no law connects two parts."""
        parts: list[tuple[frozenset[object], Cube]] = []
        for number, value in cube.items():
            about, part = self._about_of(number), {number: value}
            apart = []
            for terms, other_cube in parts:
                if terms.isdisjoint(about):
                    apart.append((terms, other_cube))
                else:
                    about, part = terms | about, {**other_cube, **part}
            parts = [*apart, (about, part)]
        return [part for _, part in parts]

    def _about_of(self, number: int) -> frozenset[object]:
        """Return the terms and signals of a fact."""
        if number not in self._terms:
            quantities = [quantity for quantity, _ in self._conditions.facts[number].weights]
            signals = [quantity for quantity in quantities if isinstance(quantity, Signal)]
            self._terms[number] = frozenset([*signals, *terms_in(quantities)])
        return self._terms[number]

    def _ask_geometry(self, cube: Cube) -> frozenset[int] | None:
        facts = self._conditions.facts
        inequalities = [
            facts[number].inequality(value, number) for number, value in cube.items() if facts[number].weights
        ]
        inside = {
            quantity
            for inequality in inequalities
            if len(inequality.coefficients) == 1 and inequality.bound <= 0
            for quantity, weight in inequality.coefficients
            if isinstance(quantity, Protrusion) and weight > 0
        }
        weights = [facts[number].weights for number in cube]
        quantities = dict.fromkeys(quantity for fact_weights in weights for quantity, _ in fact_weights)
        geometry = [quantity for quantity in quantities if not isinstance(quantity, Signal)]
        conditions = self._conditions
        geometry_laws = laws(geometry, inside, conditions.regions, conditions.between, conditions.diameters)
        return solve(inequalities, geometry_laws).conflict

    def _about(self, sides: Sequence[Side]) -> list[frozenset[tuple[int, bool]]]:
        """Return the exclusions between facts of the automata or, without any, those with one such fact."""
        facts = self._read(sides)
        about = [(exclusion, {fact for fact, _ in exclusion}) for exclusion in self._exclusions]
        within = [exclusion for exclusion, read in about if facts >= read]
        return within or [exclusion for exclusion, read in about if facts & read]

    def _read(self, sides: Sequence[Side]) -> set[int]:
        """Return the facts in the conditions of the automata."""
        facts: set[int] = set()
        waiting = [
            self._conditions.of(proposition.formula)
            for side in sides
            for proposition in side.automaton.propositions
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
        texts = [self.fact(number).texts[0 if value else 1] for number, value in sorted(exclusion)]
        if LEVEL in (self._impossible(dict(exclusion)) or ()):
            texts.append(_ON_ONE_LEVEL)
        return tuple(dict.fromkeys(texts))

    def fact(self, number: int) -> Fact:
        """Return a fact by its number."""
        return self._conditions.facts[number]


def _together(runs: Sequence[Runs]) -> list[tuple[Side, ...]]:
    """Return the alternatives of the intersection of some sets of runs."""
    return [tuple(chain.from_iterable(combination)) for combination in product(*runs)]


def joint(answers: Sequence[Answer]) -> Answer:
    """Merge the answers to several questions without a run into one."""
    exclusions = dict.fromkeys(exclusion for answer in answers for exclusion in answer.exclusions)
    opposites = dict.fromkeys(opposite for answer in answers for opposite in answer.opposites)
    equals = dict.fromkeys(equal for answer in answers for equal in answer.equals)
    by_logic = all(answer.by_logic for answer in answers)
    return Answer(None, by_logic, tuple(exclusions), tuple(opposites), tuple(equals))


def _back(
    states: tuple[int, ...], before: dict[tuple[int, ...], tuple[tuple[int, ...] | None, Cube]]
) -> Iterator[Cube]:
    """Yield the cubes of a run from its last sample back to its first."""
    at: tuple[int, ...] | None = states
    while at is not None:
        at, cube = before[at]
        yield cube


# -------------------------------------------------------------------------------------------- looser readings


@dataclass(frozen=True)
class SpecReading:
    """Runs that satisfy a formula and runs that violate it; without an automaton, supersets of these.

    Attributes:
        satisfying, violating: sets of runs; None if not even a looser reading has an automaton.
        reason: reason why a part of the formula has no automaton; "" if all parts have one.
    """

    satisfying: Runs | None
    violating: Runs | None
    reason: str = ""


def reading_of(
    specification: Specification, name: str, formula: Formula, rate_hz: float | None = None
) -> SpecReading:
    """Return the satisfying and violating runs of a formula, with one automaton for each conjunct.

    Operators without an automaton are relaxed: a bounded `F` loses its bound, and a past operator may hold or
    not. A looser reading only adds runs, so a run that it excludes is excluded by the formula, too.

    Args:
        rate_hz: sample rate for bounds in seconds, Hz; without it, such bounds have no automaton.
    """
    reasons: list[str] = []
    satisfying: list[Side] = []
    violating: list[Side | None] = []
    for part in conjuncts(formula):
        try:
            exact_automaton = automaton_of(specification, name, part, rate_hz)
        except NoAutomatonError as error:
            reasons.append(error.reason)
            looser = _loosely(specification, name, part, positive=True)
            satisfying += [] if looser is None else [looser]
            violating.append(_loosely(specification, name, part, positive=False))
        else:
            satisfying.append(Side(exact_automaton))
            violating.append(Side(exact_automaton, False))

    options = tuple((side,) for side in violating if side is not None)
    return SpecReading(
        (tuple(satisfying),) if satisfying else None,
        options if len(options) == len(violating) else None,
        reasons[0] if reasons else "",
    )


def conjuncts(formula: Formula) -> tuple[Formula, ...]:
    """Return formulas whose conjunction is equal to a formula: `G a` and `G b` for `G (a and b)`."""
    match formula:
        case Boolean(operator="and" | "spec"):
            return tuple(part for operand in formula.operands for part in conjuncts(operand))
        case Temporal(operator="G"):
            parts = conjuncts(formula.operands[0])
            return tuple(
                # `G (G a)` is `G a`
                part
                if formula.bound is None and isinstance(part, Temporal) and _is_always(part)
                else replace(formula, operands=(part,))
                for part in parts
            )
    return (formula,)


def _is_always(formula: Temporal) -> bool:
    return formula.operator == "G" and formula.bound is None


def automaton_of(
    specification: Specification, name: str, formula: Formula, rate_hz: float | None = None
) -> Automaton:
    """Return the automaton of a formula with the definitions of a specification.

    Raises:
        NoAutomatonError: the formula has no automaton (see `automaton`).
    """
    alone = replace(specification, specs=(NamedSpec(name, formula),), source="")
    return automaton(alone, name, rate_hz=rate_hz, compiler="own")


def _loosely(specification: Specification, name: str, formula: Formula, *, positive: bool) -> Side | None:
    signed = formula if positive else Boolean("not", (formula,))
    for bounds in ("seconds", "all"):
        looser = loosen(signed, bounds)
        if looser is signed:
            # the unchanged formula has no automaton
            continue
        try:
            return Side(automaton_of(specification, name, looser))
        except NoAutomatonError:
            continue
    return None


def loosen(formula: Formula, bounds: Literal["seconds", "all"] = "seconds", *, loose: bool = True) -> Formula:
    """Return a looser formula, without past operators and bounds; the given formula implies it.

    Args:
        bounds: bounds to drop, those in seconds or all.
        loose: whether the result is looser; if not, it is stricter and implies the given formula.
    """
    if not any(_is_obstacle(part, bounds) for part in iter_formulas(formula)):
        return formula
    formula = expand(formula)
    match formula:
        case Boolean(operator="not"):
            return replace(formula, operands=(loosen(formula.operands[0], bounds, loose=not loose),))
        case Boolean() | Temporal():
            if formula.operator in PAST_OPERATORS:
                return Truth(loose)
            operands = tuple(loosen(operand, bounds, loose=loose) for operand in formula.operands)
            if isinstance(formula, Boolean) or not _is_obstacle(formula, bounds):
                return replace(formula, operands=operands)
            # a window from 0 on contains the current sample; any other window may be empty
            is_now = formula.bound is not None and formula.bound.lower == 0
            if (formula.operator == "G") == loose:
                return operands[-1] if is_now else Truth(loose)
            return replace(formula, operands=operands, bound=None)
    return formula


def _is_obstacle(formula: Formula, bounds: Literal["seconds", "all"]) -> bool:
    if not isinstance(formula, Temporal):
        return False
    bound = formula.bound
    is_bounded = bound is not None and (bounds == "all" or bound.unit == "ns")
    return formula.operator in PAST_OPERATORS or is_bounded
