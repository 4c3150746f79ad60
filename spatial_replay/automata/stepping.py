"""Runs of an automaton over many samples at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from spatial_replay.automata.automaton import Automaton
from spatial_replay.compiled import kernel
from spatial_replay.geometry.arrays import Flags, Integers

FALSE, TRUE, UNKNOWN = 0, 1, -1
"""Values of propositions."""

StateSet: TypeAlias = NDArray[np.bool_]
"""(S,), which states a run may be in."""


@dataclass(frozen=True, eq=False)
class Table:
    """The moves of an automaton for the kernels.

    Attributes:
        entries: (S,), as in `Automaton`.
        decisions: (D, 3), as in `Automaton`.
    """

    entries: Integers
    decisions: Integers

    @classmethod
    def of(cls, automaton: Automaton) -> Table:
        """The table of an automaton."""
        decisions = np.array(automaton.decisions, np.int64).reshape(-1, 3)
        return cls(np.array(automaton.entries, np.int64), decisions)

    def states(self, state: int, values: Flags) -> Integers:
        """The state (T,) after each sample, where every proposition is known.

        Args:
            state: that before the first sample.
            values: (P, T), 0 or 1.
        """
        result = np.empty(values.shape[1], np.int64)
        _walk(self.entries, self.decisions, state, values, result)
        return result

    def state_sets(self, states: StateSet, values: Flags) -> NDArray[np.bool_]:
        """The states (T, S) that are possible after each sample.

        Args:
            states: (S,), those before the first sample.
            values: (P, T), 0, 1 or -1 where it is not known.
        """
        result = np.zeros((values.shape[1], len(self.entries)), np.bool_)
        _spread(self.entries, self.decisions, states, values, result)
        return result


@kernel
def _walk(entries: Integers, decisions: Integers, state: int, values: Flags, result: Integers) -> None:
    for t in range(values.shape[1]):
        place = entries[state]
        while place >= 0:
            place = decisions[place, 1 + values[decisions[place, 0], t]]
        state = ~place
        result[t] = state


@kernel
def _spread(
    entries: Integers, decisions: Integers, states: StateSet, values: Flags, result: NDArray[np.bool_]
) -> None:
    seen = np.full(decisions.shape[0], -1, np.int64)
    stack = np.empty(decisions.shape[0] + 2, np.int64)
    before = states
    for t in range(values.shape[1]):
        after = result[t]
        for state in range(before.shape[0]):
            if not before[state]:
                continue
            stack[0] = entries[state]
            height = 1
            while height > 0:
                height -= 1
                place = stack[height]
                if place < 0:
                    after[~place] = True
                    continue
                if seen[place] == t:
                    continue
                seen[place] = t
                value = values[decisions[place, 0], t]
                if value != 1:
                    stack[height] = decisions[place, 1]
                    height += 1
                if value != 0:
                    stack[height] = decisions[place, 2]
                    height += 1
        before = after
