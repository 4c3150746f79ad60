"""Planning for specifications (section 5.2 of the paper): which object to move where, and why.

Nothing here depends on a robot or a simulator. Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.geometry.poses import centre_of, moved_object
    from spatial_replay.logs.topics import PLAN_METADATA
    from spatial_replay.planning.decision_log import BlackBox, plan_metadata
    from spatial_replay.planning.decisions import Candidate, Executor, Outcome, Reason, Step, Target
    from spatial_replay.planning.edges import MOST_MOTIONS
    from spatial_replay.planning.map_layers import MapLayers, map_layers
    from spatial_replay.planning.map_messages import map_fields
    from spatial_replay.planning.maps import FREE, GradientMap, gradient_map, proposition_maps
    from spatial_replay.planning.paths import shortest_path
    from spatial_replay.planning.planner import Planner
    from spatial_replay.planning.read import LoggedStep, planner_of, read_decisions, read_steps
    from spatial_replay.planning.recompute import recompute_decisions
    from spatial_replay.planning.redo import Redone, redo_decisions
    from spatial_replay.planning.settings import (
        Settings,
        changed_settings,
        load_settings,
        parse_settings,
        settings_from_text,
        text_from_settings,
    )
    from spatial_replay.planning.workspace import Grid, Workspace

__all__ = [
    "FREE",
    "MOST_MOTIONS",
    "PLAN_METADATA",
    "BlackBox",
    "Candidate",
    "Executor",
    "GradientMap",
    "Grid",
    "LoggedStep",
    "MapLayers",
    "Outcome",
    "Planner",
    "Reason",
    "Redone",
    "Settings",
    "Step",
    "Target",
    "Workspace",
    "centre_of",
    "changed_settings",
    "gradient_map",
    "load_settings",
    "map_fields",
    "map_layers",
    "moved_object",
    "parse_settings",
    "plan_metadata",
    "planner_of",
    "proposition_maps",
    "read_decisions",
    "read_steps",
    "recompute_decisions",
    "redo_decisions",
    "settings_from_text",
    "shortest_path",
    "text_from_settings",
]

__getattr__, __dir__ = loaded_when_used(
    globals(),
    {
        "decision_log": ("BlackBox", "plan_metadata"),
        "decisions": ("Candidate", "Executor", "Outcome", "Reason", "Step", "Target"),
        "map_layers": ("MapLayers", "map_layers"),
        "map_messages": ("map_fields",),
        "edges": ("MOST_MOTIONS",),
        "maps": ("FREE", "GradientMap", "gradient_map", "proposition_maps"),
        "paths": ("shortest_path",),
        "planner": ("Planner",),
        ".geometry.poses": ("centre_of", "moved_object"),
        "read": ("PLAN_METADATA", "LoggedStep", "planner_of", "read_decisions", "read_steps"),
        "recompute": ("recompute_decisions",),
        "redo": ("Redone", "redo_decisions"),
        "settings": (
            "Settings",
            "changed_settings",
            "load_settings",
            "parse_settings",
            "settings_from_text",
            "text_from_settings",
        ),
        "workspace": ("Grid", "Workspace"),
    },
)
