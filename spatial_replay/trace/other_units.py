"""Runs in other units, known by the sizes of what both have."""

from __future__ import annotations

from typing import Final

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.trace.trace import Trace

OTHER_UNITS: Final = 8.0
"""What is so many times as large in one of two runs is in another unit there."""

_MOST_SIZES: Final = 256
"""Samples of an object that its size is the median of."""


def require_same_units(a: Trace, b: Trace, called: tuple[str, str] = ("A", "B")) -> None:
    """Refuse runs whose common objects are all many times as large in one as in the other.

    Args:
        called: what the runs are called in the message.

    Raises:
        UsageError: the runs are in other units.
    """
    ratios, example = [], ""
    for name in sorted(set(a.names) & set(b.names)):
        one, other = _size(a, name), _size(b, name)
        if min(one, other) > 0.0:
            ratios.append(one / other)
            times, which = (ratios[0], called[0]) if ratios[0] > 1.0 else (1.0 / ratios[0], called[1])
            example = example or f"{name} is {times:,.0f} times as large in {which}"
    if ratios and (min(ratios) >= OTHER_UNITS or max(ratios) <= 1.0 / OTHER_UNITS):
        runs = "the runs" if called == ("A", "B") else " and ".join(called)
        raise UsageError(
            f"{runs} seem to be in other units: {example}. Read both in one unit, by a mapping with `scale`"
        )


def _size(trace: Trace, name: str) -> float:
    """Return the median extent of an object, radii included; 0 where it is a point or never observed."""
    rows = trace.rows[:, trace.names.index(name)]
    rows = rows[rows >= 0]
    if not len(rows):
        return 0.0
    batch = trace.footprints.select(rows[:: -(-len(rows) // _MOST_SIZES)])
    start = batch.vertex_start[batch.part_start[:-1]]
    spans = [np.maximum.reduceat(x, start) - np.minimum.reduceat(x, start) for x in batch.vertices.T]
    return float(np.median(np.hypot(*spans) + 2.0 * np.maximum.reduceat(batch.radius, batch.part_start[:-1])))
