"""A log of a run whose behaviour tree fails."""

from __future__ import annotations

from pathlib import Path

import spatial_replay as sr
from spatial_replay.logs.schemas.BehaviourTree_pb2 import BehaviourTree
from spatial_replay.logs.topics import BEHAVIOUR_TREE


def write_ticked_log(log: Path) -> None:
    """Write a log of three seconds; its tree runs at first, fails after one and succeeds after two."""
    with sr.Recorder(log, specifications=sr.parse_specification("G cup dist cup <= 1")) as recorder:
        channel = recorder.channel(BEHAVIOUR_TREE, schema=BehaviourTree)
        for second, status in enumerate(("RUNNING", "FAILURE", "SUCCESS", None)):
            recorder.write(sr.Sample(second * 10**9, {"cup": sr.Footprint.disc(second, 0, 1)}))
            if status is not None:
                value = BehaviourTree.Status.Value(f"STATUS_{status}")
                tick = BehaviourTree(time_ns=second * 10**9)
                tick.nodes.add(name="motion", type="Sequence", status=value)
                tick.nodes.add(name="carry", type="Action", parent=0, status=value)
                channel.write(second * 10**9, tick)
