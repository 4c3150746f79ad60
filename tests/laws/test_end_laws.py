"""Laws of the samples at both ends of a log: windows, and the way in which a log is read, change none."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bags.bag_files import SECOND, write_json_mcap
from examples import examples
from mapping.feeding import Feed, make, pose_stamped
from spatial_replay import Trace, parse_specification, read_trace
from spatial_replay.logs.source import read_blocks
from spatial_replay.monitor.ends import Needs, RunEnds
from spatial_replay.sources.open_log import open_source

MS = SECOND // 1000
MAPPING = """\
topics:
  /a: {name: a, shape: {disc: 0.3}}
  /b: {name: b, shape: {disc: 0.3}, max_age: 300ms}
sample: {topic: /a}
"""
STEPS_NS = (100 * MS, 600 * MS)


@st.composite
def moments(draw: st.DrawFn) -> list[tuple[str, int]]:
    """Topics and times of messages; each topic comes at its own rate, for its own stretch of the log."""
    listed = []
    step_ns = draw(st.sampled_from(STEPS_NS))
    for topic in ("/a", "/b"):
        begin, length = draw(st.integers(0, 30)), draw(st.integers(0, 60))
        period = draw(st.sampled_from([1, 2, 3, 7]))
        pause = draw(st.integers(0, 25))
        times = [
            at for at in range(begin, begin + length + 1, period) if not begin + 5 < at < begin + 5 + pause
        ]
        listed += [(topic, 100 * SECOND + at * step_ns) for at in times]
    return sorted(listed, key=lambda message: message[1])


@given(moments(), st.integers(1, 40))
def test_samples_do_not_depend_on_how_messages_are_divided(
    messages: list[tuple[str, int]], batch: int
) -> None:
    feed = Feed()
    for number, (topic, time_ns) in enumerate(messages):
        feed.add(topic, time_ns, pose_stamped(float(number), 0))
    whole, divided = make(MAPPING, feed), make(MAPPING, feed, batch=batch)
    assert whole.trace == divided.trace
    assert whole.trace.spans == divided.trace.spans
    assert whole.remarks == divided.remarks
    # the log is judged to its last message, but for less than a second
    last_ns = max(time_ns for _, time_ns in messages)
    assert last_ns - int(whole.trace.times_ns[-1]) <= SECOND


@given(moments(), st.integers(0, 80), st.integers(1, 60), st.sampled_from(STEPS_NS))
@examples(60)
def test_a_window_has_the_samples_of_the_whole_log(
    messages: list[tuple[str, int]], begin: int, length: int, step_ns: int
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        log, mapping = Path(folder) / "log.mcap", Path(folder) / "m.yaml"
        mapping.write_text(MAPPING)
        contents = [
            (topic, time_ns, {"x": float(n), "y": 0.0}) for n, (topic, time_ns) in enumerate(messages)
        ]
        write_json_mcap(log, contents)
        whole = read_trace(str(log), mapping=str(mapping))
        start_ns = 100 * SECOND + begin * step_ns
        end_ns = start_ns + length * step_ns
        source = open_source(log, mapping=str(mapping))
        window = Trace.concatenate([block.trace for block in read_blocks(source, start_ns, end_ns)])
    inside = (whole.times_ns >= start_ns) & (whole.times_ns < end_ns)
    # an object that has been silent since long before the window is absent there, instead of unknown
    assert window.times_ns.tolist() == whole.times_ns[inside].tolist()


@given(moments(), st.lists(st.integers(1, 10), max_size=6))
def test_ends_do_not_depend_on_how_samples_are_divided(
    messages: list[tuple[str, int]], sizes: list[int]
) -> None:
    feed = Feed()
    for number, (topic, time_ns) in enumerate(messages):
        feed.add(topic, time_ns, pose_stamped(float(number), 0))
    needs = Needs.of([parse_specification("G (a dist b >= 1)")], {})
    counting = []
    for batch in (1000, 1, *sizes):
        # each batch makes a trace of its own
        plan_ends = RunEnds(needs)
        trace = make(MAPPING, feed, batch=batch).trace
        parts = (
            np.split(np.arange(len(trace)), np.cumsum(sizes)) if batch != 1000 else [np.arange(len(trace))]
        )
        released = [part for indices in parts for part in plan_ends.add(trace.take(indices))]
        counting.append(Trace.concatenate([*released, *plan_ends.finish()]))
    assert all(trace == counting[0] for trace in counting)
