"""The page over all logs of a batch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from operator import add
from types import MappingProxyType
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

import numpy as np

from spatial_replay.batch.curves import Curve, draw_curves
from spatial_replay.batch.run_table import (
    BASELINE_ROBUSTNESS,
    MOST_FLAKY,
    MOST_WORST,
    Total,
    Values,
    damage_word,
    flaky_results,
    requirement_of,
    result_name,
    robustness_of,
    summary_text,
    total_cells,
    totals,
    verdict_word,
    worst_rows,
)
from spatial_replay.html import Html, element
from spatial_replay.report.page import asset, html_page, text
from spatial_replay.report.panels import sentence_parts, with_signs
from spatial_replay.text import first_lines, plural, with_unit
from spatial_replay.version import __version__

if TYPE_CHECKING:
    import pyarrow as pa

    from spatial_replay.geometry.arrays import Floats


LABEL: Final = "label"
AGREEMENT: Final = "agreement"
"""Columns of judged episodes: the label, "success" or "failure", and its agreement with the verdict."""
_MOST_LOGS: Final = 2_000
"""Rows of the matrix; a page with more is slow to open."""
_MOST_SPECS: Final = 60
"""Largest number of columns of the matrix, and of distributions."""
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
        table: table of a run.
        name: name of the suite.
        reports: addresses of pages about logs, by case and log, relative to this page.
        curves: curves of the logs with a page, by case.
    """
    body = [_header(table, name), element("main", *_panels(table, reports, curves))]
    scripts = [asset("batch:overview.js")]
    return html_page(f"{name}: {_headline(table)}", body, scripts, _STYLES, marks=" data-read")


def _headline(table: pa.Table) -> str:
    failures = len(table) - table.column("failure").null_count
    return f"{failures:,} of {plural(len(table), 'result')} failed" if failures else "everything passed"


def _header(table: pa.Table, name: str) -> Html:
    failed = table.column("failure").null_count < len(table)
    chip = element("span", _headline(table), **{"class": f"chip is-{'violated' if failed else 'satisfied'}"})
    logs = len(set(table.column("log").to_pylist()))
    about = " · ".join([plural(logs, "log"), summary_text(table), f"spatial-replay {__version__}"])
    title = element("div", element("h1", text(name)), chip, **{"class": "title"})
    return element("header", title, element("p", text(about), **{"class": "about"}), **{"class": "top"})


def _panels(
    table: pa.Table, reports: Mapping[tuple[str, str], str], curves: Mapping[str, Sequence[Curve]]
) -> Iterator[Html]:
    by_spec = totals(table)
    yield _panel("Specifications", _totals(by_spec))
    worst = [row for row in worst_rows(table, MOST_WORST) if row["failure"] is not None]
    if worst:
        yield _panel("The worst", _worst(worst, reports))
    flaky = first_lines([result.text for result in flaky_results(table)], MOST_FLAKY)
    if flaky:
        yield _panel("Flaky", element("ul", *(element("li", text(line)) for line in flaky)))
    plots = _plots(table, by_spec[:_MOST_SPECS], curves)
    yield _panel("Robustness", element("div", *plots, **{"class": "plots"}))
    yield _panel("Logs", *_matrix(table, by_spec[:_MOST_SPECS], reports))


def _panel(title: str, *content: Html) -> Html:
    # focusable, so that keys can scroll a panel that is wider than the page (WCAG 2.1.1)
    attributes = {"class": "panel", "aria-label": title, "tabindex": "0"}
    return element("section", element("h2", title), *content, **attributes)


def _totals(by_spec: Sequence[Total]) -> Html:
    names = ("case", "spec", "requirement")
    numbers, cells = total_cells(by_spec)
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
            element("td", _log_link((row["case"], row["log"]), reports), **{"class": "log"}),
            element("td", *_result_cell(row)),
            _number("td", robustness_of(row)),
            element("td", text(row["failure"])),
            element("td", *_with_code(row["reason"] or "")),
        )
        for row in rows
    ]
    return element("table", element("thead", head), element("tbody", *body))


def _result_cell(row: Values) -> Iterator[Html]:
    """Yield the name of a result, and below it the requirement."""
    yield text(result_name(row["spec"] or row["file"], row["object"]))
    if about := requirement_of(row):
        yield element("div", text(about), **{"class": "requirement"})


