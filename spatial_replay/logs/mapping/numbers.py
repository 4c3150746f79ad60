"""Durations as mapping files write them."""

from __future__ import annotations

import re
from decimal import Decimal

from spatial_replay.errors import UsageError
from spatial_replay.logs.mapping.model import FOREVER_NS

_UNITS_NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}
_DURATION = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)(ns|us|ms|s)", re.ASCII)


def duration_ns(text: str) -> int:
    """`100ms` or `0.5s` as nanoseconds.

    Raises:
        UsageError: for anything else, and for 0.
    """
    found = _DURATION.fullmatch(text)
    nanoseconds = int(Decimal(found[1]) * _UNITS_NS[found[2]]) if found else 0
    if nanoseconds <= 0:
        raise UsageError(f"{text!r} is no duration; write 100ms or 0.5s")
    return nanoseconds


def age_ns(text: str) -> int:
    """A duration, or `forever`.

    Raises:
        UsageError: for anything else.
    """
    return FOREVER_NS if text == "forever" else duration_ns(text)


def unit_ns(text: str) -> int:
    """Nanoseconds of a unit of time: ns, us, ms or s."""
    return _UNITS_NS[text]
