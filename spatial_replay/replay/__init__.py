"""Replay: a log and specifications in, verdicts and an annotated log out."""

from __future__ import annotations

from spatial_replay.replay.annotated import load_files, run_replay
from spatial_replay.replay.document import document
from spatial_replay.replay.explanation import Explanation, explanations
from spatial_replay.replay.found import Replayed, ReplayedSpec
from spatial_replay.replay.replay import Replay
from spatial_replay.replay.window import Window, first_sample_ns, has_samples_from

__all__ = [
    "Explanation",
    "Replay",
    "Replayed",
    "ReplayedSpec",
    "Window",
    "document",
    "explanations",
    "first_sample_ns",
    "has_samples_from",
    "load_files",
    "run_replay",
]
