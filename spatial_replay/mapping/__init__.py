"""Mapping files: from the messages of external logs to objects and signals.

Names are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.mapping.assemble import Assembler, LiveAssembler
    from spatial_replay.mapping.mapped_source import MappedSource
    from spatial_replay.mapping.mapping_file import LogMapping, load_mapping, parse_mapping
    from spatial_replay.mapping.suggest import suggest_mapping, suggest_topics
    from spatial_replay.mapping.topic_reader import ReadingPlan

__all__ = [
    "Assembler",
    "LiveAssembler",
    "LogMapping",
    "MappedSource",
    "ReadingPlan",
    "load_mapping",
    "parse_mapping",
    "suggest_mapping",
    "suggest_topics",
]

__getattr__, __dir__ = loaded_when_used(globals())
