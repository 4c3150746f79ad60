"""The path from a node to the leaf that decides it, through the operands that attain minima and maxima.

Robustness consists of minima and maxima only, so each number is that of one leaf at one sample, perhaps
negated. The path to it follows one end of the interval (see `End`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
from typing import Protocol, TypeVar

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.offline import OfflineNodes
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.monitor.witness.unfinished import UnfinishedNodes, is_closed, windows_of
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import (
    Boolean,
    BooleanOperator,
    Formula,
    Temporal,
    Truth,
    iter_nodes,
    operands_of,
    operator_of,
)
from spatial_replay.spec.walks import nodes_with_operands
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


@dataclass(frozen=True, slots=True)
class Extremum:
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


@dataclass(frozen=True, slots=True)
class PathNode:
    """A node at a sample on a deciding path.

    Attributes:
        node: its id.
        sample: index among the samples evaluated.
    """

    node: int
    sample: int


@dataclass(frozen=True, slots=True)
class DecidingPath:
    """The path down from a node.

    Attributes:
        steps: at least one. The last is at a leaf, at `true` or `false`, or at an operator without a sample,
            such as an empty window or a next sample beyond the log.
        end: which end of the last node's interval decides.
    """

    steps: tuple[PathNode, ...]
    end: End


class NodeEnds(Protocol):
    """Every node at every sample."""

    def ends(self, node: int) -> tuple[Floats, Floats]:
        """Return the ends (T,) of a node's interval at each sample."""
        ...


def deciding_path(
    formula: Formula,
    done: NodeEnds,
    times_ns: Integers,
    node: int,
    end: End,
    *,
    goes_on: bool = False,
    sample: int = 0,
) -> DecidingPath:
    """Return the path to what decides a node at a sample.

    Ties go to the operand that leads to the earliest sample, then to the first operand; in a window, to the
    earliest sample.

    Args:
        done: every node at every sample of `times_ns` (T,).
        goes_on: whether samples may follow; `done` is then that of `evaluate_unfinished`.
    """
    return _Walk(formula, done, times_ns, goes_on=goes_on).follow(node, sample, end)


class _Walk:
    """The tree of a formula with every node's numbers."""

    def __init__(self, formula: Formula, done: NodeEnds, times_ns: Integers, *, goes_on: bool) -> None:
        self._done = done
        self._times = times_ns
        self._goes_on = goes_on
        tree = nodes_with_operands(formula)
        self._nodes, self._operands = [each for each, _ in tree], [operands for _, operands in tree]

    def follow(self, node: int, sample: int, end: End) -> DecidingPath:
        """Return the path from a node at a sample."""
        here = PathNode(node, sample)
        match self._nodes[node]:
            case Boolean() as boolean:
                extremum = extremum_of(boolean.operator, self._operands[node])
                paths = [
                    self.follow(operand.index, sample, end.turned if operand.negated else end)
                    for operand in chosen(extremum, end, lambda index: self._interval(index, sample))
                ]
                below = min(paths, key=lambda path: path.steps[-1].sample)
            case Temporal() as temporal:
                lasting = self._lasting(node, sample, end) if self._goes_on else None
                taken = lasting or self._taken(temporal, self._operands[node], sample, end)
                if taken is None:
                    return DecidingPath((here,), end)
                below = self.follow(taken.node, taken.sample, end)
            case _:
                return DecidingPath((here,), end)
        return DecidingPath((here, *below.steps), below.end)

    def _interval(self, node: int, sample: int) -> Interval:
        low, high = self._done.ends(node)
        return float(low[sample]), float(high[sample])

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
        formula, left = self._nodes[node], SignedOperand(self._operands[node][0])
        if not isinstance(formula, Temporal) or formula.operator not in ("U", "R"):
            return None
        low, high = self._interval(node, sample)
        if formula.operator == "R":
            left, end, high = SignedOperand(left.index, True), end.turned, -low
        if end is End.LOW or is_closed(formula.bound, self._times)[sample]:
            return None
        lasting = self._ends(left, slice(sample, None))[1]
        return PathNode(left.index, sample + int(np.argmin(lasting))) if lasting.min() == high else None

    def _window(self, formula: Temporal, sample: int) -> range:
        """Return the samples that an operator looks at."""
        begin, end = windows_of(formula, self._times)
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
        node, sample: the id of the response, and the index of the sample at which it should have held.
    """

    condition: str
    response: str
    time_ns: int
    is_condition: bool
    node: int
    sample: int


def short_title(formula: Formula) -> str:
    """Return the name of a formula, or its text, shortened."""
    return formula.name or shortened_formula(format_formula(formula))


def missed_response(
    path: DecidingPath, nodes: Sequence[Formula], done: OfflineNodes | UnfinishedNodes, times_ns: Integers
) -> MissedResponse | None:
    """Return the outermost implication on the path to what violates a formula that failed, if there is one.

    Args:
        nodes: every node of the formula, by id.
    """
    for step, below in pairwise(path.steps):
        node = nodes[step.node]
        if operator_of(node) == "->" and done.ends(step.node)[1][step.sample] < 0.0:
            condition, response = map(short_title, operands_of(node))
            # nodes are numbered in the order of the text
            first = step.node + 1
            after = first + sum(1 for _ in iter_nodes(operands_of(node)[0]))
            time_ns, is_condition = int(times_ns[step.sample]), below.node == first
            return MissedResponse(condition, response, time_ns, is_condition, after, step.sample)
    return None
