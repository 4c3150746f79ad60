"""What GitHub shows of a run: annotations at lines of files, and the summary of a job."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from spatial_replay.batch.run_table import (
    counts_of,
    damage_word,
    requirement_of,
    result_name,
    summary_text,
    totals,
    verdict_word,
    worst_rows,
)
from spatial_replay.errors import OutputError
from spatial_replay.logs.remote import is_address
from spatial_replay.text import counted, printable

if TYPE_CHECKING:
    import pyarrow as pa

_ANNOTATIONS: Final = 10
"""GitHub shows no more of one kind for a step."""
_WORST: Final = 10
_MOST_COMPARED: Final = 10_000
"""Of the worst rows, so many are looked through for failures of different kinds."""


def is_github(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether this process is a step of a GitHub job."""
    return environment.get("GITHUB_ACTIONS") == "true"


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
    place = {"file": file, "line": str(line), "col": str(column) if column else "", "title": title}
    properties = ",".join(f"{name}={_property(value)}" for name, value in place.items() if value)
    return f"::{severity} {properties}::{_data(message)}"


def repository_path(file: str | Path, environment: Mapping[str, str] = os.environ) -> str:
    """Return the path of a file as the tools of its repository know it: relative to the repository.

    The repository is the folder of the job on GitHub, else the nearest folder above with a `.git`, else the
    current one. A file elsewhere keeps its whole path, and an address stays.
    """
    if is_address(file):
        return str(file)
    path, here = Path(file).absolute(), Path.cwd()
    job = environment.get("GITHUB_WORKSPACE")
    above = next((each for each in (here, *here.parents) if (each / ".git").exists()), here)
    for base in (Path(job) if job else above, above):
        for own, root in ((Path(os.path.normpath(path)), base), (path.resolve(), base.resolve())):
            if own.is_relative_to(root):
                return own.relative_to(root).as_posix()
    return path.as_posix()


def worst_annotations(table: pa.Table, folder: Path = Path()) -> Iterator[str]:
    """Yield an annotation for each of the worst rows that fail, at the line of its spec.

    Rows of one spec and verdict repeat only where there are not enough others.

    Args:
        folder: what the paths of specifications are relative to.
    """
    rows = [row for row in worst_rows(table, _MOST_COMPARED) if row["failure"] is not None]
    kinds = Counter[tuple[str, str, str]]()
    ranks = []
    for row in rows:
        kind = (row["file"], row["spec"], verdict_word(row))
        ranks.append(kinds[kind])
        kinds[kind] += 1
    order = sorted(range(len(rows)), key=lambda place: ranks[place])
    for row in (rows[place] for place in order[:_ANNOTATIONS]):
        about = requirement_of(row)
        name = f"{row['spec']} ({about})" if about else row["spec"]
        message = f"{row['log']}: {row['failure']}. {row['reason']}".rstrip()
        file = row["file"] if is_address(row["file"]) else folder / row["file"]
        yield annotation("error", repository_path(file), row["line"], message, title=name)


def write_summary(table: pa.Table, environment: Mapping[str, str] = os.environ) -> None:
    """Add the totals and the worst rows to the summary of the job, if there is one.

    Raises:
        OutputError: it cannot be written.
    """
    file = environment.get("GITHUB_STEP_SUMMARY")
    if not file:
        return
    try:
        with Path(file).open("a", encoding="utf-8") as stream:
            stream.write(markdown(table))
    except OSError as error:
        raise OutputError(f"{file}: the summary could not be written: {error.strerror}") from error


def markdown(table: pa.Table) -> str:
    """Return the totals and the worst rows as Markdown."""
    rows = totals(table)
    columns = counts_of(rows)
    lines = [
        "### spatial-replay\n",
        f"{summary_text(table)}\n",
        f"| case | spec | requirement | {' | '.join(columns)} | least robustness |",
        f"|---|---|---|{'--:|' * (len(columns) + 1)}",
    ]
    for place, each in enumerate(rows):
        names = [
            each.group["case"],
            each.group["spec"] or each.group["file"],
            each.about,
        ]
        numbers = [f"{own[place]:,}" for own in columns.values()]
        least = "" if each.least is None else f"{each.least:.6g}"
        lines.append(_line([*names, *numbers, least]))
    failing = [row for row in worst_rows(table, _WORST) if row["failure"] is not None]
    if failing:
        count = len(table) - table.column("failure").null_count
        lines += [
            "",
            f"{counted(count, 'result')} failed; the worst:",
            "",
            "| log | spec | requirement | verdict | failure | reason |",
            "|---|---|---|---|---|---|",
        ]
        for row in failing:
            names = [row["log"], result_name(row["spec"], row["object"]), requirement_of(row)]
            verdict = f"{verdict_word(row)}{damage_word(row)}"
            lines.append(_line([*names, verdict, row["failure"], row["reason"]]))
    return "\n".join([*lines, "", ""])


def _line(cells: list[str]) -> str:
    shown = (printable(cell, 500) for cell in cells)
    # no cell ends another one, or becomes markup
    safe = (
        cell.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[")
        for cell in shown
    )
    return f"| {' | '.join(safe)} |"


def _data(text: str) -> str:
    """Escape the message of a workflow command: a line break would begin another one."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")
