"""The HTML page of a report: header, verdicts and explanations as text, panels for the scripts to fill.

Styles, scripts and data are in the page. The page's policy forbids the browser to load anything else.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from types import MappingProxyType
from typing import Final

from spatial_replay.html import Html, element
from spatial_replay.monitor.result import SpecResult, worst_first
from spatial_replay.monitor.sentences import settled_time
from spatial_replay.monitor.verdict import Verdict, counts_text
from spatial_replay.palette import SIGNS
from spatial_replay.report.data import MANY, ReportedResult, RunReport, page_data
from spatial_replay.report.panels import final_text, json_text, sentence_parts, with_signs
from spatial_replay.spec.formula import iter_nodes
from spatial_replay.spec.walks import declared_unit, units_of, units_text
from spatial_replay.text import CALENDAR_NS, Instant, Sentence, plural, printable, time_text
from spatial_replay.version import __version__

HEADER: Final = '<header class="top">'
"""Start tag of a report's header."""
_HEADLINE: Final = re.compile(
    r"`.+` (?:for .+ )?is (?:satisfied|violated): robustness [^ ]+(?: [^ ]+)?"
    r"(?:, certain since [\d.]+ s(?:, least at [\d.]+ s)?)?\."
)
"""Sentences that only repeat the summary line of their result."""
_WITHOUT_SCRIPTS: Final = "Without scripts this page shows verdicts and explanations alone."


def header(report: RunReport, omissions: Sequence[str]) -> Html:
    """Return the header: the run, and notices that a reader needs before the verdicts.

    Args:
        omissions: sentences on data that the page leaves out to limit its size.
    """
    counts_html = (
        element("span", _counts(report), **{"class": "quiet"}) if len(report.results) > 1 else Html("")
    )
    title = element(
        "div", element("h1", text(report.replayed.log)), _chip_of(report), counts_html, **{"class": "title"}
    )
    return element(
        "header",
        element("a", "Skip to the run", **{"class": "skip", "href": "#main"}),
        title,
        element("p", text(" · ".join(_about(report))), *_decisions_link(report), **{"class": "about"}),
        *_notices(report, omissions),
        element("noscript", element("p", _WITHOUT_SCRIPTS, **{"class": "notice"})),
        **{"class": "top"},
    )


def _chip_of(report: RunReport) -> Html:
    verdict = report.replayed.verdict
    deciding = [reported.result for reported in report.results if reported.result.verdict is verdict]
    return chip(verdict, is_sound=all(map(_is_sound, deciding)))


def panels(report: RunReport) -> Html:
    """Return the verdicts and an empty panel for each drawing."""
    has_automaton = any(reported.compiled.automaton is not None for reported in report.drawn)
    sections = [
        panel("verdicts", "Verdicts", *_verdicts(report)),
        *([panel("camera", "Camera", kind="panel wide")] if report.pictures["topic"] else []),
        panel("scene", "Scene", element("p", f"Seen from above, {report.axes}.", **{"class": "axes"})),
        panel("tree", "Specification"),
        panel("timeline", "Over time"),
        panel("automaton", "Automaton", kind="panel" if has_automaton else "panel wide"),
        panel("events", "Events"),
    ]
    if report.decisions.decisions:
        sentence = f"They were made for another specification: {report.planned_for}, as it was recorded."
        note = [element("p", text(sentence), **{"class": "axes"})] if report.planned_for else []
        sections.append(panel("decisions", "Decisions", *note))
    if report.ticks:
        sections.append(panel("ticks", "Behaviour tree"))
    return element("main", *sections, id="main", tabindex="-1")


def footer(report: RunReport) -> Html:
    """Return the texts of the specifications, and the certificate."""
    texts = [
        element("details", element("summary", text(file.filename)), element("pre", text(file.source)))
        for file in report.files
    ]
    hashes = [
        element("div", element("dt", text(key)), element("dd", text(value)))
        for key, value in report.replayed.certificate.items()
    ]
    certificate = element("details", element("summary", "Certificate"), element("dl", *hashes))
    return element("footer", *texts, certificate, **{"class": "foot"})


def text(words: str) -> Html:
    """Return a text with HTML escaped and control characters replaced by spaces."""
    return Html("\n".join(escape(printable(line, len(line))) for line in words.split("\n")))


def _about(report: RunReport) -> Iterator[str]:
    replayed = report.replayed
    yield ", ".join(file.filename for file in report.files)
    if replayed.first_ns >= CALENDAR_NS:
        yield f"{datetime.fromtimestamp(replayed.first_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    start, end = (time_text(time_ns, replayed.first_ns) for time_ns in (replayed.start_ns, replayed.end_ns))
    yield f"{start} to {end}" if replayed.start_ns != replayed.first_ns else end
    yield plural(replayed.samples, "sample")
    yield f"semantics {replayed.semantics}"
    yield f"spatial-replay {__version__}"


