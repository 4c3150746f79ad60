"""Pages of a batch: one over all logs, and a report of each log that fails."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Final

from spatial_replay.batch.curves import Curve, read_curves
from spatial_replay.batch.overview import INDEX, overview_page
from spatial_replay.batch.rows import Task, opened_task, parsed_specifications
from spatial_replay.batch.run import BatchResult, Wanted
from spatial_replay.batch.workers import Progress, Workers, no_progress
from spatial_replay.errors import OutputError, SpatialReplayError, UsageError
from spatial_replay.logs.output_file import output_error, replacing
from spatial_replay.report.write import write_report

_FOLDER: Final = "reports"
_LONGEST: Final = 80
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9._-]+")


def write_pages(
    result: BatchResult, folder: Path, name: str, workers: Workers, *, progress: Progress = no_progress
) -> dict[tuple[str, str], Path]:
    """Write the page over all logs, and one about each log with a verdict that fails.

    A page that an earlier run has written of the same log and specifications stays.

    Args:
        folder: made if need be; the page over all is its `index.html`.
        name: of the suite.
        progress: shows how many pages have been written.

    Returns:
        The pages, by case and log.

    Raises:
        UsageError: the folder is a file.
        OutputError: a page cannot be written.
    """
    failing = _failing(result)
    pages = {key: folder / _FOLDER / _file_name(key[1], requests) for key, requests in failing.items()}
    try:
        (folder / _FOLDER).mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise UsageError(f"{folder} is a file; give --html the name of a folder") from None
    except OSError as error:
        raise output_error(folder, error) from error
    missing = {
        path: (_task(failing[key]), path.resolve()) for key, path in pages.items() if not path.exists()
    }
    with progress("reports", len(missing)) as advance:
        for _ in workers.results(_write_page, missing.values()) if missing else ():
            advance(1)
    pages = {key: path for key, path in pages.items() if path.exists()}
    links = {key: path.relative_to(folder).as_posix() for key, path in pages.items()}
    curves: dict[str, list[Curve]] = {}
    for (case, log), path in pages.items():
        curves.setdefault(case, []).extend(read_curves(path, log, links[case, log]))
    with replacing(folder / INDEX) as stream:
        stream.write(overview_page(result.table, name, links, curves))
    return pages


def _failing(result: BatchResult) -> dict[tuple[str, str], list[Wanted]]:
    """Return what is wanted of each log with a failing verdict, by case and log."""
    names = ("case", "log", "failure", "error")
    rows = zip(*(result.table.column(name).to_pylist() for name in names), strict=True)
    wanted_by_log: dict[tuple[str, str], list[Wanted]] = {
        (case, log): [] for case, log, failure, error in rows if failure and not error
    }
    for request in result.wanted:
        if (request.case.name, request.log.name) in wanted_by_log:
            wanted_by_log[request.case.name, request.log.name].append(request)
    # a result that is gone may have no log any more
    return {key: requests for key, requests in wanted_by_log.items() if requests}


def _task(wanted: list[Wanted]) -> Task:
    first = wanted[0]
    return Task(first.log.path, tuple(request.file.text for request in wanted), first.case.conditions)


def _file_name(log: str, wanted: list[Wanted]) -> str:
    """Return a name that says which log it is, and changes with what the page shows."""
    digest = hashlib.sha256("".join(request.key or "" for request in wanted).encode()).hexdigest()[:12]
    return f"{_UNSAFE.sub('-', log).strip('-.')[-_LONGEST:]}-{digest}.html"


def _write_page(page: tuple[Task, Path]) -> None:
    """Write one page about a log; one that cannot be read any more has none."""
    task, path = page
    try:
        files = parsed_specifications(task.specs, task.conditions)
        source, options = opened_task(task, files)
        write_report(source, files, path, options)
    except OutputError:
        raise
    except (SpatialReplayError, OSError):
        return
