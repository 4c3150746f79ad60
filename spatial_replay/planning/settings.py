"""Settings of a planner, and their text in a log, from which decisions can be recomputed."""

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
"""What the robot does with an object: push it along a path in the plane, or pick and place it."""

RoomFrom: TypeAlias = Literal["later", "all"]
"""From what a placed object keeps the preferred room: from what may still be moved, or from everything."""

_SKILLS = ("push", "place")
_ROOM_FROM = ("later", "all")
_PLAIN = (
    "skill",
    "movable",
    "margin",
    "constraint_margin",
    "room",
    "room_from",
    "attempts",
    "motions",
    "lift",
    "refine",
    "rules",
)
"""Settings that stand in the text as they are."""


@dataclass(frozen=True)
class Settings:
    """The settings of a planner, besides the specification.

    Attributes:
        workspace: where objects can be put.
        skill: "push", for which the path matters, or "place", for which only the target does.
        movable: names of the objects that the robot can move; None for all objects of a sample.
        margin: the least robustness of progress at a target, in the unit of the relations, at least 0.
        constraint_margin: how far constraints have to stay from holding, in the same unit, at least 0.
        room: preferred clearance of a placed object, in footprint units, so that it and its neighbours can be
            grasped later; at least 0. Targets with less are used if there is no other.
        room_from: "later" keeps room only from objects that may still have to be moved on the way to
            acceptance, and from everything if the object itself may: where room is not needed, robustness
            counts. "all" always keeps it from everything, whatever robustness that costs.
        attempts: how many failed motions prune an edge, at least 1.
        motions: how many objects are moved for one edge at most, at least 1. With 1, the planner takes one
            edge by one motion and looks no further, as in the paper.
        lift: how high above where it stood an object is carried, in footprint units, at least 0. Its way then
            keeps what must not hold at a distance, over other things where heights allow. None leaves the way
            to the robot.
        refine: whether targets of placed objects are refined within their cell, and, between several
            orientations, to turns in between; without it, they are middles of cells.
        rules: 2, or 1 for the rules of earlier versions, so that their logs can be recomputed: no motions
            that only make room, and an object is never brought near a place where that failed before.

    Raises:
        UsageError: invalid values, all of them reported.
    """

    workspace: Workspace
    skill: Skill = "place"
    movable: tuple[str, ...] | None = None
    margin: float = 0.0
    constraint_margin: float = 0.0
    room: float = 0.0
    room_from: RoomFrom = "later"
    attempts: int = 6
    motions: int = 6
    lift: float | None = 0.0
    refine: bool = True
    rules: int = 2

    def __post_init__(self) -> None:
        refuse_faults(self._faults())

    def _faults(self) -> Iterator[str]:
        if self.skill not in _SKILLS:
            yield f"skill is {self.skill!r}; the skills are {', '.join(_SKILLS)}"
        faults = kind_faults("workspace", self.workspace, Workspace, "a Workspace")
        yield from faults
        if not faults and self.skill == "push" and self.workspace.yaws:
            yield "the orientation of a pushed object cannot be chosen; leave `yaws` of the workspace out"
        if self.movable is not None:
            yield from member_faults("movable", self.movable, tuple, str, "a tuple of names")
        distances = {name: getattr(self, name) for name in ("margin", "constraint_margin", "room")}
        if self.lift is not None:
            distances["lift"] = self.lift
        yield from number_faults(distances, 0)
        yield from count_faults({"attempts": self.attempts, "motions": self.motions})
        if self.room_from not in _ROOM_FROM:
            yield f"room_from is {self.room_from!r}; give {' or '.join(_ROOM_FROM)}"
        yield from kind_faults("refine", self.refine, bool, "True or False")
        if self.rules not in (1, 2):
            yield f"rules is {self.rules!r}; give 2, or 1 for the rules of earlier versions"


def text_from_settings(settings: Settings) -> str:
    """Return settings as JSON, from which `settings_from_text` reads the same numbers."""
    workspace, grid = settings.workspace, settings.workspace.grid
    return json.dumps(
        {
            **{name: getattr(settings, name) for name in _PLAIN},
            "grid": [grid.xmin, grid.ymin, grid.cell_size, grid.columns, grid.rows],
            "yaws": workspace.yaws,
            "base": workspace.base,
            "nearest": workspace.nearest,
            "farthest": workspace.farthest if math.isfinite(workspace.farthest) else None,
            "obstacles": [
                [[part.vertices.tolist(), part.radius] for part in each.parts] for each in workspace.obstacles
            ],
            "supports": sorted(workspace.supports),
            "clearance": workspace.clearance,
        }
    )


def settings_from_text(text: str) -> Settings:
    """Read settings from the text of `text_from_settings`.

    Raises:
        LogError: any other text.
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
        # logs of planners that did not look ahead do not have it
        motions=int(read.get("motions", 1)),
        lift=None if read.get("lift") is None else float(read["lift"]),
        # logs of earlier planners state none of these
        room_from=read.get("room_from", "all"),
        refine=read.get("refine", False),
        rules=read.get("rules", 1),
    )
