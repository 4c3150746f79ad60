"""Searches for failures in a simulation of one's own: what is found, kept, made smaller and repeated."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

import spatial_replay as sr
from falsification.crossings import APART, VARIED, crossing
from pages import shown
from spatial_replay.falsification.failure_search import Falsification

# to import it takes seconds
pytestmark = pytest.mark.skipif(find_spec("cma") is None, reason="the search needs cma")


def search(folder: Path, **options: object) -> Falsification:
    return sr.falsify(crossing, APART, output=folder, vary=VARIED, **{"budget": 30, **options})


def content(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a search of 30 runs."""
    folder = tmp_path_factory.mktemp("searched") / "found"
    search(folder)
    return folder


def test_failures_are_logs_that_violate_with_the_worst_first(folder: Path) -> None:
    found = search(folder)
    assert found.verdict == "violated"
    assert len(found.failures) >= 2
    robustness = [failure.run.robustness for failure in found.failures]
    assert robustness == sorted(robustness)
    assert {failure.run.number for failure in found.failures} == {
        run.number for run in found.runs if run.robustness < 0
    }
    for failure in found.failures:
        for log, run in ((failure.log, failure.run), (failure.smaller_log, failure.smaller)):
            (result,) = sr.replay_log(log).results
            assert (result.verdict, result.robustness) == ("violated", run.robustness)


def test_a_notebook_shows_failures_and_what_was_covered(folder: Path, tmp_path: Path) -> None:
    found = search(folder)
    text = shown(found)
    assert f"30 runs of {found.name}: {len(found.failures)} violated" in text
    assert found.text_of(found.failures[0].smaller.case) in text
    assert all(each.parameter in text for each in found.coverage)
    calm = sr.parse_specification("spec calm = G (robot dist person >= -10)")
    kept = sr.falsify(crossing, calm, output=tmp_path / "kept", vary=VARIED, budget=2)
    assert f"the lowest: run {kept.lowest.number}, " in shown(kept)


def test_a_run_is_that_of_its_case(folder: Path) -> None:
    for run in search(folder).runs[:5]:
        (result,) = sr.evaluate(APART, sr.Trace.from_samples(crossing(run.case)))
        assert result.robustness == run.robustness


def test_nothing_can_be_left_out_of_a_smaller_failure(folder: Path) -> None:
    found = search(folder)
    assert any(failure.is_smaller for failure in found.failures)
    rest = found.first.case
    for failure in found.failures:
        smaller = failure.smaller.case
        for name, value in smaller.items():
            if value != rest[name]:
                less = crossing({**smaller, name: rest[name]})
                assert sr.evaluate(APART, sr.Trace.from_samples(less)).verdict == "satisfied"


def test_a_clip_shows_the_violation_in_fewer_samples(folder: Path) -> None:
    for failure in search(folder).failures:
        (result,) = sr.replay_log(failure.clip).results
        assert (result.verdict, result.robustness) == ("violated", failure.smaller.robustness)
        assert len(sr.read_trace(failure.clip)) < len(sr.read_trace(failure.smaller_log))


def test_equal_searches_write_equal_bytes_with_any_number_of_processes(folder: Path, tmp_path: Path) -> None:
    search(tmp_path / "two", jobs=2)
    assert content(tmp_path / "two") == content(folder)


@pytest.mark.parametrize("runs", [0, 17])
def test_a_search_that_was_killed_goes_on_where_it_was(folder: Path, tmp_path: Path, runs: int) -> None:
    killed, simulated = tmp_path / "found", []
    killed.mkdir()
    (killed / "search.json").write_bytes((folder / "search.json").read_bytes())
    lines = (folder / "runs.jsonl").read_bytes().splitlines(keepends=True)
    # the line that was being written, and the log, are not whole
    (killed / "runs.jsonl").write_bytes(b"".join(lines[:runs]) + lines[runs][:-7])
    (killed / "runs").mkdir()
    (killed / "runs" / ".run-0018.mcap.partial").write_bytes(b"half")

    def counted(case: dict[str, float]) -> Iterator[sr.Sample]:
        simulated.append(case)
        return crossing(case)

    counted.__name__ = crossing.__name__
    sr.falsify(counted, APART, output=killed, vary=VARIED, budget=30)
    assert content(killed) == content(folder)
    assert simulated[0] == json.loads(lines[runs])["case"]


def test_a_larger_budget_adds_runs_to_those_that_there_are(folder: Path, tmp_path: Path) -> None:
    search(tmp_path / "found", budget=15)
    search(tmp_path / "found")
    grown = content(tmp_path / "found")
    assert grown["runs.jsonl"] == content(folder)["runs.jsonl"]
    assert grown["failures.json"] == content(folder)["failures.json"]


def test_other_seeds_search_elsewhere(folder: Path, tmp_path: Path) -> None:
    other = search(tmp_path / "other", seed=1, budget=10)
    assert other.runs[0].case == search(folder).runs[0].case
    assert not {tuple(run.case.values()) for run in other.runs[1:]} & {
        tuple(run.case.values()) for run in search(folder).runs[1:]
    }


