"""Rates of change: speeds, closing speeds, and those of signals."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from math import inf, nan
from pathlib import Path

import numpy as np
import pytest

from spatial_replay import (
    Footprint,
    Recorder,
    Sample,
    Trace,
    TrackedObject,
    evaluate,
    parse_specification,
    read_trace,
)
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
    assert result.nodes[0].text == formula
    np.testing.assert_allclose(result.nodes[0].now, expected)


def test_what_is_uncertain_in_both_samples_adds_up() -> None:
    (result,) = evaluate(parse_specification("X (speed(robot) >= 1.5)"), Trace.from_samples(drive(0.2)[:2]))
    # 2 m/s, give or take 0.4 m in half a second
    assert (result.lower, result.upper) == pytest.approx((-0.3, 1.3))
    assert result.verdict == "unknown"


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        # the battery has no rate in the first sample, and is missing in the last
        ("G[0, 3] (rate(battery) <= 0.25)", -0.25),
        ("F[0, 3] (rate(battery) >= 0.25)", 0.25),
        ("G[0, 0] (rate(battery) >= 9)", inf),
        ("F[0, 0] (rate(battery) <= 9)", -inf),
        ("(rate(battery) <= 0) U[0, 2] (rate(battery) >= 0.5)", 0.0),
        ("(rate(battery) >= 0.5) R[0, 2] (rate(battery) <= 9)", 8.5),
        ("(rate(battery) <= 0) W[0, 2] (rate(battery) >= 0.5)", 0.0),
        ("F[3, 3] (H (rate(battery) <= 1))", 0.5),
        ("F[3, 3] (O (rate(battery) >= 0.25))", 0.25),
        ("F[3, 3] ((rate(battery) >= -1) S (rate(battery) >= 0.5))", 0.0),
        # each sample has the rate of the next one, or of the one before
        ("G[0, 2] (X (rate(battery) <= 1))", 0.5),
        ("G[0, 2] (WX (rate(battery) <= 1))", 0.5),
        ("G[1, 3] (Y (rate(battery) <= 1))", 0.5),
        ("G[0, 3] (rate(battery) <= 1 and battery >= 11)", 0.0),
        ("G[0, 3] (not (rate(battery) >= 1))", 0.5),
        # nothing that ranges over samples is around the comparison
        ("rate(battery) <= 9", nan),
        ("X (rate(battery) <= 9)", 11.0),
        ("G[0, 0] (battery >= 3) and X (rate(battery) <= 3)", 5.0),
        # the battery is missing where the sample is asked for
        ("F[4, 4] (rate(battery) >= 0)", nan),
        ("G[4, 4] (rate(battery) >= 0)", nan),
    ],
)
def test_the_nearest_operator_leaves_out_what_has_no_rate_yet(formula: str, expected: float) -> None:
    (result,) = evaluate(parse_specification(formula), Trace.from_samples(drive()))
    np.testing.assert_equal(result.robustness, expected)


def test_a_deadline_beside_a_rate_has_the_verdict_that_it_has_alone() -> None:
    specification = parse_specification(
        "spec intime = F[0s, 1s] (battery >= 11.5)\n"
        "spec calm = G (speed(cart) <= 1)\n"
        "spec alone = F[0s, 1s] (battery >= 11.5)\n"
        "spec task = intime and calm\n"
    )
    samples = [replace(each, signals={"battery": 11.0 + (n == 2)}) for n, each in enumerate(drive())]
    alone, task = evaluate(specification, Trace.from_samples(samples))
    assert (alone.verdict, alone.robustness) == ("violated", -0.5)
    assert (task.verdict, task.robustness) == ("violated", -0.5)
    assert format_specification(specification).endswith("spec task = intime and calm\n")


def arrivals(order: str) -> list[Sample]:
    """People who walk at 1 m/s; the names of those in each sample."""
    samples = []
    for step, names in enumerate(order.split()):
        people = {
            name: TrackedObject(Footprint.disc(float(step), 9.0 * place, 0.3), class_name="person")
            for place, name in enumerate("abc")
            if name in names
        }
        samples.append(Sample(step * SECOND, people))
    return samples


@pytest.mark.parametrize("order", ["a ab abc abc", "abc bc bc abc", "c . a ab", "a b c a"])
def test_members_that_come_and_go_are_left_out_where_they_are_new(order: str) -> None:
    specification = parse_specification(
        'group people = class "person"\n'
        "spec calm = G (forall p in people: speed(p) <= 3)\n"
        "spec runs = F (exists p in people: speed(p) >= 2)\n"
    )
    samples = arrivals(order)
    moves = any(set(one) & set(other) - {"."} for one, other in pairwise(order.split()))
    calm, runs = evaluate(specification, Trace.from_samples(samples))
    assert (calm.verdict, calm.robustness) == ("satisfied", 2.0 if moves else inf)
    assert (runs.verdict, runs.robustness) == ("violated", -1.0 if moves else -inf)
    assert calm.tested == runs.tested == ("full" if moves else "nothing")


def test_samples_without_rates_test_nothing_and_are_not_what_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with Recorder("run.mcap") as recorder:
        for sample in arrivals("a ab b"):
            recorder.write(sample)
    assert run(["explain", "run.mcap", "--spec", 'G (forall p in class "person": speed(p) <= 0.5)']) == 1
    said = capsys.readouterr().out
    assert "speed(a) <= 0.5" in said
    assert "a moved by 1 from 0.000 s to 1.000 s, at 1 a second." in said
    assert run(["explain", "run.mcap", "--spec", "F[0, 0] (speed(a) <= 5)"]) == 1
    assert "no sample in its window has a rate" in capsys.readouterr().out
    for body in ("speed(a) <= 5", "(speed(a) <= 5) -> (a dist b >= 9)"):
        assert run(["replay", "run.mcap", "--spec", f"G[0, 0] ({body})"]) == 4
    assert "where no sample in its window has a rate" in capsys.readouterr().out
    # the condition is unknown only in the sample that is left out
    assert run(["replay", "run.mcap", "--spec", "G[0, 1] ((speed(a) >= 5) -> (a dist b >= 9))"]) == 4
    assert "`speed(a) >= 5` never held" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("formula", "reasons"),
    [
        ("F[0, 0] (speed(a) <= 5)", ["no rate"]),
        ("(a dist b >= 0) U[0, 0] (speed(a) <= 5)", ["no rate"]),
        ("F[0, 0] (exists p in all: speed(p) <= 5)", ["no rate"]),
        ("not G[0, 0] (speed(a) <= 5)", ["no rate"]),
        ("F[1, 2] (mode == 2 and speed(b) >= 0)", []),
    ],
)
def test_violations_whose_samples_are_all_left_out_are_tested_by_nothing(
    formula: str, reasons: list[str]
) -> None:
    samples = [replace(sample, signals={"mode": 1.0}) for sample in arrivals("ab ab abc")]
    (result,) = evaluate(parse_specification(formula), Trace.from_samples(samples))
    assert result.verdict == "violated"
    assert result.tested == ("nothing" if reasons else "full")
    assert [part.reason for part in result.untested] == reasons


def test_an_empty_window_is_no_window_without_rates() -> None:
    trace = Trace.from_samples(arrivals("a a a"))
    for formula in ("F[5, 6] (speed(a) <= 5)", "G (F[1, 1] (speed(a) <= 5))"):
        (result,) = evaluate(parse_specification(formula), trace)
        assert "no sample lies in its window" in result.explain()


@pytest.mark.parametrize(
    ("formula", "message", "hint"),
    [
        ("speed(a[-1]) <= 1", "a speed is from the report before to this one", "leave out the [-n]"),
        ("speed(class x) <= 1", "a group has no speed of its own", "write forall p in GROUP: speed(p) <= c"),
        (
            "region dock = box(0, 0, 1, 1)\nspec s = G (speed(enlarge(dock, 1)) <= 1)",
            "a region never moves",
            "or speed(a, REGION)",
        ),
        ("speed(2) <= 1", "a number has no speed", "write speed(a) or speed(a, b)"),
        ("speed() <= 1", "'speed' takes one or two objects", "write speed(a) <= c or speed(a, b) <= c"),
        ("rate(a, b) <= 1", "'rate' takes one signal", "write rate(battery) <= c"),
        ("speed(a) <= 3km/h", "'3km' is neither a number", "write 0.8333 if those are metres"),
        ("speed(a) != 1", "a rate is hardly ever exactly a number", "write what is too slow or too fast"),
        ("velocity(a) <= 1", "'velocity' is not a function", "it is written speed(a)"),
        ("derivative(x) <= 1", "'derivative' is not a function", "it is written rate(x)"),
    ],
)
def test_what_is_no_rate_is_refused_with_what_to_write(
    formula: str, message: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["check", formula if "spec" in formula else f"G ({formula})"]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert hint in said


def test_the_papers_semantics_leaves_out_what_has_no_rate_yet() -> None:
    formula = parse_specification("G (speed(cart) <= 1)")
    late = [Sample(0, {}), *(replace(each, time_ns=each.time_ns + 1) for each in drive())]
    for samples in (drive(), late[1:]):
        (result,) = evaluate(formula, Trace.from_samples(samples), semantics="paper")
        assert (result.verdict, result.robustness) == ("satisfied", 1.0)


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
    assert "robot moved by 1 m from 0.000 s to 0.500 s, at 2 m/s" in said
    assert "robot and cart approached by 1 m from 0.000 s to 0.500 s, at 2 m/s" in said
    assert "fails by 1 V/s at 0.500 s" in said
    assert "battery fell by 1 V from 0.000 s to 0.500 s, by 2 V/s" in said
    assert "or more instead of 1.5 in `speed(robot) <= 1.5`" in said
    assert run(["check", "s.spatial", "--log", "run.mcap"]) == 0
    assert "speed(robot) <= 1.5: goes from 0.5 to 2" in capsys.readouterr().out
    assert run(["replay", "run.mcap", "--spec", "s.spatial", "-o", "annotated.mcap"]) == 1
    assert run(["verify", "annotated.mcap"]) == 0
    assert run(["export", "annotated.mcap", "-o", "table.csv"]) == 0
    assert "slow: speed(robot) <= 1.5" in Path("table.csv").read_text()


def slow_reports() -> list[Sample]:
    """A cart at 0.4 m/s, reported every 0.1 s, and a battery every second; samples come every 0.05 s."""
    samples = []
    for step in range(60):
        reported = step // 2 * 2, step // 20 * 20
        cart = Footprint.disc(0.02 * reported[0], 0.0, 0.3)
        times = (int(at * SECOND // 20) for at in reported)
        reported_ns = dict(zip(("cart", "battery"), times, strict=True))
        signals = {"battery": 1.0 - 0.0005 * reported[1]}
        samples.append(Sample(step * SECOND // 20, {"cart": cart}, signals, reported_ns=reported_ns))
    return samples


def test_logs_keep_the_times_of_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with Recorder("run.mcap", units={"": "m", "battery": "1"}) as recorder:
        for sample in slow_reports():
            recorder.write(sample)
    Path("s.spatial").write_text(
        "spec slow = G (speed(cart) <= 0.3)\n"
        "spec steady = G (0.39 <= speed(cart) <= 0.41)\n"
        "spec lasts = G (rate(battery) >= -0.0101)\n"
    )
    assert run(["replay", "run.mcap", "--spec", "s.spatial", "-o", "annotated.mcap"]) == 1
    said = capsys.readouterr().out
    verdicts = dict(re.findall(r"^ +(\w+) +(satisfied|violated) ", said, re.MULTILINE))
    assert verdicts == {"slow": "violated", "steady": "satisfied", "lasts": "satisfied"}
    assert "cart moved by 0.04 m from" in said
    assert run(["verify", "annotated.mcap"]) == 0
    assert run(["clip", "run.mcap", "--spec", "s.spatial", "-o", "clip.mcap", "--around", "0.2s"]) == 0
    capsys.readouterr()
    assert run(["replay", "clip.mcap", "--spec", "s.spatial"]) == 1
    assert "by 0.1 m/s" in capsys.readouterr().out
    assert run(["replay", "run.mcap", "--spec", "s.spatial", "--read", "max_gap=40ms"]) == 4
    assert read_trace("annotated.mcap") == Trace.from_samples(slow_reports())


def test_reports_that_step_back_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    samples = slow_reports()[:30]
    samples[10] = replace(samples[10], reported_ns={**samples[10].reported_ns, "cart": 0})
    with Recorder("run.mcap") as recorder:
        for sample in samples:
            recorder.write(sample)
    Path("s.spatial").write_text("spec steady = G (0 <= speed(cart) <= 0.5)\n")
    assert run(["replay", "run.mcap", "--spec", "s.spatial"]) == 0
    said = capsys.readouterr()
    assert "1 report of cart is earlier than the one before, the first at 0.500 s" in said.out + said.err


def test_what_a_mapping_holds_for_ever_stands_in_closing_speeds() -> None:
    samples = [
        replace(sample, objects={**sample.objects, "map": Footprint.box(9, -1, 10, 1)}, lasting={"map"})
        for sample in slow_reports()
    ]
    samples = [replace(each, reported_ns={**each.reported_ns, "map": 0}) for each in samples]
    (near, still) = evaluate(
        parse_specification(
            "spec near = G (0.39 <= speed(cart, map) <= 0.41)\nspec still = G (speed(map) <= 1)"
        ),
        Trace.from_samples(samples),
    )
    assert near.verdict == "satisfied"
    assert still.tested == "nothing"


def test_a_report_after_a_hole_has_no_rate_until_the_next_one() -> None:
    samples = slow_reports()[:20]
    samples[8] = replace(samples[8], objects={}, reported_ns={})
    (result,) = evaluate(parse_specification("speed(cart) >= 0"), Trace.from_samples(samples))
    has_rate = np.isfinite(result.nodes[0].now)
    np.testing.assert_array_equal(np.flatnonzero(~has_rate), [0, 1, 8, 9])