def _decisions_link(report: RunReport) -> Iterator[Html]:
    """Yield a link to the panel of decisions for a planned run."""
    if count := len(report.decisions.decisions):
        yield text(" · ")
        yield element("a", text(plural(count, "decision")), href="#decisions")


def _notices(report: RunReport, omissions: Sequence[str]) -> Iterator[Html]:
    replayed = report.replayed
    if replayed.faults:
        message = "The log is damaged: verdicts are over what could be read."
        yield _notice("alert", message, replayed.faults)
    doubts = [doubt.text for doubt in replayed.doubts if not doubt.is_accepted]
    if doubts:
        yield _notice("alert", "The log contradicts how it was read; verdicts may be wrong:", doubts)
    if replayed.unreadable:
        verb = "holds" if replayed.unreadable == 1 else "hold"
        message = f"{plural(replayed.unreadable, 'observation')} {verb} no finite number: unknown there."
        yield _notice("note", message, replayed.remarks)
    elif replayed.remarks:
        yield _notice("note", "The log says of its samples:", replayed.remarks)
    if report.gaps:
        yield _notice("note", "Samples lack what unknown results are about:", report.gaps)
    if replayed.semantics != "ltlf" and report.results:
        yield _notice("note", "Explanations are given under the semantics ltlf alone.", ())
    if omissions:
        yield _notice("note", "The run is large, and the page leaves something out:", omissions)


def _notice(role: str, message: str, details: Sequence[str]) -> Html:
    detail_list = element("ul", *(element("li", text(detail)) for detail in details)) if details else Html("")
    return element("div", element("strong", message), detail_list, role=role, **{"class": f"notice {role}"})


def panel(name: str, title: str, *content: Html, kind: str = "panel") -> Html:
    heading = element("h2", title, id=f"{name}-title")
    body = element("div", *content, id=f"{name}-body")
    return element("section", heading, body, id=name, **{"class": kind, "aria-labelledby": f"{name}-title"})


def _verdicts(report: RunReport) -> Iterator[Html]:
    if not report.results:
        yield element("p", "The templates matched no objects.")
    first_ns = report.replayed.first_ns
    for part in report.replayed.vacuous:
        yield element("p", *sentence_html(part.message, first_ns))
    page_indices = {id(result): index for index, result in enumerate(report.drawn)}
    are_many = len(report.results) > MANY
    if are_many:
        yield element("p", text(_counts(report)), id="counts", **{"class": "counts"})
    worst_indices = worst_first(report.replayed.results)
    for position, reported in enumerate(report.results[index] for index in worst_indices):
        # the script shows this result in all panels after a click on the verdict
        result_attribute = (
            {"data-result": str(page_indices[id(reported)])} if id(reported) in page_indices else {}
        )
        is_reported = reported.result.verdict == report.replayed.verdict or bool(reported.result.remarks)
        is_unfolded = is_reported and not (are_many and position)
        open_attribute = {"open": ""} if reported.sentences and is_unfolded else {}
        attributes = {
            "class": "verdict",
            "data-verdict": str(reported.result.verdict),
            **result_attribute,
            **open_attribute,
        }
        sentences = [sentence for sentence in reported.sentences if not _HEADLINE.fullmatch(sentence)]
        content = [element("p", *sentence_html(sentence, first_ns)) for sentence in sentences]
        content += [_specs(reported, first_ns)] if reported.sentences else []
        yield element("details" if content else "div", _summary(reported, first_ns), *content, **attributes)


def _counts(report: RunReport) -> str:
    return counts_text(reported.result.verdict for reported in report.results)


def _summary(reported: ReportedResult, first_ns: int) -> Html:
    """Return the summary line of a result: verdict, requirement, robustness, and start of its certainty."""
    result = reported.result
    number_texts = [f"robustness {reported.robustness_text or 'not determined'}"]
    if result.violated_at_ns is not None:
        if result.least is None and result.least_at_ns is not None:
            number_texts.append(f"least at {Instant(result.least_at_ns, first_ns)}")
        number_texts.append(f"violated since {Instant(result.violated_at_ns, first_ns)}")
    elif result.satisfied_at_ns is not None:
        number_texts.append(f"satisfied since {Instant(result.satisfied_at_ns, first_ns)}")
    elif result.verdict is Verdict.SATISFIED and result.first_satisfied_ns is not None:
        number_texts.append(f"first satisfied at {Instant(result.first_satisfied_ns, first_ns)}")
    flaws = _mark(result)
    flaw_chips = [element("span", flaws, **{"class": "chip is-vacuous"})] if flaws else []
    return element(
        "summary" if reported.sentences else "div",
        chip(result.verdict, is_sound=_is_sound(result)),
        *flaw_chips,
        *_requirement(result.spec.id, result.title, result.spec.title),
        element("span", text(with_signs(", ".join(number_texts))), **{"class": "numbers"}),
        **{"class": "summary"},
    )


