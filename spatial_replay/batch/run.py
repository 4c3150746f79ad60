"""A batch: its logs, its evaluation by workers, and the table of results."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from glob import glob, has_magic
from math import nan
from os import PathLike
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from spatial_replay.batch.identities import identify, states_of
from spatial_replay.batch.record import RunRecord, recorded_conditions, with_explanations
from spatial_replay.batch.rows import (
    ResultRow,
    Task,
    TaskRows,
    error_rows,
    parsed_specifications,
    rows_from_task,
    rows_from_tasks,
    spec_lines,
)
from spatial_replay.batch.store import FORMAT, SOURCE, ResultsFolder, run_columns, table_of
from spatial_replay.batch.suite import Case, Conditions, Expectation, LogPattern, Outcome, Suite
from spatial_replay.batch.workers import (
    DaskCluster,
    LocalProcesses,
    Progress,
    ThisProcess,
    WorkerLost,
    Workers,
    no_progress,
)
from spatial_replay.errors import Diagnosis, LogError, SpatialReplayError, SpecificationError, UsageError
from spatial_replay.logs.formats.datasets import DATA_SET_ENDINGS, data_set_address, open_data_set
from spatial_replay.logs.remote import (
    BAG_METADATA,
    RemoteFile,
    is_address,
    local_copy,
    log_file,
    matching_addresses,
)
from spatial_replay.mapping.mapping_file import load_mapping
from spatial_replay.mapping.yaml_document import MOST_FAULTS
from spatial_replay.monitor.stream import Choice
from spatial_replay.sources.open_log import LOG_ENDINGS
from spatial_replay.spec.diagnostics import Diagnostic
from spatial_replay.spec.format import format_formula, format_specification
from spatial_replay.spec.formula import NamedSpec, Specification
from spatial_replay.spec.load import SpecificationText
from spatial_replay.spec.walks import other_names
from spatial_replay.text import encodable, first_lines, plural
from spatial_replay.version import __version__

if TYPE_CHECKING:
    import pyarrow as pa


HASH_DIGITS: Final = 32
"""Digits of a hash in a name."""


@dataclass(frozen=True, slots=True)
class SpecFile:
    """A specification file of a case, parsed with the case's constants.

    Attributes:
        name: path relative to the suite's folder.
        hash: hash of the file's meaning with ids and titles, independent of layout and comments.
        meanings: name of each spec, and hash of its meaning without ids and titles.
        lines: name and line of each spec.
        warnings: warnings of `check`.
        has_plugins: whether results depend on plug-in code, which may read any other file.
    """

    name: str
    text: SpecificationText
    hash: str
    meanings: tuple[tuple[str, str], ...]
    lines: tuple[tuple[str, int], ...]
    warnings: tuple[Diagnostic, ...] = ()
    has_plugins: bool = False


def read_specification_text(path: Path | str) -> SpecificationText:
    """Read and check the text of a specification at a path or an address.

    Raises:
        MissingFileError, UsageError, SpecificationError: see `load_specification`.
    """
    from spatial_replay.spec.load import is_formula, load_specification

    if isinstance(path, Path) and is_formula(path):
        raise UsageError(f"{path} is a formula, and results name files; write it into one: gate.spatial")
    return SpecificationText(load_specification(local_copy(path)).source, encodable(log_file(path).name))


def spec_file(path: Path | str, text: SpecificationText, parsed: Specification, folder: Path) -> SpecFile:
    """Return the `SpecFile` of a parsed specification, with a name relative to a folder."""
    lines = tuple(spec_lines(parsed).items())
    meanings = tuple((spec.name, _hash_of_text(_meaning(parsed, spec))) for spec in parsed.results)
    name, digest = _relative_name(path, folder), meaning_hash(parsed)
    return SpecFile(name, text, digest, meanings, lines, parsed.warnings, bool(parsed.plugins))


def meaning_hash(file: Specification) -> str:
    """Return a hash of the meaning of a specification, independent of layout and comments."""
    return _hash_of_text(f"{file.profile}\n{format_specification(file)}")


def _meaning(file: Specification, spec: NamedSpec) -> str:
    """Return the text of a spec with its regions and groups. The specs that it uses are expanded."""
    names = other_names(spec.formula)
    regions = {name: region for name, region in file.regions.items() if name in names}
    groups = {name: group for name, group in file.groups.items() if name in names}
    declarations = format_specification(replace(file, specs=(), regions=regions, groups=groups))
    return f"{declarations}{spec.parameter}: {format_formula(spec.formula)}"


def _hash_of_text(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:HASH_DIGITS]


def _relative_name(file: Path | str, folder: Path) -> str:
    path = log_file(file)
    if isinstance(path, RemoteFile):
        return str(path)
    return encodable((path.relative_to(folder) if path.is_relative_to(folder) else path).as_posix())


def choice_faults(case: Case, files: Sequence[Specification]) -> Iterator[str]:
    """Yield faults in a case's choices of objects for the parameters of its templates."""
    templates = [spec for file in files for spec in file.results if spec.parameter is not None]
    parameters = {spec.parameter for spec in templates}
    choices = dict(case.conditions.each)
    for parameter, objects in choices.items():
        try:
            Choice.parse(parameter, objects)
        except UsageError as error:
            yield str(error)
        if parameter not in parameters:
            template_names = ", ".join(f"{spec.name}({spec.parameter})" for spec in templates) or "none"
            yield f"no template has a parameter {parameter!r}; templates here: {template_names}"
    for spec in templates:
        if spec.parameter not in choices:
            yield (
                f"{spec.name} is a template; say which objects {spec.parameter} stands for: "
                f"--each {spec.parameter}=class:NAME or each: {{{spec.parameter}: all}}"
            )


