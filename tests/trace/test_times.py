"""Times as people write them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay import UsageError
from spatial_replay.trace.trace import (
    LATEST_NS,
    TimePoint,
    duration_ns_from_text,
    time_point_from_text,
)

times_ns = st.integers(0, LATEST_NS)
zones = st.integers(-14 * 60, 14 * 60).map(lambda minutes: timezone(timedelta(minutes=minutes)))


@given(times_ns)
def test_nanoseconds_are_on_the_clock_of_the_log(time_ns: int) -> None:
    assert time_point_from_text(f"{time_ns}ns").absolute_ns(first_ns=17) == time_ns


@given(st.integers(10**12, LATEST_NS))
def test_large_integers_are_nanoseconds(time_ns: int) -> None:
    assert time_point_from_text(str(time_ns)) == time_point_from_text(f"{time_ns}ns")


@pytest.mark.parametrize("text", ["3", "0", "1500", "999999999999"])
def test_a_small_integer_is_refused_with_both_readings(text: str) -> None:
    with pytest.raises(
        UsageError, match=f"{text}s after the log's first sample, or {text} ns on the log's own"
    ) as no:
        time_point_from_text(text)
    assert str(no.value).endswith(f"Write {text}s or {text}ns")


@given(times_ns, st.integers(0, 10**18))
def test_seconds_count_from_the_first_sample_to_the_nanosecond(offset_ns: int, first_ns: int) -> None:
    text = f"{offset_ns // 10**9}.{offset_ns % 10**9:09d}s"
    assert time_point_from_text(text).absolute_ns(first_ns) == first_ns + offset_ns


@given(st.integers(0, 10**12))
def test_milliseconds_are_thousandths_of_seconds(count: int) -> None:
    assert duration_ns_from_text(f"{count}ms") == count * 10**6 == duration_ns_from_text(f"{count}e-3s")


@given(
    st.datetimes(min_value=datetime(1970, 1, 3), max_value=datetime(2261, 12, 31)),
    zones,
    st.integers(0, 999),
)
def test_calendar_times_keep_nanoseconds_and_time_zones(
    local: datetime, zone: timezone, nanoseconds: int
) -> None:
    moment = local.replace(tzinfo=zone)
    offset = moment.strftime("%z")
    text = f"{local:%Y-%m-%dT%H:%M:%S}.{local.microsecond:06d}{nanoseconds:03d}{offset[:3]}:{offset[3:]}"
    microseconds = (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1)
    assert time_point_from_text(text) == TimePoint(microseconds * 1000 + nanoseconds, "zero")


def test_z_means_utc_and_a_blank_can_replace_t() -> None:
    expected = TimePoint(1_769_860_800 * 10**9, "zero")
    assert time_point_from_text("2026-01-31T12:00:00Z") == expected
    assert time_point_from_text("2026-01-31 13:00:00+01:00") == expected


@pytest.mark.parametrize(
    "text",
    [
        "",
        "soon",
        "12.5",
        "-1",
        "1 s",
        "1e999s",
        "1m",
        "nans",
        "2026-01-31",
        "2026-01-31T12:00:00",
        "2026-02-30T12:00:00Z",
        "2026-01-31T25:00:00Z",
        "1969-12-31T23:59:59Z",
        "1e30s",
        str(LATEST_NS + 1),
        "٣s",
    ],
)
def test_any_other_text_is_refused_with_the_text_in_the_message(text: str) -> None:
    with pytest.raises(UsageError) as refusal:
        time_point_from_text(text)
    assert repr(text) in str(refusal.value)


@given(st.text(max_size=30))
def test_no_text_raises_anything_but_a_usage_error(text: str) -> None:
    try:
        point = time_point_from_text(text)
    except UsageError:
        return
    assert 0 <= point.nanoseconds <= LATEST_NS


def test_a_duration_requires_a_unit() -> None:
    assert duration_ns_from_text("2s") == 2 * 10**9
    with pytest.raises(UsageError, match="write it as 2s"):
        duration_ns_from_text("2")
