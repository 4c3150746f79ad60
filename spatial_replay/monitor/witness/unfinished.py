"""Every node of a formula at every sample of a log that may go on.

`evaluate_offline` takes a log as finished: an open `F` has the number of what has been. Here whatever comes
after the last sample is anything, [-inf, +inf], so that the numbers at the first sample are those of a
monitor, and the path through them leads to what settled a verdict before the log ended.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.offline import evaluate_offline
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.spec.formula import (
    FUTURE_OPERATORS,
    Atom,
    Boolean,
    Bound,
    Formula,
    Quantified,
    Signal,
    Temporal,
    Truth,
    expand,
    iter_nodes,
    operands_of,
)

_Ends = tuple[Floats, Floats]
_STAND_INS = tuple(Atom(name, "signal", Signal(name)) for name in ("first", "second"))


class UnfinishedNodes:
    """Every node at every sample, each computed when it is asked for."""

    def __init__(self, formula: Formula, evaluator: _Evaluator) -> None:
        self._nodes = [node for _, _, node in iter_nodes(formula)]
        self._evaluator = evaluator

    def ends(self, node: int) -> tuple[Floats, Floats]:
        """Return the ends (T,) of a node's interval at each sample, with uncertainty."""
        return self._evaluator.ends(self._nodes[node])


def evaluate_unfinished(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers
) -> UnfinishedNodes:
    """Evaluate the nodes of a formula over samples that others may follow.

    Args:
        order: which leaf is which.
        leaves: (C, A, T), their intervals (see `leaf_values`).
        times_ns: (T,), increasing; T at least 1.
    """
    low, high = low_and_high(len(leaves), wide=True)
    columns = {_key(leaf): (leaves[low, index], leaves[high, index]) for index, leaf in enumerate(order)}
    return UnfinishedNodes(formula, _Evaluator(columns, times_ns))


def is_closed(bound: Bound | None, times_ns: Integers) -> NDArray[np.bool_]:
    """Return (T,), whether no later sample can fall into the window of a future operator at each sample."""
    count = len(times_ns)
    if bound is None or bound.upper is None:
        return np.zeros(count, np.bool_)
    if bound.unit == "samples":
        return np.arange(count) + min(bound.upper, count) < count
    # integers of any size: a time and a duration may add up to more than 64 bits
    span_ns = int(times_ns[-1]) - bound.upper
    return np.arange(count) < bisect_left(times_ns, span_ns + 1)


def _key(leaf: Formula) -> tuple[object, ...]:
    """Return what equal leaves have in common."""
    if isinstance(leaf, Quantified):
        return leaf.quantifier, leaf.variables, leaf.group, leaf.body
    return (leaf.expression,) if isinstance(leaf, Atom) else (leaf,)


class _Evaluator:
    """The ends of formulas at each sample, each computed once."""

    def __init__(self, leaves: dict[tuple[object, ...], _Ends], times_ns: Integers) -> None:
        self._leaves = leaves
        self._times = times_ns
        # the formulas stay alive, so that no other one takes the id of one
        self._done: dict[int, tuple[Formula, _Ends]] = {}

    def ends(self, formula: Formula) -> _Ends:
        """Return the ends (T,) of a formula's interval at each sample."""
        if id(formula) not in self._done:
            self._done[id(formula)] = formula, self._computed(formula)
        return self._done[id(formula)][1]

    def _computed(self, formula: Formula) -> _Ends:
        expanded = expand(formula)
        if expanded is not formula:
            return self.ends(expanded)
        operands = [self.ends(operand) for operand in operands_of(formula)]
        match formula:
            case Truth():
                constant = np.full(len(self._times), np.inf if formula.value else -np.inf)
                return constant, constant
            case Boolean():
                return _combined(formula.operator, operands)
            case Temporal():
                return self._temporal(formula, operands)
        return self._leaves[_key(formula)]

    def _temporal(self, formula: Temporal, operands: Sequence[_Ends]) -> _Ends:
        low, high = self._finished(formula, operands)
        if formula.operator not in FUTURE_OPERATORS:
            return low, high
        if formula.operator == "X":
            low[-1], high[-1] = -np.inf, np.inf
            return low, high
        is_open = ~is_closed(formula.bound, self._times)
        if formula.operator == "G":
            low[is_open] = -np.inf
        elif formula.operator == "F":
            high[is_open] = np.inf
        else:
            # a later sample may fulfil it, as far as the left operand has lasted up to now
            lasting = np.minimum.accumulate(operands[0][1][::-1])[::-1]
            high[is_open] = np.maximum(high, lasting)[is_open]
        return low, high

    def _finished(self, formula: Temporal, operands: Sequence[_Ends]) -> _Ends:
        """Return the ends where no sample follows, from those of the operands."""
        stand_ins = _STAND_INS[: len(operands)]
        single = Temporal(formula.operator, stand_ins, formula.bound)
        leaves = np.stack([np.stack(column) for column in zip(*operands, strict=True)])
        low, high = evaluate_offline(single, stand_ins, leaves, self._times).ends(0)
        return low.copy(), high.copy()


def _combined(operator: str, operands: Sequence[_Ends]) -> _Ends:
    lows, highs = zip(*operands, strict=True)
    match operator:
        case "not":
            return -highs[0], -lows[0]
        case "and":
            return np.minimum.reduce(lows), np.minimum.reduce(highs)
        case _:
            return np.maximum.reduce(lows), np.maximum.reduce(highs)
