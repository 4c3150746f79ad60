"""The ticks of a robot's behaviour tree on a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, Final

from google.protobuf.message import DecodeError

from spatial_replay.logs.schemas.BehaviourTree_pb2 import BehaviourTree

MOST_TICKS: Final = 4_000
"""Limit of ticks in a page; later ticks are left out."""


def ticks_value(payloads: Sequence[bytes], first_ns: int) -> Sequence[Mapping[str, Any]]:
    """Return stretches of consecutive ticks with equal trees.

    A stretch has the nodes of its tree, the time of each tick, and one digit per node with its status.
    """
    ticks = _iter_ticks(payloads[:MOST_TICKS])
    values = []
    for nodes, tick_group in groupby(ticks, key=_shape):
        equal_ticks = list(tick_group)
        depths: list[int] = []
        for index, (_, _, parent) in enumerate(nodes):
            depths.append(depths[parent] + 1 if parent is not None and parent < index else 0)
        values.append(
            {
                "nodes": [
                    {"name": name, "type": node_type, "depth": depth}
                    for (name, node_type, _), depth in zip(nodes, depths, strict=True)
                ],
                "times": [(tick.time_ns - first_ns) / 1e9 for tick in equal_ticks],
                "statuses": ["".join(str(node.status % 10) for node in tick.nodes) for tick in equal_ticks],
            }
        )
    return values


def _iter_ticks(payloads: Sequence[bytes]) -> Iterator[BehaviourTree]:
    """Yield the ticks that can be decoded."""
    for payload in payloads:
        try:
            yield BehaviourTree.FromString(payload)
        except DecodeError:
            continue


def _shape(tick: BehaviourTree) -> Sequence[tuple[str, str, int | None]]:
    return [(node.name, node.type, node.parent if node.HasField("parent") else None) for node in tick.nodes]
