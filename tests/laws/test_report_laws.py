"""What a report's page keeps of a run, and how it writes that down."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from spatial_replay.annotate.scene.scene_frames import DrawnEntity, SceneFrame
from spatial_replay.report.data import NodeSeries, choose_samples
from spatial_replay.report.panels import (
    MOST_CORNERS,
    MOST_FRAMES,
    ReportedScene,
    json_text,
    sentence_parts,
    singles,
)

NUMBERS = st.one_of(
    st.floats(-10, 10), st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-300, -1e-300])
)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@st.composite
def runs(draw: st.DrawFn) -> tuple[np.ndarray, list[NodeSeries]]:
    """Times of samples, and curves over stretches of them."""
    count = draw(st.integers(1, 300))
    times_ns = np.cumsum(draw(arrays.arrays(np.int64, count, elements=st.integers(1, 10**9))))
    curves = []
    for _ in range(draw(st.integers(0, 3))):
        begin = draw(st.integers(0, count - 1))
        end = draw(st.integers(begin + 1, count))
        shape = (draw(st.integers(1, 3)), 4, end - begin)
        curves.append(
            NodeSeries(times_ns[begin:end], draw(arrays.arrays(np.float64, shape, elements=NUMBERS)))
        )
    return times_ns, curves


@given(runs(), st.integers(20, 400))
def test_no_more_samples_are_kept_than_there_is_room_for(
    run: tuple[np.ndarray, list[NodeSeries]], most: int
) -> None:
    times_ns, curves = run
    kept = choose_samples(times_ns, curves, most)
    assert len(kept) <= most
    assert (np.diff(kept) > 0).all()
    ends = {0, len(times_ns) - 1}
    for each in curves:
        ends |= set(np.searchsorted(times_ns, each.times_ns[[0, -1]]).tolist())
    assert ends <= set(kept.tolist())
    if len(times_ns) <= most:
        assert len(kept) == len(times_ns)


@given(arrays.arrays(np.float64, 2_000, elements=st.floats(0.5, 2)), st.integers(0, 1_999), st.floats(3, 9))
def test_a_peak_of_one_sample_is_kept(numbers: np.ndarray, at: int, peak: float) -> None:
    numbers[at] = peak
    series = np.stack([numbers, numbers, numbers, numbers])[None]
    times_ns = np.arange(2_000)
    kept = choose_samples(times_ns, [NodeSeries(times_ns, series)], 400)
    assert at in kept
    assert numbers[kept].min() == numbers.min()


@given(arrays.arrays(np.bool_, 1_500))
def test_of_few_changes_of_sign_both_sides_are_kept(changes: np.ndarray) -> None:
    turns = np.flatnonzero(changes)[:60]
    sign = np.ones(1_500)
    for turn in turns:
        sign[turn:] *= -1.0
    series = np.stack([sign, sign, sign, sign])[None]
    times_ns = np.arange(1_500)
    kept = set(choose_samples(times_ns, [NodeSeries(times_ns, series)], 800).tolist())
    after = np.flatnonzero(np.diff(sign)) + 1
    assert set(after.tolist()) <= kept
    assert {turn - 1 for turn in after.tolist()} <= kept


@given(st.integers(1, 10_000), st.sampled_from([0, 7]))
def test_frames_are_taken_at_equal_distances(count: int, corners: int) -> None:
    scene = ReportedScene()
    frame = frame_with(corners)
    for time_ns in range(count):
        scene.add_frame(time_ns, lambda: frame)
    assert scene.times_ns.tolist() == list(range(0, count, scene.stride))
    assert len(scene.frames) == len(scene.times_ns) <= MOST_FRAMES
    assert scene.stride == 1 or len(scene.frames) >= MOST_FRAMES // 2


def test_of_frames_with_many_corners_fewer_are_taken() -> None:
    scene = ReportedScene()
    frame = frame_with(MOST_CORNERS // 10)
    for time_ns in range(25):
        scene.add_frame(time_ns, lambda: frame)
    assert sum(frame.corners for _, frame in scene.frames) <= MOST_CORNERS
    assert scene.times_ns.tolist() == list(range(0, 25, scene.stride))
    assert scene.stride == 4


def frame_with(corners: int) -> SceneFrame:
    return SceneFrame({"object/a": DrawnEntity((np.zeros((corners, 2)),), (0, 0, 0))}, ())


@given(arrays.arrays(np.float64, st.integers(0, 50), elements=st.floats(width=64)))
def test_half_the_room_keeps_every_sign(numbers: np.ndarray) -> None:
    half = singles(numbers)
    assert np.array_equal(half >= 0.0, numbers >= 0.0)
    assert np.array_equal(half < 0.0, numbers < 0.0)
    assert np.array_equal(np.isnan(half), np.isnan(numbers))


@given(VALUES)
def test_json_in_a_page_reads_back_and_has_no_sign_of_html(value: Any) -> None:
    text = json_text(value)
    assert json.loads(text) == value
    assert text.isascii()
    assert not set("<>&") & set(text)


@given(st.lists(st.text(), min_size=1, max_size=4))
def test_names_with_any_signs_leave_code_whole(names: list[str]) -> None:
    quoted = ['"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"' for name in names]
    codes = [f"{name} dist b <= -9" for name in quoted]
    sentence = " fails, and ".join(f"`{code}`" for code in codes) + f" fails: {names[0]} and b touch."
    parts = sentence_parts(sentence)
    assert parts[1 : 2 * len(codes) : 2] == codes
    assert all(text == " fails, and " for text in parts[2 : 2 * len(codes) : 2])
