"""Reports of a batch: JUnit, annotations of GitHub, and pages."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal
from urllib.parse import quote
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from spatial_replay import __version__
from spatial_replay.batch.curves import Curve, draw_curves, read_curves
from spatial_replay.batch.rows import Task, opened_task, parsed_specifications
from spatial_replay.batch.run import BatchResult, Wanted
from spatial_replay.batch.run_table import (
    BASELINE_ROBUSTNESS,
    EDITED_SINCE,
    WORSE_THAN,
    Total,
    Values,
    counts_of,
    damage_word,
    flaky_results,
    requirement_of,
    result_name,
    robustness_of,
    summary_text,
    totals,
    verdict_word,
    worst_rows,
)
from spatial_replay.batch.suite import DAMAGED, DOUBTFUL, DROPPED, UNTESTED, VACUOUS
from spatial_replay.batch.workers import Progress, Workers, no_progress
from spatial_replay.errors import OutputError, SpatialReplayError, UsageError
from spatial_replay.logs.output_file import output_error, replacing
from spatial_replay.logs.remote import is_address
from spatial_replay.notebook.figures import Html, element
from spatial_replay.report.page import asset, html_page, text
from spatial_replay.report.panels import sentence_parts
from spatial_replay.report.write import write_report
from spatial_replay.text import counted, cut, first_lines, printable, with_unit

if TYPE_CHECKING:
    import pyarrow as pa

    from spatial_replay.batch.run_table import Values
    from spatial_replay.geometry.arrays import Floats


LABEL: Final = "label"
AGREEMENT: Final = "agreement"
"""Columns of judged episodes: "success" or "failure", and how that compares with the verdict."""
_ANNOTATIONS: Final = 10
"""GitHub shows no more of one kind for a step."""
_WORST: Final = 10
_MOST_FLAKY: Final = 20
_MOST_COMPARED: Final = 10_000
"""Number of worst rows that are searched for failures of different kinds."""


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
    path, current = Path(file).absolute(), Path.cwd()
    job = environment.get("GITHUB_WORKSPACE")
    above = next((folder for folder in (current, *current.parents) if (folder / ".git").exists()), current)
    for base in (Path(job) if job else above, above):
        for candidate, root in ((Path(os.path.normpath(path)), base), (path.resolve(), base.resolve())):
            if candidate.is_relative_to(root):
                return candidate.relative_to(root).as_posix()
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
        message = f"{row['log']}: {row['failure'].rstrip('.')}. {row['reason'] or ''}".rstrip()
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
    numbers, rows = _cells(totals(table))
    lines = [
        "### spatial-replay\n",
        f"{summary_text(table)}\n",
        f"| case | spec | requirement | {' | '.join(numbers)} |",
        f"|---|---|---|{'--:|' * len(numbers)}",
        *map(_line, rows),
    ]
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
            lines.append(_line([*names, verdict, row["failure"], row["reason"] or ""]))
    flaky = first_lines([result.text for result in flaky_results(table)], _MOST_FLAKY)
    lines += ["", *(f"- {_markdown_cell(line)}" for line in flaky)] if flaky else []
    return "\n".join([*lines, "", ""])


def _cells(rows: Sequence[Total]) -> tuple[list[str], list[list[str]]]:
    """Return a table of totals: the headings of its numbers, and rows of three names and then these."""
    columns = counts_of(rows)
    cells = []
    for place, total in enumerate(rows):
        spec = total.group["spec"] or total.group["file"]
        names = [total.group["case"], f"{spec} ({EDITED_SINCE})" if total.is_edited else spec, total.about]
        counts = [f"{numbers[place]:,}" for numbers in columns.values()]
        cells.append([*names, *counts, "" if total.least is None else f"{total.least:.6g}"])
    return [*columns, "least robustness"], cells


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(_markdown_cell(printable(cell, 500)) for cell in cells)} |"


def _markdown_cell(sentence: str) -> str:
    """Return a sentence, its formulas as code, that neither ends its cell nor becomes markup."""
    pieces = []
    for number, piece in enumerate(sentence_parts(sentence)):
        if number % 2:
            # within code, a backslash escapes nothing but the end of a cell
            fence = "`" * (max(map(len, _BACKQUOTES.findall(piece)), default=0) + 1)
            pad = " " if "`" in piece else ""
            pieces.append(f"{fence}{pad}{piece.replace('|', _PIPE)}{pad}{fence}")
        else:
            pieces.append(_MARKUP.sub(r"\\\g<0>", piece).replace("<", "&lt;"))
    return "".join(pieces)


_BACKQUOTES: Final = re.compile("`+")
_MARKUP: Final = re.compile(r"[\\|\[`*_~]")
_PIPE: Final = "\\|"


def _data(text: str) -> str:
    """Escape the message of a workflow command: a line break would begin another one."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")


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
    keys = ("case", "file", "spec", "line", "requirement", "title", "log", "object", "seconds")
    results = ("verdict", "tested", "untested", "vacuous", "explanation", "faults")
    faults = ("failure", "expected", "error", "error_kind")
    edited = {
        (total.group["case"], total.group["file"], total.group["spec"])
        for total in totals(table)
        if total.is_edited
    }
    flaky: dict[tuple[str, str, str], list[str]] = {}
    for result in flaky_results(table):
        flaky.setdefault((result.case, result.file, result.spec), []).append(result.text)
    for row in table.select([*keys, *results, *faults]).to_pylist():
        suites.setdefault((row["case"], row["file"], row["spec"]), []).append(row)
    failures, errors = _counts(row for rows in suites.values() for row in rows)
    yield '<?xml version="1.0" encoding="utf-8"?>\n'
    yield (
        f'<testsuites name={_quoted(name)} tests="{len(table)}" failures="{failures}" errors="{errors}" '
        f'time="{_time(row for rows in suites.values() for row in rows)}">\n'
    )
    for (case, file, spec), rows in suites.items():
        written = rows if keeps else [row for row in rows if row["failure"] is not None]
        failures, errors = _counts(rows)
        title = f"{case}.{spec or file}"
        yield (
            f'<testsuite name={_quoted(title)} tests="{len(rows)}" failures="{failures}" errors="{errors}" '
            f'skipped="0" file={_quoted(file)} time="{_time(rows)}">\n<properties>\n'
        )
        properties = {"specification": f"{file}:{rows[0]['line']}"}
        properties |= {key: rows[0][key] for key in ("requirement", "title") if rows[0][key]}
        tested = Counter(row["tested"] for row in rows if row["tested"])
        if tested:
            properties["tested"] = ", ".join(f"{count} {kind}" for kind, count in sorted(tested.items()))
        if (case, file, spec) in edited:
            properties["baseline"] = EDITED_SINCE
        pairs = [*properties.items(), *(("flaky", line) for line in flaky.get((case, file, spec), ()))]
        for key, value in pairs:
            yield f"<property name={_quoted(key)} value={_quoted(value)}/>\n"
        yield "</properties>\n"
        # two files may have a spec of one name
        class_name = f"{case}.{Path(file).stem}.{spec}" if spec else f"{case}.{Path(file).stem}"
        for row in written:
            yield from _case(row, class_name, reports, limit)
        if len(written) < len(rows):
            left_out = counted(len(rows) - len(written), "test case")
            yield f"<system-out>{left_out} that passed left out, to keep this report small</system-out>\n"
        yield "</testsuite>\n"
    yield "</testsuites>\n"


