"""Laws of the numbers on rates and pairs."""

from __future__ import annotations

from math import comb

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay.judging.statistics import Rate, e_value, mcnemar_p, pass_hat_k

counts = st.integers(0, 60)


@given(st.integers(1, 200))
def test_evidence_of_a_fair_coin_is_one_on_average(tosses: int) -> None:
    mean = sum(comb(tosses, won) / 2**tosses * e_value(won, tosses - won) for won in range(tosses + 1))
    assert mean == pytest.approx(1.0)


@given(counts, counts)
def test_neither_side_of_a_comparison_has_an_advantage(won: int, lost: int) -> None:
    assert e_value(won, lost) == pytest.approx(e_value(lost, won))
    assert mcnemar_p(won, lost) == pytest.approx(mcnemar_p(lost, won))


@given(st.integers(0, 60), st.integers(1, 60))
def test_an_interval_contains_its_rate_and_mirrors_that_of_the_failures(successes: int, more: int) -> None:
    rate = Rate(successes, successes + more)
    failures = Rate(more, successes + more)
    assert rate.interval is not None
    assert failures.interval is not None
    assert rate.value is not None
    assert rate.interval.low <= rate.value <= rate.interval.high
    assert rate.interval.low == pytest.approx(1.0 - failures.interval.high)


@given(st.integers(0, 12), st.integers(0, 12))
def test_more_runs_of_a_start_succeed_less_often(successes: int, failures: int) -> None:
    runs = successes + failures
    rates = [pass_hat_k(successes, runs, k) for k in range(1, runs + 1)]
    assert rates == sorted(rates, reverse=True)
    assert not rates or rates[0] == successes / runs
