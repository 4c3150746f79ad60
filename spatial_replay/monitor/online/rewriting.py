"""Formulas written so that they cost less, of the same value on every run, whatever is still to come."""

from __future__ import annotations

from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Boolean,
    Bound,
    Formula,
    Temporal,
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


def recurring(node: Temporal) -> Temporal:
    """Return `F G x` and `G F x` with, in place of x, what that is at the last sample if nothing follows.

    `G x` is greatest at the last sample, where only that one counts, and `F x` is least.
    """
    other = node.operands[0]
    is_negated = False
    while isinstance(other := expand(other), Boolean) and other.operator == "not":
        other, is_negated = other.operands[0], not is_negated
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
