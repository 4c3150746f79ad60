"""The cookbook: every recipe holds on a run that keeps it, and fails on one that breaks it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest

import spatial_replay as sr

PAGE = Path(__file__).resolve().parent.parent / "docs" / "cookbook.md"
RECIPES = {
    re.findall(r"^spec (\w+)", text, re.MULTILINE)[-1]: text
    for text in re.findall(r"^```spatial\n(.*?)^```$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
}
SECOND = 10**9
IN, OUT = (0.2, 0.15), (1.0, 0.15)
"""A place inside the box from (0, 0) to (0.4, 0.3), and one outside."""


def at(places: Sequence[tuple[float, float]], class_name: str | None = None) -> list[sr.TrackedObject]:
    """A small object at these places, one a sample."""
    return [sr.TrackedObject(sr.Footprint.disc(x, y, 0.01), class_name=class_name) for x, y in places]


def visits(places: Sequence[tuple[float, float] | None]) -> sr.Trace:
    """A robot at the origin, and ann at these places, one a sample; None where she is not in view."""
    robot, *ann = at([(0, 0), *(place or OUT for place in places)])
    return sr.Trace.from_samples(
        sr.Sample(step * SECOND, {"robot": robot, **({"ann": each} if place else {})})
        for step, (each, place) in enumerate(zip(ann, places, strict=True))
    )


def run(
    objects: dict[str, list[sr.TrackedObject]] | None = None,
    signals: dict[str, Sequence[float]] | None = None,
    *,
    period_ns: int = SECOND,
) -> sr.Trace:
    """A trace with one sample for each place and number."""
    objects, signals = objects or {}, signals or {}
    count = len(next(iter([*objects.values(), *signals.values()])))
    return sr.Trace.from_samples(
        sr.Sample(
            step * period_ns,
            {name: places[step] for name, places in objects.items()},
            {name: float(numbers[step]) for name, numbers in signals.items()},
        )
        for step in range(count)
    )


def three(red: Sequence[tuple[float, float]], green: Sequence[tuple[float, float]]) -> sr.Trace:
    return run({"red": at(red), "green": at(green), "blue": at([OUT] * len(red))})


def hands(left: Sequence[float], right: Sequence[float]) -> sr.Trace:
    """Two hands on a line, and a part at 0."""
    return run(
        {
            "left": at([(-x, 0) for x in left]),
            "right": at([(x, 0) for x in right]),
            "part": at([(0, 0)] * len(left)),
        }
    )


AWAY, MAT = (1.0, 1.0), (0.0, -0.1)
CASES = {
    "ordered": (
        run({"cup": at([AWAY, AWAY, MAT]), "plate": at([AWAY, MAT, MAT])}),
        run({"cup": at([AWAY, MAT, MAT]), "plate": at([AWAY, AWAY, MAT])}),
    ),
    "kept_out": (run({"robot": at([(0, 1), (1.8, 1)])}), run({"robot": at([(0, 1), (1.95, 1)])})),
    "can_stop": (
        run({"robot": at([(0, 0), (1, 0), (1.05, 0)])}),
        run({"robot": at([(0, 0), (1, 0), (1.8, 0)])}),
    ),
    "follows": (
        run(signals={"wanted": [0, 1, 1, 1, 1], "level": [0, 0, 0.5, 0.97, 1]}),
        run(signals={"wanted": [0, 1, 1, 1, 1], "level": [0, 0, 0.5, 0.9, 1]}),
    ),
    "distant": (
        run({"robot": at([(0, 0)] * 2), "ann": at([(2, 0), (1, 0)], "person")}),
        run({"robot": at([(0, 0)] * 2), "ann": at([(2, 0), (0.4, 0)], "person")}),
    ),
    "held": (run({"cube": at([OUT, IN, IN, IN, OUT])}), run({"cube": at([OUT, IN, IN, OUT, IN])})),
    "stays": (run({"cube": at([OUT, IN, IN, IN])}), run({"cube": at([IN, IN, OUT, IN, IN])})),
    "gentle": (
        run(signals={"force": [5, 20, 20, 5, 5, 20]}, period_ns=SECOND // 5),
        run(signals={"force": [5, 20, 20, 20, 20, 5]}, period_ns=SECOND // 5),
    ),
    "responds": (
        run(signals={"button": [0, 1, 0, 0], "opening": [0, 0, 0.09, 0]}),
        run(signals={"button": [0, 1, 0, 0], "opening": [0, 0, 0, 0.09]}),
    ),
    "returns": (
        run({"robot": at([(5, 0), (3, 0), (0, 0)])}, {"battery": [0.5, 0.2, 0.1]}, period_ns=5 * SECOND),
        run({"robot": at([(5, 0), (3, 0), (3, 0), (2, 0)])}, {"battery": [0.19] * 4}, period_ns=5 * SECOND),
    ),
    "handover": (
        hands([0, 0, 0.01, 0.2], [0.3, 0.01, 0, 0]),
        hands([0, 0, 0.2, 0.2], [0.3, 0.2, 0.2, 0]),
    ),
    "two_of_three": (three([OUT, IN, IN], [OUT, OUT, IN]), three([OUT, IN, OUT], [OUT, OUT, IN])),
    "one_at_a_time": (three([IN, OUT, OUT], [OUT, OUT, IN]), three([IN, IN, OUT], [OUT, IN, IN])),
    "twice": (run({"robot": at([IN, OUT, IN])}), run({"robot": at([OUT, IN, IN])})),
    "seen": (visits([None, (2, 0), None, (1, 0)]), visits([(2, 0), None, (0.4, 0)])),
    "steady": (
        run({"cup": at([(0, 0), (0, 0), (0.5, 0)]), "kettle": at([(2, 0), (0.1, 0), (2, 0)])}),
        run({"cup": at([(0, 0), (0.1, 0), (0.5, 0)]), "kettle": at([(2, 0), (0.1, 0), (2, 0)])}),
    ),
}
"""For each recipe, a run that keeps it and a run that breaks it."""


def verdict(recipe: str, trace: sr.Trace) -> str:
    return str(sr.evaluate(sr.parse_specification(RECIPES[recipe]), trace).verdict)


@pytest.mark.parametrize("recipe", CASES)
def test_a_run_that_keeps_the_recipe_satisfies_it(recipe: str) -> None:
    assert verdict(recipe, CASES[recipe][0]) == "satisfied"


@pytest.mark.parametrize("recipe", CASES)
def test_a_run_that_breaks_the_recipe_violates_it(recipe: str) -> None:
    assert verdict(recipe, CASES[recipe][1]) == "violated"


def test_every_recipe_of_the_page_has_both_runs() -> None:
    assert set(RECIPES) == set(CASES)


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_reads_as_it_is_meant(recipe: str) -> None:
    assert not sr.parse_specification(RECIPES[recipe]).warnings
