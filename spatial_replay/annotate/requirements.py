"""The requirements of a formula: its demands on objects and regions in a single sample.

A formula without temporal operators concerns only the present sample. The *requirements* of a specification
are its largest subformulas without temporal operators. Each requirement has a sign: the sign in which the
specification needs the requirement's robustness. Under a negation, or left of an implication, the
specification needs low robustness. A requirement applies until its *obligation* is permanently fulfilled. The
obligation is the largest temporal subformula around the requirement.

A requirement that fails now is violated only if two formulas around the requirement are permanently violated:
its obligation, and the conjunct of the specification. A goal that is not reached yet is pending.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.spec.formula import (
    ANY_CLASS,
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Formula,
    Group,
    Quantified,
    RegionName,
    Temporal,
    Term,
    TrackedName,
    Variable,
    iter_nodes,
    operator_of,
)
from spatial_replay.spec.walks import base_of, is_spatial, iter_bound, operand_signs


class Obligation(NamedTuple):
    """A temporal subformula that is not part of a larger temporal subformula.

    Attributes:
        node: id in the formula's tree.
        sign: 1 if the formula needs the subformula to hold, -1 if it needs the subformula to fail.
    """

    node: int
    sign: float

    def is_fulfilled(self, series: Floats, at: Integers) -> NDArray[np.bool_]:
        """Return (S,), whether the obligation is permanently met.

        Args:
            series: (N, 4, T): value, now, lower, upper of each node.
            at: (S,) indices of samples.
        """
        if self.sign > 0.0:
            return np.asarray(series[self.node, 2, at] >= 0.0)
        return np.asarray(series[self.node, 3, at] < 0.0)

    def is_open(self, series: Floats, at: Integers) -> NDArray[np.bool_]:
        """Return (S,), whether the obligation is met, or later samples may meet it; see `is_fulfilled`."""
        if self.sign > 0.0:
            return np.asarray(series[self.node, 3, at] >= 0.0)
        return np.asarray(series[self.node, 2, at] <= 0.0)


class Standing(IntEnum):
    """The state of a requirement in a sample.

    `FULFILLED`: the obligation is permanently met, so the requirement no longer applies. `HOLDING`: the
    requirement holds now. `VIOLATED`: the requirement fails now, and later samples cannot repair that.
    `PENDING`: the requirement fails now, and later samples can repair that. `UNKNOWN`: not observed.
    """

    FULFILLED = 0
    HOLDING = 1
    VIOLATED = 2
    PENDING = 3
    UNKNOWN = 4


class ClassMembers(NamedTuple):
    """An open group: all objects of a class in a sample, with exceptions.

    Attributes:
        class_name: casefolded, or `ANY_CLASS`.
        excluded: names of the exceptions.
    """

    class_name: str
    excluded: frozenset[str]


class Requirement(NamedTuple):
    """A largest subformula without temporal operators.

    Attributes:
        node: id in the formula's tree.
        sign: 1 if the formula needs the subformula to hold, -1 if it needs the subformula to fail.
        obligation: the temporal subformula around the requirement, or None.
        objects, regions: names of related objects and regions.
        groups: open groups; their members are also related objects.
        conjunct: the conjunct of the formula around the requirement.
        can_violate: whether a failure of the requirement can be a violation. False for a goal whose
            obligation also has invariants, and for all goals under a semantics without final verdicts.
        is_condition: whether the requirement is left of an implication. The implication also holds if the
            requirement fails.
        is_invariant: whether the obligation needs the requirement in every sample, without an alternative.
    """

    node: int
    sign: float
    obligation: Obligation | None
    objects: frozenset[str]
    regions: frozenset[str]
    groups: frozenset[ClassMembers]
    conjunct: Obligation = Obligation(0, 1.0)
    can_violate: bool = True
    is_condition: bool = False
    is_invariant: bool = False

    def standing(self, series: Floats, at: Integers) -> NDArray[np.uint8]:
        """Return (S,), the state of the requirement, see `Standing`.

        Args:
            series: (N, 4, T): value, now, lower, upper of each node.
            at: (S,) indices of samples.
        """
        return self._numbers(series, at)[0]

    def robustness(self, series: Floats, at: Integers) -> Floats:
        """Return (S,), robustness times sign where the requirement holds or is violated; NaN elsewhere.

        Args:
            series: (N, 4, T): value, now, lower, upper of each node.
            at: (S,) indices of samples.
        """
        return self._numbers(series, at)[1]

    def _numbers(self, series: Floats, at: Integers) -> tuple[NDArray[np.uint8], Floats]:
        numbers_now = self.sign * series[self.node, 1, at]
        standing = np.full(numbers_now.shape, Standing.UNKNOWN, np.uint8)
        standing[numbers_now >= 0.0] = Standing.HOLDING
        is_pending = np.full(numbers_now.shape, not self.can_violate)
        for obligation in (self.conjunct if self.can_violate else None, self.obligation):
            if obligation is not None:
                is_pending |= obligation.is_open(series, at)
        is_failing = numbers_now < 0.0
        standing[is_failing] = np.where(is_pending[is_failing], Standing.PENDING, Standing.VIOLATED)
        if self.obligation is not None:
            standing[self.obligation.is_fulfilled(series, at)] = Standing.FULFILLED
        is_counted = (standing == Standing.HOLDING) | (standing == Standing.VIOLATED)
        return standing, np.where(is_counted, numbers_now, np.nan)

    def outcome(self, series: Floats, at: Integers) -> Floats:
        """Return (S,), the obligation's robustness over the finished log, times the obligation's sign.

        NaN if the robustness is not known, or if the obligation fails without violating the conjunct.

        Args:
            series: (N, 4, T): value, now, and lower and upper over the finished log.
            at: (S,) indices of samples.
        """
        obligation = self.obligation or Obligation(self.node, self.sign)
        lows, highs = (series[obligation.node, 2, at], series[obligation.node, 3, at])
        if obligation.sign < 0.0:
            lows, highs = -highs, -lows
        is_failing = (highs < 0.0) & ~self.conjunct.is_open(series, at)
        return np.where(lows >= 0.0, lows, np.where(is_failing, highs, np.nan))


def requirements_of(
    formula: Formula, object: str | None = None, *, settles: bool = True, splits: bool = False
) -> tuple[Requirement, ...]:
    """Return the requirements of a formula, by node.

    Subformulas that are needed in both signs, under `xor` and `<->`, are not requirements.

    Args:
        object: object of a template's instance, or None.
        settles: whether the semantics has final verdicts; otherwise a goal is pending up to the end.
        splits: whether to split each requirement into its conjuncts.
    """
    positions = _positions(formula)
    is_plain = [is_spatial(position.formula) for position in positions]
    requirement_positions = [
        (identifier, position)
        for identifier, position in enumerate(positions)
        if position.sign
        and is_plain[identifier]
        and (position.parent is None or not is_plain[position.parent])
    ]
    if splits:
        requirement_positions = [
            (conjunct, positions[conjunct])
            for identifier, _ in requirement_positions
            for conjunct in _conjuncts(positions, identifier)
        ]
    invariant_obligations = {
        None if position.obligation is None else position.obligation.node
        for _, position in requirement_positions
        if position.needs_all_above
    }
    requirements = []
    for identifier, position in requirement_positions:
        obligation = position.obligation
        is_goal = not position.needs_all_above and obligation is not None
        is_beside_invariant = is_goal and obligation is not None and obligation.node in invariant_obligations
        requirement = _requirement(identifier, position, object)
        requirements.append(
            requirement._replace(can_violate=not (is_goal and (is_beside_invariant or not settles)))
        )
    return tuple(requirements)


def _conjuncts(positions: Sequence[_Position], identifier: int) -> list[int]:
    """Return the parts of a requirement that are all needed: operands of `and`, or of `or` under sign -1."""
    operands = [index for index, position in enumerate(positions) if position.parent == identifier]
    if not operands or not _needs_all(positions[identifier]):
        return [identifier]
    return [conjunct for operand in operands for conjunct in _conjuncts(positions, operand)]


class _Position(NamedTuple):
    """The position of a node in a formula.

    Attributes:
        sign: sign in which the formula needs the node; 0 for both signs.
        needs_all_above: whether each operator above needs all its operands (see `_NEEDS_ALL`).
        is_condition, is_invariant: see `Requirement`.
    """

    formula: Formula
    parent: int | None
    sign: float
    obligation: Obligation | None
    conjunct: Obligation
    needs_all_above: bool
    is_condition: bool
    is_invariant: bool = True


def _positions(formula: Formula) -> list[_Position]:
    """Return the position of each node, by id."""
    positions: list[_Position] = []
    operand_counts: list[int] = []
    for identifier, parent, node in iter_nodes(formula):
        operand_counts.append(0)
        if parent is None:
            sign, obligation_above, conjunct, needs_all_above = 1.0, None, Obligation(0, 1.0), True
            is_condition, is_invariant = False, True
        else:
            parent_position = positions[parent]
            is_implied = operator_of(parent_position.formula) == "->" and parent_position.sign > 0.0
            is_condition = parent_position.is_condition or (is_implied and not operand_counts[parent])
            always_operator = "G" if parent_position.sign > 0.0 else "F"
            is_always = operator_of(parent_position.formula) == always_operator and _is_endless(
                parent_position.formula
            )
            is_invariant = parent_position.is_invariant and _needs_all_now(parent_position, is_always)
            sign = parent_position.sign * _sign(parent_position.formula, operand_counts[parent])
            obligation_above, conjunct, needs_all_above = (
                parent_position.obligation,
                parent_position.conjunct,
                parent_position.needs_all_above and _needs_all(parent_position),
            )
            if (
                conjunct == Obligation(parent, parent_position.sign)
                and isinstance(parent_position.formula, Boolean)
                and _needs_all(parent_position)
            ):
                conjunct = Obligation(identifier, sign)
            operand_counts[parent] += 1
        is_obligation = obligation_above is None and isinstance(node, Temporal)
        obligation = Obligation(identifier, sign) if is_obligation else obligation_above
        position = _Position(
            node, parent, sign, obligation, conjunct, needs_all_above, is_condition, is_invariant
        )
        positions.append(position)
    return positions


_NEEDS_ALL: Final[Mapping[float, frozenset[str]]] = MappingProxyType(
    {
        1.0: frozenset({"and", "not", "spec", "G", "H", "X", "WX", "Y"}),
        -1.0: frozenset({"or", "not", "spec", "->", "F", "O", "X", "WX", "Y"}),
    }
)
"""Operators that need all of their operands, by the sign in which the formula needs the operator."""


def _is_endless(formula: Formula) -> bool:
    """Return whether an operator concerns all later samples, without an upper bound."""
    is_ahead = operator_of(formula) in FUTURE_OPERATORS - {"X", "WX"}
    return (
        is_ahead and isinstance(formula, Temporal) and (formula.bound is None or formula.bound.upper is None)
    )


def _needs_all(position: _Position) -> bool:
    return operator_of(position.formula) in _NEEDS_ALL.get(position.sign, frozenset())


def _needs_all_now(position: _Position, is_always: bool) -> bool:
    """Return whether operands of a node may be invariants of their obligation.

    Operands may be invariants in three positions: below an unbounded operator that needs every sample, above
    all obligations, and below Boolean operators that need all operands.
    """
    is_outside = position.obligation is None and not isinstance(position.formula, Temporal)
    return is_always or is_outside or (isinstance(position.formula, Boolean) and _needs_all(position))


def _sign(parent: Formula, operand: int) -> float:
    """Return the sign in which a node needs an operand; 0 for both signs."""
    signs = operand_signs(parent, operand)
    return float(signs[0]) if len(signs) == 1 else 0.0


def _requirement(identifier: int, position: _Position, object: str | None) -> Requirement:
    objects: set[str] = set()
    regions: set[str] = set()
    groups: set[ClassMembers] = set()
    for node, quantifiers in iter_bound(position.formula):
        bindings = {
            name: base_of(quantifier.group) for quantifier in quantifiers for name in quantifier.variables
        }
        terms: tuple[Term, ...] = node.terms if isinstance(node, Atom) else ()
        if isinstance(node, Quantified):
            terms = (node.group,)
        for term in terms:
            # the object or region itself, without delay and enlargement
            base = base_of(term)
            match bindings.get(base.name, base) if isinstance(base, Variable) else base:
                case TrackedName(name):
                    objects.add(name)
                case RegionName(name):
                    regions.add(name)
                case Variable() if object is not None:
                    objects.add(object)
                case Group() as group:
                    excluded_names = _excluded_names(group, object)
                    if group.members is None:
                        groups.add(ClassMembers((group.class_name or ANY_CLASS).casefold(), excluded_names))
                    else:
                        objects.update(set(group.members) - excluded_names)
                case _:
                    pass
    return Requirement(
        identifier,
        position.sign,
        position.obligation,
        frozenset(objects),
        frozenset(regions),
        frozenset(groups),
        position.conjunct,
        is_condition=position.is_condition,
        is_invariant=position.is_invariant and position.obligation is not None,
    )


def _excluded_names(group: Group, object: str | None) -> frozenset[str]:
    names = [object if isinstance(term, Variable) else term.name for term in group.excluded]
    return frozenset(name for name in names if name is not None)