_DATA_SET_FOLDERS: Final = frozenset({"meta", "data"})
"""Names of subfolders. The folder of a data set has at least one of these subfolders."""
_MOST_LOGS: Final = 2_000_000
_MOST_FAULTS: Final = 100


class FoundLog(NamedTuple):
    """A log of a batch.

    Attributes:
        name: path relative to the suite's folder, or address.
        path: path or address that opens the log.
    """

    name: str
    path: str


def find_logs(patterns: Sequence[LogPattern], folder: Path) -> list[FoundLog]:
    """Return the logs of patterns, each log once, in the order of the patterns.

    The logs of one pattern are sorted. A folder has the logs in all its subfolders. A ROS 2 bag is one log,
    and each episode of a data set is a log. An address names one log, but `s3://bucket/folder/` and addresses
    with a pattern name all matching logs that the bucket lists.

    Args:
        folder: base of relative paths.

    Raises:
        UsageError: patterns have no log; the message lists all these patterns, with their places.
        RemoteError: a bucket cannot be listed.
    """
    logs_by_path: dict[str, FoundLog] = {}
    faults = []
    for pattern in patterns:
        prefix = f"{pattern.place}: " if pattern.place else ""
        try:
            logs = list(_logs_of(pattern.text, folder))
        except UsageError as error:
            faults.append(f"{prefix}{error}")
            continue
        if not logs:
            faults.append(f"{prefix}{_nothing(pattern.text, folder)}")
        logs_by_path.update((log.path, log) for log in logs if log.path not in logs_by_path)
        if len(logs_by_path) > _MOST_LOGS:
            raise UsageError(f"{pattern.text}: more than {plural(_MOST_LOGS, 'log')}; split the batch")
    if faults:
        raise UsageError("\n".join(first_lines(faults, _MOST_FAULTS)))
    return list(logs_by_path.values())


