"""Evaluates the specifications of a task over its log, and returns rows.

A task is sent to another process: it holds the texts of its specifications, and no open file. The rows of a
task are plain values, too.
"""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from typing import Any, Final, Literal, TypeAlias

from spatial_replay.annotate.specification import ReportedTree
from spatial_replay.batch.suite import DEFAULT_CONDITIONS, Conditions
from spatial_replay.errors import (
    GeometryError,
    LogError,
    SpatialReplayError,
    SpecificationError,
    TraceError,
    UnfitLogError,
    UsageError,
)
from spatial_replay.logs.remote import log_file
from spatial_replay.logs.source import Source
from spatial_replay.logs.topics import MAPPED
from spatial_replay.mapping.episode_source import read_together
from spatial_replay.monitor.result import RESULT_COLUMNS, SpecResult
from spatial_replay.monitor.vacuity import Tested, UntestedPart
from spatial_replay.monitor.verdict import Verdict
from spatial_replay.replay.engine import Replay, Replayed
from spatial_replay.replay.selection import ReplayOptions, Window, window_from_points
from spatial_replay.replay.together import JointReplay, ShortLog, can_join
from spatial_replay.sources.open_log import open_source
from spatial_replay.sources.overview import fitness_of
from spatial_replay.spec.diagnostics import Diagnostic, SourceText
from spatial_replay.spec.formula import NamedSpec, Specification
from spatial_replay.spec.load import SpecificationText, load_specifications
from spatial_replay.text import counted_from, encodable, first_lines, printable
from spatial_replay.trace.trace import time_point_from_text

ErrorKind: TypeAlias = Literal["usage", "log", "unfit", "machine"]
"""Source of an error: the user's options and files, the log, or the machine and this program.

An "unfit" log can be read, but does not meet a requirement of the suite.
"""

ResultName: TypeAlias = tuple[int, str, str | None]
"""Name of a result in a task: the index of the specification file, the spec, and the object of a template."""

_LONGEST: Final = 2_000
"""Length limit of a text in a row, characters."""
_MOST: Final = 20
"""Maximum number of entries in a list of a row. A further entry gives the number of omitted entries."""
_KINDS: Final[tuple[tuple[tuple[type[Exception], ...], ErrorKind], ...]] = (
    ((UsageError, SpecificationError), "usage"),
    ((LogError, TraceError, GeometryError), "log"),
    ((UnfitLogError,), "unfit"),
)


@dataclass(frozen=True, slots=True)
class Task:
    """A log to evaluate.

    Attributes:
        log: path or address of the log.
        specs: texts of the specification files.
        conditions: options of reading and evaluation. Objects for a parameter are ignored if no spec in
            `specs` has the parameter, because the rows of its specs may be stored already.
    """

    log: str
    specs: tuple[SpecificationText, ...]
    conditions: Conditions = DEFAULT_CONDITIONS


@dataclass(frozen=True, slots=True)
class ResultRow:
    """The result of one spec over one log, or an error.

    Attributes:
        spec: name of the spec.
        object: object of a template's parameter, or None.
        requirement, title: id and sentence of the spec, or None.
        line: line of the spec in its file, from 1.
        verdict: verdict of the spec; None for an error.
        unit: declared unit of the robustness, or "".
        robustness, lower, upper: robustness and its interval; NaN if not determined.
        first_satisfied_ns, violated_at_ns, satisfied_at_ns: as in `SpecResult`.
        atom, atom_time_ns, atom_objects: deciding atom with its time and objects; the atom of the first cause
            for a violation.
        reason: sentence on the deciding atom, and on the atom of the robustness if it is another atom; ""
            under the paper's semantics.
        explanation: sentences of `explain`. A satisfied spec lacks the time since which it holds.
            `explanation`, `reason` and `atom…` are None for an unexplained result.
        tested: see `SpecResult.tested`; None for an error.
        untested: sentences on the parts whose `tested` is not "full".
        vacuous: sentences on the parts that decided nothing.
        left: sentences on group members that left the log within reach of a threshold and came back.
        doubts: names of the verdict's assumptions that the log contradicts.
        doubtful: sentences on the assumptions in `doubts`.
        dropped: sentence on messages that the recorder dropped, or None.
        samples: number of evaluated samples.
        zero_ns: zero of the times in sentences about the log.
        start_ns: time of the first evaluated sample.
        duration_ns: time from the first to the last evaluated sample.
        faults, remarks, missing: losses while reading, remarks on the log, and names that the log lacks.
        seconds: time of reading and evaluating the log with all its specifications.
        error: reason for a missing verdict, or None.
        error_kind: see `ErrorKind`; None without an error.
        source: name of the evaluated file in faults, remarks and errors.
    """

    spec: str = ""
    object: str | None = None
    requirement: str | None = None
    title: str | None = None
    line: int = 1
    verdict: Verdict | None = None
    unit: str = ""
    robustness: float = float("nan")
    lower: float = float("nan")
    upper: float = float("nan")
    first_satisfied_ns: int | None = None
    violated_at_ns: int | None = None
    satisfied_at_ns: int | None = None
    atom: str | None = None
    atom_time_ns: int | None = None
    atom_objects: tuple[str, ...] | None = ()
    reason: str | None = ""
    explanation: tuple[str, ...] | None = ()
    tested: Tested | None = None
    untested: tuple[str, ...] = ()
    vacuous: tuple[str, ...] = ()
    left: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    doubtful: tuple[str, ...] = ()
    dropped: str | None = None
    samples: int = 0
    zero_ns: int | None = None
    start_ns: int | None = None
    duration_ns: int | None = None
    faults: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    seconds: float = 0.0
    error: str | None = None
    error_kind: ErrorKind | None = None
    source: str = ""


