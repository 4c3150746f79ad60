"""The compiler of our own: what a formula asks of the samples still to come, state by state.

A state is what is left to hold from the next sample on: a monotone combination of *obligations*, each a
subformula that must hold there, or (weak) must hold unless the run has ended. As a decision diagram over
obligations, equal ones are one state. Reading a sample replaces each obligation by what its subformula says
of that sample and, in obligations, of the next.
"""

from __future__ import annotations

from contextlib import suppress

from spatial_replay.automata.diagrams import NO, YES, Diagrams, copied
from spatial_replay.automata.machine import Machine
from spatial_replay.automata.skeleton import FALSE, TRUE, Skeleton
from spatial_replay.errors import NoAutomatonError

MAX_STATES = 1000
"""How many states are followed at most, before equivalent ones are joined."""

MAX_DECISIONS = 150_000
"""How many nodes the decision diagrams may have."""

_MOST_CHAINED = 250
"""With more obligations from unrolled windows, diagrams that relate them would nest too deeply."""


def progressed(skeleton: Skeleton, propositions: int, *, related: bool | None = None) -> Machine:
    """The automaton of a skeleton over so many propositions.

    Args:
        related: whether states leave out obligations that follow from others: with deadlines, that may take
            far fewer states, but larger diagrams. By default, only if it does not go without.

    Raises:
        NoAutomatonError: it would take more than `MAX_STATES` or `MAX_DECISIONS`.
    """
    if related is None:
        if not 0 < len(skeleton.chains) <= _MOST_CHAINED:
            related = False
        else:
            with suppress(NoAutomatonError):
                return progressed(skeleton, propositions, related=False)
            related = True
    try:
        return _Progression(skeleton, propositions, related=related).machine()
    except RecursionError:
        raise NoAutomatonError("the automaton takes decisions that are nested too deeply") from None


class _Progression:
    """One attempt.

    Where obligations from one unrolled window are *related*, states do not differ by those that follow from
    others: a sooner deadline implies a later one. That takes larger diagrams, and often far fewer states.
    """

    def __init__(self, skeleton: Skeleton, propositions: int, *, related: bool) -> None:
        self._skeleton = skeleton
        self._propositions = propositions
        self._diagrams = Diagrams(MAX_DECISIONS)
        self._obligations: dict[tuple[int, bool], int] = {}
        self._asked: list[tuple[int, bool]] = []
        self._now: dict[int, int] = {FALSE: NO, TRUE: YES}
        self._next: dict[int, int] = {NO: NO, YES: YES}
        self._consistent = self._consequences() if related else YES

    def machine(self) -> Machine:
        states: dict[int, int] = {}
        waiting: list[int] = []

        def number(node: int) -> int:
            node = self._diagrams.both(node, self._consistent)
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

    def _consequences(self) -> int:
        """What always holds between obligations from one unrolled window."""
        chains = self._skeleton.chains
        diagrams, result = self._diagrams, YES
        for shorter, strong in chains:
            # one after the other, which keeps diagrams small
            self._obligation(shorter, strong)
        for (shorter, strong), longer in reversed(chains.items()):
            if (longer, strong) in self._obligations:
                pair = self._obligation(shorter, strong), self._obligation(longer, strong)
                sooner, later = pair if strong else pair[::-1]
                result = diagrams.both(result, diagrams.choose(sooner, later, YES))
        return result

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
                return self._obligation(first, kind == "X")
            case "U":
                later = diagrams.both(self._read(first), self._obligation(number, True))
                return diagrams.either(self._read(second), later)
            case "R":
                later = diagrams.either(self._read(first), self._obligation(number, False))
                return diagrams.both(self._read(second), later)
        raise ValueError(kind)

    def _obligation(self, number: int, strong: bool) -> int:
        """That a subformula holds in the next sample; unless `strong`, only if there is one."""
        key = (number, strong)
        if key not in self._obligations:
            self._obligations[key] = self._propositions + len(self._asked)
            self._asked.append(key)
        return self._diagrams.variable(self._obligations[key])

    def _after(self, node: int) -> int:
        """What is left of a state after a sample: the states, under decisions on propositions."""
        if node not in self._next:
            variable, low, high = self._diagrams[node]
            obliged = self._read(self._asked[variable - self._propositions][0])
            self._next[node] = self._diagrams.choose(obliged, self._after(high), self._after(low))
        return self._next[node]

    def _accepts(self, node: int) -> bool:
        """Whether nothing is left to hold if the run has ended."""
        while node not in (NO, YES):
            variable, low, high = self._diagrams[node]
            node = low if self._asked[variable - self._propositions][1] else high
        return node == YES
