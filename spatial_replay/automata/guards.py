"""Guards: what lets a transition be taken, as a few cubes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from spatial_replay.automata.diagrams import NO, YES, Diagrams
from spatial_replay.automata.propositions import Proposition
from spatial_replay.errors import NoAutomatonError

Literal: TypeAlias = tuple[int, bool]
"""A proposition's number, and whether it has to be true."""

Cube: TypeAlias = tuple[Literal, ...]
"""Literals that all have to hold, by proposition; without any, it always does."""

Guard: TypeAlias = tuple[Cube, ...]
"""Cubes of which one has to hold."""


MAX_CUBES = 100_000
"""How many cubes all guards of an automaton have together."""


class Covers:
    """Functions as disjunctions of cubes, of which none can be left out and no literal of one.

    They are those of Minato and Morreale (1992): equal functions have equal cubes.
    """

    def __init__(self, diagrams: Diagrams) -> None:
        """Of functions that are nodes of some diagrams."""
        self._diagrams = diagrams
        self._known: dict[tuple[int, int], tuple[tuple[Cube, ...], int]] = {}
        self._cubes = 0

    def guard(self, node: int) -> Guard:
        """The cubes of a function.

        Raises:
            NoAutomatonError: they, and those before, are more than `MAX_CUBES`.
        """
        cubes = self._between(node, node)[0]
        self._count(len(cubes))
        return tuple(sorted(cubes))

    def _count(self, cubes: int) -> None:
        self._cubes += cubes
        if self._cubes > MAX_CUBES:
            raise NoAutomatonError(f"the guards of the automaton take more than {MAX_CUBES} cubes")

    def _between(self, lower: int, upper: int) -> tuple[tuple[Cube, ...], int]:
        """Cubes that hold at least where `lower` does and at most where `upper` does, and their function."""
        if lower == NO:
            return (), NO
        if upper == YES:
            return ((),), YES
        key = (lower, upper)
        if key not in self._known:
            self._known[key] = self._split(lower, upper)
        return self._known[key]

    def _split(self, lower: int, upper: int) -> tuple[tuple[Cube, ...], int]:
        diagrams = self._diagrams
        variable = min(diagrams[lower].variable, diagrams[upper].variable)
        low_0, low_1 = diagrams.branches(lower, variable)
        high_0, high_1 = diagrams.branches(upper, variable)
        cubes_0, covered_0 = self._between(diagrams.both(low_0, diagrams.complement(high_1)), high_0)
        cubes_1, covered_1 = self._between(diagrams.both(low_1, diagrams.complement(high_0)), high_1)
        left = diagrams.either(
            diagrams.both(low_0, diagrams.complement(covered_0)),
            diagrams.both(low_1, diagrams.complement(covered_1)),
        )
        cubes, covered = self._between(left, diagrams.both(high_0, high_1))
        all_cubes = (
            *(((variable, False), *cube) for cube in cubes_0),
            *(((variable, True), *cube) for cube in cubes_1),
            *cubes,
        )
        if len(all_cubes) > MAX_CUBES:
            self._count(len(all_cubes))
        decided = diagrams.decide(variable, covered_0, covered_1)
        return all_cubes, diagrams.either(decided, covered)


def guard_words(guard: Guard, propositions: Sequence[Proposition]) -> str:
    """A guard as a sentence of the specification language."""
    if guard == ((),):
        return "true"
    return " or ".join(_cube_words(cube, propositions, alone=len(guard) == 1) for cube in guard)


def _cube_words(cube: Cube, propositions: Sequence[Proposition], *, alone: bool) -> str:
    text = " and ".join(propositions[number].literal(value) for number, value in cube)
    return text if alone or len(cube) == 1 else f"({text})"
