"""Formulas written so that they cost less, of the same value on every run, whatever is still to come."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import is_
from types import MappingProxyType

from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Boolean,
    BooleanOperator,
    Bound,
    Formula,
    Temporal,
    TemporalOperator,
    Truth,
    expand,
    operands_of,
)


def looks_ahead(formula: Formula) -> bool:
    """Return whether a formula contains a future operator."""
    if isinstance(formula, Temporal) and formula.operator in FUTURE_OPERATORS:
        return True
    return any(looks_ahead(operand) for operand in operands_of(formula))


def from_first(node: Temporal) -> Temporal:
    """Return an operator that begins later, and never ends, as one that begins at once.

    It has the same value at the first sample, and only there: what comes too early counts for nothing.
    """
    bound = node.bound
    if bound is None or bound.upper is not None or bound.lower == 0 or node.operator not in "FGUR":
        return node
    is_late = Temporal("O", (Truth(True),), Bound(bound.lower, None, bound.unit))
    *left, right = node.operands
    if node.operator in "FU":
        counts = Boolean("and", (right, is_late))
    else:
        counts = Boolean("or", (right, Boolean("not", (is_late,))))
    return Temporal(node.operator, (*left, counts))


def simplified(node: Temporal) -> Temporal | Boolean:
    """Return an operator that looks ahead in the form that costs least, of the same value at every sample."""
    around = _around(recurring(node))
    return around if isinstance(around, Boolean) else _divided(merged(around))


def from_all(node: Temporal) -> Temporal:
    """Return `G H x` as `G x`, and `F O x` as `F x`, which have the same value at the first sample alone."""
    inner, is_negated = _below(node)
    wanted = {"G": "H", "F": "O"}.get(node.operator)
    if is_negated or not isinstance(inner, Temporal) or inner.operator != wanted or not looks_ahead(inner):
        return node
    if node.bound is not None or not _is_at_once(inner.bound):
        return node
    return from_all(Temporal(node.operator, inner.operands))


def at_last(node: Temporal) -> Formula | None:
    """Return what, at the first sample, is what a past operator over a future one is at the last one.

    That is a formula without future operators for `O F x`, `a S F x` and `O (x or F y)`, of which now is what
    was so far; for `O x` and `H x`, else, it is `F x` and `G x`. None if there is none, or if the operator is
    another one at the first.
    """
    behind, _ = _sides(node)
    if len(behind) == 1 and not looks_ahead(behind[0]):
        return behind[0]
    if node.operator not in "OH" or node.bound is not None:
        return None
    return Temporal("F" if node.operator == "O" else "G", node.operands)


def after_lasting(node: Temporal) -> Temporal | None:
    """Return `F[a,b] y` for `x U[a,b] y`, as of `(G z) U y`, whose left operand never falls; else None.

    Until y, x is least at once. So the node is `x and F[a,b] y`. If the window begins with the sample, y
    itself may stand for it, because the node's present value is that of y.
    """
    if node.operator != "U" or not looks_ahead(node.operands[0]) or not _never_falls(node.operands[0]):
        return None
    return Temporal("F", node.operands[1:], node.bound)


def _never_falls(formula: Formula, *, is_negated: bool = False) -> bool:
    """Return whether a formula, or its negation, is at least as much at each sample as at those before."""
    formula, is_inside = _peeled(formula)
    is_negated = is_negated != is_inside
    if isinstance(formula, Boolean):
        return all(_never_falls(operand, is_negated=is_negated) for operand in formula.operands)
    if not isinstance(formula, Temporal) or (formula.bound is not None and formula.bound.upper is not None):
        return False
    return formula.operator in ({"F", "H"} if is_negated else {"G", "O"})


def recurring(node: Temporal) -> Temporal:
    """Return `F G x` and `G F x` with, in place of x, what that is at the last sample if nothing follows.

    `G x` is greatest at the last sample, where only that one counts, and `F x` is least.
    """
    other, is_negated = _below(node)
    if not isinstance(other, Temporal) or node.bound is not None or other.bound is not None:
        return node
    wanted = node.operator if is_negated else {"F": "G", "G": "F"}.get(node.operator)
    if node.operator not in "FG" or other.operator != wanted or not _has_window(other.operands[0]):
        return node
    last = _at_last(other.operands[0])
    if last is None:
        return node
    inner: Formula = Temporal(other.operator, (last,))
    return Temporal(node.operator, (Boolean("not", (inner,)) if is_negated else inner,))


def _around(node: Temporal) -> Temporal | Boolean:
    """Return `O F x`, over windows that begin at once, as `O x or F x`, and others alike (see `_sides`)."""
    behind, ahead = _sides(node)
    return Boolean("and" if node.operator == "H" else "or", (*behind, *ahead)) if ahead else node


def _sides(node: Temporal) -> tuple[list[Formula], list[Formula]]:
    """Return what a past operator over windows ahead that begin at once looks at behind, and what ahead.

    An earlier sample looks no further ahead than the present one. In
    `a S F x`, a has to last for the shortest time from the very sample on that `F x` looks at, or not at all
    if that one is later than now. The same holds for each of several windows in one alternative, as in
    `O (x or F y)`, and below `H` for `G`, joined by `and`.

    Returns:
        both empty for any other operator.
    """
    if node.operator not in "OHS":
        return [], []
    joint: BooleanOperator = "and" if node.operator == "H" else "or"
    kind: TemporalOperator = "G" if node.operator == "H" else "F"
    *left, body = node.operands
    ahead, signals, others = list[Formula](), list[Formula](), list[Formula]()
    for each in _joined_by(joint, body, is_negated=False):
        inner, is_negated = _peeled(each)
        side = each
        if isinstance(inner, Temporal) and inner.operator == (_OPPOSITE[kind] if is_negated else kind):
            (below,) = inner.operands
            # what looks ahead on the left would be computed at all open positions twice
            is_alone = not left or not any(map(looks_ahead, (*left, below)))
            if is_alone and _is_at_once(node.bound, inner.bound):
                side = _negated(below) if is_negated else below
                ahead.append(Temporal(kind, (side,), inner.bound))
        (others if looks_ahead(side) else signals).append(side)
    if not ahead:
        return [], []
    joined = [_joined(joint, sides) for sides in (signals, others) if sides]
    return [Temporal(node.operator, (*left, each), node.bound) for each in joined], ahead


def _joined(joint: BooleanOperator, formulas: Sequence[Formula]) -> Formula:
    return Boolean(joint, tuple(formulas)) if len(formulas) > 1 else formulas[0]


def _joined_by(joint: BooleanOperator, formula: Formula, *, is_negated: bool) -> list[Formula]:
    """Return what a formula, or its negation, joins by `and` or `or`."""
    inner, is_inside = _peeled(formula)
    is_negated = is_negated != is_inside
    if isinstance(inner, Boolean) and inner.operator == (_DUAL[joint] if is_negated else joint):
        return [part for each in inner.operands for part in _joined_by(joint, each, is_negated=is_negated)]
    return [_negated(inner) if is_negated else inner]


def merged(node: Temporal) -> Temporal:
    """Return `F[a,b] F[c,d] x` as `F[a+c,b+d] x`, and `G` likewise; in samples, of which none is left out."""
    inner, is_negated = _below(node)
    operator, low, high = _as_window(node, is_negated=False)
    other, more_low, more_high = _as_window(inner, is_negated=is_negated)
    if not operator or operator != other or not isinstance(inner, Temporal):
        return node
    operand = _negated(inner.operands[0]) if is_negated else inner.operands[0]
    kind: TemporalOperator = "F" if operator == "F" else "G"
    return merged(Temporal(kind, (operand,), Bound(low + more_low, high + more_high, "samples")))


def _divided(node: Temporal) -> Temporal | Boolean:
    """Return `F[a,b] (x or F[c,d] y)` as `F[a,b] x or F[a+c,b+d] y`, and `G` over `and` likewise."""
    inner, is_negated = _below(node)
    joint: BooleanOperator = "or" if node.operator in "FX" else "and"
    if not isinstance(inner, Boolean) or (inner.operator == joint) == is_negated or len(inner.operands) < 2:
        return node
    operands = map(_negated, inner.operands) if is_negated else inner.operands
    apart = [Temporal(node.operator, (operand,), node.bound) for operand in operands]
    joined = [merged(each) for each in apart]
    return node if all(map(is_, apart, joined)) else Boolean(joint, tuple(joined))


_OPPOSITE: Mapping[str, str] = MappingProxyType({"F": "G", "G": "F"})
_DUAL: Mapping[str, str] = MappingProxyType({"and": "or", "or": "and"})


def _below(node: Temporal) -> tuple[Formula, bool]:
    """Return what stands below an operator and below `not`, and whether these negate it."""
    return _peeled(node.operands[0])


def _peeled(formula: Formula) -> tuple[Formula, bool]:
    """Return what stands below `not`, and whether that negates it."""
    other, is_negated = expand(formula), False
    while isinstance(other, Boolean) and other.operator == "not":
        other, is_negated = expand(other.operands[0]), not is_negated
    return other, is_negated


def _negated(formula: Formula) -> Formula:
    return Boolean("not", (formula,))


def _is_at_once(*bounds: Bound | None) -> bool:
    return all(bound is None or bound.lower == 0 for bound in bounds)


def _as_window(formula: Formula, *, is_negated: bool) -> tuple[str, int, int]:
    """Return F or G, and the window in samples, of an operator, or of its negation; no name for any other."""
    if isinstance(formula, Temporal) and formula.operator == "X":
        return ("G" if is_negated else "F"), 1, 1
    if not isinstance(formula, Temporal) or formula.operator not in _OPPOSITE or formula.bound is None:
        return "", 0, 0
    bound = formula.bound
    if bound.upper is None or bound.unit != "samples":
        return "", 0, 0
    operator = _OPPOSITE[formula.operator] if is_negated else formula.operator
    return operator, bound.lower, bound.upper


def _has_window(formula: Formula) -> bool:
    formula = expand(formula)
    if isinstance(formula, Temporal) and (formula.bound is not None or formula.operator == "X"):
        return True
    return any(map(_has_window, operands_of(formula)))


def _at_last(formula: Formula) -> Formula | None:
    """Return what a formula is at the last sample, without future operators; None if others matter to it."""
    formula = expand(formula)
    if not looks_ahead(formula):
        return formula
    operands = [_at_last(operand) for operand in operands_of(formula)]
    if isinstance(formula, Boolean):
        known = [operand for operand in operands if operand is not None]
        return Boolean(formula.operator, tuple(known)) if len(known) == len(operands) else None
    if not isinstance(formula, Temporal) or formula.operator not in FUTURE_OPERATORS:
        return None
    if formula.operator == "X" or (formula.bound is not None and formula.bound.lower > 0):
        return Truth(formula.operator == "G")
    return operands[-1]
