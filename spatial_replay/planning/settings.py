"""Settings of a planner: their text in a log, and the files and options in which people write them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from os import PathLike
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias

from spatial_replay.errors import GeometryError, LogError, UsageError
from spatial_replay.geometry.footprint import ConvexPart, Footprint
from spatial_replay.logs.remote import log_file
from spatial_replay.mapping.yaml_document import checked_document, read_yaml_text
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
SCHEMA_FILE: Final = "settings.schema.json"
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
        refine: whether targets are refined near their cell, and, between several orientations, to turns in
            between; without it, they are middles of cells.
        rules: 4, or those of earlier versions, so that their logs can be recomputed. 3: what only makes room
            goes to the nearest place, whatever has to be kept there later, and a motion that failed may be
            made again while nothing has changed. 2: targets of pushes are not refined, either. 1: also no
            motions that only make room, and an object is never brought near a place where that failed before.

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
    rules: int = 4

    def __post_init__(self) -> None:
        refuse_faults(self._faults())
        if self.skill == "push" and self.workspace.yaws and not self.workspace.keeps_yaw:
            object.__setattr__(self, "workspace", replace(self.workspace, keeps_yaw=True))

    def _faults(self) -> Iterator[str]:
        if self.skill not in _SKILLS:
            yield f"skill is {self.skill!r}; the skills are {', '.join(_SKILLS)}"
        yield from kind_faults("workspace", self.workspace, Workspace, "a Workspace")
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
        if self.rules not in (1, 2, 3, 4):
            yield f"rules is {self.rules!r}; give 4, or 1 to 3 for the rules of earlier versions"


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


# ------------------------------------------------------------------------------------- files and options


@cache
def settings_schema() -> Mapping[str, Any]:
    """Return the JSON Schema of settings files; its properties are all settings, each with a description."""
    text = files("spatial_replay.planning").joinpath(SCHEMA_FILE).read_text(encoding="utf-8")
    schema: Mapping[str, Any] = json.loads(text)
    return schema


def load_settings(path: str | PathLike[str], base: Settings | None = None) -> Settings:
    """Load a settings file (YAML), which changes some settings of others.

    Args:
        path: of the file, or its address.
        base: the settings to change; without them, the file has to give `area` and `cell_size`.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the file is not valid; all errors are listed.
    """
    return changed_settings(base, parse_settings(read_yaml_text(path), log_file(path).name))


def parse_settings(text: str, name: str = "settings") -> Mapping[str, Any]:
    """Parse the text of a settings file, and return what it changes, by setting.

    Args:
        name: of the file, for errors.

    Raises:
        UsageError: the text is not valid; all errors are listed.
    """
    document = checked_document(text, name, settings_schema(), lambda document: [], "a settings file")
    value: Any = document.value
    return dict(value)


def parse_setting(key: str, text: str) -> Mapping[str, Any]:
    """Parse one setting as YAML, as an option gives it; a list needs no brackets.

    Raises:
        UsageError: the value is not valid.
    """
    kind = settings_schema()["properties"][key]
    is_list = kind.get("type") == "array" or any("names" in each.get("$ref", "") for each in _options(kind))
    if is_list and text.strip() != "null" and not text.strip().startswith("["):
        text = f"[{text}]"
    option = f"--{key.replace('_', '-')}"
    try:
        return parse_settings(f"{key}: {text}", option)
    except UsageError as error:
        # there is one line, and the option names the key
        message = str(error).replace(f"{option}:1: {key}", option, 1).replace(f"{option}:1", option)
        raise UsageError(message) from None


def _options(kind: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [kind, *kind.get("anyOf", ())]


def changed_settings(base: Settings | None, changes: Mapping[str, Any]) -> Settings:
    """Return settings with some changed, by the keys and values of a settings file.

    Raises:
        UsageError: values that do not go together, or no grid.
    """
    grid = _changed_grid(None if base is None else base.workspace.grid, changes)
    workspace = Workspace(grid) if base is None else replace(base.workspace, grid=grid)
    of_workspace = {key: read(changes[key]) for key, read in _OF_WORKSPACE.items() if key in changes}
    plain = {key: _plain(key, changes[key]) for key in _PLAIN if key in changes}
    workspace = replace(workspace, **of_workspace)
    return Settings(workspace, **plain) if base is None else replace(base, workspace=workspace, **plain)


def _changed_grid(grid: Grid | None, changes: Mapping[str, Any]) -> Grid:
    if grid is None and not {"area", "cell_size"} <= changes.keys():
        raise UsageError("where to plan is not known; give area: [xmin, ymin, xmax, ymax], and cell_size")
    if grid is not None and not {"area", "cell_size"} & changes.keys():
        return grid
    cell_size = float(changes["cell_size"]) if grid is None or "cell_size" in changes else grid.cell_size
    if grid is None or "area" in changes:
        box = tuple(map(float, changes["area"]))
    else:
        xmax, ymax = grid.xmin + grid.columns * grid.cell_size, grid.ymin + grid.rows * grid.cell_size
        box = (grid.xmin, grid.ymin, xmax, ymax)
    xmin, ymin, xmax, ymax = box
    return Grid.over(xmin, ymin, xmax, ymax, cell_size)


def _plain(key: str, value: Any) -> Any:
    if key in _LENGTHS and value is not None:
        return float(value)
    return tuple(value) if isinstance(value, list) else value


_LENGTHS = ("margin", "constraint_margin", "room", "lift")


def _angle(value: float | str) -> float:
    return math.radians(float(value.removesuffix("deg"))) if isinstance(value, str) else float(value)


def _obstacle(value: Mapping[str, Any]) -> Footprint:
    ((shape, numbers),) = value.items()
    if shape == "polygon":
        return Footprint.polygon(numbers)
    return Footprint.box(*numbers) if shape == "box" else Footprint.disc(*numbers)


_OF_WORKSPACE: Final[Mapping[str, Callable[[Any], Any]]] = MappingProxyType(
    {
        "yaws": lambda each: tuple(map(_angle, each)),
        "base": lambda each: (float(each[0]), float(each[1])),
        "nearest": float,
        "farthest": lambda each: math.inf if each is None else float(each),
        "obstacles": lambda each: tuple(map(_obstacle, each)),
        "supports": frozenset,
        "clearance": float,
    }
)


def changes_text(before: Settings, after: Settings) -> tuple[str, ...]:
    """Return what differs between two settings, such as "room 0.09 -> 0.02"."""
    old, new = (json.loads(text_from_settings(each)) for each in (before, after))
    return tuple(f"{key} {_brief(old[key])} -> {_brief(new[key])}" for key in old if old[key] != new[key])


def _brief(value: Any) -> str:
    text = json.dumps(value).replace('"', "")
    return text if len(text) <= 60 else f"{text[:59]}…"
