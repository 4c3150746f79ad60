"""Scenarios by name, and their world: a table with a robot, bodies and seeded detection noise."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module, resources
from types import MappingProxyType
from typing import Any, TypeVar, Unpack

import numpy as np

from spatial_replay.errors import UsageError, importing
from spatial_replay.geometry.footprint import TrackedObject
from spatial_replay.logs.behaviour_tree import TreeTick
from spatial_replay.planning.decisions import Outcome
from spatial_replay.planning.settings import Skill
from spatial_replay.simulation.arm import (
    STEPS_PER_TICK,
    TICKS_PER_S,
    WIDEST,
    Arm,
    Point,
    Scene,
    let_go,
    picking,
    pushing,
    put_back,
)
from spatial_replay.simulation.bullet import Engine
from spatial_replay.simulation.world import (
    Body,
    Box,
    Conditions,
    Injection,
    Pose,
    Start,
    footprint,
    height,
)
from spatial_replay.spec import parse_specification
from spatial_replay.spec.formula import Specification
from spatial_replay.text import nearest_hint
from spatial_replay.trace.trace import Sample

# -------------------------------------------------------------------------------------------------- scenarios

Placing = Callable[[Scene, str, Point, float | None, Sequence[Point]], Generator[None, None, Outcome]]
"""A function like `picking`: its motion picks a body up, carries it along points and places it."""

Script = Callable[[Scene], Generator[None, None, Outcome]]
"""A function that returns the motion of the robot without a planner."""


@dataclass(frozen=True, slots=True)
class Placement:
    """The initial state of a body.

    Attributes:
        x, y, yaw: pose of the body's centre, metres and radians.
        mass_kg: mass; 0 for a fixed body.
        bottom: height of the surface under the body, metres.
        colour: red, green, blue, from 0 to 1.
    """

    body: Body
    x: float
    y: float
    yaw: float
    mass_kg: float
    colour: tuple[float, float, float]
    bottom: float = 0.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """The definition of a world.

    Attributes:
        name: name on the command line.
        placements: bodies in their initial poses.
        workspace: reach of the robot, by the keys of settings files.
        skill: skill of the robot, "push" or "place".
        script: motion of the robot without a planner.
        placing: motion that picks and places a body, for the skill "place".
        scatter_m, scatter_rad: maximum seeded shift and rotation of each body.
    """

    name: str
    placements: tuple[Placement, ...]
    workspace: Mapping[str, Any]
    skill: Skill
    script: Script
    placing: Placing = picking
    scatter_m: float = 0.01
    scatter_rad: float = 0.2


# -------------------------------------------------------------------------------------------------- the table

SAMPLES_PER_S = 30
"""Samples per simulated second."""

_TICKS_PER_SAMPLE = TICKS_PER_S // SAMPLES_PER_S
_SETTLING_STEPS = 120
"""Number of simulation steps before time 0, in which bodies come to rest."""
_RUBBER, _OIL = 1.0, 0.02
"""Friction coefficient of the fingers, normally and during a `slip`."""

_Result = TypeVar("_Result")


class Tabletop:
    """The world of a scenario, simulated step by step; lengths are in metres.

    The robot's base is at (0, 0); x points forward, y to its left, z up; the table is z = 0. Methods that
    advance time (`step`, `push`, `place`) pass each due sample to the attached listener. The sample of time 0
    is passed when time starts to advance.

    Raises:
        UsageError: the simulator is not installed, the noise is below 0, an injection is impossible, or a
            start names no body.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        seed: int = 0,
        noise_m: float = 0.0,
        injections: Sequence[Injection] = (),
        starts: Sequence[Start] = (),
        gui: bool = False,
    ) -> None:
        """Create the world at time 0; `Conditions` explains the arguments."""
        if noise_m < 0 or not math.isfinite(noise_m):
            raise UsageError(f"the noise is {noise_m} m; give 0 or more")
        for injection in injections:
            if injection.kind == "drop" and scenario.skill == "push":
                reason = f"nothing is held in {scenario.name}"
                raise UsageError(f"{injection}: {reason}; slip can be injected there")
        body_names = [placement.body.name for placement in scenario.placements]
        for start in starts:
            if start.name not in body_names:
                hint = nearest_hint(start.name, body_names) or f"there are {', '.join(body_names)}"
                raise UsageError(f"{start}: {scenario.name} has no {start.name!r}; {hint}")
        self._scenario = scenario
        self._starts = {start.name: start for start in starts}
        self._noise_m = noise_m
        self._injections = tuple(injections)
        self._listen: Callable[[Sample], str | None] = lambda sample: None
        self._listen_to_tree: Callable[[TreeTick], None] = lambda tick: None
        self._halt_reason = ""
        self._gui = gui
        self._engine: Engine | None = None
        self.reset(seed)

    @property
    def name(self) -> str:
        """The scenario's name."""
        return self._scenario.name

    @property
    def skill(self) -> Skill:
        """The skill of the robot, "push" or "place"."""
        return self._scenario.skill

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The objects, in the order of the samples."""
        return tuple(placement.body for placement in self._scenario.placements)

    @property
    def workspace(self) -> Mapping[str, Any]:
        """The reach of the robot, by the keys of settings files."""
        return self._scenario.workspace

    @property
    def time_ns(self) -> int:
        """The simulated time since the start, ns."""
        return self._ticks * 10**9 // TICKS_PER_S

    @property
    def scene(self) -> Scene:
        """The robot and the bodies, for motions."""
        return self._scene

    def attach(
        self,
        listen: Callable[[Sample], str | None],
        listen_to_tree: Callable[[TreeTick], None] = lambda tick: None,
    ) -> None:
        """Pass further samples to `listen`, and ticks of behaviour trees to `listen_to_tree`.

        A text that `listen` returns stops the current motion; the text is the reason.
        """
        self._listen, self._listen_to_tree = listen, listen_to_tree

    def reset(self, seed: int) -> None:
        """Restart at time 0; equal seeds give equal worlds."""
        if seed < 0:
            raise UsageError(f"the seed is {seed}; give 0 or more")
        self.close()
        self._seed, self._ticks, self._last_sampled_tick = seed, 0, -1
        # a reset of PyBullet leaves internal state behind; only a new simulator repeats a run exactly
        self._engine = engine = Engine(gui=self._gui)
        # the detection noise has a random stream of its own, so start poses do not depend on it
        scenario, generator = self._scenario, np.random.default_rng([seed, 0])
        for placement in scenario.placements:
            x_share, y_share, yaw_share = (generator.random(3) * 2 - 1).tolist()
            body_height = placement.body.shape.height
            x, y = placement.x + x_share * scenario.scatter_m, placement.y + y_share * scenario.scatter_m
            yaw = placement.yaw + yaw_share * scenario.scatter_rad
            if (start := self._starts.get(placement.body.name)) is not None:
                x, y, yaw = start.x, start.y, yaw if start.turn is None else start.turn
            centre = (x, y, placement.bottom + body_height / 2 + 5e-4)
            engine.add(
                placement.body.name, placement.body.shape, placement.mass_kg, centre, yaw, placement.colour
            )
        bodies = {placement.body.name: placement.body for placement in scenario.placements}
        arm, bodies_by_name = Arm(engine), MappingProxyType(bodies)
        self._scene = Scene(engine, arm, bodies_by_name, lambda tick: self._listen_to_tree(tick))
        self._scene.arm.drive()
        for _ in range(_SETTLING_STEPS):
            engine.step()

    def sample(self) -> Sample:
        """Return the current sample with detection noise; repeated calls give equal samples."""
        self._open_engine()
        sample_number = self._ticks // _TICKS_PER_SAMPLE
        errors = _displacements(self._noise_m, self._seed, sample_number, len(self._scene.bodies))
        objects = {
            name: self._tracked_object(body, self._scene.pose(name), error)
            for (name, body), error in zip(self._scene.bodies.items(), errors, strict=True)
        }
        x, y, z = self._scene.arm.position.tolist()
        signals = {"tool_x": x, "tool_y": y, "tool_z": z, "finger_width": self._scene.arm.width}
        return Sample(self.time_ns, objects, signals)

    def step(self) -> None:
        """Advance to the time of the next sample; the robot holds still."""
        self.run(self._scene.arm.wait(1 / SAMPLES_PER_S))

    def push(self, name: str, path: Sequence[tuple[float, float]], yaw: float | None = None) -> Outcome:
        """Push an object's centre along points (x, y); turn the object to `yaw` at the end, if given.

        Raises:
            UsageError: no such object, or the robot does not push.
        """
        coordinates = [number for point in path for number in point]
        self._refuse_unless("push", name, coordinates and [*coordinates, 0.0 if yaw is None else yaw])
        return self._move(name, pushing(self._scene, name, path, yaw))

    def place(
        self, name: str, x: float, y: float, yaw: float | None = None, via: Sequence[tuple[float, float]] = ()
    ) -> Outcome:
        """Pick an object up, carry it along `via`, and place its centre at (x, y).

        A yaw of None keeps the yaw.

        Raises:
            UsageError: no such object, or the robot does not pick.
        """
        self._refuse_unless("place", name, [x, y, 0.0 if yaw is None else yaw])
        return self._move(name, self._scenario.placing(self._scene, name, (x, y), yaw, via))

    def script(self) -> Generator[None, None, Outcome]:
        """Return the motion of the robot without a planner."""
        return self._scenario.script(self._scene)

    def run(
        self, motion: Generator[None, None, _Result], is_over: Callable[[], object] = lambda: False
    ) -> _Result | None:
        """Run a motion and return its result; None if `is_over` stops the motion before its end.

        Raises:
            UsageError: the world is closed.
        """
        while not is_over():
            try:
                next(motion)
            except StopIteration as end:
                result: _Result = end.value
                return result
            self.tick()
        return None

    def _move(self, name: str, motion: Generator[None, None, Outcome]) -> Outcome:
        """Run a motion of a body to its end, or until the listener stops it."""
        self._halt_reason = ""
        if (result := self.run(motion, lambda: self._halt_reason)) is not None:
            return result
        reason = self._halt_reason
        motion.close()
        if self._scenario.skill == "place":
            self.run(put_back(self._scene, name))
        elif self._scene.arm.holds:
            self.run(let_go(self._scene, WIDEST))
        return Outcome(False, reason)

    def follow(self, motion: Generator[None, None, _Result], duration_ns: int | None) -> _Result | None:
        """Run a motion for a time, and return its result; None if the motion does not end in that time.

        After an earlier end of the motion, the robot holds still until the time is over. Without a duration,
        the motion runs to its end.
        """
        if duration_ns is None:
            return self.run(motion)
        end_ns = self.time_ns + duration_ns
        result = self.run(motion, lambda: self.time_ns >= end_ns)
        self.run(self._scene.arm.rest(), lambda: self.time_ns >= end_ns)
        return result

    def tick(self) -> None:
        """Advance by one command of the arm."""
        engine = self._open_engine()
        self._emit()
        start_s = time.monotonic() if self._gui else 0.0
        self._inject()
        self._scene.arm.drive()
        for _ in range(STEPS_PER_TICK):
            engine.step()
        self._ticks += 1
        if self._gui:
            time.sleep(max(0.0, start_s + 1 / TICKS_PER_S - time.monotonic()))
        self._emit()

    def close(self) -> None:
        """Release the simulator."""
        if self._engine is not None:
            self._engine.close()
            self._engine = None

    def _emit(self) -> None:
        """Pass the current sample to the listener, if a sample is due at this tick and was not passed yet."""
        if self._ticks % _TICKS_PER_SAMPLE == 0 and self._ticks != self._last_sampled_tick:
            self._last_sampled_tick = self._ticks
            self._halt_reason = self._listen(self.sample()) or ""

    def _inject(self) -> None:
        if not self._injections:
            return
        active_kinds = {injection.kind for injection in self._injections if injection.holds(self.time_ns)}
        self._scene.arm.limp = "drop" in active_kinds
        self._scene.engine.set_grip(_OIL if "slip" in active_kinds else _RUBBER)

    def _tracked_object(self, body: Body, pose: Pose, error: tuple[float, float]) -> TrackedObject:
        detected_pose = Pose(pose.position + np.array([*error, 0.0]), pose.rotation)
        yaw = pose.yaw if isinstance(body.shape, Box) and pose.is_level else None
        return TrackedObject(
            footprint(body.shape, detected_pose),
            class_name=body.class_name,
            yaw=yaw,
            height=None if body.support else height(body.shape, detected_pose),
            uncertainty=self._noise_m,
        )

    def _open_engine(self) -> Engine:
        """Return the physics.

        Raises:
            UsageError: the world is closed.
        """
        if self._engine is None:
            raise UsageError(f"the world {self.name} is closed; make another one")
        return self._engine

    def _refuse_unless(self, skill: str, name: str, coordinates: Sequence[float]) -> None:
        self._open_engine()
        if self._scenario.skill != skill:
            robot_skill = self._scenario.skill
            raise UsageError(f"the robot of {self.name} does not {skill} objects; it can {robot_skill} them")
        movable_names = [body.name for body in self.bodies if body.movable]
        if name not in movable_names:
            raise UsageError(f"{name!r} cannot be moved in {self.name}; {', '.join(movable_names)} can")
        if not coordinates or not all(map(math.isfinite, coordinates)):
            raise UsageError(f"{name} cannot be moved to {list(coordinates)}; give finite numbers")


def _displacements(
    radius_m: float, seed: int, sample_number: int, body_count: int
) -> list[tuple[float, float]]:
    """Return the detection error of each body in a sample, metres along x and y.

    Errors are uniform on a disc of `radius_m`. They depend only on the arguments, so a repeated sample has
    equal errors.
    """
    if radius_m == 0:
        return [(0.0, 0.0)] * body_count
    random_numbers = np.random.default_rng([seed, sample_number, 1]).random((body_count, 2))
    # the square root makes the density uniform over the disc
    radii = (radius_m * np.sqrt(random_numbers[:, 0])).tolist()
    angles = (2 * math.pi * random_numbers[:, 1]).tolist()
    return [(r * math.cos(a), r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]


SCENARIOS: tuple[str, ...] = ("push", "pick-place", "table-setting")
"""Names of the scenarios; each has a module and a specification in the folder `scenarios`."""


def make_world(name: str, **conditions: Unpack[Conditions]) -> Tabletop:
    """Create the world of a scenario at time 0; `Conditions` explains the arguments.

    Raises:
        UsageError: there is no such scenario, or an argument of `Tabletop` is invalid.
    """
    return Tabletop(scenario_of(name), **conditions)


def default_specification(name: str) -> Specification:
    """Return the default specification of a scenario.

    Raises:
        UsageError: there is no such scenario.
    """
    filename = f"{scenario_of(name).name.replace('-', '_')}.spatial"
    file = resources.files("spatial_replay.simulation.scenarios") / filename
    return parse_specification(file.read_text(encoding="utf-8"), filename=filename)


def scenario_of(name: str) -> Scenario:
    """Return the definition of a scenario.

    Raises:
        UsageError: there is no such scenario, or py_trees is not installed.
    """
    if name not in SCENARIOS:
        raise UsageError(f"there is no scenario {name!r}; there are {', '.join(SCENARIOS)}")
    with importing(f"the world {name} needs py_trees", extra="sim"):
        module = import_module(f"spatial_replay.simulation.scenarios.{name.replace('-', '_')}")
    scenario: Scenario = module.SCENARIO
    return scenario
