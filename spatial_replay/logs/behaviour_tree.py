"""Behaviour trees as messages: ticks of py_trees, and the log of Nav2's behaviour trees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple, Protocol

from spatial_replay.logs.schemas.BehaviourTree_pb2 import BehaviourTree
from spatial_replay.logs.topics import BEHAVIOUR_TREE, protobuf_channel

TREE_CHANNEL: Final = protobuf_channel(BEHAVIOUR_TREE, BehaviourTree)

NAV2_LOG: Final = "nav2_msgs/msg/BehaviorTreeLog"
"""Type of Nav2's behaviour-tree messages."""


class TreeNode(NamedTuple):
    """A node of a behaviour tree.

    Attributes:
        kind: type of the node, such as Sequence or Retry; Action for a leaf; empty for nodes of Nav2.
        parent: index of the parent node in `TreeTick.nodes`; None for the root, and for nodes of Nav2.
        status: RUNNING, SUCCESS or FAILURE; INVALID for a node without a tick since the tree's start or
            reset.
    """

    name: str
    kind: str
    parent: int | None
    status: str


class TreeTick(NamedTuple):
    """A behaviour tree after a tick that changed a status. Its nodes are in depth-first order."""

    number: int | None
    nodes: tuple[TreeNode, ...]

    def payload(self, time_ns: int) -> bytes:
        """Encode the tick as a message; `time_ns` is a time on the samples' clock."""
        message = BehaviourTree(time_ns=time_ns, tick=self.number)
        for node in self.nodes:
            status = BehaviourTree.Status.Value(f"STATUS_{node.status}")
            message.nodes.add(name=node.name, type=node.kind, parent=node.parent, status=status)
        return message.SerializeToString(deterministic=True)


class Behaviour(Protocol):
    """Attributes of a py_trees behaviour that are logged."""

    name: str
    status: Any

    @property
    def children(self) -> Sequence[Any]: ...


def tree_nodes(root: Behaviour) -> tuple[TreeNode, ...]:
    """Return the nodes of a py_trees tree, depth first."""
    nodes: list[TreeNode] = []
    branches: list[tuple[int | None, Behaviour]] = [(None, root)]
    while branches:
        parent, behaviour = branches.pop()
        kind = type(behaviour).__name__ if behaviour.children else "Action"
        # reversed, because the last branch of the stack comes first
        branches += [(len(nodes), child) for child in reversed(behaviour.children)]
        nodes.append(TreeNode(behaviour.name, kind, parent, behaviour.status.name))
    return tuple(nodes)


class Nav2Tree:
    """Nodes of a Nav2 behaviour tree, from its log of status changes.

    The log names no parents. Nodes are sorted by `uid`, a number that Nav2 assigns in depth-first order.
    Older versions of Nav2 give no `uid`; then nodes are in the order of their first status change.
    """

    def __init__(self) -> None:
        self._nodes: dict[int | str, TreeNode] = {}

    def add(self, log: Any) -> tuple[TreeNode, ...]:
        """Apply a message of type `NAV2_LOG`; return all nodes after its changes."""
        for change in log.event_log:
            node_key = getattr(change, "uid", change.node_name)
            if node_key in self._nodes and self._nodes[node_key].name != change.node_name:
                # Nav2 loaded another tree, and its uids start at 1 again
                self._nodes.clear()
            is_active = change.current_status in ("RUNNING", "SUCCESS", "FAILURE")
            status = change.current_status if is_active else "INVALID"
            self._nodes[node_key] = TreeNode(change.node_name, "", None, status)
        # a stable sort, so that node names of old versions stay in the order of first changes
        node_keys = sorted(self._nodes, key=lambda key: key if isinstance(key, int) else 0)
        return tuple(self._nodes[key] for key in node_keys)
