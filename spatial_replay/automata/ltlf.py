"""The temporal skeleton of a formula: LTLf over propositions in negation normal form with unrolled bounds.

A formula that has no automaton is refused with the place of the responsible operator.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import reduce
from typing import Literal, NamedTuple

from spatial_replay.automata.guards import Propositions
from spatial_replay.errors import NoAutomatonError
from spatial_replay.spec.diagnostics import SourceText
from spatial_replay.spec.format import format_bound
from spatial_replay.spec.formula import (
    PAST_OPERATORS,
    Boolean,
    Bound,
    Formula,
    NamedSpec,
    Temporal,
    Truth,
    expand,
    iter_nodes,
    operator_of,
)

_ROUNDING = 1e-6
"""Tolerance of bounds in seconds, samples; decimal bounds and rates have rounding errors."""


def in_samples(bound: Bound, rate_hz: float) -> Bound | None:
    """Convert a bound into samples at a rate; None if no sample is in the window."""
    if bound.unit == "samples":
        return bound
    lower = math.ceil(bound.lower * rate_hz / 1e9 - _ROUNDING)
    upper = None if bound.upper is None else math.floor(bound.upper * rate_hz / 1e9 + _ROUNDING)
    return None if upper is not None and upper < lower else Bound(lower, upper, "samples")


def bounds_in_samples(formula: Formula, rate_hz: float) -> str:
    """Return a sentence on bounds in seconds: "at 30 Hz, `F[0s, 3s]` is `F[0, 90]`"; "" without bounds."""
    sentences: dict[str, None] = {}
    for node in _temporal(formula):
        if node.bound is not None and _counts_seconds(node.bound):
            bound = in_samples(node.bound, rate_hz)
            sentences[f"`{operator_text(node)}` is `{operator_of(node)}{format_bound(bound)}`"] = None
    return f"at {rate_hz:g} Hz, {', '.join(sentences)}" if sentences else ""


def counts_seconds(formula: Formula) -> bool:
    """Return whether a formula has bounds in seconds."""
    return any(node.bound is not None and _counts_seconds(node.bound) for node in _temporal(formula))


def refuse_operators(formula: Formula, source: SourceText | None, rate_hz: float | None = None) -> None:
    """Refuse past operators, and bounds in seconds if the rate is unknown or no sample is in the window.

    Raises:
        NoAutomatonError: names every refused operator.
    """
    faults = []
    for node in _temporal(formula):
        if node.operator in PAST_OPERATORS:
            message = f"`{node.operator}` looks back: there is no automaton for past operators"
            faults.append(obstacle(source, node, message))
        elif node.bound is not None and _counts_seconds(node.bound):
            if rate_hz is None:
                message = f"`{operator_text(node)}` counts seconds, an automaton counts samples"
                remedy = (
                    "for an automaton, bound it in samples, or state the samples a second (--hz, rate_hz)"
                )
                faults.append(obstacle(source, node, message, remedy))
            elif in_samples(node.bound, rate_hz) is None:
                message = f"no sample is in the window of `{operator_text(node)}` at {rate_hz:g} Hz"
                faults.append(obstacle(source, node, message, "for an automaton, widen it"))
    if faults:
        messages = dict.fromkeys(map(str, faults))
        reasons = dict.fromkeys(fault.reason for fault in faults)
        raise NoAutomatonError("\n".join(messages), "; ".join(reasons))


def no_automaton(spec: NamedSpec, source: SourceText | None, reason: str) -> NoAutomatonError:
    """Return the error for a spec that no compiler can compile.

    The error points at the operator with the widest window; without windows, at the whole formula.
    """
    widest_node = max(_temporal(spec.formula), key=_width, default=spec.formula)
    if not _width(widest_node):
        widest_node = _without_names(spec.formula)
    message = f"`{operator_text(widest_node)}` leaves {spec.name} without an automaton: {reason}"
    hint = "for an automaton, write smaller bounds, or split it into several specs"
    return obstacle(source, widest_node, message, hint)


def obstacle(
    source: SourceText | None, node: Formula | None, message: str, remedy: str = ""
) -> NoAutomatonError:
    """Return the error for a node, with its place in the text if `source` and `node` are given."""
    hint = f"it is evaluated all the same{'; ' if remedy else ''}{remedy}"
    if source is None or node is None:
        return NoAutomatonError(f"{message}; {hint}", message)
    return NoAutomatonError(str(source.diagnostic("error", node.span, message, hint)), message)


def operator_text(node: Formula) -> str:
    """Return an operator with its bound, as in the canonical text."""
    bound = node.bound if isinstance(node, Temporal) else None
    return operator_of(node) + ("" if bound is None else format_bound(bound))


def _temporal(formula: Formula) -> Iterator[Temporal]:
    """Yield the temporal operators of a formula, in the order of the text."""
    return (node for _, _, node in iter_nodes(formula) if isinstance(node, Temporal))


def _counts_seconds(bound: Bound) -> bool:
    """Return whether a bound depends on times: all bounds in seconds except [0s, 0s] and [0s, inf]."""
    return bound.unit == "ns" and (bound.lower > 0 or bound.upper not in (0, None))


def _width(node: Formula) -> int:
    """Return the end of a node's window, or the begin of an unbounded window; 0 without a window."""
    bound = node.bound if isinstance(node, Temporal) else None
    return 0 if bound is None else bound.upper or bound.lower


