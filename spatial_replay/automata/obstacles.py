"""What keeps a formula from having an automaton, told with its place."""

from __future__ import annotations

from collections.abc import Iterator

from spatial_replay.errors import NoAutomatonError
from spatial_replay.spec.faults import Source
from spatial_replay.spec.format import format_bound
from spatial_replay.spec.formula import (
    PAST_OPERATORS,
    Boolean,
    Bound,
    Formula,
    NamedSpec,
    Temporal,
    iter_nodes,
    operator_of,
)


def refuse_operators(formula: Formula, source: Source | None) -> None:
    """That no operator looks back or counts seconds.

    Raises:
        NoAutomatonError: with every operator that does.
    """
    faults = []
    for node in _temporal(formula):
        if node.operator in PAST_OPERATORS:
            message = f"`{node.operator}` looks back: there is no automaton for past operators"
            faults.append(obstacle(source, node, message))
        elif node.bound is not None and _counts_seconds(node.bound):
            message = f"`{written(node)}` counts seconds, an automaton counts samples"
            faults.append(obstacle(source, node, message, "for an automaton, bound it in samples"))
    if faults:
        told, reasons = dict.fromkeys(map(str, faults)), dict.fromkeys(fault.reason for fault in faults)
        raise NoAutomatonError("\n".join(told), "; ".join(reasons))


def no_automaton(spec: NamedSpec, source: Source | None, reason: str) -> NoAutomatonError:
    """The error for a spec that no compiler is up to; its widest window is blamed, or else all of it."""
    place = max(_temporal(spec.formula), key=_width, default=spec.formula)
    if not _width(place):
        place = _unnamed(spec.formula)
    message = f"`{written(place)}` leaves {spec.name} without an automaton: {reason}"
    hint = "for an automaton, write smaller bounds, or split it into several specs"
    return obstacle(source, place, message, hint)


def obstacle(source: Source | None, node: Formula | None, message: str, remedy: str = "") -> NoAutomatonError:
    """The error for what stands at a node; where the source is known, with its place."""
    hint = f"it is evaluated all the same{'; ' if remedy else ''}{remedy}"
    if source is None or node is None:
        return NoAutomatonError(f"{message}; {hint}", message)
    return NoAutomatonError(str(source.diagnostic("error", node.span, message, hint)), message)


def written(node: Formula) -> str:
    """An operator with its bound, as in the canonical text."""
    bound = node.bound if isinstance(node, Temporal) else None
    return operator_of(node) + ("" if bound is None else format_bound(bound))


def _temporal(formula: Formula) -> Iterator[Temporal]:
    """Its temporal operators, in the order of the text."""
    return (node for _, _, node in iter_nodes(formula) if isinstance(node, Temporal))


def _counts_seconds(bound: Bound) -> bool:
    """Whether the bound depends on times: not if it is only this sample, or all from this one on."""
    return bound.unit == "ns" and (bound.lower > 0 or bound.upper not in (0, None))


def _width(node: Formula) -> int:
    """How many samples ahead a node's bound reaches."""
    bound = node.bound if isinstance(node, Temporal) else None
    return 0 if bound is None else bound.upper or bound.lower


def _unnamed(formula: Formula) -> Formula:
    """What a formula that only names another spec stands for."""
    while isinstance(formula, Boolean) and formula.operator == "spec":
        (formula,) = formula.operands
    return formula
