"""Spatio-temporal robustness of recorded runs: log → trace → formula → robustness → log.

Names are imported at their first use. Importing the package loads no numerical library.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.errors import (
    ClusterError,
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
from spatial_replay.lazy import lazy_attributes
from spatial_replay.version import __version__

if TYPE_CHECKING:
    from spatial_replay.api import (
        clip_log,
        diff_logs,
        diff_specifications,
        evaluate_logs,
        info,
        judge,
        learn,
        read_results,
        replay_log,
        tune,
        verify,
        write_report,
    )
    from spatial_replay.automata.compile import automaton
    from spatial_replay.falsification.failure_search import falsify
    from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject
    from spatial_replay.monitor.monitor import Monitor
    from spatial_replay.monitor.result import Evaluation, evaluate
    from spatial_replay.monitor.verdict import Verdict
    from spatial_replay.planning.decisions import Outcome
    from spatial_replay.planning.planner import Planner
    from spatial_replay.planning.settings import Settings
    from spatial_replay.recording.clips import Trigger
    from spatial_replay.recording.plan_loop import plan
    from spatial_replay.recording.recorder import Recorder
    from spatial_replay.sanity.differences import distinguish
    from spatial_replay.sanity.examine import doctor
    from spatial_replay.sources.open_log import read_trace
    from spatial_replay.spec.formula import Specification
    from spatial_replay.spec.load import load_specification, parse_specification
    from spatial_replay.trace.trace import Sample, Trace

__all__ = [
    "ClusterError",
    "ConvexPart",
    "Evaluation",
    "Footprint",
    "GeometryError",
    "LogError",
    "MissingFileError",
    "Monitor",
    "NoAutomatonError",
    "Outcome",
    "OutputError",
    "Planner",
    "Recorder",
    "Sample",
    "Settings",
    "SpatialReplayError",
    "Specification",
    "SpecificationError",
    "Trace",
    "TraceError",
    "TrackedObject",
    "Trigger",
    "UsageError",
    "Verdict",
    "__version__",
    "automaton",
    "clip_log",
    "diff_logs",
    "diff_specifications",
    "distinguish",
    "doctor",
    "evaluate",
    "evaluate_logs",
    "falsify",
    "info",
    "judge",
    "learn",
    "load_specification",
    "parse_specification",
    "plan",
    "read_results",
    "read_trace",
    "replay_log",
    "tune",
    "verify",
    "write_report",
]

__getattr__, __dir__ = lazy_attributes(globals())
