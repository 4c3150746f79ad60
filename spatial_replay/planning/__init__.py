"""Planning for specifications (section 5.2 of the paper): which object to move where, and why.

Nothing here depends on a robot or a simulator. Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.geometry.footprint import centre_of, moved_object
    from spatial_replay.logs.topics import PLAN_METADATA
    from spatial_replay.planning.decision_log import BlackBox, map_fields, plan_metadata
    from spatial_replay.planning.decisions import Candidate, Executor, Outcome, Reason, Step, Target
    from spatial_replay.planning.edges import MOST_MOTIONS
    from spatial_replay.planning.maps import (
        FREE,
        GradientMap,
        MapLayers,
        gradient_map,
        map_layers,
        proposition_maps,
    )
    from spatial_replay.planning.paths import shortest_path
    from spatial_replay.planning.planner import Planner
    from spatial_replay.planning.read import (
        LoggedStep,
        Replanned,
        planner_of,
        read_decisions,
        read_steps,
        recompute_decisions,
        redo_decisions,
    )
    from spatial_replay.planning.settings import (
        Grid,
        Settings,
        Workspace,
        changed_settings,
        load_settings,
        parse_settings,
        settings_from_text,
        text_from_settings,
    )

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
    "Replanned",
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
        "decision_log": ("BlackBox", "map_fields", "plan_metadata"),
        "decisions": ("Candidate", "Executor", "Outcome", "Reason", "Step", "Target"),
        "edges": ("MOST_MOTIONS",),
        "maps": ("FREE", "GradientMap", "MapLayers", "gradient_map", "map_layers", "proposition_maps"),
        "paths": ("shortest_path",),
        "planner": ("Planner",),
        ".geometry.footprint": ("centre_of", "moved_object"),
        "read": (
            "PLAN_METADATA",
            "LoggedStep",
            "Replanned",
            "planner_of",
            "read_decisions",
            "read_steps",
            "recompute_decisions",
            "redo_decisions",
        ),
        "settings": (
            "Grid",
            "Settings",
            "Workspace",
            "changed_settings",
            "load_settings",
            "parse_settings",
            "settings_from_text",
            "text_from_settings",
        ),
    },
)
