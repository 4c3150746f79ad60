"""Operators over a few numbers, computed by hand."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest

from monitor.scenes import SECOND, judged, numbers, root
from spatial_replay import Monitor, Sample, Trace, parse_specification

P = [1, -2, 3, -4, 5]
Q = [-5, 4, -3, 2, -1]


@pytest.mark.parametrize(
    ("formula", "value"),
    [
        ("p >= 0", [1, 1, 1, 1, 1]),
        ("p <= 0", [-1, -1, -1, -1, -1]),
        ("p == 1", [inf, inf, inf, inf, inf]),
        ("p != 1", [-inf, -inf, -inf, -inf, -inf]),
        ("not p > 2", [1, 1, 1, 1, 1]),
        ("p >= 0 and q >= 0", [-5, -5, -5, -5, -5]),
        ("p >= 0 xor q >= 0", [1, 1, 1, 1, 1]),
        ("p >= 0 <-> q >= 0", [-1, -1, -1, -1, -1]),
        ("p >= 0 -> q >= 0", [-1, -1, -1, -1, -1]),
        ("X p >= 0", [-inf, -2, -2, -2, -2]),
        ("WX p >= 0", [inf, -2, -2, -2, -2]),
        ("X X p >= 0", [-inf, -inf, 3, 3, 3]),
        ("F p >= 0", [1, 1, 3, 3, 5]),
        ("G p >= 0", [1, -2, -2, -4, -4]),
        ("F[1,2] p >= 0", [-inf, -2, 3, 3, 3]),
        ("G[1,3] p >= 0", [inf, -2, -2, -4, -4]),
        ("F[1s, 2s] p >= 0", [-inf, -2, 3, 3, 3]),
        ("F[1.5s, 2.5s] p >= 0", [-inf, -inf, 3, 3, 3]),
        ("F[3,inf] p >= 0", [-inf, -inf, -inf, -4, 5]),
        ("p >= 0 U q >= 0", [-5, 1, 1, 1, 1]),
        ("p >= 0 U[2,3] q >= 0", [-inf, -inf, -3, -2, -2]),
        ("p >= -9 U[1,1] q >= 0", [-inf, 4, 4, 4, 4]),
        ("p >= 0 W q >= 0", [1, 1, 1, 1, 1]),
        ("q >= 0 W p >= 3", [-2, -2, -2, -2, -2]),
        ("p >= 0 R q >= 0", [-5, -5, -5, -5, -5]),
        ("p >= 5 R q >= -4", [-1, -1, -1, -1, -1]),
        ("X X (p >= 0 U[1,1] q >= 0)", [-inf, -inf, -inf, 2, 2]),
        ("X X (p <= 0 R[1s,1s] q >= 0)", [-inf, -inf, inf, 2, 2]),
        ("G F[0,1] p >= 0", [1, -2, 1, -4, 1]),
        ("F G[0,1] p >= 0", [1, -2, 3, -2, 5]),
        ("G (p >= 0 -> F[0,1] q >= 0)", [-1, 4, -3, 2, -1]),
        ("F Y q >= 0", [-inf, -5, 4, 4, 4]),
    ],
)
def test_value_at_the_first_sample_so_far(formula, value):
    np.testing.assert_array_equal(root(formula, numbers(p=P, q=Q)).value, value)


@pytest.mark.parametrize(
    ("formula", "now"),
    [
        ("p >= 0", P),
        ("F p >= 0", P),
        ("X p >= 0", [-inf] * 5),
        ("WX p >= 0", [inf] * 5),
        ("G[1,2] p >= 0", [inf] * 5),
        ("p >= 0 U q >= 0", Q),
        ("p >= 0 R q >= 0", Q),
        ("p >= 0 W q >= 0", [1, 4, 3, 2, 5]),
        ("Y p >= 0", [-inf, 1, -2, 3, -4]),
        ("O p >= 0", [1, 1, 3, 3, 5]),
        ("H p >= 0", [1, -2, -2, -4, -4]),
        ("O[1,2] p >= 0", [-inf, 1, 1, 3, 3]),
        ("H[1,2] p >= 0", [inf, 1, -2, -2, -4]),
        ("O[1s, 2s] p >= 0", [-inf, 1, 1, 3, 3]),
        ("O[1.5s, 2s] p >= 0", [-inf, -inf, 1, -2, 3]),
        ("H[3,inf] p >= 0", [inf, inf, inf, 1, -2]),
        ("p >= 0 S q >= 0", [-5, 4, 3, 2, 2]),
        ("p >= 0 S[1,1] q >= 0", [-inf, -5, 3, -4, 2]),
        ("O F p >= 0", [1, 1, 3, 3, 5]),
    ],
)
def test_now_at_each_sample(formula, now):
    np.testing.assert_array_equal(root(formula, numbers(p=P, q=Q)).now, now)


@pytest.mark.parametrize(
    ("formula", "lower", "upper"),
    [
        ("F p >= 0", [1, 1, 3, 3, 5], [inf] * 5),
        ("G p >= 0", [-inf] * 5, [1, -2, -2, -4, -4]),
        ("p >= 0 U q >= 0", [-5, 1, 1, 1, 1], [1, 1, 1, 1, 1]),
        ("X p >= 0", [-inf, -2, -2, -2, -2], [inf, -2, -2, -2, -2]),
        ("F[1,2] p >= 0", [-inf, -2, 3, 3, 3], [inf, inf, 3, 3, 3]),
        ("G[0s,2s] p >= 0", [-inf, -inf, -2, -2, -2], [1, -2, -2, -2, -2]),
        ("H p >= 0", [1] * 5, [1] * 5),
    ],
)
def test_interval_over_every_continuation(formula, lower, upper):
    node = root(formula, numbers(p=P, q=Q))
    np.testing.assert_array_equal(node.lower, lower)
    np.testing.assert_array_equal(node.upper, upper)


def test_windows_in_time_follow_the_clock_and_both_ends_belong_to_them():
    times = [0, 999_999_999, 2 * SECOND, 3 * SECOND, 3 * SECOND + 1]
    trace = Trace.from_samples(
        Sample(time, signals={"p": value}) for time, value in zip(times, P, strict=True)
    )
    assert root("F[1s, 3s] p >= 0", trace).value.tolist() == [-inf, -inf, 3, 3, 3]
    assert root("F[0s, 3s] p >= 4", trace).verdict == "violated"


def test_a_window_of_centuries_is_still_open():
    trace = Trace.from_samples(
        Sample(1_790_000_000 * SECOND + t, signals={"p": value}) for t, value in enumerate(P)
    )
    node = root("G F[0s, 8000000000s] p >= 6", trace)
    assert node.upper.tolist() == [inf] * 5
    assert node.value.tolist() == [-5, -8, -3, -10, -1]


def test_operators_over_a_single_sample():
    trace = numbers(p=[2])
    for formula in ("F p >= 0", "G p >= 0", "WX p >= 0", "H p >= 0", "G[0,3] p >= 0", "G F[0,3] p >= 0"):
        assert root(formula, trace).verdict == "satisfied", formula
    for formula in ("X p >= 0", "Y p >= 0", "F[1,2] p >= 0", "O[1,2] p >= 0"):
        assert root(formula, trace).verdict == "violated", formula


def test_zero_is_satisfied_and_so_is_its_negation():
    assert root("G p >= 1", numbers(p=[1])).verdict == "satisfied"
    assert root("not G p >= 1", numbers(p=[1])).verdict == "satisfied"


def test_an_unknown_number_leaves_a_gap_only_where_it_matters():
    trace = numbers(p=[1, None, 3])
    np.testing.assert_array_equal(root("G p >= 0", trace).value, [1, nan, nan])
    np.testing.assert_array_equal(root("p >= 0", trace).now, [1, nan, 3])
    np.testing.assert_array_equal(root("F p >= 0", trace).lower, [1, 1, 3])
    assert root("F p >= 0", trace).verdict == "satisfied"
    assert root("G p >= 0", trace).verdict == "unknown"
    assert root("G p >= 2", trace).verdict == "violated"


MODES = {"mode": [0, 2, 2, None], "gap": [-3, 1, -2, -9]}


@pytest.mark.parametrize(
    ("formula", "lower", "upper"),
    [
        ("G[0,2] (mode == 2 -> gap >= 0)", -2, -2),
        ("G[0,1] (mode == 2 -> gap >= 0)", 1, 1),
        ("G[0,2] not (mode == 2)", -inf, -inf),
        ("G[0,2] mode != 1", inf, inf),
        ("F (mode == 3)", -inf, inf),
        ("G (mode == 2 -> gap >= 0)", -9, -2),
    ],
)
def test_modes_are_compared_exactly_and_unknown_where_they_are_missing(formula, lower, upper):
    result = judged(formula, numbers(**MODES)).result()
    assert (result.lower, result.upper) == (lower, upper)


@pytest.mark.parametrize("formula", ["G (mode != 3)", "F (mode == 2)", "G (mode == 2 or gap >= 9)"])
def test_an_infinite_comparison_of_a_mode_tests_something(formula):
    result = judged(formula, numbers(mode=[2, 2, 2], gap=[1, 2, 3])).result()
    assert (result.lower, result.tested, result.vacuous) == (inf, "full", ())


def test_a_reason_about_a_mode_has_no_margin():
    evaluation = judged("G (not (mode == 2))", numbers(mode=[0, 2, 2]))
    text = evaluation.explain()
    assert "holds at 1.000 s (within `spec`): mode is 2." in text
    assert "inf" not in text.split("What decides")[1] and "No number" not in text


@pytest.mark.parametrize(
    ("formula", "verdict", "reason"),
    [
        ('G (mode == "AUTO" -> gap >= 0)', "violated", "gap is -2"),
        ('G (mode != "MANUAL")', "violated", 'mode is "MANUAL"'),
        ('F ("HOLD" == mode)', "violated", "mode is another text"),
        ("G (mode == 2)", "unknown", "signal 'mode' is a text, not a number"),
        ("G (mode >= 2)", "unknown", "signal 'mode' is a text, not a number"),
        ('G (gap == "AUTO")', "unknown", "signal 'gap' is a number, not a text; `names` of its mapping"),
    ],
)
def test_texts_are_compared_with_texts_alone(formula, verdict, reason):
    trace = numbers(mode=["AUTO", "MANUAL", "AUTO"], gap=[1, -3, -2])
    evaluation = judged(formula, trace)
    assert evaluation.verdict == verdict
    assert reason in evaluation.explain()
    monitor = Monitor(parse_specification(formula))
    updates = [monitor.update(sample).specs[0].numbers for sample in trace.samples()]
    assert np.stack(updates, axis=-1).tobytes() == evaluation.result().series.tobytes()


@pytest.mark.parametrize(
    ("formula", "remarks"),
    [
        ("F (p >= 1)", ["`spec` is already true at the first sample."]),
        ("F (p >= 2)", []),
        ("F[1, 3] (p >= 1)", []),
        ("G (p >= -9 -> F (p >= 1))", []),
        ("spec go = F (p >= 1)\nspec s = go and F (q >= 2)", ["`go` is already true at the first sample."]),
    ],
)
def test_goals_that_the_first_sample_fulfils_are_remarked(formula, remarks):
    assert [str(each) for each in judged(formula, numbers(p=P, q=Q)).result().remarks] == remarks
