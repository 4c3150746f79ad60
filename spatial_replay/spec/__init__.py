"""The specification language: text to formulas and back.

Names are imported when they are first used, because formulas made in Python need no parser.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from spatial_replay.lazy import lazy_attributes

if TYPE_CHECKING:
    from spatial_replay.spec.checks import check_names, object_names, signal_names
    from spatial_replay.spec.format import format_formula, format_specification
    from spatial_replay.spec.load import load_specification, parse_specification

__all__ = [
    "check_names",
    "format_formula",
    "format_specification",
    "load_specification",
    "object_names",
    "parse_specification",
    "signal_names",
]

__getattr__, __dir__ = lazy_attributes(globals())
