"""Where the joints of a Franka arm bring its tool, and which joints bring the tool somewhere.

The tool's frame lies between the fingertips: z along the fingers, y along the axis on which they open.
"""

from __future__ import annotations

import math

import numpy as np

from spatial_replay.geometry.arrays import Floats

JOINTS = 7

LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""Limits of the joints in radians, those the maker gives."""

REST = np.array([0.0, -0.3, 0.0, -2.3, 0.0, 2.0, math.pi / 4])
"""Joints in radians in front of the base, the elbow up and the fingers down."""

_OFFSETS = np.array(
    [(0, 0, 0.333), (0, 0, 0), (0, -0.316, 0), (0.0825, 0, 0), (-0.0825, 0.384, 0), (0, 0, 0), (0.088, 0, 0)]
)
_TURNS = (0.0, -math.pi / 2, math.pi / 2, math.pi / 2, -math.pi / 2, math.pi / 2, math.pi / 2)
"""Each joint's frame in that of the link before: an offset in metres, and a turn around x in radians."""

_TOOL = 0.107 + 0.105
"""From the last joint to between the fingertips, in metres."""

_DAMPING = 1e-5
_STEPS = 3
_LONGEST = 0.2
"""The longest step of an iteration, in radians."""


def tool_frame(joints: Floats) -> tuple[Floats, Floats]:
    """The tool's position (3,) in metres and rotation (3, 3) for joints (7,) in radians."""
    position, rotation, _ = _chain(joints)
    return position, rotation


def downwards(yaw: float) -> Floats:
    """The rotation (3, 3) of a tool that points down and is turned by `yaw`; it opens across that."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array([[cosine, sine, 0.0], [sine, -cosine, 0.0], [0.0, 0.0, -1.0]])


def joints_for(position: Floats, rotation: Floats, start: Floats, steps: int = _STEPS) -> Floats:
    """Joints (7,) that bring the tool near a pose, found from others by damped least squares.

    Of all that do, it tends to those close to rest. A pose out of reach is approached as far as the arm
    goes: whoever needs to know compares `tool_frame` of the result.
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
        # the last joint is the tool's turn and has no rest
        rest[6] = joints[6]
        change = inverse @ error + free @ (0.1 * (rest - joints))
        joints = np.clip(joints + change * min(1.0, _LONGEST / max(1e-9, np.abs(change).max())), LOWER, UPPER)
    return joints


def _chain(joints: Floats) -> tuple[Floats, Floats, Floats]:
    """The tool's position and rotation, and the Jacobian (6, 7) of both."""
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
    """The rotation vector (3,) that turns one frame into another; small or exact enough to iterate with."""
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
