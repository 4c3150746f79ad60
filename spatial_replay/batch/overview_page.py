"""One HTML page over all logs of a run: totals, distributions of robustness, and logs by specs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

import numpy as np

from spatial_replay import __version__
from spatial_replay.batch.baseline import BASELINE_ROBUSTNESS
from spatial_replay.batch.run_table import (
    Total,
    Values,
    counts_of,
    damage_word,
    requirement_of,
    result_name,
    summary_text,
    totals,
    verdict_word,
    worst_rows,
)
from spatial_replay.notebook.figures import Html, element
from spatial_replay.report.compact import sentence_parts
from spatial_replay.report.page import policy, text, theme
from spatial_replay.text import counted

if TYPE_CHECKING:
    import pyarrow as pa

    from spatial_replay.geometry.arrays import Floats

_MOST_LOGS: Final = 2_000
"""Rows of the matrix; a page with more is slow to open."""
_MOST_SPECS: Final = 60
"""Columns of the matrix, and distributions."""
_WORST: Final = 10
_BINS: Final = 24
_WIDTH: Final = 240.0
_HEIGHT: Final = 60.0
_STYLES: Final = ("report:browser/page.css", "batch:overview.css")


def overview_page(table: pa.Table, name: str, reports: Mapping[tuple[str, str], str]) -> bytes:
    """Return the page, in UTF-8; equal tables give equal bytes.

    Args:
        table: of a run.
        name: of the suite.
        reports: for cases and logs by name, the address of the page about them, relative to this one.
    """
    style = "\n".join([theme(), *map(_asset, _STYLES)])
    script = _asset("batch:overview.js")
    parts = [
        '<!doctype html>\n<html lang="en" data-read><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy([script], style)}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        element("title", text(f"{name}: {_headline(table)}")),
        f"<style>{style}</style></head><body>",
        _header(table, name),
        element("main", *_panels(table, reports)),
        f"<script>{script}</script></body></html>\n",
    ]
    return "".join(parts).encode("utf-8")


def _asset(name: str) -> str:
    room, _, file = name.partition(":")
    return files(f"spatial_replay.{room}").joinpath(file).read_text("utf-8")


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


def _panels(table: pa.Table, reports: Mapping[tuple[str, str], str]) -> Iterator[Html]:
    by_spec = totals(table)
    yield _panel("Specifications", _totals(by_spec))
    worst = [row for row in worst_rows(table, _WORST) if row["failure"] is not None]
    if worst:
        yield _panel("The worst", _worst(worst, reports))
    yield _panel("Robustness", element("div", *_plots(table, by_spec[:_MOST_SPECS]), **{"class": "plots"}))
    yield _panel("Logs", *_matrix(table, by_spec[:_MOST_SPECS], reports))


def _panel(title: str, *content: Html) -> Html:
    return element("section", element("h2", title), *content, **{"class": "panel"})


def _totals(by_spec: Sequence[Total]) -> Html:
    names = ("case", "spec", "requirement")
    columns = counts_of(by_spec)
    numbers = (*columns, "least robustness")
    head = [*(element("th", each) for each in names), *(_number("th", each) for each in numbers)]
    rows = []
    for place, each in enumerate(by_spec):
        group = each.group
        cells = [group["case"], group["spec"] or group["file"], each.about]
        counts = [f"{own[place]:,}" for own in columns.values()]
        least = "" if each.least is None else f"{each.least:.6g}"
        rows.append(
            element(
                "tr",
                *(element("td", text(cell)) for cell in cells),
                *(_number("td", count) for count in (*counts, least)),
            )
        )
    return element("table", element("thead", element("tr", *head)), element("tbody", *rows))


def _worst(rows: Sequence[Values], reports: Mapping[tuple[str, str], str]) -> Html:
    names = [element("th", each) for each in ("log", "spec")]
    texts = [element("th", each) for each in ("failure", "reason")]
    head = element("tr", *names, _number("th", "robustness"), *texts)
    body = [
        element(
            "tr",
            element("td", _linked((row["case"], row["log"]), reports), **{"class": "log"}),
            element("td", *_named(row)),
            _number("td", "" if math.isnan(row["robustness"]) else f"{row['robustness']:.4g}"),
            element("td", text(row["failure"])),
            element("td", *_with_code(row["reason"])),
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


def _plots(table: pa.Table, by_spec: Sequence[Total]) -> Iterator[Html]:
    import pyarrow.compute as pc

    has_cases = len({each.group["case"] for each in by_spec}) > 1
    for each in by_spec:
        group = each.group
        fits = pc.and_(
            pc.and_(pc.equal(table["case"], group["case"]), pc.equal(table["file"], group["file"])),
            pc.equal(table["spec"], group["spec"]),
        )
        numbers = np.asarray(table.filter(fits).column("robustness").to_numpy(), np.float64)
        finite = numbers[np.isfinite(numbers)]
        if len(finite):
            case = group["case"] if has_cases else None
            title = " · ".join(filter(None, (case, each.requirement, group["spec"])))
            caption = element("figcaption", text(title), **_tip(each.about))
            yield element("figure", caption, _histogram(finite))


def _histogram(numbers: Floats) -> Html:
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
        element("text", f"{low:.4g}", x="0", y=f"{_HEIGHT + 12:.0f}"),
        element("text", f"{high:.4g}", x=f"{_WIDTH:.0f}", y=f"{_HEIGHT + 12:.0f}", **{"text-anchor": "end"}),
    ]
    name = f"Distribution of robustness from {low:.4g} to {high:.4g}"
    view = f"0 0 {_WIDTH:.0f} {_HEIGHT + 16:.0f}"
    return element("svg", *bars, axis, *labels, viewBox=view, role="img", **{"aria-label": name})


def _matrix(
    table: pa.Table, by_spec: Sequence[Total], reports: Mapping[tuple[str, str], str]
) -> Iterator[Html]:
    """Yield a row for each log, the worst first, and a column for each spec."""
    columns = [(each.group["case"], each.group["file"], each.group["spec"]) for each in by_spec]
    cells: dict[str, dict[tuple[str, str, str], Values]] = {}
    for row in worst_rows(table, len(table)):
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
    yield element("p", "Marked results fail.")
    titles = [f"{case} · {spec or file}" if len(cases) > 1 else spec or file for case, file, spec in columns]
    abouts = [each.about for each in by_spec]
    head = [_sortable("log", ""), *map(_sortable, titles, ["number"] * len(titles), abouts)]
    body = []
    for name, of_log in cells.items():
        shown = [_cell(of_log.get(column)) for column in columns]
        own = next(((case, name) for case, _, _ in columns if (case, name) in reports), ("", name))
        body.append(element("tr", element("td", _linked(own, reports)), *shown))
    yield element("table", element("thead", element("tr", *head)), element("tbody", *body), id="matrix")


def _cell(row: Values | None) -> Html:
    if row is None:
        return element("td", "", **{"class": "number", "data-value": "1e400"})
    number, verdict, fails = row["robustness"], verdict_word(row), row["failure"] is not None
    kind = f"number is-{verdict}{' fails' if fails else ''}"
    was = row.get(BASELINE_ROBUSTNESS)
    before = (
        f" (was {was:.4g})" if fails and was is not None and was != number and not math.isnan(was) else ""
    )
    if row["verdict"] is None:
        return element(
            "td", f"{verdict}{before}", title=row["failure"], **{"class": kind, "data-value": "-1e400"}
        )
    shown = verdict if math.isnan(number) or verdict == "untested" else f"{number:.4g}"
    value = "0" if math.isnan(number) else f"{max(-1e300, min(1e300, number)):.17g}"
    why = f": {row['failure']}" if fails else ""
    tip = f"{result_name(row['spec'], row['object'])} is {verdict}{damage_word(row)}{why}. {row['reason']}"
    tip = " ".join([tip, *(row["untested"] or ())])
    shown = f"{shown}{damage_word(row)}{before}"
    return element("td", shown, title=tip, **{"class": kind, "data-value": value})


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
