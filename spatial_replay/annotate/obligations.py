"""How a requirement stands in a sample: by its own number and by the temporal formulas around it."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.compiled import copying_kernel, floats_at, integers_at
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
    standing, numbers = np.empty(len(at), np.uint8), np.empty(len(at))
    if len(at):
        series, at = np.ascontiguousarray(series), np.ascontiguousarray(at)
        around = np.array([own, conjunct or _NONE, obligation or _NONE], np.int64)
        nodes, _, samples = series.shape
        _stand(series.ctypes.data, nodes, samples, at.ctypes.data, around, standing, numbers)
    return standing, numbers


_NONE = Obligation(-1, 0.0)

_FULFILLED, _HOLDING, _VIOLATED, _PENDING, _UNKNOWN = map(int, Standing)


def _stand_by_arrays(
    series_at: int,
    nodes: int,
    samples: int,
    at_at: int,
    around: Integers,
    standing: NDArray[np.uint8],
    numbers: Floats,
) -> None:
    """Do what `_stand` does, all samples together."""
    series, at = floats_at(series_at, (nodes, 4, samples)), integers_at(at_at, len(standing))
    own, conjunct, obligation = (Obligation(*each) for each in around.tolist())
    now = own.sign * series[own.node, 1, at]
    standing[:] = _UNKNOWN
    standing[now >= 0.0] = _HOLDING
    is_pending = np.full(now.shape, conjunct.node < 0)
    for each in (conjunct, obligation):
        if each.node >= 0:
            is_pending |= each.is_open(series, at)
    fails = now < 0.0
    standing[fails] = np.where(is_pending[fails], _PENDING, _VIOLATED)
    if obligation.node >= 0:
        standing[obligation.is_fulfilled(series, at)] = _FULFILLED
    numbers[:] = np.where((standing == _HOLDING) | (standing == _VIOLATED), now, np.nan)


@copying_kernel(_stand_by_arrays)
def _stand(
    series_at: int,
    nodes: int,
    samples: int,
    at_at: int,
    around: Integers,
    standing: NDArray[np.uint8],
    numbers: Floats,
) -> None:
    """Fill in `standing` and `numbers` as `standing_of` returns them.

    Args:
        around: (3, 2), the requirement, its conjunct and its obligation: a node, -1 for none, and a sign.
    """
    at = integers_at(at_at, standing.shape[0])
    for s in range(standing.shape[0]):
        t = series_at + 8 * at[s]
        now = around[0, 1] * floats_at(t + 8 * samples * (4 * around[0, 0] + 1), 1)[0]
        is_pending, is_fulfilled = around[1, 0] < 0, False
        for k in range(1, 3):
            node, sign = around[k, 0], around[k, 1]
            if node >= 0:
                lower = floats_at(t + 8 * samples * (4 * node + 2), 1)[0]
                upper = floats_at(t + 8 * samples * (4 * node + 3), 1)[0]
                is_pending = is_pending or (upper >= 0.0 if sign > 0 else lower <= 0.0)
                if k == 2:
                    is_fulfilled = lower >= 0.0 if sign > 0 else upper < 0.0
        numbers[s] = np.nan
        if is_fulfilled:
            standing[s] = _FULFILLED
        elif now >= 0.0:
            standing[s], numbers[s] = _HOLDING, now
        elif now < 0.0 and is_pending:
            standing[s] = _PENDING
        elif now < 0.0:
            standing[s], numbers[s] = _VIOLATED, now
        else:
            standing[s] = _UNKNOWN
