"""The compiler of our own: what a formula asks of the samples still to come, state by state.

A state is what is left to hold from the next sample on: a monotone combination of *obligations*, each a
subformula that must hold there, or (weak) must hold unless the run has ended. As a decision diagram over
obligations, equal ones are one state. Reading a sample replaces each obligation by what its subformula says
of that sample and, in obligations, of the next.

Obligations as variables of diagrams.

An *obligation* is a subformula that has to hold in the next sample; a weak one, only if there is a next
sample. Obligations of which each follows from the one before, as those of one unrolled window do, are a
*chain*. Of a chain it is enough to know how many do not hold. That number in binary takes a few variables
where each obligation would take one, and no two diagrams say the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple, TypeAlias

from spatial_replay.automata.diagrams import NO, YES, Diagrams, copied
from spatial_replay.automata.ltlf import FALSE, TRUE, Skeleton
from spatial_replay.automata.minimise import Machine
from spatial_replay.errors import NoAutomatonError

Obligation: TypeAlias = tuple[int, bool]
"""A subformula's number, and whether there has to be a next sample."""


class Chain(NamedTuple):
    """Obligations, each of which follows from the one before.

    Attributes:
        members: numbers of their subformulas.
        strong: whether there has to be a next sample.
        first: the first of the variables that hold, as a number in binary, how many members do not hold.
        bits: how many variables these are; the most significant bit comes first.
    """

    members: tuple[int, ...]
    strong: bool
    first: int
    bits: int


class Obligations:
    """The variables of obligations, given to a chain when the first of its members is asked for."""

    def __init__(self, diagrams: Diagrams, first: int, longer: Mapping[Obligation, int]) -> None:
        """Before any obligation.

        Args:
            first: the first variable to give away.
            longer: as `chains` of a skeleton.
        """
        self._diagrams = diagrams
        self._first = first
        self._chains: list[Chain] = []
        self._members = _members(longer)
        self._places: dict[Obligation, tuple[Chain, int]] = {}

    def diagram(self, obligation: Obligation) -> int:
        """Whether an obligation is to be met."""
        if obligation not in self._places:
            self._begin(obligation)
        chain, index = self._places[obligation]
        node = YES
        for bit in range(chain.bits):
            # it holds iff no more than those before it do not
            branches = (YES, node) if index >> bit & 1 else (node, NO)
            node = self._diagrams.decide(chain.first + chain.bits - 1 - bit, *branches)
        return node

    def chain(self, variable: int) -> Chain:
        """The chain that a variable is one of."""
        return self._chains[variable - self._first]

    def cases(self, chain: Chain, node: int) -> list[tuple[int, int]]:
        """What is left of a function that decides on a chain first.

        Gives pairs: fewer than so many of the chain's members do not hold, and not as few as in the pair
        before; what then is left.
        """
        found: list[tuple[int, int]] = []
        below = 0
        for count, rest in self._rests(chain, node, 0):
            below += count
            if found and found[-1][1] == rest:
                found.pop()
            found.append((below, rest))
        return found

    def _rests(self, chain: Chain, node: int, bit: int) -> Iterator[tuple[int, int]]:
        """What is left for so many numbers, one stretch of numbers after the other."""
        if self._diagrams[node].variable >= chain.first + chain.bits:
            yield 1 << (chain.bits - bit), node
            return
        for branch in self._diagrams.branches(node, chain.first + bit):
            yield from self._rests(chain, branch, bit + 1)

    def _begin(self, obligation: Obligation) -> None:
        number, strong = obligation
        members = self._members.get(obligation, (number,))
        bits = len(members).bit_length()
        chain = Chain(members, strong, self._first + len(self._chains), bits)
        self._chains += [chain] * bits
        self._places.update({(each, strong): (chain, index) for index, each in enumerate(members)})


def _members(longer: Mapping[Obligation, int]) -> dict[Obligation, tuple[int, ...]]:
    """For each obligation that is in a chain, the chain's members."""
    later = {(number, strong) for (_, strong), number in longer.items()}
    chains: dict[Obligation, tuple[int, ...]] = {}
    for begin, strong in longer:
        if (begin, strong) in later:
            continue
        members = [begin]
        while (after := longer.get((members[-1], strong))) is not None and (after, strong) not in chains:
            members.append(after)
        # a sooner deadline implies a later one, a longer time without fail a shorter one
        ordered = tuple(members if strong else reversed(members))
        chains.update({(each, strong): ordered for each in members})
    return chains


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
