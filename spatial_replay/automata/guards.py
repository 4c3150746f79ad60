"""Guards of automata: decision diagrams over propositions, and their cubes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple, TypeAlias

from spatial_replay.errors import NoAutomatonError
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Expression,
    Formula,
    Negative,
    Quantified,
    Sum,
    Temporal,
    Truth,
    expand,
    judged_operator,
    operands_of,
    operator_of,
)
from spatial_replay.spec.walks import is_spatial, without_variables

LEAF = 1 << 60
"""Variable of leaves, which sorts after all other variables."""


class Decision(NamedTuple):
    """A node of a decision diagram; `low` and `high` of a leaf are the leaf's number.

    Attributes:
        low, high: nodes for a false and for a true variable.
    """

    variable: int
    low: int
    high: int


NO, YES = 0, 1
"""Nodes of the Boolean constants, which are leaves 0 and 1."""


class Diagrams:
    """Reduced ordered binary decision diagrams with shared nodes (Bryant, 1986)."""

    def __init__(self, limit: int = LEAF) -> None:
        """Add the nodes of the constants.

        Args:
            limit: maximum number of nodes; a further node raises NoAutomatonError.
        """
        self._nodes: list[Decision] = []
        self._numbers: dict[Decision, int] = {}
        self._choices: dict[tuple[int, int, int], int] = {}
        self._limit = limit
        # the constants come first, so that their nodes are `NO` and `YES`
        self.leaf(0), self.leaf(1)

    def __len__(self) -> int:
        return len(self._nodes)

    def __getitem__(self, node: int) -> Decision:
        return self._nodes[node]

    def leaf(self, number: int) -> int:
        """Return the node of a leaf."""
        return self._add(Decision(LEAF, number, number))

    def decide(self, variable: int, low: int, high: int) -> int:
        """Return the node that decides on a variable; `low` and `high` may only decide on later variables."""
        return low if low == high else self._add(Decision(variable, low, high))

    def variable(self, variable: int) -> int:
        """Return the node of a variable's own function: true iff the variable is true."""
        return self._add(Decision(variable, NO, YES))

    def choose(self, condition: int, then: int, otherwise: int) -> int:
        """Return the function "if `condition` then `then` else `otherwise`"."""
        if condition == YES or then == otherwise:
            return then
        if condition == NO:
            return otherwise
        if then == YES and otherwise == NO:
            return condition
        operands = (condition, then, otherwise)
        result = self._choices.get(operands)
        if result is None:
            nodes = self._nodes
            variable = min(nodes[condition].variable, nodes[then].variable, nodes[otherwise].variable)
            lows, highs = zip(*(self.branches(node, variable) for node in operands), strict=True)
            result = self._choices[operands] = self.decide(variable, self.choose(*lows), self.choose(*highs))
        return result

    def both(self, first: int, second: int) -> int:
        """Return the conjunction."""
        return self.choose(first, second, NO)

    def either(self, first: int, second: int) -> int:
        """Return the disjunction."""
        return self.choose(first, YES, second)

    def complement(self, node: int) -> int:
        """Return the negation."""
        return self.choose(node, NO, YES)

    def branches(self, node: int, variable: int) -> tuple[int, int]:
        """Return two cofactors of a function: with the variable false, and with the variable true.

        The function may not depend on earlier variables.
        """
        decision = self._nodes[node]
        return decision[1:] if decision.variable == variable else (node, node)

    def _add(self, decision: Decision) -> int:
        number = self._numbers.get(decision)
        if number is None:
            if len(self._nodes) >= self._limit:
                raise NoAutomatonError(f"the automaton takes more than {self._limit} decisions")
            number = self._numbers[decision] = len(self._nodes)
            self._nodes.append(decision)
        return number


