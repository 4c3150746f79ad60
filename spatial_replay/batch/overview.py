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
"""Column with the labels of judged episodes: "success" or "failure"."""
AGREEMENT: Final = "agreement"
"""Column with the agreement of each label with the verdict."""
_MOST_LOGS: Final = 2_000
"""Maximum number of rows of the matrix. Larger pages open slowly."""
_MOST_SPECS: Final = 60
"""Maximum number of the matrix's columns, and of histograms."""
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
    """Return the page in UTF-8. Equal tables give equal bytes.

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
    has_failed = table.column("failure").null_count < len(table)
    chip = element(
        "span", _headline(table), **{"class": f"chip is-{'violated' if has_failed else 'satisfied'}"}
    )
    log_count = len(set(table.column("log").to_pylist()))
    summary = " · ".join([plural(log_count, "log"), summary_text(table), f"spatial-replay {__version__}"])
    title = element("div", element("h1", text(name)), chip, **{"class": "title"})
    return element("header", title, element("p", text(summary), **{"class": "about"}), **{"class": "top"})


def _panels(
    table: pa.Table, reports: Mapping[tuple[str, str], str], curves: Mapping[str, Sequence[Curve]]
) -> Iterator[Html]:
    spec_totals = totals(table)
    yield _panel("Specifications", _totals(spec_totals))
    failing_rows = [row for row in worst_rows(table, MOST_WORST) if row["failure"] is not None]
    if failing_rows:
        yield _panel("The worst", _worst(failing_rows, reports))
    flaky_lines = first_lines([result.text for result in flaky_results(table)], MOST_FLAKY)
    if flaky_lines:
        yield _panel("Flaky", element("ul", *(element("li", text(line)) for line in flaky_lines)))
    plots = _plots(table, spec_totals[:_MOST_SPECS], curves)
    yield _panel("Robustness", element("div", *plots, **{"class": "plots"}))
    yield _panel("Logs", *_matrix(table, spec_totals[:_MOST_SPECS], reports))


def _panel(title: str, *content: Html) -> Html:
    # a focusable panel that is wider than the page can be scrolled by keys (WCAG 2.1.1)
    attributes = {"class": "panel", "aria-label": title, "tabindex": "0"}
    return element("section", element("h2", title), *content, **attributes)


def _totals(spec_totals: Sequence[Total]) -> Html:
    name_headings = ("case", "spec", "requirement")
    number_headings, cell_rows = total_cells(spec_totals)
    head = [
        *(element("th", name) for name in name_headings),
        *(_number("th", name) for name in number_headings),
    ]
    rows = [
        element(
            "tr",
            *(element("td", text(cell)) for cell in row[: len(name_headings)]),
            *(_number("td", cell) for cell in row[len(name_headings) :]),
        )
        for row in cell_rows
    ]
    return element("table", element("thead", element("tr", *head)), element("tbody", *rows))


def _worst(rows: Sequence[Values], reports: Mapping[tuple[str, str], str]) -> Html:
    name_headings = [element("th", name) for name in ("log", "spec")]
    text_headings = [element("th", name) for name in ("failure", "reason")]
    heading_row = element("tr", *name_headings, _number("th", "robustness"), *text_headings)
    body_rows = [
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
    return element("table", element("thead", heading_row), element("tbody", *body_rows))


def _result_cell(row: Values) -> Iterator[Html]:
    """Yield the name of a result, and its requirement."""
    yield text(result_name(row["spec"] or row["file"], row["object"]))
    if about := requirement_of(row):
        yield element("div", text(about), **{"class": "requirement"})


def _with_code(sentence: str) -> Iterator[Html]:
    """Yield a sentence with its formulas as code."""
    for number, piece in enumerate(sentence_parts(sentence)):
        yield element("code", text(piece)) if number % 2 else text(piece)


def _plots(
    table: pa.Table, spec_totals: Sequence[Total], curves: Mapping[str, Sequence[Curve]]
) -> Iterator[Html]:
    import pyarrow.compute as pc

    has_cases = len({total.group["case"] for total in spec_totals}) > 1
    for total in spec_totals:
        group = total.group
        is_of_spec = pc.and_(
            pc.and_(pc.equal(table["case"], group["case"]), pc.equal(table["file"], group["file"])),
            pc.equal(table["spec"], group["spec"]),
        )
        rows = table.filter(is_of_spec)
        robustness = np.asarray(rows.column("robustness").to_numpy(), np.float64)
        finite = robustness[np.isfinite(robustness)]
        unit = next(filter(None, rows.column("unit").to_pylist()), "")
        if len(finite):
            case = group["case"] if has_cases else None
            title = " · ".join(filter(None, (case, total.requirement, group["spec"])))
            caption = element("figcaption", text(title), **_tip(total.about))
            spec_curves = [
                curve for curve in curves.get(group["case"], ()) if group["spec"] in ("", curve.spec)
            ]
            yield element("figure", caption, _histogram(finite, unit), draw_curves(spec_curves, unit))


def _histogram(numbers: Floats, unit: str) -> Html:
    """Return a histogram as SVG. 0 is an edge of its bins, because the verdict changes there."""
    low, high = min(float(numbers.min()), 0.0), max(float(numbers.max()), 0.0)
    if low == high:
        high = low + 1.0
    bin_width = (high - low) / _BINS
    negative_bins = math.ceil(-low / bin_width) if low < 0.0 else 0
    # `_BINS` + 1 bins, because 0 is an edge
    edges = (np.arange(_BINS + 2) - negative_bins) * bin_width
    counts, _ = np.histogram(numbers, edges)
    largest_count, bar_width = max(1, int(counts.max())), _WIDTH / len(counts)
    bars = []
    for index, count in enumerate(counts.tolist()):
        height = _HEIGHT * count / largest_count
        css_class = "bad" if index < negative_bins else "good"
        box = {
            "x": index * bar_width + 0.5,
            "y": _HEIGHT - height,
            "width": bar_width - 1.0,
            "height": height,
        }
        # bars have no text: the count is in the tooltip
        tooltip = element("title", with_signs(f"{count:,} from {edges[index]:.4g} to {edges[index + 1]:.4g}"))
        attributes = {label: f"{value:.2f}" for label, value in box.items()}
        bars.append(element("rect", tooltip, **attributes, **{"class": css_class}))
    zero = f"{negative_bins * bar_width:.2f}"
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
    label = with_signs(f"Distribution of robustness from {low:.4g} to {high:.4g}")
    view_box = f"0 0 {_WIDTH:.0f} {_HEIGHT + 16:.0f}"
    return element("svg", *bars, axis, *labels, viewBox=view_box, role="img", **{"aria-label": label})


def _matrix(
    table: pa.Table, spec_totals: Sequence[Total], reports: Mapping[tuple[str, str], str]
) -> Iterator[Html]:
    """Yield the table of results: a row for each log, the worst first, and a column for each spec."""
    specs = [(total.group["case"], total.group["file"], total.group["spec"]) for total in spec_totals]
    rows_by_log: dict[str, dict[tuple[str, str, str], Values]] = {}
    rows = worst_rows(table, len(table))
    is_judged = LABEL in table.column_names
    if is_judged:
        rows.sort(key=_agrees)
    for row in rows:
        spec_key = (row["case"], row["file"], row["spec"])
        log_rows = rows_by_log.get(row["log"])
        if log_rows is None:
            if len(rows_by_log) >= _MOST_LOGS:
                continue
            log_rows = rows_by_log[row["log"]] = {}
        # rows are sorted: the first row of a template has the worst object
        log_rows.setdefault(spec_key, row)
    log_count = len(set(table.column("log").to_pylist()))
    if log_count > len(rows_by_log):
        sentence = (
            f"The {len(rows_by_log):,} worst of {plural(log_count, 'log')}; "
            "the table of the run has them all."
        )
        yield element("p", sentence)
    cases = {case for case, _, _ in specs}
    yield _filter()
    titles = [f"{case} · {spec or file}" if len(cases) > 1 else spec or file for case, file, spec in specs]
    units = [f" [{total.unit}]" if total.unit not in (None, "", "1") else "" for total in spec_totals]
    requirements = [total.about for total in spec_totals]
    label_headings = [_sortable(LABEL, "")] if is_judged else []
    head = [
        _sortable("log", ""),
        *label_headings,
        *map(_sortable, map(add, titles, units), ["number"] * len(titles), requirements),
    ]
    body = []
    for log_name, rows_by_spec in rows_by_log.items():
        row_cells = [_cell(rows_by_spec.get(spec_key)) for spec_key in specs]
        report = next(
            ((case, log_name) for case, _, _ in specs if (case, log_name) in reports), ("", log_name)
        )
        if is_judged:
            row_cells.insert(0, _label_cell(next(iter(rows_by_spec.values()))))
        body.append(element("tr", element("td", _log_link(report, reports)), *row_cells))
    yield element("table", element("thead", element("tr", *head)), element("tbody", *body), id="matrix")


def _filter() -> Html:
    """Return the filters of the matrix, and buttons for the previous and next failing row."""
    search_field = element("input", type="search", placeholder="name", **{"aria-label": "Name of a log"})
    checkbox = element("label", element("input", type="checkbox", id="only-failing"), " only failing")
    buttons = [
        element("button", f"{word} failing", type="button", **{"class": "step", "data-step": step})
        for word, step in (("Previous", "-1"), ("Next", "1"))
    ]
    count_text = element("span", "", id="left", role="status")
    return element("p", "Marked results fail. ", search_field, checkbox, *buttons, count_text, id="filter")


def _agrees(row: Values) -> bool:
    """Return whether the label of a row does not contradict the verdict."""
    return row[AGREEMENT] not in ("only_theirs", "only_ours")


def _label_cell(row: Values) -> Html:
    if row[LABEL] is None:
        return element("td", "")
    css_class = "is-satisfied" if row[LABEL] == "success" else "is-violated"
    label_text = row[LABEL] if _agrees(row) else f"{row[LABEL]}, {row[AGREEMENT].replace('_', ' ')}"
    return element("td", label_text, **{"class": css_class if _agrees(row) else f"{css_class} fails"})


def _cell(row: Values | None) -> Html:
    if row is None:
        # JavaScript reads 1e400 as infinity, which sorts last
        return element("td", "", **{"class": "number", "data-value": "1e400"})
    robustness, verdict, fails = row["robustness"], verdict_word(row), row["failure"] is not None
    classes = f"number is-{verdict}{' fails' if fails else ''}"
    baseline = row.get(BASELINE_ROBUSTNESS)
    note = f" (was {baseline:.4g})" if fails and baseline is not None and baseline != robustness else ""
    if row["verdict"] is None:
        return element(
            "td", f"{verdict}{note}", title=row["failure"] or "", **{"class": classes, "data-value": "-1e400"}
        )
    words = verdict if robustness is None or verdict in ("untested", "doubtful") else f"{robustness:.4g}"
    # the sort value is finite, so that errors sort before all numbers, and empty cells after all numbers
    sort_value = "0" if robustness is None else f"{max(-1e300, min(1e300, robustness)):.17g}"
    failure_text = f": {row['failure'].rstrip('.')}" if fails else ""
    tooltip = f"{result_name(row['spec'], row['object'])} is {verdict}{damage_word(row)}{failure_text}."
    tooltip = " ".join(
        [
            tooltip,
            *filter(None, [row["reason"]]),
            *(sentence for sentence in row["untested"] or () if sentence.rstrip(".") not in failure_text),
        ]
    )
    words = f"{words}{damage_word(row)}{note}"
    return element(
        "td", with_signs(words), title=with_signs(tooltip), **{"class": classes, "data-value": sort_value}
    )


def _sortable(title: str, kind: str, about: str = "") -> Html:
    button = element("button", text(title), type="button", **_tip(about))
    return element("th", button, scope="col", **{"class": kind})


def _tip(about: str) -> dict[str, str]:
    """Return the attribute of a tooltip with the requirement. An empty text has no attribute."""
    return {"title": about} if about else {}


def _number(tag: str, words: str) -> Html:
    return element(tag, with_signs(words), **{"class": "number"})


def _log_link(log: tuple[str, str], reports: Mapping[tuple[str, str], str]) -> Html:
    """Return the name of a log, with a link to its page if there is one.

    Args:
        log: case and name of the log.
    """
    return element("a", text(log[1]), href=quote(reports[log])) if log in reports else text(log[1])


INDEX: Final = "index.html"
