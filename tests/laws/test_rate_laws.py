"""Laws of rates of change: the samples that show reports never decide how fast something changes."""

from __future__ import annotations

import numpy as np
import pytest
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from hypothesis import given
from hypothesis import strategies as st
from mcap_protobuf.schema import build_file_descriptor_set

from bags.bag_files import (
    POINT,
    SECOND,
    START_NS,
    Sent,
    point,
    write_json_mcap,
    write_mcap,
    write_ros1,
    write_ros2,
)
from mapping.feeding import Feed, make, pose_stamped, ros
from spatial_replay import Footprint, Sample, Trace, evaluate, parse_specification, read_trace

MS = 10**6
POINT2 = build_file_descriptor_set(Point2).SerializeToString()


def rates(trace: Trace, quantity: str) -> np.ndarray:
    """A rate in each sample, NaN where there is none."""
    (result,) = evaluate(parse_specification(f"{quantity} >= 0"), trace)
    return np.asarray(result.nodes[0].now)


times_ms = st.lists(st.integers(0, 9_000), min_size=2, max_size=12, unique=True).map(sorted)
speeds = st.floats(-5, 5).map(lambda speed: round(speed, 3))


@given(of_a=times_ms, of_b=times_ms, sampled=times_ms, v=speeds, w=speeds)
def test_the_closing_speed_of_bodies_that_keep_their_velocities_is_exact(
    of_a: list[int], of_b: list[int], sampled: list[int], v: float, w: float
) -> None:
    samples, seen = [], {"a": set[int](), "b": set[int]()}
    expected = []
    for time_ms in sampled:
        objects, reported_ns = {}, {}
        for name, start, speed, reports in (("a", -500.0, v, of_a), ("b", 500.0, w, of_b)):
            shown = max((ms for ms in reports if ms <= time_ms), default=None)
            if shown is not None:
                x = start + speed * shown / 1e3
                objects[name] = Footprint.box(x - 1, -200, x + 1, 200)
                reported_ns[name] = shown * MS
                seen[name].add(shown)
        samples.append(Sample(time_ms * MS, objects, reported_ns=reported_ns))
        expected.append(v - w if min(map(len, seen.values())) > 1 else np.nan)
    np.testing.assert_allclose(rates(Trace.from_samples(samples), "speed(a, b)"), expected, atol=1e-8)


def traffic(steps_ms: list[int], values: list[float]) -> Feed:
    """A robot every 20 ms, and a cart and a battery that are reported now and then."""
    feed, time_ms = Feed(), 0
    for step_ms, value in zip(steps_ms, values, strict=True):
        feed.add("/cart", time_ms * MS, pose_stamped(value, 1.0))
        feed.add("/battery", time_ms * MS, ros("std_msgs/Float64", data=value))
        time_ms += 20 * step_ms
    for robot_ms in range(0, time_ms, 20):
        feed.add("/robot", robot_ms * MS, pose_stamped(robot_ms / 1e3, 0.0))
    feed.messages.sort(key=lambda message: message[1])
    return feed


MAPPING = """
sample: {%s}
max_age: 10s
topics:
  /robot: {shape: {disc: 0.3}}
  /cart: {shape: {disc: 0.3}}
  /battery: {signals: {battery: data}}
"""


@given(data=st.data(), steps_ms=st.lists(st.integers(2, 8), min_size=2, max_size=6))
def test_samplings_that_see_every_report_give_one_rate(data: st.DataObject, steps_ms: list[int]) -> None:
    values = data.draw(st.lists(st.floats(-9, 9), min_size=len(steps_ms), max_size=len(steps_ms)))
    feed = traffic(steps_ms, values)
    dense = [make(MAPPING % how, feed).trace for how in ("topic: /robot", "every: 10ms", "every: 4ms")]
    every_second = dense[1].take(np.arange(0, len(dense[1]), 2))
    sparse = make(MAPPING % "topic: /cart", feed).trace
    for quantity in ("speed(cart)", "rate(battery)"):
        of_reports = rates(sparse, quantity)
        for trace in (*dense, every_second):
            shown = np.searchsorted(sparse.times_ns, trace.times_ns, side="right") - 1
            assert rates(trace, quantity).tobytes() == of_reports[shown].tobytes()


def test_containers_with_the_same_numbers_give_the_same_rates(tmp_path) -> None:
    steps = [(t, "/a", point(0.1 * t, 1.0)) for t in range(0, 60, 3)]
    steps += [(t, "/b", point(5.0, 0.07 * t)) for t in range(60)]
    sent = [
        Sent(topic, POINT, START_NS + t * SECOND // 10, at)
        for t, topic, at in sorted(steps, key=lambda s: s[:2])
    ]
    listed = [(s.topic, s.time_ns, {"x": s.content.x, "y": s.content.y}) for s in sent]
    logs = [
        write_ros1(tmp_path / "one.bag", sent),
        write_ros2(tmp_path / "db3", sent, storage="sqlite3"),
        write_ros2(tmp_path / "mcap", sent),
        write_json_mcap(tmp_path / "run.mcap", listed),
        write_mcap(
            tmp_path / "protobuf.mcap",
            [(topic, "protobuf", "foxglove.Point2", "protobuf", POINT2) for topic in ("/a", "/b")],
            [(topic, time_ns, Point2(**at).SerializeToString()) for topic, time_ns, at in listed],
        ),
    ]
    mapping = tmp_path / "m.yaml"
    mapping.write_text(
        "sample: {topic: /b}\ntopics:\n"
        "  /a: {position: [x, y], shape: {disc: 0.5}}\n  /b: {position: [x, y], shape: {box: [1, 1]}}\n"
    )
    traces = [read_trace(log, mapping=mapping) for log in logs]
    for quantity, count in (("speed(a)", 57), ("speed(a, b)", 57)):
        series = [rates(trace, quantity) for trace in traces]
        assert np.isfinite(series[0]).sum() == count
        assert len({each.tobytes() for each in series}) == 1


@pytest.mark.parametrize("ending", ["csv", "jsonl"])
def test_track_files_have_a_report_in_every_sample(tmp_path, ending: str) -> None:
    path = tmp_path / f"run.{ending}"
    rows = [(0, 0, 0), (SECOND // 2, 1, 0), (3 * SECOND // 2, 1, 2)]
    lines = [f"{t},a,,{x},{y},,0.4,0.2" for t, x, y in rows]
    if ending == "csv":
        lines.insert(0, "time_ns,name,class,x,y,yaw,length,width")
    else:
        square = "[[%d, %d], [%d, %d], [%d, %d]]"
        objects = (square % (x, y, x + 1, y, x, y + 1) for _, x, y in rows)
        lines = [
            f'{{"time_ns": {t}, "objects": [{{"name": "a", "polygon": {polygon}}}]}}'
            for (t, *_), polygon in zip(rows, objects, strict=True)
        ]
    path.write_text("\n".join(lines) + "\n")
    np.testing.assert_equal(rates(read_trace(path), "speed(a)"), [np.nan, 2.0, 2.0])
