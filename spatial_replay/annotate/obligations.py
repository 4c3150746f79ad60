"""How a requirement stands in a sample: by its own number and by the temporal formulas around it."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers


class Obligation(NamedTuple):
    """A temporal subformula that is in no larger one.

    Attributes:
        node: its id in the formula's tree.
        sign: 1 where the formula needs it to hold, -1 where it needs it not to.
    """

    node: int
    sign: float

    def is_fulfilled(self, series: Floats, at: Integers) -> NDArray[np.bool_]:
        """Return (S,) whether it is decided as it should be, whatever samples follow.

        Args:
            series: (N, 4, T): value, now, lower, upper of each node.
            at: (S,) indices of samples.
        """
        if self.sign > 0.0:
            return np.asarray(series[self.node, 2, at] >= 0.0)
        return np.asarray(series[self.node, 3, at] < 0.0)

    def is_open(self, series: Floats, at: Integers) -> NDArray[np.bool_]:
        """Return (S,) whether it is met, or later samples may still meet it; see `is_fulfilled`."""
        if self.sign > 0.0:
            return np.asarray(series[self.node, 3, at] >= 0.0)
        return np.asarray(series[self.node, 2, at] <= 0.0)


class Standing(IntEnum):
    """How a requirement stands in a sample.

    `FULFILLED`: its obligation is, so that it no longer counts. `HOLDING` and `VIOLATED`: now, in the sign
    that counts. `PENDING`: it fails now, and later samples can make up for that. `UNKNOWN`: not observed.
    """

    FULFILLED = 0
    HOLDING = 1
    VIOLATED = 2
    PENDING = 3
    UNKNOWN = 4


def standing_of(
    series: Floats, at: Integers, own: Obligation, obligation: Obligation | None, conjunct: Obligation | None
) -> tuple[NDArray[np.uint8], Floats]:
    """Return how a requirement stands in some samples (S,), and its robustness where that counts.

    Args:
        series: (N, 4, T): value, now, lower, upper of each node.
        at: (S,) indices of samples.
        own: the requirement itself.
        obligation: the temporal subformula that needs it; None if there is none.
        conjunct: the one of the formula that it is in; None if its failing now violates nothing.

    Returns:
        (S,) numbers of `Standing`, and (S,) its robustness, in the sign that counts, where it holds or is
        violated; else NaN.
    """
    now = own.sign * series[own.node, 1, at]
    standing = np.full(now.shape, Standing.UNKNOWN, np.uint8)
    standing[now >= 0.0] = Standing.HOLDING
    is_pending = np.full(now.shape, conjunct is None)
    for each in (conjunct, obligation):
        if each is not None:
            is_pending |= each.is_open(series, at)
    fails = now < 0.0
    standing[fails] = np.where(is_pending[fails], Standing.PENDING, Standing.VIOLATED)
    if obligation is not None:
        standing[obligation.is_fulfilled(series, at)] = Standing.FULFILLED
    counts = (standing == Standing.HOLDING) | (standing == Standing.VIOLATED)
    return standing, np.where(counts, now, np.nan)
