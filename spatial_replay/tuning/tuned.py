"""Search for values of constants, and its result.

The search is exact for constants with a direction, and evolutionary for other constants. The result has
the values with their intervals, the margin of every run, conflicting runs, and surfaces.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from spatial_replay.errors import UsageError, importing
from spatial_replay.geometry.arrays import Floats
from spatial_replay.lazy import Displayed
from spatial_replay.monitor.ends import Needs, trim_trace
from spatial_replay.monitor.verdict import Verdict, final_verdict
from spatial_replay.spec import parse_specification
from spatial_replay.spec.checks import with_numbers
from spatial_replay.spec.diagnostics import nearest_hint
from spatial_replay.spec.formula import Specification
from spatial_replay.spec.load import constant_writer
from spatial_replay.text import json_fields, json_number, json_value, plural
from spatial_replay.trace.units import require_same_units
from spatial_replay.tuning.margins import (
    Direction,
    LabelledRun,
    Margins,
    Point,
    Value,
    text_of_constant,
    varied_constants,
)

_GENERATIONS, _CANDIDATES = 15, 6
"""Limits of an evolution: generations, and candidates per number in one generation."""


def last_that_holds(inside: int, end: int, holds: Callable[[int], bool]) -> int:
    """Return the last number up to which a condition holds, by doubling steps and then bisection.

    A condition that fails near the start costs few evaluations, all near the start.

    Args:
        inside: number at which the condition holds; it is not evaluated.
        end: last number to evaluate, above or below `inside`.
        holds: condition; after its first failure it is assumed to fail up to the end.
    """
    step = 1
    while inside != end:
        next_number = min(inside + step, end) if end > inside else max(inside - step, end)
        if not holds(next_number):
            return last_before(inside, next_number, holds)
        inside, step = next_number, 2 * step
    return inside


def last_before(inside: int, outside: int, holds: Callable[[int], bool]) -> int:
    """Return the last number at which a condition holds, by bisection.

    Args:
        inside: number at which the condition holds.
        outside: number at which the condition fails.
    """
    while abs(outside - inside) > 1:
        middle = (inside + outside) // 2
        if holds(middle):
            inside = middle
        else:
            outside = middle
    return inside


def least_for_all(runs: Iterable[int], most: int, holds: Callable[[int, int], bool]) -> int:
    """Return the least number from which on `holds(run, number)` for every run; `most` if there is none."""
    number = 0
    for run in runs:
        if not holds(run, number):
            number = last_before(most, number, partial(holds, run))
    return number


def evolve(
    cost: Callable[[Sequence[int]], float], sizes: Sequence[int], start: Sequence[int], seed: int
) -> None:
    """Search for numbers from 0 to `sizes` with the least cost, by SciPy's differential evolution.

    The caller records the best call of `cost`, so nothing is returned.

    Raises:
        UsageError: SciPy is not installed.
    """
    with importing("tuning several constants needs SciPy", extra="tune"):
        from scipy.optimize import differential_evolution
    differential_evolution(
        lambda shares: cost([round(share * size) for share, size in zip(shares, sizes, strict=True)]),
        [(0.0, 1.0)] * len(sizes),
        rng=np.random.default_rng(seed),
        x0=[number / size for number, size in zip(start, sizes, strict=True)],
        # Sobol points cover the space evenly, even if they are few
        init="sobol",
        popsize=_CANDIDATES,
        maxiter=_GENERATIONS,
        # the cost is constant between grid points, so polishing by gradients finds nothing
        polish=False,
    )


_MOST_EVALUATIONS: Final = 8_000
"""Maximum number of evaluations of runs for one decision or margin; beyond it, the result is undecided."""
_MOST_BOXES: Final = 2_000
"""Maximum number of boxes for one margin; neighbouring boxes share cached evaluations."""
_LEVELS, _PRECISION = 40, 1e-3
"""Maximum number of margins tried in one search, and relative precision of the widest margin."""
_CONTRACTION: Final = 4
"""Maximum number of bisections per side of a box in one contraction."""


class Feasibility(NamedTuple):
    """Answer to the question whether runs have a common point with a margin.

    Attributes:
        looseness: looseness of each constant at a common point; None if no point was found.
        is_proven: without a point, whether it is proven that none exists. In a result of `widest` with a
            point, whether it is proven that no margin is wider.
    """

    looseness: tuple[int, ...] | None
    is_proven: bool = True


class _Part(NamedTuple):
    """Constants that share results, and these results."""

    axes: tuple[int, ...]
    results: tuple[str, ...]


class ExactSearch:
    """Exact search for points at which runs have a margin.

    The looseness of a constant is its number of steps from the tightest value.
    """

    def __init__(self, margins: Margins, point_of: Callable[[Sequence[int]], Point]) -> None:
        """Prepare the search.

        Args:
            point_of: function from the looseness of each constant, 0 to its number of steps, to a point.
        """
        self._margins, self._point_of = margins, point_of
        self._steps = [constant.steps for constant in margins.varied]
        parts = _parts(margins)
        self._single = [part for part in parts if len(part.axes) < 2]
        joint_parts = [part for part in parts if len(part.axes) > 1]
        self._joint = _Part(
            tuple(axis for part in joint_parts for axis in part.axes),
            tuple(name for part in joint_parts for name in part.results),
        )

    def widest(self, good: Sequence[int], bad: Sequence[int]) -> Feasibility:
        """Return the point with the widest margin of the given runs, if some point fits all of them."""
        feasibility = self.decide(good, bad, 0.0)
        if feasibility.looseness is None:
            return feasibility
        best_looseness, low_margin = feasibility.looseness, self._least((*good, *bad), feasibility.looseness)
        end_points = self._steps, [0] * len(self._steps)
        high_margin = min(self._least(good, end_points[0]), self._least(bad, end_points[1]))
        # an invalid end has the margin -inf, which is not an upper bound
        if any(self._is_invalid((*good, *bad), end) for end in end_points):
            high_margin = math.inf
        is_proven = True
        evaluation_limit = self._margins.evaluations + _MOST_EVALUATIONS
        for _ in range(_LEVELS):
            if self._margins.evaluations > evaluation_limit:
                is_proven = False
                break
            if high_margin - low_margin <= _PRECISION * abs(low_margin) or low_margin == high_margin:
                break
            # without an upper bound the level is doubled
            level = (low_margin + high_margin) / 2 if math.isfinite(high_margin) else max(1.0, 2 * low_margin)
            attempt = self.decide(good, bad, level)
            if attempt.looseness is None:
                high_margin = level
                is_proven &= attempt.is_proven
            else:
                best_looseness, low_margin = (
                    attempt.looseness,
                    max(level, self._least((*good, *bad), attempt.looseness)),
                )
        return Feasibility(best_looseness, is_proven)

    def decide(self, good: Sequence[int], bad: Sequence[int], level: float) -> Feasibility:
        """Return a point at which all given runs have a margin of at least `level`, if there is one."""
        looseness = list(self._steps)
        remaining_bad = list(bad)
        for part in self._single:
            for axis in part.axes:
                holds = partial(self._holds_at, looseness, axis, level, part.results)
                looseness[axis] = least_for_all(good, self._steps[axis], holds)
            if not all(self._holds(run, looseness, level, part.results) for run in good):
                return Feasibility(None)
            remaining_bad = [
                run for run in remaining_bad if not self._holds(run, looseness, level, part.results)
            ]
        if not self._joint.axes:
            return Feasibility(None if remaining_bad else tuple(looseness))
        return self._in_boxes(good, remaining_bad, looseness, level)

    def _in_boxes(
        self, good: Sequence[int], bad: Sequence[int], numbers: Sequence[int], level: float
    ) -> Feasibility:
        low_corner = _with(numbers, self._joint.axes, 0)
        boxes = [(low_corner, list(numbers))]
        evaluation_limit = self._margins.evaluations + _MOST_EVALUATIONS
        for _ in range(_MOST_BOXES):
            if not boxes:
                return Feasibility(None)
            if self._margins.evaluations > evaluation_limit:
                break
            low_corner, high_corner = boxes.pop()
            if not (self._may_fit(good, high_corner, level) and self._may_fit(bad, low_corner, level)):
                continue
            self._contract(good, low_corner, high_corner, level)
            if not self._may_fit(bad, low_corner, level):
                continue
            self._contract(bad, high_corner, low_corner, level)
            for corner in (low_corner, high_corner):
                if all(self._holds(run, corner, level, self._joint.results) for run in (*good, *bad)):
                    return Feasibility(tuple(corner))
            axis = max(
                self._joint.axes, key=lambda axis: (high_corner[axis] - low_corner[axis]) / self._steps[axis]
            )
            if high_corner[axis] > low_corner[axis]:
                middle = (low_corner[axis] + high_corner[axis]) // 2
                # boxes are a stack, so the tighter half is searched first
                boxes.append((_with(low_corner, [axis], middle + 1), list(high_corner)))
                boxes.append((list(low_corner), _with(high_corner, [axis], middle)))
        return Feasibility(None, is_proven=not boxes)

    def _contract(
        self, runs: Sequence[int], corner: list[int], opposite: Sequence[int], level: float
    ) -> None:
        """Move a corner of a box inwards, axis by axis.

        A number on an axis is skipped if a run fails at the opposite corner with this number.
        """
        for axis in self._joint.axes:
            corner_number, opposite_number = corner[axis], opposite[axis]
            if corner_number == opposite_number or self._may_fit(
                runs, _with(opposite, [axis], corner_number), level
            ):
                continue
            least_gap = max(abs(opposite_number - corner_number) >> _CONTRACTION, 1)
            while abs(opposite_number - corner_number) > least_gap:
                middle = (corner_number + opposite_number) // 2
                if self._may_fit(runs, _with(opposite, [axis], middle), level):
                    opposite_number = middle
                else:
                    corner_number = middle
            corner[axis] = corner_number + (1 if opposite_number > corner_number else -1)

    def _may_fit(self, runs: Sequence[int], numbers: Sequence[int], level: float) -> bool:
        return all(self._holds(run, numbers, level, self._joint.results) for run in runs) or (
            bool(runs) and self._is_invalid(runs, numbers)
        )

    def _holds(self, run: int, numbers: Sequence[int], level: float, results: Sequence[str]) -> bool:
        return self._margins.holds(run, self._point_of(numbers), level, results)

    def _holds_at(
        self, numbers: Sequence[int], axis: int, level: float, results: Sequence[str], run: int, number: int
    ) -> bool:
        return self._holds(run, _with(numbers, [axis], number), level, results)

    def _is_invalid(self, runs: Sequence[int], numbers: Sequence[int]) -> bool:
        # reversed ends of a window are invalid, but values beyond them may give the right verdict again
        return self._margins.robustness(runs[0], self._point_of(numbers)) is None

    def _least(self, runs: Sequence[int], numbers: Sequence[int]) -> float:
        point = self._point_of(numbers)
        return min((self._margins.margin(run, point) for run in runs), default=math.inf)


def _parts(margins: Margins) -> list[_Part]:
    """Return groups of constants that share results, directly or through other constants."""
    parts: list[tuple[set[int], list[str]]] = []
    for name, axes in margins.axes.items():
        shared_parts = [part for part in parts if part[0] & set(axes)]
        parts = [part for part in parts if part not in shared_parts]
        parts.append(
            (
                set(axes).union(*(part[0] for part in shared_parts)),
                [name, *(part_name for shared_part in shared_parts for part_name in shared_part[1])],
            )
        )
    return [_Part(tuple(sorted(axes)), tuple(names)) for axes, names in parts]


def _with(numbers: Sequence[int], axes: Sequence[int], number: int) -> list[int]:
    return [number if axis in axes else old for axis, old in enumerate(numbers)]


_PARTS: Final = 1 << 20
"""Number of steps in which all constants are tightened together."""
_ROUNDS: Final = 6
"""Maximum number of rounds of adding runs to the deciding runs."""
_MOST_LINES, _SECANTS = 64, 24
"""Maximum number of lines of the grid in a complete search, and of steps on one line."""
_FAR: Final = 1e12
"""Substitute for an infinite margin."""


@dataclass(frozen=True, slots=True)
class Found:
    """Result of a search.

    Attributes:
        point: last point of the search.
        is_held: whether every run has the right verdict at the point.
        conflict: runs for which no common point was found; empty if `is_held`.
        is_proven: if `is_held`, whether it is proven that no point is better. Otherwise, whether it is proven
            that the conflict has no common point.
        alone: runs of the conflict that have the right verdict at no point, even without other runs.
    """

    point: Point
    is_held: bool
    conflict: tuple[int, ...] = ()
    is_proven: bool = True
    alone: tuple[int, ...] = ()


class Search:
    """Search for the best point of given runs; the same seed gives the same point."""

    def __init__(self, margins: Margins, seed: int = 0) -> None:
        self._margins, self._seed = margins, seed
        run_indices = list(range(len(margins.runs)))
        # in random order, only about ln(n) of n runs change the limit in `least_for_all`
        random.Random(seed).shuffle(run_indices)
        self._good = [run_index for run_index in run_indices if margins.runs[run_index].is_good]
        self._bad = [run_index for run_index in run_indices if not margins.runs[run_index].is_good]
        self._steps = tuple(constant.steps for constant in margins.varied)

    def best(self) -> Found:
        """Return the tightest point if all runs are good, else the point with the widest margin.

        Raises:
            UsageError: all runs are good and a constant has no direction, or SciPy is needed and missing.
        """
        if not self._bad:
            return self._tightest()
        if len(self._steps) == 1 and self._margins.directions[0] is not None:
            return self._widest_of_one()
        if None not in self._margins.directions:
            return self._widest_by_boxes()
        return self._widest_of_several()

    def limit(self, run: int) -> int | None:
        """Return the last index at which a run has the right verdict, for one constant with a direction.

        Returns:
            None if the run has the right verdict nowhere.
        """
        steps = self._steps[0]
        is_good = self._margins.runs[run].is_good

        def at(easiness: int) -> Point:
            return (self._number_at(0, easiness if is_good else steps - easiness),)

        return at(self._least([run], steps, at))[0] if self._margins.holds(run, at(steps)) else None

    def interval(self, point: Point, axis: int, least: float = 0.0) -> tuple[int, int]:
        """Return the interval around a point on one axis in which all margins are at least `least`."""
        return self._edge(point, axis, -1, least), self._edge(point, axis, 1, least)

    # ---------------------------------------------------------------------------------------- one constant

    def _tightest(self) -> Found:
        """Tighten all constants together and then one by one, while every run stays satisfied."""
        for constant, direction in zip(self._margins.varied, self._margins.directions, strict=True):
            if direction is None:
                raise UsageError(
                    f"greater values of {constant.name} are looser in one place and tighter in another, so "
                    "none is the tightest; give bad runs, too"
                )
        loosest = self._at(_PARTS)
        failing_runs = tuple(run for run in self._good if not self._margins.holds(run, loosest))
        if failing_runs:
            return Found(loosest, is_held=False, conflict=failing_runs, alone=failing_runs)
        joint_part = self._least(self._good, _PARTS, self._at)
        point = self._at(joint_part)
        for axis, steps in enumerate(self._steps):
            # the defaults bind the values of this iteration
            def along(looseness: int, axis: int = axis, point: Point = point) -> Point:
                return self._with(point, axis, self._number_at(axis, looseness))

            point = along(self._least(self._good, steps, along))
        return Found(point, is_held=True)

    def _widest_of_one(self) -> Found:
        steps = self._steps[0]

        def at(looseness: int) -> Point:
            return (self._number_at(0, looseness),)

        unfit_runs = self._alone(at(steps), at(0))
        good, bad = ([run for run in runs if run not in unfit_runs] for runs in (self._good, self._bad))
        first_looseness = self._least(good, steps, at)
        last_looseness = steps - self._least(bad, steps, lambda tightness: at(steps - tightness))
        failing_runs: list[int] = []
        if first_looseness > last_looseness:
            failing_runs = [run for run in good if not self._margins.holds(run, at(last_looseness))]
            failing_runs += [run for run in bad if not self._margins.holds(run, at(first_looseness))]
        if unfit_runs or failing_runs:
            return Found(
                at(first_looseness), is_held=False, conflict=(*unfit_runs, *failing_runs), alone=unfit_runs
            )
        crossing = self._crossing(first_looseness, last_looseness, at)
        # the widest margin is at the crossing or one step before it
        widest_looseness = max(
            crossing,
            max(crossing - 1, first_looseness),
            key=lambda looseness: self._least_margin(at(looseness)),
        )
        least_margin = self._least_margin(at(widest_looseness))
        interval = self.interval(at(widest_looseness), 0, least_margin)
        return Found((self._margins.varied[0].roundest(*interval),), is_held=True)

    def _alone(self, loosest: Point, tightest: Point) -> tuple[int, ...]:
        """Return the runs that fit nowhere: good runs fail even at `loosest`, bad runs even at `tightest`."""
        good = [run for run in self._good if not self._margins.holds(run, loosest)]
        return (*good, *(run for run in self._bad if not self._margins.holds(run, tightest)))

    def _crossing(self, first_looseness: int, last_looseness: int, at: Callable[[int], Point]) -> int:
        """Return the least looseness at which good runs have at least the margin of bad runs.

        Without such a looseness, the result is `last_looseness`.

        The interval is bisected. Runs that cannot have the least margin in the interval are dropped.
        """
        margin = self._margins.margin
        good, bad = self._good, self._bad
        while first_looseness < last_looseness:
            middle_looseness = (first_looseness + last_looseness) // 2
            least_good = min(margin(run, at(last_looseness)) for run in good) if good else np.inf
            least_bad = min(margin(run, at(first_looseness)) for run in bad)
            good = [run for run in good if margin(run, at(first_looseness)) <= least_good]
            bad = [run for run in bad if margin(run, at(last_looseness)) <= least_bad]
            good_margin = min((margin(run, at(middle_looseness)) for run in good), default=np.inf)
            if good_margin >= min(margin(run, at(middle_looseness)) for run in bad):
                last_looseness = middle_looseness
            else:
                first_looseness = middle_looseness + 1
        return first_looseness

    def _least(self, runs: Iterable[int], most: int, at: Callable[[int], Point]) -> int:
        """Return the least number from which on every run has the right verdict, at most `most`."""
        return least_for_all(runs, most, lambda run, number: self._margins.holds(run, at(number)))

    # ------------------------------------------------------------------------------------ several constants

    def _widest_by_boxes(self) -> Found:
        """Search exactly over deciding runs.

        The worst other runs become deciding runs until no other run has a smaller margin.
        """
        unfit_runs = self._alone(self._at(_PARTS), self._at(0))
        if unfit_runs:
            return Found(self._margins.start, is_held=False, conflict=unfit_runs, alone=unfit_runs)
        exact_search = ExactSearch(self._margins, self._point_at)
        deciding_runs = self._worst(self._margins.start, [])
        while True:
            good, bad = self._split(deciding_runs)
            feasibility = exact_search.widest(good, bad)
            if feasibility.looseness is None:
                break
            point = self._climb(deciding_runs, self._point_at(feasibility.looseness))
            worse_runs = self._worst(point, deciding_runs) or self._failing(point)[:1]
            if not worse_runs:
                return Found(self._centre(point), is_held=True, is_proven=feasibility.is_proven)
            deciding_runs += worse_runs
        if feasibility.is_proven:
            # runs that the contradiction does not need are left out, so that the conflict names few runs
            for run in list(deciding_runs):
                reduced_runs = self._split([other_run for other_run in deciding_runs if other_run != run])
                reduced_answer = exact_search.decide(*reduced_runs, 0.0)
                if reduced_answer.looseness is None and reduced_answer.is_proven:
                    deciding_runs.remove(run)
        return Found(self._margins.start, False, tuple(deciding_runs), feasibility.is_proven)

    def _split(self, runs: Sequence[int]) -> tuple[list[int], list[int]]:
        """Return the good runs and the bad runs among some runs."""
        return [run for run in runs if run in self._good], [run for run in runs if run in self._bad]

    def _failing(self, point: Point) -> list[int]:
        return [run for run in (*self._good, *self._bad) if not self._margins.holds(run, point)]

    def _point_at(self, looseness: Sequence[int]) -> Point:
        return tuple(self._number_at(axis, number) for axis, number in enumerate(looseness))

    def _widest_of_several(self) -> Found:
        """Optimise over deciding runs.

        The worst other runs become deciding runs until no other run has a smaller margin.
        """
        start = self._margins.start
        deciding_runs = self._worst(start, [])
        point = start
        for _ in range(_ROUNDS):
            point = self._optimise(deciding_runs, point)
            worse_runs = self._worst(point, deciding_runs)
            if not worse_runs:
                break
            deciding_runs += worse_runs
        if not self._all_hold([*self._bad, *self._good], point):
            return Found(point, is_held=False, conflict=self._conflict(point), is_proven=False)
        return Found(self._centre(point), is_held=True, is_proven=False)

    def _worst(self, point: Point, known_runs: Sequence[int]) -> list[int]:
        """Return the good run and the bad run with the least margin.

        A run is left out if the margin of some known run is not wider.
        """
        margin = self._margins.margin
        least_margin = min((margin(run, point) for run in known_runs), default=np.inf)
        worst_runs = [
            min(runs, key=lambda run: margin(run, point)) for runs in (self._good, self._bad) if runs
        ]
        return [
            run
            for run in worst_runs
            if run not in known_runs and (not known_runs or margin(run, point) < least_margin)
        ]

    def _optimise(self, runs: Sequence[int], start: Point) -> Point:
        """Return the best point for some runs, by a search of all grid lines or else by evolution.

        A grid line follows one axis with a direction. Secants find the best number on a line.
        """
        directed_axes = [
            axis for axis, direction in enumerate(self._margins.directions) if direction is not None
        ]
        axis = max(directed_axes, key=lambda axis: self._steps[axis], default=None)
        other_axes = [other_axis for other_axis in range(len(self._steps)) if other_axis != axis]
        best_candidate: tuple[float, Point] = (-np.inf, start)

        def look(numbers: Sequence[int]) -> float:
            nonlocal best_candidate
            point = list(start)
            for other_axis, number in zip(other_axes, numbers, strict=True):
                point[other_axis] = number
            candidate = self._best_on_line(runs, tuple(point), axis)
            best_candidate = max(best_candidate, candidate)
            return -candidate[0]

        sizes = [self._steps[other_axis] for other_axis in other_axes]
        if axis is not None and math.prod(size + 1 for size in sizes) <= _MOST_LINES:
            for numbers in itertools.product(*(range(size + 1) for size in sizes)):
                look(numbers)
        else:
            evolve(look, sizes, [start[other_axis] for other_axis in other_axes], self._seed)
        return self._climb(runs, best_candidate[1])

    def _best_on_line(self, runs: Sequence[int], point: Point, axis: int | None) -> tuple[float, Point]:
        """Return the best point on a line along an axis, with its margin.

        Towards looser values, margins of good runs rise and margins of bad runs fall. At the
        best point, the least margin of good runs equals the least margin of bad runs. Margins are often
        linear in a threshold, so few secants find the point.
        """
        if axis is None:
            return self._sides(runs, point)[0], point
        best_candidate: tuple[float, Point] = (-np.inf, point)

        def excess(looseness: int) -> float:
            nonlocal best_candidate
            moved_point = self._with(point, axis, self._number_at(axis, looseness))
            least_margin, good_margin, bad_margin = self._sides(runs, moved_point)
            best_candidate = max(best_candidate, (least_margin, moved_point))
            return good_margin - bad_margin

        low_looseness, high_looseness = 0, self._steps[axis]
        low_excess, high_excess = excess(low_looseness), excess(high_looseness)
        if low_excess >= 0.0 or high_excess < 0.0:
            return best_candidate
        for step in range(_SECANTS):
            if high_looseness - low_looseness <= 1:
                break
            # every third step is a bisection, because secants can leave one end in place for many steps
            fraction = 0.5 if step % 3 == 2 else low_excess / (low_excess - high_excess)
            # strictly between the ends, so that the interval always shrinks
            middle_looseness = min(
                max(low_looseness + round(fraction * (high_looseness - low_looseness)), low_looseness + 1),
                high_looseness - 1,
            )
            if (middle_excess := excess(middle_looseness)) >= 0.0:
                high_looseness, high_excess = middle_looseness, middle_excess
            else:
                low_looseness, low_excess = middle_looseness, middle_excess
        return best_candidate

    def _sides(self, runs: Sequence[int], point: Point) -> tuple[float, float, float]:
        """Return the least margins of all runs, of good runs and of bad runs, limited to `_FAR`."""
        least_margins = [_FAR, _FAR]
        for run in runs:
            side_index = int(not self._margins.runs[run].is_good)
            least_margins[side_index] = max(
                min(self._margins.margin(run, point), least_margins[side_index]), -_FAR
            )
        return min(least_margins), least_margins[0], least_margins[1]

    def _climb(self, runs: Sequence[int], point: Point) -> Point:
        """Move a point along single axes while the least margin grows, with halving steps."""

        def value(trial: Point) -> float:
            return min(self._margins.margin(run, trial) for run in runs)

        best_margin = value(point)
        step_sizes = [max(steps >> 4, 1) for steps in self._steps]
        for _ in range(12):
            for axis, step_size in enumerate(step_sizes):
                for offset in (-step_size, step_size):
                    moved_point = self._with(
                        point, axis, min(max(point[axis] + offset, 0), self._steps[axis])
                    )
                    if (margin := value(moved_point)) > best_margin:
                        point, best_margin = moved_point, margin
            step_sizes = [max(step_size >> 1, 1) for step_size in step_sizes]
        return point

    def _centre(self, point: Point) -> Point:
        """Move each number to the middle of the interval in which the least margin does not decrease."""
        least_margin = self._least_margin(point)
        for axis, constant in enumerate(self._margins.varied):
            number = constant.roundest(*self.interval(point, axis, least_margin))
            moved_point = self._with(point, axis, number)
            # a constant without a direction can have a lesser margin between the ends of the interval
            point = (
                moved_point if self._all_hold(self._good + self._bad, moved_point, least_margin) else point
            )
        return point

    def _conflict(self, point: Point) -> tuple[int, ...]:
        """Return the conflicting runs: one or two runs without a common point, else all failing runs."""
        worst_runs = self._worst(point, [])
        for few_runs in (*[[run] for run in worst_runs], worst_runs):
            if not self._all_hold(few_runs, self._optimise(few_runs, point)):
                return tuple(few_runs)
        return tuple(self._failing(point))

    # ---------------------------------------------------------------------------------------------- points

    def _number_at(self, axis: int, looseness: int) -> int:
        """Return the index of the value that is `looseness` steps looser than the tightest value."""
        return self._steps[axis] - looseness if self._margins.directions[axis] == -1 else looseness

    def _at(self, part: int) -> Point:
        """Return the point with the same relative looseness, `part / _PARTS`, on each axis."""
        return self._point_at([part * steps // _PARTS for steps in self._steps])

    def _with(self, point: Point, axis: int, number: int) -> Point:
        return (*point[:axis], number, *point[axis + 1 :])

    def _all_hold(self, runs: Sequence[int], point: Point, least: float = 0.0) -> bool:
        return all(self._margins.holds(run, point, least) for run in runs)

    def _least_margin(self, point: Point) -> float:
        return min(self._margins.margin(run, point) for run in (*self._good, *self._bad))

    def _edge_of_each(self, point: Point, axis: int, end: int, least: float) -> int:
        """Return the last index towards an end at which all runs fit, for an axis with a direction.

        Only good runs fail at tighter values, and only bad runs at looser values.
        """
        is_looser = (end > point[axis]) == (self._margins.directions[axis] == 1)
        # one good run is enough to notice that the specification is invalid
        runs = [*self._bad, *self._good[:1]] if is_looser else self._good

        def holds(run: int, number: int) -> bool:
            return self._margins.holds(run, self._with(point, axis, number), least)

        for run in runs:
            if not holds(run, end):
                end = last_before(point[axis], end, partial(holds, run))
        return end

    def _edge(self, point: Point, axis: int, towards: int, least: float) -> int:
        """Return the last index in one direction up to which all margins are at least `least`."""
        runs, end = [*self._bad, *self._good], self._steps[axis] if towards > 0 else 0
        if self._margins.directions[axis] is not None:
            return self._edge_of_each(point, axis, end, least)
        return last_that_holds(
            point[axis], end, lambda number: self._all_hold(runs, self._with(point, axis, number), least)
        )


MOST_RUNS: Final = 10_000
"""Maximum number of runs."""
MOST_SAMPLES: Final = 1 << 25
"""Maximum number of samples of all runs, which are in memory."""
MOST_CONSTANTS: Final = 10
_MOST_NAMED: Final = 5
"""Maximum number of conflicting runs in one sentence."""


@dataclass(frozen=True, slots=True)
class TunedConstant:
    """Constant with its tuned value.

    Attributes:
        value, written: tuned value and value in the text: numbers, or durations as texts.
        low, high: ends of the interval around the tuned value that fits every run, with the tuned values of
            the other constants. One step outside the interval, a run does not fit or the tried range ends.
        tried: tried range.
        step: least difference of two values; seconds for a duration.
        direction: 1 if greater values are looser, -1 if they are tighter, None if unknown.
        is_decided: whether runs decide the value. An undecided value may be loosened without admitting a
            bad run: it is the written value, or the nearest value that fits.
    """

    name: str
    value: Value
    written: Value
    low: Value
    high: Value
    tried: tuple[Value, Value]
    step: float
    direction: Direction | None
    is_decided: bool = True


@dataclass(frozen=True, slots=True)
class RunMargin:
    """Run with its verdict and margin at the tuned values.

    Attributes:
        robustness: least robustness of all results: the lower end for a good run, the upper for a bad run.
        margin: margin from the wrong verdict: the robustness, negated for a bad run. It is negative if the
            verdict is wrong.
    """

    name: str
    is_good: bool
    verdict: Verdict
    robustness: float
    margin: float


@dataclass(frozen=True, slots=True)
class Conflict:
    """Reason why no values were found.

    Attributes:
        runs: names of the runs that cannot all have the right verdict.
        message: needs of each run, as far as they are known.
        is_proven: whether it is proven that no values exist.
        alone: names of the runs that fit no values, even without other runs.
    """

    runs: tuple[str, ...]
    message: str
    is_proven: bool
    alone: tuple[str, ...] = ()

    @property
    def sections(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Needs of the runs in two sections: runs that fit no values, and runs that contradict each other."""
        needs = self.message.split("; ")
        alone_count = min(len(self.alone), _MOST_NAMED) + (len(self.alone) > _MOST_NAMED)
        alone_title = (
            "this one fits none by itself" if len(self.alone) == 1 else "these fit none by themselves"
        )
        joint_title = "these contradict each other" if len(self.runs) > 1 else "this one never fits"
        sections = ((alone_title, tuple(needs[:alone_count])), (joint_title, tuple(needs[alone_count:])))
        return tuple(section for section in sections if section[1])


