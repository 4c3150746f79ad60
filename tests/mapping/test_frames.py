"""Transforms into the fixed frame: chains, interpolation, and missing transforms."""

from __future__ import annotations

import json
from math import cos, pi, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import HealthCheck, given
from hypothesis import strategies as st

from bags.bag_files import write_mcap
from examples import examples
from mapping.feeding import SECOND, Feed, header, make, pose, pose_stamped, ros, tf, transform
from spatial_replay import Trace
from spatial_replay.mapping.mapped_source import MappedSource
from spatial_replay.mapping.mapping_file import parse_mapping
from spatial_replay.mapping.reading_plan import ReadingPlan
from spatial_replay.mapping.transforms import FrameTree

MS = 10**6
QUARTER = (0.0, 0.0, sin(pi / 4), cos(pi / 4))
NO_TURN = (0.0, 0.0, 0.0, 1.0)


def test_a_chain_of_transforms_places_an_object() -> None:
    feed = Feed(latched=frozenset({"/tf_static"}))
    feed.add("/tf_static", 0, tf(transform("base", "camera", (1, 0, 2), QUARTER)))
    feed.add("/tf", 0, tf(transform("map", "base", (10, 0, 0), QUARTER)))
    feed.add("/p", 1, pose_stamped(3.0, 0.0, "camera", z=1.0))
    feed.add("/tf", 2, tf(transform("map", "base", (10, 0, 0), QUARTER, time_ns=2)))
    made = make("fixed_frame: map\ntopics: {/p: {shape: {disc: 1}, height: [-1, 1]}}", feed)
    # the camera stands at (10, 1) in the map, turned by half a round
    assert made.centre(0, "p") == (7.0, 1.0)
    seen = made.trace.observation(0)
    assert seen.yaw is not None
    assert abs(seen.yaw) == pytest.approx(pi)
    assert seen.height == pytest.approx((2.0, 4.0))


def test_the_fixed_frame_may_be_a_child_and_the_chain_meet_above() -> None:
    feed = Feed(latched=frozenset({"/tf_static"}))
    feed.add("/tf_static", 0, tf(transform("world", "a", (1, 0, 0)), transform("world", "b", (0, 5, 0))))
    feed.add("/p", 1, pose_stamped(0.0, 0.0, "a"))
    assert make("fixed_frame: b\ntopics: {/p: {}}", feed).centre(0, "p") == (1.0, -5.0)


def moving(*stamps: int) -> Feed:
    """Return a base that moves at 1 m/s along x and turns by 90 degrees per second."""
    feed = Feed()
    for stamp in stamps:
        half = stamp / SECOND * pi / 4
        at = transform("map", "base", (stamp / SECOND, 0, 0), (0, 0, sin(half), cos(half)), time_ns=stamp)
        feed.add("/tf", stamp, tf(at))
    return feed


