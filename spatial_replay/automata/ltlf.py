"""The temporal skeleton of a formula: LTLf over propositions, in negation normal form, bounds unrolled.

A formula without an automaton is refused here, with the place of the operator that is to blame.
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
"""By how many samples a bound in seconds may miss one, since it is a decimal number and so is a rate."""


def in_samples(bound: Bound, rate_hz: float) -> Bound | None:
    """Return a bound in samples, at so many a second; None if no sample is in the window."""
    if bound.unit == "samples":
        return bound
    lower = math.ceil(bound.lower * rate_hz / 1e9 - _ROUNDING)
    upper = None if bound.upper is None else math.floor(bound.upper * rate_hz / 1e9 + _ROUNDING)
    return None if upper is not None and upper < lower else Bound(lower, upper, "samples")


def bounds_in_samples(formula: Formula, rate_hz: float) -> str:
    """Return what bounds in seconds become: "at 30 Hz, `F[0s, 3s]` is `F[0, 90]`"; "" without any."""
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
    """Refuse operators that look back, or count seconds of which it is not known how many samples they have.

    Raises:
        NoAutomatonError: with every operator that does.
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
    """Return the error for a spec that no compiler can compile, at its widest window or at all of it."""
    place = max(_temporal(spec.formula), key=_width, default=spec.formula)
    if not _width(place):
        place = _without_names(spec.formula)
    message = f"`{operator_text(place)}` leaves {spec.name} without an automaton: {reason}"
    hint = "for an automaton, write smaller bounds, or split it into several specs"
    return obstacle(source, place, message, hint)


def obstacle(
    source: SourceText | None, node: Formula | None, message: str, remedy: str = ""
) -> NoAutomatonError:
    """Return the error for a node, with its place if the source is known."""
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
    """Return whether the bound depends on times: not if it is only this sample, or all from this one on."""
    return bound.unit == "ns" and (bound.lower > 0 or bound.upper not in (0, None))


def _width(node: Formula) -> int:
    """Return the number of samples ahead that a node's bound reaches."""
    bound = node.bound if isinstance(node, Temporal) else None
    return 0 if bound is None else bound.upper or bound.lower


def _without_names(formula: Formula) -> Formula:
    """Return the formula that one that only names another spec stands for."""
    while isinstance(formula, Boolean) and formula.operator == "spec":
        (formula,) = formula.operands
    return formula


MAX_NODES = 10_000
"""How many subformulas a skeleton has at most, once its bounds are unrolled."""

Kind = Literal["false", "true", "literal", "and", "or", "X", "WX", "U", "R"]


class Node(NamedTuple):
    """One subformula.

    Attributes:
        first, second: numbers of its operands; of a literal, its proposition and whether it is true (1).
    """

    kind: Kind
    first: int = 0
    second: int = 0


FALSE, TRUE = 0, 1
"""The numbers of the constants."""