def node_copier(
    source: Diagrams, target: Diagrams, variables: int, leaf: Callable[[int], int]
) -> Callable[[int], int]:
    """Return a function that copies nodes from `source` into `target`, with other leaves.

    Args:
        variables: number of variables to copy; a node that decides on a later variable becomes a leaf.
        leaf: returns the number of the target's leaf for a source node that becomes a leaf.
    """
    copies: dict[int, int] = {}

    def copy(node: int) -> int:
        if node not in copies:
            variable, if_false, if_true = source[node]
            if variable < variables:
                copies[node] = target.decide(variable, copy(if_false), copy(if_true))
            else:
                copies[node] = target.leaf(leaf(node))
        return copies[node]

    return copy


@dataclass(frozen=True)
class Proposition:
    """A subformula without temporal operators; true in a sample iff its robustness is at least 0.

    Attributes:
        text: canonical text of the formula.
        name: name of the formula in the specification, or None.
    """

    formula: Formula
    text: str
    name: str | None = None

    @property
    def label(self) -> str:
        """The proposition's name; its text if it has no name."""
        return self.name or self.text

    def literal(self, value: bool) -> str:
        """Return the proposition as a sentence; its negation if `value` is False."""
        if self.name is not None:
            return self.name if value else f"not {self.name}"
        if isinstance(self.formula, Boolean) and self.formula.operator == "not":
            # the negation of `not a` is written as `a`
            return self.text if value else _bracket(self.formula.operands[0])
        return _bracket(self.formula) if value else f"not ({self.text})"


def _bracket(formula: Formula) -> str:
    text, innermost = format_formula(formula), formula
    if operator_of(formula) in ("given", "with"):
        innermost = operands_of(formula)[-1]
    return f"({text})" if isinstance(innermost, (Boolean, Quantified)) else text


class Propositions:
    """The propositions of a formula, numbered in the order of the text.

    Equivalent subformulas are one proposition: `a and b` and `b and a`, `a leftof b` and
    `not (a rightof b)`. A subformula and its negation are also one proposition. The first one in the text is
    the proposition; the second one is its negated literal.
    """

    def __init__(self, formula: Formula) -> None:
        self._shapes = Shapes()
        self._numbers: dict[int, int] = {}
        self._literals: dict[int, tuple[int, bool]] = {}
        self.all: list[Proposition] = []
        for proposition in _maximal(formula):
            self._add(proposition)

    def literal(self, formula: Formula) -> tuple[int, bool] | None:
        """Return the proposition of a maximal spatial subformula: its number, and False if it is negated.

        The result is None for all other formulas, including the formulas inside expansions.
        """
        return self._literals.get(id(formula))

    def _add(self, formula: Formula) -> None:
        shape = self._shapes.of(formula)
        if shape in (YES, NO):
            # its text identifies the formula: it is no constant where a relation and its opposite are both 0
            shape = self._shapes.of_text(formula)
        negated_shape = self._shapes.negate(shape)
        if negated_shape in self._numbers:
            self._literals[id(formula)] = self._numbers[negated_shape], False
            return
        if shape not in self._numbers:
            self._numbers[shape] = len(self.all)
            self.all.append(Proposition(formula, self._text(formula), formula.name))
        self._literals[id(formula)] = self._numbers[shape], True

    def _text(self, formula: Formula) -> str:
        """Return the text of a proposition.

        If another proposition has the same text, the result also says whether the formula holds without a
        rate.
        """
        text = format_formula(formula)
        if all(proposition.text != text for proposition in self.all):
            return text
        suffixes = {"given": " or there is no rate", "with": " and there is a rate"}
        return f"({text}){suffixes.get(operator_of(formula), '')}"


def _maximal(formula: Formula) -> Iterator[Formula]:
    """Yield the largest subformulas without temporal operators, in the order of the text; skip constants."""
    if isinstance(formula, Truth):
        return
    if is_spatial(formula):
        yield formula
        return
    for operand in operands_of(judged_operator(formula) if isinstance(formula, Temporal) else formula):
        yield from _maximal(operand)