def _logs_of(text: str, folder: Path) -> Iterator[FoundLog]:
    if is_address(text):
        yield from _logs_at(text)
        return
    try:
        path = folder / text
        if path.is_dir():
            yield from _logs_in(path, folder)
        elif path.exists():
            # a file of another kind becomes a log, and its row reports the error
            yield from _episodes_in(path, folder) or [_log_at(path, folder)]
        elif (address := data_set_address(path)) is not None:
            data_set = open_data_set(address[0])
            if data_set is not None:
                data_set.episode(address[1])
            yield _log_at(path, folder)
        elif has_magic(text):
            for name in sorted(glob(text, root_dir=folder, recursive=True)):  # noqa: PTH207 - absolute ones, too
                log = folder / name
                episodes = _episodes_in(log, folder)
                if episodes or (log.exists() and not log.is_dir()) or (log / BAG_METADATA).is_file():
                    yield from episodes or [_log_at(log, folder)]
    except (OSError, ValueError):
        # an impossible name, such as one with a null character
        return


def _logs_at(address: str) -> Iterator[FoundLog]:
    """Yield the log at an address, or all logs of a pattern or folder in a bucket."""
    is_folder = address.endswith("/")
    # in the address of a web server, "?" begins a query
    if address.startswith(("http://", "https://")) or not (is_folder or has_magic(address)):
        yield FoundLog(str(log_file(address)), address)
        return
    addresses = matching_addresses(address)
    bag_folders = {
        address.removesuffix(BAG_METADATA) for address in addresses if address.endswith(f"/{BAG_METADATA}")
    }
    for address in addresses:
        folder = address[: address.rfind("/") + 1]
        if folder in bag_folders:
            # a ROS 2 bag is one log, at the place of its metadata file in the listing
            if address == folder + BAG_METADATA:
                yield FoundLog(folder, folder)
        elif not is_folder or address.lower().endswith(LOG_ENDINGS):
            yield FoundLog(address, address)


def _episodes_in(path: Path, folder: Path) -> list[FoundLog]:
    """Return the episodes of a data set; none if the path is no data set.

    A damaged data set is one log, whose row reports the error. No log is skipped silently.
    """
    log = _log_at(path, folder)
    try:
        data_set = open_data_set(path)
    except LogError:
        return [log]
    except SpatialReplayError:
        return []
    episodes = () if data_set is None else data_set.episodes
    return [FoundLog(f"{log.name}#{episode.number}", f"{log.path}#{episode.number}") for episode in episodes]


def _logs_in(path: Path, folder: Path) -> Iterator[FoundLog]:
    """Yield the logs in a folder: bags, episodes and log files. An unreadable folder counts as a log."""
    errors: list[OSError] = []
    for parent, folders, file_names in os.walk(path, onerror=errors.append):
        if BAG_METADATA in file_names:
            yield _log_at(Path(parent), folder)
            folders.clear()
            continue
        if episodes := _episodes_in(Path(parent), folder) if _DATA_SET_FOLDERS & {*folders} else []:
            yield from episodes
            folders.clear()
            continue
        # `os.walk` visits the remaining folders in this order
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        parent_log = _log_at(Path(parent), folder)
        for name in sorted(file_names):
            if name.lower().endswith(LOG_ENDINGS) and not name.startswith("."):
                # joined as text, because building `Path` objects would take most of the time
                log_name = name if parent_log.name == "." else f"{parent_log.name}/{name}"
                yield FoundLog(encodable(log_name), f"{parent_log.path}/{name}")
            elif name.lower().endswith(DATA_SET_ENDINGS) and not name.startswith("."):
                yield from _episodes_in(Path(parent) / name, folder)
    # the row of an unreadable folder reports the error: no log is skipped silently
    yield from (_log_at(Path(error.filename), folder) for error in errors)


def _log_at(path: Path, folder: Path) -> FoundLog:
    relative_path = path.relative_to(folder) if path.is_relative_to(folder) else path
    return FoundLog(encodable(relative_path.as_posix()), str(path))


