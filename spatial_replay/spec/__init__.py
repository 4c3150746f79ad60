"""The language: text to formulas and back.

Names are loaded when they are first used: values of formulas need no parser.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from spatial_replay.lazy import loaded_when_used

if TYPE_CHECKING:
    from spatial_replay.spec.format import format_formula, format_specification
    from spatial_replay.spec.objects import check_names, instantiate, object_names, signal_names
    from spatial_replay.spec.specification import load_specification, parse_specification

__all__ = [
    "check_names",
    "format_formula",
    "format_specification",
    "instantiate",
    "load_specification",
    "object_names",
    "parse_specification",
    "signal_names",
]

_HOMES: Mapping[str, str] = MappingProxyType(
    {
        "check_names": "spatial_replay.spec.objects",
        "format_formula": "spatial_replay.spec.format",
        "format_specification": "spatial_replay.spec.format",
        "instantiate": "spatial_replay.spec.objects",
        "load_specification": "spatial_replay.spec.specification",
        "object_names": "spatial_replay.spec.objects",
        "parse_specification": "spatial_replay.spec.specification",
        "signal_names": "spatial_replay.spec.objects",
    }
)

__getattr__, __dir__ = loaded_when_used(globals(), _HOMES)
