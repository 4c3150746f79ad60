"""The propositions that an automaton reads: the subformulas without temporal operators."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Formula,
    Quantified,
    Temporal,
    Truth,
    expand,
    operands_of,
)
from spatial_replay.spec.walks import is_spatial


@dataclass(frozen=True)
class Proposition:
    """A subformula without temporal operators; true in a sample iff its robustness there is at least 0.

    Attributes:
        text: its canonical text.
        name: the name that the specification gives to it, or None.
    """

    formula: Formula
    text: str
    name: str | None = None

    @property
    def label(self) -> str:
        """Its name or, without one, its text."""
        return self.name or self.text

    def literal(self, value: bool) -> str:
        """Return the sentence that it is true, or that it is not."""
        if self.name is not None:
            return self.name if value else f"not {self.name}"
        if isinstance(self.formula, Boolean) and self.formula.operator == "not":
            # the opposite of a negation is what it negates
            return self.text if value else _bracketed(self.formula.operands[0])
        return _bracketed(self.formula) if value else f"not ({self.text})"


def _bracketed(formula: Formula) -> str:
    text = format_formula(formula)
    return f"({text})" if isinstance(formula, (Boolean, Quantified)) else text


class Propositions:
    """The propositions of a formula, numbered in the order of the text.

    Equal ones, however they are written (`a and b`, `b and a`; `a -> b`, `not a or b`), are one. So are a
    proposition and its negation where a formula holds both: the second is the first, negated.
    """

    def __init__(self, formula: Formula) -> None:
        self._shapes = _Shapes()
        self._numbers: dict[int, int] = {}
        self._literals: dict[int, tuple[int, bool]] = {}
        self.all: list[Proposition] = []
        for each in _maximal(formula):
            self._add(each)

    def literal(self, formula: Formula) -> tuple[int, bool] | None:
        """Return a maximal spatial subformula's proposition and whether it is that or its negation.

        None for all other formulas, those that expansions are made of included.
        """
        return self._literals.get(id(formula))

    def _add(self, formula: Formula) -> None:
        number = self._numbers.get(self._shapes.of(formula, True))
        if number is not None:
            self._literals[id(formula)] = number, True
            return
        negated = self._shapes.of(formula, False)
        if negated in self._numbers:
            self._literals[id(formula)] = self._numbers[negated], False
            return
        number = self._numbers[self._shapes.of(formula, True)] = len(self.all)
        self._literals[id(formula)] = number, True
        self.all.append(Proposition(formula, format_formula(formula), formula.name))


def _maximal(formula: Formula) -> Iterator[Formula]:
    """Yield the largest subformulas about one sample, in the order of the text; constants are none."""
    if isinstance(formula, Truth):
        return
    if is_spatial(formula):
        yield formula
        return
    for operand in operands_of(formula):
        yield from _maximal(operand)


class _Shapes:
    """Numbers of spatial formulas: one for all that are equal up to the way they are written."""

    def __init__(self) -> None:
        self._interned: dict[tuple[object, ...], int] = {}
        self._known: dict[tuple[int, bool], int] = {}
        self._joined: dict[tuple[bool, int], frozenset[int]] = {}

    def of(self, formula: Formula, positive: bool) -> int:
        """Return the number of a formula, or of its negation, in negation normal form."""
        formula = expand(formula)
        key = (id(formula), positive)
        if key not in self._known:
            self._known[key] = self._shape(formula, positive)
        return self._known[key]

    def _shape(self, formula: Formula, positive: bool) -> int:
        match formula:
            case Truth():
                return self._intern("truth", formula.value == positive)
            case Atom():
                return self._intern("atom", formula.expression, positive)
            case Boolean(operator="not"):
                return self.of(formula.operands[0], not positive)
            case Boolean():
                is_both = (formula.operator == "and") == positive
                return self._join(is_both, *(self.of(each, positive) for each in formula.operands))
            case Quantified():
                body = self.of(formula.body, positive)
                is_every = (formula.quantifier == "forall") == positive
                return self._intern("members", is_every, formula.variables, formula.group, body)
            case Temporal():
                raise ValueError(f"{formula.operator} is not an operator about one sample")

    def _join(self, is_both: bool, *operands: int) -> int:
        """Return the number of a conjunction or disjunction; order, repetition and brackets do not count."""
        parts = (self._joined.get((is_both, each), frozenset({each})) for each in operands)
        chosen = frozenset[int]().union(*parts)
        if len(chosen) == 1:
            return next(iter(chosen))
        number = self._intern(is_both, chosen)
        self._joined[is_both, number] = chosen
        return number

    def _intern(self, *key: object) -> int:
        return self._interned.setdefault(key, len(self._interned))