def _nothing(text: str, folder: Path) -> str:
    if is_address(text):
        return f"{text}: no log there; check the pattern"
    if has_magic(text):
        return f"{text}: no log matches this pattern; check it, and the folder it starts from"
    # unlike `Path.is_dir`, it accepts names that no file can have
    if os.path.isdir(folder / text):  # noqa: PTH112
        try:
            open_data_set(folder / text)
        except SpatialReplayError as error:
            return str(error)
        return f"{text}: no log in this folder; logs end in {', '.join(LOG_ENDINGS)}"
    return f"{text}: no such file; check the path"


@dataclass(frozen=True, slots=True)
class PreparedCase:
    """A case with its logs and its checked specification files."""

    case: Case
    logs: tuple[FoundLog, ...]
    files: tuple[SpecFile, ...]


def prepare(suite: Suite, progress: Progress = no_progress) -> tuple[PreparedCase, ...]:
    """Find the logs of each case, and check the specifications and mappings of a suite.

    Raises:
        SpecificationError: only specifications have faults; the error has all these faults.
        UsageError: the suite has other faults, such as patterns without a log, unusable files, or templates
            without objects. The message lists all faults with their lines.
        RemoteError: a bucket cannot be listed.
    """
    faults = _Faults(suite)
    text_by_path: dict[Path | str, SpecificationText | None] = {}
    cases = []
    with progress("finding logs", None):
        for case in suite.cases:
            logs: list[FoundLog] = []
            try:
                logs = find_logs(case.logs, suite.folder)
            except UsageError as error:
                for line in str(error).split("\n"):
                    faults.add(line)
            else:
                if len(logs) < case.at_least_logs:
                    place, count_text = case.place("at_least_logs"), plural(len(logs), "log")
                    faults.add(
                        f"{place}{count_text}, and at_least_logs is {case.at_least_logs}; check the patterns"
                    )
            cases.append(PreparedCase(case, tuple(logs), _files(case, suite.folder, text_by_path, faults)))
    faults.check()
    return tuple(cases)


@dataclass(slots=True)
class _Faults:
    """Faults of a suite, each once."""

    suite: Suite
    lines: dict[str, None] = field(default_factory=dict)
    diagnoses: dict[str, Diagnosis] = field(default_factory=dict)

    def add(self, text: str) -> None:
        self.lines[text] = None

    def check(self) -> None:
        """Raise one error with all faults, if there are any."""
        suite_name = "" if self.suite.path is None else self.suite.path.name
        fault_lines = [*(f"{suite_name}:{line}: {fault}" for line, fault in self.suite.faults), *self.lines]
        if self.diagnoses and not fault_lines:
            raise SpecificationError(list(self.diagnoses.values()))
        if fault_lines:
            fault_lines = [*sorted(fault_lines, key=self._line), *map(_in_one_line, self.diagnoses.values())]
            raise UsageError("\n".join(first_lines(fault_lines, MOST_FAULTS)))

    def _line(self, fault: str) -> float:
        """Return the line of a fault in the suite. Faults of other files have infinity: they come last."""
        file_name, _, position = fault.partition(":")
        line_text = position.partition(":")[0]
        is_own = self.suite.path is not None and file_name == self.suite.path.name and line_text.isdecimal()
        return int(line_text) if is_own else float("inf")


def _in_one_line(diagnosis: Diagnosis) -> str:
    """Return the error of a specification in one line, without the source line and its caret."""
    first_line, hint = str(diagnosis).split("\n")[0], getattr(diagnosis, "hint", "")
    return f"{first_line}; {hint}" if hint else first_line