class Shapes:
    """Spatial formulas as decision diagrams over their relations; equivalent formulas share a node."""

    def __init__(self) -> None:
        self._diagrams = Diagrams(MAX_SHAPES)
        self._variables: dict[object, int] = {}
        self._nodes: dict[int, tuple[Formula, int]] = {}

    def of(self, formula: Formula) -> int:
        """Return the node of a formula without temporal operators."""
        if id(formula) not in self._nodes:
            try:
                node = self._of(expand(formula))
            except (NoAutomatonError, RecursionError):
                # a formula that is too large for a comparison by meaning is compared by its text
                node = self.of_text(formula)
            # the stored formula stays in memory, so no other formula gets its id
            self._nodes[id(formula)] = formula, node
        return self._nodes[id(formula)][1]

    def of_text(self, formula: Formula) -> int:
        """Return a node that only formulas of the same text share."""
        return self._variable(format_formula(formula))

    def negate(self, node: int) -> int:
        """Return the node of the negation."""
        try:
            return self._diagrams.complement(node)
        except (NoAutomatonError, RecursionError):
            return self._variable(("not", node))

    def _of(self, formula: Formula) -> int:
        match formula:
            case Truth():
                return YES if formula.value else NO
            case Atom():
                expression, is_positive = _split_sign(formula)
                variable = self._variable(expression)
                return variable if is_positive else self._diagrams.complement(variable)
            case Boolean(operator="not"):
                return self._diagrams.complement(self.of(formula.operands[0]))
            case Boolean():
                join = self._diagrams.both if formula.operator == "and" else self._diagrams.either
                nodes = [self.of(operand) for operand in formula.operands]
                # from the last operand on: its variables are the deepest, so each join adds nodes on top
                return reduce(lambda below, operand: join(operand, below), reversed(nodes))
            case Quantified():
                # `exists x: a` is stored as `not forall x: not a`
                body, is_universal = self.of(without_variables(formula)), formula.quantifier == "forall"
                signature = len(formula.variables), formula.group, body if is_universal else self.negate(body)
                universal = self._variable(signature)
                return universal if is_universal else self.negate(universal)
            case Temporal():
                raise ValueError(f"{formula.operator} is not an operator about one sample")

    def _variable(self, key: object) -> int:
        return self._diagrams.variable(self._variables.setdefault(key, len(self._variables)))


MAX_SHAPES = 200_000
"""Maximum number of nodes in the diagrams that compare propositions."""


def _split_sign(atom: Atom) -> tuple[Expression, bool]:
    """Return a relation's normalized expression, and False if the relation is that expression's negation.

    Comparisons of signals are not normalized: signals are often equal to their limits, and at the limit a
    comparison and its negation both hold.
    """
    expression, is_positive = atom.expression, True
    while atom.relation not in ("signal", "sum"):
        match expression:
            case Negative(operand=operand):
                expression = operand
            # `a - b` becomes `b - a` if `b` sorts before `a`
            case Sum(first=minuend, second=Negative(operand=operand)) if repr(operand) < repr(minuend):
                expression = Sum(operand, Negative(minuend))
            case _:
                break
        is_positive = not is_positive
    return expression, is_positive


Literal: TypeAlias = tuple[int, bool]
"""Number of a proposition, and whether it must be true."""

Cube: TypeAlias = tuple[Literal, ...]
"""Conjunction of literals, sorted by proposition; the empty cube is true."""

Guard: TypeAlias = tuple[Cube, ...]
"""Disjunction of cubes."""


MAX_CUBES = 100_000
"""Maximum number of cubes of a guard."""

FEW_CUBES = 1_000
"""Number of listed cubes of a guard that has more than `MAX_CUBES` cubes."""


