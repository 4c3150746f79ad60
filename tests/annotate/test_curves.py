"""The curves of a whole log in one message."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from spatial_replay import parse_specification
from spatial_replay.annotate.robustness import Thinning, curved_nodes

NUMBERS = st.one_of(st.floats(-1e6, 1e6), st.just(float("nan")))


def times(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.int64) * 500_000_000 + 2_000_000_000


@given(st.integers(1, 200).flatmap(lambda count: arrays(np.float64, count, elements=NUMBERS)))
def test_short_curves_are_sent_as_they_are(numbers: np.ndarray) -> None:
    thinning = Thinning(times(len(numbers)), 200)
    np.testing.assert_array_equal(thinning.points(times(len(numbers)), numbers), numbers)


@given(
    st.integers(41, 300).flatmap(lambda count: arrays(np.float64, count, elements=NUMBERS)),
    st.sampled_from([2, 10, 40]),
)
def test_long_curves_keep_their_extremes_in_each_stretch(numbers: np.ndarray, most: int) -> None:
    times_ns = times(len(numbers))
    thinning = Thinning(times_ns, most)
    points, seconds = thinning.points(times_ns, numbers), thinning.seconds(0)
    assert len(points) == len(seconds) == most
    assert (np.diff(seconds) >= 0).all()
    assert (seconds[0], seconds[-1]) == (times_ns[0] / 1e9, times_ns[-1] / 1e9)
    for first in range(0, most, 2):
        begin, end = np.searchsorted(times_ns / 1e9, seconds[[first, first + 1]])
        own = numbers[begin : end + 1]
        known = own[~np.isnan(own)]
        pair = sorted(points[first : first + 2].tolist())
        assert pair == [known.min(), known.max()] if len(known) else np.isnan(pair).all()


def test_an_instance_has_numbers_only_while_it_is_there() -> None:
    thinning = Thinning(times(10), 100)
    points = thinning.points(times(10)[4:6], np.array([1.0, 2.0]))
    np.testing.assert_array_equal(points, [np.nan] * 4 + [1.0, 2.0] + [np.nan] * 4)
    assert np.isnan(thinning.points(times(0), np.empty(0))).all()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("spec a = F (x ovlp y)\n", {0: "a"}),
        ("spec a = F (x ovlp y)\nspec b = G (x dist y >= 1)\nspec c = a and b\n", {0: "c", 1: "a", 3: "b"}),
        ("spec a = F (x ovlp y)\nspec c = a or (not a)\n", {0: "c"}),
    ],
)
def test_the_root_and_named_parts_have_curves(text: str, named: dict[int, str]) -> None:
    [root] = parse_specification(text).results
    assert {identifier: node.name for identifier, node in curved_nodes(root.formula).items()} == named