def _files(
    case: Case, folder: Path, texts: dict[Path | str, SpecificationText | None], faults: _Faults
) -> tuple[SpecFile, ...]:
    """Return the specification files of a case. A case with a faulty file has none."""
    for path in case.specs:
        if path in texts:
            continue
        texts[path] = None
        try:
            texts[path] = read_specification_text(path)
        except SpecificationError as error:
            faults.diagnoses.update((str(diagnosis), diagnosis) for diagnosis in error.diagnoses)
        except UsageError as error:
            faults.add(f"{case.place('specs')}{error}")
    if case.conditions.mapping is not None:
        try:
            load_mapping(case.conditions.mapping)
        except UsageError as error:
            faults.add(str(error))
    case_texts = tuple(text for path in case.specs if (text := texts[path]) is not None)
    if not case.is_whole or len(case_texts) < len(case.specs):
        return ()
    try:
        files = parsed_specifications(case_texts, case.conditions)
    except SpecificationError as error:
        faults.diagnoses.update((str(diagnosis), diagnosis) for diagnosis in error.diagnoses)
        return ()
    except UsageError as error:
        faults.add(f"{case.place('constants')}{error}")
        return ()
    for fault in choice_faults(case, files):
        faults.add(f"{case.place('each')}{fault}")
    return tuple(spec_file(*file, folder) for file in zip(case.specs, case_texts, files, strict=True))


@dataclass(frozen=True, slots=True)
class RowRequest:
    """Request for the rows of one log and one specification file.

    Attributes:
        key: hash of all inputs of the rows, see `row_key`; None if the log cannot be read.
    """

    case: Case
    log: FoundLog
    file: SpecFile
    key: str | None


@dataclass(frozen=True, eq=False)
class BatchResult:
    """Results of a batch.

    Attributes:
        table: one row for each case, log, spec and object of a template; see `store`.
        logs: number of logs.
        evaluated: number of logs that this run evaluated. The rows of other logs were stored.
        requests: requested rows of the suite.
        remarks: sentences on damaged stored files, which were replaced.
    """

    table: pa.Table
    logs: int
    evaluated: int
    requests: tuple[RowRequest, ...]
    remarks: tuple[str, ...] = ()

    @property
    def failures(self) -> pa.Table:
        """The rows that do not pass."""
        import pyarrow.compute as pc

        return self.table.filter(pc.is_valid(self.table.column("failure")))


def workers_of(
    jobs: int, dask: str | None = None, report: Callable[[str], None] = lambda text: None
) -> Workers:
    """Return the executor of a batch.

    Args:
        jobs: number of processes; 1 for this process alone.
        dask: address of a scheduler, whose workers need access to the same files.
        report: receives messages for a waiting user.
    """
    if dask is not None:
        return DaskCluster(dask, report)
    return LocalProcesses(jobs) if jobs > 1 else ThisProcess()


def run_batch(
    cases: Sequence[PreparedCase],
    results: str | PathLike[str],
    workers: Workers,
    *,
    fail_on: frozenset[str] = frozenset(),
    progress: Progress = no_progress,
) -> BatchResult:
    """Evaluate the logs without stored rows. Store and return the results of all logs.

    Args:
        results: folder of results or its address, created if needed.
        fail_on: kinds of results that fail even if the case allows them, see `FAILING_KINDS`.
        progress: shows the numbers of hashed and evaluated logs.

    Raises:
        UsageError: the folder has other contents.
        OutputError: rows cannot be written; earlier rows are stored.
        ClusterError: the scheduler of a cluster is lost; the rows so far are stored.
    """
    folder = ResultsFolder.create(results)
    with folder.lock():
        known_identities, remarks = folder.identities()
        paths = list(dict.fromkeys(log.path for case in cases for log in case.logs))
        identities, states = identify(paths, known_identities, workers, progress)
        requests = _requests(cases, identities)
        identities_by_state = {
            states[path] or "": identity for path, identity in identities.items() if identity and states[path]
        }
        # identities are written before the evaluation, so that a killed batch does not lose them
        folder.write_identities(identities_by_state)
        storable_keys = {
            request.key for request in requests if request.key is not None and not request.file.has_plugins
        }
        stored_rows, damage_remarks = folder.rows(storable_keys)
        tasks = _tasks(requests, set(stored_rows.column("key").to_pylist()))
        unstored_rows: dict[str, Sequence[ResultRow]] = {}
        with folder.new_rows() as new_rows, progress("logs", len(tasks)) as advance:
            for group, rows_of_group in _evaluated_groups(workers, list(tasks)) if tasks else ():
                states_now = states_of([task.log for task in group])
                for task, rows_of_log in zip(group, rows_of_group, strict=True):
                    # rows of a changed log are not stored; readers of remote logs check the version
                    is_unchanged = states_now[task.log] == states[task.log]
                    for key, rows in zip(tasks[task], rows_of_log, strict=True):
                        # an error may be temporary, so its rows are not stored
                        if is_unchanged and key in storable_keys and all(row.error is None for row in rows):
                            new_rows.add(key, rows)
                        else:
                            unstored_rows[key] = rows
                advance(len(group))
        table = _table(requests, [stored_rows, *new_rows.tables], unstored_rows, fail_on)
        explanations = folder.read_explanations()
        result_names = zip(
            *(table.column(name).to_pylist() for name in ("key", "spec", "object")), strict=True
        )
        explanations_by_place = {
            place: explanations[result_name]
            for place, result_name in enumerate(result_names)
            if result_name in explanations
        }
        table = _record_of(requests).store_in(with_explanations(table, explanations_by_place))
        folder.write_run(table)
    # unreadable logs have no key, but count as evaluated
    evaluated_logs = {task.log for task in tasks} | {
        request.log.path for request in requests if request.key is None
    }
    return BatchResult(table, len(paths), len(evaluated_logs), tuple(requests), (*remarks, *damage_remarks))


