"""Laws of computed numbers: sums, multiples and `abs` have the bits that numpy computes."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay import (
    Footprint,
    Monitor,
    Sample,
    Trace,
    TrackedObject,
    evaluate,
    parse_specification,
)
from spatial_replay.spec import format_specification

LENGTH = 4
NAMES = ("x", "y", "z")
values = st.one_of(st.floats(-1e3, 1e3), st.sampled_from([0.0, -0.0, 0.1, np.nan]))
columns = st.fixed_dictionaries(
    {name: st.lists(values, min_size=LENGTH, max_size=LENGTH).map(np.array) for name in NAMES}
)
factors = st.sampled_from(["2", "0.1", "3", "1e-3", "-0.7"])


def _computed(inner: st.SearchStrategy[tuple[str, Any]]) -> st.SearchStrategy[tuple[str, Any]]:
    def plus(one: tuple[str, Any], other: tuple[str, Any]) -> tuple[str, Any]:
        return f"({one[0]} + {other[0]})", lambda at: one[1](at) + other[1](at)

    def minus(one: tuple[str, Any], other: tuple[str, Any]) -> tuple[str, Any]:
        return f"({one[0]} - {other[0]})", lambda at: one[1](at) - other[1](at)

    def times(factor: str, one: tuple[str, Any]) -> tuple[str, Any]:
        return f"{factor} * ({one[0]})", lambda at: float(factor) * one[1](at)

    def over(factor: str, one: tuple[str, Any]) -> tuple[str, Any]:
        return f"({one[0]} / {factor})", lambda at: one[1](at) / float(factor)

    def absolute(one: tuple[str, Any]) -> tuple[str, Any]:
        return f"abs({one[0]})", lambda at: np.abs(one[1](at))

    return st.one_of(
        st.builds(plus, inner, inner),
        st.builds(minus, inner, inner),
        st.builds(times, factors, inner),
        st.builds(over, factors, inner),
        st.builds(absolute, inner),
    )


def _signal(name: str) -> tuple[str, Any]:
    return name, lambda at: at[name]


numbers = st.recursive(st.sampled_from(NAMES).map(_signal), _computed, max_leaves=5)


def _trace(at: dict[str, np.ndarray]) -> list[Sample]:
    return [
        Sample(t * 10**8, {}, signals={name: float(at[name][t]) for name in NAMES}) for t in range(LENGTH)
    ]


@given(left=numbers, right=numbers, sign=st.sampled_from(["<=", "<", ">=", ">"]), at=columns)
def test_a_comparison_of_sums_is_that_of_numpy_offline_and_live(
    left: tuple[str, Any], right: tuple[str, Any], sign: str, at: dict[str, np.ndarray]
) -> None:
    specification = parse_specification(f"G ({left[0]} {sign} {right[0]})")
    high, low = (left, right) if sign[0] == ">" else (right, left)
    samples = _trace(at)
    now = np.asarray(evaluate(specification, Trace.from_samples(samples)).result().nodes[1].now)
    np.testing.assert_array_equal(now, high[1](at) - low[1](at))
    monitor = Monitor(specification)
    live = np.array([monitor.update(sample).specs[0].nodes[1].now for sample in samples])
    assert live.tobytes() == now.tobytes()
    assert parse_specification(format_specification(specification)) == specification


@given(
    gaps=st.lists(st.floats(0.1, 5.0), min_size=2, max_size=2),
    uncertainty=st.floats(0.0, 0.05),
    moves=st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
    limit=st.floats(-3.0, 3.0),
)
def test_the_interval_of_a_sum_holds_its_number_wherever_the_objects_may_be(
    gaps: list[float], uncertainty: float, moves: list[float], limit: float
) -> None:
    def trace(shifts: list[float], error: float) -> Trace:
        places = np.cumsum([0.0, *gaps]) + np.array(shifts) * uncertainty
        discs = {
            name: TrackedObject(Footprint.disc(x, 0.0, 0.01), uncertainty=error)
            for name, x in zip("abc", places, strict=True)
        }
        return Trace.from_samples([Sample(0, discs, signals={"x": 0.5})])

    text = f"abs(2 * (a dist b) - (b dist c) / 3) >= x + {limit!r}"
    uncertain, moved = (
        evaluate(parse_specification(text), trace(shifts, error)).result().final[0]
        for shifts, error in (([0.0] * 3, uncertainty), (moves, 0.0))
    )
    assert uncertain[0] - 1e-9 <= moved[0] <= moved[1] <= uncertain[1] + 1e-9
