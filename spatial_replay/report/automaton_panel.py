"""An automaton as a drawing, and where a run is in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.dot_hoa import size_words, state_words
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.schemas.AutomatonState_pb2 import AutomatonState

MOST_STATES: Final = 60
"""States that a page draws, at most: those of the run, then those nearest to the start."""
_MOST_MOVES: Final = 300
_LONGEST_GUARD: Final = 300
_SWEEPS: Final = 4


@dataclass(frozen=True, eq=False)
class StatePath:
    """The states of a run after each of some samples.

    Attributes:
        times_ns: (T,) int64.
        codes: (T,) int64, index into `sets`.
        sets: states that the run may be in.
    """

    times_ns: Integers
    codes: Integers
    sets: tuple[tuple[int, ...], ...]


class StatePathCollector:
    """Collects the states of one result from its messages as they come."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        self._codes: list[int] = []
        self._sets: dict[tuple[int, ...], int] = {}

    def add(self, message: AutomatonState) -> None:
        """Take in the next message."""
        self._times_ns.append(message.time_ns)
        self._codes.append(self._sets.setdefault(tuple(message.states), len(self._sets)))

    @property
    def path(self) -> StatePath:
        """The path so far."""
        times_ns, codes = np.array(self._times_ns, np.int64), np.array(self._codes, np.int64)
        return StatePath(times_ns, codes, tuple(self._sets))


def automaton_value(automaton: Automaton, path: StatePath) -> Mapping[str, Any]:
    """Return an automaton as the page draws it: states with their places, transitions with their guards."""
    shown = _shown_states(automaton, path)
    places = _places(automaton, shown)
    visited = _visited(path)
    moves = [move for move in automaton.transitions if move.source in places and move.target in places]
    moves.sort(key=lambda move: move.source not in visited)
    return {
        "summary": size_words(automaton),
        "left_out": len(automaton.states) - len(shown),
        "states": [
            {
                "number": state,
                "at": places[state],
                "about": state_words(automaton, state),
                "accepting": state in automaton.accepting,
                "lost": state not in automaton.can_accept,
                "won": state not in automaton.can_reject,
            }
            for state in shown
        ],
        "moves": [
            {"source": move.source, "target": move.target, "guard": _cut(automaton.guard_words(move))}
            for move in moves[:_MOST_MOVES]
        ],
    }


def _visited(path: StatePath) -> set[int]:
    return {state for states in path.sets for state in states}


def _shown_states(automaton: Automaton, path: StatePath) -> list[int]:
    visited = _visited(path) | {automaton.initial}
    others = [state for state in automaton.states if state not in visited]
    return sorted([*sorted(visited), *others][:MOST_STATES])


def _places(automaton: Automaton, shown: Sequence[int]) -> Mapping[int, tuple[int, float]]:
    """Return column and row of each state: columns follow the transitions, rows make few of them cross."""
    kept = set(shown)
    successors = {state: [each for each in automaton.successors[state] if each in kept] for state in shown}
    column = _columns(successors, automaton.initial)
    layers = [[state for state in shown if column[state] == each] for each in range(max(column.values()) + 1)]
    row = {state: height for layer in layers for state, height in _heights(layer)}
    for _ in range(_SWEEPS):
        for layer in layers[1:]:
            aims = {state: _middle(row, successors, state) for state in layer}
            layer.sort(key=lambda state: (aims[state], state))
            row |= dict(_heights(layer))
    return {state: (column[state], row[state]) for state in shown}


def _columns(successors: Mapping[int, Sequence[int]], initial: int) -> Mapping[int, int]:
    """Return for each state the longest way there, in transitions that do not lead back."""
    ended: list[int] = []
    on_way: set[int] = set()
    back: set[tuple[int, int]] = set()
    for root in [initial, *successors]:
        stack = [] if root in ended else [(root, iter(successors[root]))]
        on_way.update(state for state, _ in stack)
        while stack:
            state, targets = stack[-1]
            target = next(targets, None)
            if target is None:
                stack.pop()
                on_way.discard(state)
                ended.append(state)
            elif target in on_way:
                back.add((state, target))
            elif target not in ended:
                on_way.add(target)
                stack.append((target, iter(successors[target])))
    column = dict.fromkeys(successors, 0)
    for state in reversed(ended):
        for target in successors[state]:
            if (state, target) not in back:
                column[target] = max(column[target], column[state] + 1)
    return column


def _heights(layer: Sequence[int]) -> Iterator[tuple[int, float]]:
    """Yield the states of a column with their rows, around the middle."""
    for place, state in enumerate(layer):
        yield state, place - (len(layer) - 1) / 2.0


def _middle(row: Mapping[int, float], successors: Mapping[int, Sequence[int]], state: int) -> float:
    """Return the mean row of the states that lead to one, or its own."""
    found = [row[each] for each, targets in successors.items() if each != state and state in targets]
    return sum(found) / len(found) if found else row[state]


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST_GUARD else f"{text[: _LONGEST_GUARD - 1].rstrip()}…"
