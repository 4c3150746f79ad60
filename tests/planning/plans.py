"""Planned runs without physics, in logs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import spatial_replay as sr
from planning.kinematics import BLOCKS, PUSHING, Table
from spatial_replay import Planner, Settings
from spatial_replay.logs.topics import PLAN_METADATA
from spatial_replay.planning import Grid, Workspace
from spatial_replay.planning.decision_log import BlackBox, plan_metadata
from spatial_replay.planning.settings import text_from_settings
from spatial_replay.runs.scripted import run_log

PUSH = Settings(
    Workspace(Grid.over(0.3, -0.225, 0.75, 0.225, 0.01)), "push", margin=0.01, constraint_margin=0.005
)


class _Watched:
    """The observer of a table, which passes samples to the black box and to the log."""

    def __init__(self, box, log, recorded_as):
        self._box, self._log, self._recorded_as = box, log, recorded_as
        self.settings = box.planner.settings

    def observe(self, sample):
        self._log.write(self._recorded_as(sample))
        self._box.observe(sample)


def record_plan_of(
    path,
    text=PUSHING,
    objects=BLOCKS,
    settings=PUSH,
    recorded_settings=None,
    recorded_as=lambda sample: sample,
    most_recorded=None,
    rate_hz=None,
    **options,
):
    """Record a planned run, and return its steps.

    Args:
        recorded_settings: the settings in the log, if they differ from those of the planner.
        recorded_as: gives the sample in the log for each sample.
        rate_hz: how many samples a second has, for bounds in seconds.
        most_recorded: how many decisions and outcomes the log holds; all of them if it is None.
    """
    specification = replace(sr.parse_specification(text), filename="task.spatial")
    steps, sent = [], []

    def record(messages):
        sent.append(messages)
        if most_recorded is None or len(sent) <= most_recorded:
            log.write_messages(messages)

    box = BlackBox(Planner(specification, settings, rate_hz=rate_hz), record)
    with run_log(path, [specification]) as log:
        about = plan_metadata(box.planner, "task.spatial")
        log.add_metadata(
            PLAN_METADATA, {**about, "settings": text_from_settings(recorded_settings or settings)}
        )
        table = Table(dict(objects), _Watched(box, log, recorded_as), **options)
        table.look()
        while not steps or steps[-1].kind in ("execute", "wait"):
            step = box.next_step()
            if step in steps:
                table.look()
                continue
            steps.append(step)
            if step.kind == "execute":
                box.conclude(table.execute(step))
    return steps


@cache
def _usual_run(slips):
    with TemporaryDirectory() as folder:
        path = Path(folder, "run.mcap")
        return record_plan_of(path, slips=slips), path.read_bytes()


def write_usual_run(path, slips=0):
    """Write the log of the usual run, which is planned once for all tests, and return its steps."""
    steps, log = _usual_run(slips)
    path.write_bytes(log)
    return [*steps]
