"""Footprints and heights of bodies in every pose."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import MultiPoint, Polygon

from spatial_replay import Footprint
from spatial_replay.simulation.world import Box, Cylinder, Pose, footprint, height

SIZES = st.floats(0.01, 0.5)
ANGLES = st.floats(-math.pi, math.pi)
PLACES = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 1))


def rotation(roll: float, yaw: float) -> np.ndarray:
    """Return the rotation of a body that leans by `roll` about its x axis, then turns by `yaw`."""
    lean = np.array([(1, 0, 0), (0, math.cos(roll), -math.sin(roll)), (0, math.sin(roll), math.cos(roll))])
    turn = np.array([(math.cos(yaw), -math.sin(yaw), 0), (math.sin(yaw), math.cos(yaw), 0), (0, 0, 1)])
    return turn @ lean


def outline_of(covered: Footprint) -> Polygon:
    (part,) = covered.parts
    return Polygon(part.vertices) if len(part.vertices) > 2 else MultiPoint(part.vertices).buffer(part.radius)


@given(SIZES, SIZES, SIZES, PLACES, ANGLES, ANGLES)
def test_a_box_covers_the_projection_of_its_corners(
    length: float, width: float, tall: float, place: tuple[float, float, float], roll: float, yaw: float
) -> None:
    pose = Pose(np.array(place), rotation(roll, yaw))
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    corners = signs * np.array([length, width, tall]) / 2 @ pose.rotation.T + pose.position
    covered = outline_of(footprint(Box(length, width, tall), pose))
    expected = MultiPoint(corners[:, :2]).convex_hull
    # one that hardly leans counts as upright
    assert covered.hausdorff_distance(expected) <= 0.011 * (length + width + tall)
    bottom, top = height(Box(length, width, tall), pose)
    assert (bottom, top) == pytest.approx((corners[:, 2].min(), corners[:, 2].max()), abs=1e-12)


@given(SIZES, SIZES, PLACES, st.floats(0.02, math.pi - 0.02), ANGLES)
def test_a_leaning_cylinder_covers_its_rims_closely(
    radius: float, tall: float, place: tuple[float, float, float], roll: float, yaw: float
) -> None:
    pose = Pose(np.array(place), rotation(roll, yaw))
    angles = np.linspace(0, 2 * math.pi, 100)
    rim = radius * np.c_[np.cos(angles), np.sin(angles), 0 * angles]
    half = np.array([0, 0, tall / 2])
    rims = np.concatenate([rim + half, rim - half]) @ pose.rotation.T + pose.position
    covered = outline_of(footprint(Cylinder(radius, tall), pose))
    exact = MultiPoint(rims[:, :2]).convex_hull
    assert covered.buffer(1e-9).contains(exact)
    assert covered.hausdorff_distance(exact) < 0.05 * radius


@given(SIZES, SIZES, PLACES, ANGLES)
def test_a_standing_cylinder_is_a_disc(
    radius: float, tall: float, place: tuple[float, float, float], yaw: float
) -> None:
    pose = Pose(np.array(place), rotation(0.0, yaw))
    assert footprint(Cylinder(radius, tall), pose) == Footprint.disc(place[0], place[1], radius)
    bottom, top = height(Cylinder(radius, tall), pose)
    assert (bottom, top) == pytest.approx((place[2] - tall / 2, place[2] + tall / 2))


def test_a_pose_has_a_yaw_and_may_be_upright() -> None:
    pose = Pose(np.zeros(3), rotation(0.0, 0.7))
    assert pose.yaw == pytest.approx(0.7)
    assert pose.stands
    assert Pose(np.zeros(3), rotation(math.pi, 0.0)).stands
    assert not Pose(np.zeros(3), rotation(math.pi / 2, 0.0)).stands
