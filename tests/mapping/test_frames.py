"""Transforms into the fixed frame: chains, interpolation, and missing transforms."""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

from mapping.feeding import SECOND, Feed, make, pose_stamped, tf, transform
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
    assert "coordinates are in the frames 'camera', 'map' and taken as they are" in made.remarks[0]


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
        tree.add("base", "map", pose, stamp_ns=tick, clock_ns=tick, is_static=False)
    tree.forget_before(50)
    known = tree.between("map", "base", np.array([10, 50, 60]), by_stamp=True).known
    assert known.tolist() == [False, True, True]
    tree.forget_before(1000)
    assert tree.between("map", "base", np.array([99]), by_stamp=True).known.tolist() == [True]