def _case(
    row: Values, class_name: str, reports: Mapping[tuple[str, str], str], limit: int | None
) -> Iterator[str]:
    name = row["log"] if row["object"] is None else f"{row['log']}[{row['object']}]"
    yield f'<testcase classname={_quoted(class_name)} name={_quoted(name)} time="{row["seconds"]:.3f}">\n'
    tested = [f"tested: {row['tested']}"] if row["tested"] in ("cut", "nothing") else []
    if row["failure"] is not None:
        # errors are about the test, failures about what it tests
        tag = "failure" if row["error"] is None else "error"
        kind = row["error_kind"] or _unmet(row)
        texts = [*dict.fromkeys([*(row["explanation"] or ()), *row["vacuous"]])] or [row["failure"]]
        text = "\n".join(filter(None, [requirement_of(row), *texts, *tested]))
        text = cut(text, limit or len(text))
        message = printable(row["failure"], limit or 1_000)
        yield f"<{tag} type={_quoted(kind)} message={_quoted(message)}>{_text(text)}</{tag}>\n"
        if (row["case"], row["log"]) in reports:
            yield f"<system-out>[[ATTACHMENT|{_text(reports[row['case'], row['log']])}]]</system-out>\n"
    elif row["untested"] and limit is None:
        text = _text("\n".join([*tested, *row["untested"]]))
        yield f"<system-out>{text}</system-out>\n"
    yield "</testcase>\n"