TaskRows: TypeAlias = tuple[tuple[ResultRow, ...], ...]
"""Rows of a task, grouped by specification file."""


def rows_from_task(task: Task, explained: Collection[ResultName] | None = ()) -> TaskRows:
    """Open a log once, evaluate all its specifications over it, and return their rows.

    Args:
        explained: results to explain; None for all. Explanations take longer than the evaluation.

    Returns:
        For each of `task.specs`, one row per result and per object of a template, in the order of the text.
        Each row of a log with an error has the error. Only an interruption is raised.
    """
    begin_s = time.perf_counter()
    try:
        files = parsed_specifications(task.specs, task.conditions)
        source, options = opened_task(task, files)
        _refuse_unfit(task, source)
        replay = Replay(source, files, options, keep_leaves=True, certify=False)
        replayed = replay.run()
        rows = _rows_of_log(task, files, replay.trees, replayed, explained)
    except Exception as error:  # one log must not end a batch
        return error_rows(task, *error_from_exception(error))
    return _rows_with_time(rows, time.perf_counter() - begin_s)


def rows_from_tasks(tasks: tuple[Task, ...]) -> list[TaskRows]:
    """Return the rows of several logs. Short logs are evaluated together."""
    rows: list[TaskRows] = []
    # `groupby` needs neighbours, and the tasks of a case are neighbours
    for _, like_tasks in groupby(tasks, lambda task: (task.specs, task.conditions)):
        rows += _rows_of_like_tasks(list(like_tasks))
    return rows


def _rows_of_like_tasks(tasks: Sequence[Task]) -> list[TaskRows]:
    """Return the rows of tasks with the same specifications and conditions."""
    try:
        files = parsed_specifications(tasks[0].specs, tasks[0].conditions)
    except SpatialReplayError:
        return [rows_from_task(task) for task in tasks]
    rows_by_task: dict[Task, TaskRows] = {}
    sources: dict[Task, tuple[Source, ReplayOptions]] = {}
    begin_s = time.perf_counter()
    for task in tasks:
        try:
            source, options = opened_task(task, files)
            _refuse_unfit(task, source)
        except Exception as error:  # one log must not end a batch
            rows_by_task[task] = error_rows(task, *error_from_exception(error))
            continue
        sources[task] = source, options
    if not sources or not can_join(files, next(iter(sources.values()))[1]):
        return [rows_by_task[task] if task in rows_by_task else rows_from_task(task) for task in tasks]
    joint_replay = None
    short_logs: dict[Task, ShortLog] = {}
    whole_sources = read_together([source for source, _ in sources.values()])
    for (task, (_, options)), source in zip(sources.items(), whole_sources, strict=True):
        try:
            joint_replay = joint_replay or JointReplay(source, files, options)
            log = joint_replay.read(source) if joint_replay.fits(source) else None
        except Exception as error:
            rows_by_task[task] = error_rows(task, *error_from_exception(error))
            continue
        if log is None:
            rows_by_task[task] = rows_from_task(task)
            continue
        short_logs[task] = log
        if joint_replay.is_enough(short_logs.values()):
            rows_by_task |= _rows_of_short_logs(joint_replay, files, short_logs, begin_s)
            short_logs, begin_s = {}, time.perf_counter()
    if joint_replay is not None and short_logs:
        rows_by_task |= _rows_of_short_logs(joint_replay, files, short_logs, begin_s)
    return [rows_by_task[task] for task in tasks]


