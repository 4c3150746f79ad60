"""Worlds for tests, with their samples."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from spatial_replay import Sample
from spatial_replay.simulation.tabletop import Tabletop, make_world
from spatial_replay.simulation.world import Injection, Start

NO_SIMULATOR = "PyBullet is not installed; it has wheels for Python 3.11"


@contextmanager
def world(
    name: str,
    *,
    seed: int = 0,
    noise_m: float = 0.0,
    inject: tuple[str, ...] = (),
    starts: tuple[Start, ...] = (),
) -> Iterator[tuple[Tabletop, list[Sample]]]:
    """Create a world; yield it with the list of its samples so far."""
    pytest.importorskip("pybullet", reason=NO_SIMULATOR)
    injections = [Injection.parse(text) for text in inject]
    made = make_world(name, seed=seed, noise_m=noise_m, injections=injections, starts=starts)
    seen: list[Sample] = []
    made.attach(seen.append)
    try:
        yield made, seen
    finally:
        made.close()


def centre(world: Tabletop, name: str) -> tuple[float, float]:
    """Return the centre of a body in the plane."""
    x, y, _ = world.scene.pose(name).position.tolist()
    return x, y


def off(world: Tabletop, name: str, goal: tuple[float, float]) -> float:
    """Return the distance of a body from a point, in metres."""
    return math.dist(centre(world, name), goal)
