"""Forward and inverse kinematics of the arm."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from spatial_replay.simulation.bullet import LOWER, REST, UPPER, downwards, joints_for, tool_frame


@given(st.floats(0.35, 0.7), st.floats(-2, 2), st.floats(0.01, 0.3), st.floats(-1.5, 1.5))
def test_the_inverse_kinematics_reach_a_pose(
    radius: float, bearing: float, above: float, turn: float
) -> None:
    goal = np.array([radius * math.cos(bearing), radius * math.sin(bearing), above])
    start = np.array([bearing, *REST[1:]])
    joints = joints_for(goal, downwards(bearing + turn), start, 60)
    position, rotation = tool_frame(joints)
    assert np.abs(position - goal).max() < 1e-3
    assert np.abs(rotation - downwards(bearing + turn)).max() < 1e-2
    assert ((joints >= LOWER) & (joints <= UPPER)).all()


@given(st.lists(st.floats(0, 1), min_size=7, max_size=7))
def test_the_tool_frame_is_a_rotation_within_reach_for_all_joints(shares: list[float]) -> None:
    position, rotation = tool_frame(LOWER + np.array(shares) * (UPPER - LOWER))
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-9
    assert math.dist(position, (0, 0, 0.333)) < 1.2
