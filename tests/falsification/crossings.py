"""A robot that crosses the way of a person: a simulation of one's own, without physics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import spatial_replay as sr

APART = sr.parse_specification("spec apart = G (robot dist person >= 0.3)")
VARIED = {"speed": (0.6, 1.4), "start": (0.0, 6.0), "side": (-1.5, 1.5)}


def crossing(case: Mapping[str, float]) -> Iterator[sr.Sample]:
    """Yield a run of 10 s: the robot along x; a person, from some time on, towards its way."""
    for step in range(51):
        t = 0.2 * step
        y = -5 + 1.2 * max(0.0, t - case["start"])
        yield sr.Sample(
            round(t * 1e9),
            {
                "robot": sr.Footprint.disc(case["speed"] * t, 0.0, 0.3),
                "person": sr.Footprint.disc(5 + case["side"], y, 0.3),
            },
        )
