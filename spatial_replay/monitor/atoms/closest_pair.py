"""Quantifiers that the closest two of a group decide, so that not every pair has to be measured.

`forall p, q in people: p dist q >= 0.5` has a binding for each ordered pair, 39,800 for 200 people. But its
body falls with the distance of p and q, and reads nothing else: its value for the closest two is the least
over all pairs. Likewise, `exists p, q` of a body that rises as the distance falls is the greatest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Enlarged,
    Expression,
    Group,
    Negative,
    Number,
    Quantified,
    Scaled,
    SignedDistance,
    Sum,
    Term,
    Variable,
)
from spatial_replay.spec.walks import map_leaves


@dataclass(frozen=True, slots=True)
class ClosestPair:
    """The signed distance of the closest two members of an open group.

    Attributes:
        enlargement: of both together, in footprint units.
    """

    group: Group
    enlargement: float


def closest_pair_of(formula: Quantified) -> ClosestPair | None:
    """Return the pair whose distance decides a quantifier; None if it takes more."""
    found = number_of_closest(formula)
    return None if found is None else found[0]


def number_of_closest(formula: Quantified) -> tuple[ClosestPair, Expression] | None:
    """Return the pair that decides a quantifier, and the quantifier's number, with it as a leaf."""
    body, sign = formula.body, 1 if formula.quantifier == "forall" else -1
    is_negated = False
    while isinstance(body, Boolean) and body.operator == "not":
        (body,) = body.operands
        is_negated = not is_negated
    if len(formula.variables) != 2 or not isinstance(formula.group, Group) or not isinstance(body, Atom):
        return None
    found = {
        (effect, _enlargement(leaf, formula.variables))
        for effect, leaf in _leaves(body.expression, -sign if is_negated else sign)
        if not isinstance(leaf, Number)
    }
    if len(found) != 1:
        return None
    ((effect, enlargement),) = found
    if effect < 0 or enlargement is None:
        return None
    pair: Any = ClosestPair(formula.group, enlargement)
    number = map_leaves(body.expression, lambda leaf: leaf if isinstance(leaf, Number) else pair)
    return pair, Negative(number) if is_negated else number


def _leaves(expression: Expression, sign: int) -> Iterator[tuple[int, Expression]]:
    """Iterate over the leaves of an expression, with the sign of their effect.

    A minimum or a maximum counts as a leaf: it is unknown with any of its operands, and so does not fall as
    one of them falls.
    """
    match expression:
        case Sum(first, second):
            yield from _leaves(first, sign)
            yield from _leaves(second, sign)
        case Negative(operand):
            yield from _leaves(operand, -sign)
        case Scaled(operand):
            yield from _leaves(operand, sign)
        case _:
            yield sign, expression


def _enlargement(leaf: Expression, variables: tuple[str, ...]) -> float | None:
    """Return the enlargement of both terms of a distance between two variables; None of anything else."""
    if not isinstance(leaf, SignedDistance):
        return None
    names, radii = zip(*(_grown(term) for term in (leaf.first, leaf.second)), strict=True)
    return sum(radii) if set(names) == set(variables) else None


def _grown(term: Term) -> tuple[str | None, float]:
    """Return the name of a variable, and by how much it is enlarged; no name for anything else."""
    match term:
        case Enlarged(inner, radius):
            name, own = _grown(inner)
            return name, own + radius
        case Variable(name):
            return name, 0.0
    return None, 0.0
