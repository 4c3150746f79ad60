"""The signal table: subformulas without a future operator, compiled for `signals.step_signals`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.monitor import codes
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Bound,
    Formula,
    Quantified,
    Temporal,
    Truth,
    operands_of,
)

Row = tuple[int, ...]
"""A row of a table, its columns as `codes` lists them."""

NOTHING = -1
"""Stands where a row has no operand, no upper end, no variable, no table or no window."""

_WINDOWS = (codes.WINDOW_MAX, codes.WINDOW_MIN)


def looks_ahead(formula: Formula) -> bool:
    """Whether a formula holds a future operator."""
    if isinstance(formula, Temporal) and formula.operator in FUTURE_OPERATORS:
        return True
    return any(looks_ahead(operand) for operand in operands_of(formula))


def window_of(bound: Bound | None) -> tuple[int, int, int | None]:
    """The unit, the lower and the upper end (None: unbounded) of an operator's window."""
    if bound is None:
        return codes.SAMPLES, 0, None
    return (codes.SAMPLES if bound.unit == "samples" else codes.NANOSECONDS), bound.lower, bound.upper


def array_of_rows(rows: Sequence[Row], width: int) -> Integers:
    """(R, width), also for no rows."""
    return np.array(rows, np.int64).reshape(len(rows), width)


class SignalTable:
    """Collects rows; equal subformulas share one, and operands come before what they are operands of.

    Attributes:
        leaves: atoms and open quantifiers, by the number that their rows refer to.
    """

    def __init__(self, leaves: Sequence[Atom | Quantified] = ()) -> None:
        """Begin with leaves that are numbered already."""
        self.leaves: list[Atom | Quantified] = []
        self._leaf_numbers: dict[tuple[object, ...], int] = {}
        self._rows: dict[Row, int] = {}
        for leaf in leaves:
            self._leaf_number(leaf)

    @property
    def windows(self) -> int:
        """How many rows keep a sliding window."""
        return sum(row[0] in _WINDOWS for row in self._rows)

    @property
    def keeps_history(self) -> bool:
        """Whether any row looks at more than the newest sample."""
        return any(row[0] in _WINDOWS or row[0] == codes.DELAY for row in self._rows)

    def array(self) -> Integers:
        """(S, SIGNAL_WIDTH), with the numbers of the sliding windows."""
        window = 0
        rows = []
        for row in self._rows:
            is_window = row[0] in _WINDOWS
            rows.append((*row, window if is_window else NOTHING))
            window += is_window
        return array_of_rows(rows, codes.SIGNAL_WIDTH)

    def add(self, formula: Formula) -> int:
        """The row of a formula without future operators."""
        match formula:
            case Truth():
                return self._row(codes.CONSTANT, low=1 if formula.value else -1)
            case Atom() | Quantified():
                return self._row(codes.LEAF, self._leaf_number(formula))
            case Boolean():
                return self._boolean(formula.operator, [self.add(each) for each in formula.operands])
            case Temporal():
                operands = [self.add(each) for each in formula.operands]
                return self._temporal(formula.operator, operands, formula.bound)

    def _row(self, code: int, a: int = 0, b: int = 0, unit: int = 0, low: int = 0, high: int = 0) -> int:
        return self._rows.setdefault((code, a, b, unit, low, high), len(self._rows))

    def _leaf_number(self, formula: Atom | Quantified) -> int:
        key: tuple[object, ...]
        if isinstance(formula, Atom):
            key = (formula.expression,)
        else:
            key = (formula.quantifier, formula.variables, formula.group, formula.body)
        if key not in self._leaf_numbers:
            self._leaf_numbers[key] = len(self.leaves)
            self.leaves.append(formula)
        return self._leaf_numbers[key]

    def _boolean(self, operator: str, operands: list[int]) -> int:
        first, *rest = operands
        match operator:
            case "not":
                return self._row(codes.NOT, first)
            case "spec":
                return first
            case "and" | "or":
                for operand in rest:
                    first = self._row(codes.AND if operator == "and" else codes.OR, first, operand)
                return first
            case "xor":
                return self._row(codes.XOR, first, rest[0])
            case "->":
                return self._row(codes.OR, self._row(codes.NOT, first), rest[0])
            case _:
                return self._row(codes.IFF, first, rest[0])

    def _temporal(self, operator: str, operands: list[int], bound: Bound | None, ahead: int = 0) -> int:
        """A past operator; with `codes.AHEAD`, the future operator that is its mirror image in time."""
        unit, low, high = window_of(bound)
        match operator:
            case "Y":
                return self._delay(operands[0], codes.SAMPLES, 1, ahead)
            case "S":
                left, right = operands
                return self._since(left, right, unit, low, high, ahead)
        is_weak = operator == "H"
        if high is not None:
            code = codes.WINDOW_MIN if is_weak else codes.WINDOW_MAX
            return self._row(code + ahead, operands[0], 0, unit, low, high)
        running = self._row((codes.HISTORICALLY if is_weak else codes.ONCE) + ahead, operands[0])
        return running if low == 0 else self._delay(running, unit, low, ahead, is_weak=is_weak)

    def _since(self, left: int, right: int, unit: int, low: int, high: int | None, ahead: int) -> int:
        """phi S[a,b] psi as O[a,b] psi and phi S[a,inf] psi, the latter as phi on the last a and
        phi S psi before: since min distributes over max, both are exact for robustness too."""
        result = self._row(codes.SINCE + ahead, left, right)
        if low > 0:
            before = self._delay(result, unit, low, ahead)
            since = self._row(codes.WINDOW_MIN + ahead, left, 0, unit, 0, low - 1)
            result = self._row(codes.AND, since, before)
        if high is not None:
            within = self._row(codes.WINDOW_MAX + ahead, right, 0, unit, low, high)
            result = self._row(codes.AND, within, result)
        return result

    def _delay(self, operand: int, unit: int, distance: int, ahead: int, *, is_weak: bool = False) -> int:
        """An operand so far back: +inf where there is none for a weak operator, -inf for a strong one."""
        return self._row(codes.DELAY + ahead, operand, 0, unit, distance, 1 if is_weak else -1)
