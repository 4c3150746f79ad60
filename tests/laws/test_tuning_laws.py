"""Tuned constants do what they claim, and a step beyond what is claimed does not."""

from __future__ import annotations

from decimal import Decimal

from hypothesis import assume, given
from hypothesis import strategies as st

import spatial_replay as sr
from examples import examples
from tuning.tuned_runs import run_at

TEXTS = {
    "near": "const near = 2 in [0, 8]\nspec s = F[0, 2] (cube dist cup <= near)\n",
    "far": "const far = 2 in [0, 8]\nspec s = not F (cube dist cup < far)\n",
    "reach": "const reach = 1 in [0, 8]\nspec s = G[1, 3] (cube ovlp enlarge(cup, reach))\n",
    "soon": "const soon = 1s in [0s, 3s]\nspec s = F[0s, soon] (cube dist cup <= 3)\n",
    "count": "const count = 1 in [0, 6]\nspec s = G[0, count] (cube dist cup >= 2)\nspec t = G true\n",
}
"""Thresholds, an enlargement, and windows in seconds and in samples; looser as they grow, or tighter."""
TIGHTER = {"far", "count"}

RUNS = st.lists(st.integers(0, 80).map(lambda tenths: tenths / 10), min_size=5, max_size=5)


def satisfied(text: str, name: str, value: float | str, run: list[float]) -> bool:
    file = sr.parse_specification(text, constants={name: value})
    return sr.evaluate(file, run_at(run)).verdict == "satisfied"


def beyond(value: float | str, step: float, direction: int) -> float | str:
    """The next value of the grid."""
    number = Decimal(str(value).removesuffix("s")) + direction * Decimal(repr(step))
    return f"{number:f}s" if isinstance(value, str) else float(number)


@examples(25)
@given(st.sampled_from(sorted(TEXTS)), st.lists(RUNS, min_size=1, max_size=4))
def test_the_tightest_value_satisfies_all_good_runs_and_a_tighter_one_does_not(
    name: str, good: list[list[float]]
) -> None:
    text = TEXTS[name]
    tuning = sr.tune(sr.parse_specification(text), [run_at(each) for each in good])
    (found,) = tuning.constants
    loosest = found.tried[0 if name in TIGHTER else 1]
    assert tuning.is_found == all(satisfied(text, name, loosest, run) for run in good)
    assume(tuning.is_found)
    assert all(satisfied(text, name, found.value, run) for run in good)
    tightest = found.tried[1 if name in TIGHTER else 0]
    if found.value != tightest:
        tighter = beyond(found.value, found.step, 1 if name in TIGHTER else -1)
        assert not all(satisfied(text, name, tighter, run) for run in good)


@examples(25)
@given(
    st.sampled_from(sorted(TEXTS)),
    st.lists(RUNS, min_size=1, max_size=3),
    st.lists(RUNS, min_size=1, max_size=3),
    st.lists(st.floats(0, 1), min_size=4, max_size=4),
)
def test_the_values_that_fit_are_all_those_stated_and_none_has_a_wider_margin(
    name: str, good: list[list[float]], bad: list[list[float]], shares: list[float]
) -> None:
    text = TEXTS[name]
    tuning = sr.tune(sr.parse_specification(text), *([run_at(each) for each in runs] for runs in (good, bad)))
    (found,) = tuning.constants

    def fits(value: float | str) -> bool:
        return all(satisfied(text, name, value, run) for run in good) and not any(
            satisfied(text, name, value, run) for run in bad
        )

    def margin(value: float | str) -> float:
        file = sr.parse_specification(text, constants={name: value})
        robustness = [
            [min(each.robustness for each in sr.evaluate(file, run_at(run)).results) for run in runs]
            for runs in (good, bad)
        ]
        return min([*robustness[0], *(-each for each in robustness[1])])

    def other(share: float) -> float | str:
        low, high = (Decimal(str(end).removesuffix("s")) for end in found.tried)
        step = Decimal(repr(found.step))
        number = min(low + int(Decimal(share) * (high - low) / step) * step, high)
        return f"{number:f}s" if isinstance(found.value, str) else float(number)

    others = [other(share) for share in shares]
    if not tuning.is_found:
        assert tuning.conflict is not None and tuning.conflict.runs
        assert not any(map(fits, [*others, *found.tried]))
        return
    for value in (found.value, found.low, found.high):
        assert fits(value)
    for end, tried, direction in ((found.low, found.tried[0], -1), (found.high, found.tried[1], 1)):
        assert end == tried or not fits(beyond(end, found.step, direction))
    assert tuning.margin == margin(found.value)
    assert all(margin(value) <= tuning.margin for value in others)


@examples(15)
@given(st.lists(RUNS, min_size=1, max_size=2), st.lists(RUNS, min_size=1, max_size=2))
def test_several_constants_fit_every_run_and_a_step_beyond_the_ends_of_each_does_not(
    good: list[list[float]], bad: list[list[float]]
) -> None:
    text = (
        "const near = 2 in [0, 8]\nconst count = 1 in [0, 4]\nspec s = F[0, count] (cube dist cup <= near)\n"
    )

    def fits(values: dict[str, float | str]) -> bool:
        near, count = float(values["near"]), int(values["count"])
        nearest = [[min(run[: count + 1]) for run in runs] for runs in (good, bad)]
        return all(each <= near for each in nearest[0]) and not any(each <= near for each in nearest[1])

    tuning = sr.tune(
        sr.parse_specification(text), *([run_at(each) for each in runs] for runs in (good, bad)), seed=3
    )
    grid = [{"near": near / 10, "count": count} for near in range(81) for count in range(5)]
    assert tuning.is_found == any(map(fits, grid))
    assume(tuning.is_found)
    assert fits(tuning.values)
    for each in tuning.constants:
        for end, tried, direction in ((each.low, each.tried[0], -1), (each.high, each.tried[1], 1)):
            assert fits({**tuning.values, each.name: end})
            if end != tried:
                assert not fits({**tuning.values, each.name: beyond(end, each.step, direction)})