@dataclass(frozen=True, eq=False)
class Surface(Displayed):
    """Margin of every run over the values of one or two constants; other constants have their tuned values.

    Attributes:
        names: names of the constants; the first constant is along x.
        x, y: (X,) and (Y,), values of the constants, seconds for durations; y is one NaN for one constant.
        margins: (R, Y, X), margins; -inf where the specification is invalid.
        runs: (R,), name of each run and whether it is good.
        found: tuned values, or None.
        durations: for each constant, whether it is a duration.
    """

    names: tuple[str, ...]
    x: Floats
    y: Floats
    margins: Floats
    runs: tuple[tuple[str, bool], ...]
    found: tuple[float, ...] | None
    durations: tuple[bool, ...]

    @property
    def least(self) -> Floats:
        """(Y, X), least margin of all runs."""
        least: Floats = self.margins.min(axis=0)
        return least


@dataclass(frozen=True, eq=False)
class Tuning(Displayed):
    """Tuned values of constants, or the reason why there are none.

    Attributes:
        is_found: whether every run has the right verdict with these values.
        constants: varied constants; if nothing was found, at the last point of the search.
        margin: least margin of all runs.
        runs: all runs in the given order.
        conflict: reason why nothing was found, or None.
        is_widest: whether it is proven that no other values have a wider margin or are tighter. False if the
            search reached its limit of evaluations, if a constant has no direction, or if an undecided
            constant kept its value.
        specification: specification with the values; comments and layout are unchanged.
    """

    is_found: bool
    constants: tuple[TunedConstant, ...]
    margin: float
    runs: tuple[RunMargin, ...]
    conflict: Conflict | None
    is_widest: bool
    specification: Specification
    _margins: Margins = field(repr=False)
    _point: Point = field(repr=False)

    @property
    def values(self) -> dict[str, Value]:
        """The values by name, as an argument of `parse_specification`."""
        return {constant.name: constant.value for constant in self.constants}

    def __repr__(self) -> str:
        if self.conflict is not None:
            return f"<Tuning: {self.conflict.message}>"
        values = ", ".join(f"{name} = {value}" for name, value in self.values.items())
        return f"<Tuning of {plural(len(self.runs), 'run')}: {values}; margin {self.margin:.6g}>"

    def surface(self, *names: str, points: int = 25) -> Surface:
        """Compute the margins over one or two constants; by default over the first two.

        Args:
            points: number of values of each constant.

        Raises:
            UsageError: a constant that was not varied, more than two, fewer than 2 points or more than 200.
        """
        varied_names = [constant.name for constant in self.constants]
        axis_names = names or tuple(varied_names[:2])
        for name in axis_names:
            if name not in varied_names:
                hint = nearest_hint(name, varied_names) or f"varied were: {', '.join(varied_names)}"
                raise UsageError(f"{name!r} was not varied; {hint}")
        if len({*axis_names}) != len(axis_names) or len(axis_names) > 2:
            raise UsageError(f"a surface is over one or two constants, not over {', '.join(axis_names)}")
        if not 2 <= points <= 200:
            raise UsageError(f"points is {points}; give 2 to 200")
        axes = [varied_names.index(name) for name in axis_names]
        constants = [self._margins.varied[axis] for axis in axes]
        grids = [
            np.unique(np.linspace(0, constant.steps, points).round().astype(np.int64))
            for constant in constants
        ]
        y_indices = grids[1] if len(grids) > 1 else np.array([self._point[axes[0]]])
        margins = np.empty((len(self.runs), len(y_indices), len(grids[0])))
        for y_row, y in enumerate(y_indices.tolist()):
            for column, x in enumerate(grids[0].tolist()):
                point = list(self._point)
                point[axes[-1]] = y
                point[axes[0]] = x
                margins[:, y_row, column] = [
                    self._margins.margin(run, tuple(point)) for run in range(len(self.runs))
                ]
        axis_values = [
            np.array(
                [_number(constant.decimal(number), constant.written.duration_ns) for number in grid.tolist()]
            )
            for constant, grid in zip(constants, grids, strict=True)
        ]
        tuned_values = tuple(
            _number(constant.decimal(self._point[axis]), constant.written.duration_ns)
            for constant, axis in zip(constants, axes, strict=True)
        )
        return Surface(
            axis_names,
            axis_values[0],
            axis_values[1] if len(axis_values) > 1 else np.full(1, np.nan),
            margins,
            tuple((run.name, run.is_good) for run in self.runs),
            tuned_values if self.is_found else None,
            tuple(constant.written.duration_ns is not None for constant in constants),
        )

    @property
    def document(self) -> dict[str, Any]:
        """The result as values for JSON."""
        unknown_range = {} if self.is_found else {"low": None, "high": None}
        return {
            "found": self.is_found,
            "margin": json_number(self.margin),
            "widest": self.is_widest,
            "constants": [{**json_fields(constant), **unknown_range} for constant in self.constants],
            "runs": json_value(self.runs),
            "conflict": json_value(self.conflict),
        }


