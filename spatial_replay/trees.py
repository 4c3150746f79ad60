"""A planner inside a behaviour tree of py_trees, with decisions and ticks in one log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType

from spatial_replay.errors import UsageError, importing
from spatial_replay.logs.behaviour_tree import TreeTick, tree_nodes
from spatial_replay.logs.schemas.BehaviourTree_pb2 import BehaviourTree
from spatial_replay.logs.topics import BEHAVIOUR_TREE
from spatial_replay.planning.decisions import Outcome, Stage, Step
from spatial_replay.recording.recorder import Recorder

with importing("behaviour trees take py_trees", extra="trees"):
    from py_trees.behaviour import Behaviour
    from py_trees.common import Status
    from py_trees.decorators import Decorator
    from py_trees.trees import BehaviourTree as Tree

_NO_STAGES: Mapping[str, Stage] = MappingProxyType({})


class PlannedSteps(Decorator):
    """A decorator that requests steps from a planner. Its child executes the steps.

    A tick requests the next step if no step is executed, and ticks the child during a step. When the child
    ends, the tick concludes the step. The reason of a failure is the feedback message of the failed
    behaviour. A step also fails if the planner stops it, or if a parent interrupts it.

    The status is RUNNING until the specification is satisfied (SUCCESS) or no path is left (FAILURE). Samples
    reach the planner by `recorder.write`, from inside the tree or outside.

    Attributes:
        step: the last step, whose target is the child's task; None before the first step.
    """

    def __init__(
        self, name: str, child: Behaviour, recorder: Recorder, stages: Mapping[str, Stage] = _NO_STAGES
    ) -> None:
        """Wrap the subtree that executes a step.

        Args:
            recorder: a recorder with a planner.
            stages: stage of a motion ("pick", "way" or "place") by the name of a behaviour. The stage fails
                if the behaviour, or a behaviour below it, fails.

        Raises:
            UsageError: the recorder has no planner.
        """
        super().__init__(name=name, child=child)
        if recorder.planner is None:
            raise UsageError(f"{recorder.name} has no planner; open the Recorder with planner=planner")
        self.step: Step | None = None
        self._recorder, self._planner, self._stages = recorder, recorder.planner, stages
        self._is_executing = False

    def tick(self) -> Iterator[Behaviour]:
        """Request a step if needed, and tick the child during a step."""
        if self.status is not Status.RUNNING:
            self.initialise()
        self._check_stop()
        if not self._is_executing and self._planner.has_observed:
            self.step = self._recorder.next_step()
            self.feedback_message = self.step.reason
            self._is_executing = self.step.kind == "execute"
        if self._is_executing:
            yield from self.decorated.tick()
        status = self.update()
        if status is not Status.RUNNING:
            self.stop(status)
        self.status = status
        yield self

    def update(self) -> Status:
        """Conclude the step if the child has ended."""
        if self._is_executing and self.decorated.status is not Status.RUNNING:
            self._conclude(self._outcome())
        kind = "wait" if self.step is None else self.step.kind
        return {"hold": Status.SUCCESS, "no path": Status.FAILURE}.get(kind, Status.RUNNING)

    def terminate(self, new_status: Status) -> None:
        """Conclude an interrupted step."""
        # py_trees interrupts a behaviour with the status INVALID
        if new_status is Status.INVALID and self._is_executing:
            self._conclude(Outcome(False, f"{self.name} was interrupted"))

    def _check_stop(self) -> None:
        reason = self._planner.stop_reason
        if self._is_executing and reason:
            self.decorated.stop(Status.INVALID)
            self._conclude(Outcome(False, reason))

    def _conclude(self, outcome: Outcome) -> None:
        self._is_executing = False
        self._recorder.conclude(outcome)

    def _outcome(self) -> Outcome:
        """Return the outcome of a step, after the child has ended."""
        tip = self.decorated.tip() or self.decorated
        if self.decorated.status is Status.SUCCESS:
            return Outcome(True, tip.feedback_message)
        ancestors = list(_ancestors(tip, self.decorated))
        failed = next(behaviour for behaviour in ancestors if behaviour.status is self.decorated.status)
        stages = (self._stages[behaviour.name] for behaviour in ancestors if behaviour.name in self._stages)
        return Outcome(False, f"{failed.name}: {failed.feedback_message or 'failed'}", next(stages, None))


def _ancestors(behaviour: Behaviour, root: Behaviour) -> Iterator[Behaviour]:
    """Yield a behaviour and its ancestors, up to a root."""
    yield behaviour
    while behaviour is not root and behaviour.parent is not None:
        behaviour = behaviour.parent
        yield behaviour


def record_ticks(tree: Tree, recorder: Recorder) -> None:
    """Record later ticks on `/plan/behaviour_tree`, if they change the status of a node.

    A tick has the time of the newest sample. Ticks before the first sample are not recorded.
    """
    channel = recorder.channel(BEHAVIOUR_TREE, schema=BehaviourTree)
    recorded_nodes: list[object] = [()]

    def record(tree: Tree) -> None:
        nodes, time_ns = tree_nodes(tree.root), recorder.newest_ns
        if time_ns is not None and nodes != recorded_nodes[-1]:
            recorded_nodes[-1] = nodes
            channel.write(time_ns, TreeTick(tree.count, nodes).payload(time_ns))

    tree.add_post_tick_handler(record)