def _with_code(sentence: str) -> Iterator[Html]:
    """Yield a sentence with its formulas as code."""
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
    """Return a histogram as SVG. An edge of its bins is 0, where the verdict changes."""
    low, high = min(float(numbers.min()), 0.0), max(float(numbers.max()), 0.0)
    if low == high:
        high = low + 1.0
    width = (high - low) / _BINS
    below = math.ceil(-low / width) if low < 0.0 else 0
    # one bin more than `_BINS`, because 0 is an edge
    edges = (np.arange(_BINS + 2) - below) * width
    counts, _ = np.histogram(numbers, edges)
    tallest, step = max(1, int(counts.max())), _WIDTH / len(counts)
    bars = []
    for number, count in enumerate(counts.tolist()):
        height = _HEIGHT * count / tallest
        side = "bad" if number < below else "good"
        place = {"x": number * step + 0.5, "y": _HEIGHT - height, "width": step - 1.0, "height": height}
        # only the tooltip of a bar gives its count: bars have no text
        tip = element("title", with_signs(f"{count:,} from {edges[number]:.4g} to {edges[number + 1]:.4g}"))
        attributes = {name: f"{value:.2f}" for name, value in place.items()}
        bars.append(element("rect", tip, **attributes, **{"class": side}))
    zero = f"{below * step:.2f}"
    axis = element("line", x1=zero, x2=zero, y1="0", y2=f"{_HEIGHT + 3:.0f}")
    labels = [
        element("text", with_signs(with_unit(low, unit)), x="0", y=f"{_HEIGHT + 12:.0f}"),
        element(
            "text",
            with_unit(high, unit),
            x=f"{_WIDTH:.0f}",
            y=f"{_HEIGHT + 12:.0f}",
            **{"text-anchor": "end"},
        ),
    ]
    name = with_signs(f"Distribution of robustness from {low:.4g} to {high:.4g}")
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
        # rows are sorted, so the first one of a template is the worst object
        log.setdefault(column, row)
    logs = len(set(table.column("log").to_pylist()))
    if logs > len(cells):
        words = f"The {len(cells):,} worst of {plural(logs, 'log')}; the table of the run has them all."
        yield element("p", words)
    cases = {case for case, _, _ in columns}
    yield _filter()
    titles = [f"{case} · {spec or file}" if len(cases) > 1 else spec or file for case, file, spec in columns]
    units = [f" [{total.unit}]" if total.unit not in (None, "", "1") else "" for total in by_spec]
    abouts = [total.about for total in by_spec]
    label = [_sortable(LABEL, "")] if is_judged else []
    head = [
        _sortable("log", ""),
        *label,
        *map(_sortable, map(add, titles, units), ["number"] * len(titles), abouts),
    ]
    body = []
    for name, of_log in cells.items():
        row_cells = [_cell(of_log.get(column)) for column in columns]
        report = next(((case, name) for case, _, _ in columns if (case, name) in reports), ("", name))
        if is_judged:
            row_cells.insert(0, _label_cell(next(iter(of_log.values()))))
        body.append(element("tr", element("td", _log_link(report, reports)), *row_cells))
    yield element("table", element("thead", element("tr", *head)), element("tbody", *body), id="matrix")


def _filter() -> Html:
    """Return the filters of the matrix, and buttons that step through failing rows."""
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
        # JavaScript reads 1e400 as infinity, which sorts last
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
    # finite, so that errors and empty cells sort outside
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
    return element("td", with_signs(words), title=with_signs(tip), **{"class": kind, "data-value": value})


def _sortable(title: str, kind: str, about: str = "") -> Html:
    button = element("button", text(title), type="button", **_tip(about))
    return element("th", button, scope="col", **{"class": kind})


def _tip(about: str) -> dict[str, str]:
    """Return the attribute of a tooltip with the requirement; nothing for an empty text."""
    return {"title": about} if about else {}


def _number(tag: str, words: str) -> Html:
    return element(tag, with_signs(words), **{"class": "number"})


def _log_link(log: tuple[str, str], reports: Mapping[tuple[str, str], str]) -> Html:
    """Return the name of a log, given as (case, log), linked to its page if there is one."""
    return element("a", text(log[1]), href=quote(reports[log])) if log in reports else text(log[1])


INDEX: Final = "index.html"