def _rows_of_short_logs(
    joint: JointReplay, files: Sequence[Specification], logs: Mapping[Task, ShortLog], begin_s: float
) -> dict[Task, TaskRows]:
    """Evaluate short logs together. The rows have equal shares of the time since `begin_s`."""
    rows_by_task: dict[Task, TaskRows] = {}
    try:
        for task, replayed in zip(logs, joint.replay([*logs.values()]), strict=True):
            rows_by_task[task] = _rows_of_log(task, files, joint.trees, replayed, ())
    except Exception:  # the other logs are evaluated one by one, and only the faulty log has the error
        other_tasks = [task for task in logs if task not in rows_by_task]
    else:
        other_tasks = []
    seconds_per_log = (time.perf_counter() - begin_s) / len(logs)
    rows_by_task = {task: _rows_with_time(rows, seconds_per_log) for task, rows in rows_by_task.items()}
    return rows_by_task | {task: rows_from_task(task) for task in other_tasks}


def _rows_with_time(rows: TaskRows, seconds: float) -> TaskRows:
    return tuple(tuple(replace(row, seconds=seconds) for row in rows_of_file) for rows_of_file in rows)


def rows_with_explanations(task: Task) -> TaskRows:
    """Return the rows of a log with all explanations (see `rows_from_task`)."""
    return rows_from_task(task, None)


def _refuse_unfit(task: Task, source: Source) -> None:
    """Raise UnfitLogError if a log does not meet a requirement of its suite."""
    if not task.conditions.requires:
        return
    shortfalls = list(fitness_of(task.log, source).lacks(json.loads(task.conditions.requires)))
    if shortfalls:
        raise UnfitLogError(f"{source.name} is unfit to be judged: {'; '.join(shortfalls)}")


def opened_task(task: Task, files: Sequence[Specification]) -> tuple[Source, ReplayOptions]:
    """Return the open log of a task and the options of its replay.

    Raises:
        UsageError, LogError: the log cannot be opened, or its first sample cannot be read.
    """
    conditions = task.conditions
    source = open_source(task.log, mapping=conditions.mapping, **dict(conditions.reading))
    parameters = {spec.parameter for file in files for spec in file.results}
    choices = {name: objects for name, objects in conditions.each if name in parameters}
    window = _window(source, conditions)
    # only mapped messages are read, because samples need no others
    return source, ReplayOptions(window, choices, conditions.semantics, conditions.strict_names, (MAPPED,))


def _window(source: Source, conditions: Conditions) -> Window:
    start, end = (
        None if text is None else time_point_from_text(text) for text in (conditions.start, conditions.end)
    )
    return window_from_points(source, start, end, conditions.every)


@lru_cache(maxsize=64)
def parsed_specifications(
    specs: tuple[SpecificationText, ...], conditions: Conditions
) -> tuple[Specification, ...]:
    """Parse specifications with the constants of a case. Results are cached.

    Raises:
        SpecificationError: a specification has errors.
        UsageError: no specification has a given constant.
    """
    return tuple(load_specifications(specs, constants=dict(conditions.constants)))


def error_from_exception(error: Exception) -> tuple[str, ErrorKind]:
    """Return the message and the kind of an error."""
    kind: ErrorKind = "machine"
    for error_types, error_kind in _KINDS:
        if isinstance(error, error_types):
            kind = error_kind
    if isinstance(error, SpatialReplayError):
        return str(error), kind
    if isinstance(error, MemoryError):
        return "out of memory", kind
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror, kind
    return f"internal error: {type(error).__name__}: {error}", kind


def error_rows(task: Task, message: str, kind: ErrorKind) -> TaskRows:
    """Return a row with the error for each spec of a task.

    An unparsable specification has one row with an empty name.
    """
    error_row = ResultRow(error=_cut(message), error_kind=kind, source=log_file(task.log).name)
    rows: list[tuple[ResultRow, ...]] = []
    for text in task.specs:
        try:
            (file,) = parsed_specifications((text,), replace(task.conditions, constants=()))
        except SpatialReplayError:
            rows.append((error_row,))
        else:
            line_by_spec = spec_lines(file)
            rows.append(tuple(_about(error_row, spec, line_by_spec) for spec in file.results))
    return tuple(rows)


def _about(row: ResultRow, spec: NamedSpec, lines: Mapping[str, int], **values: Any) -> ResultRow:
    """Return a row with the name, requirement, title and line of a spec, and with other values."""
    return replace(
        row, spec=spec.name, requirement=spec.id, title=spec.title, line=lines[spec.name], **values
    )