def _unmet(row: Values) -> str:
    """Return the expectation that a result did not meet, in words that results of one kind share."""
    failure = row["failure"]
    kinds = {UNTESTED: "untested"}
    kinds |= {kind: kind for kind in (DOUBTFUL, WORSE_THAN, EDITED_SINCE, VACUOUS)}
    kinds |= {"cut": "cut", "left": "left", DROPPED: "dropped", DAMAGED: "damaged log"}
    for beginning, kind in kinds.items():
        if failure.startswith(beginning):
            return kind
    return "gone" if row["verdict"] is None else f"expected {row['expected']}"


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


_MOST_LOGS: Final = 2_000
"""Rows of the matrix; a page with more is slow to open."""
_MOST_SPECS: Final = 60
"""Columns of the matrix, and distributions."""
_BINS: Final = 24
_WIDTH: Final = 480.0
_HEIGHT: Final = 60.0
_STYLES: Final = ("browser/page.css", "batch:overview.css")


def overview_page(
    table: pa.Table,
    name: str,
    reports: Mapping[tuple[str, str], str],
    curves: Mapping[str, Sequence[Curve]] = MappingProxyType({}),
) -> bytes:
    """Return the page, in UTF-8; equal tables give equal bytes.

    Args:
        table: of a run.
        name: of the suite.
        reports: for cases and logs by name, the address of the page about them, relative to this one.
        curves: by case, those of the logs with a page.
    """
    body = [_header(table, name), element("main", *_panels(table, reports, curves))]
    scripts = [asset("batch:overview.js")]
    return html_page(f"{name}: {_headline(table)}", body, scripts, _STYLES, marks=" data-read")


def _headline(table: pa.Table) -> str:
    failures = len(table) - table.column("failure").null_count
    return f"{failures:,} of {counted(len(table), 'result')} failed" if failures else "everything passed"


def _header(table: pa.Table, name: str) -> Html:
    failed = table.column("failure").null_count < len(table)
    chip = element("span", _headline(table), **{"class": f"chip is-{'violated' if failed else 'satisfied'}"})
    logs = len(set(table.column("log").to_pylist()))
    about = " · ".join([counted(logs, "log"), summary_text(table), f"spatial-replay {__version__}"])
    title = element("div", element("h1", text(name)), chip, **{"class": "title"})
    return element("header", title, element("p", text(about), **{"class": "about"}), **{"class": "top"})


def _panels(
    table: pa.Table, reports: Mapping[tuple[str, str], str], curves: Mapping[str, Sequence[Curve]]
) -> Iterator[Html]:
    by_spec = totals(table)
    yield _panel("Specifications", _totals(by_spec))
    worst = [row for row in worst_rows(table, _WORST) if row["failure"] is not None]
    if worst:
        yield _panel("The worst", _worst(worst, reports))
    flaky = first_lines([result.text for result in flaky_results(table)], _MOST_FLAKY)
    if flaky:
        yield _panel("Flaky", element("ul", *(element("li", text(line)) for line in flaky)))
    plots = _plots(table, by_spec[:_MOST_SPECS], curves)
    yield _panel("Robustness", element("div", *plots, **{"class": "plots"}))
    yield _panel("Logs", *_matrix(table, by_spec[:_MOST_SPECS], reports))


def _panel(title: str, *content: Html) -> Html:
    # what may be wider than the page can be scrolled with keys
    attributes = {"class": "panel", "aria-label": title, "tabindex": "0"}
    return element("section", element("h2", title), *content, **attributes)


def _totals(by_spec: Sequence[Total]) -> Html:
    names = ("case", "spec", "requirement")
    numbers, cells = _cells(by_spec)
    head = [*(element("th", name) for name in names), *(_number("th", name) for name in numbers)]
    rows = [
        element(
            "tr",
            *(element("td", text(cell)) for cell in row[: len(names)]),
            *(_number("td", cell) for cell in row[len(names) :]),
        )
        for row in cells
    ]
    return element("table", element("thead", element("tr", *head)), element("tbody", *rows))


def _worst(rows: Sequence[Values], reports: Mapping[tuple[str, str], str]) -> Html:
    names = [element("th", name) for name in ("log", "spec")]
    texts = [element("th", name) for name in ("failure", "reason")]
    head = element("tr", *names, _number("th", "robustness"), *texts)
    body = [
        element(
            "tr",
            element("td", _linked((row["case"], row["log"]), reports), **{"class": "log"}),
            element("td", *_named(row)),
            _number("td", robustness_of(row)),
            element("td", text(row["failure"])),
            element("td", *_with_code(row["reason"] or "")),
        )
        for row in rows
    ]
    return element("table", element("thead", head), element("tbody", *body))


