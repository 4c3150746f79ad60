"""Every node of a formula at every sample of a log that may go on.

`evaluate_offline` takes a log as finished: an open `F` has the number of what has been. Values after the last
sample are unknown here, [-inf, +inf], so the numbers at the first sample are those of a monitor. The path
through them leads to the atom that settled a verdict before the log ended.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import TypeAlias

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
    operator_of,
)
from spatial_replay.spec.walks import leaf_key

_Ends = tuple[Floats, Floats]
_Samples: TypeAlias = NDArray[np.bool_]
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
    return UnfinishedNodes(formula, _Evaluator(_columns(order, leaves), times_ns, _is_open))


def evaluate_with_whole_windows(
    formula: Formula, order: Sequence[Atom | Quantified], leaves: Floats, times_ns: Integers
) -> UnfinishedNodes:
    """Evaluate the nodes of a formula over a finished log, but with windows that go on beyond its end.

    Values there are unknown, and only there (see `is_cut`). Arguments as of `evaluate_unfinished`.
    """
    return UnfinishedNodes(formula, _Evaluator(_columns(order, leaves), times_ns, is_cut))


def evaluate_untested(
    formula: Formula,
    order: Sequence[Atom | Quantified],
    antecedents: Floats,
    leaves: Floats,
    times_ns: Integers,
) -> _Ends:
    """Return the ends (T,) of a formula on a finished log, with other leaves in the antecedents of `->`.

    Args:
        antecedents: (C, A, T), the leaves there.
        leaves: (C, A, T), the leaves elsewhere.
    """
    within = _Evaluator(_columns(order, antecedents), times_ns, _is_never_open)
    return _Evaluator(_columns(order, leaves), times_ns, _is_never_open, within).ends(formula)


def _columns(order: Sequence[Atom | Quantified], leaves: Floats) -> dict[object, _Ends]:
    low, high = low_and_high(len(leaves), wide=True)
    return {leaf_key(leaf): (leaves[low, index], leaves[high, index]) for index, leaf in enumerate(order)}


def is_cut(formula: Temporal, times_ns: Integers) -> _Samples:
    """Return (T,), at which samples the end of a log cuts the window of an operator short.

    An operator without an upper bound ends with the log; WX says itself what holds at the last sample.
    """
    bound = formula.bound
    is_bounded = formula.operator == "X" or (bound is not None and bound.upper is not None)
    return _is_open(formula, times_ns) if is_bounded else _is_never_open(formula, times_ns)


def _is_open(formula: Temporal, times_ns: Integers) -> _Samples:
    """Return (T,), at which samples later ones can fall into the window of an operator."""
    if formula.operator in ("X", "WX"):
        return ~is_closed(Bound(1, 1, "samples"), times_ns)
    if formula.operator in FUTURE_OPERATORS:
        return ~is_closed(formula.bound, times_ns)
    return _is_never_open(formula, times_ns)


def _is_never_open(formula: Temporal, times_ns: Integers) -> _Samples:
    return np.zeros(len(times_ns), np.bool_)


def is_closed(bound: Bound | None, times_ns: Integers) -> _Samples:
    """Return (T,), whether no later sample can fall into the window of a future operator at each sample."""
    count = len(times_ns)
    if bound is None or bound.upper is None:
        return np.zeros(count, np.bool_)
    if bound.unit == "samples":
        return np.arange(count) + min(bound.upper, count) < count
    # integers of any size: a time and a duration may add up to more than 64 bits
    span_ns = int(times_ns[-1]) - bound.upper
    return np.arange(count) < bisect_left(times_ns, span_ns + 1)


def windows_of(formula: Temporal, times_ns: Integers) -> tuple[Integers, Integers]:
    """Return the first sample (T,) in an operator's window at each sample, and the one after the last."""
    count = len(times_ns)
    here = np.arange(count, dtype=np.int64)
    is_ahead = formula.operator in FUTURE_OPERATORS
    bound = formula.bound or Bound(0, None, "samples")
    if formula.operator in ("X", "WX", "Y"):
        bound = Bound(1, 1, "samples")
    # as distances from the first sample, and no further than the last: sums stay below 64 bits
    places = here if bound.unit == "samples" else times_ns - times_ns[0]
    furthest = int(places[-1]) + 1
    near = min(bound.lower, furthest)
    far = furthest if bound.upper is None else min(bound.upper, furthest)
    low, high = (places + near, places + far) if is_ahead else (places - far, places - near)
    if bound.unit == "samples":
        return np.clip(low, 0, count), np.clip(high + 1, 0, count)
    begin = np.searchsorted(places, low, side="left").astype(np.int64)
    return begin, np.searchsorted(places, high, side="right").astype(np.int64)


class _Evaluator:
    """The ends of formulas at each sample, each computed once."""

    def __init__(
        self,
        leaves: dict[object, _Ends],
        times_ns: Integers,
        is_open: Callable[[Temporal, Integers], _Samples],
        antecedents: _Evaluator | None = None,
    ) -> None:
        """Begin without any number.

        Args:
            is_open: at which samples what is beyond the end, and anything, can fall into a window.
            antecedents: computes the antecedents of `->`; None if this one does.
        """
        self._leaves = leaves
        self._times = times_ns
        self._is_open = is_open
        self._antecedents = antecedents or self
        # the formulas stay alive, so that no other one takes the id of one
        self._done: dict[int, tuple[Formula, _Ends]] = {}

    def ends(self, formula: Formula) -> _Ends:
        """Return the ends (T,) of a formula's interval at each sample."""
        if id(formula) not in self._done:
            self._done[id(formula)] = formula, self._computed(formula)
        return self._done[id(formula)][1]

    def _computed(self, formula: Formula) -> _Ends:
        if isinstance(formula, Boolean) and formula.operator == "->":
            antecedent, consequent = formula.operands
            low, high = self._antecedents.ends(antecedent)
            return _combined("or", [(-high, -low), self.ends(consequent)])
        expanded = formula if operator_of(formula) == "WX" else expand(formula)
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
        return self._leaves[leaf_key(formula)]

    def _temporal(self, formula: Temporal, operands: Sequence[_Ends]) -> _Ends:
        low, high = self._finished(formula, operands)
        is_open = self._is_open(formula, self._times)
        if formula.operator in ("X", "WX"):
            low[is_open], high[is_open] = -np.inf, np.inf
        elif formula.operator == "G":
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
