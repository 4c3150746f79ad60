"""Samples while their messages come: those of the log, or unknown."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from mapping.feeding import SECOND, Feed, make, pose_stamped, tf, transform
from spatial_replay import Trace, parse_specification
from spatial_replay.mapping.assemble import LiveAssembler
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import ReadingPlan
from spatial_replay.monitor.ends import Needs, trim_trace

MS = 10**6
TWO = """
topics:
  /a: {shape: {disc: 1}}
  /b: {shape: {disc: 1}}
sample: {topic: /a}
max_age: 300ms
"""
FRAMED = """
fixed_frame: map
topics: {/a: {shape: {disc: 1}}}
"""


def live(
    mapping: str, feed: Feed, *, max_delay_s: float = 0.2, in_order: bool = False
) -> tuple[LiveAssembler, Feed]:
    plan = ReadingPlan.of(parse_mapping(mapping, "test.yaml"), feed.topics())
    assembler = LiveAssembler(plan, feed.decoder, name="robot", max_delay_s=max_delay_s, in_order=in_order)
    return assembler, feed


@st.composite
def feeds(draw: st.DrawFn) -> tuple[Feed, list[int]]:
    """Messages of two topics in the order of time, often at equal times, and how they are divided."""
    feed, time_ns = Feed(), SECOND
    for _ in range(draw(st.integers(1, 10))):
        for topic in draw(st.sampled_from([["/a"], ["/b"], ["/a", "/b"], ["/b", "/a"]])):
            feed.add(topic, time_ns, pose_stamped(draw(st.integers(0, 3)), 0))
        time_ns += draw(st.sampled_from([1, 20, 400])) * MS
    count = len(feed.messages)
    feed.add("/a", time_ns + SECOND, pose_stamped(0, 0)).add("/b", time_ns + SECOND, pose_stamped(0, 0))
    return feed, sorted(draw(st.sets(st.integers(1, count), max_size=6)))


@examples(40)
@given(drawn=feeds(), every=st.booleans())
def test_a_log_gives_the_same_samples_while_it_comes(drawn: tuple[Feed, list[int]], every: bool) -> None:
    feed, cuts = drawn
    mapping = TWO.replace("{topic: /a}", "{every: 70ms}") if every else TWO
    assembler, _ = live(mapping, feed)
    raw = feed.raw()
    traces = []
    for begin, end in zip([0, *cuts], [*cuts, len(raw)], strict=True):
        # in its own time, but that what has one time comes in one moment
        part = raw[begin:end]
        traces.append(assembler.add(part, part[-1].log_time_ns / SECOND if part else 0.0))
    traces.append(assembler.finish())
    assert Trace.concatenate(traces) == make(mapping, feed).trace


def test_a_sample_is_there_with_the_message_that_completes_it() -> None:
    feed = Feed().add("/b", SECOND, pose_stamped(0, 0)).add("/a", SECOND + MS, pose_stamped(1, 0))
    feed.add("/b", SECOND + 2 * MS, pose_stamped(2, 0))
    assembler, _ = live(TWO, feed)
    first, second, third = feed.raw()
    assert len(assembler.add([first], 1.0)) == 0
    assert len(assembler.add([second], 1.001)) == 0
    assert len(assembler.add([third], 1.0012)) == 1
    for in_order, most_s in ((True, 1.002), (False, 1.2)):
        assembler, _ = live(TWO, feed, in_order=in_order)
        assembler.add([first, second], 1.0)
        due_s = assembler.due_s()
        assert due_s is not None and due_s <= most_s
        assert len(assembler.add([], due_s)) == 1


def test_a_message_that_comes_too_late_is_counted_and_makes_no_sample() -> None:
    feed = Feed().add("/a", SECOND, pose_stamped(0, 0)).add("/b", SECOND, pose_stamped(1, 0))
    feed.add("/b", SECOND + 100 * MS, pose_stamped(2, 0)).add("/a", SECOND + 100 * MS, pose_stamped(3, 0))
    first, late, *later = feed.raw()
    assembler, _ = live(TWO, feed)
    traces = [assembler.add([first], 1.0), assembler.add([], 1.2), assembler.add([late], 1.201)]
    traces.append(assembler.add(later, 1.21))
    alone, whole = Trace.concatenate(traces), make(TWO, feed).trace
    assert alone.slice(1, 2) == whole.slice(1, 2) and len(alone) == len(whole) == 2
    assert alone.slice(0, 1) != whole.slice(0, 1) and assembler.late == 1
    [said] = assembler.take_faults()
    assert "/b at 1.000 s: it came after" in str(said)
    # a server that does not keep the order of time is waited for from then on
    assembler, _ = live(TWO, feed, in_order=True)
    assembler.add([first], 1.0)
    assembler.add([], 1.001)
    assembler.add([late], 1.002)
    assembler.add(later[:1], 1.1)
    assert assembler.due_s() == 1.1 + 0.2


def test_an_observation_waits_for_its_transform_and_then_is_unknown() -> None:
    feed = Feed()
    for tick in range(3):
        at = SECOND + tick * 100 * MS
        feed.add("/tf", at, tf(transform("map", "cam", (tick, 0, 0), time_ns=at)))
        feed.add("/a", at + 10 * MS, pose_stamped(0, 0, "cam", time_ns=at + 5 * MS))
    assembler, _ = live(FRAMED, feed)
    raw = feed.raw()
    # the first transform lies before the stamp: the next one makes it known
    assert len(assembler.add(raw[:2], 1.0)) == 0
    (placed,) = assembler.add(raw[2:3], 1.1).samples()
    assert set(placed.objects) == {"a"} and assembler.overdue == 0
    assert len(assembler.add(raw[3:4], 1.11)) == 0
    assert len(assembler.add([], 1.3)) == 0
    assert assembler.due_s() == 1.11 + 0.2
    (late,) = assembler.add([], 1.31).samples()
    assert (dict(late.objects), dict(late.unknown)) == ({}, {"a": None})
    assert (assembler.overdue, assembler.overdue_frame) == (1, ("/a", "cam"))


def test_a_run_that_ends_while_an_observation_waits_ends_before_it() -> None:
    feed = Feed()
    for tick in range(3):
        at = SECOND + tick * 100 * MS
        feed.add("/tf", at, tf(transform("map", "cam", (tick, 0, 0), time_ns=at)))
        feed.add("/a", at + 10 * MS, pose_stamped(0, 0, "cam", time_ns=at + 5 * MS))
    assembler, _ = live(FRAMED, feed)
    needs = Needs.of(
        [parse_specification("region home = box(0, 0, 9, 9)\nspec s = G (a dist home <= 1)")], {}
    )
    running = [assembler.add([message], 1.0 + place / 20) for place, message in enumerate(feed.raw())]
    last, (remark,) = trim_trace(assembler.finish(), needs, start=False, is_rest=True)
    assert len(last) == 0
    assert str(remark).startswith("1 sample at the end is left out")
    recorded, _ = trim_trace(make(FRAMED, feed).trace, needs)
    assert Trace.concatenate([*running, last]) == recorded
    assert len(recorded) == 2


def test_what_is_lost_is_unknown_until_it_is_reported_again() -> None:
    feed = Feed().add("/b", SECOND, pose_stamped(0, 0)).add("/a", SECOND + MS, pose_stamped(1, 0))
    feed.add("/a", 2 * SECOND, pose_stamped(1, 0)).add("/b", 2 * SECOND + MS, pose_stamped(1, 0))
    feed.add("/a", 2 * SECOND + 2 * MS, pose_stamped(1, 0)).add("/b", 3 * SECOND, pose_stamped(1, 0))
    assembler, _ = live(TWO.replace("300ms", "forever"), feed)
    raw = feed.raw()
    assembler.add(raw[:2], 1.0)
    *_, lost = assembler.lose(["/a", "/b"], 1.5).samples()
    assert (lost.time_ns, dict(lost.objects), set(lost.unknown)) == (SECOND + MS + 1, {}, {"a", "b"})
    assert len(assembler.lose(["/a", "/b"], 1.6)) == 0
    after = [each for raw_one in raw[2:] for each in assembler.add([raw_one], 2.0).samples()]
    assert [(set(each.objects), set(each.unknown)) for each in after] == [
        ({"a"}, {"b"}),
        ({"a", "b"}, set()),
    ]


def test_a_clock_that_steps_back_gives_the_same_samples_while_it_comes() -> None:
    feed = Feed()
    for number in range(60):
        stamp, at = (number % 30) * 100 * MS, 20 * SECOND + number * 100 * MS
        feed.add("/a", at, pose_stamped(0, 0, "cam", time_ns=max(1, stamp - 60 * MS)))
        # the first transform of the second run comes late
        if number not in range(30, 33):
            x = stamp / SECOND if number < 30 else 50
            feed.add("/tf", at + MS, tf(transform("map", "cam", (x, 0, 0), time_ns=stamp)))
    assembler, _ = live(FRAMED, feed, max_delay_s=1.0)
    traces = [assembler.add([message], message.log_time_ns / SECOND) for message in feed.raw()]
    whole = make(FRAMED, feed)
    assert Trace.concatenate([*traces, assembler.finish()]) == whole.trace
    assert whole.states("a") == 30 * "+" + 4 * "?" + 26 * "+"


def test_a_stamp_in_another_unit_is_named_with_its_value() -> None:
    feed = Feed()
    for tick in range(3):
        at = 1_790_000_000 * SECOND + tick * SECOND
        feed.add("/tf", at, tf(transform("map", "cam", (tick, 0, 0), time_ns=at)))
        feed.add("/a", at + MS, pose_stamped(0, 0, "cam", time_ns=at // 10**9))
    [remark] = make(FRAMED, feed).remarks
    assert "its stamp is 1.79 s, in 1970: `stamp: {field: PATH, unit: s}` reads it in s" in remark


@examples(60)
@given(delays=st.lists(st.sampled_from([0, 0, 3, 20, 90]), min_size=60, max_size=60), stamped=st.booleans())
def test_transforms_that_come_late_give_the_same_samples(delays: list[int], stamped: bool) -> None:
    feed, arrivals = Feed(), []
    arrived_ns = {"/tf": 0, "/a": 0}
    for tick, delay in enumerate(delays):
        at, topic = SECOND + tick // 2 * 20 * MS, "/a" if tick % 4 == 1 else "/tf"
        if topic == "/tf":
            content = tf(transform("map", "cam", (tick * tick, 0, 0), time_ns=at))
        else:
            content = pose_stamped(0, 0, "cam", time_ns=(at - 7 * MS) * stamped)
        arrived_ns[topic] = max(arrived_ns[topic] + 1, at + delay * MS)
        feed.add(topic, at, content)
        arrivals.append(arrived_ns[topic])
    assembler, _ = live(FRAMED, feed)
    raw, traces = feed.raw(), []
    for number in sorted(range(len(raw)), key=arrivals.__getitem__):
        now_s = arrivals[number] / SECOND
        while (due_s := assembler.due_s()) is not None and due_s < now_s:
            traces.append(assembler.add([], due_s))
        traces.append(assembler.add([raw[number]], now_s))
    traces.append(assembler.finish())
    assert Trace.concatenate(traces) == make(FRAMED, feed).trace
    assert assembler.late == 0
