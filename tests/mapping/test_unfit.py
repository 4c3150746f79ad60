"""Messages that do not fit a mapping: a few are lost; if none fits, the mapping is wrong."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping.feeding import SECOND, Feed, make, pose_stamped, tf, transform
from spatial_replay import UsageError
from spatial_replay.bags.decoders import Topic
from spatial_replay.mapping.assemble import Assembler
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import ReadingPlan

HUGE = 10**400


@pytest.mark.parametrize("batch", [1, 1000])
@pytest.mark.parametrize("odd", [{"v": HUGE, "x": 0, "y": 0}, {"v": {}, "x": 0, "y": 0}, [], {"x": 1}])
@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("head", ["", "signals: {s: v}", "position: [v, y], signals: {s: v}"])
def test_a_message_that_does_not_fit_is_a_fault_at_any_place(
    odd: object, place: int, batch: int, head: str
) -> None:
    messages: list[object] = [{"v": 1.0, "x": 0.0, "y": 0.0}] * 3
    messages[place] = odd
    feed = Feed(types={"/a": "any/Thing"})
    for number, message in enumerate(messages):
        feed.add("/a", number * SECOND, message)
    made = make(f"topics: {{/a: {{{head or 'position: [v, y]'}}}}}", feed, batch=batch)
    assert len(made.faults) == 1
    assert f"/a at {place}.000 s" in made.faults[0]


@pytest.mark.parametrize("count", [1, 5, 500])
@pytest.mark.parametrize("entry", ["position: [u, y]", "signals: {s: u}", "signals: {s: y}"])
def test_a_mapping_that_fits_no_message_is_an_error(count: int, entry: str) -> None:
    feed = Feed(types={"/a": "any/Thing"})
    for number in range(count):
        feed.add("/a", number * SECOND, {"v": 1.0, "y": HUGE})
    with pytest.raises(UsageError, match=r"test\.yaml: topics\./a: [uy]: "):
        make(f"topics: {{/a: {{{entry}}}}}", feed)


def test_a_step_that_is_far_too_short_is_an_error() -> None:
    feed = Feed(types={"/a": "any/Thing"})
    for number in range(300):
        feed.add("/a", number * SECOND // 20, {"x": 0.0, "y": 0.0})
    with pytest.raises(UsageError, match=r"test\.yaml: sample\.every: .*longer step"):
        make("sample: {every: 1us}\ntopics: {/a: {}}", feed)


@pytest.mark.parametrize(("count", "faults"), [(None, 1), (3, 1), (0, 0)])
def test_transforms_that_cannot_be_decoded_are_reported(count: int | None, faults: int) -> None:
    reason = "topic '/tf': the definition is missing"
    lost = Topic("/tf", "tf2_msgs/msg/TFMessage", "cdr", count=count, unreadable=reason)
    topics = [Topic("/p", "geometry_msgs/msg/PoseStamped", "cdr"), lost]
    for head, expected in (("fixed_frame: map\n", faults), ("", 0)):
        plan = ReadingPlan.of(parse_mapping(head + "topics: {/p: {}}"), topics)
        assert "/tf" not in plan.topics
        faults_of_log = Assembler(plan, Feed().decoder, name="test.bag").take_faults()
        assert len(faults_of_log) == expected
        assert all(each.count("/tf") == 1 and "definition is missing" in each for each in faults_of_log)


def test_remarks_count_the_window_only() -> None:
    feed = Feed()
    for number in range(10):
        frame = "map" if number < 5 else "odom"
        feed.add("/p", number * SECOND, pose_stamped(1.0, 2.0, frame))
    text = "fixed_frame: map\ntopics: {/p: {}}"
    assert "5 observations are unknown" in make(text, feed).remarks[0]
    assert make(text, feed, end_ns=4 * SECOND).remarks == ()


def test_a_fault_has_the_time_of_its_own_message() -> None:
    feed = Feed(types={"/a": "any/Thing"})
    # the second message has a bad signal, the fourth a bad object
    for number, (v, x) in enumerate([(1.0, 0.0), ({}, 0.0), (1.0, 0.0), (1.0, [])]):
        feed.add("/a", number * SECOND, {"v": v, "x": x, "y": 0.0})
    made = make("topics: {/a: {position: [x, y], signals: {s: v}}}", feed)
    assert [fault.split(" s: ")[0] for fault in made.faults] == [
        f"test.bag: /a at {number}.000" for number in (1, 3)
    ]
    assert made.trace.times_ns.tolist() == [0, 2 * SECOND]


def test_a_fixed_frame_that_the_log_lacks_is_refused_with_the_frames_there_are() -> None:
    feed = Feed().add("/tf", 0, tf(transform("map", "odom", (0, 0, 0))))
    feed.add("/p", 1, pose_stamped(1, 0, "odom")).add("/p", 2, pose_stamped(1, 0, "odom"))
    with pytest.raises(
        UsageError, match=r"has no frame 'mapp'; did you mean 'map'\? its frames are map, odom"
    ):
        make("fixed_frame: mapp\ntopics: {/p: {}}", feed)
    # a window may lack what the log has
    assert make("fixed_frame: other\ntopics: {/p: {}}", feed, start_ns=1).states("p") == "??"
    # the frame of the objects themselves needs no transform
    alone = Feed().add("/p", 1, pose_stamped(1, 0, "odom"))
    assert make("fixed_frame: odom\ntopics: {/p: {}}", alone).states("p") == "+"


ZEROS = (
    "topics: {/w: {objects: 'pose[*]', name: '{name}{id}', position: position, orientation: q, missing: 0}}"
)


def without_zeros(value: Any) -> Any:
    """The message as proto3 writes it to JSON: without numbers that are 0, and empty lists."""
    if isinstance(value, dict):
        return {key: without_zeros(each) for key, each in value.items() if each not in (0, [])}
    return [without_zeros(each) for each in value] if isinstance(value, list) else value


@given(
    st.lists(
        st.lists(st.tuples(*[st.sampled_from([0, 1, -2.5])] * 2, st.integers(0, 3)), max_size=3), max_size=4
    )
)
def test_messages_without_their_zeros_read_like_those_with_them(
    messages: list[list[tuple[float, float, int]]],
) -> None:
    made = []
    for form in (lambda message: message, without_zeros):
        feed = Feed(types={"/w": "gz.msgs.Pose_V"})
        # the first message has one object, by which the paths are known
        for time, objects in enumerate([[(1, 0, 9)], *messages]):
            poses = [
                {"name": f"n{k}_", "id": number, "position": {"x": x, "y": y, "z": 0}, "q": {"w": 1, "z": 0}}
                for k, (x, y, number) in enumerate(objects)
            ]
            feed.add("/w", time * SECOND, form({"pose": poses, "header": {"seq": 0}}))
        made.append(make(ZEROS, feed))
    assert made[0].trace == made[1].trace
    assert made[0].faults == made[1].faults == ()


def test_a_position_that_no_message_has_is_an_error_even_where_zeros_are_left_out() -> None:
    feed = Feed(types={"/w": "gz.msgs.Pose_V"}).add("/w", 0, {"pose": [{"name": "a", "position": {"x": 1}}]})
    for position in ("positoin", "[u, v]"):
        with pytest.raises(UsageError, match="none of its messages has"):
            make(f"topics: {{/w: {{objects: 'pose[*]', position: {position}, missing: 0}}}}", feed)
    # without the key, the error names it
    with pytest.raises(UsageError, match="add `missing: 0`"):
        make("topics: {/w: {objects: 'pose[*]', name: '{name}', position: position}}", feed)


def test_stamps_and_signals_may_lack_zeros_too() -> None:
    feed = Feed(types={"/w": "a/Thing"})
    for seconds, stamp in enumerate(({"nsec": 5}, {"sec": "1"}, {"sec": "2", "nsec": 7})):
        speed = {"speed": seconds} if seconds else {}
        feed.add("/w", seconds * SECOND, {"header": {"stamp": stamp}, "position": {"x": 1}, **speed})
    text = "clock: header\ntopics: {/w: {name: a, position: position, missing: 0, signals: {speed: speed}}}"
    made = make(text, feed)
    assert made.trace.times_ns.tolist() == [5, SECOND, 2 * SECOND + 7]
    assert made.trace.signals["speed"].tolist() == [0, 1, 2]
