"""Placing things by a behaviour tree: detect, pick, carry, place, and recover from what went wrong.

The only module that knows py_trees.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping

from py_trees.behaviour import Behaviour
from py_trees.common import Status
from py_trees.composites import Selector, Sequence
from py_trees.decorators import Retry

from spatial_replay.simulation.grasp import Grasp, Point, best_grasp
from spatial_replay.simulation.picking import carry, let_go, missed, pick_up, set_down
from spatial_replay.simulation.scene import Scene
from spatial_replay.simulation.world import Execution

Goal = tuple[Point, float | None]
"""Where something belongs, and how it is turned there; None for any turn."""

_ATTEMPTS = 3
_TURNED = 0.15
"""Something that is turned by this much, in radians, is not as it should be."""


def setting_by_tree(scene: Scene, goals: Mapping[str, Goal]) -> Generator[None, None, Execution]:
    """Place some bodies one after the other, each tried anew when it goes wrong, a few times."""
    notes = _Notes()
    tasks = [_task(scene, name, goal, notes) for name, goal in goals.items()]
    tree = Sequence("set", memory=True, children=tasks)
    while True:
        tree.tick_once()
        if tree.status is not Status.RUNNING:
            break
        yield
    succeeded = tree.status is Status.SUCCESS
    done = f"placed {', '.join(goals)}"
    if notes.mishaps:
        done += f", after this went wrong: {'; '.join(notes.mishaps)}"
    return Execution(succeeded, done if succeeded else notes.mishaps[-1])


class _Notes:
    """What the parts of a tree tell each other: how a thing is held, and what went wrong so far."""

    def __init__(self) -> None:
        self.grasps: dict[str, Grasp] = {}
        self.mishaps: list[str] = []


def _task(scene: Scene, name: str, goal: Goal, notes: _Notes) -> Behaviour:
    """Bring one thing where it belongs."""
    point, _ = goal

    def recover() -> Generator[None, None, str]:
        """Let go of whatever is held, and say that another attempt is due."""
        yield from let_go(scene, _opening(notes, name))
        return "another attempt"

    def leave() -> Generator[None, None, str]:
        yield from let_go(scene, _opening(notes, name))
        return missed(scene, name, point)

    steps: dict[str, _Motion] = {
        "pick": lambda: pick_up(scene, name, notes.grasps[name]),
        "carry": lambda: carry(scene, name, notes.grasps[name], point),
        "place": lambda: set_down(scene, name, point),
        "leave": leave,
    }
    leaves: list[Behaviour] = [_Moving(f"{verb} {name}", motion, notes) for verb, motion in steps.items()]
    attempt = Selector(
        f"bring {name}",
        memory=True,
        children=[
            _Placed(scene, name, goal),
            Sequence(f"move {name}", memory=True, children=[_Detecting(scene, name, goal, notes), *leaves]),
            _Moving(f"recover {name}", recover, None),
        ],
    )
    return Retry(f"try {name}", attempt, num_failures=_ATTEMPTS)


def _opening(notes: _Notes, name: str) -> float:
    return notes.grasps[name].opening if name in notes.grasps else 0.05


_Motion = Callable[[], Generator[None, None, str]]
"""A motion that returns what went wrong, or ""."""


class _Moving(Behaviour):
    """A motion as a leaf of the tree: one tick of the one is one tick of the other."""

    def __init__(self, name: str, motion: _Motion, notes: _Notes | None) -> None:
        super().__init__(name)
        self._begin = motion
        self._notes = notes
        self._motion: Generator[None, None, str] | None = None

    def initialise(self) -> None:
        """Begin the motion anew."""
        self._motion = self._begin()

    def update(self) -> Status:
        """Go on by a tick."""
        if self._motion is None:
            return Status.INVALID
        try:
            next(self._motion)
        except StopIteration as end:
            if end.value and self._notes is not None:
                self._notes.mishaps.append(end.value)
            return Status.FAILURE if end.value else Status.SUCCESS
        return Status.RUNNING


class _Detecting(Behaviour):
    """See how a thing lies, and how to grasp it for its place."""

    def __init__(self, scene: Scene, name: str, goal: Goal, notes: _Notes) -> None:
        super().__init__(f"detect {name}")
        self._scene, self._body, self._goal, self._notes = scene, name, goal, notes

    def update(self) -> Status:
        """Look."""
        grasp = best_grasp(self._scene, self._body, *self._goal)
        if isinstance(grasp, str):
            self._notes.mishaps.append(grasp)
            return Status.FAILURE
        self._notes.grasps[self._body] = grasp
        return Status.SUCCESS


class _Placed(Behaviour):
    """Whether a thing is already where it belongs."""

    def __init__(self, scene: Scene, name: str, goal: Goal) -> None:
        super().__init__(f"is {name} placed?")
        self._scene, self._body, self._goal = scene, name, goal

    def update(self) -> Status:
        """Look."""
        point, yaw = self._goal
        is_there = not missed(self._scene, self._body, point)
        turned = 0.0 if yaw is None else abs(self._scene.pose(self._body).turned_from(yaw))
        return Status.SUCCESS if is_there and turned <= _TURNED else Status.FAILURE
