"""The leaf that gives a node its number, found by comparing numbers instead of walking through the log.

Robustness is made of minima and maxima, so each number is that of some leaf at some sample, perhaps with its
sign turned. If that sample is the newest, `find_leaf` compares the numbers of the leaves there.

Over a whole log, `DecidingLeaves` does the same for Boolean combinations: an operand that is a leaf or
temporal has the number of the sample at which its value last changed, which in most formulas is the sample of
the leaf that decides. Where no number is equal, no leaf is reported.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from spatial_replay.geometry.arrays import Floats, Integers
from spatial_replay.monitor.atoms.delays import look_back
from spatial_replay.monitor.atoms.terms import TraceScene
from spatial_replay.monitor.online.codes import low_and_high
from spatial_replay.monitor.stream import SeriesBlock
from spatial_replay.monitor.witness.atom import deciding_atom
from spatial_replay.monitor.witness.path import End
from spatial_replay.spec.formula import Atom, Boolean, Formula, Outline, Quantified, iter_nodes
from spatial_replay.spec.walks import operand_signs
from spatial_replay.trace.trace import Trace


class LeavesBelow(NamedTuple):
    """The leaves below one node, each once for each sign in which it counts.

    Attributes:
        indices: (L,) int64, index among the program's leaves.
        signs: (L,), 1 or -1.
    """

    indices: Integers
    signs: Floats


class LeafValue(NamedTuple):
    """A leaf at a sample.

    Attributes:
        leaf: index among the program's leaves.
        number: its own number there, its sign not turned.
        end: which end of its interval that is.
        time_ns: of the sample; None where only the number is known.
    """

    leaf: int
    number: float
    end: End
    time_ns: int | None = None


def leaves_below(formula: Formula, leaves: Sequence[Formula]) -> list[LeavesBelow]:
    """Return the leaves below each node of a formula, by id.

    Args:
        leaves: the program's leaves, of which equal ones are one.
    """
    numbers = {leaf_key(leaf): index for index, leaf in enumerate(leaves)}
    nodes = list(iter_nodes(formula))
    found: list[dict[tuple[int, int], None]] = [{} for _ in nodes]
    operands: list[list[int]] = [[] for _ in nodes]
    for identifier, parent, _ in nodes:
        if parent is not None:
            operands[parent].append(identifier)
    for identifier, _, node in reversed(nodes):
        if isinstance(node, Atom | Quantified):
            found[identifier] = {(numbers[leaf_key(node)], 1): None}
        for place, operand in enumerate(operands[identifier]):
            for sign in operand_signs(node, place):
                found[identifier].update(dict.fromkeys((leaf, own * sign) for leaf, own in found[operand]))
    return [_columns(list(each)) for each in found]


def find_leaf(
    below: LeavesBelow, ends: tuple[Floats, Floats], number: float, *, low: bool
) -> LeafValue | None:
    """Return the first leaf below a node that has the node's number, in one sample.

    Args:
        ends: (A,) low and high end of each of the program's leaves in that sample.
        number: of the node; an infinite one identifies no leaf.
        low: whether the number is the low end of the node's interval, or the high one.
    """
    if not np.isfinite(number):
        return None
    lows, highs = (end[below.indices] for end in ends)
    own = np.where((below.signs > 0.0) == low, lows, highs)
    hits = np.flatnonzero(own * below.signs == number)
    if not len(hits):
        return None
    end = End.LOW if (below.signs[hits[0]] > 0.0) == low else End.HIGH
    return LeafValue(int(below.indices[hits[0]]), float(own[hits[0]]) + 0.0, end)


def _columns(entries: Sequence[tuple[int, int]]) -> LeavesBelow:
    pairs = np.array(entries, np.int64).reshape(-1, 2)
    return LeavesBelow(pairs[:, 0], pairs[:, 1].astype(np.float64))


def leaf_key(leaf: Formula) -> tuple[object, ...]:
    """Return what equal leaves have in common."""
    if isinstance(leaf, Quantified):
        return leaf.quantifier, leaf.variables, leaf.group, leaf.body
    if isinstance(leaf, Atom):
        return (leaf.expression,)
    raise TypeError(f"{leaf!r} is not a leaf")


class DecidingLeaves:
    """The operands of some nodes of a formula, each with the leaves at the sample that its value is from.

    Cutting the samples into blocks changes nothing.
    """

    def __init__(self, formula: Formula, below: Sequence[LeavesBelow], nodes: Collection[int]) -> None:
        """Start before the first sample.

        Args:
            below: of each node of the formula, its leaves.
            nodes: ids of those whose leaves may be asked for.
        """
        self._below = below
        self._nodes = [node for _, _, node in iter_nodes(formula)]
        self._operands: list[list[int]] = [[] for _ in self._nodes]
        joined = set(nodes)
        for identifier, parent, _ in iter_nodes(formula):
            if parent is not None:
                self._operands[parent].append(identifier)
                if parent in joined and isinstance(self._nodes[parent], Boolean):
                    joined.add(identifier)
        self._parts = np.array(
            sorted(each for each in joined if not isinstance(self._nodes[each], Boolean)), np.int64
        )
        self._values = np.full(len(self._parts), np.nan)
        self._leaves: dict[int, Floats] = {}

    def extend(self, block: SeriesBlock) -> None:
        """Take in the next samples, at least one."""
        values = block.series[self._parts, 0]
        before = np.concatenate([self._values[:, None], values[:, :-1]], axis=1)
        changes = (values != before) & ~(np.isnan(values) & np.isnan(before))
        self._values = values[:, -1].copy()
        last = values.shape[1] - 1 - changes[:, ::-1].argmax(axis=1)
        changed = np.flatnonzero(changes.any(axis=1))
        # operands that changed together share the numbers of that sample
        samples = {t: block.leaves[:, :, t].copy() for t in set(last[changed].tolist())}
        for part, t in zip(self._parts[changed].tolist(), last[changed].tolist(), strict=True):
            self._leaves[part] = samples[t]

    def find_leaf(self, node: int, ends: Floats, *, low: bool, wide: bool) -> LeafValue | None:
        """Return the leaf that gives an end of a node's interval; None if comparing numbers finds none.

        Args:
            ends: (N, 2), lower and upper end of each node.
            low: whether it is the lower end, or the upper one.
            wide: whether the ends count uncertainty.
        """
        formula, number = self._nodes[node], _end(ends, node, low)
        if not isinstance(formula, Boolean):
            if node not in self._leaves:
                return None
            leaves = self._leaves[node]
            lows, highs = low_and_high(len(leaves), wide=wide)
            return find_leaf(self._below[node], (leaves[lows], leaves[highs]), number, low=low)
        for place, operand in enumerate(self._operands[node]):
            for sign in operand_signs(formula, place):
                is_low = low == (sign > 0)
                if sign * _end(ends, operand, is_low) == number:
                    found = self.find_leaf(operand, ends, low=is_low, wide=wide)
                    if found is not None:
                        return found
        return None


def _end(ends: Floats, node: int, low: bool) -> float:
    return float(ends[node, 0 if low else 1])


_RECENT: Final = 1024
"""Samples before a change in which the object that decides a quantifier is looked for."""


class NewestSamples:
    """The newest samples, in which quantifiers are traced to the objects that decide them.

    Cutting the samples into blocks changes nothing.
    """

    def __init__(self) -> None:
        """Start before the first sample."""
        self._blocks: deque[Trace] = deque()
        self._older = 0

    def extend(self, trace: Trace) -> None:
        """Take in the next samples."""
        while self._blocks and self._older - len(self._blocks[0]) >= _RECENT:
            self._older -= len(self._blocks.popleft())
        self._blocks.append(trace)
        self._older += len(trace)

    def deciding_atom(
        self, leaf: Formula, found: LeafValue, now_ns: int, regions: Mapping[str, Outline]
    ) -> tuple[Atom, float] | None:
        """Return the atom of the objects that give a quantifier its number, with the atom's own number.

        None if the sample is not recent or unknown, if earlier samples would be needed, or if no atom has
        that number.

        Args:
            leaf: with the object of a template.
            now_ns: the time of the sample from which the number is looked back at.
        """
        sample = None if found.time_ns is None else self._sample(found.time_ns, now_ns)
        if sample is None or look_back([leaf]) != (0, 0):
            return None
        decided = deciding_atom(TraceScene(sample, regions), leaf, found.end)
        if decided is None:
            return None
        is_turned = decided.end is not found.end
        number = -found.number if is_turned else found.number
        ends = decided.value, decided.lower if decided.end is End.LOW else decided.upper
        return (decided.atom, number) if number in ends else None

    def _sample(self, time_ns: int, now_ns: int) -> Trace | None:
        between = 0
        for trace in reversed(self._blocks):
            at, now = np.searchsorted(trace.times_ns, [time_ns, now_ns], side="right").tolist()
            between += now - at
            if at:
                is_there = trace.times_ns[at - 1] == time_ns and between < _RECENT
                return trace.slice(at - 1, at) if is_there else None
        return None
