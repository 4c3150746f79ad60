"""Laws of traces: cutting, joining and converting them loses nothing."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from laws.strategies_trace import certain_traces, traces
from spatial_replay import Trace


@given(certain_traces())
def test_a_trace_is_its_samples(trace):
    assert Trace.from_samples(trace.samples()) == trace


@given(traces(), st.lists(st.integers(0, 6), max_size=3))
def test_pieces_join_to_the_whole(trace, cuts):
    bounds = [0, *sorted(min(cut, len(trace)) for cut in cuts), len(trace)]
    pieces = [trace.slice(begin, end) for begin, end in pairwise(bounds)]
    assert Trace.concatenate(pieces) == trace
    assert sum(piece.unreadable_count for piece in pieces) == trace.unreadable_count


@given(traces())
def test_a_slice_keeps_only_what_its_samples_need(trace):
    half = trace.slice(0, len(trace) // 2)
    assert len(half.footprints) == (half.rows != -1).sum()


@given(traces())
def test_the_compact_form_is_the_same_trace_and_compact_already(trace):
    compact = trace.compact()
    assert compact == trace
    assert compact.compact().rows.tolist() == compact.rows.tolist()


@given(traces(), traces())
def test_equal_traces_have_equal_samples(one, other):
    if one == other:
        assert list(one.samples()) == list(other.samples())
    if one.times_ns.tolist() != other.times_ns.tolist():
        assert one != other


@given(traces())
def test_columns_cannot_be_written_to(trace):
    columns = (trace.times_ns, trace.rows, trace.yaw, trace.uncertainty, trace.class_code)
    assert not any(column.flags.writeable for column in (*columns, *trace.signals.values()))
