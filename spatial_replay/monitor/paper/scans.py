"""The table of a formula for `kernel`, and its operators: minima and maxima that skip NaN, scans over runs.

Every number has a mark beside it, 1 if it is lost; a number that depends on a lost one is lost.

A node without temporal operator below is *plain*: its number at a sample is final with that sample. Any other
node's number may change with every later sample. Most formulas need it at the first sample only (`value`); a
node below a temporal operator needs it at all samples, in a *column*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spatial_replay.compiled import inlined, piece
from spatial_replay.geometry.arrays import Flags, Floats, Integers
from spatial_replay.spec.formula import Atom, Boolean, Formula, Quantified, Temporal, Truth, iter_nodes
from spatial_replay.spec.walks import is_spatial

# columns of the table
CODE, FIRST, END, IS_IN_NS, LOW, HIGH, IS_PLAIN, COLUMN, INNER, PAIRS, LEAF = range(11)
WIDTH = 11
NOTHING = -1
"""No upper end, no column, no table of pairs."""

# codes of nodes; a row is a node as written, since Def. 16 gives a number to each
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
        rows: (N, WIDTH): code; begin and end of the node's operands in `operands`; its window; whether it is
            plain; its places in `PaperMemory`; a leaf's number, or the sign of a constant.
        operands: ids of the operands, node after node.
        columns: how many columns are kept.
        pairs: how many tables over pairs of samples are kept.
    """

    rows: Integers
    operands: Integers
    columns: int
    pairs: int


def paper_table(formula: Formula, leaves: Sequence[Atom | Quantified]) -> PaperTable:
    """Compile a formula of `OPERATORS` over these leaves."""
    nodes = [(node, parent) for _, parent, node in iter_nodes(formula)]
    operands: list[list[int]] = [[] for _ in nodes]
    for identifier, (_, parent) in enumerate(nodes):
        if parent is not None:
            operands[parent].append(identifier)
    is_plain = [is_spatial(node) for node, _ in nodes]
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


def _columns(
    nodes: Sequence[tuple[Formula, int | None]], operands: Sequence[Sequence[int]], is_plain: Sequence[bool]
) -> list[bool]:
    """Return which nodes are needed at all samples; parents come before their operands."""
    wanted = [False] * len(nodes)
    for identifier, (node, _) in enumerate(nodes):
        for operand in operands[identifier]:
            if isinstance(node, Temporal):
                wanted[operand] = wanted[identifier] or not is_plain[operand]
            else:
                wanted[operand] = wanted[identifier] and not is_plain[identifier]
    return wanted


def _code(node: Formula, leaves: Sequence[Atom | Quantified]) -> tuple[int, int]:
    """Return a node's code, and its leaf or the sign of its infinity."""
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


@inlined
def least(one: float, other: float) -> float:
    """Return the lesser number, of those not left out; NaN if both are."""
    if np.isnan(one):
        return other
    if np.isnan(other):
        return one
    return min(one, other)


@inlined
def most(one: float, other: float) -> float:
    """Return the greater number, of those not left out; NaN if both are."""
    if np.isnan(one):
        return other
    if np.isnan(other):
        return one
    return max(one, other)


@inlined
def pick(is_least: bool, one: float, other: float) -> float:
    """Return `least` or `most` of two numbers."""
    return least(one, other) if is_least else most(one, other)


@inlined
def combine(code: int, one: float, other: float) -> float:
    """Apply a Boolean operator; for one operand, both are that operand."""
    if code == AND:
        return least(one, other)
    if code == OR:
        return most(one, other)
    if code == NOT:
        return -one
    if code == IMPLIES:
        return most(-one, other)
    if code == XOR:
        return most(least(one, -other), least(-one, other))
    if code == IFF:
        return least(most(-one, other), most(-other, one))
    return one


@piece
def total(
    is_least: bool, numbers: Floats, lost: Flags, first: int, last: int
) -> tuple[float, int]:  # fmt: skip
    """Return the least or the greatest number from `first` to `last`."""
    result, is_lost = np.nan, 0
    for t in range(first, last + 1):
        result = pick(is_least, result, numbers[t])
        is_lost |= lost[t]
    return result, is_lost


@piece
def scan(
    is_least: bool, numbers: Floats, lost: Flags, first: int, last: int, into: Floats, into_lost: Flags
) -> None:
    """Compute, from each sample from `first` on, the least or greatest number up to `last`."""
    result, is_lost = np.nan, 0
    for t in range(last, first - 1, -1):
        result = pick(is_least, result, numbers[t])
        is_lost |= lost[t]
        into[t], into_lost[t] = result, is_lost


@piece
def scan_until(
    left: Floats, left_lost: Flags, right: Floats, right_lost: Flags,
    first: int, last: int, into: Floats, into_lost: Flags,
) -> None:  # fmt: skip
    """Run until from each sample from `first` on to `last`; the left operand depends on no later sample.

    The best over later ends is capped by the left operand here. An end of which everything was left out so
    far takes on the left operand here, which is then as good as any.
    """
    best, is_lost, is_any_left_out = np.nan, 0, False
    for t in range(last, first - 1, -1):
        here = least(right[t], left[t])
        if not np.isnan(left[t]):
            if is_any_left_out:
                best = left[t]
            elif not np.isnan(best):
                best = min(left[t], best)
            is_any_left_out = False
        if np.isnan(here):
            is_any_left_out = True
        best = most(best, here)
        is_lost |= left_lost[t] | right_lost[t]
        into[t], into_lost[t] = best, is_lost


@piece
def scan_until_by_last(
    left: Floats, left_lost: Flags, right: float, right_lost: int,
    first: int, last: int, into: Floats, into_lost: Flags,
) -> None:  # fmt: skip
    """Run until from each sample to `last`, given until to the sample before it."""
    still, is_lost = np.nan, right_lost
    into[last], into_lost[last] = np.nan, 0
    for t in range(last, first - 1, -1):
        still = least(still, left[t])
        is_lost |= left_lost[t]
        into[t] = most(into[t], least(right, still))
        into_lost[t] |= is_lost


@piece
def scan_until_by_pairs(
    still: Floats, still_lost: Flags, starts: Integers, right: Floats, right_lost: Flags,
    first: int, last: int, into: Floats, into_lost: Flags,
) -> None:  # fmt: skip
    """Run until from each sample to `last`, given the least left operand for each beginning and end."""
    into[first : last + 1], into_lost[first : last + 1] = np.nan, 0
    for end in range(first, last + 1):
        for t in range(first, end + 1):
            at = starts[end] + t
            into[t] = most(into[t], least(right[end], still[at]))
            into_lost[t] |= right_lost[end] | still_lost[at]