_GROUP_S: Final = 0.5
"""Target time for a group of logs, seconds."""
_GROWTH: Final = 8
"""Largest factor from the size of a finished group to the size of the next group.

The time of the first group includes loading code.
"""
_MOST_IN_GROUP: Final = 64
"""Maximum number of logs in a group. A scheduler takes 4 to 6 ms per task, the time of a short log."""


def _evaluated_groups(
    workers: Workers, tasks: Sequence[Task]
) -> Iterator[tuple[Sequence[Task], Sequence[TaskRows]]]:
    """Yield groups of tasks with their rows. The logs of a dead worker are evaluated again, one by one."""
    sized_groups = _Groups(tasks)
    single_tasks: list[tuple[Task, ...]] = []
    for task_groups in (sized_groups, single_tasks):
        for group, group_rows in workers.results(rows_from_tasks, task_groups) if task_groups else ():
            if not isinstance(group_rows, WorkerLost):
                sized_groups.note(group_rows)
                yield group, group_rows
            elif len(group) > 1:
                single_tasks += [(task,) for task in group]
            else:
                yield group, [error_rows(group[0], str(group_rows), "machine")]


class _Groups:
    """Tasks in groups, sized by the evaluation time of earlier logs."""

    def __init__(self, tasks: Sequence[Task]) -> None:
        self._tasks, self._group_size = tasks, 1

    def __iter__(self) -> Iterator[tuple[Task, ...]]:
        start = 0
        while start < len(self._tasks):
            end = start + self._group_size
            yield tuple(self._tasks[start:end])
            start = end

    def note(self, rows: Iterable[TaskRows]) -> None:
        """Adapt the size of the next group to the mean time per log in a finished group."""
        durations_s = [
            rows_of_log[0][0].seconds
            for rows_of_log in rows
            if rows_of_log[0] and rows_of_log[0][0].error is None
        ]
        if durations_s:
            size = int(_GROUP_S / max(sum(durations_s) / len(durations_s), 1e-6))
            self._group_size = max(1, min(size, _GROWTH * len(durations_s), _MOST_IN_GROUP))


def _requests(cases: Sequence[PreparedCase], identities: Mapping[str, str | None]) -> list[RowRequest]:
    requests = []
    for prepared_case in cases:
        case = prepared_case.case
        condition_values = _key_of(case.conditions)
        for log in prepared_case.logs:
            identity = identities[log.path]
            for file in prepared_case.files:
                key = _key(identity, condition_values, file.hash)
                requests.append(RowRequest(case, log, file, None if identity is None else key))
    return requests


