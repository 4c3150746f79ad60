"""A table with a robot and bodies on it: the world of every scenario.

Errors of detection, drawn from a seed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Sequence
from types import MappingProxyType
from typing import TypeVar

import numpy as np

from spatial_replay.errors import UsageError
from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.simulation.arm import STEPS_PER_TICK, TICKS_PER_S, Arm
from spatial_replay.simulation.bullet import Engine
from spatial_replay.simulation.injection import Injection
from spatial_replay.simulation.pushing import pushing
from spatial_replay.simulation.scenario import Scenario
from spatial_replay.simulation.scene import Scene
from spatial_replay.simulation.shapes import Box, Pose, footprint, height
from spatial_replay.simulation.world import Body, Execution, ReachableArea, Skill
from spatial_replay.trace.sample import Sample


def displacements(radius_m: float, seed: int, sample: int, count: int) -> list[tuple[float, float]]:
    """How far detection is off for each of `count` bodies in a sample, in metres along x and y.

    Each is drawn evenly from a disc, so that no error is greater than its radius. They depend on nothing
    but the arguments: a sample looked at twice shows the same.
    """
    if radius_m == 0:
        return [(0.0, 0.0)] * count
    drawn = np.random.default_rng([seed, sample, 1]).random((count, 2))
    radii = (radius_m * np.sqrt(drawn[:, 0])).tolist()
    angles = (2 * math.pi * drawn[:, 1]).tolist()
    return [(r * math.cos(a), r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]


SAMPLES_PER_S = 30
"""Samples in a simulated second."""

_TICKS_PER_SAMPLE = TICKS_PER_S // SAMPLES_PER_S
_SETTLING_STEPS = 120
"""How long bodies come to rest before time 0."""
_RUBBER, _OIL = 1.0, 0.02
"""Friction of the fingers, as they are and when they slip."""

_Result = TypeVar("_Result")


class Tabletop:
    """A scenario's world; see `World` for what it does.

    Raises:
        UsageError: the simulator is not installed, a noise below 0, or something that cannot be injected.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        seed: int = 0,
        noise_m: float = 0.0,
        injections: Sequence[Injection] = (),
        gui: bool = False,
    ) -> None:
        """Make the world at time 0.

        Args:
            seed: of where bodies lie and of noise.
            noise_m: detection is off by up to this much, in metres, and the samples' uncertainty says so.
            injections: what goes wrong, and when.
            gui: show a window, and run no faster than real time.
        """
        if noise_m < 0 or not math.isfinite(noise_m):
            raise UsageError(f"the noise is {noise_m} m; give 0 or more")
        for injection in injections:
            if injection.kind == "drop" and scenario.skill == "push":
                raise UsageError(
                    f"{injection}: nothing is held in {scenario.name}; slip can be injected there"
                )
        self._scenario = scenario
        self._noise_m = noise_m
        self._injections = tuple(injections)
        self._listen: Callable[[Sample], None] = _ignore
        self._gui = gui
        self._engine: Engine | None = None
        self.reset(seed)

    @property
    def name(self) -> str:
        """See `World`."""
        return self._scenario.name

    @property
    def skill(self) -> Skill:
        """See `World`."""
        return self._scenario.skill

    @property
    def bodies(self) -> tuple[Body, ...]:
        """See `World`."""
        return tuple(each.body for each in self._scenario.placements)

    @property
    def workspace(self) -> ReachableArea:
        """See `World`."""
        return self._scenario.workspace

    @property
    def obstacles(self) -> tuple[Footprint, ...]:
        """See `World`."""
        return ()

    @property
    def time_ns(self) -> int:
        """See `World`."""
        return self._ticks * 10**9 // TICKS_PER_S

    @property
    def scene(self) -> Scene:
        """The robot and what lies around it."""
        return self._scene

    def attach(self, listen: Callable[[Sample], None]) -> None:
        """See `World`."""
        self._listen = listen

    def reset(self, seed: int) -> None:
        """See `World`."""
        if seed < 0:
            raise UsageError(f"the seed is {seed}; give 0 or more")
        self.close()
        self._seed, self._ticks, self._seen = seed, 0, -1
        # only a fresh simulator is known to compute the same again
        self._engine = engine = Engine(gui=self._gui)
        scenario, drawn = self._scenario, np.random.default_rng([seed, 0])
        for each in scenario.placements:
            dx, dy, turn = (drawn.random(3) * 2 - 1).tolist()
            tall = each.body.shape.height
            x, y = each.x + dx * scenario.scatter_m, each.y + dy * scenario.scatter_m
            engine.add(
                each.body.name,
                each.body.shape,
                mass=each.mass_kg,
                position=(x, y, each.bottom + tall / 2 + 5e-4),
                yaw=each.yaw + turn * scenario.scatter_rad,
                colour=each.colour,
            )
        bodies = {each.body.name: each.body for each in scenario.placements}
        self._scene = Scene(engine, Arm(engine), MappingProxyType(bodies))
        self._scene.arm.drive()
        for _ in range(_SETTLING_STEPS):
            engine.step()

    def sample(self) -> Sample:
        """See `World`."""
        self._working()
        number = self._ticks // _TICKS_PER_SAMPLE
        errors = displacements(self._noise_m, self._seed, number, len(self._scene.bodies))
        objects = {
            name: self._seen_as(body, self._scene.pose(name), error)
            for (name, body), error in zip(self._scene.bodies.items(), errors, strict=True)
        }
        x, y, z = self._scene.arm.position.tolist()
        signals = {"tool_x": x, "tool_y": y, "tool_z": z, "finger_width": self._scene.arm.width}
        return Sample(self.time_ns, objects, signals)

    def step(self) -> None:
        """See `World`."""
        self.run(self._scene.arm.wait(1 / SAMPLES_PER_S))

    def push(self, name: str, path: Sequence[tuple[float, float]]) -> Execution:
        """See `World`."""
        self._refuse_unless("push", name, [number for point in path for number in point])
        return self.run(pushing(self._scene, name, path))

    def place(self, name: str, x: float, y: float, yaw: float | None = None) -> Execution:
        """See `World`."""
        self._refuse_unless("place", name, [x, y, 0.0 if yaw is None else yaw])
        return self.run(self._scenario.placing(self._scene, name, (x, y), yaw))

    def script(self) -> Generator[None, None, Execution]:
        """The robot's motion when nobody plans."""
        return self._scenario.script(self._scene)

    def run(self, motion: Generator[None, None, _Result]) -> _Result:
        """Move the robot to a motion's end, and return what the motion does.

        Raises:
            UsageError: the world is closed.
        """
        while True:
            try:
                next(motion)
            except StopIteration as end:
                result: _Result = end.value
                return result
            self.tick()

    def follow(self, motion: Generator[None, None, _Result], duration_ns: int | None) -> _Result | None:
        """Move the robot for a time, and let it hold still when the motion ends before; None if it does not.

        Without a duration it takes as long as the motion.
        """
        if duration_ns is None:
            return self.run(motion)
        end_ns = self.time_ns + duration_ns
        result: _Result | None = None
        while self.time_ns < end_ns:
            try:
                next(motion)
            except StopIteration as end:
                result = end.value
                break
            self.tick()
        for _ in self._scene.arm.rest():
            if self.time_ns >= end_ns:
                break
            self.tick()
        return result

    def tick(self) -> None:
        """Advance by the time that one command of the arm holds."""
        engine = self._working()
        self._tell()
        began = time.monotonic() if self._gui else 0.0
        self._inject()
        self._scene.arm.drive()
        for _ in range(STEPS_PER_TICK):
            engine.step()
        self._ticks += 1
        if self._gui:
            time.sleep(max(0.0, began + 1 / TICKS_PER_S - time.monotonic()))
        self._tell()

    def close(self) -> None:
        """See `World`."""
        if self._engine is not None:
            self._engine.close()
            self._engine = None

    def _tell(self) -> None:
        """Hand on the sample of now, if it is time for one, once."""
        if self._ticks % _TICKS_PER_SAMPLE == 0 and self._ticks != self._seen:
            self._seen = self._ticks
            self._listen(self.sample())

    def _inject(self) -> None:
        if not self._injections:
            return
        going_on = {each.kind for each in self._injections if each.holds(self.time_ns)}
        self._scene.arm.limp = "drop" in going_on
        self._scene.engine.set_grip(_OIL if "slip" in going_on else _RUBBER)

    def _seen_as(self, body: Body, pose: Pose, error: tuple[float, float]) -> TrackedObject:
        seen = Pose(pose.position + np.array([*error, 0.0]), pose.rotation)
        yaw = pose.yaw if isinstance(body.shape, Box) and pose.stands else None
        return TrackedObject(
            footprint(body.shape, seen),
            class_name=body.class_name,
            yaw=yaw,
            height=None if body.support else height(body.shape, seen),
            uncertainty=self._noise_m,
        )

    def _working(self) -> Engine:
        """The physics.

        Raises:
            UsageError: the world is closed.
        """
        if self._engine is None:
            raise UsageError(f"the world {self.name} is closed; make another one")
        return self._engine

    def _refuse_unless(self, skill: str, name: str, numbers: Sequence[float]) -> None:
        self._working()
        if self._scenario.skill != skill:
            other = self._scenario.skill
            raise UsageError(f"the robot of {self.name} does not {skill} objects; it can {other} them")
        movable = [body.name for body in self.bodies if body.movable]
        if name not in movable:
            raise UsageError(f"{name!r} cannot be moved in {self.name}; {', '.join(movable)} can")
        if not numbers or not all(map(math.isfinite, numbers)):
            raise UsageError(f"{name} cannot be moved to {list(numbers)}; give finite numbers")


def _ignore(sample: Sample) -> None:
    """Nobody listens."""