def _is_sound(result: SpecResult) -> bool:
    """Return whether a verdict is reliable: the log tested it, and no doubt about the log affects it."""
    return result.tested != "nothing" and not result.doubts


def _mark(result: SpecResult) -> str:
    """Return the flaws of a verdict in words; "" without flaws."""
    flaws = ["doubtful"] if result.doubts else []
    if result.tested == "nothing":
        return ", ".join([*flaws, "tested by nothing"])
    if result.vacuous:
        flaws.append("a part decided nothing" if len(result.vacuous) == 1 else "parts decided nothing")
    flaws += ["the end of the log cut a window"] if result.tested == "cut" else []
    return ", ".join(flaws)


def _requirement(identifier: str | None, name: str, title: str | None) -> Iterator[Html]:
    """Yield the id of a requirement, the name of its spec, and its title."""
    if identifier is not None:
        yield element("span", text(identifier), **{"class": "requirement"})
    yield element("span", text(name), **{"class": "name"})
    if title is not None:
        yield element("span", text(title), **{"class": "title-words"})


def _specs(reported: ReportedResult, first_ns: int) -> Html:
    """Return a row for each named spec within a result, and a sentence on mixed units."""
    specs_by_name = {spec.name: spec for spec in reported.file.specs}
    rows, formulas = [], {identifier: node for identifier, _, node in iter_nodes(reported.result.formula)}
    for node in reported.specs:
        settled_ns = settled_time(reported.result.settled_ns, node.id)
        spec = specs_by_name.get(node.name or "")
        id_and_title = (None, None) if spec is None else (spec.id, spec.title)
        unit = declared_unit(formulas[node.id], reported.result.evidence.units)
        numbers_text = f"robustness {final_text(node.robustness, node.final_lower, node.final_upper, unit)}"
        if settled_ns is not None:
            numbers_text += f", violated since {Instant(settled_ns, first_ns)}"
        numbers_html = element("span", text(with_signs(numbers_text)), **{"class": "numbers"})
        rows.append(
            element(
                "li",
                chip(node.verdict),
                *_requirement(id_and_title[0], node.name or "", id_and_title[1]),
                numbers_html,
            )
        )
    parts = [element("ul", *rows, **{"class": "specs"})] if rows else []
    if units_sentence := units_text(units_of(reported.result.formula)):
        parts.append(element("p", text(units_sentence), **{"class": "units"}))
    return element("div", *parts)


def sentence_html(sentence: Sentence, first_ns: int) -> Iterator[Html]:
    """Yield the parts of a sentence: quoted parts as code, times with nanoseconds since the log's zero."""
    for part in sentence.parts:
        if isinstance(part, Instant):
            yield element("span", str(part), **{"data-time-ns": str(part.time_ns - first_ns)})
            continue
        for piece_index, piece in enumerate(sentence_parts(part)):
            yield element("code", text(piece)) if piece_index % 2 else text(piece)


def chip(verdict: str, *, is_sound: bool = True) -> Html:
    """Return a verdict on a background of its colour; an unsound verdict has a neutral background."""
    return element("span", verdict, **{"class": f"chip is-{verdict if is_sound else 'vacuous'}"})


LIGHT: Final[Mapping[str, str]] = MappingProxyType(
    {
        "paper": "#f6f6f3",
        "panel": "#ffffff",
        "ink": "#1f2328",
        "quiet": "#59626b",
        "line": "#d9dce0",
        "grid": "#e4e6e9",
        "band": "rgb(120 130 140 / 0.16)",
        "lit": "#ffe9a8",
        "positive-line": "#0072b2",
        "negative-line": "#d55e00",
        "pending": "#d9c400",
        "positive-text": "#00598c",
        "negative-text": "#a34700",
    }
)
DARK: Final[Mapping[str, str]] = MappingProxyType(
    {
        "paper": "#111417",
        "panel": "#191d21",
        "ink": "#e8eaed",
        "quiet": "#a3acb5",
        "line": "#343a41",
        "grid": "#2b3137",
        "band": "rgb(170 180 190 / 0.15)",
        "lit": "#5c4a12",
        "positive-line": "#3fa2dd",
        "negative-line": "#f0802b",
        "pending": "#f0e442",
        "positive-text": "#7cc3ee",
        "negative-text": "#ffa35c",
    }
)
"""Colours by name in the style sheets.

Texts have a contrast of at least 4.5 to 1 on paper and panel, as
https://www.w3.org/TR/WCAG21/#contrast-minimum requires."""


