"""A report → one HTML page that needs nothing else."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator, Sequence
from functools import cache
from html import escape
from importlib.resources import files as files_of_package
from typing import Final

from spatial_replay import __version__
from spatial_replay.inspection.report.contents import PageData, Report, ReportedResult, page_data
from spatial_replay.inspection.report.packing import json_text
from spatial_replay.inspection.words import time_text
from spatial_replay.markup import Html, counted, element
from spatial_replay.palette import NEGATIVE, NEUTRAL, POSITIVE, hexadecimal

_STYLES: Final = ("uplot/uPlot.min.css", "browser/page.css", "browser/panels.css")
_LIBRARY: Final = "uplot/uPlot.iife.min.js"
_SCRIPTS: Final = (
    "run", "elements", "clock", "standing", "transport", "tree", "lanes", "curves", "gradient", "scene",
    "automaton", "events", "decisions", "page",
)  # fmt: skip
"""Files of browser/, in the order in which they need each other."""

_OPENS: Final = 6
"""Of how many results the explanation is unfolded."""


def page(report: Report) -> bytes:
    """The page, in UTF-8; equal reports give equal bytes."""
    data = page_data(report)
    style = "\n".join([_colours(), *map(_asset, _STYLES)])
    library, script = _asset(_LIBRARY), _script()
    head = "".join(
        [
            '<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_policy([library, script], style)}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="color-scheme" content="light dark">',
            element("title", _text(f"{report.log}: {report.verdict}")),
            f"<style>{style}</style>",
        ]
    )
    body = "".join(
        [
            _header(report, data),
            element("main", *_sections(report), id="main"),
            _footer(report),
            '<div id="transport" class="transport" role="group" aria-label="Time"></div>',
            f'<script type="application/json" id="facts">{json_text(data.facts)}</script>',
            f'<script type="application/octet-stream" id="numbers">{data.numbers}</script>',
            f"<script>{library}</script>",
            f"<script>{script}</script>",
        ]
    )
    text = f'<!doctype html>\n<html lang="en"><head>{head}</head><body>{body}</body></html>\n'
    # half of a pair of surrogates, as in names of broken logs, has no bytes of its own
    return text.encode("utf-8", "replace")


# --------------------------------------------------------------------------------------------- assets


@cache
def _asset(name: str) -> str:
    return files_of_package(__package__).joinpath(name).read_text("utf-8")


def _script() -> str:
    """Our scripts as one, whose names nobody else sees."""
    parts = "\n".join(_asset(f"browser/{name}.js") for name in _SCRIPTS)
    return f'(() => {{\n"use strict";\n{parts}\n}})();\n'


def _policy(scripts: Sequence[str], style: str) -> str:
    """That the browser loads nothing, and runs nothing but what the page was made with."""
    allowed = " ".join(map(_digest, scripts))
    return (
        f"default-src 'none'; script-src {allowed}; style-src {_digest(style)}; "
        "base-uri 'none'; form-action 'none'"
    )


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _colours() -> str:
    named = {"positive": POSITIVE, "negative": NEGATIVE, "neutral": NEUTRAL}
    return f":root{{{''.join(f'--{name}:{hexadecimal(colour)};' for name, colour in named.items())}}}"


# ---------------------------------------------------------------------------------------------- parts


def _header(report: Report, data: PageData) -> Html:
    return element(
        "header",
        element("a", "Skip to the run", **{"class": "skip", "href": "#main"}),
        element(
            "div",
            element("h1", _text(report.log)),
            _chip(report.verdict),
            **{"class": "title"},
        ),
        element("p", _text(" · ".join(_about(report))), **{"class": "about"}),
        *_notices(report, data),
        Html('<noscript><p class="notice">Without scripts this page shows verdicts and explanations alone.'),
        Html("</p></noscript>"),
        **{"class": "top"},
    )


def _about(report: Report) -> Iterator[str]:
    yield ", ".join(file.filename for file in report.files)
    start, end = (time_text(time_ns, report.first_ns) for time_ns in (report.start_ns, report.end_ns))
    yield f"{start} to {end}" if report.start_ns != report.first_ns else end
    yield counted(report.samples, "sample")
    yield f"semantics {report.semantics}"
    yield f"spatial-replay {__version__}"


def _notices(report: Report, data: PageData) -> Iterator[Html]:
    """What a reader has to know before the verdicts."""
    if report.faults:
        what = "The log is damaged: verdicts are over what could be read."
        yield _notice("alert", what, report.faults)
    if report.unreadable:
        verb = "holds" if report.unreadable == 1 else "hold"
        what = f"{counted(report.unreadable, 'observation')} {verb} no finite number: unknown there."
        yield _notice("note", what, report.remarks)
    elif report.remarks:
        yield _notice("note", "The log says of its samples:", report.remarks)
    if data.omissions:
        yield _notice("note", "The run is large, and the page leaves something out:", data.omissions)


def _notice(role: str, what: str, details: Sequence[str]) -> Html:
    listed = [element("li", _text(each)) for each in details]
    content = [element("strong", what), element("ul", *listed) if listed else Html("")]
    return element("div", *content, role=role, **{"class": f"notice {role}"})


def _sections(report: Report) -> Iterator[Html]:
    yield _section("verdicts", "Verdicts", *_verdicts(report))
    yield _section("scene", "Scene", classes="wide")
    yield _section("tree", "Specification")
    yield _section("timeline", "Over time")
    if any(result.automaton is not None for result in report.drawn):
        yield _section("automaton", "Automaton")
    yield _section("events", "Events")
    if report.plan.decisions:
        yield _section("decisions", "Decisions")


def _section(name: str, title: str, *content: Html, classes: str = "") -> Html:
    heading = element("h2", title, id=f"{name}-title")
    body = element("div", *content, id=f"{name}-body", **{"class": "body"})
    about = {"class": f"panel {classes}".strip(), "aria-labelledby": f"{name}-title"}
    return element("section", heading, body, id=name, **about)


def _verdicts(report: Report) -> Iterator[Html]:
    if not report.results:
        yield element("p", "No object was there for a template to stand for.")
    for number, result in enumerate(report.results):
        yield _verdict(result, report.first_ns, is_open=number < _OPENS)


def _verdict(result: ReportedResult, first_ns: int, *, is_open: bool) -> Html:
    numbers = f"robustness {result.robustness_text or 'not determined'}"
    if result.first_satisfied_ns is not None:
        numbers += f", first satisfied at {time_text(result.first_satisfied_ns, first_ns)}"
    summary = element(
        "summary",
        _chip(result.verdict),
        element("span", _text(result.title), **{"class": "name"}),
        element("span", _text(numbers), **{"class": "numbers"}),
    )
    sentences = [element("p", *_with_code(sentence)) for sentence in result.sentences]
    attributes = {"class": f"verdict is-{result.verdict}"}
    if not sentences:
        return element("div", *_unfolded(summary), **attributes)
    return element("details", summary, *sentences, **attributes, **({"open": ""} if is_open else {}))


def _unfolded(summary: Html) -> Iterator[Html]:
    yield Html(summary.replace("<summary>", '<div class="summary">').replace("</summary>", "</div>"))


def _with_code(sentence: str) -> Iterator[Html]:
    """A sentence whose parts between backquotes are code."""
    for number, part in enumerate(sentence.split("`")):
        yield element("code", _text(part)) if number % 2 else _text(part)


def _chip(verdict: str) -> Html:
    return element("span", verdict, **{"class": f"chip is-{verdict}"})


def _footer(report: Report) -> Html:
    texts = [
        element(
            "details",
            element("summary", _text(file.filename)),
            element("pre", _text(file.source)),
        )
        for file in report.files
    ]
    hashes = [
        element("div", element("dt", _text(key)), element("dd", _text(value)))
        for key, value in report.certificate.items()
    ]
    certificate = element("details", element("summary", "Certificate"), element("dl", *hashes))
    return element("footer", *texts, certificate, **{"class": "foot"})


def _text(text: str) -> Html:
    return Html(escape(text))
