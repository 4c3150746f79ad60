"""Writers of judgements: pages, tables of labels, and labels in data sets for training."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from spatial_replay.batch.overview import AGREEMENT, LABEL
from spatial_replay.batch.run import BatchResult
from spatial_replay.errors import UsageError
from spatial_replay.judging.judgement import JudgedEpisode, Judgement
from spatial_replay.judging.stages import annotate_frames, stage_names
from spatial_replay.logs.formats.datasets import data_set_address, open_data_set
from spatial_replay.logs.output_file import output_error, replacing

if TYPE_CHECKING:
    import pyarrow as pa

    from spatial_replay.annotate.stages import Stages

_DIFFERENCES: Final = {
    "only_theirs": "only the label counts a success",
    "only_ours": "only the verdict counts a success",
}
_WORDS: Final = {True: "success", False: "failure", None: None}


def labelled_batch(judgement: Judgement) -> BatchResult:
    """Return the batch of a judgement with its labels. The failures of this batch are disagreements."""
    import pyarrow as pa
    import pyarrow.compute as pc

    table = judgement.batch.table
    if judgement.failure_file:
        # a spec of this file describes a failure: its violation is no failure of the episode
        table = table.filter(pc.not_equal(table["file"], judgement.failure_file))
    paths = {request.log.name: request.log.path for request in judgement.batch.requests}
    rows_by_log = {row.log: row for row in judgement.rows}
    episode_rows = [rows_by_log[paths[log]] for log in table["log"].to_pylist()]
    table = table.append_column(LABEL, pa.array([_WORDS[row.label] for row in episode_rows], pa.string()))
    table = table.append_column(AGREEMENT, pa.array([row.kind for row in episode_rows], pa.string()))
    if judgement.label_rate.episodes:
        result_values = zip(*(table[name].to_pylist() for name in ("file", "spec", "failure")), strict=True)
        failures = [
            _failure(row, failure) if spec in (judgement.result, "") and file == judgement.file else None
            for row, (file, spec, failure) in zip(episode_rows, result_values, strict=True)
        ]
        column_index = table.schema.get_field_index("failure")
        table = table.set_column(
            column_index, table.schema.field(column_index), pa.array(failures, pa.string())
        )
    return replace(judgement.batch, table=table)


def _failure(row: JudgedEpisode, failure: str | None) -> str | None:
    return failure if row.kind == "undecided" else _DIFFERENCES.get(row.kind)


def label_table(judgement: Judgement) -> pa.Table:
    """Return a table of decided episodes, for training and for comparisons of rates.

    `success` is true or false, and `policy_id` is the name of the data set. Empty columns `task` and `seed`
    are left out.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    table = _table_with_success(judgement)
    # readers of CSV would convert the names 0.10 and 0.1 to the same number
    policy_name = f"policy-{judgement.name}" if _is_number(judgement.name) else judgement.name
    episode_numbers = pa.array(_episode_numbers(judgement), pa.int64())
    policy_names = pa.array([policy_name] * len(table), pa.string())
    for column, values in {
        "run_id": policy_names,
        "policy_id": policy_names,
        "episode_idx": episode_numbers,
    }.items():
        table = table.append_column(column, values)
    empty_columns = [column for column in ("task", "seed") if table[column].null_count == len(table)]
    return table.drop_columns(empty_columns).filter(pc.is_valid(table["success"]))


def _table_with_success(judgement: Judgement) -> pa.Table:
    import pyarrow as pa

    successes = pa.array([row.stored_success for row in judgement.rows], pa.bool_())
    return judgement.table.append_column("success", successes)


def _episode_numbers(judgement: Judgement) -> list[int]:
    addresses = (data_set_address(row.log) for row in judgement.rows)
    return [index if address is None else address[1] for index, address in enumerate(addresses)]


def _is_number(name: str) -> bool:
    try:
        float(name)
    except ValueError:
        return False
    return True


def ending_of_labels(file: Path) -> str:
    """Return the ending of a file for labels.

    Raises:
        UsageError: the ending is neither .parquet nor .csv.
    """
    ending = file.suffix.lower()
    if ending not in (".parquet", ".csv"):
        raise UsageError(f"--write-labels {file}: give a name that ends in .parquet or .csv")
    return ending


