"""Forward and inverse kinematics of a Franka arm.

The tool frame is between the fingertips: z along the fingers, y along the axis on which they open.
"""

from __future__ import annotations

import math

import numpy as np

from spatial_replay.geometry.arrays import Floats

JOINTS = 7

LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""Limits of the joints in radians, from the data sheet."""

REST = np.array([0.0, -0.3, 0.0, -2.3, 0.0, 2.0, math.pi / 4])
"""Joints in radians in front of the base, the elbow up and the fingers down."""

_OFFSETS = np.array(
    [(0, 0, 0.333), (0, 0, 0), (0, -0.316, 0), (0.0825, 0, 0), (-0.0825, 0.384, 0), (0, 0, 0), (0.088, 0, 0)]
)
_TURNS = (0.0, -math.pi / 2, math.pi / 2, math.pi / 2, -math.pi / 2, math.pi / 2, math.pi / 2)
"""The frame of each joint in that of the previous link: an offset in metres, a rotation about x in
radians."""

_TOOL = 0.107 + 0.105
"""The distance from the last joint to the tool frame, in metres."""

_DAMPING = 1e-5
_STEPS = 3
_LONGEST = 0.2
"""The longest step of an iteration, in radians."""


def tool_frame(joints: Floats) -> tuple[Floats, Floats]:
    """Return the position (3,) in metres and the rotation (3, 3) of the tool for joints (7,) in radians."""
    position, rotation, _ = _chain(joints)
    return position, rotation


def downwards(yaw: float) -> Floats:
    """Return the rotation (3, 3) of a tool that points down with a yaw; the fingers open across it."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array([[cosine, sine, 0.0], [sine, -cosine, 0.0], [0.0, 0.0, -1.0]])


def joints_for(position: Floats, rotation: Floats, start: Floats, steps: int = _STEPS) -> Floats:
    """Return joints (7,) that bring the tool near a pose, by damped least squares from `start`.

    The arm is redundant; its free motion tends to the rest position. A pose out of reach is approached as
    far as possible: compare with `tool_frame` of the result if that matters.
    """
    joints = start
    for _ in range(steps):
        reached, turned, jacobian = _chain(joints)
        error = np.concatenate([position - reached, _rotation_between(turned, rotation)])
        square = jacobian @ jacobian.T + _DAMPING * np.eye(6)
        inverse = np.linalg.solve(square, jacobian).T
        free = np.eye(JOINTS) - inverse @ jacobian
        rest = REST.copy()
        rest[0] = math.atan2(position[1], position[0])
        # the last joint sets the yaw of the tool and has no rest position
        rest[6] = joints[6]
        change = inverse @ error + free @ (0.1 * (rest - joints))
        joints = np.clip(joints + change * min(1.0, _LONGEST / max(1e-9, np.abs(change).max())), LOWER, UPPER)
    return joints


def _chain(joints: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the position and the rotation of the tool, and the Jacobian (6, 7) of both."""
    position, rotation = np.zeros(3), np.eye(3)
    origins, axes = [], []
    for offset, turn, angle in zip(_OFFSETS, _TURNS, joints.tolist(), strict=True):
        position = position + rotation @ offset
        rotation = rotation @ _about_x(turn)
        origins.append(position)
        axes.append(rotation[:, 2])
        rotation = rotation @ _about_z(angle)
    position = position + rotation[:, 2] * _TOOL
    rotation = rotation @ _about_z(-math.pi / 4)
    a, b, c = around = np.array(axes).T
    x, y, z = position[:, None] - np.array(origins).T
    return position, rotation, np.stack([b * z - c * y, c * x - a * z, a * y - b * x, *around])


def _rotation_between(first: Floats, second: Floats) -> Floats:
    """Return the rotation vector (3,) from one rotation to another, exact enough to iterate with."""
    between = second @ first.T
    axis = np.array(
        [between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]]
    )
    sine = float(np.sqrt(axis @ axis)) / 2
    angle = math.atan2(sine, (float(np.trace(between)) - 1) / 2)
    return axis * (angle / (2 * sine)) if sine > 1e-9 else axis / 2


def _about_x(angle: float) -> Floats:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])


def _about_z(angle: float) -> Floats:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
