"""Stages of episodes: the progress of each episode in its task."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from spatial_replay.annotate.stages import LOST, UNKNOWN, Stages, stages_of_result
from spatial_replay.batch.rows import Task, opened_task, parsed_specifications
from spatial_replay.batch.run import PreparedCase
from spatial_replay.batch.workers import Progress, no_progress
from spatial_replay.errors import GeometryError, LogError, TraceError, UsageError
from spatial_replay.judging.judgement import JudgedEpisode, Judgement
from spatial_replay.logs.formats.datasets import data_set_address
from spatial_replay.replay.engine import Replay
from spatial_replay.spec.formula import Specification

if TYPE_CHECKING:
    import pyarrow as pa

# columns with the stages of frames
SUBTASK: Final = "subtask_index"
PROGRESS: Final = "judge.progress"
LANGUAGE: Final = "language_persistent"


def episode_stages(
    judgement: Judgement, case: PreparedCase, progress: Progress = no_progress
) -> dict[str, Stages]:
    """Return the stages of each readable episode, by the path of its log.

    Args:
        case: the judged case.

    Raises:
        NoAutomatonError: the spec that judges has no automaton.
        UsageError: the spec is a template, or has the paper's semantics.
    """
    conditions, texts = case.case.conditions, tuple(file.text for file in case.files)
    specifications = parsed_specifications(texts, conditions)
    file_index = [file.name for file in case.files].index(judgement.file)
    stages: dict[str, Stages] = {}
    with progress("stages", len(judgement.rows)) as advance:
        for row in judgement.rows:
            # a row without a verdict already reports the error of its log
            if row.verdict is not None:
                with suppress(GeometryError, LogError, TraceError):
                    task = Task(row.log, (texts[file_index],), conditions)
                    stages[row.log] = _stages(task, specifications[file_index], judgement.result)
            advance(1)
    return stages


def _stages(task: Task, specification: Specification, name: str) -> Stages:
    source, options = opened_task(task, [specification])
    replay = Replay(source, [specification], options, keep_series=True, keep_leaves=True, certify=False)
    results = [result for result in replay.run().results if result.spec.name == name]
    if any(result.object is not None for result in results):
        raise UsageError(f"--stages: {name} is a template, and its objects are at different stages")
    return stages_of_result(results[0], specification)


def with_stages(judgement: Judgement, stages: Mapping[str, Stages]) -> Judgement:
    """Return a judgement whose rows have the final stage and the final progress of each episode."""
    rows = tuple(_at_stage(row, stages.get(row.log)) for row in judgement.rows)
    end_stages = {row.stage for row in rows}
    names = tuple(name for name in stage_names(stages) if name in end_stages or name not in (LOST, UNKNOWN))
    return replace(judgement, rows=rows, stages=names)


def stage_names(runs: Mapping[str, Stages]) -> tuple[str, ...]:
    """Return the names of all stages of these episodes, the farthest from success first."""
    return tuple(dict.fromkeys(stage.name for run in runs.values() for stage in run.stages))


def _at_stage(row: JudgedEpisode, stages: Stages | None) -> JudgedEpisode:
    if stages is None:
        return row
    return replace(row, stage=stages[-1].name, progress=float(stages.progress[-1]))


def frames_with_stages(table: pa.Table, runs: Mapping[int, Stages], names: Sequence[str]) -> pa.Table:
    """Return the frames of a LeRobot data set with the stages of their episodes.

    `subtask_index` is the index of the frame's stage in `names`, and `judge.progress` is its progress.
    `language_persistent` has a row for each change of the stage, with the style `subtask`. These columns are
    -1, NaN and empty for episodes without stages, or with unequal numbers of frames and samples.

    Args:
        table: frames of a LeRobot data set.
        runs: stages by the index of the episode.
        names: names of all stages.
    """
    import pyarrow as pa

    episode_indices, frame_indices = (table[name].to_numpy() for name in ("episode_index", "frame_index"))
    times_s = table["timestamp"].to_pylist()
    index_of_stage = {name: row for row, name in enumerate(names)}
    stage_indices = np.full(len(table), -1, np.int64)
    progress = np.full(len(table), np.nan, np.float32)
    language_rows: list[list[dict[str, Any]]] = [[] for _ in times_s]
    for episode in np.unique(episode_indices).tolist():
        run, frame_rows = runs.get(episode), np.flatnonzero(episode_indices == episode)
        if run is None or len(run.numbers) != len(frame_rows):
            continue
        frame_rows = frame_rows[np.argsort(frame_indices[frame_rows], kind="stable")]
        stage_indices[frame_rows] = np.array([index_of_stage[stage.name] for stage in run.stages])[
            run.numbers
        ]
        progress[frame_rows] = run.progress
        changes = [0, *(np.flatnonzero(np.diff(run.numbers)) + 1).tolist()]
        subtask_rows = [_subtask(run[change].name, times_s[frame_rows[change]]) for change in changes]
        for row in frame_rows.tolist():
            language_rows[row] = subtask_rows
    columns = {
        SUBTASK: pa.array(stage_indices),
        PROGRESS: pa.array(progress),
        # the types of lerobot's own annotations
        LANGUAGE: pa.array(language_rows, pa.list_(_row_type())),
    }
    # the metadata describes only the old columns
    table = table.drop_columns([name for name in columns if name in table.column_names])
    table = table.replace_schema_metadata(None)
    for name, column in columns.items():
        table = table.append_column(name, column)
    return table


def _subtask(content: str, timestamp: float) -> dict[str, Any]:
    return {"role": "assistant", "content": content, "style": "subtask", "timestamp": timestamp}


def _row_type() -> pa.StructType:
    import pyarrow as pa

    text_fields = ("role", "content", "style")
    return pa.struct(
        [
            *((name, pa.string()) for name in text_fields),
            ("timestamp", pa.float32()),
            ("camera", pa.null()),
            ("tool_calls", pa.null()),
        ]
    )


def annotate_frames(folder: Path, runs: Mapping[str, Stages], names: Sequence[str]) -> None:
    """Write the stages of episodes into a LeRobot data set. Its files of frames are replaced.

    Args:
        runs: stages by the address of the episode.
        names: see `frames_with_stages`.
    """
    import pyarrow as pa
    from pyarrow import parquet

    runs_by_episode = {address[1]: run for log, run in runs.items() if (address := data_set_address(log))}
    for file in sorted((folder / "data").glob("*/*.parquet")):
        with parquet.ParquetFile(file) as source:
            row_groups = [source.read_row_group(group_index) for group_index in range(source.num_row_groups)]
        table = frames_with_stages(pa.concat_tables(row_groups), runs_by_episode, names)
        # the file may be a link to the original data set, which must not change
        file.unlink()
        with parquet.ParquetWriter(file, table.schema) as writer:
            start = 0
            for row_group in row_groups:
                writer.write_table(table.slice(start, len(row_group)))
                start += len(row_group)
    subtasks = pa.table({SUBTASK: pa.array(range(len(names)), pa.int64()), "subtask": list(names)})
    # pandas reads the names as the index, as in LeRobot's table of tasks
    columns = [
        {"name": name, "field_name": name, "pandas_type": dtype, "numpy_type": dtype, "metadata": None}
        for name, dtype in ((SUBTASK, "int64"), ("subtask", "object"))
    ]
    pandas_metadata = json.dumps({"index_columns": ["subtask"], "column_indexes": [], "columns": columns})
    parquet.write_table(
        subtasks.replace_schema_metadata({"pandas": pandas_metadata}), folder / "meta/subtasks.parquet"
    )
    info = json.loads((folder / "meta/info.json").read_text("utf-8"))
    feature_types = {SUBTASK: "int64", PROGRESS: "float32", LANGUAGE: "language"}
    info["features"] |= {
        name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in feature_types.items()
    }
    (folder / "meta/info.json").write_text(json.dumps(info, indent=4), "utf-8")
