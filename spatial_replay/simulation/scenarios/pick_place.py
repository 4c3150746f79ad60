"""Nine objects on a table, from a banana to a box of crackers, and a robot that picks and places them."""

from __future__ import annotations

import math
from collections.abc import Generator

from spatial_replay.planning.decisions import Outcome
from spatial_replay.simulation.arm import Scene, picking
from spatial_replay.simulation.tabletop import Placement, Scenario
from spatial_replay.simulation.world import Body, Box, Cylinder, Shape


def _thing(
    name: str,
    class_name: str,
    shape: Shape,
    position: tuple[float, float],
    mass_kg: float,
    colour: tuple[float, float, float],
    yaw: float = 0.0,
) -> Placement:
    return Placement(Body(name, class_name, shape), *position, yaw, mass_kg, colour)


def _script(scene: Scene) -> Generator[None, None, Outcome]:
    """Set the breakfast: bun on the plate, banana in front, mug and bottle behind; put a box aside."""
    x, y = scene.place_of("plate")
    goals = {
        "kanelbulle": (x, y),
        "banana": (x - 0.12, y - 0.22),
        "mug": (x - 0.05, y + 0.24),
        "bottle": (x - 0.12, y + 0.31),
    }
    outcome = Outcome(True, "nothing to do")
    for name, goal in goals.items():
        outcome = yield from picking(scene, name, goal, None)
        if not outcome.succeeded:
            return outcome
    x, y = scene.place_of("crackerbox")
    return (yield from picking(scene, "sugarbox", (x + 0.15, y - 0.1), None))


_PLATE = Body("plate", "plate", Cylinder(0.09, 0.012), movable=False, support=True)

SCENARIO = Scenario(
    name="pick-place",
    placements=(
        _thing("bottle", "bottle", Cylinder(0.025, 0.12), (-0.15, 0.5), 0.2, (0.2, 0.5, 0.3)),
        _thing("banana", "fruit", Box(0.11, 0.032, 0.032), (0.6, 0.2), 0.12, (0.95, 0.85, 0.2)),
        _thing("mug", "mug", Cylinder(0.032, 0.075), (0.38, -0.45), 0.15, (0.3, 0.4, 0.8)),
        _thing("gelatin", "box", Box(0.07, 0.045, 0.03), (0.15, -0.5), 0.1, (0.8, 0.3, 0.3)),
        _thing("sugarbox", "box", Box(0.085, 0.045, 0.12), (0.3, 0.42), 0.25, (0.9, 0.75, 0.3), math.pi / 2),
        _thing("can", "can", Cylinder(0.032, 0.09), (-0.15, -0.45), 0.25, (0.7, 0.2, 0.2)),
        _thing("crackerbox", "box", Box(0.1, 0.05, 0.14), (0.0, -0.55), 0.3, (0.75, 0.2, 0.15), math.pi / 2),
        _thing("kanelbulle", "bun", Cylinder(0.032, 0.03), (0.12, 0.55), 0.08, (0.7, 0.45, 0.2)),
        Placement(_PLATE, 0.48, 0.0, 0.0, 0.8, (0.9, 0.9, 0.95)),
    ),
    workspace={"area": (-0.3, -0.7, 0.7, 0.7), "nearest": 0.33, "farthest": 0.7},
    skill="place",
    script=_script,
)
