"""Exact search for several constants that each loosen or tighten: boxes are split until all is decided.

Good runs hold from some looseness on, bad ones up to some. So a box of values is out if a good run fails at
its loosest corner, or a bad one at its tightest. Constants that share no result are decided apart: one alone
is as tight as the good runs allow, since nothing tighter satisfies them and nothing looser helps a bad one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple

from spatial_replay.tuning.margins import Margins, Point
from spatial_replay.tuning.number_search import last_before

_MOST_EVALUATIONS: Final = 8_000
"""Evaluations of runs for one decision, or for one widest margin; past them it counts as undecided."""
_MOST_BOXES: Final = 2_000
"""Boxes that are looked at for one margin, which need no evaluation if they lie near to others."""
_LEVELS, _PRECISION = 40, 1e-3
"""Margins tried for the widest, and how near to it, as a part of it, the search comes."""
_CONTRACTION: Final = 4
"""Halvings by which a side of a box is cut in one turn."""


class Feasibility(NamedTuple):
    """Whether some runs all have a margin at some point.

    Attributes:
        looseness: of each constant there, or None if no such point was found.
        is_proven: whether there is none, if none was found.
    """

    looseness: tuple[int, ...] | None
    is_proven: bool = True


class _Part(NamedTuple):
    """Constants that share results, and these results."""

    axes: tuple[int, ...]
    results: tuple[str, ...]


class ExactSearch:
    """The search for points, by their looseness, at which runs have a margin."""

    def __init__(self, margins: Margins, point_of: Callable[[Sequence[int]], Point]) -> None:
        """Prepare the search.

        Args:
            point_of: returns the point with a looseness of each constant, from 0 to the number of its steps.
        """
        self._margins, self._point_of = margins, point_of
        self._steps = [constant.steps for constant in margins.varied]
        parts = _parts(margins)
        self._single = [part for part in parts if len(part.axes) < 2]
        several = [part for part in parts if len(part.axes) > 1]
        self._joint = _Part(
            tuple(axis for part in several for axis in part.axes),
            tuple(name for part in several for name in part.results),
        )

    def widest(self, good: Sequence[int], bad: Sequence[int]) -> Feasibility:
        """Return the point of the widest margin of some runs, if at any point all have the right verdict."""
        found = self.decide(good, bad, 0.0)
        if found.looseness is None:
            return found
        best, low = found.looseness, self._least((*good, *bad), found.looseness)
        ends = self._steps, [0] * len(self._steps)
        high = min(self._least(good, ends[0]), self._least(bad, ends[1]))
        if any(self._is_invalid((*good, *bad), end) for end in ends):
            high = math.inf
        is_proven = True
        most = self._margins.evaluations + _MOST_EVALUATIONS
        for _ in range(_LEVELS):
            if self._margins.evaluations > most:
                is_proven = False
                break
            if high - low <= _PRECISION * abs(low) or low == high:
                break
            level = (low + high) / 2 if math.isfinite(high) else max(1.0, 2 * low)
            tried = self.decide(good, bad, level)
            if tried.looseness is None:
                high = level
                is_proven &= tried.is_proven
            else:
                best, low = tried.looseness, max(level, self._least((*good, *bad), tried.looseness))
        return Feasibility(best, is_proven)

    def decide(self, good: Sequence[int], bad: Sequence[int], level: float) -> Feasibility:
        """Return a point at which some runs have at least a margin, or whether there is none."""
        numbers = list(self._steps)
        uncovered = list(bad)
        for part in self._single:
            for axis in part.axes:
                numbers[axis] = self._tightest(good, numbers, axis, level, part)
            if not all(self._holds(run, numbers, level, part.results) for run in good):
                return Feasibility(None)
            uncovered = [run for run in uncovered if not self._holds(run, numbers, level, part.results)]
        if not self._joint.axes:
            return Feasibility(None if uncovered else tuple(numbers))
        return self._in_boxes(good, uncovered, numbers, level)

    def _tightest(
        self, good: Sequence[int], numbers: Sequence[int], axis: int, level: float, part: _Part
    ) -> int:
        """Return the least number of an axis from which on good runs hold; all steps if one never does."""
        number = 0
        for run in good:
            holds = partial(self._holds_at, run, numbers, axis, level, part.results)
            if not holds(number):
                number = last_before(self._steps[axis], number, holds)
        return number

    def _in_boxes(
        self, good: Sequence[int], bad: Sequence[int], numbers: Sequence[int], level: float
    ) -> Feasibility:
        low = _with(numbers, self._joint.axes, 0)
        boxes = [(low, list(numbers))]
        most = self._margins.evaluations + _MOST_EVALUATIONS
        for _ in range(_MOST_BOXES):
            if not boxes:
                return Feasibility(None)
            if self._margins.evaluations > most:
                break
            low, high = boxes.pop()
            if not (self._may_fit(good, high, level) and self._may_fit(bad, low, level)):
                continue
            self._contract(good, low, high, level)
            if not self._may_fit(bad, low, level):
                continue
            self._contract(bad, high, low, level)
            for corner in (low, high):
                if all(self._holds(run, corner, level, self._joint.results) for run in (*good, *bad)):
                    return Feasibility(tuple(corner))
            axis = max(self._joint.axes, key=lambda axis: self._share(axis, low, high))
            if high[axis] > low[axis]:
                middle = (low[axis] + high[axis]) // 2
                boxes.append((_with(low, [axis], middle + 1), list(high)))
                boxes.append((list(low), _with(high, [axis], middle)))
        return Feasibility(None, is_proven=not boxes)

    def _share(self, axis: int, low: Sequence[int], high: Sequence[int]) -> float:
        return (high[axis] - low[axis]) / self._steps[axis]

    def _contract(
        self, runs: Sequence[int], corner: list[int], opposite: Sequence[int], level: float
    ) -> None:
        """Move a corner of a box past numbers with which some runs fail even if all else is as opposite."""
        for axis in self._joint.axes:
            end, other = corner[axis], opposite[axis]
            if end == other or self._may_fit(runs, _with(opposite, [axis], end), level):
                continue
            least = max(abs(other - end) >> _CONTRACTION, 1)
            while abs(other - end) > least:
                middle = (end + other) // 2
                if self._may_fit(runs, _with(opposite, [axis], middle), level):
                    other = middle
                else:
                    end = middle
            corner[axis] = end + (1 if other > end else -1)

    def _may_fit(self, runs: Sequence[int], numbers: Sequence[int], level: float) -> bool:
        return all(self._holds(run, numbers, level, self._joint.results) for run in runs) or (
            bool(runs) and self._is_invalid(runs, numbers)
        )

    def _holds(self, run: int, numbers: Sequence[int], level: float, results: Sequence[str]) -> bool:
        return self._margins.holds(run, self._point_of(numbers), level, results)

    def _holds_at(
        self, run: int, numbers: Sequence[int], axis: int, level: float, results: Sequence[str], number: int
    ) -> bool:
        return self._holds(run, _with(numbers, [axis], number), level, results)

    def _is_invalid(self, runs: Sequence[int], numbers: Sequence[int]) -> bool:
        # such as a window whose ends are reversed; beyond, the verdict may be right again
        return self._margins.robustness(runs[0], self._point_of(numbers)) is None

    def _least(self, runs: Sequence[int], numbers: Sequence[int]) -> float:
        point = self._point_of(numbers)
        return min((self._margins.margin(run, point) for run in runs), default=math.inf)


def _parts(margins: Margins) -> list[_Part]:
    """Return the constants that share results, directly or through others."""
    parts: list[tuple[set[int], list[str]]] = []
    for name, axes in margins.axes.items():
        shared = [part for part in parts if part[0] & set(axes)]
        parts = [part for part in parts if part not in shared]
        parts.append(
            (set(axes).union(*(part[0] for part in shared)), [name, *(n for p in shared for n in p[1])])
        )
    return [_Part(tuple(sorted(axes)), tuple(names)) for axes, names in parts]


def _with(numbers: Sequence[int], axes: Sequence[int], number: int) -> list[int]:
    return [number if axis in axes else old for axis, old in enumerate(numbers)]
