"""A formula's nodes as the page lists them, and their numbers at the samples that it has."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np

from spatial_replay.annotate.requirements import requirements_of
from spatial_replay.annotate.specification import unit_of
from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.result import SpecResult
from spatial_replay.monitor.sentences import divisor_of
from spatial_replay.monitor.verdict import final_verdict
from spatial_replay.report.compact import Packing
from spatial_replay.spec.format import format_formula
from spatial_replay.spec.formula import Boolean, Formula, Temporal, iter_nodes, operands_of, operator_of
from spatial_replay.text import with_unit

MOST_NODES: Final = 400
"""Nodes of a tree that a page shows, at most."""
_LONGEST: Final = 400
"""Characters after which the text of a node is cut."""
_PLACE: Final = "…"


def shown_nodes(formula: Formula) -> tuple[int, ...]:
    """Return the ids of the nodes on the page, in order: all of them or, of a large tree, the uppermost."""
    nodes = list(iter_nodes(formula))
    if len(nodes) <= MOST_NODES:
        return tuple(range(len(nodes)))
    depth: list[int] = []
    for _, parent, _ in nodes:
        depth.append(0 if parent is None else depth[parent] + 1)
    uppermost = sorted(range(len(nodes)), key=lambda identifier: (depth[identifier], identifier))
    return tuple(sorted(uppermost[:MOST_NODES]))


def initial_nodes(formula: Formula) -> frozenset[int]:
    """Return the ids of the nodes that count at the first sample only: no temporal operator is above them."""
    initial: set[int] = set()
    formulas: list[Formula] = []
    for identifier, parent, node in iter_nodes(formula):
        formulas.append(node)
        if parent is None or (parent in initial and not isinstance(formulas[parent], Temporal)):
            initial.add(identifier)
    return frozenset(initial)


def tree_value(
    formula: Formula,
    robustness: Floats,
    final: Floats,
    relations: frozenset[str],
    units: Mapping[str, str],
    calls: Mapping[int, str],
) -> list[Mapping[str, Any]]:
    """Return the shown nodes, each with its text and its final verdict.

    Args:
        formula: with the object that it is about in place of a template's parameter.
        robustness: (N,), each node's value on the whole log.
        final: (N, 2), lower and upper end of each node for the finished log.
        units: those that are declared.
        calls: of nodes that are a `def` with its arguments, as the file writes them.
    """
    shown, initial = shown_nodes(formula), initial_nodes(formula)
    place = {identifier: index for index, identifier in enumerate(shown)}
    return [
        {
            "id": identifier,
            "parent": None if parent is None else place[parent],
            "name": node.name or "",
            "head": _cut(calls.get(identifier) or _head(node, relations)),
            "text": _cut(format_formula(node, relations=relations)),
            "unit": unit_of(node, units),
            "divisor": divisor_of(node),
            "initial": identifier in initial,
            "verdict": str(final_verdict(*final[identifier].tolist())),
            "value": final_text(float(robustness[identifier]), *final[identifier].tolist()),
        }
        for identifier, parent, node in iter_nodes(formula)
        if identifier in place
    ]


def requirement_values(result: SpecResult, samples: Integers, packing: Packing) -> list[Mapping[str, Any]]:
    """Return the requirements of a formula (see `annotate.requirements`) whose nodes are shown.

    Args:
        samples: (S,) indices of those that the page has.
    """
    place = {identifier: index for index, identifier in enumerate(shown_nodes(result.formula))}
    settles = result.semantics == "ltlf"
    return [
        {
            "node": place[requirement.node],
            "is_condition": requirement.is_condition,
            "is_invariant": requirement.is_invariant,
            "obligation": requirement.obligation
            and {"node": place[requirement.obligation.node], "sign": requirement.obligation.sign},
            "standing": packing.add(requirement.standing(result.series, samples), "u1"),
        }
        for requirement in requirements_of(result.formula, result.object, settles=settles)
        if requirement.node in place
    ]


def final_text(robustness: float, lower: float, upper: float, unit: str = "") -> str:
    """Return a node's final robustness with its unit, or the ends of its interval."""
    if math.isnan(robustness) or not (lower == upper == robustness):
        if math.isnan(lower):
            return "" if math.isnan(robustness) else with_unit(robustness, unit)
        return f"{with_unit(lower, unit)} … {with_unit(upper, unit)}"
    return with_unit(robustness, unit)


def named_nodes(formula: Formula) -> tuple[int, ...]:
    """Return the nodes that have curves: the root and the named nodes among those shown."""
    shown = set(shown_nodes(formula))
    return tuple(
        identifier
        for identifier, parent, node in iter_nodes(formula)
        if identifier in shown and (parent is None or node.name)
    )


def series_of(series: Floats, formula: Formula, samples: Integers) -> Floats:
    """Return the numbers (nodes, 4, samples) of the shown nodes at some samples."""
    return np.asarray(series[list(shown_nodes(formula))][:, :, samples])


def _head(node: Formula, relations: frozenset[str]) -> str:
    """Return a node's text with dots for its operands."""
    if isinstance(node, Boolean):
        return operator_of(node)
    text = format_formula(node, relations=relations)
    for operand in _operand_texts(node, relations):
        for written in (f"({operand})", operand):
            if written in text:
                text = text.replace(written, _PLACE, 1)
                break
    return text


def _operand_texts(node: Formula, relations: frozenset[str]) -> Iterator[str]:
    for operand in operands_of(node):
        yield format_formula(operand, relations=relations)


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1].rstrip()}…"