def test_transforms_are_interpolated() -> None:
    feed = moving(0, SECOND)
    feed.messages.insert(1, ("/p", SECOND // 3, pose_stamped(1.0, 0.0, "base", time_ns=SECOND // 3)))
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    x, y = made.centre(0, "p")
    assert x == pytest.approx(1 / 3 + cos(pi / 6), abs=1e-8)
    assert y == pytest.approx(sin(pi / 6), abs=1e-8)
    assert made.trace.observation(0).yaw == pytest.approx(pi / 6)


def test_an_object_is_placed_by_its_stamp_not_by_its_arrival() -> None:
    feed = moving(0, SECOND, 2 * SECOND)
    feed.add("/p", 2 * SECOND + 5, pose_stamped(0.0, 0.0, "base", time_ns=SECOND // 2))
    assert make("fixed_frame: map\ntopics: {/p: {}}", feed).centre(0, "p") == (0.5, 0.0)


def test_messages_without_a_stamp_are_placed_by_their_own_time() -> None:
    feed = moving(0, SECOND)
    feed.messages.insert(1, ("/p", SECOND // 4, {"x": 0.0, "y": 0.0}))
    assert make("fixed_frame: map\ntopics: {/p: {frame: base}}", feed).centre(0, "p") == (0.25, 0.0)


def test_there_is_no_extrapolation() -> None:
    feed = moving(SECOND, 2 * SECOND)
    for number in range(5):
        feed.add("/p", (number + 10) * SECOND, pose_stamped(0, 0, "base", time_ns=number * SECOND))
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert made.states("p") == "?++??"
    assert "/p: 3 observations are unknown" in made.remarks[0]
    assert "no transform from 'base' to 'map' at that time" in made.remarks[0]


def test_transforms_farther_apart_than_ten_seconds_do_not_count() -> None:
    feed = moving(0, 30 * SECOND)
    feed.messages.insert(1, ("/p", 15 * SECOND, pose_stamped(0, 0, "base", time_ns=15 * SECOND)))
    assert make("fixed_frame: map\ntopics: {/p: {}}", feed).states("p") == "?"


def test_objects_in_an_unknown_frame_are_unknown() -> None:
    feed = Feed().add("/p", 0, pose_stamped(1, 1, "camera")).add("/q", 1, pose_stamped(1, 1, ""))
    feed.add("/tf", 1, tf(transform("map", "odom", (0, 0, 0))))
    made = make("fixed_frame: map\nsample: {topic: /q}\ntopics: {/p: {}, /q: {}}", feed)
    assert (made.states("p"), made.states("q")) == ("?", "?")
    assert "no transform to 'map' names the frame 'camera'" in made.remarks[0]
    assert "its messages name no frame; give one with `frame`" in made.remarks[1]


def test_without_a_fixed_frame_coordinates_are_taken_as_they_are() -> None:
    feed = Feed().add("/p", 0, pose_stamped(1, 1, "camera")).add("/q", 0, pose_stamped(2, 2, "map"))
    made = make("topics: {/p: {}, /q: {}}", feed)
    assert (made.centre(0, "p"), made.centre(0, "q")) == ((1.0, 1.0), (2.0, 2.0))
    (doubt,) = made.doubts
    assert doubt.assumption == "one_frame"
    assert "/p, /q: coordinates are in the frames 'camera', 'map' and taken as they are" in doubt.text


def test_static_transforms_count_from_before_the_window() -> None:
    feed = Feed(latched=frozenset({"/tf_static"}))
    feed.add("/tf_static", 0, tf(transform("map", "base", (5, 0, 0))))
    for tick in range(100, 110):
        feed.add("/p", tick * SECOND, pose_stamped(1, 0, "base", time_ns=tick * SECOND))
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed, start_ns=105 * SECOND)
    assert made.states("p") == "+++++"
    assert made.centre(0, "p") == (6.0, 0.0)


def test_a_frame_may_change_its_parent() -> None:
    feed = Feed(latched=frozenset({"/tf_static"}))
    feed.add(
        "/tf_static", 0, tf(transform("map", "left", (0, 10, 0)), transform("map", "right", (0, -10, 0)))
    )
    for tick, parent in enumerate(["left", "left", "right", "right"], start=1):
        feed.add("/tf", tick * SECOND, tf(transform(parent, "cup", (tick, 0, 0), time_ns=tick * SECOND)))
        feed.add("/p", tick * SECOND + 1, pose_stamped(0, 0, "cup", time_ns=tick * SECOND))
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert [made.centre(n, "p") for n in range(4)] == [(1, 10), (2, 10), (3, -10), (4, -10)]


def test_a_frame_that_is_fixed_to_a_moving_one_moves_with_it() -> None:
    feed = Feed(latched=frozenset({"/tf_static"}))
    feed.add("/tf_static", 0, tf(transform("base", "camera", (1, 0, 0)), transform("map", "door", (0, 3, 0))))
    for tick in range(1, 7):
        feed.add("/tf", tick * SECOND, tf(transform("map", "base", (tick, 0, 0), time_ns=tick * SECOND)))
        feed.add("/tick", tick * SECOND, {})
    text = "fixed_frame: map\nmax_age: 1s\nsample: {topic: /tick}\ntopics: {/tf_static: {}}"
    made = make(text, feed)
    assert [made.centre(n, "camera") for n in range(6)] == [(tick + 1, 0) for tick in range(1, 7)]
    assert made.states("door") == "++++++"
    assert made.remarks == ()
    assert make(text, feed, batch=2).trace == made.trace
    assert make(text, feed, start_ns=4 * SECOND).trace == made.trace.slice(3, 6)


def locked(time_ns: int, **more: Any) -> Any:
    """Return a cube of one metre that stays at the origin of the base."""
    size = ros("geometry_msgs/Vector3", x=1.0, y=1.0, z=1.0)
    return ros(
        "visualization_msgs/Marker",
        header=header("base", time_ns),
        ns="zone",
        type=1,
        pose=pose(0, 0),
        scale=size,
        frame_locked=True,
        **more,
    )


def test_a_marker_that_is_locked_to_its_frame_moves_with_it() -> None:
    feed = moving(*(tick * SECOND for tick in range(6)))
    feed.add("/marker", SECOND + 1, locked(SECOND))
    for tick in range(1, 12):
        feed.add("/tick", tick * SECOND // 2, {})
    feed.add("/marker", 4 * SECOND + 1, locked(4 * SECOND, action=2))
    feed.messages.sort(key=lambda message: message[1])
    text = "fixed_frame: map\nsample: {topic: /tick}\ntopics: {/marker: {}}"
    made = make(text, feed)
    assert made.states("zone_0") == "--++++++---"
    assert [made.centre(n, "zone_0")[0] for n in range(2, 8)] == [1.5, 2, 2.5, 3, 3.5, 4]
    assert make(text, feed, batch=2).trace == made.trace
    assert make(text, feed, start_ns=3 * SECOND).trace == made.trace.slice(5, 11)


def test_a_locked_marker_is_unknown_once_its_frame_is_silent_for_longer_than_max_age() -> None:
    feed = moving(0, SECOND, 2 * SECOND)
    feed.add("/marker", 1, locked(0))
    for tick in range(1, 9):
        feed.add("/tick", tick * SECOND // 2, {})
    feed.messages.sort(key=lambda message: message[1])
    made = make("fixed_frame: map\nsample: {topic: /tick}\ntopics: {/marker: {}}", feed)
    assert made.states("zone_0") == "++++++??"
    assert "/marker: 2 observations are unknown, the first at 3.500 s: no transform" in made.remarks[0]


def test_an_entity_that_is_locked_to_its_frame_moves_with_it() -> None:
    update = SceneUpdate()
    entity = update.entities.add(frame_id="base", id="zone", frame_locked=True)
    cube = entity.cubes.add()
    cube.pose.orientation.w = cube.size.x = cube.size.y = cube.size.z = 1.0
    feed = moving(0, SECOND, 2 * SECOND).add("/scene", 1, update)
    feed.add("/tick", SECOND, {}).add("/tick", 2 * SECOND, {})
    feed.messages.sort(key=lambda message: message[1])
    made = make("fixed_frame: map\nsample: {topic: /tick}\ntopics: {/scene: {}}", feed)
    assert [made.centre(n, "zone")[0] for n in range(2)] == [1, 2]


def test_nothing_is_interpolated_over_more_than_max_age() -> None:
    feed = moving(0, SECOND // 2, 4 * SECOND, 4 * SECOND + SECOND // 2)
    for tick in range(10):
        at = tick * SECOND // 2
        feed.add("/p", at, pose_stamped(0, 0, "base", time_ns=at))
    feed.messages.sort(key=lambda message: message[1])
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert made.states("p") == "++??????++"
    assert any(
        "the transforms of 'base' pause for up to 3.500 s, longest from 0.500 s on, longer than max_age"
        in text
        for text in made.remarks
    )
    assert make("fixed_frame: map\ntopics: {/p: {max_age: 4s}}", feed).states("p") == "++++++++++"


def test_frames_in_a_cycle_make_objects_unknown() -> None:
    feed = Feed(latched=frozenset({"/tf_static"}))
    feed.add("/tf_static", 0, tf(transform("a", "b", (1, 0, 0)), transform("b", "a", (1, 0, 0))))
    feed.add("/tf_static", 0, tf(transform("map", "c", (1, 0, 0)))).add("/p", 0, pose_stamped(0, 0, "a"))
    assert make("fixed_frame: map\ntopics: {/p: {}}", feed).states("p") == "?"


def test_transforms_in_foxglove_messages_and_leading_slashes() -> None:
    moved = FrameTransform(parent_frame_id="/map", child_frame_id="/base")
    moved.translation.x = 2.0
    moved.rotation.w = 1.0
    later = FrameTransform()
    later.CopyFrom(moved)
    later.timestamp.seconds = 1
    feed = Feed().add("/frames", 0, moved).add("/p", 1, pose_stamped(1, 0, "base", time_ns=1))
    feed.add("/frames", SECOND, later)
    assert make("fixed_frame: /map\ntopics: {/p: {}}", feed).centre(0, "p") == (3.0, 0.0)


def test_a_covariance_turns_with_its_frame() -> None:
    covariance = np.zeros((6, 6))
    covariance[2, 2] = 0.25
    tipped: Any = (sin(pi / 4), 0.0, 0.0, cos(pi / 4))
    content = {
        "frame": "arm",
        "position": {"x": 0.0, "y": 0.0, "z": 0.0},
        "covariance": covariance.ravel().tolist(),
    }
    feed = Feed(latched=frozenset({"/tf_static"}))
    feed.add("/tf_static", 0, tf(transform("map", "arm", (0, 0, 0), tipped))).add("/p", 0, content)
    keys = "frame: {field: frame}, uncertainty: {covariance: covariance, sigmas: 1}"
    text = f"fixed_frame: map\ntopics: {{/p: {{{keys}}}}}"
    assert make(text, feed).trace.observation(0).uncertainty == pytest.approx(0.5)


def test_old_transforms_are_dropped_except_the_last() -> None:
    tree = FrameTree()
    for tick in range(100):
        pose = (float(tick), 0.0, 0.0, *NO_TURN)
        tree.add("base", "map", pose, stamp_ns=tick, clock_ns=tick, log_ns=tick, is_static=False)
    tree.forget_before(50)
    known = tree.between("map", "base", np.array([10, 50, 60]), by_stamp=True).known
    assert known.tolist() == [False, True, True]
    tree.forget_before(1000)
    assert tree.between("map", "base", np.array([99]), by_stamp=True).known.tolist() == [True]


def static(*at_ns: int, places: tuple[float, ...] = (10.0, 15.0), stamped: bool = True) -> Feed:
    """Return a feed with static transforms of `odom` at some times, one place after the other."""
    feed = Feed(latched=frozenset({"/tf_static"}))
    for time_ns, x in zip(at_ns, places, strict=True):
        feed.add("/tf_static", time_ns, tf(transform("map", "odom", (x, 0, 0), time_ns=time_ns * stamped)))
    return feed


@pytest.mark.parametrize("stamped", [True, False])
def test_a_static_transform_counts_until_the_next_and_the_first_one_before_it_too(stamped: bool) -> None:
    feed = static(2 * SECOND, 4 * SECOND, stamped=stamped)
    for tick in range(1, 6):
        feed.add("/p", tick * SECOND, pose_stamped(1, 0, "odom", time_ns=tick * SECOND))
    feed.messages.sort(key=lambda message: message[1])
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert [made.centre(tick, "p")[0] for tick in range(5)] == [11, 11, 11, 16, 16]
    assert made.remarks == (
        "test.bag: the static transform of 'odom' in 'map' changes from (10, 0, 0) to (15, 0, 0), the second"
        " from 4.000 s on: the newest counts",
    )


def test_a_static_transform_with_an_older_stamp_counts_from_its_arrival() -> None:
    feed = static(2 * SECOND, 4 * SECOND)
    late = transform("map", "odom", (20, 0, 0), time_ns=SECOND)
    for tick in range(1, 8):
        feed.add("/p", tick * SECOND, pose_stamped(0, 0, "odom", time_ns=tick * SECOND))
    feed.add("/tf_static", 6 * SECOND, tf(late))
    feed.messages.sort(key=lambda message: message[1])
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert [made.centre(tick, "p")[0] for tick in range(7)] == [10, 10, 10, 15, 15, 20, 20]


def test_two_parents_are_remarked_with_both_places() -> None:
    feed = Feed().add("/tf", 0, tf(transform("map", "odom", (0, 0, 0))))
    for tick in range(1, 5):
        at = tick * SECOND
        feed.add("/tf", at, tf(transform("map", "odom", (0, 0, 0), time_ns=at)))
        feed.add("/tf", at, tf(transform(("map", "odom")[tick % 2], "base", (50 * tick, 0, 0), time_ns=at)))
        feed.add("/p", at, pose_stamped(0, 0, "base", time_ns=at))
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert [made.centre(n, "p")[0] for n in range(4)] == [50, 100, 150, 200]
    assert made.remarks == (
        "test.bag: frame 'base' has two parents, 'odom' at (50, 0, 0) and 'map' at (100, 0, 0), the second"
        " from 2.000 s on: the newest counts",
    )


def test_a_second_parent_that_reaches_nothing_is_remarked_after_a_place_that_changed() -> None:
    feed = static(2 * SECOND, 4 * SECOND)
    feed.add("/tf_static", 5 * SECOND, tf(transform("drift", "odom", (9, 0, 0), time_ns=5 * SECOND)))
    for tick in range(1, 7):
        feed.add("/p", tick * SECOND, pose_stamped(0, 0, "odom", time_ns=tick * SECOND))
    feed.messages.sort(key=lambda message: message[1])
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert any("'odom' in 'map' changes from" in each for each in made.remarks)
    assert any("'odom' has two parents, 'map' at (15, 0, 0) and 'drift'" in each for each in made.remarks)
    assert any("no transform from 'odom' to 'map'" in each for each in made.remarks)


def test_moving_transforms_count_beside_a_static_one_of_the_same_frame() -> None:
    feed = static(SECOND, places=(10.0,))
    for tick in range(1, 7):
        feed.add("/p", tick * SECOND, pose_stamped(0, 0, "odom", time_ns=tick * SECOND))
    for tick in (3, 4, 5, 6):
        feed.add("/tf", tick * SECOND, tf(transform("map", "odom", (tick, 0, 0), time_ns=tick * SECOND)))
    feed.messages.sort(key=lambda message: message[1])
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert [made.centre(tick, "p")[0] for tick in range(6)] == [10, 10, 3, 4, 5, 6]
    assert made.remarks == (
        "test.bag: frame 'odom' is sent static and moving, in 'map' at (10, 0, 0) and 'map' at (3, 0, 0),"
        " the second from 3.000 s on: the moving ones count",
    )


def test_two_publishers_of_a_frame_are_remarked_with_both_places() -> None:
    feed = Feed()
    for tick in range(20):
        for x in (0.1 * tick, 50 + 0.1 * tick):
            at = tick * SECOND // 10 + int(x >= 50)
            feed.add("/tf", at, tf(transform("map", "base", (x, 0, 0), time_ns=at)))
        feed.add("/p", at, pose_stamped(0, 0, "base", time_ns=at))
    (remark,) = make("fixed_frame: map\ntopics: {/p: {}}", feed).remarks
    assert "frame 'base' jumps in 'map' by up to 50 and back, 38 times" in remark
    assert "from (0, 0, 0) to (50, 0, 0) at 0.000 s" in remark


@pytest.mark.parametrize(
    ("places", "every"), [((0, 0.8), 1), ((0, 0.8), 2), ((0, 0.8), 5), ((0, 3, -3), 1), ((0, 0, 3, 3), 1)]
)
def test_several_publishers_a_few_steps_apart_are_remarked(places: tuple[float, ...], every: int) -> None:
    feed = Feed()
    for tick in range(200):
        at = tick * SECOND // 10
        for number, apart in enumerate(places if tick % every == 0 else places[:1]):
            moved = transform("map", "base", (0.1 * tick + apart, 0, 0), time_ns=at + number)
            feed.add("/tf", at + number, tf(moved))
        feed.add("/p", at + len(places), pose_stamped(0, 0, "base", time_ns=at))
    (remark,) = make("fixed_frame: map\ntopics: {/p: {}}", feed).remarks
    assert "frame 'base' jumps in 'map' by up to " in remark


@pytest.mark.parametrize("noise", [0.05, 0.2, 1.0])
@pytest.mark.parametrize("step", [0.0, 0.1])
@pytest.mark.parametrize("is_wide", [False, True])
def test_a_frame_that_trembles_has_one_publisher(noise: float, step: float, is_wide: bool) -> None:
    feed, numbers = Feed(), np.random.default_rng(1)
    for tick in range(300):
        at = tick * SECOND // 10
        place = (step * tick, *(noise * numbers.normal(size=2) * [1, is_wide]))
        feed.add("/tf", at, tf(transform("map", "base", place, time_ns=at)))
        feed.add("/p", at, pose_stamped(0, 0, "base", time_ns=at))
    assert make("fixed_frame: map\ntopics: {/p: {}}", feed).remarks == ()


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (transform("map", "base", (7, 0, 0), (0, 0, 0, 0)), "its quaternion has the length 0"),
        (transform("map", "base", (7, 0, 0), (0, 0, 0, 0.5)), "its quaternion has the length 0.5"),
        (transform("map", "base", (float("nan"), 0, 0)), "not all of its numbers are finite"),
        (transform("base", "base", (7, 0, 0)), "a frame cannot be its own parent"),
        (transform("", "base", (7, 0, 0)), "it has no name for the frame or its parent"),
        (transform("map", "", (7, 0, 0)), "it has no name for the frame or its parent"),
    ],
)
def test_transforms_that_tf2_ignores_are_counted(wrong: Any, reason: str) -> None:
    feed = Feed()
    for tick in range(3):
        right = transform("map", "base", (1, 0, 0), time_ns=tick * SECOND)
        wrong.header.stamp.sec = tick
        feed.add("/tf", tick * SECOND, tf(right)).add("/tf", tick * SECOND, tf(wrong))
        feed.add("/p", tick * SECOND, pose_stamped(0, 0, "base", time_ns=tick * SECOND))
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert [made.centre(n, "p") for n in range(3)] == [(1, 0)] * 3
    (remark,) = made.remarks
    assert "3 transforms were left out" in remark and reason in remark


def test_a_loop_of_frames_is_remarked() -> None:
    feed = Feed(latched=frozenset({"/tf_static"}))
    feed.add("/tf_static", 0, tf(transform("a", "b", (1, 0, 0)), transform("b", "a", (1, 0, 0))))
    feed.add("/tf_static", 0, tf(transform("map", "c", (1, 0, 0)))).add("/p", 0, pose_stamped(0, 0, "a"))
    remarks = make("fixed_frame: map\ntopics: {/p: {}}", feed).remarks
    assert any("frames form a loop, 'a' in 'b' in 'a'" in remark for remark in remarks)


ticks = st.integers(10, 50)
"""Tenths of a second."""


@given(
    statics=st.lists(st.tuples(ticks, st.integers(1, 3), st.booleans()), min_size=1, max_size=4),
    moving=st.lists(st.tuples(ticks, st.integers(0, 9)), max_size=20),
    delay=st.integers(0, 9),
    window=st.tuples(ticks, ticks).map(sorted),
)
@examples(40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_window_of_a_log_with_frames_is_a_slice_of_the_whole(
    tmp_path: Path,
    statics: list[tuple[int, int, bool]],
    moving: list[tuple[int, int]],
    delay: int,
    window: list[int],
) -> None:
    tenth = SECOND // 10

    def moved(parent: str, child: str, x: float, stamp: int) -> dict[str, Any]:
        pose = {"translation": {"x": x, "y": 0, "z": 0}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}
        time = {"sec": stamp // SECOND, "nsec": stamp % SECOND}
        return {"parent_frame_id": parent, "child_frame_id": child, "timestamp": time, **pose}

    sent = [
        ("/tf_static", t * tenth, moved("map", "odom", x, t * tenth * stamped)) for t, x, stamped in statics
    ]
    sent += [("/tf", (t + delay) * tenth, moved("odom", "base", x, t * tenth)) for t, x in moving]
    for t in range(10, 51):
        stamp = {"sec": t * tenth // SECOND, "nanosec": t * tenth % SECOND}
        sent.append(("/p", t * tenth + 1, {"x": 1, "y": 0, "header": {"frame_id": "base", "stamp": stamp}}))
    sent.sort(key=lambda message: message[1])
    schemas = {"/p": "", "/tf": "foxglove.FrameTransform", "/tf_static": "foxglove.FrameTransform"}
    channels = [(topic, "json", name, "jsonschema" if name else "", b"{}") for topic, name in schemas.items()]
    messages = [(topic, at, json.dumps(content).encode()) for topic, at, content in sent]
    log = write_mcap(tmp_path / "log.mcap", channels, messages, chunk_bytes=300)
    mapping = parse_mapping("fixed_frame: map\nmax_age: 2s\ntopics: {/p: {shape: {disc: 1}}}", "m.yaml")
    source = MappedSource(log, "MCAP", mapping=mapping)
    whole = Trace.concatenate([block.trace for block in source.iter_blocks()])
    start_ns, end_ns = (each * tenth for each in window)
    part = Trace.concatenate([block.trace for block in source.iter_blocks(start_ns, end_ns)])
    inside = np.flatnonzero((whole.times_ns >= start_ns) & (whole.times_ns < end_ns))
    if len(inside):
        assert part == whole.slice(int(inside[0]), int(inside[-1]) + 1)
    else:
        assert len(part) == 0


def restarted(*, begin_ns: int = 1_700_000_000 * SECOND, before: int = 150, after: int = 200) -> Feed:
    """Return two runs of a simulation: the base goes away from 0 in the first, back from 100 in the second.

    Its first transform comes half a second after the restart; those of `odom` are dated ahead.
    """
    feed = Feed(latched=frozenset({"/tf_static"}))
    feed.add("/tf_static", begin_ns, tf(transform("base", "cam", (0, 5, 0))))
    for number in range(before + after):
        tick = number if number < before else number - before
        at, stamp = begin_ns + number * SECOND // 10, tick * SECOND // 10
        x = tick if number < before else 100 - tick
        feed.add("/p", at + 1, pose_stamped(0, 0, "cam", time_ns=stamp))
        if number < before or tick >= 5:
            feed.add("/tf", at + 2, tf(transform("odom", "base", (x, 0, 0), time_ns=stamp)))
        if tick % 5 == 0:
            ahead = stamp + 6 * SECOND // 10
            feed.add("/tf", at + 3, tf(transform("map", "odom", (0, 0, 0), time_ns=ahead)))
    return feed


RESTARTED = "fixed_frame: map\ntopics: {/p: {}}"


def test_transforms_of_a_run_place_nothing_of_the_next_run() -> None:
    made = make(RESTARTED, restarted())
    assert made.states("p") == 6 * "?" + 144 * "+" + 6 * "?" + 194 * "+"
    assert [made.centre(n, "p")[0] for n in range(6, 150)] == list(range(6, 150))
    assert [made.centre(n, "p")[0] for n in range(156, 350)] == [100 - tick for tick in range(6, 200)]
    restart, missing = made.remarks
    assert "the stamps of transforms step back by 14.500 s at 1700000015.000 s, as when" in restart
    assert "cut the log there to evaluate each run by itself" in restart
    assert "/p: 12 observations are unknown" in missing


@pytest.mark.parametrize("batch", [1, 7, 333])
def test_runs_do_not_depend_on_windows_and_blocks(batch: int) -> None:
    feed = restarted()
    whole, begin_ns = make(RESTARTED, feed).trace, feed.messages[0][1]
    assert make(RESTARTED, feed, batch=batch).trace == whole
    for first, last in ((100, 160), (150, 156), (152, 350), (160, 350)):
        window = {"start_ns": begin_ns + first * SECOND // 10, "end_ns": begin_ns + last * SECOND // 10}
        assert make(RESTARTED, feed, batch=batch, **window).trace == whole.slice(first, last)


def test_transforms_of_the_next_run_place_nothing_before_a_jump_that_ends_the_log() -> None:
    feed = Feed()
    for number in range(40):
        # in the second run, transforms come first
        tick, at = number % 20 + 1, number * SECOND // 10
        feed.add("/tf", at, tf(transform("map", "base", (number, 0, 0), time_ns=tick * SECOND // 10)))
        if number not in range(20, 25):
            feed.add("/p", at + 1, pose_stamped(0, 0, "base", time_ns=tick * SECOND // 10))
    made = make("fixed_frame: map\nclock: header\ntopics: {/p: {}}", feed, on_time_jump="split")
    assert [made.centre(n, "p")[0] for n in range(20)] == list(range(20))


def test_two_clocks_that_take_turns_are_no_restart() -> None:
    feed = Feed()
    for tick in range(200):
        at = tick * SECOND // 10
        feed.add("/tf", at, tf(transform("map", "base", (tick, 0, 0), time_ns=at + 30 * SECOND)))
        feed.add("/tf", at, tf(transform("map", "base", (tick, 0, 0), time_ns=at)))
        feed.add("/p", at, pose_stamped(0, 0, "base", time_ns=at))
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert made.states("p") == 200 * "+"
    assert not any("step back" in remark for remark in made.remarks)


def test_a_static_transform_counts_from_its_recording_where_stamps_are_those_of_a_simulation() -> None:
    feed, begin_ns = Feed(latched=frozenset({"/tf_static"})), 1_700_000_000 * SECOND
    for tick in range(12):
        # the simulation restarts after six seconds, and its second static transform has no stamp
        at, stamp = begin_ns + tick * SECOND, tick % 6 * SECOND + 1
        if tick in (0, 3, 6):
            stamped = transform("map", "odom", (tick, 0, 0), time_ns=0 if tick == 3 else stamp)
            feed.add("/tf_static", at, tf(stamped))
        feed.add("/p", at + 1, pose_stamped(0, 0, "odom", time_ns=stamp))
    made = make("fixed_frame: map\ntopics: {/p: {}}", feed)
    assert [made.centre(n, "p")[0] for n in range(12)] == 3 * [0] + 3 * [3] + 6 * [6]


def test_stamps_of_transforms_that_step_back_are_remarked() -> None:
    feed = Feed()
    for tick in range(40):
        at = tick * SECOND // 10
        stamp = at - (SECOND * 11 // 20 if tick >= 20 else 0)
        moved = [transform("map", name, (0.1 * tick, 0, 0), time_ns=stamp) for name in ("base", "arm")]
        feed.add("/tf", at, tf(*moved))
        feed.add("/p", at, pose_stamped(0, 0, "base", time_ns=stamp))
    (remark,) = make("fixed_frame: map\ntopics: {/p: {}}", feed).remarks
    assert "the stamps of 'base' and 1 other frame step back by 0.450 s at 2.000 s: they are sorted" in remark


def test_transforms_of_several_robots_are_remarked_without_a_fixed_frame() -> None:
    feed = Feed()
    for robot in ("/one", "/two"):
        feed.add(f"{robot}/tf", 0, tf(transform("odom", "base", (0, 0, 0), time_ns=0)))
        feed.add(f"{robot}/p", 0, pose_stamped(0, 0, "odom"))
    text = "topics: {/one/p: {}, /two/p: {}}"
    (remark,) = ReadingPlan.of(parse_mapping(text), feed.topics()).remarks
    assert "transforms come on /one/tf and /two/tf, so frames of one name may be of two robots" in remark
    assert ReadingPlan.of(parse_mapping(f"fixed_frame: odom\n{text}"), feed.topics()).remarks == ()


def test_simulated_time_is_remarked_where_log_times_count() -> None:
    feed = Feed(types={"/clock": "rosgraph_msgs/msg/Clock"}).add("/p", SECOND, pose_stamped(0, 0, time_ns=1))
    text = "topics: {/p: {}}"
    (remark,) = ReadingPlan.of(parse_mapping(text), feed.topics()).remarks
    assert remark.startswith("/clock has simulated time, which may run at another rate than the recording")
    assert ReadingPlan.of(parse_mapping(f"clock: header\n{text}"), feed.topics()).remarks == ()


def test_detections_are_placed_by_their_own_headers() -> None:
    def detection(name: str, frame: str, time_ns: int = 0) -> Any:
        box = ros("vision_msgs/BoundingBox3D", center=pose(1.0, 0.0))
        return ros("vision_msgs/Detection3D", header=header(frame, time_ns), id=name, bbox=box)

    feed = moving(0, SECOND)
    feed.latched = frozenset({"/tf_static"})
    feed.add("/tf_static", 0, tf(transform("map", "mast", (20, 0, 0))))
    listed = [
        detection("a", "mast"),
        detection("b", ""),
        detection("c", "base", SECOND),
        detection("d", "base"),
    ]
    message = ros("vision_msgs/Detection3DArray", header=header("map", SECOND // 2), detections=listed)
    feed.add("/d", SECOND, message)
    made = make("fixed_frame: map\ntopics: {/d: {name: '{id}'}}", feed)
    assert [made.centre(0, name) for name in "abc"] == [(21.0, 0.0), (1.0, 0.0), (1.0, 1.0)]
    # d has the time of its message, when the base had turned by half as much
    assert made.centre(0, "d") == pytest.approx((0.5 + cos(pi / 4), sin(pi / 4)))
    # without a fixed frame, all frames of the topic are named
    doubts = make("topics: {/d: {name: '{id}'}}", feed).doubts
    assert any("'base', 'map', 'mast'" in doubt.text for doubt in doubts)


def test_floors_are_frames_without_a_way_between_them() -> None:
    feed = Feed()
    robots = [
        {"name": name, "level": level, "x": 1.0, "y": 0.0} for name, level in (("a", "L1"), ("b", "L2"))
    ]
    feed.add("/fleet", SECOND, {"robots": robots})
    entry = "{objects: 'robots[*]', name: '{name}', position: [x, y], frame: {field: level}}"
    made = make(f"fixed_frame: L1\ntopics: {{/fleet: {entry}}}", feed)
    assert (made.states("a"), made.states("b")) == ("+", "?")
    assert any("no transform to 'L1' names the frame 'L2'" in remark for remark in made.remarks)
