"""Planning for specifications (section 5.2 of the paper): which object to move where, and why.

Nothing here depends on a robot or a simulator. Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import lazy_attributes

if TYPE_CHECKING:
    from spatial_replay.geometry.footprint import moved_object
    from spatial_replay.planning.decisions import Candidate, Executor, Outcome, Reason, Step, Target
    from spatial_replay.planning.maps import GradientMap, MapLayers, map_layers
    from spatial_replay.planning.planner import Planner
    from spatial_replay.planning.read import (
        LoggedStep,
        Replanned,
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
    )

__all__ = [
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
    "changed_settings",
    "load_settings",
    "map_layers",
    "moved_object",
    "parse_settings",
    "read_decisions",
    "read_steps",
    "recompute_decisions",
    "redo_decisions",
]

__getattr__, __dir__ = lazy_attributes(globals())
