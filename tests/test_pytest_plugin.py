"""Suites as tests of pytest, and assertions about logs in tests of one's own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import spatial_replay as sr
from spatial_replay import UsageError, pytest_plugin
from spatial_replay.cli import run
from spatial_replay.testing import assert_satisfied

pytest_plugins = ["pytester"]

RECORDINGS = Path(__file__).parent.parent / "recordings"
SUITE = """\
cases:
  - name: table
    logs: table.jsonl
    specs: table.spatial
    requirements: [REQ-7]
  - name: edited
    logs: table.jsonl
    specs: table_edited.spatial
"""


@pytest.fixture
def options(request: pytest.FixtureRequest, pytester: pytest.Pytester) -> list[str]:
    """Options with which pytest loads the plugin, as it does by itself where the package is installed."""
    for name in ("table.jsonl", "table.spatial", "table_edited.spatial"):
        shutil.copy(RECORDINGS / name, pytester.path)
    (pytester.path / "table.replay.yaml").write_text(SUITE)
    is_installed = request.config.pluginmanager.is_registered(pytest_plugin)
    return ["-p", "no:cacheprovider", *([] if is_installed else ["-p", "spatial_replay.pytest_plugin"])]


def test_every_log_and_spec_is_a_test_whose_failure_is_what_explain_says(
    pytester: pytest.Pytester, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    result = pytester.runpytest_inprocess(*options, "-v", "--junitxml=out.xml")
    outcomes = result.parseoutcomes()
    assert outcomes["passed"] + outcomes["failed"] == 6 and outcomes["failed"] >= 1
    result.stdout.fnmatch_lines(["table.replay.yaml::table?table.jsonl-table_set? PASSED*"])
    capsys.readouterr()
    assert run(["explain", "table.jsonl", "--spec", "table_edited.spatial"]) == 1
    explained = capsys.readouterr().out.splitlines()
    violated = next(i for i, line in enumerate(explained) if "is violated" in line)
    result.stdout.fnmatch_lines(
        [explained[violated].replace("[", "?"), explained[violated + 1].replace("[", "?")]
    )
    assert '<property name="requirement" value="REQ-7"' in (pytester.path / "out.xml").read_text()


def test_a_failure_begins_with_the_requirement_as_explain_does(
    pytester: pytest.Pytester, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    (pytester.path / "calm.spatial").write_text('spec calm "REQ-12: stay apart" = G (cup dist plate >= 100)')
    (pytester.path / "table.replay.yaml").write_text(
        "cases: [{name: calm, logs: table.jsonl, specs: calm.spatial}]"
    )
    result = pytester.runpytest_inprocess(*options)
    capsys.readouterr()
    assert run(["explain", "table.jsonl", "--spec", "calm.spatial"]) == 1
    explained = capsys.readouterr().out.splitlines()[:2]
    assert explained[0] == "REQ-12: stay apart"
    said = "table.jsonl: calm: violated, expected satisfied"
    result.stdout.fnmatch_lines([said, *explained], consecutive=True)
    with pytest.raises(AssertionError) as raised:
        assert_satisfied(pytester.path / "table.jsonl", pytester.path / "calm.spatial")
    assert str(raised.value).splitlines()[:3] == [said, *explained]


def test_one_test_is_chosen_by_its_name(pytester: pytest.Pytester, options: list[str]) -> None:
    result = pytester.runpytest_inprocess(*options, "table.replay.yaml::table[table.jsonl-poured]")
    result.assert_outcomes(passed=1)


def test_faults_of_a_suite_and_of_its_logs_are_shown_without_a_traceback(
    pytester: pytest.Pytester, options: list[str]
) -> None:
    (pytester.path / "table.replay.yaml").write_text(
        "cases:\n  - {name: a, logs: none.mcap, specs: none.spatial, expect: perhaps}\n"
    )
    (pytester.path / "broken.jsonl").write_text("{")
    (pytester.path / "b.replay.yaml").write_text(
        "cases:\n  - {name: broken, logs: broken.jsonl, specs: table.spatial}\n"
    )
    result = pytester.runpytest_inprocess(*options, "--continue-on-collection-errors")
    result.assert_outcomes(failed=3, errors=1)
    result.stdout.fnmatch_lines(["*table.replay.yaml:2:*perhaps*", "*broken.jsonl*holds no sample*"])
    result.stdout.no_fnmatch_line("*Traceback*")
    result.stdout.no_fnmatch_line("*rows.py:*")


def test_several_processes_and_workers_of_xdist_give_the_same_outcomes(
    pytester: pytest.Pytester, options: list[str]
) -> None:
    alone = pytester.runpytest_inprocess(*options).parseoutcomes()
    environment = os.environ | {"SPATIAL_REPLAY_KERNELS": "interpreted"}
    for more in (["--replay-jobs=2"], ["-n", "2", "--dist", "loadgroup"]):
        command = [sys.executable, "-m", "pytest", "-q", "--assert=plain", *options, *more]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        assert f"{alone['failed']} failed, {alone['passed']} passed" in done.stdout


def test_a_run_without_suites_loads_nothing_of_the_package(pytester: pytest.Pytester) -> None:
    program = (
        "import sys; from spatial_replay import pytest_plugin\n"
        "loaded = {name for name in sys.modules if name.startswith('spatial_replay')}\n"
        "print(sorted(loaded), 'numpy' in sys.modules, 'yaml' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    wanted = [
        "spatial_replay",
        "spatial_replay.errors",
        "spatial_replay.lazy",
        "spatial_replay.pytest_plugin",
        "spatial_replay.version",
    ]
    assert done.stdout.split("]")[0] + "]" == str(wanted)
    assert done.stdout.endswith("False False\n")


def test_an_assertion_about_a_log_fails_with_what_explain_says() -> None:
    log, spec = RECORDINGS / "table.jsonl", RECORDINGS / "table.spatial"
    replayed = assert_satisfied(log, spec, at_least=0.02)
    assert replayed.samples == 300
    with pytest.raises(AssertionError) as raised:
        assert_satisfied(log, spec, at_least=0.03)
    said = str(raised.value).splitlines()
    assert said[0] == "table.jsonl: table_set: robustness 0.0248667, expected at least 0.03"
    assert said[1:] == [str(each) for each in replayed.results[0].sentences(replayed.first_ns)]
    trace = sr.read_trace(log)
    with pytest.raises(AssertionError, match=r"violated, expected satisfied\n.*is violated: robustness"):
        assert_satisfied(trace, sr.parse_specification("G (cup dist plate >= 100)"))
    with pytest.raises(UsageError):
        assert_satisfied("none.mcap", spec)


def test_a_doubtful_result_fails_with_the_contradiction_unless_the_suite_allows_it(
    pytester: pytest.Pytester, options: list[str]
) -> None:
    box = [[0, 0], [1, 0], [1, 1], [0, 1]]
    objects = [{"name": "cart", "polygon": box, "yaw": 90.0}]
    lines = (json.dumps({"time_ns": number * 10**9, "objects": objects}) for number in range(3))
    (pytester.path / "degrees.jsonl").write_text("\n".join(lines))
    (pytester.path / "stays.spatial").write_text(
        "region yard = box(-1, -1, 9, 9)\nspec stays = G (cart enclosedin yard)"
    )
    case = "{name: turned, logs: degrees.jsonl, specs: stays.spatial}"
    suite = pytester.path / "table.replay.yaml"
    for allow, outcome in (("", {"failed": 1}), ("allow: doubtful\n", {"passed": 1})):
        suite.write_text(f"{allow}cases: [{case}]")
        result = pytester.runpytest_inprocess(*options)
        result.assert_outcomes(**outcome)
        if "failed" in outcome:
            result.stdout.fnmatch_lines(["degrees.jsonl: *: doubtful: its angles reach 90*"])
