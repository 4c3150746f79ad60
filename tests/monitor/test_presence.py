"""`present(a)`: whether a sample has an object."""

from __future__ import annotations

from math import inf
from pathlib import Path

import numpy as np
import pytest

from spatial_replay import Footprint, Monitor, Recorder, Sample, TrackedObject, evaluate, parse_specification
from spatial_replay.cli import run
from spatial_replay.spec.format import format_formula
from spatial_replay.trace.trace import Trace

SECOND = 10**9


def visits(ann: str, bob: str) -> list[Sample]:
    """People at 1 m/s in samples marked x, and whose place is unknown in those marked ?."""
    samples = []
    for step, marks in enumerate(zip(ann, bob, strict=True)):
        people = {
            name: TrackedObject(Footprint.disc(float(step), y, 0.3), class_name="person")
            for name, y, mark in zip(("ann", "bob"), (0.0, 5.0), marks, strict=True)
            if mark == "x"
        }
        unknown = {name: "person" for name, mark in zip(("ann", "bob"), marks, strict=True) if mark == "?"}
        samples.append(Sample(step * SECOND, people, {"present": 3.0}, unknown))
    return samples


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    with Recorder("run.mcap") as recorder:
        for sample in visits("xx.xx", "..xx."):
            recorder.write(sample)
    return "run.mcap"


def test_presence_is_never_unknown_live_or_in_a_log() -> None:
    samples = visits("x?.x", "....")
    for formula, expected in (
        ("present(ann)", [inf, inf, -inf, inf]),
        ("present(bob)", [-inf] * 4),
        ("not (present(ann) and present(bob))", [inf] * 4),
        ('exists p in class "person": present(p)', [inf, inf, -inf, inf]),
        ("present >= 2", [1.0] * 4),
    ):
        specification = parse_specification(formula)
        (result,) = evaluate(specification, Trace.from_samples(samples))
        np.testing.assert_array_equal(result.nodes[0].now, expected)
        monitor = Monitor(specification)
        live = [monitor.update(sample).specs[0].numbers[0, 1] for sample in samples]
        np.testing.assert_array_equal(live, expected)


@pytest.mark.usefixtures("log")
def test_presence_is_written_as_a_function_of_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    text = "group pair = a, b\ndef seen(x) = present(x)\nspec s = F (forall p in pair: seen(p))"
    (spec,) = parse_specification(text).specs
    assert format_formula(spec.formula) == "F ((present(a)) and (present(b)))"
    own = parse_specification("def present(x) = x ovlp b\nspec s = F present(a)").specs[-1]
    assert format_formula(own.formula) == "F (a ovlp b)"
    for argument in ("2", "a, b", "", "zone", "class person", "a[-1]", "enlarge(a, 1)"):
        text = f"region zone = box(0, 0, 1, 1)\nspec s = F (zone ovlp a and present({argument}))"
        Path("bad.spatial").write_text(text)
        assert run(["check", "bad.spatial"]) == 2
        assert "'present' takes one object of the log" in capsys.readouterr().err


def test_people_who_come_and_go_are_judged_while_they_are_seen(
    log: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("ann", "bob"):
        assert run(["replay", log, "--spec", f"G (present({name}) -> (speed({name}) <= 2))"]) == 0
    Path("calm.spatial").write_text("spec calm(p) = G (present(p) -> (speed(p) <= 2))\n")
    assert run(["replay", log, "--spec", "calm.spatial", "--each", "p=class:person"]) == 0
    capsys.readouterr()
    # an object that is asked for by its presence alone may be in no sample
    assert run(["replay", log, "--spec", "G (not present(eve))"]) == 0
    assert "eve" not in capsys.readouterr().err
    assert run(["explain", log, "--spec", "G present(ann)"]) == 1
    assert "ann is not in the sample" in capsys.readouterr().out


def test_an_explanation_offers_presence_where_the_object_is_all_that_is_missing(
    log: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("calm.spatial").write_text("spec calm(p) = G (speed(p) <= 2)\n")
    assert run(["explain", log, "--spec", "calm.spatial", "--each", "p=class:person"]) == 4
    said = capsys.readouterr().out
    assert "Asked only while ann is in the samples, it is satisfied: write `G (present(p) -> …)`." in said
    assert "while bob" not in said
    assert run(["explain", log, "--spec", "F (speed(ann) >= 2)"]) == 4
    assert "it is violated: write `F (present(ann) and …)`." in capsys.readouterr().out
    # a name that the log never has is misspelt rather than absent
    assert run(["explain", log, "--spec", "G (speed(eve) <= 2)"]) == 4
    assert "Asked only" not in capsys.readouterr().out
    # without a lamp there is nothing that presence could make known
    assert run(["explain", log, "--spec", "G (ann dist bob >= 1 and lamp >= 2)"]) in (2, 4)
    assert "Asked only" not in capsys.readouterr().out


def test_an_explanation_names_the_rate_that_leaves_a_certain_body_open(
    log: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for formula in (
        "G (present(ann) and speed(ann) <= 2)",
        "G (present(ann) and (WX (Y (speed(ann) <= 2))))",
    ):
        assert run(["explain", log, "--spec", formula]) == 4
        said = capsys.readouterr().out
        assert "`speed(ann) <= 2` is unknown at 2.000 s" in said
        assert "ann is not in the sample" in said
        assert "uncertainty" not in said
