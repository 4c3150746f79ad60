"""The table of a run as JUnit XML, in the dialect xunit2 of pytest and Jenkins.

A test suite for each case and spec, whose property `requirement` names what it is about; a test case for each
log, and for each object of a template. Names are unique, since GitLab drops what has the same name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from xml.sax.saxutils import escape, quoteattr

from spatial_replay.batch.run_table import damage_word, requirement_of, verdict_word
from spatial_replay.logs.output_file import replacing
from spatial_replay.text import counted, printable

if TYPE_CHECKING:
    import pyarrow as pa

    from spatial_replay.batch.run_table import Values

LARGEST: Final = 30_000_000
"""Bytes: GitLab refuses larger reports."""
_SHORT: Final = 300
"""Characters of a failure where the full texts would be too long."""


def write_junit(
    path: Path,
    table: pa.Table,
    name: str,
    reports: Mapping[tuple[str, str], str] | None = None,
    *,
    inputs: Sequence[Path] = (),
    largest: int = LARGEST,
) -> None:
    """Write the table of a run as a JUnit report.

    A report that would be too large has shorter texts and, if that is not enough, lacks test cases that pass;
    each test suite says how many.

    Args:
        name: of the whole: that of the suite.
        reports: for cases and logs by name, the path of a page about them.
        inputs: files that the output must not be.
        largest: bytes of the report, at most.

    Raises:
        UsageError, OutputError: the file cannot be written.
    """
    text = ""
    for limit, keeps in ((None, True), (_SHORT, True), (_SHORT, False)):
        text = "".join(_lines(table, name, reports or {}, limit, keeps))
        if len(text.encode()) <= largest:
            break
    with replacing(path, inputs) as stream:
        stream.write(text.encode())


def _lines(
    table: pa.Table, name: str, reports: Mapping[tuple[str, str], str], limit: int | None, keeps: bool
) -> Iterator[str]:
    suites: dict[tuple[str, ...], list[Values]] = {}
    wanted = ("case", "file", "spec", "requirement", "title", "log", "object", "failure", "error")
    texts = ("explanation", "vacuous", "seconds", "error_kind", "verdict", "line", "faults", "untested")
    for row in table.select([*wanted, *texts]).to_pylist():
        suites.setdefault((row["case"], row["file"], row["spec"]), []).append(row)
    failures, errors = _counts(row for rows in suites.values() for row in rows)
    yield '<?xml version="1.0" encoding="utf-8"?>\n'
    yield (
        f'<testsuites name={_quoted(name)} tests="{len(table)}" failures="{failures}" errors="{errors}" '
        f'time="{_time(row for rows in suites.values() for row in rows)}">\n'
    )
    for (case, file, spec), rows in suites.items():
        shown = rows if keeps else [row for row in rows if row["failure"] is not None]
        failures, errors = _counts(rows)
        title = f"{case}.{spec or file}"
        yield (
            f'<testsuite name={_quoted(title)} tests="{len(rows)}" failures="{failures}" errors="{errors}" '
            f'skipped="0" file={_quoted(file)} time="{_time(rows)}">\n<properties>\n'
        )
        properties = {"specification": f"{file}:{rows[0]['line']}"}
        properties |= {key: rows[0][key] for key in ("requirement", "title") if rows[0][key]}
        for key, value in properties.items():
            yield f"<property name={_quoted(key)} value={_quoted(value)}/>\n"
        yield "</properties>\n"
        # two files may have a spec of one name
        class_name = f"{case}.{Path(file).stem}.{spec}" if spec else f"{case}.{Path(file).stem}"
        for row in shown:
            yield from _case(row, class_name, reports, limit)
        if len(shown) < len(rows):
            left_out = counted(len(rows) - len(shown), "test case")
            yield f"<system-out>{left_out} that passed left out, to keep this report small</system-out>\n"
        yield "</testsuite>\n"
    yield "</testsuites>\n"


def _case(
    row: Values, class_name: str, reports: Mapping[tuple[str, str], str], limit: int | None
) -> Iterator[str]:
    name = row["log"] if row["object"] is None else f"{row['log']}[{row['object']}]"
    yield f'<testcase classname={_quoted(class_name)} name={_quoted(name)} time="{row["seconds"]:.3f}">\n'
    if row["failure"] is not None:
        # errors are about the test, failures about what it tests
        tag = "failure" if row["error"] is None else "error"
        kind = row["error_kind"] or f"{verdict_word(row)}{damage_word(row)}"
        texts = [*row["explanation"], *row["vacuous"]] or [row["failure"]]
        text = "\n".join(filter(None, [requirement_of(row), *texts]))
        text = text if limit is None or len(text) <= limit else text[: limit - 1] + "…"
        message = printable(row["failure"], limit or 1_000)
        yield f"<{tag} type={_quoted(kind)} message={_quoted(message)}>{_text(text)}</{tag}>\n"
        if (row["case"], row["log"]) in reports:
            yield f"<system-out>[[ATTACHMENT|{_text(reports[row['case'], row['log']])}]]</system-out>\n"
    elif row["untested"] and limit is None:
        own = _text("\n".join(row["untested"]))
        yield f"<system-out>{own}</system-out>\n"
    yield "</testcase>\n"


def _counts(rows: Any) -> tuple[int, int]:
    """Return how many rows fail, and how many have errors."""
    kinds = [row["error"] is None for row in rows if row["failure"] is not None]
    return sum(kinds), len(kinds) - sum(kinds)


def _time(rows: Any) -> str:
    """Return the seconds that rows took; those of one log took them together."""
    return f"{sum({(row['case'], row['log']): row['seconds'] for row in rows}.values()):.3f}"


def _text(text: str) -> str:
    """Return a text that XML can hold."""
    return escape("\n".join(printable(line, len(line)) for line in text.split("\n")))


def _quoted(text: str) -> str:
    return quoteattr(printable(str(text), 1_000))
