"""Which operand a minimum or a maximum takes its number from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

_Number = TypeVar("_Number")

Interval = tuple[float, float]


class End(Enum):
    """Which end of an interval decides.

    The low end shows why a formula is satisfied (it is at least 0), the high end why it is violated. Where
    neither is so, the formula is `OPEN`: followed along the low ends of minima and the high ends of maxima,
    it leads to an operand that is itself open.
    """

    LOW = "low"
    HIGH = "high"
    OPEN = "open"

    @property
    def turned(self) -> End:
        """That of the operand of a negation."""
        return {End.LOW: End.HIGH, End.HIGH: End.LOW, End.OPEN: End.OPEN}[self]

    def of_minimum(self, low: _Number, high: _Number) -> _Number:
        """The end by which a minimum chooses its operand."""
        return high if self is End.HIGH else low

    def of_maximum(self, low: _Number, high: _Number) -> _Number:
        """The end by which a maximum chooses its operand."""
        return low if self is End.LOW else high


@dataclass(frozen=True, slots=True)
class Operand:
    """What enters a minimum or a maximum: number `index` of something, as it is or negated."""

    index: int
    negated: bool = False


@dataclass(frozen=True, slots=True)
class Extremum:
    """A minimum or a maximum of operands, or of others."""

    is_minimum: bool
    operands: tuple[Operand | Extremum, ...]


def extremum_of(operator: str, operands: Sequence[int]) -> Extremum:
    """A Boolean operator over operands of the given numbers, as minima and maxima."""
    plain = tuple(Operand(index) for index in operands)
    first, last = plain[0], plain[-1]
    not_first, not_last = Operand(first.index, True), Operand(last.index, True)
    match operator:
        case "not":
            return Extremum(True, (not_first,))
        case "and" | "spec":
            return Extremum(True, plain)
        case "or":
            return Extremum(False, plain)
        case "->":
            return Extremum(False, (not_first, last))
        case "xor":
            return Extremum(False, (Extremum(True, (first, not_last)), Extremum(True, (not_first, last))))
    return Extremum(True, (Extremum(False, (not_first, last)), Extremum(False, (not_last, first))))


def chosen(part: Operand | Extremum, end: End, interval: Callable[[int], Interval]) -> list[Operand]:
    """The operands that a part takes its number from: one, or several equal ones in their order.

    Args:
        interval: low and high end of each operand, not negated.
    """
    if isinstance(part, Operand):
        return [part]
    choose = end.of_minimum if part.is_minimum else end.of_maximum
    keys = [choose(*_interval(each, interval)) for each in part.operands]
    best = min(keys) if part.is_minimum else max(keys)
    taken = [each for each, key in zip(part.operands, keys, strict=True) if key == best]
    return [operand for each in taken for operand in chosen(each, end, interval)]


def _interval(part: Operand | Extremum, interval: Callable[[int], Interval]) -> Interval:
    if isinstance(part, Operand):
        low, high = interval(part.index)
        return (-high, -low) if part.negated else (low, high)
    lows, highs = zip(*(_interval(each, interval) for each in part.operands), strict=True)
    return (min(lows), min(highs)) if part.is_minimum else (max(lows), max(highs))
