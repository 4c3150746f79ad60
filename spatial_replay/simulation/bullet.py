"""Physics, and kinematics of a Franka arm; no other module uses PyBullet.

The tool frame is between the fingertips. Its axis z points along the fingers, which open along its axis y.
"""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spatial_replay.errors import UsageError, importing
from spatial_replay.geometry.arrays import Floats
from spatial_replay.simulation.world import Box, Pose, Shape

# ------------------------------------------------------------------------------------------------- kinematics

JOINTS = 7

LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""Joint limits, radians, from the data sheet."""

REST = np.array([0.0, -0.3, 0.0, -2.3, 0.0, 2.0, math.pi / 4])
"""Rest position of the joints, radians; the tool is in front of the base, the elbow up, the fingers down."""

_OFFSETS = np.array(
    [(0, 0, 0.333), (0, 0, 0), (0, -0.316, 0), (0.0825, 0, 0), (-0.0825, 0.384, 0), (0, 0, 0), (0.088, 0, 0)]
)
_TURNS = (0.0, -math.pi / 2, math.pi / 2, math.pi / 2, -math.pi / 2, math.pi / 2, math.pi / 2)
"""Frame of each joint relative to the previous link: offset, metres, and rotation about x, radians."""

_TOOL = 0.107 + 0.105
"""Distance from the last joint to the tool frame, metres."""

_DAMPING = 1e-5
"""Damping of the least squares, so that they have a solution near singular poses."""
_STEPS = 3
"""Default number of iterations."""
_LONGEST = 0.2
"""Maximum step of an iteration, radians."""


def tool_frame(joints: Floats) -> tuple[Floats, Floats]:
    """Return the position (3,), metres, and rotation (3, 3) of the tool for joints (7,), radians."""
    position, rotation, _ = _chain(joints)
    return position, rotation


def downwards(yaw: float) -> Floats:
    """Return the rotation (3, 3) of a downward tool; the fingers open at right angles to `yaw`."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array([[cosine, sine, 0.0], [sine, -cosine, 0.0], [0.0, 0.0, -1.0]])


def joints_for(position: Floats, rotation: Floats, start: Floats, steps: int = _STEPS) -> Floats:
    """Return joints (7,) that bring the tool near a pose, by damped least squares from `start`.

    The arm is redundant, so the joints also approach the rest position. For a pose out of reach, the result
    is as near as possible. `tool_frame` of the result gives the actual pose.
    """
    joints = start
    for _ in range(steps):
        tool_position, tool_rotation, jacobian = _chain(joints)
        error = np.concatenate([position - tool_position, _rotation_between(tool_rotation, rotation)])
        damped_square = jacobian @ jacobian.T + _DAMPING * np.eye(6)
        inverse = np.linalg.solve(damped_square, jacobian).T
        null_space = np.eye(JOINTS) - inverse @ jacobian
        rest_joints = REST.copy()
        rest_joints[0] = math.atan2(position[1], position[0])
        # the last joint sets the yaw of the tool and has no rest position
        rest_joints[6] = joints[6]
        change = inverse @ error + null_space @ (0.1 * (rest_joints - joints))
        joints = np.clip(joints + change * min(1.0, _LONGEST / max(1e-9, np.abs(change).max())), LOWER, UPPER)
    return joints


