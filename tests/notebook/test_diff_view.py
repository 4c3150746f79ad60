"""Diffs in notebooks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import spatial_replay as sr

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"


@pytest.mark.usefixtures("figures")
def test_a_diff_is_shown_in_words_and_drawn_with_both_curves():
    trace = sr.read_trace(RECORDINGS / "table.jsonl")
    old, new = (RECORDINGS / name for name in ("table.spatial", "table_edited.spatial"))
    diff = sr.diff_specifications(trace, old, new)
    assert "because: constant deadline" in diff._repr_html_()
    (panel,) = diff.plot()
    before, after = (np.asarray(line.get_ydata()) for line in panel.lines[1:])
    np.testing.assert_array_equal(before, diff.spec("table_set").old.series[0, 0])
    np.testing.assert_array_equal(after, diff.spec("table_set").new.series[0, 0])
    assert [text.get_text() for text in panel.get_legend().get_texts()] == [old.name, new.name]
    assert "F[0s, 4s]" in diff.spec("table_set")._repr_html_()


@pytest.mark.usefixtures("figures")
def test_two_runs_are_drawn_as_they_are_aligned():
    trace = sr.read_trace(RECORDINGS / "table.jsonl")
    part = trace.slice(0, 200)
    diff = sr.diff_logs(trace, part, RECORDINGS / "table.spatial")
    assert len(diff.plot()) == len(diff.specs)
    for panel in diff.plot():
        assert len(panel.lines[1].get_xdata()) == len(diff.alignment.a)
    with pytest.raises(sr.UsageError, match="nothing to draw"):
        sr.diff_logs(trace, trace).plot()
