"""Automata of conjunctions and disjunctions, from those of their operands.

Each operand is compiled and minimised by itself, and joined with the others, the smallest ones first: states
that accept the same runs are merged before they are multiplied with those of the next operand.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush

import numpy as np

from spatial_replay.automata.diagrams import LEAF
from spatial_replay.automata.ltlf import Skeleton
from spatial_replay.automata.minimise import Machine, merged
from spatial_replay.automata.progression import MAX_DECISIONS, MAX_STATES, progressed
from spatial_replay.errors import NoAutomatonError

MAX_PAIRS = 400_000
"""Pairs of decisions that are visited at most to join two automata."""

MAX_PRODUCT = 50_000
"""States that two joined automata have at most, before equivalent ones are merged."""

_FEW_STATES, _FEW_DECISIONS = 1_000, 20_000
"""A formula that takes no more is compiled at once, without a look at its operands."""


def composed(skeleton: Skeleton, propositions: int) -> Machine:
    """Return an automaton of a skeleton over so many propositions.

    Raises:
        NoAutomatonError: it would take more states or decisions than are explored.
    """
    return _Composition(skeleton, propositions).machine(skeleton.root)


class _Composition:
    """The automata of parts of a skeleton."""

    def __init__(self, skeleton: Skeleton, propositions: int) -> None:
        self._skeleton = skeleton
        self._propositions = propositions
        self._known: dict[int, Machine] = {}

    def machine(self, number: int) -> Machine:
        """Return the automaton of a subformula."""
        if number not in self._known:
            self._known[number] = self._compiled(number)
        return self._known[number]

    def _compiled(self, number: int) -> Machine:
        try:
            return self._progressed(number, _FEW_STATES, _FEW_DECISIONS)
        except NoAutomatonError:
            kind, operands = self._skeleton.split(number)
        if len(operands) > 1:
            try:
                return self._joined(operands, kind == "and")
            except NoAutomatonError:
                pass
        return self._progressed(number, MAX_STATES, MAX_DECISIONS)

    def _progressed(self, number: int, states: int, decisions: int) -> Machine:
        return progressed(self._skeleton, self._propositions, number, states=states, decisions=decisions)

    def _joined(self, operands: tuple[int, ...], both: bool) -> Machine:
        machines = [merged(self.machine(each)) for each in operands]
        waiting = [(each.size, number) for number, each in enumerate(machines)]
        heapify(waiting)
        while len(waiting) > 1:
            first, second = (machines[heappop(waiting)[1]] for _ in range(2))
            machines.append(merged(joined(first, second, both)))
            heappush(waiting, (machines[-1].size, len(machines) - 1))
        return machines[-1]


def joined(first: Machine, second: Machine, both: bool) -> Machine:
    """Return the automaton of the runs that both machines accept or, if not `both`, that one of them does.

    Args:
        first, second: machines without equivalent states.

    Raises:
        NoAutomatonError: it takes more than `MAX_PAIRS` or `MAX_PRODUCT`.
    """
    return _Joining(first, second, both).machine()


class _Joining:
    """The pairs of places that are visited."""

    def __init__(self, first: Machine, second: Machine, both: bool) -> None:
        self._machines = first, second
        self._both = both
        self._left, self._right = first.decisions.tolist(), second.decisions.tolist()
        # a trap of one loses for both, and what accepts whatever comes wins for either
        self._decided = _decided(first, not both), _decided(second, not both)
        self._rows: list[tuple[int, int, int]] = []
        self._known: dict[tuple[int, int], int] = {}
        self._states: dict[tuple[int, int], int] = {}
        self._pairs: list[tuple[int, int]] = []

    def machine(self) -> Machine:
        first, second = self._machines
        left, right = first.moves.tolist(), second.moves.tolist()
        start = self._place(first.start, second.start)
        # the list grows while it is iterated: moves lead to new pairs
        moves = [
            ~state if one < 0 else self._place(left[one], right[other])
            for state, (one, other) in enumerate(self._pairs)
        ]
        join = np.logical_and if self._both else np.logical_or
        pairs = np.array(self._pairs, np.int64)
        accepting = join(first.accepting[pairs[:, 0]], second.accepting[pairs[:, 1]])
        accepting[pairs[:, 0] < 0] = not self._both
        rows = np.array(self._rows, np.int64).reshape(-1, 3)
        return Machine(np.array(moves, np.int64), rows, accepting, start)

    def _place(self, one: int, other: int) -> int:
        if one in self._decided[0] or other in self._decided[1]:
            return self._state(-1, -1)
        if one < 0 and other < 0:
            return self._state(~one, ~other)
        place = self._known.get((one, other))
        if place is None:
            place = self._known[one, other] = self._decision(one, other)
            if len(self._known) > MAX_PAIRS:
                raise NoAutomatonError(f"joining its operands takes more than {MAX_PAIRS} steps")
        return place

    def _decision(self, one: int, other: int) -> int:
        before, low, high = self._left[one] if one >= 0 else (LEAF, one, one)
        after, low_other, high_other = self._right[other] if other >= 0 else (LEAF, other, other)
        if before < after:
            low_other = high_other = other
        elif after < before:
            low = high = one
        when_false, when_true = self._place(low, low_other), self._place(high, high_other)
        if when_false == when_true:
            return when_false
        self._rows.append((min(before, after), when_false, when_true))
        return len(self._rows) - 1

    def _state(self, one: int, other: int) -> int:
        """Return the place of a pair of states; (-1, -1) are those in which one has decided already."""
        number = self._states.get((one, other))
        if number is None:
            number = self._states[one, other] = len(self._pairs)
            if number >= MAX_PRODUCT:
                raise NoAutomatonError(f"joining its operands takes more than {MAX_PRODUCT} states")
            self._pairs.append((one, other))
        return ~number


def _decided(machine: Machine, accepts: bool) -> frozenset[int]:
    """Return the places of states that accept, or never accept, whatever comes."""
    stays = machine.moves == ~np.arange(len(machine.moves))
    return frozenset((~np.flatnonzero(stays & (machine.accepting == accepts))).tolist())