def theme() -> str:
    """Return the colours as a style sheet, which follows the system's theme unless the reader chose one."""
    light = _rule({"color-scheme": "light", **_variables(SIGNS), **_variables(LIGHT)})
    dark = _rule({"color-scheme": "dark", **_variables(DARK)})
    return (
        f':root{light}:root[data-theme="dark"]{dark}'
        f'@media (prefers-color-scheme:dark){{:root:not([data-theme="light"]){dark}}}'
        f'@media print{{:root,:root[data-theme="dark"],:root:not([data-theme="light"]){light}}}'
    )


def _variables(colours: Mapping[str, str]) -> dict[str, str]:
    return {f"--{name}": colour for name, colour in colours.items()}


def _rule(declarations: Mapping[str, str]) -> str:
    return "{" + "".join(f"{name}:{value};" for name, value in declarations.items()) + "}"


_STYLES: Final = ("uplot/uPlot.min.css", "browser/page.css", "browser/panels.css")
_LIBRARY: Final = "uplot/uPlot.iife.min.js"
_SCRIPTS: Final = (
    "elements", "read", "clock", "verdicts", "tree", "timeline", "curves", "map", "decisions", "behaviour",
    "scene", "camera", "automaton",
)  # fmt: skip
"""Scripts in browser/, in the order of loading; the script of the page follows."""


def page(report: RunReport) -> bytes:
    """Return the page in UTF-8. Equal reports give equal bytes."""
    data = page_data(report)
    return document(
        f"{report.replayed.log}: {report.replayed.verdict}",
        [header(report, data.omissions), panels(report), footer(report)],
        {"facts": json_text(data.facts)},
        {"numbers": data.numbers},
        "page",
        has_pictures=bool(report.pictures.get("pictures")),
    )


def document(
    title: str,
    parts: Sequence[Html],
    facts: Mapping[str, str],
    numbers: Mapping[str, str],
    script_name: str,
    *,
    has_pictures: bool = False,
) -> bytes:
    """Return a whole page about runs in UTF-8.

    Args:
        parts: content of the body above the playback bar.
        facts: JSON data for the scripts, by the id of their element.
        numbers: packed arrays for the scripts, by the id of their element.
        script_name: script in browser/ that runs the other scripts.
        has_pictures: whether the facts have pictures.
    """
    json_kind, packed_kind = "application/json", "application/octet-stream"
    body = [
        *parts,
        '<div id="transport" class="transport" role="region" aria-label="Time"></div>',
        *(f'<script type="{json_kind}" id="{name}">{fact}</script>' for name, fact in facts.items()),
        *(f'<script type="{packed_kind}" id="{name}">{number}</script>' for name, number in numbers.items()),
    ]
    scripts = [asset(_LIBRARY), _script(script_name)]
    return html_page(title, body, scripts, _STYLES, has_pictures=has_pictures)


def html_page(
    title: str,
    body: Sequence[str],
    scripts: Sequence[str],
    styles: Sequence[str],
    *,
    marks: str = "",
    has_pictures: bool = False,
) -> bytes:
    """Return a page with inline styles and scripts, in UTF-8.

    Args:
        styles: names of style sheets, see `asset`.
        marks: attributes of the root element.
    """
    style = "\n".join([theme(), *map(asset, styles)])
    page_parts = [
        f'<!doctype html>\n<html lang="en"{marks}><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{_policy(scripts, style, has_pictures)}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta name="color-scheme" content="light dark">',
        element("title", text(title)),
        f"<style>{style}</style></head><body>",
        *body,
        *(f"<script>{script}</script>" for script in scripts),
        "</body></html>\n",
    ]
    return "".join(page_parts).encode("utf-8")


def asset(name: str) -> str:
    """Return the text of a file of this package, or of another package: "batch:overview.css"."""
    room, _, file = name.rpartition(":")
    return files(f"spatial_replay.{room or 'report'}").joinpath(file).read_text("utf-8")


def _script(name: str) -> str:
    """Return all scripts joined, in one function scope."""
    scripts = "\n".join(asset(f"browser/{script}.js") for script in (*_SCRIPTS, name))
    return f'(() => {{\n"use strict";\n{scripts}\n}})();\n'


def _policy(scripts: Sequence[str], style: str, has_pictures: bool) -> str:
    """Return the Content-Security-Policy: nothing is loaded, and only the page's own scripts run.

    Hashes permit the inline scripts and styles: https://www.w3.org/TR/CSP3/#grammardef-hash-source
    """
    pictures = "img-src data:; " if has_pictures else ""
    script_sources = " ".join(map(_digest, scripts))
    return (
        f"default-src 'none'; script-src {script_sources}; style-src {_digest(style)}; {pictures}"
        "base-uri 'none'; form-action 'none'"
    )


def _digest(content: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
