"""Placing bodies by a behaviour tree: detect, pick, carry, place, and recover from failures.

The only module that knows py_trees.
"""

from __future__ import annotations

from collections import abc
from collections.abc import Callable, Generator, Mapping

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Selector, Sequence
from py_trees.decorators import Retry

from spatial_replay.simulation.grasp import Grasp, Point, best_grasp
from spatial_replay.simulation.picking import carry, let_go, missed, pick_up, set_down
from spatial_replay.simulation.scene import Scene
from spatial_replay.simulation.world import Execution, Stage, TreeNode, TreeTick

Goal = tuple[Point, float | None]
"""The target position of a body, and its yaw there; None for any yaw."""

_ATTEMPTS = 3
_TURNED = 0.15
"""The tolerance of the yaw, in radians."""


def setting_by_tree(
    scene: Scene, goals: Mapping[str, Goal], via: abc.Sequence[Point] = ()
) -> Generator[None, None, Execution]:
    """Place bodies one after the other, with a few attempts each; carry them along some points."""
    blackboard = _Blackboard()
    tasks = [_task(scene, name, goal, blackboard, via) for name, goal in goals.items()]
    tree = Sequence("set", memory=True, children=tasks)
    ticks = _Ticks(scene, tree)
    ticks.tick()
    while tree.status is Status.RUNNING:
        yield
        ticks.tick()
    succeeded = tree.status is Status.SUCCESS
    done = f"placed {', '.join(goals)}"
    if blackboard.failures:
        done += f", after this went wrong: {'; '.join(each.reason for each in blackboard.failures)}"
    return Execution(True, done) if succeeded else blackboard.failures[-1]


class _Ticks:
    """The ticks of a tree; those that change the status of a node are reported."""

    def __init__(self, scene: Scene, tree: Behaviour) -> None:
        self._scene, self._tree, self._count = scene, tree, 0
        self._reported: tuple[TreeNode, ...] = ()

    def tick(self) -> None:
        self._tree.tick_once()
        nodes = tuple(_nodes(self._tree, None, []))
        if nodes != self._reported:
            self._scene.report_tick(TreeTick(self._count, nodes))
        self._reported, self._count = nodes, self._count + 1


def _nodes(tree: Behaviour, parent: int | None, found: list[TreeNode]) -> list[TreeNode]:
    kind = type(tree).__name__ if tree.children else "Action"
    place = len(found)
    found.append(TreeNode(tree.name, kind, parent, tree.status.name))
    for child in tree.children:
        _nodes(child, place, found)
    return found


class _Blackboard:
    """The blackboard of a tree: the grasp of each body, and the failures so far."""

    def __init__(self) -> None:
        self.grasps: dict[str, Grasp] = {}
        self.failures: list[Execution] = []


def _task(
    scene: Scene, name: str, goal: Goal, blackboard: _Blackboard, via: abc.Sequence[Point]
) -> Behaviour:
    """Return the subtree that places one body."""
    point, _ = goal

    def recover() -> Generator[None, None, str]:
        """Open the gripper, and fail, so that the tree starts another attempt."""
        yield from let_go(scene, _opening(blackboard, name))
        return "another attempt"

    def leave() -> Generator[None, None, str]:
        yield from let_go(scene, _opening(blackboard, name))
        return missed(scene, name, point)

    steps: dict[str, tuple[Stage, _Motion]] = {
        "pick": ("pick", lambda: pick_up(scene, name, blackboard.grasps[name])),
        "carry": ("way", lambda: carry(scene, name, blackboard.grasps[name], point, via)),
        "place": ("place", lambda: set_down(scene, name, point)),
        "leave": ("place", leave),
    }
    leaves = (_Moving(f"{verb} {name}", motion, blackboard, stage) for verb, (stage, motion) in steps.items())
    stages = [_Detecting(scene, name, goal, blackboard), *leaves]
    move = Sequence(f"move {name}", memory=True, children=stages)
    options = [_Placed(scene, name, goal), move, _Moving(f"recover {name}", recover, None)]
    attempt = Selector(f"bring {name}", memory=True, children=options)
    return Retry(f"try {name}", attempt, num_failures=_ATTEMPTS)


def _opening(blackboard: _Blackboard, name: str) -> float:
    return blackboard.grasps[name].opening if name in blackboard.grasps else 0.05


_Motion = Callable[[], Generator[None, None, str]]
"""A motion that returns the reason of its failure, or ""."""


class _Moving(Behaviour):
    """A motion as a leaf of the tree: each tick of the tree is one tick of the motion."""

    def __init__(
        self, name: str, motion: _Motion, blackboard: _Blackboard | None, stage: Stage | None = None
    ) -> None:
        super().__init__(name)
        self._stage = stage
        self._begin = motion
        self._blackboard = blackboard
        self._motion: Generator[None, None, str] | None = None

    def initialise(self) -> None:
        """Start the motion from its beginning."""
        self._motion = self._begin()

    def update(self) -> Status:
        """Advance the motion by one tick."""
        if self._motion is None:
            return Status.INVALID
        try:
            next(self._motion)
        except StopIteration as end:
            if end.value and self._blackboard is not None:
                self._blackboard.failures.append(Execution(False, end.value, self._stage))
            return Status.FAILURE if end.value else Status.SUCCESS
        return Status.RUNNING


class _Detecting(Behaviour):
    """Detect the pose of a body, and choose a grasp for its goal."""

    def __init__(self, scene: Scene, name: str, goal: Goal, blackboard: _Blackboard) -> None:
        super().__init__(f"detect {name}")
        self._scene, self._body, self._goal, self._blackboard = scene, name, goal, blackboard

    def update(self) -> Status:
        """Choose the grasp."""
        grasp = best_grasp(self._scene, self._body, *self._goal)
        if isinstance(grasp, Execution):
            self._blackboard.failures.append(grasp)
            return Status.FAILURE
        self._blackboard.grasps[self._body] = grasp
        return Status.SUCCESS


class _Placed(Behaviour):
    """Whether a body is at its goal already."""

    def __init__(self, scene: Scene, name: str, goal: Goal) -> None:
        super().__init__(f"is {name} placed?")
        self._scene, self._body, self._goal = scene, name, goal

    def update(self) -> Status:
        """Compare position and yaw with the goal."""
        point, yaw = self._goal
        is_there = not missed(self._scene, self._body, point)
        turned = 0.0 if yaw is None else abs(self._scene.pose(self._body).turned_from(yaw))
        return Status.SUCCESS if is_there and turned <= _TURNED else Status.FAILURE
