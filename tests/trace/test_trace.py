"""Traces refuse columns of inconsistent shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spatial_replay import Footprint, Sample, Trace, TraceError

BOX = Footprint.box(0, 0, 1, 1)


def two_samples():
    return Trace.from_samples([Sample(0, {"a": BOX}, {"force": 1.0}), Sample(5, {"b": BOX})])


def test_times_of_numpy_are_times() -> None:
    sample = Sample(np.int64(7))
    assert (sample, type(sample.time_ns)) == (Sample(7), int)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"signals": {"on": True}}, "signal 'on' is True; give a number, such as 1.0"),
        ({"signals": {"on": np.True_}}, "signal 'on' is .*True.*; give a number"),
        ({"signals": {"mode": "3"}}, "signal 'mode' is '3'; give a number"),
        ({"objects": [BOX]}, "objects is .*; give a dict by name, as in {'cup': Footprint"),
        ({"signals": 0.8}, "signals is 0.8; give a dict by name, as in {'battery': 0.8}"),
        ({"unknown": ["cup"]}, "unknown is .*; give a dict by name, as in {'cup': None}"),
    ],
)
def test_values_of_other_kinds_are_refused(arguments: dict[str, object], said: str) -> None:
    with pytest.raises(TraceError, match=said):
        Sample(0, **arguments)  # type: ignore[arg-type]


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
