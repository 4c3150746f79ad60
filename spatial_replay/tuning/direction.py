"""Whether one formula holds wherever another does: which way a constant loosens a specification."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, TypeAlias

from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Bound,
    Enlarged,
    Expression,
    Formula,
    Maximum,
    Minimum,
    Negative,
    Number,
    Projection,
    Protrusion,
    Quantified,
    Scaled,
    SignedDistance,
    Specification,
    Sum,
    Temporal,
    Term,
    expand,
)

Direction: TypeAlias = Literal[-1, 0, 1]
"""1: looser, its robustness is at least that of the other in every log; -1: tighter; 0: the same."""


def direction(before: Specification, after: Specification) -> Direction | None:
    """Return how the results of one specification compare with those of another, of the same shape.

    Returns:
        None where one is looser in some logs and tighter in others, or where that is not known.
    """
    if before.regions != after.regions or len(before.results) != len(after.results):
        return None
    return _common(
        _of_formula(one.formula, other.formula)
        for one, other in zip(before.results, after.results, strict=True)
    )


def _common(directions: Iterable[Direction | None]) -> Direction | None:
    """Return the direction of something that rises with each of its parts."""
    found = set(directions) - {0}
    if not found:
        return 0
    return found.pop() if len(found) == 1 else None


def _opposite(direction: Direction | None) -> Direction | None:
    return None if direction is None else -direction


def _sign(difference: float) -> Direction:
    return 1 if difference > 0 else -1 if difference < 0 else 0


def _of_formula(before: Formula, after: Formula) -> Direction | None:
    if before == after:
        return 0
    if isinstance(before, Boolean) and before.operator in ("xor", "<->"):
        return None
    match expand(before), expand(after):
        case Atom() as one, Atom() as other:
            return _of_expression(one.expression, other.expression)
        case Quantified() as one, Quantified() as other:
            same = (one.quantifier, one.variables, one.group) == (
                other.quantifier,
                other.variables,
                other.group,
            )
            return _of_formula(one.body, other.body) if same else None
        case Boolean() as one, Boolean() as other if _alike(one, other):
            parts = _common(map(_of_formula, one.operands, other.operands))
            return _opposite(parts) if one.operator == "not" else parts
        case Temporal() as one, Temporal() as other if _alike(one, other):
            window = _of_bound(one.bound, other.bound)
            window = _opposite(window) if one.operator in ("G", "H") else window
            return _common([window, *map(_of_formula, one.operands, other.operands)])
    return None


def _alike(one: Boolean | Temporal, other: Boolean | Temporal) -> bool:
    return one.operator == other.operator and len(one.operands) == len(other.operands)


def _of_bound(before: Bound | None, after: Bound | None) -> Direction | None:
    """Return 1 if the window of an operator such as F grew: it has more samples to choose from."""
    if before == after:
        return 0
    if before is None or after is None or before.unit != after.unit:
        return None
    ends = [float("inf") if each.upper is None else each.upper for each in (before, after)]
    return _common([_sign(before.lower - after.lower), _sign(ends[1] - ends[0])])


def _of_expression(before: Expression, after: Expression) -> Direction | None:
    if before == after:
        return 0
    match before, after:
        case Number() as one, Number() as other:
            return _sign(other.value - one.value)
        case Sum() as one, Sum() as other:
            return _common([_of_expression(one.first, other.first), _of_expression(one.second, other.second)])
        case Negative() as one, Negative() as other:
            return _opposite(_of_expression(one.operand, other.operand))
        case Scaled() as one, Scaled() as other if one.divisor == other.divisor:
            return _of_expression(one.operand, other.operand)
        case Minimum() as one, Minimum() as other if len(one.operands) == len(other.operands):
            return _common(map(_of_expression, one.operands, other.operands))
        case Maximum() as one, Maximum() as other if len(one.operands) == len(other.operands):
            return _common(map(_of_expression, one.operands, other.operands))
        case SignedDistance() as one, SignedDistance() as other:
            grown = [_of_term(one.first, other.first), _of_term(one.second, other.second)]
            return _opposite(_common(grown))
        case Protrusion() as one, Protrusion() as other:
            return _common([_of_term(one.inner, other.inner), _opposite(_of_term(one.outer, other.outer))])
        case Projection() as one, Projection() as other if (one.side, one.axis) == (other.side, other.axis):
            grew = _of_term(one.term, other.term)
            return grew if one.side == "max" else _opposite(grew)
    return None


def _of_term(before: Term, after: Term) -> Direction | None:
    """Return 1 if a footprint is enlarged more."""
    if before == after:
        return 0
    if isinstance(before, Enlarged) and isinstance(after, Enlarged):
        return _common([_of_term(before.term, after.term), _sign(after.radius - before.radius)])
    return None
