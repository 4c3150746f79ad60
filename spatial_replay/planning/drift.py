"""Where time alone leads: `X` and bounds in samples move an automaton while nothing else changes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, takewhile
from typing import NamedTuple

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.moves import Transition
from spatial_replay.planning.observing import Symbol
from spatial_replay.planning.step import Edge


class Drift(NamedTuple):
    """The states that an automaton goes through if all samples to come say what the newest one does.

    Attributes:
        states: the present one, and each once; it stays in the last one, or nobody knows where it goes.
    """

    states: tuple[int, ...]

    @property
    def edges(self) -> frozenset[Edge]:
        """The moves that time alone makes."""
        return frozenset(pairwise(self.states))

    def along(self, way: Sequence[Transition]) -> tuple[int, ...]:
        """The states to which time alone leads on a way, one after the other; none if its first is not."""
        steps = zip(way, self.states[1:], strict=False)
        return tuple(state for _, state in takewhile(lambda step: step[0].target == step[1], steps))


def drift_of(automaton: Automaton, state: int, symbol: Symbol) -> Drift:
    """Where time alone leads from a state."""
    seen = {state: None}
    after = automaton.step_set({state}, symbol)
    while len(after) == 1 and not after <= seen.keys():
        (state,) = after
        seen[state] = None
        after = automaton.step_set({state}, symbol)
    return Drift(tuple(seen))
