"""Constants found for runs, as users see them: values, refusals, conflicts, pictures, the file written."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

import spatial_replay as sr
from replay.runs import write_tracks
from spatial_replay import UsageError
from spatial_replay.cli import run
from tuning.tuned_runs import run_at

TEXT = """\
# how near they come
const near = 2 in [0, 10]     # metres
const hold =  1000ms          # and when
const twice = near * 2

spec close = F[0s, hold] cube dist cup <= near    # within hold
"""
GOOD = ([6, 4, 1, 1], [6, 3, 0.5, 0.5])
BAD = ([9, 6, 5, 1], [9, 8, 7, 0])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A specification, and folders of good and of bad runs."""
    (tmp_path / "s.spatial").write_text(TEXT)
    for kind, runs in (("good", GOOD), ("bad", BAD)):
        (tmp_path / kind).mkdir()
        for number, distances in enumerate(runs):
            write_tracks(run_at(distances), tmp_path / kind / f"{number}.jsonl")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def tune(*options: str) -> int:
    return run(["tune", "--spec", "s.spatial", *options])


LOGS = ("--good", "good/0.jsonl", "good/1.jsonl", "--bad", "bad/0.jsonl", "bad/1.jsonl")


def test_the_value_is_in_the_middle_between_good_and_bad_runs(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune(*LOGS) == 0
    said = capsys.readouterr().out
    assert "widest margin for 2 good runs and 2 bad runs: 2" in said
    assert "near  3  (2 as written)  every value from 1 to 4.99999 fits" in said
    assert (folder / "s.spatial").read_text() == TEXT


def test_a_margin_of_nothing_has_no_sign(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_tracks(run_at([6, 5, 4, 4]), folder / "good/edge.jsonl")
    edge = ("--good", "good/edge.jsonl", "good/0.jsonl", "--bad", "bad/0.jsonl", "--vary", "near=2:4")
    assert tune(*edge) == 0
    said = capsys.readouterr().out
    assert "margin for 2 good runs and 1 bad run: 0\n" in said
    assert "robustness -0\n" not in said


def test_write_changes_the_numbers_and_nothing_else(folder: Path) -> None:
    assert tune(*LOGS[:3], "--vary", "near", "--vary", "hold=500ms:1500ms", "--write") == 0
    written = (folder / "s.spatial").read_text()
    # both are tightened together, so that the nearest sample still counts
    assert written == TEXT.replace("= 2 in", "= 4 in").replace("  1000ms", "  0.5s")
    assert all(
        sr.evaluate(sr.parse_specification(written), run_at(each)).verdict == "satisfied" for each in GOOD
    )
    assert tune(*LOGS[:3], "--vary", "near", "--vary", "hold=500ms:1500ms", "--write") == 0
    assert (folder / "s.spatial").read_text() == written


def test_a_constant_that_no_bad_run_decides_stays_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = "const safe = 0.5 in [0.1, 1]\nconst full = 3 in [1, 9]\nspec s = {}"
    both = "G (cube dist cup >= safe) and G (battery >= full)"
    Path("s.spatial").write_text(text.format(both))
    # the bad run is as far away as the good ones: it fails by its battery
    for name, battery in (("good", 8.0), ("bad", 2.0)):
        with sr.Recorder(f"{name}.mcap") as recorder:
            for sample in run_at([2.0, 3.0], battery=battery).samples():
                recorder.write(sample)
    runs = ("--good", "good.mcap", "--bad", "bad.mcap")
    assert tune(*runs, "--write") == 0
    said = capsys.readouterr().out
    assert "no run decides safe: no bad run fails by it" in said
    assert Path("s.spatial").read_text() == text.format(both).replace("= 3", "= 5")
    # where the good run does not satisfy the written value, it is loosened no further than that takes
    Path("s.spatial").write_text(text.format(both).replace("0.5 in [0.1, 1]", "2.5 in [0.1, 3]"))
    assert tune(*runs, "--write") == 0
    assert "const safe = 2 in [0.1, 3]" in Path("s.spatial").read_text()


def test_runs_that_contradict_each_other_are_named_with_what_they_need(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (folder / "s.spatial").read_bytes()
    assert tune("--good", "bad/0.jsonl", "--bad", "good/1.jsonl", "bad/1.jsonl", "--write") == 1
    said = capsys.readouterr().out
    assert "no values of near exist that fit 1 good run and 2 bad runs" in said
    assert "bad/0.jsonl is satisfied only with near >= 5" in said or "0.jsonl is satisfied only" in said
    assert "is violated only with near <= 0.49999" in said
    assert (folder / "s.spatial").read_bytes() == before


def test_json_has_values_margins_and_conflicts(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tune(*LOGS, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["found"] and document["conflict"] is None
    assert document["constants"][0]["value"] == 3.0
    assert [each["verdict"] for each in document["runs"]] == ["satisfied"] * 2 + ["violated"] * 2
    assert tune("--good", "good/0.jsonl", "--vary", "near=0:0.5", "--json") == 1
    document = json.loads(capsys.readouterr().out)
    assert document["conflict"] == {
        "runs": ["0.jsonl"],
        "message": "0.jsonl is not satisfied with any near from 0 to 0.5",
        "proven": True,
        "alone": ["0.jsonl"],
    }


def test_runs_that_fit_no_value_are_named_apart_from_those_that_contradict_each_other(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tracks(run_at([6, 3, 0.4]), folder / "bad" / "near.jsonl")
    assert tune(*LOGS[:3], "--bad", "bad/near.jsonl", "--vary", "near=0:0.9") == 1
    assert capsys.readouterr().out.splitlines() == [
        "no values of near exist that fit 2 good runs and 1 bad run; this one fits none by itself:",
        "  0.jsonl is not satisfied with any near from 0 to 0.9",
        "and these contradict each other:",
        "  near.jsonl is violated only with near <= 0.3999999",
        "  1.jsonl is satisfied only with near >= 0.5",
    ]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--bad", "bad/0.jsonl"), "there is no good run"),
        (("--good", "good/0.jsonl", "--vary", "naer=1:2"), "did you mean 'near'?"),
        (("--good", "good/0.jsonl", "--vary", "near=3:2"), "the range [3, 2] is empty"),
        (
            ("--good", "good/0.jsonl", "--vary", "near=3:20"),
            "[3, 20] is outside of [0, 10], the range in the",
        ),
        (("--good", "good/0.jsonl", "--vary", "near=1s:2s"), "it is a number (2 as written)"),
        (("--good", "good/0.jsonl", "--vary", "near=1"), "write NAME=LOW:HIGH"),
        (("--good", "good/0.jsonl", "--vary", "hold"), "hold has no range in the text"),
        (("--good", "good/0.jsonl", "--vary", "twice=1:2"), "twice is computed from other constants"),
        (("--good", "good/0.jsonl", "--vary", "hold=-1s:2s"), "hold=-1s, the least value to try, makes the"),
        (("--good", "good/0.jsonl", "--bad", "good/0.jsonl"), "0.jsonl cannot be good and bad at once"),
        (("--good", "none.jsonl"), "none.jsonl: no such file"),
        (("--good", "good/0.jsonl", "-o", "s.gif"), "the picture is .png, .svg, .html"),
    ],
)
def test_what_cannot_be_tuned_is_refused_with_the_remedy(
    folder: Path, options: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tune(*options) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "vary", "said"),
    [
        (
            "const near = 1\nconst free = 2\nspec s = F cube dist cup <= near",
            {"free": (0, 4)},
            "depends on free",
        ),
        ("const near = 1\nspec s = F mug dist cup <= near", {"near": (0, 4)}, "good run 1 does not fit"),
        ("const near = 1\nspec s = F cube dist cup == near", {"near": (0, 4)}, "none is the tightest"),
        ("const near = 1\nspec s = F cube dist cup <= near", None, "no constant of <text> has a range"),
        ("spec s = F cube dist cup <= 1", None, "<text> has no constant to tune"),
    ],
)
def test_specifications_and_runs_that_do_not_fit_are_refused(
    text: str, vary: Mapping[str, tuple[float, float]] | None, said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        sr.tune(sr.parse_specification(text), run_at([3, 2, 1]), vary=vary)


def test_several_constants_are_searched_together_and_drawn(folder: Path) -> None:
    vary = {"near": None, "hold": ("0s", "1500ms")}
    tuning = sr.tune("s.spatial", ["good/0.jsonl", "good/1.jsonl"], ["bad/0.jsonl"], vary=vary)
    assert tuning.is_found and tuning.margin == 2.0
    surface = tuning.surface("hold", "near", points=4)
    assert surface.margins.shape == (3, 4, 4)
    for row, near in enumerate(surface.y):
        for column, hold in enumerate(surface.x):
            values = {"near": float(near), "hold": f"{hold:g}s"}
            file = sr.load_specification("s.spatial", constants=values)
            margins = [
                sign * sr.evaluate(file, run_at(each)).results[0].robustness
                for sign, each in ((1, GOOD[0]), (1, GOOD[1]), (-1, BAD[0]))
            ]
            assert surface.margins[:, row, column] == pytest.approx(margins)
    axes = surface.plot()
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("hold (s)", "near")
    assert "close" not in tuning._repr_html_() and "near" in tuning._repr_html_()


@pytest.mark.parametrize("ending", [".png", ".html"])
def test_equal_runs_give_equal_pictures(folder: Path, ending: str) -> None:
    for name in ("one", "two"):
        assert tune(*LOGS, "-o", name + ending) == 0
    one, two = ((folder / (name + ending)).read_bytes() for name in ("one", "two"))
    assert one == two
    assert one.startswith(b"\x89PNG" if ending == ".png" else b"<!DOCTYPE html>")


def test_a_template_is_tuned_over_the_objects_of_each_run() -> None:
    text = "const near = 1 in [0, 9]\nspec s(ego) = G (ego dist cup <= near)"
    tuning = sr.tune(sr.parse_specification(text), run_at([3, 2]), run_at([6, 2]), each={"ego": "all"})
    assert tuning.values == {"near": 4.5}


def test_a_small_corner_that_fits_is_found_and_its_absence_is_proven() -> None:
    text = (
        "const a = 1 in [0, 10]\nconst b = 1 in [0, 10]\nconst soon = 0.5s in [0s, 3s]\n"
        "spec s = F[0s, soon] (cube dist cup <= a)\nspec t = G (speed <= b)\n"
    )
    good = [run_at([9, 5.013, 8, 8], speed=4), run_at([5.02, 9, 9, 9], speed=3)]
    bad = [run_at([9, 5.03, 8, 8], speed=3), run_at([9, 8, 1, 8], speed=2), run_at([1, 9], speed=4.01)]
    tuning = sr.tune(sr.parse_specification(text), good, bad)
    assert tuning.is_found and tuning.margin == pytest.approx(0.005, abs=1e-5)
    assert tuning.values["a"] == pytest.approx(5.025, abs=1e-3)
    assert tuning.values["b"] == pytest.approx(4.005, abs=1e-3)
    refused = sr.tune(sr.parse_specification(text), good, [*bad, run_at([9, 5.012, 8, 8], speed=1)])
    assert refused.conflict is not None and refused.conflict.is_proven
    assert set(refused.conflict.runs) == {"good run 1", "bad run 4"}


def test_a_margin_that_may_not_be_the_widest_is_said_to(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "s.spatial").write_text(
        "const near = 2 in [0, 10]\nconst twice = near * 2\n"
        "spec amid = G (cube dist cup >= near) and G (cube dist cup <= twice)\n"
    )
    for name, distances in (("in", [6, 5, 6]), ("out", [9, 3, 6])):
        write_tracks(run_at(distances), folder / f"{name}.jsonl")
    assert tune("--good", "in.jsonl", "--bad", "out.jsonl") == 0
    assert "as far as was searched" in capsys.readouterr().out
    tuning = sr.tune("s.spatial", "in.jsonl", "out.jsonl")
    assert not tuning.is_widest
    assert repr(tuning) == f"<Tuning of 2 runs: near = {tuning.values['near']}; margin {tuning.margin:.6g}>"
