"""Descents to the least cost, one after the other: a look around, then CMA-ES from the best place seen.

CMA-ES draws more points than are asked for, and a model of the costs so far picks those that are worth a
run: a Gaussian process, since the quadratic models of `cma` take more runs to be of use than a descent has.

The only module that knows the package `cma`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import UsageError

LARGEST_COST: Final = 1e9
"""Stands for infinite costs, of which an optimiser can make nothing; impossible cases cost more."""
_LOOK: Final = 10
"""Points of a look around, spread over the whole space."""
_STEP: Final = 0.2
"""The standard deviation with which a descent begins, as a share of the ranges."""
_NARROWEST: Final = 2e-3
"""The standard deviation at which a descent has arrived."""
_FLAT: Final = 3
"""Generations of equal costs after which a descent is given up."""
_STALLED: Final = 5
_FALLS: Final = 1e-3
"""Generations after which a descent is given up whose least cost does not fall by such a part of itself."""
_DRAWN: Final = 20
"""Points that CMA-ES draws for each one that is asked for."""
_PARTS: Final = 3
"""Rounds of a generation: the model knows the costs of one when it picks the next."""
_KNOWN: Final = 80
"""Points that the model is fitted to: half of them the best, half the newest."""
_LENGTHS: Final = (0.15, 0.3, 0.6)
"""Over how much of the ranges costs vary; the likeliest length is taken."""
_NOISE: Final = 1e-2
"""The share of the costs' variance that points do not explain: contacts, and what else is drawn."""


class Descents:
    """Points of the unit cube, asked for in rounds, each of which gets its costs; a process for one search.

    The seed decides all points, for equal costs: no state of other modules counts, nor does theirs change.
    """

    def __init__(self, size: int, seed: int) -> None:
        """Begin with a look around.

        Raises:
            UsageError: `cma` is not installed.
        """
        try:
            import cma
        except ImportError:
            remedy = "pip install 'spatial-replay[falsify]'"
            raise UsageError(f"searching for failures needs cma, which is not installed: {remedy}") from None
        self._cma: Any = cma
        # CMA-ES takes no fewer than two dimensions: a second one that decides nothing does no harm
        self._size, self._searched = size, max(size, 2)
        self._random = np.random.default_rng([seed, 0])
        self._strategy: Any = None
        self._least, self._stalled = np.inf, 0
        self._asked: list[NDArray[np.float64]] = []
        # of the generation that is being asked for: what was drawn, and the points and costs so far
        self._drawn: list[NDArray[np.float64]] = []
        self._generation: list[tuple[NDArray[np.float64], float]] = []
        self._points: list[NDArray[np.float64]] = []
        self._costs: list[float] = []

    def ask(self) -> list[NDArray[np.float64]]:
        """Return the points of the next round, each (size,), from 0 to 1."""
        self._asked = self._look() if self._strategy is None else self._promising()
        return [point[: self._size] for point in self._asked]

    def take(self, costs: Sequence[float], *, is_found: bool) -> None:
        """Take the cost of each point of the last round.

        Args:
            is_found: whether one of them is what is searched for: the next descent then begins elsewhere.
        """
        self._remember(costs)
        self._generation += zip(self._asked, costs, strict=True)
        if is_found:
            self._strategy = None
        elif self._strategy is None:
            self._strategy = self._descent(self._asked[int(np.argmin(costs))])
            self._least, self._stalled = min(costs), 0
        elif len(self._generation) < self._strategy.popsize:
            return
        else:
            self._end_generation()
        self._generation, self._drawn = [], []

    def _look(self) -> list[NDArray[np.float64]]:
        """Return points of which each tenth of each dimension has one."""
        columns = [
            (self._random.permutation(_LOOK) + self._random.random(_LOOK)) / _LOOK
            for _ in range(self._searched)
        ]
        return list(np.array(columns).T)

    def _end_generation(self) -> None:
        points, costs = map(list, zip(*self._generation, strict=True))
        self._strategy.tell(points, costs)
        least = min(costs)
        is_lower = least < self._least - _FALLS * abs(self._least)
        self._stalled = 0 if is_lower else self._stalled + 1
        self._least = min(self._least, least)
        if self._strategy.stop() or self._stalled == _STALLED:
            self._strategy = None

    def _promising(self) -> list[NDArray[np.float64]]:
        """Return those points of a generation that the model expects the least costs of, a part of it."""
        size = self._strategy.popsize
        if not self._drawn:
            self._drawn = self._strategy.ask(_DRAWN * size)
        expected = expected_costs(
            np.array(self._points),
            np.array(self._costs),
            np.array([each[: self._size] for each in self._drawn]),
        )
        count = min(-(-size // _PARTS), size - len(self._generation))
        order = np.argsort(expected, kind="stable").tolist()
        chosen = [self._drawn[place] for place in order[:count]]
        self._drawn = [self._drawn[place] for place in sorted(order[count:])]
        return chosen

    def _remember(self, costs: Sequence[float]) -> None:
        """Keep the newest points, and the best of those before them."""
        self._points += [each[: self._size] for each in self._asked]
        self._costs += costs
        older = len(self._costs) - _KNOWN // 2
        best = sorted(sorted(range(max(older, 0)), key=lambda place: self._costs[place])[: _KNOWN // 2])
        kept = [*best, *range(max(older, 0), len(self._costs))]
        self._points = [self._points[place] for place in kept]
        self._costs = [self._costs[place] for place in kept]

    def _descent(self, start: NDArray[np.float64]) -> Any:
        options = {
            "bounds": [0.0, 1.0],
            # numbers of its own, in place of those of the whole process
            "randn": lambda *shape: self._random.standard_normal(shape),
            "seed": np.nan,
            "tolx": _NARROWEST,
            "tolflatfitness": _FLAT,
            "verbose": -9,
        }
        return self._cma.CMAEvolutionStrategy(start, _STEP, options)


def expected_costs(
    points: NDArray[np.float64], costs: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return which costs are to be expected elsewhere, (M,), less their mean: those of a Gaussian process.

    Rasmussen and Williams, Gaussian Processes for Machine Learning, algorithm 2.1, with a squared exponential
    kernel whose length has the greatest likelihood.

    Args:
        points: (N, D), from 0 to 1, with their `costs`, (N,).
        others: (M, D).
    """
    # a case that is impossible, or a cost that is infinite, is as bad as the worst one that is neither
    finite = costs[costs < LARGEST_COST]
    known = np.minimum(costs, finite.max()) if finite.size else np.zeros_like(costs)
    known = known - known.mean()
    among, between = _squares(points, points), _squares(others, points)
    best, found = -np.inf, np.zeros(len(others))
    for length in _LENGTHS:
        scale = -0.5 / (length * length * points.shape[1])
        lower = np.linalg.cholesky(np.exp(scale * among) + _NOISE * np.eye(len(points)))
        weights = np.linalg.solve(lower.T, np.linalg.solve(lower, known))
        # the variance of the costs is the likeliest one
        variance = max(float(known @ weights) / len(points), np.finfo(float).tiny)
        likelihood = -0.5 * len(points) * np.log(variance) - np.log(np.diag(lower)).sum()
        if likelihood > best:
            best, found = likelihood, np.exp(scale * between) @ weights
    return found


def _squares(some: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squared distance of each of some points (N, D) from each of others (M, D), as (N, M)."""
    return np.asarray(((some[:, None] - others[None]) ** 2).sum(axis=-1))
