"""A place at a table, and a robot that sets it: fork, knife and spoon beside the plate, a cup behind it."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence

from spatial_replay.simulation.behaviour import setting_by_tree
from spatial_replay.simulation.grasp import Point
from spatial_replay.simulation.scenario import Placement, Scenario
from spatial_replay.simulation.scene import Scene
from spatial_replay.simulation.shapes import Box, Cylinder
from spatial_replay.simulation.world import Body, Execution, ReachableArea

_UPRIGHT = math.pi / 2
"""Cutlery points along y, away from the diner."""
_STEEL = (0.75, 0.77, 0.8)


def _placing(
    scene: Scene, name: str, goal: Point, yaw: float | None, via: Sequence[Point]
) -> Generator[None, None, Execution]:
    return setting_by_tree(scene, {name: (goal, yaw)}, via)


def _script(scene: Scene) -> Generator[None, None, Execution]:
    x, y = scene.place_of("plate")
    goals: dict[str, tuple[Point, float | None]] = {
        "fork": ((x - 0.14, y), _UPRIGHT),
        "knife": ((x + 0.13, y), _UPRIGHT),
        "spoon": ((x, y - 0.135), 0.0),
        "cup": ((x + 0.08, y + 0.13), None),
    }
    return setting_by_tree(scene, goals)


def _cutlery(name: str, x: float, y: float, yaw: float) -> Placement:
    return Placement(Body(name, "cutlery", Box(0.16, 0.02, 0.012)), x, y, yaw, 0.05, _STEEL)


_CUP = Body("cup", "cup", Cylinder(0.03, 0.07))
_PLATE = Body("plate", "plate", Cylinder(0.08, 0.012), movable=False, support=True)
_MAT = Body("mat", "mat", Box(0.4, 0.42, 0.002), movable=False, support=True)

SCENARIO = Scenario(
    name="table-setting",
    placements=(
        _cutlery("fork", 0.25, 0.42, 0.3),
        _cutlery("knife", 0.25, -0.45, 0.9),
        _cutlery("spoon", 0.02, 0.5, 1.2),
        Placement(_CUP, 0.45, -0.38, 0.0, 0.12, (0.35, 0.5, 0.75)),
        Placement(_PLATE, 0.48, 0.0, 0.0, 0.8, (0.95, 0.95, 0.95), bottom=_MAT.shape.height),
        # without a mass it is fixed
        Placement(_MAT, 0.48, 0.0, _UPRIGHT, 0.0, (0.3, 0.45, 0.4)),
    ),
    workspace=ReachableArea(
        -0.3,
        -0.65,
        0.68,
        0.65,
        nearest=0.33,
        farthest=0.7,
        yaws=(0.0, _UPRIGHT / 2, _UPRIGHT, 1.5 * _UPRIGHT),
    ),
    skill="place",
    script=_script,
    placing=_placing,
)
