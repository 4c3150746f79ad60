"""Comparisons of computed numbers: what they say, their units, and where they stand."""

from __future__ import annotations

import pytest

import spatial_replay as sr
from spatial_replay.spec.walks import declared_unit, units_of


def trace(units: dict[str, str] | None = None) -> sr.Trace:
    """A person nears a robot by 0.5 each second from 2.5 on, while a limit rises and a load falls."""
    samples = [
        sr.Sample(
            time_ns=second * 10**9,
            objects={
                "robot": sr.Footprint.box(0, 0, 1, 1),
                "anna": sr.TrackedObject(sr.Footprint.box(3.5 - 0.5 * second, 0, 5, 1), class_name="person"),
            },
            signals={"limit": 0.5 * second, "load": 4.0 - second},
        )
        for second in range(5)
    ]
    return sr.Trace.from_samples(samples, units=units)


@pytest.mark.parametrize(
    ("text", "robustness", "sentences"),
    [
        (
            "G (load >= limit)",
            -2.0,
            (
                "`load >= limit`, which fails by 2 kg at 4.000 s",
                "load is 0 kg and limit is 2 kg",
                "with `load >= limit - 2` instead of `load >= limit`",
            ),
        ),
        (
            "G (abs(load - limit) <= 3)",
            -1.0,
            ("load is 4 kg and limit is 0 kg", "with 4 or more instead of 3 in `abs(load - limit) <= 3`"),
        ),
        (
            "const k = 2\nspec s = G (k * load + limit <= k)",
            -6.0,
            ("`2 * load + limit <= 2`, which fails by 6 kg", "with 8 or more instead of 2"),
        ),
        (
            'G (forall p in class "person": robot dist p >= 0.2 + 0.1 * limit)',
            0.1,
            ("`robot dist anna >= 0.2 + (0.1 * limit)`", "with 0.3001 or more instead of 0.2"),
        ),
        (
            "spec s(p) = G (robot dist p - 2 * speed(p) >= -1)",
            1.0,
            ("`(robot dist anna) - (2 * speed(anna)) >= -1`", "anna moved by 0.25 m"),
        ),
        ("G (-1 <= load - limit <= 4)", -1.0, ("load is 0 kg and limit is 2 kg",)),
    ],
)  # fmt: skip
def test_computed_numbers_are_explained_by_what_they_are_computed_from(
    text: str, robustness: float, sentences: tuple[str, ...]
) -> None:
    units = {"": "m", "limit": "kg", "load": "kg"} if "forall" not in text else {}
    specification = sr.parse_specification(text)
    each = {"p": "class:person"} if specification.specs[0].parameter else {}
    (result,) = sr.evaluate(specification, trace(units), each=each).results
    assert result.robustness == pytest.approx(robustness)
    explanation = result.explain()
    for sentence in sentences:
        assert sentence in explanation


def test_numbers_of_different_declared_units_are_not_added() -> None:
    specification = sr.parse_specification("G (load >= limit - 1)")
    with pytest.raises(sr.SpecificationError, match="adds or compares numbers in kg and m") as caught:
        sr.evaluate(specification, trace({"load": "kg", "limit": "m"}))
    assert "multiply one of them by a constant" in str(caught.value)
    with pytest.raises(sr.SpecificationError, match="in kg and m"):
        sr.Monitor(specification, units={"load": "kg", "limit": "m"})
    converted = sr.parse_specification("G (load >= 0.001 * limit - 1)")
    (result,) = sr.evaluate(converted, trace({"load": "kg", "limit": "m"})).results
    assert result.robustness == pytest.approx(0.998)


@pytest.mark.parametrize(
    ("text", "units", "declared"),
    [
        ("load >= limit", ["load"], "kg"),
        ("a dist b >= 0.2 + limit", ["lengths"], "m"),
        ("2 * load <= 3", ["multiples"], ""),
        ("3 - abs(2 * limit + load) >= 0", ["load"], "kg"),
        ("scale load = 2\nspec s = load + 2 * limit >= 3", ["load / 2"], ""),
    ],
)
def test_a_sum_has_the_unit_of_its_first_number_without_a_factor(
    text: str, units: list[str], declared: str
) -> None:
    formula = sr.parse_specification(text).specs[0].formula
    assert [str(unit) for unit in units_of(formula)] == units
    assert declared_unit(formula, {"": "m", "load": "kg", "limit": "kg"}) == declared


@pytest.mark.parametrize(
    ("edited", "kind"), [("load - limit <= 9", "constant"), ("limit - load <= 1", "replaced")]
)
def test_an_edited_number_of_a_sum_is_distinguished_from_another_sum(edited: str, kind: str) -> None:
    old, new = (sr.parse_specification(f"G ({text})") for text in ("load - limit <= 1", edited))
    (edit,) = sr.diff_specifications(trace(), old, new).spec("spec").edits
    assert edit.kind == kind


def test_a_constant_that_is_a_factor_too_is_no_advice() -> None:
    (result,) = sr.evaluate(
        sr.parse_specification("const k = 2\nspec s = G (k * load + limit <= k)"), trace()
    ).results
    assert "for `k`" not in result.explain()
