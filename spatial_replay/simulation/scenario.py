"""Scenarios: the bodies of a world, their initial poses, and what the robot does."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass

from spatial_replay.simulation.grasp import Point
from spatial_replay.simulation.picking import picking
from spatial_replay.simulation.scene import Scene
from spatial_replay.simulation.world import Body, Execution, ReachableArea, Skill

Placing = Callable[[Scene, str, Point, float | None, Sequence[Point]], Generator[None, None, Execution]]
"""How the robot picks a body up, carries it along some points and places it: `picking`, or a behaviour tree
around it."""

Script = Callable[[Scene], Generator[None, None, Execution]]
"""The motion of the robot without a planner."""


@dataclass(frozen=True, slots=True)
class Placement:
    """The initial state of a body.

    Attributes:
        x, y, yaw: the pose of its centre, in metres and radians.
        mass_kg: 0 for a fixed body.
        bottom: the height of its support, in metres.
        colour: red, green, blue from 0 to 1.
    """

    body: Body
    x: float
    y: float
    yaw: float
    mass_kg: float
    colour: tuple[float, float, float]
    bottom: float = 0.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """The definition of a world.

    Attributes:
        name: as on the command line.
        placements: the bodies in their initial poses.
        workspace: where the robot can put bodies.
        skill: what the robot does with bodies.
        script: the motion of the robot without a planner.
        placing: how it picks and places, if that is its skill.
        scatter_m, scatter_rad: the maximum shift and rotation of each body by the seed.
    """

    name: str
    placements: tuple[Placement, ...]
    workspace: ReachableArea
    skill: Skill
    script: Script
    placing: Placing = picking
    scatter_m: float = 0.01
    scatter_rad: float = 0.2
