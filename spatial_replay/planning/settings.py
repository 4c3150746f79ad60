"""How a planner plans: where, with which objects, with which care.

Settings of a planner as text and back, so that a log can hold them and a decision be made again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from spatial_replay.errors import GeometryError, LogError, UsageError
from spatial_replay.geometry.footprint import ConvexPart, Footprint
from spatial_replay.planning.workspace import (
    Grid,
    Workspace,
    count_faults,
    kind_faults,
    member_faults,
    number_faults,
    refuse_faults,
)

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


def text_from_settings(settings: Settings) -> str:
    """Settings in JSON; every number is read back as it was."""
    workspace, grid = settings.workspace, settings.workspace.grid
    return json.dumps(
        {
            "skill": settings.skill,
            "movable": settings.movable,
            "margin": settings.margin,
            "constraint_margin": settings.constraint_margin,
            "room": settings.room,
            "attempts": settings.attempts,
            "grid": [grid.xmin, grid.ymin, grid.cell_size, grid.columns, grid.rows],
            "yaws": workspace.yaws,
            "base": workspace.base,
            "nearest": workspace.nearest,
            "farthest": workspace.farthest if math.isfinite(workspace.farthest) else None,
            "obstacles": [
                [[part.vertices.tolist(), part.radius] for part in obstacle.parts]
                for obstacle in workspace.obstacles
            ],
            "supports": sorted(workspace.supports),
            "clearance": workspace.clearance,
        }
    )


def settings_from_text(text: str) -> Settings:
    """Settings from what `text_from_settings` gave.

    Raises:
        LogError: the text is not that.
    """
    try:
        return _settings(json.loads(text))
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, GeometryError, UsageError) as error:
        raise LogError(f"the planner's settings in the log cannot be read: {error}") from error


def _settings(read: dict[str, Any]) -> Settings:
    xmin, ymin, cell_size, columns, rows = read["grid"]
    workspace = Workspace(
        Grid(float(xmin), float(ymin), float(cell_size), int(columns), int(rows)),
        yaws=tuple(map(float, read["yaws"])),
        base=(float(read["base"][0]), float(read["base"][1])),
        nearest=float(read["nearest"]),
        farthest=math.inf if read["farthest"] is None else float(read["farthest"]),
        obstacles=tuple(
            Footprint(tuple(ConvexPart(vertices, radius) for vertices, radius in parts))
            for parts in read["obstacles"]
        ),
        supports=frozenset(read["supports"]),
        clearance=float(read["clearance"]),
    )
    return Settings(
        workspace,
        read["skill"],
        movable=None if read["movable"] is None else tuple(read["movable"]),
        margin=float(read["margin"]),
        constraint_margin=float(read["constraint_margin"]),
        room=float(read["room"]),
        attempts=int(read["attempts"]),
    )
