"""A planner inside a behaviour tree of py_trees, and behaviour trees in bags of Nav2."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import spatial_replay as sr
from bags.bag_files import write_ros2
from report.report_pages import page_of
from spatial_replay.logs.schemas.BehaviourTree_pb2 import BehaviourTree
from spatial_replay.logs.topics import BEHAVIOUR_TREE
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


NAV2 = {
    "nav2_msgs/msg/BehaviorTreeStatusChange": (
        "builtin_interfaces/Time timestamp\nstring node_name\nuint16 uid\nstring previous_status\n"
        "string current_status\n"
    ),
    "nav2_msgs/msg/BehaviorTreeLog": (
        "builtin_interfaces/Time timestamp\nBehaviorTreeStatusChange[] event_log\n"
    ),
}
NAMES = (
    "builtin_interfaces/msg/Time",
    "geometry_msgs/msg/Point",
    "geometry_msgs/msg/Quaternion",
    "geometry_msgs/msg/Pose",
    "std_msgs/msg/Header",
    "geometry_msgs/msg/PoseStamped",
    *NAV2,
)
MAPPING = "topics:\n  /pose: {name: robot, shape: {disc: 0.2}}\n"
NEAR = sr.parse_specification("G robot dist robot <= 1")


def nav2_bag(folder: Path, logs: Sequence[tuple[str, float, Sequence[tuple[str, int, str]]]]) -> Path:
    """A bag of ROS 2 of a robot that drives along x for two seconds, and of logs of behaviour trees."""
    types = get_typestore(Stores.ROS2_JAZZY)
    for name, text in NAV2.items():
        types.register(get_types_from_msg(text, name))
    time, point, quaternion, pose, header, stamped, change, log = (types.types[name] for name in NAMES)
    sent = []
    for number in range(21):
        place = pose(point(0.1 * number, 0.0, 0.0), quaternion(0.0, 0.0, 0.0, 1.0))
        content = stamped(header(time(100 + number // 10, number % 10 * 10**8), "map"), place)
        sent.append(("/pose", NAMES[5], number * 10**8, content))
    for topic, seconds, nodes in logs:
        # events count on the wall's clock, messages on that of the robot
        events = [change(time(1_700_000_000, 0), name, uid, "IDLE", status) for name, uid, status in nodes]
        content = log(time(100 + int(seconds), int(seconds % 1 * 1e9)), events)
        sent.append((topic, NAMES[7], int(seconds * 1e9), content))
    return write_ros2(folder, sorted(sent, key=lambda message: message[2]), typestore=types)


def statuses(tick: BehaviourTree) -> dict[str, str]:
    return {node.name: BehaviourTree.Status.Name(node.status).removeprefix("STATUS_") for node in tick.nodes}


def test_a_replay_of_a_bag_has_the_ticks_of_nav2_on_the_clock_of_the_samples(tmp_path: Path) -> None:
    topic = "/behavior_tree_log"
    bag = nav2_bag(
        tmp_path / "drive",
        [
            (topic, 0.5, [("Navigate", 1, "RUNNING"), ("FollowPath", 3, "RUNNING")]),
            (topic, 1.25, [("Plan", 2, "SUCCESS"), ("FollowPath", 3, "FAILURE")]),
            (topic, 1.5, [("FollowPath", 3, "IDLE"), ("Spin", 4, "SKIPPED")]),
            # another tree numbers its nodes from 1 again
            (topic, 1.75, [("Dock", 1, "RUNNING")]),
        ],
    )
    (tmp_path / "drive.yaml").write_text(MAPPING)
    log, again = tmp_path / "drive.mcap", tmp_path / "again.mcap"
    replayed = sr.replay_log(bag, NEAR, output=log, mapping=tmp_path / "drive.yaml")
    ticks = ticks_of(log)
    assert [(tick.time_ns, statuses(tick)) for tick in ticks] == [
        (500_000_000, {"Navigate": "RUNNING", "FollowPath": "RUNNING"}),
        (1_250_000_000, {"Navigate": "RUNNING", "Plan": "SUCCESS", "FollowPath": "FAILURE"}),
        (
            1_500_000_000,
            {"Navigate": "RUNNING", "Plan": "SUCCESS", "FollowPath": "INVALID", "Spin": "INVALID"},
        ),
        (1_750_000_000, {"Dock": "RUNNING"}),
    ]
    assert sr.replay_log(log, NEAR, output=again).certificate == replayed.certificate
    assert ticks_of(again) == ticks
    sr.write_report(log, NEAR, output=tmp_path / "drive.html")
    first, second = page_of(tmp_path / "drive.html").facts["ticks"][-2:]
    assert [node["name"] for node in first["nodes"]] == ["Navigate", "Plan", "FollowPath", "Spin"]
    assert (first["times"], first["statuses"]) == ([1.5], ["1200"])
    assert (second["times"], second["statuses"]) == ([1.75], ["1"])


def test_the_trees_of_two_robots_have_a_root_each_on_the_clock_of_headers(tmp_path: Path) -> None:
    changes = {"/a/behavior_tree_log": "RUNNING", "/b/behavior_tree_log": "FAILURE"}
    bag = nav2_bag(
        tmp_path / "drive", [(topic, 1.0, [("Drive", 1, status)]) for topic, status in changes.items()]
    )
    (tmp_path / "drive.yaml").write_text(f"clock: header\n{MAPPING}")
    log = tmp_path / "drive.mcap"
    sr.replay_log(bag, NEAR, output=log, mapping=tmp_path / "drive.yaml")
    *_, last = ticks_of(log)
    assert last.time_ns == 101 * 10**9
    assert [(node.name, node.parent, node.status) for node in last.nodes] == [
        ("/a/behavior_tree_log", 0, BehaviourTree.STATUS_RUNNING),
        ("Drive", 0, BehaviourTree.STATUS_RUNNING),
        ("/b/behavior_tree_log", 0, BehaviourTree.STATUS_RUNNING),
        ("Drive", 2, BehaviourTree.STATUS_FAILURE),
    ]