def _named(row: Values) -> Iterator[Html]:
    """Yield the name of a result, and below it the requirement that it is about."""
    yield text(result_name(row["spec"] or row["file"], row["object"]))
    if about := requirement_of(row):
        yield element("div", text(about), **{"class": "requirement"})


def _with_code(sentence: str) -> Iterator[Html]:
    """Yield a sentence, its formulas as code."""
    for number, piece in enumerate(sentence_parts(sentence)):
        yield element("code", text(piece)) if number % 2 else text(piece)


def _plots(
    table: pa.Table, by_spec: Sequence[Total], curves: Mapping[str, Sequence[Curve]]
) -> Iterator[Html]:
    import pyarrow.compute as pc

    has_cases = len({total.group["case"] for total in by_spec}) > 1
    for total in by_spec:
        group = total.group
        fits = pc.and_(
            pc.and_(pc.equal(table["case"], group["case"]), pc.equal(table["file"], group["file"])),
            pc.equal(table["spec"], group["spec"]),
        )
        rows = table.filter(fits)
        numbers = np.asarray(rows.column("robustness").to_numpy(), np.float64)
        finite = numbers[np.isfinite(numbers)]
        unit = next(filter(None, rows.column("unit").to_pylist()), "")
        if len(finite):
            case = group["case"] if has_cases else None
            title = " · ".join(filter(None, (case, total.requirement, group["spec"])))
            caption = element("figcaption", text(title), **_tip(total.about))
            of_spec = [curve for curve in curves.get(group["case"], ()) if group["spec"] in ("", curve.spec)]
            yield element("figure", caption, _histogram(finite, unit), draw_curves(of_spec, unit))


def _histogram(numbers: Floats, unit: str) -> Html:
    """Return a distribution as a drawing; a bin lies on one side of 0, where the verdict changes."""
    low, high = min(float(numbers.min()), 0.0), max(float(numbers.max()), 0.0)
    if low == high:
        high = low + 1.0
    width = (high - low) / _BINS
    below = math.ceil(-low / width) if low < 0.0 else 0
    edges = (np.arange(_BINS + 2) - below) * width
    counts, _ = np.histogram(numbers, edges)
    tallest, step = max(1, int(counts.max())), _WIDTH / len(counts)
    bars = []
    for number, count in enumerate(counts.tolist()):
        height = _HEIGHT * count / tallest
        side = "bad" if number < below else "good"
        place = {"x": number * step + 0.5, "y": _HEIGHT - height, "width": step - 1.0, "height": height}
        # what is read is the text beside the drawing, so the tip of a bar says its count
        tip = element("title", f"{count:,} from {edges[number]:.4g} to {edges[number + 1]:.4g}")
        attributes = {name: f"{value:.2f}" for name, value in place.items()}
        bars.append(element("rect", tip, **attributes, **{"class": side}))
    zero = f"{below * step:.2f}"
    axis = element("line", x1=zero, x2=zero, y1="0", y2=f"{_HEIGHT + 3:.0f}")
    labels = [
        element("text", with_unit(low, unit), x="0", y=f"{_HEIGHT + 12:.0f}"),
        element(
            "text",
            with_unit(high, unit),
            x=f"{_WIDTH:.0f}",
            y=f"{_HEIGHT + 12:.0f}",
            **{"text-anchor": "end"},
        ),
    ]
    name = f"Distribution of robustness from {low:.4g} to {high:.4g}"
    view = f"0 0 {_WIDTH:.0f} {_HEIGHT + 16:.0f}"
    return element("svg", *bars, axis, *labels, viewBox=view, role="img", **{"aria-label": name})


def _matrix(
    table: pa.Table, by_spec: Sequence[Total], reports: Mapping[tuple[str, str], str]
) -> Iterator[Html]:
    """Yield a row for each log, the worst first, and a column for each spec."""
    columns = [(total.group["case"], total.group["file"], total.group["spec"]) for total in by_spec]
    cells: dict[str, dict[tuple[str, str, str], Values]] = {}
    rows = worst_rows(table, len(table))
    is_judged = LABEL in table.column_names
    if is_judged:
        rows.sort(key=_agrees)
    for row in rows:
        column = (row["case"], row["file"], row["spec"])
        log = cells.get(row["log"])
        if log is None:
            if len(cells) >= _MOST_LOGS:
                continue
            log = cells[row["log"]] = {}
        # of a template, the worst object
        log.setdefault(column, row)
    logs = len(set(table.column("log").to_pylist()))
    if logs > len(cells):
        words = f"The {len(cells):,} worst of {counted(logs, 'log')}; the table of the run has them all."
        yield element("p", words)
    cases = {case for case, _, _ in columns}
    yield _filter()
    titles = [f"{case} · {spec or file}" if len(cases) > 1 else spec or file for case, file, spec in columns]
    abouts = [total.about for total in by_spec]
    label = [_sortable(LABEL, "")] if is_judged else []
    head = [_sortable("log", ""), *label, *map(_sortable, titles, ["number"] * len(titles), abouts)]
    body = []
    for name, of_log in cells.items():
        row_cells = [_cell(of_log.get(column)) for column in columns]
        report = next(((case, name) for case, _, _ in columns if (case, name) in reports), ("", name))
        if is_judged:
            row_cells.insert(0, _label_cell(next(iter(of_log.values()))))
        body.append(element("tr", element("td", _linked(report, reports)), *row_cells))
    yield element("table", element("thead", element("tr", *head)), element("tbody", *body), id="matrix")


