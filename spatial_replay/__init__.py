"""Spatio-temporal robustness of recorded runs: log → trace → formula → robustness → log.

Names are imported when they are first used, so that importing the package loads no numerical library.
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
from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.api import (
        clip_log,
        diff_logs,
        diff_specifications,
        evaluate_logs,
        info,
        learn,
        read_results,
        replay_log,
        tune,
        verify,
        write_report,
    )
    from spatial_replay.automata.automaton import Automaton
    from spatial_replay.automata.compile import automaton
    from spatial_replay.automata.guards import Transition
    from spatial_replay.batch.run import BatchResult
    from spatial_replay.compare.alignment import Alignment, Knot, Parting
    from spatial_replay.compare.clips import Clip
    from spatial_replay.compare.decision_diff import DecisionDiff
    from spatial_replay.compare.declarations import TextPlace
    from spatial_replay.compare.edit_cause import EditOutcome
    from spatial_replay.compare.edits import Edit
    from spatial_replay.compare.movement import ObjectDiff
    from spatial_replay.compare.run_results import RunSpecDiff
    from spatial_replay.compare.runs import LogDiff
    from spatial_replay.compare.spec_diff import FirstDifference, SpecDiff
    from spatial_replay.compare.specifications import SpecificationDiff
    from spatial_replay.falsification.failure_search import falsify
    from spatial_replay.falsification.failures import Coverage, Failure, Falsification, SearchedRun
    from spatial_replay.geometry.footprint import ConvexPart, Footprint, TrackedObject
    from spatial_replay.learning.learned import Learned
    from spatial_replay.monitor.causes import Cause, LeastPart
    from spatial_replay.monitor.evaluate import Evaluation, evaluate
    from spatial_replay.monitor.monitor import Ending, Monitor, NodeUpdate, SpecUpdate, Update
    from spatial_replay.monitor.result import NodeResult, SpecResult
    from spatial_replay.monitor.vacuity import UntestedPart
    from spatial_replay.monitor.verdict import Verdict
    from spatial_replay.monitor.violation import Violation
    from spatial_replay.monitor.witness.atom import DecidingAtom, Measured
    from spatial_replay.monitor.witness.evidence import Gap
    from spatial_replay.monitor.witness.path import MissedResponse
    from spatial_replay.monitor.witness.threshold import Threshold
    from spatial_replay.monitor.witness.witness import Witness, WitnessStep
    from spatial_replay.planning.decisions import Candidate, Consideration, Guards, Outcome, Step
    from spatial_replay.planning.planner import Planner
    from spatial_replay.planning.settings import Settings
    from spatial_replay.recording.clip_log import TriggeredClip
    from spatial_replay.recording.message_channel import MessageChannel
    from spatial_replay.recording.plan_loop import plan
    from spatial_replay.recording.recorder import Recorder
    from spatial_replay.recording.trigger import Trigger
    from spatial_replay.replay.engine import Replayed
    from spatial_replay.replay.verification import Verified
    from spatial_replay.sanity.examine import Examination, Finding, SpecExamination, doctor
    from spatial_replay.sanity.examples import Example
    from spatial_replay.sources.open_log import read_trace
    from spatial_replay.sources.overview import ObjectOverview, Overview
    from spatial_replay.spec.diagnostics import Diagnostic
    from spatial_replay.spec.formula import NamedSpec, Specification
    from spatial_replay.spec.load import load_specification, parse_specification
    from spatial_replay.text import Instant, Sentence
    from spatial_replay.trace.sample import Sample
    from spatial_replay.trace.trace import Trace
    from spatial_replay.tuning.tuned import Surface, Tuning

__version__ = "0.1.0"

__all__ = [
    "Alignment",
    "Automaton",
    "BatchResult",
    "Candidate",
    "Cause",
    "Clip",
    "ClusterError",
    "Consideration",
    "ConvexPart",
    "Coverage",
    "DecidingAtom",
    "DecisionDiff",
    "Diagnostic",
    "Edit",
    "EditOutcome",
    "Ending",
    "Evaluation",
    "Examination",
    "Example",
    "Failure",
    "Falsification",
    "Finding",
    "FirstDifference",
    "Footprint",
    "Gap",
    "GeometryError",
    "Guards",
    "Instant",
    "Knot",
    "Learned",
    "LeastPart",
    "LogDiff",
    "LogError",
    "Measured",
    "MessageChannel",
    "MissedResponse",
    "MissingFileError",
    "Monitor",
    "NamedSpec",
    "NoAutomatonError",
    "NodeResult",
    "NodeUpdate",
    "ObjectDiff",
    "ObjectOverview",
    "Outcome",
    "OutputError",
    "Overview",
    "Parting",
    "Planner",
    "Recorder",
    "Replayed",
    "RunSpecDiff",
    "Sample",
    "SearchedRun",
    "Sentence",
    "Settings",
    "SpatialReplayError",
    "SpecDiff",
    "SpecExamination",
    "SpecResult",
    "SpecUpdate",
    "Specification",
    "SpecificationDiff",
    "SpecificationError",
    "Step",
    "Surface",
    "TextPlace",
    "Threshold",
    "Trace",
    "TraceError",
    "TrackedObject",
    "Transition",
    "Trigger",
    "TriggeredClip",
    "Tuning",
    "UntestedPart",
    "Update",
    "UsageError",
    "Verdict",
    "Verified",
    "Violation",
    "Witness",
    "WitnessStep",
    "__version__",
    "automaton",
    "clip_log",
    "diff_logs",
    "diff_specifications",
    "doctor",
    "evaluate",
    "evaluate_logs",
    "falsify",
    "info",
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

__getattr__, __dir__ = loaded_when_used(
    globals(),
    {
        "api": (
            "clip_log",
            "diff_logs",
            "diff_specifications",
            "evaluate_logs",
            "info",
            "learn",
            "read_results",
            "replay_log",
            "tune",
            "verify",
            "write_report",
        ),
        "batch.run": ("BatchResult",),
        "automata.automaton": ("Automaton",),
        "automata.compile": ("automaton",),
        "automata.guards": ("Transition",),
        "compare.alignment": ("Alignment", "Knot", "Parting"),
        "compare.clips": ("Clip",),
        "compare.edit_cause": ("EditOutcome",),
        "compare.decision_diff": ("DecisionDiff",),
        "compare.movement": ("ObjectDiff",),
        "compare.run_results": ("RunSpecDiff",),
        "compare.runs": ("LogDiff",),
        "compare.declarations": ("TextPlace",),
        "compare.spec_diff": ("FirstDifference", "SpecDiff"),
        "compare.specifications": ("SpecificationDiff",),
        "compare.edits": ("Edit",),
        "falsification.failure_search": ("falsify",),
        "falsification.failures": ("Coverage", "Failure", "Falsification", "SearchedRun"),
        "geometry.footprint": ("ConvexPart", "Footprint", "TrackedObject"),
        "learning.learned": ("Learned",),
        "monitor.causes": ("Cause", "LeastPart"),
        "monitor.evaluate": ("Evaluation", "evaluate"),
        "monitor.monitor": ("Ending", "Monitor", "NodeUpdate", "SpecUpdate", "Update"),
        "monitor.result": ("NodeResult", "SpecResult"),
        "monitor.vacuity": ("UntestedPart",),
        "monitor.verdict": ("Verdict",),
        "monitor.violation": ("Violation",),
        "monitor.witness.atom": ("DecidingAtom", "Measured"),
        "monitor.witness.evidence": ("Gap",),
        "monitor.witness.path": ("MissedResponse",),
        "monitor.witness.threshold": ("Threshold",),
        "monitor.witness.witness": ("Witness", "WitnessStep"),
        "planning.decisions": ("Candidate", "Consideration", "Guards", "Outcome", "Step"),
        "planning.planner": ("Planner",),
        "planning.settings": ("Settings",),
        "recording.clip_log": ("TriggeredClip",),
        "recording.trigger": ("Trigger",),
        "recording.message_channel": ("MessageChannel",),
        "recording.plan_loop": ("plan",),
        "recording.recorder": ("Recorder",),
        "replay.engine": ("Replayed",),
        "replay.verification": ("Verified",),
        "sanity.examine": ("Examination", "Finding", "SpecExamination", "doctor"),
        "sanity.examples": ("Example",),
        "sources.open_log": ("read_trace",),
        "sources.overview": ("ObjectOverview", "Overview"),
        "spec.diagnostics": ("Diagnostic",),
        "spec.formula": ("NamedSpec", "Specification"),
        "spec.load": ("load_specification", "parse_specification"),
        "text": ("Instant", "Sentence"),
        "trace.sample": ("Sample",),
        "trace.trace": ("Trace",),
        "tuning.tuned": ("Surface", "Tuning"),
    },
)
