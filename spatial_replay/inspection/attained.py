"""Which leaf a number of a formula is the number of.

Robustness is made of minima and maxima, so each number is that of some leaf at some sample, perhaps with
its sign turned. Where that sample is the newest, comparing numbers finds the leaf, without a walk through
the log.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.spec.formula import Atom, Boolean, Formula, Quantified, iter_nodes


class LeavesBelow(NamedTuple):
    """The leaves below one node, each once for each sign in which it counts.

    Attributes:
        indices: (L,) int64, index among the program's leaves.
        signs: (L,), 1 or -1.
    """

    indices: Integers
    signs: Floats


class Attained(NamedTuple):
    """A leaf at a sample.

    Attributes:
        leaf: index among the program's leaves.
        number: its own number there, its sign not turned.
    """

    leaf: int
    number: float


def leaves_below(formula: Formula, leaves: Sequence[Formula]) -> list[LeavesBelow]:
    """For each node of a formula, by id, what is below it.

    Args:
        leaves: the program's leaves, of which equal ones are one.
    """
    numbers = {_key(leaf): index for index, leaf in enumerate(leaves)}
    nodes = list(iter_nodes(formula))
    found: list[dict[tuple[int, int], None]] = [{} for _ in nodes]
    operands: list[list[int]] = [[] for _ in nodes]
    for identifier, parent, _ in nodes:
        if parent is not None:
            operands[parent].append(identifier)
    for identifier, _, node in reversed(nodes):
        if isinstance(node, Atom | Quantified):
            found[identifier] = {(numbers[_key(node)], 1): None}
        for place, operand in enumerate(operands[identifier]):
            for sign in signs_of(node, place):
                found[identifier].update(dict.fromkeys((leaf, own * sign) for leaf, own in found[operand]))
    return [_columns(list(each)) for each in found]


def attained(below: LeavesBelow, ends: tuple[Floats, Floats], number: float, *, low: bool) -> Attained | None:
    """The first leaf below a node that is what the node is, in one sample.

    Args:
        ends: (A,) low and high end of each of the program's leaves in that sample.
        number: of the node; an infinite one says nothing of a leaf.
        low: whether the number is the low end of the node's interval, or the high one.
    """
    if not np.isfinite(number):
        return None
    lows, highs = (end[below.indices] for end in ends)
    own = np.where((below.signs > 0.0) == low, lows, highs)
    hits = np.flatnonzero(own * below.signs == number)
    if not len(hits):
        return None
    return Attained(int(below.indices[hits[0]]), float(own[hits[0]]) + 0.0)


def _columns(entries: Sequence[tuple[int, int]]) -> LeavesBelow:
    pairs = np.array(entries, np.int64).reshape(-1, 2)
    return LeavesBelow(pairs[:, 0], pairs[:, 1].astype(np.float64))


def signs_of(node: Formula, operand: int) -> tuple[int, ...]:
    """In which signs an operand's number can become that of the node."""
    match node:
        case Boolean(operator="not"):
            return (-1,)
        case Boolean(operator="->") if operand == 0:
            return (-1,)
        case Boolean(operator="xor" | "<->"):
            return (1, -1)
    return (1,)


def _key(leaf: Formula) -> tuple[object, ...]:
    """What makes two leaves one."""
    if isinstance(leaf, Quantified):
        return leaf.quantifier, leaf.variables, leaf.group, leaf.body
    if isinstance(leaf, Atom):
        return (leaf.expression,)
    raise TypeError(f"{leaf!r} is no leaf")