def tune_runs(
    specification: Specification,
    runs: Sequence[LabelledRun],
    ranges: Mapping[str, tuple[Value, Value] | None],
    *,
    each: Mapping[str, str] | None = None,
    seed: int = 0,
    advance: Callable[[int], None] = lambda runs: None,
) -> Tuning:
    """Find values of constants with which all good runs are satisfied and all bad runs are violated.

    With bad runs, the values have the widest margin. The margin is the least of the good runs' robustness and
    the bad runs' negated robustness. If no bad run excludes looser values of a constant, it keeps its
    value in the text, or gets the nearest value that fits. Without bad runs, the values are the tightest.
    All constants are tightened together in proportion to their ranges, and then one by one.

    Args:
        ranges: range to try by name of the constant; None for the range in the text. If `ranges` is
            empty, all constants with a range in the text are tuned.
        each: objects by template parameter.
        seed: seed of the search over several constants; the same seed finds the same values.
        advance: function that is called with the number of runs prepared since its last call.

    Raises:
        UsageError: no good run, too many runs, a constant that cannot be tuned, a run that does not fit the
            specification, or runs in different units.
    """
    needs = Needs.of([specification], each or {})
    runs = [replace(run, trace=trim_trace(run.trace, needs)[0]) for run in runs]
    _check(specification, runs)
    constants = varied_constants(specification, ranges)
    if len(constants) > MOST_CONSTANTS:
        raise UsageError(
            f"{len(constants)} constants are more than the {MOST_CONSTANTS} that are tuned together"
        )
    parse = partial(_with_values, specification, constant_writer(specification), runs[0].trace.units)
    margins = Margins(runs, parse, constants, each or {}, advance=advance)
    search = Search(margins, seed)
    search_result = search.best()
    kept_numbers = _undecided_constants(margins, search, search_result) if search_result.is_held else {}
    point = tuple(kept_numbers.get(axis, number) for axis, number in enumerate(search_result.point))
    is_widest = search_result.is_proven and point == search_result.point
    search_result = replace(
        search_result, point=point, is_proven=is_widest if search_result.is_held else search_result.is_proven
    )
    return _tuning(specification, margins, search, search_result, kept_numbers)


