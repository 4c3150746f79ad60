"""Settings of a planner and its workspace: their text in a log, settings files and options.

The workspace is a grid of positions, orientations, reach and obstacles. A check collects the faults of all
values, so that one error reports all faults.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from os import PathLike
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from spatial_replay.errors import GeometryError, LogError, UsageError
from spatial_replay.geometry.arrays import Booleans, Floats
from spatial_replay.geometry.footprint import ConvexPart, Footprint
from spatial_replay.logs.remote import log_file
from spatial_replay.mapping.yaml_document import checked_document, read_yaml_text, schema_of
from spatial_replay.text import cut, named_arguments, nearest_hint
from spatial_replay.trace.trace import Sample

# ---------------------------------------------------------------------------------------------- the workspace

MOST_CELLS = 1_000_000
"""Maximum number of cells over all orientations; maps of this size take 1 GB."""

CELLS_AROUND = 80
"""Number of cells along the longer side of a default workspace."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A grid of square cells in the plane; a map has a value for the centre of each cell.

    Attributes:
        xmin, ymin: corner of the first cell, footprint units.
        cell_size: side of a cell, footprint units.
        columns, rows: numbers of cells along x and along y.

    Raises:
        UsageError: invalid numbers, or more than `MOST_CELLS` cells.
    """

    xmin: float
    ymin: float
    cell_size: float
    columns: int
    rows: int

    def __post_init__(self) -> None:
        corner = {"xmin": self.xmin, "ymin": self.ymin}
        faults = number_faults(corner) + count_faults({"columns": self.columns, "rows": self.rows})
        if not (is_number(self.cell_size) and 0.0 < self.cell_size < math.inf):
            faults.append(f"cell_size is {self.cell_size!r}; give a finite number above 0")
        if not faults and self.columns * self.rows > MOST_CELLS:
            faults.append(
                f"a grid of {self.columns} x {self.rows} cells; give at most {MOST_CELLS:,} cells in all"
            )
        refuse_faults(faults)

    @classmethod
    def over(cls, xmin: float, ymin: float, xmax: float, ymax: float, cell_size: float) -> Grid:
        """Return the grid over a box; the last cells may extend beyond the box.

        Raises:
            UsageError: an empty box, or invalid numbers.
        """
        box = f"the box ({xmin}, {ymin}, {xmax}, {ymax})"
        if not all(map(math.isfinite, (xmin, ymin, xmax, ymax))):
            raise UsageError(f"{box} is not finite; give four numbers")
        if not (xmin < xmax and ymin < ymax):
            raise UsageError(f"{box} is empty; give xmin, ymin, xmax, ymax")
        if not (is_number(cell_size) and cell_size > 0.0):
            raise UsageError(f"cell_size is {cell_size!r}; give a number above 0")
        # without the tolerance, rounding could add a cell to a box of a whole number of cells
        columns, rows = (math.ceil(length / cell_size - 1e-9) for length in (xmax - xmin, ymax - ymin))
        return cls(xmin, ymin, cell_size, columns, rows)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.rows, self.columns

    def centres(self) -> Floats:
        """Return the centre of each cell, (rows * columns, 2), row by row."""
        x = self.xmin + (np.arange(self.columns) + 0.5) * self.cell_size
        y = self.ymin + (np.arange(self.rows) + 0.5) * self.cell_size
        centres = np.empty((*self.shape, 2))
        centres[:, :, 0], centres[:, :, 1] = x[None, :], y[:, None]
        return centres.reshape(-1, 2)

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """Return the centre (x, y) of a cell."""
        x = self.xmin + (column + 0.5) * self.cell_size
        return x, self.ymin + (row + 0.5) * self.cell_size

    def contains(self, points: Floats) -> Booleans:
        """Return whether each point (…, 2) is in a cell, (…)."""
        cells = (points - np.array([self.xmin, self.ymin])) / self.cell_size
        return np.asarray(((cells >= 0.0) & (cells < np.array([self.columns, self.rows]))).all(axis=-1))

    def reaching(self, x: float, y: float) -> Grid:
        """Return this grid, extended on up to two sides to contain a point.

        A point that is farther away than the length of the grid does not extend the grid.
        """
        row, column = self._cell(x, y)
        left, below = max(-column, 0), max(-row, 0)
        right, above = max(column + 1 - self.columns, 0), max(row + 1 - self.rows, 0)
        columns, rows = self.columns + left + right, self.rows + below + above
        most_added = max(left, below, right, above)
        if not most_added or most_added > max(self.shape) or columns * rows > MOST_CELLS:
            return self
        xmin, ymin = self.xmin - left * self.cell_size, self.ymin - below * self.cell_size
        return Grid(xmin, ymin, self.cell_size, columns, rows)

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Return the cell (row, column) of a point, or the cell nearest to a point outside the grid."""
        row, column = self._cell(x, y)
        return min(max(row, 0), self.rows - 1), min(max(column, 0), self.columns - 1)

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        """Return the cell (row, column) of a point in the unbounded grid."""
        return math.floor((y - self.ymin) / self.cell_size), math.floor((x - self.xmin) / self.cell_size)