def write_labels(judgement: Judgement, file: Path, inputs: Sequence[Path] = ()) -> None:
    """Write the table of labels as Parquet or CSV, by the ending of the file's name.

    Raises:
        UsageError: the ending is neither .parquet nor .csv, or the output is an input.
        OutputError: the file cannot be written.
    """
    from pyarrow import csv, parquet

    ending, table = ending_of_labels(file), label_table(judgement)
    with replacing(file, inputs) as stream:
        if ending == ".csv":
            csv.write_csv(table, stream)
        else:
            parquet.write_table(table, stream)


def check_annotation(logs: Sequence[str], new: Path) -> Path:
    """Return the folder of the data set to copy.

    Raises:
        UsageError: the copy exists, its folder is missing, or the logs are not the episodes of one LeRobot
            data set of version 3.
    """
    if new.exists() or new.is_symlink():
        raise UsageError(f"--annotate {new}: it exists; give a new name, since no data set is changed")
    if not new.absolute().parent.is_dir():
        raise UsageError(f"--annotate {new}: there is no folder {new.parent}; make it first")
    folders = {None if address is None else address[0] for address in map(data_set_address, logs)}
    folder = folders.pop() if len(folders) == 1 else None
    data_set = None if folder is None else open_data_set(folder)
    if folder is None or data_set is None or not (Path(folder) / "meta/episodes").is_dir():
        raise UsageError(
            "--annotate copies one LeRobot data set with meta/episodes (version 3); "
            "for others write a table: --write-labels FILE.parquet"
        )
    return Path(folder)


def annotate_data_set(
    judgement: Judgement, folder: Path, new: Path, stages: Mapping[str, Stages] | None = None
) -> None:
    """Copy a LeRobot data set, and add columns such as `judge/success` to its episodes.

    Files of data and videos are links to the original, and the metadata is copied.

    Args:
        new: folder of the copy.
        stages: stages by the address of the episode, for the frames; see `frames_with_stages`.

    Raises:
        OutputError: the copy cannot be written; the partial copy is removed.
    """
    from pyarrow import parquet

    partial = Path(tempfile.mkdtemp(prefix=f".{new.name}.", dir=new.absolute().parent))
    try:
        for entry in folder.iterdir():
            for parent, _, file_names in os.walk(entry) if entry.is_dir() else [(folder, (), [entry.name])]:
                target_folder = partial / Path(parent).relative_to(folder)
                target_folder.mkdir(parents=True, exist_ok=True)
                for name in file_names:
                    source_file = Path(parent, name).resolve()
                    if entry.name in ("data", "videos"):
                        (target_folder / name).symlink_to(source_file)
                    else:
                        shutil.copyfile(source_file, target_folder / name)
        for file in sorted((partial / "meta/episodes").glob("chunk-*/file-*.parquet")):
            parquet.write_table(_with_labels(parquet.read_table(file), judgement), file)
        if stages:
            annotate_frames(partial, stages, stage_names(stages))
        # `mkdtemp` makes folders that only their owner can read
        partial.chmod(0o755)
        partial.rename(new)
    except OSError as error:
        raise output_error(new, error) from error
    finally:
        # after the rename, the folder does not exist any more
        with suppress(OSError):
            shutil.rmtree(partial)


def _with_labels(table: pa.Table, judgement: Judgement) -> pa.Table:
    """Return a table of episodes with the columns of a judgement. Other episodes have null."""
    import pyarrow as pa

    rows_by_number = {number: row for row, number in enumerate(_episode_numbers(judgement))}
    row_indices = [rows_by_number.get(number) for number in table["episode_index"].to_pylist()]
    labels = _table_with_success(judgement).take(pa.array(row_indices, pa.int64()))
    # columns of an earlier judgement are replaced, and the metadata describes only the old columns
    column_names = [name for name in table.column_names if not name.startswith("judge/")]
    table = table.select(column_names).replace_schema_metadata(None)
    for name in ("success", "margin", "success_at", "tested", "reason"):
        table = table.append_column(f"judge/{name}", labels[name])
    spec = f"{judgement.file}: {judgement.result} = {judgement.formula}"
    spec_texts = [None if row is None else spec for row in row_indices]
    return table.append_column("judge/spec", pa.array(spec_texts, pa.string()))
