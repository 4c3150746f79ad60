"""Times and durations as people write them: `12.5s` after the first sample, nanoseconds, RFC 3339."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import Literal

from spatial_replay.errors import UsageError
from spatial_replay.trace.sample import LATEST_NS

_DURATION = re.compile(
    r"(?P<number>\d{1,19}(?:\.\d{1,30})?(?:e[+-]?\d{1,2})?)(?P<unit>s|ms)", re.ASCII | re.I
)
_ABSOLUTE = re.compile(r"(?P<number>\d{1,19})(?P<unit>ns)?", re.ASCII | re.I)
_LEAST_WITHOUT_UNIT_NS = 10**12
"""Smaller integers without a unit could be seconds or milliseconds as well."""
_CALENDAR = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)[T ](?P<time>\d\d:\d\d:\d\d)(?:\.(?P<fraction>\d{1,9}))?"
    r"(?P<offset>Z|[+-]\d\d:\d\d)",
    re.ASCII | re.IGNORECASE,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class TimePoint:
    """A time in a log, as people write it.

    Attributes:
        nanoseconds: since the first sample, or since the log's own zero.
        origin: which of the two.
    """

    nanoseconds: int
    origin: Literal["first sample", "zero"]

    def absolute_ns(self, first_ns: int) -> int:
        """Return this time on the clock of a log whose first sample has time `first_ns`."""
        return first_ns + self.nanoseconds if self.origin == "first sample" else self.nanoseconds


def time_point_from_text(text: str) -> TimePoint:
    """Read `12.5s` or `1500ms` after the first sample, `5250000000ns` on the log's clock, or RFC 3339.

    The unit of nanoseconds can be left out from 10^12 on.

    Raises:
        UsageError: for anything else, for a small integer without a unit, and for a time beyond the range of
            logs.
    """
    if _DURATION.fullmatch(text):
        return TimePoint(duration_ns_from_text(text), "first sample")
    if absolute := _ABSOLUTE.fullmatch(text):
        if absolute["unit"] is None and int(text) < _LEAST_WITHOUT_UNIT_NS:
            raise UsageError(
                f"{text!r} has no unit: {text}s after the log's first sample, or {text} ns on the log's own "
                f"clock? Write {text}s or {text}ns"
            )
        return TimePoint(_checked_ns(int(absolute["number"]), text), "zero")
    if calendar := _CALENDAR.fullmatch(text):
        return TimePoint(_checked_ns(_ns_from_calendar(calendar, text), text), "zero")
    raise UsageError(
        f"{text!r} is not a time; write 12.5s or 1500ms after the log's first sample, "
        "5250000000ns on its own clock, or 2026-01-31T12:00:00Z"
    )


def duration_ns_from_text(text: str) -> int:
    """Read a duration such as `2s`, `0.5s` or `1500ms` as nanoseconds, rounded to the nearest.

    Raises:
        UsageError: for anything else.
    """
    match = _DURATION.fullmatch(text)
    if match is None:
        raise UsageError(f"{text!r} is not a duration; write it as 2s, 0.5s or 1500ms")
    nanoseconds = Decimal(match["number"]) * (10**9 if match["unit"].lower() == "s" else 10**6)
    # compared before it becomes an integer, which might have a hundred digits
    return _checked_ns(int(min(nanoseconds, Decimal(LATEST_NS + 1)).to_integral_value()), text)


def _ns_from_calendar(match: re.Match[str], text: str) -> int:
    offset = "+00:00" if match["offset"] in "Zz" else match["offset"]
    try:
        whole_seconds = datetime.fromisoformat(f"{match['date']}T{match['time']}{offset}")
    except ValueError as error:
        raise UsageError(f"{text!r} is not a calendar time: {error}") from error
    fraction_ns = int((match["fraction"] or "").ljust(9, "0"))
    return (whole_seconds - _EPOCH) // timedelta(seconds=1) * 10**9 + fraction_ns


def _checked_ns(nanoseconds: int, text: str) -> int:
    if not 0 <= nanoseconds <= LATEST_NS:
        raise UsageError(f"{text!r} is outside the times of a log, 0 to 2**63 - 1 ns")
    return nanoseconds
