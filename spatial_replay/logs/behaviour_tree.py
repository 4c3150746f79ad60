"""Behaviour trees as messages: ticks of py_trees, and the log of Nav2's behaviour trees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple, Protocol

from spatial_replay.logs.schemas.BehaviourTree_pb2 import BehaviourTree
from spatial_replay.logs.topics import BEHAVIOUR_TREE, protobuf_channel

TREE_CHANNEL: Final = protobuf_channel(BEHAVIOUR_TREE, BehaviourTree)

NAV2_LOG: Final = "nav2_msgs/msg/BehaviorTreeLog"
"""The type of Nav2's messages about its behaviour tree."""


class TreeNode(NamedTuple):
    """A node of a behaviour tree.

    Attributes:
        kind: such as Sequence, Selector, Retry, or Action for a leaf; empty if the log does not say.
        parent: index of the node above among the nodes; None for the root, or if the log does not say.
        status: RUNNING, SUCCESS or FAILURE; INVALID if it was not ticked since the tree began or was reset.
    """

    name: str
    kind: str
    parent: int | None
    status: str


class TreeTick(NamedTuple):
    """A behaviour tree after a tick that changed the status of a node: depth first, children in order."""

    number: int | None
    nodes: tuple[TreeNode, ...]

    def payload(self, time_ns: int) -> bytes:
        """Return the message of this tick at a time on the clock of the samples."""
        message = BehaviourTree(time_ns=time_ns, tick=self.number)
        for node in self.nodes:
            status = BehaviourTree.Status.Value(f"STATUS_{node.status}")
            message.nodes.add(name=node.name, type=node.kind, parent=node.parent, status=status)
        return message.SerializeToString(deterministic=True)


class Behaviour(Protocol):
    """The part of a behaviour of py_trees that is logged."""

    name: str
    status: Any

    @property
    def children(self) -> Sequence[Any]: ...


def tree_nodes(root: Behaviour) -> tuple[TreeNode, ...]:
    """Return the nodes of a tree of py_trees."""
    nodes: list[TreeNode] = []
    branches: list[tuple[int | None, Behaviour]] = [(None, root)]
    while branches:
        parent, behaviour = branches.pop()
        kind = type(behaviour).__name__ if behaviour.children else "Action"
        branches += [(len(nodes), child) for child in reversed(behaviour.children)]
        nodes.append(TreeNode(behaviour.name, kind, parent, behaviour.status.name))
    return tuple(nodes)


class Nav2Tree:
    """The nodes of a tree of Nav2, from its log of status changes.

    The log names no parents. Nodes have the order of their numbers, which is depth first. Older versions of
    Nav2 number none; then nodes have the order of their first change.
    """

    def __init__(self) -> None:
        self._nodes: dict[int | str, TreeNode] = {}

    def add(self, log: Any) -> tuple[TreeNode, ...]:
        """Take a message of type `NAV2_LOG`, and return the nodes after it."""
        for change in log.event_log:
            key = getattr(change, "uid", change.node_name)
            if key in self._nodes and self._nodes[key].name != change.node_name:
                # another tree was loaded, and numbers its nodes from 1 again
                self._nodes.clear()
            is_active = change.current_status in ("RUNNING", "SUCCESS", "FAILURE")
            status = change.current_status if is_active else "INVALID"
            self._nodes[key] = TreeNode(change.node_name, "", None, status)
        keys = sorted(self._nodes, key=lambda key: key if isinstance(key, int) else 0)
        return tuple(self._nodes[key] for key in keys)
