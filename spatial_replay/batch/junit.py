"""Results of a batch as a JUnit report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from xml.sax.saxutils import escape, quoteattr

from spatial_replay.batch.run_table import (
    EDITED_SINCE,
    WORSE_THAN,
    Values,
    flaky_results,
    requirement_of,
    totals,
)
from spatial_replay.batch.suite import DAMAGED, DOUBTFUL, DROPPED, UNTESTED, VACUOUS
from spatial_replay.logs.output_file import replacing
from spatial_replay.text import cut, plural, printable

if TYPE_CHECKING:
    import pyarrow as pa


LARGEST: Final = 30_000_000
"""Size limit of a report, bytes. GitLab refuses larger reports."""
_SHORT: Final = 300
"""Length of a failure in a shortened report, characters."""


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

    A report above the limit has shorter texts. A report that is still too large has only the number of
    passing test cases in each test suite.

    Args:
        name: name of the suite.
        reports: paths of pages about logs, by case and log.
        inputs: files that the output must not overwrite.
        largest: size limit of the report, bytes.

    Raises:
        UsageError, OutputError: the file cannot be written.
    """
    text = ""
    # a report above the size limit first gets short texts, and then loses its passing test cases
    for text_limit, is_full in ((None, True), (_SHORT, True), (_SHORT, False)):
        text = "".join(_lines(table, name, reports or {}, text_limit, is_full))
        if len(text.encode()) <= largest:
            break
    with replacing(path, inputs) as stream:
        stream.write(text.encode())


def _lines(
    table: pa.Table, name: str, reports: Mapping[tuple[str, str], str], limit: int | None, is_full: bool
) -> Iterator[str]:
    """Yield pieces of the report.

    Args:
        limit: length limit of texts, characters; None for full texts.
        is_full: whether passing test cases are listed.
    """
    rows_by_spec: dict[tuple[str, ...], list[Values]] = {}
    key_columns = ("case", "file", "spec", "line", "requirement", "title", "log", "object", "seconds")
    result_columns = ("verdict", "tested", "untested", "vacuous", "explanation", "faults")
    failure_columns = ("failure", "expected", "error", "error_kind")
    edited_specs = {
        (total.group["case"], total.group["file"], total.group["spec"])
        for total in totals(table)
        if total.is_edited
    }
    flaky_texts: dict[tuple[str, str, str], list[str]] = {}
    for result in flaky_results(table):
        flaky_texts.setdefault((result.case, result.file, result.spec), []).append(result.text)
    for row in table.select([*key_columns, *result_columns, *failure_columns]).to_pylist():
        rows_by_spec.setdefault((row["case"], row["file"], row["spec"]), []).append(row)
    failures, errors = _counts(row for rows in rows_by_spec.values() for row in rows)
    yield '<?xml version="1.0" encoding="utf-8"?>\n'
    yield (
        f'<testsuites name={_quote(name)} tests="{len(table)}" failures="{failures}" errors="{errors}" '
        f'time="{_time(row for rows in rows_by_spec.values() for row in rows)}">\n'
    )
    for (case, file, spec), rows in rows_by_spec.items():
        listed_rows = rows if is_full else [row for row in rows if row["failure"] is not None]
        failures, errors = _counts(rows)
        title = f"{case}.{spec or file}"
        yield (
            f'<testsuite name={_quote(title)} tests="{len(rows)}" failures="{failures}" errors="{errors}" '
            f'skipped="0" file={_quote(file)} time="{_time(rows)}">\n<properties>\n'
        )
        properties = {"specification": f"{file}:{rows[0]['line']}"}
        properties |= {key: rows[0][key] for key in ("requirement", "title") if rows[0][key]}
        kinds = Counter(row["tested"] for row in rows if row["tested"])
        if kinds:
            properties["tested"] = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        if (case, file, spec) in edited_specs:
            properties["baseline"] = EDITED_SINCE
        entries = [
            *properties.items(),
            *(("flaky", line) for line in flaky_texts.get((case, file, spec), ())),
        ]
        for key, value in entries:
            yield f"<property name={_quote(key)} value={_quote(value)}/>\n"
        yield "</properties>\n"
        # the class name has the stem of the file, because two files may have a spec of the same name
        class_name = f"{case}.{Path(file).stem}.{spec}" if spec else f"{case}.{Path(file).stem}"
        for row in listed_rows:
            yield from _case(row, class_name, reports, limit)
        if len(listed_rows) < len(rows):
            left_out_text = plural(len(rows) - len(listed_rows), "test case")
            yield (
                f"<system-out>{left_out_text} that passed left out, to keep this report small</system-out>\n"
            )
        yield "</testsuite>\n"
    yield "</testsuites>\n"


def _case(
    row: Values, class_name: str, reports: Mapping[tuple[str, str], str], text_limit: int | None
) -> Iterator[str]:
    name = row["log"] if row["object"] is None else f"{row['log']}[{row['object']}]"
    yield f'<testcase classname={_quote(class_name)} name={_quote(name)} time="{row["seconds"]:.3f}">\n'
    tested_lines = [f"tested: {row['tested']}"] if row["tested"] in ("cut", "nothing") else []
    if row["failure"] is not None:
        # in JUnit, an error is a fault of the test, and a failure is a fault of its subject
        tag = "failure" if row["error"] is None else "error"
        failure_kind = row["error_kind"] or _unmet(row)
        reason_texts = [*dict.fromkeys([*(row["explanation"] or ()), *row["vacuous"]])] or [row["failure"]]
        text = "\n".join(filter(None, [requirement_of(row), *reason_texts, *tested_lines]))
        text = cut(text, text_limit or len(text))
        message = printable(row["failure"], text_limit or 1_000)
        yield f"<{tag} type={_quote(failure_kind)} message={_quote(message)}>{_text(text)}</{tag}>\n"
        if (row["case"], row["log"]) in reports:
            yield f"<system-out>[[ATTACHMENT|{_text(reports[row['case'], row['log']])}]]</system-out>\n"
    elif row["untested"] and text_limit is None:
        text = _text("\n".join([*tested_lines, *row["untested"]]))
        yield f"<system-out>{text}</system-out>\n"
    yield "</testcase>\n"


def _unmet(row: Values) -> str:
    """Return the kind of a failure; equal kinds have equal words."""
    failure = row["failure"]
    kind_by_beginning = {UNTESTED: "untested"}
    kind_by_beginning |= {kind: kind for kind in (DOUBTFUL, WORSE_THAN, EDITED_SINCE, VACUOUS)}
    kind_by_beginning |= {"cut": "cut", "left": "left", DROPPED: "dropped", DAMAGED: "damaged log"}
    for beginning, kind in kind_by_beginning.items():
        if failure.startswith(beginning):
            return kind
    return "gone" if row["verdict"] is None else f"expected {row['expected']}"


def _counts(rows: Any) -> tuple[int, int]:
    """Return the numbers of failures and of errors."""
    are_failures = [row["error"] is None for row in rows if row["failure"] is not None]
    return sum(are_failures), len(are_failures) - sum(are_failures)


def _time(rows: Any) -> str:
    """Return the total time of rows, seconds. The time of each log counts once."""
    return f"{sum({(row['case'], row['log']): row['seconds'] for row in rows}.values()):.3f}"


def _text(text: str) -> str:
    """Return a text with escapes for XML, and without control characters."""
    return escape("\n".join(printable(line, len(line)) for line in text.split("\n")))


def _quote(text: str) -> str:
    return quoteattr(printable(str(text), 1_000))
