"""The time of a playback, by a clock."""

from __future__ import annotations

from itertools import accumulate
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import spatial_replay as sr
from spatial_replay.logs.source import MemorySource
from spatial_replay.replay.loaded_log import LoadedLog
from spatial_replay.replay.specification_files import SpecificationFiles
from spatial_replay.serve.player import FASTEST, SLOWEST, Session, Status, Transport

START_NS, END_NS = 5_000_000_000, 65_000_000_000
SECOND_NS = 1_000_000_000


def test_a_playback_begins_paused_at_the_start() -> None:
    transport = Transport(START_NS, END_NS)
    assert transport.state(100.0) == (Status.PAUSED, START_NS, 1.0, False)
    assert transport.time_ns(200.0) == START_NS


@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.sampled_from([0.5, 1.0, 3.0])), max_size=8))
def test_a_playback_moves_by_the_clock_times_the_speed(parts: list[tuple[float, float]]) -> None:
    transport = Transport(START_NS, END_NS)
    now = 100.0
    transport.play(now)
    for seconds, speed in parts:
        transport.set_speed(speed, now)
        now += seconds
    played_s = sum(seconds * speed for seconds, speed in parts)
    assert transport.time_ns(now) == pytest.approx(START_NS + played_s * 1e9, abs=100)


@given(st.lists(st.floats(0.0, 30.0), min_size=1, max_size=8))
def test_a_playback_never_goes_back_or_beyond_the_end(waits: list[float]) -> None:
    transport = Transport(START_NS, END_NS)
    transport.play(0.0)
    places = [transport.time_ns(now) for now in accumulate(waits)]
    assert places == sorted(places)
    assert places[-1] <= END_NS


def test_no_time_passes_during_a_pause() -> None:
    transport = Transport(START_NS, END_NS)
    transport.play(0.0)
    transport.pause(2.0)
    transport.play(50.0)
    assert transport.time_ns(51.0) == START_NS + 3 * SECOND_NS


def test_a_playback_paused_at_the_end_has_ended() -> None:
    transport = Transport(START_NS, END_NS)
    transport.play(0.0)
    assert transport.state(1000.0).status is Status.PLAYING
    transport.pause(1000.0)
    assert transport.state(2000.0) == (Status.ENDED, END_NS, 1.0, False)


@given(st.integers(-(2**63), 2**64), st.booleans())
def test_a_seek_stays_within_the_log(time_ns: int, is_playing: bool) -> None:
    transport = Transport(START_NS, END_NS)
    if is_playing:
        transport.play(0.0)
    transport.move_to(time_ns, 7.0)
    assert transport.time_ns(7.0) == min(max(time_ns, START_NS), END_NS)


@given(st.floats())
def test_the_speed_stays_within_limits(speed: float) -> None:
    transport = Transport(START_NS, END_NS)
    transport.set_speed(speed, 0.0)
    assert SLOWEST <= transport.state(0.0).speed <= FASTEST


def test_what_a_viewer_sets_while_its_former_value_is_written_stays(tmp_path: Path) -> None:
    path = tmp_path / "s.spatial"
    text = "const near = 70\nspec s = F cube dist cup <= near\n"
    path.write_text(text)
    files = SpecificationFiles([path])
    cube = {"cube": sr.Footprint.box(0, 0, 1, 1), "cup": sr.Footprint.box(2, 0, 3, 1)}
    loaded = LoadedLog(MemorySource(sr.Trace.from_samples([sr.Sample(0, cube)])), files.load(), saved=files)
    session = Session(loaded, 0, 1)
    session.set_constants({"near": 80.0})
    edited = session.edited
    session.set_constants({"near": 90.0})
    assert edited.loaded.write_constants(edited.given) == {"near": 80.0}
    session.replace_log(loaded.with_files(files.load()))
    assert session.values == {"near": 90.0}
    # the text changed it after that, which is not overwritten before it is loaded
    path.write_text(text.replace("70", "60"))
    with pytest.raises(sr.UsageError, match="near was just saved as 60"):
        session.edited.loaded.write_constants(session.edited.given)
    assert path.read_text() == text.replace("70", "60")
    session.replace_log(session.edited.loaded.with_files(files.load()))
    assert session.values == {"near": 60.0}
