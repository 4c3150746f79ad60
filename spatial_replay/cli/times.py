"""Times and durations as they are written on the command line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import Literal

from spatial_replay.errors import UsageError
from spatial_replay.trace.times import LATEST_NS

_DURATION = re.compile(
    r"(?P<number>\d{1,19}(?:\.\d{1,30})?(?:e[+-]?\d{1,2})?)(?P<unit>s|ms)", re.ASCII | re.I
)
_ABSOLUTE = re.compile(r"\d{1,19}", re.ASCII)
_CALENDAR = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)[T ](?P<time>\d\d:\d\d:\d\d)(?:\.(?P<fraction>\d{1,9}))?"
    r"(?P<offset>Z|[+-]\d\d:\d\d)",
    re.ASCII | re.IGNORECASE,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class TimePoint:
    """A time in a log, as somebody asked for it.

    Attributes:
        nanoseconds: since the first sample, or since the log's own zero.
        origin: which of the two.
    """

    nanoseconds: int
    origin: Literal["first sample", "zero"]

    def absolute_ns(self, first_ns: int) -> int:
        """The same time on the clock of a log whose first sample has time `first_ns`."""
        return first_ns + self.nanoseconds if self.origin == "first sample" else self.nanoseconds


def time_point_from_text(text: str) -> TimePoint:
    """Read `12.5s` or `1500ms` after the first sample, integer nanoseconds, or an RFC 3339 time.

    Raises:
        UsageError: for anything else, and for a time that no log can hold.
    """
    if _DURATION.fullmatch(text):
        return TimePoint(duration_ns_from_text(text), "first sample")
    if _ABSOLUTE.fullmatch(text):
        return TimePoint(_checked_ns(int(text), text), "zero")
    if calendar := _CALENDAR.fullmatch(text):
        return TimePoint(_checked_ns(_ns_from_calendar(calendar, text), text), "zero")
    raise UsageError(
        f"{text!r} is not a time; write 12.5s or 1500ms after the log's first sample, "
        "integer nanoseconds, or 2026-01-31T12:00:00Z"
    )


def duration_ns_from_text(text: str) -> int:
    """Read a duration such as `2s`, `0.5s` or `1500ms` as nanoseconds, rounded to the nearest.

    Raises:
        UsageError: for anything else.
    """
    match = _DURATION.fullmatch(text)
    if match is None:
        raise UsageError(f"{text!r} is not a duration; write it as 2s, 0.5s or 1500ms")
    unit_ns = 10**9 if match["unit"].lower() == "s" else 10**6
    nanoseconds = Decimal(match["number"]) * unit_ns
    # compared before it becomes an integer, which might be one of a hundred digits
    return (
        int(nanoseconds.to_integral_value()) if nanoseconds <= LATEST_NS else _checked_ns(LATEST_NS + 1, text)
    )


@contextmanager
def read_for(option: str) -> Iterator[None]:
    """Name the option in what is said of a time or duration that cannot be read."""
    try:
        yield
    except UsageError as error:
        raise UsageError(f"{option}: {error}") from None


def text_from_duration_ns(nanoseconds: int) -> str:
    """A duration as `duration_ns_from_text` reads it, to the nanosecond: "2s", "0.25s"."""
    seconds, fraction_ns = divmod(nanoseconds, 10**9)
    return f"{seconds}.{fraction_ns:09d}".rstrip("0").rstrip(".") + "s"


def _ns_from_calendar(match: re.Match[str], text: str) -> int:
    offset = "+00:00" if match["offset"] in "Zz" else match["offset"]
    try:
        whole_seconds = datetime.fromisoformat(f"{match['date']}T{match['time']}{offset}")
    except ValueError as error:
        raise UsageError(f"{text!r} is no time of the calendar: {error}") from error
    fraction_ns = int((match["fraction"] or "").ljust(9, "0"))
    return (whole_seconds - _EPOCH) // timedelta(seconds=1) * 10**9 + fraction_ns


def _checked_ns(nanoseconds: int, text: str) -> int:
    if not 0 <= nanoseconds <= LATEST_NS:
        raise UsageError(f"{text!r} is longer than a log can be, or outside its times, 0 to 2**63 - 1 ns")
    return nanoseconds
