"""Parts of simulated worlds: shapes, poses, bodies, start poses and injected failures."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, TypedDict, get_args

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.arrays import Floats
from spatial_replay.geometry.footprint import Footprint

# ----------------------------------------------------------------------------------------------------- shapes

UPRIGHT = 1e-2
"""Lean below which a body counts as upright, radians."""

_LEVEL = 0.1
"""Lean up to which a body has a yaw, radians; a knife with its handle on a mat leans less."""

_RIM = 16
"""Number of corners of the polygon around the rim of a leaning cylinder."""


@dataclass(frozen=True, slots=True)
class Box:
    """A cuboid with edges along the body's axes x, y and z, in metres."""

    length: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder around the body's axis z, in metres."""

    radius: float
    height: float


Shape: TypeAlias = Box | Cylinder


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """The position of a body's centre, and its orientation.

    Attributes:
        position: (3,) float64, metres.
        rotation: (3, 3) float64, whose columns are the body's axes in the world frame.
    """

    position: Floats
    rotation: Floats

    @property
    def yaw(self) -> float:
        """The angle of the body's axis x in the plane, radians, counter-clockwise from the world's axis x."""
        return math.atan2(self.rotation[1, 0], self.rotation[0, 0])

    def turned_from(self, yaw: float) -> float:
        """Return the body's yaw minus `yaw`, -pi to pi."""
        return math.remainder(self.yaw - yaw, 2 * math.pi)

    @property
    def lean(self) -> float:
        """The angle between the body's axis z and the vertical, radians, 0 to pi."""
        return math.acos(min(1.0, max(-1.0, float(self.rotation[2, 2]))))

    @property
    def stands(self) -> bool:
        """Whether the body's axis z is vertical, upwards or downwards."""
        return min(self.lean, math.pi - self.lean) < UPRIGHT

    @property
    def is_level(self) -> bool:
        """Whether the body's axis z is nearly vertical. Only then does the body have a yaw."""
        return min(self.lean, math.pi - self.lean) < _LEVEL


def footprint(shape: Shape, pose: Pose) -> Footprint:
    """Return the footprint of a body: a polygon, or a disc for an upright cylinder."""
    x, y = float(pose.position[0]), float(pose.position[1])
    match shape:
        case Cylinder(radius=radius) if pose.stands:
            return Footprint.disc(x, y, radius)
        case Box(length=length, width=width) if pose.stands:
            return rectangle(x, y, length, width, pose.yaw)
        case _:
            return Footprint.polygon(_outline(shape, pose)[:, :2], concave="hull")


def height(shape: Shape, pose: Pose) -> tuple[float, float]:
    """Return the lowest and highest z of a body, metres."""
    z = float(pose.position[2])
    z_shares = np.abs(pose.rotation[2])
    if isinstance(shape, Box):
        half = float(z_shares @ np.array([shape.length, shape.width, shape.height])) / 2
    else:
        half = shape.radius * math.hypot(z_shares[0], z_shares[1]) + shape.height / 2 * float(z_shares[2])
    return z - half, z + half


def rectangle(x: float, y: float, length: float, width: float, yaw: float) -> Footprint:
    """Return a rectangle around a point, with its length along `yaw`; all lengths are in metres."""
    a, b, cosine, sine = length / 2, width / 2, math.cos(yaw), math.sin(yaw)
    corners = ((a, b), (-a, b), (-a, -b), (a, -b))
    return Footprint.polygon([(x + u * cosine - v * sine, y + u * sine + v * cosine) for u, v in corners])


def _outline(shape: Shape, pose: Pose) -> Floats:
    """Return points (n, 3) whose convex hull is a box, or contains a cylinder."""
    if isinstance(shape, Box):
        signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], np.float64)
        points = signs * np.array([shape.length, shape.width, shape.height]) / 2
    else:
        angles = np.arange(_RIM) * (2 * math.pi / _RIM)
        # a circumscribed polygon, so that the footprint covers the body
        rim = shape.radius / math.cos(math.pi / _RIM) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points = np.concatenate([np.c_[rim, np.full(_RIM, z)] for z in (-shape.height / 2, shape.height / 2)])
    world_points: Floats = points @ pose.rotation.T + pose.position
    return world_points