@dataclass(frozen=True)
class Workspace:
    """The poses to which a robot can bring objects.

    Attributes:
        grid: possible positions of an object's centre.
        yaws: possible orientations of objects, radians; empty to keep orientations. An object of unknown
            orientation is turned by these angles.
        keeps_yaw: whether an object may also keep its orientation. If so, an object of unknown orientation
            always keeps its orientation. Settings with the skill "push" set this attribute.
        base: position (x, y) of the robot.
        nearest, farthest: range of distances from the base within the robot's reach, footprint units.
        obstacles: static obstacles, in addition to the objects of a sample.
        supports: names of objects on which other objects may be placed; supports are no obstacles.
        clearance: least distance between objects, footprint units.

    Raises:
        UsageError: invalid values; the message lists all invalid values.
    """

    grid: Grid
    yaws: tuple[float, ...] = ()
    base: tuple[float, float] = (0.0, 0.0)
    nearest: float = 0.0
    farthest: float = math.inf
    obstacles: tuple[Footprint, ...] = ()
    supports: frozenset[str] = field(default_factory=frozenset)
    clearance: float = 0.0
    keeps_yaw: bool = False

    def __post_init__(self) -> None:
        refuse_faults(self._faults())

    @property
    def named_obstacles(self) -> dict[str, Footprint]:
        """The obstacles by the names that drawings show; settings have no names for obstacles."""
        if len(self.obstacles) == 1:
            return {"obstacle": self.obstacles[0]}
        return {f"obstacle {number}": obstacle for number, obstacle in enumerate(self.obstacles)}

    def _faults(self) -> Iterator[str]:
        yield from kind_faults("grid", self.grid, Grid, "a Grid")
        yield from kind_faults("yaws", self.yaws, tuple, "a tuple of angles in radians") or number_faults(
            {f"yaws[{place}]": yaw for place, yaw in enumerate(self.yaws)}
        )
        base: Any = self.base
        if isinstance(base, tuple) and len(base) == 2:
            yield from number_faults({"base[0]": base[0], "base[1]": base[1]})
        else:
            yield f"base is {base!r}; give (x, y)"
        if isinstance(self.grid, Grid) and isinstance(self.yaws, tuple):
            cells, angles = self.grid.columns * self.grid.rows, len(self.yaws)
            if cells * angles > MOST_CELLS:
                yield (
                    f"a grid of {cells:,} cells in {angles:,} orientations; give at most {MOST_CELLS:,} "
                    "cells over all of them"
                )
        faults = number_faults({"nearest": self.nearest}, 0)
        yield from faults
        if not is_number(self.farthest):
            yield f"farthest is {self.farthest!r}; give a number, or math.inf"
        elif not faults and self.farthest < self.nearest:
            yield f"farthest is {self.farthest}; give at least nearest, {self.nearest}"
        yield from member_faults("obstacles", self.obstacles, tuple, Footprint, "a tuple of footprints")
        yield from member_faults("supports", self.supports, frozenset, str, "a frozenset of names")
        yield from number_faults({"clearance": self.clearance}, 0)

    @classmethod
    def around(cls, sample: Sample) -> Workspace:
        """Return a workspace around all objects of a sample; each margin is half the objects' extent.

        Raises:
            UsageError: the sample has no object.
        """
        footprint_parts = [part for tracked in sample.objects.values() for part in tracked.footprint.parts]
        if not footprint_parts:
            raise UsageError("there is nothing in the sample to lay a grid around; give a workspace")
        lowest = np.min([part.vertices.min(axis=0) - part.radius for part in footprint_parts], axis=0)
        highest = np.max([part.vertices.max(axis=0) + part.radius for part in footprint_parts], axis=0)
        longer_side = float((highest - lowest).max()) or 1.0
        (xmin, ymin), (xmax, ymax) = (lowest - longer_side / 2).tolist(), (highest + longer_side / 2).tolist()
        return cls(Grid.over(xmin, ymin, xmax, ymax, 2.0 * longer_side / CELLS_AROUND))

    def turns(self, yaw: float | None) -> Floats:
        """Return the angles by which an object with an orientation may be turned, (A,), radians."""
        if not self.keeps_yaw:
            return np.array(self.yaws) - (yaw or 0.0) if self.yaws else np.zeros(1)
        # each turn has the shorter direction
        turn_angles = () if yaw is None else (math.remainder(angle - yaw, math.tau) for angle in self.yaws)
        return np.array([0.0, *turn_angles])

    def within_reach(self, grid: Grid) -> Booleans:
        """Return whether the robot reaches the centre of each cell of a grid, (rows, columns).

        Cells outside the workspace's own grid are out of reach.
        """
        if grid == self.grid and self.nearest <= 0.0 and self.farthest == math.inf:
            return np.ones(grid.shape, np.bool_)
        centres = grid.centres()
        distance = np.hypot(*(centres - np.array(self.base)).T)
        is_reached = (distance >= self.nearest) & (distance <= self.farthest) & self.grid.contains(centres)
        return np.asarray(is_reached.reshape(grid.shape))