def row_key(identity: str, conditions: Conditions, meaning: str) -> str:
    """Return the key of rows: a hash of the log, the conditions and the meaning of a specification."""
    return _key(identity, _key_of(conditions), meaning)


def _key(identity: str | None, conditions: list[Any], meaning: str) -> str:
    # another version of the program may give other results
    key_values = [FORMAT, __version__, identity, conditions, meaning]
    return hashlib.sha256(json.dumps(key_values).encode()).hexdigest()[:HASH_DIGITS]


def _key_of(conditions: Conditions) -> list[Any]:
    """Return the conditions in the key of a row, without constants: `SpecFile.hash` depends on constants."""
    mapping = conditions.mapping
    return [
        None if mapping is None else load_mapping(mapping).identity,
        conditions.reading,
        conditions.start,
        conditions.end,
        conditions.every,
        conditions.each,
        conditions.semantics,
        conditions.strict_names,
        conditions.requires,
    ]


def _tasks(requests: Sequence[RowRequest], stored_keys: set[str]) -> dict[Task, tuple[str, ...]]:
    """Return a task for each log and conditions with missing rows. Values are the keys of these rows."""
    files_by_task: dict[tuple[str, Conditions], dict[str, SpecFile]] = defaultdict(dict)
    known_keys = set(stored_keys)
    for request in requests:
        if request.key is not None and request.key not in known_keys:
            known_keys.add(request.key)
            files_by_task[request.log.path, request.case.conditions][request.key] = request.file
    return {
        Task(path, tuple(file.text for file in files.values()), conditions): tuple(files)
        for (path, conditions), files in files_by_task.items()
    }


def _table(
    requests: Sequence[RowRequest],
    stored_tables: Sequence[pa.Table],
    unstored_rows: Mapping[str, Sequence[ResultRow]],
    fail_on: frozenset[str],
) -> pa.Table:
    """Return the table of a run, with the rows of all requests."""
    import pyarrow as pa

    unreadable_rows = {
        f"{request.log.path}\0{request.file.hash}": _unreadable(request)
        for request in requests
        if request.key is None
    }
    all_rows = pa.concat_tables([*stored_tables, table_of({**unstored_rows, **unreadable_rows})])
    rows_by_key: dict[str, list[int]] = defaultdict(list)
    for row, key in enumerate(all_rows.column("key").to_pylist()):
        rows_by_key[key].append(row)
    row_indices, row_requests = [], []
    for request in requests:
        for row in rows_by_key[request.key or f"{request.log.path}\0{request.file.hash}"]:
            row_indices.append(row)
            row_requests.append(request)
    request_rows = all_rows.take(pa.array(row_indices, pa.int64()))
    return _judge_rows(_restore_file_names(request_rows, row_requests), row_requests, fail_on)


def _record_of(requests: Sequence[RowRequest]) -> RunRecord:
    cases: dict[str, dict[str, Any]] = {}
    for request in requests:
        case, file = request.case, request.file
        if case.name not in cases:
            cases[case.name] = {"conditions": recorded_conditions(case.conditions), "files": {}}
        cases[case.name]["files"][file.name] = [file.text.text, file.text.filename]
    return RunRecord(_folder_of(requests), cases)


def _folder_of(requests: Sequence[RowRequest]) -> str:
    """Return the base folder of the names of logs."""
    for request in requests:
        log = request.log
        if not is_address(log.path) and log.path.endswith(log.name) and not Path(log.name).is_absolute():
            return str(Path(log.path.removesuffix(log.name)).absolute())
    return str(Path.cwd())


