"""Units of the numbers that meet in a minimum, and `scale`, which makes them comparable."""

from __future__ import annotations

import pytest

import spatial_replay as sr
from spatial_replay.spec import format_specification
from spatial_replay.spec.walks import is_mixed, units_of

SPEC = "region plate = box(0, 0, 1, 1)\nspec s = G ((force <= 15) and (cup dist plate <= 0.2))\n"


def samples() -> list[sr.Sample]:
    """A cup that moves away from the plate by 0.01 each second, from 0.05, while the force rises from 9."""
    return [
        sr.Sample(
            time_ns=second * 10**9,
            objects={"cup": sr.Footprint.box(1.05 + 0.01 * second, 0, 2, 1)},
            signals={"force": 9.0 + second},
        )
        for second in range(3)
    ]


@pytest.mark.parametrize(
    ("scales", "units", "mixed", "robustness"),
    [
        ("", ["force", "lengths"], True, 0.13),
        ("scale force = 15\n", ["force / 15", "lengths"], True, 0.13),
        ("scale force = 15\nscale lengths = 0.1\n", ["force / 15", "lengths / 0.1"], False, 4 / 15),
        (
            "const most = 30\nscale force = most / 2\nscale lengths = 10\n",
            ["force / 15", "lengths / 10"],
            False,
            0.013,
        ),
    ],
)
def test_a_scale_divides_the_numbers_of_a_signal_or_of_lengths(
    scales: str, units: list[str], mixed: bool, robustness: float
) -> None:
    specification = sr.parse_specification(scales + SPEC)
    found = units_of(specification.specs[0].formula)
    assert [str(unit) for unit in found] == units
    assert is_mixed(found) is mixed
    result = sr.evaluate(specification, sr.Trace.from_samples(samples()))
    assert result.results[0].robustness == pytest.approx(robustness)
    monitor = sr.Monitor(specification)
    updates = [monitor.update(sample) for sample in samples()]
    assert updates[-1].node("s").upper == pytest.approx(robustness)


def test_a_scale_moves_no_threshold() -> None:
    trace = sr.Trace.from_samples(samples())
    plain, scaled = (
        sr.evaluate(sr.parse_specification(scale + "spec s = G (force <= 10.5)"), trace).results[0]
        for scale in ("", "scale force = 3\n")
    )
    assert scaled.verdict is plain.verdict is sr.Verdict.VIOLATED
    assert scaled.robustness == pytest.approx(plain.robustness / 3)
    flips = [each.witness().threshold for each in (plain, scaled)]
    assert [each.flips_at for each in flips] == pytest.approx([11.0, 11.0])


def test_a_scale_is_part_of_what_a_specification_means() -> None:
    scaled = sr.parse_specification("scale force = 15\nscale lengths = 0.1\n" + SPEC)
    assert sr.parse_specification(format_specification(scaled)) == scaled
    assert "scale force = 15\nscale lengths = 0.1\n" in format_specification(scaled)
    assert scaled != sr.parse_specification(SPEC)


def test_orientations_and_objects_called_scale_are_not_scaled() -> None:
    text = "scale lengths = 10\nspec s = (a oriented[0.1] b) and (scale ovlp b)"
    units = units_of(sr.parse_specification(text).specs[0].formula)
    assert [str(unit) for unit in units] == ["orientations", "lengths / 10"]


def test_a_scale_that_divides_nothing_is_warned_of() -> None:
    (warning,) = sr.parse_specification("scale fource = 15\nspec s = G (force <= 15)").warnings
    assert "this scale divides nothing" in warning.message
    assert warning.hint == "did you mean 'force'?"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("scale force = 0", "a scale of 0"),
        ("scale force = -15", "a scale of -15"),
        ("scale force = 15s", "a duration, where a plain number is expected"),
        ("scale plate = 15", "'plate' is a region"),
        ("scale force = 15\nscale force = 16", "'force' is scaled twice"),
    ],
)
def test_a_scale_is_a_positive_number_for_one_signal(line: str, message: str) -> None:
    with pytest.raises(sr.SpecificationError) as caught:
        sr.parse_specification(f"{line}\n{SPEC}")
    assert message in str(caught.value)
