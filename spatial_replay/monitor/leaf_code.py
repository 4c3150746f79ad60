"""Atoms and open quantifiers, compiled for the objects that a trace has."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from math import perm

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Flags
from spatial_replay.monitor.leaf_kernel import (
    ADD,
    AND,
    AND_MEMBER,
    CONSTANT,
    GREATEST,
    HOLDS,
    IFF,
    LEAST,
    MEASURED,
    NEGATE,
    OR,
    OR_MEMBER,
    SIGNAL,
    XOR,
)
from spatial_replay.monitor.operands import Bindings, Scene, bind
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    CentroidProjection,
    Expression,
    Formula,
    Maximum,
    Measurement,
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
    Truth,
)

MAX_BINDINGS = 20_000
"""How many ways of binding their variables the open quantifiers of one formula may have in all."""


class LeafCode:
    """Instructions for some leaves, operands first; equal ones share a column.

    Attributes:
        rows: operation, a, b, c of each instruction, with its number.
        constants, measurements, signals: what instructions read, with the number they know it by.
        members: for each binding of an open quantifier (T,): whether it is one in each sample (1, 0), or
            that is unknown (-1).
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._bindings = 0
        self.rows: dict[tuple[int, int, int, int], int] = {}
        self.constants: dict[float, int] = {}
        self.measurements: dict[Measurement, int] = {}
        self.signals: dict[str, int] = {}
        self.members: list[Flags] = []

    def add(self, formula: Formula, bindings: Bindings) -> int:
        """The number of the instruction that gives a formula without temporal operators, as an interval.

        Raises:
            UsageError: more than `MAX_BINDINGS`.
        """
        match formula:
            case Truth():
                return self._constant(np.inf if formula.value else -np.inf)
            case Atom():
                return self._row(HOLDS, self._expression(formula.expression, bindings))
            case Quantified():
                return self._quantified(formula, bindings)
            case Boolean():
                first, *rest = [self.add(each, bindings) for each in formula.operands]
                return self._boolean(formula.operator, first, rest)
            case Temporal():
                raise TypeError("a temporal operator in the body of an open quantifier")

    def _row(self, op: int, a: int = 0, b: int = 0, c: int = 0) -> int:
        return self.rows.setdefault((op, a, b, c), len(self.rows))

    def _constant(self, value: float) -> int:
        return self._row(CONSTANT, self.constants.setdefault(value, len(self.constants)))

    def _expression(self, expression: Expression, bindings: Bindings) -> int:
        match expression:
            case Number():
                return self._constant(expression.value)
            case Signal():
                return self._row(SIGNAL, self.signals.setdefault(expression.name, len(self.signals)))
            case Sum():
                first = self._expression(expression.first, bindings)
                return self._row(ADD, first, self._expression(expression.second, bindings))
            case Negative():
                return self._row(NEGATE, self._expression(expression.operand, bindings))
            case Minimum() | Maximum():
                op = LEAST if isinstance(expression, Minimum) else GREATEST
                row, *others = [self._expression(each, bindings) for each in expression.operands]
                for other in others:
                    row = self._row(op, row, other)
                return row
        measurement = _bound(expression, bindings)
        return self._row(MEASURED, self.measurements.setdefault(measurement, len(self.measurements)))

    def _boolean(self, operator: str, first: int, rest: Sequence[int]) -> int:
        match operator:
            case "not":
                return self._row(NEGATE, first)
            case "xor":
                return self._row(XOR, first, rest[0])
            case "<->":
                return self._row(IFF, first, rest[0])
            case "->":
                return self._row(OR, self._row(NEGATE, first), rest[0])
        for other in rest:
            first = self._row(AND if operator == "and" else OR, first, other)
        return first

    def _quantified(self, formula: Quantified, bindings: Bindings) -> int:
        is_forall = formula.quantifier == "forall"
        names, members, unknown = self._scene.members(bind(formula.group, bindings))
        self._check_bindings(formula, len(names))
        op = AND_MEMBER if is_forall else OR_MEMBER
        result = self._constant(np.inf if is_forall else -np.inf)
        if unknown.any():
            self.members.append(np.where(unknown, -1, 0).astype(np.int8))
            result = self._row(op, result, result, len(self.members) - 1)
        for chosen in permutations(range(len(names)), len(formula.variables)):
            inner = {**bindings, **{v: names[n] for v, n in zip(formula.variables, chosen, strict=True)}}
            body = self.add(formula.body, inner)
            self.members.append(members[:, chosen].min(axis=1))
            result = self._row(op, result, body, len(self.members) - 1)
        return result

    def _check_bindings(self, formula: Quantified, member_count: int) -> None:
        self._bindings += perm(member_count, len(formula.variables))
        if self._bindings > MAX_BINDINGS:
            raise UsageError(
                f"{formula.quantifier} {', '.join(formula.variables)} over {member_count} objects brings a "
                f"formula to {self._bindings} bindings; {MAX_BINDINGS} is the limit: use a smaller group or "
                "fewer variables"
            )


def _bound(measurement: Measurement, bindings: Bindings) -> Measurement:
    if not bindings:
        return measurement
    match measurement:
        case SignedDistance():
            return SignedDistance(bind(measurement.first, bindings), bind(measurement.second, bindings))
        case Misalignment():
            return Misalignment(bind(measurement.first, bindings), bind(measurement.second, bindings))
        case Protrusion():
            return Protrusion(bind(measurement.inner, bindings), bind(measurement.outer, bindings))
        case Projection():
            return Projection(bind(measurement.term, bindings), measurement.axis, measurement.side)
        case CentroidProjection():
            return CentroidProjection(bind(measurement.term, bindings), measurement.axis, measurement.side)
