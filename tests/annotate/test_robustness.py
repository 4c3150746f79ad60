"""What a message of /spatial/robustness says, to others' decoders and to ours."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from spatial_replay import LogError, Verdict
from spatial_replay.annotate.robustness import decode_robustness, encode_robustness
from spatial_replay.logs.schemas.Robustness_pb2 import (
    HOLDS_SO_FAR,
    PENDING,
    SATISFIED,
    UNKNOWN,
    VIOLATED,
    Robustness,
)
from spatial_replay.monitor.verdict import online_verdict

NAMES = st.lists(st.none() | st.text(min_size=1, max_size=5), min_size=1, max_size=6)
NUMBERS = st.floats(width=64)


@st.composite
def numbered(draw: st.DrawFn):
    """Names of nodes, times, and (N, 4, T) numbers of which lower and upper are never NaN."""
    names = draw(NAMES)
    times = np.array(sorted(draw(st.sets(st.integers(0, 2**63 - 1), max_size=5))), np.int64)
    values = draw(arrays(np.float64, (len(names), 2, len(times)), elements=NUMBERS))
    ends = draw(arrays(np.float64, (len(names), 2, len(times)), elements=st.floats(allow_nan=False)))
    return names, times, np.concatenate([values, np.sort(ends, axis=1)], axis=1)


def open_standing(value: float) -> int:
    return UNKNOWN if np.isnan(value) else HOLDS_SO_FAR if value >= 0.0 else PENDING


@given(numbered(), st.none() | st.text(min_size=1, max_size=5))
def test_the_protobuf_library_reads_every_number(given_numbers, instance):
    names, times, series = given_numbers
    payloads = encode_robustness("blocks", instance, names, times, series)
    assert len(payloads) == len(times)
    for sample, payload in enumerate(payloads):
        message = Robustness.FromString(payload)
        assert (message.specification, message.object) == ("blocks", instance or "")
        assert message.time_ns == times[sample]
        for index, (node, name) in enumerate(zip(message.nodes, names, strict=True)):
            assert (node.id, node.name) == (index, name or "")
            numbers = [node.value, node.now, node.lower, node.upper]
            assert np.array_equal(numbers, series[index, :, sample], equal_nan=True)
            verdict = online_verdict(node.lower, node.upper)
            assert node.standing == {
                Verdict.SATISFIED: SATISFIED,
                Verdict.VIOLATED: VIOLATED,
                Verdict.PENDING: open_standing(node.value),
            }.get(verdict, UNKNOWN)


@given(numbered())
def test_decoding_gives_back_what_was_encoded(given_numbers):
    names, times, series = given_numbers
    decoded = decode_robustness(encode_robustness("blocks", None, names, times, series))
    assert len(decoded) == min(1, len(times))
    for read in decoded:
        assert (read.specification, read.object, read.names) == ("blocks", None, tuple(names))
        assert read.times_ns.tolist() == times.tolist()
        assert np.array_equal(read.series, series, equal_nan=True)


@given(numbered(), numbered())
def test_interleaved_specifications_come_apart(first, second):
    payloads = encode_robustness("a", "ego", *first), encode_robustness("bcd", None, *second)
    tagged = [("a", payload) for payload in payloads[0]] + [("bcd", payload) for payload in payloads[1]]
    tagged.sort(key=lambda entry: entry[1])
    by_name = {read.specification: read for read in decode_robustness([payload for _, payload in tagged])}
    assert by_name.keys() == {name for name, _ in tagged}
    for name, read in by_name.items():
        times = [Robustness.FromString(payload).time_ns for of, payload in tagged if of == name]
        assert read.times_ns.tolist() == times


def test_a_writer_that_leaves_out_zeros_is_read_too():
    message = Robustness(specification="s")
    message.nodes.add(value=1.5, lower=-2.0, upper=2.0)
    full = encode_robustness("s", None, [None], np.array([7]), np.array([[[1.0], [2.0], [3.0], [4.0]]]))
    [read] = decode_robustness([message.SerializeToString(), *full])
    assert read.times_ns.tolist() == [0, 7]
    assert read.series[0].T.tolist() == [[1.5, 0.0, -2.0, 2.0], [1.0, 2.0, 3.0, 4.0]]


def test_what_is_no_message_of_ours_is_named():
    with pytest.raises(LogError, match=r"message 0 of 3 bytes is not a spatial_replay\.Robustness"):
        decode_robustness([b"\xff\xff\xff"])


def test_the_message_about_the_finished_log_is_no_sample():
    series = np.array([[[1.0], [2.0], [3.0], [4.0]]])
    once = encode_robustness("s", None, [None], np.array([7]), series)
    final = encode_robustness("s", None, [None], np.array([7]), series, final=True)
    [read] = decode_robustness([*once, *final])
    assert read.times_ns.tolist() == [7]
