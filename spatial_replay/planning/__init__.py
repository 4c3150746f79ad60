"""Planning by specification: what to move where, and why; knows no robot and no simulator.

Section 5.2 of the paper: progress and constraint sets of an automaton's edge, gradient maps, paths,
Algorithm 1. Names are loaded when they are first used.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.planning.decisions import Candidate, Executor, Outcome, Reason, Step, Target
    from spatial_replay.planning.maps import (
        GradientMap,
        gradient_map,
        moved_object,
        proposition_maps,
    )
    from spatial_replay.planning.planner import Planner
    from spatial_replay.planning.read import LoggedStep, read_steps
    from spatial_replay.planning.settings import Settings
    from spatial_replay.planning.workspace import Grid, Workspace

__all__ = [
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
    "gradient_map",
    "moved_object",
    "proposition_maps",
    "read_steps",
]

_HOMES: Mapping[str, str] = MappingProxyType(
    {
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
        "gradient_map": "spatial_replay.planning.maps",
        "moved_object": "spatial_replay.planning.maps",
        "proposition_maps": "spatial_replay.planning.maps",
        "read_steps": "spatial_replay.planning.read",
    }
)

__getattr__, __dir__ = loaded_when_used(globals(), _HOMES)
