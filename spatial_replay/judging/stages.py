"""Stages of episodes: how far each came in the task that it is judged by."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace

from spatial_replay.annotate.stages import LOST, UNKNOWN, Stages, stages_of_result
from spatial_replay.batch.rows import Task, opened_task, parsed_specifications
from spatial_replay.batch.run import PreparedCase
from spatial_replay.batch.workers import Progress, no_progress
from spatial_replay.errors import GeometryError, LogError, TraceError, UsageError
from spatial_replay.judging.judgement import JudgedEpisode, Judgement
from spatial_replay.replay.engine import Replay


def episode_stages(
    judgement: Judgement, case: PreparedCase, progress: Progress = no_progress
) -> dict[str, Stages]:
    """Return the stages of each episode that can be read, by the path of its log.

    Args:
        case: the one that was judged.

    Raises:
        NoAutomatonError: the spec that judges has no automaton.
        UsageError: it is a template, or under the paper's semantics.
    """
    (text,) = (file.text for file in case.files if file.name == judgement.file)
    stages: dict[str, Stages] = {}
    with progress("stages", len(judgement.rows)) as advance:
        for row in judgement.rows:
            # what is wrong with a log is in its row
            if row.verdict is not None:
                with suppress(GeometryError, LogError, TraceError):
                    stages[row.log] = _stages(Task(row.log, (text,), case.case.conditions), judgement.result)
            advance(1)
    return stages


def _stages(task: Task, name: str) -> Stages:
    # constants that only other files have are not this file's
    conditions = replace(
        task.conditions,
        constants=tuple(pair for pair in task.conditions.constants if _has_constant(task, pair[0])),
    )
    files = parsed_specifications(task.specs, conditions)
    source, options = opened_task(replace(task, conditions=conditions), files)
    replay = Replay(source, files, options, keep_series=True, keep_leaves=True, certify=False)
    results = [result for result in replay.run().results if result.spec.name == name]
    if any(result.object is not None for result in results):
        raise UsageError(f"--stages: {name} is a template, and its objects are at different stages")
    return stages_of_result(results[0], replay.files[0])


def _has_constant(task: Task, name: str) -> bool:
    (file,) = parsed_specifications(task.specs, replace(task.conditions, constants=()))
    return name in file.constants


def with_stages(judgement: Judgement, stages: Mapping[str, Stages]) -> Judgement:
    """Return a judgement whose rows have the stage and the progress at the end of each episode."""
    rows = tuple(_at_stage(row, stages.get(row.log)) for row in judgement.rows)
    names = dict.fromkeys(stage.name for run in stages.values() for stage in run.stages)
    ends = {row.stage for row in rows}
    return replace(
        judgement,
        rows=rows,
        stages=tuple(name for name in names if name in ends or name not in (LOST, UNKNOWN)),
    )


def _at_stage(row: JudgedEpisode, stages: Stages | None) -> JudgedEpisode:
    if stages is None:
        return row
    return replace(row, stage=stages[-1].name, progress=float(stages.progress[-1]))
