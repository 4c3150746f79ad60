"""Small runs to tune on: two boxes, `cup` at a fixed place and `cube` at some distances from it."""

from __future__ import annotations

from collections.abc import Sequence

import spatial_replay as sr

STEP_NS = 500_000_000


def run_at(distances: Sequence[float], **signals: float) -> sr.Trace:
    """A run in which the cube is so far from the cup in one sample after the other."""
    cup = sr.Footprint.box(-1, 0, 0, 1)
    return sr.Trace.from_samples(
        sr.Sample(
            index * STEP_NS, {"cup": cup, "cube": sr.Footprint.box(gap, 0, gap + 1, 1)}, signals=signals
        )
        for index, gap in enumerate(distances)
    )
