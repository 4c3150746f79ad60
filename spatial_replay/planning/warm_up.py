"""Compiled code loaded before the first sample, so that no decision waits for it."""

from __future__ import annotations

from spatial_replay.geometry.footprint import Footprint, TrackedObject
from spatial_replay.planning.black_box import BlackBox
from spatial_replay.planning.planner import Planner
from spatial_replay.planning.settings import Settings
from spatial_replay.planning.workspace import Grid, Workspace
from spatial_replay.spec import parse_specification
from spatial_replay.trace.sample import Sample


def warm_up() -> None:
    """Decide on a push that nobody makes.

    With nothing in the compiler's cache this takes many seconds, otherwise a fraction of one.
    """
    task = parse_specification("F (cup leftof jug and cup dist jug >= 1)")
    workspace = Workspace(Grid(0.0, 0.0, 1.0, 8, 8), obstacles=(Footprint.box(0, 0, 1, 1),))
    box = BlackBox(Planner(task, Settings(workspace, "push")))
    things = {
        "cup": TrackedObject(Footprint.box(6, 6, 7, 7), yaw=0.0, height=(0.0, 1.0)),
        "jug": TrackedObject(Footprint.disc(4, 4, 1), height=(0.0, 1.0)),
    }
    box.observe(Sample(0, things))
    box.decide()
