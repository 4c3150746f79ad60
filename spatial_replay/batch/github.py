"""Results of a batch in a job on GitHub: annotations of lines, and the summary."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from spatial_replay.batch.run_table import (
    MOST_FLAKY,
    MOST_WORST,
    damage_word,
    flaky_results,
    requirement_of,
    result_name,
    summary_text,
    total_cells,
    totals,
    verdict_word,
    worst_rows,
)
from spatial_replay.errors import OutputError
from spatial_replay.logs.remote import is_address
from spatial_replay.report.panels import sentence_parts
from spatial_replay.text import first_lines, plural, printable

if TYPE_CHECKING:
    import pyarrow as pa


_ANNOTATIONS: Final = 10
"""Maximum number of annotations of one severity that GitHub shows per step."""
_MOST_COMPARED: Final = 10_000
"""Maximum number of worst rows that are searched for failures of different kinds."""


def is_github() -> bool:
    """Return whether this process is a step of a GitHub job."""
    return os.environ.get("GITHUB_ACTIONS") == "true"


def annotation(
    severity: Literal["error", "warning"],
    file: str,
    line: int,
    message: str,
    *,
    column: int = 0,
    title: str = "",
) -> str:
    """Return the workflow command that marks a line of a file."""
    location = {"file": file, "line": str(line), "col": str(column) if column else "", "title": title}
    properties = ",".join(f"{name}={_property(value)}" for name, value in location.items() if value)
    return f"::{severity} {properties}::{_data(message)}"


def repository_path(file: str | Path) -> str:
    """Return the path of a file relative to its repository.

    The path starts at the folder of the GitHub job, or at the nearest folder with a `.git` from the current
    folder upwards. Without a `.git`, it starts at the current folder. A file elsewhere keeps its absolute
    path, and an address is unchanged.
    """
    if is_address(file):
        return str(file)
    path, current = Path(file).absolute(), Path.cwd()
    job_folder = os.environ.get("GITHUB_WORKSPACE")
    repository = next(
        (folder for folder in (current, *current.parents) if (folder / ".git").exists()), current
    )
    for base in (Path(job_folder) if job_folder else repository, repository):
        # the unresolved path is tried first, because a link in the repository may lead outside
        for candidate, root in ((Path(os.path.normpath(path)), base), (path.resolve(), base.resolve())):
            if candidate.is_relative_to(root):
                return candidate.relative_to(root).as_posix()
    return path.as_posix()


def worst_annotations(table: pa.Table, folder: Path = Path()) -> Iterator[str]:
    """Yield an annotation for each of the worst failing rows, at the line of its spec.

    The first row of each spec and verdict precedes all second rows.

    Args:
        folder: base of the paths of specifications.
    """
    rows = [row for row in worst_rows(table, _MOST_COMPARED) if row["failure"] is not None]
    kind_counts = Counter[tuple[str, str, str]]()
    kind_ranks = []
    for row in rows:
        kind = (row["file"], row["spec"], verdict_word(row))
        kind_ranks.append(kind_counts[kind])
        kind_counts[kind] += 1
    # the first row of every kind comes before the second row of any kind
    row_indices = sorted(range(len(rows)), key=lambda place: kind_ranks[place])
    for row in (rows[place] for place in row_indices[:_ANNOTATIONS]):
        requirement = requirement_of(row)
        name = f"{row['spec']} ({requirement})" if requirement else row["spec"]
        message = f"{row['log']}: {row['failure'].rstrip('.')}. {row['reason'] or ''}".rstrip()
        file = row["file"] if is_address(row["file"]) else folder / row["file"]
        yield annotation("error", repository_path(file), row["line"], message, title=name)


def write_summary(table: pa.Table) -> None:
    """Add the totals and the worst rows to the summary of the job, if there is one.

    Raises:
        OutputError: the summary cannot be written.
    """
    file = os.environ.get("GITHUB_STEP_SUMMARY")
    if not file:
        return
    try:
        with Path(file).open("a", encoding="utf-8") as stream:
            stream.write(markdown(table))
    except OSError as error:
        raise OutputError(f"{file}: the summary could not be written: {error.strerror}") from error


def markdown(table: pa.Table) -> str:
    """Return the totals and the worst rows as Markdown."""
    number_headings, total_rows = total_cells(totals(table))
    lines = [
        "### spatial-replay\n",
        f"{summary_text(table)}\n",
        f"| case | spec | requirement | {' | '.join(number_headings)} |",
        f"|---|---|---|{'--:|' * len(number_headings)}",
        *map(_line, total_rows),
    ]
    failing = [row for row in worst_rows(table, MOST_WORST) if row["failure"] is not None]
    if failing:
        failure_count = len(table) - table.column("failure").null_count
        lines += [
            "",
            f"{plural(failure_count, 'result')} failed; the worst:",
            "",
            "| log | spec | requirement | verdict | failure | reason |",
            "|---|---|---|---|---|---|",
        ]
        for row in failing:
            name_cells = [row["log"], result_name(row["spec"], row["object"]), requirement_of(row)]
            verdict = f"{verdict_word(row)}{damage_word(row)}"
            lines.append(_line([*name_cells, verdict, row["failure"], row["reason"] or ""]))
    flaky_lines = first_lines([result.text for result in flaky_results(table)], MOST_FLAKY)
    lines += ["", *(f"- {_markdown_cell(line)}" for line in flaky_lines)] if flaky_lines else []
    return "\n".join([*lines, "", ""])


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(_markdown_cell(printable(cell, 500)) for cell in cells)} |"


def _markdown_cell(sentence: str) -> str:
    """Return a sentence for a cell of a Markdown table. Formulas are code, and other text is escaped."""
    pieces = []
    for index, piece in enumerate(sentence_parts(sentence)):
        if index % 2:
            # in code, a backslash escapes only a pipe: https://github.github.com/gfm/#tables-extension-
            fence = "`" * (max(map(len, _BACKQUOTES.findall(piece)), default=0) + 1)
            padding = " " if "`" in piece else ""
            pieces.append(f"{fence}{padding}{piece.replace('|', _PIPE)}{padding}{fence}")
        else:
            pieces.append(_MARKUP.sub(r"\\\g<0>", piece).replace("<", "&lt;"))
    return "".join(pieces)


_BACKQUOTES: Final = re.compile("`+")
_MARKUP: Final = re.compile(r"[\\|\[`*_~]")
_PIPE: Final = "\\|"


def _data(text: str) -> str:
    """Escape the message of a workflow command. A line break would end the command."""
    # the escapes of https://github.com/actions/toolkit, packages/core/src/command.ts
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")
