"""An automaton as a drawing, and where a run is in it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.drawing import size_words, state_words
from spatial_replay.geometry.arrays import Integers
from spatial_replay.logs.messages.AutomatonState_pb2 import AutomatonState

MOST_STATES: Final = 60
"""How many states a page draws at most: those that the run is in, and then those nearest to the start."""
_MOST_MOVES: Final = 600
_LONGEST_GUARD: Final = 400
_SWEEPS: Final = 4


@dataclass(frozen=True, eq=False)
class StatePath:
    """Where a run is after each of some samples.

    Attributes:
        times_ns: (T,) int64.
        codes: (T,) int64, index into `sets`.
        sets: states that the run may be in.
    """

    times_ns: Integers
    codes: Integers
    sets: tuple[tuple[int, ...], ...]


class StatePathMaker:
    """Takes the states of one result from its messages as they come."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        self._codes: list[int] = []
        self._sets: dict[tuple[int, ...], int] = {}

    def add(self, message: AutomatonState) -> None:
        """Take in the next message."""
        self._times_ns.append(message.time_ns)
        self._codes.append(self._sets.setdefault(tuple(message.states), len(self._sets)))

    def path(self) -> StatePath:
        """What was taken so far."""
        times_ns, codes = np.array(self._times_ns, np.int64), np.array(self._codes, np.int64)
        return StatePath(times_ns, codes, tuple(self._sets))


def automaton_value(automaton: Automaton, path: StatePath) -> Mapping[str, Any]:
    """An automaton as the page draws it: its states with their places, its moves with their guards."""
    shown = _shown_states(automaton, path)
    places = _places(automaton, shown)
    moves = [move for move in automaton.transitions if move.source in places and move.target in places]
    return {
        "summary": size_words(automaton),
        "left_out": len(automaton.states) - len(shown),
        "propositions": [each.label for each in automaton.propositions],
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


def _shown_states(automaton: Automaton, path: StatePath) -> list[int]:
    visited = sorted({state for states in path.sets for state in states} | {automaton.initial})
    others = [state for state in automaton.states if state not in set(visited)]
    return sorted([*visited, *others][:MOST_STATES])


def _places(automaton: Automaton, shown: Sequence[int]) -> Mapping[int, tuple[int, float]]:
    """Column and row of each state: columns by distance from the start, rows so that moves cross little."""
    layers = _layers(automaton, shown)
    rows = {state: float(row) for layer in layers for row, state in enumerate(layer)}
    for _ in range(_SWEEPS):
        for layer in layers[1:]:
            aims = {state: _middle(rows, _sources(automaton, state, rows)) for state in layer}
            layer.sort(key=lambda state: (aims[state] if aims[state] is not None else rows[state], state))
            rows |= {state: row - (len(layer) - 1) / 2.0 for row, state in enumerate(layer)}
    return {
        state: (column, row - (len(layer) - 1) / 2.0)
        for column, layer in enumerate(layers)
        for row, state in enumerate(layer)
    }


def _layers(automaton: Automaton, shown: Sequence[int]) -> list[list[int]]:
    left = set(shown)
    layers: list[list[int]] = []
    layer = [automaton.initial]
    while layer:
        layers.append(layer)
        left -= set(layer)
        layer = sorted({target for state in layer for target in automaton.successors[state]} & left)
    # states whose predecessors are left out
    return [*layers, sorted(left)] if left else layers


def _sources(automaton: Automaton, state: int, rows: Mapping[int, float]) -> list[int]:
    return [each for each in rows if each != state and state in automaton.successors[each]]


def _middle(rows: Mapping[int, float], states: Iterable[int]) -> float | None:
    found = [rows[state] for state in states]
    return sum(found) / len(found) if found else None


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST_GUARD else f"{text[: _LONGEST_GUARD - 1].rstrip()}…"