def refuse_faults(faults: Iterable[str]) -> None:
    """Check that there are no faults.

    Raises:
        UsageError: the message has each fault on a line.
    """
    message = "\n".join(faults)
    if message:
        raise UsageError(message)


def is_number(value: object) -> bool:
    """Return whether a value is a number other than NaN; booleans are not numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)


def number_faults(values: Mapping[str, Any], least: float = -math.inf) -> list[str]:
    """Return a fault for each named value that is not a finite number of at least `least`."""
    expected = "a finite number" if least == -math.inf else f"a finite number of at least {least:g}"
    return [
        f"{name} is {value!r}; give {expected}"
        for name, value in values.items()
        if not (is_number(value) and math.isfinite(value) and value >= least)
    ]


def count_faults(values: Mapping[str, Any]) -> list[str]:
    """Return a fault for each named value that is not a whole number of at least 1."""
    return [
        f"{name} is {value!r}; give a whole number of at least 1"
        for name, value in values.items()
        if not isinstance(value, int) or isinstance(value, bool) or value < 1
    ]


def kind_faults(name: str, value: object, kind: type, wanted: str) -> list[str]:
    """Return a fault if a value is not of a type."""
    return [] if isinstance(value, kind) else [f"{name} is {value!r}; give {wanted}"]


def member_faults(
    name: str, members: Collection[Any], collection: type, member: type, wanted: str
) -> list[str]:
    """Return faults if `members` is not a collection of the type, or has members of another type."""
    return kind_faults(name, members, collection, wanted) or [
        f"{name} has {value!r}; give {wanted}" for value in members if not isinstance(value, member)
    ]


# --------------------------------------------------------------------------------------------------- settings

Skill: TypeAlias = Literal["push", "place"]
"""Skill of the robot: push an object along a path in the plane, or pick and place it."""

RoomFrom: TypeAlias = Literal["later", "all"]
"""Objects from which a placed object keeps room: objects that may need a later motion, or all objects."""

_SKILLS = ("push", "place")
_ROOM_FROM = ("later", "all")


@named_arguments
@dataclass(frozen=True)
class Settings:
    """The settings of a planner.

    Attributes:
        workspace: poses to which objects can be brought.
        skill: "push" (the path matters) or "place" (only the target matters).
        movable: names of the objects that the robot can move; None for all objects of a sample.
        margin: least robustness of progress at a target, in the unit of the relations, at least 0.
        constraint_margin: margin by which constraints must be false, in the relations' unit, at least 0.
        room: preferred clearance of a placed object, footprint units, at least 0. Room allows later grasps of
            the object and its neighbours. Without targets of this room, targets with less room are used.
        room_from: "later" keeps room from objects that may need a later motion; without such objects, only
            robustness decides. A placed object that may need a later motion itself keeps room from all
            objects. "all" always keeps room from all objects, even at the cost of robustness.
        attempts: number of failed motions of one object that prune an edge, at least 1. Refused motions count
            as failed.
        motions: maximum number of objects that are moved for one edge, at least 1. With 1, the planner takes
            each edge by one motion and does not look ahead, as in the paper.
        lift: height by which a carried object is raised, footprint units, at least 0. The path avoids
            constraints, and may cross low objects. None leaves the path to the robot.
        refine: whether targets are refined near the centre of their cell and, with several orientations,
            between the orientations. Without refinement, targets are centres of cells.

    Raises:
        UsageError: invalid values; the message lists all invalid values.
    """

    workspace: Workspace
    skill: Skill = "place"
    movable: tuple[str, ...] | None = None
    margin: float = 0.0
    constraint_margin: float = 0.0
    room: float = 0.0
    room_from: RoomFrom = "later"
    attempts: int = 6
    motions: int = 8
    lift: float | None = 0.0
    refine: bool = True

    def __post_init__(self) -> None:
        refuse_faults(self._faults())
        if self.skill == "push" and self.workspace.yaws and not self.workspace.keeps_yaw:
            # the dataclass is frozen
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


_PLAIN: Final = tuple(setting.name for setting in fields(Settings) if setting.name != "workspace")
"""Settings that the text contains without conversion."""


def text_from_settings(settings: Settings) -> str:
    """Return settings as JSON; `settings_from_text` reads exactly equal settings."""
    workspace, grid = settings.workspace, settings.workspace.grid
    return json.dumps(
        {
            **{name: getattr(settings, name) for name in _PLAIN},
            "grid": [grid.xmin, grid.ymin, grid.cell_size, grid.columns, grid.rows],
            "yaws": workspace.yaws,
            "base": workspace.base,
            "nearest": workspace.nearest,
            # JSON has no infinity
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
    """Read settings from the text of `text_from_settings`.

    Raises:
        LogError: the text is not valid.
    """
    try:
        return _settings(json.loads(text))
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, GeometryError, UsageError) as error:
        raise LogError(f"the planner's settings in the log cannot be read: {error}") from error


def _settings(document: dict[str, Any]) -> Settings:
    xmin, ymin, cell_size, columns, rows = document["grid"]
    workspace = Workspace(
        Grid(float(xmin), float(ymin), float(cell_size), int(columns), int(rows)),
        obstacles=tuple(
            Footprint(tuple(ConvexPart(vertices, radius) for vertices, radius in parts))
            for parts in document["obstacles"]
        ),
        **{key: value(document[key]) for key, value in _OF_WORKSPACE.items() if key != "obstacles"},
    )
    return Settings(workspace, **{key: _plain(key, document[key]) for key in _PLAIN})


# ------------------------------------------------------------------------------------- files and options


def load_settings(path: str | PathLike[str], base: Settings | None = None) -> Settings:
    """Load a settings file (YAML), which changes some of the settings `base`.

    Args:
        path: path or address of the file.
        base: settings to change. Without `base`, the file must have `area` and `cell_size`.

    Raises:
        MissingFileError: there is no such file.
        UsageError: the file is not valid; all errors are listed.
    """
    return changed_settings(base, parse_settings(read_yaml_text(path), log_file(path).name))


def parse_settings(text: str, name: str = "settings") -> Mapping[str, Any]:
    """Parse the text of a settings file, and return its changes by setting.

    Args:
        name: name of the file, for errors.

    Raises:
        UsageError: the text is not valid; all errors are listed.
    """
    schema = schema_of("planning", "settings")
    value: Any = checked_document(text, name, schema, lambda document: [], "a settings file").value
    return dict(value)


def parse_setting(text: str) -> Mapping[str, Any]:
    """Parse one setting, KEY=VALUE, with the syntax of a settings file; a list needs no brackets.

    Raises:
        UsageError: there is no such setting, or the value is not valid.
    """
    key, equals, value = text.partition("=")
    schema_by_key = schema_of("planning", "settings")["properties"]
    if not equals or key not in schema_by_key:
        hint = nearest_hint(key, schema_by_key) or f"the keys are {', '.join(schema_by_key)}"
        raise UsageError(f"--set {text!r:.100}: give KEY=VALUE; {hint}")
    value_schemas = [schema_by_key[key], *schema_by_key[key].get("anyOf", ())]
    is_list = schema_by_key[key].get("type") == "array" or any(
        "names" in kind.get("$ref", "") for kind in value_schemas
    )
    if is_list and value.strip() != "null" and not value.strip().startswith("["):
        value = f"[{value}]"
    option = f"--set {key}"
    try:
        return parse_settings(f"{key}: {value}", option)
    except UsageError as error:
        # a setting has only one line, and the option already names the key
        message = str(error).replace(f"{option}:1: {key}", option, 1).replace(f"{option}:1", option)
        raise UsageError(message) from None


def changed_settings(base: Settings | None, changes: Mapping[str, Any]) -> Settings:
    """Return settings with changes, by the keys and values of a settings file.

    Raises:
        UsageError: values that contradict each other, or no grid.
    """
    grid = _changed_grid(None if base is None else base.workspace.grid, changes)
    workspace = Workspace(grid) if base is None else replace(base.workspace, grid=grid)
    workspace_values = {key: read(changes[key]) for key, read in _OF_WORKSPACE.items() if key in changes}
    plain_values = {key: _plain(key, changes[key]) for key in _PLAIN if key in changes}
    workspace = replace(workspace, **workspace_values)
    return (
        Settings(workspace, **plain_values)
        if base is None
        else replace(base, workspace=workspace, **plain_values)
    )


def _changed_grid(grid: Grid | None, changes: Mapping[str, Any]) -> Grid:
    if grid is None and not {"area", "cell_size"} <= changes.keys():
        raise UsageError("where to plan is not known; give area: [xmin, ymin, xmax, ymax], and cell_size")
    if grid is not None and not {"area", "cell_size"} & changes.keys():
        return grid
    if grid is not None:
        xmax, ymax = grid.xmin + grid.columns * grid.cell_size, grid.ymin + grid.rows * grid.cell_size
        grid_values = {"area": (grid.xmin, grid.ymin, xmax, ymax), "cell_size": grid.cell_size}
        changes = {**grid_values, **changes}
    xmin, ymin, xmax, ymax = map(float, changes["area"])
    return Grid.over(xmin, ymin, xmax, ymax, float(changes["cell_size"]))


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
        "yaws": lambda value: tuple(map(_angle, value)),
        "base": lambda value: (float(value[0]), float(value[1])),
        "nearest": float,
        "farthest": lambda value: math.inf if value is None else float(value),
        "obstacles": lambda value: tuple(map(_obstacle, value)),
        "supports": frozenset,
        "clearance": float,
    }
)


def changes_text(before: Settings, after: Settings) -> tuple[str, ...]:
    """Return the differences between two settings, such as "room 0.09 -> 0.02"."""
    old, new = (json.loads(text_from_settings(settings)) for settings in (before, after))
    return tuple(f"{key} {_brief(old[key])} -> {_brief(new[key])}" for key in old if old[key] != new[key])


def _brief(value: Any) -> str:
    return cut(json.dumps(value).replace('"', ""), 60)
