"""Descents to the least cost, one after the other: a look around, then CMA-ES from the best place seen.

The only module that knows the package `cma`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import UsageError

_LOOK: Final = 10
"""Points of a look around, spread over the whole space."""
_STEP: Final = 0.2
"""The standard deviation with which a descent begins, as a share of the ranges."""
_NARROWEST: Final = 2e-3
"""The standard deviation at which a descent has arrived."""
_FLAT: Final = 3
"""Generations of equal costs after which a descent is given up."""


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
        self._asked: list[NDArray[np.float64]] = []

    def ask(self) -> list[NDArray[np.float64]]:
        """Return the points of the next round, each (size,), from 0 to 1."""
        self._asked = self._look() if self._strategy is None else self._strategy.ask()
        return [point[: self._size] for point in self._asked]

    def take(self, costs: Sequence[float], *, is_found: bool) -> None:
        """Take the cost of each point of the last round.

        Args:
            is_found: whether one of them is what is searched for: the next descent then begins elsewhere.
        """
        if is_found:
            self._strategy = None
        elif self._strategy is None:
            self._strategy = self._descent(self._asked[int(np.argmin(costs))])
        else:
            self._strategy.tell(self._asked, list(costs))
            if self._strategy.stop():
                self._strategy = None

    def _look(self) -> list[NDArray[np.float64]]:
        """Return points of which each tenth of each dimension has one."""
        columns = [
            (self._random.permutation(_LOOK) + self._random.random(_LOOK)) / _LOOK
            for _ in range(self._searched)
        ]
        return list(np.array(columns).T)

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
