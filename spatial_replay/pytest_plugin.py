"""A pytest plugin that collects suites named `*.replay.yaml`, with one test for each log and spec.

Every run of pytest imports this module. The module imports the package only for a suite.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from spatial_replay.batch.rows import ResultRow, Task
    from spatial_replay.batch.suite import Case

_ENDINGS = (".replay.yaml", ".replay.yml")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option for the number of processes."""
    parser.getgroup("spatial-replay").addoption(
        "--replay-jobs",
        type=int,
        default=1,
        metavar="N",
        help="Processes that evaluate the logs of *.replay.yaml files.  [default: 1]",
    )


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect suites."""
    return SuiteFile.from_parent(parent, path=file_path) if file_path.name.endswith(_ENDINGS) else None


class SuiteFile(pytest.File):
    """A suite: its tests are the specs over the logs of its cases."""

    def collect(self) -> Iterable[pytest.Item]:
        """Yield a test for each case, log and spec. Faults of the suite end the collection."""
        from spatial_replay.batch.rows import Task
        from spatial_replay.batch.run import prepare
        from spatial_replay.batch.suite import load_suite
        from spatial_replay.errors import SpatialReplayError

        try:
            cases = prepare(load_suite(self.path))
        except SpatialReplayError as error:
            raise self.CollectError(str(error)) from None
        for prepared_case in cases:
            case = prepared_case.case
            for log in prepared_case.logs:
                task = Task(log.path, tuple(file.text for file in prepared_case.files), case.conditions)
                for file_index, file in enumerate(prepared_case.files):
                    # several specification files may have a spec of the same name
                    stem = f"{file.name.removesuffix('.spatial')}." if len(prepared_case.files) > 1 else ""
                    for spec in _result_names(task, file_index):
                        name = f"{case.name}[{log.name}-{stem}{spec}]"
                        yield ReplayItem.from_parent(
                            self, name=name, case=case, task=task, file=file_index, spec=spec, log=log.name
                        )


class ReplayItem(pytest.Item):
    """A spec over a log."""

    def __init__(
        self, *, case: Case, task: Task, file: int, spec: str, log: str, name: str, parent: SuiteFile
    ) -> None:
        super().__init__(name, parent)
        self.task = task
        self._case, self._file, self._spec, self._log = case, file, spec, log
        if self.config.pluginmanager.hasplugin("xdist"):
            # with --dist loadgroup, one worker gets all specs of a log
            self.add_marker(pytest.mark.xdist_group(task.log))

    def runtest(self) -> None:
        """Evaluate the log if needed, and fail with the explanations of all failing results."""
        rows = [row for row in _results(self.session).rows(self.task)[self._file] if row.spec == self._spec]
        ids = dict.fromkeys([*filter(None, (row.requirement for row in rows)), *self._case.requirements])
        self.user_properties += [("requirement", identifier) for identifier in ids]
        self.user_properties += [("untested", text) for row in rows for text in row.untested]
        failures = [text for row in rows if (text := self._failure(row)) is not None]
        if failures:
            raise _NotSatisfiedError("\n\n".join(failures))

    def _failure(self, row: ResultRow) -> str | None:
        """Return the failure of a result with its explanation; None for a passing result."""
        from spatial_replay.text import requirement_text

        failure = row.error
        if row.verdict is not None:
            failure = self._case.expectation.failure(row)
        if failure is None:
            return None
        title = row.spec if row.object is None else f"{row.spec}[{row.object}]"
        requirement = requirement_text(row.requirement or ", ".join(self._case.requirements), row.title)
        lines = [f"{self._log}: {title}: {failure}", requirement, *(row.explanation or ())]
        return "\n".join(filter(None, lines))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Return the explanation without a traceback, because a traceback would only show this plugin."""
        if isinstance(excinfo.value, _NotSatisfiedError):
            return str(excinfo.value)
        return super().repr_failure(excinfo)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return the suite's file and a title."""
        return self.path, None, f"{self._spec} over {self._log}, case {self._case.name}"


class _NotSatisfiedError(Exception):
    """A result that differs from the expectation of its case."""


class _Results:
    """The rows of a session's logs. Each log is evaluated once, for the first of its tests.

    With several processes, all logs are evaluated when the first test runs.
    """

    def __init__(self, jobs: int, tasks: Iterable[Task]) -> None:
        self._jobs = jobs
        self._tasks = list(dict.fromkeys(tasks))
        self._rows: dict[Task, tuple[tuple[ResultRow, ...], ...]] = {}

    def rows(self, task: Task) -> tuple[tuple[ResultRow, ...], ...]:
        """Return the rows of a log, by specification file."""
        if task not in self._rows:
            self._rows.update(self._evaluate(self._tasks if self._jobs > 1 else [task]))
        return self._rows[task]

    def _evaluate(self, tasks: list[Task]) -> Iterator[tuple[Task, tuple[tuple[ResultRow, ...], ...]]]:
        from spatial_replay.batch.rows import error_rows, rows_with_explanations
        from spatial_replay.batch.run import workers_of
        from spatial_replay.batch.workers import WorkerLost

        for task, rows in workers_of(self._jobs).results(rows_with_explanations, tasks):
            yield task, error_rows(task, str(rows), "machine") if isinstance(rows, WorkerLost) else rows


_RESULTS = pytest.StashKey[_Results]()


def _results(session: pytest.Session) -> _Results:
    """Return the results of a session's tests. They are evaluated on demand."""
    if _RESULTS not in session.stash:
        jobs = session.config.getoption("--replay-jobs")
        tasks = [item.task for item in session.items if isinstance(item, ReplayItem)]
        # under xdist, each worker starts no further processes
        session.stash[_RESULTS] = _Results(1 if hasattr(session.config, "workerinput") else jobs, tasks)
    return session.stash[_RESULTS]


def _result_names(task: Task, file: int) -> list[str]:
    from spatial_replay.batch.rows import parsed_specifications

    return [spec.name for spec in parsed_specifications(task.specs, task.conditions)[file].results]
