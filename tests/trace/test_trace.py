"""Traces refuse columns of inconsistent shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spatial_replay import Footprint, Sample, Trace, TraceError

BOX = Footprint.box(0, 0, 1, 1)


def two_samples():
    return Trace.from_samples([Sample(0, {"a": BOX}, {"force": 1.0}), Sample(5, {"b": BOX})])


def test_missing_objects_are_absent():
    assert two_samples().rows.tolist() == [[0, -1], [-1, 1]]
    assert np.isnan(two_samples().signals["force"][1])


@pytest.mark.parametrize("times", [(0, 0), (5, 4)])
def test_times_must_increase(times):
    with pytest.raises(TraceError, match="give times that increase"):
        Trace.from_samples(Sample(time_ns) for time_ns in times)


@pytest.mark.parametrize(
    "change",
    [
        {"times_ns": np.array([0, 5, 6])},
        {"times_ns": np.array([-1, 5])},
        {"names": ("b", "a")},
        {"names": ("a", "a")},
        {"rows": np.array([[0, -1], [-1, 2]])},
        {"rows": np.array([[0, -1], [-1, -4]])},
        {"yaw": np.zeros(3)},
        {"uncertainty": np.zeros(1)},
        {"class_code": np.zeros(3, int)},
        {"signals": {"force": np.zeros(3)}},
    ],
)
def test_columns_must_fit_together(change):
    with pytest.raises(TraceError):
        replace(two_samples(), **change)


def test_joined_traces_must_follow_each_other():
    with pytest.raises(TraceError, match="increase"):
        Trace.concatenate([two_samples(), two_samples()])


def test_a_trace_describes_itself():
    assert repr(two_samples()) == "<Trace: 2 samples, 0 to 5 ns; objects a, b>"
