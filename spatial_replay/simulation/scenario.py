"""What makes one world differ from another: the bodies, where they lie, and what the robot can do."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Literal

from spatial_replay.simulation.scene import Scene
from spatial_replay.simulation.world import Body, Execution, Workspace

Skill = Literal["push", "place"]

Script = Callable[[Scene], Generator[None, None, Execution]]
"""What the robot does when nobody plans."""


@dataclass(frozen=True, slots=True)
class Placement:
    """A body at the beginning.

    Attributes:
        body: what it is.
        x, y, yaw: where its centre is, in metres and radians.
        mass_kg: its mass.
        colour: red, green, blue from 0 to 1.
    """

    body: Body
    x: float
    y: float
    yaw: float
    mass_kg: float
    colour: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Scenario:
    """A world before anything happens.

    Attributes:
        name: as on the command line.
        placements: the bodies.
        workspace: where the robot can put them.
        skill: what the robot does with them.
        script: its motion when nobody plans.
        scatter_m, scatter_rad: how far a seed moves and turns each body, at most.
    """

    name: str
    placements: tuple[Placement, ...]
    workspace: Workspace
    skill: Skill
    script: Script
    scatter_m: float = 0.01
    scatter_rad: float = 0.2
