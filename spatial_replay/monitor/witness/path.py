"""The path from a node to the leaf that decides it, through the operands that attain minima and maxima.

Robustness consists of minima and maxima only, so each number is that of one leaf at one sample, perhaps
negated. The path to it follows one end of the interval (see `End`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from spatial_replay.geometry.arrays import Floats
from spatial_replay.monitor.atoms.terms import Bindings
from spatial_replay.monitor.offline import OfflineNodes, is_closed, windows_of
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Boolean,
    BooleanOperator,
    Formula,
    Temporal,
    Truth,
    operands_of,
    operator_of,
)
from spatial_replay.spec.walks import substitute
from spatial_replay.text import shortened_formula

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

    @classmethod
    def of(cls, verdict: Verdict) -> End:
        """Return the end that decides a verdict."""
        return {Verdict.SATISFIED: cls.LOW, Verdict.VIOLATED: cls.HIGH}.get(verdict, cls.OPEN)

    @property
    def turned(self) -> End:
        """The end for the operand of a negation."""
        return {End.LOW: End.HIGH, End.HIGH: End.LOW, End.OPEN: End.OPEN}[self]

    def of_minimum(self, low: _Number, high: _Number) -> _Number:
        """Return the numbers by which a minimum chooses its operand."""
        return high if self is End.HIGH else low

    def of_maximum(self, low: _Number, high: _Number) -> _Number:
        """Return the numbers by which a maximum chooses its operand."""
        return low if self is End.LOW else high


@dataclass(frozen=True, slots=True)
class SignedOperand:
    """An operand of a minimum or a maximum, by index, possibly negated."""

    index: int
    negated: bool = False


class Extremum(NamedTuple):
    """A minimum or a maximum of operands or of other extrema."""

    is_minimum: bool
    operands: tuple[SignedOperand | Extremum, ...]


def extremum_of(operator: BooleanOperator, operands: Sequence[int]) -> SignedOperand | Extremum:
    """Return a Boolean operator over operands of the given numbers, as minima and maxima."""
    # stand-ins, because equal operands may be one object and still are two places in the text
    stand_ins = tuple(Truth(True) for _ in operands)
    numbers = {id(each): number for each, number in zip(stand_ins, operands, strict=True)}
    formula = Boolean(operator, stand_ins)
    return _normal_form(formula.expansion or formula, numbers, negated=False)


def _normal_form(formula: Formula, numbers: Mapping[int, int], *, negated: bool) -> SignedOperand | Extremum:
    if id(formula) in numbers:
        return SignedOperand(numbers[id(formula)], negated)
    operator = operator_of(formula)
    if operator == "not":
        return _normal_form(operands_of(formula)[0], numbers, negated=not negated)
    operands = tuple(_normal_form(each, numbers, negated=negated) for each in operands_of(formula))
    return Extremum((operator == "and") != negated, operands)


def chosen(
    part: SignedOperand | Extremum, end: End, interval: Callable[[int], Interval]
) -> list[SignedOperand]:
    """Return the operands that attain an extremum: one, or several equal ones in their order.

    Args:
        interval: low and high end of each operand, not negated.
    """
    if isinstance(part, SignedOperand):
        return [part]
    choose = end.of_minimum if part.is_minimum else end.of_maximum
    keys = [choose(*_interval(each, interval)) for each in part.operands]
    best = min(keys) if part.is_minimum else max(keys)
    taken = [each for each, key in zip(part.operands, keys, strict=True) if key == best]
    return [operand for each in taken for operand in chosen(each, end, interval)]


def _interval(part: SignedOperand | Extremum, interval: Callable[[int], Interval]) -> Interval:
    if isinstance(part, SignedOperand):
        low, high = interval(part.index)
        return (-high, -low) if part.negated else (low, high)
    lows, highs = zip(*(_interval(each, interval) for each in part.operands), strict=True)
    return (min(lows), min(highs)) if part.is_minimum else (max(lows), max(highs))


class PathNode(NamedTuple):
    """A node at a sample on a deciding path.

    Attributes:
        node: its id.
        sample: index among the samples evaluated.
    """

    node: int
    sample: int


class DecidingPath(NamedTuple):
    """The path down from a node.

    Attributes:
        steps: at least one. The last is at a leaf, at `true` or `false`, or at an operator without a sample,
            such as an empty window or a next sample beyond the log.
        end: which end of the last node's interval decides.
    """

    steps: tuple[PathNode, ...]
    end: End


def deciding_path(done: OfflineNodes, node: int, end: End, *, sample: int = 0) -> DecidingPath:
    """Return the path to what decides a node at a sample.

    Ties go to the operand that leads to the earliest sample, then to the first operand; in a window, to the
    earliest sample.
    """
    return _Walk(done).follow(node, sample, end)


class _Walk:
    """The tree of a formula with every node's numbers."""

    def __init__(self, done: OfflineNodes) -> None:
        self._done = done

    def follow(self, node: int, sample: int, end: End) -> DecidingPath:
        """Return the path from a node at a sample."""
        here, (formula, operands) = PathNode(node, sample), self._done.tree[node]
        match formula:
            case Boolean():
                extremum = extremum_of(formula.operator, operands)
                paths = [
                    self.follow(operand.index, sample, end.turned if operand.negated else end)
                    for operand in chosen(extremum, end, lambda index: self._done.interval(index, sample))
                ]
                below = min(paths, key=lambda path: path.steps[-1].sample)
            case Temporal():
                lasting = self._lasting(node, sample, end) if self._done.goes_on else None
                taken = lasting or self._taken(formula, operands, sample, end)
                if taken is None:
                    return DecidingPath((here,), end)
                below = self.follow(taken.node, taken.sample, end)
            case _:
                return DecidingPath((here,), end)
        return DecidingPath((here, *below.steps), below.end)

    def _ends(self, operand: SignedOperand, samples: slice) -> tuple[Floats, Floats]:
        low, high = (column[samples] for column in self._done.ends(operand.index))
        return (-high, -low) if operand.negated else (low, high)

    def _taken(self, formula: Temporal, operands: Sequence[int], sample: int, end: End) -> PathNode | None:
        """Return the operand and sample that an operator takes its number from; None for an empty window."""
        *_, right = operands
        window = self._window(formula, sample)
        if not len(window):
            return None
        match formula.operator:
            case "G" | "H" | "WX":
                return self._extreme(SignedOperand(right), window, end, is_minimum=True)
            case "F" | "O" | "X" | "Y":
                return self._extreme(SignedOperand(right), window, end, is_minimum=False)
            case "R":
                left, right = operands
                return self._until(
                    SignedOperand(left, True), SignedOperand(right, True), sample, window, end.turned
                )
            case "W":
                return self._weak_until(operands, sample, window, end)
        left, right = operands
        is_ahead = formula.operator == "U"
        return self._until(SignedOperand(left), SignedOperand(right), sample, window, end, is_ahead=is_ahead)

    def _lasting(self, node: int, sample: int, end: End) -> PathNode | None:
        """Return where the left operand of an until, that later samples may still fulfil, was least so far.

        None if the samples so far decide the until.
        """
        formula, operands = self._done.tree[node]
        if not isinstance(formula, Temporal) or formula.operator not in ("U", "R"):
            return None
        left, (low, high) = SignedOperand(operands[0]), self._done.interval(node, sample)
        if formula.operator == "R":
            left, end, high = SignedOperand(left.index, True), end.turned, -low
        if end is End.LOW or is_closed(formula.bound, self._done.times_ns)[sample]:
            return None
        lasting = self._ends(left, slice(sample, None))[1]
        return PathNode(left.index, sample + int(np.argmin(lasting))) if lasting.min() == high else None

    def _window(self, formula: Temporal, sample: int) -> range:
        """Return the samples that an operator looks at."""
        begin, end = windows_of(formula, self._done.times_ns)
        return range(int(begin[sample]), int(end[sample]))

    def _extreme(self, operand: SignedOperand, window: range, end: End, *, is_minimum: bool) -> PathNode:
        low, high = self._ends(operand, slice(window.start, window.stop))
        if is_minimum:
            return PathNode(operand.index, window[int(np.argmin(end.of_minimum(low, high)))])
        return PathNode(operand.index, window[int(np.argmax(end.of_maximum(low, high)))])

    def _until(
        self,
        left: SignedOperand,
        right: SignedOperand,
        sample: int,
        window: range,
        end: End,
        *,
        is_ahead: bool = True,
    ) -> PathNode:
        """Return what decides an until or, looking back, a since."""
        span = slice(sample, window.stop) if is_ahead else slice(window.start, sample + 1)
        lefts, rights = self._ends(left, span), self._ends(right, slice(window.start, window.stop))
        kept = [_least_between(each, is_ahead=is_ahead) for each in lefts]
        inside = slice(window.start - span.start, window.stop - span.start)
        low, high = (np.minimum(each, then[inside]) for each, then in zip(rights, kept, strict=True))
        at = window[int(np.argmax(end.of_maximum(low, high)))]
        right_key = float(end.of_minimum(*rights)[at - window.start])
        between = range(sample, at) if is_ahead else range(at + 1, sample + 1)
        left_key = end.of_minimum(*lefts)[between.start - span.start : between.stop - span.start]
        first = [PathNode(left.index, between[int(np.argmin(left_key))])] if len(between) else []
        least = float(left_key.min()) if len(between) else np.inf
        if right_key == least:
            return min([*first, PathNode(right.index, at)], key=lambda step: step.sample)
        return first[0] if least < right_key else PathNode(right.index, at)

    def _weak_until(self, operands: Sequence[int], sample: int, window: range, end: End) -> PathNode:
        """Return what decides a weak until: the greater of `phi U psi` and `G phi`."""
        left, right = map(SignedOperand, operands)
        inside = slice(window.start, window.stop)
        lefts, rights = self._ends(left, slice(sample, window.stop)), self._ends(right, inside)
        kept = [_least_between(each, is_ahead=True)[window.start - sample :] for each in lefts]
        until = [float(np.max(np.minimum(*pair))) for pair in zip(rights, kept, strict=True)]
        always = [float(np.min(each)) for each in self._ends(left, inside)]
        keys = [float(end.of_maximum(np.array(low), np.array(high))) for low, high in (until, always)]
        if keys[0] >= keys[1]:
            return self._until(left, right, sample, window, end)
        return self._extreme(left, window, end, is_minimum=True)


