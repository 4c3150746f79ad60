"""Rows of unequal length in one flat array: row r is values[start[r] : start[r + 1]]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spatial_replay.geometry.arrays import Integers


def starts_from_counts(counts: Integers) -> Integers:
    """(n,) lengths of rows → (n + 1,) where each begins and the last ends."""
    start = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=start[1:])
    return start


def flat_index(first: Integers, counts: Integers) -> Integers:
    """Where the elements of rows stand that begin at `first` (n,) and have `counts` (n,) elements."""
    begins = starts_from_counts(counts)
    return np.asarray(np.repeat(first - begins[:-1], counts) + np.arange(begins[-1], dtype=np.int64))


def count_in_rows(flags: NDArray[np.bool_], start: Integers) -> Integers:
    """How many flags are set in each row; rows may be empty."""
    total = starts_from_counts(flags.astype(np.int64))
    return np.asarray(total[start[1:]] - total[start[:-1]])
