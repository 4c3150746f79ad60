"""What a replay found as JSON."""

from __future__ import annotations

import json
from typing import Any

import pytest

from replay.runs import SPECIFICATION, PiecewiseSource, run
from spatial_replay import parse_specification
from spatial_replay.replay.document import document_from_replay
from spatial_replay.replay.engine import run_replay


@pytest.fixture
def found() -> dict[str, Any]:
    spec = parse_specification(SPECIFICATION)
    replayed = run_replay(PiecewiseSource(run(), 5), [spec], keep_series=True)
    loaded: dict[str, Any] = json.loads(json.dumps(document_from_replay(replayed), allow_nan=False))
    return loaded


def test_the_document_says_what_was_evaluated(found: dict[str, Any]) -> None:
    log = found["log"]
    assert (log["name"], log["samples"], log["start_ns"], log["damaged"]) == ("run", 12, 0, False)
    assert found["semantics"] == "ltlf"
    assert set(found["certificate"]) == {
        "samples_sha256",
        "messages_sha256",
        "specification_sha256",
        "results_sha256",
        "spatial_replay_version",
    }


def test_each_result_lists_the_nodes_of_its_tree(found: dict[str, Any]) -> None:
    reach, apart = found["specifications"]
    assert (reach["name"], reach["object"], reach["verdict"]) == ("reach", None, "satisfied")
    assert reach["lower"] <= reach["robustness"] <= reach["upper"]
    assert [(n["id"], n["parent"], n["operator"], n["name"]) for n in reach["nodes"]] == [
        (0, None, "F", "reach"),
        (1, 0, "enclosedin", None),
    ]
    assert apart["verdict"] == "unknown"


def test_undetermined_numbers_are_null_and_infinite_ones_texts(found: dict[str, Any]) -> None:
    _, apart = found["specifications"]
    assert apart["robustness"] is None
    assert apart["lower"] == "-inf"


def test_series_have_one_list_per_node(found: dict[str, Any]) -> None:
    reach, _ = found["specifications"]
    assert len(reach["series"]["time_ns"]) == 12
    for quantity in ("value", "now", "lower", "upper"):
        assert [len(row) for row in reach["series"][quantity]] == [12, 12]
    first = next(i for i, value in enumerate(reach["series"]["value"][0]) if value >= 0)
    assert reach["first_satisfied_ns"] == reach["series"]["time_ns"][first]


def test_there_are_no_series_by_default() -> None:
    replayed = run_replay(PiecewiseSource(run(), 5), [parse_specification(SPECIFICATION)])
    assert all("series" not in each for each in document_from_replay(replayed)["specifications"])


def test_a_goal_that_holds_at_once_is_remarked() -> None:
    spec = parse_specification("spec there = F (cube dist cube <= 1)")
    (result,) = document_from_replay(run_replay(PiecewiseSource(run(), 5), [spec]))["specifications"]
    assert result["remarks"] == ["`there` is already true at the first sample."]
