"""When samples are taken, which observations are valid then, and clocks that jump."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mapping.feeding import SECOND, Feed, header, make, pose_stamped, ros
from spatial_replay import LogError, Trace, UsageError
from spatial_replay.bags.reader import MessageColumns
from spatial_replay.logs.messages import Channel
from spatial_replay.mapping.assemble import Assembler
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import ReadingPlan
from spatial_replay.trace.trace import LATEST_NS

MS = 10**6


def seconds(times_ns: Any) -> list[float]:
    return [time / SECOND for time in times_ns.tolist()]


def point(x: float, **more: Any) -> dict[str, Any]:
    return {"x": x, "y": 0.0, **more}


def test_each_message_of_the_first_topic_with_objects_is_a_sample() -> None:
    feed = Feed()
    for tick in range(5):
        feed.add("/slow", tick * SECOND, point(tick))
        feed.add("/fast", tick * SECOND + 1, point(tick))
        feed.add("/fast", tick * SECOND + SECOND // 2, point(tick + 0.5))
    slow = make("topics: {/slow: {}, /fast: {}}", feed)
    assert seconds(slow.trace.times_ns) == [0, 1, 2, 3, 4]
    assert slow.states("fast") == "-++++"
    assert slow.centre(2, "fast") == (1.5, 0.0)
    fast = make("sample: {topic: /fast}\ntopics: {/slow: {}, /fast: {}}", feed)
    assert len(fast.trace) == 10


def test_an_unmapped_topic_can_be_sampled() -> None:
    feed = (
        Feed()
        .add("/a", 0, point(0))
        .add("/tick", 1, {})
        .add("/tick", SECOND // 2, {})
        .add("/a", SECOND, point(1))
    )
    assert make("sample: {topic: /tick}\ntopics: {/a: {}}", feed).trace.times_ns.tolist() == [1, SECOND // 2]


def test_samples_at_each_multiple_of_a_step_do_not_depend_on_the_window() -> None:
    feed = Feed()
    for tick in range(20):
        feed.add("/a", tick * 130 * MS + 7, point(tick))
    text = "sample: {every: 200ms}\ntopics: {/a: {}}"
    whole = make(text, feed)
    assert [time % (200 * MS) for time in whole.trace.times_ns.tolist()] == [0] * len(whole.trace)
    assert seconds(whole.trace.times_ns) == pytest.approx([0.2 * n for n in range(1, 13)])
    part = make(text, feed, start_ns=500 * MS, end_ns=1500 * MS)
    assert seconds(part.trace.times_ns) == pytest.approx([0.6, 0.8, 1.0, 1.2, 1.4])
    assert part.trace == whole.trace.slice(2, 7)


def test_an_object_with_an_old_observation_exists_but_is_unknown() -> None:
    feed = Feed().add("/b", 0, point(0))
    for tick in range(8):
        feed.add("/a", tick * SECOND // 2, point(tick))
    made = make("max_age: 1500ms\ntopics: {/a: {}, /b: {}}", feed)
    assert made.states("b") == "++++????"
    assert "/b: b is unknown in up to 4 samples, the first at 2.000 s" in made.remarks[0]
    assert make("topics: {/a: {}, /b: {max_age: forever}}", feed).states("b") == "++++++++"
    assert make("topics: {/a: {}, /b: {}}", feed).states("b") == "+++?????"


def test_an_object_that_a_complete_list_leaves_out_is_absent() -> None:
    def listed(*numbers: int) -> dict[str, Any]:
        return {"things": [{"id": number, "x": 0.0, "y": 0.0} for number in numbers]}

    feed = Feed()
    for tick, numbers in enumerate([(1, 2), (1,), (), (2,), (1, 2)]):
        feed.add("/list", tick * SECOND, listed(*numbers))
    text = "topics: {{/list: {{objects: 'things[*]', name: 't{{id}}', position: [x, y]{more}}}}}"
    made = make(text.format(more=""), feed)
    assert (made.states("t1"), made.states("t2")) == ("++--+", "+--++")
    kept = make(text.format(more=", complete: false, max_age: 2s"), feed)
    assert (kept.states("t1"), kept.states("t2")) == ("+++++", "+++++")


def test_lists_that_are_empty_before_the_first_object_are_samples() -> None:
    def listed(*numbers: int, time_ns: int) -> Any:
        found = [ros("apriltag_msgs/AprilTagDetection", id=number) for number in numbers]
        return ros(
            "apriltag_msgs/AprilTagDetectionArray", header=header("", SECOND + time_ns), detections=found
        )

    def marked(*numbers: int, time_ns: int) -> Any:
        marks = [
            ros("visualization_msgs/Marker", header=header("", SECOND + time_ns), ns="m", id=number, type=1)
            for number in numbers
        ]
        return ros("visualization_msgs/MarkerArray", markers=marks)

    tags, things, marks = Feed(), Feed(), Feed()
    for tick, numbers in enumerate([(), (), (), (1,), ()]):
        tags.add("/tags", tick + 9, listed(*numbers, time_ns=tick * SECOND))
        marks.add("/marks", tick + 9, marked(*numbers, time_ns=tick * SECOND))
        stamp = {"stamp": {"sec": tick + 1, "nanosec": 0}}
        each = [{"id": number, "x": 0.0, "y": 0.0, "header": stamp} for number in numbers]
        things.add("/things", tick + 9, {"header": stamp, "things": each})
    made = make("clock: header\ntopics: {/tags: {}}", tags)
    assert seconds(made.trace.times_ns) == [1, 2, 3, 4, 5]
    assert made.states("tag1")[:3] + made.states("tag1")[4] == "----"
    # objects have stamps of their own, and a list without objects that of its header
    made = make("clock: header\ntopics: {/things: {objects: 'things[*]', name: 't{id}'}}", things)
    assert (seconds(made.trace.times_ns), made.states("t1")) == ([1, 2, 3, 4, 5], "---+-")
    # what has no stamp at all is counted
    made = make("clock: header\ntopics: {/marks: {}}", marks)
    assert seconds(made.trace.times_ns) == [4]
    assert "/marks: 4 messages were left out, without a stamp" in made.remarks[0]


def test_messages_with_a_stamp_of_0_have_no_time_on_the_clock_header() -> None:
    feed = Feed()
    for tick in range(6):
        stamp = tick * SECOND if tick > 2 else 0
        feed.add("/p", tick, pose_stamped(tick, 0, time_ns=stamp))
    made = make("clock: header\ntopics: {/p: {}}", feed)
    assert seconds(made.trace.times_ns) == [3, 4, 5]
    assert made.remarks == (
        "test.bag: /p: 3 messages were left out, without a stamp, or with one of 0, for the clock header",
    )


def test_a_topic_whose_stamps_are_all_0_needs_another_clock() -> None:
    feed = Feed().add("/p", 1, pose_stamped(0, 0, time_ns=SECOND)).add("/zone", 1, pose_stamped(0, 0))
    with pytest.raises(UsageError, match=r"topics\./zone: .* no stamp; .*`clock: log` for this topic"):
        make("clock: header\ntopics: {/p: {}, /zone: {}}", feed)
    made = make("clock: header\ntopics: {/p: {}, /zone: {clock: log, max_age: forever}}", feed)
    assert made.states("zone") == "+"


@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_a_clock_that_steps_back_between_numbered_messages_is_remarked(batch: int) -> None:
    feed = Feed()
    for tick in range(40):
        feed.add("/p", 10 * SECOND + tick * 100 * MS - (750 * MS if tick >= 20 else 0), point(tick))
    made = make("topics: {/p: {}}", feed, batch=batch)
    assert [made.centre(n, "p")[0] for n in range(40)] == list(range(40))
    assert made.remarks == (
        "test.bag: /p: times step back in the order of recording, first by 0.650 s at 11.900 s: its messages"
        " are numbered on, so those recorded later count later; cut the log there, or take another `clock`",
    )


@pytest.mark.parametrize("batch", [1, 7, 1000])
@pytest.mark.parametrize("clock", ["log", "header"])
def test_times_that_step_back_without_numbers_are_sorted_and_remarked(batch: int, clock: str) -> None:
    feed = Feed(is_numbered=clock == "header")
    for tick in range(40):
        time_ns = 10 * SECOND + tick * 100 * MS - (750 * MS if tick >= 20 else 0)
        feed.add("/p", time_ns if clock == "log" else tick, pose_stamped(tick, 0, time_ns=time_ns))
    made = make(f"clock: {clock}\ntopics: {{/p: {{}}}}", feed, batch=batch)
    assert (np.diff(made.trace.times_ns) >= 0).all()
    assert made.remarks == (
        "test.bag: /p: times step back in the order of recording, first by 0.650 s at 11.900 s: its messages"
        " are sorted by time, as if of two senders; if a clock was set back, cut the log there, or take"
        " another `clock`",
    )


def test_messages_that_several_threads_mix_are_no_step() -> None:
    feed = Feed(is_numbered=False)
    for tick in range(40):
        feed.add("/p", 10 * SECOND + tick * MS - (8 * MS if tick % 4 else 0), point(tick))
    assert make("topics: {/p: {}}", feed).remarks == ()


def counted_feed(**counts: int) -> Feed:
    feed = Feed(counts={f"/{name}": count for name, count in counts.items()})
    for name, count in counts.items():
        for tick in range(count):
            feed.add(f"/{name}", tick * SECOND // count, point(tick))
    feed.messages.sort(key=lambda message: message[1])
    return feed


def test_without_a_choice_the_most_frequent_topic_is_sampled() -> None:
    made = make("topics: {/zone: {}, /p: {}}", counted_feed(zone=1, p=20))
    assert (len(made.trace), made.remarks) == (20, ())
    # one that has signals alone may be ten times as frequent
    signals = "topics: {/p: {}, /imu: {signals: {a: x}}}"
    made = make(signals, counted_feed(p=4, imu=40))
    assert len(made.trace) == 4


def test_a_topic_that_is_sampled_too_rarely_is_remarked() -> None:
    mapping = parse_mapping("sample: {topic: /zone}\ntopics: {/zone: {}, /p: {}}")
    few, many = counted_feed(zone=1, p=9), counted_feed(zone=1, p=10)
    assert ReadingPlan.of(mapping, few.topics()).remarks == ()
    assert ReadingPlan.of(mapping, many.topics()).remarks == (
        "samples are taken at /zone, which has 1 message, where /p has 10; `sample: {topic: /p}` takes one at"
        " each of these",
    )


def test_a_max_age_of_the_file_counts_for_latched_topics_and_markers_too() -> None:
    cube = ros("visualization_msgs/Marker", header=header("map"), ns="m", type=1)
    feed = Feed(latched=frozenset({"/b"})).add("/b", 0, point(0)).add("/m", 0, cube)
    for tick in range(4):
        feed.add("/a", tick * SECOND, point(tick))
    text = "sample: {{topic: /a}}\n{head}topics: {{/a: {{}}, /m: {{}}, /b: {{{own}}}}}"
    assert make(text.format(head="", own=""), feed).states("b") == "++++"
    made = make(text.format(head="max_age: 2s\n", own=""), feed)
    assert (made.states("b"), made.states("m_0")) == ("+++?", "+++?")
    assert make(text.format(head="max_age: 2s\n", own="max_age: forever"), feed).states("b") == "++++"


def test_a_silent_list_makes_its_objects_unknown() -> None:
    feed = Feed().add("/list", 0, {"things": [{"id": 1, "x": 0.0, "y": 0.0}]})
    for tick in range(4):
        feed.add("/a", tick * SECOND, point(0))
    listed = "{objects: 'things[*]', name: 't{id}', position: [x, y]}"
    text = f"sample: {{topic: /a}}\ntopics: {{/list: {listed}, /a: {{}}}}"
    assert make(text, feed).states("t1") == "++??"


def test_messages_out_of_order_by_up_to_a_second_are_sorted() -> None:
    def stamped(x: float, time_ns: int) -> Any:
        return pose_stamped(x, 0.0, time_ns=time_ns)

    feed = Feed()
    for number, tick in enumerate([0, 5, 2, 9, 4, 12]):
        feed.add("/p", number, stamped(tick, SECOND + tick * 100 * MS))
    made = make("clock: header\ntopics: {/p: {}}", feed)
    assert seconds(made.trace.times_ns) == pytest.approx([1, 1.2, 1.4, 1.5, 1.9, 2.2])
    assert [made.centre(n, "p")[0] for n in range(6)] == [0, 2, 4, 5, 9, 12]


def test_of_equal_times_the_later_one_counts() -> None:
    feed = Feed().add("/p", 5, point(1)).add("/p", 5, point(2)).add("/p", 6, point(3))
    made = make("topics: {/p: {}}", feed)
    assert made.trace.times_ns.tolist() == [5, 6]
    assert made.centre(0, "p") == (2.0, 0.0)
    assert "/p: 1 message was left out, the first at 0.000 s: of those with the same time the last" in str(
        made.remarks[0]
    )
    # two objects at one time replace nothing
    both = Feed().add("/p", 5, {"id": 1, **point(1)}).add("/p", 5, {"id": 2, **point(2)})
    assert make("topics: {/p: {name: 'o{id}'}}", both).remarks == ()


def restarted() -> Feed:
    feed = Feed()
    for tick in [*range(100, 110), *range(5)]:
        feed.add("/p", tick * SECOND, point(tick))
    return feed


def test_a_longer_jump_back_is_an_error_that_says_where() -> None:
    with pytest.raises(
        LogError, match=r"test.bag: time jumps back by 109.000 s, from 9.000 s to -100.000 s, at a"
    ):
        make("topics: {/p: {}}", restarted())


def test_topics_with_stamps_of_two_clocks_are_an_error_that_names_another_clock() -> None:
    feed = Feed()
    for tick in range(3):
        for topic, start in (("/p", 0), ("/q", 1_700_000_000)):
            stamp = {"sec": start + tick, "nanosec": 1}
            feed.add(topic, tick * SECOND, {"header": {"stamp": stamp}, **point(tick)})
    with pytest.raises(
        LogError, match=r"at a message of /p; its stamps .* two clocks; `clock: log` uses one"
    ):
        make("clock: header\ntopics: {/p: {}, /q: {}}", feed)


@pytest.mark.parametrize("batch", [1, 4, 1000])
def test_or_the_log_ends_there_if_asked(batch: int) -> None:
    made = make("topics: {/p: {}}", restarted(), batch=batch, on_time_jump="split")
    assert seconds(made.trace.times_ns) == list(range(100, 110))
    assert "the log is taken to end there" in made.remarks[0]


@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_stamps_may_be_as_late_as_is_said(batch: int) -> None:
    feed = Feed()
    # a detector whose stamps are three seconds old when they are logged, beside one that is quick
    for tick in range(40):
        at, late = ((1 + each) * 100 * MS for each in (tick, max(0, tick - 30)))
        feed.add("/quick", at, pose_stamped(tick, 0, time_ns=at))
        feed.add("/slow", at + 1, pose_stamped(tick, 5, time_ns=late))
    text = "clock: header\ntopics: {/quick: {}, /slow: {max_age: forever}}"
    with pytest.raises(
        LogError, match=r"time jumps back by \d\.\d{3} s, from \d\.\d{3} s to .*--read max_lateness=5s"
    ):
        make(text, feed, batch=batch)
    for late_ns in (5 * SECOND, LATEST_NS):
        made = make(text, feed, batch=batch, late_ns=late_ns)
        assert seconds(made.trace.times_ns) == [(1 + tick) / 10 for tick in range(40)]
        assert made.centre(5, "slow") == (35.0, 5.0)


def test_a_clock_that_jumps_forward_does_not_make_billions_of_samples() -> None:
    feed = Feed().add("/p", 0, point(0)).add("/p", 1_700_000_000 * SECOND, point(1))
    with pytest.raises(
        LogError, match=r"jumps forward from 0.000 s to 1700000000.000 s, more than 100000 samples"
    ):
        make("sample: {every: 100ms}\ntopics: {/p: {}}", feed)


def test_a_window_long_after_what_lasts_is_no_jump() -> None:
    feed = Feed(latched=frozenset({"/map"})).add("/map", 0, point(7))
    for tick in range(10):
        feed.add("/p", 1_000_000 * SECOND + tick * 100 * MS, point(tick))
    text = "sample: {every: 100ms}\ntopics: {/p: {}, /map: {}}"
    made = make(text, feed, start_ns=1_000_000 * SECOND)
    assert (len(made.trace), made.states("map")) == (10, "+" * 10)


def test_the_three_clocks() -> None:
    feed = Feed().add("/p", 7 * SECOND, pose_stamped(0, 0, time_ns=3 * SECOND))
    assert seconds(make("clock: log\ntopics: {/p: {}}", feed).trace.times_ns) == [7]
    assert seconds(make("clock: publish\ntopics: {/p: {}}", feed).trace.times_ns) == [7]
    assert seconds(make("clock: header\ntopics: {/p: {}}", feed).trace.times_ns) == [3]


def test_stamps_may_be_numbers_of_any_unit() -> None:
    feed = Feed().add("/p", 7, point(0, at=2500))
    made = make("clock: header\ntopics: {/p: {stamp: {field: at, unit: ms}}}", feed)
    assert seconds(made.trace.times_ns) == [2.5]


def test_stamps_in_another_unit_than_the_mapping_says_are_refused() -> None:
    start_ns = 1_700_000_000 * SECOND
    for unit, ns in (("us", 10**3), ("ms", 10**6), ("s", 10**9)):
        feed = Feed().add("/p", start_ns + SECOND, point(0, at=start_ns // ns))
        with pytest.raises(
            UsageError, match=rf"topics\./p: stamps in {unit} are read as ns; write .*unit: {unit}"
        ):
            make("clock: header\ntopics: {/p: {stamp: at}}", feed)


def test_a_topic_without_stamps_needs_another_clock() -> None:
    feed = Feed().add("/p", 7, point(0))
    with pytest.raises(
        UsageError, match=r"test.yaml: topics./p: the clock is header, but its messages have no stamp"
    ):
        make("clock: header\ntopics: {/p: {}}", feed)
    assert len(make("clock: header\ntopics: {/p: {clock: log}}", feed).trace) == 1


def test_signals_follow_the_same_rules() -> None:
    feed = Feed().add("/battery", 0, ros("sensor_msgs/BatteryState", percentage=0.5))
    feed.add("/battery", SECOND, ros("sensor_msgs/BatteryState", percentage=0.25))
    for tick in range(6):
        feed.add("/p", tick * SECOND // 2, point(0))
    text = (
        "sample: {topic: /p}\ntopics: {/p: {}, /battery: {signals: {charge: {field: percentage, unit: '1'}}}}"
    )
    made = make(text, feed)
    charge = made.trace.signals["charge"].tolist()
    assert charge[:5] == [0.5, 0.5, 0.25, 0.25, 0.25]
    assert charge[5] != charge[5]
    (remark,) = made.remarks
    assert "/battery: charge is unknown in up to 1 sample, the first at 2.500 s: no report came" in remark
    assert remark.endswith("`max_age: forever` keeps the last one")


def test_a_topic_may_have_objects_and_signals() -> None:
    content = ros(
        "nav_msgs/Odometry",
        header=header("odom"),
        twist=ros(
            "geometry_msgs/TwistWithCovariance",
            twist=ros("geometry_msgs/Twist", linear=ros("geometry_msgs/Vector3", x=1.5)),
        ),
    )
    feed = Feed().add("/odom", 0, content)
    both = make("topics: {/odom: {name: robot, signals: {speed: twist.twist.linear.x}}}", feed)
    assert (both.states("robot"), both.trace.signals["speed"].tolist()) == ("+", [1.5])
    only = make("topics: {/odom: {signals: {speed: twist.twist.linear.x}}}", feed)
    assert (only.trace.names, only.trace.signals["speed"].tolist()) == ((), [1.5])


@pytest.mark.parametrize("batch", [1, 3, 257])
def test_samples_do_not_depend_on_batches_of_messages(batch: int) -> None:
    feed = Feed()
    for tick in range(3000):
        feed.add("/p", tick * 10 * MS + (tick % 7) * MS, point(tick))
        if tick % 5 == 0:
            feed.add("/q", tick * 10 * MS + 3, point(-tick))
    text = "topics: {/p: {}, /q: {max_age: 45ms}}"
    whole = make(text, feed, batch=100_000)
    assert len(whole.trace) == 3000
    assert make(text, feed, batch=batch).trace == whole.trace


def test_columns_of_messages_make_the_same_samples() -> None:
    feed = Feed()
    for tick in range(20):
        feed.add("/p", tick * 10 * MS, point(tick))
    plan = ReadingPlan.of(parse_mapping("topics: {/p: {}}"), feed.topics())
    raw = feed.raw()
    columns = MessageColumns(
        channels={0: Channel("/p", "cdr", None)},
        channel=np.zeros(len(raw), np.int64),
        log_time_ns=np.array([message.log_time_ns for message in raw]),
        publish_time_ns=np.array([message.publish_time_ns for message in raw]),
        sequence=np.array([message.sequence for message in raw]),
        payloads=[message.payload for message in raw],
        place=np.arange(len(raw)),
    )
    assembler = Assembler(plan, feed.decoder, name="test.bag")
    found = Trace.concatenate([assembler.add(columns), assembler.finish()])
    assert found == make("topics: {/p: {}}", feed).trace


def test_a_window_has_the_samples_of_the_whole_log() -> None:
    feed = Feed()
    for tick in range(1000):
        feed.add("/p", tick * 10 * MS, point(tick))
        feed.add("/q", tick * 10 * MS + 1, point(-tick))
    text = "topics: {/p: {}, /q: {}}"
    whole = make(text, feed).trace
    part = make(text, feed, start_ns=2 * SECOND, end_ns=3 * SECOND)
    assert part.trace == whole.slice(200, 300)


def test_messages_that_do_not_fit_are_reported_and_skipped() -> None:
    feed = (
        Feed()
        .add("/p", 0, point(0))
        .add("/p", SECOND, {"x": 1.0})
        .add("/p", 2 * SECOND, {"x": "?", "y": 1})
        .add("/p", 3 * SECOND, point(3))
    )
    made = make("topics: {/p: {signals: {speed: x}, name: p}}", feed)
    assert made.trace.times_ns.tolist() == [0, 3 * SECOND]
    assert [made.centre(n, "p") for n in (0, 1)] == [(0.0, 0.0), (3.0, 0.0)]
    assert made.trace.signals["speed"].tolist() == [0.0, 3.0]
    assert [fault.partition(":")[0] for fault in made.faults] == ["test.bag"] * 2
    assert {fault.split()[3] for fault in made.faults} == {"1.000", "2.000"}


def test_a_first_message_with_an_unusable_name_affects_no_other() -> None:
    feed = Feed().add("/p", 0, point(0, id="\x00")).add("/p", 1, point(1, id="cup"))
    made = make("topics: {/p: {name: '{id}'}}", feed)
    assert (made.trace.names, len(made.faults)) == (("cup",), 1)


def paused(*, every: str = "") -> tuple[str, Feed]:
    feed = Feed()
    for tick in range(80):
        at = SECOND + tick * 100 * MS
        feed.add("/p", at, point(tick))
        if not 20 <= tick < 50:
            feed.add("/q", at + MS, point(tick))
    return f"sample: {every or '{topic: /p}'}\ntopics: {{/p: {{}}, /q: {{max_age: 10s}}}}\n", feed


def test_a_pause_of_a_topic_is_remarked_with_its_place_and_length() -> None:
    text, feed = paused()
    made = make(text, feed)
    assert made.states("q").count("?") == 0
    assert made.remarks == (
        "test.bag: /q: messages pause for 3.100 s from 2.901 s on, where one usually comes every 0.1 s;"
        " `max_gap` makes what lies there unknown",
    )


@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_what_lies_in_a_pause_longer_than_max_gap_is_unknown(batch: int) -> None:
    text, feed = paused()
    made = make(text + "max_gap: 2s", feed, batch=batch)
    assert made.states("q") == "-" + "+" * 19 + "?" * 31 + "+" * 29
    assert made.remarks[-1].endswith(
        "q is unknown in up to 31 samples, the first at 3.000 s: the topic was silent for longer than"
        " `max_gap`"
    )
    part = make(text + "max_gap: 2s", feed, batch=batch, start_ns=4 * SECOND, end_ns=7 * SECOND)
    inside = (made.trace.times_ns >= 4 * SECOND) & (made.trace.times_ns < 7 * SECOND)
    assert part.states("q") == "".join(np.array(list(made.states("q")))[inside])
    assert "?" not in make(text + "max_gap: 4s", feed, batch=batch).states("q")


def test_the_last_message_before_a_pause_is_known_at_its_own_time() -> None:
    feed = Feed()
    for tick in range(40):
        feed.add("/p", tick * SECOND // 10 + (5 * SECOND if tick >= 20 else 0), point(0))
    made = make("topics: {/p: {}}\nmax_gap: 1s", feed)
    assert made.states("p") == "+" * 40


def test_what_comes_irregularly_does_not_pause() -> None:
    feed, numbers = Feed(), np.random.default_rng(3)
    for at in np.cumsum(numbers.exponential(SECOND, 200)).astype(int).tolist():
        feed.add("/p", at, point(0))
    assert make("sample: {every: 1s}\nmax_age: forever\ntopics: {/p: {}}", feed).remarks == ()
