"""Settings of a planner as text and back, so that a log can hold them and a decision be made again."""

from __future__ import annotations

import json
import math
from typing import Any

from spatial_replay.errors import GeometryError, LogError, UsageError
from spatial_replay.geometry.footprint import ConvexPart, Footprint
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.workspace import Grid, Workspace


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
