"""A robot that sets a table: fork, knife and spoon next to a plate, a cup behind the plate.

A behaviour tree places bodies: detect, pick, carry, place, and recover from failures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence

from py_trees import composites
from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.decorators import Retry

from spatial_replay.logs.behaviour_tree import TreeNode, TreeTick, tree_nodes
from spatial_replay.planning.decisions import Outcome, Stage
from spatial_replay.simulation.arm import (
    Grasp,
    Point,
    Scene,
    best_grasp,
    carry,
    let_go,
    miss_text,
    pick_up,
    set_down,
)
from spatial_replay.simulation.tabletop import Placement, Scenario
from spatial_replay.simulation.world import Body, Box, Cylinder

# ----------------------------------------------------------------------------------------- the behaviour tree

Goal = tuple[Point, float | None]
"""Target position and yaw of a body; None for any yaw."""

_ATTEMPTS = 3
"""Maximum number of attempts to place a body."""
_TURNED = 0.15
"""Tolerance of the yaw, radians."""


def setting_by_tree(
    scene: Scene, goals: Mapping[str, Goal], via: Sequence[Point] = ()
) -> Generator[None, None, Outcome]:
    """Place bodies in turn, with up to `_ATTEMPTS` attempts each; each body is carried along `via`."""
    blackboard = _Blackboard()
    tasks = [_task(scene, name, goal, blackboard, via) for name, goal in goals.items()]
    tree = composites.Sequence("set", memory=True, children=tasks)
    ticks = _Ticks(scene, tree)
    ticks.tick()
    while tree.status is Status.RUNNING:
        yield
        ticks.tick()
    is_success = tree.status is Status.SUCCESS
    summary = f"placed {', '.join(goals)}"
    if blackboard.failures:
        summary += f", after this went wrong: {'; '.join(failure.reason for failure in blackboard.failures)}"
    return Outcome(True, summary) if is_success else blackboard.failures[-1]


class _Ticks:
    """Runner of a tree, which reports only the ticks that change the status of a node."""

    def __init__(self, scene: Scene, tree: Behaviour) -> None:
        self._scene, self._tree, self._tick_count = scene, tree, 0
        self._reported_nodes: tuple[TreeNode, ...] = ()

    def tick(self) -> None:
        self._tree.tick_once()
        nodes = tree_nodes(self._tree)
        if nodes != self._reported_nodes:
            self._scene.report_tick(TreeTick(self._tick_count, nodes))
        self._reported_nodes, self._tick_count = nodes, self._tick_count + 1


class _Blackboard:
    """The blackboard of a tree: the grasp of each body, and the failures so far."""

    def __init__(self) -> None:
        self.grasps: dict[str, Grasp] = {}
        self.failures: list[Outcome] = []


def _task(scene: Scene, name: str, goal: Goal, blackboard: _Blackboard, via: Sequence[Point]) -> Behaviour:
    """Return the subtree that places one body."""
    point, _ = goal

    def recover() -> Generator[None, None, str]:
        """Open the gripper, and return a failure; the tree then starts another attempt."""
        yield from let_go(scene, _opening(blackboard, name))
        return "another attempt"

    def leave() -> Generator[None, None, str]:
        yield from let_go(scene, _opening(blackboard, name))
        return miss_text(scene, name, point)

    motions_by_verb: dict[str, tuple[Stage, _Motion]] = {
        "pick": ("pick", lambda: pick_up(scene, name, blackboard.grasps[name])),
        "carry": ("way", lambda: carry(scene, name, blackboard.grasps[name], point, via)),
        "place": ("place", lambda: set_down(scene, name, point)),
        "leave": ("place", leave),
    }
    leaves = (
        _Moving(f"{verb} {name}", motion, blackboard, stage)
        for verb, (stage, motion) in motions_by_verb.items()
    )
    move_children = [_Detecting(scene, name, goal, blackboard), *leaves]
    move = composites.Sequence(f"move {name}", memory=True, children=move_children)
    attempt_children = [_Placed(scene, name, goal), move, _Moving(f"recover {name}", recover, None)]
    attempt = composites.Selector(f"bring {name}", memory=True, children=attempt_children)
    return Retry(f"try {name}", attempt, num_failures=_ATTEMPTS)


def _opening(blackboard: _Blackboard, name: str) -> float:
    return blackboard.grasps[name].opening if name in blackboard.grasps else 0.05


_Motion = Callable[[], Generator[None, None, str]]
"""A motion that returns the reason of its failure, or ""."""


class _Moving(Behaviour):
    """A motion as a leaf of the tree; each tick of the tree advances the motion by one tick."""

    def __init__(
        self, name: str, motion: _Motion, blackboard: _Blackboard | None, stage: Stage | None = None
    ) -> None:
        super().__init__(name)
        self._stage = stage
        self._begin = motion
        self._blackboard = blackboard
        self._motion: Generator[None, None, str] | None = None

    def initialise(self) -> None:
        self._motion = self._begin()

    def update(self) -> Status:
        if self._motion is None:
            return Status.INVALID
        try:
            next(self._motion)
        except StopIteration as end:
            if end.value and self._blackboard is not None:
                self._blackboard.failures.append(Outcome(False, end.value, self._stage))
            return Status.FAILURE if end.value else Status.SUCCESS
        return Status.RUNNING


class _Detecting(Behaviour):
    """Detect the pose of a body, and choose a grasp for its goal."""

    def __init__(self, scene: Scene, name: str, goal: Goal, blackboard: _Blackboard) -> None:
        super().__init__(f"detect {name}")
        self._scene, self._body, self._goal, self._blackboard = scene, name, goal, blackboard

    def update(self) -> Status:
        grasp = best_grasp(self._scene, self._body, *self._goal)
        if isinstance(grasp, Outcome):
            self._blackboard.failures.append(grasp)
            return Status.FAILURE
        self._blackboard.grasps[self._body] = grasp
        return Status.SUCCESS


class _Placed(Behaviour):
    """The condition that a body is at its goal."""

    def __init__(self, scene: Scene, name: str, goal: Goal) -> None:
        super().__init__(f"is {name} placed?")
        self._scene, self._body, self._goal = scene, name, goal

    def update(self) -> Status:
        """Compare position and yaw with the goal."""
        point, yaw = self._goal
        is_near = not miss_text(self._scene, self._body, point)
        yaw_error = 0.0 if yaw is None else abs(self._scene.pose(self._body).turned_from(yaw))
        return Status.SUCCESS if is_near and yaw_error <= _TURNED else Status.FAILURE


# ----------------------------------------------------------------------------------------------- the scenario

_UPRIGHT = math.pi / 2
"""Yaw of cutlery that points along y, away from the diner, radians."""
_STEEL = (0.75, 0.77, 0.8)


def _placing(
    scene: Scene, name: str, goal: Point, yaw: float | None, via: Sequence[Point]
) -> Generator[None, None, Outcome]:
    return setting_by_tree(scene, {name: (goal, yaw)}, via)


def _script(scene: Scene) -> Generator[None, None, Outcome]:
    x, y = scene.place_of("plate")
    goals: dict[str, tuple[Point, float | None]] = {
        "fork": ((x - 0.14, y), _UPRIGHT),
        "knife": ((x + 0.13, y), _UPRIGHT),
        "spoon": ((x, y - 0.135), 0.0),
        "cup": ((x + 0.08, y + 0.13), None),
    }
    return setting_by_tree(scene, goals)


def _cutlery(name: str, x: float, y: float, yaw: float) -> Placement:
    return Placement(Body(name, "cutlery", Box(0.16, 0.02, 0.012)), x, y, yaw, 0.05, _STEEL)


_CUP = Body("cup", "cup", Cylinder(0.03, 0.07))
_PLATE = Body("plate", "plate", Cylinder(0.08, 0.012), movable=False, support=True)
_MAT = Body("mat", "mat", Box(0.4, 0.42, 0.002), movable=False, support=True)

SCENARIO = Scenario(
    name="table-setting",
    placements=(
        _cutlery("fork", 0.25, 0.42, 0.3),
        _cutlery("knife", 0.25, -0.45, 0.9),
        _cutlery("spoon", 0.02, 0.5, 1.2),
        Placement(_CUP, 0.45, -0.38, 0.0, 0.12, (0.35, 0.5, 0.75)),
        Placement(_PLATE, 0.48, 0.0, 0.0, 0.8, (0.95, 0.95, 0.95), bottom=_MAT.shape.height),
        # mass 0 fixes the body
        Placement(_MAT, 0.48, 0.0, _UPRIGHT, 0.0, (0.3, 0.45, 0.4)),
    ),
    workspace={
        "area": (-0.3, -0.65, 0.68, 0.65),
        "nearest": 0.33,
        "farthest": 0.7,
        "yaws": (0.0, _UPRIGHT / 2, _UPRIGHT, 1.5 * _UPRIGHT),
    },
    skill="place",
    script=_script,
    placing=_placing,
)
