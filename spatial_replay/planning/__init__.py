"""Planning for specifications (section 5.2 of the paper): which object to move where, and why.

Nothing here depends on a robot or a simulator. Names are loaded when they are first used.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.planning.decision_log import PLAN_METADATA, BlackBox
    from spatial_replay.planning.decisions import Candidate, Executor, Outcome, Reason, Step, Target
    from spatial_replay.planning.maps import (
        FREE,
        GradientMap,
        centre_of,
        gradient_map,
        moved_object,
        proposition_maps,
    )
    from spatial_replay.planning.paths import shortest_path
    from spatial_replay.planning.planner import MOST_MOTIONS, Planner
    from spatial_replay.planning.read import LoggedStep, planner_of, read_decisions, read_steps
    from spatial_replay.planning.recompute import recompute_decisions
    from spatial_replay.planning.settings import Settings, settings_from_text, text_from_settings
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
    "Outcome",
    "Planner",
    "Reason",
    "Settings",
    "Step",
    "Target",
    "Workspace",
    "centre_of",
    "gradient_map",
    "moved_object",
    "planner_of",
    "proposition_maps",
    "read_decisions",
    "read_steps",
    "recompute_decisions",
    "settings_from_text",
    "shortest_path",
    "text_from_settings",
]

_HOMES: Mapping[str, str] = MappingProxyType(
    {
        "FREE": "spatial_replay.planning.maps",
        "MOST_MOTIONS": "spatial_replay.planning.planner",
        "PLAN_METADATA": "spatial_replay.planning.decision_log",
        "BlackBox": "spatial_replay.planning.decision_log",
        "Candidate": "spatial_replay.planning.decisions",
        "Executor": "spatial_replay.planning.decisions",
        "GradientMap": "spatial_replay.planning.maps",
        "Grid": "spatial_replay.planning.workspace",
        "LoggedStep": "spatial_replay.planning.read",
        "Outcome": "spatial_replay.planning.decisions",
        "Planner": "spatial_replay.planning.planner",
        "Reason": "spatial_replay.planning.decisions",
        "Settings": "spatial_replay.planning.settings",
        "Step": "spatial_replay.planning.decisions",
        "Target": "spatial_replay.planning.decisions",
        "Workspace": "spatial_replay.planning.workspace",
        "centre_of": "spatial_replay.planning.maps",
        "gradient_map": "spatial_replay.planning.maps",
        "moved_object": "spatial_replay.planning.maps",
        "planner_of": "spatial_replay.planning.read",
        "proposition_maps": "spatial_replay.planning.maps",
        "read_decisions": "spatial_replay.planning.read",
        "read_steps": "spatial_replay.planning.read",
        "recompute_decisions": "spatial_replay.planning.recompute",
        "settings_from_text": "spatial_replay.planning.settings",
        "shortest_path": "spatial_replay.planning.paths",
        "text_from_settings": "spatial_replay.planning.settings",
    }
)

__getattr__, __dir__ = loaded_when_used(globals(), _HOMES)
