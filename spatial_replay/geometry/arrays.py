"""Names for the arrays that geometry takes and gives."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.int8]
Booleans: TypeAlias = NDArray[np.bool_]


def read_only_floats(values: ArrayLike) -> Floats:
    """A contiguous float64 view (or, where need be, copy) that cannot be written to."""
    view = np.ascontiguousarray(values, dtype=np.float64).view()
    view.flags.writeable = False
    return view


def read_only_integers(values: ArrayLike) -> Integers:
    """A contiguous int64 view (or, where need be, copy) that cannot be written to."""
    view = np.ascontiguousarray(values, dtype=np.int64).view()
    view.flags.writeable = False
    return view
