"""Rates of change: speeds, closing speeds, and those of signals."""

from __future__ import annotations

from math import inf, nan
from pathlib import Path

import numpy as np
import pytest

from spatial_replay import Footprint, Recorder, Sample, Trace, TrackedObject, evaluate, parse_specification
from spatial_replay.cli import run
from spatial_replay.spec.format import format_specification

SECOND = 10**9
TIMES_S = (0.0, 0.5, 1.5, 2.0, 2.25)
ROBOT_X = (0.0, 1.0, 1.5, None, 4.0)
BATTERY = (12.0, 11.0, 11.5, 11.5, nan)


def drive(uncertainty: float = 0.0) -> list[Sample]:
    """A robot nears a cart at x = 10; one sample lacks it, another the battery."""
    cart = TrackedObject(Footprint.disc(10.0, 0.0, 0.5))
    samples = []
    for time_s, x, battery in zip(TIMES_S, ROBOT_X, BATTERY, strict=True):
        robot = TrackedObject(Footprint.disc(x or 0.0, 0.0, 0.5), uncertainty=uncertainty)
        objects = {"cart": cart} if x is None else {"cart": cart, "robot": robot}
        samples.append(Sample(int(time_s * SECOND), objects, {"battery": battery}))
    return samples


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("speed(robot) >= 0", [nan, 2.0, 0.5, nan, nan]),
        ("speed(robot, cart) >= 0", [nan, 2.0, 0.5, nan, nan]),
        ("speed(cart, enlarge(robot, 1)) <= 0", [nan, -2.0, -0.5, nan, nan]),
        ("1 <= speed(robot) <= 3", [nan, 1.0, -0.5, nan, nan]),
        ("speed(cart) >= 0", [nan, 0.0, 0.0, 0.0, 0.0]),
        ("rate(battery) >= 0", [nan, -2.0, 0.5, 0.0, nan]),
    ],
)
def test_a_rate_compares_neighbouring_samples_by_their_times(formula: str, expected: list[float]) -> None:
    (result,) = evaluate(parse_specification(formula), Trace.from_samples(drive()))
    assert result.nodes[1].text == formula
    np.testing.assert_allclose(result.nodes[1].now, expected)


def test_what_is_uncertain_in_both_samples_adds_up() -> None:
    (result,) = evaluate(parse_specification("speed(robot) >= 1.5"), Trace.from_samples(drive(0.2)[:2]))
    # 2 m/s, give or take 0.4 m in half a second
    assert (result.lower, result.upper) == pytest.approx((-0.3, 1.3))
    assert result.verdict == "unknown"


def test_a_result_with_a_rate_begins_at_the_second_sample() -> None:
    specification = parse_specification("spec slow = G (speed(cart) <= 1)\nspec a = X (rate(battery) <= 1)")
    written = format_specification(specification)
    assert "spec slow = WX (G (speed(cart) <= 1))\n" in written
    assert "spec a = X (rate(battery) <= 1)\n" in written
    assert parse_specification(written) == specification
    slow, _ = evaluate(specification, Trace.from_samples(drive()))
    assert (slow.verdict, slow.robustness) == ("satisfied", 1.0)
    slow, _ = evaluate(specification, Trace.from_samples(drive()[:1]))
    assert (slow.verdict, slow.robustness) == ("satisfied", inf)


@pytest.mark.parametrize(
    ("formula", "message", "hint"),
    [
        ("speed(a[-1]) <= 1", "a speed is from the sample before to this one", "leave out the [-n]"),
        ("speed(class x) <= 1", "a group has no speed of its own", "write forall p in GROUP: speed(p) <= c"),
        ("speed(2) <= 1", "a number has no speed", "write speed(a) or speed(a, b)"),
        ("speed() <= 1", "'speed' takes one or two objects", "write speed(a) <= c or speed(a, b) <= c"),
        ("rate(a, b) <= 1", "'rate' takes one signal", "write rate(battery) <= c"),
        ("speed(a) <= 3km/h", "'3km' is neither a number", "write 0.8333 if those are metres"),
        ("speed(a) != 1", "a rate is hardly ever exactly a number", "write what is too slow or too fast"),
        ("velocity(a) <= 1", "'velocity' is not a function", "it is written speed(a) <= 1"),
        ("derivative(x) <= 1", "'derivative' is not a function", "it is written rate(x) <= 1"),
    ],
)
def test_what_is_no_rate_is_refused_with_what_to_write(
    formula: str, message: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["check", f"G ({formula})"]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert hint in said


def test_the_papers_semantics_says_how_a_rate_is_written_for_it(capsys: pytest.CaptureFixture[str]) -> None:
    log = str(Path(__file__).resolve().parents[2] / "recordings/table.jsonl")
    paper = ("--semantics", "paper")
    assert run(["replay", log, "--spec", "G (speed(cup) <= 9)", *paper]) == 2
    assert "read from the second sample on: write X in front, or" in capsys.readouterr().err
    assert run(["replay", log, "--spec", "X G (speed(cup) <= 9)", *paper]) == 0


def test_speed_and_rate_stay_names_without_a_bracket_and_of_macros() -> None:
    for text, written in (
        ("const rate = 3\nspec s = G (speed <= rate)", "G (speed <= 3)"),
        ("def speed(x) = x ovlp b\nspec s = G speed(a)", "G (a ovlp b)"),
    ):
        assert written in format_specification(parse_specification(text))


def test_commands_say_rates_in_the_unit_of_the_log_per_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with Recorder("run.mcap", units={"": "m", "battery": "V"}) as recorder:
        for sample in drive()[:3]:
            recorder.write(sample)
    Path("s.spatial").write_text(
        "spec slow = G (speed(robot) <= 1.5)\n"
        "spec nearing = G (speed(robot, cart) <= 1.5)\n"
        "spec lasts = G (rate(battery) >= -1)\n"
    )
    assert run(["explain", "run.mcap", "--spec", "s.spatial"]) == 1
    said = capsys.readouterr().out
    assert "robustness -0.5 m/s" in said
    assert "robot moves at 2 m/s" in said
    assert "robot and cart approach at 2 m/s" in said
    assert "fails by 1 V/s at 0.500 s" in said
    assert "battery falls by 2 V/s" in said
    assert "or more instead of 1.5 in `speed(robot) <= 1.5`" in said
    assert run(["check", "s.spatial", "--log", "run.mcap"]) == 0
    assert "speed(robot) <= 1.5: goes from 0.5 to 2" in capsys.readouterr().out
    assert run(["replay", "run.mcap", "--spec", "s.spatial", "-o", "annotated.mcap"]) == 1
    assert run(["verify", "annotated.mcap"]) == 0
    assert run(["export", "annotated.mcap", "-o", "table.csv"]) == 0
    assert "slow: speed(robot) <= 1.5" in Path("table.csv").read_text()
