"""The number in an atom that decides, and what turning it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from spatial_replay.monitor.witness.atom import DecidingAtom
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    CentroidProjection,
    Enlarged,
    Expression,
    Formula,
    Maximum,
    Minimum,
    Misalignment,
    Negative,
    Number,
    Projection,
    Protrusion,
    Quantified,
    Signal,
    SignedDistance,
    Sum,
    Temporal,
    Term,
    Truth,
)


@dataclass(frozen=True, slots=True)
class Dial:
    """A number that an atom's robustness depends on.

    Attributes:
        kind: a number that the atom compares with; the radius by which a term is enlarged; or, where the
            text has neither, the margin that the relation has to hold by, which is 0.
        value: the number.
        slope: what adding 1 to it adds to the robustness of the atom's deciding branch.
        is_uniform: whether it adds that in every sample, whichever branch decides.
        is_exact: whether the atom holds at one number only (`a dist b == c`).
    """

    kind: Literal["number", "radius", "margin"]
    value: float
    slope: int
    is_uniform: bool
    is_exact: bool

    @classmethod
    def of(cls, deciding: DecidingAtom) -> Dial:
        """The first number of the deciding branch that is written in the atom, else a radius, else 0."""
        atom = deciding.atom
        is_exact = "==" in atom.parameters
        for sign, part in deciding.branch:
            if isinstance(part, Number) and part.value in atom.parameters:
                slopes = _slopes(atom.expression, part.value)
                return cls("number", part.value, sign, slopes == {sign}, is_exact)
        for sign, part in deciding.branch:
            for radius in _radii(part):
                # of prisms, how high they are may decide instead
                slope = sign * _slope_of_radius(part, radius)
                return cls("radius", radius, slope, False, is_exact)
        return cls("margin", 0.0, -1, True, is_exact)

    def turned(self, expression: Expression, value: float) -> Expression:
        """The expression with another number in its place."""
        if self.kind == "margin":
            return Sum(expression, Number(-value))
        return _replaced(expression, self.kind, self.value, value)


def rewritten(formula: Formula, is_meant: Callable[[Atom], bool], change: Callable[[Atom], Atom]) -> Formula:
    """A formula of the same shape with some of its atoms changed."""
    match formula:
        case Atom():
            return change(formula) if is_meant(formula) else formula
        case Truth():
            return formula
        case Quantified():
            return replace(formula, body=rewritten(formula.body, is_meant, change))
        case Boolean() | Temporal():
            operands = tuple([rewritten(each, is_meant, change) for each in formula.operands])
            return replace(formula, operands=operands)


def _slopes(expression: Expression, number: float) -> set[int]:
    """What adding 1 to every such number adds to the expression, over the branches that may decide it."""
    match expression:
        case Number():
            return {int(expression.value == number)}
        case Sum():
            first, second = _slopes(expression.first, number), _slopes(expression.second, number)
            return {a + b for a in first for b in second}
        case Negative():
            return {-slope for slope in _slopes(expression.operand, number)}
        case Minimum() | Maximum():
            return {slope for each in expression.operands for slope in _slopes(each, number)}
    return {0}


def _slope_of_radius(expression: Expression, radius: float) -> int:
    def count(term: Term) -> int:
        return sum(each == radius for each in _radii_of(term))

    match expression:
        case SignedDistance():
            return -count(expression.first) - count(expression.second)
        case Protrusion():
            return count(expression.inner) - count(expression.outer)
        case Projection() if expression.axis != "z":
            return count(expression.term) * (1 if expression.side == "max" else -1)
    return 0


def _radii(expression: Expression) -> list[float]:
    """The radii that a measurement depends on, in the order written."""
    match expression:
        case SignedDistance():
            return _radii_of(expression.first) + _radii_of(expression.second)
        case Protrusion():
            return _radii_of(expression.inner) + _radii_of(expression.outer)
        case Projection() if expression.axis != "z":
            return _radii_of(expression.term)
    return []


def _radii_of(term: Term) -> list[float]:
    radii = []
    while isinstance(term, Enlarged):
        radii.append(term.radius)
        term = term.term
    return radii


def _replaced(expression: Expression, kind: str, old: float, new: float) -> Expression:
    def term(old_term: Term) -> Term:
        if not isinstance(old_term, Enlarged):
            return old_term
        is_meant = kind == "radius" and old_term.radius == old
        return Enlarged(term(old_term.term), new if is_meant else old_term.radius)

    match expression:
        case Number():
            return Number(new) if kind == "number" and expression.value == old else expression
        case Sum():
            first = _replaced(expression.first, kind, old, new)
            return Sum(first, _replaced(expression.second, kind, old, new))
        case Negative():
            return Negative(_replaced(expression.operand, kind, old, new))
        case Minimum():
            return Minimum(tuple([_replaced(each, kind, old, new) for each in expression.operands]))
        case Maximum():
            return Maximum(tuple([_replaced(each, kind, old, new) for each in expression.operands]))
        case SignedDistance():
            return SignedDistance(term(expression.first), term(expression.second))
        case Protrusion():
            return Protrusion(term(expression.inner), term(expression.outer))
        case Projection():
            return replace(expression, term=term(expression.term))
        case Signal() | Misalignment() | CentroidProjection():
            return expression
