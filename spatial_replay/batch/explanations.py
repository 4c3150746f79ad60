"""Explanations of results. They are computed from the logs when a command shows them."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from spatial_replay.batch.identities import identities_of
from spatial_replay.batch.record import Explanation, RunRecord, with_explanations
from spatial_replay.batch.rows import ResultName, ResultRow, Task, parsed_specifications, rows_from_task
from spatial_replay.batch.run import BatchResult, meaning_hash, row_key
from spatial_replay.batch.run_table import worst_rows
from spatial_replay.batch.store import EXPLANATION, ResultsFolder
from spatial_replay.batch.workers import Progress, WorkerLost, Workers, no_progress
from spatial_replay.errors import SpatialReplayError

if TYPE_CHECKING:
    import pyarrow as pa


class Row(NamedTuple):
    """A row of a run's table, with its index `place`."""

    place: int
    case: str
    log: str
    file: str
    spec: str
    object: str | None
    key: str
    verdict: str | None
    explanation: list[str] | None


class ExplanationTask(NamedTuple):
    """Results of one log to explain.

    Attributes:
        keys: row key of each specification file; None for a file without results to explain.
        results: results to explain.
    """

    task: Task
    keys: tuple[str | None, ...]
    results: frozenset[ResultName]


def explain_rows(
    table: pa.Table, places: Iterable[int], workers: Workers, progress: Progress = no_progress
) -> tuple[pa.Table, list[str]]:
    """Explain the rows `places` of a run's table. Return the table, and remarks on unexplained rows.

    Rows with an explanation are unchanged. A remark names each missing or changed log.
    """
    import pyarrow as pa

    record = RunRecord.of(table)
    columns = ("case", "log", "file", "spec", "object", "key", "verdict", "explanation")
    rows_by_log: dict[tuple[str, str], list[Row]] = defaultdict(list)
    places = list(dict.fromkeys(places))
    row_values = table.select(columns).take(pa.array(places, pa.int64())).to_pylist()
    for row in (Row(place, **values) for place, values in zip(places, row_values, strict=True)):
        if row.verdict is not None and row.explanation is None and row.case in record.cases:
            rows_by_log[row.case, row.log].append(row)
    # two cases may request the same explanation
    rows_by_task: dict[ExplanationTask, list[Row]] = defaultdict(list)
    for rows_of_log in rows_by_log.values():
        rows_by_task[_task(record, rows_of_log)] += rows_of_log
    explanations, remarks = dict[int, Explanation](), list[str]()
    with progress("explanations", len(rows_by_task)) as advance:
        for task, result in workers.results(explanations_of, rows_by_task) if rows_by_task else ():
            if isinstance(result, WorkerLost | str):
                remarks.append(f"{rows_by_task[task][0].log} is not explained: {result}")
            else:
                for row in rows_by_task[task]:
                    result_name = record.result_name(row.case, row.file, row.spec, row.object)
                    explanations |= {row.place: result[result_name]} if result_name in result else {}
            advance(1)
    return with_explanations(table, explanations), remarks


def _task(record: RunRecord, rows: Sequence[Row]) -> ExplanationTask:
    """Return the task for the explanation of one log's rows."""
    case, keys = rows[0].case, {row.file: row.key for row in rows}
    result_names = frozenset(record.result_name(case, row.file, row.spec, row.object) for row in rows)
    return ExplanationTask(
        record.task(case, rows[0].log), tuple(keys.get(file) for file in record.files(case)), result_names
    )


def explanations_of(request: ExplanationTask) -> dict[ResultName, Explanation] | str:
    """Return the explanations of a log's results, or a reason if they cannot be computed."""
    task = request.task
    identity = identities_of((task.log,))[task.log]
    if identity is None:
        return "the log cannot be read any more"
    try:
        files = parsed_specifications(task.specs, task.conditions)
        keys = [row_key(identity, task.conditions, meaning_hash(file)) for file in files]
    except SpatialReplayError as error:
        return str(error)
    if any(expected_key not in (None, key) for expected_key, key in zip(request.keys, keys, strict=True)):
        return "the log, the mapping or the version has changed since; run the batch again"
    rows = {
        (file_index, row.spec, row.object): row
        for file_index, rows_of_file in enumerate(rows_from_task(task, request.results))
        for row in rows_of_file
    }
    errors = [row.error for row in rows.values() if row.error is not None]
    return (
        errors[0] if errors else {name: _explanation(rows[name]) for name in request.results if name in rows}
    )


def _explanation(row: ResultRow) -> Explanation:
    return tuple(getattr(row, name) for name in EXPLANATION)


def failing_places(table: pa.Table, count: int | None = None) -> list[int]:
    """Return the indices of the failing rows among the worst `count` rows, or among all rows."""
    places = range(len(table)) if count is None else worst_places(table, count)
    failures = table.column("failure").to_pylist()
    return [place for place in places if failures[place] is not None]


def worst_places(table: pa.Table, count: int) -> list[int]:
    """Return the indices of the worst rows, see `worst_rows`."""
    import pyarrow as pa

    numbered_table = table.append_column("place", pa.array(range(len(table)), pa.int64()))
    return [row["place"] for row in worst_rows(numbered_table, count)]


def explain_batch(
    result: BatchResult,
    places: Iterable[int],
    workers: Workers,
    *,
    results: str | os.PathLike[str] | None = None,
    progress: Progress = no_progress,
) -> BatchResult:
    """Explain the rows `places` of a batch, and return the batch with the explanations.

    Args:
        results: folder of results that also stores the explanations.

    Raises:
        OutputError: the folder cannot be written.
    """
    table, remarks = explain_rows(result.table, places, workers, progress)
    if results is not None and table is not result.table:
        ResultsFolder.open(results).write_run(table)
    return replace(result, table=table, remarks=(*result.remarks, *remarks))
