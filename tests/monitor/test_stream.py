"""Samples in blocks, as a monitor or a replay of a long log adds them."""

from __future__ import annotations

import numpy as np
import pytest

from monitor.scenes import SECOND, numbers, points
from spatial_replay import Footprint, Sample, Trace, TraceError, parse_specification
from spatial_replay.monitor.atoms.terms import look_back
from spatial_replay.monitor.stream import EvaluationStream, find_instances
from spatial_replay.trace.trace import FOREVER


def stream_of(text, *, start_ns=0, end_ns=FOREVER, traces=(), each=None):
    specification = parse_specification(text)
    instances = find_instances(specification, each or {}, traces, start_ns, end_ns)
    return EvaluationStream(instances, specification.regions)


def test_terms_look_back_across_blocks():
    trace = points(a=[0, 1, 3, 6, 10, 15])
    stream = stream_of("H (a dist a[-2] >= 0 and a dist a[-1.5s] >= 0)")
    now = [stream.extend(trace.slice(t, t + 1))[0].series[0, 1, 0] for t in range(6)]
    assert np.isnan(now).all()
    stream = stream_of("a dist a[-3] >= 0")
    now = [stream.extend(trace.slice(t, t + 1))[0].series[0, 1, 0] for t in range(6)]
    np.testing.assert_array_equal(now, [np.nan, np.nan, np.nan, 6, 9, 12])


def test_terms_look_back_by_time_across_blocks():
    times, places = [0, 1000, 1100, 1900, 2150], [0, 1, 3, 6, 10]
    trace = Trace.from_samples(
        Sample(ms * 10**6, {"a": Footprint.disc(x, 0, 0)}) for ms, x in zip(times, places, strict=True)
    )
    stream = stream_of("a dist a[-1s] >= 0")
    now = [stream.extend(trace.slice(t, t + 1))[0].series[0, 1, 0] for t in range(5)]
    np.testing.assert_array_equal(now, [np.nan, 1, 3, 6, 7])


def test_a_stream_reports_its_numbers_so_far():
    trace = numbers(p=[-1, 2, 1])
    stream = stream_of("F p >= 0")
    going = stream.streams[0]
    assert (len(going), going.verdict, going.first_satisfied_ns) == (0, "unknown", None)
    stream.extend(trace.slice(0, 1))
    assert (len(going), going.verdict, going.robustness.tolist()) == (1, "violated", [-1, -1])
    stream.extend(trace.slice(1, 3))
    assert (len(going), going.verdict, going.first_satisfied_ns) == (3, "satisfied", SECOND)


def test_samples_outside_the_window_are_looked_at_but_not_evaluated():
    trace = points(a=[0, 1, 3, 6])
    stream = stream_of("a dist a[-1] >= 0", start_ns=SECOND, end_ns=3 * SECOND)
    stretches = [stream.extend(trace.slice(t, t + 1))[0] for t in range(4)]
    assert [stretch.times_ns.tolist() for stretch in stretches] == [[], [SECOND], [2 * SECOND], []]
    assert [stretch.series.shape for stretch in stretches] == [(1, 4, 0), (1, 4, 1), (1, 4, 1), (1, 4, 0)]
    assert stretches[1].series[0, 1].tolist() == [1]


def test_each_instance_of_a_template_has_its_own_samples():
    trace = points(a=[0, 0, None], b=[None, 3, 3])
    stream = stream_of("spec s(ego) = G ego dist ego <= 0", traces=[trace], each={"ego": "all"})
    stretches = stream.extend(trace)
    assert [(s.instance.object, len(s)) for s in stream.streams] == [("a", 2), ("b", 2)]
    assert [stretch.times_ns.tolist() for stretch in stretches] == [[0, SECOND], [SECOND, 2 * SECOND]]


def test_an_empty_block_changes_nothing():
    trace = numbers(p=[1])
    stream = stream_of("G p >= 0")
    stream.extend(trace)
    assert stream.extend(trace.slice(0, 0))[0].times_ns.tolist() == []
    assert stream.streams[0].verdict == "satisfied"


def test_samples_out_of_order_are_refused():
    trace = numbers(p=[1, 2])
    stream = stream_of("G p >= 0")
    stream.extend(trace)
    with pytest.raises(TraceError, match=r"a sample at 1.000 s follows one at 1.000 s; give"):
        stream.extend(trace.slice(1, 2))


def test_look_back_is_the_farthest_of_all_terms():
    def reach(text):
        return look_back([spec.formula for spec in parse_specification(text).specs])

    assert reach("a ovlp b") == (0, 0, False)
    assert reach("G (a[-3] ovlp enlarge(b[-5], 1)) and p >= 0") == (5, 0, False)
    assert reach("F a closer b[-2s] than c[-1]") == (1, 2 * SECOND, False)
    assert reach("G (speed(a) <= 1 and a[-2] ovlp b)") == (2, 0, True)
    assert reach("group g = all\nspec s = forall x in g[-4]: a between[x] (x[-250ms], b)") == (
        4,
        SECOND // 4,
        False,
    )
