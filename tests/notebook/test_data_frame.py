"""Results as DataFrames."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import spatial_replay as sr

RECORDINGS = Path(__file__).parent.parent.parent / "recordings"


@pytest.fixture(scope="module")
def trace() -> sr.Trace:
    return sr.read_trace(RECORDINGS / "table.jsonl")


@pytest.fixture(scope="module")
def evaluation(trace: sr.Trace) -> sr.Evaluation:
    return sr.evaluate(sr.load_specification(RECORDINGS / "table_edited.spatial"), trace)


def test_results_are_rows_and_samples_are_rows(evaluation: sr.Evaluation) -> None:
    results = evaluation.to_pandas()
    assert results.set_index("name").verdict.to_dict() == {
        "table_set": "violated", "parallel": "satisfied", "poured": "satisfied"
    }  # fmt: skip
    assert results.violated_at_ns[0] == 4 * 10**9
    assert results.violated_at_ns.isna()[1]
    result = evaluation.results[0]
    samples = result.to_pandas()
    assert samples.index.tolist() == result.times_ns.tolist()
    assert samples["laid value"].to_numpy().tolist() == result.node("laid").value.tolist()
    assert samples.loc[4 * 10**9, "seconds"] == 4.0
    assert len(samples.columns) == 1 + 4 * len(result.nodes)


def test_without_pandas_an_error_says_what_to_install(
    evaluation: sr.Evaluation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    for value in (evaluation, evaluation.results[0]):
        with pytest.raises(sr.UsageError, match=r"spatial-replay\[notebook\]"):
            value.to_pandas()