def _without_names(formula: Formula) -> Formula:
    """Replace the name of a spec by the spec's formula; return other formulas unchanged."""
    while isinstance(formula, Boolean) and formula.operator == "spec":
        (formula,) = formula.operands
    return formula


MAX_NODES = 10_000
"""Maximum number of subformulas of a skeleton, after its bounds are unrolled."""

Kind = Literal["false", "true", "literal", "and", "or", "X", "WX", "U", "R"]


class Node(NamedTuple):
    """One subformula.

    Attributes:
        first, second: numbers of the operands. For a literal, `first` is the proposition's number; `second`
            is 1 for a true and 0 for a false proposition.
    """

    kind: Kind
    first: int = 0
    second: int = 0


FALSE, TRUE = 0, 1
"""The numbers of the constants."""


class Skeleton:
    """The distinct subformulas of a formula; an operator comes after its operands.

    Attributes:
        nodes: subformulas, indexed by number.
        root: number of the whole formula.
        chains: mapping from (number of a subformula, whether it is an until) to the number of the subformula
            whose window is one sample longer. A shorter until implies the longer until. A longer release
            implies the shorter release.
    """

    def __init__(
        self,
        formula: Formula,
        propositions: Propositions,
        source: SourceText | None = None,
        rate_hz: float | None = None,
    ) -> None:
        """Unroll a formula.

        Args:
            source: text of the formula, for error messages.
            rate_hz: sampling rate, for bounds in seconds.

        Raises:
            NoAutomatonError: past operators, bounds in seconds without a rate, more than `MAX_NODES`
                subformulas.
        """
        refuse_operators(formula, source, rate_hz)
        self._rate_hz = rate_hz
        self.nodes: list[Node] = []
        self._numbers: dict[Node, int] = {}
        self._propositions = propositions
        self._source = source
        self.chains: dict[tuple[int, bool], int] = {}
        self._formula_numbers: dict[tuple[int, bool], int] = {}
        # messages name operators of the text, not operators of expansions
        self._written_ids = {id(node) for node in _temporal(formula)}
        self._operator: Formula | None = None
        self._unrolled_operator: Formula | None = None
        # the constants come first, so that their numbers are `FALSE` and `TRUE`
        self._node("false"), self._node("true")
        self.root = self._of(formula, True)

    def split(self, number: int) -> tuple[Literal["and", "or"], tuple[int, ...]]:
        """Split a subformula into the operands of a conjunction or disjunction.

        Release distributes over `and` in its right operand: `G (a and b)` is `(G a) and (G b)`. Until, and
        so `F`, distributes over `or`. The result is the subformula alone if it cannot be split.
        """
        kind, first, second = self.nodes[number]
        match kind:
            case "and" | "or":
                return kind, self._operands(kind, number)
            case "R" | "U":
                connective: Literal["and", "or"] = "and" if kind == "R" else "or"
                operands = self._operands(connective, second)
                if len(operands) > 1:
                    return connective, tuple(self._node(kind, first, operand) for operand in operands)
        return "and", (number,)

    def _operands(self, kind: Kind, number: int) -> tuple[int, ...]:
        """Return a conjunction's or disjunction's operands; nested nodes of the same kind are flattened."""
        operands: dict[int, None] = {}
        stack = [number]
        while stack:
            node = self.nodes[stack.pop()]
            if node.kind == kind:
                stack += (node.second, node.first)
            else:
                operands[self._numbers[node]] = None
        return tuple(operands)

    def _of(self, formula: Formula, is_positive: bool) -> int:
        """Return the number of a formula or, if not `is_positive`, of its negation."""
        proposition = self._propositions.literal(formula)
        if proposition is not None:
            number, is_affirmed = proposition
            return self._node("literal", number, int(is_affirmed == is_positive))
        outer_operator = self._operator
        if id(formula) in self._written_ids:
            self._operator = formula
        formula = expand(formula)
        # the formula keeps its expansion in memory, so the id of the expansion stays valid
        formula_key = (id(formula), is_positive)
        if formula_key not in self._formula_numbers:
            self._formula_numbers[formula_key] = self._build(formula, is_positive)
        self._operator = outer_operator
        return self._formula_numbers[formula_key]

    def _build(self, formula: Formula, is_positive: bool) -> int:
        match formula:
            case Truth():
                return TRUE if formula.value == is_positive else FALSE
            case Boolean(operator="not"):
                return self._of(formula.operands[0], not is_positive)
            case Boolean():
                join = self._both if (formula.operator == "and") == is_positive else self._either
                return reduce(join, [self._of(operand, is_positive) for operand in formula.operands])
            case Temporal():
                operands = [self._of(operand, is_positive) for operand in formula.operands]
                return self._temporal(formula, operands, is_positive)
        raise ValueError(f"{formula!r} is not a proposition")

    def _temporal(self, formula: Temporal, operands: list[int], is_positive: bool) -> int:
        self._unrolled_operator = self._operator
        # a negated until is a release, and a negated release is an until (strong)
        is_strong = (formula.operator != "G") == is_positive
        if formula.operator == "X":
            return self._next(operands[0], is_strong)
        left_operand = operands[0] if formula.operator == "U" else TRUE if is_strong else FALSE
        bound = formula.bound
        if bound is not None and _counts_seconds(bound) and self._rate_hz is not None:
            bound = in_samples(bound, self._rate_hz)
        return self._within(left_operand, operands[-1], bound, is_strong)

    def _within(self, left_operand: int, right_operand: int, bound: Bound | None, is_strong: bool) -> int:
        """Unroll an until (`is_strong`) or a release over a window."""
        lower, upper = (0, None) if bound is None else (bound.lower, bound.upper)
        # checked before the loops, which take a step for each sample of the window
        if max(lower, upper or 0) > MAX_NODES:
            raise self._too_large()
        join_left, join_right = (self._both, self._either) if is_strong else (self._either, self._both)
        if upper is None:
            result = self._node("U" if is_strong else "R", left_operand, right_operand)
        else:
            result = right_operand
            for _ in range(upper - lower):
                shorter, result = (
                    result,
                    join_right(right_operand, join_left(left_operand, self._next(result, is_strong))),
                )
                if result != shorter:
                    self.chains.setdefault((shorter, is_strong), result)
        for _ in range(lower):
            result = join_left(left_operand, self._next(result, is_strong))
        return result

    def _next(self, operand: int, is_strong: bool) -> int:
        if operand == (FALSE if is_strong else TRUE):
            return operand
        return self._node("X" if is_strong else "WX", operand)

    def _both(self, first: int, second: int) -> int:
        return self._join("and", first, second, neutral=TRUE, final=FALSE)

    def _either(self, first: int, second: int) -> int:
        return self._join("or", first, second, neutral=FALSE, final=TRUE)

    def _join(self, kind: Literal["and", "or"], first: int, second: int, *, neutral: int, final: int) -> int:
        if first in (neutral, second) or second == final:
            return second
        if second == neutral or first == final:
            return first
        return self._node(kind, first, second)

    def _node(self, kind: Kind, first: int = 0, second: int = 0) -> int:
        node = Node(kind, first, second)
        if kind in ("U", "R") and self.nodes[second][:2] == (kind, first):
            # `G G a` is `G a`; it arises because the text `G a and G b` parses as `G (a and G b)`
            return second
        if node not in self._numbers:
            if len(self.nodes) == MAX_NODES:
                raise self._too_large()
            self._numbers[node] = len(self.nodes)
            self.nodes.append(node)
        return self._numbers[node]

    def _too_large(self) -> NoAutomatonError:
        operator = self._unrolled_operator
        subject = "the formula" if operator is None else f"`{operator_text(operator)}`"
        message = f"with {subject} unrolled into steps, there are more than {MAX_NODES} subformulas"
        return obstacle(self._source, operator, message, "for an automaton, write smaller bounds")
