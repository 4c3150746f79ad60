"""Reduced ordered decision diagrams: functions of propositions, equal ones with one number.

A node decides on a variable, the least that the function depends on; a leaf holds a number. With leaves 0
and 1 a diagram is a Boolean function, with states as leaves the moves of an automaton.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from spatial_replay.errors import NoAutomatonError

LEAF = 1 << 60
"""The variable of a leaf: it orders after all others."""


class Decision(NamedTuple):
    """A node; of a leaf, `low` is its number.

    Attributes:
        low, high: the nodes where the variable is false, and true.
    """

    variable: int
    low: int
    high: int


NO, YES = 0, 1
"""The nodes of the Boolean constants, which are leaves 0 and 1."""


class Diagrams:
    """Nodes, each once."""

    def __init__(self, limit: int = LEAF) -> None:
        """Begin with the constants.

        Args:
            limit: more nodes are an error.
        """
        self._nodes: list[Decision] = []
        self._numbers: dict[Decision, int] = {}
        self._chosen: dict[tuple[int, int, int], int] = {}
        self._limit = limit
        self.leaf(0), self.leaf(1)

    def __len__(self) -> int:
        return len(self._nodes)

    def __getitem__(self, node: int) -> Decision:
        return self._nodes[node]

    def leaf(self, number: int) -> int:
        """Return the node of a leaf."""
        return self._add(Decision(LEAF, number, number))

    def decide(self, variable: int, low: int, high: int) -> int:
        """Return the node that decides on a variable, which orders before those of `low` and `high`."""
        return low if low == high else self._add(Decision(variable, low, high))

    def variable(self, variable: int) -> int:
        """Return the function that is true where a variable is."""
        return self._add(Decision(variable, NO, YES))

    def choose(self, condition: int, then: int, otherwise: int) -> int:
        """Return the function that is `then` where a condition holds, and `otherwise` elsewhere."""
        if condition == YES or then == otherwise:
            return then
        if condition == NO:
            return otherwise
        if then == YES and otherwise == NO:
            return condition
        key = (condition, then, otherwise)
        result = self._chosen.get(key)
        if result is None:
            nodes = self._nodes
            variable = min(nodes[condition].variable, nodes[then].variable, nodes[otherwise].variable)
            lows, highs = zip(*(self.branches(node, variable) for node in key), strict=True)
            result = self._chosen[key] = self.decide(variable, self.choose(*lows), self.choose(*highs))
        return result

    def both(self, first: int, second: int) -> int:
        """Return the conjunction."""
        return self.choose(first, second, NO)

    def either(self, first: int, second: int) -> int:
        """Return the disjunction."""
        return self.choose(first, YES, second)

    def complement(self, node: int) -> int:
        """Return the negation."""
        return self.choose(node, NO, YES)

    def branches(self, node: int, variable: int) -> tuple[int, int]:
        """Return the cofactors of a function: with a variable false, and true. None before it may matter."""
        decision = self._nodes[node]
        return decision[1:] if decision.variable == variable else (node, node)

    def _add(self, decision: Decision) -> int:
        number = self._numbers.get(decision)
        if number is None:
            if len(self._nodes) >= self._limit:
                raise NoAutomatonError(f"the automaton takes more than {self._limit} decisions")
            number = self._numbers[decision] = len(self._nodes)
            self._nodes.append(decision)
        return number


def copied(
    source: Diagrams, target: Diagrams, variables: int, leaf: Callable[[int], int]
) -> Callable[[int], int]:
    """Return a function that copies nodes from one collection into another, with other leaves.

    Args:
        variables: nodes that decide on none of the first so many variables count as leaves.
        leaf: the number of the leaf in the target for such a node of the source.
    """
    known: dict[int, int] = {}

    def copy(node: int) -> int:
        if node not in known:
            variable, low, high = source[node]
            if variable < variables:
                known[node] = target.decide(variable, copy(low), copy(high))
            else:
                known[node] = target.leaf(leaf(node))
        return known[node]

    return copy
