"""An automaton as a drawing, and where a run is in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spatial_replay.automata.automaton import Automaton
from spatial_replay.automata.text import abbreviated, draw_automaton, meanings
from spatial_replay.geometry.arrays import Integers


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
        self._times_ns: list[Integers] = []
        self._codes: list[Integers] = []
        self._sets: dict[tuple[int, ...], int] = {}

    def extend(self, times_ns: Integers, groups: Sequence[tuple[Integers, tuple[int, ...]]]) -> None:
        """Take in the states after the next samples: places of samples, each time with their states."""
        codes = [
            np.full(len(places), self._sets.setdefault(states, len(self._sets))) for places, states in groups
        ]
        places = np.concatenate([places for places, _ in groups])
        order = np.argsort(places)
        self._times_ns.append(times_ns[places[order]])
        self._codes.append(np.concatenate(codes)[order])

    @property
    def path(self) -> StatePath:
        """The path so far."""
        none = [np.empty(0, np.int64)]
        times_ns, codes = (np.concatenate(none + each) for each in (self._times_ns, self._codes))
        return StatePath(times_ns, codes, tuple(self._sets))


def automaton_value(automaton: Automaton, path: StatePath, named: Callable[[str], str]) -> Mapping[str, Any]:
    """Return an automaton as the page draws it: states with their places, transitions with their guards.

    Args:
        named: writes the object in place of a template's parameter.
    """
    visited = {state for states in path.sets for state in states}
    drawing, short = draw_automaton(automaton, visited), abbreviated(automaton)
    return {
        "summary": drawing.summary,
        "left_out": drawing.left_out,
        "states": [
            {
                "number": state.number,
                "at": (state.column, state.row),
                "about": state.about,
                "accepting": state.is_accepting,
                "lost": state.is_lost,
                "won": state.is_won,
            }
            for state in drawing.states
        ],
        # the same words on arrows, and the same legend, as in a drawing by Graphviz
        "moves": [
            {**move._asdict(), "guard": named(move.guard), "label": named(brief.guard)}
            for move, brief in zip(drawing.moves, draw_automaton(short, visited).moves, strict=True)
        ],
        "legend": list(map(named, meanings(short))),
    }