def _undecided_constants(margins: Margins, search: Search, found: Found) -> dict[int, int]:
    """Return the constants that no bad run decides: the index of the value to keep, by axis.

    The widest margin would loosen such a constant to the end of its range. Without bad runs there are no such
    constants, because the tightest values are decided.
    """
    kept_numbers: dict[int, int] = {}
    if all(run.is_good for run in margins.runs):
        return kept_numbers
    for axis, constant in enumerate(margins.varied):
        point = tuple(kept_numbers.get(other_axis, number) for other_axis, number in enumerate(found.point))
        low_index, high_index = search.interval(point, axis)
        is_free = {1: high_index == constant.steps, -1: low_index == 0}.get(
            margins.directions[axis] or 0, False
        )
        if (low_index, high_index) == (0, constant.steps) or is_free:
            kept_numbers[axis] = min(max(constant.start, low_index), high_index)
    return kept_numbers


def _check(specification: Specification, runs: Sequence[LabelledRun]) -> None:
    if specification.relations:
        relation_names = ", ".join(sorted(specification.relations))
        raise UsageError(f"relations given in Python cannot be tuned ({relation_names}); write them as def")
    if not any(run.is_good for run in runs):
        raise UsageError("there is no good run to satisfy; give at least one that did what it should")
    require_comparable(runs, "tune on")
    for run in runs[1:]:
        if with_numbers(specification, run.trace.units) != with_numbers(specification, runs[0].trace.units):
            difference = f"{run.name} and {runs[0].name} name the numbers of a signal differently"
            raise UsageError(f"{difference}; read both by one mapping")


