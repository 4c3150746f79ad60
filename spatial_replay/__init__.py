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

__getattr__, __dir__ = loaded_when_used(
    globals(),
    {
        "automata.automaton": ("Automaton",),
        "automata.compile": ("automaton",),
        "geometry.footprint": ("ConvexPart", "Footprint", "TrackedObject"),
        "monitor.evaluate": ("Evaluation", "evaluate"),
        "monitor.monitor": ("Monitor",),
        "monitor.verdict": ("Verdict",),
        "planning.planner": ("Planner",),
        "recording.recorder": ("Recorder",),
        "sources.open_log": ("read_trace",),
        "spec.formula": ("Specification",),
        "spec.load": ("load_specification", "parse_specification"),
        "trace.sample": ("Sample",),
        "trace.trace": ("Trace",),
    },
)