class Skeleton:
    """The subformulas of a formula, equal ones once; operands come before what they are operands of.

    Attributes:
        nodes: by number.
        root: the number of the whole formula.
        chains: the same subformula over a window longer by one sample, by the number of the shorter one and
            whether it is an until. A shorter until implies the longer one; for a release it is the reverse.
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
            source: where it stands, for messages.
            rate_hz: how many samples a second has, for bounds in seconds.

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
        self._known: dict[tuple[int, bool], int] = {}
        # messages name the operators of the text, not those of their expansions
        self._written = {id(node) for node in _temporal(formula)}
        self._operator: Formula | None = None
        self._unrolled: Formula | None = None
        self._node("false"), self._node("true")
        self.root = self._of(formula, True)

    def split(self, number: int) -> tuple[Literal["and", "or"], tuple[int, ...]]:
        """Return subformulas whose conjunction or disjunction a subformula is; alone, if there are none.

        `G (a and b)` is `(G a) and (G b)`, and so is whatever holds until released; `F` and until distribute
        over `or`.
        """
        kind, first, second = self.nodes[number]
        match kind:
            case "and" | "or":
                return kind, self._operands(kind, number)
            case "R" | "U":
                over: Literal["and", "or"] = "and" if kind == "R" else "or"
                parts = self._operands(over, second)
                if len(parts) > 1:
                    return over, tuple(self._node(kind, first, part) for part in parts)
        return "and", (number,)

    def _operands(self, kind: Kind, number: int) -> tuple[int, ...]:
        """Return the operands of a conjunction or disjunction, however it is bracketed."""
        operands: dict[int, None] = {}
        stack = [number]
        while stack:
            current = self.nodes[stack.pop()]
            if current.kind == kind:
                stack += (current.second, current.first)
            else:
                operands[self._numbers[current]] = None
        return tuple(operands)

    def _of(self, formula: Formula, positive: bool) -> int:
        """Return the number of a formula, or of its negation."""
        proposition = self._propositions.literal(formula)
        if proposition is not None:
            number, value = proposition
            return self._node("literal", number, int(value == positive))
        outer = self._operator
        if id(formula) in self._written:
            self._operator = formula
        formula = expand(formula)
        key = (id(formula), positive)
        if key not in self._known:
            self._known[key] = self._build(formula, positive)
        self._operator = outer
        return self._known[key]

    def _build(self, formula: Formula, positive: bool) -> int:
        match formula:
            case Truth():
                return TRUE if formula.value == positive else FALSE
            case Boolean(operator="not"):
                return self._of(formula.operands[0], not positive)
            case Boolean():
                join = self._both if (formula.operator == "and") == positive else self._either
                return reduce(join, [self._of(operand, positive) for operand in formula.operands])
            case Temporal():
                operands = [self._of(operand, positive) for operand in formula.operands]
                return self._temporal(formula, operands, positive)
        raise ValueError(f"{formula!r} is not a proposition")

    def _temporal(self, formula: Temporal, operands: list[int], positive: bool) -> int:
        self._unrolled = self._operator
        # in its polarity the node is an until (strong) or a release
        strong = (formula.operator != "G") == positive
        if formula.operator == "X":
            return self._next(operands[0], strong)
        left = operands[0] if formula.operator == "U" else TRUE if strong else FALSE
        bound = formula.bound
        if bound is not None and _counts_seconds(bound) and self._rate_hz is not None:
            bound = in_samples(bound, self._rate_hz)
        return self._within(left, operands[-1], bound, strong)

    def _within(self, left: int, right: int, bound: Bound | None, strong: bool) -> int:
        """Unroll an until, or a release where not `strong`, over a window."""
        lower, upper = (0, None) if bound is None else (bound.lower, bound.upper)
        if max(lower, upper or 0) > MAX_NODES:
            raise self._too_large()
        hold, free = (self._both, self._either) if strong else (self._either, self._both)
        if upper is None:
            result = self._node("U" if strong else "R", left, right)
        else:
            result = right
            for _ in range(upper - lower):
                shorter, result = result, free(right, hold(left, self._next(result, strong)))
                if result != shorter:
                    self.chains.setdefault((shorter, strong), result)
        for _ in range(lower):
            result = hold(left, self._next(result, strong))
        return result

    def _next(self, operand: int, strong: bool) -> int:
        if operand == (FALSE if strong else TRUE):
            return operand
        return self._node("X" if strong else "WX", operand)

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
            # G G a is G a, and so on: `G a and G b` may well be read as G (a and G b)
            return second
        if node not in self._numbers:
            if len(self.nodes) == MAX_NODES:
                raise self._too_large()
            self._numbers[node] = len(self.nodes)
            self.nodes.append(node)
        return self._numbers[node]

    def _too_large(self) -> NoAutomatonError:
        place = self._unrolled
        what = "the formula" if place is None else f"`{operator_text(place)}`"
        message = f"with {what} unrolled into steps, there are more than {MAX_NODES} subformulas"
        return obstacle(self._source, place, message, "for an automaton, write smaller bounds")
