"""Spatio-temporal robustness of recorded runs: log → trace → formula → robustness → log.

Names are imported when they are first used, so that importing the package loads no numerical library.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.errors import (
    GeometryError,
    LogError,
    MissingFileError,
    NoAutomatonError,
    OutputError,
    SpatialReplayError,
    SpecificationError,
    TraceError,
    UsageError,
)
from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.automata.automaton import Automaton
    from spatial_replay.automata.compile import automaton
    from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject
    from spatial_replay.monitor.evaluate import Evaluation, evaluate
    from spatial_replay.monitor.monitor import Monitor
    from spatial_replay.monitor.verdict import Verdict
    from spatial_replay.planning.planner import Planner
    from spatial_replay.recording.recorder import Recorder
    from spatial_replay.sources.open_log import read_trace
    from spatial_replay.spec.formula import Specification
    from spatial_replay.spec.load import load_specification, parse_specification
    from spatial_replay.trace.sample import Sample
    from spatial_replay.trace.trace import Trace

__version__ = "0.1.0"

__all__ = [
    "Automaton",
    "ConvexPart",
    "Evaluation",
    "Footprint",
    "GeometryError",
    "LogError",
    "MissingFileError",
    "Monitor",
    "NoAutomatonError",
    "OutputError",
    "Planner",
    "Recorder",
    "Sample",
    "SpatialReplayError",
    "Specification",
    "SpecificationError",
    "Trace",
    "TraceError",
    "TrackedObject",
    "UsageError",
    "Verdict",
    "__version__",
    "automaton",
    "evaluate",
    "load_specification",
    "parse_specification",
    "read_trace",
]

_HOMES = {
    "Automaton": "spatial_replay.automata.automaton",
    "ConvexPart": "spatial_replay.geometry.footprint",
    "Evaluation": "spatial_replay.monitor.evaluate",
    "Footprint": "spatial_replay.geometry.footprint",
    "Monitor": "spatial_replay.monitor.monitor",
    "Planner": "spatial_replay.planning.planner",
    "Recorder": "spatial_replay.recording.recorder",
    "Sample": "spatial_replay.trace.sample",
    "Specification": "spatial_replay.spec.formula",
    "Trace": "spatial_replay.trace.trace",
    "TrackedObject": "spatial_replay.geometry.footprint",
    "Verdict": "spatial_replay.monitor.verdict",
    "automaton": "spatial_replay.automata.compile",
    "evaluate": "spatial_replay.monitor.evaluate",
    "load_specification": "spatial_replay.spec.load",
    "parse_specification": "spatial_replay.spec.load",
    "read_trace": "spatial_replay.sources.open_log",
}

__getattr__, __dir__ = loaded_when_used(globals(), _HOMES)
