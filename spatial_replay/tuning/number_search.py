"""Searches among whole numbers with few evaluations: how far a condition holds, and where a cost is least."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spatial_replay.errors import importing

_GENERATIONS, _CANDIDATES = 15, 6
"""Bounds of an evolution: its generations, and candidates of each for every number."""


def last_that_holds(inside: int, end: int, holds: Callable[[int], bool]) -> int:
    """Return the last number up to which a condition holds: looked for at doubling steps, then by halves.

    It costs few evaluations, all of them near to where it starts, if it does not hold far.

    Args:
        inside: holds, and is not evaluated.
        end: the last number to look at, on either side.
        holds: once it fails, it is taken to fail from there to the end.
    """
    step = 1
    while inside != end:
        ahead = min(inside + step, end) if end > inside else max(inside - step, end)
        if not holds(ahead):
            return last_before(inside, ahead, holds)
        inside, step = ahead, 2 * step
    return inside


def last_before(inside: int, outside: int, holds: Callable[[int], bool]) -> int:
    """Return the last number that holds between one that does and another, on either side, that does not."""
    while abs(outside - inside) > 1:
        middle = (inside + outside) // 2
        if holds(middle):
            inside = middle
        else:
            outside = middle
    return inside


def evolve(
    cost: Callable[[Sequence[int]], float], sizes: Sequence[int], start: Sequence[int], seed: int
) -> None:
    """Let SciPy look for numbers, from 0 to some sizes, of the least cost: the best that it asked for.

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
        init="sobol",
        popsize=_CANDIDATES,
        maxiter=_GENERATIONS,
        polish=False,
    )
