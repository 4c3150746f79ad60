"""A planner inside a behaviour tree of py_trees."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import spatial_replay as sr
from spatial_replay.logs.messages import BEHAVIOUR_TREE
from spatial_replay.logs.schemas.BehaviourTree_pb2 import BehaviourTree
from spatial_replay.planning import Grid, Workspace, moved_object, read_decisions
from spatial_replay.planning.decisions import points_along
from spatial_replay.sources import open_source

py_trees = pytest.importorskip("py_trees", reason="py_trees is not installed; it comes with the extra trees")

from spatial_replay.trees import PlannedSteps, record_ticks  # noqa: E402

Status = py_trees.common.Status

TASK = sr.parse_specification(
    "region tray = box(0.6, 0.2, 1.0, 0.6)\n"
    "spec served = F cup enclosedin tray\nspec safe = G cup dist vase >= 0.02\nspec task = served and safe"
)
SETTINGS = sr.Settings(
    Workspace(Grid.over(0.0, 0.0, 1.2, 0.8, cell_size=0.04), clearance=0.02),
    movable=("cup",),
    margin=0.01,
    constraint_margin=0.01,
)


class Cell:
    """A robot that carries a cup, beside a vase."""

    def __init__(self, recorder: sr.Recorder) -> None:
        self.recorder, self.time_ns = recorder, 0
        self.scene = {
            "cup": sr.TrackedObject(sr.Footprint.disc(0.1, 0.4, 0.05)),
            "vase": sr.TrackedObject(sr.Footprint.disc(0.4, 0.1, 0.08)),
        }

    def look(self) -> None:
        self.recorder.write(sr.Sample(self.time_ns, self.scene))
        self.time_ns += 100_000_000

    def move(self, name: str, x: float, y: float) -> None:
        self.scene = {**self.scene, name: moved_object(self.scene[name], x, y)}


class Leaf(py_trees.behaviour.Behaviour):
    """A leaf that calls a function at each tick, which returns whether it goes on, or why it fails."""

    def __init__(self, name: str, advance: Callable[[], bool | str]) -> None:
        super().__init__(name)
        self.advance = advance

    def update(self) -> Status:
        result = self.advance()
        self.feedback_message = result if isinstance(result, str) else ""
        return Status.FAILURE if isinstance(result, str) else Status.RUNNING if result else Status.SUCCESS


def planned_tree(log: Path, faults: list[str]) -> tuple[py_trees.trees.BehaviourTree, PlannedSteps, Cell]:
    """A tree that carries the cup; on its first ways it fails with the faults."""
    planner = sr.Planner(TASK, SETTINGS, name="task")
    cell = Cell(sr.Recorder(log, planner=planner))
    way: list[tuple[float, float]] = []

    def pick() -> bool:
        way[:] = points_along(planned.step.target.waypoints, 0.03)
        return False

    def carry() -> bool | str:
        cell.move("cup", *way.pop(0))
        return faults.pop() if faults and len(way) < 12 else bool(way)

    leaves = [Leaf("pick", pick), Leaf("carry", carry)]
    motion = py_trees.composites.Sequence("motion", memory=True, children=leaves)
    planned = PlannedSteps("set the table", motion, cell.recorder, {"pick": "pick", "carry": "way"})
    tree = py_trees.trees.BehaviourTree(planned)
    record_ticks(tree, cell.recorder)
    return tree, planned, cell


def ticks_of(log: Path) -> list[BehaviourTree]:
    payloads = (payload for batch, _ in open_source(log).iter_payloads(BEHAVIOUR_TREE) for payload in batch)
    return [BehaviourTree.FromString(payload) for payload in payloads]


def test_a_tree_of_py_trees_executes_a_plan_and_says_which_node_failed(tmp_path: Path) -> None:
    log = tmp_path / "cups.mcap"
    tree, planned, cell = planned_tree(log, ["the cup slipped"])
    tree.tick()
    # before the first sample nothing is decided
    assert planned.status is Status.RUNNING and planned.step is None
    while planned.status is Status.RUNNING:
        cell.look()
        tree.tick()
    cell.recorder.close()
    assert planned.status is Status.SUCCESS
    outcomes = [decision.outcome for decision in read_decisions(log).decisions if decision.kind == 1]
    assert [(outcome.succeeded, outcome.reason, outcome.at) for outcome in outcomes] == [
        (False, "carry: the cup slipped", "way"),
        (True, "", ""),
    ]
    assert sr.verify(log).differences == ()
    ticks = ticks_of(log)
    # one clock: the tick of the failure has the time of the outcome
    failed = next(tick for tick in ticks if tick.nodes[-1].status == BehaviourTree.STATUS_FAILURE)
    assert failed.time_ns == outcomes[0].end_ns
    assert [(node.name, node.type, node.parent) for node in failed.nodes] == [
        ("set the table", "PlannedSteps", 0),
        ("motion", "Sequence", 0),
        ("pick", "Action", 1),
        ("carry", "Action", 1),
    ]
    # a tick without a change is left out
    assert len(ticks) < tree.count


def test_a_step_fails_that_the_planner_stops_or_a_parent_interrupts(tmp_path: Path) -> None:
    log = tmp_path / "cups.mcap"
    tree, planned, cell = planned_tree(log, [])
    stops: list[str] = []
    for number in range(12):
        # somebody moves the vase onto the way
        cell.move("vase", 0.4, 0.1 + 0.025 * number)
        cell.look()
        stops.append(cell.recorder.planner.stop_reason)
        tree.tick()
    while planned.step.kind != "execute":
        cell.look()
        tree.tick()
    planned.stop(Status.INVALID)
    cell.recorder.close()
    reasons = [decision.outcome.reason for decision in read_decisions(log).decisions if decision.kind == 1]
    assert next(filter(None, stops)) == reasons[0]
    assert reasons[-1] == "set the table was interrupted"