def _restore_file_names(rows: pa.Table, requests: Sequence[RowRequest]) -> pa.Table:
    """Put the name of the requested file into texts that name another file of the same content."""
    import pyarrow as pa

    stored_names = rows.column(SOURCE).to_pylist()
    requested_names = [encodable(log_file(request.log.path).name) for request in requests]
    changed_rows = [
        row
        for row, (old, new) in enumerate(zip(stored_names, requested_names, strict=True))
        if old not in (None, new)
    ]
    if not changed_rows:
        return rows
    for column in ("faults", "remarks", "missing", "error"):
        texts = rows.column(column).to_pylist()
        for row in changed_rows:
            texts[row] = _rename_file(texts[row], stored_names[row], requested_names[row])
        field = rows.schema.field(column)
        rows = rows.set_column(rows.schema.get_field_index(column), field, pa.array(texts, field.type))
    return rows


def _rename_file(text: str | list[str] | None, old: str, new: str) -> str | list[str] | None:
    """Replace a file name where it is a whole word: "a.csv" is also a part of "b-a.csv.gz"."""
    if isinstance(text, str):
        return re.sub(rf"(?<![\w./-]){re.escape(old)}(?![\w-]|\.\w)", lambda _: new, text)
    return text and [str(_rename_file(line, old, new)) for line in text]


def _unreadable(request: RowRequest) -> tuple[ResultRow, ...]:
    """Return the error rows of a log that could not be hashed."""
    task = Task(request.log.path, (request.file.text,), request.case.conditions)
    (rows,) = rows_from_task(task)
    if all(row.error is None for row in rows):
        # the log became readable after the hashing
        message = f"{request.log.name} could not be read at first; run the batch again"
        (rows,) = error_rows(task, message, "machine")
    return rows


def _judge_rows(rows: pa.Table, requests: Sequence[RowRequest], fail_on: frozenset[str]) -> pa.Table:
    """Add the columns of a run's table to rows: case, log, file, expectation and failure."""
    import pyarrow as pa

    specs = rows.column("spec").to_pylist()
    columns = {name: rows.column(name) for name in rows.column_names}
    judged_values = rows.select(_JUDGED).to_pylist()
    # the id is the key, because hashing a `SpecFile` reads its whole text
    lines = {id(request.file): dict(request.file.lines) for request in requests}
    meanings = {id(request.file): dict(request.file.meanings) for request in requests}
    requirements = zip(columns["requirement"].to_pylist(), requests, strict=True)
    columns |= {
        "verdict": [
            request.case.expectation.verdict_of(row["verdict"], _lower(row))
            for row, request in zip(judged_values, requests, strict=True)
        ],
        "case": [request.case.name for request in requests],
        "log": [request.log.name for request in requests],
        "file": [request.file.name for request in requests],
        "meaning": [
            meanings[id(request.file)].get(name) for request, name in zip(requests, specs, strict=True)
        ],
        "expected": [request.case.expectation.text for request in requests],
        "failure": [
            _failure(row, request.case.expectation, fail_on)
            for row, request in zip(judged_values, requests, strict=True)
        ],
        "line": [lines[id(request.file)].get(name, 1) for request, name in zip(requests, specs, strict=True)],
        "requirement": [
            requirement or ", ".join(request.case.requirements) or None
            for requirement, request in requirements
        ],
    }
    schema = run_columns()
    return pa.table({field.name: columns[field.name] for field in schema}, schema=schema)


_JUDGED = ["verdict", "lower", "tested", "untested", "vacuous", "left", "doubtful", "dropped"]
_JUDGED += ["faults", "error"]


def _failure(row: Mapping[str, Any], expectation: Expectation, fail_on: frozenset[str]) -> str | None:
    """Return the reason for the failure of a row, in a few words; None if the row passes."""
    if row["verdict"] is None:
        return cast("str | None", row["error"])
    return expectation.failure(cast(Outcome, SimpleNamespace(**{**row, "lower": _lower(row)})), fail_on)


def _lower(row: Mapping[str, Any]) -> float:
    """Return the least possible robustness of a row; NaN if unknown."""
    return nan if row["lower"] is None else cast(float, row["lower"])
