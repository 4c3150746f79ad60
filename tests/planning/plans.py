"""Planned runs without physics, in logs."""

from __future__ import annotations

from dataclasses import replace

import spatial_replay as sr
from planning.kinematics import BLOCKS, PUSHING, Table
from spatial_replay.planning import (
    PLAN_METADATA,
    BlackBox,
    Grid,
    Planner,
    Settings,
    Workspace,
    text_from_settings,
)
from spatial_replay.runs.run_log import run_log

PUSH = Settings(
    Workspace(Grid.over(0.3, -0.225, 0.75, 0.225, 0.005)), "push", margin=0.01, constraint_margin=0.005
)


class _Watched:
    """What a table shows its samples to: the black box and the log."""

    def __init__(self, box, log, seen_as):
        self._box, self._log, self._seen_as = box, log, seen_as
        self.settings = box.planner.settings

    def observe(self, sample):
        self._log.write(self._seen_as(sample))
        self._box.observe(sample)


def record_plan_of(
    path,
    text=PUSHING,
    objects=BLOCKS,
    settings=PUSH,
    told=None,
    seen_as=lambda sample: sample,
    most_told=None,
    **options,
):
    """A planned run in a log.

    Args:
        told: the settings that the log tells of, if they are not those that were planned with.
        seen_as: the sample that the log holds of each sample.
        most_told: how many decisions and outcomes the log holds, the first ones; all if it is None.
    """
    specification = replace(sr.parse_specification(text), filename="task.spatial")
    box = BlackBox(Planner(specification, settings))
    with run_log(path, [specification]) as log:
        kept = {"file": "task.spatial", "specification": box.planner.automaton.name}
        log.add_metadata(PLAN_METADATA, {**kept, "settings": text_from_settings(told or settings)})
        table = Table(dict(objects), _Watched(box, log, seen_as), **options)
        table.look()
        steps, said = [], []

        def tell(messages):
            said.append(messages)
            if most_told is None or len(said) <= most_told:
                log.write_messages(messages)

        while not steps or steps[-1].kind in ("execute", "wait"):
            step, messages = box.decide()
            if step in steps:
                table.look()
                continue
            tell(messages)
            steps.append(step)
            if step.kind == "execute":
                tell(box.conclude(table.execute(step)))
    return steps
