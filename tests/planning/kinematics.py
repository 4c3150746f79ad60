"""A table without physics: objects reach their targets unless they are stuck."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import spatial_replay as sr
from spatial_replay.planning import Outcome, moved_object


@dataclass
class Table:
    """Objects, a planner that observes them, and an `Executor` that moves them.

    Attributes:
        stuck: objects that do not move.
        slips: how many of the next motions end half way.
        stage: the stage at which these fail, if the robot says it.
    """

    objects: dict[str, sr.TrackedObject]
    planner: object
    stuck: set[str] = field(default_factory=set)
    slips: int = 0
    stage: str | None = None
    time_ns: int = 0
    samples: list[sr.Sample] = field(default_factory=list)

    def look(self):
        sample = sr.Sample(self.time_ns, self.objects)
        self.time_ns += 100_000_000
        self.samples.append(sample)
        self.planner.observe(sample)

    def execute(self, step):
        target = step.target
        if target.name in self.stuck:
            self.look()
            return Outcome(False, "it does not move")
        ends = target.waypoints if len(target.waypoints) > 1 else (target.waypoints[0],) * 2
        carried = self.planner.settings.skill == "place"
        start = self.objects[target.name]
        for number, end in enumerate(ends[1:], start=1):
            share = 1.0
            if self.slips and number == len(ends) - 1:
                self.slips -= 1
                share = 0.5
            x, y = (a + share * (b - a) for a, b in zip(ends[number - 1], end, strict=True))
            turn = target.turn if carried else 0.0
            self.objects[target.name] = moved_object(start, x, y, turn)
            self.look()
            if share < 1.0:
                return Outcome(False, "it slipped", self.stage)
        if target.turn and not carried:
            for number in range(1, 7):
                self.objects[target.name] = moved_object(start, *ends[-1], number / 6 * target.turn)
                self.look()
                if reason := getattr(self.planner, "stop_reason", ""):
                    return Outcome(False, reason)
        return Outcome(True, "it is there")


def run(planner, objects, most=50, **options):
    """Return all steps until nothing is left to execute, and the table after them."""
    table = Table(dict(objects), planner, **options)
    table.look()
    steps = []
    while len(steps) < most:
        step = planner.next_step()
        if step in steps:
            table.look()
            continue
        steps.append(step)
        if step.kind == "execute":
            planner.conclude(table.execute(step))
        elif step.kind != "wait":
            return steps, table
    raise AssertionError(f"still planning after {most} steps")


def block(x, y, yaw=0.0, size=0.032):
    shape = sr.Footprint.box(-size / 2, -size / 2, size / 2, size / 2)
    return moved_object(sr.TrackedObject(shape, yaw=0.0, height=(0.0, size)), x, y, yaw)


PUSHING = """
use spatial_spec
spec push = (F (green rightof red and green rightof blue))
    and ((not (green rightof red and green rightof blue)) U (red above blue))
    and (G (green dist red >= 0.03 and green dist blue >= 0.03 and red dist blue >= 0.03))
"""
BLOCKS = {
    "green": block(0.4, 0.0),
    "red": block(0.5, -0.05, math.pi / 4),
    "blue": block(0.6, 0.15, math.pi / 4),
}