def require_comparable(runs: Sequence[LabelledRun], remedy: str) -> None:
    """Raise an error if runs have too many samples for the memory, or different units.

    Args:
        remedy: verb for messages that ask for fewer runs, such as "tune on".

    Raises:
        UsageError: too many runs or samples, or different units.
    """
    if len(runs) > MOST_RUNS:
        raise UsageError(f"{len(runs)} runs are more than {MOST_RUNS}; {remedy} some of them")
    sample_count = sum(len(run.trace) for run in runs)
    if sample_count > MOST_SAMPLES:
        raise UsageError(
            f"the runs have {sample_count} samples, more than {MOST_SAMPLES}; {remedy} some of them"
        )
    for run in runs[1:]:
        require_same_units(runs[0].trace, run.trace, (runs[0].name, run.name))


def _with_values(
    specification: Specification,
    write: Callable[[Mapping[str, Value]], str],
    units: Mapping[str, str],
    values: Mapping[str, Value],
) -> Specification:
    text, filename = write(values), specification.filename
    return with_numbers(parse_specification(text, filename=filename, profile=specification.profile), units)


def _tuning(
    specification: Specification, margins: Margins, search: Search, found: Found, kept_axes: Collection[int]
) -> Tuning:
    tuned_constants = []
    for axis, constant in enumerate(margins.varied):
        value_index = found.point[axis]
        low_index, high_index = (
            search.interval(found.point, axis) if found.is_held else (value_index, value_index)
        )
        duration_ns = constant.written.duration_ns
        tuned_constants.append(
            TunedConstant(
                constant.name,
                constant.value(value_index),
                constant.written.value if duration_ns is None else text_of_constant(constant.written),
                constant.value(low_index),
                constant.value(high_index),
                (constant.value(0), constant.value(constant.steps)),
                _number(constant.step, duration_ns),
                margins.directions[axis],
                axis not in kept_axes,
            )
        )
    run_margins = []
    for run_index, run in enumerate(margins.runs):
        robustness = margins.robustness(run_index, found.point)
        lower, upper = (-np.inf, np.inf) if robustness is None else robustness
        run_margins.append(
            RunMargin(
                run.name,
                run.is_good,
                final_verdict(lower, upper),
                lower if run.is_good else upper,
                margins.margin(run_index, found.point),
            )
        )
    return Tuning(
        found.is_held,
        tuple(tuned_constants),
        min(run.margin for run in run_margins),
        tuple(run_margins),
        None if found.is_held else _conflict(margins, search, found),
        found.is_held and found.is_proven,
        margins.specification(found.point) or specification,
        margins,
        found.point,
    )


