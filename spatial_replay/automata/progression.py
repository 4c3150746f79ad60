"""The compiler of our own: what a formula asks of the samples still to come, state by state.

A state is what is left to hold from the next sample on: a monotone combination of *obligations*, each a
subformula that must hold there, or (weak) must hold unless the run has ended. As a decision diagram over
obligations, equal ones are one state. Reading a sample replaces each obligation by what its subformula says
of that sample and, in obligations, of the next.
"""

from __future__ import annotations

from spatial_replay.automata.diagrams import NO, YES, Diagrams, copied
from spatial_replay.automata.machine import Machine
from spatial_replay.automata.obligations import Obligations
from spatial_replay.automata.skeleton import FALSE, TRUE, Skeleton
from spatial_replay.errors import NoAutomatonError

MAX_STATES = 5000
"""How many states are followed at most, before equivalent ones are joined."""

MAX_DECISIONS = 150_000
"""How many nodes the decision diagrams may have."""


def progressed(skeleton: Skeleton, propositions: int) -> Machine:
    """The automaton of a skeleton over so many propositions.

    Raises:
        NoAutomatonError: it would take more than `MAX_STATES` or `MAX_DECISIONS`.
    """
    try:
        return _Progression(skeleton, propositions).machine()
    except RecursionError:
        raise NoAutomatonError("the automaton takes decisions that are nested too deeply") from None


class _Progression:
    """The states of a skeleton, as they are found."""

    def __init__(self, skeleton: Skeleton, propositions: int) -> None:
        self._skeleton = skeleton
        self._propositions = propositions
        self._diagrams = Diagrams(MAX_DECISIONS)
        self._obligations = Obligations(self._diagrams, propositions, skeleton.chains)
        self._now: dict[int, int] = {FALSE: NO, TRUE: YES}
        self._next: dict[int, int] = {NO: NO, YES: YES}

    def machine(self) -> Machine:
        states: dict[int, int] = {}
        waiting: list[int] = []

        def number(node: int) -> int:
            if node not in states:
                if len(waiting) == MAX_STATES:
                    raise NoAutomatonError(f"the automaton takes more than {MAX_STATES} states")
                states[node] = len(waiting)
                waiting.append(node)
            return states[node]

        result = Diagrams()
        copy = copied(self._diagrams, result, self._propositions, number)
        start = copy(self._read(self._skeleton.root))
        # the list grows as moves lead to states that are new
        moves = tuple(copy(self._after(node)) for node in waiting)
        return Machine(result, moves, tuple(map(self._accepts, waiting)), start)

    def _read(self, number: int) -> int:
        """What a subformula says of this sample and, in obligations, of the next."""
        if number not in self._now:
            self._now[number] = self._reading(number)
        return self._now[number]

    def _reading(self, number: int) -> int:
        diagrams = self._diagrams
        kind, first, second = self._skeleton.nodes[number]
        match kind:
            case "literal":
                variable = diagrams.variable(first)
                return variable if second else diagrams.complement(variable)
            case "and":
                return diagrams.both(self._read(first), self._read(second))
            case "or":
                return diagrams.either(self._read(first), self._read(second))
            case "X" | "WX":
                return self._obligations.diagram((first, kind == "X"))
            case "U":
                later = diagrams.both(self._read(first), self._obligations.diagram((number, True)))
                return diagrams.either(self._read(second), later)
            case "R":
                later = diagrams.either(self._read(first), self._obligations.diagram((number, False)))
                return diagrams.both(self._read(second), later)
        raise ValueError(kind)

    def _after(self, node: int) -> int:
        """What is left of a state after a sample: the states, under decisions on propositions."""
        if node not in self._next:
            chain = self._obligations.chain(self._diagrams[node].variable)
            *cases, (_, rest) = self._obligations.cases(chain, node)
            result = self._after(rest)
            for below, rest in reversed(cases):
                obliged = self._read(chain.members[below - 1])
                result = self._diagrams.choose(obliged, self._after(rest), result)
            self._next[node] = result
        return self._next[node]

    def _accepts(self, node: int) -> bool:
        """Whether nothing is left to hold if the run has ended."""
        while node not in (NO, YES):
            variable, low, high = self._diagrams[node]
            # of strong obligations none is met then, of weak ones each
            node = high if self._obligations.chain(variable).strong else low
        return node == YES