def _chain(joints: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the position and rotation of the tool, and their Jacobian (6, 7)."""
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
    a, b, c = axis_rows = np.array(axes).T
    x, y, z = position[:, None] - np.array(origins).T
    return position, rotation, np.stack([b * z - c * y, c * x - a * z, a * y - b * x, *axis_rows])


def _rotation_between(first: Floats, second: Floats) -> Floats:
    """Return the rotation vector (3,) from the first rotation to the second; inexact near half a turn."""
    rotation = second @ first.T
    axis = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine = float(np.sqrt(axis @ axis)) / 2
    angle = math.atan2(sine, (float(np.trace(rotation)) - 1) / 2)
    return axis * (angle / (2 * sine)) if sine > 1e-9 else axis / 2


def _about_x(angle: float) -> Floats:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])


def _about_z(angle: float) -> Floats:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


# ---------------------------------------------------------------------------------------------------- physics

STEPS_PER_S = 240
"""Simulation steps per second."""

FINGERS = (9, 10)
"""Indices of the two fingers, as joints and as links."""

_FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""Maximum torques of the arm's joints, N m, from the data sheet."""
_GAINS = (0.3,) * JOINTS
"""Position gains of the arm's joints."""
_WOOD = 0.5
"""Default friction coefficient."""
_FRICTION = MappingProxyType({"lateralFriction": _WOOD, "spinningFriction": 2e-3, "rollingFriction": 2e-3})
"""Friction of bodies; rolling friction stops rolling bodies, as on a real table."""

_NEAR, _FAR = 0.05, 5.0
"""Nearest and farthest distance in a camera's picture, metres."""


class Engine:
    """The simulated table, robot and bodies.

    Raises:
        UsageError: the simulator is not installed, or there is no display for its window.
    """

    def __init__(self, *, gui: bool = False) -> None:
        self._bullet = bullet = _load()
        if gui:
            _refuse_no_display()
        self._client: int = bullet.connect(bullet.GUI if gui else bullet.DIRECT)
        if self._client < 0:
            raise UsageError("the simulator could not be started; run without gui if it shows a window")
        self._bodies: dict[str, int] = {}
        call = self._call
        if gui:
            call("configureDebugVisualizer", bullet.COV_ENABLE_GUI, 0)
            call("resetDebugVisualizerCamera", 1.2, 90.0, -45.0, (0.45, 0.0, 0.0))
        call("setGravity", 0.0, 0.0, -9.81)
        # deterministic pairs, because equal seeds must give equal runs
        call("setPhysicsEngineParameter", deterministicOverlappingPairs=1, numSolverIterations=100)
        self._table: int = self._add(Box(1.8, 1.8, 0.1), 0.0, (0.0, 0.0, -0.05), 0.0, (0.72, 0.62, 0.5, 1.0))
        call("changeDynamics", self._table, -1, lateralFriction=_WOOD)
        folder = resources.files("pybullet_data")
        self._robot: int = call("loadURDF", str(folder / "franka_panda/panda.urdf"), useFixedBase=True)
        self._couple_fingers()
        self.set_grip(1.0)

    def close(self) -> None:
        """Release the simulator; a second call has no effect."""
        if self._client >= 0:
            self._call("disconnect")
            self._client = -1

    def step(self) -> None:
        """Advance by 1 / `STEPS_PER_S` seconds."""
        self._call("stepSimulation")

    def add(
        self,
        name: str,
        shape: Shape,
        mass: float,
        position: tuple[float, float, float],
        yaw: float,
        colour: tuple[float, float, float],
    ) -> None:
        """Add a body with its z axis upwards; a mass of 0 kg fixes the body."""
        body_id = self._add(shape, mass, position, yaw, (*colour, 1.0))
        self._call("changeDynamics", body_id, -1, **_FRICTION)
        self._bodies[name] = body_id

    def pose(self, name: str) -> Pose:
        """Return the pose of a body."""
        position, quaternion = self._call("getBasePositionAndOrientation", self._bodies[name])
        rotation = np.array(self._bullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
        return Pose(np.array(position), rotation)

    def move(self, name: str, x: float, y: float) -> None:
        """Move a fixed body regardless of collisions; the body's height and orientation do not change."""
        (*_, z), quaternion = self._call("getBasePositionAndOrientation", self._bodies[name])
        self._call("resetBasePositionAndOrientation", self._bodies[name], (x, y, z), quaternion)

    # -------------------------------------------------------------------------------------- the robot

    def set_joints(self, joints: Floats, width: float) -> None:
        """Set the arm's joints (7,), and the fingers to a distance of `width` metres, without motion."""
        for joint_index, angle in enumerate(joints.tolist()):
            self._call("resetJointState", self._robot, joint_index, angle)
        for finger in FINGERS:
            self._call("resetJointState", self._robot, finger, width / 2)

    def drive(self, joints: Floats, velocities: Floats, width: float, force: float) -> None:
        """Command the motors for the next steps.

        Args:
            joints: (7,), positions of the arm's joints, radians.
            velocities: (7,), velocities of the arm's joints, rad/s.
            width: distance of the fingers, metres.
            force: force of the fingers, N.
        """
        bullet = self._bullet
        self._call(
            "setJointMotorControlArray",
            self._robot,
            list(range(JOINTS)),
            bullet.POSITION_CONTROL,
            targetPositions=joints.tolist(),
            targetVelocities=velocities.tolist(),
            forces=list(_FORCES),
            positionGains=list(_GAINS),
            velocityGains=[1.0] * JOINTS,
        )
        self._call(
            "setJointMotorControlArray",
            self._robot,
            list(FINGERS),
            bullet.POSITION_CONTROL,
            targetPositions=[width / 2] * 2,
            forces=[force] * 2,
        )

    def joints(self) -> Floats:
        """Return the actual positions (7,) of the arm's joints, radians."""
        states = self._call("getJointStates", self._robot, list(range(JOINTS)))
        return np.array([state[0] for state in states])

    def finger_width(self) -> float:
        """Return the distance of the fingers, metres."""
        return float(sum(state[0] for state in self._call("getJointStates", self._robot, list(FINGERS))))

    def fingers_touching(self, name: str) -> int:
        """Return how many of the two fingers touch a body."""
        contact_points = (
            self._call("getContactPoints", self._robot, self._bodies[name], finger) for finger in FINGERS
        )
        return sum(bool(points) for points in contact_points)

    def picture(
        self,
        size: tuple[int, int],
        focal: float,
        eye: tuple[float, float, float],
        look_at: tuple[float, float, float],
    ) -> tuple[NDArray[np.uint8], Floats]:
        """Return a camera's picture (height, width, 3) in RGB, and distances (height, width) along its axis.

        Args:
            size: width and height, pixels.
            focal: focal length, pixels; the principal point is in the middle.
        """
        width, height = size
        # PyBullet's field of view is vertical, in degrees
        view_angle = math.degrees(2 * math.atan(height / 2 / focal))
        bullet = self._bullet
        view_matrix = bullet.computeViewMatrix(eye, look_at, (0.0, 0.0, 1.0))
        projection_matrix = bullet.computeProjectionMatrixFOV(view_angle, width / height, _NEAR, _FAR)
        # the software renderer also works without a display
        camera_image = self._call(
            "getCameraImage",
            width,
            height,
            view_matrix,
            projection_matrix,
            renderer=bullet.ER_TINY_RENDERER,
            shadow=0,
        )
        # a PyBullet that was built without NumPy returns tuples
        colours = np.asarray(camera_image[2], np.uint8).reshape(height, width, 4)[..., :3]
        # the depth buffer is not linear: 0 at _NEAR, 1 at _FAR
        depth_buffer = np.asarray(camera_image[3], np.float64).reshape(height, width)
        return colours, _FAR * _NEAR / (_FAR - (_FAR - _NEAR) * depth_buffer)

    def set_grip(self, friction: float) -> None:
        """Set the friction of the fingers: 1 for rubber, close to 0 for oil."""
        for finger in FINGERS:
            self._call("changeDynamics", self._robot, finger, lateralFriction=friction)

    # ---------------------------------------------------------------------------------------- private

    def _couple_fingers(self) -> None:
        """Couple the fingers, as in the real hand: a held body stays in the middle."""
        left, right = FINGERS
        joint_type, axis, centre = self._bullet.JOINT_GEAR, (1, 0, 0), (0, 0, 0)
        gear = self._call(
            "createConstraint", self._robot, left, self._robot, right, joint_type, axis, centre, centre
        )
        self._call("changeConstraint", gear, gearRatio=-1, erp=0.1, maxForce=50)

    def _add(
        self,
        shape: Shape,
        mass: float,
        position: tuple[float, float, float],
        yaw: float,
        colour: tuple[float, float, float, float],
    ) -> int:
        bullet = self._bullet
        if isinstance(shape, Box):
            half_lengths = [shape.length / 2, shape.width / 2, shape.height / 2]
            collision = self._call("createCollisionShape", bullet.GEOM_BOX, halfExtents=half_lengths)
            visual = self._call(
                "createVisualShape", bullet.GEOM_BOX, halfExtents=half_lengths, rgbaColor=colour
            )
        else:
            cylinder_type, r, h = bullet.GEOM_CYLINDER, shape.radius, shape.height
            collision = self._call("createCollisionShape", cylinder_type, radius=r, height=h)
            visual = self._call("createVisualShape", cylinder_type, radius=r, length=h, rgbaColor=colour)
        quaternion = bullet.getQuaternionFromEuler((0.0, 0.0, yaw))
        body_id: int = self._call("createMultiBody", mass, collision, visual, position, quaternion)
        return body_id

    def _call(self, function: str, *arguments: Any, **named: Any) -> Any:
        """Call a function of the simulator for this world; a process may have several worlds."""
        return getattr(self._bullet, function)(*arguments, physicsClientId=self._client, **named)


def _load() -> ModuleType:
    """Import the simulator.

    Raises:
        UsageError: the simulator is not installed.
    """
    with (
        importing("simulated worlds need PyBullet (it has wheels for Python 3.11)", extra="sim"),
        _without_greeting(),
    ):
        import pybullet
    module: ModuleType = pybullet
    return module


def _refuse_no_display() -> None:
    """Check that there is a display for a window, because without a display the simulator ends the process.

    Raises:
        UsageError: there is no display.
    """
    display_name = os.environ.get("DISPLAY")
    if not display_name:
        raise UsageError("there is no display to show the world on (DISPLAY is not set); run without gui")
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError as error:
        raise UsageError("windows need libX11, which is not installed; run without gui") from error
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if display is None:
        raise UsageError(
            f"the display {display_name} cannot be opened (DISPLAY); correct it, or run without gui"
        )
    x11.XCloseDisplay(ctypes.c_void_p(display))


@contextmanager
def _without_greeting() -> Iterator[None]:
    """Suppress the build date that PyBullet writes to standard error on import."""
    # C code writes the date, so only the file descriptor can be redirected
    stderr = os.dup(2)
    try:
        with Path(os.devnull).open("wb") as null_file:
            os.dup2(null_file.fileno(), 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
