"""Pages of a batch: a page over all logs, and a report for each failing log."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final
from urllib.parse import quote

from spatial_replay.batch.curves import Curve, read_curves
from spatial_replay.batch.overview import INDEX, overview_page
from spatial_replay.batch.rows import Task, opened_task, parsed_specifications
from spatial_replay.batch.run import BatchResult, RowRequest
from spatial_replay.batch.run_table import worst_rows
from spatial_replay.batch.workers import Progress, Workers, no_progress
from spatial_replay.errors import OutputError, SpatialReplayError, UsageError
from spatial_replay.html import element
from spatial_replay.logs.output_file import output_error, replacing
from spatial_replay.report.page import HEADER, text
from spatial_replay.report.write import write_report

_FOLDER: Final = "reports"
_LONGEST: Final = 80
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9._-]+")
_HEAD: Final = re.compile(rb'(?:<nav class="neighbours".*?</nav>)?' + re.escape(HEADER.encode()), re.DOTALL)
"""Beginning of a report's header, with the links of an earlier batch if there are any."""


def write_pages(
    result: BatchResult, folder: Path, name: str, workers: Workers, *, progress: Progress = no_progress
) -> dict[tuple[str, str], Path]:
    """Write the page over all logs, and a page about each log with a failing verdict.

    A page of an earlier run about the same log and specifications is reused, with new links. The
    links follow the order of the logs, the worst first.

    Args:
        folder: folder of the pages, created if needed. The page over all logs is its `index.html`.
        name: name of the suite.
        progress: shows the number of written pages.

    Returns:
        The paths of the pages about logs, by case and log.

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
    missing_pages = {
        path: (_task(failing[key]), path.resolve()) for key, path in pages.items() if not path.exists()
    }
    with progress("reports", len(missing_pages)) as advance:
        for _ in workers.results(_write_page, missing_pages.values()) if missing_pages else ():
            advance(1)
    worst_first = dict.fromkeys(
        (row["case"], row["log"]) for row in worst_rows(result.table, len(result.table))
    )
    pages = {key: pages[key] for key in worst_first if key in pages and pages[key].exists()}
    _link_pages(pages)
    addresses = {key: path.relative_to(folder).as_posix() for key, path in pages.items()}
    curves: dict[str, list[Curve]] = {}
    for (case, log), path in pages.items():
        curves.setdefault(case, []).extend(read_curves(path, log, addresses[case, log]))
    with replacing(folder / INDEX) as stream:
        stream.write(overview_page(result.table, name, addresses, curves))
    return pages


def _link_pages(pages: Mapping[tuple[str, str], Path]) -> None:
    """Add links to each page about a log: to the page over all logs, and to the neighbouring pages."""
    neighbours = [(log, path.name) for (_, log), path in pages.items()]
    for index, path in enumerate(pages.values()):
        links = [element("a", "All logs", href=f"../{INDEX}")]
        links.append(element("span", f"{index + 1} of {len(pages)} that fail"))
        for words, neighbour_index in (("Previous", index - 1), ("Next", index + 1)):
            if 0 <= neighbour_index < len(pages):
                log, address = neighbours[neighbour_index]
                relation = "prev" if neighbour_index < index else "next"
                links.append(element("a", f"{words}: ", text(log), href=quote(address), rel=relation))
        nav = element("nav", *links, **{"class": "neighbours", "aria-label": "Logs that fail"})
        content, new_header = path.read_bytes(), (nav + HEADER).encode()
        # in a replacement of `re`, backslashes are escapes, and names of logs may contain them
        new_content = _HEAD.sub(new_header.replace(b"\\", rb"\\"), content, count=1)
        if new_content != content:
            with replacing(path) as stream:
                stream.write(new_content)


def _failing(result: BatchResult) -> dict[tuple[str, str], list[RowRequest]]:
    """Return the requests of each log with a failing verdict, by case and log."""
    columns = ("case", "log", "failure", "error")
    rows = zip(*(result.table.column(name).to_pylist() for name in columns), strict=True)
    requests_by_log: dict[tuple[str, str], list[RowRequest]] = {
        (case, log): [] for case, log, failure, error in rows if failure and not error
    }
    for request in result.requests:
        if (request.case.name, request.log.name) in requests_by_log:
            requests_by_log[request.case.name, request.log.name].append(request)
    # the log of a gone result may be gone, too
    return {key: requests for key, requests in requests_by_log.items() if requests}


def _task(requests: list[RowRequest]) -> Task:
    first = requests[0]
    return Task(first.log.path, tuple(request.file.text for request in requests), first.case.conditions)


def _file_name(log: str, requests: list[RowRequest]) -> str:
    """Return a file name with the log's name and a hash of the page's inputs."""
    digest = hashlib.sha256("".join(request.key or "" for request in requests).encode()).hexdigest()[:12]
    # the end of a long name stays, because it distinguishes logs
    return f"{_UNSAFE.sub('-', log).strip('-.')[-_LONGEST:]}-{digest}.html"


def _write_page(page: tuple[Task, Path]) -> None:
    """Write a page about a log. A log that is unreadable by now has no page."""
    task, path = page
    try:
        files = parsed_specifications(task.specs, task.conditions)
        source, options = opened_task(task, files)
        write_report(source, files, path, options)
    except OutputError:
        raise
    except (SpatialReplayError, OSError):
        return
