"""Replay: a log and specifications in, verdicts and an annotated log out."""

from __future__ import annotations

from spatial_replay.replay.annotated import load_files, run_replay
from spatial_replay.replay.document import Explanation, document, explanations
from spatial_replay.replay.engine import Replay, Replayed, ReplayedSpec
from spatial_replay.replay.selection import Window, first_sample_ns, has_samples_from

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
