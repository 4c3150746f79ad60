"""Replay: a log and specifications in, verdicts and an annotated log out.

`selection` picks the samples, `engine` evaluates them and writes the log, `document` the JSON. `loaded_log`
evaluates a log in memory again, with what `specification_files` reads when it is saved, and plays it.

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.replay.document import (
        Explanation,
        document_from_replay,
        explain_results,
        idle_document,
        verdict_of,
    )
    from spatial_replay.replay.engine import Replay, Replayed, load_files, recorded_texts, run_replay
    from spatial_replay.replay.loaded_log import (
        Evaluated,
        LoadedLog,
        Playback,
        constant_text,
        constant_values,
    )
    from spatial_replay.replay.selection import (
        LogNames,
        ReplayOptions,
        Window,
        default_keep,
        first_sample_ns,
        has_samples_from,
        known_start_ns,
    )
    from spatial_replay.replay.specification_files import SpecificationFiles, write_constants
    from spatial_replay.replay.table import QUANTITIES, export_table
    from spatial_replay.replay.verification import verify_certificate

__all__ = [
    "QUANTITIES",
    "Evaluated",
    "Explanation",
    "LoadedLog",
    "LogNames",
    "Playback",
    "Replay",
    "ReplayOptions",
    "Replayed",
    "SpecificationFiles",
    "Window",
    "constant_text",
    "constant_values",
    "default_keep",
    "document_from_replay",
    "explain_results",
    "export_table",
    "first_sample_ns",
    "has_samples_from",
    "idle_document",
    "known_start_ns",
    "load_files",
    "recorded_texts",
    "run_replay",
    "verdict_of",
    "verify_certificate",
    "write_constants",
]

__getattr__, __dir__ = loaded_when_used(
    globals(),
    {
        "document": ("Explanation", "document_from_replay", "explain_results", "idle_document", "verdict_of"),
        "engine": ("Replay", "Replayed", "load_files", "recorded_texts", "run_replay"),
        "selection": (
            "LogNames",
            "ReplayOptions",
            "Window",
            "default_keep",
            "first_sample_ns",
            "has_samples_from",
            "known_start_ns",
        ),
        "specification_files": ("SpecificationFiles", "write_constants"),
        "table": ("QUANTITIES", "export_table"),
        "loaded_log": ("Evaluated", "LoadedLog", "Playback", "constant_text", "constant_values"),
        "verification": ("verify_certificate",),
    },
)