# ----------------------------------------------------------------------------------------------------- worlds


@dataclass(frozen=True, slots=True)
class Body:
    """An object of a world.

    Attributes:
        name, class_name: name and class in the samples.
        shape: shape, metres.
        movable: whether the robot can push it, or pick and place it.
        support: whether other objects may be placed on the body, as on a plate. A support is no obstacle to
            other objects. It has no height in samples, so that objects on it count as inside.
    """

    name: str
    class_name: str
    shape: Shape
    movable: bool = True
    support: bool = False


# ------------------------------------------------------------------------------- starts and injected failures

Kind = Literal["drop", "slip"]

DURATION_NS = {"drop": 400 * 10**6, "slip": 4 * 10**9}
"""Duration of an injected failure that has a start time, ns."""

_WRITTEN = re.compile(r"(?P<kind>\w+)(?:@(?P<number>\d+(?:\.\d+)?)(?P<unit>ms|s))?")


@dataclass(frozen=True, slots=True)
class Injection:
    """A failure of the gripper.

    Attributes:
        kind: `drop` opens the gripper; `slip` makes the fingers slippery, as if oiled.
        at_ns: start of the failure; None for the whole run.
    """

    kind: Kind
    at_ns: int | None = None

    @classmethod
    def parse(cls, text: str) -> Injection:
        """Parse `drop@7s`, `slip@2500ms`, or `slip` for the whole run.

        Raises:
            UsageError: the text has another form.
        """
        match = _WRITTEN.fullmatch(text)
        kinds: tuple[Kind, ...] = get_args(Kind)
        for kind in kinds:
            if match is None or match["kind"] != kind:
                continue
            if match["number"] is not None:
                return cls(kind, round(float(match["number"]) * (10**9 if match["unit"] == "s" else 10**6)))
            if kind == "slip":
                return cls(kind)
        raise UsageError(f"{text!r} cannot be injected; write drop@7s, slip@7s or slip")

    def holds(self, time_ns: int) -> bool:
        """Return whether the failure is active at a time."""
        return self.at_ns is None or self.at_ns <= time_ns < self.at_ns + DURATION_NS[self.kind]

    def __str__(self) -> str:
        return self.kind if self.at_ns is None else f"{self.kind}@{self.at_ns / 10**9:g}s"


@dataclass(frozen=True, slots=True)
class Start:
    """The start pose of a body, which overrides the seeded pose.

    Attributes:
        x, y: centre of the body, metres.
        turn: yaw of the body, radians; None for the seeded yaw.
    """

    name: str
    x: float
    y: float
    turn: float | None = None

    @classmethod
    def parse(cls, text: str) -> Start:
        """Parse `red=0.47,-0.09` or `red=0.47,-0.09,0.4`.

        Raises:
            UsageError: the text has another form.
        """
        name, _, place = text.partition("=")
        try:
            coordinates = [float(number) for number in place.split(",")]
        except ValueError:
            coordinates = []
        if not name or not 2 <= len(coordinates) <= 3 or not all(map(math.isfinite, coordinates)):
            raise UsageError(
                f"{text!r} is no start; write NAME=X,Y in metres, or NAME=X,Y,TURN with radians, such as "
                "red=0.47,-0.09,0.4"
            )
        return cls(name.strip(), *coordinates)

    def __str__(self) -> str:
        numbers = [self.x, self.y] + ([] if self.turn is None else [self.turn])
        return f"{self.name}={','.join(f'{number:.12g}' for number in numbers)}"


class Conditions(TypedDict, total=False):
    """Keyword arguments of `make_world`.

    Attributes:
        seed: seed of the start poses and of the noise; the default is 0.
        noise_m: maximum error of detected positions, metres; samples have it as their uncertainty.
        injections: injected failures.
        starts: start poses; all other bodies have seeded start poses.
        gui: whether to show a window, and to run no faster than real time.
    """

    seed: int
    noise_m: float
    injections: Sequence[Injection]
    starts: Sequence[Start]
    gui: bool
