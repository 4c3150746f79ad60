"""Worlds for tests, and what is seen of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from spatial_replay.simulation.injection import Injection
from spatial_replay.simulation.tabletop import Tabletop
from spatial_replay.simulation.worlds import make_world
from spatial_replay.trace.sample import Sample

NO_SIMULATOR = "PyBullet is not installed; it has wheels for Python 3.11"


@contextmanager
def world(
    name: str, *, seed: int = 0, noise_m: float = 0.0, inject: tuple[str, ...] = ()
) -> Iterator[tuple[Tabletop, list[Sample]]]:
    """A world, and the samples that it has handed out so far."""
    pytest.importorskip("pybullet", reason=NO_SIMULATOR)
    injections = [Injection.parse(text) for text in inject]
    made = make_world(name, seed=seed, noise_m=noise_m, injections=injections)
    seen: list[Sample] = []
    made.attach(seen.append)
    try:
        yield made, seen
    finally:
        made.close()


def centre(world: Tabletop, name: str) -> tuple[float, float]:
    """Where a body is in the plane."""
    x, y, _ = world.scene.pose(name).position.tolist()
    return x, y


def off(world: Tabletop, name: str, goal: tuple[float, float]) -> float:
    """How far a body is from a point, in metres."""
    return math.dist(centre(world, name), goal)
