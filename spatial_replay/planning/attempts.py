"""What was tried for each edge of the automaton, and where that failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

from spatial_replay.planning.maps import Cubes
from spatial_replay.planning.step import Consideration, Edge, Outcome, Target

MOST_MOTIONS: Final = 100
"""How many motions an edge gets in all, however often they succeed."""


class Attempts:
    """The motions of a run."""

    def __init__(self) -> None:
        self._in_vain: Counter[Edge] = Counter()
        self._in_all: Counter[Edge] = Counter()
        self._places: dict[tuple[Cubes, str], tuple[tuple[float, float], ...]] = {}

    def why_enough(self, edge: Edge, most_in_vain: int) -> str:
        """Why an edge is not to be tried again, or ""."""
        if self._in_vain[edge] >= most_in_vain:
            return f"tried {self._in_vain[edge]} times"
        return f"tried {MOST_MOTIONS} times in all" if self._in_all[edge] >= MOST_MOTIONS else ""

    def begin(self, edge: Edge) -> None:
        """Count a motion for an edge, in vain so far."""
        self._in_vain[edge] += 1
        self._in_all[edge] += 1

    def conclude(self, aim: Consideration, target: Target, outcome: Outcome, states: Sequence[int]) -> None:
        """Take in how a motion went, and where the automaton is then."""
        if not outcome.succeeded:
            key = (aim.progress.cubes, target.name)
            self._places[key] = (*self._places.get(key, ()), (target.x, target.y))
        elif tuple(states) == aim.edge[1:]:
            del self._in_vain[aim.edge]

    def failed(self, aim: Consideration, name: str) -> tuple[tuple[float, float], ...]:
        """The places (x, y) where an object could not be brought for equal progress."""
        return self._places.get((aim.progress.cubes, name), ())