def _conflict(margins: Margins, search: Search, found: Found) -> Conflict:
    conflict_runs = sorted(found.conflict, key=lambda run: (margins.margin(run, found.point), run))
    alone_runs = [run for run in conflict_runs if run in found.alone]
    other_runs = [run for run in conflict_runs if run not in found.alone]
    is_exact = len(margins.varied) == 1 and margins.directions[0] is not None
    needs: list[str] = []
    for runs in (alone_runs, other_runs):
        needs += [
            _needs(margins, search, run, is_exact=is_exact, is_alone=runs is alone_runs)
            for run in runs[:_MOST_NAMED]
        ]
        if len(runs) > _MOST_NAMED:
            needs.append(f"and {plural(len(runs) - _MOST_NAMED, 'other run')} likewise")
    run_names = tuple(margins.runs[run].name for run in (*alone_runs, *other_runs))
    return Conflict(run_names, "; ".join(needs), found.is_proven, run_names[: len(alone_runs)])


def _needs(margins: Margins, search: Search, run: int, *, is_exact: bool, is_alone: bool) -> str:
    """Return the values that a run needs, as part of a sentence."""
    labelled_run = margins.runs[run]
    verdict_text = "satisfied" if labelled_run.is_good else "violated"
    if not is_exact:
        if is_alone:
            return f"{labelled_run.name} is not {verdict_text} with any values tried"
        return f"{labelled_run.name} has to be {verdict_text}"
    constant, limit = margins.varied[0], search.limit(run)
    if limit is None:
        range_text = f"from {constant.text(0)} to {constant.text(constant.steps)}"
        return f"{labelled_run.name} is not {verdict_text} with any {constant.name} {range_text}"
    sign = ">=" if (margins.directions[0] == 1) == labelled_run.is_good else "<="
    return f"{labelled_run.name} is {verdict_text} only with {constant.name} {sign} {constant.text(limit)}"


def _number(value: Any, duration_ns: int | None) -> float:
    return float(value) if duration_ns is None else float(value) / 1e9
