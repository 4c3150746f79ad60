"""The built-in compiler: formula progression, one state for each distinct remainder of a formula.

A state is what has to hold from the next sample on: a monotone combination of *obligations*, each a
subformula that must hold in the next sample or, if weak, only if there is a next sample. States are decision
diagrams over obligations, so equal ones are one. Reading a sample replaces each obligation by what its
subformula requires of that sample and, as obligations, of the next.

Obligations of which each implies the next one, as those of one unrolled window do, are a *chain*. Of a chain
it is enough to know how many do not hold. That number in binary takes a few variables where each obligation
would take one, and different diagrams mean different functions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple, TypeAlias

from spatial_replay.automata.diagrams import NO, YES, Diagrams, copied
from spatial_replay.automata.ltlf import FALSE, TRUE, Skeleton
from spatial_replay.automata.minimise import Machine, machine_of
from spatial_replay.errors import NoAutomatonError

Obligation: TypeAlias = tuple[int, bool]
"""A subformula's number, and whether there has to be a next sample."""


class Chain(NamedTuple):
    """Obligations, each of which is implied by the one before.

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
    """The variables of obligations, allotted to a chain when the first of its members is needed."""

    def __init__(self, diagrams: Diagrams, first: int, longer: Mapping[Obligation, int]) -> None:
        """Begin without obligations.

        Args:
            first: the first variable to allot.
            longer: as `chains` of a skeleton.
        """
        self._diagrams = diagrams
        self._first = first
        self._chains: list[Chain] = []
        self._members = _members(longer)
        self._places: dict[Obligation, tuple[Chain, int]] = {}

    def diagram(self, obligation: Obligation) -> int:
        """Return the diagram of an obligation: true where it is met."""
        if obligation not in self._places:
            self._begin(obligation)
        chain, index = self._places[obligation]
        node = YES
        for bit in range(chain.bits):
            # it holds iff at most the members before it do not: the count in the bits is at most its index
            branches = (YES, node) if index >> bit & 1 else (node, NO)
            node = self._diagrams.decide(chain.first + chain.bits - 1 - bit, *branches)
        return node

    def chain(self, variable: int) -> Chain:
        """Return the chain that a variable is one of."""
        return self._chains[variable - self._first]

    def cases(self, chain: Chain, node: int) -> list[tuple[int, int]]:
        """Split a function that decides on a chain first into cases.

        Returns:
            Pairs of a count and the function that is left where fewer than so many of the chain's members do
            not hold, and not as few as in the pair before.
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
        """Yield the functions that are left, each with the number of counts in a row that it holds for."""
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
    """Return for each obligation that is in a chain, the chain's members."""
    later = {(number, strong) for (_, strong), number in longer.items()}
    chains: dict[Obligation, tuple[int, ...]] = {}
    for begin, strong in longer:
        if (begin, strong) in later:
            continue
        members = [begin]
        while (after := longer.get((members[-1], strong))) is not None and (after, strong) not in chains:
            members.append(after)
        # until by a sooner deadline implies until by a later one; holding longer implies holding shorter
        ordered = tuple(members if strong else reversed(members))
        chains.update({(each, strong): ordered for each in members})
    return chains


MAX_STATES = 5000
"""States explored at most, before equivalent ones are merged."""

MAX_DECISIONS = 150_000
"""How many nodes the decision diagrams may have."""


def progressed(
    skeleton: Skeleton,
    propositions: int,
    number: int | None = None,
    *,
    states: int = MAX_STATES,
    decisions: int = MAX_DECISIONS,
) -> Machine:
    """Return an automaton of a skeleton over so many propositions.

    Args:
        number: the subformula that it is of; without it, the whole formula.
        states, decisions: how many it takes at most.

    Raises:
        NoAutomatonError: it would take more.
    """
    root = skeleton.root if number is None else number
    try:
        return _Progression(skeleton, propositions, states, decisions).machine(root)
    except RecursionError:
        raise NoAutomatonError("the automaton takes decisions that are nested too deeply") from None


class _Progression:
    """The states of a skeleton, explored from the first one."""

    def __init__(self, skeleton: Skeleton, propositions: int, states: int, decisions: int) -> None:
        self._skeleton = skeleton
        self._propositions = propositions
        self._most = states
        self._diagrams = Diagrams(decisions)
        self._obligations = Obligations(self._diagrams, propositions, skeleton.chains)
        self._now: dict[int, int] = {FALSE: NO, TRUE: YES}
        self._next: dict[int, int] = {NO: NO, YES: YES}

    def machine(self, root: int) -> Machine:
        states: dict[int, int] = {}
        waiting: list[int] = []

        def number(node: int) -> int:
            if node not in states:
                if len(waiting) == self._most:
                    raise NoAutomatonError(f"the automaton takes more than {self._most} states")
                states[node] = len(waiting)
                waiting.append(node)
            return states[node]

        result = Diagrams()
        copy = copied(self._diagrams, result, self._propositions, number)
        start = copy(self._read(root))
        # the list grows while it is iterated: moves lead to new states
        moves = [copy(self._after(node)) for node in waiting]
        return machine_of(result, moves, [self._accepts(node) for node in waiting], start)

    def _read(self, number: int) -> int:
        """Return what a subformula requires of this sample and, as obligations, of the next."""
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
        """Return the states that follow a state, under decisions on propositions."""
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
        """Return whether nothing is left to hold if the run has ended."""
        while node not in (NO, YES):
            variable, low, high = self._diagrams[node]
            # at the end strong obligations fail, and weak ones hold
            node = high if self._obligations.chain(variable).strong else low
        return node == YES
