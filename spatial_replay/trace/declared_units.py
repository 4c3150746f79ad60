"""Units that a source declares, for readers: of signals by their names, of lengths by ""."""

from __future__ import annotations

import json
from collections.abc import Mapping
from reprlib import repr as shortened

from spatial_replay.errors import UsageError
from spatial_replay.text import is_encodable

SIGNAL_UNITS_KEY = "signal_units"
"""The entry of a log's metadata with the units of its signals; that of lengths is among the axes."""

_LONGEST_UNIT = 64


def checked_units(units: Mapping[str, str] | None) -> dict[str, str]:
    """Return units that a caller declares, in the order of their names; none for None.

    Raises:
        UsageError: something else than short texts by names.
    """
    if units is None:
        return {}
    if not isinstance(units, Mapping) or not all(isinstance(name, str) for name in units):
        remedy = 'give them by the names of signals, and that of lengths by "": {"": "m"}'
        raise UsageError(f"units are {shortened(units)}; {remedy}")
    for name, unit in units.items():
        if not isinstance(unit, str) or not 0 < len(unit) <= _LONGEST_UNIT or not is_encodable(unit):
            what = f"of signal {name!r}" if name else "of lengths"
            raise UsageError(f"the unit {what} is {shortened(unit)}; give a short text, such as 'm'")
    return dict(sorted(units.items()))


def signal_units_metadata(units: Mapping[str, str]) -> dict[str, str]:
    """Return the entry for the metadata of a log; none where no signal has a unit."""
    of_signals = {name: unit for name, unit in sorted(units.items()) if name}
    return {SIGNAL_UNITS_KEY: json.dumps(of_signals)} if of_signals else {}


def signal_units_from_metadata(about: Mapping[str, str]) -> dict[str, str]:
    """Return the units of signals that a log's metadata declare, by their names."""
    try:
        found = json.loads(about.get(SIGNAL_UNITS_KEY, "{}"))
        return {name: unit for name, unit in found.items() if name and isinstance(unit, str)}
    except (ValueError, AttributeError, RecursionError):
        return {}
