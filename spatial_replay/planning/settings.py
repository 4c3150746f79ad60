"""How a planner plans: where, with which objects, with which care."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

from spatial_replay.planning.checks import (
    count_faults,
    kind_faults,
    member_faults,
    number_faults,
    refuse_faults,
)
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
        UsageError: values that cannot be, all of them told.
    """

    workspace: Workspace
    skill: Skill = "place"
    movable: tuple[str, ...] | None = None
    margin: float = 0.0
    constraint_margin: float = 0.0
    room: float = 0.0
    attempts: int = 3

    def __post_init__(self) -> None:
        refuse_faults(self._faults())

    def _faults(self) -> Iterator[str]:
        if self.skill not in _SKILLS:
            yield f"skill is {self.skill!r}; the skills are {', '.join(_SKILLS)}"
        faults = kind_faults("workspace", self.workspace, Workspace, "a Workspace")
        yield from faults
        if not faults and self.skill == "push" and self.workspace.yaws:
            yield "an object that is pushed keeps no orientation; leave `yaws` of the workspace out"
        if self.movable is not None:
            yield from member_faults("movable", self.movable, tuple, str, "a tuple of names")
        distances = {name: getattr(self, name) for name in ("margin", "constraint_margin", "room")}
        yield from number_faults(distances, 0)
        yield from count_faults({"attempts": self.attempts})
