"""The tree of a formula as a table for `kernel`, which evaluates Def. 16 on every prefix.

A node without temporal operator below is *plain*: its number at a sample is settled once the sample is there.
Any other node's number at a sample may change with every further sample. Most formulas need it at the first
sample alone (`value`); a node below a temporal operator needs it at all samples, in a *column*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.geometry.arrays import Integers
from spatial_replay.spec.formula import (
    Atom,
    Boolean,
    Formula,
    Quantified,
    Temporal,
    Truth,
    iter_nodes,
    operands_of,
)

# columns of the table
CODE, FIRST, END, IS_IN_NS, LOW, HIGH, IS_PLAIN, COLUMN, INNER, PAIRS, LEAF = range(11)
WIDTH = 11
NOTHING = -1
"""No upper end, no column, no table of pairs."""

# codes of nodes
LEAF_NODE, TRUTH = 0, 1
NOT, AND, OR, XOR, IMPLIES, IFF, SAME = 2, 3, 4, 5, 6, 7, 8
NEXT, EVENTUALLY, ALWAYS, UNTIL = 9, 10, 11, 12

_BOOLEAN_CODES = {"not": NOT, "and": AND, "or": OR, "xor": XOR, "->": IMPLIES, "<->": IFF, "spec": SAME}
_TEMPORAL_CODES = {"X": NEXT, "F": EVENTUALLY, "G": ALWAYS, "U": UNTIL}
OPERATORS = frozenset(_TEMPORAL_CODES)
"""The temporal operators that there are."""


@dataclass(frozen=True, eq=False)
class PaperTable:
    """A formula's nodes, by id.

    Attributes:
        rows: (N, WIDTH): code; where the node's operands begin and end in `operands`; its window; whether it
            is plain; its places in what `PaperMemory` keeps; a leaf's number, or the sign of a constant.
        operands: ids of the operands, node after node.
        columns: how many columns are kept.
        pairs: how many tables over pairs of samples are kept.
    """

    rows: Integers
    operands: Integers
    columns: int
    pairs: int


def paper_table(formula: Formula, leaves: Sequence[Atom | Quantified]) -> PaperTable:
    """The table of a formula of `OPERATORS` over these leaves."""
    nodes = [(node, parent) for _, parent, node in iter_nodes(formula)]
    operands: list[list[int]] = [[] for _ in nodes]
    for identifier, (_, parent) in enumerate(nodes):
        if parent is not None:
            operands[parent].append(identifier)
    is_plain = [_is_plain(node) for node, _ in nodes]
    has_column = _columns(nodes, operands, is_plain)
    rows = np.zeros((len(nodes), WIDTH), np.int64)
    columns = pairs = begin = 0
    for identifier, (node, _) in enumerate(nodes):
        row, own = rows[identifier], operands[identifier]
        row[[CODE, LEAF]] = _code(node, leaves)
        row[[FIRST, END]] = begin, begin + len(own)
        row[IS_PLAIN] = is_plain[identifier]
        row[[HIGH, COLUMN, INNER, PAIRS]] = NOTHING
        begin += len(own)
        if has_column[identifier]:
            row[COLUMN], columns = columns, columns + 1
        if isinstance(node, Temporal):
            if node.bound is not None:
                upper = NOTHING if node.bound.upper is None else node.bound.upper
                row[[IS_IN_NS, LOW, HIGH]] = node.bound.unit == "ns", node.bound.lower, upper
            is_until_nested = node.operator == "U" and not is_plain[own[-1]]
            if has_column[identifier] and row[LOW] == 0 and row[HIGH] == NOTHING:
                row[INNER] = row[COLUMN]
            elif has_column[identifier] or is_until_nested:
                row[INNER], columns = columns, columns + 1
            if has_column[identifier] and is_until_nested and not is_plain[own[0]]:
                row[PAIRS], pairs = pairs, pairs + 1
    return PaperTable(rows, np.array([i for own in operands for i in own], np.int64), columns, pairs)


def _is_plain(formula: Formula) -> bool:
    return not isinstance(formula, Temporal) and all(map(_is_plain, operands_of(formula)))


def _columns(
    nodes: Sequence[tuple[Formula, int | None]], operands: Sequence[Sequence[int]], is_plain: Sequence[bool]
) -> list[bool]:
    """Which nodes are wanted at all samples; parents come before their operands."""
    wanted = [False] * len(nodes)
    for identifier, (node, _) in enumerate(nodes):
        for operand in operands[identifier]:
            if isinstance(node, Temporal):
                wanted[operand] = wanted[identifier] or not is_plain[operand]
            else:
                wanted[operand] = wanted[identifier] and not is_plain[identifier]
    return wanted


def _code(node: Formula, leaves: Sequence[Atom | Quantified]) -> tuple[int, int]:
    """A node's code, and which leaf it is or which sign of infinity."""
    match node:
        case Truth():
            return TRUTH, 1 if node.value else -1
        case Boolean():
            return _BOOLEAN_CODES[node.operator], 0
        case Temporal():
            return _TEMPORAL_CODES[node.operator], 0
        case _:
            return LEAF_NODE, _leaf_number(node, leaves)


def _leaf_number(node: Atom | Quantified, leaves: Sequence[Atom | Quantified]) -> int:
    for number, leaf in enumerate(leaves):
        if isinstance(node, Atom):
            if isinstance(leaf, Atom) and leaf.expression == node.expression:
                return number
        elif isinstance(leaf, Quantified) and _meaning(leaf) == _meaning(node):
            return number
    raise ValueError(f"{node!r} is none of the leaves")


def _meaning(leaf: Quantified) -> tuple[object, ...]:
    return leaf.quantifier, leaf.variables, leaf.group, leaf.body
