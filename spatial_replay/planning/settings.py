"""How a planner plans: where, with which objects, with which care."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

from spatial_replay.errors import UsageError
from spatial_replay.planning.workspace import Workspace

Skill: TypeAlias = Literal["push", "place"]
"""What the robot does with an object: push it along a path in the plane, or pick it up and place it."""

_SKILLS = ("push", "place")


@dataclass(frozen=True)
class Settings:
    """What a planner has to know besides the specification and the samples.

    Attributes:
        workspace: where objects can be put.
        skill: whether the way matters ("push") or only where it ends ("place").
        movable: names of the objects that the robot can move; None for all that a sample has.
        margin: how well progress has to hold at a target, in the unit of the relations, at least 0.
        constraint_margin: how far constraints have to stay from holding, in the same unit, at least 0.
        room: how far from obstacles an object is placed if it can be, in footprint units, so that it and its
            neighbours can be grasped later; at least 0.
        attempts: how often an edge is tried before it is given up, at least 1.

    Raises:
        UsageError: a value that cannot be.
    """

    workspace: Workspace
    skill: Skill = "place"
    movable: tuple[str, ...] | None = None
    margin: float = 0.0
    constraint_margin: float = 0.0
    room: float = 0.0
    attempts: int = 3

    def __post_init__(self) -> None:
        if self.skill not in _SKILLS:
            raise UsageError(f"skill is {self.skill!r}; the skills are {', '.join(_SKILLS)}")
        for name in ("margin", "constraint_margin", "room"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise UsageError(f"{name} is {getattr(self, name)}; give a number of at least 0")
        if self.attempts < 1:
            raise UsageError(f"attempts is {self.attempts}; give 1 or more")
        if self.skill == "push" and self.workspace.yaws:
            raise UsageError(
                "an object that is pushed keeps no orientation; leave `yaws` of the workspace out"
            )
