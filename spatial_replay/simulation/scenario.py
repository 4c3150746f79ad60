"""What makes one world differ from another: the bodies, where they lie, and what the robot can do."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

from spatial_replay.simulation.grasp import Point
from spatial_replay.simulation.picking import picking
from spatial_replay.simulation.scene import Scene
from spatial_replay.simulation.world import Body, Execution, ReachableArea, Skill

Placing = Callable[[Scene, str, Point, float | None], Generator[None, None, Execution]]
"""How a robot picks a body up and places it: `picking`, or something more careful."""

Script = Callable[[Scene], Generator[None, None, Execution]]
"""What the robot does when nobody plans."""


@dataclass(frozen=True, slots=True)
class Placement:
    """A body at the beginning.

    Attributes:
        body: what it is.
        x, y, yaw: where its centre is, in metres and radians.
        bottom: the height of what it lies on, in metres.
        mass_kg: its mass.
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
    """A world before anything happens.

    Attributes:
        name: as on the command line.
        placements: the bodies.
        workspace: where the robot can put them.
        skill: what the robot does with them.
        script: its motion when nobody plans.
        placing: how it picks and places, where that is its skill.
        scatter_m, scatter_rad: how far a seed moves and turns each body, at most.
    """

    name: str
    placements: tuple[Placement, ...]
    workspace: ReachableArea
    skill: Skill
    script: Script
    placing: Placing = picking
    scatter_m: float = 0.01
    scatter_rad: float = 0.2