def _filter() -> Html:
    """Return what the rows of the matrix can be filtered by, and buttons that go through those that fail."""
    words = element("input", type="search", placeholder="name", **{"aria-label": "Name of a log"})
    box = element("label", element("input", type="checkbox", id="only-failing"), " only failing")
    steps = [
        element("button", f"{word} failing", type="button", **{"class": "step", "data-step": step})
        for word, step in (("Previous", "-1"), ("Next", "1"))
    ]
    left = element("span", "", id="left", role="status")
    return element("p", "Marked results fail. ", words, box, *steps, left, id="filter")


def _agrees(row: Values) -> bool:
    """Return whether the label of a row agrees with the verdict, or is not compared with it."""
    return row[AGREEMENT] not in ("only_theirs", "only_ours")


def _label_cell(row: Values) -> Html:
    if row[LABEL] is None:
        return element("td", "")
    kind = "is-satisfied" if row[LABEL] == "success" else "is-violated"
    words = row[LABEL] if _agrees(row) else f"{row[LABEL]}, {row[AGREEMENT].replace('_', ' ')}"
    return element("td", words, **{"class": kind if _agrees(row) else f"{kind} fails"})


def _cell(row: Values | None) -> Html:
    if row is None:
        return element("td", "", **{"class": "number", "data-value": "1e400"})
    number, verdict, fails = row["robustness"], verdict_word(row), row["failure"] is not None
    kind = f"number is-{verdict}{' fails' if fails else ''}"
    was = row.get(BASELINE_ROBUSTNESS)
    before = f" (was {was:.4g})" if fails and was is not None and was != number else ""
    if row["verdict"] is None:
        return element(
            "td", f"{verdict}{before}", title=row["failure"] or "", **{"class": kind, "data-value": "-1e400"}
        )
    words = verdict if number is None or verdict in ("untested", "doubtful") else f"{number:.4g}"
    value = "0" if number is None else f"{max(-1e300, min(1e300, number)):.17g}"
    why = f": {row['failure'].rstrip('.')}" if fails else ""
    tip = f"{result_name(row['spec'], row['object'])} is {verdict}{damage_word(row)}{why}."
    tip = " ".join(
        [
            tip,
            *filter(None, [row["reason"]]),
            *(sentence for sentence in row["untested"] or () if sentence.rstrip(".") not in why),
        ]
    )
    words = f"{words}{damage_word(row)}{before}"
    return element("td", words, title=tip, **{"class": kind, "data-value": value})


def _sortable(title: str, kind: str, about: str = "") -> Html:
    button = element("button", text(title), type="button", **_tip(about))
    return element("th", button, scope="col", **{"class": kind})


def _tip(about: str) -> dict[str, str]:
    """Return the attribute with which a name shows the requirement that it is about."""
    return {"title": about} if about else {}


def _number(tag: str, words: str) -> Html:
    return element(tag, words, **{"class": "number"})


def _linked(log: tuple[str, str], reports: Mapping[tuple[str, str], str]) -> Html:
    """Return the name of a log, given with its case, linked to the page about it."""
    return element("a", text(log[1]), href=quote(reports[log])) if log in reports else text(log[1])


INDEX: Final = "index.html"
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
    pages = {key: folder / _FOLDER / _file_name(key[1], wanted) for key, wanted in failing.items()}
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
    for wanted in result.wanted:
        if (wanted.case.name, wanted.log.name) in wanted_by_log:
            wanted_by_log[wanted.case.name, wanted.log.name].append(wanted)
    # a result that is gone may have no log any more
    return {key: wanted for key, wanted in wanted_by_log.items() if wanted}


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
