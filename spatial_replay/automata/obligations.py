"""Obligations as variables of diagrams.

An *obligation* is a subformula that has to hold in the next sample; a weak one, only if there is a next
sample. Obligations of which each follows from the one before, as those of one unrolled window do, are a
*chain*. Of a chain it is enough to know how many do not hold. That number in binary takes a few variables
where each obligation would take one, and no two diagrams say the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple, TypeAlias

from spatial_replay.automata.diagrams import NO, YES, Diagrams

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