class Covers:
    """Functions as irredundant disjunctions of cubes: no cube and no literal can be omitted.

    The algorithm is by Minato and Morreale (1992). Equal functions have equal cubes.
    """

    def __init__(self, diagrams: Diagrams) -> None:
        self._diagrams = diagrams
        self._covers: dict[tuple[int, int], _Cover] = {}

    def guard(self, node: int) -> Guard:
        """Return the cubes of a function.

        Raises:
            NoAutomatonError: the function takes more than `MAX_CUBES` cubes.
        """
        cover = self._between(node, node)
        # the size is known before the cubes are written out
        if cover.size > MAX_CUBES:
            raise NoAutomatonError(f"a guard takes more than {MAX_CUBES} cubes")
        return tuple(sorted(_cubes_of(cover)))

    def some(self, node: int) -> Guard:
        """Return up to `FEW_CUBES` disjoint cubes of a function."""
        cubes: list[Cube] = []
        stack: list[tuple[int, Cube]] = [(node, ())]
        while stack and len(cubes) < FEW_CUBES:
            current_node, cube = stack.pop()
            variable, if_false, if_true = self._diagrams[current_node]
            if current_node == YES:
                cubes.append(cube)
            elif current_node != NO:
                stack += ((if_true, (*cube, (variable, True))), (if_false, (*cube, (variable, False))))
        return tuple(cubes)

    def _between(self, lower: int, upper: int) -> _Cover:
        """Return cubes whose disjunction is implied by `lower` and implies `upper`."""
        if lower == NO:
            return _Cover(0, NO)
        if upper == YES:
            return _Cover(1, YES)
        bounds = (lower, upper)
        if bounds not in self._covers:
            self._covers[bounds] = self._split(lower, upper)
        return self._covers[bounds]

    def _split(self, lower: int, upper: int) -> _Cover:
        diagrams = self._diagrams
        variable = min(diagrams[lower].variable, diagrams[upper].variable)
        lower_false, lower_true = diagrams.branches(lower, variable)
        upper_false, upper_true = diagrams.branches(upper, variable)
        false_cover = self._between(diagrams.both(lower_false, diagrams.complement(upper_true)), upper_false)
        true_cover = self._between(diagrams.both(lower_true, diagrams.complement(upper_false)), upper_true)
        # cubes without this variable cover the rest of `lower`
        uncovered_false = diagrams.both(lower_false, diagrams.complement(false_cover.union))
        uncovered_true = diagrams.both(lower_true, diagrams.complement(true_cover.union))
        free_cover = self._between(
            diagrams.either(uncovered_false, uncovered_true), diagrams.both(upper_false, upper_true)
        )
        covered_decision = diagrams.decide(variable, false_cover.union, true_cover.union)
        size = false_cover.size + true_cover.size + free_cover.size
        return _Cover(
            size,
            diagrams.either(covered_decision, free_cover.union),
            (variable, false_cover, true_cover, free_cover),
        )


class _Cover(NamedTuple):
    """A set of cubes in a recursive form, which is smaller than the list of cubes.

    Attributes:
        size: number of cubes.
        union: disjunction of the cubes.
        split: a variable, the cubes with the variable false, the cubes with it true, and all other cubes.
            These cubes omit the variable's literal. None without cubes, and if the only cube is empty.
    """

    size: int
    union: int
    split: tuple[int, _Cover, _Cover, _Cover] | None = None


def _cubes_of(cover: _Cover) -> Iterator[Cube]:
    stack: list[tuple[_Cover, Cube]] = [(cover, ())]
    while stack:
        (size, _, split), cube = stack.pop()
        if split is not None:
            variable, false_cover, true_cover, free_cover = split
            stack += (
                (false_cover, (*cube, (variable, False))),
                (true_cover, (*cube, (variable, True))),
                (free_cover, cube),
            )
        elif size:
            yield cube


@dataclass(frozen=True)
class Transition:
    """A move from one state to another.

    Attributes:
        guard: disjunction of cubes, which are conjunctions of literals (number of a proposition, whether it
            must be true). No cube and no literal can be omitted.
        is_cut: whether the guard takes more than `MAX_CUBES` cubes. A cut guard has only some of the cubes,
            which are disjoint.
    """

    source: int
    guard: Guard
    target: int
    is_cut: bool = False