def _rows_of_log(
    task: Task,
    files: Sequence[Specification],
    trees: Sequence[ReportedTree],
    replayed: Replayed,
    explained: Collection[ResultName] | None,
) -> TaskRows:
    log_row = ResultRow(
        samples=replayed.samples,
        zero_ns=replayed.first_ns,
        start_ns=replayed.start_ns,
        duration_ns=replayed.end_ns - replayed.start_ns,
        faults=_some(replayed.faults),
        remarks=_some(replayed.remarks),
        missing=_some([_missing(name) for name in replayed.missing]),
        left=_some([departure.message for departure in replayed.left]),
        dropped=replayed.dropped.text or None,
        source=encodable(log_file(task.log).name),
    )
    return tuple(
        _rows_of_file(log_row, trees, replayed, file, index, explained) for index, file in enumerate(files)
    )


def _rows_of_file(
    log_row: ResultRow,
    trees: Sequence[ReportedTree],
    replayed: Replayed,
    file: Specification,
    file_index: int,
    explained: Collection[ResultName] | None,
) -> tuple[ResultRow, ...]:
    line_by_spec = spec_lines(file)
    tree_results = zip(trees, replayed.results, strict=True)
    # a replay renames specs of several files with the same name; a row has the name in its file
    results = [
        result if result.name == result.spec.name else replace(result, name=result.spec.name)
        for tree, result in tree_results
        if tree.file == file_index
    ]
    parts = {part.text: part for part in replayed.vacuous}
    rows = [_row(log_row, result, replayed.first_ns, line_by_spec) for result in results]
    rows = [
        _with_explanation(row, result, replayed.first_ns)
        if explained is None or (file_index, row.spec, row.object) in explained
        else row
        for row, result in zip(rows, results, strict=True)
    ]
    result_names = {result.name for result in results}
    idle = [spec for spec in file.results if spec.name not in result_names and spec.parameter is not None]
    rows += [
        _idle_row(_about(log_row, spec, line_by_spec), parts[f"{spec.name}({spec.parameter})"])
        for spec in idle
    ]
    return tuple(rows)


def _missing(diagnostic: Diagnostic) -> str:
    """Return a sentence on a missing name with the nearest name, and without the other names of the log."""
    nearest_name, mark, _ = diagnostic.hint.partition("'?")
    return f"{diagnostic.message}; {nearest_name}{mark}" if mark else diagnostic.message


def _row(log_row: ResultRow, result: SpecResult, first_ns: int, lines: Mapping[str, int]) -> ResultRow:
    return _about(
        log_row,
        result.spec,
        lines,
        **{name: getattr(result, name) for name in (*RESULT_COLUMNS, "unit", "tested") if name != "name"},
        atom_objects=None,
        reason=None,
        explanation=None,
        untested=_some(counted_from((part.message for part in result.untested), first_ns)),
        vacuous=_some(counted_from((part.message for part in result.vacuous), first_ns)),
        doubts=tuple(doubt.assumption for doubt in result.doubts),
        doubtful=_some([doubt.text for doubt in result.doubts]),
    )


def _with_explanation(row: ResultRow, result: SpecResult, first_ns: int) -> ResultRow:
    witness = result.worst
    deciding_atom = None if witness is None else witness.deciding
    return replace(
        row,
        atom=None if deciding_atom is None else _cut(deciding_atom.text),
        atom_time_ns=None if witness is None else witness.time_ns,
        atom_objects=() if deciding_atom is None else tuple(deciding_atom.objects),
        reason=_cut(result.reason(first_ns)),
        explanation=_some(result.sentences(first_ns)),
    )


def _idle_row(row: ResultRow, part: UntestedPart) -> ResultRow:
    """Return the row of a template without matching objects: satisfied, and tested by nothing."""
    message = _cut(part.message)
    infinity = float("inf")
    return replace(
        row,
        verdict=Verdict.SATISFIED,
        robustness=infinity,
        lower=infinity,
        upper=infinity,
        explanation=(message,),
        tested="nothing",
        untested=(message,),
        vacuous=(message,),
    )


def spec_lines(file: Specification) -> dict[str, int]:
    """Return the line of each spec in the file's text."""
    text = SourceText.of(file.source, file.filename)
    return {spec.name: text.line_of(spec.span.start) for spec in file.specs}


def _some(texts: Sequence[str]) -> tuple[str, ...]:
    """Return texts of bounded length and number. The last text gives the number of omitted texts."""
    return tuple(map(_cut, first_lines(texts, _MOST)))


def _cut(text: str) -> str:
    return "\n".join(printable(line, _LONGEST) for line in text.split("\n")[:_MOST])
