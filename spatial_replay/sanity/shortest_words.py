"""Shortest runs that automata jointly accept or reject, among the runs that geometry allows.

The product of many automata has too many states for a search. Short runs need no product: a small
diagram over the facts of all samples describes the short runs that an automaton accepts or rejects. A spec
without an automaton has looser readings, which still decide some questions.
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
"""Maximum number of nodes in the diagrams for runs of one length."""

MAX_CONFLICTS_OF_A_LENGTH: Final = 400
"""Maximum number of excluded combinations of facts before the search skips a length."""


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
        """Return a lower bound of the number of samples from a state to the required outcome."""
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
    """Return a run of given length with the required outcome of each side; None if there is no such run.

    The run is given by its requirements on each sample.

    Args:
        facts: diagrams of the conditions.
        diagrams: empty diagrams for the runs, with room for `MAX_NODES` nodes.
        condition_of: function that returns the conditions of an automaton's propositions.
        conflicts: function from the facts of one sample to combinations that geometry excludes.
        avoided: words that the run must not contain; a word of one cube is excluded in every sample.

    Raises:
        NoAutomatonError: the diagrams need too many nodes.
        RecursionError: the runs have too many facts.
        TooManyConflictsError: geometry excludes too many combinations of facts.
    """
    runs = _Runs(length, facts, diagrams)
    agreeing_node = YES
    for side in sides:
        agreeing_node = runs.diagrams.both(
            agreeing_node, runs.agreeing_runs(side, condition_of(side.automaton))
        )
    allowed_node = agreeing_node
    for word in avoided:
        allowed_node = runs.without(allowed_node, word)
    for _ in range(MAX_CONFLICTS_OF_A_LENGTH):
        if allowed_node == NO:
            return None
        # requirements come from the sides alone (`agreeing_node`), not from the exclusions
        word = runs.split(necessary(runs.diagrams, agreeing_node, first_cube(runs.diagrams, allowed_node)))
        new_conflicts = [conflict for cube in word for conflict in conflicts(cube)]
        if not new_conflicts:
            return word
        for conflict in new_conflicts:
            allowed_node = runs.without(allowed_node, [conflict])
    raise TooManyConflictsError


def agreements(
    sides: Sequence[Side],
    word: Sequence[Cube],
    facts: Diagrams,
    diagrams: Diagrams,
    condition_of: Callable[[Automaton], Sequence[int]],
) -> list[tuple[bool, bool]]:
    """Return two flags per side: some run with a word, and every run with the word, has the side's outcome.

    Raises:
        NoAutomatonError: the diagrams need too many nodes.
    """
    runs = _Runs(len(word), facts, diagrams)
    cube = {
        runs.variable(fact, index): value
        for index, sample_cube in enumerate(word)
        for fact, value in sample_cube.items()
    }
    differing_node = clause(diagrams, cube)
    agreeing_nodes = [runs.agreeing_runs(side, condition_of(side.automaton)) for side in sides]
    return [
        (
            diagrams.either(differing_node, node) != differing_node,
            diagrams.either(differing_node, node) == YES,
        )
        for node in agreeing_nodes
    ]


class _Runs:
    """Diagrams over the facts in all samples of a run; the variables of one fact are next to each other."""

    def __init__(self, length: int, facts: Diagrams, diagrams: Diagrams) -> None:
        self.diagrams, self._length, self._facts = diagrams, length, facts
        self._nodes_in_samples: dict[tuple[int, int], int] = {}

    def variable(self, fact: int, index: int) -> int:
        """Return the variable of a fact in a sample."""
        return fact * self._length + index

    def clause(self, word: Sequence[Cube], first_sample: int = 0) -> int:
        """Return the diagram of the runs that differ from a word, which begins at sample `first_sample`."""
        cubes = enumerate(word, first_sample)
        return clause(
            self.diagrams,
            {self.variable(fact, index): value for index, cube in cubes for fact, value in cube.items()},
        )

    def without(self, node: int, word: Sequence[Cube]) -> int:
        """Return the diagram of the runs in `node` that do not contain a word."""
        for first_sample in range(self._length - len(word) + 1):
            node = self.diagrams.both(node, self.clause(word, first_sample))
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

        def decision_node(decision_index: int, index: int) -> int:
            if decision_index < 0:
                return after(~decision_index, index + 1)
            key = decision_index, index
            if key not in nodes:
                proposition, low, high = automaton.decisions[decision_index]
                condition = self._in_sample(conditions[proposition], index)
                nodes[key] = self.diagrams.choose(
                    condition, decision_node(high, index), decision_node(low, index)
                )
            return nodes[key]

        return after(automaton.initial, 0)

    def _in_sample(self, node: int, index: int) -> int:
        """Return the diagram of a condition in one sample of the run."""
        key = node, index
        if key not in self._nodes_in_samples:
            fact, low, high = self._facts[node]
            self._nodes_in_samples[key] = (
                node
                if fact == LEAF
                else self.diagrams.decide(
                    self.variable(fact, index), self._in_sample(low, index), self._in_sample(high, index)
                )
            )
        return self._nodes_in_samples[key]


def first_cube(diagrams: Diagrams, node: int) -> Cube:
    """Return decisions on a path to YES; a fact is true only if its false branch is NO."""
    cube: Cube = {}
    while node != YES:
        variable, low, high = diagrams[node]
        cube[variable] = low == NO
        node = high if low == NO else low
    return cube


def necessary(diagrams: Diagrams, condition: int, cube: Cube) -> Cube:
    """Return an irreducible part of a cube that makes a condition true."""
    for fact in sorted(cube, reverse=True):
        smaller_cube = {number: value for number, value in cube.items() if number != fact}
        if _is_certain(diagrams, condition, smaller_cube):
            cube = smaller_cube
    return cube


def _is_certain(diagrams: Diagrams, node: int, cube: Cube) -> bool:
    """Return whether a cube makes a condition true for all values of the other facts."""
    pending_nodes, visited_nodes = [node], {node}
    while pending_nodes:
        current_node = pending_nodes.pop()
        if current_node == NO:
            return False
        if current_node == YES:
            continue
        variable, low, high = diagrams[current_node]
        value = cube.get(variable)
        for next_node in (low, high) if value is None else (high,) if value else (low,):
            if next_node not in visited_nodes:
                visited_nodes.add(next_node)
                pending_nodes.append(next_node)
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
"""Cost of one check of geometry, steps."""

MAX_CONFLICTS: Final = 2000
"""Maximum number of excluded combinations of facts before a question is undecided."""


MAX_LENGTHS: Final = 4
"""Maximum number of lengths that are tried without a product, from the least possible length on."""

MAX_SHORT: Final = 12
"""Longest run that is searched for without a product, samples."""

_ON_ONE_LEVEL: Final = "no gap in height"
"""Note on an exclusion that does not hold for objects above each other."""

MAX_PAIRS: Final = 200
"""Maximum number of pairs of automata that are tested for excluding each other."""

Runs: TypeAlias = tuple[tuple[Side, ...], ...]
"""Set of runs as alternatives. A run is in the set if it has the outcomes of all sides of one alternative."""


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
        self._state_numbers: dict[tuple[int, ...], int] = {}
        self._state_tuples: list[tuple[int, ...]] = []
        self._exclusions: list[frozenset[tuple[int, bool]]] = []
        self._allowed = YES
        self._conflicts_by_cube: dict[frozenset[tuple[int, bool]], frozenset[int] | None] = {}
        self._terms_by_fact: dict[int, frozenset[object]] = {}
        self._leaves_by_moves: dict[tuple[int, int], set[int]] = {}
        self._steps = self._all_steps = 0

    def shortest(self, *runs: Runs) -> Answer:
        """Return the shortest run in the intersection of sets of runs, or the reason why it is empty.

        Raises:
            UndecidedError: the search takes too many steps.
        """
        self._steps = 0
        alternatives = _together(runs)
        try:
            word = self._short(alternatives)
            if word is not None and any(word):
                return Answer(word)
            answers = [self._refine(sides) for sides in alternatives]
        except (NoAutomatonError, RecursionError) as error:
            raise UndecidedError from error
        answers_with_word = [answer for answer in answers if answer.word is not None]
        return min(answers_with_word, key=lambda answer: len(answer.word or ()), default=joint(answers))

    def is_found(self, *runs: Runs) -> bool:
        """Return whether a short run in the intersection is found; False does not exclude longer runs."""
        return self._short(_together(runs)) is not None

    def another(self, length: int, avoided: Sequence[Word], *runs: Runs) -> Word | None:
        """Return a run of given length in the intersection of the sets `runs`; None if none is found.

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
        least_lengths = [
            max([1, *(side.least_remaining(side.automaton.initial) for side in sides)])
            for sides in options
            if all(side.may_agree(side.automaton.initial) for side in sides)
        ]
        first_length, open_options = min(least_lengths, default=MAX_SHORT), list(options)
        length_count = 1 if self._all_steps > MAX_ALL_STEPS else MAX_LENGTHS
        for length in range(first_length, min(first_length + length_count, MAX_SHORT + 1)):
            empty_word = None
            for sides in tuple(open_options):
                try:
                    word = self._of_length(sides, length)
                except (NoAutomatonError, RecursionError, TooManyConflictsError):
                    # longer runs need even more nodes
                    open_options.remove(sides)
                    continue
                # a run with requirements is preferred to an empty word, which stands for any run
                if word is not None and any(word):
                    return word
                empty_word = empty_word or word
            if empty_word is not None or not open_options:
                return empty_word
        return None

    def _refine(self, sides: Sequence[Side]) -> Answer:
        """Return the answer for all sides from searches with few sides.

        A side that disagrees with the run of the chosen sides is added to the chosen sides.
        """
        side_pairs = combinations(sides, 2) if len(sides) > 2 else ()
        for side_pair in islice(side_pairs, MAX_PAIRS):
            if self._short([side_pair]) is None and (answer := self._decide(side_pair)).word is None:
                return answer
        chosen_sides = list(sides[-1:])
        while True:
            answer = self._decide(chosen_sides)
            disagreeing_side = None if answer.word is None else self._disagreeing(sides, answer.word)
            if disagreeing_side is None:
                return answer
            chosen_sides.append(disagreeing_side)

    def _disagreeing(self, sides: Sequence[Side], word: Word) -> Side | None:
        """Return a side that may disagree with a run, preferably a side that must; None if all agree."""
        diagrams = Diagrams(MAX_NODES)
        agreement_flags = agreements(sides, word, self._diagrams, diagrams, self._conditions_of)
        uncertain_sides = [
            side for side, (_, is_whole) in zip(sides, agreement_flags, strict=True) if not is_whole
        ]
        opposed_sides = [side for side, (is_any, _) in zip(sides, agreement_flags, strict=True) if not is_any]
        return next(iter([*opposed_sides, *uncertain_sides]), None)

    def _decide(self, sides: Sequence[Side]) -> Answer:
        word = self._search(sides, geometry=True)
        if word is not None:
            return Answer(word)
        if self._search(sides, geometry=False) is not None:
            return Answer(
                None, exclusions=tuple(self._texts_of(exclusion) for exclusion in self._about(sides))
            )
        fact_numbers = sorted(self._read(sides))
        facts = [self.fact(number) for number in fact_numbers]
        # opposites of exact comparisons and of negated relations need no explanation
        opposites = [
            fact.texts for fact in facts if fact.side == ">" and not any(map(is_negated, fact.texts))
        ]
        equals = [pair for number in fact_numbers for pair in self._conditions.equal_texts(number)]
        return Answer(None, True, opposites=tuple(opposites), equals=tuple(equals))

    def _conditions_of(self, automaton: Automaton) -> list[int]:
        return [self._conditions.of(proposition.formula) for proposition in automaton.propositions]

    def _conflicts(self, cube: Cube) -> list[Cube]:
        """Return minimal excluded combinations of facts, at most one for each independent part of a cube."""
        return list(filter(None, map(self._conflict, self._parts(cube))))

    def _search(self, sides: Sequence[Side], *, geometry: bool) -> Word | None:
        """Return the shortest run by A*; the automata give the lower bound of the remaining samples."""
        predecessors: dict[tuple[int, ...], tuple[tuple[int, ...] | None, Cube]] = {}
        # the counter breaks ties, so that heapq never compares the later entries
        tie_breaker = count()
        # geometry is checked when a move leaves the queue, because most moves never leave it
        queue: list[tuple[tuple[int, tuple[int, ...], int], int, int, int, tuple[int, ...] | None]] = []

        def put_in(
            moves: int, leaves: Sequence[int], length: int, previous_states: tuple[int, ...] | None
        ) -> None:
            for leaf in leaves:
                next_states = self._state_tuples[leaf]
                if next_states not in predecessors and all(map(Side.may_agree, sides, next_states)):
                    # among equal bounds, moves near the end of the last side come first, then long runs
                    remaining_samples = tuple(map(Side.least_remaining, sides, next_states))
                    priority = length + max(remaining_samples), remaining_samples[::-1], -length
                    heappush(queue, (priority, next(tie_breaker), moves, leaf, previous_states))

        put_in(*self._join(sides, tuple(side.automaton.initial for side in sides)), 1, None)
        while queue:
            (_, _, length), _, moves, leaf, previous_states = heappop(queue)
            next_states = self._state_tuples[leaf]
            is_closed = geometry and self._allowed != YES and leaf not in self._open_leaves(moves)
            if next_states in predecessors or is_closed:
                continue
            cube = self._cube(self._leading(moves, leaf)) if geometry else {}
            if cube is None:
                continue
            predecessors[next_states] = previous_states, cube
            if all(map(Side.agrees, sides, next_states)):
                return tuple(reversed(list(_back(next_states, predecessors))))
            put_in(*self._join(sides, next_states), 1 - length, next_states)
        return None

    def _spend(self, steps: int) -> None:
        self._steps += steps
        self._all_steps += steps
        if self._steps > MAX_STEPS or self._all_steps > MAX_ALL_STEPS:
            raise UndecidedError

    def _join(self, sides: Sequence[Side], states: Sequence[int]) -> tuple[int, list[int]]:
        """Return the moves of all sides in one sample as a diagram over facts, and the leaves of the diagram.

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

        root = join(tuple(nodes))
        self._spend(len(joined_nodes))
        decisions = [self._diagrams[node] for node in joined_nodes.values()]
        return root, list(dict.fromkeys(decision.low for decision in decisions if decision.variable == LEAF))

    def _open_leaves(self, moves: int) -> set[int]:
        """Return the leaves of a diagram that can be reached without a known exclusion."""
        key = moves, self._allowed
        if key not in self._leaves_by_moves:
            leaves, pending_pairs, visited_pairs = set(), [key], {key}
            while pending_pairs:
                node, allowed_node = pending_pairs.pop()
                variable = min(self._diagrams[node].variable, self._diagrams[allowed_node].variable)
                if allowed_node != NO and self._diagrams[node].variable == LEAF:
                    leaves.add(self._diagrams[node].low)
                elif allowed_node != NO:
                    branches = [
                        self._diagrams.branches(diagram, variable) for diagram in (node, allowed_node)
                    ]
                    new_pairs = set(zip(*branches, strict=True)) - visited_pairs
                    visited_pairs |= new_pairs
                    pending_pairs += new_pairs
            self._spend(len(visited_pairs))
            self._leaves_by_moves[key] = leaves
        return self._leaves_by_moves[key]

    def _number(self, states: tuple[int, ...]) -> int:
        if states not in self._state_numbers:
            self._state_numbers[states] = len(self._state_tuples)
            self._state_tuples.append(states)
        return self._state_numbers[states]

    def _compose(self, automaton: Automaton, state: int) -> int:
        """Return the moves from a state as a diagram over facts, with states as leaves."""
        # the automaton is stored, because the id of a deleted automaton can be reused
        self._automata[id(automaton)] = automaton
        conditions = self._conditions_of(automaton)

        def node(decision_index: int) -> int:
            if decision_index < 0:
                return self._diagrams.leaf(~decision_index)
            key = (id(automaton), decision_index)
            if key not in self._moves:
                proposition, low, high = automaton.decisions[decision_index]
                self._moves[key] = self._diagrams.choose(conditions[proposition], node(high), node(low))
            return self._moves[key]

        return node(automaton.entries[state])

    def _leading(self, node: int, leaf: int) -> int:
        """Return the condition under which a diagram leads to a leaf."""
        nodes: dict[int, int] = {}

        def to(inner_node: int) -> int:
            if inner_node not in nodes:
                variable, low, high = self._diagrams[inner_node]
                if variable == LEAF:
                    nodes[inner_node] = YES if low == leaf else NO
                else:
                    nodes[inner_node] = self._diagrams.decide(variable, to(low), to(high))
            return nodes[inner_node]

        condition = to(node)
        self._spend(len(nodes))
        return condition

    def _cube(self, condition: int) -> Cube | None:
        """Return a cube that makes a condition true and that geometry allows; None if there is none."""
        for _ in range(MAX_CONFLICTS):
            self._spend(_STEPS_OF_GEOMETRY)
            open_condition = self._diagrams.both(condition, self._allowed)
            if open_condition == NO:
                return None
            cube = necessary(self._diagrams, condition, first_cube(self._diagrams, open_condition))
            conflicts = self._conflicts(cube)
            if not conflicts:
                return cube
            for conflict in conflicts:
                self._exclusions.append(frozenset(conflict.items()))
                self._allowed = self._diagrams.both(self._allowed, clause(self._diagrams, conflict))
        raise UndecidedError

    def _conflict(self, cube: Cube) -> Cube | None:
        """Return a minimal combination of facts in a cube that geometry excludes; None if there is none."""
        conflict_numbers = self._impossible(cube)
        if conflict_numbers is None:
            return None
        core = {number: cube[number] for number in sorted(conflict_numbers - {LEVEL})}
        for number in tuple(core):
            smaller_core = {fact: value for fact, value in core.items() if fact != number}
            if smaller_core and self._impossible(smaller_core) is not None:
                core = smaller_core
        return core

    def _impossible(self, cube: Cube) -> frozenset[int] | None:
        """Return facts of a cube that exclude each other by geometry; None if geometry allows the cube."""
        cube_key = frozenset(cube.items())
        if cube_key not in self._conflicts_by_cube:
            self._conflicts_by_cube[cube_key] = self._ask_geometry(cube)
        return self._conflicts_by_cube[cube_key]

    def _parts(self, cube: Cube) -> list[Cube]:
        """Split a cube into parts without common terms or signals, so that no law connects two parts."""
        parts_with_terms: list[tuple[frozenset[object], Cube]] = []
        for number, value in cube.items():
            part_terms, part = self._about_of(number), {number: value}
            unrelated_parts = []
            for other_terms, other_cube in parts_with_terms:
                if other_terms.isdisjoint(part_terms):
                    unrelated_parts.append((other_terms, other_cube))
                else:
                    part_terms, part = other_terms | part_terms, {**other_cube, **part}
            parts_with_terms = [*unrelated_parts, (part_terms, part)]
        return [part for _, part in parts_with_terms]

    def _about_of(self, number: int) -> frozenset[object]:
        """Return the terms and signals of a fact."""
        if number not in self._terms_by_fact:
            quantities = [quantity for quantity, _ in self._conditions.facts[number].weights]
            signals = [quantity for quantity in quantities if isinstance(quantity, Signal)]
            self._terms_by_fact[number] = frozenset([*signals, *terms_in(quantities)])
        return self._terms_by_fact[number]

    def _ask_geometry(self, cube: Cube) -> frozenset[int] | None:
        facts = self._conditions.facts
        inequalities = [
            facts[number].inequality(value, number) for number, value in cube.items() if facts[number].weights
        ]
        inside_protrusions = {
            quantity
            for inequality in inequalities
            if len(inequality.coefficients) == 1 and inequality.bound <= 0
            for quantity, weight in inequality.coefficients
            if isinstance(quantity, Protrusion) and weight > 0
        }
        weights = [facts[number].weights for number in cube]
        quantities = dict.fromkeys(quantity for fact_weights in weights for quantity, _ in fact_weights)
        measurements = [quantity for quantity in quantities if not isinstance(quantity, Signal)]
        conditions = self._conditions
        geometry_laws = laws(
            measurements, inside_protrusions, conditions.regions, conditions.between, conditions.diameters
        )
        return solve(inequalities, geometry_laws).conflict

    def _about(self, sides: Sequence[Side]) -> list[frozenset[tuple[int, bool]]]:
        """Return the exclusions whose facts all occur in the automata.

        If there are none, return the exclusions with at least one fact of the automata.
        """
        facts = self._read(sides)
        exclusions_with_facts = [
            (exclusion, {fact for fact, _ in exclusion}) for exclusion in self._exclusions
        ]
        inner_exclusions = [
            exclusion for exclusion, exclusion_facts in exclusions_with_facts if facts >= exclusion_facts
        ]
        return inner_exclusions or [
            exclusion for exclusion, exclusion_facts in exclusions_with_facts if facts & exclusion_facts
        ]

    def _read(self, sides: Sequence[Side]) -> set[int]:
        """Return the facts in the conditions of the automata."""
        facts: set[int] = set()
        pending_nodes = [
            self._conditions.of(proposition.formula)
            for side in sides
            for proposition in side.automaton.propositions
        ]
        visited_nodes = set(pending_nodes)
        while pending_nodes:
            variable, low, high = self._diagrams[pending_nodes.pop()]
            if variable != LEAF:
                facts.add(variable)
                pending_nodes += {low, high} - visited_nodes
                visited_nodes |= {low, high}
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
    """Merge several answers without a run into one answer."""
    exclusions = dict.fromkeys(exclusion for answer in answers for exclusion in answer.exclusions)
    opposites = dict.fromkeys(opposite for answer in answers for opposite in answer.opposites)
    equals = dict.fromkeys(equal for answer in answers for equal in answer.equals)
    by_logic = all(answer.by_logic for answer in answers)
    return Answer(None, by_logic, tuple(exclusions), tuple(opposites), tuple(equals))


def _back(
    states: tuple[int, ...], predecessors: dict[tuple[int, ...], tuple[tuple[int, ...] | None, Cube]]
) -> Iterator[Cube]:
    """Yield the cubes of a run from its last sample back to its first."""
    current_states: tuple[int, ...] | None = states
    while current_states is not None:
        current_states, cube = predecessors[current_states]
        yield cube


# -------------------------------------------------------------------------------------------- looser readings


@dataclass(frozen=True)
class SpecReading:
    """Runs that satisfy a formula and runs that violate it; without an automaton, supersets of these runs.

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
        rate_hz: sample rate for bounds in seconds, Hz; without a rate, these bounds have no automaton.
    """
    reasons: list[str] = []
    satisfying: list[Side] = []
    violating: list[Side | None] = []
    for conjunct in conjuncts(formula):
        try:
            exact_automaton = automaton_of(specification, name, conjunct, rate_hz)
        except NoAutomatonError as error:
            reasons.append(error.reason)
            loose_side = _loosely(specification, name, conjunct, positive=True)
            satisfying += [] if loose_side is None else [loose_side]
            violating.append(_loosely(specification, name, conjunct, positive=False))
        else:
            satisfying.append(Side(exact_automaton))
            violating.append(Side(exact_automaton, False))

    violating_options = tuple((side,) for side in violating if side is not None)
    return SpecReading(
        (tuple(satisfying),) if satisfying else None,
        violating_options if len(violating_options) == len(violating) else None,
        reasons[0] if reasons else "",
    )


def conjuncts(formula: Formula) -> tuple[Formula, ...]:
    """Return formulas whose conjunction is equal to a formula: `G a` and `G b` for `G (a and b)`."""
    match formula:
        case Boolean(operator="and" | "spec"):
            return tuple(conjunct for operand in formula.operands for conjunct in conjuncts(operand))
        case Temporal(operator="G"):
            operand_conjuncts = conjuncts(formula.operands[0])
            return tuple(
                # `G (G a)` is `G a`
                conjunct
                if formula.bound is None and isinstance(conjunct, Temporal) and _is_always(conjunct)
                else replace(formula, operands=(conjunct,))
                for conjunct in operand_conjuncts
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
    single_specification = replace(specification, specs=(NamedSpec(name, formula),), source="")
    return automaton(single_specification, name, rate_hz=rate_hz, compiler="own")


def _loosely(specification: Specification, name: str, formula: Formula, *, positive: bool) -> Side | None:
    signed_formula = formula if positive else Boolean("not", (formula,))
    for bounds in ("seconds", "all"):
        loose_formula = loosen(signed_formula, bounds)
        if loose_formula is signed_formula:
            # the unchanged formula has no automaton
            continue
        try:
            return Side(automaton_of(specification, name, loose_formula))
        except NoAutomatonError:
            continue
    return None


def loosen(formula: Formula, bounds: Literal["seconds", "all"] = "seconds", *, loose: bool = True) -> Formula:
    """Return a looser formula, without past operators and bounds; the given formula implies it.

    Args:
        bounds: bounds to drop: bounds in seconds, or all bounds.
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
