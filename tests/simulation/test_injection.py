"""Injected failures happen, and only when they should."""

from __future__ import annotations

import pytest

from simulation.worlds import world
from spatial_replay import UsageError
from spatial_replay.simulation.world import Injection

GOAL = (0.36, -0.2)


def test_a_drop_makes_the_robot_lose_what_it_carries() -> None:
    with world("pick-place", inject=("drop@5s",)) as (made, seen):
        done = made.place("mug", *GOAL)
        assert not done.succeeded
        assert done.reason.startswith("mug slipped out of the fingers")
        wide = [sample.time_ns for sample in seen if sample.signals["finger_width"] > 0.07]
        assert any(5 * 10**9 < time_ns < 6 * 10**9 for time_ns in wide)


def test_slippery_fingers_lose_a_heavy_object() -> None:
    with world("pick-place", inject=("slip",)) as (made, _):
        done = made.place("crackerbox", 0.45, -0.3)
        assert not done.succeeded
        assert "crackerbox" in done.reason


def test_a_failure_that_is_over_has_no_effect() -> None:
    with world("pick-place", inject=("drop@0s",)) as (made, _):
        assert made.place("mug", *GOAL).succeeded


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("drop@7s", Injection("drop", 7 * 10**9)),
        ("slip@2500ms", Injection("slip", 2500 * 10**6)),
        ("slip", Injection("slip")),
    ],
)
def test_an_injection_is_parsed(text: str, expected: Injection) -> None:
    assert Injection.parse(text) == expected
    assert Injection.parse(str(expected)) == expected


@pytest.mark.parametrize("text", ["", "drop", "drop@", "drop@7", "fall@7s", "slip@-1s", "drop@7s "])
def test_an_invalid_injection_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="write drop@7s"):
        Injection.parse(text)


def test_a_drop_is_refused_in_a_world_without_grasping() -> None:
    with pytest.raises(UsageError, match="nothing is held in push"), world("push", inject=("drop@1s",)):
        pass