def _least_between(column: Floats, *, is_ahead: bool) -> Floats:
    """Return the least of a column from its near end to before each place; +inf at the near end."""
    ordered = column if is_ahead else column[::-1]
    least = np.minimum.accumulate(np.concatenate([[np.inf], ordered[:-1]]))
    return least if is_ahead else least[::-1]


@dataclass(frozen=True, slots=True)
class MissedResponse:
    """An implication on the path to the deciding atom that failed: its condition held, its response did not.

    Attributes:
        condition, response: their names, or their texts, shortened.
        time_ns: of the sample at which the condition held.
        is_condition: whether the deciding atom is in the condition.
    """

    condition: str
    response: str
    time_ns: int
    is_condition: bool


def short_title(formula: Formula) -> str:
    """Return the name of a formula, or its text, shortened."""
    return formula.name or shortened_formula(format_formula(formula))


def missed_response(
    path: DecidingPath, done: OfflineNodes, bindings: Bindings = MappingProxyType({})
) -> tuple[MissedResponse | None, DecidingPath | None]:
    """Return the outermost implication that failed on the path to what violates a formula, if there is one.

    If its condition decided, the path to what came closest to fulfilling its response comes with it.

    Args:
        bindings: the objects that variables stand for.
    """
    for step, below in pairwise(path.steps):
        node, operands = done.tree[step.node]
        if operator_of(node) == "->" and done.ends(step.node)[1][step.sample] < 0.0:
            condition, response = (short_title(substitute(each, bindings)) for each in operands_of(node))
            time_ns, is_condition = int(done.times_ns[step.sample]), below.node == operands[0]
            closest = deciding_path(done, operands[1], End.HIGH, sample=step.sample) if is_condition else None
            return MissedResponse(condition, response, time_ns, is_condition), closest
    return None, None
