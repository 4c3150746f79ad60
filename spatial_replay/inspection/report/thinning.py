"""Which samples of a long run a page keeps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Floats, Integers


class Curves(NamedTuple):
    """What is to be seen of some nodes.

    Attributes:
        times_ns: (T,) int64, a stretch of the run's samples.
        series: (K, 4, T): value, now, lower, upper.
    """

    times_ns: Integers
    series: Floats


def kept_samples(times_ns: Integers, curves: Sequence[Curves], most: int) -> Integers:
    """Indices of the samples to keep, in order: all of them, or at most `most`.

    Of a run that is too long those are the first and the last of all and of each curve, others at equal
    distances, those before and after changes of sign, and those in which a curve has its least and its
    greatest number within a stretch: in this order as long as there is room, and spread over the run where
    there is not.

    Args:
        times_ns: (T,) int64, of all samples.
        most: at least 8, and 4 for each of the curves.
    """
    count = len(times_ns)
    if count <= most:
        return np.arange(count)
    starts = [int(np.searchsorted(times_ns, each.times_ns[0])) for each in curves]
    chosen = np.zeros(count, np.bool_)
    chosen[np.linspace(0, count - 1, most // 4).astype(np.int64)] = True
    for start, each in zip(starts, curves, strict=True):
        chosen[[start, start + len(each.times_ns) - 1]] = True
    stretches = max(1, most // 16)
    for limit, found_in in ((most * 5 // 8, _turns), (most, lambda series: _extremes(series, stretches))):
        for start, each in zip(starts, curves, strict=True):
            _choose(chosen, start + found_in(each.series), limit)
    return np.flatnonzero(chosen)


def _choose(chosen: NDArray[np.bool_], samples: Integers, most: int) -> None:
    """Add samples as long as no more than `most` are chosen."""
    new = samples[~chosen[samples]]
    room = max(0, most - int(np.count_nonzero(chosen)))
    if len(new) > room:
        new = new[np.linspace(0, len(new), room, endpoint=False).astype(np.int64)]
    chosen[new] = True


def _turns(series: Floats) -> Integers:
    """The samples on both sides of a change of sign: of a number, or of an end of its interval."""
    found = [np.empty(0, np.int64)]
    for numbers in series.reshape(-1, series.shape[-1]):
        sign = np.where(np.isnan(numbers), 0, np.where(numbers >= 0.0, 1, -1))
        after = np.flatnonzero(np.diff(sign)) + 1
        found += [after - 1, after]
    return np.unique(np.concatenate(found))


def _extremes(series: Floats, stretches: int) -> Integers:
    """Where value and now are least and greatest within each of so many stretches."""
    count = series.shape[-1]
    starts = np.unique(np.linspace(0, count, stretches, endpoint=False).astype(np.int64))
    found = [np.empty(0, np.int64)]
    for numbers in series[:, :2].reshape(-1, count):
        for infinite, extreme in ((np.inf, np.minimum), (-np.inf, np.maximum)):
            known = np.where(np.isnan(numbers), infinite, numbers)
            best = np.repeat(extreme.reduceat(known, starts), np.diff([*starts, count]))
            hits = np.flatnonzero(known == best)
            # the first in each stretch
            _, first = np.unique(np.searchsorted(starts, hits, side="right"), return_index=True)
            found.append(hits[first])
    return np.unique(np.concatenate(found))