def test_where_nothing_is_found_what_was_covered_is_said(tmp_path: Path) -> None:
    calm = sr.parse_specification("spec calm = G (robot dist person >= -10)")
    found = sr.falsify(crossing, calm, output=tmp_path / "found", vary=VARIED, budget=25)
    assert (found.verdict, found.failures) == ("satisfied", ())
    assert found.lowest.robustness == min(run.robustness for run in found.runs) > 9
    assert [(each.parameter, each.low, each.high) for each in found.coverage] == [
        (name, *span) for name, span in VARIED.items()
    ]
    for each in found.coverage:
        # the first run varies nothing; a look around tries every tenth
        assert sum(each.runs) == 24
        assert min(each.runs) >= 1
        assert min(least for least in each.least_robustness if least is not None) >= found.lowest.robustness
    assert json.loads((tmp_path / "found" / "failures.json").read_text())["runs"] == 25


def test_what_fails_without_variation_ends_the_search_with_its_first_run(tmp_path: Path) -> None:
    never = sr.parse_specification("spec never = G (robot dist person >= 10)")
    found = sr.falsify(crossing, never, output=tmp_path / "found", vary=VARIED)
    assert len(found.runs) == 1
    (failure,) = found.failures
    assert not failure.is_smaller
    assert failure.log.exists()
    assert failure.clip.exists()


def test_a_search_with_nothing_else_to_try_ends(tmp_path: Path) -> None:
    calm = sr.parse_specification("spec calm = G (robot dist person >= -10)")
    found = sr.falsify(
        lambda case: crossing({**case, "start": 0.0, "side": 0.0}),
        calm,
        output=tmp_path / "found",
        vary={"speed": (1.0, math.nextafter(1.0, 2.0))},
    )
    assert found.is_exhausted
    assert len(found.runs) <= 3


def test_the_example_of_the_page_prints_what_the_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "simulation.md").read_text("utf-8")
    example, shown = re.findall(r"^```python\n([^`]*)```\n\n```text\n(.*?)^```", page, re.M | re.S)[0]
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "docs/simulation.md", "exec"), {})  # noqa: S102
    assert capsys.readouterr().out == shown


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"budget": 0}, "the budget is 0 runs; give 1 to 1,000,000"),
        ({"seed": -1}, "the seed is -1; give 0 or more"),
        ({"vary": {}}, "nothing is varied; name at least one parameter"),
        ({"vary": {"speed": (2.0, 1.0)}}, "speed: 2 to 1 is not a range; write the lower end first"),
        ({"vary": {"speed": (0.0, math.inf)}}, "speed: inf is not an end of a range"),
        ({"vary": ["speed"]}, "'speed' is incomplete; write NAME=LOW:HIGH"),
        ({"vary": ["speed=a:2"]}, "speed: 'a' is not a number"),
        ({"specifications": ()}, "has no specification yet; give what has to hold"),
        ({"planned": True}, "planned is for scenarios"),
        ({"simulation": lambda case: []}, "returns nothing; a simulation returns one Sample or more"),
        ({"simulation": lambda case: crossing(case), "jobs": 2}, "cannot be sent to other processes"),
        ({"simulation": "pusch"}, "there is no scenario 'pusch'; there are push"),
    ],
)
def test_what_cannot_be_searched_is_refused(tmp_path: Path, options: dict[str, object], message: str) -> None:
    given = {"simulation": crossing, "specifications": APART, "vary": VARIED, **options}
    if isinstance(given["simulation"], str):
        given["vary"] = ()
    with pytest.raises(sr.UsageError) as refused:
        sr.falsify(**given, output=tmp_path / "found")
    assert message in str(refused.value)


def test_a_folder_of_something_else_is_left_as_it_is(folder: Path, tmp_path: Path) -> None:
    before = content(folder)
    other = sr.parse_specification("spec apart = G (robot dist person >= 0.4)")
    for options, message in [
        ({"seed": 3}, "holds another search: its seed is 0; give another folder"),
        ({"vary": {"speed": (1.0, 2.0)}}, "it varies speed from 0.6 to 1.4, .* and this one speed from 1.0"),
        ({"specifications": other}, "it has other specifications"),
    ]:
        given = {"specifications": APART, "vary": VARIED, **options}
        with pytest.raises(sr.UsageError, match=message):
            sr.falsify(crossing, output=folder, **given)
    assert content(folder) == before
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(sr.UsageError, match="holds files, but no search; give an empty folder"):
        search(tmp_path)
    assert content(tmp_path) == {"notes.txt": b"mine"}


def test_a_damaged_line_is_named(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "search.json").write_bytes((folder / "search.json").read_bytes())
    (tmp_path / "runs.jsonl").write_text('{"run": 1}\n')
    with pytest.raises(sr.LogError, match=r"runs\.jsonl:1: this line is not a run .* delete the file"):
        search(tmp_path)