def guard_words(move: Transition, propositions: Sequence[Proposition], longest: int | None = None) -> str:
    """Return a guard as a sentence of the specification language; a cut guard ends in "…".

    Args:
        longest: maximum number of characters; None for no limit.
    """
    if move.guard == ((),):
        return "true"
    cube_texts: list[str] = []
    total_length = 0
    for cube in move.guard:
        text = " and ".join(propositions[number].literal(value) for number, value in cube)
        cube_texts.append(text if len(move.guard) == 1 or len(cube) == 1 else f"({text})")
        total_length += len(cube_texts[-1])
        # the text is cut below, so further cubes would not appear
        if longest is not None and total_length > longest:
            break
    words = " or ".join([*cube_texts, "…"] if move.is_cut else cube_texts)
    return words if longest is None or len(words) <= longest else f"{words[: longest - 1].rstrip()}…"


class Moves:
    """The moves of an automaton as decision diagrams, with a cache of successors and transitions."""

    def __init__(self, entries: Sequence[int], decisions: Sequence[tuple[int, int, int]]) -> None:
        """Convert `entries` and `decisions` of an automaton."""
        self._diagrams = Diagrams()
        self._covers = Covers(self._diagrams)
        decision_nodes: list[int] = []

        def node(place: int) -> int:
            return self._diagrams.leaf(~place) if place < 0 else decision_nodes[place]

        for proposition, if_false, if_true in decisions:
            decision_nodes.append(self._diagrams.decide(proposition, node(if_false), node(if_true)))
        self._nodes = tuple(node(place) for place in entries)
        self._successors: dict[int, tuple[int, ...]] = {}
        self._conditions: dict[int, dict[int, int]] = {}
        self._transitions: dict[tuple[int, int], Transition] = {}

    def __len__(self) -> int:
        return len(self._nodes)

    def successors(self, source: int) -> tuple[int, ...]:
        """Return the states that one sample can lead to from a state, in ascending order."""
        node = self._nodes[source]
        if node not in self._successors:
            self._successors[node] = tuple(sorted(self._leaves(node)))
        return self._successors[node]

    def transition(self, source: int, target: int) -> Transition:
        """Return the transition from a state to one of its successors."""
        ends = (source, target)
        if ends not in self._transitions:
            condition = self._to(target, self._nodes[source], self._conditions.setdefault(target, {}))
            try:
                move = Transition(source, self._covers.guard(condition), target)
            except NoAutomatonError:
                move = Transition(source, self._covers.some(condition), target, is_cut=True)
            self._transitions[ends] = move
        return self._transitions[ends]

    def _leaves(self, node: int) -> set[int]:
        visited_nodes = {node}
        states = set()
        stack = [node]
        while stack:
            variable, if_false, if_true = self._diagrams[stack.pop()]
            if variable == LEAF:
                states.add(if_false)
                continue
            for branch in (if_false, if_true):
                if branch not in visited_nodes:
                    visited_nodes.add(branch)
                    stack.append(branch)
        return states

    def _to(self, target: int, node: int, conditions: dict[int, int]) -> int:
        """Return the condition under which a node leads to a state."""
        if node not in conditions:
            variable, if_false, if_true = self._diagrams[node]
            if variable == LEAF:
                conditions[node] = YES if if_false == target else NO
            else:
                branches = self._to(target, if_false, conditions), self._to(target, if_true, conditions)
                conditions[node] = self._diagrams.decide(variable, *branches)
        return conditions[node]


class Successors(Sequence[tuple[int, ...]]):
    """The successors of each state, computed on demand."""

    def __init__(self, moves: Moves) -> None:
        self._moves = moves

    def __len__(self) -> int:
        return len(self._moves)

    def __getitem__(self, state: Any) -> Any:
        if isinstance(state, slice):
            return tuple(self[number] for number in range(len(self))[state])
        if not -len(self) <= state < len(self):
            raise IndexError(f"no state {state}; there are 0 to {len(self) - 1}")
        return self._moves.successors(state % len(self))
