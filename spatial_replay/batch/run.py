"""A batch: a suite in, the rows of all its logs out; only what no earlier run has evaluated is evaluated."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias

from spatial_replay import __version__
from spatial_replay.batch.data_set import FORMAT, ResultsFolder, run_columns, table_of, write_rows
from spatial_replay.batch.log_files import FoundLog, Identities, find_logs
from spatial_replay.batch.result_files import result_files
from spatial_replay.batch.rows import (
    ResultRow,
    Task,
    error_rows,
    rows_from_task,
)
from spatial_replay.batch.spec_files import HASH_DIGITS, SpecFile, checked_spec_files
from spatial_replay.batch.suite import Case, Conditions, Suite
from spatial_replay.batch.workers import DaskCluster, LocalProcesses, ThisProcess, WorkerLost, Workers
from spatial_replay.errors import UsageError
from spatial_replay.mapping.mapping_file import load_mapping
from spatial_replay.monitor.verdict import Verdict

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class Wanted:
    """The rows that a case wants of one log and one specification file.

    Attributes:
        key: a hash of all that the rows depend on; None if the log cannot be read.
    """

    case: Case
    log: FoundLog
    file: SpecFile
    key: str | None


@dataclass(frozen=True, slots=True)
class StoredTask:
    """A task, and where its rows go: for each specification the key, and the hash of the specification."""

    task: Task
    keys: tuple[str, ...]
    hashes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class BatchResult:
    """What a batch found.

    Attributes:
        table: one row for each case, log, spec and object of a template; see `data_set`.
        logs: how many logs.
        evaluated: on how many of them something was evaluated in this run; the rest was known.
        wanted: what the suite asks for.
    """

    table: pa.Table
    logs: int
    evaluated: int
    wanted: tuple[Wanted, ...]

    @property
    def failures(self) -> pa.Table:
        """The rows that do not pass."""
        import pyarrow.compute as pc

        return self.table.filter(pc.is_valid(self.table.column("failure")))


def workers_of(jobs: int, dask: str | None = None) -> Workers:
    """Return what evaluates logs.

    Args:
        jobs: how many processes; with 1, this one.
        dask: address of a scheduler, whose workers see the same files.
    """
    if dask is not None:
        return DaskCluster(dask)
    return LocalProcesses(jobs) if jobs > 1 else ThisProcess()


def run_batch(
    suite: Suite,
    results: str | PathLike[str],
    workers: Workers,
    *,
    fail_on: frozenset[str] = frozenset(),
    begin: Callable[[int], None] = lambda tasks: None,
    advance: Callable[[int], None] = lambda tasks: None,
) -> BatchResult:
    """Evaluate what is new, and return and store the results of all logs of a suite.

    Args:
        results: the folder of results or its address, made if need be.
        fail_on: "vacuous" and "unknown": what fails although the case allows it.
        begin: called with the number of logs to evaluate.
        advance: called with 1 for each log that is done.

    Raises:
        UsageError: patterns without a log, files that cannot be used, a folder that is not one of results.
        SpecificationError: specifications with errors.
        OutputError: rows cannot be written; those written so far stay.
    """
    files = checked_spec_files(suite)
    logs = found_logs(suite)
    folder = ResultsFolder.create(results)
    with folder.locked():
        identities = Identities(folder.identities)
        paths = list(dict.fromkeys(log.path for several in logs for log in several))
        known = identities.of(paths, workers)
        identities.save()
        wanted = _wanted(suite, files, logs, known)
        stored = folder.keys()
        tasks = list(_tasks(wanted, stored))
        begin(len(tasks))
        errors: dict[str, tuple[ResultRow, ...]] = {}
        work, joined = partial(evaluate_and_store, folder.location), folder.joined_rows()
        for task, result in workers.results(work, tasks):
            for key, spec_hash, rows in _rows_of(task, result):
                if isinstance(rows, bytes):
                    joined.add(spec_hash, key, rows)
                else:
                    errors[key] = rows
            advance(1)
        joined.finish()
        folder.join_files()
        table = _table(wanted, folder, errors, fail_on)
        folder.write_run(table)
    # a log that cannot be read was tried, and is not known
    evaluated = {task.task.log for task in tasks} | {each.log.path for each in wanted if each.key is None}
    return BatchResult(table, len(paths), len(evaluated), tuple(wanted))


StoredRows: TypeAlias = tuple[ResultRow, ...] | bytes
"""The rows of one key: those with an error, or what `write_rows` has returned."""


def evaluate_and_store(folder: str, stored: StoredTask) -> tuple[StoredRows, ...]:
    """Evaluate a task and store its rows, for each of its keys; errors are not stored: they may pass."""
    files = result_files(folder)
    evaluated = zip(rows_from_task(stored.task), stored.keys, stored.hashes, strict=True)
    return tuple(
        rows if any(row.error is not None for row in rows) else write_rows(files, spec_hash, key, rows)
        for rows, key, spec_hash in evaluated
    )


def _rows_of(
    stored: StoredTask, result: tuple[StoredRows, ...] | WorkerLost
) -> Iterator[tuple[str, str, StoredRows]]:
    """Return the rows of a task, with the key and the specification of each."""
    if isinstance(result, WorkerLost):
        result = error_rows(stored.task, str(result), "machine")
    return zip(stored.keys, stored.hashes, result, strict=True)


def found_logs(suite: Suite) -> list[list[FoundLog]]:
    """Return the logs of each case.

    Raises:
        UsageError: patterns without a log; all are listed.
    """
    logs, faults = [], []
    for case in suite.cases:
        try:
            logs.append(find_logs(case.logs, suite.folder))
        except UsageError as error:
            faults.append(str(error))
    if faults:
        raise UsageError("\n".join(faults))
    return logs


def _wanted(
    suite: Suite,
    files: Sequence[Sequence[SpecFile]],
    logs: Sequence[Sequence[FoundLog]],
    identities: Mapping[str, str | None],
) -> list[Wanted]:
    wanted = []
    for case, own, several in zip(suite.cases, files, logs, strict=True):
        conditions = _key_of(case.conditions)
        for log in several:
            identity = identities[log.path]
            for file in own:
                parts = [FORMAT, __version__, identity, conditions, file.hash]
                key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:HASH_DIGITS]
                wanted.append(Wanted(case, log, file, None if identity is None else key))
    return wanted


def _key_of(conditions: Conditions) -> list[Any]:
    """Return what rows depend on besides the log and the specification, whose constants have their values."""
    mapping = conditions.mapping
    return [
        None if mapping is None else load_mapping(mapping).sha256,
        conditions.reading,
        conditions.start,
        conditions.end,
        conditions.every,
        conditions.each,
        conditions.semantics,
        conditions.strict_names,
    ]


def _tasks(wanted: Sequence[Wanted], stored: set[str]) -> Iterator[StoredTask]:
    """Yield a task for each log and conditions under which something is missing, with all that is."""
    groups: dict[tuple[str, Conditions], dict[str, SpecFile]] = defaultdict(dict)
    taken = set(stored)
    for each in wanted:
        if each.key is not None and each.key not in taken:
            taken.add(each.key)
            groups[each.log.path, each.case.conditions][each.key] = each.file
    for (path, conditions), files in groups.items():
        task = Task(path, tuple(file.text for file in files.values()), conditions)
        yield StoredTask(task, tuple(files), tuple(file.hash for file in files.values()))


def _table(
    wanted: Sequence[Wanted],
    folder: ResultsFolder,
    errors: dict[str, tuple[ResultRow, ...]],
    fail_on: frozenset[str],
) -> pa.Table:
    """Return the table of a run: what was wanted, with the rows found for it."""
    import pyarrow as pa

    rows = folder.rows({each.key for each in wanted if each.key is not None})
    unreadable = {
        f"{each.log.path}\0{each.file.hash}": _unreadable(each) for each in wanted if each.key is None
    }
    rows = pa.concat_tables([rows, table_of({**errors, **unreadable})])
    places: dict[str, list[int]] = defaultdict(list)
    for place, key in enumerate(rows.column("key").to_pylist()):
        places[key].append(place)
    indices, asked = [], []
    for each in wanted:
        for place in places[each.key or f"{each.log.path}\0{each.file.hash}"]:
            indices.append(place)
            asked.append(each)
    chosen = rows.take(pa.array(indices, pa.int64()))
    return _judged(chosen, asked, fail_on)


def _unreadable(wanted: Wanted) -> tuple[ResultRow, ...]:
    """Return the rows of a log that cannot even be hashed."""
    task = Task(wanted.log.path, (wanted.file.text,), wanted.case.conditions)
    (rows,) = rows_from_task(task)
    if all(row.error is None for row in rows):
        # it came back while it was looked at
        message = f"{wanted.log.name} could not be read at first; run the batch again"
        (rows,) = error_rows(task, message, "machine")
    return rows


def _judged(rows: pa.Table, asked: Sequence[Wanted], fail_on: frozenset[str]) -> pa.Table:
    """Return the table of a run: rows with what was asked for, and with why they fail."""
    import pyarrow as pa

    names = rows.column("spec").to_pylist()
    columns = {name: rows.column(name) for name in rows.column_names}
    judged = ("verdict", "robustness", "vacuous", "faults", "error")
    values = zip(*(columns[name].to_pylist() for name in judged), asked, strict=True)
    lines = {id(each.file): dict(each.file.lines) for each in asked}
    requirements = zip(columns["requirement"].to_pylist(), asked, strict=True)
    columns |= {
        "case": [each.case.name for each in asked],
        "log": [each.log.name for each in asked],
        "file": [each.file.name for each in asked],
        "expected": [each.case.expectation.text for each in asked],
        "failure": [_failure(*each, fail_on=fail_on) for each in values],
        "line": [lines[id(each.file)].get(name, 1) for each, name in zip(asked, names, strict=True)],
        "requirement": [own or ", ".join(each.case.requirements) or None for own, each in requirements],
    }
    schema = run_columns()
    return pa.table({field.name: columns[field.name] for field in schema}, schema=schema)


def _failure(
    verdict: str | None,
    robustness: float,
    vacuous: Sequence[str],
    faults: Sequence[str],
    error: str | None,
    wanted: Wanted,
    *,
    fail_on: frozenset[str],
) -> str | None:
    """Return why a row does not pass, in a few words; None if it does."""
    if error is not None or verdict is None:
        return error
    failure = wanted.case.expectation.failure(Verdict(verdict), robustness)
    if failure is not None:
        return failure
    if "unknown" in fail_on and verdict == Verdict.UNKNOWN:
        return "unknown"
    if "vacuous" in fail_on and vacuous:
        return f"vacuous: {vacuous[0]}"
    return f"the log is damaged: {faults[0]}" if faults else None
